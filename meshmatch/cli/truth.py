"""What is known about the true map, as verbs are told it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import numpy as np

    from meshmatch.shapes.shape import Shape

Truth = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="True pairs, a source vertex and a target vertex a line (.txt .csv .npy); or one column: the "
        "target vertex of every source vertex.",
    ),
]
Points = Annotated[
    tuple[Path, Path] | None,
    typer.Option(
        metavar="FILE FILE",
        help="The truth as two lists: vertices of SOURCE, and the same points as vertices of TARGET.",
    ),
]


def check_truth(truth: Path | None, points: tuple[Path, Path] | None) -> bool:
    """Whether the truth is known; refuse to be told it twice (`OptionError`)."""
    from meshmatch.errors import OptionError

    if truth is not None and points is not None:
        raise OptionError("--truth and --points both give the truth", "choose one of them")
    return truth is not None or points is not None


def load_truth(
    truth: Path | None, points: tuple[Path, Path] | None, source: "Shape"
) -> "tuple[np.ndarray, np.ndarray] | tuple[None, None]":
    """True points on source and target; (None, None) if nothing is known."""
    import numpy as np

    from meshmatch.errors import InputError
    from meshmatch.maps.pairs import load_pairs, load_points

    if points is not None:
        return load_points(points[0]), load_points(points[1])
    if truth is None:
        return None, None
    try:
        return load_pairs(truth)
    except InputError:
        column = load_points(truth)  # its error is the one to tell: a column is the simpler form
    if len(column) != source.V:
        raise InputError(
            f"{truth.name} has {len(column)} entries, but {source.name} has {source.V} vertices",
            "a truth of one column has an entry for every vertex of the source",
        )
    return np.arange(source.V), column
