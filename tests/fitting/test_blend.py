"""Between fits: rotations and stretches by hand, then the laws of a blend on bent eggs."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import OptionError
from meshmatch.fitting import blend as blend_module
from meshmatch.fitting.blend import Blend
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.solve.blend import RotationBlend, StretchBlend, _spanning_order, polar
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.frames import Frame
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.conftest import some_fit

HALF = np.array([0.5, 0.5])


def about(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def bent(model: TrainedModel, degrees: float, grow: float = 1.0) -> np.ndarray:
    """Node vectors (K, 3) of an egg whose upper end is turned about x against its lower end, without any stretch."""
    nodes = model.template.nodes
    angle = np.radians(degrees) * nodes[:, 1]
    # Circles around a line in the plane y = 0: the middle line keeps its length.
    bend = np.radians(degrees)
    radius = 1 / bend + nodes[:, 2]
    turned = np.stack([nodes[:, 0], radius * np.sin(angle), radius * np.cos(angle) - 1 / bend], 1)
    return grow * turned - nodes


def fit_of(model: TrainedModel, vectors: np.ndarray, frame: Frame | None = None) -> Fit:
    system = node_system(model)
    about = {"template_hash": model.template.hash, "frame": frame or Frame.identity()}
    return some_fit(system.moved(vectors), system.faces, vectors=vectors, resting=system.verts, **about)


@pytest.fixture(scope="module")
def three(model: TrainedModel) -> list[Fit]:
    return [fit_of(model, bent(model, degrees, grow)) for degrees, grow in ((100, 1.0), (20, 1.1), (-90, 1.2))]


def test_two_rotations_turn_at_constant_speed_and_on() -> None:
    blend = RotationBlend([about("z", 10)[None], about("z", 100)[None]])
    for time in (-0.2, 0.0, 1 / 3, 1.0, 1.4):
        found = blend.at(np.array([1 - time, time]))
        assert np.allclose(found[0], about("z", 10 + 90 * time))


def test_rotations_are_met_and_their_order_does_not_matter() -> None:
    keys = Rotation.random(12, random_state=np.random.default_rng(0)).as_matrix().reshape(3, 4, 3, 3)
    there, back = RotationBlend(list(keys)), RotationBlend(list(keys[::-1]))
    for number in range(3):
        assert np.allclose(there.at(np.eye(3)[number]), keys[number])
    weights = np.array([0.5, 0.3, 0.2])
    assert np.allclose(there.at(weights), back.at(weights[::-1]))


def test_stretches_are_blended_by_their_logarithms() -> None:
    blend = StretchBlend([np.diag(np.log([4.0, 1.0, 0.25]))[None], np.zeros((1, 3, 3))])
    assert np.allclose(blend.at(HALF), np.diag([2.0, 1.0, 0.5]))
    assert np.allclose(blend.at(np.array([2.0, -1.0])), np.diag([16.0, 1.0, 1 / 16]))
    assert np.isfinite(blend.at(np.array([1e4, 1 - 1e4]))).all()


def test_polar_gives_back_what_it_took_apart() -> None:
    F = np.random.default_rng(1).normal(0, 0.3, (50, 3, 3)) + np.eye(3)
    F = F[np.linalg.det(F) > 0.05]
    R, logs = polar(F)
    assert np.allclose(np.linalg.det(R), 1)
    assert np.allclose(logs, logs.transpose(0, 2, 1))
    assert np.allclose(R @ StretchBlend([logs]).at(np.ones(1)), F)


def test_polar_of_a_reflection_is_a_rotation_with_a_very_small_stretch() -> None:
    R, logs = polar(np.diag([2.0, 1.0, -0.5])[None])
    assert np.allclose(R, np.eye(3))
    assert np.allclose(np.exp(np.diag(logs[0])), [2.0, 1.0, 1e-3])


def fake_system(verts: np.ndarray, faces: np.ndarray) -> Any:
    return SimpleNamespace(verts=verts, faces=faces, gradient_points=np.arange(len(verts)))


def test_the_tree_goes_round_a_tear() -> None:
    """A ring of points of which one edge is torn by a large turn: it is the one edge that the tree leaves out."""
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    verts = np.concatenate([ring, [[0, 0, 5]]])
    faces = np.array([[k, (k + 1) % 8, 8] for k in range(8)])
    turns = np.stack([about("z", 20 * k) for k in range(8)] + [about("x", 180)])
    parent, levels = _spanning_order(fake_system(verts, faces), [turns], np.array([0]))
    assert parent.tolist() == [-1, 0, 1, 2, 3, 4, 5, 6, parent[8]]
    assert sorted(np.concatenate(levels).tolist()) == list(range(1, 9))


def test_every_part_has_its_own_root() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    verts = np.concatenate([square, square + np.array([50.0, 0, 0])])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    same = np.repeat(np.eye(3)[None], 8, 0)
    parent, levels = _spanning_order(fake_system(verts, faces), [same], np.array([0, 1]))
    roots = np.flatnonzero(parent < 0)
    assert (roots < 4).sum() == 1
    assert len(roots) == 2
    done = set(roots.tolist())
    for level in levels:
        assert set(parent[level].tolist()) <= done
        done |= set(level.tolist())
    assert len(done) == 8


@pytest.mark.parametrize("way", ["field", "codes"])
def test_the_fits_are_met_exactly(model: TrainedModel, three: list[Fit], way: Any) -> None:
    shapes = [Shape(fit.points, fit.faces) for fit in three]
    blend = Blend(model, three, [0.0, 0.4, 1.0], shapes, way)
    for fit, time in zip(three, blend.times, strict=True):
        assert np.array_equal(blend.vectors(time), fit.vectors)
        near = blend.vectors(time + 1e-7 if time < 1 else time - 1e-7)
        assert np.abs(near - fit.vectors).max() < 1e-4  # and no jump there
        assert blend.deviation(time, fit.vectors).volume < 1e-12


def test_what_codes_leave_over_turns_with_the_part(model: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Codes that turn the whole, fits with the same small difference as seen from it: half way it is that still."""
    nodes = model.template.nodes
    own = 0.02 * np.sin(7 * nodes[:, [1, 2, 0]])

    def turned(degrees: float) -> np.ndarray:
        return nodes @ about("z", degrees).T - nodes

    monkeypatch.setattr(
        blend_module, "_code_path", lambda model, shapes, fits: lambda weights: turned(120 * weights[1])
    )
    fits = [fit_of(model, turned(angle) + own @ about("z", angle).T) for angle in (0, 120)]
    shapes = [Shape(fit.points, fit.faces, "egg") for fit in fits]
    blend = Blend(model, fits, None, shapes, "codes")
    for time in (0.0, 0.5, 0.8, 1.0, 1.2):
        there = turned(120 * time) + own @ about("z", 120 * time).T
        assert np.allclose(blend.vectors(time), there, atol=1e-5)


def test_there_and_back_is_one_way(model: TrainedModel, three: list[Fit]) -> None:
    there, back = Blend(model, three[::2]), Blend(model, three[::-2])
    for time in (-0.2, 0.3, 0.5, 1.1):
        assert np.allclose(there.vectors(time), back.vectors(1 - time), atol=1e-9)
        assert np.allclose(there.weights(time), back.weights(1 - time)[::-1])


def test_three_times_one_way_is_smooth_and_straight_on_beyond(model: TrainedModel, three: list[Fit]) -> None:
    blend = Blend(model, three)
    assert np.allclose([blend.weights(time).sum() for time in (-0.5, 0.2, 0.7, 1.5)], 1)
    step = 1e-4
    at = [blend.weights(0.5 + k * step) for k in (-1, 0, 1)]
    assert np.abs(at[0] - 2 * at[1] + at[2]).max() < 20 * step**2  # no kink at the one in the middle
    end = [blend.weights(1 - k * step) for k in (0, 1, 2)]
    assert np.abs(end[0] - 2 * end[1] + end[2]).max() < 0.01 * step**2 + 1e-12  # no bend at the ends either
    beyond = [blend.weights(1 + k) for k in (0.0, 0.1, 0.2)]
    assert np.allclose(beyond[0] - 2 * beyond[1] + beyond[2], 0)
    assert np.allclose((beyond[1] - beyond[0]) / 0.1, (end[0] - end[1]) / step, atol=1e-3)  # at the same speed
    assert np.allclose(Blend(model, three[:2]).weights(1.2), [-0.2, 1.2])


def test_the_core_goes_straight(model: TrainedModel, three: list[Fit]) -> None:
    blend, core = Blend(model, three[::2]), model.template.core
    ends = [fit.points[core].mean(0) for fit in three[::2]]
    for time in (0.3, 1.2):
        found = blend.points(blend.vectors(time))[core].mean(0)
        assert np.allclose(found, (1 - time) * ends[0] + time * ends[1])


def test_a_bending_egg_keeps_its_size(model: TrainedModel, three: list[Fit]) -> None:
    """From one bend to the opposite one: straight in the middle, where straight lines would flatten it."""
    blend = Blend(model, [three[0], fit_of(model, bent(model, -100))])
    middle = blend.vectors(0.5)
    flat = (blend.vectors(0.0) + blend.vectors(1.0)) / 2
    assert blend.deviation(0.5, middle).arap < 0.2 * blend.deviation(0.5, flat).arap
    assert blend.deviation(0.5, middle).volume < 0.2 * blend.deviation(0.5, flat).volume
    # The bend of 0 degrees is no motion at all.
    assert np.abs(blend.points(middle) - node_system(model).verts).max() < 0.02


def test_a_copy_moves_rigidly(model: TrainedModel, three: list[Fit]) -> None:
    frame = Frame(2.0, about("y", 30), np.array([1.0, 2, 3]))
    moved = Frame(2.0, about("y", 120), np.array([5.0, 2, -3]))
    blend = Blend(model, [replace(three[0], frame=frame), replace(three[0], frame=moved)])
    vectors = blend.vectors(0.25)
    assert np.allclose(vectors, three[0].vectors, atol=1e-9)
    quarter = blend.frame(0.25)
    assert (quarter.scale, quarter.center.tolist()) == (pytest.approx(2.0), [2.0, 2.0, 1.5])
    assert np.allclose(quarter.rotation, about("y", 52.5))
    for time, wanted in ((0.0, frame), (1.0, moved)):
        found = blend.frame(time)
        assert np.allclose(found.rotation, wanted.rotation)
        assert np.allclose(found.center, wanted.center)


def test_sizes_grow_by_equal_factors(model: TrainedModel, three: list[Fit]) -> None:
    small, large = (Frame(scale, np.eye(3), np.zeros(3)) for scale in (1.0, 9.0))
    blend = Blend(model, [replace(three[0], frame=small), replace(three[0], frame=large)])
    assert blend.frame(0.5).scale == pytest.approx(3.0)


def test_the_template_turns_as_its_field_does(model: TrainedModel) -> None:
    turn = about("x", 40)
    nodes = model.template.nodes
    whole = fit_of(model, nodes @ turn.T - nodes)
    turns = Blend(model, [whole, whole]).turns(whole.vectors)
    assert np.allclose(turns, turn, atol=1e-4)


def test_deviation_counts_from_the_stretch_that_the_fits_have(model: TrainedModel) -> None:
    nodes = model.template.nodes
    double = fit_of(model, nodes.copy())  # twice as large
    blend = Blend(model, [double, double])
    own = blend.deviation(0.5, double.vectors)
    assert own.volume < 1e-6
    assert own.arap < 1e-6
    assert own.template_volume == pytest.approx(7, abs=1e-3)
    assert own.template_arap == pytest.approx(3 * np.sqrt(3), abs=1e-3)
    rest = blend.deviation(0.5, np.zeros_like(nodes))
    assert (rest.volume, rest.template_volume) == (pytest.approx(7, abs=1e-3), pytest.approx(0, abs=1e-6))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fits": 1}, "at least two shapes"),
        ({"times": [0.0, 0.0, 1.0]}, "later than the one before"),
        ({"times": [0.0, 1.0]}, "3 shapes need as many times"),
        ({"way": "magic"}, "unknown way to blend 'magic'"),
        ({"way": "codes"}, "needs the shape of each fit"),
        ({"other": True}, "another template"),
    ],
)
def test_what_cannot_be_blended(model: TrainedModel, three: list[Fit], change: dict[str, Any], words: str) -> None:
    fits = three[: change.get("fits", 3)]
    if change.get("other"):
        fits = [*fits[:2], replace(fits[2], template_hash="0" * 16)]
    with pytest.raises(OptionError, match=words):
        Blend(model, fits, change.get("times"), None, cast(Any, change.get("way", "field")))
