"""``meshmatch picture``."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meshmatch.cli import options, picture_options
from meshmatch.cli.console import Console, print_json
from meshmatch.cli.output_paths import check_distinct, check_png

if TYPE_CHECKING:
    from meshmatch.cli.picture_options import Subject


@options.grouped
def picture(
    shapes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SHAPE...",
            help="Shapes, side by side. A template bundle, or the name of a template or model, is drawn with its "
            "nodes.",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="PNG", help="The picture.")],
    shown: picture_options.PictureOptions,
    how: picture_options.LookOptions,
    name: Annotated[
        list[str] | None,
        typer.Option(metavar="TEXT", help="Text below a shape, once for each. Default: the file's name."),
    ] = None,
    names: Annotated[bool, typer.Option("--names/--no-names", help="Write the names.")] = True,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Draw shapes, and what is known about them.

    A PNG without a GPU, a display or OpenGL. Textures and colours of the files are shown where there are any.
    """
    from meshmatch.errors import OptionError
    from meshmatch.outputs import replace_on_success

    check_png(output)
    shown.check(len(shapes))
    if name and len(name) != len(shapes):
        raise OptionError(
            f"{len(shapes)} shapes need {len(shapes)} names, not {len(name)}", "give --name once for each shape"
        )
    look = how.look()
    check_distinct([output], [*shapes, *shown.files])
    console = Console(quiet)
    with replace_on_success(output) as temporary:
        subjects = [picture_options.load_subject(path, shown) for path in shapes]
        made = picture_options.compose(shown, subjects, look, console)
        labels = _labels(shapes, subjects, name, [panel.label for panel in made.panels])
        made = made.named(labels if names else [""] * len(labels))
        width, height = made.render(temporary, look)
    console.say(f"drew {output}: {made.caption} ({width} x {height} pixels)")
    if json:
        record = {"output": output, "shapes": [str(path) for path in shapes], "shows": made.caption}
        print_json(record | {"width": width, "height": height} | made.record)


def _labels(paths: list[Path], subjects: "list[Subject]", names: list[str] | None, labels: list[str]) -> list[str]:
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
