"""Geo-NVS-w: a signed distance field, fed by tourist photos, becomes a picture from a new viewpoint.

A minimal single-file reference implementation of "Geo-NVS-w: Geometry-Aware Novel View Synthesis
In-the-Wild with an SDF Renderer" (Tsalakopoulos et al., ICCV 2025 workshops). Read it top to bottom:
the sections follow one ray from the pixel to the loss, then the training loop around it.

    python geonvs.py                             toy scene: made, trained, scored (minutes, 2 CPU cores)
    python geonvs.py --scene brandenburg         a Phototourism scene (one GPU); also sacre, trevi, taj
    python geonvs.py --data DIR                  your own COLMAP folder
    python geonvs.py --help                      every setting with its meaning, unit and source

A run writes runs/<name>/: metrics.json, log.jsonl, checkpoint.pt, panel.png, mesh.ply.

Conventions, stated once
  world     the foreground is the unit sphere; x_file = x * scale + center leads back to SfM units
  cameras   c2w (3,4) camera to world, OpenCV axes: x right, y down, z forward; pixel centres at +0.5
  rays      r(t) = o + t d with |d| = 1, so t is a distance along the ray and not a z-depth
  sdf       positive outside; the normal is the unit gradient; colours are sRGB in [0, 1]
  mask      M = 1 means transient (person, car), M = 0 means scene
  shapes    R rays, S samples per ray, P points, L octree levels, C channels per level, V octree corners,
            A appearance dims, I photos, K sparse points

Where the printed paper is departed from, the line carries its tag:
  [D1]  alpha is divided by sigmoid(zeta s_prev) and never negative (as printed, a wall is 63 % opaque)
  [D2]  the slope correction sits inside zeta, with opposite signs for the two ends of a section
  [D3]  Phi uses NeuS-weighted errors, |lap| times eps, batch-quantile calibration, and is detached
  [D4]  the curvature loss is |lap| times eps: |lap| of a trilinear field grows as eps shrinks
  [D5]  the Lipschitz term is a sum of logs, not a product that starts ten times above the colour loss
  [D6]  CGNet: GroupNorm for BatchNorm, half the width, negative initial bias, a head at half resolution
  [D7]  the mask pays mean M, not mean M^2, to go with an L1 error; its weight decays from a high start
  [D8]  the background starts where the ray leaves the sphere and its last section is opaque
  [D9]  the SDF branch stays in float32 under mixed precision: half precision turns normals into noise
  [D10] SfM points place the sphere, seed the octree and pull |s(p)| to zero
  [D11] samples are drawn from a cached SDF volume; no second network pass along the ray
  [D12] test photos: appearance fitted on the left half, scored on the right half
  [D13] normals come from differentiating the trilinear weights; --normals fd is the paper's choice
"""
from __future__ import annotations

import argparse
import difflib
import json
import math
import os
import platform
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from skimage.measure import marching_cubes
from skimage.metrics import structural_similarity
from torch import Tensor, nn

import data_prep
from data_prep import UserError, atomic_write

# ---------------------------------------------------------------------------------------------------
# 1 Config: every field is a flag
# ---------------------------------------------------------------------------------------------------


def opt(default, text, choices=None):
    return field(default=default, metadata={"help": text, "choices": choices})


@dataclass
class Config:
    """All settings. [R] marks a value that the paper leaves open (recommended by the predecessors)."""

    scene: str = opt("toy", "toy, brandenburg, sacre, trevi or taj")
    data: str = opt("", "an IMC-PT or COLMAP folder instead of a named scene")
    method: str = opt("geonvsw", "which model to train", ("geonvsw", "nerfw", "hanerf"))
    name: str = opt("", "run folder below runs/ (default: scene-method-seed)")
    seed: int = opt(0, "seed of everything random")
    device: str = opt("auto", "auto, cpu, cuda or cuda:N")
    steps: int = opt(4000, "training steps")
    minutes: float = opt(0.0, "training budget in minutes, 0: until --steps is reached")
    downscale: int = opt(2, "integer factor by which photos are made smaller (benchmarks use 2)")
    rays: int = opt(512, "rays per step")
    photos: int = opt(8, "photos per step; the mask network sees these whole")
    samples: int = opt(16, "foreground samples per ray")
    bg_samples: int = opt(8, "background samples per ray")
    levels: int = opt(0, "octree levels, 0: from the pixel footprint at the surface")
    bg_levels: int = opt(3, "octree levels of the background")
    channels: int = opt(4, "feature channels per octree level")
    hidden: int = opt(64, "width of the MLPs")
    appearance_dim: int = opt(16, "length of a photo's appearance code")
    appearance: str = opt("auto", "appearance codes; auto: on if exposures differ", ("auto", "on", "off"))
    mask: str = opt("auto", "transient mask; auto: off if nothing is transient", ("auto", "on", "off"))
    background: str = opt("auto", "background field; auto: off if it is one colour", ("auto", "on", "off"))
    mask_every: int = opt(4, "the mask network runs every so many steps; between, its last logits count")
    mask_px: int = opt(96, "side of the square photo that the mask network sees, px")
    normals: str = opt("analytic", "derivatives of the SDF [D13]", ("analytic", "fd"))
    sampling: str = opt("cached", "how samples are placed [D11]", ("cached", "uniform"))
    alpha: str = opt("neus", "opacity of a section [D1] [D2]", ("neus", "printed"))
    gpl: str = opt("calibrated", "edge indicator Phi [D3]", ("calibrated", "literal"))
    lam_eik: float = opt(0.04, "weight of the eikonal loss (Permuto-SDF)")
    lam_curv: float = opt(1e-3, "weight of the curvature loss, on |lap| eps [D4] [R]")
    lam_gpl: float = opt(0.05, "weight of the geometry-preservation loss (paper)")
    lam_grad: float = opt(10.0, "weight of the eikonal error inside Phi (paper)")
    lam_lap: float = opt(2.0, "weight of the curvature inside Phi (the paper's lambda_curv = 2)")
    lam_lps: float = opt(1e-5, "weight of the Lipschitz loss, log form [D5] [R]")
    lam_off: float = opt(1e-3, "weight of the off-surface loss [R]")
    lam_sfm: float = opt(0.3, "weight of |s(p)| at SfM points [D10]")
    lam_mask: float = opt(0.1, "weight of mean M: the L1 error from which a pixel is masked [D7]")
    lam_bimodal: float = opt(1e-4, "weight of the pull of M towards 0 and 1 (Ha-NeRF's digit loss) [R]")
    lr_grid: float = opt(1e-2, "learning rate of octree features")
    lr_net: float = opt(2e-3, "learning rate of networks and codes")
    lr_zeta: float = opt(1e-3, "learning rate of the deviation network")
    amp: bool = opt(True, "mixed precision on a GPU [D9]")
    protocol: str = opt("half", "half: fit left, score right [D12]; leaky: fit on all", ("half", "leaky"))


SCENES = {  # settings that differ from Config's defaults, by scene; flags override them
    "toy": dict(steps=5000),
    **{name: dict(steps=300_000, rays=4096, photos=16, samples=32, bg_samples=16, appearance_dim=32)
       for name in data_prep.SCENES},
}

# ---------------------------------------------------------------------------------------------------
# 2 Scene file and rays
# ---------------------------------------------------------------------------------------------------


class Scene(NamedTuple):
    """The arrays of one scene file (data_prep.py documents them) as tensors on the device."""

    rgb: Tensor  # (N,3) uint8, all pixels of all photos, photo after photo
    start: Tensor  # (I+1,) first pixel of each photo
    wh: Tensor  # (I,2) width, height in px
    K: Tensor  # (I,4) fx fy cx cy in px
    c2w: Tensor  # (I,3,4)
    near: Tensor  # (I,) smallest useful t
    is_test: Tensor  # (I,)
    points: Tensor  # (K,3) SfM points
    track_photo: Tensor  # (T,) photo ...
    track_point: Tensor  # (T,) ... in which this point was found
    thumbs: Tensor  # (I,3,mask_px,mask_px) uint8, whole photos for the mask network
    raw: dict  # the file's arrays in numpy: names, ground truth of the toy, center, scale, info

    @property
    def info(self):
        return json.loads(str(self.raw["info"]))

    def photo(self, i: int) -> np.ndarray:
        """Photo i as (H,W,3) uint8."""
        w, h = self.raw["wh"][i]
        return self.raw["rgb"][self.raw["start"][i]:self.raw["start"][i + 1]].reshape(h, w, 3)


def load_scene(arrays: dict | str | Path, device="cpu", mask_px: int = 96) -> Scene:
    """Scene from a file written by data_prep.py, or from its dictionary. Raises UserError."""
    if not isinstance(arrays, dict):
        arrays = dict(np.load(arrays))
    wh, start = arrays["wh"], arrays["start"]
    thumbs = np.stack([cv2.resize(arrays["rgb"][start[i]:start[i + 1]].reshape(h, w, 3),
                                  (mask_px, mask_px), interpolation=cv2.INTER_AREA)
                       for i, (w, h) in enumerate(wh)])  # (I,H,W,3)

    def to(key, dtype):
        return torch.as_tensor(arrays[key]).to(device=device, dtype=dtype)
    return Scene(to("rgb", torch.uint8), to("start", torch.long), to("wh", torch.long),
                 to("K", torch.float32), to("c2w", torch.float32), to("near", torch.float32),
                 to("is_test", torch.bool), to("points", torch.float32), to("track_photo", torch.long),
                 to("track_point", torch.long),
                 torch.as_tensor(thumbs).permute(0, 3, 1, 2).to(device).contiguous(), arrays)


class Rays(NamedTuple):
    """A batch of rays; every field is indexed by the ray."""

    o: Tensor  # (R,3) origin
    d: Tensor  # (R,3) unit direction
    near: Tensor  # (R,)
    img: Tensor  # (R,) photo index
    uv: Tensor  # (R,2) pixel position over photo size, 0..1
    rgb: Tensor  # (R,3) the photo's colour


def pixel_directions(uv_px: Tensor, K: Tensor) -> Tensor:
    """Unit directions in camera axes of positions uv_px (R,2) px, pixel centres at +0.5."""
    xy = (uv_px - K[:, 2:]) / K[:, :2]  # (R,2)
    return F.normalize(torch.cat([xy, torch.ones_like(xy[:, :1])], 1), dim=1)  # (R,3)


def make_rays(scene: Scene, img: Tensor, pixel: Tensor) -> Rays:
    """Rays through pixels. img, pixel: (R,) photo and row-major pixel number within it."""
    w, h = scene.wh[img].unbind(1)  # (R,)
    uv = torch.stack([pixel % w, torch.div(pixel, w, rounding_mode="floor")], 1) + 0.5  # (R,2) px
    c2w = scene.c2w[img]  # (R,3,4)
    d = (c2w[:, :, :3] @ pixel_directions(uv, scene.K[img])[:, :, None])[:, :, 0]  # (R,3)
    rgb = scene.rgb[scene.start[img] + pixel].float() / 255  # (R,3)
    return Rays(c2w[:, :, 3], d, scene.near[img], img, uv / torch.stack([w, h], 1), rgb)


def random_rays(scene: Scene, photos: Tensor, n: int, per_step: int, gen: torch.Generator):
    """n training rays from per_step random photos. Returns Rays and the photos (B,) drawn."""
    pick = photos[torch.randint(len(photos), (per_step,), generator=gen, device=photos.device)]  # (B,)
    img = pick.repeat_interleave(n // per_step)  # (R,) photo by photo, equally many from each
    u = torch.rand(len(img), generator=gen, device=photos.device, dtype=torch.float64)  # (R,)
    return make_rays(scene, img, (u * (scene.start[img + 1] - scene.start[img])).long()), pick


def sphere_interval(rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """t where each ray enters and leaves the unit sphere, and whether it does: (R,), (R,), (R,).

    A ray that misses the sphere, or has it behind, gets the empty interval at its closest approach (or
    at near), from where its background starts: no ray is ever dropped, and no square root is negative.
    """
    closest = -(rays.o * rays.d).sum(1)  # (R,)
    disc = closest ** 2 - (rays.o ** 2).sum(1) + 1  # (R,)
    half = disc.clamp(min=0).sqrt()  # (R,)
    hit = (disc > 0) & (closest + half > rays.near)  # (R,)
    t0 = torch.maximum(closest - half * hit, rays.near)  # (R,)
    t1 = torch.maximum(closest + half * hit, t0)  # (R,)
    return t0, t1, hit


# ---------------------------------------------------------------------------------------------------
# 3 Octree: features on the corners of cells
# ---------------------------------------------------------------------------------------------------

CORNERS = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # (8,3), x slowest


def trilinear_matrices() -> Tensor:
    """(8,32): the monomials 1 z y yz x xz xy xyz of a position in a cell times this are the weights of
    the 8 corners, then their derivatives along x, y, z. Per axis the two ends weigh 1 - f and f.
    """
    value, slope = torch.tensor([[1.0, 0], [-1, 1]]), torch.tensor([[-1.0, 1], [0, 0]])  # rows: 1, f
    axes = [(value, value, value), (slope, value, value), (value, slope, value), (value, value, slope)]
    return torch.cat([torch.kron(x, torch.kron(y, z)) for x, y, z in axes], 1)


TRILINEAR = trilinear_matrices()


class Interpolate(torch.autograd.Function):
    """out[p,j] = sum over the 8 corners k of w[p,j,k] features[corner[p,k]], for J sets of weights.

    The j-th set of weights is the value (j = 0) or its derivative along x, y, z. A fused gather both
    ways (embedding_bag forward, index_add backward) because this is the hottest operation of a step.
    Row 0 of the features belongs to the pinned corners: it is zero and gets no gradient.
    """

    @staticmethod
    def forward(ctx, features, corner, w):  # (V,C), (P,8), (P,J,8) -> (P,J,C)
        ctx.save_for_backward(corner, w)
        ctx.rows = len(features)
        return torch.stack([F.embedding_bag(corner, features, per_sample_weights=wj.contiguous(), mode="sum")
                            for wj in w.unbind(1)], 1)

    @staticmethod
    def backward(ctx, grad):  # (P,J,C)
        corner, w = ctx.saved_tensors
        spread = torch.bmm(w.transpose(1, 2), grad)  # (P,8,C)
        out = grad.new_zeros(ctx.rows, grad.shape[2])  # (V,C)
        out.index_add_(0, corner.reshape(-1), spread.reshape(-1, grad.shape[2]))
        out[0] = 0
        return out, None, None


class Octree(nn.Module):
    """Feature grid over the cube [-half, half]^3 that is fine only where it has been split.

    Level 0 is a dense grid of root^3 cells; a node points to its first of eight children. Nodes 0..7 are
    the null block: a leaf's children, and their own. Features live on corners, shared by the cells that
    meet there. A corner with a missing cell around it ("hanging") is pinned to zero, so that the field
    is continuous across every face between a refined and an unrefined region. A query concatenates the
    trilinear features of all levels on its path; absent levels contribute zeros.
    """

    def __init__(self, half: float, levels: int, root: int = 16, channels: int = 4, std: float = 1e-2):
        super().__init__()
        self.half, self.levels, self.root, self.std = half, levels, root, std
        self.features = nn.Parameter(torch.zeros(1, channels))  # (V,C), row 0 pinned
        self.register_buffer("row_key", torch.zeros(1, dtype=torch.long))  # (V,) level and corner
        self.register_buffer("scale", torch.tensor([float(self.resolution(i)) for i in range(levels)]))
        self.build([torch.zeros(0, dtype=torch.long)] * (levels - 1))
        self.features.data[1:].normal_(0, std)

    def resolution(self, level: int) -> int:
        return self.root << level

    def cell(self, level: int) -> float:
        """Side of a cell, scene units."""
        return 2 * self.half / self.resolution(level)

    def key(self, ijk: Tensor, level: int) -> Tensor:
        """One number per cell or corner (...,3) of a level; corners run to resolution inclusive."""
        n = self.resolution(level) + 1
        return (ijk[..., 0] * n + ijk[..., 1]) * n + ijk[..., 2]

    def cell_of(self, x: Tensor, level: int) -> Tensor:
        """Integer coordinates (P,3) of the cell of a level that holds x (P,3), clamped to the cube."""
        n = self.resolution(level)
        return ((x / (2 * self.half) + 0.5) * n).long().clamp(0, n - 1)

    def build(self, split_keys: list[Tensor]) -> Tensor:
        """Makes nodes and corners from the keys of the split cells of each level but the last.

        Features of corners that exist before and after are kept, new ones are zero. Returns old_row (V,):
        the former row of every row, 0 (the pinned zero row) for new ones; it remaps optimiser state too.
        """
        dev = self.features.device
        grid = torch.arange(self.root, device=dev)
        ijk = torch.cartesian_prod(grid, grid, grid)  # (N,3) cells of the level, in node order
        child, corner, rows, start = [torch.zeros(8, dtype=torch.long, device=dev)], \
            [torch.zeros(8, 8, dtype=torch.long, device=dev)], [torch.zeros(1, dtype=torch.long, device=dev)], 8
        n_rows = 1
        self.split_keys, self.cells = [], []
        for level in range(self.levels):
            n = self.resolution(level)
            self.cells.append(ijk)
            at = ijk[:, None] + CORNERS.to(dev)  # (N,8,3)
            keys, inverse, count = torch.unique(self.key(at, level), return_inverse=True,
                                                return_counts=True)
            k = torch.stack([keys // (n + 1) ** 2, keys // (n + 1) % (n + 1), keys % (n + 1)], 1)
            free = count == (1 + ((k > 0) & (k < n)).long()).prod(1)  # all cells around it exist
            row = torch.where(free, n_rows - 1 + free.long().cumsum(0), 0)
            corner.append(row[inverse])  # (N,8)
            rows.append(keys[free] + ((level + 1) << 40))
            n_rows += int(free.sum())
            here = torch.zeros(len(ijk), dtype=torch.long, device=dev)  # (N,) first child
            if level + 1 < self.levels:
                is_split = torch.isin(self.key(ijk, level), split_keys[level])  # (N,)
                here[is_split] = start + len(ijk) + 8 * torch.arange(int(is_split.sum()), device=dev)
                self.split_keys.append(self.key(ijk[is_split], level))
                start += len(ijk)
                ijk = (2 * ijk[is_split][:, None] + CORNERS.to(dev)).reshape(-1, 3)
            child.append(here)
        row_key = torch.cat(rows)
        old_row = torch.searchsorted(self.row_key, row_key).clamp(max=len(self.row_key) - 1)
        old_row = torch.where(self.row_key[old_row] == row_key, old_row, 0)  # (V,)
        self.features = nn.Parameter(self.features.detach()[old_row])  # (V,C)
        self.row_key = row_key
        self.child, self.corner = torch.cat(child), torch.cat(corner).int()  # (N,), (N,8)
        return old_row

    def split(self, level: int, ijk: Tensor) -> Tensor:
        """Splits cells ijk (P,3) of a level. The function does not change: new features are zero."""
        keys = list(self.split_keys)
        keys[level] = torch.cat([keys[level], self.key(ijk, level)])
        return self.build(keys)

    def prune(self, level: int, ijk: Tensor) -> Tensor:
        """Removes the children of cells ijk (P,3) of a level, and all that hangs below them."""
        keys = list(self.split_keys)
        keys[level] = keys[level][~torch.isin(keys[level], self.key(ijk, level))]
        return self.build(keys)

    def locate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Corner rows (P,L,8) of the cells that hold x (P,3), and the position (P,L,3) 0..1 inside."""
        u = (x / (2 * self.half) + 0.5).clamp(0, 1 - 1e-6)  # (P,3)
        at = u[:, None] * self.scale[:, None]  # (P,L,3) in cells
        ijk = at.long()  # (P,L,3)
        node = 8 + (ijk[:, 0, 0] * self.root + ijk[:, 0, 1]) * self.root + ijk[:, 0, 2]  # (P,)
        nodes = [node]
        for level in range(1, self.levels):
            bit = ijk[:, level] & 1  # (P,3)
            node = self.child[node] + bit[:, 0] * 4 + bit[:, 1] * 2 + bit[:, 2]  # (P,)
            nodes.append(node)
        return self.corner[torch.stack(nodes, 1)].long(), at - ijk

    def forward(self, x: Tensor, derivatives: bool = False) -> Tensor:
        """Features (P,L,J,C) at x (P,3); J = 1, or 4: value and its change per cell along x, y, z."""
        P, L, J = len(x), self.levels, 4 if derivatives else 1
        corner, inside = self.locate(x)  # (P,L,8), (P,L,3)
        fx, fy, fz = inside.reshape(-1, 3).T.contiguous()  # (PL,)
        yz = fy * fz
        basis = torch.stack([torch.ones_like(fx), fz, fy, yz, fx, fx * fz, fx * fy, fx * yz], 1)  # (PL,8)
        w = basis @ TRILINEAR[:, :8 * J].to(x.device)  # (PL,8J)
        out = Interpolate.apply(self.features, corner.reshape(-1, 8), w.reshape(-1, J, 8))
        return out.reshape(P, L, J, -1)

    def bytes(self) -> int:
        """Memory of features and structure."""
        return sum(t.numel() * t.element_size() for t in (self.features, self.child, self.corner))


def seed_octree(octree: Octree, points: Tensor, dense: int, shell: tuple[float, float]) -> None:
    """Splits all cells that touch the shell of radii up to level `dense`; below, those near points.

    Near is one cell on every side, so that the corners around a point are never hanging.
    """
    for level in range(octree.levels - 1):
        ijk = octree.cells[level]  # (N,3)
        if level < dense:
            centre = (ijk + 0.5) * octree.cell(level) - octree.half  # (N,3)
            reach = octree.cell(level) * math.sqrt(3) / 2
            r = centre.norm(dim=1)  # (N,)
            octree.split(level, ijk[(r > shell[0] - reach) & (r < shell[1] + reach)])
        elif len(points):
            near = octree.cell_of(points, level)[:, None] + torch.cartesian_prod(
                *[torch.arange(-1, 2, device=ijk.device)] * 3)  # (K,27,3)
            octree.split(level, near.reshape(-1, 3).clamp(0, octree.resolution(level) - 1).unique(dim=0))
    octree.features.data[1:].normal_(0, octree.std)


def levels_for_footprint(scene: Scene, root: int = 16, finest: int = 8) -> int:
    """Octree levels such that the finest cell is not smaller than a pixel at the surface.

    The footprint of a pixel at an SfM point is depth / focal length; the lower quartile over all
    observations in training photos counts, so the closest photos decide without single outliers.
    """
    seen = ~scene.is_test[scene.track_photo]  # (T,)
    cam, at = scene.c2w[scene.track_photo[seen]], scene.points[scene.track_point[seen]]
    footprint = (at - cam[:, :, 3]).norm(dim=1) / scene.K[scene.track_photo[seen], 0]  # (T,) units
    footprint = footprint[at.norm(dim=1) < 1]
    if not len(footprint):  # no points: as if the surface were at the centre
        footprint = scene.c2w[:, :, 3].norm(dim=1) / scene.K[:, 0]
    cells = 2 / footprint.double().quantile(0.25).item()
    return int(np.clip(1 + math.floor(math.log2(cells / root)), 2, finest))


# ---------------------------------------------------------------------------------------------------
# 4 Fields: the networks on top of the octree
# ---------------------------------------------------------------------------------------------------

GEO = 15  # length of the geometry feature that the SDF network hands to the colour network
BETA = 100.0  # sharpness of the softplus in the SDF network: nearly a ReLU, but twice differentiable


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
        differentiable expression, so training through normals needs no second-order autograd.
        """
        with torch.autocast(x.device.type, enabled=False):  # [D9]
            feat = self.octree(x, derivatives=True)  # (P,L,4,C)
            h = self.lin1(torch.cat([x, feat[:, :, 0].flatten(1)], 1))  # (P,H)
            out = self.lin2(F.softplus(h, BETA))  # (P,1+GEO)
            ds_dz = (torch.sigmoid(BETA * h) * self.lin2.weight[0]) @ self.lin1.weight  # (P,3+LC)
            ds_df = ds_dz[:, 3:].reshape(len(x), self.octree.levels, 1, -1)  # (P,L,1,C)
            per_unit = (self.octree.scale / (2 * self.octree.half))[:, None, None]  # (L,1,1) cells
            grad = ds_dz[:, :3] + (feat[:, :, 1:] * (ds_df * per_unit)).sum((1, 3))  # (P,3)
        return out[:, 0], out[:, 1:], grad


TETRAHEDRON = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])  # (4,3) tap directions


def finite_differences(sdf, x: Tensor, eps: float, centre: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Gradient (P,3) and Laplacian (P,) of sdf at x (P,3) from four tetrahedral taps (Neuralangelo).

    Taps sit at x + eps k / sqrt(3): their mean difference to the centre is eps^2/6 times the Laplacian,
    their k-weighted mean the gradient. centre: s(x) where the caller has it already.
    """
    k = TETRAHEDRON.to(x.device) / math.sqrt(3)  # (4,3)
    taps = sdf((x[:, None] + eps * k).reshape(-1, 3)).reshape(-1, 4)  # (P,4)
    centre = sdf(x) if centre is None else centre  # (P,)
    grad = 0.75 / eps * (taps @ k)  # (P,3); sum over taps of k k^T is 4/3 times the identity
    lap = 6 / eps ** 2 * (taps.mean(1) - centre)  # (P,)
    return grad, lap


def sh_basis(d: Tensor) -> Tensor:
    """Real spherical harmonics up to degree 2 of unit directions (R,3) -> (R,9), without constants."""
    x, y, z = d.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 1)


class LipschitzMLP(nn.Module):
    """MLP whose rows are scaled to an L1 norm of at most softplus(c) per layer (Liu et al. 2022)."""

    def __init__(self, sizes: list[int]):
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:]))
        bound = [layer.weight.detach().abs().sum(1).max() for layer in self.layers]
        self.c = nn.Parameter(torch.stack([torch.log(torch.expm1(2 * b)) for b in bound]))  # (layers,)

    def bounds(self) -> Tensor:
        """Lipschitz bound of each layer in the max norm."""
        return F.softplus(self.c)

    def forward(self, x: Tensor) -> Tensor:
        for i, (layer, bound) in enumerate(zip(self.layers, self.bounds())):
            scale = (bound / layer.weight.abs().sum(1)).clamp(max=1)  # (out,)
            x = F.linear(x, layer.weight * scale[:, None], layer.bias)
            x = F.relu(x) if i + 1 < len(self.layers) else x
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
        self.density = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, 1 + GEO))
        self.color = nn.Sequential(nn.Linear(GEO + 9 + appearance_dim, hidden), nn.ReLU(),
                                   nn.Linear(hidden, 3))

    def forward(self, rays: Rays, start: Tensor, code: Tensor, n: int, jitter: Tensor) -> Tensor:
        """Colour (R,3) beyond start (R,). code: (R,A); jitter: (R,n) in 0..1. [D8]

        Sections are equal steps of u in t = start + u / (1 - u); the last one is opaque.
        """
        edges = torch.arange(n, device=start.device) / n  # (n,)
        u = edges + jitter / n  # (R,n) stratified
        t = start[:, None] + u / (1 - u).clamp(min=1e-3)  # (R,n)
        dt = torch.diff(t, dim=1)  # (R,n-1)
        x = contract(rays.o[:, None] + t[:, :, None] * rays.d[:, None]).reshape(-1, 3)  # (Rn,3)
        out = self.density(torch.cat([x, self.octree(x).flatten(1)], 1)).float()  # (Rn,1+GEO)
        sigma = F.softplus(out[:, 0].reshape(len(t), n) - 1)  # (R,n)
        alpha = torch.cat([1 - torch.exp(-sigma[:, :-1] * dt), torch.ones_like(t[:, :1])], 1)  # (R,n)
        per_ray = torch.cat([sh_basis(rays.d), code], 1).repeat_interleave(n, 0)  # (Rn,9+A)
        rgb = torch.sigmoid(self.color(torch.cat([out[:, 1:], per_ray], 1)).float())  # (Rn,3)
        w, _ = composite(alpha)  # (R,n)
        return (w[:, :, None] * rgb.reshape(len(t), n, 3)).sum(1)  # (R,3)


# ---------------------------------------------------------------------------------------------------
# 5 From SDF to colour: sections along the ray, alpha, compositing
# ---------------------------------------------------------------------------------------------------


class Deviation(nn.Module):
    """The deviation network: zeta = exp(10 v), one learned number; 1/zeta is the width of a surface."""

    def __init__(self, zeta: float = 20.0):
        super().__init__()
        self.v = nn.Parameter(torch.tensor(math.log(zeta) / 10))

    def forward(self) -> Tensor:
        return torch.exp(10 * self.v).clamp(1e-2, 1e5)


def neus_alpha(sdf: Tensor, cos: Tensor, dt: Tensor, zeta: Tensor) -> Tensor:
    """Opacity (R,S) of sections of length dt with SDF sdf and slope cos = <grad s, d> at their middle.

    Eq. 1 mended: 1 - sigmoid(zeta s_next) / sigmoid(zeta s_prev) (NeuS Eq. 13) with the two ends
    s -+ cos dt / 2 inside zeta [D2], divided so that opacities multiply up to one behind a wall [D1].
    A section that leads outwards (cos > 0) is transparent. Logs of sigmoids neither overflow nor need an
    epsilon.
    """
    half = F.relu(-cos) * dt / 2  # (R,S)
    return -torch.expm1(F.logsigmoid(zeta * (sdf - half)) - F.logsigmoid(zeta * (sdf + half)))


def printed_alpha(sdf: Tensor, cos: Tensor, dt: Tensor, zeta: Tensor) -> Tensor:
    """Eq. 1 as printed, kept to be shown and tested against: sums to one, but multiplies to 1 - 1/e."""
    beta = cos * dt / 2  # (R,S)
    after = torch.cat([sdf[:, 1:], sdf[:, -1:]], 1)  # (R,S), s_{i+1}
    return torch.sigmoid(zeta * sdf + beta) - torch.sigmoid(zeta * after + beta)


def composite(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights w_i = T_i alpha_i (R,S) with T_i = prod_{j<i} (1 - alpha_j), and what passes, T (R,). Eq. 2

    The product runs as a sum of logs: its backward needs no look for zeros.
    """
    log_pass = torch.log1p(-alpha.clamp(max=1 - 1e-6)).cumsum(1)  # (R,S)
    trans = torch.exp(log_pass)  # (R,S), after each section
    before = torch.cat([torch.ones_like(trans[:, :1]), trans[:, :-1]], 1)  # (R,S)
    return before * alpha, trans[:, -1]


def inverse_cdf(edges: Tensor, weight: Tensor, u: Tensor) -> Tensor:
    """Positions (R,S) where the piecewise linear CDF of weight (R,N) on edges (R,N+1) reaches u (R,S)."""
    cdf = torch.cumsum(weight, 1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf / cdf[:, -1:]], 1)  # (R,N+1)
    hi = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, weight.shape[1])  # (R,S)
    c0, c1 = cdf.gather(1, hi - 1), cdf.gather(1, hi)  # (R,S)
    e0, e1 = edges.gather(1, hi - 1), edges.gather(1, hi)  # (R,S)
    return e0 + (e1 - e0) * ((u - c0) / (c1 - c0).clamp(min=1e-9)).clamp(0, 1)


PROBES = 64  # cheap lookups of the cached SDF per ray
FLOOR = 0.2  # share of samples spread uniformly, so that a lost surface can return


def cached_weight(cache: Tensor, rays: Rays, edges: Tensor, zeta: float) -> Tensor:
    """NeuS weights (R,N) of sections (R,N+1) from the cached SDF volume (1,1,n,n,n). [D11]"""
    x = rays.o[:, None] + edges[:, :, None] * rays.d[:, None]  # (R,N+1,3)
    s = F.grid_sample(cache, x.flip(-1)[None, None], padding_mode="border",
                      align_corners=True)[0, 0, 0]  # (R,N+1)
    log_phi = F.logsigmoid(zeta * s)
    alpha = -torch.expm1((log_phi[:, 1:] - log_phi[:, :-1]).clamp(max=0))  # (R,N)
    return composite(alpha)[0]


def sample_sections(model: "GeoNVS", rays: Rays, t0: Tensor, t1: Tensor, n: int, jitter: Tensor) -> Tensor:
    """Edges (R,n+1) of n sections between t0 and t1 (R,), dense where the cached SDF sees a surface.

    jitter: (R,n) in 0..1, stratifies the n - 1 inner edges.
    """
    u = (torch.arange(n - 1, device=t0.device) + jitter[:, :-1]) / (n - 1)  # (R,n-1)
    probes = torch.linspace(0, 1, PROBES + 1, device=t0.device)  # (N+1,)
    edges = t0[:, None] + (t1 - t0)[:, None] * probes  # (R,N+1)
    weight = torch.full_like(edges[:, 1:], 1.0)  # (R,N)
    if model.cfg.sampling == "cached":
        zeta = model.deviation().clamp(max=model.cache.shape[-1])  # a surface as wide as a voxel
        weight = cached_weight(model.cache, rays, edges, zeta)
        weight = weight + (FLOOR / (1 - FLOOR) * weight.sum(1, keepdim=True) + 1e-3) / PROBES
    return torch.cat([t0[:, None], inverse_cdf(edges, weight, u), t1[:, None]], 1)  # (R,n+1)


def render_rays(model: "GeoNVS", rays: Rays, code: Tensor, jitter: Tensor) -> dict[str, Tensor]:
    """One ray batch through the whole model. code: (R,A) appearance; jitter: (R,S+B) in 0..1.

    Returns rgb (R,3), opacity (R,), depth (R,), normal (R,3), e_grad (R,), e_curv (R,), plus x, grad, w
    for the losses. e_grad and e_curv are the NeuS-weighted eikonal error and curvature of Eq. 4. [D3]
    """
    cfg, R, S = model.cfg, len(rays.o), model.cfg.samples
    t0, t1, hit = sphere_interval(rays)  # (R,)
    with torch.no_grad():
        edges = sample_sections(model, rays, t0, t1, S, jitter[:, :S])  # (R,S+1)
    dt = torch.diff(edges, dim=1)  # (R,S)
    t = (edges[:, 1:] + edges[:, :-1]) / 2  # (R,S)
    x = (rays.o[:, None] + t[:, :, None] * rays.d[:, None]).reshape(-1, 3)  # (RS,3)
    if cfg.normals == "fd":
        sdf, geo = model.sdf(x)  # (RS,), (RS,GEO)
        grad, lap = finite_differences(lambda y: model.sdf(y)[0], x, model.eps, sdf)  # (RS,3), (RS,)
    else:
        sdf, geo, grad = model.sdf.with_gradient(x)  # (RS,), (RS,GEO), (RS,3) [D13]
    normal = F.normalize(grad, dim=1)  # (RS,3)
    cos = (grad.reshape(R, S, 3) * rays.d[:, None]).sum(2)  # (R,S)
    alpha_fn = neus_alpha if cfg.alpha == "neus" else printed_alpha
    alpha = alpha_fn(sdf.reshape(R, S), cos, dt, model.deviation()) * hit[:, None]  # (R,S)
    w, trans = composite(alpha)  # (R,S), (R,)
    per_ray = torch.cat([sh_basis(rays.d), code], 1)[:, None].expand(R, S, -1).reshape(R * S, -1)
    rgb_s = torch.sigmoid(model.color(torch.cat([geo, normal, per_ray], 1)).float())  # (RS,3)
    rgb = (w[:, :, None] * rgb_s.reshape(R, S, 3)).sum(1)  # (R,3)
    if model.background is not None:
        behind = model.background(rays, t1, code, cfg.bg_samples, jitter[:, S:])  # (R,3)
    else:
        behind = model.bg_color.expand(R, 3)  # (R,3)
    opacity = w.sum(1)  # (R,)
    depth = (w * t).sum(1) + trans * t1  # (R,)
    if cfg.normals == "analytic":  # four taps at the rendered surface, for the curvature alone
        at = rays.o + depth.detach()[:, None] * rays.d  # (R,3)
        _, lap = finite_differences(lambda y: model.sdf(y)[0], at, model.eps)  # (R,)
        e_curv = lap.abs() * model.eps * opacity  # (R,)
    else:
        e_curv = (w * lap.reshape(R, S).abs()).sum(1) * model.eps  # (R,)
    error = (grad.norm(dim=1) - 1) ** 2  # (RS,)
    return dict(rgb=rgb + trans[:, None] * behind, opacity=opacity, depth=depth, hit=hit,
                normal=(w[:, :, None] * normal.reshape(R, S, 3)).sum(1), e_curv=e_curv,
                e_grad=(w * error.reshape(R, S)).sum(1), eikonal=error.reshape(R, S))


# ---------------------------------------------------------------------------------------------------
# 6 Photos in the wild: transient mask and geometry preservation
# ---------------------------------------------------------------------------------------------------


def conv(cin: int, cout: int, size: int = 3, stride: int = 1, dilation: int = 1, groups: int = 1):
    return nn.Sequential(nn.Conv2d(cin, cout, size, stride, dilation * (size // 2), dilation, groups,
                                   bias=False), nn.GroupNorm(8, cout), nn.PReLU(cout))  # [D6]


class ContextBlock(nn.Module):
    """Context-guided block (CGNet Fig. 3): local and dilated surrounding context, gated globally."""

    def __init__(self, cin: int, cout: int, stride: int, dilation: int):
        super().__init__()
        half = cout // 2
        self.reduce = conv(cin, half, 3 if stride == 2 else 1, stride)
        self.local = nn.Conv2d(half, half, 3, padding=1, groups=half, bias=False)
        self.around = nn.Conv2d(half, half, 3, padding=dilation, dilation=dilation, groups=half, bias=False)
        self.join = nn.Sequential(nn.GroupNorm(8, cout), nn.PReLU(cout))
        self.gate = nn.Sequential(nn.Linear(cout, cout // 8), nn.ReLU(), nn.Linear(cout // 8, cout),
                                  nn.Sigmoid())

    def forward(self, x: Tensor) -> Tensor:
        y = self.reduce(x)
        y = self.join(torch.cat([self.local(y), self.around(y)], 1))  # (B,cout,h,w)
        y = y * self.gate(y.mean((2, 3)))[:, :, None, None]
        return y + x if y.shape == x.shape else y


class CGNet(nn.Module):
    """Whole photos (B,3,H,W) in 0..1 to transient logits (B,1,H/2,W/2) (CGNet, as in CR-NeRF). [D6]

    The head reads all three resolutions: at 1/8 alone a mask could not follow a person's outline.
    """

    def __init__(self, width: int = 16):
        super().__init__()
        self.stem = nn.Sequential(conv(3, width, stride=2), conv(width, width))
        self.stage2 = nn.Sequential(ContextBlock(width, 2 * width, 2, 2), ContextBlock(2 * width, 2 * width, 1, 2))
        self.stage3 = nn.Sequential(ContextBlock(2 * width, 4 * width, 2, 4),
                                    ContextBlock(4 * width, 4 * width, 1, 4))
        self.heads = nn.ModuleList(nn.Conv2d(width * k, 1, 1) for k in (1, 2, 4))
        for head in self.heads:
            nn.init.zeros_(head.bias)
        nn.init.constant_(self.heads[0].bias, -2.5)  # starts with 8 % masked, not with half the picture

    def forward(self, photo: Tensor) -> Tensor:
        y1 = self.stem(photo - 0.5)
        y2 = self.stage2(y1)
        y3 = self.stage3(y2)
        size = y1.shape[2:]
        up = [F.interpolate(head(y).float(), size, mode="bilinear", align_corners=False)
              for head, y in zip(self.heads, (y1, y2, y3))]
        return sum(up)  # (B,1,H/2,W/2)


def mask_at(logits: Tensor, uv: Tensor) -> Tensor:
    """M (R,) at uv (R,2) in 0..1 of logits (B,1,h,w); rays come photo by photo, R / B from each."""
    B, R = len(logits), len(uv)
    grid = (2 * uv - 1).reshape(B, R // B, 1, 2)  # (B,R/B,1,2)
    return torch.sigmoid(F.grid_sample(logits, grid, padding_mode="border", align_corners=False)).reshape(R)


def edge_indicator(e_grad: Tensor, e_curv: Tensor, lam_grad: float, lam_lap: float,
                   calibration: Tensor | None) -> Tensor:
    """Phi (R,) from the rays' eikonal error and curvature. Eq. 4

    calibration (2,): centre and width of the sigmoid. None is the literal reading: as both errors are
    positive, Phi then lies between 0.5 and 1 for every ray and marks nothing. Detached [D3]: Phi is to
    hold back the mask, not to be lowered by smoothing the geometry away.
    """
    x = (lam_grad * e_grad + lam_lap * e_curv).detach()  # (R,)
    return torch.sigmoid(x if calibration is None else (x - calibration[0]) / calibration[1])


def calibrate(x: Tensor, calibration: Tensor, rate: float = 0.05) -> None:
    """Moves calibration (2,) towards the batch: centre = 75th percentile, width = (p95 - p50) / 4. [D3]"""
    p50, p75, p95 = torch.quantile(x.detach(), torch.tensor([0.5, 0.75, 0.95], device=x.device))
    calibration.lerp_(torch.stack([p75, ((p95 - p50) / 4).clamp(min=1e-3)]), rate)


def gpl_loss(mask: Tensor, edge: Tensor) -> Tensor:
    """Geometry-preservation loss: mean of M(r) Phi(r). Eq. 3"""
    return (mask * edge).mean()


# ---------------------------------------------------------------------------------------------------
# 7 The model and its objective
# ---------------------------------------------------------------------------------------------------


def observed_pixels(scene: Scene) -> tuple[Tensor, Tensor]:
    """Where SfM found its points: pixel (T,) within photo track_photo, and whether it is in the photo."""
    c2w, K = scene.c2w[scene.track_photo], scene.K[scene.track_photo]  # (T,3,4), (T,4)
    at = scene.points[scene.track_point] - c2w[:, :, 3]  # (T,3)
    cam = (at[:, None] @ c2w[:, :, :3])[:, 0]  # (T,3) in camera axes
    uv = (cam[:, :2] / cam[:, 2:].clamp(min=1e-6) * K[:, :2] + K[:, 2:]).floor()  # (T,2) px
    wh = scene.wh[scene.track_photo]
    ok = (cam[:, 2] > 0) & (uv >= 0).all(1) & (uv < wh).all(1)
    uv = torch.minimum(uv.clamp(min=0), wh - 1).long()
    return uv[:, 1] * wh[:, 0] + uv[:, 0], ok


def exposure_spread(scene: Scene) -> float:
    """Standard deviation over photos of how much brighter each shows the same SfM points, 0..1 sRGB."""
    pixel, ok = observed_pixels(scene)
    ok &= ~scene.is_test[scene.track_photo]
    img, point = scene.track_photo[ok], scene.track_point[ok]
    if not len(img):
        return math.inf  # nothing known: assume the general case

    def mean_by(index, value, n):
        total = value.new_zeros(n).index_add_(0, index, value)
        return total / torch.bincount(index, minlength=n).clamp(min=1)
    grey = scene.rgb[scene.start[img] + pixel[ok]].float().mean(1) / 255  # (T,)
    offset = grey - mean_by(point, grey, len(scene.points))[point]
    return mean_by(img, offset, len(scene.wh))[img.unique()].std().item()


def constant_background(scene: Scene, gen: torch.Generator) -> Tensor | None:
    """The one colour (3,) of all rays that miss the sphere, or None if they differ or there are none."""
    photos = torch.nonzero(~scene.is_test)[:, 0]
    rays, _ = random_rays(scene, photos, 20_000, min(len(photos), 100), gen)
    rgb = rays.rgb[~sphere_interval(rays)[2]]
    return rgb.mean(0) if len(rgb) > 100 and rgb.std(0).max() < 0.01 else None


def mask_loss(mask: Tensor, lam_bimodal: float) -> Tensor:
    """L_reg: mean M keeps the mask small; a pole at M = 1/2, scaled by lam_bimodal, pushes it to 0 or 1.

    Ha-NeRF's mean M^2 belongs to a squared error. With an L1 error e it ends at M = e / (2 lam), a mask on
    every pixel that is not perfect yet; mean M turns lam_mask into a threshold on e. [D7]
    """
    return mask.mean() + lam_bimodal * (1 / ((mask - 0.5) ** 2 + 0.02)).mean()


def random_ball(n: int, gen: torch.Generator) -> Tensor:
    """Uniform points (n,3) in the unit ball."""
    direction = F.normalize(torch.randn(n, 3, generator=gen, device=gen.device), dim=1)
    return direction * torch.rand(n, 1, generator=gen, device=gen.device) ** (1 / 3)


class GeoNVS(nn.Module):
    """The paper's model. Everything it learns and everything it caches."""

    WARM_UP, RADIUS = 200, 0.5  # sphere initialisation: steps, radius

    def __init__(self, cfg: Config, scene: Scene, gen: torch.Generator):
        super().__init__()
        self.cfg, self.scene = cfg, scene
        dev = scene.rgb.device
        inside = scene.points.norm(dim=1) < 1
        self.register_buffer("sfm", scene.points[inside])  # (K,3)
        levels = cfg.levels or levels_for_footprint(scene)
        fg = Octree(1.0, levels, channels=cfg.channels).to(dev)
        seed_octree(fg, self.sfm, 1 if len(self.sfm) else levels, (0.0, 1.0))
        self.sdf = SDFField(fg, cfg.hidden)
        spread = exposure_spread(scene)
        self.use_appearance = cfg.appearance == "on" or (cfg.appearance == "auto" and spread > 0.01)
        A = cfg.appearance_dim if self.use_appearance else 0
        self.appearance = nn.Embedding(len(scene.wh), A)
        nn.init.normal_(self.appearance.weight, std=0.01)
        self.color = LipschitzMLP([GEO + 3 + 9 + A, cfg.hidden, cfg.hidden, 3])
        one_color = constant_background(scene, gen) if cfg.background == "auto" else None
        self.background = None
        if cfg.background == "on" or (cfg.background == "auto" and one_color is None):
            bg = Octree(2.0, cfg.bg_levels, channels=cfg.channels).to(dev)
            seed_octree(bg, contract(scene.points[~inside]), 1, (1.0, 2.0))
            self.background = Background(bg, cfg.hidden, A)
        self.register_buffer("bg_color", one_color if one_color is not None else torch.zeros(3))
        self.use_mask = cfg.mask != "off"
        self.cgnet = CGNet()
        self.register_buffer("logits", torch.full((len(scene.wh), 1, cfg.mask_px // 2, cfg.mask_px // 2), -9.0))
        self.deviation = Deviation()
        self.register_buffer("calibration", torch.tensor([0.0, 1.0]))  # centre and width in Phi
        n = int(np.clip(16 << (levels - 1), 64, 128))
        self.register_buffer("cache", torch.zeros(1, 1, n, n, n))  # SDF for placing samples
        self.eps, self.step = fg.cell(levels - 1) / 2, 0
        self.to(dev)
        print(f"  finest cell {fg.cell(levels - 1):.4f} ({levels} levels), {sum(map(len, fg.cells)):,} cells, "
              f"exposure spread {spread:.3f}: appearance {'on' if A else 'off'}, "
              f"background {'on' if self.background else 'one colour'}, mask {cfg.mask}")

    def groups(self) -> list[dict]:
        """Optimiser groups: features fast, networks and codes slower, zeta on its own."""
        cfg = self.cfg
        grids = [o.features for o in self.octrees()]
        own = {id(p) for p in grids} | {id(self.deviation.v)}
        rest = [p for p in self.parameters() if id(p) not in own]
        return [dict(params=grids, lr=cfg.lr_grid), dict(params=rest, lr=cfg.lr_net),
                dict(params=[self.deviation.v], lr=cfg.lr_zeta)]

    def octrees(self) -> list[Octree]:
        return [self.sdf.octree] + ([self.background.octree] if self.background else [])

    def start(self, gen: torch.Generator) -> None:
        """Warm-up: L_sphere fits the SDF to a sphere, from where every surface can be reached."""
        adam = torch.optim.Adam([dict(params=[self.sdf.octree.features], lr=1e-3),
                                 dict(params=[*self.sdf.lin1.parameters(), *self.sdf.lin2.parameters()], lr=5e-3)])
        for _ in range(self.WARM_UP):
            x = random_ball(2048, gen)  # (P,3)
            loss = ((self.sdf(x)[0] - (x.norm(dim=1) - self.RADIUS)) ** 2).mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
        self.refresh_cache(0, 1)

    @torch.no_grad()
    def refresh_cache(self, part: int, parts: int) -> None:
        """Evaluates the SDF again on every parts-th slice of the cache, from slice `part`."""
        n = self.cache.shape[-1]
        line = torch.linspace(-1, 1, n, device=self.cache.device)  # (n,)
        for i in range(part, n, parts):
            x = torch.cartesian_prod(line[i:i + 1], line, line)  # (n^2,3)
            self.cache[0, 0, i] = self.sdf(x)[0].reshape(n, n)

    def maintain(self, step: int) -> None:
        """What happens between steps: an eighth of the cache is refreshed every eight steps."""
        self.step = step
        if step % 8 == 0:
            self.refresh_cache(step // 8 % 8, 8)

    def mask_of(self, pick: Tensor, uv: Tensor, fresh: bool = True) -> Tensor:
        """M (R,) of rays at uv (R,2) in photos pick (B,), from the network or from its last logits."""
        if fresh:
            logits = self.cgnet(self.scene.thumbs[pick].float() / 255)  # (B,1,h,w)
            self.logits[pick] = logits.detach()
        return mask_at(logits if fresh else self.logits[pick], uv)

    def losses(self, rays: Rays, pick: Tensor, progress: float, gen: torch.Generator):
        """The objective, Eq. 5. Returns its weighted sum, raw terms and health signals by name."""
        cfg, R = self.cfg, len(rays.o)
        jitter = torch.rand(R, cfg.samples + cfg.bg_samples, generator=gen, device=rays.o.device)
        out = render_rays(self, rays, self.appearance(rays.img), jitter)
        error = (out["rgb"] - rays.rgb).abs().mean(1)  # (R,) L1
        masked = self.use_mask and progress > 0.1
        fresh = self.step % cfg.mask_every == 0
        mask = self.mask_of(pick, rays.uv, fresh) if masked else torch.zeros_like(error)  # (R,)
        aux = torch.cat([random_ball(R // 2, gen), self.sfm[torch.randint(
            max(len(self.sfm), 1), (R // 2 * (len(self.sfm) > 0),), generator=gen, device=mask.device)]])
        s = self.sdf(aux)[0]  # (R/2 + R/2,)
        raw = dict(rgb=((1 - mask) * error).mean(),
                   eik=(out["eikonal"].mean(1) * out["hit"]).sum() / out["hit"].sum().clamp(min=1),
                   curv=out["e_curv"].mean(),  # [D4]
                   lps=torch.log(self.color.bounds()).sum(),  # [D5]
                   off=torch.exp(-50 * s[:R // 2].abs()).mean(),
                   sfm=s[R // 2:].abs().sum() / max(R // 2, 1))  # [D10]
        total = (raw["rgb"] + cfg.lam_eik * raw["eik"] + cfg.lam_curv * raw["curv"]
                 + cfg.lam_lps * raw["lps"] + cfg.lam_off * raw["off"] + cfg.lam_sfm * raw["sfm"])
        if masked:
            calibration = self.calibration if cfg.gpl == "calibrated" else None
            calibrate(cfg.lam_grad * out["e_grad"] + cfg.lam_lap * out["e_curv"], self.calibration)
            edge = edge_indicator(out["e_grad"], out["e_curv"], cfg.lam_grad, cfg.lam_lap, calibration)
            raw["mask"] = mask_loss(mask, cfg.lam_bimodal)
            raw["gpl"] = gpl_loss(mask, edge * out["opacity"].detach())
            lam = cfg.lam_mask * (1 + 7 * math.exp(-30 * (progress - 0.1)))  # [D7]
            total = total + lam * raw["mask"] + cfg.lam_gpl * raw["gpl"]
        health = dict(zeta=self.deviation(), mask=mask.mean(), opacity=out["opacity"].mean(),
                      miss=1 - out["hit"].float().mean(), mse=((out["rgb"] - rays.rgb) ** 2).mean())
        return total, {k: v.detach() for k, v in (raw | health).items()}

    def render(self, rays: Rays, code: Tensor) -> dict[str, Tensor]:
        """render_rays without jitter, for pictures and for fitting codes."""
        jitter = torch.full((len(rays.o), self.cfg.samples + self.cfg.bg_samples), 0.5, device=rays.o.device)
        return render_rays(self, rays, code, jitter)


# ---------------------------------------------------------------------------------------------------
# 9 Energy meter
# ---------------------------------------------------------------------------------------------------


class EnergyMeter:
    """Joules spent between start() and stop(), from an energy counter and from power samples.

    counter() returns joules and may wrap at `wrap`; power() returns watts and is integrated by the
    trapezoid rule every `period` seconds. Either may be None; without both, the energy is None and
    never 0. Windows add up, so evaluation can be left out and a resumed run goes on counting.
    """

    def __init__(self, source=None, counter=None, power=None, wrap=math.inf, period=0.5, clock=time.monotonic):
        self.source, self.counter, self.power, self.wrap = source, counter, power, wrap
        self.period, self.clock = period, clock
        self.joules = 0.0 if counter else None
        self.sampled_joules = 0.0 if power else None
        self.idle_w = power() if power else None  # read before any work
        self.lock, self.stopped, self.thread = threading.Lock(), threading.Event(), None

    def tick(self) -> None:
        """Adds what was spent since the last tick."""
        with self.lock:
            now = (self.clock(), self.counter() if self.counter else 0.0, self.power() if self.power else 0.0)
            if self.last is not None and self.counter:
                self.joules += (now[1] - self.last[1]) % self.wrap
            if self.last is not None and self.power:
                self.sampled_joules += (now[2] + self.last[2]) / 2 * (now[0] - self.last[0])
            self.last = now

    def start(self) -> None:
        self.last = None
        self.tick()
        self.stopped.clear()
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self) -> None:
        while not self.stopped.wait(self.period):
            self.tick()

    def stop(self) -> None:
        if self.thread is not None:
            self.stopped.set()
            self.thread.join()
            self.thread = None
            self.tick()

    def report(self) -> dict:
        """Watt-hours by counter and by samples (None where there is no such reading) and their source."""
        counter = None if self.joules is None else self.joules / 3600
        sampled = None if self.sampled_joules is None else self.sampled_joules / 3600
        off = abs(counter / sampled - 1) if counter and sampled else None
        return dict(energy_wh=counter if counter is not None else sampled, energy_wh_sampled=sampled,
                    energy_source=self.source, idle_w=self.idle_w, energy_disagree=None if off is None else off > 0.05)


def rapl_meter(root: str = "/sys/class/powercap") -> EnergyMeter:
    """Processor packages through RAPL where readable (often root only), else a meter that reads None."""
    packages = [p for p in sorted(Path(root).glob("intel-rapl:*")) if p.name.count(":") == 1
                and os.access(p / "energy_uj", os.R_OK)]
    if not packages:
        return EnergyMeter()
    wraps = [int((p / "max_energy_range_uj").read_text()) for p in packages]
    total, last = [0] * len(packages), [int((p / "energy_uj").read_text()) for p in packages]

    def counter():
        for i, p in enumerate(packages):  # each package wraps on its own
            now = int((p / "energy_uj").read_text())
            total[i], last[i] = total[i] + (now - last[i]) % wraps[i], now
        return sum(total) / 1e6
    return EnergyMeter("rapl", counter)


def make_meter(device: torch.device) -> EnergyMeter:
    """The meter for a device: NVML (the GPU that torch uses, found by UUID), RAPL, or none."""
    if device.type != "cuda":
        return rapl_meter()
    try:
        import pynvml
    except ImportError:
        print("  no GPU energy: pip install nvidia-ml-py")
        return EnergyMeter()
    pynvml.nvmlInit()
    uuid = f"GPU-{torch.cuda.get_device_properties(device).uuid}"  # whatever CUDA_VISIBLE_DEVICES says
    gpu = pynvml.nvmlDeviceGetHandleByUUID(uuid.encode())
    return EnergyMeter("nvml", lambda: pynvml.nvmlDeviceGetTotalEnergyConsumption(gpu) / 1e3,
                       lambda: pynvml.nvmlDeviceGetPowerUsage(gpu) / 1e3)


# ---------------------------------------------------------------------------------------------------
# 10 Training
# ---------------------------------------------------------------------------------------------------

METHODS = {"geonvsw": GeoNVS}
CHECKPOINT_S = 60.0  # seconds of training between checkpoints


def make_optimizer(model) -> torch.optim.Adam:
    optimizer = torch.optim.Adam(model.groups(), betas=(0.9, 0.99), eps=1e-15, fused=True)
    for group in optimizer.param_groups:
        group["base_lr"] = group["lr"]
    return optimizer


def set_learning_rate(optimizer, step: int, progress: float) -> None:
    """Linear warm-up over 100 steps, then a cosine down to 5 %."""
    factor = min(1, (step + 1) / 100) * (0.05 + 0.95 * (1 + math.cos(math.pi * progress)) / 2)
    for group in optimizer.param_groups:
        group["lr"] = group["base_lr"] * factor


def save_checkpoint(path: Path, cfg: Config, model, optimizer, gen: torch.Generator, state: dict) -> None:
    atomic_write(path, lambda tmp: torch.save(dict(
        geonvs=1, config=asdict(cfg), model=model.state_dict(), optimizer=optimizer.state_dict(),
        octrees=[o.split_keys for o in model.octrees()], rng=gen.get_state(), state=state), tmp))


def read_checkpoint(path: Path, device="cpu") -> dict:
    """A checkpoint's dictionary: tensors and plain values, never code. Raises UserError."""
    if not path.exists():
        raise UserError(f"{path} does not exist: nothing to resume, start without --resume")
    try:
        saved = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # a damaged file can fail in any layer: zip, pickle, tensor storage
        raise UserError(f"{path} is damaged or not a checkpoint ({type(error).__name__}): "
                        "delete it and train again") from None
    if not isinstance(saved, dict) or saved.get("geonvs") != 1:
        raise UserError(f"{path} is not a checkpoint of this program: delete it and train again")
    return saved


def restore(saved: dict, path: Path, model, optimizer, gen: torch.Generator) -> dict:
    """Puts a checkpoint's dictionary back into model, optimiser and generator; returns its state."""
    try:
        for octree, keys in zip(model.octrees(), saved["octrees"], strict=True):
            octree.build(keys)
        model.load_state_dict(saved["model"])
        if optimizer is not None:
            for group, new in zip(optimizer.param_groups, model.groups(), strict=True):
                group["params"] = new["params"]
            optimizer.load_state_dict(saved["optimizer"])
            gen.set_state(saved["rng"].cpu())
        return saved["state"]
    except (KeyError, ValueError, RuntimeError, TypeError, AttributeError) as error:
        raise UserError(f"{path} does not fit this scene and these settings "
                        f"({str(error).splitlines()[0][:90]}): delete it or use the flags it was made with") from None


def train(cfg: Config, scene: Scene, run: Path, saved: dict | None = None):
    """Trains until cfg.steps or cfg.minutes; writes log.jsonl and checkpoint.pt below run.

    saved: a checkpoint to go on from. Returns (model, state); state has step, seconds, joules, curve.
    Evaluation moments are outside the timed and metered window.
    """
    device = scene.rgb.device
    torch.set_flush_denormal(True)  # vanishing weights would otherwise slow a CPU down
    torch.manual_seed(cfg.seed)
    gen = torch.Generator(device).manual_seed(cfg.seed)
    model = METHODS[cfg.method](cfg, scene, gen)
    optimizer = make_optimizer(model)
    meter = make_meter(device)
    state = dict(step=0, seconds=0.0, joules=None, sampled_joules=None, dropped=0, curve=[])
    checkpoint, log_path = run / "checkpoint.pt", run / "log.jsonl"
    if saved is None:
        log_path.unlink(missing_ok=True)
    else:
        state = restore(saved, checkpoint, model, optimizer, gen)
        meter.joules, meter.sampled_joules = state["joules"], state["sampled_joules"]
        kept = [l for l in log_path.read_text().splitlines() if json.loads(l)["step"] <= state["step"]]
        atomic_write(log_path, lambda tmp: Path(tmp).write_text("".join(l + "\n" for l in kept)))
    photos = torch.nonzero(~scene.is_test)[:, 0]  # (B,)
    dropped = torch.tensor(state["dropped"], device=device)
    last_save = last_line = since = time.perf_counter()
    next_check = 2.0 ** math.ceil(math.log2(max(state["seconds"], 4)))
    meter.start()
    if saved is None:
        model.start(gen)

    def clock():  # training seconds so far
        return state["seconds"] + time.perf_counter() - since

    def save():
        state.update(joules=meter.joules, sampled_joules=meter.sampled_joules, dropped=int(dropped))
        save_checkpoint(checkpoint, cfg, model, optimizer, gen, state | dict(seconds=clock()))
    try:
        while state["step"] < cfg.steps and not (cfg.minutes and clock() >= 60 * cfg.minutes):
            step, before = state["step"], time.perf_counter()
            progress = max(step / cfg.steps, clock() / (60 * cfg.minutes) if cfg.minutes else 0)
            rays, pick = random_rays(scene, photos, cfg.rays, cfg.photos, gen)
            with torch.autocast(device.type, torch.bfloat16, enabled=cfg.amp and device.type == "cuda"):
                loss, logs = model.losses(rays, pick, progress, gen)
            optimizer.zero_grad()
            loss.backward()
            set_learning_rate(optimizer, step, progress)
            norm = nn.utils.get_total_norm([p.grad for g in optimizer.param_groups for p in g["params"]
                                            if p.grad is not None])
            optimizer.found_inf = (~torch.isfinite(norm + loss.detach())).float()  # drops the step
            dropped += optimizer.found_inf.long()
            optimizer.step()
            model.maintain(step)
            state["step"] = step + 1
            now = time.perf_counter()
            if now - last_line > 5 or step + 1 == cfg.steps:
                last_line = now
                report_line(cfg, log_path, state["step"], clock(), progress, logs, int(dropped))
            if now - last_save > CHECKPOINT_S:
                save()
                last_save = time.perf_counter()
        meter.stop()
        save()
        state["seconds"] = clock()
    except KeyboardInterrupt:
        meter.stop()
        save()
        raise UserError(f"stopped at step {state['step']}; the same command with --resume goes on") from None
    return model, state, meter


def report_line(cfg, log_path, step, seconds, progress, logs, dropped) -> None:
    """One line on the terminal and one in log.jsonl."""
    values = {k: float(v) for k, v in logs.items()}
    values["psnr"] = -10 * math.log10(max(values.pop("mse"), 1e-10))
    rate, left = step * cfg.rays / seconds, seconds / max(progress, 1e-3) * (1 - progress)
    print(f"  step {step:6d}  psnr {values['psnr']:5.2f}  zeta {values.get('zeta', math.nan):6.1f}  "
          f"mask {values['mask']:.3f}  {rate:8.0f} rays/s  {left / 60:5.1f} min left", flush=True)
    with open(log_path, "a") as file:
        file.write(json.dumps(dict(step=step, seconds=seconds, dropped=dropped) | values) + "\n")


# ---------------------------------------------------------------------------------------------------
# 11 Scoring, mesh, pictures
# ---------------------------------------------------------------------------------------------------


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of two uint8 pictures."""
    mse = ((a.astype(np.float64) - b) ** 2).mean()
    return -10 * math.log10(max(mse / 255 ** 2, 1e-10))


def ssim(a: np.ndarray, b: np.ndarray) -> float | None:
    """SSIM of two uint8 pictures: Gaussian window of 11 px, sigma 1.5, no border; None below 11 px."""
    if min(a.shape[:2]) < 11:
        return None
    return float(structural_similarity(a, b, channel_axis=2, data_range=255, gaussian_weights=True,
                                       sigma=1.5, use_sample_covariance=False))


class LPIPS(nn.Module):
    """Learned perceptual distance on AlexNet features, v0.1 weights (Zhang et al. 2018)."""

    TRUNK = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
    HEADS = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/alex.pth"
    SHAPES = ((3, 64, 11, 4, 2), (64, 192, 5, 1, 2), (192, 384, 3, 1, 1), (384, 256, 3, 1, 1), (256, 256, 3, 1, 1))

    def __init__(self):
        super().__init__()
        self.convs = nn.ModuleList(nn.Conv2d(a, b, k, s, p) for a, b, k, s, p in self.SHAPES)
        self.heads = nn.ParameterList(torch.zeros(1, b, 1, 1) for _, b, *_ in self.SHAPES)

    def load(self, trunk: dict, heads: dict) -> "LPIPS":
        for i, (layer, index) in enumerate(zip(self.convs, (0, 3, 6, 8, 10))):
            layer.load_state_dict({k: trunk[f"features.{index}.{k}"] for k in ("weight", "bias")})
            self.heads[i].data.copy_(heads[f"lin{i}.model.1.weight"])
        return self.requires_grad_(False)

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Distance (B,) of pictures (B,3,H,W) in 0..1."""
        x = torch.cat([a, b]) * 2 - 1
        x = (x - x.new_tensor([-0.030, -0.088, -0.188])[:, None, None]) / x.new_tensor(
            [0.458, 0.448, 0.450])[:, None, None]
        total = 0
        for i, (layer, head) in enumerate(zip(self.convs, self.heads)):
            x = F.relu(layer(F.max_pool2d(x, 3, 2) if i in (1, 2) else x))
            fa, fb = (x / (x.pow(2).sum(1, keepdim=True).sqrt() + 1e-10)).chunk(2)
            total = total + ((fa - fb) ** 2 * head).sum(1).mean((1, 2))
        return total


def make_lpips(device) -> LPIPS | None:
    """LPIPS with its published weights, or None with one line of reason where they can't be had."""
    try:
        weights = [torch.hub.load_state_dict_from_url(url, map_location="cpu", weights_only=True, progress=False)
                   for url in (LPIPS.TRUNK, LPIPS.HEADS)]
    except OSError as error:  # urllib's errors are OSErrors
        print(f"  lpips is null: its weights could not be downloaded ({error})")
        return None
    return LPIPS().load(*weights).to(device)


def half_pixels(scene: Scene, photo: int, left: bool) -> Tensor:
    """Pixel numbers of the columns left of w // 2, or from there on. [D12]"""
    w, h = scene.wh[photo].tolist()
    pixel = torch.arange(w * h, device=scene.rgb.device)
    return pixel[(pixel % w < w // 2) == left]


def fit_codes(model, scene: Scene, photos: Tensor, codes: Tensor | None, steps: int, protocol: str,
              rays_per_photo: int = 64) -> Tensor:
    """Appearance codes (B,A) of unseen photos (B,): Adam on random rays of the left halves. [D12]

    Starts from codes, or from the mean code of the training photos. The scene itself stays untouched.
    """
    gen = torch.Generator(scene.rgb.device).manual_seed(0)
    if codes is None:
        codes = model.appearance.weight[~scene.is_test].mean(0).expand(len(photos), -1)  # (B,A)
    codes = codes.detach().clone().requires_grad_()
    if codes.numel() == 0:
        return codes
    allowed = [torch.cat([half_pixels(scene, i, True)] + ([half_pixels(scene, i, False)]
                         if protocol == "leaky" else [])) for i in photos.tolist()]
    img = photos.repeat_interleave(rays_per_photo)  # (R,)
    adam = torch.optim.Adam([codes], lr=0.1)
    was = [p.requires_grad for p in model.parameters()]
    model.requires_grad_(False)
    for step in range(steps):
        adam.param_groups[0]["lr"] = 0.1 * 0.1 ** (step / steps)
        pixel = torch.cat([a[torch.randint(len(a), (rays_per_photo,), generator=gen, device=a.device)]
                           for a in allowed])  # (R,)
        rays = make_rays(scene, img, pixel)
        loss = (model.render(rays, codes.repeat_interleave(rays_per_photo, 0))["rgb"] - rays.rgb).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    for parameter, flag in zip(model.parameters(), was):
        parameter.requires_grad_(flag)
    return codes.detach()


CHUNK = 4096  # rays rendered at once


@torch.no_grad()
def render_photo(model, scene: Scene, photo: int, code: Tensor) -> dict[str, np.ndarray]:
    """Photo's viewpoint rendered under an appearance code (A,): arrays (H,W,...) by name of render_rays.

    Adds `mask` (H,W): what the mask network thinks of the real photo, and `truth` (H,W,3).
    """
    w, h = scene.wh[photo].tolist()
    img = torch.tensor([photo], device=scene.rgb.device)
    parts = []
    for pixel in torch.arange(w * h, device=img.device).split(CHUNK):
        rays = make_rays(scene, img.expand(len(pixel)), pixel)
        out = model.render(rays, code.expand(len(pixel), -1))
        out["mask"] = model.mask_of(img, rays.uv)
        out["truth"] = rays.rgb
        parts.append({k: v for k, v in out.items() if len(v) == len(pixel)})
    joined = {k: torch.cat([p[k] for p in parts]).float().cpu().numpy() for k in parts[0]}
    return {k: v.reshape(h, w, *v.shape[1:]) for k, v in joined.items()}


def to_uint8(picture: np.ndarray) -> np.ndarray:
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def floor_picture(truth: np.ndarray) -> np.ndarray:
    """The trivial predictor: each row's mean colour of the left half, as (H,1,3) uint8."""
    return to_uint8(truth[:, :truth.shape[1] // 2].mean(1, keepdims=True))


def evaluate(model, scene: Scene, cfg: Config, lpips: LPIPS | None) -> dict:
    """Scores test photos by the half-image protocol [D12]: PSNR, SSIM, LPIPS, floor, per photo and mean."""
    photos = torch.nonzero(scene.is_test)[:, 0]  # (B,)
    if not len(photos):
        return dict(psnr=None, psnr_floor=None, ssim=None, lpips=None, per_image=[], frames=[])
    codes = fit_codes(model, scene, photos, None, 128, cfg.protocol)  # (B,A)
    rows, frames = [], []
    for photo, code in zip(photos.tolist(), codes):
        frame = render_photo(model, scene, photo, code)
        half = frame["rgb"].shape[1] // 2
        got, want = to_uint8(frame["rgb"])[:, half:], to_uint8(frame["truth"])[:, half:]
        flat = np.broadcast_to(floor_picture(frame["truth"]), want.shape)
        row = dict(name=str(scene.raw["name"][photo]), psnr=psnr(got, want), psnr_floor=psnr(flat, want),
                   ssim=ssim(got, want), lpips=None)
        if lpips is not None and min(got.shape[:2]) >= 32:
            pair = [torch.as_tensor(p, device=scene.rgb.device).permute(2, 0, 1)[None] / 255 for p in (got, want)]
            row["lpips"] = lpips(*pair).item()
        rows.append(row)
        frames.append((row["name"], frame))

    def mean(key):
        values = [r[key] for r in rows if r[key] is not None]
        return float(np.mean(values)) if values else None
    return dict({k: mean(k) for k in ("psnr", "psnr_floor", "ssim", "lpips")}, per_image=rows, frames=frames)


@torch.no_grad()
def toy_truth(model, scene: Scene) -> dict:
    """What only a synthetic scene can tell: SDF error, mask IoU, mean mask on static pixels.

    sdf_error: mean |s - s_true| at points within 0.05 of visible surfaces, scene units. mask_iou: of M > 0.5
    with the true occluders over all training photos; None where there is no model part to score.
    """
    raw, found = scene.raw, {}
    rng = np.random.default_rng(0)
    pixel = torch.as_tensor(rng.choice(np.flatnonzero(np.isfinite(raw["depth"])), 20_000))
    img = torch.searchsorted(torch.as_tensor(raw["start"]), pixel, right=True) - 1
    rays = make_rays(scene, img.to(scene.rgb.device), (pixel - torch.as_tensor(raw["start"])[img]).to(scene.rgb.device))
    depth = torch.as_tensor(raw["depth"][pixel].astype(np.float32), device=rays.o.device)
    x = rays.o + depth[:, None] * rays.d  # (P,3) on the true surface
    x = x + torch.as_tensor(rng.normal(0, 0.02, x.shape), device=x.device, dtype=x.dtype)
    world = x.double().cpu().numpy() * raw["scale"] + raw["center"]
    true = torch.as_tensor(data_prep.toy_sdf(world, ground=scene.info["background"]) / raw["scale"])  # (P,)
    near = ((true.abs() < 0.05).to(x.device)) & (x.norm(dim=1) < 1)
    found["sdf_error"] = None
    if hasattr(model, "sdf"):
        s = torch.cat([model.sdf(part)[0] for part in x[near].split(CHUNK)]).cpu()
        found["sdf_error"] = (s - true[near.cpu()]).abs().mean().item()
    found["mask_iou"] = found["mask_static"] = None
    both = either = static = pixels = 0
    if getattr(model, "use_mask", False):
        for i in torch.nonzero(~scene.is_test)[:, 0]:
            occluder = torch.as_tensor(raw["occluder"][raw["start"][i]:raw["start"][i + 1]], device=x.device)
            rays = make_rays(scene, i.expand(len(occluder)), torch.arange(len(occluder), device=x.device))
            mask = model.mask_of(i[None], rays.uv)  # (N,)
            both += ((mask > 0.5) & occluder).sum().item()
            either += ((mask > 0.5) | occluder).sum().item()
            static += mask[~occluder].sum().item()
            pixels += (~occluder).sum().item()
        found.update(mask_iou=both / either if either else None, mask_static=static / pixels)
    return found


@torch.no_grad()
def extract_mesh(model: GeoNVS, resolution: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface s = 0 inside the unit sphere: vertices (N,3) in SfM units, faces (M,3), colours (N,3) uint8.

    Marching cubes over a grid of `resolution` cells (default: two per finest octree cell, at most 512);
    the cached SDF says which cells can hold the surface, and only their corners are evaluated.
    """
    scene, octree = model.scene, model.sdf.octree
    n = resolution or min(2 * octree.resolution(octree.levels - 1), 512)
    dev, line = model.cache.device, torch.linspace(-1, 1, n + 1)
    near = F.interpolate(model.cache, size=(n + 1,) * 3, mode="trilinear", align_corners=True)[0, 0].abs()
    near = (near < 3 * 2 / model.cache.shape[-1]) & (torch.cartesian_prod(line, line, line).norm(dim=1)
                                                      .reshape(near.shape) < 1).to(dev)  # (n+1,n+1,n+1)
    volume = np.ones(near.shape, np.float32)
    index = torch.nonzero(near)  # (P,3)
    if len(index):
        s = torch.cat([model.sdf(part * (2 / n) - 1.0)[0] for part in index.split(2 ** 16)])
        volume[near.cpu().numpy()] = s.cpu().numpy()
    inside = near[1:, 1:, 1:]  # a cube counts if all its corners were evaluated
    for corner in CORNERS[:-1].tolist():
        inside = inside & near[tuple(slice(c, n + c) for c in corner)]
    cubes = np.pad(inside.cpu().numpy(), ((0, 1),) * 3)
    if not cubes.any() or not (volume[near.cpu().numpy()] < 0).any():
        return np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8)
    vertices, faces, _, _ = marching_cubes(volume, 0, mask=cubes, gradient_direction="ascent")
    x = torch.as_tensor(vertices * (2 / n) - 1, dtype=torch.float32, device=dev)  # (N,3)
    code = model.appearance.weight[~scene.is_test].mean(0)  # (A,)
    colors = []
    for part in x.split(2 ** 16):
        _, geo, grad = model.sdf.with_gradient(part)
        normal = F.normalize(grad, dim=1)
        inputs = torch.cat([geo, normal, sh_basis(-normal), code.expand(len(part), -1)], 1)
        colors.append(torch.sigmoid(model.color(inputs)))
    return x.cpu().numpy() * scene.raw["scale"] + scene.raw["center"], faces, to_uint8(torch.cat(colors).cpu().numpy())


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> None:
    """Binary PLY with a colour per vertex."""
    v = np.empty(len(vertices), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    f = np.empty(len(faces), [("n", "u1"), ("index", "<i4", 3)])
    v["xyz"], v["rgb"], f["n"], f["index"] = vertices, colors, 3, faces
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(v)}\nproperty float x\nproperty float y\n"
              "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
              f"element face {len(f)}\nproperty list uchar int vertex_indices\nend_header\n")
    atomic_write(path, lambda tmp: Path(tmp).write_bytes(header.encode() + v.tobytes() + f.tobytes()))


def write_png(path: Path, picture: np.ndarray) -> None:
    """RGB uint8 picture to a file."""
    def write(tmp):
        if not cv2.imwrite(str(tmp), picture[:, :, ::-1]):
            raise OSError("OpenCV could not write the picture")
    atomic_write(path, write)


def colormap(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """(H,W) to RGB by viridis between low and high."""
    grey = to_uint8((value - low) / max(high - low, 1e-9))
    return cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[:, :, ::-1]


def panel(model, frames: list[tuple[str, dict]], height: int = 180) -> np.ndarray:
    """The paper's Fig. 2: a row per photo; photo, render, mask, geometry map, depth, normals."""
    cfg, rows, width = model.cfg, [], max(round(f["rgb"].shape[1] * height / f["rgb"].shape[0]) for _, f in frames)
    titles = ["photo", "render", "mask M", "geometry map", "depth", "normals"]
    for name, f in frames:
        tiles = [to_uint8(f["truth"]), to_uint8(f["rgb"]), colormap(f["mask"], 0, 1)]
        if "normal" in f:
            signal = cfg.lam_grad * f["e_grad"] + cfg.lam_lap * f["e_curv"]
            centre, spread = model.calibration.tolist()
            tiles.append(colormap(f["opacity"] / (1 + np.exp(-(signal - centre) / spread)), 0, 1))
        tiles.append(colormap(1 / f["depth"], *np.quantile(1 / f["depth"], (0.02, 0.98))))
        if "normal" in f:
            tiles.append(to_uint8(f["normal"] / 2 + 0.5))
        row = []
        for tile in tiles:
            w = round(tile.shape[1] * height / tile.shape[0])
            tile = cv2.resize(tile, (w, height), interpolation=cv2.INTER_AREA if w < tile.shape[1] else cv2.INTER_CUBIC)
            row.append(np.pad(tile, ((2, 2), (2, 2 + width - w), (0, 0)), constant_values=255))
        rows.append(np.concatenate(row, 1))
        cv2.putText(rows[-1], name, (6, height - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (255, 255, 255), 1, cv2.LINE_AA)
    head = np.full((20, rows[0].shape[1], 3), 255, np.uint8)
    titles = titles if len(tiles) == 6 else titles[:3] + ["depth"]
    for i, title in enumerate(titles):
        cv2.putText(head, title, (6 + i * (width + 4), 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([head, *rows])


def finish(model, scene: Scene, cfg: Config, state: dict, meter: EnergyMeter, run: Path) -> dict:
    """Scores a trained model and writes metrics.json, panel.png and mesh.ply below run."""
    scores = evaluate(model, scene, cfg, make_lpips(scene.rgb.device))
    frames = [(f"held out: {name}", frame) for name, frame in scores.pop("frames")[:3]]
    train_photos = torch.nonzero(~scene.is_test)[:, 0]
    busy = train_photos
    if getattr(model, "use_mask", False):  # training photos with most on the mask
        busy = train_photos[model.logits[train_photos].sigmoid().mean((1, 2, 3)).argsort(descending=True)]
    for i in busy[:2].tolist():
        frames.append((f"training: {scene.raw['name'][i]}", render_photo(model, scene, i, model.appearance.weight[i])))
    write_png(run / "panel.png", panel(model, frames))
    if hasattr(model, "sdf"):
        write_ply(run / "mesh.ply", *extract_mesh(model))
    octrees = model.octrees()
    commit = subprocess.run(["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"],
                            capture_output=True, text=True).stdout.strip() or None
    metrics = dict(
        scene=scene.info["scene"], method=cfg.method, seed=cfg.seed, steps=state["step"],
        device=torch.cuda.get_device_name() if scene.rgb.is_cuda else f"cpu, {torch.get_num_threads()} threads",
        **scores, train_seconds=state["seconds"], **meter.report(),
        rays_per_second=state["step"] * cfg.rays / max(state["seconds"], 1e-9),
        parameters=sum(p.numel() for p in model.parameters()),
        octree_cells=[len(c) for o in octrees[:1] for c in o.cells] or None,
        model_bytes=sum(t.numel() * t.element_size() for t in model.parameters()) + sum(o.bytes() for o in octrees),
        peak_memory_bytes=torch.cuda.max_memory_allocated() if scene.rgb.is_cuda else peak_rss(),
        protocol=f"appearance fitted on the {'left half' if cfg.protocol == 'half' else 'WHOLE photo (leaky)'}, "
                 "scored on the right half",
        torch=torch.__version__, python=platform.python_version(), commit=commit, config=asdict(cfg))
    if scene.info["kind"] == "toy":
        metrics.update(toy_truth(model, scene))
    atomic_write(run / "metrics.json", lambda tmp: Path(tmp).write_text(json.dumps(metrics, indent=1)))
    return metrics


def peak_rss() -> int:
    """Largest resident memory of this process, bytes."""
    import resource  # absent on Windows
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


# ---------------------------------------------------------------------------------------------------
# 12 Command line
# ---------------------------------------------------------------------------------------------------


class Parser(argparse.ArgumentParser):
    """Bad flags end with one sentence that names the nearest right one."""

    def error(self, message):
        for word in message.split():
            if word.startswith("--"):
                near = difflib.get_close_matches(word.split("=")[0], self._option_string_actions, 1)
                message += f"; did you mean {near[0]}?" if near and "unrecognized" in message else ""
        raise UserError(f"{message} (python geonvs.py --help lists all flags)")


def make_parser() -> argparse.ArgumentParser:
    parser = Parser(description=__doc__.split("\n\n")[0], allow_abbrev=False, argument_default=argparse.SUPPRESS,
                    formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    for f in fields(Config):
        kind = {"int": int, "float": float, "str": str}.get(f.type)
        more = dict(type=kind, choices=f.metadata["choices"]) if kind else dict(action=argparse.BooleanOptionalAction)
        parser.add_argument(f"--{f.name}", help=f"{f.metadata['help']} [{f.default}]", **more)
    parser.add_argument("--resume", action="store_true", help="go on from the run's checkpoint")
    parser.add_argument("--render", choices=("orbit", "appearance"), help="write a short film of a finished run")
    return parser


def pick_device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UserError(f"--device {name} is unknown: use auto, cpu, cuda or cuda:N") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UserError("--device cuda: torch finds no GPU here; use --device cpu, or install torch with CUDA")
    return device


def find_scene(cfg: Config) -> Path:
    """The scene file of a configuration, made on first use. Raises UserError."""
    if cfg.data:
        name = Path(cfg.data).resolve().name
    elif cfg.scene in ("toy", *data_prep.SCENES):
        name = cfg.scene
    else:
        near = difflib.get_close_matches(cfg.scene, SCENES, 1)
        raise UserError(f"--scene {cfg.scene} is unknown: use one of {', '.join(SCENES)}"
                        + (f"; did you mean {near[0]}?" if near else ""))
    path = Path("data") / (f"{name}.npz" if name == "toy" else f"{name}_x{cfg.downscale}.npz")
    if not path.exists():
        print(f"making {path}")
        arrays = data_prep.prepare(cfg.data, cfg.downscale) if cfg.data else data_prep.make_toy() \
            if name == "toy" else data_prep.locate_and_prepare(name, "data", cfg.downscale)
        path.parent.mkdir(exist_ok=True)
        data_prep.write_scene(path, arrays)
    return path


def check(cfg: Config) -> None:
    """Refuses settings that cannot work, before anything is written."""
    for f in fields(cfg):
        value = getattr(cfg, f.name)
        if isinstance(value, (int, float)) and (not math.isfinite(value) or value < 0):
            raise UserError(f"--{f.name} {value} makes no sense: use a number >= 0")
    for name in ("rays", "photos", "samples", "bg_samples", "steps", "downscale", "channels", "hidden", "mask_every"):
        if getattr(cfg, name) < 1 + (name in ("samples", "bg_samples")):
            raise UserError(f"--{name} {getattr(cfg, name)} is too small")
    if cfg.rays % cfg.photos:
        raise UserError(f"--rays {cfg.rays} must be a multiple of --photos {cfg.photos}")


def main(argv: list[str] | None = None) -> int:
    given = vars(make_parser().parse_args(argv))
    resume, film = given.pop("resume", False), given.pop("render", None)
    cfg = Config(**(SCENES.get(given.get("scene", "toy"), {}) if "data" not in given else {}) | given)
    check(cfg)
    device = pick_device(cfg.device)
    scene_name = Path(cfg.data).resolve().name if cfg.data else cfg.scene
    run = Path("runs") / (cfg.name or f"{scene_name}-{cfg.method}-{cfg.seed}")
    saved = None
    if resume or film:
        saved = read_checkpoint(run / "checkpoint.pt", device)
        cfg = Config(**saved["config"] | given)
    scene = load_scene(find_scene(cfg), device, cfg.mask_px)
    run.mkdir(parents=True, exist_ok=True)
    print(f"{cfg.method} on {scene.info['scene']}: {len(scene.wh)} photos ({int(scene.is_test.sum())} held out), "
          f"{len(scene.rgb):,} pixels, {device}; writes {run}/")
    model, state, meter = train(cfg, scene, run, saved)
    metrics = finish(model, scene, cfg, state, meter, run)
    shown = {k: round(metrics[k], 4) for k in ("psnr", "psnr_floor", "ssim", "lpips", "sdf_error", "mask_iou",
                                               "mask_static", "train_seconds", "energy_wh") if metrics.get(k) is not None}
    print("  " + "  ".join(f"{k} {v}" for k, v in shown.items()))
    return 0


def run_command_line(entry) -> None:
    """Exit code 0, or 2 with one sentence on stderr."""
    try:
        sys.exit(entry())
    except UserError as error:
        sys.exit(print(f"error: {error}", file=sys.stderr) or 2)


if __name__ == "__main__":
    run_command_line(main)
