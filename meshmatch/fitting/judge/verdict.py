"""Good, fair or poor: how a fit is judged, by its features, and why."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Bool, Bools
from meshmatch.fitting.judge.features import (
    FitFeatures,
    cloud_allowance,
    compute_features,
    connected_parts,
    multipart_allowance,
    subtract_in_quadrature,
)
from meshmatch.fitting.judge.reasons import Reason, ReasonCode, Verdict
from meshmatch.fitting.search.predictor import reads_alike
from meshmatch.fitting.search.task import Registration, without_interior
from meshmatch.fitting.solve.regularity import Regularity

# Trust from which on a fit is good, and fair: more likely right than wrong; a part is fair at best.
GOOD_TRUST, FAIR_TRUST = 0.99, 0.5
EVEN_TRUST = 0.5  # at most, where nearness says nothing: as likely wrong as right
# Shares without counterpart up to which a fit is good; and of the template, up to which it is fair. Set by hand.
_GOOD_SHARE, _FAIR_SHARE = 0.02, 0.06
_HIDDEN = 0.6  # share of the template: of a part that shows less than the rest, such as a leg, too little can be told
# A stretch of the template from which on no fit is good, and from which on it is poor. Set by hand.
_CRUSHED, _FLAT = 1.0, 2.0
_SKIN = 1.9  # square metres of an adult's skin
# Share of the template's vertices that are folded, up to which a fit is good: right fits of generated animals have up to
# 0.03, those of people up to 0.01. What folds only when fits agree is no property of the shape: less of it is too much.
_FOLDED, _FOLDED_SINCE = 0.05, 0.01
# A residual (units of sqrt(area)) from which on a fit may be one of a part, and the search for parts goes on. Set by hand.
FAIR_RESIDUAL = 0.031


@dataclass(frozen=True)
class Judgement:
    """A verdict, why it is not good, and by what features."""

    verdict: Verdict
    reasons: tuple[Reason, ...]
    features: FitFeatures

    @property
    def trust(self) -> float:
        """How far (0..1) the fit can be trusted."""
        return self.features.p_correct


def judge_registration(found: Registration, partial: bool) -> Judgement:
    """What is thought of a registration."""
    task, vectors = found.task, found.candidate.vectors
    if task.shape.is_cloud:
        allowance = cloud_allowance(task.system, found.local, task.shape.V, vectors, task.config.seed)
    else:
        allowance = multipart_allowance(task.shape, without_interior(task.shape, task.system))
    residual = subtract_in_quadrature(found.candidate.residual, allowance)

    def spread_at(vertices: Bool[Bools, " V"]) -> float:
        return task.predictor.spread(found.local, vectors, vertices)

    predicted = task.model.has_nodes and reads_alike(task.model)
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
    return judge(features) if task.shape.is_cloud else judge_with_allowance(features, found.candidate.residual)


def judge_with_allowance(features: FitFeatures, residual: float) -> Judgement:
    """Verdict, reasons and trust of a fit of a mesh that has that ``residual``, some of it excused in ``features``.

    What is excused makes no fit good: front and back of a figure of solids differ by no more than that.
    """
    judged = judge(features)
    if judged.verdict != "good" or judge(replace(features, residual=residual)).verdict == "good":
        return judged
    return replace(judged, verdict="fair", reasons=(Reason("residual", _gap(residual)),))


def judge(features: FitFeatures) -> Judgement:
    """Verdict, reasons and trust."""
    trust, reasons = features.p_correct, _reasons(features)
    lacking = max(features.uncovered_shape, features.uncovered_template)
    if features.partial:
        lost = f"{100 * features.hidden:.0f} % of the template has no counterpart"
        reasons.append(Reason("part", f"taken for a part: {lost}"))
    if (
        trust < FAIR_TRUST
        or features.uncovered_template > _FAIR_SHARE
        or features.hidden > _HIDDEN
        or features.stretch > _FLAT
    ):
        verdict: Verdict = "poor"
    elif (
        trust < GOOD_TRUST
        or features.partial
        or lacking > _GOOD_SHARE
        or features.stretch > _CRUSHED
        or features.inverted > _FOLDED
    ):
        verdict = "fair"
    else:
        return Judgement("good", (), features)
    if trust < GOOD_TRUST and not reasons:
        likely = f"{int(100 * trust)} % likely to be right, where a good fit needs {100 * GOOD_TRUST:.0f} %"
        reasons.append(Reason("doubt", likely))
    return Judgement(verdict, tuple(reasons), features)


def _reasons(features: FitFeatures) -> list[Reason]:
    """Features that speak against the fit."""
    unreached = f"{100 * features.uncovered_shape:.0f} % of the shape is not reached by the template"
    empty = f"{100 * features.uncovered_template:.0f} % of the template lies where the shape has no surface"
    crushed = f"the template had to be stretched or compressed {np.exp(features.stretch):.1f}-fold on average"
    facing = f"{100 * features.flipped:.0f} % of the shape faces the other way than the template"
    unsure = (
        f"what the network predicts for tilted and mirrored copies is {100 * features.spread:.0f} % of sqrt(area) off"
    )
    told: list[tuple[bool, ReasonCode, str]] = [
        (features.residual > 0.0285, "residual", _gap(features.residual)),
        (features.uncovered_shape > _GOOD_SHARE, "unreached", unreached),
        (features.uncovered_template > _GOOD_SHARE, "empty", empty),
        (
            features.discontinuous > 0.02,
            "torn",
            f"{100 * features.discontinuous:.0f} % of neighbours on the shape belong far apart",
        ),
        (features.stretch > _CRUSHED, "crushed", crushed),
        (features.inverted > _FOLDED, "folded", _folds(features.inverted)),
        (features.flipped > 0.1, "facing", facing),
        (features.spread > 0.06, "unsure", unsure),
    ]
    return [Reason(code, words) for speaks, code, words in told if speaks]


def _gap(residual: float) -> str:
    on_a_person = 100 * np.sqrt(_SKIN) * residual
    return f"template and shape are {100 * residual:.1f} % of sqrt(area) apart on average ({on_a_person:.1f} cm on a person)"


def _folds(inverted: float) -> str:
    return f"the template is folded or inside out at {100 * inverted:.1f} % of its vertices"


def folded_by_agreement(before: Regularity | None, after: Regularity) -> Reason | None:
    """Why a fit is no longer good whose deformation folds more than right ones do, or clearly more than before."""
    folded = 0.0 if before is None else before.inverted
    if after.inverted <= min(_FOLDED, folded + _FOLDED_SINCE):
        return None
    return Reason("folded", _folds(after.inverted))
