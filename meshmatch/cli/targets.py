"""Run a transfer to several targets: files, a folder of shapes, or a folder of fits; finished outputs are kept."""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_type_hints

from typer import Argument, Option

from meshmatch.cli.options import check_outputs, check_writable
from meshmatch.cli.user_messages import Console, Json, print_json
from meshmatch.collections.suffixes import DEFAULT_SUFFIXES
from meshmatch.errors import InputError, OptionError
from meshmatch.models.registry import check_model

if TYPE_CHECKING:
    from meshmatch.collections.transfer_table import TransferRecord

Verb = Callable[..., Json]
Check = Callable[[Mapping[str, Any]], object]
"""Checks the command's arguments before the work, for errors that every target would have."""


class Gather(NamedTuple):
    """How one table with the results of all targets is written."""

    check: Callable[[Path], object]
    """Checks the path of the table (`OptionError`)."""
    write: Callable[[Path, Mapping[str, Any], str, Mapping[str, Path]], str]
    """Writes the table, given its path, the command's arguments, the source's name and the outputs by name; returns a
    message on what was written."""


_ROW = "{:<28} {:<8} {:>10} {:>8}"
_MAX_LISTED = 5  # failed targets in the last message
_SEVERAL = (
    "Several are possible: files, quoted patterns, a folder of shapes, or a folder of fits, whose maps are used. The output "
    "is then a folder."
)


def to_targets(
    transfer: str, gather: Gather | None = None, check: Check | None = None
) -> Callable[[Verb], Callable[..., None]]:
    """Let a command for one target, which returns its record for --json, accept several targets.

    ``transfer`` is the name of the function of `meshmatch` that the command calls; ``gather`` writes the table of its option
    ``table``; ``check`` is called once, before the work.
    """

    def wrapped(verb: Verb) -> Callable[..., None]:
        @wraps(verb)
        def called(*, target: list[Path], ending: str | None, **rest: Any) -> None:
            if _is_several(target):
                _transfer_all(verb, transfer, target, ending, rest, gather, check)
                return
            if ending is not None:
                raise OptionError(
                    "--format is for several targets", "for one target, the suffix of --output chooses the format"
                )
            if gather is not None and rest["table"] is not None:
                raise OptionError("--table is for several targets", "name them, their folder, or a folder of fits")
            record = verb(target=target[0], **rest)
            if rest["run"].json:
                print_json(record)

        found = DEFAULT_SUFFIXES[transfer]
        usual = f"{found.suffix}{', or as TGT' if found.own else ''}" if found.suffix else "as GARMENT"
        help_text = f"With several targets, the suffix of each output. Default: {usual}."
        format_ = Option(None, "--format", metavar="SUFFIX", help=help_text)
        parameters = dict(inspect.signature(verb).parameters)
        hints = get_type_hints(verb, include_extras=True)
        one = hints["target"].__metadata__[0]
        targets = Annotated[list[Path], Argument(metavar=one.metavar, help=f"{one.help} {_SEVERAL}")]
        parameters["target"] = parameters["target"].replace(annotation=targets)
        parameters["ending"] = inspect.Parameter("ending", inspect.Parameter.KEYWORD_ONLY, default=format_)
        called.__signature__ = inspect.Signature(list(parameters.values()))  # type: ignore[attr-defined]
        called.__annotations__ = hints | {"target": targets, "ending": str | None, "return": None}
        return called

    return wrapped


def _is_several(target: Sequence[Path]) -> bool:
    one = target[0]
    return len(target) > 1 or one.is_dir() or (not one.exists() and any(mark in str(one) for mark in "*?["))


def _transfer_all(
    verb: Verb,
    transfer: str,
    target: Sequence[Path],
    ending: str | None,
    rest: dict[str, Any],
    gather: Gather | None,
    check: Check | None,
) -> None:
    """Transfer to each target and print a row for each; raise in the end if a transfer failed."""
    from meshmatch.collections.setting import FAILED
    from meshmatch.collections.suffixes import choose_suffix
    from meshmatch.collections.transfer_table import transfer_each
    from meshmatch.collections.transfers import Targets

    run, output, picture, table = rest["run"], rest["output"], rest["picture"], rest.get("table")
    _check_folders(output, picture)
    maps, garment = rest["maps"], rest.get("garment")
    maps.check()
    found = Targets.find(target, rest["source"], garment, output)
    if maps.map is None and found.fits is not None:
        maps.refuse(maps.for_matching, "a folder of fits", "its maps are used, and nothing is matched: leave it out")
        maps = _changed(maps, map=found.fits)
    if table is not None:
        rest["table"] = None
        if gather is not None:
            gather.check(table)
        _check_table(table, found.source, found.files, rest)
    if rest.get("values") is not None:
        transfer = "transfer_values"
    elif ending is not None and ending.removeprefix(".") in ("ply", "off") and transfer == "transfer_texture":
        transfer = "transfer_colors"
    endings = choose_suffix(transfer, ending, garment, found.files, rest.get("join", False))
    if maps.map is None:
        check_model(maps.model)
    if check is not None:
        check(rest)
    console = Console(run.quiet)
    rest |= {"maps": maps, "run": _changed(run, json=False, quiet=True)}
    how = {name: value for name, value in rest.items() if name not in ("run", "output", "picture")}
    records: dict[str, Json] = {}
    warned: set[str] = set()
    has_header = False

    def picture_of(name: str) -> Path | None:
        return None if picture is None else picture / f"{name}.png"

    def transfer_one(name: str, file: Path, path: Path) -> tuple[str, float | None]:
        record = verb(**rest | {"target": file, "output": path, "picture": picture_of(name)})
        records[name] = record
        return record["verdict"], record["confidence_mean"]

    def report(record: TransferRecord) -> None:
        nonlocal has_header
        if not has_header:
            console.say(_ROW.format("target", "verdict", "confidence", "seconds"))
            has_header = True
        *_, confidence, seconds, _, _ = record.row()
        last = "kept" if record.kept else seconds
        console.say(_ROW.format(record.name, record.verdict, confidence, last).rstrip())
        if record.error and record.error not in warned:  # an error of the source repeats for each target
            warned.add(record.error)
            console.warn(f"{record.name}: {record.error}")

    rows = transfer_each(
        found.files, output, endings, (verb.__name__, how, run.strict), transfer_one, report, picture_of
    )
    written = {row.name: Path(row.output) for row in rows if row.verdict != FAILED}
    if gather is not None and table is not None and written:
        console.say(gather.write(table, rest, found.source, written))
    results = [{"name": row.name, "file": row.file} | records.get(row.name, _record(row)) for row in rows]
    _report_all(console, output, rows, results, run.json)


def _record(row: TransferRecord) -> Json:
    """The record for --json of a target that was kept or failed."""
    if row.kept:
        return {"output": row.output, "verdict": row.verdict, "kept": True}
    return {"verdict": row.verdict, "error": row.error}


def _report_all(
    console: Console, output: Path, rows: Sequence[TransferRecord], records: list[Json], json: bool
) -> None:
    """Print the summary of all transfers; raise `InputError` if one failed."""
    from meshmatch.collections.setting import FAILED
    from meshmatch.collections.transfer_table import TABLE

    counts = Counter(row.verdict for row in rows)
    verdicts = ", ".join(f"{counts[verdict]} {verdict}" for verdict in sorted(counts))
    done = len(rows) - counts[FAILED]
    console.say(f"{done} of {len(rows)} targets are in {output}: {verdicts}; see {output / TABLE}")
    if json:
        print_json({"output": output, "table": output / TABLE, "verdicts": counts, "targets": records})
    if counts[FAILED]:
        failed = [row for row in rows if row.verdict == FAILED]
        names = ", ".join([row.name for row in failed[:_MAX_LISTED]] + (["..."] if len(failed) > _MAX_LISTED else []))
        reasons = {row.error for row in failed}
        names += f", all for one reason: {reasons.pop()}" if len(reasons) < min(len(failed), 2) else ""
        hint = "the warnings above say why; the same command continues with the missing ones"
        raise InputError(f"{len(failed)} of {len(rows)} targets failed: {names}", hint)


def _check_table(table: Path, source: str, files: Mapping[str, Path], rest: Mapping[str, Any]) -> None:
    """Check before the transfers that the table can be written (`OptionError`, `OutputError`)."""
    if source in files:
        problem = f"the source and a target are both called {source}"
        raise OptionError(problem, "rename one: the table lists specimens by name")
    check_outputs([*files.values(), rest["source"], rest["landmarks"], rest.get("measurements")], table)
    check_writable(table)


def _check_folders(output: Path, picture: Path | None) -> None:
    """Raise `OptionError` if the output or picture is named like a file, where a folder is needed."""
    from meshmatch.shapes.files import SUFFIXES

    for path, what in ((output, "the output"), (picture, "the picture")):
        if path is not None and path.suffix.lower() in (*SUFFIXES, ".npz", ".csv", ".txt", ".json", ".png"):
            raise OptionError(
                f"for several targets {what} is a folder, not {path.name}", "give a name without a suffix"
            )


def _changed(options: Any, **changes: Any) -> Any:
    """Copy a group of options with changes, keeping the record of which were given."""
    new = replace(options, **changes)
    object.__setattr__(new, "given", options.given)
    return new
