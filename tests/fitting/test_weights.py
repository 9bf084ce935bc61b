"""Points of a shape that are trusted less: weights on their way into a fit, and what they change there."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.api.inputs import repair_or_raise
from meshmatch.errors import InputError
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import bent_egg, egg_model

NO_FACES = np.empty((0, 3), np.int64)
FEW = FitConfig(samples=1500, variants=0, finalists=1, careful=1, partial="no", up="y", front="z")


def test_weights_are_numbers_from_0_to_1_for_each_vertex(cube: Shape) -> None:
    for wrong in (np.ones(7), np.full(8, 1.5), np.full(8, np.nan), "heavy"):
        with pytest.raises(InputError):
            Shape(cube.verts, cube.faces, weights=wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("cloud", [False, True])
def test_samples_have_the_weights_of_where_they_lie(sphere: Shape, cloud: bool) -> None:
    height = 0.5 + 0.5 * sphere.verts[:, 2]
    verts = np.concatenate([sphere.verts, [[9.0, 9, 9]]])  # which repair drops
    shape = Shape(verts, NO_FACES if cloud else sphere.faces, weights=np.append(height, 1))
    samples = sample_surface(repair_or_raise(shape).shape, 300, np.random.default_rng(0))
    assert samples.weights is not None
    assert np.abs(samples.weights - (0.5 + 0.5 * samples.points[:, 2])).max() < 1e-7  # single precision
    assert samples.signed == (not cloud)


def test_what_is_not_trusted_pulls_at_no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """An egg with a bump that has no weight is fitted as if it had none, alone and with another."""
    model = egg_model()
    egg = bent_egg(model)
    top = egg.verts[:, 1] > np.quantile(egg.verts[:, 1], 0.8)
    bumped = egg.verts + 0.25 * np.sqrt(egg.area) * top[:, None] * [0.0, 1, 0]

    def away(weights: np.ndarray | None) -> float:
        shapes = [Shape(bumped, egg.faces, "bumped", weights=weights), egg]
        found = [
            replace(Fitter(model, FEW).fit(shape), verdict="fair") for shape in shapes
        ]  # poor ones agree with nobody
        fits = agreed_fits(model, shapes, found, FEW)
        return float(surface.query(fits[0].points_in_file)[0].max())

    surface = cKDTree(sample_surface(egg, 20_000, np.random.default_rng(0)).points)
    assert away(np.where(top, 0.0, 1.0)) < 0.8 * away(None)
    heard: list[OrientedPoints] = []

    def agree(system, members, threads, pairs):
        heard.extend(member.samples for member in members)
        return [member.vectors for member in members]

    monkeypatch.setattr("meshmatch.fitting.agree.agree", agree)
    away(np.where(top, 0.0, 1.0))
    assert heard[0].weights is not None and heard[1].weights is None
