"""Logarithms and exponentials of many symmetric 3 x 3 matrices side by side, their six entries in rows: xx xy xz yy yz zz.

A function of a matrix is the polynomial through its values at the eigenvalues (Newton's form), which are found by cosines.
Eigenvalues that are nearly equal do no harm: slopes between them are computed without cancellation, and what is left of the
second difference is multiplied by nearly nothing. It takes a seventh of the time of eigenvectors.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from meshmatch.arrays import Float, Floats

# Where the six entries belong in a matrix, row by row; and which of the nine they are.
_BLOCK = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_UPPER = np.array([0, 1, 2, 4, 5, 8])


def entries_of(matrices: Float[Floats, "G 3 3"]) -> Float[Floats, "6 G"]:
    """The six entries of symmetric matrices."""
    return np.ascontiguousarray(matrices.reshape(-1, 9).T[_UPPER])


def matrices_of(entries: Float[Floats, "6 G"]) -> Float[Floats, "G 3 3"]:
    """Symmetric matrices of six entries each."""
    return np.ascontiguousarray(entries[_BLOCK].T).reshape(-1, 3, 3)


def logarithm(S: Float[Floats, "6 G"], least: float) -> Float[Floats, "6 G"]:
    """Of matrices whose eigenvalues are not negative; those below ``least`` count as this."""
    high, middle, low = eigenvalues(S)

    def slope(a: Floats, b: Floats) -> Floats:
        return _over(np.log1p, (a - b) / b) / b

    hard = low <= 10 * least
    if hard.any():
        high, middle, low = (np.where(hard, 1.0, each) for each in (high, middle, low))
    found = _through(S, (high, middle, low), np.log(high), slope(high, middle), slope(middle, low))
    if hard.any():
        values, axes = np.linalg.eigh(matrices_of(S[:, hard]))
        logs = np.log(np.maximum(values, least))
        found[:, hard] = entries_of((axes * logs[:, None, :]) @ axes.transpose(0, 2, 1))
    return found


def exponential(S: Float[Floats, "6 G"]) -> Float[Floats, "6 G"]:
    """Of any symmetric matrices."""
    high, middle, low = eigenvalues(S)

    def slope(a: Floats, b: Floats) -> Floats:
        return np.exp(b) * _over(np.expm1, a - b)

    return _through(S, (high, middle, low), np.exp(high), slope(high, middle), slope(middle, low))


def eigenvalues(S: Float[Floats, "6 G"]) -> tuple[Float[Floats, " G"], Float[Floats, " G"], Float[Floats, " G"]]:
    """The eigenvalues of each matrix, the highest first."""
    xx, xy, xz, yy, yz, zz = S
    mean = (xx + yy + zz) / 3
    x, y, z = xx - mean, yy - mean, zz - mean
    size = np.sqrt((x * x + y * y + z * z + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    determinant = x * (y * z - yz * yz) - xy * (xy * z - xz * yz) + xz * (xy * yz - xz * y)
    angle = np.arccos(np.clip(determinant / np.maximum(2 * size**3, 1e-300), -1, 1)) / 3
    high, low = mean + 2 * size * np.cos(angle), mean + 2 * size * np.cos(angle + 2 * np.pi / 3)
    return high, 3 * mean - high - low, low


def _over(function: Callable[[Floats], Floats], x: Float[Floats, " G"]) -> Float[Floats, " G"]:
    """f(x) / x of a function that is like x near 0."""
    return np.divide(function(x), x, out=np.ones_like(x), where=x != 0)


def _through(
    S: Float[Floats, "6 G"],
    nodes: tuple[Floats, Floats, Floats],
    value: Float[Floats, " G"],
    first: Float[Floats, " G"],
    second: Float[Floats, " G"],
) -> Float[Floats, "6 G"]:
    """The polynomial with a value at the first of three nodes, and slopes from it to the second, and on to the third."""
    high, middle, low = nodes
    gap = high - low
    curve = np.divide(first - second, gap, out=np.zeros_like(gap), where=gap > 0)
    xx, xy, xz, yy, yz, zz = S
    square = (
        *(xx * xx + xy * xy + xz * xz, xx * xy + xy * yy + xz * yz, xx * xz + xy * yz + xz * zz),
        *(xy * xy + yy * yy + yz * yz, xy * xz + yy * yz + yz * zz, xz * xz + yz * yz + zz * zz),
    )
    found = curve * np.stack(square) + (first - curve * (high + middle)) * S
    found[[0, 3, 5]] += value - first * high + curve * high * middle
    return np.asarray(found)
