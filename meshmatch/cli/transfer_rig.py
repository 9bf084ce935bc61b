"""``meshmatch transfer-rig``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from typer import Option

import meshmatch
from meshmatch.cli.options import RunOptions, grouped, output_option
from meshmatch.cli.targets import to_targets
from meshmatch.cli.transfer_options import MapOptions, Picture, Source, Target, Transfer
from meshmatch.cli.user_messages import Json
from meshmatch.scalars import counted

_MAX_LISTED = 8  # joints or clips in a note


@grouped
@to_targets("transfer_rig")
def transfer_rig(
    *,
    source: Source,
    target: Target,
    output: Path = output_option(
        "FILE", "TGT with the rig: .glb, .vrm (if TGT is one) or, with Blender installed, .fbx, .usdz, .dae or .blend."
    ),
    maps: MapOptions,
    run: RunOptions,
    pose: Literal["rest", "source"] = Option(
        "rest", help="Pose of TGT in the output: its own (rest), or that of SRC (source)."
    ),
    picture: Picture = None,
) -> Json:
    """Transfer a skeleton, skin weights and animation clips.

    SRC is a rigged .glb, .gltf or .vrm, or a file that Blender reads. A TGT in one of these formats keeps everything but its
    own skeleton; a TGT in another format is turned upright. The new skeleton has the bones and names of SRC, and its clips
    play on TGT in any pose.
    """
    from meshmatch.api.rig import check_rig_output, write_rig

    transfer = Transfer(source, target, output, maps, run, picture)
    console = transfer.console
    check_rig_output(output, source, target)
    with transfer.outputs() as (temporary,):
        result = meshmatch.transfer_rig(source, target, transfer, pose=pose)
        write_rig(result, output, temporary)
    joints, clips = len(result.rig.joints), [clip.name for clip in result.rig.clips]
    if result.unused:
        count, names = len(result.unused), _listed(result.unused)
        have = "joint that moves" if count == 1 else "joints that move"
        console.warn(
            f"{count} {have} {transfer.names[0]} {'has' if count == 1 else 'have'} no vertex on the target: {names}"
        )
    if result.replaced:
        console.say(f"note: the skeleton that {transfer.names[1]} had ({result.replaced} joints) is replaced")
    if result.replaced_clips:
        count, names = len(result.replaced_clips), _listed(result.replaced_clips)
        what = "clip of that skeleton no longer moves" if count == 1 else "clips of that skeleton no longer move"
        console.warn(f"{count} {what} anything: {names}")
    played = f", {counted(len(clips), 'clip')}" if clips else ""
    console.say(f"wrote {output}: {transfer.names[1]} with {counted(joints, 'joint')}{played}")
    if picture is not None:
        from meshmatch.render.compose import compose_labels
        from meshmatch.transfer.attributes import most_votes
        from meshmatch.transfer.weight_files import load_weights

        a, b = result.maps.source, result.maps.target
        heaviest = most_votes(load_weights(source, a).matrix), most_votes(result.weights.matrix)
        transfer.draw(result.maps, compose_labels((a, b), heaviest, result.weights.names))
    record = {"picture": picture, "pose": pose, "joints": joints, "clips": clips, "unused_joints": list(result.unused)}
    record |= {"replaced_joints": result.replaced, "replaced_clips": list(result.replaced_clips)}
    return transfer.record(record, result.maps, float(result.maps.forward.confidence.mean()))


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_MAX_LISTED]) + (", ..." if len(names) > _MAX_LISTED else "")
