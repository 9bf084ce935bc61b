"""Write meshes with moved vertices.

A glb or ply keeps everything in its file but the positions, and an obj its text; materials and images are copied.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from meshmatch import blender
from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.geometry.trees import cKDTree
from meshmatch.outputs import make_folder, replace_all_on_success
from meshmatch.shapes.appearance import Appearance, BakedMaterial
from meshmatch.shapes.colors import linear_to_bytes
from meshmatch.shapes.dressed_files import Dressed, content_beyond_triangles, find_companions
from meshmatch.shapes.files import check_suffix, load_shape, save_shape
from meshmatch.shapes.formats import COORDINATES, gltf, obj_text
from meshmatch.shapes.formats.gltf_add_skeleton import with_skeleton
from meshmatch.shapes.formats.gltf_edit import Editor, record_source_mesh
from meshmatch.shapes.formats.gltf_join import add_scene
from meshmatch.shapes.formats.gltf_materials import with_material, with_texture_coordinates
from meshmatch.shapes.formats.gltf_positions import with_positions
from meshmatch.shapes.formats.gltf_rig import Binding
from meshmatch.shapes.formats.gltf_vrm import SUFFIX, check_character
from meshmatch.shapes.formats.ply_edit import PlyFile
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import find_appearance, load_coordinates

_WHITE = (1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class MovedFile:
    """An output that equals an original file except for the vertex positions: what is written, and copied next to it.

    ``original`` is None if the mesh came from no file; ``copies`` are pairs of a new file and its source. What the
    output cannot hold is reported by a warning, unless ``told``: it is then one of several outputs, and the first one
    reports it.
    """

    output: Path
    original: Path | None
    copies: tuple[tuple[Path, Path], ...] = ()
    told: bool = False

    @classmethod
    def plan_all(cls, outputs: Sequence[Path], original: Path | None) -> list[MovedFile]:
        """Plan several outputs in one folder, which share the material files of an .obj; errors as for `planned`."""
        plans = [cls.planned(output, None if number else original) for number, output in enumerate(outputs)]
        return [replace(plan, original=original, told=number > 0) for number, plan in enumerate(plans)]

    @classmethod
    def planned(cls, output: Path, original: Path | None, into: Path | None = None) -> MovedFile:
        """Plan an output, or data to put ``into`` another file; warn about materials and images that are missing.

        `OptionError`: the suffix cannot be written, or a copy would replace another file. `InputError`: a material file
        cannot be read.
        """
        if into is None:
            check_suffix(output)
        else:
            check_insertion(into, output)
        if original is None or not (output.suffix.lower() == original.suffix.lower() in (".obj", ".ply")):
            return cls(output, original)
        source_folder, output_folder = original.parent.resolve(), output.parent.resolve()
        if source_folder == output_folder:
            return cls(output, original)
        companions, missing_names = find_companions(original)
        if missing_names:
            warn(f"{original.name} names {', '.join(missing_names)[:200]}, which is not there: not copied")
        copies = []
        for file in companions:
            copy = output.parent / file.resolve().relative_to(source_folder)
            if not copy.exists():
                copies.append((copy, file))
            elif copy.read_bytes() != file.read_bytes():
                hint = "choose another folder for the output, or remove the file"
                raise OptionError(f"cannot copy {file.name} next to {output.name}: another {copy} is there", hint)
        return cls(output, original, tuple(copies))

    @property
    def rotates_normals(self) -> bool:
        """Whether vertex normals of the original are rotated, rather than recomputed."""
        before, after = "" if self.original is None else self.original.suffix.lower(), self.output.suffix.lower()
        return before == after in (".obj", ".ply") or (before in gltf.SUFFIXES and after == ".glb")

    @property
    def files(self) -> list[Path]:
        """The files that are written, the output first."""
        return [self.output, *(copy for copy, _ in self.copies)]

    def make_folders(self) -> None:
        """Create the folders of copies below that of the output; `OutputError` on failure."""
        for copy, _ in self.copies:
            if copy.parent != self.output.parent:
                make_folder(copy.parent)

    def write(
        self,
        places: Sequence[Path],
        shape: Shape,
        turns: Float[Floats, "V 3 3"],
        binding: Binding | None = None,
        turn: Float[Floats, "3 3"] | None = None,
        into: Path | None = None,
    ) -> None:
        """Write the moved mesh and the copies to temporary ``places``, one for each of `files`.

        The shape has the original's vertices in its order; ``turns`` is the local rotation at each of them. With a
        ``binding``, a glb gets a skeleton that moves them; it may be put ``into`` another glb, which has these joints.
        Without either, a node with the rotation ``turn`` makes a glb upright. What the format cannot hold is reported
        by a warning.
        """
        place = places[0]
        if place.suffix.lower() == SUFFIX:
            glb = place.with_suffix(".glb")
            try:
                self.write([glb, *places[1:]], shape, turns, binding, turn, into)
                glb.replace(place)
            finally:
                glb.unlink(missing_ok=True)
            return
        self._write_mesh(places, shape, turns, still=binding is None)
        if place.suffix.lower() == ".glb" and (binding is not None or into is not None):
            add = partial(_add_skeleton, shape=shape, binding=binding, into=into)
            place.write_bytes(gltf.parse_document(self.output, place.read_bytes(), "scene makes", add))
        elif self.is_turned(binding, turn):
            assert turn is not None
            place.write_bytes(
                gltf.parse_document(self.output, place.read_bytes(), "scene makes", partial(_turn_scene, turn=turn))
            )

    def is_turned(self, binding: Binding | None, turn: Float[Floats, "3 3"] | None) -> bool:
        """Whether a node makes the mesh upright in this output: not if it has a skeleton."""
        has_nodes = self.output.suffix.lower() == ".glb" or blender.is_converted(self.output)
        return has_nodes and binding is None and turn is not None and not np.array_equal(turn, np.eye(3))

    def _write_mesh(self, places: Sequence[Path], shape: Shape, turns: Float[Floats, "V 3 3"], still: bool) -> None:
        for place, (_, file) in zip(places[1:], self.copies, strict=True):
            place.write_bytes(read_bytes(file))
        suffix, original = places[0].suffix.lower(), self.original
        if original is not None and suffix == original.suffix.lower() == ".obj":
            text = obj_text.with_positions(original.name, read_bytes(original), shape.verts_or_nan, turns)
            places[0].write_bytes(text)
            return
        ply = PlyFile.of(original, shape, moved=True) if suffix == ".ply" else None
        edited = None if ply is None else ply.with_positions(shape.verts_or_nan, turns)
        if original is not None and suffix == ".glb" and original.suffix.lower() in gltf.SUFFIXES:
            edited = _move_scene(self.output, original, shape, turns, still and not self.told)
        if edited is not None:
            places[0].write_bytes(edited)
            if not self.told:
                warn_about_lost(self.output, original, _lost_polygons(original))
            return
        as_read = _as_read(original, shape) if suffix == ".glb" else shape
        look = _find_look(original, as_read, suffix == ".glb" and not self.told)
        uv = _find_coordinates(original, as_read) if suffix == ".glb" else None
        textured = _as_textured(shape, look, uv) if suffix == ".glb" and look is not None else None
        if textured is not None:
            textured.write(self.output, places[:1])
        else:
            save_shape(places[0], shape)
            if uv is not None:
                places[0].write_bytes(_add_coordinates(self.output, places[0].read_bytes(), shape, uv))
        if not self.told:
            warn_about_lost(self.output, original, _describe_lost(original, look, textured is not None, uv is not None))


def save_moved(
    path: str | Path,
    original: Path | None,
    shape: Shape,
    turns: Float[Floats, "V 3 3"],
    binding: Binding | None = None,
    turn: Float[Floats, "3 3"] | None = None,
    into: Path | None = None,
) -> None:
    """Write a moved mesh that was read from a file; all files or none.

    Errors as for `MovedFile.planned`, and `OutputError` if a file cannot be written.
    """
    plan = MovedFile.planned(Path(path), original, into)
    plan.make_folders()
    with replace_all_on_success(plan.files) as places:
        plan.write(places, shape, turns, binding, turn, into)


def check_insertion(file: Path | None, output: Path) -> None:
    """`OptionError` if nothing can be put into a file, or the output is not a glb, nor a .vrm of a character."""
    if file is None or file.suffix.lower() not in gltf.SUFFIXES:
        name = "the target" if file is None else file.name
        raise OptionError(f"nothing can be put into {name}", f"the target must be one of {', '.join(gltf.SUFFIXES)}")
    if output.suffix.lower() not in (".glb", SUFFIX):
        raise OptionError(f"{output.name} cannot hold the target and what is put into it", "end the output in .glb")
    check_character(file, output)


def add_appearance(glb: bytes, original: Path | None, shape: Shape) -> tuple[bytes, str]:
    """A glb of a shape with the texture coordinates, and the texture or single color, of the shape's file.

    Also returns what a glb cannot hold of that file, for `warn_about_lost`.
    """
    if original is None or original.suffix.lower() in gltf.SUFFIXES:
        return glb, _lost_polygons(original)
    look, uv = _find_look(original, shape), _find_coordinates(original, shape)
    textured = None if look is None else _as_textured(shape, look, uv)
    if textured is not None:
        edit = partial(with_material, uv=textured.uv, own=False, material=textured.material, turn=textured.turn)
        glb = gltf.parse_document(original, glb, "scene makes", edit)
    elif uv is not None:
        glb = _add_coordinates(original, glb, shape, uv)
    return glb, _describe_lost(original, look, textured is not None, uv is not None)


def warn_about_lost(output: Path, original: Path | None, lost: str) -> None:
    """Warn about what an output lacks of the file that it was made of, if anything."""
    if original is not None and lost:
        warn(f"{output.name} does not have {lost} of {original.name}")


def _lost_polygons(original: Path | None) -> str:
    """Words for the polygons of a file, if Blender converts it to glb and it has any; else an empty string."""
    has_polygons = original is not None and blender.is_converted(original) and blender.has_polygons(original)
    return "the polygons" if has_polygons else ""


def _as_read(original: Path | None, shape: Shape) -> Shape:
    """The mesh with the positions of its file, which determine how polygons are triangulated.

    Texture coordinates belong to the corners of these triangles.
    """
    return load_shape(original) if original is not None and original.suffix.lower() in (".obj", ".ply") else shape


def _find_look(original: Path | None, shape: Shape, wanted: bool = True) -> Appearance | None:
    """The appearance of a mesh in its file; None if it cannot be read, with a warning if it is ``wanted``."""
    if original is None or shape.is_cloud:
        return None
    try:
        return find_appearance(original, shape, plain=True)
    except InputError as error:
        if wanted:
            warn(f"the look of {original.name} is left out: {error.message}")
        return None


def _find_coordinates(original: Path | None, shape: Shape) -> Floats | None:
    """Texture coordinates of each corner, regardless of materials; None if any face has none."""
    with suppress(InputError):
        return None if original is None or shape.is_cloud else load_coordinates(original, shape)
    return None


def _add_coordinates(name: Path, glb: bytes, shape: Shape, uv: Floats) -> bytes:
    """Add texture coordinates to a glb that was made of a shape, maybe of its valid faces only."""

    def edit(document: gltf.Document) -> bytes:
        return with_texture_coordinates(document, uv if len(document.faces()) == len(uv) else uv[shape.valid_faces])

    return gltf.parse_document(name, glb, "scene makes", edit)


def _turn_scene(document: gltf.Document, turn: Float[Floats, "3 3"]) -> bytes:
    editor = Editor(document)
    editor.turn(document, turn)
    return editor.to_bytes()


def _add_skeleton(document: gltf.Document, shape: Shape, binding: Binding | None, into: Path | None) -> bytes:
    """The glb of a mesh with its skeleton, or the other glb with the mesh put into it."""
    if binding is not None:
        verts = document.scene().verts
        # vertices are duplicated at seams of the texture
        rows = np.arange(shape.V) if len(verts) == shape.V else cKDTree(shape.verts).query(verts)[1]
        binding = binding.of(rows)
    if into is not None:
        both = gltf.parse_document(
            into, read_bytes(into), "scene makes", lambda body: add_scene(body, document, binding)
        )
        return record_source_mesh(both, load_shape(into))
    assert binding is not None
    return with_skeleton(document, binding)[0]


def _move_scene(output: Path, original: Path, shape: Shape, turns: Float[Floats, "V 3 3"], still: bool) -> bytes | None:
    """The original scene with its vertices moved; None if it draws instances of a mesh.

    These cannot be moved separately. Warns that joints stay where they are, if ``still``.
    """

    def edit(document: gltf.Document) -> tuple[bytes, bool] | None:
        if gltf.INSTANCES in document.json.get("extensionsUsed", []):
            return None
        return with_positions(document, shape.verts_or_nan, turns), bool(document.json.get("skins"))

    result = gltf.parse_document(original, read_bytes(original), "scene makes", edit)
    if result is not None and result[1] and still:
        where = f"the joints of {original.name} stay where they are in {output.name}"
        warn(f"{where}: `meshmatch transfer-rig {original.name} {output.name}` moves them")
    return None if result is None else result[0]


def _as_textured(shape: Shape, look: Appearance, coordinates: Floats | None) -> Dressed | None:
    """The mesh with its texture, or with its single color on its texture coordinates; None for any other appearance."""
    material = look.materials[0]
    if len(look.materials) != 1 or look.colors is not None or (material.image is None and material.factor == _WHITE):
        return None
    image, uv = material.image, look.uv
    if image is None:
        color = np.append(
            linear_to_bytes(np.array(material.factor[:3], np.float32)), np.uint8(round(255 * material.factor[3]))
        )
        image = np.tile(color.astype(np.uint8), (4, 4, 1))
        uv = np.full_like(look.uv, 0.5) if coordinates is None else coordinates
    return Dressed(shape, None, uv, False, BakedMaterial(image, material.alpha, material.cutoff, material.name))


def _describe_lost(original: Path | None, look: Appearance | None, textured: bool, laid_out: bool) -> str:
    """What an output lacks of the original, in words; for formats other than the original's."""
    if original is None:
        return ""
    suffix = original.suffix.lower()
    lost = []
    if look is not None and not textured and (look.textured or len(look.materials) > 1):
        lost += ["the materials"] if laid_out else ["the texture coordinates", "the materials"]
    if suffix not in gltf.SUFFIXES:
        beyond = content_beyond_triangles(original)
        lost += [f"the {word}" for word in beyond if word != COORDINATES or not (textured or laid_out)]
    else:
        lost += ["other maps than the base color", "skins", "morph targets", "the nodes"]
    lost = list(dict.fromkeys(lost))
    return " and ".join([", ".join(lost[:-1]), lost[-1]]) if len(lost) > 1 else "".join(lost)
