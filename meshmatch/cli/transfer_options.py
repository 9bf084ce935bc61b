"""Shared parts of the transfer commands: options of the map, outputs, pictures, messages and records."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from typer import Argument, Option

import meshmatch
from meshmatch.cli import user_messages
from meshmatch.cli.options import PAIRS_HELP, PairOptions, RunOptions, check_outputs
from meshmatch.cli.user_messages import Console, Json
from meshmatch.models.registry import check_model
from meshmatch.outputs import replace_all_on_success

if TYPE_CHECKING:
    from meshmatch.api.results import MapPair
    from meshmatch.render.compose import Composition
    from meshmatch.transfer.low_confidence import LowConfidence

Source = Annotated[Path, Argument(metavar="SRC", help="Shape to transfer from.")]
Target = Annotated[Path, Argument(metavar="TGT", help="Shape to transfer to.")]
Picture = Annotated[Path | None, Option(metavar="PNG", help="Draw both shapes with what was transferred.")]


@dataclass(frozen=True)
class MapOptions(PairOptions):
    """Options of the map: its file, or how the shapes are matched."""

    for_matching: ClassVar[tuple[str, ...]] = (
        *("up", "front", "source_up", "source_front", "target_up", "target_front"),
        *("model", "refine", "partial", "mirror", "try_harder", "only", "without", "known_pairs"),
    )
    map: Path | None = Option(
        None,
        "--map",
        metavar="MAP",
        help="Use this map from the first shape to the second, as `meshmatch match` writes it, or a folder of `meshmatch "
        "fit` with the fits of both. Default: match the shapes, unless both have the same faces.",
    )


@dataclass(frozen=True)
class MapOptionsWithPairs(MapOptions):
    """The same, for commands whose --landmarks are the data to transfer."""

    known_pairs: Path | None = Option(None, "--pairs", metavar="FILE", help=PAIRS_HELP)


@dataclass(frozen=True)
class ViewMapOptions(MapOptions):
    """The same for the viewer, where the axes also set the orientation on the page."""

    for_matching = MapOptions.for_matching[2:]


@dataclass
class Transfer:
    """One transfer between two files; calling it with the loaded shapes finds the maps and reports on them."""

    source: Path
    target: Path
    output: Path
    options: MapOptions
    run: RunOptions
    picture: Path | None = None

    def __post_init__(self) -> None:
        self.console = Console(self.run.quiet)
        self.names = user_messages.names_of([self.source, self.target])

    @contextmanager
    def outputs(self, *read: Path | None, files: Sequence[Path] | None = None) -> Iterator[list[Path]]:
        """Yield temporary paths that become the output, or its ``files``, if the block succeeds.

        Outputs that cannot be written and contradicting options are reported before the work; ``read`` are other inputs.
        """
        from meshmatch.shapes.formats.gltf_vrm import check_character

        files = [self.output] if files is None else files
        check_character(self.target, self.output)
        self.options.check()
        if self.options.map is not None:
            hint = "it controls matching, but --map supplies the map: leave one of them out"
            self.options.refuse(self.options.for_matching, "--map", hint)
        check_outputs([self.source, self.target, self.options.map, *read], *files, picture=self.picture)
        with replace_all_on_success(files) as temporary:
            if self.options.map is None:
                check_model(self.options.model)  # an unknown model is reported before the long computation
            yield temporary

    @property
    def _has_matching_options(self) -> bool:
        """Whether an option was given that requires matching the shapes."""
        return any(name in self.options.given for name in self.options.for_matching)

    def __call__(self, source: meshmatch.Shape, target: meshmatch.Shape) -> MapPair:
        """Find the maps: from a file, by equal faces, or by matching. With --strict, raise `PoorFit` for a poor map."""
        from meshmatch.api.transfer import have_same_faces, vertex_to_vertex

        def matched(a: meshmatch.Shape, b: meshmatch.Shape) -> meshmatch.MatchResult:
            if self.options.only or self.options.without:  # weights of the fit, which are not transferred
                a, b = self.options.load(self.source, self.target)
            return self.options.match(a, b, self.run, self.console)

        if self.options.map is not None and self.options.map.is_dir():
            maps = meshmatch.Collection(self.options.map).maps_between(source, target)
        elif self.options.map is None and not self._has_matching_options and have_same_faces(source, target):
            maps = vertex_to_vertex(source, target)
        else:
            maps = meshmatch.find_maps(source, target, self.options.map or matched)
        found = maps.forward
        user_messages.raise_if_poor(self.run.strict, found.verdict, found.reasons, "the map")
        a, b = self.names
        if maps.match is None and self.options.map is None:
            self.console.say(f"{a} and {b} have the same faces: each vertex is mapped to the one with the same index")
        elif maps.match is None:
            self.console.say(f"used the map {self.options.map} from {a} to {b}")
        else:
            user_messages.report_match(self.console, maps.match, (a, b))
            self.console.say(f"matched {a} to {b} ({maps.match.seconds:.1f} s)")
        user_messages.report_verdict(self.console, found.verdict, found.reasons, "the map")
        return maps

    def report_low(self, low: LowConfidence, minimum: float, what: str = "vertices") -> Json:
        """Report how many values have low confidence and how they were handled; return the numbers for --json."""
        kept = low.low - low.filled - low.blank
        parts = (
            (low.filled, "filled in from their neighbours"),
            (low.blank, "left blank"),
            (kept, "kept as transferred"),
        )
        became = ", ".join(f"{count} {done}" for count, done in parts if count > 0)
        if low.low:
            self.console.say(
                f"{100.0 * low.low / low.total:.1f} % of the {what} ({low.low} of {low.total}) have no counterpart with "
                f"a value, or a confidence below {minimum:g}: {became}"
            )
        shares = {"min_confidence": minimum, "low_confidence": low.low, "low_confidence_share": low.low / low.total}
        return shares | {"blank": low.blank, "filled": low.filled}

    def draw(self, maps: MapPair, shown: Composition) -> None:
        """Draw what was transferred, on both shapes."""
        from meshmatch.render.facing import rotations_to_same_side

        assert self.picture is not None
        turns = rotations_to_same_side(maps.source, maps.target, maps.forward, maps.rotations)
        shown.rotated(turns).named(self.names).render(self.picture)
        self.console.say(f"drew {self.picture}: both shapes with what was transferred")

    def record(self, own: Json, maps: MapPair, confidence: float) -> Json:
        """The record for --json: the results of the command and the map that was used."""
        record: Json = {"output": self.output} | own | user_messages.map_record(maps.forward, self.names)
        record["map"] = self.options.map
        record["confidence_mean"] = user_messages.json_number(confidence)
        if maps.match is not None:
            record |= self.options.record(maps.match.source_fit) | {
                "notes": list(maps.match.notes),
                "seconds": round(maps.match.seconds, 3),
            }
        return record
