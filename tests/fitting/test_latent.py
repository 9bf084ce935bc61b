"""The search over codes: it lowers the paper's energy and never hands back more than it was given."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.latent import LatentRefineConfig, PaperEnergy, refine_code
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import Progress
from meshmatch.templates.template import template_radius
from tests.fitting.eggs import bent_egg, egg_model, gentle_vectors, scan_of
from tests.training.small import POINTS

CONFIG = LatentRefineConfig(steps=30, points=120)


@pytest.fixture(scope="module", params=["corrected", "paper"])
def model(request: pytest.FixtureRequest) -> TrainedModel:
    return egg_model("cubic", POINTS) if request.param == "paper" else egg_model()


@pytest.fixture(scope="module")
def scan(model: TrainedModel) -> OrientedPoints:
    return scan_of(model.template.shape, 400)


def energy(
    model: TrainedModel, scan: OrientedPoints, vectors: np.ndarray, config: LatentRefineConfig = CONFIG
) -> float:
    return PaperEnergy(model, scan, config, np.random.default_rng(0)).value(vectors)


def test_lengths_are_in_the_unit_sphere_where_the_model_scales_by_it(model: TrainedModel, scan: OrientedPoints) -> None:
    chamfer, still = replace(CONFIG, volume=0.0, arap=0.0), np.zeros((model.template.K, 3))
    sphere = replace(model, card=replace(model.card, frame={"orientation": "searched", "scale": "sphere"}))
    radius = template_radius(model.template)
    assert abs(radius - 1) > 0.1
    assert energy(sphere, scan, still, chamfer) == pytest.approx(energy(model, scan, still, chamfer) / radius**2)


def search(model: TrainedModel, scan: OrientedPoints, config: LatentRefineConfig = CONFIG, **more) -> np.ndarray:
    return refine_code(model, scan, config, np.random.default_rng(0), **more)


def test_it_lowers_the_energy_of_the_networks_answer(model: TrainedModel, scan: OrientedPoints) -> None:
    first = search(model, scan, replace(CONFIG, steps=1))
    some, more = (search(model, scan, replace(CONFIG, steps=steps)) for steps in (10, 30))
    assert energy(model, scan, more) < energy(model, scan, some) < energy(model, scan, first)


def test_it_begins_where_it_is_told_to(model: TrainedModel, scan: OrientedPoints) -> None:
    start = gentle_vectors(model)
    assert np.allclose(search(model, scan, replace(CONFIG, steps=1), start=start), start, atol=1e-6)
    found = search(model, scan, start=start)
    assert energy(model, scan, found) < energy(model, scan, start)


@pytest.mark.parametrize("rate", [1e-3, 1e3])
def test_it_never_returns_a_higher_energy_than_it_was_given(
    model: TrainedModel, scan: OrientedPoints, rate: float
) -> None:
    """Also not where the rate is absurd, or the start is the answer."""
    config = replace(CONFIG, steps=8, rate=rate)
    for start in (np.zeros((model.template.K, 3)), gentle_vectors(model)):
        found = search(model, scan, config, start=start)
        assert energy(model, scan, found) <= energy(model, scan, start) * (1 + 1e-5)


def test_the_same_draw_gives_the_same_answer_and_the_network_stays_as_it_is(
    model: TrainedModel, scan: OrientedPoints
) -> None:
    before = {name: value.clone() for name, value in model.network.state_dict().items()}
    one, again = (search(model, scan, replace(CONFIG, steps=10)) for _ in range(2))
    assert np.array_equal(one, again)
    assert all((before[name] == value).all() for name, value in model.network.state_dict().items())
    assert all(parameter.grad is None for parameter in model.network.parameters())


def test_progress_is_told(model: TrainedModel, scan: OrientedPoints) -> None:
    shares: list[float] = []
    search(model, scan, replace(CONFIG, steps=25), progress=Progress(lambda stage, name, share: shares.append(share)))
    assert shares == [0.04, 0.84, 1.0]


def test_a_fit_refined_by_code_has_a_lower_energy_than_the_networks(model: TrainedModel) -> None:
    shape = bent_egg(model, 4)
    config = FitConfig(samples=400, copies=4, hypotheses=1, careful=1, variants=2, finalists=1, latent=CONFIG)
    plain = Fitter(model, replace(config, refine="none")).fit(shape)
    refined = Fitter(model, replace(config, refine="latent")).fit(shape)
    assert np.allclose(plain.frame.rotation, refined.frame.rotation)
    seen = scan_of(shape, 400, seed=9)
    local = OrientedPoints(plain.frame.apply(seen.points), seen.normals @ plain.frame.rotation.T)
    assert energy(model, local, refined.vectors) < energy(model, local, plain.vectors)
