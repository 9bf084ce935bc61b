"""``meshmatch measure``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

import meshmatch
from meshmatch.cli.options import RunOptions, grouped, optional, output_option
from meshmatch.cli.targets import Gather, to_targets
from meshmatch.cli.transfer_options import MapOptionsWithPairs, Picture, Transfer
from meshmatch.cli.user_messages import Json
from meshmatch.errors import warn
from meshmatch.outputs import replace_on_success
from meshmatch.scalars import counted

_ROW = "{:<28} {:>10} {:>10}"
_Source = Annotated[
    Path,
    Argument(
        metavar="SRC",
        help="Shape with the landmarks that define the measurements; or the word body: an included person with its own "
        "landmarks and measurements.",
    ),
]


_Target = Annotated[Path, Argument(metavar="TGT", help="Shape to measure.")]


def _check_table(table: Path) -> None:
    from meshmatch.shapes.tables import check_suffix

    check_suffix(table, (".csv",), "a table of measurements")


def _check_points(given: Mapping[str, Any]) -> None:
    """Check that SRC has the landmarks of all measurements."""
    from meshmatch.api.measure import measuring_points

    measuring_points(given["source"], given["measurements"], given["landmarks"])


def _table(table: Path, given: Mapping[str, Any], source: str, written: Mapping[str, Path]) -> str:
    """Write the measurements of all targets, and of SRC unless it is the included body, as one table."""
    import numpy as np

    from meshmatch.api.measure import is_body, measuring_points
    from meshmatch.collections.registered import mixed_units
    from meshmatch.shapes.tables import write_rows
    from meshmatch.transfer.measurements import measured_values

    points = measuring_points(given["source"], given["measurements"], given["landmarks"])
    own = points.taken(points.points)
    values = {} if is_body(given["source"]) else {source: dict(zip(own.names, own.values.tolist(), strict=True))}
    values |= {name: measured_values(file) for name, file in written.items()}
    numbers = np.array([[row.get(name, np.nan) for name in own.names] for row in values.values()])
    with replace_on_success(table) as temporary:
        cells = zip(values, numbers.tolist(), strict=True)
        write_rows(temporary, ["name", *own.names], [[name, *map(_cell, row)] for name, row in cells])
    are_lengths = (np.array(own.kinds) != "angle") & (own.values > 0)
    lengths = numbers[:, are_lengths]
    known = np.isfinite(lengths).any(axis=1)
    if known.any():
        sizes = np.nanmedian(lengths[known] / own.values[are_lengths], axis=1)
        if units := mixed_units([name for name, there in zip(values, known, strict=True) if there], sizes):
            warn(units)
    return f"wrote {table}: {counted(len(own.names), 'measurement')} of {counted(len(values), 'shape')}"


def _cell(value: float) -> float | str:
    return value if value == value else ""


@grouped
@to_targets("measure", Gather(_check_table, _table), _check_points)
def measure(
    *,
    source: _Source,
    target: _Target,
    output: Path = output_option("FILE", "The measurements of TGT: .csv, or .json, which also has the measured lines."),
    measurements: Path | None = optional(
        "FILE",
        "The measurements: a .csv with a row for each, name,kind,landmark,landmark,... The kinds are distance (along "
        "straight lines through the landmarks), girth (around the part that the first landmark is on, perpendicular to the "
        "line from the second to the third) and angle (at the second of three, in degrees). Default for body: its own.",
    ),
    landmarks: Path | None = optional(
        "FILE", "Landmarks of SRC, in any format of `transfer-landmarks`. Default for body: its own."
    ),
    maps: MapOptionsWithPairs,
    run: RunOptions,
    min_confidence: float = Option(
        0.3,
        min=0.0,
        max=1.0,
        help="A distance or an angle is missing if a landmark is below this confidence, a girth if over a quarter of it is.",
    ),
    table: Path | None = optional("FILE", "With several targets, also write one table of all: .csv."),
    picture: Picture = None,
) -> Json:
    """Measure a shape: girths, lengths, angles.

    Each measurement is defined by landmarks of SRC, which are transferred to TGT, and is in the unit of TGT's file. A girth
    is measured as with a tape: it does not follow hollows. `meshmatch measure body scan.ply -o scan.csv` takes 30
    measurements of a person in any pose.
    """
    import numpy as np

    from meshmatch.api.measure import measure_inputs, measuring_points
    from meshmatch.transfer.measurements import check_measurements_suffix

    path, defined, marks = measure_inputs(source, measurements, landmarks)
    assert isinstance(path, Path)
    transfer = Transfer(path, target, output, maps, run, picture)
    console = transfer.console
    check_measurements_suffix(output)
    with transfer.outputs(measurements, landmarks) as (temporary,):
        rule = meshmatch.ConfidenceRule(min_confidence)
        result = meshmatch.measure(path, target, defined, marks, transfer, rule=rule)
        found = result.data
        result.writer(temporary, output)
    console.say(_ROW.format("measurement", "value", "confidence"))
    for name, value, confidence in zip(found.names, found.values, found.confidence, strict=True):
        text = "missing" if np.isnan(value) else f"{value:.4g}"
        console.say(_ROW.format(name, text, "unknown" if np.isnan(confidence) else f"{confidence:.2f}"))
    lost = int(np.isnan(found.values).sum())
    if lost:
        why = "the confidence is too low there, or the map is discontinuous along a girth"
        console.warn(f"{transfer.names[1]}: {lost} of {len(found.names)} measurements are missing: {why}")
    text = "in the unit of its file; angles in degrees" if "angle" in found.kinds else "in the unit of its file"
    kept = counted(len(found.names) - lost, "measurement")
    console.say(f"wrote {output}: {kept} of {transfer.names[1]}, {text}")
    if picture is not None:
        from meshmatch.render.compose import compose_lines

        points = measuring_points(source, measurements, landmarks)
        there = np.flatnonzero(~np.isnan(found.values)).tolist()
        lines = [[each.lines[k] for k in there] for each in (points.taken(points.points), found)]
        transfer.draw(result.maps, compose_lines((result.maps.source, result.maps.target), lines))
    values = {
        name: None if np.isnan(value) else float(value) for name, value in zip(found.names, found.values, strict=True)
    }
    counts = {"measurements": values, "min_confidence": min_confidence, "missing": lost}
    return transfer.record({"picture": picture} | counts, result.maps, float(result.maps.forward.confidence.mean()))
