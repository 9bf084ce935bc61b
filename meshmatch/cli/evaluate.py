"""``meshmatch evaluate``."""

from pathlib import Path
from typing import TYPE_CHECKING

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options
from meshmatch.cli.words import Console, print_json, print_rows
from meshmatch.errors import OptionError

if TYPE_CHECKING:
    from meshmatch.maps.evaluate import Evaluation


def evaluate(
    *,
    map_file: Path = Argument(..., metavar="MAP", help="A map that `meshmatch match` wrote."),
    source: Path = Argument(..., metavar="SOURCE", help="The shape that it maps."),
    target: Path = Argument(..., metavar="TARGET", help="The shape that it maps to."),
    truth: options.Truth = None,
    points: options.Points = None,
    threshold: float = Option(15.0, min=0.0, metavar="CM", help="Give the share of errors over this many cm."),
    curve: Path | None = options.optional(
        "FILE", "Draw the cumulative error curve, .png, .svg or .pdf (needs the truth)."
    ),
    picture: Path | None = options.optional("PNG", "Draw both shapes, the errors as a color map (needs the truth)."),
    unit: options.ErrorUnit = Option(
        "cm", help="Of curve and picture: cm at 1.9 m2 of skin, or sqrt(area of the target) / 100."
    ),
    seed: options.Seed = 0,
    json: options.Json = False,
) -> None:
    """Measure how good a map is.

    Coverage always, distortion between meshes, and errors where the truth is known: geodesic distances on
    TARGET, over the square root of its area and times 100; and in centimetres with TARGET scaled to 1.9
    square metres, the skin of a person.
    """
    told = options.check_truth(truth, points)
    for what, file in (("curve", curve), ("picture", picture)):
        if file is not None and not told:
            raise OptionError(f"a {what} of errors needs the truth", "give it with --truth or --points")
    options.check_outputs([map_file, source, target, truth, *(points or ())], chart=curve, picture=picture)
    shapes = meshmatch.load_shape(source), meshmatch.load_shape(target)
    found = meshmatch.load_map(map_file, *shapes)
    known = options.load_truth(truth, points, shapes[0])
    result = meshmatch.evaluate(found, *shapes, known, seed=seed)
    if known is not None and result.errors is not None:
        if curve is not None:
            from meshmatch.render.charts import draw_curves

            limit = 20.0 if unit == "cm" else 25.0
            draw_curves({found.source or source.stem: result.errors}, curve, limit, unit=unit)
        if picture is not None:
            from meshmatch.render.compose import compose_errors

            compose_errors(*shapes, found, known, result.errors, unit).render(picture)
    Console().say(*(f"note: {reason}" for reason in found.reasons))
    if json:
        print_json(dict(result.as_dict(threshold)))
    else:
        print_rows(_rows(result, threshold))


def _rows(result: "Evaluation", threshold: float) -> list[tuple[str, str, str]]:
    rows = []
    if (errors := result.errors) is not None:
        rows = [
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
