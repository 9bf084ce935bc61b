"""``meshmatch transfer-landmarks``."""

from pathlib import Path
from typing import Annotated

import typer

from meshmatch.cli import carrying, options
from meshmatch.cli.console import Console, print_json


def transfer_landmarks(
    source: carrying.Source,
    target: carrying.Target,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="Where the landmarks go: .csv .json .pp.")
    ],
    landmarks: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Landmarks of SRC, as vertices or positions: .csv .json, MeshLab's .pp, or .txt .npy of vertices.",
        ),
    ],
    map: carrying.MapOption = None,
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
    """Carry landmarks from one shape to exact points on the surface of another.

    The output says for each: its vertex, its position, its face with the weights of the corners, and how sure
    that is (.csv, .json); or name and position (.pp). A position in FILE stands for the nearest point of SRC.
    Landmarks below --min-confidence are named.
    """
    from meshmatch.threads import set_threads

    set_threads(1)
    import numpy as np

    from meshmatch.shapes.files import load_shape
    from meshmatch.transfer.landmark_files import check_landmarks_suffix, load_landmarks, save_landmarks
    from meshmatch.transfer.landmarks import push_landmarks

    request = carrying.Request(source, target, map, model, refine, seed, up, front, strict, threads)
    carrying.check_request(request)
    check_landmarks_suffix(output)
    carrying.check_picture(request, picture, [output, landmarks])
    voice = Console(quiet)
    with carrying.output_file(request, output, [landmarks]) as temporary:
        a, b = load_shape(source), load_shape(target)
        given, furthest = load_landmarks(landmarks, a)
        if furthest > 0.02 * a.diagonal:
            voice.warn(
                f"a landmark lies {furthest:.4g} away from {a.name}, which is {100 * furthest / a.diagonal:.0f} % "
                "of its size: the nearest point of the surface was taken"
            )
        result = carrying.find_maps(request, voice, a, b)
        found = push_landmarks(result.forward, a, b, given)
        save_landmarks(temporary, found)
    low = np.flatnonzero(found.confidence < min_confidence)
    for k in low[:10].tolist():
        voice.warn(f"landmark {found.names[k]} is unsure: its confidence is {found.confidence[k]:.2f}")
    if len(low) > 10:
        voice.warn(f"and so are {len(low) - 10} more")
    voice.say(f"wrote {output}: {len(found.names)} landmarks on {request.names[1]}")
    if picture is not None:
        from meshmatch.render.compose import compose_points

        shown = compose_points((a, b), (given.points, found.points))
        carrying.draw(request, voice, picture, (a, b), result, shown)
    if json:
        drawn = None if picture is None else str(picture)
        record = carrying.map_record(request, result, result.forward)
        doubt = {"min_confidence": min_confidence, "low_confidence": len(low)}
        print_json({"output": str(output), "picture": drawn, "landmarks": len(found.names)} | doubt | record)
