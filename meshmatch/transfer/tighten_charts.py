"""Tightening of pieces in an image, until a smaller square holds them all.

The square shrinks in small steps. Pieces that this pushes into others are moved, one after the other, to where they overlap
the others least within a short distance. Pairs that keep overlapping weigh more each round, so that others give way (guided
local search, Voudouris and Tsang 1999).
"""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import maximum_filter

from meshmatch.arrays import Bools, Int, Ints

# All of these were set by hand.
_STEP = 2  # texels by which the square shrinks
_REACH = 12  # texels that a piece moves at once, at most
# Factor of the weight of pairs that overlap, what the worst pair gets in addition, and the factor of all others.
_GROWTH, _WORST_GROWTH, _DECAY = 1.2, 0.8, 0.95
_MOVE_COST = 1e-3  # cost of a texel moved, relative to a texel of overlap


def tighten(
    images: list[Bools], at: Int[Ints, "N 2"], gap: int, moves: int, rng: np.random.Generator
) -> tuple[Int[Ints, "N 2"], int]:
    """Positions of the pieces, and the side of the square that holds them.

    Parameters
    ----------
    images
        Occupied texels of each piece.
    at
        Row and column of each image's first corner; pieces are at least `gap` apart.
    gap
        Texels that must be free around a piece.
    moves
        Maximum number of moves in all; each moves one piece.
    """
    packing = _Packing(images, at, gap, rng)
    largest = int(packing.sizes.max())
    while True:
        kept, end = packing.at.copy(), packing.side
        packing.side -= _STEP
        if packing.side < largest or not packing.separate(moves):
            return kept, end


class _Packing:
    """Pieces in a square, with the weights of their overlaps."""

    def __init__(self, images: list[Bools], at: Ints, gap: int, rng: np.random.Generator) -> None:
        self.images, self.at, self.gap, self.rng = (
            [np.ascontiguousarray(image) for image in images],
            at.copy(),
            gap,
            rng,
        )
        self.sizes = np.array([image.shape for image in images])
        self.side = int((at + self.sizes).max())
        self.padded = [maximum_filter(np.pad(image, gap), 2 * gap + 1) if gap else image for image in self.images]
        self.transforms = [
            np.conj(rfft2(room.astype(np.float32), _fast_shape(room.shape[0] + 2 * _REACH, room.shape[1] + 2 * _REACH)))
            for room in self.padded
        ]
        self.weights = np.ones((len(images), len(images)), np.float32)
        self.n_moves = 0

    def separate(self, moves: int) -> bool:
        """Move pieces until none overlap within the square; False if that takes more than ``moves`` moves in all."""
        self.at = np.minimum(self.at, self.side - self.sizes)
        self.overlaps = np.array([self._overlaps(k) for k in range(len(self.images))])
        while self.overlaps.any():
            for k in self.rng.permutation(np.flatnonzero(self.overlaps.any(axis=1))).tolist():
                if self.overlaps[k].any():
                    if self.n_moves >= moves:
                        return False
                    self._move(k)
            worst = max(int(self.overlaps.max()), 1)
            more = self.weights * (_GROWTH + _WORST_GROWTH * self.overlaps / worst)
            less = np.maximum(self.weights * _DECAY, 1)
            self.weights = np.where(self.overlaps > 0, more, less).astype(np.float32)
        return True

    def _neighbours(self, k: int, reach: int) -> list[int]:
        """Pieces whose boxes come within `reach` and the gap of this one's."""
        low, high = self.at[k] - reach - self.gap, self.at[k] + self.sizes[k] + reach + self.gap
        is_near = ((self.at < high) & (self.at + self.sizes > low)).all(axis=1)
        is_near[k] = False
        return np.flatnonzero(is_near).tolist()

    def _window(self, k: int, reach: int, other: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """Slices of the intersection of a piece's image, padded by the gap and `reach`, with another's: in each image."""
        corner = self.at[k] - self.gap - reach
        low = np.maximum(corner, self.at[other])
        high = np.minimum(self.at[k] + self.sizes[k] + self.gap + reach, self.at[other] + self.sizes[other])
        one, two = ((low - origin, high - origin) for origin in (corner, self.at[other]))
        return tuple(map(slice, *one)), tuple(map(slice, *two))  # type: ignore[return-value]

    def _overlaps(self, k: int) -> Int[Ints, " N"]:
        """Texels of each other piece within the padded image of this one."""
        found = np.zeros(len(self.images), np.int64)
        for other in self._neighbours(k, 0):
            window, other_window = self._window(k, 0, other)
            found[other] = np.count_nonzero(self.padded[k][window] & self.images[other][other_window])
        return found

    def _move(self, k: int) -> None:
        """Move a piece to where it overlaps least, within its reach."""
        self.n_moves += 1
        high, wide = (int(side) for side in self.sizes[k] + 2 * (self.gap + _REACH))
        occupancy = np.zeros((high, wide), np.float32)
        for other in self._neighbours(k, _REACH):
            window, other_window = self._window(k, _REACH, other)
            occupancy[window] += self.weights[k, other] * self.images[other][other_window]
        size, offsets = _fast_shape(high, wide), np.arange(-_REACH, _REACH + 1)
        sums = irfft2(rfft2(occupancy, size) * self.transforms[k], size)[: len(offsets), : len(offsets)]
        row, column = self.at[k][:, None] + offsets
        inside = [
            (place >= 0) & (place <= self.side - side) for place, side in zip((row, column), self.sizes[k], strict=True)
        ]
        cost = np.round(sums) + _MOVE_COST * (np.abs(offsets)[:, None] + np.abs(offsets))
        best = int(np.where(inside[0][:, None] & inside[1], cost, np.inf).argmin())
        self.at[k] = row[best // len(offsets)], column[best % len(offsets)]
        self.overlaps[k] = self.overlaps[:, k] = self._overlaps(k)


def _fast_shape(high: int, wide: int) -> tuple[int, int]:
    return next_fast_len(high, real=True), next_fast_len(wide, real=True)
