"""``meshmatch transfer-labels``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from meshmatch.cli import carrying, options
from meshmatch.cli.console import Console, print_json

On = Literal["vertices", "faces"]


def transfer_labels(
    source: carrying.Source,
    target: carrying.Target,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Where the labels go: .npy .csv .txt .json, or TGT as .ply.",
        ),
    ],
    labels: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="A whole number or a word for each vertex or each face of SRC: .npy .csv .txt .json.",
        ),
    ],
    on: Annotated[
        On | None, typer.Option(help="What FILE has labels of. Told by their count if not given.")
    ] = None,
    to: Annotated[
        On | None, typer.Option(help="What of TGT gets labels. The same as in FILE if not given.")
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
    """Carry labels of vertices or faces from one shape to another.

    Labels are voted on and never averaged. --blank names the label to write where the confidence is too low,
    such as -1 or unknown; where SRC has no label it is also what TGT gets.
    """
    from meshmatch.threads import set_threads

    set_threads(1)
    import numpy as np

    from meshmatch.errors import OptionError
    from meshmatch.shapes.files import load_shape
    from meshmatch.transfer.attributes import pull_labels
    from meshmatch.transfer.face_labels import mean_of_corners, pull_face_labels
    from meshmatch.transfer.label_files import check_labels_suffix, load_labels, named, save_labels
    from meshmatch.transfer.low_confidence import replace_low_labels

    request = carrying.Request(source, target, map, model, refine, seed, up, front, strict, threads)
    carrying.check_request(request, fill, blank)
    check_labels_suffix(output)
    carrying.check_picture(request, picture, [output, labels])
    voice = Console(quiet)
    with carrying.output_file(request, output, [labels]) as temporary:
        a, b = load_shape(source), load_shape(target)
        given = load_labels(labels, a, on)
        if blank is not None:
            given.check_blank(blank)
        if to == "faces" and b.is_cloud:
            raise OptionError(f"{b.name} is a point cloud: it has no faces to label", "leave out --to faces")
        kind: On = "vertices" if b.is_cloud else to or given.on
        result = carrying.find_maps(request, voice, a, b)
        confidence = result.back.confidence.astype(np.float64)
        if kind == "faces":
            found = pull_face_labels(result.back, a, b, given.codes, given.on == "faces", threads)
            confidence = mean_of_corners(confidence, b)
        else:
            found = pull_labels(result.back, a, given.codes, given.on == "faces")
        found, doubt = replace_low_labels(
            found, confidence, b, min_confidence, blank is not None, fill, kind == "faces"
        )
        carried = named(found, given, kind, blank)
        save_labels(temporary, carried, b)
    carrying.tell_doubt(voice, doubt, min_confidence, kind)
    used = len(np.unique(carried.codes))
    voice.say(f"wrote {output}: {used} different labels on the {len(found)} {kind} of {request.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_labels

        words = [str(name) for name in given.names]
        theirs = np.where(carried.codes < len(words), carried.codes, -1)  # a blank comes after the names
        faces = given.on == "faces", kind == "faces"
        shown = compose_labels((a, b), (given.codes, theirs), words, faces)
        carrying.draw(request, voice, picture, (a, b), result, shown)
    if json:
        drawn = None if picture is None else str(picture)
        record = carrying.map_record(request, result, result.back)
        record |= carrying.doubt_record(doubt, min_confidence)
        print_json(
            {"output": str(output), "picture": drawn, "from": given.on, "to": kind, "labels": used} | record
        )
