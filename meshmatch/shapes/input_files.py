"""Files to be read: are they there, are they where a mesh may ask for them, and the arrays in npy and npz files, which
can promise more than they hold. Nothing is unpickled.
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
"""Bytes: a hundred million vertices, more than anything here can work on. Larger files are refused unread."""
LARGEST_TEXT = 1 << 29
"""Bytes of a file of text."""
LARGEST = 1 << 30
"""Uncompressed bytes of one array in an npz file; a million vertices with 120 dense weights fit."""
ROOM = 800_000_000
"""Bytes that a file may take besides four times its size; the rest of a gigabyte is the program's."""
LABEL_MAP_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")
"""Of volumes of labels, whose surfaces are shapes (`meshmatch.shapes.formats.label_maps`)."""
_MAYBE_TEXT = (".ply", ".obj", ".mtl", ".off", ".stl", ".gltf", ".xyz", ".pcd")  # tables are read by `read_text`
_COPIES = 24  # bytes for each number of an array: it becomes one of 64 bits, and is compared and copied
_LAST_CHARACTER = 0x10FFFF
_NO_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1f\x7f]")  # what no editor puts into a text
_LINE_ENDS = b"\n\r\x0b\x0c\x1c\x1d\x1e\x85"  # where `str.splitlines` splits


def suffix_of(path: PurePath) -> str:
    """The suffix that tells the format, in small letters; that of a.nii.gz is .nii.gz."""
    suffix = path.suffix.lower()
    return ".nii.gz" if suffix == ".gz" and path.stem.lower().endswith(".nii") else suffix


def stem_of(path: PurePath) -> str:
    """The name of a file without the suffix that tells its format."""
    return path.name[: len(path.name) - len(suffix_of(path))]


def existing(path: Path, hint: str = "", suffixes: tuple[str, ...] = ()) -> Path:
    """The path; `InputError` if no ordinary file is there, or one that is empty or larger than `LARGEST_FILE`.

    Without a `hint` for the error one is made up, with the most similar name of a file with one of ``suffixes``.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder, not a file", hint or "give the name of a file")
        if not path.exists():
            if path.is_symlink():
                raise InputError(f"{path} is a link to a file that is not there", "repair the link, or name the file")
            raise InputError(f"there is no file {path}", hint or _similar(path, suffixes))
        if not path.is_file():
            odd = f"{path} is not a regular file (it is a pipe or a device)"
            raise InputError(odd, "write its data to a file first")
        size = path.stat().st_size
        with path.open("rb"):  # may it be read?
            pass
    except OSError as error:
        usual = "may you read it?" if isinstance(error, PermissionError) else "check the name"
        raise InputError(f"cannot read {path}: {error.strerror}", hint or usual) from error
    if size == 0:
        raise InputError(f"{path.name} is empty (0 bytes)", hint or "was the download or the export cut short?")
    if size > LARGEST_FILE:
        limit = f"the limit is {LARGEST_FILE / 2**30:.0f} GiB"
        raise InputError(f"{path.name} is too large: {size / 2**30:.1f} GiB", limit)
    return path


def _similar(path: Path, suffixes: tuple[str, ...]) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent} either"
    names = [entry.name for entry in path.parent.iterdir() if entry.suffix.lower() in suffixes]
    close = get_close_matches(path.name, names, n=1)
    return f"did you mean {path.parent / close[0]}?" if close else "check the name and the folder"


def read_bytes(path: Path, largest: int = LARGEST_FILE) -> bytes:
    """All of a file, of text without the mark of its encoding (`_unmarked`); `InputError` as `existing`, for one of text
    that is larger than that, or if reading fails. Of a file that Blender reads (`meshmatch.blender`) it is the glb that
    it becomes.
    """
    try:
        if existing(path).stat().st_size > largest:
            raise _much_text(path.name, path.stat().st_size, largest)
        if blender.is_converted(path):
            return blender.glb_of(path)
        data = path.read_bytes()
        return _unmarked(path.name, data) if path.suffix.lower() in _MAYBE_TEXT else data
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}", "check the disk") from error


def _unmarked(name: str, data: bytes) -> bytes:
    """Text without a byte order mark, and in UTF-8 where the mark is that of UTF-16."""
    if name.lower().endswith(".stl") and b"solid" not in data[:16].replace(b"\0", b"").lower():
        return data  # binary, with a header that may hold anything
    if data.startswith(codecs.BOM_UTF8):  # sometimes two: a program wrote one before what had one
        return data.removeprefix(codecs.BOM_UTF8).removeprefix(codecs.BOM_UTF8)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        if len(data) > LARGEST_TEXT:
            raise _much_text(name, len(data), LARGEST_TEXT)
        return data.decode("utf-16", "replace").encode("utf-8", "replace")
    return data


def read_text(path: Path, line: int, cell: int = 0) -> str:
    """A file's text, where a line takes so many bytes of memory, and each further cell; `InputError` if that
    would be too much (`check_memory`), or the file is too large.
    """
    data = read_bytes(path, largest=LARGEST_TEXT // 2)
    check_memory(path.name, len(data), line * sum(map(data.count, _LINE_ENDS)) + cell * sum(map(data.count, b",;")))
    return _decoded(path.name, data)


def _decoded(name: str, data: bytes) -> str:
    """Text in UTF-8, UTF-16 with a byte order mark, or else, which is said, in Windows' Latin letters; `ValueError` for what
    is no text.
    """
    try:
        return data.decode("utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError:
        if _NO_TEXT.search(data):
            raise
        text = data.decode("cp1252")
        warn(f"{name} is not in UTF-8; it is read as Windows' Latin letters (cp1252)")
        return text


def check_text(name: str, data: bytes) -> None:
    """Refuse a text that is too large, or has more lines or gaps between words than it may have (`InputError`)."""
    if len(data) > LARGEST_TEXT:
        raise _much_text(name, len(data), LARGEST_TEXT)
    lines, gaps = (sum(map(data.count, each)) for each in (b"\r\n", b" \t"))
    check_memory(name, len(data), 40 * lines + 20 * gaps)


def _much_text(name: str, size: int, largest: int) -> InputError:
    large = f"{name} is too large for a file of text: {size >> 20} MiB, of {largest >> 20} at most"
    return InputError(large, "save it in a binary format, such as .ply, .glb or .npz")


def read_json(path: Path) -> Any:
    """The value of a JSON file; `InputError` if that would take too much memory (`check_memory`)."""
    return json_of(path.name, read_bytes(path, largest=LARGEST_TEXT // 2))


def json_of(name: str, data: bytes) -> Any:
    """The value of a JSON text, if it does not take too much memory; `ValueError` if it is none."""
    check_memory(name, len(data), 100 * sum(map(data.count, b",[")) + 250 * data.count(b"{"))
    try:
        return json.loads(data.decode("utf-8-sig"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def check_memory(name: str, size: int, need: int) -> None:
    """Refuse a file of so many bytes that would need more memory than four times that and a gigabyte (`InputError`)."""
    if need > 4 * size + ROOM:
        large = f"{name} promises too much: of {size / 1e6:,.0f} MB it would make {need / 1e9:.1f} GB"
        raise InputError(large, "make it smaller, or save it uncompressed in a binary format")


def read_npy(path: Path) -> NDArray[Any]:
    """The array of an npy file; `InputError` if it is damaged or holds objects."""
    try:
        with path.open("rb") as file:
            start = file.read(2)
            if start == b"PK":
                raise ValueError("it holds several arrays, as an npz does")
            if start != b"\x93N":
                raise InputError(f"{path.name} is not an npy file", "does the suffix fit the content?")
            file.seek(0)
            size = path.stat().st_size
            return _array(file, path.name, size, size)
    except InputError:
        raise
    except Exception as error:  # a damaged header can break Python's parser and NumPy in a dozen ways
        raise _not_arrays(path, error) from error


def read_npz(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Those of the named arrays that an npz file holds; `InputError` if it is damaged, holds objects, or an array of
    more than `LARGEST` bytes.
    """
    found: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            there = set(archive.namelist())
            members = {name: archive.getinfo(f"{name}.npy") for name in names if f"{name}.npy" in there}
            size = path.stat().st_size
            check_memory(path.name, size, sum(member.file_size for member in members.values()))
            for name, member in members.items():
                with archive.open(member) as file:
                    found[name] = _array(file, member.filename, min(member.file_size, LARGEST), size)
    except InputError:
        raise
    except Exception as error:  # as above, and the zip around it
        raise _not_arrays(path, error) from error
    return found


def _array(file: IO[bytes], name: str, most: int, size: int) -> NDArray[Any]:
    """The array of an open npy file, if it promises no more than `most` bytes, nor too much for a file of a size."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers as Python 2 wrote them
        version = npy_format.read_magic(file)
        if version not in ((1, 0), (2, 0), (3, 0)):
            raise ValueError(f"{name} has an unknown format version")
        read = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
        shape, _, kind = read(file)
        if kind.hasobject:
            raise ValueError("it holds Python objects")
        # An item counts, also one of no bytes: so many of them would fill a list.
        promised = math.prod((max(int(kind.itemsize), 1), *(int(axis) for axis in shape)))
        if min(shape, default=0) < 0 or promised > most:
            raise ValueError(f"{name} promises {promised} bytes")
        check_memory(name, size, _COPIES * math.prod(int(axis) for axis in shape))
        file.seek(0)
        array = np.asarray(npy_format.read_array(file, allow_pickle=False))
    if array.dtype.kind == "U" and array.size:
        characters = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("=")).reshape(-1)
        codes = characters.view(np.uint32)
        if ((codes > _LAST_CHARACTER) | ((codes >= 0xD800) & (codes < 0xE000))).any():  # the latter are halves
            raise ValueError(f"{name} holds invalid characters")
    if array.dtype.kind in "fc" and np.isnan(array).any():
        with np.errstate(invalid="ignore"):
            array = np.asarray(array * array.dtype.type(1))  # no nan signals later
    return array


def _not_arrays(path: Path, error: Exception) -> InputError:
    if "pickle" in str(error) or "Object arrays" in str(error):
        return InputError(f"{path.name} holds Python objects, which are not read", "save plain arrays in it")
    what = str(error).partition(": <ast.")[0]  # not where Python's parser has its node
    unreadable = f"{path.name} does not hold arrays that can be read: {what}"
    return InputError(unreadable, "is it damaged, or of another format?")
