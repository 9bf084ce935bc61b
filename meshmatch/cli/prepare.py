"""``meshmatch prepare``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from meshmatch.cli import options
from meshmatch.cli.console import Console, print_json
from meshmatch.outputs import make_folder

if TYPE_CHECKING:
    import numpy as np

    from meshmatch.shapes.repair import Repaired


def prepare(
    shapes: Annotated[
        Path, typer.Argument(metavar="SHAPES", help="A folder of shapes, or the one shape of a template.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where everything goes; made if needed.")
    ],
    template: Annotated[
        str | None,
        typer.Option(
            metavar="SHAPE",
            help="The shape that becomes the template: a name in the folder, or any mesh or cloud. If not given: the "
            "folder's first where all are registered, else the one that lies nearest to all others.",
        ),
    ] = None,
    align: Annotated[
        Literal["none", "near", "rigid"] | None,
        typer.Option(
            help="How shapes are turned to the template, now and when fitted: as they are given, a little, or "
            "from any orientation. If not given: near where they are registered and stand alike, else rigid."
        ),
    ] = None,
    scale: Annotated[
        Literal["area", "sphere"],
        typer.Option(
            help="What is made equal to the template's: surface area, or the radius around the centroid."
        ),
    ] = "area",
    landmarks: Annotated[
        str | None,
        typer.Option(
            metavar="WHERE",
            help="Known points of the shapes: a folder of NAME.npy, or an ending beside them such as "
            ".landmarks.npy (docs/formats.md).",
        ),
    ] = None,
    strategy: Annotated[
        Literal["parts", "spectral", "geodesic", "uniform"],
        typer.Option(
            help="Which nodes are refused: those between two parts (needs --labels), between two spectral "
            "clusters, near two points far apart along the surface, or none."
        ),
    ] = "geodesic",
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="The part of every vertex of a single shape, a number a line, from 0."
        ),
    ] = None,
    nodes: Annotated[int, typer.Option(min=4, max=10_000, help="How many control nodes.")] = 320,
    radius: Annotated[
        float, typer.Option(min=1e-6, help="Support radius of a node, in units of sqrt(surface area).")
    ] = 0.13,
    faces: Annotated[int, typer.Option(min=100, help="Triangles of the low resolution.")] = 10_000,
    seed: options.Seed = 0,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Make a template, and shapes to learn from.

    A folder's shapes are checked, normalised, decimated and brought to the template's position, size and orientation.
    `meshmatch train --shapes FOLDER` learns from them: from their correspondence if all share the template's vertices
    and triangles, else without one. Writes template.safetensors, a picture of the nodes (nodes.png) and, from a
    folder, shapes.safetensors, points.safetensors, normalised/ and prepared.json.
    """
    from meshmatch.errors import OptionError
    from meshmatch.render.fitted import nodes_panel
    from meshmatch.render.picture import render_shapes
    from meshmatch.templates.make import low_resolution, make_template
    from meshmatch.templates.nodes import NodeConfig
    from meshmatch.templates.prepare import prepare_folder, template_shape
    from meshmatch.templates.template import save_template

    voice = Console(quiet)
    config = NodeConfig(strategy=strategy, K=nodes, radius=radius, seed=seed)
    if (strategy == "parts") != (labels is not None):
        raise OptionError(
            "--strategy parts and --labels belong together", "give both, or choose another strategy"
        )
    if shapes.is_dir() and labels is not None:
        raise OptionError("--labels are of one shape, not of a folder", "name the shape itself")
    for option, value in (("--template", template), ("--align", align), ("--landmarks", landmarks)):
        if not shapes.is_dir() and value is not None:
            raise OptionError(f"{option} goes with a folder of shapes", "one shape is its own template")
    if shapes.is_dir() and output.is_dir() and output.samefile(shapes):
        raise OptionError(f"cannot prepare {shapes} into itself", "choose another folder with -o")
    make_folder(output)
    if shapes.is_dir():
        with voice.progress() as report:
            made = prepare_folder(
                shapes,
                output,
                config,
                template=template,
                faces=faces,
                align=align,
                scale=scale,
                landmarks=landmarks,
                progress=lambda done, total: report("checked", shapes.name, done / total),
            )
        bundle, names, registered, notes = made.template, made.names, len(made.shapes), made.notes
        found: dict[str, object] = {"align": made.align, "scale": scale, "landmarks": made.landmarks}
    else:
        from meshmatch.maps.pairs import load_points

        clean = template_shape(shapes)
        parts = None if labels is None else _repaired_labels(load_points(labels), clean, labels)
        bundle = make_template(
            clean.shape,
            shapes.stem,
            config,
            labels=parts,
            source=shapes.name,
            low=None if clean.shape.is_cloud else low_resolution(clean.shape, faces),
        )
        save_template(bundle, output / "template.safetensors")
        names, registered, notes = (shapes.name,), 0, clean.notes
        found = {}
    picture = output / "nodes.png"
    render_shapes([nodes_panel(bundle)], picture)
    for note in notes:
        voice.say(note)
    voice.say(
        f"wrote {output}: a template of {bundle.shape.V} vertices and {bundle.K} nodes"
        + (f", {registered} registered shapes" if registered else "")
        + (f", {len(names)} shapes without correspondence" if found and not registered else "")
        + (f", {found['landmarks']} known points" if found.get("landmarks") else "")
        + f"; look at {picture}"
    )
    if json:
        print_json(
            {
                "output": str(output),
                "template": bundle.name,
                "template_hash": bundle.hash,
                "vertices": bundle.shape.V,
                "nodes": bundle.K,
                "shapes": list(names),
                "registered": registered,
                **found,
                "notes": list(notes),
            }
        )


def _repaired_labels(labels: "np.ndarray", clean: "Repaired", file: Path) -> "np.ndarray":
    """Labels of the file's vertices (V_original,) as labels of the repaired ones (V,)."""
    from meshmatch.errors import InputError

    if len(labels) != clean.original.V:
        raise InputError(
            f"{file.name} has {len(labels)} labels, but {clean.original.name} has {clean.original.V} vertices",
            "one label a line, for every vertex of the file",
        )
    return labels[clean.kept_vertex]
