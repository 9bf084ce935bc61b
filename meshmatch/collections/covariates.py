"""Covariates of shapes: read a table with a row for each shape, and build the design matrix of a linear model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeAlias
from unicodedata import normalize

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.collections.formula import Factor, Formula, term_name
from meshmatch.collections.sources import find_name, name_index
from meshmatch.errors import InputError, OptionError
from meshmatch.scalars import counted
from meshmatch.shapes.tables import is_missing, is_number, parse_number, read_by_suffix, read_table

Columns: TypeAlias = Mapping[str, Sequence[Any]]
"""Values of the shapes, by the name of the column; in any order if there is a column ``name``, else in the shapes' order."""
NAMES = "name"
SIZE = "size"
_LARGEST = 1e30  # largest number; squares of products of several must not overflow
_MAX_NAMES = 5  # names listed in a message
_NULLS = ("none", "null")  # missing values in a column of numbers, but a category, as in "no treatment", among words


@dataclass(frozen=True, eq=False)
class Covariates:
    """The columns of a table as text, a cell for each shape in the order of ``names``.

    Numbers have decimal points, letters such as é are composed (NFC).
    """

    names: tuple[str, ...]
    cells: dict[str, tuple[str, ...]]

    def column(self, name: str) -> tuple[str, ...]:
        """The cells of a column; `InputError` if there is no such column."""
        name = normalize("NFC", name)
        if name not in self.cells:
            close = get_close_matches(name, self.cells, n=1)
            known = (
                f"there are: {shorten_names(list(self.cells))}" if len(self.cells) > 1 else "give a table that has it"
            )
            raise InputError(f"there is no column called {name}", f"did you mean {close[0]}?" if close else known)
        return self.cells[name]

    def missing(self, name: str) -> Bool[Bools, " S"]:
        """Whether the value of each shape is missing in a column."""
        cells = self.column(name)
        kept = () if _are_numbers(cells) else _NULLS
        return np.array([is_missing(cell) and cell.strip().lower() not in kept for cell in cells], bool)

    def select(self, rows: Bool[Bools, " S"]) -> Covariates:
        """Select the shapes of these rows."""
        kept = np.flatnonzero(rows).tolist()
        return Covariates(
            tuple(self.names[k] for k in kept),
            {name: tuple(cells[k] for k in kept) for name, cells in self.cells.items()},
        )


@dataclass(frozen=True, eq=False)
class DesignTerm:
    """A term of a linear model: its columns (S, C) of the design matrix, and the name of each coefficient."""

    name: str
    columns: Float[Floats, "S C"]
    coefficients: tuple[str, ...]


def covariates(table: str | Path | Columns | None, names: Sequence[str], sizes: Float[Floats, " S"]) -> Covariates:
    """Read the covariates of shapes from a table or a file; ``sizes`` become the column ``size`` if there is none.

    Rows are found by the column ``name``, else by the first column of a file: the names of the shapes or of their files.
    `InputError` for shapes without a row or with two rows, and for files that are not tables.
    """
    if table is None:
        found: dict[str, tuple[str, ...]] = {}
    elif isinstance(table, (str, Path)):
        header, rows = read_by_suffix(
            table,
            dict.fromkeys((".csv", ".tsv", ".txt"), _read_table_file),
            "tables",
            "the first row has the names of columns",
        )
        key = next((k for k, title in enumerate(header) if title.lower() == NAMES), 0)
        order = _match_rows([row[key] for row in rows], names, Path(table).name)
        found = {
            title: _normalise_numbers([rows[k][column] for k in order])
            for column, title in enumerate(header)
            if column != key
        }
    else:
        found = _reorder(
            {str(title): ["" if cell is None else str(cell) for cell in table[title]] for title in table}, names
        )
    _check_titles(list(found))
    found = {normalize("NFC", title): tuple(normalize("NFC", cell) for cell in cells) for title, cells in found.items()}
    found.setdefault(SIZE, tuple(map(repr, sizes.tolist())))
    return Covariates(tuple(names), found)


def _read_table_file(path: Path) -> tuple[list[str], list[list[str]]]:
    """Read the header and the rows of a file."""
    table = read_table(path)
    table.check_unambiguous()
    header, *rows = table.rows() or [[]]
    if len(header) < 2 or not rows:
        raise InputError("it has no rows, or one column only", "write a row for each shape, commas between the cells")
    table.check_decimal_marks(rows)
    _check_titles(header)
    return header, rows


def _check_titles(titles: Sequence[str]) -> None:
    """`InputError` if two columns have the same name, or names that differ only in how accents are encoded."""
    counts = Counter(normalize("NFC", title) for title in titles)
    duplicate = next((title for title, count in counts.items() if count > 1), None)
    if duplicate is None:
        return
    if titles.count(duplicate) > 1:
        raise InputError(f"two columns are called {duplicate or 'nothing'}", "the first row has the names of columns")
    how = "with its accents encoded in different ways"
    raise InputError(f"two columns are called {duplicate}, {how}", "rename one of them")


def _normalise_numbers(cells: Sequence[str]) -> tuple[str, ...]:
    """Normalise the cells of a column: numbers get decimal points and ASCII minus signs."""
    if not _are_numbers(cells):
        return tuple(cells)
    return tuple(cell.replace(",", ".").replace("\N{MINUS SIGN}", "-") for cell in cells)


def _reorder(cells: dict[str, list[str]], names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Bring columns into the order of the shapes, by the column ``name`` if there is one."""
    key = cells.pop(NAMES, None)
    for title, column in cells.items():
        if len(column) != len(names if key is None else key):
            hint = "add a column 'name' if there are others"
            raise InputError(f"the column {title} has {len(column)} values for {len(names)} shapes", hint)
    order = range(len(names)) if key is None else _match_rows(key, names, "the table")
    return {title: tuple(column[k] for k in order) for title, column in cells.items()}


def _match_rows(known: Sequence[str], names: Sequence[str], what: str) -> list[int]:
    """The row of each shape; a name in the table may have the suffix of a file. ``what`` names the table in messages."""
    rows: dict[str, int] = {}
    index = name_index(names)
    for k, word in enumerate(known):
        if (name := find_name(word, index)) is None:
            continue
        if name in rows:
            raise InputError(f"{what} has two rows for {name}", "keep one of them")
        rows[name] = k
    unmatched = [name for name in names if name not in rows]
    if unmatched:
        close = get_close_matches(unmatched[0], known, n=1)
        hint = f"is {close[0]} meant for {unmatched[0]}?" if close else "its first column, or 'name', names the shapes"
        raise InputError(f"{what} has no row for {shorten_names(unmatched)}", hint)
    return [rows[name] for name in names]


def shorten_names(names: Sequence[str]) -> str:
    """List the first names, and the number of others."""
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return f"{', '.join(names[:_MAX_NAMES])}{more}"


def design_terms(formula: Formula, known: Covariates) -> tuple[list[DesignTerm], dict[str, str]]:
    """Build the terms of a model, without the intercept, and describe how each column was interpreted.

    Categories are compared with the first one in alphabetical order. `InputError` for columns that are constant or
    invalid, and for models with too many coefficients for the number of shapes.
    """
    coded: dict[Factor, tuple[Floats, tuple[str, ...]]] = {}
    interpretation: dict[str, str] = {}
    for term in formula.terms:
        for factor in term:
            if factor not in coded:
                values, titles, interpretation[str(factor)] = _code_factor(factor, known)
                coded[factor] = values, titles
    width = [int(np.prod([len(coded[factor][1]) for factor in term])) for term in formula.terms]
    if sum(width) + 1 >= len(known.names):
        raise InputError(
            f"{len(known.names)} shapes are too few for a model of {sum(width) + 1} coefficients",
            _many_coefficients_hint(max(coded, key=lambda factor: len(coded[factor][1])), known),
        )
    terms = []
    for term in formula.terms:
        columns, titles = coded[term[0]]
        for factor in term[1:]:
            more, others = coded[factor]
            columns = (columns[:, :, None] * more[:, None]).reshape(len(columns), -1)
            titles = tuple(f"{one}:{other}" for one in titles for other in others)
        terms.append(DesignTerm(term_name(term), columns, titles))
    return terms, interpretation


def _many_coefficients_hint(factor: Factor, known: Covariates) -> str:
    """What may reduce the number of coefficients, most of which are those of a factor."""
    cells = known.column(factor.column)
    words = [cell for cell in cells if not is_number(cell)]
    if words and 2 * len(words) < len(cells) and not factor.function:
        return f"{factor.column} counts as categories, because of {words[0][:40]!r}: write a number, or leave the cell empty"
    count = f"; {factor.column} has {len(set(cells))}" if words or factor.function == "factor" else ""
    return f"leave out terms; each category but the first has a coefficient{count}"


def _code_factor(factor: Factor, known: Covariates) -> tuple[Floats, tuple[str, ...], str]:
    """Columns of a factor, the name of each, and a description of how the factor was interpreted."""
    cells = known.column(factor.column)
    if factor.function != "factor" and _are_numbers(cells):
        values = np.array([parse_number(cell) for cell in cells])
        fine = np.abs(values) < _LARGEST
        if not fine.all():
            name = known.names[int(np.argmin(fine))]
            raise InputError(f"{factor.column} is not finite, or huge, for {name}", "leave the cell empty")
        if factor.function == "log":
            if not (values > 0).all():
                name = known.names[int(np.argmin(values))]
                message = f"{factor} needs numbers above 0, and {name} has {values.min():g}"
                raise InputError(message, f"use {factor.column} itself, or leave the cell empty")
            values = np.log(values)
        if not np.ptp(values) > max(1e-12 * np.abs(values).max(), 1 / _LARGEST):
            raise InputError(f"{factor} is the same for all shapes in the model", "leave it out")
        return values[:, None], (str(factor),), f"a number, {values.min():.4g} to {values.max():.4g}"
    if factor.function == "log":
        word = next(cell for cell in cells if not is_number(cell))
        raise InputError(f"{factor} needs numbers, and a cell is {word[:40]!r}", "use the column without log()")
    levels = sorted(set(cells))
    if len(levels) < 2:
        raise InputError(f"{factor.column} is the same for all shapes in the model", "leave it out")
    counts = [f"{level} {cells.count(level)}" for level in levels[:_MAX_NAMES]]
    if len(levels) > _MAX_NAMES:
        counts.append("...")
    columns = np.array([[cell == level for level in levels[1:]] for cell in cells], np.float64)
    titles = tuple(f"{factor.column}: {level} - {levels[0]}" for level in levels[1:])
    return columns, titles, f"{len(levels)} categories ({', '.join(counts)}), compared with {levels[0]}"


def complete_rows(formula: Formula, blocks: str | None, known: Covariates) -> tuple[Bool[Bools, " S"], dict[str, str]]:
    """Whether each shape has all values that a model needs, and a missing column for each of the others.

    `OptionError` if fewer than four shapes are complete.
    """
    lacking: dict[str, str] = {}
    for column in (*formula.columns, *([blocks] if blocks else [])):
        for k in np.flatnonzero(known.missing(column)).tolist():
            lacking.setdefault(known.names[k], column)
    rows = np.array([name not in lacking for name in known.names], bool)
    if rows.sum() < 4:
        raise OptionError(
            f"all of {', '.join(formula.columns)} are known for {counted(int(rows.sum()), 'shape')} only",
            "four or more are needed",
        )
    return rows, lacking


def _are_numbers(cells: Sequence[str]) -> bool:
    """Whether all cells are numbers or missing, and some are not missing."""
    return all(map(is_number, cells)) and not all(map(is_missing, cells))
