"""Read label maps, such as segmentations of CT and MRI: .nii and .nii.gz, .nrrd and .nhdr, .mha and .mhd.

Positions are in LPS, the frame of DICOM, which 3D Slicer assumes for meshes: x to the left, y to the back, z to the head.
NIfTI files are in RAS, where x and y have the opposite sign; MetaImage files are in LPS; NRRD files name their space.
"""

from __future__ import annotations

import bz2
import math
import re
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError
from meshmatch.shapes.companions import find_companion
from meshmatch.shapes.formats import Raw, damaged, parse_numbers
from meshmatch.shapes.formats.label_surfaces import CODE_BYTES, label_surfaces
from meshmatch.shapes.input_files import check_memory, read_bytes, suffix_of

_MAX_HEADER_BYTES = 1 << 20
_SIGNS = {"left": 1.0, "right": -1.0, "posterior": 1.0, "anterior": -1.0, "superior": 1.0, "inferior": -1.0}
_LETTERS = {word[0].upper(): word for word in _SIGNS}
_NRRD_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("unsigned char", "uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("unsigned short", "ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("unsigned", "uint", "uint32"), "u4"),
    **dict.fromkeys(("long long", "longlong", "int64"), "i8"),
    **dict.fromkeys(("unsigned long long", "ulonglong", "uint64"), "u8"),
    **{"float": "f4", "double": "f8"},
}
_MHA_TYPES = {
    f"MET_{name}": kind
    for name, kind in (
        *(("CHAR", "i1"), ("SHORT", "i2"), ("INT", "i4"), ("LONG", "i4"), ("LONG_LONG", "i8")),
        *(("UCHAR", "u1"), ("USHORT", "u2"), ("UINT", "u4"), ("ULONG", "u4"), ("ULONG_LONG", "u8")),
        *(("FLOAT", "f4"), ("DOUBLE", "f8")),
    )
}
_NIFTI_TYPES = {
    2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"
}  # fmt: skip
_SEGMENT = re.compile(r"Segment(\d{1,4})_(Name|LabelValue|Layer)")


@dataclass(frozen=True, eq=False)
class _LabelMap:
    """Voxels of one or several layers, indexed (x, y, z), with centers at origin + index @ steps, in LPS."""

    layers: list[NDArray[Any]]
    origin: Float[Floats, " 3"]
    steps: Float[Floats, "3 3"]
    names: Mapping[tuple[int, int], str] = field(default_factory=dict)  # by (layer, label)


def read(path: Path, data: bytes) -> Raw:
    """Read the surfaces of all labels, one mesh per label, named by its number and, if it has one, its name."""
    reader = _READERS[suffix_of(path)]
    try:
        label_map = reader(path, data)
    except (ValueError, KeyError, OverflowError, struct.error, zlib.error, OSError, EOFError) as error:
        raise damaged(path.name, f"its header or its data cannot be read ({error})") from None
    if (
        not np.isfinite(label_map.steps).all()
        or not np.isfinite(label_map.origin).all()
        or not np.linalg.det(label_map.steps)
    ):
        raise damaged(path.name, "its axes or its origin are not finite, or its axes do not span the space")
    return label_surfaces(path.name, len(data), label_map.layers, label_map.names, label_map.origin, label_map.steps)


def _voxels(
    name: str, size: int, sizes: Sequence[int], kind: str, unpack: Callable[[int], bytes], skip: int = 0
) -> NDArray[Any]:
    """Read the voxels of a file of `size` bytes, the first axis varying fastest.

    `unpack` returns the first n bytes of the data, `skip` bytes of which precede the voxels; no more than needed is
    unpacked.
    """
    if min(sizes) < 1 or skip < 0:
        raise damaged(name, f"its sizes are {' x '.join(map(str, sizes))}")
    if min(sizes[-3:]) < 2:
        raise InputError(f"{name} has {' x '.join(map(str, sizes))} voxels, which have no surface", "save all slices")
    width = np.dtype(kind).itemsize
    count = math.prod(sizes)
    check_memory(name, size, (width + CODE_BYTES) * count + skip)
    data = unpack(skip + width * count)
    if len(data) < skip + width * count:
        raise damaged(name, f"it has {len(data) - skip:,} bytes of voxels, not {width * count:,}")
    return np.frombuffer(data, kind, count, skip).reshape(sizes[::-1]).T


def _decompress(data: bytes, need: int, encoding: str = "gzip") -> bytes:
    """Decompress the first `need` bytes of gzip or bzip2 data, or fewer if there are not as many."""
    decompressed = bytearray()
    while len(decompressed) < need and data:
        unpacker: Any = zlib.decompressobj(zlib.MAX_WBITS | 32) if encoding == "gzip" else bz2.BZ2Decompressor()
        decompressed += unpacker.decompress(data, need - len(decompressed))
        data = unpacker.unused_data if unpacker.eof else b""
    return bytes(decompressed)


def _nifti(path: Path, data: bytes) -> _LabelMap:
    """Read a NIfTI-1 file, and convert its frame from RAS to LPS."""
    compressed = data[:2] == b"\x1f\x8b"
    unpack = _unpacker(path.name, "gzip" if compressed else "raw", data, "")
    head = unpack(348)
    byte_order = next((each for each in "<>" if head[:4] == struct.pack(f"{each}i", 348)), "")
    if len(head) < 348 or not byte_order or head[344:348] != b"n+1\0":
        problem = f"{path.name} is not a NIfTI-1 file with its voxels in it"
        raise InputError(
            problem, "other kinds (NIfTI-2, .hdr with .img) can be saved as .nrrd or .mha, such as by 3D Slicer"
        )
    dims = struct.unpack(f"{byte_order}8h", head[40:56])
    if not 3 <= dims[0] <= 7 or any(each != 1 for each in dims[4 : dims[0] + 1]):
        raise InputError(f"{path.name} has other than three dimensions", "save one label map")
    (kind,), (offset, slope, shift) = (
        struct.unpack(f"{byte_order}h", head[70:72]),
        struct.unpack(f"{byte_order}3f", head[108:120]),
    )
    spacing = struct.unpack(f"{byte_order}8f", head[76:108])
    qform, sform = struct.unpack(f"{byte_order}2h", head[252:256])
    if kind not in _NIFTI_TYPES or not 0 <= offset < _MAX_HEADER_BYTES:
        raise InputError(f"{path.name} has voxels of type {kind}, which cannot be labels", "save a label map")
    if slope not in (0.0, 1.0) or (slope and shift):
        raise InputError(
            f"{path.name} scales its numbers by {slope:g} and {shift:g}", "labels are whole numbers: save them"
        )
    voxels = _voxels(path.name, len(data), dims[1:4], byte_order + _NIFTI_TYPES[kind], unpack, int(offset))
    if sform > 0:
        affine = np.array(struct.unpack(f"{byte_order}12f", head[280:328])).reshape(3, 4)
        steps, origin = affine[:, :3].T, affine[:, 3]
    elif qform > 0:
        b, c, d, *offsets = struct.unpack(f"{byte_order}6f", head[256:280])
        steps, origin = _rotation(b, c, d).T * np.array(spacing[1:4])[:, None], np.array(offsets)
        steps[2] *= -1.0 if spacing[0] < 0 else 1.0
    else:
        steps, origin = np.diag(spacing[1:4]), np.zeros(3)
    signs = np.array([-1.0, -1.0, 1.0])
    return _LabelMap([voxels], origin * signs, steps * signs)


def _rotation(b: float, c: float, d: float) -> Float[Floats, "3 3"]:
    """Rotation matrix of the unit quaternion (a, b, c, d) with a >= 0."""
    a = math.sqrt(max(1.0 - b * b - c * c - d * d, 0.0))
    return np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )


def _nrrd(path: Path, data: bytes) -> _LabelMap:
    """Read an NRRD file; with four dimensions, the first axis is the layer (3D Slicer's overlapping segments)."""
    if not data.startswith(b"NRRD"):
        raise InputError(f"{path.name} is not an NRRD file", "does the suffix fit the content?")
    end = re.search(rb"\r?\n\r?\n", data[:_MAX_HEADER_BYTES])
    lines = data[: end.start() if end else _MAX_HEADER_BYTES].decode("utf-8", "replace").splitlines()[1:]
    parts = [line.partition(":") for line in lines if not line.startswith("#")]
    fields = {key.strip().lower(): value.strip() for key, _, value in parts if not value.startswith("=")}
    extra = {key: value[1:].strip() for key, _, value in parts if value.startswith("=")}
    sizes = [int(word) for word in fields["sizes"].split()]
    if len(sizes) not in (3, 4) or int(fields["dimension"]) != len(sizes):
        raise InputError(f"{path.name} has {len(sizes)} dimensions, not three", "save one label map")
    steps, origin = _nrrd_frame(fields, len(sizes))
    data_file = fields.get("data file", fields.get("datafile"))
    content = data[end.end() :] if data_file is None and end else _read_data_file(path, data_file or "")
    encoding = fields.get("encoding", "raw").lower()
    voxel_type = _voxel_type(path.name, _NRRD_TYPES, re.sub(r"\bsigned |_t$| int$", "", fields["type"].lower()))
    voxel_type = (">" if fields.get("endian", "little").lower() == "big" else "<") + voxel_type
    skip, lines_skipped = int(fields.get("byte skip", fields.get("byteskip", "0"))), int(fields.get("line skip", "0"))
    if lines_skipped or skip < -1:
        raise InputError(f"{path.name} skips lines of its data", "save it as one .nrrd file")
    if skip == -1:
        content, skip = content[-math.prod(sizes) * np.dtype(voxel_type).itemsize :], 0
    unpack = _unpacker(path.name, encoding, content, voxel_type)
    voxels = _voxels(path.name, len(content), sizes, voxel_type, unpack, skip)
    layers = [voxels] if len(sizes) == 3 else list(voxels)
    return _LabelMap(layers, origin, steps, _segments(extra))


def _nrrd_frame(fields: Mapping[str, str], dimension: int) -> tuple[Floats, Floats]:
    """Return steps and origin, converted to LPS if the space is an anatomical one."""
    space = fields.get("space", "")
    words = [_LETTERS.get(letter, "") for letter in space] if space.isupper() else space.lower().split("-")
    signs = np.array(
        [_SIGNS[word] for word in words[:3]] if len(words) >= 3 and set(words[:3]) <= set(_SIGNS) else [1.0] * 3
    )
    vectors = re.findall(r"none|\([^)]*\)", fields.get("space directions", "").lower())
    if vectors:
        if dimension == 4 and vectors[0] != "none":
            raise ValueError("its first axis does not count layers")
        steps = np.array([_vector(each) for each in vectors if each != "none"])
    else:
        steps = np.diag([float(word) for word in fields.get("spacings", "1 1 1").split()[-3:]])
    if steps.shape != (3, 3):
        raise ValueError("three directions are needed")
    return steps * signs, _vector(fields.get("space origin", "(0,0,0)")) * signs


def _vector(text: str) -> Float[Floats, " 3"]:
    x, y, z = (float(word) for word in text.strip("() ").split(","))
    return np.array([x, y, z])


def _segments(extra: Mapping[str, str]) -> dict[tuple[int, int], str]:
    """Names that 3D Slicer gave the segments, by layer and label."""
    segments: dict[str, dict[str, str]] = {}
    for key, value in extra.items():
        if found := _SEGMENT.fullmatch(key):
            segments.setdefault(found[1], {})[found[2]] = value
    complete = [each for each in segments.values() if len(each) == 3]
    return {(int(each["Layer"]), int(each["LabelValue"])): each["Name"] for each in complete}


def _meta_image(path: Path, data: bytes) -> _LabelMap:
    """Read an ITK MetaImage. Its frame is LPS."""
    end = re.search(rb"^ElementDataFile *= *([^\r\n]*)\r?\n?", data[:_MAX_HEADER_BYTES], re.MULTILINE)
    if end is None:
        raise InputError(
            f"{path.name} is not a MetaImage: it has no ElementDataFile", "does the suffix fit the content?"
        )
    parts = [line.partition("=") for line in data[: end.start()].decode("utf-8", "replace").splitlines()]
    fields = {key.strip(): value.strip() for key, _, value in parts}
    sizes = [int(word) for word in fields["DimSize"].split()]
    channels = fields.get("ElementNumberOfChannels", "1")
    if int(fields["NDims"]) != 3 or len(sizes) != 3 or channels != "1":
        raise InputError(f"{path.name} has {fields['NDims']} dimensions and {channels} channels", "save one label map")
    voxel_type = _voxel_type(path.name, _MHA_TYPES, fields["ElementType"])
    big_endian = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "False"))
    voxel_type = (">" if big_endian.lower() == "true" else "<") + voxel_type
    data_file = end[1].decode("utf-8", "surrogateescape").strip()
    content = data[end.end() :] if data_file == "LOCAL" else _read_data_file(path, data_file)
    compressed = fields.get("CompressedData", "False").lower() == "true"
    encoding = "gzip" if compressed else "raw" if fields.get("BinaryData", "True").lower() == "true" else "text"
    skip = int(fields.get("HeaderSize", "0"))
    if skip == -1:
        content, skip = content[-math.prod(sizes) * np.dtype(voxel_type).itemsize :], 0
    voxels = _voxels(
        path.name, len(content), sizes, voxel_type, _unpacker(path.name, encoding, content, voxel_type), skip
    )

    def vector(*names: str, default: str) -> Floats:
        return np.array(next((fields[name] for name in names if name in fields), default).split(), float)

    spacing = vector("ElementSpacing", "ElementSize", default="1 1 1")
    axes = vector("TransformMatrix", "Rotation", "Orientation", default="1 0 0 0 1 0 0 0 1").reshape(3, 3)
    origin = vector("Offset", "Position", "Origin", default="0 0 0")
    if spacing.shape != (3,) or origin.shape != (3,):
        raise ValueError("spacing and offset need three numbers")
    return _LabelMap([voxels], origin, axes * spacing[:, None])


def _voxel_type(name: str, voxel_types: Mapping[str, str], word: str) -> str:
    if word not in voxel_types:
        raise InputError(f"{name} has voxels of type {word[:30]}, which cannot be labels", "save a label map")
    return voxel_types[word]


def _read_data_file(path: Path, name: str) -> bytes:
    """Read the data file, in the same folder, that a header refers to."""
    file = find_companion(path.parent, name)
    if file is None:
        problem = f"{path.name}: there is no file {name[:80]} in its folder, which should contain its voxels"
        raise InputError(problem, "keep both together, or save a .nrrd or .mha, which is one file")
    return read_bytes(file)


def _unpacker(name: str, encoding: str, content: bytes, kind: str) -> Callable[[int], bytes]:
    """Return a function that unpacks the first n bytes of the voxels of the given encoding and data type."""
    if encoding == "raw":
        return lambda need: content[:need]
    if encoding in ("gzip", "gz", "bzip2", "bz2"):
        return lambda need: _decompress(content, need, "gzip" if encoding[0] == "g" else "bz2")
    if encoding in ("ascii", "text", "txt"):
        return lambda need: parse_numbers(name, content).astype(kind).tobytes()[:need]
    raise InputError(f"{name} has the unsupported encoding {encoding[:20]}", "save it uncompressed, or by gzip")


_READERS: dict[str, Callable[[Path, bytes], _LabelMap]] = {
    ".nii": _nifti,
    ".nii.gz": _nifti,
    ".nrrd": _nrrd,
    ".nhdr": _nrrd,
    ".mha": _meta_image,
    ".mhd": _meta_image,
}
