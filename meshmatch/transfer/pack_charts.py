"""Packing of charts into a square image, as large as they fit.

Charts are placed one by one, each where its surroundings are most occupied, in the best of four orientations; all places are
scored at once by FFT correlations. The places are then tightened in a finer image. Small charts are first put on shelves, in
one block.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft, ifft, irfft, next_fast_len, rfft, rfft2
from scipy.ndimage import distance_transform_cdt
from scipy.spatial import ConvexHull, QhullError

from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.geometry.triangles import planar_areas
from meshmatch.transfer.texels import covered_texels
from meshmatch.transfer.tighten_charts import tighten

# All of these were set by hand.
_GRID, _REFINEMENT = 256, 4  # texels of the image in which places are searched; how much finer the last one is
_TOLERANCE = 1e-6  # relative; smaller differences are ties
_MAX_PIECES = 80  # charts that are placed one by one
_MOVES_PER_PIECE = 12  # moves that are tried at the end, per piece on average
# Factor of lengths between scales, in the search for the largest one that fits; steps at once while none has fit.
_SHRINK, _STEPS = 0.995, 4
_FIRST_FILL = 0.78  # share of the image that charts and half of the gaps fill at the first scale tried
# Rings of texels around a piece in which others count as close, and the weight of each ring relative to the one before.
_RINGS, _RING_DECAY = 5, 0.7
_RING_WEIGHTS = np.array([1.0, *_RING_DECAY ** np.arange(_RINGS), 0.0], np.float32)  # by distance beyond the padding
_LOW_WEIGHT = 0.3  # weight of a low place in the image, relative to the occupied share of the rings
_MAX_GAP_SHARE = 0.2  # share of the image at most for gaps between small charts, and between charts


@dataclass(frozen=True, eq=False)
class Chart:
    """Triangles of a surface that are flattened together."""

    members: Int[Ints, " n"]
    uv: Float[Floats, "M 2"]  # in the unit of the surface
    corners: Int[Ints, "n 3"]


def smallest_rectangle(uv: Float[Floats, "M 2"]) -> tuple[float, float]:
    """Angle in radians, 0 to pi, of the long side of the smallest rectangle around points, and the rectangle's area."""
    try:
        hull_area = uv[ConvexHull(uv).vertices]
    except QhullError:  # all on a line
        hull_area = uv
    edges = np.roll(hull_area, -1, axis=0) - hull_area
    angle = np.arctan2(edges[:, 1], edges[:, 0])
    cosine, sine = np.cos(angle), np.sin(angle)
    wide = np.ptp(np.outer(cosine, hull_area[:, 0]) + np.outer(sine, hull_area[:, 1]), axis=1)
    high = np.ptp(np.outer(cosine, hull_area[:, 1]) - np.outer(sine, hull_area[:, 0]), axis=1)
    angle = np.where(wide >= high * (1 - _TOLERANCE), angle, angle + np.pi / 2) % np.pi
    angle = np.where(angle > np.pi - _TOLERANCE, 0.0, angle)
    least = float((wide * high).min())
    ties = np.flatnonzero(wide * high <= least * (1 + _TOLERANCE))  # rounding must not decide
    return float(angle[ties].min()), least


def hull_area(uv: Float[Floats, "M 2"]) -> float:
    """Area of the convex hull; 0 for points on a line."""
    try:
        return float(ConvexHull(uv).volume)
    except QhullError:
        return 0.0


def pack_charts(charts: list[Chart], padding: float, seed: int = 0) -> list[Float[Floats, "M 2"]]:
    """Coordinates in 0..1 of each chart, at one scale and at least `padding` of the image apart; less where so many charts
    would leave little room for anything else.
    """
    pieces = [_Piece(chart.uv, chart.corners) for chart in charts]
    order = sorted(range(len(pieces)), key=lambda k: (-pieces[k].area, k))
    large, crumbs = order[:_MAX_PIECES], order[_MAX_PIECES:]
    placed = [pieces[k] for k in large]
    shelves: list[Floats] = []
    if crumbs:
        total = sum(piece.area for piece in pieces)
        gap = min(padding, np.sqrt(_MAX_GAP_SHARE / len(crumbs))) * np.sqrt(2 * total)
        shelves, size = _put_on_shelves([pieces[k] for k in crumbs], gap)
        placed.append(_Piece(np.array([[0, 0], [size[0], 0], size, [0, size[1]]]), np.array([[0, 1, 2], [0, 2, 3]])))
    padding = min(padding, np.sqrt(_MAX_GAP_SHARE / len(placed)))
    scale, places = _search(placed, padding, np.random.default_rng(seed))
    out: list[Floats] = [np.empty(0)] * len(charts)
    for k, piece, place in zip(large, placed, places, strict=False):
        out[k] = place.apply(piece.uv * scale)
    for k, at in zip(crumbs, shelves, strict=True):
        out[k] = places[-1].apply(placed[-1].align(pieces[k].uv + at) * scale)
    return out


@dataclass(frozen=True, eq=False)
class _RotatedPiece:
    """A rotated piece as images: itself, with the padding that must stay free, with rings by their weights; and the sum of
    the weights of all rings.
    """

    quarters: int
    image: Bools
    room: Bools
    rings: NDArray[np.float32]
    ring_total: float


class _Piece:
    """A chart aligned with its smallest rectangle."""

    def __init__(self, uv: Floats, corners: Ints) -> None:
        angle = smallest_rectangle(uv)[0]
        self.rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        self.low = (uv @ self.rotation).min(axis=0)
        self.uv, self.corners = self.align(uv), corners
        self.size = self.uv.max(axis=0)
        self.area = float(planar_areas(self.uv[corners]).sum())
        edges = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        key = edges.min(axis=1) * len(uv) + edges.max(axis=1)
        first, count = np.unique(key, return_index=True, return_counts=True)[1:]
        self.border = edges[first[count == 1]]
        self._cache: tuple[float, int, list[_RotatedPiece]] = 0.0, 0, []

    def align(self, uv: Floats) -> Floats:
        return np.asarray(uv @ self.rotation - self.low)

    def rotations(self, scale: float, gap: int) -> list[_RotatedPiece]:
        """Images in four rotations; those of the last scale are cached."""
        if self._cache[:2] != (scale, gap):
            mask = self.mask(scale)
            distance = distance_transform_cdt(~np.pad(mask, gap + _RINGS), "chessboard")
            rings = _RING_WEIGHTS[np.clip(distance - gap, 0, _RINGS + 1)]
            grown = distance[_RINGS:-_RINGS, _RINGS:-_RINGS] <= gap
            ring_total = float(rings.sum()) - int(grown.sum())
            rotated = ((np.rot90(mask, k), np.rot90(grown, k), np.rot90(rings, k)) for k in range(4))
            self._cache = scale, gap, [_RotatedPiece(k, *images, ring_total) for k, images in enumerate(rotated)]
        return self._cache[2]

    def mask(self, scale: float) -> Bools:
        """The texels that the piece touches."""
        uv = self.uv * scale
        wide, high = np.floor(uv.max(axis=0)).astype(np.int64) + 1
        out = np.zeros((high, wide), bool)
        for _, x, y in covered_texels(uv[self.corners]):
            out[np.minimum(y, high - 1), np.minimum(x, wide - 1)] = True
        begin, along = uv[self.border[:, 0]], uv[self.border[:, 1]] - uv[self.border[:, 0]]
        steps = np.maximum(np.ceil(2 * np.abs(along).max(axis=1)), 1).astype(np.int64)
        edge = np.repeat(np.arange(len(steps)), steps)
        step = np.arange(len(edge)) - np.repeat(np.cumsum(steps) - steps, steps)
        x, y = (begin[edge] + along[edge] * (step / steps[edge])[:, None]).astype(np.int64).T
        out[np.minimum(y, high - 1), np.minimum(x, wide - 1)] = True
        return out


@dataclass(frozen=True, eq=False)
class _Place:
    """Quarter turns, then a translation in texels, of a piece whose image is `size` texels wide and high; in an image of
    `grid` texels.
    """

    quarters: int
    size: tuple[int, int]
    x: int
    y: int
    grid: int

    def apply(self, uv: Floats) -> Floats:
        wide, high = self.size
        for _ in range(self.quarters):  # as rot90 turns an image
            uv = np.stack([uv[:, 1], wide - uv[:, 0]], axis=1)
            wide, high = high, wide
        return np.asarray((uv + np.array([self.x, self.y])) / self.grid)


def _search(pieces: list[_Piece], padding: float, rng: np.random.Generator) -> tuple[float, list[_Place]]:
    """Texels per unit, and the places, at about the largest scale at which all pieces fit."""
    longest = np.array([piece.size[0] * np.sqrt(piece.area) for piece in pieces])
    order = np.argsort(-np.round(longest / max(float(longest.max()), 1e-300), 6), kind="stable")
    scale, too_large, fits = _initial_scale(pieces, padding), np.inf, 0  # steps up that are too many, and that fit
    while (last := _place_all(pieces, order, scale, padding)) is None:
        scale, too_large = scale * _SHRINK**_STEPS, _STEPS
    while too_large - fits > 1:
        step = fits + 1 if np.isinf(too_large) else int(fits + too_large) // 2
        if (places := _place_all(pieces, order, scale / _SHRINK**step, padding)) is None:
            too_large = step
        else:
            last, fits = places, step
    scale *= _REFINEMENT / _SHRINK**fits
    return scale, _tighten_places(pieces, last, scale, padding, rng)


def _tighten_places(
    pieces: list[_Piece], places: list[_Place], scale: float, padding: float, rng: np.random.Generator
) -> list[_Place]:
    """Tighten places in a finer image, which is then cropped to the pieces."""
    masks = [piece.mask(scale) for piece in pieces]
    images = [np.rot90(mask, place.quarters) for mask, place in zip(masks, places, strict=True)]
    low = [
        place.apply(piece.uv * (scale / _REFINEMENT)).min(axis=0)[::-1]
        for piece, place in zip(pieces, places, strict=True)
    ]
    at = np.floor(np.array(low) * (_GRID * _REFINEMENT) + 1e-6).astype(np.int64)
    corners, end = tighten(images, at, int(np.ceil(padding * _GRID * _REFINEMENT)), _MOVES_PER_PIECE * len(pieces), rng)
    return [
        _Place(place.quarters, (mask.shape[1], mask.shape[0]), int(x), int(y), end)
        for place, mask, (y, x) in zip(places, masks, corners.tolist(), strict=True)
    ]


def _initial_scale(pieces: list[_Piece], padding: float) -> float:
    """A scale at which pieces and gaps fill the intended share of the image."""
    area = sum(piece.area for piece in pieces)
    perimeter = sum(2 * float(piece.size.sum()) for piece in pieces) * padding * _GRID / 2
    # scale^2 area + scale around = dense grid^2
    return float((np.sqrt(perimeter**2 + 4 * area * _FIRST_FILL * _GRID**2) - perimeter) / (2 * area))


def _place_all(pieces: list[_Piece], order: Ints, scale: float, padding: float) -> list[_Place] | None:
    """Place the pieces in this order; None if one does not fit."""
    grid, gap = _GRID, int(np.ceil(padding * _GRID))
    span = next_fast_len(grid + 2 * gap + 2 * _RINGS, real=True)
    occupancy = np.zeros((span, span), np.float32)  # offset, as the rings of a piece may reach over the image's border
    inside = occupancy[gap + _RINGS :, gap + _RINGS :]
    places: list[_Place | None] = [None] * len(pieces)
    for k in order.tolist():
        rotations = pieces[k].rotations(scale, gap)
        shape = rotations[0].image.shape
        if max(shape) > grid:
            return None
        best, found = -np.inf, None
        occupied, transforms = rfft2(occupancy), []
        for turned in rotations:
            high, wide = turned.image.shape
            rows, columns = grid - high + 1, grid - wide + 1
            if turned.quarters < 2:
                transforms.append([_transform(each, span) for each in (turned.room, turned.rings)])
            room, rings = transforms[turned.quarters % 2]
            free = _correlate(occupied, room, turned.quarters, turned.room.shape, _RINGS, rows, columns) < 0.5
            if not free.any():
                continue
            close = _correlate(occupied, rings, turned.quarters, turned.rings.shape, 0, rows, columns)
            for ring in range(min(_RINGS, rows, columns)):  # the image's border counts as occupied
                close[[ring, -1 - ring]] += wide * _RING_DECAY**ring
                close[:, [ring, -1 - ring]] += high * _RING_DECAY**ring
            low = (np.arange(rows) + high) * (_LOW_WEIGHT / grid)
            score = np.where(free, close / turned.ring_total - low[:, None], -np.inf)
            at = int(np.round(score, 4).argmax())
            if score.flat[at] > best + _TOLERANCE:
                best, found = float(score.flat[at]), (turned, *divmod(at, score.shape[1]))
        if found is None:
            return None
        turned, y, x = found
        inside[y : y + turned.image.shape[0], x : x + turned.image.shape[1]] += turned.image
        places[k] = _Place(turned.quarters, (shape[1], shape[0]), x, y, grid)
    return [place for place in places if place]


def _transform(image: NDArray[Any], span: int) -> NDArray[np.complex64]:
    """Real FFT of an image in the corner of an empty one."""
    rows = np.zeros((len(image), span), np.float32)
    rows[:, : image.shape[1]] = image
    padded = np.zeros((span, span // 2 + 1), np.complex64)
    padded[: len(image)] = rfft(rows, axis=1)
    return np.asarray(fft(padded, axis=0, overwrite_x=True))


def _correlate(
    occupied: NDArray[np.complex64],
    image: NDArray[np.complex64],
    quarters: int,
    size: tuple[int, ...],
    first: int,
    rows: int,
    columns: int,
) -> Float[Floats, "R C"]:
    """Correlation of the occupied texels with an image, at all places from ``first`` on. ``image`` is the transform of the
    image, or of the image before a half turn where ``quarters`` is 2 or more.
    """
    span = len(occupied)
    begin, left = (first + size[0] - 1, first + size[1] - 1) if quarters >= 2 else (first, first)
    product = ifft(occupied * (image if quarters >= 2 else np.conj(image)), axis=0, overwrite_x=True)
    return np.asarray(irfft(product[begin : begin + rows], span, axis=1)[:, left : left + columns])


def _put_on_shelves(pieces: list[_Piece], gap: float) -> tuple[list[Floats], Floats]:
    """Positions of pieces in rows, and the size of the whole block, which is nearly a square."""
    sizes = np.array([piece.size for piece in pieces]) + gap
    order = np.argsort(-sizes[:, 1], kind="stable")
    width = max(float(np.sqrt(sizes.prod(axis=1).sum())), float(sizes[:, 0].max()))
    ends = np.cumsum(sizes[order, 0])
    at = np.zeros((len(pieces), 2))
    begin, y, filled = 0, 0.0, 0.0
    while begin < len(order):
        end = max(int(np.searchsorted(ends, filled + width, side="right")), begin + 1)
        row = order[begin:end]
        at[row, 0], at[row, 1] = ends[begin:end] - sizes[row, 0] - filled, y
        y += float(sizes[row, 1].max())
        begin, filled = end, float(ends[end - 1])
    return list(at), np.array([width, max(y, 1e-300)]) - gap
