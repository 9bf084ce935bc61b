"""A template fitted without a network, to a shape of its kind: in any pose and orientation, or mirrored.

Surfaces are brought together by least squares alone (`meshmatch.fitting.solve.viscous`), which finds what lies near. A
shape that stands as the template does, once it is turned, needs no more. For others the template is first registered to
the shape as two shapes of no kind are (`meshmatch.fitting.direct`), and begins there.
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
from meshmatch.fitting.kind_templates import finest, viscous_system
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
from meshmatch.shapes.normalise import Align, align, sqrt_area_frame
from meshmatch.shapes.rims import RimPoints, is_sheet
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.sides import mirrored
from meshmatch.templates.template import Template
from meshmatch.threads import parallel_calls, parallel_map

_ALIGNED_BY = 2400  # samples
# Where the template roughly belongs is all that is asked of a search.
_ROUGHLY = DirectConfig(coarse=1200, fine=2400, samples=3000, few=1200, fewer=700, better=8, best=3, both_ways="no")
_ONTO = Schedule(steps=6, prior=(1e-2, 1e-3), scale=(1.0, 1.0), damping=1e-6)
# Set by hand, on femurs, hearts, ants and four-legged animals: a shape to which the template comes so near, and stretches so
# little (0.6 for hearts, 0.8 and more for ants in other poses), stands as the template does;
_NEAR, _STRETCH = 0.045, 0.7
# a pose that was searched, and is not believed, must have so much less than the shape as it is: 0.73 of it for an ant in
# another pose, 0.95 for one whose legs were exchanged; and so must one that stands otherwise than the axes of the files
# say, or is mirrored: 0.66 of mirrored femurs, 0.97 of ants, 0.88 of eggs that were turned wrongly.
_SEARCHED, _TURNED = 0.9, 0.85
_AS_IT_STANDS = np.radians(40)  # a smaller turn is none: the axes of two files may be meant to be the same
_PART = 0.85  # so much of a whole's energy a part must have; 0.3 of a cut femur
# Of a whole that stands as the template does: 0.36 to 0.55 of cut femurs, 0.56 and more of leaves of another size.
_PART_OF_ALIKE = 0.55
# As how far it counts, in units of sqrt(area), that a template, which is cut too, ends before the part.
_BEYOND = 0.02
_TURNS = 2  # of a part, and of its mirror image, that are tried
_OTHER_SIDE = 0.86  # so much of the stretch a mirror image may need, to be meant: 0.48 to 0.83 of molars, 0.99 of birds
_ANEW = 0.95  # so much of the energy another turn than a model's may have: 0.5 to 0.9 of leaves
_FEW, _FEW_STEPS = 4000, 12  # samples and steps by which poses are chosen in less time
# Of a whole: up to so many turns are fitted, whose samples stay up to so many times as far apart as those of the best one.
# Ends of leaves are told by their fits alone (1.0 to 1.2); of femurs all others are 2 and more, of knees 1.3.
_ALIKE_TURNS, _NEARLY = 4, 1.35
_RIM_STEP = 0.01  # between points of a rim
_LOST = 0.5  # trust of a search whose result is not believed
_NOTHING = 0.01  # a smaller stretch is none
_STRETCHED = 0.03  # weight of the stretch in an energy, beside the residual
# Stretch beyond which a fit folds: of busts 1.2 to 1.9, of which 11 to 24 % of the vertices were folded, and 1 to 8 % of a
# stiffer fit with the same errors; of all other kinds up to 0.8.
_FAR = 1.0


def stand_alike(residual: float, stretch: float) -> bool:
    """Whether a shape stands as the template does, by how its fit went."""
    return residual < _NEAR and stretch < _STRETCH


@dataclass(frozen=True, eq=False)
class _Begin:
    """From where least squares begin: the core frame, and node vectors there; ``trust`` and ``doubts`` of the search that
    found it, if there was one.
    """

    frame: Frame
    vectors: Float[Floats, "K 3"]
    trust: float = 1.0
    doubts: tuple[Reason, ...] = ()


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Where least squares ended, and the samples of the shape in the core frame."""

    begin: _Begin
    samples: OrientedPoints
    vectors: Float[Floats, "K 3"]
    features: DirectFeatures

    @property
    def energy(self) -> float:
        """Low for right fits, as `DirectFeatures.energy`: specimens of one kind differ in proportions more than in pose."""
        return self.features.residual + _STRETCHED * self.features.stretch

    @property
    def alike(self) -> bool:
        """Whether the shape stands as the template does."""
        return stand_alike(self.features.residual, self.features.stretch)


class _Task:
    """One shape, and the template that is fitted to it."""

    def __init__(self, template: Template, shape: Shape, config: ViscousConfig, size: float | None = None) -> None:
        """``size`` is that of the whole of which the shape is a part: the unit of its core frame, in that of its file."""
        self.template, self.shape, self.config, self.partial = template, shape, config, size is not None
        self.system = viscous_system(template)
        whole = None if size is None else replace(sqrt_area_frame(shape), scale=size)
        rng = np.random.default_rng(config.seed + 1)
        self._own, self._samples = take_samples(shape, config.samples, rng, whole)
        sheets = not self.partial and self.system.is_sheet and is_sheet(shape)
        self._rim = RimPoints.of(shape, _RIM_STEP) if sheets else None
        self._resting = sample_surface(template.shape, _ALIGNED_BY, np.random.default_rng(config.seed))

    def fitted(self, begin: _Begin) -> _Fitted:
        points = begin.frame.apply(self._own.undo(self._samples.points))
        normals = self._samples.normals @ self._own.rotation @ begin.frame.rotation.T
        samples = replace(self._samples, points=points, normals=normals).facing(self.system.surface(begin.vectors))
        rim = None if self._rim is None else self._rim.in_frame(begin.frame)
        vectors = viscous_vectors(self.system, samples, self.config, begin.vectors, self.partial, rim)
        features = DirectFeatures.of(self.system, samples, vectors)
        if self.partial:
            features = replace(features, residual=part_residual(self.system, samples, vectors, _BEYOND))
        return _Fitted(begin, samples, vectors, features)

    def turns(self, side: Frame | None, how: Align = "rigid", keep: int = 1, most: float = np.inf) -> list[_Begin]:
        """The template as it rests, on the shape, or on its mirror image, turned in some ways, or near its file's axes: the
        best way first, and others that lie up to ``most`` times as far off.
        """
        outer = self._own if side is None else self._own.compose(side)
        normals = self._samples.normals if side is None else self._samples.normals @ side.rotation.T
        points = self._samples.points if side is None else side.apply(self._samples.points)
        samples = replace(self._samples, points=points, normals=normals).first(_ALIGNED_BY)
        found = align(samples, self._resting, how, keep)
        frames = [outer.compose(each.pose.frame) for each in found if each.residual <= most * found[0].residual]
        return [_Begin(frame, np.zeros((self.system.K, 3))) for frame in frames]

    def searched(self, side: Frame | None) -> list[_Begin]:
        """Where the template belongs on the shape, or on its mirror image, in another pose; none of what is no surface."""
        image = self.shape if side is None else mirrored(self.shape)
        try:
            found = match_directly(self.template.shape, image, replace(_ROUGHLY, seed=self.config.seed))
        except InputError:
            return []
        at = np.asarray(cKDTree(self.system.verts).query(found.source.frame.undo(found.source.points))[1], np.int64)
        vectors = self.onto(at, found.target.points)
        frame = found.target.frame if side is None else side.compose(found.target.frame)
        return [_Begin(frame, vectors, found.target.trust, found.target.reasons)]

    def onto(self, at: Int[Ints, " N"], points: Float[Floats, "N 3"]) -> Float[Floats, "K 3"]:
        """Node vectors that take some vertices of the template to points, as rigidly as possible."""
        prior = RotatedReference(np.tile(np.eye(3), (len(self.system.gradient_points), 1, 1)))
        problem = Problem(system=self.system, terms=[LandmarkTerm((at, points), 1 / len(at))], schedule=_ONTO)
        return minimise(problem, prior, np.zeros((self.system.K, 3)))

    def near(self, frame: Frame) -> _Begin:
        """The template as it rests, near to where another template of the same vertices had its shape, in its frame."""
        samples = self._samples.first(_ALIGNED_BY)
        points = frame.apply(self._own.undo(samples.points))
        normals = samples.normals @ self._own.rotation @ frame.rotation.T
        pose: RigidPose = align(replace(samples, points=points, normals=normals), self._resting, "near")[0].pose
        return _Begin(frame.compose(pose.frame), np.zeros((self.system.K, 3)))

    def best(self, sides: Sequence[Frame | None]) -> tuple[_Fitted, float]:
        """The best fit of the shape; or of its mirror image, if that fits clearly better. And its `Fit.side`."""
        found = [self.best_turn(side) for side in sides]
        if sides[0] is None:
            near = self.turns(None, "near")[0]
            if np.trace(near.frame.rotation) > 1 + 2 * np.cos(_AS_IT_STANDS):
                found[0] = _clearly_better(found[0], self.fitted(near), _TURNED)
        if not any(each.alike for each in found):
            for number, side in enumerate(sides):
                for begin in self.searched(side):
                    factor = 1.0 if begin.trust >= _LOST else _SEARCHED
                    found[number] = _clearly_better(self.fitted(begin), found[number], factor)
        if len(found) == 1:
            return found[0], 0.0
        plain, other = found
        best = _clearly_better(other, plain, _TURNED)
        stretches = [max(each.features.stretch, _NOTHING) for each in (plain if best is other else other, best)]
        return best, float(np.log(stretches[0] / stretches[1]))

    def best_turn(self, side: Frame | None) -> _Fitted:
        """The best fit of the shape, or of its mirror image, where the template is only turned. Far from its own form its
        stretch says little: the turn that lies closest is then as good a guess as any.
        """
        closest, *others = parallel_map(self.fitted, self.turns(side, keep=_ALIKE_TURNS, most=_NEARLY))
        for other in others:
            closest = _clearly_better(other, closest, 1.0 if other.alike else _TURNED)
        return closest

    def best_part(self, sides: Sequence[Frame | None]) -> _Fitted:
        """The best fit of a part, of either side."""
        begins = [begin for side in sides for begin in self.turns(side, keep=_TURNS)]
        return min(parallel_map(self.fitted, begins), key=attrgetter("energy"))

    def best_from(self, start: Fit) -> _Fitted:
        """The best fit from where another template of the same vertices was fitted."""
        found = self.fitted(self.near(start.frame))
        if found.alike:
            return found
        ambiguous = tuple(reason for reason in start.reasons if reason.code == "ambiguous")
        vectors = self.onto(np.arange(len(start.points)), start.points)
        moved = self.fitted(_Begin(start.frame, vectors, start.trust, ambiguous))
        return _clearly_better(moved, found, _SEARCHED)


def _clearly_better(one: _Fitted, other: _Fitted, factor: float) -> _Fitted:
    """One fit if it has so much less energy than the other; else the other."""
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
    """Fit a template to a repaired shape; a mesh, or a cloud. Such a fit is fair at best, for nothing was learned of what
    corresponds.

    ``start`` is a fit of another template of the same vertices to this shape, from which this one begins. With ``mirror``
    the shape may be the mirror image of what the template shows; with ``other_side`` it is the one that ``start`` is not.
    Where ``whole`` is given, the sqrt(area) of a whole shape in the unit of the file, it may also be cut.
    """
    began, rough = time.monotonic(), config or ViscousConfig.choosing()
    config = config or ViscousConfig()
    task, stiff = _Task(template, shape, config), _Task(template, shape, rough)
    stiffest = stiff if rough is config else _Task(template, shape, ViscousConfig.folding())
    if start is None:
        found, lead = stiff.best((None, MIRROR) if mirror else (None,))
        if rough is not config:
            found = (stiffest if found.features.stretch > _FAR else task).fitted(found.begin)
    elif other_side:
        found, lead = task.best((None if start.frame.mirrored else MIRROR,))[0], -start.side
    else:
        found, lead = task.best_from(start), start.side
        if found.features.stretch > _FAR:
            found = stiffest.best_from(start)
    as_whole = _Judged.of(task, found)
    if whole is None:
        return as_whole.fit(lead, began)
    part_task = _Task(template, shape, config, whole)
    part = part_task.best_part((None, MIRROR) if mirror else (None,))
    clearly = 1.0 if as_whole.judgement.verdict == "poor" else _PART
    return (_Judged.of(part_task, part) if part.energy < clearly * found.energy else as_whole).fit(lead, began)


def fit_near(
    template: Template,
    shape: Shape,
    start: Fit,
    config: ViscousConfig,
    turned: bool = False,
    mirror: bool = False,
    sided: bool = False,
) -> Fit | None:
    """Fit a template to a repaired shape that stands as it does.

    Parameters
    ----------
    start
        A fit of another template of the same vertices, from whose pose this one begins.
    turned, mirror
        Whether other turns are tried, and those of the mirror image.
    sided
        Whether shapes are known to have sides: the one is meant for which the template stretches less.

    Returns
    -------
    Fit
        None where the shape stands otherwise.
    """
    began, quick = time.monotonic(), _Task(template, shape, _quick(config.seed))
    own = MIRROR if start.frame.mirrored else None
    best, lead = quick.fitted(quick.near(start.frame)), 0.0
    if turned:
        best = _clearly_better(quick.best_turn(own), best, _ANEW)
    if turned and mirror:
        other = quick.best_turn(None if own is MIRROR else MIRROR)
        lead = float(np.log(max(other.features.stretch, _NOTHING) / max(best.features.stretch, _NOTHING)))
        certain = sided and best.alike and other.alike
        if lead < 0 if certain else _clearly_better(other, best, _TURNED) is other:
            best, lead = other, -lead
    task = _Task(finest(template, config) if best.alike else template, shape, config)
    found = task.fitted(replace(best.begin, vectors=np.zeros((task.system.K, 3))))
    return _Judged.of(task, found).fit(lead, began) if found.alike else None


def fit_otherwise(template: Template, shape: Shape, start: Fit, config: ViscousConfig) -> tuple[Fit, bool]:
    """Fit a template to a repaired shape that stands otherwise than it does.

    Parameters
    ----------
    start
        Another template of the same vertices, where they belong on the shape, or may.

    Returns
    -------
    Fit
        From there; or of the template that is only turned, if that has less energy.
    bool
        Whether it is the former.
    """
    began, quick = time.monotonic(), _Task(template, shape, _quick(config.seed))
    ambiguous = tuple(reason for reason in start.reasons if reason.code == "ambiguous")
    vectors = quick.onto(np.arange(len(start.points)), start.points)
    moved = quick.fitted(_Begin(start.frame, vectors, start.trust, ambiguous))
    turned = quick.best_turn(MIRROR if start.frame.mirrored else None)
    best = _clearly_better(moved, turned, 1.0 if start.trust >= _LOST else _SEARCHED)
    if best.features.stretch > _FAR:
        config = replace(ViscousConfig.choosing(), seed=config.seed)
    task = _Task(template, shape, config)
    return _Judged.of(task, task.fitted(best.begin)).fit(0.0, began), best is moved


def fit_alike(
    template: Template,
    shape: Shape,
    begun: tuple[Float[Floats, "N 3"], Fit],
    config: ViscousConfig | None = None,
    mirror: bool = True,
    whole: float | None = None,
    turned: bool = True,
) -> tuple[Fit, bool] | None:
    """Fit a template to a repaired shape that may stand as it does, or be a part of it, and has been matched to it.

    Parameters
    ----------
    begun
        Positions (N, 3) on the resting template, and a fit whose points (N, 3) say where a search found them to belong.
    mirror, whole
        As of `fit_without_model`.
    turned
        Whether the template is also only turned, in any way.

    Returns
    -------
    Fit
        Of more nodes, and more samples, than those of a search.
    bool
        Whether it began where the search ended; else where the template is only turned, which is clearly better.

    None where the shape stands otherwise than the template.
    """
    began, config = time.monotonic(), config or ViscousConfig()
    few, sides = _quick(config.seed), (None, MIRROR) if mirror else (None,)
    task, (resting, start) = _Task(template, shape, few), begun
    at = np.asarray(cKDTree(task.system.verts).query(resting)[1], np.int64)
    as_found = partial(task.fitted, _Begin(start.frame, task.onto(at, start.points)))
    others = [partial(task.best_turn, side) for side in sides] if turned else []
    first, *turns = parallel_calls((as_found, *others))
    best = first
    for turn in turns:
        other = turn.begin.frame.mirrored != best.begin.frame.mirrored
        relaxed = whole is None and other and turn.alike and turn.features.stretch < _OTHER_SIDE * best.features.stretch
        best = turn if relaxed else _clearly_better(turn, best, _TURNED)
    if whole is not None:
        part = _Task(template, shape, few, whole).best_part(sides)
        poor = _Judged.of(task, best).judgement.verdict == "poor"
        if part.energy < (1.0 if poor else _PART_OF_ALIKE if best.alike else _PART) * best.energy:
            task = _Task(template, shape, config, whole)
            return _Judged.of(task, task.fitted(part.begin)).fit(0.0, began), False
    if not best.alike:
        return None
    task = _Task(template, shape, config)
    return _Judged.of(task, task.fitted(best.begin)).fit(0.0, began), best is first


@dataclass(frozen=True, eq=False)
class Standing:
    """A shape beside a template that is only turned: the frame from its file to the template, how much that has to stretch,
    and whether the shape stands as it does."""

    frame: Frame
    stretch: float
    alike: bool


def standing(template: Template, shape: Shape, seed: int) -> Standing:
    """How a repaired shape stands to a template, by fits of those turns of it that lie near."""
    best = _Task(template, shape, _quick(seed)).best_turn(None)
    return Standing(best.begin.frame, max(best.features.stretch, _NOTHING), best.alike)


def fit_from(template: Template, shape: Shape, start: Fit, config: ViscousConfig) -> Fit | None:
    """Fit a template to a repaired shape from the pose of a fit of another template with the same vertices; None where the
    shape stands otherwise."""
    began, task = time.monotonic(), _Task(template, shape, config)
    found = task.fitted(task.near(start.frame))
    return _Judged.of(task, found).fit(0.0, began) if found.alike else None


def fit_turned(template: Template, shape: Shape, turn: Float[Floats, "3 3"], config: ViscousConfig) -> Fit:
    """Fit a template to a repaired shape that stands as it does, turned by a rotation from its file to the template."""
    began, task = time.monotonic(), _Task(template, shape, config)
    begin = task.near(replace(sqrt_area_frame(shape), rotation=turn))
    return _Judged.of(task, task.fitted(begin)).fit(0.0, began)


def _quick(seed: int) -> ViscousConfig:
    """To choose among poses in less time."""
    stiff = ViscousConfig.choosing()
    schedule = replace(stiff.schedule, steps=_FEW_STEPS)
    return replace(stiff, samples=_FEW, back_points=_FEW, schedule=schedule, seed=seed)


@dataclass(frozen=True, eq=False)
class _Judged:
    """Where least squares ended, and what is said of it."""

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

    def fit(self, lead: float, began: float) -> Fit:
        """As a fit, which is fair at best; ``lead`` is its `Fit.side`."""
        task, found = self.task, self.found
        frame = found.begin.frame
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
            side=lead,
            partial=task.partial,
        )
        # The trust is that of the fit itself: a collection compares it with others.
        trust = min(fit.trust, found.begin.trust)
        doubts = (reason for reason in found.begin.doubts if reason.code == "ambiguous")
        fit = replace(cap_verdict(fit, [*doubts, unsure]), trust=trust)
        if found.begin.trust >= _LOST:
            return fit
        lost = Reason("doubt", "no pose of the template is clearly right for this shape")
        return replace(fit, verdict="poor", reasons=(lost, *fit.reasons))
