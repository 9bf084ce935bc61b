"""Texture atlases of targets: their own texture coordinates where these are valid, else new ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints, ShortRepr
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.triangles import planar_areas
from meshmatch.progress import Progress
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.flat_layout import weld
from meshmatch.transfer.new_charts import new_charts
from meshmatch.transfer.texels import MAX_ROWS, count_rows, draw_triangles

Keep = Literal["auto", "keep", "new", "source"]
# Share of the used texels that may be covered twice without a note: rounding at the edges of charts.
_NEGLIGIBLE_OVERLAP = 0.002
# Share up to which overlaps are only noted: layouts made by hand overlap here and there.
_MAX_OVERLAP = 0.02
# How often the image may be covered, as by mirrored halves, or by legs that look alike.
_MAX_LAYERS = 8.0
# Coordinates must use this share of the image, and may starve this share of the surface.
_MIN_USED, _MAX_STARVED = 0.05, 0.02
# A triangle is starved if it has less than this fraction of the room in the image that its area is due.
_STARVED = 1e-3
_MARGIN = 2  # texels at the border of the image
_FIRST_TILE = 1001
_MAX_TEXELS = 1 << 28  # of all tiles together
_NEW_HINT = "leave out --uv keep: new ones are made"
# Length of an edge, in units of sqrt(area): a longer one leaves no room for anything else in a square.
_MAX_EDGE = 500.0


@dataclass(frozen=True, eq=False, repr=False)
class Atlas(ShortRepr):
    """Texture coordinates that give every point of a surface its own place in an image."""

    uv: Float[Floats, "F 3 2"]  # within 0..1, u to the right, v down; zeros for a face without area
    own: bool  # whether they are those of the file
    note: str = ""  # why the file's own are not used, or what is unusual about them
    shared: float = 0.0  # share of the used texels that several places share, as mirrored halves do; 0 if negligible
    tiles: Int[Ints, " F"] | None = None  # tile of each face (UDIM, 1001 to 1100), where one image is not enough

    @property
    def laid(self) -> Float[Floats, "F 3 2"]:
        """The coordinates as stored in files: each tile at its place, to the right of 0..1 or above it (v below 0)."""
        if self.tiles is None:
            return self.uv
        row, column = np.divmod(self.tiles - _FIRST_TILE, 10)
        return np.asarray(self.uv + np.stack([column, -row], axis=1)[:, None])

    def of_tile(self, tile: int) -> Atlas:
        """An atlas of the faces of one tile; the other faces have no area in it."""
        others = np.flatnonzero(self.tiles != tile)
        uv = self.uv.copy()
        uv[others] = 0.0
        return replace(self, uv=uv, tiles=None)


def atlas_of(
    shape: Shape,
    own: Floats | None,
    size: int,
    padding: int,
    keep: Keep = "auto",
    polygons: Ints | None = None,
    tiled: bool = True,
    progress: Progress = Progress(),
) -> Atlas:
    """Choose the coordinates for baking an image of a size.

    Parameters
    ----------
    shape
        The target.
    own
        (F, 3, 2) texture coordinates of its file, if any.
    size, padding
        Texels along a side of the image, and minimum number of texels between new charts.
    keep
        "auto" uses the file's own if they are valid, else new ones; "keep" fails if they are not valid; "new" ignores them.
    polygons
        (F,) the polygon that each triangle belongs to: new seams do not cross polygons.
    tiled
        Whether own coordinates in several tiles stay there.
    progress
        Called with the share (0..1) of unwrapping that is done, approximately.

    Raises
    ------
    OptionError
        The target is a cloud, or coordinates to keep are not valid.
    InputError
        The target has no area, or has triangles as thin as a thread.
    """
    name = shape.name or "the target"
    check_surface(shape)
    if own is not None and keep != "new":
        tiles = tiles_of(shape, own, size) if tiled else None
        if tiles is not None:
            message = f"{name}: its own texture coordinates lie in the tiles {', '.join(map(str, np.unique(tiles)))}"
            return Atlas(
                np.clip(_into_unit_square(own, shape), 0.0, 1.0), True, f"{message}: an image for each", tiles=tiles
            )
        within, problem, shared = _check_coordinates(own, shape, size)
        if not problem:
            message = f"{name}: its own texture coordinates overlap on {100 * shared:.1f} % of their texels"
            note = f"{message}, each of which shows only one of two places" if shared > _NEGLIGIBLE_OVERLAP else ""
            return Atlas(within, True, note, shared if shared > _MAX_OVERLAP else 0.0)
        return new_atlas(shape, size, padding, keep, polygons, problem, progress)
    if keep == "keep":
        raise OptionError(f"{name} has no texture coordinates to keep", _NEW_HINT)
    return Atlas(unwrapped(shape, size, padding, polygons, progress), False)


def check_surface(shape: Shape) -> None:
    """Raise an error for a target without a surface for a texture: `OptionError` for a cloud, `InputError` without area."""
    name = shape.name or "the target"
    if shape.is_cloud:
        problem = f"{name} is a point cloud, which has no surface for a texture"
        raise OptionError(problem, "its points can have colors: end the output in .ply")
    if not (shape.face_areas > 0).any():
        raise InputError(f"{name} has no triangle with an area", "is it a mesh?")


def new_atlas(
    shape: Shape,
    size: int,
    padding: int,
    keep: Keep,
    polygons: Ints | None,
    problem: str,
    progress: Progress = Progress(),
) -> Atlas:
    """New coordinates instead of the file's own, because of a `problem` with these; `OptionError` if the file's own must be
    kept, `InputError` for triangles as thin as a thread.
    """
    message = f"{shape.name or 'the target'}: its own texture coordinates cannot be used: {problem}"
    if keep == "keep":
        raise OptionError(message, _NEW_HINT)
    return Atlas(unwrapped(shape, size, padding, polygons, progress), False, f"{message}; new ones were made")


def _check_coordinates(uv: Floats, shape: Shape, size: int) -> tuple[Floats, str, float]:
    """Check coordinates for baking.

    Returns them, moved into 0..1 by whole numbers per triangle; why they cannot be used, empty if they can; and the share of
    the used texels that several places share.
    """
    real = shape.face_areas > 0
    if not np.isfinite(uv[real]).all():
        return uv, "some are not numbers", 0.0
    if np.abs(uv[real]).max() > 1e6:
        return uv, "some are absurdly large", 0.0
    out = _into_unit_square(uv, shape)
    n_outside = int((out.max(axis=(1, 2)) > 1.0 + 1e-5).sum())
    if n_outside:
        return out, f"{n_outside} faces reach out of range, over the edge of the image", 0.0
    uv = np.clip(out, 0.0, 1.0)
    room = planar_areas(uv)
    if room.sum() < _MIN_USED:
        return uv, f"they use only {100 * room.sum():.1f} % of the image", 0.0
    if layers := too_many_layers(uv, size):
        return uv, f"they overlap ({layers:.1f} times the image)", 0.0
    due = shape.face_areas / shape.face_areas.sum()
    starved = float(due[room < _STARVED * due].sum())
    if starved > _MAX_STARVED:
        return uv, f"{100 * starved:.0f} % of the surface has no room in the image", 0.0
    return uv, "", shared_texels(uv, size)


def _into_unit_square(uv: Floats, shape: Shape) -> Floats:
    """Coordinates moved by whole numbers, per triangle, so that they begin in 0..1; zeros for triangles without area."""
    out = np.where((shape.face_areas > 0)[:, None, None], uv, 0.0)
    return np.asarray(out - np.floor(out.min(axis=1, keepdims=True) + 1e-5))


def tiles_of(shape: Shape, uv: Float[Floats, "F 3 2"], size: int) -> Int[Ints, " F"] | None:
    """The tile (UDIM, 1001 to 1100) of each face, by its coordinates (v down).

    None where one image is enough for all faces, or where tiles with images of `size` cannot be used either: a face reaches
    from one tile into another, or several places share one.
    """
    real = shape.face_areas > 0
    if not real.any() or not (np.isfinite(uv[real]).all() and np.abs(uv[real]).max() <= 10.0 + 1e-5):
        return None
    upwards = np.where(real[:, None, None], uv * [1.0, -1.0] + [0.0, 1.0], 0.0)
    place = np.floor(upwards.min(axis=1) + 1e-5).astype(np.int64)
    number = _FIRST_TILE + place @ [1, 10]
    found = np.unique(number[real])
    crosses_tiles = (
        (upwards.max(axis=1) > place + 1.0 + 1e-5).any(axis=1) | (place < 0).any(axis=1) | (place > 9).any(axis=1)
    )
    if crosses_tiles[real].any() or len(found) < 2 or len(found) * size**2 > _MAX_TEXELS:
        return None
    within = np.clip(_into_unit_square(uv, shape), 0.0, 1.0)
    room, due = planar_areas(within), shape.face_areas / shape.face_areas.sum()
    if room.sum() < _MIN_USED or due[room < _STARVED * due].sum() > _MAX_STARVED:
        return None
    if not too_many_layers(within, size) and shared_texels(within, size) <= _MAX_OVERLAP:
        return None
    for tile in found:
        inside = within[real & (number == tile)]
        if too_many_layers(inside, size) or shared_texels(inside, size) > _MAX_OVERLAP:
            return None
    return np.asarray(np.where(real, number, found[0]))


def too_many_layers(uv: Float[Floats, "F 3 2"], size: int) -> float:
    """How often triangles cover an image, if that is too often for a comparison texel by texel; else 0."""
    layers = float(planar_areas(uv).sum())
    return layers if layers > _MAX_LAYERS or count_rows(uv * size).sum() > MAX_ROWS else 0.0


def shared_texels(uv: Float[Floats, "F 3 2"], size: int = 1024) -> float:
    """Share of the used texels of an image that several triangles cover."""
    found, n_surplus = draw_triangles(uv * size, size)
    used = found >= 0
    if n_surplus <= _MAX_OVERLAP * used.sum():
        return n_surplus / max(int(used.sum()), 1)
    other = draw_triangles(uv[::-1] * size, size)[0]
    return float((other[used] != len(uv) - 1 - found[used]).mean())


def unwrapped(
    shape: Shape, size: int, padding: int, polygons: Ints | None = None, progress: Progress = Progress()
) -> Floats:
    """(F, 3, 2) new coordinates, not mirrored; `InputError` for triangles as thin as a thread."""
    real = np.flatnonzero(shape.face_areas > 0)
    used, corners = np.unique(shape.faces[real], return_inverse=True)
    verts = shape.verts[used]
    verts = (verts - verts.mean(axis=0)) / max(float(np.sqrt(shape.face_areas.sum())), 1e-300)
    corners = corners.reshape(-1, 3)
    edges = verts[corners] - verts[corners[:, [1, 2, 0]]]
    if np.sqrt((edges**2).sum(axis=2).max()) > _MAX_EDGE:
        problem = f"{shape.name or 'the target'} cannot be unwrapped (it has triangles as thin as a thread)"
        raise InputError(problem, "unwrap it in a modelling program, and use --uv keep")
    corners = weld(verts, corners)
    if (is_triangle := (corners != corners[:, [1, 2, 0]]).all(axis=1)).any():
        real, corners = real[is_triangle], corners[is_triangle]
    uv = new_charts(verts, corners, size, padding, None if polygons is None else polygons[real], progress)
    out = np.zeros((shape.F, 3, 2))
    # A margin at the border too: a repeated image continues there with its opposite side.
    margin = min(_MARGIN, padding) / size
    uv[..., 1] = 1.0 - uv[..., 1]  # v runs down
    out[real] = margin + (1.0 - 2.0 * margin) * uv
    return out
