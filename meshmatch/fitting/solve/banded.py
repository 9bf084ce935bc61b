"""Symmetric positive definite band matrices, factored while other threads go on.

SciPy's wrappers of LAPACK keep Python's lock, so that fits in two threads wait for one another. Here the function that SciPy
exports for compiled code is called through ctypes, which gives the lock up. Where it is exported with other types, such as
integers of 64 bits, SciPy's wrapper does.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np
from scipy.linalg import cython_lapack, solveh_banded

from meshmatch.arrays import Float, Floats

_DOUBLE = "__pyx_t_5scipy_6linalg_13cython_lapack_d *"
_SIGNATURE = f"void (char *, int *, int *, int *, {_DOUBLE}, int *, {_DOUBLE}, int *, int *)"


def _exported() -> Callable[..., None] | None:
    """LAPACK's dpbsv, if SciPy exports it with the types that are expected."""
    python, exported = getattr(ctypes, "pythonapi", None), getattr(cython_lapack, "__pyx_capi__", {}).get("dpbsv")
    if python is None or exported is None:
        return None
    name = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", python))
    pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(("PyCapsule_GetPointer", python))
    signature = name(exported)
    if signature != _SIGNATURE.encode():
        return None
    arguments = (ctypes.c_char_p, *[ctypes.c_void_p] * 8)
    return ctypes.CFUNCTYPE(None, *arguments)(pointer(exported, signature))


_DPBSV = _exported()


def solved_band(band: Float[Floats, "N B"], right: Float[Floats, "*R N"]) -> Float[Floats, "*R N"]:
    """Solve A x = b, with A[i + k, i] in ``band[i, k]``, for each row of ``right``; both arrays are used up.

    Raises
    ------
    numpy.linalg.LinAlgError
        A is not positive definite.
    """
    if _DPBSV is None:
        return np.asarray(solveh_banded(band.T, right.T, overwrite_ab=True, lower=True, check_finite=False).T)
    for each in (band, right):  # LAPACK reads and writes where these lie
        if not each.flags.c_contiguous or each.dtype != np.float64:
            raise ValueError("a band and its right sides are contiguous 64-bit floats")
    if right.shape[-1] != len(band) or right.ndim > 2:
        raise ValueError(f"right sides of {right.shape} do not belong to a band of {len(band)} rows")
    sides = len(right) if right.ndim == 2 else 1
    N, above, columns, rows, failed = map(ctypes.c_int, (len(band), band.shape[1] - 1, sides, band.shape[1], 0))
    sizes = [ctypes.byref(each) for each in (N, above, columns, rows, N, failed)]
    _DPBSV(b"L", *sizes[:3], band.ctypes.data, sizes[3], right.ctypes.data, *sizes[4:])
    if failed.value:
        raise np.linalg.LinAlgError(f"the leading block of {failed.value} rows is not positive definite")
    return right
