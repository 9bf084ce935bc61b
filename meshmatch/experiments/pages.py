"""Tables of the pages, made from the files in docs/results.

``python -m meshmatch.experiments.pages [--check]``

Every experiment writes such a file with ``--save docs/results/NAME.json``: when, on which commit, machine and data, and by
which command it ran, and its tables. A page asks for a table between two comments,

    <!-- results NAME 1: set, mean, median -->
    <!-- end -->

the number of the table in the file, from 1, and which columns (all of them where none is named). Below its first table of a
file a page says when and how that was made. A page begins the table of all sets (`SUMMARY`) with ``<!-- summary -->``.
Whatever stands between the comments is replaced.

A file that the commands of today cannot make again says in ``last_commit`` which commit was the last that could.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from typer import Option

from meshmatch.errors import InputError
from meshmatch.experiments import runner

DOCS = Path(__file__).parents[2] / "docs"
PAGES = ("results.md", "method.md", "paper.md", "rigs.md", "collections.md", "categories.md", "measurements.md")
_BLOCK = re.compile(r"(<!-- (results|summary)([^>]*?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
_COLUMNS = ("mean", "median", "lost", "flips", "pairs")


class Row(NamedTuple):
    """A row of the summary: its name, the file, which row of the file's first table, by the beginnings of cells, the file's
    columns for `_COLUMNS` (empty where it has none), and the unit."""

    name: str
    file: str
    where: Mapping[str, str]
    columns: tuple[str, ...]
    unit: str


_CM = ("mean", "median", "over 15 cm", "flips", "pairs")
_PART = ("mean", "median", "over 15 cm", "", "pairs")
_BODY = ("mean cm", "", "", "", "pairs")
_CONTACT = ("mean cm", "median", "", "", "pairs")
_X100 = ("mean", "median", "off", "", "pairs")
SUMMARY = (
    Row("SCAPE", "accuracy", {"set": "scape"}, _CM, "cm"),
    Row("FAUST", "accuracy", {"set": "faust"}, _CM, "cm"),
    Row("SHREC'19", "accuracy", {"set": "shrec19"}, _CM, "cm"),
    Row("SCAPE, noisy points", "accuracy", {"set": "scape-pcn"}, _CM, "cm"),
    Row("FAUST, points with outliers", "outliers", {}, _CM, "cm"),
    Row("SCAPE, one view", "partial", {"set": "scape", "part": "view"}, _PART, "cm"),
    Row("SCAPE, cut", "partial", {"set": "scape", "part": "cut"}, _PART, "cm"),
    Row("SHREC'19, one view", "partial", {"set": "shrec19", "part": "view"}, _PART, "cm"),
    Row("SHREC'19, cut", "partial", {"set": "shrec19", "part": "cut"}, _PART, "cm"),
    Row("people in clothes, generated", "characters", {"group": "clothed"}, _BODY, "cm"),
    Row("stylised people, generated", "characters", {"group": "stylised"}, _BODY, "cm"),
    Row("touching themselves, generated", "characters", {"group": "touching"}, _CONTACT, "cm"),
    Row("these, fused", "characters", {"group": "fused"}, _CONTACT, "cm"),
    Row("animals", "animals", {"of": "all"}, _X100, "% of √area"),
    Row("hands, generated", "hands", {"of": "all"}, _X100, "% of the length"),
    Row("heads, generated", "heads", {"of": "all"}, _X100, "% of the length"),
    Row("animals, without a model", "animals-none", {"of": "all"}, _X100, "% of √area"),
    Row("15 kinds, without a model", "any-shapes", {"class": "all"}, ("mean", "median", "", "", "pairs"), "% of √area"),
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


def table_of(words: str, docs: Path, above: bool = False) -> str:
    """The table that a comment asks for, and when, on which commit and machine it was made, unless that stands ``above``."""
    head, _, names = words.partition(":")
    name, number = head.split()
    found = results_file(name, docs)
    table = found["tables"][int(number) - 1]
    wanted = [each.strip() for each in names.split(",") if each.strip()] or table["columns"]
    places = [table["columns"].index(each) for each in wanted]
    rows = [[row[place] for place in places] for row in table["rows"]]
    told = f"[{name}.json](results/{name}.json)"
    if above:
        told += ", as above"
    else:
        told += f": {found['date']}, commit {found['commit']}, {found['machine']}"
        if last := found.get("last_commit"):
            told += f"; to repeat it, check out {last}"
    return f"\n{markdown(wanted, rows)}\n{told}.\n\n"


def summary(docs: Path) -> str:
    """A row for every set that is measured."""
    rows = []
    for each in SUMMARY:
        table = results_file(each.file, docs)["tables"][0]
        cells = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
        row = next(one for one in cells if all(one[key].startswith(value) for key, value in each.where.items()))
        rows.append([each.name, *(row[column] if column else "" for column in each.columns), each.unit])
    return f"\n{markdown(['set', *_COLUMNS, 'unit'], rows)}\n"


def refreshed(text: str, docs: Path) -> str:
    """A page with its tables as the files have them now."""
    files: set[str] = set()

    def block(match: re.Match[str]) -> str:
        if match[2] == "summary":
            return f"{match[1]}{summary(docs)}{match[5]}"
        name = match[3].split()[0]
        made = table_of(match[3].strip(), docs, above=name in files)
        files.add(name)
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
