"""Formulas and tables: what they mean, and what is refused."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from meshmatch.collections.covariates import Covariates, complete_rows, covariates, design_terms
from meshmatch.collections.formula import parse
from meshmatch.errors import InputError, OptionError
from tests.growth import grows_with_size

NAMES = ("a", "b.1", "sub/c", "d", "e", "f", "g")
SIZES = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0])


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("shape ~ log(size) + sex + age", "shape ~ log(size) + sex + age"),
        ("form~sex*age", "form ~ sex + age + sex:age"),
        ("shape ~ a*b:c + b*c + a:c + a:b", "shape ~ a + b + c + b:c + a:c + a:b + a:b:c"),
        ("shape ~ a*b*c", "shape ~ a + b + c + a:b + a:c + b:c + a:b:c"),
        ("shape ~ b:a + a + b + a:b + a:a", "shape ~ a + b + b:a"),
        (
            'shape ~ factor(no.) + `age at death` * "größe"',
            "shape ~ factor(no.) + age at death + größe + age at death:größe",
        ),
    ],
)
def test_formulas_are_read(text: str, meant: str) -> None:
    assert str(parse(text)) == meant


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "ends early"),
        ("age + sex", "does not begin"),
        ("size ~ sex", "does not begin"),
        ("shape ~", "ends early"),
        ("shape ~ a +", "ends early"),
        ("shape ~ a - b", "'-' where"),
        ("shape ~ a b", "'b' where"),
        ("shape ~ 1", "not '1'"),
        ("shape ~ exp(a)", "function 'exp'"),
        ("shape ~ log(a", "no \\) behind a"),
        ("shape ~ log(log(a))", "no \\) behind log"),
        ("shape ~ a:b", "a:b without a"),
        ("shape ~ a*b*c*d", "more than 3"),
        ("shape ~ a*b:c:d", "more than 3"),
        ("shape ~ " + "+".join(f"x{k}" for k in range(60)), "60 terms"),
        ("shape ~ " + 2000 * "a", "too long"),
        ("shape ~ __import__('os')", "function"),
    ],
)
def test_what_is_no_formula_is_refused(text: str, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        parse(text)


def write(path: Path, *rows: str) -> Path:
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def test_rows_are_found_by_name(tmp_path: Path) -> None:
    rows = ["d;m;4,5;1", "nobody;f;9,5;1", "sub/c.ply;f;3,5;2", "b.1.stl;none;2,5;2"]
    rows += ["a;m;1,5;1", "e;f;;1", "f;f;6,5;2", "g;m;7,5;1"]
    known = covariates(write(tmp_path / "t.csv", "Specimen;sex;age;site", *rows), NAMES, SIZES)
    assert known.cells["sex"] == ("m", "none", "f", "m", "f", "f", "m")
    assert [float(cell) for cell in known.column("size")] == SIZES.tolist()
    model = parse("shape ~ log(size) + age + sex + factor(site) + site")
    rows_kept, lacking = complete_rows(model, None, known)
    assert lacking == {"e": "age"}
    terms, taken = design_terms(parse("shape ~ log(size) + age + sex"), known.select(rows_kept))
    assert [term.coefficients for term in terms] == [("log(size)",), ("age",), ("sex: m - f", "sex: none - f")]
    assert terms[0].columns[:, 0] == pytest.approx(np.log(SIZES[rows_kept]))
    assert terms[1].columns[:, 0].tolist() == [1.5, 2.5, 3.5, 4.5, 6.5, 7.5]
    assert terms[2].columns[:3].tolist() == [[1, 0], [0, 1], [0, 0]]
    assert taken["sex"] == "3 categories (f 2, m 3, none 1), compared with f"
    (term,), taken = design_terms(parse("form ~ factor(site)"), known)
    assert term.columns[:, 0].tolist() == [0, 1, 1, 0, 0, 1, 0]


def test_columns_of_python(tmp_path: Path) -> None:
    known = covariates({"age": [1, 2, None, 4, float("nan"), 6, 7], "size": 7 * [1]}, NAMES, SIZES)
    assert known.missing("age").tolist() == [False, False, True, False, True, False, False]
    assert known.cells["size"] == ("1",) * 7
    turned = covariates({"name": NAMES[::-1], "age": range(7)}, NAMES, SIZES)
    assert turned.cells["age"] == tuple("6543210")
    crossed = design_terms(parse("form ~ age*sex"), covariates({"age": range(7), "sex": "xxyyxyx"}, NAMES, SIZES))[0]
    assert crossed[2].coefficients == ("age:sex: y - x",)
    assert crossed[2].columns[:, 0].tolist() == [0, 0, 2, 3, 0, 5, 0]


def test_names_and_categories_are_the_same_in_other_unicode(tmp_path: Path) -> None:
    """Files of macOS decompose letters, keyboards and most tables do not."""
    decomposed, composed = (unicodedata.normalize(form, "é") for form in ("NFD", "NFC"))
    rows = [f"{composed}1,{composed}", f"{composed}2.ply,{decomposed}", "3.nii.gz,o", "4.seg.nrrd,o"]
    names = [f"{decomposed}1", f"{decomposed}2", "3", "4.seg"]
    known = covariates(write(tmp_path / "t.csv", f"name,t{decomposed}", *rows), names, np.ones(4))
    assert known.names == tuple(names)
    (term,), _ = design_terms(parse(f"form ~ t{decomposed}"), known)
    assert term.coefficients == (f"t{composed}: {composed} - o",)
    assert known.column(f"t{decomposed}") == (composed, composed, "o", "o")


def test_columns_that_differ_only_in_unicode_are_refused(tmp_path: Path) -> None:
    """The second would silently replace the first."""
    titles = [unicodedata.normalize(form, "été") for form in ("NFD", "NFC")]
    file = write(tmp_path / "t.csv", f"name,{','.join(titles)}", *(f"{name},1,2" for name in NAMES))
    for table in (file, {title: [k] * len(NAMES) for k, title in enumerate(titles)}):
        with pytest.raises(InputError, match=f"two columns are called {titles[1]}, with its accents") as caught:
            covariates(table, NAMES, SIZES)
        assert caught.value.hint == "rename one of them"


@pytest.mark.parametrize(
    ("rows", "formula", "words"),
    [
        (["name,x", *(f"{name},1" for name in NAMES[1:])], "x", "no row for a"),
        (["name,x", *(f"{name},1" for name in (*NAMES, "a.ply"))], "x", "two rows for a"),
        (["name,x,x", *(f"{name},1,2" for name in NAMES)], "x", "two columns are called x"),
        (["name", *NAMES], "x", "one column only|columns"),
        (["name,x", *(f"{name},1" for name in NAMES)], "y", "no column called y"),
        (["name,x", *(f"{name},1" for name in NAMES)], "x", "x is the same"),
        (["name,x", *(f"{name},q" for name in NAMES)], "x", "x is the same"),
        (["name,x", *(f"{name},{k}" for k, name in enumerate(NAMES))], "log(x)", "above 0, and a has 0"),
        (["name,x", *(f"{name},{'uv'[k % 2]}" for k, name in enumerate(NAMES))], "log(x)", "needs numbers"),
        (
            ["name,x", *(f"{name},{'inf' if k else 1}" for k, name in enumerate(NAMES))],
            "x",
            "not finite, or huge, for b.1",
        ),
        (
            ["name,x", *(f"{name},{'NA' if k else 1}" for k, name in enumerate(NAMES))],
            "x",
            "x are known for 1 shape only",
        ),
    ],
)
def test_what_a_table_cannot_say(tmp_path: Path, rows: list[str], formula: str, words: str) -> None:
    with pytest.raises((InputError, OptionError), match=words):
        known = covariates(write(tmp_path / "t.csv", *rows), NAMES, SIZES)
        model = parse(f"form ~ {formula}")
        design_terms(model, known.select(complete_rows(model, None, known)[0]))


def test_a_word_among_numbers_is_named_if_there_are_too_many_categories() -> None:
    for cells, hint in ((["1", "2", "3", "ca. 4", "5", "6", "7"], "because of 'ca. 4'"), (NAMES, "x has 7")):
        with pytest.raises(InputError, match="7 shapes are too few") as caught:
            design_terms(parse("form ~ x"), covariates({"x": cells}, NAMES, SIZES))
        assert hint in caught.value.hint


def test_columns_of_another_length_are_refused() -> None:
    with pytest.raises(InputError, match="age has 2 values for 7 shapes"):
        covariates({"age": [1, 2]}, NAMES, SIZES)


def test_a_table_of_coordinates_is_read_soon(tmp_path: Path) -> None:
    """As `meshmatch export` writes one, with columns for all vertices."""

    def prepared(count: int) -> Callable[[], Covariates]:
        titles = [f"{axis}{vertex}" for vertex in range(count) for axis in "xyz"]
        rows = [",".join([name, *("0.5" for _ in titles)]) for name in NAMES]
        path = write(tmp_path / "coords.csv", ",".join(["name", *titles]), *rows)
        return lambda: covariates(path, NAMES, SIZES)

    known = grows_with_size(prepared, 10_000)
    assert known.column("z9999") == ("0.5",) * len(NAMES)
