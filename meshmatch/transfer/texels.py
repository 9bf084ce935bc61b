"""Which triangle lies on each texel of an atlas: scanlines, for all triangles at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Bools, Floats, Ints, Ints32

_AT_ONCE = 1 << 21  # texels
MOST_ROWS = 40_000_000
"""Of all triangles together; coordinates that need more are no atlas."""


@dataclass(frozen=True, eq=False)
class Spans:
    """Runs of texels whose centers lie in a triangle: face (N,), row (N,), first column (N,), length (N,).

    A center on an edge belongs to one of the two triangles that share it. Rows and columns are not bounded.
    """

    face: Ints
    row: Ints
    first: Ints
    length: Ints

    @property
    def texels(self) -> int:
        """How many there are in all, those that several triangles hold counted each time."""
        return int(self.length.sum())

    def expanded(self) -> Iterator[tuple[Ints, Ints, Ints]]:
        """Face, column and row of every texel, some millions at a time."""
        ends = np.cumsum(self.length)
        low, done = 0, 0
        while low < len(ends):
            high = max(int(np.searchsorted(ends, done + _AT_ONCE, side="right")), low + 1)
            length = self.length[low:high]
            span = np.repeat(np.arange(low, high), length)
            begins = np.cumsum(length) - length
            column = self.first[span] + np.arange(len(span)) - np.repeat(begins, length)
            yield self.face[span], column, self.row[span]
            low, done = high, int(ends[high - 1])


def rows_of(corners: Floats) -> Ints:
    """(F,) how many rows of texel centers each triangle (F, 3, 2) crosses."""
    y = corners[:, :, 1]
    return np.asarray(np.ceil(y.max(axis=1) - 0.5) - np.ceil(y.min(axis=1) - 0.5), np.int64)


def spans(corners: Floats) -> Spans:
    """The texels of triangles (F, 3, 2), whose coordinates count texels: column, row."""
    order = np.lexsort((corners[:, :, 0], corners[:, :, 1]), axis=1)
    top, middle, low = (np.take_along_axis(corners, order[:, k, None, None], axis=1)[:, 0] for k in range(3))
    first_row = np.ceil(top[:, 1] - 0.5).astype(np.int64)
    rows = np.ceil(low[:, 1] - 0.5).astype(np.int64) - first_row
    face = np.repeat(np.arange(len(corners)), rows)
    row = np.arange(len(face)) - np.repeat(np.cumsum(rows) - rows, rows) + first_row[face]
    y = row + 0.5
    long_edge = _crossing(top[face], low[face], y)
    upper = y < middle[face, 1]
    begin = np.where(upper[:, None], top[face], middle[face])
    end = np.where(upper[:, None], middle[face], low[face])
    short_edge = _crossing(begin, end, y)
    first = np.ceil(np.minimum(long_edge, short_edge) - 0.5).astype(np.int64)
    length = np.ceil(np.maximum(long_edge, short_edge) - 0.5).astype(np.int64) - first
    some = length > 0
    return Spans(face[some], row[some], first[some], length[some])


def _crossing(begin: Floats, end: Floats, y: Floats) -> Floats:
    """Where edges cross rows. An edge of two triangles comes in one order, so both get the same number."""
    height = end[:, 1] - begin[:, 1]
    share = (y - begin[:, 1]) / np.where(height == 0, 1.0, height)
    return np.asarray(begin[:, 0] + (end[:, 0] - begin[:, 0]) * share)


def faces_on(corners: Floats, size: int) -> tuple[Ints32, int]:
    """The triangle on each texel of a square image, (size, size) with -1 for none, and how many texels are held
    more than once. Where several hold one, the last stays.
    """
    found = np.full(size * size, -1, np.int32)
    total = 0
    for face, column, row in spans(corners).expanded():
        inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
        found[(row * size + column)[inside]] = face[inside]
        total += int(inside.sum())
    return found.reshape(size, size), total - int((found >= 0).sum())


def grown(found: Ints32, steps: int) -> Ints32:
    """The same with each texel that is free, but has a neighbour that is not, taking over from it; `steps` times."""
    for _ in range(steps):
        out = found.copy()
        for straight in (True, False):
            for down in (-1, 0, 1):
                for right in (-1, 0, 1):
                    if (down == 0) == (right == 0) if straight else 0 in (down, right):
                        continue
                    to, source = _shifted(down, right)
                    part = out[to]
                    np.copyto(part, found[source], where=part < 0)
        found = out
    return found


def _shifted(down: int, right: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of an image and of its neighbour's image, moved by one."""
    ahead, back, whole = slice(1, None), slice(None, -1), slice(None)
    pick = {1: (ahead, back), -1: (back, ahead), 0: (whole, whole)}
    return (pick[down][0], pick[right][0]), (pick[down][1], pick[right][1])


def beside_another(values: Ints32) -> Bools:
    """(H, W) True for texels with a value (0 or more) that have a neighbour with another one."""
    out = np.zeros(values.shape, bool)
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        differ = (values[a] != values[b]) & (values[a] >= 0) & (values[b] >= 0)
        out[a] |= differ
        out[b] |= differ
    return out
