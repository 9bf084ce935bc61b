"""Options that several verbs share: each group is spelled once, and `grouped` adds it to a verb's own options."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from meshmatch.errors import OptionError
from meshmatch.fitting.choices import Refine

if TYPE_CHECKING:
    from meshmatch.api.results import ConfidenceRule
    from meshmatch.arrays import Ints
    from meshmatch.fitting.fit_config import FitConfig

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

Source = Annotated[Path, typer.Argument(metavar="SOURCE", help="The shape to match.")]
Target = Annotated[Path, typer.Argument(metavar="TARGET", help="The shape it is matched to.")]
Seed = Annotated[int, typer.Option(min=0, help="Random seed. The same seed gives the same result.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
Threads = Annotated[int, typer.Option(min=1, help="Number of threads.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no summary; warnings stay.")]


PAIRS_HELP = "Known pairs that the map must honour: a source vertex and a target vertex a line, counted from 0."


def check_axes(up: Axis | None, front: Axis | None) -> None:
    """Refuse up and front along one axis (`OptionError`)."""
    if up is not None and front is not None and up[-1] == front[-1]:
        raise OptionError(f"up ({up}) and front ({front}) lie along one axis", "choose two different axes")


def _axis(help: str) -> Any:
    return typer.Option(help=help, case_sensitive=False)


@dataclass(frozen=True)
class FitOptions:
    """How a template is fitted."""

    model: Annotated[
        str, typer.Option(metavar="NAME", help="Model: a name (see `meshmatch models list`) or a model folder.")
    ] = "human"
    refine: Annotated[
        Refine,
        typer.Option(
            help="Refinement of the fit. nodes: Gauss-Newton on the nodes; latent: search over the network's codes; "
            "none: the network alone."
        ),
    ] = "nodes"
    up: Annotated[Axis | None, _axis("Axis of the file that points up. Default: detect. With two shapes, of both.")] = (
        None
    )
    front: Annotated[
        Axis | None, _axis("Axis of the file that the shape faces. Default: detect. With two shapes, of both.")
    ] = None
    partial: Annotated[
        bool | None,
        typer.Option(
            "--partial/--whole",
            help="Treat shapes as partial scans (--partial) or as complete (--whole). Default: detect.",
        ),
    ] = None
    seed: Seed = 0

    def check(self) -> None:
        """Refuse up and front along one axis (`OptionError`), before anything is loaded."""
        check_axes(self.up, self.front)

    def config(self) -> FitConfig:
        """The same for the library."""
        from meshmatch.fitting.fit_config import FitConfig

        return FitConfig(refine=self.refine, seed=self.seed, up=self.up, front=self.front, partial=self._partial)

    @property
    def _partial(self) -> Literal["auto", "yes", "no"]:
        return "auto" if self.partial is None else "yes" if self.partial else "no"

    @property
    def record(self) -> dict[str, str | int]:
        """For --json."""
        return {"model": self.model, "refine": self.refine, "seed": self.seed}


@dataclass(frozen=True)
class PairOptions(FitOptions):
    """How two shapes are matched."""

    source_up: Annotated[Axis | None, _axis("Up axis of the first shape, where the two differ.")] = None
    source_front: Annotated[Axis | None, _axis("Front axis of the first shape.")] = None
    target_up: Annotated[Axis | None, _axis("Up axis of the second shape.")] = None
    target_front: Annotated[Axis | None, _axis("Front axis of the second shape.")] = None
    known_pairs: Annotated[Path | None, typer.Option("--landmarks", metavar="FILE", help=PAIRS_HELP)] = None

    def check(self) -> None:
        """Refuse axes that lie along one line (`OptionError`), before anything is loaded."""
        for up, front in self._axes:
            check_axes(up, front)

    @property
    def _axes(self) -> tuple[tuple[Axis | None, Axis | None], tuple[Axis | None, Axis | None]]:
        source = self.source_up or self.up, self.source_front or self.front
        return source, (self.target_up or self.up, self.target_front or self.front)

    def pairs(self) -> tuple[Ints, Ints] | None:
        """The known pairs, from their file."""
        from meshmatch.maps.pairs import load_pairs

        return None if self.known_pairs is None else load_pairs(self.known_pairs)

    def configs(self) -> tuple[FitConfig, FitConfig]:
        """Those of source and target."""
        from meshmatch.fitting.fit_config import FitConfig

        source, target = self._axes
        plain = FitConfig(refine=self.refine, seed=self.seed, partial=self._partial)
        return replace(plain, up=source[0], front=source[1]), replace(plain, up=target[0], front=target[1])

    @property
    def given(self) -> list[str]:
        """The options that only matching can obey, as far as they were given."""
        names = ["up", "front", "source_up", "source_front", "target_up", "target_front", "partial"]
        found = [f"--{name.replace('_', '-')}" for name in names if getattr(self, name) is not None]
        return [*found, *(["--landmarks"] if self.known_pairs is not None else [])]


@dataclass(frozen=True)
class RunOptions:
    """How a verb that takes long behaves."""

    strict: Annotated[bool, typer.Option("--strict", help="Write nothing and exit with 1 if a fit is poor.")] = False
    json: Json = False
    threads: Threads = 2
    quiet: Quiet = False


@dataclass(frozen=True)
class RuleOptions:
    """What is written where the map is not to be trusted."""

    fill: Annotated[
        bool, typer.Option("--fill", help="Replace values of low confidence by those of their neighbours.")
    ] = False
    blank: Annotated[
        str | None, typer.Option(metavar="VALUE", help="Or write VALUE there. Default: keep them as they are.")
    ] = None
    min_confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Minimum confidence for a value to be trusted.")
    ] = 0.3

    def rule(self, blank: float | str | Sequence[float] | None = None) -> ConfidenceRule:
        """The same for the library; `blank` is what the text means."""
        from meshmatch.api.results import ConfidenceRule

        if self.fill and self.blank is not None:
            raise OptionError("--fill and --blank contradict each other", "choose one of them")
        return ConfidenceRule(self.min_confidence, self.fill, blank)


def grouped(verb: Callable[..., None]) -> Callable[..., None]:
    """A verb for typer: each parameter whose type is a group becomes the options of that group."""
    hints = get_type_hints(verb, include_extras=True)
    groups = {name: hint for name, hint in hints.items() if isinstance(hint, type) and is_dataclass(hint)}
    parameters, annotations = [], {}
    for name, parameter in inspect.signature(verb).parameters.items():
        for each in _expanded(parameter, hints[name]):
            parameters.append(each)
            annotations[each.name] = each.annotation

    @wraps(verb)
    def called(**given: Any) -> None:
        for name, group in groups.items():
            own = [field.name for field in fields(group)]
            given[name] = group(**{key: given.pop(key) for key in own})
        verb(**given)

    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = annotations
    return called


def _expanded(parameter: inspect.Parameter, hint: Any) -> list[inspect.Parameter]:
    if not (isinstance(hint, type) and is_dataclass(hint)):
        return [parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY)]
    types = get_type_hints(hint, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=types[field.name],
        )
        for field in fields(hint)
    ]
