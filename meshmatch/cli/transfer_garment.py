"""``meshmatch transfer-garment``."""

from pathlib import Path

from typer import Argument, Option

import meshmatch
from meshmatch.cli.options import RunOptions, grouped, output_option
from meshmatch.cli.targets import to_targets
from meshmatch.cli.transfer_options import MapOptions, Picture, Source, Target, Transfer
from meshmatch.cli.user_messages import Json


@grouped
@to_targets("transfer_garment")
def transfer_garment(
    *,
    garment: Path = Argument(..., metavar="GARMENT", help="Mesh that SRC wears: clothes, hair, a hat, shoes."),
    source: Source,
    target: Target,
    output: Path = output_option(
        "FILE",
        "GARMENT on TGT. An .obj written from an .obj, or a .glb from a .glb, keeps everything but the positions; materials "
        "and images of an .obj are copied next to it. Other formats keep less; a warning lists what is lost.",
    ),
    maps: MapOptions,
    run: RunOptions,
    join: bool = Option(
        False, "--join", help="Write TGT (a .glb, .gltf or .vrm) and GARMENT together, as one .glb or .vrm."
    ),
    picture: Picture = None,
) -> Json:
    """Transfer clothes, hair or other worn meshes.

    GARMENT must be in place on SRC, in the same frame and unit. Its vertices follow SRC to TGT and keep their offsets from
    the skin, rotated and scaled as the body is there; vertices that would sink below the skin of TGT are pushed out. Vertex
    order, polygons, texture coordinates, groups and materials are kept. In a .glb, GARMENT moves with the skeleton of TGT.
    """
    from meshmatch.shapes.deformed_files import MovedFile

    transfer = Transfer(source, target, output, maps, run, picture)
    console = transfer.console
    into = target if join else None
    plan = MovedFile.planned(output, garment, into)
    worn = meshmatch.load_shape(garment)
    plan.make_folders()
    with transfer.outputs(garment, files=plan.files) as temporary:
        result = meshmatch.transfer_garment(garment, source, target, transfer)
        plan.write(temporary, result.shape, result.turns, result.binding, result.turn, into)
    a, b = result.maps.source, result.maps.target
    if not result.sits:
        where = f"{100 * result.below:.0f} % of it lies below the skin and {100 * result.far:.0f} % far from it"
        console.warn(f"{garment.name} seems not to fit {transfer.names[0]} in this pose: {where}")
    if b.is_cloud:
        console.say(f"note: {transfer.names[1]} is a point cloud: nothing was pushed out of it")
    elif len(result.pushed):
        share = 100 * len(result.pushed) / worn.V
        console.say(f"{len(result.pushed)} of {worn.V} vertices ({share:.1f} %) were pushed out of {transfer.names[1]}")
    if len(result.sunk):
        console.warn(f"{len(result.sunk)} of {worn.V} vertices are below the skin of {transfer.names[1]}")
    if result.binding is not None and output.suffix.lower() in (".glb", ".vrm"):
        console.say(f"{len(result.binding.rig.joints)} joints move {garment.name}")
    if not join and plan.is_turned(result.binding, result.turn):
        console.say(f"note: a node turns {garment.name} upright, along y")
    written = " ".join(str(file) for file in plan.files)
    console.say(f"wrote {written}: {garment.name} on {transfer.names[1]} ({result.seconds:.1f} s)")
    if picture is not None:
        from meshmatch.render.compose import compose_garments

        transfer.draw(result.maps, compose_garments((a, b), (worn, result.shape)))
    record = {"picture": picture, "files": [str(file) for file in plan.files], "vertices": worn.V}
    numbers = {"joined": join, "pushed_out": len(result.pushed), "below_skin": len(result.sunk), "sits": result.sits}
    shares = {"below_source_skin": round(result.below, 4), "far_from_source": round(result.far, 4)}
    return transfer.record(record | numbers | shares, result.maps, float(result.maps.forward.confidence.mean()))
