"""``meshmatch transfer-weights``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import carrying, options
from meshmatch.cli.console import Console, print_json


def transfer_weights(
    source: carrying.Source,
    target: carrying.Target,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Where the skin weights go: .npz .json.")
    ],
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Skin weights of SRC: .npz .json .glb. Else the skin of SRC itself."
        ),
    ] = None,
    influences: Annotated[int, typer.Option(min=1, help="How many joints may move a vertex.")] = 4,
    map: carrying.MapOption = None,
    fill: carrying.Fill = False,
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
    """Carry skin weights from one shape to another.

    They are interpolated within the faces of SRC; each vertex keeps its heaviest joints, and their weights sum
    to 1.
    """
    from meshmatch.threads import set_threads

    set_threads(1)
    import numpy as np

    from meshmatch.errors import InputError
    from meshmatch.shapes.files import load_shape
    from meshmatch.transfer.attributes import pull_weights
    from meshmatch.transfer.low_confidence import replace_low_weights
    from meshmatch.transfer.weight_files import SkinWeights, check_weights_suffix, load_weights, save_weights

    request = carrying.Request(source, target, map, model, refine, seed, up, front, strict, threads)
    carrying.check_request(request, fill)
    check_weights_suffix(output)
    carrying.check_picture(request, picture, [output, weights])
    voice = Console(quiet)
    with carrying.output_file(request, output, [weights]) as temporary:
        a, b = load_shape(source), load_shape(target)
        if weights is None and source.suffix.lower() not in (".glb", ".gltf"):
            raise InputError(f"{a.name} holds no skin weights", "give them in a file: --weights weights.npz")
        given = load_weights(weights or source, a)
        result = carrying.find_maps(request, voice, a, b)
        confidence = result.back.confidence.astype(np.float64)
        carried = pull_weights(result.back, given.matrix, influences)
        carried, doubt = replace_low_weights(carried, confidence, b, min_confidence, fill, influences)
        save_weights(temporary, SkinWeights(carried, given.names))
    carrying.tell_doubt(voice, doubt, min_confidence)
    bare = int((np.diff(carried.indptr) == 0).sum())
    if bare:
        voice.warn(f"{bare} of the {b.V} vertices have no weights, because nothing moves them on {a.name}")
    joints = len(np.unique(carried.indices))
    voice.say(f"wrote {output}: weights of {joints} joints for the {b.V} vertices of {request.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_labels
        from meshmatch.transfer.attributes import most_votes

        heaviest = most_votes(given.matrix), most_votes(carried)
        shown = compose_labels((a, b), heaviest, given.names)
        carrying.draw(request, voice, picture, (a, b), result, shown)
    if json:
        drawn = None if picture is None else str(picture)
        record = carrying.map_record(request, result, result.back)
        record |= carrying.doubt_record(doubt, min_confidence)
        counts = {"joints": len(given.names), "used_joints": joints, "without_weights": bare}
        print_json({"output": str(output), "picture": drawn} | counts | record)
