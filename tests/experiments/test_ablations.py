"""The command on eggs: a table, figures and a line; a run that goes on; every option."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from meshmatch.experiments import ablation_run, cell_errors, pool
from meshmatch.experiments.ablation_cells import VIEWS, all_cells
from meshmatch.experiments.ablation_run import methods_of
from meshmatch.experiments.ablations import main
from meshmatch.experiments.cell_errors import Measure
from meshmatch.experiments.cells import BASE
from meshmatch.fitting.fit_config import FitConfig
from tests.experiments.egg_cells import make_small, prepare_eggs
from tests.experiments.small_bench import build
from tests.fitting.eggs import egg_model, write_model

LINE = {"steps": [0, 10], "seconds": [0.0, 0.2], "errors_cm": [[3.0, 5.0], [2.0, 3.0]]}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("ablations")
    prepare_eggs(root)
    build(root / "bench")
    write_model(egg_model(), root / "egg")
    return root


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """How often something is measured, with everything made small."""
    make_small(monkeypatch)
    drawn = pool._drawn
    monkeypatch.setattr(pool, "_drawn", lambda setting, pose, shapes: drawn(setting, pose, 4))
    quick = partial(FitConfig, samples=300, coarse_samples=60, careful=1)
    monkeypatch.setattr(cell_errors, "FitConfig", quick)
    monkeypatch.setattr(ablation_run, "Measure", partial(Measure, landmarks=20, samples=300, code_points=200))
    monkeypatch.setattr(ablation_run, "BODIES", 2)
    monkeypatch.setattr(ablation_run, "LINES", [])
    counted = {"train_cell": 0, "errors_of": 0, "timed": 0, "memory": 0, "oriented": 0}
    monkeypatch.setattr(ablation_run, "memory", lambda *_: {"megabytes": 1.5, "how": "guessed"})
    monkeypatch.setattr(ablation_run, "descend", lambda *_: {"ours": LINE})

    def count(name: str) -> None:
        real = getattr(ablation_run, name)

        def call(*given, **named):
            counted[name] += 1
            return real(*given, **named)

        monkeypatch.setattr(ablation_run, name, call)

    for name in counted:
        count(name)
    return counted


def line(capsys: pytest.CaptureFixture[str]) -> tuple[str, dict]:
    out = capsys.readouterr().out
    return out, json.loads(out.splitlines()[-1])


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was told on stderr, which a narrow terminal folds."""
    return " ".join(capsys.readouterr().err.split())


def test_a_run_is_tables_figures_and_a_line_and_goes_on(
    places: Path, tmp_path: Path, calls: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "--output",
        str(tmp_path / "out"),
        "--folder",
        str(places / "prepared"),
        "--model",
        str(places / "egg"),
    ]
    words += [
        "--data",
        str(places / "bench"),
        "--cache",
        str(tmp_path / "cache"),
        "--sets",
        "scape,faust",
    ]
    words += ["--minutes", "0.0005", "--code-steps", "2", "--shapes", "2", "--batch", "3", "--threads", "1"]
    words += ["--preset", "small", "--identities", "16", "--code", "16", "--width", "32", "--rounds", "1"]
    few = [*words, "--tables", "", "--figures", "10"]
    assert main([*few, "--cells", "supervised-100"]) == 0
    assert calls["train_cell"] == 2  # the base says how many steps
    out, record = line(capsys)
    assert "Not measured: supervised-50" in out
    assert set(record["cells"]) == {"base", "supervised-100"}
    steps = record["cells"]["base"]["steps"]
    assert record["cells"]["supervised-100"]["steps"] == steps
    assert main([*few, "--cells", "base,seed-7"]) == 1
    assert "no cell 'seed-7'" in said(capsys)
    assert main(few) == 0
    assert calls == {"train_cell": 3, "errors_of": 6, "timed": 0, "memory": 0, "oriented": 4}
    out, record = line(capsys)
    assert (
        f"0.0005 CPU min of training a cell or the base's {steps} steps, preset small, 2 steps on the code"
        in out
    )
    assert set(record["cells"]) == {"base", "supervised-100", "supervised-50"}
    assert {"base scape chamfer", "base scape none", "supervised-50 faust code"} <= record["errors"].keys()
    assert (tmp_path / "out" / "figure-10.png").is_file()

    assert main(few) == 0  # everything is there
    assert calls["train_cell"] == 3
    assert calls["errors_of"] == 6
    (tmp_path / "out" / "supervised-50" / "trained.json").unlink()
    (tmp_path / "out" / "supervised-50" / "error-scape-code.json").unlink()
    (tmp_path / "out" / "supervised-50" / "error-faust-code.json").unlink()
    assert main([*few, "--show", "--pictures", str(tmp_path / "pictures")]) == 0
    out, record = line(capsys)
    assert calls["train_cell"] == 3
    assert "Not measured: supervised-50" in out
    assert set(record["cells"]) == {"base", "supervised-100"}
    assert (tmp_path / "pictures" / "figure-10.png").is_file()
    assert main(few) == 0
    assert calls["train_cell"] == 4
    capsys.readouterr()

    assert main([*few[:-1], "9", "--minutes", "0.0004"]) == 1  # cells of another budget
    assert "other choices (minutes)" in said(capsys)
    assert main([*few, "--code-steps", "3"]) == 1
    assert "other choices (measure)" in said(capsys)


def test_table_4_has_costs_without_training(
    places: Path, tmp_path: Path, calls: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--output", str(tmp_path / "out"), "--folder", str(places / "prepared"), "--minutes", "0"]
    words += ["--sets", "", "--rounds", "1", "--tables", "4", "--figures", "6", "--batch", "2"]
    assert main(words) == 0
    assert calls == {"train_cell": 0, "errors_of": 0, "timed": 1, "memory": 9, "oriented": 0}
    out, record = line(capsys)
    assert "cost of a training iteration" in out
    assert "errors in cm" not in out
    assert len(record["times"]) == len(record["memory"]) == 9
    assert record["figure6"] is None
    assert main([*words, "--show", "--markdown", str(tmp_path / "table.md")]) == 0
    assert calls["timed"] == 1
    written = (tmp_path / "table.md").read_text(encoding="utf-8")
    head, rule, first = written.split("\n")[2:5]
    assert head.startswith("| constraint | field | CPU ms |")
    assert rule.count("---") == head.count("|") - 1 == first.count("|") - 1
    assert first.startswith("| none | mls |")
    assert "\n| mls: both regularisers < none | not measured |" in written
    assert "| claim | here |" in written
    out, shown = line(capsys)
    assert shown["times"] == record["times"]
    assert main([*words[:-2], "--rounds", "0"]) == 0
    assert line(capsys)[1]["times"] == {}


def two_seeds(places: Path, output: Path) -> list[str]:
    """Words for table 5 and figure 6 with two seeds, measured on no set."""
    words = ["--output", str(output), "--folder", str(places / "prepared"), "--minutes", "1e-6", "--sets", ""]
    return [*words, "--batch", "2", "--seeds", "2", "--tables", "5", "--figures", "6", "--rounds", "0"]


def test_all_cells_of_two_seeds(
    places: Path, tmp_path: Path, calls: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    words = two_seeds(places, tmp_path)
    assert main(words) == 0
    assert calls["train_cell"] == 6 + 4
    out, record = line(capsys)
    assert "Table 5, errors in cm" in out
    assert "±" in out
    assert "field-pointwise.constraint-none.seed-1" in record["cells"]
    assert record["figure6"]["lines"] == {"ours": LINE}
    for claim in record["claims"]:
        assert claim["words"] in out
    assert any(claim["holds"] is not None for claim in record["claims"])
    assert {path.name for path in tmp_path.glob("*.png")} == {"table-5.png", "figure-6.png"}

    # A cell whose model is gone can be shown, but not measured on more.
    (tmp_path / "base" / "model" / "card.json").unlink()
    more = ["--sets", "scape", "--data", str(places / "bench"), "--model", str(places / "egg")]
    assert main([*words, *more]) == 1
    assert "has lost its model" in said(capsys)


@pytest.mark.parametrize(
    ("repeated", "more"), [("", 0), ("table5,figure6", 6), ("figure6", 2), ("figure9", 1)]
)
def test_the_views_that_are_repeated_are_a_choice(
    places: Path, tmp_path: Path, calls: dict[str, int], repeated: str, more: int
) -> None:
    assert main([*two_seeds(places, tmp_path), "--repeated", repeated]) == 0
    assert calls["train_cell"] == 6 + more


@pytest.mark.parametrize(
    "words",
    [["--minutes", "-1"], ["--rounds", "-1"], ["--seeds", "0"], ["--code-steps", "0"], ["--shapes", "1"]],
)
def test_choices_that_cannot_be(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--output", str(tmp_path), *words])
    assert "needed" in said(capsys)


@pytest.mark.parametrize("words", [["--tables", "8"], ["--figures", "x"], ["--repeated", "4"]])
def test_views_that_are_not_there(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--output", str(tmp_path), "--sets", "", *words]) == 1
    assert "choose from table4" in said(capsys)


def test_a_cell_is_measured_alike_with_every_seed() -> None:
    for cell in all_cells(VIEWS):
        assert methods_of(replace(cell, seed=3)) == methods_of(cell)
    assert methods_of(replace(BASE, seed=1)) == ("code", "none", "chamfer", "nodes")
    assert methods_of(replace(BASE, field="rbf", seed=1)) == ("code", "nodes")
    assert methods_of(replace(BASE, pose="A", seed=1)) == ("code",)


def test_a_file_in_the_way_of_the_folder_is_an_error_in_words(
    places: Path, tmp_path: Path, calls: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("here first")
    words = ["--output", str(tmp_path / "file"), "--folder", str(places / "prepared"), "--minutes", "1e-6"]
    assert main([*words, "--sets", "", "--tables", "", "--figures", "10", "--batch", "2"]) == 1
    assert "cannot make the folder" in said(capsys)
