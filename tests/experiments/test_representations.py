"""Table 4 on eggs: cells, their iterations, memory and errors, and a run that goes on where it was stopped."""

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pytest

from meshmatch.cli import main as meshmatch
from meshmatch.errors import InputError, OptionError
from meshmatch.experiments import representations
from meshmatch.experiments.cell_files import claim, keep, read_cell
from meshmatch.experiments.iterations import CONSTRAINTS, Cell, Setting, built, memory, timed
from meshmatch.experiments.representations import PAPER_MS, main, ratios
from meshmatch.fields.choice import FIELDS
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.shapes.files import save_shape
from meshmatch.training.run import Recipe
from tests.experiments.small_bench import build
from tests.fitting.eggs import bent_egg, egg_model
from tests.training.small import POINTS


@dataclass(frozen=True)
class Tiny(Setting):
    """The same with a network and scans that cost nothing."""

    def recipe(self, cell: Cell) -> Recipe:
        chosen = super().recipe(cell)
        network = replace(POINTS, field=chosen.network.field)
        scan = replace(chosen.scan, points=64)
        return replace(chosen, network=network, scan=scan, train=replace(chosen.train, steps=2, workers=0))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("eggs")
    (root / "eggs").mkdir()
    for seed in range(3):
        save_shape(root / "eggs" / f"egg{seed}.ply", bent_egg(egg_model(), seed))
    nodes = ["--nodes", "36", "--radius", "0.5", "--strategy", "uniform", "-q"]
    assert meshmatch(["prepare", str(root / "eggs"), "-o", str(root / "prepared"), *nodes]) == 0
    return root / "prepared"


@pytest.fixture
def setting(prepared: Path) -> Tiny:
    return Tiny(shapes=str(prepared), batch=2)


def test_cells_differ_in_representation_and_constraints_alone() -> None:
    plain = Setting(batch=5, width=40, code=9, threads=2, seed=3)
    for field in FIELDS:
        none, some, every = (plain.recipe(Cell(field, constraint)) for constraint in CONSTRAINTS)
        assert none.network == some.network == every.network
        assert (none.network.field, none.network.width, none.network.code) == (field, 40, 9)
        assert [r.train.loss.volume for r in (none, some, every)] == [0, 5e-3, 5e-3]
        assert [r.train.loss.arap for r in (none, some, every)] == [0, 1e-2, 1e-2]
        assert [r.train.loss.blend for r in (none, some, every)] == [0, 0, 5e-3]
        assert (none.train.shapes, none.train.threads, none.train.seed) == (5, 2, 3)
    assert Setting().recipe(Cell("mls", "none")).train.shapes == 16  # the paper's
    assert Setting(preset="default").recipe(Cell("mls", "none")).network.encoder == "basis"


def test_cells_take_turns(setting: Tiny) -> None:
    cells = [Cell(field, "vol+arap+Z") for field in FIELDS]
    heard: list[int] = []
    found = timed(setting, cells, 2, heard.append)
    assert heard == [0, 1, 2]
    assert set(found) == {f"{field}-vol-arap-Z" for field in FIELDS}
    for record in found.values():
        assert len(record["ms_all"]) == record["rounds"] == 2
        assert min(record["ms_all"]) <= record["ms"] <= max(record["ms_all"])
        assert record["cpu_ms"] > 0


def test_a_cell_without_constraints_has_no_terms_of_them(setting: Tiny) -> None:
    trainer, batches = built(setting, Cell("pointwise", "none"), *setting.material())
    assert set(trainer.iterate(batches[0])) == {"total", "reconstruction", "error_code"}
    trainer, batches = built(setting, Cell("pointwise", "vol+arap+Z"), *setting.material())
    assert {"volume", "arap", "blend"} < set(trainer.iterate(batches[0]))
    assert trainer.step == 1


def test_memory_is_that_of_the_iterations(setting: Tiny) -> None:
    small = memory(setting, Cell("pointwise", "vol+arap"), 1)
    large = memory(replace(setting, batch=60), Cell("pointwise", "vol+arap"), 1)
    assert "resident set" in small["how"] or "GPU" in small["how"]
    assert 0 <= small["megabytes"] < large["megabytes"]


def test_ratios_are_to_moving_least_squares_with_the_same_constraints() -> None:
    ms = {"mls-none": 2.0, "rbf-none": 3.0, "pointwise-vol-arap": 9.0}
    assert ratios(ms) == {"mls-none": 1.0, "rbf-none": 1.5}
    assert set(PAPER_MS) == set(FIELDS)
    assert all(tuple(row) == CONSTRAINTS for row in PAPER_MS.values())


def test_cells_are_kept(tmp_path: Path) -> None:
    cell = Cell("rbf", "vol+arap")
    assert read_cell(tmp_path, cell) == {}
    keep(tmp_path, cell, time={"ms": 1.0})
    keep(tmp_path, cell, memory={"megabytes": 2.0})
    assert read_cell(tmp_path, cell) == {
        **{"field": "rbf", "constraint": "vol+arap"},
        **{"time": {"ms": 1.0}, "memory": {"megabytes": 2.0}},
    }
    for words in ("{", "[]"):
        (tmp_path / "rbf-vol-arap.json").write_text(words)
        with pytest.raises(InputError, match=r"rbf-vol-arap\.json"):
            read_cell(tmp_path, cell)
    claim(tmp_path / "new", Setting())
    claim(tmp_path / "new", Setting())
    with pytest.raises(OptionError, match="another setting"):
        claim(tmp_path / "new", Setting(seed=1))


def test_a_run_is_a_table_and_a_line_and_goes_on(
    prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(representations, "Setting", Tiny)
    quick = partial(FitConfig, samples=300, coarse_samples=60, laid=1)
    monkeypatch.setattr(representations, "FitConfig", quick)
    calls = {"timed": 0, "memory": 0, "error_of": 0}

    def counted(name: str):
        real = getattr(representations, name)

        def call(*given, **named):
            calls[name] += 1
            return real(*given, **named)

        monkeypatch.setattr(representations, name, call)

    for name in calls:
        counted(name)
    monkeypatch.setattr(
        representations, "memory", lambda *_: calls.update(memory=calls["memory"] + 1) or {"megabytes": 1.5}
    )
    data = build(tmp_path / "bench")
    words = ["--output", str(tmp_path / "cells"), "--shapes", str(prepared), "--batch", "2", "--rounds", "1"]
    words += ["--data", str(data), "--cache", str(tmp_path / "cache"), "--constraints", "none,vol+arap"]
    assert main([*words, "--fields", "mls,pointwise"]) == 0
    assert calls == {"timed": 1, "memory": 4, "error_of": 0}
    out = capsys.readouterr().out
    assert "Representations: preset paper, 2 shapes a batch, 1 thread" in out
    record = json.loads(out.splitlines()[-1])
    assert record["times_as_slow"]["mls-none"] == 1.0
    assert record["cells"]["pointwise-none"]["memory"] == {"megabytes": 1.5}
    assert "error" not in record["cells"]["mls-none"]

    (tmp_path / "cells" / "mls-none.json").unlink()  # as if it had been stopped before
    budget = ["--minutes", "5", "--sets", "scape", "--limit-pairs", "1", "--code-steps", "2"]
    assert main([*words, "--fields", "mls,pointwise", *budget]) == 0
    assert calls == {"timed": 2, "memory": 5, "error_of": 4}
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    error = record["cells"]["pointwise-vol-arap"]["error"]
    assert error["steps"] == 2
    assert error["sets"]["scape"]["pairs"] == 1
    assert error["sets"]["scape"]["mean_cm"] >= 0
    assert main([*words, "--fields", "mls,pointwise", *budget]) == 0
    assert calls == {"timed": 2, "memory": 5, "error_of": 4}
    out = capsys.readouterr().out
    assert "errors after 5 min of training, 2 steps on the code" in out
    assert main([*words, "--fields", "mls,pointwise", *budget, "--seed", "4"]) == 1
    assert "another setting" in capsys.readouterr().err
    assert main([*words, "--fields", "mls,pointwise", *budget, "--code-steps", "3"]) == 1
    assert "another budget" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [["--fields", "splines"], ["--constraints", "all"], ["--rounds", "0"], ["--minutes", "-1"]]
)
def test_choices_that_cannot_be(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--output", str(tmp_path), *words])
    assert "error:" in capsys.readouterr().err
