"""The public names: all there, and described. That they have types, mypy asks of `client.py`."""

from pathlib import Path

import pytest

import meshmatch

ROOT = Path(__file__).resolve().parents[2]


def test_public_names_are_there_and_nothing_else_is() -> None:
    assert dir(meshmatch) == sorted(meshmatch.__all__)
    for name in meshmatch.__all__:
        assert getattr(meshmatch, name) is not None
    assert (ROOT / "meshmatch" / "py.typed").is_file()
    with pytest.raises(AttributeError, match="no attribute 'mach'"):
        _ = meshmatch.mach  # type: ignore[attr-defined]
