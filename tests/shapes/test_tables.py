"""One table in many spellings gives the same numbers, through every reader of tables; what could be two is refused."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.maps.files import load_map
from meshmatch.shapes.tables import as_whole_numbers, is_missing, parse_number, read_table
from meshmatch.shapes.vertex_lists import load_pairs, load_points
from meshmatch.transfer.label_files import load_labels
from meshmatch.transfer.landmarks import load_landmarks
from meshmatch.transfer.value_files import load_values
from tests.conftest import icosphere

SHAPE = icosphere(1)  # 42 vertices, 80 faces
COLUMN = np.round(np.linspace(-1.5, 2.5, SHAPE.V), 3)
TABLE = np.column_stack([COLUMN, COLUMN[::-1] * 3])
WHOLE = np.random.default_rng(3).permutation(SHAPE.V)


def text(table: np.ndarray, separator: str, spell: str = "%.3f", end: str = "\n", comma: bool = False) -> str:
    rows = [separator.join((spell % x).replace(".", "," if comma else ".") for x in row) for row in table]
    return end.join(rows) + end


COLUMNS = {
    "commas": text(TABLE, ","),
    "commas and spaces": text(TABLE, ", "),
    "semicolons": text(TABLE, ";"),
    "tabs": text(TABLE, "\t"),
    "spaces": text(TABLE, "   "),
    "decimal commas, semicolons": text(TABLE, ";", comma=True),
    "decimal commas, tabs": text(TABLE, "\t", comma=True),
    "decimal commas, spaces": text(TABLE, " ", comma=True),
    "decimal commas in quotes": text(TABLE, '","', comma=True).replace("\n", '"\n"').join(('"', ""))[:-1],
    "numpy": text(TABLE, " ", "%.18e"),
    "numpy with a header": "# heat loss\n" + text(TABLE, " ", "%.18e"),
    "exponents with commas": text(TABLE, ";", "%.12e", comma=True),
    "names": "heat;loss\n" + text(TABLE, ";", comma=True),
    "Excel's first line": "sep=;\nheat;loss\n" + text(TABLE, ";", comma=True),
    "trailing separators": text(TABLE, ";", end=";\n"),
    "empty rows at the end": "heat;loss\n" + text(TABLE, ";") + ";\n;\n",
    "CRLF": text(TABLE, ",", end="\r\n"),
    "CR": text(TABLE, ",", end="\r"),
    "byte order mark": "\ufeffheat,loss\n" + text(TABLE, ","),
    "vertex first": "vertex,heat,loss\n" + "".join(f"{k},{a},{b}\n" for k, (a, b) in enumerate(TABLE.tolist())),
    "pandas": ",0,1\n" + "".join(f"{k},{a},{b}\n" for k, (a, b) in enumerate(TABLE.tolist())),
    "R": '"","a","b"\n' + "".join(f'"{k}",{a},{b}\n' for k, (a, b) in enumerate(TABLE.tolist(), 1)),
    "a comment between": text(TABLE[:5], ",") + "# the others\n" + text(TABLE[5:], ","),
    "another minus": text(TABLE, ";", comma=True).replace("-", "\N{MINUS SIGN}"),
}


@pytest.mark.parametrize("suffix", [".csv", ".txt"])
@pytest.mark.parametrize("case", COLUMNS)
def test_values_in_many_spellings(tmp_path: Path, case: str, suffix: str) -> None:
    (tmp_path / f"v{suffix}").write_text(COLUMNS[case], encoding="utf-8", newline="")
    assert np.allclose(load_values(tmp_path / f"v{suffix}", SHAPE).numbers, TABLE, atol=1e-12)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "cp1252"])
def test_encodings(tmp_path: Path, encoding: str) -> None:
    """What no mark tells is said."""
    (tmp_path / "v.csv").write_text("Höhe\tMaß\n" + text(TABLE, "\t"), encoding=encoding)
    guessed = pytest.warns(MeshmatchWarning, match="v.csv is not in UTF-8; it is read as Windows' Latin letters")
    with guessed if encoding == "cp1252" else nullcontext():
        found = load_values(tmp_path / "v.csv", SHAPE)
    assert found.names == ("Höhe", "Maß") and np.allclose(found.numbers, TABLE)


@pytest.mark.parametrize("spell", ["%.3f", "%g", "%.5e"])
@pytest.mark.parametrize("head", ["", "heat\n"])
@pytest.mark.parametrize("decimal", [".", ","])
def test_one_column(tmp_path: Path, spell: str, head: str, decimal: str) -> None:
    (tmp_path / "v.csv").write_text(head + "".join(spell % x + "\n" for x in COLUMN).replace(".", decimal))
    assert np.allclose(load_values(tmp_path / "v.csv", SHAPE).numbers, COLUMN, atol=1e-4)


@pytest.mark.parametrize("word", ["", "NA", "N/A", "nan", "NaN", "#N/A", "null", "#DIV/0!", "#NV", "#WERT!", "1.#QNAN"])
@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_missing_numbers(tmp_path: Path, word: str, mark: str) -> None:
    (tmp_path / "v.csv").write_text(text(TABLE[:-1], mark) + f"{word}{mark}7\n")
    found = load_values(tmp_path / "v.csv", SHAPE).numbers
    assert is_missing(word) and np.isnan(found[-1, 0]) and found[-1, 1] == 7
    assert np.allclose(found[:-1], TABLE[:-1])


def test_two_columns_of_whole_numbers_stay_two(tmp_path: Path) -> None:
    """By names, by numbered rows, by zeros that no fraction has at its end."""
    pairs = np.column_stack([WHOLE, np.arange(SHAPE.V) * 5])
    plain = text(pairs, ",", "%d")
    for given in (plain, "a,b\n" + text(pairs % 7, ",", "%d"), text(np.sort(pairs, axis=0), ",", "%d")):
        (tmp_path / "v.csv").write_text(given)
        assert load_values(tmp_path / "v.csv", SHAPE).numbers.shape == (SHAPE.V, 2)


@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("36,6", "is 36,6 one number with a decimal comma, or are these columns"),
        ("0,05,1,25", "are in 0,05,1,25 numbers with a decimal comma"),
        ("0.5;1,5", "decimal points and a decimal comma"),
        ('"1,234","2"', "or does it divide thousands"),
        ("1_0", "is not a number"),
        ("٣", "is not a number"),
    ],
)
def test_what_could_be_two_things_is_refused(tmp_path: Path, row: str, told: str) -> None:
    header = "v\n" if row in ("1_0", "٣") else ""  # a first row of words would be one
    (tmp_path / "v.csv").write_text(header + f"{row}\n" * SHAPE.V, encoding="utf-8")
    with pytest.raises(InputError, match=told):
        load_values(tmp_path / "v.csv", SHAPE)


LISTS: dict[str, Callable[[list[int]], str]] = {
    "plain": lambda n: "".join(f"{k}\n" for k in n),
    "numpy": lambda n: "".join(f"{k:.18e}\n" for k in n),
    "pandas": lambda n: "".join(f"{k:.1f}\n" for k in n),
    "decimal commas": lambda n: "".join(f"{k},0\n" for k in n),
    "CRLF": lambda n: "".join(f"{k}\r\n" for k in n),
    "trailing semicolons": lambda n: "".join(f"{k};\n" for k in n),
}


@pytest.mark.parametrize("case", LISTS)
def test_whole_numbers_in_every_kind_of_file(tmp_path: Path, case: str) -> None:
    given = WHOLE.tolist()
    for name in ("a.txt", "a.csv"):
        (tmp_path / name).write_text(LISTS[case](given), newline="")
        assert load_map(tmp_path / name).index.tolist() == given
        assert load_points(tmp_path / name).tolist() == given
        if not (case == "trailing semicolons" and name == "a.txt"):  # a line of a .txt is a label, whatever it is
            assert load_labels(tmp_path / name, SHAPE).values.tolist() == given
        marks, _ = load_landmarks(tmp_path / name, SHAPE)
        assert marks.vertex.tolist() == given


@pytest.mark.parametrize("mark", [",", ";", "\t", " ", " ; "])
@pytest.mark.parametrize("spell", ["%d", "%.1f", "%.18e"])
@pytest.mark.parametrize("head", ["", "source target\n"])
def test_pairs(tmp_path: Path, mark: str, spell: str, head: str) -> None:
    pairs = np.column_stack([WHOLE, WHOLE[::-1]])
    (tmp_path / "p.txt").write_text(head.replace(" ", mark) + text(pairs, mark, spell))
    assert np.array_equal(np.column_stack(load_pairs(tmp_path / "p.txt")), pairs)


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_maps_with_named_columns(tmp_path: Path, mark: str) -> None:
    rows = [("Source_Vertex", "target_vertex"), *((f"{k}.0", f"{v}.0") for k, v in enumerate(WHOLE.tolist()))]
    (tmp_path / "m.csv").write_text("".join(mark.join(row) + "\n" for row in rows))
    assert load_map(tmp_path / "m.csv").index.tolist() == WHOLE.tolist()


@pytest.mark.parametrize("mark", [",", ";", "\t"])
@pytest.mark.parametrize("suffix", [".csv", ".txt"])
@pytest.mark.parametrize("head", ["vertex{}label\n", "# vertex{}label\n", ""])
@pytest.mark.parametrize("words", [False, True])
def test_labels_behind_their_vertices(tmp_path: Path, mark: str, suffix: str, head: str, words: bool) -> None:
    labels = [f"left part {k % 3}" if words else k % 3 for k in range(SHAPE.V)]
    rows = "".join(f"{k}{mark}{label}\n" for k, label in enumerate(labels))
    (tmp_path / f"l{suffix}").write_text(head.format(mark) + rows)
    assert load_labels(tmp_path / f"l{suffix}", SHAPE).values.tolist() == labels


def test_labels_with_separators_and_marks_in_them(tmp_path: Path) -> None:
    for label in ("#ff0000", "face", "a; b", "1.5"):
        (tmp_path / "l.txt").write_text(f"{label}\nother\n" * (SHAPE.V // 2))
        assert load_labels(tmp_path / "l.txt", SHAPE).names == tuple(sorted((label, "other")))
    (tmp_path / "l.csv").write_text("vertex,label\n" + "".join(f"{k},a;b\n" for k in range(SHAPE.V)))
    assert load_labels(tmp_path / "l.csv", SHAPE).names == ("a;b",)


def test_labels_that_are_missing_among_numbers(tmp_path: Path) -> None:
    (tmp_path / "l.csv").write_text(
        "vertex;label\n" + "".join(f"{k};{'NA' if k == 3 else '2.0'}\n" for k in range(SHAPE.V))
    )
    found = load_labels(tmp_path / "l.csv", SHAPE)
    assert found.names == (2,) and np.flatnonzero(found.codes < 0).tolist() == [3]
    (tmp_path / "l.txt").write_text("0,5\n1,5\n" * (SHAPE.V // 2))
    with pytest.raises(InputError, match="decimal comma"):
        load_labels(tmp_path / "l.txt", SHAPE)


def test_numbers_and_whole_numbers() -> None:
    assert [parse_number(cell) for cell in ("1e3", " -0,5 ", ".5", "inf", "+2.")] == [1000, -0.5, 0.5, np.inf, 2]
    assert as_whole_numbers(np.array([1.0, 2e3])).tolist() == [1, 2000]
    for bad in ([1.5], [np.nan], [1e17], [np.inf]):
        with pytest.raises(ValueError, match=r"whole|large"):
            as_whole_numbers(np.array(bad))


def test_rows_that_differ_are_told_by_their_line(tmp_path: Path) -> None:
    (tmp_path / "v.csv").write_text("a;b\n1;2\n\n3\n")
    with pytest.raises(InputError, match="line 4 has 1 cell, the first 2"):
        read_table(tmp_path / "v.csv").numbers()


@pytest.mark.parametrize("mark", ["\t", ";", ","])
def test_lines_longer_than_a_cell_may_be(tmp_path: Path, mark: str) -> None:
    """csv takes no cell of more than 131,072 letters; a line of a table of coordinates has more."""
    titles = ["name", *(f'"{axis}{vertex}"' for vertex in range(5000) for axis in "xyz")]
    rows = [[name, *map(repr, np.random.default_rng(k).normal(size=15_000).tolist())] for k, name in enumerate("ab")]
    (tmp_path / "a.csv").write_text("\n".join(mark.join(row) for row in (titles, *rows)))
    table = read_table(tmp_path / "a.csv")
    assert table.separator == mark
    assert table.rows() == [[title.strip('"') for title in titles], *rows]


def test_numbers_with_too_many_digits(tmp_path: Path) -> None:
    """Python's own message names a function that the user of a file cannot call."""
    (tmp_path / "l.json").write_text(f'{{"nose": {"1" * 10_000}}}')
    with pytest.raises(InputError, match=r"l\.json .*: a number has too many digits"):
        load_landmarks(tmp_path / "l.json", SHAPE)
