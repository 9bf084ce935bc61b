"""The command on eggs: a table, figures and a line; a run that goes on; every option."""

import json
from functools import partial
from pathlib import Path

import pytest

from meshmatch.experiments.paper import ablation_errors, ablation_training, ablation_transmatch, ablations
from meshmatch.experiments.paper.ablation_errors import Measure
from meshmatch.experiments.paper.ablations import main
from meshmatch.fitting.fit_config import FitConfig
from tests.experiments.egg_runs import make_small, prepare_eggs
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
    drawn = ablation_training.pool_of.__wrapped__
    for module in (ablation_training, ablation_transmatch):
        monkeypatch.setattr(module, "pool_of", lambda setting, pose, **more: drawn(setting, pose, 4, **more))
    quick = partial(FitConfig, samples=300, coarse_samples=60, careful=1)
    monkeypatch.setattr(ablation_errors, "FitConfig", quick)
    monkeypatch.setattr(ablations, "Measure", partial(Measure, landmarks=20, samples=300, code_points=200))
    monkeypatch.setattr(ablations, "BODIES", 2)
    monkeypatch.setattr(ablations, "LINES", {})
    counted = {"train_run": 0, "errors_of": 0, "timed": 0, "memory": 0, "oriented": 0}
    monkeypatch.setattr(ablations, "memory", lambda *_: {"megabytes": 1.5, "how": "guessed"})
    monkeypatch.setattr(ablations, "descend", lambda *_: {"ours": LINE})

    def count(name: str) -> None:
        real = getattr(ablations, name)

        def call(*given, **named):
            counted[name] += 1
            return real(*given, **named)

        monkeypatch.setattr(ablations, name, call)

    for name in counted:
        count(name)
    return counted


def line(capsys: pytest.CaptureFixture[str]) -> tuple[str, dict]:
    out = capsys.readouterr().out
    return out, json.loads(out.splitlines()[-1])


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was told on stderr, which a narrow terminal folds."""
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_a_run_is_tables_figures_and_a_line_and_goes_on(
    places: Path, tmp_path: Path, calls: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    words = ["--output", str(output), "--folder", str(places / "prepared"), "--model", str(places / "egg")]
    words += ["--data", str(places / "bench"), "--cache", str(tmp_path / "cache"), "--sets", "scape,faust"]
    words += [
        "--minutes",
        "0.0005",
        "--code-steps",
        "2",
        "--shapes",
        "2",
        "--views",
        "figure10",
        "--without",
        "pointwise",
    ]
    assert main([*words, "--show"]) == 0
    out, record = line(capsys)
    rivals = [f"field-transmatch.constraint-none{few}" for few in (".supervised-50", ".supervised-100", "")]
    assert f"Not measured: base, supervised-50, supervised-100, {', '.join(rivals)}" in out
    assert main(words) == 0
    assert calls == {"train_run": 3, "errors_of": 6, "timed": 0, "memory": 0, "oriented": 4}
    out, record = line(capsys)
    assert set(record["runs"]) == {"base", "supervised-100", "supervised-50", *rivals}
    steps = record["runs"]["base"]["steps"]
    assert {record["runs"][name]["steps"] for name in ("supervised-100", *rivals)} == {steps}
    assert f"0.0005 CPU min of training a run or the base's {steps} steps, radii in units of" in out
    assert "preset small, 2 steps on the code" in out
    assert {"base scape chamfer", "base scape none", "supervised-50 faust code", f"{rivals[0]} faust none"} <= record[
        "errors"
    ].keys()
    assert (output / "figure-10.png").is_file()

    for name in ("trained", "error-scape-code", "error-faust-code"):
        (output / "supervised-50" / f"{name}.json").unlink()
    pictures = tmp_path / "pictures"
    assert main([*words, "--show", "--pictures", str(pictures)]) == 0
    out, record = line(capsys)
    assert "Not measured: supervised-50" in out and set(record["runs"]) == {"base", "supervised-100", *rivals}
    assert (pictures / "figure-10.png").is_file()
    assert main(words) == 0
    assert (calls["train_run"], calls["errors_of"]) == (4, 8)
    (output / "base" / "model" / "card.json").unlink()  # what is there needs no model, more of it does
    assert main(words) == 0
    (output / "base" / "error-faust-code.json").unlink()
    capsys.readouterr()
    assert main(words) == 1
    assert "has lost its model" in said(capsys)
    assert main([*words, "--minutes", "0.0004"]) == 1  # runs of another budget
    assert "other choices (minutes)" in said(capsys)
    assert main([word for word in words if word not in ("--minutes", "0.0005")]) == 1  # equal steps are another
    assert "other choices (minutes, steps)" in said(capsys)


@pytest.mark.slow
def test_every_run_has_the_steps(
    places: Path, tmp_path: Path, calls: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    """Table 4 too: its fields learn for as many steps, and nothing is said of minutes; of refinements, those asked for."""
    words = ["--output", str(tmp_path), "--folder", str(places / "prepared"), "--model", str(places / "egg")]
    words += ["--data", str(places / "bench"), "--sets", "scape", "--shapes", "2", "--code-steps", "1"]
    words += ["--steps", "3", "--batch", "2", "--rounds", "0", "--views", "table4"]
    assert main([*words, "--plan"]) == 0
    assert sum(row["runs"] for row in line(capsys)[1]["plan"]) == 9
    assert main([*words, "--plan", "--without", "rbf,pointwise"]) == 0
    assert [(row["field"], row["runs"]) for row in line(capsys)[1]["plan"]] == [("mls", 1)] * 3
    assert calls["train_run"] == 0
    assert main([*words, "--methods", "code"]) == 0
    out, record = line(capsys)
    assert {run["steps"] for run in record["runs"].values()} == {3} and len(record["runs"]) == 9
    assert "Budget: 3 steps of every run, batches of 2, radii in units of the template's diameter" in out
    assert {key.rsplit(" ", 1)[1] for key in record["errors"]} == {"code"}


def test_table_4_has_costs_without_training(
    places: Path, tmp_path: Path, calls: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--output", str(tmp_path / "out"), "--folder", str(places / "prepared"), "--minutes", "0"]
    words += ["--sets", "", "--rounds", "1", "--views", "table4,figure6"]
    assert main(words) == 0
    assert calls == {"train_run": 0, "errors_of": 0, "timed": 1, "memory": 9, "oriented": 0}
    out, record = line(capsys)
    assert "cost of a training iteration" in out and "errors in cm" not in out
    assert len(record["times"]) == len(record["memory"]) == 9
    assert record["figure6"] is None
    assert main([*words, "--show", "--markdown", str(tmp_path / "table.md")]) == 0
    assert calls["timed"] == 1
    written = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "\n| constraint | field | CPU ms |" in written
    assert "\n| mls: both regularisers < none |" in written
    assert line(capsys)[1]["times"] == record["times"]


def test_repeated_views_have_two_seeds(
    places: Path, tmp_path: Path, calls: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--output", str(tmp_path), "--folder", str(places / "prepared"), "--minutes", "1e-6", "--sets", ""]
    words += ["--seeds", "2", "--rounds", "0", "--views", "table5,figure6", "--repeated", "figure6"]
    assert main(words) == 0
    assert calls["train_run"] == 6 + 2
    out, record = line(capsys)
    assert "Table 5, errors in cm" in out and "±" in out
    assert "field-pointwise.constraint-none.seed-1" in record["runs"]
    assert record["figure6"]["lines"] == {"ours": LINE}
    assert any(claim["outcome"] != "not measured" for claim in record["claims"])
    assert {path.name for path in tmp_path.glob("*.png")} == {"table-5.png", "figure-6.png"}


def test_what_cannot_be_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--output", str(tmp_path), "--shapes", "1"]) == 2
    assert main(["--output", str(tmp_path), "--sets", "", "--views", "table8"]) == 1
    assert "choose from table4" in said(capsys)
