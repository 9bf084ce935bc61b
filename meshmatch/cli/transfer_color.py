"""``meshmatch transfer-color``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import transfer_options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.options import RuleOptions, RunOptions, grouped


@grouped
def transfer_color(
    source: transfer_options.Source,
    target: transfer_options.Target,
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
    maps: transfer_options.MapOptions,
    rules: RuleOptions,
    run: RunOptions,
    values: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Transfer these numbers, a row per vertex of SRC (.npy .csv), not its colours."
        ),
    ] = None,
    picture: transfer_options.Picture = None,
) -> None:
    """Transfer vertex colours, or other numbers per vertex.

    They are interpolated within the faces of SRC. The VALUE of --blank is a number, one number for each column
    (1,0,0), or a colour (#ff0000).
    """
    from meshmatch.api.transfer import transfer_colors, transfer_values
    from meshmatch.shapes.files import load_shape
    from meshmatch.transfer import colors
    from meshmatch.transfer.value_files import Values, check_values_suffix, load_values, parse_blank, save_values

    transfer = transfer_options.Transfer(source, target, maps, run, Console(run.quiet))
    (colors.check_suffix if values is None else check_values_suffix)(output)
    with transfer.outputs([output], [values], picture) as (temporary,):
        a, b = load_shape(source), load_shape(target)
        given = None if values is None else load_values(values, a)
        here = colors.light_of(a) if given is None else given.numbers
        columns = 1 if here.ndim == 1 else here.shape[1]
        rule = rules.rule(None if rules.blank is None else parse_blank(rules.blank, columns).tolist())
        if given is None:
            result = transfer_colors(a, b, transfer, rule=rule)
            colors.save(temporary, b, result.data)
        else:
            result = transfer_values(a, b, given.numbers, transfer, rule=rule)
            save_values(temporary, Values(result.data, given.names), b)
    transfer_options.tell_low(transfer.console, result.low, rule.minimum)
    what = "colours" if given is None else f"{columns} number{'s' if columns > 1 else ''} each"
    transfer.console.say(f"wrote {output}: {what} for the {b.V} vertices of {transfer.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_light, compose_values

        if given is None:
            shown = compose_light((a, b), (here, colors.light(result.data)))
        else:
            title = given.names[0] if given.names else str(values and values.stem)
            title += "" if columns == 1 else f" (the first of {columns} numbers)"
            tables = [table if table.ndim == 1 else table[:, 0] for table in (here, result.data)]
            shown = compose_values((a, b), tables, title)
        transfer.draw(picture, result.maps, shown)
    if run.json:
        record = transfer.record(result.maps, float(result.confidence.mean()))
        record |= transfer_options.low_record(result.low, rule.minimum)
        print_json({"output": output, "picture": picture, "columns": columns} | record)
