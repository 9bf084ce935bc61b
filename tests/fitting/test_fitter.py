"""The whole fit on eggs that an untrained network reads: laws that hold however badly it reads."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import OptionError
from meshmatch.fields.field import PointField
from meshmatch.fitting.fit import Fit, axis_name
from meshmatch.fitting.fit_config import REFINE_NAMES, FitConfig, Refine
from meshmatch.fitting.fitter import Fitter, template_vertices
from meshmatch.fitting.search.frames import axis_vector
from meshmatch.fitting.search.latent import LatentRefineConfig
from meshmatch.fitting.search.predictor import Candidate, Mirror, Predictor
from meshmatch.fitting.search.refinement import REFINEMENTS
from meshmatch.fitting.search.task import take_samples
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import bent_egg, egg_model

QUICK = FitConfig(
    samples=400, coarse_samples=200, copies=4, variants=3, finalists=2, latent=LatentRefineConfig(steps=5)
)
RANK = {"good": 0, "fair": 1, "poor": 2}


@pytest.fixture(scope="module")
def egg(model: TrainedModel) -> Shape:
    return bent_egg(model)


@pytest.fixture(scope="module")
def fits(model: TrainedModel, egg: Shape) -> dict[Refine, Fit]:
    return {refine: Fitter(model, replace(QUICK, refine=refine)).fit(egg) for refine in REFINEMENTS}


@pytest.mark.parametrize("refine", REFINEMENTS)
def test_torch_on_a_device_fits_as_numpy_does(
    model: TrainedModel, egg: Shape, fits: dict[Refine, Fit], refine: Refine
) -> None:
    there = Fitter(model, replace(QUICK, refine=refine, device="cpu:0")).fit(egg)
    assert np.allclose(there.points, fits[refine].points, atol=2e-4)


@pytest.mark.parametrize("device", ["abacus", "cuda:4096", ""])
def test_a_device_that_is_not_there_is_said(model: TrainedModel, egg: Shape, device: str) -> None:
    with pytest.raises(OptionError, match="device"):
        Fitter(model, replace(QUICK, device=device)).fit(egg)


@pytest.mark.parametrize("refine", REFINEMENTS)
def test_a_fit_is_whole(model: TrainedModel, egg: Shape, fits: dict[Refine, Fit], refine: Refine) -> None:
    fit = fits[refine]
    K, V = model.template.K, model.template.shape.V
    assert fit.template_hash == model.template.hash
    assert (fit.vectors.shape, fit.points.shape, fit.vertex_distance.shape) == ((K, 3), (V, 3), (egg.V,))
    assert np.isfinite(fit.points).all()
    assert np.array_equal(fit.faces, model.template.shape.faces)
    assert np.array_equal(fit.resting, model.template.shape.verts)
    assert np.allclose(fit.frame.apply(fit.points_in_file), fit.points)
    mesh = fit.to_trimesh()
    assert np.array_equal(mesh.vertices, fit.points_in_file) and np.array_equal(mesh.faces, fit.faces)
    R = fit.frame.rotation
    assert np.allclose(R @ R.T, np.eye(3))
    assert np.linalg.det(R) == pytest.approx(1)
    assert fit.frame.scale == pytest.approx(np.sqrt(egg.area))
    assert (fit.up, fit.front) == (axis_name(R[1]), axis_name(R[2]))
    assert (fit.verdict == "good") == (not fit.reasons)
    nearest = np.linalg.norm(fit.frame.apply(egg.verts[:5])[:, None] - fit.points, axis=2).min(1)
    assert np.allclose(fit.vertex_distance[:5], nearest)


def test_the_refinements_are_three(fits: dict[Refine, Fit]) -> None:
    none, latent, nodes = (fits[refine] for refine in REFINEMENTS)
    assert np.abs(none.vectors - latent.vectors).max() > 1e-4
    assert np.abs(none.vectors - nodes.vectors).max() > 1e-2
    assert nodes.residual < none.residual
    with pytest.raises(OptionError, match="unknown refinement 'lots'") as caught:
        FitConfig(refine="lots")  # type: ignore[arg-type]
    assert "nodes" in caught.value.hint


@pytest.mark.parametrize(
    "wrong",
    [
        *({"tilt": "a"}, {"tilt": float("nan")}, {"tilt": True}, {"device": None}, {"nodes": 3}, {"latent": None}),
        *({"samples": True}, {"seed": False}, {"hypotheses": 2.0}, {"copies": 0}),
    ],
)
def test_values_of_another_type_are_refused_at_once(wrong: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=f"{next(iter(wrong))} cannot be "):
        FitConfig(**wrong)


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"steps": True}, {"points": 1.5}, {"rate": 0}, {"rate": float("inf")}, {"arap": -1e-3}]
)
def test_a_search_over_codes_needs_steps_points_and_a_rate(wrong: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=f"{next(iter(wrong))} cannot be ") as caught:
        LatentRefineConfig(**wrong)
    assert "or leave it out" in caught.value.hint
    assert LatentRefineConfig(volume=0, arap=0, steps=np.int64(3)).steps == 3  # type: ignore[arg-type]


@pytest.mark.parametrize("refine", REFINEMENTS)
def test_the_same_seed_gives_the_same_fit(
    model: TrainedModel, egg: Shape, fits: dict[Refine, Fit], refine: Refine
) -> None:
    np.random.seed(7)  # noqa: NPY002 (a global state that must not matter)
    again = Fitter(model, replace(QUICK, refine=refine)).fit(egg)
    for name in ("points", "vectors", "vertex_distance"):
        assert np.array_equal(getattr(again, name), getattr(fits[refine], name))
    assert (again.residual, again.verdict, again.seed) == (fits[refine].residual, fits[refine].verdict, 0)
    other = Fitter(model, replace(QUICK, refine=refine, seed=1)).fit(egg)
    assert not np.array_equal(other.vectors, again.vectors)
    assert other.seed == 1


def test_the_unit_and_the_place_of_a_shape_do_not_matter(
    model: TrainedModel, egg: Shape, fits: dict[Refine, Fit]
) -> None:
    moved = Shape(egg.verts / 2.54 + [30, -20, 5], egg.faces, "elsewhere")
    fit = Fitter(model, replace(QUICK, refine="none")).fit(moved)
    assert np.allclose(fit.points_in_file, fits["none"].points_in_file / 2.54 + [30, -20, 5], atol=1e-4)


def test_samples_are_of_a_shape_of_area_one_around_its_centroid(egg: Shape) -> None:
    frame, scan = take_samples(egg, 500, np.random.default_rng(0))
    there = Shape(frame.apply(egg.verts), egg.faces)
    assert there.area == pytest.approx(1)
    a, b, c = (there.verts[there.faces[:, k]] for k in range(3))
    weight = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert np.allclose(weight @ (a + b + c) / 3, 0, atol=1e-9)
    assert scan.points.shape == scan.normals.shape == (500, 3)
    assert np.allclose(np.linalg.norm(scan.normals, axis=1), 1)
    assert np.linalg.norm(scan.points, axis=1).max() <= np.linalg.norm(there.verts, axis=1).max() + 1e-9


@pytest.mark.parametrize(("up", "front"), [("y", None), (None, "-z"), ("-x", "y")])
def test_axes_of_the_user_leave_no_other_hypothesis(
    model: TrainedModel, egg: Shape, monkeypatch: pytest.MonkeyPatch, up: str | None, front: str | None
) -> None:
    tried = []
    plain = Predictor.fit_all

    def watched(predictor: Predictor, starts: list[tuple[OrientedPoints, RigidPose]], **how: int) -> list[Candidate]:
        tried.extend(pose.rotation for _, pose in starts)
        return plain(predictor, starts, **how)

    monkeypatch.setattr(Predictor, "fit_all", watched)
    Fitter(model, replace(QUICK, refine="none", up=up, front=front, careful=1)).fit(egg)
    asked = np.stack(tried[:-1])  # the last is the best one again, with care
    for name, column in ((up, 1), (front, 2)):
        if name is not None:
            assert (asked[:, :, column] @ axis_vector(name) > 0.5).all()


def test_progress_rises_to_the_whole(model: TrainedModel, egg: Shape) -> None:
    told: list[tuple[str, float]] = []

    def progress(stage: str, name: str, share: float) -> None:
        assert name == egg.name
        told.append((stage, share))

    Fitter(model, QUICK, progress).fit(egg)
    for stage in ("orientation", "refinement"):
        shares = [share for what, share in told if what == stage]
        assert shares == sorted(shares)
        assert shares[-1] == pytest.approx(1)
    assert [what for what, _ in told] == sorted(what for what, _ in told)  # o before r


def test_landmarks_of_the_file_are_met(model: TrainedModel, egg: Shape, fits: dict[Refine, Fit]) -> None:
    free = fits["nodes"]
    at = np.array([5, 60, 120])
    size = np.sqrt(egg.area)
    place = free.points_in_file[at] + 0.06 * size * np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    held = Fitter(model, QUICK).fit(egg, landmarks=(at, place))
    apart = [np.linalg.norm(fit.points_in_file[at] - place, axis=1).mean() / size for fit in (free, held)]
    assert apart[0] == pytest.approx(0.06)
    assert apart[1] < 0.03


def test_a_landmark_lies_where_the_fits_put_it(model: TrainedModel, fits: dict[Refine, Fit]) -> None:
    template = model.template
    verts = template.shape.verts
    frames = Frame(2.0, np.eye(3), np.array([1.0, 0, 0])), Frame(0.5, np.eye(3)[[1, 2, 0]], np.zeros(3))
    still = [replace(fits["none"], frame=frame, points=verts) for frame in frames]
    places = [frame.undo(verts[[4, 77]] + 1e-3) for frame in frames]
    assert template_vertices(template, still, places).tolist() == [4, 77]
    # of two answers the vertex between them
    nearest = np.linalg.norm(verts - verts[4], axis=1).argsort()
    other = int(nearest[6])
    middle = np.linalg.norm(verts - (verts[4] + verts[other]) / 2, axis=1).argmin()
    mixed = [still[0].frame.undo(verts[[4]]), still[1].frame.undo(verts[[other]])]
    assert template_vertices(template, still, mixed).tolist() == [middle]


def test_a_fit_that_is_not_good_is_made_again(model: TrainedModel, egg: Shape) -> None:
    few = FitConfig.quick(samples=400, coarse_samples=200, copies=4)
    first, again, full = (
        Fitter(model, config).fit(egg) for config in (replace(few, again=False), few, few.with_all_of_the_search())
    )
    assert first.verdict != "good"
    assert np.array_equal(again.vectors, full.vectors) and not np.array_equal(again.vectors, first.vectors)


def test_quick_is_less_search_and_the_same_refinement() -> None:
    usual, quick = FitConfig(), FitConfig.quick(seed=3)
    fewer = ("samples", "coarse_samples", "copies", "hypotheses", "careful", "variants", "finalists")
    assert all(getattr(quick, name) < getattr(usual, name) for name in fewer)
    assert all(
        getattr(quick, name) == value
        for name, value in vars(usual).items()
        if name not in (*fewer, "seed", "again", "nodes")
    )
    assert quick.again and quick.nodes.schedule.steps < usual.nodes.schedule.steps
    assert quick.with_all_of_the_search() == replace(usual, seed=3)
    assert FitConfig.quick(samples=9000).with_all_of_the_search() == replace(usual, samples=9000)
    with pytest.raises(OptionError):
        FitConfig.quick(samples=0)


def test_names_of_directions() -> None:
    assert axis_name(np.array([0.1, -0.9, 0.3])) == "-y"
    assert axis_name(np.array([0.1, 0.2, 0.3])) == "+z"


def test_two_threads_share_one_fitter_that_is_still_cold(egg: Shape, monkeypatch: pytest.MonkeyPatch) -> None:
    """What depends on the model alone is built once, and each shape is fitted as if it were alone."""
    built: list[type] = []
    for kind in (NodeSystem, Mirror):
        plain = kind.__init__

        def counted(self, *args, kind=kind, plain=plain):
            built.append(kind)
            plain(self, *args)

        monkeypatch.setattr(kind, "__init__", counted)
    fields: list[int] = []
    plain_field = TrainedModel.field

    def counted_field(model: TrainedModel, points: np.ndarray) -> PointField:
        fields.append(len(points))
        return plain_field(model, points)

    monkeypatch.setattr(TrainedModel, "field", counted_field)
    model = egg_model.__wrapped__()  # nothing is known of it
    fitter, shapes = Fitter(model, QUICK), [egg, bent_egg(model, 1)]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(fitter.fit, shapes))
    assert built == [NodeSystem, Mirror]
    assert len(fields) == 2  # of the template and of its mirror image
    for shape, fit in zip(shapes, together, strict=True):
        assert np.array_equal(fit.vectors, Fitter(model, QUICK).fit(shape).vectors)
    assert built == [NodeSystem, Mirror]


def test_every_refinement_has_a_name_that_can_be_listed_without_it() -> None:
    assert tuple(REFINEMENTS) == REFINE_NAMES
