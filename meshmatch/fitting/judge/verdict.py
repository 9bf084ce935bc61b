"""Verdict of a fit (good, fair or poor) from its features, with reasons."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Bool, Bools
from meshmatch.fitting.judge.calibration import CALIBRATION, Calibration, calibration_of
from meshmatch.fitting.judge.features import (
    FitFeatures,
    cloud_allowance,
    compute_features,
    connected_parts,
    multipart_allowance,
    subtract_in_quadrature,
    uncut_share,
)
from meshmatch.fitting.judge.joints import knees_forward
from meshmatch.fitting.judge.reasons import Reason, ReasonCode, Verdict
from meshmatch.fitting.search.predictor import is_tilt_consistent
from meshmatch.fitting.search.task import Registration, without_interior
from meshmatch.fitting.search.visibility import visible_vertices
from meshmatch.fitting.solve.regularity import Regularity

_SKIN = 1.9  # area of an adult's skin in square metres


@dataclass(frozen=True, kw_only=True)
class VerdictLimits:
    """Limits between good, fair and poor. Set by hand, apart from the trust, which is a probability.

    Attributes
    ----------
    good_trust, fair_trust : least trust of a good and of a fair fit
    uninformative_trust : upper bound of the trust if the residual is uninformative
    good_share : largest share (0..1) of shape or template without counterpart in a good fit
    fair_share : largest share of the template without counterpart in a fair fit
    hidden : largest share of the template that a fair fit of a part may leave hidden: a leg alone is not enough to judge
    crushed, flat : stretch of the template above which no fit is good, and above which it is poor
    folded : largest share of folded template vertices in a good fit: right fits of generated animals have up to 0.03, those
        of people up to 0.01
    folded_by_agreement : the same for vertices that fold only during agreement, which is no property of the shape
    search_parts : residual (units of sqrt(area)) above which a fit may be one of a part
    residual, discontinuous, flipped, spread : values above these are reported as reasons
    """

    good_trust: float = 0.99
    fair_trust: float = 0.5
    uninformative_trust: float = 0.5
    good_share: float = 0.02
    fair_share: float = 0.06
    hidden: float = 0.6
    crushed: float = 1.0
    flat: float = 2.0
    folded: float = 0.05
    folded_by_agreement: float = 0.01
    search_parts: float = 0.031
    residual: float = 0.0285
    discontinuous: float = 0.02
    flipped: float = 0.1
    spread: float = 0.06


LIMITS = VerdictLimits()


@dataclass(frozen=True)
class Judgement:
    """A verdict, the reasons why it is not good, and the features behind it."""

    verdict: Verdict
    reasons: tuple[Reason, ...]
    features: FitFeatures
    calibration: Calibration = CALIBRATION

    @property
    def trust(self) -> float:
        """Probability (0..1) that the fit is right."""
        return self.features.p_correct(self.calibration)


def judge_registration(found: Registration, partial: bool) -> Judgement:
    """Judge a registration."""
    task, vectors = found.task, found.candidate.vectors
    if task.shape.is_cloud:
        allowance = cloud_allowance(task.system, found.local, task.shape.V, vectors, task.config.seed)
    else:
        allowance = multipart_allowance(task.shape, without_interior(task.shape, task.system))
    residual = subtract_in_quadrature(found.candidate.residual, allowance)

    def spread_at(vertices: Bool[Bools, " V"]) -> float:
        return task.predictor.spread(found.local, vectors, vertices)

    predicted = task.model.has_nodes and is_tilt_consistent(task.model)
    features = compute_features(
        task.system,
        vectors,
        found.local,
        residual,
        task.model.template.labels,
        partial=partial,
        spread_at=spread_at if predicted else None,
        connected=connected_parts(task.shape, found.local),
    )
    shown = visible_vertices(task.system, found.local, vectors) if partial else None
    features = replace(features, forward=knees_forward(task.system, vectors, task.model.template, shown))
    if partial and not task.shape.is_cloud:
        edges = found.core_frame.apply(task.shape.verts[task.shape.edges.open].mean(1))
        features = replace(features, uncut=uncut_share(task.system, found.local, vectors, edges))
    calibration = calibration_of(task.model.card.category)
    if task.shape.is_cloud:
        return judge(features, calibration)
    return judge_with_allowance(features, found.candidate.residual, calibration)


def judge_with_allowance(features: FitFeatures, residual: float, calibration: Calibration = CALIBRATION) -> Judgement:
    """Verdict, reasons and trust of a fit of a mesh, where part of ``residual`` is allowed for in ``features``.

    The allowance makes no fit good: front and back of a figure of solids differ by no more than that.
    """
    judged = judge(features, calibration)
    if judged.verdict != "good" or judge(replace(features, residual=residual), calibration).verdict == "good":
        return judged
    return replace(judged, verdict="fair", reasons=(Reason("residual", _gap(residual)),))


def judge(features: FitFeatures, calibration: Calibration = CALIBRATION) -> Judgement:
    """Verdict, reasons and trust for features."""
    trust, reasons = features.p_correct(calibration), _reasons(features)
    lacking = max(features.uncovered_shape, features.uncovered_template)
    if features.partial:
        lost = f"{100 * features.hidden:.0f} % of the template has no counterpart"
        reasons.append(Reason("part", f"fitted as a part: {lost}"))
    if (
        trust < LIMITS.fair_trust
        or features.uncovered_template > LIMITS.fair_share
        or features.hidden > LIMITS.hidden
        or features.stretch > LIMITS.flat
    ):
        verdict: Verdict = "poor"
    elif (
        trust < LIMITS.good_trust
        or features.partial
        or lacking > LIMITS.good_share
        or features.stretch > LIMITS.crushed
        or features.inverted > LIMITS.folded
    ):
        verdict = "fair"
    else:
        return Judgement("good", (), features, calibration)
    if trust < LIMITS.good_trust and not reasons:
        likely = f"{int(100 * trust)} % likely to be right, where a good fit needs {100 * LIMITS.good_trust:.0f} %"
        reasons.append(Reason("doubt", likely))
    return Judgement(verdict, tuple(reasons), features, calibration)


def _reasons(features: FitFeatures) -> list[Reason]:
    """Features that speak against the fit, as reasons."""
    unreached = f"{100 * features.uncovered_shape:.0f} % of the shape is not reached by the template"
    empty = f"{100 * features.uncovered_template:.0f} % of the template lies where the shape has no surface"
    crushed = f"the template had to be stretched or compressed {np.exp(features.stretch):.1f}-fold on average"
    facing = f"{100 * features.flipped:.0f} % of the shape faces the other way than the template"
    unsure = (
        f"the network's predictions for tilted and mirrored copies differ by {100 * features.spread:.0f} % of "
        f"sqrt(area)"
    )
    pieces = f"{100 * features.astray:.0f} % of the shape are separate pieces that lie beside the template"
    uncut = f"{100 * features.uncut:.0f} % of the border of the fitted part is not an open edge of the shape"
    bent = f"a knee bends forward by {features.forward:.0f} degrees, as if front and back were exchanged"
    astray, open_border, forward = features.alone
    criteria: list[tuple[bool, ReasonCode, str]] = [
        (features.residual > LIMITS.residual, "residual", _gap(features.residual)),
        (features.uncovered_shape > LIMITS.good_share, "unreached", unreached),
        (features.uncovered_template > LIMITS.good_share, "empty", empty),
        (
            features.discontinuous > LIMITS.discontinuous,
            "torn",
            f"{100 * features.discontinuous:.0f} % of neighbouring vertices of the shape belong to distant places of "
            f"the template",
        ),
        (features.stretch > LIMITS.crushed, "crushed", crushed),
        (features.inverted > LIMITS.folded, "folded", _folds(features.inverted)),
        (astray, "pieces", pieces),
        (open_border, "uncut", uncut),
        (forward, "bent", bent),
        (features.flipped > LIMITS.flipped, "facing", facing),
        (features.spread > LIMITS.spread, "unsure", unsure),
    ]
    return [Reason(code, text) for applies, code, text in criteria if applies]


def _gap(residual: float) -> str:
    """Sentence on the residual (units of sqrt(area))."""
    on_a_person = 100 * np.sqrt(_SKIN) * residual
    as_much = f"as {on_a_person:.1f} cm would be on a person"
    return f"template and shape are {100 * residual:.1f} % of sqrt(area) apart on average, {as_much}"


def _folds(inverted: float) -> str:
    """Sentence on the share (0..1) of folded vertices."""
    return f"the template is folded or inside out at {100 * inverted:.1f} % of its vertices"


def folded_by_agreement(before: Regularity | None, after: Regularity) -> Reason | None:
    """The reason why a fit is no longer good after agreement, or None.

    It is not if its deformation folds more than right ones do, or clearly more than before.
    """
    folded = 0.0 if before is None else before.inverted
    if after.inverted <= min(LIMITS.folded, folded + LIMITS.folded_by_agreement):
        return None
    return Reason("folded", _folds(after.inverted))
