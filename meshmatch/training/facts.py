"""Facts about a model that a training writes to its card."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from meshmatch.errors import OptionError
from meshmatch.models.card import ModelCard
from meshmatch.models.trained import TrainedModel


@dataclass(frozen=True)
class CardFacts:
    """Facts about a model for its card, see `ModelCard`; those left empty are filled in by the training.

    ``start`` is a model (or its name or folder) with the same template, network and kernel, whose weights training starts
    from.
    """

    name: str = ""  # by default the name of the output folder
    category: str = ""  # by default the model's name for a folder of shapes; "human" for bodies
    data: str = ""  # a sentence about the shapes
    licence: str = "unstated"
    stiffness: float = 1.0  # 0.05 suits shapes that vary more than bodies do, such as organs
    start: TrainedModel | str | Path | None = None
    mirror: str = ""  # "auto" if shapes come in left and right versions, or "no"
    frame: dict[str, str] | None = None  # by default determined by the shapes and the network
    measured: str = ""  # what the validation error was measured on; empty for newly generated shapes


def fill_from_card(facts: CardFacts, card: ModelCard) -> CardFacts:
    """Fill unset fields from the start model's card; `OptionError` if that was trained without correspondence."""
    if not card.correspondence:
        raise OptionError(
            f"{card.name} was trained without correspondence", "fit with a model that was trained with correspondence"
        )
    defaults = CardFacts()
    names = ("frame", "mirror", "category", "licence", "stiffness")
    unset = {name: getattr(card, name) for name in names if getattr(facts, name) == getattr(defaults, name)}
    return replace(facts, **unset)
