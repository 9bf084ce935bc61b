"""``meshmatch transfer-shapes``."""

from pathlib import Path

from typer import Option

import meshmatch
from meshmatch.cli.options import RunOptions, grouped, output_option
from meshmatch.cli.targets import to_targets
from meshmatch.cli.transfer_options import MapOptions, Picture, Source, Target, Transfer
from meshmatch.cli.user_messages import Json

_MAX_LISTED = 8  # blendshapes or clips in a warning


@grouped
@to_targets("transfer_shapes")
def transfer_shapes(
    *,
    source: Source,
    target: Target,
    output: Path = output_option(
        "FILE",
        "TGT with the blendshapes: .glb, .vrm (if TGT is one) or, with Blender installed, .fbx, .usdz or .blend. Or their "
        "names and displacements (.npz); or a new folder (a name without a suffix) with an .obj for each blendshape.",
    ),
    shapes: list[Path] | None = Option(
        None,
        metavar="FILE",
        help="The blendshapes, if they are not in SRC: a folder of meshes with the vertices of SRC, named like the "
        "blendshapes; a .npz or .glb; or a single mesh. May be repeated for several meshes.",
    ),
    maps: MapOptions,
    run: RunOptions,
    picture: Picture = None,
) -> Json:
    """Transfer blendshapes (morph targets).

    These are, for instance, facial expressions. SRC is a .glb, .gltf or .vrm with morph targets, a file that Blender reads,
    or any mesh with --shapes. Displacements are rotated and scaled with the surface; eyes, teeth and other separate parts
    move with what surrounds them; closed lips and lids stay closed. A TGT in one of these formats keeps everything else.
    Clips that animate the blendshapes are transferred too.
    """
    import numpy as np

    from meshmatch.api.blend_shapes import check_shapes_output, write_shapes

    transfer = Transfer(source, target, output, maps, run, picture)
    console = transfer.console
    suffix = check_shapes_output(output)
    with transfer.outputs(*(shapes or ()), files=[output] if suffix else ()) as temporary:
        given = None if shapes is None else shapes[0] if len(shapes) == 1 else shapes
        with console.progress() as report:
            result = meshmatch.transfer_shapes(source, target, transfer, shapes=given, progress=report)
        if temporary:
            write_shapes(result, output, *temporary)
        else:
            result.save(output)
    names, clips = result.shapes.names, [clip.name for clip in result.shapes.clips]
    if result.still:
        listed = ", ".join(result.still[:_MAX_LISTED]) + (", ..." if len(result.still) > _MAX_LISTED else "")
        console.warn(f"{len(result.still)} of {len(names)} shapes move no vertex of {transfer.names[1]}: {listed}")
    if clips and output.suffix.lower() in ("", ".npz"):
        console.warn(
            f"{output.name} cannot contain clips: {', '.join(clips[:_MAX_LISTED])}"
            f"{', ...' if len(clips) > _MAX_LISTED else ''}"
        )
        clips = []
    played = f", {len(clips)} clip{'s' if len(clips) != 1 else ''}" if clips else ""
    shown = f"{len(names)} blendshape{'s' if len(names) != 1 else ''}"
    console.say(f"wrote {output}: {transfer.names[1]} with {shown}{played} ({result.seconds:.1f} s)")
    if picture is not None:
        from meshmatch.render.compose import compose_values

        moved = [np.linalg.norm(each.moves, axis=2).max(axis=0) for each in (result.given, result.shapes)]
        bodies = result.maps.source, result.target
        transfer.draw(result.maps, compose_values(bodies, moved, "largest displacement of a shape"))
    record = {"picture": picture, "shapes": list(names), "still": list(result.still), "clips": clips}
    return transfer.record(record, result.maps, float(result.maps.backward.confidence.mean()))
