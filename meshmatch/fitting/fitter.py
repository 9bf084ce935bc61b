"""Fit a model's template to shapes: samples, orientation, prediction, refinement, verdict; and with known pairs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, off_torch
from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit, judged_fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge.features import uncovered_share
from meshmatch.fitting.judge.reasons import SIDE_IN_DOUBT, Reason, Verdict
from meshmatch.fitting.judge.verdict import LIMITS, judge_registration
from meshmatch.fitting.search.predictor import mirror_of
from meshmatch.fitting.search.refinement import REFINEMENTS, fit_part, fit_whole
from meshmatch.fitting.search.task import FitTask, Registration
from meshmatch.fitting.search.thick_parts import with_thick_part_smaller
from meshmatch.fitting.search.untangling import untangled
from meshmatch.fitting.solve.terms import Landmarks
from meshmatch.fitting.usual import Usual
from meshmatch.geometry.oriented import quick_tree
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.card import ModelCard
from meshmatch.models.trained import TrainedModel, torch_network
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.normalise import ALIGNS
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

_HINT = "one target vertex for each source vertex, both counted from 0"
# All of these were set by hand.
_EMPTY = 0.06  # a fit of the whole that leaves this share of the template without surface may be one of a part
_OPEN = 0.3  # so may a bad one of a mesh with a boundary of so many sqrt(area)
_CUT = 1.0  # a bad fit that leaves nothing bare needs a boundary of so many: characters built of parts have up to 0.5
_AGAINST = 0.06  # a boundary so near to another part (units of sqrt(area)) is not that of a cut
_CLOSER = 0.85  # a part is believed if its residual is that much smaller
_MISSING = 0.03  # and if it lacks that much of the surface
_SURE_SIDE = 0.95  # left or right is sure if the other side's residual is larger by this factor


class Fitter:
    """Fits the template of one model. Nothing in it changes, so several threads can share one.

    What depends on the model alone is built once for all its fitters, also if threads ask for it at the same time.
    ``progress`` is called with (stage, name of the shape, share of the stage that is done); what it raises ends the fit.
    """

    def __init__(
        self, model: TrainedModel, config: FitConfig | None = None, progress: ProgressCallback | None = None
    ) -> None:
        self.model = model
        self.config = (config or FitConfig()).for_model(model)
        self.progress = progress
        if self.config.refine == "latent":
            torch_network(model, self.config.device)  # which needs torch: told before minutes of work

    def fit(self, shape: Shape, landmarks: Landmarks | None = None) -> Fit:
        """Fit the template to a repaired shape; to a cloud without its outliers.

        The shape is in any unit, turn and resolution. Landmarks (template vertices (N,), positions (N, 3) in the shape's
        file) are held by a fit of the whole, and parts are not tried then; `OptionError` for a model without nodes.
        """
        if landmarks is not None:
            check_landmarks(self.model)
        began = time.monotonic()
        found = self._fit(self.config, shape, landmarks, began)
        if self.config.again and _spoken_against(found):
            found = self._fit(self.config.with_all_of_the_search(), shape, landmarks, began)
        return found

    def _fit(self, config: FitConfig, shape: Shape, landmarks: Landmarks | None, began: float) -> Fit:
        progress, card = Progress(self.progress, shape.name), self.model.card
        doubts: list[Reason] = []
        both = (config.mirror or card.mirror) != "no" and mirror_of(self.model) is None
        stretches = [progress.between(k / 2, (k + 1) / 2) for k in range(2)] if both else [progress]

        def whole(how: FitConfig, mirrored: bool) -> Registration:
            return fit_whole(FitTask.of(self.model, how, shape, landmarks, stretches[mirrored], mirrored))

        # What is said to be a part is tried as a whole with little effort, and in full only where it is none.
        said = config.partial == "yes"
        little = replace(config, finalists=1) if said else config
        wholes = [whole(little, mirrored) for mirrored in ((False, True) if both else (False,))]
        # If either handedness fits the whole shape, the other is not tried as a part.
        parts = landmarks is None and _may_be_part(min(wholes, key=_cost))
        sides = [_as_part_if_closer(each) if parts else (each, False) for each in wholes]
        (found, partial), *others = sorted(sides, key=lambda side: _cost(side[0]))
        if said and not partial:
            found = whole(config, found.core_frame.mirrored)
        notes = with_side((), shape.name, card, found.core_frame.mirrored)
        if others and _cost(found) > _SURE_SIDE * _cost(others[0][0]):
            doubts.append(Reason("side", SIDE_IN_DOUBT))
        fit = as_fit(found, partial, began)
        if _spoken_against(fit) and not partial and config.variants and config.moves_nodes:
            better = with_thick_part_smaller(found) if fit.verdict == "poor" else None
            better = better or untangled(found)
            fit = fit if better is None else as_fit(better, partial, began)
        fit = replace(fit, notes=notes)
        return cap_verdict(fit if card.correspondence else judged_of_kind(card, fit), doubts)


def _spoken_against(fit: Fit) -> bool:
    """Whether something in particular speaks against a fit, beyond a doubt.

    Of 180 people, ten of these gained 2.6 cm by all of the search, six that were merely doubted nothing.
    """
    return any(reason.code != "doubt" for reason in fit.reasons)


def side_words(card: ModelCard) -> str:
    """What is said of a shape that is fitted as a mirror image."""
    return f"taken for the mirror image of what {card.name} knows"


def with_side(notes: Sequence[str], name: str, card: ModelCard, mirrored: bool) -> tuple[str, ...]:
    """What is said of a fit, with whether its shape was taken for a mirror image."""
    of_mirror_image = f"{name}: {side_words(card)}"
    return (*([of_mirror_image] if mirrored else []), *(note for note in notes if note != of_mirror_image))


def judged_of_kind(card: ModelCard, fit: Fit) -> Fit:
    """A fit of a model that learned a kind without correspondence: judged by what its card says is usual; fair at best where
    it says nothing."""
    usual = Usual.of_card(card)
    if usual is not None and fit.signs is not None:
        return usual.judged(fit, fit.trust, fit.signs.stretch, fit.residual)
    learned = f"{card.name} was trained without correspondence: surfaces that lie close need not correspond"
    return cap_verdict(fit, [Reason("unsupervised", learned)])


def _cost(found: Registration) -> float:
    return found.candidate.cost


def _as_part_if_closer(whole: Registration) -> tuple[Registration, bool]:
    """A fit of the whole, or one as a part if that may be and is better; and which it is."""
    if not _may_be_part(whole):
        return whole, False
    config = whole.task.config
    thorough = config.try_harder or config.partial == "yes" or _leaves_bare(whole)
    part = _best_part(whole.task.on_visible_samples, thorough)
    if part is None:
        return whole, False
    # A part explains the shape better than the whole, and lacks some of it.
    closer = part.candidate.cost < _CLOSER * whole.candidate.residual
    partial = closer and part.candidate.share < 1 - _MISSING
    return (part, True) if partial else (whole, False)


def _best_part(task: FitTask, thorough: bool) -> Registration | None:
    """The best fit of a part, if one is near; in a ``thorough`` search, where that is poor, also from more orientations."""
    found = fit_part(task)
    if not thorough or (found is not None and judge_registration(found, partial=True).verdict != "poor"):
        return found
    return min([each for each in (found, fit_part(task, wide=True)) if each is not None], key=_cost)


def cap_verdict(fit: Fit, doubts: Sequence[Reason]) -> Fit:
    """Cap the verdict of a fit whose residual is uninformative: it is fair at best, and as likely wrong as right."""
    if not doubts:
        return fit
    verdict: Verdict = "fair" if fit.verdict == "good" else fit.verdict
    return replace(
        fit, verdict=verdict, reasons=(*fit.reasons, *doubts), trust=min(fit.trust, LIMITS.uninformative_trust)
    )


def _may_be_part(whole: Registration) -> bool:
    """Whether a fit as a part is worth its time: asked for and the whole is not good, or a bad fit of an open shape, or one
    that leaves the template bare.
    """
    task, asked = whole.task, whole.task.config.partial
    if asked == "no":
        return False
    if asked == "yes" and judge_registration(whole, partial=False).verdict != "good":
        return True
    if asked == "auto" and not REFINEMENTS[task.config.refine].tries_parts:
        return False
    if not may_show_part(task.shape, task.config):
        return False
    # the residual of a cloud says how sparse and noisy it is
    if not task.shape.is_cloud and whole.candidate.residual > LIMITS.search_parts:
        least = _OPEN if task.config.try_harder or asked == "yes" else _CUT
        if boundary_length(task.shape) >= least * np.sqrt(task.shape.area):
            return True
    return _leaves_bare(whole)


def _leaves_bare(whole: Registration) -> bool:
    """Whether a fit of the whole leaves so much of the template without surface that the shape may be a part."""
    return uncovered_share(whole.local, whole.surface.points) > _EMPTY


def may_show_part(shape: Shape, config: FitConfig) -> bool:
    """Whether a shape could be a part of a whole: said so, a cloud, or a mesh with a long boundary."""
    if config.partial != "auto":
        return config.partial == "yes"
    return shape.is_cloud or boundary_length(shape) >= _OPEN * np.sqrt(shape.area)


def as_fit(found: Registration, partial: bool, began: float) -> Fit:
    """The fit of a registration, judged."""
    task, best = found.task, found.candidate
    aligned = task.model.card.frame["orientation"] in ALIGNS  # its template stands as some shape did
    return judged_fit(
        judge_registration(found, partial),
        task.system,
        found.core_frame,
        best.vectors,
        upright=not aligned or task.config.up is not None or task.config.front is not None,
        template_hash=task.model.template.hash,
        residual=best.residual,
        verts=task.shape.verts,
        seconds=time.monotonic() - began,
        seed=task.config.seed,
        partial=partial,
        model=task.model.card.name,
    )


def boundary_length(shape: Shape) -> float:
    """Length of the edges with one face, in the unit of the file.

    Those that lie against another connected part of the shape do not count: where an arm ends in a sleeve, nothing is cut.
    """
    ends = shape.verts[shape.edges.open]  # N 2 3
    counts = ~_against_another_part(shape, ends.mean(1))
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)[counts].sum())


def _against_another_part(shape: Shape, middles: Float[Floats, "N 3"]) -> Bool[Bools, " N"]:
    """Whether the middle of each open edge is near to another connected part than its own.

    The numbers of two parts differ in some binary digit: for each digit, edges of parts that have a 0 there are looked up
    among the points of parts that have a 1, and the other way round. So the cost grows with the logarithm of the number of
    parts, where a tree of all other parts for each of them would make it grow with the square.
    """
    own = shape.vertex_parts[shape.edges.open[:, 0]]
    against = np.zeros(len(own), bool)
    if not len(own) or shape.face_parts.max() == 0:
        return against
    edges, used = shape.edges.vertices, np.flatnonzero(shape.vertex_parts >= 0)
    points = np.concatenate([shape.verts[used], shape.verts[edges].mean(1)])
    part = shape.vertex_parts[np.concatenate([used, edges[:, 0]])]
    near = _AGAINST * np.sqrt(shape.area)
    for digit in range(int(part.max()).bit_length()):
        one, sought = part >> digit & 1, own >> digit & 1
        for value in (0, 1):
            asked = np.flatnonzero(~against & (sought == value))
            if len(asked):
                others = quick_tree(points[one != value])
                against[asked] = others.query(middles[asked], distance_upper_bound=near)[0] <= near
    return against


def check_landmarks(model: TrainedModel) -> None:
    """Refuse landmarks for a model without nodes, which could not hold them (`OptionError`)."""
    if not model.has_nodes:
        raise OptionError(
            f"model {model.card.name} is pointwise: it has no nodes that landmarks could hold",
            "leave out the landmarks, or use a model of another field",
        )


def template_vertices(
    template: Template, fits: Sequence[Fit], places: Sequence[Float[Floats, "N 3"]]
) -> Int[Ints, " N"]:
    """Template vertices for N points given on several fitted shapes (file frames).

    Each fit answers with the template vertex nearest to the point; the vertex nearest to the mean of the
    answers on the resting template is taken, so no shape's fit decides alone.
    """
    verts = template.shape.verts
    answers = [
        verts[cKDTree(fit.points).query(fit.frame.apply(place))[1]] for fit, place in zip(fits, places, strict=True)
    ]
    return cKDTree(verts).query(np.mean(answers, axis=0))[1].astype(np.int64)


def landmark_places(clean: Sequence[Repaired], landmarks: Sequence[ArrayLike]) -> list[Float[Floats, "N 3"]]:
    """Where the landmarks of two shapes lie, in the frames of their files.

    `OptionError` if these are not pairs of vertices, or a shape does not have one.
    """
    if isinstance(landmarks, list) and all(isinstance(each, tuple) and len(each) == 2 for each in landmarks):
        raise OptionError("landmarks must be two lists of vertices, not a list of pairs", "write tuple(zip(*pairs))")
    if len(landmarks) != 2:
        raise OptionError(f"landmarks must be two lists of vertices, not {len(landmarks)}", _HINT)
    places = []
    for part, vertices in zip(clean, landmarks, strict=True):
        chosen, V = np.asarray(off_torch(vertices)), len(part.original_to_repaired)
        if chosen.ndim != 1 or len(chosen) == 0 or chosen.dtype.kind not in "iu" or chosen.min() < 0:
            raise OptionError("landmarks must be lists of vertex numbers", _HINT)
        if chosen.max() >= V:
            raise OptionError(
                f"landmark vertex {chosen.max()} is not on {part.shape.name}, which has {V} vertices",
                "numbers start at 0; the source comes first",
            )
        if (lost := chosen[~part.original.valid[chosen]]).size:
            raise OptionError(f"landmark vertex {lost[0]} of {part.shape.name} has no position", "leave its pair out")
        places.append(part.shape.verts[part.original_to_repaired[chosen]])
    if len(places[0]) != len(places[1]):
        raise OptionError("landmarks must come in pairs", _HINT)
    sources, targets = np.unique(np.stack([np.asarray(each) for each in landmarks]), axis=1)
    if len(twice := np.flatnonzero(np.diff(sources) == 0)):
        vertex, (one, other) = sources[twice[0]], targets[twice[0] : twice[0] + 2]
        two = f"landmarks pair vertex {vertex} of {clean[0].shape.name} with two of {clean[1].shape.name}: {one} and {other}"
        raise OptionError(two, "keep one of the two lines")
    return places


def fits_with_landmarks(
    model: TrainedModel,
    clean: Sequence[Repaired],
    fits: Sequence[Fit],
    landmarks: tuple[Ints, Ints],
    configs: Sequence[FitConfig],
) -> tuple[list[Fit], list[Landmarks]]:
    """Fit two repaired shapes again with known pairs: vertices (N,) of the source's file, and of the target's.

    A pair is carried to the template through the first fits; the template point between the two answers is then pulled
    to the landmark on both shapes. Returns the fits, and for each shape the template vertices (N,) and their places
    (N, 3) in its file. Errors are those of `landmark_places`.
    """
    places = landmark_places(clean, landmarks)
    at = template_vertices(model.template, fits, places)
    known = [(at, place) for place in places]
    found = [
        Fitter(model, config).fit(part.shape, held) for config, part, held in zip(configs, clean, known, strict=True)
    ]
    return found, known
