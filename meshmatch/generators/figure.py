"""Body parts of a rig, for proportions and clothes: their joints, vertices, and positions along limbs."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from meshmatch.arrays import Float, Int
from meshmatch.generators.quadruped_rig import mean_of_neighbours
from meshmatch.generators.rig import Rig

# For each part: prefixes of its joints' names, and the start and end joints of its axis. `SIDED` parts have two sides.
_JOINTS: dict[str, tuple[tuple[str, ...], str, str]] = {
    "hips": (("root", "pelvis", "spine05"), "root", "spine04"),
    "belly": (("spine04", "spine03"), "spine04", "spine02"),
    "chest": (("spine02", "spine01", "clavicle", "shoulder01"), "spine02", "neck01"),
    "neck": (("neck",), "neck01", "head"),
    "head": (("head", "eye"), "neck01", "head"),
    "upper arm": (("upperarm",), "upperarm01", "lowerarm01"),
    "forearm": (("lowerarm",), "lowerarm01", "wrist"),
    "hand": (("wrist", "metacarpal", "finger"), "wrist", "finger3-1"),
    "thigh": (("upperleg",), "upperleg01", "lowerleg01"),
    "shin": (("lowerleg",), "lowerleg01", "foot"),
    "foot": (("foot", "toe"), "foot", "toe2-1"),
}
SIDED = ("upper arm", "forearm", "hand", "thigh", "shin", "foot")
PARTS = tuple(name + side for name in _JOINTS for side in ((" L", " R") if name in SIDED else ("",)))
ARM, LEG = ("upper arm", "forearm", "hand"), ("thigh", "shin", "foot")
_ROUNDS = 3  # rounds of smoothing of normals


def part(name: str, side: str = "") -> int:
    """Index of a part in `PARTS`; ``side`` is L or R for sided parts."""
    return PARTS.index(f"{name} {side}".strip())


@dataclass(frozen=True, eq=False)
class Figure:
    """Per-vertex data that all bodies of a rig share; built once per rig, by `Figure.of`.

    ``of_joint`` is the part of every joint, ``share`` the weight of each part at every vertex. ``reach`` is the position of
    a vertex along an arm (column 0) or a leg (column 1): 0 at the shoulder or hip, 1 at the elbow or knee, 2 at the wrist or
    ankle, more beyond, and -1 elsewhere. ``height`` is 0 at the root and 1 at the neck. ``skull`` is the position relative
    to the center of the head, in units of the head's size (z to the face).
    """

    rig: Rig
    of_joint: Int[Tensor, " J"]
    share: Float[Tensor, "V P"]
    reach: Float[Tensor, "V 2"]
    height: Float[Tensor, " V"]
    skull: Float[Tensor, "V 3"]
    mean_of_neighbours: csr_matrix

    @classmethod
    def of(cls, rig: Rig) -> Figure:
        """Build the figure of a rig from the mean of its bodies."""
        of_joint = torch.tensor([_part_of(name) for name in rig.names])
        share = torch.zeros(len(rig.weights), len(PARTS)).index_add_(1, of_joint, rig.weights)
        rest, heads = rig.rest.float().mean(0), rig.heads.mean(0)
        reach = torch.full((len(rest), 2), -1.0)
        for column, chain in enumerate((ARM, LEG)):
            for side in "LR":
                start = [part(name, side) for name in chain]
                bones = torch.stack([_along(rig, heads, name, side, rest) for name in chain], 1)
                shares = share[:, start]
                on_limb = shares.sum(1) > 0.25
                value = (shares * (bones.clamp(0, None) + torch.arange(3.0))).sum(1) / shares.sum(1).clamp_min(1e-9)
                reach[on_limb, column] = value[on_limb]
        bottom, top = heads[rig.joint("root"), 1], heads[rig.joint("neck01"), 1]
        head_share = share[:, part("head")]
        middle = (head_share[:, None] * rest).sum(0) / head_share.sum()
        size = ((head_share[:, None] * (rest - middle)).square().sum(0) / head_share.sum()).sqrt().mean() * 3**0.5
        height = (rest[:, 1] - bottom) / (top - bottom)
        neighbours = mean_of_neighbours(rig.faces.numpy(), len(rest)).astype(np.float32)
        neighbours.sort_indices()  # fixes the order of summation
        return cls(rig, of_joint, share, reach, height, (rest - middle) / size, neighbours)

    def axes(self, heads: Float[Tensor, "B J 3"]) -> Float[Tensor, "B P 3 3"]:
        """Orthonormal axes of every part of bodies at rest; rows are across, along and out of the part."""
        part_axes = []
        for each in PARTS:
            name, side = (each[:-2], each[-1]) if each[:-2] in SIDED else (each, "")
            start, end = joints_of(self.rig, name, side)
            along = torch.nn.functional.normalize(heads[:, end] - heads[:, start], dim=-1)
            if name not in SIDED:
                along = torch.tensor([0.0, 1.0, 0.0]).expand_as(along)
            ahead = torch.tensor([0.0, 1.0, 0.0] if name == "foot" else [0.0, 0.0, 1.0]).expand_as(along)
            across = torch.nn.functional.normalize(torch.linalg.cross(along, ahead), dim=-1)
            part_axes.append(torch.stack([across, along, torch.linalg.cross(across, along)], -2))
        return torch.stack(part_axes, 1)

    def smooth(self, values: Float[Tensor, "B V C"], rounds: int) -> Float[Tensor, "B V C"]:
        """Move vertex values halfway to the mean of their neighbours, ``rounds`` times."""
        flat = values.transpose(0, 1).flatten(1)
        for _ in range(rounds):
            flat = 0.5 * flat + 0.5 * self._means(flat)
        result: Tensor = flat.unflatten(1, (len(values), -1)).transpose(0, 1)
        return result

    def _means(self, values: Float[Tensor, "V C"]) -> Float[Tensor, "V C"]:
        if values.device.type == "cpu":  # SciPy is faster there, and as exact
            return torch.from_numpy(self.mean_of_neighbours @ values.numpy())
        result: Tensor = self._sparse @ values
        return result

    @cached_property
    def _sparse(self) -> Tensor:
        matrix = self.mean_of_neighbours
        starts, columns, values = map(torch.from_numpy, (matrix.indptr, matrix.indices, matrix.data))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns that CSR tensors are in beta
            return torch.sparse_csr_tensor(starts, columns, values, matrix.shape, device=self.share.device)

    def normals(self, verts: Float[Tensor, "B V 3"]) -> Float[Tensor, "B V 3"]:
        """Smoothed unit normals."""
        a, b, c = (verts[:, self.rig.faces[:, k]] for k in range(3))
        area = torch.linalg.cross(b - a, c - a)
        total = torch.zeros_like(verts)
        for k in range(3):
            total.index_add_(1, self.rig.faces[:, k], area)
        return torch.nn.functional.normalize(self.smooth(total, _ROUNDS), dim=-1)


def joints_of(rig: Rig, name: str, side: str = "") -> tuple[int, int]:
    """Start and end joint of the axis of a part."""
    _, start, end = _JOINTS[name]
    suffix = f".{side}" if side else ""
    return rig.joint(start + suffix), rig.joint(end + suffix)


def _part_of(joint: str) -> int:
    name = next(name for name, (stems, *_) in _JOINTS.items() if joint.startswith(stems))
    return part(name, joint[-1] if name in SIDED else "")


def _along(rig: Rig, heads: Tensor, name: str, side: str, rest: Tensor) -> Tensor:
    start, end = (heads[k] for k in joints_of(rig, name, side))
    return (rest - start) @ (end - start) / (end - start).square().sum()
