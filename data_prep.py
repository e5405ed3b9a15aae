"""Scene files for geonvs.py: a synthetic landmark, or photos with a COLMAP reconstruction.

    python data_prep.py toy --occluders 0.4     -> data/toy.npz; every knob of make_toy is a flag
    python data_prep.py brandenburg --download  -> data/brandenburg.npz, from an archive of 5 GB
    python data_prep.py my_photos --sfm         raw photos, by pycolmap -> data/my_photos-*.npz
    python data_prep.py my_scene                my_scene/[dense/]{images,sparse} -> the same

The landmark lies in the unit sphere. A ray is c2w[:, 3] + t * d with |d| = 1; a distance is this t,
never a z-depth. Functions raise UserError, one sentence that says what to do.
"""
import argparse, contextlib, gzip, http.client, inspect, io, itertools, json, math, os, shutil
import struct, sys, tarfile, tempfile, time, urllib.request, zipfile, zlib
from pathlib import Path

import cv2, skimage.io
import numpy as np

SCENES = {"brandenburg": ("brandenburg_gate", "brandenburg.tsv"),   # name: (archive, split file)
          "sacre": ("sacre_coeur", "sacre.tsv"), "trevi": ("trevi_fountain", "trevi.tsv"),
          "taj": ("taj_mahal", "taj_mahal.tsv")}
ARCHIVE_URL = "https://www.cs.ubc.ca/research/kmyi_data/imw2020/TrainingData/"
SPLIT_URL = "https://nerf-w.github.io/data/selected_images/"
# A scene is one .npz of these arrays: I photos, J = I + 1, N pixels, K points, T observations. A
# toy has two more: depth float16 (N,), true distance, inf is sky; occluder bool (N,), by people.
FORMAT = dict(
    rgb="uint8 N3", start="int64 J",   # photo i is rgb[start[i]:start[i+1]], row by row
    wh="int32 I2", K="float64 I4",   # width, height; fx fy cx cy [px]; first pixel's centre 0.5 0.5
    c2w="float64 I34",   # camera to world; OpenCV: x right, y down, z forward
    is_test="bool I", name="<U I",   # held out from training; file name
    points="float32 K3", center="float64 3", scale="float64",   # SfM units: x * scale + center
    track_photo="int32 T", track_point="int32 T", track_uv="float32 T2",   # see statistics
    near="float32 I", footprint="float64", exposure_spread="float64", bg_color="float64 3",
    info="<U")   # JSON: scene, kind (toy or colmap), downscale, folder, split; of a toy its knobs
FAR = 1e9   # sound reconstructions have no larger number; float32 holds its square


class UserError(Exception):
    """Something that the person at the keyboard can mend: one sentence that says how."""


def need(ok, message):
    if not ok:
        raise UserError(message)


def tell(items, what):
    """Yields items; once that took ten seconds, a line of the terminal says how far it is."""
    begin, due, total = time.monotonic(), 10, len(items)
    for done, item in enumerate(items, 1):
        yield item
        past = time.monotonic() - begin
        if past > due or due > 10 and done == total:
            due, left, end = past + 1, past / done * (total - done), "\n" if done == total else ""
            print(f"\r  {what}: {done} of {total}, {left:.0f} s left ", end=end, flush=True)


def atomic_write(path, write):
    """write(temporary path), then rename: `path` is the whole old file or the whole new one."""
    part = path.with_name(f".{path.stem}.{os.getpid()}.{time.time_ns()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        need(write(part) is not False, f"cannot encode {path}")   # so cv2.imwrite says no
        os.replace(part, path)
    except OSError as e:
        raise UserError(f"cannot write {path} ({e.strerror or e}): free or choose a place") from e
    finally:
        if part.exists():
            part.unlink()


def write_scene(path, scene):
    """Uncompressed: a third larger, but six times faster to write and no slower to read."""
    atomic_write(path, lambda part: np.savez(part, **scene))


def refuse_bomb(path):
    """Raises BadZipFile for what is no zip file, or larger inside than outside: ours never are."""
    with zipfile.ZipFile(path) as file:
        if sum(member.file_size for member in file.infolist()) > os.path.getsize(path):
            raise zipfile.BadZipFile(f"{path} is larger inside than outside")


def read_scene(path):
    """The dictionary of a scene file; UserError unless it is whole, and fits FORMAT and itself."""
    try:
        refuse_bomb(path)
        with np.load(path, allow_pickle=False) as file:
            scene = {key: file[key] for key in file.files}
        start, wh, seen = scene["start"], scene["wh"], (scene["track_photo"], scene["track_point"])
        size = dict(I=len(wh), J=len(wh) + 1, K=len(scene["points"]), T=len(seen[0]), N=start[-1])
        for key, text in FORMAT.items():
            array, (kind, _, shape) = scene[key], text.partition(" ")
            need(array.shape == tuple(size.get(n) or int(n) for n in shape), key)
            need(str(array.dtype).startswith(kind), key)
            need(kind[0] != "f" or key == "bg_color" or np.isfinite(array).all(), key)
        need(start[0] == 0 and (wh > 0).all() and (np.diff(start) == wh.prod(1)).all(), "start")
        need(np.min(seen) >= 0 and (np.max(seen, 1) < (size["I"], size["K"])).all(), "tracks")
        need(min(scene["footprint"], scene["scale"]) > 0 and not scene["is_test"].all(), "scale")
        info = json.loads(str(scene["info"]))
        need({"kind", "scene", "downscale", "folder", "split"} <= {*info}, "info")
    except Exception as e:   # a damaged file can fail in any layer: zip, array header, dtype, text
        raise UserError(f"{path} is no whole scene, or too large: delete it, it is remade") from e
    return scene


# ---- the toy: z up, front towards -y, in its own units; world = TOY_SCALE * x + TOY_ORIGIN -------
TOY_SCALE, TOY_ORIGIN, INF = 3.7, np.array([12.0, -7.0, 5.0]), np.inf
SUN = np.array([-.50, -.62, .60]) / np.linalg.norm([-.50, -.62, .60])   # left, behind the tourists
STONE, PALE, SAND, BRICK, ROOF, SLATE, COPPER, GOLD, HOUSE, LEAF, PAVING, MEADOW = range(12)
LOOKS = np.array([   # percent: colour, width and height of a cell, contrast of cells, has windows
    (50, 46, 40, 29, 13, 20, 0), (80, 74, 60, 29, 13, 8, 0), (78, 56, 30, 30, 30, 15, 100),
    (52, 19, 11, 30, 30, 15, 100), (60, 22, 12, 16, 8, 30, 0), (12, 19, 31, 20, 10, 25, 0),
    (16, 46, 36, 50, 50, 40, 0), (90, 58, 8, 50, 50, 0, 0), (60, 46, 34, 62, 62, 15, 100),
    (10, 22, 5, 20, 20, 45, 0), (48, 42, 34, 42, 42, 20, 0), (17, 22, 8, 60, 60, 10, 0)]) / 100
# Part: |z| <= half around its centre, and its first `round` coordinates lie in a ball whose radius
# runs from bottom to top: 1 a box or roof (its |y| <= depth), 2 a column or cone; 3 is a ball.
LANDMARK = np.array([   # round; centre x y z, half, bottom, top, depth in thousandths; look
    (1, -10, -30, 50, 50, 960, 960, 530, STONE), (1, -50, 0, 150, 50, 850, 850, 470, STONE),
    *[(2, 0, -340, 470, 270, 62, 50, INF, PALE)] * 6, (1, 30, 200, 530, 330, 590, 590, 260, SAND),
    (1, 30, 30, 800, 60, 670, 670, 460, PALE), (1, 30, 30, 980, 120, 710, 0, 480, ROOF),
    (2, -50, 220, 1070, 170, 330, 310, INF, SAND), (3, -50, 220, 1240, 300, 300, 300, INF, COPPER),
    (2, -50, 220, 1570, 70, 75, 65, INF, PALE), (2, -50, 220, 1700, 60, 100, 20, INF, COPPER),
    (3, -50, 220, 1780, 45, 45, 45, INF, GOLD), (1, 870, 180, 530, 530, 170, 170, 170, BRICK),
    (1, 870, 180, 1100, 40, 200, 200, 200, PALE), (2, 870, 180, 1320, 180, 200, 0, INF, SLATE),
    (1, -760, 240, 380, 180, 190, 190, 250, BRICK), (1, -760, 240, 650, 90, 230, 0, 280, SLATE),
    (1, -800, -350, 280, 80, 90, 90, 90, PALE), (2, -800, -350, 480, 120, 70, 40, INF, COPPER),
    (3, -800, -350, 640, 55, 55, 55, INF, COPPER)]) / (1, *[1000] * 7, 1)
LANDMARK[2:8, 1] = np.linspace(-.54, .60, 6)   # plinth, columns, hall; dome; tower; annex; statue
TOWN = np.array([row for x, y, w, h in [   # houses, and a tree before each
    (-7.5, 2.0, .6, 1.5), (-6.2, 4.4, .5, 1.1), (-4.0, 6.4, .8, 1.8), (-1.2, 7.6, .5, 2.3),
    (2.0, 6.8, .7, 1.4), (4.6, 5.6, .5, 1.9), (6.8, 3.0, .6, 1.3), (7.4, 0.0, .5, 1.7)] for row in [
        (1, x, y, h / 2, h / 2, w, w, w, HOUSE), (1, x, y, h + .25, .25, w, 0, w, SLATE),
        (3, .8 * x + 1, .7 * y, .2 + .8 * w, .8 * w, .8 * w, .8 * w, INF, LEAF)]])


def toy_parts(landmark, background):
    """(P,9): LANDMARK, for other numbers than 0 another building of such parts; then maybe TOWN."""
    parts, rng = LANDMARK.copy(), np.random.default_rng([landmark, 1])
    if landmark:   # stretch and move what is on the plinth; of it the dome; tower; annex; statue
        for first, last in (2, 16), (11, 16), (16, 19), (19, 21), (21, 24):
            group, size = parts[first:last], rng.uniform(.7, 1.2, 3)
            foot = *group[:, 1:3].mean(0), group[0, 3] - group[0, 4]
            group[:, 1:4] = foot + (group[:, 1:4] - foot) * size + (*rng.uniform(-.06, .06, 2), 0)
            group[:, 4:8] *= np.where(group[:, :1] == 1, size[[2, 0, 0, 1]], size[2])
        parts[:, 1] *= rng.choice((-1, 1))
        looks = *rng.permutation(2), *rng.permutation(2) + SAND, *rng.permutation(3) + ROOF, GOLD
        parts[:, 8] = np.take(looks, parts[:, 8].astype(int))
    return np.concatenate([parts, TOWN]) if background else parts


def part_sdf(part, x):
    """Distance to one part (9,), or to one part for each point (P,9). x (P,3) -> (P,)"""
    p, (n, half, bottom, top, depth) = x - part[..., 1:4], part.T[[0, 4, 5, 6, 7]]
    u, z = np.where(n == 1, np.abs(p[:, 0]), np.hypot(p[:, 0], p[:, 1])), p[:, 2]
    grow, tall = top - bottom, 2 * half   # the slanted side, from bottom to top
    k = np.clip(((u - bottom) * grow + (z + half) * tall) / (grow ** 2 + tall ** 2), 0, 1)
    side = np.hypot(u - bottom - k * grow, z + half - k * tall)
    cap = np.hypot(np.maximum(u - np.where(z < 0, bottom, top), 0), np.abs(z) - half)
    inside = (np.abs(z) < half) & (u < bottom + grow * (z + half) / tall)
    d, e = np.where(inside, -1, 1) * np.minimum(side, cap), np.abs(p[:, 1]) - depth   # e: or -inf
    d = np.hypot(np.maximum(d, 0), np.maximum(e, 0)) + np.minimum(np.maximum(d, e), 0)
    return np.where(n == 3, np.hypot(u, z) - bottom, d)


def toy_sdf(x_world, background=True, landmark=0):
    """Signed distance of the toy, + and exact outside, SfM units. (P,3) -> (P,) float64"""
    x = (np.asarray(x_world, np.float64) - TOY_ORIGIN) / TOY_SCALE
    parts = [part_sdf(part, x) for part in toy_parts(landmark, background)]
    return np.min([*parts, x[:, 2]] if background else parts, axis=0) * TOY_SCALE


@np.errstate(divide="ignore", invalid="ignore")
def trace(o, d, parts, ground):
    """First hits of rays, closed form: distance (R,), inf is sky, and part (R,), -1 is the ground.
    A part is where a quadric and up to two slabs overlap; its hit is where the last one begins."""
    t = np.where(ground & (d[:, 2] < -1e-3), -o[:, 2] / d[:, 2], INF)   # (R,)
    which, centre = np.full(len(d), -1), parts[:, 1:4]
    along = centre @ d.T - (o * d).sum(1)   # (P,R), bounding spheres first
    aside = (centre ** 2).sum(1)[:, None] - 2 * centre @ o.T + (o * o).sum(1) - along ** 2
    for i, (n, *_, half, bottom, top, depth, _) in enumerate(parts):
        n, grow = int(n), (top - bottom) / half / 2
        radius = np.linalg.norm((max(bottom, top), half * (n < 3), depth if n == 1 else 0))
        rows = np.flatnonzero((aside[i] < radius ** 2) & (np.abs(along[i]) < radius + t))
        p, v = o[rows] - centre[i], d[rows]
        w, rise = (bottom + top) / 2 + grow * p[:, 2], grow * v[:, 2]
        a, b = (v[:, :n] ** 2).sum(1) - rise ** 2, (v[:, :n] * p[:, :n]).sum(1) - rise * w
        root = np.sqrt(b * b - a * ((p[:, :n] ** 2).sum(1) - w * w))   # nan for a miss
        enter = np.where((a < 0) & (rise < 0), -INF, (-b - root) / a)   # a < 0: a cone, open at
        leave = np.where((a < 0) & (rise > 0), INF, (-b + root) / a)   # one end
        for axis in range(n, 3):
            reach = np.abs((depth, half)[axis - 1] / v[:, axis])
            enter = np.maximum(enter, -p[:, axis] / v[:, axis] - reach)
            leave = np.minimum(leave, -p[:, axis] / v[:, axis] + reach)
        hit = (enter < leave) & (enter > 0) & (enter < t[rows])
        t[rows[hit]], which[rows[hit]] = enter[hit], i
    return t, which


def shade(o, d, parts, background):
    """Radiance along rays: sun, shadow, sky light and haze. o, d (R,3) -> (R,3) linear"""
    up, azimuth = d[:, 2:], np.arctan2(d[:, :1], d[:, 1:2])
    colour = (.58, .68, .78) + np.clip(up * 1.5, 0, 1) * (-.52, -.46, -.26)
    for base, size, waves, hill in (.11, .045, 5, (.25, .33, .45)), (.06, .03, 9, (.11, .18, .16)):
        ridge = np.sin(waves * azimuth + base * 40) + 0.6 * np.sin(2.3 * waves * azimuth)
        colour = np.where(up < base + size * ridge, hill, colour)
    colour *= background
    t, which = trace(o, d, parts, background)
    hit = np.flatnonzero(t < INF)
    x, floor, part = o[hit] + t[hit, None] * d[hit], which[hit] < 0, parts[which[hit]]   # (R,9)
    normal = np.stack([part_sdf(part, x + e) - part_sdf(part, x - e) for e in 1e-5 * np.eye(3)], 1)
    normal = np.where(floor[:, None], (0, 0, 1), normal / 2e-5)
    turn = np.arctan2(x[:, 1] - part[:, 2], x[:, 0] - part[:, 1])
    across = np.where(floor, x[:, 0], np.where(part[:, 0] == 1, x[:, 0] + x[:, 1], turn))
    square = np.where(np.hypot(x[:, 0], x[:, 1]) < 2.6, PAVING, MEADOW)
    look = LOOKS[np.where(floor, square, part[:, 8]).astype(int)]
    row = np.where(floor, x[:, 1], x[:, 2]) / look[:, 4]   # solid texture of cells; without
    column = across / look[:, 3] + (np.floor(row) % 2 / 2) * (1 - look[:, 6])   # windows, a bond
    chance = np.abs(np.sin(12.9898 * np.floor(column) + 78.233 * np.floor(row))) * 437.585 % 1
    dark = look[:, 6] * (np.abs(column % 1 - .5) < .2) * (np.abs(row % 1 - .45) < .28)
    paint = look[:, :3] * ((1 + look[:, 5] * (2 * chance - 1)) * (1 - .8 * dark))[:, None]
    shadow = trace(x + 1e-4 * normal, np.broadcast_to(SUN, x.shape), parts, background)[0] < INF
    light = (np.clip(normal @ SUN, 0, None) * ~shadow)[:, None] * (1.15, 1.05, .88)
    light += (0.20 + 0.10 * normal[:, 2:]) * (.8, .92, 1.15)
    haze = np.exp(-np.maximum(t[hit, None] - 5, 0) / 20)
    colour[hit] = haze * paint * light + (1 - haze) * (.42, .50, .58)
    return colour


def rays(K, c2w, w, h, dx=0.5, dy=0.5):
    """Unit directions of a photo's pixels in world axes, row by row. -> (h*w,3)"""
    v, u = np.mgrid[:h, :w].reshape(2, -1)
    d = np.stack([(u + dx - K[2]) / K[0], (v + dy - K[3]) / K[1], np.ones(w * h)], 1)
    return (d / np.linalg.norm(d, axis=1, keepdims=True)) @ c2w[:, :3].T


def project(K, c2w, x):
    """Pixels (P,2), -1e9 behind the camera, and distances (P,) of points x (P,3)."""
    p = (x - c2w[:, 3]) @ c2w[:, :3]
    z = np.where(p[:, 2:] > 1 / FAR, p[:, 2:], np.nan)
    return np.nan_to_num(p[:, :2] / z * K[:2] + K[2:], nan=-1e9), np.linalg.norm(p, axis=1)


def toy_camera(rng, azimuth, size):
    """A tourist at `azimuth` [rad] from the front. -> K (4,), c2w (3,4) in the toy's units, w, h"""
    aspect = rng.choice([4 / 3, 3 / 2, 1.1, 3 / 4, 2 / 3])
    w, h = np.round(size * np.minimum((aspect, 1), (1, 1 / aspect))).astype(int)
    f = size / 2 / np.tan(np.radians(rng.uniform(40, 65)) / 2)
    target = (0, .05, .80) + rng.uniform(-.12, .12, 3)
    away = np.array([np.sin(azimuth), -np.cos(azimuth), rng.uniform(-.15, .45)])
    eye = target + away * f / min(w, h) * rng.uniform(2.0, 2.6) * rng.choice((0.8, 1), p=(.1, .9))
    eye[2] = max(eye[2], 0.2)
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, (*rng.normal(0, .03, 2), 1))   # hardly anyone holds it level
    x /= np.linalg.norm(x)
    return np.array([f, f, w / 2, h / 2]), np.stack([x, np.cross(z, x), z, eye], 1), w, h


def draw_people(rng, w, h, share):
    """Passers-by on about `share` of the photo. -> (h*w,4): colour times opacity, opacity"""
    canvas = np.zeros((4 * h, 4 * w, 4), np.float32)   # drawn large, then averaged
    while (left := share - canvas[..., 3].mean()) > max(0.1 * share, 0.002):
        tall = 4 * np.clip(np.sqrt(left * w * h / .25) * rng.uniform(.5, 1), .12 * h, .95 * h)
        feet = rng.uniform((0, 3.2 * h), (4 * w, 4 * h + .2 * tall))
        coat, legs, thing, skin = .02 + .83 * rng.beta(.4, .4, (4, 3))   # vivid, black or white
        stripe, belts = thing if rng.random() < .4 else coat, np.arange(.5, .75, .06)
        spot = rng.uniform((-.25, .5), (.25, 1.15))   # of a bag, balloon or hat
        for colour, *ends, wide in [
                (legs, -.06, .03, -.06, .45, .1), (legs, .06, .03, .06, .45, .1),
                *[((coat, stripe)[i % 2], -.05, y, .05, y, .16) for i, y in enumerate(belts)],
                ((.3 + skin[0]) * np.array([.8, .6, .45]), 0, .92, 0, .92, .15),
                (thing, *spot, *(spot + rng.uniform(-.15, .15, 2)), rng.uniform(.08, .25))]:
            ends = (feet + np.reshape(ends, (2, 2)) * (tall, -tall)).astype(int).tolist()
            cv2.line(canvas, *ends, (*colour.tolist(), 1), int(wide * tall) + 1)
    return cv2.resize(canvas, (w, h), interpolation=cv2.INTER_AREA).reshape(-1, 4).astype(float)


def toy_points(rng, views, depths, people, count=3000):
    """As by SfM: noisy, 1.5 % wrong. -> points (K,5) as in finish, and those (M,) of each photo"""
    x, tracks, views = [], [], [*zip(views, depths, people)]
    for (K, c2w, w, h), depth, hidden in views:
        surface = c2w[:, 3] + rays(K, c2w, w, h) * depth[:, None]
        ok = (depth < 30) & ~hidden
        on = ok & (surface[:, 2] > .02) & (np.abs(surface[:, :2]) < 1.3).all(1)
        for some, n in (on, count // len(views)), (ok & ~on, count // 5 // len(views)):
            x.append(surface[rng.choice(np.flatnonzero(some), n * some.any())])
    x = np.concatenate(x)
    for (K, c2w, w, h), depth, hidden in views:
        uv, distance = project(K, c2w, x)
        at = np.clip(uv, 0, (w - 1, h - 1)).astype(int) @ (1, w)
        ok = ((uv >= 0) & (uv < (w, h))).all(1) & (np.abs(depth[at] / distance - 1) < .02)
        tracks.append(np.flatnonzero(ok & ~hidden[at] & (rng.random(len(x)) < .6)))
    x += (rng.random((len(x), 1)) < .015) * rng.uniform(-1, 1, x.shape)
    x = (x + rng.normal(0, .005, x.shape)) * TOY_SCALE + TOY_ORIGIN
    views = np.bincount(np.concatenate(tracks), minlength=len(x))
    return np.column_stack([x, 0 * views, views]), tracks


def make_toy(seed=0, size=96, photos=48, test=8, occluders=0.05, exposure=1.0, pose_noise=0.0,
             background=True, landmark=0):
    """Scene of a procedural landmark, the same for every seed, another for every number. size: long
    side [px]. occluders: mean share of a training photo that people cover, 0..0.6. exposure: spread
    of brightness, white balance and contrast, 0 none, 1 tourists, 2 extreme. pose_noise: of the
    training photos [px rms at the landmark]. background=False: nothing else, before black."""
    info = dict(scene="toy", kind="toy", downscale=1, folder=None, split=None) | locals()
    need(0 <= occluders <= 0.6 and 0 <= exposure <= 2 and min(size / 16, photos / 4) >= 1
         and min(test, seed, landmark) >= 0 and 0 <= pose_noise < INF, "the toy needs occluders in "
         "0..0.6, exposure in 0..2, size >= 16, photos >= 4, and no other number below 0")
    camera, taste, people, sfm, shake = (np.random.default_rng([seed, k]) for k in range(5))
    count = photos + test   # a stream each: no knob moves another
    angles = 200 * (np.arange(count) + camera.uniform(.1, .9, count)) / count - 100
    views = [toy_camera(camera, angle, size) for angle in np.radians(angles)]
    is_test = np.isin(np.arange(count), (np.arange(test) + 0.5) * count // max(test, 1))
    share = people.gamma(0.8 + 6 * occluders, size=count) * ~is_test   # some photos stay free
    share = np.minimum(share / share.sum() * photos * occluders, 0.85)
    parts, images, depth, occluder = toy_parts(landmark, background), [], [], []
    for (K, c2w, w, h), cover in zip(tell(views, "drawing photos"), share):
        o, tint = np.broadcast_to(c2w[:, 3], (w * h, 3)), exposure * taste.uniform(-1, 1, 4)
        linear = sum(np.clip(shade(o, rays(K, c2w, w, h, dx, dy), parts, background), 0, 1)
                     for dx in (.25, .75) for dy in (.25, .75)) / 4
        cover = draw_people(people, w, h, cover)
        linear = linear * (1 - cover[:, 3:]) + cover[:, :3]   # (h*w,3)
        gain = 2 ** (tint[0] / 2) * (1 + .1 * tint[1:3] @ [[1, 0, 0], [0, 0, 1]])
        srgb = np.clip(linear * gain, 0, 1) ** (1.2 ** tint[3] / 2.2)
        images.append((srgb * 255 + 0.5).astype(np.uint8).reshape(h, w, 3))
        depth.append(trace(o, rays(K, c2w, w, h), parts, background)[0])
        occluder.append(cover[:, 3] > 0)
    points, tracks = toy_points(sfm, views, depth, occluder)
    for (K, c2w, *_), test in zip(views, is_test):   # half by turning, half by moving [rad]
        *turn, dx, dy = shake.normal(0, pose_noise / 2, 4) / K[0] * ~test
        c2w[:, 3] += c2w[:, :2] @ (dx, dy) * np.linalg.norm(c2w[:, 3])
        c2w[:, :3] = c2w[:, :3] @ cv2.Rodrigues(np.array([*turn, 0]))[0]
        c2w[:, 3] = c2w[:, 3] * TOY_SCALE + TOY_ORIGIN
    parts = parts[:len(LANDMARK)]   # all of it belongs in the unit sphere
    extent = np.where(parts[:, [5, 7, 4]] < INF, parts[:, [5, 7, 4]], parts[:, [5]])
    corners = [parts[:, 1:4] + extent * c for c in itertools.product((-1, 1), repeat=3)]
    contain = np.concatenate(corners) * TOY_SCALE + TOY_ORIGIN
    (K, c2w, *_), name = zip(*views), [f"toy_{i:03d}.png" for i in range(count)]
    scene = finish(images, K, c2w, is_test, name, points, tracks, info, contain)
    depth = np.concatenate(depth) * TOY_SCALE / scene["scale"]
    return scene | dict(depth=depth.astype(np.float16), occluder=np.concatenate(occluder))


def finish(images, K, c2w, is_test, name, points, tracks, info, contain=()):
    """The scene of images (h,w,3), each of which observes the points tracks (M,). SfM units: c2w;
    points (K,5): x y z, error [px], views; contain (P,3). Unit sphere: geometric median of points
    by views, 1.1 x the distance of 95 %; contain; 30 % of 9 in 10 training photos' own. [D10]"""
    error, views, rng = points[:, 3], points[:, 4], np.random.default_rng(0)
    usable = views >= (3 if (views >= 3).sum() >= 500 else 2)
    need(usable.sum() >= 20, f"{usable.sum()} usable 3D points: SfM needs more overlapping photos")
    usable &= error <= np.quantile(error[usable], 0.95)
    share, new = 2e6 / (1 + sum(map(len, tracks))), np.cumsum(usable) - 1   # 2 million are plenty
    tracks = [new[own[usable[own] & (rng.random(len(own)) < share)]] for own in tracks]
    x, weight = points[usable, :3], np.minimum(views[usable], 20).astype(int)
    centre = np.median(x, axis=0)
    for _ in range(20):   # Weiszfeld
        w = weight / np.maximum(np.linalg.norm(x - centre, axis=1), 1e-9)
        centre = w @ x / w.sum()
    distance = np.linalg.norm(x - centre, axis=1)   # (K,)
    radius = 1.1 * np.quantile(np.repeat(distance, weight), 0.95, method="inverted_cdf")
    training = [own for own, test in zip(tracks, is_test) if len(own) and not test]
    need(training, "no training photo observes a usable 3D point: they do not belong together")
    reach = np.quantile([np.quantile(distance[own], 0.3) for own in training], 0.9)
    corners = np.linalg.norm(np.reshape(contain, (-1, 3)) - centre, axis=1)
    radius = max(radius, reach, *1.02 * corners)
    need(radius > 1 / FAR, "all 3D points coincide: run SfM again")
    c2w = np.array(c2w)
    c2w[:, :, 3] = (c2w[:, :, 3] - centre) / radius
    arrays = dict(
        rgb=np.concatenate([image.reshape(-1, 3) for image in images]), K=K, c2w=c2w, name=name,
        wh=[image.shape[1::-1] for image in images], is_test=is_test, center=centre, scale=radius,
        start=np.cumsum([0, *(image.size // 3 for image in images)]), info=json.dumps(info),
        track_photo=np.repeat(np.arange(len(c2w)), [len(own) for own in tracks]),
        track_point=np.concatenate(tracks), points=(x - centre) / radius)
    return statistics({k: np.asarray(v, FORMAT[k].split()[0]) for k, v in arrays.items()})


def statistics(scene):
    """Adds what geonvs.py decides by. track_photo (sorted) sees track_point at track_uv (T,2), over
    wh, if in 0..1. near (I,): 0.8 x the 2 % quantile of their distances, >= 0.02. Of the training
    photos: footprint, lower quartile of a pixel's size at points in the sphere; exposure_spread,
    deviation of brightness (0..1) at equal points; bg_color (3,), beyond; NaN unless 60 % agree."""
    K, c2w, wh, start, rgb, points = (scene[k] for k in "K c2w wh start rgb points".split())
    ends = np.searchsorted(scene["track_photo"], np.arange(1, len(wh)))
    step, near, places, rows = max(1, len(rgb) // 500_000), [], [], []
    for i, own in enumerate(np.split(scene["track_point"], ends)):
        uv, distance = project(K[i], c2w[i], points[own].astype(float))
        places.append(np.clip(uv / wh[i], -1, 2))
        near.append(max(0.8 * np.quantile(distance, 0.02), 0.02) if len(own) else 0.05)
        if not scene["is_test"][i]:
            photo, (u, v) = rgb[start[i]:start[i + 1]], np.clip(uv, 0, wh[i] - 1).astype(int).T
            o, d = c2w[i, :, 3], rays(K[i], c2w[i], *wh[i])
            closest = o - np.minimum(d @ o, 0)[:, None] * d   # to the centre, along each ray
            rows.append((own, distance / K[i, 0], photo[v * wh[i, 0] + u].mean(1) / 255,
                         photo[np.linalg.norm(closest, axis=1) > 1][::step]))
    seen, size, bright, beyond = zip(*rows)
    every, size, beyond = map(np.concatenate, (seen, size, beyond))
    mean = np.bincount(every, np.concatenate(bright)) / np.maximum(np.bincount(every), 1)   # (K,)
    spread = np.std([np.median(b - mean[own]) for b, own in zip(bright, seen) if len(own)])
    color = np.median(beyond, 0) if len(beyond) > 100 else np.full(3, np.nan)   # people may hide it
    is_flat = (np.abs(beyond - color) < 5.1).all(1).sum() > 0.6 * len(beyond)
    inside = np.linalg.norm(points[every], axis=1) < 1
    size = size[inside] if inside.any() else np.linalg.norm(c2w[:, :, 3], axis=1) / K[:, 0]
    return scene | dict(near=np.float32(near), track_uv=np.concatenate(places, dtype=np.float32),
                        exposure_spread=spread, bg_color=color / (255 if is_flat else np.nan),
                        footprint=np.quantile(size, 0.25))


def open_binary(path):
    """Bounded reader of a little-endian file: take(format) -> values, take(number) -> bytes."""
    need(path.is_file(), f"{path} is missing: copy the whole COLMAP model, in its binary form")
    file = io.BytesIO(path.read_bytes())

    def take(what):
        size = what if isinstance(what, int) else struct.calcsize("<" + what)
        data = file.read(min(size, sys.maxsize))
        need(len(data) == size, f"{path} ends too early: copy or export it again")
        return data if size == what else struct.unpack("<" + what, data)
    return take


MODELS = {0: "f", 1: "ff", 2: "fk", 3: "fkk", 4: "ffkkpp"}   # f, then cx cy, then distortion


def read_colmap(sparse):
    """A COLMAP model, SfM units. -> points (K,5) as in finish, photos {name: ((w, h, K (4,), k1
    k2 p1 p2 (4,)), c2w (3,4), points (M,) that it observes)}"""
    take, cameras, photos, index, points = open_binary(sparse / "points3D.bin"), {}, {}, {}, []
    for _ in range(*take("Q")):
        key, x, y, z, *_, error, views = take("Q3d3BdQ")
        take(8 * views)
        if all(abs(value) < FAR for value in (x, y, z, error)):   # false for nan
            index[key] = len(points)
            points.append((x, y, z, error, views))
    take = open_binary(sparse / "cameras.bin")
    for _ in range(*take("Q")):
        key, model, w, h = take("IiQQ")
        need(model in MODELS, f"{sparse} has camera model {model}: run colmap image_undistorter")
        n, p = MODELS[model].count("f"), np.array(take(f"{len(MODELS[model]) + 2}d"))
        need(0 < w < 32767 and 0 < h < 32767 and (np.abs(p) < FAR).all() and min(p[:n]) > 1 / FAR,
             f"{sparse}: camera {key} is {w} x {h} with {p.tolist()}, which cannot be: export it")
        cameras[key] = w, h, p[[0, n - 1, n, n + 1]], np.append(p[n + 2:], np.zeros(4))[:4]
    take = open_binary(sparse / "images.bin")
    for _ in range(*take("Q")):
        _, *pose, camera = take("I7dI")
        name = b"".join(iter(lambda: take("c")[0], b"\0")).decode(errors="replace")
        seen = np.frombuffer(take(24 * take("Q")[0]), "<u8")[2::3].tolist()   # of u, v, point
        need(name and name[0] != "/" and "\\" not in name and ".." not in name.split("/"),
             f"{sparse}: photo {name!r} is outside the image folder; rename it")
        is_sound = all(abs(value) < FAR for value in pose) and any(pose[:4])
        need(is_sound and camera in cameras and name not in photos,
             f"{sparse}: photo {name!r} has no sound pose, no camera, or occurs twice")
        w, *v = np.array(pose[:4]) / math.hypot(*pose[:4])   # old files are not normalised
        cross = np.cross(v, np.eye(3))   # c2w = 1 - 2 w [v] + 2 [v] [v]
        R = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        own = np.array([index[key] for key in seen if key in index], int)
        photos[name] = cameras[camera], np.column_stack([R, -R @ pose[4:]]), own
    return np.array(points, float).reshape(-1, 5), photos


def read_split(path):
    """NeRF-W table, by column name: {photo: "train" or "test"}; rows with empty id are dropped."""
    need(path.is_file(), f"the split file {path} is not there")
    lines, split = path.read_bytes().decode("utf-8-sig", "replace").splitlines(), {}
    head, *rows = [line.split("\t") for line in lines if line] or [[]]
    need({"filename", "split"} <= set(head), f"{path} needs a header with filename, tab, and split")
    for row in (dict(zip(head, row)) for row in rows):
        name, part = row.get("filename"), row.get("split")
        is_sound = name and part in ("train", "test")
        need(row.get("id") == "" or is_sound and split.setdefault(name, part) == part,
             f"{path}: {name!r} is {part!r}; each photo is train or test, and not both")
    return split


def read_photo(path, camera, downscale):
    """Undistorted, then reduced. -> rgb uint8 (h,w,3), K (4,)"""
    image, (w, h, K, bend) = None, camera
    need(1 <= downscale <= min(w, h) / 2, f"--downscale {downscale} leaves nothing of {path}")
    with contextlib.suppress(Exception):   # cut off, no photo, more than a gigapixel
        skimage.io.imread(path)   # as OpenCV says nothing where a JPEG is cut off
        image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)   # COLMAP's
    need(np.shape(image)[:2] == (h, w), f"{path} is no photo of {w} x {h}: replace or delete it")
    if bend.any():   # OpenCV's first pixel is at 0
        M = np.array([[K[0], 0, K[2] - 0.5], [0, K[1], K[3] - 0.5], [0, 0, 1]])
        P = cv2.getOptimalNewCameraMatrix(M, bend, (w, h), 0)[0]   # shows nothing but photo
        P = P if P[0, 0] > M[0, 0] or P[1, 1] > M[1, 1] else M
        image = cv2.undistort(image, M, bend, None, P)
        K = P[[0, 1, 0, 1], [0, 1, 2, 2]] + (0, 0, 0.5, 0.5)
    small = w // downscale, h // downscale
    image = cv2.cvtColor(cv2.resize(image, small, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGB)
    return image, K * np.tile(np.array(small) / (w, h), 2)


def prepare(name, downscale=2, split=None):
    """Scene of one of SCENES, or of a folder with [dense/[0/]]{images,sparse[/0]}; see FORMAT."""
    names = (f"data/{name}", f"data/{SCENES[name][0]}") if name in SCENES else [name]
    places = [(Path(n), Path(n, dense, "images"), Path(n, dense, "sparse", number)) for n in names
              for dense in ("dense", "dense/0", "") for number in ("0", "")]
    found = [place for place in places if place[1].is_dir() and place[2].is_dir()]
    need(found, f"{names[0]} has no folders images and sparse; run: python data_prep.py {name} "
         f"--{'download' if name in SCENES else 'sfm'}")
    folder, images, sparse = found[0]
    tables = [Path(split)] if split else sorted(folder.glob("[!.]*.tsv"))
    need(len(tables) < 2, f"{folder} has {len(tables)} split files: name one, data_prep.py --split")
    points, photos = read_colmap(sparse)
    here = sorted(n for n in photos if (images / n).is_file())
    parts = read_split(tables[0]) if tables else {
        n: "test" if i % 8 == 7 else "train" for i, n in enumerate(here)}
    odd = {n for n in here for w, h, K, _ in [photos[n][0]] if parts.get(n) == "train"
           and not 10 <= 2 * np.degrees(np.arctan(max(w / K[0], h / K[1]) / 2)) <= 120}
    for out, why in ((photos.keys() - here, "of the model are not on disk"),
                     (parts.keys() - here, "of the split file have no pose or no file"),
                     (here - parts.keys(), "are not in the split file"),
                     (odd, "are narrower than 10 or wider than 120 degrees")):
        if out:
            print(f"{len(out)} photos {why}: {', '.join(sorted(out)[:3])} ...", file=sys.stderr)
    names = [n for n in here if n in parts and n not in odd]
    is_test = np.array([parts[n] == "test" for n in names], bool)
    need((~is_test).sum() >= 2, f"{folder} has not 2 usable training photos: check its split file")
    rgb, K = zip(*[read_photo(images / n, photos[n][0], downscale)
                   for n in tell(names, "preparing photos")])
    _, c2w, tracks = zip(*[photos[n] for n in names])
    info = dict(scene=folder.resolve().name, kind="colmap", downscale=downscale,
                folder=str(folder), split=split and str(Path(split).resolve()))
    return finish(rgb, K, c2w, is_test, names, points, tracks, info)


def scene_path(name_or_folder):
    """data/<scene>.npz; of two folders with one name each has its own."""
    folder = Path(name_or_folder).resolve()
    mark = f"-{zlib.crc32(os.fsencode(folder)):08x}"
    return Path("data", folder.name + ("" if name_or_folder in ("toy", *SCENES) else mark) + ".npz")


def open_scene(name_or_folder, downscale=2):
    """Scene from its file: made on first use, and anew if photos, poses or split are newer."""
    path, is_toy, split = scene_path(name_or_folder), name_or_folder == "toy", None
    if path.exists():
        scene, made = read_scene(path), path.stat().st_mtime
        info = json.loads(str(scene["info"]))
        split, folder = info["split"], Path(info["folder"] or "")   # split: named once, by --split
        inside = map(folder.glob, ("[!.]*.tsv", "**/images*", "**/images/**/*"))
        files = itertools.chain([Path(split or folder)], *inside)
        newer = (p for p in files if p.exists() and p.stat().st_mtime > made)
        if is_toy or info["downscale"] == downscale and not any(newer):
            return scene
    print(f"making {path}")
    scene = make_toy() if is_toy else prepare(name_or_folder, downscale, split)
    write_scene(path, scene)
    return scene


def fetch(url, path):
    """Streams url into path; what came of a broken transfer waits in path.part to be continued."""
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(part, "ab") as file:   # the last byte again: so a whole part is no special case
            have = max(file.tell() - 1, 0)
            request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"})
            with urllib.request.urlopen(request, timeout=60) as answer:
                have *= answer.status == 206   # a server without ranges starts over
                total = have + int(answer.headers.get("Content-Length", -1))
                file.truncate(have)
                for _ in tell(range(have, total, 1 << 20), f"MiB of {path.name}"):
                    have += file.write(answer.read(1 << 20))
        need(have == total, f"the download of {url} broke off; the same command continues it")
        os.replace(part, path)
    except (OSError, http.client.HTTPException) as e:
        if getattr(e, "code", 0) == 416:   # longer than the file itself
            part.unlink()
        raise UserError(f"the download of {url} broke ({e}); the same command continues it") from e


def download(name, archive_url=ARCHIVE_URL, split_url=SPLIT_URL):
    """Photos and reconstruction of one of SCENES, with its split file -> data/<name>/"""
    need(name in SCENES, f"--download knows {', '.join(SCENES)}, not {name}")
    (scene, table), root = SCENES[name], Path("data")
    archive, home = root / f"{scene}.tar.gz", root / name
    need(not home.exists(), f"{home} is there already: move it, or leave --download out")
    for url, path in (split_url + table, root / table), (archive_url + archive.name, archive):
        if not path.exists():
            fetch(url, path)
    wanted = f"{scene}/dense/images/", f"{scene}/dense/sparse/"
    try:
        with tempfile.TemporaryDirectory(dir=root) as temporary, gzip.open(archive) as raw:
            with tarfile.open(fileobj=raw, mode="r|") as tar:
                for member in tar:   # files only: a link could lead outside
                    if member.isfile() and member.name.startswith(wanted):
                        tar.extract(member, temporary, filter="data")
            while raw.read(1 << 20):   # to the checksum at the very end
                pass
            shutil.copy(root / table, Path(temporary, scene, table))
            os.replace(Path(temporary, scene), home)
    except (tarfile.TarError, EOFError, zlib.error, OSError, TypeError) as e:
        raise UserError(f"cannot unpack {archive} ({e}): free space, or delete it and retry") from e


def run_sfm(folder):
    """Poses for the raw photos in `folder`, by pycolmap -> folder/dense/{images,sparse}"""
    import pycolmap   # an extra: main says when it is not there
    database, models, dense = (folder / name for name in ("database.db", "models", "dense"))
    need(folder.is_dir() and not dense.exists(), f"{folder} is missing, or has dense/: delete that")
    models.mkdir(exist_ok=True)
    pycolmap.extract_features(database, folder)
    pycolmap.match_exhaustive(database)
    found = pycolmap.incremental_mapping(database, folder, models)
    need(found, f"the photos in {folder} do not match each other; take more, with more overlap")
    best = max(found, key=lambda i: found[i].num_reg_images())
    pycolmap.undistort_images(dense, models / str(best), folder)


def main(argv=None):
    p = argparse.ArgumentParser(allow_abbrev=False, argument_default=argparse.SUPPRESS, description=
                                __doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scene", help=f"toy, {', '.join(SCENES)}, or a folder")
    p.add_argument("--download", action="store_true", help="fetch archive and split file first")
    p.add_argument("--sfm", action="store_true", help="the folder has raw photos: pose them first")
    p.add_argument("--downscale", type=int, help="photos get this many times smaller; default 2")
    p.add_argument("--split", help="table of training and test photos; default: <folder>/*.tsv")
    for key, value in zip(inspect.signature(make_toy).parameters, make_toy.__defaults__):
        how = {"action": argparse.BooleanOptionalAction} if value is True else {"type": type(value)}
        p.add_argument(f"--{key}", help=f"toy, default {value}", **how)
    given = vars(p.parse_args(argv))
    name, fetch_first, sfm_first = (given.pop(key, None) for key in ("scene", "download", "sfm"))
    make, path = make_toy if name == "toy" else prepare, scene_path(name)
    wrong = given.keys() - inspect.signature(make).parameters
    try:
        need(not wrong, f"--{' --'.join(wrong)}: not for {name}")
        fetch_first and download(name)
        sfm_first and run_sfm(Path(name))
        scene = make(**given) if name == "toy" else make(name, **given)
        write_scene(path, scene)
    except (UserError, OSError, MemoryError, ImportError, KeyboardInterrupt) as e:
        print(f"error: {e}" if str(e) else "error: stopped; start again", file=sys.stderr)
        sys.exit(2)
    print(f"{path}: {len(scene['wh'])} photos, {scene['is_test'].sum()} of them for testing")


if __name__ == "__main__":
    main()
