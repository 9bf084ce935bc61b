"""Array annotations with shapes: ``Float[Floats, "V 3"]`` is a float64 array of V rows and 3 columns.

The shapes are jaxtyping's (https://docs.kidger.site/jaxtyping); type checkers see only the array type. Modules that use
them begin with ``from __future__ import annotations``, so that annotations cost nothing at import time. jaxtyping
itself is not imported unless it already was, as in the tests.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import Field, fields
from html import escape
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.errors import InputError

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Bool as Bool
    from jaxtyping import Float as Float
    from jaxtyping import Int as Int
    from jaxtyping import UInt8 as UInt8
else:

    class Bool:
        def __class_getitem__(cls, what: tuple[Any, str]) -> Any:
            """Return the array type alone."""
            return what[0]

    Float = Int = UInt8 = Bool

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
UInts8 = NDArray[np.uint8]
Bools = NDArray[np.bool_]


class TensorLike(Protocol):
    """A torch tensor, for annotations that do not import torch; see `is_tensor`."""

    def detach(self) -> Any: ...

    def numpy(self, *, force: bool = False) -> NDArray[Any]: ...


SomeTensor = TypeVar("SomeTensor", bound=TensorLike)


def as_read_only(values: Any, dtype: type, label: str) -> NDArray[Any]:
    """The values as a contiguous, read-only array: a copy, unless they already are such an array that owns its data.

    `InputError` if the values are not numbers, or rows differ in length; ``label`` names them in the message.
    """
    owns_data = isinstance(values, np.ndarray) and values.dtype == dtype and values.base is None
    if owns_data and values.flags.c_contiguous and not values.flags.writeable:
        shared: NDArray[Any] = values
        return shared
    try:
        values = to_numpy(values)
        if np.iscomplexobj(values):
            raise TypeError("complex numbers are not supported")
        array: NDArray[Any] = np.array(values, dtype=dtype, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{label}: not an array of numbers ({error})") from error
    return set_read_only(array)


def set_read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Make an array read-only and return it."""
    array.setflags(write=False)
    return array


class PickledFields:
    """Mixin for frozen dataclasses that pickles their fields alone, without cached values.

    Arrays that were read-only are read-only again.
    """

    def __getstate__(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        state = {each.name: getattr(self, each.name) for each in fields(self)}  # type: ignore[arg-type]
        arrays = [name for name, value in state.items() if isinstance(value, np.ndarray)]
        return state, tuple(name for name in arrays if not state[name].flags.writeable)

    def __setstate__(self, state: tuple[dict[str, Any], tuple[str, ...]]) -> None:
        self.__dict__.update(state[0])
        for name in state[1]:
            set_read_only(state[0][name])


class ShortRepr:
    """Mixin for dataclasses with ``repr=False``: a one-line repr that gives arrays by their sizes."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self._format(each) for each in fields(self) if each.repr)})"  # type: ignore[arg-type]

    def _format(self, field: Field[Any]) -> str:
        value = getattr(self, field.name)
        shape = getattr(value, "shape", ())
        if shape and isinstance(shape, tuple):  # arrays, sparse arrays and tensors
            return f"{field.name}: {' x '.join(map(str, shape))}"
        if isinstance(value, tuple | list | dict) and len(value) > 3:
            return f"{field.name}: {len(value)} items"
        return f"{field.name}={value!r}"


def table_html(title: str, rows: Mapping[str, str]) -> str:
    """A heading and a table as HTML for a notebook; rows with empty values are left out."""
    cell = '<td style="text-align:left">'
    lines = [f"<tr>{cell}{escape(name)}</td>{cell}{escape(value)}</td></tr>" for name, value in rows.items() if value]
    return f"<b>{escape(title)}</b><table>{''.join(lines)}</table>"


def to_numpy(values: Any) -> Any:
    """Convert a torch tensor, or a list of them, to NumPy, detached and in CPU memory; return anything else as is.

    `TypeError` for a tensor that is not dense or not of numbers, such as a sparse one.
    """
    if isinstance(values, list | tuple):
        are_tensors = len(values) > 0 and is_tensor(values[0])
        return [to_numpy(each) for each in values] if are_tensors else values
    if not is_tensor(values):
        return values
    try:
        try:
            return values.numpy(force=True)
        except TypeError:  # a type that NumPy lacks, such as bfloat16
            return values.float().numpy(force=True)
    except (RuntimeError, NotImplementedError) as error:
        raise TypeError(str(error).splitlines()[0]) from error


def is_tensor(values: Any) -> bool:
    """Whether this is a torch tensor, judged by its methods, without importing torch."""
    return hasattr(values, "detach") and hasattr(values, "numpy")


def as_array(values: Any, name: str, hint: str = "") -> NDArray[Any]:
    """The values as an array of any type; `InputError` if they do not form one, such as rows of different lengths."""
    try:
        return np.asarray(to_numpy(values))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: not an array ({error})", hint) from error


@np.errstate(invalid="ignore")  # rounding nan; nan is refused
def as_integers(values: ArrayLike, label: str, hint: str = "") -> Int[Ints, ...]:
    """Convert integers, which may be given as floats, to int64; `InputError` for anything else."""
    array = as_array(values, label, hint)
    is_whole = array.dtype.kind == "f" and np.array_equal(array, np.round(array))
    if is_whole and (np.abs(array.astype(np.float64)) < 2**53).all():
        return array.astype(np.int64)  # MATLAB's numbers are doubles
    if array.dtype.kind not in "iu":
        raise InputError(f"{label} must be whole numbers, not {array.dtype}", hint)
    return np.array(array, dtype=np.int64)


def as_numbers(values: ArrayLike | TensorLike, name: str, finite: bool = False) -> Floats:
    """Convert values to float64; `InputError` if they are not numbers, rows differ in length, or ``finite`` fails."""
    if values is None:
        raise InputError(f"{name} must be numbers, not None", "pass an array")
    try:
        array = np.asarray(to_numpy(values))
        if array.dtype.kind == "c":
            raise TypeError("complex numbers are not supported")
        array = array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers ({error})", "pass an array, one row for each vertex") from error
    if finite and not np.isfinite(array).all():
        raise InputError(f"{name} must be finite, but holds nan or infinite values", "leave them out or replace them")
    return array
