"""``meshmatch transfer-weights``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import transfer_options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.options import RunOptions, grouped


@grouped
def transfer_weights(
    source: transfer_options.Source,
    target: transfer_options.Target,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="Skin weights of TGT: .npz .json.")],
    maps: transfer_options.MapOptions,
    run: RunOptions,
    weights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Skin weights of SRC: .npz .json .glb. Default: the skin in SRC."),
    ] = None,
    influences: Annotated[int, typer.Option(min=1, help="Maximum number of joints per vertex.")] = 4,
    fill: Annotated[
        bool, typer.Option("--fill", help="Replace weights of low confidence by those of their neighbours.")
    ] = False,
    min_confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Minimum confidence for weights to be trusted.")
    ] = 0.3,
    picture: transfer_options.Picture = None,
) -> None:
    """Transfer skin weights.

    They are interpolated within the faces of SRC; each vertex keeps its heaviest joints, and their weights sum to 1.
    """
    import numpy as np

    from meshmatch.api.results import ConfidenceRule
    from meshmatch.api.transfer import transfer_weights as transferred
    from meshmatch.errors import InputError
    from meshmatch.shapes.files import load_shape
    from meshmatch.transfer.weight_files import check_weights_suffix, load_weights, save_weights

    transfer = transfer_options.Transfer(source, target, maps, run, Console(run.quiet))
    rule = ConfidenceRule(min_confidence, fill)
    check_weights_suffix(output)
    with transfer.outputs([output], [weights], picture) as (temporary,):
        a, b = load_shape(source), load_shape(target)
        if weights is None and source.suffix.lower() not in (".glb", ".gltf"):
            raise InputError(f"{a.name} has no skin weights", "give them in a file: --weights weights.npz")
        given = load_weights(weights or source, a)
        result = transferred(a, b, given, transfer, influences=influences, rule=rule)
        matrix = result.data.matrix
        save_weights(temporary, result.data)
    transfer_options.tell_low(transfer.console, result.low, min_confidence)
    bare = int((np.diff(matrix.indptr) == 0).sum())
    if bare:
        transfer.console.warn(f"{bare} of the {b.V} vertices have no weights: no joint moves them on {a.name}")
    used = len(np.unique(matrix.indices))
    transfer.console.say(f"wrote {output}: weights of {used} joints for the {b.V} vertices of {transfer.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_labels
        from meshmatch.transfer.attributes import most_votes

        shown = compose_labels((a, b), (most_votes(given.matrix), most_votes(matrix)), given.names)
        transfer.draw(picture, result.maps, shown)
    if run.json:
        record = transfer.record(result.maps, float(result.confidence.mean()))
        record |= transfer_options.low_record(result.low, min_confidence)
        counts = {"joints": len(given.names), "used_joints": used, "without_weights": bare}
        print_json({"output": output, "picture": picture} | counts | record)
