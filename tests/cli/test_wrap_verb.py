"""wrap through the program's only door; the match is made up."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import pdist

from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import FakeMatching, Run, refused, well
from tests.transfer.worn import rod, tube


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stub: FakeMatching) -> Path:
    """A rod with groups in its file, and a thicker one to wrap it onto."""
    monkeypatch.chdir(tmp_path)
    save_shape("base.obj", rod())
    Path("base.obj").write_text(Path("base.obj").read_text().replace("# meshmatch\n", "# mine\ng rod\n"))
    fine = tube(0.21, 2.0, 48, 81, "scan", closed=True)
    save_shape("scan.ply", fine)
    return tmp_path


def test_the_text_stays_and_the_distance_is_printed(run: Run, files: Path) -> None:
    answer = well(run("wrap", "base.obj", "scan.ply", "-o", "out.obj", "--json", "--picture", "p.png"))
    record = answer.record
    assert set(record["vertices_to_surface"]) == {"mean", "95 %", "worst"}
    assert record["vertices_to_surface"]["95 %"] < 0.003
    assert (record["files"], record["free"], record["vertices"]) == (["out.obj"], 0, rod().V)
    assert "vertices to scan.ply (whose sqrt(area) is" in answer.err
    assert "\nsurfaces lie " in answer.err and record["distance"]["unit"] == "file"
    assert 0 < record["distance"]["mean"] < 0.01
    lines, before = (Path(name).read_text().splitlines() for name in ("out.obj", "base.obj"))
    assert [line for line in lines if line[:2] != "v "] == [line for line in before if line[:2] != "v "]
    radius = np.linalg.norm(load_shape("out.obj").verts[:-2, [0, 2]], axis=1)
    assert np.quantile(np.abs(radius - 0.21), 0.9) < 0.003
    assert Path("p.png").is_file()


def test_the_images_of_a_ply_come_along(run: Run, files: Path) -> None:
    save_shape("base.ply", rod())
    named = b"comment TextureFile maps\\My Skin.png\ncomment TextureFile gone.png\nelement vertex"
    Path("base.ply").write_bytes(Path("base.ply").read_bytes().replace(b"element vertex", named, 1))
    for folder in ("maps", "out"):
        Path(folder).mkdir()
    Path("maps/my skin.png").write_bytes(b"an image")
    answer = well(run("wrap", "base.ply", "scan.ply", "-o", "out/base.ply", "--json"))
    assert answer.record["files"] == ["out/base.ply", "out/maps/my skin.png"]
    assert "warning: base.ply names gone.png, which is not there: not copied\n" in answer.err
    assert Path("out/maps/my skin.png").read_bytes() == b"an image"
    assert named in Path("out/base.ply").read_bytes()


def test_faces_may_run_the_other_way(run: Run, files: Path) -> None:
    """As those of a node of negative scale do: what faces as a vertex does is there all the same."""
    shape = rod()
    save_shape("base.obj", Shape(shape.verts, shape.faces[:, ::-1]))
    answer = well(run("wrap", "base.obj", "scan.ply", "-o", "out.obj", "--json"))
    assert answer.record["vertices_to_surface"]["95 %"] < 0.003


@pytest.mark.parametrize(
    ("name", "text"), [("free.txt", "500\n501\n"), ("free.json", json.dumps({"eyes": [500], "mouth": [501]}))]
)
def test_free_vertices_by_number_or_part(run: Run, files: Path, name: str, text: str) -> None:
    Path(name).write_text(text)
    answer = well(run("wrap", "base.obj", "scan.ply", "-o", "out.obj", "--free", name, "--json"))
    assert answer.record["free"] == 2
    assert "2 vertices kept their shape" in answer.err


def test_what_is_left_out_keeps_its_shape(run: Run, files: Path) -> None:
    """A blade beside the rod, a part of the file, is no part of the scan: it is carried along."""
    body, blade = rod(), trimesh.creation.box((0.02, 0.4, 0.02)).subdivide()
    verts = np.concatenate([body.verts, np.add(blade.vertices, [0.3, 0.0, 0.0])])
    save_shape("base.ply", Shape(verts, np.concatenate([body.faces, blade.faces + body.V])))
    answer = well(run("wrap", "base.ply", "scan.ply", "-o", "out.ply", "--without", "2", "--json"))
    assert json.loads(answer.out)["free"] == len(blade.vertices)
    before, after = (pdist(each[body.V :]) for each in (verts, load_shape("out.ply").verts))
    assert np.ptp(after / before) < 1e-4


def test_what_cannot_be_is_told(run: Run, files: Path, stub: FakeMatching) -> None:
    Path("free.txt").write_text("99999\n")
    save_shape("cloud.ply", replace(rod(), faces=np.empty((0, 3), np.int64)))
    before = {path.name for path in files.iterdir()}
    answer = run("wrap", "base.obj", "scan.ply", "-o", "out.obj", "--free", "free.txt")
    assert (answer.status, stub.called) == (1, {})
    assert "base.obj has vertices 0 to 985" in answer.err
    refused(run("wrap", "cloud.ply", "scan.ply", "-o", "out.obj"), "only a mesh can be wrapped", files, before)
    refused(run("wrap", "base.obj", "scan.ply", "-o", "base.obj"), "is an input of this command", files, before)
    refused(run("wrap", "base.obj", "scan.ply", "-o", "out.pcd"), "out.pcd", files, before)
