"""Fit a template to a shape of its kind without a network; the shape may have any pose and orientation, or be mirrored.

Surfaces are brought together by least squares alone (`meshmatch.fitting.solve.viscous`), which finds what is nearby. That
suffices for a shape in the template's pose ("alike"), after rotation. For other poses the template is first registered to
the shape as two arbitrary shapes are (`meshmatch.fitting.direct`), and least squares start from there.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.fitting.direct import MIRROR, match_directly
from meshmatch.fitting.fit import Fit, judged_fit
from meshmatch.fitting.fit_config import Schedule
from meshmatch.fitting.fitter import cap_verdict
from meshmatch.fitting.judge.direct import DirectFeatures
from meshmatch.fitting.judge.features import compute_features
from meshmatch.fitting.judge.reasons import Reason
from meshmatch.fitting.judge.verdict import Judgement, judge
from meshmatch.fitting.kind_templates import viscous_system, with_final_nodes
from meshmatch.fitting.one_way import DirectConfig
from meshmatch.fitting.search.predictor import part_residual
from meshmatch.fitting.search.task import take_samples
from meshmatch.fitting.solve.driver import Problem, minimise
from meshmatch.fitting.solve.priors import RotatedReference
from meshmatch.fitting.solve.terms import LandmarkTerm
from meshmatch.fitting.solve.viscous import ViscousConfig, viscous_vectors
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.registry import NO_MODEL
from meshmatch.shapes.alignment import Align, align, align_part, sqrt_area_frame
from meshmatch.shapes.rims import RimPoints, is_sheet
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.mirror_images import mirrored
from meshmatch.templates.template import Template
from meshmatch.threads import parallel_calls, parallel_map

_ALIGN_SAMPLES = 2400  # samples for rigid alignment
# A search need only find roughly where the template belongs.
_SEARCH_CONFIG = DirectConfig(
    coarse=1200, fine=2400, samples=3000, second_samples=1200, first_samples=700, n_second=8, n_third=3, both_ways="no"
)
_DEFORM_SCHEDULE = Schedule(steps=6, prior=(1e-2, 1e-3), scale=(1.0, 1.0), damping=1e-6)
# All below are set by hand, on femurs, hearts, ants, four-legged animals and others. Energies are those of `_Fitted.energy`.
# Largest residual (units of sqrt(area)) and stretch of a shape that has the template's pose. Stretches are 0.6 for hearts,
# and 0.8 and more for ants in other poses.
_MAX_ALIKE_RESIDUAL, _MAX_ALIKE_STRETCH = 0.045, 0.7
# A fit replaces the current best one only if its energy is below this multiple of the best one's. First for fits from a
# search that is not trusted: 0.73 for an ant in another pose, 0.95 for one with exchanged legs. Second for fits in another
# orientation than the axes of the files suggest, or of the mirror image: 0.66 for mirrored femurs, 0.97 for ants, 0.88 for
# eggs in a wrong rotation.
_SEARCHED_RATIO, _TURNED_RATIO = 0.9, 0.85
_MIN_TURN = np.radians(40)  # two files with a smaller rotation between them may be meant to have the same axes
_PART_RATIO = 0.85  # the same for a fit as a part against one of the whole; 0.3 for a cut femur
# And against a whole that has the template's pose: 0.36 to 0.55 for cut femurs, 0.56 and more for leaves of another size.
_PART_RATIO_IF_ALIKE = 0.55
# Residual (units of sqrt(area)) of a sample beyond the end of a template that is cut as well.
_BEYOND_RIM_RESIDUAL = 0.02
_PART_TURNS = 2  # rotations to try for a part, and for its mirror image
# Share of the stretch below which the mirror image is meant: 0.48 to 0.83 for molars, 0.99 for birds.
_MIRROR_STRETCH_RATIO = 0.86
_NEW_TURN_RATIO = 0.95  # share of the energy for a rotation other than the model's: 0.5 to 0.9 for leaves
_QUICK_SAMPLES, _QUICK_STEPS = 4000, 12  # samples and steps for choosing among poses
# For a whole, at most this many rotations are fitted, with residuals after alignment up to this multiple of the best one's.
# The two ends of a leaf are distinguished by the fits alone (1.0 to 1.2); other rotations have 2 and more for femurs, 1.3
# for knees.
_MAX_TURNS, _TURN_TOLERANCE = 4, 1.35
_RIM_STEP = 0.01  # spacing of the points on a rim
_MIN_TRUST = 0.5  # a search with less trust is not believed
_MIN_STRETCH = 0.01  # smaller stretches are raised to this
_STRETCH_WEIGHT = 0.03  # weight of the stretch in an energy, relative to the residual
# Stretch above which a fit folds. Busts have 1.2 to 1.9, and 11 to 24 % of their vertices were folded, but only 1 to 8 % of
# those of a stiffer fit with the same errors. All other kinds have up to 0.8.
_FOLDING_STRETCH = 1.0


def has_template_pose(residual: float, stretch: float) -> bool:
    """Return whether a shape has the template's pose, given the residual and stretch of its fit."""
    return residual < _MAX_ALIKE_RESIDUAL and stretch < _MAX_ALIKE_STRETCH


@dataclass(frozen=True, eq=False)
class _Start:
    """Starting point of least squares; ``trust`` and ``doubts`` are those of the search that found it, if any."""

    frame: Frame
    vectors: Float[Floats, "K 3"]
    trust: float = 1.0
    doubts: tuple[Reason, ...] = ()


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Result of least squares, with the samples of the shape in the core frame."""

    initial: _Start
    samples: OrientedPoints
    vectors: Float[Floats, "K 3"]
    features: DirectFeatures

    @property
    def energy(self) -> float:
        """Low for right fits; weighs stretch less than `DirectFeatures.energy`, as a kind varies in proportions."""
        return self.features.residual + _STRETCH_WEIGHT * self.features.stretch

    @property
    def alike(self) -> bool:
        """Whether the shape has the template's pose."""
        return has_template_pose(self.features.residual, self.features.stretch)


class _Task:
    """A template and the shape to which it is fitted."""

    def __init__(self, template: Template, shape: Shape, config: ViscousConfig, size: float | None = None) -> None:
        """``size``, for a part, is the sqrt(area) of its whole: the unit of its core frame, in that of its file."""
        self.template, self.shape, self.config, self.partial = template, shape, config, size is not None
        self.system = viscous_system(template)
        whole = None if size is None else replace(sqrt_area_frame(shape), scale=size)
        rng = np.random.default_rng(config.seed + 1)
        self._own, self._samples = take_samples(shape, config.samples, rng, whole)
        sheets = not self.partial and self.system.is_sheet and is_sheet(shape)
        self._rim = RimPoints.of(shape, _RIM_STEP) if sheets else None
        self._resting = sample_surface(template.shape, _ALIGN_SAMPLES, np.random.default_rng(config.seed))

    def fitted(self, initial: _Start) -> _Fitted:
        """Fit by least squares from a starting point."""
        points = initial.frame.apply(self._own.undo(self._samples.points))
        normals = self._samples.normals @ self._own.rotation @ initial.frame.rotation.T
        samples = replace(self._samples, points=points, normals=normals).facing(self.system.surface(initial.vectors))
        rim = None if self._rim is None else self._rim.in_frame(initial.frame)
        vectors = viscous_vectors(self.system, samples, self.config, initial.vectors, self.partial, rim)
        features = DirectFeatures.of(self.system, samples, vectors)
        if self.partial:
            features = replace(features, residual=part_residual(self.system, samples, vectors, _BEYOND_RIM_RESIDUAL))
        return _Fitted(initial, samples, vectors, features)

    def aligned_starts(
        self, side: Frame | None, how: Align = "rigid", keep: int = 1, most: float = np.inf, placed: bool = False
    ) -> list[_Start]:
        """Starts with the undeformed template, rigidly aligned to the shape, or to its mirror image if ``side`` is given.

        ``how`` is the kind of alignment; if ``placed``, that of a part to any place of the template is used. At most
        ``keep`` starts are returned, the best first, with residuals up to ``most`` times that of the best.
        """
        outer = self._own if side is None else self._own.compose(side)
        normals = self._samples.normals if side is None else self._samples.normals @ side.rotation.T
        points = self._samples.points if side is None else side.apply(self._samples.points)
        samples = replace(self._samples, points=points, normals=normals).first(_ALIGN_SAMPLES)
        found = align_part(samples, self._resting, keep) if placed else align(samples, self._resting, how, keep)
        frames = [outer.compose(each.pose.frame) for each in found if each.residual <= most * found[0].residual]
        return [_Start(frame, np.zeros((self.system.K, 3))) for frame in frames]

    def search(self, side: Frame | None) -> list[_Start]:
        """Starts from a search for other poses on the shape, or on its mirror image; none if the shape is not a surface."""
        image = self.shape if side is None else mirrored(self.shape)
        try:
            found = match_directly(self.template.shape, image, replace(_SEARCH_CONFIG, seed=self.config.seed))
        except InputError:
            return []
        at = np.asarray(cKDTree(self.system.verts).query(found.source.frame.undo(found.source.points))[1], np.int64)
        vectors = self.deformed_to(at, found.target.points)
        frame = found.target.frame if side is None else side.compose(found.target.frame)
        return [_Start(frame, vectors, found.target.trust, found.target.reasons)]

    def deformed_to(self, at: Int[Ints, " N"], points: Float[Floats, "N 3"]) -> Float[Floats, "K 3"]:
        """Node vectors that move some template vertices to points, as rigidly as possible."""
        prior = RotatedReference(np.tile(np.eye(3), (len(self.system.gradient_points), 1, 1)))
        problem = Problem(
            system=self.system, terms=[LandmarkTerm((at, points), 1 / len(at))], schedule=_DEFORM_SCHEDULE
        )
        return minimise(problem, prior, np.zeros((self.system.K, 3)))

    def start_near(self, frame: Frame) -> _Start:
        """Start with the undeformed template, aligned near the frame of a fit of another template."""
        samples = self._samples.first(_ALIGN_SAMPLES)
        points = frame.apply(self._own.undo(samples.points))
        normals = samples.normals @ self._own.rotation @ frame.rotation.T
        pose: RigidPose = align(replace(samples, points=points, normals=normals), self._resting, "near")[0].pose
        return _Start(frame.compose(pose.frame), np.zeros((self.system.K, 3)))

    def best(self, sides: Sequence[Frame | None]) -> tuple[_Fitted, float]:
        """The best fit of the shape or, if that is clearly better, of its mirror image; and its `Fit.side`."""
        found = [self.best_turn(side) for side in sides]
        if sides[0] is None:
            near_axes = self.aligned_starts(None, "near")[0]
            if np.trace(near_axes.frame.rotation) > 1 + 2 * np.cos(_MIN_TURN):
                found[0] = _clearly_better(found[0], self.fitted(near_axes), _TURNED_RATIO)
        if not any(each.alike for each in found):
            for number, side in enumerate(sides):
                for initial in self.search(side):
                    factor = 1.0 if initial.trust >= _MIN_TRUST else _SEARCHED_RATIO
                    found[number] = _clearly_better(self.fitted(initial), found[number], factor)
        if len(found) == 1:
            return found[0], 0.0
        plain, other = found
        best = _clearly_better(other, plain, _TURNED_RATIO)
        stretches = [max(each.features.stretch, _MIN_STRETCH) for each in (plain if best is other else other, best)]
        return best, float(np.log(stretches[0] / stretches[1]))

    def best_turn(self, side: Frame | None) -> _Fitted:
        """The best fit of the shape, or of its mirror image, from rigid starts.

        If the shape is far from the template's pose, stretch says little; another rotation must then be clearly better than
        the closest one.
        """
        closest, *others = parallel_map(self.fitted, self.aligned_starts(side, keep=_MAX_TURNS, most=_TURN_TOLERANCE))
        for other in others:
            closest = _clearly_better(other, closest, 1.0 if other.alike else _TURNED_RATIO)
        return closest

    def best_part(self, sides: Sequence[Frame | None]) -> _Fitted:
        """The best fit of a part, over both sides.

        It starts with both centroids together or, if that is clearly better, with the part anywhere on the template.
        """

        def best(placed: bool) -> _Fitted:
            starts = [start for side in sides for start in self.aligned_starts(side, keep=_PART_TURNS, placed=placed)]
            return min(parallel_map(self.fitted, starts), key=attrgetter("energy"))

        return _clearly_better(best(placed=True), best(placed=False), _TURNED_RATIO)

    def best_from(self, start: Fit) -> _Fitted:
        """The best fit starting from a fit of another template with the same vertices."""
        found = self.fitted(self.start_near(start.frame))
        if found.alike:
            return found
        ambiguous = tuple(reason for reason in start.reasons if reason.code == "ambiguous")
        vectors = self.deformed_to(np.arange(len(start.points)), start.points)
        moved = self.fitted(_Start(start.frame, vectors, start.trust, ambiguous))
        return _clearly_better(moved, found, _SEARCHED_RATIO)


def _clearly_better(one: _Fitted, other: _Fitted, factor: float) -> _Fitted:
    """Return ``one`` if its energy is below ``factor`` times that of ``other``, else ``other``."""
    return one if one.energy < factor * other.energy else other


def fit_without_model(
    template: Template,
    shape: Shape,
    config: ViscousConfig | None = None,
    start: Fit | None = None,
    mirror: bool = True,
    other_side: bool = False,
    whole: float | None = None,
) -> Fit:
    """Fit a template to a repaired mesh or cloud. The fit is at most fair, as no correspondence was learned.

    ``start`` is a fit of another template with the same vertices to this shape, from which this one starts. ``mirror``
    allows the shape to be the mirror image of the template; ``other_side`` fits the side that ``start`` is not. If
    ``whole`` is given, the sqrt(area) of a whole shape in the unit of the file, the shape may also be a part.
    """
    began, rough = time.monotonic(), config or ViscousConfig.choosing()
    config = config or ViscousConfig()
    task, stiff = _Task(template, shape, config), _Task(template, shape, rough)
    stiffest = stiff if rough is config else _Task(template, shape, ViscousConfig.folding())
    if start is None:
        found, log_ratio = stiff.best((None, MIRROR) if mirror else (None,))
        if rough is not config:
            found = (stiffest if found.features.stretch > _FOLDING_STRETCH else task).fitted(found.initial)
    elif other_side:
        found, log_ratio = task.best((None if start.frame.mirrored else MIRROR,))[0], -start.side
    else:
        found, log_ratio = task.best_from(start), start.side
        if found.features.stretch > _FOLDING_STRETCH:
            found = stiffest.best_from(start)
    as_whole = _Judged.of(task, found)
    if whole is None:
        return as_whole.fit(log_ratio, began)
    part_task = _Task(template, shape, config, whole)
    part = part_task.best_part((None, MIRROR) if mirror else (None,))
    clearly = 1.0 if as_whole.judgement.verdict == "poor" else _PART_RATIO
    return (_Judged.of(part_task, part) if part.energy < clearly * found.energy else as_whole).fit(log_ratio, began)


def fit_same_pose_near(
    template: Template,
    shape: Shape,
    start: Fit,
    config: ViscousConfig,
    turned: bool = False,
    mirror: bool = False,
    sided: bool = False,
) -> Fit | None:
    """Fit a template to a repaired shape in the template's pose.

    Parameters
    ----------
    start
        A fit of another template with the same vertices, from whose pose this one starts.
    turned, mirror
        Whether to try other rotations, and those of the mirror image.
    sided
        Whether shapes of the kind are known to have sides; the side for which the template stretches less is then chosen.

    Returns
    -------
    Fit
        None if the shape has another pose.
    """
    began, quick = time.monotonic(), _Task(template, shape, _quick(config.seed))
    own_side = MIRROR if start.frame.mirrored else None
    best, log_ratio = quick.fitted(quick.start_near(start.frame)), 0.0
    if turned:
        best = _clearly_better(quick.best_turn(own_side), best, _NEW_TURN_RATIO)
    if turned and mirror:
        other = quick.best_turn(None if own_side is MIRROR else MIRROR)
        log_ratio = float(np.log(max(other.features.stretch, _MIN_STRETCH) / max(best.features.stretch, _MIN_STRETCH)))
        certain = sided and best.alike and other.alike
        if log_ratio < 0 if certain else _clearly_better(other, best, _TURNED_RATIO) is other:
            best, log_ratio = other, -log_ratio
    task = _Task(with_final_nodes(template, config) if best.alike else template, shape, config)
    found = task.fitted(replace(best.initial, vectors=np.zeros((task.system.K, 3))))
    return _Judged.of(task, found).fit(log_ratio, began) if found.alike else None


def fit_other_pose(template: Template, shape: Shape, start: Fit, config: ViscousConfig) -> tuple[Fit, bool]:
    """Fit a template to a repaired shape that has another pose.

    Parameters
    ----------
    start
        Positions of another template with the same vertices on the shape, which may be wrong.

    Returns
    -------
    Fit
        From there; or from the undeformed template, rigidly aligned, if that has less energy.
    bool
        Whether it is the former.
    """
    began, quick = time.monotonic(), _Task(template, shape, _quick(config.seed))
    ambiguous = tuple(reason for reason in start.reasons if reason.code == "ambiguous")
    vectors = quick.deformed_to(np.arange(len(start.points)), start.points)
    moved = quick.fitted(_Start(start.frame, vectors, start.trust, ambiguous))
    turned = quick.best_turn(MIRROR if start.frame.mirrored else None)
    best = _clearly_better(moved, turned, 1.0 if start.trust >= _MIN_TRUST else _SEARCHED_RATIO)
    if best.features.stretch > _FOLDING_STRETCH:
        config = replace(ViscousConfig.choosing(), seed=config.seed)
    task = _Task(template, shape, config)
    return _Judged.of(task, task.fitted(best.initial)).fit(0.0, began), best is moved


def fit_same_pose(
    template: Template,
    shape: Shape,
    search_result: tuple[Float[Floats, "N 3"], Fit],
    config: ViscousConfig | None = None,
    mirror: bool = True,
    whole: float | None = None,
    turned: bool = True,
) -> tuple[Fit, bool] | None:
    """Fit a template to a repaired shape that was matched to it, if the shape has the template's pose or is a part of it.

    Parameters
    ----------
    search_result
        Positions (N, 3) on the rest template, and a fit whose points (N, 3) are their counterparts according to a search.
    mirror, whole
        As for `fit_without_model`.
    turned
        Whether to try rigid starts as well, in all rotations.

    Returns
    -------
    Fit
        With more nodes and samples than the search.
    bool
        Whether it started from the search's result; otherwise a rigid start was clearly better.

    None if the shape has another pose than the template.
    """
    began, config = time.monotonic(), config or ViscousConfig()
    quick, sides = _quick(config.seed), (None, MIRROR) if mirror else (None,)
    task, (resting, start) = _Task(template, shape, quick), search_result
    at = np.asarray(cKDTree(task.system.verts).query(resting)[1], np.int64)
    search_call = partial(task.fitted, _Start(start.frame, task.deformed_to(at, start.points)))
    turn_calls = [partial(task.best_turn, side) for side in sides] if turned else []
    first, *turn_fits = parallel_calls((search_call, *turn_calls))
    best = first
    for turn in turn_fits:
        other = turn.initial.frame.mirrored != best.initial.frame.mirrored
        relaxed = (
            whole is None
            and other
            and turn.alike
            and turn.features.stretch < _MIRROR_STRETCH_RATIO * best.features.stretch
        )
        best = turn if relaxed else _clearly_better(turn, best, _TURNED_RATIO)
    if whole is not None:
        part = _Task(template, shape, quick, whole).best_part(sides)
        poor = _Judged.of(task, best).judgement.verdict == "poor"
        if part.energy < (1.0 if poor else _PART_RATIO_IF_ALIKE if best.alike else _PART_RATIO) * best.energy:
            task = _Task(template, shape, config, whole)
            judged = _Judged.of(task, task.fitted(part.initial))
            fit = judged.fit(0.0, began)
            crushed = judged.judgement.features.stretch > _FOLDING_STRETCH  # a part in the same pose need not stretch
            return replace(fit, verdict="poor") if crushed else fit, False
    if not best.alike:
        return None
    task = _Task(template, shape, config)
    return _Judged.of(task, task.fitted(best.initial)).fit(0.0, began), best is first


@dataclass(frozen=True, eq=False)
class RigidAlignment:
    """A shape relative to a rigidly aligned template.

    ``frame`` goes from the shape's file to the template, ``stretch`` is the template's, and ``alike`` says whether the
    shape has the template's pose.
    """

    frame: Frame
    stretch: float
    alike: bool


def align_by_fits(template: Template, shape: Shape, seed: int) -> RigidAlignment:
    """Align a template to a repaired shape by fits from the best few rotations."""
    best = _Task(template, shape, _quick(seed)).best_turn(None)
    return RigidAlignment(best.initial.frame, max(best.features.stretch, _MIN_STRETCH), best.alike)


def fit_from(template: Template, shape: Shape, start: Fit, config: ViscousConfig) -> Fit | None:
    """Fit a template from the pose of another one's fit with the same vertices; None if the shape has another pose."""
    began, task = time.monotonic(), _Task(template, shape, config)
    found = task.fitted(task.start_near(start.frame))
    return _Judged.of(task, found).fit(0.0, began) if found.alike else None


def fit_rotated(template: Template, shape: Shape, turn: Float[Floats, "3 3"], config: ViscousConfig) -> Fit:
    """Fit a template to a repaired shape in the same pose, given the rotation from the shape's file to the template."""
    began, task = time.monotonic(), _Task(template, shape, config)
    initial = task.start_near(replace(sqrt_area_frame(shape), rotation=turn))
    return _Judged.of(task, task.fitted(initial)).fit(0.0, began)


def _quick(seed: int) -> ViscousConfig:
    """Settings for choosing among poses in less time."""
    stiff = ViscousConfig.choosing()
    schedule = replace(stiff.schedule, steps=_QUICK_STEPS)
    return replace(stiff, samples=_QUICK_SAMPLES, back_points=_QUICK_SAMPLES, schedule=schedule, seed=seed)


@dataclass(frozen=True, eq=False)
class _Judged:
    """Result of least squares with its judgement."""

    task: _Task
    found: _Fitted
    judgement: Judgement

    @classmethod
    def of(cls, task: _Task, found: _Fitted) -> _Judged:
        features = compute_features(
            task.system,
            found.vectors,
            found.samples,
            found.features.residual,
            task.template.labels,
            partial=task.partial,
        )
        return cls(task, found, judge(features))

    def fit(self, log_ratio: float, began: float) -> Fit:
        """Convert to a `Fit`, which is at most fair; ``log_ratio`` is its `Fit.side`."""
        task, found = self.task, self.found
        frame = found.initial.frame
        unsure = Reason("unsupervised", "fitted without a trained model: surfaces that lie close need not correspond")
        fit = judged_fit(
            self.judgement,
            task.system,
            frame,
            found.vectors,
            upright=False,
            template_hash=task.template.hash,
            residual=found.features.residual,
            verts=task.shape.verts,
            seconds=time.monotonic() - began,
            seed=task.config.seed,
            model=NO_MODEL,
            notes=("taken for the mirror image of the template",) if frame.mirrored else (),
            side=log_ratio,
            partial=task.partial,
        )
        # Keep the uncapped trust: a collection compares it with that of other fits.
        trust = min(fit.trust, found.initial.trust)
        doubts = (reason for reason in found.initial.doubts if reason.code == "ambiguous")
        fit = replace(cap_verdict(fit, [*doubts, unsure]), trust=trust)
        if found.initial.trust >= _MIN_TRUST:
            return fit
        no_pose = Reason("doubt", "no pose of the template is clearly right for this shape")
        return replace(fit, verdict="poor", reasons=(no_pose, *fit.reasons))
