"""Options that several commands share, and checks before the work.

Each group of options is a dataclass, and `grouped` adds its options to those of a command. The fields' defaults are typer's
descriptions of the options, so only `grouped` can construct a group.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from typer import Argument, Context, Option

import meshmatch
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.fitting.fit_config import Refine
from meshmatch.models.registry import AUTO, implicit_folder
from meshmatch.outputs import replace_on_success
from meshmatch.threads import MAX_THREADS

if TYPE_CHECKING:
    from meshmatch.arrays import Ints
    from meshmatch.cli.user_messages import Console

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

Source = Annotated[Path, Argument(metavar="SOURCE", help="The shape to match.")]
Target = Annotated[Path, Argument(metavar="TARGET", help="The shape it is matched to.")]
Seed = Annotated[int, Option(min=0, help="Random seed. The same seed gives the same result.")]
Json = Annotated[bool, Option("--json", help="Print one JSON object on stdout.")]
Threads = Annotated[int, Option(min=1, max=MAX_THREADS, help="Number of threads.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="Print only warnings and errors.")]
ErrorUnit = Annotated[
    Literal["auto", "cm", "file", "x100"],
    Option(
        help="Unit of errors: cm on a person (1.9 m2 of skin), file (unit of TARGET's file), x100 (percent of the square "
        "root of TARGET's area), or auto: cm if TARGET is a person, else file."
    ),
]
Truth = Annotated[
    Path | None,
    Option(
        metavar="FILE",
        help="Ground truth: a source vertex and a target vertex per line (.txt, .csv or .npy), or one column with "
        "the target vertex of every source vertex.",
    ),
]
Points = Annotated[
    tuple[Path, Path] | None,
    Option(
        metavar="FILE FILE",
        help="Ground truth as two lists: vertices of SOURCE, and the corresponding vertices of TARGET; or landmarks of "
        "both, with the same names, in any format of `transfer-landmarks`.",
    ),
]
PAIRS_HELP = (
    "Known correspondences that guide both fits: a source vertex and a target vertex per line, counted from "
    "0. The map reports those that it misses."
)


def output_option(metavar: str, help: str) -> Any:
    """The required option --output of commands that write files."""
    return Option(..., "--output", "-o", metavar=metavar, help=help)


def optional(metavar: str, help: str) -> Any:
    """An option that defaults to None."""
    return Option(None, metavar=metavar, help=help)


def check_axes(up: Axis | None, front: Axis | None) -> None:
    """Raise `OptionError` if up and front lie along the same axis."""
    if up is not None and front is not None and up[-1] == front[-1]:
        raise OptionError(f"up ({up}) and front ({front}) lie along one axis", "choose two different axes")


def check_truth(truth: Path | None, points: tuple[Path, Path] | None) -> bool:
    """Whether the ground truth is given; `OptionError` if it is given twice."""
    if truth is not None and points is not None:
        raise OptionError("--truth and --points both give the ground truth", "choose one of them")
    return truth is not None or points is not None


def check_outputs(
    inputs: Iterable[Path | None], *outputs: Path | None, picture: Path | None = None, chart: Path | None = None
) -> None:
    """Check, before the work, that the outputs can be written; None stands for an output that is not requested.

    `OptionError` if the picture is no PNG, the chart has an unknown format, or an output would replace an input or another
    output; `OutputError` if the picture or chart cannot be written. (Other outputs are opened during the work.)
    """
    if chart is not None:
        from meshmatch.render.charts import check_chart

        check_chart(chart)
    if picture is not None and picture.suffix.lower() != ".png":
        raise OptionError(f"{picture.name}: a picture is a PNG", "end the name in .png")
    used = {os.path.realpath(path): "is an input of this command" for path in inputs if path is not None}
    for path in (*outputs, chart, picture):
        if path is None:
            continue
        real = os.path.realpath(path)  # Path.resolve raises for circular links
        if real in used:
            raise OptionError(f"cannot write {path}: it {used[real]}", "choose another name for the output")
        used[real] = "is an output of this command already"
    for path in (chart, picture):
        check_writable(path)


def check_writable(path: Path | None) -> None:
    """Raise `OutputError` if a file cannot be written, before the work."""
    if path is not None:
        with suppress(_IsWritable), replace_on_success(path):
            raise _IsWritable


class _IsWritable(Exception):
    """Raised where the file could be written, to discard it."""


def load_truth(
    truth: Path | None,
    points: tuple[Path, Path] | None,
    shapes: tuple[meshmatch.Shape, meshmatch.Shape],
    files: tuple[Path, Path] | None = None,
) -> tuple[Ints, Ints] | None:
    """Corresponding vertices of source and target, (N,) each, that have a position; None without ground truth.

    The shapes' ``files`` may define the frame of landmarks.
    """
    import numpy as np

    from meshmatch.maps.evaluate import placed_pairs
    from meshmatch.shapes import vertex_lists

    if points is not None:
        return placed_pairs(*_load_points(points, shapes, files), *shapes)
    if truth is None:
        return None
    rows, source = vertex_lists.load_truth(truth), shapes[0]
    if rows.shape[1] == 1:
        if len(rows) != source.V:
            hint = "ground truth in one column needs an entry for every vertex of the source"
            raise InputError(f"{truth.name} has {len(rows)} entries, but {source.name} has {source.V} vertices", hint)
        rows = np.column_stack([np.arange(source.V), rows])
    known = rows[(rows >= 0).all(axis=1)]
    if len(known) < len(rows):
        warn(f"{truth.name}: {len(rows) - len(known)} of {len(rows)} vertices have no counterpart: left out")
    return placed_pairs(known[:, 0], known[:, 1], *shapes)


def _load_points(
    points: tuple[Path, Path], shapes: tuple[meshmatch.Shape, meshmatch.Shape], files: tuple[Path, Path] | None
) -> tuple[Ints, Ints]:
    """Read two lists of vertices, or two files of landmarks."""
    from meshmatch.shapes import vertex_lists
    from meshmatch.shapes.landmark_files import mesh_space
    from meshmatch.transfer.landmarks import known_pairs

    try:
        return vertex_lists.load_points(points[0]), vertex_lists.load_points(points[1])
    except InputError as error:
        try:
            return known_pairs(points, shapes, [mesh_space(file) for file in files or ()] or ["", ""])
        except InputError as other:
            lists = {".csv", ".txt", ".npy"} >= {each.suffix.lower() for each in points}
            raise (error if lists else other) from None


class Options:
    """A group of options."""

    given: Mapping[str, str] = {}
    """Options and arguments of the command that were given on the command line, with their spelling."""

    def refuse(self, names: Iterable[str], what: str, hint: str = "leave it out") -> None:
        """Raise `OptionError` if one of the options was given, naming ``what`` it cannot be combined with."""
        for name in names:
            if name in self.given:
                raise OptionError(f"{self.given[name]} does not go with {what}", hint)


@dataclass(frozen=True)
class FitOptions(Options):
    """How a template is fitted."""

    model: str = Option(
        AUTO,
        metavar="NAME",
        help="Name (see `meshmatch models list`) or folder of a model. auto: the installed model for this kind of shape. "
        "none: match shapes directly, without a model.",
    )
    only: list[str] | None = Option(
        None,
        metavar="NAME",
        help="Fit only this part: its number; in a glb or gltf file, the name of its mesh (with * and ? as wildcards); in "
        "a label map, a label. May be repeated. `meshmatch info FILE` lists names and numbers.",
    )
    without: list[str] | None = Option(
        None,
        metavar="NAME",
        help="Exclude this part from the fit, such as weapons, a cape or the floor. Its vertices follow the nearest "
        "fitted ones. May be repeated.",
    )
    refine: Refine = Option(
        "nodes",
        help="Refinement of the fit. nodes: least squares on the nodes; latent: search over the network's latent "
        "codes; none: the network's prediction alone.",
    )
    up: Axis | None = Option(
        None, help="Up axis of all input shapes, in their files. Default: detected.", case_sensitive=False
    )
    front: Axis | None = Option(
        None, help="Axis that all input shapes face, in their files. Default: detected.", case_sensitive=False
    )
    partial: bool | None = Option(
        None,
        "--partial/--whole",
        help="Treat shapes as partial scans (--partial) or as complete (--whole). Default: detected.",
    )
    mirror: Literal["auto", "no"] | None = Option(
        None,
        help="Whether to also try the mirror image of each shape, for example for left hands with a model of right hands. "
        "Default: as the model card says.",
    )
    try_harder: bool = Option(
        False,
        "--try-harder",
        help="If a fit is poor, search longer: fit the shape as partial in more orientations, and try parts of the file "
        "on their own.",
    )
    seed: Seed = 0
    device: str = Option(
        "cpu", metavar="NAME", help="Where the network is evaluated: cpu, or cuda (needs meshmatch[train])."
    )

    @property
    def axes(self) -> tuple[tuple[Axis | None, Axis | None], ...]:
        """Up and front axes: one pair for all shapes, or one for each."""
        return ((self.up, self.front),)

    @property
    def implicit(self) -> bool:
        """Whether the model is an implicit one."""
        return implicit_folder(self.model) is not None

    def load(self, *paths: Path) -> list[meshmatch.Shape]:
        """Load shapes, with the parts selected by --only and --without. For an implicit model, also load samples."""
        if self.implicit:
            from meshmatch.implicit.samples import load_source

            return [load_source(path) for path in paths]
        from meshmatch.shapes.files import load_shapes

        return load_shapes(paths, only=self.only or (), without=self.without or ())

    def check(self, not_implicit: Iterable[str] = ()) -> None:
        """Raise `OptionError` for contradicting options, before anything is loaded.

        ``not_implicit`` are options of the command that do not apply to implicit models, in addition to all options of this
        group except the model and the seed.
        """
        for up, front in self.axes:
            check_axes(up, front)
        if self.implicit:
            own = {each.name for each in fields(self)} - {"model", "seed"}
            self.refuse([*sorted(own), *not_implicit], "an implicit model")

    def configs(self) -> tuple[meshmatch.FitConfig, ...]:
        """The configs for the library, one for each pair of `axes`."""
        from meshmatch.fitting.fit_config import FitConfig

        partial: Literal["auto", "yes", "no"] = "auto" if self.partial is None else "yes" if self.partial else "no"
        plain = FitConfig(
            refine=self.refine, seed=self.seed, partial=partial, mirror=self.mirror, try_harder=self.try_harder,
            device=self.device,
        )  # fmt: skip
        return tuple(replace(plain, up=up, front=front) for up, front in self.axes)

    def record(self, fit: meshmatch.Fit | meshmatch.ImplicitFit) -> dict[str, Any]:
        """Options for --json; the model is that of the fit if it was chosen automatically."""
        model = fit.model if self.model == AUTO else self.model
        return {"model": model, "seed": self.seed} | ({} if self.implicit else {"refine": self.refine})


@dataclass(frozen=True)
class PairOptions(FitOptions):
    """How two shapes are matched."""

    source_up: Axis | None = Option(None, help="Up axis of the first shape, if the two differ.", case_sensitive=False)
    source_front: Axis | None = Option(None, help="Front axis of the first shape.", case_sensitive=False)
    target_up: Axis | None = Option(None, help="Up axis of the second shape.", case_sensitive=False)
    target_front: Axis | None = Option(None, help="Front axis of the second shape.", case_sensitive=False)
    known_pairs: Path | None = Option(None, "--landmarks", metavar="FILE", help=PAIRS_HELP)

    @property
    def axes(self) -> tuple[tuple[Axis | None, Axis | None], ...]:
        source = self.source_up or self.up, self.source_front or self.front
        return source, (self.target_up or self.up, self.target_front or self.front)

    def pairs(self) -> tuple[Ints, Ints] | None:
        """Read the corresponding vertices of --landmarks; None without them."""
        from meshmatch.shapes.vertex_lists import load_pairs

        return None if self.known_pairs is None else load_pairs(self.known_pairs)

    def match(
        self, source: meshmatch.Shape, target: meshmatch.Shape, run: RunOptions, console: Console
    ) -> meshmatch.MatchResult:
        """Match two shapes, showing progress bars."""
        from meshmatch.api.matching import match

        pairs = self.pairs()
        with console.progress() as report:
            return match(
                source, target, model=self.model, config=self.configs(), landmarks=pairs, threads=run.threads,
                progress=report,
            )  # fmt: skip


@dataclass(frozen=True)
class RunOptions(Options):
    """Options of commands with longer computations."""

    strict: bool = Option(False, "--strict", help="Write nothing and exit with status 1 if a fit or map is poor.")
    json: Json = False
    threads: Threads = 2
    quiet: Quiet = False


@dataclass(frozen=True)
class RuleOptions(Options):
    """How values of low confidence are written."""

    fill: bool = Option(False, "--fill", help="Replace values of low confidence by those of their neighbours.")
    blank: str | None = optional("VALUE", "Write VALUE where confidence is low. Default: keep the transferred value.")
    min_confidence: float = Option(0.3, min=0.0, max=1.0, help="Minimum confidence for a value to be trusted.")

    def rule(self, blank: float | str | Sequence[float] | None = None) -> meshmatch.ConfidenceRule:
        """The rule for the library; ``blank`` is the parsed value of --blank."""
        if self.fill and self.blank is not None:
            raise OptionError("--fill and --blank contradict each other", "choose one of them")
        return meshmatch.ConfidenceRule(self.min_confidence, self.fill, blank)


def grouped(verb: Callable[..., None]) -> Callable[..., None]:
    """Turn a command into a function for typer: each parameter whose type is a group becomes the options of the group."""
    hints = get_type_hints(verb, include_extras=True)
    groups: dict[str, Any] = {}
    options: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(verb).parameters.items():
        if not is_dataclass(hints[name]):
            options.append(parameter.replace(annotation=hints[name]))
            continue
        groups[name] = hints[name]
        inside = get_type_hints(hints[name], include_extras=True)
        for each in fields(hints[name]):
            options.append(parameter.replace(name=each.name, default=each.default, annotation=inside[each.name]))

    @wraps(verb)
    def called(context: Context, **values: Any) -> None:
        given = {
            str(each.name): each.opts[0]
            for each in context.command.params
            if each.name and getattr(context.get_parameter_source(each.name), "name", "") == "COMMANDLINE"
        }
        for name, group in groups.items():
            values[name] = group(**{each.name: values.pop(each.name) for each in fields(group)})
            object.__setattr__(values[name], "given", given)
        verb(**values)

    options.append(inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=Context))
    called.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    called.__annotations__ = {each.name: each.annotation for each in options}
    return called
