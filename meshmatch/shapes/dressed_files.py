"""Write meshes with a baked material: a glb or obj keeps everything in its file except the materials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from meshmatch import blender
from meshmatch.arrays import Float, Floats, ShortRepr
from meshmatch.errors import OptionError, warn
from meshmatch.outputs import replace_all_on_success
from meshmatch.shapes.appearance import BakedMaterial, Pixels, png_bytes
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.formats import (
    COORDINATES,
    TexturedMesh,
    gltf,
    gltf_write,
    obj,
    obj_appearance,
    obj_text,
    off,
    ply,
    ply_appearance,
    vtk,
)
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import record_source_mesh
from meshmatch.shapes.formats.gltf_materials import with_material, with_vertex_colors
from meshmatch.shapes.formats.gltf_vrm import check_character
from meshmatch.shapes.formats.ply_edit import PlyFile
from meshmatch.shapes.formats.vtp_edit import VtpFile
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import check_textured, image_file, output_files, tile_file


@dataclass(frozen=True, eq=False, repr=False)
class Dressed(ShortRepr):
    """A mesh with a baked material.

    ``file`` is the file it was read from, None for a mesh from arrays; ``uv`` are texture coordinates of each corner, v
    down, ``own`` if they are those of the file. ``turn`` rotates a file without defined axes upright in formats that
    define them. ``tiles`` are materials that differ only in their images, by the tile (UDIM, 1001 to 1100) of the
    coordinates they are for; if empty, one image covers all coordinates.
    """

    shape: Shape
    file: Path | None
    uv: Float[Floats, "F 3 2"]
    own: bool
    material: BakedMaterial
    turn: Float[Floats, "3 3"] = field(default_factory=lambda: np.eye(3))
    tiles: Mapping[int, BakedMaterial] = field(default_factory=dict)

    @property
    def turned(self) -> bool:
        """Whether the shape stands along another axis than y."""
        return not np.array_equal(self.turn, np.eye(3))

    def save(self, path: Path) -> None:
        """Write a glb, or an obj with its material files; all files or none.

        `OptionError` if the suffix is neither .glb nor .obj, nor .vrm for a character, or the format has no tiles;
        `OutputError` if a file cannot be written.
        """
        check_textured(path)
        check_character(self.file, path)
        if self.tiles:
            check_tiles(path)
        with replace_all_on_success(output_files(path, self.material.layers, self.tiles)) as places:
            self.write(path, places)

    def write(self, path: Path, places: Sequence[Path]) -> None:
        """Write the contents of `output_files` to temporary ``places``; issue a warning for what the format cannot hold."""
        if len(places) == 1:
            places[0].write_bytes(self._glb())
        else:
            self._write_obj(path, places)
        warn_about_losses(self.file, path, own_materials=True)

    def _glb(self) -> bytes:
        """The mesh with its material as glb: the edited original, or a new file."""
        path, data, is_original = glb_base(self.file, self.shape)
        if is_original:
            uv, own, turn = self.uv, self.own, np.eye(3)
        else:
            uv, own, turn = self.uv[self.shape.valid_faces], False, self.turn
        glb = gltf.parse_document(
            path, data, "scene makes", lambda document: with_material(document, uv, own, self.material, turn)
        )
        return record_source_mesh(glb, self.shape)

    def _write_obj(self, path: Path, places: Sequence[Path]) -> None:
        shared, name = self.material, "_".join((self.material.name or path.stem).split()) or "texture"
        files = output_files(path, shared.layers, self.tiles)
        if self.file is not None and self.file.suffix.lower() == ".obj":
            text, names = self._edited_text(self.file, files[1].name, name)
            places[0].write_bytes(text)
        else:
            real = self.shape.valid_faces
            mesh = TexturedMesh(self.shape.verts, self.shape.faces[real], self.uv[real])
            obj.write_textured(places[0], mesh, files[1].name, name)
            names = [name]
        place_of, image_names = dict(zip(files, places, strict=True)), {}
        for tile, material in (self.tiles or {0: shared}).items():
            for word, image in _images_of(material).items():
                image_path = image_file(path, word)
                image_names[word] = tile_file(image_path, "<UDIM>" if self.tiles else "").name
                place_of[tile_file(image_path, tile)].write_bytes(png_bytes(image))
        obj.write_materials(places[1], names, shared, image_names)
        if shared.occluded or shared.unlit:
            lost = " and ".join(["an occlusion map"] * shared.occluded + ["materials without light"] * shared.unlit)
            warn(f"{path.name} does not have {lost}: an mtl holds none")

    def _edited_text(self, file: Path, library: str, name: str) -> tuple[bytes, list[str]]:
        """The text of an original obj with the new material, and the names of its materials."""
        data = read_bytes(file)
        if self.own:
            return obj_text.with_material(data, library, name, None)
        polygons = obj_text.polygons_of(file.name, data, self.shape.verts_or_nan)
        corners = np.zeros((int(polygons.sizes.sum()), 2))
        corners[polygons.triangles] = self.uv
        corners[:, 1] = 1.0 - corners[:, 1]
        return obj_text.with_material(data, library, name, corners)


def _images_of(material: BakedMaterial) -> dict[str, Pixels]:
    """The images of an mtl, keyed as in `image_file`."""
    images = {"color": material.color}
    if material.normal is not None:
        images["normal"] = material.normal
    if material.surface is not None and not material.even:
        for k, word in ((1, "roughness"), (2, "metal")):
            images[word] = np.dstack([*[material.surface[..., k]] * 3, material.surface[..., 3]])
    if material.glow is not None:
        images["emission"] = material.glow
    return images


def check_tiles(path: Path) -> None:
    """`OptionError` if the format cannot hold tiles (UDIM)."""
    if path.suffix.lower() != ".obj":
        problem = f"{path.name}: {path.suffix} has no tiles (UDIM), in which the texture coordinates of the target lie"
        raise OptionError(problem, "end the name in .obj, or bring them into one (BakeOptions.tiles=False)")


def save_textured(path: str | Path, mesh: TexturedMesh, image: Pixels) -> None:
    """Write a mesh with the texture `image` (H, W, 4) as glb, or as obj with an mtl and a png of the same name.

    Errors are those of `Dressed.save`.
    """
    path = Path(path)
    material = BakedMaterial(image, mesh.alpha, mesh.cutoff, path.stem)
    Dressed(Shape(mesh.verts, mesh.faces, path.stem), None, mesh.uv, False, material).save(path)


def save_colored(path: Path, shape: Shape, file: Path | None, turn: Float[Floats, "3 3"]) -> bool:
    """Write a shape with its vertex colors.

    If the shape was read from a glb, obj, ply or vtp and the output has the same format, everything else in the file is
    kept. A glb of a shape without defined axes is rotated upright. Returns whether an original of the output's format
    would be kept.
    """
    suffix, colors = path.suffix.lower(), shape.colors
    assert colors is not None
    if suffix in (".glb", ".vrm"):
        name, data, is_original = glb_base(file, shape)
        turned = np.eye(3) if is_original else turn
        glb = gltf.parse_document(name, data, "scene makes", lambda doc: with_vertex_colors(doc, colors, turned))
        path.write_bytes(record_source_mesh(glb, shape))
    elif suffix == ".obj" and file is not None and file.suffix.lower() == ".obj":
        path.write_bytes(obj_text.with_colors(file.name, read_bytes(file), colors))
    elif suffix == ".ply" and (as_ply := PlyFile.of(file, shape)) is not None:
        path.write_bytes(as_ply.with_columns(ply.color_columns(colors), {}))
    elif suffix == ".vtp" and (as_vtp := VtpFile.of(file, shape)) is not None:
        path.write_bytes(as_vtp.with_arrays({"Colors": vtk.bytes_of(colors)}, {}))
    else:
        save_shape(path, shape)
        return False
    return True


def glb_base(file: Path | None, shape: Shape) -> tuple[Path, bytes, bool]:
    """The glTF file that data is added to, as a name and its content, and whether it is the original file.

    Otherwise it is a new glb of the shape.
    """
    if file is not None and file.suffix.lower() in gltf.SUFFIXES:
        data = read_bytes(file)
        if not gltf.parse_document(file, data, "scene makes", Document.uses_instancing):
            return file, data, True
        warn(f"{file.name} draws copies of one mesh, which would have to differ: all becomes one mesh")
    name = Path(shape.name or "target").stem
    bare_shape = Shape(shape.verts, shape.faces[shape.valid_faces], name)
    return Path(f"{name}.glb"), gltf_write.glb_of(bare_shape), False


def find_companions(file: Path) -> tuple[list[Path], list[str]]:
    """Find the material files and images that an obj or ply refers to. Returns them, and the names without a file."""
    find = {".obj": obj_appearance.companions, ".ply": ply_appearance.companions}.get(file.suffix.lower())
    return ([], []) if find is None else find(file, read_bytes(file))


def warn_about_losses(file: Path | None, path: Path, kept: bool = True, own_materials: bool = False) -> None:
    """Warn about what an output lacks of its original file.

    If both have the same format and all of it was ``kept``, only files in another folder are missing: those of materials
    and images to which the output refers, unless it has ``own_materials``.
    """
    before, after = ("" if each is None else each.suffix.lower() for each in (file, path))
    if file is not None and file.is_file() and before == after and kept and not own_materials:
        folder = path.parent.resolve()
        files = [] if file.parent.resolve() == folder else find_companions(file)[0]
        copies = {each: folder / each.resolve().relative_to(file.parent.resolve()) for each in files}
        if missing := [each.name for each, copy in copies.items() if not copy.exists()]:
            names = ", ".join(missing)[:200]
            warn(f"{path.name} refers to {names}, which is not in its folder: copy it from that of {file.name}")
    after = ".glb" if blender.is_converted(path) else after  # Blender writes these through a glb
    if (
        file is None
        or not file.is_file()
        or (before == after and kept)
        or after not in (".glb", ".obj", ".ply", ".off", ".vtp", ".vtk")
    ):
        return
    if after == ".glb" and blender.is_converted(file):
        lost = ["polygons"] if blender.has_polygons(file) else []
    elif after == ".glb" and before in gltf.SUFFIXES:
        lost = []
    else:
        lost = [word for word in content_beyond_triangles(file) if word != COORDINATES or not own_materials]
    if lost:
        listed = f"{', '.join(lost[:-1])} and {lost[-1]}" if lost[1:] else lost[0]
        warn(f"{path.name} does not have the {listed} of {file.name}")


def content_beyond_triangles(file: Path) -> list[str]:
    """What a file contains besides the triangles of one mesh and its material or colors, in words."""
    suffix = file.suffix.lower()
    if suffix in gltf.SUFFIXES:
        return gltf.parse_document(file, read_bytes(file), "scene makes", Document.content_beyond_triangles)
    readers: dict[str, type[PlyFile | VtpFile]] = {".ply": PlyFile, ".vtp": VtpFile}
    if suffix in readers:
        return readers[suffix].parsed(file.name, read_bytes(file)).content_beyond_triangles
    describe = {
        ".obj": obj_text.content_beyond_triangles,
        ".off": off.content_beyond_triangles,
        ".vtk": vtk.content_beyond_triangles,
    }
    return describe[suffix](file.name, read_bytes(file)) if suffix in describe else []
