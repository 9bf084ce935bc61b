"""Files of blendshapes: a glTF scene, one mesh per shape, or arrays (.npz)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError
from meshmatch.outputs import as_path, plain_text
from meshmatch.shapes.blend_shapes import BlendShapes
from meshmatch.shapes.files import SUFFIXES, load_shape
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.formats.gltf_morphs import read_morphs
from meshmatch.shapes.input_files import check_input_file, read_bytes, read_npz, suffix_of
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_npz

_FORMAT = "meshmatch blendshapes 1"
_MAX_DISPLACEMENT = 1e18
_HINT = (
    "a .glb with morph targets, an .npz that meshmatch wrote, or a mesh for each shape with the source's own vertices"
)


def load_blend_shapes(given: str | Path | Sequence[str | Path], neutral: Shape) -> BlendShapes:
    """Read the blendshapes of a mesh.

    Parameters
    ----------
    given
        A glTF scene with morph targets; an .npz; or meshes with the vertices of ``neutral``, each named like its shape:
        their files, or a folder of them. Meshes equal to ``neutral`` are skipped.
    neutral
        The mesh without expression.

    Returns
    -------
    BlendShapes
        In the order of the scene, the arrays or the list; those of a folder by name.

    Raises
    ------
    InputError
        A file cannot be read, has no blendshapes, or those of another mesh; or two shapes have the same name.
    """
    files = [as_path(given)] if isinstance(given, str | Path) else [as_path(each) for each in given]
    if len(files) == 1 and files[0].is_dir():
        folder = files[0]
        files = sorted(file for file in folder.iterdir() if suffix_of(file) in SUFFIXES and file.is_file())
        if not files:
            raise InputError(f"there are no shapes in {folder}", _HINT)
    elif len(files) == 1 and files[0].suffix.lower() in (".npz", *gltf.SUFFIXES):
        path = check_input_file(files[0])
        shapes = _from_arrays(path) if path.suffix.lower() == ".npz" else read_morphs(path, read_bytes(path))
        if shapes.moves.shape[1] != neutral.V:
            raise _other_mesh(path.name, shapes.moves.shape[1], neutral)
        return shapes
    moves: dict[str, np.ndarray] = {}
    for file in files:
        shape = load_shape(file)
        if shape.V != neutral.V:
            raise _other_mesh(file.name, shape.V, neutral)
        is_valid = shape.valid & neutral.valid
        move = np.where(is_valid[:, None], shape.verts - neutral.verts, 0.0).astype(np.float32)
        name = plain_text(file.stem)
        if name in moves:
            raise InputError(f"two shapes are called {name}", "rename one of the files")
        if move.any():
            moves[name] = move
    if not moves:
        raise InputError("the files of blendshapes are all like the source", _HINT)
    return BlendShapes(tuple(moves), np.stack(list(moves.values())), np.zeros(len(moves)))


def save_blend_shapes(path: Path, shapes: BlendShapes) -> None:
    """Write names and displacements as arrays (.npz)."""
    write_npz(path, {"format": _FORMAT, "names": np.array(shapes.names, np.str_), "moves": shapes.moves})


def _from_arrays(path: Path) -> BlendShapes:
    arrays = read_npz(path, ("names", "moves"))
    moves, names = arrays.get("moves"), tuple(plain_text(str(name)) for name in np.ravel(arrays.get("names", ())))
    if moves is None or moves.ndim != 3 or moves.shape[2] != 3 or moves.dtype.kind not in "iuf":
        raise InputError(f"{path.name} does not hold 'moves', an array (K, V, 3) of numbers", _HINT)
    if not len(moves) or len(set(names)) != len(moves):
        raise InputError(f"{path.name} has {len(moves)} shapes, and {len(set(names))} different names", _HINT)
    if not (np.abs(moves) < _MAX_DISPLACEMENT).all():
        raise InputError(f"{path.name}: a move is no number, or too large", "is it the right file?")
    return BlendShapes(names, moves.astype(np.float32), np.zeros(len(names)))


def _other_mesh(name: str, vertices: int, neutral: Shape) -> InputError:
    other = f"{name} has {vertices} vertices, but {neutral.name or 'the source'} has {neutral.V}"
    return InputError(other, "blendshapes have the vertices of the source, in its order")
