"""The public names have types that a strict checker sees."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import meshmatch

ROOT = Path(__file__).resolve().parents[2]
TYPES = (
    *("MatchResult", "VertexMap", "float", "VertexMap", "Fit", "Evaluation", "Labels", "TexturedResult"),
    *("Interpolation", "tuple", "Page", "Shape", "VertexMap", "TrainedModel"),
)


@pytest.mark.slow
def test_a_strict_checker_knows_all_types_of_a_client() -> None:
    words = ["--strict", "--follow-imports=silent", "tests/api/client.py"]
    done = subprocess.run([sys.executable, "-m", "mypy", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    seen = re.findall(r'Revealed type is "([^"]+)"', done.stdout)
    assert [re.split(r"\.", kind.partition("[")[0])[-1] for kind in seen] == list(TYPES)


def test_public_names_are_there_and_nothing_else_is() -> None:
    assert dir(meshmatch) == sorted(meshmatch.__all__)
    for name in meshmatch.__all__:
        assert getattr(meshmatch, name) is not None
    assert (ROOT / "meshmatch" / "py.typed").is_file()
    with pytest.raises(AttributeError, match="no attribute 'mach'"):
        _ = meshmatch.mach  # type: ignore[attr-defined]


def test_the_reference_names_everything_public() -> None:
    from meshmatch.experiments import reference

    described = {name for names in reference.API.values() for name in names}
    assert described == set(meshmatch.__all__) - {"__version__"}
