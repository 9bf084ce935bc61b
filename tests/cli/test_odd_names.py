"""Names that are not ASCII, not UTF-8, or as long as a name may be; and a terminal that cannot show them."""

import io
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.cli import main
from meshmatch.errors import OutputError
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import folder_on_success, replace_on_success
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from tests.cli.conftest import Run

BAD = os.fsdecode(b"b\xff.ply")


@pytest.fixture
def odd(tmp_path: Path, cube: Shape) -> Path:
    """A folder in which a cube has a name that is not UTF-8; skipped where the file system refuses it."""
    try:
        save_shape(tmp_path / BAD, cube)
    except OSError:
        pytest.skip("this file system takes UTF-8 names alone")
    np.savetxt(tmp_path / "map.txt", np.arange(8), fmt="%d")
    np.savetxt(tmp_path / "labels.txt", np.arange(8) % 2, fmt="%d")
    return tmp_path


@pytest.mark.parametrize("suffix", [".json", ".csv", ".ply", ".npy", ".txt"])
def test_a_name_that_is_not_utf_8(run: Run, odd: Path, suffix: str) -> None:
    words = (odd / BAD, odd / BAD, "--map", odd / "map.txt", "--labels", odd / "labels.txt")
    output = odd / os.fsdecode(b"o\xff" + suffix.encode())
    answer = run("transfer-labels", *words, "-o", output)
    assert answer.status == 0, answer.err
    assert output.is_file()


@pytest.mark.parametrize("coding", ["ascii", "latin-1", "utf-8"])
def test_a_terminal_without_the_letters(odd: Path, coding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (odd / "ü人.ply").write_bytes((odd / BAD).read_bytes())
    monkeypatch.chdir(odd)

    def said(*words: str) -> str:
        terminal = io.TextIOWrapper(io.BytesIO(), encoding=coding, errors="strict")
        monkeypatch.setattr(sys, "stdout", terminal)
        assert main(["info", *words]) == 0
        return terminal.buffer.getvalue().decode(coding)

    for name in ("ü人.ply", BAD):
        assert "vertices" in said(name) and said(name).endswith("\n")
    assert json.loads(said("ü人.ply", "--json"))["file"] == "ü人.ply"


def test_an_output_that_is_a_link_keeps_the_link(tmp_path: Path) -> None:
    """To a file, to nothing yet, to a folder; a circle leads nowhere, and is replaced."""
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "real.txt").write_text("old")
    (tmp_path / "a.txt").symlink_to("far/real.txt")
    (tmp_path / "b.txt").symlink_to("far/new.txt")
    for name, real in (("a.txt", "real.txt"), ("b.txt", "new.txt")):
        with replace_on_success(tmp_path / name) as temporary:
            temporary.write_text("new")
        assert (tmp_path / name).is_symlink()
        assert (tmp_path / "far" / real).read_text() == "new"
    (tmp_path / "c.txt").symlink_to("nowhere/new.txt")
    with pytest.raises(OutputError, match="there is no folder"), replace_on_success(tmp_path / "c.txt"):
        pass
    with pytest.raises(OutputError) as raised, replace_on_success(tmp_path / "my out" / "a.txt"):
        pass
    assert shlex.split(raised.value.hint)[-1] == str(tmp_path / "my out")
    (tmp_path / "empty").mkdir()
    (tmp_path / "d").symlink_to("empty")
    with folder_on_success(tmp_path / "d") as folder:
        (folder / "x").touch()
    assert (tmp_path / "d").is_symlink()
    assert os.listdir(tmp_path / "empty") == ["x"]


def test_a_file_that_is_write_protected_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.txt").write_text("mine")
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "a.txt")  # root may write everywhere
    with pytest.raises(OutputError, match="write-protected"), replace_on_success(tmp_path / "a.txt"):
        pass
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_pipe_stays_one(tmp_path: Path) -> None:
    """A link to a device too, such as /dev/null: those who may remove it would."""
    os.mkfifo(tmp_path / "pipe.txt")
    (tmp_path / "link.txt").symlink_to("pipe.txt")
    for name in ("pipe.txt", "link.txt"):
        with pytest.raises(OutputError, match="it is a pipe or a device"), replace_on_success(tmp_path / name):
            pass
    assert (tmp_path / "pipe.txt").is_fifo() and len(os.listdir(tmp_path)) == 2


@pytest.mark.parametrize(("name", "told"), [("loop.ply", "a link to a file"), ("pipe.ply", "not a regular file")])
def test_inputs_that_are_no_files(run: Run, tmp_path: Path, name: str, told: str) -> None:
    (tmp_path / "loop.ply").symlink_to("loop.ply")
    os.mkfifo(tmp_path / "pipe.ply")  # nobody ever writes into it
    answer = run("info", tmp_path / name)
    assert (answer.status, answer.out) == (1, "")
    assert told in answer.err
    labels = ("--labels", tmp_path / "x.txt", "-o", tmp_path / "loop.ply")
    assert run("transfer-labels", tmp_path / name, tmp_path / name, *labels).status == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize("words", [["info", "a.ply", "--json"], ["models", "show", "human"], ["--help"]])
def test_a_full_disk_behind_stdout_is_told(tmp_path: Path, cube: Shape, words: list[str]) -> None:
    save_shape(tmp_path / "a.ply", cube)
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "meshmatch", *words],
            cwd=tmp_path,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr.splitlines()[0] == "error: cannot write to stdout: No space left on device"
    assert "Traceback" not in done.stderr


def test_names_as_long_as_a_name_may_be(tmp_path: Path) -> None:
    """255 bytes, of which each letter takes four: the temporary name must not be longer."""
    name = "😀" * 62
    with replace_on_success(tmp_path / f"{name}.json") as temporary:
        temporary.write_text("x")
    with folder_on_success(tmp_path / name) as folder:
        (folder / "x").touch()
    assert sorted(os.listdir(tmp_path)) == [name, f"{name}.json"]


def test_an_mtl_whose_images_have_names_in_latin_1(tmp_path: Path) -> None:
    """Old programs write names as bytes of their own; the file has the same bytes."""
    image = tmp_path / os.fsdecode(b"H\xe4ut.png")
    try:
        Image.fromarray(np.full((2, 2, 3), 200, np.uint8)).save(image)
    except OSError:
        pytest.skip("this file system takes UTF-8 names alone")
    (tmp_path / "a.mtl").write_bytes(b"newmtl K\xf6rper\nmap_Kd H\xe4ut.png\n")
    (tmp_path / "a.obj").write_bytes(
        b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl K\xf6rper\nf 1/1 2/2 3/3\n"
    )
    found = load_appearance(tmp_path / "a.obj", load_shape(tmp_path / "a.obj"))
    assert found.textured


def test_what_a_file_says_commands_no_terminal(run: Run, tmp_path: Path, cube: Shape) -> None:
    """Its title would change, its text turn red; a new line would pass for a message of ours."""
    bad = "\x1b]0;pwned\x07\x9b31m\nerror: me"
    found = VertexMap("a" + bad, "b", np.arange(8), verdict="poor", reasons=(bad,))
    save_map(tmp_path / "m.npz", found)
    (tmp_path / "a.obj").write_text(f"mtllib {bad.partition(chr(10))[0]}x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    answers = [
        run("info", tmp_path / "m.npz"),
        run("info", tmp_path / "m.npz", "--json"),
        run("picture", tmp_path / "a.obj", "-o", tmp_path / "p.png"),
    ]
    for answer in answers:
        lines = (answer.out + answer.err).splitlines()
        assert not any(ord(letter) < 32 or 126 < ord(letter) < 160 for line in lines for letter in line)
        assert not any(line.startswith("error: me") for line in lines)
    assert [answer.status for answer in answers] == [0, 0, 0]
    assert answers[1].record["reasons"] == [bad]
