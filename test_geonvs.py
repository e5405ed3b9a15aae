"""Part I: tests, in the order of data_prep.py and geonvs.py. Part II: the rivals NeRF-W and Ha-NeRF, experiments.

The tests come from properties: naive loops in float64, closed forms, limits, invariances, round trips; nothing
needs data, network or a GPU, nothing is skipped, and no timing decides.
"""
import contextlib, copy, functools, http.server, importlib.util, inspect, io, itertools, json, math, os, pickle
import re, resource, shutil, socket, struct, subprocess, sys, tarfile, threading, time, tracemalloc, zipfile, zlib
from dataclasses import asdict, fields, replace
from pathlib import Path
from types import SimpleNamespace

from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from data_prep import UserError
import data_prep
import geonvs as g

if __name__ != "__main__":
    torch.set_num_threads(1)  # the scenes of tests are tiny: a second thread would only wait for the first

# ==== Part I: tests ===================================================================================

# ---- data_prep.py: the toy -------------------------------------------------------------------------

TINY_TOY = dict(size=32, photos=6, test=2)


@functools.cache
def toy(**knobs):
    return data_prep.make_toy(**{**TINY_TOY, **knobs})


def photo(scene, i, key="rgb"):
    w, h = scene["wh"][i]
    return scene[key][scene["start"][i]:scene["start"][i + 1]].reshape(h, w, *scene[key].shape[1:])


world = lambda scene, x: x * scene["scale"] + scene["center"]
CPU = torch.device("cpu")
toy_world = lambda x: np.asarray(x) * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN
age = lambda path, seconds: os.utime(path, (seconds, seconds))
info = lambda scene: json.loads(str(scene["info"]))
GOOD_SPLIT = {"a b.jpg": "test", "sub/c.jpg": "train"}
own_points = lambda scene, i: scene["points"][scene["track_point"][scene["track_photo"] == i]].astype(float)


def same(a, b, *keys):
    return all(np.array_equal(a[k], b[k], equal_nan=np.asarray(a[k]).dtype.kind == "f") for k in keys or a)


def run_main(*argv):
    code = 0
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        try:
            data_prep.main(list(map(str, argv)))
        except SystemExit as e:
            code = e.code
    return code, out.getvalue(), err.getvalue()


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("seconds, count, told", [
    (.9, 10, []), (1.01, 10, [10]), (4, 10, range(3, 11)), (30, 10, range(1, 11)), (.01, 1500, range(1002, 1501, 102))])
def test_progress_is_told_on_one_line_after_ten_seconds_then_every_second(seconds, count, told, capsys, monkeypatch):
    items, clock = [str(i) for i in range(count)], [100.0]
    monkeypatch.setattr(data_prep.time, "monotonic", lambda: clock[0])
    for i, item in enumerate(data_prep.tell(items, "counting")):
        assert item == str(i)
        clock[0] += seconds
    out, said = capsys.readouterr().out, [f"counting: {n} of {count}, {seconds * (count - n):.0f} s left" for n in told]
    assert i == count - 1 and out.count("\n") == bool(told) == out.startswith("\r") == out.endswith("\n")
    assert count > 10 or [line.strip() for line in out.split("\r")[1:]] == said
    assert abs(out.count("\r") - len(told)) < 3 and (not told or f"{count} of {count}, 0 s" in out)


def test_scene_dictionary_keeps_its_contract(tmp_path):
    s, again, other = toy(), data_prep.make_toy(**TINY_TOY), toy(landmark=2)
    assert same(s, again) and not same(s, toy(seed=1), "c2w") and (s["rgb"] != other["rgb"]).any(1).mean() > .05
    data_prep.write_scene(tmp_path / "toy.npz", s)
    back = data_prep.read_scene(tmp_path / "toy.npz")
    n, i, k, t = s["start"][-1], 8, len(s["points"]), len(s["track_photo"])
    want = dict(rgb=("uint8", (n, 3)), wh=("int32", (i, 2)), c2w=("float64", (i, 3, 4)), points=("float32", (k, 3)),
                track_uv=("float32", (t, 2)), depth=("float16", (n,)), occluder=("bool", (n,)))
    assert {key: (str(back[key].dtype), back[key].shape) for key in want} == want and same(s, back)
    assert set(back) == set(s) == set(data_prep.FORMAT) | {"depth", "occluder"} and len(set(back["name"])) == i
    assert info(other).items() >= dict(TINY_TOY, kind="toy", scene="toy", downscale=1, landmark=2).items()
    assert np.array_equal(np.diff(s["start"]), s["wh"].prod(1)) and s["is_test"].sum() == 2 and s["wh"].max() == 32
    r, ordered = s["c2w"][:, :, :3], (np.diff(s["track_photo"]) >= 0).all()
    assert np.allclose(r @ r.transpose(0, 2, 1), np.eye(3), atol=1e-12) and (np.linalg.det(r) > 0).all() and (r[:, 2, 1] < -.5).all() and ordered   # y is down


@pytest.mark.parametrize("number", [0, 1, 2, 10])
def test_every_landmark_is_a_building_of_the_same_parts_in_the_unit_sphere(number):
    first, parts, s = data_prep.LANDMARK, data_prep.toy_parts(number, False), toy(landmark=number)
    assert np.array_equal(parts[:, 0], first[:, 0]) and (number == 0) == np.array_equal(parts, first)
    assert np.array_equal(data_prep.toy_parts(number, True), np.concatenate([parts, data_prep.TOWN]))
    assert (number > 0) == (np.abs(parts[:, 1:4] - first[:, 1:4]).max() > .1) == (parts[:, 8] != first[:, 8]).any()
    assert .6 < (parts[:, 3] + parts[:, 4]).max() / 1.825 < 1.3 and (np.abs(parts[:, 1:3]) < (1.1, .6)).all()
    assert all(p[4] == p[5] == p[6] for p in parts if p[0] == 3)   # balls stay round
    for i, (_, x, y, z, half, *_) in enumerate(parts):   # nothing hangs in the air
        foot, others = np.array([[x, y, z - half]]), np.delete(parts, i, 0)
        assert z - half < 1e-9 or min(data_prep.part_sdf(q, foot)[0] for q in others) < .02, i
    x = toy_world(np.random.default_rng(0).uniform([-1.2, -.8, 0], [1.2, .8, 2.4], (60_000, 3)))
    reach = np.linalg.norm((x[data_prep.toy_sdf(x, False, number) < 0] - s["center"]) / s["scale"], axis=1)
    assert .75 < reach.max() < 1 and (np.linalg.norm(s["points"], axis=1) < 1).mean() > .8


@pytest.mark.parametrize("knobs", [{}, dict(background=False), dict(background=False, occluders=.2)])
def test_background_is_one_colour_exactly_when_most_rays_beyond_the_sphere_agree(knobs):
    scene, seen = toy(**knobs), []
    for i in np.flatnonzero(~scene["is_test"]):
        o, d = scene["c2w"][i, :, 3], data_prep.rays(scene["K"][i], scene["c2w"][i], *scene["wh"][i])
        seen += [rgb / 255 for to, rgb in zip(d, photo(scene, i).reshape(-1, 3))
                 if np.linalg.norm(o + np.linspace(0, 20, 2000)[:, None] * to, axis=1).min() > 1]
    agree = (np.abs(seen - np.median(seen, 0)) < .02).all(1).mean()
    is_one = agree > .6 and len(seen) > 100   # in the last scene too few
    np.testing.assert_allclose(scene["bg_color"], np.median(seen, 0) if is_one else [np.nan] * 3)


def test_near_footprint_and_exposure_spread_agree_with_naive_loops():
    s, size = toy(exposure=0.0, occluders=0.0), []
    for i, near in enumerate(s["near"]):
        distance = [np.linalg.norm(x - s["c2w"][i, :, 3]) for x in own_points(s, i)]
        assert np.isclose(near, .8 * np.quantile(distance, .02), rtol=1e-5)
        uv = data_prep.project(s["K"][i], s["c2w"][i], own_points(s, i))[0] / s["wh"][i]
        np.testing.assert_allclose(s["track_uv"][s["track_photo"] == i], np.clip(uv, -1, 2), atol=1e-6)
        size += [d / s["K"][i, 0] for x, d in zip(own_points(s, i), distance) if not s["is_test"][i] and np.linalg.norm(x) < 1]
    assert np.isclose(s["footprint"], np.quantile(size, .25), rtol=1e-5) and s["exposure_spread"] < 0.01
    c2w, some = s["c2w"].copy(), np.isin(s["track_photo"], (1, 2))   # cameras without points, one in its only point
    c2w[1, :, 3], point = s["points"][0], np.where(s["track_photo"] == 1, 0, s["track_point"])
    near = data_prep.statistics(dict(s, c2w=c2w, track_photo=s["track_photo"][some], track_point=point[some]))["near"]
    assert np.allclose(near[[0, 1, 3, 7]], (.05, .02, .05, .05))
    offset = np.random.default_rng(0).uniform(-40, 40, len(s["wh"]))
    rgb = s["rgb"] * 0.5 + 64 + np.repeat(offset, np.diff(s["start"]))[:, None]
    found = data_prep.statistics(dict(s, rgb=rgb.round().astype(np.uint8)))["exposure_spread"]
    assert 0.5 < found / (offset[~s["is_test"]] / 255).std() < 1.5


@pytest.mark.parametrize("knobs", [{}, dict(background=False), dict(landmark=4), dict(background=False, landmark=5)])
def test_depth_is_where_the_distance_function_first_vanishes(knobs):
    s = toy(**knobs)
    sdf = lambda x: data_prep.toy_sdf(world(s, x), **knobs) / s["scale"]
    for i in range(8):
        c2w, d = s["c2w"][i], data_prep.rays(s["K"][i], s["c2w"][i], *s["wh"][i])
        uv, distance = data_prep.project(s["K"][i], c2w, c2w[:, 3] + 2.5 * d)   # unit rays through the pixels' centres
        want = np.argwhere(photo(s, i, "depth") > -1)[:, ::-1] + .5
        np.testing.assert_allclose(np.column_stack([uv, distance]), np.insert(want, 2, 2.5, axis=1), atol=1e-9)
        assert (data_prep.project(s["K"][i], c2w, c2w[:, 3] - d)[0] < -1e8).all()   # behind the camera
        t = photo(s, i, "depth").ravel().astype(float)
        hit = np.isfinite(t) & (t < 8)
        assert hit.any() and np.abs(sdf(c2w[:, 3] + t[hit, None] * d[hit])).max() < 8 * 2 ** -10
        for share in np.linspace(0, .99, 12):   # nothing is in between, nor before the sky
            assert (sdf(c2w[:, 3] + share * np.minimum(t, 12)[:, None] * d) > -1e-3).mean() > .999


def test_part_distance_agrees_with_dense_surface_samples_and_traced_parts_with_heights():
    rng = np.random.default_rng(1)
    x = rng.uniform(-1, 1, (150, 3))
    for part in np.array([(1, .1, .2, .3, .3, .4, .4, .2, 0), (1, 0, 0, 0, .2, .5, 0, .3, 0),
                          (3, 0, .1, 0, .5, .5, .5, np.inf, 0), (2, .1, 0, 0, .4, .3, .1, np.inf, 0)]):
        surface = rng.uniform(-.9, .9, (400_000, 3))
        surface = surface[np.abs(data_prep.part_sdf(part, surface)) < .004]
        brute, out = np.array([np.sqrt(((surface - p) ** 2).sum(1).min()) for p in x]), data_prep.part_sdf(part, x)
        assert np.abs(np.abs(out) - brute)[out > 0].max() < .07
    parts, heights = data_prep.toy_parts(0, True), np.array([1.825, 1.5, .1, 0])   # finial, tower, plinth, ground
    o, down = np.array([[-.05, .22, 9], [.87, .18, 9], [.9, -.5, 9], [3, -3, 9]]), np.array([[1e-6, 1e-6, -1]] * 4)
    t, which = data_prep.trace(o, down, parts, True)
    np.testing.assert_allclose(t, 9 - heights, atol=1e-4)
    assert parts[which[:3], 8].tolist() == [data_prep.GOLD, data_prep.SLATE, data_prep.STONE] and which[3] == -1
    x, z = rng.uniform(.95, 1.03, 99), rng.uniform(.9, 1, 99)   # the tower's wall in the sun, and the one behind it
    front, back = (data_prep.shade(np.column_stack([x, 0 * x - 3 * k, z]), np.tile([1e-6, k, 1e-6], (99, 1)), parts, False).mean() for k in (1, -1))
    assert front > 2 * back


def test_no_exposure_and_no_people_means_the_same_picture_of_the_same_thing():
    plain = toy(exposure=0.0, occluders=0.0, photos=16)
    for share in (.05, .3):   # of the training photos that people cover
        other = toy(exposure=0.0, occluders=share, photos=16, size=32)
        free, each = ~other["occluder"], np.array([photo(other, i, "occluder").mean() for i in range(18)])
        assert same(plain, other, "K") and np.array_equal(plain["rgb"][free], other["rgb"][free])
        assert (other["rgb"][~free] > plain["rgb"][~free] + 50.).mean() > .05   # people wear colours
        each, test = each[~other["is_test"]], (each[other["is_test"]], plain["occluder"])
        assert .7 < each.mean() / share < 1.6 and max(each) > 1.3 * share > 2 * min(each) and not any(map(np.any, test))
    tastes = [toy(exposure=exposure, occluders=0.0, photos=16) for exposure in (1.0, 2.0)]
    spread = [np.std([photo(s, i).mean() / photo(plain, i).mean() for i in range(18)]) for s in tastes]
    assert .03 < spread[0] and 1.3 * spread[0] < spread[1]


def test_points_lie_on_surfaces_and_look_the_same_in_all_photos_but_for_noise_and_a_few_wild_ones():
    s = data_prep.make_toy(size=48, photos=12, test=2, exposure=0.0)
    miss = np.abs(data_prep.toy_sdf(world(s, s["points"].astype(float)))) / s["scale"]
    assert .001 < np.median(miss) < .006 and .0005 < (miss > .03).mean() < .05
    assert len(s["points"]) > 1000 and np.bincount(s["track_point"]).min() >= 2
    hidden, colour = 0, np.full((14, len(s["points"]), 3), np.nan)
    for i in range(14):
        uv, distance = data_prep.project(s["K"][i], s["c2w"][i], own_points(s, i))
        u, v = np.clip(uv.astype(int), 0, s["wh"][i] - 1).T
        colour[i, s["track_point"][s["track_photo"] == i]] = photo(s, i)[v, u]
        hidden += (photo(s, i, "depth")[v, u] < .8 * distance).sum()
        assert (distance > s["near"][i]).mean() > .95 and photo(s, i, "occluder")[v, u].mean() < .1
    assert hidden < .06 * len(s["track_photo"]) and np.nanstd(colour, axis=0).mean() < .5 * np.nanstd(colour)


def test_pose_noise_moves_training_photos_by_that_many_pixels_and_no_test_photo():
    clean, noisy = (data_prep.make_toy(size=20, photos=40, test=3, occluders=0.0, pose_noise=px) for px in (0.0, 2.0))
    assert same(clean, noisy, "rgb", "K", "points", "scale", "center")
    x = (toy_world([[0, 0, .7]]) - clean["center"]) / clean["scale"]
    shift = np.array([data_prep.project(k, a, x)[0][0] - data_prep.project(k, b, x)[0][0]
                      for k, a, b in zip(clean["K"], clean["c2w"], noisy["c2w"])])
    assert 1.4 < np.sqrt((shift[~clean["is_test"]] ** 2).sum(1).mean()) < 2.8 and not shift[clean["is_test"]].any()
    assert all(np.abs(clean["c2w"] - noisy["c2w"])[..., part].max() > .01 for part in (3, slice(3)))


def write_colmap(folder, cameras, images, points):
    """{id: (model, w, h, params)}, [(id, q, t, camera id, name, point ids)], [(id, xyz, error, track)]"""
    folder.mkdir(parents=True, exist_ok=True)
    for name, records in (
            ("cameras", [struct.pack(f"<iiQQ{len(p)}d", key, *size, *p) for key, (*size, p) in cameras.items()]),
            ("images", [struct.pack("<I4d3dI", key, *q, *t, camera) + name.encode() + struct.pack("<xQ", len(own))
                        + b"".join(struct.pack("<ddQ", 1.5, 2.5, k) for k in own)
                        for key, q, t, camera, name, own in images]),
            ("points3D", [struct.pack(f"<Q3d3BdQ{2 * len(t)}I", key, *x, 1, 2, 3, error, len(t), *sum(t, ()))
                          for key, x, error, t in points])):
        (folder / f"{name}.bin").write_bytes(struct.pack("<Q", len(records)) + b"".join(records))


def as_colmap(folder, scene, model=1, sub="dense", bend=()):
    cameras, images, tracks, rows = {}, [], {}, ["id\tsplit\tfilename\tdataset"]
    for i, n in enumerate(map(str, scene["name"])):
        fx, fy, cx, cy = scene["K"][i]
        p = (fx, fy, cx, cy) if model in (1, 4) else (fx, cx, cy)
        cameras[3 * i + 7] = (model, *map(int, scene["wh"][i]), (*p, *bend))
        turn = cv2.Rodrigues(scene["c2w"][i, :, :3].T)[0].ravel()
        angle = np.linalg.norm(turn)
        q = 2.5 * np.array([np.cos(angle / 2), *(np.sin(angle / 2) * turn / angle)])   # of any length
        own = scene["track_point"][scene["track_photo"] == i].tolist()
        for j, point in enumerate(own):
            tracks.setdefault(point, []).append((i + 50, j))
        ids = [5 * point + 2 ** 40 for point in own] + [2 ** 64 - 1]   # a corner without a 3D point
        t = -scene["c2w"][i, :, :3].T @ world(scene, scene["c2w"][i, :, 3])
        images.append((i + 50, q, t, 3 * i + 7, n, ids))
        path = folder / sub / "images" / n
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), photo(scene, i)[..., ::-1])
        rows.append(f"{i}.0\t{'test' if scene['is_test'][i] else 'train'}\t{n}\ttoy")
    points = [(5 * k + 2 ** 40, world(scene, scene["points"][k].astype(float)), .5, t) for k, t in tracks.items()]
    write_colmap(folder / sub / "sparse", cameras, images[::-1], points)
    (folder / "toy.tsv").write_text("\n".join(rows) + "\n")
    return cameras, images, points


@pytest.fixture(scope="module")
def source():
    return data_prep.make_toy(size=40, photos=8, test=2)


@pytest.fixture
def folder(tmp_path, source):
    as_colmap(tmp_path / "place", source)
    return tmp_path / "place"


@pytest.mark.parametrize("sub, model, prefix", [("dense", 1, ""), (".", 0, "a b/ü "), ("dense/0", 1, "")])
def test_toy_survives_the_way_through_colmap_files(tmp_path, source, sub, model, prefix):
    source = dict(source, name=np.array([prefix + n for n in source["name"]]))
    cameras, images, points = as_colmap(tmp_path, source, model, sub)
    s = data_prep.prepare(tmp_path, downscale=1)
    assert same(s, source, "rgb", "is_test", "name", "wh", "start")
    for value in (lambda a: a["K"], lambda a: a["c2w"][:, :, :3], lambda a: world(a, a["c2w"][:, :, 3])):
        np.testing.assert_allclose(value(s), value(source), atol=1e-9)
    for i in range(10):   # each photo sees the same points of the world
        mine, theirs = ({tuple(x) for x in world(a, own_points(a, i)).round(4)} for a in (s, source))
        assert len(mine) > 10 and len(mine & theirs) > .9 * len(theirs)
    assert info(s).items() >= dict(scene=tmp_path.name, kind="colmap", downscale=1, split=None).items()
    images = [(cam_id, *rest) for (_, *rest), cam_id in zip(images, np.roll([i[0] for i in images], 3))]
    write_colmap(tmp_path / sub / "sparse" / "0", cameras, images, points)   # image ids mean nothing
    for file in (tmp_path / sub / "sparse").glob("*.bin"):
        file.unlink()
    assert same(data_prep.prepare(tmp_path, downscale=1), s)
    small, ratio = data_prep.prepare(tmp_path, downscale=3), (source["wh"] // 3) / source["wh"]
    assert (source["wh"] % 3).any() and np.array_equal(small["wh"], source["wh"] // 3)
    np.testing.assert_allclose(small["K"], source["K"] * np.tile(ratio, 2))
    assert np.abs(photo(small, 0).mean((0, 1)) - photo(source, 0).mean((0, 1))).max() < 2   # it shrinks as a mean


def sphere(xyz, views, tracks, is_test=(False,) * 3, error=0, contain=()):
    points, n = np.column_stack([xyz, np.zeros(len(xyz)) + error, views]), len(tracks)
    s = data_prep.finish([np.zeros((2, 2, 3), np.uint8)] * n, np.ones((n, 4)), np.tile(np.eye(4)[:3], (n, 1, 1)),
                         np.array(is_test[:n]), ["a", "b", "c"][:n], points, tracks, {}, contain)
    return s["center"], s["scale"], s


def test_the_sphere_ignores_wild_points_and_prefers_what_many_see():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2000, 3))
    x *= (rng.random((2000, 1)) ** (1 / 3)) / np.linalg.norm(x, axis=1, keepdims=True)   # a unit ball
    xyz, views = np.concatenate([x, rng.normal([40, 0, 0], 3, (300, 3))]), np.repeat([20, 3], [2000, 300])
    seen = [np.arange(2000)] * 2
    centre, radius, s = sphere(xyz, views, seen)
    assert np.linalg.norm(centre) < .05 and .95 < radius < 1.15 and np.allclose(world(s, s["c2w"][:, :, 3]), 0)
    moved = np.hstack(sphere(xyz * 3 + [5, 6, 7], views, seen)[:2])
    np.testing.assert_allclose(moved, [*centre * 3 + [5, 6, 7], 3 * radius], atol=1e-6)
    equal = sphere(xyz, np.full(2300, 20), seen)   # without weights the far points count; 20 views are enough
    assert equal[1] > 20 and np.allclose(sphere(xyz, views * 50, seen)[0], equal[0])
    point = [np.arange(100), 2000 + np.arange(150), 2150 + np.arange(150)]   # two of three look elsewhere
    assert sphere(xyz, views, point)[1] > 30
    assert sphere(xyz, views, point, (False, True, True))[1] < 1.2   # test photos have no say
    assert np.isclose(sphere(xyz, views, seen, contain=centre + [[0, 3, 4], [1, 0, 0]])[1], 5.1)
    views, error = np.repeat([2, 3], [1750, 550]), np.arange(2300) % 550 / 100   # enough of three views, exact ones
    s, good = sphere(xyz, views, [np.arange(2300)] * 2, error=error)[2], views == 3
    good = np.flatnonzero(good & (error <= np.quantile(error[good], .95)))
    np.testing.assert_allclose(world(s, s["points"].astype(float)), xyz[good], atol=1e-4)
    tracks = np.stack([s["track_photo"], s["track_point"]])
    assert np.array_equal(tracks, [np.repeat([0, 1], len(good)), np.tile(np.arange(len(good)), 2)])
    assert len(sphere(xyz[:2249], views[:2249], seen)[2]["points"]) == 2249   # 499 are not enough


@pytest.mark.parametrize("text, says", [
    ("filename\tid\tsplit\tdataset\na b.jpg\t1.0\ttest\tx\nsub/c.jpg\t2.0\ttrain\tx\nno.jpg\t\ttrain\tx\n", GOOD_SPLIT),
    ("\ufeffid\tfilename\tsplit\n1\ta b.jpg\ttest\n2\tsub/c.jpg\ttrain\n\tno.jpg\ttrain\n", GOOD_SPLIT),
    ("id\tsplit\tfilename\tdataset\r\n1\ttest\ta b.jpg\tx\r\n2\ttrain\tsub/c.jpg\tx\r\n", GOOD_SPLIT),
    ("\tsplit\tnima\tfilename\n0\ttest\t5.1\ta b.jpg\n1\ttrain\t4\tsub/c.jpg\n", GOOD_SPLIT),
    ("", "header"), ("filename\tid\n", "header"), ("a,b\n", "header"), ("split\tfilename\ntrain\n", "None"),
    ("filename\tsplit\n\ttrain\n", "train or test"), ("filename\tsplit\nx.jpg\tvalid\n", "train or test"),
    ("filename\tsplit\nx.jpg\n", "train or test"), ("filename\tsplit\nx\ttrain\nx\ttest\n", "not both")])
def test_split_is_read_by_column_name_or_what_is_wrong_is_named(tmp_path, text, says):
    (tmp_path / "s.tsv").write_bytes(text.encode())
    with contextlib.nullcontext() if says is GOOD_SPLIT else pytest.raises(UserError, match=f"s.tsv.*{says}"):
        assert data_prep.read_split(tmp_path / "s.tsv") == says


def test_photos_left_out_are_reported_and_every_eighth_is_held_out_without_a_split(folder, capsys):
    rows = (folder / "toy.tsv").read_text().splitlines()
    (folder / "toy.tsv").write_text("\n".join(rows[:-1] + ["9\ttrain\tghost.jpg\ttoy"]).replace("test", "train"))
    (folder / "._toy.tsv").write_bytes(b"what a Mac leaves on other disks")
    (folder / "dense" / "images" / "toy_000.png").unlink()
    s, said = data_prep.prepare(folder), capsys.readouterr().err
    assert list(s["name"]) == [f"toy_00{i}.png" for i in range(1, 9)] and not s["is_test"].any()
    assert said.count("\n") == 3 and all(name in said for name in ("toy_000.png", "toy_009.png", "ghost.jpg"))
    (folder / "toy.tsv").unlink()
    s = data_prep.prepare(folder)
    assert np.flatnonzero(s["is_test"]).tolist() == [7] and list(s["name"]) == sorted(s["name"]) and len(s["name"]) == 9


def test_modes_and_rotations_of_photos_change_nothing(folder):
    from PIL import Image
    before, turned = data_prep.prepare(folder, 1), Image.Exif()
    turned[274] = 6   # by 90 degrees: COLMAP works on stored pixels
    for i, mode, kind in (0, "L", "PNG"), (1, "CMYK", "JPEG"), (3, "RGB", "JPEG"):
        path = folder / "dense" / "images" / f"toy_00{i}.png"
        Image.open(path).convert("RGB").convert(mode).save(path, kind, exif=turned, quality=98)
    after = data_prep.prepare(folder, 1)
    assert same(before, after, "wh", "K") and np.ptp(photo(after, 0), axis=2).max() == 0   # grey
    assert all(np.abs(photo(before, i).astype(float) - photo(after, i)).mean() < 12 for i in range(1, 10))


@pytest.mark.parametrize("model, bend", [(2, (.2,)), (3, (-.15, .02)), (4, (.1, 0, .01, -.01))])
def test_an_undistorted_photo_shows_nothing_but_photo_where_its_camera_says(tmp_path, source, model, bend):
    cameras, images, points = as_colmap(tmp_path, source, model, bend=bend)
    w, h, K = 90, 60, np.array([70.0, 72 if model == 4 else 70, 44, 31])
    grey = lambda x, y: 110 + 60 * x + 40 * y
    v, u = np.mgrid[:h, :w] + .5
    x0, y0 = (u - K[2]) / K[0], (v - K[3]) / K[1]
    x, y, (k1, k2, p1, p2) = x0.copy(), y0.copy(), np.append(bend, np.zeros(4))[:4]
    for _ in range(200):   # COLMAP's formula, turned round: where a straight photo shows what this one has at u, v
        r2 = x * x + y * y
        x += .5 * (x0 - x * (1 + k1 * r2 + k2 * r2 * r2) - 2 * p1 * x * y - p2 * (r2 + 2 * x * x))
        y += .5 * (y0 - y * (1 + k1 * r2 + k2 * r2 * r2) - 2 * p2 * x * y - p1 * (r2 + 2 * y * y))
    cv2.imwrite(str(tmp_path / "dense" / "images" / "toy_000.png"), grey(x, y).round().astype(np.uint8))
    cameras[7] = (model, w, h, (*(K if model == 4 else K[[0, 2, 3]]), *bend))
    write_colmap(tmp_path / "dense" / "sparse", cameras, images, points)
    s = data_prep.prepare(tmp_path, 1)
    fx, fy, cx, cy = s["K"][0]
    miss = photo(s, 0)[..., 0] - grey((u - cx) / fx, (v - cy) / fy)
    assert np.abs(miss).max() < 3 and abs(miss.mean()) < .3   # half a pixel would be .7


def test_very_narrow_and_very_wide_photos_are_left_out_of_training_only(tmp_path, source, capsys):
    cameras, images, points = as_colmap(tmp_path, source)
    for i, angle in zip([0, 1, 3, 4, 2, 7], [*np.radians([9.9, 120.1, 10.1, 119.9]), .1, 3.1]):   # of the long side
        w, h = map(int, source["wh"][i])   # 2 and 7 are for testing
        f = max(w, h) / 2 / np.tan(angle / 2)
        cameras[3 * i + 7] = (1, w, h, (f, f, w / 2, h / 2))
    write_colmap(tmp_path / "dense" / "sparse", cameras, images, points)
    s = data_prep.prepare(tmp_path)
    assert set(source["name"]) - set(s["name"]) == {"toy_000.png", "toy_001.png"}
    assert "2 photos are narrower" in capsys.readouterr().err and s["is_test"].sum() == 2


@pytest.mark.parametrize("far", [1e300, -1e200, 1e30, np.inf, np.nan])
def test_points_absurdly_far_away_do_no_harm(tmp_path, source, far):
    cameras, images, points = as_colmap(tmp_path, source)
    clean, ids, track = data_prep.prepare(tmp_path, 1), [2 ** 50 + k for k in range(4)], [(i[0], 0) for i in images]
    bad = [(k, np.roll((far, 1., 2.), k), .5, track) for k in ids[:3]] + [(ids[3], (1., 2., 3.), far, track)]
    write_colmap(tmp_path / "dense" / "sparse", cameras, [(*rest, [*own, *ids]) for *rest, own in images], bad + points)
    with np.errstate(all="raise"):
        data_prep.write_scene(tmp_path / "s.npz", data_prep.prepare(tmp_path, 1))
    assert same(data_prep.read_scene(tmp_path / "s.npz"), clean)


camera = lambda *params, model=1: lambda c, i, p: c.__setitem__(7, (model, *c[7][1:3], params))
first = lambda field, value: lambda c, i, p: i[0].__setitem__(field, value)
points_at = lambda x: lambda c, i, p: p.__setitem__(slice(None), [(key, (x, 2., 3.), *rest) for key, _, *rest in p])
SPARSE, PHOTO = Path("place/dense/sparse"), Path("place/dense/images/toy_000.png")
CASES = {   # what is changed of cameras {}, images [[]], points []; or on disk
    "fisheye": (camera(*(30.,) * 8, model=5), "image_undistorter"), "model": (camera(30., model=77), "undistorter"),
    "negative focal": (camera(-30., 30., 2., 1.), "camera 7"), "tiny focal": (camera(3., 1e-300, 2., 1.), "camera 7"),
    "infinite centre": (camera(30., 30., np.inf, 15.), "camera 7"), "nan": (first(1, [np.nan] * 4), "toy_000.png"),
    "zero quaternion": (first(1, [0.] * 4), "toy_000.png"), "windows": (first(4, "..\\toy_000.png"), "outside"),
    "absurd": (first(2, [1., 2., -1e300]), "toy_000.png"), "no such camera": (first(3, 12345), "toy_000.png"),
    "twice": (first(4, "toy_001.png"), "toy_001.png"), "escaping": (first(4, "../toy_000.png"), "outside"),
    "absolute": (first(4, "/toy_000.png"), "outside"), "no points": (lambda c, i, p: p.clear(), "overlapping"),
    "points at one place": (points_at(1.), "coincide"), "points at infinity": (points_at(np.inf), "overlapping"),
    "only test": (lambda c, i, p: [j.__setitem__(5, []) for j in i if j[4][6] not in "27"], "no training photo"),
    "size": (lambda *_: cv2.imwrite(str(PHOTO), np.zeros((7, 9, 3), np.uint8)), "toy_000.png"),
    "no photo": (lambda *_: PHOTO.write_text("x"), "toy_000.png"), "cut off": (lambda *_: PHOTO.write_bytes(
        cv2.imencode(".jpg", cv2.imread(str(PHOTO)))[1].tobytes()[:-99]), "toy_000.png"),
    "two gigapixels": (lambda *_: PHOTO.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in (
            struct.pack(">4sIIBBBBB", b"IHDR", 60_000, 40_000, 8, 2, 0, 0, 0), b"IDAT", b"IEND"))), "toy_000.png"),
    "two splits": (lambda *_: Path("place/b.tsv").write_text("x"), "--split"),
    "one train": (lambda *_: Path("place/toy.tsv").write_text("filename\tsplit\ntoy_000.png\ttrain\n"), "split file"),
    "no images": (lambda *_: PHOTO.parent.rename("place/elsewhere"), "place --sfm"),
    "missing file": (lambda *_: (SPARSE / "0").mkdir(), "points3D.bin is missing")}


@pytest.mark.parametrize("what", CASES)
def test_bad_input_gives_one_sentence_and_exit_code_2(desk, source, what):
    cameras, images, points = as_colmap(desk / "place", source)
    images, (change, says) = list(map(list, images)), CASES[what]
    change(cameras, images, points)
    write_colmap(SPARSE, cameras, images, points)
    with np.errstate(all="raise"):
        code, out, err = run_main("place")
    assert not (desk / "data").exists() and np.flatnonzero(source["is_test"]).tolist() == [2, 7]
    *reports, last = err.splitlines()
    assert (code, out, last[:7], len(reports)) == (2, "", "error: ", what == "one train") and says in last


def survives(read, path, data):
    """What read() makes of a file with this content; None where it refuses that in one sentence."""
    good = path.read_bytes() if path.exists() else b""
    path.write_bytes(data)
    try:
        return read()
    except UserError as e:
        assert "\n" not in str(e)
    finally:
        path.write_bytes(good)


def peak(call, *args):
    """Bytes that Python and numpy take at most, and the result."""
    tracemalloc.start()
    result, size = call(*args), tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return result, size


def flipped(data, bits):
    data = bytearray(data)
    for at in bits:
        data[at // 8] ^= 1 << at % 8
    return bytes(data)


@pytest.fixture(scope="module", params=["cameras.bin", "images.bin", "points3D.bin", "s.tsv"])
def damaged(tmp_path_factory, request):
    """What a file's reader makes of other bytes, its good bytes, and where their first record promises a length."""
    folder = tmp_path_factory.mktemp("model")
    images = [(1, (1., 0, 0, 0), (0., 0, 0), 1, "a b.jpg", [0, 1, 2]), (2, (1., .1, 0, 0), (1., 0, 0), 2, "c.jpg", [2])]
    write_colmap(folder, {1: (1, 8, 6, (9., 9., 4., 3.)), 2: (2, 8, 6, (9., 4., 3., .1))}, images,
                 [(i, (float(i), 1., 2.), .5, [(1, 0), (2, 0)]) for i in range(3)])
    path = folder / request.param
    if path.name == "s.tsv":
        path.write_text("filename\tid\tsplit\tdataset\na b.jpg\t1\ttest\tx\nsub/c.jpg\t2.0\ttrain\tx\nd.png\t\ttrain\n")
    read = (lambda: data_prep.read_split(path)) if path.name == "s.tsv" else lambda: data_prep.read_colmap(folder)
    promise = {"images.bin": path.read_bytes().find(b"a b.jpg") + 8, "points3D.bin": 8 + 43}.get(path.name, 0)
    return functools.partial(survives, read, path), path.read_bytes(), promise


def test_truncation_and_promised_counts_are_noticed_before_memory_is_taken_and_damage_does_no_harm(damaged):
    (read, data, promise), rng = damaged, np.random.default_rng(0)
    assert read(data) and (b"filename" in data or not any(read(data[:n]) for n in range(len(data))))
    for at in {0, promise}:
        for count in (4, 1000, 2 ** 31, 2 ** 40, 2 ** 63, 2 ** 64 - 1):
            result, size = peak(read, data[:at] + struct.pack("<Q", count) + data[at + 8:])
            assert result is None and size < 2 ** 20
    for i in range(40):
        junk = rng.bytes(rng.integers(200))
        read(flipped(data, rng.integers(8 * len(data), size=i % 5)))
        read(struct.pack("<Q", i % 4) + junk)
        read(b"filename\tid\tsplit\n" + junk)


def zipped(scene, save=np.savez):
    file = io.BytesIO()
    save(file, **scene)
    return file.getvalue()


@pytest.fixture(scope="module")
def stored():
    return (scene := data_prep.make_toy(size=16, photos=4, test=1)), zipped(scene)


def readable(path, data):
    scene = survives(lambda: data_prep.read_scene(path), path, data)
    if scene:
        assert len(scene["wh"]) == 5 and all(photo(scene, i).size for i in range(5))
        assert np.isfinite(scene["points"][scene["track_point"]]).all() and scene["c2w"][scene["track_photo"]].size
    return bool(scene)


@pytest.mark.parametrize("seed", range(20))
def test_damaged_scene_files_do_no_harm(tmp_path, stored, seed):
    path, (_, good), rng = tmp_path / "s.npz", stored, np.random.default_rng(seed)
    head, end = good.find(b"NUMPY"), good.find(b"PK\1\2")   # an array's header, the directory
    for low, high in (0, len(good)), (end, len(good)), (head, head + 120):
        readable(path, flipped(good, rng.integers(8 * low, 8 * high, 1 + seed % 4)))
    assert not readable(path, good[:rng.integers(len(good) - 23)]) and not readable(path, rng.bytes(10 * seed))


@pytest.mark.parametrize("key", sorted(data_prep.FORMAT))
def test_scene_files_with_a_wrong_array_are_refused(tmp_path, stored, key):
    (scene, good), path = stored, tmp_path / "s.npz"
    assert readable(path, good) and not readable(path, zipped({k: v for k, v in scene.items() if k != key}))
    junk = [np.array(0), np.zeros((5, 0)), np.zeros((2, 3, 4)), np.array("x"), np.array(["a", "b"]), np.full(5, np.nan),
            np.full(5, -1), np.ones(5, bool), np.zeros(5, "V4"), np.array([2 ** 63], "u8"), np.array("[1]"), np.array("{}")]
    array = np.asarray(scene[key])
    wrong = [*junk, array[..., None], array[:-1] if array.ndim else array[None]]
    if array.dtype.kind == "f":
        wrong += [array.astype(">f8"), array.astype(complex)] + [np.where(np.arange(array.size).reshape(array.shape) > 0, array, np.inf)] * (key != "bg_color")
    if key in ("scale", "footprint", "start", "wh", "track_photo", "track_point"):
        wrong += [array - array.max() - 1, array * 0 - (key[:5] == "track"), array + 10 ** 6 if array.ndim else -array]
    for value in wrong:
        assert not readable(path, zipped(scene | {key: value})), value


def test_bombs_and_promised_shapes_are_refused(tmp_path, stored):
    (scene, _), path = stored, tmp_path / "s.npz"
    bomb = zipped(scene | dict(rgb=np.zeros((2 ** 24, 3), np.uint8)), np.savez_compressed)
    assert len(bomb) < 2 ** 20 > peak(readable, path, bomb)[1] / 4 and not readable(path, bomb)   # unread
    for count in (10 ** 5, 2 ** 31, 2 ** 40, 2 ** 62, 2 ** 80):
        with zipfile.ZipFile(path, "w") as file:
            for key, value in scene.items():
                array, head = io.BytesIO(), np.lib.format.header_data_from_array_1_0(value)
                np.lib.format.write_array_header_1_0(array, dict(head, shape=(count, 3)) if key == "rgb" else head)
                file.writestr(f"{key}.npy", array.getvalue() + value.tobytes())
        assert not readable(path, path.read_bytes())


class Evil(str):
    """Makes a folder of this name when it is unpickled."""
    def __reduce__(self):
        return os.mkdir, (str(self),)


def test_a_scene_file_never_runs_code(tmp_path, stored):
    path, harm = tmp_path / "s.npz", tmp_path / "harm"
    evil = np.array([Evil(harm)] * 5, object)
    for data in (*(zipped(stored[0] | {key: evil}) for key in ("name", "more")), pickle.dumps(Evil(harm))):
        assert not readable(path, data)
    assert not harm.exists() and not pickle.loads(pickle.dumps(Evil(harm))) and harm.exists()   # it is live


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), ValueError("x")])
def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "sub" / "sub" / "scene.npz"
    data_prep.atomic_write(path, lambda part: part.write_text("old"))
    def write(part):
        assert part.suffix == ".npz" and part.parent == path.parent and part.write_text("half")
        raise error
    with pytest.raises(UserError if isinstance(error, OSError) else type(error)) as e:
        data_prep.atomic_write(path, write)
    assert not isinstance(error, OSError) or "scene.npz (No space" in str(e.value)
    for place, write in ((path, lambda part: bool(part.write_text(""))), (path / "a.png", lambda part: part.touch())):
        with pytest.raises(UserError):   # as cv2.imwrite says no; below a file
            data_prep.atomic_write(place, write)
    assert path.read_text() == "old" and os.listdir(path.parent) == ["scene.npz"]


@pytest.mark.parametrize("name, home", [("place", "place"), ("sacre", "data/sacre"), ("sacre", "data/sacre_coeur")])
def test_a_scene_is_made_once_and_anew_when_its_sources_change(desk, source, capsys, name, home):
    as_colmap(desk / home, source)
    photos, poses, table = (desk / home / part for part in ("dense/images", "dense/sparse/images.bin", "toy.tsv"))

    def makes(downscale=2):
        capsys.readouterr()
        scene, path = data_prep.open_scene(name, downscale), data_prep.scene_path(name)
        assert np.array_equal(scene["wh"], source["wh"] // downscale) and same(scene, data_prep.read_scene(path))
        age(path, 2000)
        return capsys.readouterr().out.startswith(f"making {path}\n")
    one = [age(file, 0) or file for file in (desk / home, *photos.iterdir())][-1]
    assert makes()
    for file, when, want in ((photos, 0, True), (poses, 0, True), (table, 0, False), (poses, 3000, True), (poses, 0, False),
                             (table, 3000, True), (table, 2000, False), (photos, 3000, True), (photos, 0, False),
                             (one, 3000, True), (one, 0, False), (desk / home, 3000, True), (desk / home, 0, False)):
        age(file, when)
        assert makes() == want
    assert makes(4) and not makes(4) and makes()


def test_a_split_named_once_stays_when_the_scene_is_made_again(desk, folder, capsys):
    names, table = sorted(os.listdir(folder / "dense/images")), desk / "mine.tsv"   # not the folder's own
    table.write_text("filename\tsplit\n" + "".join(f"{n}\t{'test' if n == names[2] else 'train'}\n" for n in names))
    assert run_main(folder, "--split", "mine.tsv", "--downscale", 1)[0] == 0
    [age(file, 1000) for file in folder.glob("**/*")]
    for downscale, when in ((1, 1000), (2, 1000), (2, 3000), (2, 1000)):
        age(table, when)
        scene = data_prep.open_scene(folder, downscale)
        assert scene["name"][scene["is_test"]].tolist() == [names[2]]
        age(data_prep.scene_path(folder), 2000)
    assert capsys.readouterr().out.count("making") == 2
    table.unlink()
    with pytest.raises(UserError, match="mine.tsv is not there"):
        data_prep.open_scene(folder, 4)


def test_every_folder_has_a_file_of_its_own_and_a_toy_stays_as_it_was_made(desk, source, monkeypatch, capsys):
    paths = [data_prep.scene_path(n) for n in ("toy", "sacre", "one/photos", "two/photos", "./toy", desk / "sacre")]
    assert [str(p) for p in paths[:2]] == ["data/toy.npz", "data/sacre.npz"] and len(set(paths)) == len(paths)
    assert all(p.parent == Path("data") and p.suffix == ".npz" for p in paths) and paths[2].name.startswith("photos-")
    assert data_prep.scene_path(desk / "one/photos") == paths[2] == data_prep.scene_path("one/../one/photos")
    for name, command in (("sacre", "python data_prep.py sacre --download"), ("nowhere", "data_prep.py nowhere --sfm")):
        with pytest.raises(UserError, match=command):
            data_prep.open_scene(name)
    made, small, other, _ = [], toy(), toy(seed=1), capsys.readouterr()
    monkeypatch.setattr(data_prep, "make_toy", lambda **knobs: made.append(knobs) or small)
    assert same(data_prep.open_scene("toy", 7), small) and "making" in capsys.readouterr().out
    data_prep.write_scene(paths[0], other)   # by data_prep.py toy --seed 1
    (desk / "x.tsv").write_text("newer, and no business of the toy")
    assert same(data_prep.open_scene("toy", 3), other) and made == [{}] and not capsys.readouterr().out
    as_colmap(desk / "toy", source)   # a folder called toy is no toy
    assert info(data_prep.open_scene(g.Config(data="toy").source))["kind"] == "colmap"


class Server(http.server.BaseHTTPRequestHandler):
    """Ranges, or not; breaks off after `limit` bytes of an answer."""
    files, ranges, limit, asked = {}, True, None, []

    def do_GET(self):
        cls, data = type(self), type(self).files.get(self.path)
        start = int(self.headers.get("Range", "bytes=0-")[6:-1]) if cls.ranges else 0
        cls.asked.append((self.path, start))
        if data is None:
            return self.send_error(404)
        self.send_response(416 if start >= len(data) else 206 if start else 200)
        self.send_header("Content-Length", str(max(len(data) - start, 0)))
        self.end_headers()
        self.wfile.write(data[start:][:cls.limit])
    log_message = lambda *_: None


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


PLACE, TAR = "brandenburg_gate/dense/", "/t/brandenburg_gate.tar.gz"
GOOD = [(PLACE + "images/a.jpg", np.random.default_rng(0).bytes(50_000)), (PLACE + "sparse/cameras.bin", b"x"),
        (PLACE + "stereo/big.bin", b"y"), ("brandenburg_gate/other.txt", b"z")]
WANTED = {"brandenburg.tsv": b"filename\tsplit\n", "dense/images/a.jpg": GOOD[0][1], "dense/sparse/cameras.bin": b"x"}


@pytest.fixture
def server(desk):
    handler = type("Handler", (Server,), dict(asked=[]))
    handler.files = {TAR: archive(GOOD), "/s/brandenburg.tsv": b"filename\tsplit\n"}
    web = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=web.serve_forever, args=(.02,), daemon=True).start()
    handler.base = f"http://127.0.0.1:{web.server_port}"
    handler.get = lambda: data_prep.download("brandenburg", handler.base + "/t/", handler.base + "/s/")
    handler.part, home = desk / "data" / "brandenburg_gate.tar.gz.part", desk / "data" / "brandenburg"
    handler.unpacked = lambda: {str(p.relative_to(home)): p.read_bytes() for p in home.rglob("*") if p.is_file()}
    yield handler
    web.shutdown()
    web.server_close()


@pytest.mark.parametrize("ranges", [True, False])
def test_broken_download_goes_on_where_it_stopped_and_unpacks_what_is_wanted(server, ranges):
    server.limit, server.ranges = 20_000, ranges
    with pytest.raises(UserError, match="same command"):
        server.get()
    assert server.part.stat().st_size == 20_000 and not Path("data/brandenburg").exists()
    server.limit = None
    server.get()
    assert server.asked[-1] == (TAR, 19_999 if ranges else 0) and server.unpacked() == WANTED
    assert Path("data/brandenburg_gate.tar.gz").read_bytes() == server.files[TAR]
    assert sorted(os.listdir("data")) == ["brandenburg", "brandenburg.tsv", "brandenburg_gate.tar.gz"]
    with pytest.raises(UserError, match="there already"):
        server.get()
    assert len(server.asked) == 3   # nothing is fetched twice


def test_whole_parts_are_used_those_of_another_file_started_over_and_what_fails_is_said(server):
    server.part.parent.mkdir()
    server.part.write_bytes(b"?" * 200_000)   # longer than the file
    with pytest.raises(UserError):
        server.get()
    assert not server.part.exists()
    server.part.write_bytes(server.files[TAR])
    server.get()
    assert server.unpacked() == WANTED and not server.part.exists()
    for name, address, says in (("sacre", server.base + "/", "404"), ("taj", "http://127.0.0.1:9/", "127.0.0.1"),
                                ("nowhere", "", "--download knows")):
        with pytest.raises(UserError, match=says):
            data_prep.download(name, address, address)


@pytest.mark.parametrize("evil", [
    (PLACE + "images/../../../../evil.txt", b"x"), ("/evil.txt", b"x"), ("../evil.txt", b"x"),
    (PLACE + "images/link", "/etc"), (PLACE + "images/link", "../../../.."), ("brandenburg_gate/dense/images", "/tmp")])
def test_archives_cannot_write_outside(server, desk, evil):
    server.files[TAR] = archive([*GOOD, evil, (PLACE + "images/link/evil.txt", b"x")])
    with contextlib.suppress(UserError):
        server.get()
    inside = all(desk / "data" / "brandenburg" in p.parents for p in desk.rglob("evil.txt"))
    assert inside and not [p for p in desk.rglob("*") if p.is_symlink()] and os.listdir(desk) == ["data"]


@pytest.mark.parametrize("damage", [
    lambda b: b[:30_000], lambda b: b"no archive", lambda b: b[:9000] + b"?" * 99 + b[9099:],
    lambda b: b[:-8] + b"????" + b[-4:], lambda b: archive(GOOD[2:])])
def test_damaged_archives_are_named_and_leave_nothing(server, damage):
    server.files[TAR] = damage(server.files[TAR])
    with pytest.raises(UserError, match="brandenburg_gate.tar.gz"):
        server.get()
    assert sorted(os.listdir("data")) == ["brandenburg.tsv", "brandenburg_gate.tar.gz"]


def test_command_line_makes_a_toy_and_reads_a_folder_or_ends_in_one_sentence(desk, folder, monkeypatch):
    code, out, _ = run_main("toy", "--size", 32, "--photos", 6, "--test", 2, "--no-background", "--occluders", .2)
    assert code == 0 and "data/toy.npz: 8 photos, 2 of them" in out
    assert same(data_prep.read_scene("data/toy.npz"), toy(occluders=.2, background=False))
    for flags, downscale in ((["--downscale", 4], 4), ([], 2)):
        code, _, err = run_main("place", *flags)
        assert (code, err) == (0, "") and info(np.load(data_prep.scene_path(folder)))["downscale"] == downscale
    for error, say in (KeyboardInterrupt(), "stopped"), (OSError(13, "denied"), "denied"), (MemoryError("a"), "a"):
        monkeypatch.setattr(data_prep, "shade", lambda *_: (_ for _ in ()).throw(error))
        code, _, err = run_main("toy", "--photos", 4, "--test", 0)
        assert code == 2 and say in err and err.count("\n") == 1


@pytest.mark.parametrize("argv", """toy --sizee 9, toy --siz 9, toy --size x,, nowhere, brandenburg, x --download,
    toy --occluders 2, place --downscale 0, place --downscale 16, toy --pose_noise nan, toy --pose_noise inf,
    toy --downscale 4, toy --split x.tsv, place --split x.tsv, toy --exposure -1, toy --exposure 2.1, toy --seed -1,
    place --size 9, toy --size 15, toy --photos 3, toy --test -1, toy --pose_noise -1, toy --landmark -1""".split(","))
def test_misspelt_commands_exit_with_2(desk, folder, argv):
    code, out, err = run_main(*argv.split())
    assert code == 2 and out == "" and "error: " in err and "Traceback" not in err and not (desk / "data").exists()


def test_sfm_calls_pycolmap_in_order_once(desk, monkeypatch, source):
    photos, calls, count = desk / "raw", [], lambda n: SimpleNamespace(num_reg_images=lambda: n)
    photos.mkdir()
    fake = SimpleNamespace(extract_features=lambda *a: calls.append(a), match_exhaustive=lambda *a: calls.append(a),
        incremental_mapping=lambda *a: calls.append(a) or {0: count(2), 1: count(9), 2: count(3)},
        undistort_images=lambda *a: calls.append(a) or as_colmap(photos, source))
    monkeypatch.setitem(sys.modules, "pycolmap", fake)
    base, models = photos / "database.db", photos / "models"
    assert run_main(photos, "--sfm")[0] == 0 and data_prep.scene_path(photos).exists() and models.is_dir()
    assert calls == [(base, photos), (base,), (base, photos, models), (photos / "dense", models / "1", photos)]
    assert "has dense/" in run_main(photos, "--sfm")[2]   # its photos would be posed twice
    (photos / "dense").rename(desk / "old")
    fake.incremental_mapping = lambda *_: {}
    assert "overlap" in run_main(photos, "--sfm")[2]
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert "pycolmap" in run_main(photos, "--sfm")[2]
    monkeypatch.setattr(data_prep, "download", lambda name: as_colmap(desk / "data" / name, source))
    assert run_main("sacre", "--download")[0] == 0 and data_prep.scene_path("sacre").exists()


TINY = dict(rays=64, photos=4, samples=8, bg_samples=4, hidden=16, levels=2, appearance_dim=4, steps=6)
BITS = list(itertools.product((0, 1), repeat=3))


def config(**changes):
    return g.Config(**TINY | changes)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def random(*shape, seed=0, low=0.0, high=1.0, dtype=torch.float64):
    return low + (high - low) * torch.rand(*shape, generator=generator(seed), dtype=dtype)


def close(a, b, rtol=1e-5, atol=1e-6):
    a, b = (torch.as_tensor(v).detach().double() for v in (a, b))
    torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


def batch(scene, n=64, photos=4, seed=0, among=None):
    """Rays and the photos they come from, of one step."""
    model = SimpleNamespace(scene=scene, cfg=config(photos=photos, rays=n))
    return g.GeoNVS.batch(model, scene.photos(False) if among is None else torch.tensor(among), n, generator(seed))


def new_model(scene, seed=0, **changes):
    torch.manual_seed(seed)
    return g.GeoNVS(config(seed=seed, **changes), scene)


seeded = pytest.fixture(lambda: torch.manual_seed(0), autouse=True, name="seeded")
double = pytest.fixture(lambda monkeypatch: monkeypatch.setattr(g, "TRILINEAR", g.TRILINEAR.double()), name="double")  # octrees


@pytest.fixture(scope="session")
def scene():
    return g.load_scene(toy(photos=8))


@pytest.fixture(scope="session")
def warm(scene):
    """A model after its sphere warm-up; a test that changes it takes a copy."""
    model = new_model(scene)
    model.start(generator(), radius=0.5)
    model.zero_grad()
    return model


# ---- 2 scene file and rays -----------------------------------------------------------------------

def scene_of(wh, rgb, **changes):
    """A scene of these photos, (w, h) and pixels, the second held out, without SfM points."""
    n, none = len(wh), np.zeros(0, int)
    raw = dict(rgb=rgb, start=np.cumsum([0, *(w * h for w, h in wh)]), wh=np.array(wh), K=np.ones((n, 4)),
               c2w=np.tile(np.eye(3, 4), (n, 1, 1)), near=np.full(n, 0.1), is_test=np.arange(n) == 1,
               points=np.zeros((0, 3)), track_photo=none, track_point=none, track_uv=np.zeros((0, 2)),
               info=np.array(json.dumps(dict(scene="own", kind="colmap"))))
    return g.load_scene(raw | changes)


@pytest.fixture(scope="session")
def odd():
    """Two photos, landscape and portrait, with fx != fy and principal points off centre."""
    rng = np.random.default_rng(0)
    turn = np.stack([np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2)])
    turn *= np.sign(np.linalg.det(turn))[:, None, None]  # proper rotations
    return scene_of([(7, 4), (3, 5)], rng.integers(0, 256, (43, 3)).astype(np.uint8), near=np.array([0.1, 0.2]),
                    K=np.array([[6.0, 8, 2.3, 1.1], [4, 3, 2.2, 3.3]]),
                    c2w=np.concatenate([turn, rng.normal(size=(2, 3, 1))], 2))


def test_ray_through_a_pixel_projects_back_to_its_centre_and_has_its_colour(odd):
    for i, (w, h) in enumerate(odd.wh.tolist()):
        rays = g.make_rays(odd, torch.full((w * h,), i), torch.arange(w * h))
        t = random(w * h, 2, low=0.5, high=9, dtype=torch.float32)
        cam = (rays.at(t)[:, 1] - odd.c2w[i, :, 3]) @ odd.c2w[i, :, :3]  # world to camera
        want = torch.tensor([[x + 0.5, y + 0.5] for y in range(h) for x in range(w)])
        close(cam[:, :2] / cam[:, 2:] * odd.K[i, :2] + odd.K[i, 2:], want, atol=1e-4)
        close(rays.uv * torch.tensor([w, h]), want)
        close(cam.norm(dim=1), t[:, 1])  # a distance along the ray, in front of the camera
        assert (cam[:, 2] > 0).all() and (rays.near == odd.near[i]).all() and (rays.img == i).all()
        close(rays.rgb * 255, odd.raw["rgb"][odd.start[i]:odd.start[i + 1]], atol=1e-3)


def test_random_rays_come_equally_from_the_photos_allowed_and_cover_them(odd):
    rays, pick = batch(odd, 600, 3, among=[1])
    assert pick.tolist() == [1, 1, 1] and set(rays.img.tolist()) == {1}
    rays, pick = batch(odd, 3000, 30, seed=1, among=[0, 1])
    assert torch.equal(rays.img, pick.repeat_interleave(100)) and set(pick.tolist()) == {0, 1}
    for i, n in enumerate((28, 15)):  # a pixel is missed with odds below 28 (27/28)^900 = 2e-13
        mine = rays.img == i
        assert mine.sum() >= 900 and len((rays.uv[mine] * odd.wh[i]).floor().unique(dim=0)) == n


@pytest.mark.parametrize("side, small", [(40, 96), (400, 200), (900, 256)])
def test_thumbnails_are_whole_photos_upright_in_rgb_of_half_the_usual_size(side, small):
    wh, photos = [(side, side // 2), (side // 2, side), (3, 2)], []
    for w, h in wh:
        across, down = np.meshgrid(np.arange(w) / w, np.arange(h) / h)
        photos.append(np.stack([255 * across, 255 * down, 0 * down], 2).reshape(-1, 3).astype(np.uint8))
    scene, ramp = scene_of(wh, np.concatenate(photos)), 255 * torch.arange(small) / small
    assert scene.thumbs.shape == (3, 3, small, small) and scene.thumbs.dtype == torch.uint8
    for channel, want in ((0, ramp), (1, ramp[:, None]), (2, 0 * ramp)):  # to a pixel of the shorter side
        close(scene.thumbs[:2, channel], want.expand(2, small, small), atol=2 + 2 * 255 / side, rtol=0)
    assert scene.photos(True).tolist() == [1] and scene.photos(False).tolist() == [0, 2]


def sphere_rays(o, d, near=0.1):
    o, d = torch.as_tensor(o).float(), F.normalize(torch.as_tensor(d).float(), dim=1)
    return g.Rays(o, d, near + 0 * o[:, 0], torch.zeros(len(o)).long(), 0 * o[:, :2], 0 * o)


def test_sphere_interval_is_where_a_ray_is_inside_or_empty_at_its_closest_approach():
    o, d = random(4000, 3, low=-3, high=3), random(4000, 3, seed=1, low=-1)
    o[0], d[0] = torch.tensor([0, 1.0, -3]), torch.tensor([0, 0, 1.0])  # touches
    t0, t1 = g.sphere_interval(rays := sphere_rays(o, d))
    t = random(4000, 300, low=0.1, high=7, seed=2, dtype=torch.float32)
    within, r = (t > t0[:, None]) & (t < t1[:, None]), rays.at(t).norm(dim=2)
    assert (r[within] < 1 + 1e-5).all() and (r[~within] > 1 - 1e-5).all() and (t0 >= rays.near).all()
    assert (t0 <= t1).all() and 0.02 < (hit := t0 < t1).float().mean() < 0.9
    close(t0[~hit], (rays.o * -rays.d).sum(1)[~hit].clamp(min=0.1), atol=1e-5)


# ---- 3 octree ------------------------------------------------------------------------------------

def of_level(octree, level):
    """The cells (N,4) of a level."""
    return octree.cells[octree.cells[:, 0] == level]


def counts(octree):
    return octree.cells[:, 0].bincount(minlength=octree.levels).tolist()


def make_tree(seed=0, half=1.5, levels=4, root=3, channels=2, share=0.35, dtype=torch.float64):
    """A tree with a random share of each level's cells split and random features."""
    octree = g.Octree(half, levels, channels, root=root).to(dtype)
    for level in range(levels - 1):
        cells = of_level(octree, level)
        octree.split(cells[random(len(cells), seed=seed + level) < share])
    return fill(octree, seed)


def fill(octree, seed=0):
    own = octree.features.data[g.PINNED:]
    own[:] = random(*own.shape, seed=seed, low=-1).to(own)
    return octree


def corners_of(octree):
    """(level, i, j, k) of the corners that own a row, in the order of rows, from their keys."""
    n, key = octree.root * 2 ** octree.levels + 1, octree.row_key[g.PINNED:]
    return list(zip(*(v.tolist() for v in (key // n ** 3, key // n ** 2 % n, key // n % n, key % n))))


def naive_lookup(octree, x):
    """Features (L,C) at one point by loops over levels and corners; float64."""
    table = dict(zip(corners_of(octree), octree.features[g.PINNED:].detach().double()))
    out = torch.zeros(octree.levels, octree.features.shape[1], dtype=torch.float64)
    cells = octree.cells.tolist()
    for level in range(octree.levels):
        at = [(float(v) / (2 * octree.half) + 0.5) * octree.root * 2 ** level for v in x]
        cell = [math.floor(v) for v in at]
        for bits in BITS if [level, *cell] in cells else ():
            weight = math.prod(p - c if b else 1 - (p - c) for p, c, b in zip(at, cell, bits))
            feature = table.get((level, *(c + b for c, b in zip(cell, bits))))
            out[level] += 0 if feature is None else weight * feature
    return out


@pytest.mark.parametrize("dtype, atol", [(torch.float64, 1e-9), (torch.float32, 2e-5)])
def test_lookup_equals_a_naive_loop(monkeypatch, dtype, atol):
    monkeypatch.setattr(g, "TRILINEAR", g.TRILINEAR.to(dtype))
    octree, x = make_tree(dtype=dtype), random(150, 3, seed=9, low=-1.5, high=1.5)
    want = torch.stack([naive_lookup(octree, p) for p in x])
    close(octree(x.to(dtype))[:, :, 0], want, atol=atol)
    assert (want[:, 3] != 0).any() and (want[:, 3] == 0).any()  # deep and shallow paths both occur


def test_interpolate_is_a_plain_weighted_sum_there_and_back_but_pinned_rows_learn_nothing():
    features = random(g.PINNED + 9, 2, low=-1).requires_grad_()
    corner = (random(50, 8, seed=1) * len(features)).int()
    corner[10:] = g.PINNED + corner[10:] % 9  # the same rows again and again
    w, pull = random(50, 3, 8, seed=2, low=-1), random(50, 3, 2, seed=3, low=-1)
    values = torch.einsum("pjk,pkc->pjc", w, features[corner.long()]), g.Interpolate.apply(features, corner, w)
    close(*values)
    want, got = (torch.autograd.grad(value, features, pull)[0] for value in values)
    close(got[g.PINNED:], want[g.PINNED:])
    assert (got[:g.PINNED] == 0).all() and (want[:g.PINNED] != 0).any()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_corner_owns_a_row_if_all_its_cells_exist_and_is_pinned_if_not(seed):
    octree, want = make_tree(seed), set()
    for level in range(octree.levels):
        have, n = set(map(tuple, of_level(octree, level)[:, 1:].tolist())), octree.root << level
        for corner in itertools.product(range(n + 1), repeat=3):
            around = [tuple(c - b for c, b in zip(corner, bits)) for bits in BITS]
            if have.issuperset(c for c in around if min(c) >= 0 and max(c) < n):
                want.add((level, *corner))
    owners, pinned = corners_of(octree), octree.corner[octree.corner < g.PINNED].unique()
    assert len(owners) == len(set(owners)) and set(owners) == want
    assert len(pinned) > g.PINNED / 2 and (octree.features[pinned] == 0).all()  # spread, for a GPU
    assert octree.corner[:8].flatten().tolist() == list(range(g.PINNED))


def structure(octree):
    return [v.tolist() for v in (octree.row_key, octree.child, octree.corner, octree.cells, octree.split_keys)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_split_does_not_change_the_function_by_a_bit_and_splitting_again_nothing(double, seed):
    octree, x = make_tree(seed, share=0.2), random(500, 3, low=-1.5, high=1.5)
    before = octree(x, derivatives=True)
    for level in (0, 1, 2, 0):
        cells, n = of_level(octree, level), len(octree.cells)
        octree.split(cells[random(len(cells), seed=n) < 0.5])
        leaf = of_level(octree, level)[~torch.isin(octree.key(of_level(octree, level)), octree.split_keys)]
        grown = structure(octree)
        octree.split(cells[random(len(cells), seed=n) < 0.5])  # again
        octree.split(leaf * torch.tensor([1, 2, 2, 2]) + torch.tensor([1, 0, 0, 0]))  # children that do not exist
        octree.split(of_level(octree, octree.levels - 1))  # and the finest have none
        assert len(octree.cells) > n and structure(octree) == grown
        assert torch.equal(octree(x, derivatives=True), before)


def test_merging_removes_subtrees_and_splitting_again_restores_all_but_their_features():
    octree = make_tree(levels=3, share=0.6)
    before, features, keys = structure(octree), octree.features.detach().clone(), octree.split_keys
    coarse = octree.key(of_level(octree, 0))
    some = coarse[torch.isin(coarse, keys)][::2]
    old_row = octree.build(torch.cat([some, keys[~torch.isin(keys, coarse)]]))
    assert len(of_level(octree, 1)) == 8 * len(some) and counts(octree)[2] > 0
    home = of_level(octree, 2) * torch.tensor([0, 1, 1, 1]) // 4
    assert torch.isin(octree.key(home), some).all()
    assert torch.equal(octree.features, features[old_row])
    assert octree.row_key.tolist() == [before[0][i] for i in old_row]  # nothing is new
    stayed = torch.isin(torch.tensor(before[0]), octree.row_key)
    old_row = octree.build(keys)
    assert structure(octree) == before
    assert torch.equal(octree.features, torch.where(stayed[:, None], features, 0)) and not stayed.all()
    assert torch.equal(old_row[stayed], torch.arange(int(stayed.sum()))) and (old_row[~stayed] == 0).all()


@pytest.mark.parametrize("far", [1.0, 1.5, 100.0, 1e30])
def test_points_outside_the_cube_get_the_nearest_features_inside(far):
    octree, x = make_tree(half=1.0, dtype=torch.float32), random(100, 3, low=-1, dtype=torch.float32)
    for sign in (-1, 1):
        outside, edge, inside = x.clone(), x.clone(), x.clone()
        outside[:, 1], edge[:, 1], inside[:, 1] = sign * far, sign, sign * (1 - 2e-6)
        assert torch.equal(octree(outside), octree(edge))
        close(octree(outside), octree(inside), atol=1e-3)


@pytest.mark.parametrize("levels, root", [(1, 1), (3, 1), (5, 2)])
def test_one_cell_empty_levels_wild_and_no_points_give_finite_features_and_gradients(levels, root):
    octree = g.Octree(1.0, levels, 2, root=root)  # nothing is split
    x = torch.tensor([[0.0, 0, 0], [1, 1, 1], [-1, 0.5, 1], [1e30, -1e4, 0], [math.nan, math.inf, -math.inf]])
    out = octree(x, derivatives=True)
    out.square().sum().backward()
    assert out.shape == (5, levels, 4, 2) and len(octree.features) - g.PINNED == (root + 1) ** 3
    assert torch.isfinite(out).all() and torch.isfinite(octree.features.grad).all() and (out[:, 1:] == 0).all()
    assert octree(x[:0]).shape == (0, levels, 1, 2)


def test_seeding_splits_dense_levels_then_the_neighbourhood_of_points():
    octree, points = g.Octree(1.6, 3, 1, root=8), random(7, 3, low=-0.8, high=0.8, dtype=torch.float32)
    points[0] = torch.tensor([1.599, -1.599, 0.2])
    g.seed_octree(octree, points, 1)
    home, steps = ((points / 1.6 + 1) * 8).long().tolist(), list(itertools.product((-1, 0, 1), repeat=3))
    want = {cell for p in home for s in steps if set(cell := tuple(map(sum, zip(p, s)))) <= set(range(16))}
    assert set(map(tuple, (of_level(octree, 2)[:, 1:] // 2).tolist())) == want
    assert counts(octree) == [512, 4096, 8 * len(want)]
    assert (octree.corner[octree.locate(points)[0]] >= g.PINNED).all()  # no corner beside a point hangs
    assert octree.features[g.PINNED:].square().mean().sqrt().item() == pytest.approx(0.01, rel=0.1)
    node = octree.locate(torch.tensor([[-9, 1.6, 9]]))[0][0]
    assert octree.cells[node[:2] - 8].tolist() == [[0, 0, 7, 7], [1, 0, 15, 15]] and node[2] < 8  # no cell there
    g.seed_octree(deep := g.Octree(1.6, 5, 1, root=8), points, 1, 3)  # down to the points, and only there
    assert (deep.corner[deep.locate(points)[0]] >= g.PINNED).all() and counts(deep)[:3] == counts(octree)
    assert 7 * 27 < counts(deep)[4] <= 8 * 27 * 7 and counts(deep)[3] <= 8 * 27 * 7


@pytest.mark.parametrize("footprint, levels", [(0.02, 3), (0.011, 4), (0.004, 5), (2, 2), (1e-9, 8)])
def test_the_finest_cell_is_one_to_two_pixels_at_the_surface_within_two_to_eight_levels(scene, footprint, levels):
    octree = new_model(scene._replace(raw=scene.raw | dict(footprint=np.float64(footprint))), levels=0).sdf.octree
    assert octree.levels == levels and (levels in (2, 8) or footprint <= octree.cell(levels - 1) < 2 * footprint)


CENTRE, BALL_R = torch.tensor([0.1, -0.25, 0.3]), 0.4  # off centre and unequal, so that swapped axes show


def ball(x):
    return (x - CENTRE).norm(dim=1) - BALL_R


def dense_tree():
    octree = g.Octree(1.0, 4, 2, root=8)
    octree.split(octree.cells), octree.split(octree.cells)  # levels 0 and 1 are split everywhere
    return octree


FRONT, SIDE = ([c + BALL_R * v / math.hypot(*d) for c, v in zip(CENTRE.tolist(), d)]
               for d in ((0.3, -0.5, 0.8), (-1.0, 0.2, 0.1)))  # on the ball
FAR, RIM, BEYOND = (0.0, 0.65, -0.3), (0.70, 0.69, 0.01), (0.71, 0.72, 0.01)  # RIM and BEYOND: |x| = 0.98, 1.01


def hits_of(*groups):
    """Groups of rays, (n, x, error, pixel); up to 64 the rest is beyond the sphere with error 0.1, a quartile."""
    rows = [torch.tensor([*x, error, pixel]).expand(n, 5) for n, x, error, pixel in groups]
    rest = torch.tensor([0.0, 1.2, 0.3, 0.1, 0.0]).expand(64 - sum(map(len, rows)), 5)
    return torch.cat([*rows, rest, torch.full((200, 5), 2.0)])


SOME = hits_of((1, FRONT, 0.1, 0.0))


def refine(octree, hits, sdf=ball, zeta=1e9, max_mb=1000.0):
    octree.build(g.refined_keys(octree, sdf, hits, zeta, max_mb))
    return octree


def is_split(octree, x, level=2):
    return bool(octree.child[octree.locate(torch.tensor([x]))[0][0, level]])


@pytest.mark.parametrize("where, want, groups", [
    (FRONT, True, [(10, FRONT, 0.22, 0)]), (FRONT, False, [(10, FRONT, 0.18, 0)]),  # twice the quartile is 0.2
    (FRONT, False, [(6, FRONT, 0.05, 0), (1, FRONT, 1.0, 0)]),  # means of 0.186 and 0.217
    (FRONT, True, [(6, FRONT, 0.25, 0), (3, FRONT, 0.15, 0)]),
    (FRONT, False, [(10, FRONT, 0.15, 0), (15, BEYOND, 1e-3, 0)]),  # the quartile is the lower one, and of all rays
    (FRONT, True, [(10, FRONT, 0.15, 0), (17, BEYOND, 1e-3, 0)]),
    (FRONT, True, [(g.SPLIT_RAYS, FRONT, 0.5, 0)]), (FRONT, False, [(g.SPLIT_RAYS - 1, FRONT, 0.5, 0)]),
    (FRONT, True, [(10, FRONT, 0.5, 0.9 / 32)]), (FRONT, False, [(10, FRONT, 0.5, 1.1 / 32)]),  # a child's side
    (FAR, False, [(30, FAR, 0.9, 0)]), (RIM, True, [(10, RIM, 0.9, 0)]), (BEYOND, False, [(10, BEYOND, 0.9, 0)])])
def test_cells_of_the_surface_split_where_enough_rays_miss_their_colour_by_more_than_is_usual(where, want, groups):
    def sdf(x):  # the ball, and what goes on beyond the sphere
        return torch.minimum(ball(x), (x.norm(dim=1) - 1).abs())
    octree = refine(dense_tree(), hits_of(*groups), sdf)
    assert is_split(octree, where) == want and counts(octree)[3] == 8 * want


def test_refining_an_octree_with_empty_levels_goes_down_one_level_at_a_time():
    octree, depths = g.Octree(1.0, 6, 2), []
    for _ in range(6):
        depths.append(refine(octree, hits_of((20, FRONT, 0.5, 0))).active)
    assert depths == [2, 3, 4, 5, 6, 6] and counts(octree) == [16 ** 3, 8, 8, 8, 8, 8]


@pytest.mark.parametrize("zeta", [1e9, 40.0])
def test_exactly_the_cells_far_from_what_is_seen_are_merged_and_no_ray_sees_the_change(zeta):
    octree, x = fill(dense_tree()), random(40_000, 3, low=-1, dtype=torch.float32)
    for none in (torch.full((9, 5), 2.0), hits_of(), SOME[:0]):
        assert torch.equal(g.refined_keys(octree, ball, none, zeta, 1000.0), octree.split_keys)
    before, keys = octree(x), g.refined_keys(octree, ball, SOME, zeta, 1000.0)
    for level in range(2):
        cells = of_level(octree, level)
        distance, stays = ball((cells[:, 1:] + 0.5) * octree.cell(level) - 1).abs(), torch.isin(octree.key(cells), keys)
        reach = (math.sqrt(3) / 2 + 1) * octree.cell(level) + g.HIDDEN / zeta
        assert torch.equal(stays, distance < reach) and stays.any() and not stays.all()
    octree.build(keys)  # pinned corners now reach one child's side into cells that stay
    nearest = ball(x).abs()[(octree(x) != before).flatten(1).any(1)].min()
    assert g.HIDDEN / zeta <= nearest < g.HIDDEN / zeta + octree.cell(1)


def test_refining_stays_within_its_memory_and_takes_the_worst_first():
    octree, hits = refine(dense_tree(), SOME), hits_of((10, FRONT, 0.4, 0), (10, SIDE, 0.9, 0))
    keys, one = octree.split_keys, 8 * (76 + 16 * 2)  # bytes of eight nodes and corners, as held in training
    held = lambda: len(octree.child) * one / 8
    for splits, want in ((-5, (False, False)), (0.99, (False, False)), (1.01, (False, True)), (2.01, (True, True))):
        octree.build(keys)
        full = held()
        refine(octree, hits, max_mb=(full + splits * one) / 2 ** 20)
        assert (is_split(octree, FRONT), is_split(octree, SIDE)) == want
        assert held() <= full + max(splits, 0) * one
    octree.build(keys)
    home = octree.key(octree.cells[octree.locate(torch.tensor([FRONT]))[0][0, 1] - 8])
    octree.build(keys[keys != home])  # FRONT now lies in a coarser cell than SIDE
    refine(octree, hits, max_mb=(held() + 1.01 * one) / 2 ** 20)
    assert is_split(octree, SIDE) and not is_split(octree, FRONT, 1)


# ---- 4 fields ------------------------------------------------------------------------------------

def test_field_is_one_hidden_layer_over_position_and_features_with_exact_derivatives(double):
    field, x, eps = g.SDFField(make_tree(levels=3), 16).double(), random(300, 3, low=-1.29, high=1.29), 1e-6
    fine = (x / 2.6 + 0.5) * 12
    x = x[((fine - fine.round()).abs() > 1e-3).all(1)]
    (sdf, geo, grad), feat = field(x, True), field.octree(x)[:, :, 0].flatten(1)
    out = field.lin2(torch.log1p(torch.exp(100 * field.lin1(torch.cat([x, feat], 1)))) / 100)
    close(torch.cat([sdf[:, None], geo], 1), torch.cat([out, feat], 1), rtol=1e-9)
    assert geo.shape[1] == g.GEO + field.features and field.features == 6
    again = field(x)
    assert torch.equal(sdf, again[0]) and torch.equal(geo, again[1]) and again[2] is None
    want = [(field(x + e)[0] - field(x - e)[0]) / (2 * eps) for e in torch.eye(3).double() * eps]
    close(grad, torch.stack(want, 1), atol=1e-5)
    grad.square().sum().backward()  # training through normals
    silent = [k for k, p in field.named_parameters() if p.grad is None or not (p.grad != 0).any()]
    assert silent == ["lin2.bias"]  # the one shift that no derivative sees
    g.TRILINEAR = g.TRILINEAR.float()
    close(copy.deepcopy(field).float()(x.float(), True)[2], grad, rtol=1e-3, atol=1e-3)
    field.lin1.weight.data *= 1e4  # nothing overflows
    out = field.float()(torch.cat([x, 0 * x, 1e3 * x]).float(), True)
    sum(v.sum() for v in out).backward()
    assert all(v.isfinite().all() for v in (*out, *(p.grad for p in field.parameters())))


@pytest.mark.parametrize("eps", [1e-3, 0.1, 1.0])
def test_differences_of_quadratics_are_exact_but_for_the_mixed_terms_of_a_tetrahedron(monkeypatch, eps):
    """A tetrahedron has no point symmetry: 2 A_yz y z leaks eps 2/sqrt(3) A_yz into the x slope, and so on."""
    monkeypatch.setattr(g, "TAPS", F.normalize(g.TAPS.double(), dim=1))
    x, A, b = random(20, 3, low=-1), random(3, 3, low=-1), random(3, seed=1, low=-1)
    A = A + A.T
    y = g.taps(x, eps)  # (20,5,3)
    grad, lap = g.finite_differences(((y @ A) * y).sum(2) + y @ b + 0.7, eps)
    leak = eps * 2 / math.sqrt(3) * torch.stack([A[1, 2], A[0, 2], A[0, 1]])
    close(grad, 2 * x @ A + b + leak, atol=1e-9)
    close(lap, (2 * A.trace()).expand(20), rtol=1e-6, atol=1e-7)
    close((y - x[:, None]).norm(dim=2), eps * torch.tensor([0, 1, 1, 1, 1]).expand(20, 5))


@pytest.mark.parametrize("tight", [0, 0.3, 3])
def test_lipschitz_mlp_is_an_mlp_whose_long_rows_are_cut_to_the_bound_that_it_keeps(tight):
    mlp, x = g.LipschitzMLP([6, 20, 20, 3]), random(4000, 6, low=-3, high=3, dtype=torch.float32)
    mlp.c.data -= tight
    bounds, y, cut = [math.log1p(math.exp(c)) for c in mlp.c.tolist()], x, []
    close(mlp.bounds(), bounds, atol=2e-6)
    for i, layer in enumerate(mlp.layers):
        length = layer.weight.detach().abs().sum(1, keepdim=True)
        cut.append(length > bounds[i] * (1 + 1e-5))
        y = F.linear(y if i == 0 else y.relu(), layer.weight * torch.where(cut[-1], bounds[i] / length, 1), layer.bias)
    close(mlp(x), y, atol=1e-4)
    cut = torch.cat(cut)
    assert cut.any() == (tight > 0) and cut.all() == (tight == 3) and len(cut) == 20 + 20 + 3
    rise = (mlp(x) - mlp(x.flip(0))).abs().amax(1) / (x - x.flip(0)).abs().amax(1)
    assert rise.max() <= math.prod(bounds) * 1.0001
    for layer in mlp.layers:
        layer.weight.data.mul_(tight)[0] = 0  # also with rows and bounds that vanish
    for c in (-1e4, -100.0, 0.0, 1e4):
        mlp.zero_grad()
        mlp.c.data.fill_(c)
        loss = mlp(x).sum() + torch.log(mlp.bounds()).sum()
        loss.backward()
        assert math.isfinite(loss.item()) and all(torch.isfinite(p.grad).all() for p in mlp.parameters())


# ---- 5 alpha, compositing, sampling, background --------------------------------------------------

def sigmoid(x):
    return 1 / (1 + math.exp(-x))


def test_deviation_starts_at_its_width_and_is_an_exponential_within_bounds():
    (deviation := g.Deviation(20.0)).v.data += 0.1
    close(deviation(), 20 * math.e, rtol=1e-4)
    for step, zeta, want in ((0, 3, 15), (200, 3, 25), (9000, 79, 80), (0, 15.1, 15.1), (9000, 81, 81), (9, 1e3, 500)):
        (deviation := g.Deviation(zeta)).bound(step, 500.0)  # a stalled one is lifted, a healthy one not moved
        close(deviation(), want, rtol=1e-4)


def ray_of_plane(cos, n, zeta):
    """Sections of a ray that crosses the plane at s = 0 with slope cos: (sdf, cos, dt, zeta), edge values."""
    edges = torch.linspace(0, 2, n + 1).double()
    f = 0.1 + cos * (edges - 1)
    mid = (f[1:] + f[:-1])[None] / 2
    return (mid, torch.full_like(mid, cos), edges.diff()[None], torch.tensor(zeta).double()), f


def two_samples(f, zeta):
    """NeuS Eq. 13 from the SDF at the edges."""
    phi = torch.sigmoid(zeta * f)
    return ((phi[..., :-1] - phi[..., 1:]) / phi[..., :-1]).clamp(min=0)


@pytest.mark.parametrize("zeta", [15.0, 1.0])
@pytest.mark.parametrize("cos", [-1.0, -0.6, -0.05, 0.8])
def test_alpha_of_a_plane_is_neus_equation_13_and_zero_on_the_way_out(cos, zeta):
    args, f = ray_of_plane(cos, 40, zeta)
    close(g.neus_alpha(*args)[0], two_samples(f, zeta), atol=1e-12)
    assert cos < 0 or (g.neus_alpha(*args) == 0).all() and (g.printed_alpha(*args)[0, :-1] < 0).all()


def test_printed_alpha_is_equation_1_literally_and_leaves_a_wall_63_percent_opaque():
    s, cos, dt = torch.tensor([[[0.3, 0.1, -0.2]], [[-1.0, -0.5, -0.8]], [[0.2, 0.3, 0.1]]])
    sections = zip((0.3, 0.1, -0.2), (0.1, -0.2, -0.2), (cos * dt / 2)[0].tolist())
    want = [sigmoid(9 * a + beta) - sigmoid(9 * b + beta) for a, b, beta in sections]
    close(g.printed_alpha(s, cos, dt, torch.tensor(9.0))[0], want)
    alpha = g.printed_alpha(*ray_of_plane(-1.0, 4000, 40.0)[0])
    close([alpha.sum(), g.composite(alpha)[0].sum()], [1, 1 - 1 / math.e], atol=2e-3)


@pytest.mark.parametrize("formula, least", [(g.neus_alpha, 0), (g.printed_alpha, -1)])
def test_alpha_and_its_gradients_are_finite_for_all_magnitudes(formula, least):
    grid = torch.cartesian_prod(*(torch.tensor(v) for v in (
        [-1e4, -10.0, -0.1, -1e-4, 0.0, 1e-4, 0.1, 10.0, 1e4], [-1.0, -1e-3, 0.0, 0.5, 100.0, -100.0],
        [0.0, 1e-5, 0.1, 1e3], [1e-2, 1.0, 30.0, 1e3, 1e6])))
    args = [c[None].clone().requires_grad_() for c in grid.T]
    alpha = formula(*args)
    assert ((alpha >= least) & (alpha <= 1)).all()
    assert all(torch.isfinite(v).all() for v in torch.autograd.grad(alpha.sum(), args))


def test_composite_and_its_gradient_equal_a_naive_loop_to_a_millionth():
    alpha = random(6, 9, high=0.95)
    alpha[0, 3], alpha[1, 5] = 1.0, 0.0  # opaque: hides all behind it
    left, naive = torch.ones(6).double(), []
    for a in alpha.requires_grad_().T:
        naive.append(left * a)
        left = left * (1 - a)
    got, want = torch.cat([(both := g.composite(alpha))[0], both[1][:, None]], 1), torch.stack([*naive, left], 1)
    close(got, want, atol=2e-6)
    pull = random(6, 10, seed=3)
    close(*(torch.autograd.grad(v, alpha, pull)[0] for v in (got, want)), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("alpha", [[0.0, 0, 0], [1.0, 1, 1], [0.7], *([v] * 9999 for v in (1e-12, 1e-4, 0.999, 1))])
def test_weights_and_what_passes_sum_to_one_with_finite_gradients(alpha):
    alpha = torch.tensor([alpha]).float().requires_grad_()
    w, trans = g.composite(alpha)
    ((w * torch.arange(1.0, 1 + w.shape[1])).sum() + 5 * trans.sum()).backward()
    assert (w >= 0).all() and abs(w.sum() + trans - 1) < 1e-4 and trans > -1e-5 and torch.isfinite(alpha.grad).all()


def test_inverse_cdf_inverts_the_cdf_and_shares_samples_by_weight():
    edges, weight = random(3, 9, seed=1).cumsum(1), random(3, 8, seed=2)
    weight[0] = torch.eye(8)[5]  # one heavy section, in which the CDF is a straight line
    u = ((torch.arange(8000) + 0.5) / 8000).double().expand(3, -1)
    t = g.inverse_cdf(edges, weight, u)
    assert (t.diff(dim=1) >= 0).all()
    close(t[0], edges[0, 5] + u[0] * (edges[0, 6] - edges[0, 5]), atol=1e-9)
    share = np.stack([np.histogram(a, b)[0] / 8000 for a, b in zip(t, edges)])
    close(share, weight / weight.sum(1, keepdim=True), atol=2 / 8000, rtol=0)
    close(g.inverse_cdf(edges[1:], weight[1:], torch.tensor([[0.0, 1.0]] * 2).double()), edges[1:, [0, -1]])


def ball_model(zeta=400.0, slope=1.0, samples=48, **changes):
    """A model that knows the ball: its distance times `slope`, and x as its geometry feature."""
    def sdf(x, with_gradient=False):
        return slope * ball(x), x, slope * F.normalize(x - CENTRE, dim=1) if with_gradient else None
    cache = g.SDFCache(64)
    cache.refresh(ball)
    return SimpleNamespace(cfg=config(samples=samples, **changes), sdf=sdf, deviation=lambda: torch.tensor(zeta),
                           color=lambda z: torch.zeros(len(z), 3), background=None, cache=cache, eps=0.01,
                           bg_color=torch.tensor([0.9, 0.1, 0.3]), distance=lambda x: sdf(x)[0])


def ball_rays(n=80):
    """Rays at points near the ball, the true distance to it (inf: they miss), and by how much they hit or miss."""
    o = 3 * F.normalize(random(n, 3, low=-1, dtype=torch.float32), dim=1)
    rays = sphere_rays(o, CENTRE + random(n, 3, seed=1, low=-0.5, high=0.5) - o)
    m = rays.o - CENTRE
    b = (m * rays.d).sum(1)
    disc = b ** 2 - (m * m).sum(1) + BALL_R ** 2
    return rays, torch.where(disc > 0, -b - disc.clamp(min=0).sqrt(), math.inf), disc


def test_the_cache_holds_the_sdf_slice_by_slice_and_gives_sections_of_a_plane_their_weights():
    """Trilinear lookups reproduce a linear field; a voxel's shift or swapped axes would show."""
    cache, line, slopes = g.SDFCache(33), torch.linspace(-1, 1, 33), torch.tensor([0.3, -0.5, 0.8]).requires_grad_()
    want = line[:, None, None] * 0.3 - line[:, None] * 0.5 + line * 0.8 - 0.1
    for part in range(8):
        before = cache.volume[0, 0].clone()
        cache.refresh(lambda x: x @ slopes - 0.1, part, 8)
        mine = torch.arange(33) % 8 == part
        close(cache.volume[0, 0], torch.where(mine[:, None, None], want, before))
    rays = sphere_rays([(-0.1, -0.2, 3)] * 3, [(0, -0.05, -1), (-0.1, 0, -1), (0.1, -0.1, -1)])  # looking inwards
    edges = torch.linspace(2.2, 3.6, 41).expand(3, -1)
    for zeta in (30.0, 400.0):  # the second sharper than a voxel
        want, _ = g.composite(two_samples((rays.at(edges) @ slopes - 0.1).double(), min(zeta, 33)))
        close(cache.weights(rays, edges, torch.tensor(zeta)), want, atol=1e-4)
        assert want.max() > 0.05 and not cache.volume.requires_grad


@pytest.mark.parametrize("is_cached", [True, False])
def test_edges_tile_the_ray_even_and_stratified_or_gathered_at_the_surface_but_for_a_share(is_cached):
    (rays, depth, disc), jitter, far = ball_rays(), torch.rand(80, 201), 0.25
    (t0, t1), zeta = g.sphere_interval(rays), torch.tensor(400.0, requires_grad=True)
    edges = ball_model().cache.edges(rays, t0, t1, jitter, zeta * is_cached)
    assert edges.shape == (80, 202) and (edges.diff(dim=1) >= -1e-6).all() and not edges.requires_grad
    assert torch.equal(edges[:, 0], t0) and torch.equal(edges[:, -1], t1)
    if is_cached:
        hits = disc > 0.02
        away = ((edges[hits, 1:-1] - depth[hits, None]).abs() > far).float().mean(1)
        close(away.mean(), g.FLOOR * (1 - 2 * far / (t1 - t0)[hits]).mean(), atol=5e-3)
    else:
        close(edges[:, 1:-1], t0[:, None] + (torch.arange(200) + jitter[:, :200]) / 200 * (t1 - t0)[:, None], atol=1e-5)


def rendered(model, rays, code=0, jitter=0.5):
    n, S = len(rays.o), model.cfg.samples
    return g.render_rays(model, rays, torch.zeros(n, 5) + code, torch.zeros(n, S + 4) + jitter)


@pytest.mark.parametrize("mode", [dict(), dict(sampling="uniform", samples=256), dict(normals="fd")])
def test_rendering_a_known_ball_finds_its_depth_normal_and_silhouette(mode):
    (rays, depth, disc), model = ball_rays(), ball_model(**mode)
    out, hit, miss = rendered(model, rays), disc > 0.02, disc < -0.02
    assert hit.sum() > 5 and miss.sum() > 5 and (out["e_grad"] < 1e-3).all()  # a true distance has no eikonal error
    close(out["x"], rays.at(out["depth"][:, None])[:, 0])
    close(out["depth"][hit], depth[hit], atol=0.012)
    close(out["depth"][miss], g.sphere_interval(rays)[1][miss], atol=0.02)
    close(out["opacity"][hit | miss], hit[hit | miss], atol=0.01)
    close(out["normal"][hit], F.normalize(out["x"][hit] - CENTRE, dim=1), atol=0.05)
    close(out["rgb"][hit | miss], torch.where(hit[:, None], 0.5, model.bg_color)[hit | miss], atol=5e-3)


def test_contract_is_identity_inside_below_two_outside_monotone_and_finite_with_its_gradient():
    d, r = F.normalize(random(50, 1, 3, low=-1), dim=2), torch.tensor([0.0, 0.3, 1 - 1e-6, 1, 1 + 1e-6, 2, 10, 1e6])
    y, r = g.contract(d * r[:, None]), r.double()
    close(y, torch.where(r < 1, r, 2 - 1 / r)[:, None] * d)
    assert (y.norm(dim=2) < 2).all() and (y.norm(dim=2).diff(dim=1) > 0).all()
    x = torch.tensor([0, 1e-30, 1e-3, 1, 30, 1e4, 1e15])[:, None] * torch.tensor([0.6, 0, -0.8])
    g.contract(x.requires_grad_()).sum().backward()
    assert torch.isfinite(x.grad).all() and (g.contract(x).norm(dim=1) <= 2).all()


def test_background_equals_naive_loops_over_its_sections_before_and_beyond_the_sphere():
    bg, n, want = g.Background(points := random(9, 3, low=1, high=3, dtype=torch.float32), 16, 12), 4, []
    assert (fill(bg.octree).locate(g.contract(points))[0] >= 8).sum() == 9 * 5 and max(counts(bg.octree)[2:]) <= 9 * 27 * 8 < 32 ** 3 == counts(bg.octree)[1]
    rays = sphere_rays([(0.3, 0.2, -3), (0, 2, 0)], [(0, 0.1, 1), (1, 0, 0.3)])
    t0, t1, jitter = torch.tensor([2.0, 0.1]), torch.tensor([3.0, 0.5]), random(2, n + 2, seed=4, dtype=torch.float32)
    per_ray, jitter[1, -1] = random(2, 12, seed=5, dtype=torch.float32), 1.0  # its last is at infinity
    for i in range(2):
        length = (t0[i].item() - 0.1) / 2  # of the two sections before; the second ray has nothing there
        before = [0.1 + length * (j + jitter[i, j].item()) for j in range(2)]
        u = [(j + jitter[i, 2 + j].item()) / n for j in range(n)]
        beyond = [t1[i].item() + v / max(1 - v, 1e-3) for v in u]
        for t, steps in ((before, [length] * 2), (beyond, [*np.diff(beyond), math.inf])):
            rgb, left = torch.zeros(3), 1.0 if t is before else left
            for at, dt in zip(t, steps):
                x = g.contract(rays.o[i] + at * rays.d[i])
                out = bg.density(torch.cat([x, bg.octree(x[None]).flatten()]))
                opacity = 1 - math.exp(-math.log1p(math.exp(out[0].item() - 1)) * dt)
                rgb = rgb + left * opacity * torch.sigmoid(bg.color(torch.cat([out[1:], per_ray[i]])))
                left *= 1 - opacity
            want.append(torch.cat([rgb, torch.tensor([left])]))
    front, passes, behind = bg(rays, t0, t1, per_ray, jitter)
    close(torch.cat([front, passes[:, None]], 1), torch.stack(want[::2]), atol=1e-5)
    close(behind, torch.stack(want[1::2])[:, :3], atol=1e-5)
    assert passes[0] < 0.9 and passes[1] == 1


@pytest.mark.parametrize("alpha", ["neus", "printed"])
def test_past_the_sphere_is_background_alone_and_as_printed_so_is_a_part_of_what_lies_behind_a_wall(alpha):
    model = ball_model(zeta=20.0, slope=2.0, alpha=alpha, sampling="uniform", samples=400)
    o = torch.tensor([[0, 5, -3], [0, 0, 3], [0.1, -0.25, -3], [*CENTRE]])  # past, away, through the ball, out of it
    out = rendered(model, sphere_rays(o, [(0, 0, 1)] * 4))
    close(out["rgb"][:2], model.bg_color.expand(2, 3))
    assert out["opacity"][[0, 1, 3]].tolist() == [0, 0, 0] and not out["eikonal"][:2].any() and out["eikonal"][2].all()
    close(out["depth"][:2], [3, 0.1], atol=1e-3)
    assert (out["opacity"][2] > 0.99) == (alpha == "neus")


def test_colour_and_background_networks_see_what_they_should_and_their_colours_are_blended():
    (rays, _, disc), model, seen, asked = ball_rays(), ball_model(slope=3.0), [], []
    model.color = lambda z: (seen.append(z), z[:, :3])[1]
    front, passes = random(80, 3, seed=2, dtype=torch.float32), random(80, seed=3, dtype=torch.float32)
    model.background = lambda *args: (asked.extend(args[1:]), (front, passes, torch.ones(80, 3)))[1]
    code, jitter = random(80, 5, dtype=torch.float32), torch.rand(80, 52)
    out, d = rendered(model, rays, code, jitter), rays.d
    per_ray = torch.cat([d, d * d, d * d[:, [2, 0, 1]], code], 1)
    x = seen[0][:, :3]
    close(seen[0], torch.cat([x, F.normalize(x - CENTRE, dim=1), per_ray.repeat_interleave(48, 0)], 1), atol=1e-5)
    want = *g.sphere_interval(rays), per_ray, jitter[:, 48:]  # the background leaves out the sphere
    assert all(torch.equal(a, b) for a, b in zip(asked, want, strict=True))
    opacity = out["opacity"][:, None]
    rgb = opacity * torch.where(disc[:, None] > 0, out["x"].sigmoid(), 0)
    close(out["rgb"], front + passes[:, None] * rgb + 1 - opacity, atol=0.02)


def test_doubling_the_sdf_and_halving_zeta_changes_nothing_but_the_eikonal_error():
    a, b = (rendered(ball_model(zeta, slope, sampling="uniform"), ball_rays()[0], jitter=random(80, 52).float())
            for zeta, slope in ((40.0, 1.0), (20.0, 2.0)))
    assert all(torch.allclose(a[k], b[k], atol=1e-4) for k in ("rgb", "opacity", "depth", "normal"))
    close(b["e_grad"], b["opacity"], atol=1e-4)  # (2 - 1)^2 where there is something to see
    close(b["eikonal"], torch.lt(*g.sphere_interval(ball_rays()[0]))[:, None].expand(80, 48), atol=1e-4)


def test_colour_and_eikonal_error_teach_every_part_and_nothing_else_carries_a_gradient(warm, scene):
    model, (rays, _) = copy.deepcopy(warm), batch(scene)
    out, jitter = model.render(rays, code := model.appearance(rays.img)), torch.full((64, model.cfg.samples + model.cfg.bg_samples), 0.5)
    assert torch.equal(out["rgb"], g.render_rays(model, rays, code, jitter)["rgb"])  # pictures have samples mid-way
    assert {k for k, v in out.items() if v.requires_grad} == {"rgb", "eikonal"} and len(out) == 7
    (out["rgb"].sum() + out["eikonal"].sum()).backward()
    silent = {n for n, p in model.named_parameters() if p.grad is None or not (p.grad != 0).any()}
    assert {n for n in silent if not n.startswith("mask.")} <= {"color.c"}  # a bound above all rows is slack


# ---- 6 mask and geometry preservation ------------------------------------------------------------

@pytest.mark.parametrize("seed, h, w", [(0, 32, 48), (1, 33, 31), (2, 48, 48)])
def test_mask_network_halves_the_resolution_starts_small_and_sees_each_photo_alone(seed, h, w):
    torch.manual_seed(seed)
    net, photos = g.CGNet(), random(3, 3, h, w, dtype=torch.float32)
    logits = net(photos)
    assert logits.shape == (3, 1, (h + 1) // 2, (w + 1) // 2) and 0.03 < logits.sigmoid().mean() < 0.2
    close(logits[1:2], net(photos[1:2]), atol=1e-4)
    logits.square().sum().backward()
    assert [n for n, p in net.named_parameters() if p.grad is None or not (p.grad != 0).any()] == []
    impulse, [stem, block, deep] = F.pad(torch.ones(1, 32, 1, 1), [8] * 4), net.stages
    reach = [stage.around(impulse[:, :n])[0, 0].nonzero().unique().tolist() for stage, n in ((block, 16), (deep, 32))]
    block.gate[2].bias.data.fill_(-1e4)
    assert reach == [[6, 8, 10], [4, 8, 12]] and not block(stem(photos)).any()  # a shut gate lets nothing through


def test_mask_is_read_at_the_right_pixel_of_the_right_photo_and_bilinear_between():
    logits = random(3, 1, 4, 6, low=-3, high=3, dtype=torch.float32)
    row, col = torch.meshgrid(torch.arange(4), torch.arange(6), indexing="ij")
    uv = torch.stack([(col + 0.5) / 6, (row + 0.5) / 4], -1).reshape(-1, 2)  # u runs along the width
    close(g.mask_at(logits, uv.repeat(3, 1)), torch.sigmoid(logits).flatten())
    uv = torch.tensor([[0.5, 0.25], [0.25, 0.5], [0.5, 0.5], [0.0, 0.0], [1.0, 1.0]])  # constant beyond the border
    close(g.mask_at(torch.tensor([[[[0.0, 1], [2, 5]]]]), uv), torch.sigmoid(torch.tensor([0.5, 1, 2, 0, 5])))


def small_mask(scene, **changes):
    """A mask network over 16 x 16 px, from thumbnails of 31 x 31."""
    return g.TransientMask(config(**changes), scene._replace(thumbs=scene.thumbs[:, :, 3::3, 3::3].contiguous()))


def test_the_mask_network_is_told_where_sfm_points_are_seen_and_masks_nothing_at_first(scene):
    uv, want = scene.track_uv.clone(), torch.zeros(10, 1, 16, 16, dtype=torch.bool)
    uv[::7, 0], uv[1::7, 1] = 1.0, -0.01  # SfM got these wrong
    mask = small_mask(scene._replace(track_uv=uv))
    for i, (u, v) in zip(scene.track_photo.tolist(), uv.tolist()):
        if 0 <= u < 1 and 0 <= v < 1:
            want[i, 0, int(v * 16), int(u * 16)] = True
    assert torch.equal(mask.static, want) and 0.02 < want.float().mean() < 0.9
    assert mask.logits.shape == want.shape and mask.logits.sigmoid().max() < 1e-3 and mask.phi([0, 1]).sum() == 0
    close(mask.look(torch.tensor([4, 2])), mask.cgnet(mask.thumbs[[4, 2]].float() / 255))


def test_errors_are_remembered_where_the_mask_network_looks_for_them_and_bad_ones_as_nothing(scene):
    mask, (rays, _) = small_mask(scene), batch(scene)
    rays = rays._replace(img=torch.tensor([3, 5, 6]), uv=torch.tensor([[0.9, 0.1], [0, 0.99], [0.5, 0.5]]))
    residual = torch.tensor([[0.7, -0.6, 0.5], [-0.2, 0.3, 0.0], [math.nan, math.inf, -math.inf]])
    mask.remember(rays, residual, torch.tensor([0.4, 0.1, math.nan]), torch.tensor([0.9, 0.8, math.inf]))
    close(mask.seen[3, :, 1, 14], [0.7, -0.6, 0.5, 0.4, 0.9])  # u along the width
    close(mask.seen[5, :, 15, 0], [-0.2, 0.3, 0.0, 0.1, 0.8])
    assert (mask.seen[6, :, 8, 8] == 0).all() and (mask.seen[:, 4] >= 0).sum() == 3


@pytest.mark.parametrize("x", [random(1001, high=3.0) ** 2, [0.0], [0.7] * 64, [0.0, 1e30], [math.inf, 0.2, math.nan]])
def test_calibration_converges_to_quantiles_of_the_rays_and_stays_finite(scene, x):
    x, mask = torch.as_tensor(x).float(), small_mask(scene)
    q = np.quantile(x.nan_to_num(0, 0, 0), [0.5, 0.75, 0.95], method="lower")
    want = np.array([q[1], max((q[2] - q[0]) / 4, 1e-3)])
    mask.calibrate(x)
    close(mask.calibration, 0.2 * want + [0, 0.8], rtol=1e-4)
    for _ in range(100):
        mask.calibrate(x)
    close(mask.calibration, want, rtol=1e-3)


@pytest.mark.parametrize("kind", ["on", "printed"])
def test_the_mask_objective_equals_a_naive_loop_over_what_is_known(scene, monkeypatch, kind):
    monkeypatch.setattr(g, "LAM_BIMODAL", 1e-2)
    mask, pick = small_mask(scene, lam_gpl=0.3, lam_mask=0.1, mask=kind), torch.tensor([2, 0])
    known, static = random(2, 16, 16, seed=1) < 0.6, random(2, 16, 16, seed=4) < 0.2
    found = random(2, 5, 16, 16, seed=2, low=-1)
    found[:, 4] = random(2, 16, 16, seed=3)  # opacity
    mask.seen[pick] = torch.where(known[:, None], found, -1.0).float()
    mask.static[pick], mask.calibration[:], mask.usual[:] = static[:, None], *torch.tensor([[0.3, 0.2], [0.05, 0.08]])
    logits, errors, gpl, want = mask.look(pick)[:, 0].detach(), torch.full((2, 16, 16), math.nan), 0.0, 0.0
    pixels = list(itertools.product(range(2), range(16), range(16)))
    for b, i, j in pixels:  # signed means over 3 x 3 px, of the worst channel
        around = (b, slice(max(i - 1, 0), i + 2), slice(max(j - 1, 0), j + 2))
        if known[b, i, j]:
            errors[b, i, j] = max(abs(found[:, c][around][known[around]].mean().item()) for c in range(3))
    got, got_gpl = mask.objective(pick)
    usual = [0.9 * before + 0.1 * np.quantile(errors[known & static & ((found[:, 4] > 0.5) == is_solid)], 0.75)
             for is_solid, before in enumerate((0.05, 0.08))]  # beside the foreground, and of it
    for b, i, j in pixels:
        logit = logits[b, i, j].item()
        M, (*residual, bend, opacity) = sigmoid(logit), found[b, :, i, j].tolist()
        want += 1e-2 / ((M - 0.5) ** 2 + 0.02) / 512
        if known[b, i, j]:
            phi = opacity * sigmoid((bend - 0.3) / 0.2)
            price = 0.1 + usual[opacity > 0.5] + 0.3 * phi - errors[b, i, j].item() * (not static[b, i, j])
            gpl += M * phi / 512
            if kind == "printed":  # Eq. 5: SfM points and usual errors play no part
                want += ((1 - M) * np.mean(np.abs(residual)) + 0.1 * M ** 2 + 0.3 * M * phi) / 512
            else:  # worth masking where the price of M is negative
                want += abs(price) * math.log1p(math.exp(logit if price > 0 else -logit)) / 512
    assert got.item() == pytest.approx(want, rel=1e-4) and got_gpl.item() == pytest.approx(gpl, rel=1e-4)
    assert kind == "printed" or mask.usual.tolist() == pytest.approx(usual, rel=1e-4)
    close(mask.logits[pick][:, 0], logits, atol=1e-5)
    assert not mask.logits.requires_grad and not got_gpl.requires_grad and (mask.logits[1] == -9).all()


def test_a_pixel_is_drawn_to_the_mask_when_its_error_is_above_its_price_and_only_then_whatever_the_mask(scene):
    mask, none = (small_mask(scene, lam_gpl=0.05, lam_mask=0.06, gpl="literal") for _ in range(2))
    mask.static[:], mask.usual[()] = False, 0.06
    error, phi = torch.linspace(0, 0.5, 16)[:, None], (torch.arange(16) >= 8).float()
    mask.seen[0, :3], mask.seen[0, 3], mask.seen[0, 4] = error, 99.0, phi
    close(g.edge_indicator(error), torch.sigmoid(error))  # the literal reading
    price = 0.06 + 0.06 + 0.05 * phi - error
    for logit, known, kind in itertools.product((-9.0, -2.5, 9.0, -1e4, 1e4), (mask, none), ("on", "printed")):
        logits = torch.full((1, 1, 16, 16), logit, requires_grad=True)
        known.look, known.cfg.mask = lambda pick: logits, kind
        loss, gpl = known.objective(torch.tensor([0]))
        loss.backward()
        assert (loss + gpl).isfinite() and logits.grad.isfinite().all()
        if known is mask and kind == "on" and abs(logit) < 1e4:  # also where a sigmoid hardly moves
            assert torch.equal((logits.grad[0, 0] > 0)[price.abs() > 0.002], (price > 0)[price.abs() > 0.002])


# ---- 7 the model and its objective ---------------------------------------------------------------------

LAM = dict(lam_eik=0.3, lam_curv=0.7, lam_lps=0.11, lam_off=0.9, lam_sfm=0.5)


def like(warm, **changes):
    """A model of other settings with the weights of a warm one, whose remembered masks are worth the name."""
    model = new_model(warm.scene, **changes)
    model.cache.volume.copy_(warm.cache.volume)
    with torch.no_grad():
        for name, p in model.named_parameters():
            p.copy_(warm.get_parameter(name))
    model.mask.logits.copy_(random(*model.mask.logits.shape, low=-0.5, high=1.5, dtype=torch.float32))
    return model


def objective(raw):
    return raw["rgb"].item() + sum(weight * raw[name[4:]].item() for name, weight in LAM.items())


def finite(model, rays, pick, step=0):
    model.zero_grad()
    total, raw = model.losses(rays, pick, step, generator())
    total.backward()
    grads = [p.grad for p in model.parameters() if p.grad is not None]
    return all(v.isfinite().all() for v in (total, *raw.values(), *grads))


@pytest.mark.parametrize("changes", [dict(), dict(normals="fd"), dict(alpha="printed"), dict(mask="off")])
@torch.no_grad()
def test_each_term_of_the_objective_and_all_that_is_remembered_equal_their_definitions(warm, scene, changes):
    model, (rays, pick), seen = like(warm, **LAM, **changes), batch(scene), []
    rays = rays._replace(d=torch.where(torch.arange(64)[:, None] < 32, rays.d, -rays.d))  # half look away
    model.distance = lambda x: seen.append((x, warm.distance(x))) or seen[-1][1]
    total, raw = model.losses(rays, pick, 512 + 1, generator())
    (x, s), eps, code, jitter = seen[-1], model.eps, model.codes()[rays.img], torch.rand(64, 12, generator=generator())
    out, ends, ball, sfm = g.render_rays(model, rays, code, jitter), x[:320].reshape(64, 5, 3), x[320:352], x[352:]
    close((ends - out["x"][:, None]).norm(dim=2), eps * torch.tensor([0.0, 1, 1, 1, 1]).expand(64, 5), atol=1e-5)
    assert ball.abs().max() < 1 < ball.abs().max() + 0.2 and ball.mean(0).norm() < 0.4
    assert (sfm[:, None] == model.sfm).all(2).any(1).all() and len(sfm.unique(dim=0)) > 20 and len(sfm) == 32
    mask = torch.zeros(64) if changes.get("mask") == "off" else g.mask_at(model.mask.logits[pick], rays.uv)
    lap = 6 / eps ** 2 * (s[:320].reshape(64, 5)[:, 1:].mean(1) - s[:320:5])
    e_curv, error = lap.abs() * eps * out["opacity"], (1 - mask) * (out["rgb"] - rays.rgb).abs().mean(1)
    assert 0 < out["eikonal"].any(1).sum() <= 32 and e_curv.max() > 1e-3 and model.deviation() == pytest.approx(40.65)
    want = dict(rgb=error.mean(), eik=out["eikonal"].mean(), curv=e_curv.mean(),
                lps=F.softplus(model.color.c).log().sum(), off=torch.exp(-50 * s[320:352].abs()).mean(),
                sfm=40.0 * s[352:].abs().mean(), mask=mask.mean())
    for name, value in want.items():
        assert raw[name].mean().item() == pytest.approx(value.item(), rel=1e-4), name
    assert total.item() == pytest.approx(objective(want), rel=1e-4)
    told = torch.stack([error, out["depth"] / scene.K[rays.img, 0]], 1)  # for refinement, in a ring of 512 steps
    close(model.hits[64:128], torch.cat([out["x"], told], 1), atol=1e-5)
    assert (model.hits[:, 4] != 2).sum() == 64
    col, row = (rays.uv * model.mask.seen.shape[-1]).long().unbind(1)  # for the mask network
    told = torch.cat([out["rgb"] - rays.rgb, torch.stack([10 * out["e_grad"] + 2 * e_curv, out["opacity"]], 1)], 1)
    same = ((model.mask.seen[rays.img, :, row, col] - told).abs() < 1e-4 * (1 + told.abs())).all(1)
    assert same.float().mean() > 0.8 and (told[:, :3] < 0).any()  # of two rays at one place the later stays


@pytest.mark.parametrize("changes", [dict(), dict(normals="fd"), dict(sampling="uniform"), dict(alpha="printed"),
                                     dict(gpl="literal"), dict(mask="printed"), dict(background="off")])
def test_losses_are_finite_with_any_setting_mask_sdf_and_sharpness_and_beside_the_sphere(scene, changes):
    model, (rays, pick) = new_model(scene, **changes), batch(scene)
    away = rays._replace(o=rays.o * 100)  # no ray meets the sphere
    assert finite(model, away, pick) and model.losses(away, pick, 1, generator())[1]["eik"] == 0
    assert (model.mask.calibration.tolist() == [0, 1]) == (changes.get("gpl") == "literal")
    model.zero_grad()
    sum(model.losses(rays, pick, 1, generator())[1][k] for k in ("curv", "sfm")).backward()  # move it, hide nothing
    assert all(p.grad is None or name.startswith("sdf.") for name, p in model.named_parameters())
    for logit in (-1e4, 1e4):
        model.mask.logits.fill_(logit)
        _, raw = model.losses(rays, pick, 1, generator())
        assert finite(model, rays, pick, 1) and raw["mask"].mean() == (logit > 0) == (raw["rgb"].item() == 0)
    model.sdf.lin2.weight.data.zero_()
    share = torch.lt(*g.sphere_interval(rays)).float().mean().item()  # of rays that meet it
    for value, zeta in ((-1e4, 1e-2), (-1e4, 1e5), (-1e-4, 1e5), (0.0, 20.0), (0.03, 20.0), (1e4, 1e5)):
        _, model.deviation = model.sdf.lin2.bias.data.fill_(value), g.Deviation(zeta)  # the same s everywhere
        (_, raw), zeta = model.losses(rays, pick, 1, generator()), min(max(zeta, 15 + 1 / 20), 32 * model.cfg.samples)
        assert finite(model, rays, pick) and [v.item() for v in (raw["eik"], model.deviation())] == [
            pytest.approx(share, abs=1e-7 + 1e-4 * abs(value)), pytest.approx(zeta, rel=1e-4)]
        close([raw[k].item() for k in ("curv", "off", "sfm")], [0, math.exp(-50 * abs(value)), abs(value) * min(zeta, 40)])


def test_only_lessons_teach_the_mask_and_every_eighth_step_the_cache(warm, scene):
    model, told = like(warm, **LAM), []
    model.mask.remember = lambda *args: told.append(args) or g.TransientMask.remember(model.mask, *args)
    model.cache.volume.fill_(7)
    for step in (*range(64, 73), *range(80, 128, 8)):
        (rays, pick), alone = batch(scene, seed=step), copy.deepcopy(model.mask)
        model.zero_grad()
        total, raw = model.losses(rays, pick, step, generator(step))
        total.backward(), close(raw["mask"], g.mask_at(alone.logits[pick], rays.uv))
        is_taught, is_lesson, want = model.mask.cgnet.heads[0].bias.grad is not None, "gpl" in raw, objective(raw)
        if is_lesson:
            g.TransientMask.remember(alone, *told[-1])
            alone.calibrate(told[-1][2])
            taught, gpl = alone.objective(pick)
            want += taught.item()
            close(torch.stack([raw["gpl"], *model.mask.calibration]), torch.stack([gpl, *alone.calibration]))
        assert is_taught == is_lesson == (step % g.MASK_EVERY == 0) and torch.equal(alone.logits, model.mask.logits)
        assert total.item() == pytest.approx(want, rel=1e-5)
        fresh = (model.cache.volume[0, 0] != 7).all(2).all(1)
        assert torch.equal(fresh, torch.arange(len(fresh)) % 8 <= step // 8 - 8)
    model.zero_grad()
    model.cfg.mask = "off"
    total, raw = model.losses(*batch(scene), 0, generator())
    total.backward()
    assert not raw["mask"].any() and "gpl" not in raw and all(p.grad is None for p in model.mask.parameters())


def test_a_bad_batch_does_not_poison_what_the_model_remembers(warm, scene, monkeypatch):
    model, render = like(warm), g.render_rays
    for value in (math.nan, math.inf):
        with monkeypatch.context() as patch:
            patch.setattr(g, "render_rays", lambda *args: {k: value * v for k, v in render(*args).items()})
            model.losses(*batch(scene), 0, generator())
        assert finite(model, *batch(scene, seed=1), step=g.MASK_EVERY)
        assert all((b.float().abs() < 1e15).all() for b in model.buffers())


def test_every_parameter_has_one_group_and_the_rate_of_its_kind(scene):
    model = new_model(scene, lr_net=0.1, lr_grid=0.2, lr_zeta=0.3)
    kinds = {model.deviation.v: 0.3} | {octree.features: 0.2 for octree in model.octrees}
    kinds |= dict.fromkeys(model.mask.parameters(), 8e-3) | {model.appearance.weight: 0.2}
    rates = [(id(p), group["lr"]) for group in model.groups() for p in group["params"]]
    assert sorted(rates) == sorted((id(p), kinds.get(p, 0.1)) for p in model.parameters()) and len(kinds) > 20
    for p in model.parameters():
        p.grad = torch.full_like(p, 1e-13)  # as zeta's where all is sharp, for long
    before, optimizer = model.deviation.v.item(), torch.optim.Adam(model.groups(), **model.adam)
    for _ in range(100):
        optimizer.step()
    assert abs(model.deviation.v.item() - before) < 1e-2 * 0.3


def test_warm_up_on_uniform_points_makes_a_sphere_and_the_cache_knows_it(warm):
    x, n = random(20_000, 3, low=-1, dtype=torch.float32), warm.cache.volume.shape[-1]
    assert (warm.distance(x) - (x.norm(dim=1) - 0.5)).square().mean().sqrt() < 0.02
    at = torch.tensor([(0, 0, 0), (5, 17, 40), (n - 1, 3, n - 2)])
    close(warm.cache.volume[0, 0][tuple(at.T)], warm.distance(at * 2 / (n - 1) - 1), atol=1e-5)


def test_automatic_parts_follow_the_facts_of_the_scene_and_settings_overrule_them(scene):
    plain, mixed = (scene._replace(raw=scene.raw | facts) for facts in (
        dict(exposure_spread=0.001, bg_color=[0.2, 0.4, 0.6]),
        dict(exposure_spread=0.1, bg_color=[math.nan] * 3, footprint=0.03)))
    rays = (rays := batch(scene)[0])._replace(o=rays.o * 100)  # no ray meets the sphere
    for facts, how, has in ((plain, "auto", False), (mixed, "auto", True), (plain, "on", True), (mixed, "off", False)):
        model = new_model(facts, appearance=how, background=how)
        assert (model.codes().shape == (10, 4), model.background is not None, model.codes().requires_grad) == (has,) * 3
        assert (model.render(rays, model.codes()[rays.img])["rgb"] == model.bg_color).all() == (not has)
    close(new_model(plain).bg_color, [0.2, 0.4, 0.6])
    octree, far = (model := new_model(mixed, levels=5)).sdf.octree, scene.points[scene.points.norm(dim=1) > 1]
    assert (fill(model.background.octree).locate(g.contract(far))[0] >= 8).all() and octree.levels == 5 and octree.active == 3 and model.eps == octree.cell(2) / 2


@pytest.mark.parametrize("grid", ["octree", "uniform"])
def test_the_poorest_scenes_train(scene, grid):
    none = torch.zeros(0, dtype=torch.long)  # no photo shows a point
    for poor, changes in ((scene._replace(points=scene.points[:1], track_uv=scene.track_uv[:0], track_photo=none), {}),
                          (scene._replace(rgb=0 * scene.rgb, thumbs=0 * scene.thumbs), {}), (scene, dict(levels=1, samples=3, bg_samples=2))):
        model = new_model(poor, grid=grid, **changes)
        assert finite(model, *batch(poor)) and finite(model, *batch(poor, 2, 1))  # as few rays as --rays allows


@pytest.mark.parametrize("setting, masked, is_last, stays", [
    ("auto", "none", True, False), ("auto", "none", False, True), ("on", "none", True, True), ("printed", "none", True, True),
    ("auto", "test", True, False), ("auto", "train", True, True), ("auto", "one", True, True)])  # of these photos, 2 %
def test_a_mask_that_is_nearly_empty_goes_off_at_the_last_plan(scene, setting, masked, is_last, stays):
    model, (test, train) = new_model(scene, mask=setting), map(scene.photos, (True, False))
    looked_at = dict(none=test[:0], test=test, train=train, one=train[:1])[masked]
    model.mask.logits[looked_at] = torch.where(torch.arange(48) > 0, -8.0, 9.0)[:, None]
    assert (model.plan(is_last)["mask"] != "off") is stays and model.cfg.mask == setting


def test_a_plan_refines_by_what_the_model_remembers(warm, monkeypatch):
    model, asked, keys = like(warm, max_mb=77.0), [], torch.tensor([5, 3])
    monkeypatch.setattr(g, "refined_keys", lambda *args: asked.append(args) or keys)
    assert torch.equal(model.plan(True)["keys"], keys)
    [(octree, sdf, hits, zeta, max_mb)] = asked
    assert octree is model.sdf.octree and hits is model.hits and (zeta, max_mb) == (pytest.approx(20), 77)
    assert torch.equal(sdf(warm.sfm), model.distance(warm.sfm))
    octree = (uniform := new_model(warm.scene, grid="uniform", levels=3, max_mb=41.0)).sdf.octree
    assert counts(octree) == [16 ** 3, 32 ** 3, 64 ** 3]  # fine everywhere, and stays so
    assert torch.equal(uniform.plan(True)["keys"], octree.split_keys)


def test_following_a_plan_moves_adams_moments_along_with_their_features(scene):
    model = new_model(scene, levels=4)
    octree, optimizer = model.sdf.octree, torch.optim.Adam(model.groups(), fused=True)
    for is_finer in (True, False):  # some cells are split, then others merged
        model.losses(*batch(scene), 0, generator())[0].backward()
        before = octree.features.detach().clone()
        optimizer.step()
        assert not torch.equal(octree.features, before) and len(optimizer.state) == len(list(model.parameters()))
        old, features = octree.row_key, octree.features
        optimizer.state[features]["exp_avg"][:, 1] = (old + g.PINNED).float()
        finer = torch.cat([octree.split_keys, octree.key(of_level(octree, 2)[:40])])
        model.follow(dict(keys=finer if is_finer else octree.split_keys[::2], mask="off"), optimizer)
        kept, state = torch.isin(octree.row_key, old), optimizer.state[octree.features]
        assert torch.equal(state["exp_avg"][kept, 1], (octree.row_key[kept] + g.PINNED).float()) and state["step"] >= 1
        assert not state["exp_avg"][~kept].any() and not state["exp_avg_sq"][~kept].any()
        ids = [id(p) for group in optimizer.param_groups for p in group["params"]]
        assert sorted(ids) == sorted(id(p) for p in model.parameters()) and id(features) not in ids
        assert kept.any() and len(octree.row_key) != len(old) and model.cfg.mask == "off"


# ---- 8 energy ------------------------------------------------------------------------------------------

def test_meter_adds_up_what_a_counter_counts_or_says_none_and_never_zero(monkeypatch, capsys):
    for reads, joules in (((1000.0, 1003, 1003, 4600), 3600), ((7,), 0), ((9.5, 10, 2, 6), 4.5), ((1, 2, None), None)):
        meter = g.EnergyMeter(CPU, counter=iter(reads).__next__)
        for _ in reads:
            meter.tick()
        assert meter.joules == joules  # the last reading fails
    assert capsys.readouterr().out.count("energy is null") == 1
    monkeypatch.setitem(sys.modules, "pynvml", None)
    (meter := g.EnergyMeter(torch.device("cuda"))).tick(), meter.tick()
    assert meter.joules is None and capsys.readouterr().out.count("\n") == 1


def test_rapl_sums_packages_and_skips_their_parts_and_loses_at_most_one_reading_to_a_wrap(tmp_path):
    with pytest.raises(UserError, match="no counter in"):
        g.open_counter(CPU, str(tmp_path))
    meter = g.EnergyMeter(CPU)
    for energies in ((900_000, 100_000, 5), (1_400_000, 150_000, 999_999), (100_000, 160_000, 9), (300_000, 160_000, 7)):
        for zone, name, energy in zip(("0", "1", "0:0", "2"), ("package-0", "package-1", "core", "psys"), (*energies, energies[0])):
            (folder := tmp_path / f"intel-rapl:{zone}").mkdir(exist_ok=True)
            (folder / "energy_uj").write_text(f"{energy}\n"), (folder / "name").write_text(f"{name}\n")
        meter.counter = meter.counter or g.open_counter(CPU, str(tmp_path))
        meter.tick()
    assert meter.joules == pytest.approx(0.55 + 0.2) and "rapl" in meter.source
    (tmp_path / "intel-rapl:1/energy_uj").unlink()  # its counter cannot be read: the sum would be wrong
    meter.tick()
    assert meter.joules is None


def test_nvml_is_asked_for_torchs_gpu(monkeypatch):
    asked, spent = [], itertools.count(7000, 2)  # mJ
    monkeypatch.setitem(sys.modules, "pynvml", SimpleNamespace(
        nvmlInit=lambda: None, nvmlDeviceGetHandleByUUID=asked.append,
        nvmlDeviceGetTotalEnergyConsumption=lambda gpu: next(spent)))
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid=device))
    (meter := g.EnergyMeter(torch.device("cuda:1"))).tick(), meter.tick()
    assert meter.joules == pytest.approx(0.002) and "nvml" in meter.source
    monkeypatch.setattr(g, "RANKS", 2), g.open_counter(torch.device("cuda:1"))
    assert asked == ["GPU-cuda:1", "GPU-0", "GPU-1"]  # the first process speaks for both


# ---- 9 training ----------------------------------------------------------------------------------------

def hasten(patch):
    """No warm-up; and each plan splits more cells, whatever rays say."""
    plan = g.GeoNVS.plan

    def splitting(self, is_last):
        found, keys = plan(self, is_last), self.sdf.octree.key(of_level(self.sdf.octree, 1))
        found["keys"] = torch.cat([found["keys"], keys[len(self.sdf.octree.row_key) % 97::97]])
        return found
    patch.setattr(g.GeoNVS, "start", lambda self, gen: None)
    patch.setattr(g.GeoNVS, "plan", splitting)


quick = pytest.fixture(lambda monkeypatch: hasten(monkeypatch), name="quick")


def before_step(patch, act):
    step = g.training_step
    patch.setattr(g, "training_step", lambda *args: (act(args[3]), step(*args))[1])


def jump(patch, pause=1e4):
    """Time passes in training steps alone, by default so much that the run reports and saves after each."""
    now = [500.0]
    before_step(patch, lambda state: now.append(now[-1] + pause))
    look = lambda: now.append(now[-1] + 1e-3) or now[-1]
    patch.setattr(g, "time", SimpleNamespace(perf_counter=look, monotonic=look))


def run_training(scene, run, saved=None, **changes):
    run.mkdir(exist_ok=True)
    return g.train(config(**dict(levels=3) | changes), scene, run, saved)


def same_weights(a, b):
    a, b = ({k: v for k, v in m.state_dict().items() if torch.is_tensor(v)} for m in (a, b))
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def log_of(run, without="seconds"):
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != without} for line in lines]


def checkpoint(run, name="checkpoint.pt"):
    return g.read_checkpoint(run / name, {})[0]


@pytest.fixture(scope="module")
def six(scene, tmp_path_factory):
    run = tmp_path_factory.mktemp("six")
    with pytest.MonkeyPatch.context() as patch:
        hasten(patch)
        before_step(patch, lambda state: state["step"] and shutil.copy(
            run / "checkpoint.pt", run / f"after_{state['step']}.pt"))
        jump(patch)
        model, _ = run_training(scene, run)
    return SimpleNamespace(run=run, model=model)


@pytest.mark.parametrize("after", [0, 1, 3, 5])
def test_a_repeated_or_resumed_run_ends_bit_for_bit_as_the_first(scene, tmp_path, quick, six, after, monkeypatch):
    jump(monkeypatch)
    for name in () if after else ("metrics.json", "panel.png", "mesh.ply", "film.mp4", "checkpoint.pt"):
        (tmp_path / name).touch()
    lines = (six.run / "log.jsonl").read_text().splitlines(True)
    (tmp_path / "log.jsonl").write_text("".join(lines[:after]) or "of a former run")
    model, _ = run_training(scene, tmp_path, checkpoint(six.run, f"after_{after}.pt") if after else None)
    assert same_weights(six.model, model) and log_of(tmp_path) == log_of(six.run)
    assert len(model.sdf.octree.row_key) > len(new_model(scene, levels=3).sdf.octree.row_key)  # refined
    assert after or not same_weights(model, run_training(scene, tmp_path, seed=1)[0])
    lines, names = log_of(tmp_path, None), {"psnr", "energy_wh", "dropped", "zeta", "opacity", "mask", *g.GeoNVS.terms}
    close([[line["step"], line["seconds"]] for line in lines], [[i, 1e4 * i] for i in range(1, 7)], atol=1)
    assert all(names <= line.keys() and 0 < line["psnr"] < 50 for line in lines) and "gpl" in lines[0]
    assert {p.name for p in tmp_path.iterdir()} == {"log.jsonl", "checkpoint.pt"}


def child(code, folder, **env):
    code = f"import sys; sys.path[:0] = {[p or '.' for p in sys.path]!r}; import {Path(__file__).stem} as t; {code}"
    env, pipe = dict(os.environ, OMP_NUM_THREADS=str(torch.get_num_threads())) | env, subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", code], cwd=folder, env=env, text=True, stdout=pipe, stderr=pipe)


def test_a_run_killed_at_any_moment_goes_on_bit_for_bit(scene, tmp_path, quick):
    np.savez(tmp_path / "scene.npz", **toy(photos=8))
    process = child("t.hasten(p := t.pytest.MonkeyPatch()); t.jump(p); t.run_training("
                    "t.g.load_scene(dict(t.np.load('scene.npz'))), t.Path(), steps=30)", tmp_path)
    while not (tmp_path / "checkpoint.pt").exists() and process.poll() is None:
        time.sleep(0.01)
    time.sleep(0.2)  # whenever that is: the checkpoint is whole
    process.kill()
    assert process.communicate()[1] == "" and 0 < (saved := checkpoint(tmp_path))["state"]["step"] < 30
    runs = run_training(scene, tmp_path, saved, steps=30), run_training(scene, tmp_path / "whole", steps=30)
    assert same_weights(*[model for model, _ in runs]) and log_of(tmp_path)[-1] == log_of(tmp_path / "whole")[-1]


def spoil(patch, is_bad, how=lambda total, model: total * math.nan):
    losses = g.GeoNVS.losses

    def spoiled(self, rays, pick, step, gen):
        total, raw = losses(self, rays, pick, step, gen)
        return how(total, self) if is_bad(step) else total, raw
    patch.setattr(g.GeoNVS, "losses", spoiled)


@pytest.mark.parametrize("how", [  # the last has an infinite slope
    lambda total, model: total * math.nan, lambda total, model: total + math.inf,
    lambda total, model: total + (model.deviation.v - model.deviation.v.detach()).sqrt()])
def test_a_void_step_is_left_out_and_counted_and_the_next_one_is_taken(scene, tmp_path, monkeypatch, how, six, capsys):
    spoil(monkeypatch, lambda step: step == 3, how)
    before = checkpoint(six.run, "after_3.pt")
    _, state = run_training(scene, tmp_path, before, steps=4)
    after = checkpoint(tmp_path)
    assert state["dropped"] == log_of(tmp_path)[-1]["dropped"] == after["state"]["dropped"] == 1
    g.report(six.model, tmp_path / "log.jsonl", 0.25, state | dict(seconds=2.0, step=4), dict(rgb=torch.tensor(math.nan)))
    assert log_of(tmp_path)[-1]["rgb"] is None and "  128 rays/s  0.1 min left" in capsys.readouterr().out  # JSON has no NaN
    assert all(torch.equal(after["model"][name], before["model"][name]) for name, _ in six.model.named_parameters())
    for i, moments in after["optimizer"]["state"].items():
        assert all(torch.equal(v, before["optimizer"]["state"][i][k]) for k, v in moments.items())
    model, state = run_training(scene, tmp_path, after, steps=5)
    assert state["dropped"] == 1 and not torch.equal(model.sdf.lin1.weight, before["model"]["sdf.lin1.weight"])


def test_twenty_void_steps_in_a_row_stop_a_run_with_its_last_good_weights_and_fewer_do_not(scene, tmp_path, quick, monkeypatch):
    with monkeypatch.context() as patch:
        spoil(patch, lambda step: step % 20 > 0)
        assert run_training(scene, tmp_path, steps=21)[1]["dropped"] == 21 - 2
    spoil(monkeypatch, lambda step: step >= 2)
    with pytest.raises(UserError, match=f"learning rate.*{tmp_path}/checkpoint.pt"):
        run_training(scene, tmp_path, steps=1000)
    state, model = (checkpoint(tmp_path)[k] for k in ("state", "model"))
    assert 2 + 20 <= state["step"] <= 60 and state["dropped"] == state["step"] - 2
    assert all(v.isfinite().all() for v in model.values() if torch.is_tensor(v))


class AsksNothing(TorchDispatchMode):
    """Refuses operators that need a value of a tensor on the host: a GPU would run dry while it waits."""
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        is_free = func.name() == "aten::equal" and args[0].dtype == torch.bool  # older torch's check of quantile's q, on CPUs
        assert is_free or not re.search("_local_scalar_dense|nonzero|masked_select|unique|equal", func.name()), func.name()
        return func(*args, **kwargs or {})


@pytest.mark.parametrize("how", [{}, dict(normals="fd"), dict(mask="printed"), dict(mask="off", sampling="uniform")])
def test_a_step_asks_the_device_for_no_value(warm, scene, how):
    model, state, photos = like(warm, **how), dict(step=0), scene.photos(False)
    optimizer = torch.optim.Adam(model.groups(), **model.adam, fused=True)
    for asks in (False, True):  # Adam's own first step does
        with AsksNothing() if asks else contextlib.nullcontext():
            for _ in range(g.MASK_EVERY):
                g.training_step(model, optimizer, photos, state, 0.5, generator())
    with pytest.raises(AssertionError, match="_local_scalar_dense"), AsksNothing():
        model.deviation().item()


def test_compiled_and_eager_losses_agree(warm, scene, monkeypatch):
    eager = like(warm).losses(*batch(scene), 1, generator())[0]
    monkeypatch.setattr(g, "render_rays", torch.compile(g.render_rays, backend="aot_eager"))
    close(like(warm).losses(*batch(scene), 1, generator())[0], eager, rtol=1e-5)


@pytest.mark.parametrize("step, progress, share", [(0, 0, .05), (9, 0, .5), (19, 0, 1), (500, .5, .525), (0, 1, .0025)])
def test_the_learning_rate_warms_up_linearly_and_falls_by_a_cosine_to_five_percent(scene, step, progress, share):
    (model := new_model(scene)).deviation = g.Deviation(100.0)  # above its floor
    optimizer, zeta = torch.optim.Adam(model.groups(), **model.adam, fused=True), model.deviation.v.item()
    g.training_step(model, optimizer, scene.photos(False), dict(step=step), progress, generator())
    close([group["lr"] for group in optimizer.param_groups], [share * group["lr"] for group in model.groups()])
    assert abs(model.deviation.v.item() - zeta) == pytest.approx(share * model.cfg.lr_zeta, rel=1e-2)  # as Adam begins


def test_the_budget_in_minutes_ends_training_and_drives_its_schedule(scene, tmp_path, quick, monkeypatch):
    seen, step, draw, drawn = [], g.training_step, g.make_rays, []
    monkeypatch.setattr(g, "training_step", lambda *args: seen.append(args[4]) or step(*args))
    monkeypatch.setattr(g, "make_rays", lambda scene, img, pixel: drawn.append(img) or draw(scene, img, pixel))
    jump(monkeypatch, pause=2.0)
    run_training(scene, tmp_path, steps=2, minutes=0.5)  # the steps do not count
    assert len(seen) == 15 and log_of(tmp_path)[0]["step"] == 3  # a line every five seconds
    close(seen, np.arange(15) / 15, atol=0.01)
    assert set(torch.cat(drawn).tolist()) == set(scene.photos(False).tolist())  # never a test photo


@pytest.mark.parametrize("before, counter, joules", [(100.0, 5.0, 107.0), (None, 5.0, None), (100.0, None, None)])
def test_resuming_adds_time_dropped_steps_and_energy_and_half_a_measurement_is_none(
        scene, tmp_path, quick, six, monkeypatch, before, counter, joules):
    saved, ticks = checkpoint(six.run, "after_3.pt"), itertools.chain([counter], itertools.repeat(12.0))
    saved["state"].update(joules=before, seconds=1000.0, dropped=4)
    monkeypatch.setattr(g, "EnergyMeter", functools.partial(g.EnergyMeter, counter=ticks.__next__))
    _, state = run_training(scene, tmp_path, saved)  # its log is lost
    assert (last := log_of(tmp_path, None)[-1])["energy_wh"] == (joules and joules / 3600) and state["joules"] == joules and bool(state["source"]) is bool(joules)
    assert 1000 < last["seconds"] < 1100 and last["dropped"] == 4 and last["step"] == 6


@pytest.mark.parametrize("changes", [dict(), dict(lr_net=0.0), dict(lam_eik=1e6), dict(mask="off"), dict(steps=60)])
def test_resuming_takes_what_flags_say(scene, tmp_path, quick, six, monkeypatch, changes):
    saved, plans, plan = checkpoint(six.run, "after_5.pt"), [], g.GeoNVS.plan
    monkeypatch.setattr(g.GeoNVS, "plan", lambda self, is_last: plans.append(is_last) or plan(self, is_last))
    model, _ = run_training(scene._replace(info=scene.info | dict(folder="moved", split="too")), tmp_path, saved, **changes)
    assert same_weights(model, six.model) is (not changes) and (model.cfg.mask == "off") is ("mask" in changes)
    assert torch.equal(model.color.c, saved["model"]["color.c"]) is ("lr_net" in changes)
    assert plans == ([False] * 5 + [True] if "steps" in changes else [])  # a larger budget refines again


def test_bad_checkpoints_are_refused_in_one_sentence_and_do_no_harm(six, scene, tmp_path, monkeypatch):
    model, path, good = new_model(scene, levels=3), tmp_path / "checkpoint.pt", torch.load(six.run / "after_3.pt")
    data, loads, load = (six.run / "after_3.pt").read_bytes(), [], torch.load
    monkeypatch.setattr(torch, "load", lambda *a, **k: loads.append(1) or load(*a, **k))

    def refused(value, **how):
        torch.save(value, path, **how) if not isinstance(value, bytes) else path.write_bytes(value)
        before = path.read_bytes()
        try:
            saved, cfg = g.read_checkpoint(path, {})
            g.restore(saved, path, model)
        except UserError as error:
            return "\n" not in str(error) and path.name in str(error) and path.read_bytes() == before
        return False
    bomb = zipped(dict(a=np.zeros(2 ** 20)), np.savez_compressed)
    assert refused(bomb) and refused(good, _use_new_zipfile_serialization=False) and not loads  # unread
    rng, at = np.random.default_rng(0), data.find(b"data.pkl")
    for low, high in ((0, len(data)), (data.find(b"PK\1\2"), len(data)), (at, at + 6000)) * 5:
        refused(flipped(data, rng.integers(8 * low, 8 * high, rng.integers(1, 5))))  # or a weight's bit passes
    assert all(refused(data[:n]) and refused(rng.bytes(n % 300)) for n in (0, 1, *rng.integers(0, len(data) - 23, 6)))
    odd = [None, -1, "x", [], {"a": 1}, torch.full((5,), 2 ** 62), Path]
    bad = [good | {key: value} for key in ("config", "model", "octrees", "optimizer", "state") for value in odd]
    bad += [good | dict(config=good["config"] | {key: "x"}) for key in ("rays", "lam_gpl", "flux")]
    bad += [good | dict(state=good["state"] | {key: x}) for key in ("step", "refined", "seconds", "dropped") for x in odd]
    bad += [*odd, good | dict(run=Path), b"cos\nmkdir\n(S'%s'\ntR." % bytes(tmp_path / "harm")]
    assert all(map(refused, bad)) and not (tmp_path / "harm").exists() and not refused(data)


@pytest.mark.parametrize("changes", [dict(hidden=8), dict(levels=4), dict(background="off"), dict(gpl="literal"), dict(grid="uniform"), {}, None])
def test_a_checkpoint_that_does_not_fit_is_refused_and_its_run_stays(scene, tmp_path, quick, six, changes):
    run = shutil.copytree(six.run, tmp_path / "run")
    before, saved = {p.name: p.read_bytes() for p in run.iterdir()}, checkpoint(run)
    other = scene._replace(raw=scene.raw | dict(is_test=~scene.raw["is_test"]))  # another split
    with pytest.raises(UserError, match="does not fit"):
        run_training(other if changes is None else scene, run, saved | (dict(rng=None) if changes == {} else {}), **changes or {})
    assert {p.name: p.read_bytes() for p in run.iterdir()} == before


def together():
    def kept(*args):
        model, state = train(*args)
        torch.save(dict(model.named_parameters()) | dict(hits=model.hits, state=state), f"{g.RANK} of {g.RANKS}.pt")
        return model, state
    train, spent = g.train, itertools.chain([0], itertools.repeat(10 * (g.RANK + 1)))
    with pytest.MonkeyPatch.context() as patch:
        hasten(patch)
        spoil(patch, lambda step: step == 5 and g.RANK == g.RANKS - 1, lambda total, model: total + math.inf)  # on one
        patch.setattr(data_prep, "open_scene", lambda *_: dict(np.load("scene.npz")))
        for name, f in dict(train=kept, fit_codes=lambda model, _, photos: model.codes()[photos],
                            EnergyMeter=functools.partial(g.EnergyMeter, counter=spent.__next__)).items():
            patch.setattr(g, name, f)
        g.main(["--name=a", "--device=cpu", "--lr_grid=0.05", "--lr_net=0.01", *FLAGS, "--steps=40"])
        patch.setattr(g, "train", train)
        run_training(g.load_scene(dict(np.load("scene.npz"))), Path("runs/b"), steps=3)


def test_two_processes_train_one_model_on_the_rays_of_both(tmp_path, monkeypatch):
    """A step that is void on the second is so for both; the first speaks and writes."""
    for name in ("alone", "pair"):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "scene.npz", **toy(photos=8))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        env = dict(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(free.getsockname()[1]), WORLD_SIZE="2",
                   GLOO_SOCKET_IFNAME="lo0" if sys.platform == "darwin" else "lo")
    pair = [child("t.g.run_command_line(t.together)", tmp_path / "pair", RANK=rank, LOCAL_RANK=rank, **env) for rank in "01"]
    monkeypatch.chdir(tmp_path / "alone")
    together()
    (said, errors), (silence, more) = (process.communicate(timeout=300) for process in pair)
    assert [process.returncode for process in pair] == [0, 0] and said != "" == silence, errors + more
    a, b, alone = (torch.load(tmp_path / name) for name in ("pair/0 of 2.pt", "pair/1 of 2.pt", "alone/0 of 1.pt"))
    states, rays = [end.pop("state") for end in (a, b, alone)], [end.pop("hits") for end in (a, b)]
    assert [(s["dropped"], s["joules"]) for s in states] == [(1, 10), (1, 20), (1, 10)]  # each reads a meter
    assert all(torch.equal(a[name], b[name]) for name in a) and not torch.equal(*rays)
    assert [(hits[:, 4] != 2).sum() for hits in rays] == [40 * 32] * 2  # half of --rays each
    start, end, other = (log_of(tmp_path / run)[-1]["psnr"] for run in ("pair/runs/b", "pair/runs/a", "alone/runs/a"))
    assert end == pytest.approx(other, abs=0.5) and end > start + 0.5  # it learns as one process does
    files = [{str(p.relative_to(tmp_path / n)) for p in (tmp_path / n).glob("runs/*/*")} for n in ("alone", "pair")]
    assert files[0] == files[1] and len(files[0]) == 5 + 2


# ---- 10 scoring, mesh, pictures ------------------------------------------------------------------------

def picture(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape) / 255


def test_psnr_and_ssim_equal_naive_loops():
    a, mixed = picture(13, 14, 3), g.to_uint8(picture(13, 14, 3, seed=1) * 0.3 + picture(13, 14, 3) * 0.7) / 255
    k, total = np.exp(-np.arange(-5, 6) ** 2 / (2 * 1.5 ** 2)), []
    for c, i, j in itertools.product(range(3), range(3), range(4)):
        x, y = (p[i:i + 11, j:j + 11, c] for p in (a, mixed))
        mx, my, xx, yy, xy = ((np.outer(k, k) / k.sum() ** 2 * v).sum() for v in (x, y, x * x, y * y, x * y))
        total.append((2 * mx * my + 1e-4) * (2 * (xy - mx * my) + 9e-4) / (
            (mx ** 2 + my ** 2 + 1e-4) * (xx - mx ** 2 + yy - my ** 2 + 9e-4)))
    truth, rgb = (np.tile(p, (1, 2, 1)) for p in (a, mixed))  # twice as wide, as the right half is scored
    assert [g.score(dict(truth=truth[:n], rgb=rgb[:n]))["ssim"] for n in (13, 10)] == [pytest.approx(np.mean(total), rel=1e-6), None]
    assert g.psnr(a, a + 0.1) == g.psnr(torch.tensor(a + 0.1), torch.tensor(a)) == pytest.approx(20)


def test_the_right_half_is_scored_in_8_bits_beside_the_mean_colour_of_each_row_of_the_left(monkeypatch, capsys):
    truth, is_left = picture(40, 71, 3), np.arange(71)[:, None] < 35
    net = SimpleNamespace(to=lambda device: lambda a, b, normalize: normalize * (a[:, 1, 2, 3] + b[:, 2, 4, 5]))  # colours first
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=lambda net, verbose, own=net: dict(alex=own)[net]))
    found = g.score(dict(truth=truth, rgb=np.where(is_left, 0, truth + 0.4 / 255)), g.make_lpips("cpu"))
    flat = np.floor(np.repeat(truth[:, :35].mean(1, keepdims=True), 36, 1) * 255 + 0.5) / 255
    assert found["lpips"] == pytest.approx(truth[2, 38, 1] + truth[4, 40, 2], abs=1e-5)
    assert found["psnr"] == pytest.approx(100) and found["ssim"] == pytest.approx(1)
    assert found["psnr_floor"] == pytest.approx(g.psnr(flat, truth[:, 35:]), abs=1e-9)
    assert g.score(dict(truth=truth[:20], rgb=truth[:20]), lpips=1)["lpips"] is None  # too small for it
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert g.make_lpips("cpu") is None and capsys.readouterr().out.count("\n") == 1


def test_fitting_codes_starts_from_the_mean_sees_left_halves_only_and_touches_no_scene(warm, scene, monkeypatch):
    photos, model, fitted, seen, rates, make_rays = scene.photos(True), copy.deepcopy(warm), [], [], [], g.make_rays
    with monkeypatch.context() as patch:
        patch.setattr(g, "make_rays", lambda *args: seen.append(rays := make_rays(*args)) or rays)
        patch.setattr(torch.optim.Adam, "step", lambda adam: rates.append(adam.param_groups[0]["lr"]))
        g.fit_codes(model, scene, photos, 8, 500)
    close(rates, np.geomspace(0.1, 0.01, 9)[:8])
    for photo in photos.tolist():  # every pixel of the left half, and no other
        w, h = scene.wh[photo].tolist()
        places = {tuple(uv) for rays in seen for uv in (rays.uv[rays.img == photo] * scene.wh[photo]).int().tolist()}
        assert len(places) > 0.9 * (w // 2) * h and {u for u, _ in places} == set(range(w // 2))
    for left, *shades in ((False, 9, 9), (False, 0, 0), (True, 0, 0), (True, 0, 255)):
        rgb = scene.rgb.clone()
        for photo, shade in zip(photos.tolist(), shades):
            w, h = scene.wh[photo].tolist()
            is_left = torch.arange(w * h) % w < w // 2
            rgb[scene.start[photo]:scene.start[photo + 1]][is_left == left] = shade
        fitted.append(g.fit_codes(model, scene._replace(rgb=rgb), photos, 8, 16))
    close(start := g.fit_codes(model, scene, photos, 0), model.codes()[~scene.is_test].mean(0).expand(2, -1))
    assert torch.equal(fitted[0], fitted[1]) and same_weights(model, warm)
    assert all(p.requires_grad and p.grad is None for p in model.parameters())
    rays = g.make_rays(scene, photos.repeat_interleave(60), torch.arange(120) % 60 * 11)
    dark, plain, bright = (model.render(rays, c.repeat_interleave(60, 0))["rgb"][60:].mean() for c in (fitted[2], start, fitted[3]))
    assert dark < plain < bright and torch.equal(fitted[2][0], fitted[3][0])  # each photo gets its own light
    assert g.fit_codes(bare := new_model(scene, appearance="off"), scene, photos).shape == (2, 0)
    assert not bare.appearance.weight.requires_grad  # an empty table stays frozen


class Perfect(nn.Module):
    """A model that knows the toy, but renders left halves of photos black."""
    sdf = shift = 0.0

    def __init__(self, raw):
        super().__init__()
        people = [torch.as_tensor(part).float().reshape(1, 1, h, w) for part, (w, h) in zip(
            np.split(raw["occluder"], raw["start"][1:-1]), raw["wh"])]
        self.cfg, self.mask = g.Config(), SimpleNamespace(look=lambda pick: 40 * people[pick] - 20)
        self.codes = lambda: torch.zeros(10, 2)
        self.render = lambda rays, code: dict(rgb=rays.rgb * (rays.uv[:, :1] > 0.499))
        self.distance = lambda x: (s := torch.as_tensor(data_prep.toy_sdf(x.double().numpy() * raw["scale"] + raw[
            "center"], True, info(raw)["landmark"]) / raw["scale"])) + torch.where(s.abs() < 0.05, self.shift, 1.0)


def test_scores_and_toy_truth_of_a_perfect_model_are_perfect(scene, monkeypatch):
    monkeypatch.setattr(g, "fit_codes", lambda model, scene, photos: model.codes()[photos])
    model, raw, names = Perfect(scene.raw), scene.raw, scene.raw["name"][scene.raw["is_test"]].tolist()
    scores, found, people = g.evaluate(model, scene), g.toy_truth(model, scene), []
    rows, none = scores["per_image"], g.evaluate(model, scene._replace(is_test=0 * scene.is_test > 0))
    assert scores["psnr"] == pytest.approx(100) and scores["ssim"] == pytest.approx(1) and scores["lpips"] is None
    assert [row["name"] for row in rows] == names and len(scores["frames"]) == 2
    assert scores["psnr_floor"] == pytest.approx(np.mean([row["psnr_floor"] for row in rows]))
    assert none["psnr"] is none["psnr_floor"] is None and none["per_image"] == []
    assert found["sdf_error"] < 1e-6 and found["mask_iou"] == 1 and found["mask_static"] < 1e-6
    assert g.toy_truth(Perfect(other := toy(photos=8, landmark=2)), g.load_scene(other))["sdf_error"] < 1e-6
    model.shift, model.mask.look = -0.01, lambda pick: torch.full((1, 1, 8, 8), 20.0)
    for occluder, is_test in zip(np.split(raw["occluder"], raw["start"][1:-1]), raw["is_test"]):
        people += [] if is_test else occluder.tolist()
    want = dict(sdf_error=0.01, mask_iou=np.mean(people[::5]), mask_static=1)
    assert g.toy_truth(model, scene) == pytest.approx(want, rel=1e-3)
    model.cfg = g.Config(mask="off")
    assert (found := g.toy_truth(model, scene))["mask_iou"] is found["mask_static"] is None


def test_a_rendered_photo_and_its_panel_show_pixels_in_order_whatever_the_chunk(warm, scene, monkeypatch):
    w, h = scene.wh[1].tolist()
    whole = g.render_photo(warm, scene, 1, warm.codes()[1])
    assert whole["rgb"].shape == (h, w, 3) and whole["depth"].shape == (h, w) and "eikonal" not in whole
    assert np.array_equal(g.to_uint8(whole["truth"]).reshape(-1, 3), scene.raw["rgb"][scene.start[1]:scene.start[2]])
    monkeypatch.setattr(g, "CHUNK", 100)
    close(g.render_photo(warm, scene, 1, warm.codes()[1])["rgb"], whole["rgb"], atol=1e-4)
    whole |= dict(truth=whole["truth"] * 0 + [1, 0, 0], rgb=whole["rgb"] * 0 + [0, 0, 1], normal=whole["rgb"] * 0 + [1, 0, 0])
    monkeypatch.setattr(g.TransientMask, "look", lambda self, pick: torch.full((1, 1, 8, 8), 20.0))
    made = g.panel(warm, [(1, "a", whole), (0, "b", {k: v[:, ::2] for k, v in whole.items()})])
    red, blue = (np.argwhere((made == color).all(2)) for color in ([255, 0, 0], [0, 0, 255]))
    assert len(red) == len(blue) > 1000 and red[:, 1].mean() < blue[:, 1].mean()
    assert all((abs(made - np.array(color)) < 6).all(2).sum() > 1000 for color in ((255, 128, 128), (253, 231, 37)))  # x, yellow


def test_mesh_of_the_warm_up_sphere_is_that_sphere_closed_looking_outwards_and_reads_back(warm, scene, tmp_path):
    assert torch.equal(warm.distance(x := random(99, 3, low=-1).float()), warm.sdf(x)[0])  # what rays see
    vertices, faces = mesh = g.extract_mesh(warm)
    a, b, c = (x := (vertices - scene.raw["center"]) / scene.raw["scale"])[faces].transpose(1, 0, 2)
    directed = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)])
    close(np.linalg.norm(x, axis=1), np.full(len(x), 0.5), atol=0.08)
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(4 / 3 * math.pi * 0.5 ** 3, rel=0.1)
    forth, back = (set(map(tuple, e.tolist())) for e in (directed, directed[:, ::-1]))
    assert len(forth) == len(directed) and forth == back  # each edge once in each direction
    g.write_ply(tmp_path / "mesh.ply", *mesh)
    head, body = (tmp_path / "mesh.ply").read_bytes().split(b"end_header\n", 1)
    assert b"element vertex %d\n" % len(x) in head and b"element face %d\n" % len(faces) in head
    f = np.frombuffer(body, [("n", "u1"), ("index", "<i4", 3)], offset=24 * len(x))
    close(np.frombuffer(body, "<f8", 3 * len(x)).reshape(-1, 3).copy(), vertices, rtol=1e-12)
    assert np.array_equal(f["index"], faces) and (f["n"] == 3).all()
    assert np.array_equal(faces, g.extract_mesh(warm, 64)[1])  # two a finest cell
    empty = copy.deepcopy(warm)
    for height in (1e-3, 0.4):  # near a surface everywhere, but on one side; far from it
        empty.distance = lambda x: 0 * x[:, 0] + height
        empty.cache.refresh(empty.distance)
        assert [len(part) for part in g.extract_mesh(empty, 16)] == [0, 0]
    for axis in range(3):  # a plane ends at the sphere, which does not close it
        empty.distance = lambda x: x[:, axis] - 0.01
        empty.cache.refresh(lambda x: x[:, axis] - 0.03)  # some steps ago
        x = (g.extract_mesh(empty, 40)[0] - scene.raw["center"]) / scene.raw["scale"]
        assert np.abs(x[:, axis] - 0.01).max() < 1e-3 and 0.9 < np.linalg.norm(x, axis=1).max() < 1 - (4 - 12 ** 0.5) / 40
        assert np.ptp(x[g.extract_mesh(empty, 40)[1]], axis=1).max() < 0.051  # no triangle beyond a cell


@pytest.mark.parametrize("count", [8, 1])
def test_a_film_goes_from_camera_to_camera_and_then_through_the_lights(warm, scene, tmp_path, monkeypatch, count):
    few = scene._replace(is_test=~torch.isin(torch.arange(10), photos := scene.photos(False)[:count]))
    monkeypatch.setattr(g, "render_photo", lambda model, moved, view, code: shots.append(
        (moved.c2w[view], code)) or nears.append((moved.near[view].item(), ((2 * moved.K[view, 2:] / moved.wh[view] - 1).abs() < 0.3).all().item()))
        or dict(rgb=np.zeros((*moved.wh[view].tolist()[::-1], 3)) + [1, 0, 0]))
    shots, nears, path = [], [], tmp_path / "a.mp4"
    g.film(warm, few, path)
    video = g.cv2.VideoCapture(str(path))
    (poses, codes), half = (torch.stack(part) for part in zip(*shots)), len(shots) // 2
    assert video.get(g.cv2.CAP_PROP_FRAME_COUNT) == len(shots) > 40
    assert list((frame := video.read()[1]).shape[1::-1]) in (scene.wh[photos] // 2 * 2).tolist()  # even, for the codec
    assert frame[..., 2].mean() > 200 > 100 > frame[..., 0].mean()  # red, in OpenCV's order
    close(poses[:, :, :3] @ poses[:, :, :3].mT, torch.eye(3).expand(len(shots), 3, 3), atol=1e-4)  # rotations
    assert all((scene.c2w[photos] - end).abs().amax((1, 2)).min() < 1e-2 for end in poses[[0, half - 1]])
    eyes, ends = scene.c2w[photos][:, :, 3], poses[[0, half - 1], :, 3]  # from one end to the other
    assert (ends[0] - ends[1]).norm() >= 0.9 * torch.cdist(eyes, eyes).max()
    assert (poses[half:] == poses[half]).all() and (codes[:half] == codes[0]).all()
    close(codes[[half, -1]], warm.codes()[photos[[0, -1]]], atol=1e-3)
    g.film(warm, few, path, rays=1e4)
    assert set(nears) == {(scene.near[photos].min().item(), True)}  # smaller, but the same view
    assert 0.5e4 < np.prod(g.cv2.VideoCapture(str(path)).read()[1].shape[:2]) * half * 2 <= 1e4
    monkeypatch.setattr(g.cv2, "VideoWriter", lambda tmp, *_: SimpleNamespace(isOpened=object, write=id, release=Path(tmp).touch))
    with pytest.raises(UserError, match="a.mp4"):  # a full disk, of which a writer says nothing
        g.film(warm, few, path)


# ---- 11 command line, documents ------------------------------------------------------------------------

FLAGS = [f"--{k}={v}" for k, v in (TINY | dict(levels=3)).items()]


@pytest.fixture
def command(tmp_path, monkeypatch, quick, capsys):
    """What a command line, in an empty folder and on the tiny toy, says where it fails: one line, code 2."""
    opened = data_prep.open_scene
    monkeypatch.setattr(data_prep, "open_scene", lambda name, *a: toy(photos=8) if name == "toy" else opened(name, *a))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.chdir(tmp_path)

    def command(*argv):
        try:
            return g.run_command_line(lambda: g.main(list(argv)))
        except SystemExit as end:
            error = capsys.readouterr().err
            assert end.code == 2 and error.startswith("error: ") and error.count("\n") == 1
            return error
    return command


def test_one_command_trains_scores_and_writes_everything_and_others_go_on_and_film(command, monkeypatch):
    monkeypatch.setenv("PATH", "")  # no git
    monkeypatch.setattr(g, "EnergyMeter", functools.partial(g.EnergyMeter, counter=itertools.count(0.0, 3600.0).__next__))
    assert command(*FLAGS, "--seed=3") is None
    run = Path("runs/toy-geonvsw-3")
    assert {p.name for p in run.iterdir()} == {"metrics.json", "log.jsonl", "checkpoint.pt", "panel.png", "mesh.ply"}
    metrics = json.loads((run / "metrics.json").read_text(), parse_constant=float.fromhex)  # strict: no NaN
    assert metrics.keys() >= set("""scene method device psnr_floor ssim lpips per_image energy_source torch sdf_error mask_iou
        mask_static""".split()) and "left half" in metrics["protocol"] and 1e8 < metrics["peak_memory_bytes"] < 1e12
    shared = dict(step="steps", seconds="train_seconds", dropped="dropped", energy_wh="energy_wh")
    assert {k: log_of(run, None)[-1][k] for k in shared} == {k: metrics[v] for k, v in shared.items()} and metrics["energy_wh"]
    own = config(levels=3, seed=3, mask="on")  # what auto came to
    assert metrics["config"] == asdict(own) and metrics["commit"] is None and metrics["psnr"] > 5
    assert metrics["rays_per_second"] == pytest.approx(6 * 64 / metrics["train_seconds"])
    beyond = metrics["model_bytes"] - 4 * metrics["parameters"] - 36 * (8 + sum(metrics["octree_cells"]))
    assert beyond > 36 * 16 ** 3 and beyond % 36 == 0  # nodes of the background's octree
    monkeypatch.setattr(g, "panel", lambda *_: np.full((9, 9, 3), (250, 120, 10), np.uint8))
    assert command("--resume", "--seed=3", "--steps=8") is None  # with the run's own settings
    assert cv2.imread(str(run / "panel.png"))[0, 0].tolist() == [10, 120, 250]  # blue first
    assert json.loads((run / "metrics.json").read_text())["config"] == asdict(replace(own, steps=8))
    assert command("--resume", "--seed=3", "--minutes=1e-9") is command("--resume", "--seed=3", "--steps=9") is None
    assert "--photos" in command("--resume", "--seed=3", "--rays=66") and "mb" in command("--grid=uniform", "--levels=6")
    monkeypatch.setattr(g, "film", lambda model, scene, path: torch.save(model.sdf.lin1.weight, path))
    assert command("--render", "--seed=3") is None and log_of(run)[-1]["step"] == 9
    assert torch.equal(torch.load(run / "film.mp4"), checkpoint(run)["model"]["sdf.lin1.weight"])


@pytest.mark.parametrize("flags, word", [
    ("--stepz=3", "--stepz"), ("--sam=3", "--sam"), ("--scene=brandenbrug", "brandenburg"), ("--scene=sacre", "sacre"),
    ("--data=nowhere", "nowhere"), ("--device=cuda", "cpu"), ("--device=meta", "meta"), ("--normals=none", "analytic"),
    ("--steps=many", "many"), ("--steps=0", "steps"), ("--lam_gpl=-1", "lam_gpl"), ("--lr_grid=nan", "lr_grid"),
    ("--lr_grid=inf", "lr_grid"), ("--samples=2", "samples"), ("--bg_samples=1", "bg"), ("--rays=1 --photos=1", "rays"),
    ("--rays=10 --photos=3", "photos"), ("--photos=0", "photos"), ("--hidden=0", "hidden"), ("--render", "render"),
    ("--resume --data=nowhere", "nowhere-"), ("--render --scene=sacre", "sacre-geonvsw"), ("--rays=2147483648", "rays"), ("--seed=" + "9" * 30, "seed"), ("--resume", "--resume"), ("--levels=9", "levels")])
def test_a_mistake_ends_with_code_2_and_one_line_that_helps_and_no_folder(command, flags, word):
    assert word in command(*FLAGS, *flags.split()) and not Path("runs").exists()


def test_problems_end_with_code_2_and_one_line_and_a_full_disk_leaves_whole_files(command, monkeypatch):
    monkeypatch.setattr(g, "finish", lambda *_: {})
    assert command(*FLAGS, "--rays=66", "--photos=6", "--name=a") is None
    before, limit = Path("runs/a/checkpoint.pt").read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limit[1]))  # a larger file cannot be written
    try:
        for flags in (["--resume", "--name=a", "--photos=6", "--steps=8"], [*FLAGS, "--name=b"]):
            assert "checkpoint.pt" in command(*flags)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert Path("runs/a/checkpoint.pt").read_bytes() == before and os.listdir("runs/b") == ["log.jsonl"]
    for problem, word in ((UserError("x"), "x"), (OSError(28, "No space left"), "space"),
                          (KeyboardInterrupt(), "--resume"), (torch.OutOfMemoryError("a\nb"), "--rays"), (RuntimeError("CPU: can't allocate memory"), "--rays")):
        monkeypatch.setattr(g, "execute", lambda *_: next((_ for _ in ()).throw(problem)))
        assert word in command(*FLAGS)
    with pytest.raises(NotImplementedError):  # a fault of ours, or of a driver, keeps its traceback
        g.run_command_line(lambda: next((_ for _ in ()).throw(NotImplementedError("CUDA error"))))
    asked, made = [], lambda *args: asked.append(args) or toy(photos=8)
    monkeypatch.setattr(g, "execute", lambda *_: None), monkeypatch.setattr(data_prep, "open_scene", made)
    assert command(*FLAGS, "--data=x", "--downscale=3") is None and asked == [(str(Path("x").resolve()), 3)]
    monkeypatch.setattr(g, "RANKS", 2)
    assert "torchrun" in command(*FLAGS)


def test_settings_come_from_defaults_then_the_scene_then_flags_and_devices_are_there(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)  # large settings are for a GPU
    assert g.make_config(dict(scene="sacre", rays=160)) == g.Config(scene="sacre", rays=160)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: g.LOCAL_RANK + 1), monkeypatch.setattr(g, "RANKS", 3)
    for own in (0, 1):
        monkeypatch.setattr(g, "LOCAL_RANK", own)
        assert [g.pick_device(name).index for name in ("auto", "cpu", "cuda", "cuda:0")] == [own, None, own, own]
    assert g.make_config(dict(data="x")) == g.Config(data="x", **g.LARGE) and g.make_config({}) == g.Config()
    assert g.make_config(dict(scene="taj", steps=9)) == g.Config(scene="taj", **g.LARGE | dict(steps=9))
    assert g.make_config(dict(data="x", device="cpu", rays=8)) == g.Config(data="x", device="cpu", rays=8)
    for refused, given, word in ((g.main, ["--rays=8", "--photos=8"], "processes"),
                                 (lambda rays: g.Config(rays=rays), 9, "--photos"), (g.pick_device, "cuda:2", "cuda:1")):
        with pytest.raises(UserError, match=word):
            refused(given)


def test_each_deviation_listed_is_tagged_and_each_setting_is_a_flag_and_used():
    code, listed = Path(g.__file__).read_text(), re.findall(r"^  \[(D\d+)\]", g.__doc__, re.M)
    tagged = set(re.findall(r"\[(D\d+)\]", code.replace(g.__doc__, "")))
    assert len(listed) == len(set(listed)) > 10 and set(listed) == tagged
    text, terms = " ".join(g.make_parser().format_help().split()), {f"lam_{name}" for name in g.GeoNVS.terms}
    for name in (f.name for f in fields(g.Config)):
        assert f"--{name} " in text and (name in terms | {"data", "scene"} or re.search(rf"\bcfg\.{name}\b", code)), name


# ---- Part II's rivals and experiments ------------------------------------------------------------------

def rival(scene, kind, **changes):
    torch.manual_seed(0)
    return kind(config(**dict(rays=256, photos=1 if kind is HaNeRF else 256, hidden=16, samples=6) | changes), scene)


def test_positional_encoding_equals_a_naive_loop():
    x = random(3, 2)
    want = [[*row, *[f(v * 2 ** k) for f in (math.sin, math.cos) for v in row for k in range(3)]] for row in x.tolist()]
    close(positional(x, 3), torch.tensor(want))


@pytest.mark.parametrize("name", ["NeRFW", "HaNeRF"])
def test_rivals_train_on_finite_losses_that_reach_every_part_and_render_weights_that_sum_to_one(scene, name):
    model, gen = rival(scene, globals()[name]), generator()
    for step in range(2):  # the second knows another photo's code
        rays, pick = model.batch(scene.photos(False), 256, gen)
        loss, terms = model.losses(rays, pick, step, gen)
        model.zero_grad()
        loss.backward()
    assert loss.isfinite() and all(v.isfinite().all() for v in terms.values())
    still = {n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()}
    assert not {n for n in still if "bias" not in n and "PReLU" not in n}
    out = model.trace(rays, model.codes()[rays.img], gen)
    close(out["w"].sum(1), torch.ones(256), atol=1e-4)
    assert (out["depth"] >= rays.near).all() and (out["depth"] <= model.far[rays.img] * 1.001).all()


def test_nerfw_mixes_static_and_transient_as_its_equation_says(scene):
    model = rival(scene, NeRFW)
    rays, _ = model.batch(scene.photos(False), 256, generator())
    rays = g.Rays(*(v[:3] for v in rays))
    t, code, other = torch.tensor([[1.0, 1.5, 1.7]] * 3), model.codes()[rays.img], model.transient(rays.img) + 1
    sigma, rgb, neck = (v.detach() for v in model.fine(rays.at(t), rays.d, code))
    h = model.head(torch.cat([neck, other[:, None].expand(-1, 3, -1)], 2)).detach()
    got = model.pass_through(model.fine, rays, t, code, other)
    for r in range(3):
        passes, color, beta = 1.0, torch.zeros(3), 0.03
        for s, dt in enumerate((0.5, 0.2, 100.0)):
            static, moving = (1 - math.exp(-v * dt) for v in (float(sigma[r, s]), float(F.softplus(h[r, s, 0]))))
            color = color + passes * (static * rgb[r, s] + moving * h[r, s, 1:4].sigmoid())
            beta = beta + passes * moving * float(F.softplus(h[r, s, 4]))
            passes *= (1 - static) * (1 - moving)
        close(got["rgb"][r], color, atol=1e-4)
        close(got["beta"][r], beta, atol=1e-4)


def test_hanerf_draws_a_row_major_window_of_one_photo_and_scores_with_more_samples(scene, monkeypatch):
    model, asked = rival(scene, HaNeRF), []
    rays, pick = model.batch(scene.photos(False), 256, generator())
    uv = rays.uv.reshape(16, 16, 2)
    assert len(pick) == 1 and (rays.img == pick).all()
    assert (uv[:, 1:, 0] >= uv[:, :-1, 0]).all() and (uv[1:, :, 1] >= uv[:-1, :, 1]).all()
    monkeypatch.setattr(model, "pass_through", lambda field, rays, t, code, other: asked.append(t.shape[1]) or dict(rgb=rays.rgb, w=torch.ones_like(t)))
    model.render(rays, model.codes()[rays.img])
    with torch.no_grad():
        model.render(rays, model.codes()[rays.img])
    assert asked == [6, 12, 24, 48]  # coarse and fine


@pytest.mark.parametrize("name", ["chart", "pieces", "grid", "stress"])
def test_every_experiment_runs_reads_finished_rows_again_and_writes_a_table_and_a_figure(name, tmp_path, monkeypatch):
    tiny, few = toy(), dict(rays=64, photos=4, samples=4, bg_samples=4, hidden=16)
    start = g.GeoNVS.start
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(g.GeoNVS, "start", lambda self, gen: start(self, gen, 3))
    monkeypatch.setattr(data_prep, "open_scene", lambda *a: tiny)
    monkeypatch.setattr(data_prep, "make_toy", lambda **knobs: tiny)
    monkeypatch.setattr(g, "fit_codes", functools.partial(g.fit_codes, steps=2, n=8))
    for key, value in dict(SMALL={g.GeoNVS: few, NeRFW: few | dict(photos=64), HaNeRF: few | dict(rays=256, photos=1)},
                           PIECES=dict(list(PIECES.items())[:2]), STRESS=dict(list(STRESS.items())[:1])).items():
        monkeypatch.setitem(globals(), key, value)
    argv = [name, "--steps", "4" if name == "chart" else "2", "--seeds", "1", *[x for k, v in few.items() for x in (f"--{k}", str(v))]]
    experiment(argv)
    table = Path(f"{name}.csv").read_text()
    assert len(table.splitlines()) == 1 + dict(chart=14, pieces=2, grid=2, stress=4)[name] and Path(f"{name}.png").exists()
    monkeypatch.setattr(g, "execute", None)  # nothing is trained again
    experiment(argv)
    assert Path(f"{name}.csv").read_text() == table
    for say, flag, run in (("resume", "--resume", None), ("first row", "--lam_eik=1", lambda *_, **__: data_prep.need(False, "x")),
                           ("cannot write", "--lam_eik=2", lambda *_, **__: data_prep.atomic_write(Path(f"{name}.csv/x"), bool))):
        monkeypatch.setattr(g, "execute", run)  # the last: a full disk is no result of a method
        with pytest.raises(UserError, match=say):
            experiment([*argv, flag])


def test_the_time_to_a_level_is_interpolated_between_whole_runs():
    rows = [dict(s=s, psnr=p) for s, p in ((10, 15.0), (20, 17.0), (40, 19.0), (80, None))]
    assert time_to(rows, 18, "s") == pytest.approx(20 * 2 ** 0.5) and time_to(rows, 14, "s") == 10 and time_to(rows, 20, "s") is None


# ==== Part II: the rivals, and the experiments by name ================================================
#     python test_geonvs.py chart    speed against accuracy: Geo-NVS-w, NeRF-W and Ha-NeRF by budget
#     python test_geonvs.py pieces   what each piece of the method buys
#     python test_geonvs.py grid     the octree against a uniform grid
#     python test_geonvs.py stress   where methods fail: cells of the toy with knobs turned together
# Flags of geonvs.py apply (--data, --scene, --minutes, --steps ...) unless a row sets them (SMALL, PUBLISHED ...),
# and --seeds, --published. A row is a whole run, scored as by geonvs.py, and read again. Writes NAME.csv, NAME.png.


def mlp(*sizes):
    """Linear layers with ReLU between them and after the last."""
    return nn.Sequential(*[m for a, b in zip(sizes, sizes[1:]) for m in (nn.Linear(a, b), nn.ReLU())])


def positional(x, octaves):
    """x (...,n) with sines and cosines of 2^k x: (...,n(1+2 octaves)) (NeRF Eq. 4, no pi)."""
    angle = (x[..., None] * 2.0 ** torch.arange(octaves, device=x.device)).flatten(-2)
    return torch.cat([x, angle.sin(), angle.cos()], -1)


class RadianceField(nn.Module):
    """NeRF's network: 8 layers with a skip to the fifth, density, then colour. W: width."""
    def __init__(self, width, code_dim):
        super().__init__()
        self.first, self.second = mlp(93, *[width] * 4), mlp(93 + width, *[width] * 4)
        self.density, self.bottleneck = nn.Linear(width, 1), nn.Linear(width, width)
        self.color = nn.Sequential(mlp(width + 27 + code_dim, width // 2), nn.Linear(width // 2, 3))

    def forward(self, x, d, code):
        """Density (R,S), colour (R,S,3), bottleneck (R,S,W) at x (R,S,3), d (R,3), code (R,A)."""
        pe = positional(x, 15)  # (R,S,93)
        h = self.second(torch.cat([pe, self.first(pe)], 2))  # (R,S,W)
        neck = self.bottleneck(h)  # (R,S,W)
        return F.softplus(self.density(h)[..., 0]), self.paint(neck, d, code), neck

    def paint(self, neck, d, code):
        """Colour (R,S,3) of samples with bottleneck (R,S,W), under an appearance code (R,A)."""
        per_ray = torch.cat([positional(d, 4), code], 1)[:, None].expand(-1, neck.shape[1], -1)
        return torch.sigmoid(self.color(torch.cat([neck, per_ray], 2)))


class NeRFW(nn.Module):
    """NeRF-W (Martin-Brualla et al. 2021): appearance codes, transient head with uncertainty. From the paper:
    two networks, 48 + 16 code dims, losses, lambda_u = 0.01; from its PyTorch version: width 256, 64 + 64
    samples, beta_min 0.03, Adam 5e-4, 1024 rays, SfM near and far. finer: samples in scoring over training."""
    name, code_dim, finer, octrees, adam = "nerfw", 48, 1, (), dict(betas=(0.9, 0.999), eps=1e-8)

    def __init__(self, cfg, scene):
        super().__init__()
        self.cfg, self.scene = cfg, scene
        self.coarse, self.fine = (RadianceField(cfg.hidden, self.code_dim) for _ in range(2))
        reach = (scene.points[::20] - scene.c2w[:, None, :, 3]).norm(dim=2)  # (I,K/20)
        self.register_buffer("far", reach.quantile(0.999, dim=1))  # (I,)
        self.make_heads(len(scene.wh))
        self.to(scene.c2w.device)

    def make_heads(self, photos):
        half = self.cfg.hidden // 2
        self.appearance, self.transient = nn.Embedding(photos, self.code_dim), nn.Embedding(photos, 16)
        self.head = nn.Sequential(mlp(self.cfg.hidden + 16, *[half] * 4), nn.Linear(half, 5))

    batch, codes = g.GeoNVS.batch, g.GeoNVS.codes
    groups = lambda self: [dict(params=list(self.parameters()), lr=self.cfg.lr_net)]
    start = plan = follow = lambda self, *_: None  # no warm-up, nothing to refine

    def render(self, rays, code):
        return {k: v for k, v in self.trace(rays, code).items() if k in ("rgb", "depth")}

    def trace(self, rays, code, gen=None, more=None):
        """Coarse and fine pass; gen: of the jitter, None for none. more: codes (R,16) of the transient head."""
        n = self.cfg.samples * (1 if torch.is_grad_enabled() else self.finer)
        middle = rays.o.new_full((len(rays.o), 2 * n), 0.5)
        jitter = middle if gen is None else torch.rand(middle.shape, generator=gen, device=gen.device)  # (R,2n)
        u = (torch.arange(n, device=code.device).repeat(2) + jitter) / n  # (R,2n) stratified twice
        edges = torch.lerp(rays.near[:, None], self.far[rays.img, None], torch.linspace(0, 1, n + 1, device=u.device))  # (R,n+1)
        t = g.inverse_cdf(edges, torch.ones_like(edges[:, 1:]), u[:, :n])  # (R,n)
        out = self.pass_through(self.coarse, rays, t, code, None)
        t = torch.cat([t, g.inverse_cdf(edges, out["w"].detach() + 1e-3, u[:, n:])], 1).sort(1)[0]  # (R,2n)
        return self.pass_through(self.fine, rays, t, code, more) | dict(coarse=out["rgb"])

    def pass_through(self, field, rays, t, code, transient):
        """Densities to a picture: C = sum T (alpha_s c_s + alpha_t c_t) (NeRF-W Eq. 5)."""
        sigma, rgb, neck = field(rays.at(t), rays.d, code)  # (R,S), (R,S,3), (R,S,W)
        dt = F.pad(torch.diff(t), (0, 1), value=100.0)  # (R,S), last opaque
        alpha = 1 - torch.exp(-sigma * dt)  # (R,S)
        if transient is None:
            w, _ = g.composite(alpha)  # (R,S)
            return dict(rgb=(w[..., None] * rgb).sum(1), depth=(w * t).sum(1), w=w, neck=neck)
        h = self.head(torch.cat([neck, transient[:, None].expand(-1, t.shape[1], -1)], 2))  # (R,S,5)
        sigma_t, beta = F.softplus(h[..., 0]), F.softplus(h[..., 4])  # (R,S)
        alpha_t, both = (1 - torch.exp(-s * dt) for s in (sigma_t, sigma + sigma_t))  # (R,S)
        w, _ = g.composite(both)  # (R,S)
        before = w / both.clamp(min=1e-10)  # (R,S) T
        mixed = alpha[..., None] * rgb + alpha_t[..., None] * torch.sigmoid(h[..., 1:4])  # (R,S,3)
        return dict(rgb=(before[..., None] * mixed).sum(1), depth=(w * t).sum(1), w=w, sigma_t=sigma_t.mean(1),
                    beta=(before * alpha_t * beta).sum(1) + 0.03, transient=(before * alpha_t).sum(1))

    def losses(self, rays, pick, step, gen):
        """NeRF-W Eq. 13: squared error over learned variance, its log, a price on transients."""
        out = self.trace(rays, self.codes()[rays.img], gen, self.transient(rays.img))
        error, coarse = (((out[k] - rays.rgb) ** 2).sum(1) for k in ("rgb", "coarse"))  # (R,)
        terms = dict(coarse=coarse.mean() / 2, rgb=(error / (2 * out["beta"] ** 2)).mean(),
                     beta=3 + torch.log(out["beta"]).mean(), sigma=0.01 * out["sigma_t"].mean())
        return sum(terms.values()), terms | dict(mask=out["transient"])


class HaNeRF(NeRFW):
    """Ha-NeRF (Chen et al. 2022): appearance from a CNN over the photo, mask by an MLP of pixels. From the
    authors' code: network sizes, 64 + 64 samples (256 + 256 in scoring), one 32x32 grid of rays per step, loss
    weights, Adam 5e-4. Left out: the mode-seeking term (weight 1e-6), noise on densities."""
    name, finer = "hanerf", 4

    def make_heads(self, photos):
        sizes = [(3, 64, 7, 1), (64, 128, 4, 2), *[(a, 256, 4, 2) for a in (128, 256, 256)]]
        convs = [m for a, b, k, s in sizes for m in (
            nn.Conv2d(a, b, k, s, (k - 1) // 2, padding_mode="reflect"), nn.ReLU())]
        self.encoder = nn.Sequential(*convs, nn.AdaptiveAvgPool2d(1), nn.Conv2d(256, self.code_dim, 1), nn.Flatten())
        self.register_buffer("bank", torch.zeros(photos, self.code_dim))  # last code of each photo
        self.mask_code = nn.Embedding(photos, 128)
        self.mask_mlp = nn.Sequential(mlp(128 + 42, *[256] * 4), nn.Linear(256, 1), nn.Sigmoid())

    @torch.no_grad()
    def codes(self):
        return torch.cat([self.encoder(part.float() / 127.5 - 1) for part in self.scene.thumbs.split(8)])

    def batch(self, photos, n, gen):
        """A square grid of rays over a random window of one photo."""
        pick = photos[torch.randint(len(photos), (1,), generator=gen, device=photos.device)]
        size = 0.5 + 0.5 * torch.rand(1, generator=gen, device=photos.device)
        corner = torch.rand(2, generator=gen, device=photos.device) * (1 - size)
        grid = torch.linspace(0, 1, math.isqrt(n), device=photos.device)
        uv = torch.cartesian_prod(grid, grid).flip(1) * size + corner  # (R,2)
        col, row = (uv * (self.scene.wh[pick] - 1)).round().long().T  # (R,)
        return g.make_rays(self.scene, pick.expand(len(uv)), row * self.scene.wh[pick, 0] + col), pick

    def losses(self, rays, pick, step, gen):
        """Ha-NeRF Eq. 9: masked colour, a falling price on masks, codes that survive a render: of the same
        rays in another photo's light."""
        R, side = len(rays.o), math.isqrt(len(rays.o))
        code = self.encoder(self.scene.thumbs[pick].float() / 127.5 - 1)  # (1,A)
        other = self.bank[torch.randint(len(self.bank), (1,), generator=gen, device=pick.device)]
        other = torch.where(other.any(), other, code.detach())  # (1,A) of another photo, once known
        self.bank[pick] = code.detach()
        out = self.trace(rays, code.expand(R, -1), gen, other.expand(R, -1))
        mask = self.mask_mlp(torch.cat([self.mask_code(rays.img), positional(rays.uv, 10)], 1))[:, 0]  # (R,)
        error, coarse = (((out[k] - rays.rgb) ** 2).mean(1) for k in ("rgb", "coarse"))  # (R,)
        again = self.encoder(out["other"].reshape(1, side, side, 3).permute(0, 3, 1, 2) * 2 - 1)  # (1,A)
        terms = dict(rgb=((1 - mask) * error).mean() / 2, coarse=((1 - mask.detach()) * coarse).mean() / 2,
                     size=max(6e-3, 5e-2 * math.exp(-1e-3 * step)) * (mask ** 2).mean(),
                     code=1e-5 * (code ** 2).mean(), again=1e-3 * (again - other).abs().mean())
        return sum(terms.values()), terms | dict(mask=mask)

    def pass_through(self, field, rays, t, code, other):
        """The static picture; with the codes (R,A) of another photo also its colours there."""
        out = super().pass_through(field, rays, t, code, None)
        neck, w = out.pop("neck").detach(), out["w"].detach()[..., None]  # only colours learn
        return out if other is None else out | dict(other=(w * field.paint(neck, rays.d, other)).sum(1))


PUBLISHED = {g.GeoNVS: {}, NeRFW: dict(rays=1024, photos=1024, samples=64, hidden=256, lr_net=5e-4),
             HaNeRF: dict(rays=1024, photos=1, samples=64, hidden=256, lr_net=5e-4)}
SMALL = {g.GeoNVS: dict(rays=256, lr_net=1e-2), NeRFW: dict(rays=256, photos=256, samples=24, hidden=64, lr_net=5e-3),
         HaNeRF: dict(rays=256, photos=1, samples=16, hidden=64, lr_net=4e-3)}  # what serves the toy best
PIECES = {"full": {}, "no GPL": dict(lam_gpl=0.0), "literal GPL": dict(gpl="literal"), "no mask": dict(mask="off"),
          "printed mask": dict(mask="printed", lam_mask=0.15), "no SfM term": dict(lam_sfm=0.0),
          "printed mask, no GPL": dict(mask="printed", lam_mask=0.15, lam_gpl=0.0), "no curvature": dict(lam_curv=0.0),
          "no appearance": dict(appearance="off"), "no background": dict(background="off"),
          "no Lipschitz": dict(lam_lps=0.0), "uniform sampling": dict(sampling="uniform"),
          "printed alpha": dict(alpha="printed"), "finite differences": dict(normals="fd")}
GRID = {"octree": {}, "uniform grid": dict(grid="uniform")}
STRESS = {  # knobs of the toy, and the piece that is made for them
    "easy": (dict(photos=48, occluders=0.04, exposure=0.5), "no mask"),
    "middle": (dict(photos=32, occluders=0.15, exposure=1.0, pose_noise=0.5), "no GPL"),
    "hard": (dict(photos=24, occluders=0.25, exposure=2.0, pose_noise=1.0), "no SfM term"),
    "crowd": (dict(photos=24, occluders=0.4), "no mask"), "lights": (dict(photos=24, exposure=2.0), "no appearance"),
    "few photos": (dict(photos=8), "no SfM term"), "wrong poses": (dict(photos=24, pose_noise=3.0), "no curvature"),
    "other building": (dict(photos=24, landmark=3), "no curvature")}
stress_toy = functools.lru_cache(1)(lambda **knobs: data_prep.make_toy(**knobs))  # the rows of a cell share it
FIGURES = ("psnr", "psnr_floor", "ssim", "sdf_error", "mask_iou", "mask_static", "steps", "train_seconds",
           "energy_wh", "rays_per_second", "model_bytes", "parameters")


def rows_of(name, given, published):
    """The rows of an experiment: settings by name, with `kind` of model and knobs of a `toy`."""
    kinds = PUBLISHED if published else SMALL
    if name == "chart":
        unit, whole = ("steps", given["steps"]) if "steps" in given else ("minutes", given.get("minutes", 1.0))
        early = {g.GeoNVS: (1 / 16, 1 / 8)}  # to see when it passes what the others end with
        return {f"{kind.name} x{share:g}": settings | {unit: type(whole)(share * whole) or 1, "kind": kind}
                for kind, settings in kinds.items() for share in (*early.get(kind, ()), 0.25, 0.5, 1, 2)}
    if name == "stress":
        budget = {} if {"steps", "minutes"} & set(given) else dict(minutes=1.5)
        return {f"{cell}: {how}": dict(toy=knobs, kind=kind) | budget | kinds[kind] | PIECES.get(how, {})
                for cell, (knobs, piece) in STRESS.items()
                for how, kind in (("full", g.GeoNVS), (piece, g.GeoNVS), ("nerfw", NeRFW), ("hanerf", HaNeRF))}
    return {"pieces": PIECES, "grid": GRID}[name]


def run_row(run, given, toy=None, kind=g.GeoNVS, **row):
    """Metrics of one training, read if it has been run before; one that diverged is a result, too."""
    cfg = g.make_config(given | row)
    arrays = stress_toy(**toy) if toy else data_prep.open_scene(cfg.source, cfg.downscale)
    data_prep.need(arrays["is_test"].any(), "experiments need held-out photos: give a split file, see README")
    key, done = json.loads(json.dumps(dict(config=asdict(cfg), toy=toy))), run / "row.json"
    metrics = json.loads(done.read_text()) if done.exists() else {}
    if {k: metrics.get(k) for k in key} != key:
        run.mkdir(parents=True, exist_ok=True)
        scene = g.load_scene(arrays, g.pick_device(cfg.device))
        with open(run / "log.txt", "w") as log, contextlib.redirect_stdout(log):
            try:
                metrics = g.execute(cfg, scene, run, kind=kind) | key
            except UserError as error:
                data_prep.need(not error.__cause__, error)  # a full disk: no result of the method
                metrics = dict(failed=str(error)) | key
        data_prep.atomic_write(done, lambda tmp: Path(tmp).write_text(json.dumps(metrics)))
    print(f"{run}: {metrics.get('failed') or '{psnr:.2f} dB, {train_seconds:.0f} s'.format(**metrics)}", flush=True)
    return metrics


def line_of(name, runs):
    """Mean and standard deviation over seeds, None if not measured. Failures: diverged or below the trivial predictor."""
    line = dict(row=name, runs=len(runs), failures=sum("failed" in m or m["psnr"] < m["psnr_floor"] for m in runs))
    for key in FIGURES:
        values = [m[key] for m in runs if m.get(key) is not None]
        line |= {key: float(np.mean(values)) if values else None,
                 key + "_std": float(np.std(values)) if len(values) > 1 else None}
    return line


def time_to(lines, level, unit):
    """Seconds or watt-hours at which whole runs reach a PSNR, log-interpolated between budgets, or None."""
    points = sorted((r[unit], r["psnr"]) for r in lines if r[unit] and r["psnr"])
    for (x0, y0), (x1, y1) in zip(points[:1] + points, points):
        if y1 >= level:
            return x1 if y1 <= y0 else x0 * (x1 / x0) ** max(0.0, (level - y0) / (y1 - y0))


def draw(name, table):
    """The figure of an experiment, from its table alone: PSNR over what it cost, or what each row gains over the
    first row, the best one last; in `stress` over the trivial predictor, coloured by method."""
    from matplotlib import figure as figures, ticker
    rows = sorted((r for r in table if r["psnr"]), key=lambda r: r["psnr"] if name in ("pieces", "grid") else 0)
    if name != "chart":
        gains = [r["psnr"] - (r["psnr_floor"] if name == "stress" else table[0]["psnr"]) for r in rows]
        axis = figures.Figure(figsize=(7.5, 1 + 0.25 * len(rows)), layout="constrained").subplots()
        names = [r["row"] + (f" ({r['failures']} of {r['runs']} failed)" if r["failures"] else "") for r in rows]
        at = [i + i // 4 * (name == "stress") / 2 for i in range(len(rows))]  # cells of four rows stand apart
        by_method = [dict(full="C0", nerfw="C1", hanerf="C2").get(r["row"].split(": ")[-1], "C9") for r in rows]
        colours = by_method if name == "stress" else ["C1" if gain < 0 else "C0" for gain in gains]
        axis.barh(at, gains, xerr=[r["psnr_std"] or math.nan for r in rows], capsize=3, tick_label=names, color=colours)
        base = "the trivial predictor" if name == "stress" else f"'{table[0]['row']}' ({table[0]['psnr']:.2f} dB)"
        axis.set(xlabel=f"PSNR above {base}, dB", ylim=(at[-1] + 1, -1)), axis.axvline(0, color="grey", lw=1)
        return axis.figure
    axes = [cost for cost in (("train_seconds", "training, s"), ("energy_wh", "energy, Wh")) if any(r[cost[0]] for r in rows)]
    figure = figures.Figure(figsize=(6.5 * len(axes), 4), layout="constrained")
    for axis, (unit, text) in zip(figure.subplots(1, len(axes), squeeze=False)[0], axes):
        for kind in dict.fromkeys(r["row"].split(" x")[0] for r in rows):
            mine = [(r[unit], r["psnr"], r["psnr_std"] or math.nan) for r in rows if r["row"].startswith(kind) and r[unit]]
            axis.errorbar(*zip(*mine), marker="o", capsize=3, label=kind)
        axis.axhline(np.mean([r["psnr_floor"] for r in rows]), color="grey", label="trivial predictor")
        axis.set(xscale="log", xlabel=text, ylabel="PSNR of held-out right halves, dB")
        axis.xaxis.set(major_locator=ticker.LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}", minor_formatter="")
        axis.legend()
    return figure


def experiment(argv):
    """Runs every row of an experiment, writes its table and its figure."""
    data_prep.need(importlib.util.find_spec("matplotlib"), "charts need matplotlib: pip install matplotlib")
    parser = g.make_parser()
    parser.add_argument("experiment", choices=("chart", "pieces", "grid", "stress"))
    parser.add_argument("--seeds", type=int, default=3, help="seeds of every row [3]")
    parser.add_argument("--published", action="store_true", default=False, help="rivals at published size")
    given = vars(parser.parse_args(argv))
    name, seeds, published = (given.pop(k) for k in ("experiment", "seeds", "published"))
    data_prep.need(seeds > 0 and not {"resume", "render"} & set(given), "--seeds from 1, no --render, no --resume: it is by itself")
    cfg = g.make_config(given)
    where = Path("runs") / f"{name}-{data_prep.scene_path(cfg.source).stem}"
    begin, table = time.perf_counter(), []
    for row, settings in rows_of(name, given, published).items():
        table.append(line_of(row, [run_row(where / f"{row}-{seed}".replace(" ", "_").replace(":", ""),
                                           given | dict(seed=seed), **settings) for seed in range(seeds)]))
    data_prep.need(table[0]["psnr"], f"the first row of {name} has failed; {where} has a log.txt of each run")
    if name == "chart":  # time and energy to each rival's best run, over what that took
        for rival, unit in itertools.product(("nerfw", "hanerf"), ("train_seconds", "energy_wh")):
            best = max((r for r in table if r["row"].startswith(rival) and r["psnr"]), key=lambda r: r["psnr"], default=None)
            for r in table if best else ():
                hit = time_to([q for q in table if q["row"].split()[0] == r["row"].split()[0]], best["psnr"], unit)
                r[f"{unit}_to_{rival}"], r[f"{unit}_ratio_{rival}"] = hit, hit and hit / best[unit]
    lines = [list(table[0]), *[[f"{v:.5g}" if isinstance(v, float) else v for v in r.values()] for r in table]]
    text = "\n".join(",".join("" if v is None else f'"{v}"' if "," in str(v) else str(v) for v in r) for r in lines)
    data_prep.atomic_write(Path(f"{name}.csv"), lambda tmp: Path(tmp).write_text(text + "\n"))
    figure, trained = draw(name, table), sum(r["train_seconds"] * r["runs"] for r in table if r["train_seconds"])
    figure.suptitle(f"{cfg.data or cfg.scene}, seeds: {seeds}, {trained / 60:.0f} minutes of training in all", fontsize=9)
    data_prep.atomic_write(Path(f"{name}.png"), lambda tmp: figure.savefig(tmp, dpi=110))
    print(f"wrote {name}.csv and {name}.png after {time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    g.run_command_line(lambda: experiment(sys.argv[1:]))
