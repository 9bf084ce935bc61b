"""``meshmatch transfer-texture``."""

from contextlib import ExitStack
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from meshmatch.cli import carrying, options
from meshmatch.cli.console import Console, print_json

if TYPE_CHECKING:
    from meshmatch.shapes.appearance import Appearance
    from meshmatch.shapes.shape import Shape
    from meshmatch.transfer.bake import BakeOptions
    from meshmatch.transfer.unwrap import Atlas


def transfer_texture(
    source: carrying.Source,
    target: carrying.Target,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="TGT with its texture: .glb, or .obj (an .mtl and a .png of the same name come with it). As .ply or "
            ".off, and for a point cloud, it gets vertex colours instead.",
        ),
    ],
    map: carrying.MapOption = None,
    image: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="The picture for the texture coordinates of SRC, instead of those it names."
        ),
    ] = None,
    uv: Annotated[
        Literal["auto", "keep", "new"],
        typer.Option(
            help="The texture coordinates of TGT: its own where they serve, its own or an error, or new ones."
        ),
    ] = "auto",
    size: Annotated[int, typer.Option(metavar="TEXELS", help="Width and height of the texture.")] = 2048,
    samples: Annotated[
        int,
        typer.Option(
            metavar="N", help="N x N samples for a texel on a seam of SRC, or with much detail in it."
        ),
    ] = 2,
    padding: Annotated[
        int,
        typer.Option(
            metavar="TEXELS",
            help="Room between new charts. Beyond their edges colours go on all over the picture; with 0 they do "
            "not, and seams show.",
        ),
    ] = 8,
    fill: Annotated[
        bool,
        typer.Option(
            "--fill", help="Take colours from around in the texture where the confidence is too low."
        ),
    ] = False,
    blank: Annotated[
        str | None,
        typer.Option(
            metavar="COLOR",
            help="The colour where the confidence is too low: #808080, or 0 for a hole. Kept if not given.",
        ),
    ] = None,
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
    """Carry the texture of one shape to another.

    Every texel of the new texture takes the colour of its place on SRC: from its materials and their images, or from
    its vertex colours. The first vertices of a written glb are those of TGT in their order, and copies where the
    texture has seams follow; an obj has exactly the vertices and faces of TGT.
    """
    from meshmatch.threads import set_threads

    set_threads(1)
    from meshmatch.cli.output_paths import check_apart
    from meshmatch.models.registry import locate_model
    from meshmatch.outputs import replace_on_success
    from meshmatch.shapes.appearance_files import load_appearance
    from meshmatch.shapes.files import load_shape
    from meshmatch.shapes.textured_files import files_of
    from meshmatch.transfer.bake import BakeOptions
    from meshmatch.transfer.texture import check_bake_options

    request = carrying.Request(source, target, map, model, refine, seed, up, front, strict, threads)
    carrying.check_request(request, fill, blank)
    choices = BakeOptions(size, samples, padding, min_confidence, fill, _color(blank), threads)
    check_bake_options(choices)
    _check_suffix(output)
    voice = Console(quiet)
    a, b = load_shape(source), load_shape(target)
    painted = b.is_cloud or output.suffix.lower() in _COLORS
    files = [output] if painted else files_of(output)
    check_apart(files, [source, target, map, image])
    carrying.check_picture(request, picture, [*files, image])
    with ExitStack() as claims:
        # The obj, which names the others, is claimed first and so renamed last.
        temporary = [claims.enter_context(replace_on_success(file)) for file in files]
        if map is None:
            locate_model(model)  # a mistyped name is told before the long work
        look = load_appearance(source, a, image)
        if painted:
            _check_painted(uv, b)
            result = carrying.find_maps(request, voice, a, b)
            record = _paint(temporary[0], (a, b), look, result, choices, voice)
        else:
            from meshmatch.shapes.appearance_files import load_coordinates
            from meshmatch.transfer.unwrap import atlas_of

            began = monotonic()
            own = None if uv == "new" else load_coordinates(target, b)
            atlas = atlas_of(b, own, size, padding, uv)
            unwrapping = monotonic() - began
            result = carrying.find_maps(request, voice, a, b)
            record = _bake(output, temporary, (a, b), look, result, atlas, choices, voice)
            record["baking_seconds"] = round(record["baking_seconds"] + unwrapping, 3)
    what = "with vertex colours" if painted else f"with a texture of {size} x {size}"
    voice.say(f"wrote {' '.join(str(file) for file in files)}: {request.names[1]} {what}")
    if picture is not None:
        from meshmatch.render.compose import compose_shapes
        from meshmatch.shapes.appearance_files import find_appearance

        worn = load_shape(output)
        shown = compose_shapes([(a, look), (worn, find_appearance(output, worn))])
        carrying.draw(request, voice, picture, (a, b), result, shown)
    if json:
        drawn = None if picture is None else str(picture)
        written = {"output": str(output), "picture": drawn, "files": [str(file) for file in files]}
        print_json(written | record | carrying.map_record(request, result, result.back))


_COLORS = (".ply", ".off")


def _color(text: str | None) -> tuple[float, float, float, float] | None:
    """The colour and alpha that a user means."""
    from meshmatch.errors import OptionError
    from meshmatch.transfer.value_files import parse_blank

    if text is None:
        return None
    red, green, blue, alpha = parse_blank(text, 4).tolist()
    if not all(0 <= value <= 1 for value in (red, green, blue, alpha)):
        raise OptionError(
            f"--blank {text}: colours lie in 0..1", "such as 0.5,0.5,0.5 or #808080, or 0 for a hole"
        )
    return red, green, blue, alpha


def _check_suffix(output: Path) -> None:
    from meshmatch.errors import OptionError
    from meshmatch.shapes.textured_files import TEXTURED_SUFFIXES

    if output.suffix.lower() not in (*TEXTURED_SUFFIXES, *_COLORS):
        raise OptionError(
            f"{output.name}: a texture cannot be kept as '{output.suffix or 'a file without a suffix'}'",
            "end the name in .glb or .obj, or in .ply or .off for vertex colours",
        )


def _check_painted(uv: str, target: "Shape") -> None:
    from meshmatch.errors import OptionError

    if uv == "keep":
        raise OptionError(
            f"{target.name} gets vertex colours, which need no texture coordinates to keep",
            "leave out --uv keep" if target.is_cloud else "end the output in .glb or .obj for a texture",
        )


def _paint(
    path: Path,
    shapes: "tuple[Shape, Shape]",
    look: "Appearance",
    result: carrying.Maps,
    choices: "BakeOptions",
    voice: Console,
) -> dict[str, Any]:
    """Write the target with vertex colours."""
    import numpy as np

    from meshmatch.transfer import colors
    from meshmatch.transfer.low_confidence import replace_low_values
    from meshmatch.transfer.texture import colors_of_vertices

    source, target = shapes
    found = colors_of_vertices(source, look, target, result.back)
    empty = None if choices.blank is None else colors.light(np.array(choices.blank))
    confidence = result.back.confidence.astype(np.float64)
    found, doubt = replace_low_values(found, confidence, target, choices.min_confidence, empty, choices.fill)
    colors.save(path, target, found)
    carrying.tell_doubt(voice, doubt, choices.min_confidence)
    return carrying.doubt_record(doubt, choices.min_confidence)


def _bake(
    output: Path,
    temporary: list[Path],
    shapes: "tuple[Shape, Shape]",
    look: "Appearance",
    result: carrying.Maps,
    atlas: "Atlas",
    choices: "BakeOptions",
    voice: Console,
) -> dict[str, Any]:
    """Write the target with a texture."""
    from meshmatch.shapes.textured_files import TexturedFiles
    from meshmatch.transfer.texture import transfer_texture

    began = monotonic()
    with voice.progress() as report:

        def tell(share: float) -> None:
            report("baking", shapes[1].name, share)

        worn = transfer_texture(shapes[0], look, shapes[1], result.back, atlas, choices, tell)
    TexturedFiles(output, tuple(temporary)).write(worn.mesh, worn.baked.image)
    seconds = monotonic() - began
    baked = worn.baked
    became = (
        "filled in from around"
        if choices.fill
        else "kept as it came"
        if choices.blank is None
        else "left blank"
    )
    if atlas.note:
        voice.say(f"note: {atlas.note}")
    if baked.low:
        voice.say(
            f"{100 * baked.low:.1f} % of the surface has less confidence than {choices.min_confidence:g}: {became}"
        )
    if baked.torn > _WORTH_SAYING:
        voice.say(f"note: the map tears {100 * baked.torn:.1f} % of the surface apart; colours are cut there")
    whose = "its own texture coordinates" if atlas.own else "new texture coordinates"
    voice.say(f"{whose}: {100 * baked.used:.0f} % of the texture lies on the surface ({seconds:.1f} s)")
    return {
        "size": choices.size,
        "uv": "own" if atlas.own else "new",
        "uv_note": atlas.note,
        "used": baked.used,
        "alpha": baked.alpha,
        "min_confidence": choices.min_confidence,
        "low_confidence_share": baked.low,
        "blank_share": baked.low if choices.blank is not None else 0.0,
        "filled_share": baked.low if choices.fill else 0.0,
        "torn_share": baked.torn,
        "baking_seconds": seconds,
    }


_WORTH_SAYING = 0.002
