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
from meshmatch.models.tensor_file import TensorInfo, check_tensor_file


def write(path: Path, header: Any, data: bytes = b"", length: int | None = None) -> Path:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text) if length is None else length) + text + data)
    return path


def entry(dtype: str = "F32", shape: Any = (2,), span: Any = (0, 8)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": span}


def test_files_of_the_library_pass(tmp_path: Path) -> None:
    kinds = ("float16", "float32", "float64", "int8", "int32", "int64", "uint8", "bool")
    arrays = {kind: np.ones((3, k), kind) for k, kind in enumerate(kinds)}
    save_file(arrays, tmp_path / "a.safetensors", {"words": "x"})
    found = check_tensor_file(tmp_path / "a.safetensors")
    assert {name: info.shape for name, info in found.items()} == {n: a.shape for n, a in arrays.items()}
    assert found["int64"] == TensorInfo("I64", (3, 5))


def test_scalars_and_no_tensors_pass(tmp_path: Path) -> None:
    path = write(tmp_path / "a", {"x": entry(shape=(), span=(0, 4))}, b"1234")
    assert check_tensor_file(path)["x"].shape == ()
    assert check_tensor_file(write(tmp_path / "b", {})) == {}


def test_a_header_that_claims_10_gb_is_refused_unread(tmp_path: Path) -> None:
    path = write(tmp_path / "a", b"{}", length=10_000_000_000)
    with pytest.raises(ModelError, match="header claims 10,000,000,000 bytes"):
        check_tensor_file(path)


def test_a_tensor_that_claims_10_gb_is_refused(tmp_path: Path) -> None:
    size = 10_000_000_000
    path = write(tmp_path / "a", {"x": entry("U8", (size,), (0, size))}, b"12")
    with pytest.raises(ModelError, match="header is wrong at 'x'"):
        check_tensor_file(path)


def test_a_huge_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        file.truncate(tensor_file.MOST_BYTES + 1)  # sparse: it takes no room
    with pytest.raises(ModelError, match="at most 1,000,000,000"):
        check_tensor_file(path)


@pytest.mark.parametrize("data", [b"", b"1234567", struct.pack("<Q", 50) + b"{}"])
def test_a_file_that_is_cut_short_is_refused(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(data)
    with pytest.raises(ModelError, match=r"too short|cut short"):
        check_tensor_file(tmp_path / "a")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="cannot read"):
        check_tensor_file(tmp_path / "none")


def test_bytes_before_the_end_are_needed(tmp_path: Path) -> None:
    header = {"x": entry()}
    assert check_tensor_file(write(tmp_path / "a", header, b"12345678"))
    for data in (b"1234567", b"123456789"):
        with pytest.raises(ModelError, match="its header speaks of"):
            check_tensor_file(write(tmp_path / "a", header, data))


_WRONG: list[Any] = [
    b"not json",
    b"[" * 200_000,
    b"\xff\xff",
    [],
    b'{"x": 1, "x": 2}',
    {"x": 3},
    {"x": {"dtype": "F32", "shape": [2]}},
    {"x": entry() | {"more": 1}},
    {"x": entry(dtype="F99")},
    {"x": entry(dtype=["F32"])},
    {"x": entry(shape=(3,))},
    {"x": entry(shape="2")},
    {"x": entry(shape=(-1, -2))},
    {"x": entry(shape=(2.0,))},
    {"x": entry(shape=(True, 2))},
    {"x": entry(shape=(1,) * 20 + (2,))},
    {"x": entry(span=(0,))},
    {"x": entry(span=(8, 0))},
    {"x": entry(span=(-8, 0))},
    {"x": entry(span=(4, 12))},
    {"x": entry(), "y": entry()},
    {
        "x": entry(shape=(1,), span=(0, 4)),
        "y": entry(shape=(1,), span=(2, 6)),
        "z": entry("U8", (2,), (6, 8)),
    },
]


@pytest.mark.parametrize("header", _WRONG, ids=range(len(_WRONG)))
def test_dishonest_headers_are_refused(header: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "a", header, b"12345678")
    with pytest.raises(ModelError, match="is damaged") as caught:
        check_tensor_file(path)
    assert caught.value.hint
