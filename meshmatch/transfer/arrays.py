"""Arrays out of npy and npz files, which can promise more than they hold. Nothing is unpickled."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from meshmatch.errors import InputError

# Uncompressed bytes of one array in an npz file; a million vertices with 120 dense weights fit.
LARGEST = 1 << 30
_DAMAGED = (ValueError, OSError, EOFError, SyntaxError, TypeError, TokenError, KeyError, zlib.error)


def read_npy(path: Path) -> NDArray[Any]:
    """The array of an npy file.

    Raises
    ------
    InputError
        The file is damaged, or holds objects.
    """
    with path.open("rb") as file:
        if file.read(2) not in (b"\x93N", b"PK"):  # numpy takes anything else for a pickle
            raise InputError(f"{path.name} is no npy file", "does the suffix fit the content?")
    try:
        # mapped, not loaded: a header that promises more than the file holds allocates nothing
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it holds several arrays")
        return np.array(array)
    except _DAMAGED as error:
        raise _not_arrays(path, error) from error


def read_npz(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Those of the named arrays that an npz file holds.

    Raises
    ------
    InputError
        The file is damaged, holds objects, or an array of more than `LARGEST` bytes.
    """
    found: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            there = set(archive.namelist())
            for name in names:
                if f"{name}.npy" in there:
                    found[name] = _member(archive, f"{name}.npy")
    except (*_DAMAGED, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise _not_arrays(path, error) from error
    return found


def _member(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    with archive.open(name) as file:
        version = npy_format.read_magic(file)
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise ValueError(f"{name} is of an unknown version")
        read = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
        shape, _, kind = read(file)
        size = int(kind.itemsize)
        for axis in shape:
            size *= int(axis)
        if not 0 <= size <= min(archive.getinfo(name).file_size, LARGEST):
            raise ValueError(f"{name} promises {size} bytes")
    with archive.open(name) as file:
        return np.asarray(npy_format.read_array(file, allow_pickle=False))


def _not_arrays(path: Path, error: Exception) -> InputError:
    if "pickle" in str(error) or "Object arrays" in str(error):
        return InputError(f"{path.name} holds Python objects, which are not read", "save plain arrays in it")
    return InputError(
        f"{path.name} does not hold arrays that can be read: {error}", "is it damaged, or of another format?"
    )


def existing(path: Path, what: str) -> Path:
    """The path, if a file that is not empty is there; `InputError` otherwise."""
    if not path.is_file():
        raise InputError(f"there is no file {path}" if not path.exists() else f"{path} is not a file", what)
    if path.stat().st_size == 0:
        raise InputError(f"{path.name} is empty", what)
    return path
