"""Tables and claims about ablation runs, with numbers made up by hand."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meshmatch.experiments.paper.ablation_claims import Sample, claims, order, pairs_interval, seeds_interval
from meshmatch.experiments.paper.ablation_results import cost_table, draw_views, number, tables
from meshmatch.experiments.paper.ablation_views import BASE, PAPER_SETS, VIEWS, Known, Run, all_runs, methods_of
from meshmatch.experiments.runner import as_markdown

SETS = ["scape"]


def time(cpu: float) -> dict[str, Any]:
    return {"cpu_ms": cpu, "ms": 2 * cpu, "device": "cpu"}


def known(held_out: dict[Run, float], errors: dict[tuple[Run, str], float] | None = None, **more: Any) -> Known:
    trained = {run: {"held_out_cm": value, "steps": 7, "rule": "parts"} for run, value in held_out.items()}
    by_method = {(run, "scape", how): {"mean_cm": value} for (run, how), value in (errors or {}).items()}
    return Known(trained, by_method, more.get("times", {}), more.get("memory", {}))


def verdicts(found: Known) -> dict[str, str]:
    return {f"{claim.where}: {claim.words}".removeprefix(": "): claim.outcome for claim in claims(found, SETS)}


def twice(errors: dict[Run, float], off: float = 0.01) -> dict[Run, float]:
    """The same trained from another seed, which moves errors a little."""
    return errors | {replace(run, seed=1): value + off for run, value in errors.items()}


def test_nothing_is_claimed_of_what_was_not_measured() -> None:
    assert set(verdicts(known({})).values()) == {"not measured"}
    assert set(verdicts(known({BASE: 3.0})).values()) == {"not measured"}


def test_fields_are_ordered_by_their_errors() -> None:
    rbf, pointwise = (replace(BASE, field=field) for field in ("rbf", "pointwise"))
    words = "held out: with vol+arap+Z: mls < rbf < pointwise"
    assert verdicts(known(twice({BASE: 1.0, rbf: 2.0, pointwise: 3.0})))[words] == "holds"
    assert verdicts(known(twice({BASE: 1.0, rbf: 3.0, pointwise: 2.0})))[words] == "does not hold"
    assert verdicts(known(twice({BASE: 2.0, rbf: 2.0, pointwise: 3.0})))[words] == "not told apart"
    assert verdicts(known({BASE: 1.0, rbf: 2.0, pointwise: 3.0}))[words] == "not told apart"  # one seed
    assert verdicts(known(twice({BASE: 1.0, rbf: 1.5, pointwise: 3.0}, 0.3)))[words] == "not told apart"
    assert verdicts(known({BASE: 1.0, pointwise: 3.0}))[words] == "not measured"


def test_the_best_of_the_grid_is_the_base() -> None:
    words = "held out: 300 nodes of radius 0.2 are the best of the grid"
    dense = replace(BASE, nodes=900, radius=0.1)
    assert verdicts(known(twice({BASE: 1.0, dense: 2.0})))[words] == "holds"
    assert verdicts(known(twice({BASE: 2.0, dense: 1.0, replace(BASE, pose="A"): 0.5})))[words] == "does not hold"
    assert verdicts(known({BASE: 1.0, dense: 2.0}))[words] == "not told apart"


def test_an_interval_of_seeds_is_the_textbooks() -> None:
    low, high = seeds_interval([1.0, 1.2], [2.0, 2.2], paired=False) or (0.0, 0.0)
    reach = 4.302653 * np.sqrt(0.02 / 2 + 0.02 / 2)  # two degrees of freedom
    assert (low, high) == pytest.approx((1 - reach, 1 + reach))
    assert seeds_interval([1.0, 5.0], [2.0, 6.0], paired=True) == (1.0, 1.0)
    assert seeds_interval([1.0], [2.0, 2.1], paired=False) is None


def test_pairs_must_carry_an_order_too() -> None:
    """Half of the pairs are better and half worse: the mean of one pair more or less decides."""
    seeds = ([1.0, 1.01], [1.1, 1.11])
    even, clear = [0.0, 0.0, 2.0, 2.0], [1.0, 1.0, 1.0, 1.0]
    assert order(Sample(seeds[0], [clear, clear]), Sample(seeds[1], [[1.1] * 4] * 2)) == 1
    assert order(Sample(seeds[0], [clear, clear]), Sample(seeds[1], [even, [0.2, 0.2, 2.2, 2.2]])) == 0
    assert order(Sample([1.0], [clear]), Sample([1.1], [[1.1] * 4]), paired=True) == 1  # the same network
    low, high = pairs_interval(np.zeros(4), np.array([0.0, 0.0, 2.0, 2.0]))
    assert low == 0.0 and 1.0 < high <= 2.0


def test_bodies_must_carry_an_order_of_held_out_errors() -> None:
    """Seeds agree, but one body in four decides: what holds must hold by bodies too. A verdict tells the interval."""
    wide = replace(BASE, pose="I")
    words = "held out: template pose T < I"
    found = known(twice({BASE: 1.0, wide: 2.0}))
    for run in found.trained:
        bodies = [1.0] * 4 if run.pose == "T" else [0.0, 0.0, 0.0, 8.0]
        found.trained[run]["bodies_cm"] = bodies  # type: ignore[index]
    assert verdicts(found)[words] == "not told apart"
    for run in found.trained:
        found.trained[run]["bodies_cm"] = [1.0 + (run.pose == "I")] * 4  # type: ignore[index]
    assert verdicts(found)[words] == "holds"
    claim = next(each for each in claims(found, SETS) if each.words == "template pose T < I")
    low, high = claim.intervals[0] or (0.0, 0.0)
    assert low < 1.0 < high
    assert f"; differences {low:+.2f} to {high:+.2f}" in claim.verdict


def test_refinements_are_ordered_on_sets() -> None:
    words = "scape: refined with regularisers < by Chamfer alone < not at all"
    again = replace(BASE, seed=1)
    errors = {(BASE, "code"): 1.0, (BASE, "chamfer"): 2.0, (BASE, "none"): 3.0}
    assert verdicts(known({BASE: 1.0}, errors))[words] == "not told apart"  # one seed, no pairs
    more = errors | {(again, "code"): 6.0, (again, "chamfer"): 7.01, (again, "none"): 8.02}
    assert verdicts(known({BASE: 1.0, again: 1.0}, more))[words] == "holds"
    worse = more | {(BASE, "none"): 1.5, (again, "none"): 6.51}
    assert verdicts(known({BASE: 1.0, again: 1.0}, worse))[words] == "does not hold"
    # measured after one refinement alone, which is no comparison
    assert verdicts(known({BASE: 1.0, again: 1.0}, errors | {(again, "code"): 9.0}))[words] == "not told apart"


def test_costs_are_told_by_their_ratios() -> None:
    times = {}
    for field, plain, full in (("mls", 10.0, 15.0), ("rbf", 10.0, 30.0), ("pointwise", 50.0, 500.0)):
        times[replace(BASE, field=field, constraint="none").name] = time(plain)
        times[replace(BASE, field=field).name] = time(full)
    found = known({}, times=times)
    assert "| vol+arap+Z | pointwise | 500.0 | 1000.0 | 33.3 |" in as_markdown(cost_table(found))
    held = verdicts(found)
    assert held["vol+arap+Z slows an iteration of mls by less than one of pointwise"] == "holds"
    assert held["an iteration of mls takes at most 2 times as long with vol+arap+Z"] == "holds"
    assert held["an iteration of rbf takes at most 2 times as long with vol+arap+Z"] == "does not hold"
    assert held["with vol+arap+Z an iteration of pointwise takes at least 3 times as long as one of mls"] == "holds"


def test_table_7_says_what_each_rule_refuses() -> None:
    uniform = replace(BASE, strategy="uniform")
    found = known({BASE: 2.0, uniform: 3.0})
    found = replace(
        found,
        trained={run: {**record, "rule": run.strategy} for run, record in found.trained.items()},
        refused={BASE.name: {"refused": 0.758, "taken": 0.2}, uniform.name: {"refused": 0.0, "taken": 0.0}},
    )
    drawn = {view: as_markdown(tables(found, [view], [], "")[0]) for view in ("table7", "table5")}
    assert "| nodes by | template | rule refuses | steps |" in drawn["table7"]
    assert (
        "| parts, milder: 20.0 % | T | 75.8 % | 7 | 2.00 |" in drawn["table7"]
        and "| uniform | T | 0.0 % | 7 |" in drawn["table7"]
    )
    assert "refuses" not in drawn["table5"]


def test_three_methods_are_drawn_at_every_place(tmp_path: Path) -> None:
    runs = VIEWS["figure9"].runs
    errors = {(run, where, how): {"mean_cm": 2.0} for run in runs for where in PAPER_SETS for how in methods_of(run)}
    found = replace(known(dict.fromkeys(runs, 1.0)), errors=errors)
    (path,) = draw_views(found, ["figure9"], PAPER_SETS, tmp_path)
    with Image.open(path) as image:
        assert path.name == "figure-9.png" and len(np.unique(np.asarray(image.convert("L")))) > 20


def test_seeds_are_joined() -> None:
    found = known({BASE: 2.0, replace(BASE, seed=1): 3.0, replace(BASE, pose="A", seed=1): 9.0})
    assert found.error(BASE, "held out") == [2.0, 3.0]
    assert found.error(replace(BASE, pose="A"), "held out") == [9.0]
    assert number([2.0, 3.0]) == "2.50 ± 0.71"
    assert number([2.0]) == "2.00"
    assert number([]) == "-"


def test_tables_show_what_is_there() -> None:
    runs = all_runs(list(VIEWS))
    trained: dict[Run, dict[str, Any]] = {
        run: {"held_out_cm": 10.0 + k, "steps": 100 + k, "rule": "uniform"} for k, run in enumerate(runs)
    }
    trained[replace(BASE, nodes=2700, radius=0.5)] = {"skipped": "no nodes"}
    del trained[runs[3]]
    errors = {(run, "scape-pcn", "code"): {"mean_cm": 50.0 + k, "median_cm": 30.0 + k} for k, run in enumerate(runs)}
    errors[BASE, "scape-pcn", "nodes"] = {"mean_cm": 44.44}
    times = {run.name: time(123.4) for run in runs[:9]}
    found = Known(trained, errors, times, {"base": {"megabytes": 77.7}})
    for view in VIEWS:
        out = "\n".join(as_markdown(each) for each in tables(found, [view], ["scape-pcn"], "a budget"))
        assert ("a budget" in out) == (view != "figure6")
        if view == "table4":
            for words in ("10.00", "50.00", "30.00", "44.44", "6.6", "123.4", "78", "4098.3", "338.7", "-"):
                assert words in out
        if view == "table6":
            assert "uniform" in out
            assert "cubic" in out
            assert "cannot be" in out
