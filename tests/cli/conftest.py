"""The command line as its users meet it: words in, a status, stdout and stderr out."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from meshmatch.cli import main
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures whose size is not given are small: rays cost seconds."""
    monkeypatch.setattr("meshmatch.render.layout.HEIGHT", 160)


@dataclass(frozen=True)
class Answer:
    status: int
    out: str
    err: str


Run = Callable[..., Answer]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run the program through its only door."""
    monkeypatch.delenv("MESHMATCH_DEBUG", raising=False)

    def call(*words: str | Path) -> Answer:
        capsys.readouterr()
        status = main([str(word) for word in words])
        heard = capsys.readouterr()
        return Answer(status, heard.out, heard.err)

    return call


@pytest.fixture
def two(tmp_path: Path, sphere: Shape, torus: Shape) -> tuple[Path, Path]:
    """Files of two shapes: a.ply (642 vertices) and b.ply (1600 vertices)."""
    files = tmp_path / "a.ply", tmp_path / "b.ply"
    save_shape(files[0], sphere)
    save_shape(files[1], torus)
    return files
