"""What a safetensors file holds, told by its own bytes before any library loads it."""

import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path

from meshmatch.errors import ModelError
from meshmatch.models.card import unique_keys

MOST_HEADER_BYTES = 1_000_000
MOST_BYTES = 1_000_000_000

_ITEM_BYTES = {
    **dict.fromkeys(("BOOL", "U8", "I8"), 1),
    **dict.fromkeys(("U16", "I16", "F16", "BF16"), 2),
    **dict.fromkeys(("U32", "I32", "F32"), 4),
    **dict.fromkeys(("U64", "I64", "F64"), 8),
}


@dataclass(frozen=True)
class TensorInfo:
    """Kind and shape of one tensor in a file."""

    dtype: str
    shape: tuple[int, ...]


def check_tensor_file(path: str | Path) -> dict[str, TensorInfo]:
    """The tensors of a safetensors file, if its header is honest.

    The header has at most 1 MB and the file 1 GB; every tensor's bytes are those of its kind and shape;
    header and tensors together are the whole file, with no gap and no overlap. Only the header is read.

    Raises
    ------
    ModelError
        The file is missing, cut short, too large, or its header is not as above.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            start = file.read(8)
            if size > MOST_BYTES:
                raise _bad(path, f"it has {size:,} bytes; at most {MOST_BYTES:,} are allowed")
            if len(start) < 8:
                raise _bad(path, "it is too short for a header")
            (length,) = struct.unpack("<Q", start)
            if length > MOST_HEADER_BYTES:
                raise _bad(
                    path, f"its header claims {length:,} bytes; at most {MOST_HEADER_BYTES:,} are allowed"
                )
            header = file.read(length)
    except OSError as error:
        raise ModelError(f"cannot read {path}: {error.strerror}", "is the model complete?") from error
    if len(header) < length:
        raise _bad(path, "it is cut short")
    try:
        words = json.loads(header.decode("utf-8"), object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:
        raise _bad(path, "its header is no JSON") from error
    if not isinstance(words, dict):
        raise _bad(path, "its header is no JSON object")
    words.pop("__metadata__", None)
    found: dict[str, TensorInfo] = {}
    spans: list[tuple[int, int]] = []
    for name, entry in words.items():
        info, span = _tensor(path, name, entry)
        found[name] = info
        spans.append(span)
    end = 0
    for begin, after in sorted(spans):
        if begin != end:
            raise _bad(path, "its tensors overlap or leave gaps")
        end = after
    if 8 + length + end != size:
        raise _bad(path, f"its header speaks of {8 + length + end:,} bytes, but it has {size:,}")
    return found


def _tensor(path: Path, name: str, entry: object) -> tuple[TensorInfo, tuple[int, int]]:
    if not isinstance(entry, dict) or entry.keys() != {"dtype", "shape", "data_offsets"}:
        raise _bad(path, f"its header is wrong at {name[:60]!r}")
    dtype, shape, span = entry["dtype"], entry["shape"], entry["data_offsets"]
    counts = (
        [*shape, *span] if isinstance(shape, list) and isinstance(span, list) and len(span) == 2 else [-1]
    )
    if not all(type(count) is int and 0 <= count <= MOST_BYTES for count in counts) or len(counts) > 10:
        raise _bad(path, f"its header is wrong at {name[:60]!r}")
    if not isinstance(dtype, str) or dtype not in _ITEM_BYTES:
        raise _bad(path, f"{name[:60]!r} has an unknown kind of number")
    if span[1] - span[0] != math.prod(shape) * _ITEM_BYTES[dtype]:
        raise _bad(path, f"the bytes of {name[:60]!r} are not those of its shape")
    return TensorInfo(dtype, tuple(shape)), (span[0], span[1])


def _bad(path: Path, reason: str) -> ModelError:
    return ModelError(f"{path} is damaged: {reason}", "fetch or make it again")
