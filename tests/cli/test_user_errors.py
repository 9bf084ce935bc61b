"""What users get wrong: one line that says what, a hint, status 1, nothing half-written.

Everything here fails before the first fit, which is made to fail the test if it begins.
"""

import os
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


HEAD = "ply\nformat binary_little_endian 1.0\nelement vertex 100\n" + "".join(f"property float {a}\n" for a in "xyz")
HEAD += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
NAN = "v nan nan nan\n" * 3 + "f 1 2 3\n"
RANDOM = np.random.default_rng(0).normal(size=(20, 3))

# name of the file, what is in it (None: there is none), a word of the message that names the trouble
BAD_FILES: dict[str, tuple[str, bytes | str | np.ndarray | Shape | None, str]] = {
    "missing": ("bad.ply", None, "there is no file"),
    "0 bytes": ("bad.ply", b"", "0 bytes"),
    "not a mesh": ("bad.ply", "Dear Sir or Madam,\n", "is not a ply file"),
    "a picture called obj": ("bad.obj", b"\x89PNG\r\n\x1a\n\0\0", "is not an obj file"),
    "unknown kind": ("bad.docx", "x", "unsupported file format"),
    "no suffix": ("bad", "x", "no suffix"),
    "truncated ply": ("bad.ply", HEAD.encode() + bytes(120), "fewer vertex rows than the 100"),
    "truncated glb": ("bad.glb", b"glTF\2\0\0\0\xff\0\0\0", "is only 12"),
    "no vertices": ("bad.off", "OFF\n0 0 0\n", "no vertices"),
    "face of a missing vertex": ("bad.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "refers to vertex 9"),
    "all NaN": ("bad.obj", NAN, "no vertex has a usable position"),
    "a cloud of NaN": ("bad.npy", np.full((500, 3), np.nan), "no vertex has a usable position"),
    "one triangle": ("bad.ply", Shape(np.eye(3), np.array([[0, 1, 2]])), "only 1 usable triangle"),
    "no face with area": ("bad.ply", Shape(np.eye(3), np.array([[0, 1, 1], [2, 2, 2]])), "no face with any area"),
    "few points": ("bad.npy", RANDOM, "only 20 distinct point positions"),
    "a folder": ("bad.ply/inside", "", "is a folder"),
    "a map for a cloud": ("bad.npy", np.arange(9), "bad.npy"),
}


def write(path: Path, content: bytes | str | np.ndarray | Shape) -> None:
    path.parent.mkdir(exist_ok=True)
    if isinstance(content, Shape):
        save_shape(path, content)
    elif isinstance(content, np.ndarray):
        np.save(path, content)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)


@pytest.mark.parametrize("side", ["source", "target", "register"])
@pytest.mark.parametrize("kind", BAD_FILES)
def test_bad_files(run: Run, two: tuple[Path, Path], tmp_path: Path, kind: str, side: str) -> None:
    name, content, told = BAD_FILES[kind]
    bad = tmp_path / name.partition("/")[0]
    if content is not None:
        write(tmp_path / name, content)
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


@pytest.mark.parametrize("words", [("register", "a.ply"), ("wrap", "a.ply", "b.ply")])
def test_a_mesh_needs_a_format_with_faces(run: Run, two: tuple[Path, Path], tmp_path: Path, words: tuple[str]) -> None:
    verb, *shapes = words
    before = set(os.listdir(tmp_path))
    answer = run(verb, *(tmp_path / shape for shape in shapes), "-o", tmp_path / "out.xyz", "--model", "human")
    refused(answer, "a .xyz file cannot hold faces", tmp_path, before)


def test_readers_say_what_may_not_be_read(
    run: Run, two: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As data that are wrong (1), not as a wrong command line (2): for typer asks nobody."""

    def not_allowed(self: Path, *_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr("os.access", lambda path, mode: mode != os.R_OK)
    monkeypatch.setattr(Path, "open", not_allowed)
    for words in (
        ("info", two[0]),
        ("evaluate", tmp_path / "map.npy", *two),
        ("match", *two, "-o", tmp_path / "m.npy"),
    ):
        answer = run(*words)
        assert (answer.status, "is not readable" in answer.err) == (1, False)
    assert "may you read it?" in run("info", two[0]).err


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
