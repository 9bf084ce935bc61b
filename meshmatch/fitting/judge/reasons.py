"""The words of a verdict: good, fair or poor, and the reasons why it is not good."""

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
"""Template and shape stay apart; some of the shape is not reached; template lies where the shape has no surface;
neighbours belong far apart; the template is stretched or compressed; it is folded, or inside out, in places; pieces of a
part lie beside it; a part ends where the shape has no edge; a knee bends forward; the shape faces the other way; the network
predicts other points for tilted and mirrored copies of the shape; no feature alone, but all together; it was taken for a
part; its mirror image fits as well; the model was learned without
correspondence, or there was none; other fits are equally good; it stands out of its collection."""
SIDE_IN_DOUBT = "its mirror image fits nearly as well: left and right may be exchanged"


class Reason(str):
    """Why a verdict is not good: a string with a sentence to print, and a ``code`` to branch on.

    The codes are "residual", "unreached", "empty", "torn", "crushed", "folded", "pieces", "uncut", "bent", "facing",
    "unsure", "doubt", "part", "side", "unsupervised", "ambiguous" and "outlier".

    Parameters
    ----------
    code
        One of these.
    sentence
        For people; may be worded differently in another version.

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
