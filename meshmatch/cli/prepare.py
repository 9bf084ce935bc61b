"""``meshmatch prepare``."""

from meshmatch.cli import options
from meshmatch.cli import training_options as given
from meshmatch.cli.console import Console, print_json


def prepare(
    shapes: given.Shapes,
    output: given.PreparedFolder,
    template: given.TemplateShape = None,
    align: given.AlignOption = None,
    scale: given.ScaleOption = "area",
    landmarks: given.Landmarks = None,
    strategy: given.Strategy = "geodesic",
    labels: given.Labels = None,
    nodes: given.Nodes = 320,
    radius: given.Radius = 0.13,
    faces: given.Faces = 10_000,
    decimate: given.Decimate = "fast",
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
    from meshmatch.maps.pairs import load_points
    from meshmatch.render.compose import compose_shapes
    from meshmatch.templates.nodes import NodeConfig
    from meshmatch.templates.prepare import PrepareConfig
    from meshmatch.templates.prepare import prepare as prepare_shapes

    console = Console(quiet)
    parts = None if labels is None else load_points(labels)
    config = PrepareConfig(
        NodeConfig(strategy, nodes, radius, seed=seed), *(faces, decimate, template, align, scale, landmarks, parts)
    )
    with console.progress() as progress:
        made = prepare_shapes(shapes, output, config, progress)
    found: dict[str, object] = {}
    if shapes.is_dir():
        found = {"align": made.align, "scale": scale, "landmarks": made.landmarks}
    registered, picture = len(made.shapes), output / "nodes.png"
    compose_shapes([(made.template, None)]).render(picture)
    for note in made.notes:
        console.say(note)
    console.say(
        f"wrote {output}: a template of {made.template.shape.V} vertices and {made.template.K} nodes"
        + (f", {registered} registered shapes" if registered else "")
        + (f", {len(made.names)} shapes without correspondence" if found and not registered else "")
        + (f", {made.landmarks} known points" if made.landmarks else "")
        + f"; look at {picture}"
    )
    if json:
        print_json(
            {
                "output": str(output),
                "template": made.template.name,
                "template_hash": made.template.hash,
                "vertices": made.template.shape.V,
                "nodes": made.template.K,
                "shapes": list(made.names),
                "registered": registered,
                **found,
                "notes": list(made.notes),
            }
        )
