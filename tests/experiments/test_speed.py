"""The clock of whole processes: shapes of the sizes that are asked, costs as the system counts them, a record."""

import inspect
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments import roofline, speed, stages
from meshmatch.experiments.speed import Case, cost_of, keep_to_cores, main, measure, shape_file, sized, split
from meshmatch.experiments.stages import STAGES, Clock, place_of, watched
from meshmatch.fitting import refinement
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape


@pytest.fixture(autouse=True)
def cores() -> Iterator[None]:
    """A run keeps its process on few cores for good; the tests after it get theirs back."""
    before = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else None
    yield
    if before is not None:
        os.sched_setaffinity(0, before)


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def test_an_earlier_run_stands_beside_this_one(tmp_path: Path) -> None:
    path = tmp_path / "before.json"
    path.write_text('a table\n{"cases": [{"case": "help", "wall": 2, "cpu": 0.5, "gigabytes": 0}]}\n')
    row = speed.compared({"case": "help", "wall": 1.0, "cpu": 1.0, "gigabytes": 1.0}, speed.earlier(path)["help"])
    assert (row["wall_before"], row["wall_ratio"], row["cpu_ratio"]) == (2.0, 0.5, 2.0)
    assert "gigabytes_ratio" not in row
    path.write_text("[]")
    with pytest.raises(InputError, match="holds no run"):
        speed.earlier(path)


def test_the_numbers_of_the_last_release_are_of_all_cases() -> None:
    assert list(speed.earlier(Path(__file__).parents[2] / "docs" / "results" / "speed.json")) == list(speed.CASES)


def test_a_triangle_in_four() -> None:
    one = split(Shape(np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]]), np.array([[0, 1, 2]])))
    assert one.verts[3:].tolist() == [[1, 0, 0], [0, 1, 0], [1, 1, 0]]
    assert one.face_areas.tolist() == [0.5] * 4
    normals = np.cross(*(one.verts[one.faces[:, k]] - one.verts[one.faces[:, 0]] for k in (1, 2)))
    assert normals.tolist() == [[0, 0, 1]] * 4


def test_a_split_surface_is_the_same_surface(torus: Shape) -> None:
    finer = split(torus)
    assert (finer.V, finer.F) == (torus.V + 3 * torus.F // 2, 4 * torus.F)  # a closed one: an edge for 2/3 of a face
    assert finer.area == pytest.approx(torus.area)
    assert np.array_equal(finer.verts[: torus.V], torus.verts)
    assert not repair(finer).notes


def test_shapes_come_in_the_size_that_is_asked(sphere: Shape) -> None:
    assert sized(sphere, 642) is sphere
    assert sized(sphere, 600) is sphere  # near enough
    assert 300 <= sized(sphere, 320).V <= 340
    assert 1900 <= sized(sphere, 2000).V <= 2200
    assert not repair(sized(sphere, 2000)).notes


def test_the_file_of_a_sample_is_made_once(tmp_path: Path) -> None:
    path = shape_file("climber@900", tmp_path)
    assert 850 <= load_shape(path).V <= 990
    before = path.stat().st_mtime_ns
    assert shape_file("climber@900", tmp_path) == path
    assert path.stat().st_mtime_ns == before


def test_a_sample_that_is_not_there(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(MeshmatchError, match="could not make nobody@900"):
        shape_file("nobody@900", tmp_path)


def test_samples_are_changed_as_a_case_asks(sphere: Shape) -> None:
    cloud = speed.noisy(sphere)
    assert cloud.is_cloud
    assert np.std(cloud.verts - sphere.verts) == pytest.approx(0.01 * sphere.diagonal, rel=0.05)
    half = speed.upper_half(sphere)
    middle = 0.5 * (sphere.verts[:, 1].min() + sphere.verts[:, 1].max())
    assert half.verts[:, 1].min() > middle
    assert 0.35 * sphere.F < half.F < 0.5 * sphere.F
    assert not repair(half).notes or half.V < sphere.V / 2


def test_costs_are_those_of_the_process() -> None:
    """Measured from a process of its own: this one is large by now, and what it holds would count."""
    work = "import time; x = b'1' * 500_000_000; end = time.process_time() + 0.3"
    burn = f"{work}\nwhile time.process_time() < end: pass"
    code = f"""
import json, sys
from dataclasses import asdict
from meshmatch.experiments.speed import cost_of
costs = [cost_of([sys.executable, "-c", code]) for code in ("pass", {burn!r})]
print(json.dumps([asdict(cost) for cost in costs]))
"""
    done = subprocess.run(python(code), capture_output=True, text=True, check=True)
    small, large = json.loads(done.stdout)
    assert 0 < small["wall"]
    assert small["gigabytes"] < 0.5 < large["gigabytes"] < 0.6
    assert large["cpu"] >= 0.3


def test_a_process_that_fails_is_told_with_its_last_words() -> None:
    with pytest.raises(MeshmatchError, match="ended with 3: no such luck"):
        cost_of(python("import sys; print('first\\nno such luck', file=sys.stderr); sys.exit(3)"))
    with pytest.raises(MeshmatchError, match="it said nothing"):
        cost_of(python("raise SystemExit(1)"))


def test_the_first_run_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def counted(command: list[str]) -> speed.Cost:
        commands.append(command)
        return speed.Cost(len(commands), 0.0, 0.0)

    monkeypatch.setattr(speed, "cost_of", counted)
    monkeypatch.setattr(speed, "shape_file", lambda word, folder: folder / word.replace("@", "-"))
    case = Case(("match", "climber@500", "dancer@400", "-o", "@map"), 1.0)
    assert [cost.wall for cost in measure(case, 3, tmp_path)] == [2, 3, 4]
    wanted = ["match", tmp_path / "climber-500", tmp_path / "dancer-400", "-o", tmp_path / "map.npy"]
    assert commands[0] == [sys.executable, "-m", "meshmatch", *map(str, wanted)]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system keeps nobody on a core")
def test_processes_are_kept_on_few_cores() -> None:
    assert keep_to_cores(1) == 1
    assert len(os.sched_getaffinity(0)) == 1
    seen = python("import os, sys; sys.exit(len(os.sched_getaffinity(0)) != 1)")
    cost_of(seen)


def test_the_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    met = Case(("--help",), 1e6, 1e3)
    missed = Case(("info", "climber@300"), 1e-6)
    monkeypatch.setattr(speed, "CASES", {"easy": met, "hard": missed})
    assert main(["--cases", "easy,hard", "--runs", "1", "--cores", "1"]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    record = json.loads(lines[-1])
    assert {"date", "commit", "machine", "threads"} <= set(record)
    easy, hard = record["cases"]
    assert (easy["met"], hard["met"]) == (True, False)
    assert (easy["bar_gigabytes"], hard["bar_gigabytes"]) == (1e3, None)
    assert len(easy["runs"]) == 1
    assert easy["runs"][0][0] == easy["wall"] > 0
    table = "\n".join(lines[:-1])
    assert all(word in table for word in ("easy", "hard", "True", "False"))


def test_a_case_that_breaks_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(speed, "CASES", {"broken": Case(("dance",), 1.0)})
    assert main(["--cases", "broken", "--runs", "1"]) == 1
    assert "ended with 2" in " ".join(capsys.readouterr().err.split())


def test_every_stage_is_a_function() -> None:
    for _, module, name in STAGES:
        place, last = place_of(module, name)
        assert inspect.isfunction(vars(place)[last]), f"{module}.{name}"


def test_a_stage_does_not_count_what_another_one_does() -> None:
    clock = Clock()

    def burn(seconds: float) -> None:
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    inner = clock.timed("inner", burn)

    def both() -> None:
        burn(0.02)
        inner(0.05)

    began = time.process_time()
    clock.timed("outer", both)()
    passed = time.process_time() - began
    assert clock.calls == {"outer": 1, "inner": 1}
    assert clock.seconds["inner"] == pytest.approx(0.05, abs=0.01)
    assert clock.seconds["outer"] == pytest.approx(0.02, abs=0.01)
    assert clock.total - clock.seconds["other"] == pytest.approx(passed, abs=0.005)


def test_watched_functions_are_theirs_again() -> None:
    known = [vars(module) for name, module in sys.modules.items() if name.split(".")[0] == "meshmatch"]
    before = [dict(names) for names in known]
    original = [vars(place_of(module, name)[0])[name.split(".")[-1]] for _, module, name in STAGES]
    with pytest.raises(KeyError), watched():
        assert refinement.two_way_residual is not before[known.index(vars(refinement))]["two_way_residual"]
        raise KeyError
    assert [vars(place_of(module, name)[0])[name.split(".")[-1]] for _, module, name in STAGES] == original
    assert all(names[key] is value for names, old in zip(known, before, strict=True) for key, value in old.items())


def test_the_stages_of_a_match(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = Case(("match", "climber@900", "dancer@900", "-o", "@map"), 1.0)
    monkeypatch.setattr(speed, "CASES", {"pair": small})
    picture = tmp_path / "stages.svg"
    assert main(["--profile", "--runs", "1", "--picture", str(picture)]) == 0
    record = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    rows = {row["stage"]: row for row in record["stages"]}
    assert list(rows) == ["import", *dict.fromkeys(stage for stage, _, _ in STAGES), "other"]
    assert sum(row["cpu"] for row in rows.values()) == pytest.approx(record["total"])
    assert sum(row["share"] for row in rows.values()) == pytest.approx(1)
    assert record["total"] == pytest.approx(record["runs"][0] + record["imports"][0])
    assert all(row["cpu"] > 0 and row["calls"] for name, row in rows.items() if name not in ("import", "other"))
    assert rows["other"]["share"] < 0.25
    assert "Gauss-Newton, solve" in picture.read_text()


def test_a_picture_is_of_stages(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--picture", "stages.png"]) == 1
    assert main(["--profile", "--picture", "stages.doc"]) == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "add --profile" in told
    assert "stages.doc: unsupported chart format" in told


def test_a_match_imports_nothing_else(tmp_path: Path) -> None:
    """No library is loaded later than in the row ``import``."""

    def packages(code: str) -> set[str]:
        told = subprocess.run(
            python(f"{code}\nimport sys; print(*sys.modules)"), capture_output=True, text=True, check=True
        )
        names = {name.split(".")[0] for name in told.stdout.splitlines()[-1].split()}
        return names - set(sys.stdlib_module_names)

    paths = [str(shape_file(word, tmp_path)) for word in ("climber@900", "dancer@900")]
    words = ["match", *paths, "-o", str(tmp_path / "map.npy"), "--quiet"]
    run = f"from meshmatch.cli import main\nassert main({words!r}) == 0"
    assert packages(run) <= packages(stages.IMPORTS)


def test_the_machine_and_its_bounds(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(roofline, "_PRODUCT", 200)
    monkeypatch.setattr(roofline, "_COPY", 1 << 20)
    assert main(["--roofline", "--runs", "1"]) == 0
    record = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    many, one, *rest = record["kernels"]
    assert many["mflop"] == pytest.approx(24 * one["mflop"])
    assert many["megabytes"] < 1.1 * one["megabytes"]
    assert all(row["share"] > 0 and row["limit"] in ("product", "copy") for row in (many, one, *rest))


def test_every_bar_of_the_house_is_a_case() -> None:
    for name, case in speed.CASES.items():
        assert case.seconds > 0, name
        assert all(word.split("@")[0] in ("climber", "dancer") for word in case.words if "@" in word[1:])
