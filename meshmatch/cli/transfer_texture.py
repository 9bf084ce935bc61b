"""``meshmatch transfer-texture``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from meshmatch.cli import transfer_options
from meshmatch.cli.console import Console, Json, print_json
from meshmatch.cli.options import RuleOptions, RunOptions, grouped
from meshmatch.errors import OptionError

if TYPE_CHECKING:
    from meshmatch.api.results import ConfidenceRule
    from meshmatch.api.texture import TexturedResult

_COLORS = (".ply", ".off")
_WORTH_SAYING = 0.002  # of the surface


@dataclass(frozen=True)
class TextureOptions:
    """What is baked, and how."""

    image: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Image for the texture coordinates of SRC, instead of its own.")
    ] = None
    uv: Annotated[
        Literal["auto", "keep", "new"],
        typer.Option(help="Texture coordinates of TGT. auto: reuse valid ones; keep: reuse or fail; new: unwrap."),
    ] = "auto"
    size: Annotated[int, typer.Option(metavar="TEXELS", help="Width and height of the texture.")] = 2048
    samples: Annotated[
        int, typer.Option(metavar="N", help="N x N samples per texel at seams and fine detail of SRC.")
    ] = 2
    padding: Annotated[
        int,
        typer.Option(
            metavar="TEXELS",
            help="Distance between new charts. Colours are continued past their edges; with 0 they are not, and seams "
            "show.",
        ),
    ] = 8


@grouped
def transfer_texture(
    source: transfer_options.Source,
    target: transfer_options.Target,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="TGT with its texture: .glb, or .obj (with an .mtl and a .png of the same name). As .ply or .off, "
            "and for a point cloud, it gets vertex colours instead.",
        ),
    ],
    texture: TextureOptions,
    maps: transfer_options.MapOptions,
    rules: RuleOptions,
    run: RunOptions,
    picture: transfer_options.Picture = None,
) -> None:
    """Transfer the texture of one shape to another.

    Every texel takes the colour of its place on SRC: from its materials and their images, or from its vertex colours.
    The VALUE of --blank is a colour such as #808080, or 0 for a hole. The first vertices of a written glb are those of
    TGT in their order, and copies at texture seams follow; an obj has exactly the vertices and faces of TGT.
    """
    from meshmatch.api.texture import transfer_texture as transferred
    from meshmatch.api.transfer import transfer_colors
    from meshmatch.shapes.files import load_shape
    from meshmatch.shapes.textured_files import (
        check_textured,
        files_of,
        find_appearance,
        load_appearance,
        write_textured,
    )
    from meshmatch.transfer import colors
    from meshmatch.transfer.bake import BakeOptions
    from meshmatch.transfer.texture import check_bake_options

    transfer = transfer_options.Transfer(source, target, maps, run, Console(run.quiet))
    size, uv, image = texture.size, texture.uv, texture.image
    blank = colors.parse_color(rules.blank)
    rule = rules.rule(blank)
    baking = BakeOptions(size, texture.samples, texture.padding, rules.min_confidence, rules.fill, blank, run.threads)
    check_bake_options(baking)
    check_textured(output, _COLORS)
    a, b = load_shape(source), load_shape(target)
    painted = b.is_cloud or output.suffix.lower() in _COLORS
    if painted and uv == "keep":
        raise OptionError(
            f"{b.name} gets vertex colours, which need no texture coordinates",
            "leave out --uv keep" if b.is_cloud else "end the output in .glb or .obj for a texture",
        )
    files = [output] if painted else files_of(output)
    with transfer.outputs(files, [image], picture) as temporary:
        look = load_appearance(source, a, image)
        if painted:
            done = transfer_colors(a, b, transfer, colors=look, rule=rule)
            colors.save(temporary[0], b, done.data)
            transfer_options.tell_low(transfer.console, done.low, rule.minimum)
            record, pair = transfer_options.low_record(done.low, rule.minimum), done.maps
        else:
            with transfer.console.progress() as report:
                made = transferred(a, target, transfer, uv=uv, options=baking, look=look, progress=report)
            write_textured(output, temporary, made.mesh, made.baked.image)
            record, pair = _tell_baked(transfer.console, made, rule, size), made.maps
    what = "with vertex colours" if painted else f"with a texture of {size} x {size}"
    transfer.console.say(f"wrote {' '.join(str(file) for file in files)}: {transfer.names[1]} {what}")
    if picture is not None:
        from meshmatch.render.compose import compose_shapes

        result = load_shape(output)
        shown = compose_shapes([(a, look), (result, find_appearance(output, result))])
        transfer.draw(picture, pair, shown)
    if run.json:
        written = {"output": output, "picture": picture, "files": [str(file) for file in files]}
        print_json(written | record | transfer.record(pair, float(pair.backward.confidence.mean())))


def _tell_baked(console: Console, made: "TexturedResult", rule: "ConfidenceRule", size: int) -> Json:
    """What came out, in words and for --json."""
    baked, atlas = made.baked, made.atlas
    if atlas.note:
        console.say(f"note: {atlas.note}")
    if baked.low:
        became = "filled in from around" if rule.fill else "kept as it is" if rule.blank is None else "left blank"
        console.say(f"{100 * baked.low:.1f} % of the surface has less confidence than {rule.minimum:g}: {became}")
    if baked.torn > _WORTH_SAYING:
        console.say(f"note: the map is discontinuous on {100 * baked.torn:.1f} % of the surface; colours are cut there")
    whose = "its own texture coordinates" if atlas.own else "new texture coordinates"
    console.say(f"{whose}: {100 * baked.used:.0f} % of the texture lies on the surface ({made.seconds:.1f} s)")
    return {
        "size": size,
        "uv": "own" if atlas.own else "new",
        "uv_note": atlas.note,
        "used": baked.used,
        "alpha": baked.alpha,
        "min_confidence": rule.minimum,
        "low_confidence_share": baked.low,
        "blank_share": baked.low if rule.blank is not None else 0.0,
        "filled_share": baked.low if rule.fill else 0.0,
        "torn_share": baked.torn,
        "baking_seconds": round(made.seconds, 3),
    }
