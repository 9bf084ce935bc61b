"""Checks and reading of input files, and of the arrays in npy and npz files.

Files may claim more data than they contain, or try to escape their folder; nothing is unpickled.
"""

from __future__ import annotations

import codecs
import json
import math
import re
import warnings
import zipfile
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path, PurePath
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from meshmatch import blender
from meshmatch.errors import InputError, warn

LARGEST_FILE = 1 << 32
"""Maximum size of a file in bytes: a hundred million vertices, more than can be processed. Larger files are refused
unread.
"""
LARGEST_TEXT = 1 << 29
"""Maximum size of a text file in bytes."""
LARGEST = 1 << 30
"""Maximum uncompressed size of an array in an npz file, in bytes; a million vertices with 120 dense weights fit."""
MEMORY_ALLOWANCE = 800_000_000
"""Bytes of memory that a file may need beyond four times its size; the rest of a gigabyte is the program's own."""
LABEL_MAP_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
"""Volumes of labels, whose surfaces are shapes (`meshmatch.shapes.formats.label_maps`)."""
_MAYBE_TEXT = (".ply", ".obj", ".mtl", ".off", ".stl", ".gltf", ".xyz", ".pcd")  # tables are read by `read_text`
_BYTES_PER_NUMBER = 24  # bytes of memory per number of an array, which becomes 64-bit and is compared and copied
_LAST_CHARACTER = 0x10FFFF
_NOT_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1f\x7f]")  # control characters that do not occur in text
_LINE_ENDS = b"\n\r\x0b\x0c\x1c\x1d\x1e\x85"  # characters at which `str.splitlines` splits


def suffix_of(path: PurePath) -> str:
    """The suffix that determines the format, in lower case; that of a.nii.gz is .nii.gz."""
    suffix = path.suffix.lower()
    return ".nii.gz" if suffix == ".gz" and path.stem.lower().endswith(".nii") else suffix


def stem_of(path: PurePath) -> str:
    """The name of a file without the suffix that determines its format."""
    return path.name[: len(path.name) - len(suffix_of(path))]


def check_input_file(path: Path, hint: str = "", suffixes: tuple[str, ...] = ()) -> Path:
    """Check that a path is a regular, readable, nonempty file of at most `LARGEST_FILE` bytes, and return it.

    Otherwise `InputError`. Its hint is `hint`, or suggests the most similar name of a file with one of ``suffixes``.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder, not a file", hint or "give the name of a file")
        if not path.exists():
            if path.is_symlink():
                raise InputError(f"{path} is a link to a file that is not there", "repair the link, or name the file")
            raise InputError(f"there is no file {path}", hint or _suggest_name(path, suffixes))
        if not path.is_file():
            problem = f"{path} is not a regular file (it is a pipe or a device)"
            raise InputError(problem, "write its data to a file first")
        size = path.stat().st_size
        with path.open("rb"):  # checks that it can be read
            pass
    except OSError as error:
        default_hint = "may you read it?" if isinstance(error, PermissionError) else "check the name"
        raise InputError(f"cannot read {path}: {error.strerror}", hint or default_hint) from error
    if size == 0:
        raise InputError(f"{path.name} is empty (0 bytes)", hint or "was the download or the export cut short?")
    if size > LARGEST_FILE:
        limit = f"the limit is {LARGEST_FILE / 2**30:.0f} GiB"
        raise InputError(f"{path.name} is too large: {size / 2**30:.1f} GiB", limit)
    return path


def _suggest_name(path: Path, suffixes: tuple[str, ...]) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent} either"
    names = [entry.name for entry in path.parent.iterdir() if entry.suffix.lower() in suffixes]
    close = get_close_matches(path.name, names, n=1)
    return f"did you mean {path.parent / close[0]}?" if close else "check the name and the folder"


def read_bytes(path: Path, largest: int = LARGEST_FILE) -> bytes:
    """The content of a file; text without its byte order mark (`_strip_bom`), and formats read by Blender as glb.

    `InputError` as for `check_input_file`, for a file larger than ``largest``, and if reading fails.
    """
    try:
        if check_input_file(path).stat().st_size > largest:
            raise _text_too_large(path.name, path.stat().st_size, largest)
        if blender.is_converted(path):
            return blender.convert_to_glb(path)
        data = path.read_bytes()
        return _strip_bom(path.name, data) if path.suffix.lower() in _MAYBE_TEXT else data
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}", "check the disk") from error


def _strip_bom(name: str, data: bytes) -> bytes:
    """Text without a byte order mark; UTF-16 with a mark is converted to UTF-8."""
    if name.lower().endswith(".stl") and b"solid" not in data[:16].replace(b"\0", b"").lower():
        return data  # binary, with an arbitrary header
    if data.startswith(codecs.BOM_UTF8):  # may occur twice: a program prepended one to text that had one
        return data.removeprefix(codecs.BOM_UTF8).removeprefix(codecs.BOM_UTF8)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        if len(data) > LARGEST_TEXT:
            raise _text_too_large(name, len(data), LARGEST_TEXT)
        return data.decode("utf-16", "replace").encode("utf-8", "replace")
    return data


def read_text(path: Path, line: int, cell: int = 0) -> str:
    """The text of a file; `InputError` if the file is too large, or would need too much memory (`check_memory`).

    ``line`` and ``cell`` are the bytes of memory that each line, and each further cell of it, takes.
    """
    data = read_bytes(path, largest=LARGEST_TEXT // 2)
    check_memory(path.name, len(data), line * sum(map(data.count, _LINE_ENDS)) + cell * sum(map(data.count, b",;")))
    return _decode(path.name, data)


def _decode(name: str, data: bytes) -> str:
    """Decode UTF-8, UTF-16 with a byte order mark, or else cp1252, with a warning; `ValueError` if it is not text."""
    try:
        return data.decode("utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError:
        if _NOT_TEXT.search(data):
            raise
        text = data.decode("cp1252")
        warn(f"{name} is not in UTF-8; it is read as Windows' Latin letters (cp1252)")
        return text


def check_text_size(name: str, data: bytes) -> None:
    """`InputError` for a text that is too large, or has too many lines or words for the memory."""
    if len(data) > LARGEST_TEXT:
        raise _text_too_large(name, len(data), LARGEST_TEXT)
    lines, spaces = (sum(map(data.count, each)) for each in (b"\r\n", b" \t"))
    check_memory(name, len(data), 40 * lines + 20 * spaces)


def _text_too_large(name: str, size: int, largest: int) -> InputError:
    large = f"{name} is too large for a file of text: {size >> 20} MiB, of {largest >> 20} at most"
    return InputError(large, "save it in a binary format, such as .ply, .glb or .npz")


def read_json(path: Path) -> Any:
    """The value of a JSON file; `InputError` if it would take too much memory (`check_memory`)."""
    return parse_json(path.name, read_bytes(path, largest=LARGEST_TEXT // 2))


def parse_json(name: str, data: bytes) -> Any:
    """The value of a JSON text; `ValueError` if it is not JSON, `InputError` if it would take too much memory."""
    check_memory(name, len(data), 100 * sum(map(data.count, b",[")) + 250 * data.count(b"{"))
    try:
        return json.loads(data.decode("utf-8-sig"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except ValueError as error:
        if type(error) is ValueError:  # neither broken text nor JSON: Python's limit of the digits of an integer
            raise ValueError("a number has too many digits") from error
        raise


def check_memory(name: str, size: int, need: int) -> None:
    """`InputError` if a file of ``size`` bytes would ``need`` more memory than four times that plus `MEMORY_ALLOWANCE`."""
    if need > 4 * size + MEMORY_ALLOWANCE:
        large = f"{name} promises too much: of {size / 1e6:,.0f} MB it would make {need / 1e9:.1f} GB"
        raise InputError(large, "make it smaller, or save it uncompressed in a binary format")


def read_npy(path: Path) -> NDArray[Any]:
    """The array of an npy file; `InputError` if it is damaged or contains objects."""
    try:
        with path.open("rb") as file:
            start = file.read(2)
            if start == b"PK":
                raise ValueError("it holds several arrays, as an npz does")
            if start != b"\x93N":
                raise InputError(f"{path.name} is not an npy file", "does the suffix fit the content?")
            file.seek(0)
            size = path.stat().st_size
            return _read_array(file, path.name, size, size)
    except InputError:
        raise
    except Exception as error:  # a damaged header can raise a dozen exceptions in Python's parser and NumPy
        raise _unreadable_arrays(path, error) from error


def read_npz(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """The arrays of an npz file that are among ``names``.

    `InputError` if the file is damaged, or if one of them contains objects or has more than `LARGEST` bytes.
    """
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            present = set(archive.namelist())
            members = {name: archive.getinfo(f"{name}.npy") for name in names if f"{name}.npy" in present}
            size = path.stat().st_size
            check_memory(path.name, size, sum(member.file_size for member in members.values()))
            for name, member in members.items():
                with archive.open(member) as file:
                    arrays[name] = _read_array(file, member.filename, min(member.file_size, LARGEST), size)
    except InputError:
        raise
    except Exception as error:  # as above, and in the zip reader
        raise _unreadable_arrays(path, error) from error
    return arrays


def _read_array(file: IO[bytes], name: str, max_bytes: int, size: int) -> NDArray[Any]:
    """The array of an open npy file; `ValueError` if it claims more than ``max_bytes``.

    `InputError` if it claims too much for a file of ``size`` bytes.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # headers written by Python 2
        version = npy_format.read_magic(file)
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise ValueError(f"{name} has an unknown format version")
        read = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
        shape, _, dtype = read(file)
        if dtype.hasobject:
            raise ValueError("it holds Python objects")
        # Items of no bytes count as well: a claimed number of them would fill a list.
        claimed = math.prod((max(int(dtype.itemsize), 1), *(int(axis) for axis in shape)))
        if min(shape, default=0) < 0 or claimed > max_bytes:
            raise ValueError(f"{name} promises {claimed} bytes")
        check_memory(name, size, _BYTES_PER_NUMBER * math.prod(int(axis) for axis in shape))
        file.seek(0)
        array = np.asarray(npy_format.read_array(file, allow_pickle=False))
    if array.dtype.kind == "U" and array.size:
        characters = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("=")).reshape(-1)
        codes = characters.view(np.uint32)
        if ((codes > _LAST_CHARACTER) | ((codes >= 0xD800) & (codes < 0xE000))).any():  # the latter are surrogates
            raise ValueError(f"{name} holds invalid characters")
    if array.dtype.kind in "fc" and np.isnan(array).any():
        with np.errstate(invalid="ignore"):
            array = np.asarray(array * array.dtype.type(1))  # turns signaling nan into quiet nan
    return array


def _unreadable_arrays(path: Path, error: Exception) -> InputError:
    if "pickle" in str(error) or "Object arrays" in str(error):
        return InputError(f"{path.name} holds Python objects, which are not read", "save plain arrays in it")
    what = str(error).partition(": <ast.")[0]  # without the address of a node of Python's parser
    unreadable = f"{path.name} does not hold arrays that can be read: {what}"
    return InputError(unreadable, "is it damaged, or of another format?")
