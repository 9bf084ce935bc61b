"""Files of tables: what separates the cells of a text, as spreadsheets, NumPy, pandas, R and people write it, whether the
decimal mark is a point or a comma, which cells are missing; the choice of a reader by suffix, and errors in one line.

A decimal comma is read where something else separates the cells (``0,5;1,25``, also a tab or spaces), where it is in
quotes, and in a single column whose digits are no second column of whole numbers. Where both could be meant, readers
refuse the table and say so.
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
from meshmatch.shapes.input_files import check_memory, existing, read_text

T = TypeVar("T")
# What a damaged file raises in the readers of the standard library and NumPy.
_DAMAGE = (ValueError, TypeError, LookupError, ArithmeticError, RecursionError, EOFError, StopIteration, csv.Error)
DECIMAL_COMMA = "for a decimal comma: put semicolons or tabs between the cells (0,5;1,25), or write points (0.5)"
_WORDS = (
    "na n/a nan -nan +nan null none 1.#qnan 1.#ind -1.#ind nan(ind) -nan(ind) #n/a #num! #div/0! #value! #ref! #name? "
    "#nv #zahl! #wert! #bezug! #nombre! #valeur! #n/d #valor! #nome?"
)
_MISSING = frozenset((*_WORDS.split(), ""))
_SIGN = "[+\N{MINUS SIGN}-]?"  # some locales write the mathematical sign
_EXPONENT = "(?:[eE][+-]?[0-9]+)?"
_NUMBER = re.compile(rf"{_SIGN}(?:[0-9]+\.?[0-9]*|[0-9]+,[0-9]+|[.,][0-9]+){_EXPONENT}")
_INFINITE = re.compile(r"[+-]?inf(?:inity)?", re.IGNORECASE)
_GROUPED = re.compile(rf"{_SIGN}[1-9][0-9]{{0,2}},[0-9]{{3}}")  # 1,234: of a thousand and more, or of less than ten
# A mark begins a comment, but not in what spreadsheets and C write for a value that is none.
_COMMENT = r"#(?!(?:N/[AD]|NV|[A-Z/0]+[!?]|QNAN|IND|SNAN)(?:[\t;,)\"\s]|$))"
_WHOLE_LINE = re.compile(rf"^[ \t]*{_COMMENT}.*$", re.MULTILINE)
_TO_THE_END = re.compile(rf"{_COMMENT}.*$", re.MULTILINE)
# Lines of a single column with decimal commas: is there another line; and signs for and against such a column.
_OTHER_LINE = re.compile(rf"^(?![ \t]*{_SIGN}[0-9]+(?:,[0-9]+)?{_EXPONENT}[ \t]*$)[^\n]*[^\s][^\n]*$", re.MULTILINE)
_FRACTION = re.compile(r"^[ \t]*[\N{MINUS SIGN}-]0+,|,0[0-9]|,[0-9]+[eE]", re.MULTILINE)
_WHOLE_NUMBERS, _PADDED = re.compile(r"[0-9,+\s-]+"), re.compile(r",0[0-9]")
_SECOND = re.compile(r",([0-9]+)")
_SAMPLE = 2000  # lines that tell what separates the cells
_ROW, _CELL = 280, 120  # bytes of memory that a row and a cell of text take
_LARGEST_VERTEX = 2.0**53  # whole numbers of more are not exact as floats


def is_missing(cell: str) -> bool:
    """Whether a cell holds nothing: it is empty, or says so (NA, N/A, nan, #N/A of a spreadsheet, ...)."""
    return cell.strip().lower() in _MISSING


def number(cell: str) -> float:
    """The number in a cell, with a decimal point or comma; nan where it is missing. `ValueError` if it is none."""
    word = cell.strip()
    if _NUMBER.fullmatch(word):
        return float(word.replace(",", ".").replace("\N{MINUS SIGN}", "-"))
    if is_missing(word):
        return float("nan")
    if _INFINITE.fullmatch(word):
        return float(word)
    raise ValueError(f"{word[:40]!r} is not a number")


def is_number(cell: str) -> bool:
    """Whether a cell holds a number, or is missing."""
    try:
        number(cell)
    except ValueError:
        return False
    return True


def whole(values: ArrayLike) -> Ints:
    """Numbers that are whole, also where they are written as 10.0 or 1.000e+01, as integers; `ValueError` for others."""
    array = np.asarray(values)
    if array.dtype.kind in "iu" and array.size and array.max() > np.iinfo(np.int64).max:
        raise ValueError("a number is too large to be a vertex")
    if array.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            broken = ~(array == np.round(array))
        if broken.any():
            raise ValueError(f"{array[broken][0]:g} is not a whole number")
        if (np.abs(array) >= _LARGEST_VERTEX).any():
            raise ValueError("a number is too large to be a vertex")
    elif array.dtype.kind not in "iub":
        raise ValueError("its numbers are not whole")
    return array.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Table:
    """The text of a table, and how it is written."""

    name: str  # of the file
    text: str  # lines end in \n; comments are blank lines
    comment: str  # the last one before the first row
    separator: Literal["\t", ";", ",", " ", "any", ""]  # " ": blanks; "": there is one column
    is_doubtful: bool  # its lines may be one column with decimal commas or two of whole numbers

    @cached_property
    def _first(self) -> tuple[list[str], int]:
        """The cells of the first row, and where the text goes on behind it."""
        end = 0
        for line in _lines(self.text):
            end += len(line) + 1
            if line.strip():
                return next(_split([line], self.separator)), end
        return [], end

    def rows(self, even: bool = True) -> list[list[str]]:
        """The cells of every row that is not blank, the header too. All rows are equally long; `InputError` if they are not,
        unless they need not be ``even``.

        Cells have no spaces around them. A last column that is empty everywhere is left out, and so are empty rows at
        the end: spreadsheets write both.
        """
        lines = 1 + self.text.count("\n")
        cells = sum(map(self.text.count, "\t;, " if self.separator in ("any", " ") else self.separator or "\n"))
        check_memory(self.name, len(self.text), _ROW * lines + _CELL * cells)
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
        odd = next((k for k, row in enumerate(rows) if len(row) != width), None)
        if odd is not None:
            count = f"{len(rows[odd])} cell{'s' if len(rows[odd]) > 1 else ''}"
            uneven = f"line {self._line(odd)} has {count}, the first {width}: its rows are not equally long"
            raise InputError(uneven, DECIMAL_COMMA if "," in self.text and self.separator not in ("\t", ";") else "")

    def numbers(self) -> tuple[tuple[str, ...], Float[Floats, "R C"]]:
        """The names of the columns, () if the table has none, and its numbers, nan where one is missing.

        A first row with a word in it holds the names; else the last comment before it does, if it has as many words.
        `InputError` or `ValueError` if rows are not equally long, or a cell is no number.
        """
        first, behind = self._first
        is_header = not all(map(is_number, first))
        table = self._quick_numbers(self.text[behind:] if is_header else self.text)
        if table is None or (is_header and table.size and table.shape[1] != len(first)):
            return self._slow_numbers(is_header)
        return tuple(first) if is_header else self._named_by_comment(table.shape[1]), table

    def _quick_numbers(self, text: str) -> Floats | None:
        """The numbers by NumPy's reader, if all are plain; None if a closer look is needed."""
        if "," in text and self.separator != ",":
            if "." in text:
                return None
            text = text.replace(",", " " if self.separator == "any" else ".")
        text = text.replace(";", " ") if self.separator == "any" else text
        plain = self.separator if self.separator in ("\t", ";", ",") else None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a table without rows
            try:
                table = np.loadtxt(_lines(text), delimiter=plain, comments=None, ndmin=2)
            except ValueError:
                return None
        return table if table.size else table.reshape(0, 1)

    def _slow_numbers(self, is_header: bool) -> tuple[tuple[str, ...], Floats]:
        rows = self.rows()
        names = tuple(rows.pop(0)) if is_header else ()
        table = np.empty((len(rows), len(rows[0]) if rows else max(len(names), 1)))
        is_plain = self.text.isascii() and "_" not in self.text  # Python knows more digits, and 1_000
        for k, row in enumerate(rows):
            try:
                table[k] = _floats(row) if is_plain else [number(cell) for cell in row]
            except ValueError as error:
                hint = DECIMAL_COMMA if any("," in cell and not is_number(cell) for cell in row) else ""
                raise InputError(f"line {self._line(k + is_header)}: {error}", hint) from error
        self.check_marks(rows)
        return names or self._named_by_comment(table.shape[1]), table

    def check_marks(self, rows: list[list[str]]) -> None:
        """`InputError` if numbers have decimal points and decimal commas, or commas between thousands."""
        if self.separator != "," and not ("," in self.text and "." in self.text):
            return
        cells = [cell for row in rows for cell in row if "," in cell and _NUMBER.fullmatch(cell)]
        if not cells:
            return
        if any("." in cell and _NUMBER.fullmatch(cell) for row in rows for cell in row):
            raise InputError(f"it has decimal points and a decimal comma, in {cells[0]}", "write all numbers one way")
        if self.separator == "," and all(map(_GROUPED.fullmatch, cells)):
            problem = f"is the comma in {cells[0]} a decimal comma, or does it divide thousands?"
            raise InputError(problem, "write numbers without commas")

    def check_no_doubt(self) -> None:
        """`InputError` if lines may be one column with decimal commas or two of whole numbers."""
        if self.is_doubtful:
            line = next(line for line in _lines(self.text) if line.strip()).strip()
            problem = f"is {line[:40]} one number with a decimal comma, or are these columns?"
            if line.count(",") > 1:
                problem = f"are in {line[:40]} numbers with a decimal comma, or is each a column?"
            hint = "write 0.5 for a decimal comma; put semicolons or tabs between columns, or names above them"
            raise InputError(problem, hint)

    def _named_by_comment(self, width: int) -> tuple[str, ...]:
        if not self.comment:
            return ()
        names = next(_split([self.comment], self.separator), [])
        return tuple(names) if len(names) == width and not all(map(is_number, names)) else ()

    def _line(self, row: int) -> int:
        """The number of a row's line in the file, if no cell holds a line end."""
        return next(islice((k for k, line in enumerate(_lines(self.text), 1) if line.strip()), row, None), row + 1)


def read_table(
    path: Path, *, blanks: bool = True, comments: Literal["lines", "ends", ""] = "lines", whole: bool = False
) -> Table:
    """The table in a file of text, and how it is written; `InputError` or `ValueError` if it is no text, or too large.

    Parameters
    ----------
    path
        The file, in UTF-8 with or without a byte order mark, UTF-16 with one, or else in Windows' Latin letters.
    blanks
        Whether spaces may separate cells: they do if all behind the first cell are numbers.
    comments
        Where ``#`` begins a comment: at the beginning of lines, anywhere, or nowhere.
    whole
        Numbers are known to be whole: ``10,0`` is 10.
    """
    text = read_text(path, 140, 16).replace("\r\n", "\n").replace("\r", "\n")
    comment = ""
    if comments and "#" in text:
        for line in _lines(text):
            if line.strip() and not _WHOLE_LINE.match(line):
                break
            comment = line.strip().lstrip("#").strip() or comment
        text = (_WHOLE_LINE if comments == "lines" else _TO_THE_END).sub("", text)
    declared = re.match(r"\s*(\"?)sep=([\t;,])\1[ \t]*\n", text)  # how Excel is told
    if declared:
        text = "\n" * declared[0].count("\n") + text[declared.end() :]
        separator = declared[2]
    else:
        separator = _separator(text, blanks)
    doubt = False
    if separator == ",":
        answer = _one_column(text, whole)
        separator, doubt = ("" if answer else separator), answer is None
    return Table(path.name, text, comment, separator, doubt)  # type: ignore[arg-type]


def _lines(text: str) -> Iterator[str]:
    start = 0
    while start < len(text):
        end = text.find("\n", start)
        end = len(text) if end < 0 else end
        yield text[start:end]
        start = end + 1


def _split(lines: Iterator[str] | list[str], separator: str) -> Iterator[list[str]]:
    """The cells of the lines that are not blank."""
    if separator == "":
        return ([unquoted(line.strip())] for line in lines if line.strip())
    if separator == "any":
        return (re.split(r"[\s,;]+", line.strip(" \t,;")) for line in lines if line.strip())
    if separator == " ":
        return (_words(line) for line in lines if line.strip())
    rows = csv.reader((line for line in lines if line.strip()), delimiter=separator, skipinitialspace=True)
    return ([cell.strip() for cell in row] for row in rows)


def _words(line: str) -> list[str]:
    if '"' not in line:
        return line.split()
    return next(csv.reader([" ".join(line.split())], delimiter=" "))


def unquoted(cell: str) -> str:
    """A cell without the quotes around it."""
    return cell[1:-1].replace('""', '"') if len(cell) > 1 and cell[0] == cell[-1] == '"' else cell


def _separator(text: str, blanks: bool) -> str:
    """What separates the cells of a table, told by its first lines."""
    sample = list(islice((line for line in _lines(text) if line.strip()), _SAMPLE))
    named = blanks and len(sample) > 1 and not _holds_numbers(sample[0])
    body = sample[1:] if named else sample  # names of columns may be written otherwise
    if not any(mark in line for line in body for mark in "\t;, "):
        return ""
    even = {}
    for mark in "\t;,":
        if not any(mark in line for line in body):  # nor need csv take a whole line for one cell, which may be too long
            continue
        rows = list(_split(body, mark))
        if len({len(row) for row in rows}) == 1 and len(rows[0]) > 1:
            even[mark] = rows
    strong = next((mark for mark in even if mark != ","), None)
    if strong and "," in even and not all(_has_decimal_commas(row) for row in even[strong]):
        # Both divide all rows: the one that stands first does, and the other is part of a word.
        return min((strong, ","), key=body[0].index)
    if strong:
        return strong
    if blanks:
        words = [line.split() for line in body]
        if len({len(row) for row in words}) == 1 and len(words[0]) > 1 and all(map(_is_row, words)):
            return " "
    if even or (any("," in line for line in body) and not _OTHER_LINE.search("\n".join(body))):
        return ","
    if not blanks or not any(mark in body[0] for mark in "\t;,"):
        present = [mark for mark in "\t;," if any(mark in line for line in body)]
        return present[0] if present else (" " if blanks and any(" " in line.strip() for line in body) else "")
    return "any"


def _holds_numbers(line: str) -> bool:
    """Whether a line is all numbers, whatever separates them."""
    one = len(line) <= csv.field_size_limit()  # whether it may be one cell
    cells = [next(_split([line], mark)) for mark in ("\t", ";", ",", " ") if one or mark in line]
    return any(all(map(is_number, row)) and not all(map(is_missing, row)) for row in cells)


def _floats(row: list[str]) -> list[float]:
    """The numbers in cells without digits other than 0 to 9, the quick way if they are plain."""
    try:
        return list(map(float, row))
    except ValueError:
        return [number(cell) for cell in row]


def _has_decimal_commas(row: list[str]) -> bool:
    """Whether all cells with a comma are numbers."""
    return all(_NUMBER.fullmatch(cell) for cell in row if "," in cell)


def _is_row(words: list[str]) -> bool:
    """Whether all words but the first are numbers, none of which begins or ends in a comma, and the first may be one."""
    return all(is_number(word) and not word.startswith(",") for word in words[1:]) and not words[0].endswith(",")


def _one_column(text: str, whole: bool) -> bool | None:
    """Whether lines such as 0,5 are a column of numbers with decimal commas; False if they are two columns of whole
    numbers, None if nothing tells.
    """
    head = next((line for line in _lines(text) if line.strip()), "")
    header = head if not all(map(is_number, next(_split([head], ",")))) else ""
    body = text.partition(header)[2] if header else text
    if _OTHER_LINE.search(body):
        broken = not header and head.count(",") % 2 and _WHOLE_NUMBERS.fullmatch(body) and _PADDED.search(body)
        return None if broken else False  # 0,05,1,25: pairs of them may be numbers
    numbers = [line.partition(",")[0].strip() for line in _lines(body) if line.strip()]
    if len(numbers) > 2 and numbers == list(map(str, range(len(numbers)))):
        return False
    if "," in header:  # names of two columns, or a comma in the name of one
        return None if _FRACTION.search(body) else False
    if header or _FRACTION.search(body):
        return True
    second = _SECOND.findall(body)
    if whole and len(second) > 1 and not any(digits.strip("0") for digits in second):
        return True
    # Decimals have all the same number of digits, or none that could be left out.
    padded = any(len(digits) > 1 and digits.endswith("0") for digits in second)
    return False if padded and len({len(digits) for digits in second}) > 1 else None


def check_suffix(path: str | Path, suffixes: Iterable[str], what: str) -> str:
    """The suffix in small letters, if it is one of `suffixes`; `OptionError` otherwise. Ask before long work.

    Where a glb may be written, so may what Blender makes of one, whose suffix counts as .glb.
    """
    path = as_path(path)
    suffix = path.suffix.lower()
    if blender.is_converted(path) and ".glb" in suffixes:
        blender.check_written(path)
        return ".glb"
    if suffix not in suffixes:
        given = f"'{suffix}'" if suffix else "a name without a suffix"
        unknown = f"{path.name or path}: {given} is not a format for {what}"
        raise OptionError(unknown, f"end the name in one of {' '.join(suffixes)}")
    return suffix


def read_by_suffix(path: str | Path, readers: Mapping[str, Callable[[Path], T]], what: str, hint: str) -> T:
    """What the reader for the file's suffix makes of it; `InputError` where there is none, or the file is missing, empty
    or damaged.

    The file's name comes first in the message. A reader's own errors keep their kind and words, and get `hint` where
    they have none.
    """
    path = existing(as_path(path), hint)
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise InputError(f"{path.name}: {what} are not read from '{suffix}' files", f"choose {', '.join(readers)}")
    try:
        return readers[suffix](path)
    except MeshmatchError as error:
        words = error.message if error.message.startswith(path.name) else f"{path.name}: {error.message}"
        raise type(error)(words, error.hint or hint) from error
    except _DAMAGE as error:
        why = "it is not text" if isinstance(error, UnicodeDecodeError) else error
        raise InputError(f"{path.name} does not hold {what} that can be read: {why}", hint) from error


def is_numbered(numbers: ArrayLike | Sequence[str]) -> bool:
    """Whether the rows are numbered 0, 1, 2, ...: by numbers, or by cells of a table that hold them."""
    try:
        rows = np.array([number(each) if isinstance(each, str) else each for each in np.asarray(numbers).tolist()])
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
    """A csv file; floats are written with the fewest digits that read back as the same number."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def write_json(path: Path, record: Mapping[str, Any], indent: int | None = None) -> None:
    """A JSON file, in letters where every file can hold them."""
    text = json.dumps(record, ensure_ascii=False, allow_nan=False, indent=indent)
    path.write_text(plain_text(text) + "\n", encoding="utf-8")


def write_npy(path: Path, array: np.ndarray) -> None:
    """An npy file. Through an open file: given a path such as a.NPY, NumPy writes a.NPY.npy."""
    with path.open("wb") as file:
        np.save(file, array, allow_pickle=False)


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """A compressed npz file; see `write_npy`."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **{name: np.asarray(value) for name, value in arrays.items()})


def short_floats(values: np.ndarray) -> list[Any]:
    """float32 numbers as the floats with the fewest digits that read back as the same float32; None for nan."""
    floats = values.astype(np.float32).astype(np.str_).astype(np.float64)
    found = floats.astype(object)
    found[np.isnan(floats)] = None
    return list(found.tolist())
