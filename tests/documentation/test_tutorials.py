"""The tutorials run from end to end, as they stand, and their pictures show something."""

import csv
import importlib
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch.distributed as dist
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from meshmatch.cli import main
from meshmatch.experiments.makers import bones
from meshmatch.maps.files import load_map
from meshmatch.models.card import read_card
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_add_skeleton import with_skeleton
from meshmatch.shapes.formats.gltf_rig import Binding, Clip, Rig, Track
from meshmatch.shapes.landmark_files import read_landmark_file
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from tests.fitting.small_viscous import use_small_fits
from tests.shapes.painted import quarters
from tests.transfer.rigs import posed_verts

ROOT = Path(__file__).resolve().parents[2]
WRITTEN = {
    "artist": {"before.png", "map.npz", "dressed.glb", "dressed.png", "confidence.png", "check.glb"},
    "anatomist": {"fits"},
    "researcher": {"map.npz"},
}


def script(page: str, language: str) -> str:
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    return "".join(re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))


def run(words: list[str], source: str, folder: Path) -> str:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        words, input=source, cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def write_hero(folder: Path) -> None:
    """A small dancer with a picture, a skeleton of three joints and a clip; a shirt on it; and a small climber."""
    body = decimate(load_shape(ROOT / "templates" / "samples" / "dancer.ply"), 1500)
    low, high = body.bounds
    x, y = ((body.verts[:, k] - low[k]) / (high[k] - low[k]) for k in (0, 1))
    uv = np.stack([x, 1 - y], axis=1)[body.faces]
    plain = folder / "plain.glb"
    save_textured(plain, TexturedMesh(body.verts, body.faces, uv), quarters(64))
    above = np.clip(5 * y - 1.5, 0, 1)  # the hips
    weights = np.stack([above, 1 - above], axis=1).astype(np.float32)
    turns = Rotation.from_rotvec(np.sin(np.linspace(0, 2 * np.pi, 9))[:, None] * [0.0, 1, 0]).as_quat()
    clip = Clip("walk", (Track(2, "rotation", np.linspace(0, 1, 9), turns, "LINEAR"),))
    hips = np.array([(low + high)[0] / 2, low[1] + 0.4 * (high - low)[1], (low + high)[2] / 2])
    places = np.array([[0.0, 0, 0], hips, [0, 0, 0]])
    still = np.tile([0.0, 0, 0, 1], (3, 1))
    names, parents = ("root", "hips", "chest"), np.array([-1, 0, 1])
    rig = Rig(names, parents, np.array([1, 2]), still, places, np.ones((3, 3)), (clip,))
    document = Document(plain, plain.read_bytes())
    seen = cKDTree(body.verts).query(load_shape(plain).verts)[1]
    joints = np.where(weights[seen] > 0, [1, 0], 0).astype(np.int32)
    binding = Binding(rig, rig.worlds(), joints, weights[seen])
    (folder / "hero.glb").write_bytes(with_skeleton(document, binding)[0])
    plain.unlink()
    upper = ((y > 0.5) & (y < 0.8) & (np.abs(x - 0.5) < 0.2))[body.faces].all(axis=1)
    used, faces = np.unique(body.faces[upper], return_inverse=True)
    shirt = Shape(body.verts[used] + 0.01 * np.ptp(y) * body.vertex_normals[used], faces.reshape(-1, 3))
    save_shape(folder / "jacket.obj", shirt)
    text = (folder / "jacket.obj").read_text()
    (folder / "jacket.obj").write_text(f"mtllib jacket.mtl\nusemtl wool\n{text}")
    (folder / "jacket.mtl").write_text("newmtl wool\nKd 0.5 0 0\n")
    save_shape(folder / "body.ply", decimate(load_shape(ROOT / "templates" / "samples" / "climber.ply"), 1500))


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
def test_two_files_become_a_walking_textured_dressed_character(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In at most eight commands; what each of them writes is what the page says."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("meshmatch.render.picture.HEIGHT", 160)
    write_hero(tmp_path)
    section = (ROOT / "docs" / "artist.md").read_text(encoding="utf-8").split("## 6. A walking")[1].split("\n## ")[0]
    block = re.search(r"^```text\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    assert block is not None
    commands = block[1].splitlines()
    assert 0 < len(commands) <= 8
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0, command
    body = load_shape("body.ply")
    assert load_map("map.npz", "hero.glb", body).verdict != "poor"
    for name in ("walking", "textured", "character"):
        path = tmp_path / f"{name}.glb"
        there = load_shape(path)
        before, after = posed_verts(path), posed_verts(path, "walk", 0.25)
        heights = there.verts[:, 1] - there.verts[:, 1].min()
        upper = heights > 0.7 * heights.max()
        assert np.linalg.norm(after - before, axis=1)[upper].mean() > 0.05 * heights.max(), name
        assert np.ptp(there.verts[:, 1]) == pytest.approx(np.ptp(body.verts[:, 2]), rel=1e-3)  # it stands along y
    pixels = np.asarray(load_appearance("textured.glb", load_shape("textured.glb")).materials[0].image)
    colors, many = np.unique(pixels.reshape(-1, 4) // 128, axis=0, return_counts=True)
    assert (many > 0.02 * len(pixels) ** 2).sum() >= 4, colors  # all four quarters of the picture
    document = Document(tmp_path / "character.glb", (tmp_path / "character.glb").read_bytes())
    worn = [node for node in document.nodes if "mesh" in node]
    assert [node.get("name") for node in worn] == ["body", "jacket"]
    first, second = (document.json["skins"][node["skin"]]["joints"] for node in worn)
    assert first == second
    skin, jacket = load_shape("textured.glb"), load_shape("character.glb").verts[load_shape("textured.glb").V :]
    away = cKDTree(skin.verts).query(jacket)[0] / np.sqrt(skin.area)
    assert len(jacket) > 50 and away.max() < 0.1
    assert Path("character.png").stat().st_size > 1000


@pytest.fixture
def small_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    use_small_fits(monkeypatch)


def check_by_r(folder: Path) -> None:
    """What the page has R alone read is what was written."""
    page = (ROOT / "docs" / "anatomist.md").read_text(encoding="utf-8")
    alone = re.search(r"^```r\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert alone is not None and "library(" not in alone[1]
    told = "cat(dim(coords), coords[1, 2, 2], dim(landmarks), landmarks[7, 3, 2], names(effects)[2], sep = '\\n')"
    *_, effect = lines = run(["Rscript", "-"], f"{alone[1]}\n{told}\n", folder).splitlines()[-9:]
    with open(folder / "tables" / "coords.csv", encoding="utf-8", newline="") as file:
        names, *rows = csv.reader(file)
    last = read_landmark_file(folder / "landmarks" / "bone-02.mrk.json", "bone-02", "LPS").places[6]
    known = [(len(names) - 1) / 3, 3, 5, float(rows[1][2]), 7, 3, 5, last.where[2]]
    assert [float(each) for each in lines[:-1]] == pytest.approx(known, rel=1e-4)
    assert effect == "log(size), x"


@pytest.mark.filterwarnings("ignore::meshmatch.errors.MeshmatchWarning")
def test_a_folder_of_bones_becomes_landmarks_statistics_and_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_fits: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """In at most ten commands. Bones are drawn with their truth."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("meshmatch.render.picture.HEIGHT", 120)
    page = (ROOT / "docs" / "anatomist.md").read_text(encoding="utf-8")
    block = re.search(r"^```text\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert block is not None
    first, *commands = block[1].splitlines()
    assert len(commands) < 10
    few = first.replace("--count 20", "--count 5").replace("--vertices 3000", "--vertices 400")
    assert bones.main(shlex.split(few)[3:]) == 0 and few != first
    quick = {"fit": ["--jobs", "1"], "atlas": ["--no-measures", "--permutations", "99"]}
    for command in commands:
        words = shlex.split(command)[1:]
        assert main([*words, *quick.get(words[0], [])]) == 0, command
    assert "surfaces lie 0." in capsys.readouterr().err
    with open("fits/fits.csv", encoding="utf-8", newline="") as file:
        fits = {row["name"]: row for row in csv.DictReader(file)}
    with open("bones/table.csv", encoding="utf-8", newline="") as file:
        known = {row["name"]: row for row in csv.DictReader(file)}
    for name, row in fits.items():
        assert row["verdict"] in ("good", "fair") and float(row["distance"]) < 0.5
        assert (row["mirrored"] == "1") == (known[name]["side"] == "left")
        if name == "bone-01":  # from which the landmarks are
            continue
        found, truth = (
            np.array([place.where for place in read_landmark_file(Path(folder, name + suffix), name, "LPS").places])
            for folder, suffix in (("landmarks", ".mrk.json"), ("bones/landmarks", ".csv"))
        )
        assert np.linalg.norm(found - truth, axis=1).mean() < 6.0  # of 100
    terms = Path("atlas/anova.csv").read_text(encoding="utf-8")
    assert "log(size)" in terms and "group" in terms
    assert {"mean.png", "landmarks.tps"} <= {path.name for path in tmp_path.iterdir()}
    tables = [path.name for path in Path("tables").iterdir()]
    assert {"coords.csv", "metadata.csv"} == set(tables)
    if shutil.which("Rscript") is not None:
        check_by_r(tmp_path)
    if importlib.util.find_spec("vtkmodules") is None:
        return
    vtk = importlib.import_module("vtkmodules.vtkIOXML")
    for path, array in (("meshes/bone-01.vtp", None), ("originals/bone-02.vtp", "distance_to_mean")):
        reader = vtk.vtkXMLPolyDataReader()
        reader.SetFileName(path)
        reader.Update()
        read = reader.GetOutput()
        assert read.GetNumberOfPolys() > 300
        assert array is None or read.GetPointData().GetArray(array).GetNumberOfTuples() == read.GetNumberOfPoints()


@pytest.mark.parametrize("page", ["fields", "training"])
def test_the_code_of_a_page_runs(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, remembered_fits: Any
) -> None:
    (tmp_path / "templates").symlink_to(ROOT / "templates")
    monkeypatch.chdir(tmp_path)
    exec(compile(script(page, "python"), f"{page}.md", "exec"), {"__name__": "__main__"})


FORKED = """
import os, runpy, shlex, socket, sys
import torch._dynamo, torch.distributed.run
import meshmatch.training.train  # which all processes then have
for line in sys.stdin:
    chosen = torch.distributed.run.get_args_parser().parse_args(shlex.split(line)[1:])
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    count, processes = int(chosen.nproc_per_node), []
    for rank in range(count):
        processes.append(os.fork())
        if not processes[-1]:
            os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(count)}
            os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
            sys.argv = [chosen.training_script, *chosen.training_script_args]
            runpy.run_path(sys.argv[0], run_name="__main__")
            os._exit(0)
    assert [os.waitpid(each, 0)[1] for each in processes] == [0] * count
"""
"""As torchrun, for lines of it, but each process does not import torch again."""


@pytest.mark.skipif(not dist.is_gloo_available() or not hasattr(os, "fork"), reason="this torch has no gloo")
def test_the_training_by_two_processes_goes_on_exactly(tmp_path: Path) -> None:
    (tmp_path / "two.py").write_text(script("training", 'python title="two.py"'), encoding="utf-8")
    first, *others = script("training", 'bash title="terminal"').splitlines()
    program, *words = shlex.split(first)
    run([sys.executable, "-m", "torch.distributed.run", "--standalone", *words], "", tmp_path)
    stopped = read_card(tmp_path / "stopped" / "card.json")
    run([sys.executable, "-c", FORKED], "\n".join(others), tmp_path)
    whole = [read_card(tmp_path / name / "card.json") for name in ("stopped", "unbroken")]
    assert {line.split()[0] for line in others} == {program} == {"torchrun"}
    assert [card.steps for card in (stopped, *whole)] == [1, 3, 3]
    assert stopped.weights_sha256 != whole[0].weights_sha256 == whole[1].weights_sha256


@pytest.mark.slow
@pytest.mark.parametrize("page", WRITTEN)
def test_a_tutorial_runs_from_end_to_end(page: str, tmp_path: Path) -> None:
    (tmp_path / "templates").symlink_to(ROOT / "templates")
    run(["bash", "-e"], script(page, "bash"), tmp_path)
    run([sys.executable, "-W", "error", "-"], script(page, "python"), tmp_path)
    assert WRITTEN[page] <= {path.name for path in tmp_path.iterdir()}
    for picture in tmp_path.glob("*.png"):
        pixels = np.asarray(Image.open(picture).convert("RGB"))
        drawn = (np.abs(pixels.astype(int) - pixels[0, 0]).max(axis=2) > 40).mean(axis=0) > 0.02
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 500
        assert drawn[: len(drawn) // 2].any()  # both shapes are there
        assert drawn[len(drawn) // 2 :].any()
