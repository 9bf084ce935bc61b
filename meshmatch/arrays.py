"""Array types in one dialect: ``Float[Floats, "V 3"]`` is a float64 array of V rows and 3 columns.

The shape is jaxtyping's (https://docs.kidger.site/jaxtyping); a type checker sees the array type alone. Modules that
use it begin with ``from __future__ import annotations``, so that annotations cost nothing when they are loaded.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike, NDArray

from meshmatch.errors import InputError

__all__ = [
    "Bool",
    "Bools",
    "Float",
    "Floats",
    "Floats32",
    "Int",
    "Ints",
    "Ints32",
    "UInt8",
    "UInts8",
    "as_numbers",
    "frozen",
    "read_only",
]

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
UInts8 = NDArray[np.uint8]
Bools = NDArray[np.bool_]


def read_only(values: Any, dtype: type, label: str) -> NDArray[Any]:
    """The values as a contiguous, read-only array of their own; an array that is all of this already is shared.

    Raises
    ------
    InputError
        The values are not numbers, or rows differ in length; ``label`` says whose they are.
    """
    if isinstance(values, np.ndarray) and values.dtype == dtype and values.base is None:
        shareable = values.flags.c_contiguous and not values.flags.writeable
        if shareable:
            return values
    try:
        array: NDArray[Any] = np.array(values, dtype=dtype, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{label}: not an array of numbers ({error})") from error
    return frozen(array)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """The same array, read-only from now on."""
    array.setflags(write=False)
    return array


def as_numbers(values: ArrayLike, name: str, finite: bool = False) -> Floats:
    """An array of numbers; `InputError` where they are something else, such as words or rows of different lengths."""
    try:
        found = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers ({error})", "pass an array, one row for each vertex") from error
    if finite and not np.isfinite(found).all():
        raise InputError(f"{name} must be finite, but holds nan or infinite values")
    return found
