"""Textured meshes to files: one glb, or an obj with its mtl and png. All appear whole, or none does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.formats import gltf_out, obj_out
from meshmatch.shapes.formats.textured import Textured
from meshmatch.shapes.images import Pixels, png_bytes

TEXTURED_SUFFIXES = (".glb", ".obj")


def files_of(path: Path) -> list[Path]:
    """What will be written for an output: an obj has two companions."""
    if path.suffix.lower() != ".obj":
        return [path]
    return [path, path.with_suffix(".mtl"), path.with_suffix(".png")]


@dataclass(frozen=True)
class TexturedFiles:
    """Places claimed for the files of one textured mesh."""

    path: Path
    temporary: tuple[Path, ...]

    def write(self, mesh: Textured, image: Pixels) -> None:
        """Write everything; the files get their names when the claim ends well."""
        png = png_bytes(image)
        name = self.path.stem
        if len(self.temporary) == 1:
            gltf_out.write_textured(self.temporary[0], name, mesh, png)
            return
        obj, mtl, picture = self.temporary
        files = files_of(self.path)
        material = "_".join(name.split()) or "texture"
        obj_out.write_textured(obj, mesh, files[1].name, material)
        obj_out.write_material(mtl, material, files[2].name, mesh)
        picture.write_bytes(png)


def check_textured(path: Path, colored: tuple[str, ...] = ()) -> None:
    """Refuse a suffix that holds no texture (`OptionError`), nor is one of those `colored` by vertex."""
    if path.suffix.lower() not in (*TEXTURED_SUFFIXES, *colored):
        hint = f", or in {' or '.join(colored)} for vertex colours" if colored else ""
        raise OptionError(
            f"{path.name}: cannot write a texture as {path.suffix or '(no suffix)'}",
            f"end the name in {' or '.join(TEXTURED_SUFFIXES)}{hint}",
        )


@contextmanager
def claim_textured(path: str | Path) -> Iterator[TexturedFiles]:
    """Claim the places of a textured mesh before the work; nothing appears unless the block ends well.

    Raises
    ------
    OptionError
        The suffix is neither .glb nor .obj.
    OutputError
        A file cannot be written.
    """
    path = Path(path)
    check_textured(path)
    with ExitStack() as claims:  # the obj, which names the others, is claimed first and so renamed last
        temporary = tuple(claims.enter_context(replace_on_success(file)) for file in files_of(path))
        yield TexturedFiles(path, temporary)


def save_textured(path: str | Path, mesh: Textured, image: Pixels) -> None:
    """Write a mesh that wears `image` (H, W, 4) as glb, or as obj with an mtl and a png of the same name."""
    with claim_textured(path) as files:
        files.write(mesh, image)
