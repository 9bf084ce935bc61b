"""``meshmatch fit`` and ``map``: fit the shapes of a collection, and map any two of them."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

import meshmatch
from meshmatch.cli import options
from meshmatch.cli.options import FitOptions, grouped, optional, output_option
from meshmatch.cli.user_messages import Console, map_record, print_json
from meshmatch.errors import OptionError, PoorFit
from meshmatch.models.registry import AUTO, NO_MODEL, check_model
from meshmatch.outputs import plain_text, replace_on_success

if TYPE_CHECKING:
    from meshmatch.collections.collection import Collection
    from meshmatch.collections.setting import Record

Jobs = Annotated[int | None, Option(min=1, metavar="N", help="Number of processes. Default: one per core.")]
Scheduler = Annotated[
    str | None,
    Option(
        metavar="ADDRESS",
        help="Run on the workers of a Dask scheduler, such as tcp://127.0.0.1:8786. They must have access to the same "
        "files (needs meshmatch[cluster]).",
    ),
]


_MAX_LISTED = 5  # ignored files in one message

# Row of the table: the residual is in % of sqrt(area), the distance of the surfaces in the unit of the files.
_ROW = "{:<28} {:<7} {:>6} {:>9} {:>9} {:>4} {:>6} {:>11} {:>8}"


@grouped
def fit(
    *,
    shapes: list[str] = Argument(..., metavar="SHAPES", help="Files, folders, or patterns in quotes; URLs of folders."),
    output: str = output_option("FITS", "The folder of the fits, or its URL; an existing one is continued."),
    how: FitOptions,
    agree: bool = Option(
        True,
        "--agree/--alone",
        help="Refine all fits jointly, towards a common stretch of the template (--agree), or each on its own (--alone).",
    ),
    sequence: bool = Option(
        False, "--sequence", help="The shapes are frames of a sequence: each fit starts from the previous one."
    ),
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    strict: bool = Option(False, "--strict", help="Exit with status 1 if a shape cannot be fitted, or a fit is poor."),
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Fit every shape of a collection once.

    Maps between any two shapes (`map`) and atlases (`atlas`) are made from the fits. Each shape is reported when it is
    finished; a shape that cannot be fitted does not stop the others. Run the command again to continue after an
    interruption or to add shapes. Without --model, the first shape decides the model; shapes of other kinds are fitted
    with the models of their kinds, in FITS/KIND. With --model none, the template is built from the shapes themselves, in
    any pose and orientation; mirror images and cut shapes are recognised. FITS/fits.csv lists the result of every shape.
    """
    from meshmatch.collections.fit_all import elsewhere_messages
    from meshmatch.collections.setting import FAILED, LEFT_OUT
    from meshmatch.collections.sources import WARNED

    how.check()
    if how.model != NO_MODEL:
        check_model(how.model)
    console = Console(quiet)

    report = _table(console)
    with console.progress() as progress:
        collection = meshmatch.Collection(output, scheduler or jobs, progress)
        made = collection.fit(
            shapes, model=how.model, config=how.configs()[0], only=how.only or (), without=how.without or (),
            sequence=sequence, agree=agree, tell=report,
        )  # fmt: skip
    counts, verdicts = made.counts, _summarize_verdicts(made.counts)
    for where in dict.fromkeys([output, *made.elsewhere.values()]):
        records = [each for each in made.records if made.elsewhere.get(each.name, output) == where]
        written = sum(each.fitted for each in records)
        model = made.model if where == output else meshmatch.Collection(where).model
        chosen = f" (model {model})" if how.model == AUTO else ""
        found = _summarize_verdicts(replace(made, records=tuple(records)).counts)
        console.say(f"wrote {written} fit{'s' * (written != 1)} to {where}{chosen}: {found}")
    ignored = [each for each in made.records if each.verdict == LEFT_OUT]
    if others := [each.name for each in ignored if not each.reasons.startswith(WARNED)]:
        console.say(f"ignored, as they are not shapes: {_summarize_files(others)}; see {output}/fits.csv")
    console.say(*elsewhere_messages(made.elsewhere))
    if counts["poor"] and not how.try_harder:
        console.say("to search longer for poor fits, run the same command with --try-harder")
    _report_distances(console, made.records, made.model)
    if made.agreed:
        console.say(f"{made.agreed} fits were refined jointly, so that the template stretches alike")
    if json:
        print_json({"output": output, "model": made.model, "seed": how.seed, "agreed": made.agreed, "verdicts": counts})
    if strict and (counts["poor"] or counts[FAILED]):
        raise PoorFit(f"not every fit is to be trusted: {verdicts}", f"see {output}/fits.csv")


def _summarize_verdicts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)


def _report_distances(console: Console, records: "Sequence[Record]", model: str) -> None:
    """Print the distance between fits without a model and their shapes; warn of copied files, and of differing units."""
    from meshmatch.collections.registered import mixed_units

    same = defaultdict(list)
    for each in (each for each in records if each.fitted and each.digest):
        same[each.digest].append(each.name)
    for names in (names for names in same.values() if len(names) > 1):
        console.warn(f"{' and '.join(names)} are copies of one file: an atlas counts each of them")
    near = [each for each in records if each.verdict in ("good", "fair") and each.distance >= 0 and each.scale > 0]
    if units := mixed_units([each.name for each in near], [each.scale for each in near]):
        console.warn(units)
    elif near and model == NO_MODEL:
        mean, most = sum(each.distance for each in near) / len(near), max(each.furthest for each in near)
        console.say(f"surfaces lie {mean:.2g} apart on average, {most:.2g} at most, in the unit of the files")


def _summarize_files(files: Sequence[str]) -> str:
    """List the names of files, or the number of files by suffix if there are many."""
    if len(files) <= _MAX_LISTED:
        return ", ".join(plain_text(file) for file in files)
    counts = Counter(Path(file).suffix.lower() or "without a suffix" for file in files)
    return ", ".join(f"{number} {plain_text(suffix)}" for suffix, number in counts.most_common())


def _table(console: Console) -> Callable[["Record"], None]:
    """Make a function that prints the row of a shape, after a heading, and its warnings and notes."""
    lines = count()

    def report(record: "Record") -> None:
        if not next(lines):
            console.say(
                _ROW.format("shape", "verdict", "trust", "residual", "distance", "up", "front", "vertices", "seconds")
            )
        measured: tuple[str, ...] = (f"{record.trust:.2f}", f"{100 * record.residual:.1f} %", f"{record.distance:.2g}")
        measured += (record.up, record.front, f"{record.vertices:,}", f"{record.seconds:.1f}")
        console.say(_ROW.format(record.name, record.verdict, *(measured if record.fitted else [""] * 7)).rstrip())
        if not record.fitted or record.verdict == "poor":
            console.warn(f"{record.name}: {'' if record.fitted else 'not fitted: '}{record.reasons}")
        if record.notes:
            console.say(f"{record.name}: {record.notes}")

    return report


def map(
    fits: Annotated[str, Argument(metavar="FITS", help="A folder that `meshmatch fit` made, or its URL.")],
    names: Annotated[
        list[str] | None, Argument(metavar="A B", help="Names of two shapes, as in FITS/fits.csv: map A to B.")
    ] = None,
    *,
    output: str = output_option(
        "MAPS", "The folder of the maps; the map from A to B is MAPS/A/B with a suffix. For a single map, also a file."
    ),
    pairs: Path | None = optional("FILE", "Map these pairs: the names of a source and a target per line."),
    to: str | None = optional("NAME", "Map every shape to this one."),
    all_pairs: bool = Option(False, "--all", help="Map every shape to every other shape."),
    suffix: str = Option(
        ".npz", "--format", metavar="SUFFIX", help="Format of the maps: .npy, .npz, .csv, .txt, .mat or .json."
    ),
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Map shapes of a collection to each other.

    Choose the maps by two names A B, --pairs, --to or --all. The fits are used as they are. Existing maps are kept unless
    the fits are newer.
    """
    from meshmatch.collections.map_all import load_pairs
    from meshmatch.maps import MAP_SUFFIXES

    chosen = [bool(names), pairs is not None, to is not None, all_pairs].count(True)
    if chosen != 1:
        problem = "more than one choice of maps" if chosen else "no maps are chosen"
        raise OptionError(problem, "name two shapes, or give one of --pairs FILE, --to NAME and --all")
    if names and len(names) != 2:
        given = "one name was given" if len(names) == 1 else f"{len(names)} names were given"
        raise OptionError(f"a map leads from one shape to another, and {given}", "name the source and the target")
    console = Console(quiet)
    with console.progress() as progress:
        collection = meshmatch.Collection(fits, scheduler or jobs, progress)
        if names:
            pair = _name_of(collection, names[0]), _name_of(collection, names[1])
            if Path(output).suffix.lower() in MAP_SUFFIXES:
                _write_map(collection, pair, Path(output), console, json)
                return
            wanted = [pair]
        else:
            wanted = collection.pairs(to) if pairs is None else load_pairs(pairs)
        count = collection.save_maps(output, wanted, suffix=suffix)
    files = f"{output}/SOURCE/TARGET.{suffix.removeprefix('.')}"
    console.say(f"{count} map{'s' * (count != 1)} in {output}: {files}; those that were as new as the fits were kept")
    if json:
        print_json({"output": output, "fits": fits, "maps": count})


def _name_of(collection: "Collection", word: str) -> str:
    """The name of a shape, given by its name or file; `InputError` if it has no fit."""
    from meshmatch.shapes.input_files import stem_of

    known = collection.names
    found = next((name for name in (word, stem_of(Path(word))) if name in known), None)
    if found is None:
        collection.pairs(word)  # raises the error
    return found or word


def _write_map(collection: "Collection", pair: tuple[str, str], output: Path, console: Console, json: bool) -> None:
    """Write the map of two shapes into a file."""
    from meshmatch.maps.files import save_map

    with replace_on_success(output) as temporary:
        found = collection.map(*pair)
        save_map(temporary, found)
    console.say(f"wrote {output}: {pair[0]} to {pair[1]}, {found.verdict}")
    if json:
        print_json({"output": output, "fits": collection.store.location, "maps": 1} | map_record(found, pair))
