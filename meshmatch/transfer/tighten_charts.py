"""Pieces of an image moved closer together, until a smaller square holds them all.

The square shrinks in small steps. Pieces that it pushes into others go, one after the other, to where they overlap the
others least within a short way. Pairs that stay in each other's way weigh more each round, so that others give way (guided
local search, as of Voudouris and Tsang 1999).
"""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import maximum_filter

from meshmatch.arrays import Bools, Int, Ints

# All of these were set by hand.
_STEP = 2  # texels by which the square shrinks
_REACH = 12  # texels that a piece moves at once, at most
_HEAVIER, _WORST, _LIGHTER = (
    1.2,
    0.8,
    0.95,
)  # what overlaps weighs so many times more, the worst this more; what does not
_NEARER = 1e-3  # of a texel that overlaps: what a texel of the way counts


def tightened(
    images: list[Bools], at: Int[Ints, "N 2"], apart: int, moves: int, rng: np.random.Generator
) -> tuple[Int[Ints, "N 2"], int]:
    """Where pieces lie, and the side of the square that holds them.

    Parameters
    ----------
    images
        The texels that each piece takes.
    at
        Row and column of each image's corner; no two pieces are closer than `apart`.
    apart
        Texels that must be free around a piece.
    moves
        How many of one piece are tried, at most.
    """
    crowd = _Crowd(images, at, apart, rng)
    largest = int(crowd.sizes.max())
    while True:
        kept, end = crowd.at.copy(), crowd.end
        crowd.end -= _STEP
        if crowd.end < largest or not crowd.separated(moves):
            return kept, end


class _Crowd:
    def __init__(self, images: list[Bools], at: Ints, apart: int, rng: np.random.Generator) -> None:
        self.images, self.at, self.apart, self.rng = (
            [np.ascontiguousarray(image) for image in images],
            at.copy(),
            apart,
            rng,
        )
        self.sizes = np.array([image.shape for image in images])
        self.end = int((at + self.sizes).max())
        self.rooms = [maximum_filter(np.pad(image, apart), 2 * apart + 1) if apart else image for image in self.images]
        self.transforms = [
            np.conj(rfft2(room.astype(np.float32), _fast(room.shape[0] + 2 * _REACH, room.shape[1] + 2 * _REACH)))
            for room in self.rooms
        ]
        self.weights = np.ones((len(images), len(images)), np.float32)
        self.moved = 0

    def separated(self, moves: int) -> bool:
        """Whether no piece overlaps another, within the square, after so many moves in all."""
        self.at = np.minimum(self.at, self.end - self.sizes)
        self.overlaps = np.array([self._overlaps(k) for k in range(len(self.images))])
        while self.overlaps.any():
            for k in self.rng.permutation(np.flatnonzero(self.overlaps.any(axis=1))).tolist():
                if self.overlaps[k].any():
                    if self.moved >= moves:
                        return False
                    self._move(k)
            worst = max(int(self.overlaps.max()), 1)
            more = self.weights * (_HEAVIER + _WORST * self.overlaps / worst)
            less = np.maximum(self.weights * _LIGHTER, 1)
            self.weights = np.where(self.overlaps > 0, more, less).astype(np.float32)
        return True

    def _near(self, k: int, reach: int) -> list[int]:
        low, high = self.at[k] - reach - self.apart, self.at[k] + self.sizes[k] + reach + self.apart
        near = ((self.at < high) & (self.at + self.sizes > low)).all(axis=1)
        near[k] = False
        return np.flatnonzero(near).tolist()

    def _window(self, k: int, reach: int, other: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """What is common of the image around a piece, with the room and so much more, and of another's: in each of them."""
        corner = self.at[k] - self.apart - reach
        low = np.maximum(corner, self.at[other])
        high = np.minimum(self.at[k] + self.sizes[k] + self.apart + reach, self.at[other] + self.sizes[other])
        one, two = ((low - origin, high - origin) for origin in (corner, self.at[other]))
        return tuple(map(slice, *one)), tuple(map(slice, *two))  # type: ignore[return-value]

    def _overlaps(self, k: int) -> Int[Ints, " N"]:
        """The texels of each other piece in the room of one."""
        found = np.zeros(len(self.images), np.int64)
        for other in self._near(k, 0):
            own, theirs = self._window(k, 0, other)
            found[other] = np.count_nonzero(self.rooms[k][own] & self.images[other][theirs])
        return found

    def _move(self, k: int) -> None:
        """A piece to where it overlaps least, within its reach."""
        self.moved += 1
        high, wide = (int(side) for side in self.sizes[k] + 2 * (self.apart + _REACH))
        taken = np.zeros((high, wide), np.float32)
        for other in self._near(k, _REACH):
            own, theirs = self._window(k, _REACH, other)
            taken[own] += self.weights[k, other] * self.images[other][theirs]
        size, ways = _fast(high, wide), np.arange(-_REACH, _REACH + 1)
        sums = irfft2(rfft2(taken, size) * self.transforms[k], size)[: len(ways), : len(ways)]
        row, column = self.at[k][:, None] + ways
        inside = [
            (place >= 0) & (place <= self.end - side) for place, side in zip((row, column), self.sizes[k], strict=True)
        ]
        cost = np.round(sums) + _NEARER * (np.abs(ways)[:, None] + np.abs(ways))
        best = int(np.where(inside[0][:, None] & inside[1], cost, np.inf).argmin())
        self.at[k] = row[best // len(ways)], column[best % len(ways)]
        self.overlaps[k] = self.overlaps[:, k] = self._overlaps(k)


def _fast(high: int, wide: int) -> tuple[int, int]:
    return next_fast_len(high, real=True), next_fast_len(wide, real=True)
