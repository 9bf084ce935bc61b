"""Shapes that stand alike are matched more finely without a model, and broken ones as parts of whole ones."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Bools, Floats
from meshmatch.experiments.makers.bones import BoneScan, draw_bones, scan
from meshmatch.fitting import same_pose, without_model
from meshmatch.fitting.direct import MIRROR, DirectMatch, match_either_side
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.judge.reasons import Reason, Verdict
from meshmatch.fitting.kind_templates import template_of, viscous_system
from meshmatch.fitting.one_way import DirectConfig, KnownPairs
from meshmatch.fitting.same_pose import fit_as_part, is_refined, refine_fit, refine_match
from meshmatch.fitting.solve.system import node_system
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.fitting.without_model import fit_same_pose, fit_same_pose_near, fit_without_model
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.rims import MIN_RIM_LENGTH, rim_lengths
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import bent_egg, egg_model, gentle_vectors
from tests.fitting.test_direct import QUICK

FAST = replace(QUICK, both_ways="no")
RIGHT, LEFT = (scan(draw_bones(3)[number], 900) for number in (0, 2))


@pytest.fixture(autouse=True)
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer nodes and samples than of specimens."""
    few = partial(ViscousConfig, nodes=300, radius=0.13, faces=1500, samples=3000, back_points=2000)
    monkeypatch.setattr(same_pose, "ViscousConfig", few)


def cut(bone: BoneScan, high: float, way: float = 1.0) -> tuple[Shape, Bools]:
    """What lies below a height of a bone's axis, or above it, and which vertices those are."""
    kept = way * bone.directions[:, 2] < way * high
    faces = bone.shape.faces[kept[bone.shape.faces].all(1)]
    used = np.unique(faces)
    return Shape(bone.shape.verts[used], np.searchsorted(used, faces), "broken"), np.isin(np.arange(len(kept)), used)


def errors(found: DirectMatch, source: BoneScan, target: BoneScan, of: Shape, kept: Bools | None = None) -> Floats:
    """How far from their places, in mm, those vertices of a source arrive on a target."""
    directions = source.directions if kept is None else source.directions[kept]
    at = cKDTree(found.source.points_in_file).query(of.verts)[1]
    return np.asarray(np.linalg.norm(found.target.points_in_file[at] - target.places(directions), axis=1))


def test_specimens_get_a_finer_fit_that_keeps_the_verdict() -> None:
    found = match_either_side(RIGHT.shape, LEFT.shape, FAST)
    finer = refine_match(RIGHT.shape, LEFT.shape, found, FitConfig())
    assert len(finer.target.vectors) == len(finer.source.vectors) == 500 != len(found.target.vectors)
    assert finer.target.frame.mirrored and finer.source.template_hash == finer.target.template_hash
    middle = (finer.source.points + finer.target.points) / 2
    turn = kabsch(finer.source.resting, middle)
    assert np.abs(turn.to_local(middle) - finer.source.resting).max() < 0.02  # of a template that lies half way
    worse, better = (errors(each, RIGHT, LEFT, RIGHT.shape).mean() for each in (found, finer))
    assert better < worse and better < 4
    assert (finer.verdict, finer.reasons) == (found.verdict, found.reasons)


def test_what_stands_otherwise_and_clouds_are_left_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    found = match_either_side(RIGHT.shape, RIGHT.shape, replace(FAST, n_second=2, n_third=1))
    cloud = Shape(RIGHT.shape.verts, np.empty((0, 3), np.int64))
    assert refine_match(cloud, RIGHT.shape, found, FitConfig()) is found
    for told in (replace(found, apart=(0.08, 0.07)), replace(found, apart=None)):
        monkeypatch.setattr(same_pose, "alignment_residuals", lambda *_: (0.07, 0.08))
        assert refine_match(RIGHT.shape, RIGHT.shape, told, FitConfig()) is told


def test_cracks_are_no_rim() -> None:
    whole = RIGHT.shape
    assert rim_lengths(whole).max() == 0
    cracked = Shape(whole.verts, np.delete(whole.faces, np.arange(0, whole.F, 40), 0))
    broken = cut(RIGHT, -0.1)[0]
    assert 0 < rim_lengths(cracked).max() < MIN_RIM_LENGTH < rim_lengths(broken).max()
    for shape, ends in ((cracked, False), (broken, True)):
        assert viscous_system(template_of(shape, "t", ViscousConfig(nodes=300))).rim.any() == ends


@pytest.mark.parametrize("source_is_broken", [True, False])
def test_a_broken_one_is_a_part_of_a_whole_one(source_is_broken: bool) -> None:
    broken, kept = cut(LEFT, -0.1)
    pair = (broken, RIGHT.shape) if source_is_broken else (RIGHT.shape, broken)
    plain = match_either_side(*pair, replace(FAST, n_second=2, n_third=1))
    seen = refine_match(*pair, plain, FitConfig())
    of_broken, of_whole = (seen.source, seen.target) if source_is_broken else (seen.target, seen.source)
    assert of_broken.partial and not of_whole.partial and seen.verdict != "good"
    assert of_broken.frame.mirrored and not of_whole.frame.mirrored
    assert of_whole.template_hash == of_broken.template_hash and not of_whole.vectors.any()
    swapped = replace(seen, source=of_broken, target=of_whole)
    assert errors(swapped, LEFT, RIGHT, broken, kept).mean() < 4


def test_a_part_in_another_unit_is_not_taken_for_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a femur in metres was stretched over a whole one in millimetres, and called good."""
    monkeypatch.setattr(same_pose, "fit_same_pose", lambda *_: None)
    broken, whole = cut(RIGHT, -0.1)[0], LEFT.shape
    found = match_either_side(whole, whole, replace(FAST, n_second=2, n_third=1))
    good = replace(found, source=replace(found.source, verdict="good"), target=replace(found.target, verdict="good"))
    small = Shape(broken.verts / 1000, broken.faces, "small")
    for pair in ((small, whole), (whole, small)):
        doubted = refine_match(*pair, good, FitConfig())
        assert doubted.verdict == "fair" and "use one unit" in str(doubted.reasons[0])
    for pair in ((broken, whole), (small, broken)):  # of one unit; and of two shapes that are both cut
        assert refine_match(*pair, good, FitConfig()).verdict == "good"


@pytest.mark.parametrize(("limit", "verdict"), [(0.0, "poor"), (1.0, "fair")])
def test_a_part_that_had_to_be_crushed_is_poor(monkeypatch: pytest.MonkeyPatch, limit: float, verdict: Verdict) -> None:
    """The head of a teddy that lies on the belly of another has a stretch of 1.4, right parts up to 0.8."""
    monkeypatch.setattr(without_model, "_FOLDING_STRETCH", limit)
    broken, size, config = cut(RIGHT, -0.1)[0], float(np.sqrt(RIGHT.shape.area)), same_pose.ViscousConfig()
    template = template_of(RIGHT.shape, "whole", config)
    guess = fit_without_model(template_of(broken, "own", config), broken, config, mirror=False)
    found = fit_same_pose(template, broken, (guess.points, guess), config, mirror=False, whole=size, turned=False)
    assert found is not None and found[0].partial and found[0].verdict == verdict


def test_two_broken_ones_share_what_both_have() -> None:
    (low, kept), (upper, _) = cut(LEFT, 0.4), cut(RIGHT, -0.5, -1.0)
    plain = match_either_side(low, upper, replace(FAST, n_second=2, n_third=1))
    seen = refine_match(low, upper, plain, FitConfig())
    shared = LEFT.directions[kept][:, 2] > -0.4
    assert errors(seen, LEFT, RIGHT, low, kept)[shared].mean() < 5


def test_a_model_that_learned_no_correspondence_gets_finer_points() -> None:
    known = egg_model()
    model = TrainedModel(replace(known.card, correspondence=False), known.template, known.inference)
    system, vectors = node_system(model), gentle_vectors(model)
    points = system.moved(vectors)
    bump = 0.08 * np.exp(-np.square(points - points[points[:, 0].argmax()]).sum(1) / 0.02)
    shape = Shape(points + bump[:, None] * system.normals(points), model.template.shape.faces)
    fit = replace(Fitter(model).fit(shape), points=points, vectors=vectors, verdict="fair", frame=Frame.identity())
    found = refine_fit(model, shape, fit, FitConfig(mirror="no"))
    off, better = (np.linalg.norm(each.points_in_file - shape.verts, axis=1).mean() for each in (fit, found))
    assert better < 0.6 * off
    assert found.template_hash == fit.template_hash and is_refined(model, found) and not is_refined(model, fit)
    assert np.linalg.norm(system.moved(found.vectors) - found.points, axis=1).mean() < 0.02
    assert found.signs is not None and found.signs.stretch < 0.3
    poor = replace(fit, verdict="poor")
    assert refine_fit(model, shape, poor, FitConfig(mirror="no")).verdict == found.verdict == "fair"  # judged anew
    for one, other in ((known, fit), (model, replace(fit, partial=True))):
        assert refine_fit(one, shape, other, FitConfig()) is other
    assert refine_fit(model, Shape(shape.verts, np.empty((0, 3), np.int64)), fit, FitConfig()) is fit


@pytest.mark.parametrize("mirrored", [True, False])
@pytest.mark.parametrize(("verdict", "over"), [("good", 0.0), ("good", 0.01), ("good", 0.001), ("poor", 0.0)])
def test_what_stands_otherwise_than_the_template_is_searched_once(
    mirrored: bool, verdict: Verdict, over: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    known, guesses = egg_model(), list[KnownPairs]()
    model = TrainedModel(replace(known.card, correspondence=False), known.template, known.inference)
    rested, faces = node_system(model).verts, model.template.shape.faces
    plain = Fitter(model).fit(Shape(rested, faces))
    places = rested * [1, 3, 1]
    frame = MIRROR if mirrored else Frame.identity()
    shape = Shape(frame.undo(places), faces[:, :: -1 if mirrored else 1], "tall")

    def directly(
        template: Shape, image: Shape, config: DirectConfig, progress: ProgressCallback, guess: KnownPairs
    ) -> DirectMatch:
        progress("searching", template.name, 0.5)
        assert config.from_source and np.allclose(image.verts, places)  # of the side that the model found
        guesses.append(guess)
        order = np.random.default_rng(0).permutation(len(rested))
        first = replace(plain, points=rested[order], frame=Frame.identity())
        second = replace(first, points=places[order], verdict=verdict, reasons=(Reason("ambiguous", "two ways"),))
        return DirectMatch(first, second, (("guess", 0.02),), system, guess_lead=over)

    def moved(template: object, shape: Shape, start: Fit, config: object) -> tuple[Fit, bool]:
        return replace(start, points=start.points + 1, residual=0.01), True  # what is judged, and no more

    monkeypatch.setattr(same_pose, "match_directly", directly)
    monkeypatch.setattr(same_pose, "fit_other_pose", moved)
    system = node_system(model)
    vectors = system.vectors_to(places + np.array([0.0, 0.0, 0.04]))
    fit = replace(plain, points=system.moved(vectors), vectors=vectors, verdict="good", frame=frame)
    told = list[str]()

    def report(stage: str, name: str, share: float) -> None:
        told.append(name)

    found = refine_fit(model, shape, fit, FitConfig(mirror="no"), report)
    assert told == [shape.name] and len(guesses) == 1
    assert np.allclose(guesses[0][1], fit.points)
    taken = verdict == "good" and over != 0.001
    assert np.allclose(found.points, places if taken else fit.points)
    assert is_refined(model, found) == taken and (found.vectors is fit.vectors) == (not taken)
    assert any(reason.code == "ambiguous" for reason in found.reasons) == (over == 0.01)
    assert found.residual == 0.01


def test_what_stands_otherwise_is_only_turned_where_a_search_finds_nothing_better(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = egg_model()
    model = TrainedModel(replace(known.card, correspondence=False), known.template, known.inference)
    system = node_system(model)
    shape = Shape(system.verts * [1, 3, 1], model.template.shape.faces)
    crumpled = system.verts @ np.diag([1.0, -1.0, 1.0]) * [3, 1, 1]
    fit = replace(Fitter(model).fit(shape), points=crumpled, verdict="fair", frame=Frame.identity())
    monkeypatch.setattr(same_pose, "_search_again", lambda template, part, start, progress: start)
    found = refine_fit(model, shape, fit, FitConfig(mirror="no"))
    assert cKDTree(found.points_in_file).query(shape.verts)[0].mean() < 0.1
    assert not np.allclose(found.points, fit.points)


@pytest.mark.parametrize(("turned", "sided"), [(True, True), (True, False), (False, True)])
def test_the_side_is_that_for_which_the_template_stretches_less(turned: bool, sided: bool) -> None:
    config = same_pose.ViscousConfig()
    template = template_of(RIGHT.shape, "right", config)
    wrong = fit_without_model(template, LEFT.shape, config, mirror=False)
    found = fit_same_pose_near(template, LEFT.shape, wrong, config, turned, mirror=True, sided=sided)
    assert found is not None and not wrong.frame.mirrored
    assert found.frame.mirrored == turned and (found.side > 0) == turned


def test_what_is_cut_is_a_part_of_what_a_model_knows() -> None:
    known = egg_model()
    model = TrainedModel(replace(known.card, correspondence=False), known.template, known.inference)
    whole = Shape(30 * node_system(model).moved(gentle_vectors(model, 0.01)), model.template.shape.faces)
    size = float(np.sqrt(whole.area))
    kept = whole.verts[:, 1] < np.quantile(whole.verts[:, 1], 0.6)
    half = Shape(whole.verts, whole.faces[kept[whole.faces].all(1)])
    used = np.unique(half.faces)
    half = Shape(half.verts[used], np.searchsorted(used, half.faces))
    fit = fit_as_part(model, half, size, FitConfig(mirror="no"))
    assert fit is not None and fit.partial
    assert (fit.model, fit.template_hash, fit.vectors.shape) == ("egg", model.template.hash, (model.template.K, 3))
    off = np.linalg.norm(fit.points_in_file[used] - half.verts, axis=1).mean()
    assert off < 0.1 * size
    assert cKDTree(fit.points_in_file).query(half.verts)[0].mean() < 0.01 * size
    assert fit_as_part(model, whole, size, FitConfig(mirror="no")) is None


@pytest.mark.parametrize("correspondence", [True, False])
def test_fits_and_maps_ask_for_finer_ones(correspondence: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    known = egg_model()
    model = TrainedModel(replace(known.card, correspondence=correspondence), known.template, known.inference)
    shape, asked = bent_egg(model), list[object]()

    def asked_for(_: TrainedModel, part: Shape, fit: Fit, config: FitConfig, *more: object) -> Fit:
        asked.append(more[-1])
        return replace(fit, points=fit.points + 0.01)

    monkeypatch.setattr(same_pose, "refine_fit", asked_for)
    matcher = Matcher(model)
    fit = matcher.fit(shape)
    agreed = matcher.match(shape, shape).target_fit
    assert np.allclose(agreed.points, fit.points) == (not correspondence)  # a finer fit is not lost by agreement
    matcher.follow(shape, fit)
    assert asked == ([] if correspondence else [True, True, True, False])
