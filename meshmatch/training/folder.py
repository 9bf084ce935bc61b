"""The folder that a training writes into: the checkpoint that it goes on from, and the end that every training has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from meshmatch.models.deformer import Deformer
from meshmatch.training.loop import Progress, Trainer

VALIDATION_SEED = 999_983
"""Of the batch that no training sees and every training is measured on."""


def checkpoint_in(output: Path) -> Path:
    """Where the checkpoint of a training into a folder lies."""
    return output / "checkpoint" / "last.safetensors"


def train_into(
    output: Path,
    trainer: Trainer,
    data: torch.utils.data.Dataset,
    measure: Callable[[Deformer], float],
    write: Callable[[float], None],
    resume: bool,
    progress: Callable[[Progress], None] | None,
) -> Path:
    """Train, or go on from the folder's checkpoint; then measure the averaged weights, and write them.

    Parameters
    ----------
    output : Path
        The model folder.
    measure : callable
        The error of a network on what it has not seen.
    write : callable
        Writes the model, given the error of its averaged weights. Of several processes one calls it.

    Returns
    -------
    Path
        The model folder.
    """
    checkpoint = checkpoint_in(output)
    if resume and checkpoint.is_file():
        trainer.load(checkpoint)
        for name in ("encoder", "aligner"):  # what reads the batches are copies (see `build_dataset`)
            if (reader := getattr(data, name, None)) is not None:
                reader.load_state_dict(getattr(trainer.model, name).state_dict())
    trainer.run(data, checkpoint, progress, measure)
    trainer.close()
    if trainer.rank == 0:
        trainer.model.load_state_dict(trainer.averaged_state())
        write(measure(trainer.model))
    return output
