"""Tables of the pages, made from the files in docs/results.

``python -m meshmatch.experiments.pages [--check]``

Every experiment writes such a file with ``--save docs/results/NAME.json``: when, on which commit and machine, and by which
command it ran, and its tables. A page asks for a table between two comments,

    <!-- results NAME 1: set, mean cm, median cm -->
    <!-- end -->

the number of the table in the file, from 1, and which columns (all of them where none is named). A page of its own words
may begin the table of several files with ``<!-- summary -->``. Whatever stands between the comments is replaced.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from meshmatch.errors import InputError
from meshmatch.experiments import runner

DOCS = Path(__file__).parents[2] / "docs"
PAGES = ("results.md", "paper.md")
_BLOCK = re.compile(r"(<!-- (results|summary)([^>]*?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Row:
    """A row of the summary: what it is called, where it stands, and in which columns.

    ``where`` picks the row of the file's table by the beginnings of its cells; ``cells`` names the file's column for each of
    the summary's.
    """

    name: str
    file: str
    where: Mapping[str, str]
    cells: Mapping[str, str]
    unit: str
    table: int = 1


_CM = {"mean": "mean cm", "median": "median cm", "lost": "over 15 cm", "flips": "flips", "pairs": "pairs"}
_PART = {"mean": "mean cm", "median": "median", "lost": "over 15 cm", "pairs": "pairs"}
_X100 = {"mean": "mean", "median": "median pair", "lost": "over 10", "pairs": "pairs"}
SUMMARY = (
    Row(name="SCAPE", file="accuracy", where={"set": "scape", "refine": "nodes"}, cells=_CM, unit="cm"),
    Row(name="FAUST", file="accuracy", where={"set": "faust", "refine": "nodes"}, cells=_CM, unit="cm"),
    Row(name="SHREC'19", file="accuracy", where={"set": "shrec19", "refine": "nodes"}, cells=_CM, unit="cm"),
    Row(
        name="SCAPE, noisy points", file="accuracy", where={"set": "scape-pcn", "refine": "nodes"}, cells=_CM, unit="cm"
    ),
    Row(
        name="FAUST, points with outliers",
        file="outliers",
        where={},
        cells={"mean": "mean", "median": "median", "lost": "over 15 cm", "flips": "flips", "pairs": "pairs"},
        unit="cm",
    ),
    Row(name="SCAPE, one view", file="partial", where={"set": "scape", "part": "view"}, cells=_PART, unit="cm"),
    Row(name="SCAPE, cut", file="partial", where={"set": "scape", "part": "cut"}, cells=_PART, unit="cm"),
    Row(name="SHREC'19, one view", file="partial", where={"set": "shrec19", "part": "view"}, cells=_PART, unit="cm"),
    Row(name="SHREC'19, cut", file="partial", where={"set": "shrec19", "part": "cut"}, cells=_PART, unit="cm"),
    Row(
        name="people in clothes, generated",
        file="characters",
        where={"": "adults in clothes"},
        cells={"mean": "mean cm", "pairs": "pairs"},
        unit="cm",
    ),
    Row(
        name="stylised people, generated",
        file="characters",
        where={"": "stylised"},
        cells={"mean": "mean cm", "pairs": "pairs"},
        unit="cm",
    ),
    Row(name="animals", file="animals", where={"geodesic error × 100 / √area": "all"}, cells=_X100, unit="% of √area"),
    Row(
        name="hands, generated",
        file="hands-and-heads",
        where={"error in percent of the length": "hand"},
        cells=_X100,
        unit="% of the length",
    ),
    Row(
        name="heads, generated",
        file="hands-and-heads",
        where={"error in percent of the length": "head"},
        cells=_X100,
        unit="% of the length",
    ),
)


def results_file(name: str, docs: Path = DOCS) -> dict[str, Any]:
    """A file of docs/results.

    Raises
    ------
    InputError
        It is not there, or holds no tables.
    """
    path = docs / "results" / f"{name}.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        found["tables"][0]["columns"]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} is not a file of results", "an experiment writes it: --save FILE") from error
    return dict(found)


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of a page."""
    lines = [f"| {' | '.join(each)} |" for each in (columns, *rows)]
    return "\n".join([lines[0], "|---" * len(columns) + "|", *lines[1:], ""])


def circumstances_line(found: Mapping[str, Any]) -> str:
    """When, on which commit and machine, and by which command a table was made."""
    commands = found.get("commands") or []
    told = f"{found['date']}, commit {found['commit']}, {found['machine']}"
    return f"*{told}.*\n" + "".join(f"\n```text\n{each}\n```\n" for each in commands[:1])


def table_of(words: str, docs: Path) -> str:
    """The table that a comment asks for, with its circumstances."""
    head, _, names = words.partition(":")
    name, number = head.split()
    found = results_file(name, docs)
    table = found["tables"][int(number) - 1]
    wanted = [each.strip() for each in names.split(",") if each.strip()] or table["columns"]
    places = [table["columns"].index(each) for each in wanted]
    rows = [[row[place] for place in places] for row in table["rows"]]
    return f"\n{markdown(wanted, rows)}\n{circumstances_line(found)}\n"


def summary(docs: Path) -> str:
    """A row for every set that is measured."""
    columns = {"mean": "mean", "median": "median", "lost": "lost", "flips": "flips", "pairs": "pairs"}
    rows = []
    for each in SUMMARY:
        table = results_file(each.file, docs)["tables"][each.table - 1]
        names = table["columns"]
        (row,) = [
            row
            for row in table["rows"]
            if all(row[names.index(column)].startswith(value) for column, value in each.where.items())
        ][:1]
        values = {key: row[names.index(column)] for key, column in each.cells.items()}
        rows.append([each.name, *(values.get(key, "") for key in columns), each.unit])
    return f"\n{markdown(['set', *columns.values(), 'unit'], rows)}\n"


def refreshed(text: str, docs: Path) -> str:
    """A page with its tables as the files have them now."""

    def block(match: re.Match[str]) -> str:
        made = summary(docs) if match[2] == "summary" else table_of(match[3].strip(), docs)
        return f"{match[1]}{made}{match[5]}"

    return _BLOCK.sub(block, text)


@runner.command
def main(
    check: Annotated[bool, Option("--check", help="write nothing; status 1 if a page is not fresh")] = False,
    docs: Annotated[Path, Option(help="the folder of the pages")] = DOCS,
) -> runner.Report:
    stale = []
    for name in PAGES:
        path = docs / name
        before = path.read_text(encoding="utf-8")
        after = refreshed(before, docs)
        if after != before:
            stale.append(name)
            if not check:
                path.write_text(after, encoding="utf-8")
    stopped = InputError(f"not fresh: {', '.join(stale)}", "run it without --check") if stale and check else None
    return runner.Report({"stale": stale}, stopped=stopped)


if __name__ == "__main__":
    sys.exit(main())
