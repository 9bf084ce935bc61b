"""Fit a model's template to shapes: samples, orientation, prediction, refinement, verdict; and with known pairs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, to_numpy
from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit, judged_fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge.features import uncovered_share
from meshmatch.fitting.judge.reasons import SIDE_IN_DOUBT, Reason, Verdict
from meshmatch.fitting.judge.verdict import LIMITS, judge_registration
from meshmatch.fitting.reference_statistics import Usual
from meshmatch.fitting.search.predictor import mirror_of
from meshmatch.fitting.search.refinement import REFINEMENTS, fit_part, fit_whole
from meshmatch.fitting.search.task import FitTask, Registration
from meshmatch.fitting.search.thick_parts import with_thick_part_smaller
from meshmatch.fitting.search.untangling import untangled
from meshmatch.fitting.solve.terms import Landmarks
from meshmatch.geometry.oriented import quick_tree
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.card import ModelCard
from meshmatch.models.trained import TrainedModel, torch_network
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.alignment import ALIGNS
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

_HINT = "one target vertex for each source vertex, both counted from 0"
# All set by hand. Boundary lengths and distances are in units of sqrt(area).
_PART_UNCOVERED = 0.06  # a fit of the whole with more than this share of the template uncovered may be one of a part
_MIN_BOUNDARY = 0.3  # a shape with a boundary at least this long may be a part
# Boundary that a badly fitted shape needs where the template is covered; characters built of parts have up to 0.5.
_MIN_BOUNDARY_IF_COVERED = 1.0
_PART_CONTACT = 0.06  # boundary edges this close to another part of the shape are not counted as cut
_PART_RESIDUAL_RATIO = 0.85  # a fit as a part is accepted below this multiple of the whole's residual
_MIN_HIDDEN = 0.03  # and if the part lacks more than this share of the surface
_CLEAR_SIDE_RATIO = 0.95  # handedness is clear if the residual is at most this multiple of the other side's


class Fitter:
    """Fits the template of one model to shapes. Instances are immutable and can be shared by threads.

    Whatever depends on the model alone is built once and shared by all of its fitters, even if threads request it at the
    same time. ``progress`` is called with (stage, name of the shape, completed share of the stage); an exception that it
    raises ends the fit.
    """

    def __init__(
        self, model: TrainedModel, config: FitConfig | None = None, progress: ProgressCallback | None = None
    ) -> None:
        self.model = model
        self.config = (config or FitConfig()).for_model(model)
        self.progress = progress
        if self.config.refine == "latent":
            torch_network(model, self.config.device)  # fail early if torch is missing

    def fit(self, shape: Shape, landmarks: Landmarks | None = None) -> Fit:
        """Fit the template to a repaired shape. The outliers of a cloud are ignored.

        The shape may have any unit, orientation and resolution. Landmarks are template vertices (N,) and positions (N, 3)
        in the shape's file; with them the shape is fitted as a whole, and parts are not tried. Landmarks raise
        `OptionError` for a model without nodes.
        """
        if landmarks is not None:
            check_landmarks(self.model)
        began = time.monotonic()
        found = self._fit(self.config, shape, landmarks, began)
        if self.config.again and _has_specific_reason(found):
            found = self._fit(self.config.with_all_of_the_search(), shape, landmarks, began)
        return found

    def _fit(self, config: FitConfig, shape: Shape, landmarks: Landmarks | None, began: float) -> Fit:
        """Fit as a whole, as a part and mirrored, as far as the configuration allows, and return the best fit."""
        progress, card = Progress(self.progress, shape.name), self.model.card
        doubts: list[Reason] = []
        both_sides = (config.mirror or card.mirror) != "no" and mirror_of(self.model) is None
        stages = [progress.between(k / 2, (k + 1) / 2) for k in range(2)] if both_sides else [progress]

        def whole(search_config: FitConfig, mirrored: bool) -> Registration:
            return fit_whole(FitTask.of(self.model, search_config, shape, landmarks, stages[mirrored], mirrored))

        # If the user declares a part, fit the whole with less effort, and in full only if the part is rejected.
        declared_part = config.partial == "yes"
        light_config = replace(config, finalists=1) if declared_part else config
        wholes = [whole(light_config, mirrored) for mirrored in ((False, True) if both_sides else (False,))]
        # If either handedness fits the whole shape, the other is not tried as a part.
        try_parts = landmarks is None and _part_is_plausible(min(wholes, key=_cost))
        sides = [_as_part_if_better(each) if try_parts else (each, False) for each in wholes]
        (found, partial), *others = sorted(sides, key=lambda side: _cost(side[0]))
        if declared_part and not partial:
            found = whole(config, found.core_frame.mirrored)
        notes = with_mirror_note((), shape.name, card, found.core_frame.mirrored)
        if others and _cost(found) > _CLEAR_SIDE_RATIO * _cost(others[0][0]):
            doubts.append(Reason("side", SIDE_IN_DOUBT))
        fit = fit_of_registration(found, partial, began)
        if _has_specific_reason(fit) and not partial and config.variants and config.moves_nodes:
            better = with_thick_part_smaller(found) if fit.verdict == "poor" else None
            better = better or untangled(found)
            fit = fit if better is None else fit_of_registration(better, partial, began)
        fit = replace(fit, notes=notes)
        return cap_verdict(fit if card.correspondence else judge_unsupervised(card, fit), doubts)


def _has_specific_reason(fit: Fit) -> bool:
    """Return whether a fit has a specific reason against it, other than "doubt" (low trust).

    Of 180 people, the full search improved ten fits with a specific reason by 2.6 cm, and six merely doubtful ones not at
    all.
    """
    return any(reason.code != "doubt" for reason in fit.reasons)


def mirror_note(card: ModelCard) -> str:
    """Return the note for a shape that was fitted as a mirror image."""
    return f"taken for the mirror image of what {card.name} knows"


def with_mirror_note(notes: Sequence[str], name: str, card: ModelCard, mirrored: bool) -> tuple[str, ...]:
    """Return notes in which the note on the mirror image is present if and only if the shape was fitted as one."""
    of_mirror_image = f"{name}: {mirror_note(card)}"
    return (*([of_mirror_image] if mirrored else []), *(note for note in notes if note != of_mirror_image))


def judge_unsupervised(card: ModelCard, fit: Fit) -> Fit:
    """Judge a fit of a model that was trained without correspondence.

    The fit is compared with the reference statistics in the model's card. If the card has none, the fit is at most fair.
    """
    usual = Usual.of_card(card)
    if usual is not None and fit.signs is not None:
        return usual.judged(fit, fit.trust, fit.signs.stretch, fit.residual)
    learned = f"{card.name} was trained without correspondence: surfaces that lie close need not correspond"
    return cap_verdict(fit, [Reason("unsupervised", learned)])


def _cost(found: Registration) -> float:
    """Cost of a registration's candidate."""
    return found.candidate.cost


def _as_part_if_better(whole: Registration) -> tuple[Registration, bool]:
    """Return the fit of the whole, or a fit as a part if that is plausible and better; and whether it is a part."""
    if not _part_is_plausible(whole):
        return whole, False
    config = whole.task.config
    thorough = config.try_harder or config.partial == "yes" or _leaves_template_uncovered(whole)
    part = _best_part(whole.task.on_visible_samples, thorough)
    if part is None:
        return whole, False
    # A part must explain the shape better than the whole does, and must lack some of the surface.
    closer = part.candidate.cost < _PART_RESIDUAL_RATIO * whole.candidate.residual
    partial = closer and part.candidate.share < 1 - _MIN_HIDDEN
    return (part, True) if partial else (whole, False)


def _best_part(task: FitTask, thorough: bool) -> Registration | None:
    """Return the best fit as a part, or None. A ``thorough`` search tries more orientations if the first fit is poor."""
    narrow = fit_part(task)
    if not thorough or (narrow is not None and judge_registration(narrow, partial=True).verdict != "poor"):
        return narrow
    return min([each for each in (narrow, fit_part(task, wide=True)) if each is not None], key=_cost)


def cap_verdict(fit: Fit, doubts: Sequence[Reason]) -> Fit:
    """Add reasons for doubt to a fit; with any, its verdict is at most fair and its trust at most `uninformative_trust`."""
    if not doubts:
        return fit
    verdict: Verdict = "fair" if fit.verdict == "good" else fit.verdict
    return replace(
        fit, verdict=verdict, reasons=(*fit.reasons, *doubts), trust=min(fit.trust, LIMITS.uninformative_trust)
    )


def _part_is_plausible(whole: Registration) -> bool:
    """Return whether fitting the shape as a part is worth the time.

    It is if the user declares a part and the fit of the whole is not good; or, where the shape could be a part at all, if an
    open mesh fits badly or the fit leaves template uncovered.
    """
    task, declared = whole.task, whole.task.config.partial
    if declared == "no":
        return False
    if declared == "yes" and judge_registration(whole, partial=False).verdict != "good":
        return True
    if declared == "auto" and not REFINEMENTS[task.config.refine].tries_parts:
        return False
    if not may_be_part(task.shape, task.config):
        return False
    # The residual of a cloud reflects its density and noise instead.
    if not task.shape.is_cloud and whole.candidate.residual > LIMITS.search_parts:
        least = _MIN_BOUNDARY if task.config.try_harder or declared == "yes" else _MIN_BOUNDARY_IF_COVERED
        if boundary_length(task.shape) >= least * np.sqrt(task.shape.area):
            return True
    return _leaves_template_uncovered(whole)


def _leaves_template_uncovered(whole: Registration) -> bool:
    """Return whether a fit of the whole leaves so much of the template uncovered that the shape may be a part."""
    return uncovered_share(whole.local, whole.surface.points) > _PART_UNCOVERED


def may_be_part(shape: Shape, config: FitConfig) -> bool:
    """Return whether a shape could be a part: by configuration, as a cloud, or as a mesh with a long boundary."""
    if config.partial != "auto":
        return config.partial == "yes"
    return shape.is_cloud or boundary_length(shape) >= _MIN_BOUNDARY * np.sqrt(shape.area)


def fit_of_registration(found: Registration, partial: bool, began: float) -> Fit:
    """Judge a registration and return it as a `Fit`."""
    task, best = found.task, found.candidate
    aligned = task.model.card.frame["orientation"] in ALIGNS  # its template has the orientation of some shape
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
    """Total length of the boundary edges (edges with one face), in the unit of the file.

    Edges that touch another connected part of the shape are not counted: where an arm ends in a sleeve, nothing is cut.
    """
    ends = shape.verts[shape.edges.open]  # N 2 3
    counts = ~_touches_another_part(shape, ends.mean(1))
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)[counts].sum())


def _touches_another_part(shape: Shape, middles: Float[Floats, "N 3"]) -> Bool[Bools, " N"]:
    """Whether the midpoint (N, 3) of each boundary edge is near a connected part other than its own.

    The numbers of two different parts differ in at least one binary digit. For each digit, edges of parts with a 0 are
    queried against points of parts with a 1, and vice versa. The cost grows with the logarithm of the number of parts;
    querying each part against all others would be quadratic.
    """
    own_part = shape.vertex_parts[shape.edges.open[:, 0]]
    touching = np.zeros(len(own_part), bool)
    if not len(own_part) or shape.face_parts.max() == 0:
        return touching
    edges, used = shape.edges.vertices, np.flatnonzero(shape.vertex_parts >= 0)
    points = np.concatenate([shape.verts[used], shape.verts[edges].mean(1)])
    point_part = shape.vertex_parts[np.concatenate([used, edges[:, 0]])]
    near = _PART_CONTACT * np.sqrt(shape.area)
    for digit in range(int(point_part.max()).bit_length()):
        bit, own_bit = point_part >> digit & 1, own_part >> digit & 1
        for value in (0, 1):
            queried = np.flatnonzero(~touching & (own_bit == value))
            if len(queried):
                others = quick_tree(points[bit != value])
                touching[queried] = others.query(middles[queried], distance_upper_bound=near)[0] <= near
    return touching


def check_landmarks(model: TrainedModel) -> None:
    """Raise `OptionError` if the model has no nodes: such a model cannot use landmarks."""
    if not model.has_nodes:
        raise OptionError(
            f"model {model.card.name} is pointwise: it has no nodes that landmarks could hold",
            "leave out the landmarks, or use a model of another field",
        )


def template_vertices(
    template: Template, fits: Sequence[Fit], places: Sequence[Float[Floats, "N 3"]]
) -> Int[Ints, " N"]:
    """Template vertices (N,) that correspond to N points, each given on several fitted shapes (file frames).

    Every fit maps a point to its nearest template vertex. The vertex nearest to the mean of these on the rest template is
    returned, so that no single fit decides.
    """
    verts = template.shape.verts
    nearest = [
        verts[cKDTree(fit.points).query(fit.frame.apply(points))[1]] for fit, points in zip(fits, places, strict=True)
    ]
    return cKDTree(verts).query(np.mean(nearest, axis=0))[1].astype(np.int64)


def landmark_places(clean: Sequence[Repaired], landmarks: Sequence[ArrayLike]) -> list[Float[Floats, "N 3"]]:
    """Positions (N, 3) of the landmarks on two repaired shapes, in the frames of their files.

    Raises `OptionError` if the landmarks are not valid pairs of vertices.
    """
    if isinstance(landmarks, list) and all(isinstance(each, tuple) and len(each) == 2 for each in landmarks):
        raise OptionError("landmarks must be two lists of vertices, not a list of pairs", "write tuple(zip(*pairs))")
    if len(landmarks) != 2:
        raise OptionError(f"landmarks must be two lists of vertices, not {len(landmarks)}", _HINT)
    places = []
    for part, vertices in zip(clean, landmarks, strict=True):
        numbers, V = np.asarray(to_numpy(vertices)), len(part.original_to_repaired)
        if numbers.ndim != 1 or len(numbers) == 0 or numbers.dtype.kind not in "iu" or numbers.min() < 0:
            raise OptionError("landmarks must be lists of vertex numbers", _HINT)
        if numbers.max() >= V:
            raise OptionError(
                f"landmark vertex {numbers.max()} is not on {part.shape.name}, which has {V} vertices",
                "numbers start at 0; the source comes first",
            )
        if (invalid := numbers[~part.original.valid[numbers]]).size:
            raise OptionError(
                f"landmark vertex {invalid[0]} of {part.shape.name} has no position", "leave its pair out"
            )
        places.append(part.shape.verts[part.original_to_repaired[numbers]])
    if len(places[0]) != len(places[1]):
        raise OptionError("landmarks must come in pairs", _HINT)
    sources, targets = np.unique(np.stack([np.asarray(each) for each in landmarks]), axis=1)
    if len(repeated := np.flatnonzero(np.diff(sources) == 0)):
        vertex, (one, other) = sources[repeated[0]], targets[repeated[0] : repeated[0] + 2]
        two = f"landmarks pair vertex {vertex} of {clean[0].shape.name} with two of {clean[1].shape.name}: {one} and {other}"
        raise OptionError(two, "keep one of the two lines")
    return places


def refit_with_landmarks(
    model: TrainedModel,
    clean: Sequence[Repaired],
    fits: Sequence[Fit],
    landmarks: tuple[Ints, Ints],
    configs: Sequence[FitConfig],
) -> tuple[list[Fit], list[Landmarks]]:
    """Fit two repaired shapes again with landmarks: vertices (N,) of the source's file and (N,) of the target's.

    Each landmark pair is transferred to the template through the first ``fits``, and the corresponding template vertex is
    then pulled to the landmark on both shapes. Returns the new fits and, for each shape, the template vertices (N,) with
    their positions (N, 3) in its file. Errors are those of `landmark_places`.
    """
    places = landmark_places(clean, landmarks)
    template_verts = template_vertices(model.template, fits, places)
    known = [(template_verts, place) for place in places]
    found = [
        Fitter(model, config).fit(part.shape, pulled)
        for config, part, pulled in zip(configs, clean, known, strict=True)
    ]
    return found, known
