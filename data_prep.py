"""Scene files for geonvs.py: a synthetic landmark, or photos with a COLMAP reconstruction.

    python data_prep.py toy --occluders 0.4     -> data/toy.npz; every knob of make_toy is a flag
    python data_prep.py brandenburg --download  -> data/brandenburg.npz, from an archive of 5 GB
    python data_prep.py my_photos --sfm         raw photos, by pycolmap -> data/my_photos-*.npz
    python data_prep.py my_scene                photos and a COLMAP model in it -> the same

The landmark lies in the unit sphere. A ray is c2w[:, 3] + t * d with |d| = 1; a distance is this t,
never a z-depth. Functions raise UserError, one sentence that says what to do.
"""
import argparse
import gzip
import http.client
import inspect
import io
import itertools
import json
import math
import os
import shutil
import struct
import sys
import tarfile
import tempfile
import time
import urllib.request
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
from numpy import arange, array, bincount, clip, concatenate, cross, eye, flatnonzero, floor, hypot
from numpy import inf, maximum, median, minimum, quantile, radians, sin, stack, where
from numpy.linalg import norm

# name: (archive, split file)
SCENES = {
    "brandenburg": ("brandenburg_gate", "brandenburg.tsv"),
    "sacre": ("sacre_coeur", "sacre.tsv"),
    "trevi": ("trevi_fountain", "trevi.tsv"),
    "taj": ("taj_mahal", "taj_mahal.tsv"),
}
ARCHIVE_URL = "https://www.cs.ubc.ca/research/kmyi_data/imw2020/TrainingData/"
SPLIT_URL = "https://nerf-w.github.io/data/selected_images/"
# A scene is one .npz of these arrays: I photos, J = I + 1, N pixels, K points, T observations. A
# toy has more: depth float16 (N,), true distance, inf is sky; occluder bool (N,), by people; and
# what toy_walls returns.
FORMAT = dict(
    rgb="uint8 N3",
    start="int64 J",   # photo i is rgb[start[i]:start[i + 1]], row by row
    wh="int32 I2",   # width, height
    K="float64 I4",   # fx fy cx cy [px]; the first pixel's centre is at 0.5 0.5
    c2w="float64 I34",   # camera to world; OpenCV: x right, y down, z forward
    is_test="bool I",   # held out from training
    name="<U I",
    points="float32 K3",
    center="float64 3",   # SfM units: x * scale + center
    scale="float64",
    track_photo="int32 T",   # sorted; this photo sees
    track_point="int32 T",   # this point
    track_uv="float32 T2",   # there, over wh: in 0..1 if inside
    near="float32 I",
    footprint="float64",
    exposure_spread="float64",
    bg_color="float64 3",
    info="<U",   # JSON: scene, kind (toy or colmap), downscale, folder, split; of a toy its knobs
)
FAR = 1e9   # sound reconstructions have no larger number; float32 holds its square


class UserError(Exception):
    """Something that the person at the keyboard can mend: one sentence that says how."""


def check(ok, message):
    if not ok:
        raise UserError(message)


def warn(message):
    print(message, file=sys.stderr)


def progress(items, what):
    """Yields items; says how far it is once that took ten seconds, or a minute in a log file."""
    is_terminal = sys.stdout.isatty()
    due, wait = (10, 1) if is_terminal else (60, 60)   # seconds
    begin = time.monotonic()
    total = len(items)
    for done, item in enumerate(items, 1):
        yield item
        past = time.monotonic() - begin
        is_last = done == total
        if past > due or (is_last and past > 10):
            due = past + wait
            line = f"  {what}: {done} of {total}, {past / done * (total - done):.0f} s left "
            if is_terminal:
                print("\r" + line, end="\n" if is_last else "", flush=True)
            else:
                print(line, flush=True)


def atomic_write(path, write):
    """write(temporary path), then rename: `path` is the whole old file or the whole new one."""
    part = path.with_name(f".{path.stem}.{os.getpid()}.{time.time_ns()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        result = write(part)
        check(result is not False, f"cannot encode {path}")   # so cv2.imwrite says no
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
        inside = sum(member.file_size for member in file.infolist())
        if inside > os.path.getsize(path):
            raise zipfile.BadZipFile(f"{path} is larger inside than outside")


def check_scene(scene):
    """UserError unless the arrays fit FORMAT and each other."""
    start, wh = scene["start"], scene["wh"]
    tracks = array([scene["track_photo"], scene["track_point"]])
    counts = len(wh), len(scene["points"])
    sizes = dict(zip("IJKTN", (len(wh), len(wh) + 1, counts[1], len(tracks[0]), start[-1])))
    for key, text in FORMAT.items():
        value = scene[key]
        dtype, _, letters = text.partition(" ")
        shape = tuple(sizes.get(letter) or int(letter) for letter in letters)
        check(value.shape == shape and str(value.dtype).startswith(dtype), key)
        check(dtype[0] != "f" or key == "bg_color" or np.isfinite(value).all(), key)
    check(start[0] == 0 and (wh > 0).all() and (np.diff(start) == wh.prod(1)).all(), "start")
    check(tracks.min() >= 0 and (tracks.max(1) < counts).all(), "tracks")
    check(min(scene["footprint"], scene["scale"]) > 0 and not scene["is_test"].all(), "scale")
    info = json.loads(str(scene["info"]))
    check({"kind", "scene", "downscale", "folder", "split"} <= set(info), "info")


def read_scene(path):
    """The dictionary of a scene file; UserError unless it is whole, and fits FORMAT and itself."""
    try:
        refuse_bomb(path)
        with np.load(path, allow_pickle=False) as file:
            scene = {key: file[key] for key in file.files}
        check_scene(scene)
    except Exception as e:   # a damaged file can fail in any layer: zip, array header, dtype, text
        raise UserError(f"{path} is no whole scene, or too large: delete it, it is remade") from e
    return scene


# ---- the toy: z up, front towards -y, in its own units; world = TOY_SCALE * x + TOY_ORIGIN -------
TOY_SCALE = 3.7
TOY_ORIGIN = array([12.0, -7.0, 5.0])
SUN = array([-.50, -.62, .60]) / norm([-.50, -.62, .60])   # left, behind the tourists
STONE, PALE, SAND, BRICK, ROOF, SLATE, COPPER, GOLD, HOUSE, LEAF, PAVING, MEADOW = range(12)
# Percent: colour, width and height of a cell, contrast of cells, has windows; a row a surface.
LOOKS = array("""
    50 46 40  29 13  20   0
    80 74 60  29 13   8   0
    78 56 30  30 30  15 100
    52 19 11  30 30  15 100
    60 22 12  16  8  30   0
    12 19 31  20 10  25   0
    16 46 36  50 50  40   0
    90 58  8  50 50   0   0
    60 46 34  62 62  15 100
    10 22  5  20 20  45   0
    48 42 34  42 42  20   0
    17 22  8  60 60  10   0
""".split(), float).reshape(-1, 7) / 100
# Shape; centre x y z, half height, radius at the bottom and at the top, depth in thousandths; look.
# Shape 1 is a box or roof, |x| <= radius and |y| <= depth; 2 a column or cone; 3 a ball. Plinth,
# columns, hall; dome; tower; annex; statue.
LANDMARK = array("""
    1  -10  -30   50   50  960  960  530  0
    1  -50    0  150   50  850  850  470  0
    2    0 -340  470  270   62   50  inf  1
    2    0 -340  470  270   62   50  inf  1
    2    0 -340  470  270   62   50  inf  1
    2    0 -340  470  270   62   50  inf  1
    2    0 -340  470  270   62   50  inf  1
    2    0 -340  470  270   62   50  inf  1
    1   30  200  530  330  590  590  260  2
    1   30   30  800   60  670  670  460  1
    1   30   30  980  120  710    0  480  4
    2  -50  220 1070  170  330  310  inf  2
    3  -50  220 1240  300  300  300  inf  6
    2  -50  220 1570   70   75   65  inf  1
    2  -50  220 1700   60  100   20  inf  6
    3  -50  220 1780   45   45   45  inf  7
    1  870  180  530  530  170  170  170  3
    1  870  180 1100   40  200  200  200  1
    2  870  180 1320  180  200    0  inf  5
    1 -760  240  380  180  190  190  250  3
    1 -760  240  650   90  230    0  280  5
    1 -800 -350  280   80   90   90   90  1
    2 -800 -350  480  120   70   40  inf  6
    3 -800 -350  640   55   55   55  inf  6
""".split(), float).reshape(-1, 9) / (1, *[1000] * 7, 1)
LANDMARK[2:8, 1] = np.linspace(-.54, .60, 6)   # the columns stand in a row
GROUPS = (2, 16), (11, 16), (16, 19), (19, 21), (21, 24)   # on the plinth; of it the dome; ...
HOUSES = array("""
    -7.5 2.0 .6 1.5
    -6.2 4.4 .5 1.1
    -4.0 6.4 .8 1.8
    -1.2 7.6 .5 2.3
     2.0 6.8 .7 1.4
     4.6 5.6 .5 1.9
     6.8 3.0 .6 1.3
     7.4 0.0 .5 1.7
""".split(), float).reshape(-1, 4)   # x, y, half width, height


def town():
    """Parts of the background: houses with a roof, and a tree before each."""
    parts = []
    for x, y, w, h in HOUSES:
        tree = .8 * w
        parts.append((1, x, y, h / 2, h / 2, w, w, w, HOUSE))
        parts.append((1, x, y, h + .25, .25, w, 0, w, SLATE))
        parts.append((3, .8 * x + 1, .7 * y, .2 + tree, tree, tree, tree, inf, LEAF))
    return array(parts)


def toy_parts(landmark, background):
    """(P,9): LANDMARK, for other numbers than 0 another building of such parts; maybe a town."""
    parts = LANDMARK.copy()
    if landmark:
        rng = np.random.default_rng([landmark, 1])
        for first, last in GROUPS:   # stretch and move
            group = parts[first:last]
            place = group[:, 1:4]
            size = rng.uniform(.7, 1.2, 3)
            shift = np.append(rng.uniform(-.06, .06, 2), 0)
            foot = np.append(place[:, :2].mean(0), place[0, 2] - group[0, 4])
            place[:] = foot + (place - foot) * size + shift
            is_box = group[:, :1] == 1   # others stay round
            group[:, 4:8] *= where(is_box, size[[2, 0, 0, 1]], size[2])
        parts[:, 1] *= rng.choice((-1, 1))
        looks = [*rng.permutation(2), *SAND + rng.permutation(2), *ROOF + rng.permutation(3), GOLD]
        parts[:, 8] = np.take(looks, parts[:, 8].astype(int))
    if background:
        parts = concatenate([parts, town()])
    return parts


def part_sdf(part, x):
    """Distance to one part (9,), or to one part for each point (P,9). x (P,3) -> (P,)"""
    shape, _, _, _, half, bottom, top, depth, _ = part.T
    x, y, z = (x - part[..., 1:4]).T
    u = where(shape == 1, abs(x), hypot(x, y))
    # In the plane of u and z: the slanted side from bottom to top, and the caps.
    grow = top - bottom
    tall = 2 * half
    k = ((u - bottom) * grow + (z + half) * tall) / (grow ** 2 + tall ** 2)
    k = clip(k, 0, 1)
    side = hypot(u - bottom - k * grow, z + half - k * tall)
    cap = hypot(maximum(u - where(z < 0, bottom, top), 0), abs(z) - half)
    inside = (abs(z) < half) & (u < bottom + grow * (z + half) / tall)
    d = where(inside, -1, 1) * minimum(side, cap)
    e = abs(y) - depth   # -inf for a column
    d = hypot(maximum(d, 0), maximum(e, 0)) + minimum(maximum(d, e), 0)
    return where(shape == 3, hypot(u, z) - bottom, d)


def toy_sdf(x_world, background=True, landmark=0):
    """Signed distance of the toy, + and exact outside, SfM units. (P,3) -> (P,) float64"""
    x = (np.asarray(x_world, np.float64) - TOY_ORIGIN) / TOY_SCALE
    distances = [part_sdf(part, x) for part in toy_parts(landmark, background)]
    if background:
        distances.append(x[:, 2])   # the ground
    return np.min(distances, axis=0) * TOY_SCALE


def enter_part(part, o, d):
    """Where rays o, d (R,3), seen from the part's centre, enter it; inf for a miss. -> (R,)

    A part is where a quadric and up to two slabs overlap: a ray is inside between the last
    entrance and the first exit."""
    shape, *_, half, bottom, top, depth, _ = part
    n = int(shape)   # the quadric is round in the first n coordinates
    grow = (top - bottom) / half / 2
    rise = grow * d[:, 2]
    w = (bottom + top) / 2 + grow * o[:, 2]   # radius at the ray's start
    a = (d[:, :n] ** 2).sum(1) - rise ** 2
    b = (d[:, :n] * o[:, :n]).sum(1) - rise * w
    c = (o[:, :n] ** 2).sum(1) - w * w
    root = np.sqrt(b * b - a * c)   # nan for a miss
    is_cone = a < 0   # such a ray is inside on one end, for ever
    enter = where(is_cone & (rise < 0), -inf, (-b - root) / a)
    leave = where(is_cone & (rise > 0), inf, (-b + root) / a)
    for axis in range(n, 3):
        middle = -o[:, axis] / d[:, axis]
        reach = abs((depth, half)[axis - 1] / d[:, axis])
        enter = maximum(enter, middle - reach)
        leave = minimum(leave, middle + reach)
    return where((enter < leave) & (enter > 0), enter, inf)


@np.errstate(divide="ignore", invalid="ignore")
def trace(o, d, parts, ground):
    """First hits of rays: distance (R,), inf is sky, and part (R,), -1 is the ground."""
    t = where(ground & (d[:, 2] < -1e-3), -o[:, 2] / d[:, 2], inf)   # (R,)
    which = np.full(len(d), -1)
    centre = parts[:, 1:4]
    along = centre @ d.T - (o * d).sum(1)   # (P,R)
    aside = (centre ** 2).sum(1)[:, None] - 2 * centre @ o.T + (o * o).sum(1) - along ** 2
    for i, (shape, *_, half, bottom, top, depth, _) in enumerate(parts):
        extent = max(bottom, top), half * (shape < 3), depth if shape == 1 else 0
        radius = norm(extent)   # of the bounding sphere
        rows = flatnonzero((aside[i] < radius ** 2) & (abs(along[i]) < radius + t))
        enter = enter_part(parts[i], o[rows] - centre[i], d[rows])
        hit = enter < t[rows]
        t[rows[hit]] = enter[hit]
        which[rows[hit]] = i
    return t, which


# Two ranges of hills: base and size as slopes, waves around the horizon, colour.
HILLS = array("""
    .11 .045 5 .25 .33 .45
    .06 .03  9 .11 .18 .16
""".split(), float).reshape(-1, 6)


def sky(d):
    """Radiance of the sky and two ranges of hills. d (R,3) -> (R,3) linear"""
    up = d[:, 2:]
    azimuth = np.arctan2(d[:, :1], d[:, 1:2])
    colour = (.58, .68, .78) + clip(up * 1.5, 0, 1) * (-.52, -.46, -.26)
    for base, size, waves, *hill in HILLS:
        ridge = sin(waves * azimuth + base * 40) + 0.6 * sin(2.3 * waves * azimuth)
        colour = where(up < base + size * ridge, hill, colour)
    return colour


def paint(x, part, is_ground):
    """Solid texture of cells at points of the surface: x (H,3), part (H,9) -> (H,3)"""
    x, y, z = x.T
    shape, centre_x, centre_y = part.T[:3]
    square = where(hypot(x, y) < 2.6, PAVING, MEADOW)
    look = LOOKS[where(is_ground, square, part[:, 8]).astype(int)]
    width, height, contrast, windows = look.T[3:]
    turn = np.arctan2(y - centre_y, x - centre_x)
    across = where(is_ground, x, where(shape == 1, x + y, turn))
    row = where(is_ground, y, z) / height
    bond = (floor(row) % 2 / 2) * (1 - windows)   # every other row of stones is shifted
    column = across / width + bond
    chance = abs(sin(12.9898 * floor(column) + 78.233 * floor(row))) * 437.585 % 1
    is_window = (abs(column % 1 - .5) < .2) * (abs(row % 1 - .45) < .28)
    brightness = (1 + contrast * (2 * chance - 1)) * (1 - .8 * (windows * is_window))
    return look[:, :3] * brightness[:, None]


def shade(o, d, parts, background, sun):
    """Radiance along rays: sun, shadow, sky light and haze. o, d (R,3), sun (3,) -> (R,3) linear"""
    colour = sky(d) * background
    t, which = trace(o, d, parts, background)
    hit = flatnonzero(t < inf)
    x = o[hit] + t[hit, None] * d[hit]
    part = parts[which[hit]]   # (H,9)
    is_ground = which[hit] < 0
    steps = 1e-5 * eye(3)
    normal = stack([part_sdf(part, x + e) - part_sdf(part, x - e) for e in steps], 1) / 2e-5
    normal = where(is_ground[:, None], (0, 0, 1), normal)
    to_sun = np.broadcast_to(sun, x.shape)
    in_sun = trace(x + 1e-4 * normal, to_sun, parts, background)[0] == inf
    light = (clip(normal @ sun, 0, None) * in_sun)[:, None] * (1.15, 1.05, .88)
    light += (0.20 + 0.10 * normal[:, 2:]) * (.8, .92, 1.15)
    haze = np.exp(-maximum(t[hit, None] - 5, 0) / 20)
    colour[hit] = haze * paint(x, part, is_ground) * light + (1 - haze) * (.42, .50, .58)
    return colour


def rays(K, c2w, w, h, dx=0.5, dy=0.5):
    """Unit directions of a photo's pixels in world axes, row by row. -> (h*w,3)"""
    v, u = np.mgrid[:h, :w].reshape(2, -1)
    d = stack([(u + dx - K[2]) / K[0], (v + dy - K[3]) / K[1], np.ones(w * h)], 1)
    return (d / norm(d, axis=1, keepdims=True)) @ c2w[:, :3].T


def project(K, c2w, x):
    """Pixels (P,2), -1e9 behind the camera, and distances (P,) of points x (P,3)."""
    p = (x - c2w[:, 3]) @ c2w[:, :3]
    z = where(p[:, 2:] > 1 / FAR, p[:, 2:], np.nan)
    uv = p[:, :2] / z * K[:2] + K[2:]
    return np.nan_to_num(uv, nan=-1e9), norm(p, axis=1)


def toy_camera(rng, azimuth, size):
    """A tourist at `azimuth` [rad] from the front. -> K (4,), c2w (3,4) in the toy's units, w, h"""
    aspect = rng.choice([4 / 3, 3 / 2, 1.1, 3 / 4, 2 / 3])
    w, h = np.round(size * minimum((aspect, 1), (1, 1 / aspect))).astype(int)
    angle = radians(rng.uniform(40, 65))   # of view, along the long side
    f = size / 2 / np.tan(angle / 2)
    target = (0, .05, .80) + rng.uniform(-.12, .12, 3)
    away = array([sin(azimuth), -np.cos(azimuth), rng.uniform(-.15, .45)])
    away = away * f / min(w, h) * rng.uniform(2.0, 2.6)
    eye = target + away * rng.choice((0.8, 1), p=(.1, .9))
    eye[2] = max(eye[2], 0.2)
    z = (target - eye) / norm(target - eye)
    lean = rng.normal(0, .03, 2)   # hardly anyone holds it level
    x = cross(z, (*lean, 1))
    x /= norm(x)
    c2w = stack([x, cross(z, x), z, eye], 1)
    return array([f, f, w / 2, h / 2]), c2w, w, h


# Legs, belts of the coat and head: both ends x y and width, in heights above the feet.
STROKES = array("""
    -.06 .03 -.06 .45 .10
     .06 .03  .06 .45 .10
    -.05 .50  .05 .50 .16
    -.05 .56  .05 .56 .16
    -.05 .62  .05 .62 .16
    -.05 .68  .05 .68 .16
    -.05 .74  .05 .74 .16
      0  .92   0  .92 .15
""".split(), float).reshape(-1, 5)


def draw_people(rng, w, h, share):
    """Passers-by on about `share` of the photo. -> (h*w,4): colour times opacity, opacity"""
    canvas = np.zeros((4 * h, 4 * w, 4), np.float32)   # drawn large, then averaged
    while True:
        left = share - canvas[..., 3].mean()
        if left <= max(0.1 * share, 0.002):
            break
        tall = np.sqrt(left * w * h / .25) * rng.uniform(.5, 1)
        tall = 4 * clip(tall, .12 * h, .95 * h)
        feet = rng.uniform((0, 3.2 * h), (4 * w, 4 * h + .2 * tall))
        coat, legs, thing, skin = .02 + .83 * rng.beta(.4, .4, (4, 3))   # vivid, black or white
        skin = (.3 + skin[0]) * array([.8, .6, .45])
        stripe = thing if rng.random() < .4 else coat
        spot = rng.uniform((-.25, .5), (.25, 1.15))   # of a bag, balloon or hat
        end = spot + rng.uniform(-.15, .15, 2)
        strokes = [*STROKES, (*spot, *end, rng.uniform(.08, .25))]
        colours = legs, legs, coat, stripe, coat, stripe, coat, skin, thing
        for colour, (*ends, wide) in zip(colours, strokes):
            ends = feet + np.reshape(ends, (2, 2)) * (tall, -tall)
            thickness = int(wide * tall) + 1
            cv2.line(canvas, *ends.astype(int).tolist(), (*colour.tolist(), 1), thickness)
    small = cv2.resize(canvas, (w, h), interpolation=cv2.INTER_AREA)
    return small.reshape(-1, 4).astype(float)


def toy_points(rng, views, depths, people, count=3000):
    """As by SfM: noisy, 1.5 % wrong. -> points (K,5) as in finish, and those (M,) of each photo"""
    x, tracks = [], []
    photos = list(zip(views, depths, people))
    for (K, c2w, w, h), depth, hidden in photos:
        surface = c2w[:, 3] + rays(K, c2w, w, h) * depth[:, None]
        ok = (depth < 30) & ~hidden
        on = ok & (surface[:, 2] > .02) & (abs(surface[:, :2]) < 1.3).all(1)   # the landmark
        for some, n in (on, count // len(views)), (ok & ~on, count // 5 // len(views)):
            x.append(surface[rng.choice(flatnonzero(some), n * some.any())])
    x = concatenate(x)
    for (K, c2w, w, h), depth, hidden in photos:
        uv, distance = project(K, c2w, x)
        at = clip(uv, 0, (w - 1, h - 1)).astype(int) @ (1, w)
        ok = ((uv >= 0) & (uv < (w, h))).all(1)
        ok &= abs(depth[at] / distance - 1) < .02
        ok &= ~hidden[at] & (rng.random(len(x)) < .6)
        tracks.append(flatnonzero(ok))
    is_wrong = rng.random((len(x), 1)) < .015
    x += is_wrong * rng.uniform(-1, 1, x.shape)
    x = (x + rng.normal(0, .005, x.shape)) * TOY_SCALE + TOY_ORIGIN
    counts = bincount(concatenate(tracks), minlength=len(x))
    return np.column_stack([x, 0 * counts, counts]), tracks


def shake_camera(rng, K, c2w, pixels):
    """Moves c2w, in the toy's units, by noise that is `pixels` rms at the landmark."""
    *turn, dx, dy = rng.normal(0, pixels / 2, 4) / K[0]   # half by turning, half by moving [rad]
    c2w[:, 3] += c2w[:, :2] @ (dx, dy) * norm(c2w[:, 3])
    c2w[:, :3] = c2w[:, :3] @ cv2.Rodrigues(array([*turn, 0]))[0]


def make_toy(seed=0, size=96, photos=48, test=8, occluders=0.05, exposure=1.0, pose_noise=0.0,
             background=True, landmark=0, sun=0.0):
    """Scene of a procedural landmark, the same for every seed, another for every number. size: long
    side [px]. occluders: mean share of a training photo that people cover, 0..0.6. exposure: spread
    of brightness, white balance and contrast, 0 none, 1 tourists, 2 extreme. pose_noise: of the
    training photos [px rms at the landmark]. background=False: nothing else, before black. sun: its
    azimuth differs from photo to photo by up to this many degrees."""
    info = dict(locals(), scene="toy", kind="toy", downscale=1, folder=None, split=None)
    is_sound = occluders <= 0.6 and exposure <= 2 and sun <= 180 and pose_noise < inf
    is_sound &= min(seed, test, occluders, exposure, pose_noise, landmark, sun) >= 0
    check(is_sound and size >= 16 and photos >= 4, "the toy needs occluders in 0..0.6, exposure in "
          "0..2, sun in 0..180, size >= 16, photos >= 4, and no other number below 0")
    streams = [np.random.default_rng([seed, k]) for k in range(6)]   # no knob moves another
    camera, taste, people, sfm, shake, day = streams
    count = photos + test
    angles = 200 * (arange(count) + camera.uniform(.1, .9, count)) / count - 100
    views = [toy_camera(camera, angle, size) for angle in radians(angles)]
    is_test = np.isin(arange(count), (arange(test) + 0.5) * count // max(test, 1))
    share = people.gamma(0.8 + 6 * occluders, size=count) * ~is_test   # some photos stay free
    share = minimum(share / share.sum() * photos * occluders, 0.85)
    turns = radians(day.uniform(-sun, sun, count))
    suns = [cv2.Rodrigues(array([0, 0, turn]))[0] @ SUN for turn in turns]
    parts = toy_parts(landmark, background)
    depth, images, occluder = [], [], []
    for i in progress(range(count), "drawing photos"):
        K, c2w, w, h = views[i]
        o = np.broadcast_to(c2w[:, 3], (w * h, 3))
        d = [rays(K, c2w, w, h, *at) for at in itertools.product((.25, .75), repeat=2)]
        linear = sum(clip(shade(o, to, parts, background, suns[i]), 0, 1) for to in d)
        cover = draw_people(people, w, h, share[i])
        linear = linear / 4 * (1 - cover[:, 3:]) + cover[:, :3]   # (h*w,3)
        tint = exposure * taste.uniform(-1, 1, 4)
        balance = 1 + .1 * tint[1:3] @ [[1, 0, 0], [0, 0, 1]]   # of red and blue
        bright = clip(linear * (2 ** (tint[0] / 2) * balance), 0, 1)
        srgb = bright ** (1.2 ** tint[3] / 2.2)
        images.append((srgb * 255 + 0.5).astype(np.uint8).reshape(h, w, 3))
        depth.append(trace(o, rays(K, c2w, w, h), parts, background)[0])
        occluder.append(cover[:, 3] > 0)
    points, tracks = toy_points(sfm, views, depth, occluder)
    walls = [c2w[:, 3] + rays(K, c2w, w, h) * z[:, None] for (K, c2w, w, h), z in zip(views, depth)]
    for (K, c2w, *_), held_out in zip(views, is_test):
        shake_camera(shake, K, c2w, pose_noise * (not held_out))
        c2w[:, 3] = c2w[:, 3] * TOY_SCALE + TOY_ORIGIN
    building = parts[:len(LANDMARK)]   # all of it belongs in the unit sphere
    extent = building[:, [5, 7, 4]]
    extent = where(extent < inf, extent, building[:, [5]])   # columns and balls are round
    corners = [building[:, 1:4] + extent * signs for signs in itertools.product((-1, 1), repeat=3)]
    contain = concatenate(corners) * TOY_SCALE + TOY_ORIGIN
    K, c2w, *_ = zip(*views)
    name = [f"toy_{i:03d}.png" for i in range(count)]
    scene = finish(images, K, c2w, is_test, name, points, tracks, info, contain)
    scene["depth"] = (concatenate(depth) * TOY_SCALE / scene["scale"]).astype(np.float16)
    scene["occluder"] = concatenate(occluder)
    walls = concatenate(walls)[::9] * TOY_SCALE + TOY_ORIGIN
    walls = (walls - scene["center"]) / scene["scale"]
    walls = walls[norm(walls, axis=1) < 0.95]
    return scene | toy_walls(scene, walls, background, landmark)


def toy_walls(scene, wall, background, landmark):
    """What scores of geometry need, in scene units: visible walls (P,3) where they are smooth and
    their normals; points near walls, and the true signed distance there."""
    def sdf(x):   # (P,3) -> (P,)
        world = x * scene["scale"] + scene["center"]
        return toy_sdf(world, background, landmark) / scene["scale"]

    step = 0.004
    ends = [sdf(wall + axis) - sdf(wall - axis) for axis in step * np.eye(3)]
    normal = np.stack(ends, 1) / (2 * step)   # (P,3)
    is_smooth = abs(norm(normal, axis=1) - 1) < 0.01
    near = wall + np.random.default_rng(0).normal(0, 0.02, wall.shape)
    s = sdf(near)
    is_near = abs(s) < 0.05
    return dict(wall=wall[is_smooth], wall_normal=normal[is_smooth], near_wall=near[is_near],
                near_wall_sdf=s[is_near])


# ---- from photos, poses and points to a scene ----------------------------------------------------
def choose_points(points):
    """Which (K,) of the points are seen often enough and lie exactly enough."""
    error, views = points[:, 3], points[:, 4]
    usable = views >= (3 if (views >= 3).sum() >= 500 else 2)
    check(usable.sum() >= 20, f"{usable.sum()} usable 3D points: SfM needs more overlapping photos")
    return usable & (error <= quantile(error[usable], 0.95))


def find_sphere(x, weight, tracks, is_test, contain=()):
    """Centre (3,) and radius of what most photos look at; its definition is [D10].

    Centre: geometric median of points x (K,3) by weight. Radius: 1.1 x the distance of 95 %; if it
    is a skyline, more than four times the median distance away, only nearer points are counted.
    Inside are at least 30 % of the points (M,) of most training photos, and contain (P,3)."""
    centre = median(x, axis=0)
    for _ in range(20):   # Weiszfeld
        w = weight / maximum(norm(x - centre, axis=1), 1e-9)
        centre = w @ x / w.sum()
    distance = norm(x - centre, axis=1)   # (K,)
    counted = np.repeat(distance, weight)
    limit = 4 * median(counted)
    if quantile(counted, 0.95) > limit:
        counted = counted[counted <= limit]
    radius = 1.1 * quantile(counted, 0.95, method="inverted_cdf")
    training = [own for own, held_out in zip(tracks, is_test) if len(own) and not held_out]
    check(training, "no training photo observes a usable 3D point: they do not belong together")
    reach = median([quantile(distance[own], 0.3) for own in training])
    corners = norm(np.reshape(contain, (-1, 3)) - centre, axis=1)
    radius = max(radius, reach, *1.02 * corners)
    check(radius > 1 / FAR, "all 3D points coincide: run SfM again")
    return centre, radius


def finish(images, K, c2w, is_test, name, points, tracks, info, contain=()):
    """The scene of images (h,w,3), each of which observes the points tracks (M,). SfM units: c2w;
    points (K,5): x y z, error [px], views; contain (P,3)."""
    usable = choose_points(points)
    share = 2e6 / (1 + sum(map(len, tracks)))   # two million observations are plenty
    rng = np.random.default_rng(0)
    new_index = np.cumsum(usable) - 1
    kept = []
    for own in tracks:
        own = own[usable[own] & (rng.random(len(own)) < share)]
        kept.append(new_index[own])
    x = points[usable, :3]
    weight = minimum(points[usable, 4], 20).astype(int)
    centre, radius = find_sphere(x, weight, kept, is_test, contain)
    c2w = array(c2w)
    c2w[:, :, 3] = (c2w[:, :, 3] - centre) / radius
    arrays = dict(
        rgb=concatenate([image.reshape(-1, 3) for image in images]),
        wh=[image.shape[1::-1] for image in images],
        start=np.cumsum([0, *(image.size // 3 for image in images)]),
        K=K, c2w=c2w, is_test=is_test, name=name, info=json.dumps(info),
        points=(x - centre) / radius, center=centre, scale=radius,
        track_photo=np.repeat(arange(len(c2w)), [len(own) for own in kept]),
        track_point=concatenate(kept))
    scene = {key: np.asarray(value, FORMAT[key].split()[0]) for key, value in arrays.items()}
    return statistics(scene)


def statistics(scene):
    """Adds what geonvs.py decides by. near (I,): 0.8 x the 2 % quantile of the distances of a
    photo's points, >= 0.02. Of the training photos: footprint, lower quartile of a pixel's size at
    points in the sphere; exposure_spread, deviation of brightness (0..1) at equal points; bg_color
    (3,), beyond the sphere; NaN unless 60 % agree."""
    K, c2w, wh, rgb = scene["K"], scene["c2w"], scene["wh"], scene["rgb"]
    start = scene["start"]
    ends = np.searchsorted(scene["track_photo"], arange(1, len(wh)))
    tracks = np.split(scene["track_point"], ends)
    step = max(1, len(rgb) // 500_000)
    near, places = [], []   # of all photos
    seen, size, bright, beyond = [], [], [], []   # of the training photos
    for i, own in enumerate(tracks):
        uv, distance = project(K[i], c2w[i], scene["points"][own].astype(float))
        places.append(clip(uv / wh[i], -1, 2))
        near.append(max(0.8 * quantile(distance, 0.02), 0.02) if len(own) else 0.05)
        if scene["is_test"][i]:
            continue
        u, v = clip(uv, 0, wh[i] - 1).astype(int).T
        seen.append(own)
        size.append(distance / K[i, 0])
        bright.append(rgb[start[i] + v * wh[i, 0] + u].mean(1) / 255)
        o, d = c2w[i, :, 3], rays(K[i], c2w[i], *wh[i])
        closest = o - minimum(d @ o, 0)[:, None] * d   # to the centre, along each ray
        misses = norm(closest, axis=1) > 1
        beyond.append(rgb[start[i]:start[i + 1]][misses][::step])
    every, size, beyond = concatenate(seen), concatenate(size), concatenate(beyond)
    mean = bincount(every, concatenate(bright)) / maximum(bincount(every), 1)   # (K,)
    offsets = [median(b - mean[own]) for b, own in zip(bright, seen) if len(own)]
    color = np.full(3, np.nan)
    if len(beyond) > 100:   # fewer may all be people
        usual = median(beyond, 0)
        agree = (abs(beyond - usual) < 5.1).all(1)
        if agree.mean() > 0.6:
            color = usual / 255
    inside = norm(scene["points"][every], axis=1) < 1
    size = size[inside] if inside.any() else norm(c2w[:, :, 3], axis=1) / K[:, 0]
    added = dict(near=np.float32(near), track_uv=concatenate(places, dtype=np.float32))
    added.update(footprint=quantile(size, 0.25), exposure_spread=np.std(offsets), bg_color=color)
    return scene | added


# ---- folders with photos and COLMAP models -------------------------------------------------------
PHOTO_TYPES = ".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"
# By COLMAP's number of a camera model: how many numbers it has; and how many focal lengths, which
# come first, before centre and distortion.
PARAMETERS = [int(count) for count in "3 4 4 5 8 8 12 5 4 5 12 16 4 5 3 4 6 2".split()]
FOCAL_LENGTHS = {0: 1, 1: 2, 2: 1, 3: 1, 4: 2, 6: 2}   # not of fisheye and other models


@dataclass
class Photo:
    """A photo as a model has it, in SfM units."""
    fault: str = ""   # why it cannot be used; then nothing else is known
    wh: tuple = ()
    K: np.ndarray = None   # (4,)
    bend: np.ndarray = None   # k1 k2 p1 p2 k3 .. k6 of OpenCV
    c2w: np.ndarray = None   # (3,4)
    points: list = ()   # ids, then rows, of the points that it observes


def open_binary(path):
    """Bounded reader of a little-endian file: read(format) -> values, read(number) -> bytes."""
    check(path.is_file(), f"{path} is missing: copy the whole COLMAP model, in its binary form")
    file = io.BytesIO(path.read_bytes())

    def read(what):
        size = what if isinstance(what, int) else struct.calcsize("<" + what)
        data = file.read(min(size, sys.maxsize))
        check(len(data) == size, f"{path} ends too early: copy or export it again")
        return data if size == what else struct.unpack("<" + what, data)
    return read


def make_photo(camera, pose, ids):
    """Photo; UserError, a sentence about it, if it cannot be used."""
    check(camera, "has no camera in the model: export the model again")
    model, *wh, numbers = camera
    check(model in FOCAL_LENGTHS, f"has a fisheye or other camera, COLMAP's model {model}: run "
          "colmap image_undistorter")
    n = FOCAL_LENGTHS[model]
    is_sound = (abs(numbers) < FAR).all() and min(numbers[:n]) > 1 / FAR and 0 < min(wh)
    check(is_sound and max(wh) < 32767, f"has a camera of {wh[0]} x {wh[1]} with {numbers.tolist()}"
          ", which cannot be: export the model again")
    is_sound = all(abs(value) < FAR for value in pose) and any(pose[:4])   # false for nan
    check(is_sound, "has no sound pose: run SfM again")
    bend = np.zeros(8)
    bend[:len(numbers) - n - 2] = numbers[n + 2:]
    w, *v = array(pose[:4]) / math.hypot(*pose[:4])   # old files are not normalised
    turn = cross(v, eye(3))
    R = eye(3) + 2 * w * turn + 2 * turn @ turn   # camera to world
    c2w = np.column_stack([R, -R @ pose[4:]])
    return Photo("", tuple(wh), numbers[[0, n - 1, n, n + 1]], bend, c2w, ids)


def read_photos(sparse):
    """{name: Photo} of a COLMAP model."""
    cameras, photos = {}, {}
    read = open_binary(sparse / "cameras.bin")
    for _ in range(*read("Q")):
        key, model, w, h = read("IiQQ")
        check(0 <= model < len(PARAMETERS), f"{sparse} has camera model {model}, which is unknown: "
              "run colmap image_undistorter")
        cameras[key] = model, w, h, array(read(f"{PARAMETERS[model]}d"))
    read = open_binary(sparse / "images.bin")
    for _ in range(*read("Q")):
        _, *pose, camera = read("I7dI")
        name = b"".join(iter(lambda: read(1), b"\0")).decode(errors="replace")
        (count,) = read("Q")
        ids = np.frombuffer(read(24 * count), "<u8")[2::3].tolist()   # of u, v, point
        is_inside = name and name[0] != "/" and "\\" not in name and ".." not in name.split("/")
        check(is_inside, f"{sparse}: photo {name!r} is outside the image folder: rename it")
        check(name not in photos, f"{sparse}: photo {name!r} occurs twice: export the model again")
        try:
            photos[name] = make_photo(cameras.get(camera), pose, ids)
        except UserError as e:
            photos[name] = Photo(str(e))
    return photos


def read_points(sparse):
    """Points (K,5) of a COLMAP model, as in finish, and {id: row} of them."""
    path = sparse / "points3D.bin"
    triangulate = f"run colmap point_triangulator with --input_path {sparse}"
    check(path.is_file(), f"{path} is missing: {triangulate}")
    read = open_binary(path)
    points, rows = [], {}
    for _ in range(*read("Q")):
        key, x, y, z, *_, error, views = read("Q3d3BdQ")
        read(8 * views)
        if all(abs(value) < FAR for value in (x, y, z, error)):   # false for nan
            rows[key] = len(points)
            points.append((x, y, z, error, views))
    points = array(points, float).reshape(-1, 5)
    has_tracks = max(points[:, 4], default=0) > 1
    check(has_tracks, f"{path} has {len(points)} points, none with a track: {triangulate}")
    return points, rows


def photo_files(folder):
    """{name: path} of the photos below a folder; dense/ holds copies of those outside it."""
    files = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        is_photo = path.suffix.lower() in PHOTO_TYPES and path.name[0] != "."
        if is_photo and name.parts[0] != "dense":
            files[name.as_posix()] = path
    return files


def renamed(name, others):
    """Says which of the others the name means, if folder or extension alone differ."""
    same = [other for other in others if stem(other) == stem(name)]
    return f"; {same[0]} has another folder or extension" if same else ""


def stem(name):
    return Path(name.replace("\\", "/")).stem.lower()


def model_folders(folder, name="images.bin"):
    """Folders with COLMAP models, at most four levels down; links are followed."""
    found = [path.parent for depth in range(5) for path in folder.glob("*/" * depth + name)]
    return sorted(found, key=lambda place: (len(place.parts), place))


def open_model(folder, sparse):
    """A model with that folder of photos around it in which most of its photos are."""
    photos = read_photos(sparse)
    around = [sparse, *sparse.parents]
    around = around[:around.index(folder) + 1]
    places = [place / name for place in around for name in ("images", "input", "")]
    images = max(places, key=lambda place: len(photos.keys() & photo_files(place)))
    files = photo_files(images)
    names = sorted(photos.keys() & files)   # posed, and on disk
    return SimpleNamespace(sparse=sparse, photos=photos, images=images, files=files, names=names)


def find_model(folder, command):
    """The model in the folder with most usable photos; says what that leaves out."""
    places = model_folders(folder)
    texts = model_folders(folder, "images.txt")
    check(places or not texts, f"{folder} has models as text alone: run colmap model_converter "
          f"--output_type BIN with input and output path {' or '.join(map(str, texts))}")
    check(places, f"{folder} has no COLMAP model; run: python data_prep.py {command}")
    models = [open_model(folder, place) for place in places]
    best = max(models, key=lambda model: sum(not model.photos[n].fault for n in model.names))
    first = min(best.photos, default="")
    hint = renamed(first, map(str, folder.rglob("*")))
    check(best.names, f"no photo of {best.sparse} is on disk, such as {first}{hint}: put them into "
          f"{folder}/images, or run: python data_prep.py {command}")
    on_disk = max(len(model.files) for model in models if model.names)
    print(f"{best.images}: {on_disk} photos on disk, {len(best.names)} posed by {best.sparse}")
    for model in models:
        if model.photos.keys() != best.photos.keys():
            print(f"left out is another model: {len(model.photos)} posed by {model.sparse}")
    return best


def read_table(path):
    """Lines of a table of any separator, as lists of words."""
    text = path.read_bytes().decode("utf-8-sig", "replace")
    lines = [line for line in text.splitlines() if line.strip()] or [""]
    mark = max("\t;,", key=lines[0].count)
    return [[word.strip(' "') for word in line.split(mark)] for line in lines]


def read_split(path):
    """{name: "train" or "test"} of a table with NeRF-W's columns, without the rows with an empty
    id; or of train_list.txt and test_list.txt, one of which is `path`."""
    check(path.is_file(), f"the split file {path} is not there")
    head, *rows = read_table(path)
    if path.suffix == ".txt" and "split" not in head:
        head = "filename", "split"
        rows = []
        for part, other in ("train", "test"), ("test", "train"):
            table = path.with_name(path.name.replace(other, part))
            check(table.is_file(), f"{table} is missing: a split needs both lists")
            rows += [(words[0], part) for words in read_table(table)]
    check({"filename", "split"} <= set(head), f"{path} needs a header with filename and split")
    split = {}
    for words in rows:
        row = dict(zip(head, words))
        name, part = row.get("filename"), row.get("split")
        if row.get("id") == "":
            continue
        is_sound = name and part in ("train", "test") and split.setdefault(name, part) == part
        check(is_sound, f"{path}: {name!r} is {part!r}; each is train or test, and not both")
    return split


def find_split(folder):
    """The split file of a folder, or one of its two lists, or None."""
    tables = sorted([*folder.glob("[!.]*.tsv"), *folder.glob("[!.]*.csv")])   # or of other things:
    tables = [path for path in tables if path.suffix == ".tsv" or "split" in read_table(path)[0]]
    tables = tables or list(folder.glob("train*.txt"))
    names = ", ".join(table.name for table in tables)
    check(len(tables) < 2, f"{folder} has several split files ({names}): choose by --split")
    return tables[0] if tables else None


def fingerprint(folder, images, split):
    """Of names, sizes and times of all files that a scene is read from."""
    paths = [*photo_files(images).values(), *folder.glob("*.*")]
    for place in model_folders(folder):
        paths += place.glob("*.bin")
    paths += [Path(split)] if split else []
    paths = [path for path in sorted(paths) if path.exists()]
    lines = [f"{path} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in paths]
    return zlib.crc32(os.fsencode("\n".join(lines)))


def decode(path):
    """The photo, BGR as OpenCV has it, unturned as COLMAP has it. -> uint8 (h,w,3)"""
    data = path.read_bytes()
    is_whole = True   # OpenCV says nothing where a file is cut off
    if data[:2] == b"\xff\xd8":   # a JPEG: an end mark follows its last scan
        is_whole = data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")
    if data[1:4] == b"PNG":
        is_whole = b"IEND" in data
    check(is_whole, "is cut off: copy it again")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:   # empty, or more than a gigapixel
        image = None
    check(image is not None, "is empty, damaged, too large or no photo: replace it")
    return image


def read_photo(path, photo, downscale):
    """Undistorted, then reduced. -> rgb uint8 (h,w,3), K (4,)"""
    w, h = photo.wh
    K = photo.K
    check(downscale <= min(w, h) / 2, f"is {w} x {h}: --downscale {downscale} leaves nothing of it")
    image = decode(path)
    size = image.shape[1::-1]
    check(size == photo.wh, f"has {size[0]} x {size[1]} pixels, its camera {w} x {h}: put back the "
          "photos that SfM saw")
    if photo.bend.any():   # OpenCV's first pixel is at 0
        M = array([[K[0], 0, K[2] - 0.5], [0, K[1], K[3] - 0.5], [0, 0, 1]])
        P = cv2.getOptimalNewCameraMatrix(M, photo.bend, (w, h), 0)[0]   # shows nothing but photo
        if P[0, 0] <= M[0, 0] and P[1, 1] <= M[1, 1]:
            P = M
        image = cv2.undistort(image, M, photo.bend, None, P)
        K = P[[0, 1, 0, 1], [0, 1, 2, 2]] + (0, 0, 0.5, 0.5)
    small = array((w // downscale, h // downscale))
    image = cv2.resize(image, small.tolist(), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB), K * np.tile(small / photo.wh, 2)


def choose_parts(folder, model, split):
    """{name: "train" or "test"} of the photos that are to be used; says by which rule."""
    table = Path(split) if split else find_split(folder)
    if table is None:
        print(f"{folder} has no split file: every eighth photo is held out")
        return {n: "test" if i % 8 == 7 else "train" for i, n in enumerate(model.names)}
    parts = read_split(table)
    print(f"split by {table}")
    rest = set(model.names) - parts.keys()
    if rest:
        warn(f"{len(rest)} photos are not in {table}: {min(rest)} ...")
    return parts


def read_usable(model, parts, downscale):
    """{name: (rgb, K)} of the photos that can be used; says which cannot, and why."""
    usable, faults = {}, {}
    for name in progress(sorted(parts), "preparing photos"):
        try:
            hint = renamed(name, model.names)
            check(name in model.names, f"has no pose or no file{hint}")
            photo = model.photos[name]
            check(not photo.fault, photo.fault)
            angle = 2 * np.degrees(np.arctan(max(photo.wh / photo.K[:2]) / 2))
            is_usual = parts[name] == "test" or 10 <= angle <= 120
            check(is_usual, f"is {angle:.1f} degrees wide, which is not in 10..120")
            usable[name] = read_photo(model.files[name], photo, downscale)
        except UserError as e:
            faults[name] = f"{name} {e}"
            warn(f"left out: {name} {e}")
    lost = [faults[name] for name in faults if parts[name] == "test"]
    lost = "; ".join(lost[:3]) + f" and {len(lost) - 3} more" * (len(lost) > 3)
    check(not lost, f"held-out photos cannot be used: {lost}; mend them, or hold out others")
    count = sum(parts[name] == "train" for name in usable)
    first = min(faults.values(), default="mend the split file")
    check(count >= 2, f"{count} usable training photos are too few: {first}")
    return usable


def prepare(name, downscale=2, split=None):
    """Scene of one of SCENES, or of a folder with photos and a COLMAP model; see FORMAT."""
    check(downscale >= 1, f"--downscale {downscale} is not 1 or more")
    folder, command = Path(name), f"{name} --sfm"
    if name in SCENES:
        folder, command = Path("data", name), f"{name} --download"
        if not folder.is_dir():
            folder = Path("data", SCENES[name][0])
    model = find_model(folder, command)
    files = fingerprint(folder, model.images, split)
    parts = choose_parts(folder, model, split)
    points, rows = read_points(model.sparse)
    photos = model.photos
    for photo in photos.values():
        photo.points = array([rows[key] for key in photo.points if key in rows], int)
    usable = read_usable(model, parts, downscale)
    images, K = zip(*usable.values())
    is_test = array([parts[name] == "test" for name in usable])
    c2w = [photos[name].c2w for name in usable]
    tracks = [photos[name].points for name in usable]
    info = dict(scene=folder.resolve().name, kind="colmap", downscale=downscale, files=files,
                folder=str(folder), images=str(model.images), split=None)
    if split:
        info["split"] = str(Path(split).resolve())
    scene = finish(images, K, c2w, is_test, list(usable), points, tracks, info)
    uv = scene["track_uv"]
    share = ((uv >= 0) & (uv <= 1)).all(1).mean()
    if np.std(uv) < .02:
        share = 0   # all in the middle: points in smaller units than the poses
    says = f"{share:.0%} of the sightings of {model.sparse} fall into the photo that saw them"
    check(share >= .5, f"only {says}: give poses as COLMAP does, world to camera, x right, y down, "
          "z forward, in the units of the points")
    if share < .9:
        warn(f"only {says}")
    inside = (norm(scene["points"], axis=1) < 1).mean()
    print(f"the sphere has a radius of {scene['scale']:.3g} units of the reconstruction; "
          f"{inside:.0%} of the points are inside")
    return scene


def scene_path(name_or_folder):
    """data/<scene>.npz; of two folders with one name each has its own."""
    folder = Path(name_or_folder).resolve()
    mark = ""
    if name_or_folder not in ("toy", *SCENES):
        mark = f"-{zlib.crc32(os.fsencode(folder)):08x}"
    return Path("data", f"{folder.name}{mark}.npz")


def open_scene(name_or_folder, downscale=2):
    """Scene from its file: made on first use, and anew if its sources differ in any way."""
    path = scene_path(name_or_folder)
    is_toy = name_or_folder == "toy"
    split = None
    if path.exists():
        scene = read_scene(path)
        info = json.loads(str(scene["info"]))
        split = info["split"]   # named once, by --split
        folder, images = Path(info["folder"] or ""), Path(info.get("images", ""))
        is_alone = is_toy or not folder.is_dir()   # a scene file does without its sources
        if is_alone or info.get("files") == fingerprint(folder, images, split):
            if is_toy or info["downscale"] == downscale:
                return scene
    print(f"making {path}")
    scene = make_toy() if is_toy else prepare(name_or_folder, downscale, split)
    write_scene(path, scene)
    return scene


# ---- download, SfM, command line -----------------------------------------------------------------
def fetch(url, path):
    """Streams url into path; what came of a broken transfer waits in path.part to be continued."""
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(part, "ab") as file:   # the last byte again: so a whole part is no special case
            have = max(file.tell() - 1, 0)
            request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"})
            with urllib.request.urlopen(request, timeout=60) as answer:
                if answer.status != 206:
                    have = 0   # a server without ranges starts over
                total = have + int(answer.headers.get("Content-Length", -1))
                file.truncate(have)
                for _ in progress(range(have, total, 1 << 20), f"MiB of {path.name}"):
                    have += file.write(answer.read(1 << 20))
        check(have == total, f"the download of {url} broke off; the same command continues it")
        os.replace(part, path)
    except (OSError, http.client.HTTPException) as e:
        if getattr(e, "code", 0) == 416:   # longer than the file itself
            part.unlink()
        raise UserError(f"the download of {url} broke ({e}); the same command continues it") from e


def unpack(archive, wanted, folder):
    """Files of a .tar.gz whose names start so; the whole archive is checked."""
    with gzip.open(archive) as raw:
        with tarfile.open(fileobj=raw, mode="r|") as tar:
            for member in tar:   # files only: a link could lead outside
                if member.isfile() and member.name.startswith(wanted):
                    tar.extract(member, folder, filter="data")
        while raw.read(1 << 20):   # to the checksum at the very end
            pass


def download(name, archive_url=ARCHIVE_URL, split_url=SPLIT_URL):
    """Photos and reconstruction of one of SCENES, with its split file -> data/<name>/"""
    check(name in SCENES, f"--download knows {', '.join(SCENES)}, not {name}")
    scene, table_name = SCENES[name]
    home = Path("data", name)
    table = Path("data", table_name)
    archive = Path("data", f"{scene}.tar.gz")
    check(not home.exists(), f"{home} is there already: move it, or leave --download out")
    if not table.exists():
        fetch(split_url + table.name, table)
    if not archive.exists():
        fetch(archive_url + archive.name, archive)
    try:
        with tempfile.TemporaryDirectory(dir="data") as temporary:
            unpack(archive, (f"{scene}/dense/images/", f"{scene}/dense/sparse/"), temporary)
            shutil.copy(table, Path(temporary, scene, table.name))
            os.replace(Path(temporary, scene), home)
    except (tarfile.TarError, EOFError, zlib.error, OSError, TypeError) as e:
        raise UserError(f"cannot unpack {archive} ({e}): free space, or delete it and retry") from e


def run_sfm(folder):
    """Poses for the raw photos in `folder`, by pycolmap -> folder/dense/{images,sparse}"""
    import pycolmap   # an extra: main says when it is not there
    database = folder / "database.db"
    models = folder / "models"
    dense = folder / "dense"
    is_new = folder.is_dir() and not dense.exists()
    check(is_new, f"{folder} is missing, or has dense/: delete that")
    models.mkdir(exist_ok=True)
    # Of 135 photos of a statue in all lights these options pose 104 in one model instead of 60.
    features = pycolmap.FeatureExtractionOptions()
    features.sift.estimate_affine_shape = True
    features.sift.domain_size_pooling = True
    matching = pycolmap.FeatureMatchingOptions()
    matching.guided_matching = True
    pycolmap.extract_features(database, folder, extraction_options=features)
    pycolmap.match_exhaustive(database, matching_options=matching)
    found = pycolmap.incremental_mapping(database, folder, models)
    check(found, f"the photos in {folder} do not match each other; take more, with more overlap")
    best = max(found, key=lambda i: found[i].num_reg_images())
    pycolmap.undistort_images(dense, models / str(best), folder)


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False, argument_default=argparse.SUPPRESS)
    add = parser.add_argument
    add("scene", help=f"toy, {', '.join(SCENES)}, or a folder")
    add("--download", action="store_true", help="fetch archive and split file first")
    add("--sfm", action="store_true", help="the folder has raw photos: pose them first")
    add("--downscale", type=int, help="photos get this many times smaller; default 2")
    add("--split", help="table of training and test photos; default: <folder>/*.tsv or *.csv, or "
        "train_list.txt and test_list.txt, or every eighth photo")
    knobs = inspect.signature(make_toy).parameters
    for key, knob in knobs.items():
        how = {"type": type(knob.default)}
        if isinstance(knob.default, bool):
            how = {"action": argparse.BooleanOptionalAction}
        add(f"--{key}", help=f"toy, default {knob.default}", **how)
    given = vars(parser.parse_args(argv))
    name = given.pop("scene")
    is_download = given.pop("download", False)
    is_sfm = given.pop("sfm", False)
    path = scene_path(name)
    allowed = knobs if name == "toy" else ("downscale", "split")
    wrong = given.keys() - allowed
    try:
        check(not wrong, f"--{' --'.join(wrong)}: not for {name}")
        if is_download:
            download(name)
        if is_sfm:
            run_sfm(Path(name))
        scene = make_toy(**given) if name == "toy" else prepare(name, **given)
        write_scene(path, scene)
    except (UserError, OSError, MemoryError, ImportError, KeyboardInterrupt) as e:
        warn(f"error: {e}" if str(e) else "error: stopped; start again")
        sys.exit(2)
    print(f"{path}: {len(scene['wh'])} photos, {scene['is_test'].sum()} of them for testing")


if __name__ == "__main__":
    main()
