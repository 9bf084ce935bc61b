"""Transfer of blendshapes (morph targets) between shapes."""

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
from meshmatch.arrays import ShortRepr
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import rotations_between
from meshmatch.outputs import as_path, check_new_folder, folder_on_success, make_unique, replace_on_success
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes import tables
from meshmatch.shapes.blend_shape_files import load_blend_shapes, save_blend_shapes
from meshmatch.shapes.blend_shapes import BlendShapes, shape_normals
from meshmatch.shapes.deformed_files import MovedFile, add_appearance, warn_about_lost
from meshmatch.shapes.files import ShapeLike, as_gltf_scene, as_shape
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.formats.gltf_edit import record_source_mesh
from meshmatch.shapes.formats.gltf_morphs import with_morphs
from meshmatch.shapes.formats.gltf_vrm import check_character
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.blend_shapes import carry_moves

check_suffix = partial(tables.check_suffix, suffixes=(".glb", ".vrm", ".npz"), what="blendshapes")
_UNSAFE = re.compile(r"[^\w .+-]")  # characters that are replaced in the names of files
_MAX_NAME_LENGTH = 100  # characters of a file's name


@dataclass(frozen=True, eq=False, repr=False)
class BlendShapesResult(ShortRepr):
    """The blendshapes of the source on the target: the result of `transfer_shapes`.

    Attributes
    ----------
    shapes
        The transferred blendshapes: ``names`` (K,), ``moves`` (K, V_target, 3) in the frame and unit of the target,
        ``weights`` and ``clips``.
    given
        The blendshapes of the source.
    still
        Names of blendshapes that move vertices of the source but none of the target.
    target
        The target.
    maps
        The maps that were used.
    seconds
        Wall time, excluding the match.
    stands_along_y
        Whether the source was read from a glTF file, so that y is its up axis; a target of unknown orientation is then
        turned upright like it in a .glb.
    original
        The target's file, if it was read from one.

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
        from meshmatch.api.notebook import transfer_html

        return transfer_html("Blendshapes", self.maps.forward, None, {"shapes": ", ".join(self.shapes.names)})

    def save(self, path: str | Path) -> None:
        """Write the target with its blendshapes.

        Parameters
        ----------
        path
            A .glb (or a .vrm, if the target is one): the target's scene with morph targets and the clips that animate them;
            a target from another format than glTF keeps its texture or single color. An .npz: ``names`` (K,) and
            ``moves`` (K, V, 3). Or a new folder, with an .obj for each blendshape: the text of the target's .obj with
            other positions, if it was read from one.

        Raises
        ------
        OptionError
            The suffix is not supported.
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
        """Plan the files of a folder of meshes: an .obj for each blendshape, and their common materials and images."""
        safe_names = (_UNSAFE.sub("_", name)[:_MAX_NAME_LENGTH].strip(". ") or "shape" for name in self.shapes.names)
        files = [folder / f"{stem}.obj" for stem in make_unique(safe_names, "-", str.lower)]
        return MovedFile.plan_all(files, self.original)

    def _write_meshes(self, plans: Sequence[MovedFile]) -> None:
        normals = shape_normals(self.target, self.shapes.moves)
        for move, plan, now in zip(self.shapes.moves, plans, normals[1:], strict=True):
            shape = replace(self.target, verts=self.target.verts + move)
            plan.make_folders()
            plan.write(plan.files, shape, rotations_between(normals[0], now))


def write_shapes(result: BlendShapesResult, output: Path, place: Path) -> None:
    """Write the result for ``output``, a single file, to the temporary path ``place``; warn of what is lost."""
    if check_shapes_output(output) == ".npz":
        save_blend_shapes(place, result.shapes)
        return
    target, original = result.target, result.original
    path, data, in_gltf = as_gltf_scene(original or target, target)
    turn = np.eye(3) if in_gltf else turn_upright(result.maps, result.stands_along_y)
    adding = partial(with_morphs, shape=target, added=result.shapes, turn=turn)
    glb, lost = add_appearance(gltf.parse_document(path, data, "scene makes", adding), original, target)
    place.write_bytes(record_source_mesh(glb, target))
    warn_about_lost(output, original, lost)


def check_shapes_output(path: Path) -> str:
    """Return the suffix of an output, or "" for a folder (a numeric suffix, as in "v1.0", is part of its name).

    Check an output before the transfer: `OptionError` if the format does not support blendshapes, `OutputError` if the
    folder cannot be made or is not empty.
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
    progress: ProgressCallback | None = None,
) -> BlendShapesResult:
    """Transfer blendshapes (morph targets) from the source to the target: facial expressions, pose corrections.

    Parameters
    ----------
    source
        A mesh in its rest pose, given as in `find_maps`.
    target
        A mesh, given as in `find_maps`.
    match
        As in `find_maps`.
    shapes
        The blendshapes, if they are not in the source's file: a glTF scene, an .npz, or meshes with the vertices of the
        source, as a list of files or a folder.
    progress
        As in `match`.

    Returns
    -------
    BlendShapesResult
        Its ``save("face.glb")`` writes the target with the blendshapes.

    Raises
    ------
    MeshmatchError
        There are no blendshapes, or they are of another mesh; a shape is a point cloud; or as for `find_maps`.

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
    report = Progress(progress, b.name, "transferring displacements")
    report(0.0)
    with thread_limit(1):
        moves = carry_moves(given.moves, maps.forward, maps.backward, a, b, report)
    is_still = [bool(old.any()) and not new.any() for old, new in zip(given.moves, moves, strict=True)]
    still = tuple(name for name, flag in zip(given.names, is_still, strict=True) if flag)
    original = Path(target) if isinstance(target, str | Path) else None
    seconds = time.monotonic() - began
    return BlendShapesResult(replace(given, moves=moves), given, still, b, maps, seconds, in_gltf, original)
