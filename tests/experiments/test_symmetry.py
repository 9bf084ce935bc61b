"""The bench of counterparts across the plane of symmetry, on eggs."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.experiments.bench import any_shapes, symmetry
from meshmatch.experiments.bench.specimens import Specimens, by_points
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.fitting.small_viscous import use_small_fits


def eggs() -> dict[str, Shape]:
    """Symmetric in the plane y = 0 alone."""
    found = {}
    for number, squash in enumerate((0.6, 0.65, 0.7)):
        ball = icosphere(3)
        radius = 1 + 0.15 * ball.verts[:, 2] + 0.1 * ball.verts[:, 0]
        found[str(number)] = Shape(radius[:, None] * ball.verts * [1, squash, 1.4], ball.faces, str(number))
    return found


@pytest.fixture
def some(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Specimens:
    """Eggs with two keypoints on either side, and one in the middle."""
    folder, shapes = tmp_path / "shrec07" / "bird", eggs()
    folder.mkdir(parents=True)
    (folder / "symmetry.txt").write_text("0 1\n2 3\n")
    ball = cKDTree(icosphere(3).verts)
    sides = ball.query([[0.4, 0.9, 0], [0.4, -0.9, 0], [0, 0.7, 0.7], [0, -0.7, 0.7], [1, 0, 0]])[1]
    for name, shape in shapes.items():
        save_shape(folder / f"{name}.ply", shape)
        np.save(folder / f"{name}.keypoints.npy", sides)
    rng = np.random.default_rng(0)
    found = Specimens({name: by_points(shape, sides, 5, rng) for name, shape in shapes.items()}, "%", folder)
    monkeypatch.setattr(symmetry, "load", lambda *_: found)
    return found


def test_counterparts_are_found_by_fits(some: Specimens, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_small_fits(monkeypatch)
    row = symmetry.measure("bird", "none", tmp_path, 0, tmp_path / "work")
    assert (row["shapes"], row["keypoints"], row["lost"]) == (3, 12, 0.0)
    assert row["error"] < 5 and set(row["each"]) == {"0", "1", "2"}


def test_counterparts_of_one_shape_are_those_of_its_map(
    some: Specimens, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(shape: Shape) -> SimpleNamespace:
        way = icosphere(3).verts  # specimens are turned, but keep the order of their vertices
        across = cKDTree(way).query(way * [1, -1, 1])[1]
        return SimpleNamespace(map=VertexMap.between(shape, shape, across))

    monkeypatch.setattr(symmetry, "find_symmetry", found)
    row = symmetry.measure("bird", "alone", tmp_path, 0, tmp_path / "work")
    assert (row["keypoints"], row["lost"]) == (12, 0.0) and row["error"] < 1


def test_what_stays_on_its_side_is_lost(some: Specimens, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(symmetry, "by_fits", lambda *_: lambda name, at: some.each[name].shape.verts[at])
    row = symmetry.measure("bird", "none", tmp_path, 0, tmp_path / "work")
    assert row["lost"] == 1.0 and row["error"] > 40
    assert symmetry.pairs_of(some.folder, "0").tolist() == [[0, 1], [1, 0], [2, 3], [3, 2]]
    assert len(any_shapes.symmetries(some.folder, "0")) == 2
