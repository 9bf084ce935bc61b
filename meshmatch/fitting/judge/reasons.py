"""Verdicts (good, fair, poor), and the reasons why a verdict is not good."""

from __future__ import annotations

from typing import Literal

Verdict = Literal["good", "fair", "poor"]
ReasonCode = Literal[
    "residual",
    "unreached",
    "empty",
    "torn",
    "crushed",
    "folded",
    "pieces",
    "uncut",
    "bent",
    "facing",
    "unsure",
    "doubt",
    "part",
    "side",
    "unsupervised",
    "ambiguous",
    "outlier",
]
"""In this order: template and shape stay apart; some of the shape is not reached; template lies where the shape has no
surface; neighbours are mapped far apart; the template is stretched or compressed; it is folded or inside out in places;
separate pieces of a part lie next to it; a part ends where the shape has no edge; a knee bends forward; the shape faces
the other way; the network predicts other points for tilted and mirrored copies of the shape; no single feature, but all
together; it was fitted as a part; its mirror image fits as well; the model was trained without correspondence, or there
was none; other fits are equally good; it is an outlier of its collection."""
SIDE_IN_DOUBT = "its mirror image fits nearly as well: left and right may be exchanged"


class Reason(str):
    """Why a verdict is not good: a string with a sentence for people, and a ``code`` for programs.

    The codes are "residual", "unreached", "empty", "torn", "crushed", "folded", "pieces", "uncut", "bent", "facing",
    "unsure", "doubt", "part", "side", "unsupervised", "ambiguous" and "outlier".

    Parameters
    ----------
    code
        One of these.
    sentence
        The text; its wording may change between versions.

    Examples
    --------
    >>> fit = meshmatch.register("templates/samples/climber.ply")
    >>> torn = any(reason.code == "torn" for reason in fit.reasons)
    """

    code: ReasonCode

    def __new__(cls, code: ReasonCode, sentence: str) -> Reason:
        return super().__new__(cls, sentence)

    def __init__(self, code: ReasonCode, sentence: str) -> None:
        self.code = code

    def __reduce__(self) -> tuple[type[Reason], tuple[str, str]]:
        return Reason, (self.code, str(self))
