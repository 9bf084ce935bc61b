"""``meshmatch view``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meshmatch.cli import carrying, options
from meshmatch.cli.console import Console, print_json

if TYPE_CHECKING:
    import numpy as np

    from meshmatch.render.viewer import Looks
    from meshmatch.shapes.appearance import Appearance
    from meshmatch.shapes.shape import Shape


def view(
    source: options.Source,
    target: options.Target,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PAGE", help="Where the page goes: one .html file.")
    ],
    map: carrying.MapOption = None,
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
    """Make a page that shows two shapes and the map between them.

    Matched places have one colour; point at one shape and see the place on the other. The page is one file for
    any browser and needs no network. With --map, --up and --front say how SOURCE is to stand.
    """
    from meshmatch.threads import set_threads

    set_threads(1)
    from meshmatch.render.viewer import check_page, write_page
    from meshmatch.shapes.files import load_shape

    request = carrying.Request(source, target, map, model, refine, seed, up, front, strict, threads)
    options.check_axes(up, front)
    check_page(output)
    voice = Console(quiet)
    with carrying.output_file(request, output, []) as temporary:
        shapes = load_shape(source), load_shape(target)
        result = carrying.find_maps(request, voice, *shapes)
        report = write_page(
            temporary,
            *shapes,
            result.forward,
            result.back,
            rotations=_rotations(request, shapes, result),
            names=request.names,
            looks=_looks(request, voice, shapes, result),
        )
    for note in report.notes:
        voice.say(note)
    voice.say(f"wrote {output} ({report.size / 1e6:.1f} MB): open it in a browser")
    if json:
        record = carrying.map_record(request, result, result.forward)
        record |= {"drawn_vertices": list(report.drawn), "bytes": report.size}
        print_json({"output": str(output)} | record)


def _rotations(
    request: carrying.Request, shapes: "tuple[Shape, Shape]", result: carrying.Maps
) -> "tuple[np.ndarray | None, np.ndarray | None]":
    """How the shapes stand: as they were fitted, if well; else the source as the user or its format says."""
    import numpy as np

    from meshmatch.render.facing import facing
    from meshmatch.render.viewer import levelled

    if result.match is not None and result.forward.verdict != "poor":
        fits = result.match.source_fit, result.match.target_fit
        a, b = (levelled(shape, fit.frame.rotation) for shape, fit in zip(shapes, fits, strict=True))
        return a, b
    if request.up is not None or request.front is not None:
        return facing(shapes[0], request.up, request.front), None
    if request.source.suffix.lower() in (".glb", ".gltf"):
        return np.eye(3), None  # the format says: y up, z to the front
    return None, None


def _looks(
    request: carrying.Request, voice: Console, shapes: "tuple[Shape, Shape]", result: carrying.Maps
) -> "Looks | None":
    """What the shapes wear. A look that cannot be read is no reason to show nothing."""
    from meshmatch.errors import InputError
    from meshmatch.render.viewer import share_look
    from meshmatch.shapes.appearance_files import find_appearance, load_coordinates

    def read(path: Path, shape: "Shape") -> "tuple[Appearance | None, np.ndarray | None]":
        try:
            return find_appearance(path, shape), load_coordinates(path, shape)
        except InputError as error:
            voice.say(f"shown without its look: {error.message}")
            return None, None

    (a, uv_a), (b, uv_b) = read(request.source, shapes[0]), read(request.target, shapes[1])
    return share_look(
        shapes, (a, b), result.forward, result.back, coordinates=(uv_a, uv_b), workers=request.threads
    )
