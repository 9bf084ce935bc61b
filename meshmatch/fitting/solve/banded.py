"""Solvers for symmetric positive definite band matrices that release Python's lock.

SciPy's wrappers of LAPACK hold the lock, so that fits in two threads would wait for each other. LAPACK functions that SciPy
exports for compiled code are therefore called through ctypes, which releases it. If they are exported with other types,
such as 64-bit integers, SciPy's wrapper is used.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg import cython_blas, cython_lapack, solveh_banded

from meshmatch.arrays import Float, Floats, Int, Ints

_ROUTINES = {
    "dpbsv": (cython_lapack, "char, int, int, int, double, int, double, int, int"),
    "dpbtrs": (cython_lapack, "char, int, int, int, double, int, double, int, int"),
    "dpotrf": (cython_lapack, "char, int, double, int, int"),
    "dtrsm": (cython_blas, "char, char, char, char, int, int, double, double, int, double, int"),
    "dsyrk": (cython_blas, "char, char, int, int, double, double, int, double, double, int"),
}
"""Name of each routine, the module that exports it, and the types to which its arguments point."""
_BLOCK_SIZE = 32  # columns that `Envelope` eliminates at once


def _exported() -> dict[str, Callable[..., None]] | None:
    """The routines, or None unless SciPy exports all of them with the expected types."""
    python = getattr(ctypes, "pythonapi", None)
    if python is None:
        return None
    name = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", python))
    pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(("PyCapsule_GetPointer", python))
    found: dict[str, Callable[..., None]] = {}
    for routine, (module, kinds) in _ROUTINES.items():
        double = f"__pyx_t_5scipy_6linalg_{'13cython_lapack' if module is cython_lapack else '11cython_blas'}_d"
        types = [double if kind == "double" else kind for kind in kinds.split(", ")]
        signature = f"void ({', '.join(f'{each} *' for each in types)})".encode()
        exported = getattr(module, "__pyx_capi__", {}).get(routine)
        if exported is None or name(exported) != signature:
            return None
        arguments = [ctypes.c_char_p if kind == "char" else ctypes.c_void_p for kind in types]
        found[routine] = ctypes.CFUNCTYPE(None, *arguments)(pointer(exported, signature))
    return found


_LAPACK = _exported()


def solved_band(band: Float[Floats, "N B"], right: Float[Floats, "*R N"]) -> Float[Floats, "*R N"]:
    """Solve A x = b for each row of ``right``, with A[i + k, i] in ``band[i, k]``; both arrays are overwritten.

    Raises
    ------
    numpy.linalg.LinAlgError
        A is not positive definite.
    """
    if _LAPACK is None:
        return np.asarray(solveh_banded(band.T, right.T, overwrite_ab=True, lower=True, check_finite=False).T)
    _check(band, right)
    if right.shape[-1] != len(band) or right.ndim > 2:
        raise ValueError(f"right sides of {right.shape} do not belong to a band of {len(band)} rows")
    sides = len(right) if right.ndim == 2 else 1
    N, above, columns, rows, failed = map(ctypes.c_int, (len(band), band.shape[1] - 1, sides, band.shape[1], 0))
    sizes = [ctypes.byref(each) for each in (N, above, columns, rows, N, failed)]
    _LAPACK["dpbsv"](b"L", *sizes[:3], band.ctypes.data, sizes[3], right.ctypes.data, *sizes[4:])
    _raise_if_failed(failed.value)
    return right


class Envelope:
    """The part of a band that a matrix and its Cholesky factor fill.

    Unknowns of limbs interact with few others, and only those of a torso with as many as the band is wide. Column i is zero
    from row ``ends[i]`` on, and ``ends`` does not decrease. LAPACK's banded routine eliminates all columns over the full
    bandwidth; this class eliminates each block of columns only as far as it reaches.
    """

    def __init__(self, ends: Int[Ints, " N"]) -> None:
        N = len(ends)
        self.above = int((ends - np.arange(N)).max()) - 1
        self.columns = self.above + 1 + _BLOCK_SIZE
        """Columns of the band's array: `above` off the diagonal, the diagonal, and room for the corners of a block."""
        step, size = self.columns - 1, np.dtype(np.float64).itemsize  # distance in memory between neighbours in a row
        self._sizes = [_int_pointer(each) for each in (N, self.above, 1, self.columns)]
        self._step, self._blocks = _int_pointer(step), []
        for first in range(0, N, _BLOCK_SIZE):
            after = min(first + _BLOCK_SIZE, N)
            below, width, start = int(ends[after - 1]) - after, after - first, first * self.columns
            places = (size * start, size * (start + width), size * after * self.columns)
            self._blocks.append((first, _int_pointer(width), _int_pointer(below) if below > 0 else None, places))

    def solve(self, band: Float[Floats, "N B"], right: Float[Floats, " N"]) -> Float[Floats, " N"]:
        """Solve A x = b, where A[i + k, i] is ``band[i, k]``; both arrays are overwritten.

        k goes up to `above`; the further columns of ``band`` are zero.

        Raises
        ------
        numpy.linalg.LinAlgError
            A is not positive definite.
        """
        if _LAPACK is None:
            return solved_band(band[:, : self.above + 1], right)
        _check(band, right)
        if band.shape != (len(right), self.columns):
            raise ValueError(f"a band of {band.shape} and right sides of {right.shape} are not those of this envelope")
        failed, array, step = ctypes.c_int(0), band.ctypes.data, self._step
        code = ctypes.byref(failed)
        for first, width, below, places in self._blocks:
            diagonal, under, rest = (array + place for place in places)
            _LAPACK["dpotrf"](b"L", width, diagonal, step, code)
            _raise_if_failed(failed.value and first + failed.value)
            if below is not None:
                _LAPACK["dtrsm"](b"R", b"L", b"T", b"N", below, width, _ONE, diagonal, step, under, step)
                _LAPACK["dsyrk"](b"L", b"N", below, width, _MINUS_ONE, under, step, _ONE, rest, step)
        N, above, sides, columns = self._sizes
        _LAPACK["dpbtrs"](b"L", N, above, sides, array, columns, right.ctypes.data, N, code)
        return right


_ONE, _MINUS_ONE = (ctypes.byref(ctypes.c_double(value)) for value in (1.0, -1.0))


def _int_pointer(value: int) -> Any:
    return ctypes.byref(ctypes.c_int(value))


def _check(*arrays: Floats) -> None:
    """Check that arrays have the memory layout that LAPACK expects."""
    for each in arrays:
        if not each.flags.c_contiguous or each.dtype != np.float64:
            raise ValueError("a band and its right sides are contiguous 64-bit floats")


def _raise_if_failed(failed: int) -> None:
    if failed:
        raise np.linalg.LinAlgError(f"the leading block of {failed} rows is not positive definite")
