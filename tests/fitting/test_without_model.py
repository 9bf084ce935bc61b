"""A template fitted without a model, to shapes that are turned, mirrored or in another pose."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError
from meshmatch.experiments.makers.molars_and_leaves import leaves
from meshmatch.fitting import without_model
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.judge.direct import DirectFeatures
from meshmatch.fitting.kind_templates import mean_shape, template_of, viscous_system, with_final_nodes
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import RimTerm
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.fitting.without_model import fit_without_model
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.rims import RimPoints
from meshmatch.shapes.shape import Shape
from meshmatch.templates.mirror_images import mirrored
from meshmatch.templates.template import Template
from tests.fitting.test_direct import QUICK, bent, creature
from tests.shapes.test_rims import disc

IDENTITY = Frame(1.0, np.eye(3), np.zeros(3))
CONFIG = ViscousConfig(nodes=200, radius=0.2, samples=3000, back_points=1500)


@pytest.fixture(scope="module")
def template() -> Template:
    return template_of(creature(3), "creature", CONFIG)


def off(fit: Fit, shape: Shape) -> float:
    """Mean distance of the template's vertices on a shape from the shape's own, which are the same."""
    return float(np.linalg.norm(fit.points_in_file - shape.verts, axis=1).mean() / np.sqrt(shape.area))


def test_a_turned_mirror_image_is_found_and_named(template: Template, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(*_: Any) -> Any:
        raise InputError("it is no surface")

    monkeypatch.setattr(without_model, "match_directly", nothing)
    shape = mirrored(creature(3))
    turn = Rotation.from_euler("xyz", (100, 20, 200), degrees=True)
    shape = replace(shape, verts=40 * shape.verts @ turn.as_matrix().T + 5)
    fit = fit_without_model(template, shape, CONFIG)
    assert fit.frame.mirrored and "mirror" in fit.notes[0] and fit.verdict == "fair"
    assert off(fit, shape) < 0.01
    assert not fit_without_model(template, shape, CONFIG, mirror=False).frame.mirrored


def test_another_pose_is_searched_for_and_is_where_the_mean_begins(
    template: Template, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(without_model, "_SEARCH_CONFIG", QUICK)
    shape = bent(creature(3), Rotation.from_euler("xyz", (70, 130, -40), degrees=True), 250.0)
    fit = fit_without_model(template, shape, CONFIG, mirror=False)
    assert off(fit, shape) < 0.04
    monkeypatch.setattr(without_model, "match_directly", None)
    again = fit_without_model(template, shape, CONFIG, start=fit)
    assert off(again, shape) < 0.04


def test_what_no_pose_fits_is_poor(template: Template, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(without_model, "_SEARCH_CONFIG", QUICK)
    rod = creature(3)
    rod = replace(rod, verts=rod.verts * [0.1, 4.0, 0.1])
    assert fit_without_model(template, rod, CONFIG, mirror=False).verdict == "poor"


@pytest.mark.parametrize(("stretch", "energies", "chosen"), [(0.3, (0.03, 0.029), 1), (1.5, (0.06, 0.055), 0)])
def test_another_turn_is_taken_where_the_template_is_near_or_the_fit_is_clearly_better(
    template: Template, monkeypatch: pytest.MonkeyPatch, stretch: float, energies: tuple[float, ...], chosen: int
) -> None:
    task = without_model._Task(template, creature(3), CONFIG)
    starts = [without_model._Start(IDENTITY, np.zeros((task.system.K, 3))) for _ in energies]

    def fitted(initial: without_model._Start) -> without_model._Fitted:
        energy = energies[starts.index(initial)]
        features = DirectFeatures(residual=energy - 0.03 * stretch, stretch=stretch)
        return without_model._Fitted(initial, task._samples, initial.vectors, features)

    monkeypatch.setattr(task, "aligned_starts", lambda *_, **__: starts)
    monkeypatch.setattr(task, "fitted", fitted)
    assert task.best_turn(None).initial is starts[chosen]


@pytest.mark.parametrize("far", [False, True])
def test_the_last_fit_is_softer_unless_the_template_is_far(
    template: Template, monkeypatch: pytest.MonkeyPatch, far: bool
) -> None:
    asked: list[ViscousConfig] = []

    def still(system: NodeSystem, samples: OrientedPoints, config: ViscousConfig, *_: Any) -> Any:
        asked.append(config)
        return np.zeros((system.K, 3))

    monkeypatch.setattr(without_model, "viscous_vectors", still)
    monkeypatch.setattr(without_model, "_FOLDING_STRETCH", -1.0 if far else 1.0)
    fit = fit_without_model(template, template.shape, mirror=False)
    assert asked[0] == ViscousConfig.choosing()
    assert asked[-1] == (ViscousConfig.folding() if far else ViscousConfig())
    asked.clear()
    fit_without_model(template, template.shape, start=fit)
    assert (asked[-1] == ViscousConfig.folding()) == far


def test_a_template_that_would_fold_is_held(template: Template) -> None:
    """A creature on something of another build: less of it is inside out, by the stiffer fit."""
    other = Shape(creature(3).verts * [2.5, 1, 0.4], creature(3).faces)
    folded = []
    for config in (ViscousConfig.choosing(), ViscousConfig.folding()):
        task = without_model._Task(template, other, replace(config, samples=3000, back_points=1500))
        vectors = task.fitted(without_model._Start(sqrt_area_frame(other), np.zeros((task.system.K, 3)))).vectors
        folded.append(task.system.regularity(vectors).inverted)
    assert folded[1] < 0.5 * folded[0]


def test_last_fits_have_more_nodes_but_of_sheets(template: Template) -> None:
    fine, few = with_final_nodes(template, CONFIG), len(template.nodes)
    assert len(fine.nodes) == round(5 / 3 * few) and np.allclose(fine.shape.verts, template.shape.verts)
    assert fine.hash != template.hash
    sheet = template_of(disc(count=1000), "sheet", CONFIG)
    assert with_final_nodes(sheet, CONFIG) is sheet


def test_the_mean_of_poses_keeps_the_size_of_what_turns(template: Template) -> None:
    system, fits = viscous_system(template), []
    rest = np.array(template.shape.verts)
    plain = fit_without_model(template, template.shape, CONFIG, mirror=False)
    for angle in (-1.2, 1.2):  # a limb along y turns about the x axis, more towards its end
        turn = Rotation.from_rotvec(angle * np.clip(rest[:, 1:2] / 0.6, 0, 1) * [1, 0, 0])
        vectors = system.vectors_to(turn.apply(rest))
        fits.append(replace(plain, vectors=vectors, points=system.moved(vectors)))
    mean = mean_shape(template, fits)
    straight = np.mean([fit.points for fit in fits], axis=0)
    lengths = [np.ptp(points[:, 1]) for points in (rest, mean, straight)]
    assert abs(lengths[1] / lengths[0] - 1) < 0.5 * abs(lengths[2] / lengths[0] - 1)


def test_rims_of_open_sheets_lie_on_each_other() -> None:
    """Leaves slide in their planes: their rims tell where they belong."""
    made = leaves(2, 7, 900)
    first, other = (Shape(verts, made.faces, "leaf") for verts in made.verts)
    quick = replace(CONFIG, nodes=120, radius=0.25, samples=1500, back_points=1500)
    template, errors = template_of(first, "leaf", quick), []
    at = cKDTree(template.shape.verts).query(sqrt_area_frame(first).apply(first.verts))[1]
    for width in (0.0, quick.rim_width):
        task = without_model._Task(template, other, replace(quick, rim_width=width))
        found = task.fitted(task.aligned_starts(None, "near")[0])
        points = found.initial.frame.undo(task.system.moved(found.vectors))
        errors.append(np.linalg.norm(points[at] - other.verts, axis=1).mean())
    assert errors[1] < 0.5 * errors[0]


def test_a_rim_is_held_on_a_rim_and_glides_along_it() -> None:
    shape = disc(1.0)
    system = viscous_system(template_of(shape, "disc", CONFIG))
    rim = RimPoints.of(Shape(1.1 * system.verts, system.faces), 0.01)
    weights, pulls = RimTerm(rim, 0.01, 0.1).quadratic(system, np.zeros((system.K, 3)), 1e3)
    assert np.array_equal(weights.any(axis=1), system.rim)
    at = np.flatnonzero(system.rim)
    normal = weights[at][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    out = system.verts[at] / np.linalg.norm(system.verts[at], axis=1, keepdims=True)
    along = np.cross(out, [0.0, 0.0, 1.0])
    across = np.einsum("nij,ni,nj->n", normal, out, out)
    assert np.einsum("nij,ni,nj->n", normal, along, along).max() < 0.02 * across.min()
    length = 2 * np.pi / np.sqrt(np.pi)
    assert across.sum() == pytest.approx(0.01 * length, rel=0.02)
    wanted = np.einsum("nij,nj->ni", normal, 1.1 * system.verts[at])
    assert np.abs(pulls[at] - wanted).max() < 0.02 * np.abs(wanted).max()
