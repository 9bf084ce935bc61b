"""What users get wrong: one line that says what, a hint, status 1, nothing half-written.

Everything here fails before the first fit, which is made to fail the test if it begins.
"""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.cli.conftest import Run, refused


@pytest.fixture(autouse=True)
def home(no_fit: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MESHMATCH_HOME", str(tmp_path.parent / f"{tmp_path.name}-home"))


def write_text(path: Path, text: str) -> None:
    path.write_text(text)


def truncated_ply(path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 100\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(head.encode() + struct.pack("<30f", *range(30)))


def all_nan(path: Path) -> None:
    write_text(path, "v nan nan nan\n" * 3 + "f 1 2 3\n")


def nan_cloud(path: Path) -> None:
    np.save(path, np.full((500, 3), np.nan))


def one_triangle(path: Path) -> None:
    save_shape(path, Shape(np.eye(3), np.array([[0, 1, 2]]), "one"))


def flat_faces(path: Path) -> None:
    save_shape(path, Shape(np.eye(3), np.array([[0, 1, 1], [2, 2, 2]]), "flat"))


def few_points(path: Path) -> None:
    np.save(path, np.random.default_rng(0).normal(size=(20, 3)))


# name of the file, how it is made (None: not at all), a word of the message that names the trouble
BAD_FILES = {
    "missing": ("bad.ply", None, "there is no file"),
    "0 bytes": ("bad.ply", lambda path: path.write_bytes(b""), "0 bytes"),
    "not a mesh": ("bad.ply", lambda path: write_text(path, "Dear Sir or Madam,\n"), "is not a ply file"),
    "a picture called obj": ("bad.obj", lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0"), "is not an obj file"),
    "unknown kind": ("bad.docx", lambda path: write_text(path, "x"), "unsupported file format"),
    "no suffix": ("bad", lambda path: write_text(path, "x"), "no suffix"),
    "truncated ply": ("bad.ply", truncated_ply, "fewer vertex rows than the 100"),
    "truncated glb": ("bad.glb", lambda path: path.write_bytes(b"glTF\2\0\0\0\xff\0\0\0"), "is only 12"),
    "no vertices": ("bad.off", lambda path: write_text(path, "OFF\n0 0 0\n"), "no vertices"),
    "face of a missing vertex": (
        "bad.obj",
        lambda path: write_text(path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        "refers to vertex 9",
    ),
    "all NaN": ("bad.obj", all_nan, "no vertex has a usable position"),
    "a cloud of NaN": ("bad.npy", nan_cloud, "no vertex has a usable position"),
    "one triangle": ("bad.ply", one_triangle, "only 1 usable triangle"),
    "no face with area": ("bad.ply", flat_faces, "no face with any area"),
    "few points": ("bad.npy", few_points, "only 20 distinct point positions"),
    "a folder": ("bad.ply", lambda path: path.mkdir(), "is a folder"),
    "a map for a cloud": ("bad.npy", lambda path: np.save(path, np.arange(9)), "bad.npy"),
}


@pytest.mark.parametrize("side", ["source", "target", "register"])
@pytest.mark.parametrize("kind", BAD_FILES)
def test_bad_files(run: Run, two: tuple[Path, Path], tmp_path: Path, kind: str, side: str) -> None:
    name, make, told = BAD_FILES[kind]
    bad = tmp_path / name
    if make is not None:
        make(bad)
    before = set(os.listdir(tmp_path))
    words = {
        "source": ("match", bad, two[1], "-o", tmp_path / "map.npy"),
        "target": ("match", two[0], bad, "-o", tmp_path / "map.npy"),
        "register": ("register", bad, "-o", tmp_path / "fitted.obj"),
    }[side]
    refused(run(*words), told, tmp_path, before)


def test_a_few_bad_vertices_are_no_error(run: Run, two: tuple[Path, Path], tmp_path: Path, sphere: Shape) -> None:
    """A NaN vertex and a stray triangle are repaired: the work goes on to the fit."""
    verts = np.concatenate([sphere.verts, 9.0 + np.eye(3) / 1000, np.zeros((1, 3))])
    faces = np.concatenate([sphere.faces, [[642, 643, 644]]])
    bad = np.arange(646) == 645
    save_shape(tmp_path / "nan.ply", Shape(verts, faces, "nan", None, bad))
    assert load_shape(tmp_path / "nan.ply").invalid is not None
    with pytest.raises(AssertionError, match="a fit began"):
        run("register", tmp_path / "nan.ply", "-o", tmp_path / "fitted.ply", "--model", "human")


def test_a_mistyped_file_is_guessed(run: Run, two: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "dancer.ply").write_bytes(two[0].read_bytes())
    answer = run("match", tmp_path / "dancre.ply", two[1], "-o", tmp_path / "map.npy")
    assert answer.status == 1
    assert f"did you mean {tmp_path / 'dancer.ply'}?" in answer.err


def test_a_damaged_model(run: Run, two: tuple[Path, Path], tmp_path: Path) -> None:
    model = tmp_path / "model"
    model.mkdir()
    for file in (bundled_folder() / "models" / "human").iterdir():
        (model / file.name).write_bytes(file.read_bytes())
    weights = model / "weights.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    before = set(os.listdir(tmp_path))
    answer = run("match", *two, "-o", tmp_path / "map.npy", "--model", model)
    refused(answer, "are not those of its card", tmp_path, before)


def test_a_folder_that_refuses_files(
    run: Run, two: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As above, for every user: the system says no when the file is made."""

    def not_allowed(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    before = set(os.listdir(tmp_path))
    with monkeypatch.context() as patch:
        patch.setattr(Path, "touch", not_allowed)
        answer = run("match", *two, "-o", tmp_path / "map.npy")
    refused(answer, "Permission denied", tmp_path, before)


@pytest.mark.parametrize(
    ("text", "told"),
    [("", "is empty"), ("nose\n", "pairs.txt"), ("1 2 3\n", "pairs.txt"), ("0 -1\n", "-1"), ("1.5 2\n", "pairs.txt")],
)
def test_landmarks_that_are_none(run: Run, two: tuple[Path, Path], tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "pairs.txt").write_text(text)
    before = set(os.listdir(tmp_path))
    answer = run("match", *two, "-o", tmp_path / "map.npy", "--landmarks", tmp_path / "pairs.txt")
    refused(answer, told, tmp_path, before)


def test_a_truth_on_a_cloud_needs_faces(run: Run, tmp_path: Path, sphere: Shape) -> None:
    np.save(tmp_path / "cloud.npy", sphere.verts)
    save_shape(tmp_path / "ball.ply", sphere)
    np.savetxt(tmp_path / "map.txt", np.arange(642), fmt="%d")
    before = set(os.listdir(tmp_path))
    words = (tmp_path / "map.txt", tmp_path / "ball.ply", tmp_path / "cloud.npy")
    answer = run("evaluate", *words, "--truth", tmp_path / "map.txt")
    refused(answer, "cloud", tmp_path, before)
