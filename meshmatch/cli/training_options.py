"""Options of `prepare` and `train`: what shapes are made ready, and how a model is learned from them."""

from pathlib import Path
from typing import Annotated, Literal

import typer

Shapes = Annotated[Path, typer.Argument(metavar="SHAPES", help="A folder of shapes, or the one shape of a template.")]
PreparedFolder = Annotated[
    Path, typer.Option("--output", "-o", metavar="FOLDER", help="The output folder; made if needed.")
]
TemplateShape = Annotated[
    str | None,
    typer.Option(
        metavar="SHAPE",
        help="The shape that becomes the template: a name in the folder, or any mesh or cloud. Default: the folder's "
        "first where all are registered, else the one nearest to all others.",
    ),
]
AlignOption = Annotated[
    Literal["none", "near", "rigid"] | None,
    typer.Option(
        help="How shapes are turned to the template, now and when fitted: as they are given, a little, or from any "
        "orientation. Default: near where they are registered and stand alike, else rigid."
    ),
]
ScaleOption = Annotated[
    Literal["area", "sphere"],
    typer.Option(help="What is made equal to the template's: surface area, or the radius around the centroid."),
]
Landmarks = Annotated[
    str | None,
    typer.Option(
        metavar="WHERE",
        help="Known points of the shapes: a folder of NAME.npy, or a suffix beside them such as .landmarks.npy "
        "(docs/formats.md).",
    ),
]
Strategy = Annotated[
    Literal["parts", "spectral", "geodesic", "uniform"],
    typer.Option(
        help="Which nodes are rejected: those between two parts (needs --labels), between two spectral clusters, near "
        "two points far apart along the surface, or none."
    ),
]
Labels = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="The part of every vertex of a single shape: one number a line, from 0."),
]
Nodes = Annotated[int, typer.Option(min=4, max=10_000, help="Number of control nodes.")]
Radius = Annotated[float, typer.Option(min=1e-6, help="Support radius of a node, in units of sqrt(surface area).")]
Faces = Annotated[int, typer.Option(min=100, help="Triangles of the low resolution.")]
Decimate = Annotated[
    Literal["fast", "meshlab"],
    typer.Option(
        help="How the low resolution is made: fast, or slowly with better triangles by MeshLab (extra `meshlab`)."
    ),
]

ModelFolder = Annotated[
    Path, typer.Option("--output", "-o", metavar="FOLDER", help="The model folder; also holds the checkpoint.")
]
BodyTemplate = Annotated[
    str, typer.Option(metavar="NAME", help="A bundled template (human-T, human-A, human-I), or a bundle's file.")
]
TrainingShapes = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="Learn from a folder that `meshmatch prepare` made, with its template. Default: generated human bodies "
        "(needs the extra `train`).",
    ),
]
Unsupervised = Annotated[
    bool,
    typer.Option(
        "--unsupervised", help="Learn without correspondence even if the shapes are registered; others always are."
    ),
]
PresetOption = Annotated[
    Literal["default", "paper"],
    typer.Option(help="The recipe: what measured best, or the paper's network, losses and rates."),
]
FieldOption = Annotated[
    Literal["mls", "rbf", "pointwise"],
    typer.Option(
        help="How a deformation is represented: by moving least squares or radial basis functions of nodes, or by a "
        "network at every point, which is slow (--refine nodes then refines its code)."
    ),
]
Start = Annotated[
    str | None,
    typer.Option(metavar="MODEL", help="Begin with the weights of a trained model of the same template and preset."),
]
Rate = Annotated[float | None, typer.Option(min=0.0, help="Learning rate; default: the preset's.")]
Blend = Annotated[
    float | None,
    typer.Option(
        metavar="WEIGHT",
        min=0.0,
        help="Weight of volume and rigidity between two codes: the paper's l4, 1 for models that interpolate by codes. "
        "Default: the preset's.",
    ),
]
Stiffness = Annotated[
    float,
    typer.Option(
        min=1e-6,
        help="How firmly two fits hold a common stretch of the template; written on the card. 1 suits bodies; 0.05 "
        "what differs more from shape to shape, such as organs.",
    ),
]
ModelName = Annotated[str | None, typer.Option(metavar="NAME", help="The model's name; default: the folder's.")]
Category = Annotated[
    str | None, typer.Option(help="What it matches; default: human, or the name of the folder of shapes.")
]
Licence = Annotated[str, typer.Option(help="Terms of use of the weights; written on the card.")]
Steps = Annotated[int | None, typer.Option(min=1, help="Training steps; default: the preset's.")]
Minutes = Annotated[
    float | None, typer.Option(min=0.0, help="Stop after so many minutes; the same command goes on later.")
]
Identities = Annotated[int, typer.Option(min=1, help="How many different bodies are generated.")]
Poses = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Poses to mix with the sampled ones: .npz, .json or .csv (docs/formats.md)."),
]
PoseShare = Annotated[
    float, typer.Option(min=0.0, max=1.0, help="Share of the bodies that stand in a pose of --poses.")
]
Bf16 = Annotated[
    bool | None, typer.Option("--bf16/--no-bf16", help="bfloat16 arithmetic; default: the preset's choice.")
]
Workers = Annotated[int | None, typer.Option(min=0, help="Processes that draw batches; default: the preset's.")]
LossPicture = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Draw the losses of this run over its steps: .png, .svg or .pdf.")
]
Fresh = Annotated[bool, typer.Option("--fresh", help="Start anew instead of going on from the folder's checkpoint.")]
