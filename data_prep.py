"""Scene files for geonvs.py: a synthetic landmark, or photos with a COLMAP reconstruction.

    python data_prep.py toy --occluders 0.4     -> data/toy.npz; every knob of make_toy is a flag
    python data_prep.py brandenburg --download  -> data/brandenburg.npz, from an archive of 5 GB
    python data_prep.py my_photos --sfm         raw photos, posed by pycolmap -> data/my_photos.npz
    python data_prep.py my_scene                my_scene/dense/{images,sparse} -> data/my_scene.npz

A scene is one .npz. I photos, N pixels, K points, T observations; R rays, P parts or points:

    rgb          uint8 (N,3)      all photos one after the other, each row by row
    start        int64 (I+1,)     photo i owns the pixels start[i]:start[i+1]
    wh           int32 (I,2)      width, height [px]
    K            float64 (I,4)    fx fy cx cy [px]; the centre of the first pixel is (0.5, 0.5)
    c2w          float64 (I,3,4)  camera to world, normalised; OpenCV axes x right, y down, z forward
    near         float32 (I,)     0.8 x the 2 % quantile of the distances to the photo's own points
    is_test      bool (I,)        held out from training
    name         str (I,)         file names
    points       float32 (K,3)    SfM points, normalised
    track_photo, track_point      int32 (T,): photo track_photo[j] observes point track_point[j]
    center, scale                 float64 (3,), (): x_world = x * scale + center
    info         JSON text        scene, kind (toy or colmap), downscale, reprojection_px, left_out
    depth        float16 (N,)     toy: true distance, normalised; inf is sky
    occluder     bool (N,)        toy: pixels that a passer-by covers

The landmark lies in the unit sphere. A ray is c2w[:, 3] + t * d with |d| = 1; a distance is this t,
never a z-depth. Functions raise UserError, one sentence that says what to do.
"""
import argparse, gzip, http.client, inspect, itertools, json, os, shutil, struct, sys, tarfile, time, zlib
import urllib.error, urllib.request
from pathlib import Path

import cv2
import numpy as np

SCENES = {"brandenburg": ("brandenburg_gate", "brandenburg.tsv"),   # name: (archive, split file)
          "sacre": ("sacre_coeur", "sacre.tsv"),
          "trevi": ("trevi_fountain", "trevi.tsv"),
          "taj": ("taj_mahal", "taj_mahal.tsv")}
ARCHIVE_URL = "https://www.cs.ubc.ca/research/kmyi_data/imw2020/TrainingData/"
SPLIT_URL = "https://nerf-w.github.io/data/selected_images/"


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
        raise UserError(f"cannot write {path} ({e.strerror or e}); free space or go elsewhere") from e
    finally:
        if part.exists():
            part.unlink()


def write_scene(path, scene):
    """Uncompressed: photos hardly shrink, and inflating takes longer than reading."""
    atomic_write(path, lambda part: np.savez(part, **scene))


# ---- the toy: z up, front towards -y, in its own units; world = TOY_SCALE * x + TOY_ORIGIN -------

TOY_SCALE, TOY_ORIGIN = 3.7, np.array([12.0, -7.0, 5.0])
SUN = np.array([-.50, -.62, .60]) / np.linalg.norm([-.50, -.62, .60])   # left, behind the tourists
STONE, PALE, SAND, BRICK, ROOF, SLATE, COPPER, GOLD, HOUSE, LEAF, PAVING, MEADOW = range(12)
LOOKS = np.array([   # colour, width and height of a cell, contrast between cells, has windows
    (.50, .46, .40, .29, .13, .20, 0), (.80, .74, .60, .29, .13, .08, 0),
    (.78, .56, .30, .30, .30, .15, 1), (.52, .19, .11, .30, .30, .15, 1),
    (.60, .22, .12, .16, .08, .30, 0), (.12, .19, .31, .20, .10, .25, 0),
    (.16, .46, .36, .50, .50, .40, 0), (.90, .58, .08, .50, .50, .00, 0),
    (.60, .46, .34, .62, .62, .15, 1), (.10, .22, .05, .20, .20, .45, 0),
    (.48, .42, .34, .42, .42, .20, 0), (.17, .22, .08, .60, .60, .10, 0)])
# A part is |z| <= half, around its centre, and its first `round` coordinates lie in a ball whose
# radius runs from bottom to top: 1 a box or a roof (with |y| <= depth), 2 a column or a cone, 3 a ball.
LANDMARK = np.array([   # round, centre x y z, half, bottom, top, depth, look
    (1, -.01, -.03, .050, .050, .96, .96, .53, STONE), (1, -.05, -.01, .15, .05, .85, .85, .47, STONE),
    (1, .03, .20, .530, .330, .590, .590, .26, SAND),                        # steps; hall, columns
    *[(2, x, -.34, .47, .27, .062, .050, np.inf, PALE) for x in np.linspace(-.54, .60, 6)],
    (1, .03, .03, .800, .060, .670, .670, .46, PALE), (1, .03, .03, .98, .12, .71, 0, .48, ROOF),
    (2, -.05, .22, 1.07, .17, .33, .31, np.inf, SAND),                       # roof; drum, dome
    (3, -.05, .22, 1.24, .30, .30, .30, np.inf, COPPER),
    (2, -.05, .22, 1.57, .07, .075, .065, np.inf, PALE),                     # lantern and finial
    (2, -.05, .22, 1.70, .06, .10, .02, np.inf, COPPER),
    (3, -.05, .22, 1.78, .045, .045, .045, np.inf, GOLD),
    (1, .87, .18, .530, .530, .170, .170, .17, BRICK), (1, .87, .18, 1.10, .04, .20, .20, .20, PALE),
    (2, .87, .18, 1.32, .18, .20, .00, np.inf, SLATE),                       # tower; annex
    (1, -.76, .24, .38, .18, .19, .19, .25, BRICK), (1, -.76, .24, .65, .09, .23, 0, .28, SLATE),
    (1, -.80, -.35, .28, .08, .09, .09, .09, PALE),                          # statue
    (2, -.80, -.35, .48, .12, .07, .04, np.inf, COPPER),
    (3, -.80, -.35, .64, .055, .055, .055, np.inf, COPPER)])
SURROUNDINGS = np.array([row for x, y, w, h in [   # houses, and a tree before each
    (-7.5, 2.0, .6, 1.5), (-6.2, 4.4, .5, 1.1), (-4.0, 6.4, .8, 1.8), (-1.2, 7.6, .5, 2.3),
    (2.0, 6.8, .7, 1.4), (4.6, 5.6, .5, 1.9), (6.8, 3.0, .6, 1.3), (7.4, 0.0, .5, 1.7)] for row in [
        (1, x, y, h / 2, h / 2, w, w, w, HOUSE), (1, x, y, h + .25, .25, w, 0, w, SLATE),
        (3, .8 * x + 1, .7 * y, .2 + .8 * w, .8 * w, .8 * w, .8 * w, np.inf, LEAF)]])


def toy_parts(ground):
    return np.concatenate([LANDMARK, SURROUNDINGS]) if ground else LANDMARK   # (P,9)


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

    ground=False leaves the landmark alone, as make_toy(background=False) does."""
    x = (np.asarray(x_world, np.float64) - TOY_ORIGIN) / TOY_SCALE
    d = x[:, 2] if ground else np.full(len(x), np.inf)
    for part in toy_parts(ground):
        d = np.minimum(d, part_sdf(part, x))
    return d * TOY_SCALE


@np.errstate(divide="ignore", invalid="ignore")
def trace(o, d, ground):
    """First hits of rays, in closed form: distance (R,), inf is sky, and part (R,), -1 is the ground.

    A part is where a quadric and up to two slabs overlap; its hit is where the last one begins."""
    t = np.where(ground & (d[:, 2] < -1e-3), -o[:, 2] / d[:, 2], np.inf)   # (R,)
    which, parts = np.full(len(d), -1), toy_parts(ground)
    centre = parts[:, 1:4]                                   # bounding spheres first
    along = centre @ d.T - (o * d).sum(1)                    # (P,R)
    aside = (centre ** 2).sum(1)[:, None] - 2 * centre @ o.T + (o * o).sum(1) - along ** 2
    for i, (n, *_, half, bottom, top, depth, _) in enumerate(parts):
        n, corner = int(n), [max(bottom, top), half if n < 3 else 0, depth if n == 1 else 0]
        radius = np.linalg.norm(corner)
        rows = np.flatnonzero((aside[i] < radius ** 2) & (np.abs(along[i]) < radius + t))
        p, v = o[rows] - centre[i], d[rows]
        w, rise = (bottom + top + (top - bottom) / half * p[:, 2]) / 2, (top - bottom) / half / 2 * v[:, 2]
        a = (v[:, :n] ** 2).sum(1) - rise ** 2
        b = (v[:, :n] * p[:, :n]).sum(1) - rise * w
        root = np.sqrt(b * b - a * ((p[:, :n] ** 2).sum(1) - w * w))       # nan for a miss
        enter = np.where((a < 0) & (rise < 0), -np.inf, (-b - root) / a)   # a < 0: a cone, open
        leave = np.where((a < 0) & (rise > 0), np.inf, (-b + root) / a)    # at one end
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
    hit = np.flatnonzero(t < np.inf)
    x, floor = o[hit] + t[hit, None] * d[hit], which[hit] < 0
    part = toy_parts(background)[which[hit]]                 # (R,9), any part for the floor
    normal = np.stack([part_sdf(part, x + e) - part_sdf(part, x - e) for e in 1e-5 * np.eye(3)], 1)
    normal = np.where(floor[:, None], (0, 0, 1), normal / 2e-5)
    turn = np.arctan2(x[:, 1] - part[:, 2], x[:, 0] - part[:, 1])   # around an axis, else along x + y
    across = np.where(floor, x[:, 0], np.where(part[:, 0] == 1, x[:, 0] + x[:, 1], turn))
    square = np.where(np.hypot(x[:, 0], x[:, 1]) < 2.6, PAVING, MEADOW)
    look = LOOKS[np.where(floor, square, part[:, 8]).astype(int)]
    row = np.where(floor, x[:, 1], x[:, 2]) / look[:, 4]     # solid texture: cells, every other
    column = across / look[:, 3] + (np.floor(row) % 2 / 2) * (1 - look[:, 6])   # row shifted by half
    chance = np.abs(np.sin(12.9898 * np.floor(column) + 78.233 * np.floor(row))) * 437.585 % 1
    dark = look[:, 6] * (np.abs(column % 1 - .5) < .2) * (np.abs(row % 1 - .45) < .28)   # windows
    paint = look[:, :3] * ((1 + look[:, 5] * (2 * chance - 1)) * (1 - .8 * dark))[:, None]
    sun = np.clip(normal @ SUN, 0, None)[:, None]
    sun[trace(x + 1e-4 * normal, np.broadcast_to(SUN, x.shape), background)[0] < np.inf] = 0
    light = sun * (1.15, 1.05, .88) + (0.20 + 0.10 * normal[:, 2:]) * (.8, .92, 1.15)
    haze = np.exp(-np.maximum(t[hit, None] - 5, 0) / 20)
    colour[hit] = haze * paint * light + (1 - haze) * (.42, .50, .58)
    return colour


def rays(K, c2w, w, h, dx=0.5, dy=0.5):
    """Unit directions of a photo's pixels in world axes, row by row. -> (h*w,3)"""
    v, u = np.mgrid[:h, :w]
    d = np.stack([(u.ravel() + dx - K[2]) / K[0], (v.ravel() + dy - K[3]) / K[1], np.ones(w * h)], 1)
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
    z = -np.array([np.sin(azimuth), -np.cos(azimuth), rng.uniform(-.15, .45)])
    eye = target - z * f / min(w, h) * rng.uniform(2.0, 2.6) * (0.8 if rng.random() < 0.1 else 1)
    eye[2] = max(eye[2], 0.2)
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, (*rng.normal(0, .03, 2), 1))             # hardly anyone holds it level
    x /= np.linalg.norm(x)
    return w, h, np.array([f, f, w / 2, h / 2]), np.stack([x, np.cross(z, x), z, eye], 1)


def draw_people(rng, w, h, share):
    """Passers-by on about `share` of the photo. -> (h*w,4): colour times opacity, opacity"""
    canvas = np.zeros((4 * h, 4 * w, 4), np.float32)         # drawn large, then averaged
    while (left := share - canvas[..., 3].mean()) > max(0.2 * share, 0.002):
        tall = 4 * np.clip(np.sqrt(left * w * h / .25) * rng.uniform(.5, 1), .12 * h, .95 * h)
        x, y = rng.uniform(0, 4 * w), rng.uniform(3.2 * h, 4 * h + .2 * tall)   # of the feet
        coat, legs, thing, skin = rng.uniform(.03, .8, (4, 3))
        stripe = thing if rng.random() < .4 else coat
        things = [], [(.15, .55, .15, .72, .18)], [(.2, 1, .2, 1, .3)], [(-.2, 1.06, .2, 1.06, .1),
                                                                        (-.1, 1.12, .1, 1.12, .1)]
        for colour, x0, y0, x1, y1, wide in [                # bag, balloon or umbrella come last
                (legs, -.06, .03, -.06, .45, .1), (legs, .06, .03, .06, .45, .1),
                *[((coat, stripe)[i % 2], -.05, .5 + .06 * i, .05, .5 + .06 * i, .16) for i in range(5)],
                ((.3 + skin[0]) * np.array([.8, .6, .45]), 0, .92, 0, .92, .15),
                *[(thing, *line) for line in things[rng.integers(4)]]]:
            ends = (np.array([[x0, -y0], [x1, -y1]]) * tall + (x, y)).astype(int).tolist()
            cv2.line(canvas, *ends, (*colour.tolist(), 1), int(wide * tall) + 1)
    return cv2.resize(canvas, (w, h), interpolation=cv2.INTER_AREA).reshape(-1, 4).astype(float)


def toy_points(rng, wh, K, c2w, depth, occluder, count=3000):
    """What SfM would find: noisy points of visible surfaces, 1.5 % of them quite wrong.

    -> points (K,3) in the toy's units; for each observation photo (T,), point (T,), pixel (T,2)"""
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
    wild = (rng.random((len(x), 1)) < .015) * rng.uniform(-1, 1, x.shape)
    return x + rng.normal(0, .005, x.shape) + wild, *map(np.concatenate, zip(*seen))


def make_toy(seed=0, size=96, photos=48, test=8, occluders=0.05, exposure=1.0, pose_noise=0.0,
             background=True):
    """Scene of a small procedural landmark, the same landmark for every seed.

    size: long side [px]. occluders: mean share of a training photo that people cover, 0..0.6.
    exposure: spread of brightness, white balance and contrast, 0 none, 1 tourists, 2 extreme.
    pose_noise: error of the training poses [px rms at the landmark]. background=False: nothing
    but the landmark, before black."""
    knobs = dict(locals())
    need(0 <= occluders <= 0.6 and 0 <= exposure <= 2 and pose_noise >= 0 and size >= 16 and photos >= 4
         and test >= 0 and seed >= 0, "the toy needs occluders in 0..0.6, exposure in 0..2, size >= 16, "
         "photos >= 4, and no negative seed, test or pose_noise")
    camera, taste, people, sfm, shake = (np.random.default_rng([seed, k]) for k in range(5))
    count = photos + test                                    # a stream each: no knob moves another
    angles = 200 * (np.arange(count) + camera.uniform(.1, .9, count)) / count - 100
    w, h, K, c2w = map(np.array, zip(*[toy_camera(camera, a, size) for a in np.radians(angles)]))
    wh = np.stack([w, h], 1)
    is_test = np.isin(np.arange(count), (np.arange(test) + 0.5) * count // max(test, 1))
    share = people.gamma(0.8 + 6 * occluders, size=count) * ~is_test   # some photos stay free
    share = np.minimum(share / share.sum() * photos * occluders, 0.9)
    taste = exposure * taste.uniform(-1, 1, (count, 4))
    rgb, depth, occluder = [], [], []
    for i in range(count):
        o = np.broadcast_to(c2w[i, :, 3], (w[i] * h[i], 3))
        linear = sum(np.clip(shade(o, rays(K[i], c2w[i], w[i], h[i], dx, dy), background), 0, 1)
                     for dx in (.25, .75) for dy in (.25, .75)) / 4
        cover = draw_people(people, w[i], h[i], share[i])
        linear = linear * (1 - cover[:, 3:]) + cover[:, :3]  # (h*w,3)
        gain = 2 ** (taste[i, 0] / 2) * np.array([1 + .1 * taste[i, 1], 1, 1 + .1 * taste[i, 2]])
        srgb = np.clip(linear * gain, 0, 1) ** (1.2 ** taste[i, 3] / 2.2)
        rgb.append((srgb * 255 + 0.5).astype(np.uint8))
        depth.append(trace(o, rays(K[i], c2w[i], w[i], h[i]), background)[0])
        occluder.append(cover[:, 3] > 0)
    xyz, track_photo, track_point, pixels = toy_points(sfm, wh, K, c2w, depth, occluder)
    given, noise = c2w.copy(), shake.normal(0, pose_noise / 2, (count, 4)) * ~is_test[:, None]
    for i, (turn, move) in enumerate(zip(noise[:, :2] / K[:, :1], noise[:, 2:] / K[:, :1])):
        given[i, :, :3] = c2w[i, :, :3] @ cv2.Rodrigues(np.array([*turn, 0]))[0]
        given[i, :, 3] += np.linalg.norm(c2w[i, :, 3]) * c2w[i, :, :2] @ move
    given[:, :, 3] = given[:, :, 3] * TOY_SCALE + TOY_ORIGIN
    extent = np.where(LANDMARK[:, :1] == 1, LANDMARK[:, [5, 7, 4]], LANDMARK[:, [5, 5, 4]])   # (P,3)
    corners = np.concatenate([LANDMARK[:, 1:4] + extent * c for c in itertools.product((-1, 1), repeat=3)])
    scene = dict(rgb=np.concatenate(rgb), wh=wh, K=K, is_test=is_test,
                 name=[f"toy_{i:03d}.png" for i in range(count)])
    scene = finish(scene, given, xyz * TOY_SCALE + TOY_ORIGIN, np.bincount(track_point, minlength=len(xyz)),
                   np.zeros(len(xyz)), track_photo, track_point, pixels,
                   dict(scene="toy", kind="toy", downscale=1, left_out=[], **knobs), corners * TOY_SCALE + TOY_ORIGIN)
    depth = np.concatenate(depth) * TOY_SCALE / scene["scale"]
    return dict(scene, depth=depth.astype(np.float16), occluder=np.concatenate(occluder))


# ---- from world to normalised units -------------------------------------------------------------

def foreground_sphere(xyz, views, error, track_photo, track_point, is_train):
    """What many photos look at; cameras may be inside. -> centre (3,), radius, usable points (K,)

    Weighted geometric median, and 1.1 x the distance that holds 95 % of the weight: a few wild points
    move neither. Then nine of ten training photos must have 30 % of their points inside."""
    sound = np.isfinite(xyz).all(1) & np.isfinite(error)
    usable = sound & (views >= (3 if (sound & (views >= 3)).sum() >= 500 else 2))
    need(usable.sum() >= 20, f"only {usable.sum()} usable 3D points: SfM needs more overlapping photos")
    usable &= error <= np.quantile(error[usable], 0.95)
    x, weight = xyz[usable], np.minimum(views[usable], 20)   # the landmark is what many look at
    centre = np.median(x, axis=0)
    for _ in range(20):                                      # Weiszfeld
        w = weight / np.maximum(np.linalg.norm(x - centre, axis=1), 1e-9)
        centre = w @ x / w.sum()
    distance = np.linalg.norm(x - centre, axis=1)
    order = np.argsort(distance)
    rank = np.searchsorted(np.cumsum(weight[order]), 0.95 * weight.sum())
    radius = 1.1 * distance[order[rank]]
    own = [track_point[(track_photo == i) & usable[track_point]] for i in np.flatnonzero(is_train)]
    reach = [np.quantile(np.linalg.norm(xyz[k] - centre, axis=1), 0.3) for k in own if len(k)]
    radius = max(radius, np.quantile(reach, 0.9)) if reach else radius
    need(0 < radius < np.inf, "all 3D points coincide or lie at infinity: run SfM again")
    return centre, radius, usable


def finish(scene, c2w, xyz, views, error, track_photo, track_point, pixels, info, contain=None):
    """Adds what depends on the sphere. c2w, xyz, contain: world; pixels (T,2): of the observations."""
    centre, radius, usable = foreground_sphere(xyz, views, error, track_photo, track_point, ~scene["is_test"])
    if contain is not None:
        radius = max(radius, 1.02 * np.linalg.norm(contain - centre, axis=1).max())
    ok = np.flatnonzero(usable[track_point])
    if len(ok) > 2_000_000:                                  # plenty for masks and octree
        ok = np.sort(np.random.default_rng(0).choice(ok, 2_000_000, replace=False))
    track_photo, track_point, pixels = track_photo[ok], (np.cumsum(usable) - 1)[track_point[ok]], pixels[ok]
    points, wh = (xyz[usable] - centre) / radius, scene["wh"].astype(np.int32)
    c2w = np.concatenate([c2w[:, :, :3], (c2w[:, :, 3:] - centre[:, None]) / radius], 2)
    near, miss = np.full(len(c2w), 0.05, np.float32), []
    for i in np.unique(track_photo):
        own = track_photo == i
        at, distance = project(scene["K"][i], c2w[i], points[track_point[own]])
        near[i] = max(0.8 * np.quantile(distance, 0.02), 0.02)
        miss.append(np.linalg.norm(at - pixels[own], axis=1))
    need(miss, "no photo observes a usable 3D point: photos and points are of different reconstructions")
    info["reprojection_px"] = float(np.median(np.concatenate(miss)))
    return dict(scene, wh=wh, start=np.append(0, np.cumsum(wh.prod(1, dtype=np.int64))), c2w=c2w, near=near,
                name=np.array(scene["name"]), points=points.astype(np.float32),
                track_photo=track_photo.astype(np.int32), track_point=track_point.astype(np.int32),
                center=centre, scale=np.float64(radius), info=np.array(json.dumps(info)))


# ---- photos with a COLMAP reconstruction --------------------------------------------------------

UNDISTORT = "colmap image_undistorter --image_path images --input_path sparse --output_path dense"
MODELS = {0: "f", 1: "ff", 2: "fk", 3: "fkk", 4: "ffkkpp"}   # parameters beside cx, cy, which follow f


def open_binary(path):
    """Bounded reader of a little-endian file. -> take(format), count(record size), skip(bytes)"""
    need(path.is_file(), f"{path} is missing: copy the whole COLMAP model")
    data, at = path.read_bytes(), 0

    def skip(size):
        nonlocal at
        need(0 <= size <= len(data) - at, f"{path} is damaged at byte {at}: copy or export it again")
        at += size
        return data[at - size:at]

    def take(form):
        return struct.unpack("<" + form, skip(struct.calcsize("<" + form)))

    def count(record):   # promised records must fit into the file, before anything is allocated
        n, = take("Q")
        need(n * record <= len(data) - at, f"{path} is damaged: {n} records do not fit; copy it again")
        return n
    return take, count, skip


def safe_name(name, where):
    """Photos may be in sub-folders of the image folder, but nowhere else."""
    need(name and not name.startswith("/") and ".." not in name.split("/") and "\\" not in name
         and "\0" not in name, f"{where}: photo {name!r} is outside the image folder; rename it")
    return name


def read_colmap(sparse):
    """A COLMAP model, world units. -> cameras {id: (w, h, K (4,), k1 k2 p1 p2 (4,))},
    photos {name: (camera id, c2w (3,4), pixels (M,2), point ids (M,))}, and of the points
    ids (K,) uint64, xyz (K,3), reprojection error (K,) [px], views (K,)"""
    sparse, cameras, photos = Path(sparse), {}, {}
    take, count, skip = open_binary(sparse / "cameras.bin")
    for _ in range(count(48)):
        key, model, w, h = take("IiQQ")
        need(model in MODELS, f"{sparse}: camera model {model} is not supported; run: {UNDISTORT}")
        n = MODELS[model].count("f")
        p = np.array(take(f"{len(MODELS[model]) + 2}d"))
        K, bend = p[[0, n - 1, n, n + 1]], np.append(p[n + 2:], np.zeros(4))[:4]
        need(np.isfinite(p).all() and (K[:2] > 0).all() and 0 < w < 1e5 and 0 < h < 1e5,
             f"{sparse}: camera {key} has size {w} x {h} and parameters {p}: export the model again")
        cameras[key] = w, h, K, bend
    take, count, skip = open_binary(sparse / "images.bin")
    for _ in range(count(73)):
        _, *pose, camera = take("I7dI")
        name = b""
        while (letter := skip(1)) != b"\0":
            name += letter
        name = safe_name(name.decode(errors="replace"), sparse / "images.bin")
        q, t = np.array(pose[:4]), np.array(pose[4:])
        need(np.isfinite(pose).all() and q.any() and camera in cameras and name not in photos,
             f"{sparse}: photo {name} has no finite pose, no camera, or is there twice; export again")
        w, x, y, z = q / np.linalg.norm(q)                   # old files are not normalised
        R = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
                      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
                      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]])   # c2w
        seen = np.frombuffer(skip(24 * count(24)), np.dtype([("uv", "<f8", 2), ("id", "<u8")]))
        seen = seen[seen["id"] != 2 ** 64 - 1]
        photos[name] = camera, np.column_stack([R, -R @ t]), seen["uv"], seen["id"]
    take, count, skip = open_binary(sparse / "points3D.bin")
    points = []
    for _ in range(count(51)):
        key, x, y, z, *_, error = take("Q3d3Bd")
        points.append((key, x, y, z, error, len(skip(8 * count(8))) // 8))
    table = np.array(points, "u8, f8, f8, f8, f8, i8")
    return (cameras, photos, table["f0"], np.stack([table[f"f{i}"] for i in (1, 2, 3)], 1), table["f4"],
            table["f5"])


def read_split(path):
    """NeRF-W table, by column name: {photo: "train" or "test"}; rows with an empty id are dropped."""
    need(Path(path).is_file(), f"the split file {path} is not there")
    text = Path(path).read_bytes().decode(errors="replace")
    head, *rows = [line.split("\t") for line in text.splitlines() if line] or [[]]
    need({"filename", "split"} <= set(head), f"{path} needs a header with filename and split, tab-separated")
    split = {}
    for row in (dict(zip(head, row)) for row in rows):
        if row.get("id", "none") == "":
            continue
        name, part = safe_name(row.get("filename"), path), row.get("split")
        need(part in ("train", "test") and split.get(name, part) == part,
             f"{path}: {name} is {part!r}; each photo is train or test, and not both")
        split[name] = part
    return split


def read_photo(path, camera, uv, downscale):
    """Undistorted and reduced. uv (M,2) follow. -> rgb uint8 (h,w,3), K (4,), uv (M,2)"""
    w, h, K, bend = camera
    try:   # COLMAP works on stored pixels: an EXIF rotation must not be applied
        image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    need(image is not None, f"cannot read the photo {path}; replace it, or take it out of the split file")
    need(image.shape[:2] == (h, w), f"{path} is {image.shape[1]} x {image.shape[0]}, its camera {w} x {h}; "
         "use the photos that belong to this reconstruction")
    if bend.any():                                           # OpenCV's first pixel is at 0, ours at 0.5
        M = np.array([[K[0], 0, K[2] - 0.5], [0, K[1], K[3] - 0.5], [0, 0, 1]])
        image = cv2.undistort(image, M, bend)
        uv = cv2.undistortPoints(uv[:, None] - 0.5, M, bend, P=M)[:, 0] + 0.5 if len(uv) else uv
    small = max(w // downscale, 1), max(h // downscale, 1)
    image = cv2.cvtColor(cv2.resize(image, small, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGB)
    ratio = np.array(small) / (w, h)
    return image, K * np.tile(ratio, 2), uv * ratio


def prepare(folder, downscale=2, split=None):
    """Scene of <folder>/dense/{images,sparse} or <folder>/{images,sparse}; see the top of the file."""
    folder, left_out = Path(folder), []

    def report(names, why):
        if names:
            left_out.append(f"{len(names)} photos {why}: {', '.join(names[:3])}{' ...' * (len(names) > 3)}")
            print(left_out[-1], file=sys.stderr)
    root = folder / "dense" if (folder / "dense").is_dir() else folder
    sparse = root / "sparse" / "0" if (root / "sparse" / "0").is_dir() else root / "sparse"
    fix = "--download" if folder.name in SCENES else "--sfm"
    need((root / "images").is_dir() and sparse.is_dir(), f"{folder} has no folders images and sparse; run: "
         f"python data_prep.py {folder.name if fix == '--download' else folder} {fix}")
    need(downscale >= 1, f"--downscale is a whole number from 1, not {downscale}")
    cameras, photos, ids, xyz, error, views = read_colmap(sparse)
    tables = [Path(split)] if split else sorted(folder.glob("*.tsv"))
    need(len(tables) < 2, f"{folder} has {len(tables)} split files; choose with --split {tables[-1:]}")
    here = sorted(name for name in photos if (root / "images" / name).is_file())
    report(sorted(set(photos) - set(here)), "of the model are not on disk")
    if tables:
        parts = read_split(tables[0])
        report(sorted(set(parts) - set(here)), "of the split file have no pose or no file")
        report([name for name in here if name not in parts], "are not in the split file")
    else:
        parts = {name: "test" if i % 8 == 7 else "train" for i, name in enumerate(here)}
        print("no split file: every eighth photo is held out", file=sys.stderr)
    here = [name for name in here if name in parts]
    wide = {name: max(w / K[0], h / K[1]) for name in here for w, h, K, _ in [cameras[photos[name][0]]]}
    names = [name for name in here if np.tan(np.radians(5)) <= wide[name] / 2 <= np.tan(np.radians(60))]
    report(sorted(set(here) - set(names)), "are narrower than 10 or wider than 120 degrees")
    is_test = np.array([parts[name] == "test" for name in names], bool)
    need((~is_test).sum() >= 2, f"{folder} has {(~is_test).sum()} usable training photos; 2 are needed: "
         "check the split file and the image folder")
    if not is_test.any():
        print("no test photos: scores will be null", file=sys.stderr)
    order, rows = np.argsort(ids), []
    for i, name in enumerate(names):
        camera, c2w, uv, seen = photos[name]
        image, K, uv = read_photo(root / "images" / name, cameras[camera], uv, downscale)
        point = order[np.searchsorted(ids[order], seen) % max(len(ids), 1)] if len(ids) else seen[:0]
        ok = np.flatnonzero(ids[point] == seen[:len(point)])
        rows.append((image.reshape(-1, 3), image.shape[1::-1], K, c2w, np.full(len(ok), i), point[ok], uv[ok]))
    rgb, wh, K, c2w, photo, point, pixels = zip(*rows)
    return finish(dict(rgb=np.concatenate(rgb), wh=np.array(wh), K=np.array(K), is_test=is_test, name=names),
                  np.array(c2w), xyz, views, error, *map(np.concatenate, (photo, point, pixels)),
                  dict(scene=folder.resolve().name, kind="colmap", downscale=downscale, left_out=left_out))


# ---- download, SfM, command line ----------------------------------------------------------------

def fetch(url, path):
    """Streams url into path; what has come of a broken transfer is in path.part, and is continued."""
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
                    print(f"\r{path.name}: {have / 1e6:.1f} MB, {have / max(total, have):.0%}", end="",
                          file=sys.stderr, flush=True)
        print(file=sys.stderr)
        if have < total:
            raise OSError(f"{have} of {total} bytes came")
        os.replace(part, path)
    except (OSError, http.client.HTTPException) as e:        # 416: the part is not of this file
        if getattr(e, "code", 0) == 416:
            part.unlink()
        raise UserError(f"the download of {url} broke ({e}); the same command goes on from there") from e


def download(name, data_root="data", archive_url=ARCHIVE_URL, split_url=SPLIT_URL):
    """Photos and reconstruction of one of SCENES, with its split file -> <data_root>/<name>/"""
    need(name in SCENES, f"--download knows {', '.join(SCENES)}, not {name}")
    (scene, table), root = SCENES[name], Path(data_root)
    archive, temporary = root / f"{scene}.tar.gz", root / f".{name}.{os.getpid()}"
    if (root / name).is_dir():
        return
    for url, path in (split_url + table, root / table), (f"{archive_url}{scene}.tar.gz", archive):
        if not path.exists():
            fetch(url, path)
    try:
        with gzip.open(archive) as raw, tarfile.open(fileobj=raw, mode="r|") as tar:
            for member in tar:                               # only files: a link could lead outside
                if member.isfile() and member.name.startswith(
                        (f"{scene}/dense/images/", f"{scene}/dense/sparse/")):
                    tar.extract(member, temporary, filter="data")
            while raw.read(1 << 20):                         # to the checksum at the very end
                pass
        shutil.copy(root / table, temporary / scene)
        os.replace(temporary / scene, root / name)
    except (tarfile.TarError, EOFError, zlib.error, OSError) as e:
        raise UserError(f"cannot unpack {archive} ({e}); free space, or delete it and try again") from e
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def run_sfm(folder):
    """Poses for the raw photos in `folder`, by pycolmap -> folder/dense/{images,sparse}"""
    try:
        import pycolmap
    except ImportError as e:
        raise UserError("--sfm needs pycolmap; run: pip install pycolmap") from e
    database, models = folder / "database.db", folder / "models"
    models.mkdir(exist_ok=True)
    pycolmap.extract_features(database, folder)
    pycolmap.match_exhaustive(database)
    found = pycolmap.incremental_mapping(database, folder, models)
    need(found, f"the photos in {folder} do not match each other; take more, with more overlap")
    best = max(found, key=lambda i: found[i].num_reg_images())
    pycolmap.undistort_images(folder / "dense", models / str(best), folder)


def locate_and_prepare(name, data_root="data", downscale=2):
    """Path of the scene file of one of SCENES, made from the unpacked archive at first use."""
    path = Path(data_root) / f"{name}.npz"
    if path.exists():
        with np.load(path) as old:
            if json.loads(str(old["info"]))["downscale"] == downscale:
                return path
    write_scene(path, prepare(path.with_suffix(""), downscale))
    return path


def main(argv=None):
    p = argparse.ArgumentParser(description=__doc__, allow_abbrev=False,
                                formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scene", help=f"toy, {', '.join(SCENES)}, or a folder")
    p.add_argument("--download", action="store_true", help="fetch archive and split file first")
    p.add_argument("--sfm", action="store_true", help="the folder has raw photos: pose them first")
    p.add_argument("--downscale", type=int, default=2, help="photos become this many times smaller")
    p.add_argument("--split", help="table of training and test photos; default: <folder>/*.tsv")
    p.add_argument("--out", help="default: data/<scene>.npz")
    knobs = inspect.signature(make_toy).parameters
    for key, knob in knobs.items():
        how = dict(type=type(knob.default))
        if knob.default is True:
            how = dict(action=argparse.BooleanOptionalAction)
        p.add_argument(f"--{key}", default=None, help=f"toy only, default {knob.default}", **how)
    a = p.parse_args(argv)
    knobs = {key: getattr(a, key) for key in knobs if getattr(a, key) is not None}
    try:
        need(a.scene == "toy" or not knobs, f"--{'/--'.join(knobs)} is for the scene toy only")
        folder = Path("data") / a.scene if a.scene in SCENES else Path(a.scene)
        if a.download:
            download(a.scene)
        if a.sfm:
            run_sfm(folder)
        scene = make_toy(**knobs) if a.scene == "toy" else prepare(folder, a.downscale, a.split)
        out = Path(a.out or f"data/{folder.resolve().name}.npz")
        write_scene(out, scene)
    except UserError as e:
        print(f"error: {e}", file=sys.stderr)
        sys.exit(2)
    print(f"{out}: {len(scene['wh'])} photos, {scene['is_test'].sum()} of them for testing, "
          f"{len(scene['rgb']) / 1e6:.2f} million pixels, {len(scene['points'])} points\n"
          f"unit sphere: centre {np.round(scene['center'], 3)}, radius {scene['scale']:.3f} world units\n"
          f"reprojection error: median {json.loads(str(scene['info']))['reprojection_px']:.2f} px "
          f"of {len(scene['track_photo'])} observations")


if __name__ == "__main__":
    main()
