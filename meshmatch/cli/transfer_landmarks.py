"""``meshmatch transfer-landmarks``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import transfer_options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.options import RunOptions, grouped

_FAR = 0.02  # of the size of a shape: a landmark this far from its surface is worth a warning


@grouped
def transfer_landmarks(
    source: transfer_options.Source,
    target: transfer_options.Target,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="Landmarks of TGT: .csv .json .pp.")],
    landmarks: Annotated[
        Path,
        typer.Option(
            "--landmarks",
            metavar="FILE",
            help="Landmarks of SRC, as vertices or positions: .csv .json, MeshLab's .pp, or .txt .npy of vertices.",
        ),
    ],
    maps: transfer_options.MapOptionsWithPairs,
    run: RunOptions,
    min_confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Landmarks of less confidence are named.")
    ] = 0.3,
    picture: transfer_options.Picture = None,
) -> None:
    """Transfer landmarks to exact points on the surface of another shape.

    The output has for each: its vertex, its position, its face with barycentric weights, and its confidence (.csv,
    .json); or name and position (.pp). A position in FILE stands for the nearest point of SRC.
    """
    import numpy as np

    from meshmatch.api.results import ConfidenceRule
    from meshmatch.api.transfer import transfer_landmarks as transferred
    from meshmatch.shapes.files import load_shape
    from meshmatch.transfer.landmarks import check_landmarks_suffix, load_landmarks, save_landmarks

    transfer = transfer_options.Transfer(source, target, maps, run, Console(run.quiet))
    console = transfer.console
    check_landmarks_suffix(output)
    with transfer.outputs([output], [landmarks], picture) as (temporary,):
        a, b = load_shape(source), load_shape(target)
        given, furthest = load_landmarks(landmarks, a)
        if furthest > _FAR * a.diagonal:
            console.warn(
                f"a landmark lies {furthest:.4g} from {a.name}, {100 * furthest / a.diagonal:.0f} % of its size: the "
                "nearest point of the surface was taken"
            )
        result = transferred(a, b, given, transfer, rule=ConfidenceRule(min_confidence))
        found = result.data
        save_landmarks(temporary, found)
    low = np.flatnonzero(found.confidence < min_confidence)
    for k in low[:10].tolist():
        console.warn(f"landmark {found.names[k]} is uncertain: its confidence is {found.confidence[k]:.2f}")
    if len(low) > 10:
        console.warn(f"so are {len(low) - 10} more")
    console.say(f"wrote {output}: {len(found.names)} landmarks on {transfer.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_points

        transfer.draw(picture, result.maps, compose_points((a, b), (given.points, found.points)))
    if run.json:
        counts = {"min_confidence": min_confidence, "low_confidence": len(low)}
        record = transfer.record(result.maps, float(result.maps.forward.confidence.mean()))
        print_json({"output": output, "picture": picture, "landmarks": len(found.names)} | counts | record)
