"""Safetensors headers: honest ones pass, all others are refused before anything is loaded."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from meshmatch.errors import ModelError
from meshmatch.models import tensor_file
from meshmatch.models.tensor_file import TensorInfo, read_header


def write(path: Path, header: Any, data: bytes = b"12345678", length: int | None = None) -> Path:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text) if length is None else length) + text + data)
    return path


def entry(dtype: str = "F32", shape: Any = (2,), span: Any = (0, 8)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": span}


def test_files_of_the_library_pass(tmp_path: Path) -> None:
    kinds = ("float16", "float32", "float64", "int8", "int32", "int64", "uint8", "bool")
    arrays = {kind: np.ones((3, k), kind) for k, kind in enumerate(kinds)}
    save_file(arrays, tmp_path / "a.safetensors", {"words": "x"})
    found = read_header(tmp_path / "a.safetensors")
    assert {name: info.shape for name, info in found.items()} == {n: a.shape for n, a in arrays.items()}
    assert found["int64"] == TensorInfo("I64", (3, 5))


def test_a_huge_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        file.truncate(tensor_file.MAX_BYTES + 1)  # sparse: it takes no room
    with pytest.raises(ModelError, match="at most 500,000,000"):
        read_header(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="cannot read"):
        read_header(tmp_path / "none")


@pytest.mark.parametrize(
    ("header", "data", "length"),
    [
        (b"{}", b"", 10_000_000_000),
        (b"{}", b"", 50),
        (b"[" * 200_000, b"", None),
        ({"x": entry("U8", (10_000_000_000,), (0, 10_000_000_000))}, b"12", None),
        ({"x": entry()}, b"1234567", None),
        ({"x": entry()}, b"123456789", None),
        ({"x": entry(shape=(3,))}, b"12345678", None),
        ({"x": entry(dtype="F99")}, b"12345678", None),
        ({"x": entry(span=(4, 12))}, b"12345678", None),
        ({"x": entry(), "y": entry()}, b"12345678", None),
    ],
)
def test_dishonest_headers_are_refused(header: Any, data: bytes, length: int | None, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="is damaged") as caught:
        read_header(write(tmp_path / "a", header, data, length))
    assert caught.value.hint
