"""Tests of data_prep.py: scene files, the toy, COLMAP folders as people have them, downloads."""
import contextlib
import functools
import http.server
import io
import json
import os
import pickle
import shutil
import struct
import sys
import tarfile
import threading
import tracemalloc
import zipfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import data_prep
from data_prep import UserError

TINY_TOY = dict(size=32, photos=6, test=2)


@functools.cache
def toy(**knobs):
    return data_prep.make_toy(**{**TINY_TOY, **knobs})


def run_main(*argv):
    """Exit code, stdout and stderr of the command line."""
    code = 0
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            data_prep.main(list(map(str, argv)))
        except SystemExit as e:
            code = e.code
    return code, out.getvalue(), err.getvalue()


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def photo(scene, i, key="rgb"):
    w, h = scene["wh"][i]
    pixels = scene[key][scene["start"][i]:scene["start"][i + 1]]
    return pixels.reshape(h, w, *pixels.shape[1:])


def world(scene, x):
    return x * scene["scale"] + scene["center"]


def own_points(scene, i):
    own = scene["track_point"][scene["track_photo"] == i]
    return scene["points"][own].astype(float)


def info(scene):
    return json.loads(str(scene["info"]))


def same(a, b, *keys):
    for key in keys or a:
        is_float = np.asarray(a[key]).dtype.kind == "f"
        if not np.array_equal(a[key], b[key], equal_nan=is_float):
            return False
    return True


# ---- progress and scene files --------------------------------------------------------------------
def told(monkeypatch, capsys, seconds, count, is_terminal):
    clock = [100.0]
    monkeypatch.setattr(data_prep.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(sys.stdout, "isatty", lambda: is_terminal, raising=False)
    seen = []
    for item in data_prep.progress(range(count), "counting"):
        seen.append(item)
        clock[0] += seconds
    assert seen == list(range(count))
    return capsys.readouterr().out


@pytest.mark.parametrize("seconds, count, numbers", [
    (.9, 10, []), (1.01, 10, [10]), (4, 5, [3, 4, 5]), (.5, 26, [21, 24, 26])])
def test_on_a_terminal_one_line_tells_progress_after_ten_seconds(
        seconds, count, numbers, monkeypatch, capsys):
    out = told(monkeypatch, capsys, seconds, count, True)
    lines = [f"  counting: {n} of {count}, {seconds * (count - n):.0f} s left " for n in numbers]
    assert out == "".join("\r" + line for line in lines) + "\n" * bool(numbers)


@pytest.mark.parametrize("seconds, count, numbers", [
    (.9, 10, []), (1.01, 10, [10]), (25, 9, [3, 6, 9]), (25, 4, [3, 4])])
def test_in_a_log_file_progress_takes_a_line_a_minute_and_one_at_the_end(
        seconds, count, numbers, monkeypatch, capsys):
    out = told(monkeypatch, capsys, seconds, count, False)
    assert [int(line.split()[1]) for line in out.splitlines()] == numbers
    assert "\r" not in out


def test_a_scene_survives_its_file_and_has_the_documented_arrays(tmp_path):
    scene = toy(landmark=2)
    data_prep.write_scene(tmp_path / "toy.npz", scene)
    back = data_prep.read_scene(tmp_path / "toy.npz")
    assert same(scene, back)
    assert set(back) == set(data_prep.FORMAT) | {"depth", "occluder"}
    assert back["depth"].dtype == np.float16
    assert back["depth"].shape == back["occluder"].shape == (back["start"][-1],)
    assert info(back).items() >= dict(TINY_TOY, kind="toy", landmark=2, sun=0.0).items()


def test_a_toy_depends_on_its_seed_alone():
    assert same(toy(), data_prep.make_toy(**TINY_TOY))
    assert not same(toy(), toy(seed=1), "c2w")


def zipped(scene, save=np.savez):
    file = io.BytesIO()
    save(file, **scene)
    return file.getvalue()


@pytest.fixture(scope="module")
def stored():
    scene = data_prep.make_toy(size=16, photos=4, test=1)
    return scene, zipped(scene)


def accepts(path, data):
    """Whether the bytes are read as a scene, which is then used; refusal is one sentence."""
    path.write_bytes(data)
    try:
        scene = data_prep.read_scene(path)
    except UserError as e:
        assert "\n" not in str(e)
        return False
    assert all(photo(scene, i).size for i in range(5))
    assert np.isfinite(scene["points"][scene["track_point"]]).all()
    assert scene["c2w"][scene["track_photo"]].size
    return True


def flipped(data, bits):
    data = bytearray(data)
    for at in bits:
        data[at // 8] ^= 1 << at % 8
    return bytes(data)


@pytest.mark.parametrize("seed", range(10))
def test_damaged_scene_files_do_no_harm(tmp_path, stored, seed):
    path, good = tmp_path / "s.npz", stored[1]
    rng = np.random.default_rng(seed)
    head, directory = good.find(b"NUMPY"), good.find(b"PK\1\2")
    for low, high in (0, len(good)), (directory, len(good)), (head, head + 120):
        accepts(path, flipped(good, rng.integers(8 * low, 8 * high, 1 + seed % 4)))
    assert not accepts(path, good[:rng.integers(len(good) - 23)])
    assert not accepts(path, rng.bytes(10 * seed))


@pytest.mark.parametrize("key", sorted(data_prep.FORMAT))
def test_scene_files_with_a_wrong_array_are_refused(tmp_path, stored, key):
    scene, path = stored[0], tmp_path / "s.npz"
    array = np.asarray(scene[key])
    wrong = [np.array(0), np.zeros((5, 0)), np.array("x"), np.array("[1]"), np.array("{}"),
             np.full(5, np.nan), np.full(5, -1), np.ones(5, bool), array[..., None]]
    wrong.append(array[:-1] if array.ndim else array[None])
    if array.dtype.kind == "f":
        wrong.append(array.astype(">f8"))
        if key != "bg_color":
            wrong.append(array * np.inf)
    if key in ("scale", "footprint", "start", "wh"):
        wrong.append(array - array.max() - 1)
    if key.startswith("track_p"):
        wrong += [array * 0 - 1, array + array.max() + 1, array + 10 ** 6]
    if key == "is_test":
        wrong.append(array | True)
    without = {k: v for k, v in scene.items() if k != key}
    assert not accepts(path, zipped(without))
    for value in wrong:
        assert not accepts(path, zipped(without | {key: value})), value


def peak(call, *args):
    """The result, and the bytes that Python and numpy take at most."""
    tracemalloc.start()
    result = call(*args)
    size = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return result, size


def test_zip_bombs_are_refused_unread(tmp_path, stored):
    big = np.zeros((2 ** 24, 3), np.uint8)
    bomb = zipped(stored[0] | dict(rgb=big), np.savez_compressed)
    is_accepted, size = peak(accepts, tmp_path / "s.npz", bomb)
    assert not is_accepted
    assert size < 2 ** 22


@pytest.mark.parametrize("count", [10 ** 5, 2 ** 31, 2 ** 40, 2 ** 62, 2 ** 80])
def test_promised_shapes_are_refused(tmp_path, stored, count):
    path = tmp_path / "s.npz"
    with zipfile.ZipFile(path, "w") as file:
        for key, value in stored[0].items():
            head = np.lib.format.header_data_from_array_1_0(value)
            if key == "rgb":
                head["shape"] = count, 3
            array = io.BytesIO()
            np.lib.format.write_array_header_1_0(array, head)
            file.writestr(f"{key}.npy", array.getvalue() + value.tobytes())
    assert not accepts(path, path.read_bytes())


class Evil(str):
    """Makes a folder of this name when it is unpickled."""
    def __reduce__(self):
        return os.mkdir, (str(self),)


def test_a_scene_file_never_runs_code(tmp_path, stored):
    path, harm = tmp_path / "s.npz", tmp_path / "harm"
    evil = np.array([Evil(harm)] * 5, object)
    assert not accepts(path, zipped(stored[0] | dict(name=evil)))
    assert not accepts(path, zipped(stored[0] | dict(more=evil)))
    assert not accepts(path, pickle.dumps(Evil(harm)))
    assert not harm.exists()
    pickle.loads(pickle.dumps(Evil(harm)))
    assert harm.exists()   # it was live


@pytest.mark.parametrize("error, raised", [
    (OSError(28, "No space left"), UserError), (KeyboardInterrupt(), KeyboardInterrupt)])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, error, raised):
    path = tmp_path / "sub" / "sub" / "scene.npz"
    data_prep.atomic_write(path, lambda part: part.write_text("old"))

    def write(part):
        assert part.suffix == ".npz"
        part.write_text("half")
        raise error
    with pytest.raises(raised):
        data_prep.atomic_write(path, write)
    with pytest.raises(UserError, match="encode"):   # as cv2.imwrite says no
        data_prep.atomic_write(path, lambda part: bool(part.write_text("")))
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["scene.npz"]


# ---- the toy -------------------------------------------------------------------------------------
def test_cameras_are_rotations_that_stand_upright():
    scene = toy(pose_noise=3.0)
    R = scene["c2w"][:, :, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), [np.eye(3)] * 8, atol=1e-12)
    assert (np.linalg.det(R) > 0).all()
    assert (R[:, 2, 1] < -.5).all()   # y is down


@pytest.mark.parametrize("number", [1, 2, 10])
def test_every_landmark_is_another_building_that_stands_in_the_unit_sphere(number):
    first, parts = data_prep.LANDMARK, data_prep.toy_parts(number, False)
    scene = toy(landmark=number)
    assert np.array_equal(parts[:, 0], first[:, 0])
    assert np.abs(parts[:, 1:4] - first[:, 1:4]).max() > .1
    assert (parts[:, 8] != first[:, 8]).any()
    balls = parts[parts[:, 0] == 3]
    assert np.array_equal(balls[:, 4], balls[:, 5])   # they stay round
    for i, (_, x, y, z, half, *_) in enumerate(parts):
        foot = np.array([[x, y, z - half]])
        others = [data_prep.part_sdf(part, foot)[0] for part in np.delete(parts, i, 0)]
        assert z - half < 1e-9 or min(others) < .02   # nothing hangs in the air
    rng = np.random.default_rng(0)
    x = rng.uniform([-1.2, -.8, 0], [1.2, .8, 2.4], (60_000, 3))
    x = x * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN
    inside = x[data_prep.toy_sdf(x, False, number) < 0]
    reach = np.linalg.norm((inside - scene["center"]) / scene["scale"], axis=1).max()
    assert .75 < reach
    assert reach < 1


@pytest.mark.parametrize("knobs", [{}, dict(background=False), dict(occluders=.2, background=False)])
def test_background_is_one_colour_exactly_when_most_rays_beyond_the_sphere_agree(knobs):
    scene = toy(**knobs)
    seen = []
    for i in np.flatnonzero(~scene["is_test"]):
        c2w = scene["c2w"][i]
        d = data_prep.rays(scene["K"][i], c2w, *scene["wh"][i])
        steps = c2w[:, 3] + np.linspace(0, 20, 1000)[:, None, None] * d
        misses = np.linalg.norm(steps, axis=2).min(0) > 1
        seen.append(photo(scene, i).reshape(-1, 3)[misses] / 255)
    seen = np.concatenate(seen)
    agree = (np.abs(seen - np.median(seen, 0)) < .02).all(1).mean()
    is_one = agree > .6 and len(seen) > 100   # in the last scene too few
    expected = np.median(seen, 0) if is_one else [np.nan] * 3
    np.testing.assert_allclose(scene["bg_color"], expected)


def test_near_and_footprint_agree_with_naive_loops():
    scene = toy(exposure=0.0, occluders=0.0)
    sizes = []
    for i, c2w in enumerate(scene["c2w"]):
        distances = [np.linalg.norm(x - c2w[:, 3]) for x in own_points(scene, i)]
        assert np.isclose(scene["near"][i], .8 * np.quantile(distances, .02), rtol=1e-5)
        uv = data_prep.project(scene["K"][i], c2w, own_points(scene, i))[0] / scene["wh"][i]
        places = scene["track_uv"][scene["track_photo"] == i]
        np.testing.assert_allclose(places, np.clip(uv, -1, 2), atol=1e-6)
        for x, distance in zip(own_points(scene, i), distances):
            if not scene["is_test"][i] and np.linalg.norm(x) < 1:
                sizes.append(distance / scene["K"][i, 0])
    assert np.isclose(scene["footprint"], np.quantile(sizes, .25), rtol=1e-5)


def test_near_of_cameras_without_points_and_within_their_only_point():
    scene = toy()
    some = np.isin(scene["track_photo"], (1, 2))
    c2w = scene["c2w"].copy()
    c2w[1, :, 3] = scene["points"][0]
    point = np.where(scene["track_photo"] == 1, 0, scene["track_point"])
    photos = scene["track_photo"][some]
    changed = dict(scene, c2w=c2w, track_photo=photos, track_point=point[some])
    near = data_prep.statistics(changed)["near"]
    np.testing.assert_allclose(near[[0, 1, 7]], (.05, .02, .05), rtol=1e-6)


def test_exposure_spread_is_the_deviation_of_brightness_of_training_photos():
    scene = toy(exposure=0.0, occluders=0.0)
    offset = np.random.default_rng(0).uniform(-40, 40, len(scene["wh"]))
    rgb = scene["rgb"] * 0.5 + 64 + np.repeat(offset, np.diff(scene["start"]))[:, None]
    changed = dict(scene, rgb=rgb.round().astype(np.uint8))
    found = data_prep.statistics(changed)["exposure_spread"]
    assert scene["exposure_spread"] < .01
    assert abs(found / (offset[~scene["is_test"]] / 255).std() - 1) < .5


@pytest.mark.parametrize("knobs", [{}, dict(background=False), dict(landmark=4)])
def test_depth_is_where_the_distance_function_first_vanishes(knobs):
    scene = toy(**knobs)

    def sdf(x):
        return data_prep.toy_sdf(world(scene, x), **knobs) / scene["scale"]
    for i in range(8):
        o = scene["c2w"][i, :, 3]
        d = data_prep.rays(scene["K"][i], scene["c2w"][i], *scene["wh"][i])
        t = photo(scene, i, "depth").ravel().astype(float)
        hit = t < 8
        assert np.abs(sdf(o + t[hit, None] * d[hit])).max() < 8 * 2 ** -10
        for share in np.linspace(0, .99, 12):   # nothing is in between, nor before the sky
            before = o + share * np.minimum(t, 12)[:, None] * d
            assert (sdf(before) > -1e-3).mean() > .999


def test_rays_are_unit_and_go_through_the_centres_of_their_pixels():
    scene = toy()
    K, c2w = scene["K"][1], scene["c2w"][1]
    w, h = scene["wh"][1]
    d = data_prep.rays(K, c2w, w, h)
    uv, distance = data_prep.project(K, c2w, c2w[:, 3] + 2.5 * d)
    centres = [(u + .5, v + .5) for v in range(h) for u in range(w)]
    np.testing.assert_allclose(uv, centres, atol=1e-9)
    np.testing.assert_allclose(distance, 2.5)
    behind, _ = data_prep.project(K, c2w, c2w[:, 3] - d)
    assert (behind < -1e8).all()


@pytest.mark.parametrize("part", [
    (1, .1, .2, .3, .3, .4, .4, .2, 0), (1, 0, 0, 0, .2, .5, 0, .3, 0),
    (3, 0, .1, 0, .5, .5, .5, np.inf, 0), (2, .1, 0, 0, .4, .3, .1, np.inf, 0)])
def test_the_distance_to_a_part_agrees_with_dense_samples_of_its_surface(part):
    rng = np.random.default_rng(1)
    part = np.array(part)
    x = rng.uniform(-1, 1, (150, 3))
    surface = rng.uniform(-.9, .9, (400_000, 3))
    surface = surface[np.abs(data_prep.part_sdf(part, surface)) < .004]
    distance = data_prep.part_sdf(part, x)
    brute = np.array([np.linalg.norm(surface - p, axis=1).min() for p in x])
    outside = distance > 0
    assert np.abs(distance - brute)[outside].max() < .07


def test_rays_from_above_hit_the_tops_of_finial_tower_plinth_and_ground():
    o = np.array([[-.05, .22, 9], [.87, .18, 9], [.9, -.5, 9], [3, -3, 9]])
    down = np.array([[1e-6, 1e-6, -1]] * 4)
    parts = data_prep.toy_parts(0, True)
    t, which = data_prep.trace(o, down, parts, True)
    np.testing.assert_allclose(t, 9 - np.array([1.825, 1.5, .1, 0]), atol=1e-4)
    tops = data_prep.GOLD, data_prep.SLATE, data_prep.STONE
    assert parts[which[:3], 8].tolist() == list(tops)
    assert which[3] == -1


@pytest.mark.parametrize("side", [1, -1])
def test_the_wall_that_faces_the_sun_is_brighter(side):
    rng = np.random.default_rng(1)
    o = np.column_stack([rng.uniform(.95, 1.03, 99), np.full(99, -3.0), rng.uniform(.9, 1, 99)])
    parts = data_prep.toy_parts(0, False)
    sun = data_prep.SUN * (1, side, 1)
    front = data_prep.shade(o, np.tile([1e-6, 1, 1e-6], (99, 1)), parts, False, sun).mean()
    o = o * (1, -1, 1)
    back = data_prep.shade(o, np.tile([1e-6, -1, 1e-6], (99, 1)), parts, False, sun).mean()
    assert (front > 2 * back) == (side == 1)
    assert (back > 2 * front) == (side == -1)


def test_a_building_casts_its_shadow_away_from_the_sun():
    parts = data_prep.toy_parts(0, True)
    away = -data_prep.SUN[:2] / np.linalg.norm(data_prep.SUN[:2])
    down = np.array([[0, 0, -1.0]])
    places = [(*(sign * 1.2 * away + (.87, .18)), 5.0) for sign in (1, -1)]   # of the tower
    shadow, free = (data_prep.shade(np.array([o]), down, parts, True, data_prep.SUN).mean()
                    for o in places)
    assert shadow < .6 * free


def test_the_sun_turns_from_photo_to_photo_and_moves_nothing_else():
    plain, other = toy(exposure=0.0), toy(exposure=0.0, sun=90.0)
    changed = np.abs(plain["rgb"].astype(float) - other["rgb"]).max(1) > 20
    assert same(plain, other, "c2w", "K", "points", "depth", "occluder", "track_point", "scale")
    assert changed.mean() > .05
    assert changed[np.isinf(plain["depth"])].mean() < .1 * changed.mean()   # the sky stays


def test_people_cover_their_share_of_training_photos_and_nothing_else_changes():
    plain = toy(exposure=0.0, occluders=0.0, photos=16)
    other = toy(exposure=0.0, occluders=.3, photos=16)
    free = ~other["occluder"]
    shares = np.array([photo(other, i, "occluder").mean() for i in range(18)])
    training = shares[~other["is_test"]]
    assert np.array_equal(plain["rgb"][free], other["rgb"][free])
    assert (other["rgb"][~free] > plain["rgb"][~free] + 50.0).mean() > .05   # in colours
    assert abs(training.mean() / .3 - 1.15) < .45
    assert max(training) > 2 * min(training)
    assert not shares[other["is_test"]].any()
    assert not plain["occluder"].any()


def test_exposure_spreads_the_brightness_of_photos():
    plain, one, two = (toy(exposure=e, occluders=0.0, photos=16) for e in (0.0, 1.0, 2.0))
    spread = []
    for scene in (one, two):
        ratios = [photo(scene, i).mean() / photo(plain, i).mean() for i in range(18)]
        spread.append(np.std(ratios))
    assert spread[0] > .03
    assert spread[1] > 1.3 * spread[0]


def test_points_lie_on_surfaces_but_for_noise_and_a_few_wild_ones():
    scene = data_prep.make_toy(size=48, photos=12, test=2, exposure=0.0)
    x = world(scene, scene["points"].astype(float))
    miss = np.abs(data_prep.toy_sdf(x)) / scene["scale"]
    assert abs(np.median(miss) - .0035) < .0025
    assert abs((miss > .03).mean() - .025) < .0245
    assert len(x) > 1000
    assert np.bincount(scene["track_point"]).min() >= 2
    hidden = 0
    colour = np.full((14, len(x), 3), np.nan)
    for i in range(14):
        uv, distance = data_prep.project(scene["K"][i], scene["c2w"][i], own_points(scene, i))
        u, v = np.clip(uv.astype(int), 0, scene["wh"][i] - 1).T
        colour[i, scene["track_point"][scene["track_photo"] == i]] = photo(scene, i)[v, u]
        hidden += (photo(scene, i, "depth")[v, u] < .8 * distance).sum()
        assert photo(scene, i, "occluder")[v, u].mean() < .1
    assert hidden < .06 * len(scene["track_photo"])
    assert np.nanstd(colour, axis=0).mean() < .5 * np.nanstd(colour)   # alike in all photos


def test_pose_noise_moves_training_photos_by_that_many_pixels_and_no_test_photo():
    knobs = dict(size=20, photos=40, test=3, occluders=0.0)
    clean, noisy = data_prep.make_toy(**knobs), data_prep.make_toy(pose_noise=2.0, **knobs)
    x = (np.array([[0, 0, .7]]) * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN - clean["center"])
    shift = []
    for K, a, b in zip(clean["K"], clean["c2w"], noisy["c2w"]):
        places = [data_prep.project(K, pose, x / clean["scale"])[0][0] for pose in (a, b)]
        shift.append(places[0] - places[1])
    shift = np.array(shift)
    rms = np.sqrt((shift[~clean["is_test"]] ** 2).sum(1).mean())
    moved = np.abs(clean["c2w"] - noisy["c2w"])
    assert same(clean, noisy, "rgb", "K", "points", "scale", "center")
    assert abs(rms - 2.1) < .7
    assert not shift[clean["is_test"]].any()
    assert moved[..., 3].max() > .01
    assert moved[..., :3].max() > .01


# ---- the sphere ----------------------------------------------------------------------------------
def ball(count, radius=1.0, centre=(0, 0, 0)):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return centre + radius * rng.random((count, 1)) ** (1 / 3) * x


def sphere(xyz, views, tracks, is_test=None, error=0, contain=()):
    """The scene of black photos that see these points."""
    n = len(tracks)
    points = np.column_stack([xyz, np.zeros(len(xyz)) + error, np.zeros(len(xyz)) + views])
    is_test = np.zeros(n, bool) if is_test is None else np.array(is_test)
    c2w = np.tile(np.eye(4)[:3], (n, 1, 1))
    black = [np.zeros((2, 2, 3), np.uint8)] * n
    names = [f"{i}.png" for i in range(n)]
    return data_prep.finish(black, np.ones((n, 4)), c2w, is_test, names, points, tracks, {}, contain)


def test_the_sphere_holds_a_ball_of_points_wherever_and_however_large_it_is():
    seen = [np.arange(2000)] * 2
    scene = sphere(ball(2000), 20, seen)
    moved = sphere(ball(2000) * 3 + [5, 6, 7], 20, seen)
    assert np.linalg.norm(scene["center"]) < .05
    assert abs(scene["scale"] - 1.08) < .03
    np.testing.assert_allclose(moved["center"], scene["center"] * 3 + [5, 6, 7], atol=1e-6)
    np.testing.assert_allclose(moved["scale"], 3 * scene["scale"])
    np.testing.assert_allclose(world(scene, scene["c2w"][:, :, 3]), 0, atol=1e-12)


@pytest.mark.parametrize("share, distance", [(.06, 10), (.1, 30), (.3, 20), (.01, 1e6)])
def test_a_skyline_and_wild_points_do_not_blow_up_the_sphere(share, distance):
    far = ball(int(2000 * share))
    far *= distance / np.linalg.norm(far, axis=1, keepdims=True)
    xyz = np.concatenate([ball(2000), far])
    scene = sphere(xyz, 20, [np.arange(len(xyz))] * 2)
    assert abs(scene["scale"] - 1.08) < .1
    assert np.linalg.norm(scene["center"]) < .2


def test_points_that_many_photos_see_count_for_more_up_to_twenty():
    xyz = np.concatenate([ball(2000), ball(1500, 1, (3, 0, 0))])
    seen = [np.arange(3500)] * 2
    rare = sphere(xyz, np.repeat([20, 3], [2000, 1500]), seen)
    often = sphere(xyz, np.repeat([900, 20], [2000, 1500]), seen)
    equal = sphere(xyz, 20, seen)
    assert rare["center"][0] < .5 * equal["center"][0]
    assert np.array_equal(often["center"], equal["center"])


def test_the_sphere_grows_until_most_training_photos_see_their_points_and_holds_what_it_must():
    xyz = np.concatenate([ball(2000), ball(300, 1, (40, 0, 0))])
    views = np.repeat([20, 3], [2000, 300])
    tracks = [np.arange(100), 2000 + np.arange(150), 2150 + np.arange(150)]
    assert sphere(xyz, views, tracks)["scale"] > 30
    assert sphere(xyz, views, tracks, (False, True, True))["scale"] < 1.2
    scene = sphere(xyz, views, tracks[:1] * 2)
    larger = sphere(xyz, views, tracks[:1] * 2, contain=scene["center"] + [[0, 3, 4], [1, 0, 0]])
    assert np.isclose(larger["scale"], 5.1)


def test_points_of_three_views_and_small_errors_are_kept_if_there_are_500_of_them():
    xyz = ball(2300)
    views = np.repeat([2, 3], [1750, 550])
    error = np.arange(2300) % 550 / 100
    scene = sphere(xyz, views, [np.arange(2300)] * 2, error=error)
    good = np.flatnonzero((views == 3) & (error <= np.quantile(error[views == 3], .95)))
    np.testing.assert_allclose(world(scene, scene["points"].astype(float)), xyz[good], atol=1e-4)
    assert np.array_equal(scene["track_point"], np.tile(np.arange(len(good)), 2))
    assert np.array_equal(scene["track_photo"], np.repeat([0, 1], len(good)))
    assert len(sphere(xyz[:2249], views[:2249], [np.arange(2249)] * 2)["points"]) == 2249


# ---- COLMAP folders ------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def source():
    return data_prep.make_toy(size=40, photos=8, test=2)


def colmap_model(scene, model=1, bend=()):
    """Records of a scene: cameras {id: }, images and points, to be changed and written."""
    cameras, images, tracks = {}, [], {}
    for i, name in enumerate(map(str, scene["name"])):
        fx, fy, cx, cy = scene["K"][i]
        focal = (fx, fy) if model in (1, 4, 6) else (fx,)
        w, h = map(int, scene["wh"][i])
        cameras[3 * i + 7] = SimpleNamespace(model=model, w=w, h=h, numbers=(*focal, cx, cy, *bend))
        R = scene["c2w"][i, :, :3].T
        turn = cv2.Rodrigues(R)[0].ravel()
        angle = np.linalg.norm(turn)
        q = 2.5 * np.array([np.cos(angle / 2), *np.sin(angle / 2) * turn / angle])   # any length
        own = scene["track_point"][scene["track_photo"] == i].tolist()
        for j, point in enumerate(own):
            tracks.setdefault(point, []).append((i + 50, j))
        ids = [5 * point + 2 ** 40 for point in own] + [2 ** 64 - 1]   # a corner without a point
        t = -R @ world(scene, scene["c2w"][i, :, 3])
        images.append(SimpleNamespace(id=i + 50, q=q, t=t, camera=3 * i + 7, name=name, points=ids))
    points = []
    for k, track in tracks.items():
        x = world(scene, scene["points"][k].astype(float))
        points.append(SimpleNamespace(id=5 * k + 2 ** 40, x=x, error=.5, track=track))
    return SimpleNamespace(cameras=cameras, images=images[::-1], points=points)


def write_model(folder, model):
    cameras, images, points = [], [], []
    for key, c in model.cameras.items():
        numbers = struct.pack(f"<{len(c.numbers)}d", *c.numbers)
        cameras.append(struct.pack("<iiQQ", key, c.model, c.w, c.h) + numbers)
    for i in model.images:
        seen = b"".join(struct.pack("<ddQ", 1.5, 2.5, key) for key in i.points)
        head = struct.pack("<I7dI", i.id, *i.q, *i.t, i.camera) + i.name.encode() + b"\0"
        images.append(head + struct.pack("<Q", len(i.points)) + seen)
    for p in model.points:
        track = b"".join(struct.pack("<II", *pair) for pair in p.track)
        head = struct.pack("<Q3d3BdQ", p.id, *p.x, 1, 2, 3, p.error, len(p.track))
        points.append(head + track)
    folder.mkdir(parents=True, exist_ok=True)
    for name, records in dict(cameras=cameras, images=images, points3D=points).items():
        data = struct.pack("<Q", len(records)) + b"".join(records)
        (folder / f"{name}.bin").write_bytes(data)


def write_folder(folder, scene, images="dense/images", sparse="dense/sparse", **how):
    """Photos, model and split table; the model's records."""
    model = colmap_model(scene, **how)
    write_model(folder / sparse, model)
    rows = ["id\tsplit\tfilename\tdataset"]
    for i, name in enumerate(map(str, scene["name"])):
        path = folder / images / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), photo(scene, i)[..., ::-1])
        part = "test" if scene["is_test"][i] else "train"
        rows.append(f"{i}.0\t{part}\t{name}\ttoy")
    (folder / "toy.tsv").write_text("\n".join(rows) + "\n")
    return model


@pytest.fixture
def model(desk, source):
    return write_folder(desk / "place", source)


SPARSE = Path("place/dense/sparse")
IMAGES = Path("place/dense/images")
TABLE = Path("place/toy.tsv")
PHOTO = IMAGES / "toy_000.png"   # for training; toy_002 and toy_007 are held out
LAYOUTS = [("dense/images", "dense/sparse"), ("images", "sparse/0"), ("images", "colmap/sparse/0"),
           ("images", "."), ("dense/0/images", "dense/0/sparse"), ("input", "distorted/sparse/0"),
           (".", "sparse")]


@pytest.mark.parametrize("images, sparse", LAYOUTS)
def test_a_scene_survives_the_way_through_colmap_files_wherever_they_lie(
        desk, source, images, sparse):
    write_folder(desk / "place", source, images, sparse)
    scene = data_prep.prepare("place", downscale=1)
    assert same(scene, source, "rgb", "is_test", "name", "wh", "start")
    np.testing.assert_allclose(scene["K"], source["K"], atol=1e-9)
    np.testing.assert_allclose(scene["c2w"][..., :3], source["c2w"][..., :3], atol=1e-9)
    centres = [world(s, s["c2w"][..., 3]) for s in (scene, source)]
    np.testing.assert_allclose(*centres, atol=1e-9)
    for i in range(10):   # each photo sees the same points of the world
        mine = {tuple(x) for x in world(scene, own_points(scene, i)).round(4)}
        theirs = {tuple(x) for x in world(source, own_points(source, i)).round(4)}
        assert len(mine & theirs) > .9 * len(theirs)


def test_names_may_have_folders_and_image_ids_mean_nothing(desk, source):
    source = dict(source, name=np.array(["a b/ü " + name for name in source["name"]]))
    model = write_folder(desk / "place", source)
    before = data_prep.prepare("place")
    for image, key in zip(model.images, np.roll([image.id for image in model.images], 3)):
        image.id = key
    write_model(SPARSE, model)
    assert same(data_prep.prepare("place"), before, *set(before) - {"info"})
    assert before["name"].tolist() == source["name"].tolist()


def test_photos_shrink_as_a_mean_and_their_cameras_with_them(model, source):
    small = data_prep.prepare("place", downscale=3)
    ratio = (source["wh"] // 3) / source["wh"]
    assert np.array_equal(small["wh"], source["wh"] // 3)
    np.testing.assert_allclose(small["K"], source["K"] * np.tile(ratio, 2))
    assert np.abs(photo(small, 0).mean((0, 1)) - photo(source, 0).mean((0, 1))).max() < 2


def test_modes_and_rotations_of_photos_change_nothing(model):
    from PIL import Image
    before = data_prep.prepare("place", 1)
    turned = Image.Exif()
    turned[274] = 6   # by 90 degrees: COLMAP works on stored pixels
    for i, mode, kind in (0, "L", "PNG"), (1, "CMYK", "JPEG"), (3, "RGB", "JPEG"):
        path = IMAGES / f"toy_00{i}.png"
        picture = Image.open(path).convert("RGB").convert(mode)
        picture.save(path, kind, exif=turned, quality=98)
    after = data_prep.prepare("place", 1)
    assert same(before, after, "wh", "K")
    assert np.ptp(photo(after, 0), axis=2).max() == 0   # grey
    for i in range(1, 10):
        assert np.abs(photo(before, i).astype(float) - photo(after, i)).mean() < 12


def test_photos_of_200_megapixels_are_read(tmp_path):
    big = np.zeros((12_500, 16_000), np.uint8)
    big[-1, -1] = 255
    cv2.imwrite(str(tmp_path / "big.png"), big, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    back = data_prep.decode(tmp_path / "big.png")
    assert back.shape == (12_500, 16_000, 3)
    assert back[-1, -1, 0] == 255


@pytest.mark.parametrize("number, bend", [
    (2, (.2,)), (3, (-.15, .02)), (4, (.1, 0, .01, -.01)), (6, (.1, 0, .01, -.01, 0, 0, 0, 0))])
def test_an_undistorted_photo_shows_nothing_but_photo_where_its_camera_says(
        desk, source, number, bend):
    def grey(x, y):
        return 110 + 60 * x + 40 * y
    model = write_folder(desk / "place", source, model=number, bend=bend)
    w, h = 90, 60
    K = np.array([70.0, 72 if number > 3 else 70, 44, 31])
    v, u = np.mgrid[:h, :w] + .5
    x0, y0 = (u - K[2]) / K[0], (v - K[3]) / K[1]
    x, y = x0.copy(), y0.copy()
    k1, k2, p1, p2 = np.append(bend, np.zeros(4))[:4]
    for _ in range(200):   # inverts COLMAP's formula: what a straight photo shows there
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        x += .5 * (x0 - x * radial - 2 * p1 * x * y - p2 * (r2 + 2 * x * x))
        y += .5 * (y0 - y * radial - 2 * p2 * x * y - p1 * (r2 + 2 * y * y))
    cv2.imwrite(str(PHOTO), grey(x, y).round().astype(np.uint8))
    focal = K[:2] if number > 3 else K[:1]
    model.cameras[7] = SimpleNamespace(model=number, w=w, h=h, numbers=(*focal, 44, 31, *bend))
    write_model(SPARSE, model)
    scene = data_prep.prepare("place", 1)
    fx, fy, cx, cy = scene["K"][0]
    miss = photo(scene, 0)[..., 0] - grey((u - cx) / fx, (v - cy) / fy)
    assert np.abs(miss).max() < 3
    assert abs(miss.mean()) < .3   # half a pixel would be .7


def test_very_narrow_and_very_wide_photos_are_left_out_of_training_only(desk, source, model):
    angles = {0: 9.9, 1: 120.1, 3: 10.1, 4: 119.9, 2: 5, 7: 170}   # 2 and 7 are held out
    for i, angle in angles.items():
        camera = model.cameras[3 * i + 7]
        f = max(camera.w, camera.h) / 2 / np.tan(np.radians(angle) / 2)
        camera.numbers = f, f, camera.w / 2, camera.h / 2
    write_model(SPARSE, model)
    scene = data_prep.prepare("place")
    assert set(source["name"]) - set(scene["name"]) == {"toy_000.png", "toy_001.png"}


@pytest.mark.parametrize("far", [1e300, -1e30, np.inf, np.nan])
def test_points_absurdly_far_away_do_no_harm(model, far):
    clean = data_prep.prepare("place", 1)
    track = [(image.id, 0) for image in model.images]
    for k in range(4):
        x = np.roll((far, 1.0, 2.0), k) if k < 3 else (1.0, 2.0, 3.0)
        error = .5 if k < 3 else far
        model.points.insert(0, SimpleNamespace(id=2 ** 50 + k, x=x, error=error, track=track))
        for image in model.images:
            image.points.append(2 ** 50 + k)
    write_model(SPARSE, model)
    with np.errstate(all="raise"):
        scene = data_prep.prepare("place", 1)
    assert same(scene, clean, *set(clean) - {"info"})


def without_tracks(m):
    for point in m.points:
        point.track = []


def at_one_place(m):
    for point in m.points:
        point.x = 1.0, 2.0, 3.0


def only_tests_see(m):
    for image in m.images:
        if image.name[6] not in "27":
            image.points = []


def all_fisheye(m):
    for camera in m.cameras.values():
        camera.model, camera.numbers = 5, (30.0,) * 8


def unknown_camera(m):
    m.cameras[7].model = 77


def as_text(m):
    for path in SPARSE.glob("*.bin"):
        path.rename(path.with_suffix(".txt"))


def renamed_photos(m):
    for path in IMAGES.glob("*.png"):
        path.rename(path.with_suffix(".jpg"))


def smaller_photos(m):
    for path in IMAGES.glob("*.png"):
        cv2.imwrite(str(path), np.zeros((7, 9, 3), np.uint8))


def two_tables(m):
    shutil.copy(TABLE, "place/b.tsv")


def named(name):
    def change(m):
        m.images[-1].name = name
    return change


def split_of(*rows):
    def change(m):
        TABLE.write_text("filename\tsplit\n" + "\n".join(rows))
    return change


BAD = [   # what is changed of the model or on disk, and what the sentence says
    (without_tracks, "colmap point_triangulator"), (lambda m: m.points.clear(), "point_triangulator"),
    (lambda m: m.points.__delitem__(slice(9, None)), "overlapping photos"),
    (at_one_place, "coincide"), (only_tests_see, "no training photo"),
    (all_fisheye, "colmap image_undistorter"), (unknown_camera, "colmap image_undistorter"),
    (as_text, "colmap model_converter"), (renamed_photos, "another folder or extension"),
    (smaller_photos, "has 9 x 7 pixels, its camera 27 x 40"), (two_tables, "--split"),
    (named("toy_001.png"), "toy_001.png' occurs twice"), (named("../toy_000.png"), "outside"),
    (named("/toy_000.png"), "outside"), (named("..\\toy_000.png"), "outside"), (named(""), "outside"),
    (split_of("toy_000.png\ttrain"), "too few"), (split_of("a\ttest"), "a has no pose"),
    (lambda m: IMAGES.rename("elsewhere"), "place --sfm"),
    (lambda m: (SPARSE / "images.bin").unlink(), "place --sfm"),
    (lambda m: (SPARSE / "cameras.bin").unlink(), "cameras.bin is missing"),
    (lambda m: (SPARSE / "points3D.bin").unlink(), "colmap point_triangulator")]


@pytest.mark.parametrize("change, says", BAD)
def test_bad_input_gives_one_sentence_and_exit_code_2_and_writes_nothing(desk, model, change, says):
    change(model)
    if SPARSE.joinpath("cameras.bin").exists() and SPARSE.joinpath("points3D.bin").exists():
        write_model(SPARSE, model) if SPARSE.joinpath("images.bin").exists() else None
    code, out, err = run_main("place")
    assert code == 2
    last = err.splitlines()[-1]
    assert last.startswith("error: ")
    assert says in last
    assert not Path("data").exists()


def image_of(m, name):
    return [image for image in m.images if image.name == name][0]


def nan_pose(m, name):
    image_of(m, name).q = [np.nan] * 4


def zero_quaternion(m, name):
    image_of(m, name).q = [0.0] * 4


def huge_pose(m, name):
    image_of(m, name).t = 1.0, 2.0, -1e300


def no_camera(m, name):
    image_of(m, name).camera = 12345


def fisheye(m, name):
    m.cameras[99] = SimpleNamespace(model=5, w=40, h=30, numbers=(30.0,) * 8)
    image_of(m, name).camera = 99


def negative_focal(m, name):
    m.cameras[image_of(m, name).camera].numbers = -30.0, 30.0, 2.0, 1.0


def tiny_focal(m, name):
    m.cameras[image_of(m, name).camera].numbers = 30.0, 1e-300, 2.0, 1.0


def infinite_centre(m, name):
    m.cameras[image_of(m, name).camera].numbers = 30.0, 30.0, np.inf, 1.0


def resized(m, name):
    cv2.imwrite(str(IMAGES / name), np.zeros((7, 9, 3), np.uint8))


def no_photo(m, name):
    (IMAGES / name).write_text("x")


def empty(m, name):
    (IMAGES / name).write_text("")


def cut_off_jpeg(m, name):
    data = cv2.imencode(".jpg", cv2.imread(str(IMAGES / name)))[1].tobytes()
    (IMAGES / name).write_bytes(data[:-20])


def cut_off_png(m, name):
    (IMAGES / name).write_bytes((IMAGES / name).read_bytes()[:-20])


FAULTS = {nan_pose: "no sound pose", zero_quaternion: "no sound pose", huge_pose: "no sound pose",
          no_camera: "no camera", fisheye: "fisheye", negative_focal: "cannot be",
          tiny_focal: "cannot be", infinite_centre: "cannot be", resized: "has 9 x 7 pixels",
          no_photo: "no photo", empty: "empty", cut_off_jpeg: "cut off", cut_off_png: "cut off"}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_training_photo_that_cannot_be_used_is_left_out_and_named(model, source, fault):
    fault(model, "toy_001.png")
    write_model(SPARSE, model)
    code, out, err = run_main("place")
    assert code == 0
    assert f"toy_001.png {FAULTS[fault]}" in err or FAULTS[fault] in err
    assert err.count("\n") == 1
    scene = data_prep.open_scene("place")
    assert set(source["name"]) - set(scene["name"]) == {"toy_001.png"}


def test_all_photos_that_cannot_be_used_are_found_in_one_go_and_a_held_out_one_is_an_error(model):
    nan_pose(model, "toy_000.png")
    cut_off_jpeg(model, "toy_004.png")
    resized(model, "toy_007.png")
    write_model(SPARSE, model)
    code, out, err = run_main("place")
    assert code == 2
    *listed, last = err.splitlines()
    assert [line.split()[2] for line in listed] == ["toy_000.png", "toy_004.png", "toy_007.png"]
    assert "toy_007.png" in last
    assert "toy_000.png" not in last


def test_a_camera_that_no_photo_uses_does_not_matter(model):
    before = data_prep.prepare("place")
    model.cameras[99] = SimpleNamespace(model=5, w=0, h=0, numbers=(np.nan,) * 8)
    write_model(SPARSE, model)
    assert same(data_prep.prepare("place"), before, *set(before) - {"info"})


def test_of_several_models_the_largest_is_taken_and_the_others_are_named(model):
    for place, count in ("sparse/0", 2), ("sparse/1", 4):
        part = SimpleNamespace(cameras=model.cameras, images=model.images[:count], points=[])
        write_model(Path("place/dense", place), part)
    shutil.copy(PHOTO, IMAGES / "more.JPG")
    code, out, err = run_main("place", "--downscale", 1)
    assert code == 0
    assert "11 photos on disk, 10 posed by place/dense/sparse\n" in out
    assert "2 posed by place/dense/sparse/0" in out
    assert "4 posed by place/dense/sparse/1" in out


def test_of_equal_models_one_that_can_be_used_is_taken_without_a_word(desk, source):
    write_folder(desk / "place", source)
    shutil.copytree(IMAGES, "place/raw/images")
    bent = colmap_model(source, model=2, bend=(.1,))
    write_model(Path("place/raw/sparse"), bent)
    all_fisheye(bent)
    write_model(Path("place/models"), bent)
    code, out, err = run_main("place")
    assert code == 0
    assert "10 posed by place/dense/sparse\n" in out
    assert "left out" not in out + err


def c2w_for_w2c(image, R, centre):
    image.q, image.t = image.q * (1, -1, -1, -1), centre


def opengl(image, R, centre):
    w, x, y, z = image.q
    image.q, image.t = np.array([-x, w, -z, y]), image.t * (1, -1, -1)


def larger_units(image, R, centre):
    image.t = image.t * 1000


def smaller_units(image, R, centre):
    image.t = image.t / 1000


@pytest.mark.parametrize("mistake", [c2w_for_w2c, opengl, larger_units, smaller_units])
def test_a_model_that_contradicts_its_photos_is_refused(model, source, mistake):
    for image in model.images:
        c2w = source["c2w"][image.id - 50]
        mistake(image, c2w[:, :3].T, world(source, c2w[:, 3]))
    write_model(SPARSE, model)
    code, out, err = run_main("place")
    assert code == 2
    assert "world to camera, x right, y down, z forward" in err


@pytest.mark.parametrize("count, code, says", [(0, 0, ""), (2, 0, "only"), (8, 2, "error: only")])
def test_the_share_of_sightings_in_their_photos_is_said_below_nine_tenths(model, count, code, says):
    for image in model.images[:count]:
        opengl(image, None, None)
    write_model(SPARSE, model)
    result = run_main("place")
    assert result[0] == code
    assert result[2].startswith(says)
    assert bool(result[2]) == bool(says)


def test_the_radius_of_the_sphere_and_the_share_of_points_inside_are_printed(model):
    out = run_main("place")[1]
    scene = data_prep.open_scene("place")
    share = (np.linalg.norm(scene["points"], axis=1) < 1).mean()
    assert f"radius of {scene['scale']:.3g} units" in out
    assert f"{share:.0%} of the points are inside" in out


# ---- split tables --------------------------------------------------------------------------------
GOOD_SPLIT = {"a b.jpg": "test", "sub/c.jpg": "train"}


@pytest.mark.parametrize("text", [
    "filename\tid\tsplit\tdataset\na b.jpg\t1.0\ttest\tx\nsub/c.jpg\t2.0\ttrain\tx\nno\t\ttrain\tx\n",
    "\ufeffid\tfilename\tsplit\n1\ta b.jpg\ttest\n2\tsub/c.jpg\ttrain\n\tno.jpg\ttrain\n",
    "id\tsplit\tfilename\r\n1\ttest\ta b.jpg\r\n\r\n2\ttrain\tsub/c.jpg\r\n",
    "\tsplit\tnima\tfilename\n0\ttest\t5.1\ta b.jpg\n1\ttrain\t4\tsub/c.jpg\n",
    "filename,id,split\n\"a b.jpg\",1,test\nsub/c.jpg,2,train\nno.jpg,,train\n",
    "filename;split\na b.jpg;test\nsub/c.jpg;train\n"])
def test_a_split_table_is_read_by_the_names_of_its_columns(tmp_path, text):
    path = tmp_path / "s.tsv"
    path.write_bytes(text.encode())
    assert data_prep.read_split(path) == GOOD_SPLIT


@pytest.mark.parametrize("text, says", [
    ("", "header"), ("filename\tid\n", "header"), ("a,b\n", "header"), ("split\tfilename\ntrain\n", "None"),
    ("filename\tsplit\n\ttrain\n", "train or test"), ("filename\tsplit\nx.jpg\tvalid\n", "valid"),
    ("filename\tsplit\nx.jpg\n", "train or test"), ("filename\tsplit\nx\ttrain\nx\ttest\n", "not both")])
def test_what_is_wrong_with_a_split_table_is_said(tmp_path, text, says):
    (tmp_path / "s.tsv").write_text(text)
    with pytest.raises(UserError, match=f"s.tsv.*{says}"):
        data_prep.read_split(tmp_path / "s.tsv")


def held_out(*argv):
    code, out, err = run_main("place", *argv)
    assert code == 0, err
    scene = data_prep.open_scene("place")
    return scene["name"][scene["is_test"]].tolist(), out, err


@pytest.mark.parametrize("name", ["nerfw_split.csv", "s.tsv"])
def test_tables_and_lists_of_the_folder_are_used_and_named(model, name):
    TABLE.unlink()
    mark = "\t" if name == "s.tsv" else ","
    rows = [f"toy_00{i}.png{mark}{'test' if i == 5 else 'train'}" for i in range(9)]
    Path("place", name).write_text(f"filename{mark}split\n" + "\n".join(rows))
    Path("place/other.csv").write_text("a,b\n1,2\n")
    Path("place/._s.tsv").write_bytes(b"what a Mac leaves on other disks")
    names, out, err = held_out()
    assert names == ["toy_005.png"]
    assert f"split by place/{name}" in out
    assert "1 photos are not in" in err


@pytest.mark.parametrize("given", [[], ["--split", "place/test_list.txt"]])
def test_lists_of_training_and_test_photos_are_used(model, given):
    TABLE.unlink()
    Path("place/train_list.txt").write_text("\ufefftoy_000.png\r\ntoy_001.png\r\n\r\n", "utf-8")
    Path("place/test_list.txt").write_text("toy_003.png")
    names, out, err = held_out(*given)
    assert names == ["toy_003.png"]
    Path("place/test_list.txt").unlink()
    assert "test_list.txt is" in run_main("place", *given)[2]


def test_without_a_table_every_eighth_photo_is_held_out_and_that_is_said(model):
    TABLE.unlink()
    names, out, err = held_out()
    assert names == ["toy_007.png"]
    assert "every eighth photo" in out


def test_names_with_another_folder_or_extension_are_said_to_be_such(model):
    text = TABLE.read_text().replace("toy_000.png", "images/toy_000.jpg")
    TABLE.write_text(text + "12.0\ttrain\tghost.png\ttoy\n")
    names, out, err = held_out()
    assert "2 photos of place/toy.tsv have no pose or no file by another folder or extension" in err
    assert "images/toy_000.jpg is toy_000.png" in err


# ---- freshness -----------------------------------------------------------------------------------
def makes(capsys, name="place", downscale=2):
    capsys.readouterr()
    data_prep.open_scene(name, downscale)
    return "making" in capsys.readouterr().out


def set_time(path, seconds):
    os.utime(path, (seconds, seconds))


def test_a_scene_is_made_once_for_each_size(model, capsys):
    assert makes(capsys)
    assert not makes(capsys)
    assert makes(capsys, downscale=4)
    assert not makes(capsys, downscale=4)


@pytest.mark.parametrize("path", [PHOTO, SPARSE / "images.bin", SPARSE / "points3D.bin", TABLE])
@pytest.mark.parametrize("seconds", [1000, 4 * 10 ** 9])
def test_a_scene_is_made_anew_when_a_source_is_older_or_newer(model, capsys, path, seconds):
    makes(capsys)
    set_time(path, seconds)
    assert makes(capsys)
    assert not makes(capsys)


def test_a_scene_is_made_anew_when_a_photo_or_a_model_goes_or_comes(model, capsys):
    makes(capsys)
    SPARSE.rename("place/dense/sparse_1")
    assert makes(capsys)
    PHOTO.unlink()
    assert makes(capsys)
    write_model(Path("place/sparse"), model)
    assert makes(capsys)


def test_a_scene_file_does_without_its_sources(model, capsys):
    makes(capsys)
    Path("place").rename("elsewhere")
    assert not makes(capsys)


def test_a_split_named_once_stays_when_the_scene_is_made_again(model):
    table = Path("mine.tsv")   # not the folder's own
    table.write_text(TABLE.read_text().replace("test", "train").replace("train\ttoy_003", "test\ttoy_003"))
    assert run_main("place", "--split", "mine.tsv", "--downscale", 1)[0] == 0
    scene = data_prep.open_scene("place", 2)
    assert scene["name"][scene["is_test"]].tolist() == ["toy_003.png"]
    table.unlink()
    with pytest.raises(UserError, match="mine.tsv is not there"):
        data_prep.open_scene("place", 4)


def test_every_folder_has_a_file_of_its_own(desk):
    names = ["toy", "sacre", "one/photos", "two/photos", "./toy", str(desk / "sacre")]
    paths = [data_prep.scene_path(name) for name in names]
    assert [str(path) for path in paths[:2]] == ["data/toy.npz", "data/sacre.npz"]
    assert len(set(paths)) == len(paths)
    assert paths[2].name.startswith("photos-")
    assert data_prep.scene_path("one/../one/photos") == paths[2]


def test_a_toy_stays_as_it_was_made(desk, monkeypatch):
    data_prep.write_scene(Path("data/toy.npz"), toy(seed=1))
    Path("toy.tsv").write_text("no business of the toy")
    assert same(data_prep.open_scene("toy", 3), toy(seed=1))
    Path("data/toy.npz").unlink()
    monkeypatch.setattr(data_prep, "make_toy", toy)
    assert same(data_prep.open_scene("toy", 3), toy())


@pytest.mark.parametrize("home", ["data/sacre", "data/sacre_coeur"])
def test_scenes_that_are_known_by_name_lie_in_data(desk, source, home):
    with pytest.raises(UserError, match="python data_prep.py sacre --download"):
        data_prep.open_scene("sacre")
    write_folder(desk / home, source)
    assert len(data_prep.open_scene("sacre")["wh"]) == 10


# ---- damaged models ------------------------------------------------------------------------------
def survives(read, path, data):
    """What read() makes of a file with this content; None where it refuses that in one sentence."""
    path.write_bytes(data)
    try:
        return read()
    except UserError as e:
        assert "\n" not in str(e)


@pytest.fixture(params=["cameras.bin", "images.bin", "points3D.bin"])
def damaged(tmp_path, source, request):
    """What the model's reader makes of other bytes of a file, its good bytes, and where counts lie."""
    model = colmap_model(source)
    model.images, model.points = model.images[:2], model.points[:3]
    write_model(tmp_path, model)
    path = tmp_path / request.param
    data = path.read_bytes()

    def read():
        return data_prep.read_photos(tmp_path), data_prep.read_points(tmp_path)
    counts = {"cameras.bin": [0], "images.bin": [0, data.find(b"png\0") + 4], "points3D.bin": [0, 51]}
    return functools.partial(survives, read, path), data, counts[request.param]


def test_truncated_models_are_refused_wherever_they_end(damaged):
    read, data, _ = damaged
    assert read(data)
    for n in range(0, len(data), 7):
        assert read(data[:n]) is None


def test_promised_counts_are_noticed_before_memory_is_taken(damaged):
    read, data, counts = damaged
    for at in counts:
        for count in (1000, 2 ** 31, 2 ** 40, 2 ** 63, 2 ** 64 - 1):
            result, size = peak(read, data[:at] + struct.pack("<Q", count) + data[at + 8:])
            assert result is None
            assert size < 2 ** 21


def test_damaged_models_and_split_tables_do_no_harm(damaged, tmp_path):
    read, data, _ = damaged
    rng = np.random.default_rng(0)
    table = tmp_path / "s.tsv"
    for i in range(40):
        read(flipped(data, rng.integers(8 * len(data), size=i % 5)))
        read(struct.pack("<Q", i % 4) + rng.bytes(i))
        text = b"filename\tid\tsplit\n" + rng.bytes(100)
        survives(lambda: data_prep.read_split(table), table, text)


# ---- downloads -----------------------------------------------------------------------------------
class Handler(http.server.BaseHTTPRequestHandler):
    """Serves files, with ranges or without; breaks off after `limit` bytes of an answer."""

    def do_GET(self):
        server = self.server
        data = server.files.get(self.path)
        start = int(self.headers.get("Range", "bytes=0-")[6:-1]) if server.ranges else 0
        server.asked.append((self.path, start))
        if data is None:
            self.send_error(404)
            return
        self.send_response(416 if start >= len(data) else 206 if start else 200)
        self.send_header("Content-Length", str(max(len(data) - start, 0)))
        self.end_headers()
        self.wfile.write(data[start:][:server.limit])

    def log_message(self, *_):
        pass


def archive(members):
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as tar:
        for name, content in members:
            entry = tarfile.TarInfo(name)
            if isinstance(content, str):
                entry.type, entry.linkname, content = tarfile.SYMTYPE, content, b""
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    return out.getvalue()


DENSE = "brandenburg_gate/dense/"
TAR = "/brandenburg_gate.tar.gz"
JPEG = np.random.default_rng(0).bytes(50_000)
GOOD = [(DENSE + "images/a.jpg", JPEG), (DENSE + "sparse/cameras.bin", b"x"),
        (DENSE + "stereo/big.bin", b"y"), ("brandenburg_gate/other.txt", b"z")]
WANTED = {"brandenburg.tsv": b"table", "dense/images/a.jpg": JPEG, "dense/sparse/cameras.bin": b"x"}
HOME = Path("data/brandenburg")


@pytest.fixture
def server(desk):
    web = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    web.files = {TAR: archive(GOOD), "/brandenburg.tsv": b"table"}
    web.ranges, web.limit, web.asked = True, None, []
    threading.Thread(target=web.serve_forever, args=(.02,), daemon=True).start()
    web.url = f"http://127.0.0.1:{web.server_port}/"
    web.get = functools.partial(data_prep.download, "brandenburg", web.url, web.url)
    yield web
    web.shutdown()
    web.server_close()


def unpacked():
    files = [path for path in HOME.rglob("*") if path.is_file()]
    return {path.relative_to(HOME).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize("ranges", [True, False])
def test_a_broken_download_goes_on_where_it_stopped_and_unpacks_what_is_wanted(server, ranges):
    part = Path("data" + TAR + ".part")
    server.limit, server.ranges = 20_000, ranges
    with pytest.raises(UserError, match="same command"):
        server.get()
    assert part.stat().st_size == 20_000
    assert not HOME.exists()
    server.limit = None
    server.get()
    assert server.asked[-1] == (TAR, 19_999 if ranges else 0)
    assert unpacked() == WANTED
    assert sorted(os.listdir("data")) == ["brandenburg", "brandenburg.tsv", "brandenburg_gate.tar.gz"]
    with pytest.raises(UserError, match="there already"):
        server.get()
    assert len(server.asked) == 3   # nothing is fetched twice


def test_a_whole_part_is_used_and_a_longer_one_started_over(server):
    part = Path("data" + TAR + ".part")
    part.parent.mkdir()
    part.write_bytes(b"?" * 200_000)
    with pytest.raises(UserError):
        server.get()
    assert not part.exists()
    part.write_bytes(server.files[TAR])
    server.get()
    assert unpacked() == WANTED


@pytest.mark.parametrize("name, says", [("sacre", "404"), ("nowhere", "--download knows")])
def test_what_fails_of_a_download_is_said(server, name, says):
    with pytest.raises(UserError, match=says):
        data_prep.download(name, server.url, server.url)


@pytest.mark.parametrize("evil", [
    (DENSE + "images/../../../../evil.txt", b"x"), ("/evil.txt", b"x"), ("../evil.txt", b"x"),
    (DENSE + "images/link", "/etc"), (DENSE + "images/link", "../../../.."),
    ("brandenburg_gate/dense/images", "/tmp")])
def test_archives_cannot_write_outside(server, desk, evil):
    server.files[TAR] = archive([*GOOD, evil, (DENSE + "images/link/evil.txt", b"x")])
    with contextlib.suppress(UserError):
        server.get()
    home = desk / HOME
    assert all(home in path.parents for path in desk.rglob("evil.txt"))
    assert not any(path.is_symlink() for path in desk.rglob("*"))
    assert os.listdir(desk) == ["data"]


DAMAGE = [lambda b: b[:30_000], lambda b: b"no archive", lambda b: b[:9000] + b"?" * 99 + b[9099:],
          lambda b: b[:-8] + b"????" + b[-4:], lambda b: archive(GOOD[2:])]


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_archives_are_named_and_leave_nothing(server, damage):
    server.files[TAR] = damage(server.files[TAR])
    with pytest.raises(UserError, match="brandenburg_gate.tar.gz"):
        server.get()
    assert sorted(os.listdir("data")) == ["brandenburg.tsv", "brandenburg_gate.tar.gz"]


# ---- command line --------------------------------------------------------------------------------
def test_the_command_line_makes_a_toy_with_any_knob(desk):
    code, out, err = run_main("toy", "--size", 32, "--photos", 6, "--test", 2, "--no-background",
                              "--occluders", .2)
    assert code == 0
    assert "data/toy.npz: 8 photos, 2 of them" in out
    assert same(data_prep.read_scene("data/toy.npz"), toy(occluders=.2, background=False))


@pytest.mark.parametrize("argv", [
    "toy --sizee 9", "toy --siz 9", "toy --size x", "", "nowhere", "brandenburg", "x --download",
    "toy --occluders 2", "place --downscale 0", "place --downscale 16", "toy --pose_noise nan",
    "toy --pose_noise inf", "toy --downscale 4", "toy --split x.tsv", "place --split x.tsv",
    "toy --exposure -1", "toy --exposure 2.1", "toy --seed -1", "place --size 9", "toy --size 15",
    "toy --photos 3", "toy --test -1", "toy --pose_noise -1", "toy --landmark -1", "toy --sun 181",
    "toy --sun -1"])
def test_misspelt_commands_exit_with_2(model, argv):
    code, out, err = run_main(*argv.split())
    assert code == 2
    assert "error: " in err
    assert not Path("data").exists()


@pytest.mark.parametrize("error, says", [
    (KeyboardInterrupt(), "stopped"), (OSError(13, "denied"), "denied"), (MemoryError("a"), "a")])
def test_what_stops_a_command_is_one_sentence(desk, monkeypatch, error, says):
    def fail(**knobs):
        raise error
    monkeypatch.setattr(data_prep, "make_toy", functools.wraps(data_prep.make_toy)(fail))
    code, out, err = run_main("toy")
    assert code == 2
    assert says in err
    assert err.count("\n") == 1


@pytest.fixture
def pycolmap(desk, monkeypatch, source):
    """A stand-in that notes its calls and finds models of 2, 9 and 3 photos."""
    photos = desk / "raw"
    (photos / "images").mkdir(parents=True)
    calls = []

    def note(name, result=None):
        def call(*args):
            calls.append((name, *args[:3]))
            return result() if callable(result) else result
        return call
    found = {i: SimpleNamespace(num_reg_images=lambda n=n: n) for i, n in enumerate((2, 9, 3))}
    fake = SimpleNamespace(
        calls=calls, photos=photos, extract_features=note("extract"), match_exhaustive=note("match"),
        incremental_mapping=note("map", found), undistort_images=note(
            "undistort", lambda: write_folder(photos, source)),
        IncrementalPipelineOptions=lambda: SimpleNamespace(mapper=SimpleNamespace()))
    monkeypatch.setitem(sys.modules, "pycolmap", fake)
    return fake


def test_sfm_calls_pycolmap_in_order_and_undistorts_the_largest_model(pycolmap):
    photos = pycolmap.photos
    assert run_main(photos, "--sfm")[0] == 0
    assert data_prep.scene_path(photos).exists()
    assert pycolmap.calls == [
        ("extract", photos / "database.db", photos), ("match", photos / "database.db"),
        ("map", photos / "database.db", photos, photos / "models"),
        ("undistort", photos / "dense", photos / "models" / "1", photos)]
    assert "has dense/" in run_main(photos, "--sfm")[2]   # its photos would be posed twice


def test_sfm_says_when_photos_do_not_match_and_when_pycolmap_is_missing(pycolmap, monkeypatch):
    pycolmap.incremental_mapping = lambda *args: {}
    assert "overlap" in run_main(pycolmap.photos, "--sfm")[2]
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert "pycolmap" in run_main(pycolmap.photos, "--sfm")[2]


def test_download_comes_first(desk, monkeypatch, source):
    monkeypatch.setattr(data_prep, "download", lambda name: write_folder(desk / "data" / name, source))
    assert run_main("sacre", "--download")[0] == 0
    assert data_prep.scene_path("sacre").exists()
