"""A real Dask scheduler with two worker processes on the loopback, one of which is killed."""

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import meshmatch
from meshmatch.errors import OptionError
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape

pytest.importorskip("distributed")
SAMPLES = Path(__file__).parents[2] / "templates" / "samples"
ROOT = Path(__file__).parents[2]


class Scheduler:
    """Processes as docs/cluster.md starts them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        self.address = ""

    def start(self, *words: str) -> subprocess.Popen[bytes]:
        log = self.folder / f"{len(self.processes)}.log"
        with log.open("wb") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "distributed.cli.dask_" + words[0], *words[1:]],
                stdout=file,
                stderr=file,
                cwd=self.folder,
                env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"},
            )
        self.processes.append(process)
        return process

    def wait_for(self, pattern: str, number: int) -> str:
        log = self.folder / f"{number}.log"
        for _ in range(600):
            found = re.search(pattern, log.read_text(errors="replace"))
            if found:
                return found[1]
            assert self.processes[number].poll() is None, log.read_text(errors="replace")
            time.sleep(0.1)
        raise AssertionError(log.read_text(errors="replace"))


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[Scheduler]:
    folder = tmp_path / "dask"
    folder.mkdir()
    found = Scheduler(folder)
    try:
        found.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        found.address = found.wait_for(r"Scheduler at:\s+(tcp://[\d.:]+)", 0)
        for number in (1, 2):
            found.start("worker", found.address, "--nthreads", "1", "--no-dashboard", "--no-nanny")
            found.wait_for(r"(Registered to)", number)
        yield found
    finally:
        for process in found.processes:
            process.kill()
            process.wait()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "fits").glob("*.safetensors"))}


def test_a_cluster_of_which_one_worker_is_killed(scheduler: Scheduler, tmp_path: Path) -> None:
    shapes = tmp_path / "shapes"
    shapes.mkdir()
    dancer = load_shape(SAMPLES / "dancer.ply")
    for number in range(3):
        save_shape(shapes / f"dancer-{number}.ply", Shape((number + 1) * dancer.verts, dancer.faces))
    shutil.copy(SAMPLES / "climber.ply", shapes)
    killed = []

    def kill_one(record: object) -> None:
        if not killed:
            scheduler.processes[1].kill()
            killed.append(record)

    far = meshmatch.Collection(tmp_path / "far", workers=scheduler.address)
    quick = meshmatch.FitConfig(refine="none", copies=16, careful=1)
    made = far.fit(shapes, model="human", config=quick, tell=kill_one)
    assert killed and all(record.fitted for record in made.records)
    here = meshmatch.Collection(tmp_path / "here", workers=1)
    here.fit(shapes, model="human", config=quick)
    assert contents(tmp_path / "far") == contents(tmp_path / "here")
    assert far.save_maps(tmp_path / "maps") == 12


def test_nobody_at_the_address(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("meshmatch.collections.workers._CONNECT_TIMEOUT", 0.5)
    with pytest.raises(OptionError, match="no Dask scheduler answers"):
        meshmatch.Collection(tmp_path / "fits", workers="tcp://127.0.0.1:9").fit(SAMPLES / "dancer.ply", model="human")


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("nonsense", "no address of"),
        ("tcp://127.0.0.1", "no address of"),
        ("http://127.0.0.1:8786", "no address of"),
        ("tcp://name.invalid:8786", "no machine at"),
    ],
)
def test_what_is_no_address_is_told_at_once(
    address: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("distributed.Client", None)  # which would ask for long
    with pytest.raises(OptionError, match=words):
        meshmatch.Collection(tmp_path / "fits", workers=address).fit(SAMPLES / "dancer.ply", model="human")
