"""Good, fair or poor: how a fit is judged, by its signs, and why."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Bool, Bools
from meshmatch.fitting.judge.features import (
    Signs,
    cloud_allowance,
    connected_parts,
    multipart_allowance,
    signs_of,
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
    """A verdict, why it is not good, and by what signs."""

    verdict: Verdict
    reasons: tuple[Reason, ...]
    signs: Signs

    @property
    def trust(self) -> float:
        """How far (0..1) the fit can be trusted."""
        return self.signs.trust


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

    parts = task.model.template.labels
    told = task.model.has_nodes and reads_alike(task.model)
    connected = connected_parts(task.shape, found.local)
    known = residual, parts, partial, spread_at if told else None, connected
    signs = signs_of(task.system, vectors, found.local, *known)
    return judge(signs) if task.shape.is_cloud else judge_with_allowance(signs, found.candidate.residual)


def judge_with_allowance(signs: Signs, residual: float) -> Judgement:
    """Verdict, reasons and trust of a fit of a mesh that has that ``residual``, some of it excused in ``signs``.

    What is excused makes no fit good: front and back of a figure of solids differ by no more than that.
    """
    judged = judge(signs)
    if judged.verdict != "good" or judge(replace(signs, residual=residual)).verdict == "good":
        return judged
    return replace(judged, verdict="fair", reasons=(Reason("residual", _gap(residual)),))


def judge(signs: Signs) -> Judgement:
    """Verdict, reasons and trust."""
    trust, reasons = signs.trust, _reasons(signs)
    lacking = max(signs.missed, signs.empty)
    if signs.partial:
        lost = f"{100 * signs.hidden:.0f} % of the template has no counterpart"
        reasons.append(Reason("part", f"taken for a part: {lost}"))
    if trust < FAIR_TRUST or signs.empty > _FAIR_SHARE or signs.hidden > _HIDDEN or signs.stretch > _FLAT:
        verdict: Verdict = "poor"
    elif (
        trust < GOOD_TRUST
        or signs.partial
        or lacking > _GOOD_SHARE
        or signs.stretch > _CRUSHED
        or signs.inverted > _FOLDED
    ):
        verdict = "fair"
    else:
        return Judgement("good", (), signs)
    if trust < GOOD_TRUST and not reasons:
        likely = f"{int(100 * trust)} % likely to be right, where a good fit needs {100 * GOOD_TRUST:.0f} %"
        reasons.append(Reason("doubt", likely))
    return Judgement(verdict, tuple(reasons), signs)


def _reasons(signs: Signs) -> list[Reason]:
    """Signs that speak against the fit."""
    unreached = f"{100 * signs.missed:.0f} % of the shape is not reached by the template"
    empty = f"{100 * signs.empty:.0f} % of the template lies where the shape has no surface"
    crushed = f"the template had to be stretched or compressed {np.exp(signs.stretch):.1f}-fold on average"
    facing = f"{100 * signs.against:.0f} % of the shape faces the other way than the template"
    unsure = f"what the network predicts for tilted and mirrored copies is {100 * signs.spread:.0f} % of sqrt(area) off"
    told: list[tuple[bool, ReasonCode, str]] = [
        (signs.residual > 0.0285, "residual", _gap(signs.residual)),
        (signs.missed > _GOOD_SHARE, "unreached", unreached),
        (signs.empty > _GOOD_SHARE, "empty", empty),
        (signs.torn > 0.02, "torn", f"{100 * signs.torn:.0f} % of neighbours on the shape belong far apart"),
        (signs.stretch > _CRUSHED, "crushed", crushed),
        (signs.inverted > _FOLDED, "folded", _folds(signs.inverted)),
        (signs.against > 0.1, "facing", facing),
        (signs.spread > 0.06, "unsure", unsure),
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
