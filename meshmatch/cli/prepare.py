"""``meshmatch prepare``: prepare shapes and a template for training."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from typer import Argument, Option

from meshmatch.cli.options import Json, Quiet, Seed, grouped, optional, output_option
from meshmatch.cli.user_messages import Console, print_json
from meshmatch.errors import MeshmatchError
from meshmatch.progress import ProgressCallback


@dataclass(frozen=True)
class PrepareOptions:
    """Options of the template and of the shapes."""

    template: str | None = optional(
        "SHAPE",
        "The shape that becomes the template: a name in the folder, or any mesh or cloud. Default: the first shape if all "
        "are registered, otherwise the shape closest to all others, or the mean of those in the same pose.",
    )
    align: Literal["none", "near", "rigid"] | None = Option(
        None,
        help="How shapes are aligned with the template, now and whenever the model is used: not at all, by a small "
        "rotation, or from any orientation. Default: near for registered shapes that share an orientation, none for a "
        "hundred registered ones or more, otherwise rigid.",
    )
    scale: Literal["area", "sphere"] = Option(
        "area", help="Scale shapes to the template's surface area, or to its radius around the centroid (sphere)."
    )
    mirror: Literal["auto", "no"] = Option(
        "auto",
        help="auto: find and mirror shapes that are mirror images of the others, such as left hands among right ones; the "
        "model then tries both sides. Registered shapes are never mirrored.",
    )
    landmarks: str | None = optional(
        "WHERE",
        "Known points of the shapes: a folder with NAME.npy files, or the suffix of files next to the shapes, such as "
        ".landmarks.npy or .fcsv (docs/formats.md).",
    )
    strategy: Literal["parts", "spectral", "geodesic", "uniform"] = Option(
        "geodesic",
        help="Which candidate nodes are rejected. parts: those between two parts (needs --labels); spectral: between "
        "two spectral clusters; geodesic: near points that are far apart along the surface; uniform: none.",
    )
    labels: Path | None = optional(
        "FILE", "The part of every vertex of a single shape: one number per line, counted from 0."
    )
    nodes: int = Option(320, min=4, max=10_000, help="Number of control nodes.")
    radius: float = Option(0.13, min=1e-6, help="Support radius of a node, in units of sqrt(surface area).")
    grow_radii: bool = Option(
        False,
        "--grow-radii",
        help="If vertices are within reach of too few nodes, enlarge the radii of the nodes around them. Default: add "
        "nodes, or use a milder strategy.",
    )
    faces: int = Option(10_000, min=100, help="Number of triangles after decimation.")
    decimate: Literal["fast", "meshlab"] = Option(
        "fast",
        help="How shapes are decimated: fast, or by MeshLab, which is slower and gives better triangles (needs the extra "
        "`meshlab`).",
    )
    seed: Seed = 0


@grouped
def prepare(
    *,
    shapes: Path = Argument(..., metavar="SHAPES", help="A folder of shapes, or a single shape to make a template of."),
    output: Path = output_option("FOLDER", "The output folder; made if needed."),
    how: PrepareOptions,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Prepare shapes and a template for training.

    The shapes of a folder are checked, normalised, decimated and aligned with the template. `meshmatch train --shapes
    FOLDER` then learns from them: from their correspondence if all are registered (share the template's vertices and
    triangles), otherwise without it. Writes template.safetensors, a picture of the nodes (nodes.png) and, from a folder,
    shapes.safetensors, points.safetensors, normalised/ and prepared.json.
    """
    from meshmatch.api.prepare import PrepareConfig
    from meshmatch.api.prepare import prepare as prepare_shapes
    from meshmatch.render.compose import compose_shapes
    from meshmatch.shapes.vertex_lists import load_points
    from meshmatch.templates.make import NodeConfig

    console = Console(quiet)
    parts = None if how.labels is None else load_points(how.labels)
    nodes = NodeConfig(how.strategy, how.nodes, how.radius, seed=how.seed, grow=how.grow_radii)
    turned = how.align, how.scale, how.mirror
    config = PrepareConfig(nodes, how.faces, how.decimate, how.template, *turned, how.landmarks, parts)
    with console.progress() as progress:
        made = prepare_shapes(shapes, output, config, progress)
    found: dict[str, object] = {}
    if shapes.is_dir():
        found = {"align": made.align, "scale": how.scale, "mirrored": made.mirrored, "landmarks": made.landmarks}
    template, registered, picture = made.template, len(made.shapes), output / "nodes.png"
    compose_shapes([(template, None)]).render(picture)
    notes = [*made.notes]
    if found and not registered and not (quiet and not json):
        with console.progress() as progress:
            notes += _kind_notes(made.names, output / "normalised", shapes, how.seed, progress)
    console.say(*notes)
    console.say(
        f"wrote {output}: a template of {template.shape.V} vertices and {template.K} nodes"
        + (f", {registered} registered shapes" if registered else "")
        + (f", {len(made.names)} shapes without correspondence" if found and not registered else "")
        + (f", {made.landmarks} known points" if made.landmarks else "")
        + f"; look at {picture}"
    )
    if json:
        record = {"output": output, "template": template.name, "template_hash": template.hash}
        record |= {"vertices": template.shape.V, "nodes": template.K, "shapes": made.names, "registered": registered}
        print_json(record | found | {"notes": notes})


def _kind_notes(
    names: Sequence[str], normalised: Path, folder: Path, seed: int, progress: ProgressCallback
) -> list[str]:
    """Notes on the kinds of the prepared shapes; errors become notes, too."""
    from meshmatch.api.kinds import kind_notes, kinds_of

    places = {name: [normalised / f"{stem}.ply" for stem in (name, Path(name).stem)] for name in names}
    files = {name: path for name, paths in places.items() for path in paths if path.is_file()}
    try:
        return kind_notes(kinds_of(files, seed, progress), folder)
    except MeshmatchError as error:
        return [f"the kinds of these shapes were not read: {error.message}"]
