"""Update the tables in the pages of docs from the files in docs/results.

``python -m meshmatch.experiments.pages [--check]``

Every experiment writes such a file with ``--save docs/results/NAME.json``. It contains the date, commit, machine, data and
command of the run, and its tables. A page includes a table between two comments,

    <!-- results NAME 1: set, mean, median -->
    <!-- end -->

with the number of the table in the file, from 1, and the columns (by default all). The text between the comments is
replaced. Below a page's first table of a file are the date, commit and machine. The table of all sets (`SUMMARY`) is
included with ``<!-- summary -->``.

``last_commit`` in a file is the last commit that can repeat it, if current commands cannot.
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
    """A row of the summary.

    ``where`` selects the row of the file's first table by the prefixes of its cells; ``columns`` are the file's columns for
    `_COLUMNS`, empty where there is none.
    """

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
    """Read a file of docs/results.

    Raises
    ------
    InputError
        The file is missing, or has no tables.
    """
    path = docs / "results" / f"{name}.json"
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
        results["tables"][0]["columns"]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} is not a file of results", "an experiment writes it: --save FILE") from error
    return dict(results)


def markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [f"| {' | '.join(each)} |" for each in (columns, *rows)]
    return "\n".join([lines[0], "|---" * len(columns) + "|", *lines[1:], ""])


def build_table(words: str, docs: Path, above: bool = False) -> str:
    """The table for a comment's ``words``, followed by its date, commit and machine unless the page has them ``above``."""
    head, _, names = words.partition(":")
    name, number = head.split()
    results = results_file(name, docs)
    table = results["tables"][int(number) - 1]
    columns = [each.strip() for each in names.split(",") if each.strip()] or table["columns"]
    indices = [table["columns"].index(each) for each in columns]
    rows = [[row[index] for index in indices] for row in table["rows"]]
    source = f"[{name}.json](results/{name}.json)"
    if above:
        source += ", as above"
    else:
        source += f": {results['date']}, commit {results['commit']}, {results['machine']}"
        if last := results.get("last_commit"):
            source += f"; to repeat it, check out {last}"
    return f"\n{markdown(columns, rows)}\n{source}.\n\n"


def summary(docs: Path) -> str:
    """The summary table, with one row for every evaluated set."""
    rows = []
    for entry in SUMMARY:
        table = results_file(entry.file, docs)["tables"][0]
        cells = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
        row = next(
            cell_row for cell_row in cells if all(cell_row[key].startswith(value) for key, value in entry.where.items())
        )
        rows.append([entry.name, *(row[column] if column else "" for column in entry.columns), entry.unit])
    return f"\n{markdown(['set', *_COLUMNS, 'unit'], rows)}\n"


def update_tables(text: str, docs: Path) -> str:
    """Text of a page with its tables updated from the files."""
    files: set[str] = set()

    def replacement(match: re.Match[str]) -> str:
        if match[2] == "summary":
            return f"{match[1]}{summary(docs)}{match[5]}"
        name = match[3].split()[0]
        table = build_table(match[3].strip(), docs, above=name in files)
        files.add(name)
        return f"{match[1]}{table}{match[5]}"

    return _BLOCK.sub(replacement, text)


@runner.command
def main(
    check: Annotated[bool, Option("--check", help="write nothing; status 1 if a page is not fresh")] = False,
    docs: Annotated[Path, Option(help="the folder of the pages")] = DOCS,
) -> runner.Report:
    stale = []
    for name in PAGES:
        path = docs / name
        before = path.read_text(encoding="utf-8")
        after = update_tables(before, docs)
        if after != before:
            stale.append(name)
            if not check:
                path.write_text(after, encoding="utf-8")
    stopped = InputError(f"not fresh: {', '.join(stale)}", "run it without --check") if stale and check else None
    return runner.Report({"stale": stale}, stopped=stopped)
