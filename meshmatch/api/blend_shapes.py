"""Blendshapes from one shape to another."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from meshmatch.api.results import MapPair
from meshmatch.api.transfer import MapLike, find_maps
from meshmatch.api.upright import turn_upright
from meshmatch.arrays import Brief
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import shortest_turns
from meshmatch.outputs import as_path, check_new_folder, folder_on_success, numbered_apart, replace_on_success
from meshmatch.shapes import tables
from meshmatch.shapes.blend_shape_files import load_blend_shapes, save_blend_shapes
from meshmatch.shapes.blend_shapes import BlendShapes, shape_normals
from meshmatch.shapes.files import ShapeLike, as_scene, as_shape
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.formats.gltf_edit import remembering
from meshmatch.shapes.formats.gltf_morphs import with_morphs
from meshmatch.shapes.formats.gltf_vrm import check_character
from meshmatch.shapes.moved_files import MovedFile, tell_left, with_look
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.blend_shapes import carry_moves

check_suffix = partial(tables.check_suffix, suffixes=(".glb", ".vrm", ".npz"), what="blendshapes")
_PLAIN = re.compile(r"[^\w .+-]")
_LONGEST = 100  # letters of a file's name


@dataclass(frozen=True, eq=False, repr=False)
class BlendShapesResult(Brief):
    """The blendshapes of the source on the target.

    Attributes
    ----------
    shapes
        ``names`` (K,), ``moves`` (K, V_target, 3) in the frame and unit of the target, ``weights`` and ``clips``.
    given
        Those of the source.
    still
        Names of shapes that move vertices of the source, and none of the target.
    target
        The target.
    maps
        The maps that were followed.
    seconds
        Time beside the match.
    stands_along_y
        Whether the source comes from a glTF file: the target then stands upright in a glb.
    original
        The target's file, if it came from one.

    Examples
    --------
    >>> result = meshmatch.transfer_shapes("face.glb", "scan.ply")
    >>> smiling = result.target.verts + result.shapes.moves[result.shapes.names.index("smile")]
    >>> result.save("face-of-the-scan.glb")
    """

    shapes: BlendShapes
    given: BlendShapes
    still: tuple[str, ...]
    target: Shape
    maps: MapPair
    seconds: float
    stands_along_y: bool = False
    original: Path | None = None

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import carried_html

        return carried_html("Blendshapes", self.maps.forward, None, {"shapes": ", ".join(self.shapes.names)})

    def save(self, path: str | Path) -> None:
        """Write the target with its shapes.

        Parameters
        ----------
        path
            A .glb: the target as it came, with morph targets and the clips that animate them; of another file than glTF
            with its texture or its one color. An .npz: ``names`` (K,) and
            ``moves`` (K, V, 3). Or a new folder, which gets an .obj for each shape: the target's own text with other
            positions, if it came as .obj.

        Raises
        ------
        OptionError
            The suffix is another one.
        OutputError
            A file cannot be written, or the folder is not empty.
        """
        path = as_path(path)
        suffix = check_shapes_output(path)
        check_character(self.original, path)
        if suffix:
            with replace_on_success(path) as temporary:
                write_shapes(self, path, temporary)
            return
        with folder_on_success(path) as folder:
            self._write_meshes(self._plans(folder))

    def _plans(self, folder: Path) -> list[MovedFile]:
        """The files of a folder of meshes: an .obj for each shape, and what an .obj takes along, once."""
        plain = (_PLAIN.sub("_", name)[:_LONGEST].strip(". ") or "shape" for name in self.shapes.names)
        files = [folder / f"{stem}.obj" for stem in numbered_apart(plain, "-", str.lower)]
        return MovedFile.planned_all(files, self.original)

    def _write_meshes(self, plans: Sequence[MovedFile]) -> None:
        normals = shape_normals(self.target, self.shapes.moves)
        for move, plan, now in zip(self.shapes.moves, plans, normals[1:], strict=True):
            shape = replace(self.target, verts=self.target.verts + move)
            plan.make_folders()
            plan.write(plan.files, shape, shortest_turns(normals[0], now))


def write_shapes(result: BlendShapesResult, output: Path, place: Path) -> None:
    """Write an output that is one file where it waits to get its name. What it does not hold is told."""
    if check_shapes_output(output) == ".npz":
        save_blend_shapes(place, result.shapes)
        return
    target, original = result.target, result.original
    path, data, in_gltf = as_scene(original or target, target)  # as it came
    turn = np.eye(3) if in_gltf else turn_upright(result.maps, result.stands_along_y)
    adding = partial(with_morphs, shape=target, added=result.shapes, turn=turn)
    glb, lost = with_look(gltf.understood(path, data, "scene makes", adding), original, target)
    place.write_bytes(remembering(glb, target))
    tell_left(output, original, lost)


def check_shapes_output(path: Path) -> str:
    """The suffix of an output, "" for a folder, such as v1.0. Ask before long work.

    `OptionError` for a suffix that holds no blendshapes, `OutputError` for a folder that cannot be made or is not empty.
    """
    if path.suffix and not path.suffix[1:].isdecimal():
        return check_suffix(path)
    check_new_folder(path)
    return ""


def transfer_shapes(
    source: ShapeLike,
    target: ShapeLike,
    match: MapLike = None,
    *,
    shapes: BlendShapes | str | Path | Sequence[str | Path] | None = None,
) -> BlendShapesResult:
    """Blendshapes (morph targets) of the source on the target: expressions of a face, corrections of a pose.

    Parameters
    ----------
    source
        As in `find_maps`: a mesh at rest.
    target
        As in `find_maps`: a mesh.
    match
        As in `find_maps`.
    shapes
        The blendshapes, if they are not in the source's own file: a glTF scene, an .npz, or meshes with the source's own
        vertices, as a list of files or a folder.

    Returns
    -------
    BlendShapesResult
        Its ``save("face.glb")`` writes the target with them.

    Raises
    ------
    MeshmatchError
        There are no blendshapes, or those of another mesh; one of the two is a point cloud; or as for `find_maps`.

    Examples
    --------
    >>> dancer = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> meshmatch.transfer_shapes(dancer, "templates/samples/climber.ply", shapes="dancers-shapes").save("climber.glb")
    """
    file = Path(source) if isinstance(source, str | Path) else None
    a, b = as_shape(source, "source"), as_shape(target, "target")
    for each in (a, b):
        if each.is_cloud:
            raise InputError(f"{each.name or 'the shape'} is a point cloud, and blendshapes move meshes", "give a mesh")
    in_gltf = file is not None and file.suffix.lower() in gltf.SUFFIXES
    if shapes is None:
        if file is None or not in_gltf:
            raise InputError(f"{a.name or 'the source'} has no blendshapes", "give them as files: --shapes FOLDER")
        shapes = file
    given = shapes if isinstance(shapes, BlendShapes) else load_blend_shapes(shapes, a)
    maps = find_maps(a, b, match)
    began = time.monotonic()
    with thread_limit(1):
        moves = carry_moves(given.moves, maps.forward, maps.backward, a, b)
    stopped = [bool(old.any()) and not new.any() for old, new in zip(given.moves, moves, strict=True)]
    still = tuple(name for name, gone in zip(given.names, stopped, strict=True) if gone)
    original = Path(target) if isinstance(target, str | Path) else None
    seconds = time.monotonic() - began
    return BlendShapesResult(replace(given, moves=moves), given, still, b, maps, seconds, in_gltf, original)
