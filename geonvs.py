"""Geo-NVS-w: a signed distance field, fed by tourist photos, becomes a picture from a new view.

A minimal single-file reference implementation of "Geo-NVS-w: Geometry-Aware Novel View Synthesis
In-the-Wild with an SDF Renderer" (Tsalakopoulos et al., ICCV 2025 workshops). Sections 2-7 follow
one ray from the pixel to the loss; then comes the training loop around it.

    python geonvs.py                       toy scene: made, trained, scored (minutes, 2 CPU cores)
    python geonvs.py --scene brandenburg   a Phototourism scene (one GPU); also sacre, trevi, taj
    python geonvs.py --data DIR            your own COLMAP folder
    torchrun --nproc_per_node 4 geonvs.py  on 4 GPUs that share the rays of each step
    python geonvs.py --help                every setting with its meaning and default

Conventions
  world     the foreground is the unit sphere; x_file = x * scale + center leads back to SfM units
  cameras   c2w (3,4) camera to world, OpenCV axes: x right, y down, z forward; pixel centres +0.5
  rays      r(t) = o + t d with |d| = 1, so t is a distance along the ray and not a z-depth
  sdf       positive outside; the normal is the unit gradient; colours are sRGB in [0, 1]
  mask      M = 1 means transient (person, car), M = 0 means scene
  shapes    R rays, S samples per ray, P points, N cells, pixels or sections, L octree levels, C
            channels per level, V rows of features, H hidden width, G what colour is read from, A
            appearance dims, B photos of all I, K SfM points, T sightings of them, m side of a mask

Where the printed paper is departed from, the line carries its tag:
  [D1]  alpha is divided by sigmoid(zeta s_prev), never negative (printed: a wall is 63 % opaque)
  [D2]  the slope correction sits inside zeta, with opposite signs for the two ends of a section
  [D3]  Phi: E_grad weighted by w, |lap| eps opacity, sigmoid set by quantiles, detached, x opacity
  [D4]  the curvature loss is |lap| eps opacity: |lap| of a trilinear field grows as eps shrinks
  [D5]  the Lipschitz term is a sum of logs, not a product that can drown the colour at first
  [D6]  a small CGNet on small square photos: one plain block a stage, GroupNorm, ReLU, finer head
  [D7]  M, not M^2, as errors are L1, times lam_mask + lam_gpl Phi + what most SfM pixels err by
  [D8]  the background also fills what lies before the sphere; its last section is opaque
  [D9]  all is float32: mixed precision, as the paper has it, makes noise of distances and normals
  [D10] SfM points place the sphere, seed the octree, teach M = 0 and pull s(p) to zero, but less
        while zeta is below 40: a strong pull would leave the surface fog
  [D11] samples are drawn from a cached SDF volume; no second network pass along the ray
  [D12] test photos: appearance fitted on the left half, scored on the right half
  [D13] exact normals by trilinear weights (--normals fd: as printed); curvature where a ray ends
  [D14] the mask learns every few steps, by a logistic surrogate, from averaged errors of photos
  [D15] zeta stays above a rising floor, so that no surface stays fog, and below a fixed bound
  [D16] cells split where colours err and merge far from surfaces; a scene that needs no codes, no
        mask or no background field is modelled without
"""
import argparse, datetime, functools, gc, io, json, math, os, re
import resource, shutil, subprocess, sys, time
from dataclasses import asdict, dataclass, field, fields, replace
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
from data_prep import UserError, atomic_write, need, tell

torch.set_float32_matmul_precision("highest")  # [D9] no TF32, which some containers switch on,
torch.backends.cudnn.allow_tf32 = False  # and convolutions have by default


# ---- 1 Config: every field is a flag -------------------------------------------------------------

def opt(default, text, *choices):
    return field(default=default, metadata={"help": text, "choices": choices or None})


@dataclass
class Config:
    """All settings. Of the weights and sizes the paper gives lam_gpl alone."""
    scene: str = opt("toy", "synthetic, or of Phototourism", "toy", *data_prep.SCENES)
    data: str = opt("", "an IMC-PT or COLMAP folder instead of a named scene")
    name: str = opt("", "run folder below runs/ (default: scene-method-seed)")
    seed: int = opt(0, "seed of everything random")
    device: str = opt("auto", "auto, cpu, cuda or cuda:N")
    steps: int = opt(3000, "training steps")
    minutes: float = opt(0.0, "training budget in minutes, instead of --steps if above 0")
    downscale: int = opt(2, "integer factor by which photos are made smaller (benchmarks use 2)")
    rays: int = opt(512, "rays per step, of all processes together")
    photos: int = opt(8, "photos per step, of each process; the mask network sees them whole")
    samples: int = opt(16, "foreground samples per ray")
    bg_samples: int = opt(24, "background samples per ray, a third of them before the sphere")
    levels: int = opt(0, "octree levels, 0: from the pixel footprint at the surface", *range(9))
    grid: str = opt("octree", "uniform: the same finest cell everywhere", "octree", "uniform")
    max_mb: float = opt(1000.0, "limit of the foreground's octree with Adam's moments, MiB")
    hidden: int = opt(64, "width of the MLPs")
    appearance_dim: int = opt(16, "length of a photo's appearance code")
    appearance: str = opt("auto", "codes; auto: on if exposures differ", "auto", "on", "off")
    mask: str = opt("auto", "auto: if M over 0.01; printed: M^2", "auto", "on", "off", "printed")
    background: str = opt("auto", "field; auto: off if it is one colour", "auto", "on", "off")
    normals: str = opt("analytic", "derivatives of the SDF [D13]", "analytic", "fd")
    sampling: str = opt("cached", "how samples are placed [D11]", "cached", "uniform")
    alpha: str = opt("neus", "opacity of a section [D1] [D2]", "neus", "printed")
    gpl: str = opt("calibrated", "sigmoid of Phi [D3]; literal: 0 and 1", "calibrated", "literal")
    lam_eik: float = opt(0.04, "weight of the eikonal loss (Permuto-SDF)")
    lam_curv: float = opt(3e-3, "weight of the curvature loss, on |lap| eps [D4]")
    lam_gpl: float = opt(0.05, "weight of the geometry-preservation loss (paper)")
    lam_lps: float = opt(1e-5, "weight of the Lipschitz loss, log form [D5]")
    lam_off: float = opt(1e-3, "weight of the off-surface loss")
    lam_sfm: float = opt(7.5e-3, "weight of min(zeta, 40) |s(p)| at SfM points [D10]")
    lam_mask: float = opt(0.04, "weight of mean M: the excess error that masks a pixel [D7]")
    lr_grid: float = opt(1e-2, "learning rate of octree features and appearance codes")
    lr_net: float = opt(2e-3, "learning rate of networks")
    lr_zeta: float = opt(1e-3, "learning rate of the deviation network")

    def __post_init__(self):  # refuses what cannot work, before anything is written
        least = dict(samples=3, bg_samples=2, rays=2, photos=1, steps=1, downscale=1, hidden=1)
        for f in fields(self):
            value, low = getattr(self, f.name), least.get(f.name, 0)
            is_right = isinstance(value, str) if f.type is str else low <= value < 2 ** 31
            need(is_right and value in (f.metadata["choices"] or [value]),
                 f"--{f.name} {value} makes no sense: use a number from {low}, or see --help")
        need(self.rays % self.photos == 0, "--rays must be a multiple of --photos")

    @property
    def source(self) -> str:
        """What data_prep.open_scene takes: a scene's name, or a folder, never mistaken for one."""
        return str(Path(self.data).resolve()) if self.data else self.scene


# settings of photos on a GPU that differ from Config's defaults; flags override them
LARGE = dict(steps=300_000, rays=4096, photos=16, samples=32, appearance_dim=32)


# ---- 2 Scene file and rays -----------------------------------------------------------------------

class Scene(NamedTuple):
    """The arrays of a scene file (data_prep.py documents them) as tensors on the device."""
    rgb: Tensor  # (N,3) uint8, all pixels of all photos
    start: Tensor  # (I+1,) first pixel of each photo
    wh: Tensor  # (I,2) width, height in px
    K: Tensor  # (I,4) fx fy cx cy in px
    c2w: Tensor  # (I,3,4)
    near: Tensor  # (I,) smallest useful t
    is_test: Tensor  # (I,)
    points: Tensor  # (K,3) SfM points
    track_photo: Tensor  # (T,) the photo of a sighting of an SfM point
    track_uv: Tensor  # (T,2) where in that photo, over its size; in the picture if in 0..1
    thumbs: Tensor  # (I,3,n,n) uint8, whole photos for the mask network
    raw: dict  # the file in numpy: names, statistics, center, scale, ground truth of the toy
    info: dict

    def photos(self, is_test: bool) -> Tensor:
        """Numbers (B,) of the held-out photos, or of those to train on."""
        return torch.nonzero(self.is_test == is_test)[:, 0]


def load_scene(raw: dict, device="cpu") -> Scene:
    """Scene from the dictionary of a scene file (data_prep.open_scene, make_toy or prepare)."""
    photos = [raw["rgb"][a:b].reshape(h, w, 3)
              for a, b, (w, h) in zip(raw["start"], raw["start"][1:], raw["wh"])]
    side = int(np.clip(np.median(raw["wh"].max(1)) / 2, 96, 256))  # what the mask network sees [D6]
    thumbs = [cv2.resize(p, (side, side), interpolation=cv2.INTER_AREA) for p in photos]
    thumbs = torch.as_tensor(np.stack(thumbs)).permute(0, 3, 1, 2).contiguous().to(device)
    kinds = dict(i=torch.long, f=torch.float32)  # uint8 and bool stay what they are
    arrays = {k: torch.as_tensor(raw[k], dtype=kinds.get(raw[k].dtype.kind), device=device)
              for k in Scene._fields[:-3]}
    return Scene(**arrays, thumbs=thumbs, raw=raw, info=json.loads(str(raw["info"])))


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
        return torch.addcmul(self.o[:, None], t[:, :, None], self.d[:, None])


def make_rays(scene: Scene, img: Tensor, pixel: Tensor) -> Rays:
    """Rays through pixels. img, pixel: (R,) photo and row-major pixel number within it."""
    wh, K, c2w = scene.wh[img], scene.K[img], scene.c2w[img]  # (R,2), (R,4), (R,3,4)
    uv = torch.stack([pixel % wh[:, 0], pixel // wh[:, 0]], 1) + 0.5  # (R,2) px
    d = F.pad((uv - K[:, 2:]) / K[:, :2], (0, 1), value=1.0)  # (R,3) in camera axes
    d = (c2w[:, :, :3] @ F.normalize(d, dim=1)[:, :, None])[:, :, 0]  # (R,3)
    rgb = scene.rgb[scene.start[img] + pixel].float() / 255  # (R,3)
    return Rays(c2w[:, :, 3], d, scene.near[img], img, uv / wh, rgb)


def sphere_interval(rays: Rays) -> tuple[Tensor, Tensor]:
    """Distances (R,), (R,) at which rays enter and leave the unit sphere. A ray that misses it, or
    has it behind, gets an empty interval: at its closest approach, or at near."""
    closest = -(rays.o * rays.d).sum(1)  # (R,)
    away = rays.at(closest[:, None])[:, 0]  # (R,3) the point nearest to the sphere's centre
    half = (1 - (away ** 2).sum(1)).clamp(min=0).sqrt()  # (R,)
    t0 = torch.maximum(closest - half, rays.near)  # (R,)
    return t0, torch.maximum(closest + half, t0)


# ---- 3 Octree: features on the corners of cells --------------------------------------------------

# A corner's weight is a product over the axes: 1 - f at the near end, f at the far end, for f in
# 0..1. Columns: the 8 corners' weights, then their derivatives, where an axis has its slope, -1, 1.
FAR = torch.cartesian_prod(*[torch.arange(2.0)] * 3).T.repeat(1, 4)  # (3,32) 1 at the far end
IS_SLOPE = F.pad(torch.eye(3), (1, 0)).repeat_interleave(8, 1) > 0  # (3,32)
TRILINEAR = torch.stack([torch.where(IS_SLOPE, 2 * FAR - 1, 1 - FAR),  # (2,3,32) constant and
                         torch.where(IS_SLOPE, 0, 2 * FAR - 1)])  # factor of f
PINNED = 64  # rows that stay zero, for hanging corners: on one row a GPU would queue their writes
CHUNK = 4096  # points or rays evaluated at once without gradient
resident = functools.cache(Tensor.to)  # a constant on a device: one copy, as copies make a GPU wait


class Interpolate(torch.autograd.Function):
    """out[p,j] = sum over the 8 corners k of w[p,j,k] features[corner[p,k]], for J sets of weights:
    of the value, and of its derivatives along x, y, z. The hottest operation of a step."""
    @staticmethod
    def forward(ctx, features, corner, w):  # (V,C), (P,8), (P,J,8) -> (P,J,C)
        ctx.save_for_backward(features, corner, w)
        at = corner[:, None].expand(w.shape).reshape(-1, 8)  # (PJ,8)
        out = F.embedding_bag(at, features, per_sample_weights=w.reshape(-1, 8), mode="sum")
        return out.reshape(*w.shape[:2], features.shape[1])

    @staticmethod
    def backward(ctx, grad):  # (P,J,C)
        features, corner, w = ctx.saved_tensors
        spread = torch.einsum("pjk,pjc->pkc", w, grad)  # (P,8,C)
        out = torch.zeros_like(features)  # (V,C)
        out.index_add_(0, corner.flatten().long(), spread.flatten(0, 1))  # a CPU adds slowly by int
        out[:PINNED] = 0  # hanging corners learn nothing
        return out, None, None


class Octree(nn.Module):
    """Feature grid over the cube [-half, half]^3 that is fine only where it has been split. Level 0
    is a dense grid of root^3 cells; a node points to its first of eight children. Nodes 0-7, the
    null block, stand in for children that do not exist. Features live on corners, shared by the
    cells that meet there. A corner with a missing cell around it ("hanging") is pinned to zero: the
    field is continuous across borders of refined regions. Levels that a place lacks are zeros."""
    def __init__(self, half: float, levels: int, channels: int = 4, device="cpu", root: int = 16):
        super().__init__()
        self.half, self.levels, self.root = half, levels, root
        self.n = (root << levels) + 1  # more than the finest level has corners a side
        self.features = nn.Parameter(torch.zeros(PINNED, channels, device=device))  # (V,C)
        self.row_key = torch.arange(-PINNED, 0, device=device)  # (V,) the corner that owns a row
        constant = lambda value: nn.Buffer(value.to(device), persistent=False)
        self.per_unit = constant(1 / self.cell(torch.arange(levels)))  # (L,)
        self.middle = constant(half * self.per_unit[:, None])  # (L,1) of the cube, in cells
        self.trilinear = constant(TRILINEAR)  # (2,3,32)
        # a cell's number: row-major on level 0, then among 8 children by the last bits of i, j, k
        steps = torch.tensor([[-1, root ** 2, root, 1], *[[1, 4, 2, 1]] * (levels - 1)]).int()
        self.bits, self.stride = constant(steps[:, :1]), constant(steps[:, 1:])  # (L,1), (L,3)
        self.build(self.row_key[:0])

    def cell(self, level):
        """Side of a cell, scene units. level: a number, or a tensor of them."""
        return 2 * self.half / (self.root * 2.0 ** level)

    def key(self, at: Tensor) -> Tensor:
        """One number for a cell or corner (...,4) level, i, j, k; linear in them."""
        return ((at[..., 0] * self.n + at[..., 1]) * self.n + at[..., 2]) * self.n + at[..., 3]

    def build(self, split_keys: Tensor) -> Tensor:
        """Makes nodes and corners from the keys of the cells that are split. New features are zero.
        Returns the former row (V,) of every row, 0 (a pinned one) if new."""
        octant = torch.cartesian_prod(*[torch.arange(2, device=split_keys.device)] * 3)  # (8,3)
        ijk = torch.cartesian_prod(*[torch.arange(self.root, device=octant.device)] * 3)  # (N,3)
        cells, cut = [], []
        for level in range(self.levels):
            cells.append(F.pad(ijk, (1, 0), value=level))  # (N,4)
            cut.append(torch.isin(self.key(cells[-1]), split_keys) & (level + 1 < self.levels))
            ijk = (2 * ijk[cut[-1]][:, None] + octant).reshape(-1, 3)  # (N,3) of the next level
        self.cells, cut = torch.cat(cells), torch.cat(cut)  # (N,4), (N,) is it split
        self.child = F.pad(torch.where(cut, 8 * cut.cumsum(0) + self.root ** 3, 0), (8, 0)).int()
        self.active = int(self.cells[-1, 0]) + 1  # levels that have cells
        key, n = self.key(self.cells), self.n  # (N,)
        self.split_keys = key[cut]
        keys, inverse, count = torch.unique(key[:, None] + self.key(F.pad(octant, (1, 0))),  # (N,8)
                                            return_inverse=True, return_counts=True)
        at = torch.stack([keys // n ** 2, keys // n, keys], 1) % n  # (Q,3) corners
        last = self.root << (keys // n ** 3)[:, None]  # (Q,1) of their level, on the far faces
        free = count == 2 ** ((at > 0) & (at < last)).sum(1)  # (Q,) all cells around it exist
        row = torch.where(free, PINNED - 1 + free.cumsum(0), keys % PINNED)  # (Q,)
        null = torch.arange(PINNED, device=row.device).reshape(8, 8)  # rows of the null block
        self.corner = torch.cat([null, row[inverse]]).int()  # (8+N,8)
        old_key, self.row_key = self.row_key, torch.cat([self.row_key[:PINNED], keys[free]])  # (V,)
        old_row = torch.searchsorted(old_key, self.row_key).clamp(max=len(old_key) - 1)
        old_row = torch.where(old_key[old_row] == self.row_key, old_row, 0)  # (V,)
        self.features = nn.Parameter(self.features.detach()[old_row])  # (V,C)
        return old_row

    def split(self, cells: Tensor) -> None:
        """Splits cells (...,4); the function stays, as new features are zero."""
        self.build(torch.cat([self.split_keys, self.key(cells).flatten()]))

    def locate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Nodes (P,L) that hold x (P,3), 8 + the row in cells, below 8 where a level has no cell;
        and where in each, 0..1 (P,L,3). An x outside the cube is moved to its border."""
        x = x.nan_to_num(0).clamp(-self.half, self.half * (1 - 1e-6))[:, None]  # (P,1,3)
        middle, per_unit = self.middle[:self.active], self.per_unit[:self.active, None]  # (L,1)
        at = torch.addcmul(middle, x, per_unit)  # (P,L,3) in cells
        step = (at.int() & self.bits[:self.active]) * self.stride[:self.active]  # (P,L,3)
        step = step.sum(2, dtype=torch.int32)  # (P,L)
        nodes = [8 + step[:, 0]]  # (P,) root cell, then the child of the cell before
        for level in range(1, self.active):
            nodes.append(self.child.index_select(0, nodes[-1]) + step[:, level])  # (P,)
        return torch.stack(nodes, 1), at.frac()

    def forward(self, x: Tensor, derivatives: bool = False) -> Tensor:
        """Features (P,L,J,C) at x (P,3); J = 1, or 4: value, its change per cell along x, y, z."""
        P, L, J = len(x), self.active, 4 if derivatives else 1
        nodes, inside = self.locate(x)  # (P,L), (P,L,3)
        axes = zip(*self.trilinear[:, :, :8 * J], inside.reshape(-1, 3, 1).unbind(1))
        x, y, z = (torch.addcmul(start, f, rise) for start, rise, f in axes)  # (PL,8J)
        w = (x * y * z).reshape(-1, J, 8)  # (PL,J,8)
        corner = self.corner.index_select(0, nodes.flatten())  # (PL,8)
        out = Interpolate.apply(self.features, corner, w).reshape(P, L, J, self.features.shape[1])
        return F.pad(out, (0, 0, 0, 0, 0, self.levels - L)) if L < self.levels else out


def seed_octree(octree: Octree, points: Tensor, dense: int, near: int = 1) -> None:
    """Splits the first `dense` levels everywhere, `near` more around points (P,3), neighbours too,
    so that no corner of a point's cell is hanging; then random features. [D10]"""
    for _ in range(dense):
        octree.split(octree.cells)
    step = torch.cartesian_prod(*[torch.arange(-1, 2, device=points.device)] * 3)  # (27,3)
    for _ in range(near):
        home = octree.cells[octree.locate(points)[0][:, -1].unique() - 8]  # (N,4)
        octree.split(home[:, None] + F.pad(step, (1, 0)))
    octree.features.data[PINNED:].normal_(0, 0.01)


SPLIT_RAYS = 6  # recent rays that end in a cell before it is split
SPLIT_ERROR = 2.0  # their mean error over the lower quartile of all rays' that splits it
HIDDEN = 6.0  # zeta |s| from where on the field is hardly seen: sigmoid(-6) = 0.0025


def refined_keys(octree: Octree, sdf, hits: Tensor, zeta: float, max_mb: float) -> Tensor:
    """Keys of the cells that should be split. sdf: (P,3) to (P,); hits (P,5): where recent rays
    ended, their masked error, a pixel's size there; 2: no ray yet. A cell at the surface is split
    if enough rays end in it, their error is high and its children are no finer than pixels; worst
    first, as far as max_mb allows. It is merged if hardly anything near it is seen. [D16]"""
    is_inside = hits[:, :3].norm(dim=1) < 1  # (P,) rays that miss the sphere split no cells
    if not is_inside.any():
        return octree.split_keys
    errors, hits = hits[hits[:, 4] != 2, 3].sort()[0], hits[is_inside]  # (Q,) of all rays, (P,5)
    cells = octree.cells[octree.cells[:, 0] < octree.levels - 1]  # (N,4) all but the finest
    side, is_split = octree.cell(cells[:, 0]), octree.child[8:8 + len(cells)] > 0  # (N,)
    centre = (cells[:, 1:] + 0.5) * side[:, None] - octree.half  # (N,3)
    s = torch.cat([sdf(x) for x in centre.split(CHUNK)]).abs()  # (N,)
    reach = (math.sqrt(3) / 2 + 1) * side  # (N,)
    is_split &= s < reach + HIDDEN / zeta
    nodes, bound = octree.locate(hits[:, :3])[0], SPLIT_ERROR * errors[len(errors) // 4]  # (P,L)
    found = F.pad(hits[:, 3:], (0, 1), value=1.0).repeat_interleave(nodes.shape[1], 0)  # (PL,3)
    found = hits.new_zeros(len(octree.child), 3).index_add_(0, nodes.flatten(), found)  # (8+N,3)
    error, pixel, count = found[8:8 + len(cells)].unbind(1)  # (N,) sums
    pays = (count >= SPLIT_RAYS) & (error > bound * count) & (pixel < count * side / 2)  # (N,)
    pays &= (s < reach) & ~is_split
    held = 76 + 16 * octree.features.shape[1]  # bytes: a node; a row, its gradient, Adam's moments
    room = max(0, int(max_mb * 2 ** 20 / held) - len(octree.child)) // 8
    worst = (error / count)[pays].argsort(descending=True)  # (Q,)
    is_split[pays.nonzero()[worst[:room], 0]] = True
    return octree.key(cells[is_split])


# ---- 4 Fields: the networks on top of the octree -------------------------------------------------

GEO = 15  # length of the geometry feature that the SDF network hands to the colour network
BETA = 100.0  # sharpness of the SDF network's softplus: nearly a ReLU, but twice differentiable


class SDFField(nn.Module):
    """s(x) and what colour is read from: a geometry feature beside the octree's own features. One
    hidden layer over xyz and features; G = GEO + L C. In float32 [D9]."""
    def __init__(self, octree: Octree, hidden: int):
        super().__init__()
        self.octree, self.features = octree, octree.features.shape[1] * octree.levels  # LC
        self.lin1 = nn.Linear(3 + self.features, hidden)
        self.lin2 = nn.Linear(hidden, 1 + GEO)

    def forward(self, x: Tensor, with_gradient: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """sdf (P,), geometry (P,G) and, if wanted, grad s (P,3) at x (P,3) [D13]: the chain rule
        by hand, ds/dx = ds/dz dz/dx with z = [x, features(x)], needs no second-order autograd."""
        feat = self.octree(x, with_gradient)  # (P,L,1 or 4,C)
        value, slope = feat.split([1, feat.shape[2] - 1], 2)  # (P,L,1,C), (P,L,0 or 3,C)
        h = self.lin1(torch.cat([x, value.flatten(1)], 1))  # (P,H)
        sdf, geo = self.lin2(F.softplus(h, BETA)).split([1, GEO], 1)  # (P,1), (P,GEO)
        grad = None
        if with_gradient:
            ds_dz = (torch.sigmoid(BETA * h) * self.lin2.weight[0]) @ self.lin1.weight  # (P,3+LC)
            ds_dx, ds_df = ds_dz.split([3, self.features], 1)  # (P,3), (P,LC)
            ds_df = ds_df.reshape(value.shape) * self.octree.per_unit[:, None, None]  # (P,L,1,C)
            grad = ds_dx + (slope * ds_df).sum((1, 3))  # (P,3)
        return sdf.flatten(), torch.cat([geo, value.flatten(1)], 1), grad


TAPS = F.pad(torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3),
             (0, 0, 1, 0))  # (5,3) a point, and around it the ends of a tetrahedron
MEAN = torch.tensor([-1, 0.25, 0.25, 0.25, 0.25])  # (5,) of the ends, less the point


def taps(x: Tensor, eps: float) -> Tensor:
    """Where finite_differences wants s around x (P,3): at x + eps k, |k| = 0 or 1. (P,5,3)"""
    return torch.add(x[:, None], resident(TAPS, x.device).to(x.dtype), alpha=eps)


def finite_differences(s: Tensor, eps: float) -> tuple[Tensor, Tensor]:
    """Gradient (P,3) and Laplacian (P,) from s (P,5) at the taps (Neuralangelo)."""
    k, mean = (resident(c, s.device).to(s.dtype) for c in (TAPS, MEAN))  # (5,3), (5,)
    return 0.75 / eps * (s @ k), 6 / eps ** 2 * (s @ mean)  # as sum k k^T is 4/3 of the identity


class LipschitzMLP(nn.Module):
    """MLP whose rows are scaled to an L1 norm of at most softplus(c) (Liu et al. 2022)."""
    def __init__(self, sizes: list[int]):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        bound = torch.stack([m.weight.detach().abs().sum(1).max() for m in self.layers])
        self.c = nn.Parameter(torch.log(torch.expm1(bound)))  # (layers,)

    def bounds(self) -> Tensor:
        """Lipschitz bound of each layer in the max norm; above 0, as the loss takes its log."""
        return F.softplus(self.c) + 1e-6

    def forward(self, x: Tensor) -> Tensor:
        rows = [len(m.weight) for m in self.layers]
        norm = torch.cat([m.weight.abs().sum(1) for m in self.layers]) + 1e-9  # (rows,)
        bound = torch.cat([b.expand(n) for b, n in zip(self.bounds(), rows)])  # (rows,)
        scale = (bound / norm).clamp(max=1)[:, None].split(rows)  # (out,1) of each layer
        for i, layer in enumerate(self.layers):
            x = F.linear(F.relu(x) if i else x, layer.weight * scale[i], layer.bias)  # (P,out)
        return x


# ---- 5 From SDF to colour: alpha, compositing, samples, background -------------------------------

class Deviation(nn.Module):
    """The deviation network: zeta = exp(10 v), one learned number; 1/zeta is a surface's width."""
    def __init__(self, zeta: float = 20.0):
        super().__init__()
        self.v = nn.Parameter(torch.tensor(math.log(zeta) / 10))

    def forward(self) -> Tensor:
        return torch.exp(10 * self.v)

    @torch.no_grad()
    def bound(self, step: int, most: float) -> None:
        """Keeps zeta above a floor, 15 at first and 80 from step 1,300 on: in a crowd, fog hides
        people from the mask, and people that it misses keep up the fog. And below `most`: shards
        in the air that hardly a sample meets would stay. [D15]"""
        self.v.clamp_(math.log(min(15 + step / 20, 80)) / 10, math.log(most) / 10)


def neus_alpha(sdf: Tensor, cos: Tensor, dt: Tensor, zeta: Tensor) -> Tensor:
    """Opacity (R,S) of sections of length dt with SDF sdf and slope cos = <grad s, d> mid-way.
    Eq. 1 mended: 1 - sigmoid(zeta s_next) / sigmoid(zeta s_prev) (NeuS Eq. 13) [D1] with the two
    ends s -+ cos dt / 2 inside zeta [D2]. 0 where a ray leads outwards. Logs do not overflow."""
    half = F.relu(cos * (dt / -2))  # (R,S)
    before, after = F.logsigmoid(zeta * torch.stack([sdf + half, sdf - half]))  # (R,S) [D2]
    return -torch.expm1(after - before)  # [D1]


def printed_alpha(sdf: Tensor, cos: Tensor, dt: Tensor, zeta: Tensor) -> Tensor:
    """Eq. 1 as printed, kept to be shown and tested: sums to one, but multiplies to 1 - 1/e."""
    beta = cos * dt / 2  # (R,S)
    after = torch.cat([sdf[:, 1:], sdf[:, -1:]], 1)  # (R,S), s_{i+1}
    return torch.sigmoid(zeta * sdf + beta) - torch.sigmoid(zeta * after + beta)


def composite(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights w_i = T_i alpha_i (R,S), T_i = prod_{j<i} (1 - alpha_j); what passes, T (R,). Eq. 2
    A sum of logs: its backward needs no look for zeros; opaque sections still pass 1e-6 [D1]."""
    passes = torch.log1p((1e-6 - 1) * alpha)  # (R,S) log of what passes a section
    w = torch.exp(passes.cumsum(1) - passes) * alpha  # (R,S)
    return w, 1 - w.sum(1)


def inverse_cdf(edges: Tensor, weight: Tensor, u: Tensor) -> Tensor:
    """Positions (R,S) where the linear CDF of weight (R,N) on edges (R,N+1) reaches u (R,S)."""
    cdf = torch.cumsum(weight, 1)
    cdf = F.pad(cdf / cdf[:, -1:], (1, 0))  # (R,N+1)
    hi = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, weight.shape[1])  # (R,S)
    both = torch.cat([hi - 1, hi], 1)  # (R,2S)
    (c0, c1), (e0, e1) = cdf.gather(1, both).chunk(2, 1), edges.gather(1, both).chunk(2, 1)  # (R,S)
    return torch.lerp(e0, e1, ((u - c0) / (c1 - c0).clamp(min=1e-9)).clamp(0, 1))


PROBES = 64  # cheap lookups of the cached SDF per ray
FLOOR = 0.2  # share of samples spread uniformly, so that a lost surface can return


class SDFCache(nn.Module):
    """The SDF of the last steps on a dense grid: where along a ray samples pay. [D11]"""
    def __init__(self, n: int):
        super().__init__()
        self.volume = nn.Buffer(torch.zeros(1, 1, n, n, n))  # x slowest

    @torch.no_grad()
    def refresh(self, sdf, part: int = 0, parts: int = 1) -> None:
        """Evaluates sdf, (P,3) to (P,), again on every parts-th slice, from slice `part`."""
        n = self.volume.shape[-1]
        line = torch.linspace(-1, 1, n, device=self.volume.device)  # (n,)
        x = torch.cartesian_prod(line[part::parts], line, line)  # (P,3)
        size = 2 ** 18 if x.is_cuda else 2 ** 15  # few calls for a GPU, what fits a CPU's cache
        s = torch.cat([sdf(some) for some in x.split(size)])  # (P,)
        self.volume[0, 0, part::parts] = s.reshape(-1, n, n)

    def weights(self, rays: Rays, edges: Tensor, zeta: Tensor) -> Tensor:
        """NeuS weights (R,N) of sections (R,N+1); surfaces are at least half a voxel wide."""
        x = rays.at(edges).flip(-1)[None, None]  # (1,1,R,N+1,3) as grid_sample wants it, z first
        s = F.grid_sample(self.volume, x, padding_mode="border", align_corners=True)[0, 0, 0]
        log_phi = F.logsigmoid(zeta.clamp(max=self.volume.shape[-1]) * s)  # (R,N+1)
        fall = F.pad(torch.diff(log_phi).clamp(max=0), (1, 0))  # (R,N+1) log of what passes
        return -torch.diff(fall.cumsum(1).exp())  # (R,N)

    @torch.no_grad()
    def edges(self, rays: Rays, t0: Tensor, t1: Tensor, jitter: Tensor, zeta: Tensor) -> Tensor:
        """Edges (R,S+1) of S sections from t0 to t1 (R,), dense where a surface is seen; even ones
        if zeta is 0. jitter: (R,S) in 0..1, stratifies the S - 1 inner edges."""
        n, t0, t1 = jitter.shape[1] - 1, t0[:, None], t1[:, None]  # (R,1)
        u = (torch.arange(n, device=t0.device) + jitter[:, :n]) / n  # (R,S-1)
        probes = torch.lerp(t0, t1, torch.linspace(0, 1, PROBES + 1, device=t0.device))  # (R,N+1)
        weight = self.weights(rays, probes, zeta)  # (R,N)
        weight = torch.add(weight + 1e-5, weight.sum(1, keepdim=True),
                           alpha=FLOOR / (1 - FLOOR) / PROBES)  # (R,N)
        return torch.cat([t0, inverse_cdf(probes, weight, u), t1], 1)  # (R,S+1)


def contract(x: Tensor) -> Tensor:
    """Squeezes |x| > 1 into the ball of radius 2 (mip-NeRF 360 Eq. 10); identity inside."""
    inverse = x.norm(dim=-1, keepdim=True).clamp(min=1).reciprocal()  # (...,1) 1 / |x|
    return x * (2 - inverse) * inverse


class Background(nn.Module):
    """A small NeRF before the sphere and beyond it, on an octree over contracted space."""
    def __init__(self, points: Tensor, hidden: int, per_ray: int):
        super().__init__()
        self.octree = Octree(2.0, levels=5, device=points.device)
        seed_octree(self.octree, contract(points), 1, 3)  # three levels only near SfM points (K,3)
        inputs = 3 + self.octree.features.shape[1] * self.octree.levels
        self.density, self.color = (
            nn.Sequential(nn.Linear(a, hidden), nn.ReLU(), nn.Linear(hidden, b))
            for a, b in ((inputs, 1 + GEO), (GEO + per_ray, 3)))

    def forward(self, rays: Rays, t0: Tensor, t1: Tensor, per_ray: Tensor, jitter: Tensor):
        """Colour (R,3) of what lies before t0 (R,), the share (R,) of light that passes it, and
        that share of the colour (R,3) beyond t1 (R,). per_ray: (R,9+A) direction, code; jitter
        (R,S) in 0..1. [D8] A third of the S sections are equal and end at t0; the others are
        equal steps of u in t = t1 + u / (1 - u), and the last is opaque."""
        (R, S), n = jitter.shape, jitter.shape[1] // 3
        at, dt = torch.arange(S, device=t0.device) + jitter, (t0 - rays.near)[:, None] / n  # (R,1)
        before = torch.addcmul(rays.near[:, None], dt, at[:, :n])  # (R,n)
        u = (at[:, n:] - n) / (S - n)  # (R,S-n)
        beyond = torch.addcdiv(t1[:, None], u, (1 - u).clamp(min=1e-3))  # (R,S-n)
        x = contract(rays.at(torch.cat([before, beyond], 1))).reshape(-1, 3)  # (RS,3)
        feat = torch.cat([x, self.octree(x).flatten(1)], 1)  # (RS,3+LC)
        density, geo = self.density(feat).split([1, GEO], 1)  # (RS,1), (RS,GEO)
        inputs = torch.cat([geo, per_ray.repeat_interleave(S, 0)], 1)  # (RS,GEO+9+A)
        rgb = self.color(inputs).sigmoid().reshape(R, S, 3)  # (R,S,3)
        sigma = F.softplus(density.reshape(R, S) - 1)[:, :-1]  # (R,S-1)
        dt = torch.cat([dt.expand(-1, n), torch.diff(beyond)], 1)  # (R,S-1)
        alpha = F.pad(-torch.expm1(-sigma * dt), (0, 1), value=1.0)  # (R,S) [D8]
        w, _ = composite(alpha)  # (R,S)
        front, behind = (w[:, :, None] * rgb).split([n, S - n], 1)
        return front.sum(1), 1 - w[:, :n].sum(1), behind.sum(1)  # (R,3), (R,), (R,3)


def render_rays(model: "GeoNVS", rays: Rays, code: Tensor, jitter: Tensor) -> dict[str, Tensor]:
    """One ray batch through the whole model. code: (R,A) appearance; jitter in 0..1, for S samples
    and the background's. Returns rgb (R,3), eikonal error of each sample (R,S), and without
    gradient opacity, mean depth (R,), normal, the point there x (R,3), E_grad of Eq. 4 (R,)."""
    cfg, R, S, zeta = model.cfg, len(rays.o), model.cfg.samples, model.deviation()
    t0, t1 = sphere_interval(rays)  # (R,)
    seen_zeta = zeta if cfg.sampling == "cached" else 0 * zeta  # 0: nothing is seen, even sections
    edges = model.cache.edges(rays, t0, t1, jitter[:, :S], seen_zeta)  # (R,S+1) [D11]
    t = torch.lerp(edges[:, :-1], edges[:, 1:], 0.5)  # (R,S)
    x = rays.at(t).reshape(-1, 3)  # (RS,3)
    sdf, geo, grad = model.sdf(x, cfg.normals == "analytic")  # (RS,), (RS,G), (RS,3) [D13]
    if cfg.normals == "fd":
        ends = model.distance(taps(x, model.eps)[:, 1:].reshape(-1, 3)).reshape(-1, 4)  # (RS,4)
        grad, _ = finite_differences(torch.cat([sdf[:, None], ends], 1), model.eps)  # (RS,3)
    length = grad.norm(dim=1, keepdim=True)  # (RS,1)
    normal = grad / (length + 1e-12)  # (RS,3)
    cos = torch.einsum("rsi,ri->rs", grad.reshape(R, S, 3), rays.d)  # (R,S)
    opacity_of = neus_alpha if cfg.alpha == "neus" else printed_alpha
    alpha = opacity_of(sdf.reshape(R, S), cos, torch.diff(edges), zeta)  # (R,S)
    w, trans = composite(alpha)  # (R,S), (R,); 0 and 1 where a ray misses: no section has a length
    d = rays.d  # its polynomials up to degree 2 span the spherical harmonics
    per_ray = torch.cat([d, d * d, d * d.roll(1, 1), code], 1)  # (R,9+A)
    inputs = torch.cat([geo, normal, per_ray.repeat_interleave(S, 0)], 1)  # (RS,G+3+9+A)
    rgb = torch.einsum("rs,rsc->rc", w, model.color(inputs).sigmoid().reshape(R, S, 3))  # (R,3)
    if model.background is None:
        front, passes, behind = 0, trans.new_ones(R), model.bg_color
    else:
        front, passes, behind = model.background(rays, t0, t1, per_ray, jitter[:, S:])
    eikonal = ((length - 1) ** 2).reshape(R, S) * (t1 > t0)[:, None]  # a miss has none
    with torch.no_grad():
        depth = torch.addcmul(torch.einsum("rs,rs->r", w, t), trans, t1)  # (R,)
        seen = dict(opacity=(1 - trans).clamp(min=0), depth=depth, x=rays.at(depth[:, None])[:, 0],
                    normal=torch.einsum("rs,rsi->ri", w, normal.reshape(R, S, 3)),
                    e_grad=torch.einsum("rs,rs->r", w, eikonal))  # NeuS-weighted [D3]
    rgb = front + passes[:, None] * rgb + trans[:, None] * behind  # (R,3)
    return seen | dict(rgb=rgb, eikonal=eikonal)


# ---- 6 Photos in the wild: transient mask and geometry preservation ------------------------------

def conv(cin: int, cout: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(cin, cout, 3, stride, 1, bias=False),
                         nn.GroupNorm(8, cout), nn.ReLU())  # [D6]


class ContextBlock(nn.Module):
    """Context-guided block (CGNet Fig. 3) at half the resolution: local and dilated context, gated
    globally; no residual, no 1x1. [D6]"""
    def __init__(self, cin: int, cout: int, dilation: int):
        super().__init__()
        half = cout // 2
        self.reduce = conv(cin, half, 2)
        self.local = nn.Conv2d(half, half, 3, 1, 1, groups=half, bias=False)
        self.around = nn.Conv2d(half, half, 3, 1, dilation, dilation, half, bias=False)
        self.join = nn.Sequential(nn.GroupNorm(8, cout), nn.ReLU())
        self.gate = nn.Sequential(nn.Linear(cout, cout // 8), nn.ReLU(),
                                  nn.Linear(cout // 8, cout), nn.Sigmoid())

    def forward(self, x: Tensor) -> Tensor:
        y = self.reduce(x)  # (B,cout/2,h/2,w/2)
        y = self.join(torch.cat([self.local(y), self.around(y)], 1))  # (B,cout,h/2,w/2)
        return y * self.gate(y.mean((2, 3)))[:, :, None, None]


class CGNet(nn.Module):
    """Whole photos (B,3,H,W) in 0..1 to transient logits (B,1,H/2,W/2) (CGNet, as in CR-NeRF). [D6]
    The head reads all three resolutions: at 1/8 alone a mask could not follow an outline."""
    def __init__(self):
        super().__init__()
        self.stages = nn.ModuleList([nn.Sequential(conv(3, 16, 2), conv(16, 16, 1)),
                                     ContextBlock(16, 32, 2), ContextBlock(32, 64, 4)])
        self.heads = nn.ModuleList(nn.Conv2d(k, 1, 1) for k in (16, 32, 64))
        for head, bias in zip(self.heads, (-2.5, 0.0, 0.0)):
            nn.init.constant_(head.bias, bias)  # starts with 8 % masked, not with half the picture

    def forward(self, photo: Tensor) -> Tensor:
        y, logits = photo - 0.5, []
        for stage, head in zip(self.stages, self.heads):
            y = stage(y)  # (B,16,H/2,W/2), (B,32,H/4,W/4), (B,64,H/8,W/8)
            logits.append(head(y))
        size = logits[0].shape[2:]
        return sum(F.interpolate(z, size, mode="bilinear") for z in logits)  # (B,1,H/2,W/2)


def mask_at(logits: Tensor, uv: Tensor) -> Tensor:
    """M (R,) at uv (R,2) in 0..1 of logits (B,1,h,w); rays come photo by photo, R / B from each."""
    grid = (2 * uv - 1).reshape(len(logits), -1, 1, 2)  # (B,R/B,1,2)
    at = F.grid_sample(logits, grid, padding_mode="border", align_corners=False)  # (B,1,R/B,1)
    return torch.sigmoid(at).flatten()  # (R,)


LAM_GRAD, LAM_LAP = 10.0, 2.0  # lambda_grad and lambda_curv inside Phi (paper)
LAM_BIMODAL = 1e-4  # weight of a term that is largest at M = 1/2; a large one no M could cross
MASK_EVERY = 4  # steps from one lesson of the mask network to the next [D14]


def edge_indicator(bend: Tensor, calibration=(0.0, 1.0)) -> Tensor:
    """Phi of bend = lambda_grad E_grad + lambda_curv E_curv, any shape. Eq. 4 calibration: centre
    and width of the sigmoid [D3]; 0 and 1 are the literal reading: Phi is over 0.5 on all rays."""
    return torch.sigmoid((bend - calibration[0]) / calibration[1])


def gpl_loss(mask: Tensor, edge: Tensor) -> Tensor:
    """Geometry-preservation loss: mean of M(r) Phi(r). Eq. 3"""
    return (mask * edge).mean()


class TransientMask(nn.Module):
    """M, which pixels show what passes by: CGNet, what rays last found at each pixel of each photo,
    and the objective that it learns from. m: side of the logits, px."""
    def __init__(self, cfg: Config, scene: Scene):
        super().__init__()
        self.cfg, self.thumbs, self.cgnet = cfg, scene.thumbs, CGNet()
        I, m = len(scene.thumbs), (scene.thumbs.shape[3] + 1) // 2
        self.logits = nn.Buffer(torch.full((I, 1, m, m), -9.0))  # last output of the network
        self.seen = nn.Buffer(torch.full((I, 5, m, m), -1.0))  # residual, bend, opacity; -1: no ray
        self.calibration = nn.Buffer(torch.tensor([0.0, 1.0]))  # centre and width of Phi
        # running upper quartiles of errors at SfM points: beside the foreground, and of it
        self.usual = nn.Buffer(torch.full((2,), 0.3))
        # which pixels show SfM points
        self.static = nn.Buffer(scene.is_test.new_zeros(I, 1, m, m), persistent=False)
        ok = ((scene.track_uv >= 0) & (scene.track_uv < 1)).all(1)  # not those that SfM got wrong
        col, row = (scene.track_uv[ok] * m).long().unbind(1)  # (T,)
        self.static[scene.track_photo[ok], 0, row, col] = True  # a few wrongly, on outlines [D10]

    def look(self, pick: Tensor) -> Tensor:
        """Logits (B,1,m,m) of photos (B,)."""
        return self.cgnet(self.thumbs[pick].float() / 255)

    def remember(self, rays: Rays, residual: Tensor, bend: Tensor, opacity: Tensor) -> None:
        """Keeps residual (R,3), bend and opacity (R,) where the network will look for them."""
        m = self.seen.shape[-1]
        col, row = (rays.uv * m).long().unbind(1)  # (R,)
        found = torch.cat([residual, bend[:, None], opacity[:, None]], 1)  # (R,5)
        self.seen[rays.img, :, row, col] = found.nan_to_num(0, 0, 0)

    def calibrate(self, bend: Tensor, rate: float = 0.2) -> None:
        """Moves Phi's centre and width to the rays': p75 and (p95 - p50) / 4 of bend (R,). [D3]"""
        order, last = bend.nan_to_num(0, 0, 0).sort()[0], len(bend) - 1  # (R,)
        p50, p75, p95 = (order[int(q * last)] for q in (0.5, 0.75, 0.95))
        self.calibration.lerp_(torch.stack([p75, ((p95 - p50) / 4).clamp(min=1e-3)]), rate)

    def phi(self, pick: Tensor) -> Tensor:
        """Phi times opacity (B,1,m,m) of photos (B,) as rays found it; 0 where none came."""
        bend, opacity = self.seen[pick, 3:].split(1, 1)  # (B,1,m,m)
        return opacity.clamp(min=0) * edge_indicator(bend, self.calibration)  # [D3]

    def objective(self, pick: Tensor) -> tuple[Tensor, Tensor]:
        """The terms of Eq. 5 that hold M, over photos (B,), a pixel that no ray has seen being 0,
        and L_GPL alone. M = 1 costs a price and saves the error, a signed mean over 3x3 pixels of
        the worst channel: what a blurred model lacks cancels, people do not. At pixels that show
        SfM points M saves nothing; their errors set the price. The logistic surrogate of (price -
        error) M has its sign and optimum, and a slope while M is wrong, where a sigmoid has none
        [D14]. --mask printed has none of this: mean M^2 is the price, as in Ha-NeRF."""
        cfg, logits, phi = self.cfg, self.look(pick), self.phi(pick)  # (B,1,m,m)
        self.logits[pick] = logits.detach()
        residual, known = self.seen[pick, :3], (self.seen[pick, 4:] >= 0).float()  # (B,3 or 1,m,m)
        mask, static = logits.sigmoid(), self.static[pick]  # (B,1,m,m)
        gpl = gpl_loss(mask, phi)
        pole = LAM_BIMODAL * (1 / ((mask - 0.5) ** 2 + 0.02)).mean()  # to 0 or 1 (Ha-NeRF's digits)
        if cfg.mask == "printed":
            error = residual.abs().mean(1, keepdim=True)  # (B,1,m,m)
            paid = ((1 - mask) * error + cfg.lam_mask * mask ** 2) * known  # (B,1,m,m)
            return paid.mean() + pole + cfg.lam_gpl * gpl, gpl.detach()
        around = F.avg_pool2d(torch.cat([residual * known, known], 1), 3, 1, 1)  # (B,4,m,m)
        error = (around[:, :3] / around[:, 3:].clamp(min=0.1)).abs().amax(1, True)  # (B,1,m,m)
        solid = self.seen[pick, 4:] > 0.5  # (B,1,m,m) the foreground, or what is beside it
        told = torch.stack([~solid, solid]) & static & (known > 0)  # (2,B,1,m,m) at SfM points
        usual = torch.where(told, error, math.nan).flatten(1).nanquantile(0.75, 1)  # (2,)
        self.usual.lerp_(torch.where(usual.isnan(), self.usual, usual), 0.1)
        price = cfg.lam_mask + self.usual[solid.long()] + cfg.lam_gpl * phi  # (B,1,m,m) [D7]
        loss = price - error * ~static  # (B,1,m,m) of M = 1 instead of 0
        slope = F.softplus(torch.where(loss > 0, logits, -logits))  # (B,1,m,m)
        return (loss.abs() * slope * known).mean() + pole, gpl.detach()


# ---- 7 The model and its objective ---------------------------------------------------------------

class GeoNVS(nn.Module):
    """The paper's model: it assembles the parts above and sums their losses. What stands from
    `losses` on is what training and scoring ask of any model; rivals in the tests answer too."""
    name, terms = "geonvsw", ("rgb", "eik", "curv", "lps", "off", "sfm")  # the mask has its own
    adam = dict(betas=(0.9, 0.99), eps=1e-15)  # as is usual for feature grids (Instant-NGP)

    def __init__(self, cfg: Config, scene: Scene):
        super().__init__()
        self.cfg = cfg = replace(cfg)  # a copy, as training decides --mask auto
        self.scene, raw, dev = scene, scene.raw, scene.c2w.device
        inside = scene.points.norm(dim=1) < 1
        self.sfm = scene.points[inside]  # (K,3)
        fit = 1 + math.floor(math.log2(2 / raw["footprint"] / 16))  # no cell smaller than a pixel
        levels = cfg.levels or min(max(fit, 2), 8)
        held = 20 * 16 ** 3 * 8 ** levels / 2 ** 20  # MiB, 140 bytes for a cell of a uniform grid
        need(cfg.grid == "octree" or held < cfg.max_mb, f"a uniform grid of {levels} levels takes "
             f"{held:.0f} MiB: lower --levels or raise --max_mb")
        octree = Octree(1.0, levels, device=dev)
        seed_octree(octree, self.sfm, 1 if cfg.grid == "octree" else levels - 1)
        has_codes = dict(on=True, off=False, auto=raw["exposure_spread"] > 0.01)[cfg.appearance]
        has_field = dict(on=True, off=False, auto=np.isnan(raw["bg_color"]).any())[cfg.background]
        A = cfg.appearance_dim if has_codes else 0  # [D16]
        self.sdf = SDFField(octree, cfg.hidden)
        self.appearance = nn.Embedding(len(scene.wh), A).requires_grad_(A > 0)  # at 0 CUDA errs
        nn.init.normal_(self.appearance.weight, std=0.01)
        self.color = LipschitzMLP([GEO + self.sdf.features + 3 + 9 + A, cfg.hidden, cfg.hidden, 3])
        self.background = (Background(scene.points[~inside], cfg.hidden, 9 + A)
                           if has_field else None)
        self.octrees = [part.octree for part in (self.sdf, self.background) if part]
        self.deviation, self.mask = Deviation(), TransientMask(cfg, scene)
        self.cache = SDFCache(int(np.clip(octree.root << levels - 1, 64, 128)))
        self.bg_color = nn.Buffer(torch.as_tensor(raw["bg_color"]).float().nan_to_num(0.5))
        self.hits = nn.Buffer(torch.full((512 * cfg.rays, 5), 2.0))  # what refined_keys looks at
        lam = torch.tensor([1.0, *(getattr(cfg, f"lam_{k}") for k in self.terms[1:])])
        self.lam = nn.Buffer(lam, persistent=False)  # flags may change it
        self.to(dev)
        print(f"  {levels} levels, finest cell {octree.cell(levels - 1):.4f}; appearance {A} "
              f"numbers; background {'a field' if has_field else 'one colour'}; mask {cfg.mask}")

    @property
    def eps(self) -> float:
        """Length of the taps of finite differences: half of the finest cell there is."""
        return self.sdf.octree.cell(self.sdf.octree.active - 1) / 2

    def distance(self, x: Tensor) -> Tensor:
        """s (P,) at x (P,3)."""
        return self.sdf(x)[0]

    def losses(self, rays: Rays, pick: Tensor, step: int, gen: torch.Generator):
        """The objective, Eq. 5: its weighted sum, and the raw terms by name. M is what the network
        said of each photo of pick (B,) at its last lesson; now and then comes another [D14]."""
        cfg, R, n = self.cfg, len(rays.o), len(rays.o) // 2
        self.deviation.bound(step, 32 * cfg.samples)  # about 1 / the finest section [D15]
        if step % 8 == 0:  # an eighth of the cache
            self.cache.refresh(self.distance, step // 8 % 8, 8)
        jitter = torch.rand(R, cfg.samples + cfg.bg_samples, generator=gen, device=gen.device)
        out = render_rays(self, rays, self.appearance(rays.img), jitter)
        residual = out["rgb"] - rays.rgb  # (R,3)
        is_on = cfg.mask != "off"
        mask = mask_at(self.mask.logits[pick], rays.uv) if is_on else torch.zeros_like(rays.near)
        kept = (1 - mask) * residual.abs().mean(1)  # (R,) what the mask leaves of the L1 error
        sfm = self.sfm[torch.randint(len(self.sfm), (n,), generator=gen, device=gen.device)]
        cube = torch.empty(n, 3, device=gen.device).uniform_(-1, 1, generator=gen)
        x = torch.cat([taps(out["x"], self.eps).reshape(-1, 3), cube, sfm])
        ends, off, sfm = self.distance(x).split([5 * R, n, n])  # all points but the samples
        lap = finite_differences(ends.reshape(R, 5), self.eps)[1]  # (R,) where rays end
        e_curv = lap.abs() * self.eps * out["opacity"]  # (R,) opacity: no gradient [D4] [D13]
        terms = dict(rgb=kept.mean(),
                     eik=out["eikonal"].mean(),
                     curv=e_curv.mean(),
                     lps=torch.log(self.color.bounds()).sum(),  # [D5]
                     off=torch.exp(-50 * off.abs()).mean(),
                     sfm=self.deviation().detach().clamp(max=40) * sfm.abs().mean())  # [D10]
        total = torch.stack([terms[name] for name in self.terms]) @ self.lam
        with torch.no_grad():  # what refining and the mask will want to know
            pixel = out["depth"] / self.scene.K[rays.img, 0]  # (R,) its size at the ray's end
            hits = torch.cat([out["x"], kept[:, None], pixel[:, None]], 1)  # (R,5)
            first = step * R % len(self.hits)
            self.hits[first:first + R] = hits.nan_to_num(2, 2, 2)
            bend = torch.add(LAM_GRAD * out["e_grad"], e_curv, alpha=LAM_LAP)  # (R,) [D3]
            self.mask.remember(rays, residual, bend, out["opacity"])
        if is_on and step % MASK_EVERY == 0:
            self.mask.calibrate(bend, 0.2 if cfg.gpl == "calibrated" else 0.0)
            taught, terms["gpl"] = self.mask.objective(pick)  # all terms of M in Eq. 5
            total = total + taught
        return total, terms | dict(mask=mask)

    def batch(self, photos: Tensor, n: int, gen: torch.Generator) -> tuple[Rays, Tensor]:
        """n rays of one step and the photos (B,) they come from, drawn at random."""
        B, wh, dev = self.cfg.photos, self.scene.wh, photos.device
        pick = photos[torch.randint(len(photos), (B,), generator=gen, device=dev)]  # (B,)
        img = pick.repeat_interleave(max(n // B, 1))  # (R,) photo by photo, equally many from each
        u = torch.rand(len(img), generator=gen, device=dev, dtype=torch.float64)  # (R,)
        return make_rays(self.scene, img, (u * wh[img].prod(1)).long()), pick

    def groups(self) -> list[dict]:
        """Optimiser groups: networks, lookup tables, which learn faster, zeta, and the mask. zeta's
        larger eps keeps vanishing gradients from driving it away."""
        tables = [self.appearance.weight, *(o.features for o in self.octrees)]
        mask, v = list(self.mask.parameters()), self.deviation.v
        taken = {*map(id, (*tables, *mask, v))}
        nets = [p for p in self.parameters() if id(p) not in taken]
        return [dict(params=nets, lr=self.cfg.lr_net), dict(params=tables, lr=self.cfg.lr_grid),
                dict(params=[v], lr=self.cfg.lr_zeta, eps=1e-8),
                dict(params=mask, lr=8e-3)]  # learns in few steps [D14]

    def start(self, gen: torch.Generator, steps: int = 200, radius: float = 0.25) -> None:
        """Warm-up: L_sphere fits the SDF to a sphere. A small one: a surface that starts inside the
        landmark grows to it, one that starts outside also has to be carved out of the sky."""
        grid, *nets = self.sdf.parameters()
        adam = torch.optim.Adam([dict(params=[grid], lr=1e-3), dict(params=nets)], 5e-3, fused=True)
        for _ in range(steps):
            x = torch.empty(1024, 3, device=gen.device).uniform_(-1, 1, generator=gen)  # (P,3)
            loss = ((self.distance(x) - (x.norm(dim=1) - radius)) ** 2).mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
        self.cache.refresh(self.distance)

    @torch.no_grad()
    def plan(self, is_last: bool) -> dict:
        """How to fit the model to the scene: split keys; if is_last, whether it needs a mask."""
        cfg, octree, mask = self.cfg, self.sdf.octree, self.cfg.mask
        keys = octree.split_keys if cfg.grid == "uniform" else refined_keys(
            octree, self.distance, self.hits, float(self.deviation()), cfg.max_mb)
        if is_last and mask == "auto":
            logits = self.mask.logits[self.scene.photos(False)]  # (B,1,m,m)
            share = logits[logits != -9].sigmoid().mean().item()  # of photos that it has seen
            mask = "on" if share > 0.01 else "off"  # [D16]
            print(f"  mean mask {share:.4f}: mask {mask}")
        return dict(keys=keys.cpu(), mask=mask)

    def follow(self, plan: dict, optimizer: torch.optim.Optimizer) -> None:
        """Carries out a plan; Adam's moments move along with their features."""
        octree, old, self.cfg.mask = self.sdf.octree, self.sdf.octree.features, plan["mask"]
        old_row = octree.build(plan["keys"].to(old.device))
        moments = optimizer.state.pop(old, {}).items()
        optimizer.state[octree.features] = {k: v[old_row] if v.dim() else v for k, v in moments}
        for group in optimizer.param_groups:
            group["params"] = [octree.features if p is old else p for p in group["params"]]

    def codes(self) -> Tensor:
        """Appearance codes (I,A) of all photos."""
        return self.appearance.weight

    def render(self, rays: Rays, code: Tensor) -> dict[str, Tensor]:
        """render_rays without jitter, for pictures and for fitting codes."""
        shape = len(rays.o), self.cfg.samples + self.cfg.bg_samples  # S and the background's
        return render_rays(self, rays, code, rays.o.new_full(shape, 0.5))


# ---- 8 Energy ------------------------------------------------------------------------------------

def open_counter(device: torch.device, rapl: str = "/sys/class/powercap"):
    """A function that reads joules: of a GPU through NVML (Volta and newer), whatever
    CUDA_VISIBLE_DEVICES says, or of a CPU's packages, where readable (often by root only)."""
    if device.type == "cuda":
        import pynvml
        pynvml.nvmlInit()
        used = range(RANKS) if RANKS > 1 else [device]  # the first process speaks for all
        gpus = [pynvml.nvmlDeviceGetHandleByUUID(
            f"GPU-{torch.cuda.get_device_properties(gpu).uuid}") for gpu in used]
        return lambda: sum(map(pynvml.nvmlDeviceGetTotalEnergyConsumption, gpus)) / 1e3  # mJ
    packages = [p for p in Path(rapl).glob("intel-rapl:*")  # not their parts, nor the platform
                if (p / "name").read_text().startswith("package")]
    need(packages, f"no counter in {rapl}")
    return lambda: sum(int((p / "energy_uj").read_text()) for p in packages) / 1e6


class EnergyMeter:
    """Joules counted from tick to tick, on top of those given; None, never 0, from where on nothing
    counts. A counter that starts again from zero between two ticks loses what it counted there."""
    def __init__(self, device: torch.device, joules: float | None = 0.0, counter=None):
        self.device, self.joules, self.counter, self.last = device, joules, counter, None
        self.source = {"cuda": "nvml"}.get(device.type, "rapl") + " counter, read every 5 s"

    def tick(self) -> None:
        """Adds what was spent since the last tick. A failing reading ends metering, not the run."""
        if self.joules is None:
            return
        try:
            self.counter = self.counter or open_counter(self.device)
            now = self.counter()
            self.joules += max(0.0, now - (now if self.last is None else self.last))
            self.last = now
        except Exception as error:  # a package, a driver's answer or a permission is missing
            print(f"  energy is null ({error}); a GPU's needs: pip install nvidia-ml-py")
            self.joules = None


# ---- 9 Training ----------------------------------------------------------------------------------

REFINE_AT = (0.1, 0.2, 0.3, 0.45, 0.6)  # shares of training at which the octree is refined
PATIENCE = 20  # void steps (loss or gradient not finite) in a row that stop a run; seen every 20
# torchrun starts RANKS processes. Each draws its own rays, the gradients are averaged, the first
# process decides, speaks and writes; so all hold the same weights, but each what its rays found.
RANK, LOCAL_RANK, RANKS = (int(os.environ.get(name, default)) for name, default in (
    ("RANK", 0), ("LOCAL_RANK", 0), ("WORLD_SIZE", 1)))


def agreed(value):
    """The value that the first process has, for all of them."""
    box = [value]
    if RANKS > 1:
        dist.broadcast_object_list(box)
    return box[0]


def training_step(model, optimizer, photos: Tensor, state: dict, progress: float, gen):
    """One update; the learning rate rises for 20 steps, then follows a cosine down to 5 %. Returns
    the raw terms of the loss, and 1 if a loss or gradient that is not finite made the step void.
    Nothing in it asks the device for a value."""
    rays, pick = model.batch(photos, model.cfg.rays // RANKS, gen)
    loss, terms = model.losses(rays, pick, state["step"], gen)
    optimizer.zero_grad()
    loss.backward()
    grads = [p.grad for p in model.parameters() if p.grad is not None]
    flat = nn.utils.parameters_to_vector([loss.detach()[None], *grads])
    if RANKS > 1:  # their mean over the processes
        dist.all_reduce(flat)
        nn.utils.vector_to_parameters(flat[1:] / RANKS, grads)
    is_void = (flat.sum() * 0).nan_to_num(1)  # 0 or 1, as NaN and infinity times 0 are NaN
    optimizer.found_inf = is_void  # fused Adam leaves such a step out
    factor = min(1, (state["step"] + 1) / 20) * (0.525 + 0.475 * math.cos(math.pi * progress))
    for group, now in zip(optimizer.param_groups, model.groups()):
        group["lr"] = factor * now["lr"]
    optimizer.step()
    state["step"] += 1
    return terms, is_void


def facts(model) -> list:
    """What a checkpoint must share with the scene and settings that it is read for."""
    raw, cfg = model.scene.raw, model.cfg
    made = {k: v for k, v in model.scene.info.items() if k not in ("folder", "split")}  # may move
    return [made, *(raw[k].tolist() for k in ("name", "is_test", "scale", "center")),
            cfg.grid, cfg.gpl]


def save_checkpoint(path: Path, model, optimizer, gen, state: dict) -> None:
    buffer = io.BytesIO()  # as torch.save calls a full disk a RuntimeError
    torch.save(dict(config=asdict(model.cfg), model=model.state_dict(), rng=gen.get_state(),
                    optimizer=optimizer.state_dict(), state=state, facts=facts(model),
                    octrees=[o.split_keys for o in model.octrees]), buffer)
    atomic_write(path, lambda tmp: tmp.write_bytes(buffer.getbuffer()))


def read_checkpoint(path: Path, given: dict) -> tuple[dict, Config]:
    """A checkpoint's dictionary, tensors and plain values, never code; and its settings, replaced
    by those given. Raises UserError."""
    need(path.exists(), f"{path} does not exist: train first, without --resume or --render, or "
         "name the run by the --data, --seed and --name that it was made with")
    try:
        data_prep.refuse_bomb(path)
        saved = dict(torch.load(path, map_location="cpu", weights_only=True))
        cfg = Config(**saved["config"])
        counts = map(dict(saved["state"]).get, ("step", "refined", "seconds", "dropped"))
        need(min(counts) >= 0, "")
    except Exception as error:  # a damaged file can fail in any layer: zip, pickle, tensor storage
        raise UserError(f"{path} is damaged, too large for the memory or of another program "
                        f"({type(error).__name__}): train again under another --name") from None
    return saved, replace(cfg, **given)


def restore(saved: dict, path: Path, model, gen=None) -> torch.optim.Adam:
    """Puts a checkpoint's weights into a model, its state into gen; returns its optimiser."""
    try:
        need(saved["facts"] == facts(model), "another scene or split")
        for octree, keys in zip(model.octrees, saved["octrees"], strict=True):
            octree.build(keys.to(octree.features.device))
        model.load_state_dict(saved["model"])
        optimizer = torch.optim.Adam(model.groups(), **model.adam, fused=True)
        optimizer.load_state_dict(saved["optimizer"])
        if gen is not None:
            gen.set_state(saved["rng"])
        return optimizer
    except torch.OutOfMemoryError:
        raise
    except (LookupError, ValueError, RuntimeError, TypeError, AttributeError, UserError) as error:
        raise UserError(f"{path} does not fit this scene and these settings ({error!r:.90}): use "
                        "flags and kind of device as it was made with, or another --name") from None


def train(cfg: Config, scene: Scene, run: Path, saved: dict | None = None, kind=GeoNVS):
    """Trains until cfg.steps or cfg.minutes; writes log.jsonl and checkpoint.pt below run. saved: a
    checkpoint to go on from; kind: class of the model. Returns model and state."""
    begin, path = time.perf_counter(), run / "checkpoint.pt"
    torch.set_flush_denormal(True)  # vanishing weights would otherwise slow a CPU down
    torch.manual_seed(cfg.seed)
    gen = torch.Generator(scene.c2w.device).manual_seed(cfg.seed)
    state = dict(step=0, refined=0, seconds=0.0, dropped=0, joules=0.0)
    state |= saved["state"] if saved else {}
    model, meter, terms = kind(cfg, scene), EnergyMeter(scene.c2w.device, state["joules"]), {}
    meter.tick()
    if saved is None:  # nothing of a former run may be taken for this one's
        for name in "checkpoint.pt log.jsonl metrics.json panel.png mesh.ply film.mp4".split():
            (run / name).unlink(missing_ok=True)
        model.start(gen)
        optimizer = torch.optim.Adam(model.groups(), **model.adam, fused=True)
    else:
        optimizer = restore(saved, path, model, gen)
    for value in model.state_dict().values() if RANKS > 1 else ():
        dist.broadcast(value, 0)
    if RANK:
        gen.manual_seed(cfg.seed + RANK + RANKS * state["step"])  # own rays for each process
    photos, begin, streak = scene.photos(False), begin - state["seconds"], 0  # void steps in a row
    next_line, next_save = state["seconds"] + 5, state["seconds"] + 60
    while True:
        seconds = agreed(time.perf_counter() - begin)
        progress = seconds / (60 * cfg.minutes) if cfg.minutes else state["step"] / cfg.steps
        has_diverged = state["step"] % PATIENCE == 0 and int(streak) >= PATIENCE
        is_over = progress >= 1 or has_diverged
        if is_over or seconds > next_line:
            state["dropped"] = int(state["dropped"])  # waits for a GPU's queue
            meter.tick()
            state |= dict(joules=meter.joules, energy_wh=meter.joules and meter.joules / 3600,
                          source=None if meter.joules is None else meter.source,
                          seconds=agreed(time.perf_counter() - begin))
            RANK or report(model, run / "log.jsonl", progress, state, terms)
            next_line = seconds + 5
            if is_over or seconds > next_save:
                RANK or save_checkpoint(path, model, optimizer, gen, state)
                next_save = seconds + 60
        if is_over:
            break
        terms, is_void = training_step(model, optimizer, photos, state, progress, gen)
        state["dropped"], streak = state["dropped"] + is_void, (streak + 1) * is_void
        due = sum(progress >= share for share in REFINE_AT)
        if state["refined"] != due:  # or fewer: resumed with a larger budget
            state["refined"] = due
            model.follow(agreed(RANK or model.plan(due == len(REFINE_AT))), optimizer)
    need(not has_diverged, f"{int(streak)} steps in a row had no finite loss: mend poses, or try a "
         f"third of the learning rates --lr_grid, --lr_net; {path} holds the last good weights")
    return model, state


@torch.no_grad()
def report(model, path: Path, progress: float, state: dict, terms: dict) -> None:
    """A line on the terminal and one in log.jsonl. psnr and opacity: of 1,024 fixed rays."""
    gen = torch.Generator(model.scene.c2w.device).manual_seed(0)
    rays, _ = model.batch(model.scene.photos(False), 1024, gen)
    out = model.render(rays, model.codes()[rays.img])
    more = dict(zeta=model.deviation(), opacity=out["opacity"]) if hasattr(model, "sdf") else {}
    line = {k: state[k] for k in ("step", "seconds", "dropped", "energy_wh")}
    line |= {k: v.mean().item() for k, v in (terms | more).items()}
    line["psnr"] = psnr(out["rgb"], rays.rgb)
    rate = state["step"] * model.cfg.rays / state["seconds"]
    left = state["seconds"] * max(0, 1 / max(progress, 1e-3) - 1) / 60
    shown = "".join(f"  {k} {line[k]:.3g}" for k in ("psnr", "zeta", "mask") if k in line)
    print(f"  step {state['step']:6d}{shown}  {rate:.0f} rays/s  {left:.1f} min left", flush=True)
    line = {k: v if v is None or abs(v) < math.inf else None for k, v in line.items()}  # as in JSON
    with open(path, "a") as file:
        file.write(json.dumps(line) + "\n")


# ---- 10 Scoring, mesh, pictures ------------------------------------------------------------------

def to_uint8(picture: np.ndarray) -> np.ndarray:
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def psnr(a, b) -> float:
    """Peak signal-to-noise ratio in dB of two pictures in 0..1, numpy or torch; at most 100."""
    return -10 * math.log10(max(float(((a - b) ** 2).mean()), 1e-10))


def make_lpips(device):
    """Learned perceptual distance of two pictures in 0..1 (AlexNet, v0.1), or None with a line."""
    try:
        import lpips
        net = lpips.LPIPS(net="alex", verbose=False).to(device)
    except Exception as error:  # not installed, or its weights cannot be fetched
        print(f"  lpips is null ({error}): pip install lpips, with a network for its weights")
        return None
    as_batch = lambda p: torch.as_tensor(p).to(device, torch.float32).permute(2, 0, 1)[None]
    return lambda *pair: net(*map(as_batch, pair), normalize=True).item()  # 0..1 to -1..1


def fit_codes(model, scene: Scene, photos: Tensor, steps: int = 128, n: int = 0) -> Tensor:
    """Appearance codes (B,A) of unseen photos (B,): Adam on n random rays a step of each left half
    (64, on a GPU 512) [D12], from the mean code of the training photos. The scene stays as is."""
    gen, n = torch.Generator(scene.c2w.device).manual_seed(0), n or (512 if photos.is_cuda else 64)
    codes = model.codes().detach()[~scene.is_test].mean(0).repeat(len(photos), 1)  # (B,A)
    adam = torch.optim.Adam([codes.requires_grad_()])
    img = photos.repeat_interleave(n)  # (Bn,)
    size = torch.stack([scene.wh[img, 0] // 2, scene.wh[img, 1]], 1)  # (Bn,2) of left halves [D12]
    model.requires_grad_(False)
    for step in tell(range(steps if codes.numel() else 0), "fitting the light of held-out photos"):
        adam.param_groups[0]["lr"] = 0.1 * 0.1 ** (step / steps)
        u = torch.rand(size.shape, generator=gen, device=gen.device, dtype=torch.float64)
        col, row = (u * size).long().unbind(1)  # (Bn,)
        rays = make_rays(scene, img, row * scene.wh[img, 0] + col)
        loss = (model.render(rays, codes.repeat_interleave(n, 0))["rgb"] - rays.rgb).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    for p in model.parameters():
        p.requires_grad_(p.numel() > 0)  # at 0 CUDA errs
    return codes.detach()


@torch.no_grad()
def render_photo(model, scene: Scene, photo: int, code: Tensor) -> dict[str, np.ndarray]:
    """A photo's view under an appearance code (A,): arrays (H,W,...) by name of render_rays, and
    `truth` (H,W,3)."""
    (w, h), parts = scene.wh[photo].tolist(), []
    size = CHUNK if scene.c2w.is_cuda else CHUNK // 8  # as in SDFCache.refresh
    for pixel in torch.arange(w * h, device=scene.c2w.device).split(size):
        rays = make_rays(scene, torch.full_like(pixel, photo), pixel)
        out = model.render(rays, code.expand(len(pixel), -1)) | dict(truth=rays.rgb)
        parts.append({k: v for k, v in out.items() if v[0].numel() in (1, 3)})  # not the samples'
    return {k: torch.cat([p[k] for p in parts]).reshape(h, w, *v.shape[1:]).cpu().numpy()
            for k, v in parts[0].items()}


def score(frame: dict[str, np.ndarray], lpips=None) -> dict:
    """The right half of a rendered photo [D12] against the truth, both rounded to 8 bits, beside
    the trivial predictor: the mean colour of each row of the left half. SSIM: Gaussian window of
    11 px, sigma 1.5, no border. None where a picture is too small."""
    half = frame["rgb"].shape[1] // 2
    flat = np.broadcast_to(frame["truth"][:, :half].mean(1, keepdims=True), frame["truth"].shape)
    got, want, flat = (to_uint8(p)[:, half:] / 255 for p in (frame["rgb"], frame["truth"], flat))
    how = dict(channel_axis=2, data_range=1, gaussian_weights=True, sigma=1.5)
    ssim, side = functools.partial(structural_similarity, **how), min(got.shape[:2])
    return dict(psnr=psnr(got, want), psnr_floor=psnr(flat, want), ssim=None if side < 11 else
                float(ssim(got, want, use_sample_covariance=False)),
                lpips=lpips(got, want) if lpips and side >= 32 else None)


def evaluate(model, scene: Scene, lpips=None) -> dict:
    """Scores of the test photos by the half-image protocol [D12], per photo and on average, None
    where there are none; the first frames, (photo, name, frame), for the panel."""
    photos, rows, frames, means = scene.photos(True), [], [], {}  # (B,)
    codes = [code for some in photos.split(32) for code in fit_codes(model, scene, some)]  # B (A,)
    for i, code in tell(list(zip(photos.tolist(), codes)), "scoring held-out photos"):
        frame, name = render_photo(model, scene, i, code), str(scene.raw["name"][i])
        rows.append(dict(name=name) | score(frame, lpips))
        frames += [(i, f"held out: {name}", frame)] if len(frames) < 2 else []
    for key in ("psnr", "psnr_floor", "ssim", "lpips"):
        values = [row[key] for row in rows if row[key] is not None]
        means[key] = float(np.mean(values)) if values else None
    return means | dict(per_image=rows, frames=frames)


@torch.no_grad()
def toy_truth(model, scene: Scene) -> dict:
    """What only a toy can tell, from every fifth training pixel. sdf_error: mean |s - s_true|
    within 0.05 of visible surfaces, scene units. mask_iou, mask_static: M > 0.5 against the true
    occluders, and mean M on all others; None without a mask."""
    raw, info, gen = scene.raw, scene.info, torch.Generator().manual_seed(0)
    img = torch.arange(len(scene.wh), device=scene.wh.device).repeat_interleave(scene.start.diff())
    pixel = torch.nonzero(~scene.is_test[img])[::5, 0]  # (R,)
    rays = make_rays(scene, img[pixel], pixel - scene.start[img[pixel]])
    depth = torch.as_tensor(raw["depth"]).to(rays.d)[pixel]  # (R,)
    x = rays.at(depth[:, None])[depth.isfinite(), 0]  # (P,3)
    x = x + 0.02 * torch.randn(x.shape, generator=gen).to(x)  # around the surface
    x = x[x.norm(dim=1) < 1]
    true = data_prep.toy_sdf(x.cpu().numpy() * raw["scale"] + raw["center"],
                             info["background"], info["landmark"]) / raw["scale"]  # (P,)
    s = torch.cat([model.distance(part) for part in x.split(CHUNK)]).cpu().numpy()  # (P,)
    error = float(np.abs(s - true)[np.abs(true) < 0.05].mean())
    if model.cfg.mask == "off":
        return dict(sdf_error=error, mask_iou=None, mask_static=None)
    mask = torch.cat([mask_at(model.mask.look(i), rays.uv[rays.img == i])
                      for i in scene.photos(False)[:, None]]).cpu().numpy()  # (R,)
    people, found = raw["occluder"][pixel.cpu()], mask > 0.5  # (R,)
    iou = float((found & people).sum() / (found | people).sum()) if people.any() else None
    return dict(sdf_error=error, mask_iou=iou, mask_static=float(mask[~people].mean()))


@torch.no_grad()
def extract_mesh(model: GeoNVS, resolution: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The surface s = 0 in the unit sphere, open where it meets that: vertices (N,3) in SfM units,
    faces (M,3). By marching cubes over `resolution` cells (default: two per finest octree cell, at
    most 512); corners near the surface are evaluated, elsewhere the cache has the sign."""
    scene, cache = model.scene, model.cache.volume
    n = resolution or min(round(2 / model.eps), 512)
    line = torch.linspace(-1, 1, n + 1, device=cache.device)
    volume = F.interpolate(cache, size=(n + 1,) * 3, mode="trilinear", align_corners=True)[0, 0]
    radius = (line[:, None, None] ** 2 + line[:, None] ** 2 + line ** 2).sqrt()  # (n+1,n+1,n+1)
    near = torch.nonzero((volume.abs() < 6 / cache.shape[-1]) & (radius < 1))  # (P,3)
    for index in tell(near.split(2 ** 16), "meshing"):
        volume[tuple(index.T)] = model.distance(index * (2 / n) - 1.0)
    is_inside = radius < 1 - 4 / n  # so that all corners of the cells there are evaluated
    if len(torch.unique(volume[is_inside] < 0)) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    vertices, faces, _, _ = marching_cubes(volume.cpu().numpy(), 0, mask=is_inside.cpu().numpy())
    return (vertices * (2 / n) - 1) * scene.raw["scale"] + scene.raw["center"], faces


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Binary PLY; double, as coordinates of a map would lose their metres."""
    f = np.empty(len(faces), [("n", "u1"), ("index", "<i4", 3)])
    f["n"], f["index"] = 3, faces
    header = ("ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}",
              *[f"property double {k}" for k in "xyz"], f"element face {len(f)}",
              "property list uchar int vertex_indices", "end_header\n")
    data = "\n".join(header).encode() + vertices.astype("<f8").tobytes() + f.tobytes()
    atomic_write(path, lambda tmp: tmp.write_bytes(data))


def panel(model, frames: list[tuple[int, str, dict]], width: int = 240) -> np.ndarray:
    """A row for each photo, (number, name, rendered frame): photo, render, and of our model the
    normals of the surface and what the mask network says of the photo."""
    rows = []
    for i, name, f in frames:
        tiles = {name: f["truth"], "render": f["rgb"]}
        if hasattr(model, "sdf"):
            tiles["normals"] = f["normal"] / 2 + 0.5
        if hasattr(model, "sdf") and model.cfg.mask != "off":
            M = to_uint8(model.mask.look([i])[0, 0].sigmoid().detach().cpu().numpy())  # (m,m)
            M = cv2.applyColorMap(M, cv2.COLORMAP_VIRIDIS)[:, :, ::-1] / 255  # (m,m,3)
            tiles["mask: yellow is transient"] = M
        size = width, round(width * f["rgb"].shape[0] / f["rgb"].shape[1])
        row = [np.pad(cv2.resize(to_uint8(tile), size, interpolation=cv2.INTER_AREA),
                      ((20, 4), (0, 4), (0, 0)), constant_values=255) for tile in tiles.values()]
        for title, tile in zip(tiles, row):
            cv2.putText(tile, title, (2, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, 16)
        rows.append(np.concatenate(row, 1))
    return np.concatenate(rows)


def finish(model, scene: Scene, state: dict, run: Path) -> dict:
    """Scores a trained model and writes metrics.json, panel.png and mesh.ply below run."""
    cfg, is_gpu, octrees = model.cfg, scene.c2w.is_cuda, model.octrees
    peak = (torch.cuda.max_memory_allocated(scene.c2w.device) if is_gpu else  # before scoring
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            * (1 if sys.platform == "darwin" else 1024))
    scores = evaluate(model, scene, make_lpips(scene.c2w.device))
    frames = scores.pop("frames")
    if hasattr(model, "sdf"):
        write_ply(run / "mesh.ply", *extract_mesh(model))
        scores |= toy_truth(model, scene) if scene.info["kind"] == "toy" else {}
        busy = scene.photos(False)
        share = model.mask.logits[busy].sigmoid().mean((1, 2, 3))
        busy = busy[share.argsort(descending=True)][:2].tolist()  # with most on the mask
        frames = [(i, f"training: {scene.raw['name'][i]}",
                   render_photo(model, scene, i, model.codes()[i])) for i in busy] + frames
    picture = panel(model, frames)[:, :, ::-1]
    atomic_write(run / "panel.png", lambda tmp: cv2.imwrite(str(tmp), picture))
    parameters = sum(p.numel() for p in model.parameters())
    git = "git", "-C", Path(__file__).parent, "describe", "--always", "--dirty", "--exclude=*"
    metrics = dict(
        scene=scene.info["scene"], method=model.name, seed=cfg.seed, steps=state["step"],
        device=(torch.cuda.get_device_name(scene.c2w.device) if is_gpu else
                f"cpu, {torch.get_num_threads()} threads"), **scores,
        train_seconds=state["seconds"], dropped=state["dropped"],
        energy_wh=state["energy_wh"], energy_source=state["source"],
        rays_per_second=state["step"] * cfg.rays / max(state["seconds"], 1e-9),
        octree_cells=octrees and octrees[0].cells[:, 0].bincount().tolist() or None,
        model_bytes=4 * parameters + sum(4 * (o.child.numel() + o.corner.numel()) for o in octrees),
        peak_memory_bytes=peak, parameters=parameters, torch=torch.__version__, config=asdict(cfg),
        protocol="appearance fitted on the left half, scored on the right half",
        commit=shutil.which("git") and subprocess.run(
            git, capture_output=True, text=True).stdout.strip() or None)
    atomic_write(run / "metrics.json", lambda tmp: tmp.write_text(json.dumps(metrics, indent=1)))
    return metrics


def film(model, scene: Scene, path: Path, rays: float = 4e6) -> None:
    """mp4 at 24 frames/s: a path through the training cameras, from one end to the other, then one
    view through the photos' lights. Frames are as large as photos, or as so many rays allow."""
    photos = scene.photos(False)
    c2w, codes = scene.c2w[photos], model.codes()[photos]
    between = lambda keys: F.interpolate(keys.T[None], 48, mode="linear", align_corners=True)[0].T
    place = c2w[:, :, 3] - c2w[:, :, 3].mean(0)  # (B,3)
    order = (place @ torch.linalg.svd(place)[2][0]).argsort()  # along the axis of their spread
    stops = order[torch.linspace(0, len(order) - 1, min(7, len(order))).round().long()]
    poses = between(c2w[stops].flatten(1)).reshape(-1, 3, 4)  # (48,3,4)
    left, _, right = torch.linalg.svd(poses[:, :, :3])
    poses[:, :, :3] = left @ right  # the nearest rotation
    view = order[len(order) // 2]  # the middle camera
    shots = [(pose, codes.mean(0)) for pose in poses]
    shots += [(c2w[view], code) for code in between(codes)] if codes.numel() else []
    wh, K = (a[photos[view]][None] for a in (scene.wh, scene.K))
    near = scene.near[photos].min()[None]  # as cameras between the photos may be nearer
    budget = rays * (50 if wh.is_cuda else 1) / len(shots)
    scale = min(1.0, math.sqrt(budget / wh.prod().item()))
    one = scene._replace(wh=(wh * scale / 2).long() * 2, K=K * scale, near=near)  # even sides

    def write(tmp):
        video = cv2.VideoWriter(str(tmp), cv2.VideoWriter_fourcc(*"mp4v"), 24, one.wh[0].tolist())
        need(video.isOpened(), "OpenCV cannot write mp4 here")
        for pose, code in tell(shots, f"filming {len(shots)} frames"):
            frame = render_photo(model, one._replace(c2w=pose[None]), 0, code)["rgb"]
            video.write(np.ascontiguousarray(to_uint8(frame)[:, :, ::-1]))
        video.release()  # without a word where the disk is full
        return cv2.VideoCapture(str(tmp)).get(cv2.CAP_PROP_FRAME_COUNT) == len(shots)
    atomic_write(path, write)
    print(f"wrote {path}")


# ---- 11 Command line -----------------------------------------------------------------------------

def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0], allow_abbrev=False,
                                     argument_default=argparse.SUPPRESS,
                                     epilog=f"[Dn]: see geonvs.py's head. Photos on a GPU: {LARGE}")
    parser.error = lambda message: need(False, f"{message}: see python geonvs.py --help")
    for f in fields(Config):
        parser.add_argument(f"--{f.name}", type=type(f.default), choices=f.metadata["choices"],
                            help=f"{f.metadata['help']} [{f.default}]")
    parser.add_argument("--resume", action="store_true", help="go on from the run's checkpoint")
    parser.add_argument("--render", action="store_true", help="film a finished run: a path through "
                        "the cameras, then one view through the lights of the photos")
    return parser


def pick_device(name: str) -> torch.device:
    """The device of this process: with torchrun each has its own GPU."""
    names = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    chosen = ("cuda" if names[1:] else "cpu") if name == "auto" else name
    if chosen == "cuda" or RANKS > 1 and chosen in names[1:]:
        chosen = f"cuda:{LOCAL_RANK}"
    need(chosen in names, f"--device {name} is not there: this machine has {', '.join(names)}")
    return torch.device(chosen)


def make_config(given: dict) -> Config:
    """Config's defaults, then LARGE if photos meet a GPU, then flags."""
    is_toy = not given.get("data") and given.get("scene", "toy") == "toy"
    has_gpu = given.get("device") != "cpu" and torch.cuda.device_count() > 0
    return Config(**(LARGE if has_gpu and not is_toy else {}) | given)


def execute(cfg: Config, scene: Scene, run: Path, saved: dict | None = None, kind=GeoNVS) -> dict:
    """Trains and scores one model; returns its metrics."""
    run.mkdir(parents=True, exist_ok=True)
    print(f"{kind.name} on {scene.info['scene']}: {len(scene.wh)} photos ({len(scene.photos(True))}"
          f" held out), {len(scene.rgb):,} pixels; {scene.c2w.device}; {run}/")
    model, state = train(cfg, scene, run, saved, kind)
    metrics = agreed(RANK or finish(model, scene, state, run))
    print("".join(f"  {k} {v:.4g}" for k, v in metrics.items() if isinstance(v, float)))
    return metrics


def main(argv: list[str] | None = None) -> None:
    given, saved = vars(make_parser().parse_args(argv)), None
    resume, render = (given.pop(k, False) for k in ("resume", "render"))
    finding = ("scene", "data", "name", "seed") if resume or render else given  # a run's folder
    cfg = make_config({k: v for k, v in given.items() if k in finding})
    where = data_prep.scene_path(cfg.source).stem
    run = Path("runs") / (cfg.name or f"{where}-{GeoNVS.name}-{cfg.seed}")
    if resume or render:
        given = {"minutes": 0.0} | given if "steps" in given else given  # of budgets the last one
        saved, cfg = read_checkpoint(run / "checkpoint.pt", given)
    need(cfg.rays % (cfg.photos * RANKS) == 0 and cfg.rays >= 2 * RANKS,
         f"--rays {cfg.rays} must be a multiple of --photos {cfg.photos} times {RANKS} processes")
    device = pick_device(cfg.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if RANKS > 1:
        need("MASTER_ADDR" in os.environ, "start processes by torchrun, or unset WORLD_SIZE")
        dist.init_process_group("cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo",
                                timeout=datetime.timedelta(days=1))  # the first scores alone
        sys.stdout = open(os.devnull, "w") if RANK else sys.stdout
    opened = functools.cache(data_prep.open_scene)
    agreed(RANK or bool(opened(cfg.source, cfg.downscale)))  # the first makes the file
    scene = load_scene(opened(cfg.source, cfg.downscale), device)
    if render:
        model = GeoNVS(cfg, scene)
        restore(saved, run / "checkpoint.pt", model)
        RANK or film(model, scene, run / "film.mp4")
    else:
        execute(cfg, scene, run, saved)


def run_command_line(entry) -> None:
    """Exit code 0, or 2 with one sentence on stderr. Several processes part in the end."""
    try:
        entry()
        if dist.is_initialized():
            dist.destroy_process_group()
            gc.collect()  # a cycle that holds the group would keep its threads: exit would abort
        return
    except UserError as error:
        message = str(error)
    except (RuntimeError, MemoryError) as error:  # a CPU's allocator has no error of its own
        if not re.search("MemoryError|allocate memory|out of memory", repr(error)):
            raise
        message = ("the memory is full: go on with fewer --samples, or begin anew with fewer "
                   "--rays, a lower --max_mb or a larger --downscale")
    except OSError as error:  # a full disk, a folder without permission
        message = f"{error}: free or choose a place, then go on with --resume"
    except KeyboardInterrupt:
        message = "stopped; --resume goes on from the last checkpoint: training makes one a minute"
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    run_command_line(main)
