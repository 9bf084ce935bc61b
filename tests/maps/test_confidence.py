"""Confidence falls where two fits had to move until they agreed, and nowhere else; and everywhere without trust."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from meshmatch.fitting.fit import Fit
from meshmatch.maps.build import build_map
from meshmatch.maps.places import Places
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere, some_fit
from tests.maps.solids import bumpy_sphere
from tests.transfer.known import brute_force


def mapped(
    source: Repaired, fit: Fit, target: Repaired, other: Fit, before: tuple[Fit | None, Fit | None] = (None, None)
) -> VertexMap:
    return build_map(Places.of(source, fit, before[0]), Places.of(target, other, before[1]))


def confidence(doubt: NDArray[np.float64] | float, trust: float = 1.0) -> NDArray[np.float64]:
    """Of squared distances in their units: what the regression found."""
    doubt, trust = np.maximum(doubt, 1e-6), min(trust, 0.999)
    right = 1 / (1 + (1 - trust) / trust / 0.091 * np.sqrt(np.expm1(doubt)))
    return np.asarray(np.exp(-doubt) * (0.072 + 0.896 * right))


def unit_ball(rows: int = 24, columns: int = 40) -> Shape:
    """Its area is 1."""
    ball = bumpy_sphere(rows, columns)
    return Shape(ball.verts / np.sqrt(ball.area), ball.faces, "ball")


def lying_on(shape: Shape) -> Fit:
    """A fit that is exactly its shape."""
    return some_fit(shape.verts, shape.faces)


def round_ball() -> Shape:
    """Its area is 1, and a turn slides it along itself."""
    ball = icosphere(4)
    return Shape(ball.verts / np.sqrt(ball.area), ball.faces, "round")


def turned_back(shape: Shape, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vertices of a ball, each turned about z by an angle (V,)."""
    x, y, z = shape.verts.T
    return np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z], 1)


def test_where_agreement_changed_the_map_it_is_not_believed() -> None:
    """The template slid along the upper half of one ball, by as much as a confidence of 1/e asks for at most."""
    unit = round_ball()
    part, fit = repair(unit), lying_on(unit)
    sure = mapped(part, fit, part, fit)
    assert np.allclose(sure.confidence, 0.968, atol=2e-3)
    high = unit.verts[:, 2] > 0.08
    slid = replace(fit, points=turned_back(unit, np.where(unit.verts[:, 2] > 0, 0.15, 0.0)))
    far = np.linalg.norm(slid.points - fit.points, axis=1)
    for before in ((slid, fit), (fit, slid)):
        found = mapped(part, fit, part, fit, before)
        assert np.allclose(found.confidence[high], confidence((far[high] / 0.0487) ** 2), atol=0.02)
        assert np.allclose(found.confidence[unit.verts[:, 2] < -0.08], 0.968, atol=2e-3)
        assert found.confidence[high].min() < 0.6
        assert np.array_equal(found.index, sure.index)
    assert np.allclose(mapped(part, fit, part, fit, (fit, fit)).confidence, sure.confidence)


def test_fits_that_slide_together_change_no_map() -> None:
    """The target is larger and stands on its head: its template slides as far on the resting one, and further in space."""
    unit = round_ball()
    turned = Shape(unit.verts * [1.3, -1.3, -1.3], unit.faces, "turned")
    fit, other = lying_on(unit), replace(lying_on(turned), resting=unit.verts)
    angle = np.where(unit.verts[:, 2] > 0, 0.15, 0.0)
    before = replace(fit, points=turned_back(unit, angle))
    there = replace(other, points=turned_back(turned, -angle))
    apart = replace(other, points=turned_back(turned, angle))
    together, against = (
        mapped(repair(unit), fit, repair(turned), other, (before, each)).confidence for each in (there, apart)
    )
    high = unit.verts[:, 2] > 0.08
    assert np.allclose(together, 0.968, atol=2e-3)
    far = 2 * np.linalg.norm(before.points - fit.points, axis=1)
    assert np.allclose(against[high], confidence((far[high] / 0.0487) ** 2), atol=0.02)


def test_a_map_is_believed_as_its_fits_are() -> None:
    """Of a wrong fit, one vertex in sixteen is near by chance; of a doubtful one, far ones are doubted more than near."""
    unit = unit_ball()
    part, fit = repair(unit), lying_on(unit)
    half = replace(fit, trust=0.5, verdict="fair")
    for source, target, believed in ((fit, half, 0.5), (half, fit, 0.5), (half, half, 0.25)):
        found = mapped(part, source, part, target)
        assert np.allclose(found.confidence, confidence(0.0, believed), atol=1e-6)
        assert found.verdict == "fair"
    wrong = replace(fit, trust=1e-9)
    assert np.allclose(mapped(part, wrong, part, fit).confidence, 0.072, atol=1e-3)
    away = replace(fit, points=1.02 * unit.verts)
    lost = [mapped(part, replace(away, trust=trust), part, fit).confidence for trust in (1.0, 0.5)]
    assert (lost[1] / lost[0]).max() < 0.8 < confidence(0.0, 0.5) / confidence(0.0)


@pytest.mark.parametrize("side", ["source", "target"])
def test_distance_from_the_template_costs_confidence_on_both_sides(side: str) -> None:
    """The fit of one side is a little too large all over; the other one is exact."""
    unit = unit_ball(12, 20)
    part, fit = repair(unit), lying_on(unit)
    large = replace(fit, points=1.05 * unit.verts)
    distance, _ = brute_force(unit.verts, large.points, unit.faces)
    near = Places.of(part, fit)
    far = replace(Places.of(part, large), resting=near.resting, height=near.height)  # the same places cost nothing
    found = build_map(far, near) if side == "source" else build_map(near, far)
    assert distance.max() > 0.01
    assert np.allclose(found.confidence, confidence((distance / 0.0353) ** 2), atol=0.03)


def test_what_was_left_out_is_as_far_away_as_it_lies() -> None:
    """Vertices of weight 0, which the nearest ones stand for, and one that no face uses."""
    unit = unit_ball()
    verts = np.concatenate([unit.verts, [1.0, 1.0, 1.05] * unit.verts[:1] + [0, 0, 0.05]])
    weights = np.append(np.where(unit.verts[:, 2] > 0.2, 0.0, 1.0), 1.0)
    part, fit = repair(Shape(verts, unit.faces, "part", weights=weights)), lying_on(unit)
    places, dropped = Places.of(part, fit), np.setdiff1d(np.arange(len(verts)), part.kept_vertex)
    assert 0 < len(dropped) < 0.4 * len(verts) and len(verts) - 1 in dropped
    away = np.linalg.norm(verts[dropped] - verts[places.stands[dropped]], axis=1)
    assert np.allclose(places.distance[dropped], away, atol=1e-6) and away.max() > 0.05
    assert np.allclose(places.distance[part.kept_vertex], 0, atol=1e-6)


def test_reasons_say_which_shape_they_are_of() -> None:
    """By its name, or without one by its side."""
    places = Places.of(repair(unit_ball()), lying_on(unit_ball()))
    here, there = (replace(places, name=name, verdict="fair", reasons=("cut",)) for name in ("ball", ""))
    assert build_map(here, there).reasons == ("ball: cut", "target: cut")
    assert build_map(there, here).reasons == ("source: cut", "ball: cut")


def test_what_has_no_position_is_a_guess() -> None:
    """It has the answer of a neighbour, and may be anywhere."""
    unit = unit_ball()
    invalid = np.isin(np.arange(unit.V + 1), [7, unit.V])
    verts = np.where(invalid[:, None], 0.0, np.append(unit.verts, [[0, 0, 0]], axis=0))
    part, fit = repair(Shape(verts, unit.faces, "part", invalid=invalid)), lying_on(unit)
    found = mapped(part, fit, repair(unit), fit)
    assert found.confidence[invalid].max() < 1e-6 and found.confidence[~invalid].min() > 0.9
    assert np.linalg.norm(unit.verts[found.index[7]] - unit.verts[7]) < 0.2
