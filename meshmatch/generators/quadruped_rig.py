"""The rig of the dog from which animals are generated: a symmetric mesh with a skeleton.

It faces +z, stands along y and has its left at +x, and has the vertices and triangles of the template of four-legged
animals. The file is part of the package: the dog of dm_control (Apache-2.0) with its eyes closed, decimated, made symmetric
and transferred to the template's vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import TemplateError
from meshmatch.geometry.triangles import edges_of
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import save_arrays

# Prefixes of the names of each group's bones.
_GROUPS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("trunk", ("torso", "L_")), ("pelvis", ("pelvis",)), ("tail", ("Ca_",)), ("neck", ("C_",)), ("skull", ("skull",)),
    ("jaw", ("jaw",)), ("hip", ("upper_leg",)), ("knee", ("lower_leg",)), ("hock", ("foot",)), ("toe", ("toe",)),
    ("scapula", ("scapula",)), ("shoulder", ("upper_arm",)), ("elbow", ("lower_arm",)), ("wrist", ("hand",)),
    ("finger", ("finger",)),
)  # fmt: skip
# Least and largest rotation, degrees, about x (positive turns the front down, legs back), y (to the left) and z (left side
# down).
LIMITS: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "trunk": ((-9, 9), (-7, 7), (-5, 5)), "pelvis": ((-40, 25), (-12, 12), (-10, 10)),
    "tail": ((-22, 28), (-20, 20), (-4, 4)), "neck": ((-18, 22), (-18, 18), (-8, 8)),
    "skull": ((-65, 50), (-40, 40), (-30, 30)), "jaw": ((-36, 70), (-4, 4), (0, 0)),
    "hip": ((-80, 55), (-25, 25), (-35, 35)), "knee": ((-45, 110), (-8, 8), (-6, 6)),
    "hock": ((-110, 50), (-8, 8), (-6, 6)), "toe": ((-50, 75), (-12, 12), (-8, 8)),
    "scapula": ((-20, 25), (-6, 6), (-6, 6)), "shoulder": ((-60, 60), (-20, 20), (-30, 30)),
    "elbow": ((-115, 45), (-8, 8), (-6, 6)), "wrist": ((-35, 135), (-10, 10), (-8, 8)),
    "finger": ((-50, 75), (-12, 12), (-8, 8)),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class AnimalRig:
    """A mesh at rest with a skeleton, metres; reflection at x = 0 maps vertex v to ``mirror[v]``."""

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    mirror: Int[Ints, " V"]
    names: tuple[str, ...]  # names of the bones; parents precede children
    parents: Int[Ints, " B"]  # -1 for the root
    joints: Float[Floats, "B 3"]  # start of each bone
    weights: Float[Floats, "V B"]  # rows sum to 1

    def share(self, *starts: str) -> Float[Floats, " V"]:
        """Total weight at every vertex of the bones whose names start with one of ``starts``."""
        return np.asarray(self.weights[:, [name.startswith(starts) for name in self.names]].sum(1))

    def axis(self, bone: int, groups: Sequence[str]) -> Float[Floats, " 3"]:
        """Unit vector along a bone: towards its children (of its own group, if any), or away from its parent."""
        children = np.flatnonzero(self.parents == bone).tolist()
        ends = [child for child in children if groups[child] == groups[bone]] or children
        along = self.joints[ends].mean(0) if ends else 2 * self.joints[bone] - self.joints[self.parents[bone]]
        along = along - self.joints[bone]
        size = np.linalg.norm(along)
        return np.asarray(along / size) if size > 1e-9 else np.array([0.0, -1.0, 0.0])

    def smoothed(self, values: Floats, rounds: int) -> Floats:
        """Vertex values after ``rounds`` steps halfway to the mean of their neighbours."""
        for _ in range(rounds):
            values = 0.5 * values + 0.5 * (self._neighbours @ values)
        return values

    @cached_property
    def _neighbours(self) -> csr_matrix:
        return mean_of_neighbours(self.faces, len(self.verts))


def skinned(
    rig: AnimalRig, verts: Float[Floats, "V 3"], scales: Float[Floats, "B 3 3"], angles: Float[Floats, "B 3"]
) -> Float[Floats, "V 3"]:
    """Scale and rotate bones, and deform the skin by linear blend skinning; units as in the rig."""
    turns = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    places = rig.joints.copy()
    posed = np.zeros_like(verts)
    for bone, parent in enumerate(rig.parents):
        if parent >= 0:
            turns[bone] = turns[parent] @ turns[bone]
            places[bone] = places[parent] + turns[parent] @ scales[parent] @ (rig.joints[bone] - rig.joints[parent])
        affected = rig.weights[:, bone] > 0
        by_bone = (verts[affected] - rig.joints[bone]) @ (turns[bone] @ scales[bone]).T + places[bone]
        posed[affected] += rig.weights[affected, bone, None] * by_bone
    return posed


def group_of(bone: str) -> str:
    """Group of a bone."""
    return next(group for group, starts in _GROUPS if bone.startswith(starts))


def rig_file() -> Path:
    """Path of the dog's rig in the package."""
    return bundled_folder() / "rigs" / "dog.safetensors"


def load_rig(path: Path | None = None) -> AnimalRig:
    """Load the dog, or another rig that `save_rig` wrote; `TemplateError` if the file is missing or damaged."""
    path = path or rig_file()
    try:
        arrays = load_file(path)
    except (SafetensorError, OSError) as error:
        raise TemplateError(f"the rig {path} is missing or damaged", "install meshmatch again") from error
    verts, joints = arrays["verts"].astype(np.float64), arrays["joints"].astype(np.float64)
    faces, mirror, parents = (arrays[name].astype(np.int64) for name in ("faces", "mirror", "parents"))
    weights = np.zeros((len(verts), len(joints)))
    weights[arrays["carried"], arrays["carriers"]] = arrays["weights"]
    names = tuple(arrays["names"].tobytes().decode().split("\n"))
    return AnimalRig(verts, faces, mirror, names, parents, joints, weights)


def save_rig(rig: AnimalRig, path: Path, **words: str) -> None:
    """Write a rig as a safetensors file; ``words`` are metadata, such as its source."""
    carried, carriers = np.nonzero(rig.weights)
    arrays: dict[str, np.ndarray] = {
        "verts": rig.verts.astype(np.float32),
        "faces": rig.faces.astype(np.int32),
        "mirror": rig.mirror.astype(np.int32),
        "names": np.frombuffer("\n".join(rig.names).encode(), np.uint8),
        "parents": rig.parents.astype(np.int32),
        "joints": rig.joints.astype(np.float32),
        "carried": carried.astype(np.int32),
        "carriers": carriers.astype(np.int32),
        "weights": rig.weights[carried, carriers].astype(np.float32),
    }
    save_arrays(path, arrays, words)


def mean_of_neighbours(faces: Int[Ints, "M 3"], count: int) -> csr_matrix:
    """Sparse (count, count) matrix that averages vertex values over each vertex's neighbours."""
    edges = edges_of(faces).vertices
    a, b = np.concatenate([edges, edges[:, ::-1]]).T
    adjacency = coo_matrix((np.ones(len(a)), (a, b)), (count, count)).tocsr()
    return (diags(1 / np.maximum(np.asarray(adjacency.sum(1)).reshape(-1), 1)) @ adjacency).tocsr()


def ramp(values: Floats, low: float, high: float) -> Floats:
    """Integral of `smooth_step`: 0 up to ``low``, slope 1 above ``high``."""
    t = np.clip((values - low) / (high - low), 0, 1)
    return np.asarray((high - low) * (t**3 - 0.5 * t**4) + np.maximum(values - high, 0))


def smooth_step(values: Floats, low: float, high: float) -> Floats:
    """Cubic step: 0 up to ``low``, 1 above ``high``, smooth in between."""
    t = np.clip((values - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))
