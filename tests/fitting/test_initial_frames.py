"""A category's card says how its shapes are placed, and fitting does as it says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.fitting.fit import axis_name
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.frames import aligned_frames, scan_frame
from meshmatch.models.network import NetworkConfig
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import template_radius
from tests.fitting.eggs import bent_egg, egg_model, scan_of

PLAIN = NetworkConfig(code=16, width=32, depth=1, basis=24, align_basis=0, corrections=0)
QUICK = FitConfig(refine="none", samples=600, coarse_samples=300)


def wanting(orientation: str, scale: str = "area") -> TrainedModel:
    model = egg_model(network=PLAIN)
    card = replace(model.card, frame={"orientation": orientation, "scale": scale})
    return replace(model, card=card)


def turned_template(model: TrainedModel, vector: list[float]) -> Shape:
    turn = Rotation.from_rotvec(vector).as_matrix()
    return Shape(model.template.shape.verts @ turn.T, model.template.shape.faces, "egg")


def test_a_searched_category_asks_its_network() -> None:
    model = egg_model()
    assert aligned_frames(model, scan_of(model.template.shape)) is None


def test_a_given_orientation_is_taken_as_it_is() -> None:
    model = wanting("none")
    [only] = aligned_frames(model, scan_of(turned_template(model, [0, 0, 1.0]))) or []
    assert np.array_equal(only.rotation, np.eye(3)) and not only.center.any()
    shape = turned_template(model, [0, 0, 0.2])
    fit = Fitter(model, QUICK).fit(shape)
    assert (axis_name(fit.frame.rotation[1]), axis_name(fit.frame.rotation[2])) == ("+y", "+z")
    assert (fit.up, fit.front, fit.axes) == ("", "", "")  # its template stands as some shape did
    assert Fitter(model, replace(QUICK, up="y")).fit(shape).axes == "up +y, front +z"


@pytest.mark.parametrize(("orientation", "vector"), [("near", [0.2, 0.1, 0.1]), ("rigid", [0.5, 2.0, -1.0])])
def test_an_orientation_is_found_by_alignment(orientation: str, vector: list[float]) -> None:
    model = wanting(orientation)
    shape = turned_template(model, vector)
    found = aligned_frames(model, scan_of(shape)) or []
    turn = Rotation.from_rotvec(vector).as_matrix()
    # an egg of three axes looks the same after half a turn about any of them
    halves = [np.eye(3), *(2 * np.outer(axis, axis) - np.eye(3) for axis in np.eye(3))]
    assert any(np.allclose(guess.rotation, turn @ half, atol=0.06) for guess in found for half in halves)
    assert len(found) == 1 if orientation == "near" else 1 < len(found) <= 4
    fit = Fitter(model, QUICK).fit(shape)
    assert fit.residual < 0.06  # far more where the orientation is wrong
    assert Fitter(wanting("none"), QUICK).fit(shape).residual > fit.residual


def test_the_scale_of_the_card_is_used() -> None:
    model = wanting("none", "sphere")
    egg = bent_egg(model)
    frame = scan_frame(model, egg)
    reach = np.linalg.norm(frame.apply(egg.verts), axis=1).max()
    assert reach == pytest.approx(template_radius(model.template))
    assert Fitter(model, QUICK).fit(egg).frame.scale == pytest.approx(frame.scale)
    there = scan_frame(wanting("none"), egg).apply(egg.verts)
    assert Shape(there, egg.faces).area == pytest.approx(1)
