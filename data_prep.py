# SPDX-License-Identifier: MIT
"""Scene files for geonvs.py: a synthetic landmark, or photos with a COLMAP reconstruction.

    python data_prep.py toy --occluders 0.4     a toy -> data/toy.npz
    python data_prep.py brandenburg --download  Phototourism, 5 GB -> data/brandenburg.npz
    python data_prep.py my_photos --sfm         photos, posed first -> data/my_photos-*.npz
    python data_prep.py my_scene                photos and their COLMAP model -> data/my_scene-*.npz

Scene files. A scene is one .npz of the arrays in FORMAT, below; some have those in OPTIONAL.
The landmark lies in the unit sphere. A ray is c2w[:, 3] + t * d with |d| = 1; a distance
is this t, never a z-depth. x right, y down, z forward are a camera's axes, as in OpenCV.

Masks. masks/ or MASKS/ lies in the folder of photos or beside it; there the mask of photo.jpg
is photo.png, photo.jpg.png or photo.jpg. Pixels darker than 128 are left out, and so are
pixels whose alpha channel is below 128, in a photo or a mask. A point that most photos
see in such pixels is dropped.

Functions raise UserError, one sentence that says what to do."""
import argparse
import contextlib
import gzip
import inspect
import io
import itertools
import json
import os
import re
import shutil
import signal
import struct
import sys
import tarfile
import tempfile
import threading
import time
import unicodedata
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import NamedTuple
from urllib.request import Request, urlopen

import cv2
import numpy as np

# name: (archive, split file)
SCENES = {
    "brandenburg": ("brandenburg_gate", "brandenburg.tsv"),
    "sacre": ("sacre_coeur", "sacre.tsv"),
    "trevi": ("trevi_fountain", "trevi.tsv"),
    "taj": ("taj_mahal", "taj_mahal.tsv")}
DATA = Path("data")
ARCHIVE_URL = "https://www.cs.ubc.ca/research/kmyi_data/imw2020/TrainingData/"
SPLIT_URL = "https://nerf-w.github.io/data/selected_images/"
# The arrays of a scene file: data type and shape. Scene units, unless said.
FORMAT = dict(
    rgb=("uint8", ["pixels", 3]),  # photo i is rgb[start[i]:start[i + 1]], row by row
    start=("int64", ["photos + 1"]),
    wh=("int32", ["photos", 2]),  # width, height
    K=("float64", ["photos", 4]),  # fx fy cx cy [px]; the first pixel's centre is 0.5 0.5
    c2w=("float64", ["photos", 3, 4]),  # camera to world: x_world = c2w @ (x_camera, 1)
    is_test=("bool", ["photos"]),  # held out from training
    name=("<U", ["photos"]),
    near=("float32", ["photos"]),  # distance at which the photo's content begins
    points=("float32", ["points", 3]),  # of SfM
    track_photo=("int32", ["observations"]),  # sorted by photo: index of the photo
    track_point=("int32", ["observations"]),  # index of the point
    track_uv=("float32", ["observations", 2]),  # (u / w, v / h): 0..1 inside, clipped to -1..2
    center=("float64", [3]),  # SfM units are x * scale + center
    scale=("float64", []),
    footprint=("float64", []),  # size of a pixel on the landmark, lower quartile
    exposure_spread=("float64", []),  # between training photos, of brightness in 0..1
    bg_color=("float64", [3]),  # in 0..1, where it is one colour; else NaN
    info=("<U", []),  # JSON: scene, kind (toy or colmap), downscale, folder, split, ...
)
OPTIONAL = dict(
    masked=("bool", ["pixels"]),  # black in a mask of the photographer's: left out
    # Of toys: the truth.
    depth=("float16", ["pixels"]),  # distance; inf is sky
    occluder=("bool", ["pixels"]),  # a person
    wall=("float64", ["surface points", 3]),  # visible, where the surface is smooth
    wall_normal=("float64", ["surface points", 3]),
    near_wall=("float64", ["points near surfaces", 3]),
    near_wall_sdf=("float64", ["points near surfaces"]),  # signed distance, + outside
)
MAX_NUMBER = 1e9  # sound reconstructions have none larger; float32 holds its square
EPSILON = 1e-9  # a smaller depth, radius or focal length counts as zero


class UserError(Exception):
    """Something that the person at the keyboard can correct: one sentence that says how."""


def check(ok, message):
    if not ok:
        raise UserError(message)


def warn(message):
    print(message, file=sys.stderr)


@contextlib.contextmanager
def as_user_error(errors, what, advice):
    """An error of these types becomes one sentence: what went wrong, its reason, and what to do."""
    try:
        yield
    except errors as e:
        reason = " ".join(str(getattr(e, "strerror", None) or e).split())
        raise UserError(f"{what} ({reason}): {advice}") from e


@contextlib.contextmanager
def on_signals(handler):
    """Ctrl-C, SIGTERM and SIGHUP (a closed terminal) call a handler meanwhile, in the main thread.
    A signal that is ignored, as nohup does, stays ignored."""
    is_main = threading.current_thread() is threading.main_thread()
    with contextlib.ExitStack() as at_the_end:
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number and is_main and signal.getsignal(number) != signal.SIG_IGN:
                at_the_end.callback(signal.signal, number, signal.signal(number, handler))
        yield


def is_memory_full(error):
    """Whether an error of Python, OpenCV, a CPU's allocator, CUDA, cuBLAS or cuDNN says so."""
    if isinstance(error, (RuntimeError, cv2.error)):
        says_so = "allocat|out of memory|ALLOC_FAILED|_NOT_INITIALIZED|nsufficient memory"
        return re.search(says_so, str(error)) is not None
    return isinstance(error, MemoryError)


def run_command_line(entry, go_on="start again"):
    """Exit code 0, or 2 with one sentence on stderr; a bug keeps its traceback. go_on: what to do
    after a stop."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a notebook's streams print any character
            stream.reconfigure(errors="backslashreplace")  # a terminal may lack it
    with on_signals(signal.default_int_handler):
        try:
            entry()
            return
        except UserError as error:
            message = str(error)
        except OSError as error:  # a full disk, a folder without permission
            message = f"{error}: make room, or choose another place (in training: --name); {go_on}"
        except KeyboardInterrupt as stop:
            message = str(stop) or f"stopped; {go_on}"
        except Exception as error:
            if not is_memory_full(error):
                raise
            message = ("the memory is full: end other programs, or begin anew with a larger "
                       f"--downscale (in training: or fewer --rays); {go_on}")
    with contextlib.suppress(OSError):  # the terminal may be closed
        warn(f"error: {message}")
    sys.exit(2)


def progress(items, what):
    """Yields items and prints progress: after 10 s every second, in a log file every minute."""
    wait = 1 if sys.stdout.isatty() else 60  # seconds
    begin = time.monotonic()
    due = max(10, wait)
    for done, item in enumerate(items, 1):
        yield item
        elapsed = time.monotonic() - begin
        is_last = done == len(items)
        if elapsed > due or (is_last and elapsed > 10):
            due = elapsed + wait
            left = elapsed / done * (len(items) - done)
            end = "\r" if wait == 1 and not is_last else "\n"  # the next line covers this one
            print(f"  {what}: {done} of {len(items)}, {left:.0f} s left ", end=end, flush=True)


def atomic_write(path, write):
    """write(temporary path), then rename: `path` is the whole old file or the new one."""
    # Without the stem: a name may have 255 bytes already.
    temporary = path.with_name(f".{os.getpid()}.{time.time_ns()}{path.suffix}")
    with as_user_error(OSError, f"cannot write {path}", "free or choose a place"):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            write(temporary)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def write_scene(path, scene):
    """Writes a scene file, uncompressed: a third larger, but six times faster."""
    atomic_write(path, lambda temporary: np.savez(temporary, **scene))


def write_png(path, picture):
    """An RGB picture (H,W,3) of bytes; encoded here, as cv2 cannot open every path."""
    _, data = cv2.imencode(".png", picture[..., ::-1])
    atomic_write(path, lambda temporary: temporary.write_bytes(data))


def write_ply(path, vertices, faces, colors):
    """A binary PLY file of vertices (P,3), faces (N,3) and the vertices' colours (P,3) in bytes.
    Coordinates are doubles, as floats would round those of a map."""
    vertex = np.rec.fromarrays([vertices, colors], formats="(3,)<f8, (3,)u1")
    face = np.rec.fromarrays([np.full(len(faces), 3), faces], formats="u1, (3,)<i4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header += ["end_header", ""]
    data = "\n".join(header).encode() + vertex.tobytes() + face.tobytes()
    atomic_write(path, lambda temporary: temporary.write_bytes(data))


def refuse_bomb(path):
    """UserError if the archive unpacks to more bytes than the file has: ours are never packed."""
    with zipfile.ZipFile(path) as file:
        unpacked = sum(member.file_size for member in file.infolist())
    check(unpacked <= os.path.getsize(path), f"{path} is larger inside than outside")


def check_scene(scene):
    """UserError with what is wrong, unless the arrays fit FORMAT and each other."""
    sizes = {2: 2, 3: 3, 4: 4}  # by name, of the first array that has it
    optional = {key: OPTIONAL[key] for key in OPTIONAL.keys() & scene}
    for key, (dtype, shape) in (FORMAT | optional).items():
        value = scene[key]
        is_fit = str(value.dtype).startswith(dtype)  # "<U" fits a text of any length
        check(is_fit and value.ndim == len(shape), f"{key} is no {dtype} with axes {shape}")
        for name, size in zip(shape, value.shape):
            check(sizes.setdefault(name, size) == size, f"{key} has {size} {name}")
        if dtype.startswith("float") and key not in ("bg_color", "depth"):
            check(np.isfinite(value).all(), f"{key} is not finite")
    for key, count in [("track_photo", sizes["photos"]), ("track_point", sizes["points"])]:
        check(((scene[key] >= 0) & (scene[key] < count)).all(), f"{key} is not in 0..{count - 1}")
    for key in ("wh", "footprint", "scale"):
        check((scene[key] > 0).all(), f"{key} is not positive")
    start = np.cumsum([0, *scene["wh"].prod(1)])
    check(np.array_equal(scene["start"], start) and start[-1] == sizes["pixels"], "start is wrong")
    check(not scene["is_test"].all(), "no photo is for training")
    info = json.loads(str(scene["info"]))
    check({"kind", "scene", "downscale", "folder", "split"} <= set(info), "info lacks a key")


def read_scene(path):
    """The dictionary of a scene file; UserError unless it is whole and fits FORMAT."""
    what = f"{path} is no whole scene, or too large"
    # A damaged file can fail in any layer: zip, header, dtype, text.
    with as_user_error(Exception, what, "delete it, it is remade"):
        refuse_bomb(path)
        with np.load(path, allow_pickle=False) as file:
            scene = dict(file)
        check_scene(scene)
    return scene


# ---- pixels and rays -------------------------------------------------------------------
def lengths(x):
    """Lengths of vectors. (P,3) -> (P,)"""
    return np.linalg.norm(x, axis=1)


def ray_directions(K, c2w, w, h, offset=(0.5, 0.5)):
    """Unit vectors through each pixel's offset, in world axes, row by row. -> (h*w,3)"""
    uv = np.indices((w, h)).T.reshape(-1, 2)
    xy = (uv + offset - K[2:]) / K[:2]
    d = np.column_stack([xy, np.ones(w * h)])
    d /= lengths(d)[:, None]
    return d @ c2w[:, :3].T


def project(K, c2w, x):
    """Pixels (P,2) and distances (P,) of points x (P,3). Behind the camera uv is -MAX_NUMBER."""
    p = (x - c2w[:, 3]) @ c2w[:, :3]
    z = p[:, 2:]
    uv = p[:, :2] / np.maximum(z, EPSILON) * K[:2] + K[2:]
    return np.where(z > 0, uv, -MAX_NUMBER), lengths(p)


def pixel_index(uv, wh):
    """Row-by-row indices of pixels uv (P,2), moved inside a photo of size wh. -> (P,)"""
    return np.clip(uv, 0, np.subtract(wh, 1)).astype(int) @ (1, wh[0])


# ---- from photos, poses and points to a scene ------------------------------------------
@dataclass
class Photo:
    name: str
    image: np.ndarray  # (h,w,3) uint8
    masked: np.ndarray  # (h,w) bool, True is left out
    K: np.ndarray  # (4,)
    c2w: np.ndarray  # (3,4), in SfM units
    track: np.ndarray  # (M,) indices of the points that it sees
    is_test: bool  # held out


def find_sphere(x, weight, photos, contain):
    """Centre (3,) and radius of the scene sphere, which becomes the unit sphere [D5]. Centre:
    geometric median of points x (P,3) by weight. Radius: 1.1 x the distance of 95 %; if that is a
    skyline, more than four times the median distance away, only nearer points are counted. At
    least half of the training photos have 30 % of their points inside. All points contain (...,3)
    are inside."""
    center = np.median(x, axis=0)
    for _ in range(20):  # Weiszfeld
        w = weight / np.maximum(lengths(x - center), EPSILON)
        center = w @ x / w.sum()
    distance = lengths(x - center)  # (P,)
    counted = np.repeat(distance, weight)
    limit = 4 * np.median(counted)
    if np.quantile(counted, 0.95) > limit:
        counted = counted[counted <= limit]
    # A distance in `counted`: between two of them there may be a gap.
    radius = 1.1 * np.quantile(counted, 0.95, method="inverted_cdf")
    tracks = [photo.track for photo in photos if len(photo.track) and not photo.is_test]
    check(tracks, "no training photo observes a usable 3D point: they do not belong together")
    reach = [np.quantile(distance[track], 0.3) for track in tracks]
    corners = 1.02 * lengths(np.reshape(contain, (-1, 3)) - center)  # a margin
    radius = max(radius, np.median(reach), *corners)
    check(radius > EPSILON, "all 3D points coincide: run SfM again")
    return center, radius


def count_sightings(photos, points):
    """How many of the photos see each point. -> (P,)"""
    return np.bincount(np.concatenate([photo.track for photo in photos]), minlength=len(points))


def drop_masked(photos, points):
    """Drops sightings in masked pixels. -> whether a point keeps half of its sightings (P,)"""
    before = count_sightings(photos, points)
    for photo in photos:
        uv, _ = project(photo.K, photo.c2w, points[photo.track, :3])
        pixel = pixel_index(uv, photo.masked.shape[::-1])
        photo.track = photo.track[~photo.masked.ravel()[pixel]]
    return 2 * count_sightings(photos, points) >= before


def build_scene(photos, points, info, contain=()):
    """The scene of photos. points (P,5): x y z, error [px], track length; contain (...,3): points
    that the sphere holds. Changes the photos."""
    is_there = drop_masked(photos, points)
    error, track_length = points[:, 3:].T
    usable = is_there & (track_length >= 3)
    if usable.sum() < 500:
        usable = is_there & (track_length >= 2)
    count = usable.sum()
    check(count >= 20, f"{count} usable 3D points: take more overlapping photos, or mask less")
    usable &= error <= np.quantile(error[usable], 0.95)
    new_index = np.cumsum(usable) - 1
    for photo in photos:
        photo.track = new_index[photo.track[usable[photo.track]]]
    x = points[usable, :3]
    weight = np.minimum(track_length[usable], 20).astype(int)
    center, radius = find_sphere(x, weight, photos, contain)
    c2w = np.array([photo.c2w for photo in photos])
    c2w[:, :, 3] = (c2w[:, :, 3] - center) / radius
    wh = np.array([photo.image.shape[1::-1] for photo in photos])
    masked = np.concatenate([photo.masked.ravel() for photo in photos])
    arrays = dict(
        rgb=np.concatenate([photo.image.reshape(-1, 3) for photo in photos]),
        start=np.cumsum([0, *wh.prod(1)]),
        wh=wh,
        K=[photo.K for photo in photos],
        c2w=c2w,
        is_test=[photo.is_test for photo in photos],
        name=[photo.name for photo in photos],
        points=(x - center) / radius,
        track_photo=np.repeat(np.arange(len(photos)), [len(photo.track) for photo in photos]),
        track_point=np.concatenate([photo.track for photo in photos]),
        center=center,
        scale=radius,
        info=json.dumps(info))
    scene = {key: np.asarray(value, FORMAT[key][0]) for key, value in arrays.items()}
    if masked.any():
        scene["masked"] = masked
    return add_statistics(scene)


def common_color(colors):
    """Median of uint8 colours (P,3), scaled to 0..1; NaN unless 60 % lie within 2 % of it."""
    if len(colors) > 100:  # fewer may all be people
        median = np.median(colors, axis=0)
        is_like = (abs(colors - median) < 5.1).all(1)
        if is_like.mean() > 0.6:
            return median / 255
    return np.full(3, np.nan)


def add_statistics(scene):
    """Adds the arrays that follow from the others.
    near: 0.8 x the 2 % quantile of the distances of a photo's points, >= 0.02;
    0.05 without points. The others are about pixels of training photos without a mask.
    footprint: lower quartile of a pixel's size at points in the sphere.
    exposure_spread: standard deviation of photos' median offsets from points' mean brightness.
    bg_color: seen by rays that miss the sphere, NaN unless 60 % agree."""
    rgb = scene["rgb"]
    masked = scene.get("masked", np.zeros(len(rgb), bool))
    step = max(1, len(rgb) // 500_000)  # large scenes need not every background pixel
    near, track_uv = [], []
    observed, sizes, brightness, background = [], [], [], []
    for i, (K, c2w, wh) in enumerate(zip(scene["K"], scene["c2w"], scene["wh"])):
        track = scene["track_point"][scene["track_photo"] == i]
        x = scene["points"][track]
        uv, distance = project(K, c2w, x)
        track_uv.append(np.clip(uv / wh, -1, 2))
        near.append(max(0.8 * np.quantile(distance, 0.02), 0.02) if len(track) else 0.05)
        if scene["is_test"][i]:
            continue
        sizes.append(distance[lengths(x) < 1] / K[0])
        pixel = scene["start"][i] + pixel_index(uv, wh)
        observed.append(track)
        brightness.append(rgb[pixel].mean(1) / 255)
        o = c2w[:, 3]
        d = ray_directions(K, c2w, *wh)
        closest = o - np.minimum(d @ o, 0)[:, None] * d  # to the centre, along each ray
        pixel = scene["start"][i] + np.arange(len(d))
        is_background = (lengths(closest) > 1) & ~masked[pixel]
        background.append(rgb[pixel[is_background][::step]])
    point = np.concatenate(observed)
    mean = np.bincount(point, np.concatenate(brightness)) / np.maximum(np.bincount(point), 1)
    offsets = [np.median(b - mean[track]) for track, b in zip(observed, brightness) if len(track)]
    return scene | dict(
        near=np.float32(near), track_uv=np.concatenate(track_uv, dtype=np.float32),
        footprint=np.quantile(np.concatenate(sizes), 0.25),
        exposure_spread=np.std(offsets or [0]),
        bg_color=common_color(np.concatenate(background)))


# ---- COLMAP models ---------------------------------------------------------------------
# COLMAP's camera models: the numbers of their parameters.
PARAMETERS = [3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2]
# The perspective ones begin with f cx cy or fx fy cx cy, then k1 k2 p1 p2 k3 k4 k5 k6 of OpenCV.
ONE_FOCAL_LENGTH = (0, 2, 3)
TWO_FOCAL_LENGTHS = (1, 4, 6)


def records(path):
    """Yields, for each record of a COLMAP file, a function that reads values by a layout."""
    check(path.is_file(), f"{path} is missing: copy the model, or run colmap point_triangulator")
    file = io.BytesIO(path.read_bytes())

    def read(layout):
        # An error says that too few bytes are left, or that the count is absurd.
        with as_user_error(struct.error, f"{path} is cut off", "copy it, or delete its folder"):
            record = struct.Struct("<" + layout)  # little-endian, without gaps
            return record.unpack(file.read(record.size))
    (count,) = read("Q")
    for _ in range(count):
        yield read


def read_cameras(sparse):
    """{number: ((w, h), K (4,), OpenCV's distortion (8,))} of a model's perspective cameras."""
    cameras = {}
    for read in records(sparse / "cameras.bin"):
        number, kind, w, h = read("IiQQ")
        check(0 <= kind < len(PARAMETERS),
              f"{sparse} has an unknown camera model, {kind}: run colmap image_undistorter")
        numbers = read(f"{PARAMETERS[kind]}d")
        if kind in ONE_FOCAL_LENGTH:
            numbers = numbers[:1] + numbers
        if kind in ONE_FOCAL_LENGTH + TWO_FOCAL_LENGTHS:
            numbers = np.pad(numbers, (0, 12 - len(numbers)))  # what a model lacks is 0
            cameras[number] = (w, h), numbers[:4], numbers[4:]
    return cameras


def read_photos(sparse):
    """{name: (camera or None, pose (7,), ids of its points)} of a COLMAP model."""
    cameras = read_cameras(sparse)
    photos = {}
    for read in records(sparse / "images.bin"):
        _, *pose, camera = read("I7dI")
        letters = iter(lambda: read("c")[0], b"\0")  # the name ends with a zero byte
        name = b"".join(letters).decode(errors="surrogateescape")
        name = name.replace("\\", "/")  # of Windows
        (observations,) = read("Q")
        ids = read(f"{3 * observations}Q")[2::3]  # of (u, v, point id), 8 bytes each
        is_outside = any(step in ("", "..") for step in name.split("/"))
        check(name not in photos and not is_outside,
              f"{sparse}: rename photo {name!r}, which occurs twice or is outside the folder")
        photos[name] = cameras.get(camera), np.array(pose), ids
    return photos


def check_photo(camera, pose, is_test):
    """UserError, a sentence about the photo, unless it can be used."""
    check(camera, "has no camera in the model, or a fisheye: run colmap image_undistorter")
    wh, K, distortion = camera
    numbers = np.concatenate([K, distortion, pose])
    is_sound = (abs(numbers) < MAX_NUMBER).all() and min(K[:2]) > EPSILON and pose[:4].any()
    check(is_sound, "has no sound camera or pose: run SfM again")
    check(max(wh) < 32767, f"is {wh[0]} x {wh[1]} pixels, too large: shrink it, then run SfM again")
    angle = 2 * np.degrees(np.arctan(max(wh / K[:2]) / 2))
    check(is_test or 10 <= angle <= 120, f"is {angle:.1f} degrees wide, which is not in 10..120")


def camera_to_world(pose):
    """COLMAP's world to camera, quaternion and translation (7,) -> c2w (3,4)"""
    w, *v = pose[:4] / np.linalg.norm(pose[:4])  # old files are not normalised
    turn = np.cross(v, np.eye(3))  # rows v x e_i: [v]x transposed, so that R is camera to world
    R = np.eye(3) + 2 * w * turn + 2 * turn @ turn
    return np.column_stack([R, -R @ pose[4:]])


def read_points(sparse):
    """Points (P,5) of a COLMAP model, as in build_scene, and {id: row} of them."""
    points, rows = [], {}
    for read in records(sparse / "points3D.bin"):
        point_id, x, y, z, *_, error, track_length = read("Q3d3BdQ")
        read(f"{2 * track_length}I")  # the track, skipped: photos list their points
        rows[point_id] = len(points)
        points.append((x, y, z, error, track_length))
    points = np.array(points, float).reshape(-1, 5)
    # A row with nan or a huge number becomes 0; build_scene drops points of track length 0.
    points[~(abs(points) < MAX_NUMBER).all(1)] = 0
    has_track = points[:, 4] > 1
    check(has_track.any(), f"no point of {sparse} has a track: run colmap point_triangulator")
    return points, rows


# ---- names and folders -----------------------------------------------------------------
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin")
JPEG = rb"\xff\xd8\xff"  # how a file starts
HEIC = rb"....ftyp(heic|heix|mif1|msf1)"  # phones often name it .jpg
# A photo has one of these types or starts. Some programs leave copies beside it.
PHOTO_STARTS = rb"\x89PNG|RIFF....WEBP|" + JPEG + b"|" + HEIC
PHOTO_TYPES = ".jpg .jpeg .png .tif .tiff .bmp .webp .ppm .pgm .jp2 .avif .heic .heif".split()
COPY_ENDINGS = ("~", "_original", ".bak", ".thm")


def files_below(folder, levels=7):
    """Files at most so many levels down, also by links; none in hidden folders and thumbnails. A
    broken link counts as a file, and so does a folder that may not be read."""
    try:
        paths = sorted(folder.iterdir()) if levels and folder.is_dir() else []
    except PermissionError:
        return [folder]
    files = []
    for path in paths:
        if not path.name.startswith((".", "@")):  # NAS boxes write @eaDir
            files += files_below(path, levels - 1) if os.path.isdir(path) else [path]
    return files


def starts_with(path, pattern):
    """Whether a file can be read and its first bytes match."""
    try:
        with open(path, "rb") as file:
            return bool(re.match(pattern, file.read(16), re.DOTALL))
    except OSError:
        return False


def photo_files(folder, posed=()):
    """{name: path} of the photos below a folder, without masks/ and copies in dense/. A file that
    the model names is one of them, whatever its type."""
    files = {}
    for path in files_below(folder):
        name = path.relative_to(folder).as_posix()
        lower = name.lower()
        is_copy = lower.startswith(("dense/", "masks/")) or lower.endswith(COPY_ENDINGS)
        is_photo = path.suffix.lower() in PHOTO_TYPES or starts_with(path, PHOTO_STARTS)
        if name in posed or (is_photo and not is_copy):
            files[name] = path
    return files


def match_names(wanted, there):
    """{wanted: name there}: equal, or the only two that differ just in case or Unicode form."""
    alike = {}  # by form: names that are wanted, names that are there
    for side, names in enumerate((wanted, there)):
        for name in set(names):
            form = unicodedata.normalize("NFC", name).casefold()
            alike.setdefault(form, ([], []))[side].append(name)
    found = {ours[0]: theirs[0] for ours, theirs in alike.values() if len(ours) == len(theirs) == 1}
    return found | {name: name for name in wanted if name in there}


def name_hint(name, names):
    """A hint at a name that differs in folder or ending only, or nothing."""
    stem = PurePosixPath(name).stem
    close = [other for other in names if PurePosixPath(other).stem == stem]
    return f"; there is {close[0]!r}" if close else ""


def mask_folders(images):
    """Folders with "mask" in their name, in the folder of photos and beside it; masks/ first."""
    places = [images, images.parent]
    if images.parent.name == "dense":
        places.append(images.parent.parent)
    paths = [path for place in places for path in place.glob("*[mM][aA][sS][kK]*")]
    return sorted(filter(Path.is_dir, paths), key=lambda path: path.name.lower() != "masks")


def mask_files(images, names):
    """{photo: path of its mask}; tells which folders of masks are not used."""
    masks = {}
    for folder in mask_folders(images):
        files = {path.relative_to(folder).as_posix(): path for path in files_below(folder)}
        is_masks = folder.name.lower() == "masks" and not masks
        # A mask counts under its whole name and without .png, photos also by their stem.
        keys = files | {key[:-4]: path for key, path in files.items() if key[-4:].lower() == ".png"}
        stems = {name: os.path.splitext(name)[0] for name in names if is_masks}
        found = match_names([*stems, *stems.values()], keys)
        for name, stem in stems.items():
            if name in found or stem in found:
                masks[name] = keys[found.get(stem, found.get(name))]
        if files and not found:
            warn(f"{folder} is not used: masks lie in masks/ and have photos' names, unlike "
                 f"{min(files)}")
    return masks


# ---- models and splits of a folder -----------------------------------------------------
def open_model(folder, sparse):
    """Reads a COLMAP model and finds the folder that holds most of its photos."""
    photos = read_photos(sparse)
    around = [place for place in (sparse, *sparse.parents) if place.is_relative_to(folder)]
    models = []
    for images in [place / name for place in around for name in ("images", "input", "")]:
        on_disk = photo_files(images, photos)
        files = {name: on_disk[other] for name, other in match_names(photos, on_disk).items()}
        count = sum(photos[name][0] is not None for name in files)  # those with a camera
        models.append(SimpleNamespace(
            sparse=sparse, photos=photos, images=images, on_disk=on_disk, files=files, count=count))
    return max(models, key=lambda model: len(model.files))


def find_model(folder):
    """The model in the folder with most photos; prints which photos and models it lacks."""
    models = []
    for path in files_below(folder):
        if os.path.isdir(path):
            warn(f"passed over: the folder {path} may not be read")
        if path.name == "images.bin":
            models.append(open_model(folder, path.parent))
    sfm = f"python data_prep.py {folder} --sfm"
    parent = folder.absolute().parent
    if not models and folder.name in ("images", "input"):
        around = [path.name for path in files_below(parent)]
        check("images.bin" not in around,
              f"{folder} has no COLMAP model, the folder around it has: give {parent}")
    check(models, f"{folder} has no binary COLMAP model: run {sfm}, or for a text model "
          "colmap model_converter --output_type BIN")
    best = max(models, key=lambda model: model.count)
    check(best.photos, f"{best.sparse} is an empty model: delete it and run {sfm}")
    lost = sorted(best.photos.keys() - best.files)
    if lost:
        hint = name_hint(lost[0], best.on_disk)
        message = f"{len(lost)} photos of {best.sparse} are not on disk, such as {lost[0]!r}{hint}"
        check(best.files, f"{message}: put them into {folder / 'images'}, or run {sfm}")
        warn(message)
    count = len(best.on_disk)
    print(f"{best.images}: {count} photos on disk, {len(best.files)} posed by {best.sparse}")
    for model in models:
        if model.photos.keys() != best.photos.keys():
            print(f"left out is another model: {len(model.photos)} posed by {model.sparse}")
    return best


def read_table(path):
    """Rows of a table of any separator as dictionaries; of a list train*.txt or test*.txt, too."""
    check(path.is_file(), f"the split file {path} is missing")
    text = path.read_text("utf-8-sig", "surrogateescape")
    lines = [line for line in text.splitlines() if line.strip()]
    if path.suffix == ".txt":
        subset = "test" if "test" in path.name else "train"
        return [dict(filename=line.strip(), split=subset) for line in lines]
    separator = max("\t;,", key="".join(lines[:1]).count)
    words = [[word.strip(' "') for word in line.split(separator)] for line in lines]
    return [dict(zip(words[0], row)) for row in words[1:]]


def split_files(folder, split):
    """The table of the split, or train_list.txt and test_list.txt: named or in the folder."""
    found = [Path(split)] if split else [
        path for path in sorted(folder.glob("[!.]*.[ct]sv"))
        if os.access(path, os.R_OK) and any("split" in row for row in read_table(path))
    ] or list(folder.glob("train*.txt"))
    check(len(found) < 2, f"choose a split file by --split: {', '.join(map(str, found))}")
    if found and found[0].suffix == ".txt":
        names = [re.sub("train|test", subset, found[0].name) for subset in ("train", "test")]
        return [found[0].with_name(name) for name in names]
    return found


def read_split(paths, names):
    """{name: whether it is held out} of what split_files finds, with names as they are here. A
    table has NeRF-W's columns; rows with an empty id do not count."""
    print(f"split by {paths[0]}")
    subsets = {}
    for row in itertools.chain(*map(read_table, paths)):
        name, subset = row.get("filename"), row.get("split")
        if row.get("id") != "":
            is_clear = subset in ("train", "test") and subsets.setdefault(name, subset) == subset
            check(name and is_clear,
                  f"{paths[0]}: filename {name!r} has split {subset!r}; each has train or test")
    matches = match_names(subsets, names)
    rest = set(names) - set(matches.values())
    if rest:
        warn(f"{len(rest)} photos are not in {paths[0]}: {min(rest)} ...")
    return {matches.get(name, name): subset == "test" for name, subset in subsets.items()}


def checksum(paths):
    """CRC-32 over files' names and content. A file that cannot be read adds only its name."""
    crc = 0
    for path in paths:
        crc = zlib.crc32(os.fsencode(path), crc)
        with contextlib.suppress(OSError):
            crc = zlib.crc32(path.read_bytes(), crc)
    return crc


def fingerprint(info):
    """Checksum of the files a scene is read from: models, split tables, posed photos, masks."""
    folder, images = Path(info["folder"]), Path(info["images"])
    paths = [path for path in files_below(folder) if path.name in MODEL_FILES]
    paths += split_files(folder, info["split"])
    photos = photo_files(images, info["posed"])
    paths += [photos[name] for name in sorted(match_names(info["posed"], photos).values())]
    for masks in mask_folders(images):
        if masks.name.lower() == "masks":  # others are named, not read
            paths += files_below(masks)
    return checksum(paths)


# ---- photos and masks ------------------------------------------------------------------
# Starts a segment of a JPEG or ends it; FF 00 is a byte of pixels, the others have no length.
MARKER = re.compile(rb"\xff[\x02-\xcf\xd9-\xfe]")
# In a TIFF with two samples per pixel, in either byte order: the second is alpha.
GREY_WITH_ALPHA = re.compile(rb"\x15\x01\x03\0\x01\0\0\0\x02\0|\x01\x15\0\x03\0\0\0\x01\0\x02")


def is_cut_off(data):
    """Whether a JPEG or PNG file lacks its end, which OpenCV does not report. A JPEG ends with its
    first end mark. A video or raw data may follow, and a segment before it may hold a thumbnail
    with an end of its own."""
    if data[:2] != b"\xff\xd8":
        return data[1:4] == b"PNG" and b"IEND" not in data
    at = 2
    while marker := MARKER.search(data, at):
        at = marker.end()
        if marker[0] == b"\xff\xd9":
            return False
        at += int.from_bytes(data[at:at + 2], "big")  # the segment's length
    return True


def read_image(path, flags):
    """An image file's pixels; UserError, a sentence about the file, where it has none."""
    try:
        data = path.read_bytes()
        check(not is_cut_off(data), "is cut off: copy it again")
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except OSError as e:
        raise UserError(f"cannot be read: {e.strerror}") from e
    except cv2.error as e:  # empty, or more than a gigapixel
        if is_memory_full(e):
            raise
        image = None
    check(image is not None, "is empty, damaged, too large or of an unknown type: replace it")
    return image


def read_photo(path, size):
    """The photo (h,w,3) in uint8, BGR, as a camera of this size (w, h) saw it."""
    check(path.exists(), "is a broken link: copy the photo itself")
    check(not starts_with(path, HEIC), "is HEIC, which cannot be read: convert it to JPEG")
    image = read_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    h, w = image.shape[:2]
    if (w, h) != size:
        image = read_image(path, cv2.IMREAD_COLOR)  # turned by its EXIF tag
    check(image.shape[1::-1] == size,
          f"has {w} x {h} pixels, its camera {size[0]} x {size[1]}: put back what SfM saw")
    return image


def shrink(image, camera, downscale):
    """Undistorts and downscales a photo (h,w,3) or a mask (h,w). -> it, K (4,)"""
    size, K, distortion = camera
    check(1 <= downscale <= min(size) / 2, f"is {size[0]} x {size[1]}: change --downscale")
    if distortion.any():
        fx, fy, cx, cy = K - (0, 0, 0.5, 0.5)  # OpenCV's first pixel is at 0
        M = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        # alpha = 0: every pixel lies in the photo
        P, _ = cv2.getOptimalNewCameraMatrix(M, distortion, size, 0)
        image = cv2.undistort(image, M, distortion, None, P)
        K = np.array([P[0, 0], P[1, 1], P[0, 2] + 0.5, P[1, 2] + 0.5])
    small = size[0] // downscale, size[1] // downscale
    image = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
    return image, K * np.tile(np.divide(small, size), 2)  # fx, cx by width; fy, cy by height


def read_opaque(path, is_mask):
    """Which pixels (h,w) of a file are opaque, and bright in a mask; None for all of them."""
    grey = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    layers = [read_image(path, grey)] if is_mask else []
    if not starts_with(path, JPEG):  # which has no alpha channel
        image = read_image(path, cv2.IMREAD_UNCHANGED)
        check(not GREY_WITH_ALPHA.search(path.read_bytes()),
              "is a grey TIFF with alpha, which cannot be read: save it as PNG")
        if image.shape[2:] == (4,) and image.dtype.kind == "u":
            layers.append(image[..., 3] / (np.iinfo(image.dtype).max / 255))
    return np.min(layers, axis=0) >= 128 if layers else None


def read_mask(photo, path, size):
    """The mask of a photo by its alpha channel and its mask file, if any, in size (w, h): uint8
    (h,w), where 0 is left out and 255 is not. A bad mask is told."""
    w, h = size
    mask = np.full((h, w), 255, np.uint8)
    for file in [photo, path] if path else [photo]:
        try:
            layer = read_opaque(file, file is path)
            if layer is not None:
                check(layer.any(), "is black or transparent all over; 255 is white")
                height, width = layer.shape
                check(abs(width * h / (height * w) - 1) < 0.02,
                      f"has {width} x {height} pixels, its photo {w} x {h}")
                mask *= cv2.resize(layer.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        except UserError as e:
            warn(f"mask not used: {file} {e}")
    return mask


# ---- prepare ---------------------------------------------------------------------------
def read_usable(model, points, rows, is_held_out, downscale):
    """The photos that can be used, sorted by name. Prints which cannot, and why. Of photos with
    the same pixels one is used for training, or none if one is held out."""
    masks = mask_files(model.images, model.files)
    photos = []
    first = {}  # by hash of pixels: name of the first photo that has them
    misfits = 0  # photos that miss most of the points that they should see
    names = sorted(is_held_out, key=lambda name: (not is_held_out[name], name))
    for name in progress(names, "preparing photos"):
        is_test = is_held_out[name]
        try:
            check(name in model.photos, f"has no pose{name_hint(name, model.files)}")
            check(name in model.files, f"is not on disk{name_hint(name, model.on_disk)}")
            camera, pose, ids = model.photos[name]
            check_photo(camera, pose, is_test)
            image = read_photo(model.files[name], camera[0])
            pixels = hash(image.tobytes())
            twin = first.get(pixels)
            check(is_test or not twin, f"is the same photo as {twin}")
            image, K = shrink(image, camera, downscale)
            c2w = camera_to_world(pose)
            track = np.array([rows[key] for key in ids if key in rows], int)
            uv, _ = project(K, c2w, points[track, :3])
            is_inside = ((uv >= 0) & (uv < image.shape[1::-1])).all(1)
            share = is_inside.mean() if len(track) else 1
            misfits += share < 0.5
            check(share >= 0.5, f"shows {share:.0%} of its points: wrong pose or distortion")
            first.setdefault(pixels, name)
            mask = read_mask(model.files[name], masks.get(name), camera[0])
            mask, _ = shrink(mask, camera, downscale)
            photos.append(Photo(name, image[..., ::-1], mask < 128, K, c2w, track, is_test))
        except UserError as e:
            warn(f"left out: {name} {e}")
    check(misfits <= len(photos),
          f"{misfits} of {misfits + len(photos)} photos miss most of their points: give poses as "
          "COLMAP does, world to camera, x right, y down, z forward, in the units of the points")
    used = {photo.name for photo in photos}
    lost = [name for name in names if is_held_out[name] and name not in used]
    check(not lost, f"held-out photos cannot be used, repair them or hold out others: {lost}")
    count = sum(not photo.is_test for photo in photos)
    check(count >= 2, f"{count} usable training photos are too few: repair them or the split file")
    return sorted(photos, key=lambda photo: photo.name)


def check_sphere(scene):
    """Prints size and content of the sphere; UserError if points and poses disagree."""
    seen = [scene["track_uv"][scene["track_photo"] == i] for i in np.unique(scene["track_photo"])]
    check(np.median([np.std(uv, axis=0).max() for uv in seen]) > 0.02,
          "the points of a photo lie on one spot of it: give poses in the units of the points")
    inside = (lengths(scene["points"]) < 1).mean()
    print(f"the sphere has a radius of {scene['scale']:.3g} units of the reconstruction; "
          f"{inside:.0%} of the points are inside")
    place, forward = scene["c2w"][:, :, 3], scene["c2w"][:, :, 2]
    looks_out = (lengths(place) < 1) & ((place * forward).sum(1) > 0)  # the centre is behind
    if looks_out.mean() > 0.3:
        warn(f"{looks_out.sum()} of {len(place)} cameras look outwards from within the sphere, as "
             "in a room: expect poor geometry; this method is for a landmark seen from outside")


def prepare(name, downscale=2, split=None):
    """Scene of one of SCENES, or of a folder with photos and a COLMAP model; see FORMAT."""
    folder = Path(name)
    if name in SCENES:
        homes = [DATA / name, DATA / SCENES[name][0]]
        folder = next(filter(Path.is_dir, homes), None)
        check(folder, f"{homes[0]} is missing: run python data_prep.py {name} --download")
    split = split and os.path.abspath(split)
    model = find_model(folder)
    info = dict(
        scene=folder.resolve().name, kind="colmap", downscale=downscale, folder=str(folder),
        images=str(model.images), posed=sorted(model.photos), split=split)
    info["files"] = fingerprint(info)
    tables = split_files(folder, split)
    is_held_out = dict.fromkeys(model.files, False)
    if tables:
        is_held_out = read_split(tables, model.files)
    points, rows = read_points(model.sparse)
    photos = read_usable(model, points, rows, is_held_out, downscale)
    if not tables:
        print(f"{folder} has no split file: every eighth photo is held out")
        for photo in photos[7::8]:
            photo.is_test = True
    scene = build_scene(photos, points, info)
    if "masked" in scene:
        count = sum(photo.masked.any() for photo in photos)
        print(f"masks leave out {scene['masked'].mean():.0%} of all pixels, in {count} of "
              f"{len(photos)} photos")
    check_sphere(scene)
    return scene


def scene_path(name_or_folder):
    """data/<scene>.npz; folders get a suffix, so that two of one name do not share a file."""
    folder = Path(name_or_folder).resolve()
    is_known = name_or_folder in ("toy", *SCENES)
    mark = "" if is_known else f"-{zlib.crc32(os.fsencode(folder)):08x}"
    return DATA / f"{folder.name[:50]}{mark}.npz"  # a file's name has 255 bytes at most


def open_scene(name_or_folder, downscale=2):
    """Scene from its file: made on first use, and anew if the content of a source differs. Where
    the sources are gone the file is all that is needed."""
    path = scene_path(name_or_folder)
    split = None
    if path.exists():
        scene = read_scene(path)
        info = json.loads(str(scene["info"]))
        split = info["split"]  # named once, by --split
        if info["kind"] == "toy":
            return scene
        is_gone = not os.path.isdir(info["folder"])
        if info["downscale"] == downscale and (is_gone or info["files"] == fingerprint(info)):
            return scene
        check(not is_gone, f"{path} has --downscale {info['downscale']} and its photos are gone: "
              "give that")
    print(f"making {path}")
    scene = make_toy() if name_or_folder == "toy" else prepare(name_or_folder, downscale, split)
    write_scene(path, scene)
    return scene


# ---- the toy: z up, front towards -y, in its own units ---------------------------------
FACADE = -1  # the number of the landmark that is seen from the front alone
# Arbitrary: centre and scale of the scene must be recovered.
TOY_SCALE = 3.7
TOY_ORIGIN = np.array([12.0, -7.0, 5.0])
SUN = np.array([-0.50, -0.62, 0.60])  # left, behind the tourists
SUN /= np.linalg.norm(SUN)
# Linear colour; width and height of a stone, or of the wall around a window; their contrast.
MATERIALS = dict(
    stone=((0.5, 0.46, 0.4), (0.29, 0.13), 0.2),
    pale=((0.8, 0.74, 0.6), (0.29, 0.13), 0.08),
    sand=((0.78, 0.56, 0.3), (0.3, 0.3), 0.15),
    brick=((0.52, 0.19, 0.11), (0.3, 0.3), 0.15),
    tiles=((0.6, 0.22, 0.12), (0.16, 0.08), 0.3),
    slate=((0.12, 0.19, 0.31), (0.2, 0.1), 0.25),
    copper=((0.16, 0.46, 0.36), (0.5, 0.5), 0.4),
    gold=((0.9, 0.58, 0.08), (0.5, 0.5), 0),
    plaster=((0.6, 0.46, 0.34), (0.62, 0.62), 0.15),
    leaf=((0.1, 0.22, 0.05), (0.2, 0.2), 0.45),
    paving=((0.48, 0.42, 0.34), (0.42, 0.42), 0.2),
    meadow=((0.17, 0.22, 0.08), (0.6, 0.6), 0.1))


class Part(NamedTuple):
    shape: str  # "ground" (up to a radius), "ball", "column" (or cone), "box" (or roof)
    group: str  # parts that stand on each other
    material: str
    center: tuple
    half: tuple  # half width (or radius) at the bottom, half depth, half height
    top: float  # half width at the top


LANDMARK = [
    Part("box", "plinth", "stone", center=(-.01, -.03, .05), half=(.96, .53, .05), top=.96),
    Part("box", "plinth", "stone", center=(-.05, 0, .15), half=(.85, .47, .05), top=.85),
    *[Part("column", "hall", "pale", center=(x, -.34, .47), half=(.062, .062, .27), top=.05)
      for x in np.linspace(-.54, .60, 6)],
    Part("box", "hall", "sand", center=(.03, .2, .53), half=(.59, .26, .33), top=.59),
    Part("box", "hall", "pale", center=(.03, .03, .8), half=(.67, .46, .06), top=.67),
    Part("box", "hall", "tiles", center=(.03, .03, .98), half=(.71, .48, .12), top=0),
    Part("column", "dome", "sand", center=(-.05, .22, 1.07), half=(.33, .33, .17), top=.31),
    Part("ball", "dome", "copper", center=(-.05, .22, 1.24), half=(.3, .3, .3), top=.3),
    Part("column", "dome", "pale", center=(-.05, .22, 1.57), half=(.075, .075, .07), top=.065),
    Part("column", "dome", "copper", center=(-.05, .22, 1.7), half=(.1, .1, .06), top=.02),
    Part("ball", "dome", "gold", center=(-.05, .22, 1.78), half=(.045, .045, .045), top=.045),
    Part("box", "tower", "brick", center=(.87, .18, .53), half=(.17, .17, .53), top=.17),
    Part("box", "tower", "pale", center=(.87, .18, 1.1), half=(.2, .2, .04), top=.2),
    Part("column", "tower", "slate", center=(.87, .18, 1.32), half=(.2, .2, .18), top=0),
    Part("box", "annex", "brick", center=(-.76, .24, .38), half=(.19, .25, .18), top=.19),
    Part("box", "annex", "slate", center=(-.76, .24, .65), half=(.23, .28, .09), top=0),
    Part("box", "statue", "pale", center=(-.8, -.35, .28), half=(.09, .09, .08), top=.09),
    Part("column", "statue", "copper", center=(-.8, -.35, .48), half=(.07, .07, .12), top=.04),
    Part("ball", "statue", "copper", center=(-.8, -.35, .64), half=(.055, .055, .055), top=.055)]
# A palace around a court that opens to the tourists: nothing stands in its middle.
PALACE = [
    Part("box", "palace", "stone", center=(0, .06, .03), half=(1, .64, .03), top=1),
    Part("box", "palace", "sand", center=(0, .56, .45), half=(.95, .1, .42), top=.95),
    *[Part("column", "palace", "pale", center=(x, .38, .42), half=(.055, .055, .36), top=.045)
      for x in np.linspace(-.5, .5, 6)],
    Part("box", "palace", "pale", center=(0, .46, .83), half=(.62, .16, .05), top=.62),
    Part("box", "palace", "tiles", center=(0, .46, .98), half=(.66, .18, .1), top=0)]
for x in (-.82, .82):
    PALACE += [
        Part("box", "palace", "brick", center=(x, .02, .36), half=(.16, .5, .33), top=.16),
        Part("box", "palace", "slate", center=(x, .02, .77), half=(.2, .54, .08), top=0)]
TOWN = [
    Part("ground", "town", "paving", center=(0, 0, 0), half=(2.6, 2.6, 0), top=2.6),
    Part("ground", "town", "meadow", center=(0, 0, 0), half=(np.inf, np.inf, 0), top=np.inf)]
for x, y, wide, tall in [  # a house: half width, half height; a tree stands before it
    (-7.5, 2, .6, .75), (-6.2, 4.4, .5, .55), (-4, 6.4, .8, .9), (-1.2, 7.6, .5, 1.15),
    (2, 6.8, .7, .7), (4.6, 5.6, .5, .95), (6.8, 3, .6, .65), (7.4, 0, .5, .85),
]:
    crown = 0.8 * wide
    tree = (.8 * x + 1, .7 * y, crown + .2)
    TOWN += [
        Part("box", "town", "plaster", center=(x, y, tall), half=(wide, wide, tall), top=wide),
        Part("box", "town", "slate", center=(x, y, 2 * tall + .25), half=(wide, wide, .25), top=0),
        Part("ball", "town", "leaf", center=tree, half=(crown, crown, crown), top=crown)]


def toy_parts(landmark, background=True):
    """The parts of a landmark, every number another building, and of the town around."""
    town = TOWN if background else []
    if landmark in (0, FACADE):
        return {0: LANDMARK, FACADE: PALACE}[landmark] + town
    rng = np.random.default_rng([landmark, 1])
    parts = list(LANDMARK)
    # Random proportions, moved a little; the dome also with the hall.
    for groups in [("hall", "dome"), ("dome",), ("tower",), ("annex",), ("statue",)]:
        size = rng.uniform(0.7, 1.2, 3)
        shift = np.append(rng.uniform(-0.06, 0.06, 2), 0)
        chosen = {i: part for i, part in enumerate(parts) if part.group in groups}
        lowest = parts[min(chosen)]
        foot = np.mean([part.center for part in chosen.values()], axis=0)
        foot[2] = lowest.center[2] - lowest.half[2]
        for i, part in chosen.items():
            grow = size if part.shape == "box" else size[[2, 2, 2]]  # others stay round
            center = foot + (part.center - foot) * size + shift
            parts[i] = part._replace(center=center, half=part.half * grow, top=part.top * grow[0])
    mirror = np.array([rng.choice((-1, 1)), 1, 1])
    material = {"gold": "gold"}
    for names in [("stone", "pale"), ("sand", "brick"), ("tiles", "slate", "copper")]:
        material |= dict(zip(names, rng.permutation(names)))
    return [part._replace(center=part.center * mirror, material=material[part.material])
            for part in parts] + town


def part_sdf(part, x):
    """Signed distance to a part, + and exact outside. (P,3) -> (P,)"""
    x, y, z = (x - part.center).T
    if part.shape == "ground":
        return z  # as if it had no edge: there is ground all around
    if part.shape == "ball":
        return np.hypot(np.hypot(x, y), z) - part.half[0]
    # Distance d to the profile, a trapezoid in (u, z). u: from the axis, for a box |x|.
    u = abs(x) if part.shape == "box" else np.hypot(x, y)
    bottom, half_depth, half_height = part.half
    slant = part.top - bottom
    height = 2 * half_height
    k = ((u - bottom) * slant + (z + half_height) * height) / (slant ** 2 + height ** 2)
    k = np.clip(k, 0, 1)  # the nearest point of the side: 0 at the bottom, 1 at the top
    side_u = u - bottom - k * slant
    side_z = z + half_height - k * height
    cap_u = np.maximum(u - np.where(z < 0, bottom, part.top), 0)
    cap_z = abs(z) - half_height
    d = np.minimum(np.hypot(side_u, side_z), np.hypot(cap_u, cap_z))
    d = np.where((side_u < 0) & (cap_z < 0), -d, d)
    if part.shape == "column":
        return d
    e = abs(y) - half_depth  # a box extrudes the profile along y
    outside = np.hypot(np.maximum(d, 0), np.maximum(e, 0))
    return outside + np.minimum(np.maximum(d, e), 0)


def toy_sdf(x_world, background=True, landmark=0):
    """Signed distance to the toy, + and exact outside, SfM units. (P,3) -> (P,)"""
    x = (x_world - TOY_ORIGIN) / TOY_SCALE
    distances = [part_sdf(part, x) for part in toy_parts(landmark, background)]
    return np.min(distances, axis=0) * TOY_SCALE


def gradient(sdf, x, step):
    """Gradient of a distance function at x (P,3), by central differences. -> (P,3)"""
    rise = [sdf(x + axis) - sdf(x - axis) for axis in step * np.eye(3)]
    return np.stack(rise, axis=1) / (2 * step)


@np.errstate(divide="ignore", invalid="ignore")  # rays that miss, or are parallel
def intersect_part(part, o, d):
    """Distances (R,) at which rays o, d (R,3) enter a part; inf for a miss. A part is a quadric,
    round in the first n coordinates, with a radius linear in z; a slab cuts it in each other
    coordinate. A roof has n = 1, a cone n = 2, a ball n = 3."""
    o = o - part.center
    if part.shape == "ground":
        t = -o[:, 2] / d[:, 2]
        from_center = lengths((o + t[:, None] * d)[:, :2])
        return np.where((d[:, 2] < -1e-3) & (from_center < part.half[0]), t, np.inf)
    n = {"box": 1, "column": 2, "ball": 3}[part.shape]
    slope = (part.top - part.half[0]) / part.half[2] / 2
    rise = slope * d[:, 2]
    radius = (part.half[0] + part.top) / 2 + slope * o[:, 2]  # where the ray starts
    a = (d[:, :n] ** 2).sum(1) - rise ** 2
    b = (d[:, :n] * o[:, :n]).sum(1) - rise * radius
    c = (o[:, :n] ** 2).sum(1) - radius * radius
    root = np.sqrt(b * b - a * c)  # inside where a t^2 + 2 b t + c < 0; nan for a miss
    # a < 0: the radius grows faster than the ray leaves the axis: one end stays inside.
    enter = np.where((a < 0) & (rise < 0), -np.inf, (-b - root) / a)
    leave = np.where((a < 0) & (rise > 0), np.inf, (-b + root) / a)
    for axis in range(n, 3):
        middle = -o[:, axis] / d[:, axis]
        reach = abs(part.half[axis] / d[:, axis])
        enter = np.maximum(enter, middle - reach)
        leave = np.minimum(leave, middle + reach)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def trace(o, d, parts):
    """First hits of rays o, d (R,3) or (1,3) -> distance, inf is sky; part's number (R,)"""
    enter = np.stack([intersect_part(part, o, d) for part in parts])
    return enter.min(0), enter.argmin(0)


def sky_color(d, weather):
    """Linear colour of the sky and two ranges of hills. d (R,3) -> (R,3)"""
    up = d[:, 2:]
    azimuth = np.arctan2(d[:, :1], d[:, 1:2])
    *tint, phase = weather
    cloud = np.sin(5 * azimuth + 9 * phase) * np.sin(12 * up + 7 * phase)
    color = (0.58, 0.68, 0.78) - np.clip(up * 1.5, 0, 1) * (0.52, 0.46, 0.26)
    color += 0.4 * np.array(tint) + 0.5 * abs(phase) * np.maximum(cloud, 0)
    for height, amplitude, waves, hill in [(0.11, 0.045, 5, (0.25, 0.33, 0.45)),
                                           (0.06, 0.03, 9, (0.11, 0.18, 0.16))]:
        ridge = np.sin(waves * azimuth + height * 40) + 0.6 * np.sin(2.3 * waves * azimuth)
        color = np.where(up < height + amplitude * ridge, hill, color)
    return color


def surface_color(part, x):
    """Linear colours at points on a part: stones, or walls with windows. (P,3) -> (P,3)"""
    x, y, z = x.T
    angle = np.arctan2(y - part.center[1], x - part.center[0])
    across = {"ground": x, "box": x + y, "column": angle, "ball": angle}[part.shape]
    up = y if part.shape == "ground" else z
    color, (width, height), contrast = MATERIALS[part.material]
    row = up / height
    column = across / width
    has_windows = part.material in ("sand", "brick", "plaster")
    is_window = has_windows & (abs(column % 1 - 0.5) < 0.2) & (abs(row % 1 - 0.45) < 0.28)
    if not has_windows:
        column += np.floor(row) % 2 / 2  # every other row of stones is shifted
    # A random number per cell: the hash by a sine that shaders use.
    chance = np.sin(12.9898 * np.floor(column) + 78.233 * np.floor(row))
    chance = abs(chance) * 437.585 % 1
    brightness = (1 + contrast * (2 * chance - 1)) * np.where(is_window, 0.2, 1)
    return color * brightness[:, None]


def shade(o, d, parts, background, sun, weather):
    """Linear colours along rays, in 0..1: sun, shadow, light of the sky, haze.
    o (1,3), d (R,3), sun (3,) -> (R,3)
    weather (4,): RGB tint of the sky and cloud phase, each in -sky..sky of make_toy."""
    color = sky_color(d, weather) * background
    t, which = trace(o, d, parts)
    hit = np.flatnonzero(t < np.inf)
    t, which = t[hit, None], which[hit]
    x = o + t * d[hit]
    normal, surface = np.zeros((2, *x.shape))
    for i in np.unique(which):
        part = parts[i]
        here = which == i
        normal[here] = gradient(lambda x: part_sdf(part, x), x[here], 1e-5)
        surface[here] = surface_color(part, x[here])
    obstacle, _ = trace(x + 1e-4 * normal, sun[None], parts)
    sunlight = np.maximum(normal @ sun, 0) * (obstacle == np.inf)
    light = sunlight[:, None] * (1.15, 1.05, 0.88)
    light += (0.20 + 0.10 * normal[:, 2:]) * (0.8, 0.92, 1.15)
    clear = np.exp(-np.maximum(t - 5, 0) / 20)
    color[hit] = clear * surface * light + (1 - clear) * (0.42, 0.50, 0.58)
    return np.clip(color, 0, 1)


def toy_camera(rng, azimuth, size):
    """K (4,), c2w (3,4) in the toy's units, width and height of a tourist's camera. azimuth: its
    angle [rad] from the front."""
    aspect = rng.choice([4 / 3, 3 / 2, 1.1, 3 / 4, 2 / 3])
    w = round(size * min(1, aspect))
    h = round(size * min(1, 1 / aspect))
    angle = np.radians(rng.uniform(40, 65))  # of view, along the long side
    f = size / 2 / np.tan(angle / 2)
    target = (0, 0.05, 0.80) + rng.uniform(-0.12, 0.12, 3)
    away = np.array([np.sin(azimuth), -np.cos(azimuth), rng.uniform(-0.15, 0.45)])
    away = away * f / min(w, h) * rng.uniform(2.0, 2.6)
    place = target + away * rng.choice((0.8, 1), p=(0.1, 0.9))  # one in ten stands closer
    place[2] = max(place[2], 0.2)
    z = target - place
    z /= np.linalg.norm(z)
    x = np.cross(z, (*rng.normal(0, 0.03, 2), 1))  # hardly anyone holds it level
    x /= np.linalg.norm(x)
    c2w = np.stack([x, np.cross(z, x), z, place], 1)
    return (f, f, w / 2, h / 2), c2w, w, h


def draw_people(rng, w, h, share):
    """Passers-by on about `share` of the photo. -> (h*w,4): colour x opacity, opacity"""
    W, H = 4 * w, 4 * h  # drawn large, then averaged
    canvas = np.zeros((H, W, 4), np.float32)
    left = share
    while left > max(0.1 * share, 0.002):
        height = np.sqrt(left * W * H / 0.25) * rng.uniform(0.5, 1)
        height = np.clip(height, 0.12 * H, 0.95 * H)
        feet = rng.uniform((0, 0.8 * H), (W, H + 0.2 * height))
        # Most colours are vivid, black or white.
        coat, legs, thing, skin = 0.02 + 0.83 * rng.beta(0.4, 0.4, (4, 3))
        skin = (0.3 + skin[:1]) * (0.8, 0.6, 0.45)
        stripe = thing if rng.random() < 0.4 else coat
        stripes = zip((0.50, 0.56, 0.62, 0.68, 0.74), (coat, stripe, coat, stripe, coat))
        hand = rng.uniform((-0.25, 0.5), (0.25, 1.15))  # holds a bag, balloon or hat
        tip = hand + rng.uniform(-0.15, 0.15, 2)
        # From x y, to x y, width, in heights above the feet. Each covers those before it.
        for begin, end, width, color in [
            *[((x, 0.03), (x, 0.45), 0.10, legs) for x in (-0.06, 0.06)],
            *[((-0.05, y), (0.05, y), 0.16, color) for y, color in stripes],
            ((0, 0.92), (0, 0.92), 0.15, skin),
            (hand, tip, rng.uniform(0.08, 0.25), thing),
        ]:
            ends = feet + np.array([begin, end]) * (height, -height)
            cv2.line(canvas, *ends.astype(int), (*color, 1), int(width * height) + 1)
        left = share - canvas[..., 3].mean()
    small = cv2.resize(canvas, (w, h), interpolation=cv2.INTER_AREA)
    return small.reshape(-1, 4).astype(float)


def toy_points(rng, photos, surface, seen):
    """Points (P,5) of build_scene, noisy and 1.5 % of them wrong, as by SfM; sets tracks. For each
    photo, surface: points (h*w,3) of its pixels; seen: their distances (h*w,), inf at a person."""
    samples = []
    count = 3000 // len(photos)
    for x, t in zip(surface, seen):
        is_landmark = (abs(x - (0, 0, 1.02)) < (1.3, 1.3, 1)).all(1)
        for some, n in [(is_landmark, count), (~is_landmark, count // 5)]:
            pixels = np.flatnonzero(some & (t < 30))
            if len(pixels):
                samples.append(x[rng.choice(pixels, n)])
    x = np.concatenate(samples)
    for photo, t in zip(photos, seen):
        wh = photo.image.shape[1::-1]
        uv, distance = project(photo.K, photo.c2w, x)
        is_visible = abs(t[pixel_index(uv, wh)] / distance - 1) < 0.02
        is_found = rng.random(len(x)) < 0.6
        is_inside = ((uv >= 0) & (uv < wh)).all(1)
        photo.track = np.flatnonzero(is_inside & is_visible & is_found)
    is_wrong = rng.random((len(x), 1)) < 0.015
    x += is_wrong * rng.uniform(-1, 1, x.shape)
    x += rng.normal(0, 0.005, x.shape)
    track_length = count_sightings(photos, x)
    return np.column_stack([x * TOY_SCALE + TOY_ORIGIN, np.zeros(len(x)), track_length])


def add_pose_noise(rng, K, c2w, pixels):
    """Turns and moves c2w in place, in the toy's units, by `pixels` rms at the landmark."""
    # [rad]: rotation and shift in two axes each, so that 4 (pixels / 2)^2 = pixels^2.
    *turn, dx, dy = rng.normal(0, pixels / 2, 4) / K[0]
    c2w[:, 3] += c2w[:, :2] @ (dx, dy) * np.linalg.norm(c2w[:, 3])
    c2w[:, :3] @= cv2.Rodrigues((*turn, 0))[0]


def make_toy(seed=0, size=96, photos=48, test=8, occluders=0.05, exposure=1.0,
             pose_noise=0.0, background=True, landmark=0, sun=0.0, sky=0.0):
    """A synthetic scene. seed changes cameras, people and noise; only landmark the building.
    photos, test: number of training photos and of held-out photos
    size: long side of a photo [px]
    occluders: mean share of a training photo that people cover, 0 to 0.6
    exposure: spread of brightness, white balance and contrast; 1 as of tourists, 0 to 2
    pose_noise: of the training photos [px rms at the landmark]
    background: False leaves nothing but the landmark, before black
    landmark: another building for every number; -1 is a palace around an empty court,
        seen from the front within 120 degrees
    sun: its azimuth differs from photo to photo by up to so many degrees
    sky: how much its colour and clouds differ from photo to photo, 0 to 1"""
    info = dict(locals(), scene="toy", kind="toy", downscale=1, folder=None, split=None)
    check(
        seed >= 0 and size >= 16 and photos >= 4 and test >= 0 and landmark >= -1
        and 0 <= occluders <= 0.6 and 0 <= exposure <= 2 and 0 <= pose_noise < np.inf
        and 0 <= sun <= 180 and 0 <= sky <= 1,
        "occluders in 0..0.6, exposure 0..2, sun 0..180, sky 0..1, size >= 16, "
        "photos >= 4, landmark >= -1, others >= 0")
    # A generator per source of randomness: a knob leaves the random numbers of others alone.
    camera_rng, exposure_rng, people_rng, sfm_rng, pose_rng, sun_rng, sky_rng = [
        np.random.default_rng([seed, k]) for k in range(7)]
    count = photos + test
    numbers = np.arange(count)
    is_test = np.isin(numbers, (np.arange(test) + 0.5) * count // test)
    arc = 120 if landmark == FACADE else 200  # degrees around the landmark
    azimuth = arc * (numbers + camera_rng.uniform(0.1, 0.9, count)) / count - arc / 2
    share = people_rng.gamma(0.8 + 6 * occluders, size=count) * ~is_test
    share = np.minimum(share / share.sum() * photos * occluders, 0.85)
    turn = np.radians(sun_rng.uniform(-sun, sun, count))  # of the sun
    weather = sky_rng.uniform(-sky, sky, (count, 4))
    parts = toy_parts(landmark, background)
    taken, depth, surface, occluder = [], [], [], []
    for i in progress(numbers, "drawing photos"):
        camera = toy_camera(camera_rng, np.radians(azimuth[i]), size)
        K, c2w, w, h = camera
        o = c2w[None, :, 3]
        to_sun = cv2.Rodrigues((0, 0, turn[i]))[0] @ SUN
        samples = []
        for offset in itertools.product((0.25, 0.75), repeat=2):  # places in a pixel
            d = ray_directions(*camera, offset)
            samples.append(shade(o, d, parts, background, to_sun, weather[i]))
        people = draw_people(people_rng, w, h, share[i])
        linear = np.mean(samples, axis=0) * (1 - people[:, 3:]) + people[:, :3]
        brightness, red, blue, contrast = exposure * exposure_rng.uniform(-1, 1, 4)
        gain = 2 ** (brightness / 2) * np.array([1 + 0.1 * red, 1, 1 + 0.1 * blue])
        srgb = np.clip(linear * gain, 0, 1) ** (1.2 ** contrast / 2.2)
        image = (srgb * 255 + 0.5).astype(np.uint8).reshape(h, w, 3)
        masked = np.zeros((h, w), bool)
        taken.append(Photo(f"toy_{i:03d}.png", image, masked, K, c2w, None, is_test[i]))
        d = ray_directions(*camera)
        t, _ = trace(o, d, parts)
        depth.append(t)
        surface.append(o + t[:, None] * d)
        occluder.append(people[:, 3] > 0)
    seen = [np.where(people, np.inf, t) for people, t in zip(occluder, depth)]
    points = toy_points(sfm_rng, taken, surface, seen)
    for photo in taken:
        add_pose_noise(pose_rng, photo.K, photo.c2w, pose_noise * (not photo.is_test))
        photo.c2w[:, 3] = photo.c2w[:, 3] * TOY_SCALE + TOY_ORIGIN
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    corners = [part.center + part.half * signs for part in toy_parts(landmark, background=False)]
    scene = build_scene(taken, points, info, np.array(corners) * TOY_SCALE + TOY_ORIGIN)
    scene["depth"] = np.float16(np.concatenate(depth) * TOY_SCALE / scene["scale"])
    scene["occluder"] = np.concatenate(occluder)
    some = np.concatenate(surface)[::9]  # every ninth pixel; sky is infinite and drops out
    return scene | surface_truth(scene, some, background, landmark)


def surface_truth(scene, surface, background, landmark):
    """OPTIONAL arrays about surfaces, from visible points (P,3) in the toy's units."""
    center, scale = scene["center"], scene["scale"]

    def sdf(x):  # (P,3) -> (P,), scene units
        return toy_sdf(x * scale + center, background, landmark) / scale

    wall = (surface * TOY_SCALE + TOY_ORIGIN - center) / scale
    wall = wall[lengths(wall) < 0.95]
    normal = gradient(sdf, wall, 0.004)
    is_smooth = abs(lengths(normal) - 1) < 0.01
    near = wall + np.random.default_rng(0).normal(0, 0.02, wall.shape)
    distance = sdf(near)
    is_near = abs(distance) < 0.05
    return dict(wall=wall[is_smooth], wall_normal=normal[is_smooth],
                near_wall=near[is_near], near_wall_sdf=distance[is_near])


def depth_edges(depth):
    """Whether a pixel of depth (H,W), distances along rays, lies beside a jump: the second
    difference of inverse depth, nearly 0 on a plane, exceeds 5 % of the largest of the three."""
    inverse = 1 / depth.astype(np.float32)  # 0: sky
    edges = np.zeros(depth.shape, bool)
    for q, is_edge in (inverse, edges), (inverse.T, edges.T):  # down, then across
        before, here, after = q[:-2], q[1:-1], q[2:]
        bend = np.abs(2 * here - before - after)
        is_edge[1:-1] |= bend > 0.05 * np.maximum(here, np.maximum(before, after))
    return edges


def toy_truth(scene, sdf, gradient, mask=None):
    """What only a toy can tell of a trained model. sdf (.,): its signed distance at near_wall;
    gradient (.,3): the slope of that at wall; mask (P,): its M at all pixels of training photos.
    sdf_error is the mean |s - s_true| near visible walls in scene units, normal_error the median
    angle at walls in degrees. mask_iou compares M > 0.5 with the true people. False positives are
    the mean M on static pixels: mask_static on all, mask_edges on those beside a jump of depth,
    mask_flat on the others, mask_sky on the sky. None where nothing is to be measured."""
    size = np.maximum(lengths(gradient) * lengths(scene["wall_normal"]), EPSILON)
    cos = (gradient * scene["wall_normal"]).sum(1) / size
    truth = dict(
        sdf_error=float(np.abs(sdf - scene["near_wall_sdf"]).mean()),
        normal_error=float(np.median(np.degrees(np.arccos(np.clip(cos, -1, 1))))))
    truth |= dict.fromkeys(["mask_iou", "mask_static", "mask_edges", "mask_flat", "mask_sky"])
    if mask is None:
        return truth
    is_train = np.repeat(~scene["is_test"], np.diff(scene["start"]))  # by pixel
    people = scene["occluder"][is_train]
    depths = zip(np.split(scene["depth"], scene["start"][1:-1]), scene["wh"])
    edges = [depth_edges(depth.reshape(h, w)).ravel() for depth, (w, h) in depths]
    edges = np.concatenate(edges)[is_train]
    is_sky = np.isinf(scene["depth"][is_train])
    for region, pixels in dict(static=True, edges=edges, flat=~edges, sky=is_sky).items():
        static = mask[~people & pixels]
        if len(static):
            truth[f"mask_{region}"] = float(static.mean())
    if people.any():
        found = mask > 0.5
        truth["mask_iou"] = float((found & people).sum() / (found | people).sum())
    return truth


# ---- download, SfM, command line -------------------------------------------------------
def fetch(folder_url, path):
    """Streams the file of path's name into path, unless that exists. The part that came of a
    broken transfer waits in path.part to be continued."""
    if path.exists():
        return
    url = folder_url + path.name
    partial = path.with_name(path.name + ".part")
    path.parent.mkdir(exist_ok=True)
    try:
        with open(partial, "ab") as file:
            # Ask for the last byte again: past the end of a complete file a server answers 416.
            have = max(file.tell() - 1, 0)
            request = Request(url, headers={"Range": f"bytes={have}-"})
            with urlopen(request, timeout=60) as answer:
                if answer.status != 206:
                    have = 0  # a server without ranges starts over
                total = have + int(answer.headers["Content-Length"])
                file.truncate(have)
                for _ in progress(range(have, total, 1 << 20), f"MiB of {path.name}"):
                    have += file.write(answer.read(1 << 20))
        check(have == total, "it ended early")
        partial.replace(path)
    except Exception as e:  # of the disk, the network or its protocol
        if getattr(e, "code", 0) == 416:  # longer than the file itself
            partial.unlink()
        raise UserError(f"the download of {url} broke ({e}); the same command continues it") from e


def download(name):
    """Downloads photos, reconstruction and split file of one of SCENES -> data/<name>/"""
    check(name in SCENES, f"--download knows {', '.join(SCENES)}, not {name}")
    inner, split = SCENES[name]
    folder = DATA / name
    archive = DATA / f"{inner}.tar.gz"
    check(not folder.exists(), f"{folder} is there already: move it, or leave --download out")
    fetch(SPLIT_URL, DATA / split)
    fetch(ARCHIVE_URL, archive)
    wanted = (f"{inner}/dense/images/", f"{inner}/dense/sparse/")
    # A damaged archive can fail in any layer.
    advice = "free space, or delete it and retry"
    with (as_user_error(Exception, f"cannot unpack {archive}", advice),
          tempfile.TemporaryDirectory(dir=DATA) as temporary):
        with gzip.open(archive) as raw, tarfile.open(fileobj=raw, mode="r|") as tar:
            # Files only: a link could lead outside.
            files = (item for item in tar if item.isfile() and item.name.startswith(wanted))
            tar.extractall(temporary, files, filter="data")
            while raw.read(1 << 20):  # to the checksum at the very end
                pass
        shutil.copy(DATA / split, Path(temporary, inner, split))
        Path(temporary, inner).replace(folder)


def sfm_photos(images):
    """{name: path} of raw photos, all of which pycolmap can read."""
    files = photo_files(images)
    for name, path in list(files.items()):
        is_text = name == name.encode(errors="replace").decode()
        check(is_text, f"the name {name!a} is not UTF-8: rename the photo")
        check(not starts_with(path, HEIC), f"{name} is HEIC: convert all such photos to JPEG")
        if not starts_with(path, b"."):
            warn(f"left out: {name} is empty, a broken link or may not be read")
            del files[name]
    check(files, f"{images} has no photos of a known type: name the folder that holds them")
    return files


def write_sfm_masks(files, masks, folder):
    """Writes masks in the photos' sizes under COLMAP's names, photo.jpg.png, white ones for photos
    without: COLMAP 4 wants one for each photo or none. Returns whether any pixel is left out."""
    is_needed = False
    for name, path in progress(files.items(), "looking for masks"):
        try:
            photo = read_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        except UserError as e:
            warn(f"{name} {e}")
            continue
        mask = read_mask(path, masks.get(name), photo.shape[1::-1])
        is_needed |= not mask.all()
        write_png(folder / f"{name}.png", np.stack([mask] * 3, axis=-1))
    return is_needed


def run_sfm(folder):
    """Finds the poses of the raw photos in a folder by pycolmap and writes folder/sparse/{0,1,...}.
    The database waits in data/ for a second try and goes after a success."""
    images = folder / "images"
    if not images.is_dir():
        images = folder
    sparse = folder / "sparse"
    check(not sparse.exists() and not (folder / "dense").exists(),
          f"{folder} has sparse/ or dense/, a model: leave --sfm out, or delete that")
    files = sfm_photos(images)
    masks = mask_files(images, files)
    missing_or_old = (ImportError, AttributeError)
    with as_user_error(missing_or_old, "--sfm needs pycolmap", 'run pip install "pycolmap>=3.13"'):
        import pycolmap  # an extra
        reader = pycolmap.ImageReaderOptions()
        features = pycolmap.FeatureExtractionOptions()
        matching = pycolmap.FeatureMatchingOptions()
    work = DATA / f"sfm-{checksum([*files.values(), *masks.values()]):08x}"
    database = work / "database.db"
    (work / "masks").mkdir(parents=True, exist_ok=True)
    if write_sfm_masks(files, masks, work / "masks"):
        reader.mask_path = work / "masks"
    # Of 135 photos of a statue in all lights these options pose 104 in one model, not 60.
    features.sift.estimate_affine_shape = True
    features.sift.domain_size_pooling = True
    matching.guided_matching = True
    with tempfile.TemporaryDirectory(prefix=".sparse", dir=folder) as temporary:
        models = Path(temporary, "models")
        models.mkdir()
        advice = f"delete {work}, which may be damaged, and retry"
        with as_user_error((RuntimeError, ValueError), "pycolmap failed", advice):
            pycolmap.extract_features(database, images, sorted(files), reader_options=reader,
                                      extraction_options=features)
            pycolmap.match_exhaustive(database, matching_options=matching)
            found = pycolmap.incremental_mapping(database, images, models)
        check(found, f"the photos in {folder} do not match: take more, with more overlap")
        models.rename(sparse)
    shutil.rmtree(work)


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False, argument_default=argparse.SUPPRESS)
    add = parser.add_argument
    add("scene", help=f"toy, {', '.join(SCENES)}, or a folder")
    add("--download", action="store_true", help="fetch archive and split file first")
    add("--sfm", action="store_true", help="the folder has raw photos: pose them first")
    add("--downscale", type=int, help="photos get this many times smaller; default 2")
    add("--split", help="default: a .tsv, .csv or train_list.txt in it, or every 8th photo")
    knobs = inspect.signature(make_toy).parameters
    for key, knob in knobs.items():
        options = {"type": type(knob.default)}
        if isinstance(knob.default, bool):
            options = {"action": argparse.BooleanOptionalAction}
        add(f"--{key}", help=f"toy, default {knob.default}", **options)
    given = vars(parser.parse_args(argv))
    name, is_download, is_sfm = [given.pop(key, None) for key in ("scene", "download", "sfm")]
    path = scene_path(name)
    allowed = knobs if name == "toy" else ("downscale", "split")
    wrong = given.keys() - allowed
    check(not wrong, f"--{' --'.join(wrong)}: not for {name}")
    if is_download:
        download(name)
    if is_sfm:
        run_sfm(Path(name))
    scene = make_toy(**given) if name == "toy" else prepare(name, **given)
    write_scene(path, scene)
    print(f"{path}: {len(scene['wh'])} photos, {scene['is_test'].sum()} of them for testing")


if __name__ == "__main__":
    run_command_line(main)
