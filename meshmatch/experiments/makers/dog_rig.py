"""Make the rig of generated animals from the dog of dm_control (Apache-2.0, `locomotion/walkers/assets/dog_v2`).

``python -m meshmatch.experiments.makers.dog_rig -o FILE``, after ``pip install --no-deps dm_control``.

The eyes are closed, and one half is decimated and mirrored. As the result of decimation depends on the machine in a few
vertices, it is then transferred to the vertices of the bundled template.
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
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import Template, read_template

SOURCE = (
    "the dog of dm_control, locomotion/walkers/assets/dog_v2, Copyright The dm_control Authors; changed: eyes closed, "
    "decimated, mirrored, joints of the neck moved"
)
FILES = ("dog_v2/dog_skin.skn", "dog_v2/dog.xml")
FACES = 9_800
"""Number of triangles of the rig: no more than a template's low resolution has, so that `prepare` keeps all of them."""
# Center and radius of the sphere around the left eye whose vertices become a flat membrane; metres, in the rig's frame.
_EYE, _EYE_RADIUS = np.array([0.0255, 0.705, 0.359]), 0.0142
_TONGUE = 0.0165  # half the width of the tongue
# Range of the jaw's share of the head's weight in which a vertex changes over from the skull to the jaw.
_JAW_FROM, _JAW_TO = 0.3, 0.75


def transfer_rig(rig: AnimalRig, template: Template) -> AnimalRig:
    """Transfer a rig to the template's vertices and triangles, by the three nearest vertices at rest (inverse squares)."""
    rest = Shape(resting_animal(rig), rig.faces, "quadruped")
    distance, nearest = cKDTree(sqrt_area_frame(rest).apply(rest.verts)).query(template.shape.verts, 3)
    nearest_weights = 1 / np.maximum(distance, 1e-9) ** 2
    nearest_weights /= nearest_weights.sum(1, keepdims=True)
    verts = np.einsum("vk,vkd->vd", nearest_weights, rig.verts[nearest])
    weights = np.einsum("vk,vkb->vb", nearest_weights, rig.weights[nearest])
    mirror = cKDTree(verts).query(verts * [-1, 1, 1])[1].astype(np.int64)
    verts = 0.5 * (verts + verts[mirror] * [-1, 1, 1])
    weights = symmetric(weights, mirror, rig.names)
    weights[weights < 1e-4] = 0.0
    weights /= weights.sum(1, keepdims=True)
    return replace(rig, verts=verts, faces=template.shape.faces.astype(np.int64), mirror=mirror, weights=weights)


def symmetric(weights: Float[Floats, "V B"], mirror: Int[Ints, " V"], names: tuple[str, ...]) -> Float[Floats, "V B"]:
    """Symmetrise weights: the mean of those of each vertex and bone and of their mirror images."""
    return np.asarray(0.5 * (weights + weights[mirror][:, [names.index(_other_side(name)) for name in names]]))


def read_dog(faces: int = FACES) -> AnimalRig:
    """Read the dog as a symmetric rig with about ``faces`` triangles; `InputError` if a file is missing or damaged."""
    return symmetric_rig(read_animal(*find_files(*FILES)), faces)


def symmetric_rig(dog: AnimalRig, count: int) -> AnimalRig:
    """Decimate the left half of a rig to ``count`` / 2 triangles, and mirror it."""
    names, joints = dog.names, dog.joints.copy()
    verts = harmonic(dog.verts, dog.faces, _eyes_and_tongue(dog.verts))
    # The left half, bounded by the plane of symmetry.
    left = (verts[dog.faces, 0] > -1e-9).all(1)
    half = decimate(Shape(verts, dog.faces[left], "half"), count // 2)
    points = np.array(half.verts)
    points[np.abs(points[:, 0]) < 1e-6, 0] = 0.0
    on_plane = points[:, 0] <= 0
    points[on_plane, 0] = 0.0
    partner = np.where(on_plane, np.arange(len(points)), len(points) + np.cumsum(~on_plane) - 1)
    whole = np.concatenate([points, points[~on_plane] * [-1, 1, 1]])
    mirror = np.concatenate([partner, np.flatnonzero(~on_plane)]).astype(np.int64)
    triangles = np.concatenate([half.faces, partner[half.faces][:, ::-1]])
    weights = dog.weights[cKDTree(verts).query(whole)[1]]
    weights = _separate_jaw(symmetric(weights, mirror, names), names)
    for bone in (k for k, name in enumerate(names) if name.startswith("C_")):
        # Move joints from the spine halfway to the middle of the neck, so that necks thicken on both sides.
        joints[bone] = 0.5 * (joints[bone] + weights[:, bone] @ whole / weights[:, bone].sum())
    return AnimalRig(whole, triangles.astype(np.int64), mirror, names, dog.parents, joints, weights)


def _other_side(name: str) -> str:
    """Name of the corresponding bone on the other side, or of the bone itself."""
    return {"_L": name[:-2] + "_R", "_R": name[:-2] + "_L"}.get(name[-2:], name)


def _eyes_and_tongue(verts: Float[Floats, "N 3"]) -> Bool[Bools, " N"]:
    """Vertices of eyeballs, lids and tongue, which are replaced by membranes."""
    x, y, z = verts.T
    selected = (np.abs(x) < _TONGUE) & (z > 0.355) & (y > 0.6035 + 0.3 * (0.42 - z)) & (y < 0.64)
    for side in (1.0, -1.0):
        selected |= np.linalg.norm(verts - _EYE * [side, 1, 1], axis=1) < _EYE_RADIUS
    return np.asarray(selected)


def harmonic(verts: Float[Floats, "N 3"], faces: Int[Ints, "M 3"], free: Bool[Bools, " N"]) -> Float[Floats, "N 3"]:
    """Harmonic interpolation: free vertices move to the mean of their neighbours, all others are fixed."""
    if not free.any():
        return verts
    laplacian = (diags(np.ones(len(verts))) - mean_of_neighbours(faces, len(verts))).tocsr()
    moved = verts.copy()
    moved[free] = spsolve(laplacian[free][:, free].tocsc(), -(laplacian[free][:, ~free] @ verts[~free]))
    return moved


def _separate_jaw(weights: Float[Floats, "V B"], names: tuple[str, ...]) -> Float[Floats, "V B"]:
    """Sharpen the weights of jaw and skull, so that the jaw alone moves the lower lip and the mouth can close."""
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
    output: Annotated[Path, Option("-o", "--output", help="output file; in the package it is below templates/rigs")],
) -> runner.Report:
    template = read_template(bundled_folder() / "models" / "quadruped" / "template.safetensors")
    rig = transfer_rig(read_dog(), template)
    save_rig(rig, output, source=SOURCE, licence="Apache-2.0")
    record = {"vertices": len(rig.verts), "triangles": len(rig.faces), "bones": len(rig.names)}
    return runner.Report(record, notes=[f"wrote {output}"])
