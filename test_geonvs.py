# SPDX-License-Identifier: MIT
"""Part I: tests, in the order of data_prep.py and geonvs.py. Part II: rivals and experiments.

Tests check properties: against plain loops in float64, closed forms, limits, invariances, round
trips. Nothing needs data, network or a GPU, nothing is skipped, and no timing decides.
"""
import contextlib
import copy
import csv
import functools
import io
import itertools
import json
import math
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tarfile
import threading
import time
import tracemalloc
from collections import defaultdict
from dataclasses import asdict, fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple
from unittest import mock
from urllib.error import HTTPError

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from torch import nn
from torch.optim import adam
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import data_prep
import geonvs
from data_prep import UserError

if __name__ != "__main__":
    torch.set_num_threads(1)  # the scenes of tests are tiny: a second thread would only wait

# ==== Part I: tests ===============================================================================

TINY_TOY = dict(size=32, photos=6, test=2)  # photos: for training, in the scene
TINY = dict(  # photos: of a step
    steps=6, rays=64, photos=4, samples=8, bg_samples=6, hidden=16, levels=3, appearance_dim=4)


def cases(names, **rows):
    """A table of cases: the name of each row is its test's id."""
    return pytest.mark.parametrize(names, list(rows.values()), ids=list(rows))


@functools.cache
def toy(**knobs):
    return data_prep.make_toy(**TINY_TOY | knobs)


@pytest.fixture(scope="session")
def scene():
    return geonvs.load_scene(toy())


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


@pytest.fixture
def double():
    """New tensors are of float64 during the test."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture
def in_tmp_dir(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def random(*shape, low=0.0, high=1.0):
    return low + (high - low) * torch.rand(shape)


def assert_tensors_close(actual, wanted, tolerance=1e-5):
    wanted = torch.as_tensor(wanted)
    torch.testing.assert_close(actual, wanted, rtol=tolerance, atol=tolerance, check_dtype=False)


def assert_arrays_close(found, wanted, atol=1e-6):
    np.testing.assert_allclose(found, wanted, atol=atol, rtol=1e-5)


def assert_same_arrays(a, b, *keys):
    for key in keys or a:
        np.testing.assert_equal(a[key], b[key], key)


def assert_same_tensors(a, b):
    torch.testing.assert_close(a, b, rtol=0, atol=0)


def lengths(x):
    return np.linalg.norm(x, axis=-1)


def photo(scene, i, key="rgb"):
    w, h = scene["wh"][i]
    pixels = scene[key][scene["start"][i]:scene["start"][i + 1]]
    return pixels.reshape(h, w, *pixels.shape[1:])


def world(scene, x):
    return x * scene["scale"] + scene["center"]


def put(path, content):
    """Writes a file, bytes or text, in a folder that may be new."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else os.fsencode(content))


def run_main(command):
    """Exit code, stdout and stderr of data_prep's command line."""
    code = 0
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            data_prep.run_command_line(lambda: data_prep.main(command.split()))
        except SystemExit as e:
            code = e.code
    return code, out.getvalue(), err.getvalue()


def assert_error(says, command="place"):
    code, out, err = run_main(command)
    assert code == 2
    assert says in err
    assert "error: " in err.splitlines()[-1]
    assert not list(Path().glob("data/*.npz"))


# ---- progress and scene files --------------------------------------------------------------------
@cases(
    "is_terminal, seconds, told",
    quick=(True, 0.9, []),
    terminal=(True, 3.8, [3, 4, 5]),
    short_log=(False, 2.1, [5]),
    log=(False, 40, [2, 4, 5]))
def test_progress_is_told_after_ten_seconds(is_terminal, seconds, told, monkeypatch, capsys):
    clock = itertools.count(100, seconds)
    monkeypatch.setattr(data_prep, "time", SimpleNamespace(monotonic=clock.__next__))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: is_terminal, raising=False)
    assert list(data_prep.progress(range(5), "counting")) == list(range(5))
    wanted = ""
    for done in told:
        end = "\r" if is_terminal and done < 5 else "\n"
        wanted += f"  counting: {done} of 5, {(5 - done) * seconds:.0f} s left {end}"
    assert capsys.readouterr().out == wanted


def attempt(read, *args):
    """What read() returns; None where it refuses in one sentence."""
    try:
        return read(*args)
    except UserError as e:
        assert "\n" not in str(e)


@contextlib.contextmanager
def in_little_memory():
    """Python and numpy take less than 2 MiB meanwhile."""
    tracemalloc.start()
    yield
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2 ** 21


def is_usable(data):
    """Whether a scene file of these bytes or arrays is read and used, or refused."""
    path = Path("scene.npz")
    if isinstance(data, bytes):
        path.write_bytes(data)
    else:
        np.savez(path, **data)
    scene = attempt(data_prep.read_scene, path)
    return scene is not None and "near" in data_prep.add_statistics(scene)


def test_damaged_scene_files_do_no_harm(in_tmp_dir):
    """A changed byte is harmless, or refused in one sentence; there is no other exception."""
    assert is_usable(toy())
    good = Path("scene.npz").read_bytes()
    directory = good.find(b"PK\1\2")  # the zip directory, at the end
    for at in [*range(0, 300, 3), *range(directory, len(good), 25)]:
        is_usable(good[:at] + b"9" + good[at + 1:])
    end = b", 3), }"  # of a header's shape (rows, 3); spaces follow
    more_rows = good.replace(end + b" " * 9, b"0" * 9 + end)
    for bad in [more_rows, *[good[:size] for size in (0, 99, 9999, -99, -9)]]:
        assert not is_usable(bad)
    np.savez_compressed("bomb.npz", **toy() | dict(rgb=np.zeros((2 ** 22, 3), np.uint8)))
    with in_little_memory():
        assert attempt(data_prep.read_scene, "bomb.npz") is None


class Evil(str):
    """Makes a folder of this name when it is unpickled."""
    def __reduce__(self):
        return os.mkdir, (str(self),)


@cases(
    "keys, change",
    missing=(" ".join(data_prep.FORMAT), None),
    one_axis_more=(" ".join(data_prep.FORMAT | data_prep.OPTIONAL), lambda array: array[None]),
    other_type=(" ".join(data_prep.FORMAT | data_prep.OPTIONAL), lambda array: array.astype("S9")),
    infinite=("K c2w points center scale track_uv near footprint exposure_spread", np.inf),
    zero=("scale footprint", 0),
    negative=("track_photo track_point", -1),
    mirrored=("wh", lambda wh: -wh),
    no_such_photo=("track_photo", 8),  # photos are 0..7
    nothing_to_train=("is_test", True),
    no_split=("info", '{"kind": 1, "scene": 1, "downscale": 1, "folder": 1}'),
    late_start=("start", lambda start: np.maximum(start, 1)),
    shorter=("rgb K c2w is_test name near", lambda array: array[1:]),
    code=("name", lambda name: np.array([Evil("harm")], object)))
def test_impossible_arrays_are_refused(in_tmp_dir, keys, change):
    good = toy() | dict(masked=np.zeros(len(toy()["rgb"]), bool))
    for key in keys.split():
        scene = {needed: good[needed] for needed in data_prep.FORMAT if needed != key}
        if change is not None:
            scene[key] = change(good[key]) if callable(change) else np.full_like(good[key], change)
        assert not is_usable(scene), key
    assert not Path("harm").exists()


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "sub/sub" / ("x" * 251 + ".png")  # a name may have 255 bytes
    data_prep.atomic_write(path, lambda part: part.write_text("old"))

    def write(part):
        part.write_text("half")
        raise OSError(28, "No space left")
    with pytest.raises(UserError, match="No space left"):
        data_prep.atomic_write(path, write)
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == [path.name]


def test_a_written_mesh_reads_back_exactly(tmp_path):
    rng = np.random.default_rng(0)
    vertices = rng.normal(4e5, 1.0, (5, 3))
    colors, faces = rng.integers(0, 5, (2, 5, 3))
    path = tmp_path / "a.ply"
    data_prep.write_ply(path, vertices, faces[:4], colors)
    head, body = path.read_bytes().split(b"end_header\n")
    assert re.findall(rb"element (\w+ \d)", head) == [b"vertex 5", b"face 4"]
    rows = list(struct.iter_unpack("<3d3B", body[:5 * 27]))
    assert np.array_equal(rows, np.hstack([vertices, colors]))
    corners = list(struct.iter_unpack("<B3i", body[5 * 27:]))
    assert np.array_equal(corners, np.insert(faces[:4], 0, 3, axis=1))


# ---- the sphere ----------------------------------------------------------------------------------
def ball(count):
    """Random points of the unit ball (count,3)"""
    x = np.random.default_rng(0).uniform(-1, 1, (3 * count, 3))
    return x[lengths(x) < 1][:count]


def scene_of_points(
        xyz, views=20, tracks=None, is_test=(False, False, False), error=0, contain=(),
        masks=np.zeros((3, 20, 20), bool)):
    """The scene of three black photos that see these points: all of them, unless said. The cameras
    are at the origin; their axes meet a corner of 20 x 20 pixels."""
    points = np.stack(np.broadcast_arrays(*xyz.T, error, views), axis=1)
    photos = []
    for track, mask, test in zip(tracks or [np.arange(len(xyz))] * 3, masks, is_test):
        image = np.zeros((*mask.shape, 3), np.uint8)
        K = np.full(4, 20)
        photos.append(data_prep.Photo("a", image, mask, K, np.eye(3, 4), track, test))
    return data_prep.build_scene(photos, points, {}, contain)


BALL_SCALE = 1.1 * .95 ** (1 / 3)  # 1.1 x the radius that holds 95 % of a uniform ball
TWO_BALLS = np.concatenate([ball(2000), ball(300) + [40, 0, 0]])
NEAR = np.arange(100)  # points of the first ball
FAR = np.arange(2000, 2150)


@cases(
    "given, scale, tolerance",
    ball=(dict(xyz=3 * ball(2000) + 5), 3 * BALL_SCALE, .09),
    # The 95 % quantile is a skyline's, which is cut off.
    skyline=(dict(xyz=np.concatenate([ball(2000), 10 * ball(130)])), BALL_SCALE, .1),
    # 1 %: the quantile is the ball's.
    distant_skyline=(dict(xyz=np.concatenate([ball(2000), 1e6 * ball(20)])), BALL_SCALE, .1),
    most_see_far=(dict(xyz=TWO_BALLS, tracks=[NEAR, FAR, FAR]), 45, 15),
    most_see_near=(dict(xyz=TWO_BALLS, tracks=[NEAR, NEAR, FAR]), 1.1, .1),
    held_out_see_far=(
        dict(xyz=TWO_BALLS, tracks=[NEAR, FAR, FAR], is_test=[False, True, True]), 1.1, .1),
    corners=(
        dict(xyz=np.concatenate([ball(1000), -ball(1000)]), contain=[[0, 3, 4], [1, 0, 0]]),
        1.02 * 5, 1e-6))
def test_the_sphere_holds_the_landmark(given, scale, tolerance):
    scene = scene_of_points(**given)
    assert abs(scene["scale"] - scale) < tolerance
    assert lengths(scene["center"] - given["xyz"][:2000].mean(0)) < 1.6 * tolerance
    assert_arrays_close(world(scene, scene["c2w"][:, :, 3]), 0)


def test_points_count_by_views_up_to_twenty():
    xyz = np.concatenate([ball(2000), ball(1500) + [3, 0, 0]])
    views = [(20, 3), (900, 20), (20, 20)]  # of the points of each ball
    scenes = [scene_of_points(xyz, np.repeat(pair, (2000, 1500))) for pair in views]
    second_rare, first_often, equal = [scene["center"][0] for scene in scenes]
    assert second_rare < .5 * equal
    assert first_often == equal


@pytest.mark.parametrize("count, kept", [(500, 475), (499, 2136)])
def test_points_of_few_views_or_large_errors_go(count, kept):
    """Two views suffice where fewer than 500 points have three; 5 % are dropped by error."""
    views = np.where(np.arange(2249) < count, 3, 2)
    scene = scene_of_points(ball(2249), views, error=np.arange(2249))
    points = world(scene, scene["points"].astype(float))
    assert_arrays_close(points, ball(2249)[:kept], atol=1e-4)


@cases(
    "xyz, held_out, says",
    too_few=(ball(19), False, "overlapping photos"),
    one_place=(np.ones((30, 3)), False, "coincide"),
    held_out=(ball(30), True, "no training photo"))
def test_points_without_a_sphere_are_an_error(xyz, held_out, says):
    with pytest.raises(UserError, match=says):
        scene_of_points(xyz, is_test=[held_out] * 3)


def test_points_that_most_photos_mask_are_not_there():
    masks = np.zeros((3, 20, 40), bool)  # 40 px wide: x and y are in -1..1 and -1..0
    masks[[0, 2], 5:, 30:] = True
    xyz = np.random.default_rng(0).uniform((-1, -1, 1), (1, 0, 1), (600, 3))
    is_third = np.arange(600) % 2 == 0  # the last photo sees every other point
    is_clear = (xyz[:, 0] < .5) | (xyz[:, 1] < -.75)
    is_there = is_clear | ~is_third  # half of the sightings are enough
    every = np.arange(600)
    scene = scene_of_points(xyz, tracks=[every, every, every[is_third]], masks=masks)
    for i, seen in enumerate([is_clear, is_there, is_clear & is_third]):
        track = scene["track_point"][scene["track_photo"] == i]
        assert_arrays_close(world(scene, scene["points"][track]), xyz[seen])


def test_near_footprint_and_sightings_follow_the_points():
    xyz = ball(900)
    xyz[:100] *= 9  # most of these lie outside of the sphere
    xyz += [0, 0, 8]  # before the cameras and, a few, behind them
    xyz[0] = 0  # where the cameras are
    tracks = [np.arange(1, 900), np.arange(1), np.arange(0)]
    scene = scene_of_points(xyz, tracks=tracks, is_test=[False, True, True])
    distance = lengths(xyz[1:]) / scene["scale"]
    in_sphere = distance[lengths(scene["points"][1:]) < 1]
    z = xyz[1:, 2:]
    uv = np.where(z > 0, xyz[1:, :2] / z + 1, -1)
    assert_arrays_close(scene["near"], [.8 * np.quantile(distance, .02), .02, .05])
    assert_arrays_close(scene["footprint"], np.quantile(in_sphere, .25) / 20)
    assert_arrays_close(scene["track_uv"][:-1], uv.clip(-1, 2), atol=1e-3)


@cases(
    "count, alike, color",
    agreed=(200, 124, .2),
    disagreed=(200, 116, np.nan),
    too_few=(99, 99, np.nan))
def test_background_is_what_sixty_percent_of_many_pixels_agree_on(count, alike, color):
    colors = np.random.default_rng(0).integers(0, 255, (count, 3), np.uint8)
    colors[:alike] = 51
    assert_arrays_close(data_prep.common_color(colors), [color] * 3)
    assert_arrays_close(toy(background=False)["bg_color"], [0, 0, 0])  # the landmark is not black


@cases("is_masked, spread, color", no=(False, 25 / 255, np.nan), yes=(True, 0, 0))
def test_colors_are_of_training_photos_without_masks(is_masked, spread, color):
    masks = [np.full((20, 20), i == 1 and is_masked) for i in range(3)]
    scene = scene_of_points(  # all rays miss the sphere
        ball(500) + [9, 9, 9], is_test=[False, False, True], masks=masks)
    scene["rgb"][400:800] = 50
    scene["rgb"][800:] = 255
    scene = data_prep.add_statistics(scene)
    assert_arrays_close(scene["exposure_spread"], spread)
    assert_arrays_close(scene["bg_color"], [color] * 3)


# ---- COLMAP folders ------------------------------------------------------------------------------
SPARSE = Path("place/sparse")
IMAGES = Path("place/images")
MASKS = Path("place/masks")
TABLE = Path("place/toy.tsv")
PHOTO = IMAGES / "toy_000.png"  # for training, 24 x 32 pixels; toy_002 and toy_006 are held out
BLACK = np.zeros((32, 24))


def write_model(model, folder=SPARSE):
    cameras = [struct.pack("<iiQQ8d", 99, 5, 0, 0, *[np.nan] * 8)]  # of no photo, a broken fisheye
    for number, (kind, w, h, *values) in enumerate(model.cameras, 7):
        cameras.append(struct.pack(f"<iiQQ{len(values)}d", number, kind, w, h, *values))
    images = []
    columns = zip(model.names, model.poses, model.camera_ids, model.sightings)
    for number, (name, pose, camera, track) in enumerate(columns):
        image = struct.pack("<I7dI", number, *pose, camera) + os.fsencode(name)
        corners = [(1.5, 2.5, key) for key in (2 ** 64 - 1, *track)]  # the first has no point
        corners = [struct.pack("<ddQ", *corner) for corner in corners]
        images.insert(0, image + struct.pack("<xQ", len(corners)) + b"".join(corners))
    points = []
    for k, (x, error, views) in enumerate(zip(model.x, model.errors, model.views)):
        points.append(struct.pack("<Q3d3BdQ", 5 * k, *x, 1, 2, 3, error, views) + bytes(8 * views))
    for name, records in [("cameras", cameras), ("images", images), ("points3D", points)]:
        put(folder / f"{name}.bin", struct.pack("<Q", len(records)) + b"".join(records))


def encoded(image, kind=".png", dtype=np.uint8):
    return cv2.imencode(kind, np.asarray(image, dtype))[1].tobytes()


def write_folder(scene, images="images", sparse="sparse", folder="place"):
    """Photos, split table and COLMAP model. Returns the model's columns, to be changed and written
    again: a row a photo, or a row a point."""
    turn = Rotation.from_matrix(scene["c2w"][:, :, :3]).inv()
    quaternions = 2 * np.roll(turn.as_quat(), 1, axis=1)  # w first; of any length
    t = -turn.apply(world(scene, scene["c2w"][:, :, 3]))
    x = world(scene, scene["points"].astype(float))
    absurd = [[0, 0, 1e300], [0, -1e30, 0], [np.inf, 0, 0], [0, np.nan, 0], [0, 0, 0]]  # they go
    model = SimpleNamespace(
        names=scene["name"].tolist(),
        camera_ids=np.arange(len(t)) + 7,
        cameras=[[1, *wh, *K] for wh, K in zip(scene["wh"], scene["K"])],  # 1 is PINHOLE
        poses=np.column_stack([quaternions, t]),
        sightings=[],
        x=np.concatenate([x, absurd]),
        errors=np.array([.5] * len(x) + [.5, .5, .5, .5, np.inf]),
        views=np.append(np.bincount(scene["track_point"]), [9] * 5))
    table = "split\tfilename\n"
    for i, name in enumerate(model.names):
        track = scene["track_point"][scene["track_photo"] == i]
        model.sightings.append(5 * np.append(track, len(x) + np.arange(5)))
        kind = ".tiff" if name.endswith(".dng") else ".png"
        put(Path(folder, images, name), encoded(photo(scene, i)[..., ::-1], kind))
        table += f"{'test' if scene['is_test'][i] else 'train'}\t{name}\n"
    put(Path(folder, "toy.tsv"), table)
    write_model(model, Path(folder, sparse))
    return model


@pytest.fixture
def model(in_tmp_dir):
    return write_folder(toy())


def made(flags=""):
    """The scene that the command line makes of the folder, and what that prints."""
    with np.errstate(all="raise"):
        code, out, err = run_main(f"place {flags}")
    assert code == 0
    return data_prep.read_scene(data_prep.scene_path("place")), out, err


CORNER = np.full((64, 48), 255)  # a mask twice as large as its photo; the sky is black
CORNER[:16, :16] = 0


@cases(
    "images, sparse, names, on_disk, mask",
    undistorted=("dense/images", "dense/sparse", "{}.jfif", "{}.jfif", "dense/masks/0.png"),
    amid_photos=(".", "sparse", "{}.JPG_large", "{}.JPG_large", "masks/0.JPG_large.png"),
    of_windows=("images", "colmap/sparse/0", "a b\\ü {}", "a b/ü {}", "MASKS/A B/Ü 0.PNG"),
    linked_and_not_utf8=("input", "sparse/0", "\udcff{}.png", "\udcff{}.png", "masks/\udcff0.png"),
    of_a_mac=("images", ".", "é{}.jpg", "e\u0301{}.JPG", "images/masks/é0.jpg"),  # decomposed
    raw_if_posed=("dense/images", "dense/sparse", "{}.dng", "{}.dng", "masks/0.dng.png"))
def test_a_scene_survives_colmap_files(in_tmp_dir, images, sparse, names, on_disk, mask):
    source = toy() | dict(name=np.array([on_disk.format(i) for i in range(8)]))
    put("place/elsewhere/notes.txt", "no photo")
    Path("place/input").symlink_to("elsewhere")
    model = write_folder(source, images, sparse)
    model.names = [names.format(i) for i in range(8)]
    write_model(model, Path("place", sparse))
    copies = "@eaDir/a.jpg .thumbnails/a.jpg dense/a.jpg a.jpg_original a.jpg~ a.THM .a.jpg"
    for name in copies.split():
        put(Path("place", images, name), encoded(BLACK, ".jpg"))
    put(Path("place", images, "raw.dng"), encoded(BLACK, ".tiff"))
    put(Path("place", images, "a photo"), encoded(BLACK, ".jpg"))  # known by its content
    put(Path("place", mask), encoded(CORNER, Path(mask).suffix))
    scene, out, err = made("--downscale 1")
    assert not err
    assert "9 photos on disk, 8 posed" in out
    assert f"radius of {scene['scale']:.3g} units" in out
    assert f"{scene['masked'].mean():.0%} of all pixels, in 1 of 8 photos" in out
    assert photo(scene, 0, "masked")[:8, :8].all()
    assert scene["masked"].sum() == 8 * 8
    assert scene["name"].tolist() == [name.replace("\\", "/") for name in model.names]
    assert_same_arrays(scene, source, "rgb", "is_test", "wh", "track_photo", "track_point")
    assert_arrays_close(scene["K"], source["K"])
    assert_arrays_close(scene["c2w"][..., :3], source["c2w"][..., :3])
    assert_arrays_close(world(scene, scene["c2w"][..., 3]), world(source, source["c2w"][..., 3]))
    assert_arrays_close(world(scene, scene["points"]), world(source, source["points"]), atol=1e-4)


def test_equal_names_go_before_alike_ones():
    match = data_prep.match_names
    assert match(["a.jpg", "A.jpg"], ["a.jpg"]) == {"a.jpg": "a.jpg"}  # two share no file
    assert match(["a.jpg", "A.jpg"], ["A.JPG"]) == {}
    assert match(["a.jpg"], ["A.jpg", "a.JPG"]) == {}


@cases(
    "kind, focal, distortion",
    simple_pinhole=(0, [70], []),
    simple_radial=(2, [70], [.2]),
    radial=(3, [70], [.2, .05]),
    opencv=(4, [70, 72], [.1, 0, .05, -.01]),
    full_opencv=(6, [70, 72], [.1, 0, .01, -.01, 0, 0, 0, .5]))
def test_small_straight_photos_agree_with_their_camera(model, kind, focal, distortion):
    v, u = np.indices((60, 92)) + .5
    put(PHOTO, encoded((u + 2 * v).round()))
    put(MASKS / "toy_000.png", encoded((u > 50) * 255))
    put(IMAGES / "toy_007.png", encoded(np.tile([0, 0, 255], (32, 8))))
    model.cameras[0] = [kind, 92, 60, *focal, 44, 31, *distortion]
    model.sightings[0] = []
    write_model(model)
    scene = data_prep.prepare("place", 3)
    d = data_prep.ray_directions(scene["K"][0], np.eye(3), 30, 20)
    padded = np.append(distortion, np.zeros(8))[:8]
    xy, _ = cv2.projectPoints(d, np.zeros(3), np.zeros(3), np.eye(3), padded)
    uv = xy[:, 0] * focal + (44, 31)
    miss = photo(scene, 0)[..., 0].ravel() - uv @ (1, 2)
    masked = photo(scene, 0, "masked").ravel()
    assert np.abs(miss).max() < 3
    assert abs(miss.mean()) < .3  # half a pixel would be 1.5
    assert masked[uv[:, 0] < 48].all()
    assert not masked[uv[:, 0] > 53].any()
    assert_arrays_close(photo(scene, 7), 85)  # a mean


def saved(image, mode, kind, **options):
    """A file by Pillow, for what OpenCV does not write."""
    file = io.BytesIO()
    Image.fromarray(np.uint8(image)).convert(mode).save(file, kind, **options)
    return file.getvalue()


def test_photos_are_turned_only_if_that_fits(model):
    left_side = Image.Exif()
    left_side[274] = 6  # the tag of photos that lie on it
    options = dict(kind="JPEG", exif=left_side, quality=98, subsampling=0)
    put(PHOTO, saved(np.rot90(photo(toy(), 0)), "RGB", **options))
    put(IMAGES / "toy_001.png", saved(photo(toy(), 1), "CMYK", **options))  # fits as it is stored
    scene = data_prep.prepare("place", 1)
    error = scene["rgb"] - toy()["rgb"].astype(float)
    for pixels in np.split(error, scene["start"][1:3])[:2]:
        assert np.abs(pixels).mean() < 3


def test_narrow_and_wide_photos_are_left_out(model):
    angles = [9.9, 120.1, 5, 10.1, 119.9, 60, 170, 60]  # toy_002 and 006 are held out
    for i, f in enumerate(16 / np.tan(np.radians(angles) / 2)):  # the long side has 32 px
        model.cameras[i][3:] = f, f, 16, 16
    model.sightings = [[]] * 7 + [5 * np.arange(len(model.x))]  # of one photo
    write_model(model)
    assert data_prep.prepare("place")["name"].tolist() == model.names[2:]


def change(column, rows, value):
    """A change of the model's columns, for tables of cases."""
    def apply(model):
        getattr(model, column)[rows] = value
        write_model(model)
    return apply


def move(path, to="elsewhere"):
    return lambda model: path.rename(to)


def new(path, content="x"):
    return lambda model: put(path, content)


@cases(
    "spoil, says",
    no_views=(change("views", ..., 0), "run colmap point_triangulator"),
    no_cameras=(change("camera_ids", ..., 99), "run colmap image_undistorter"),
    unknown_camera=(change("cameras", 0, [77, 0, 0]), "run colmap image_undistorter"),
    name_twice=(change("names", 0, "toy_001.png"), "'toy_001.png', which occurs twice"),
    name_of_root=(change("names", 0, "/toy_000.png"), "outside"),
    name_above=(change("names", 0, "..\\toy_000.png"), "outside"),
    wrong_poses=(change("poses", (slice(6), 4), 99), "6 of 8 photos miss most of their points"),
    small_units=(change("poses", (..., 6), 1e4), "lie on one spot"),  # the cameras are far away
    empty_model=(new(SPARSE / "images.bin", bytes(8)), "place/sparse is an empty model"),
    no_points=(new(SPARSE / "points3D.bin", bytes(8)), "no point of place/sparse has a track"),
    no_points3D=(move(SPARSE / "points3D.bin"), "points3D.bin is missing"),
    no_images=(move(IMAGES), "such as 'toy_000.png': put them into place/images"),
    no_model=(move(SPARSE), "run python data_prep.py place --sfm"),
    bad_photos=(change("poses", [2, 4, 6], 0), "others: ['toy_002.png', 'toy_006.png']\n"),
    one_photo=(new(TABLE, "filename\tsplit\ntoy_000.png\ttrain"), "1 usable training photos"),
    two_tables=(new("place/b.tsv", "filename\tsplit\nx\ttest"), "--split: place/b.tsv, place/toy"),
    half_a_split=(move(TABLE, "place/train.txt"), "place/test.txt is missing"),
    short_row=(new(TABLE, "split\tfilename\ntrain\n"), "filename None has split 'train'"),
    no_name=(new(TABLE, "filename\tsplit\n\ttrain\n"), "toy.tsv: filename '' has split 'train'"),
    other_part=(new(TABLE, "filename\tsplit\nx\tvalid\n"), "filename 'x' has split 'valid'"),
    both_parts=(new(TABLE, "filename\tsplit\nx\ttrain\nx\ttest\n"), "'x' has split 'test'"))
def test_a_bad_folder_is_refused(model, spoil, says):
    spoil(model)
    assert_error(says)


def test_the_folder_around_images_is_named(model, in_tmp_dir):
    assert_error(f"the folder around it has: give {in_tmp_dir}/place", "place/images")


HEIC = b"\0\0\0\x18ftypheic" + bytes(99)
CLEAR = np.full((32, 24, 4), 255)  # a photo whose upper quarter is transparent
CLEAR[:8, :, 3] = 85


def twin(name, other):
    return lambda model: shutil.copy(IMAGES / name, IMAGES / other)


@cases(
    "spoil, says",
    no_pose=(change("poses", 0, 0), "no sound camera or pose"),
    huge_pose=(change("poses", 0, -1e300), "no sound camera or pose"),
    tiny_focal=(change("cameras", 0, [1, 24, 32, 30, 1e-300, 2, 1]), "no sound camera or pose"),
    infinite=(change("cameras", 0, [1, 24, 32, 30, 30, np.inf, 1]), "no sound camera or pose"),
    no_camera=(change("camera_ids", 0, 12345), "no camera in the model"),
    panorama=(change("cameras", 0, [1, 33000, 9, 99, 99, 9, 9]), "is 33000 x 9 pixels, too large"),
    wrong_pose=(change("poses", (0, 4), 99), "shows 0% of its points"),
    empty=(new(PHOTO, b""), "is empty, damaged, too large or of an unknown type"),
    heic=(new(PHOTO, HEIC), "is HEIC, which cannot be read"),
    cut_png=(new(PHOTO, encoded(BLACK)[:-20]), "is cut off"),
    turned=(new(PHOTO, encoded(BLACK.T)), "has 32 x 24 pixels, its camera 24 x 32"),
    nearly_black=(new(MASKS / "toy_000.png", encoded(BLACK + 1)), "is black or transparent all"),
    grey_tiff=(new(PHOTO, saved(CLEAR, "LA", "TIFF")), "is a grey TIFF with alpha, which"),
    other_folder=(new("place/mask/toy_000.png", encoded(BLACK)), "place/mask is not used"),
    other_names=(new(MASKS / "mask_0.png", encoded(BLACK)), "unlike mask_0.png"),
    turned_mask=(new(MASKS / "toy_000.png", encoded(BLACK.T + 255)), "32 x 24 pixels, its photo"),
    twin=(twin("toy_000.png", "toy_007.png"), "left out: toy_007.png is the same photo as toy_000"),
    of_held_out=(twin("toy_003.png", "toy_006.png"), "toy_003.png is the same photo as toy_006"),
    both_held_out=(twin("toy_002.png", "toy_006.png"), ""))
def test_what_cannot_be_used_is_named(model, spoil, says):
    spoil(model)
    scene, out, err = made()
    assert err.count("\n") == bool(says)
    assert says in err
    used = 7 if err.startswith("left out: ") else 8
    assert f"{used} photos, 2 of them for testing" in out
    assert "masked" not in scene


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_ends_with_its_first_end_mark(progressive):
    image = np.random.default_rng(0).integers(0, 255, (40, 50, 3))
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive, cv2.IMWRITE_JPEG_RST_INTERVAL, 2]
    jpeg = cv2.imencode(".jpg", np.uint8(image), options)[1].tobytes()
    thumbnail = struct.pack(">HH", 0xffe1, len(jpeg) + 2) + jpeg
    whole = jpeg[:2] + thumbnail + jpeg[2:]
    for rest in (b"", b"\0" * 9, jpeg[:99], b"ftypmp42\xff\xda\0\5raw"):
        assert not data_prep.is_cut_off(whole + rest)
    assert all(data_prep.is_cut_off(whole[:size]) for size in range(2, len(whole)))


def test_the_largest_model_is_taken_and_leftovers_told(model, monkeypatch):
    lost = Path("place/lost+found")
    lost.mkdir()
    Path(IMAGES, "toy_001.png").rename(IMAGES / "more.JPG")
    Path(IMAGES, "toy_001.png").symlink_to("nowhere")
    Path(IMAGES, "toy_003.png").rename(IMAGES / "toy_003.jpeg")
    model.camera_ids[:] = 99  # a fisheye
    write_model(model, Path("place/fisheye"))
    model.names = model.names[:4]
    write_model(model, Path("place/part"))
    for function in (Path.iterdir, Path.read_bytes):
        def refuse(self, function=function):
            if self in (lost, PHOTO):
                raise PermissionError(13, "Permission denied", str(self))
            return function(self)
        monkeypatch.setattr(Path, function.__name__, refuse)
    scene, out, err = made()
    assert len(scene["name"]) == 5
    assert "9 photos on disk, 7 posed by place/sparse\n" in out
    assert re.findall("left out is another model: (.*)", out) == ["4 posed by place/part"]
    assert err.splitlines() == [
        "passed over: the folder place/lost+found may not be read",
        "1 photos of place/sparse are not on disk, such as 'toy_003.png'; there is 'toy_003.jpeg'",
        "left out: toy_000.png cannot be read: Permission denied",
        "left out: toy_001.png is a broken link: copy the photo itself",
        "left out: toy_003.png is not on disk; there is 'toy_003.jpeg'"]


@pytest.mark.parametrize("ahead, is_room", [(.5, True), (-.5, False), (1.5, False)])
def test_cameras_that_look_out_of_the_sphere_are_told(ahead, is_room, capsys):
    c2w = toy()["c2w"].copy()
    c2w[:, :, 3] = ahead * c2w[:, :, 2]  # so far from the centre, in the direction of the view
    data_prep.check_sphere(toy() | dict(c2w=c2w))
    assert ("8 of 8 cameras look outwards" in capsys.readouterr().err) == is_room


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_damaged_model_is_refused_in_little_memory(model, name):
    model.names = ["a", "b"]
    model.cameras = model.cameras[:2]
    model.x = model.x[:3]
    model.views[:3] = 2
    model.sightings = [[0], [0]]
    write_model(model)
    path = SPARSE / name
    good = path.read_bytes()

    def read(data):
        path.write_bytes(data)
        return data_prep.read_photos(SPARSE), data_prep.read_points(SPARSE)
    assert attempt(read, good)
    for size in range(0, len(good), 3):
        assert attempt(read, good[:size]) is None
    for at in range(len(good) - 7):
        for number in (2 ** 40, 2 ** 64 - 1):  # also as a count
            with in_little_memory():
                attempt(read, good[:at] + struct.pack("<Q", number) + good[at + 8:])


# ---- split tables --------------------------------------------------------------------------------
ROWS = """filename\tid\tsplit
TOY_000.png\t1\ttrain
toy_003.png\t2\ttrain
toy_005.png\t3\ttest
toy_004.png\t\ttrain
my/toy_007.png\t4\ttrain
a ghost\t5\ttrain
"""
OF_WINDOWS = "\ufeff" + ROWS.replace("\n", "\r\n\r\n").replace("\t", ";")
LISTS = {
    "train_list.txt": "\ufeffTOY_000.png\r\ntoy_003.png\r\n\r\nmy/toy_007.png\r\na ghost",
    "test_list.txt": "toy_005.png"}


@cases(
    "files, flags, first",
    nameless_column=({"s.tsv": "\t" + ROWS.replace("\n", "\n\t")}, "", "s.tsv"),
    commas=({"nerfw_split.csv": ROWS.replace("\t", ",")}, "", "nerfw_split.csv"),
    of_windows=({"s.csv": OF_WINDOWS}, "", "s.csv"),
    quoted=({"s.csv": re.sub(r"([^\t\n]+)", r'"\1"', ROWS).replace("\t", ",")}, "", "s.csv"),
    named_elsewhere=({"s.tsv": "split\nx", "../mine.tsv": ROWS}, "--split mine.tsv", "mine.tsv"),
    lists=(LISTS, "", "train_list.txt"),
    named_list=(LISTS, "--split place/test_list.txt", "train_list.txt"))
def test_a_split_is_found_read_and_remembered(model, files, flags, first):
    TABLE.unlink()
    put("place/other.csv", "a,b\n1,2\n")
    put("place/._s.tsv", "filename\tsplit\nx\ttest\n")  # as a Mac leaves on other disks
    for path, text in files.items():
        put(Path("place", path), text)
    scene, out, err = made(flags)
    assert re.search(f"split by .*{first}\n", out)
    assert scene["name"].tolist() == ["toy_000.png", "toy_003.png", "toy_005.png"]
    assert scene["is_test"].tolist() == [False, False, True]
    assert "5 photos are not in" in err
    assert "left out: my/toy_007.png has no pose; there is 'toy_007.png'\n" in err
    assert "left out: a ghost has no pose\n" in err
    put("place/images/toy_001.png", "another photo")
    assert_same_arrays(data_prep.open_scene("place"), scene, "name", "is_test")


# ---- freshness -----------------------------------------------------------------------------------
@cases(
    "happens, is_made",
    other_time=(lambda model: os.utime(PHOTO, (1000, 1000)), False),
    notes=(new("place/notes.txt"), False),
    table_without_split=(new("place/notes.csv"), False),
    photo_without_pose=(new(IMAGES / "without_pose.png"), False),
    unused_masks=(new("place/unmasked_old/toy_000.png"), False),
    sources_gone=(move(Path("place")), False),
    other_size=(lambda model: data_prep.open_scene("place", 4), True),
    other_photo=(new(PHOTO, encoded(BLACK)), True),
    other_camera=(change("cameras", 0, [1, 24, 32, 40, 40, 12, 16]), True),
    other_pose=(change("poses", (0, 4), 99), True),
    other_point=(change("x", 0, 9), True),
    other_split=(move(TABLE, Path("place/other.csv")), True),
    other_mask=(new(MASKS / "toy_000.png", encoded(BLACK + 255)), True),
    mask_of_other_photo=(move(MASKS / "toy_000.png", MASKS / "toy_001.png"), True),
    photo_renamed=(move(PHOTO, IMAGES / "other.png"), True),
    second_model=(lambda model: write_model(model, Path("place/more")), True))
def test_a_scene_follows_its_sources_content(model, happens, is_made, capsys):
    put(MASKS / "toy_000.png", encoded(BLACK))
    data_prep.open_scene("place")
    happens(model)
    capsys.readouterr()
    data_prep.open_scene("place")
    assert ("making" in capsys.readouterr().out) == is_made
    data_prep.open_scene("place")
    assert not capsys.readouterr().out


def test_every_folder_has_its_own_file(in_tmp_dir):
    names = ["toy", "sacre", "one/photos", "two/photos", "./toy", in_tmp_dir / "sacre"]
    assert len({data_prep.scene_path(name) for name in names}) == 6
    assert data_prep.scene_path("a/../b") == data_prep.scene_path("b")
    assert len(os.fsencode(data_prep.scene_path("é" * 127).name)) < 256


@pytest.mark.parametrize("home", ["data/sacre", "data/sacre_coeur"])
def test_scenes_known_by_name_lie_in_data(in_tmp_dir, home):
    assert_error("python data_prep.py sacre --download", "sacre")
    write_folder(toy(), folder=home)
    assert len(data_prep.open_scene("sacre")["wh"]) == 8
    assert Path("data/sacre.npz").exists()


# ---- masks ---------------------------------------------------------------------------------------
BLACK_LEFT = np.repeat([[0, 255]], 24, 1)[[0] * 64]  # twice as large as the photo (64,48)


@cases(
    "file, share",
    png_of_16_bits=(encoded(CLEAR * 257, dtype=np.uint16), 1 / 4),
    tiff=(encoded(CLEAR, ".tiff"), 1 / 4),
    webp=(encoded(CLEAR, ".webp"), 1 / 4),
    grey=(saved(CLEAR, "LA", "PNG"), 1 / 4),
    opaque=(encoded(CLEAR | 255), 0))
def test_an_alpha_channel_is_a_mask(model, file, share):
    put(PHOTO, file)
    TABLE.unlink()
    scene, out, err = made("--downscale 1")
    assert "every eighth photo" in out
    assert scene["is_test"].tolist() == [False] * 7 + [True]
    assert scene.get("masked", np.zeros(1)).sum() == share * 32 * 24
    put("masks/toy_000.png", encoded(BLACK))  # too far away
    put(MASKS / "toy_000.png", encoded(BLACK_LEFT))  # both count
    masked = photo(made("--downscale 1")[0], 0, "masked")
    assert np.array_equal(masked, masked[-1] | masked[:, -1:])
    assert masked.mean() == (share + 1) / 2


# ---- the toy -------------------------------------------------------------------------------------
def scene_sdf(scene, x, **knobs):
    """Signed distance of the toy at x (P,3), both in scene units -> (P,)"""
    return data_prep.toy_sdf(world(scene, x), **knobs) / scene["scale"]


@pytest.mark.parametrize("number", [-1, 1, 3, 10])
def test_every_landmark_is_another_whole_building(number):
    parts = data_prep.toy_parts(number, background=False)
    shift = [lengths(np.subtract(a.center, b.center)) for a, b in zip(parts, data_prep.LANDMARK)]
    assert max(shift) > .1
    assert [part.material for part in parts] != [part.material for part in data_prep.LANDMARK]
    for part in parts:  # none hangs in the air
        foot = np.array([part.center]) - [0, 0, part.half[2]]
        others = [other for other in parts + data_prep.TOWN if other is not part]
        assert min(data_prep.part_sdf(other, foot)[0] for other in others) < .02


@cases(
    "shape, top, x, distance",
    ground=("ground", 3, (1, 2, .5), .5),
    corner=("box", 3, (5, 5, 7), 7),
    inside=("box", 3, (1, 0, .5), -.5),
    # 3-4-5 triangles: the slanted side falls 1.5 over 2.
    roof=("box", 1.5, (6.25, 0, 3), 5),
    cone=("column", 1.5, (0, 6.25, 3), 5),
    upper_edge=("column", 3, (4.2, 5.6, 4), 5),
    ball=("ball", 3, (3, 4, 12), 10))
def test_distances_to_parts_equal_closed_forms(shape, top, x, distance):
    center = np.array([10, 20, 30])
    part = data_prep.Part(shape, "hall", "gold", center, half=(3, 2, 1), top=top)
    assert_arrays_close(data_prep.part_sdf(part, np.array([center + x])), distance)


@cases(
    "i, knobs",
    town=(4, {}),
    alone=(3, dict(background=False)),
    other=(2, dict(landmark=4)),
    facade=(1, dict(landmark=-1)))
def test_a_toy_agrees_with_its_distance_function(i, knobs):
    scene = toy(**knobs)
    c2w = scene["c2w"][i]
    d = data_prep.ray_directions(scene["K"][i], c2w, *scene["wh"][i])[::3]
    t = np.zeros(len(d))
    for _ in range(300):  # sphere tracing
        x = c2w[:, 3] + t[:, None] * d
        t += scene_sdf(scene, x, **knobs)
    depth = photo(scene, i, "depth").ravel()[::3]
    assert_arrays_close(np.minimum(t, 6), np.minimum(depth, 6), atol=.01)
    before = scene["wall"] + .004 * scene["wall_normal"]
    assert_arrays_close(np.median(scene_sdf(scene, before, **knobs)), .004, atol=1e-4)
    assert_arrays_close(scene_sdf(scene, scene["near_wall"], **knobs), scene["near_wall_sdf"])
    assert np.abs(scene["near_wall_sdf"]).max() < .05
    x = np.random.default_rng(0).uniform(-1.5, 1.5, (60_000, 3))
    is_landmark = scene_sdf(scene, x, **knobs | dict(background=False)) < 0
    assert .75 < lengths(x[is_landmark]).max() < 1  # it fills the unit sphere
    assert np.median(scene["c2w"][:, 1, 3]) < -1  # tourists stand before the front, towards -y


def test_rays_end_on_the_part_they_hit():
    parts = data_prep.toy_parts(0)
    o = np.array([[0, -4.0, 1]])
    d = np.random.default_rng(0).uniform(-1, 1, (999, 3))
    t, which = data_prep.trace(o, d, parts)
    x = o + np.minimum(t, 20)[:, None] * d
    distance = [data_prep.part_sdf(parts[i], x[n:n + 1])[0] for n, i in enumerate(which)]
    assert len(np.unique(which)) > 9
    assert_arrays_close(np.array(distance)[t < 20], 0)


def test_the_ground_behind_a_tower_is_darker():
    o = np.array([[1.6, 1.1, 5], [.1, -.75, 5]])  # above the ground behind and before it
    d = np.array([[1e-6, 1e-6, -1]] * 2)
    colors = data_prep.shade(o, d, data_prep.toy_parts(0), True, data_prep.SUN, np.zeros(4))
    behind, before = colors.mean(1)
    assert behind < .6 * before


@cases(
    "knob, key, changes_sky",
    sun=(dict(sun=90.0), "rgb", False),
    sky=(dict(sky=1.0), "rgb", True),
    exposure=(dict(exposure=2.0), "rgb", True),
    pose_noise=(dict(pose_noise=3.0), "c2w", False))
def test_a_knob_changes_nothing_else(knob, key, changes_sky):
    usual = toy()
    other = toy(**knob)
    keys = ["rgb", "c2w", "points", "track_point", "depth", "occluder", "center"]
    assert [name for name in keys if not np.array_equal(usual[name], other[name])] == [key]
    changed = np.abs(usual["rgb"].astype(float) - other["rgb"]).max(1) > 20
    is_sky = np.isinf(usual["depth"])
    assert (changed.mean() > .05) == (key == "rgb")
    assert (changed[is_sky].mean() > .1 * changed.mean()) == changes_sky
    is_moved = (other["c2w"] != usual["c2w"]).any((1, 2))
    assert np.array_equal(is_moved, ~usual["is_test"] & (key == "c2w"))
    assert other["c2w"][:, 2, 1].max() < -.5  # all stand upright: y is down


def test_photos_differ_in_exposure_by_the_knob():
    plain, usual, extreme = [toy(exposure=knob)["exposure_spread"] for knob in (0.0, 1.0, 2.0)]
    assert plain < .5 * usual
    assert usual < .6 * extreme


def test_people_cover_their_share_of_training_photos():
    plain = toy(occluders=0.0, photos=12)["rgb"].astype(float)
    other = toy(occluders=.3, photos=12)
    people = other["occluder"]
    assert np.array_equal(plain[~people], other["rgb"][~people])
    assert (other["rgb"] > plain + 50)[people].mean() > .05  # in colours
    shares = np.array([photo(other, i, "occluder").mean() for i in range(14)])
    training = shares[~other["is_test"]]
    assert .21 < training.mean() < .48  # asked for: .3
    assert training.max() > 2 * training.min()
    assert not shares[other["is_test"]].any()


def test_points_lie_on_surfaces_in_plain_view():
    scene = toy(occluders=.3, photos=12)
    miss = np.abs(scene_sdf(scene, scene["points"].astype(float)))
    assert len(miss) > 1000
    assert .001 < np.median(miss) < .006  # noise
    assert .0005 < (miss > .03).mean() < .05  # outliers
    assert np.bincount(scene["track_point"]).min() >= 2
    seen_by = scene["track_photo"]
    x = scene["points"][scene["track_point"]]
    distance = lengths(x - scene["c2w"][seen_by, :, 3])
    wh = scene["wh"][seen_by]
    u, v = np.clip(scene["track_uv"] * wh, 0, wh - 1).astype(int).T
    pixel = scene["start"][seen_by] + v * wh[:, 0] + u
    is_behind = scene["depth"][pixel] < .8 * distance
    assert (is_behind | scene["occluder"][pixel]).mean() < .12


def test_pose_noise_is_in_pixels_rms():
    rng = np.random.default_rng(0)
    K = np.array([50, 50, 16, 16])
    uv = np.zeros((500, 2))
    for i in range(500):
        c2w = np.eye(3, 4)
        c2w[2, 3] = -4  # looks at the landmark
        data_prep.add_pose_noise(rng, K, c2w, 2.0)
        uv[i], _ = data_prep.project(K, c2w, np.zeros((1, 3)))
    assert abs(((uv - 16) ** 2).sum(1).mean() - 4) < .4


# ---- downloads -----------------------------------------------------------------------------------
TAR = "brandenburg_gate.tar.gz"
GOOD = {
    "dense/images/a.jpg": np.random.default_rng(0).bytes(50_000),
    "dense/sparse/cameras.bin": b"x"}
OTHER = {"dense/stereo/big.bin": b"y", "other.txt": b"z"}
LINK = {"dense/images/link": b"", "dense/images/link/evil.txt": b"x"}
HOME = Path("data/brandenburg")


def archive(files):
    """A .tar.gz of files, bytes by name; an empty one is a link out of the folder."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as tar:
        for name, content in files.items():
            entry = tarfile.TarInfo("brandenburg_gate/" + name)
            entry.size = len(content)
            if not content:
                entry.type = tarfile.SYMTYPE
                entry.linkname = "../../../.."
            tar.addfile(entry, io.BytesIO(content))
    return out.getvalue()


WHOLE = archive(GOOD | OTHER)


@pytest.fixture
def server(in_tmp_dir, monkeypatch):
    """A server of files, with ranges or of status 200; breaks off after `limit` bytes."""
    server = SimpleNamespace(status=206, limit=None, asked=[])
    server.files = {TAR: WHOLE, "brandenburg.tsv": b"table"}

    def urlopen(request, timeout):
        name = Path(request.selector).name
        start = int(request.headers["Range"][6:-1]) if server.status == 206 else 0
        rest = server.files[name][start:]
        server.asked.append((name, start))
        if not rest:
            raise HTTPError(name, 416, "no such bytes", {}, None)
        headers = {"Content-Length": len(rest)}
        read = io.BytesIO(rest[:server.limit]).read
        answer = SimpleNamespace(status=server.status, headers=headers, read=read)
        return contextlib.nullcontext(answer)
    monkeypatch.setattr(data_prep, "urlopen", urlopen)
    return server


@cases(
    "part, status, limit, starts",
    breaks_off=(b"", 206, 20_000, [0, 19_999]),
    breaks_off_without_ranges=(b"", 200, 20_000, [0, 0]),
    part_is_too_long=(b"?" * 200_000, 206, None, [199_999, 0]),
    part_is_whole=(WHOLE, 206, None, [len(WHOLE) - 1]))
def test_a_broken_download_goes_on(server, part, status, limit, starts):
    put(f"data/{TAR}.part", part)
    server.status = status
    server.limit = limit
    for _ in starts[1:]:
        assert "same command" in run_main("brandenburg --download")[2]
        assert not HOME.exists()
    server.limit = None
    data_prep.download("brandenburg")
    found = {str(path.relative_to(HOME)): path.read_bytes() for path in HOME.rglob("*.*")}
    assert found == GOOD | {"brandenburg.tsv": b"table"}
    assert sorted(os.listdir("data")) == ["brandenburg", "brandenburg.tsv", TAR]
    assert "there already" in run_main("brandenburg --download")[2]
    assert server.asked == [("brandenburg.tsv", 0), *[(TAR, start) for start in starts]]


@cases(
    "data, is_refused",
    dots=(archive(GOOD | {"dense/images/../../../../evil.txt": b"x"}), True),
    link=(archive(GOOD | LINK), False),
    cut_off=(WHOLE[:30_000], True),
    wrong_checksum=(WHOLE[:-8] + b"wrong checksum", True),
    of_something_else=(archive(OTHER), True))
def test_bad_archives_leave_nothing_outside(server, in_tmp_dir, data, is_refused):
    server.files[TAR] = data
    assert (TAR in run_main("brandenburg --download")[2]) == is_refused
    assert HOME.exists() != is_refused
    assert {*os.listdir("data")} - {HOME.name} == {"brandenburg.tsv", TAR}
    assert not any(path.is_symlink() for path in in_tmp_dir.rglob("*"))
    assert os.listdir(in_tmp_dir) == ["data"]


# ---- SfM -----------------------------------------------------------------------------------------
@pytest.fixture
def pycolmap(model, monkeypatch):
    """A stand-in that notes its calls and writes a model of the raw photos."""
    shutil.rmtree(SPARSE)
    fake = mock.MagicMock()
    fake.incremental_mapping.side_effect = lambda *args: [write_model(model, args[2] / "0")]
    monkeypatch.setitem(sys.modules, "pycolmap", fake)
    return fake


def test_a_second_sfm_takes_up_the_first(pycolmap):
    put(MASKS / "toy_000.png", encoded(BLACK_LEFT))
    put(MASKS / "toy_001.png", "no image")
    put(IMAGES / "toy_003.png", encoded(CLEAR))
    Path(IMAGES, "lost.png").symlink_to("nowhere")
    no_place = OSError(30, "Read-only file system")
    with mock.patch.object(data_prep.tempfile, "TemporaryDirectory", side_effect=no_place):
        assert_error("Read-only file system", "place --sfm")
    pycolmap.extract_features.assert_not_called()  # which may take hours
    works = pycolmap.incremental_mapping.side_effect
    pycolmap.incremental_mapping.side_effect = OSError(28, "No space left")
    assert_error("No space left", "place --sfm")
    assert sorted(os.listdir("place")) == ["images", "masks", "toy.tsv"]
    paths = sorted(Path("data").rglob("masks/*"))
    assert [path.name[:-4] for path in paths] == toy()["name"].tolist()  # COLMAP's names
    mask, bad, none, transparent, *_ = [cv2.imread(str(path), 0) for path in paths]
    assert np.array_equal(mask, BLACK_LEFT[::2, ::2])
    assert (transparent == 0).mean() == 1 / 4 and bad.all() and none.all()
    pycolmap.incremental_mapping.side_effect = works
    scene, out, err = made("--sfm")
    assert "8 posed by place/sparse/0" in out
    assert sorted(os.listdir("place")) == ["images", "masks", "sparse", "toy.tsv"]
    assert len(os.listdir("data")) == 1
    calls = [call for call in pycolmap.mock_calls if call.args]
    extract, match, map_photos = calls[3:]
    assert calls[:2] == [extract, match]
    database = match.args[0]
    assert database.parts[0] == "data"  # not among photos
    assert extract.args == (database, IMAGES, toy()["name"].tolist())
    assert map_photos.args[:2] == (database, IMAGES)
    assert extract.kwargs["reader_options"].mask_path == paths[0].parent
    features = extract.kwargs["extraction_options"].sift
    assert features.estimate_affine_shape is features.domain_size_pooling is True
    assert match.kwargs["matching_options"].guided_matching is True


def use(pycolmap):
    return lambda model: sys.modules.update(pycolmap=pycolmap)


DAMAGED = mock.Mock(**{"extract_features.side_effect": RuntimeError("no table")})


@cases(
    "spoil, says",
    has_model=(new(SPARSE / "0/images.bin"), "place has sparse/ or dense/, a model: leave --sfm"),
    no_photos=(move(IMAGES), "place has no photos"),
    damaged=(use(DAMAGED), "(no table): delete data/sfm"),
    heic=(new(IMAGES / "phone.jpg", HEIC), "phone.jpg is HEIC: convert all such photos"),
    no_utf8=(move(PHOTO, IMAGES / "\udcff.png"), "is not UTF-8: rename the photo"),
    no_pycolmap=(use(None), 'run pip install "pycolmap>=3.13"'),
    old_pycolmap=(use(SimpleNamespace()), "no attribute 'ImageReaderOptions'): run pip install"),
    no_match=(lambda model: None, "do not match: take more"))
def test_sfm_tells_what_is_wrong(pycolmap, model, spoil, says):
    pycolmap.incremental_mapping.side_effect = lambda *_: {}
    spoil(model)
    assert_error(says, "place --sfm")
    assert "mask_path" not in vars(pycolmap.ImageReaderOptions())  # no photo has a mask


# ---- command line --------------------------------------------------------------------------------
def test_a_toy_is_made_once_or_by_its_knobs(in_tmp_dir):
    with mock.patch.object(data_prep, "make_toy", toy):
        assert_same_arrays(data_prep.open_scene("toy"), toy())
    code, out, err = run_main(
        "toy --size 32 --photos 6 --test 2 --no-background --occluders .2 --seed 1")
    assert code == 0
    assert "data/toy.npz: 8 photos, 2 of them" in out
    scene = data_prep.open_scene("toy", 3)
    assert_same_arrays(scene, toy(occluders=.2, background=False, seed=1))
    assert (scene["K"] != toy()["K"]).any()  # of another seed


WRONG = """
toy --sizee 9, toy --siz 32, toy --size x, toy --size 15, toy --photos 3,
toy --test -1, toy --seed -1, toy --landmark -2, toy --occluders .61,
toy --exposure -1, toy --exposure 2.1, toy --pose_noise -1, toy --pose_noise nan,
toy --pose_noise inf, toy --sun -1, toy --sun 181, toy --sky -1, toy --sky 1.1,
toy --downscale 4, toy --split x.tsv, place --split x.tsv, place --downscale 0,
place --downscale 16, place --size 9, brandenburg, nowhere, x --download
"""


@pytest.mark.parametrize("command", ["", *map(str.strip, WRONG.split(","))])
def test_misspelt_commands_exit_with_2(model, command):
    assert_error("error: ", command)


OPENCV_FULL = cv2.error("(-4:Insufficient memory) Failed to allocate 9 bytes")


@cases(
    "module, function, happens, says",
    ctrl_c=(data_prep, "prepare", KeyboardInterrupt, "stopped"),
    sigterm=(data_prep, "prepare", lambda _: signal.raise_signal(signal.SIGTERM), "stopped"),
    full_disk=(data_prep, "prepare", OSError(28, "No space left"), "No space left"),
    full_memory=(np, "concatenate", MemoryError(), "the memory is full"),
    full_at_a_photo=(cv2, "imdecode", OPENCV_FULL, "the memory is full"),  # it is not damaged
    full_at_its_size=(cv2, "resize", OPENCV_FULL, "the memory is full"))
def test_a_stop_is_one_sentence(model, monkeypatch, module, function, happens, says):
    monkeypatch.setattr(module, function, mock.Mock(side_effect=happens))
    assert_error(says)


# ---- models and rays for tests -------------------------------------------------------------------
def tiny(**changes):
    return geonvs.Config(**TINY | changes)


def make_model(scene, **changes):
    torch.manual_seed(0)
    return geonvs.GeoNVS(tiny(**changes), scene)


@pytest.fixture(scope="session")
def warm_start(scene):
    return make_model(scene)


@pytest.fixture
def warm(warm_start):
    """A model whose SDF is a small sphere; every test has its own."""
    return copy.deepcopy(warm_start)


def fake_rays(o, d):
    """Rays of no photo from o (R,3) along d (R,3)."""
    near = torch.full((len(o), 1), 0.1)
    others = [None] * (len(geonvs.Rays._fields) - 3)
    return geonvs.Rays(o, F.normalize(d), near, *others)


def gradients(model, value):
    """Gradients of a value by the model's parameters, with their names."""
    names, parameters = zip(*model.named_parameters())
    grads = torch.autograd.grad(value, parameters, retain_graph=True, materialize_grads=True)
    return dict(zip(names, grads))


# ---- 1 settings ----------------------------------------------------------------------------------
LEAST = dict(steps=1, downscale=1, rays=2, photos=1, samples=3, bg_samples=2, hidden=1, lam_gpl=0)


@pytest.mark.parametrize("name, value", [
    ("scene", "tower"), ("device", "tpu"), ("levels", 9), ("mask", "maybe"),
    ("paper", "alpha,beta"), ("paper", "alpha reg"), ("steps", 2**31), ("lam_gpl", math.nan),
    *[(name, least - 1) for name, least in LEAST.items()]])
def test_a_wrong_setting_is_refused(name, value):
    geonvs.Config(**LEAST)
    with pytest.raises(UserError, match=f"--{name} {value} is (unknown|out of range): use "):
        geonvs.Config(**{name: value})


@cases(
    "given, gpus, source, base",
    toy=({}, 1, "toy", {}),
    folder=(dict(data="toy"), 1, os.path.realpath("toy"), geonvs.GPU_DEFAULTS),
    flag=(dict(scene="taj", steps=9), 1, "taj", geonvs.GPU_DEFAULTS),
    cpu=(dict(scene="taj"), 0, "taj", {}))
def test_photos_on_a_gpu_have_other_defaults(monkeypatch, given, gpus, source, base):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    cfg = geonvs.make_config(given)
    assert cfg == geonvs.Config(**base | given)
    assert cfg.source == source


# ---- 2 scene file and rays -----------------------------------------------------------------------
@pytest.fixture(scope="module")
def odd():
    """A scene with a portrait photo, fx != fy and principal points off centre."""
    raw = copy.deepcopy(toy())
    raw["K"] *= [1, 1.3, 0.9, 1.2]
    raw["wh"][1] = raw["wh"][1][::-1]
    return geonvs.load_scene(raw)


def test_a_ray_projects_back_to_its_pixel(odd):
    w, h = odd.wh[1].tolist()
    rays = geonvs.photo_rays(odd, 1)
    t = random(w * h, 1, low=0.5, high=9)
    x = rays.at(t)[:, 0].numpy()
    found, distance = data_prep.project(odd.raw["K"][1], odd.raw["c2w"][1], x)
    pixels = torch.cartesian_prod(torch.arange(h), torch.arange(w)).flip(1) + 0.5  # centres
    sfm = torch.from_numpy(odd.raw["track_uv"][odd.raw["track_photo"] == 1])  # (T,2)
    has_sfm = (32 * rays.uv[:, None]).floor() == (32 * sfm).floor()  # (wh,T,2)
    assert_arrays_close(found, pixels, 1e-3)
    assert_arrays_close(distance, t[:, 0])
    assert_tensors_close(rays.uv * odd.wh[1], pixels)
    assert_tensors_close(rays.rgb * 255, odd.rgb[odd.start[1]:odd.start[2]], 1e-4)
    assert torch.equal(rays.has_sfm, has_sfm.all(2).any(1))


@pytest.mark.parametrize("part", [1.0, 0.5])
def test_random_rays_cover_the_left_part_alone(odd, part):
    w, h = odd.wh[1].tolist()
    img = torch.ones(30 * w * h).long()
    rays = geonvs.random_rays(odd, img, generator(), part)
    found = (rays.uv * odd.wh[1]).floor()
    wanted = torch.cartesian_prod(torch.arange(int(part * w)), torch.arange(h))
    assert_tensors_close(found.unique(dim=0), wanted)


@pytest.mark.parametrize("long_side, side", [(100, 64), (300, 150), (600, 256)])
def test_thumbnails_are_whole_photos_of_half_the_size(long_side, side):
    rgb = np.zeros((8, 4, long_side, 3), np.uint8)
    rgb[:, :2, long_side // 2:, 0] = 255  # red in the upper right
    wh = np.tile([long_side, 4], (8, 1))
    raw = toy() | dict(wh=wh, start=4 * long_side * np.arange(9), rgb=rgb.reshape(-1, 3))
    thumbs = geonvs.load_scene(raw).thumbs
    assert thumbs.shape == (8, 3, side, side)
    quarters = F.adaptive_avg_pool2d(thumbs[7].float(), 2) / 255
    assert_tensors_close(quarters, [[[0, 1], [0, 0]], [[0, 0]] * 2, [[0, 0]] * 2], 0.02)


def test_rays_are_in_the_sphere_within_their_interval(double):
    rays = fake_rays(random(500, 3, low=-2, high=2), random(500, 3, low=-1))
    t = random(500, 200, low=0.1, high=5)
    t0, t1 = geonvs.sphere_interval(*rays[:3])
    is_empty = t0 == t1
    closest = (-rays.o * rays.d).sum(1, keepdim=True).clamp(min=0.1)
    assert torch.equal((t > t0) & (t < t1), rays.at(t).norm(dim=2) < 1)
    assert_tensors_close(t0[is_empty], closest[is_empty])
    assert (t0 <= t1).all()


def test_air_lies_between_training_cameras_and_points_that_they_saw(scene):
    place = torch.eye(4)[:3].repeat(3, 1, 1)
    place[:, 2, 3] = torch.tensor([-3.0, 0.2, -3.0])  # before the sphere, in it, before it
    found = geonvs.air_segments(scene._replace(
        c2w=place,
        near=torch.tensor([0.1, 0.3, 0.1]),
        points=torch.tensor([[0, 0, 0.6], [0, 0, 2.0], [0, 0, -2.0], [0, 3.0, 0]]),
        train=torch.tensor([0, 1]),
        raw=dict(
            track_photo=np.array([0, 0, 0, 0, 1, 1, 2]),
            track_point=np.array([0, 1, 2, 3, 0, 1, 0]))))
    # The first camera sees a point in the sphere, one behind it, one before it, one beside it; the
    # second camera sees two, from near on.
    assert (found[..., :2] == 0).all()
    assert_tensors_close(found[..., 2], [(-1, 0.55), (-1, 1), (0.5, 0.55), (0.5, 1)])


# ---- 3 octree ------------------------------------------------------------------------------------
def make_tree():
    """An octree with a random part of each level's cells split and random features."""
    octree = geonvs.Octree(1.5, 4, channels=2, root=3)
    for level in range(3):
        cells = octree.cells[octree.cells[:, 0] == level]
        octree.split(cells[random(len(cells)) < 0.4])
    nn.init.uniform_(octree.features, -1, 1)
    return octree


OCTANTS = F.pad(torch.ones(2, 2, 2).nonzero(), (1, 0))  # (8,4): level 0, then i, j, k


def plain_octree(octree):
    """The octree's function by loops over levels and corners, for one point at a time."""
    cells = set(map(tuple, octree.cells.tolist()))
    features = dict(zip(octree.corner_key.tolist(), octree.features))

    def lookup(x):
        """Features (LC,) at x (3,)."""
        out = torch.zeros(octree.levels, octree.features.shape[1])
        x = (x / octree.half).clamp(-1, 1 - 2e-6)
        for level in range(octree.levels):
            at = (x + 1) / 2 * octree.root * 2**level
            cell = F.pad(at.long(), (1, 0), value=level)
            if tuple(cell.tolist()) not in cells:
                break
            for corner in cell + OCTANTS:
                if cells.issuperset(map(tuple, (corner - OCTANTS).tolist())):
                    weight = 1 - (at - corner[1:]).abs()  # (3,)
                    feature = features[geonvs.pack_index(corner).item()]
                    out[level] += weight.prod() * feature
        return out.flatten()
    return lookup


def assert_one_function(model, found, wanted, trains_mask=False):
    """Two values are alike, and so are their gradients, which reach every parameter of the model,
    those of the mask only if it is trained."""
    assert_tensors_close(found, wanted, 1e-7)
    factor = random(*found.shape)
    wanted = gradients(model, (factor * wanted).sum())
    for name, grad in gradients(model, (factor * found).sum()).items():
        assert_tensors_close(grad, wanted[name], 1e-7)
        assert grad.any() == (trains_mask or not name.startswith("mask")), name


def test_a_lookup_and_its_gradient_equal_plain_loops(double):
    octree = make_tree()
    x = random(60, 3, low=-1.6, high=1.6)
    wanted = torch.stack(list(map(plain_octree(octree), x)))
    assert_one_function(octree, octree(x), wanted)
    assert wanted[:, 6].any()  # some lie in cells of the last level
    assert octree(torch.tensor([[math.nan, -math.inf, 1e30]])).isfinite().all()


def test_seeding_leaves_no_hanging_corner_around_points():
    octree = geonvs.Octree(1.0, 6, root=8)
    points = random(5, 3, low=-0.7, high=0.7)  # away from the cube's faces
    geonvs.seed_octree(octree, points, dense=1)
    node, exists, _ = octree.locate(points)
    assert (exists == (torch.arange(6) < 4)).all()  # level 0, a whole one, two near points
    assert not octree.is_hanging[node[:, :4]].any()
    assert octree.cells[:, 0].bincount()[1] == 16**3
    assert octree.finest == 2 / 64
    assert 0.005 < octree.features.std() < 0.02


def test_the_worst_cells_are_split(monkeypatch, capsys):
    octree = make_tree()
    octree.cell_error.uniform_()
    octree.cell_error[:, 1] /= 4  # pixels of about the sizes of cells
    is_leaf = octree.child[:, 0] == torch.arange(len(octree.cells))
    octree.cell_error[~is_leaf] = 0
    level = octree.cells[:, 0]
    error, pixel, count = octree.cell_error.T
    is_open = is_leaf & (level < 3) & (pixel / count < 0.5 / 2**level)
    error, order = error[is_open].sort(descending=True)
    chosen = (error.cumsum(0) < geonvs.SPLIT_SHARE * error.sum()).sum() + 1
    wanted = octree.cells[is_open][order][:chosen]
    assert torch.equal(geonvs.cells_to_split(octree), wanted)
    monkeypatch.setattr(geonvs, "MAX_CELLS", len(octree.cells) + 5 * 56 + 55)
    assert torch.equal(geonvs.cells_to_split(octree), wanted[:5])
    assert "near the limit" in capsys.readouterr().out


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_cells_are_split_with_the_neighbours_that_exist(reach):
    octree = make_tree()
    cells = octree.cells.tolist()
    near = [d for d in itertools.product((-1, 0, 1), repeat=3) if np.abs(d).sum() <= reach]
    moved = [[n, i + di, j + dj, k + dk] for n, i, j, k in cells[::9] for di, dj, dk in near]
    there = torch.tensor([cell for cell in moved if cell[0] < 3 and cell in cells])
    wanted = {*octree.split_keys.tolist(), *geonvs.pack_index(there).tolist()}
    octree.split(octree.cells[::9], reach)
    assert octree.split_keys.tolist() == sorted(wanted)


# ---- 4 fields ------------------------------------------------------------------------------------
SLOPE = torch.tensor([1.0, 10, 100])
BEND = torch.tensor([1.0, 3, -9])


def quadratic(x):
    """A field (...) at x (...,3). Its gradient is SLOPE + 2 BEND x, its Laplacian 2 BEND.sum()."""
    return (SLOPE * x + BEND * x**2).sum(-1)


def test_four_taps_differentiate_a_quadratic(warm, double):
    warm.sdf.forward = lambda x: (quadratic(x), None)
    warm.sdf.double()
    x = random(20, 3)
    s, grad, lap = warm.sdf.derivatives(x, 0.3)
    assert_tensors_close(s, quadratic(x), 1e-6)
    assert_tensors_close(grad, SLOPE + 2 * BEND * x, 1e-6)
    assert_tensors_close(lap, 2 * BEND.sum().expand(20), 1e-6)


def test_a_lipschitz_layer_bounds_its_rows(double):
    layer = geonvs.LipschitzLinear(7, 5)
    x = random(50, 7, low=-1)
    norms = layer.weight.abs().sum(1)
    assert_tensors_close(layer.bound(), norms.max())  # at first it leaves all rows as they are
    for bound in (norms.max(), norms.median()):
        layer.c.data = (bound.exp() - 1).log()
        scale = (bound / norms).clamp(max=1)
        assert_tensors_close(layer(x), scale * (x @ layer.weight.T) + layer.bias)


# ---- 5 from SDF to colour ------------------------------------------------------------------------
def test_inverse_cdf_inverts_the_cdf(double):
    edges = random(4, 9).cumsum(1)
    weight = random(4, 8)
    weight[:, 3] = 0
    u = random(4, 30)
    u[:, 0] = 0
    for row, found in enumerate(geonvs.inverse_cdf(edges, weight, u)):
        cdf = np.append(0, weight[row].cumsum(0) / weight[row].sum())
        assert_tensors_close(found, np.interp(u[row], cdf, edges[row]), 1e-9)


def test_the_cache_holds_a_quadratic_and_its_errors(double):
    cache = geonvs.SDFCache(17)
    cache.refresh(quadratic)
    x = cache.points[cache.points.norm(dim=1) < 1]
    x = x[(x.abs() < 0.8).all(1)][None]  # the grid's border lacks neighbours
    e_grad = ((SLOPE + 2 * BEND * x).norm(dim=2) - 1) ** 2
    e_curv = 2 * BEND.sum().abs().expand(x.shape[:2]) * 2 / 16  # |lap| times a voxel's side
    wanted = torch.stack([quadratic(x), e_grad, e_curv])
    assert_tensors_close(cache.lookup(x, slice(0, 3)), wanted)
    assert len(cache.points) < 17**3


def test_strata_hold_one_number_each():
    rays = fake_rays(torch.zeros(4000, 3), torch.ones(4000, 3))
    place = 5 * geonvs.stratified(rays, 5, generator()) - torch.arange(5)  # within a stratum
    assert (place >= 0).all() and (place < 1).all()
    assert_tensors_close(place.mean(0), [0.5] * 5, 0.02)
    assert_tensors_close(place.std(0), [1 / 12**0.5] * 5, 0.02)
    assert (place.T.corrcoef() - torch.eye(5)).abs().max() < 0.1  # drawn one by one
    assert_tensors_close(5 * geonvs.stratified(rays, 5)[7] - torch.arange(5), [0.5] * 5)


def test_samples_crowd_at_the_first_surface(warm, double):
    warm.cache = geonvs.SDFCache(64).double()
    warm.cache.refresh(lambda x: (x[:, 0] + 0.25).abs() - 0.15)  # a slab, x = -0.4 to -0.1
    rays = fake_rays(torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0, 0]]))
    ends = geonvs.sphere_interval(*rays[:3])
    warm.cfg.samples = 1001
    by_zeta = []
    for zeta in (64, 64000):
        warm.deviation.data.fill_(math.log(zeta) / 10)
        by_zeta.append(warm.sample(rays, *ends, generator()))
    t, at_large_zeta = by_zeta
    assert_tensors_close(t[:, [0, -1]], torch.hstack(ends))
    assert (t.diff() >= 0).all()
    assert ((t - 2.6).abs() < 0.1).float().mean() > 0.98  # the slab begins at 2.6
    assert (t > 3).float().mean() < 0.01
    assert_tensors_close(at_large_zeta, t)  # not below a voxel
    probes = random(3, 1) + torch.arange(9)
    u = torch.tensor([[0.25, 0.9]] * 3)
    even = geonvs.importance_samples(probes, torch.zeros(3, 8), u)
    assert_tensors_close(even, probes[:, :1] + torch.tensor([0, 2, 7.2, 8]))  # nothing is met


@pytest.mark.parametrize("zeta", [20, 480, 1e4])
def test_the_hit_is_where_a_plane_is(double, zeta):
    """Within a tenth of the finest step of differences, whatever samples and sharpness."""
    eps = 1 / geonvs.ROOT / 2**7 / 2  # at eight levels
    plane = 2.0 + random(200, 1)  # distances along rays
    t = plane + random(200, 16, low=-0.1, high=0.1).sort().values
    t[:, [0, -1]] = torch.tensor([1.0, 4.0])
    sdf = random(200, 1, low=0.3) * (plane - t)
    w = geonvs.composite(geonvs.neus_alpha(sdf, zeta))
    assert_tensors_close(geonvs.surface_depth(t, sdf, w), plane[:, 0], eps / 10)
    assert_tensors_close(geonvs.surface_depth(t, sdf, 0 * w), t[:, -1])


def plain_weights(alphas):
    """Weights (S,) of intervals with these opacities, front to back."""
    passing = [math.prod(1 - (1 - 1e-6) * a for a in alphas[:i]) for i in range(len(alphas))]
    return torch.stack([share * alpha for share, alpha in zip(passing, alphas)])


def plain_background(model, o, d, t0, t1, near, per_ray, before, beyond):
    """What GeoNVS.background returns for one ray, with stratified numbers before (n,) the sphere
    and beyond (K-n,) it."""
    n = len(before)
    t = torch.cat([near + before * (t0 - near), t1 + beyond / (1 - beyond)])  # (K,)
    ends = torch.cat([t[1:n], t0[None], t[n + 1:]])  # (K-1,) of all intervals but the last
    x = o + t[:, None] * d
    length = x.norm(dim=1, keepdim=True).clamp(min=1)
    x = x * (2 - 1 / length) / length
    features = torch.stack(list(map(model.plain[1], x)))
    out = model.background.density(torch.hstack([x, features]))
    inputs = torch.hstack([out[:, 1:], per_ray.expand(len(t), -1)])
    color = model.background.color(inputs).sigmoid()
    alphas = 1 - torch.exp(-F.softplus(out[:-1, 0] - 1) * (ends - t[:-1]))
    w = plain_weights([*alphas, 1])
    return w[:n] @ color[:n], 1 - w[:n].sum(), w[n:] @ color[n:]


def plain_render(model, o, d, near, t, code, *parts):
    """What trace and shade return for one ray with samples at t (S+1,), in one row."""
    x = o + t[:, None] * d
    features = torch.stack(list(map(model.plain[0], x)))
    out = model.sdf.network(torch.hstack([x, features]))
    s = x.norm(dim=1) - 0.25 + out[:, 0]
    start, end = s[:-1], s[1:]
    zeta = torch.exp(10 * model.deviation)
    fall = 1 - (zeta * end).sigmoid() / (zeta * start).sigmoid()
    if model.cfg.printed("alpha"):
        beta = (end - start) / 2
        fall = (zeta * start + beta).sigmoid() - (zeta * end + beta).sigmoid()
    w = plain_weights(fall.relu())
    opacity = w.sum()
    zero = t[:-1] + start / (start - end).clamp(min=1e-6) * t.diff()  # w is 0 where s rises
    vote = torch.where((start > 0) & (end <= 0), w, 0.01 * w).detach()
    depth = vote @ zero.clamp(t[0], t[-1]) + 1e-8 * t[-1]
    depth = (depth / (vote.sum() + 1e-8)).detach()
    point = o + depth * d
    _, grad, _ = model.sdf.derivatives(point[None], model.eps)
    normal = grad[0] / grad.norm()
    per_ray = torch.cat([normal, d, code])
    inputs = torch.hstack([out[:, 1:], features, per_ray.expand(len(t), -1)])
    colors = model.color(inputs).sigmoid()
    rgb = w @ (colors[:-1] + colors[1:]) / 2
    before, passed, beyond = 0, 1, model.bg_color
    if model.background:
        before, passed, beyond = plain_background(
            model, o, d, t[0], t[-1], near, per_ray[3:], *parts)
    rgb = before + passed * rgb + (1 - opacity) * beyond
    return torch.hstack([rgb, opacity, depth, normal, point])


def rough_case(**changes):
    """A model in float64, with rough features and bounds that bind; eight rays towards its middle,
    but the first misses the sphere, the second starts in it, a person's mask leaves the third out;
    their photos."""
    scene = geonvs.load_scene(toy() | dict(bg_color=np.array([0.2, 0.4, 0.6])))
    scene.sfm_pixels.bernoulli_(0.5)
    scene = scene._replace(
        c2w=scene.c2w.double(), near=scene.near.double(), points=scene.points.double())
    model = make_model(scene, samples=5, bg_samples=12, **changes).double()
    for octree in model.octrees:
        nn.init.uniform_(octree.features, -0.1, 0.1)
    for layer in model.color[::2]:
        layer.c.data -= 1
    model.plain = list(map(plain_octree, model.octrees))
    rays, photos = model.batch(8, generator())
    d = 0.2 * random(8, 3, low=-1) - rays.o
    rays.o[:2] = torch.tensor([[0, 0.2, 3], [0.1, 0.1, 0.7]])
    d[:2] = torch.tensor([[1, 0.1, 0.3], [0, -0.1, -1]])
    rays.is_masked[2] = True
    rays.near[3:] = 0.1  # there is room before the sphere
    return model, rays._replace(d=F.normalize(d)), photos


def shaded(model, rays, code, hits):
    """Colours (R,3) and normals (R,3) of hits."""
    _, grad, _ = model.sdf.derivatives(hits.point, model.eps)
    normal = F.normalize(grad)
    return model.shade(rays, code, hits, normal), normal


@pytest.mark.parametrize("background, paper", [("on", ""), ("off", "alpha")])
def test_rendering_and_its_gradients_equal_plain_loops(double, background, paper):
    model, rays, _ = rough_case(background=background, paper=paper)
    code = model.appearance(rays.photo)
    gen = generator()
    t = model.sample(rays, *geonvs.sphere_interval(*rays[:3]), gen)
    before, beyond = [geonvs.stratified(rays, n, gen) for n in (2, 10)]
    rows = zip(rays.o, rays.d, rays.near[:, 0], t, code, before, beyond)
    wanted = [plain_render(model, *row) for row in rows]
    hits = model.trace(rays, code, generator())
    rgb, normal = shaded(model, rays, code, hits)
    found = torch.column_stack([rgb, hits.opacity, hits.depth, normal, hits.point])
    assert_one_function(model, found, torch.stack(wanted))


@pytest.mark.parametrize("aside, opacity, depth", [(0.0, 1, 2.75), (0.8, 0, 3.6)])
def test_a_new_model_shows_a_small_ball(warm, aside, opacity, depth):
    warm.deviation.data.fill_(math.log(200) / 10)  # a sharp surface
    d = F.normalize(random(50, 3, low=-1))
    right = F.normalize(torch.linalg.cross(d, random(50, 3)))
    rays = fake_rays(-3 * d + aside * right, d)  # the ball's radius is 0.25
    code = warm.codes()[:1].expand(50, -1)
    out = warm.render(rays, code)
    wanted, normal = shaded(warm, rays, code, warm.trace(rays, code))
    assert_tensors_close(out.normal, normal * out.opacity[:, None])
    assert_tensors_close(out.opacity, [opacity] * 50, 0.02)
    assert_tensors_close(out.depth, [depth] * 50, 0.02)
    assert_tensors_close(out.rgb, wanted)  # samples lie in the middle of their strata


# ---- 6 photos in the wild ------------------------------------------------------------------------
def test_logits_that_are_linear_in_the_photo_are_read_so():
    u = (torch.arange(8) + 0.5) / 8  # centres of pixels
    v = (torch.arange(4) + 0.5) / 4
    first = (u - 3 * v[:, None])[None]  # (1,4,8)
    uv = random(20, 2, low=0.2, high=0.8)
    found = geonvs.sample_logits(torch.stack([first, first + 5]), uv)  # ten rays of each
    assert_tensors_close(found, uv[:, 0] - 3 * uv[:, 1] + 5 * (torch.arange(20) >= 10))


def test_the_mask_starts_low_at_half_size(warm):
    mask = warm.mask
    y = mask.thumbs[[3]].float()  # (1,3,64,64)
    halved = F.avg_pool2d(y, 2)
    assert 0.02 < mask.logits([0, 1, 2]).sigmoid().mean() < 0.2
    for stage, size in zip(mask.stages, [(16, 32, 32), (32, 16, 16), (64, 8, 8)]):
        y = stage(y)
        assert y.shape[1:] == size
    mask.stages = mask.heads = nn.ModuleList([nn.Identity()])  # leaves what the network reads
    assert_tensors_close(mask.logits([3]), halved / 255 - 0.5)


def test_phi_depends_on_ratios_of_complexity(double):
    complexity, opacity = random(2, 200)
    phi = geonvs.edge_indicator(complexity, opacity)
    scaled = 30 * complexity + 0.029  # as 30 (x + 0.001) is that + 0.001
    assert_tensors_close(geonvs.edge_indicator(scaled, opacity), phi)
    assert (geonvs.edge_indicator(torch.full((200,), 2.0), opacity) == opacity / 2).all()
    assert (geonvs.edge_indicator(complexity, 0 * opacity) == 0).all()


# ---- 7 model and objective -----------------------------------------------------------------------
def test_batches_come_photo_by_photo_from_training_photos(warm):
    gen = generator()
    batches = [warm.batch(64, gen) for _ in range(20)]
    assert all(torch.equal(rays.photo, photos.repeat_interleave(16)) for rays, photos in batches)
    assert torch.equal(torch.cat([photos for _, photos in batches]).unique(), warm.scene.train)


def plain_phi(model, rays, hits):
    """Phi (8,) of eight rays, in numpy."""
    at = (hits.x.detach() + 1) / 2 * (model.cache.n - 1)  # (8,6,3) in voxels
    e_grad, e_curv = [
        map_coordinates(channel, at.permute(2, 0, 1), order=1, mode="nearest").mean(1)
        for channel in model.cache.volume[0, 1:]]
    is_counted = ~rays.is_masked.numpy()
    if model.cfg.printed("phi"):  # with |lap s|, not that times a voxel's side
        meets_sphere = hits.x[:, 0].norm(dim=1).numpy() < 1.001
        assert not meets_sphere.all()
        return is_counted / (1 + np.exp(-(10 * e_grad + 2 * e_curv / (2 / 63)) * meets_sphere))
    opacity = hits.opacity.detach().numpy() * is_counted
    x = np.log(10 * e_grad + 2 * e_curv + 1e-3)
    mean = np.average(x, weights=opacity)
    deviation = np.average((x - mean) ** 2, weights=opacity) ** 0.5
    return opacity / (1 + np.exp((mean - x) / deviation))


def plain_losses(model, rays, done):
    """Terms of the objective, what is logged beside them, and statistics, ray by ray."""
    gen = generator()
    code = model.appearance(rays.photo)
    hits = model.trace(rays, code, gen)
    sfm = model.sfm[torch.randint(len(model.sfm), (2,), generator=gen)]
    start, end = model.air[torch.randint(len(model.air), (2,), generator=gen)].unbind(1)
    air = start + geonvs.uniform(gen, 2, 1) * (end - start)
    _, slopes, laps = model.sdf.derivatives(torch.cat([hits.point, sfm, air]), model.eps)
    rgb, _ = shaded(model, rays, code, hits)
    nodes, _, _ = model.sdf.octree.locate(hits.point)
    phi = plain_phi(model, rays, hits)
    cell_error = torch.zeros(len(model.sdf.octree.cells), 3)
    terms = defaultdict(float, cell_error=cell_error)
    for r, (is_masked, has_sfm) in enumerate(zip(rays.is_masked.tolist(), rays.has_sfm.tolist())):
        residual = (rgb[r] - rays.rgb[r]).abs()
        error = residual.max().item()
        opacity = hits.opacity[r].item()
        M, reg, left_out = 0.0, 0.0, is_masked
        if model.mask:
            logit, = geonvs.sample_logits(model.mask.logits(rays.photo[[r]]), rays.uv[r])
            logit = logit.detach() if done >= 0.6 else logit
            M = logit.sigmoid()
            judged = 0.0 if has_sfm else error
            excess = judged - 0.15
            reg = -abs(excess) * F.logsigmoid(logit if excess > 0 else -logit)
            if model.cfg.printed("reg"):
                reg = 0.15 * M**2 + 0.02 * M * (1 - M) - M * judged
            left_out = 1.0 if is_masked else M.item()
        terms["mse"] += residual.square().mean() / 8
        terms["rgb"] += (1 - left_out) * residual.mean() / 8
        terms["reg"] += reg * (not is_masked) / 8
        terms["gpl"] += M * phi[r] / 8
        terms["eik"] += opacity * (slopes[r].norm() - 1) ** 2 / 12
        terms["curv"] += opacity * laps[r].abs() * model.eps / 8
        terms["left_out"] += left_out / 8
        if opacity > 0.5:
            pixel = hits.depth[r] / model.scene.K[rays.photo[r], 0]
            cell_error[nodes[r, -1]] += torch.tensor([0 if is_masked else error, pixel, 1])
    for slope in slopes[8:]:
        terms["eik"] += (slope.norm() - 1) ** 2 / 12
    terms["lps"] = math.prod(torch.log(1 + layer.c.exp()) for layer in model.color[::2])
    terms["sfm"] = model.signed_distance(sfm).abs().mean()
    terms["off"] = (model.sdf.octree.finest - model.signed_distance(air)).relu().mean()
    return terms


@cases(
    "mask, zeta, done, paper",
    soft=("on", 30.0, 0.02, ""),
    late=("on", 50.0, 0.7, ""),
    printed=("on", 50.0, 0.02, "phi,reg"),
    off=("off", 30.0, 0.02, ""))
def test_the_objective_and_its_gradients_equal_plain_loops(double, mask, zeta, done, paper):
    model, rays, photos = rough_case(mask=mask, lam_gpl=0.4, lam_mask=0.7, paper=paper)
    model.deviation.data.fill_(math.log(zeta) / 10)
    # in the ball, where s < 0: L_off counts, and L_sfm needs the absolute value
    model.air = random(*model.air.shape, low=-0.2, high=0.2)
    model.sfm = random(*model.sfm.shape, low=-0.2, high=0.2)
    plain = plain_losses(model, rays, done)
    total, log = model.losses(rays, photos, done, generator())
    log |= dict(cell_error=model.sdf.octree.cell_error)
    for name, value in log.items():
        assert_tensors_close(value, plain[name])
    weights = dict(rgb=1, reg=model.cfg.lam_mask)
    weights |= {n: getattr(model.cfg, f"lam_{n}") for n in "eik curv gpl lps off sfm".split()}
    wanted = sum(weight * plain[name] for name, weight in weights.items())
    assert_one_function(model, total, wanted, trains_mask=mask == "on" and done < 0.6)
    assert plain["off"] > 0


def test_a_facades_court_becomes_air():
    """s starts as a ball, which hangs in the empty court of a palace. Few photos see its remains:
    without L_off an eighth of the air stays inside."""
    scene = geonvs.load_scene(toy(size=48, photos=10, landmark=-1))
    model = make_model(scene, steps=120, rays=128)
    optimizer = geonvs.make_optimizer(model)
    for step in range(120):
        geonvs.training_step(model, optimizer, step, step / 120, generator(step))
    x = F.normalize(torch.randn(9000, 3)) * random(9000, 1) ** (1 / 3)  # anywhere in the sphere
    air = x[scene_sdf(scene.raw, x.numpy(), landmark=-1) > 0.1]
    assert (geonvs.in_chunks(model.signed_distance, air) < 0).float().mean() < 0.06


@pytest.mark.parametrize("zeta", [1.0, 1e4])
@pytest.mark.parametrize("distance", [-1e3, -1e-6, 0.0, 1e-6, 1e3])
def test_a_step_is_finite_whatever_the_sdf(warm, distance, zeta):
    warm.cfg.photos = 1
    warm.sdf.network[2].weight.data *= 1e-3
    warm.sdf.network[2].bias.data.fill_(distance)
    warm.deviation.data.fill_(math.log(zeta) / 10)
    for count in (1, 64):
        total, _ = warm.losses(*warm.batch(count, generator()), 0, generator())
        assert all(value.isfinite().all() for value in [total, *gradients(warm, total).values()])


ALIKE = dict(footprint=0.02, exposure_spread=0.009, bg_color=np.array([0.2, 0.4, 0.6]))
VARIED = dict(footprint=0.02, exposure_spread=0.011, bg_color=np.array([0.2, 0.4, math.nan]))


@cases(
    "settings, facts, wanted",
    needs_nothing=({}, ALIKE, (3, 0, False)),
    needs_both=({}, VARIED, (3, 4, True)),
    turned_on=(dict(appearance="on", background="on"), ALIKE, (3, 4, True)),
    turned_off=(dict(appearance="off", background="off"), VARIED, (3, 0, False)),
    # a cell of two levels is 1/16 wide
    few_pixels=(dict(levels=0), ALIKE | dict(footprint=0.5), (2, 0, False)),
    a_pixel_above_half_a_cell=(dict(levels=0), ALIKE | dict(footprint=0.032), (2, 0, False)),
    a_pixel_below_half_a_cell=(dict(levels=0), ALIKE | dict(footprint=0.031), (3, 0, False)),
    many_pixels=(dict(levels=0), ALIKE | dict(footprint=0.0001), (8, 0, False)))
def test_a_scene_gets_the_parts_it_needs(settings, facts, wanted):
    assert geonvs.needed_parts(tiny(**settings), facts) == wanted


def test_a_model_is_made_of_these_parts(scene, warm, monkeypatch):
    bare = make_model(scene, appearance="off", background="off")
    make_cache = mock.Mock(side_effect=lambda n, make=geonvs.SDFCache: make(8))
    monkeypatch.setattr(geonvs, "SDFCache", make_cache)
    deep = make_model(scene, levels=5)
    octree = deep.background.octree
    far = scene.points[scene.points.norm(dim=1) > 1]
    node, _, _ = octree.locate(geonvs.contract(far))
    assert bare.background is None
    assert geonvs.fit_codes(bare, scene, scene.test).shape == (2, 0)  # nothing is fitted
    assert octree.levels == 4  # at most
    assert octree.cells[:, 0].bincount()[:2].tolist() == [32**3, 64**3]  # one level more is whole
    assert (octree.cells[node[:, -1], 0] == 3).all()  # fine where points are
    assert warm.background.octree.cells[:, 0].bincount()[1] < 64**3
    assert deep.eps == 2 / 16 / 4 / 2  # half of the smallest cell there is
    make_cache.assert_called_once_with(128)


@pytest.mark.parametrize("done, least", [(0.0, 1e-6), (0.1, 20), (0.2, 40), (0.4, 80), (1.0, 80)])
@pytest.mark.parametrize("paper", ["", ",".join(geonvs.PRINTED)])
def test_the_least_zeta_rises_and_paper_has_none(warm, done, least, paper):
    warm.cfg.paper = paper
    for v in (-9, 0, 0.3, 0.6, 9):
        wanted = np.clip(math.exp(10 * v), 1e-6, 1e6)
        warm.deviation.data.fill_(v)
        warm.bound_zeta(done)
        assert warm.zeta().item() == pytest.approx(wanted if paper else max(wanted, least), 1e-4)


def test_refining_moves_features_and_moments_with_corners(warm):
    def tables():
        state = optimizer.state[octree.features]
        return octree.features.data, state["exp_avg"], state["exp_avg_sq"]
    optimizer = geonvs.make_optimizer(warm)
    octree = warm.sdf.octree
    octree.features.sum().backward()
    optimizer.step()
    number = {key: row for row, key in enumerate(octree.corner_key.tolist(), 1)}
    for table in tables():
        table[:, 1] = torch.arange(1, len(table) + 1)
    octree.cell_error[:, ::2] = 1  # colours err everywhere
    twin = copy.deepcopy(octree)
    twin.split(geonvs.cells_to_split(octree), reach=1)
    warm.refine(optimizer)
    wanted = [number.get(key, 0) for key in twin.corner_key.tolist()]
    assert 0 in wanted
    for table in tables():
        assert_tensors_close(table[:, 1], wanted)
    assert optimizer.state[octree.features]["step"] == 1
    held = {p for group in optimizer.param_groups for p in group["params"]}
    assert held == set(warm.parameters())


def test_mixed_precision_leaves_the_sdf_alone(warm, monkeypatch):
    batch = warm.batch(64, generator())
    full, log = warm.losses(*batch, 0, generator())
    monkeypatch.setattr(geonvs, "has_bfloat16", lambda device_type: True)
    mixed, mixed_log = warm.losses(*batch, 0, generator())
    wanted, found = [gradients(warm, loss)["sdf.octree.features"] for loss in (full, mixed)]
    assert_tensors_close(mixed, full, 0.01)
    assert mixed != full
    assert all(mixed_log[name] == log[name] for name in ("eik", "curv", "sfm", "off"))
    assert (found - wanted).norm() < 0.05 * wanted.norm()


class OneDevice(TorchDispatchMode):
    """Refuses an operator with tensors on two devices. A tensor without dimensions may be the
    host's, as a GPU takes it along with the call, unless it is copied."""
    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        tensors = filter(torch.is_tensor, tree_leaves([args, kwargs, result]))
        devices = {x.device for x in tensors if "copy" in str(function) or x.dim() > 0}
        assert len(devices) < 2, f"{function} on {devices}"
        return result


@pytest.mark.parametrize("parts", ["on", "off"])
def test_a_step_asks_its_device_for_nothing(scene, monkeypatch, parts):
    """On a device that has no values to be asked for."""
    class MetaGenerator(torch.Generator):
        device = torch.device("meta")  # a host's generator draws for it
    monkeypatch.setattr(adam, "_device_dtype_check_for_fused", mock.Mock())
    model = make_model(scene, appearance=parts, background=parts, mask=parts).to("meta")
    tensors = [x.to("meta") if torch.is_tensor(x) else x for x in scene]
    model.scene = geonvs.Scene(*tensors)
    optimizer = geonvs.make_optimizer(model)
    with OneDevice():
        for step, done in ((0, 0.1), (64, 0.7)):
            geonvs.training_step(model, optimizer, step, done, MetaGenerator())
    assert model.deviation.grad.is_meta


# ---- 8 energy ------------------------------------------------------------------------------------
CPU = torch.device("cpu")


@cases(
    "energy, wanted",
    fails_at_once=({"GPU-0": []}, []),
    fails_after_one=({"GPU-0": [9000]}, []),
    fails_later=({"GPU-0": [1000, 1000, 4000, 8000]}, [50, 53, 57]),
    of_two_gpus=({"GPU-0": [1000, 2000], "GPU-1": [5000, 7000]}, [53]))
def test_a_meter_adds_until_its_counter_fails(monkeypatch, capsys, energy, wanted):
    nvml = SimpleNamespace(
        nvmlInit=mock.Mock(),
        nvmlDeviceGetHandleByUUID=str,
        nvmlDeviceGetTotalEnergyConsumption=lambda gpu: energy[gpu].pop(0))
    monkeypatch.setitem(sys.modules, "pynvml", nvml)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda n: SimpleNamespace(uuid=n))
    gpu = torch.device("cuda")
    assert list(geonvs.metered_joules(gpu, 50.0, geonvs.Processes(len(energy)))) == wanted
    assert capsys.readouterr().out.count("energy is null") == 1
    nvml.nvmlInit.assert_called_once()
    assert list(geonvs.metered_joules(CPU, 50.0)) == []  # GPUs alone are metered
    energy["GPU-0"] = [1000, 2000]
    assert list(geonvs.metered_joules(gpu, None)) == []  # it had failed before


# ---- 9 training ----------------------------------------------------------------------------------
RUN = Path("runs", "a")
CHECKPOINT = RUN / "checkpoint.pt"


def pass_time(patch, seconds):
    """So much time passes between two looks at the clock, and no energy is spent."""
    clock = itertools.count(500.0, seconds)
    patch.setattr(geonvs, "time", SimpleNamespace(perf_counter=clock.__next__))
    patch.setattr(geonvs, "metered_joules", lambda *_: itertools.repeat(0.0))


def run_training(saved=None, processes=geonvs.ALONE, **changes):
    """Model and state of a run on the tiny toy."""
    scene = geonvs.load_scene(toy())
    return geonvs.train(tiny(**changes), scene, RUN, saved, processes)


def read_log():
    return [json.loads(line) for line in (RUN / "log.jsonl").read_text().splitlines()]


def read_saved():
    saved, _ = geonvs.read_checkpoint(CHECKPOINT, {})
    return saved


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The model of a run that nothing stopped, its log with a line a step, its checkpoint."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("whole"))
        pass_time(patch, seconds=100)
        model, _ = run_training()
        return SimpleNamespace(model=model, log=read_log(), saved=read_saved())


@pytest.fixture
def loop(in_tmp_dir, monkeypatch):
    """The training loop alone, ten seconds a step: what it calls."""
    calls = mock.Mock()
    calls.step.return_value = dict(mse=torch.tensor(0.1))
    pass_time(monkeypatch, seconds=10)
    monkeypatch.setattr(geonvs, "training_step", calls.step)
    monkeypatch.setattr(geonvs.GeoNVS, "refine", calls.refine)
    return calls


@pytest.mark.parametrize("step, done, share", [
    (0, 0, 0.05), (19, 0, 1), (128, 0.5, 0.525), (500, 0.5, 0.525), (9, 1, 0.025)])
def test_adams_first_step_equals_its_closed_form(warm, step, done, share):
    warm.cache.volume.zero_()  # as of an older model
    cfg = warm.cfg
    rates = dict(octree=cfg.lr_grid, appearance=cfg.lr_code, mask=cfg.lr_mask)
    twin = copy.deepcopy(warm)
    if step in (0, 128):
        twin.refresh_cache()
    gen = generator()
    twin.bound_zeta(done)
    total, _ = twin.losses(*twin.batch(64, gen), done, gen)
    wanted = twin.state_dict()
    parameters = dict(warm.named_parameters())
    for name, grad in gradients(twin, total).items():
        rate, = [rates[part] for part in rates if part in name] or [cfg.lr_net]
        direction = grad / (grad.abs() + 1e-15)  # a sign, but for the tiniest
        wanted[name] = wanted[name] - share * rate * direction
        parameters[name].grad = torch.ones_like(grad)  # of a former step
    geonvs.training_step(warm, geonvs.make_optimizer(warm), step, done, generator())
    for name, value in warm.state_dict().items():
        assert_tensors_close(value, wanted[name])


def test_a_budget_in_minutes_replaces_steps(loop, monkeypatch):
    flush = mock.Mock()
    monkeypatch.setattr(torch, "set_flush_denormal", flush)
    _, state = run_training(steps=2, minutes=2.5)
    steps, done = zip(*[call.args[2:4] for call in loop.step.call_args_list])
    log = read_log()
    assert steps == tuple(range(15))
    assert_arrays_close(done, np.arange(15) / 15)
    assert [line["step"] for line in log] == [1, 4, 7, 10, 13, 15]  # every 30 s
    assert_arrays_close(log[0]["psnr"], 10)  # of the step's mse
    assert read_saved()["state"] == vars(state)
    flush.assert_called_with(True)  # vanishing numbers would be slow


@pytest.mark.parametrize("start", [0, 5, 12, 13])
def test_refining_comes_at_shares_of_training(loop, whole, start):
    state = whole.saved["state"] | dict(step=start, seconds=0.0)
    run_training(whole.saved | dict(state=state), steps=20)
    wanted = ["step"] * 20
    for step in (12, 9, 6, 4, 2):  # shares 0.6, 0.45, 0.3, 0.2, 0.1
        wanted.insert(step, "refine")
    events = [name for name, _, _ in loop.mock_calls]
    assert events == wanted[-len(events):]
    assert events.count("step") == 20 - start


def test_of_two_processes_in_a_folder_one_goes_on(loop):
    def write_as_another(model, optimizer, step, *others):
        if step == 2:
            (RUN / "log.jsonl").write_text("a line of another process")
        return mock.DEFAULT
    loop.step.side_effect = write_as_another
    with pytest.raises(UserError, match="another process"):
        run_training()
    assert read_saved()["state"]["step"] == 1


@cases(
    "laps, seconds, count",
    none=([1.0] * 9, 9, 1),
    paused=([1.0, 1.0, 1.0, 600.0, 1.0], 24, 1),
    short=([0.1, 0.1, 9.9], 10.1, 1),  # seconds can be a checkpoint on a slow disk
    slow=([1.0, 1.0, 19.0], 21, 1),
    slower=([9.0, 60.0, 90.0], 159, 1),
    of_two_processes=([10.0] * 5, 50, 2))  # told after the last step
def test_a_pause_counts_as_twenty_steps_at_most(loop, monkeypatch, laps, seconds, count):
    clock = itertools.accumulate([5.0, *laps])
    monkeypatch.setattr(geonvs, "time", SimpleNamespace(perf_counter=clock.__next__))
    monkeypatch.setattr(geonvs.Processes, "share", lambda self, value: value)
    _, state = run_training(processes=geonvs.Processes(count), steps=len(laps))
    assert state.seconds == pytest.approx(seconds)


def test_a_resumed_run_adds_to_what_was_spent(loop, monkeypatch):
    run_training()
    saved = read_saved()
    saved["state"].update(joules=100.0, seconds=1000.0)
    result = RUN / "metrics.json"
    result.touch()
    monkeypatch.setattr(
        geonvs, "metered_joules", lambda _, joules, processes: itertools.count(joules, 3.0))
    run_training(saved)  # nothing is left to be done
    assert result.exists()
    _, state = run_training(saved, steps=8)
    assert (state.step, state.seconds, state.joules) == (8, 1020, 106)
    assert [line["step"] for line in read_log()] == [1, 4, 6, 7, 8]  # the first run ended at 6
    assert not result.exists()


def start_child(function, **env):
    """A new process that calls a function of this file."""
    code = f"import sys; sys.path[:0] = {sys.path}; import {__name__}; {__name__}.{function}()"
    return subprocess.Popen(
        [sys.executable, "-c", code], env=os.environ | env, text=True, stdout=subprocess.PIPE)


def train_with_signal(number, step):
    """Trains, and gets a signal in a step."""
    def step_with_signal(*args, train=geonvs.training_step):
        if args[2] == step:
            signal.raise_signal(number)
        return train(*args)
    with mock.patch.object(geonvs, "training_step", step_with_signal):
        run_training()


def train_until_killed():
    """Trains five steps of six, with a checkpoint at each."""
    pass_time(pytest.MonkeyPatch(), seconds=100)
    train_with_signal(signal.SIGKILL, step=5)


def test_sigkill_and_resume_change_no_bit(whole, in_tmp_dir, monkeypatch):
    code = start_child("train_until_killed").wait(600)
    saved = read_saved()
    with open(RUN / "log.jsonl", "a") as log:
        log.write('{"step": 6}\n{"step":')  # a line without its checkpoint, and a torn one
    pass_time(monkeypatch, seconds=100)
    resumed, _ = run_training(saved)
    cache = resumed.cache
    assert code == -signal.SIGKILL
    assert saved["state"]["step"] == 5
    assert_same_tensors(resumed.state_dict(), whole.model.state_dict())
    assert_tensors_close(cache.sdf(cache.points[None])[0], resumed.signed_distance(cache.points))
    assert read_log() == whole.log


STOPS = pytest.raises(KeyboardInterrupt, match="step 3 is saved")


@cases(
    "number, handler, end, step",
    ctrl_c=(signal.SIGINT, signal.default_int_handler, STOPS, 3),
    kill=(signal.SIGTERM, signal.default_int_handler, STOPS, 3),
    closed_terminal=(signal.SIGHUP, signal.default_int_handler, STOPS, 3),
    nohup=(signal.SIGHUP, signal.SIG_IGN, contextlib.nullcontext(), 6))
def test_a_stopped_run_ends_its_step(whole, in_tmp_dir, number, handler, end, step):
    former = signal.signal(number, handler)  # a background job ignores Ctrl-C
    try:
        with end:
            train_with_signal(number, step=2)
        assert signal.getsignal(number) == handler
    finally:
        signal.signal(number, former)
    assert read_saved()["state"]["step"] == step
    resumed, _ = run_training(read_saved())
    assert_same_tensors(resumed.state_dict(), whole.model.state_dict())


def test_a_run_can_be_trained_in_a_thread(in_tmp_dir):
    thread = threading.Thread(target=run_training)
    thread.start()
    thread.join()
    assert read_saved()["state"]["step"] == 6


def test_what_is_printed_comes_after_the_checkpoint(loop, monkeypatch):
    def print_to_closed_terminal(text, **_):
        if "step 4" in text:
            raise OSError(5, "Input/output error")
    monkeypatch.setattr(geonvs, "print", print_to_closed_terminal, raising=False)
    with pytest.raises(OSError, match="Input"):
        run_training()
    assert read_saved()["state"]["step"] == 4


@pytest.mark.parametrize("paper", ["", "reg"])
def test_infinite_weights_end_a_run_before_its_checkpoint(loop, paper):
    def spoil(model, *others):
        model.deviation.data /= loop.step.call_count < 5
        return mock.DEFAULT
    loop.step.side_effect = spoil
    with pytest.raises(UserError, match="learning rates.*checkpoint.pt") as error:
        run_training(steps=99, paper=paper)
    assert ("printed equations may" in str(error.value)) == (paper != "")
    assert [line["step"] for line in read_log()] == [1, 4]
    assert read_saved()["state"]["step"] == 4


ODD = (None, -1, "x", [], {"a": 1}, torch.full((5,), 2**62), Evil("harm"))


def test_a_bad_checkpoint_is_refused_in_one_sentence(in_tmp_dir):
    model, _ = run_training(steps=1, levels=1, background="off")
    data = CHECKPOINT.read_bytes()
    good = torch.load(CHECKPOINT)
    files = [data[:n] for n in (0, 99, 30_000, -9)]
    bad = [good | {key: odd} for key in good for odd in (*ODD, dict(lam_old=1.0))]
    for value in [*ODD, *bad]:
        torch.save(value, CHECKPOINT)
        files.append(CHECKPOINT.read_bytes())
    for data in files:
        CHECKPOINT.write_bytes(data)
        with pytest.raises(UserError, match="^.*checkpoint.pt.*$"):  # of one line
            geonvs.restore(read_saved(), model, generator())
        assert CHECKPOINT.read_bytes() == data
    assert not Path("harm").exists()


def adds(key, place, amount):
    """Changes of a scene's arrays: one of them, in one place."""
    def change(arrays):
        array = np.array(arrays[key])
        array[place] += amount
        return {key: array}
    return change


@cases(
    "change, says",
    new_name=(lambda a: dict(name=np.char.replace(a["name"], "_001", "_x")), "2 .*_001.png"),
    order=(lambda a: dict(track_photo=7 - a["track_photo"]) | {
        key: a[key][::-1] for key in ("name", "is_test", "wh", "K", "c2w", "thumbs")}, "8 .*_000"),
    is_test=(adds("is_test", 1, True), "1 .*_001.png"),
    wh=(adds("wh", (2, 1), 1), "1 .*_002.png"),
    K=(adds("K", (3, 0), 1e-3), "1 .*_003.png"),
    c2w=(adds("c2w", (4, 0, 0), 1e-4), "1 .*_004.png"),
    light=(adds("thumbs", 5, 3), "1 .*_005.png"),
    masked=(adds("masked", slice(9), True), "1 .*_000.png"),
    sightings=(adds("track_photo", 0, 1), "2 .*"),
    points=(adds("points", ..., 1e-3), "1 .*the sphere"),
    center=(adds("center", 2, 1e-3), "1 .*the sphere"),
    scale=(adds("scale", ..., 0.01), ".*the sphere"))
def test_a_checkpoint_of_another_scene_is_refused(whole, warm, change, says):
    raw = warm.scene.raw
    raw = raw | dict(masked=np.zeros(len(raw["rgb"]), bool), thumbs=warm.scene.thumbs.numpy())
    other = raw | change(raw)
    warm.scene = warm.scene._replace(raw=other, thumbs=torch.tensor(other["thumbs"].copy()))
    with pytest.raises(UserError, match=f"points: {says}"):
        geonvs.restore(whole.saved, warm, generator())


def test_a_checkpoint_fits_its_own_settings_alone(whole, scene):
    raw = scene.raw | dict(c2w=scene.raw["c2w"] + 1e-9)  # another machine's rounding
    info = dict(scene="toy", kind="colmap", folder="/elsewhere")
    model = make_model(scene._replace(raw=raw, info=info), lr_net=1e-4)
    saved = whole.saved | dict(generator=torch.zeros(16).byte())  # of a GPU, to render
    model.sdf.octree.split(model.sdf.octree.cells)  # a new model may have other cells
    optimizer, _ = geonvs.restore(saved, model)
    assert torch.equal(model.sdf.octree.features, saved["model"]["sdf.octree.features"])
    assert optimizer.param_groups[0]["base_lr"] == 1e-4  # rates may be given anew
    with pytest.raises(UserError, match="kind of device"):
        geonvs.restore(saved, model, generator())  # to train
    for settings in (dict(hidden=8), dict(levels=2), dict(background="off")):
        with pytest.raises(UserError, match="does not fit"):
            geonvs.restore(saved, make_model(scene, **settings))


def train_as_one_of_two():
    """Trains for a minute on its own clock, then once more until the second process has an infinite
    gradient. Saves weights, pixels, a mean of gradients, and what is said about infinity."""
    rank = int(os.environ["RANK"])
    processes = geonvs.Processes(2, rank, rank)
    processes.join(CPU)
    patch = pytest.MonkeyPatch()
    pass_time(patch, seconds=100 - 99 * rank)  # each looks every step
    make_rays = mock.Mock(wraps=geonvs.make_rays)
    patch.setattr(geonvs, "make_rays", make_rays)
    # as if errors differed between processes, which they do on GPUs
    patch.setattr(geonvs, "cells_to_split", lambda octree: octree.cells[9 * rank:][:9])
    model, _ = run_training(processes=processes, minutes=1.0, steps=99)
    pixels = torch.cat([call.args[2] for call in make_rays.call_args_list])
    weights = dict(model.named_parameters(), split=model.sdf.octree.split_keys)
    layer = nn.Linear(2, 1)
    layer.weight.grad = torch.tensor([[1.0, 5.0]]) + rank
    processes.average_gradients(layer)
    patch.setattr(geonvs, "objective", lambda loss, cfg: loss["rgb"] / (1 - rank))
    with pytest.raises(UserError) as error:
        run_training(read_saved(), processes, minutes=99.0)
    torch.save((weights, pixels, layer.weight.grad, str(error.value)), f"{rank}.pt")


def test_two_processes_train_one_model(in_tmp_dir):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    env = dict(MASTER_ADDR="127.0.0.1", MASTER_PORT=port, WORLD_SIZE="2")
    pair = [start_child("train_as_one_of_two", RANK=rank, **env) for rank in "01"]
    said, silence = [process.communicate(timeout=600)[0] for process in pair]
    assert "step 16" in said
    assert silence == ""
    a, pixels_a, grad, error_a = torch.load("0.pt")
    b, pixels_b, _, error_b = torch.load("1.pt")
    assert_same_tensors(a, b)
    assert len(pixels_a) == len(pixels_b) == 16 * 64  # until the first process says so
    assert (pixels_a == pixels_b).float().mean() < 0.1  # each draws its own rays
    assert grad.tolist() == [[1.5, 5.5]]  # the means of 1 and 2, of 5 and 6
    assert error_a == error_b
    assert "no longer finite" in error_a  # both noticed it


def test_processes_come_from_torchrun_and_the_first_makes_the_scene(in_tmp_dir, monkeypatch):
    events = mock.Mock()
    events.open.side_effect = [None, KeyboardInterrupt]
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.delenv("MASTER_ADDR", raising=False)
    with pytest.raises(UserError, match="torchrun"):
        geonvs.main(["--device", "cpu"])
    monkeypatch.setattr(geonvs.Processes, "join", events.join)
    monkeypatch.setattr(geonvs.dist, "barrier", events.wait)
    monkeypatch.setattr(data_prep, "open_scene", events.open)
    with pytest.raises(KeyboardInterrupt):
        geonvs.main(["--device", "cpu"])
    assert [name for name, _, _ in events.method_calls] == ["join", "open", "wait", "open"]


# ---- 10 scoring, mesh, pictures ------------------------------------------------------------------
def plain_ssim(a, b):
    """By the equations of Wang et al. 2004, in Gaussian windows of 11 px, without a border."""
    def mean(x):
        return cv2.GaussianBlur(x, (11, 11), 1.5)[5:-5, 5:-5]
    product = mean(a) * mean(b)
    squares = mean(a) ** 2 + mean(b) ** 2
    shared = mean(a * b) - product
    spread = mean(a * a + b * b) - squares
    likeness = (2 * product + 1e-4) / (squares + 1e-4)
    structure = (2 * shared + 9e-4) / (spread + 9e-4)
    return (likeness * structure).mean(2)


@pytest.mark.parametrize("width, masked_rows", [(80, 0), (81, 0), (80, 9)])
def test_the_right_half_is_scored_in_bytes(double, width, masked_rows):
    def lpips(a, b, normalize):
        assert normalize  # from 0..1
        return (a - b)[0, 2].abs().mean()
    truth, noise = random(2, 33, width, 3).numpy()
    rgb = 0.7 * truth + 0.3 * noise
    masked = np.zeros((33, width), bool)
    masked[5:5 + masked_rows, 10:75] = True
    masked[24:24 + masked_rows] = True  # whole rows
    left, want = np.split(truth, [width // 2], axis=1)
    _, got = np.split(np.round(rgb * 255) / 255, [width // 2], axis=1)
    is_used, is_scored = np.split(~masked, [width // 2], axis=1)
    got = np.where(is_scored[..., None], got, want)
    flat = want.copy()
    for row in np.flatnonzero(is_used.any(1)):
        flat[row] = left[row, is_used[row]].mean(0)
    scores = geonvs.score(rgb, truth, masked, lpips)
    assert scores == pytest.approx(dict(
        psnr=-10 * np.log10(np.mean((got - want)[is_scored] ** 2)),
        psnr_floor=-10 * np.log10(np.mean((flat - want)[is_scored] ** 2)),
        ssim=plain_ssim(got, want)[is_scored[5:-5, 5:-5]].mean(),
        lpips=np.abs(got - want)[..., 2].mean(),
        masked_pixels=(~is_scored).sum()), abs=1e-5)
    rgb[masked] = 0  # masked pixels of a rendering change no score
    assert geonvs.score(rgb, truth, masked, lpips) == scores
    small = geonvs.score(rgb[:10], truth[:10], masked[:10], lpips)
    assert small["ssim"] is small["lpips"] is None
    assert set(geonvs.score(rgb, truth, masked | True).values()) == {None, is_scored.size}


def picture(rgb):
    """A rendering of these colours (R,3), without depth and normals."""
    return geonvs.Rendering(rgb, rgb[:, 0], rgb[:, 0], rgb)


def test_fitted_codes_explain_each_left_half_but_for_masked_pixels(warm, scene):
    photos = scene.test
    raw = copy.deepcopy(scene.raw) | dict(masked=np.zeros(len(scene.raw["rgb"]), bool))
    raw["rgb"][:] = 255
    for number in photos:
        half = raw["wh"][number, 0] // 2
        photo(raw, number)[:, :half] = 30 * number
        photo(raw, number)[3:20] = 255
        photo(raw, number, "masked")[3:20] = True  # more than half
    codes = random(8, 3)
    painter = SimpleNamespace(
        cfg=tiny(), codes=lambda: codes, render=lambda rays, code: picture(code))
    start = geonvs.fit_codes(painter, scene, photos, steps=0)
    _, found = geonvs.evaluate(painter, geonvs.load_scene(raw))
    assert_arrays_close(start, codes[scene.train].mean(0).expand(2, 3))
    assert_arrays_close(found[photos], 30 * photos.expand(3, 2).T / 255, atol=0.03)
    geonvs.fit_codes(warm, scene, photos, steps=1)
    assert all(p.grad is None and p.requires_grad for p in warm.parameters())


@pytest.fixture
def knowing(warm):
    """A model that knows the toy: its surface, and the right halves of photos."""
    def render(rays, code):
        rgb = rays.rgb * (rays.uv[:, :1] > 0.48) + 0 * code.sum()
        return geonvs.Rendering(rgb, rgb[:, 0], rays.uv[:, 0], rays.d)

    def sdf(x):
        s = scene_sdf(toy(), x.reshape(-1, 3).numpy())
        return torch.tensor(s).float().reshape(x.shape[:-1]), None
    warm.sdf.forward = sdf
    warm.render = render
    return warm


def test_a_model_that_knows_photos_scores_perfectly(knowing, scene):
    pictures = {}
    scores, codes = geonvs.evaluate(knowing, scene, pictures=pictures)
    rows = scores["per_image"]
    names = scene.raw["name"][scene.raw["is_test"]].tolist()
    is_same = (codes == knowing.codes()).all(1)
    left, right = np.hsplit(pictures[names[0]], 2)
    assert scores["psnr"] == pytest.approx(100)  # no score is higher
    assert scores["psnr_floor"] == np.mean([row["psnr_floor"] for row in rows])
    assert [row["name"] for row in rows] == list(pictures) == names
    assert torch.equal(is_same.nonzero()[:, 0], scene.train)  # codes of test photos are fitted
    assert np.array_equal(left, photo(scene.raw, scene.test[0].item()))
    assert np.array_equal(right[:, -9:], left[:, -9:])  # the model knows the right half
    scores, _ = geonvs.evaluate(knowing, scene._replace(test=scene.test[:0]))
    assert scores.pop("per_image") == []
    assert set(scores.values()) == {None}


def test_a_rendered_photo_has_its_pixels_in_order_and_is_finite(knowing, scene):
    rgb, seen, normal, depth = geonvs.render_photo(knowing, scene, 1, torch.zeros(4))
    rays = geonvs.photo_rays(scene, 1)
    assert np.array_equal(geonvs.to_uint8(seen), photo(scene.raw, 1))
    assert not rgb[:, 0].any()  # the model knows the right half
    assert_arrays_close(normal.reshape(-1, 3), rays.d)
    assert_arrays_close(depth.flatten(), rays.uv[:, 0])
    knowing.render = lambda rays, code: picture(code[:, :3])
    with pytest.raises(UserError, match="no longer finite"):
        geonvs.render_photo(knowing, scene, 1, torch.tensor([0.5, 0.5, math.nan, 0.0]))


def plain_edges(depth):
    """Whether inverse depth bends by 5 % or more down or across, pixel by pixel."""
    q = 1 / np.pad(depth.astype(np.float32), 1, constant_values=np.nan)
    edges = np.zeros(depth.shape, bool)
    for row, col in np.ndindex(depth.shape):
        for before, here, after in (q[row:row + 3, col + 1], q[row + 1, col:col + 3]):
            bend = abs(2 * here - before - after)  # nan at a border
            edges[row, col] |= bend > 0.05 * max(before, here, after)
    return edges


def test_toy_truth_measures_known_errors(knowing, scene):
    raw = toy() | dict(
        near_wall_sdf=toy()["near_wall_sdf"] + 0.01, wall_normal=-toy()["wall_normal"])
    train = scene.train.tolist()
    people, depth = [[photo(raw, i, key) for i in train] for key in ("occluder", "depth")]
    marked = [p & (d < 2) | plain_edges(d) for p, d in zip(people, depth)]  # some of the people
    M = {i: 0.4 + 0.2 * torch.tensor(mark) for i, mark in zip(train, marked)}
    knowing.mask.logits = lambda photos: M[photos[0]].logit()[None, None]
    truth = geonvs.toy_truth(knowing, scene._replace(raw=raw))
    people, depth, marked = [np.hstack(list(map(np.ravel, x))) for x in (people, depth, marked)]
    assert truth.pop("sdf_error") == pytest.approx(0.01, rel=1e-3)
    assert truth.pop("normal_error") == pytest.approx(180, abs=0.5)
    assert truth == pytest.approx(dict(
        mask_iou=(people & marked).sum() / (people | marked).sum(),
        mask_static=0.4 + 0.2 * marked[~people].mean(),
        mask_sky=0.4 + 0.2 * marked[~people & np.isinf(depth)].mean(),
        mask_edges=0.6,
        mask_flat=0.4))


def test_a_mesh_is_a_disc_that_faces_outwards(warm):
    slope = torch.tensor([0.48, 0.6, 0.64])  # of length 1
    warm.signed_distance = lambda x: x @ slope - 0.01
    warm.cache.refresh(lambda x: x @ slope - 0.03)  # some steps ago
    vertices, faces = geonvs.extract_mesh(warm)
    x = (vertices - warm.scene.raw["center"]) / warm.scene.raw["scale"]
    a, b, c = x[faces].swapaxes(0, 1)
    area = np.cross(b - a, c - a).sum(0) / 2  # along the normal
    assert_arrays_close(x @ slope.numpy(), 0.01, atol=1e-3)
    assert lengths(x).max() == pytest.approx(1, abs=2 * warm.eps)  # it ends at the unit sphere
    assert_arrays_close(area, math.pi * slope, atol=0.06)
    assert np.ptp(x[faces], axis=1).max() == pytest.approx(warm.eps, rel=0.01)


@pytest.mark.parametrize("radius", [-0.1, 1.2])
def test_a_mesh_without_a_surface_is_empty(warm, radius):
    warm.signed_distance = lambda x: x.norm(dim=1) - radius
    warm.cache.refresh(warm.signed_distance)
    vertices, faces = geonvs.extract_mesh(warm)
    assert len(vertices) == len(faces) == len(geonvs.mesh_colors(warm, vertices)) == 0


def test_vertices_have_the_colours_of_rays(warm):
    d = F.normalize(random(9, 3, low=-1))
    vertices = world(warm.scene.raw, 0.25 * d.numpy())  # about on the sphere at the start
    code = warm.codes()[warm.scene.train].mean(0).expand(9, -1)
    warm.deviation.data.fill_(0.8)  # a sharp surface
    warm.background = None
    rgb = warm.render(fake_rays(3 * d, -d), code).rgb
    assert_arrays_close(geonvs.mesh_colors(warm, vertices), rgb.detach(), atol=0.02)


def test_depth_is_red_near_blue_far():
    picture = geonvs.depth_picture(np.array([[1.0, 2.0, 9.0]]), np.array([[1.0, 1.0, 0.0]]))
    near, far, nothing = picture[0].astype(int)
    assert near[0] > near[2] + 50
    assert far[2] > far[0]
    assert not nothing.any()


@pytest.mark.parametrize("mask, count", [("on", 5), ("off", 4)])
def test_a_panel_shows_its_columns_in_order(warm, scene, monkeypatch, mask, count):
    def render_photo(model, scene, photo, code):
        assert torch.equal(code, codes[photo])
        pictures = [np.full((24, 16, 3), color) for color in np.eye(3) / 2]
        return *pictures, np.zeros((24, 16))
    codes = random(8, 4)
    depth = np.full((24, 16, 3), 7, np.uint8)
    write_text = mock.Mock(wraps=cv2.putText)
    monkeypatch.setattr(geonvs, "render_photo", render_photo)
    monkeypatch.setattr(geonvs, "depth_picture", lambda *_: depth)
    monkeypatch.setattr(cv2, "putText", write_text)
    warm.has_mask = mask == "on"
    warm.mask.logits = lambda photos: torch.full((1, 1, 8, 8), -0.5)
    scene = scene._replace(test=torch.tensor([1, 4, 6]), train=torch.tensor([0, 2, 3]))
    panel = geonvs.draw_panel(warm, scene, codes).reshape(4, 380, count, 240, 3)
    titles = [call.args[1] for call in write_text.call_args_list]
    wanted = [[0, 128, 0], [128, 0, 0], [128, 128, 191], [7, 7, 7], [96, 96, 96]]
    assert (panel[:, 20:] == np.array(wanted[:count])[:, None]).all()
    assert [title[:8] for title in titles] == ["held out"] * 2 + ["training"] * 2
    assert all(("mask" in title) == (mask == "on") for title in titles)
    assert (panel[:, :20] < 50).any((1, 2, 3, 4)).all()  # they are to be seen


def test_a_film_sways_and_changes_its_light(warm, odd, in_tmp_dir, monkeypatch):
    def full_disk(*args, make=cv2.VideoWriter):
        """A writer that loses half of the frames, and says nothing."""
        writer = make(*args)
        turns = itertools.cycle([writer.write, len])
        return SimpleNamespace(write=lambda frame: next(turns)(frame), release=writer.release)
    odd = odd._replace(wh=odd.wh - 1)  # a codec wants even sides
    w, h = odd.wh[0].tolist()
    render = mock.Mock(return_value=(np.full((h, w, 3), [1.0, 0, 0]), None, None, None))
    monkeypatch.setattr(geonvs, "render_photo", render)
    geonvs.film(warm, odd, Path("a.mp4"))
    film = Path("a.mp4").read_bytes()
    _, views, photos, lights = zip(*[call.args for call in render.call_args_list])
    share = torch.arange(96)[:, None] / 95
    cameras = odd.c2w[0].repeat(96, 1, 1)
    cameras[:, :, 3] += 0.1 * torch.sin(math.tau * share) * cameras[:, :, 0]
    first, last = warm.codes()[[0, 7]]  # of training photos
    video = cv2.VideoCapture("a.mp4")
    blue, _, red, _ = cv2.mean(video.read()[1])
    assert set(photos) == {0}
    assert_tensors_close(torch.stack([view.c2w[0] for view in views]), cameras)
    assert_tensors_close(torch.stack(lights), first + share * (last - first))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 96
    assert red > 200 > 50 > blue
    monkeypatch.setattr(cv2, "VideoWriter", full_disk)
    with pytest.raises(UserError, match="48 of 96 frames"):
        geonvs.film(warm, odd, Path("a.mp4"))
    assert Path("a.mp4").read_bytes() == film  # it replaces none


# ---- 11 command line, documents ------------------------------------------------------------------
FLAGS = "--name=b " + " ".join(f"--{key}={value}" for key, value in TINY.items())


def start_folder(patch, folder):
    """Goes to a folder with the tiny toy in it; codes of held-out photos are not fitted."""
    def fit_codes(model, scene, photos):
        return model.codes()[photos] + 1
    patch.chdir(folder)
    patch.setattr(torch.cuda, "device_count", lambda: 0)
    patch.setattr(geonvs, "fit_codes", fit_codes)
    data_prep.write_scene(Path("data/toy.npz"), toy())


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run by one command, on a meter."""
    folder = tmp_path_factory.mktemp("finished")
    reads = itertools.count(0.0, 3600.0)
    with pytest.MonkeyPatch.context() as patch:
        start_folder(patch, folder)
        patch.setattr(geonvs, "metered_joules", lambda *_: reads)
        patch.setenv("PATH", "")  # no git
        geonvs.main(f"{FLAGS} --name= --seed=3 --mask=on".split())
    return folder / "runs/toy-geonvsw-3"


@pytest.fixture
def command(finished, tmp_path, monkeypatch, capsys):
    """Runs a command line where run a has ended already; returns exit code and stderr."""
    start_folder(monkeypatch, tmp_path)
    shutil.copytree(finished, RUN)
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    monkeypatch.setenv("RANK", "1")  # without others the process is alone all the same

    def run(flags):
        code = 0
        try:
            geonvs.run_command_line(lambda: geonvs.main(flags.split()), geonvs.GO_ON)
        except SystemExit as end:
            code = end.code
        return code, capsys.readouterr().err
    return run


def assert_refused(answer, word):
    """The answer is exit code 2 and one line with that word."""
    code, error = answer
    assert code == 2
    assert re.fullmatch(f".*error: .*{re.escape(word)}.*\n", error)


def test_one_command_trains_scores_and_writes_everything(finished, whole, scene):
    metrics = json.loads((finished / "metrics.json").read_text(), parse_constant=pytest.fail)
    line = json.loads((finished / "log.jsonl").read_text().splitlines()[0])
    held_out = scene.raw["name"][scene.raw["is_test"]].tolist()
    assert set(os.listdir(finished)) == {
        "checkpoint.pt", "log.jsonl", "metrics.json", "codes.npy", "panel.png", "mesh.ply",
        "held_out"}
    assert sorted(os.listdir(finished / "held_out")) == held_out
    assert line.keys() == whole.log[0].keys() > {"psnr", "joules", "rgb", "eik", "curv", "gpl"}
    assert line["rgb"] != whole.log[0]["rgb"]  # of another seed
    assert metrics["config"] == asdict(tiny(seed=3, mask="on"))
    assert metrics["energy_wh"] in range(2, 8)  # one at the start, one for each line of the log
    assert metrics["rays_per_second"] == pytest.approx(6 * 64 / metrics["train_seconds"])
    assert metrics["commit"] is None
    assert {"psnr", "ssim", "sdf_error", "normal_error", "mask_iou"} < set(metrics)
    assert metrics["model_bytes"] > 4 * metrics["parameters"] + 72 * sum(metrics["octree_cells"])
    assert 1e8 < metrics["peak_memory_bytes"] < 1e11


def test_resume_keeps_settings_that_are_not_given(command, monkeypatch):
    def resume(flags):
        return command("--resume --name=a " + flags)
    metrics = RUN / "metrics.json"
    monkeypatch.setattr(data_prep, "make_toy", toy)
    saved = read_saved()
    saved["config"]["minutes"] = 1e-4
    torch.save(saved, CHECKPOINT)
    shutil.rmtree("data")  # the toy is made again
    assert resume("--steps=8") == (0, "")  # the last budget counts
    saved = read_saved()
    assert saved["config"] == asdict(tiny(name="a", seed=3, mask="on", steps=8))
    assert saved["state"]["step"] == 8
    (RUN / "film.mp4").touch()
    metrics.unlink()
    assert resume("--steps=7 --paper --lam_gpl=0.5") == (0, "")  # it is scored again
    assert json.loads(metrics.read_text())["config"] == saved["config"]  # of what was trained
    assert (RUN / "film.mp4").exists()
    monkeypatch.setattr(geonvs, "training_step", mock.Mock(side_effect=MemoryError()))
    assert_refused(resume("--steps=9"), "fewer --rays")
    assert metrics.exists()  # no longer training has replaced it yet


def test_printed_equations_have_a_folder_of_their_own(command, monkeypatch):
    monkeypatch.setattr(geonvs, "train", lambda cfg, scene, run, *_: [None, run.mkdir()])
    monkeypatch.setattr(geonvs, "finish", lambda *_: None)
    flags = FLAGS.replace("--name=b", "--seed=5")
    for paper in "", "--paper", "--paper=reg", "--paper=alpha,reg":
        assert command(f"{flags} {paper}") == (0, "")
    name = "toy-geonvsw-5"
    assert set(os.listdir("runs")) == {
        "a", name, f"{name}-paper", f"{name}-paper-reg", f"{name}-paper-alpha,reg"}


def test_a_run_is_loaded_in_python_from_any_folder(command, monkeypatch):
    write_folder(toy())
    assert command(f"{FLAGS} --downscale=1 --data=place") == (0, "")
    run = Path("runs/b").resolve()
    saved, _ = geonvs.read_checkpoint(run / "checkpoint.pt", {})
    saved["model"]["cache.volume"].zero_()  # as of a run that was stopped
    torch.save(saved, run / "checkpoint.pt")
    Path("elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    model, scene, codes = geonvs.load_run(run, device="cpu")
    cache = model.cache
    assert os.listdir(".") == []  # nothing was made again
    assert_tensors_close(cache.sdf(cache.points[None])[0], model.signed_distance(cache.points))
    cache.volume.zero_()
    assert_same_tensors(dict(model.state_dict()), dict(saved["model"]))
    assert np.array_equal(codes, np.load(run / "codes.npy"))
    assert_tensors_close(codes[scene.test], model.codes()[scene.test] + 1)  # as they were fitted


def test_a_run_needs_neither_utf8_nor_resource(command, monkeypatch):
    run = RUN.with_name(os.fsdecode(b"\xff\xe9"))
    RUN.rename(run)
    monkeypatch.setitem(sys.modules, "resource", None)  # as on Windows
    assert command(f"--resume --steps=7 --name={run.name}") == (0, "")
    assert command(f"--render --name={run.name}") == (0, "")
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["peak_memory_bytes"] is None
    assert (run / "film.mp4").stat().st_size > 1000


MISTAKES = """
--stepz=3, --steps=many, --steps=0, --levels=9, --rays=10 --photos=3, --device=cuda,
--scene=brandenbrug, --scene=sacre, --data=nowhere, --resume, --render --data=nowhere,
--name=../b, --downscale=2, --name=a --steps=3
"""


@pytest.mark.parametrize("flags", re.split(r",\s", MISTAKES.strip()))
def test_a_mistake_is_one_line_and_changes_no_run(command, flags):
    CHECKPOINT.unlink()  # results are a run, too
    (RUN / "log.jsonl").unlink()
    before = {path: path.read_bytes() for path in RUN.rglob("*.*")}
    assert_refused(command(f"{FLAGS} {flags}"), "")
    assert {path: path.read_bytes() for path in Path("runs").rglob("*.*")} == before


def test_a_full_disk_leaves_the_old_checkpoint(command):
    before = CHECKPOINT.read_bytes()
    import resource  # Windows has none
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))  # a larger file cannot be written
    try:
        answer = command("--resume --name=a --steps=8")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert_refused(answer, "checkpoint.pt")
    assert CHECKPOINT.read_bytes() == before


@cases(
    "problem, word",
    full_disk=(OSError(28, "No space left"), "No space left"),
    ctrl_c=(KeyboardInterrupt(), "--resume"),
    gpu_memory=(torch.OutOfMemoryError("Tried to allocate\n1 GiB"), "fewer --rays"),
    cpu_memory=(RuntimeError("can't allocate memory"), "end other programs"),
    cuda=(RuntimeError("CUDA error: out of memory\nkernel errors ..."), "fewer --rays"),
    cublas=(RuntimeError("CUBLAS_STATUS_ALLOC_FAILED when calling `c`"), "fewer --rays"),
    cudnn=(RuntimeError("cuDNN error: CUDNN_STATUS_NOT_INITIALIZED"), "fewer --rays"))
def test_a_problem_in_training_is_one_line_but_a_bug_is_a_traceback(
        command, monkeypatch, problem, word):
    train = mock.Mock(side_effect=[problem, RuntimeError("shapes do not match")])
    monkeypatch.setattr(geonvs, "train", train)
    assert_refused(command(FLAGS), word)
    with pytest.raises(RuntimeError, match="shapes"):
        command(FLAGS)


@pytest.mark.parametrize("part", ["evaluate", "extract_mesh"])
def test_a_trained_run_outlives_full_memory(command, monkeypatch, part):
    with monkeypatch.context() as patch:
        patch.setattr(geonvs, part, mock.Mock(side_effect=RuntimeError("can't allocate memory")))
        assert_refused(command(FLAGS), "end other programs")
    assert command("--resume --name=b") == (0, "")
    assert Path("runs/b/metrics.json").exists()


def test_a_picture_that_fails_is_one_line(command, monkeypatch, capsys):
    names = np.array([f"deep/{n * 'a'}.jpg" for n in range(241, 249)])  # the last one is too long
    data_prep.write_scene(Path("data/toy.npz"), toy() | dict(name=names, is_test=names >= names[6]))
    monkeypatch.setattr(geonvs, "draw_panel", mock.Mock(side_effect=MemoryError("full")))
    geonvs.run_command_line(lambda: geonvs.main(FLAGS.split()))
    lines = capsys.readouterr().out.splitlines()
    missing = [line.split(":")[0] for line in lines if line.startswith("  no ")]
    assert missing == ["  no panel.png", f"  no {248 * 'a'}.jpg.png"]
    assert {"metrics.json", "mesh.ply", "codes.npy"} < set(os.listdir("runs/b"))
    assert os.listdir("runs/b/held_out/deep") == [f"{247 * 'a'}.jpg.png"]


@pytest.mark.parametrize("name, gpus, device", [
    ("auto", 2, "cuda:1"), ("cpu", 2, "cpu"), ("auto", 0, "cpu")])
def test_each_process_takes_its_own_gpu(monkeypatch, name, gpus, device):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    assert str(geonvs.pick_device(name, geonvs.Processes(2, 1, 1))) == device


CODE = Path(geonvs.__file__).read_text()
LISTED = re.findall(r"^  \[(D\d+)\]", geonvs.__doc__, re.M)


def test_departures_are_listed_and_tagged():
    tagged = re.findall(r"\[(D\d+)\]", CODE.replace(geonvs.__doc__, ""))
    assert LISTED == [f"D{n}" for n in range(1, len(LISTED) + 1)]
    assert set(tagged) == set(LISTED)
    for name in ("README.md", "tutorial.ipynb"):
        text = Path(geonvs.__file__).with_name(name).read_text()
        assert set(re.findall(r"\[(D\d+)\]", text)) <= set(LISTED)


def test_each_setting_is_used_and_explained(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = geonvs.make_parser().format_help()
    for setting in fields(geonvs.Config):
        meaning = setting.metadata["meaning"]
        line, = re.findall(rf"  --{setting.name} .*", text)
        assert line.rstrip().endswith(f"{meaning} [{setting.default}]".removesuffix(" []"))
        assert re.search(rf"\b(cfg|self)\.{setting.name}\b", CODE)
    assert len(text.splitlines()) <= 50  # a screen


# ==== Part II: rivals and experiments =============================================================
#     python test_geonvs.py parts    each equation as printed, each loss and each part left out
#     python test_geonvs.py chart    PSNR over training time: Geo-NVS-w and its rivals
#     python test_geonvs.py grid     the octree against a uniform grid
#     python test_geonvs.py stress   toys on which methods fail
#     python test_geonvs.py draw     chart.png from chart*.csv of this folder
# Flags of geonvs.py apply (--data, --downscale, --minutes, --steps ...) unless a row sets them;
# --seeds is their number. A row is a whole training, scored as by geonvs.py; one that is there
# already is read again. Writes NAME.csv. Shapes beside those of geonvs.py: N Gaussians, B tiles
# with P pixels and D Gaussians each.


# ---- Rival: NeRF-W -------------------------------------------------------------------------------

class Rival(nn.Module):
    """What training and scoring ask of any model, where it does nothing special."""
    octrees = []
    has_mask = False
    batch = geonvs.GeoNVS.batch
    codes = geonvs.GeoNVS.codes

    def __init__(self, cfg, scene):
        super().__init__()
        self.cfg = replace(cfg)
        self.scene = scene

    def groups(self):
        params = list(self.parameters())
        return [dict(params=params, base_lr=self.cfg.lr_net, betas=(0.9, 0.999), eps=1e-8)]

    def do_nothing(self, *_):
        pass

    refresh_cache = bound_zeta = refine = do_nothing

    def render(self, rays, code):
        """Colours under codes (R,A). A rival has no surface: opacity, depth and normals are 0."""
        rgb = self.colors(rays, code)
        none = torch.zeros_like(rgb)
        return geonvs.Rendering(rgb, none[:, 0], none[:, 0], none)


def layers(*sizes):
    """Linear layers with ReLU between them and after the last."""
    parts = []
    for inputs, outputs in zip(sizes, sizes[1:]):
        parts += [nn.Linear(inputs, outputs), nn.ReLU()]
    return nn.Sequential(*parts)


def positional(x, octaves):
    """x (...,n) with sines and cosines of 2^k x: (...,n(1+2 octaves)) (NeRF Eq. 4, no pi)."""
    factor = 2.0 ** torch.arange(octaves, device=x.device)
    angle = (x[..., None] * factor).flatten(-2)
    return torch.cat([x, angle.sin(), angle.cos()], -1)


class RadianceField(nn.Module):
    """NeRF's network: 8 layers with a skip to the fifth, density, then colour. W: width."""
    def __init__(self, width, code_dim, octaves):
        super().__init__()
        self.octaves = octaves  # of positions
        inputs = 3 + 6 * octaves
        self.first = layers(inputs, *[width] * 4)
        self.second = layers(inputs + width, *[width] * 4)
        self.density = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.color = geonvs.mlp(width + 27 + code_dim, width // 2, 3)

    def forward(self, x, d, code):
        """Density (R,S), colour (R,S,3), bottleneck (R,S,W) at x (R,S,3), d (R,3), code (R,A)."""
        pe = positional(x, self.octaves)  # (R,S,3+6 octaves)
        h = self.first(pe)  # (R,S,W)
        h = self.second(torch.cat([pe, h], 2))  # (R,S,W)
        sigma = F.softplus(self.density(h)).squeeze(2)  # (R,S)
        neck = self.bottleneck(h)  # (R,S,W)
        per_ray = torch.cat([positional(d, 4), code], 1)  # (R,27+A)
        return sigma, geonvs.colors_of(self.color, neck, per_ray), neck


class NeRFW(Rival):
    """NeRF-W (Martin-Brualla et al. 2021): appearance codes, transient head with uncertainty. From
    the paper: two networks, 48 + 16 code dims, losses, lambda_u = 0.01; from its PyTorch version:
    width 256, 64 + 64 samples, beta_min 0.03, Adam 5e-4, 1024 rays, SfM near and far."""
    name = "nerfw"
    code_dim = 48

    def __init__(self, cfg, scene):
        super().__init__(cfg, scene)
        octaves = int(1 + math.log2(math.pi / scene.raw["footprint"]))  # the last has two pixels
        self.coarse = RadianceField(cfg.hidden, self.code_dim, octaves)
        self.fine = RadianceField(cfg.hidden, self.code_dim, octaves)
        reach = torch.cdist(scene.c2w[:, :, 3], scene.points[::20])  # (I,Q/20)
        self.far = nn.Buffer(reach.quantile(0.95, dim=1))  # (I,) the farthest points are wild
        self.appearance = nn.Embedding(len(scene.wh), self.code_dim)
        self.transient = nn.Embedding(len(scene.wh), 16)
        half = cfg.hidden // 2
        self.head = nn.Sequential(layers(2 * half + 16, *[half] * 4), nn.Linear(half, 5))

    def colors(self, rays, code):
        return self.trace(rays, code)["rgb"]

    def trace(self, rays, code, other=None, gen=None):
        """Coarse and fine pass with n samples and 2n, as in GeoNVS.trace. other: codes (R,16)
        of the transient head."""
        n = self.cfg.samples
        far = self.far[rays.photo, None]  # (R,1)
        t = torch.lerp(rays.near, far, geonvs.stratified(rays, n, gen))  # (R,n)
        coarse = self.pass_through(self.coarse, rays, t, code)
        weight = coarse["w"].detach() + 1e-3
        share = torch.linspace(0, 1, n + 1, device=code.device)
        edges = torch.lerp(rays.near, far, share)  # (R,n+1)
        t_fine = geonvs.inverse_cdf(edges, weight, geonvs.stratified(rays, n, gen))  # (R,n)
        t, _ = torch.cat([t, t_fine], 1).sort(1)  # (R,2n)
        out = self.pass_through(self.fine, rays, t, code, other)
        return out | dict(coarse=coarse["rgb"])

    def pass_through(self, field, rays, t, code, other=None):
        """Densities to a picture: C = sum T (alpha_s c_s + alpha_t c_t). NeRF-W Eq. 5"""
        sigma, rgb, neck = field(rays.at(t), rays.d, code)  # (R,S), (R,S,3), (R,S,W)
        dt = F.pad(torch.diff(t), (0, 1), value=100.0)  # (R,S), last opaque
        alpha = 1 - torch.exp(-sigma * dt)  # (R,S)
        if other is None:
            w = geonvs.composite(alpha)  # (R,S)
            return dict(rgb=torch.einsum("rs,rsc->rc", w, rgb), w=w)
        other = other[:, None].expand(-1, t.shape[1], -1)  # (R,S,16)
        h = self.head(torch.cat([neck, other], 2))  # (R,S,5)
        sigma_t, rgb_t, beta = h.split([1, 3, 1], 2)
        sigma_t = F.softplus(sigma_t).squeeze(2)  # (R,S)
        alpha_t = 1 - torch.exp(-sigma_t * dt)  # (R,S)
        both = 1 - (1 - alpha) * (1 - alpha_t)  # (R,S)
        w = geonvs.composite(both)  # (R,S)
        trans = w / both.clamp(min=1e-10)  # (R,S)
        w_t = trans * alpha_t  # (R,S)
        static = torch.einsum("rs,rsc->rc", trans * alpha, rgb)
        moving = torch.einsum("rs,rsc->rc", w_t, rgb_t.sigmoid())
        beta = w_t * F.softplus(beta).squeeze(2)
        beta = beta.sum(1) + 0.03
        return dict(rgb=static + moving, sigma_t=sigma_t, beta=beta)

    def losses(self, rays, photos, done, gen):
        """Squared error over learned variance, its log, a penalty on transients. NeRF-W Eq. 13"""
        code = self.appearance(rays.photo)
        out = self.trace(rays, code, self.transient(rays.photo), gen)
        error = ((out["rgb"] - rays.rgb) ** 2).sum(1)  # (R,)
        coarse = ((out["coarse"] - rays.rgb) ** 2).sum(1)
        beta = out["beta"]
        terms = dict(
            coarse=coarse.mean() / 2,
            rgb=(error / (2 * beta**2)).mean(),
            beta=3 + beta.log().mean(),
            sigma=0.01 * out["sigma_t"].mean())
        mse = error.detach().mean() / 3
        return sum(terms.values()), terms | dict(mse=mse)


# ---- Rival: Gaussian splats ----------------------------------------------------------------------

TILE = 4  # rays along an axis that are drawn together in training
REACH = 3.0  # standard deviations after which a Gaussian is left out
BLUR = 0.3  # px^2 added to a projected covariance: a pixel's own width (EWA splatting)
SHELL = 1000  # Gaussians that begin in the sky
FEATURE = 16  # numbers that a Gaussian's colour is made of


def rotation(q):
    """Rotation matrices (N,3,3) of quaternions (N,4) of any length, the real part first."""
    q = F.normalize(q)
    unit = torch.eye(3, device=q.device).expand(len(q), 3, 3)  # its rows are turned
    v = q[:, None, 1:].expand_as(unit)
    once = 2 * torch.linalg.cross(v, unit)
    rows = unit + q[:, :1, None] * once + torch.linalg.cross(v, once)
    return rows.mT


def project(x, axes, K):
    """Gaussians in a camera's axes, centres x (N,3), covariance axes axes^T (N,3,3), as Gaussians
    of the picture: centre (N,2) px, covariance (N,2,2) px^2 = J axes axes^T J^T + BLUR, with the
    slope J of the projection at the centre (EWA splatting, Zwicker et al. 2001; Kerbl et al. 2023
    Eq. 5 and 6)."""
    z = x[:, 2, None]
    slope = x[:, :2] / z  # (N,2)
    center = slope * K[:2] + K[2:]
    one = torch.eye(2, device=x.device)
    J = torch.cat([one.expand(len(x), 2, 2), -slope[:, :, None]], 2)  # (N,2,3)
    J = J * (K[:2] / z)[:, :, None]
    half = J @ axes  # (N,2,3)
    return center, half @ half.mT + BLUR * one


def splat(center, cov, opacity, rgb, xy):
    """Colour (B,P,3) of pixels xy (B,P,2) of tiles, and what passes all Gaussians (B,P), which come
    front first: alpha = opacity exp(-1/2 d^T cov^-1 d), composited as samples of a ray are (Kerbl
    et al. 2023 Eq. 3). A tile's D Gaussians are those that reach its bounding box."""
    variance = cov.detach().diagonal(dim1=1, dim2=2)  # (N,2)
    reach = REACH * variance.sqrt()
    low = xy.amin(1, keepdim=True) - reach  # (B,N,2)
    high = xy.amax(1, keepdim=True) + reach
    is_near = ((center > low) & (center < high)).all(2)  # (B,N)
    rank = torch.arange(len(center), 0, -1, device=center.device)
    D = is_near.sum(1).max().item()
    rank, index = (is_near * rank).topk(D)  # (B,D) front first, then some that are not near
    is_near = rank > 0  # (B,D)

    a, b, _, c = cov.flatten(1).unbind(1)
    inverse = torch.stack([c, -b, a], 1) / (a * c - b * b)[:, None]  # (N,3)
    columns = torch.cat([center, inverse, opacity[:, None], rgb], 1)  # (N,9)
    columns = F.embedding(index, columns)  # (B,D,9)
    center, inverse, opacity, rgb = columns.split([2, 3, 1, 3], 2)
    x, y = (xy[:, :, None] - center[:, None]).unbind(3)  # (B,P,D)
    a, b, c = inverse[:, None].unbind(3)  # (B,1,D)
    power = a * x * x + 2 * b * x * y + c * y * y  # (B,P,D)
    alpha = (opacity * is_near[..., None]).mT * torch.exp(-power / 2)
    w = geonvs.composite(alpha.clamp(max=0.999).flatten(0, 1))  # (BP,D)
    w = w.unflatten(0, xy.shape[:2])
    return w @ rgb, 1 - w.sum(2)


class Splats(Rival):
    """3D Gaussians (Kerbl et al. 2023) with appearance codes: a Gaussian has a feature, a small
    network makes its colour of that and a photo's code. The transient mask is this project's, as
    splats in the wild have one."""
    name = "splats"
    transients = geonvs.GeoNVS.transients

    def __init__(self, cfg, scene):
        super().__init__(cfg, scene)
        radius = scene.points.norm(dim=1).max().clamp(min=3)
        sky = F.normalize(torch.randn(SHELL, 3))
        center = torch.cat([scene.points, 2 * radius * sky])  # (N,3)
        nearest = [
            torch.cdist(some, center).topk(4, largest=False).values
            for some in center.split(1024)]
        gap = torch.cat(nearest)[:, 1:].mean(1, keepdim=True)  # (N,1) to three neighbours
        size = 0.3 * gap.clamp(min=1e-4)  # (N,1)
        N = len(center)
        self.center = nn.Parameter(center)
        self.log_size = nn.Parameter(size.log().repeat(1, 3))
        self.turn = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(N, 1))
        self.opacity = nn.Parameter(torch.zeros(N))
        self.feature = nn.Parameter(0.1 * torch.randn(N + 1, FEATURE))  # the last one of the sky
        self.paint = geonvs.mlp(FEATURE + cfg.appearance_dim, cfg.hidden, 3)
        self.appearance = nn.Embedding(len(scene.wh), cfg.appearance_dim)
        nn.init.normal_(self.appearance.weight, std=0.01)
        self.has_mask = cfg.mask == "on"
        self.mask = geonvs.TransientMask(scene.thumbs) if self.has_mask else None

    def groups(self):
        rates = dict(
            center=2e-3, log_size=5e-2, turn=2e-2, opacity=5e-2, feature=2e-2, paint=2e-3,
            appearance=self.cfg.lr_code, mask=self.cfg.lr_mask)
        return [
            dict(params=[value], base_lr=rates[name.split(".")[0]], betas=(0.9, 0.999))
            for name, value in self.named_parameters()]

    def batch(self, n, gen):
        """A square grid of n rays over a random window of one photo, tile by tile."""
        photos = self.scene.train
        picked = photos[geonvs.random_index(gen, len(photos), 1)]
        size = 0.5 + 0.5 * geonvs.uniform(gen, 1)
        corner = geonvs.uniform(gen, 2) * (1 - size)
        axis = torch.linspace(0, 1, math.isqrt(n), device=gen.device).view(-1, TILE)
        row, col = torch.broadcast_tensors(axis[:, None, :, None], axis[:, None])
        uv = torch.stack([col, row], 4).view(-1, 2) * size + corner  # (R,2)
        wh = self.scene.wh[picked]  # (1,2)
        xy = (uv * (wh - 1)).round().long()  # (R,2)
        pixel = xy[:, 1] * wh[:, 0] + xy[:, 0]
        rays = geonvs.make_rays(self.scene, picked.expand_as(pixel), pixel)
        return rays, picked

    def colors(self, rays, code):
        """The rays of each photo at once, under the code of the first of them. The geometry has no
        gradient here."""
        rgb = torch.zeros_like(rays.rgb)
        for photo in rays.photo.unique().tolist():
            with torch.no_grad():
                view = self.view(photo)
            mine = rays.photo == photo  # (R,)
            xy = rays.uv[mine, None] * self.scene.wh[photo]  # (R,1,2) px, each ray a tile
            rgb[mine] = self.draw(view, code[mine][0], xy)[:, 0]
        return rgb

    def view(self, photo):
        """Which Gaussians a photo sees, front first (N,); their centres (N,2) px and covariances
        (N,2,2) px^2 in it."""
        K = self.scene.K[photo]
        c2w = self.scene.c2w[photo]
        turn = c2w[:, :3]
        x = (self.center - c2w[:, 3]) @ turn  # (N,3) in the camera's axes
        slope, z = x.detach().split([2, 1], 1)
        slope = slope / z
        is_seen = (slope.abs() < self.scene.wh[photo] / K[:2]).all(1)  # in twice the frame
        is_seen &= z[:, 0] > self.scene.near[photo] / 4
        order = z[:, 0].argsort()
        order = order[is_seen[order]]
        axes = turn.T @ rotation(self.turn[order])
        axes = axes * self.log_size[order, None].exp()
        return order, *project(x[order], axes, K)

    def draw(self, view, code, xy):
        """Colours (B,P,3) of pixels xy (B,P,2) of a view under a code (A,)."""
        order, center, cov = view
        feature = torch.cat([self.feature[order], self.feature[-1:]])  # (N+1,F)
        codes = code.expand(len(feature), -1)
        rgb = self.paint(torch.cat([feature, codes], 1))
        rgb = (feature[:, :3] + rgb).sigmoid()
        opacity = self.opacity[order].sigmoid()
        picture, trans = splat(center, cov, opacity, rgb[:-1], xy)
        return picture + trans[..., None] * rgb[-1]

    def losses(self, rays, photos, done, gen):
        """Mean absolute error of rays of one photo, weighted by what the mask leaves."""
        photo = photos.item()
        xy = rays.uv * self.scene.wh[photo]  # px
        tiles = xy.view(-1, TILE**2, 2)
        rgb = self.draw(self.view(photo), self.appearance.weight[photo], tiles)
        rgb = rgb.flatten(0, 1)  # (R,3)
        residual = (rgb - rays.rgb).abs()
        error = residual.detach().amax(1)  # (R,) of the worst channel
        no_edges = torch.zeros_like(error)  # Phi
        left_out, reg, _ = self.transients(rays, photos, no_edges, error, done)
        loss = ((1 - left_out) * residual.mean(1)).mean()
        mse = residual.detach().square().mean()
        return loss + reg, dict(rgb=loss, reg=reg, mse=mse)


# ---- Other forms of the method -------------------------------------------------------------------

class Density(geonvs.GeoNVS):
    """An octree NeRF-W: the field is a density exp(-10 s) instead of a distance."""
    name = "density"

    def sample(self, rays, t0, t1, gen=None):
        """GeoNVS.sample with this density. Lengths are remembered for alpha: first those between
        the probes of the cache, then those between the samples."""
        self.length = (t1 - t0) / geonvs.PROBES  # (R,1)
        t = super().sample(rays, t0, t1, gen)  # (R,S+1)
        self.length = t.diff()  # (R,S)
        return t

    def alpha(self, sdf, zeta=None):
        mean = (sdf[:, :-1] + sdf[:, 1:]) / 2  # (R,S)
        sigma = torch.exp(-10 * mean.clamp(-2, 2))
        return 1 - torch.exp(-sigma * self.length)


class NoNormal(geonvs.GeoNVS):
    """Colours do not see the normal."""

    def shade(self, rays, code, hits, normal):
        return super().shade(rays, code, hits, torch.zeros_like(normal))


class UniformGrid(geonvs.GeoNVS):
    """Every cell of the foreground is split, down to the last level."""
    name = "uniform grid"

    def __init__(self, cfg, scene):
        super().__init__(cfg, scene)
        octree = self.sdf.octree
        for _ in range(octree.levels - 1):
            octree.split(octree.cells)
        nn.init.normal_(octree.features, std=0.01)
        self.cache.refresh(self.signed_distance)

    def refine(self, *_):
        """There is nothing left to split."""


# ---- Experiments and their rows ------------------------------------------------------------------

class Row(NamedTuple):
    """One training of an experiment, but for its seed."""
    settings: dict = {}  # of Config
    kind: type = geonvs.GeoNVS
    toy: dict = {}  # knobs of data_prep.make_toy; none: the scene that flags name
    constants: dict = {}  # of geonvs.py, that have another value


BUDGETS = dict(  # unless --steps or --minutes is given
    parts=dict(steps=1500),
    chart=dict(minutes=1.0),
    grid=dict(steps=1500),
    stress=dict(minutes=0.5))
NO_GEOMETRY = dict(lam_eik=0.0, lam_curv=0.0, lam_sfm=0.0, lam_off=0.0, lam_gpl=0.0)
SMALL = dict(rays=384, hidden=32, lr_net=1e-2, lr_grid=3e-2)  # for budgets under a minute
SPLATS = dict(rays=1024, photos=1, hidden=64)
NERFW = dict(rays=256, photos=256, samples=16, hidden=64, lr_net=5e-3)
METHODS = {  # of chart
    "Geo-NVS-w": Row(),
    "Geo-NVS-w, small": Row(SMALL),
    "density": Row(NO_GEOMETRY, Density),
    "splats": Row(SPLATS, Splats),
    "splats, no mask": Row(SPLATS | dict(mask="off"), Splats),
    "NeRF-W": Row(NERFW, NeRFW)}
PARTS = {
    "Geo-NVS-w": Row(),
    **{f"{name} as printed": Row(dict(paper=name)) for name in geonvs.PRINTED},
    "all as printed": Row(dict(paper=",".join(geonvs.PRINTED))),
    **{f"no L_{name}": Row({f"lam_{name}": 0.0}) for name in ("off", "sfm", "eik", "curv", "lps")},
    "GPL off": Row(dict(lam_gpl=0.0)),
    "GPL ten times": Row(dict(lam_gpl=0.5)),
    "no mask": Row(dict(mask="off")),
    "no codes": Row(dict(appearance="off")),
    "no background": Row(dict(background="off")),
    "no normal as an input": Row(kind=NoNormal),
    "density": METHODS["density"]}
GRID = {"octree": Row(), "uniform grid": Row(kind=UniformGrid)}
STRESS = {  # knobs of a toy, and the row of PARTS without what is made for it
    "plain": (dict(photos=24), "alpha as printed"),
    "hard": (dict(photos=24, occluders=0.25, exposure=2.0, pose_noise=1.0), "no L_sfm"),
    "crowd": (dict(photos=24, occluders=0.4), "no mask"),
    "lights": (dict(photos=24, exposure=2.0), "no codes"),
    "sky": (dict(photos=24, sky=1.0), "reg as printed"),
    "facade": (dict(photos=10, landmark=-1), "no L_off"),
    "few photos": (dict(photos=8), "no L_sfm"),
    "wrong poses": (dict(photos=24, pose_noise=3.0), "no L_curv")}


def chart_rows(given):
    """Every method in turn with a quarter of the budget, the budget, and four times as much."""
    unit = "minutes" if given.get("minutes") else "steps"
    rows = {}
    for share in (0.25, 1, 4):
        budget = type(given[unit])(share * given[unit])  # steps are whole numbers
        for title, row in METHODS.items():
            rows[f"{title} x{share:g}"] = row._replace(settings=row.settings | {unit: budget})
    return rows


def stress_rows():
    """On every toy: the method, small; the same without what is made for the toy; its rivals."""
    rows = {}
    for cell, (toy, part) in STRESS.items():
        rows |= {
            f"{cell}: Geo-NVS-w, small": Row(SMALL, toy=toy),
            f"{cell}: {part}": Row(SMALL | PARTS[part].settings, toy=toy),
            f"{cell}: density": Row(SMALL | NO_GEOMETRY, Density, toy),
            f"{cell}: splats": Row(SPLATS, Splats, toy)}
    return rows


make_toy_once = functools.cache(data_prep.make_toy)


def run_row(run, given, row):
    """Metrics of one training. They are read if the run is there with the same settings; a
    training that diverged is a result, too."""
    cfg = geonvs.make_config(given | row.settings)
    if row.toy:
        arrays = make_toy_once(**row.toy)
    else:
        arrays = data_prep.open_scene(cfg.source, cfg.downscale)
    key = dict(
        config=asdict(cfg),
        scene=json.loads(str(arrays["info"])),
        constants=row.constants,
        method=row.kind.__name__)
    path = run / "row.json"
    saved = json.loads(path.read_text()) if path.exists() else {}
    if saved.get("key") != key:
        data_prep.check(arrays["is_test"].any(), "experiments need held-out photos: see README")
        with mock.patch.dict(vars(geonvs), row.constants):
            saved = dict(key=key, metrics=train_row(cfg, arrays, run, row.kind))
        data_prep.atomic_write(path, lambda part: part.write_text(json.dumps(saved)))
    metrics = saved["metrics"]
    result = metrics.get("failed") or f"{metrics['psnr']:.2f} dB"
    print(f"{run}: {result}", flush=True)
    return metrics


def train_row(cfg, arrays, run, kind):
    """Trains and scores a model of a class; writes log.txt below run. One thread on a CPU is timed
    by its work, as experiments may share a machine."""
    shutil.rmtree(run, ignore_errors=True)  # what was cut off begins anew
    run.mkdir(parents=True)
    device = geonvs.pick_device(cfg.device)
    scene = geonvs.load_scene(arrays, device)
    is_one_thread = device.type == "cpu" and torch.get_num_threads() == 1
    clock = time.process_time if is_one_thread else time.perf_counter
    timed = mock.patch.object(time, "perf_counter", clock)
    replaced = mock.patch.object(geonvs, "GeoNVS", kind)
    with timed, replaced, open(run / "log.txt", "w") as log, contextlib.redirect_stdout(log):
        try:
            model, state = geonvs.train(cfg, scene, run)
            if not issubclass(kind, Rival):
                return geonvs.finish(model, scene, state, run)
            scores, codes = geonvs.evaluate(model, scene)  # it has no surface
            data_prep.write_png(run / "panel.png", geonvs.draw_panel(model, scene, codes))
            return scores | dict(steps=state.step, train_seconds=state.seconds)
        except UserError as error:
            if error.__cause__:  # a full disk is no result of the method
                raise
            return dict(failed=str(error))


def experiment(argv):
    """Trains every row of an experiment with every seed; writes its table and prints it."""
    parser = geonvs.make_parser()
    parser.add_argument("experiment", choices=(*BUDGETS, "draw"))
    parser.add_argument("--seeds", type=int, default=3, help="seeds of every row [3]")
    given = vars(parser.parse_args(argv))
    name = given.pop("experiment")
    seeds = given.pop("seeds")
    data_prep.check(seeds > 0, "--seeds: use a number from 1")
    is_plain = not (given.pop("resume") or given.pop("render"))
    data_prep.check(is_plain, "an experiment goes on by itself: no --resume, no --render")
    if name == "draw":
        draw()
        return
    if not (given.get("steps") or given.get("minutes")):
        given |= BUDGETS[name]
    rows = dict(parts=PARTS, chart=chart_rows(given), grid=GRID, stress=stress_rows())[name]
    source = geonvs.make_config(given).source
    where = Path("runs", f"{name}-{data_prep.scene_path(source).stem}")
    results = defaultdict(list)
    for seed in range(seeds):
        for title, row in rows.items():
            folder = re.sub(r"[^\w.]+", "-", f"{title} {seed}")
            results[title].append(run_row(where / folder, given | dict(seed=seed), row))
    table = [summary(title, runs) for title, runs in results.items()]
    write_table(Path(f"{name}.csv"), table)
    print(markdown(table))


# ---- Tables and figures --------------------------------------------------------------------------

METRICS = (
    "psnr", "psnr_floor", "ssim", "sdf_error", "normal_error", "mask_iou", "mask_edges",
    "mask_flat", "mask_sky", "steps", "train_seconds", "energy_wh", "model_bytes")
COLUMNS = dict(  # of the printed table: title, digits after the point
    psnr=("PSNR, dB", 2),
    ssim=("SSIM", 3),
    sdf_error=("SDF error", 4),
    normal_error=("normals, degrees", 1),
    mask_iou=("IoU", 2))


def summary(title, runs):
    """A line of a table: means and standard deviations over seeds, None if not measured. Trainings
    that failed have diverged."""
    line = dict(row=title, runs=len(runs), failures=sum("failed" in run for run in runs))
    for key in METRICS:
        values = [run[key] for run in runs if run.get(key) is not None]
        line[key] = float(np.mean(values)) if values else None
        line[f"{key}_std"] = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return line


def write_table(path, table):
    text = io.StringIO()
    writer = csv.DictWriter(text, table[0], lineterminator="\n")
    writer.writeheader()
    for line in table:
        writer.writerow(
            {k: f"{v:.5g}" if isinstance(v, float) else v for k, v in line.items()})
    data_prep.atomic_write(path, lambda part: part.write_text(text.getvalue()))


def read_table(path):
    """The lines of a table that have a PSNR; what was not measured is nan."""
    with open(path) as file:
        lines = [line for line in csv.DictReader(file) if line["psnr"]]
    return [
        {k: v if k == "row" else float(v or "nan") for k, v in line.items()}
        for line in lines]


def markdown(table):
    """The table as text: mean ± standard deviation. A column without numbers is left out."""
    keys = [key for key in COLUMNS if any(line[key] is not None for line in table)]
    rows = [["row", *[COLUMNS[key][0] for key in keys]], ["---"] * (1 + len(keys))]
    for line in table:
        failed = f" ({line['failures']} of {line['runs']} failed)" if line["failures"] else ""
        cells = [line["row"] + failed]
        for key in keys:
            _, digits = COLUMNS[key]
            numbers = [line[key], line[f"{key}_std"]]
            cells.append(" ± ".join(f"{x:.{digits}f}" for x in numbers if x is not None) or "–")
        rows.append(cells)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in rows)


def draw():
    """Draws chart.png: a panel for each chart*.csv of this folder."""
    from matplotlib.figure import Figure
    paths = sorted(Path().glob("chart*.csv"))
    data_prep.check(paths, "there is no chart*.csv here: run the experiment chart")
    high = math.ceil(len(paths) / 2)
    figure = Figure(figsize=(13, 4.2 * high), layout="constrained")
    for number, path in enumerate(paths):
        axis = figure.add_subplot(high, 2, number + 1, title=path.stem.removeprefix("chart-"))
        draw_chart(axis, read_table(path))
    data_prep.atomic_write(Path("chart.png"), lambda part: figure.savefig(part, dpi=110))
    print("wrote chart.png")


def spread_out(values, gap):
    """Ascending numbers (N,) moved apart, so that neighbours are at least gap apart: the mean of
    moving them only up and moving them only down."""
    even = gap * np.arange(len(values))
    free = values - even
    up = np.maximum.accumulate(free)
    down = np.minimum.accumulate(free[::-1])[::-1]
    return (up + down) / 2 + even


def draw_chart(axis, table):
    """PSNR over training time: a line a method, and the baseline, with their names at the right. At
    a budget the methods stand side by side, so that none hides another."""
    curves = defaultdict(list)
    for line in table:
        method, _ = line["row"].split(" x")
        curves[method].append([line[key] for key in ("train_seconds", "psnr", "psnr_std")])
    budgets, _, _ = np.transpose(next(iter(curves.values())))  # of the first method
    axis.set(xscale="log", xlabel="training, s", ylabel="PSNR, dB")
    axis.set_xticks(budgets, [f"{seconds:.0f}" for seconds in budgets])
    axis.minorticks_off()
    floor = table[0]["psnr_floor"]
    axis.axhline(floor, color="grey", ls=":")
    ends = [(floor, budgets[-1], "baseline", "grey")]
    for number, (method, curve) in enumerate(curves.items()):
        seconds, psnr, spread = np.transpose(curve)
        seconds = seconds * 1.06 ** (number - len(curves) / 2)
        color = f"C{number}"
        axis.errorbar(seconds, psnr, spread, color=color, marker="osD^vX"[number], capsize=2)
        ends.append((psnr[-1], seconds[-1], method, color))
    ends.sort()  # by PSNR
    low, high = axis.get_ylim()
    heights = spread_out([psnr for psnr, *_ in ends], (high - low) / 17)
    for (psnr, seconds, name, color), height in zip(ends, heights):
        axis.annotate(
            name, (seconds, psnr), (1.04, height), va="center", color=color,
            textcoords=axis.get_yaxis_transform(), arrowprops=dict(arrowstyle="-", color=color))


# ---- Tests of Part II ----------------------------------------------------------------------------

RIVALS = {
    title: row._replace(settings=row.settings | TINY)
    for title, row in METHODS.items() if issubclass(row.kind, Rival)}


def rival(scene, name):
    kind = RIVALS[name].kind
    return kind(geonvs.Config(**RIVALS[name].settings), scene)


# ---- Rivals and other forms

@pytest.mark.parametrize("name", RIVALS)
def test_losses_of_rivals_are_finite_and_reach_every_parameter(scene, name):
    model = rival(scene, name)
    gen = generator()
    rays, photos = model.batch(256, gen)
    loss, terms = model.losses(rays, photos, 0.0, gen)
    loss.backward()
    assert all(value.isfinite().all() for value in terms.values())
    for value in model.parameters():
        assert value.grad.any()


def test_nerfw_mixes_static_and_transient_as_its_equation_says(scene):
    model = rival(scene, "NeRF-W")
    rays, _ = model.batch(64, generator())
    t = torch.tensor([[1.0, 1.5, 1.7]]).repeat(64, 1)
    code = model.codes()[rays.photo]
    other = torch.ones(64, 16)
    sigma, rgb, neck = model.fine(rays.at(t), rays.d, code)
    out = model.pass_through(model.fine, rays, t, code, other)
    passes = 1.0
    color = 0
    beta = 0.03
    for i, dt in enumerate((0.5, 0.2, 100.0)):
        h = model.head(torch.cat([neck[:, i], other], 1))  # (64,5)
        static = 1 - torch.exp(-sigma[:, i, None] * dt)  # (64,1)
        moving = 1 - torch.exp(-F.softplus(h[:, :1]) * dt)
        color += passes * static * rgb[:, i]
        color += passes * moving * h[:, 1:4].sigmoid()
        beta += passes * moving * F.softplus(h[:, 4:])
        passes = passes * (1 - static) * (1 - moving)
    assert_tensors_close(out["rgb"], color, 1e-4)
    assert_tensors_close(out["beta"], beta[:, 0], 1e-4)


def test_opacities_of_a_density_follow_the_lengths_between_its_samples(scene):
    model = Density(geonvs.Config(**TINY), scene)
    rays, _ = model.batch(64, generator())
    t0 = torch.full((64, 1), 0.5)
    t = model.sample(rays, t0, t0 + 2)
    sdf = random(*t.shape, low=-0.3, high=0.3)
    sigma = torch.exp(-5 * (sdf[:, :-1] + sdf[:, 1:]))
    assert_tensors_close(model.alpha(sdf), 1 - torch.exp(-sigma * t.diff()), 1e-4)


def test_a_uniform_grid_has_every_cell_of_its_last_level(scene):
    octree = UniformGrid(geonvs.Config(**TINY), scene).sdf.octree
    assert octree.cells[:, 0].bincount().tolist() == [16**3, 32**3, 64**3]
    assert octree.features.all()


# ---- Splats

def test_splats_equal_a_loop_over_gaussians(monkeypatch):
    monkeypatch.setitem(globals(), "REACH", 9.0)
    center, xy = 20 * torch.rand(9, 2), 20 * torch.rand(5, 6, 2)
    half = 3 * torch.randn(9, 2, 2)
    cov = half @ half.mT + torch.eye(2)
    opacity, rgb = torch.rand(9), torch.rand(9, 3)
    color = torch.zeros(5, 6, 3)
    passes = torch.ones(5, 6, 1)
    for n in range(9):
        d = xy - center[n]  # (5,6,2)
        power = (d @ cov[n].inverse() * d).sum(2, keepdim=True) / 2
        alpha = opacity[n] * torch.exp(-power)  # (5,6,1)
        color += passes * alpha * rgb[n]
        passes *= 1 - alpha
    picture, trans = splat(center, cov, opacity, rgb, xy)
    assert_tensors_close(picture, color, 1e-4)
    assert_tensors_close(trans, passes[..., 0], 1e-4)


def test_a_projected_gaussian_has_the_spread_of_projected_samples():
    x = torch.tensor([[0.4, -0.3, 2.0]])
    turn = rotation(torch.tensor([[0.8, 0.1, -0.5, 0.3]]))
    axes = turn * torch.tensor([0.03, 0.01, 0.02])
    K = torch.tensor([50.0, 70.0, 30.0, 40.0])
    center, cov = project(x, axes, K)
    normal = torch.randn(100_000, 3, generator=generator())
    samples = x + normal @ axes[0].T
    pixels = samples[:, :2] / samples[:, 2:] * K[:2] + K[2:]
    spread = pixels.T.cov() + BLUR * torch.eye(2)
    assert_tensors_close(center[0], pixels.mean(0), 0.02)
    assert_tensors_close(cov[0], spread, 0.02)


def test_a_view_shows_gaussians_where_the_rays_through_them_are(scene):
    model = rival(scene, "splats")
    order, center, _ = model.view(1)
    depth = (model.center[order] - scene.c2w[1, :, 3]) @ scene.c2w[1, :, 2]
    assert (depth.diff() >= 0).all()  # front first
    is_inside = ((center >= 0) & (center < scene.wh[1])).all(1)  # (N,)
    col, row = center[is_inside].long().unbind(1)
    rays = geonvs.make_rays(scene, torch.ones_like(col), row * scene.wh[1, 0] + col)
    to_center = F.normalize(model.center[order[is_inside]] - rays.o)
    assert ((to_center - rays.d).norm(dim=1) < 1.5 / scene.K[1, 0]).all()


def test_splats_render_a_ray_alike_among_any_others(scene):
    model = rival(scene, "splats")
    img = torch.tensor([0, 1, 1, 2]).repeat(25)
    rays = geonvs.random_rays(scene, img, generator())
    code = model.codes()[img]
    together = model.render(rays, code).rgb
    for i in (3, 50):
        ray = geonvs.Rays(*[column[i:i + 1] for column in rays])
        alone = model.render(ray, code[i:i + 1]).rgb
        assert_tensors_close(alone[0], together[i], 1e-4)


# ---- Experiments

@pytest.fixture
def quick_rows(monkeypatch, in_tmp_dir):
    """Trainings take a second, in a folder of their own."""
    monkeypatch.setattr(geonvs, "fit_codes", functools.partial(geonvs.fit_codes, steps=2, n=8))
    monkeypatch.setattr(geonvs, "extract_mesh", lambda model: [np.zeros((0, 3))] * 2)
    monkeypatch.setattr(data_prep, "open_scene", lambda *_: toy())
    monkeypatch.setitem(globals(), "make_toy_once", lambda **knobs: toy())
    methods = {"Geo-NVS-w": Row(), "splats": RIVALS["splats"], "NeRF-W": RIVALS["NeRF-W"]}
    monkeypatch.setitem(globals(), "METHODS", methods)
    monkeypatch.setitem(globals(), "STRESS", {"crowd": STRESS["crowd"]})
    return [f"--{key}={value}" for key, value in TINY.items()]


@functools.cache
def last_line(title):
    """Of a training's log, without its time."""
    run_row(Path(title), TINY, (PARTS | GRID)[title])
    line = Path(title, "log.jsonl").read_text().splitlines()[-1]
    return json.loads(line) | dict(seconds=0)


@pytest.mark.parametrize("title", [*PARTS, "uniform grid"][1:])
def test_each_row_of_parts_and_grid_changes_the_training(quick_rows, title, monkeypatch):
    monkeypatch.setattr(geonvs, "finish", lambda *_: dict(psnr=20.0))
    assert last_line(title) != last_line("Geo-NVS-w")


@pytest.mark.parametrize("name, rows", dict(chart=9, parts=2, grid=2, stress=4).items())
def test_an_experiment_writes_and_prints_a_table_and_reads_trainings_again(
        quick_rows, name, rows, monkeypatch, capsys):
    monkeypatch.setitem(globals(), "PARTS", {k: PARTS[k] for k in ("Geo-NVS-w", "no mask")})
    argv = [name, "--seeds=1", *quick_rows]
    experiment(argv)
    table = Path(f"{name}.csv").read_text()
    assert len(table.splitlines()) == 1 + rows
    assert len(re.findall(r"^\|", capsys.readouterr().out, re.M)) == 2 + rows
    monkeypatch.setattr(geonvs, "train", None)  # nothing is trained again
    experiment(argv)
    assert Path(f"{name}.csv").read_text() == table
    if name != "stress":  # its rows have toys of their own
        monkeypatch.setattr(data_prep, "open_scene", lambda *_: toy(occluders=0.2))
        with pytest.raises(TypeError):  # another scene: it would train
            experiment(argv)
    with pytest.raises(UserError) if name != "chart" else contextlib.nullcontext():
        experiment(["draw"])


def test_a_failed_training_is_a_result_and_a_full_disk_is_none(quick_rows, monkeypatch, capsys):
    clocks = []
    error = UserError("the loss is no longer finite")

    def fail(*_):
        clocks.append(time.perf_counter)
        raise error
    monkeypatch.setattr(geonvs, "train", fail)
    experiment(["grid", "--seeds=2"])
    assert "| octree (2 of 2 failed) |" in capsys.readouterr().out
    assert clocks == [time.process_time] * 4  # one thread is timed by its work
    assert time.perf_counter is not time.process_time
    shutil.rmtree("runs")
    error.__cause__ = OSError("the disk is full")
    with pytest.raises(UserError, match="finite"):
        experiment(["grid"])


def test_a_table_has_mean_and_deviation_of_what_was_measured():
    runs = [
        dict(psnr=20.0, psnr_floor=16.0, ssim=0.5, sdf_error=None),
        dict(psnr=23.0, psnr_floor=16.0, ssim=0.7, sdf_error=None),
        dict(failed="diverged")]
    line = summary("no mask", runs)
    assert line["psnr"] == 21.5
    assert line["psnr_std"] == pytest.approx(1.5 * 2**0.5)  # n - 1
    assert line["sdf_error"] is None
    assert markdown([line, summary("one", runs[:1])]).splitlines() == [
        "| row | PSNR, dB | SSIM |",
        "| --- | --- | --- |",
        "| no mask (1 of 3 failed) | 21.50 ± 2.12 | 0.600 ± 0.141 |",
        "| one | 20.00 | 0.500 |"]


def test_a_chart_shows_each_method_and_the_baseline_and_none_hides_another():
    from matplotlib.figure import Figure
    values = {"ours": [20.0, 24.0], "theirs": [20.0, 24.0], "old": [15.0, 17.0]}
    axis = Figure().subplots()
    draw_chart(axis, [
        dict(row=f"{method} x{i}", train_seconds=[15, 60][i], psnr=values[method][i],
             psnr_std=0.5, psnr_floor=16.0)
        for i in range(2) for method in values])
    assert axis.get_xscale() == "log"
    assert set(axis.lines[0].get_ydata()) == {16.0}
    curves = [curve.lines[0].get_xydata() for curve in axis.containers]
    for curve, psnr in zip(curves, values.values(), strict=True):
        np.testing.assert_array_equal(curve[:, 1], psnr)
        assert_arrays_close(np.log(curve[:, 0] / [15, 60]), 0, atol=0.1)
    assert (abs(np.log(curves[0] / curves[1])[:, 0]) > 0.03).all()
    heights = {text.get_text(): text.xyann[1] for text in axis.texts}
    assert set(heights) == {"baseline", *values}
    assert heights["theirs"] - heights["ours"] > 0.5 and abs(heights["old"] - 17) < 0.5


def test_numbers_that_are_close_are_spread_out_in_their_order():
    assert_arrays_close(spread_out([1.0, 1.5, 5.0], 1), [0.75, 1.75, 5])
    moved = spread_out([2.9, 3.0, 3.0, 9.0], 0.5)
    assert (np.diff(moved) > 0.499).all()
    assert moved[3] == 9


if __name__ == "__main__":
    geonvs.run_command_line(lambda: experiment(sys.argv[1:]))
