"""Make the rig of generated animals from the free dog of dm_control (Apache-2.0, `locomotion/walkers/assets/dog_v2`).

``python -m meshmatch.experiments.makers.dog_rig -o FILE``, after ``pip install --no-deps dm_control``.

Its eyeballs are closed over, and one half is decimated and mirrored. Decimation differs from machine to machine in a few
vertices, so that the result is laid on those of the included template.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import spsolve
from typer import Option

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.makers.mujoco_skin import find_files, read_animal
from meshmatch.generators.quadruped_rig import AnimalRig, mean_of_neighbours, save_rig, smooth_step
from meshmatch.generators.quadrupeds import resting_animal
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import Template, read_template

SOURCE = (
    "the dog of dm_control, locomotion/walkers/assets/dog_v2, Copyright The dm_control Authors; changed: eyes closed, "
    "decimated, mirrored, joints of the neck moved"
)
FILES = ("dog_v2/dog_skin.skn", "dog_v2/dog.xml")
FACES = 9_800
"""Triangles of the rig: no more than a template's low resolution has, so that `prepare` keeps all of them."""
# Metres, in the rig's frame: the sphere around the left eye whose vertices become a flat membrane.
_EYE, _EYE_RADIUS = np.array([0.0255, 0.705, 0.359]), 0.0142
_TONGUE = 0.0165  # half its width
# Shares of the jaw's weight in the head's between which a vertex turns from the skull's to the jaw's.
_JAW_FROM, _JAW_TO = 0.3, 0.75


def laid_on(rig: AnimalRig, template: Template) -> AnimalRig:
    """The rig with the template's vertices and triangles: each from the three nearest at rest (inverse squares)."""
    rest = Shape(resting_animal(rig), rig.faces, "quadruped")
    far, near = cKDTree(sqrt_area_frame(rest).apply(rest.verts)).query(template.shape.verts, 3)
    shares = 1 / np.maximum(far, 1e-9) ** 2
    shares /= shares.sum(1, keepdims=True)
    verts = np.einsum("vk,vkd->vd", shares, rig.verts[near])
    weights = np.einsum("vk,vkb->vb", shares, rig.weights[near])
    mirror = cKDTree(verts).query(verts * [-1, 1, 1])[1].astype(np.int64)
    verts = 0.5 * (verts + verts[mirror] * [-1, 1, 1])
    weights = symmetric(weights, mirror, rig.names)
    weights[weights < 1e-4] = 0.0
    weights /= weights.sum(1, keepdims=True)
    return replace(rig, verts=verts, faces=template.shape.faces.astype(np.int64), mirror=mirror, weights=weights)


def symmetric(weights: Float[Floats, "V B"], mirror: Int[Ints, " V"], names: tuple[str, ...]) -> Float[Floats, "V B"]:
    """The mean of the weights and of those of the other side's vertices for the other side's bones."""
    return np.asarray(0.5 * (weights + weights[mirror][:, [names.index(_other_side(name)) for name in names]]))


def read_dog(faces: int = FACES) -> AnimalRig:
    """The dog as a symmetric rig with about so many triangles; `InputError` if its files are missing or damaged."""
    return symmetric_rig(read_animal(*find_files(*FILES)), faces)


def symmetric_rig(dog: AnimalRig, count: int) -> AnimalRig:
    """One half decimated to ``count`` / 2 triangles, and mirrored."""
    names, joints = dog.names, dog.joints.copy()
    verts = harmonic(dog.verts, dog.faces, _eyes_and_tongue(dog.verts))
    # On the left, with the plane of symmetry as its border.
    left = (verts[dog.faces, 0] > -1e-9).all(1)
    half = decimate(Shape(verts, dog.faces[left], "half"), count // 2)
    points = np.array(half.verts)
    points[np.abs(points[:, 0]) < 1e-6, 0] = 0.0
    middle = points[:, 0] <= 0
    points[middle, 0] = 0.0
    other = np.where(middle, np.arange(len(points)), len(points) + np.cumsum(~middle) - 1)
    whole = np.concatenate([points, points[~middle] * [-1, 1, 1]])
    mirror = np.concatenate([other, np.flatnonzero(~middle)]).astype(np.int64)
    triangles = np.concatenate([half.faces, other[half.faces][:, ::-1]])
    own = dog.weights[cKDTree(verts).query(whole)[1]]
    own = _jaw_apart(symmetric(own, mirror, names), names)
    for bone in (k for k, name in enumerate(names) if name.startswith("C_")):
        # Halfway from the spine to the middle of the neck, so that necks grow thick on both sides.
        joints[bone] = 0.5 * (joints[bone] + own[:, bone] @ whole / own[:, bone].sum())
    return AnimalRig(whole, triangles.astype(np.int64), mirror, names, dog.parents, joints, own)


def _other_side(name: str) -> str:
    """The bone's partner on the other side, or itself."""
    return {"_L": name[:-2] + "_R", "_R": name[:-2] + "_L"}.get(name[-2:], name)


def _eyes_and_tongue(verts: Float[Floats, "N 3"]) -> Bool[Bools, " N"]:
    """Vertices of the eyeballs with the lids around them, and of the tongue: membranes are enough."""
    x, y, z = verts.T
    mouth = (np.abs(x) < _TONGUE) & (z > 0.355) & (y > 0.6035 + 0.3 * (0.42 - z)) & (y < 0.64)
    for side in (1.0, -1.0):
        mouth |= np.linalg.norm(verts - _EYE * [side, 1, 1], axis=1) < _EYE_RADIUS
    return np.asarray(mouth)


def harmonic(verts: Float[Floats, "N 3"], faces: Int[Ints, "M 3"], free: Bool[Bools, " N"]) -> Float[Floats, "N 3"]:
    """Vertices that are free go to the mean of their neighbours, all others stay."""
    if not free.any():
        return verts
    pull = (diags(np.ones(len(verts))) - mean_of_neighbours(faces, len(verts))).tocsr()
    moved = verts.copy()
    moved[free] = spsolve(pull[free][:, free].tocsc(), -(pull[free][:, ~free] @ verts[~free]))
    return moved


def _jaw_apart(weights: Float[Floats, "V B"], names: tuple[str, ...]) -> Float[Floats, "V B"]:
    """The jaw alone moves the lower lip, the skull alone eyes and nose, so that a mouth can close."""
    if "jaw" not in names:
        return weights
    jaw, skull = names.index("jaw"), names.index("skull")
    both = weights[:, jaw] + weights[:, skull]
    share = smooth_step(weights[:, jaw] / np.maximum(both, 1e-12), _JAW_FROM, _JAW_TO)
    weights = weights.copy()
    weights[:, jaw], weights[:, skull] = both * share, both * (1 - share)
    return weights


@runner.command
def main(
    output: Annotated[Path, Option("-o", "--output", help="where to write it; the package has it in templates/rigs")],
) -> runner.Report:
    template = read_template(bundled_folder() / "models" / "quadruped" / "template.safetensors")
    rig = laid_on(read_dog(), template)
    save_rig(rig, output, source=SOURCE, licence="Apache-2.0")
    record = {"vertices": len(rig.verts), "triangles": len(rig.faces), "bones": len(rig.names)}
    return runner.Report(record, notes=[f"wrote {output}"])
