"""``meshmatch transfer-labels``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from meshmatch.cli import transfer_options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.options import RuleOptions, RunOptions, grouped

On = Literal["vertices", "faces"]


@grouped
def transfer_labels(
    source: transfer_options.Source,
    target: transfer_options.Target,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Labels: .npy .csv .txt .json, or TGT as .ply.")
    ],
    labels: Annotated[
        Path,
        typer.Option(metavar="FILE", help="A whole number or a word per vertex or face of SRC: .npy .csv .txt .json."),
    ],
    maps: transfer_options.MapOptions,
    rules: RuleOptions,
    run: RunOptions,
    on: Annotated[
        On | None, typer.Option(help="What the labels of FILE belong to. Default: told by their number.")
    ] = None,
    to: Annotated[On | None, typer.Option(help="What of TGT gets labels. Default: the same.")] = None,
    picture: transfer_options.Picture = None,
) -> None:
    """Transfer labels of vertices or faces.

    Labels are voted on and never averaged. The VALUE of --blank is a label, such as -1 or unknown; TGT also gets it
    where SRC has no label.
    """
    import numpy as np

    from meshmatch.api.transfer import transfer_labels as transferred
    from meshmatch.shapes.files import load_shape
    from meshmatch.transfer.label_files import check_labels_suffix, load_labels, save_labels

    transfer = transfer_options.Transfer(source, target, maps, run, Console(run.quiet))
    rule = rules.rule(rules.blank)
    check_labels_suffix(output)
    with transfer.outputs([output], [labels], picture) as (temporary,):
        a, b = load_shape(source), load_shape(target)
        given = load_labels(labels, a, on)
        result = transferred(a, b, given, transfer, to=to, rule=rule)
        found = result.data
        save_labels(temporary, found, b)
    transfer_options.tell_low(transfer.console, result.low, rule.minimum, found.on)
    used = len(np.unique(found.codes))
    transfer.console.say(
        f"wrote {output}: {used} different labels on the {len(found.codes)} {found.on} of {transfer.names[1]}"
    )
    if picture is not None:
        from meshmatch.render.compose import compose_labels

        names = [str(name) for name in given.names]
        theirs = np.where(found.codes < len(names), found.codes, -1)  # a blank comes after the names
        faces = given.on == "faces", found.on == "faces"
        shown = compose_labels((a, b), (given.codes, theirs), names, faces)
        transfer.draw(picture, result.maps, shown)
    if run.json:
        record = transfer.record(result.maps, float(result.maps.backward.confidence.mean()))
        record |= transfer_options.low_record(result.low, rule.minimum)
        ends = {"from": given.on, "to": found.on, "labels": used}
        print_json({"output": output, "picture": picture} | ends | record)
