"""One transfer to several targets: files, a folder of shapes, or a folder of fits; what is finished is kept."""

from __future__ import annotations

import csv
import hashlib
import inspect
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from typer import Argument, Option

import meshmatch
from meshmatch.cli.options import check_outputs, check_writable
from meshmatch.cli.transfer_options import MapOptions
from meshmatch.cli.words import Console, Json, print_json
from meshmatch.errors import InputError, MeshmatchError, OptionError, OutputError
from meshmatch.models.registry import check_model

Verb = Callable[..., Json]
Gather = Callable[[Path, Mapping[str, Any], str, Mapping[str, Path]], str]
"""Writes one table of all, from its path, the verb's arguments, the source's name and the outputs by name; what to say."""
TABLE = "transfers.csv"
_COLUMNS = ("name", "file", "output", "verdict", "confidence", "seconds", "error", "made")
_ROW = "{:<28} {:<8} {:>10} {:>8}"
_FAILED, _FITS = "failed", "fits.csv"
_NAMED = 5  # targets that the last line lists
_Targets = Annotated[
    list[Path],
    Argument(
        metavar="TGT",
        help="Shape to transfer to. Or several: files, patterns in quotes, a folder of shapes, or a folder of fits, whose "
        "maps are used; the output is a folder then.",
    ),
]


def to_targets(suffix: str, *own: str, gather: Gather | None = None) -> Callable[[Verb], Callable[..., None]]:
    """Let a verb of one target, which returns its record for --json, take several.

    What it writes for each ends in ``suffix``, or as the target does where that is one of ``own``; if ``suffix`` is empty,
    as the garment does. ``gather`` writes what the verb's option ``table`` asks for.
    """

    def wrapped(verb: Verb) -> Callable[..., None]:
        @wraps(verb)
        def called(*, target: list[Path], ending: str | None, **rest: Any) -> None:
            if _several(target):
                _transfer_all(verb, target, lambda file: _ending(file, ending, suffix, own, rest), rest, gather)
                return
            if ending is not None:
                raise OptionError("--format is for several targets", "end the name of the output in it")
            if gather is not None and rest["table"] is not None:
                raise OptionError("--table is for several targets", "name them, their folder, or a folder of fits")
            record = verb(target=target[0], **rest)
            if rest["run"].json:
                print_json(record)

        usual = f"{suffix}{', or as TGT' if own else ''}" if suffix else "as GARMENT"
        words = f"With several targets, the suffix of each output. Default: {usual}."
        format_ = Option(None, "--format", metavar="SUFFIX", help=words)
        parameters = dict(inspect.signature(verb).parameters)
        parameters["target"] = parameters["target"].replace(annotation=_Targets)
        parameters["ending"] = inspect.Parameter("ending", inspect.Parameter.KEYWORD_ONLY, default=format_)
        called.__signature__ = inspect.Signature(list(parameters.values()))  # type: ignore[attr-defined]
        hints = get_type_hints(verb, include_extras=True)
        called.__annotations__ = hints | {"target": _Targets, "ending": str | None, "return": None}
        return called

    return wrapped


@dataclass(frozen=True)
class _Row:
    """What became of one target: a row of ``transfers.csv``. What it was made of and how is a digest."""

    name: str
    file: str
    output: str
    verdict: str
    confidence: str = ""
    seconds: str = ""
    error: str = ""
    made: str = ""


def _several(target: Sequence[Path]) -> bool:
    one = target[0]
    return len(target) > 1 or one.is_dir() or (not one.exists() and any(mark in str(one) for mark in "*?["))


def _ending(file: Path, given: str | None, suffix: str, own: Sequence[str], rest: Mapping[str, Any]) -> str:
    if given is not None:
        return f".{given.removeprefix('.')}"
    if not suffix:
        garment = rest["garment"].suffix.lower()
        return ".glb" if garment in (".gltf", ".vrm") else str(garment)
    if rest.get("values") is not None:  # a shape does not hold them
        return suffix
    return file.suffix.lower() if file.suffix.lower() in own else suffix


def _check_ending(verb: str, name: str, rest: Mapping[str, Any]) -> None:
    """Refuse a name that ends in what the verb cannot write (`OptionError`), once and before any target."""
    from meshmatch.api import blend_shapes, rig
    from meshmatch.shapes import files, textured_files
    from meshmatch.transfer import label_files, landmarks, value_files, weight_files

    if Path(name).name != name:
        raise OptionError(f"{name}: --format is a suffix", "such as .glb")
    colors = value_files.check_color_suffix if rest.get("values") is None else value_files.check_values_suffix
    checks: dict[str, Callable[[Path], object]] = {
        "transfer_color": colors,
        "transfer_labels": label_files.check_labels_suffix,
        "transfer_weights": weight_files.check_weights_suffix,
        "transfer_landmarks": landmarks.check_landmarks_suffix,
        "transfer_rig": rig.check_rig_suffix,
        "transfer_shapes": blend_shapes.check_suffix,
        "transfer_texture": lambda path: textured_files.check_textured(path, (".ply", ".off")),
        "transfer_garment": files.check_suffix,
    }
    checks[verb](Path(name))


def _transfer_all(
    verb: Verb, target: Sequence[Path], ending: Callable[[Path], str], rest: dict[str, Any], gather: Gather | None
) -> None:
    """Transfer to each target, say a row for each, and fail in the end if one failed."""
    from meshmatch.collections.stores import Store

    run, output, picture, table = rest["run"], rest["output"], rest["picture"], rest.get("table")
    _check_folders(output, picture)
    rest["maps"].check()
    files, maps, source = _files(target, output, rest["maps"], (rest["source"], rest.get("garment")))
    if table is not None:
        rest["table"] = None
        _check_table(table, source, files, rest)
    for each, name in {ending(file): name for name, file in reversed(files.items())}.items():
        _check_ending(verb.__name__, f"{name.rpartition('/')[2]}{each}", rest)
    if maps.map is None:
        check_model(maps.model)
    console = Console(run.quiet)
    rest |= {"maps": maps, "run": _changed(run, json=False, quiet=True)}
    how = _how(verb, rest)
    with Store.of(output).alone():
        rows = _read(output / TABLE)
        _write(output / TABLE, rows.values())
        console.say(_ROW.format("target", "verdict", "confidence", "seconds"))
        told, records = [], []
        for name, file in files.items():
            written = output / f"{name}{ending(file)}"
            made, before = _digest(how, file), rows.get(name)
            drawn = None if picture is None else picture / f"{name}.png"
            kept = before is not None and before.made == made and before.output == str(written) and written.exists()
            kept = kept and (drawn is None or drawn.exists())
            if before is None or not kept:
                row, record = _transfer(verb, name, rest | {"target": file, "output": written, "picture": drawn}, made)
                if not _outlives(before, row):
                    rows[name] = row
                    with (output / TABLE).open("a", encoding="utf-8", newline="") as lines:
                        csv.writer(lines, lineterminator="\n").writerow(asdict(row).values())
            else:
                row, record = before, {"output": before.output, "verdict": before.verdict, "kept": True}
            told.append(row)
            records.append({"name": name, "file": str(file)} | record)
            console.say(_ROW.format(name, row.verdict, row.confidence, "kept" if kept else row.seconds).rstrip())
            if row.error:
                console.warn(f"{name}: {row.error}")
        _write(output / TABLE, rows.values())
        written = {row.name: Path(row.output) for row in told if row.verdict != _FAILED}
        if gather is not None and table is not None and written:
            console.say(gather(table, rest, source, written))
    _tell(console, output, told, records, run.json)


def _outlives(before: _Row | None, row: _Row) -> bool:
    """Whether what was written before, as another file, is still there, and nothing new is."""
    if before is None or before.verdict == _FAILED or row.verdict != _FAILED:
        return False
    return before.output != row.output and Path(before.output).exists()


def _transfer(verb: Verb, name: str, rest: dict[str, Any], made: str) -> tuple[_Row, Json]:
    """What became of one target; that a transfer fails stops no other."""
    from meshmatch.outputs import make_folder

    file, output, began = str(rest["target"]), str(rest["output"]), time.monotonic()
    try:
        for path in (rest["output"], rest["picture"]):
            if path is not None:
                make_folder(path.parent)
        record = verb(**rest)
    except MeshmatchError as error:
        words = error.message + (f" ({error.hint})" if error.hint else "")
        return _Row(name, file, output, _FAILED, error=words), {"verdict": _FAILED, "error": words}
    known = record["confidence_mean"]
    confidence, seconds = "" if known is None else f"{known:.2f}", f"{time.monotonic() - began:.1f}"
    return _Row(name, file, output, record["verdict"], confidence, seconds, made=made), record


def _tell(console: Console, output: Path, rows: Sequence[_Row], records: list[Json], json: bool) -> None:
    counts = Counter(row.verdict for row in rows)
    told = ", ".join(f"{counts[verdict]} {verdict}" for verdict in sorted(counts))
    done = len(rows) - counts[_FAILED]
    console.say(f"{done} of {len(rows)} targets are in {output}: {told}; see {output / TABLE}")
    if json:
        print_json({"output": output, "table": output / TABLE, "verdicts": counts, "targets": records})
    if counts[_FAILED]:
        failed = [row.name for row in rows if row.verdict == _FAILED]
        names = ", ".join(failed[:_NAMED]) + (", ..." if len(failed) > _NAMED else "")
        hint = "warnings above say why; the same command goes on with what is missing"
        raise InputError(f"{len(failed)} of {len(rows)} targets failed: {names}", hint)


def _check_table(table: Path, source: str, files: Mapping[str, Path], rest: Mapping[str, Any]) -> None:
    """Refuse a table of all that could not be written afterwards (`OptionError`, `OutputError`)."""
    from meshmatch.transfer.landmarks import check_table_suffix

    check_table_suffix(table)
    if source in files:
        problem = f"the source and a target are both called {source}"
        raise OptionError(problem, "rename one: a table has specimens by name")
    check_outputs([*files.values(), rest["source"], rest["landmarks"]], table)
    check_writable(table)


def _check_folders(output: Path, picture: Path | None) -> None:
    """Refuse files where folders are needed (`OptionError`)."""
    from meshmatch.shapes.files import SUFFIXES

    for path, what in ((output, "the output"), (picture, "the picture")):
        if path is not None and path.suffix.lower() in (*SUFFIXES, ".npz", ".csv", ".txt", ".json", ".png"):
            raise OptionError(f"of several targets {what} is a folder, not {path.name}", "give a name without a suffix")


def _files(
    target: Sequence[Path], output: Path, maps: MapOptions, others: tuple[Path, Path | None]
) -> tuple[dict[str, Path], MapOptions, str]:
    """The targets by name, without other inputs, of which the source is the first; where their maps come from; and what
    the source is called among them.
    """
    from meshmatch.collections.sources import find_sources
    from meshmatch.collections.stores import Store
    from meshmatch.shapes.input_files import stem_of

    fits = target[0] / _FITS
    if len(target) == 1 and fits.is_file():
        with fits.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row.get("verdict") != _FAILED]
        found = {_inner(str(row.get("name")), fits): Path(str(row.get("file"))) for row in rows}
        if maps.map is None and meshmatch.Collection(target[0]).holds(others[0]):
            maps = _changed(maps, map=target[0])
    else:
        sources, _ = find_sources([str(each) for each in target], Store.of(output))
        found = {source.name: Path(source.path) for source in sources}
    taken = {os.path.realpath(path) for path in others if path is not None}
    own = os.path.realpath(others[0])
    source = next((name for name, file in found.items() if os.path.realpath(file) == own), stem_of(others[0]))
    found = {name: file for name, file in found.items() if os.path.realpath(file) not in taken}
    if not found:
        raise InputError(f"there is no target in {target[0]}", "name files or folders of shapes")
    return found, maps, source


def _inner(name: str, table: Path) -> str:
    """A name of a table; `InputError` if a file named so could lie outside of the folder it is meant for."""
    path = Path(name)
    if not path.parts or path.anchor or ".." in path.parts or "\0" in name:
        raise InputError(f"{table}: {name!r} is no name of a shape", "correct that row, or fit the shapes again")
    return name


def _changed(options: Any, **changes: Any) -> Any:
    """A group of options with others; which were given stays known."""
    new = replace(options, **changes)
    object.__setattr__(new, "given", options.given)
    return new


def _how(verb: Verb, rest: Mapping[str, Any]) -> str:
    """All that decides about the results but the target: choices, and the files that are read."""
    parts = [meshmatch.__version__, verb.__name__]
    for name, value in sorted(rest.items()):
        if name in ("run", "output", "picture"):
            continue
        values = asdict(value) if is_dataclass(value) and not isinstance(value, type) else {name: value}
        for key, each in sorted(values.items()):
            parts.append(f"{key}={each!r}")
            listed = each if isinstance(each, list | tuple) else [each]
            parts += [_state(path) for path in listed if isinstance(path, Path)]
    return "\n".join([*parts, f"strict={rest['run'].strict}"])


def _state(path: Path) -> str:
    """What tells whether a file, or one in a folder, has changed."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    found = [(file, file.stat()) for file in files if file.is_file()]
    return " ".join(f"{file} {state.st_size} {state.st_mtime_ns}" for file, state in found)


def _digest(how: str, file: Path) -> str:
    return hashlib.blake2b(f"{how}\n{_state(file)}".encode(errors="surrogatepass"), digest_size=16).hexdigest()


def _read(path: Path) -> dict[str, _Row]:
    """The rows of a table that a run before wrote; `OutputError` if it is something else."""
    if not path.exists():
        return {}
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.reader(file)
            if tuple(next(lines, ())) != _COLUMNS:
                raise ValueError
            rows = [_Row(*line) for line in lines if len(line) == len(_COLUMNS)]
    except (OSError, ValueError, csv.Error) as error:
        raise OutputError(f"{path} is no table of transfers", "choose another folder") from error
    return {row.name: row for row in rows}


def _write(path: Path, rows: Iterable[_Row]) -> None:
    from meshmatch.outputs import replace_on_success
    from meshmatch.shapes.tables import write_rows

    with replace_on_success(path) as temporary:
        write_rows(temporary, _COLUMNS, ([str(each) for each in asdict(row).values()] for row in rows))
