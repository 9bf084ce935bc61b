"""The whole road with the model that ships: two shapes in, a map out."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.api.matching import match, register
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.shapes.shape import Shape

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"
pytestmark = pytest.mark.usefixtures("remembered_fits")


@pytest.fixture(scope="module")
def dancer() -> Shape:
    return meshmatch.load_shape(SAMPLES / "dancer.ply")


@pytest.fixture(scope="module")
def both(dancer: Shape, remembered_fits: Callable):
    return match(dancer, meshmatch.load_shape(SAMPLES / "climber.ply"))


def turned(shape: Shape) -> Shape:
    """z up, facing elsewhere, in inches, somewhere else; twisted so that no axis survives."""
    a, b = 0.9, 2.4
    Z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    X = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    return Shape(shape.verts @ (Z @ X).T / 2.54 + [300, -20, 5], shape.faces, "turned")


def test_a_shape_is_matched_the_same_from_any_file(both, dancer: Shape) -> None:
    """The climber of a file that stands upright, in single precision, each face with its own vertices."""
    climber = meshmatch.load_shape(SAMPLES / "climber.ply")
    corner, single = climber.faces.ravel(), climber.verts.astype(np.float32).astype(np.float64)
    upright = np.stack([single[:, 0], single[:, 2], -single[:, 1]], axis=1)[corner]
    other = match(dancer, Shape(upright, np.arange(len(corner)).reshape(-1, 3), "climber"))
    x, y, z = other.map.points(Shape(upright, np.arange(len(corner)).reshape(-1, 3))).T
    np.testing.assert_allclose(np.stack([x, -z, y], axis=1), both.map.points(climber), atol=1e-5)


def test_the_samples_match_well(both) -> None:
    assert both.map.verdict != "poor"
    assert both.map.source_vertices == len(both.map.index)
    assert len(np.unique(both.map.index)) > 0.4 * both.map.target_vertices
    assert (both.source_fit.up, both.target_fit.up) == (both.map.source_up, both.map.target_up) == ("+y", "+z")


@pytest.mark.slow
def test_the_same_seed_gives_the_same_map(
    dancer: Shape, both, remembered_fits: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Fitter, "fit", remembered_fits)  # both are fitted again
    again = match(dancer, meshmatch.load_shape(SAMPLES / "climber.ply"))
    assert np.array_equal(again.map.index, both.map.index)
    assert np.array_equal(again.map.barycentric, both.map.barycentric)
    assert np.array_equal(again.map.confidence, both.map.confidence)


def test_a_turned_and_scaled_copy_maps_to_itself(dancer: Shape) -> None:
    found = match(dancer, turned(dancer)).map.index
    apart = np.linalg.norm(dancer.verts[found] - dancer.verts, axis=1)  # centimetres
    assert apart.mean() < 1.5
    assert (apart > 15).mean() < 0.005


def test_a_wrong_axis_is_obeyed_and_judged(dancer: Shape) -> None:
    upside_down, right = (register(dancer, config=FitConfig(refine="none", up=up)) for up in ("-y", "y"))
    assert right.up == "+y"
    assert upside_down.residual > right.residual


@pytest.mark.slow
def test_landmarks_are_honoured(dancer: Shape, both) -> None:
    climber = meshmatch.load_shape(SAMPLES / "climber.ply")
    source = np.array([100, 900])
    wanted = both.map.index[source]
    found = match(dancer, climber, landmarks=(source, wanted)).map.index[source]
    height = np.ptp(climber.verts, axis=0).max()
    assert np.linalg.norm(climber.verts[found] - climber.verts[wanted], axis=1).max() < 0.02 * height


@pytest.mark.slow
def test_a_map_tells_which_landmarks_it_misses(dancer: Shape, both) -> None:
    """The far end of the climber for one vertex of the dancer: the surfaces say something else."""
    climber = meshmatch.load_shape(SAMPLES / "climber.ply")
    right = both.map.index[100]
    far = int(np.linalg.norm(climber.verts - climber.verts[right], axis=1).argmax())
    found = match(dancer, climber, landmarks=([100], [far])).map
    assert found.verdict == "poor" and found.reasons[0].startswith(f"the known pair 100, {far} is missed by ")


@pytest.mark.parametrize(
    ("choice", "config", "error"),
    [
        ({"model": "humann"}, {}, ModelError),
        ({}, {"refine": "lots"}, OptionError),
        ({}, {"up": "w"}, OptionError),
        ({}, {"up": "y", "front": "-y"}, OptionError),
        ({"landmarks": (np.array([10**6]), np.array([0]))}, {}, OptionError),
        ({"landmarks": (np.array([0, 1]), np.array([0]))}, {}, OptionError),
        ({"landmarks": (np.array([0]), np.array([0]))}, {"refine": "none"}, OptionError),
        ({"landmarks": (np.array([0]), np.array([0]))}, {"refine": "latent"}, OptionError),
    ],
)
def test_choices_that_do_not_exist(dancer: Shape, choice: dict, config: dict, error: type) -> None:
    with pytest.raises(error) as caught:
        match(dancer, dancer, config=FitConfig(**config), **choice)
    assert caught.value.hint


def test_shapes_that_cannot_be_fitted(cube: Shape, dancer: Shape) -> None:
    with pytest.raises(InputError, match="12 usable triangles"):
        match(cube, dancer)
    apart = Shape(
        np.concatenate([dancer.verts, dancer.verts + 1e4]),
        np.concatenate([dancer.faces, dancer.faces + dancer.V]),
        "two",
    )
    with pytest.raises(InputError, match="several shapes of one kind") as caught:
        register(apart)
    assert "--only 1 or --only 2" in caught.value.hint


def test_what_is_no_body_is_called_poor(torus: Shape) -> None:
    fit = register(torus, model="human", config=FitConfig(variants=0, finalists=1, careful=1))
    assert fit.verdict == "poor"
    assert fit.reasons
