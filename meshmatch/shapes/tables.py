"""Text tables as spreadsheets, NumPy, pandas, R and people write them, and readers and writers by suffix.

The reader detects the separator of cells, whether the decimal mark is a point or a comma, and missing values. A decimal
comma is recognised if another character separates the cells (``0,5;1,25``, also a tab or spaces), if it is in quotes,
and in a single column whose digits cannot be a second column of whole numbers. Ambiguous tables are refused with an
explanation.
"""

from __future__ import annotations

import csv
import json
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from meshmatch import blender
from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.outputs import as_path, plain_text
from meshmatch.shapes.input_files import check_input_file, check_memory, read_text

T = TypeVar("T")
# Exceptions that damaged files raise in readers of the standard library and NumPy.
_READ_ERRORS = (ValueError, TypeError, LookupError, ArithmeticError, RecursionError, EOFError, StopIteration, csv.Error)
DECIMAL_COMMA = "for a decimal comma: put semicolons or tabs between the cells (0,5;1,25), or write points (0.5)"
_MISSING_WORDS = (
    "na n/a nan -nan +nan null none 1.#qnan 1.#ind -1.#ind nan(ind) -nan(ind) #n/a #num! #div/0! #value! #ref! #name? "
    "#nv #zahl! #wert! #bezug! #nombre! #valeur! #n/d #valor! #nome?"
)
_MISSING = frozenset((*_MISSING_WORDS.split(), ""))
_SIGN = "[+\N{MINUS SIGN}-]?"  # some locales write the mathematical minus sign
_EXPONENT = "(?:[eE][+-]?[0-9]+)?"
_NUMBER = re.compile(rf"{_SIGN}(?:[0-9]+\.?[0-9]*|[0-9]+,[0-9]+|[.,][0-9]+){_EXPONENT}")
_INFINITE = re.compile(r"[+-]?inf(?:inity)?", re.IGNORECASE)
_THOUSANDS = re.compile(rf"{_SIGN}[1-9][0-9]{{0,2}},[0-9]{{3}}")  # 1,234: more than a thousand, or less than ten
# A # begins a comment, except in the error values of spreadsheets and C.
_COMMENT = r"#(?!(?:N/[AD]|NV|[A-Z/0]+[!?]|QNAN|IND|SNAN)(?:[\t;,)\"\s]|$))"
_COMMENT_LINE = re.compile(rf"^[ \t]*{_COMMENT}.*$", re.MULTILINE)
_TRAILING_COMMENT = re.compile(rf"{_COMMENT}.*$", re.MULTILINE)
# Single columns with decimal commas: a line that does not fit, and signs for and against such a column.
_OTHER_LINE = re.compile(rf"^(?![ \t]*{_SIGN}[0-9]+(?:,[0-9]+)?{_EXPONENT}[ \t]*$)[^\n]*[^\s][^\n]*$", re.MULTILINE)
_CLEAR_FRACTION = re.compile(r"^[ \t]*[\N{MINUS SIGN}-]0+,|,0[0-9]|,[0-9]+[eE]", re.MULTILINE)
_WHOLE_NUMBERS, _PADDED = re.compile(r"[0-9,+\s-]+"), re.compile(r",0[0-9]")
_AFTER_COMMA = re.compile(r",([0-9]+)")
_MAX_SAMPLE = 2000  # maximum number of lines for detecting the separator
_ROW_BYTES, _CELL_BYTES = 280, 120  # bytes of memory per row and per cell of text
_MAX_EXACT = 2.0**53  # larger whole numbers are not exact as floats


def is_missing(cell: str) -> bool:
    """Whether a cell is empty or marks a missing value (NA, N/A, nan, #N/A of a spreadsheet, ...)."""
    return cell.strip().lower() in _MISSING


def parse_number(cell: str) -> float:
    """Parse a cell as a number with a decimal point or comma; nan if it is missing. `ValueError` if it is not a number."""
    word = cell.strip()
    if _NUMBER.fullmatch(word):
        return float(word.replace(",", ".").replace("\N{MINUS SIGN}", "-"))
    if is_missing(word):
        return float("nan")
    if _INFINITE.fullmatch(word):
        return float(word)
    raise ValueError(f"{word[:40]!r} is not a number")


def is_number(cell: str) -> bool:
    """Whether a cell is a number, or missing."""
    try:
        parse_number(cell)
    except ValueError:
        return False
    return True


def as_whole_numbers(values: ArrayLike) -> Ints:
    """Convert whole numbers, also if written as 10.0 or 1.000e+01, to integers; `ValueError` for other values."""
    array = np.asarray(values)
    if array.dtype.kind in "iu" and array.size and array.max() > np.iinfo(np.int64).max:
        raise ValueError("a number is too large to be a vertex")
    if array.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            broken = ~(array == np.round(array))
        if broken.any():
            raise ValueError(f"{array[broken][0]:g} is not a whole number")
        if (np.abs(array) >= _MAX_EXACT).any():
            raise ValueError("a number is too large to be a vertex")
    elif array.dtype.kind not in "iub":
        raise ValueError("its numbers are not whole")
    return array.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Table:
    """The text of a table, and its notation."""

    name: str  # of the file
    text: str  # lines end in \n; comments are blank lines
    comment: str  # last comment before the first row
    separator: Literal["\t", ";", ",", " ", "any", ""]  # " ": spaces; "any": several; "": a single column
    is_doubtful: bool  # whether it may be one column with decimal commas or several of whole numbers

    @cached_property
    def _first_row(self) -> tuple[list[str], int]:
        """The cells of the first row, and the position of the text after it."""
        end = 0
        for line in _lines(self.text):
            end += len(line) + 1
            if line.strip():
                return next(_split([line], self.separator)), end
        return [], end

    def rows(self, even: bool = True) -> list[list[str]]:
        """The cells of every row that is not blank, including the header.

        All rows must be equally long unless ``even`` is false; `InputError` otherwise. Spaces around cells are removed.
        A last column that is empty everywhere is dropped, and so are empty rows at the end: spreadsheets write both.
        """
        lines = 1 + self.text.count("\n")
        cells = sum(map(self.text.count, "\t;, " if self.separator in ("any", " ") else self.separator or "\n"))
        check_memory(self.name, len(self.text), _ROW_BYTES * lines + _CELL_BYTES * cells)
        rows = list(_split(_lines(self.text), self.separator))
        while len(rows) > 1 and len(rows[-1]) > 1 and not any(rows[-1]):
            rows.pop()
        if not rows or not even:
            return rows
        first, others = len(rows[0]), {len(row) for row in rows[1:]} or {len(rows[0])}
        is_even = len(others) == 1 and (width := others.pop()) > 1
        if is_even and not any(row[-1] for row in rows[1:]) and (first < width or not rows[0][-1]):
            rows = [row[: width - 1] for row in rows]
        self._check_widths(rows)
        return rows

    def _check_widths(self, rows: list[list[str]]) -> None:
        width = len(rows[0])
        odd_row = next((k for k, row in enumerate(rows) if len(row) != width), None)
        if odd_row is not None:
            count = f"{len(rows[odd_row])} cell{'s' if len(rows[odd_row]) > 1 else ''}"
            uneven = f"line {self._line_number(odd_row)} has {count}, the first {width}: its rows are not equally long"
            raise InputError(uneven, DECIMAL_COMMA if "," in self.text and self.separator not in ("\t", ";") else "")

    def numbers(self) -> tuple[tuple[str, ...], Float[Floats, "R C"]]:
        """The names of the columns, () if the table has none, and its numbers, nan where missing.

        A first row that contains a word is a header; otherwise the last comment before it is, if it has as many words.
        `InputError` or `ValueError` if rows are not equally long, or a cell is not a number.
        """
        first, behind = self._first_row
        is_header = not all(map(is_number, first))
        table = self._parse_fast(self.text[behind:] if is_header else self.text)
        if table is None or (is_header and table.size and table.shape[1] != len(first)):
            return self._parse_cells(is_header)
        return tuple(first) if is_header else self._names_from_comment(table.shape[1]), table

    def _parse_fast(self, text: str) -> Floats | None:
        """The numbers from NumPy's reader, if all are plain; None if they need the slower reader."""
        if "," in text and self.separator != ",":
            if "." in text:
                return None
            text = text.replace(",", " " if self.separator == "any" else ".")
        text = text.replace(";", " ") if self.separator == "any" else text
        delimiter = self.separator if self.separator in ("\t", ";", ",") else None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # warns of tables without rows
            try:
                table = np.loadtxt(_lines(text), delimiter=delimiter, comments=None, ndmin=2)
            except ValueError:
                return None
        return table if table.size else table.reshape(0, 1)

    def _parse_cells(self, is_header: bool) -> tuple[tuple[str, ...], Floats]:
        rows = self.rows()
        names = tuple(rows.pop(0)) if is_header else ()
        table = np.empty((len(rows), len(rows[0]) if rows else max(len(names), 1)))
        is_plain = self.text.isascii() and "_" not in self.text  # Python accepts other digits, and 1_000
        for k, row in enumerate(rows):
            try:
                table[k] = _parse_floats(row) if is_plain else [parse_number(cell) for cell in row]
            except ValueError as error:
                hint = DECIMAL_COMMA if any("," in cell and not is_number(cell) for cell in row) else ""
                raise InputError(f"line {self._line_number(k + is_header)}: {error}", hint) from error
        self.check_decimal_marks(rows)
        return names or self._names_from_comment(table.shape[1]), table

    def check_decimal_marks(self, rows: list[list[str]]) -> None:
        """`InputError` if numbers have both decimal points and decimal commas, or commas that may group thousands."""
        if self.separator != "," and not ("," in self.text and "." in self.text):
            return
        cells = [cell for row in rows for cell in row if "," in cell and _NUMBER.fullmatch(cell)]
        if not cells:
            return
        if any("." in cell and _NUMBER.fullmatch(cell) for row in rows for cell in row):
            raise InputError(f"it has decimal points and a decimal comma, in {cells[0]}", "write all numbers one way")
        if self.separator == "," and all(map(_THOUSANDS.fullmatch, cells)):
            problem = f"is the comma in {cells[0]} a decimal comma, or does it divide thousands?"
            raise InputError(problem, "write numbers without commas")

    def check_unambiguous(self) -> None:
        """`InputError` if lines may be one column with decimal commas or several of whole numbers."""
        if self.is_doubtful:
            line = next(line for line in _lines(self.text) if line.strip()).strip()
            problem = f"is {line[:40]} one number with a decimal comma, or are these columns?"
            if line.count(",") > 1:
                problem = f"are in {line[:40]} numbers with a decimal comma, or is each a column?"
            hint = "write 0.5 for a decimal comma; put semicolons or tabs between columns, or names above them"
            raise InputError(problem, hint)

    def _names_from_comment(self, width: int) -> tuple[str, ...]:
        if not self.comment:
            return ()
        names = next(_split([self.comment], self.separator), [])
        return tuple(names) if len(names) == width and not all(map(is_number, names)) else ()

    def _line_number(self, row: int) -> int:
        """Line number of a row in the file, if no cell contains a line end."""
        return next(islice((k for k, line in enumerate(_lines(self.text), 1) if line.strip()), row, None), row + 1)


def read_table(
    path: Path, *, blanks: bool = True, comments: Literal["lines", "ends", ""] = "lines", whole: bool = False
) -> Table:
    """Read a text table and detect its notation; `InputError` or `ValueError` if it is not text, or too large.

    Parameters
    ----------
    path
        The file, in UTF-8 with or without a byte order mark, UTF-16 with one, or cp1252.
    blanks
        Whether spaces may separate cells: they do if all cells after the first are numbers.
    comments
        Where ``#`` begins a comment: at the beginning of lines, anywhere, or nowhere.
    whole
        Whether the numbers are known to be whole, so that ``10,0`` is 10.
    """
    text = read_text(path, 140, 16).replace("\r\n", "\n").replace("\r", "\n")
    comment = ""
    if comments and "#" in text:
        for line in _lines(text):
            if line.strip() and not _COMMENT_LINE.match(line):
                break
            comment = line.strip().lstrip("#").strip() or comment
        text = (_COMMENT_LINE if comments == "lines" else _TRAILING_COMMENT).sub("", text)
    declared = re.match(r"\s*(\"?)sep=([\t;,])\1[ \t]*\n", text)  # declares the separator for Excel
    if declared:
        text = "\n" * declared[0].count("\n") + text[declared.end() :]
        separator = declared[2]
    else:
        separator = _detect_separator(text, blanks)
    is_doubtful = False
    if separator == ",":
        is_single = _is_single_column(text, whole)
        separator, is_doubtful = ("" if is_single else separator), is_single is None
    return Table(path.name, text, comment, separator, is_doubtful)  # type: ignore[arg-type]


def _lines(text: str) -> Iterator[str]:
    start = 0
    while start < len(text):
        end = text.find("\n", start)
        end = len(text) if end < 0 else end
        yield text[start:end]
        start = end + 1


def _split(lines: Iterator[str] | list[str], separator: str) -> Iterator[list[str]]:
    """The cells of lines that are not blank."""
    if separator == "":
        return ([unquoted(line.strip())] for line in lines if line.strip())
    if separator == "any":
        return (re.split(r"[\s,;]+", line.strip(" \t,;")) for line in lines if line.strip())
    if separator == " ":
        return (_split_words(line) for line in lines if line.strip())
    rows = csv.reader((line for line in lines if line.strip()), delimiter=separator, skipinitialspace=True)
    return ([cell.strip() for cell in row] for row in rows)


def _split_words(line: str) -> list[str]:
    if '"' not in line:
        return line.split()
    return next(csv.reader([" ".join(line.split())], delimiter=" "))


def unquoted(cell: str) -> str:
    """A cell without quotes around it."""
    return cell[1:-1].replace('""', '"') if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell


def _detect_separator(text: str, blanks: bool) -> str:
    """Detect the separator of cells from the first lines."""
    sample = list(islice((line for line in _lines(text) if line.strip()), _MAX_SAMPLE))
    has_header = blanks and len(sample) > 1 and not _is_numeric(sample[0])
    body = sample[1:] if has_header else sample  # column names may be separated differently
    if not any(mark in line for line in body for mark in "\t;, "):
        return ""
    rows_by_mark = {}
    for mark in "\t;,":
        if not any(mark in line for line in body):  # csv limits the length of a cell, which would be the whole line
            continue
        rows = list(_split(body, mark))
        if len({len(row) for row in rows}) == 1 and len(rows[0]) > 1:
            rows_by_mark[mark] = rows
    best_mark = next((mark for mark in rows_by_mark if mark != ","), None)
    if best_mark and "," in rows_by_mark and not all(_has_decimal_commas(row) for row in rows_by_mark[best_mark]):
        # Both divide all rows evenly: the first one in a row separates, and the other is part of a word.
        return min((best_mark, ","), key=body[0].index)
    if best_mark:
        return best_mark
    if blanks:
        words = [line.split() for line in body]
        if len({len(row) for row in words}) == 1 and len(words[0]) > 1 and all(map(_is_number_row, words)):
            return " "
    if rows_by_mark or (any("," in line for line in body) and not _OTHER_LINE.search("\n".join(body))):
        return ","
    if not blanks or not any(mark in body[0] for mark in "\t;,"):
        present = [mark for mark in "\t;," if any(mark in line for line in body)]
        return present[0] if present else (" " if blanks and any(" " in line.strip() for line in body) else "")
    return "any"


def _is_numeric(line: str) -> bool:
    """Whether all cells of a line are numbers, with any separator."""
    fits_one_cell = len(line) <= csv.field_size_limit()  # csv limits the length of a cell
    cells = [next(_split([line], mark)) for mark in ("\t", ";", ",", " ") if fits_one_cell or mark in line]
    return any(all(map(is_number, row)) and not all(map(is_missing, row)) for row in cells)


def _parse_floats(row: list[str]) -> list[float]:
    """Parse cells with ASCII digits; quickly if they are plain."""
    try:
        return list(map(float, row))
    except ValueError:
        return [parse_number(cell) for cell in row]


def _has_decimal_commas(row: list[str]) -> bool:
    """Whether all cells with a comma are numbers."""
    return all(_NUMBER.fullmatch(cell) for cell in row if "," in cell)


def _is_number_row(words: list[str]) -> bool:
    """Whether all words but the first are numbers without a comma at either end, and the first does not end in one."""
    return all(is_number(word) and not word.startswith(",") for word in words[1:]) and not words[0].endswith(",")


def _is_single_column(text: str, whole: bool) -> bool | None:
    """Whether lines such as 0,5 are a column with decimal commas; None if ambiguous.

    False means that they are columns of whole numbers.
    """
    head = next((line for line in _lines(text) if line.strip()), "")
    header = head if not all(map(is_number, next(_split([head], ",")))) else ""
    body = text.partition(header)[2] if header else text
    if _OTHER_LINE.search(body):
        broken = not header and head.count(",") % 2 and _WHOLE_NUMBERS.fullmatch(body) and _PADDED.search(body)
        return None if broken else False  # 0,05,1,25 may be pairs with decimal commas
    numbers = [line.partition(",")[0].strip() for line in _lines(body) if line.strip()]
    if len(numbers) > 2 and numbers == list(map(str, range(len(numbers)))):
        return False
    if "," in header:  # names of two columns, or one name with a comma
        return None if _CLEAR_FRACTION.search(body) else False
    if header or _CLEAR_FRACTION.search(body):
        return True
    decimals = _AFTER_COMMA.findall(body)
    if whole and len(decimals) > 1 and not any(digits.strip("0") for digits in decimals):
        return True
    # Decimals either all have the same number of digits, or no trailing zeros.
    padded = any(len(digits) > 1 and digits.endswith("0") for digits in decimals)
    return False if padded and len({len(digits) for digits in decimals}) > 1 else None


def check_suffix(path: str | Path, suffixes: Iterable[str], what: str) -> str:
    """The suffix in lower case, if it is one of `suffixes`; `OptionError` otherwise. Call it before long work.

    If glb can be written, so can the formats that Blender makes of it; for these the result is .glb.
    """
    path = as_path(path)
    suffix = path.suffix.lower()
    if blender.is_converted(path) and ".glb" in suffixes:
        blender.check_written(path)
        return ".glb"
    if suffix not in suffixes:
        described = f"'{suffix}'" if suffix else "a name without a suffix"
        unknown = f"{path.name or path}: {described} is not a format for {what}"
        raise OptionError(unknown, f"end the name in one of {' '.join(suffixes)}")
    return suffix


def read_by_suffix(path: str | Path, readers: Mapping[str, Callable[[Path], T]], what: str, hint: str) -> T:
    """Read a file with the reader for its suffix.

    `InputError` if there is none, or the file is missing, empty or damaged. Messages begin with the file's name. Errors
    of a reader keep their class and message, and get `hint` if they have none.
    """
    path = check_input_file(as_path(path), hint)
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise InputError(f"{path.name}: {what} are not read from '{suffix}' files", f"choose {', '.join(readers)}")
    try:
        return readers[suffix](path)
    except MeshmatchError as error:
        message = error.message if error.message.startswith(path.name) else f"{path.name}: {error.message}"
        raise type(error)(message, error.hint or hint) from error
    except _READ_ERRORS as error:
        why = "it is not text" if isinstance(error, UnicodeDecodeError) else error
        raise InputError(f"{path.name} does not hold {what} that can be read: {why}", hint) from error


def is_numbered(numbers: ArrayLike | Sequence[str]) -> bool:
    """Whether the rows are numbered 0, 1, 2, ...; ``numbers`` are numbers, or cells of a table."""
    try:
        rows = np.array(
            [parse_number(each) if isinstance(each, str) else each for each in np.asarray(numbers).tolist()]
        )
    except ValueError:
        return False
    return np.array_equal(rows, np.arange(len(rows)))


def check_numbered(numbers: ArrayLike | Sequence[str]) -> None:
    """`InputError` if the rows are not numbered 0, 1, 2, ..."""
    if not is_numbered(numbers):
        from_one = is_numbered(["0", *map(str, np.asarray(numbers).tolist())])
        hint = "it counts from 1: subtract 1" if from_one else "sort it, one row for each"
        raise InputError("its rows are not 0, 1, 2, ... in order", hint)


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a csv file; floats get the fewest digits that read back as the same number."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def write_json(path: Path, record: Mapping[str, Any], indent: int | None = None) -> None:
    """Write a JSON file in UTF-8, without escapes."""
    text = json.dumps(record, ensure_ascii=False, allow_nan=False, indent=indent)
    path.write_text(plain_text(text) + "\n", encoding="utf-8")


def write_npy(path: Path, array: np.ndarray) -> None:
    """Write an npy file. The file is opened here, because NumPy would write a path such as a.NPY to a.NPY.npy."""
    with path.open("wb") as file:
        np.save(file, array, allow_pickle=False)


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write a compressed npz file; see `write_npy`."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **{name: np.asarray(value) for name, value in arrays.items()})


def short_floats(values: np.ndarray) -> list[Any]:
    """Convert float32 to the floats with the fewest digits that read back as the same float32; nan becomes None."""
    floats = values.astype(np.float32).astype(np.str_).astype(np.float64)
    result = floats.astype(object)
    result[np.isnan(floats)] = None
    return list(result.tolist())
