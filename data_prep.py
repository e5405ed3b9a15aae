"""Scene files for geonvs.py: a synthetic landmark, or photos with a COLMAP reconstruction.

    python data_prep.py toy --occluders 0.4     -> data/toy.npz; every knob of make_toy is a flag
    python data_prep.py brandenburg --download  -> data/brandenburg.npz, from an archive of 5 GB
    python data_prep.py my_photos --sfm         raw photos, by pycolmap -> data/my_photos-*.npz
    python data_prep.py my_scene                my_scene/[dense/]{images,sparse} -> the same

A scene is one .npz. I photos, N pixels, K points, T observations; R rays, P parts:

    rgb          uint8 (N,3)      all photos one after the other, each row by row
    start        int64 (I+1,)     photo i owns the pixels start[i]:start[i+1]
    wh           int32 (I,2)      width, height [px]
    K            float64 (I,4)    fx fy cx cy [px]; the centre of the first pixel is (0.5, 0.5)
    c2w          float64 (I,3,4)  camera to world, normalised; OpenCV: x right, y down, z forward
    near         float32 (I,)     0.8 x the 2 % quantile of the photo's points' distances, >= 0.02
    is_test      bool (I,)        held out from training
    name         str (I,)         file names
    points       float32 (K,3)    SfM points, normalised
    track_photo, track_point      int32 (T,): photo track_photo[j] (sorted) observes track_point[j]
    center, scale                 float64 (3,), (): x_world = x * scale + center
    footprint, exposure_spread, bg_color    what geonvs.py decides by; see statistics
    info         JSON text        scene, kind (toy or colmap), downscale, reprojection_px, left_out;
                                  split: what --split named; of a toy its knobs
    depth        float16 (N,)     toy: true distance, normalised; inf is sky
    occluder     bool (N,)        toy: pixels that a passer-by covers

The landmark lies in the unit sphere. A ray is c2w[:, 3] + t * d with |d| = 1; a distance is this t,
never a z-depth. Functions raise UserError, one sentence that says what to do.
"""
import argparse, gzip, http.client, inspect, itertools, json, math, os, shutil, struct, sys
import tarfile, urllib.request, zipfile, zlib
from pathlib import Path

import cv2
import numpy as np

SCENES = {"brandenburg": ("brandenburg_gate", "brandenburg.tsv"),   # name: (archive, split file)
          "sacre": ("sacre_coeur", "sacre.tsv"),
          "trevi": ("trevi_fountain", "trevi.tsv"),
          "taj": ("taj_mahal", "taj_mahal.tsv")}
ARCHIVE_URL = "https://www.cs.ubc.ca/research/kmyi_data/imw2020/TrainingData/"
SPLIT_URL = "https://nerf-w.github.io/data/selected_images/"
POINT = np.dtype([("id", "u8"), ("xyz", "f8", 3), ("error", "f8"), ("views", "i8")])   # error [px]


class UserError(Exception):
    """Something that the person at the keyboard can mend: one sentence that says how."""


def need(ok, message):
    if not ok:
        raise UserError(message)


def atomic_write(path, write):
    """write(temporary path), then rename: `path` is the whole old file or the whole new one."""
    path = Path(path)
    part = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if write(part) is False:   # how cv2.imwrite says no
            raise OSError("encoding failed")
        os.replace(part, path)
    except OSError as e:
        raise UserError(f"cannot write {path} ({e.strerror or e}): free or choose a place") from e
    finally:
        if part.exists():
            part.unlink()


def scene_path(scene, is_folder):
    """data/<scene>.npz; of two folders with one name each has its own."""
    folder = Path(scene).resolve()
    where = f"-{zlib.crc32(str(folder).encode()):08x}" if is_folder else ""
    return Path("data") / f"{folder.name}{where}.npz"


def write_scene(path, scene):
    """Uncompressed: a third larger, but six times faster to write and no slower to read."""
    atomic_write(path, lambda part: np.savez(part, **scene))


def refuse_bomb(path):
    """Raises BadZipFile for what is no zip file, or larger inside than outside: ours never are."""
    with zipfile.ZipFile(path) as file:
        if sum(member.file_size for member in file.infolist()) > os.path.getsize(path):
            raise zipfile.BadZipFile(f"{path} is larger inside than outside")


def read_scene(path):
    """The dictionary of a scene file; UserError if it is not one, or not all of it."""
    try:
        refuse_bomb(path)
        with zipfile.ZipFile(path) as file:   # what a header promises must be there
            for member in file.infolist():
                with file.open(member) as array:
                    np.lib.format.read_magic(array)
                    shape, _, dtype = np.lib.format.read_array_header_1_0(array)
                    need(math.prod(shape) * dtype.itemsize <= member.file_size, "")
        with np.load(path, allow_pickle=False) as file:
            scene = {key: file[key] for key in file.files}
        is_whole = is_consistent(scene)
    except Exception as e:   # a damaged file can fail in any layer: zip, array header, dtype, text
        raise UserError(f"cannot read {path} ({type(e).__name__}): delete it, it is remade") from e
    need(is_whole, f"{path} is no complete scene file of this version: delete it, it is remade")
    return scene


def is_consistent(scene):
    """Do the arrays of a scene fit together? Wrong shapes and types may also raise anything."""
    start, wh, count, points = scene["start"], scene["wh"], len(scene["wh"]), len(scene["points"])
    photo, point, info = scene["track_photo"], scene["track_point"], json.loads(str(scene["info"]))
    shapes = dict(rgb=(start[-1], 3), start=(count + 1,), wh=(count, 2), K=(count, 4),
                  c2w=(count, 3, 4), near=(count,), is_test=(count,), name=(count,),
                  points=(points, 3), track_photo=photo.shape[:1], track_point=photo.shape[:1],
                  center=(3,), scale=(), footprint=(), exposure_spread=(), bg_color=(3,), info=())
    kinds = dict(rgb="u", is_test="b", name="U", info="U") | dict.fromkeys(
        ("start", "wh", "track_photo", "track_point"), "i")
    return (all(scene[k].shape == v and scene[k].dtype.kind == kinds.get(k, "f")
                for k, v in shapes.items())
            and count > 0 and (wh > 0).all() and scene["rgb"].dtype == np.uint8 and start[0] == 0
            and (np.diff(start) == wh.prod(1, dtype=np.int64)).all() and not scene["is_test"].all()
            and all(np.isfinite(scene[k]).all() for k in shapes if k not in {*kinds, "bg_color"})
            and min(scene["footprint"], scene["scale"]) > 0
            and ((0 <= photo) & (photo < count) & (0 <= point) & (point < points)).all()
            and {"scene", "kind", "downscale"} <= info.keys())


# ---- the toy: z up, front towards -y, in its own units; world = TOY_SCALE * x + TOY_ORIGIN -------

TOY_SCALE, TOY_ORIGIN, INF = 3.7, np.array([12.0, -7.0, 5.0]), np.inf
SUN = np.array([-.50, -.62, .60]) / np.linalg.norm([-.50, -.62, .60])   # left, behind the tourists
STONE, PALE, SAND, BRICK, ROOF, SLATE, COPPER, GOLD, HOUSE, LEAF, PAVING, MEADOW = range(12)
LOOKS = np.array([   # colour, width and height of a cell, contrast between cells, has windows
    (.50, .46, .40, .29, .13, .20, 0), (.80, .74, .60, .29, .13, .08, 0),
    (.78, .56, .30, .30, .30, .15, 1), (.52, .19, .11, .30, .30, .15, 1),
    (.60, .22, .12, .16, .08, .30, 0), (.12, .19, .31, .20, .10, .25, 0),
    (.16, .46, .36, .50, .50, .40, 0), (.90, .58, .08, .50, .50, .00, 0),
    (.60, .46, .34, .62, .62, .15, 1), (.10, .22, .05, .20, .20, .45, 0),
    (.48, .42, .34, .42, .42, .20, 0), (.17, .22, .08, .60, .60, .10, 0)])
# Part: |z| <= half around its centre, and its first `round` coordinates lie in a ball whose radius
# runs from bottom to top: 1 a box or roof (its |y| <= depth), 2 a column or cone; 3 is a ball.
LANDMARK = np.array([   # round, centre x y z, half, bottom, top, depth, look
    (1, -.01, -.03, .05, .05, .96, .96, .53, STONE), (1, -.05, 0, .15, .05, .85, .85, .47, STONE),
    *[(2, x, -.34, .47, .27, .062, .050, INF, PALE) for x in np.linspace(-.54, .60, 6)],
    (1, .03, .20, .53, .33, .59, .59, .26, SAND), (1, .03, .03, .80, .06, .67, .67, .46, PALE),
    (1, .03, .03, .98, .12, .71, 0, .48, ROOF), (2, -.05, .22, 1.07, .17, .33, .31, INF, SAND),
    (3, -.05, .22, 1.24, .30, .30, .30, INF, COPPER),                        # dome, lantern, finial
    (2, -.05, .22, 1.57, .07, .075, .065, INF, PALE),
    (2, -.05, .22, 1.70, .06, .10, .02, INF, COPPER),
    (3, -.05, .22, 1.78, .045, .045, .045, INF, GOLD),
    (1, .87, .18, .53, .53, .17, .17, .17, BRICK), (1, .87, .18, 1.10, .04, .20, .20, .20, PALE),
    (2, .87, .18, 1.32, .18, .20, .00, INF, SLATE),                          # tower; annex; statue
    (1, -.76, .24, .38, .18, .19, .19, .25, BRICK), (1, -.76, .24, .65, .09, .23, 0, .28, SLATE),
    (1, -.80, -.35, .28, .08, .09, .09, .09, PALE), (2, -.8, -.35, .48, .12, .07, .04, INF, COPPER),
    (3, -.80, -.35, .64, .055, .055, .055, INF, COPPER)])
TOWN = np.concatenate([LANDMARK, [row for x, y, w, h in [   # houses, and a tree before each
    (-7.5, 2.0, .6, 1.5), (-6.2, 4.4, .5, 1.1), (-4.0, 6.4, .8, 1.8), (-1.2, 7.6, .5, 2.3),
    (2.0, 6.8, .7, 1.4), (4.6, 5.6, .5, 1.9), (6.8, 3.0, .6, 1.3), (7.4, 0.0, .5, 1.7)] for row in [
        (1, x, y, h / 2, h / 2, w, w, w, HOUSE), (1, x, y, h + .25, .25, w, 0, w, SLATE),
        (3, .8 * x + 1, .7 * y, .2 + .8 * w, .8 * w, .8 * w, .8 * w, INF, LEAF)]]])


def part_sdf(part, x):
    """Distance to one part (9,), or to one part for each point (P,9). x (P,3) -> (P,)"""
    n, half, bottom, top, depth = part.T[[0, 4, 5, 6, 7]]
    p = x - part[..., 1:4]
    u, z = np.where(n == 1, np.abs(p[:, 0]), np.hypot(p[:, 0], p[:, 1])), p[:, 2]
    grow, tall = top - bottom, 2 * half                      # the slanted side, from bottom to top
    k = np.clip(((u - bottom) * grow + (z + half) * tall) / (grow ** 2 + tall ** 2), 0, 1)
    side = np.hypot(u - bottom - k * grow, z + half - k * tall)
    cap = np.hypot(np.maximum(u - np.where(z < 0, bottom, top), 0), np.abs(z) - half)
    inside = (np.abs(z) < half) & (u < bottom + grow * (z + half) / tall)
    d = np.where(inside, -1, 1) * np.minimum(side, cap)
    e = np.abs(p[:, 1]) - depth                              # -inf where there is no depth
    d = np.hypot(np.maximum(d, 0), np.maximum(e, 0)) + np.minimum(np.maximum(d, e), 0)
    return np.where(n == 3, np.hypot(u, z) - bottom, d)


def toy_sdf(x_world, ground=True):
    """Signed distance of the toy, + and exact outside, world units. (P,3) -> (P,) float64
    ground=False: the landmark alone, as in make_toy(background=False)."""
    x = (np.asarray(x_world, np.float64) - TOY_ORIGIN) / TOY_SCALE
    d = x[:, 2] if ground else np.full(len(x), INF)
    for part in TOWN if ground else LANDMARK:
        d = np.minimum(d, part_sdf(part, x))
    return d * TOY_SCALE


@np.errstate(divide="ignore", invalid="ignore")
def trace(o, d, ground):
    """First hits of rays, closed form: distance (R,), inf is sky, and part (R,), -1 is the ground.

    A part is where a quadric and up to two slabs overlap; its hit is where the last one begins."""
    t = np.where(ground & (d[:, 2] < -1e-3), -o[:, 2] / d[:, 2], INF)      # (R,)
    which, parts = np.full(len(d), -1), TOWN if ground else LANDMARK
    centre = parts[:, 1:4]                                   # bounding spheres first
    along = centre @ d.T - (o * d).sum(1)                    # (P,R)
    aside = (centre ** 2).sum(1)[:, None] - 2 * centre @ o.T + (o * o).sum(1) - along ** 2
    for i, (n, *_, half, bottom, top, depth, _) in enumerate(parts):
        n, grow = int(n), (top - bottom) / half / 2
        radius = np.linalg.norm((max(bottom, top), half * (n < 3), depth if n == 1 else 0))
        rows = np.flatnonzero((aside[i] < radius ** 2) & (np.abs(along[i]) < radius + t))
        p, v = o[rows] - centre[i], d[rows]
        w, rise = (bottom + top) / 2 + grow * p[:, 2], grow * v[:, 2]
        a = (v[:, :n] ** 2).sum(1) - rise ** 2
        b = (v[:, :n] * p[:, :n]).sum(1) - rise * w
        root = np.sqrt(b * b - a * ((p[:, :n] ** 2).sum(1) - w * w))       # nan for a miss
        enter = np.where((a < 0) & (rise < 0), -INF, (-b - root) / a)      # a < 0: a cone, open at
        leave = np.where((a < 0) & (rise > 0), INF, (-b + root) / a)       # one end
        for axis in range(n, 3):
            reach = np.abs((depth, half)[axis - 1] / v[:, axis])
            enter = np.maximum(enter, -p[:, axis] / v[:, axis] - reach)
            leave = np.minimum(leave, -p[:, axis] / v[:, axis] + reach)
        hit = (enter < leave) & (enter > 0) & (enter < t[rows])
        t[rows[hit]], which[rows[hit]] = enter[hit], i
    return t, which


def shade(o, d, background):
    """Radiance along rays: sun, shadow, sky light and haze. o, d (R,3) -> (R,3) linear"""
    up, azimuth = d[:, 2:], np.arctan2(d[:, :1], d[:, 1:2])
    colour = (.58, .68, .78) + np.clip(up * 1.5, 0, 1) * (-.52, -.46, -.26)
    for base, size, waves, hill in (.11, .045, 5, (.25, .33, .45)), (.06, .03, 9, (.11, .18, .16)):
        ridge = np.sin(waves * azimuth + base * 40) + 0.6 * np.sin(2.3 * waves * azimuth)
        colour = np.where(up < base + size * ridge, hill, colour)
    colour *= background
    t, which = trace(o, d, background)
    hit = np.flatnonzero(t < INF)
    x, floor, part = o[hit] + t[hit, None] * d[hit], which[hit] < 0, TOWN[which[hit]]   # (R,9)
    normal = np.stack([part_sdf(part, x + e) - part_sdf(part, x - e) for e in 1e-5 * np.eye(3)], 1)
    normal = np.where(floor[:, None], (0, 0, 1), normal / 2e-5)
    turn = np.arctan2(x[:, 1] - part[:, 2], x[:, 0] - part[:, 1])
    across = np.where(floor, x[:, 0], np.where(part[:, 0] == 1, x[:, 0] + x[:, 1], turn))
    square = np.where(np.hypot(x[:, 0], x[:, 1]) < 2.6, PAVING, MEADOW)
    look = LOOKS[np.where(floor, square, part[:, 8]).astype(int)]
    row = np.where(floor, x[:, 1], x[:, 2]) / look[:, 4]     # solid texture of cells; without
    column = across / look[:, 3] + (np.floor(row) % 2 / 2) * (1 - look[:, 6])   # windows, a bond
    chance = np.abs(np.sin(12.9898 * np.floor(column) + 78.233 * np.floor(row))) * 437.585 % 1
    dark = look[:, 6] * (np.abs(column % 1 - .5) < .2) * (np.abs(row % 1 - .45) < .28)
    paint = look[:, :3] * ((1 + look[:, 5] * (2 * chance - 1)) * (1 - .8 * dark))[:, None]
    sun = np.clip(normal @ SUN, 0, None)[:, None]
    sun[trace(x + 1e-4 * normal, np.broadcast_to(SUN, x.shape), background)[0] < INF] = 0
    light = sun * (1.15, 1.05, .88) + (0.20 + 0.10 * normal[:, 2:]) * (.8, .92, 1.15)
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
    z = np.where(p[:, 2:] > 0, p[:, 2:], np.nan)
    return np.nan_to_num(p[:, :2] / z * K[:2] + K[2:], nan=-1e9), np.linalg.norm(p, axis=1)


def toy_camera(rng, azimuth, size):
    """A tourist at `azimuth` [rad] from the front. -> w, h, K (4,), c2w (3,4) in the toy's units"""
    aspect = rng.choice([4 / 3, 3 / 2, 1.1, 3 / 4, 2 / 3])
    w, h = np.round(size * np.minimum((aspect, 1), (1, 1 / aspect))).astype(int)
    f = size / 2 / np.tan(np.radians(rng.uniform(40, 65)) / 2)
    target = (0, .05, .80) + rng.uniform(-.12, .12, 3)
    away = np.array([np.sin(azimuth), -np.cos(azimuth), rng.uniform(-.15, .45)])
    eye = target + away * f / min(w, h) * rng.uniform(2.0, 2.6) * rng.choice((0.8, 1), p=(.1, .9))
    eye[2] = max(eye[2], 0.2)
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, (*rng.normal(0, .03, 2), 1))             # hardly anyone holds it level
    x /= np.linalg.norm(x)
    return w, h, np.array([f, f, w / 2, h / 2]), np.stack([x, np.cross(z, x), z, eye], 1)


def draw_people(rng, w, h, share):
    """Passers-by on about `share` of the photo. -> (h*w,4): colour times opacity, opacity"""
    canvas = np.zeros((4 * h, 4 * w, 4), np.float32)         # drawn large, then averaged
    while (left := share - canvas[..., 3].mean()) > max(0.1 * share, 0.002):
        tall = 4 * np.clip(np.sqrt(left * w * h / .25) * rng.uniform(.5, 1), .12 * h, .95 * h)
        feet = rng.uniform((0, 3.2 * h), (4 * w, 4 * h + .2 * tall))
        coat, legs, thing, skin = .02 + .83 * rng.beta(.4, .4, (4, 3))   # vivid, black or white
        stripe, belts = thing if rng.random() < .4 else coat, np.arange(.5, .75, .06)
        spot = rng.uniform((-.25, .5), (.25, 1.15))          # of a bag, balloon or hat
        for colour, *ends, wide in [
                (legs, -.06, .03, -.06, .45, .1), (legs, .06, .03, .06, .45, .1),
                *[((coat, stripe)[i % 2], -.05, y, .05, y, .16) for i, y in enumerate(belts)],
                ((.3 + skin[0]) * np.array([.8, .6, .45]), 0, .92, 0, .92, .15),
                (thing, *spot, *(spot + rng.uniform(-.15, .15, 2)), rng.uniform(.08, .25))]:
            ends = (feet + np.reshape(ends, (2, 2)) * (tall, -tall)).astype(int).tolist()
            cv2.line(canvas, *ends, (*colour.tolist(), 1), int(wide * tall) + 1)
    return cv2.resize(canvas, (w, h), interpolation=cv2.INTER_AREA).reshape(-1, 4).astype(float)


def toy_points(rng, wh, K, c2w, depth, occluder, count=3000):
    """What SfM would find: noisy points of visible surfaces, 1.5 % of them quite wrong.

    -> points (K,) POINT in the toy's units; per observation photo (T,), point (T,), pixel (T,2)"""
    x, seen = [], []
    for i, (w, h) in enumerate(wh):
        surface = c2w[i, :, 3] + rays(K[i], c2w[i], w, h) * depth[i][:, None]
        ok = (depth[i] < 30) & ~occluder[i]
        on = ok & (surface[:, 2] > .02) & (np.abs(surface[:, :2]) < 1.3).all(1)
        for some, n in (on, count // len(wh)), (ok & ~on, count // 5 // len(wh)):
            x.append(surface[rng.choice(np.flatnonzero(some), n * some.any())])
    x = np.concatenate(x)
    for i, (w, h) in enumerate(wh):
        uv, distance = project(K[i], c2w[i], x)
        at = np.clip(uv.astype(int), 0, (w - 1, h - 1)) @ (1, w)
        ok = ((uv >= 0) & (uv < (w, h))).all(1) & (np.abs(depth[i][at] / distance - 1) < .02)
        ok &= ~occluder[i][at] & (rng.random(len(x)) < .6)
        seen.append((np.full(ok.sum(), i), np.flatnonzero(ok), uv[ok]))
    photo, point, uv = map(np.concatenate, zip(*seen))
    points = np.zeros(len(x), POINT)
    points["views"] = np.bincount(point, minlength=len(x))
    wild = (rng.random((len(x), 1)) < .015) * rng.uniform(-1, 1, x.shape)
    points["xyz"] = x + rng.normal(0, .005, x.shape) + wild
    return points, photo, point, uv


def make_toy(seed=0, size=96, photos=48, test=8, occluders=0.05, exposure=1.0, pose_noise=0.0,
             background=True):
    """Scene of a small procedural landmark, the same landmark for every seed.

    size: long side [px]. occluders: mean share of a training photo that people cover, 0..0.6.
    exposure: spread of brightness, white balance and contrast, 0 none, 1 tourists, 2 extreme.
    pose_noise: error of the training poses [px rms at the landmark]. background=False: nothing
    but the landmark, before black."""
    knobs = dict(locals())
    need(0 <= occluders <= 0.6 and 0 <= exposure <= 2 and min(size / 16, photos / 4) >= 1
         and min(test, seed) >= 0 and 0 <= pose_noise < math.inf, "the toy needs occluders in "
         "0..0.6, exposure in 0..2, size >= 16, photos >= 4, no negative seed, test or pose_noise")
    camera, taste, people, sfm, shake = (np.random.default_rng([seed, k]) for k in range(5))
    count = photos + test                                    # a stream each: no knob moves another
    angles = 200 * (np.arange(count) + camera.uniform(.1, .9, count)) / count - 100
    w, h, K, c2w = map(np.array, zip(*[toy_camera(camera, a, size) for a in np.radians(angles)]))
    is_test = np.isin(np.arange(count), (np.arange(test) + 0.5) * count // max(test, 1))
    share = people.gamma(0.8 + 6 * occluders, size=count) * ~is_test   # some photos stay free
    share = np.minimum(share / share.sum() * photos * occluders, 0.85)
    taste = exposure * taste.uniform(-1, 1, (count, 4))
    rgb, depth, occluder = [], [], []
    for i in range(count):
        o = np.broadcast_to(c2w[i, :, 3], (w[i] * h[i], 3))
        linear = sum(np.clip(shade(o, rays(K[i], c2w[i], w[i], h[i], dx, dy), background), 0, 1)
                     for dx in (.25, .75) for dy in (.25, .75)) / 4
        cover = draw_people(people, w[i], h[i], share[i])
        linear = linear * (1 - cover[:, 3:]) + cover[:, :3]  # (h*w,3)
        gain = 2 ** (taste[i, 0] / 2) * (1 + .1 * taste[i, 1:3] @ [[1, 0, 0], [0, 0, 1]])
        srgb = np.clip(linear * gain, 0, 1) ** (1.2 ** taste[i, 3] / 2.2)
        rgb.append((srgb * 255 + 0.5).astype(np.uint8))
        depth.append(trace(o, rays(K[i], c2w[i], w[i], h[i]), background)[0])
        occluder.append(cover[:, 3] > 0)
    points, *tracks = toy_points(sfm, np.stack([w, h], 1), K, c2w, depth, occluder)
    points["xyz"] = points["xyz"] * TOY_SCALE + TOY_ORIGIN
    noise = shake.normal(0, pose_noise / 2, (count, 4)) / K[:, :1] * ~is_test[:, None]   # [rad]
    for pose, (*turn, dx, dy) in zip(c2w, noise):            # half by turning, half by moving
        pose[:, 3] += pose[:, :2] @ (dx, dy) * np.linalg.norm(pose[:, 3])
        pose[:, :3] = pose[:, :3] @ cv2.Rodrigues(np.array([*turn, 0]))[0]
        pose[:, 3] = pose[:, 3] * TOY_SCALE + TOY_ORIGIN
    extent = LANDMARK[:, [5, 7, 4]]                          # (P,3)
    extent = np.where(extent == INF, extent[:, :1], extent)
    corners = [LANDMARK[:, 1:4] + extent * c for c in itertools.product((-1, 1), repeat=3)]
    scene = dict(rgb=np.concatenate(rgb), wh=np.stack([w, h], 1), K=K, is_test=is_test,
                 name=[f"toy_{i:03d}.png" for i in range(count)], occluder=np.concatenate(occluder))
    scene = finish(scene, c2w, points, *tracks, np.concatenate(corners) * TOY_SCALE + TOY_ORIGIN,
                   dict(scene="toy", kind="toy", downscale=1, left_out=[], **knobs))
    depth = np.concatenate(depth) * TOY_SCALE / scene["scale"]
    return dict(scene, depth=depth.astype(np.float16))


# ---- from world to normalised units -------------------------------------------------------------

def foreground_sphere(points, track_photo, track_point, is_train):
    """What many photos look at; cameras may be inside. -> centre (3,), radius, usable points (K,)

    Weighted geometric median, and 1.1 x the distance that holds 95 % of the weight: a few wild
    points move neither. Then 9 of 10 training photos must have 30 % of their points inside."""
    xyz, views, error = points["xyz"], points["views"], points["error"]
    sound = np.isfinite(xyz).all(1) & np.isfinite(error)
    usable = sound & (views >= (3 if (sound & (views >= 3)).sum() >= 500 else 2))
    need(usable.sum() >= 20, f"{usable.sum()} usable 3D points: SfM needs more overlapping photos")
    usable &= error <= np.quantile(error[usable], 0.95)
    x, weight = xyz[usable], np.minimum(views[usable], 20)   # the landmark is what many look at
    centre = np.median(x, axis=0)
    for _ in range(20):                                      # Weiszfeld
        w = weight / np.maximum(np.linalg.norm(x - centre, axis=1), 1e-9)
        centre = w @ x / w.sum()
    distance = np.linalg.norm(xyz - centre, axis=1)          # (K,)
    order = np.argsort(distance[usable])
    rank = np.searchsorted(np.cumsum(weight[order]), 0.95 * weight.sum())
    radius = 1.1 * distance[usable][order[rank]]
    own = np.split(track_point, np.searchsorted(track_photo, np.arange(1, len(is_train))))
    own = [point[usable[point]] for point, train in zip(own, is_train) if train]
    reach = [np.quantile(distance[point], 0.3) for point in own if len(point)]
    return centre, max(radius, np.quantile(reach, 0.9)) if reach else radius, usable


def finish(scene, c2w, points, track_photo, track_point, pixels, contain, info):
    """Adds what depends on the sphere. c2w, points, contain: world; pixels (T,2): observed."""
    centre, radius, usable = foreground_sphere(points, track_photo, track_point, ~scene["is_test"])
    radius = max([radius, *1.02 * np.linalg.norm(np.reshape(contain, (-1, 3)) - centre, axis=1)])
    need(0 < radius < INF, "all 3D points coincide: run SfM again")
    ok = np.flatnonzero(usable[track_point])                 # 2 million are plenty
    ok = np.sort(np.random.default_rng(0).permutation(ok)[:2_000_000])
    photo, point = track_photo[ok], (np.cumsum(usable) - 1)[track_point[ok]]
    x, wh = (points["xyz"][usable] - centre) / radius, np.array(scene["wh"], np.int32)
    c2w = np.concatenate([c2w[:, :, :3], (c2w[:, :, 3:] - centre[:, None]) / radius], 2)
    near, miss = np.full(len(c2w), 0.05, np.float32), []
    for i in np.unique(photo):
        own = slice(*np.searchsorted(photo, (i, i + 1)))     # photo by photo
        uv, distance = project(scene["K"][i], c2w[i], x[point[own]])
        near[i] = max(0.8 * np.quantile(distance, 0.02), 0.02)
        miss.append(np.linalg.norm(uv - pixels[ok[own]], axis=1))
    need((~scene["is_test"])[photo].any(), "no training photo observes a usable 3D point: photos "
         "and points do not belong together")
    info["reprojection_px"] = float(np.median(np.concatenate(miss)))
    return statistics(dict(
        scene, wh=wh, start=np.append(0, np.cumsum(wh.prod(1, dtype=np.int64))), c2w=c2w,
                near=near, points=x.astype(np.float32), track_photo=photo.astype(np.int32),
                track_point=point.astype(np.int32), name=np.array(scene["name"]), center=centre,
                scale=np.float64(radius), info=np.array(json.dumps(info))))


def statistics(scene):
    """What geonvs.py decides by: adds footprint, exposure_spread and bg_color to a scene.

    footprint: lower quartile of a pixel's size at the SfM points inside the sphere, over the
    training photos, so that the closest photos decide without single outliers. exposure_spread:
    standard deviation over photos of how much brighter (0..1) each shows the same points. bg_color
    (3,): the colour of the rays that miss the sphere, NaN unless three in five agree.
    """
    K, c2w, photo = scene["K"], scene["c2w"], scene["track_photo"]
    keep = ~scene["is_test"][photo]
    photo, point = photo[keep], scene["track_point"][keep]
    size, bright = np.zeros(len(photo)), np.full(len(photo), np.nan)
    beyond, step = [], max(1, len(scene["rgb"]) // 500_000)
    for i in np.flatnonzero(~scene["is_test"]):
        rgb = scene["rgb"][scene["start"][i]:scene["start"][i + 1]]
        (w, h), mine = scene["wh"][i], photo == i
        uv, distance = project(K[i], c2w[i], scene["points"][point[mine]].astype(float))
        at = np.clip(uv.astype(int), 0, (w - 1, h - 1)) @ (1, w)
        size[mine], bright[mine] = distance / K[i, 0], rgb[at].mean(1) / 255
        o, d = c2w[i, :, 3], rays(K[i], c2w[i], w, h)[::step]
        closest = np.linalg.norm(o - (d @ o)[:, None] * d, axis=1)
        beyond.append(rgb[::step][(closest > 1) | (d @ o > 0) & (o @ o > 1)])
    inside = np.linalg.norm(scene["points"][point], axis=1) < 1
    seen = np.maximum(np.bincount(point, minlength=len(scene["points"])), 1)
    bright -= (np.bincount(point, bright, len(scene["points"])) / seen)[point]
    spread = np.std([np.median(bright[photo == i]) for i in np.unique(photo)])
    beyond = np.concatenate(beyond) / 255                    # people may stand before it
    color = np.median(beyond, 0) if len(beyond) > 100 else np.full(3, np.nan)
    flat = len(beyond) > 100 and (np.abs(beyond - color) < 0.02).all(1).mean() > 0.6
    size = size[inside] if inside.any() else np.linalg.norm(c2w[:, :, 3], axis=1) / K[:, 0]
    return dict(scene, footprint=np.quantile(size, 0.25), exposure_spread=spread,
                bg_color=color if flat else np.full(3, np.nan))


# ---- photos with a COLMAP reconstruction --------------------------------------------------------

MODELS = {0: "f", 1: "ff", 2: "fk", 3: "fkk", 4: "ffkkpp"}   # f, then cx cy, then distortion
UNDISTORT = "colmap image_undistorter --image_path images --input_path sparse --output_path dense"


def open_binary(path):
    """Bounded reader of a little-endian file. -> take(format), count(bytes of a record)"""
    need(path.is_file(), f"{path} is missing: copy the whole COLMAP model; one in text becomes "
         "binary by colmap model_converter --output_type BIN")
    data, at = path.read_bytes(), 0

    def take(form):
        nonlocal at
        at += struct.calcsize("<" + form)
        need(at <= len(data), f"{path} ends too early: copy or export it again")
        return struct.unpack_from("<" + form, data, at - struct.calcsize("<" + form))

    def count(record):   # what a file promises must fit into it, before anything is allocated
        n, = take("Q")
        need(n * record <= len(data) - at, f"{path} is too short for {n} records: copy it again")
        return n
    return take, count


def safe_name(name, where):
    """Photos may be in sub-folders of the image folder, but nowhere else."""
    need(name and name[0] != "/" and ".." not in name.split("/") and not {"\\", "\0"} & set(name),
         f"{where}: photo {name!r} is outside the image folder; rename it")
    return name


def read_colmap(sparse):
    """A COLMAP model, in world units. -> cameras {id: (w, h, K (4,), k1 k2 p1 p2 (4,))}, photos
    {name: (camera id, c2w (3,4), pixels (M,2), point ids (M,))} and points (K,) POINT"""
    sparse, cameras, photos, points = Path(sparse), {}, {}, []
    take, count = open_binary(sparse / "cameras.bin")
    for _ in range(count(48)):
        key, model, w, h = take("IiQQ")
        need(model in MODELS, f"{sparse}: camera model {model} is not supported; run: {UNDISTORT}")
        n, p = MODELS[model].count("f"), np.array(take(f"{len(MODELS[model]) + 2}d"))
        K, bend = p[[0, n - 1, n, n + 1]], np.append(p[n + 2:], np.zeros(4))[:4]
        need(np.isfinite(p).all() and (K[:2] > 0).all() and 0 < w < 1e5 and 0 < h < 1e5,
             f"{sparse}: camera {key} has size {w} x {h} and parameters {p}: export it again")
        cameras[key] = w, h, K, bend
    take, count = open_binary(sparse / "images.bin")
    for _ in range(count(73)):
        _, *pose, camera = take("I7dI")
        name = b"".join(iter(lambda: take("c")[0], b"\0")).decode(errors="replace")
        safe_name(name, sparse / "images.bin")
        need(np.isfinite(pose).all() and any(pose[:4]) and camera in cameras and name not in photos,
             f"{sparse}: photo {name} has no finite pose, no camera, or occurs twice; export again")
        w, *v = np.array(pose[:4]) / math.hypot(*pose[:4])   # old files are not normalised
        cross = np.cross(v, np.eye(3))                       # c2w = 1 - 2 w [v] + 2 [v] [v]
        R = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        seen = np.frombuffer(take(f"{24 * count(24)}s")[0], [("uv", "<f8", 2), ("id", "<u8")])
        seen = seen[seen["id"] != 2 ** 64 - 1]               # corners without a 3D point
        photos[name] = camera, np.column_stack([R, -R @ pose[4:]]), seen["uv"], seen["id"]
    take, count = open_binary(sparse / "points3D.bin")
    for _ in range(count(51)):
        key, x, y, z, *_, error = take("Q3d3Bd")
        points.append((key, (x, y, z), error, len(take(f"{8 * count(8)}s")[0]) // 8))
    return cameras, photos, np.array(points, POINT)


def read_split(path):
    """NeRF-W table, by column name: {photo: "train" or "test"}; rows with empty id are dropped."""
    need(Path(path).is_file(), f"the split file {path} is not there")
    lines = Path(path).read_bytes().decode("utf-8-sig", "replace").splitlines()
    head, *rows = [line.split("\t") for line in lines if line] or [[]]
    need({"filename", "split"} <= set(head), f"{path} needs a header with filename, tab, and split")
    split = {}
    for row in (dict(zip(head, row)) for row in rows):
        if row.get("id") != "":
            name, part = safe_name(row.get("filename"), path), row.get("split")
            need(part in ("train", "test") and split.get(name, part) == part,
                 f"{path}: {name} is {part!r}; each photo is train or test, and not both")
            split[name] = part
    return split


def read_photo(path, camera, uv, downscale):
    """Undistorted, reduced; the pixels uv (M,2) follow. -> rgb uint8 (h,w,3), K (4,), uv (M,2)"""
    w, h, K, bend = camera
    try:   # COLMAP works on stored pixels: an EXIF rotation must not be applied
        image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    need(image is not None, f"cannot read {path}: replace it, or delete it and go without")
    need(image.shape[:2] == (h, w), f"{path} is {image.shape[1]} x {image.shape[0]}, its camera "
         f"{w} x {h}; use the photos that belong to this reconstruction")
    if bend.any():                                           # OpenCV's first pixel is at 0
        M = np.array([[K[0], 0, K[2] - 0.5], [0, K[1], K[3] - 0.5], [0, 0, 1]])
        P = cv2.getOptimalNewCameraMatrix(M, bend, (w, h), 0)[0]   # shows nothing but photo
        P = P if P[0, 0] > M[0, 0] or P[1, 1] > M[1, 1] else M
        image = cv2.undistort(image, M, bend, None, P)
        if len(uv):
            uv = cv2.undistortPoints(uv[:, None] - 0.5, M, bend, P=P)[:, 0] + 0.5
        K = np.array([P[0, 0], P[1, 1], P[0, 2] + 0.5, P[1, 2] + 0.5])
    small = w // downscale, h // downscale
    need(min(small) >= 2, f"--downscale {downscale} leaves nothing of {path.name}: use a smaller")
    image = cv2.cvtColor(cv2.resize(image, small, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGB)
    ratio = np.array(small) / (w, h)
    return image, K * np.tile(ratio, 2), uv * ratio


def prepare(folder, downscale=2, split=None):
    """Scene of <folder>/dense/{images,sparse} or <folder>/{images,sparse}; see the top."""
    folder, left_out = Path(folder), []

    def report(names, why):
        if names:
            left_out.append(f"{len(names)} photos {why}: {', '.join(sorted(names)[:3])}, ...")
            print(left_out[-1], file=sys.stderr)
    roots = folder / "dense", folder / "dense" / "0", folder   # COLMAP numbers them, or not
    root = next((r for r in roots if (r / "images").is_dir() and (r / "sparse").is_dir()), folder)
    sparse = root / "sparse" / "0" if (root / "sparse" / "0").is_dir() else root / "sparse"
    fix = f"{folder.name} --download" if folder.name in SCENES else f"{folder} --sfm"
    need((root / "images").is_dir() and sparse.is_dir(),
         f"{folder} has no folders images and sparse; run: python data_prep.py {fix}")
    need(downscale >= 1, f"--downscale is a whole number from 1, not {downscale}")
    cameras, photos, points = read_colmap(sparse)
    tables = [Path(split)] if split else sorted(folder.glob("[!.]*.tsv"))
    need(len(tables) < 2, f"{folder} has {len(tables)} split files: keep one, or name one by "
         "data_prep.py --split")
    here = sorted(name for name in photos if (root / "images" / name).is_file())
    report(set(photos) - set(here), "of the model are not on disk")
    if tables:
        parts = read_split(tables[0])
        report(set(parts) - set(here), "of the split file have no pose or no file")
        report(set(here) - set(parts), "are not in the split file")
    else:
        parts = {name: "test" if i % 8 == 7 else "train" for i, name in enumerate(here)}
        print("no split file: every eighth photo is held out", file=sys.stderr)
    here = [name for name in here if name in parts]
    wide = {n: max(w / K[0], h / K[1]) / 2 for n in here for w, h, K, _ in [cameras[photos[n][0]]]}
    names = [n for n in here if np.tan(np.radians(5)) <= wide[n] <= np.tan(np.radians(60))]
    report(set(here) - set(names), "are narrower than 10 or wider than 120 degrees")
    is_test = np.array([parts[name] == "test" for name in names], bool)
    need((~is_test).sum() >= 2, f"{folder} has {(~is_test).sum()} usable training photos, not 2 or "
         "more: check the split file and the image folder")
    if not is_test.any():
        print("no test photos: scores will be null", file=sys.stderr)
    index, rows = dict(zip(points["id"].tolist(), range(len(points)))), []
    for i, name in enumerate(names):
        camera, c2w, uv, seen = photos[name]
        image, K, uv = read_photo(root / "images" / name, cameras[camera], uv, downscale)
        point = np.array([index.get(key, -1) for key in seen.tolist()], int)
        ok = point >= 0
        rows.append((image.reshape(-1, 3), K, c2w, image.shape[1::-1], np.full(ok.sum(), i),
                     point[ok], uv[ok]))
    rgb, K, c2w, wh, *tracks = zip(*rows)
    return finish(dict(rgb=np.concatenate(rgb), wh=wh, K=np.array(K), is_test=is_test, name=names),
                  np.array(c2w), points, *map(np.concatenate, tracks), [],
                  dict(scene=folder.resolve().name, kind="colmap", downscale=downscale,
                       left_out=left_out, split=split and str(Path(split).resolve())))


# ---- download, SfM, command line ----------------------------------------------------------------

def fetch(url, path):
    """Streams url into path; what came of a broken transfer waits in path.part to be continued."""
    part = path.with_name(path.name + ".part")
    have = part.stat().st_size if part.exists() else 0
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
        with urllib.request.urlopen(request, timeout=60) as answer:
            have *= answer.status == 206                     # a server without ranges starts over
            total = have + int(answer.headers.get("Content-Length", 0))
            with open(part, "ab" if have else "wb") as file:
                while block := answer.read(1 << 20):
                    have += file.write(block)
                    print(f"\r{path.name}: {have / 1e6:.1f} MB, {have / max(total, have):.0%}",
                          end="", file=sys.stderr, flush=True)
        print(file=sys.stderr)
        if have < total:
            raise OSError(f"{have} of {total} bytes came")
        os.replace(part, path)
    except (OSError, http.client.HTTPException) as e:
        if getattr(e, "code", 0) == 416:                     # the part is whole, or of another file
            if e.headers.get("Content-Range") == f"bytes */{have}":
                return os.replace(part, path)
            part.unlink()
        raise UserError(f"the download of {url} broke ({e}); the same command continues it") from e


def download(name, data_root="data", archive_url=ARCHIVE_URL, split_url=SPLIT_URL):
    """Photos and reconstruction of one of SCENES, with its split file -> <data_root>/<name>/"""
    need(name in SCENES, f"--download knows {', '.join(SCENES)}, not {name}")
    (scene, table), root = SCENES[name], Path(data_root)
    archive, temporary = root / f"{scene}.tar.gz", root / f".{name}.{os.getpid()}"
    if (root / name / "dense").is_dir():
        return
    need(not (root / name).exists(),
         f"{root / name} is in the way of the archive: move it, or leave --download out")
    need(hasattr(tarfile, "data_filter"), "unpacking needs Python 3.10.12, 3.11.4 or newer")
    for url, path in (split_url + table, root / table), (archive_url + archive.name, archive):
        if not path.exists():
            fetch(url, path)
    try:
        with gzip.open(archive) as raw, tarfile.open(fileobj=raw, mode="r|") as tar:
            wanted = f"{scene}/dense/images/", f"{scene}/dense/sparse/"
            for member in tar:                               # files only: a link could lead outside
                if member.isfile() and member.name.startswith(wanted):
                    tar.extract(member, temporary, filter="data")
            while raw.read(1 << 20):                         # to the checksum at the very end
                pass
        shutil.copy(root / table, temporary / scene)
        os.replace(temporary / scene, root / name)
    except (tarfile.TarError, EOFError, zlib.error, OSError) as e:
        raise UserError(f"cannot unpack {archive} ({e}): free space, or delete it and retry") from e
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def run_sfm(folder):
    """Poses for the raw photos in `folder`, by pycolmap -> folder/dense/{images,sparse}"""
    try:
        import pycolmap
    except ImportError as e:
        raise UserError("--sfm needs pycolmap; run: pip install pycolmap") from e
    need(folder.is_dir() and not (folder / "dense").exists(),
         f"{folder} must be a folder of photos without a folder dense from an earlier run")
    database, models = folder / "database.db", folder / "models"
    models.mkdir(exist_ok=True)
    pycolmap.extract_features(database, folder)
    pycolmap.match_exhaustive(database)
    found = pycolmap.incremental_mapping(database, folder, models)
    need(found, f"the photos in {folder} do not match each other; take more, with more overlap")
    best = max(found, key=lambda i: found[i].num_reg_images())
    pycolmap.undistort_images(folder / "dense", models / str(best), folder)


def locate_and_prepare(name, data_root="data", downscale=2, split=None):
    """Scene of one of SCENES from its unpacked archive, under its short or its long name."""
    short, long = (Path(data_root) / folder for folder in (name, SCENES[name][0]))
    is_short = (short / "dense").is_dir() or not long.is_dir()
    return prepare(short if is_short else long, downscale, split)


def main(argv=None):
    p = argparse.ArgumentParser(description=__doc__, allow_abbrev=False,
                                formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scene", help=f"toy, {', '.join(SCENES)}, or a folder")
    p.add_argument("--download", action="store_true", help="fetch archive and split file first")
    p.add_argument("--sfm", action="store_true", help="the folder has raw photos: pose them first")
    p.add_argument("--downscale", type=int, help="photos get this many times smaller; default 2")
    p.add_argument("--split", help="table of training and test photos; default: <folder>/*.tsv")
    p.add_argument("--out", help="default: data/<scene>.npz")
    knobs = {key: knob.default for key, knob in inspect.signature(make_toy).parameters.items()}
    for key, value in knobs.items():
        how = {"action": argparse.BooleanOptionalAction} if value is True else {"type": type(value)}
        p.add_argument(f"--{key}", default=None, help=f"toy, default {value}", **how)
    a = p.parse_args(argv)
    out = Path(a.out) if a.out else scene_path(a.scene, a.scene not in ("toy", *SCENES))
    set_knobs = {key: value for key in knobs if (value := getattr(a, key)) is not None}
    try:
        need(a.scene == "toy" or not set_knobs, f"--{', --'.join(set_knobs)}: for the toy only")
        need(a.scene != "toy" or a.downscale is a.split is None,
             "--downscale and --split are for photos: the toy takes --size and --test")
        need(out.suffix == ".npz", f"--out {out}: name a file that ends in .npz")
        downscale = 2 if a.downscale is None else a.downscale
        if a.download:
            download(a.scene)
        if a.sfm:
            run_sfm(Path(a.scene))
        if a.scene == "toy":
            scene = make_toy(**set_knobs)
        elif a.scene in SCENES:
            scene = locate_and_prepare(a.scene, downscale=downscale, split=a.split)
        else:
            scene = prepare(a.scene, downscale, a.split)
        write_scene(out, scene)
    except (UserError, OSError, MemoryError, KeyboardInterrupt) as e:
        print(f"error: {e}" if str(e) else "error: stopped; start again", file=sys.stderr)
        sys.exit(2)
    print(f"{out}: {len(scene['wh'])} photos, {scene['is_test'].sum()} of them for testing, "
          f"{len(scene['rgb']) / 1e6:.2f} million pixels, {len(scene['points'])} points\n"
          f"unit sphere: {np.round(scene['center'], 3)}, radius {scene['scale']:.3f} world units\n"
          f"reprojection error: {json.loads(str(scene['info']))['reprojection_px']:.2f} px, median "
          f"of {len(scene['track_photo'])} observations")


if __name__ == "__main__":
    main()
