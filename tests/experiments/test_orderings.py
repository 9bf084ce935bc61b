"""Claims about cells, with numbers made up by hand."""

from dataclasses import replace
from typing import Any

import pytest

from meshmatch.experiments.ablation_cells import VIEWS, Known, all_cells
from meshmatch.experiments.ablation_tables import TABLES, number, ratios
from meshmatch.experiments.cells import BASE, Cell
from meshmatch.experiments.orderings import claims
from meshmatch.experiments.report import wide_console

SETS = ["scape"]


def time(cpu: float) -> dict[str, Any]:
    return {"cpu_ms": cpu, "ms": 2 * cpu, "device": "cpu"}


def known(
    held_out: dict[Cell, float], errors: dict[tuple[Cell, str], float] | None = None, **more: Any
) -> Known:
    trained = {cell: {"held_out_cm": value, "steps": 7, "rule": "parts"} for cell, value in held_out.items()}
    by_method = {(cell, "scape", how): {"mean_cm": value} for (cell, how), value in (errors or {}).items()}
    return Known(trained, by_method, more.get("times", {}), more.get("memory", {}))


def verdicts(found: Known) -> dict[str, bool | None]:
    return {f"{claim.where}: {claim.words}".removeprefix(": "): claim.holds for claim in claims(found, SETS)}


def test_nothing_is_claimed_of_what_was_not_measured() -> None:
    assert set(verdicts(known({})).values()) == {None}
    assert set(verdicts(known({BASE: 3.0})).values()) == {None}


def test_fields_are_ordered_by_their_errors() -> None:
    rbf, pointwise = (replace(BASE, field=field) for field in ("rbf", "pointwise"))
    words = "held out: with vol+arap+Z: mls < rbf < pointwise"
    assert verdicts(known({BASE: 1.0, rbf: 2.0, pointwise: 3.0}))[words] is True
    assert verdicts(known({BASE: 1.0, rbf: 3.0, pointwise: 2.0}))[words] is False
    assert verdicts(known({BASE: 2.0, rbf: 2.0, pointwise: 3.0}))[words] is False
    assert verdicts(known({BASE: 1.0, pointwise: 3.0}))[words] is None


def test_the_best_of_the_grid_is_the_base() -> None:
    words = "held out: 300 nodes of radius 0.2 are the best of the grid"
    dense = replace(BASE, nodes=900, radius=0.1)
    assert verdicts(known({BASE: 1.0, dense: 2.0}))[words] is True
    assert verdicts(known({BASE: 2.0, dense: 1.0, replace(BASE, pose="A"): 0.5}))[words] is False


def test_refinements_are_ordered_on_sets() -> None:
    words = "scape: refined with regularisers < by Chamfer alone < not at all"
    errors = {(BASE, "code"): 1.0, (BASE, "chamfer"): 2.0, (BASE, "none"): 3.0}
    assert verdicts(known({BASE: 1.0}, errors))[words] is True
    assert verdicts(known({BASE: 1.0}, errors | {(BASE, "none"): 1.5}))[words] is False
    again = replace(BASE, seed=1)  # measured after one refinement alone, which is no comparison
    assert verdicts(known({BASE: 1.0, again: 1.0}, errors | {(again, "code"): 9.0}))[words] is True
    more = errors | {(again, "code"): 9.0, (again, "chamfer"): 3.0, (again, "none"): 9.0}
    assert verdicts(known({BASE: 1.0, again: 1.0}, more))[words] is False


def test_costs_are_told_by_their_ratios() -> None:
    times = {}
    for field, plain, full in (("mls", 10.0, 15.0), ("rbf", 10.0, 30.0), ("pointwise", 50.0, 500.0)):
        times[replace(BASE, field=field, constraint="none").name] = time(plain)
        times[replace(BASE, field=field).name] = time(full)
    found = known({}, times=times)
    assert ratios(found)["field-pointwise"] == pytest.approx(500 / 15, abs=0.01)
    held = verdicts(found)
    assert held["vol+arap+Z makes an iteration dearer by less for mls than for pointwise"] is True
    assert held["vol+arap+Z makes an iteration of mls at most 2 times as dear"] is True
    assert held["vol+arap+Z makes an iteration of rbf at most 2 times as dear"] is False
    assert held["with vol+arap+Z an iteration costs pointwise at least 3 times what it costs mls"] is True


def test_seeds_are_joined() -> None:
    found = known({BASE: 2.0, replace(BASE, seed=1): 3.0, replace(BASE, pose="A", seed=1): 9.0})
    assert found.error(BASE, "held out") == [2.0, 3.0]
    assert found.error(replace(BASE, pose="A"), "held out") == [9.0]
    assert number([2.0, 3.0]) == "2.50 ± 0.50"
    assert number([2.0]) == "2.00"
    assert number([]) == "-"


def test_tables_show_what_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    cells = all_cells(VIEWS)
    trained: dict[Cell, dict[str, Any]] = {
        cell: {"held_out_cm": 10.0 + k, "steps": 100 + k, "rule": "uniform"} for k, cell in enumerate(cells)
    }
    trained[replace(BASE, nodes=2700, radius=0.5)] = {"skipped": "no nodes"}
    del trained[cells[3]]
    errors = {
        (cell, "scape-pcn", "code"): {"mean_cm": 50.0 + k, "median_cm": 30.0 + k}
        for k, cell in enumerate(cells)
    }
    errors[BASE, "scape-pcn", "nodes"] = {"mean_cm": 44.44}
    times = {cell.name: time(123.4) for cell in cells[:9]}
    found = Known(trained, errors, times, {"base": {"megabytes": 77.7}})
    for view, table in TABLES.items():
        for each in table(found, ["scape-pcn"], "a budget"):
            wide_console().print(each)
        out = capsys.readouterr().out
        assert "a budget" in out
        assert view.replace("table", "Table ").replace("figure", "Figure ") in out
        if view == "table4":
            for words in ("10.00", "50.00", "30.00", "44.44", "6.6", "123.4", "78", "4098.3", "338.7", "-"):
                assert words in out
        if view == "table6":
            assert "uniform" in out
            assert "cubic" in out
            assert "cannot be" in out
