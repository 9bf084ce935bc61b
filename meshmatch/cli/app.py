"""The typer application with all commands."""

import inspect
from typing import Any

import typer
from typer.core import TyperGroup
from typer.models import ParameterInfo

from meshmatch import __version__
from meshmatch.cli.atlas import atlas
from meshmatch.cli.blender_addon import blender_addon
from meshmatch.cli.collect import fit, map
from meshmatch.cli.export import export
from meshmatch.cli.info import info
from meshmatch.cli.interpolate import interpolate
from meshmatch.cli.match import evaluate, match, register
from meshmatch.cli.measure import measure
from meshmatch.cli.models import models
from meshmatch.cli.picture import picture, view
from meshmatch.cli.prepare import prepare
from meshmatch.cli.symmetry import symmetry
from meshmatch.cli.train import train
from meshmatch.cli.transfer import transfer_color, transfer_labels, transfer_landmarks, transfer_weights
from meshmatch.cli.transfer_garment import transfer_garment
from meshmatch.cli.transfer_rig import transfer_rig
from meshmatch.cli.transfer_shapes import transfer_shapes
from meshmatch.cli.transfer_texture import transfer_texture
from meshmatch.cli.wrap import wrap


class _Commands(TyperGroup):
    """A command group that removes pydantic's prefix "Value error" from messages about invalid arguments."""

    def invoke(self, *context: Any) -> Any:
        try:
            return super().invoke(*context)
        except typer.BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise


app = typer.Typer(
    name="meshmatch",
    cls=_Commands,
    help="Dense matching of non-rigid 3D shapes: two meshes in, a vertex map out.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # plain text is printed faster
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"meshmatch {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    """Dense matching of non-rigid 3D shapes: two meshes in, a vertex map out.

    Exit status: 0 success, 1 a problem with data or options (one line says what), 2 a wrong command line.
    Messages go to stderr, data to stdout. MESHMATCH_DEBUG=1 shows the traceback of every error.
    """


for verb in (
    *(match, register, wrap, evaluate),
    *(transfer_texture, transfer_color, transfer_labels, transfer_weights),
    *(transfer_rig, transfer_shapes, transfer_landmarks, transfer_garment, measure),
    *(fit, map, export, atlas, symmetry),
    *(interpolate, picture, view, info, prepare, train, blender_addon),
):
    for parameter in inspect.signature(verb).parameters.values():
        for each in (parameter.default, *getattr(parameter.annotation, "__metadata__", ())):
            if isinstance(each, ParameterInfo):
                each.readable = False  # unreadable files are reported by our readers, with status 1
    app.command()(verb)
app.add_typer(models, name="models")
