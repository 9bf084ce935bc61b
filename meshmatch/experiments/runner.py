"""The runner that all experiments share: options, circumstances, finished work kept in a folder, tables, one JSON line.

An experiment is a function with typer annotations that returns a `Report`; `command` makes its `main`. Shared options
(`Data`, `Seed`, `Threads`, ...) are declared here once. Rows of a table are the dictionaries of the record:

    @command  # last in its module: where that is run as a program, it runs here
    def main(data: Data = DATA, seed: Seed = 0) -> Report:
        rows = [{"set": "scape", "mean_cm": 1.63}]
        return Report({"sets": rows}, [table("Errors", rows, {"set": "set", "mean": "mean_cm:.2f"})])

Every experiment takes ``--save FILE``, which writes a file of results (`saved_record`): by which command, when, on which
commit, machine and data it ran, its tables as they are printed, and its values. The pages are made from such files
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
Work = Annotated[Path | None, typer.Option(help="keep what is finished in this folder, and go on with what is there")]
Cache = Annotated[Path | None, typer.Option(help="folder of kept geodesic distances (10 GB for all sets)")]


@dataclass(frozen=True)
class Report:
    """What an experiment found: the record for the JSON line, tables, and lines to print below them.

    ``stopped`` is told last, on stderr, and makes the status 1.
    """

    record: Mapping[str, Any]
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    stopped: MeshmatchError | None = None


Save = Annotated[Path | None, typer.Option(help="write tables, values and circumstances to this JSON file")]


def command(run: Callable[..., Report]) -> Callable[..., int]:
    """The ``main`` of an experiment: parse words, run, print, and return the exit status. Called at once in a module that is
    run as a program.

    0: it ran; 1: the data or a choice stopped it (one line on stderr); 2: usage. The module's docstring is its help. The
    JSON line begins with the circumstances and the options; with ``--save`` it is written to a file too, with the tables.
    """
    module = sys.modules[run.__module__]
    spec = module.__spec__  # a module that is run is called __main__
    name = str(spec.name if spec else run.__module__).removeprefix("meshmatch.experiments.").removesuffix(".__main__")
    program = f"python -m meshmatch.experiments.{name}"

    def body(words: Sequence[str], save: Path | None, options: dict[str, Any]) -> None:
        threads, jobs = options.get("threads", 1), options.get("jobs", 1)
        set_threads(threads)
        began = time.perf_counter()
        try:
            report = run(**options)
        except MeshmatchError as error:
            explain(error)
            raise SystemExit(1) from None
        out = Console(width=None if os.isatty(1) else 140, highlight=False)  # a pipe has no width of its own
        for each in report.tables:
            out.print(each)
        for line in report.notes:
            out.print(line, soft_wrap=True, markup=False)
        head = {"experiment": name, **circumstances(threads, jobs), "options": plain(options)}
        head["seconds"] = round(time.perf_counter() - began, 1)
        print(json.dumps(plain({**head, **report.record})), flush=True)
        if save is not None:
            record = saved_record(head, [f"{program} {shlex.join(words)}".strip()], report)
            with replace_on_success(save) as temporary:
                temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        if report.stopped is not None:
            explain(report.stopped)
            raise SystemExit(1)

    def main(words: Sequence[str] | None = None) -> int:
        given = sys.argv[1:] if words is None else list(words)

        @functools.wraps(run)
        def called(save: Path | None = None, **options: Any) -> None:
            body(_without_save(given), save, options)

        known = inspect.signature(run, eval_str=True)
        last = inspect.Parameter("save", inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Save)
        called.__signature__ = known.replace(parameters=[*known.parameters.values(), last])  # type: ignore[attr-defined]
        called.__annotations__ = {**run.__annotations__, "save": Save}
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
        app.command(help=module.__doc__)(called)
        try:
            typer.main.get_command(app)(args=given, prog_name=program)
        except SystemExit as stop:
            return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        return 0

    if run.__module__ == "__main__":
        sys.exit(main())
    return main


def _without_save(words: Sequence[str]) -> list[str]:
    """Words of a command line without the option that writes the file they stand in."""
    kept = [word for word in words if not word.startswith("--save=")]
    if "--save" in kept:
        at = kept.index("--save")
        del kept[at : at + 2]
    return kept


def saved_record(head: Mapping[str, Any], commands: Sequence[str], report: Report) -> dict[str, Any]:
    """A file of results: ``commands``, circumstances, ``data``, ``tables`` of words and ``values`` of numbers."""
    data = head["options"].get("data", "generated")
    tables = [{"title": str(each.title), **dict(zip(("columns", "rows"), words_of(each), strict=True))}
              for each in report.tables]  # fmt: skip
    return {**head, "commands": list(commands), "data": data, "tables": tables, "values": plain(report.record)}


def explain(error: MeshmatchError) -> None:
    """Print on stderr what stopped an experiment."""
    console = Console(stderr=True, highlight=False)
    console.print(f"[red]error:[/] {escape(error.message)}", soft_wrap=True)
    if error.hint:
        console.print(f"[dim]hint:[/] {escape(error.hint)}", soft_wrap=True)


def tell(line: str) -> None:
    """Print on stderr what is going on."""
    Console(stderr=True, highlight=False).print(line, markup=False, soft_wrap=True)


def track(items: Iterable[T], what: str, total: int | None = None) -> Iterable[T]:
    """The same items, with a progress bar on stderr."""
    console = Console(stderr=True)
    return progress.track(items, what, total=total, console=console, disable=not console.is_terminal)


def plain(value: Any) -> Any:
    """What JSON can say: paths as words, tuples as lists, numbers that are not finite as null."""
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(each) for each in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def installed(methods: Sequence[str], packages: Sequence[str]) -> tuple[list[str], list[str]]:
    """The methods but those named as a package that is not here, and a line for each of these."""
    missing = [name for name in methods if name in packages and find_spec(name) is None]
    return [name for name in methods if name not in missing], [f"skipped: {name} is not installed" for name in missing]


def names_of(words: str, known: Iterable[str], what: str) -> list[str]:
    """Names separated by commas, each once and in the order given.

    Raises
    ------
    OptionError
        A name that is not known.
    """
    allowed = list(known)
    names = list(dict.fromkeys(word.strip() for word in words.split(",") if word.strip()))
    for name in names:
        if name not in allowed:
            raise OptionError(f"unknown {what} '{name}'", f"choose from {', '.join(allowed)}")
    return names


def files_in(folder: Path, pattern: str, least: int = 1) -> list[Path]:
    """The files of a folder of data, sorted; `InputError` where there are fewer than this."""
    files = sorted(folder.glob(pattern))
    if len(files) < least:
        few = f"there are {len(files) or 'no'} {pattern} files in {folder}"
        raise InputError(few if least == 1 else f"{few}, not {least} or more", "name the data's folder with --data")
    return files


def spread(items: Sequence[T], count: int | None) -> list[T]:
    """``count`` items, evenly spread over a sequence and always the same ones; all of them for None or a large count."""
    if count is None or count >= len(items):
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, max(1, count)).round().astype(int)]


def table(title: str, rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> Table:
    """Rows as a table.

    Parameters
    ----------
    columns
        Heading: key of the row, or "key:format" for numbers, which stand to the right (format ">" for words that do).
        What a row lacks, None and nan leave the cell empty.
    """
    drawn = Table(title=title, title_justify="left")
    for heading, column in columns.items():
        drawn.add_column(heading, justify="right" if ":" in column else "left", no_wrap=":" not in column)
    for row in rows:
        drawn.add_row(*(_cell(row, *column.partition(":")[::2]) for column in columns.values()))
    return drawn


def _cell(row: Mapping[str, Any], key: str, form: str) -> str:
    value = row.get(key)
    if value is None or value != value:
        return ""
    return format(value, form).replace("%", " %") if form != ">" else str(value)


def words_of(drawn: Table) -> tuple[list[str], list[list[str]]]:
    """A table's columns and rows, as words."""
    rows = zip(*(map(str, column.cells) for column in drawn.columns), strict=True)
    return [str(column.header) for column in drawn.columns], [list(row) for row in rows]


def circumstances(threads: int, jobs: int = 1) -> dict[str, Any]:
    """Date, commit, machine and threads, as every published number needs them."""
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


def recall(path: Path, asked: Mapping[str, Any]) -> dict[str, Any] | None:
    """A kept result; None where there is no file.

    Raises
    ------
    InputError
        The file is damaged.
    OptionError
        It was measured with other choices than ``asked``.
    """
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        found = None
    return as_asked(found, asked, str(path))


def as_asked(found: Any, asked: Mapping[str, Any], where: str) -> dict[str, Any]:
    """A kept result, which must be one; ``where`` it was kept, in words.

    Raises
    ------
    InputError
        It is no result.
    OptionError
        It was measured with other choices than ``asked``.
    """
    try:
        before = dict(found["asked"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{where} is not a result of this experiment", "remove it to measure again") from error
    now = plain(asked)
    if differences := sorted(key for key in {*before, *now} if before.get(key) != now.get(key)):
        raise OptionError(
            f"{where} was measured with other choices ({', '.join(differences)})",
            "choose another output folder, or remove it",
        )
    return dict(found)


def keep(path: Path, asked: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, Any]:
    """Write a result with the choices that it belongs to, and return both."""
    record: dict[str, Any] = plain({"asked": asked, **found})
    make_folder(path.parent)
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return record


def once(path: Path, asked: Mapping[str, Any], measure: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """A kept result, measured and written where there is none: a run that was stopped goes on with what is missing."""
    found = recall(path, asked)
    return keep(path, asked, measure()) if found is None else found


def at_work(
    work: Path | None, name: str, asked: Mapping[str, Any], measure: Callable[[], Mapping[str, Any]]
) -> dict[str, Any]:
    """As `once`, in a file of this name; measured anew where there is no folder for it."""
    return plain(measure()) if work is None else once(work / f"{name}.json", asked, measure)
