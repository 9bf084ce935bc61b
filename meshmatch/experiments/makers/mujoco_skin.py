"""Read the animals of dm_control (Apache-2.0): skins and skeletons in MuJoCo's formats."""

from __future__ import annotations

import importlib.util
import struct
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.generators.quadruped_rig import AnimalRig

_WALKERS = Path("locomotion", "walkers", "assets")  # relative to the installed package
_NAME_BYTES = 40
_HINT = "pip install --no-deps dm_control: its files are all that is needed"


def find_files(*names: str) -> list[Path]:
    """Find files of dm_control's walkers; `InputError` if it is not installed or a file is missing."""
    spec = importlib.util.find_spec("dm_control")
    roots = list(spec.submodule_search_locations or []) if spec is not None else []
    if not roots:
        raise InputError("dm_control, which has the animal, is not installed", _HINT)
    paths = [Path(roots[0], _WALKERS, name) for name in names]
    if missing := [path for path in paths if not path.is_file()]:
        raise InputError(f"{missing[0].parent} lacks {missing[0].name}", _HINT)
    return paths


def read_animal(skin: Path, skeleton: Path) -> AnimalRig:
    """Read a welded mesh with its bones, parents first, rotated so that it faces +z, stands along y and has its left at +x.

    ``mirror`` is the identity. `InputError` if a file is missing or damaged.
    """
    verts, faces, names, joints, weights = read_skin(skin)
    parents = read_parents(skeleton, names)
    verts, faces, weights = _weld(verts, faces, weights)
    order = _parents_first(parents)
    parents = np.array([-1 if parents[k] < 0 else int(np.flatnonzero(order == parents[k])[0]) for k in order])
    axes = [1, 2, 0]  # MuJoCo's x is forward, y left, z up
    bones = tuple(names[k] for k in order)
    identity = np.arange(len(verts))
    return AnimalRig(verts[:, axes], faces, identity, bones, parents, joints[order][:, axes], weights[:, order])


def read_skin(
    path: Path,
) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"], tuple[str, ...], Float[Floats, "B 3"], Float[Floats, "V B"]]:
    """Vertices, triangles, names and positions of the bones, and weights of a MuJoCo skin, in the file's axes.

    Raises
    ------
    InputError
        The file is damaged.
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
            joints[bone] = take(7, "<f4")[:3]  # the rotation after it is not used by the dog's bones
            (count,) = take(1, "<i4")
            ids = take(int(count), "<i4")
            weights[ids, bone] = take(int(count), "<f4")
        weights /= weights.sum(1, keepdims=True)
    except (struct.error, ValueError, IndexError) as error:
        raise InputError(f"{path.name} is not a skin of MuJoCo", "install dm_control again") from error
    return verts, faces, tuple(names), joints, weights


def read_parents(path: Path, names: tuple[str, ...]) -> Int[Ints, " B"]:
    """Parent of every bone in a MuJoCo model: the nearest ancestor that is a bone, -1 for the root."""
    parents = np.full(len(names), -1, np.int64)

    def visit(element: ElementTree.Element, above: int) -> None:
        for child in element:
            name, index = child.get("name"), above
            if child.tag == "body" and name in names:
                index = names.index(name)
                parents[index] = above
            visit(child, index)

    try:
        visit(ElementTree.parse(path).getroot(), -1)
    except ElementTree.ParseError as error:
        raise InputError(f"{path.name} is not a model of MuJoCo", "install dm_control again") from error
    return parents


def _weld(
    verts: Float[Floats, "N 3"], faces: Int[Ints, "M 3"], weights: Float[Floats, "N B"]
) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"], Float[Floats, "V B"]]:
    """Merge vertices at the same place, and drop degenerate triangles."""
    places, first, merged_index = np.unique(np.round(verts, 6), axis=0, return_index=True, return_inverse=True)
    corners = merged_index.reshape(-1)[faces]
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
