"""``meshmatch evaluate``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from meshmatch.cli import options
from meshmatch.cli import truth as truths
from meshmatch.cli.console import Console, print_json, print_rows
from meshmatch.cli.output_paths import check_chart, check_distinct, check_png, claimed

if TYPE_CHECKING:
    from meshmatch.maps.evaluate import Evaluation


def evaluate(
    map_file: Annotated[Path, typer.Argument(metavar="MAP", help="A map that `meshmatch match` wrote.")],
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="The shape that it maps.")],
    target: Annotated[Path, typer.Argument(metavar="TARGET", help="The shape that it maps to.")],
    truth: truths.Truth = None,
    points: truths.Points = None,
    threshold: Annotated[
        float, typer.Option(min=0.0, metavar="CM", help="Give the share of errors over this many cm.")
    ] = 15.0,
    curve: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the cumulative error curve, .png, .svg or .pdf (needs the truth)."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Draw both shapes, the errors as a color map (needs the truth).")
    ] = None,
    unit: Annotated[
        Literal["cm", "x100"],
        typer.Option(help="Of curve and picture: cm at 1.9 m2 of skin, or sqrt(area of the target) / 100."),
    ] = "cm",
    seed: options.Seed = 0,
    json: options.Json = False,
) -> None:
    """Measure how good a map is.

    Coverage always, distortion between meshes, and errors where the truth is known: geodesic distances on
    TARGET, over the square root of its area and times 100; and in centimetres with TARGET scaled to 1.9
    square metres, the skin of a person.
    """
    from meshmatch.api.evaluation import evaluate as evaluated
    from meshmatch.errors import OptionError
    from meshmatch.maps.files import load_map
    from meshmatch.render.charts import draw_curves
    from meshmatch.shapes.files import load_shape

    told = truths.check_truth(truth, points)
    if curve is not None and not told:
        raise OptionError("a curve of errors needs the truth", "give it with --truth or --points")
    if picture is not None and not told:
        raise OptionError("a picture of errors needs the truth", "give it with --truth or --points")
    check_chart(curve)
    check_png(picture)
    inputs = [map_file, source, target, truth, *(points or ())]
    check_distinct([curve, picture], inputs)
    # Pictures that cannot be written are told before the geodesics.
    with claimed(curve) as plot, claimed(picture) as drawing:
        shapes = load_shape(source), load_shape(target)
        found = load_map(map_file, *shapes)
        known = truths.load_truth(truth, points, shapes[0])
        result = evaluated(found, *shapes, None if known[0] is None else known, seed=seed)
        if plot is not None and result.errors is not None:
            limit = 20.0 if unit == "cm" else 25.0
            draw_curves({found.source or source.stem: result.errors}, plot, limit, unit=unit)
        if drawing is not None and result.errors is not None and known[0] is not None:
            from meshmatch.render.compose import compose_errors

            compose_errors(*shapes, found, known, result.errors, unit).render(drawing)
    for reason in found.reasons:
        Console().say(f"note: {reason}")
    if json:
        print_json(dict(result.as_dict(threshold)))
    else:
        print_rows(_rows(result, threshold))


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
