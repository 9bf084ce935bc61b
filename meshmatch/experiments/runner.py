"""Common infrastructure of all experiments: options, run metadata, caching of finished results, tables, one JSON line.

An experiment is a function with typer annotations that returns a `Report`; `command` turns it into the module's `main`.
Shared options (`Data`, `Seed`, `Threads`, ...) are declared here. Rows of a table are the dictionaries of the record:

    @command  # last in the module: if that is run as a program, it runs here
    def main(data: Data = DATA, seed: Seed = 0) -> Report:
        rows = [{"set": "scape", "mean_cm": 1.63}]
        return Report({"sets": rows}, [table("Errors", rows, {"set": "set", "mean": "mean_cm:.2f"})])

Every experiment has the option ``--save FILE``, which writes a file of results (`saved_record`): command, date, commit,
machine, data, the tables as printed, and their values. The pages of docs are made from such files
(`meshmatch.experiments.pages`).
"""

from __future__ import annotations

import datetime
import functools
import inspect
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from rich import progress
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.threads import set_threads

T = TypeVar("T")

DATA = Path("../shared/bench")
Data = Annotated[Path, typer.Option(help="folder of the evaluation data")]
Model = Annotated[str, typer.Option(help="name or folder of a model")]
Seed = Annotated[int, typer.Option(min=0)]
Threads = Annotated[int, typer.Option(min=1, help="threads of each process")]
Jobs = Annotated[int, typer.Option(min=1, help="processes")]
LimitPairs = Annotated[int | None, typer.Option(min=1, help="pairs of each set, evenly spread")]
Work = Annotated[Path | None, typer.Option(help="keep finished results in this folder, and reuse those that are there")]
Cache = Annotated[Path | None, typer.Option(help="folder for the cache of geodesic distances (10 GB for all sets)")]


@dataclass(frozen=True)
class Report:
    """Result of an experiment: the record for the JSON line, tables, and lines to print below them.

    ``stopped`` is an error to report last, on stderr; the exit status is then 1.
    """

    record: Mapping[str, Any]
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    stopped: MeshmatchError | None = None


Save = Annotated[Path | None, typer.Option(help="write tables, values and circumstances to this JSON file")]


def command(run: Callable[..., Report]) -> Callable[..., int]:
    """Decorate an experiment to become the module's ``main``: parse arguments, run, print, and return the exit status.

    If the module is run as a program, this runs it at once. The exit status is 0 for success, 1 if the data or an option is
    invalid (one line on stderr), 2 for wrong usage. The module's docstring is the command's help. The JSON line begins with
    metadata and options; ``--save`` also writes it to a file, with the tables.
    """
    module = sys.modules[run.__module__]
    spec = module.__spec__  # has the real name of a module that is run as __main__
    name = str(spec.name if spec else run.__module__).removeprefix("meshmatch.experiments.").removesuffix(".__main__")
    program = f"python -m meshmatch.experiments.{name}"

    def run_and_print(words: Sequence[str], save: Path | None, options: dict[str, Any]) -> None:
        threads, jobs = options.get("threads", 1), options.get("jobs", 1)
        set_threads(threads)
        start = time.perf_counter()
        try:
            report = run(**options)
        except MeshmatchError as error:
            explain(error)
            raise SystemExit(1) from None
        out = Console(width=None if os.isatty(1) else 140, highlight=False)  # a pipe has no width
        for each in report.tables:
            out.print(each)
        for line in report.notes:
            out.print(line, soft_wrap=True, markup=False)
        metadata = {"experiment": name, **run_metadata(threads, jobs), "options": to_json(options)}
        metadata["seconds"] = round(time.perf_counter() - start, 1)
        print(json.dumps(to_json({**metadata, **report.record})), flush=True)
        if save is not None:
            record = saved_record(metadata, [f"{program} {shlex.join(words)}".strip()], report)
            with replace_on_success(save) as temporary:
                temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        if report.stopped is not None:
            explain(report.stopped)
            raise SystemExit(1)

    def main(words: Sequence[str] | None = None) -> int:
        arguments = sys.argv[1:] if words is None else list(words)

        @functools.wraps(run)
        def called(save: Path | None = None, **options: Any) -> None:
            run_and_print(_without_save(arguments), save, options)

        signature = inspect.signature(run, eval_str=True)
        save_parameter = inspect.Parameter("save", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Save)
        called.__signature__ = signature.replace(parameters=[*signature.parameters.values(), save_parameter])  # type: ignore[attr-defined]
        called.__annotations__ = {**run.__annotations__, "save": Save}
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
        # Each item of a list becomes a paragraph; otherwise all are joined into one.
        paragraphs = (module.__doc__ or "").replace("\n- ", "\n\n- ").replace("\n  ", "\n")
        app.command(help=paragraphs)(called)
        try:
            typer.main.get_command(app)(args=arguments, prog_name=program)
        except SystemExit as stop:
            return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        return 0

    if run.__module__ == "__main__":
        sys.exit(main())
    return main


def _without_save(words: Sequence[str]) -> list[str]:
    """Arguments of a command line without ``--save``."""
    kept = [word for word in words if not word.startswith("--save=")]
    if "--save" in kept:
        index = kept.index("--save")
        del kept[index : index + 2]
    return kept


def saved_record(metadata: Mapping[str, Any], commands: Sequence[str], report: Report) -> dict[str, Any]:
    """Contents of a file of results: metadata, ``commands``, ``data``, ``tables`` as text and ``values`` as numbers."""
    data = metadata["options"].get("data", "generated")
    tables = [{"title": str(each.title), **dict(zip(("columns", "rows"), table_cells(each), strict=True))}
              for each in report.tables]  # fmt: skip
    return {**metadata, "commands": list(commands), "data": data, "tables": tables, "values": to_json(report.record)}


def explain(error: MeshmatchError) -> None:
    """Print an error and its hint on stderr."""
    console = Console(stderr=True, highlight=False)
    console.print(f"[red]error:[/] {escape(error.message)}", soft_wrap=True)
    if error.hint:
        console.print(f"[dim]hint:[/] {escape(error.hint)}", soft_wrap=True)


def cpu_seconds() -> float:
    """CPU seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


def log(line: str) -> None:
    """Print a line about the progress on stderr."""
    Console(stderr=True, highlight=False).print(line, markup=False, soft_wrap=True)


def track(items: Iterable[T], what: str, total: int | None = None) -> Iterable[T]:
    """Iterate over items with a progress bar on stderr."""
    console = Console(stderr=True)
    return progress.track(items, what, total=total, console=console, disable=not console.is_terminal)


def to_json(value: Any) -> Any:
    """Convert a value for JSON: tuples and arrays to lists, numbers that are not finite to null, paths to strings."""
    if isinstance(value, Mapping):
        return {str(key): to_json(each) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [to_json(each) for each in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def installed(methods: Sequence[str], packages: Sequence[str]) -> tuple[list[str], list[str]]:
    """Methods without those that are named like a package that is not installed, and a message for each of these."""
    missing = [name for name in methods if name in packages and find_spec(name) is None]
    return [name for name in methods if name not in missing], [f"skipped: {name} is not installed" for name in missing]


def split_names(words: str, known: Iterable[str], what: str) -> list[str]:
    """Split names separated by commas, without duplicates; ``what`` they are, for messages.

    Raises
    ------
    OptionError
        A name is unknown.
    """
    allowed = list(known)
    names = list(dict.fromkeys(word.strip() for word in words.split(",") if word.strip()))
    for name in names:
        if name not in allowed:
            raise OptionError(f"unknown {what} '{name}'", f"choose from {', '.join(allowed)}")
    return names


def files_in(folder: Path, pattern: str, least: int = 1) -> list[Path]:
    """Sorted files of a data folder that match a pattern; `InputError` if there are fewer than ``least``."""
    files = sorted(folder.glob(pattern))
    if len(files) < least:
        problem = f"there are {len(files) or 'no'} {pattern} files in {folder}"
        raise InputError(
            problem if least == 1 else f"{problem}, not {least} or more", "name the data's folder with --data"
        )
    return files


def evenly_spread(items: Sequence[T], count: int | None) -> list[T]:
    """Select ``count`` items at even distances in a sequence; all items if ``count`` is None or not smaller."""
    if count is None or count >= len(items):
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, max(1, count)).round().astype(int)]


def table(title: str, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> Table:
    """Build a table from rows.

    Parameters
    ----------
    columns
        For each heading the key in the rows, or "key:format" for numbers, which are aligned to the right (format ">" aligns
        text to the right). Missing values, None and nan give an empty cell.
    """
    result = Table(title=title, title_justify="left")
    for heading, column in columns.items():
        result.add_column(heading, justify="right" if ":" in column else "left", no_wrap=":" not in column)
    for row in rows:
        result.add_row(*(_cell(row, *column.partition(":")[::2]) for column in columns.values()))
    return result


def _cell(row: Mapping[str, Any], key: str, form: str) -> str:
    value = row.get(key)
    if value is None or value != value:
        return ""
    return format(value, form).replace("%", " %") if form != ">" else str(value)


def table_cells(table: Table) -> tuple[list[str], list[list[str]]]:
    """Columns and rows of a table as strings."""
    rows = zip(*(map(str, column.cells) for column in table.columns), strict=True)
    return [str(column.header) for column in table.columns], [list(row) for row in rows]


def run_metadata(threads: int, jobs: int = 1) -> dict[str, Any]:
    """Metadata of a run, as published with every number: date, commit, machine, Python, threads and jobs."""
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()}",
        "python": platform.python_version(),
        "threads": threads,
        "jobs": jobs,
    }


def commit(folder: Path = Path(__file__).parent) -> str:
    """Short hash of the checked-out commit, with "+" if tracked files were changed; "unknown" without git."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "--short=10", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def read_cached(path: Path, asked: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read a cached result; None if there is no file.

    Raises
    ------
    InputError
        The file is damaged.
    OptionError
        The result is for other options than ``asked``.
    """
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        record = None
    return check_cached(record, asked, str(path))


def check_cached(record: Any, asked: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Check a cached result; ``where`` names its origin in messages.

    Raises
    ------
    InputError
        It is not a result.
    OptionError
        The result is for other options than ``asked``.
    """
    try:
        stored = dict(record["asked"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{where} is not a result of this experiment", "remove it to measure again") from error
    requested = to_json(asked)
    if differences := sorted(key for key in {*stored, *requested} if stored.get(key) != requested.get(key)):
        raise OptionError(
            f"{where} was measured with other options ({', '.join(differences)})",
            "choose another output folder, or remove it",
        )
    return dict(record)


def write_cached(path: Path, asked: Mapping[str, Any], result: Mapping[str, Any]) -> dict[str, Any]:
    """Write a result to the cache together with its options, and return the record."""
    record: dict[str, Any] = to_json({"asked": asked, **result})
    make_folder(path.parent)
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return record


def cached(path: Path, asked: Mapping[str, Any], measure: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """Return a cached result, or measure and cache it; an interrupted run thus continues with what is missing."""
    result = read_cached(path, asked)
    return write_cached(path, asked, measure()) if result is None else result


def cached_in(
    work: Path | None, name: str, asked: Mapping[str, Any], measure: Callable[[], Mapping[str, Any]]
) -> dict[str, Any]:
    """As `cached`, in a file of the folder ``work``; without a folder always measure."""
    return to_json(measure()) if work is None else cached(work / f"{name}.json", asked, measure)
