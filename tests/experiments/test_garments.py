"""Clothes that are bound to a body, and so known on every other one."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.experiments.bench.garments import Bound, inside, main, true_map
from meshmatch.shapes.files import save_shape
from tests.conftest import icosphere

BINDING = """# a file
name patch
x_scale 0 1 1.0
z_scale 0 3 2.0
y_scale 0 2 1.0
verts 0
1
0 1 2 0.5 0.25 0.25 0.1 0.2 0.4
3

delete_verts
1 2 - 3
"""
BASE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]])


@pytest.fixture
def patch(tmp_path: Path) -> Path:
    save_shape(tmp_path / "patch.obj", (np.eye(3), [[0, 1, 2]]))
    (tmp_path / "patch.mhclo").write_text(BINDING)
    return tmp_path / "patch.mhclo"


def test_a_garment_follows_its_triangles_and_sizes(patch: Path) -> None:
    bound = Bound.read(patch)
    assert np.allclose(bound.refit(BASE).verts, [[1, 0, 0], [0.35, 0.45, 0.4], [0, 0, 2]])
    assert np.allclose(bound.refit(3 * BASE).verts, 3 * bound.refit(BASE).verts)
    lifted = np.tile(np.eye(3, 4), (4, 1, 1))
    lifted[:, :, 3] = [1.0, 2.0, 3.0]
    assert np.allclose(bound.refit_posed(BASE, lifted).verts, bound.refit(BASE).verts + np.array([1, 2, 3]))


def test_files_that_do_not_belong_together_are_refused(patch: Path, capsys: pytest.CaptureFixture[str]) -> None:
    patch.write_text(BINDING.replace("3\n\ndelete", "\ndelete"))
    with pytest.raises(InputError, match=r"patch\.mhclo binds 2 vertices, and its mesh has 3"):
        Bound.read(patch)
    assert main(["--data", str(patch.parent)]) == 1
    assert "there are no *.mhclo files" in capsys.readouterr().err


def test_true_places_and_what_lies_inside() -> None:
    ball = icosphere(2)
    found = true_map(ball, ball.verts, ball)
    assert np.allclose(found.points(ball), ball.verts, atol=1e-9)
    assert inside(ball, np.array([[0.1, 0.2, 0.0], [2.0, 0.1, 0.0]])).tolist() == [True, False]
