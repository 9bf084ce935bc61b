"""Arguments and options that several verbs share, described once."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from meshmatch.errors import OptionError
from meshmatch.fitting.choices import Partial, Refine

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

Source = Annotated[Path, typer.Argument(metavar="SOURCE", help="The shape whose every vertex is matched.")]
Target = Annotated[Path, typer.Argument(metavar="TARGET", help="The shape that it is matched to.")]
Model = Annotated[
    str,
    typer.Option(metavar="NAME", help="A model by name (see `meshmatch models list`) or by its folder."),
]
RefineOption = Annotated[
    Refine,
    typer.Option(
        help="How the fit is refined: Gauss-Newton on the nodes, the search over codes, or the network alone."
    ),
]
Up = Annotated[Axis | None, typer.Option(help="The file's axis that points up. Searched for if not given.")]
Front = Annotated[
    Axis | None, typer.Option(help="The file's axis that the shape faces. Searched for if not given.")
]
PartialFlag = Annotated[
    bool | None,
    typer.Option(
        "--partial/--whole",
        help="A shape may be a part, such as a scan from one side: try that too, or never. Found out if not given.",
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Chooses the samples. The same seed gives the same result.")]
Strict = Annotated[bool, typer.Option("--strict", help="Write nothing and exit with 1 if a fit is poor.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
Threads = Annotated[int, typer.Option(min=1, help="How many threads to use.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no summary; warnings stay.")]


def partial_choice(partial: bool | None) -> Partial:
    """The pipeline's word for the flag."""
    if partial is None:
        return "auto"
    return "yes" if partial else "no"


def check_axes(up: Axis | None, front: Axis | None) -> None:
    """Refuse up and front along one axis (`OptionError`)."""
    if up is not None and front is not None and up[-1] == front[-1]:
        raise OptionError(f"up ({up}) and front ({front}) lie along one axis", "choose two different axes")
