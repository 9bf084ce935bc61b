"""Transfer of textures between shapes."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from meshmatch.api.results import MapPair
from meshmatch.api.transfer import MapLike, find_maps, is_given
from meshmatch.api.upright import turn_upright
from meshmatch.arrays import Ints, ShortRepr
from meshmatch.errors import InputError, OptionError
from meshmatch.outputs import as_path
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.appearance import Appearance, BakedMaterial, vertex_colors_alone
from meshmatch.shapes.dressed_files import Dressed
from meshmatch.shapes.files import ShapeLike, as_shape, load_shape
from meshmatch.shapes.formats import gltf, obj_text
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import find_appearance, load_appearance, load_coordinates
from meshmatch.threads import thread_limit
from meshmatch.transfer import bake
from meshmatch.transfer.bake import Baked, BakeOptions
from meshmatch.transfer.source_layout import check_layout, source_layout
from meshmatch.transfer.unwrap import (
    Atlas,
    Keep,
    atlas_of,
    check_surface,
    new_atlas,
    shared_texels,
    tiles_of,
    too_many_layers,
)

if TYPE_CHECKING:
    from meshmatch.render.compose import Composition

_MAX_CONTRADICTED = 0.1
"""Share of the surface with shared texels that may look different from the other places with these texels."""

_MIN_REPORTED = 0.002  # share of texels with several places that is reported


@dataclass(frozen=True, eq=False, repr=False)
class TexturedResult(ShortRepr):
    """The target with its new texture: the result of `transfer_texture`.

    Attributes
    ----------
    dressed
        The target with its new look: ``uv`` (F, 3, 2), ``material``, the rotation ``turn`` that makes it upright in a glb,
        and ``tiles``: materials by tile number, if the target's texture coordinates lie in several tiles (UDIM).
    baked
        The baked texture: ``material``, its ``image`` (size, size, 4) uint8 (of the first tile, if there are several), and
        the shares (0..1) of the surface with low confidence (``low``) and a discontinuous map (``torn``).
    atlas
        The texture coordinates, and a note on why the target's own were not used.
    maps
        The maps that were used.
    seconds
        Wall time of unwrapping and baking.

    Examples
    --------
    >>> result = meshmatch.transfer_texture("templates/samples/dancer-textured.glb", "templates/samples/climber.ply")
    >>> result.baked.image.shape  # (2048, 2048, 4)
    >>> result.save("dressed.obj")  # with dressed.mtl and dressed.png
    """

    dressed: Dressed
    baked: Baked
    atlas: Atlas
    maps: MapPair
    seconds: float

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import transfer_html

        used = f"{'its own' if self.atlas.own else 'new'}; {100 * self.baked.used:.0f} % of the image is used"
        return transfer_html("Texture", self.maps.forward, self._drawn, {"texture coordinates": used})

    def _drawn(self) -> Composition:
        """Compose a picture of the target with its texture."""
        from meshmatch.render.compose import compose_shapes

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "shown.glb")
            self.save(path)
            shape = load_shape(path)
            return compose_shapes([(shape, find_appearance(path, shape))])

    def save(self, path: str | Path) -> None:
        """Write a .glb (or a .vrm, if the target is one), or an .obj with an .mtl and a .png of the same name.

        If the target's file has the same format, everything but the texture is kept.

        Parameters
        ----------
        path
            The output file; its suffix selects the format.

        Raises
        ------
        OptionError
            The suffix is not supported; or it is .glb, and the target's texture coordinates lie in several tiles; or it is
            .vrm, and the target is not a .vrm.
        OutputError
            A file cannot be written.
        """
        self.dressed.save(as_path(path))


def transfer_texture(
    source: ShapeLike,
    target: ShapeLike,
    match: MapLike = None,
    *,
    image: str | Path | None = None,
    uv: Keep = "auto",
    options: BakeOptions = BakeOptions(),
    look: Appearance | None = None,
    progress: ProgressCallback | None = None,
) -> TexturedResult:
    """Transfer the texture of the source: bake it into a new texture of the target.

    Parameters
    ----------
    source
        The shape with a texture, as in `find_maps`. Its texture and texture coordinates are read if it is a path.
    target
        The mesh that receives the texture, as in `find_maps`. Its texture coordinates are read if it is a path.
    match
        As in `find_maps`.
    image
        An image for the source's texture coordinates, instead of the one that its file names; the source must be a path.
    uv
        Texture coordinates of the target: reuse its own if they are valid ("auto"), reuse them or fail ("keep"), unwrap it
        anew ("new"), or transfer those of the source ("source").
    options
        Size, sampling and padding of the texture, and how texels of low confidence are handled.
    look
        The appearance of the source, instead of that of its file. By default, a source that is not a path is baked from its
        vertex colors.
    progress
        As in `match`.

    Returns
    -------
    TexturedResult
        The target with its texture; ``save("target.glb")`` writes it.

    Raises
    ------
    MeshmatchError
        The source has neither a texture nor colors, the target is a point cloud, or its texture coordinates are to be kept
        and are not valid; or as for `find_maps`.

    Examples
    --------
    >>> dancer, climber = "templates/samples/dancer-textured.glb", "templates/samples/climber.ply"
    >>> dressed = meshmatch.transfer_texture(dancer, climber, options=meshmatch.BakeOptions(size=512))
    >>> dressed.save("dressed.glb")
    """
    if uv not in get_args(Keep):
        raise OptionError(f"invalid uv {uv!r}", f"choose one of {', '.join(get_args(Keep))}")
    mesh = as_shape(target, "target")
    own = load_coordinates(target, mesh) if uv in ("auto", "keep") and isinstance(target, str | Path) else None
    shape = as_shape(source, "source")
    if look is None:
        if isinstance(source, str | Path):
            look = load_appearance(source, shape, image)
        elif image is not None:
            hint = "give the source as a path"
            raise OptionError("an image needs the texture coordinates of the source's file", hint)
        elif shape.colors is None:
            hint = "give the source as a path if its file has a texture, or give look"
            raise InputError(f"{shape.name or 'the source'} has neither a texture nor colors", hint)
        else:
            look = vertex_colors_alone(shape)
    file = as_path(target) if isinstance(target, str | Path) else None
    polygons = None
    if file is not None and file.suffix.lower() == ".obj" and not mesh.is_cloud:
        polygons = obj_text.polygons_of(file.name, read_bytes(file), mesh.verts_or_nan).of_triangles
    if is_given(match):
        match = find_maps(shape, mesh, match)  # a wrong map is refused before the long work
    unwrapping = Progress(progress, mesh.name, "texture coordinates")
    began = time.monotonic()
    with thread_limit(1):
        if uv == "source":
            check_surface(mesh)
            check_layout(shape, look)
            atlas = None
        else:
            unwrapping(0.0)
            atlas = atlas_of(mesh, own, options.size, options.padding, uv, polygons, options.tiles, unwrapping)
            unwrapping(1.0)
    unwrapped = time.monotonic() - began
    maps = find_maps(shape, mesh, match)
    began = time.monotonic() - unwrapped
    report = Progress(progress, mesh.name, "baking")
    with thread_limit(1):
        if atlas is None:
            atlas = _transfer_layout(shape, look, maps, polygons, options.size)
        elif atlas.shared:
            contradicted = bake.contradicting_share(shape, look, mesh, maps.backward, atlas)
            atlas = _check_shared(atlas, contradicted, mesh, options, uv, polygons, unwrapping)
        tiles: dict[int, BakedMaterial] = {}
        if atlas.tiles is None:
            baked = bake.transfer_texture(shape, look, mesh, maps.backward, atlas, options, report, maps.forward)
        else:
            baked, tiles = bake.transfer_tiles(shape, look, mesh, maps.backward, atlas, options, report, maps.forward)
    turn = np.eye(3)
    if file is None or file.suffix.lower() not in gltf.SUFFIXES:
        turn = turn_upright(maps, Path(shape.name).suffix.lower() in gltf.SUFFIXES)
    dressed = Dressed(mesh, file, atlas.laid, atlas.own, baked.material, turn, tiles)
    return TexturedResult(dressed, baked, atlas, maps, time.monotonic() - began)


def tiles_of_file(path: Path, mesh: Shape, size: int) -> list[int]:
    """Numbers of the tiles (UDIM) of a target file's texture coordinates, if each needs its own image of this size."""
    own = None if mesh.is_cloud else load_coordinates(path, mesh)
    found = None if own is None else tiles_of(mesh, own, size)
    return [] if found is None else np.unique(found).tolist()


def _check_shared(
    atlas: Atlas,
    contradicted: float,
    mesh: Shape,
    options: BakeOptions,
    uv: Keep,
    polygons: Ints | None,
    progress: Progress,
) -> Atlas:
    """Keep texture coordinates with shared texels if the places that share them look alike; else unwrap anew or raise."""
    if contradicted > _MAX_CONTRADICTED:
        problem = f"they overlap, and {100 * contradicted:.0f} % of the overlapping surface looks different"
        return new_atlas(mesh, options.size, options.padding, uv, polygons, problem, progress)
    note_text = (
        f"{mesh.name}: its own texture coordinates give {100 * atlas.shared:.0f} % of their texels to several places"
    )
    return replace(atlas, note=f"{note_text}, as to mirrored halves; these look alike, and are baked once")


def _transfer_layout(shape: Shape, look: Appearance, maps: MapPair, polygons: Ints | None, size: int) -> Atlas:
    """Transfer the source's texture coordinates; `OptionError` if places that look different would share texels."""
    coordinates, charts = source_layout(shape, look, maps.target, maps.backward, polygons)
    name = shape.name or "the source"
    if layers := too_many_layers(coordinates, size):
        problem = f"the layout of {name} cannot be carried over: it covers the image {layers:.1f} times"
        raise OptionError(problem, "leave out --uv source")
    atlas = Atlas(coordinates, False, shared=shared_texels(coordinates))
    differ = bake.contradicting_share(shape, look, maps.target, maps.backward, atlas) if atlas.shared else 0.0
    if differ * atlas.shared > _MAX_CONTRADICTED:
        problem = (
            f"the layout of {name} cannot be carried over: of its texels {100 * atlas.shared:.0f} % have several places"
        )
        raise OptionError(f"{problem}, which look different", "leave out --uv source")
    pieces = f"{charts} chart{'s' if charts != 1 else ''}"
    note_text = f"the layout of {name} ({pieces}) was carried over"
    if atlas.shared > _MIN_REPORTED:
        note_text += f"; {100 * atlas.shared:.1f} % of its texels have several places and show one of them"
    return replace(atlas, note=note_text)
