"""Tests of data_prep.py, then of geonvs.py in the order of the file.

They come from properties: naive loops in float64, closed forms, limits, invariances, round trips; nothing
needs data, network or a GPU, nothing is skipped, and no timing decides.
"""
import ast
import contextlib
import copy
import dataclasses
import functools
import http.server
import io
import itertools
import json
import math
import os
import pickle
import re
import shutil
import signal
import struct
import subprocess
import sys
import tarfile
import threading
import time
import tracemalloc
import types
import zipfile
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import HealthCheck, given, settings, strategies as st
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

import data_prep
import geonvs as g
from data_prep import UserError

# ---- data_prep.py ----------------------------------------------------------------------------------


TINY_TOY = dict(size=32, photos=6, test=2)


@functools.cache
def toy(**knobs):
    return data_prep.make_toy(**{**TINY_TOY, **knobs})


def photo(scene, i, key="rgb"):
    w, h = scene["wh"][i]
    return scene[key][scene["start"][i]:scene["start"][i + 1]].reshape(h, w, *scene[key].shape[1:])


def world(scene, x):
    return x * scene["scale"] + scene["center"]


def same(a, b, *keys):
    return all(np.array_equal(a[k], b[k], equal_nan=np.asarray(a[k]).dtype.kind == "f") for k in keys or a)


# ---- toy -------------------------------------------------------------------------------------------

def test_toy_repeats_by_seed_and_differs_between_seeds():
    again = data_prep.make_toy(**TINY_TOY)
    assert same(toy(), again) and set(toy()) == set(again)
    assert not np.array_equal(toy()["c2w"], toy(seed=1)["c2w"])


def pixels_beyond(scene):
    """Directions (P,3), origins (P,3) and colours (P,3) of all training rays that miss the unit sphere."""
    for i in np.flatnonzero(~scene["is_test"]):
        (w, h), c2w, (fx, fy, cx, cy) = scene["wh"][i], scene["c2w"][i], scene["K"][i]
        for p, rgb in enumerate(scene["rgb"][scene["start"][i]:scene["start"][i + 1]]):
            d = c2w[:, :3] @ [(p % w + .5 - cx) / fx, (p // w + .5 - cy) / fy, 1]
            t = -(c2w[:, 3] @ d) / (d @ d)
            if t < 0 or np.linalg.norm(c2w[:, 3] + t * d) > 1:
                yield rgb / 255


@pytest.mark.parametrize("knobs", [{}, dict(background=False), dict(background=False, occluders=.2)])
def test_background_is_one_colour_exactly_when_most_rays_beyond_the_sphere_agree(knobs):
    scene = toy(**knobs)
    seen = np.array(list(pixels_beyond(scene)))
    agree = (np.abs(seen - np.median(seen, 0)) < .02).all(1).mean()
    assert np.isfinite(scene["bg_color"]).all() == (agree > .6 and len(seen) > 100)
    assert np.isnan(scene["bg_color"]).all() or (scene["bg_color"] == np.median(seen, 0)).all()


def test_exposure_spread_is_what_was_added_to_whole_photos():
    s = toy(exposure=0.0, occluders=0.0)
    assert s["exposure_spread"] < 0.01
    rgb, offset = s["rgb"].astype(float) * 0.5 + 64, np.random.default_rng(0).uniform(-40, 40, len(s["wh"]))
    for i, (a, b) in enumerate(zip(s["start"], s["start"][1:])):
        rgb[a:b] += offset[i]
    found = data_prep.statistics(dict(s, rgb=rgb.round().astype(np.uint8)))["exposure_spread"]
    assert 0.5 < found / (offset[~s["is_test"]] / 255).std() < 1.5


def test_footprint_halves_with_twice_the_focal_length():
    s = toy()
    K = s["K"] * [2, 2, 1, 1]
    np.testing.assert_allclose(data_prep.statistics(dict(s, K=K))["footprint"], s["footprint"] / 2)


def test_scene_dictionary_keeps_its_contract(tmp_path):
    s = toy()
    data_prep.write_scene(tmp_path / "toy.npz", s)
    with np.load(tmp_path / "toy.npz", allow_pickle=False) as f:
        back = {k: f[k] for k in f}
    assert same(s, back)
    n, i, k, t = s["start"][-1], 8, len(s["points"]), len(s["track_photo"])
    want = dict(rgb=("uint8", (n, 3)), start=("int64", (i + 1,)), wh=("int32", (i, 2)), K=("float64", (i, 4)),
                c2w=("float64", (i, 3, 4)), near=("float32", (i,)), is_test=("bool", (i,)),
                points=("float32", (k, 3)), track_photo=("int32", (t,)), track_point=("int32", (t,)),
                center=("float64", (3,)), scale=("float64", ()), depth=("float16", (n,)), occluder=("bool", (n,)))
    assert {key: (str(back[key].dtype), back[key].shape) for key in want} == want
    assert back["name"].dtype.kind == "U" and len(set(back["name"])) == i
    assert set(back) == set(want) | {"name", "info", "footprint", "exposure_spread", "bg_color"}
    info = json.loads(str(back["info"]))
    assert info["kind"] == "toy" and info["downscale"] == 1 and info["left_out"] == [] and info["size"] == 32
    assert np.array_equal(np.diff(s["start"]), s["wh"].prod(1)) and s["is_test"].sum() == 2
    assert (s["near"] > 0).all() and s["track_photo"].max() < i and s["track_point"].max() < k
    r = s["c2w"][:, :, :3]
    np.testing.assert_allclose(r @ r.transpose(0, 2, 1), np.tile(np.eye(3), (i, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(r), 1)
    assert s["wh"].max() == 32 and len(set(map(tuple, s["wh"].tolist()))) > 1


@pytest.mark.parametrize("background", [True, False])
def test_depth_is_where_the_distance_function_vanishes(background):
    s = toy(background=background)
    for i in range(8):
        w, h = s["wh"][i]
        t = photo(s, i, "depth").ravel().astype(float)
        hit = np.isfinite(t) & (t < 8)
        x = s["c2w"][i, :, 3] + t[hit, None] * data_prep.rays(s["K"][i], s["c2w"][i], w, h)[hit]
        assert hit.any() and np.abs(data_prep.toy_sdf(world(s, x), background)).max() < 8 * 2 ** -10 * s["scale"]
        assert data_prep.toy_sdf(world(s, s["c2w"][i, :, 3])[None], background) > 0.05


def random_rays(count=400, seed=3):
    rng = np.random.default_rng(seed)
    o = rng.normal(size=(count, 3)) * 2.2 + [0, 0, 1]
    o[:, 2] = np.abs(o[:, 2]) + .05
    o = o[data_prep.toy_sdf(o * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN) > .05]
    d = rng.normal([0, 0, .7], .6, o.shape) - o
    return o, d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("ground", [True, False])
def test_tracer_agrees_with_sphere_tracing_by_the_distance_function(ground):
    o, d = random_rays()
    t, which = data_prep.trace(o, d, ground)
    sdf = lambda x: data_prep.toy_sdf(x * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN, ground) / data_prep.TOY_SCALE
    march = np.zeros(len(o))
    for _ in range(250):
        march += np.where(march < 40, sdf(o + march[:, None] * d), 0)
    hit = t < 20
    assert np.abs(sdf(o + np.where(hit, t, 0)[:, None] * d)[hit]).max() < 1e-9
    assert (march[hit] <= t[hit] + 1e-6).all()   # never behind the traced hit
    assert (np.abs(march - t)[hit] < 1e-3).mean() > .97   # a grazing ray marches slowly
    assert (march[t == np.inf] > 15).mean() > .97
    assert len(set(which[hit])) > 12


def test_sdf_is_positive_outside_and_grows_no_faster_than_distance():
    rng = np.random.default_rng(0)
    a = rng.uniform([-9, -3, 0], [9, 9, 3], (4000, 3)) * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN
    b = a + rng.normal(0, .4, a.shape)
    for ground in (True, False):
        gap = np.abs(data_prep.toy_sdf(a, ground) - data_prep.toy_sdf(b, ground)) / np.linalg.norm(a - b, axis=1)
        assert gap.max() < 1 + 1e-9 and gap.max() > .9
    below = np.array([[0, 0, -1.0]]) * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN
    assert data_prep.toy_sdf(below) < 0 < data_prep.toy_sdf(below, ground=False)
    inside = np.array([[.03, .2, .5]]) * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN   # of the hall
    assert data_prep.toy_sdf(inside) < 0


def test_part_distance_agrees_with_dense_surface_samples():
    rng = np.random.default_rng(1)
    x = rng.uniform(-1, 1, (300, 3))
    for part in (np.array([1, .1, .2, .3, .3, .4, .4, .2, 0]), np.array([1, 0, 0, 0, .2, .5, 0, .3, 0]),
                 np.array([2, .1, 0, 0, .4, .3, .1, np.inf, 0]), np.array([3, 0, .1, 0, .5, .5, .5, np.inf, 0])):
        surface = rng.uniform(-.9, .9, (400_000, 3))
        sdf = data_prep.part_sdf(part, surface)
        surface = surface[np.abs(sdf) < .004]
        brute = np.array([np.sqrt(((surface - p) ** 2).sum(1).min()) for p in x])
        out = data_prep.part_sdf(part, x)
        assert np.abs(np.abs(out) - brute)[out > 0].max() < .05


@pytest.mark.parametrize("knobs", [{}, dict(seed=2), dict(background=False), dict(occluders=.3)])
def test_unit_sphere_holds_the_landmark_and_little_else(knobs):
    s = toy(**knobs)
    x = np.random.default_rng(0).uniform([-1.2, -.8, 0], [1.2, .8, 2], (200_000, 3)) * data_prep.TOY_SCALE + data_prep.TOY_ORIGIN
    inside = x[data_prep.toy_sdf(x, ground=False) < 0]
    reach = np.linalg.norm((inside - s["center"]) / s["scale"], axis=1)
    assert .75 < reach.max() < 1
    assert (np.linalg.norm(s["points"], axis=1) < 1).mean() > .8


def test_no_exposure_and_no_people_means_the_same_picture_of_the_same_thing():
    plain = toy(exposure=0.0, occluders=0.0)
    assert not plain["occluder"].any()
    for other in (toy(exposure=0.0, occluders=.3), toy(exposure=0.0)):
        assert same(plain, other, "K", "c2w", "depth") or not same(plain, other, "scale")
        free = ~other["occluder"]
        assert np.array_equal(plain["rgb"][free], other["rgb"][free]) and free.mean() < 1
    varied = toy(exposure=1.0, occluders=0.0)
    ratio = [photo(varied, i).mean() / photo(plain, i).mean() for i in range(8)]
    assert np.std(ratio) > .03
    wilder = [photo(toy(exposure=2.0, occluders=0.0), i).mean() / photo(plain, i).mean() for i in range(8)]
    assert np.std(wilder) > 1.3 * np.std(ratio)


def test_same_point_has_the_same_colour_in_two_photos_without_exposure():
    s = toy(exposure=0.0, occluders=0.0, size=64, background=True)
    colour = np.full((len(s["wh"]), len(s["points"]), 3), np.nan)
    for i in range(8):
        own = s["track_point"][s["track_photo"] == i]
        uv, _ = data_prep.project(s["K"][i], s["c2w"][i], s["points"][own].astype(float))
        w, h = s["wh"][i]
        ok = ((uv > 0) & (uv < (w, h))).all(1)
        u, v = uv[ok].astype(int).T
        colour[i, own[ok]] = photo(s, i)[v, u]
    pairs = np.isfinite(colour[:, :, 0]).sum(0) >= 2
    within = np.nanstd(colour[:, pairs], axis=0).mean()
    assert within < .5 * np.nanstd(colour)


@pytest.mark.parametrize("share", [.05, .2, .5])
def test_people_cover_the_asked_share_of_training_photos_only(share):
    s = data_prep.make_toy(size=64 if share < .1 else 32, photos=24, test=3, occluders=share)
    train = np.repeat(~s["is_test"], np.diff(s["start"]))
    assert not s["occluder"][~train].any()
    assert .75 * share < s["occluder"][train].mean() < 1.35 * share
    each = [photo(s, i, "occluder").mean() for i in np.flatnonzero(~s["is_test"])]
    assert max(each) > 1.3 * share and min(each) < .7 * share


def test_pose_noise_moves_training_photos_by_that_many_pixels_and_no_test_photo():
    knobs = dict(size=24, photos=40, test=3, occluders=0.0)
    clean, noisy = data_prep.make_toy(**knobs), data_prep.make_toy(**knobs, pose_noise=2.0)
    assert same(clean, noisy, "rgb", "K", "points", "scale")
    x = np.zeros((1, 3)) - clean["center"] / clean["scale"] + (data_prep.TOY_ORIGIN + [0, 0, 2.5]) / clean["scale"]
    shift = np.array([data_prep.project(k, a, x)[0][0] - data_prep.project(k, b, x)[0][0]
                      for k, a, b in zip(clean["K"], clean["c2w"], noisy["c2w"])])
    assert not shift[clean["is_test"]].any()
    assert 1.5 < np.sqrt((shift[~clean["is_test"]] ** 2).sum(1).mean()) < 2.6
    error = [json.loads(str(s["info"]))["reprojection_px"] for s in (clean, noisy)]
    assert error[0] < .3 and error[1] > 1


def test_points_lie_on_surfaces_but_for_noise_and_a_few_wild_ones():
    s = data_prep.make_toy(size=48, photos=12, test=2)
    miss = np.abs(data_prep.toy_sdf(world(s, s["points"].astype(float)))) / s["scale"]
    assert .001 < np.median(miss) < .006 and .0005 < (miss > .03).mean() < .05
    assert len(s["points"]) > 1000 and np.bincount(s["track_point"]).min() >= 2
    hidden = 0
    for i in range(14):
        own = s["points"][s["track_point"][s["track_photo"] == i]].astype(float)
        uv, distance = data_prep.project(s["K"][i], s["c2w"][i], own)
        u, v = np.clip(uv.astype(int), 0, s["wh"][i] - 1).T
        hidden += (photo(s, i, "depth")[v, u] < .8 * distance).sum()
        assert (distance > s["near"][i]).mean() > .95
    assert hidden < .06 * len(s["track_photo"])   # wild points, and the noise at outlines


def test_nothing_but_the_landmark_without_background():
    s = toy(background=False, occluders=0.0, exposure=2.0)
    sky = np.isinf(s["depth"])
    edge = 0
    for i in range(8):   # supersampling mixes the colours at outlines: look one pixel away from them
        far = cv2.erode(np.isinf(photo(s, i, "depth")).astype(np.uint8), np.ones((3, 3)))
        edge += far.sum()
        assert not photo(s, i)[far > 0].any()
    assert edge > .2 * sky.sum() and sky.mean() > .3


@pytest.mark.parametrize("bad", [dict(occluders=.7), dict(exposure=-1), dict(size=4), dict(photos=1),
                                 dict(pose_noise=-1), dict(seed=-1), dict(test=-1)])
def test_toy_refuses_senseless_knobs(bad):
    with pytest.raises(UserError, match="toy needs"):
        data_prep.make_toy(**{**TINY_TOY, **bad})


def test_toy_without_test_photos():
    assert not data_prep.make_toy(**{**TINY_TOY, "test": 0})["is_test"].any()


# ---- COLMAP ------------------------------------------------------------------------------------------

def write_colmap(folder, cameras, images, points):
    """Independent writer. cameras {id: (model, w, h, params)}, images [(id, q, t, camera id, name, obs)],
    points [(id, xyz, error, track)]."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "cameras.bin", "wb") as f:
        f.write(struct.pack("<Q", len(cameras)))
        for key, (model, w, h, p) in cameras.items():
            f.write(struct.pack("<iiQQ", key, model, w, h) + struct.pack(f"<{len(p)}d", *p))
    with open(folder / "images.bin", "wb") as f:
        f.write(struct.pack("<Q", len(images)))
        for key, q, t, camera, name, obs in images:
            f.write(struct.pack("<I4d3dI", key, *q, *t, camera) + name.encode() + b"\0")
            f.write(struct.pack("<Q", len(obs)) + b"".join(struct.pack("<ddQ", *o) for o in obs))
    with open(folder / "points3D.bin", "wb") as f:
        f.write(struct.pack("<Q", len(points)))
        for key, x, error, track in points:
            f.write(struct.pack("<Q3d3BdQ", key, *x, 1, 2, 3, error, len(track)))
            f.write(b"".join(struct.pack("<II", *o) for o in track))


def quaternion(r):
    w = np.sqrt(max(0, 1 + np.trace(r))) / 2
    if w > 1e-3:
        return np.array([w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w))])
    x = cv2.Rodrigues(r)[0].ravel()
    angle = np.linalg.norm(x)
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * x / angle)])


def as_colmap(folder, scene, model=1, sub="dense", table=True, name=lambda n: n, distort=None):
    """The toy written as if COLMAP had posed its photos."""
    cameras, images, tracks = {}, [], {}
    x = world(scene, scene["points"].astype(float))
    for i, n in enumerate(scene["name"]):
        w, h = map(int, scene["wh"][i])
        fx, fy, cx, cy = scene["K"][i]
        k = distort or ()
        cameras[3 * i + 7] = (model, w, h, (fx, fy, cx, cy, *k) if model in (1, 4) else (fx, cx, cy, *k))
        r = scene["c2w"][i, :, :3].T
        centre = world(scene, scene["c2w"][i, :, 3])
        own = scene["track_point"][scene["track_photo"] == i]
        p = (x[own] - centre) @ r.T
        uv = p[:, :2] / p[:, 2:] * (fx, fy) + (cx, cy)
        obs = []
        for j, (point, at) in enumerate(zip(own, uv)):
            obs.append((*at, 5 * int(point) + 2 ** 40))
            tracks.setdefault(int(point), []).append((i + 50, j))
        obs.append((1.0, 1.0, 2 ** 64 - 1))
        images.append((i + 50, 2.5 * quaternion(r), -r @ centre, 3 * i + 7, name(str(n)), obs))
        path = folder / sub / "images" / name(str(n))
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), photo(scene, i)[..., ::-1])
    points = [(5 * k + 2 ** 40, x[k], .5, track) for k, track in tracks.items()]
    write_colmap(folder / sub / "sparse", cameras, images[::-1], points)
    if table:
        rows = [f"{j}.0\t{'test' if scene['is_test'][j] else 'train'}\t{name(str(n))}\ttoy"
                for j, n in enumerate(scene["name"])]
        (folder / "toy.tsv").write_text("\n".join(["id\tsplit\tfilename\tdataset", *rows]) + "\n")
    return cameras, images, points


@pytest.fixture(scope="module")
def source():
    return data_prep.make_toy(size=40, photos=8, test=2)


@pytest.fixture
def folder(tmp_path, source):
    as_colmap(tmp_path / "place", source)
    return tmp_path / "place"


def test_colmap_model_comes_back(tmp_path):
    rng = np.random.default_rng(0)
    q, t = rng.normal(size=(3, 4)) * 3, rng.normal(size=(3, 3))
    names = ["b c/photo 1.jpg", "a.png", "Ünïcode.jpg"]
    cameras = {9: (0, 30, 20, (25., 15., 10.)), 2 ** 31 - 1: (4, 31, 21, (25., 26., 15., 10., .1, .2, .3, .4)),
               4: (3, 9, 8, (5., 4., 3., .01, .02)), 5: (2, 9, 8, (5., 4., 3., .01))}
    images = [(100 + 7 * i, q[i], t[i], (9, 2 ** 31 - 1, 9)[i], names[i],
               [(1.5 + i, 2.5, 2 ** 63 + 5), (3., 4., 2 ** 64 - 1), (5., 6., 17)]) for i in range(3)]
    points = [(2 ** 63 + 5, (1., 2., 3.), .7, [(100, 0), (107, 0)]), (17, (4., 5., 6.), .1, [])]
    write_colmap(tmp_path, cameras, images, points)
    got, photos, p = data_prep.read_colmap(tmp_path)
    ids, xyz, error, views = p["id"], p["xyz"], p["error"], p["views"]
    assert [tuple(map(float, got[9][2])), got[9][0], got[9][1]] == [(25, 25, 15, 10), 30, 20]
    assert list(got[2 ** 31 - 1][2]) == [25, 26, 15, 10] and list(got[2 ** 31 - 1][3]) == [.1, .2, .3, .4]
    assert list(got[4][3]) == [.01, .02, 0, 0] and list(got[5][3]) == [.01, 0, 0, 0]
    assert list(photos) == names and [photos[n][0] for n in names] == [9, 2 ** 31 - 1, 9]
    assert list(ids) == [2 ** 63 + 5, 17] and views.tolist() == [2, 0] and error.tolist() == [.7, .1]
    np.testing.assert_array_equal(xyz, [[1, 2, 3], [4, 5, 6]])
    for i, n in enumerate(names):
        _, c2w, uv, seen = photos[n]
        w, *v = q[i] / np.linalg.norm(q[i])
        p = rng.normal(size=3)
        turned = p + 2 * w * np.cross(v, p) + 2 * np.cross(v, np.cross(v, p))   # q p q*, by vectors
        np.testing.assert_allclose(c2w[:, :3] @ (turned + t[i]) + c2w[:, 3], p, atol=1e-12)
        assert seen.tolist() == [2 ** 63 + 5, 17] and uv.tolist() == [[1.5 + i, 2.5], [5., 6.]]


@pytest.mark.parametrize("sub", ["dense", ".", "dense/0"])
def test_toy_survives_the_way_through_colmap_files(tmp_path, source, sub):
    as_colmap(tmp_path, source, sub=sub)
    s = data_prep.prepare(tmp_path, downscale=1)
    assert json.loads(str(s["info"]))["reprojection_px"] < .01
    assert same(s, source, "rgb", "is_test", "name", "wh", "start")
    np.testing.assert_allclose(s["K"], source["K"])
    np.testing.assert_allclose(s["c2w"][:, :, :3], source["c2w"][:, :, :3], atol=1e-9)
    np.testing.assert_allclose(world(s, s["c2w"][:, :, 3]), world(source, source["c2w"][:, :, 3]), atol=1e-9)
    assert len(s["points"]) > .9 * len(source["points"])
    uv, _ = data_prep.project(s["K"][0], s["c2w"][0], s["points"][s["track_point"][s["track_photo"] == 0]].astype(float))
    assert ((uv > -1) & (uv < s["wh"][0] + 1)).all(1).mean() > .95
    (tmp_path / sub / "sparse" / "0").mkdir()
    for f in (tmp_path / sub / "sparse").glob("*.bin"):
        f.rename(f.parent / "0" / f.name)
    assert same(data_prep.prepare(tmp_path, downscale=1), s)


def test_shared_cameras_are_found_through_the_camera_id(tmp_path, source):
    cameras, images, points = as_colmap(tmp_path, source)
    images = [(cam_id, *rest) for (_, *rest), cam_id in zip(images, np.roll([i[0] for i in images], 3))]
    write_colmap(tmp_path / "dense" / "sparse", cameras, images, points)   # image ids mean nothing
    np.testing.assert_allclose(data_prep.prepare(tmp_path, 1)["K"], source["K"])


def test_downscaled_intrinsics_are_exact_for_odd_sizes(tmp_path, source):
    as_colmap(tmp_path, source)
    s = data_prep.prepare(tmp_path, downscale=3)
    assert (source["wh"] % 3).any()
    np.testing.assert_array_equal(s["wh"], source["wh"] // 3)
    ratio = s["wh"] / source["wh"]
    np.testing.assert_allclose(s["K"], source["K"] * np.tile(ratio, 2))
    np.testing.assert_allclose(s["K"][:, 2:] * 2, s["wh"])   # the middle stays the middle
    assert json.loads(str(s["info"]))["reprojection_px"] < .01


def test_a_wrong_convention_shows_in_the_reprojection_error(tmp_path, source):
    cameras, images, points = as_colmap(tmp_path, source)
    flipped = [(k, q * [1, -1, -1, -1], *rest) for k, q, *rest in images]   # camera to world, mistaken
    write_colmap(tmp_path / "dense" / "sparse", cameras, flipped, points)
    assert json.loads(str(data_prep.prepare(tmp_path, 1)["info"]))["reprojection_px"] > 5


@pytest.mark.parametrize("model, k", [(2, (-.15,)), (3, (-.15, .05)), (4, (-.12, .03, .01, -.01))])
def test_distorted_photos_are_undistorted(tmp_path, model, k):
    source = data_prep.make_toy(size=96, photos=4, test=0, occluders=0.0)
    cameras, images, points = as_colmap(tmp_path, source, model=model, distort=k, table=False)
    bend = np.append(k, np.zeros(4))[:4]
    for i, (key, q, t, camera, name, obs) in enumerate(images):
        fx, fy, cx, cy = source["K"][i]

        def distorted(x, y):   # COLMAP's formula, by hand
            r2, (k1, k2, p1, p2) = x * x + y * y, bend
            radial = 1 + k1 * r2 + k2 * r2 * r2
            return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                    y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y))
        uv = np.array([o[:2] for o in obs])
        x, y = distorted((uv[:, 0] - cx) / fx, (uv[:, 1] - cy) / fy)
        obs[:] = [(a * fx + cx, b * fy + cy, o[2]) for a, b, o in zip(x, y, obs)]
        w, h = source["wh"][i]
        v, u = np.mgrid[:h, :w] + .5
        x0, y0 = (u - cx) / fx, (v - cy) / fy
        x, y = x0.copy(), y0.copy()
        for _ in range(50):   # where the straight photo shows what the bent one has at (u, v)
            dx, dy = distorted(x, y)
            x, y = x + x0 - dx, y + y0 - dy
        bent = cv2.remap(photo(source, i), (x * fx + cx - .5).astype(np.float32),
                         (y * fy + cy - .5).astype(np.float32), cv2.INTER_LINEAR)
        cv2.imwrite(str(tmp_path / "dense" / "images" / name), bent[..., ::-1])
    write_colmap(tmp_path / "dense" / "sparse", cameras, images, points)
    s = data_prep.prepare(tmp_path, 1)
    assert json.loads(str(s["info"]))["reprojection_px"] < .01
    for i in range(4):
        a, b = photo(s, i).astype(float), photo(source, i).astype(float)
        middle = tuple(slice(n // 6, -n // 6) for n in a.shape[:2])
        error = lambda image: np.abs(image - b)[middle].mean()
        shifted = min(error(np.roll(a, 1, axis)) for axis in (0, 1))
        assert error(a) < .6 * shifted


def test_foreground_sphere_ignores_wild_points_and_prefers_what_many_see():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2000, 3))
    x *= (rng.random((2000, 1)) ** (1 / 3)) / np.linalg.norm(x, axis=1, keepdims=True)   # a unit ball
    far = rng.normal([40, 0, 0], 3, (300, 3))
    xyz, views = np.concatenate([x, far]), np.repeat([20, 3], [2000, 300])
    photos, point = np.zeros(2000, int), np.arange(2000)

    def sphere(xyz, views, is_train=np.ones(1, bool)):
        table = np.zeros(len(xyz), data_prep.POINT)
        table["xyz"], table["views"] = xyz, views
        return data_prep.foreground_sphere(table, photos, point, is_train)
    centre, radius, usable = sphere(xyz, views)
    assert np.linalg.norm(centre) < .05 and .95 < radius < 1.15 and usable.all()
    moved = sphere(xyz * 3 + [5, 6, 7], views)
    np.testing.assert_allclose(moved[0], centre * 3 + [5, 6, 7], atol=1e-6)
    np.testing.assert_allclose(moved[1], 3 * radius, rtol=1e-6)
    xyz[5], views[6] = np.inf, 2
    assert not sphere(xyz, views)[2][[5, 6]].any()
    equal = sphere(xyz, np.full(2300, 20))
    assert equal[1] > 20   # without weights the far points would count
    xyz, views = np.concatenate([x, far]), np.repeat([20, 3], [2000, 300])
    photos = np.repeat([0, 1, 2], [100, 150, 150])   # two of three look elsewhere: they must see it too
    point = np.concatenate([np.arange(100), 2000 + np.arange(150), 2150 + np.arange(150)])
    assert sphere(xyz, views, np.ones(3, bool))[1] > 30
    assert sphere(xyz, views, np.array([True, False, False]))[1] < 1.2   # test photos have no say


# ---- splits, photos, and what can be wrong with them -------------------------------------------------

def test_split_is_read_by_column_name(tmp_path):
    want = {"a b.jpg": "test", "sub/c.jpg": "train"}
    for text in ("filename\tid\tsplit\tdataset\na b.jpg\t1.0\ttest\tx\nsub/c.jpg\t2.0\ttrain\tx\nno.jpg\t\ttrain\tx\n",
                 "\ufefffilename\tid\tsplit\na b.jpg\t1\ttest\nsub/c.jpg\t2\ttrain\nno.jpg\t\ttrain\n",
                 "\ufeffid\tfilename\tsplit\n1\ta b.jpg\ttest\n2\tsub/c.jpg\ttrain\n\tno.jpg\ttrain\n",
                 "id\tsplit\tfilename\tdataset\r\n1\ttest\ta b.jpg\tx\r\n2\ttrain\tsub/c.jpg\tx\r\n",
                 "\tsplit\tnima\tfilename\n0\ttest\t5.1\ta b.jpg\n1\ttrain\t4\tsub/c.jpg\n"):
        (tmp_path / "s.tsv").write_bytes(text.encode())
        assert data_prep.read_split(tmp_path / "s.tsv") == want


@pytest.mark.parametrize("text, says", [
    ("", "header"), ("filename\tid\n", "header"), ("a,b\n", "header"),
    ("filename\tsplit\n../x.jpg\ttrain\n", "outside"), ("filename\tsplit\n/etc/x.jpg\ttrain\n", "outside"),
    ("filename\tsplit\n\ttrain\n", "outside"), ("filename\tsplit\nx.jpg\tvalid\n", "train or test"),
    ("filename\tsplit\nx.jpg\n", "train or test"), ("filename\tsplit\nx\ttrain\nx\ttest\n", "not both")])
def test_bad_splits_are_named(tmp_path, text, says):
    (tmp_path / "s.tsv").write_text(text)
    with pytest.raises(UserError, match=says) as e:
        data_prep.read_split(tmp_path / "s.tsv")
    assert "s.tsv" in str(e.value)


def run_main(*argv):
    """Exit code, stdout, stderr of the command line."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            data_prep.main(list(map(str, argv)))
        except SystemExit as e:
            code = e.code
    return code, out.getvalue(), err.getvalue()


def test_every_eighth_photo_is_held_out_without_a_split(folder, capsys):
    (folder / "toy.tsv").unlink()
    s = data_prep.prepare(folder)
    assert np.flatnonzero(s["is_test"]).tolist() == [7] and list(s["name"]) == sorted(s["name"])
    assert "every eighth" in capsys.readouterr().err


def test_photos_left_out_are_reported(folder, capsys):
    rows = (folder / "toy.tsv").read_text().splitlines()
    (folder / "toy.tsv").write_text("\n".join(rows[:-1] + ["9\ttrain\tghost.jpg\ttoy"]))
    (folder / "dense" / "images" / "toy_000.png").unlink()
    s = data_prep.prepare(folder)
    said, info = capsys.readouterr().err, json.loads(str(s["info"]))
    assert len(s["name"]) == 8 and not {"toy_000.png", "toy_009.png"} & set(s["name"])
    assert len(info["left_out"]) == 3 and all(line in said for line in info["left_out"])
    assert "toy_000.png" in said and "toy_009.png" in said and "ghost.jpg" in said
    assert s["track_photo"].max() == 7


def test_split_without_test_rows_is_fine_and_said(folder, capsys):
    table = folder / "toy.tsv"
    table.write_text(table.read_text().replace("\ttest\t", "\ttrain\t"))
    assert not data_prep.prepare(folder)["is_test"].any() and "null" in capsys.readouterr().err


def test_grey_cmyk_and_rotated_photos(folder):
    from PIL import Image
    images = folder / "dense" / "images"
    for i, mode in enumerate(("L", "CMYK", "P", "RGBA")):
        path = images / f"toy_{i:03d}.png"
        image = Image.open(path).convert("RGB").convert(mode)
        image.save(path, "TIFF" if mode == "CMYK" else "PNG")
    exif = Image.Exif()
    exif[274] = 6   # turned by 90 degrees, which must be ignored
    Image.open(images / "toy_004.png").save(images / "toy_004.png", "JPEG", exif=exif, quality=98)
    assert len(data_prep.prepare(folder)["name"]) == 10


def test_cmyk_jpeg_keeps_its_colours(folder):
    from PIL import Image
    path = folder / "dense" / "images" / "toy_000.png"
    before = photo(data_prep.prepare(folder, 1), 0).astype(float)
    Image.open(path).convert("CMYK").save(path, "JPEG", quality=95)
    assert np.abs(photo(data_prep.prepare(folder, 1), 0) - before).mean() < 12


def damage_file(folder, source, what):
    """Breaks one thing in a good folder."""
    cameras, images, points = as_colmap(folder, source)
    sparse, first = folder / "dense" / "sparse", folder / "dense" / "images" / "toy_000.png"
    image = dict((i[4], list(i)) for i in images)
    if what == "fisheye":
        cameras[7] = (5, *cameras[7][1:3], (30.,) * 8)
    if what == "unknown model":
        cameras[7] = (77, *cameras[7][1:])
    if what == "nan pose":
        image["toy_000.png"][1] = np.full(4, np.nan)
    if what == "zero quaternion":
        image["toy_000.png"][1] = np.zeros(4)
    if what == "infinite position":
        image["toy_000.png"][2] = np.full(3, np.inf)
    if what == "negative focal":
        cameras[7] = (1, *cameras[7][1:3], (-30., 30., 20., 15.))
    if what == "no such camera":
        image["toy_000.png"][3] = 12345
    if what == "twice the same":
        image["toy_001.png"][4] = "toy_000.png"
    if what == "escaping name":
        image["toy_000.png"][4] = "../toy_000.png"
    write_colmap(sparse, cameras, list(image.values()), [] if what == "no points" else points)
    if what == "points at one place":
        write_colmap(sparse, cameras, list(image.values()), [(k, (1., 2., 3.), e, t) for k, _, e, t in points])
    if what == "points at infinity":
        write_colmap(sparse, cameras, list(image.values()), [(k, (np.inf,) * 3, e, t) for k, _, e, t in points])
    if what == "size":
        cv2.imwrite(str(first), np.zeros((7, 9, 3), np.uint8))
    if what == "not a photo":
        first.write_text("no photo")
    if what == "empty photo":
        first.write_bytes(b"")
    if what == "missing file":
        (sparse / "images.bin").unlink()
    if what == "empty file":
        (sparse / "points3D.bin").write_bytes(b"")
    if what == "two splits":
        (folder / "other.tsv").write_text((folder / "toy.tsv").read_text())
    if what == "no train":
        (folder / "toy.tsv").write_text((folder / "toy.tsv").read_text().replace("\ttrain\t", "\ttest\t"))
    if what == "no images":
        (folder / "dense" / "images").rename(folder / "dense" / "elsewhere")


CASES = {"fisheye": "image_undistorter", "unknown model": "image_undistorter", "nan pose": "toy_000.png",
         "zero quaternion": "toy_000.png", "infinite position": "toy_000.png", "negative focal": "camera 7",
         "no such camera": "toy_000.png", "twice the same": "toy_000.png", "escaping name": "outside",
         "no points": "overlapping", "points at one place": "coincide", "points at infinity": "overlapping",
         "size": "toy_000.png",
         "not a photo": "toy_000.png", "empty photo": "toy_000.png", "missing file": "images.bin",
         "empty file": "points3D.bin", "two splits": "--split", "no train": "split file", "no images": "--sfm"}


@pytest.mark.parametrize("what", CASES)
def test_bad_input_gives_one_line_and_exit_code_2(tmp_path, source, what):
    damage_file(tmp_path / "place", source, what)
    with np.errstate(all="raise"):
        code, out, err = run_main(tmp_path / "place", "--out", tmp_path / "x.npz")
    assert code == 2 and out == "" and err.count("\n") == 1 and err.startswith("error: ")
    assert CASES[what] in err and not (tmp_path / "x.npz").exists()


def test_hidden_files_beside_the_split_are_not_read(folder):
    (folder / "._toy.tsv").write_bytes(b"what a Mac leaves on other disks")
    assert data_prep.prepare(folder)["is_test"].sum() == 2


def test_points_that_only_test_photos_observe_make_no_scene(tmp_path, source):
    cameras, images, points = as_colmap(tmp_path, source)
    for i, image in enumerate(images):
        image[5][:] = image[5] if source["is_test"][i] else image[5][-1:]
    write_colmap(tmp_path / "dense" / "sparse", cameras, images, points)
    with pytest.raises(UserError, match="no training photo observes"):
        data_prep.prepare(tmp_path)


@pytest.mark.parametrize("bend", [(.2, 0, 0, 0), (-.15, .02, 0, 0), (.1, 0, .01, -.01)])
def test_an_undistorted_photo_shows_nothing_but_photo_where_its_camera_says(tmp_path, bend):
    """A photo whose grey is linear in the direction; a frame of other grey would be trained on."""
    w, h, K = 90, 60, np.array([70.0, 72, 44, 31])
    grey = lambda x, y: 110 + 60 * x + 40 * y
    v, u = np.mgrid[:h, :w] + .5
    x0, y0 = (u - K[2]) / K[0], (v - K[3]) / K[1]
    x, y, (k1, k2, p1, p2) = x0.copy(), y0.copy(), bend
    for _ in range(200):
        r2 = x * x + y * y
        x += .5 * (x0 - x * (1 + k1 * r2 + k2 * r2 * r2) - 2 * p1 * x * y - p2 * (r2 + 2 * x * x))
        y += .5 * (y0 - y * (1 + k1 * r2 + k2 * r2 * r2) - 2 * p2 * x * y - p1 * (r2 + 2 * y * y))
    cv2.imwrite(str(tmp_path / "a.png"), grey(x, y).round().astype(np.uint8))
    rgb, K, _ = data_prep.read_photo(tmp_path / "a.png", (w, h, K, np.array(bend)), np.zeros((0, 2)), 1)
    want = grey((u - K[2]) / K[0], (v - K[3]) / K[1])
    assert np.abs(rgb[..., 0] - want).max() < 3


def test_very_narrow_and_very_wide_photos_are_left_out(tmp_path, source):
    cameras, images, points = as_colmap(tmp_path, source)
    for key, f in ((7, 1000.), (10, 3.)):
        cameras[key] = (1, *cameras[key][1:3], (f, f, *cameras[key][3][2:]))
    write_colmap(tmp_path / "dense" / "sparse", cameras, images, points)
    s = data_prep.prepare(tmp_path)
    assert list(s["name"]) == list(source["name"][2:]) and "toy_000.png, toy_001.png" in str(s["info"])


# ---- random damage_file -----------------------------------------------------------------------------------

QUICK = settings(max_examples=60, deadline=2000, derandomize=True,
                 suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    points = [(i, (float(i), 1., 2.), .5, [(1, 0), (2, 0)]) for i in range(3)]
    obs = [(1., 2., i) for i in range(3)]
    write_colmap(folder, {1: (1, 8, 6, (9., 9., 4., 3.)), 2: (2, 8, 6, (9., 4., 3., .1))},
                 [(1, (1., 0, 0, 0), (0., 0, 0), 1, "a b.jpg", obs), (2, (1., .1, 0, 0), (1., 0, 0), 2, "c.jpg", obs)],
                 points)
    return folder, {f.name: f.read_bytes() for f in folder.glob("*.bin")}


def survives(model, name, data):
    folder, good = model
    (folder / name).write_bytes(data)
    try:
        data_prep.read_colmap(folder)
        return True
    except UserError as e:
        assert "\n" not in str(e)
        return False
    finally:
        (folder / name).write_bytes(good[name])


@contextlib.contextmanager
def peak_below(size):
    """Python and numpy take less than `size` bytes at any moment."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < size
    finally:
        tracemalloc.stop()


BINS = ["cameras.bin", "images.bin", "points3D.bin"]


@pytest.mark.parametrize("name", BINS)
def test_truncation_anywhere_is_noticed(model, name):
    data = model[1][name]
    assert survives(model, name, data)
    assert not any(survives(model, name, data[:n]) for n in range(len(data)))


@pytest.mark.parametrize("name", BINS)
@QUICK
@given(data=st.data())
def test_random_and_flipped_bytes_do_no_harm(model, name, data):
    good = bytearray(model[1][name])
    for at in data.draw(st.lists(st.integers(0, 8 * len(good) - 1), max_size=4)):
        good[at // 8] ^= 1 << at % 8
    survives(model, name, bytes(good))
    survives(model, name, data.draw(st.binary(max_size=200)))
    small = struct.pack("<Q", data.draw(st.integers(0, 3)))
    survives(model, name, small + data.draw(st.binary(max_size=200)))


@pytest.mark.parametrize("name", BINS)
@pytest.mark.parametrize("count", [4, 1000, 2 ** 31, 2 ** 40, 2 ** 63, 2 ** 64 - 1])
def test_promised_counts_are_checked_before_memory_is_taken(model, name, count):
    data = model[1][name]
    with peak_below(2 ** 20):
        assert not survives(model, name, struct.pack("<Q", count) + data[8:])
    at = {"images.bin": data.find(b"a b.jpg\0") + 8, "points3D.bin": 8 + 43}.get(name)   # of the first record
    if at:
        with peak_below(2 ** 20):
            assert not survives(model, name, data[:at] + struct.pack("<Q", count) + data[at + 8:])


@QUICK
@given(text=st.one_of(st.binary(max_size=200), st.text(max_size=200).map(lambda s: s.encode("utf-8", "ignore"))))
def test_random_tables_do_no_harm(tmp_path, text):
    for head in (b"", b"filename\tid\tsplit\n"):
        (tmp_path / "s.tsv").write_bytes(head + text)
        try:
            split = data_prep.read_split(tmp_path / "s.tsv")
        except UserError:
            continue
        assert set(split.values()) <= {"train", "test"} and not any(".." in n.split("/") for n in split)


TABLE = (b"filename\tid\tsplit\tdataset\na b.jpg\t1\ttest\tx\nsub/c.jpg\t2.0\ttrain\tx\n"
         b"d.png\t\ttrain\tx\n")


@QUICK
@given(end=st.integers(0, len(TABLE)),
       flips=st.lists(st.integers(0, 8 * len(TABLE) - 1), max_size=4))
def test_damaged_tables_do_no_harm(tmp_path, end, flips):
    data = bytearray(TABLE)
    for at in flips:
        data[at // 8] ^= 1 << at % 8
    (tmp_path / "s.tsv").write_bytes(data[:end])
    try:
        split = data_prep.read_split(tmp_path / "s.tsv")
    except UserError as e:
        assert "\n" not in str(e)
    else:
        assert set(split.values()) <= {"train", "test"} and len(split) <= 3


# ---- hostile scene files -------------------------------------------------------------------------

HOSTILE = settings(max_examples=40, deadline=None, derandomize=True,
                   suppress_health_check=[HealthCheck.function_scoped_fixture])


def zipped(scene, save=np.savez):
    file = io.BytesIO()
    save(file, **scene)
    return file.getvalue()


@pytest.fixture(scope="module")
def stored():
    return zipped(data_prep.make_toy(size=16, photos=4, test=1))


def readable(path, data):
    """Is it a scene, then a usable one? If not, one sentence says so."""
    path.write_bytes(data)
    try:
        scene = data_prep.read_scene(path)
    except UserError as e:
        assert "\n" not in str(e) and path.name in str(e)
        return False
    assert len(g.load_scene(scene, "cpu", 16).wh) == 5
    return True


@HOSTILE
@given(data=st.data())
def test_damaged_scene_files_do_no_harm(tmp_path, stored, data):
    """Bits flipped anywhere, in the directory at the end, in an array's header; cut off; noise."""
    path, good = tmp_path / "s.npz", bytearray(stored)
    header = good.find(b"NUMPY")
    parts = [(0, len(good)), (good.find(b"PK\1\2"), len(good)), (header, header + 120)]
    low, high = data.draw(st.sampled_from(parts))
    for at in data.draw(st.lists(st.integers(8 * low, 8 * high - 1), min_size=1, max_size=4)):
        good[at // 8] ^= 1 << at % 8
    readable(path, bytes(good))
    assert not readable(path, stored[:data.draw(st.integers(0, len(stored) - 23))])
    assert not readable(path, data.draw(st.binary(max_size=200)))


JUNK = [np.array(0), np.zeros((5, 0)), np.zeros((2, 3, 4)), np.array("x"), np.array(["a", "b"]),
        np.full(5, np.nan), np.full(5, -1), np.zeros(5, bool), np.array(2 + 3j), np.zeros(5, "V4"),
        np.zeros(5, "M8[s]"), np.array([2 ** 63], np.uint64), np.array("[1]"), np.array("{}")]


@HOSTILE
@given(data=st.data())
def test_scene_files_with_a_wrong_array_are_refused(tmp_path, stored, data):
    with np.load(io.BytesIO(stored)) as file:
        scene = dict(file)
    key = data.draw(st.sampled_from(sorted(set(scene) - {"depth", "occluder"})))  # the toy's own
    junk = scene | {key: data.draw(st.sampled_from(JUNK))}
    assert not readable(tmp_path / "s.npz", zipped(junk))
    index = data.draw(st.sampled_from(["start", "wh", "track_photo", "track_point"]))
    assert not readable(tmp_path / "s.npz", zipped(scene | {index: scene[index] + 10 ** 6}))
    del scene[key]
    assert not readable(tmp_path / "s.npz", zipped(scene))


@pytest.mark.parametrize("count", [10 ** 5, 2 ** 31, 2 ** 40, 2 ** 62, 2 ** 80])
def test_promised_shapes_are_checked_before_memory_is_taken(tmp_path, stored, count):
    with np.load(io.BytesIO(stored)) as file:
        scene = dict(file)
    with zipfile.ZipFile(tmp_path / "s.npz", "w") as file:
        for key, value in scene.items():
            array = io.BytesIO()
            shape = (count, 3) if key == "rgb" else value.shape
            np.lib.format.write_array_header_1_0(
                array, dict(descr=value.dtype.str, fortran_order=False, shape=shape))
            file.writestr(f"{key}.npy", array.getvalue() + value.tobytes())
    with peak_below(2 ** 21):
        assert not readable(tmp_path / "s.npz", (tmp_path / "s.npz").read_bytes())


def test_a_scene_file_larger_inside_than_outside_is_refused_unread(tmp_path, stored):
    with np.load(io.BytesIO(stored)) as file:
        bomb = zipped(dict(file) | dict(rgb=np.zeros((2 ** 24, 3), np.uint8)), np.savez_compressed)
    assert len(bomb) < 2 ** 20
    with peak_below(2 ** 22):
        assert not readable(tmp_path / "s.npz", bomb)


class Evil:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_scene_file_never_runs_code(tmp_path, stored):
    with np.load(io.BytesIO(stored)) as file:
        scene = dict(file)
    scene["name"] = np.array([Evil(tmp_path / "harm")] * 5, object)
    assert not readable(tmp_path / "s.npz", zipped(scene))
    assert not readable(tmp_path / "s.npz", pickle.dumps(Evil(tmp_path / "harm")))
    assert not (tmp_path / "harm").exists()
    pickle.loads(pickle.dumps(Evil(tmp_path / "harm")))  # it is live
    assert (tmp_path / "harm").exists()


# ---- writing, download, command line -----------------------------------------------------------------

@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt(), ValueError("x")])
def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "sub" / "scene.npz"
    data_prep.atomic_write(path, lambda part: part.write_text("old"))

    def write(part):
        assert part.suffix == ".npz" and part.parent == path.parent
        part.write_text("half")
        raise error
    with pytest.raises(UserError if isinstance(error, OSError) else type(error)) as e:
        data_prep.atomic_write(path, write)
    assert path.read_text() == "old" and [p.name for p in path.parent.iterdir()] == ["scene.npz"]
    if isinstance(error, OSError):
        assert "scene.npz" in str(e.value) and "No space" in str(e.value)
    with pytest.raises(UserError):
        data_prep.atomic_write(path, lambda part: False)
    with pytest.raises(UserError):
        data_prep.atomic_write(path / "below a file.png", lambda part: part.write_text("x"))


class Server(http.server.BaseHTTPRequestHandler):
    """Ranges, or not; breaks off after `limit` bytes of an answer."""
    files, ranges, limit, asked = {}, True, None, []

    def do_GET(self):
        cls, data = type(self), type(self).files.get(self.path)
        start = int(self.headers.get("Range", "bytes=0-")[6:-1]) if cls.ranges else 0
        cls.asked.append((self.path, self.headers.get("Range")))
        if data is None:
            return self.send_error(404)
        if start >= len(data) > 0 and start:
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(data)}")
            return self.end_headers()
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(data) - start))
        self.end_headers()
        self.wfile.write(data[start:][:cls.limit])

    def log_message(self, *_):
        pass


def archive(members):
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as tar:
        for name, content in members:
            info = tarfile.TarInfo(name)
            if isinstance(content, str):
                info.type, info.linkname = tarfile.SYMTYPE, content
                tar.addfile(info)
            else:
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
    return out.getvalue()


PLACE = "brandenburg_gate/dense/"
GOOD = [(PLACE + "images/a.jpg", np.random.default_rng(0).bytes(50_000)), (PLACE + "sparse/cameras.bin", b"x"),
        (PLACE + "stereo/big.bin", b"y"), ("brandenburg_gate/other.txt", b"z")]


@pytest.fixture
def server(tmp_path):
    handler = type("Handler", (Server,), dict(asked=[]))
    handler.files = {"/t/brandenburg_gate.tar.gz": archive(GOOD), "/s/brandenburg.tsv": b"filename\tsplit\n"}
    web = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=web.serve_forever, args=(.02,), daemon=True).start()
    base = f"http://127.0.0.1:{web.server_port}"
    handler.get = lambda: data_prep.download("brandenburg", tmp_path / "data", base + "/t/", base + "/s/")
    yield handler
    web.shutdown()
    web.server_close()


def unpacked(tmp_path):
    root = tmp_path / "data" / "brandenburg"
    return sorted(str(p.relative_to(root)) for p in root.rglob("*") if p.is_file())


def test_download_unpacks_photos_model_and_split_only(server, tmp_path):
    server.get()
    assert unpacked(tmp_path) == ["brandenburg.tsv", "dense/images/a.jpg", "dense/sparse/cameras.bin"]
    assert (tmp_path / "data/brandenburg/dense/images/a.jpg").read_bytes() == GOOD[0][1]
    assert not [p for p in (tmp_path / "data").iterdir() if p.name.startswith(".") or p.suffix == ".part"]
    asked = len(server.asked)
    server.get()
    assert len(server.asked) == asked   # nothing is fetched twice


@pytest.mark.parametrize("ranges", [True, False])
def test_broken_download_goes_on_where_it_stopped(server, tmp_path, ranges):
    server.limit, server.ranges = 20_000, ranges
    with pytest.raises(UserError, match="same command"):
        server.get()
    part = tmp_path / "data" / "brandenburg_gate.tar.gz.part"
    assert part.stat().st_size == 20_000 and not (tmp_path / "data" / "brandenburg").exists()
    server.limit = None
    server.get()
    assert ("/t/brandenburg_gate.tar.gz", "bytes=20000-") in server.asked and not part.exists()
    assert (tmp_path / "data/brandenburg_gate.tar.gz").read_bytes() == server.files["/t/brandenburg_gate.tar.gz"]
    assert len(unpacked(tmp_path)) == 3


def test_a_part_longer_than_the_file_is_started_over(server, tmp_path):
    part = tmp_path / "data" / "brandenburg_gate.tar.gz.part"
    part.parent.mkdir()
    part.write_bytes(b"?" * 200_000)
    with pytest.raises(UserError):
        server.get()
    server.get()
    assert len(unpacked(tmp_path)) == 3


def test_a_whole_part_is_not_fetched_again(server, tmp_path):
    part = tmp_path / "data" / "brandenburg_gate.tar.gz.part"
    part.parent.mkdir()
    part.write_bytes(server.files["/t/brandenburg_gate.tar.gz"])
    server.get()
    assert len(unpacked(tmp_path)) == 3 and not part.exists() and len(server.asked) == 2


def test_a_folder_in_the_way_of_an_archive_is_named(server, tmp_path):
    (tmp_path / "data" / "brandenburg").mkdir(parents=True)
    with pytest.raises(UserError, match="in the way"):
        server.get()
    assert not server.asked


def test_missing_file_and_dead_server_are_said(server, tmp_path):
    server.files = {}
    with pytest.raises(UserError, match="404"):
        server.get()
    with pytest.raises(UserError, match="127.0.0.1"):
        data_prep.download("brandenburg", tmp_path / "d", "http://127.0.0.1:9/", "http://127.0.0.1:9/")
    with pytest.raises(UserError, match="--download knows"):
        data_prep.download("nowhere", tmp_path / "d")


@pytest.mark.parametrize("evil", [
    (PLACE + "images/../../../../evil.txt", b"x"), ("/evil.txt", b"x"), ("../evil.txt", b"x"),
    (PLACE + "images/link", "/etc"), (PLACE + "images/link", "a.jpg"), (PLACE + "images/link", "../../../.."), ("brandenburg_gate/dense/images", "/tmp")])
def test_archives_cannot_write_outside(server, tmp_path, evil):
    server.files["/t/brandenburg_gate.tar.gz"] = archive(
        [*GOOD, evil] + [(PLACE + "images/link/evil.txt", b"x")] * (evil[1] != "a.jpg"))
    try:
        server.get()
    except UserError as e:
        assert "unpack" in str(e)
    assert not [p for p in tmp_path.rglob("*") if p.is_symlink()]
    inside = tmp_path / "data" / "brandenburg"
    assert all(inside in p.parents for p in tmp_path.rglob("evil.txt"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["data"]


@pytest.mark.parametrize("damage_file", [lambda b: b[:30_000], lambda b: b"no archive", lambda b: b[:9000] + b"?" * 99 + b[9099:]])
def test_damaged_archives_are_named_and_leave_nothing(server, tmp_path, damage_file):
    server.files["/t/brandenburg_gate.tar.gz"] = damage_file(server.files["/t/brandenburg_gate.tar.gz"])
    with pytest.raises(UserError, match="brandenburg_gate.tar.gz"):
        server.get()
    assert sorted(p.name for p in (tmp_path / "data").iterdir()) == ["brandenburg.tsv", "brandenburg_gate.tar.gz"]


def test_locate_and_prepare_finds_the_archive_or_names_the_command(tmp_path, source):
    with pytest.raises(UserError, match="python data_prep.py sacre --download"):
        data_prep.locate_and_prepare("sacre", tmp_path)
    (tmp_path / "sacre").mkdir()
    for folder in ("sacre_coeur", "sacre"):   # unpacked by hand, or by --download
        as_colmap(tmp_path / folder, source)
        s = data_prep.locate_and_prepare("sacre", tmp_path, downscale=2)
        assert np.array_equal(s["wh"], source["wh"] // 2) and folder in str(s["info"])


def test_command_line_makes_a_toy_and_reads_a_folder(tmp_path, source, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run_main("toy", "--size", 32, "--photos", 6, "--test", 2, "--no-background", "--occluders", .2)
    assert code == 0 and "8 photos, 2 of them" in out and "reprojection" in out
    with np.load("data/toy.npz") as s:
        assert same(dict(s), toy(occluders=.2, background=False))
    as_colmap(tmp_path / "place", source)
    code, out, err = run_main("place", "--downscale", 4)
    assert code == 0 and data_prep.scene_path(tmp_path / "place", True).exists() and err == ""


@pytest.mark.parametrize("argv", [["toy", "--sizee", "9"], ["toy", "--siz", "9"], ["toy", "--size", "x"], [],
                                  ["nowhere"], ["brandenburg"], ["nowhere", "--download"], ["place", "--size", "9"],
                                  ["toy", "--occluders", "2"], ["place", "--downscale", "0"],
                                  ["toy", "--pose_noise", "nan"], ["toy", "--pose_noise", "inf"],
                                  ["toy", "--out", "mine"], ["toy", "--out", "."], ["toy", "--downscale", "4"],
                                  ["toy", "--split", "x.tsv"]])
def test_misspelt_commands_exit_with_2(tmp_path, monkeypatch, argv):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "place").mkdir()
    code, out, err = run_main(*argv)
    assert code == 2 and out == "" and "error: " in err and "Traceback" not in err
    assert [p.name for p in tmp_path.rglob("*")] == ["place"]


def test_a_toy_beyond_memory_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(data_prep, "trace", lambda *_: np.empty((2 ** 24, 2 ** 24)))
    code, _, err = run_main("toy", "--photos", 4, "--test", 0)
    assert code == 2 and err.count("\n") == 1 and "allocate" in err


def test_sfm_says_what_to_install_and_calls_pycolmap_in_order(tmp_path, monkeypatch, source):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert "pip install pycolmap" in run_main(tmp_path, "--sfm")[2]
    calls = []
    fake = types.SimpleNamespace(
        extract_features=lambda database, photos: calls.append("extract"),
        match_exhaustive=lambda database: calls.append("match"),
        incremental_mapping=lambda database, photos, out: {0: types.SimpleNamespace(num_reg_images=lambda: 2),
                                                           1: types.SimpleNamespace(num_reg_images=lambda: 9)},
        undistort_images=lambda out, model, photos: (calls.append(model.name), as_colmap(tmp_path, source)))
    monkeypatch.setitem(sys.modules, "pycolmap", fake)
    code, out, _ = run_main(tmp_path, "--sfm", "--out", tmp_path / "x.npz")
    assert code == 0 and calls == ["extract", "match", "1"] and (tmp_path / "x.npz").exists()
    assert "earlier run" in run_main(tmp_path, "--sfm")[2]   # its photos would be posed twice
    (tmp_path / "dense").rename(tmp_path / "old")
    fake.incremental_mapping = lambda *_: {}
    assert "overlap" in run_main(tmp_path, "--sfm")[2]


# ---- geonvs.py -------------------------------------------------------------------------------------


TINY = dict(rays=64, photos=4, samples=8, bg_samples=4, hidden=16, levels=2, bg_levels=2, channels=2,
            appearance_dim=4, mask_px=32, steps=6)


def config(**changes):
    return g.Config(**TINY | changes)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def random(*shape, seed=0, low=0.0, high=1.0, dtype=torch.float64):
    return low + (high - low) * torch.rand(*shape, generator=generator(seed), dtype=dtype)


def close(a, b, rtol=1e-5, atol=1e-6):
    a, b = (torch.as_tensor(v).detach().double() for v in (a, b))
    torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Each test starts from the same seed and without a network."""
    torch.manual_seed(0)

    def unplugged(*args, **kwargs):
        raise OSError("no network in tests")
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", unplugged)


@pytest.fixture
def double(monkeypatch):
    """Octrees in float64."""
    monkeypatch.setattr(g, "TRILINEAR", g.TRILINEAR.double())


@pytest.fixture
def brief(monkeypatch):
    """Models that skip most of the sphere warm-up."""
    start = g.GeoNVS.start
    monkeypatch.setattr(g.GeoNVS, "start", lambda self, gen: start(self, gen, 3))


@pytest.fixture(scope="session")
def arrays():
    return data_prep.make_toy(size=32, photos=8, test=2)


@pytest.fixture(scope="session")
def scene(arrays):
    return g.load_scene(arrays, "cpu", TINY["mask_px"])


@pytest.fixture(scope="session")
def warm(scene):
    """A model after its sphere warm-up; a test that changes it takes a copy."""
    torch.manual_seed(0)
    gen = generator()
    model = g.GeoNVS(config(), scene)
    model.start(gen, radius=0.5)
    model.zero_grad()
    return model


def batch(scene, n=64, photos=4, seed=0):
    train = torch.nonzero(~scene.is_test)[:, 0]
    return g.random_rays(scene, train, n, photos, generator(seed))


# ---- 2 scene file and rays ---------------------------------------------------------------------------

@pytest.fixture(scope="session")
def odd():
    """Two photos, landscape and portrait, with fx != fy and principal points off centre."""
    rng = np.random.default_rng(0)
    wh = np.array([[7, 4], [3, 5]])
    turn = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in wh]
    turn = np.stack([q * np.sign(np.linalg.det(q)) for q in turn])  # proper rotations
    start = np.array([0, 28, 43])
    scene = dict(rgb=rng.integers(0, 256, (43, 3)).astype(np.uint8), start=start, wh=wh,
                 K=np.array([[6.0, 8, 2.3, 1.1], [4, 3, 2.2, 3.3]]), near=np.array([0.1, 0.2]),
                 c2w=np.concatenate([turn, rng.normal(size=(2, 3, 1))], 2), is_test=np.array([False, False]),
                 name=np.array(["a", "b"]), points=np.zeros((0, 3)), center=np.zeros(3), scale=np.array(1.0),
                 info=np.array(json.dumps(dict(scene="odd", kind="colmap"))))
    return g.load_scene(scene, "cpu", 8)


def pixel_of(scene, photo, x, y):
    w = int(scene.wh[photo, 0])
    return scene.raw["rgb"][scene.raw["start"][photo] + y * w + x]


def test_ray_through_a_pixel_projects_back_to_its_centre(odd):
    for i, (w, h) in enumerate(odd.wh.tolist()):
        rays = g.make_rays(odd, torch.full((w * h,), i), torch.arange(w * h))
        x = rays.o + random(w * h, 1, low=0.5, high=9, dtype=torch.float32) * rays.d
        cam = (x - odd.c2w[i, :, 3]) @ odd.c2w[i, :, :3]  # world to camera
        px = cam[:, :2] / cam[:, 2:] * odd.K[i, :2] + odd.K[i, 2:]
        want = torch.tensor([[x + 0.5, y + 0.5] for y in range(h) for x in range(w)])
        close(px, want, atol=1e-4)
        close(rays.uv * torch.tensor([w, h]), want)
        assert (cam[:, 2] > 0).all()


def test_directions_are_unit_and_origins_are_camera_centres(odd):
    rays = g.make_rays(odd, torch.tensor([0, 1, 1]), torch.tensor([27, 0, 14]))
    close(rays.d.norm(dim=1), torch.ones(3))
    close(rays.o, odd.c2w[[0, 1, 1], :, 3])
    close(rays.near, [0.1, 0.2, 0.2])


def test_principal_point_looks_along_the_camera_axis(odd):
    d = g.pixel_directions(odd.K[:, 2:], odd.K)
    close(d, [[0, 0, 1], [0, 0, 1]])


def test_rays_carry_the_colour_of_their_pixel(odd):
    rays = g.make_rays(odd, torch.tensor([0, 1]), torch.tensor([9, 7]))
    close(rays.rgb * 255, np.stack([pixel_of(odd, 0, 2, 1), pixel_of(odd, 1, 1, 2)]), atol=1e-3)


def test_random_rays_come_equally_from_the_photos_allowed_and_cover_them(odd):
    rays, pick = g.random_rays(odd, torch.tensor([1]), 600, 3, generator())
    assert pick.tolist() == [1, 1, 1] and set(rays.img.tolist()) == {1}
    seen = (rays.uv * torch.tensor([3, 5])).floor().unique(dim=0)
    assert len(seen) == 15  # a pixel is missed with odds 15 (14/15)^600 = 2e-17
    rays, pick = g.random_rays(odd, torch.tensor([0, 1]), 40, 4, generator(1))
    assert torch.equal(rays.img, pick.repeat_interleave(10))


def test_thumbnails_are_the_photos_in_channel_order(odd):
    want = [odd.raw["rgb"][a:b].mean(0) for a, b in zip(odd.raw["start"], odd.raw["start"][1:])]
    close(odd.thumbs.float().mean((2, 3)), np.stack(want), atol=12)
    assert odd.thumbs.shape == (2, 3, 8, 8)


def sphere_rays(o, d, near=0.1):
    o, d = torch.tensor(o, dtype=torch.float32), F.normalize(torch.tensor(d, dtype=torch.float32), dim=1)
    n = len(o)
    return g.Rays(o, d, torch.full((n,), near), torch.zeros(n).long(), torch.zeros(n, 2), torch.zeros(n, 3))


SPHERE_CASES = {  # origin, direction, t0, t1, hit; near is 0.1
    "through the centre": ((0, 0, -3), (0, 0, 1), 2, 4, True),
    "off centre": ((0.6, 0, -3), (0, 0, 1), 2.2, 3.8, True),
    "starts inside": ((0, 0, 0), (1, 0, 0), 0.1, 1, True),
    "leaves it before near": ((0, 0.95, 0), (0, 1, 0), 0.1, 0.1, False),
    "miss": ((0, 2, -3), (0, 0, 1), 3, 3, False),
    "miss, closest approach behind": ((0, 2, 3), (0, 0, 1), 0.1, 0.1, False),
    "behind": ((0, 0, 3), (0, 0, 1), 0.1, 0.1, False),
    "far away": ((0, 0, -1000), (0, 0, 1), 999, 1001, True),
}


@pytest.mark.parametrize("case", SPHERE_CASES)
def test_sphere_interval(case):
    o, d, *want, want_hit = SPHERE_CASES[case]
    t0, t1, hit = g.sphere_interval(sphere_rays([o], [d]))
    close([t0.item(), t1.item()], want, atol=1e-3)
    assert hit.item() is want_hit


def test_tangent_ray_has_a_finite_empty_interval():
    t0, t1, _ = g.sphere_interval(sphere_rays([(0, 1, -3)], [(0, 0, 1)]))
    close([t0.item(), t1.item()], [3, 3], atol=1e-3)


def test_sphere_interval_of_any_ray_is_finite_ordered_and_ends_on_the_sphere():
    o, d = random(4000, 3, low=-3, high=3).tolist(), random(4000, 3, seed=1, low=-1).tolist()
    rays = sphere_rays(o, d, near=0.0)
    t0, t1, hit = g.sphere_interval(rays)
    assert torch.isfinite(t0 + t1).all() and (t1 >= t0).all() and (t0 >= 0).all()
    assert (t0 == t1)[~hit].all() and 0.02 < hit.float().mean() < 0.9
    outside = hit & (rays.o.norm(dim=1) > 1)
    for t, on in ((t0, outside), (t1, hit)):
        close((rays.o + t[:, None] * rays.d)[on].norm(dim=1), torch.ones(int(on.sum())), atol=1e-4)
    closest = -(rays.o * rays.d).sum(1)
    close(t0[~hit], closest[~hit].clamp(min=0), atol=1e-5)


# ---- 3 octree ----------------------------------------------------------------------------------------

def make_tree(seed=0, half=1.3, levels=4, root=3, channels=2, share=0.35, dtype=torch.float64):
    """A tree with a random share of each level's cells split and random features."""
    octree = g.Octree(half, levels, channels, root=root).to(dtype)
    for level in range(levels - 1):
        ijk = octree.cells[level]
        octree.split(level, ijk[random(len(ijk), seed=seed + level) < share])
    fill(octree, seed)
    return octree


def fill(octree, seed=0):
    octree.features.data[1:] = random(*octree.features[1:].shape, seed=seed, low=-1).to(octree.features)


def corners_of(octree):
    """Level (V-1,) and integer coordinates (V-1,3) of the corners that own a row, from their keys."""
    key = octree.row_key[1:] % (1 << 40)
    level = octree.row_key[1:] // (1 << 40) - 1
    n = torch.tensor([octree.resolution(int(i)) + 1 for i in level])
    return level, torch.stack([key // n ** 2, key // n % n, key % n], 1)


def naive_lookup(octree, x):
    """Features (L,C) at one point by loops over levels and corners; float64."""
    level, ijk = corners_of(octree)
    table = {(a, *b): f for a, b, f in zip(level.tolist(), ijk.tolist(), octree.features[1:].double())}
    cells = [set(map(tuple, c.tolist())) for c in octree.cells]
    out = torch.zeros(octree.levels, octree.features.shape[1], dtype=torch.float64)
    for a in range(octree.levels):
        at = [(float(v) / (2 * octree.half) + 0.5) * octree.root * 2 ** a for v in x]
        cell = tuple(math.floor(v) for v in at)
        if cell not in cells[a]:
            break
        for bits in itertools.product((0, 1), repeat=3):
            weight = math.prod(p - c if b else 1 - (p - c) for p, c, b in zip(at, cell, bits))
            feature = table.get((a, *(c + b for c, b in zip(cell, bits))))
            out[a] += 0 if feature is None else weight * feature
    return out


@pytest.mark.parametrize("seed", [0, 1])
def test_lookup_equals_a_naive_loop(double, seed):
    octree, x = make_tree(seed), random(150, 3, seed=9, low=-1.3, high=1.3)
    want = torch.stack([naive_lookup(octree, p) for p in x])
    close(octree(x)[:, :, 0], want, atol=1e-9)
    assert (want[:, 3] != 0).any() and (want[:, 3] == 0).any()  # deep and shallow paths both occur


def test_lookup_in_float32_is_as_good_as_float32():
    octree, x = make_tree(dtype=torch.float32), random(100, 3, low=-1.3, high=1.3)
    close(octree(x.float())[:, :, 0], torch.stack([naive_lookup(octree, p) for p in x]), atol=2e-5)


def full_linear_tree(half=1.3):
    """All cells split; every level's corners hold x + 10 y + 100 z."""
    octree = g.Octree(half, 3, 1, root=2).double()
    for level in range(2):
        octree.split(level, octree.cells[level])
    level, ijk = corners_of(octree)
    cell = torch.tensor([octree.cell(int(i)) for i in level])[:, None]
    octree.features.data[1:, 0] = (ijk * cell.double() - half) @ torch.tensor([1.0, 10, 100]).double()
    return octree


def test_linear_field_with_unequal_slopes_is_reproduced_exactly(double):
    x = random(300, 3, low=-1.299, high=1.299)
    want = (x @ torch.tensor([1.0, 10, 100]).double())[:, None].expand(-1, 3)
    close(full_linear_tree()(x)[:, :, 0, 0], want, atol=1e-9)


def test_derivatives_of_a_linear_field_are_its_slopes_per_cell(double):
    octree, x = full_linear_tree(), random(50, 3, low=-1.2, high=1.2)
    got = octree(x, derivatives=True)[:, :, 1:, 0]
    for level in range(3):
        want = torch.tensor([1.0, 10, 100]).double() * octree.cell(level)
        close(got[:, level], want.expand(50, 3), atol=1e-9)


def test_derivatives_equal_finite_differences(double):
    octree, x, eps = make_tree(), random(400, 3, low=-1.29, high=1.29), 1e-6
    finest = (x / 2.6 + 0.5) * octree.resolution(3)
    x = x[((finest - finest.round()).abs() > 1e-3).all(1)]  # the derivative jumps on faces
    got = octree(x, derivatives=True)
    for axis, step in enumerate(torch.eye(3).double() * eps):
        slope = (octree(x + step) - octree(x - step))[:, :, 0] / (2 * eps)
        cell = torch.tensor([octree.cell(i) for i in range(4)]).double()[:, None]
        close(got[:, :, 1 + axis], slope * cell, atol=1e-6)
    assert torch.equal(got[:, :, :1], octree(x))


def test_gradient_reaches_features_through_the_derivatives(double):
    octree, x = make_tree(levels=2), random(20, 3, low=-1.2, high=1.2)
    weight = random(20, 2, 4, 2, seed=5)
    (octree(x, derivatives=True) * weight).sum().backward()
    v, c = int(octree.corner.max()), 1
    for row in (1, v // 2, v):
        before = octree.features.data[row, c].item()
        ends = []
        for value in (before - 1e-3, before + 1e-3):
            octree.features.data[row, c] = value
            ends.append((octree(x, derivatives=True) * weight).sum().item())
        octree.features.data[row, c] = before
        assert octree.features.grad[row, c].item() == pytest.approx((ends[1] - ends[0]) / 2e-3, abs=1e-8)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_field_is_continuous_across_every_face_of_every_cell(double, seed):
    octree = make_tree(seed, levels=3)
    for level, cells in enumerate(octree.cells):
        low = cells.double() * octree.cell(level) - octree.half
        for axis in range(3):
            x = low + random(*low.shape, seed=seed) * octree.cell(level)
            x[:, axis] = low[:, axis]
            x = x[cells[:, axis] > 0]  # the cube's own faces have one side
            step = torch.eye(3).double()[axis] * 1e-9
            close(octree(x - step), octree(x + step), atol=1e-6)


def brute_force_corners(octree):
    """Per level: all corners of its cells, and those with all their cells present."""
    found = []
    for level, cells in enumerate(octree.cells):
        have, n = set(map(tuple, cells.tolist())), octree.resolution(level)
        around = list(itertools.product((0, 1), repeat=3))
        corners = {tuple(c + b for c, b in zip(cell, bits)) for cell in have for bits in around}
        free = set()
        for k in corners:
            cells_there = [tuple(c - b for c, b in zip(k, bits)) for bits in around]
            if all(c in have for c in cells_there if all(0 <= v < n for v in c)):
                free.add(k)
        found.append((corners, free))
    return found


@pytest.mark.parametrize("seed", [0, 1])
def test_each_shared_corner_owns_one_row_and_hanging_corners_none(seed):
    octree = make_tree(seed)
    level, ijk = corners_of(octree)
    for a, (corners, free) in enumerate(brute_force_corners(octree)):
        owners = list(map(tuple, ijk[level == a].tolist()))
        assert len(owners) == len(set(owners)) and set(owners) == free
        assert a == 0 or free < corners  # some do hang in a random tree


def test_cells_that_meet_share_rows_and_hanging_corners_point_to_row_zero():
    octree = make_tree()
    level, ijk = corners_of(octree)
    row_of = {(a, *b): i + 1 for i, (a, b) in enumerate(zip(level.tolist(), ijk.tolist()))}
    node = 8
    for a, cells in enumerate(octree.cells):
        for cell in cells.tolist():
            want = [row_of.get((a, *(c + b for c, b in zip(cell, bits))), 0)
                    for bits in itertools.product((0, 1), repeat=3)]
            assert octree.corner[node].tolist() == want
            node += 1
    assert node == len(octree.corner) == len(octree.child)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_split_does_not_change_the_function_by_a_bit(double, seed):
    octree, x = make_tree(seed, share=0.2), random(500, 3, low=-1.3, high=1.3)
    before = octree(x, derivatives=True)
    for level in (0, 1, 2, 0):
        ijk, n = octree.cells[level], sum(map(len, octree.cells))
        octree.split(level, ijk[random(len(ijk), seed=n) < 0.5])
        assert sum(map(len, octree.cells)) > n
        assert torch.equal(octree(x, derivatives=True), before)


def structure(octree):
    return [octree.row_key, octree.child, octree.corner, *octree.cells, *octree.split_keys]


def same_structure(a, b):
    return len(a) == len(b) and all(torch.equal(x, y) for x, y in zip(a, b))


def test_splitting_twice_is_splitting_once():
    octree = make_tree(levels=3)
    ijk = octree.cells[1][::3]
    octree.split(1, ijk)
    fill(octree)
    once, features = structure(octree), octree.features.clone()
    octree.split(1, ijk)
    assert same_structure(structure(octree), once) and torch.equal(octree.features, features)


def test_prune_then_split_restores_structure_and_zeroes_only_what_was_cut():
    octree = make_tree(levels=3, share=0.6)
    ijk = octree.cells[0][::4]
    octree.split(0, ijk)
    fill(octree)
    before, features, keys = structure(octree), octree.features.clone(), octree.split_keys[1]
    octree.prune(0, ijk)
    assert len(octree.row_key) < len(before[0])
    surviving = torch.isin(before[0], octree.row_key)
    octree.split(0, ijk)
    octree.build([octree.split_keys[0], keys])
    assert same_structure(structure(octree), before)
    assert torch.equal(octree.features[surviving], features[surviving])
    assert (octree.features[~surviving] == 0).all()


def test_prune_removes_whole_subtrees():
    octree = make_tree(share=0.7)
    octree.prune(0, octree.cells[0])
    assert [len(c) for c in octree.cells] == [27, 0, 0, 0]


def test_splitting_a_cell_that_does_not_exist_changes_nothing():
    octree = make_tree(levels=3, share=0.3)
    leaf = octree.cells[0][~torch.isin(octree.key(octree.cells[0], 0), octree.split_keys[0])]
    before = structure(octree)
    octree.split(1, 2 * leaf)  # children of leaves
    assert same_structure(structure(octree), before)


def test_old_row_maps_rows_by_the_corner_they_stand_for():
    octree = make_tree(levels=3)
    keys, features = octree.row_key, octree.features.detach().clone()
    for change in (lambda: octree.split(1, octree.cells[1][::5]), lambda: octree.prune(0, octree.cells[0][:9])):
        old_row = change()
        assert torch.equal(octree.features, features[old_row])
        kept = old_row > 0
        assert torch.equal(octree.row_key[kept], keys[old_row[kept]])
        assert not torch.isin(octree.row_key[~kept][1:], keys).any()
        keys, features = octree.row_key, octree.features.detach().clone()


def test_the_pinned_row_is_zero_and_gets_no_gradient():
    octree = make_tree(dtype=torch.float32)
    octree(random(200, 3, low=-1.3, high=1.3, dtype=torch.float32), True).square().sum().backward()
    assert (octree.features[0] == 0).all() and (octree.features.grad[0] == 0).all()
    assert (octree.features.grad[1:] != 0).any()


@pytest.mark.parametrize("sets", [1, 3])  # the value alone takes a way of its own
@pytest.mark.parametrize("kind", [torch.int32, torch.int64])
def test_interpolate_passes_gradcheck(sets, kind):
    features = random(12, 2, low=-1).requires_grad_()
    corner = 1 + (random(5, 8, seed=1) * 11).to(kind)
    w = random(5, sets, 8, seed=2, low=-1)
    assert torch.autograd.gradcheck(lambda f: g.Interpolate.apply(f, corner, w), (features,))


def test_interpolate_equals_a_naive_sum_also_when_corners_repeat():
    features, w = random(4, 2, low=-1), random(3, 2, 8, seed=2, low=-1)
    corner = torch.tensor([[0, 1, 1, 1, 2, 3, 3, 0], [1] * 8, [0] * 8])
    close(g.Interpolate.apply(features, corner, w), torch.einsum("pjk,pkc->pjc", w, features[corner]))


@pytest.mark.parametrize("sets", [1, 3])
def test_interpolate_sends_back_what_a_naive_sum_does(sets):
    """gradcheck pulls with one-hot vectors alone; here with both signs."""
    features, w = random(9, 2, low=-1).requires_grad_(), random(5, sets, 8, seed=2, low=-1)
    corner, pull = 1 + (random(5, 8, seed=1) * 8).int(), random(5, sets, 2, seed=3, low=-1)
    values = torch.einsum("pjk,pkc->pjc", w, features[corner.long()]), g.Interpolate.apply(features, corner, w)
    close(*(torch.autograd.grad(value, features, pull)[0] for value in values))


def test_memory_of_a_shell_grows_fourfold_per_level_not_eightfold():
    octree = g.Octree(1.0, 4, 1)
    sizes = [octree.bytes()]
    for level in range(3):
        r = ((octree.cells[level] + 0.5) * octree.cell(level) - 1).norm(dim=1)
        octree.split(level, octree.cells[level][(r - 0.5).abs() < octree.cell(level)])
        sizes.append(octree.bytes())
    growth = [(sizes[3] - sizes[2]) / (sizes[2] - sizes[1])]
    assert 3.5 < growth[0] < 4.5


@pytest.mark.parametrize("far", [1.0, 1.5, 100.0, 1e30])
def test_points_outside_the_cube_get_the_nearest_features_inside(far):
    octree = make_tree(half=1.0, dtype=torch.float32)
    x = random(100, 3, low=-1, dtype=torch.float32)
    x[:, 1] = far
    edge = x.clone()
    edge[:, 1] = 1.0
    assert torch.equal(octree(x), octree(edge)) and torch.isfinite(octree(-x)).all()


@pytest.mark.parametrize("levels, root", [(1, 1), (3, 1), (5, 2)])
def test_one_cell_and_empty_levels_give_finite_features_and_gradients(levels, root):
    octree = g.Octree(1.0, levels, 2, root=root)  # nothing is split
    x = torch.tensor([[0.0, 0, 0], [1, 1, 1], [-1, 0.5, 1], [1e4, -1e4, 0], [1e30, 0, -1e30]])
    out = octree(x, derivatives=True)
    out.square().sum().backward()
    assert out.shape == (5, levels, 4, 2) and len(octree(x[:0])) == 0
    assert torch.isfinite(out).all() and torch.isfinite(octree.features.grad).all()
    assert (out[:, 1:] == 0).all() and len(octree.features) - 1 == (root + 1) ** 3


def test_trilinear_weights_sum_to_one_and_their_derivatives_to_zero():
    f = random(20, 3)
    basis = torch.stack([f[:, 0] ** i * f[:, 1] ** j * f[:, 2] ** k
                         for i, j, k in itertools.product((0, 1), repeat=3)], 1)
    w = (basis @ g.TRILINEAR.double()).reshape(20, 4, 8)
    close(w.sum(2), torch.tensor([1.0, 0, 0, 0]).expand(20, 4))


def test_seeding_refines_around_points_with_no_hanging_corner_beside_them():
    octree, points = g.Octree(1.0, 4, 1, root=8), random(6, 3, low=-0.5, high=0.5, dtype=torch.float32)
    g.seed_octree(octree, points, 1, (0.0, 1.0))
    corner, _ = octree.locate(points)
    assert (corner[:, :3] > 0).all() and len(octree.cells[2]) <= 8 * 27 * 6 and len(octree.cells[3]) == 0
    assert (octree.features[1:] != 0).all() and (octree.features[0] == 0).all()


def test_seeding_a_shell_splits_exactly_what_may_touch_it():
    octree = g.Octree(2.0, 2, 1, root=8)
    g.seed_octree(octree, torch.zeros(0, 3), 1, (1.0, 2.0))
    x = random(3000, 3, low=-2, high=2, dtype=torch.float32)
    r, split = x.norm(dim=1), torch.isin(octree.key(octree.cell_of(x, 0), 0), octree.split_keys[0])
    diagonal = 0.5 * math.sqrt(3)
    assert split[(r > 1) & (r < 2)].all() and not split[(r < 1 - diagonal) | (r > 2 + diagonal)].any()


def test_around_is_the_neighbourhood_within_the_cube():
    octree = g.Octree(1.0, 2, 1, root=4)
    cells = torch.tensor([[0, 5, 7], [1, 5, 7], [4, 0, 3]])
    got = set(map(tuple, octree.around(cells, 1).tolist()))
    want = [tuple(min(max(c + b, 0), 7) for c, b in zip(cell, bits))
            for cell in cells.tolist() for bits in itertools.product((-1, 0, 1), repeat=3)]
    assert got == set(want)


@pytest.mark.parametrize("footprint", [0.02, 0.011, 0.004])
def test_the_finest_cell_is_one_to_two_pixels_at_the_surface(footprint):
    cell = 2 / (16 << (g.levels_for_footprint(footprint) - 1))
    assert footprint <= cell < 2 * footprint
    assert g.levels_for_footprint(footprint / 2) == g.levels_for_footprint(footprint) + 1  # twice the focal length


def test_levels_stay_between_two_and_eight():
    assert g.levels_for_footprint(5.0) == 2 and g.levels_for_footprint(1e-9) == 8


# ---- 4 fields ----------------------------------------------------------------------------------------

def make_field(dtype=torch.float64, seed=0):
    torch.manual_seed(seed)
    field = g.SDFField(make_tree(seed, half=1.0, levels=3, dtype=dtype), 16).to(dtype)
    return field


def test_with_gradient_returns_forward_and_its_central_differences(double):
    field, x, eps = make_field(), random(300, 3, low=-0.99, high=0.99), 1e-6
    fine = (x / 2 + 0.5) * field.octree.resolution(2)
    x = x[((fine - fine.round()).abs() > 1e-3).all(1)]
    sdf, geo, grad = field.with_gradient(x)
    assert torch.equal(sdf, field(x)[0]) and torch.equal(geo, field(x)[1])
    want = torch.stack([(field(x + e)[0] - field(x - e)[0]) / (2 * eps) for e in torch.eye(3).double() * eps], 1)
    close(grad, want, rtol=1e-5, atol=1e-5)


def test_with_gradient_in_float32_agrees_with_float64(double):
    field, x = make_field(), random(100, 3, low=-0.9, high=0.9).float().double()
    want = field.with_gradient(x)[2]
    g.TRILINEAR = g.TRILINEAR.float()
    got = copy.deepcopy(field).float().with_gradient(x.float())[2]
    close(got, want, rtol=1e-3, atol=1e-3)


def test_training_through_normals_reaches_every_weight_of_the_field(double):
    field = make_field()
    field.with_gradient(random(50, 3, low=-0.9, high=0.9))[2].square().sum().backward()
    got = {name: p.grad is not None and bool((p.grad != 0).any()) for name, p in field.named_parameters()}
    assert [k for k, v in got.items() if not v] == ["lin2.bias"]  # the one shift that no derivative sees


def quadratic(seed, diagonal=False):
    A = random(3, 3, seed=seed, low=-1)
    A = torch.diag(A.diagonal()) if diagonal else A + A.T
    b = random(3, seed=seed + 1, low=-1)
    return A, b, lambda x: ((x @ A) * x).sum(1) + x @ b + 0.7


@pytest.mark.parametrize("eps", [1e-3, 0.1, 1.0])
def test_laplacian_is_exact_for_quadratics_of_any_step(monkeypatch, eps):
    monkeypatch.setattr(g, "TETRAHEDRON", g.TETRAHEDRON.double())
    A, _, f = quadratic(0)
    x = random(20, 3, low=-1)
    close(g.finite_differences(f, x, eps)[1], torch.full((20,), 2 * A.trace().item()), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("eps", [1e-3, 0.1, 1.0])
def test_gradient_is_exact_for_quadratics_up_to_the_mixed_terms_of_a_tetrahedron(monkeypatch, eps):
    """A tetrahedron has no point symmetry: 2 A_yz y z leaks eps 2/sqrt(3) A_yz into the x slope, and so on."""
    monkeypatch.setattr(g, "TETRAHEDRON", g.TETRAHEDRON.double())
    x = random(20, 3, low=-1)
    A, b, f = quadratic(3, diagonal=True)
    close(g.finite_differences(f, x, eps)[0], 2 * x @ A + b, atol=1e-9)
    A, b, f = quadratic(3)
    leak = eps * 2 / math.sqrt(3) * torch.stack([A[1, 2], A[0, 2], A[0, 1]])
    close(g.finite_differences(f, x, eps)[0], 2 * x @ A + b + leak, atol=1e-9)


def test_gradient_error_shrinks_with_eps_and_laplacian_error_too(monkeypatch):
    monkeypatch.setattr(g, "TETRAHEDRON", g.TETRAHEDRON.double())
    x = random(30, 3, low=0.3, high=0.9)
    error = []
    for eps in (0.04, 0.02, 0.01):  # |x| has gradient x / |x| and Laplacian 2 / |x|
        grad, lap = g.finite_differences(lambda y: y.norm(dim=1), x, eps)
        error.append([(grad - F.normalize(x, dim=1)).norm(), (lap - 2 / x.norm(dim=1)).abs().mean()])
    ratio = torch.tensor(error)[:-1] / torch.tensor(error)[1:]
    assert (ratio > 1.8).all()


def test_taps_are_unit_steps_and_a_given_centre_saves_its_evaluation():
    calls = []

    def f(y):
        calls.append(y)
        return y[:, 0] * 3
    x = random(5, 3, dtype=torch.float32)
    g.finite_differences(f, x, 0.5, x[:, 0] * 3)
    assert [len(c) for c in calls] == [20]
    close((calls[0].reshape(5, 4, 3) - x[:, None]).norm(dim=2), torch.full((5, 4), 0.5))


@pytest.mark.parametrize("scale", [0.0, 1e-4, 1.0, 1e4])
@pytest.mark.parametrize("eps", [1e-4, 1e-2, 1e3])
def test_derivatives_and_their_gradients_are_finite_at_any_size(scale, eps):
    field = g.SDFField(g.Octree(1.0, 2, 2), 8)
    with torch.no_grad():
        field.octree.features.mul_(scale)
        field.lin2.weight.mul_(scale)
        field.lin2.bias.fill_(scale)
    x = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0.125, 0.3, -0.125], [1e3, 0, 1]]).requires_grad_()
    s, _, grad = field.with_gradient(x)
    taps, lap = g.finite_differences(lambda y: field(y)[0], x, eps)
    (s.sum() + (grad.norm(dim=1) - 1).square().sum() + F.normalize(grad, dim=1).sum()
     + F.normalize(taps, dim=1).sum() + lap.abs().sum() * eps).backward()
    assert all(torch.isfinite(v).all() for v in (s, grad, taps, lap, x.grad))
    assert all(torch.isfinite(p.grad).all() for p in field.parameters())


def test_spherical_harmonics_are_orthogonal_on_the_sphere():
    z, wz = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * np.pi / 16
    z, phi, w = np.repeat(z, 16), np.tile(phi, 8), np.repeat(wz, 16) / 16
    rho = np.sqrt(1 - z ** 2)
    basis = g.sh_basis(torch.as_tensor(np.stack([rho * np.cos(phi), rho * np.sin(phi), z], 1)))
    gram = (basis * torch.as_tensor(w)[:, None]).T @ basis
    assert basis.shape == (128, 9) and (gram.diagonal() > 0.05).all()
    close(gram - torch.diag(gram.diagonal()), torch.zeros(9, 9), atol=1e-12)


def test_spherical_harmonics_of_a_turn_around_z_change_only_where_they_must():
    angle = torch.linspace(0, 6, 20)
    basis = g.sh_basis(torch.stack([0.6 * angle.cos(), 0.6 * angle.sin(), torch.full((20,), 0.8)], 1))
    assert (basis.std(0) < 1e-6).nonzero()[:, 0].tolist() == [0, 3, 8]
    close(basis[0, [0, 3, 8]], [1, 0.8, 3 * 0.64 - 1])


def lipschitz(tight):
    torch.manual_seed(0)
    mlp = g.LipschitzMLP([6, 20, 20, 3])
    with torch.no_grad():
        mlp.c -= tight
    return mlp


@pytest.mark.parametrize("tight", [0, 1, 3])
def test_lipschitz_bound_holds_for_random_pairs(tight):
    mlp = lipschitz(tight)
    a, b = random(2, 4000, 6, low=-3, high=3, dtype=torch.float32)
    rise = (mlp(a) - mlp(b)).abs().amax(1) / (a - b).abs().amax(1)
    assert rise.max() <= mlp.bounds().prod() * 1.0001


def test_lipschitz_bound_is_reached_by_a_single_clamped_layer():
    mlp = g.LipschitzMLP([4, 1])
    with torch.no_grad():
        mlp.c.fill_(math.log(math.expm1(0.1)))
    step = mlp.layers[0].weight.sign()
    assert (mlp(step) - mlp(-step)).item() / 2 == pytest.approx(0.1, rel=1e-4)


def test_lipschitz_mlp_starts_as_a_plain_mlp_at_its_bounds():
    mlp, x = lipschitz(0), random(30, 6, dtype=torch.float32)
    y = x
    for i, layer in enumerate(mlp.layers):
        y = layer(y if i == 0 else F.relu(y))
    close(mlp(x), y)
    close(mlp.bounds().detach(), [la.weight.detach().abs().sum(1).max().item() for la in mlp.layers], rtol=1e-4)


def test_contract_is_identity_inside_below_two_outside_continuous_and_monotone():
    d = F.normalize(random(50, 1, 3, low=-1), dim=2)
    r = torch.tensor([0.0, 0.3, 0.999999, 1.0, 1.000001, 2, 10, 1e6])[:, None].double()  # (8,1)
    y = g.contract(d * r)
    n = y.norm(dim=2)  # (50,8)
    close(y[:, :4], (d * r)[:, :4])
    close(n[:, 4:], (2 - 1 / r[4:, 0]).expand(50, 4))
    assert (n < 2).all() and (n.diff(dim=1) > 0).all() and (n[:, 4] - n[:, 2] < 1e-5).all()
    close(F.cosine_similarity(y[:, 1:], d.expand(50, 7, 3), dim=2), torch.ones(50, 7))


@pytest.mark.parametrize("c", [-1e4, -100.0, 0.0, 1e4])
@pytest.mark.parametrize("weight", [0.0, 1e-20, 1.0, 1e4])
def test_lipschitz_bound_and_its_gradients_are_finite(c, weight):
    net = g.LipschitzMLP([3, 4, 4, 2])
    with torch.no_grad():
        net.c.fill_(c)
        for layer in net.layers:
            layer.weight.mul_(weight)
            layer.weight[0] = 0
    loss = net(random(5, 3, dtype=torch.float32)).sum() + torch.log(net.bounds()).sum()
    loss.backward()
    assert math.isfinite(loss.item())
    assert all(torch.isfinite(p.grad).all() for p in net.parameters())


def test_contraction_and_its_gradient_are_finite():
    r = torch.tensor([0, 1e-30, 1e-3, 1 - 1e-6, 1, 1 + 1e-6, 30, 1e4, 1e15])
    x = torch.cat([F.pad(r[:, None], (0, 2)), r[:, None] * torch.tensor([0.6, 0, -0.8])])
    x.requires_grad_()
    out = g.contract(x)
    out.sum().backward()
    assert (out.norm(dim=1) <= 2).all() and torch.isfinite(x.grad).all()


class Recorder(nn.Module):
    """Stands in for an octree: remembers the points asked for; features are functions of position."""

    def __init__(self, channels=2):
        super().__init__()
        self.levels, self.features, self.seen = 1, torch.zeros(1, channels), []

    def forward(self, x, derivatives=False):
        self.seen.append(x)
        return torch.stack([x.sum(1), x[:, 0]], 1)[:, None, None]


def make_background(appearance=3):
    torch.manual_seed(0)
    return g.Background(Recorder(), 16, appearance)


def test_background_of_one_colour_shows_exactly_that_colour():
    bg, rays = make_background(), sphere_rays([(0, 0, -3), (0, 3, 0)], [(0, 0, 1), (1, 0, 0)])
    with torch.no_grad():
        bg.color[2].weight.zero_()
        bg.color[2].bias.copy_(torch.tensor([-1.0, 0, 2]))
        got = bg(rays, torch.tensor([4.0, 1]), torch.zeros(2, 3), 5, torch.rand(2, 5))
    close(got, torch.sigmoid(torch.tensor([-1.0, 0, 2])).expand(2, 3), atol=2e-6)


def test_background_samples_start_at_the_sphere_exit_and_stay_outside():
    bg, rays = make_background(), sphere_rays([(0.3, 0.2, -3)] * 2, [(0, 0.1, 1), (0, 0, 1)])
    _, t1, _ = g.sphere_interval(rays)
    bg(rays, t1, torch.zeros(2, 3), 6, torch.zeros(2, 6))
    x = bg.octree.seen[0].reshape(2, 6, 3)
    close(x[:, 0], rays.o + t1[:, None] * rays.d, atol=1e-5)
    r = x.norm(dim=2)
    assert (r.diff(dim=1) > 0).all() and (r < 2).all() and (r[:, 0] > 1 - 1e-5).all()


def test_background_equals_a_naive_loop_over_its_sections():
    bg, n = make_background(), 4
    rays = sphere_rays([(0.3, 0.2, -3), (0, 2, 0)], [(0, 0.1, 1), (1, 0, 0.3)])
    start, jitter = torch.tensor([3.0, 0.5]), random(2, n, seed=4, dtype=torch.float32)
    code = random(2, 3, seed=5, dtype=torch.float32)
    want = []
    with torch.no_grad():
        for i in range(2):
            u = [(j + jitter[i, j].item()) / n for j in range(n)]
            t = [start[i].item() + v / (1 - v) for v in u]
            rgb, left = torch.zeros(3), 1.0
            for j in range(n):
                x = rays.o[i] + t[j] * rays.d[i]
                x = (g.contract(x))[None]
                out = bg.density(torch.cat([x, bg.octree(x).flatten(1)], 1))[0]
                sigma = math.log1p(math.exp(out[0].item() - 1))
                opacity = 1 - math.exp(-sigma * (t[j + 1] - t[j])) if j + 1 < n else 1.0
                look = torch.cat([out[1:], g.sh_basis(rays.d[i:i + 1])[0], code[i]])
                rgb += left * opacity * torch.sigmoid(bg.color(look))
                left *= 1 - opacity
            want.append(rgb)
        close(bg(rays, start, code, n, jitter), torch.stack(want), atol=1e-5)


def test_background_is_finite_at_the_largest_jitter():
    bg, rays = make_background(), sphere_rays([(0, 0, -3)], [(0, 0, 1)])
    assert torch.isfinite(bg(rays, torch.tensor([4.0]), torch.zeros(1, 3), 3, torch.ones(1, 3))).all()


# ---- 5 alpha, compositing, sampling -------------------------------------------------------------------

def sigmoid(x):
    return 1 / (1 + math.exp(-x))


def test_deviation_starts_at_its_width_and_is_an_exponential_within_bounds():
    deviation = g.Deviation(20.0)
    assert deviation().item() == pytest.approx(20, rel=1e-4)
    deviation.v.data += 0.1
    assert deviation().item() == pytest.approx(20 * math.e, rel=1e-4)
    for v, want in ((-50.0, 1e-2), (50.0, 1e5)):
        deviation.v.data.fill_(v)
        assert deviation().item() == pytest.approx(want)


@pytest.mark.parametrize("zeta, s, cos, dt", [(20, 0.05, -0.7, 0.1), (3, -0.2, -1, 0.5), (200, 0.01, -0.2, 0.03),
                                              (50, 0.0, -0.5, 0.2), (1, 2.0, -0.9, 3.0)])
def test_alpha_equals_the_two_sided_formula(zeta, s, cos, dt):
    before, after = s - cos * dt / 2, s + cos * dt / 2
    want = 1 - sigmoid(zeta * after) / sigmoid(zeta * before)
    got = g.neus_alpha(*(torch.tensor([[v]], dtype=torch.float64) for v in (s, cos, dt)), torch.tensor(float(zeta)).double())
    assert got.item() == pytest.approx(want, rel=1e-9, abs=1e-12)


def ray_of_plane(cos, n, zeta, start=1.0, length=2.0, offset=0.1, dtype=torch.float64):
    """Sections of a ray that crosses the plane at s = 0 with slope cos: (sdf, cos, dt, zeta), edge values."""
    edges = torch.linspace(0, length, n + 1, dtype=dtype)
    f = offset - cos * start + cos * edges
    t = (edges[1:] + edges[:-1]) / 2
    mid = (offset - cos * start + cos * t)[None]
    return (mid, torch.full_like(mid, cos), edges.diff()[None], torch.tensor(zeta, dtype=dtype)), f


@pytest.mark.parametrize("cos", [-1.0, -0.6, -0.05])
def test_alpha_of_a_plane_is_neus_equation_13(cos):
    args, f = ray_of_plane(cos, 40, 15.0)
    phi = torch.sigmoid(15.0 * f)
    close(g.neus_alpha(*args)[0], ((phi[:-1] - phi[1:]) / phi[:-1]).clamp(min=0), atol=1e-12)


def test_slope_form_converges_to_the_two_sample_form_on_a_curved_surface():
    gap = []
    for n in (16, 64, 256):
        edges = torch.linspace(0, 2, n + 1).double()
        t = (edges[1:] + edges[:-1]) / 2

        def ball(t):  # ray passing a sphere of radius 0.6 at distance 0.3
            return torch.sqrt((t - 1) ** 2 + 0.09) - 0.6
        slope = (t - 1) / torch.sqrt((t - 1) ** 2 + 0.09)
        got = g.neus_alpha(ball(t)[None], slope[None], edges.diff()[None], torch.tensor(20.0).double())[0]
        phi = torch.sigmoid(20 * ball(edges))
        gap.append((got - ((phi[:-1] - phi[1:]) / phi[:-1]).clamp(min=0)).abs().max())
    assert gap[0] > 8 * gap[1] > 64 * gap[2]


@pytest.mark.parametrize("n", [3, 50, 1000])
def test_transmittance_through_a_wall_telescopes(n):
    args, f = ray_of_plane(-0.7, n, 6.0)
    _, trans = g.composite(g.neus_alpha(*args))
    want = sigmoid(6 * f[-1].item()) / sigmoid(6 * f[0].item())
    assert trans.item() == pytest.approx(want, rel=1e-9)


def test_printed_alpha_sums_to_one_but_leaves_a_wall_63_percent_opaque():
    args, _ = ray_of_plane(-1.0, 4000, 40.0)
    printed = g.printed_alpha(*args)
    assert printed.sum().item() == pytest.approx(1, abs=2e-3)
    assert g.composite(printed)[0].sum().item() == pytest.approx(1 - 1 / math.e, abs=2e-3)
    assert g.composite(g.neus_alpha(*args))[0].sum().item() == pytest.approx(1, abs=1e-6)


def test_printed_alpha_is_equation_1_literally():
    s, cos, dt = torch.tensor([[0.3, 0.1, -0.2]]), torch.tensor([[-1.0, -0.5, -0.8]]), torch.tensor([[0.2, 0.3, 0.1]])
    got = g.printed_alpha(s, cos, dt, torch.tensor(9.0))[0].tolist()
    for i in range(2):
        beta = cos[0, i].item() * dt[0, i].item() / 2
        want = sigmoid(9 * s[0, i].item() + beta) - sigmoid(9 * s[0, i + 1].item() + beta)
        assert got[i] == pytest.approx(want, abs=1e-6)
    assert got[2] == 0


def test_printed_alpha_goes_negative_where_a_ray_leaves_and_neus_alpha_is_transparent():
    args, _ = ray_of_plane(0.8, 30, 20.0)
    assert (g.printed_alpha(*args)[0, :-1] < 0).all()
    assert (g.neus_alpha(*args) == 0).all()


GRID = torch.cartesian_prod(*(torch.tensor(v) for v in (
    [1e-2, 1.0, 30.0, 1e3, 1e6], [-1e4, -10.0, -0.1, -1e-4, 0.0, 1e-4, 0.1, 10.0, 1e4],
    [-1.0, -1e-3, 0.0, 0.5, 100.0, -100.0], [0.0, 1e-5, 0.1, 1e3])))


def test_alpha_and_its_gradients_are_finite_for_all_magnitudes():
    zeta, s, cos, dt = (c.clone().requires_grad_() for c in GRID.T)
    alpha = g.neus_alpha(s, cos, dt, zeta)
    grads = torch.autograd.grad(alpha.sum(), (s, cos, dt, zeta))
    assert len(alpha) == 1080 and ((alpha >= 0) & (alpha <= 1)).all()
    assert all(torch.isfinite(v).all() for v in grads)


def test_printed_alpha_and_its_gradients_are_finite_for_all_magnitudes():
    zeta, s, cos, dt = (c[None].clone().requires_grad_() for c in GRID.T)
    alpha = g.printed_alpha(s, cos, dt, zeta)
    grads = torch.autograd.grad(alpha.sum(), (s, cos, dt, zeta))
    assert (alpha.abs() <= 1).all() and all(torch.isfinite(v).all() for v in grads)


@pytest.mark.parametrize("k", [1e-2, 0.5, 7.0])
def test_alpha_does_not_change_when_space_is_scaled_and_zeta_with_it(k):
    s, cos, dt = random(9, 9, low=-0.3, high=0.3), random(9, 9, seed=1, low=-1), random(9, 9, seed=2)
    zeta = torch.tensor(15.0).double()
    close(g.neus_alpha(k * s, cos, k * dt, zeta / k), g.neus_alpha(s, cos, dt, zeta), rtol=1e-9)


def test_alpha_grows_with_the_section_and_with_the_slope():
    s, zeta = torch.tensor([[0.02] * 20]), torch.tensor(30.0)
    rising = torch.linspace(0.01, 1, 20)[None]
    assert (g.neus_alpha(s, torch.full_like(s, -0.5), rising, zeta).diff() > 0).all()
    assert (g.neus_alpha(s, -rising, torch.full_like(s, 0.1), zeta).diff() > 0).all()


def test_composite_equals_a_naive_loop():
    alpha = random(6, 9)
    w, trans = g.composite(alpha)
    for i in range(6):
        left = 1.0
        for j in range(9):
            assert w[i, j].item() == pytest.approx(left * alpha[i, j].item(), abs=1e-12)
            left *= 1 - alpha[i, j].item()
        assert trans[i].item() == pytest.approx(left, abs=1e-12)


@pytest.mark.parametrize("alpha", [[0.0, 0, 0], [1.0, 1, 1], [0.3, 0.9, 0.1], [1.0, 0.5, 0], [0.0, 0, 1]])
def test_weights_and_what_passes_sum_to_one_with_finite_gradients(alpha):
    alpha = torch.tensor([alpha]).requires_grad_()
    w, trans = g.composite(alpha)
    assert (w.sum() + trans).item() == pytest.approx(1, abs=3e-6)
    grad, = torch.autograd.grad((w * torch.tensor([1.0, 2, 3])).sum() + 5 * trans.sum(), alpha)
    assert torch.isfinite(grad).all()


@pytest.mark.parametrize("n", [1, 2, 10_000])
@pytest.mark.parametrize("value", [0.0, 1e-12, 1e-4, 0.999, 1.0])
def test_compositing_one_or_many_sections_is_finite(n, value):
    alpha = torch.full((1, n), value).requires_grad_()
    w, trans = g.composite(alpha)
    ((w * torch.arange(1.0, n + 1)).sum() + trans.sum()).backward()
    assert (w >= 0).all() and (w.sum() + trans).item() == pytest.approx(1, abs=1e-3)
    assert torch.isfinite(alpha.grad).all()


def test_an_opaque_section_hides_all_behind_it():
    w, trans = g.composite(torch.tensor([[1.0, 0.7, 0.9]]))
    close(w, [[1, 0, 0]], atol=2e-6)
    assert trans.item() < 2e-6


def test_gradient_of_composite_equals_that_of_the_plain_product():
    alpha = random(1, 7, low=0.1, high=0.9).requires_grad_()
    color = random(7, seed=3)
    before = torch.cat([torch.ones(1).double(), torch.cumprod(1 - alpha[0], 0)[:-1]])
    want, = torch.autograd.grad((before * alpha[0] * color).sum(), alpha)
    got, = torch.autograd.grad((g.composite(alpha)[0] * color).sum(), alpha)
    close(got, want, rtol=1e-9)


def test_inverse_cdf_of_uniform_weights_is_the_straight_line():
    edges, u = torch.linspace(2, 6, 9)[None].double(), random(1, 50).sort().values
    close(g.inverse_cdf(edges, torch.ones(1, 8).double(), u), 2 + 4 * u, rtol=1e-9)


def test_inverse_cdf_of_one_heavy_section_stays_inside_it():
    weight = torch.zeros(1, 8).double()
    weight[0, 5] = 3
    got = g.inverse_cdf(torch.linspace(0, 8, 9)[None].double(), weight, random(1, 50))
    assert ((got >= 5) & (got <= 6)).all()
    close(got, 5 + random(1, 50), atol=1e-9)


def test_inverse_cdf_inverts_the_cdf_and_shares_samples_by_weight():
    edges, weight = random(3, 9, seed=1).cumsum(1), random(3, 8, seed=2)
    u = ((torch.arange(8000) + 0.5) / 8000).double().expand(3, -1)
    t = g.inverse_cdf(edges, weight, u)
    assert (t.diff(dim=1) >= 0).all()
    for i in range(3):
        share = np.histogram(t[i], edges[i])[0] / 8000
        close(share, weight[i] / weight[i].sum(), atol=2 / 8000, rtol=0)


def test_inverse_cdf_at_zero_and_one_returns_the_ends():
    got = g.inverse_cdf(torch.tensor([[1.0, 2, 4]]), torch.tensor([[0.2, 0.8]]), torch.tensor([[0.0, 1.0]]))
    close(got, [[1, 4]])


CENTRE, BALL_R = torch.tensor([0.1, -0.25, 0.3]), 0.4  # off centre and unequal, so that swapped axes show


class Ball:
    """A signed distance to a ball, times `slope`, with the interface of SDFField."""

    def __init__(self, slope=1.0):
        self.slope, self.seen = slope, []

    def __call__(self, x):
        self.seen.append(x)
        return self.slope * ((x - CENTRE).norm(dim=1) - BALL_R), x.new_zeros(len(x), g.GEO)

    def with_gradient(self, x):
        return *self(x), self.slope * F.normalize(x - CENTRE, dim=1)


def ball_model(zeta=400.0, slope=1.0, **changes):
    line = torch.linspace(-1, 1, 64)
    cache = Ball()(torch.cartesian_prod(line, line, line))[0].reshape(1, 1, 64, 64, 64)
    return SimpleNamespace(cfg=config(**dict(samples=48) | changes), sdf=Ball(slope), deviation=lambda: torch.tensor(zeta),
                           color=lambda z: torch.zeros(len(z), 3), background=None, cache=cache, eps=0.01,
                           bg_color=torch.tensor([0.9, 0.1, 0.3]))


def ball_rays(n=40, seed=0):
    """Rays from outside the unit sphere at points near the ball, and the true distance to it (inf: misses)."""
    o = 3 * F.normalize(random(n, 3, seed=seed, low=-1, dtype=torch.float32), dim=1)
    target = CENTRE + random(n, 3, seed=seed + 1, low=-0.5, high=0.5, dtype=torch.float32)
    rays = sphere_rays(o.tolist(), (target - o).tolist())
    m = rays.o - CENTRE
    b = (m * rays.d).sum(1)
    disc = b ** 2 - (m * m).sum(1) + BALL_R ** 2
    return rays, torch.where(disc > 0, -b - disc.clamp(min=0).sqrt(), math.inf), disc


def test_weights_from_the_cache_of_a_plane_are_those_of_the_plane():
    """Trilinear lookups reproduce a linear field; a voxel's shift or swapped axes would show."""
    line, slopes = torch.linspace(-1, 1, 33), torch.tensor([0.3, -0.5, 0.8])
    cache = (torch.cartesian_prod(line, line, line) @ slopes - 0.1).reshape(1, 1, 33, 33, 33)
    rays = sphere_rays([(0.1, 0.2, -3)] * 3, [(0, 0.05, 1), (0.1, 0, 1), (-0.1, 0.1, 1)])
    rays = rays._replace(d=-rays.d, o=-rays.o)  # looking inwards
    edges = torch.linspace(2.2, 3.6, 41).expand(3, -1)
    s = (rays.o[:, None] + edges[:, :, None] * rays.d[:, None]) @ slopes - 0.1
    phi = torch.sigmoid(30.0 * s.double())
    want, _ = g.composite((1 - phi[:, 1:] / phi[:, :-1]).clamp(min=0))
    got = g.cached_weight(cache, rays, edges, 30.0)
    close(got, want, atol=1e-4)
    assert got.max() > 0.05


@pytest.mark.parametrize("sampling", ["cached", "uniform"])
def test_sections_are_sorted_and_tile_the_ray(sampling):
    rays, *_ = ball_rays()
    t0, t1, _ = g.sphere_interval(rays)
    edges = g.sample_sections(ball_model(sampling=sampling), rays, t0, t1, 16, torch.rand(40, 16))
    assert edges.shape == (40, 17) and (edges.diff(dim=1) >= -1e-6).all()
    assert torch.equal(edges[:, 0], t0) and torch.equal(edges[:, -1], t1)


def test_uniform_sampling_is_stratified():
    rays, *_ = ball_rays()
    t0, t1, _ = g.sphere_interval(rays)
    edges = g.sample_sections(ball_model(sampling="uniform"), rays, t0, t1, 9, torch.rand(40, 9))
    stratum = ((edges[:, 1:-1] - t0[:, None]) / (t1 - t0)[:, None] * 8).clamp(0, 7.999).floor()
    close(stratum, torch.arange(8).expand(40, 8))


def test_cached_samples_gather_where_the_cache_sees_the_surface():
    rays, depth, disc = ball_rays(80)
    t0, t1, _ = g.sphere_interval(rays)
    hits = disc > 0.02
    edges = g.sample_sections(ball_model(), rays, t0, t1, 32, torch.full((80, 32), 0.5))[hits, 1:-1]
    near = ((edges - depth[hits, None]).abs() < 0.15).float().mean(1)
    assert hits.sum() > 20 and near.min() > 0.6  # uniform samples: less than 0.2
    assert (~(near == 1)).any()  # and the floor keeps looking elsewhere


def test_jitter_moves_edges_within_their_stratum_and_in_its_direction():
    (rays, *_), model = ball_rays(), ball_model(sampling="uniform")
    t0, t1, _ = g.sphere_interval(rays)
    low, mid, high = (g.sample_sections(model, rays, t0, t1, 9, torch.full((40, 9), v))[:, 1:-1] for v in (0.0, 0.5, 1.0))
    close(mid, (low + high) / 2, atol=1e-5)
    close(low[:, 1:], high[:, :-1], atol=1e-5)
    assert (high > low).all()


def test_cached_samples_spread_over_a_voxel_however_sharp_the_surface():
    rays, depth, disc = ball_rays(80)
    t0, t1, _ = g.sphere_interval(rays)
    soft, sharp = (g.sample_sections(ball_model(zeta), rays, t0, t1, 32, torch.full((80, 32), 0.5)) for zeta in (64.0, 1e4))
    close(soft, sharp, atol=1e-5)


def test_cached_samples_of_an_empty_ray_are_uniform():
    rays = sphere_rays([(0, 0.9, -3)], [(0, 0, 1)])
    t0, t1, _ = g.sphere_interval(rays)
    edges = g.sample_sections(ball_model(), rays, t0, t1, 9, torch.full((1, 9), 0.5))[0]
    want = t0 + (t1 - t0) * (torch.arange(8) + 0.5) / 8
    close(edges[1:-1], want, atol=5e-3)


@pytest.mark.parametrize("mode", [dict(), dict(sampling="uniform", samples=256), dict(normals="fd")])
def test_rendering_a_known_ball_finds_its_depth_normal_and_silhouette(mode):
    rays, depth, disc = ball_rays()
    model = ball_model(**mode)
    out = g.render_rays(model, rays, torch.zeros(40, 0), torch.full((40, model.cfg.samples + 4), 0.5))
    hit, miss = disc > 0.02, disc < -0.02
    assert hit.sum() > 5 and miss.sum() > 5
    close(out["depth"][hit], depth[hit], atol=0.012)
    assert (out["opacity"][hit] > 0.99).all() and (out["opacity"][miss] < 0.01).all()
    normal = F.normalize(rays.o + depth[:, None] * rays.d - CENTRE, dim=1)
    close(out["normal"][hit], normal[hit], atol=0.05)
    close(out["rgb"][hit], torch.full((int(hit.sum()), 3), 0.5), atol=5e-3)
    close(out["rgb"][miss], model.bg_color.expand(int(miss.sum()), 3), atol=5e-3)
    close(out["depth"][miss], g.sphere_interval(rays)[1][miss], atol=0.02)
    assert (out["e_grad"] < 1e-3).all()  # a true distance has no eikonal error
    close(out["e_curv"][hit], torch.full((int(hit.sum()),), 2 / BALL_R * model.eps), rtol=0.05)


def test_rays_that_miss_the_sphere_show_the_background_and_nothing_else():
    model, rays = ball_model(), sphere_rays([(0, 5, -3), (0, 0, 3)], [(0, 0, 1), (0, 0, 1)])
    out = g.render_rays(model, rays, torch.zeros(2, 0), torch.rand(2, 52))
    close(out["rgb"], model.bg_color.expand(2, 3))
    assert (out["opacity"] == 0).all() and not out["hit"].any()
    close(out["depth"], [3, 0.1], atol=1e-3)


def test_background_is_asked_from_the_exit_of_the_sphere_and_shines_through_what_passes():
    model, (rays, _, disc) = ball_model(), ball_rays()
    asked = {}

    def background(rays, start, code, n, jitter):
        asked.update(start=start, n=n, jitter=jitter)
        return torch.ones(40, 3)
    model.background, jitter = background, torch.rand(40, 52)
    out = g.render_rays(model, rays, torch.zeros(40, 0), jitter)
    assert torch.equal(asked["start"], g.sphere_interval(rays)[1]) and asked["n"] == 4
    assert torch.equal(asked["jitter"], jitter[:, 48:])
    close(out["rgb"], (0.5 * out["opacity"] + 1 - out["opacity"])[:, None].expand(40, 3), atol=1e-5)


def test_the_colour_network_sees_feature_unit_normal_direction_and_code():
    model, (rays, _, _) = ball_model(slope=3.0), ball_rays()
    seen = []
    model.color = lambda z: (seen.append(z), torch.zeros(len(z), 3))[1]
    code = random(40, 5, dtype=torch.float32)
    g.render_rays(model, rays, code, torch.rand(40, 52))
    z = seen[0].reshape(40, 48, -1)
    assert z.shape[2] == g.GEO + 3 + 9 + 5
    close(z[..., 15:18].reshape(-1, 3), F.normalize(model.sdf.seen[0] - CENTRE, dim=1), atol=1e-5)
    close(z[..., 18:27], g.sh_basis(rays.d)[:, None].expand(-1, 48, -1))
    close(z[..., 27:], code[:, None].expand(-1, 48, -1))


def test_doubling_the_sdf_and_halving_zeta_changes_nothing_but_the_eikonal_error():
    (rays, *_), jitter = ball_rays(), torch.rand(40, 52)
    a, b = (g.render_rays(ball_model(zeta, slope, sampling="uniform"), rays, torch.zeros(40, 0), jitter)
            for zeta, slope in ((40.0, 1.0), (20.0, 2.0)))
    assert all(torch.allclose(a[k], b[k], atol=1e-4) for k in ("rgb", "opacity", "depth", "normal"))
    close(b["e_grad"], b["opacity"], atol=1e-4)  # (2 - 1)^2 where there is something to see
    close(b["eikonal"], torch.ones(40, 48), atol=1e-4)


@pytest.mark.parametrize("alpha", ["neus", "printed"])
def test_alpha_setting_selects_the_formula(alpha):
    (rays, _, disc), model = ball_rays(), ball_model(zeta=40.0, alpha=alpha, sampling="uniform", samples=400)
    out = g.render_rays(model, rays, torch.zeros(40, 0), torch.full((40, 404), 0.5))
    core = disc > 0.12
    assert core.sum() > 2
    assert ((out["opacity"][core] > 0.99) == (alpha == "neus")).all()


# ---- 6 mask and geometry preservation ------------------------------------------------------------------

def cgnet(seed=0):
    torch.manual_seed(seed)
    return g.CGNet()


def test_mask_network_returns_half_the_resolution_in_any_shape():
    assert cgnet()(torch.rand(2, 3, 32, 48)).shape == (2, 1, 16, 24)


@pytest.mark.parametrize("seed", range(4))
def test_mask_starts_small(seed):
    mask = torch.sigmoid(cgnet(seed)(random(4, 3, 48, 48, seed=seed, dtype=torch.float32)))
    assert 0.03 < mask.mean().item() < 0.2


def test_gradient_reaches_all_of_the_mask_network():
    net = cgnet()
    net(random(2, 3, 32, 32, dtype=torch.float32)).square().sum().backward()
    assert [n for n, p in net.named_parameters() if p.grad is None or not (p.grad != 0).any()] == []


def test_mask_is_read_at_the_right_pixel_of_the_right_photo():
    logits = random(3, 1, 4, 6, low=-3, high=3, dtype=torch.float32)
    i, j = torch.meshgrid(torch.arange(4), torch.arange(6), indexing="ij")
    uv = torch.stack([(j + 0.5) / 6, (i + 0.5) / 4], -1).reshape(-1, 2)  # u runs along the width
    close(g.mask_at(logits, uv.repeat(3, 1)), torch.sigmoid(logits).flatten())


def test_mask_between_pixels_is_bilinear_in_the_logits_and_constant_beyond_the_border():
    logits = torch.tensor([[[[0.0, 1], [2, 5]]]])
    uv = torch.tensor([[0.5, 0.25], [0.25, 0.5], [0.5, 0.5], [0.0, 0.0], [1.0, 1.0]])
    close(g.mask_at(logits, uv), torch.sigmoid(torch.tensor([0.5, 1, 2, 0, 5])))


def test_bimodality_is_a_pole_at_one_half():
    mask = torch.linspace(0, 1, 101)
    pole = torch.stack([g.bimodality(m[None]) for m in mask])
    close(pole, 1 / ((mask.double() - 0.5) ** 2 + 0.02), rtol=1e-4)
    assert pole.argmax() == 50


def errors(n=200, seed=0):
    return random(n, seed=seed, high=0.5, dtype=torch.float32), random(n, seed=seed + 1, high=0.5, dtype=torch.float32)


def test_literal_edge_indicator_marks_nothing_below_one_half():
    edge = g.edge_indicator(*errors(), 10.0, 2.0, None)
    assert (edge >= 0.5).all() and (edge <= 1).all()
    close(edge, torch.sigmoid(10 * errors()[0] + 2 * errors()[1]))


def test_calibrated_edge_indicator_is_half_at_its_centre_and_rises_with_both_errors():
    calibration, zero = torch.tensor([0.4, 0.1]), torch.zeros(9)
    rising = torch.linspace(0, 0.1, 9)
    assert g.edge_indicator(torch.tensor([0.04]), torch.zeros(1), 10.0, 2.0, calibration).item() == pytest.approx(0.5)
    assert g.edge_indicator(torch.zeros(1), torch.tensor([0.25]), 10.0, 2.0, calibration).item() == \
        pytest.approx(sigmoid(1.0), abs=1e-6)
    assert (g.edge_indicator(rising, zero, 10.0, 2.0, calibration).diff() > 0).all()
    assert (g.edge_indicator(zero, rising, 10.0, 2.0, calibration).diff() > 0).all()


@pytest.mark.parametrize("calibration", [None, torch.tensor([0.4, 0.1])])
def test_edge_indicator_sends_no_gradient_to_the_geometry(calibration):
    e_grad, e_curv = (e.requires_grad_() for e in errors())
    assert not g.edge_indicator(e_grad, e_curv, 10.0, 2.0, calibration).requires_grad


def test_gpl_loss_is_the_mean_product():
    mask, edge = errors()
    assert g.gpl_loss(mask, edge).item() == pytest.approx(
        sum(m * e for m, e in zip(mask.tolist(), edge.tolist())) / 200, rel=1e-5)


def test_calibration_converges_to_the_quantiles_of_the_batch():
    x, calibration = random(1001, high=3.0, dtype=torch.float32) ** 2, torch.tensor([0.0, 1.0])
    q = np.quantile(x.numpy(), [0.5, 0.75, 0.95])
    g.calibrate(x, calibration)
    close(calibration, [0.05 * q[1], 0.95 + 0.05 * (q[2] - q[0]) / 4], rtol=1e-4)
    for _ in range(400):
        g.calibrate(x, calibration)
    close(calibration, [q[1], (q[2] - q[0]) / 4], rtol=1e-3)


def test_calibration_of_equal_signals_keeps_a_positive_width():
    calibration = torch.tensor([0.0, 1.0])
    for _ in range(2000):
        g.calibrate(torch.full((64,), 0.7), calibration)
    close(calibration, [0.7, 1e-3], rtol=1e-3)


@pytest.mark.parametrize("x", [[0.0], [0.3], [0.7] * 9, [0.0, 1e30], [1e-30, 1e-30, 5.0],
                               [math.inf, 0.2, math.nan]])
def test_calibration_and_edges_are_finite(x):
    """Of one ray, of equal rays, and beyond anything that a field can produce."""
    x, calibration = torch.tensor(x), torch.tensor([0.0, 1.0])
    for _ in range(300):
        g.calibrate(x, calibration)
    edge = g.edge_indicator(x, x, 10.0, 2.0, calibration)[x.isfinite()]
    assert torch.isfinite(calibration).all() and calibration[1] >= 1e-3
    assert ((edge >= 0) & (edge <= 1)).all()


@pytest.mark.parametrize("logit", [-1e4, -100.0, 0.0, 100.0, 1e4])
@pytest.mark.parametrize("seen", [-1.0, 0.0, 0.2, 1.0])
def test_mask_losses_and_gradients_are_finite(warm, logit, seen):
    """Nothing seen yet, no error, usual and largest errors; masks all off, unsure, all on."""
    model = copy.deepcopy(warm)
    model.seen.fill_(seen)
    model.cgnet = FreeLogits((1, 1, 16, 16))
    model.cgnet.logits.data.fill_(logit)
    mask = g.mask_at(model.cgnet.logits, random(9, 2, dtype=torch.float32))
    loss = model.mask_objective(torch.tensor([0])) + g.gpl_loss(mask, mask) + g.bimodality(mask)
    loss.backward()
    assert math.isfinite(loss.item()) and torch.isfinite(model.cgnet.logits.grad).all()


# ---- 7 model and objective -----------------------------------------------------------------------------

def test_random_ball_is_uniform():
    x = g.random_ball(20_000, generator())
    r = x.norm(dim=1)
    assert (r <= 1).all()
    share = np.histogram(r ** 3, np.linspace(0, 1, 11))[0] / 20_000  # sd 0.0021
    close(share, np.full(10, 0.1), atol=0.012, rtol=0)
    close(x.mean(0), torch.zeros(3), atol=0.02)


def test_every_parameter_is_in_exactly_one_optimiser_group(warm):
    ids = [id(p) for group in warm.groups() for p in group["params"]]
    assert sorted(ids) == sorted(id(p) for p in warm.parameters())


def test_warm_up_makes_a_sphere(warm):
    x = g.random_ball(4000, generator(5))
    with torch.no_grad():
        error = warm.sdf(x)[0] - (x.norm(dim=1) - 0.5)
    assert error.square().mean().sqrt() < 0.02


def test_cache_is_the_sdf_on_its_grid(warm):
    n = warm.cache.shape[-1]
    for i, j, k in ((0, 0, 0), (5, 17, 40), (n - 1, 3, n - 2)):
        x = torch.tensor([[i, j, k]]) * 2 / (n - 1) - 1
        assert warm.cache[0, 0, i, j, k].item() == pytest.approx(warm.sdf(x)[0].item(), abs=1e-5)


def test_maintenance_refreshes_each_slice_of_the_cache_once_in_64_steps(warm):
    model, n, done = copy.deepcopy(warm), warm.cache.shape[-1], []
    model.refresh_cache = lambda part, parts: done.extend(range(part, n, parts))
    for step in range(64):
        model.maintain(step, 0.0, None)
    assert sorted(done) == list(range(n))


def test_refreshing_a_part_of_the_cache_leaves_the_rest(warm):
    model = copy.deepcopy(warm)
    model.cache.fill_(7)
    model.refresh_cache(3, 8)
    fresh = (model.cache[0, 0] != 7).all(2).all(1)
    assert fresh.nonzero()[:, 0].tolist() == list(range(3, model.cache.shape[-1], 8))
    assert torch.equal(model.cache[0, 0, 3::8], warm.cache[0, 0, 3::8])


@pytest.mark.parametrize("changes", [dict(), dict(normals="fd"), dict(sampling="uniform"), dict(alpha="printed"),
                                     dict(gpl="literal"), dict(mask="off")])
def test_every_loss_and_gradient_is_finite(warm, scene, changes):
    model = copy.deepcopy(warm)
    model.cfg, model.use_mask = config(**changes), changes.get("mask") != "off"
    total, logs = model.losses(*batch(scene), generator())
    total.backward()
    assert all(math.isfinite(float(v)) for v in (total.detach(), *logs.values()))
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


class Operations(TorchDispatchMode):
    """Names of all operations that run inside, and of those that copy from one device to another."""
    def __init__(self):
        super().__init__()
        self.names, self.copies = [], []

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        name, kwargs = operation.overloadpacket.__name__, kwargs or {}
        self.names.append(name)
        if name == "_to_copy" and kwargs.get("device", args[0].device) != args[0].device:
            self.copies.append(args)
        return operation(*args, **kwargs)


WAITS = {"_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "_unique2", "unique_dim"}


@pytest.mark.parametrize("method", ["geonvsw", "nerfw", "hanerf"])
def test_a_step_never_asks_a_gpu_for_a_value(scene, brief, method):
    """What would make the host wait, on any device: item(), nonzero() and their kin."""
    model = g.GeoNVS(config(), scene) if method == "geonvsw" else baseline(scene, method)
    model.step, model.refined = 4, 5  # a step with the mask network and without refinement
    optimizer, photos = g.make_optimizer(model), scene.photos(False)
    with Operations() as seen:
        g.training_step(model, optimizer, photos, dict(step=4), 0.5, generator())
        assert len(seen.names) > 100 and not WAITS & set(seen.names)
        photos[0].item()
    assert WAITS & set(seen.names)


@pytest.mark.parametrize("changes", [dict(), dict(normals="fd")])
def test_a_step_copies_nothing_between_devices(scene, monkeypatch, changes):
    """The meta device computes shapes alone; whatever still lies on the CPU has to be copied to it."""
    model, meta = g.GeoNVS(config(**changes), scene).to("meta"), torch.device("meta")
    model.scene = scene._replace(**{k: v.to(meta) for k, v in scene._asdict().items() if torch.is_tensor(v)})
    model.step, model.sfm = 4, model.sfm.to(meta)
    for octree in model.octrees():
        octree.child, octree.corner = octree.child.to(meta), octree.corner.to(meta)
    for draw in ("rand", "randn", "randint"):  # a generator cannot live there
        monkeypatch.setattr(torch, draw, lambda *a, generator, _draw=getattr(torch, draw), **k: _draw(*a, **k))
    monkeypatch.setattr(torch, "autocast", lambda *a, **k: contextlib.nullcontext())

    def step():
        rays, pick = model.batch(torch.arange(6, device=meta), SimpleNamespace(device=meta))
        model.losses(rays, pick, SimpleNamespace(device=meta))[0].backward()
    step()  # constants become resident
    with Operations() as seen:
        step()
        assert len(seen.names) > 500 and not seen.copies
        g.TRILINEAR.to(meta)
    assert len(seen.copies) == 1


@pytest.mark.parametrize("normals", ["analytic", "fd"])
@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_mixed_precision_changes_the_losses_little_and_nothing_to_nan(warm, scene, kind, normals):
    (rays, pick), found = batch(scene), []
    for use_amp in (False, True):
        model = copy.deepcopy(warm)
        model.cfg = config(normals=normals)
        with torch.autocast("cpu", kind, enabled=use_amp):
            total, logs = model.losses(rays, pick, generator())
        total.backward()
        assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)
        found.append(logs | dict(total=total))
    close(*(f["total"] for f in found), rtol=0.05)
    close(*(f["rgb"] for f in found), rtol=0.05)
    assert all(found[0][k] == found[1][k] for k in "eik curv off sfm opacity".split())  # [D9]


def constant_sdf(model, value):
    with torch.no_grad():
        model.sdf.lin2.weight.zero_()
        model.sdf.lin2.bias.fill_(value)
    model.refresh_cache(0, 1)
    return model


def losses_are_finite(model, rays, pick):
    model.zero_grad()
    total, logs = model.losses(rays, pick, generator())
    total.backward()
    grads = [p.grad for p in model.parameters() if p.grad is not None]
    return all(torch.isfinite(v).all() for v in (total, *logs.values(), *grads))


@pytest.mark.parametrize("normals", ["analytic", "fd"])
@pytest.mark.parametrize("zeta", [1e-2, 1e5])
@pytest.mark.parametrize("value", [-1e4, -1e-4, 0.0, 1e4])
def test_a_constant_sdf_has_finite_losses_at_any_sharpness(warm, scene, value, zeta, normals):
    model = constant_sdf(copy.deepcopy(warm), value)
    model.cfg, model.deviation = config(normals=normals), g.Deviation(zeta)
    assert losses_are_finite(model, *batch(scene))


@pytest.mark.parametrize("logit", [-1e4, 1e4])
def test_a_batch_that_is_all_masked_or_not_at_all_has_finite_losses(warm, scene, logit):
    model = copy.deepcopy(warm)
    model.logits.fill_(logit)
    model.step = 1  # no new opinion in this step
    assert losses_are_finite(model, *batch(scene))
    _, logs = model.losses(*batch(scene), generator())
    assert float(logs["mask"]) == (logit > 0) and (float(logs["rgb"]) > 0) == (logit < 0)


def test_one_photo_and_the_smallest_batch_train(arrays):
    """One photo, one ray to look at, the two rays that --rays asks for at least."""
    n = int(arrays["start"][1])
    one = {k: arrays[k][:1] for k in ("wh", "K", "c2w", "near", "name")}
    one |= dict(rgb=arrays["rgb"][:n], start=arrays["start"][:2], is_test=np.zeros(1, bool))
    one |= {k: arrays[k][arrays["track_photo"] == 0] for k in ("track_photo", "track_point")}
    scene = g.load_scene(arrays | one, "cpu", 32)
    model = new_model(scene, photos=1, rays=2)
    rays, pick = model.batch(scene.photos(False), generator())
    assert len(rays.o) == 2 and losses_are_finite(model, rays, pick)
    out = model.render(g.Rays(*[v[:1] for v in rays]), model.codes()[:1])
    assert all(torch.isfinite(v).all() for v in out.values())


@pytest.mark.parametrize("value", [0, 127, 255])
def test_photos_of_one_colour_are_a_scene(arrays, value):
    """All black, all grey, all white: statistics, losses and scores are finite."""
    flat = data_prep.statistics(arrays | dict(rgb=np.full_like(arrays["rgb"], value)))
    scene = g.load_scene(flat, "cpu", 32)
    assert flat["exposure_spread"] == 0 and 0 < flat["footprint"] < math.inf
    close(flat["bg_color"], [value / 255] * 3)
    model = new_model(scene, mask="on")
    assert losses_are_finite(model, *batch(scene))
    rows = g.evaluate(model, scene, model.cfg, None)["per_image"]
    assert all(math.isfinite(row[k]) for row in rows for k in ("psnr", "ssim", "psnr_floor"))


def tuned(warm, logit=0.5, **changes):
    """A copy whose remembered masks are worth the name."""
    model = copy.deepcopy(warm)
    model.cfg = config(**changes)
    model.logits.copy_(random(*model.logits.shape, low=logit - 1, high=logit + 1, dtype=torch.float32))
    return model


WEIGHTS = "eik curv lps off sfm".split()


@pytest.mark.parametrize("step", [0, 1, 4])
def test_the_objective_is_the_weighted_sum_of_its_terms(warm, scene, step):
    more = {f"lam_{k}": v for k, v in zip(WEIGHTS, (0.3, 0.7, 0.11, 0.9, 0.5))}
    model, (rays, pick) = tuned(warm, **more), batch(scene)
    model.step, again = step, copy.deepcopy(model)
    total, raw = model.losses(rays, pick, generator())
    again.seen.copy_(model.seen)  # mask_objective moves what is usual: once each
    want = float(raw["rgb"]) + sum(more[f"lam_{k}"] * float(raw[k]) for k in WEIGHTS)
    if step % model.cfg.mask_every == 0:
        want += again.mask_objective(pick).item()
    assert total.item() == pytest.approx(want, rel=1e-5)


def test_raw_terms_of_a_constant_sdf_are_known(warm, scene):
    """s = 0.03 everywhere: no slope, no curvature, no opacity; only the background is seen."""
    model = copy.deepcopy(warm)
    with torch.no_grad():
        model.sdf.lin2.weight.zero_()
        model.sdf.lin2.bias.fill_(0.03)
    _, raw = model.losses(*batch(scene), generator())
    want = dict(eik=1.0, curv=0.0, off=math.exp(-1.5), sfm=0.03, opacity=0.0, mask=sigmoid(-9.0), gpl=0.0, zeta=20.0,
                lps=model.color.bounds().log().sum().item())
    for key, value in want.items():
        assert float(raw[key]) == pytest.approx(value, rel=1e-4, abs=1e-6), key


def test_the_rgb_term_is_the_unmasked_share_of_the_l1_error(warm, scene):
    model, (rays, pick), gen = tuned(warm), batch(scene), generator()
    model.step = 1  # no new logits in this step
    _, raw = model.losses(rays, pick, generator())
    out = g.render_rays(model, rays, model.appearance(rays.img), torch.rand(64, 12, generator=gen))
    mask = g.mask_at(model.logits[pick], rays.uv)
    error = (out["rgb"] - rays.rgb).abs().mean(1)
    assert float(raw["rgb"]) == pytest.approx(((1 - mask) * error).mean().item(), rel=1e-4)
    assert float(raw["mse"]) == pytest.approx(((out["rgb"] - rays.rgb) ** 2).mean().item(), rel=1e-4)
    assert float(raw["mask"]) == pytest.approx(mask.mean().item(), rel=1e-4) and 0.3 < mask.mean() < 0.8


@pytest.mark.parametrize("gpl", ["calibrated", "literal"])
def test_gpl_and_curvature_terms_equal_their_definitions(warm, scene, gpl):
    model, (rays, pick) = tuned(warm, gpl=gpl, lam_grad=3.0, lam_lap=7.0), batch(scene)
    model.step, before = 1, model.calibration.clone()
    _, raw = model.losses(rays, pick, generator())
    out = g.render_rays(model, rays, model.appearance(rays.img), torch.rand(64, 12, generator=generator()))
    signal = (3 * out["e_grad"] + 7 * out["e_curv"]).detach()
    g.calibrate(signal, before)
    close(model.calibration, before)
    phi = torch.sigmoid(signal if gpl == "literal" else (signal - before[0]) / before[1])
    want = (g.mask_at(model.logits[pick], rays.uv) * phi * out["opacity"]).mean().item()
    assert raw["gpl"].item() == pytest.approx(want, rel=1e-4)
    assert raw["curv"].item() == pytest.approx(out["e_curv"].mean().item(), rel=1e-4)


def test_derivatives_are_taken_over_half_the_finest_cell_there_is(scene):
    model = new_model(scene, levels=6)
    octree = model.sdf.octree
    assert len(octree.cells[2]) and not len(octree.cells[3])
    assert model.eps == pytest.approx(octree.cell(2) / 2)
    octree.split(2, octree.cells[2][:1])
    assert model.eps == pytest.approx(octree.cell(3) / 2)


@pytest.mark.parametrize("normals", ["analytic", "fd"])
def test_the_curvature_loss_flattens_and_does_not_hide(warm, scene, normals):
    """It would pay to turn curved places transparent."""
    model, (rays, _) = tuned(warm, normals=normals, sampling="uniform"), batch(scene)
    out = g.render_rays(model, rays, model.appearance(rays.img), torch.full((64, 12), 0.5))
    out["e_curv"].sum().backward()
    assert model.deviation.v.grad is None and model.sdf.octree.features.grad.abs().sum() > 0


def test_the_mask_does_not_act_when_it_is_off(warm, scene):
    model = tuned(warm)
    model.use_mask = False
    total, raw = model.losses(*batch(scene), generator())
    total.backward()
    assert float(raw["mask"]) == 0 and all(p.grad is None for p in model.cgnet.parameters())
    assert (model.seen == warm.seen).all()


def test_eikonal_term_counts_only_rays_that_meet_the_sphere(warm, scene):
    rays, pick = batch(scene)
    away = rays._replace(d=torch.where(torch.arange(64)[:, None] % 2 == 0, rays.d, -rays.d))
    eik = []
    for r in (rays, g.Rays(*[v[::2] for v in rays]), away):
        model = copy.deepcopy(warm)
        model.cfg = config(sampling="uniform")
        jitter = torch.full((len(r.o), 12), 0.5)
        out = g.render_rays(model, r, model.appearance(r.img), jitter)
        eik.append((out["eikonal"].mean(1) * out["hit"]).sum() / out["hit"].sum())
    close(eik[1], eik[2])
    gen = generator()
    out = g.render_rays(warm, away, warm.appearance(away.img), torch.rand(64, 12, generator=generator()))
    _, raw = copy.deepcopy(warm).losses(away, pick, gen)
    hit = out["hit"]
    assert 0 < hit.sum() <= 32 and float(raw["eik"]) == pytest.approx(out["eikonal"][hit].mean().item(), rel=1e-4)


def test_off_surface_and_sfm_terms_equal_their_definitions(warm, scene):
    gen = generator()
    torch.rand(64, 12, generator=gen)
    points = warm.sfm[torch.randint(len(warm.sfm), (32,), generator=gen)]
    ball = g.random_ball(32, gen)
    _, raw = copy.deepcopy(warm).losses(*batch(scene), generator())
    assert float(raw["off"]) == pytest.approx((-50 * warm.sdf(ball)[0].abs()).exp().mean().item(), rel=1e-4)
    assert float(raw["sfm"]) == pytest.approx(warm.sdf(points)[0].abs().mean().item(), rel=1e-4)


def test_errors_are_remembered_where_the_mask_network_looks_for_them(warm, scene):
    model, (rays, _) = copy.deepcopy(warm), batch(scene)
    rays = rays._replace(img=torch.tensor([3, 5]), uv=torch.tensor([[0.9, 0.1], [0.0, 1.0]]))  # u along the width
    model.seen.fill_(-1)
    model.remember(rays, torch.tensor([[0.7, -0.6, 0.5], [-0.2, 0.3, 0.0]]), torch.tensor([0.4, 0.1]))
    m = model.seen.shape[-1]
    close(model.seen[3, :, m // 10, 9 * m // 10], [0.7, -0.6, 0.5, 0.4])
    close(model.seen[5, :, m - 1, 0], [-0.2, 0.3, 0.0, 0.1])
    assert (model.seen[:, 3] >= 0).sum() == 2


def test_a_step_remembers_residuals_with_their_signs(warm, scene):
    """Of absolute values nothing would cancel out, and blur would be taken for people."""
    model, (rays, pick) = copy.deepcopy(warm), batch(scene)
    model.losses(rays, pick, generator())
    out = g.render_rays(model, rays, model.appearance(rays.img), torch.rand(64, 12, generator=generator()))
    m = model.seen.shape[-1]
    col, row = (rays.uv * m).long().unbind(1)
    got, want = model.seen[rays.img, :3, row, col], (out["rgb"] - rays.rgb).detach()
    once = ((got - want).abs() < 1e-5).all(1)  # of two rays into one place the later one stays
    assert once.float().mean() > 0.8 and (want[once] < -0.01).any() and (want[once] > 0.01).any()


def test_where_rays_ended_is_remembered_with_what_the_mask_does_not_explain(warm, scene):
    model, (rays, pick), jitter = tuned(warm), batch(scene), torch.rand(64, 12, generator=generator())
    n = len(model.hits) // 64
    mask = g.mask_at(model.logits[pick], rays.uv)
    for model.step in (1, 3, n + 3):  # after n steps the slots are filled anew
        model.hits.fill_(2)
        model.losses(rays, pick, generator())
        out = g.render_rays(model, rays, model.appearance(rays.img), jitter)
        error = (1 - mask) * (out["rgb"] - rays.rgb).abs().mean(1)
        slot = model.step % n * 64
        pixel = out["depth"] / scene.K[rays.img, 0]
        close(model.hits[slot:slot + 64], torch.cat([out["x"], torch.stack([error, pixel], 1)], 1), atol=1e-5)
        assert (model.hits[:, 0] < 2).sum() == 64
        close(out["x"], rays.o + out["depth"][:, None] * rays.d, atol=1e-5)


def test_level_is_the_running_lower_quartile_of_the_error(warm, scene):
    model, (rays, pick) = copy.deepcopy(warm), batch(scene)
    model.level.fill_(5.0)
    model.losses(rays, pick, generator())
    out = g.render_rays(model, rays, model.appearance(rays.img), torch.rand(64, 12, generator=generator()))
    quartile = np.quantile((out["rgb"] - rays.rgb).abs().mean(1).detach().numpy(), 0.25)
    assert model.level.item() == pytest.approx(0.98 * 5 + 0.02 * quartile, rel=1e-5)


def price_of_masking(model, error, edge):
    """What M = 1 costs a pixel: intensity, threshold of usual errors and GPL, less the error that it saves."""
    return model.cfg.lam_mask + model.usual.item() + model.cfg.lam_gpl * edge - error


def test_the_mask_objective_equals_a_naive_loop_over_what_is_known(warm):
    model, pick = tuned(warm, lam_gpl=0.3, lam_mask=0.1, lam_bimodal=1e-2), torch.tensor([2, 0])
    known, static = random(2, 16, 16, seed=1) < 0.6, random(2, 16, 16, seed=4) < 0.2
    model.usual.fill_(0.05)
    model.static[pick] = static[:, None]
    residual, edge = random(2, 3, 16, 16, seed=2) * 2 - 1, random(2, 1, 16, 16, seed=3)
    model.seen[pick] = torch.where(known[:, None], torch.cat([residual, edge], 1), -1.0).float()
    logits = model.cgnet(model.scene.thumbs[pick].float() / 255)[:, 0]
    want, n, errors = 0.0, 2 * 16 * 16, np.full((2, 16, 16), np.nan)
    for b, i, j in itertools.product(range(2), range(16), range(16)):
        around = (b, slice(max(i - 1, 0), i + 2), slice(max(j - 1, 0), j + 2))
        if known[b, i, j]:
            errors[b, i, j] = max(abs(c[around][known[around]].mean().item()) for c in residual.unbind(1))  # signed
    got = model.mask_objective(pick).item()
    assert model.usual.item() == pytest.approx(
        0.9 * 0.05 + 0.1 * np.quantile(errors[(known & static).numpy()], 0.75), rel=1e-4)
    for b, i, j in itertools.product(range(2), range(16), range(16)):
        logit = logits[b, i, j].item()
        if known[b, i, j]:  # worth masking where the price of M is negative
            price = price_of_masking(model, errors[b, i, j] * (not static[b, i, j]), edge[b, 0, i, j].item())
            want += abs(price) * math.log1p(math.exp(logit if price > 0 else -logit)) / n
        want += 1e-2 / ((sigmoid(logit) - 0.5) ** 2 + 0.02) / n
    assert got == pytest.approx(want, rel=1e-4)
    close(model.logits[pick][:, 0], logits.detach(), atol=1e-5)


class FreeLogits(nn.Module):
    """Stands in for the mask network: every pixel's logit is its own, from the 8 % that CGNet starts with."""

    def __init__(self, shape):
        super().__init__()
        self.logits = nn.Parameter(torch.full(shape, -2.5))

    def forward(self, photo):
        return self.logits


def nobody_tracked(model, usual):
    """No photo shows an SfM point, and `usual` is what the scene errs by."""
    model.static.fill_(False)
    model.usual.fill_(usual)
    return model


def test_a_pixel_is_masked_when_its_error_is_above_its_price_and_only_then(warm):
    model, pick = nobody_tracked(tuned(warm, lam_gpl=0.05, lam_mask=0.06), 0.06), torch.tensor([0])
    model.cgnet = FreeLogits((1, 1, 16, 16))
    model.seen[0, :3], model.seen[0, 3] = torch.linspace(0, 0.5, 16)[:, None], 0.0
    model.seen[0, 3, :, 8:] = 1.0
    adam = torch.optim.Adam(model.cgnet.parameters(), lr=0.1)
    for _ in range(300):
        adam.zero_grad()
        model.mask_objective(pick).backward()
        adam.step()
    _, _, error, edge = model.seen[0]
    excess, mask = -price_of_masking(model, error, edge), torch.sigmoid(model.cgnet.logits[0, 0])
    assert (mask[excess > 0.02] > 0.95).all() and (mask[excess < -0.02] < 0.05).all()
    assert ((excess > 0.02).sum(0) > 8).all() and ((excess < -0.02).sum(0) > 2).all()


def mask_gradient(warm, usual=0.0, **changes):
    """Gradient at the bias of the mask where all errors are 0.1 and all edges are certain."""
    model, pick = tuned(warm, **dict(lam_gpl=0.0, lam_mask=0.0, lam_bimodal=0.0) | changes), torch.tensor([0, 1])
    nobody_tracked(model, usual)
    model.seen[:, :3], model.seen[:, 3] = 0.1, 1.0
    model.mask_objective(pick).backward()
    return model.cgnet.heads[0].bias.grad.item()


def test_error_raises_the_mask_and_its_price_and_gpl_hold_it_back(warm):
    assert mask_gradient(warm) < 0
    assert mask_gradient(warm, lam_mask=0.1) == pytest.approx(0, abs=1e-6)  # the threshold itself
    assert mask_gradient(warm, lam_mask=0.2) > 0 < mask_gradient(warm, lam_gpl=0.2)
    assert mask_gradient(warm, usual=0.2) > 0  # where such errors are usual


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_pixels_that_show_sfm_points_are_not_masked_and_say_which_errors_are_usual(warm, share):
    """All pixels err by 0.3, SfM points are seen in a share of them: none of those is masked, the others are as
    long as no such error is known to be the scene's own."""
    model, pick = nobody_tracked(tuned(warm, lam_gpl=0.0), 0.02), torch.tensor([0])
    model.static[0, 0] = static = random(16, 16) < share
    model.cgnet = FreeLogits((1, 1, 16, 16))
    model.seen[0, :3], model.seen[0, 3] = 0.3, 0.0
    masks, adam = [], torch.optim.Adam(model.cgnet.parameters(), lr=0.3)
    for _ in range(200):
        adam.zero_grad()
        model.mask_objective(pick).backward()
        adam.step()
        masks.append(model.cgnet.logits.detach()[0, 0].sigmoid())
    assert (masks[-1][static] < 0.05).all()
    assert model.usual.item() == pytest.approx(0.3 if share else 0.02, abs=1e-4)
    assert (masks[-1][~static] > 0.9).all() if share == 0 else (masks[-1][~static] < 0.05).all()


def test_sightings_are_where_the_cameras_see_the_points(scene):
    """Against OpenCV's projection."""
    img, x, uv = scene.sightings()
    raw, n = scene.raw, len(img)
    assert 0.9 * len(raw["track_photo"]) < n <= len(raw["track_photo"]) and ((uv >= 0) & (uv < 1)).all()
    for k in range(0, n, max(1, n // 50)):
        i, K, w2c = img[k].item(), np.eye(3), np.eye(4)
        K[[0, 1, 0, 1], [0, 1, 2, 2]] = raw["K"][i]
        w2c[:3] = raw["c2w"][i]
        w2c = np.linalg.inv(w2c)
        px, _ = cv2.projectPoints(x[k].numpy().astype(float)[None], cv2.Rodrigues(w2c[:3, :3])[0], w2c[:3, 3], K, None)
        close(uv[k], px[0, 0] / raw["wh"][i], atol=1e-4)


def test_sightings_with_unequal_focal_lengths_and_on_the_border(scene):
    n, (w, h) = len(scene.K), scene.wh[0].tolist()
    K, c2w = torch.tensor([[20.0, 40, 8, 24]]).expand(n, -1), torch.eye(3, 4).expand(n, -1, -1)
    px = torch.tensor([[0.0, 0], [w / 4, h / 2], [w, h / 2], [w / 2, h], [w / 2, -1], [-1, h / 2]])
    points = torch.cat([(px - K[:1, 2:]) / K[:1, :2], torch.ones(6, 1)], 1)
    tracks = dict(track_photo=np.zeros(6, np.int32), track_point=np.arange(6, dtype=np.int32))
    uv = scene._replace(K=K, c2w=c2w, points=points, raw=scene.raw | tracks).sightings()[2]
    close(uv, [[0, 0], [0.25, 0.5]], atol=1e-6)


def test_at_first_all_is_wrong_and_nothing_is_masked(warm, scene):
    model = copy.deepcopy(warm)
    model.losses(*batch(scene), generator())[0].backward()
    assert model.cgnet.heads[0].bias.grad.item() > 0


def test_the_source_has_no_star_in_a_subscript():
    """Python 3.10 does not know it."""
    tree = ast.parse(Path(g.__file__).read_text())
    assert not [n.lineno for n in ast.walk(tree) if isinstance(n, ast.Subscript)
                for e in getattr(n.slice, "elts", ()) if isinstance(e, ast.Starred)]


def test_observations_that_sfm_got_wrong_are_no_sightings(scene):
    """Behind the camera, outside of the photo, in the camera's own plane."""
    c2w, raw = scene.c2w[0], scene.raw
    local = torch.tensor([[0, 0, -2.0], [9.0, 0, 1.0], [0.1, 0, 0.0], [0, 0, 2.0]])
    points = local @ c2w[:, :3].T + c2w[:, 3]
    bent = scene._replace(points=points, raw=raw | dict(track_photo=np.zeros(4, np.int32), track_point=np.arange(4)))
    img, x, uv = bent.sightings()
    close(x, points[3:], atol=1e-6)
    close(uv[0] * scene.wh[0], scene.K[0, 2:], atol=1e-3)


def test_the_mask_network_is_told_where_sfm_points_are_seen(scene):
    """Row and column of the small map, per photo."""
    model = new_model(scene)
    img, _, uv = scene.sightings()
    m, want = model.static.shape[-1], torch.zeros_like(model.static)
    for i, (u, v) in zip(img.tolist(), uv.tolist()):
        want[i, 0, int(v * m), int(u * m)] = True
    assert torch.equal(model.static, want) and 0.02 < want.float().mean() < 0.9


def test_the_mask_learns_from_errors_but_the_geometry_never_from_the_mask(warm, scene):
    grads = []
    for lam in (0.0, 5.0):
        model = tuned(warm, lam_gpl=lam)
        total, _ = model.losses(*batch(scene), generator())
        total.backward()
        grads.append((model.sdf.lin1.weight.grad, model.cgnet.heads[0].bias.grad))
    assert torch.equal(grads[0][0], grads[1][0])
    assert grads[1][1].item() > grads[0][1].item()


def test_the_mask_of_rays_is_the_networks_opinion_or_zero(warm, scene):
    model, (rays, pick) = copy.deepcopy(warm), batch(scene)
    close(model.mask_of(rays, pick), g.mask_at(model.cgnet(scene.thumbs[pick].float() / 255), rays.uv))
    model.use_mask = False
    assert torch.equal(model.mask_of(rays, pick), torch.zeros(64))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_one_bad_batch_does_not_poison_what_the_model_remembers(warm, scene, monkeypatch, value):
    model, render = copy.deepcopy(warm), g.render_rays
    bad = {"e_grad", "e_curv", "rgb", "x"}
    monkeypatch.setattr(g, "render_rays", lambda *a: {k: v * value if k in bad else v for k, v in render(*a).items()})
    model.losses(*batch(scene), generator())
    monkeypatch.setattr(g, "render_rays", render)
    model.step += 1
    total, _ = model.losses(*batch(scene, seed=1), generator(1))
    assert math.isfinite(total.item())
    assert all((b.float().abs() < 1e15).all() for b in model.buffers())


def new_model(scene, seed=0, **changes):
    torch.manual_seed(seed)
    return g.GeoNVS(config(seed=seed, **changes), scene)


def with_facts(scene, **facts):
    return scene._replace(raw=scene.raw | {k: np.array(v) for k, v in facts.items()})


def test_appearance_off_costs_no_numbers(scene):
    model = new_model(scene, appearance="off")
    total, _ = model.losses(*batch(scene), generator())
    assert model.codes().numel() == 0 and math.isfinite(total.item())


def test_background_off_shows_one_colour(scene):
    model = new_model(scene, background="off")
    rays, pick = batch(scene)
    out = model.render(rays, model.appearance(rays.img))
    assert model.background is None and len(model.octrees()) == 1
    miss = ~out["hit"]
    assert miss.any()
    close(out["rgb"][miss], model.bg_color.expand(int(miss.sum()), 3))


def test_a_scene_without_points_works(scene):
    none = np.zeros(0, np.int32)
    bare = scene._replace(points=scene.points[:0], raw=scene.raw | dict(track_photo=none, track_point=none))
    model = new_model(bare)
    total, raw = model.losses(*batch(bare), generator())
    total.backward()
    assert math.isfinite(total.item()) and float(raw["sfm"]) == 0


def test_one_exposure_and_one_background_colour_switch_their_parts_off(scene):
    model = new_model(with_facts(scene, exposure_spread=0.001, bg_color=[0.2, 0.4, 0.6]))
    assert model.codes().shape[1] == 0 and model.background is None
    close(model.bg_color, [0.2, 0.4, 0.6])
    model = new_model(with_facts(scene, exposure_spread=0.1, bg_color=[math.nan] * 3))
    assert model.codes().shape[1] == 4 and model.background is not None


def test_settings_overrule_what_the_scene_needs(scene):
    model = new_model(with_facts(scene, exposure_spread=0.0, bg_color=[0.2] * 3), appearance="on", background="on")
    assert model.codes().shape[1] == 4 and model.background is not None


def test_levels_come_from_the_footprint_unless_given(scene):
    assert new_model(with_facts(scene, footprint=0.03), levels=0).sdf.octree.levels == g.levels_for_footprint(0.03)


def test_appearance_changes_colours_and_never_the_geometry(warm, scene):
    rays, _ = batch(scene)
    a, b = (warm.render(rays, torch.full((64, 4), v)) for v in (-2.0, 2.0))
    assert (a["rgb"] != b["rgb"]).any()
    assert all(torch.equal(a[k], b[k]) for k in ("depth", "opacity", "normal"))


class Refinable(SimpleNamespace):
    """What GeoNVS.refine needs: a tree, the SDF of the ball, remembered hits and an optimiser."""


def refinable(levels=4, zeta=1e9, **changes):
    octree = g.Octree(1.0, levels, 2, root=8)
    g.seed_octree(octree, torch.zeros(0, 3), 2, (0.0, 0.9))  # levels 0 and 1 split everywhere
    model = Refinable(cfg=config(**changes), sdf=Ball(), hits=torch.full((64, 5), 2.0), refined=4,
                      level=torch.tensor(0.1), deviation=lambda: torch.tensor(zeta))
    model.sdf.octree = octree
    model.optimizer = torch.optim.Adam([dict(params=[octree.features], lr=0.01)])
    octree.features[1:].sum().backward()
    model.optimizer.step()
    state = model.optimizer.state[octree.features]
    state["exp_avg"][:, 0] = octree.row_key.float()  # a mark by which to know each row again
    return model


def test_refining_a_tree_with_empty_levels_works(warm):
    model = copy.deepcopy(warm)
    octree = model.sdf.octree = g.Octree(1.0, 6, 2)  # nothing is split: levels 1 to 5 have no cells
    model.sdf.lin1 = nn.Linear(3 + 6 * 2, 16)
    optimizer = torch.optim.Adam([octree.features])
    octree.features.sum().backward()
    optimizer.step()
    model.hits[:64, :3] = 0.1
    model.refine(optimizer)
    assert [len(cells) for cells in octree.cells] == [16 ** 3, 0, 0, 0, 0, 0]
    assert [v.shape for v in model.sdf.with_gradient(torch.zeros(0, 3))] == [(0,), (0, g.GEO), (0, 3)]


def test_refining_goes_from_coarse_to_fine():
    model = refinable(levels=6)
    octree, depths = model.sdf.octree, []
    for _ in range(6):
        hit_the_ball(model, 64, 0.5)
        g.GeoNVS.refine(model, model.optimizer)
        depths.append(octree.active)
    assert depths == [min(depths[0] + i, 6) for i in range(6)]  # a level at a time, to the last


def hit_the_ball(model, n, error, direction=(0.3, -0.5, 0.8), pixel=0.0):
    at = CENTRE + BALL_R * F.normalize(torch.tensor([direction]), dim=1)
    model.hits[:n] = torch.cat([at, torch.tensor([[error, pixel]])], 1)
    return at


@pytest.mark.parametrize("radius, is_split", [(0.9, True), (1.1, False)])
def test_rays_that_miss_the_sphere_split_no_cell(radius, is_split):
    """Their closest points lie in the cube all the same, where ground goes on beyond the sphere."""
    class Ground(Ball):
        def __call__(self, x):
            return x.norm(dim=1) - radius, x.new_zeros(len(x), g.GEO)
    model = refinable()
    model.sdf, octree = Ground(), model.sdf.octree
    model.sdf.octree = octree
    at = radius * F.normalize(torch.tensor([[0.71, 0.70, 0.01]]), dim=1)
    model.hits[:] = torch.cat([at, torch.tensor([[0.5, 0.0]])], 1)
    depth = []
    for _ in range(2):
        depth.append(sum(torch.isin(octree.key(octree.cell_of(at, k), k), octree.split_keys[k]).item() for k in range(3)))
        g.GeoNVS.refine(model, model.optimizer)
    assert (depth[1] > depth[0]) == is_split


def distance_to_cells(octree, level, keys):
    cells = octree.cells[level][torch.isin(octree.key(octree.cells[level], level), keys)]
    return Ball()((cells + 0.5) * octree.cell(level) - 1)[0].abs()


@pytest.mark.parametrize("zeta", [1e9, 40.0])
def test_refining_prunes_cells_far_from_what_is_seen_and_only_those(zeta):
    model = refinable(zeta=zeta)
    octree = model.sdf.octree
    before = octree.split_keys[0].clone(), octree.split_keys[1].clone()
    g.GeoNVS.refine(model, model.optimizer)
    for level in (0, 1):
        reach = (math.sqrt(3) / 2 + 1) * octree.cell(level) + g.HIDDEN / zeta
        gone = before[level][~torch.isin(before[level], octree.split_keys[level])]
        assert len(gone) > 0 < len(octree.split_keys[level])
        assert (distance_to_cells(octree, level, octree.split_keys[level]) < reach).all()
        assert (distance_to_cells(octree, level, gone) >= reach).all()
    assert len(octree.cells[3]) == 0  # nothing was hit, nothing is finer


def test_pruning_changes_the_field_only_where_no_ray_can_see_it():
    """Pinned corners reach one child's side into cells that stay: they are part of the promise."""
    zeta = 40.0
    model, x = refinable(zeta=zeta), random(40_000, 3, low=-1, dtype=torch.float32)
    octree, s = model.sdf.octree, Ball()(x)[0].abs()
    fill(octree)
    before = octree(x)
    g.GeoNVS.refine(model, model.optimizer)
    changed = (octree(x) != before).flatten(1).any(1)
    assert g.HIDDEN / zeta <= s[changed].min() < g.HIDDEN / zeta + octree.cell(1)


@pytest.mark.parametrize("zeta", [20.0, 500.0])
def test_what_lies_deeper_than_hidden_changes_a_pixel_by_half_a_percent_at_most(zeta):
    """Total opacity before the surface, and what passes behind it, on a ray to a plane."""
    t = torch.linspace(-2, 2, 4001, dtype=torch.float64)
    s, dt = -(t[1:] + t[:-1])[None] / 2, torch.diff(t)[None]
    w, _ = g.composite(g.neus_alpha(s, -torch.ones_like(s), dt, torch.tensor(zeta)))
    assert 0 < w[s.abs() * zeta > g.HIDDEN].sum() <= 2 / (1 + math.exp(g.HIDDEN)) + 1e-6


def test_refining_splits_where_rays_miss_their_colour_and_nowhere_else():
    for error, want in ((0.22, True), (0.18, False)):  # the lower quartile is 0.1
        model = refinable()
        at = hit_the_ball(model, 10, error)
        g.GeoNVS.refine(model, model.optimizer)
        octree = model.sdf.octree
        split = octree.cells[2][torch.isin(octree.key(octree.cells[2], 2), octree.split_keys[2])]
        assert split.tolist() == (octree.cell_of(at, 2).tolist() if want else [])


def test_refining_leaves_cells_that_few_rays_reach():
    for n, want in ((g.SPLIT_RAYS, 8), (g.SPLIT_RAYS - 1, 0)):
        model = refinable()
        hit_the_ball(model, n, 0.5)
        g.GeoNVS.refine(model, model.optimizer)
        assert len(model.sdf.octree.cells[3]) == want


def test_refining_makes_no_cell_finer_than_the_pixels_that_see_it():
    for pixel, want in ((0.45, 8), (0.55, 0)):  # of the cell that is to be split
        model = refinable()
        hit_the_ball(model, 10, 0.5, pixel=pixel * model.sdf.octree.cell(2))
        g.GeoNVS.refine(model, model.optimizer)
        assert len(model.sdf.octree.cells[3]) == want


def test_refining_never_splits_far_from_the_surface_whatever_the_error():
    model = refinable()
    g.GeoNVS.refine(model, model.optimizer)  # far cells are whole now
    model.hits[:5] = torch.tensor([-0.8, 0.8, -0.8, 0.9, 0.0])
    g.GeoNVS.refine(model, model.optimizer)
    octree = model.sdf.octree
    home = octree.key(octree.cell_of(model.hits[:1, :3], 1), 1)
    assert not torch.isin(home, octree.split_keys[1]).any() and len(octree.cells[3]) == 0


def test_refining_judges_cells_by_their_mean_error():
    model = refinable(split_error=3.0)
    hit_the_ball(model, 6, 0.0)
    hit_the_ball(model, 1, 1.0)  # a mean of 0.17, below 2 x 0.1
    g.GeoNVS.refine(model, model.optimizer)
    assert len(model.sdf.octree.cells[3]) == 0


def test_refining_without_pruning_does_not_change_the_function(monkeypatch):
    model = refinable()
    monkeypatch.setattr(model.sdf.__class__, "__call__", lambda self, x: (0 * x[:, 0], None))  # surface everywhere
    hit_the_ball(model, 10, 0.5)
    x = random(300, 3, low=-1, dtype=torch.float32)
    before, n = model.sdf.octree(x), len(model.sdf.octree.cells[3])
    g.GeoNVS.refine(model, model.optimizer)
    assert n < len(model.sdf.octree.cells[3]) == 8 and torch.equal(model.sdf.octree(x), before)


def test_refining_stays_within_its_memory_and_takes_the_worst_first():
    model = refinable()
    g.GeoNVS.refine(model, model.optimizer)  # pruned once, so that only growth is left
    octree = model.sdf.octree
    hit_the_ball(model, 60, 0.4)  # worth it, too
    worst = hit_the_ball(model, 20, 0.9, (-1.0, 0.2, 0.1))
    full = octree.bytes() / 2 ** 20
    for bytes_more, cells in ((0, 0), (8 * (36 + 4 * 2), 8)):  # eight nodes and corners of two channels
        model.cfg = config(max_mb=full + (bytes_more + 0.5) / 2 ** 20)
        g.GeoNVS.refine(model, model.optimizer)
        assert len(octree.cells[3]) == cells and octree.bytes() <= model.cfg.max_mb * 2 ** 20
    assert (octree.cells[3] // 2 == octree.cell_of(worst, 2)).all()


def test_refining_shares_its_memory_among_the_levels():
    model = refinable()
    g.GeoNVS.refine(model, model.optimizer)
    octree, home = model.sdf.octree, hit_the_ball(model, 10, 0.9)
    octree.prune(1, octree.cell_of(home, 1))  # one cell of level 1 and one of level 2 are worth it
    model.optimizer = torch.optim.Adam([octree.features])
    octree.features[1:].sum().backward()
    model.optimizer.step()
    model.hits[10:20] = model.hits[:10]
    hit_the_ball(model, 10, 0.9, (-1.0, 0.2, 0.1))
    n = sum(map(len, octree.cells))
    model.cfg = config(max_mb=(octree.bytes() + 8 * (36 + 4 * 2) + 0.5) / 2 ** 20)
    g.GeoNVS.refine(model, model.optimizer)
    assert sum(map(len, octree.cells)) == n + 8  # room for one of them


def test_adams_moments_move_with_their_features():
    model = refinable()
    octree, rate = model.sdf.octree, model.optimizer.state[model.sdf.octree.features]["step"].item()
    old = octree.row_key.clone()
    hit_the_ball(model, 10, 0.5)
    g.GeoNVS.refine(model, model.optimizer)
    state = model.optimizer.state[octree.features]
    kept = torch.isin(octree.row_key, old)
    assert kept.any() and not kept.all()
    assert torch.equal(state["exp_avg"][kept, 0], octree.row_key[kept].float())
    assert (state["exp_avg"][~kept] == 0).all() and (state["exp_avg_sq"][~kept] == 0).all() and state["step"] == rate
    assert model.optimizer.param_groups[0]["params"][0] is octree.features and len(model.optimizer.state) == 1
    octree.features.sum().backward()
    before = octree.features.detach().clone()
    model.optimizer.step()
    assert not torch.equal(octree.features, before)


def test_the_model_is_refined_at_its_moments_and_drops_an_empty_mask(warm):
    model, calls = copy.deepcopy(warm), []
    model.refine = lambda optimizer: calls.append(round(progress, 2))
    for step in range(100):
        progress = step / 100
        model.maintain(step, progress, None)
    assert calls == [0.1, 0.2, 0.3, 0.45, 0.6] and model.use_mask is False  # its logits never moved
    model = copy.deepcopy(warm)
    model.refine, model.refined = lambda optimizer: None, 4
    model.logits[:2] = 2.0
    model.maintain(0, 0.9, None)
    assert model.use_mask


def test_a_uniform_grid_is_fine_everywhere_in_the_sphere_and_stays_so(scene):
    model = new_model(scene, grid="uniform")
    octree, x = model.sdf.octree, g.random_ball(500, generator())
    assert torch.isin(octree.key(octree.cell_of(x, 0), 0), octree.split_keys[0]).all()
    model.refine = None  # would fail if it were called
    model.maintain(0, 0.9, None)
    assert model.refined == 1


# ---- 8 baselines ---------------------------------------------------------------------------------------

BASELINE = dict(rays=16, photos=16, samples=6, hidden=32)


def baseline(scene, kind, **changes):
    torch.manual_seed(0)
    settings = BASELINE | dict(photos=1, rays=256) if kind == "hanerf" else BASELINE
    return g.METHODS[kind][0](config(method=kind, **settings | changes), scene)


def test_positional_encoding_equals_a_naive_loop():
    x = random(5, 2, low=-2)
    got = g.positional(x, 3)
    for p in range(5):
        want = [*x[p].tolist()] + [f(2 ** k * v) for f in (math.sin, math.cos) for v in x[p].tolist() for k in range(3)]
        assert sorted(got[p].tolist()) == pytest.approx(sorted(want)) and got[p, :2].tolist() == x[p].tolist()


@pytest.mark.parametrize("kind", ["nerfw", "hanerf"])
def test_baselines_train_on_finite_losses_that_reach_every_part(scene, kind):
    model = baseline(scene, kind)
    rays, pick = model.batch(torch.nonzero(~scene.is_test)[:, 0], generator())
    total, logs = model.losses(rays, pick, generator())
    total.backward()
    assert all(math.isfinite(float(v)) for v in (total.detach(), *logs.values())) and {"mse", "mask"} <= logs.keys()
    lost = [n for n, p in model.named_parameters() if p.grad is None or not torch.isfinite(p.grad).all()]
    if kind == "hanerf":
        lost = [n for n in lost if n != "appearance.weight"]
    assert lost == []


@pytest.mark.parametrize("kind", ["nerfw", "hanerf"])
def test_baselines_have_finite_losses_under_mixed_precision(scene, kind):
    model = baseline(scene, kind)
    batch = model.batch(torch.nonzero(~scene.is_test)[:, 0], generator())
    with torch.autocast("cpu", torch.bfloat16):
        assert losses_are_finite(model, *batch)


def rendered(model, scene, transient=None):
    rays, _ = batch(scene, 12, 4)
    return rays, model.render(rays, random(12, 48, dtype=torch.float32), random(12, 12, dtype=torch.float32), transient)


@pytest.mark.parametrize("kind", ["nerfw", "hanerf"])
def test_baseline_weights_sum_to_one_and_depths_are_within_reach(scene, kind):
    model = baseline(scene, kind)
    rays, out = rendered(model, scene)
    close(out["w"].sum(1), torch.ones(12), atol=1e-4)  # the last section is opaque
    assert out["w"].shape == (12, 12) and (out["depth"] >= rays.near).all() and (out["depth"] <= model.far[rays.img]).all()
    assert (out["rgb"] >= 0).all() and (out["rgb"] <= 1.001).all()


def test_nerfw_without_transient_density_is_the_static_picture(scene):
    model = baseline(scene, "nerfw")
    with torch.no_grad():
        model.head_out.weight.zero_()
        model.head_out.bias.copy_(torch.tensor([-100.0, 0, 0, 0, 3]))
    _, static = rendered(model, scene)
    _, both = rendered(model, scene, torch.zeros(12, 16))
    close(both["rgb"], static["rgb"], atol=1e-4)
    close(both["transient"], torch.zeros(12))
    close(both["beta"], torch.full((12,), 0.03))


def test_nerfw_behind_a_dense_transient_sees_only_the_transient(scene):
    model = baseline(scene, "nerfw")
    with torch.no_grad():
        model.fine.density.bias.fill_(-50.0)
        model.head_out.weight.zero_()
        model.head_out.bias.copy_(torch.tensor([100.0, 1, 1, 1, 3]))
    _, out = rendered(model, scene, torch.zeros(12, 16))
    close(out["rgb"], torch.full((12, 3), sigmoid(1.0)), atol=1e-3)
    close(out["transient"], torch.ones(12), atol=1e-3)
    close(out["beta"], torch.full((12,), math.log1p(math.exp(3)) + 0.03), atol=1e-2)


def test_nerfw_mixes_static_and_transient_as_its_equation_says(scene):
    """Naive loop in float64 over the sections of one ray (NeRF-W Eq. 5)."""
    model, (rays, _) = baseline(scene, "nerfw"), batch(scene, 4, 4)
    t = (1.5 + random(4, 5).cumsum(1)).float()
    code, transient = random(4, 48, seed=1, dtype=torch.float32), random(4, 16, seed=2, dtype=torch.float32)
    out = model.pass_through(model.fine, rays, t, code, transient)
    sigma, rgb, neck = model.fine(rays.o[:, None] + t[:, :, None] * rays.d[:, None], rays.d, code)
    head = model.head_out(model.head(torch.cat([neck, transient[:, None].expand(-1, 5, -1)], 2)))
    for r in range(4):
        left, total, beta = 1.0, torch.zeros(3), 0.03
        for j in range(5):
            dt = (t[r, j + 1] - t[r, j]).item() if j < 4 else 100.0
            st = math.log1p(math.exp(head[r, j, 0].item()))
            a_s, a_t = 1 - math.exp(-sigma[r, j].item() * dt), 1 - math.exp(-st * dt)
            total = total + left * (a_s * rgb[r, j] + a_t * torch.sigmoid(head[r, j, 1:4]))
            beta += left * a_t * math.log1p(math.exp(head[r, j, 4].item()))
            left *= math.exp(-(sigma[r, j].item() + st) * dt)
        close(out["rgb"][r], total, atol=1e-4)
        assert out["beta"][r].item() == pytest.approx(beta, abs=1e-4)


def test_nerfw_fine_samples_gather_where_the_coarse_weights_are(scene):
    model, (rays, _), seen = baseline(scene, "nerfw"), batch(scene, 12, 4), []

    def pass_through(field, rays, t, code, transient):
        seen.append((field, t))
        return dict(rgb=torch.zeros(12, 3), w=F.one_hot(torch.full((12,), 2), t.shape[1]).float())
    model.pass_through = pass_through
    model.render(rays, torch.zeros(12, 48), torch.rand(12, 12))
    (first, coarse), (second, fine) = seen
    assert first is model.coarse and second is model.fine and (fine.diff(dim=1) >= 0).all()
    section = ((fine - rays.near[:, None]) / (model.far[rays.img] - rays.near)[:, None] * 6).floor()
    assert coarse.shape == (12, 6) and ((section == 2).sum(1) >= 6).all()  # one of the first and nearly all of the second pass


def test_nerfw_loss_is_its_equation_13(scene):
    model, (rays, pick) = baseline(scene, "nerfw"), batch(scene, 16, 16)
    total, raw = model.losses(rays, pick, generator())
    out = model.render(rays, model.codes()[rays.img], torch.rand(16, 12, generator=generator()), model.transient(rays.img))
    want = 0.0
    for i in range(16):
        e, b = ((out["rgb"][i] - rays.rgb[i]) ** 2).sum().item(), out["beta"][i].item()
        want += (e / (2 * b * b) + 3 + math.log(b) + 0.01 * out["sigma_t"][i].item()) / 16
    want += ((out["coarse"] - rays.rgb) ** 2).sum(1).mean().item() / 2
    assert total.item() == pytest.approx(want, rel=1e-4)


def test_hanerf_draws_a_row_major_window_of_one_photo(scene):
    model = baseline(scene, "hanerf")
    for seed in range(5):
        rays, pick = model.batch(torch.nonzero(~scene.is_test)[:, 0], generator(seed))
        uv = rays.uv.reshape(16, 16, 2)
        assert set(rays.img.tolist()) == {pick.item()} and not scene.is_test[pick]
        assert (uv[:, 1:, 0] >= uv[:, :-1, 0]).all() and (uv[1:, :, 1] >= uv[:-1, :, 1]).all()
        assert (uv[:, :, 0] == uv[:1, :, 0]).all() and (uv[:, :, 1] == uv[:, :1, 1]).all()
        assert (uv[0, -1, 0] - uv[0, 0, 0]) > 0.4


def test_hanerf_mask_lowers_the_colour_loss_and_has_a_falling_price(scene):
    model, sizes = baseline(scene, "hanerf", steps=10 ** 6, minutes=2.0), []
    rays, pick = model.batch(torch.nonzero(~scene.is_test)[:, 0], generator())
    for model.step in (0, 1000, 10_000):  # by steps, whatever the budget
        sizes.append(float(model.losses(rays, pick, generator())[1]["size"]))
    mask = model.mask_of(rays, pick).detach()
    close(sizes, [5e-2 * (mask ** 2).mean(), 5e-2 / math.e * (mask ** 2).mean(), 6e-3 * (mask ** 2).mean()], rtol=1e-3)


def test_baselines_draw_samples_up_to_the_farthest_points_of_each_photo(scene):
    """Not of all photos: one outlier would thin out everybody's samples (nerf_pl's far)."""
    far = baseline(scene, "nerfw").far
    reach = (scene.points[::20] - scene.c2w[:, None, :, 3]).norm(dim=2)
    assert far.shape == (10,) and (far <= reach.amax(1)).all() and (far > reach.quantile(0.98, dim=1)).all()
    assert far.unique().numel() == 10


def test_hanerf_codes_survive_a_render_in_another_photos_light(scene):
    """The second picture has the weights of the first and the colours of a stored code; of the field
    it teaches the colour branch alone."""
    model, photos = baseline(scene, "hanerf"), torch.nonzero(~scene.is_test)[:, 0]
    rays, pick = model.batch(photos, generator())
    own, other = model.encode(pick).expand(256, -1), random(1, 48, dtype=torch.float32).expand(256, -1)
    jitter = torch.rand(256, 12, generator=generator())
    out = model.render(rays, own, jitter, other)
    close(model.render(rays, own, jitter, own)["other"], model.render(rays, own, jitter)["rgb"], atol=1e-6)
    close(out["rgb"], model.render(rays, own, jitter)["rgb"], atol=1e-6)
    assert (out["other"] - out["rgb"]).abs().max() > 1e-3
    out["other"].sum().backward()
    taught = {name.split(".")[1] for name, p in model.fine.named_parameters(prefix="fine") if p.grad is not None}
    assert taught == {"color"} and all(p.grad is None for p in model.coarse.parameters())
    model.losses(rays, pick, generator())
    close(model.bank[pick], model.encode(pick), atol=1e-6)
    seen = []
    model.render = lambda rays, code, jitter, other: seen.append(other[0]) or {k: rays.rgb for k in ("rgb", "coarse", "other")}
    for i in range(20):
        model.losses(rays, pick, generator(i))
    assert torch.stack(seen).unique(dim=0).shape[0] == 1  # so far one code is known
    model.bank[:] = random(10, 48, dtype=torch.float32)
    for i in range(20):
        model.losses(rays, pick, generator(i))
    assert torch.stack(seen).unique(dim=0).shape[0] > 5


def test_each_method_has_its_own_adam(scene):
    own, theirs = (g.make_optimizer(m).defaults for m in (new_model(scene), baseline(scene, "nerfw")))
    assert own["betas"] == (0.9, 0.99) and theirs["betas"] == (0.9, 0.999) and theirs["eps"] == 1e-8


def test_hanerf_codes_come_from_the_photos_in_any_batch(scene):
    model = baseline(scene, "hanerf")
    codes = model.codes()
    assert codes.shape == (10, 48) and not codes.requires_grad
    close(codes[7], model.encode(torch.tensor([7]))[0], atol=1e-5)


def test_a_uniform_grid_is_as_fine_as_its_memory_allows(scene):
    sizes = {}
    for max_mb in (0.3, 3.0, 100.0):
        octree = new_model(scene, grid="uniform", levels=3, max_mb=max_mb).sdf.octree
        sizes[octree.levels] = octree.bytes() / 2 ** 20
        assert octree.bytes() <= 1.2 * max_mb * 2 ** 20 and len(octree.cells[-1]) == octree.resolution(octree.levels - 1) ** 3
    assert list(sizes) == [1, 2, 3]


def test_a_model_without_codes_has_none_to_learn(scene):
    off, on = (new_model(scene, appearance=how).appearance.weight for how in ("off", "on"))
    assert off.numel() == 0 and not off.requires_grad and on.numel() > 0 and on.requires_grad


def test_a_photo_of_odd_size_reaches_the_mask_network(scene):
    model = new_model(scene._replace(thumbs=scene.thumbs[:, :, :17, :17]), mask_px=17)
    model.step = 4
    assert model.losses(*batch(scene), generator())[0].isfinite()


def test_health_without_visible_points_says_nothing_of_them(scene):
    none = np.zeros(0, np.int32)
    assert new_model(with_facts(scene, track_photo=none, track_point=none)).health() == {}


# ---- 9 energy meter ------------------------------------------------------------------------------------

class Bench:
    """A clock, a counter and a power reading that tests turn by hand."""

    def __init__(self, watts=lambda t: 50.0, scale=1.0, **kwargs):
        self.t, self.j, self.watts = 0.0, 0.0, watts
        self.meter = g.EnergyMeter("fake", kwargs.pop("counter", lambda: self.j), kwargs.pop(
            "power", lambda: watts(self.t) * scale), period=1e9, clock=lambda: self.t, **kwargs)

    def work(self, seconds, joules, ticks=1):
        for _ in range(ticks):
            self.t, self.j = self.t + seconds / ticks, self.j + joules / ticks
            self.meter.tick()

    def window(self, *args, **kwargs):
        self.meter.start()
        self.work(*args, **kwargs)
        self.meter.stop()


def test_meter_of_constant_power_reads_power_times_time():
    bench = Bench()
    bench.window(72, 3600, ticks=5)
    report = bench.meter.report()
    assert report["energy_wh"] == pytest.approx(1) and report["energy_wh_sampled"] == pytest.approx(1)
    assert report["energy_source"] == "fake" and report["idle_w"] == 50 and report["energy_disagrees"] is False


def test_meter_integrates_a_ramp_by_trapezoids():
    bench = Bench(watts=lambda t: 3 * t)
    bench.window(10, 150, ticks=4)
    assert bench.meter.sampled_joules == pytest.approx(150)


def test_meter_flags_readings_that_disagree_by_more_than_five_percent():
    for scale, want in ((1.04, False), (1.2, True), (0.8, True)):
        bench = Bench(scale=scale)
        bench.window(10, 500)
        assert bench.meter.report()["energy_disagrees"] is want


def test_meter_windows_add_up_and_what_lies_between_is_left_out():
    bench = Bench()
    bench.window(10, 500)
    bench.t, bench.j = bench.t + 1000, bench.j + 77_777
    bench.window(20, 1000, ticks=2)
    assert bench.meter.joules == pytest.approx(1500) and bench.meter.sampled_joules == pytest.approx(1500)


def test_meter_without_readings_reports_none_and_never_zero():
    meter = g.EnergyMeter()
    meter.start()
    meter.stop()
    assert all(v is None for v in meter.report().values())


def test_meter_with_one_reading_reports_that_one():
    counter, power = Bench(power=None), Bench(counter=None)
    for bench in (counter, power):
        bench.window(72, 3600)
    assert counter.meter.report()["energy_wh"] == pytest.approx(1) and counter.meter.report()["energy_wh_sampled"] is None
    assert power.meter.report()["energy_wh"] == pytest.approx(1) and power.meter.report()["energy_disagrees"] is None


def test_meter_thread_ticks_and_ends():
    ticks = []
    meter = g.EnergyMeter("fake", power=lambda: 1.0, period=1e-3, clock=lambda: ticks.append(0) or len(ticks))
    meter.start()
    while len(ticks) < 5:
        pass
    meter.stop()
    assert not meter.thread.is_alive() and meter.sampled_joules == len(ticks) - 1


def test_a_reading_that_fails_in_mid_run_leaves_null_and_ends_nothing(capsys):
    bench = Bench()
    bench.window(10, 500)
    bench.meter.power = lambda: 1 / 0
    bench.window(10, 500)
    bench.window(10, 500)
    assert all(bench.meter.report()[k] is None for k in ("energy_wh", "energy_wh_sampled", "energy_source"))
    assert capsys.readouterr().out.count("energy is null") == 1


def powercap(root, packages, wrap=1_000_000):
    for name, energy in packages.items():
        (root / name).mkdir(exist_ok=True)
        (root / name / "energy_uj").write_text(f"{energy}\n")
        (root / name / "max_energy_range_uj").write_text(f"{wrap}\n")


def test_rapl_sums_packages_each_with_its_own_wrap_and_skips_their_parts(tmp_path):
    powercap(tmp_path, {"intel-rapl:0": 900_000, "intel-rapl:1": 100_000, "intel-rapl:0:0": 5, "other": 9})
    meter = g.rapl_meter(str(tmp_path))
    meter.period = 1e9
    meter.start()
    powercap(tmp_path, {"intel-rapl:0": 200_000, "intel-rapl:1": 150_000, "intel-rapl:0:0": 999_999})
    meter.tick()
    powercap(tmp_path, {"intel-rapl:0": 300_000, "intel-rapl:1": 150_000})
    meter.stop()
    assert meter.joules == pytest.approx(0.3 + 0.05 + 0.1) and meter.source == "rapl"


def test_rapl_without_packages_reads_none(tmp_path):
    assert g.rapl_meter(str(tmp_path)).report()["energy_wh"] is None


def nvml(monkeypatch, **more):
    """A GPU that has spent 7 J and draws 30 W, as pynvml would tell it."""
    calls = dict(nvmlInit=lambda: None, nvmlDeviceGetHandleByUUID=lambda uuid: uuid,
                 nvmlDeviceGetTotalEnergyConsumption=lambda gpu: 7000, nvmlDeviceGetPowerUsage=lambda gpu: 30_000)
    monkeypatch.setitem(sys.modules, "pynvml", SimpleNamespace(**calls | more))
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid="abc"))
    return g.make_meter(torch.device("cuda"))


def test_nvml_is_asked_for_torchs_gpu_in_millijoules_and_milliwatts(monkeypatch):
    asked = []
    meter = nvml(monkeypatch, nvmlDeviceGetHandleByUUID=asked.append)
    assert meter.source == "nvml" and meter.counter() == 7 and meter.idle_w == 30
    assert asked in (["GPU-abc"], [b"GPU-abc"])


class NVMLError(Exception):
    pass


def refuse(gpu):
    raise NVMLError("Not Supported")


def test_a_gpu_without_an_energy_counter_is_read_by_its_power(monkeypatch):
    meter = nvml(monkeypatch, NVMLError=NVMLError, nvmlDeviceGetTotalEnergyConsumption=refuse)
    assert meter.counter is None and meter.idle_w == 30 and meter.source == "nvml"


def test_a_gpu_that_tells_nothing_reads_none(monkeypatch, capsys):
    meter = nvml(monkeypatch, NVMLError=NVMLError, nvmlDeviceGetTotalEnergyConsumption=refuse, nvmlDeviceGetPowerUsage=refuse)
    assert meter.report()["energy_wh"] is None and "Not Supported" in capsys.readouterr().out


def test_runs_side_by_side_do_not_tell_each_others_energy_and_memory(monkeypatch):
    """A package's counter and a worker's peak are those of all that ran there: none of them is a run's own."""
    monkeypatch.setattr(g, "rapl_meter", lambda: g.EnergyMeter("rapl", float))
    assert g.make_meter(torch.device("cpu")).counter and g.peak_rss() > 2 ** 20
    monkeypatch.setattr(g, "parent_process", lambda: "a pool")
    assert g.make_meter(torch.device("cpu")).counter is None and g.peak_rss() is None


def test_gpu_without_pynvml_reads_none(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pynvml", None)
    assert g.make_meter(torch.device("cuda")).report()["energy_wh"] is None
    assert capsys.readouterr().out.count("\n") == 1


# ---- 10 training ---------------------------------------------------------------------------------------

def run_training(scene, run, seed=0, saved=None, **changes):
    run.mkdir(exist_ok=True)
    return g.train(config(seed=seed, **changes), scene, run, saved)


def weights(model):
    return {k: v for k, v in model.state_dict().items() if torch.is_tensor(v)}


def same_weights(a, b):
    a, b = weights(a), weights(b)
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def last_log(run):
    line = json.loads((run / "log.jsonl").read_text().splitlines()[-1])
    return {k: v for k, v in line.items() if k != "seconds"}


@pytest.fixture(scope="module")
def six(scene, tmp_path_factory):
    """Six steps in one go, with a copy of the checkpoint that was written after each."""
    run = tmp_path_factory.mktemp("six")
    with pytest.MonkeyPatch.context() as patch:
        start, save = g.GeoNVS.start, g.save_checkpoint

        def keep(path, *args):
            save(path, *args)
            shutil.copy(path, run / f"after_{args[-1]['step']}.pt")
        patch.setattr(g.GeoNVS, "start", lambda self, gen: start(self, gen, 3))
        patch.setattr(g, "CHECKPOINT_S", -1.0)  # after every step
        patch.setattr(g, "save_checkpoint", keep)
        model, state, _ = run_training(scene, run)
    saved = g.read_checkpoint(run / "after_3.pt")
    return SimpleNamespace(run=run, model=model, state=state, saved=saved)


def test_training_counts_its_steps_and_logs_them(six):
    assert six.state["step"] == six.model.step + 1 == 6 and six.state["dropped"] == 0
    assert last_log(six.run)["step"] == 6 and {"psnr", "zeta", "mask", "rgb", "eik"} <= last_log(six.run).keys()


def test_the_same_seed_repeats_bit_for_bit_and_another_does_not(scene, tmp_path, brief, six):
    again, *_ = run_training(scene, tmp_path / "again")
    other, *_ = run_training(scene, tmp_path / "other", seed=1)
    assert same_weights(six.model, again) and last_log(six.run) == last_log(tmp_path / "again")
    assert not torch.equal(other.sdf.lin1.weight, again.sdf.lin1.weight)


def poisoned(monkeypatch, since=0):
    """From a step on, the loss is not a number."""
    losses = g.GeoNVS.losses

    def poison(self, *args):
        total, logs = losses(self, *args)
        return (total * math.nan if self.step >= since else total), logs
    monkeypatch.setattr(g.GeoNVS, "losses", poison)


def test_a_run_that_never_recovers_stops_with_its_last_good_weights(scene, tmp_path, brief, monkeypatch, six):
    poisoned(monkeypatch, since=2)
    with pytest.raises(g.Diverged, match="learning rate") as caught:
        run_training(scene, tmp_path, steps=1000)
    saved = g.read_checkpoint(tmp_path / "checkpoint.pt")
    assert saved["state"]["step"] <= 3 * g.PATIENCE and str(tmp_path / "checkpoint.pt") in str(caught.value)
    assert saved["state"]["dropped"] == saved["state"]["step"] - 2
    assert all(torch.isfinite(v).all() for v in saved["model"].values() if torch.is_tensor(v))


def test_float16_scales_its_loss_and_takes_the_step_of_float32(scene, tmp_path, brief, monkeypatch):
    monkeypatch.setattr(g, "half_dtype", lambda device: torch.float16)
    models, scales = [], []
    step = torch.optim.Adam.step
    monkeypatch.setattr(torch.optim.Adam, "step", lambda self: (scales.append(
        getattr(self, "grad_scale", None)), step(self)))
    for amp in ("off", "on"):
        models.append(run_training(scene, tmp_path / amp, steps=3, amp=amp)[0])
    assert scales[-1] == g.LOSS_SCALE and scales[3:6] == [None] * 3
    a, b = (torch.cat([p.detach().flatten() for p in m.parameters()]) for m in models)
    start = torch.cat([p.detach().flatten() for p in g.GeoNVS(config(), scene).parameters()])
    assert len(start) == len(a) and (a - b).norm() < 0.3 * (a - start).norm()


def test_full_gpu_memory_is_one_sentence(capsys):
    def fill():
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate ...")
    with pytest.raises(SystemExit) as end:
        g.run_command_line(fill)
    assert end.value.code == 2 and "--rays" in capsys.readouterr().err


def test_void_steps_between_good_ones_do_not_stop_a_run(scene, tmp_path, brief, monkeypatch):
    losses = g.GeoNVS.losses

    def poison(self, *args):
        total, logs = losses(self, *args)
        return (total if self.step % 5 == 0 else total * math.nan), logs
    monkeypatch.setattr(g.GeoNVS, "losses", poison)
    state = run_training(scene, tmp_path, steps=2 * g.PATIENCE)[1]
    assert state["step"] == 2 * g.PATIENCE and state["dropped"] == 8 * g.PATIENCE // 5


def test_a_diverged_run_of_a_matrix_is_a_result(arrays, tmp_path, brief, monkeypatch):
    monkeypatch.chdir(tmp_path)
    poisoned(monkeypatch)
    monkeypatch.setattr(g, "find_scene", lambda cfg: arrays)
    metrics = g.run_once(TINY | dict(steps=1000), tmp_path / "run")
    assert "finite" in metrics["failed"] and g.table_line({}, [metrics])["failures"] == 1
    assert g.run_once(TINY | dict(steps=1000), tmp_path / "run") == metrics


def test_an_unhealthy_figure_is_warned_of_once(scene, tmp_path, brief, monkeypatch, capsys):
    clock = itertools.count(0, 10.0)
    monkeypatch.setattr(g.time, "perf_counter", lambda: next(clock))  # a line after every step
    monkeypatch.setattr(g, "HEALTH", {"miss": (2, 3, "BAD"), "eik": (0, math.inf, "GOOD")})
    run_training(scene, tmp_path)
    out = capsys.readouterr().out
    assert out.count("step") == 6 and out.count("BAD") == 1 and "GOOD" not in out


def test_sfm_opacity_looks_at_points_from_photos_that_show_them(warm, monkeypatch):
    seen = {}

    def look(rays, code):
        seen["rays"] = rays
        return dict(opacity=torch.full_like(rays.near, 0.25))
    model = copy.deepcopy(warm)
    monkeypatch.setattr(model, "render", look)
    assert model.health()["sfm_opacity"] == 0.25
    rays, points = seen["rays"], warm.scene.points
    along = ((points - rays.o[:, None]) * rays.d[:, None]).sum(2)  # (R,K)
    gap = (rays.o[:, None] + along[..., None] * rays.d[:, None] - points).norm(dim=2)  # (R,K)
    assert gap.min(1)[0].max() < 1e-4 and not warm.scene.is_test[rays.img].any()
    raw = warm.scene.raw
    pairs = set(zip(raw["track_photo"].tolist(), raw["track_point"].tolist()))
    near = [{(i, k) for k in torch.nonzero(row < 1e-4)[:, 0].tolist()} for i, row in zip(rays.img.tolist(), gap)]
    assert all(pairs & options for options in near)


@pytest.mark.parametrize("after", [2, 3, 5])
def test_resuming_equals_never_having_stopped(scene, tmp_path, brief, six, after):
    shutil.copy(six.run / "log.jsonl", tmp_path / "log.jsonl")  # holds a line beyond the checkpoint
    saved = g.read_checkpoint(six.run / f"after_{after}.pt")
    assert saved["state"]["step"] == after
    model, state, _ = run_training(scene, tmp_path, saved=saved)
    assert state["step"] == 6 and same_weights(six.model, model)
    assert (tmp_path / "log.jsonl").read_text().count("\n") == 1 and last_log(tmp_path) == last_log(six.run)


def test_ctrl_c_ends_the_step_saves_and_says_how_to_go_on(scene, tmp_path, brief, monkeypatch, six):
    draw, calls, handler = g.random_rays, itertools.count(1), signal.getsignal(signal.SIGINT)

    def interrupt(*args):
        if next(calls) == 3:
            signal.raise_signal(signal.SIGINT)
        return draw(*args)
    with monkeypatch.context() as patch, pytest.raises(UserError, match="--resume"):
        patch.setattr(g, "random_rays", interrupt)
        run_training(scene, tmp_path)
    saved = g.read_checkpoint(tmp_path / "checkpoint.pt")
    assert saved["state"]["step"] == 3 and signal.getsignal(signal.SIGINT) is handler
    model, *_ = run_training(scene, tmp_path, saved=saved)
    assert same_weights(six.model, model)


KILLED = """
import sys, data_prep, geonvs as g
from pathlib import Path
torch = g.torch
torch.set_num_threads(1)
g.CHECKPOINT_S, g.GeoNVS.start = -1.0, lambda self, gen: None
arrays = data_prep.make_toy(size=24, photos=4, test=1)
scene = g.load_scene(arrays, "cpu", 32)
cfg = g.Config(**{config!r})
run = Path(sys.argv[1])
saved = g.read_checkpoint(run / "checkpoint.pt") if sys.argv[2] == "resume" else None
model, state, _ = g.train(cfg, scene, run, saved)
print(state["step"], sum(p.double().abs().sum().item() for p in model.parameters()).hex())
"""


def test_a_run_killed_at_any_moment_goes_on_bit_for_bit(tmp_path):
    code, here = KILLED.replace("{config!r}", repr(dict(TINY, steps=40))), Path(g.__file__).parent

    def start(run, how):
        (tmp_path / run).mkdir(exist_ok=True)
        return subprocess.Popen([sys.executable, "-c", code, tmp_path / run, how], cwd=here, text=True,
                                stdout=subprocess.PIPE)
    victim = start("victim", "new")
    while not (tmp_path / "victim" / "checkpoint.pt").exists() and victim.poll() is None:
        time.sleep(0.01)
    time.sleep(0.1)  # whenever that is: the checkpoint is whole
    victim.kill()
    victim.communicate()
    ends = [start("victim", "resume").communicate()[0], start("whole", "new").communicate()[0]]
    assert ends[0].splitlines()[-1] == ends[1].splitlines()[-1] and ends[0].splitlines()[-1].startswith("40 ")


def test_resuming_adds_time_and_dropped_steps_to_those_before(scene, tmp_path, brief, six):
    saved = g.read_checkpoint(six.run / "after_3.pt")
    saved["state"].update(seconds=1000.0, dropped=4)
    shutil.copy(six.run / "log.jsonl", tmp_path)
    _, state, _ = run_training(scene, tmp_path, saved=saved)
    assert 1000 < state["seconds"] < 1100 and last_log(tmp_path)["dropped"] == 4
    assert last_log(tmp_path)["step"] == 6


def test_training_never_sees_a_test_photo(scene, tmp_path, brief, monkeypatch):
    draw, seen = g.make_rays, []
    monkeypatch.setattr(g, "make_rays", lambda scene, img, pixel: (seen.append(img), draw(scene, img, pixel))[1])
    run_training(scene, tmp_path, steps=12)
    assert set(torch.cat(seen).tolist()) == set(torch.nonzero(~scene.is_test)[:, 0].tolist())


def test_resuming_adds_energy_to_what_was_spent_before(scene, tmp_path, brief, six, monkeypatch):
    saved = g.read_checkpoint(six.run / "after_3.pt")
    saved["state"].update(joules=100.0, sampled_joules=90.0)
    shutil.copy(six.run / "log.jsonl", tmp_path)
    monkeypatch.setattr(g, "make_meter", lambda device: g.EnergyMeter("fake", lambda: 5.0, lambda: 0.0, period=1e9))
    *_, meter = run_training(scene, tmp_path, saved=saved)
    assert meter.report()["energy_wh"] == pytest.approx(100 / 3600)


@pytest.mark.parametrize("before, counter", [(None, lambda: 5.0), (100.0, None)])
def test_energy_that_was_measured_only_in_part_is_none(scene, tmp_path, brief, six, monkeypatch, before, counter):
    """A run is resumed on a machine with a counter that it began without, or the other way round."""
    saved = g.read_checkpoint(six.run / "after_3.pt")
    saved["state"].update(joules=before, sampled_joules=None)
    shutil.copy(six.run / "log.jsonl", tmp_path)
    monkeypatch.setattr(g, "make_meter", lambda device: g.EnergyMeter("fake", counter, period=1e9))
    *_, meter = run_training(scene, tmp_path, saved=saved)
    assert meter.report()["energy_wh"] is None


@pytest.mark.parametrize("log", [None, '{"step": 1, "loss": 2}\n{"step": 2, "lo'])
def test_resuming_survives_a_lost_or_torn_log(scene, tmp_path, brief, six, log):
    if log is not None:
        (tmp_path / "log.jsonl").write_text(log)
    run_training(scene, tmp_path, saved=g.read_checkpoint(six.run / "after_3.pt"))
    assert last_log(tmp_path)["step"] == 6


def test_the_octree_of_a_checkpoint_is_restored_with_its_moments(scene, tmp_path, brief):
    """A refined tree has other rows than a new one; both models then take the same step."""
    a, b = new_model(scene, levels=4), new_model(scene, levels=4)
    optimizers = [g.make_optimizer(m) for m in (a, b)]

    def step(model, optimizer, seed):
        model.losses(*batch(scene, seed=seed), generator(seed))[0].backward()
        optimizer.step()
        optimizer.zero_grad()
    step(a, optimizers[0], 0)
    a.refined, a.level[()] = 1, 0.0  # as if half trained: finer cells pay
    x = random(4000, 3, low=-0.7, high=0.7, dtype=torch.float32)
    a.sdf.lin2.bias.data[0] -= a.sdf(x)[0].median().detach()  # now there is a surface
    near = x[a.sdf(x)[0].abs().argsort()[:400]]  # eight rays end at each of these points
    a.hits[:3200, :3], a.hits[:3200, 3:] = near.repeat(8, 1), torch.tensor([0.5, 0.0])
    a.refine(optimizers[0])
    assert a.sdf.octree.features.shape != b.sdf.octree.features.shape
    gens = generator(7), generator(8)
    g.save_checkpoint(tmp_path / "c.pt", a.cfg, a, optimizers[0], gens[0], dict(step=1))
    assert g.restore(g.read_checkpoint(tmp_path / "c.pt"), tmp_path / "c.pt", b, optimizers[1], gens[1]) == dict(step=1)
    assert torch.equal(torch.rand(3, generator=gens[0]), torch.rand(3, generator=gens[1]))
    for model, optimizer in zip((a, b), optimizers):
        step(model, optimizer, 1)
    assert same_weights(a, b) and b.refined == a.refined


def fake_clock(monkeypatch, tick=1.0):
    now = itertools.count()
    monkeypatch.setattr(g, "time", SimpleNamespace(perf_counter=lambda: next(now) * tick, monotonic=lambda: 0.0))


def test_the_budget_in_minutes_ends_training_and_drives_its_schedule(scene, tmp_path, brief, monkeypatch):
    fake_clock(monkeypatch)
    seen = []
    monkeypatch.setattr(g, "set_learning_rate", lambda optimizer, step, progress: seen.append(progress))
    _, state, _ = run_training(scene, tmp_path, steps=2, minutes=0.5)  # the steps do not count
    assert 2 < state["step"] == len(seen) < 30 and seen == sorted(seen) and 0.8 < seen[-1] <= 1


def test_the_curve_costs_neither_time_nor_energy(scene, tmp_path, brief, monkeypatch):
    fake_clock(monkeypatch)
    pause = 10_000.0
    looked, clock = [], g.time.perf_counter

    def look(model, scene, photos, codes):
        looked.append(1)
        return codes, 20.0 + len(looked)
    monkeypatch.setattr(g, "validate", look)
    g.time.perf_counter = lambda: clock() + pause * len(looked)
    meter = g.EnergyMeter("fake", lambda: pause * len(looked), period=1e9)
    monkeypatch.setattr(g, "make_meter", lambda device: meter)
    _, state, _ = run_training(scene, tmp_path, curve=True, steps=10)
    assert len(looked) == len(state["curve"]) >= 2 and state["seconds"] < pause and meter.joules == 0
    assert [p["psnr"] for p in state["curve"]] == [20.0 + i for i in range(1, len(looked) + 1)]
    seconds = [p["seconds"] for p in state["curve"]]
    assert seconds == sorted(seconds) and all(b > 4 * 1.5 ** i for i, b in enumerate(seconds))


def spoil(monkeypatch, bad, how):
    """Makes the loss of some steps non-finite."""
    losses, calls = g.GeoNVS.losses, itertools.count()

    def spoiled(self, *args):
        total, logs = losses(self, *args)
        return (how(total, self) if next(calls) in bad else total), logs
    monkeypatch.setattr(g.GeoNVS, "losses", spoiled)


BAD = {"nan loss": lambda total, model: total * math.nan,
       "infinite loss": lambda total, model: total * math.inf,
       "infinite gradient": lambda total, model: total + (model.deviation.v - model.deviation.v.detach()).sqrt()}


@pytest.mark.parametrize("kind", BAD)
def test_a_non_finite_step_is_dropped_and_counted_and_reaches_no_weight(scene, tmp_path, brief, monkeypatch, kind):
    spoil(monkeypatch, range(9), BAD[kind])
    start = []
    begin = g.GeoNVS.start
    monkeypatch.setattr(g.GeoNVS, "start", lambda self, gen: (begin(self, gen), start.append(copy.deepcopy(self))))
    model, _, _ = run_training(scene, tmp_path, steps=3)
    assert all(torch.equal(a, b) for a, b in zip(model.parameters(), start[0].parameters()))
    assert last_log(tmp_path)["dropped"] == 3
    assert g.read_checkpoint(tmp_path / "checkpoint.pt")["state"]["dropped"] == 3


def test_training_goes_on_after_a_dropped_step(scene, tmp_path, brief, monkeypatch):
    spoil(monkeypatch, {1}, BAD["nan loss"])
    model, _, _ = run_training(scene, tmp_path, steps=4)
    assert last_log(tmp_path)["dropped"] == 1
    assert all(torch.isfinite(p).all() for p in model.parameters()) and math.isfinite(last_log(tmp_path)["rgb"])


def damage(kind, good, path):
    if kind == "missing":
        return
    data = good.read_bytes()
    if kind == "truncated":
        path.write_bytes(data[:len(data) // 2])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("not a checkpoint\n")
    elif kind == "foreign":
        torch.save({"weights": torch.zeros(3)}, path)
    elif kind == "a tensor":
        torch.save(torch.zeros(3), path)
    elif kind == "code":
        torch.save(dict(geonvs=1, run=Path), path)  # a class: not data


@pytest.mark.parametrize("kind", ["missing", "truncated", "empty", "text", "foreign", "a tensor", "code"])
def test_a_bad_checkpoint_is_refused_in_one_sentence(six, tmp_path, kind):
    damage(kind, six.run / "checkpoint.pt", tmp_path / "checkpoint.pt")
    with pytest.raises(UserError) as error:
        g.read_checkpoint(tmp_path / "checkpoint.pt")
    assert "checkpoint.pt" in str(error.value) and "\n" not in str(error.value)


@pytest.fixture
def restored(scene, tmp_path):
    """Is what these bytes hold restored? If not, one sentence says so."""
    model, path, gen = new_model(scene), tmp_path / "checkpoint.pt", generator()
    optimizer = g.make_optimizer(model)

    def restored(data):
        path.write_bytes(data)
        try:
            state = g.restore(g.read_checkpoint(path), path, model, optimizer, gen)
        except UserError as e:
            assert "\n" not in str(e) and path.name in str(e)
            return False
        assert isinstance(state["step"], int)
        return True
    return restored


@settings(HOSTILE, max_examples=25)
@given(data=st.data())
def test_damaged_checkpoints_do_no_harm(six, restored, data):
    """Bits flipped anywhere, in the directory at the end, in the pickle; cut off; noise."""
    stored = (six.run / "after_3.pt").read_bytes()
    good, at = bytearray(stored), stored.find(b"data.pkl")
    parts = [(0, len(good)), (good.find(b"PK\1\2"), len(good)), (at, at + 6000)]
    low, high = data.draw(st.sampled_from(parts))
    for at in data.draw(st.lists(st.integers(8 * low, 8 * high - 1), min_size=1, max_size=4)):
        good[at // 8] ^= 1 << at % 8
    restored(bytes(good))
    assert not restored(stored[:data.draw(st.integers(0, len(stored) - 23))])
    assert not restored(data.draw(st.binary(max_size=200)))


def torch_bytes(value, **how):
    file = io.BytesIO()
    torch.save(value, file, **how)
    return file.getvalue()


ODD = [None, 0, -1, 1e300, math.nan, "x", [], {}, [1, 2], {"a": 1}, torch.zeros(0),
       torch.zeros(3, 3), torch.tensor(2), torch.full((5,), 2 ** 62)]
PLACES = """geonvs config config.scene config.rays config.lam_gpl model model.calibration octrees
    octrees.0 octrees.0.0 optimizer optimizer.param_groups rng state state.step""".split()


@settings(HOSTILE, max_examples=20)
@given(place=st.sampled_from(PLACES), odd=st.sampled_from(ODD))
def test_checkpoints_with_a_wrong_value_are_refused(six, restored, place, odd):
    """A value of the right kind may pass (other settings, an octree that is split nowhere)."""
    saved = copy.deepcopy(six.saved)
    *inside, last = (int(key) if key.isdigit() else key for key in place.split("."))
    inside = functools.reduce(lambda value, key: value[key], inside, saved)
    kinds = (int, float) if isinstance(inside[last], float) else type(inside[last])
    inside[last] = odd
    assert not restored(torch_bytes(saved)) or isinstance(odd, kinds)
    assert not restored(torch_bytes(odd))


@pytest.mark.parametrize("moment", [torch.zeros(3), torch.zeros(0), 1.0, None])
def test_checkpoints_with_wrong_moments_are_refused(six, restored, moment):
    saved = copy.deepcopy(six.saved)
    assert restored(torch_bytes(saved))
    saved["optimizer"]["state"][1] |= dict(exp_avg=moment)
    if moment is None:
        del saved["optimizer"]["state"][1]["exp_avg"]
    assert not restored(torch_bytes(saved))


def test_a_checkpoint_larger_inside_than_outside_is_refused_unread(
        six, restored, tmp_path, monkeypatch):
    loads, load = [], torch.load
    monkeypatch.setattr(torch, "load", lambda *a, **k: (loads.append(1), load(*a, **k))[1])
    assert restored((six.run / "after_3.pt").read_bytes()) and len(loads) == 1
    with zipfile.ZipFile(six.run / "after_3.pt") as good, \
            zipfile.ZipFile(tmp_path / "bomb", "w", zipfile.ZIP_DEFLATED) as bomb:
        for name in good.namelist():
            bomb.writestr(name, good.read(name))
        bomb.writestr("archive/data/999", bytes(2 ** 24))
    assert not restored((tmp_path / "bomb").read_bytes())
    old = torch_bytes(six.saved, _use_new_zipfile_serialization=False)
    assert not restored(old)  # no zip file: the sizes in it could not be checked
    assert len(loads) == 1


def test_a_checkpoint_never_runs_code(six, restored, tmp_path):
    assert not restored(torch_bytes(six.saved | dict(state=Evil(tmp_path / "harm"))))
    assert not restored(pickle.dumps(Evil(tmp_path / "harm")))
    assert not (tmp_path / "harm").exists()


def test_settings_of_a_resumed_run_are_checked_too(desk, capsys):
    assert command(*FLAGS, "--steps=1", "--name=a", "--photos=3", "--rays=63") == 0
    capsys.readouterr()
    assert command("--resume", "--name=a", "--rays=64") == 2  # no multiple of its 3 photos
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("changes", [dict(hidden=8), dict(levels=3), dict(background="off"), dict(appearance="off")])
def test_a_checkpoint_of_other_settings_is_refused(scene, tmp_path, brief, six, changes):
    with pytest.raises(UserError, match="does not fit"):
        run_training(scene, tmp_path, saved=g.read_checkpoint(six.run / "checkpoint.pt"), **changes)


def test_learning_rate_warms_up_linearly_and_falls_to_five_percent():
    optimizer = SimpleNamespace(param_groups=[dict(base_lr=2.0, lr=0.0)])

    def rate(step, progress):
        g.set_learning_rate(optimizer, step, progress)
        return optimizer.param_groups[0]["lr"]
    assert rate(0, 0) == pytest.approx(0.1) and rate(9, 0) == pytest.approx(1.0)
    assert rate(19, 0) == rate(500, 0) == pytest.approx(2.0)
    assert rate(500, 0.5) == pytest.approx(2 * (0.05 + 0.95 / 2)) and rate(999, 1.0) == pytest.approx(0.1)


TOGETHER = """
import json, math, os, shutil, signal
from pathlib import Path
import torch, data_prep, geonvs as g

torch.set_num_threads(1)
os.chdir(where)
me, runs = f"{g.RANK} of {g.RANKS}", Path("runs")
begin, toy, step, save, render = g.GeoNVS.start, data_prep.make_toy, g.training_step, g.save_checkpoint, g.render_rays
curve, meters, trouble, ends = [], [], {}, {}


def made():
    Path(f"made by {me}").touch()
    return toy(size=24, photos=6, test=1)


def logged(model, optimizer, photos, state, *args):
    if state["step"] == trouble.get("stop"):
        signal.raise_signal(signal.SIGINT)
    logs, dropped = step(model, optimizer, photos, state, *args)
    meters[-1].tick()
    slopes = {k: p.grad.double().norm().item() for k, p in model.named_parameters() if p.grad is not None}
    curve.append({k: float(v) for k, v in logs.items()} | slopes)
    return logs, dropped


def metered(device):
    joules = iter(range(0, 1000, 1 + g.RANK))  # so many from one look to the next
    meters.append(g.EnergyMeter("fake", lambda: next(joules), period=1e9))
    return meters[-1]


def kept(path, cfg, model, optimizer, gen, state):
    save(path, cfg, model, optimizer, gen, state)
    if state["step"] == 4 and g.RANK == 0:
        shutil.copy(path, "after_4.pt")


def scored(model, scene, cfg, state, energy, run):
    Path(f"scored by {me}").touch()
    g.write_text(run / "metrics.json", json.dumps(energy))
    return energy


def troubled(model, rays, *args):
    out = render(model, rays, *args)
    if g.RANK == g.RANKS - 1 and model.step in trouble:  # on one process alone
        trouble[model.step](out["rgb"])
    return out


def training(name, saved=None, **changes):
    curve.clear()
    (runs / name).mkdir(exist_ok=True)
    try:
        model, state, _ = g.train(g.Config(**config | changes), scene, runs / name, saved)
    except g.UserError as error:
        return str(error)
    weights = {k: v for k, v in model.state_dict().items() if torch.is_tensor(v)}
    return dict(weights=weights, curve=list(curve), joules=state["joules"], dropped=state["dropped"])


patch(data_prep, "make_toy", made)
patch(g.GeoNVS, "start", lambda self, gen: begin(self, gen, 3))
for name, f in dict(training_step=logged, make_meter=metered, save_checkpoint=kept, CHECKPOINT_S=-1.0,
                    finish=scored, render_rays=troubled).items():
    patch(g, name, f)
g.main([f"--{k}={v}" for k, v in config.items()] + ["--name=whole"])  # makes the scene, meets the other process
ends["whole"] = list(curve)
scene = g.load_scene(g.find_scene(g.Config()), "cpu", config["mask_px"])
ends["resumed"] = training("resumed", g.read_checkpoint(Path("after_4.pt")))
trouble = {0: lambda rgb: rgb.data.fill_(math.nan), 2: lambda rgb: rgb.register_hook(lambda grad: math.inf * grad)}
ends["dropped"] = training("dropped", steps=4)
trouble = dict(stop=1) if g.RANK == 0 else {}
ends["stopped"] = training("stopped")
trouble = {}
for method in ("nerfw", "hanerf"):
    ends[method] = training(method, method=method, rays=1024, photos=1, samples=2, steps=2)
torch.save(ends, f"ends of {me}.pt")
"""


def test_two_processes_do_together_what_one_does(tmp_path, monkeypatch):
    """Uneven shares of a step's rays, refinements, the mask, a resumed run, steps that are not finite on one of two
    processes, Ctrl-C, the baselines: the same losses, gradients and weights, joules of both, files of the first."""
    setting = TINY | dict(rays=63, photos=3, levels=3)
    for name in ("alone", "pair"):
        (tmp_path / name).mkdir()
    script = tmp_path / "together.py"
    script.write_text(f"config, where, patch = {setting!r}, {str(tmp_path / 'pair')!r}, setattr\n" + TOGETHER)
    env = dict(PYTHONPATH=str(Path(g.__file__).parent), OMP_NUM_THREADS="1",
               GLOO_SOCKET_IFNAME="lo0" if sys.platform == "darwin" else "lo")
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2", str(script)]
    done = subprocess.run(torchrun, env=os.environ | env, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    monkeypatch.chdir(tmp_path)
    exec(TOGETHER, dict(config=setting, where=tmp_path / "alone", patch=monkeypatch.setattr))

    alone, first, second = (torch.load(tmp_path / path) for path in (
        "alone/ends of 0 of 1.pt", "pair/ends of 0 of 2.pt", "pair/ends of 1 of 2.pt"))
    for name in ("whole", "resumed", "nerfw", "hanerf"):
        curves = [ends[name] if name == "whole" else ends[name]["curve"] for ends in (alone, first, second)]
        assert curves[1] == curves[2] and len(curves[0]) == len(curves[1])
        for a, b in zip(*curves[:2]):
            close(list(a.values()), [b[k] for k in a], rtol=1e-4, atol=1e-7)
    for name in ("resumed", "dropped", "nerfw", "hanerf"):
        a, b, c = (ends[name]["weights"] for ends in (alone, first, second))
        assert a.keys() == b.keys() and all(torch.equal(b[k], c[k]) and b[k].isfinite().all() for k in b)
        assert name == "dropped" or all(torch.allclose(a[k], b[k], rtol=1e-4, atol=1e-5) for k in a)
    assert first["resumed"]["curve"] == first["whole"][4:]
    assert alone["dropped"]["dropped"] == first["dropped"]["dropped"] == second["dropped"]["dropped"] == 2
    assert "stopped at step 2" in alone["stopped"] and alone["stopped"] == first["stopped"] == second["stopped"]

    assert alone["resumed"]["joules"] == 7 and first["resumed"]["joules"] == 7 * (1 + 2)
    metrics = json.loads((tmp_path / "pair/runs/whole/metrics.json").read_text())
    assert metrics["energy_wh"] == pytest.approx(21 / 3600)
    assert {p.name for p in (tmp_path / "pair").glob("*by*")} == {"made by 0 of 2", "scored by 0 of 2"}
    files = {name: sorted(p.relative_to(tmp_path / name) for p in (tmp_path / name).glob("runs/*/*"))
             for name in ("alone", "pair")}
    assert files["alone"] == files["pair"] and done.stdout.count("making data") == 1


# ---- 11 scoring, mesh, pictures ------------------------------------------------------------------------

def picture(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


@pytest.mark.parametrize("offset", [1, 5, 100])
def test_psnr_of_a_constant_offset(offset):
    a = picture(9, 7, 3) // 2
    assert g.psnr(a, a + np.uint8(offset)) == pytest.approx(20 * math.log10(255 / offset))
    assert g.psnr(a + np.uint8(offset), a) == g.psnr(a, a + np.uint8(offset))
    assert g.psnr(a, a) == pytest.approx(100)  # its cap


def naive_ssim(a, b):
    """SSIM over all complete windows of 11 px with Gaussian weights of sigma 1.5, in float64."""
    k = np.exp(-np.arange(-5, 6) ** 2 / (2 * 1.5 ** 2))
    window = np.outer(k, k) / k.sum() ** 2
    total = []
    for c in range(3):
        for i, j in itertools.product(range(a.shape[0] - 10), range(a.shape[1] - 10)):
            x, y = (p[i:i + 11, j:j + 11, c].astype(float) for p in (a, b))
            mx, my = (window * x).sum(), (window * y).sum()
            vx, vy, vxy = (window * x * x).sum() - mx * mx, (window * y * y).sum() - my * my, (window * x * y).sum() - mx * my
            c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
            total.append((2 * mx * my + c1) * (2 * vxy + c2) / ((mx ** 2 + my ** 2 + c1) * (vx + vy + c2)))
    return np.mean(total)


def test_ssim_equals_a_naive_loop_is_one_for_equal_pictures_and_none_for_tiny_ones():
    a = picture(14, 16, 3)
    b = np.clip(a * 0.7 + picture(14, 16, 3, seed=1) * 0.3, 0, 255).astype(np.uint8)
    assert g.ssim(a, b) == pytest.approx(naive_ssim(a, b), rel=1e-6)
    assert g.ssim(a, a) == pytest.approx(1) and g.ssim(a[:10], b[:10]) is None


def fake_lpips():
    torch.manual_seed(0)
    trunk, heads = {}, {}
    sizes = (3, 64, 11), (64, 192, 5), (192, 384, 3), (384, 256, 3), (256, 256, 3)
    for i, (index, (a, b, k)) in enumerate(zip((0, 3, 6, 8, 10), sizes)):
        trunk[f"features.{index}.weight"] = torch.randn(b, a, k, k) * (2 / (a * k * k)) ** 0.5
        trunk[f"features.{index}.bias"] = torch.randn(b) * 0.1
        heads[f"lin{i}.model.1.weight"] = torch.rand(1, b, 1, 1)
    return g.lpips_from(trunk, heads), trunk, heads


def test_lpips_is_zero_for_equal_pictures_symmetric_and_grows_with_the_difference():
    net, *_ = fake_lpips()
    a, b = random(2, 1, 3, 64, 64, dtype=torch.float32)
    d = [net(a, a + k * (b - a)).item() for k in (0, 0.2, 1)]
    assert d[0] == 0 and 0 < d[1] < d[2]
    assert net(b, a).item() == pytest.approx(d[2], rel=1e-5)


def test_lpips_equals_a_naive_alexnet():
    net, trunk, heads = fake_lpips()
    a, b = random(2, 1, 3, 64, 64, dtype=torch.float32)
    mean, std = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, want = [((2 * p - 1) - mean[:, None, None]) / std[:, None, None] for p in (a, b)], 0.0
    for i, (index, stride, pad) in enumerate(((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1))):
        if index in (3, 6):
            x = [F.max_pool2d(p, 3, 2) for p in x]
        x = [F.relu(F.conv2d(p, trunk[f"features.{index}.weight"], trunk[f"features.{index}.bias"], stride, pad))
             for p in x]
        unit = [p / (p.norm(dim=1, keepdim=True) + 1e-10) for p in x]
        want += (heads[f"lin{i}.model.1.weight"] * (unit[0] - unit[1]) ** 2).sum(1).mean().item()
    assert net(a, b).item() == pytest.approx(want, rel=1e-4)


def test_lpips_without_its_weights_is_none_with_one_line_of_reason(capsys):
    assert g.make_lpips("cpu") is None
    assert capsys.readouterr().out.count("\n") == 1


def test_half_pixels_are_disjoint_and_complete(odd):
    for photo, (w, h) in enumerate(odd.wh.tolist()):
        left, right = (g.half_pixels(odd, photo, side).tolist() for side in (True, False))
        assert sorted(left + right) == list(range(w * h)) and {p % w for p in left} == set(range(w // 2))


def test_the_trivial_predictor_is_the_mean_colour_of_each_row_of_the_left_half():
    truth = g.to_uint8(random(16, 7, 3).numpy()) / 255
    flat = [[[round(255 * sum(truth[i, j, c] for j in range(3)) / 3) for c in range(3)]] * 4 for i in range(16)]
    row = g.score(dict(rgb=truth, truth=truth), None, "cpu")
    assert row["psnr_floor"] == pytest.approx(g.psnr(np.array(flat, np.uint8), g.to_uint8(truth)[:, 3:]), abs=1e-9)
    assert row["psnr"] == 100


def test_to_uint8_rounds_and_clips():
    assert g.to_uint8(np.array([-1, 0, 0.4999 / 255, 0.5001 / 255, 1, 2])).tolist() == [0, 0, 0, 1, 255, 255]


def with_pixels(scene, left, value):
    """The scene with one half of every test photo painted over."""
    rgb = scene.rgb.clone()
    for photo in torch.nonzero(scene.is_test)[:, 0].tolist():
        rgb[scene.start[photo] + g.half_pixels(scene, photo, left)] = value
    return scene._replace(rgb=rgb)


@pytest.mark.parametrize("protocol, blind", [("half", True), ("leaky", False)])
def test_fitting_a_code_never_sees_the_right_half_unless_the_protocol_leaks(warm, scene, protocol, blind):
    photos = torch.nonzero(scene.is_test)[:, 0]
    before = copy.deepcopy(weights(warm))
    a, b, c = (g.fit_codes(warm, s, photos, None, 2, protocol, 16)
               for s in (scene, with_pixels(scene, False, 255), with_pixels(scene, True, 255)))
    assert torch.equal(a, b) is blind and not torch.equal(a, c)
    assert all(torch.equal(v, before[k]) for k, v in weights(warm).items())
    assert all(p.requires_grad and p.grad is None for p in warm.parameters())


def test_fitting_codes_starts_from_the_mean_code_of_training_photos(warm, scene):
    photos = torch.nonzero(scene.is_test)[:, 0]
    want = warm.codes()[~scene.is_test].mean(0).expand(len(photos), -1)
    close(g.fit_codes(warm, scene, photos, None, 0, "half"), want.detach())


def test_fitting_codes_lowers_the_error(warm, scene):
    photos = torch.nonzero(scene.is_test)[:, 0]
    dark = with_pixels(scene, True, 0)  # a code can at least darken the picture

    def brightness(codes):
        rays = g.make_rays(dark, photos.repeat_interleave(60), torch.arange(120) % 60 * 11)
        return warm.render(rays, codes.repeat_interleave(60, 0))["rgb"].mean().item()
    start, end = (g.fit_codes(warm, dark, photos, None, n, "half", 32) for n in (0, 20))
    assert brightness(end) < brightness(start)


def test_fitting_goes_on_from_given_codes(warm, scene):
    photos = torch.nonzero(scene.is_test)[:, 0]
    given = torch.full((len(photos), 4), 0.3)
    assert torch.equal(g.fit_codes(warm, scene, photos, given, 0, "half"), given)


def test_validation_sees_left_halves_only(warm, scene):
    photos = torch.nonzero(scene.is_test)[:, 0]
    values = [g.validate(warm, s, photos, torch.zeros(len(photos), 4))[1]
              for s in (scene, with_pixels(scene, False, 255), with_pixels(scene, True, 255))]
    assert values[0] == values[1] != values[2] and math.isfinite(values[0])


class Perfect(nn.Module):
    """A model that renders the right halves of photos perfectly, and the left halves black."""

    use_mask = True

    def __init__(self, scene):
        super().__init__()
        self.cfg, self.appearance = config(), nn.Embedding(len(scene.wh), 2)
        self.raw = scene.raw

    def sdf(self, x):
        world = x.double().numpy() * self.raw["scale"] + self.raw["center"]
        return torch.as_tensor(data_prep.toy_sdf(world) / self.raw["scale"]), None

    def render(self, rays, code):
        return dict(rgb=rays.rgb * (rays.uv[:, :1] > 0.499) + 0 * code.sum(), depth=rays.near)

    def codes(self):
        return self.appearance.weight

    def mask_of(self, rays, pick):
        w, h = self.raw["wh"][int(pick)]
        pixel = (rays.uv[:, 1] * h).long() * w + (rays.uv[:, 0] * w).long()
        return torch.as_tensor(self.raw["occluder"][self.raw["start"][int(pick)]:][pixel.numpy()]).float()


def test_only_the_right_half_is_scored(scene):
    scores = g.evaluate(Perfect(scene), scene, config(), None)
    assert scores["psnr"] == pytest.approx(100) and scores["ssim"] == pytest.approx(1) and scores["lpips"] is None
    assert len(scores["per_image"]) == 2 and 5 < scores["psnr_floor"] < 40
    assert scores["psnr_floor"] == pytest.approx(np.mean([row["psnr_floor"] for row in scores["per_image"]]))


def test_scoring_without_test_photos_gives_none(scene):
    scores = g.evaluate(Perfect(scene), scene._replace(is_test=torch.zeros_like(scene.is_test)), config(), None)
    assert scores["psnr"] is None and scores["per_image"] == []


def test_truth_of_the_toy_is_matched_by_a_perfect_model(scene):
    found = g.toy_truth(Perfect(scene), scene)
    assert found["sdf_error"] < 1e-6 and found["mask_iou"] == 1 and found["mask_static"] == 0


def test_a_mask_over_everything_is_right_only_where_something_passes_by(scene):
    model = Perfect(scene)
    model.mask_of = lambda rays, pick: torch.ones(len(rays.o))
    photos = [scene.raw["occluder"][a:b:5] for a, b, test in zip(
        scene.raw["start"], scene.raw["start"][1:], scene.raw["is_test"]) if not test]
    found = g.toy_truth(model, scene)
    assert found["mask_iou"] == pytest.approx(np.concatenate(photos).mean()) and found["mask_static"] == 1
    model.use_mask = False
    assert g.toy_truth(model, scene)["mask_iou"] is None


def test_sdf_error_of_a_shifted_surface_is_the_shift(scene):
    model = Perfect(scene)
    model.sdf = lambda x: (Perfect.sdf(model, x)[0] + 0.01, None)
    assert g.toy_truth(model, scene)["sdf_error"] == pytest.approx(0.01, rel=1e-3)


def test_validation_is_the_mean_of_the_photos_own_psnr(scene, monkeypatch):
    monkeypatch.setattr(g, "fit_codes", lambda model, scene, photos, *more: torch.zeros(len(photos), 1))
    photos = scene.photos(True)
    off = {photos[0].item(): 0.01, photos[1].item(): 0.1}  # 40 and 20 dB
    model = SimpleNamespace(render=lambda rays, code: dict(
        rgb=rays.rgb + torch.tensor([off[i] for i in rays.img.tolist()])[:, None]))
    assert g.validate(model, scene, photos, None)[1] == pytest.approx(30, abs=1e-3)
    off |= dict.fromkeys(off, 0.0)
    assert g.validate(model, scene, photos, None)[1] == pytest.approx(100)  # a perfect view has a finite score


def test_rendering_a_photo_keeps_its_shape_and_pixel_order_whatever_the_chunk(warm, scene, monkeypatch):
    for photo in (0, 1):
        whole = g.render_photo(warm, scene, photo, warm.appearance.weight[photo])
        w, h = scene.wh[photo].tolist()
        assert whole["rgb"].shape == (h, w, 3) and whole["mask"].shape == whole["depth"].shape == (h, w)
        assert "eikonal" not in whole  # figures of samples would fill the memory of many photos
        assert np.array_equal(g.to_uint8(whole["truth"][3, 5]), pixel_of(scene, photo, 5, 3))
    monkeypatch.setattr(g, "CHUNK", 100)
    close(g.render_photo(warm, scene, 1, warm.appearance.weight[1])["rgb"], whole["rgb"], atol=1e-4)


@pytest.fixture(scope="session")
def mesh(warm):
    return g.extract_mesh(warm, 120)  # two slabs


def test_mesh_of_the_warm_up_sphere_is_that_sphere_in_sfm_units(warm, scene, mesh):
    vertices, faces, colors = mesh
    r = np.linalg.norm((vertices - scene.raw["center"]) / scene.raw["scale"], axis=1)
    assert len(faces) > 1000 and colors.shape == vertices.shape and colors.dtype == np.uint8
    assert abs(r.mean() - 0.5) < 0.02 and np.abs(r - 0.5).max() < 0.08


def test_mesh_is_closed_and_its_faces_look_outwards(scene, mesh):
    vertices, faces, _ = mesh
    a, b, c = (vertices[faces[:, i]] - scene.raw["center"] for i in range(3))
    volume = (np.cross(a, b) * c).sum() / 6 / scene.raw["scale"] ** 3
    assert volume == pytest.approx(4 / 3 * math.pi * 0.5 ** 3, rel=0.1)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forth, back = (set(map(tuple, e.tolist())) for e in (directed, directed[:, ::-1]))
    assert len(forth) == len(directed) and forth == back  # each edge once in each direction


def test_mesh_of_an_empty_scene_is_empty(warm):
    model = copy.deepcopy(warm)
    with torch.no_grad():
        model.sdf.lin2.weight.zero_()
        model.sdf.lin2.bias.fill_(0.4)
    model.refresh_cache(0, 1)
    assert [len(part) for part in g.extract_mesh(model, 16)] == [0, 0, 0]
    constant_sdf(model, -1e-3)  # near a surface everywhere, but never on its other side
    assert [len(part) for part in g.extract_mesh(model, 16)] == [0, 0, 0]


def read_ply(path):
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    nv, nf = (int(re.search(rb"element %s (\d+)" % k, head)[1]) for k in (b"vertex", b"face"))
    v = np.frombuffer(body, [("xyz", "<f4", 3), ("rgb", "u1", 3)], nv)
    f = np.frombuffer(body, [("n", "u1"), ("index", "<i4", 3)], nf, offset=nv * 15)
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n") and len(body) == nv * 15 + nf * 13
    return v["xyz"].copy(), f["index"], v["rgb"], f["n"]


def test_ply_reads_back_as_written(tmp_path, mesh):
    g.write_ply(tmp_path / "mesh.ply", *mesh)
    vertices, faces, colors, n = read_ply(tmp_path / "mesh.ply")
    close(vertices, mesh[0], rtol=1e-6)
    assert np.array_equal(faces, mesh[1]) and np.array_equal(colors, mesh[2]) and (n == 3).all()


def test_png_reads_back_as_written_in_rgb(tmp_path):
    a = picture(5, 8, 3)
    g.write_png(tmp_path / "a.png", a)
    assert np.array_equal(g.cv2.imread(str(tmp_path / "a.png"))[:, :, ::-1], a)


def test_colormap_is_monotone_in_brightness_and_survives_a_flat_picture():
    grey = g.colormap(np.linspace(0, 1, 64)[None], 0, 1).astype(float).mean(2)[0]
    assert grey[-1] > grey[32] > grey[0]
    assert np.isfinite(g.colormap(np.ones((2, 2)), 1, 1)).all()


def test_camera_path_starts_and_ends_at_cameras_with_rotations_all_along(scene):
    c2w = scene.c2w[~scene.is_test]
    path = g.camera_path(c2w, 50)
    turn = path[:, :, :3]
    close(turn @ turn.transpose(1, 2), torch.eye(3).expand(50, 3, 3), atol=1e-4)
    assert (torch.linalg.det(turn) > 0).all()
    for end in (path[0], path[-1]):
        assert (c2w - end).abs().amax((1, 2)).min() < 1e-3
    assert (path[1:, :, 3] - path[:-1, :, 3]).norm(dim=1).max() < (path[0, :, 3] - path[-1, :, 3]).norm()


@pytest.mark.parametrize("kind", ["orbit", "appearance"])
def test_films_have_their_frames(warm, scene, tmp_path, kind):
    g.film(warm, scene, kind, tmp_path / "a.mp4", count=3)
    video, frames = g.cv2.VideoCapture(str(tmp_path / "a.mp4")), 0
    while video.read()[0]:
        frames += 1
    assert frames == 3


# ---- 12 experiments ------------------------------------------------------------------------------------

@pytest.mark.parametrize("rows", ["PIECES", "RIVALS", "FRONT", "STRESS_METHODS"])
def test_rows_of_experiments_change_settings_that_exist(rows):
    known = {f.name for f in dataclasses.fields(g.Config)}
    assert all(set(row) <= known for row in getattr(g, rows).values())


def test_every_row_of_the_ablation_differs_from_the_full_method():
    assert g.PIECES["full"] == {}
    assert all(row[k] != getattr(g.Config(), k) for row in g.PIECES.values() for k in row)


def test_the_knobs_of_the_stress_chart_turn_away_from_the_calm_toy():
    assert g.STRESS.keys() == g.CALM.keys() == g.KNOB_UNITS.keys()
    assert all(g.CALM[knob] in values and len(set(values)) > 1 for knob, values in g.STRESS.items())


def test_the_pareto_front_is_what_nothing_beats_at_the_same_cost():
    assert g.pareto([(1, 10), (2, 9), (3, 12), (3, 11), (4, 12.5)]) == [(1, 10), (3, 12), (4, 12.5)]


def test_presets_are_factors_and_flags_override_them():
    base, fast, best = (g.make_config(dict(preset=name)) for name in ("default", "fast", "best"))
    assert fast.rays < base.rays == best.rays and fast.steps < base.steps < best.steps
    assert base == g.make_config({}) != fast
    assert g.make_config(dict(preset="fast", steps=12)).steps == 12
    sacre, nerfw = (g.make_config(dict(preset="fast") | more) for more in (dict(scene="sacre"), dict(method="nerfw")))
    assert sacre.rays == round(g.LARGE["rays"] * g.PRESETS["fast"]["rays"])
    assert nerfw.rays == g.METHODS["nerfw"][1]["rays"]  # baselines keep their own
    for preset in g.PRESETS:
        g.check(g.make_config(dict(preset=preset)))


def test_tuned_baselines_replace_published_settings():
    published, tuned = (g.make_config(dict(method="nerfw", tuned=t)) for t in (False, True))
    assert (published.hidden, published.samples) == (256, 64) and tuned.hidden < 256


def test_a_level_is_reached_where_the_curve_crosses_it():
    curve = [dict(psnr=10.0, seconds=1.0, wh=None), dict(psnr=20.0, seconds=100.0, wh=None)]
    assert g.reached(curve, 15, "seconds") == pytest.approx(10)  # half way in log time
    assert g.reached(curve, 5, "seconds") == 1 and g.reached(curve, 20, "seconds") == pytest.approx(100)
    assert g.reached(curve, 21, "seconds") is None and g.reached(curve, 15, "wh") is None


def test_summary_is_mean_and_spread_and_none_when_nothing_was_measured():
    rows = [dict(a=1.0, b=None), dict(a=3.0, b=None)]
    assert g.summary(rows, "a") == (2.0, 1.0) and g.summary(rows, "b") == (None, None) == g.summary(rows, "c")


def test_table_leaves_cells_empty_that_were_not_measured(tmp_path):
    rows = [dict(x=1.23456789, y=None, z="n"), dict(x=2, y=3.0, z="m, k")]
    g.publish(str(tmp_path / "a"), rows, SimpleNamespace(savefig=lambda tmp, **_: tmp.write_text("drawn")))
    assert (tmp_path / "a.csv").read_text() == 'x,y,z\n1.2346,,n\n2,3,"m, k"\n'
    assert (tmp_path / "a.png").read_text() == "drawn"


def finished(folder, **metrics):
    """A run folder as training leaves it."""
    folder.mkdir(parents=True)
    curve = [dict(step=i, seconds=2.0 ** i, psnr=15.0 + i, wh=None) for i in range(3)]
    base = dict(scene="toy", device="cpu", curve=curve, psnr_floor=14.0, psnr=18.0, energy_wh=None,
                psnr_mean_color=13.0, train_seconds=4.0,
                config=dataclasses.asdict(g.make_config(dict(steps=1))))
    (folder / "metrics.json").write_text(json.dumps(base | metrics))
    return str(folder)


def test_a_chart_of_nothing_but_failures_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "metrics.json").write_text(json.dumps(
        dict(failed="diverged", method="geonvsw", curve=[], config=dict(tuned=False))))
    with pytest.raises(g.UserError, match="all of these runs failed"):
        g.main(["--chart", "a"])
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("flags, minutes", [([], 2.0), (["--steps", "7"], 0.0), (["--minutes", "1"], 1.0)])
def test_a_chart_runs_for_two_minutes_or_as_long_as_it_is_told(monkeypatch, flags, minutes):
    given = []
    monkeypatch.setattr(g, "matrix", lambda kind, rows, settings, seeds: given.append(settings))
    monkeypatch.setattr(g, "chart", lambda *a: None)
    g.main(["--chart", *flags])
    assert given[0]["minutes"] == minutes and given[0]["curve"]


def test_chart_of_finished_runs_writes_picture_and_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = [finished(tmp_path / name, method=method, psnr=value)
            for name, method, value in (("a", "geonvsw", 20.0), ("b", "geonvsw", 22.0), ("c", "nerfw", 17.0))]
    g.main(["--chart", *runs])
    head, *rows = [line.split(",") for line in (tmp_path / "chart.csv").read_text().splitlines()]
    table = {row[0]: dict(zip(head, row)) for row in rows}
    assert list(table) == ["geonvsw", "nerfw"] and table["geonvsw"]["runs"] == "2"
    assert float(table["geonvsw"]["psnr"]) == 21 and float(table["geonvsw"]["psnr_std"]) == 1
    assert table["nerfw"]["energy_wh"] == "" and float(table["nerfw"]["seconds_to_16dB"]) == pytest.approx(2)
    assert table["nerfw"]["seconds_to_25dB"] == "" and (tmp_path / "chart.png").stat().st_size > 1000


def test_chart_without_matplotlib_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UserError, match="pip install matplotlib"):
        g.chart("chart", {})


def test_a_finished_run_of_a_matrix_is_read_and_not_repeated(tmp_path):
    run = Path(finished(tmp_path / "a", method="geonvsw", psnr=12.5))
    assert g.run_once(dict(steps=1), run)["psnr"] == 12.5


@pytest.mark.parametrize("flag, how", [([], ""), (["--tuned"], " tuned")])
def test_a_chart_trains_all_methods_for_the_same_time(tmp_path, monkeypatch, flag, how):
    monkeypatch.chdir(tmp_path)
    trained, drawn = {}, {}
    monkeypatch.setattr(g, "matrix", lambda kind, rows, given, seeds: trained.update(
        {name: g.make_config(given | row) for name, row in rows.items()}))
    monkeypatch.setattr(g, "chart", lambda kind, groups: drawn.update(kind=kind))
    g.main(["--chart", *flag, "--minutes", "3"])
    assert list(trained) == [m + how for m in ("geonvsw", "nerfw", "hanerf")] and drawn == dict(kind="chart")
    assert {(cfg.minutes, cfg.curve) for cfg in trained.values()} == {(3.0, True)}
    assert all(cfg.tuned == (flag != []) for cfg in trained.values())


def test_a_run_of_other_settings_is_not_taken_for_this_one(tmp_path, monkeypatch):
    run, calls = Path(finished(tmp_path / "a", method="geonvsw", psnr=12.5)), []
    monkeypatch.setattr(g, "execute", lambda cfg, arrays, run: calls.append(cfg))
    monkeypatch.setattr(g, "find_scene", lambda cfg: dict(is_test=np.array([True])))
    g.run_once(dict(steps=2), run)
    assert [cfg.steps for cfg in calls] == [2]


def test_failures_are_counted_and_their_scores_not_left_out():
    good = dict(psnr=20.0, psnr_mean_color=12.0, octree_cells=[8, 16])
    bad, lost = dict(good, psnr=10.0), dict(failed="the last 20 steps ...")
    line = g.table_line(dict(row="x"), [good, bad, lost])
    assert (line["row"], line["runs"], line["failures"]) == ("x", 3, 2)
    assert line["psnr"] == 15 and line["cells"] == 24 and line["energy_wh"] is None


def test_time_ratios_compare_with_where_nerfw_ends(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = {name: [g.read_metrics(Path(finished(tmp_path / name, method=name)))] for name in ("geonvsw", "nerfw")}
    for i, point in enumerate(runs["geonvsw"][0]["curve"]):
        point.update(psnr=17.0 + 5 * i)  # is at once where NeRF-W ends after 4 s
    g.chart("chart", runs)
    head, *rows = [line.split(",") for line in (tmp_path / "chart.csv").read_text().splitlines()]
    mine, theirs = (dict(zip(head, row)) for row in rows)
    assert float(mine["seconds_ratio_nerfw_end"]) == pytest.approx(1 / 4)
    assert float(theirs["seconds_ratio_nerfw_end"]) == 1 and "seconds_ratio_hanerf_end" not in head
    assert mine["wh_ratio_nerfw_end"] == "" == mine["wh_to_nerfw_end"]


SMALL_TOY = dict(occluders=0.2, exposure=1.0, photos=4, pose_noise=0.0, amp="off")


def test_stress_fills_its_table_and_picture(tmp_path, monkeypatch, brief):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(g, "CALM", SMALL_TOY)
    monkeypatch.setattr(g, "STRESS", dict(pose_noise=(0.0, 2.0), amp=("off", "on")))
    monkeypatch.setattr(g, "STRESS_METHODS", {"full": {}, "no mask": dict(mask="off")})
    monkeypatch.setattr(g, "find_scene", lambda cfg: dict(is_test=np.array([True])))
    g.stress({k: v for k, v in (TINY | dict(steps=2)).items()}, 1, 1)
    head, *rows = [line.split(",") for line in (tmp_path / "stress.csv").read_text().splitlines()]
    rows = [dict(zip(head, row)) for row in rows]
    assert [(r["knob"], r["value"], r["method"]) for r in rows] == [
        (k, v, m) for k, v in (("pose_noise", "0"), ("pose_noise", "2"), ("amp", "off"), ("amp", "on"))
        for m in ("full", "no mask")]
    same = [[r[k] for k in head[3:]] for r in rows if (r["knob"], r["value"]) in (("pose_noise", "0"), ("amp", "off"))]
    assert same[:2] == same[2:] and all(r["psnr"] for r in rows)  # knobs share the calm cell
    assert len(list((tmp_path / "runs" / "stress").iterdir())) == 6 and (tmp_path / "stress.png").exists()


def test_processes_side_by_side_give_the_runs_of_one(tmp_path, monkeypatch, arrays):
    monkeypatch.chdir(tmp_path)
    data_prep.write_scene(tmp_path / "data" / "toy.npz", arrays)
    row = {"a": TINY | dict(steps=2, mask="off")}
    (side,), (alone,) = (g.matrix(kind, row, {}, n, n)["a"][:1] for kind, n in (("two", 2), ("one", 1)))
    assert side["psnr"] == pytest.approx(alone["psnr"], abs=1e-3)
    assert sorted(p.name for p in (tmp_path / "runs" / "two").iterdir()) == ["a-0", "a-1"]


def test_ablation_fills_its_table_with_depths_around_the_footprints(tmp_path, monkeypatch, arrays, brief):
    monkeypatch.chdir(tmp_path)
    data_prep.write_scene(tmp_path / "data" / "toy.npz", arrays)
    monkeypatch.setattr(g, "PIECES", {k: g.PIECES[k] for k in ("full", "half depth", "double depth")})
    g.ablation(TINY | dict(steps=2, levels=1), 1, 1)
    head, *rows = [line.split(",") for line in (tmp_path / "ablation.csv").read_text().splitlines()]
    assert [row[0] for row in rows] == ["full", "half depth", "double depth"] and (tmp_path / "ablation.png").exists()
    levels = [g.read_metrics(p)["config"]["levels"] for p in sorted((tmp_path / "runs" / "ablation-toy").iterdir())]
    assert levels == [2, 1, 1]  # double, full, half: not below one level


def test_an_ablation_of_nothing_but_diverged_runs_is_a_table_of_failures(tmp_path, monkeypatch, arrays, brief):
    monkeypatch.chdir(tmp_path)
    data_prep.write_scene(tmp_path / "data" / "toy.npz", arrays)
    monkeypatch.setattr(g, "PIECES", {"full": {}})
    poisoned(monkeypatch)
    g.ablation(TINY | dict(steps=2 * g.PATIENCE), 1, 1)
    head, row = [line.split(",") for line in (tmp_path / "ablation.csv").read_text().splitlines()]
    line = dict(zip(head, row))
    assert line["failures"] == "1" and line["psnr"] == "" and (tmp_path / "ablation.png").exists()


# ---- 13 command line -----------------------------------------------------------------------------------

FLAGS = [f"--{k}={v}" for k, v in TINY.items()]
METRICS = """scene method seed steps device psnr psnr_floor ssim lpips per_image train_seconds energy_wh energy_source
    rays_per_second parameters octree_cells model_bytes protocol torch commit sdf_error mask_iou""".split()


@pytest.fixture
def desk(tmp_path, monkeypatch, arrays, brief):
    """An empty working folder with the tiny toy scene in it."""
    monkeypatch.chdir(tmp_path)
    data_prep.write_scene(tmp_path / "data" / "toy.npz", arrays)
    return tmp_path


def command(*argv):
    """Exit code of a command line."""
    try:
        g.run_command_line(lambda: g.main(list(argv)))
    except SystemExit as end:
        return end.code
    return 0


def metrics_of(desk, name):
    return json.loads((desk / "runs" / name / "metrics.json").read_text())


def test_one_command_trains_scores_and_writes_everything(desk, capsys):
    assert command(*FLAGS, "--name", "a", "--seed", "3") == 0
    run, metrics = desk / "runs" / "a", metrics_of(desk, "a")
    assert {p.name for p in run.iterdir()} == {"metrics.json", "log.jsonl", "checkpoint.pt", "panel.png", "mesh.ply"}
    assert not [k for k in METRICS if k not in metrics]
    assert metrics["seed"] == 3 and metrics["steps"] == 6 and metrics["scene"] == "toy" and metrics["lpips"] is None
    assert metrics["energy_wh"] is None or metrics["energy_wh"] > 0
    assert metrics["rays_per_second"] == pytest.approx(6 * 64 / metrics["train_seconds"])
    assert metrics["config"]["seed"] == 3 and "left half" in metrics["protocol"]
    assert "lpips is null" in capsys.readouterr().out
    assert [json.loads(line)["step"] for line in (run / "log.jsonl").read_text().splitlines()][-1] == 6
    assert command("--resume", "--name", "a", "--steps", "8") == 0  # goes on with the run's own settings
    metrics = metrics_of(desk, "a")
    assert metrics["steps"] == 8 and metrics["config"]["hidden"] == 16 and metrics["config"]["seed"] == 3


@pytest.mark.parametrize("method", ["nerfw", "hanerf"])
def test_baselines_run_by_the_same_command(desk, method):
    more = dict(rays=1024, photos=1, samples=4, hidden=16, steps=2, method=method, name="a", protocol="leaky")
    assert command(*FLAGS, *(f"--{k}={v}" for k, v in more.items())) == 0
    metrics = metrics_of(desk, "a")
    assert "leaky" in metrics["protocol"]  # and says so
    assert metrics["method"] == method and metrics["psnr"] > 0 and metrics["sdf_error"] is None
    assert metrics["octree_cells"] is None and not (desk / "runs" / "a" / "mesh.ply").exists()


@pytest.mark.parametrize("problem", [UserError("x"), OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_problems_end_with_code_2_and_one_line(capsys, problem):
    def entry():
        raise problem
    with pytest.raises(SystemExit) as end:
        g.run_command_line(entry)
    err = capsys.readouterr().err
    assert end.value.code == 2 and err.startswith("error: ") and err.count("\n") == 1


BAD_COMMANDS = {
    "misspelt flag": (["--stepz", "3"], "--steps"),
    "abbreviated flag": (["--sam", "3"], "--sam"),
    "unknown scene": (["--scene", "brandenbrug"], "brandenburg"),
    "scene not there yet": (["--scene", "sacre"], "data_prep.py"),
    "no such folder": (["--data", "nowhere"], "nowhere"),
    "no GPU": (["--device", "cuda"], "cpu"),
    "unknown device": (["--device", "potato"], "potato"),
    "a device without numbers": (["--device", "meta"], "meta"),
    "unknown method": (["--method", "nerv"], "nerv"),
    "word for a number": (["--steps", "many"], "many"),
    "negative weight": (["--lam_gpl", "-1"], "lam_gpl"),
    "weight that is no number": (["--lr_grid", "nan"], "lr_grid"),
    "too few samples": (["--samples", "1"], "samples"),
    "no rays": (["--rays", "0"], "rays"),
    "one ray": (["--rays", "1", "--photos", "1"], "rays"),
    "more levels than corner keys can tell apart": (["--levels", "12"], "levels"),
    "a seed too long for a generator": (["--seed", "9" * 30], "seed"),
    "no background levels": (["--bg_levels", "0"], "bg_levels"),
    "no pixels for the mask": (["--mask_px", "1"], "mask_px"),
    "rays that do not divide": (["--rays", "10", "--photos", "3"], "photos"),
    "a grid of rays too small for Ha-NeRF": (["--method", "hanerf", "--rays", "16"], "rays"),
    "nothing to resume": (["--resume"], "--resume"),
    "nothing to film": (["--render", "orbit"], "checkpoint"),
    "nothing to chart": (["--chart", "nowhere"], "nowhere"),
}


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_a_mistake_ends_with_code_2_and_one_line_that_helps(desk, capsys, monkeypatch, case):
    argv, word = BAD_COMMANDS[case]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert command(*FLAGS, "--steps=1", *argv) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1 and word in err and not (desk / "runs").exists()


@pytest.mark.parametrize("saved", [dict(geonvs=1), dict(geonvs=1, config=dict(flux=88))])
def test_a_checkpoint_of_another_version_is_refused_in_one_line(desk, capsys, saved):
    (desk / "runs" / "a").mkdir(parents=True)
    torch.save(saved, desk / "runs" / "a" / "checkpoint.pt")
    assert command("--resume", "--name", "a") == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_split_named_once_stays_when_the_scene_is_made_again(desk, folder):
    """Otherwise photos held out so far would be trained on, without a word."""
    names = sorted(p.name for p in (folder / "dense/images").iterdir())
    table = desk / "mine.tsv"
    table.write_text("filename\tid\tsplit\n" + "".join(
        f"{n}\t{i}\t{'test' if i == 2 else 'train'}\n" for i, n in enumerate(names)))
    sys_argv = [str(folder), "--split", "mine.tsv", "--downscale", "1"]
    data_prep.main(sys_argv)
    for downscale in (1, 2):
        scene = g.find_scene(config(data=str(folder), downscale=downscale))
        assert scene["name"][scene["is_test"]].tolist() == [names[2]]
    table.unlink()
    with pytest.raises(g.UserError, match="mine.tsv is not there"):
        g.find_scene(config(data=str(folder), downscale=4))


def test_two_folders_of_one_name_are_two_scenes(desk, monkeypatch, arrays):
    made = []
    monkeypatch.setattr(data_prep, "prepare", lambda folder, *more: (made.append(str(folder)), arrays)[1])
    for folder in ("one/photos", "two/photos", "two/photos"):
        (desk / folder).mkdir(parents=True, exist_ok=True)
        g.find_scene(config(data=folder, downscale=1))
    assert made == ["one/photos", "two/photos"]


def test_a_baseline_of_a_scene_without_points_ends_in_words_or_works(scene):
    model = baseline(scene._replace(points=scene.points[:0]), "nerfw")
    assert model.far.isfinite().all()


def test_a_machine_without_git_gets_its_metrics(desk, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert command(*FLAGS, "--steps=1", "--name=a") == 0
    assert json.loads((desk / "runs" / "a" / "metrics.json").read_text())["commit"] is None


def test_a_device_is_taken_if_it_is_there(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    picked = {name: str(g.pick_device(name)) for name in ("auto", "cpu", "cuda", "cuda:1")}
    assert picked == {"auto": "cuda:0", "cpu": "cpu", "cuda": "cuda:0", "cuda:1": "cuda:1"}
    with pytest.raises(UserError, match="cuda:0, cuda:1"):
        g.pick_device("cuda:2")


def test_a_folders_scene_is_the_one_that_data_prep_made_until_its_split_changes(desk, monkeypatch, arrays):
    made = []
    monkeypatch.setattr(data_prep, "prepare", lambda folder, *more: (made.append(more), arrays)[1])
    (desk / "place").mkdir()
    downscale = json.loads(str(arrays["info"])).get("downscale")
    monkeypatch.setattr(sys, "argv", ["data_prep.py", "place", "--split", "mine.tsv"])
    data_prep.main()
    for want in (1, 1, 2, 2):
        if want == 2:
            (desk / "place" / "split.tsv").write_text("x")
            os.utime(desk / "place" / "split.tsv", (4e9, 4e9) if len(made) == 1 else (0, 0))
        g.find_scene(SimpleNamespace(data="place", scene="toy", downscale=downscale))
        assert len(made) == want


@pytest.mark.parametrize("given, home", [(dict(scene="sacre"), "data/sacre"), (dict(data="place"), "place"),
                                         (dict(scene="sacre"), "data/sacre_coeur")])
def test_a_scene_is_made_anew_when_its_split_or_its_poses_are(desk, monkeypatch, arrays, given, home):
    """Otherwise test photos would be trained on, or old poses, without a word."""
    made = []
    for maker in ("prepare", "locate_and_prepare"):
        monkeypatch.setattr(data_prep, maker, lambda *_: (made.append(0), arrays)[1])
    downscale = json.loads(str(arrays["info"]))["downscale"]
    model, split = desk / home / "dense/sparse/0/images.bin", desk / home / "x.tsv"
    model.parent.mkdir(parents=True)
    for source, when, want in ((model, 0, 1), (model, 0, 1), (model, 4e9, 2), (model, 0, 2), (split, 4e9, 3), (split, 0, 3)):
        source.touch()
        os.utime(source, (when, when))
        g.find_scene(config(downscale=downscale, **given))
        assert len(made) == want


def test_a_folder_called_toy_is_no_toy(desk, monkeypatch, arrays):
    made, other = [], arrays | dict(info=np.array(json.dumps(json.loads(str(arrays["info"])) | dict(downscale=2))))
    monkeypatch.setattr(data_prep, "prepare", lambda folder, *more: (made.append(more), other)[1])
    (desk / "a" / "toy").mkdir(parents=True)
    for downscale in (2, 2, 8):
        g.find_scene(config(data="a/toy", downscale=downscale))
    assert made == [(2, None), (8, None)]


@pytest.mark.parametrize("argv", [["--ablation", "--seeds", "0"], ["--stress", "--seeds", "-1"], ["--chart", "--seeds", "0"],
                                  ["--ablation", "--levels", "9"], ["--front", "--photos", "100"],
                                  ["--method", "hanerf", "--rays", "511"], ["--resume", "--preset", "fast"],
                                  ["--resume", "--tuned"]])
def test_what_cannot_work_is_refused_before_anything_runs(desk, capsys, monkeypatch, argv):
    monkeypatch.setattr(g, "train", None)
    assert command(*argv) == 2 and capsys.readouterr().err.count("\n") == 1
    assert [p.name for p in desk.iterdir()] == ["data"]


def test_experiments_are_not_for_torchrun(desk, capsys, monkeypatch):
    monkeypatch.setattr(g, "RANKS", 2)
    assert command("--ablation") == 2 and "one process" in capsys.readouterr().err


def test_a_new_run_leaves_nothing_of_the_former_one(scene, tmp_path, brief, monkeypatch):
    for name in ("checkpoint.pt", "metrics.json"):
        (tmp_path / name).write_text("old")

    def interrupted(*_):
        raise KeyboardInterrupt
    monkeypatch.setattr(g, "training_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_training(scene, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["log.jsonl"]


def test_resuming_takes_learning_rates_and_mask_from_the_flags(scene, tmp_path, brief, six, monkeypatch):
    rates, step = [], g.training_step
    monkeypatch.setattr(g, "training_step", lambda model, optimizer, *more: (rates.append(
        (model.use_mask, optimizer.param_groups[0]["base_lr"])), step(model, optimizer, *more))[1])
    for changes in (dict(), dict(lr_net=1e-5, mask="off")):
        run_training(scene, tmp_path, saved=g.read_checkpoint(six.run / "after_3.pt"), **changes)
    assert rates == [(True, config().lr_net)] * 3 + [(False, 1e-5)] * 3


def test_a_resumed_curve_goes_on_with_the_codes_it_had(scene, tmp_path, brief, monkeypatch):
    fake_clock(monkeypatch)
    run_training(scene, tmp_path, steps=40, curve=True)
    saved = g.read_checkpoint(tmp_path / "checkpoint.pt")
    codes, looked = saved["state"]["codes"], []
    assert saved["state"]["curve"] and codes.shape == (len(scene.photos(True)), config().appearance_dim)
    monkeypatch.setattr(g, "validate", lambda model, scene, photos, codes: (looked.append(codes), (codes, 1.0))[1])
    run_training(scene, tmp_path, steps=400, curve=True, saved=saved)
    assert torch.equal(looked[0], codes)


def test_a_finished_run_of_an_older_scene_is_run_again(desk, monkeypatch):
    run, calls = Path(finished(desk / "a", method="geonvsw", psnr=12.5)), []
    monkeypatch.setattr(g, "execute", lambda cfg, arrays, run: calls.append(cfg))
    given = {k: v for k, v in g.read_metrics(run)["config"].items()}
    for when, want in ((0, 0), (4e9, 1)):
        os.utime(desk / "data" / "toy.npz", (when, when))
        g.run_once(given, run)
        assert len(calls) == want


def test_a_run_without_scores_is_no_row_of_a_chart(desk, capsys):
    run = Path(finished(desk / "a", method="geonvsw"))
    (run / "metrics.json").write_text(json.dumps(g.read_metrics(run) | dict(psnr=None)))
    assert command("--chart", str(run)) == 2 and "no scores" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "[1]", "{}", "{\"psnr\": 1"])
def test_metrics_that_are_none_get_one_sentence(desk, capsys, text):
    (desk / "a").mkdir()
    (desk / "a" / "metrics.json").write_text(text)
    assert command("--chart", str(desk / "a")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "a/metrics.json is damaged" in error


def test_lpips_weights_that_cannot_be_read_leave_null(monkeypatch, capsys):
    for damage in (RuntimeError("not a zip"), EOFError(), KeyError("features.0.weight")):
        def broken(*_, **__):
            raise damage
        monkeypatch.setattr(torch.hub, "load_state_dict_from_url", broken)
        assert g.make_lpips("cpu") is None and "lpips is null" in capsys.readouterr().out


def test_only_the_panels_frames_are_kept(warm, scene, monkeypatch):
    monkeypatch.setattr(g, "fit_codes", lambda model, scene, photos, *_: model.codes()[photos])
    many = scene._replace(is_test=torch.arange(len(scene.wh)) > 1)
    scores = g.evaluate(warm, many, config(), None)
    assert len(scores["per_image"]) > 3 == len(scores["frames"])


def test_a_full_disk_at_a_checkpoint_is_one_sentence(scene, tmp_path, brief, monkeypatch):
    def full(whole, path):  # torch's writer has no OSError
        raise RuntimeError("PytorchStreamWriter failed writing file data/0: No space left on device")
    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(UserError, match="checkpoint.pt .*No space"):
        run_training(scene, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["log.jsonl"]


def test_ctrl_c_and_forbidden_folders_end_data_prep_in_a_sentence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for error, said in ((KeyboardInterrupt(), "stopped"), (PermissionError(13, "Permission denied"), "denied")):
        def broken(*_):
            raise error
        monkeypatch.setattr(data_prep, "prepare", broken)
        code, _, err = run_main("place")
        assert code == 2 and said in err and err.count("\n") == 1


def test_a_film_of_appearances_needs_codes(scene, tmp_path):
    with pytest.raises(UserError, match="orbit"):
        g.film(new_model(scene, appearance="off"), scene, "appearance", tmp_path / "a.mp4")


def test_experiments_without_held_out_photos_say_so(monkeypatch):
    monkeypatch.setattr(g, "find_scene", lambda cfg: dict(is_test=np.array([False])))
    with pytest.raises(UserError, match="held-out"):
        g.matrix("a", {"full": {}}, {}, 1)


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(g.Config)])
def test_every_setting_is_a_flag_with_help_and_is_used(name):
    text = re.sub(r"\s+", " ", g.make_parser().format_help())
    assert re.search(rf"--{name}\b", text)
    assert re.search(rf'\bcfg\.{name}\b|given\.get\("{name}"', Path(g.__file__).read_text())


def test_settings_of_scenes_and_methods_are_settings_and_flags_overrule_them():
    names = {f.name for f in dataclasses.fields(g.Config)}
    more = [*g.SCENES.values(), *(m for _, *both in g.METHODS.values() for m in both)]
    assert all(set(m) <= names for m in more) and set(data_prep.SCENES) < set(g.SCENES)
    assert g.make_config(dict(scene="sacre")).steps == g.SCENES["sacre"]["steps"]
    assert g.make_config(dict(scene="sacre", method="nerfw")).rays == g.METHODS["nerfw"][1]["rays"]
    assert g.make_config(dict(scene="sacre", method="nerfw", steps=9, rays=7)).rays == 7


@pytest.mark.parametrize("given", [dict(scene=s, method=m) for s in g.SCENES for m in g.METHODS])
def test_every_scene_and_method_has_settings_that_pass_the_check(given):
    g.check(g.make_config(given))


NOTEBOOK = json.loads(Path(g.__file__).with_name("tutorial.ipynb").read_text())["cells"]
CODE_CELLS = [c for c in NOTEBOOK if c["cell_type"] == "code"]
NOTEBOOK_TEXT = "\n".join("".join(c["source"]) for c in NOTEBOOK if c["cell_type"] == "markdown")


def test_readme_and_notebook_list_the_same_deviations_as_the_docstring():
    readme = Path(g.__file__).with_name("README.md").read_text()
    here, *there = (re.findall(r"^[ -]*`?\[(D\d+)\]`? +(.+)$", text, re.M)
                    for text in (g.__doc__, readme, NOTEBOOK_TEXT))
    assert here and there == [here, here]


def test_notebook_shows_every_numbered_equation_of_the_paper():
    assert re.findall(r"\\tag\{(\d)\}", NOTEBOOK_TEXT) == list("12345")


def test_notebook_defines_no_name_that_the_code_defines():
    code = "\n".join("".join(c["source"]) for c in CODE_CELLS)
    ours = set(re.findall(r"^ *(?:def|class) (\w+)", code, re.M))
    assert "show" in ours and not ours & ({*dir(g)} | {*dir(data_prep)})


def test_notebook_lies_here_as_one_clean_run_left_it():
    assert [c["execution_count"] for c in CODE_CELLS] == list(range(1, len(CODE_CELLS) + 1))
    outputs = [o for c in CODE_CELLS for o in c["outputs"]]
    assert any("image/png" in o.get("data", {}) for o in outputs)
    assert not [o for o in outputs if o["output_type"] == "error" or o.get("name") == "stderr"]
    assert Path(g.__file__).with_name("tutorial.ipynb").stat().st_size < 1.5e6


def test_deviations_listed_in_the_docstring_are_those_tagged_in_the_code():
    code = Path(g.__file__).read_text().replace(g.__doc__, "")
    listed = re.findall(r"^  \[(D\d+)\]", g.__doc__, re.M)
    assert len(listed) == len(set(listed)) and set(listed) == set(re.findall(r"\[(D\d+)\]", code))


# ---- 14 where the predecessors fail --------------------------------------------------------------
# One test per failure that users of the works behind this method report, named by its symptom. In
# brackets: repository and issue, or the file that has it. A: Neuralangelo, P: Permuto-SDF, W:
# NeuralRecon-W, I: instant-nsr-pl, C: CR-NeRF, H: Ha-NeRF.


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short training on a toy without passers-by, with every part of the model switched on, and
    some of its photos rendered with the mean appearance code."""
    arrays = toy(size=32, photos=12, test=3, occluders=0.0)
    scene = g.load_scene(arrays, "cpu", 32)
    run = tmp_path_factory.mktemp("trained")
    model, *_ = run_training(
        scene, run, rays=144, photos=6, samples=12, bg_samples=4, hidden=32, channels=4, steps=240,
        lr_net=5e-3, lr_grid=2e-2, lr_zeta=1e-2, mask="on", appearance="on")
    code = model.codes()[~scene.is_test].mean(0).detach()
    photos = [*scene.photos(False)[::3].tolist(), *scene.photos(True).tolist()]
    frames = {i: g.render_photo(model, scene, i, code) for i in photos}
    return SimpleNamespace(model=model, scene=scene, arrays=arrays, frames=frames,
                           log=last_log(run))


def test_failure_01_no_nan_when_rays_miss_the_sphere(warm, scene):
    """NaN in the first steps: root of a negative number, far < near (NeRF++ #10, A #102)."""
    model, (rays, pick) = copy.deepcopy(warm), batch(scene)
    o = torch.tensor([[0, 0, -3.0], [0, 5, 0], [0, 0, 0], [1, 0, 0], [0, 1, -3], [900, 0, 0]])
    d = F.normalize(random(64, 3, low=-1, dtype=torch.float32), dim=1)
    d[4::6] = torch.tensor([0.0, 0, 1])  # tangents
    rays = rays._replace(o=o[torch.arange(64) % 6], d=d)
    t0, t1, hit = g.sphere_interval(rays)
    assert 0 < hit.sum() < 64 and torch.equal(hit, t1 > t0) and (t0 >= rays.near).all()
    total, logs = model.losses(rays, pick, generator())
    total.backward()
    assert [k for k, v in logs.items() if not math.isfinite(v)] == []
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


def test_failure_02_no_jump_and_no_nan_after_resuming(scene, tmp_path):
    """NaN after a resume that lost part of the schedule, or late, out of the curvature (A #21,
    #22). A model with a past takes the same step before and after its checkpoint."""
    a, b = new_model(scene), new_model(scene, seed=1)
    photos, gens, optimizers = scene.photos(False), [generator(7), generator(8)], []
    a.refined = 3
    with torch.no_grad():
        a.deviation.v.fill_(0.7)
        for name in ("calibration", "level", "cache", "hits", "logits", "seen", "usual"):
            buffer = getattr(a, name)
            buffer.copy_(random(buffer.numel(), low=0.01).reshape(buffer.shape))
    optimizers = [g.make_optimizer(m) for m in (a, b)]
    state = dict(step=776)  # a step of the mask network
    g.training_step(a, optimizers[0], photos, state, 0.4, gens[0])  # gives Adam a past
    g.save_checkpoint(tmp_path / "c.pt", a.cfg, a, optimizers[0], gens[0], state)
    again = g.restore(g.read_checkpoint(tmp_path / "c.pt"), tmp_path / "c.pt", b, optimizers[1],
                      gens[1])
    steps = [g.training_step(m, opt, photos, s, 0.4, gen)  # by then, it has been refined thrice
             for m, opt, s, gen in zip((a, b), optimizers, (state, again), gens)]
    assert steps[0] == steps[1] and same_weights(a, b) and a.refined == b.refined == 3
    assert steps[0][1] == 0 and all(math.isfinite(v) for v in steps[0][0].values())


def test_failure_03_no_crash_when_all_is_empty(scene):
    """"0 samples", all rays in empty cells (SuperNormal #10, P #14). The background is still seen
    and still learns."""
    model, (rays, pick) = constant_sdf(new_model(scene), 5.0), batch(scene)
    away = rays._replace(o=5 * F.normalize(rays.o, dim=1), d=F.normalize(rays.o, dim=1))
    for some in (rays, away):
        model.zero_grad()
        total, logs = model.losses(some, pick, generator())
        total.backward()
        assert math.isfinite(total.item()) and float(logs["opacity"]) == 0
        assert (model.background.color[2].weight.grad != 0).any()
    assert float(logs["miss"]) == 1 and float(logs["eik"]) == 0


def test_failure_04_ray_count_neither_explodes_nor_vanishes(warm):
    """Rays per step adapted to the samples found: none or millions (P/train_permuto_sdf.py). Here
    rays and samples of a step are constants, whether the scene is empty or solid."""
    for value in (5.0, -5.0, 0.0):
        model, gen, seen, asked = constant_sdf(copy.deepcopy(warm), value), generator(), [], []
        optimizer, losses = g.make_optimizer(model), model.losses
        model.losses = lambda rays, *more: (seen.append(len(rays.o)), losses(rays, *more))[1]
        model.sdf.octree.register_forward_pre_hook(lambda _, args: asked.append(len(args[0])))
        for step in range(1, 4):
            g.training_step(model, optimizer, model.scene.photos(False), dict(step=step), 0.0, gen)
        assert seen == [64] * 3 and asked.count(64 * 8) == 3
        assert sum(asked) == 3 * 64 * (8 + 5 + 1)  # samples, taps and centre, losses


@pytest.mark.parametrize("how", ["analytic", "finite differences"])
def test_failure_05_normals_are_no_noise_under_mixed_precision(warm, monkeypatch, how):
    """Taps a few thousandths apart are equal in half precision (kaolin-wisp octree_grid.py)."""
    x, eps = g.random_ball(500, generator()), 1 / 64

    def derive(field, x):
        if how == "analytic":
            return field.with_gradient(x)[2]
        return g.finite_differences(lambda y: field(y)[0], x, eps)[0]
    with torch.no_grad():
        full = derive(warm.sdf, x)
        for kind in (torch.bfloat16, torch.float16):
            with torch.autocast("cpu", kind):
                assert torch.equal(derive(warm.sdf, x), full) and full.dtype == torch.float32
        with monkeypatch.context() as patch:
            patch.setattr(g, "TRILINEAR", g.TRILINEAR.double())
            error = full - derive(copy.deepcopy(warm.sdf).double(), x.double())
    assert error.norm(dim=1).max() < 1e-2 < full.norm(dim=1).min()


@pytest.mark.parametrize("normals", ["analytic", "fd"])
def test_failure_06_curvature_does_not_rise_as_eps_falls(warm, scene, normals, monkeypatch):
    """|lap| of a trilinear field sits on cell faces and grows as its step shrinks (A #172)."""
    model, (rays, _) = copy.deepcopy(warm), batch(scene, 512, 8)
    model.cfg = config(normals=normals, sampling="uniform")
    with torch.no_grad():
        model.sdf.octree.features[1:].normal_(0, 0.05)
        cell, loss = 2 * model.eps, []
        for eps in (cell, cell / 4, cell / 16):
            monkeypatch.setattr(g.GeoNVS, "eps", eps)
            loss.append(model.render(rays, model.codes()[rays.img])["e_curv"].mean().item())
    lap = [v * k / cell for v, k in zip(loss, (1, 4, 16))]
    assert lap[2] > 1.1 * lap[0]
    assert loss[0] >= loss[1] >= loss[2] > 0


def test_failure_07_sphere_does_not_stay_a_sphere(arrays, scene):
    """zeta stuck, scene outside the sphere, wrong poses (NeuS #25, Factored-NeuS #1, P #17)."""
    on = [arrays["points"][arrays["track_point"][arrays["track_photo"] == i]] for i in range(10)]
    miss = []
    for i, x in enumerate(on):
        w, h = arrays["wh"][i]
        uv, _ = data_prep.project(arrays["K"][i], arrays["c2w"][i], x.astype(float))
        ok = ((uv > 0) & (uv < (w, h))).all(1)
        pixel = torch.as_tensor(uv[ok].astype(int) @ (1, w))
        rays = g.make_rays(scene, torch.full_like(pixel, i), pixel)
        to_point = torch.as_tensor(x[ok]) - rays.o  # (P,3)
        along = (to_point * rays.d).sum(1)  # (P,) negative behind the camera
        angle = torch.atan2(torch.linalg.cross(to_point, rays.d).norm(dim=1), along)  # (P,)
        miss.append(angle * arrays["K"][i, 0])
    assert torch.cat(miss).median() < 2  # px
    assert json.loads(str(arrays["info"]))["reprojection_px"] < 2
    assert (scene.points.norm(dim=1) < 1).float().mean() > 0.8
    (rays, *_), model = ball_rays(), ball_model()
    zero, jitter = torch.zeros(40, 0), torch.full((40, 52), 0.5)
    sharp, model.deviation = g.render_rays(model, rays, zero, jitter)["rgb"], g.Deviation()
    (g.render_rays(model, rays, zero, jitter)["rgb"] - sharp).abs().mean().backward()
    assert model.deviation.v.grad < 0  # a surface in its place gets sharper


def test_failure_08_no_shell_around_the_scene(trained):
    """A cube or shell with the sky painted on it (A #129, I #17, #55, #56)."""
    x = g.random_ball(4000, generator())
    world_x = x.numpy() * trained.scene.raw["scale"] + trained.scene.raw["center"]
    true = torch.as_tensor(data_prep.toy_sdf(world_x) / trained.scene.raw["scale"])
    with torch.no_grad():
        s = trained.model.sdf(x)[0]
    free, shell = true > 0.1, x.norm(dim=1) > 0.8
    assert free.sum() > 1000 < (free & shell).sum() + 900
    assert (s[free] < 0).float().mean() < 0.05 > (s[free & shell] < 0).float().mean()


def test_failure_09_background_does_not_paint_everything(trained):
    """The foreground stays empty as the background reaches into the sphere (I #40, #78)."""
    model, scene, seen = trained.model, trained.scene, []
    hook = model.background.octree.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    rays, _ = batch(scene, 192, 6)
    with torch.no_grad():
        hit = model.render(rays, model.codes()[rays.img])["hit"]
    hook.remove()
    x = seen[0].reshape(192, -1, 3)[hit]
    assert hit.sum() > 50 and x.norm(dim=2).min() > 1 - 1e-4
    opacity = []
    for i in scene.photos(False)[::3].tolist():
        pixel = torch.arange(int(scene.wh[i].prod()))
        rays = g.make_rays(scene, torch.full_like(pixel, i), pixel)
        depth = torch.as_tensor(photo(trained.arrays, i, "depth").reshape(-1, 1)).float()
        on = (rays.at(depth)[:, 0].norm(dim=1) < 0.9) & depth[:, 0].isfinite()
        opacity.append(torch.as_tensor(trained.frames[i]["opacity"]).flatten()[on])
    assert torch.cat(opacity).median() > 0.9
    assert 0 < trained.log["opacity"] < 1  # its mean is logged


def test_failure_10_no_billboard_in_front_of_a_camera(trained):
    """Each photo grows its own billboard where no other looks (P/SphereGPU.cuh, I #20)."""
    model, scene, seen = trained.model, trained.scene, []
    hook = model.sdf.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    sdf, model.sdf.with_gradient = model.sdf.with_gradient, \
        lambda x: (seen.append(x), sdf(x))[1]
    rays, _ = batch(scene, 192, 6)
    rays = rays._replace(o=0.3 * rays.o, near=torch.full((192,), 0.5))  # inside the sphere
    with torch.no_grad():
        model.render(rays, model.codes()[rays.img])
    hook.remove()
    del model.sdf.with_gradient
    x = seen[0].reshape(192, -1, 3)
    assert (x - rays.o[:, None]).norm(dim=2).min() >= 0.5
    scores = {True: [], False: []}
    for i, frame in trained.frames.items():
        value = g.psnr(g.to_uint8(frame["rgb"]), g.to_uint8(frame["truth"]))
        scores[scene.is_test[i].item()].append(value)
    assert abs(np.mean(scores[True]) - np.mean(scores[False])) < 3


def test_failure_11_no_collapse_around_a_wrong_surface():
    """Worse with more training: samples sit where the surface was once thought to be (W #53)."""
    (rays, depth, disc), model = ball_rays(80), ball_model()
    t0, t1, _ = g.sphere_interval(rays)
    model.cache = model.cache.flip(2, 3, 4)  # the ball is believed to be on the other side
    edges = g.sample_sections(model, rays, t0, t1, 48, torch.full((80, 48), 0.5))
    assert (edges.diff(dim=1).max(1)[0] <= (t1 - t0) / (g.FLOOR * 47) * 1.01 + 1e-6).all()
    out = g.render_rays(model, rays, torch.zeros(80, 0), torch.full((80, 52), 0.5))
    hit = disc > 0.04
    assert hit.sum() > 10 and (out["opacity"][hit] > 0.9).all()
    close(out["depth"][hit], depth[hit], atol=0.1, rtol=0)


def test_failure_12_mask_does_not_eat_the_static_scene(trained):
    """Everything hard to fit is called transient, with weights made for squared errors (C, H
    losses.py; nerf-on-the-go #5, wild-gaussians #23). Nothing moves in this scene."""
    assert trained.model.use_mask
    assert max(frame["mask"].mean() for frame in trained.frames.values()) < 0.05
    assert trained.model.logits.sigmoid().mean() < 0.05


@pytest.mark.parametrize("start", [-4.0, 0.0, 4.0])
def test_failure_13_mask_is_not_stuck(warm, start):
    """Stuck at 1/2 before the pole of the bimodality term, or frozen at 0 or 1 (H #30). Plain
    gradient descent on free pixels: errors of 0.3 end masked and of 0.02 not, from any start."""
    model, pick = nobody_tracked(tuned(warm), 0.06), torch.tensor([0])
    model.cgnet = FreeLogits((1, 1, 16, 16))
    model.cgnet.logits.data.fill_(start)
    model.seen[0] = 0.0
    model.seen[0, :3, 8:] = 0.3
    for _ in range(400):
        model.mask_objective(pick).backward()
        with torch.no_grad():
            model.cgnet.logits -= 256 * model.cgnet.logits.grad  # the objective is a mean over 256
        model.cgnet.logits.grad = None
    mask = torch.sigmoid(model.cgnet.logits[0, 0])
    assert (mask[10:] > 0.9).all() and (mask[:6] < 0.1).all()


def test_failure_14_mask_is_the_same_in_training_and_evaluation():
    """BatchNorm with one photo a step: other masks in evaluation (C models/lightweight_seg.py)."""
    net, photo = cgnet(), random(3, 3, 32, 32, dtype=torch.float32)
    both = [net.train()(photo), net.eval()(photo)]
    assert torch.equal(*both)
    close(net(photo[1:2]), both[0][1:2], atol=1e-5)


@pytest.mark.parametrize("eps", [1e-3, 1e-5, 1e-7])
def test_failure_15_no_spikes_at_cell_borders(double, eps):
    """A tap that leaves the refined cells reads zeros: a spike of height 1 / eps (kaolin-wisp
    octree_grid.py). Here slopes across every border are those of the cells on its two sides."""
    octree = make_tree()
    fill(octree)
    face = []
    for level in range(1, octree.levels):
        x = octree.centres(level).double()
        inside = random(len(x), 3, low=-0.4, high=0.4) * octree.cell(level)
        for axis in range(3):
            inside[:, axis] = octree.cell(level) / 2
            face.append(x + inside)
    x = torch.cat(face)
    x = x[(x.abs() < octree.half - 2 * eps).all(1)]
    with torch.no_grad():
        grad, _ = g.finite_differences(lambda y: octree(y).sum((1, 2, 3)), x, eps)
        steepest = 2 * octree.features.abs().max() * sum(
            2 / octree.cell(level) for level in range(octree.levels))  # two channels, per axis
    assert len(x) > 1000 and grad.norm(dim=1).max() <= 3 * steepest


def test_failure_16_a_lost_surface_returns(monkeypatch):
    """Cells pruned where the surface was not are never looked at again (P/sdf_utils.py). A ball
    that moves by three cells is found by samples and by the octree."""
    shift, model, tree = torch.tensor([0.375, 0, 0]), ball_model(), refinable()
    g.GeoNVS.refine(tree, tree.optimizer)  # prunes around the old place
    monkeypatch.setitem(globals(), "CENTRE", CENTRE + shift)
    model.refresh_cache = functools.partial(g.GeoNVS.refresh_cache, model)
    model.refined = len(g.REFINE_AT)
    for step in range(64):
        g.GeoNVS.maintain(model, step, 0.0, None)
    rays, depth, disc = ball_rays(80)
    t0, t1, _ = g.sphere_interval(rays)
    edges = g.sample_sections(model, rays, t0, t1, 32, torch.full((80, 32), 0.5))[:, 1:-1]
    near = ((edges - depth[:, None]).abs() < 0.15).float().mean(1)[disc > 0.02]
    assert len(near) > 20 and near.min() > 0.6
    at = hit_the_ball(tree, 10, 0.5, (1.0, 0.2, 0.1))
    octree = tree.sdf.octree
    home = octree.key(octree.cell_of(at, 1), 1)
    assert not torch.isin(home, octree.split_keys[1]).any()  # not fine there
    g.GeoNVS.refine(tree, tree.optimizer)
    assert torch.isin(home, octree.split_keys[1]).all()


@pytest.fixture(scope="module")
def exposures(scene, tmp_path_factory):
    """Trained on photos that differ in nothing but exposure: each is one grey, dark or bright."""
    grey = torch.where(torch.arange(len(scene.wh)) % 2 == 0, 64, 191).to(torch.uint8)
    rgb = grey.repeat_interleave(scene.start.diff())[:, None].expand(-1, 3).contiguous()
    flat = scene._replace(rgb=rgb)
    model, *_ = run_training(flat, tmp_path_factory.mktemp("exposures"), steps=160, rays=64,
                             appearance="on", background="on", mask="off", lr_net=2e-2)
    return SimpleNamespace(model=model, scene=flat, grey=grey.float() / 255)


def test_failure_17_exposure_needs_no_floaters(exposures):
    """Colour changes are explained by floaters where codes reach not all parts (CityGaussian #43):
    seen from the same place, foreground and background both follow the code."""
    model, scene, train = exposures.model, exposures.scene, ~exposures.scene.is_test
    rays, _ = batch(scene, 512, 8)
    seen = {}
    for grey in exposures.grey.unique().tolist():
        code = model.codes()[train & (exposures.grey == grey)].mean(0)
        with torch.no_grad():
            seen[grey] = model.render(rays, code.expand(512, -1))
    miss, solid = ~seen[grey]["hit"], seen[grey]["opacity"] > 0.5
    assert miss.sum() > 20 < solid.sum()
    for grey, out in seen.items():
        for part in (miss, solid):
            assert (out["rgb"][part] - grey).abs().mean() < 0.1


def test_failure_18_unseen_photos_get_the_right_code(exposures):
    """Codes memorise the training photos, a test photo gets another one's (Octree-AnyGS #8,
    Scaffold-GS #38, splatfacto-w #16): fitted on the left, it must serve the right half."""
    model, scene = exposures.model, exposures.scene
    photos = scene.photos(True)
    assert exposures.grey[photos].unique().numel() == 2
    mean, fitted = (g.fit_codes(model, scene, photos, None, n, "half", 32) for n in (0, 60))
    error = []
    for i, *codes in zip(photos.tolist(), mean, fitted):
        right = g.half_pixels(scene, i, False)
        rays = g.make_rays(scene, torch.full_like(right, i), right)
        for code in codes:
            with torch.no_grad():
                rgb = model.render(rays, code.expand(len(right), -1))["rgb"]
            error.append((rgb - rays.rgb).abs().mean().item())
    assert max(error[1::2]) < 0.06 < min(error[::2])


def test_failure_19_the_metric_is_the_one_it_names(scene):
    """Window 3 or 11, whole or half photo, masked or not (NeuS #34, GS-W #6, C #3)."""
    truth = random(24, 40, 3).numpy()
    frame = dict(rgb=(truth + 0.1 * random(24, 40, 3, seed=1).numpy()).clip(0, 1), truth=truth,
                 mask=np.ones((24, 40)))
    half = [g.to_uint8(frame[k])[:, 20:] for k in ("rgb", "truth")]
    row = g.score(frame, None, "cpu")
    assert row["ssim"] == pytest.approx(naive_ssim(*half), abs=1e-4)
    mse = ((half[0].astype(float) - half[1]) ** 2).mean()
    assert row["psnr"] == pytest.approx(10 * math.log10(255 ** 2 / mse))
    frame["rgb"][:, :20] = 0  # the left half, and what the mask thinks, do not count
    assert g.score(frame | dict(mask=frame["mask"] * 0), None, "cpu")["psnr"] == row["psnr"]


def test_failure_20_split_is_joined_by_name(tmp_path, source):
    """Labels shift when rows are taken by position (C datasets: names without a pose are skipped,
    the table is not). Shuffled rows, stale numbers, names that only one side knows."""
    as_colmap(tmp_path / "place", source)
    table = tmp_path / "place" / "toy.tsv"
    head, *rows = table.read_text().splitlines()
    rows = [f"{9 - i}.0\t{row.split(chr(9), 1)[1]}" for i, row in enumerate(rows)]
    rows = ["77.0\ttest\ta_ghost.jpg\ttoy", *rows[::-1][1:], "\ttest\ttoy_000.png\ttoy"]
    table.write_text("\n".join([head, *rows]) + "\n")  # the last photo has no row any more
    made = data_prep.prepare(tmp_path / "place", 1)
    want = dict(zip(source["name"][:-1].tolist(), source["is_test"][:-1].tolist()))
    assert dict(zip(made["name"].tolist(), made["is_test"].tolist())) == want
    for i, name in enumerate(made["name"]):  # and each name kept its own picture
        assert np.array_equal(photo(made, i), photo(source, source["name"].tolist().index(name)))


def test_failure_21_lipschitz_loss_does_not_dominate(warm, scene):
    """The product of the bounds starts above the colour loss (P/models.py). At P's layer sizes."""
    model = copy.deepcopy(warm)
    inputs = model.color.layers[0].in_features
    model.color = g.LipschitzMLP([inputs, 128, 128, 64, 3])
    _, raw = model.losses(*batch(scene), generator())
    assert 0 < g.Config().lam_lps * raw["lps"] < 0.1 * raw["rgb"]


@pytest.mark.parametrize("normals, more", [("analytic", lambda n: n + 5), ("fd", lambda n: 5 * n)])
@pytest.mark.parametrize("samples", [4, 12])
def test_failure_22_derivatives_cost_no_more_than_their_taps(warm, scene, normals, more, samples):
    """4 to 7 times the evaluations (sdfstudio #247, #140): four taps share the sample's own value,
    closed-form normals need none, and placing samples asks the network nothing."""
    model, asked = copy.deepcopy(warm), []
    model.cfg, (rays, _) = config(normals=normals, samples=samples), batch(scene)
    model.sdf.octree.register_forward_pre_hook(lambda _, args: asked.append(len(args[0])))
    model.render(rays, model.codes()[rays.img])
    assert sum(asked) == 64 * more(samples)


def test_failure_23_the_grid_does_not_ignore_the_first_sphere(scene):
    """Random features outweigh xyz, or cells are missing where the sphere is (I #22)."""
    model = new_model(scene, hidden=64, levels=3, channels=4)
    model.start(generator())
    with torch.no_grad():
        x = g.random_ball(4000, generator(5))
        error = model.sdf(x)[0] - (x.norm(dim=1) - 0.25)
    assert error.square().mean().sqrt() < model.eps / 2  # a quarter of the finest cell
