"""``meshmatch transfer-texture``."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from typer import Option

import meshmatch
from meshmatch.cli.options import RuleOptions, RunOptions, grouped, optional, output_option
from meshmatch.cli.targets import to_targets
from meshmatch.cli.transfer_options import MapOptions, Picture, Source, Target, Transfer
from meshmatch.cli.user_messages import Console, Json
from meshmatch.errors import OptionError

_COLOR_SUFFIXES = (".ply", ".off")  # formats with vertex colors instead of textures
_MIN_REPORTED = 0.002  # share of the surface


@dataclass(frozen=True)
class TextureOptions:
    """Options of the texture."""

    image: Path | None = optional("FILE", "Image for the texture coordinates of SRC, instead of its own.")
    uv: Literal["auto", "keep", "new", "source"] = Option(
        "auto",
        help="Texture coordinates of TGT. auto: reuse its own if they are valid, else unwrap; keep: reuse its own or fail; "
        "new: unwrap; source: transfer those of SRC.",
    )
    size: int = Option(2048, metavar="TEXELS", help="Width and height of the texture.")
    samples: int = Option(2, metavar="N", help="Average N x N samples per texel at seams and fine detail of SRC.")
    padding: int = Option(
        8,
        metavar="TEXELS",
        help="Distance between new charts, filled with the colors at their edges. With 0, seams are visible.",
    )


@grouped
@to_targets("transfer_texture")
def transfer_texture(
    *,
    source: Source,
    target: Target,
    output: Path = output_option(
        "FILE",
        "TGT with its texture: .glb, .vrm (if TGT is one), or .obj (with an .mtl and images of the same name). With .ply or "
        ".off, or if TGT is a point cloud, it gets vertex colors instead.",
    ),
    texture: TextureOptions,
    maps: MapOptions,
    rules: RuleOptions,
    run: RunOptions,
    picture: Picture = None,
) -> Json:
    """Transfer the textures of one shape to another.

    Each texel gets the color, normal, roughness, metalness, occlusion and emission of the corresponding point of SRC, from
    its materials and images or its vertex colors. The VALUE of --blank is a color such as #808080, or 0 for transparent. A
    glb or obj written for a TGT of the same format keeps everything else: nodes, skins, clips, groups, polygons. A TGT in
    another format is turned upright in a glb.
    """
    from meshmatch.api.texture import tiles_of_file
    from meshmatch.shapes import textured_files
    from meshmatch.transfer.value_files import parse_color

    transfer = Transfer(source, target, output, maps, run, picture)
    size, uv, image = texture.size, texture.uv, texture.image
    blank = parse_color(rules.blank)
    rule = rules.rule(blank)
    textured_files.check_textured(output, _COLOR_SUFFIXES)
    a, b = meshmatch.load_shape(source), meshmatch.load_shape(target)
    painted = b.is_cloud or output.suffix.lower() in _COLOR_SUFFIXES
    if painted and uv in ("keep", "source"):
        hint = f"leave out --uv {uv}" if b.is_cloud else "end the output in .glb or .obj for a texture"
        raise OptionError(f"{b.name} gets vertex colors, which need no texture coordinates", hint)
    look = textured_files.load_appearance(source, a, image)
    finish = look.finish
    layers = () if finish is None else [each for each in finish.images if each != "surface" or not finish.even]
    tiles: list[int] = []
    if not painted and uv in ("auto", "keep"):
        tiles = tiles_of_file(target, b, size)
    tiled = output.suffix.lower() == ".obj"
    if tiles and not tiled:
        transfer.console.say(f"note: {output.suffix} has no tiles (UDIM): those of {b.name} are brought into one image")
        tiles = []
    rules_of_texels = rules.min_confidence, rules.fill, blank
    baking = meshmatch.BakeOptions(size, texture.samples, texture.padding, *rules_of_texels, run.threads, tiled)
    files = [output] if painted else textured_files.output_files(output, layers, tiles)
    turn = None
    with transfer.outputs(image, files=files) as temporary:
        if painted:
            done = meshmatch.transfer_colors(a, target, transfer, colors=look, rule=rule)
            done.writer(temporary[0], output)
            record, pair = transfer.report_low(done.low, rule.minimum), done.maps
        else:
            match = transfer if maps.map is None else transfer(a, b)  # a wrong map is refused before the long work
            with transfer.console.progress() as report:
                made = meshmatch.transfer_texture(a, target, match, uv=uv, options=baking, look=look, progress=report)
            made.dressed.write(output, temporary)
            record, pair = _report_baked(transfer.console, made, rule, texture), made.maps
            if made.dressed.turned and output.suffix.lower() == ".glb":
                turn = made.dressed.turn
                transfer.console.say(f"note: a node turns {b.name} upright, along y")
    textures = f"{len(tiles)} textures" if tiles else "a texture"
    what = "with vertex colors" if painted else f"with {textures} of {size} x {size}"
    transfer.console.say(f"wrote {', '.join(str(file) for file in files)}: {transfer.names[1]} {what}")
    if picture is not None:
        from meshmatch.render.compose import compose_shapes

        result = meshmatch.load_shape(output)
        if painted:  # in the orientation of the target's file
            result = replace(result, verts=b.verts)
        elif turn is not None:
            result = replace(result, verts=result.verts @ turn)
        transfer.draw(pair, compose_shapes([(a, look), (result, textured_files.find_appearance(output, result))]))
    record = {"picture": picture, "files": [str(file) for file in files], "tiles": tiles} | record
    return transfer.record(record, pair, float(pair.backward.confidence.mean()))


def _report_baked(
    console: Console, made: "meshmatch.TexturedResult", rule: "meshmatch.ConfidenceRule", texture: TextureOptions
) -> Json:
    """Report on the baked texture; return the numbers for --json."""
    from meshmatch.maps.folds import Folds

    baked, atlas, maps = made.baked, made.atlas, made.maps
    folds = None if maps.source.is_cloud else Folds.of(maps.backward, maps.target, maps.source)
    if atlas.note:
        console.say(f"note: {atlas.note}")
    if baked.low:
        became = "filled in from its surroundings" if rule.fill else "kept" if rule.blank is None else "left blank"
        console.say(f"{100 * baked.low:.1f} % of the surface has less confidence than {rule.minimum:g}: {became}")
    if baked.torn > _MIN_REPORTED:
        console.say(f"note: the map is discontinuous on {100 * baked.torn:.1f} % of the surface; colors are cut there")
    if folds is not None:
        console.say(
            f"the map turns over {100 * folds.flipped:.2f} % of the surface and crushes {100 * folds.crushed:.2f} %; "
            f"the median stretch is {folds.stretch:.2f}-fold"
        )
    origin = "own" if atlas.own else "source" if texture.uv == "source" else "new"
    names = {"own": "its own texture coordinates", "source": "texture coordinates of the source"}
    coordinates = names.get(origin, "new texture coordinates")
    console.say(f"{coordinates}: {100 * baked.used:.0f} % of the texture is used ({made.seconds:.1f} s)")
    uv = {"size": texture.size, "uv": origin, "uv_note": atlas.note, "used": baked.used}
    low = {"min_confidence": rule.minimum, "low_confidence_share": baked.low}
    low |= {"blank_share": baked.low * (rule.blank is not None), "filled_share": baked.low * rule.fill}
    return (
        uv
        | {"alpha": baked.material.alpha}
        | low
        | {"torn_share": baked.torn, "baking_seconds": round(made.seconds, 3)}
        | ({} if folds is None else asdict(folds))
    )
