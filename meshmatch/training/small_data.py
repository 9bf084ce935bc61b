"""Learning from a few shapes: a small network, and how a folder of few registered shapes is learned."""

from __future__ import annotations

from pathlib import Path

from meshmatch.models.deformer import NetworkConfig
from meshmatch.templates.registered import FEW
from meshmatch.templates.unregistered import prepared_words
from meshmatch.training.loop import TrainConfig
from meshmatch.training.losses import LossConfig
from meshmatch.training.run import Recipe
from meshmatch.training.scans import ScanConfig


def few_recipe() -> Recipe:
    """The recipe for few shapes: a small network that finds no orientation; the card says how shapes are turned."""
    network = NetworkConfig(
        code=128, width=256, depth=1, basis=384, align_basis=0, corrections=2, correct_width=256
    )
    loss = LossConfig(volume=1e-3, arap=1e-3, blend=1e-3, robust=True)
    train = TrainConfig(
        steps=3000, shapes=8, scans_per_shape=1, decay=0.5, warm_up=100, average=0.99, loss=loss, workers=0
    )
    return Recipe(network, train, ScanConfig(points=1024), "smooth")


def frame_of_few(folder: str | Path) -> dict[str, str] | None:
    """What a card says of orientation and scale for a prepared folder of few registered shapes; None for others, and for
    those of equal radii: registered shapes are learned at equal areas."""
    try:
        words = prepared_words(folder)
        if not words["registered"] or words["scale"] != "area" or len(words["names"]) >= FEW:
            return None
        return {"orientation": str(words["align"]), "scale": "area"}
    except (OSError, ValueError, KeyError, TypeError):
        return None  # whoever reads its shapes says what is wrong with the folder
