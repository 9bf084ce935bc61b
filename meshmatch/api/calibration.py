"""Calibration of a model's verdicts: reference values from fits of shapes of its kind, stored on the model card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshmatch.api.matcher import Matcher
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig, LatentRefineConfig
from meshmatch.fitting.reference_statistics import MIN_FITS, STATISTICS_KEY
from meshmatch.models.card import ModelCard, write_card
from meshmatch.models.registry import CARD, find_model
from meshmatch.outputs import as_path
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import SUFFIXES, ShapeLike
from meshmatch.shapes.input_files import suffix_of

DEFAULT_COUNT = 12
"""Default number of shapes to fit."""
SEARCH_STEPS = 400
"""Steps of the latent code search for a pointwise model; a normal fit takes 2,000 steps and five minutes. For a femur, 400
steps changed residual and stretch from 0.0197 and 0.071 to 0.0185 and 0.057; 2,000 steps to 0.0195 and 0.042."""
_NORMALISED = "normalised"  # subfolder of a prepared folder


def calibrate(
    model: str | Path,
    shapes: str | Path | Sequence[ShapeLike],
    *,
    count: int = DEFAULT_COUNT,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> ModelCard:
    """Calibrate the verdicts of a model that was trained without correspondence.

    Fit sound shapes of the model's kind, and store on its card the median stretch of the template and the median residual.
    Later fits are judged relative to these values: their trust becomes a probability, and their verdict can be "good".
    ``meshmatch train --shapes`` does this at the end of the training.

    Parameters
    ----------
    model
        Folder or name of the model.
    shapes
        A folder that `prepare` wrote, any other folder of shapes, or shapes as in `match`. Most should be complete and of
        the model's kind.
    count
        How many of the shapes to fit, evenly spaced in their order; at least 5.
    threads
        How many shapes are fitted at once; 2 by default.
    progress
        As in `match`.

    Returns
    -------
    ModelCard
        The new card, with the medians in ``metrics["usual"]``.

    Raises
    ------
    ModelError
        There is no such model, it is damaged, or it learned correspondence, and its fits need no calibration.
    InputError
        Fewer than five shapes can be fitted.
    OptionError
        ``count`` is below five.
    OutputError
        The card cannot be written.

    Examples
    --------
    >>> meshmatch.train("my-model", shapes="my-prepared")
    >>> card = meshmatch.calibrate("my-model", "my-prepared")
    >>> card.metrics["usual"]["stretch"], card.metrics["usual"]["residual"]
    """
    folder, card = find_model(model)
    if card.correspondence:
        raise ModelError(
            f"{card.name} learned correspondence and needs no calibration", "its fits are judged as they are"
        )
    if count < MIN_FITS:
        raise OptionError(f"{count} shapes are too few for a calibration", f"use {MIN_FITS} or more")
    given = list_shapes(as_path(shapes)) if isinstance(shapes, str | Path) else list(shapes)
    if len(given) < MIN_FITS:
        raise _too_few_error(len(given))
    chosen = [given[k] for k in np.unique(np.linspace(0, len(given) - 1, min(count, len(given))).round().astype(int))]
    config = FitConfig(latent=LatentRefineConfig(steps=SEARCH_STEPS))
    matcher = Matcher(folder, config, threads=threads, progress=progress)
    fits = [fit for fit in matcher.fit_all(chosen, errors="return") if isinstance(fit, Fit) and fit.signs is not None]
    if len(fits) < MIN_FITS:
        raise _too_few_error(len(fits))
    usual = {"fits": len(fits), "residual": float(np.median([fit.residual for fit in fits]))}
    usual["stretch"] = float(np.median([fit.signs.stretch for fit in fits if fit.signs is not None]))
    card = replace(
        card, metrics=card.metrics | {STATISTICS_KEY: {name: round(value, 5) for name, value in usual.items()}}
    )
    write_card(card, folder / CARD)
    return card


def _too_few_error(count: int) -> InputError:
    return InputError(f"{count} shapes that can be fitted are too few for a calibration", f"give {MIN_FITS} or more")


def list_shapes(folder: Path) -> list[Path]:
    """List the shapes of a folder; for a prepared folder, its normalised shapes. `InputError` if there are none."""
    inside = folder / _NORMALISED if (folder / _NORMALISED).is_dir() else folder
    files = [file for file in sorted(inside.glob("*")) if file.is_file() and suffix_of(file) in SUFFIXES]
    if not files:
        raise InputError(f"there are no shapes in {inside}", f"read are {', '.join(SUFFIXES)}")
    return files
