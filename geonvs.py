"""Geo-NVS-w: a signed distance field, fed by tourist photos, becomes a picture from a new view.

A minimal single-file reference implementation of "Geo-NVS-w: Geometry-Aware Novel View Synthesis
In-the-Wild with an SDF Renderer" (Tsalakopoulos et al., ICCV 2025 workshops). Read it from the top:
the sections follow one ray from the pixel to the loss, then the training loop around it.

    python geonvs.py                       toy scene: made, trained, scored (minutes, 2 CPU cores)
    python geonvs.py --scene brandenburg   a Phototourism scene (one GPU); also sacre, trevi, taj
    python geonvs.py --data DIR            your own COLMAP folder
    torchrun --nproc_per_node 4 geonvs.py  on 4 GPUs that share the rays of each step
    python geonvs.py --help                every setting with its meaning, unit and source

A run writes runs/<name>/: metrics.json, log.jsonl, checkpoint.pt, panel.png and a mesh.ply.

Sections: 1 config, 2 scene and rays, 3 octree, 4 fields, 5 from SDF to colour, 6 mask and GPL,
7 model and objective, 8 baselines, 9 energy, 10 training, 11 scoring, 12 experiments, 13 commands.

Conventions, stated once
  world     the foreground is the unit sphere; x_file = x * scale + center leads back to SfM units
  cameras   c2w (3,4) camera to world, OpenCV axes: x right, y down, z forward; pixel centres +0.5
  rays      r(t) = o + t d with |d| = 1, so t is a distance along the ray and not a z-depth
  sdf       positive outside; the normal is the unit gradient; colours are sRGB in [0, 1]
  mask      M = 1 means transient (person, car), M = 0 means scene
  shapes    R rays, S samples per ray, P points, L octree levels, C channels per level,
            V octree corners, A appearance dims, I photos, K sparse points, T sightings of them

Where the printed paper is departed from, the line carries its tag:
  [D1]  alpha is divided by sigmoid(zeta s_prev) and never negative (printed: a wall is 63 % opaque)
  [D2]  the slope correction sits inside zeta, with opposite signs for the two ends of a section
  [D3]  Phi uses NeuS-weighted errors, |lap| times eps, batch-quantile calibration, and is detached
  [D4]  the curvature loss is |lap| times eps: |lap| of a trilinear field grows as eps shrinks
  [D5]  the Lipschitz term is a sum of logs, not a product that can drown the colour at first
  [D6]  CGNet: GroupNorm for BatchNorm, half the width, negative first bias, head at half resolution
  [D7]  the mask pays mean M, not mean M^2, to go with an L1 error, above what SfM pixels err by
  [D8]  the background starts where the ray leaves the sphere and its last section is opaque
  [D9]  the SDF branch stays in float32 under mixed precision: half precision makes noise of normals
  [D10] SfM points place the sphere, seed the octree, pull |s(p)| to zero and teach M = 0
  [D11] samples are drawn from a cached SDF volume; no second network pass along the ray
  [D12] test photos: appearance fitted on the left half, scored on the right half
  [D13] exact normals by the trilinear weights, curvature where a ray ends; --normals fd: as printed
  [D14] the mask learns every few steps, by a logistic surrogate, from averaged errors of photos
"""
from __future__ import annotations

import argparse, contextlib, csv, datetime, difflib, functools, io, itertools, json, math, os
import shutil, signal, subprocess, sys, threading, time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, fields
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.distributed as dist
import torch.nn.functional as F
from skimage.measure import marching_cubes
from skimage.metrics import structural_similarity
from torch import Tensor, nn

import data_prep
from data_prep import UserError, atomic_write, need

torch.set_float32_matmul_precision("highest")  # [D9] no TF32, which some containers switch on


# ---- 1 Config: every field is a flag -------------------------------------------------------------

def opt(default, text, *choices):
    return field(default=default, metadata={"help": text, "choices": choices or None})


@dataclass
class Config:
    """All settings. [R] marks a value that the paper leaves open (recommended by predecessors)."""

    scene: str = opt("toy", "synthetic, or of Phototourism", "toy", *data_prep.SCENES)
    data: str = opt("", "an IMC-PT or COLMAP folder instead of a named scene")
    method: str = opt("geonvsw", "which model to train", "geonvsw", "nerfw", "hanerf")
    preset: str = opt("default", "quality against speed: see PRESETS", "fast", "default", "best")
    tuned: bool = opt(False, "the method's settings that serve the toy best in a few minutes")
    name: str = opt("", "run folder below runs/ (default: scene-method-seed)")
    seed: int = opt(0, "seed of everything random")
    device: str = opt("auto", "auto, cpu, cuda or cuda:N")
    steps: int = opt(4000, "training steps")
    minutes: float = opt(0.0, "training budget in minutes, instead of --steps if above 0")
    downscale: int = opt(2, "integer factor by which photos are made smaller (benchmarks use 2)")
    rays: int = opt(512, "rays per step, of all processes together")
    photos: int = opt(8, "photos per step; the mask network sees these whole")
    samples: int = opt(16, "foreground samples per ray")
    bg_samples: int = opt(16, "background samples per ray")
    levels: int = opt(0, "octree levels, 0: from the pixel footprint at the surface")
    grid: str = opt("octree", "uniform: the same finest cell everywhere", "octree", "uniform")
    split_error: float = opt(2.0, "times the lower quartile of all rays' errors splits a cell")
    max_mb: float = opt(1000.0, "memory up to which the foreground octree may grow, MiB")
    bg_levels: int = opt(3, "octree levels of the background")
    channels: int = opt(4, "feature channels per octree level")
    hidden: int = opt(64, "width of the MLPs")
    appearance_dim: int = opt(16, "length of a photo's appearance code")
    appearance: str = opt("auto", "codes; auto: on if exposures differ", "auto", "on", "off")
    mask: str = opt("auto", "mask; auto: off if nothing is transient", "auto", "on", "off")
    background: str = opt("auto", "field; auto: off if it is one colour", "auto", "on", "off")
    mask_every: int = opt(4, "steps from one run of the mask network to the next [D14]")
    mask_px: int = opt(96, "side of the square photo that the mask network sees, px")
    normals: str = opt("analytic", "derivatives of the SDF [D13]", "analytic", "fd")
    sampling: str = opt("cached", "how samples are placed [D11]", "cached", "uniform")
    alpha: str = opt("neus", "opacity of a section [D1] [D2]", "neus", "printed")
    gpl: str = opt("calibrated", "edge indicator Phi [D3]", "calibrated", "literal")
    lam_eik: float = opt(0.04, "weight of the eikonal loss (Permuto-SDF)")
    lam_curv: float = opt(1e-3, "weight of the curvature loss, on |lap| eps [D4] [R]")
    lam_gpl: float = opt(0.05, "weight of the geometry-preservation loss (paper)")
    lam_grad: float = opt(10.0, "weight of the eikonal error inside Phi (paper)")
    lam_lap: float = opt(2.0, "weight of the curvature inside Phi (the paper's lambda_curv = 2)")
    lam_lps: float = opt(1e-5, "weight of the Lipschitz loss, log form [D5] [R]")
    lam_off: float = opt(1e-3, "weight of the off-surface loss [R]")
    lam_sfm: float = opt(0.3, "weight of |s(p)| at SfM points [D10]")
    lam_mask: float = opt(0.04, "weight of mean M: the excess error that masks a pixel [D7]")
    lam_bimodal: float = opt(1e-4, "weight of the pull of M to 0 and 1 (Ha-NeRF's digit loss) [R]")
    lr_grid: float = opt(1e-2, "learning rate of octree features")
    lr_net: float = opt(2e-3, "learning rate of networks and codes")
    lr_zeta: float = opt(1e-3, "learning rate of the deviation network")
    curve: bool = opt(False, "record PSNR of held-out left halves over s and Wh, for --chart")
    amp: str = opt("auto", "mixed precision; auto: on a GPU [D9]", "auto", "on", "off")
    protocol: str = opt("half", "leaky: codes fitted on whole photos [D12]", "half", "leaky")


LARGE = dict(steps=300_000, rays=4096, photos=16, samples=32, bg_samples=16, appearance_dim=32)
# settings that differ from Config's defaults, by scene; flags override them
SCENES = {"toy": dict(steps=3000), **{name: LARGE for name in data_prep.SCENES}}
# factors on Geo-NVS-w's settings, from the front that --front measures: within a minute, steps of
# half the rays win over those of more rays or samples; beyond it, steps are what is left to buy
PRESETS = {"fast": dict(rays=0.5, steps=0.5), "default": {}, "best": dict(steps=3)}


# ---- 2 Scene file and rays -----------------------------------------------------------------------

class Scene(NamedTuple):
    """The arrays of a scene file (data_prep.py documents them) as tensors on the device."""

    rgb: Tensor  # (N,3) uint8, all pixels of all photos; stays on the host if too large for a GPU
    start: Tensor  # (I+1,) first pixel of each photo
    wh: Tensor  # (I,2) width, height in px
    K: Tensor  # (I,4) fx fy cx cy in px
    c2w: Tensor  # (I,3,4)
    near: Tensor  # (I,) smallest useful t
    is_test: Tensor  # (I,)
    points: Tensor  # (K,3) SfM points
    thumbs: Tensor  # (I,3,mask_px,mask_px) uint8, whole photos for the mask network
    raw: dict  # the file in numpy: names, statistics, center, scale, ground truth of the toy
    info: dict

    def photos(self, is_test: bool) -> Tensor:
        """Numbers (B,) of the held-out photos, or of those to train on."""
        return torch.nonzero(self.is_test == is_test)[:, 0]

    def sightings(self) -> tuple[Tensor, Tensor, Tensor]:
        """SfM points that photos show: photo (T,), point (T,3), its place on it (T,2) in 0..1."""
        img, x = (torch.as_tensor(self.raw[f"track_{k}"]) for k in ("photo", "point"))  # (T,)
        img, x = img.long().to(self.c2w.device), self.points[x.long()]  # (T,), (T,3)
        local = ((x - self.c2w[img, :, 3])[:, None] @ self.c2w[img, :, :3])[:, 0]  # (T,3) camera
        uv = local[:, :2] / local[:, 2:] * self.K[img, :2] + self.K[img, 2:]  # (T,2) px
        uv = uv / self.wh[img]  # (T,2)
        ok = (local[:, 2] > 0) & ((uv >= 0) & (uv < 1)).all(1)  # not those that SfM got wrong
        return img[ok], x[ok], uv[ok]


def load_scene(raw: dict, device="cpu", mask_px: int = 96) -> Scene:
    """Scene from the dictionary of a scene file (data_prep.read_scene, make_toy or prepare)."""
    photos = [raw["rgb"][a:b].reshape(h, w, 3)
              for a, b, (w, h) in zip(raw["start"], raw["start"][1:], raw["wh"])]
    thumbs = [cv2.resize(p, (mask_px, mask_px), interpolation=cv2.INTER_AREA) for p in photos]
    thumbs = torch.as_tensor(np.stack(thumbs)).permute(0, 3, 1, 2).contiguous().to(device)
    kinds = dict(start=torch.long, wh=torch.long, is_test=torch.bool)
    arrays = {k: torch.as_tensor(raw[k]).to(device, kinds.get(k, torch.float32))
              for k in Scene._fields[1:8]}
    fits = thumbs.device.type == "cpu" or raw["rgb"].nbytes < torch.cuda.mem_get_info(device)[0] / 2
    rgb = torch.as_tensor(raw["rgb"])
    arrays["rgb"] = rgb.to(device) if fits else rgb.pin_memory()
    return Scene(**arrays, thumbs=thumbs, raw=raw, info=json.loads(str(raw["info"])))


CHUNK = 4096  # rays or points evaluated at once outside training; more rays on a GPU


class Rays(NamedTuple):
    """A batch of rays; every field is indexed by the ray."""

    o: Tensor  # (R,3) origin
    d: Tensor  # (R,3) unit direction
    near: Tensor  # (R,)
    img: Tensor  # (R,) photo index
    uv: Tensor  # (R,2) pixel position over photo size, 0..1
    rgb: Tensor  # (R,3) the photo's colour

    def at(self, t: Tensor) -> Tensor:
        """Points (R,S,3) at distances t (R,S)."""
        return self.o[:, None] + t[:, :, None] * self.d[:, None]


def pixel_directions(uv_px: Tensor, K: Tensor) -> Tensor:
    """Unit directions in camera axes of positions uv_px (R,2) px, pixel centres at +0.5."""
    xy = (uv_px - K[:, 2:]) / K[:, :2]  # (R,2)
    return F.normalize(F.pad(xy, (0, 1), value=1.0), dim=1)  # (R,3)


def make_rays(scene: Scene, img: Tensor, pixel: Tensor) -> Rays:
    """Rays through pixels. img, pixel: (R,) photo and row-major pixel number within it."""
    w, h = scene.wh[img].unbind(1)  # (R,)
    uv = torch.stack([pixel % w, pixel // w], 1) + 0.5  # (R,2) px
    c2w = scene.c2w[img]  # (R,3,4)
    d = (c2w[:, :, :3] @ pixel_directions(uv, scene.K[img])[:, :, None])[:, :, 0]  # (R,3)
    at = (scene.start[img] + pixel).to(scene.rgb.device)  # (R,)
    rgb = scene.rgb[at].to(d.device).float() / 255  # (R,3)
    return Rays(c2w[:, :, 3], d, scene.near[img], img, uv / torch.stack([w, h], 1), rgb)


def random_rays(scene: Scene, photos: Tensor, n: int, per_step: int, gen: torch.Generator):
    """n training rays from per_step random photos. Returns Rays and the photos (B,) drawn."""
    dev = photos.device
    pick = photos[torch.randint(len(photos), (per_step,), generator=gen, device=dev)]  # (B,)
    img = pick.repeat_interleave(n // per_step)  # (R,) photo by photo, equally many from each
    u = torch.rand(len(img), generator=gen, device=dev, dtype=torch.float64)  # (R,)
    return make_rays(scene, img, (u * (scene.start[img + 1] - scene.start[img])).long()), pick


def sphere_interval(rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """t where each ray enters and leaves the unit sphere, and whether it does: (R,), (R,), (R,). A
    ray that misses the sphere, or has it behind, gets the empty interval at its closest approach
    (or at near), from where its background starts: no ray is dropped, no square root negative."""
    closest = -(rays.o * rays.d).sum(1)  # (R,)
    disc = closest ** 2 - (rays.o ** 2).sum(1) + 1  # (R,)
    half = disc.clamp(min=0).sqrt()  # (R,)
    hit = (disc > 0) & (closest + half > rays.near)  # (R,)
    t0 = torch.maximum(closest - half * hit, rays.near)  # (R,)
    return t0, torch.maximum(closest + half * hit, t0), hit


# torchrun starts RANKS processes. All draw the same random numbers and each works on own rows of a
# step, so that together they do what one does; the first alone speaks, decides, scores and writes.
RANK, LOCAL_RANK, RANKS = (int(os.environ.get(name, default)) for name, default in (
    ("RANK", 0), ("LOCAL_RANK", 0), ("WORLD_SIZE", 1)))
atomic_write = (lambda path, write: None) if RANK else atomic_write


def agreed(value, source: int = 0):
    """The value that one process has, for all of them."""
    box = [value]
    if RANKS > 1:
        dist.broadcast_object_list(box, source)
    return box[0]


def in_shares(f, *rows) -> dict[str, Tensor]:
    """f(*rows), from R rows to R rows by name: a process computes every RANKS-th, and all get all.
    Gradients flow to own rows alone, RANKS-fold, as their mean over the processes is taken."""
    if RANKS == 1:
        return f(*rows)
    own = f(*[Rays(*(v[RANK::RANKS] for v in r)) if isinstance(r, Rays) else r[RANK::RANKS]
              for r in rows])
    flat = torch.cat([v.reshape(len(v), -1) for v in own.values()], 1)  # (R/RANKS,columns)
    flat.register_hook(lambda grad: RANKS * grad)
    whole = flat.new_zeros(len(rows[-1]), flat.shape[1])  # (R,columns)
    whole[RANK::RANKS] = flat.detach()
    dist.all_reduce(whole)
    whole[RANK::RANKS] = flat
    parts = zip(own.items(), whole.split([v.shape[1:].numel() for v in own.values()], 1))
    return {name: (part if v.requires_grad else part.detach()).reshape(-1, *v.shape[1:])
            for (name, v), part in parts}


# ---- 3 Octree: features on the corners of cells --------------------------------------------------

CORNERS = torch.cartesian_prod(*[torch.arange(2)] * 3)  # (8,3), x slowest
# (8,32): the monomials 1 z y yz x xz xy xyz of a position in a cell times this are the weights of
# the 8 corners, then their derivatives along x, y, z. Per axis the ends weigh 1 - f and f.
VALUE, SLOPE = torch.tensor([[[1.0, 0], [-1, 1]], [[-1, 1], [0, 0]]])  # (2,2) each, rows 1, f
TRILINEAR = torch.cat([torch.kron(x, torch.kron(y, z)) for x, y, z in (
    3 * [VALUE], (SLOPE, VALUE, VALUE), (VALUE, SLOPE, VALUE), (VALUE, VALUE, SLOPE))], 1)


@functools.cache
def resident(constant: Tensor, device: torch.device) -> Tensor:
    """A constant on a device, copied once: a copy in every step would make a GPU wait."""
    return constant.to(device)


class Interpolate(torch.autograd.Function):
    """out[p,j] = sum over the 8 corners k of w[p,j,k] features[corner[p,k]], for J sets of weights:
    of the value, and of its derivatives along x, y, z. Fused, as the hottest operation of a step.
    Row 0 of the features belongs to the pinned corners: it is zero and gets no gradient."""
    @staticmethod
    def forward(ctx, features, corner, w):  # (V,C), (P,8), (P,J,8) -> (P,J,C)
        ctx.save_for_backward(corner, w)
        ctx.rows = len(features)
        return torch.stack([F.embedding_bag(corner, features, per_sample_weights=wj.contiguous(),
                                            mode="sum") for wj in w.unbind(1)], 1)

    @staticmethod
    def backward(ctx, grad):  # (P,J,C)
        corner, w = ctx.saved_tensors
        by_corner, is_single = w.transpose(1, 2), grad.shape[1] == 1  # (P,8,J)
        spread = by_corner * grad if is_single else torch.bmm(by_corner, grad)  # (P,8,C)
        out = grad.new_zeros(ctx.rows, grad.shape[2])  # (V,C)
        out.index_add_(0, corner.flatten().long(), spread.flatten(0, 1))
        out[0] = 0
        return out, None, None


class Octree(nn.Module):
    """Feature grid over the cube [-half, half]^3 that is fine only where it has been split. Level 0
    is a dense grid of root^3 cells; a node points to its first of eight children. Nodes 0-7 are the
    null block: a leaf's children, and their own. Features live on corners, shared by the cells that
    meet there. A corner with a missing cell around it ("hanging") is pinned to zero: the field is
    continuous across the borders of refined regions. A query concatenates the trilinear features of
    all levels on its path; absent levels contribute zeros."""
    def __init__(self, half: float, levels: int, channels: int = 4, device="cpu", root: int = 16,
                 std: float = 1e-2):
        super().__init__()
        self.half, self.levels, self.root, self.std = half, levels, root, std
        self.features = nn.Parameter(torch.zeros(1, channels, device=device))  # (V,C), row 0 pinned
        key = torch.zeros(1, dtype=torch.long, device=device)
        self.register_buffer("row_key", key)  # (V,) level and corner of each row
        self.register_buffer("scale", root * 2.0 ** torch.arange(levels, device=device))  # (L,)
        self.build([key[:0]] * (levels - 1))
        self.features.data[1:].normal_(0, std)

    def resolution(self, level: int) -> int:
        return self.root << level

    def cell(self, level: int) -> float:
        """Side of a cell, scene units."""
        return 2 * self.half / self.resolution(level)

    def centres(self, level: int) -> Tensor:
        """Centres (N,3) of the cells of a level."""
        return (self.cells[level] + 0.5) * self.cell(level) - self.half

    def key(self, ijk: Tensor, level: int) -> Tensor:
        """One number per cell or corner (...,3) of a level; corners run to resolution inclusive."""
        n = self.resolution(level) + 1
        return (ijk[..., 0] * n + ijk[..., 1]) * n + ijk[..., 2]

    def cell_of(self, x: Tensor, level: int) -> Tensor:
        """Integer coordinates (P,3) of the cells of a level that hold x (P,3), clamped."""
        n = self.resolution(level)
        return ((x / (2 * self.half) + 0.5) * n).long().clamp(0, n - 1)

    def around(self, ijk: Tensor, level: int) -> Tensor:
        """Cells (P,3) of a level and all their neighbours, some repeatedly: (27P,3)."""
        step = torch.cartesian_prod(*[torch.arange(-1, 2, device=ijk.device)] * 3)  # (27,3)
        return (ijk[:, None] + step).reshape(-1, 3).clamp(0, self.resolution(level) - 1)

    def build(self, split_keys: list[Tensor]) -> Tensor:
        """Makes nodes and corners from the keys of the split cells of each level but the last. New
        features are zero. Returns the former row (V,) of every row, 0 (the pinned one) if new."""
        octant = CORNERS.to(self.features.device)
        ijk = torch.cartesian_prod(*[torch.arange(self.root, device=octant.device)] * 3)  # (N,3)
        child, corner, rows = [octant.new_zeros(8)], [octant.new_zeros(8, 8)], [octant.new_zeros(1)]
        n_rows, n_nodes, self.split_keys, self.cells = 1, 8, [], []
        for level in range(self.levels):
            n = self.resolution(level)
            self.cells.append(ijk)
            n_nodes += len(ijk)
            keys, inverse, count = torch.unique(
                self.key(ijk, level)[:, None] + self.key(octant, level),  # (N,8), as key is linear
                return_inverse=True, return_counts=True)
            at = torch.stack([keys // (n + 1) ** 2, keys // (n + 1), keys], 1) % (n + 1)  # corners
            free = count == 2 ** ((at > 0) & (at < n)).sum(1)  # all cells around it exist
            corner.append(torch.where(free, n_rows - 1 + free.cumsum(0), 0)[inverse])  # (N,8)
            rows.append(keys[free] + ((level + 1) << 40))
            n_rows += len(rows[-1])
            child.append(torch.zeros_like(ijk[:, 0]))  # (N,) first child
            if level + 1 < self.levels:
                is_split = torch.isin(self.key(ijk, level), split_keys[level])  # (N,)
                self.split_keys.append(self.key(ijk[is_split], level))
                ijk = (2 * ijk[is_split][:, None] + octant).reshape(-1, 3)  # (N,3) of the next
                child[-1][is_split] = n_nodes + 8 * torch.arange(len(ijk) // 8, device=ijk.device)
        row_key = torch.cat(rows)
        old_row = torch.searchsorted(self.row_key, row_key).clamp(max=len(self.row_key) - 1)
        old_row = torch.where(self.row_key[old_row] == row_key, old_row, 0)  # (V,)
        self.features = nn.Parameter(self.features.detach()[old_row])  # (V,C)
        self.row_key = row_key
        self.child, self.corner = torch.cat(child).int(), torch.cat(corner).int()  # (N,), (N,8)
        self.active = sum(len(cells) > 0 for cells in self.cells)  # levels that have cells
        return old_row

    def split(self, level: int, ijk: Tensor) -> Tensor:
        """Splits cells ijk (P,3) of a level; the function stays, as new features are zero."""
        keys = list(self.split_keys)
        keys[level] = torch.cat([keys[level], self.key(ijk, level)])
        return self.build(keys)

    def prune(self, level: int, ijk: Tensor) -> Tensor:
        """Removes the children of cells ijk (P,3) of a level, and all that hangs below them."""
        keys = list(self.split_keys)
        keys[level] = keys[level][~torch.isin(keys[level], self.key(ijk, level))]
        return self.build(keys)

    def locate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Corner rows (P,L,8) of the cells that hold x (P,3), and its place (P,L,3) 0..1 inside, on
        the levels that have cells."""
        u = (x / (2 * self.half) + 0.5).clamp(0, 1 - 1e-6)  # (P,3)
        at = u[:, None] * self.scale[:self.active, None]  # (P,L,3) in cells
        ijk = at.int()  # (P,L,3)
        bit = ijk & 1  # (P,L,3)
        octant = bit[..., 0] * 4 + bit[..., 1] * 2 + bit[..., 2]  # (P,L)
        nodes = [8 + (ijk[:, 0, 0] * self.root + ijk[:, 0, 1]) * self.root + ijk[:, 0, 2]]  # (P,)
        for level in range(1, self.active):
            nodes.append(self.child[nodes[-1]] + octant[:, level])  # (P,)
        return self.corner[torch.stack(nodes, 1)], at - ijk

    def forward(self, x: Tensor, derivatives: bool = False) -> Tensor:
        """Features (P,L,J,C) at x (P,3); J = 1, or 4: value, its change per cell along x, y, z."""
        P, L, J = len(x), self.active, 4 if derivatives else 1
        corner, inside = self.locate(x)  # (P,L,8), (P,L,3)
        fx, fy, fz = inside.reshape(-1, 3).T.contiguous()  # (PL,)
        yz = fy * fz
        basis = torch.stack([torch.ones_like(fx), fz, fy, yz, fx, fx * fz, fx * fy, fx * yz], 1)
        with torch.autocast(x.device.type, enabled=False):  # [D9] corners have float32 features
            w = basis @ resident(TRILINEAR, x.device)[:, :8 * J]  # (PL,8) to (PL,8J)
        out = Interpolate.apply(self.features, corner.reshape(-1, 8), w.reshape(-1, J, 8))
        out = out.reshape(P, L, J, self.features.shape[1])
        return F.pad(out, (0, 0, 0, 0, 0, self.levels - L)) if L < self.levels else out

    def bytes(self) -> int:
        """Memory of features and of the structure that a query needs."""
        return sum(t.numel() * t.element_size() for t in (self.features, self.child, self.corner))


def seed_octree(octree: Octree, points: Tensor, dense: int, shell: tuple[float, float]) -> None:
    """Splits all cells that touch the shell of radii up to level `dense`, then cells near points:
    one cell on every side, so that the corners around a point are never hanging."""
    for level in range(min(dense, octree.levels - 1)):
        reach = octree.cell(level) * math.sqrt(3) / 2
        r = octree.centres(level).norm(dim=1)  # (N,)
        touches = (r > shell[0] - reach) & (r < shell[1] + reach)  # (N,)
        octree.split(level, octree.cells[level][touches])
    if len(points) and dense < octree.levels - 1:
        octree.split(dense, octree.around(octree.cell_of(points, dense), dense))
    octree.features.data[1:].normal_(0, octree.std)


def levels_for_footprint(footprint: float, root: int = 16, finest: int = 8) -> int:
    """Octree levels such that the finest cell is no smaller than a pixel at the surface."""
    return int(np.clip(1 + math.floor(math.log2(2 / footprint / root)), 2, finest))


# ---- 4 Fields: the networks on top of the octree -------------------------------------------------

GEO = 15  # length of the geometry feature that the SDF network hands to the colour network
BETA = 100.0  # sharpness of the SDF network's softplus: nearly a ReLU, but twice differentiable


class SDFField(nn.Module):
    """s(x) and a geometry feature, from xyz and octree features through one hidden layer. [D9]"""
    def __init__(self, octree: Octree, hidden: int):
        super().__init__()
        self.octree = octree
        self.lin1 = nn.Linear(3 + octree.features.shape[1] * octree.levels, hidden)
        self.lin2 = nn.Linear(hidden, 1 + GEO)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """sdf (P,) and geometry feature (P,GEO) at x (P,3)."""
        with torch.autocast(x.device.type, enabled=False):  # [D9]
            z = torch.cat([x, self.octree(x).flatten(1)], 1)  # (P,3+LC)
            out = self.lin2(F.softplus(self.lin1(z), BETA))  # (P,1+GEO)
        return out[:, 0], out[:, 1:]

    def with_gradient(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """sdf (P,), feature (P,GEO) and grad s (P,3) in closed form through the same corners. [D13]
        The chain rule written out: ds/dx = ds/dz dz/dx with z = [x, features(x)]. It is an ordinary
        differentiable expression, so training through normals needs no second-order autograd."""
        with torch.autocast(x.device.type, enabled=False):  # [D9]
            feat = self.octree(x, derivatives=True)  # (P,L,4,C)
            h = self.lin1(torch.cat([x, feat[:, :, 0].flatten(1)], 1))  # (P,H)
            out = self.lin2(F.softplus(h, BETA))  # (P,1+GEO)
            ds_dz = (torch.sigmoid(BETA * h) * self.lin2.weight[0]) @ self.lin1.weight  # (P,3+LC)
            ds_df = ds_dz[:, None, None, 3:].reshape(feat[:, :, :1].shape)  # (P,L,1,C)
            per_unit = (self.octree.scale / (2 * self.octree.half))[:, None, None]  # (L,1,1) cells
            grad = ds_dz[:, :3] + (feat[:, :, 1:] * (ds_df * per_unit)).sum((1, 3))  # (P,3)
        return out[:, 0], out[:, 1:], grad


TETRAHEDRON = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)


def finite_differences(sdf, x: Tensor, eps: float, centre: Tensor | None = None):
    """Gradient (P,3) and Laplacian (P,) of sdf at x (P,3) from 4 tetrahedral taps (Neuralangelo).
    Taps sit at x + eps k, |k| = 1: their mean difference to the centre is eps^2/6 times the
    Laplacian, their k-weighted mean the gradient. centre: s(x) where the caller has it already."""
    k = resident(TETRAHEDRON, x.device).to(x.dtype)  # (4,3)
    ends = x[:, None] + eps * (k if centre is not None else F.pad(k, (0, 0, 0, 1)))  # (P,4 or 5,3)
    s = sdf(ends.reshape(-1, 3)).reshape(len(x), -1)  # (P,4 or 5)
    taps, centre = s[:, :4], s[:, 4] if centre is None else centre  # (P,4), (P,)
    slope = (taps[:, :, None] * k).sum(1)  # (P,3) not taps @ k: autocast would round the taps [D9]
    grad = 0.75 / eps * slope  # (P,3); sum over taps of k k^T is 4/3 times the identity
    return grad, 6 / eps ** 2 * (taps.mean(1) - centre)  # (P,3), (P,)


def sh_basis(d: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 2 of unit directions (R,3) -> (R,9), no constants."""
    x, y, z = d.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, z,
                        x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 1)  # (R,9)


class LipschitzMLP(nn.Module):
    """MLP whose rows are scaled to an L1 norm of at most softplus(c) (Liu et al. 2022)."""
    def __init__(self, sizes: list[int]):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        bound = torch.stack([m.weight.detach().abs().sum(1).max() for m in self.layers])
        self.c = nn.Parameter(torch.log(torch.expm1(bound)))  # (layers,)

    def bounds(self) -> Tensor:
        """Lipschitz bound of each layer in the max norm; above 0, as the loss takes its log."""
        return F.softplus(self.c).clamp(min=1e-6)

    def forward(self, x: Tensor) -> Tensor:
        for i, (layer, bound) in enumerate(zip(self.layers, self.bounds())):
            norm = layer.weight.abs().sum(1).clamp(min=1e-9)  # (out,)
            scale = (bound / norm).clamp(max=1)  # (out,)
            x = F.relu(x) if i else x
            x = F.linear(x, layer.weight * scale[:, None], layer.bias)  # (P,out)
        return x


def contract(x: Tensor) -> Tensor:
    """Squeezes |x| > 1 into the ball of radius 2 (mip-NeRF 360 Eq. 10); identity inside."""
    r = x.norm(dim=-1, keepdim=True).clamp(min=1)  # (...,1)
    return x * (2 - 1 / r) / r


class Background(nn.Module):
    """A small NeRF outside the sphere, on an octree over contracted space."""
    def __init__(self, octree: Octree, hidden: int, appearance_dim: int):
        super().__init__()
        self.octree = octree
        inputs = 3 + octree.features.shape[1] * octree.levels
        self.density, self.color = (
            nn.Sequential(nn.Linear(a, hidden), nn.ReLU(), nn.Linear(hidden, b))
            for a, b in ((inputs, 1 + GEO), (GEO + 9 + appearance_dim, 3)))

    def forward(self, rays: Rays, start: Tensor, code: Tensor, n: int, jitter: Tensor) -> Tensor:
        """Colour (R,3) beyond start (R,). code: (R,A); jitter: (R,n) in 0..1. [D8] Sections are
        equal steps of u in t = start + u / (1 - u); the last one is opaque."""
        u = torch.arange(n, device=start.device) / n + jitter / n  # (R,n) stratified
        t = start[:, None] + u / (1 - u).clamp(min=1e-3)  # (R,n)
        x = contract(rays.at(t)).reshape(-1, 3)  # (Rn,3)
        out = self.density(torch.cat([x, self.octree(x).flatten(1)], 1)).float()  # (Rn,1+GEO)
        sigma = F.softplus(out[:, 0].reshape(len(t), n) - 1)  # (R,n)
        alpha = 1 - torch.exp(-sigma[:, :-1] * torch.diff(t, dim=1))  # (R,n-1)
        w, _ = composite(F.pad(alpha, (0, 1), value=1.0))  # (R,n)
        per_ray = torch.cat([sh_basis(rays.d), code], 1).repeat_interleave(n, 0)  # (Rn,9+A)
        rgb = torch.sigmoid(self.color(torch.cat([out[:, 1:], per_ray], 1)).float())  # (Rn,3)
        return (w[:, :, None] * rgb.reshape(len(t), n, 3)).sum(1)  # (R,3)


# ---- 5 From SDF to colour: sections along the ray, alpha, compositing ----------------------------

class Deviation(nn.Module):
    """The deviation network: zeta = exp(10 v), one learned number; 1/zeta is a surface's width."""
    def __init__(self, zeta: float = 20.0):
        super().__init__()
        self.v = nn.Parameter(torch.tensor(math.log(zeta) / 10))

    def forward(self) -> Tensor:
        return torch.exp(10 * self.v).clamp(1e-2, 1e5)


def neus_alpha(sdf: Tensor, cos: Tensor, dt: Tensor, zeta: Tensor) -> Tensor:
    """Opacity (R,S) of sections of length dt with SDF sdf and slope cos = <grad s, d> mid-way.
    Eq. 1 mended: 1 - sigmoid(zeta s_next) / sigmoid(zeta s_prev) (NeuS Eq. 13) with the two ends
    s -+ cos dt / 2 inside zeta [D2], divided so that opacities multiply up to 1 behind walls [D1].
    A section that leads outwards (cos > 0) is transparent. Logs of sigmoids do not overflow."""
    half = F.relu(-cos) * dt / 2  # (R,S)
    return -torch.expm1(F.logsigmoid(zeta * (sdf - half)) - F.logsigmoid(zeta * (sdf + half)))


def printed_alpha(sdf: Tensor, cos: Tensor, dt: Tensor, zeta: Tensor) -> Tensor:
    """Eq. 1 as printed, kept to be shown and tested: sums to one, but multiplies to 1 - 1/e."""
    beta = cos * dt / 2  # (R,S)
    after = torch.cat([sdf[:, 1:], sdf[:, -1:]], 1)  # (R,S), s_{i+1}
    return torch.sigmoid(zeta * sdf + beta) - torch.sigmoid(zeta * after + beta)


def composite(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights w_i = T_i alpha_i (R,S), T_i = prod_{j<i} (1 - alpha_j); what passes, T (R,). Eq. 2
    The product runs as a sum of logs: its backward needs no look for zeros."""
    trans = torch.exp(torch.log1p(-alpha.clamp(max=1 - 1e-6)).cumsum(1))  # (R,S) after each section
    return F.pad(trans[:, :-1], (1, 0), value=1.0) * alpha, trans[:, -1]


def inverse_cdf(edges: Tensor, weight: Tensor, u: Tensor) -> Tensor:
    """Positions (R,S) where the linear CDF of weight (R,N) on edges (R,N+1) reaches u (R,S)."""
    cdf = torch.cumsum(weight, 1)
    cdf = F.pad(cdf / cdf[:, -1:], (1, 0))  # (R,N+1)
    hi = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, weight.shape[1])  # (R,S)
    c0, c1 = cdf.gather(1, hi - 1), cdf.gather(1, hi)  # (R,S)
    e0, e1 = edges.gather(1, hi - 1), edges.gather(1, hi)  # (R,S)
    return e0 + (e1 - e0) * ((u - c0) / (c1 - c0).clamp(min=1e-9)).clamp(0, 1)


PROBES = 64  # cheap lookups of the cached SDF per ray
FLOOR = 0.2  # share of samples spread uniformly, so that a lost surface can return


def cached_weight(cache: Tensor, rays: Rays, edges: Tensor, zeta: Tensor) -> Tensor:
    """NeuS weights (R,N) of sections (R,N+1) from the cached SDF volume (1,1,n,n,n). [D11]"""
    x = rays.at(edges).flip(-1)[None, None]  # (1,1,R,N+1,3) as grid_sample wants it, z first
    s = F.grid_sample(cache, x, padding_mode="border", align_corners=True)[0, 0, 0]  # (R,N+1)
    alpha = -torch.expm1(torch.diff(F.logsigmoid(zeta * s)).clamp(max=0))  # (R,N)
    return composite(alpha)[0]


def sample_sections(model: "GeoNVS", rays: Rays, t0: Tensor, t1: Tensor, n: int, jitter: Tensor):
    """Edges (R,n+1) of n sections from t0 to t1 (R,), dense where the cached SDF sees a surface.
    jitter: (R,n) in 0..1, stratifies the n - 1 inner edges."""
    u = (torch.arange(n - 1, device=t0.device) + jitter[:, :-1]) / (n - 1)  # (R,n-1)
    probes = torch.linspace(0, 1, PROBES + 1, device=t0.device)  # (N+1,)
    edges = t0[:, None] + (t1 - t0)[:, None] * probes  # (R,N+1)
    weight = torch.ones_like(edges[:, 1:])  # (R,N)
    if model.cfg.sampling == "cached":
        zeta = model.deviation().clamp(max=model.cache.shape[-1])  # a surface as wide as a voxel
        weight = cached_weight(model.cache, rays, edges, zeta)  # (R,N)
        weight = weight + (FLOOR / (1 - FLOOR) * weight.sum(1, keepdim=True) + 1e-3) / PROBES
    return torch.cat([t0[:, None], inverse_cdf(edges, weight, u), t1[:, None]], 1)  # (R,n+1)


def render_rays(model: "GeoNVS", rays: Rays, code: Tensor, jitter: Tensor) -> dict[str, Tensor]:
    """One ray batch through the whole model. code: (R,A) appearance; jitter: (R,S+B) in 0..1.
    Returns rgb (R,3), opacity, depth (R,), normal (R,3), e_grad, e_curv (R,): eikonal error and
    curvature of Eq. 4, NeuS-weighted [D3] (analytic normals: curvature where the ray ends); hit
    (R,), the rays' ends x (R,3), eikonal error of each sample (R,S)."""
    cfg, R, S = model.cfg, len(rays.o), model.cfg.samples
    t0, t1, hit = sphere_interval(rays)  # (R,)
    with torch.no_grad():
        edges = sample_sections(model, rays, t0, t1, S, jitter[:, :S])  # (R,S+1)
    t = (edges[:, 1:] + edges[:, :-1]) / 2  # (R,S)
    x = rays.at(t).reshape(-1, 3)  # (RS,3)
    if cfg.normals == "fd":
        sdf, geo = model.sdf(x)  # (RS,), (RS,GEO)
        grad, lap = finite_differences(lambda y: model.sdf(y)[0], x, model.eps, sdf)  # (RS,3)
    else:
        sdf, geo, grad = model.sdf.with_gradient(x)  # (RS,), (RS,GEO), (RS,3) [D13]
    normal = F.normalize(grad, dim=1)  # (RS,3)
    cos = (grad.reshape(R, S, 3) * rays.d[:, None]).sum(2)  # (R,S)
    opacity_of = neus_alpha if cfg.alpha == "neus" else printed_alpha
    alpha = opacity_of(sdf.reshape(R, S), cos, torch.diff(edges), model.deviation())  # (R,S)
    w, trans = composite(alpha * hit[:, None])  # (R,S), (R,)
    per_ray = torch.cat([sh_basis(rays.d), code], 1)[:, None].expand(R, S, -1).reshape(R * S, -1)
    rgb_s = torch.sigmoid(model.color(torch.cat([geo, normal, per_ray], 1)).float())  # (RS,3)
    rgb = (w[:, :, None] * rgb_s.reshape(R, S, 3)).sum(1)  # (R,3)
    behind = model.bg_color  # (3,)
    if model.background is not None:
        behind = model.background(rays, t1, code, cfg.bg_samples, jitter[:, S:])  # (R,3)
    opacity = w.sum(1)  # (R,)
    depth = (w * t).sum(1) + trans * t1  # (R,)
    end = rays.o + depth.detach()[:, None] * rays.d  # (R,3) where the ray ends
    if cfg.normals == "fd":
        e_curv = (w.detach() * lap.reshape(R, S).abs()).sum(1) * model.eps  # (R,)
    else:  # four taps where the ray ends, for the curvature alone
        _, lap = finite_differences(lambda y: model.sdf(y)[0], end, model.eps)  # (R,)
        e_curv = lap.abs() * model.eps * opacity.detach()  # (R,) flat, not transparent
    error = ((grad.norm(dim=1) - 1) ** 2).reshape(R, S)
    return dict(rgb=rgb + trans[:, None] * behind, opacity=opacity, depth=depth, hit=hit, x=end,
                normal=(w[:, :, None] * normal.reshape(R, S, 3)).sum(1),
                e_curv=e_curv, e_grad=(w * error).sum(1), eikonal=error)


# ---- 6 Photos in the wild: transient mask and geometry preservation ------------------------------

def conv(cin: int, cout: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(cin, cout, size, stride, size // 2, bias=False),
                         nn.GroupNorm(8, cout), nn.PReLU(cout))  # [D6]


class ContextBlock(nn.Module):
    """Context-guided block (CGNet Fig. 3): local and dilated context, gated globally."""
    def __init__(self, cin: int, cout: int, stride: int, dilation: int):
        super().__init__()
        half = cout // 2
        self.reduce = conv(cin, half, 3 if stride == 2 else 1, stride)
        self.local = nn.Conv2d(half, half, 3, 1, 1, groups=half, bias=False)
        self.around = nn.Conv2d(half, half, 3, 1, dilation, dilation, half, bias=False)
        self.join = nn.Sequential(nn.GroupNorm(8, cout), nn.PReLU(cout))
        self.gate = nn.Sequential(nn.Linear(cout, cout // 8), nn.ReLU(),
                                  nn.Linear(cout // 8, cout), nn.Sigmoid())

    def forward(self, x: Tensor) -> Tensor:
        y = self.reduce(x)  # (B,cout/2,h,w)
        y = self.join(torch.cat([self.local(y), self.around(y)], 1))  # (B,cout,h,w)
        y = y * self.gate(y.mean((2, 3)))[:, :, None, None]
        return y + x if y.shape == x.shape else y


class CGNet(nn.Module):
    """Whole photos (B,3,H,W) in 0..1 to transient logits (B,1,H/2,W/2) (CGNet, as in CR-NeRF). [D6]
    The head reads all three resolutions: at 1/8 alone a mask could not follow an outline."""
    def __init__(self, width: int = 16):
        super().__init__()
        a, b, c = width, 2 * width, 4 * width
        self.stem = nn.Sequential(conv(3, a, stride=2), conv(a, a))
        self.stage2 = nn.Sequential(ContextBlock(a, b, 2, 2), ContextBlock(b, b, 1, 2))
        self.stage3 = nn.Sequential(ContextBlock(b, c, 2, 4), ContextBlock(c, c, 1, 4))
        self.heads = nn.ModuleList(nn.Conv2d(k, 1, 1) for k in (a, b, c))
        for head, bias in zip(self.heads, (-2.5, 0.0, 0.0)):
            nn.init.constant_(head.bias, bias)  # starts with 8 % masked, not with half the picture

    def forward(self, photo: Tensor) -> Tensor:
        y1 = self.stem(photo - 0.5)  # (B,a,H/2,W/2)
        y2 = self.stage2(y1)  # (B,b,H/4,W/4)
        y3 = self.stage3(y2)  # (B,c,H/8,W/8)
        return sum(F.interpolate(head(y).float(), y1.shape[2:], mode="bilinear")
                   for head, y in zip(self.heads, (y1, y2, y3)))  # (B,1,H/2,W/2)


def mask_at(logits: Tensor, uv: Tensor) -> Tensor:
    """M (R,) at uv (R,2) in 0..1 of logits (B,1,h,w); rays come photo by photo, R / B from each."""
    grid = (2 * uv - 1).reshape(len(logits), -1, 1, 2)  # (B,R/B,1,2)
    at = F.grid_sample(logits, grid, padding_mode="border", align_corners=False)  # (B,1,R/B,1)
    return torch.sigmoid(at).flatten()  # (R,)


def edge_indicator(e_grad: Tensor, e_curv: Tensor, lam_grad: float, lam_lap: float,
                   calibration: Tensor | None) -> Tensor:
    """Phi (R,) from the rays' eikonal error and curvature. Eq. 4 calibration (2,): centre and width
    of the sigmoid. None is the literal reading: Phi then lies between 0.5 and 1 for every ray, a
    price that tells no edge. Detached [D3]: it is to hold back the mask, not to smooth geometry."""
    x = (lam_grad * e_grad + lam_lap * e_curv).detach()  # (R,)
    return torch.sigmoid(x if calibration is None else (x - calibration[0]) / calibration[1])


QUANTILES = torch.tensor([0.5, 0.75, 0.95])


def calibrate(x: Tensor, calibration: Tensor, rate: float = 0.05) -> None:
    """Moves calibration (2,) to the batch's: 75th percentile and width (p95 - p50) / 4. [D3]"""
    x = x.detach().nan_to_num(0, 0, 0)  # (R,)
    p50, p75, p95 = x.quantile(resident(QUANTILES, x.device))
    calibration.lerp_(torch.stack([p75, ((p95 - p50) / 4).clamp(min=1e-3)]), rate)


def gpl_loss(mask: Tensor, edge: Tensor) -> Tensor:
    """Geometry-preservation loss: mean of M(r) Phi(r). Eq. 3"""
    return (mask * edge).mean()


# ---- 7 The model and its objective ---------------------------------------------------------------

def bimodality(mask: Tensor) -> Tensor:
    """The second half of L_reg: a pole at 1/2 that pushes M to 0 or 1 (Ha-NeRF's digit loss)."""
    return (1 / ((mask - 0.5) ** 2 + 0.02)).mean()


def random_ball(n: int, gen: torch.Generator) -> Tensor:
    """Uniform points (n,3) in the unit ball."""
    direction = F.normalize(torch.randn(n, 3, generator=gen, device=gen.device), dim=1)  # (n,3)
    return direction * torch.rand(n, 1, generator=gen, device=gen.device) ** (1 / 3)


class Method(nn.Module):
    """What the training loop asks of a method, with the answers that most of them give."""

    step = 0  # number of the present step, set by the loop
    adam = dict(betas=(0.9, 0.99), eps=1e-15)  # as is usual for feature grids (Instant-NGP)

    def octrees(self) -> list[Octree]:
        return [part for part in self.modules() if isinstance(part, Octree)]

    def codes(self) -> Tensor:
        """Appearance codes (I,A) of all photos."""
        return self.appearance.weight

    def start(self, gen: torch.Generator) -> None:
        """Before the first step."""

    def batch(self, photos: Tensor, gen: torch.Generator) -> tuple[Rays, Tensor]:
        """Rays of one step and the photos (B,) they come from."""
        return random_rays(self.scene, photos, self.cfg.rays, self.cfg.photos, gen)

    def maintain(self, step: int, progress: float, optimizer: torch.optim.Optimizer) -> None:
        """After every step."""

    def health(self) -> dict[str, Tensor]:
        """More figures for a line of the log."""
        return {}


REFINE_AT = (0.1, 0.2, 0.3, 0.45, 0.6)  # shares of training at which the octree is refined
SPLIT_RAYS = 6  # recent rays that end in a cell before it is split
HIDDEN = 6.0  # zeta |s| from where on the field is not seen: sigmoid(-6) = 0.0025


def worth_splitting(octree: Octree, level: int, hits: Tensor, bound: float) -> Tensor:
    """Keys (Q,) of cells where enough rays end, that miss their colour by more than bound on
    average, and to whose pixels the children are not too fine; worst first. hits: (P,5), the rays'
    ends, errors and pixel sizes there."""
    key, which, count = octree.key(octree.cell_of(hits[:, :3], level), level).unique(
        return_inverse=True, return_counts=True)  # (Q,), (P,), (Q,)
    mean = hits.new_zeros(len(key), 2).index_add_(0, which, hits[:, 3:]) / count[:, None]  # (Q,2)
    error, pixel = mean.unbind(1)  # (Q,)
    pays = (count >= SPLIT_RAYS) & (error > bound) & (pixel < octree.cell(level) / 2)  # (Q,)
    worst = error.argsort(descending=True)
    return key[worst[pays[worst]]]


class GeoNVS(Method):
    """The paper's model: what it learns, and what it caches to be fast."""
    def __init__(self, cfg: Config, scene: Scene):
        super().__init__()
        self.cfg, self.scene, self.refined = cfg, scene, 0
        self.use_mask, dev = cfg.mask != "off", scene.c2w.device
        inside = scene.points.norm(dim=1) < 1
        self.sfm = scene.points[inside]  # (K,3)
        levels = cfg.levels or levels_for_footprint(float(scene.raw["footprint"]))
        is_octree = len(self.sfm) > 0 and cfg.grid == "octree"
        if not is_octree:  # a dense cube has 8/7 of its finest cells, as many corners
            side = (7 / 8 * cfg.max_mb * 2 ** 20 / (36 + 4 * cfg.channels)) ** (1 / 3)  # in cells
            levels = max(1, min(levels, 1 + int(math.log2(max(side / 16, 1)))))
        octree = Octree(1.0, levels, cfg.channels, dev)
        dense, radius = (1, 1.0) if is_octree else (levels, math.sqrt(3))
        seed_octree(octree, self.sfm, dense, (0.0, radius))  # [D10]
        spread, sky = float(scene.raw["exposure_spread"]), torch.as_tensor(scene.raw["bg_color"])
        has_codes = cfg.appearance == "on" or cfg.appearance == "auto" and spread > 0.01
        A = cfg.appearance_dim * has_codes
        self.sdf = SDFField(octree, cfg.hidden)
        self.appearance = nn.Embedding(len(scene.wh), A).requires_grad_(A > 0)  # at 0 CUDA errs
        nn.init.normal_(self.appearance.weight, std=0.01)
        self.color = LipschitzMLP([GEO + 3 + 9 + A, cfg.hidden, cfg.hidden, 3])
        self.background = None
        if cfg.background == "on" or cfg.background == "auto" and sky.isnan().any():
            outer = Octree(2.0, cfg.bg_levels, cfg.channels, dev)
            seed_octree(outer, contract(scene.points[~inside]), 1, (1.0, 2.0))
            self.background = Background(outer, cfg.hidden, A)
        self.deviation, self.cgnet = Deviation(), CGNet()
        I, m = len(scene.wh), (cfg.mask_px + 1) // 2
        n = np.clip(octree.resolution(levels - 1), 64, 128)
        static = torch.zeros(I, 1, m, m, dtype=torch.bool, device=dev)
        img, x, uv = scene.sightings()  # (T,), (T,3), (T,2)
        col, row = (uv * m).long().unbind(1)  # (T,)
        static[img, 0, row, col] = True
        pick = torch.nonzero(~scene.is_test[img] & (x.norm(dim=1) < 0.95))[:, 0]
        pick = pick[::max(1, len(pick) // 256)]
        self.probes = img[pick], x[pick]  # (Q,), (Q,3) for health
        memory = dict(
            bg_color=sky.float().nan_to_num(0.5), calibration=torch.tensor([0.0, 1.0]),
            level=torch.tensor(0.1),  # running lower quartile of all L1 errors, for splits
            cache=torch.zeros(1, 1, n, n, n),  # SDF on a dense grid, for placing samples [D11]
            hits=torch.full((max(2 ** 18, 512 * cfg.rays), 5), 2.0),  # ends of rays, errors, pixels
            logits=torch.full((I, 1, m, m), -9.0),  # last output of the mask network
            seen=torch.full((I, 4, m, m), -1.0),  # last residual and Phi by pixel; -1: no ray yet
            static=static,  # pixels that show an SfM point, but for outlines scene [D10]
            usual=torch.tensor(0.3))  # running upper quartile of the errors of such pixels
        for name, value in memory.items():
            self.register_buffer(name, value)
        self.to(dev)

    @property
    def eps(self) -> float:
        """Length of the taps of finite differences: half of the finest cell there is."""
        return self.sdf.octree.cell(self.sdf.octree.active - 1) / 2

    def get_extra_state(self) -> dict:
        return dict(refined=self.refined, use_mask=self.use_mask)

    def set_extra_state(self, state: dict) -> None:
        self.refined = state["refined"]
        self.use_mask = state["use_mask"] if self.cfg.mask == "auto" else self.use_mask

    def groups(self) -> list[dict]:
        """Optimiser groups: features fast, networks and codes slower, zeta and mask apart."""
        cfg, grids = self.cfg, [o.features for o in self.octrees()]
        others = [dict(params=grids, lr=cfg.lr_grid),
                  dict(params=[self.deviation.v], lr=cfg.lr_zeta),
                  dict(params=list(self.cgnet.parameters()), lr=8e-3)]  # learns in few steps [D14]
        taken = {id(p) for group in others for p in group["params"]}
        nets = [p for p in self.parameters() if id(p) not in taken]
        return [dict(params=nets, lr=cfg.lr_net), *others]

    def start(self, gen: torch.Generator, steps: int = 200, radius: float = 0.25) -> None:
        """Warm-up: L_sphere fits the SDF to a sphere. A small one: a surface that starts inside the
        landmark grows to it, one that starts outside also has to be carved out of the sky."""
        octree, codes = self.sdf.octree, self.codes()
        print(f"  {octree.levels} levels, finest cell {octree.cell(octree.levels - 1):.4f}, "
              f"{sum(map(len, octree.cells)):,} cells; exposures spread by "
              f"{float(self.scene.raw['exposure_spread']):.3f}: appearance "
              f"{'on' if codes.numel() else 'off'}; background "
              f"{'on' if self.background else 'one colour'}; mask {self.cfg.mask}")
        nets = [*self.sdf.lin1.parameters(), *self.sdf.lin2.parameters()]
        grid = dict(params=[self.sdf.octree.features], lr=1e-3)
        adam = torch.optim.Adam([grid, dict(params=nets, lr=5e-3)])
        for _ in range(steps):
            x = random_ball(1024, gen)  # (P,3)
            loss = ((self.sdf(x)[0] - (x.norm(dim=1) - radius)) ** 2).mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
        self.refresh_cache(0, 1)

    def losses(self, rays: Rays, pick: Tensor, gen: torch.Generator):
        """The objective, Eq. 5: its weighted sum, and by name the raw terms and health signals. The
        terms that teach M come from mask_objective, every few steps [D14]."""
        cfg, R, K, dev = self.cfg, len(rays.o), len(self.sfm), rays.o.device
        jitter = torch.rand(R, cfg.samples + cfg.bg_samples, generator=gen, device=dev)  # (R,S+B)
        out = in_shares(lambda *v: render_rays(self, *v), rays, self.appearance(rays.img), jitter)
        e_grad, e_curv, hit = out["e_grad"], out["e_curv"], out["hit"]  # (R,)
        residual = out["rgb"] - rays.rgb  # (R,3)
        error = residual.abs().mean(1)  # (R,) L1
        mask = mask_at(self.logits[pick], rays.uv) * self.use_mask  # (R,)
        calibrate(cfg.lam_grad * e_grad + cfg.lam_lap * e_curv, self.calibration)
        calibration = self.calibration if cfg.gpl == "calibrated" else None
        edge = edge_indicator(e_grad, e_curv, cfg.lam_grad, cfg.lam_lap, calibration)  # (R,)
        edge = out["opacity"].detach() * edge  # (R,)
        sfm = torch.randint(max(K, 1), (R // 2 if K else 0,), generator=gen, device=dev)  # (R/2,)
        x = torch.cat([random_ball(R // 2, gen), self.sfm[sfm]])  # (R/2 + R/2,3)
        s = in_shares(lambda x: dict(sdf=self.sdf(x)[0]), x)["sdf"]  # (R/2 + R/2,)
        raw = dict(rgb=((1 - mask) * error).mean(),
                   eik=(out["eikonal"].mean(1) * hit).sum() / hit.sum().clamp(min=1),
                   curv=e_curv.mean(),  # [D4]
                   lps=torch.log(self.color.bounds()).sum(),  # [D5]
                   off=torch.exp(-50 * s[:R // 2].abs()).mean(),
                   sfm=s[R // 2:].abs().sum() / max(R // 2, 1),  # [D10]
                   mask=mask.mean(), gpl=gpl_loss(mask, edge))
        total = (raw["rgb"] + cfg.lam_eik * raw["eik"] + cfg.lam_curv * raw["curv"]
                 + cfg.lam_lps * raw["lps"] + cfg.lam_off * raw["off"] + cfg.lam_sfm * raw["sfm"])
        misfit = error.detach().nan_to_num(0, 0, 0)  # (R,) what is remembered stays finite
        self.level.lerp_(misfit.quantile(0.25), 0.02)
        if self.use_mask:
            self.remember(rays, residual.detach().nan_to_num(0, 0, 0), edge.nan_to_num(0, 0, 0))
            if self.step % cfg.mask_every == 0:
                total = total + self.mask_objective(pick)
        slot = (self.step * R + torch.arange(R, device=dev)) % len(self.hits)  # (R,)
        pixel = out["depth"].detach() / self.scene.K[rays.img, 0]  # (R,) its size at the ray's end
        told = torch.stack([(1 - mask) * misfit, pixel], 1)  # (R,2)
        self.hits[slot] = torch.cat([out["x"], told], 1).nan_to_num(2, 2, 2)
        health = dict(zeta=self.deviation(), opacity=out["opacity"].mean(),
                      miss=1 - hit.float().mean(), mse=(residual ** 2).mean())
        return total, {k: v.detach() for k, v in (raw | health).items()}

    def remember(self, rays: Rays, residual: Tensor, edge: Tensor) -> None:
        """Keeps residual (R,3) and Phi (R,) where the mask network will look for them."""
        m = self.seen.shape[-1]
        col, row = (rays.uv * m).long().clamp(max=m - 1).unbind(1)  # (R,)
        self.seen[rays.img, :, row, col] = torch.cat([residual, edge[:, None]], 1)

    def mask_objective(self, pick: Tensor) -> Tensor:
        """The terms of Eq. 5 that hold M, over all pixels of photos (B,) that rays have seen. [D14]
        Eq. 5 is linear in M: M = 1 costs a pixel its intensity and GPL and saves it its error. As a
        sigmoid hardly moves at 0 or 1, price times M is minimised through its logistic surrogate:
        the same sign, so the same optimum, but a slope that never vanishes. Errors are signed means
        over 3x3 pixels, of the worst channel: what a blurred model lacks cancels, people do not.
        Pixels that show SfM points are scene: their own error never counts for M = 1, but tells
        what is usual. The price lies above: at first, and in fine detail, the scene is wrong."""
        cfg, logits = self.cfg, self.cgnet(self.scene.thumbs[pick].float() / 255)  # (B,1,h,w)
        self.logits[pick] = logits.detach()
        residual, edge = self.seen[pick].split((3, 1), 1)  # (B,3,h,w), (B,1,h,w)
        known = (edge >= 0).float()  # (B,1,h,w)
        around = F.avg_pool2d(torch.cat([residual * known, known], 1), 3, 1, 1)  # (B,4,h,w)
        mean = around[:, :3] / around[:, 3:].clamp(min=0.1)  # (B,3,h,w)
        error = mean.abs().amax(1, keepdim=True)  # (B,1,h,w)
        static = self.static[pick]  # (B,1,h,w)
        usual = torch.where(static & (edge >= 0), error, math.nan).nanquantile(0.75)
        self.usual.lerp_(torch.where(usual.isnan(), self.usual, usual), 0.1)
        price = cfg.lam_mask + self.usual + cfg.lam_gpl * edge - error * ~static  # (B,1,h,w) [D7]
        slope = F.softplus(torch.where(price > 0, logits, -logits))  # (B,1,h,w)
        pull = cfg.lam_bimodal * bimodality(logits.sigmoid())
        return (price.abs() * slope * known).mean() + pull

    def mask_of(self, rays: Rays, pick: Tensor) -> Tensor:
        """M (R,) of rays, R / B from each of photos pick (B,)."""
        if not self.use_mask:
            return torch.zeros_like(rays.near)
        return mask_at(self.cgnet(self.scene.thumbs[pick].float() / 255), rays.uv)

    @torch.no_grad()
    def refresh_cache(self, part: int, parts: int) -> None:
        """Evaluates the SDF again on every parts-th slice of the cache, from slice `part`."""
        n = self.cache.shape[-1]
        line = torch.linspace(-1, 1, n, device=self.cache.device)  # (n,)
        x = torch.cartesian_prod(line[part::parts], line, line)  # (P,3)
        size = 2 ** 18 if x.is_cuda else 2 ** 15  # launches bind a GPU, its cache a CPU
        s = torch.cat([self.sdf(some)[0] for some in x.split(size)])  # (P,)
        self.cache[0, 0, part::parts] = s.reshape(-1, n, n)

    @torch.no_grad()
    def refine(self, optimizer: torch.optim.Optimizer) -> None:
        """Fits the octree to the scene: no fine cell far from the surface or where pictures agree.
        Cells are newly split at the surface where that pays, coarse levels first, as far as
        cfg.max_mb allows. A cell is merged again when nothing of it, nor within a child's side of
        it, where corners become pinned, is nearer to the surface than HIDDEN / zeta: if |grad s| is
        1, no pixel changes by more than 2 sigmoid(-HIDDEN) = 0.005. Adam's moments move along."""
        octree, keys, zeta = self.sdf.octree, list(self.sdf.octree.split_keys), self.deviation()
        hits = self.hits[self.hits[:, :3].norm(dim=1) < 1]  # (P,5) no empty slots, no missing rays
        split_bytes = 8 * (36 + 4 * octree.features.shape[1])  # nodes, and as many corners
        room = int(max(0, self.cfg.max_mb * 2 ** 20 - octree.bytes()) // split_bytes)
        for level in range(min(octree.active, octree.levels - 1)):
            s = torch.cat([self.sdf(x)[0] for x in octree.centres(level).split(CHUNK)])  # (N,)
            reach = (math.sqrt(3) / 2 + 1) * octree.cell(level)
            key = octree.key(octree.cells[level], level)  # (N,)
            keys[level] = keys[level][torch.isin(keys[level], key[s.abs() < reach + HIDDEN / zeta])]
            bound = self.cfg.split_error * self.level
            new = worth_splitting(octree, level, hits, bound)  # (Q,)
            new = new[torch.isin(new, key[s.abs() < reach]) & ~torch.isin(new, keys[level])][:room]
            room -= len(new)
            keys[level] = torch.cat([keys[level], new])
        keys = [k.to(hits.device) for k in agreed([k.cpu() for k in keys])]
        old = octree.features
        old_row = octree.build(keys)
        moments = optimizer.state.pop(old).items()
        optimizer.state[octree.features] = {k: v[old_row] if v.dim() else v for k, v in moments}
        for group in optimizer.param_groups:
            group["params"] = [octree.features if p is old else p for p in group["params"]]

    def maintain(self, step: int, progress: float, optimizer: torch.optim.Optimizer) -> None:
        """Cache slices are refreshed; a few times, the model is fitted to the scene."""
        if step % 8 == 0:
            self.refresh_cache(step // 8 % 8, 8)
        if self.refined == len(REFINE_AT) or progress < REFINE_AT[self.refined]:
            return
        if self.cfg.grid == "octree":
            self.refine(optimizer)
        self.refined += 1
        if self.refined == len(REFINE_AT) and self.cfg.mask == "auto" and self.use_mask:
            share = agreed(self.logits[~self.scene.is_test].sigmoid().mean().item())
            self.use_mask = share > 0.01
            print(f"  mean mask {share:.4f}: mask {'stays on' if self.use_mask else 'goes off'}")

    @torch.no_grad()
    def health(self) -> dict[str, Tensor]:
        """Mean foreground opacity of rays from training photos to SfM points that they show."""
        scene, (img, x) = self.scene, self.probes
        if not len(img):
            return {}
        o = scene.c2w[img, :, 3]  # (Q,3)
        rays = Rays(o, F.normalize(x - o, dim=1), scene.near[img], img, o[:, :2], o)
        return dict(sfm_opacity=self.render(rays, self.appearance(img))["opacity"].mean())

    def render(self, rays: Rays, code: Tensor) -> dict[str, Tensor]:
        """render_rays without jitter, for pictures and for fitting codes."""
        shape = len(rays.o), self.cfg.samples + self.cfg.bg_samples  # R, S+B
        return render_rays(self, rays, code, rays.o.new_full(shape, 0.5))


# ---- 8 The paper's two baselines, under the same loop, protocol and meter ------------------------

def positional(x: Tensor, octaves: int) -> Tensor:
    """x (...,n) with sines and cosines of 2^k x: (...,n(1+2 octaves)) (NeRF Eq. 4, no pi)."""
    angle = (x[..., None] * 2.0 ** torch.arange(octaves, device=x.device)).flatten(-2)
    return torch.cat([x, angle.sin(), angle.cos()], -1)


def mlp(*sizes: int) -> nn.Sequential:
    """Linear layers with ReLU between them and after the last."""
    pairs = zip(sizes, sizes[1:])
    return nn.Sequential(*[m for a, b in pairs for m in (nn.Linear(a, b), nn.ReLU())])


def summed(raw: dict[str, Tensor], **health: Tensor) -> tuple[Tensor, dict]:
    """The sum of loss terms, and every figure by name."""
    return sum(raw.values()), {k: v.detach() for k, v in (raw | health).items()}


class RadianceField(nn.Module):
    """NeRF's network: 8 layers with a skip to the fifth, density, then colour."""
    def __init__(self, width: int, code_dim: int):
        super().__init__()
        self.first, self.second = mlp(93, *[width] * 4), mlp(93 + width, *[width] * 4)
        self.density, self.bottleneck = nn.Linear(width, 1), nn.Linear(width, width)
        self.color = nn.Sequential(mlp(width + 27 + code_dim, width // 2), nn.Linear(width // 2, 3))

    def forward(self, x: Tensor, d: Tensor, code: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Density (R,S), colour (R,S,3), bottleneck (R,S,W) at x (R,S,3), d (R,3), code (R,A)."""
        pe = positional(x, 15)  # (R,S,93)
        h = self.second(torch.cat([pe, self.first(pe)], 2))  # (R,S,W)
        neck = self.bottleneck(h)  # (R,S,W)
        return F.softplus(self.density(h)[..., 0].float()), self.paint(neck, d, code), neck

    def paint(self, neck: Tensor, d: Tensor, code: Tensor) -> Tensor:
        """Colour (R,S,3) of samples with bottleneck (R,S,W), under an appearance code (R,A)."""
        per_ray = torch.cat([positional(d, 4), code], 1)[:, None].expand(-1, neck.shape[1], -1)
        return torch.sigmoid(self.color(torch.cat([neck, per_ray], 2)).float())


class NeRFW(Method):
    """NeRF-W (Martin-Brualla et al. 2021): appearance codes, transient head with uncertainty. From
    the paper: two networks, 48 + 16 code dims, losses, lambda_u = 0.01. From its PyTorch version:
    width 256, 64 + 64 samples, beta_min 0.03, Adam 5e-4, 1024 rays, SfM near and far."""

    code_dim, use_mask, adam = 48, True, dict(betas=(0.9, 0.999), eps=1e-8)

    def __init__(self, cfg: Config, scene: Scene):
        super().__init__()
        self.cfg, self.scene = cfg, scene
        self.coarse, self.fine = (RadianceField(cfg.hidden, self.code_dim) for _ in range(2))
        points = scene.points[::20] if len(scene.points) else scene.c2w.new_zeros(1, 3)
        reach = (points - scene.c2w[:, None, :, 3]).norm(dim=2)  # (I,K/20)
        self.register_buffer("far", reach.quantile(0.999, dim=1), persistent=False)  # (I,)
        self.make_heads(len(scene.wh))
        self.to(scene.c2w.device)

    def make_heads(self, photos: int) -> None:
        half = self.cfg.hidden // 2
        self.appearance = nn.Embedding(photos, self.code_dim)
        self.transient = nn.Embedding(photos, 16)
        self.head, self.head_out = mlp(self.cfg.hidden + 16, *[half] * 4), nn.Linear(half, 5)

    def groups(self) -> list[dict]:
        return [dict(params=list(self.parameters()), lr=self.cfg.lr_net)]

    def render(self, rays: Rays, code: Tensor, jitter: Tensor | None = None,
               transient: Tensor | None = None) -> dict[str, Tensor]:
        """Coarse and fine pass. transient: (R,16) codes of the transient head, or None."""
        n, R, dev = self.cfg.samples, len(rays.o), code.device
        u = torch.full((R, 2 * n), 0.5, device=dev) if jitter is None else jitter
        u = (torch.arange(n, device=dev).repeat(2) + u) / n  # (R,2n) stratified twice
        edges = torch.linspace(0, 1, n + 1, device=dev)
        edges = rays.near[:, None] + (self.far[rays.img] - rays.near)[:, None] * edges  # (R,n+1)
        t = inverse_cdf(edges, torch.ones_like(edges[:, 1:]), u[:, :n])  # (R,n)
        out = self.pass_through(self.coarse, rays, t, code, None)
        more = inverse_cdf(edges, out["w"].detach() + 1e-3, u[:, n:])  # (R,n)
        t = torch.cat([t, more], 1).sort(1)[0]  # (R,2n)
        return self.pass_through(self.fine, rays, t, code, transient) | dict(coarse=out["rgb"])

    def pass_through(self, field: RadianceField, rays: Rays, t: Tensor, code: Tensor,
                     transient: Tensor | None) -> dict[str, Tensor]:
        """Densities to a picture: C = sum T (alpha_s c_s + alpha_t c_t) (NeRF-W Eq. 5)."""
        sigma, rgb, neck = field(rays.at(t), rays.d, code)  # (R,S), (R,S,3), (R,S,W)
        dt = F.pad(torch.diff(t), (0, 1), value=100.0)  # (R,S), last opaque
        alpha = 1 - torch.exp(-sigma * dt)  # (R,S)
        if transient is None:
            w, _ = composite(alpha)  # (R,S)
            return dict(rgb=(w[..., None] * rgb).sum(1), depth=(w * t).sum(1), w=w, neck=neck)
        code_t = transient[:, None].expand(-1, t.shape[1], -1)  # (R,S,16)
        h = self.head_out(self.head(torch.cat([neck, code_t], 2)))  # (R,S,5)
        sigma_t, beta = F.softplus(h[..., 0]), F.softplus(h[..., 4])  # (R,S)
        alpha_t = 1 - torch.exp(-sigma_t * dt)  # (R,S)
        w, _ = composite(1 - torch.exp(-(sigma + sigma_t) * dt))  # (R,S)
        before = w / (1 - torch.exp(-(sigma + sigma_t) * dt)).clamp(min=1e-10)  # (R,S) T
        mixed = alpha[..., None] * rgb + alpha_t[..., None] * torch.sigmoid(h[..., 1:4])  # (R,S,3)
        return dict(rgb=(before[..., None] * mixed).sum(1), depth=(w * t).sum(1), w=w,
                    beta=(before * alpha_t * beta).sum(1) + 0.03, sigma_t=sigma_t.mean(1),
                    transient=(before * alpha_t).sum(1))

    def losses(self, rays: Rays, pick: Tensor, gen: torch.Generator):
        """NeRF-W Eq. 13: squared error over learned variance, its log, a price on transients."""
        jitter = torch.rand(len(rays.o), 2 * self.cfg.samples, generator=gen, device=rays.o.device)
        out = in_shares(self.render, rays, self.codes()[rays.img], jitter, self.transient(rays.img))
        error = ((out["rgb"] - rays.rgb) ** 2).sum(1)  # (R,)
        raw = dict(coarse=((out["coarse"] - rays.rgb) ** 2).sum(1).mean() / 2,
                   rgb=(error / (2 * out["beta"] ** 2)).mean(),
                   beta=3 + torch.log(out["beta"]).mean(), sigma=0.01 * out["sigma_t"].mean())
        return summed(raw, mask=out["transient"].mean(), mse=error.mean() / 3)

    def mask_of(self, rays: Rays, pick: Tensor) -> Tensor:
        """Opacity (R,) of the transient part."""
        codes = self.codes()[rays.img], None, self.transient(rays.img)
        return self.render(rays, *codes)["transient"]


class HaNeRF(NeRFW):
    """Ha-NeRF (Chen et al. 2022): appearance from a CNN over the photo, mask by an MLP of pixels.
    From the authors' code: network sizes, 64 + 64 samples, one 32x32 grid of rays per step, loss
    weights, Adam 5e-4. Left out: the mode-seeking term (weight 1e-6), noise on densities."""
    def make_heads(self, photos: int) -> None:
        sizes = [(3, 64, 7, 1), (64, 128, 4, 2), *[(a, 256, 4, 2) for a in (128, 256, 256)]]
        convs = [m for a, b, k, s in sizes for m in (
            nn.Conv2d(a, b, k, s, (k - 1) // 2, padding_mode="reflect"), nn.ReLU())]
        self.encoder = nn.Sequential(*convs, nn.AdaptiveAvgPool2d(1),
                                     nn.Conv2d(256, self.code_dim, 1), nn.Flatten())
        self.register_buffer("bank", torch.zeros(photos, self.code_dim))  # last code of each photo
        self.mask_code = nn.Embedding(photos, 128)
        self.mask_mlp = nn.Sequential(mlp(128 + 42, *[256] * 4), nn.Linear(256, 1), nn.Sigmoid())

    def encode(self, pick: Tensor) -> Tensor:
        """Codes (B,A) of photos (B,)."""
        return self.encoder(self.scene.thumbs[pick].float() / 127.5 - 1)

    @torch.no_grad()
    def codes(self) -> Tensor:
        photos = torch.arange(len(self.scene.wh), device=self.scene.wh.device)
        return torch.cat([self.encode(pick) for pick in photos.split(8)])

    def batch(self, photos: Tensor, gen: torch.Generator) -> tuple[Rays, Tensor]:
        """A square grid of rays over a random window of one photo."""
        pick = photos[torch.randint(len(photos), (1,), generator=gen, device=photos.device)]
        size = 0.5 + 0.5 * torch.rand(1, generator=gen, device=photos.device)
        corner = torch.rand(2, generator=gen, device=photos.device) * (1 - size)
        grid = torch.linspace(0, 1, math.isqrt(self.cfg.rays), device=photos.device)
        uv = torch.cartesian_prod(grid, grid).flip(1) * size + corner  # (R,2)
        w, h = self.scene.wh[pick].T  # (1,), (1,)
        pixel = (uv[:, 1] * (h - 1)).round().long() * w + (uv[:, 0] * (w - 1)).round().long()
        return make_rays(self.scene, pick.expand(len(pixel)), pixel), pick

    def losses(self, rays: Rays, pick: Tensor, gen: torch.Generator):
        """Ha-NeRF Eq. 9: masked colour, a falling price on masks, codes that survive a render: of
        the same rays in another photo's light."""
        R, side = len(rays.o), math.isqrt(self.cfg.rays)
        jitter = torch.rand(R, 2 * self.cfg.samples, generator=gen, device=rays.o.device)
        code = self.encode(pick)  # (1,A)
        other = self.bank[torch.randint(len(self.bank), (1,), generator=gen, device=pick.device)]
        other = torch.where(other.any(), other, code.detach())  # (1,A) of another photo, once known
        self.bank[pick] = code.detach().float()
        out = in_shares(self.render, rays, code.expand(R, -1), jitter, other.expand(R, -1))
        mask = self.mask_of(rays, pick)  # (R,)
        error, coarse = (((out[k] - rays.rgb) ** 2).mean(1) for k in ("rgb", "coarse"))  # (R,)
        window = out["other"].reshape(1, side, side, 3).permute(0, 3, 1, 2)
        again = self.encoder(window * 2 - 1)  # (1,A)
        price = max(6e-3, 5e-2 * math.exp(-1e-3 * self.step))
        raw = dict(rgb=((1 - mask) * error).mean() / 2,
                   coarse=((1 - mask.detach()) * coarse).mean() / 2,
                   size=price * (mask ** 2).mean(), code=1e-5 * (code ** 2).mean(),
                   again=1e-3 * (again - other).abs().mean())
        return summed(raw, mask=mask.mean(), mse=error.mean())

    def pass_through(self, field: RadianceField, rays: Rays, t: Tensor, code: Tensor,
                     other: Tensor | None) -> dict[str, Tensor]:
        """The static picture; with the codes (R,A) of another photo also its colours there."""
        out = super().pass_through(field, rays, t, code, None)
        neck, w = out.pop("neck").detach(), out["w"].detach()[..., None]  # only colours learn
        return out if other is None else out | dict(
            other=(w * field.paint(neck, rays.d, other)).sum(1))

    def mask_of(self, rays: Rays, pick: Tensor) -> Tensor:
        per_ray = torch.cat([self.mask_code(rays.img), positional(rays.uv, 10)], 1)
        return self.mask_mlp(per_ray)[:, 0]


# ---- 9 Energy meter ------------------------------------------------------------------------------

class EnergyMeter:
    """Joules between start() and stop(), by an energy counter and by integrated power samples.
    counter() returns joules; power() watts, integrated by the trapezoid rule every `period`
    seconds. Without either the energy is None, never 0. Windows add up: evaluation can be left out,
    and a resumed run goes on counting."""
    def __init__(self, source=None, counter=None, power=None, period=0.5, clock=time.monotonic):
        self.source, self.counter, self.power = source, counter, power
        self.period, self.clock = period, clock
        self.joules, self.sampled_joules = 0.0 if counter else None, 0.0 if power else None
        self.idle_w = power() if power else None  # read before any work
        self.last = None  # clock, counter and power at the last tick

    def tick(self) -> None:
        """Adds what was spent since the last tick. A failed reading ends metering, not the run."""
        try:
            now = self.clock(), self.counter and self.counter(), self.power and self.power()
        except Exception as error:  # drivers raise what they like
            print(f"  energy is null, as it could not be read any more ({error})")
            self.counter = self.power = self.joules = self.sampled_joules = self.source = None
            return
        if self.last and self.joules is not None:
            self.joules += now[1] - self.last[1]
        if self.last and self.sampled_joules is not None:
            self.sampled_joules += (now[2] + self.last[2]) / 2 * (now[0] - self.last[0])
        self.last = now

    def start(self) -> None:
        self.last, self.stopped = None, threading.Event()
        self.tick()
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self) -> None:
        while not self.stopped.wait(self.period):
            self.tick()

    def stop(self) -> None:
        self.stopped.set()
        self.thread.join()
        self.tick()

    def totals(self) -> list[float | None]:
        """Joules by counter and by samples, over all processes; None if one cannot tell."""
        each = [(agreed(self.joules, i), agreed(self.sampled_joules, i)) for i in range(RANKS)]
        return [None if None in joules else sum(joules) for joules in zip(*each)]

    def report(self) -> dict:
        """Watt-hours by counter, else by samples; None where there is neither."""
        counter, sampled = (None if j is None else j / 3600 for j in self.totals())
        off = abs(counter / sampled - 1) > 0.05 if counter and sampled else None
        return dict(energy_wh=sampled if counter is None else counter, energy_wh_sampled=sampled,
                    energy_source=self.source, energy_disagrees=off, idle_w=self.idle_w)


def rapl_meter(root: str = "/sys/class/powercap") -> EnergyMeter:
    """Processor packages through RAPL where readable (often by root only), or None."""
    packages = [p for p in sorted(Path(root).glob("intel-rapl:*"))
                if p.name.count(":") == 1 and os.access(p / "energy_uj", os.R_OK)]

    def read(name):
        return [int((p / name).read_text()) for p in packages]
    wraps, last, total = read("max_energy_range_uj"), read("energy_uj"), 0

    def counter():  # each package wraps on its own
        nonlocal last, total
        now = read("energy_uj")
        total, last = total + sum((b - a) % w for a, b, w in zip(last, now, wraps)), now
        return total / 1e6
    return EnergyMeter("rapl", counter) if packages else EnergyMeter()


def make_meter(device: torch.device) -> EnergyMeter:
    """NVML for a GPU, found by UUID whatever CUDA_VISIBLE_DEVICES says; RAPL for a CPU; or none."""
    if device.type != "cuda":  # one process reads for its whole machine; side by side none can tell
        return EnergyMeter("rapl", float) if LOCAL_RANK else (
            EnergyMeter() if parent_process() else rapl_meter())
    try:
        import pynvml
        pynvml.nvmlInit()
        uuid = torch.cuda.get_device_properties(device).uuid
        gpu = pynvml.nvmlDeviceGetHandleByUUID(f"GPU-{uuid}")
        power = lambda: pynvml.nvmlDeviceGetPowerUsage(gpu) / 1e3
        counter = lambda: pynvml.nvmlDeviceGetTotalEnergyConsumption(gpu) / 1e3
        try:
            counter()
        except pynvml.NVMLError:  # vGPUs and GPUs before Volta have none
            counter = None
        return EnergyMeter("nvml", counter, power)
    except ImportError:
        print("  no GPU energy: pip install nvidia-ml-py")
    except pynvml.NVMLError as error:
        print(f"  no GPU energy: {error}")
    return EnergyMeter()


# ---- 10 Training ---------------------------------------------------------------------------------

METHODS = {  # class, settings (the baselines': published), those that serve the toy best
    "geonvsw": (GeoNVS, {}, dict(rays=256)),
    "nerfw": (NeRFW, dict(rays=1024, photos=1024, samples=64, hidden=256, lr_net=5e-4),
              dict(rays=256, photos=256, samples=24, hidden=64, lr_net=5e-3)),
    "hanerf": (HaNeRF, dict(rays=1024, photos=1, samples=64, hidden=256, lr_net=5e-4),
               dict(rays=256, samples=16, hidden=64, lr_net=4e-3)),
}
CHECKPOINT_S = 60.0  # seconds of training between checkpoints
PATIENCE = 20  # steps in a row without a finite loss and gradient that stop a run
HEALTH = {  # lowest and highest healthy value after a third of training, and what it can mean
    "zeta": (30, math.inf, "the surface stays blurred: wrong poses or scale, or too few steps"),
    "sfm_opacity": (0.7, math.inf, "rays to SfM points pass through: the background paints the "
                    "landmark; raise --lam_sfm or train longer"),
    "mask": (0, 0.5, "the mask covers half of the picture: raise --lam_mask"),
    "eik": (0, 0.5, "the SDF is no distance: raise --lam_eik or lower --lr_grid"),
    "miss": (0, 0.6, "most rays miss the unit sphere: is it the right landmark that it surrounds?"),
}


class Diverged(UserError):
    """Training was stopped, as its losses or gradients were not finite."""


def make_optimizer(model: Method) -> torch.optim.Adam:
    groups = [group | dict(base_lr=group["lr"]) for group in model.groups()]
    return torch.optim.Adam(groups, **model.adam, fused=True)


def set_learning_rate(optimizer, step: int, progress: float) -> None:
    """Linear warm-up over 20 steps, then a cosine down to 5 %."""
    factor = min(1, (step + 1) / 20) * (0.05 + 0.95 * (1 + math.cos(math.pi * progress)) / 2)
    for group in optimizer.param_groups:
        group["lr"] = group["base_lr"] * factor


def write_text(path: Path, text: str) -> None:
    atomic_write(path, lambda tmp: Path(tmp).write_text(text))


def save_checkpoint(path: Path, cfg: Config, model, optimizer, gen, state: dict) -> None:
    whole = dict(
        geonvs=1, config=asdict(cfg), model=model.state_dict(), optimizer=optimizer.state_dict(),
        octrees=[o.split_keys for o in model.octrees()], rng=gen.get_state(), state=state)

    def write(tmp):
        try:
            torch.save(whole, tmp)
        except RuntimeError as error:  # so torch reports a full disk
            raise OSError(str(error)) from error
    atomic_write(path, write)


def read_checkpoint(path: Path) -> dict:
    """A checkpoint's dictionary: tensors and plain values, never code. Raises UserError."""
    need(path.exists(), f"{path} does not exist: train first, without --resume or --render, or "
         "name the run by the --data, --seed and --name that it was made with")
    try:
        data_prep.refuse_bomb(path)
        saved = dict(torch.load(path, map_location="cpu", weights_only=True))
        config, step = saved["config"], saved["state"]["step"]
        kinds = {f.name: (float, int) if f.type == "float" else type(f.default)
                 for f in fields(Config)}
        need(saved["geonvs"] == 1 and config.keys() == kinds.keys()
             and all(isinstance(config[name], kind) for name, kind in kinds.items())
             and isinstance(step, int) and step >= 0, "")
        return saved
    except Exception as error:  # a damaged file can fail in any layer: zip, pickle, tensor storage
        raise UserError(f"{path} is damaged or not a checkpoint of this program "
                        f"({type(error).__name__}): delete it and train again") from None


def restore(saved: dict, path: Path, model, optimizer, gen: torch.Generator) -> dict:
    """Puts a checkpoint back into model, optimiser and generator; returns its state."""
    try:
        for octree, keys in zip(model.octrees(), saved["octrees"], strict=True):
            octree.build([k.to(octree.features.device) for k in keys])
        model.load_state_dict(saved["model"])
        if optimizer is not None:
            for group, new in zip(optimizer.param_groups, model.groups(), strict=True):
                group["params"] = new["params"]
            optimizer.load_state_dict(saved["optimizer"])
            for group, new in zip(optimizer.param_groups, model.groups()):
                group["base_lr"] = new["lr"]  # flags may have changed it
            for p, moments in optimizer.state.items():
                shapes = dict(step=torch.Size(), exp_avg=p.shape, exp_avg_sq=p.shape)
                if {k: v.shape for k, v in moments.items()} != shapes:
                    raise ValueError("Adam's moments have other shapes")
            gen.set_state(saved["rng"])
        return saved["state"]
    except (KeyError, IndexError, ValueError, RuntimeError, TypeError, AttributeError) as error:
        raise UserError(f"{path} does not fit this scene and these settings "
                        f"({str(error).splitlines()[0][:90]}): delete it or use the flags and "
                        "the kind of device it was made with") from None


LOSS_SCALE = 2.0 ** 10  # lifts small gradients above what float16 can hold


def half_dtype(device: torch.device) -> torch.dtype:
    """What mixed precision computes in: bfloat16, or float16 on GPUs that have no other."""
    lacks = device.type == "cuda" and torch.cuda.get_device_capability(device) < (8, 0)
    return torch.float16 if lacks else torch.bfloat16


def training_step(model: Method, optimizer, photos: Tensor, state: dict, progress: float,
                  gen: torch.Generator) -> tuple[dict, Tensor]:
    """One update. Returns the logs, and 1 if a loss or gradient that is not finite made it void."""
    cfg, device, model.step = model.cfg, photos.device, state["step"]
    rays, pick = model.batch(photos, gen)
    is_half = cfg.amp == "on" or cfg.amp == "auto" and device.type == "cuda"
    half = half_dtype(device)
    with torch.autocast(device.type, half, enabled=is_half):
        loss, logs = model.losses(rays, pick, gen)
    scale = LOSS_SCALE if is_half and half == torch.float16 else 1.0
    optimizer.zero_grad()
    (scale * loss).backward()
    set_learning_rate(optimizer, state["step"], progress)
    grads = [p.grad for p in model.parameters() if p.grad is not None]
    if RANKS > 1:  # their mean over the processes
        flat = nn.utils.parameters_to_vector(grads)
        dist.all_reduce(flat)
        nn.utils.vector_to_parameters(flat.div_(RANKS), grads)
    optimizer.grad_scale = None if scale == 1 else torch.full((), scale, device=device)
    optimizer.found_inf = (~torch.isfinite(nn.utils.get_total_norm(grads) + loss.detach())).float()
    optimizer.step()
    model.maintain(state["step"], progress, optimizer)
    state["step"] += 1
    return logs, optimizer.found_inf.long()


def prepare(cfg: Config, scene: Scene, run: Path, saved: dict | None):
    """What training begins with, new or from a checkpoint: model, optimiser, meter, generator and
    state. The run's folder keeps nothing of a former run, of the log what the checkpoint knows."""
    device = scene.c2w.device
    torch.set_flush_denormal(True)  # vanishing weights would otherwise slow a CPU down
    torch.manual_seed(cfg.seed)
    gen = torch.Generator(device).manual_seed(cfg.seed)
    model = METHODS[cfg.method][0](cfg, scene)
    optimizer, meter = make_optimizer(model), make_meter(device)
    state = dict(step=0, seconds=0.0, dropped=0, curve=[], codes=None)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    if saved is not None:
        state |= restore(saved, run / "checkpoint.pt", model, optimizer, gen)
        state |= dict(joules=0.0, sampled_joules=0.0) if RANK else {}  # what all spent counts once
        meter.joules = state["joules"] if meter.counter else None  # all of it was measured, or None
        meter.sampled_joules = state["sampled_joules"] if meter.power else None
    elif not RANK:  # nothing of a former run may be taken for this one's
        for name in ("checkpoint.pt", "metrics.json", "panel.png", "mesh.ply"):
            (run / name).unlink(missing_ok=True)
    log = run / "log.jsonl"
    lines = log.read_text().splitlines(True) if saved and log.exists() else []
    write_text(log, "".join(k for k in lines if k.endswith("\n")
                            and json.loads(k)["step"] <= state["step"]))
    return model, optimizer, meter, gen, state


def train(cfg: Config, scene: Scene, run: Path, saved: dict | None = None):
    """Trains until cfg.steps or cfg.minutes; writes log.jsonl and checkpoint.pt below run. saved: a
    checkpoint to go on from. Returns model, state (step, seconds, joules, curve), meter. Evaluation
    moments are outside the timed and metered window."""
    model, optimizer, meter, gen, state = prepare(cfg, scene, run, saved)
    device, checkpoint, log_path = scene.c2w.device, run / "checkpoint.pt", run / "log.jsonl"
    photos, held_out = scene.photos(False), scene.photos(True)  # (B,)
    dropped = torch.tensor(state["dropped"], device=device)
    streak, warned = torch.zeros_like(dropped), set()  # void steps in a row; warnings given
    last_line = since = time.perf_counter()
    last_save = state["seconds"]
    meter.start()
    if saved is None:
        model.start(gen)
    for value in model.state_dict().values():
        if RANKS > 1 and torch.is_tensor(value):  # GPUs do not repeat their sums to the last bit
            dist.broadcast(value, 0)

    def clock():  # training seconds so far
        return state["seconds"] + time.perf_counter() - since

    def save():
        state.update(zip(("joules", "sampled_joules"), meter.totals()), dropped=int(dropped))
        save_checkpoint(checkpoint, cfg, model, optimizer, gen, state | dict(seconds=clock()))
    stop = threading.Event()  # Ctrl-C lets a step end, so that what is saved is whole
    handler = signal.signal(signal.SIGINT, lambda *_: stop.set())
    try:
        while True:
            seconds, is_stopped = agreed((clock(), stop.is_set()))
            share = seconds / (60 * cfg.minutes) if cfg.minutes else state["step"] / cfg.steps
            progress = min(share, 1.0)
            if progress == 1 or is_stopped:
                break
            logs, is_dropped = training_step(model, optimizer, photos, state, progress, gen)
            dropped += is_dropped
            streak = (streak + 1) * is_dropped
            if state["step"] % PATIENCE == 0 and int(streak) >= PATIENCE:
                break
            if cfg.curve and len(held_out) and seconds > 4 * 1.6 ** len(state["curve"]):
                int(dropped)  # waits for a GPU: what it has queued is training
                state["seconds"] = clock()
                meter.stop()  # looking costs neither time nor energy
                state["codes"], value = (None, 0) if RANK else validate(
                    model, scene, held_out, state["codes"])
                state["curve"].append(dict(step=state["step"], seconds=state["seconds"], psnr=value,
                                           wh=meter.report()["energy_wh"]))
                meter.start()
                since = time.perf_counter()
            if RANK == 0 and (time.perf_counter() > last_line + 5 or state["step"] == cfg.steps):
                last_line = time.perf_counter()
                logs = model.health() | logs
                report(cfg, log_path, state["step"], clock(), progress, logs, int(dropped), warned)
            if seconds - last_save > CHECKPOINT_S:
                save()
                last_save = seconds
    finally:
        signal.signal(signal.SIGINT, handler)
        if device.type == "cuda":
            torch.cuda.synchronize()
        meter.stop()
        spent = clock()
    save()
    if int(streak) >= PATIENCE:
        raise Diverged(f"the last {int(streak)} steps had no finite loss or gradient; {checkpoint} "
                       "holds the last good weights. Likely causes: learning rates too high (try a "
                       "third of --lr_grid and --lr_net), half precision (--amp off), broken poses")
    need(not is_stopped, f"stopped at step {state['step']}; add --resume to go on")
    state["seconds"] = spent
    return model, state, meter


def report(cfg, log_path, step, seconds, progress, logs, dropped, warned: set) -> None:
    """A line on the terminal and one in log.jsonl; a warning, once, where a figure is unhealthy."""
    values = {k: float(v) for k, v in logs.items()}
    values["psnr"] = -10 * math.log10(max(values.pop("mse"), 1e-10))
    rate, left = step * cfg.rays / seconds, seconds / max(progress, 1e-3) * (1 - progress)
    print(f"  step {step:6d}  psnr {values['psnr']:5.2f}  zeta {values.get('zeta', math.nan):6.1f} "
          f" mask {values['mask']:.3f}  {rate:8.0f} rays/s  {left / 60:5.1f} min left", flush=True)
    with open(log_path, "a") as file:
        file.write(json.dumps(dict(step=step, seconds=seconds, dropped=dropped) | values) + "\n")
    for name, (low, high, meaning) in HEALTH.items() if progress > 1 / 3 else ():
        if name in values and name not in warned and not low <= values[name] <= high:
            warned.add(name)
            print(f"  warning: {name} is {values[name]:.3g}: {meaning}")


# ---- 11 Scoring, mesh, pictures ------------------------------------------------------------------

def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of two uint8 pictures."""
    mse = ((a.astype(np.float64) - b) ** 2).mean()
    return -10 * math.log10(max(mse / 255 ** 2, 1e-10))


def ssim(a: np.ndarray, b: np.ndarray) -> float | None:
    """SSIM of two uint8 pictures: Gaussian window of 11 px, sigma 1.5, no border, or None."""
    if min(a.shape[:2]) < 11:
        return None
    return float(structural_similarity(a, b, channel_axis=2, data_range=255, gaussian_weights=True,
                                       sigma=1.5, use_sample_covariance=False))


LPIPS_WEIGHTS = (  # of AlexNet; of the heads, v0.1
    "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/"
    "lpips/weights/v0.1/alex.pth")


def lpips_from(trunk: dict, heads: dict):
    """Learned perceptual distance (Zhang et al. 2018) from weights of AlexNet and of its heads: a
    function of pictures (B,3,H,W) in 0..1 and others, with the distances (B,)."""
    shapes = (0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1)  # place, stride, padding
    layers = [(trunk[f"features.{at}.weight"], trunk[f"features.{at}.bias"], stride, padding,
               heads[f"lin{i}.model.1.weight"]) for i, (at, stride, padding) in enumerate(shapes)]

    @torch.no_grad()
    def distance(a: Tensor, b: Tensor) -> Tensor:
        mean, std = a.new_tensor([[-0.030, -0.088, -0.188], [0.458, 0.448, 0.450]])[..., None, None]
        x, total = (torch.cat([a, b]) * 2 - 1 - mean) / std, 0
        for i, (weight, bias, stride, padding, head) in enumerate(layers):
            x = F.max_pool2d(x, 3, 2) if i in (1, 2) else x
            x = F.relu(F.conv2d(x, weight, bias, stride, padding))
            fa, fb = F.normalize(x, dim=1, eps=1e-10).chunk(2)
            total = total + ((fa - fb) ** 2 * head).sum(1).mean((1, 2))
        return total
    return distance


def make_lpips(device):
    """LPIPS with its published weights, or None with one line of reason where they can't be had."""
    try:
        return lpips_from(*(torch.hub.load_state_dict_from_url(
            url, map_location=device, progress=False, weights_only=True) for url in LPIPS_WEIGHTS))
    except Exception as error:  # no network, or a damaged file: any layer can fail
        print(f"  lpips is null: its weights could not be downloaded or read ({error})")
        return None


def half_pixels(scene: Scene, photo: int, left: bool) -> Tensor:
    """Pixel numbers of the columns left of w // 2, or from there on. [D12]"""
    w, h = scene.wh[photo].tolist()
    pixel = torch.arange(w * h, device=scene.c2w.device)
    return pixel[(pixel % w < w // 2) == left]


def color_errors(model, scene: Scene, photos: Tensor, codes: Tensor, allowed: list[Tensor], n: int,
                 gen: torch.Generator) -> Tensor:
    """Rendered less true colours (Bn,3) at n random ones of each photo's allowed pixels."""
    pixel = [a[torch.randint(len(a), (n,), generator=gen, device=gen.device)] for a in allowed]
    rays = make_rays(scene, photos.repeat_interleave(n), torch.cat(pixel))
    return model.render(rays, codes.repeat_interleave(n, 0))["rgb"] - rays.rgb


def fit_codes(model, scene: Scene, photos: Tensor, codes: Tensor | None, steps: int, protocol: str,
              rays_per_photo: int = 64) -> Tensor:
    """Appearance codes (B,A) of unseen photos (B,): Adam on random rays of the left halves. [D12]
    Starts from codes, or from the mean code of the training photos. The scene stays untouched."""
    gen, n = torch.Generator(scene.c2w.device).manual_seed(0), rays_per_photo
    if codes is None:
        codes = model.codes()[~scene.is_test].mean(0).expand(len(photos), -1)  # (B,A)
    codes = codes.detach().to(scene.c2w.device, copy=True).requires_grad_()
    if codes.numel() == 0:
        return codes
    sides = (True, False) if protocol == "leaky" else (True,)
    allowed = [torch.cat([half_pixels(scene, i, side) for side in sides]) for i in photos.tolist()]
    adam = torch.optim.Adam([codes], lr=0.1)
    model.requires_grad_(False)
    for step in range(steps):
        adam.param_groups[0]["lr"] = 0.1 * 0.1 ** (step / steps)
        loss = color_errors(model, scene, photos, codes, allowed, n, gen).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    model.requires_grad_(True)
    return codes.detach()


def validate(model, scene: Scene, photos: Tensor, codes: Tensor | None) -> tuple[Tensor, float]:
    """Codes fitted a little further and PSNR, both on left halves of photos (B,): leaks nothing."""
    codes = fit_codes(model, scene, photos, codes, 20, "half", 32)
    gen = torch.Generator(scene.c2w.device).manual_seed(1)
    left = [half_pixels(scene, i, True) for i in photos.tolist()]
    with torch.no_grad():
        errors = color_errors(model, scene, photos, codes, left, 256, gen) ** 2  # (256B,3)
    mse = errors.reshape(len(photos), -1).mean(1).clamp(min=1e-10)  # (B,)
    return codes, (-10 * torch.log10(mse)).mean().item()


RAY_BYTES = 2 ** 20  # memory that a ray takes in rendering: NeRF-W at full size needs 0.6 MiB


@torch.no_grad()
def render_photo(model, scene: Scene, photo: int, code: Tensor,
                 with_mask: bool = True) -> dict[str, np.ndarray]:
    """A photo's view under an appearance code (A,): arrays (H,W,...) by name of render_rays, and
    `truth` (H,W,3); with a mask also `mask` (H,W), what the method thinks of the real photo."""
    w, h = scene.wh[photo].tolist()
    img = torch.tensor([photo], device=scene.c2w.device)
    free = torch.cuda.mem_get_info()[0] if img.is_cuda else 0
    parts, n = [], int(np.clip(free // RAY_BYTES, CHUNK, 2 ** 18))
    for pixel in torch.arange(w * h, device=img.device).split(n):
        rays = make_rays(scene, img.expand(len(pixel)), pixel)
        out = model.render(rays, code.expand(len(pixel), -1))
        out |= dict(truth=rays.rgb) | (dict(mask=model.mask_of(rays, img)) if with_mask else {})
        parts.append({k: v for k, v in out.items() if v[0].numel() in (1, 3)})  # not the samples'
    whole = {k: torch.cat([p[k] for p in parts]).float().cpu().numpy() for k in parts[0]}
    return {k: v.reshape(h, w, *v.shape[1:]) for k, v in whole.items()}


def to_uint8(picture: np.ndarray) -> np.ndarray:
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def score(frame: dict[str, np.ndarray], lpips, device) -> dict:
    """The right half of a rendered photo [D12] against the truth, beside two trivial predictors."""
    half = frame["rgb"].shape[1] // 2
    got, want = to_uint8(frame["rgb"])[:, half:], to_uint8(frame["truth"])[:, half:]
    left = frame["truth"][:, :half]  # its mean colours, row by row, are the trivial predictor
    flat = np.broadcast_to(to_uint8(left.mean(1, keepdims=True)), want.shape)
    mean = np.broadcast_to(flat.mean((0, 1)).round(), want.shape)
    row = dict(psnr=psnr(got, want), psnr_floor=psnr(flat, want), psnr_mean_color=psnr(mean, want),
               ssim=ssim(got, want), lpips=None)
    if lpips is not None and min(got.shape[:2]) >= 32:
        pair = [torch.as_tensor(p, device=device).permute(2, 0, 1)[None] / 255 for p in (got, want)]
        row["lpips"] = lpips(*pair).item()
    return row


def summary(rows: list[dict], key: str) -> tuple[float | None, float | None]:
    """Mean and spread (standard deviation) over rows of a figure; None if no row has it."""
    values = [row[key] for row in rows if row.get(key) is not None]
    return (float(np.mean(values)), float(np.std(values))) if values else (None, None)


def evaluate(model, scene: Scene, cfg: Config, lpips) -> dict:
    """Scores of the test photos by the half-image protocol [D12], per photo and on average."""
    photos, rows, frames, seconds = scene.photos(True), [], [], []  # (B,)
    codes = fit_codes(model, scene, photos, None, 128, cfg.protocol) if len(photos) else []  # (B,A)
    for photo, code in zip(photos.tolist(), codes):
        begin = time.perf_counter()
        name = str(scene.raw["name"][photo])
        frame = render_photo(model, scene, photo, code, hasattr(model, "cgnet"))
        seconds.append(time.perf_counter() - begin)
        rows.append(dict(name=name) | score(frame, lpips, scene.c2w.device))
        frames += [(name, frame)] if len(frames) < 3 else []  # for the panel
    keys = ("psnr", "psnr_floor", "psnr_mean_color", "ssim", "lpips")
    fps = 1 / float(np.median(seconds)) if seconds else None
    means = {k: summary(rows, k)[0] for k in keys}
    return means | dict(per_image=rows, frames_per_second=fps, frames=frames)


@torch.no_grad()
def toy_truth(model, scene: Scene) -> dict:
    """What only a synthetic scene can tell; None where the model has no such part. sdf_error: mean
    |s - s_true| within 0.05 of visible surfaces, scene units. mask_iou, _static: M > 0.5 against
    the true occluders over every fifth training pixel, and mean M on all others."""
    raw, dev = scene.raw, scene.c2w.device
    found = dict.fromkeys(("sdf_error", "mask_iou", "mask_static"))
    has_sdf, surface, mask, occluder = hasattr(model, "sdf"), [], [], []
    for i in scene.photos(False)[:, None]:
        span = slice(*scene.start[int(i):int(i) + 2].tolist())
        pixel = torch.arange(0, span.stop - span.start, 5, device=dev)  # (R,)
        rays = make_rays(scene, i.expand(len(pixel)), pixel)
        depth = torch.as_tensor(raw["depth"][span][::5]).to(dev, torch.float32)  # (R,)
        if has_sdf:
            surface.append(rays.at(depth[:, None])[depth.isfinite()][:, 0])  # (P,3)
        if model.use_mask:
            mask.append(model.mask_of(rays, i).cpu())
            occluder.append(torch.as_tensor(raw["occluder"][span][::5]))
    if has_sdf:
        x, gen = torch.cat(surface), torch.Generator().manual_seed(0)
        x = x + 0.02 * torch.randn(x.shape, generator=gen).to(dev)  # (P,3) around the true surface
        x = x[x.norm(dim=1) < 1]
        x_file = x.cpu().numpy() * raw["scale"] + raw["center"]
        true = torch.as_tensor(data_prep.toy_sdf(x_file, scene.info["background"]) / raw["scale"])
        s = torch.cat([model.sdf(part)[0] for part in x.split(CHUNK)]).cpu()  # (P,)
        found["sdf_error"] = (s - true)[true.abs() < 0.05].abs().mean().item()
    if model.use_mask:
        mask, occluder = torch.cat(mask), torch.cat(occluder)
        both, union = (mask > 0.5) & occluder, (mask > 0.5) | occluder
        found["mask_iou"] = both.sum().item() / union.sum().item() if union.any() else None
        found["mask_static"] = mask[~occluder].mean().item()
    return found


@torch.no_grad()
def extract_mesh(model: GeoNVS, resolution: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface s = 0 inside the unit sphere: vertices (N,3) in SfM units, faces (M,3), uint8
    colours (N,3), by marching cubes over `resolution` cells (default: two per finest octree cell,
    at most 512). Only corners are evaluated that are near the surface by the cached SDF."""
    scene, octree, cache = model.scene, model.sdf.octree, model.cache
    n = resolution or min(2 * octree.resolution(octree.active - 1), 512)
    line = torch.linspace(-1, 1, n + 1, device=cache.device)
    cached = F.interpolate(cache, size=(n + 1,) * 3, mode="trilinear", align_corners=True)[0, 0]
    is_inside = line[:, None, None] ** 2 + line[:, None] ** 2 + line ** 2 < 1  # (n+1,n+1,n+1)
    near = (cached.abs() < 6 / cache.shape[-1]) & is_inside  # (n+1,n+1,n+1)
    volume = torch.ones_like(cached)
    for index in torch.nonzero(near).split(2 ** 16) if near.any() else ():  # (P,3)
        volume[tuple(index.T)] = model.sdf(index * (2 / n) - 1.0)[0]
    cubes = []
    for slab in (slice(i, i + 65) for i in range(0, n, 64)):  # all at once would take gigabytes
        far, high, low = (F.max_pool3d(v[None], 2, 1)[0]
                          for v in (-near[slab].float(), volume[slab], -volume[slab]))
        cubes.append((far < 0) & (high > 0) & (low >= 0))  # corners evaluated, s changes sign
    cubes = F.pad(torch.cat(cubes), (1, 0) * 3)  # skimage looks a cube up at its last corner
    if not cubes.any():
        return np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8)
    vertices, faces, _, _ = marching_cubes(volume.cpu().numpy(), 0, mask=cubes.cpu().numpy(),
                                           gradient_direction="descent")
    x = torch.as_tensor(vertices * (2 / n) - 1, dtype=torch.float32, device=line.device)  # (N,3)
    code, colors = model.codes()[~scene.is_test].mean(0), []  # (A,)
    for part in x.split(2 ** 16):
        _, geo, grad = model.sdf.with_gradient(part)
        normal = F.normalize(grad, dim=1)
        inputs = torch.cat([geo, normal, sh_basis(-normal), code.expand(len(part), -1)], 1)
        colors.append(torch.sigmoid(model.color(inputs)))
    vertices = x.cpu().numpy() * scene.raw["scale"] + scene.raw["center"]
    return vertices, faces, to_uint8(torch.cat(colors).cpu().numpy())


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> None:
    """Binary PLY with a colour per vertex."""
    v = np.empty(len(vertices), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    f = np.empty(len(faces), [("n", "u1"), ("index", "<i4", 3)])
    v["xyz"], v["rgb"], f["n"], f["index"] = vertices, colors, 3, faces
    kinds = [f"float {k}" for k in "xyz"] + [f"uchar {k}" for k in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(v)}",
              *[f"property {kind}" for kind in kinds], f"element face {len(f)}",
              "property list uchar int vertex_indices", "end_header\n"]
    data = "\n".join(header).encode() + v.tobytes() + f.tobytes()
    atomic_write(path, lambda tmp: Path(tmp).write_bytes(data))


def write_png(path: Path, picture: np.ndarray) -> None:
    """RGB uint8 picture to a file."""
    atomic_write(path, lambda tmp: cv2.imwrite(str(tmp), picture[:, :, ::-1]))


def colormap(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """(H,W) to RGB by viridis between low and high."""
    grey = to_uint8((value - low) / max(high - low, 1e-9))
    return cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[:, :, ::-1]


def tiles_of(model, f: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A rendered photo's pictures (H,W,3) uint8 by title."""
    mask = f.get("mask", np.zeros_like(f["depth"]))  # baselines have none for held-out photos
    tiles = {"photo": to_uint8(f["truth"]), "render": to_uint8(f["rgb"]),
             "mask M": colormap(mask, 0, 1)}
    if "normal" in f:
        cfg, errors = model.cfg, [torch.as_tensor(f[k]) for k in ("e_grad", "e_curv")]
        calibration = model.calibration.cpu() if cfg.gpl == "calibrated" else None
        phi = edge_indicator(*errors, cfg.lam_grad, cfg.lam_lap, calibration).numpy()
        tiles["geometry map"] = colormap(f["opacity"] * phi, 0, 1)
    tiles["depth"] = colormap(1 / f["depth"], *np.quantile(1 / f["depth"], (0.02, 0.98)))
    if "normal" in f:
        tiles["normals"] = to_uint8(f["normal"] / 2 + 0.5)
    return tiles


def panel(model, frames: list[tuple[str, dict]], height: int = 180) -> np.ndarray:
    """The paper's Fig. 2: a row per photo; photo, render, mask, geometry map, depth, normals."""
    widths = [round(f["rgb"].shape[1] * height / f["rgb"].shape[0]) for _, f in frames]
    rows = []

    def write(picture, text, at, size, color):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, cv2.LINE_AA)
    for (name, f), w in zip(frames, widths):
        how = cv2.INTER_AREA if w < f["rgb"].shape[1] else cv2.INTER_CUBIC
        tiles = {title: cv2.resize(tile, (w, height), interpolation=how)
                 for title, tile in tiles_of(model, f).items()}
        rows.append(np.concatenate([
            np.pad(tile, ((2, 2), (2, 2 + max(widths) - w), (0, 0)), constant_values=255)
            for tile in tiles.values()], 1))
        write(rows[-1], name, (6, height - 4), 0.36, (255, 255, 255))
    head = np.full((20, rows[0].shape[1], 3), 255, np.uint8)
    for i, title in enumerate(tiles):
        write(head, title, (6 + i * (max(widths) + 4), 14), 0.45, (0, 0, 0))
    return np.concatenate([head, *rows])


def finish(model, scene: Scene, cfg: Config, state: dict, energy: dict, run: Path) -> dict:
    """Scores a trained model and writes metrics.json, panel.png and mesh.ply below run."""
    is_gpu = scene.c2w.is_cuda
    peak = torch.cuda.max_memory_allocated() if is_gpu else None  # of training, not of scoring
    scores = evaluate(model, scene, cfg, make_lpips(scene.c2w.device))
    frames = [(f"held out: {name}", frame) for name, frame in scores.pop("frames")]
    busy = scene.photos(False)
    if hasattr(model, "logits"):  # training photos with most on the mask
        busy = busy[model.logits[busy].sigmoid().mean((1, 2, 3)).argsort(descending=True)]
    for i in busy[:2].tolist():
        frame = render_photo(model, scene, i, model.codes()[i])
        frames.append((f"training: {scene.raw['name'][i]}", frame))
    write_png(run / "panel.png", panel(model, frames))
    if hasattr(model, "sdf"):
        write_ply(run / "mesh.ply", *extract_mesh(model))
    octrees, cpu = model.octrees(), f"cpu, {torch.get_num_threads()} threads"
    structure = sum(o.bytes() - 4 * o.features.numel() for o in octrees)
    git = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    fitted = "left half" if cfg.protocol == "half" else "WHOLE photo (leaky)"
    metrics = dict(
        scene=scene.info["scene"], method=cfg.method, seed=cfg.seed, steps=state["step"],
        device=torch.cuda.get_device_name() if is_gpu else cpu,
        **scores, train_seconds=state["seconds"], **energy,
        curve=state["curve"], dropped=state["dropped"], processes=RANKS,
        rays_per_second=state["step"] * cfg.rays / max(state["seconds"], 1e-9),
        parameters=sum(p.numel() for p in model.parameters()),
        octree_cells=[len(c) for o in octrees[:1] for c in o.cells] or None,
        octree_bytes=octrees[0].bytes() if octrees else None,
        model_bytes=sum(p.numel() * p.element_size() for p in model.parameters()) + structure,
        peak_memory_bytes=peak if is_gpu else peak_rss(),
        protocol=f"appearance fitted on the {fitted}, scored on the right half",
        torch=torch.__version__, python=sys.version.split()[0], config=asdict(cfg),
        commit=shutil.which("git") and subprocess.run(
            git, capture_output=True, text=True).stdout.strip() or None)
    if scene.info["kind"] == "toy":
        metrics |= toy_truth(model, scene)
    write_text(run / "metrics.json", json.dumps(metrics, indent=1))
    return metrics


def camera_path(c2w: Tensor, count: int, keys: int = 6) -> Tensor:
    """A smooth path (count,3,4) through cameras (B,3,4), along the axis on which they spread."""
    centre = c2w[:, :, 3] - c2w[:, :, 3].mean(0)  # (B,3)
    order = (centre @ torch.linalg.svd(centre)[2][0]).argsort()  # (B,)
    stops = torch.linspace(0, len(order) - 1, min(keys, len(order))).round().long()
    stops = c2w[order[stops]]  # (keys,3,4)
    u = torch.linspace(0, len(stops) - 1 - 1e-4, count)  # (count,)
    i = u.long()
    f = (u - i)[:, None, None].to(c2w)
    f = f * f * (3 - 2 * f)  # rests at every key
    path = torch.lerp(stops[i], stops[(i + 1).clamp(max=len(stops) - 1)], f)  # (count,3,4)
    left, _, right = torch.linalg.svd(path[:, :, :3])  # the nearest rotation
    return torch.cat([left @ right, path[:, :, 3:]], 2)


def film(model, scene: Scene, kind: str, path: Path, count: int = 72) -> None:
    """mp4 at 24 frames/s: a path through the training cameras, or one view in all appearances."""
    photos = scene.photos(False)
    c2w, codes = scene.c2w[photos], model.codes()[photos]
    centre = c2w[:, :, 3].mean(0)
    view = photos[(c2w[:, :, 3] - centre).norm(dim=1).argmin()].item()  # the middle one
    w, h = (scene.wh[view] // 2 * 2).tolist()
    if kind == "orbit":
        poses, codes = camera_path(c2w, count), codes.mean(0).expand(count, -1)
    else:
        need(codes.numel(), "this run has no appearance codes: --render orbit shows what it has")
        u = torch.linspace(0, len(photos) - 1.001, count)[:, None].to(codes)
        i = u[:, 0].long()
        codes = torch.lerp(codes[i], codes[i + 1], u % 1)
        poses = scene.c2w[view].expand(count, 3, 4)

    def write(tmp):
        video = cv2.VideoWriter(str(tmp), cv2.VideoWriter_fourcc(*"mp4v"), 24, (w, h))
        if not video.isOpened():
            raise OSError("OpenCV cannot write mp4 here")
        for pose, code in zip(poses, codes):
            moved = scene.c2w.clone()
            moved[view] = pose
            frame = render_photo(model, scene._replace(c2w=moved), view, code, False)["rgb"]
            video.write(np.ascontiguousarray(to_uint8(frame)[:h, :w, ::-1]))
        video.release()
    atomic_write(path, write)
    print(f"wrote {path}")


def peak_rss() -> int | None:
    """Largest resident memory of this process, bytes; None where several runs share a process."""
    if parent_process():
        return None
    import resource  # absent on Windows
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


# ---- 12 Experiments: speed against accuracy, what each piece buys, where methods fail ------------

PIECES = {  # of the method, one changed at a time
    "full": {}, "no GPL": dict(lam_gpl=0.0), "literal GPL": dict(gpl="literal"),
    "no mask": dict(mask="off"), "no appearance": dict(appearance="off"),
    "no SfM term": dict(lam_sfm=0.0), "no background": dict(background="off"),
    "no curvature": dict(lam_curv=0.0), "no Lipschitz": dict(lam_lps=0.0),
    "uniform sampling": dict(sampling="uniform"), "printed alpha": dict(alpha="printed"),
    "finite differences": dict(normals="fd"), "uniform grid": dict(grid="uniform"),
    "half depth": dict(levels=-1), "double depth": dict(levels=1),  # so many more levels
}
RIVALS = {method + how: dict(method=method, tuned=bool(how))
          for method in ("geonvsw", "nerfw", "hanerf") for how in ("", " tuned")}
FRONT = {f"{rays} rays x {n} samples": dict(rays=rays, samples=n, bg_samples=n)
         for rays in (256, 512, 1024) for n in (8, 16, 24)}
FRONT |= {f"512 x 16, {k}": PIECES[k] for k in ("half depth", "double depth")}
CALM = dict(occluders=0.2, exposure=1.0, photos=24, pose_noise=0.0, amp="off")  # of a 64 px toy,
STRESS = {  # and one knob turned at a time
    "occluders": (0.0, 0.2, 0.4, 0.6), "exposure": (0.0, 1.0, 2.0), "photos": (6, 24, 48),
    "pose_noise": (0.0, 1.0, 4.0), "amp": ("off", "on")}
KNOB_UNITS = dict(occluders="share of occluders", exposure="exposure spread", amp="half precision",
                  photos="training photos", pose_noise="pose noise, px")
SMALL = dict(steps=300, rays=256, mask_px=64, mask_every=2, bg_samples=8)  # half a minute each
STRESS_METHODS = {piece: PIECES[piece] | SMALL for piece in
                  ("full", "no GPL", "literal GPL", "no mask", "no appearance")}
STRESS_METHODS |= {method: RIVALS[f"{method} tuned"] | dict(minutes=0.5)
                   for method in ("nerfw", "hanerf")}
COLORS = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999"
FIGURES = ("psnr", "psnr_floor", "ssim", "sdf_error", "mask_iou", "mask_static", "octree_bytes",
           "rays_per_second", "train_seconds", "energy_wh", "parameters")


def read_metrics(run: Path) -> dict:
    path = run / "metrics.json"
    need(path.exists(), f"{run} holds no metrics.json: give folders of finished runs")
    try:
        metrics = json.loads(path.read_text())
        has_score = "failed" in metrics or metrics["psnr"] is not None
    except (ValueError, KeyError, TypeError):
        raise UserError(f"{path} is damaged or not of this program: train that run again") from None
    need(has_score, f"{run} has no scores, as its scene holds no photos out: see README")
    return metrics


def run_once(given: dict, run: Path) -> dict:
    """Metrics of one training; given may hold "toy", knobs of make_toy. What it prints goes to
    log.txt. A finished run of the same settings is read; one that diverged is a result, too."""
    toy, given = given.get("toy"), {k: v for k, v in given.items() if k != "toy"}
    cfg = make_config(given)
    done, source = run / "metrics.json", scene_file(cfg)
    is_newer = done.exists() and source.exists() and source.stat().st_mtime > done.stat().st_mtime
    if not done.exists() or is_newer and not toy or read_metrics(run)["config"] != asdict(cfg):
        run.mkdir(parents=True, exist_ok=True)
        with open(run / "log.txt", "w") as log, contextlib.redirect_stdout(log):
            try:
                execute(cfg, data_prep.make_toy(**toy) if toy else find_scene(cfg), run)
            except Diverged as error:
                write_text(run / "metrics.json", json.dumps(
                    dict(failed=str(error), method=cfg.method, curve=[], config=asdict(cfg))))
    metrics = read_metrics(run)
    said = metrics.get("failed") or "{psnr:.2f} dB, {train_seconds:.0f} s".format(**metrics)
    print(f"{run}: {said}", flush=True)
    return metrics


def matrix(kind: str, rows: dict[str, dict], given: dict, seeds: int, workers: int = 1) -> dict:
    """Metrics, a list over seeds, of every row (settings by name, levels relative to the scene's).
    workers: CPU processes that train side by side, a thread each, which is faster than one after
    the other with all threads."""
    cfg = make_config(given)
    scene, folder = find_scene(cfg), Path("runs") / kind  # made once, before processes start
    need(scene["is_test"].any(), "experiments need held-out photos: give a split file, see README")
    levels, jobs = cfg.levels or levels_for_footprint(float(scene["footprint"])), []
    for (name, row), seed in itertools.product(rows.items(), range(seeds)):
        deeper = {"levels": max(1, levels + row["levels"])} if "levels" in row else {}
        jobs.append((given | row | deeper | dict(seed=seed),
                     folder / f"{name}-{seed}".replace(" ", "_")))
    for job, _ in jobs:  # a row that cannot work is refused before the first is run
        check(make_config({k: v for k, v in job.items() if k != "toy"}))
    if workers == 1:
        done = [run_once(*job) for job in jobs]
    else:
        with ProcessPoolExecutor(workers, get_context("spawn"), torch.set_num_threads, [1]) as pool:
            done = list(pool.map(run_once, *zip(*jobs)))
    return {name: done[i * seeds:(i + 1) * seeds] for i, name in enumerate(rows)}


def table_line(name: dict, metrics: list[dict]) -> dict:
    """A line of a table: mean and spread over seeds. Failures, runs that diverged or ended below a
    picture of one colour, are counted in a column of their own."""
    cells = [m["octree_cells"] for m in metrics if m.get("octree_cells")]
    failures = sum("failed" in m or m["psnr"] < m["psnr_mean_color"] for m in metrics)
    line = name | dict(runs=len(metrics), failures=failures,
                       cells=float(np.mean([sum(c) for c in cells])) if cells else None)
    pairs = ((key, summary(metrics, key)) for key in FIGURES)
    return line | {k: v for key, pair in pairs for k, v in zip((key, key + "_std"), pair)}


def plotting():
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise UserError("charts need matplotlib: pip install matplotlib") from None
    plt.switch_backend("Agg")
    return plt


def publish(kind: str, rows: list[dict], figure) -> None:
    """<kind>.csv of rows with the same keys, where None stays empty, and <kind>.png."""
    text = io.StringIO()
    cells = [[f"{v:.5g}" if isinstance(v, float) else v for v in row.values()] for row in rows]
    csv.writer(text, lineterminator="\n").writerows([list(rows[0]), *cells])
    write_text(Path(f"{kind}.csv"), text.getvalue())
    atomic_write(Path(f"{kind}.png"), lambda tmp: figure.savefig(tmp, dpi=110, bbox_inches="tight"))
    print(f"wrote {kind}.csv and {kind}.png")


def reached(curve: list[dict], level: float, unit: str) -> float | None:
    """Seconds or watt-hours at which a curve first reaches a PSNR, log-interpolated, or None."""
    for a, b in zip([None] + curve, curve):
        if b["psnr"] >= level and b[unit] is not None:
            if a is None or b["psnr"] == a["psnr"]:
                return b[unit]
            f = (level - a["psnr"]) / (b["psnr"] - a["psnr"])
            return a[unit] ** (1 - f) * b[unit] ** f
    return None


def pareto(points: list[tuple]) -> list[tuple]:
    """Of points (cost, quality) those that no other beats at the same cost or less."""
    return [(x, y) for x, y in points if not any(a <= x and b > y for a, b in points)]


def plot_curves(axis, groups: dict[str, list[dict]], unit: str, xlabel: str) -> None:
    """PSNR over seconds or watt-hours: mean and range over seeds; rings mark the Pareto front."""
    points = []
    for i, (name, metrics) in enumerate(groups.items()):
        curves = [m["curve"] for m in metrics if m["curve"]]
        n = min(map(len, curves), default=0)
        if n and all(point[unit] is not None for c in curves for point in c):
            x, y = (np.array([[p[k] for p in c[:n]] for c in curves]) for k in (unit, "psnr"))
            style = dict(color=COLORS[i % 8], marker="os^Dv"[i % 5], ls=("-", "--", ":")[i % 3])
            axis.plot(x.mean(0), y.mean(0), label=f"{name} ({len(curves)} seeds)", ms=4, **style)
            axis.fill_between(x.mean(0), y.min(0), y.max(0), color=COLORS[i % 8], alpha=0.2)
            points += zip(x.mean(0), y.mean(0))
    if points:
        axis.plot(*zip(*pareto(points)), "o", mfc="none", mec="black", ms=9, label="Pareto front")
        floor, _ = summary([m for metrics in groups.values() for m in metrics], "psnr_floor")
        axis.axhline(floor, color="grey", lw=1, label="trivial predictor")
        axis.set_xscale("log", subs=(2, 5))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("{x:g}")
        axis.legend(fontsize=8, ncol=3, loc="upper left", bbox_to_anchor=(0, -0.13))
    else:
        axis.text(0.5, 0.5, f"no {unit} in these runs\n(needs --curve\nand a counter)",
                  ha="center", va="center", transform=axis.transAxes)
    axis.set(xlabel=xlabel, ylabel="PSNR on held-out left halves, dB")
    axis.grid(alpha=0.3, which="both")


def chart(kind: str, groups: dict[str, list[dict]]) -> None:
    """<kind>.png: PSNR over seconds and watt-hours, a curve a row; <kind>.csv: the table, with time
    and energy to PSNR levels, and to where each baseline's better row ends, over what that took."""
    plt, rows, goals = plotting(), [], {f"{n}dB": dict(psnr=float(n)) for n in range(14, 32)}
    finished = [m for metrics in groups.values() for m in metrics if "failed" not in m]
    need(finished, "all of these runs failed: the log.txt of each says why")
    for rival in ("nerfw", "hanerf"):
        ends = [[m["curve"][-1] for m in metrics] for name, metrics in groups.items()
                if name.startswith(rival) and all(m["curve"] for m in metrics)]
        if ends:
            best = max(ends, key=lambda points: summary(points, "psnr")[0])
            goals[f"{rival}_end"] = {k: summary(best, k)[0] for k in ("psnr", "seconds", "wh")}
    for name, metrics in groups.items():
        row, curves = table_line(dict(row=name), metrics), [m["curve"] for m in metrics]
        for unit, (end, goal) in itertools.product(("seconds", "wh"), goals.items()):
            hits = [reached(curve, goal["psnr"], unit) for curve in curves]
            row[f"{unit}_to_{end}"] = mean = None if None in hits else float(np.mean(hits))
            if unit in goal:
                row[f"{unit}_ratio_{end}"] = mean / goal[unit] if mean and goal[unit] else None
        rows.append(row)
    has_energy = any(p["wh"] for m in finished for p in m["curve"])
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), sharey=True,
                                width_ratios=(1, 1 if has_energy else 0.3))
    plot_curves(axes[0], groups, "seconds", "training time, s")
    plot_curves(axes[1], groups, "wh", "energy, Wh")
    figure.suptitle("{scene}: speed against accuracy ({device})".format(**finished[0]))
    publish(kind, rows, figure)


def ablation(given: dict, seeds: int, workers: int) -> None:
    """What each piece buys, the octree's depth and shape among them: ablation.csv and png."""
    plt, cfg = plotting(), make_config(given)
    groups = matrix(f"ablation-{scene_name(cfg)}", PIECES, given, seeds, workers)
    table = [table_line(dict(row=name), metrics) for name, metrics in groups.items()]
    shown = dict(psnr="PSNR, dB", sdf_error="SDF error, radii", mask_iou="mask IoU",
                 octree_bytes="octree, bytes", rays_per_second="training, rays/s")
    figure, axes = plt.subplots(1, len(shown), figsize=(15, 0.33 * len(table) + 1), sharey=True)
    for axis, (key, label) in zip(axes, shown.items()):
        mean, std = (np.array([r[k] for r in table], float) for k in (key, key + "_std"))
        axis.barh([r["row"] for r in table], mean, xerr=std, color=COLORS[0])
        axis.axvline(mean[0], color="black", lw=1)
        has_low = key == "psnr" and np.isfinite(mean).any()
        axis.set(xlabel=label, xlim=(np.nanmin(mean) - 1, None) if has_low else None)
    axes[0].invert_yaxis()
    figure.suptitle(f"{scene_name(cfg)}: one piece changed at a time, {seeds} seeds")
    publish("ablation", table, figure)


def stress(given: dict, seeds: int, workers: int) -> None:
    """Where methods fail: stress.csv and png, over one knob of a small toy at a time."""
    plt, names, rows = plotting(), {}, {}
    for knob, values in STRESS.items():
        for value, (method, settings) in itertools.product(values, STRESS_METHODS.items()):
            toy = CALM | {knob: value}
            name = "-".join(map(str, (method, *toy.values())))  # knobs share their calm cell
            names[knob, value, method] = name
            rows[name] = settings | dict(amp=toy.pop("amp"), toy=toy | dict(size=64))
    groups = matrix("stress", rows, given, seeds, workers)
    table = [table_line(dict(knob=knob, value=value, method=method), groups[name])
             for (knob, value, method), name in names.items()]
    figure, axes = plt.subplots(2, len(STRESS), figsize=(16, 7), sharey="row")
    for pair, (knob, values) in zip(axes.T, STRESS.items()):
        for i, method in enumerate(STRESS_METHODS):
            mine = [r for r in table if (r["knob"], r["method"]) == (knob, method)]
            for axis, key in zip(pair, ("psnr", "sdf_error")):
                mean, std = (np.array([r[k] for r in mine], float) for k in (key, key + "_std"))
                axis.errorbar(range(len(values)), mean, std, color=COLORS[i], marker="os^Dv<>"[i],
                              ms=4, capsize=2, label=method)
                axis.set_xticks(range(len(values)), values)
        failures = sum(r["failures"] for r in table if r["knob"] == knob)
        pair[0].set_title(f"{failures} failed runs", fontsize=9)
        pair[1].set_xlabel(KNOB_UNITS[knob])
    axes[0, 0].set_ylabel("PSNR, dB")
    axes[1, 0].set_ylabel("SDF error, radii")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), ncol=7, loc="lower center",
                  bbox_to_anchor=(0.5, -0.03))
    publish("stress", table, figure)


# ---- 13 Command line -----------------------------------------------------------------------------

def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0], allow_abbrev=False,
                                     argument_default=argparse.SUPPRESS)

    def error(message):  # bad flags end with one sentence that names the nearest right one
        for word in message.split():
            near = difflib.get_close_matches(word.split("=")[0], parser._option_string_actions, 1)
            if word.startswith("--") and near and "unrecognized" in message:
                message += f"; did you mean {near[0]}?"
        raise UserError(f"{message} (python geonvs.py --help lists all flags)")
    parser.error = error
    for f in fields(Config):
        more = dict(type=type(f.default), choices=f.metadata["choices"])
        if f.type == "bool":
            more = dict(action=argparse.BooleanOptionalAction)
        parser.add_argument(f"--{f.name}", help=f"{f.metadata['help']} [{f.default}]", **more)
    add = parser.add_argument
    add("--resume", action="store_true", help="go on from the run's checkpoint")
    add("--chart", nargs="*", metavar="RUN", help="speed against accuracy: of finished runs, or of "
        "the three methods trained now")
    add("--front", action="store_true", help="quality against speed of the method's own knobs")
    add("--ablation", action="store_true", help="what each piece buys")
    add("--stress", action="store_true", help="where methods fail: the toy's knobs, one by one")
    add("--seeds", type=int, help="seeds of --chart, --front, --ablation and --stress [3]")
    add("--render", choices=("orbit", "appearance"), help="write a short film of a finished run")
    return parser


def pick_device(name: str) -> torch.device:
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    names = ["cpu", *(f"cuda:{i}" for i in range(count))]
    chosen = ("cuda" if count else "cpu") if name == "auto" else name
    if chosen == "cuda" or chosen in names[1:] and RANKS > 1:
        chosen = f"cuda:{LOCAL_RANK}"  # each process has its own
    need(chosen in names, f"--device {name} is not there: this machine has {', '.join(names)}")
    return torch.device(chosen)


def scene_name(cfg: Config) -> str:
    return Path(cfg.data).resolve().name if cfg.data else cfg.scene


def scene_file(cfg: Config) -> Path:
    return data_prep.scene_path(cfg.data or cfg.scene, bool(cfg.data))


def find_scene(cfg: Config) -> dict:
    """The scene of a configuration from its file, made on first use or when the split file or the
    reconstruction of its folder is newer. Raises UserError."""
    path, is_toy = scene_file(cfg), not cfg.data and cfg.scene == "toy"
    scene = data_prep.read_scene(path) if path.exists() else None
    info = json.loads(str(scene["info"])) if scene else {}
    split = info.get("split")  # named by data_prep.py --split
    folders = [cfg.data] if cfg.data else [] if is_toy else [
        f"data/{name}" for name in (cfg.scene, data_prep.SCENES[cfg.scene][0])]
    sources = [Path(split)] if split else [t for f in folders for t in Path(f).glob("[!.]*.tsv")]
    sources += [model for f in folders for model in Path(f).glob("**/images.bin")]
    is_old = scene and any(
        s.exists() and s.stat().st_mtime > path.stat().st_mtime for s in sources)
    if scene and not is_old and (is_toy or info["downscale"] == cfg.downscale):
        return scene
    print(f"making {path}")
    if cfg.data:
        scene = data_prep.prepare(cfg.data, cfg.downscale, split)
    elif is_toy:
        scene = data_prep.make_toy()
    else:
        scene = data_prep.locate_and_prepare(cfg.scene, "data", cfg.downscale, split)
    data_prep.write_scene(path, scene)
    return scene


def check(cfg: Config) -> None:
    """Refuses settings that cannot work, before anything is written."""
    for name, value in asdict(cfg).items():
        if isinstance(value, (int, float)) and not 0 <= value < 2 ** 63:
            raise UserError(f"--{name} {value} makes no sense: use a number >= 0")
    least = dict(samples=2, bg_samples=2, rays=2 * RANKS, mask_px=16) | dict.fromkeys(
        ("photos", "steps", "downscale", "channels", "hidden", "mask_every", "bg_levels"), 1)
    least |= dict(rays=256) if cfg.method == "hanerf" else {}  # its encoder reads the grid of rays
    for name, bound in least.items():
        if getattr(cfg, name) < bound:
            raise UserError(f"--{name} {getattr(cfg, name)} is too small: use at least {bound}")
    if max(cfg.levels, cfg.bg_levels) > 9:
        raise UserError("--levels and --bg_levels go up to 9: 4096 cells a side")
    if cfg.method == "hanerf" and math.isqrt(cfg.rays) ** 2 != cfg.rays:
        raise UserError(f"--rays {cfg.rays} is no square, as hanerf's grid of rays needs: try 1024")
    if cfg.rays % cfg.photos:
        raise UserError(f"--rays {cfg.rays} must be a multiple of --photos {cfg.photos}")


def execute(cfg: Config, arrays, run: Path, saved: dict | None = None) -> dict:
    """Trains and scores one model on the dictionary of a scene file; returns its metrics."""
    device = pick_device(cfg.device)
    scene = load_scene(arrays, device, cfg.mask_px)
    run.mkdir(parents=True, exist_ok=True)
    print(f"{cfg.method} on {scene.info['scene']}: {len(scene.wh)} photos "
          f"({len(scene.photos(True))} held out), {len(scene.rgb):,} pixels; {device}; {run}/")
    model, state, meter = train(cfg, scene, run, saved)
    energy = meter.report()  # of all processes
    metrics = agreed(RANK or finish(model, scene, cfg, state, energy, run))
    shown = ("psnr", "psnr_floor", "ssim", "lpips", "sdf_error", "mask_iou", "mask_static",
             "train_seconds", "energy_wh")
    print("".join(f"  {k} {metrics[k]:.4g}" for k in shown if metrics.get(k) is not None))
    return metrics


def make_config(given: dict) -> Config:
    """Config's defaults, the scene's settings, the method's, the preset's factors, then flags."""
    chosen = {} if given.get("data") else dict(SCENES.get(given.get("scene", "toy"), {}))
    method, preset = given.get("method", "geonvsw"), given.get("preset", "default")
    _, published, tuned = METHODS[method]
    chosen |= published | (tuned if given.get("tuned") else {})
    for name, factor in PRESETS[preset].items() if method == "geonvsw" else ():
        chosen[name] = round(chosen.get(name, getattr(Config, name)) * factor)
    return Config(**chosen | given)


def main(argv: list[str] | None = None) -> None:
    given = vars(make_parser().parse_args(argv))
    commands = {k: given.pop(k) for k in set(given) - {f.name for f in fields(Config)}}
    cfg, seeds, saved = make_config(given), commands.get("seeds", 3), None
    run = Path("runs") / (cfg.name or f"{scene_name(cfg)}-{cfg.method}-{cfg.seed}")
    if {"resume", "render"} & set(commands):
        if {"preset", "tuned"} & set(given):
            raise UserError("--preset and --tuned are for new runs: a saved one keeps its settings")
        saved = read_checkpoint(run / "checkpoint.pt")
        cfg = Config(**saved["config"] | given)
    check(cfg)
    if seeds < 1 or RANKS > 1 and {"chart", "front", "ablation", "stress"} & set(commands):
        raise UserError("experiments need --seeds of at least 1 and one process, not torchrun")
    device = pick_device(cfg.device)
    workers = 1 if device.type == "cuda" else torch.get_num_threads()
    timed = dict(minutes=0.0 if "steps" in given else 2.0, curve=True) | given  # all threads
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if RANKS > 1:
        dist.init_process_group("cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo",
                                timeout=datetime.timedelta(days=1))  # the first scores alone
        sys.stdout = open(os.devnull, "w") if RANK else sys.stdout
    if commands.get("chart"):
        runs = [read_metrics(Path(run)) for run in commands["chart"]]
        names = [m["method"] + " tuned" * m["config"]["tuned"] for m in runs]
        chart("chart", {name: [m for m, n in zip(runs, names) if n == name]
                        for name in RIVALS if name in names})
    elif "chart" in commands:
        rows = {name: row for name, row in RIVALS.items() if row["tuned"] == cfg.tuned}
        chart("chart", matrix(f"chart-{scene_name(cfg)}", rows, timed, seeds))
    elif "front" in commands:
        chart("front", matrix(f"front-{scene_name(cfg)}", FRONT, timed, seeds, workers))
    elif "ablation" in commands:
        ablation(given, seeds, workers)
    elif "stress" in commands:
        stress(given, seeds, workers)
    elif "render" in commands:
        scene = load_scene(find_scene(cfg), device, cfg.mask_px)
        model = METHODS[cfg.method][0](cfg, scene)
        restore(saved, run / "checkpoint.pt", model, None, None)
        film(model, scene, commands["render"], run / f"{commands['render']}.mp4")
    else:
        try:
            arrays = RANK or find_scene(cfg)
        finally:  # the others read what the first one made, or fail as it did
            agreed(None)
        execute(cfg, find_scene(cfg) if RANK else arrays, run, saved)


def run_command_line(entry) -> None:
    """Exit code 0, or 2 with one sentence on stderr."""
    try:
        return entry()
    except UserError as error:
        message = str(error)
    except torch.OutOfMemoryError:
        message = "the GPU's memory is full: lower --samples or --max_mb, or --rays in a new run"
    except OSError as error:  # a full disk, a folder without permission
        message = f"{error}: free or choose a place, then go on with --resume"
    except KeyboardInterrupt:  # outside the training loop, which ends its step and saves
        message = "stopped; the last checkpoint stays, --resume goes on from it"
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    run_command_line(main)
    if RANKS > 1:
        dist.destroy_process_group()
