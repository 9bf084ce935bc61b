"""``meshmatch transfer-color``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import carrying, options
from meshmatch.cli.console import Console, print_json


def transfer_color(
    source: carrying.Source,
    target: carrying.Target,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="TGT with colours: .ply .glb .obj .off, or the colours alone: .npy .csv. With --values: .npy "
            ".csv .ply.",
        ),
    ],
    values: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Carry these numbers, a row for each vertex of SRC (.npy .csv), instead of its colours.",
        ),
    ] = None,
    map: carrying.MapOption = None,
    fill: carrying.Fill = False,
    blank: carrying.Blank = None,
    min_confidence: carrying.Least = carrying.LEAST,
    picture: carrying.Picture = None,
    model: options.Model = "human",
    refine: options.RefineOption = "nodes",
    up: options.Up = None,
    front: options.Front = None,
    seed: options.Seed = 0,
    strict: options.Strict = False,
    json: options.Json = False,
    threads: options.Threads = 2,
    quiet: options.Quiet = False,
) -> None:
    """Carry colours, or other numbers of each vertex, from one shape to another.

    They are interpolated within the faces of SRC. What --blank writes is a number, as many numbers as there
    are columns (1,0,0), or a colour (#ff0000).
    """
    from meshmatch.threads import set_threads

    set_threads(1)
    import numpy as np

    from meshmatch.errors import OptionError
    from meshmatch.shapes.files import load_shape
    from meshmatch.transfer import colors
    from meshmatch.transfer.attributes import pull_values
    from meshmatch.transfer.low_confidence import replace_low_values
    from meshmatch.transfer.value_files import (
        Values,
        check_values_suffix,
        load_values,
        parse_blank,
        save_values,
    )

    request = carrying.Request(source, target, map, model, refine, seed, up, front, strict, threads)
    carrying.check_request(request, fill, blank)
    if values is not None:
        check_values_suffix(output)
    else:
        colors.check_suffix(output)
    carrying.check_picture(request, picture, [output, values])
    voice = Console(quiet)
    with carrying.output_file(request, output, [values]) as temporary:
        a, b = load_shape(source), load_shape(target)
        given = colors.of_shape(a) if values is None else load_values(values, a)
        columns = 1 if given.numbers.ndim == 1 else given.numbers.shape[1]
        empty = None if blank is None else parse_blank(blank, columns)
        if empty is not None and values is None and not ((empty >= 0) & (empty <= 1)).all():
            raise OptionError(f"--blank {blank}: colours lie in 0..1", "such as 0.5,0.5,0.5 or #808080")
        if empty is not None and values is None:
            empty = colors.light(empty)
        result = carrying.find_maps(request, voice, a, b)
        carried = pull_values(result.back, given.numbers)
        carried, doubt = replace_low_values(
            carried, result.back.confidence.astype(np.float64), b, min_confidence, empty, fill
        )
        if values is None:
            colors.save(temporary, b, carried)
        else:
            save_values(temporary, Values(carried, given.names), b)
    carrying.tell_doubt(voice, doubt, min_confidence)
    what = "colours" if values is None else f"{columns} number{'s' if columns > 1 else ''} each"
    voice.say(f"wrote {output}: {what} for the {b.V} vertices of {request.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_light, compose_values

        if values is None:
            shown = compose_light((a, b), (given.numbers, carried))
        else:
            title = given.names[0] if given.names else values.stem
            title += "" if columns == 1 else f" (the first of {columns} numbers)"
            tables = [table if table.ndim == 1 else table[:, 0] for table in (given.numbers, carried)]
            shown = compose_values((a, b), tables, title)
        carrying.draw(request, voice, picture, (a, b), result, shown)
    if json:
        drawn = None if picture is None else str(picture)
        record = carrying.map_record(request, result, result.back)
        record |= carrying.doubt_record(doubt, min_confidence)
        print_json({"output": str(output), "picture": drawn, "columns": columns} | record)
