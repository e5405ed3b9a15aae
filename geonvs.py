# SPDX-License-Identifier: MIT
"""Geo-NVS-w: a signed distance field, trained on tourist photos, rendered from new viewpoints.

A minimal single-file reference implementation of "Geo-NVS-w: Geometry-Aware Novel View Synthesis
In-the-Wild with an SDF Renderer" (Tsalakopoulos et al., ICCV 2025 workshops). Sections 2 to 7
follow one ray from its pixel to the loss; the training loop comes after them.

    python geonvs.py                       toy scene: made, trained, scored (minutes, 2 CPU cores)
    python geonvs.py --scene brandenburg   a Phototourism scene (one GPU); also sacre, trevi, taj
    python geonvs.py --data DIR            your own COLMAP folder
    torchrun --nproc_per_node 4 geonvs.py  on 4 GPUs, each with rays of its own
    python geonvs.py --help                every setting with its meaning and default

The paper's equations. `--paper` trains with the forms in the last column and a zeta without the
bound of [D8]; all other departures stay.
  Eq. 1  opacity of an interval     neus_alpha                                 paper_alpha
  Eq. 2  compositing weights        composite
  Eq. 3  geometry preservation      gpl_loss
  Eq. 4  edge indicator Phi         edge_indicator, complexity, SDFCache       paper_phi
  Eq. 5  objective                  objective, called by GeoNVS.losses
         L_rgb, L_eik, L_curv       GeoNVS.losses; eikonal, finite_differences
         L_reg                      mask_loss                                  paper_mask_loss
         L_lps                      lipschitz_loss
         off-surface penalty        off_surface_loss, at points of air_segments

Conventions
  world     the foreground is the unit sphere; x * scale + center leads back to SfM units
  cameras   c2w (3,4) camera to world, OpenCV axes: x right, y down, z forward; pixel centres +0.5
  rays      r(t) = o + t d with |d| = 1, so t is a distance along the ray and not a z-depth
  sdf       positive outside; the normal is the unit gradient; colours are sRGB in [0, 1]
  mask      M = 1 means transient (person, car), M = 0 means static scene
  symbols   s signed distance; zeta sharpness of the surface (1 / zeta is its width); eps step of
            finite differences; lap Laplacian; E_grad = (|grad s| - 1)^2; E_curv = |lap s| h,
            h is eps in L_curv, a voxel's side in Phi [D2]
  shapes    R rays, S intervals of a ray (S + 1 samples), J intervals or points on a ray, P points,
            K background samples of a ray, N octree cells, L octree levels, C channels per level,
            V feature rows, G inputs of the colour network from geometry, A appearance dims,
            I photos in all, B of them in a batch, Q SfM points, T sightings, m side of a mask,
            n: see the line, "." any length

Departures from the printed paper. The tag stands at the code; .github/RESULTS.md has figures.
  tag   in the paper                   here                              because
  [D1]  alpha: a difference of         NeuS's Eq. 13, with s at both     printed, 37 % of the light
        sigmoids with a slope beta     ends of an interval               passes through a surface
  [D2]  E_curv = |lap s|; Phi on       |lap s| h, h being the step of    |lap s| grows as h shrinks;
        every ray                      the difference; L_eik, L_curv,    rays through air have no
                                       Phi are weighted by opacity       edges
  [D3]  L_reg: penalties of            M is trained to classify rays     castle: 2.8 dB; Reichstag,
        intensity and bimodality of    by error; M is fixed at 60 %      crowd: level
        M, which L_rgb trains, too     of training
  [D4]  CGNet                          a block a stage, GroupNorm, a     photos are small, a few in
                                       head at each resolution           a batch
  [D5]  a sphere loss in a warm-up     SfM points place the sphere and   else remnants of the ball
                                       seed the octree; s and M are 0    float before facades
                                       there; lines of sight are air
  [D6]  derivatives at every sample;   at one surface point per ray, at  each is five lookups;
        no normal as an input          SfM points and in air; colours    colours that see normals:
                                       see the normal; samples and Phi   statue: 0.75 dB
                                       read a cached SDF, so L_GPL
                                       moves M alone
  [D7]  octrees are pruned             cells split where colour errors   cells that are never made
                                       are large; codes or background    need no pruning
                                       are off where not needed
  [D8]  zeta is learned                above a bound that rises          else surfaces stay soft
                                                                         where photos are few:
                                                                         SSIM 0.635, not 0.670
"""
import argparse
import contextlib
import functools
import io
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field, fields, replace
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
from data_prep import (
    UserError, as_user_error, atomic_write, check, on_signals, progress, run_command_line,
    write_ply, write_png)

# distances need float32: TF32 would drown finite differences in rounding errors
torch.set_float32_matmul_precision("highest")


# ---- 1 Settings and processes --------------------------------------------------------------------

def setting(default, meaning, **limits):
    """A field of Config, which is a flag: its meaning for --help, and its least value (else 0), the
    choices there are, or what the flag means alone, without a value."""
    return field(default=default, metadata=dict(meaning=meaning, **limits))


SCENES = ("toy", *data_prep.SCENES)
DEVICES = ("auto", "cpu", "cuda")
SWITCH = ("auto", "on", "off")
PRINTED = ("alpha", "phi", "reg", "zeta")  # equations that --paper can choose
GROUPS = dict(  # titles in --help, by the first setting of each group
    scene="what", steps="how long", rays="model", lam_eik="loss weights", lr_grid="learning rates")


@dataclass
class Config:
    """All settings. Of the defaults, lam_gpl alone is the paper's."""
    scene: str = setting("toy", "toy, brandenburg, sacre, trevi or taj", choices=SCENES)
    data: str = setting("", "an IMC-PT or COLMAP folder instead of --scene")
    name: str = setting("", "folder below runs/ (default: scene-method-seed)")
    seed: int = setting(0, "seed of training; a toy has its own")
    device: str = setting("auto", "cpu, cuda, or auto (a GPU if there is one)", choices=DEVICES)
    downscale: int = setting(2, "factor by which photos are made smaller", least=1)
    steps: int = setting(3000, "training steps", least=1)
    minutes: float = setting(0.0, "minutes of training; above 0, steps do not count")
    rays: int = setting(512, "rays per step, of each process", least=2)
    photos: int = setting(8, "photos per step, of each process", least=1)
    samples: int = setting(15, "intervals of a ray in the foreground", least=3)
    bg_samples: int = setting(24, "background samples of a ray", least=2)
    levels: int = setting(0, "octree levels, 0: as fine as a pixel", choices=range(9))
    hidden: int = setting(64, "width of the networks", least=1)
    appearance_dim: int = setting(16, "length of a photo's appearance code")
    appearance: str = setting("auto", "codes: on, off, auto (if exposures differ)", choices=SWITCH)
    mask: str = setting("on", "transient mask: on, off", choices=("on", "off"))
    background: str = setting("auto", "a field: on, off, auto (unless one colour)", choices=SWITCH)
    paper: str = setting("", f"as printed: {','.join(PRINTED)}; bare: all", alone=",".join(PRINTED))
    lam_eik: float = setting(0.004, "L_eik, eikonal (Permuto-SDF: 0.04)")
    lam_curv: float = setting(0.01, "L_curv, curvature: |lap s| eps [D2]")
    lam_mask: float = setting(1.0, "L_reg, which trains the mask [D3]")
    lam_gpl: float = setting(0.05, "L_GPL, geometry preservation")
    lam_lps: float = setting(3e-6, "L_lps, Lipschitz bound (as Permuto-SDF)")
    lam_sfm: float = setting(0.3, "L_sfm, |s| at SfM points [D5]")
    lam_off: float = setting(1.2, "L_off, off-surface [D5]")
    lr_grid: float = setting(1e-2, "octree features")
    lr_code: float = setting(3e-2, "appearance codes")
    lr_net: float = setting(4e-3, "networks")
    lr_mask: float = setting(8e-3, "mask network")

    def __post_init__(self):
        """Refuses what cannot work, before anything is written."""
        for option in fields(self):
            value = getattr(self, option.name)
            least = option.metadata.get("least", 0)
            choices = option.metadata.get("choices", [value])  # no choices: the value passes
            words = ", ".join(map(str, choices))
            check(value in choices, f"--{option.name} {value} is unknown: use one of {words}")
            check(option.type is str or least <= value < 2**31,
                  f"--{option.name} {value} is out of range: use {least} to 2^31 - 1")
        check(set(self.paper.split(",")) <= {"", *PRINTED},
              f"--paper {self.paper} is unknown: use some of {','.join(PRINTED)}")
        check(Path(self.name).name == self.name,
              f"--name {self.name} is a path: use a name, as runs are folders below runs/")
        if self.data:
            self.data = os.path.realpath(self.data)  # to be found from any folder

    @property
    def source(self):
        """What data_prep.open_scene takes: a folder, or a scene's name."""
        return self.data or self.scene

    def printed(self, name):
        """Whether an equation, one of PRINTED, has the form that is printed in the paper."""
        return name in self.paper.split(",")


# Photos on a GPU, where flags do not say otherwise. Fewer rays would not make its steps faster.
GPU_DEFAULTS = dict(steps=75_000, rays=16_384, photos=16, samples=32, appearance_dim=32)


@dataclass
class Processes:
    """The processes that torchrun started, or this one alone. Each draws its own rays. Gradients
    are averaged, so all hold the same weights. Rank 0 decides, prints and saves. One process on a
    CPU resumes bit for bit. A GPU adds floats in any order, and of several processes only the first
    keeps its random numbers."""
    count: int = 1
    rank: int = 0
    local_rank: int = 0  # on this machine: the number of the process's GPU

    def join(self, device):
        """Connects this process with the others. All but the first stop printing."""
        check("MASTER_ADDR" in os.environ, "start processes by torchrun, or unset WORLD_SIZE")
        if device.type == "cuda":
            torch.cuda.set_device(device)
        has_nccl = device.type == "cuda" and dist.is_nccl_available()  # not on Windows
        dist.init_process_group("cpu:gloo,cuda:nccl" if has_nccl else "gloo")
        if self.rank > 0:
            sys.stdout = open(os.devnull, "w", errors="replace")

    def share(self, value):
        """The first process's value, for all of them."""
        box = [value]
        if self.count > 1:
            dist.broadcast_object_list(box)
        return box[0]

    def sum(self, tensor):
        """Adds up a tensor over processes, in place."""
        if self.count > 1:
            dist.all_reduce(tensor)

    def average_gradients(self, model):
        """Averages gradients over processes, in one transfer."""
        if self.count > 1:
            grads = [p.grad for p in model.parameters() if p.grad is not None]
            flat = nn.utils.parameters_to_vector(grads)
            self.sum(flat)
            nn.utils.vector_to_parameters(flat / self.count, grads)


ALONE = Processes()

# when things happen, in shares of training
REFINE_AT = (0.1, 0.2, 0.3, 0.45, 0.6)  # the octree is refined; later there is no time to fit it
ZETA_RISE = 0.4  # surfaces may be soft until then: the least zeta rises
MASK_TRAINING = 0.6  # M is fixed from then on, which is faster and costs nothing


# ---- 2 Scene file and rays -----------------------------------------------------------------------

class Scene(NamedTuple):
    """The arrays of a scene file (data_prep.py documents them) as tensors on the device."""
    rgb: Tensor  # (.,3) uint8, all pixels of all photos
    start: Tensor  # (I+1,) first pixel of each photo, and the end
    wh: Tensor  # (I,2) width, height in px
    K: Tensor  # (I,4) fx fy cx cy in px
    c2w: Tensor  # (I,3,4)
    near: Tensor  # (I,) smallest useful t
    points: Tensor  # (Q,3) SfM points
    masked: Tensor  # (.,) whether a user's mask file excludes the pixel; (0,) without such files
    thumbs: Tensor  # (I,3,2m,2m) uint8, whole photos for the mask network
    sfm_pixels: Tensor  # (I,m,m) mask pixels in which the photo saw an SfM point [D5]
    train: Tensor  # (.,) indices of the training photos
    test: Tensor  # (.,) indices of the held-out photos
    raw: dict  # the file in numpy: names, statistics, center, scale, ground truth of the toy
    info: dict  # what the file was made from


def load_scene(raw, device="cpu"):
    """Scene from the dictionary of a scene file (data_prep.open_scene, make_toy or prepare)."""
    mask_side = int(np.clip(np.median(raw["wh"].max(1)) / 4, 32, 128))  # px
    side = 2 * mask_side  # px, half of a usual photo's long side; photos become squares [D4]
    thumbs = [
        cv2.resize(pixels.reshape(h, w, 3), (side, side), interpolation=cv2.INTER_AREA)
        for pixels, (w, h) in zip(np.split(raw["rgb"], raw["start"][1:-1]), raw["wh"])]
    uv = raw["track_uv"]  # (T,2)
    is_seen = ((uv >= 0) & (uv < 1)).all(1)  # (T,) the point lies in the picture
    col, row = (uv[is_seen] * mask_side).astype(int).T
    sfm_pixels = np.zeros((len(thumbs), mask_side, mask_side), bool)
    sfm_pixels[raw["track_photo"][is_seen], row, col] = True
    arrays = {key: raw[key] for key in ("rgb", "start", "wh", "K", "c2w", "near", "points")}
    arrays |= dict(
        masked=raw.get("masked", np.zeros(0, bool)),
        thumbs=np.moveaxis(thumbs, 3, 1),
        sfm_pixels=sfm_pixels,
        train=np.flatnonzero(~raw["is_test"]),
        test=np.flatnonzero(raw["is_test"]))
    tensors = {key: torch.as_tensor(array, device=device) for key, array in arrays.items()}
    tensors = {key: x.float() if x.is_floating_point() else x for key, x in tensors.items()}
    return Scene(**tensors, raw=raw, info=json.loads(str(raw["info"])))


class Rays(NamedTuple):
    """A batch of rays; every field is indexed by the ray."""
    o: Tensor  # (R,3) origin
    d: Tensor  # (R,3) unit direction
    near: Tensor  # (R,1)
    photo: Tensor  # (R,) its index
    uv: Tensor  # (R,2) pixel position over photo size, 0..1
    rgb: Tensor  # (R,3) the photo's colour
    has_sfm: Tensor  # (R,) whether the mask's pixel shows an SfM point [D5]
    is_masked: Tensor  # (R,) whether a user's mask file excludes the pixel

    def at(self, t):
        """Points (R,S,3) at distances t (R,S): o + t d in one operation."""
        return torch.addcmul(self.o[:, None], t[..., None], self.d[:, None])


def make_rays(scene, photo, pixel):
    """Rays through pixels. photo, pixel: (R,) index of a photo, and row-major index in it."""
    wh = scene.wh[photo]  # (R,2)
    focal, centre = scene.K[photo].split(2, 1)  # (R,2)
    c2w = scene.c2w[photo]  # (R,3,4)
    w = wh[:, 0]
    xy = torch.stack([pixel % w, pixel // w], 1) + 0.5  # (R,2) px
    d = (xy - centre) / focal  # (R,2)
    d = F.normalize(F.pad(d, (0, 1), value=1.0))  # (R,3) in camera axes
    d = torch.einsum("rij,rj->ri", c2w[..., :3], d)  # (R,3) in world axes
    index = scene.start[photo] + pixel  # (R,) among all pixels
    rgb = scene.rgb[index] / 255
    uv = xy / wh  # (R,2)
    col, row = (uv * scene.sfm_pixels.shape[1]).long().unbind(1)  # (R,) of the mask's pixel
    has_sfm = scene.sfm_pixels[photo, row, col]
    is_masked = scene.masked[index] if len(scene.masked) else torch.zeros_like(has_sfm)
    return Rays(c2w[..., 3], d, scene.near[photo, None], photo, uv, rgb, has_sfm, is_masked)


def uniform(gen, *shape):
    """Random numbers in [0, 1) on the generator's device."""
    return torch.rand(shape, generator=gen, device=gen.device)


def random_index(gen, n, count):
    """Random integers (count,) among 0 .. n - 1."""
    return torch.randint(n, (count,), generator=gen, device=gen.device)


def random_rays(scene, photo, gen, part=1.0):
    """Rays through random pixels of photos (R,), one each, of the left `part` of the photo."""
    w, h = scene.wh[photo].unbind(1)
    u, v = uniform(gen, 2, len(photo))
    col = (u * (part * w).long()).long()
    return make_rays(scene, photo, (v * h).long() * w + col)


def sphere_interval(o, d, near):
    """Distances t0, t1 (R,1) at which rays o, d (R,3) enter and leave the unit sphere, from near
    (R,1) on. If a ray misses the sphere or has it behind, both are its closest approach or near."""
    closest = -(o * d).sum(1, keepdim=True)  # (R,1)
    distance = torch.addcmul(o, closest, d).norm(dim=1, keepdim=True)  # from the sphere's centre
    half = (1 - distance**2).clamp_min(0).sqrt()
    t0 = torch.maximum(closest - half, near)
    return t0, torch.maximum(closest + half, t0)


AIR_GAP = 0.05  # length before an SfM point that does not count as air, in radii of the sphere


def air_segments(scene):
    """Ends (T,2,3) of segments that are air. Where a training photo saw an SfM point, nothing
    stands between its camera and the point. A segment is the part of that line of sight in the unit
    sphere; it ends AIR_GAP before the point, or where the line leaves the sphere."""
    tracks = np.stack([scene.raw["track_photo"], scene.raw["track_point"]], 1)  # (.,2)
    tracks = torch.as_tensor(tracks, device=scene.train.device).long()
    photo, point = tracks[torch.isin(tracks[:, 0], scene.train)].unbind(1)  # (T,)
    o = scene.c2w[photo, :, 3]  # (T,3)
    to_point = scene.points[point] - o
    distance = to_point.norm(dim=1, keepdim=True)  # (T,1)
    d = to_point / distance
    t0, t1 = sphere_interval(o, d, scene.near[photo, None])
    t1 = torch.minimum(t1, distance - AIR_GAP)
    ends = torch.stack([o + t0 * d, o + t1 * d], 1)  # (T,2,3)
    return ends[t0[:, 0] < t1[:, 0]]


# ---- 3 Octree: features on the corners of cells --------------------------------------------------

ROOT = 16  # cells of the coarsest level along an axis
MAX_CELLS = 8_000_000  # of the foreground: 1.2 GB with Adam's moments, more while refining
SPLIT_SHARE = 0.5  # a refinement splits the worst cells, which hold this share of the error


def trilinear_weights(f):
    """Weights (P,8) of a cell's corners at f (P,3), 0..1 within the cell."""
    f = f.t()  # (3,P)
    ends = torch.stack([1 - f, f], 1)  # (3,2,P)
    return torch.einsum("ip,jp,kp->pijk", *ends).flatten(1).contiguous()


class WeightedSum(torch.autograd.Function):
    """Row p of the result: the sum over 8 corners k of w[p,k] table[row[p,k]]. Only the table gets
    a gradient, as derivatives in x are finite differences; embedding_bag's own backward takes
    several times as long."""
    @staticmethod
    def forward(ctx, table, row, w):  # (V,C), (P,8), (P,8) -> (P,C)
        ctx.save_for_backward(table, row, w)
        return F.embedding_bag(row, table, per_sample_weights=w, mode="sum")

    @staticmethod
    def backward(ctx, grad):  # (P,C)
        table, row, w = ctx.saved_tensors
        grad = w[..., None] * grad[:, None]  # (P,8,C)
        out = torch.zeros_like(table)  # (V,C)
        out.index_add_(0, row.flatten().long(), grad.flatten(0, 1))
        return out, None, None


def grid_index(n, device):
    """Indices (n^3,3) of all cells of a grid with n cells along an axis, the last axis fastest."""
    line = torch.arange(n, device=device)
    return torch.cartesian_prod(line, line, line)


def pack_index(index, base=2**13):
    """One integer (...) whose digits in a base are an index (...,d), the highest first. With base n
    it is the row of a cell (i, j, k) in grid_index(n). With the default base it is the key of a
    cell or corner (level, i, j, k) of an octree: 2^13 is more than the 2,049 corners along an axis
    of the finest level, so an index of -1 has no cell's key."""
    key = index[..., 0]
    for digit in index[..., 1:].unbind(-1):
        key = torch.add(digit, key, alpha=base)  # base key + digit, in one operation
    return key


class Octree(nn.Module):
    """Feature grid over the cube [-half, half]^3 that is fine only where it has been split. Level
    0 is a dense grid of root^3 cells. A feature lives on a corner and is shared by the cells that
    meet there. In the plane, three split cells of one level look like this in the next level:

        o---o---o---o---o
        |   |   |   |   |     *  has a feature: all cells around it exist
        o---*---*---*---o     o  hanging: a cell around it is missing, so its weight is 0
        |   |   |   |   |
        o---*---o---o---o
        |   |   |
        o---*---o
        |   |   |
        o---o---o

    So the features of a level fade to 0 at the border of what it refines, and of the cube; they are
    continuous. Where a level has no cell, its features are 0."""
    def __init__(self, half, levels, channels=4, root=ROOT):
        super().__init__()
        self.half = half
        self.levels = levels
        self.width = levels * channels  # LC
        self.root = root
        self.resolution = nn.Buffer(root * 2.0 ** torch.arange(levels), persistent=False)  # (L,)
        self.features = torch.zeros(0, channels)  # (V,C), none yet; build makes it a parameter
        self.corner_key = nn.Buffer(torch.arange(0), persistent=False)
        self.build(torch.arange(0))  # no cell is split

    @property
    def side(self):
        """(L,) side of a cell, scene units. resolution: (L,) cells along an axis."""
        return 2 * self.half / self.resolution

    def split(self, cells, reach=0):
        """Splits cells (N,4), and those of their neighbours that differ along at most `reach` axes:
        1 means the six that share a face, 3 all 26. Cells of the last level are not split. The
        field keeps its values, because new features are zero. Returns what build does."""
        offsets = grid_index(3, cells.device) - 1  # (27,3)
        offsets = offsets[offsets.abs().sum(1) <= reach]
        cells = (cells[:, None] + F.pad(offsets, (1, 0))).flatten(0, 1)
        key = pack_index(cells[cells[:, 0] < self.levels - 1])
        key = key[torch.isin(key, pack_index(self.cells))]  # a neighbour may not exist
        return self.build(torch.cat([self.split_keys, key]).unique())

    def build(self, split_keys):
        """Makes cells and corners, given the keys of all cells that are split. Corners that were
        there before keep their features, new ones have zeros. Returns which rows (V,) of features
        are old; they keep their order."""
        octants = grid_index(2, split_keys.device)  # (8,3)
        index = grid_index(self.root, split_keys.device)  # (.,3) cells of a level
        cells = []
        for level in range(self.levels):
            cells.append(F.pad(index, (1, 0), value=level))  # (.,4) level, i, j, k
            parents = index[torch.isin(pack_index(cells[level]), split_keys)]
            index = (2 * parents[:, None] + octants).flatten(0, 1)  # by parent, then octant
        cells = torch.cat(cells)
        is_split = torch.isin(pack_index(cells), split_keys)  # (N,)
        # a cell that is not split stands for its children: only rows of children exceed its own
        child = torch.arange(len(cells), device=cells.device)[:, None].repeat(1, 8)  # (N,8)
        child[is_split] = torch.arange(self.root**3, len(cells), device=cells.device).view(-1, 8)
        # a corner is its cell's index plus an octant; the key of a sum is the sum of the keys
        corners = pack_index(cells)[:, None] + pack_index(octants)  # (N,8)
        key, corner, cells_around = corners.unique(return_inverse=True, return_counts=True)  # (.,)
        has_feature = cells_around == 8
        # rows are counted over corners with a feature; a hanging one has any row, with weight 0
        row = (has_feature.cumsum(0) - 1).clamp_min(0)
        key = key[has_feature]  # (V,)
        is_old = torch.isin(key, self.corner_key)

        # the state has features and cell_error, save() adds split_keys; the rest follows from these
        self.split_keys = nn.Buffer(split_keys, persistent=False)
        self.corner_key = nn.Buffer(key, persistent=False)  # (V,) sorted, the corner of each row
        self.features = nn.Parameter(carry_over_rows(self.features, is_old))
        self.cells = nn.Buffer(cells, persistent=False)  # (N,4) level, i, j, k
        self.child = nn.Buffer(child.int(), persistent=False)  # (N,8) rows of children, or its own
        self.corner = nn.Buffer(row[corner].int(), persistent=False)  # (N,8) rows of features
        self.is_hanging = nn.Buffer(~has_feature[corner], persistent=False)  # (N,8)
        # (N,3) sums over rays that hit a cell: of errors, of pixel sizes there, their number
        self.cell_error = nn.Buffer(self.features.new_zeros(len(cells), 3))
        self.finest = self.side[cells[-1, 0]].item()  # side of the smallest cell
        return is_old

    def locate(self, x):
        """Where points x (P,3) lie in each level: the row in cells (P,L) of the finest cell around
        x down to that level; whether the level has a cell there (P,L); the position in it, 0..1
        (P,L,3). An x outside the cube is moved to its border."""
        x = 0.5 + x * (0.5 / self.half)  # (P,3) over the cube
        x = x.clamp(0, 1 - 1e-6).nan_to_num()  # an index needs a number; check_finite tells later
        x = x[:, None] * self.resolution[:, None]  # (P,L,3) in cells
        index = x.long()  # (P,L,3)
        # the last bit of i, j, k says in which half of its parent a cell lies
        octants = pack_index(index & 1, base=2)  # (P,L)
        node = pack_index(index[:, 0], base=self.root)  # (P,) of level 0
        nodes = [node]
        for octant in octants[:, 1:].unbind(1):  # (P,) of the levels after it
            node = self.child[node, octant]
            nodes.append(node)
        node = torch.stack(nodes, 1)  # (P,L)
        exists = F.pad(node.diff() > 0, (1, 0), value=True)  # (P,L) level 0 always does
        return node, exists, x.frac()

    def forward(self, x):
        """Features (...,LC) at x (...,3)."""
        node, exists, local = self.locate(x.flatten(0, -2))  # of P points
        node = node.flatten()  # (PL,)
        is_hanging = self.is_hanging.index_select(0, node)  # (PL,8)
        w = trilinear_weights(local.flatten(0, 1))  # (PL,8)
        w = w.masked_fill(is_hanging | ~exists.reshape(-1, 1), 0)
        corner = self.corner.index_select(0, node)  # (PL,8)
        feat = WeightedSum.apply(self.features, corner, w)  # (PL,C)
        return feat.reshape(*x.shape[:-1], self.width)


def carry_over_rows(table, is_old):
    """A table (V,C) with the rows of table (.,C) where is_old (V,), zeros elsewhere."""
    out = table.new_zeros(len(is_old), table.shape[1])
    out[is_old] = table
    return out


@torch.no_grad()
def in_chunks(function, x):
    """function(x) of points (P,3), a part at a time, without gradient."""
    return torch.cat([function(part) for part in x.split(2**15)])


def seed_octree(octree, points, dense):
    """Splits the first `dense` levels. Then twice splits the finest cell at each of points (P,3)
    and its 26 neighbours, so that none of its corners hangs. Features are then random. [D5]"""
    for _ in range(dense):
        octree.split(octree.cells)
    for _ in range(2):
        node, _, _ = octree.locate(points)
        octree.split(octree.cells[node[:, -1].unique()], reach=3)
    nn.init.normal_(octree.features, std=0.01)


def cells_to_split(octree):
    """Cells (N,4) to split: those with the largest summed errors, until they hold SPLIT_SHARE of
    the errors of all cells that can be split. A cell can be split if its level is not the last, and
    its children are larger than the mean pixel that sees it. Errors are recorded in cells without
    children, since the last refinement, as build sets them to 0. [D7]"""
    level = octree.cells[:, 0]  # (N,)
    error_sum, pixel_sum, count = octree.cell_error.T  # (N,) over rays
    is_coarse = pixel_sum < count * octree.side[level] / 2  # the mean pixel is below a child's side
    can_split = is_coarse & (level < octree.levels - 1)
    error, order = (error_sum * can_split).sort(descending=True)
    error_before = error.cumsum(0) - error  # (N,) in worse cells
    is_chosen = error_before < SPLIT_SHARE * error.sum()
    room = max(MAX_CELLS - len(level), 0) // (7 * 8)  # six neighbours are split with each
    if is_chosen.sum() > room:
        print(f"  {len(level)} octree cells near the limit of {MAX_CELLS}: fewer are split")
    return octree.cells[order[is_chosen][:room]]


# ---- 4 Fields: the networks on top of the octree -------------------------------------------------

GEOMETRY_FEATURES = 15  # that the SDF network hands to the colour network
START_RADIUS = 0.25  # of the initial sphere, from which the surface grows to the landmark [D5]


@functools.cache
def has_bfloat16(device_type):
    """Whether a kind of device computes in bfloat16 itself: GPUs from Ampere on."""
    return device_type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)


def mixed_precision(network, x):
    """network(x), computed in bfloat16 where that pays, returned as float32. Not for distances:
    finite differences need float32."""
    if not has_bfloat16(x.device.type):
        return network(x)
    with torch.autocast(x.device.type, torch.bfloat16):
        return network(x).float()


def mlp(inputs, hidden, outputs):
    """A network with one hidden layer."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def colors_of(network, geo, per_ray):
    """Colours (R,S,3) that a network reads from geometry (R,S,G) and what is the same for all
    samples of a ray (R,.)."""
    per_ray = per_ray[:, None].expand(-1, geo.shape[1], -1)  # (R,S,.)
    inputs = torch.cat([geo, per_ray], 2)
    return mixed_precision(network, inputs).sigmoid()


# a tetrahedron's centre and corners, which are 3^0.5 away; taps are scaled to length 1
TETRAHEDRON = ((0, 0, 0), (1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))


def finite_differences(s, taps, eps):
    """Gradient (P,3) and Laplacian (P,) of a field from its values s (P,5) at x + eps taps: x
    itself, then the corners of a tetrahedron (Neuralangelo's code; its paper has six)."""
    grad = 3 / (4 * eps) * (s @ taps)  # (P,3) as the sum of k k^T over corners k is 4/3 I
    # The mean m over the four corners is s + eps^2 lap / 6. The mean over all five values is
    # (s + 4 m) / 5, so m - s is 5/4 of that mean less s.
    lap = 6 / eps**2 * 5 / 4 * (s.mean(1) - s[:, 0])
    return grad, lap


def eikonal(grad):
    """E_grad = (|grad s| - 1)^2 (P,) of gradients (P,3): a distance has slope 1."""
    return (grad.norm(dim=1) - 1) ** 2


def off_surface_loss(sdf, margin):
    """L_off, the paper's off-surface penalty: s (P,) is at least margin at points that are known to
    be air. The paper names it without a formula. [D5]"""
    return F.relu(margin - sdf).mean()


class SDFField(nn.Module):
    """s(x), the SDF of a small sphere plus an offset by a network of xyz and the octree's features;
    and G = GEOMETRY_FEATURES + L C inputs of the colour network. In float32 on every device."""
    def __init__(self, octree, hidden):
        super().__init__()
        self.octree = octree
        self.network = mlp(3 + octree.width, hidden, 1 + GEOMETRY_FEATURES)
        nn.init.normal_(self.network[-1].weight[0], std=0.01)  # the offset starts near 0
        nn.init.zeros_(self.network[-1].bias)
        self.taps = nn.Buffer(torch.tensor(TETRAHEDRON) / 3**0.5, persistent=False)  # (5,3)

    def forward(self, x):
        """sdf (...) and geometry (...,G) at x (...,3)."""
        feat = self.octree(x)  # (...,LC)
        out = self.network(torch.cat([x, feat], -1))  # (...,1+GEOMETRY_FEATURES)
        offset, geo = out.split([1, GEOMETRY_FEATURES], -1)
        sdf = x.norm(dim=-1) - START_RADIUS + offset.squeeze(-1)  # (...) [D5]
        return sdf, torch.cat([geo, feat], -1)

    def derivatives(self, x, eps):
        """s (P,), grad s (P,3), lap s (P,) at x (P,3), from s there and at four taps, eps away."""
        sdf, _ = self(x[:, None] + eps * self.taps)  # (P,5) from (P,5,3)
        return sdf[:, 0], *finite_differences(sdf, self.taps, eps)


class LipschitzLinear(nn.Linear):
    """A layer whose rows are scaled to an L1 norm of at most softplus(c), with c learned: its
    Lipschitz bound in the max norm (Liu et al. 2022)."""
    def __init__(self, inputs, outputs):
        super().__init__(inputs, outputs)
        bound = self.weight.abs().sum(1).max()
        self.c = nn.Parameter(bound.expm1().log())  # softplus(c) is the bound: no row is scaled

    def bound(self):
        return F.softplus(self.c)

    def forward(self, x):
        scale = (self.bound() / self.weight.abs().sum(1, keepdim=True)).clamp_max(1)  # (out,1)
        return F.linear(x, self.weight * scale, self.bias)


def lipschitz_loss(network):
    """L_lps: the network's Lipschitz bound, the product of its layers' (Liu et al. 2022)."""
    return math.prod(layer.bound() for layer in network if isinstance(layer, LipschitzLinear))


# ---- 5 From SDF to colour: alpha, compositing, samples, background -------------------------------

PROBES = 64  # even intervals of a ray at whose ends the cache is looked up, to place samples


def neus_alpha(sdf, zeta):
    """Opacity (R,S) of the intervals between samples with SDF (R,S+1). Eq. 1 corrected: alpha_i =
    max(0, 1 - sigmoid(zeta s_{i+1}) / sigmoid(zeta s_i)), which is NeuS Eq. 13. As s is taken at
    both ends of an interval, no slope beta is needed. [D1]"""
    log_sigmoid = F.logsigmoid(zeta * sdf)  # (R,S+1), which does not overflow
    fall = log_sigmoid.diff().clamp_max(0)  # (R,S) 0 where the ray leads outwards
    return -fall.expm1()


def paper_alpha(sdf, zeta):
    """Eq. 1 as printed: sigmoid(zeta s_i + beta_i) - sigmoid(zeta s_{i+1} + beta_i), here not
    negative. Without NeuS's division the opacities of a crossing sum to about 1. With many samples
    the product of 1 - alpha tends to exp(-1), so 37 % of the light passes."""
    beta = sdf.diff() / 2  # (R,S) half of the slope times the length of the interval
    before = torch.sigmoid(zeta * sdf[:, :-1] + beta)
    after = torch.sigmoid(zeta * sdf[:, 1:] + beta)
    return (before - after).clamp_min(0)


def composite(alpha):
    """Eq. 2: weights w_i = T_i alpha_i (R,S) with T_i = prod_{j<i} (1 - alpha_j). The product is
    the exponential of a sum of logs. For these to be finite, 1 - (1 - 1e-6) alpha stands for
    1 - alpha: an opaque interval passes 1e-6, and weights can sum to 1 + 1e-6."""
    log_pass = torch.log1p(-(1 - 1e-6) * alpha)  # (R,S) log(1 - alpha), finite
    trans = torch.exp(log_pass.cumsum(1) - log_pass)  # (R,S) T_i
    return trans * alpha


def inverse_cdf(edges, weight, u):
    """Positions (R,S) where the linear CDF of weight (R,J) on edges (R,J+1) reaches u (R,S)."""
    cdf = weight.cumsum(1)
    cdf = F.pad(cdf / cdf[:, -1:], (1, 0))  # (R,J+1)
    right = torch.searchsorted(cdf, u, right=True).clamp_max(weight.shape[1])  # (R,S) from 1
    left = right - 1
    below = cdf.gather(1, left)
    above = cdf.gather(1, right)
    part = (u - below) / (above - below).clamp_min(1e-9)
    return edges.gather(1, left).lerp(edges.gather(1, right), part.clamp(0, 1))


def stratified(rays, n, gen=None):
    """Numbers (R,n) for R rays: one in each of n equal strata of 0..1, at a random place, or in the
    middle without a generator."""
    offset = torch.full_like(rays.near, 0.5) if gen is None else uniform(gen, len(rays.near), n)
    return (torch.arange(n, device=offset.device) + offset) / n


def importance_samples(probes, alpha, u):
    """Distances (R,S+1): the first and the last of the probes (R,J+1), and between them those of
    the stratified numbers u (R,S-1). They are dense where the intervals between probes, of opacity
    alpha (R,J), have weight."""
    weight = composite(alpha)
    inner = inverse_cdf(probes, weight + 1e-5, u)  # an empty ray has uniform samples
    return torch.cat([probes[:, :1], inner, probes[:, -1:]], 1)


class SDFCache(nn.Module):
    """s, E_grad and E_curv on a dense grid, renewed every CACHE_EVERY steps. It says where samples
    lie along a ray [D6] and how complex the geometry along it is (Eq. 4)."""
    def __init__(self, n):
        super().__init__()
        self.n = n
        self.side = 2 / (n - 1)  # of a voxel
        self.volume = nn.Buffer(torch.zeros(1, 3, n, n, n))  # x slowest
        voxels = grid_index(n, self.volume.device) * self.side - 1  # (n^3,3)
        # a little more than the sphere: lookups read one voxel further, second differences two
        inside = (voxels.norm(dim=1) < 1 + 3 * self.side).nonzero()[:, 0]
        self.inside = nn.Buffer(inside, persistent=False)
        self.points = nn.Buffer(voxels[inside], persistent=False)  # (P,3)

    def refresh(self, signed_distance):
        """Evaluates signed_distance, (P,3) to (P,), again at all voxels in the sphere, then E_grad
        and E_curv = |lap s| h by central differences, h being the side of a voxel. At an edge the
        slope changes by about 1 within a step h, so |lap s| is about 1 / h, whereas |lap s| h does
        not depend on the grid. [D2]"""
        h = self.side
        s = self.volume[0, 0]  # (n,n,n) a view of the volume
        s.view(-1)[self.inside] = in_chunks(signed_distance, self.points)
        slopes = torch.gradient(s, spacing=h)  # along x, y, z
        lap = sum(torch.gradient(slope, spacing=h, dim=i)[0] for i, slope in enumerate(slopes))
        grad = torch.stack(slopes, -1).flatten(0, 2)  # (n^3,3)
        self.volume[0, 1] = eikonal(grad).view_as(s)
        self.volume[0, 2] = lap.abs() * h

    def lookup(self, x, channels):
        """Values (.,R,J) of some channels at x (R,J,3), trilinear."""
        grid = x.flip(-1)[None, None]  # (1,1,R,J,3), z first as grid_sample wants it
        volume = self.volume[:, channels]
        return F.grid_sample(volume, grid, padding_mode="border", align_corners=True)[0, :, 0]

    def sdf(self, x):
        """s (R,J) at x (R,J,3)."""
        return self.lookup(x, slice(0, 1))[0]

    def errors(self, x):
        """E_grad and E_curv (R,) of rays with samples x (R,J,3): ray-wise averages. Eq. 4 [D6]"""
        return self.lookup(x, slice(1, 3)).mean(2)


def contract(x):
    """Squeezes |x| > 1 into the ball of radius 2 (mip-NeRF 360 Eq. 10); identity inside."""
    inverse = 1 / x.norm(dim=-1, keepdim=True).clamp_min(1)  # (...,1)
    return x * (2 - inverse) * inverse


class Background(nn.Module):
    """A small NeRF before and beyond the sphere, on an octree over contracted space."""
    def __init__(self, points, cfg, A, levels):
        super().__init__()
        self.samples = cfg.bg_samples
        levels = min(levels, 4)  # at most 256 cells across
        self.octree = Octree(2.0, levels, root=32)  # cells of 1/8
        seed_octree(self.octree, contract(points), dense=levels - 3)  # points (P,3)
        self.density = mlp(3 + self.octree.width, cfg.hidden, 1 + GEOMETRY_FEATURES)
        self.color = mlp(GEOMETRY_FEATURES + 3 + A, cfg.hidden, 3)

    def forward(self, rays, t0, t1, code, gen=None):
        """What rays see around the sphere, which they enter at t0 (R,1) and leave at t1, under
        codes (R,A). Returns the colour (R,3) of what lies before the sphere and the share (R,1) of
        light that passes it; the colour (R,3) beyond the sphere, already dimmed by that share."""
        n = self.samples // 6  # samples before the sphere; little stands before a landmark
        near = rays.near.lerp(t0, stratified(rays, n, gen))  # (R,n)
        u = stratified(rays, self.samples - n, gen)  # (R,K-n)
        far = u / (1 - u).clamp_min(1e-3)  # (R,K-n) beyond t1, dense near it, at most 1,000 radii
        near_length = torch.cat([near, t0], 1).diff()  # (R,n) the last one ends at the sphere
        length = torch.cat([near_length, far.diff()], 1)  # (R,K-1)
        x = contract(rays.at(torch.cat([near, t1 + far], 1)))  # (R,K,3)
        inputs = torch.cat([x, self.octree(x)], 2)  # (R,K,3+LC)
        out = mixed_precision(self.density, inputs)  # (R,K,1+GEOMETRY_FEATURES)
        sigma, geo = out.split([1, GEOMETRY_FEATURES], 2)
        sigma = F.softplus(sigma.squeeze(2) - 1)  # (R,K) starts at 0.31
        alpha = 1 - torch.exp(-length * sigma[:, :-1])  # (R,K-1)
        w = composite(F.pad(alpha, (0, 1), value=1.0))  # (R,K) the last sample is opaque
        per_ray = torch.cat([rays.d, code], 1)  # (R,3+A)
        colors = w[..., None] * colors_of(self.color, geo, per_ray)  # (R,K,3)
        near_color = colors[:, :n].sum(1)  # (R,3)
        far_color = colors[:, n:].sum(1)  # (R,3)
        near_trans = 1 - w[:, :n].sum(1, keepdim=True)  # (R,1)
        return near_color, near_trans, far_color


def surface_depth(t, sdf, w):
    """Distance (R,) to the surface on rays with samples at t (R,S+1), SDF (R,S+1) and weights w
    (R,S) of the intervals between them. Each interval gives a zero of s, taken as a line; the
    result is their weighted mean. An interval that leads from outside to inside holds its zero. Any
    other extrapolates, which is exact for a plane alone, and counts a hundredth: it decides on rays
    that only graze a surface. Where s rises, w is 0. A ray without weight gets the last sample."""
    start, end = sdf[:, :-1], sdf[:, 1:]
    fraction = start / (start - end).clamp_min(1e-6)  # (R,S) of the interval, up to the zero
    zero = t[:, :-1].lerp(t[:, 1:], fraction).clamp(t[:, :1], t[:, -1:])
    vote = torch.where((start > 0) & (end <= 0), w, 0.01 * w)  # (R,S)
    return ((vote * zero).sum(1) + 1e-8 * t[:, -1]) / (vote.sum(1) + 1e-8)


class Hits(NamedTuple):
    """What rays meet, indexed by the ray. depth and point have no gradient."""
    x: Tensor  # (R,S+1,3) samples in the sphere
    geo: Tensor  # (R,S+1,G) inputs of the colour network there
    w: Tensor  # (R,S+1) their weights, dimmed by what lies before the sphere
    opacity: Tensor  # (R,) of the foreground
    depth: Tensor  # (R,) distance to the surface; t1 if none is met
    point: Tensor  # (R,3) the surface point
    around: Tensor  # (R,3) colour that the background adds, before and beyond the sphere


class Rendering(NamedTuple):
    """A batch of rays as a picture shows it."""
    rgb: Tensor  # (R,3)
    opacity: Tensor  # (R,) of the foreground
    depth: Tensor  # (R,)
    normal: Tensor  # (R,3) at the surface point, times opacity: 0 where nothing is


# ---- 6 Photos in the wild: transient mask and geometry preservation ------------------------------

# the paper's values for Eq. 4; the lambda_curv of its Eq. 5 is cfg.lam_curv here: with a value of
# 2, L_curv would outweigh L_rgb [D2]
LAMBDA_GRAD, LAMBDA_CURV = 10.0, 2.0
THRESHOLD = 0.15  # a greater error of a pixel's worst channel makes it transient


def complexity(e_grad, e_curv):
    """Complexity (R,) of the geometry along rays: the argument of the sigmoid in Eq. 4."""
    return LAMBDA_GRAD * e_grad + LAMBDA_CURV * e_curv


def edge_indicator(ray_complexity, opacity):
    """Phi (R,), Eq. 4: opacity times sigmoid((x - mean) / deviation), x being the logarithm of the
    complexity. The paper calibrates its sigmoid, but does not say how. Here mean and deviation are
    those of x over the step's rays, weighted by opacity, so that Phi tells edges from flat walls at
    any scale. The factor opacity (R,) makes Phi 0 on rays through air, which have no edge. The
    caller sets it to 0 where a user's mask excludes the pixel, too. [D2]"""
    weight = opacity / opacity.sum().clamp_min(1e-6)  # (R,)
    x = (ray_complexity + 1e-3).log()
    mean = (weight * x).sum()
    variance = (weight * (x - mean) ** 2).sum()
    return opacity * torch.sigmoid((x - mean) / variance.sqrt().clamp_min(1e-3))


def paper_phi(ray_complexity):
    """Phi (R,), Eq. 4 with a plain sigmoid and E_curv = |lap s|. The complexity is never negative,
    so Phi is at least 0.5 on every ray; as |lap s| is large, it is near 1 on most."""
    return torch.sigmoid(ray_complexity)


def gpl_loss(mask, phi):
    """L_GPL, Eq. 3: the mean of M(r) Phi(r); the mask must not erase edges of the structure. Phi
    has no gradient: the loss moves the mask, never the SDF. At the paper's weight it has no effect
    that counts here. [D6]"""
    return (mask * phi).mean()


def mask_loss(logit, excess):
    """L_reg: binary cross entropy that classifies rays (R,). The label of a ray is 1 if its error
    exceeds THRESHOLD (excess > 0), else 0; its weight is |excess|. Without L_GPL the best M of a
    ray is its label. The simpler loss (1 - M) error + M THRESHOLD has the same minimum, but no
    gradient where the sigmoid saturates. With L_GPL a ray with excess > 0 minimises
    -excess log M + lam_gpl M Phi (lam_mask is 1). Its best M is excess / (lam_gpl Phi), at most 1:
    an edge with Phi = 1 is masked fully only if excess is at least lam_gpl. [D3]"""
    is_transient = (excess > 0).float()
    return F.binary_cross_entropy_with_logits(logit, is_transient, excess.abs())


def paper_mask_loss(mask, error):
    """L_reg as the paper describes it: -M error for what M takes out of L_rgb (here the error of
    the worst channel), and penalties for intensity and bimodality. The paper prints neither forms
    nor weights: the forms are CR-NeRF's, the weights 0.15 and 0.02 ours. The best M of a ray is
    (error - 0.02) / 0.26. L_GPL subtracts 0.05 Phi from the error: it lowers M by at most 0.19."""
    return (0.15 * mask**2 + 0.02 * mask * (1 - mask) - mask * error).mean()


def conv(inputs, outputs, stride):
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False),
        nn.GroupNorm(8, outputs),
        nn.ReLU())  # [D4]


class ContextBlock(nn.Module):
    """Context-guided block (CGNet Fig. 3), from n channels to 2n at half the resolution: local and
    dilated context, gated globally; no residual, no 1x1. [D4]"""
    def __init__(self, n, dilation):
        super().__init__()
        self.reduce = conv(n, n, stride=2)
        self.local = nn.Conv2d(n, n, 3, padding=1, groups=n)
        self.around = nn.Conv2d(n, n, 3, padding=dilation, dilation=dilation, groups=n)
        self.norm = nn.GroupNorm(8, 2 * n)
        self.gate = mlp(2 * n, n // 4, 2 * n)

    def forward(self, x):
        y = self.reduce(x)  # (B,n,h/2,w/2)
        y = torch.cat([self.local(y), self.around(y)], 1)
        y = F.relu(self.norm(y))  # (B,2n,h/2,w/2)
        gate = self.gate(y.mean((2, 3))).sigmoid()  # (B,2n)
        return y * gate[..., None, None]


def sample_logits(logits, uv):
    """Logits (R,) at uv (R,2) in 0..1 of logits (B,1,h,w); rays come photo by photo, R / B each."""
    grid = (2 * uv - 1).reshape(len(logits), -1, 1, 2)  # (B,R/B,1,2)
    return F.grid_sample(logits, grid, padding_mode="border", align_corners=False).flatten()


class TransientMask(nn.Module):
    """CGNet (as in CR-NeRF), which gives M. The head reads all three resolutions: at 1/8 alone a
    mask could not follow an outline. [D4]"""
    def __init__(self, thumbs):
        super().__init__()
        self.stages = nn.Sequential(
            nn.Sequential(conv(3, 16, stride=2), conv(16, 16, stride=1)),
            ContextBlock(16, dilation=2),
            ContextBlock(32, dilation=4))
        self.heads = nn.ModuleList([
            nn.Conv2d(16, 1, 1),
            nn.Conv2d(32, 1, 1, bias=False),  # as logits are summed, one bias is enough
            nn.Conv2d(64, 1, 1, bias=False)])
        nn.init.constant_(self.heads[0].bias, -2.5)  # starts with 8 % masked, not with half
        self.thumbs = nn.Buffer(thumbs, persistent=False)  # (I,3,2m,2m)

    def logits(self, photos):
        """Transient logits (B,1,m,m) of photos (B,)."""
        y = self.thumbs[photos] / 255 - 0.5  # (B,3,2m,2m)
        size = y.shape[2] // 2
        logits = 0
        for stage, head in zip(self.stages, self.heads):
            y = stage(y)  # (B,16,m,m), (B,32,m/2,m/2), (B,64,m/4,m/4)
            logits += F.interpolate(head(y), size, mode="bilinear")
        return logits


# ---- 7 The model and its objective ---------------------------------------------------------------

START_ZETA = 20  # a surface is 1/20 of a radius wide
LEAST_ZETA = 80  # from ZETA_RISE of training on
CACHE_EVERY = 128  # steps between renewals of the cache


def needed_parts(cfg, raw):
    """What the scene file `raw` needs, and no more, unless settings say so: the octree's levels;
    A, 0 without appearance codes; whether the background is a field or one colour. [D7]"""
    def is_on(switch, is_needed):
        return bool(is_needed) if switch == "auto" else switch == "on"

    pixels = 2 / raw["footprint"]  # across the sphere; footprint: a pixel's size there
    levels = int(np.clip(1 + np.log2(pixels / ROOT), 2, 8))  # no cell smaller than a pixel
    has_codes = is_on(cfg.appearance, raw["exposure_spread"] > 0.01)
    has_no_color = np.isnan(raw["bg_color"]).any()  # nan: the background has no one colour
    has_background = is_on(cfg.background, has_no_color)
    return cfg.levels or levels, cfg.appearance_dim if has_codes else 0, has_background


def objective(loss, cfg):
    """L, the weighted sum of losses in the paper's order, with two terms more: the off-surface
    penalty, which its text names, and one for SfM points [D5]. lambda_rgb is 1. Eq. 5"""
    return (
        loss["rgb"]
        + cfg.lam_eik * loss["eik"]
        + cfg.lam_curv * loss["curv"]
        + cfg.lam_mask * loss["reg"]
        + cfg.lam_gpl * loss["gpl"]
        + cfg.lam_lps * loss["lps"]
        + cfg.lam_off * loss["off"]
        + cfg.lam_sfm * loss["sfm"])


class GeoNVS(nn.Module):
    """The paper's model: the parts above, and their losses. Made under `with device:`, so that all
    its tensors lie on the scene's device."""
    name = "geonvsw"

    def __init__(self, cfg, scene):
        super().__init__()
        self.cfg = replace(cfg)
        self.scene = scene
        self.has_mask = cfg.mask == "on"
        levels, A, has_background = needed_parts(cfg, scene.raw)
        is_inside = scene.points.norm(dim=1) < 1
        self.sfm = nn.Buffer(scene.points[is_inside], persistent=False)  # (Q,3), never empty
        self.air = nn.Buffer(air_segments(scene), persistent=False)  # (T,2,3)
        check(len(self.air), "no camera sees an SfM point through air: correct the poses")

        octree = Octree(1.0, levels)
        seed_octree(octree, self.sfm, dense=0)
        self.octrees = [octree]  # a plain list, as the fields own them
        self.sdf = SDFField(octree, cfg.hidden)
        self.color = nn.Sequential(
            LipschitzLinear(GEOMETRY_FEATURES + octree.width + 3 + 3 + A, cfg.hidden),
            nn.ReLU(),
            LipschitzLinear(cfg.hidden, cfg.hidden),
            nn.ReLU(),
            LipschitzLinear(cfg.hidden, 3))
        self.appearance = nn.Embedding(len(scene.wh), A)
        self.appearance.requires_grad_(A > 0)
        nn.init.normal_(self.appearance.weight, std=0.01)
        self.background = None
        # grey where the scene has no one colour, but --background off was given
        bg_color = torch.tensor(scene.raw["bg_color"].tolist()).nan_to_num(0.5)
        self.bg_color = nn.Buffer(bg_color, persistent=False)
        if has_background:
            self.background = Background(scene.points[~is_inside], cfg, A, levels)
            self.octrees.append(self.background.octree)
        self.deviation = nn.Parameter(torch.tensor(math.log(START_ZETA) / 10))
        self.mask = TransientMask(scene.thumbs) if self.has_mask else None
        self.cache = SDFCache(64 if levels < 4 else 128)  # as fine as the octree, within bounds
        self.refresh_cache()
        print(f"  octree levels: {levels}, appearance code: {A}, octrees: {len(self.octrees)}")

    @property
    def eps(self):
        """Step of finite differences: half of the finest cell there is."""
        return self.sdf.octree.finest / 2

    def zeta(self):
        """The deviation network: one learned number v, zeta = exp(10 v) (NeuS). 1 / zeta is the
        width of a surface."""
        return torch.exp(10 * self.deviation)

    def bound_zeta(self, done):
        """Keeps zeta between 1e-6 and 1e6 (NeuS's code), and above a bound that rises with training
        (done: 0..1). A soft surface can paint people and clouds of a single photo. Their errors are
        then small, so the mask misses them, and the surface stays soft. [D8]"""
        least = 1e-6
        if not self.cfg.printed("zeta"):
            least += LEAST_ZETA * min(done / ZETA_RISE, 1)
        self.deviation.data.clamp_(math.log(least) / 10, math.log(1e6) / 10)

    def alpha(self, sdf, zeta):
        """Opacity (R,S) of the intervals between samples with SDF (R,S+1). Eq. 1"""
        form = paper_alpha if self.cfg.printed("alpha") else neus_alpha
        return form(sdf, zeta)

    def signed_distance(self, x):
        """s (P,) at x (P,3)."""
        return self.sdf(x)[0]

    @torch.no_grad()
    def sample(self, rays, t0, t1, gen=None):
        """Distances (R,S+1) of the samples between t0 and t1 (R,1), dense where the cache sees a
        surface. The cache knows where s is 0 to about half a voxel. So, to place samples, a
        surface is taken to be at least that wide, however large zeta is."""
        even = torch.linspace(0, 1, PROBES + 1, device=t0.device)
        probes = t0.lerp(t1, even)  # (R,PROBES+1)
        sdf = self.cache.sdf(rays.at(probes))  # (R,PROBES+1)
        zeta = self.zeta().clamp_max(self.cache.n)  # 1 / n is half a voxel
        alpha = self.alpha(sdf, zeta)  # (R,PROBES)
        return importance_samples(probes, alpha, stratified(rays, self.cfg.samples - 1, gen))

    def trace(self, rays, code, gen=None):
        """Hits of a batch of rays under appearance codes (R,A). Samples lie at random places of
        their strata, or in the middle without a generator."""
        t0, t1 = sphere_interval(rays.o, rays.d, rays.near)  # (R,1)
        t = self.sample(rays, t0, t1, gen)  # (R,S+1)
        x = rays.at(t)  # (R,S+1,3)
        sdf, geo = self.sdf(x)  # (R,S+1), (R,S+1,G)
        interval_w = composite(self.alpha(sdf, self.zeta()))  # (R,S)
        opacity = interval_w.sum(1)  # (R,)
        depth = surface_depth(t, sdf.detach(), interval_w.detach())
        point = rays.at(depth[:, None])[:, 0]  # (R,3)
        # alpha belongs to intervals, colour to samples: either end gets half of the weight [D1]
        w = F.avg_pool1d(interval_w, 2, stride=1, padding=1)  # (R,S+1)

        near_color = 0  # nothing stands before the sphere
        far_color = self.bg_color  # (3,)
        if self.background:
            near_color, near_trans, far_color = self.background(rays, t0, t1, code, gen)
            w = near_trans * w
        around = near_color + (1 - opacity[:, None]) * far_color  # (R,3)
        return Hits(x, geo, w, opacity, depth, point, around)

    def shade(self, rays, code, hits, normal):
        """Colours (R,3) of rays with hits and normals (R,3) at their surface points. All samples of
        a ray share its normal, which is no input in the paper. [D6]"""
        per_ray = torch.cat([normal, rays.d, code], 1)  # (R,3+3+A)
        rgb = colors_of(self.color, hits.geo, per_ray)  # (R,S+1,3)
        return torch.einsum("rs,rsc->rc", hits.w, rgb) + hits.around

    def losses(self, rays, photos, done, gen):
        """The objective, and a dictionary for the log, of rays that come photo by photo, equally
        many of each of photos (B,); done: share of training, 0..1. Also calls update_statistics."""
        R = len(rays.o)
        code = self.appearance(photos).repeat_interleave(R // len(photos), 0)  # (R,A)
        hits = self.trace(rays, code, gen)
        n = math.ceil(R / 4)  # SfM points, and as many in air
        sfm = self.sfm[random_index(gen, len(self.sfm), n)]  # (n,3) where s is 0 [D5]
        start, end = self.air[random_index(gen, len(self.air), n)].unbind(1)  # (n,3)
        air = start.lerp(end, uniform(gen, n, 1))  # (n,3) where s is positive [D5]
        points = torch.cat([hits.point, sfm, air])  # (R+2n,3), looked up at once [D6]
        s, grad, lap = self.sdf.derivatives(points, self.eps)  # (R+2n,), (R+2n,3), (R+2n,)
        opacity = hits.opacity.detach()
        eik_weight = F.pad(opacity, (0, 2 * n), value=1.0)  # (R+2n,) 1 at SfM points and in air

        rgb = self.shade(rays, code, hits, F.normalize(grad[:R]))  # (R,3)
        residual = (rgb - rays.rgb).abs()  # (R,3)
        error = residual.detach().amax(1)  # (R,) of the worst channel
        phi = self.phi(rays, hits)  # (R,)
        left_out, reg, gpl = self.transients(rays, photos, phi, error, done)
        _, s_sfm, s_air = s.split([R, n, n])
        # at a segment's end s is at most AIR_GAP, as the SfM point is that near
        margin = min(self.sdf.octree.finest, AIR_GAP)
        loss = dict(
            rgb=((1 - left_out) * residual.mean(1)).mean(),  # [D3]
            eik=(eik_weight * eikonal(grad)).mean(),
            curv=(opacity * lap[:R].abs()).mean() * self.eps,  # [D2]
            reg=reg,
            gpl=gpl,
            lps=lipschitz_loss(self.color),
            off=off_surface_loss(s_air, margin),  # [D5]
            sfm=s_sfm.abs().mean())  # [D5]
        self.update_statistics(rays, hits, error)
        log = loss | dict(mse=residual.square().mean(), left_out=left_out.mean())
        return objective(loss, self.cfg), log

    def phi(self, rays, hits):
        """Phi (R,) of rays with hits, 0 where a user's mask excludes the pixel. Eq. 4"""
        is_counted = ~rays.is_masked
        e_grad, e_curv = self.cache.errors(hits.x)  # (R,)
        if self.cfg.printed("phi"):
            is_inside = hits.x[:, 0].norm(dim=1) < 1.001  # not if a ray misses the sphere
            e_curv = e_curv / self.cache.side  # as printed: |lap s| without h
            ray_complexity = complexity(e_grad, e_curv) * is_inside
            return paper_phi(ray_complexity) * is_counted
        return edge_indicator(complexity(e_grad, e_curv), hits.opacity.detach() * is_counted)

    def transients(self, rays, photos, phi, error, done):
        """Section 6 for rays with Phi and errors (R,). Returns left_out (R,), L_reg and L_GPL.
        L_rgb is weighted by 1 - left_out, which does not train M. left_out is M, or 1 where a
        user's mask excludes the pixel."""
        if not self.has_mask:
            return rays.is_masked.float(), *error.new_zeros(2)
        with torch.set_grad_enabled(done < MASK_TRAINING):
            logit = sample_logits(self.mask.logits(photos), rays.uv)  # (R,)
        M = logit.sigmoid()
        # SfM pixels count as if they had no error: they train M = 0 [D5]
        judged = error.masked_fill(rays.has_sfm, 0)
        if self.cfg.printed("reg"):
            reg = paper_mask_loss(M * ~rays.is_masked, judged)
        else:
            excess = (judged - THRESHOLD) * ~rays.is_masked
            reg = mask_loss(logit, excess)
        left_out = M.detach().masked_fill(rays.is_masked, 1)
        return left_out, reg, gpl_loss(M, phi)

    def update_statistics(self, rays, hits, error):
        """Records the errors (R,) of a step's rays by the octree's cell at the surface point, for
        refinement. M plays no part, so people's errors are recorded, too; those of pixels that a
        user's mask excludes are not. [D7]"""
        is_solid = hits.opacity > 0.5  # (R,)
        pixel = hits.depth / self.scene.K[rays.photo, 0]  # (R,) its size at the surface point
        counted = error.masked_fill(rays.is_masked, 0)
        columns = torch.stack([counted, pixel, torch.ones_like(pixel)], 1) * is_solid[:, None]
        octree = self.sdf.octree
        node, _, _ = octree.locate(hits.point)
        octree.cell_error.index_add_(0, node[:, -1], columns)

    def refresh_cache(self):
        """Renews the cache: every CACHE_EVERY steps, and before pictures are made."""
        self.cache.refresh(self.signed_distance)

    def batch(self, n, gen):
        """n random rays and the photos (B,) they come from, photo by photo."""
        train = self.scene.train
        photos = train[random_index(gen, len(train), self.cfg.photos)]  # (B,)
        photo = photos.repeat_interleave(n // len(photos))  # (R,)
        return random_rays(self.scene, photo, gen), photos

    def groups(self):
        """Optimiser groups with their learning rates: networks, grids, codes, mask."""
        grids = [octree.features for octree in self.octrees]
        codes = [self.appearance.weight]
        mask = list(self.mask.parameters()) if self.has_mask else []
        special = set(grids + codes + mask)
        networks = [p for p in self.parameters() if p not in special]
        return [
            dict(params=networks, base_lr=self.cfg.lr_net),
            dict(params=grids, base_lr=self.cfg.lr_grid),
            dict(params=codes, base_lr=self.cfg.lr_code),
            dict(params=mask, base_lr=self.cfg.lr_mask)]

    def refine(self, optimizer, processes=ALONE):
        """Splits cells where colours err, and the neighbours that share a face with them, as the
        outer corners of a single layer of cells would hang. Adam's moments move along with their
        features. [D7]"""
        octree = self.sdf.octree
        processes.sum(octree.cell_error)
        # sums of floats differ between GPUs: one process chooses the cells for all
        worst = processes.share(cells_to_split(octree).cpu())
        state = optimizer.state.pop(octree.features)
        is_old = octree.split(worst.to(octree.features.device), reach=1)
        for name in ("exp_avg", "exp_avg_sq"):
            state[name] = carry_over_rows(state[name], is_old)
        optimizer.state[octree.features] = state
        _, grids, _, _ = optimizer.param_groups
        grids["params"] = [tree.features for tree in self.octrees]

    def codes(self):
        """Appearance codes (I,A) of all photos."""
        return self.appearance.weight.detach()

    def render(self, rays, code):
        """Rendering of rays under codes (R,A): for pictures, and to fit codes."""
        hits = self.trace(rays, code)
        _, grad, _ = self.sdf.derivatives(hits.point, self.eps)
        normal = F.normalize(grad)
        rgb = self.shade(rays, code, hits, normal)
        return Rendering(rgb, hits.opacity, hits.depth, normal * hits.opacity[:, None])


# ---- 8 Energy ------------------------------------------------------------------------------------

def metered_joules(device, joules, processes=ALONE):
    """Yields the joules given and those that the GPUs of all processes spent since the first call,
    by their NVML counters (Volta and newer). Ends when one fails, or had failed (joules None)."""
    try:
        check(device.type == "cuda", "only GPUs are metered")
        import pynvml
        pynvml.nvmlInit()
        gpus = []
        for number in range(processes.count):  # the first process has the first GPU
            uuid = torch.cuda.get_device_properties(number).uuid
            gpus.append(pynvml.nvmlDeviceGetHandleByUUID(f"GPU-{uuid}"))
        begin = sum(map(pynvml.nvmlDeviceGetTotalEnergyConsumption, gpus))  # mJ
        while joules is not None:
            now = sum(map(pynvml.nvmlDeviceGetTotalEnergyConsumption, gpus))
            yield joules + (now - begin) / 1e3
    except Exception as error:  # a package, a driver's answer or a permission is missing
        print(f"  energy is null ({error}); on a GPU: pip install nvidia-ml-py")


# ---- 9 Training ----------------------------------------------------------------------------------

LOG_EVERY = 30  # seconds between lines of the log; a checkpoint is made with each


@dataclass
class State:
    """What a run has done so far."""
    step: int = 0
    seconds: float = 0.0
    joules: float | None = 0.0  # None once a counter has failed
    log: list = field(default_factory=list)  # lines of log.jsonl, as text

    def share_done(self, cfg):
        """Share of training that is done, of steps or minutes; 1 or more: it is over."""
        if cfg.minutes > 0:
            return self.seconds / (60 * cfg.minutes)
        return self.step / cfg.steps


def make_optimizer(model):
    """Adam as is usual for feature grids (Instant-NGP)."""
    return torch.optim.Adam(model.groups(), betas=(0.9, 0.99), eps=1e-15, fused=True)


def training_step(model, optimizer, step, done, gen, processes=ALONE):
    """One update. The learning rate rises for 20 steps, then follows a cosine down to 5 %. done:
    share of training, 0..1. Returns GeoNVS.losses' log and total. Never waits for the device."""
    if step % CACHE_EVERY == 0:
        model.refresh_cache()
    model.bound_zeta(done)
    rays, photos = model.batch(model.cfg.rays, gen)
    loss, terms = model.losses(rays, photos, done, gen)
    optimizer.zero_grad()
    loss.backward()
    processes.average_gradients(model)
    warm_up = min(1, (step + 1) / 20)
    decay = 0.525 + 0.475 * math.cos(math.pi * done)
    for group in optimizer.param_groups:
        group["lr"] = warm_up * decay * group["base_lr"]
    optimizer.step()
    return terms | dict(total=loss.detach())


def fingerprint(scene):
    """What weights depend on: each photo's place in the list, split, size, camera, mean colour,
    masked share and number of sightings, by its name; the sphere, and the middle of SfM points."""
    raw = scene.raw
    count = len(raw["name"])
    masked = raw.get("masked", np.zeros(len(raw["rgb"]), bool))
    masked_share = [part.mean() for part in np.split(masked, raw["start"][1:-1])]
    sightings = np.bincount(raw["track_photo"], minlength=count)
    # colours weigh a hundredth, as programs decode photos in slightly different ways
    color = scene.thumbs.mean((2, 3), dtype=torch.float).cpu().numpy() / 255 / 100  # (I,3)
    photos = np.column_stack([
        np.arange(count), raw["is_test"], raw["wh"], raw["K"], raw["c2w"].reshape(count, 12), color,
        masked_share, sightings])
    sphere = np.hstack([raw["center"] / raw["scale"], np.log(raw["scale"]), raw["points"].mean(0)])
    return dict(zip(raw["name"].tolist(), photos.tolist())) | {"the sphere": sphere.tolist()}


def save(run, model, optimizer, gen, state, terms):
    """Adds a line to the log, writes checkpoint.pt (with the log in it) and log.jsonl, and prints.
    terms: the step's losses."""
    line = dict(step=state.step, seconds=state.seconds, joules=state.joules)
    line |= {key: value.item() for key, value in terms.items()}
    line["psnr"] = -10 * math.log10(line["mse"] + 1e-10)  # of the step's rays, people included
    log = run / "log.jsonl"
    log_is_unchanged = "".join(state.log) == (log.read_text() if log.exists() else "")
    check(log_is_unchanged, f"another process trains in {run}, too: stop it and go on with "
          "--resume, or train beside it by --name NAME")
    state.log.append(json.dumps(line) + "\n")
    saved = dict(
        config=vars(model.cfg),
        scene=fingerprint(model.scene),
        octrees=[octree.split_keys.clone() for octree in model.octrees],
        model=model.state_dict(),
        optimizer=optimizer.state_dict(),
        generator=gen.get_state(),
        state=vars(state))
    buffer = io.BytesIO()  # as torch.save calls a full disk a RuntimeError
    torch.save(saved, buffer)
    atomic_write(run / "checkpoint.pt", lambda part: part.write_bytes(buffer.getbuffer()))
    atomic_write(log, lambda part: part.write_text("".join(state.log)))
    done = min(1, state.share_done(model.cfg))
    print(f"  {done:4.0%}  step {state.step}  psnr {line['psnr']:.2f}", flush=True)


def read_checkpoint(path, given):
    """A checkpoint's dictionary, plain values and never code; its settings, or those given."""
    check(path.exists(), f"{path} does not exist: train first, without --resume or --render, or "
          "name the run by the --scene, --data, --seed, --paper or --name it was made with")
    what = f"{path} is damaged, too large, or of another version of geonvs.py"
    with as_user_error(Exception, what, "use that version, or train under another --name"):
        data_prep.refuse_bomb(path)
        saved = dict(torch.load(path, map_location="cpu", weights_only=True))
        saved["scene"] = dict(saved["scene"])
        cfg = Config(**saved["config"])
    return saved, replace(cfg, **given)


def restore(saved, model, gen=None):
    """Puts a checkpoint's weights into a model. If gen is given, it goes on with the saved random
    numbers; its kind of device must be the same. Returns optimiser and State."""
    old, new = saved["scene"], fingerprint(model.scene)
    changed = [  # in more than the last digits, in which machines differ; nan equals nothing
        name for name in old | new if not np.allclose(
            old.get(name, math.nan), new.get(name, math.nan), rtol=0, atol=5e-5)]
    check(not changed, "checkpoint.pt was trained with other photos, cameras, masks or points: "
          f"{len(changed)} differ, first {changed[:1]}: use its data, or another --name")
    with as_user_error(Exception, "checkpoint.pt does not fit settings or kind of device",
                       "use those it was made with, or train under another --name"):
        for octree, keys in zip(model.octrees, saved["octrees"], strict=True):
            octree.corner_key = octree.corner_key[:0]  # no corner is carried over
            octree.features = nn.Parameter(octree.features[:0])
            octree.build(keys.to(octree.child.device))
        model.load_state_dict(saved["model"])
        optimizer = make_optimizer(model)
        groups = optimizer.state_dict()["param_groups"]  # learning rates may be given anew
        optimizer.load_state_dict(dict(saved["optimizer"], param_groups=groups))
        if gen:
            gen.set_state(saved["generator"])
        return optimizer, State(**saved["state"])


def find_scene(cfg, home=None):
    """The dictionary of the scene file that settings name; the file is made on first use. home: the
    folder in which a run was trained, if another one than here."""
    path = data_prep.scene_path(cfg.source)
    if home and (home / path).exists() and not home.samefile("."):
        return data_prep.read_scene(home / path)
    is_there = not cfg.data or Path(cfg.data).is_dir()
    check(is_there or path.exists(),
          f"{cfg.data} is no folder: give the folder's place by --data; a run that was trained "
          "with its old place also needs --name")
    return data_prep.open_scene(cfg.source, cfg.downscale)


def load_run(run, **given):
    """Model, scene and appearance codes (I,A) of all photos of a run that was trained, such as
    runs/toy-geonvsw-0. Settings may be given anew: device="cpu"."""
    run = Path(run).resolve()
    saved, cfg = read_checkpoint(run / "checkpoint.pt", given)
    device = pick_device(cfg.device)
    scene = load_scene(find_scene(cfg, run.parent.parent), device)
    with device:
        model = GeoNVS(cfg, scene)
    restore(saved, model)
    model.refresh_cache()  # a run that was stopped has an older cache
    codes = model.codes()
    if (run / "codes.npy").exists():  # finished: codes of test photos are fitted
        codes = torch.as_tensor(np.load(run / "codes.npy"), device=device)
    return model, scene, codes


def check_finite(tensors, cfg):
    """UserError if numbers are infinite or not a number: the training diverged."""
    cause = " (--paper: printed equations may do this)" if cfg.paper else ""
    check(all(tensor.isfinite().all() for tensor in tensors),
          f"numbers are no longer finite{cause}: correct the poses, or try a third of the learning "
          "rates --lr_grid and --lr_net; an older checkpoint.pt, if any, is still there")


def remove_results(run):
    """Removes what a finished run wrote."""
    for name in ("metrics.json", "codes.npy", "panel.png", "mesh.ply", "film.mp4"):
        (run / name).unlink(missing_ok=True)
    shutil.rmtree(run / "held_out", ignore_errors=True)


def start(cfg, scene, saved=None, processes=ALONE):
    """Model, optimiser, generator and State: new ones, or those of a checkpoint, `saved`."""
    torch.manual_seed(cfg.seed)
    own_seed = cfg.seed * processes.count + processes.rank
    gen = torch.Generator(scene.c2w.device).manual_seed(own_seed)
    with gen.device:
        model = GeoNVS(cfg, scene)
    if saved is None:
        return model, make_optimizer(model), gen, State()
    optimizer, state = restore(saved, model, gen)
    if processes.rank > 0:  # random numbers and sums of errors are those of the first process
        gen.manual_seed(own_seed)
        model.sdf.octree.cell_error.zero_()
    return model, optimizer, gen, state


def train(cfg, scene, run, saved=None, processes=ALONE):
    """Trains until cfg.steps or cfg.minutes; writes checkpoint.pt and log.jsonl below run. saved: a
    checkpoint to go on from. Returns model and state."""
    print(f"{GeoNVS.name} on {scene.info['scene']}: {len(scene.wh)} photos, "
          f"{len(scene.test)} held out; {scene.c2w.device}; {run}/")
    torch.set_flush_denormal(True)  # vanishing weights would otherwise slow a CPU down
    model, optimizer, gen, state = start(cfg, scene, saved, processes)
    done = state.share_done(cfg)
    if done >= 1:
        print("  nothing is left to train: give more --steps or --minutes; it is scored again")
        model.cfg = Config(**saved["config"])  # what was trained, not what was asked for now
    elif saved and processes.rank == 0:
        atomic_write(run / "log.jsonl", lambda part: part.write_text("".join(state.log)))
    meter = metered_joules(gen.device, state.joules, processes)
    next(meter, None)  # it counts from here
    seconds = state.seconds  # of this process; state has those that all agree on
    next_log = 0.0
    caught = []  # signals
    is_stopped = False
    last = time.perf_counter()
    with on_signals(lambda number, _: caught.append(number)):
        while done < 1 and not is_stopped:
            terms = training_step(model, optimizer, state.step, done, gen, processes)
            now = time.perf_counter()
            # a step of many times the usual length is a pause: Ctrl-Z, a laptop's lid
            longest = max(10, 20 * seconds / max(state.step, 1))
            seconds += min(now - last, longest)
            last = now
            state.step += 1
            # several processes agree now and then, and at the last step
            if processes.count == 1 or state.step % 16 == 0 or state.step == cfg.steps:
                state.seconds, is_stopped = processes.share((seconds, len(caught) > 0))
            before = done
            done = state.share_done(cfg)
            if any(before < share <= done for share in REFINE_AT):
                model.refine(optimizer, processes)
            if done >= 1 or is_stopped or state.seconds >= next_log:  # in all processes at once
                next_log = state.seconds + LOG_EVERY
                check_finite(model.parameters(), cfg)
                if processes.rank == 0:
                    state.joules = next(meter, None)  # None, never 0, once a counter has failed
                    save(run, model, optimizer, gen, state, terms)
                    remove_results(run)  # of a shorter training
    if caught or is_stopped:
        raise KeyboardInterrupt(
            f"stopped; step {state.step} is saved, and the same command with --resume goes on")
    model.refresh_cache()
    return model, state


# ---- 10 Scoring, mesh, pictures ------------------------------------------------------------------

RENDER_RAYS = dict(cpu=2**10, cuda=2**14)  # rendered at a time: 2 GB on a GPU
FRAMES = 96  # of a film


def to_uint8(picture):
    """Numbers in 0..1 as bytes."""
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def psnr(error):
    """Peak signal-to-noise ratio in dB for the error of a picture in 0..1; at most 100."""
    return -10 * math.log10((error**2).mean() + 1e-10)


def photo_rays(scene, photo):
    """The rays of all pixels of a photo, row by row."""
    pixel = torch.arange(scene.wh[photo].prod(), device=scene.wh.device)
    return make_rays(scene, torch.full_like(pixel, photo), pixel)


@torch.no_grad()
def render_photo(model, scene, photo, code):
    """A photo's view under an appearance code (A,): its colours, the photo itself, normals scaled
    by opacity, each (H,W,3), and depth (H,W), along the ray."""
    w, h = scene.wh[photo].tolist()
    parts = []
    for pixel in torch.arange(w * h, device=code.device).split(RENDER_RAYS[code.device.type]):
        rays = make_rays(scene, torch.full_like(pixel, photo), pixel)
        out = model.render(rays, code.expand(len(pixel), -1))
        parts.append(torch.cat([out.rgb, rays.rgb, out.normal, out.depth[:, None]], 1))
    check_finite(parts, model.cfg)
    picture = torch.cat(parts).reshape(h, w, 10).cpu().numpy()
    rgb, truth, normal, depth = np.split(picture, [3, 6, 9], axis=2)
    return rgb, truth, normal, depth[..., 0]


def fit_codes(model, scene, photos, steps=128, n=64):
    """Appearance codes (B,A) of unseen photos (B,), by Adam from the mean code of the training
    photos. Each step uses n random rays of each photo's left half. The scene stays as it is."""
    gen = torch.Generator(photos.device).manual_seed(0)
    codes = model.codes()[scene.train].mean(0).repeat(len(photos), 1)  # (B,A)
    if codes.numel() == 0:
        return codes
    adam = torch.optim.Adam([codes.requires_grad_()])
    photo = photos.repeat_interleave(n)  # (Bn,)
    for step in progress(range(steps), "fitting codes of held-out photos"):
        adam.param_groups[0]["lr"] = 0.1 * 0.1 ** (step / steps)
        rays = random_rays(scene, photo, gen, part=0.5)
        rgb = model.render(rays, codes.repeat_interleave(n, 0)).rgb
        residual = (rgb - rays.rgb).abs() * ~rays.is_masked[:, None]  # (Bn,3)
        adam.zero_grad()
        residual.mean().backward(inputs=codes)  # the model's weights get no gradient
        adam.step()
    return codes.detach()


def score(rgb, truth, masked, lpips=None):
    """The right half of a rendered photo, rounded to 8 bits, against the truth, beside a baseline
    (psnr_floor): each row of pixels in the mean colour of its left half. SSIM has a Gaussian window
    of 11 px with sigma 1.5 and no border. Pixels that a user's mask excludes, masked (H,W), are
    left out. None where a picture is too small, or nothing is left of it."""
    half = truth.shape[1] // 2
    left, want = np.split(truth, [half], axis=1)
    is_scored = ~masked[:, half:]
    row = dict(psnr=None, psnr_floor=None, ssim=None, lpips=None)
    row["masked_pixels"] = int((~is_scored).sum())
    if not is_scored.any():
        return row
    got = to_uint8(rgb[:, half:]) / 255
    got = np.where(is_scored[..., None], got, want)  # no window sees a difference in the others
    weight = ~masked[:, :half, None] + 1e-9  # so that a row without pixels has a mean, too
    floor = (weight * left).sum(1) / weight.sum(1)
    row["psnr"] = psnr((got - want)[is_scored])
    row["psnr_floor"] = psnr((floor[:, None] - want)[is_scored])
    inner = is_scored[5:-5, 5:-5]  # centres of whole windows
    if inner.any():
        _, ssim = structural_similarity(
            got, want, channel_axis=2, data_range=1, gaussian_weights=True,
            use_sample_covariance=False, full=True)  # (H,W/2,3)
        row["ssim"] = ssim[5:-5, 5:-5][inner].mean()
    if lpips and min(is_scored.shape) >= 32:
        a, b = [torch.tensor(x).float().permute(2, 0, 1)[None] for x in (got, want)]  # (1,3,H,W)
        row["lpips"] = lpips(a, b, normalize=True).item()
    return row


def evaluate(model, scene, lpips=None, pictures=None):
    """Scores of the test photos by the half-image protocol, per photo and on average, None where
    there are none; codes (I,A) of all photos, those of test photos fitted. The dictionary
    `pictures` gets each photo with its render to the right of it, by name."""
    codes = model.codes().clone()
    for photos in scene.test.split(32):
        codes[photos] = fit_codes(model, scene, photos)
    rows = []
    for photo in progress(scene.test.tolist(), "scoring held-out photos"):
        name = str(scene.raw["name"][photo])
        rgb, truth, _, _ = render_photo(model, scene, photo, codes[photo])
        start, end = scene.raw["start"][photo:photo + 2]
        masked = scene.raw.get("masked", np.zeros(end, bool))[start:end].reshape(truth.shape[:2])
        rows.append(score(rgb, truth, masked, lpips) | dict(name=name))
        if pictures is not None:
            pictures[name] = to_uint8(np.hstack([truth, rgb]))
    scores = dict(per_image=rows)
    for key in ("psnr", "psnr_floor", "ssim", "lpips"):
        values = [row[key] for row in rows if row[key] is not None]
        scores[key] = np.mean(values) if values else None
    scores["masked_pixels"] = sum(row["masked_pixels"] for row in rows) if rows else None
    return scores, codes


@torch.no_grad()
def toy_truth(model, scene):
    """Errors of surface and mask that only a toy can tell: see data_prep.toy_truth."""
    near, wall = [torch.as_tensor(scene.raw[key]).to(scene.c2w) for key in ("near_wall", "wall")]
    gradient = in_chunks(lambda x: model.sdf.derivatives(x, 0.004)[1], wall)
    sdf = in_chunks(model.signed_distance, near)
    M = None
    if model.has_mask:
        logits = [
            sample_logits(model.mask.logits([photo]), photo_rays(scene, photo).uv)
            for photo in scene.train.tolist()]
        M = torch.cat(logits).sigmoid().cpu().numpy()
    return data_prep.toy_truth(scene.raw, sdf.cpu().numpy(), gradient.cpu().numpy(), M)


def extract_mesh(model):
    """The surface s = 0, cut open at the unit sphere, by marching cubes with two cells per finest
    octree cell, at most 512: vertices (P,3) in SfM units, faces (N,3). s is evaluated near the
    surface; elsewhere the cache gives its sign."""
    n = min(round(2 / model.eps), 512)
    cache = model.cache
    s = cache.volume[:, :1]
    volume = F.interpolate(s, n + 1, mode="trilinear", align_corners=True)[0, 0]
    square = torch.linspace(-1, 1, n + 1, device=volume.device) ** 2
    square = square[:, None, None] + square[:, None] + square  # (n+1,n+1,n+1) squared radius
    is_close = (square < 1.1) & (volume.abs() < 3 * cache.side)
    volume[is_close] = in_chunks(model.signed_distance, is_close.nonzero() * (2 / n) - 1)
    volume = volume.cpu().numpy()
    is_inside = (square < 1).cpu().numpy()
    if len(np.unique(volume[is_inside] < 0)) < 2:
        return [np.zeros((0, 3))] * 2
    vertices, faces, _, _ = marching_cubes(volume, 0, mask=is_inside)
    raw = model.scene.raw
    return (vertices * (2 / n) - 1) * raw["scale"] + raw["center"], faces


@torch.no_grad()
def mesh_colors(model, vertices):
    """Colours (P,3) of vertices (P,3) in SfM units, seen along their normals in the mean light."""
    scene = model.scene
    mean = model.codes()[scene.train].mean(0)  # (A,)

    def colors(x):
        _, geo = model.sdf(x)  # (P,G)
        _, grad, _ = model.sdf.derivatives(x, model.eps)
        normal = F.normalize(grad)
        per_ray = torch.cat([normal, -normal, mean.expand(len(x), -1)], 1)  # (P,3+3+A)
        return colors_of(model.color, geo[:, None], per_ray)[:, 0]
    x = (vertices - scene.raw["center"]) / scene.raw["scale"]
    return in_chunks(colors, torch.as_tensor(x).to(scene.c2w)).cpu().numpy()


def depth_picture(depth, opacity):
    """Depth (H,W) as colours (H,W,3) of bytes: red is near, blue far, black where nothing is."""
    solid = depth[opacity > 0.5]
    nearest = solid.min(initial=1e9)
    farthest = solid.max(initial=0)
    nearness = (farthest - depth) / max(farthest - nearest, 1e-6)
    color = cv2.applyColorMap(to_uint8(nearness), cv2.COLORMAP_TURBO)[..., ::-1]
    return (color * opacity[..., None]).astype(np.uint8)


def draw_panel(model, scene, codes):
    """A picture with a row for two held-out photos and two of training: photo, render under codes
    (I,A), normals and depth of the surface, and M of the whole photo."""
    rows = []
    for photo in scene.test[:2].tolist() + scene.train[:2].tolist():
        rgb, truth, normal, depth = render_photo(model, scene, photo, codes[photo])
        tiles = [to_uint8(tile) for tile in (truth, rgb, normal / 2 + 0.5)]
        tiles.append(depth_picture(depth, np.linalg.norm(normal, axis=2)))
        kind = "held out" if photo in scene.test else "training"
        text = f"{kind}: {scene.raw['name'][photo]}, render, normals, depth (red: near)"
        if model.has_mask:
            M = model.mask.logits([photo])[0, 0].detach().sigmoid().cpu()  # (m,m)
            tiles.append(to_uint8(np.dstack([M] * 3)))
            text += ", mask (white: transient)"
        h, w, _ = rgb.shape
        size = (240, 240 * h // w)
        row = [cv2.resize(tile, size, interpolation=cv2.INTER_AREA) for tile in tiles]
        row = np.insert(np.hstack(row), [0] * 20, 255, axis=0)  # 20 white lines for the title
        cv2.putText(row, text, (2, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, 0)
        rows.append(row)
    return np.vstack(rows)


def write_picture(path, draw):
    """Writes the picture that draw() returns. One that fails is a line, not the end of a run."""
    try:
        write_png(path, draw())
    except Exception as error:
        print(f"  no {path.name}: {error!r:.200}")


def film(model, scene, path):
    """VP9, which browsers play, at 24 frames/s: the first training camera sways sideways, by a
    tenth of the sphere's radius, while its photo's light turns into the last photo's."""
    photo, other = scene.train[[0, -1]].tolist()
    first, last = model.codes()[[photo, other]]  # (A,)
    size = scene.wh[photo].tolist()  # px; of an odd side cv2 leaves out the last pixel
    with tempfile.TemporaryDirectory() as folder:  # as cv2 cannot open every path
        part = Path(folder, "film.mp4")
        video = cv2.VideoWriter(str(part), cv2.VideoWriter_fourcc(*"vp09"), 24, size)
        for n in progress(range(FRAMES), f"filming {FRAMES} frames"):
            phase = n / (FRAMES - 1)
            c2w = scene.c2w.clone()
            c2w[..., 3] += 0.1 * math.sin(math.tau * phase) * c2w[..., 0]
            view = scene._replace(c2w=c2w)
            rgb, _, _, _ = render_photo(model, view, photo, first.lerp(last, phase))
            video.write(to_uint8(rgb[..., ::-1]))
        video.release()
        video = cv2.VideoCapture(str(part))  # read back, as a writer says nothing of a full disk
        count = sum(1 for _ in iter(lambda: video.read()[0], False))
        video.release()
        check(count == FRAMES, f"{count} of {FRAMES} frames were written: make room in {folder}, "
              "or pip install --upgrade opencv-contrib-python-headless, which encodes VP9")
        atomic_write(path, lambda new: shutil.copyfile(part, new))
    print(f"wrote {path}")


def make_lpips():
    """LPIPS (AlexNet, v0.1), a learned perceptual distance, on the CPU; or None with a line."""
    try:
        import lpips
        return lpips.LPIPS(net="alex", verbose=False)
    except Exception as error:  # not installed, or its weights cannot be fetched
        print(f"  lpips is null ({error}): pip install lpips, and internet for its weights")


def peak_memory(is_cuda):
    """Most bytes in use at a time, of the GPU, else of this process; None on Windows."""
    if is_cuda:
        return torch.cuda.max_memory_allocated()
    with contextlib.suppress(ImportError):
        import resource
        unit = 1 if sys.platform == "darwin" else 1024  # bytes
        return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def code_version():
    """The commit of this file; None without git."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    with contextlib.suppress(OSError):  # git is not installed
        return subprocess.run(command, capture_output=True, text=True).stdout.strip() or None


def finish(model, scene, state, run, processes=ALONE):
    """Scores a trained model; writes codes, mesh, metrics and at last pictures below run. Returns
    the metrics, and prints those that are one number with a fraction."""
    cfg = model.cfg
    is_metered = state.joules is not None
    is_cuda = scene.c2w.is_cuda
    threads = f"cpu, {torch.get_num_threads()} threads"
    buffers = [tensor for octree in model.octrees for tensor in octree.buffers()]
    fitted = "appearance fitted on the left half, " if model.codes().numel() else ""
    metrics = dict(
        scene=scene.info["scene"],
        method=model.name,
        seed=cfg.seed,
        steps=state.step,
        device=torch.cuda.get_device_name() if is_cuda else threads,
        train_seconds=state.seconds,
        energy_wh=state.joules / 3600 if is_metered else None,
        energy_source="the device's counter, in pauses, too" if is_metered else None,
        rays_per_second=processes.count * cfg.rays * state.step / state.seconds,
        parameters=sum(p.numel() for p in model.parameters()),
        model_bytes=sum(tensor.nbytes for tensor in [*model.parameters(), *buffers]),
        octree_cells=model.sdf.octree.cells[:, 0].bincount().tolist(),  # by level
        peak_memory_bytes=peak_memory(is_cuda),  # up to here: not of scoring
        protocol=fitted + "scored on the right half",
        has_mask=model.has_mask,
        torch=torch.__version__,
        commit=code_version(),
        config=vars(cfg))
    pictures = {}
    scores, codes = evaluate(model, scene, make_lpips(), pictures)
    metrics |= scores
    atomic_write(run / "codes.npy", lambda part: np.save(part, codes.cpu()))
    vertices, faces = extract_mesh(model)
    if len(faces) == 0:
        print(f"  {run}/mesh.ply is empty: no surface lies in the unit sphere; train longer")
    write_ply(run / "mesh.ply", vertices, faces, to_uint8(mesh_colors(model, vertices)))
    if "wall" in scene.raw:
        metrics |= toy_truth(model, scene)
    atomic_write(run / "metrics.json", lambda part: part.write_text(json.dumps(metrics, indent=1)))
    write_picture(run / "panel.png", lambda: draw_panel(model, scene, codes))
    for name, picture in pictures.items():
        name = name.removesuffix(".png") + ".png"  # a.png stays, a.jpg becomes a.jpg.png
        write_picture(run / "held_out" / name, lambda: picture)
    for key, value in metrics.items():
        if isinstance(value, float):
            print(f"  {key} {value:.4g}")
    return metrics


# ---- 11 Command line -----------------------------------------------------------------------------

GO_ON = "a run that has a checkpoint goes on with --resume"


def make_parser():
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog=f"[Dn]: see the head of geonvs.py. Photos on a GPU: {GPU_DEFAULTS}",
        usage=argparse.SUPPRESS)  # so a mistake ends in one sentence
    parser.add_argument(
        "--resume", action="store_true", help="go on; new --steps stretch all schedules")
    parser.add_argument("--render", action="store_true", help="film a finished run")
    for option in fields(Config):
        if option.name in GROUPS:
            group = parser.add_argument_group(GROUPS[option.name])
        alone = option.metadata.get("alone")
        group.add_argument(
            f"--{option.name}",
            type=option.type,
            nargs="?" if alone else None,
            const=alone,
            metavar=option.type.__name__.upper(),
            default=argparse.SUPPRESS,  # for make_config, which has to know what was given
            help=f"{option.metadata['meaning']} [{option.default}]".removesuffix(" []"))
    return parser


def pick_device(name, processes=ALONE):
    """The device of this process: with torchrun each has its own GPU."""
    count = torch.cuda.device_count()
    number = processes.local_rank
    if name == "cpu" or (name == "auto" and count == 0):
        return torch.device("cpu")
    check(number < count, f"process {number + 1} has no GPU: there are {count}; use --device cpu")
    return torch.device("cuda", number)


def make_config(given):
    """Config's defaults, then GPU_DEFAULTS if photos meet a GPU, then flags."""
    cfg = Config(**given)
    if cfg.source == "toy":
        check("downscale" not in given,
              "--downscale is for photos: a toy's size is that of data_prep.py toy --size")
    elif pick_device(cfg.device).type == "cuda":
        cfg = Config(**GPU_DEFAULTS | given)
    return cfg


def main(argv=None):
    given = vars(make_parser().parse_args(argv))
    resume = given.pop("resume")
    render = given.pop("render")
    if resume and "steps" in given:
        given.setdefault("minutes", 0.0)  # of two budgets the last one given
    cfg = make_config(given)
    name = f"{data_prep.scene_path(cfg.source).stem}-{GeoNVS.name}-{cfg.seed}"
    if cfg.paper:
        name += f"-paper-{cfg.paper}".removesuffix("-" + ",".join(PRINTED))
    run = Path("runs", cfg.name or name)
    if render:
        model, scene, _ = load_run(run, **given)
        film(model, scene, run / "film.mp4")
        return
    saved = None
    if resume:
        saved, cfg = read_checkpoint(run / "checkpoint.pt", given)
    check(resume or not run.exists(), f"{run} exists already: go on with it by --resume, train "
          "beside it by --name NAME, or delete the folder to replace it")
    check(cfg.rays % cfg.photos == 0,
          f"--rays {cfg.rays} must be a multiple of --photos {cfg.photos}")
    numbers = [int(os.environ.get(key, 0)) for key in ("WORLD_SIZE", "RANK", "LOCAL_RANK")]
    processes = Processes(*numbers) if numbers[0] > 1 else ALONE  # torchrun says so
    device = pick_device(cfg.device, processes)
    if processes.count > 1:
        processes.join(device)
        if processes.rank == 0:
            find_scene(cfg)  # the others find it made
        dist.barrier()
    scene = load_scene(find_scene(cfg), device)
    model, state = train(cfg, scene, run, saved, processes)
    if processes.rank == 0:
        finish(model, scene, state, run, processes)
    if processes.count > 1:
        dist.destroy_process_group()


if __name__ == "__main__":
    run_command_line(main, GO_ON)
