"""Make the rig of generated animals from the free dog of dm_control (Apache-2.0, `locomotion/walkers/assets/dog_v2`).

``python -m meshmatch.experiments.dog_rig [-o FILE]``, after ``pip install --no-deps dm_control``.

Its skin is a file of MuJoCo: vertices, and the bones that carry them. It is welded, turned so that the animal faces +z,
stands along y and has its left at +x, its eyeballs are closed over, and one half is decimated and mirrored. Decimation
differs from machine to machine in a few vertices, so that the result is laid on those of the included template.
"""

from __future__ import annotations

import importlib.util
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.generators.quadruped_rig import AnimalRig, mean_of_neighbours, rig_file, save_rig, smooth_step
from meshmatch.generators.quadrupeds import resting_animal
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import Template, read_template

SKIN, SKELETON = "dog_skin.skn", "dog.xml"
_INSIDE = Path("locomotion", "walkers", "assets", "dog_v2")  # of the installed package
_NAME_BYTES = 40
FACES = 9_800
"""Triangles of the rig: no more than a template's low resolution has, so that `prepare` keeps all of them."""
# Metres, in the rig's frame: the sphere around the left eye whose vertices become a flat membrane.
_EYE, _EYE_RADIUS = np.array([0.0255, 0.705, 0.359]), 0.0142
_TONGUE = 0.0165  # half its width
# Shares of the jaw's weight in the head's between which a vertex turns from the skull's to the jaw's.
_JAW_FROM, _JAW_TO = 0.3, 0.75


@runner.command
def main(
    output: Annotated[
        Path | None, Option("-o", "--output", help="where to write it; default: where the package has it")
    ] = None,
) -> runner.Report:
    template = read_template(bundled_folder() / "models" / "quadruped" / "template.safetensors")
    rig = laid_on(read_rig(), template)
    path = output or rig_file()
    save_rig(rig, path)
    record = {"vertices": len(rig.verts), "triangles": len(rig.faces), "bones": len(rig.names)}
    return runner.Report(record, notes=[f"wrote {path}"])


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


def find_assets(folder: str | Path | None = None) -> Path:
    """The folder of the dog's files: the one that is named, or that of the installed dm_control.

    Raises
    ------
    InputError
        There are none.
    """
    if folder is None:
        found = importlib.util.find_spec("dm_control")
        roots = list(found.submodule_search_locations or []) if found is not None else []
        folder = Path(roots[0]) / _INSIDE if roots else None
    hint = "pip install --no-deps dm_control: its dog is all that is needed"
    if folder is None:
        raise InputError("dm_control, which has the dog, is not installed", hint)
    if missing := [name for name in (SKIN, SKELETON) if not (Path(folder) / name).is_file()]:
        raise InputError(f"{folder} lacks {missing[0]}", hint)
    return Path(folder)


def read_rig(folder: str | Path | None = None, faces: int = FACES) -> AnimalRig:
    """The dog as a symmetric rig with about so many triangles; `InputError` if its files are missing or damaged."""
    assets = find_assets(folder)
    verts, triangles, names, joints, weights = read_skin(assets / SKIN)
    parents = read_parents(assets / SKELETON, names)
    return build_rig(verts, triangles, names, parents, joints, weights, faces)


def read_skin(
    path: Path,
) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"], tuple[str, ...], Float[Floats, "B 3"], Float[Floats, "V B"]]:
    """Vertices, triangles, names and places of the bones, and weights of a MuJoCo skin, as the file has them.

    Raises
    ------
    InputError
        It is damaged.
    """
    content = path.read_bytes()
    at = 16

    def take(count: int, kind: str) -> np.ndarray:
        nonlocal at
        at += 4 * count
        return np.frombuffer(content, kind, count, at - 4 * count)

    try:
        nv, nt, nf, nb = struct.unpack("<4i", content[:16])
        verts = take(3 * nv, "<f4").reshape(-1, 3).astype(np.float64)
        take(2 * nt, "<f4")
        faces = take(3 * nf, "<i4").reshape(-1, 3).astype(np.int64)
        names, joints, weights = [], np.zeros((nb, 3)), np.zeros((nv, nb))
        for bone in range(nb):
            names.append(content[at : at + _NAME_BYTES].split(b"\0")[0].decode())
            at += _NAME_BYTES
            joints[bone] = take(7, "<f4")[:3]  # a rotation follows, which the dog's bones do not use
            (count,) = take(1, "<i4")
            ids = take(int(count), "<i4")
            weights[ids, bone] = take(int(count), "<f4")
        weights /= weights.sum(1, keepdims=True)
    except (struct.error, ValueError, IndexError) as error:
        raise InputError(f"{path.name} is not a skin of MuJoCo", "install dm_control again") from error
    return verts, faces, tuple(names), joints, weights


def read_parents(path: Path, names: tuple[str, ...]) -> Int[Ints, " B"]:
    """The nearest ancestor of every bone in a MuJoCo model that is a bone itself; -1 for the root."""
    parents = np.full(len(names), -1, np.int64)

    def visit(element: ElementTree.Element, above: int) -> None:
        for child in element:
            name, own = child.get("name"), above
            if child.tag == "body" and name in names:
                own = names.index(name)
                parents[own] = above
            visit(child, own)

    try:
        visit(ElementTree.parse(path).getroot(), -1)
    except ElementTree.ParseError as error:
        raise InputError(f"{path.name} is not a model of MuJoCo", "install dm_control again") from error
    return parents


def build_rig(
    verts: Float[Floats, "N 3"],
    faces: Int[Ints, "M 3"],
    names: tuple[str, ...],
    parents: Int[Ints, " B"],
    joints: Float[Floats, "B 3"],
    weights: Float[Floats, "N B"],
    count: int,
) -> AnimalRig:
    """Weld, turn (from x forward, y left, z up), decimate one half to ``count`` / 2 triangles, and mirror it."""
    verts, faces, weights = _weld(verts, faces, weights)
    verts, joints = verts[:, [1, 2, 0]], joints[:, [1, 2, 0]]
    order = _parents_first(parents)
    names, joints, weights = tuple(names[k] for k in order), joints[order], weights[:, order]
    parents = np.array([-1 if parents[k] < 0 else int(np.flatnonzero(order == parents[k])[0]) for k in order])
    verts = harmonic(verts, faces, _eyes_and_tongue(verts))
    # On the left, with the plane of symmetry as its border.
    left = (verts[faces, 0] > -1e-9).all(1)
    half = decimate(Shape(verts, faces[left], "half"), count // 2)
    points = np.array(half.verts)
    points[np.abs(points[:, 0]) < 1e-6, 0] = 0.0
    middle = points[:, 0] <= 0
    points[middle, 0] = 0.0
    other = np.where(middle, np.arange(len(points)), len(points) + np.cumsum(~middle) - 1)
    whole = np.concatenate([points, points[~middle] * [-1, 1, 1]])
    mirror = np.concatenate([other, np.flatnonzero(~middle)]).astype(np.int64)
    triangles = np.concatenate([half.faces, other[half.faces][:, ::-1]])
    own = weights[cKDTree(verts).query(whole)[1]]
    own = _jaw_apart(symmetric(own, mirror, names), names)
    for bone in (k for k, name in enumerate(names) if name.startswith("C_")):
        # Halfway from the spine to the middle of the neck, so that necks grow thick on both sides.
        joints[bone] = 0.5 * (joints[bone] + own[:, bone] @ whole / own[:, bone].sum())
    return AnimalRig(whole, triangles.astype(np.int64), mirror, names, parents, joints, own)


def _weld(
    verts: Float[Floats, "N 3"], faces: Int[Ints, "M 3"], weights: Float[Floats, "N B"]
) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"], Float[Floats, "V B"]]:
    """One vertex where several lie, and no triangle without three of them."""
    places, first, own = np.unique(np.round(verts, 6), axis=0, return_index=True, return_inverse=True)
    corners = own.reshape(-1)[faces]
    a, b, c = corners.T
    return places, corners[(a != b) & (b != c) & (c != a)], weights[first]


def _parents_first(parents: Int[Ints, " B"]) -> Int[Ints, " B"]:
    depth = np.zeros(len(parents), np.int64)
    for bone in range(len(parents)):
        above = parents[bone]
        while above >= 0:
            depth[bone] += 1
            above = parents[above]
    return np.argsort(depth, kind="stable")


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


if __name__ == "__main__":
    sys.exit(main())
