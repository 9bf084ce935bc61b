"""What is usual of a model's fits, found by fitting shapes of its kind, and kept on its card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshmatch.api.matcher import Matcher
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig, LatentRefineConfig
from meshmatch.fitting.usual import FEWEST, USUAL
from meshmatch.models.card import ModelCard, write_card
from meshmatch.models.registry import CARD, find_model
from meshmatch.outputs import as_path
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import SUFFIXES, ShapeLike
from meshmatch.shapes.input_files import suffix_of

COUNT = 12
"""Shapes that are fitted, where nobody says how many."""
SEARCHED = 400
"""Steps of the search for a code, of a pointwise model, where a fit takes 2,000 and five minutes. Of a femur they brought
residual and stretch from 0.0197 and 0.071 to 0.0185 and 0.057, all steps to 0.0195 and 0.042."""
_NORMALISED = "normalised"  # of a prepared folder


def calibrate(
    model: str | Path,
    shapes: str | Path | Sequence[ShapeLike],
    *,
    count: int = COUNT,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> ModelCard:
    """Fit sound shapes of its kind with a model that was trained without correspondence, and keep on its card what is usual:
    how much its template stretches, and how far it stays from the shapes.

    Fits by the model are then judged beside that: their trust is a probability, and they may be good. ``meshmatch train
    --shapes`` does it at its end.

    Parameters
    ----------
    model
        Folder of the model, or its name.
    shapes
        Most of them whole and of its kind: a folder that `prepare` made, or any other, or shapes as in `match`.
    count
        How many of them are fitted, evenly chosen; 5 or more.
    threads
        How many are fitted at once; 2 by default.
    progress
        As in `match`.

    Returns
    -------
    ModelCard
        As it is now; its ``metrics["usual"]`` are medians.

    Raises
    ------
    ModelError
        There is no such model, it is damaged, or it learned correspondence, whose fits need no comparison.
    InputError
        Fewer than five shapes can be fitted.
    OptionError
        ``count`` is less.
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
        raise ModelError(f"{card.name} learned correspondence: its fits are judged without others", "leave it as it is")
    if count < FEWEST:
        raise OptionError(f"{count} shapes are too few to say what is usual", f"take {FEWEST} or more")
    given = shapes_in(as_path(shapes)) if isinstance(shapes, str | Path) else list(shapes)
    if len(given) < FEWEST:
        raise _too_few(len(given))
    some = [given[k] for k in np.unique(np.linspace(0, len(given) - 1, min(count, len(given))).round().astype(int))]
    config = FitConfig(latent=LatentRefineConfig(steps=SEARCHED))
    matcher = Matcher(folder, config, threads=threads, progress=progress)
    fits = [fit for fit in matcher.fit_all(some, errors="return") if isinstance(fit, Fit) and fit.signs is not None]
    if len(fits) < FEWEST:
        raise _too_few(len(fits))
    usual = {"fits": len(fits), "residual": float(np.median([fit.residual for fit in fits]))}
    usual["stretch"] = float(np.median([fit.signs.stretch for fit in fits if fit.signs is not None]))
    card = replace(card, metrics=card.metrics | {USUAL: {name: round(value, 5) for name, value in usual.items()}})
    write_card(card, folder / CARD)
    return card


def _too_few(count: int) -> InputError:
    return InputError(f"{count} shapes that can be fitted are too few to say what is usual", f"give {FEWEST} or more")


def shapes_in(folder: Path) -> list[Path]:
    """The shapes of a folder; of one that `prepare` made, as it left them."""
    inside = folder / _NORMALISED if (folder / _NORMALISED).is_dir() else folder
    files = [file for file in sorted(inside.glob("*")) if file.is_file() and suffix_of(file) in SUFFIXES]
    if not files:
        raise InputError(f"there are no shapes in {inside}", f"read are {', '.join(SUFFIXES)}")
    return files
