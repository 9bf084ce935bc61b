"""transfer-garment through the program's only door; the map is made by construction."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.maps.files import save_map
from meshmatch.shapes.files import load_shape, save_shape
from tests.cli.conftest import Run, refused, well
from tests.transfer.worn import bent, rod, same_numbers, sleeve

CALL = ["transfer-garment", "given/sleeve.obj", "rod.ply", "bent.ply", "--map", "map.npz"]


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A rod, the same one bent, the map, and a sleeve with its material in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    save_shape("rod.ply", rod())
    save_shape("bent.ply", replace(rod(), verts=bent(rod().verts)))
    save_map("map.npz", same_numbers(load_shape("rod.ply"), load_shape("bent.ply")))
    Path("given").mkdir()
    save_shape("given/sleeve.obj", sleeve())
    text = Path("given/sleeve.obj").read_text().replace("# meshmatch\n", "# wool\nmtllib wool.mtl\ng sleeve\n")
    Path("given/sleeve.obj").write_text(text)
    Path("given/wool.mtl").write_text("newmtl wool\nKd 1 0 0\n")
    return tmp_path


def test_a_sleeve_on_a_bent_rod(run: Run, files: Path) -> None:
    answer = well(run(*CALL, "-o", "out.obj", "--json", "--picture", "worn.png"))
    assert "wrote out.obj wool.mtl: sleeve.obj on bent.ply" in answer.err
    found = answer.record
    assert found["files"] == ["out.obj", "wool.mtl"]
    assert (found["vertices"], found["below_skin"], found["map"]) == (sleeve().V, 0, "map.npz")
    assert Path("wool.mtl").read_bytes() == Path("given/wool.mtl").read_bytes()
    assert Path("worn.png").read_bytes()[:4] == b"\x89PNG"
    lines, before = (Path(name).read_text().splitlines() for name in ("out.obj", "given/sleeve.obj"))
    assert [line for line in lines if line[:2] != "v "] == [line for line in before if line[:2] != "v "]
    error = np.linalg.norm(load_shape("out.obj").verts - bent(sleeve().verts), axis=1)
    assert error.mean() < 0.01


def test_other_formats_say_what_is_lost(run: Run, files: Path) -> None:
    assert well(run(*CALL, "-o", "out.ply", "--quiet")).err == ""  # its triangles are one group
    with Path("given/sleeve.obj").open("a") as text:
        text.write("g cuff\n")
    answer = well(run(*CALL, "-o", "out.ply", "--quiet"))
    assert answer.err == "warning: out.ply does not have the groups of sleeve.obj\n"
    assert load_shape("out.ply").F == sleeve().F


def test_what_cannot_be_is_told(run: Run, files: Path) -> None:
    far = replace(sleeve(), verts=100.0 * sleeve().verts)
    save_shape("far.obj", far)
    Path("wool.mtl").write_text("newmtl mine\n")
    before = {path.name for path in files.iterdir()}
    refused(run(*CALL, "-o", "out.obj"), "another wool.mtl is there", files, before)
    words = [word.replace("given/sleeve.obj", "far.obj") for word in CALL]
    answer = run(*words, "-o", "out.obj")
    assert answer.status == 1
    assert "error: far.obj is not on rod.ply" in answer.err
    assert {path.name for path in files.iterdir()} == before
    refused(run(*CALL, "-o", "given/sleeve.obj"), "is an input of this command", files, before)
