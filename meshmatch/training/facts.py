"""What a training is told about its model, for the card."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from meshmatch.errors import OptionError
from meshmatch.models.card import ModelCard
from meshmatch.models.trained import TrainedModel


@dataclass(frozen=True)
class CardFacts:
    """What a training is told about its model; goes onto the card, see `ModelCard`.

    Empty words are found out. The weights of ``start`` (a model of the same template, network and kernel, its name or
    folder) begin the training.
    """

    name: str = ""  # the output folder's
    category: str = ""  # of a folder of shapes the model's name; "human" for bodies
    data: str = ""  # a sentence about the shapes
    licence: str = "unstated"
    stiffness: float = 1.0  # 0.05 suits what differs more from shape to shape than bodies do, such as organs
    start: TrainedModel | str | Path | None = None
    mirror: str = ""  # "auto" for what comes in two sides, or "no"
    frame: dict[str, str] | None = None  # as the training's shapes and network say
    measured: str = ""  # what the validation error is of, unless it is of more of what is generated


def inherited(facts: CardFacts, card: ModelCard) -> CardFacts:
    """What is not said of a model is said of the one that it goes on from; `OptionError` if that may not teach."""
    if not card.correspondence:
        raise OptionError(
            f"{card.name} was trained without correspondence", "fit with a model that was trained with correspondence"
        )
    plain = CardFacts()
    names = ("frame", "mirror", "category", "licence", "stiffness")
    unsaid = {name: getattr(card, name) for name in names if getattr(facts, name) == getattr(plain, name)}
    return replace(facts, **unsaid)
