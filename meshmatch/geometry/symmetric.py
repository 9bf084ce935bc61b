"""Matrix logarithms and exponentials of many symmetric 3 x 3 matrices.

Matrices are stored as six rows of entries: xx xy xz yy yz zz. A matrix function is evaluated as Newton's interpolation
polynomial at the eigenvalues, which have a closed form in cosines. Nearly equal eigenvalues are harmless: divided
differences are computed without cancellation, and the error of the second one is multiplied by nearly zero. This takes
a seventh of the time of eigenvectors.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from meshmatch.arrays import Float, Floats

# Index of the entry for each of the nine elements, row by row; and the elements that the six entries are.
_ELEMENT_ENTRY = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_ENTRY_ELEMENT = np.array([0, 1, 2, 4, 5, 8])


def to_entries(matrices: Float[Floats, "G 3 3"]) -> Float[Floats, "6 G"]:
    """The six entries of symmetric matrices, as rows."""
    return np.ascontiguousarray(matrices.reshape(-1, 9).T[_ENTRY_ELEMENT])


def to_matrices(entries: Float[Floats, "6 G"]) -> Float[Floats, "G 3 3"]:
    """Symmetric matrices from their six entries."""
    return np.ascontiguousarray(entries[_ELEMENT_ENTRY].T).reshape(-1, 3, 3)


def logarithm(S: Float[Floats, "6 G"], least: float) -> Float[Floats, "6 G"]:
    """Logarithms of positive semidefinite matrices; eigenvalues below ``least`` are raised to it."""
    high, middle, low = eigenvalues(S)

    def slope(a: Floats, b: Floats) -> Floats:
        return _divided(np.log1p, (a - b) / b) / b

    nearly_singular = low <= 10 * least
    if nearly_singular.any():
        high, middle, low = (np.where(nearly_singular, 1.0, each) for each in (high, middle, low))
    result = _newton_polynomial(S, (high, middle, low), np.log(high), slope(high, middle), slope(middle, low))
    if nearly_singular.any():
        values, axes = np.linalg.eigh(to_matrices(S[:, nearly_singular]))
        logs = np.log(np.maximum(values, least))
        result[:, nearly_singular] = to_entries((axes * logs[:, None, :]) @ axes.transpose(0, 2, 1))
    return result


def exponential(S: Float[Floats, "6 G"]) -> Float[Floats, "6 G"]:
    """Exponentials of symmetric matrices."""
    high, middle, low = eigenvalues(S)

    def slope(a: Floats, b: Floats) -> Floats:
        return np.exp(b) * _divided(np.expm1, a - b)

    return _newton_polynomial(S, (high, middle, low), np.exp(high), slope(high, middle), slope(middle, low))


def eigenvalues(S: Float[Floats, "6 G"]) -> tuple[Float[Floats, " G"], Float[Floats, " G"], Float[Floats, " G"]]:
    """Eigenvalues of each matrix: largest, middle, smallest."""
    xx, xy, xz, yy, yz, zz = S
    mean = (xx + yy + zz) / 3
    x, y, z = xx - mean, yy - mean, zz - mean
    size = np.sqrt((x * x + y * y + z * z + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    determinant = x * (y * z - yz * yz) - xy * (xy * z - xz * yz) + xz * (xy * yz - xz * y)
    angle = np.arccos(np.clip(determinant / np.maximum(2 * size**3, 1e-300), -1, 1)) / 3
    high, low = mean + 2 * size * np.cos(angle), mean + 2 * size * np.cos(angle + 2 * np.pi / 3)
    return high, 3 * mean - high - low, low


def _divided(function: Callable[[Floats], Floats], x: Float[Floats, " G"]) -> Float[Floats, " G"]:
    """f(x) / x for a function with f(x) ~ x near 0; 1 at 0."""
    return np.divide(function(x), x, out=np.ones_like(x), where=x != 0)


def _newton_polynomial(
    S: Float[Floats, "6 G"],
    nodes: tuple[Floats, Floats, Floats],
    value: Float[Floats, " G"],
    first: Float[Floats, " G"],
    second: Float[Floats, " G"],
) -> Float[Floats, "6 G"]:
    """Evaluate Newton's polynomial at S, from a value at the first node and two divided differences between nodes."""
    high, middle, low = nodes
    gap = high - low
    curve = np.divide(first - second, gap, out=np.zeros_like(gap), where=gap > 0)
    xx, xy, xz, yy, yz, zz = S
    square = (
        *(xx * xx + xy * xy + xz * xz, xx * xy + xy * yy + xz * yz, xx * xz + xy * yz + xz * zz),
        *(xy * xy + yy * yy + yz * yz, xy * xz + yy * yz + yz * zz, xz * xz + yz * yz + zz * zz),
    )
    result = curve * np.stack(square) + (first - curve * (high + middle)) * S
    result[[0, 3, 5]] += value - first * high + curve * high * middle
    return np.asarray(result)
