"""Charts side by side in a square image, as large as they fit.

Each is put where most of what is there is close to it, in the best of four turns; all places are tried at once by Fourier
transforms of images of what is taken. In a finer image they are then moved closer together. Crumbs are put on shelves first,
in one block.
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
from meshmatch.geometry.triangles import flat_areas
from meshmatch.transfer.texels import texels_in
from meshmatch.transfer.tighten_charts import tightened

# All of these were set by hand.
_GRID, _FINE = 256, 4  # texels of the image in which places are looked for; how much finer they are at last
_ALIKE = 1e-6  # what is closer is the same
_MOST = 80  # charts that are moved one by one
_TIGHTENED = 12  # moves of each piece that are tried at last
_SHRINK, _STEPS = 0.995, 4  # of lengths, in which the largest with room for all charts is looked for; of them at once
_DENSE = 0.78  # of the image, that the charts and half of what is between them fill at the first try
_RINGS, _FADING = (
    5,
    0.7,
)  # texels around a piece in which others count as close, each ring so much less than the one before
_COUNTS = np.array([1.0, *_FADING ** np.arange(_RINGS), 0.0], np.float32)  # so many texels further than others may be
_LOW = 0.3  # how much it counts to lie low in the image, beside the share of the rings that is taken
_BETWEEN = 0.2  # of the image at most: what lies between crumbs, and between charts


@dataclass(frozen=True, eq=False)
class Chart:
    """Triangles of a surface that lie flat together."""

    members: Int[Ints, " n"]
    uv: Float[Floats, "M 2"]  # in the unit of the surface
    corners: Int[Ints, "n 3"]


def tightest(uv: Float[Floats, "M 2"]) -> tuple[float, float]:
    """The angle in radians at which the smallest rectangle around points lies, its long side along x; and its area."""
    try:
        hull = uv[ConvexHull(uv).vertices]
    except QhullError:  # all on a line
        hull = uv
    edges = np.roll(hull, -1, axis=0) - hull
    angle = np.arctan2(edges[:, 1], edges[:, 0])
    cosine, sine = np.cos(angle), np.sin(angle)
    wide = np.ptp(np.outer(cosine, hull[:, 0]) + np.outer(sine, hull[:, 1]), axis=1)
    high = np.ptp(np.outer(cosine, hull[:, 1]) - np.outer(sine, hull[:, 0]), axis=1)
    angle = np.where(wide >= high * (1 - _ALIKE), angle, angle + np.pi / 2) % np.pi
    angle = np.where(angle > np.pi - _ALIKE, 0.0, angle)
    least = float((wide * high).min())
    ties = np.flatnonzero(wide * high <= least * (1 + _ALIKE))  # rounding is not to decide
    return float(angle[ties].min()), least


def hull(uv: Float[Floats, "M 2"]) -> float:
    """The area of the convex hull."""
    try:
        return float(ConvexHull(uv).volume)
    except QhullError:
        return 0.0


def packed(charts: list[Chart], padding: float, seed: int = 0) -> list[Float[Floats, "M 2"]]:
    """Coordinates in 0..1 of each chart, all of one density and at least `padding` of the image apart, or less where there
    are so many that little else would be left.
    """
    pieces = [_Piece(chart.uv, chart.corners) for chart in charts]
    order = sorted(range(len(pieces)), key=lambda k: (-pieces[k].area, k))
    large, crumbs = order[:_MOST], order[_MOST:]
    moved = [pieces[k] for k in large]
    shelves: list[Floats] = []
    if crumbs:
        total = sum(piece.area for piece in pieces)
        between = min(padding, np.sqrt(_BETWEEN / len(crumbs))) * np.sqrt(2 * total)
        shelves, size = _on_shelves([pieces[k] for k in crumbs], between)
        moved.append(_Piece(np.array([[0, 0], [size[0], 0], size, [0, size[1]]]), np.array([[0, 1, 2], [0, 2, 3]])))
    padding = min(padding, np.sqrt(_BETWEEN / len(moved)))
    scale, places = _search(moved, padding, np.random.default_rng(seed))
    out: list[Floats] = [np.empty(0)] * len(charts)
    for k, piece, place in zip(large, moved, places, strict=False):
        out[k] = place.of(piece.uv * scale)
    for k, at in zip(crumbs, shelves, strict=True):
        out[k] = places[-1].of(moved[-1].turned(pieces[k].uv + at) * scale)
    return out


@dataclass(frozen=True, eq=False)
class _Turned:
    """A piece as an image, after quarter turns; with what must stay free around it; that with the rings, by what they count;
    and what all rings count together.
    """

    quarters: int
    image: Bools
    room: Bools
    rings: NDArray[np.float32]
    around: float


class _Piece:
    def __init__(self, uv: Floats, corners: Ints) -> None:
        angle = tightest(uv)[0]
        self.turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        self.low = (uv @ self.turn).min(axis=0)
        self.uv, self.corners = self.turned(uv), corners
        self.size = self.uv.max(axis=0)
        self.area = float(flat_areas(self.uv[corners]).sum())
        edges = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        key = edges.min(axis=1) * len(uv) + edges.max(axis=1)
        first, count = np.unique(key, return_index=True, return_counts=True)[1:]
        self.border = edges[first[count == 1]]
        self._known: tuple[float, int, list[_Turned]] = 0.0, 0, []

    def turned(self, uv: Floats) -> Floats:
        return np.asarray(uv @ self.turn - self.low)

    def turns(self, scale: float, apart: int) -> list[_Turned]:
        """Its image in four turns; those of the last scale are kept."""
        if self._known[:2] != (scale, apart):
            mask = self.mask(scale)
            away = distance_transform_cdt(~np.pad(mask, apart + _RINGS), "chessboard")
            rings = _COUNTS[np.clip(away - apart, 0, _RINGS + 1)]
            grown = away[_RINGS:-_RINGS, _RINGS:-_RINGS] <= apart
            around = float(rings.sum()) - int(grown.sum())
            turned = ((np.rot90(mask, k), np.rot90(grown, k), np.rot90(rings, k)) for k in range(4))
            self._known = scale, apart, [_Turned(k, *images, around) for k, images in enumerate(turned)]
        return self._known[2]

    def mask(self, scale: float) -> Bools:
        """The texels that it touches."""
        uv = self.uv * scale
        wide, high = np.floor(uv.max(axis=0)).astype(np.int64) + 1
        out = np.zeros((high, wide), bool)
        for _, x, y in texels_in(uv[self.corners]):
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
    """Quarter turns, and then the way, of a piece whose image is `size` texels wide and high; of an image of `grid`."""

    quarters: int
    size: tuple[int, int]
    x: int
    y: int
    grid: int

    def of(self, uv: Floats) -> Floats:
        wide, high = self.size
        for _ in range(self.quarters):  # as rot90 turns an image
            uv = np.stack([uv[:, 1], wide - uv[:, 0]], axis=1)
            wide, high = high, wide
        return np.asarray((uv + np.array([self.x, self.y])) / self.grid)


def _search(pieces: list[_Piece], padding: float, rng: np.random.Generator) -> tuple[float, list[_Place]]:
    """Texels per unit, and the places, at about the largest scale with room for all."""
    longest = np.array([piece.size[0] * np.sqrt(piece.area) for piece in pieces])
    order = np.argsort(-np.round(longest / max(float(longest.max()), 1e-300), 6), kind="stable")
    scale, most, larger = _first(pieces, padding), np.inf, 0  # steps up that are too many, and that are not
    while (last := _placed(pieces, order, scale, padding)) is None:
        scale, most = scale * _SHRINK**_STEPS, _STEPS
    while most - larger > 1:
        step = larger + 1 if np.isinf(most) else int(larger + most) // 2
        if (places := _placed(pieces, order, scale / _SHRINK**step, padding)) is None:
            most = step
        else:
            last, larger = places, step
    scale *= _FINE / _SHRINK**larger
    return scale, _tightened(pieces, last, scale, padding, rng)


def _tightened(
    pieces: list[_Piece], places: list[_Place], scale: float, padding: float, rng: np.random.Generator
) -> list[_Place]:
    """Places in a finer image, closer together, which is cut where the pieces end."""
    masks = [piece.mask(scale) for piece in pieces]
    images = [np.rot90(mask, place.quarters) for mask, place in zip(masks, places, strict=True)]
    low = [place.of(piece.uv * (scale / _FINE)).min(axis=0)[::-1] for piece, place in zip(pieces, places, strict=True)]
    at = np.floor(np.array(low) * (_GRID * _FINE) + 1e-6).astype(np.int64)
    corners, end = tightened(images, at, int(np.ceil(padding * _GRID * _FINE)), _TIGHTENED * len(pieces), rng)
    return [
        _Place(place.quarters, (mask.shape[1], mask.shape[0]), int(x), int(y), end)
        for place, mask, (y, x) in zip(places, masks, corners.tolist(), strict=True)
    ]


def _first(pieces: list[_Piece], padding: float) -> float:
    area = sum(piece.area for piece in pieces)
    around = sum(2 * float(piece.size.sum()) for piece in pieces) * padding * _GRID / 2
    # scale^2 area + scale around = dense grid^2
    return float((np.sqrt(around**2 + 4 * area * _DENSE * _GRID**2) - around) / (2 * area))


def _placed(pieces: list[_Piece], order: Ints, scale: float, padding: float) -> list[_Place] | None:
    """Places in this order; None if one finds none."""
    grid, apart = _GRID, int(np.ceil(padding * _GRID))
    span = next_fast_len(grid + 2 * apart + 2 * _RINGS, real=True)
    taken = np.zeros((span, span), np.float32)  # behind what may lie before a piece: its rings
    inside = taken[apart + _RINGS :, apart + _RINGS :]
    places: list[_Place | None] = [None] * len(pieces)
    for k in order.tolist():
        turns = pieces[k].turns(scale, apart)
        shape = turns[0].image.shape
        if max(shape) > grid:
            return None
        best, found = -np.inf, None
        known, transforms = rfft2(taken), []
        for turned in turns:
            high, wide = turned.image.shape
            rows, columns = grid - high + 1, grid - wide + 1
            if turned.quarters < 2:
                transforms.append([_transform(each, span) for each in (turned.room, turned.rings)])
            room, rings = transforms[turned.quarters % 2]
            free = _sums(known, room, turned.quarters, turned.room.shape, _RINGS, rows, columns) < 0.5
            if not free.any():
                continue
            close = _sums(known, rings, turned.quarters, turned.rings.shape, 0, rows, columns)
            for ring in range(min(_RINGS, rows, columns)):  # the border of the image counts as taken
                close[[ring, -1 - ring]] += wide * _FADING**ring
                close[:, [ring, -1 - ring]] += high * _FADING**ring
            low = (np.arange(rows) + high) * (_LOW / grid)
            score = np.where(free, close / turned.around - low[:, None], -np.inf)
            at = int(np.round(score, 4).argmax())
            if score.flat[at] > best + _ALIKE:
                best, found = float(score.flat[at]), (turned, *divmod(at, score.shape[1]))
        if found is None:
            return None
        turned, y, x = found
        inside[y : y + turned.image.shape[0], x : x + turned.image.shape[1]] += turned.image
        places[k] = _Place(turned.quarters, (shape[1], shape[0]), x, y, grid)
    return [place for place in places if place]


def _transform(image: NDArray[Any], span: int) -> NDArray[np.complex64]:
    """Of an image at the corner of an empty one."""
    rows = np.zeros((len(image), span), np.float32)
    rows[:, : image.shape[1]] = image
    whole = np.zeros((span, span // 2 + 1), np.complex64)
    whole[: len(image)] = rfft(rows, axis=1)
    return np.asarray(fft(whole, axis=0, overwrite_x=True))


def _sums(
    known: NDArray[np.complex64],
    image: NDArray[np.complex64],
    quarters: int,
    size: tuple[int, ...],
    first: int,
    rows: int,
    columns: int,
) -> Float[Floats, "R C"]:
    """What is taken of an image at every place from the ``first``, by transforms: its own, or those before half a turn."""
    span = len(known)
    begin, left = (first + size[0] - 1, first + size[1] - 1) if quarters >= 2 else (first, first)
    product = ifft(known * (image if quarters >= 2 else np.conj(image)), axis=0, overwrite_x=True)
    return np.asarray(irfft(product[begin : begin + rows], span, axis=1)[:, left : left + columns])


def _on_shelves(pieces: list[_Piece], between: float) -> tuple[list[Floats], Floats]:
    """Where pieces stand in rows, and the size of all, nearly a square."""
    sizes = np.array([piece.size for piece in pieces]) + between
    order = np.argsort(-sizes[:, 1], kind="stable")
    width = max(float(np.sqrt(sizes.prod(axis=1).sum())), float(sizes[:, 0].max()))
    ends = np.cumsum(sizes[order, 0])
    at = np.zeros((len(pieces), 2))
    begin, y, done = 0, 0.0, 0.0
    while begin < len(order):
        end = max(int(np.searchsorted(ends, done + width, side="right")), begin + 1)
        row = order[begin:end]
        at[row, 0], at[row, 1] = ends[begin:end] - sizes[row, 0] - done, y
        y += float(sizes[row, 1].max())
        begin, done = end, float(ends[end - 1])
    return list(at), np.array([width, max(y, 1e-300)]) - between
