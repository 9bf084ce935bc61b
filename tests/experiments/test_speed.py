"""The clock of whole processes: shapes of the sizes that are asked, costs as the system counts them, a record."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments.bench import speed
from meshmatch.experiments.bench.speed import Case, cost_of, keep_to_cores, main, measure, resize, split
from meshmatch.maps.files import load_map
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
    path.write_text('{"values": {"cases": [{"case": "help", "wall": 2, "cpu": 0.5, "gigabytes": 0}]}}')
    row = speed.add_comparison(
        {"case": "help", "wall": 1.0, "cpu": 1.0, "gigabytes": 1.0}, speed.read_earlier(path)["help"]
    )
    assert (row["wall_before"], row["wall_ratio"], row["cpu_ratio"]) == (2.0, 0.5, 2.0)
    assert "gigabytes_ratio" not in row
    path.write_text("[]")
    with pytest.raises(InputError, match="holds no run"):
        speed.read_earlier(path)


def test_the_numbers_of_the_last_release_are_of_cases_that_are_still_run() -> None:
    kept = speed.read_earlier(Path(__file__).parents[2] / "docs" / "results" / "speed.json")
    assert "pair" in kept and set(kept) <= set(speed.CASES)


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
    assert resize(sphere, 642) is sphere
    assert resize(sphere, 600) is sphere  # near enough
    assert 300 <= resize(sphere, 320).V <= 340
    finer = resize(sphere, 2000)
    assert 1900 <= finer.V <= 2200 and finer.area == pytest.approx(sphere.area, rel=0.01)
    assert not repair(resize(sphere, 2000)).notes


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
from meshmatch.experiments.bench.speed import cost_of
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
    with pytest.raises(MeshmatchError, match="no message"):
        cost_of(python("raise SystemExit(1)"))


def test_the_first_run_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def counted(command: list[str]) -> speed.Cost:
        commands.append(command)
        return speed.Cost(len(commands), 0.0, 0.0)

    monkeypatch.setattr(speed, "cost_of", counted)
    monkeypatch.setattr(speed, "file_of", lambda word, folder: folder / word.replace("@", "-"))
    case = Case(("match", "climber@500", "dancer@400", "-o", "@map.npy"), 1.0)
    assert [cost.wall for cost in measure(case, 3, tmp_path)] == [2, 3, 4]
    wanted = ["match", tmp_path / "climber-500", tmp_path / "dancer-400", "-o", tmp_path / "map.npy"]
    assert commands[0] == [sys.executable, "-m", "meshmatch", *map(str, wanted)]


def test_maps_and_truths_are_made_once(tmp_path: Path) -> None:
    known = speed.file_of("dancer@5000~dancer@4000", tmp_path)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".npy", ".npz", ".ply", ".ply"]
    source, target = (load_shape(speed.file_of(word, tmp_path)) for word in ("dancer@5000", "dancer@4000"))
    found = load_map(speed.file_of("dancer@5000>dancer@4000", tmp_path), source, target)
    off = np.linalg.norm(target.verts[np.load(known)] - target.verts[found.index], axis=1) / np.sqrt(target.area)
    assert 0.005 < off.mean() < 0.06
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system keeps nobody on a core")
def test_processes_are_kept_on_few_cores() -> None:
    assert keep_to_cores(1) == 1
    assert len(os.sched_getaffinity(0)) == 1
    seen = python("import os, sys; sys.exit(len(os.sched_getaffinity(0)) != 1)")
    cost_of(seen)


def test_a_case_that_breaks_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(speed, "CASES", {"broken": Case(("dance",), 1.0)})
    assert main(["--cases", "broken", "--runs", "1"]) == 1
    assert "ended with 2" in " ".join(capsys.readouterr().err.split())
