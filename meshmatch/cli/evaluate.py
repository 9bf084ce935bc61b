"""``meshmatch evaluate``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from meshmatch.cli import options
from meshmatch.cli.claims import check_png, claimed
from meshmatch.cli.voice import Voice, print_json, print_rows

if TYPE_CHECKING:
    import numpy as np

    from meshmatch.maps.evaluate import Evaluation
    from meshmatch.shapes.shape import Shape


def evaluate(
    map_file: Annotated[Path, typer.Argument(metavar="MAP", help="A map that `meshmatch match` wrote.")],
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="The shape that it maps.")],
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="The shape that it maps to.")],
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="True pairs, a source vertex and a target vertex a line (.txt .csv .npy); or one column: the "
            "target vertex of every source vertex.",
        ),
    ] = None,
    points: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            metavar="FILE FILE",
            help="The truth as two lists: vertices of SOURCE, and the same points as vertices of TARGET.",
        ),
    ] = None,
    threshold: Annotated[
        float, typer.Option(min=0.0, metavar="CM", help="Give the share of errors over this many cm.")
    ] = 15.0,
    curve: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Draw the cumulative error curve (needs the truth).")
    ] = None,
    unit: Annotated[
        Literal["cm", "x100"],
        typer.Option(help="Of the curve: cm at 1.9 m2 of skin, or sqrt(area of the target) / 100."),
    ] = "cm",
    seed: options.Seed = 0,
    json: options.Json = False,
) -> None:
    """Measure how good a map is.

    Coverage always, distortion between meshes, and errors where the truth is known: geodesic distances on
    TARGET, over the square root of its area and times 100; and in centimetres with TARGET scaled to 1.9
    square metres, the skin of a person.
    """
    import numpy as np

    from meshmatch.errors import OptionError
    from meshmatch.maps.curve import draw_curves
    from meshmatch.maps.evaluate import evaluate_map
    from meshmatch.maps.files import load_map
    from meshmatch.shapes.files import load_shape

    if truth is not None and points is not None:
        raise OptionError("--truth and --points both give the truth", "choose one of them")
    if curve is not None and truth is None and points is None:
        raise OptionError("a curve of errors needs the truth", "give it with --truth or --points")
    check_png(curve)
    with claimed(curve) as drawing:  # a picture that cannot be written is told before the geodesics
        shapes = load_shape(source), load_shape(target)
        found = load_map(map_file, *shapes)
        known = _known(truth, points, shapes[0])
        result = evaluate_map(found, *shapes, *known, rng=np.random.default_rng(seed))
        if drawing is not None and result.errors is not None:
            limit = 20.0 if unit == "cm" else 25.0
            draw_curves({found.source or source.stem: result.errors}, drawing, limit, unit=unit)
    for reason in found.reasons:
        Voice().say(f"note: {reason}")
    if json:
        print_json(dict(result.as_dict(threshold)))
    else:
        print_rows(_rows(result, threshold))


def _known(
    truth: Path | None, points: tuple[Path, Path] | None, source: "Shape"
) -> "tuple[np.ndarray | None, np.ndarray | None]":
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


def _rows(result: "Evaluation", threshold: float) -> list[tuple[str, str, str]]:
    rows = []
    if result.errors is not None:
        errors = result.errors
        rows += [
            ("mean error", f"{errors.mean_cm:.2f} cm", f"{100 * errors.mean:.2f} x 0.01 sqrt(area)"),
            ("median error", f"{errors.median_cm:.2f} cm", f"{100 * errors.median:.2f} x 0.01 sqrt(area)"),
            (f"over {threshold:g} cm", f"{100 * errors.share_over(threshold):.2f} %", ""),
            ("points", f"{errors.values.size}", f"geodesic: {result.geodesic}"),
        ]
    rows += [
        ("coverage", f"{100 * result.coverage.vertices:.1f} %", "of the target's vertices"),
        ("", f"{100 * result.coverage.area:.1f} %", "of the target's area"),
    ]
    if result.distortion is not None:
        rows.append(("distortion", f"{result.distortion:.4f}", "sqrt(area), between random pairs of points"))
    return rows
