"""``meshmatch picture``."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from meshmatch.cli import options, picture_options
from meshmatch.cli import truth as truths
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.output_paths import check_apart, check_png

if TYPE_CHECKING:
    from meshmatch.cli.picture_options import Subject

View = Literal["quarter", "front", "left", "right", "back", "above"]


def picture(
    shapes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SHAPE...",
            help="Shapes, side by side. A template bundle, or the name of a template or model, is drawn with its "
            "nodes.",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="PNG", help="Where the picture goes.")],
    map: Annotated[
        Path | None,
        typer.Option(
            metavar="MAP", help="Of two shapes, SOURCE TARGET, a map: matched places in one colour."
        ),
    ] = None,
    confidence: Annotated[
        bool, typer.Option("--confidence", help="With --map: how sure it is, as heat.")
    ] = False,
    truth: truths.Truth = None,
    points: truths.Points = None,
    unit: Annotated[
        Literal["cm", "x100"],
        typer.Option(help="Of errors: cm at 1.9 m2 of skin, or sqrt(area of the target) / 100."),
    ] = "cm",
    values: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="A number for each vertex, as heat (.npy .csv); or three, as colour. Once for each shape.",
        ),
    ] = None,
    title: Annotated[
        str | None, typer.Option(metavar="TEXT", help="What the numbers of --values are, with their unit.")
    ] = None,
    range: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="LOW HIGH", help="Ends of the scale of a heat; chosen if not given."),
    ] = None,
    labels: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="A label for each vertex or face (.npy .csv .txt .json). Once for each shape.",
        ),
    ] = None,
    on: Annotated[
        Literal["vertices", "faces"] | None,
        typer.Option(help="What the labels belong to; told by their count if not given."),
    ] = None,
    fit: Annotated[
        str | None,
        typer.Option(
            metavar="MESH|MODEL",
            help="Over one shape: the template that `meshmatch register` laid on it, or a model whose template is "
            "laid on it now. The distance is drawn as heat.",
        ),
    ] = None,
    image: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A texture for a shape whose file names none, or another one."),
    ] = None,
    plain: Annotated[bool, typer.Option("--plain", help="Without textures, colours and nodes.")] = False,
    view: Annotated[View, typer.Option(help="The side that is shown.")] = "quarter",
    up: Annotated[
        options.Axis | None, typer.Option(help="The files' axis that points up. Guessed if not given.")
    ] = None,
    front: Annotated[
        options.Axis | None, typer.Option(help="The files' axis that the shapes face. Guessed if not given.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Width and height in pixels, such as 1200x800. Fitted if not given."
        ),
    ] = None,
    background: Annotated[
        str, typer.Option(metavar="COLOR", help="white, dark, transparent, or a colour such as #e8f0f8.")
    ] = "white",
    ground: Annotated[bool, typer.Option("--ground/--no-ground", help="Whether shadows fall.")] = True,
    name: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TEXT", help="What to write below a shape. Once for each; its file's if not given."
        ),
    ] = None,
    names: Annotated[bool, typer.Option("--names/--no-names", help="Whether names are written.")] = True,
    seed: options.Seed = 0,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Draw shapes, and what is known about them.

    A PNG without a GPU, a display or OpenGL. Textures and colours of the files are shown where there are any.
    """
    from meshmatch.threads import set_threads

    set_threads(1)  # sums in another order would differ in their last bits
    from meshmatch.errors import OptionError
    from meshmatch.outputs import replace_on_success
    from meshmatch.render.layout import VIEWS
    from meshmatch.render.picture import Look

    options.check_axes(up, front)
    check_png(output)
    told = truths.check_truth(truth, points)
    asked = picture_options.PictureOptions(
        map, confidence, (truth, points) if told else None, unit, values or [], title, range, labels or [], on,
        fit, image, plain, seed,
    )  # fmt: skip
    asked.check(len(shapes))
    if name and len(name) != len(shapes):
        raise OptionError(
            f"{len(shapes)} shapes need {len(shapes)} names, not {len(name)}",
            "give --name once for each shape",
        )
    look = Look(_size(size), background, up, front, *VIEWS[view], ground)
    check_apart([output], [*shapes, *asked.files])
    voice = Console(quiet)
    with replace_on_success(output) as temporary:
        subjects = [picture_options.load_subject(path, asked) for path in shapes]
        shown = picture_options.compose(asked, subjects, look, voice)
        below = _labels(shapes, subjects, name, [panel.label for panel in shown.panels])
        shown = shown.named(below if names else [""] * len(below))
        width, height = shown.render(temporary, look)
    voice.say(f"drew {output}: {shown.caption} ({width} x {height} pixels)")
    if json:
        record = {"output": str(output), "shapes": [str(path) for path in shapes], "shows": shown.caption}
        print_json(record | {"width": width, "height": height} | shown.record)


def _size(text: str | None) -> tuple[int, int] | None:
    """Width and height of words such as 1200x800 (`OptionError` if invalid)."""
    from meshmatch.errors import OptionError

    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isascii() and width.isdigit() and height.isascii() and height.isdigit()):
        raise OptionError(f"invalid size '{text}'", "give width and height in pixels, such as 1200x800")
    if max(len(width), len(height)) > 9:
        raise OptionError(f"a picture of {text} pixels is too large", "give a size such as 1200x800")
    return int(width), int(height)


def _labels(
    paths: list[Path], subjects: "list[Subject]", names: list[str] | None, labels: list[str]
) -> list[str]:
    """The words below the panels with the names that the user gave; files of one name get their folders."""
    files: dict[str, set[str]] = {}
    for path, subject in zip(paths, subjects, strict=True):
        files.setdefault(subject.name, set()).add(os.path.realpath(path))
    for k, (path, subject) in enumerate(zip(paths, subjects, strict=True)):
        if names:
            given = names[k]
        elif len(files[subject.name]) > 1:
            given = str(path)
        else:
            continue
        labels[k] = labels[k].replace(subject.name, given) if len(labels) > len(paths) else given
    return labels
