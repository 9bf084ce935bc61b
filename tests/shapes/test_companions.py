"""Names of other files as mtl, glTF and ply have them, written on other systems."""

import base64
import os
import unicodedata
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.shapes.companions import find_companion
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf import Document
from tests.shapes.painted import write_gltf

ACCENTS = "Gesäß é.png"
COMPOSED, DECOMPOSED = (unicodedata.normalize(form, ACCENTS) for form in ("NFC", "NFD"))


def make(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(name.encode("utf-8", "surrogateescape"))


def found(folder: Path, name: str, uri: bool) -> str | None:
    file = find_companion(folder, name, uri)
    return None if file is None else file.relative_to(folder.resolve()).as_posix()


@pytest.mark.parametrize("uri", [False, True], ids=["name", "uri"])
@pytest.mark.parametrize(
    ("there", "name"),
    [
        ("skin.png", "skin.png"),
        ("skin.png", "  skin.png "),
        ("my skin.png", '"my skin.png"'),
        ("my skin.png", "./my skin.png"),
        ("Skin.PNG", "sKIN.png"),
        ("Maps/Skin.PNG", "maps/skin.png"),
        (COMPOSED, DECOMPOSED),
        (DECOMPOSED, COMPOSED),
        (DECOMPOSED, COMPOSED.upper().replace("SS", "ß")),
        ("maps/skin.png", "maps\\skin.png"),
        ("maps/skin.png", ".\\Maps\\Skin.png"),
        ("maps\\skin.png", "maps\\skin.png"),
        ("skin.png", "C:\\Users\\me\\skin.png"),
        ("skin.png", "d:/scans/skin.png"),
        ("skin.png", "\\\\server\\share\\skin.png"),
        ("skin.png", "/home/me/skin.png"),
        ("skin.png", "file:///C:/scans/skin.png"),
        ("maps/skin.png", "C:\\scans\\maps\\skin.png"),
        ("maps/skin.png", "../../maps/skin.png"),
        ("skin.png", "maps/skin.png"),
        ("a b.png", "a%20b.png"),
        ("a%20b.png", "a%20b.png"),
        ("100%.png", "100%.png"),
        ("k%C3%B6rper.png", "k%C3%B6rper.png"),
        ("körper.png", "k%C3%B6rper.png"),
        ("körper.png", "k%F6rper.png"),
        ("körper.png", "k\udcf6rper.png"),
        ("k\udcf6rper.png", "körper.png"),
        ("skin.png", "skin.png?v=3"),
        ("skin.png?v=3", "skin.png?v=3"),
        ("skin.png", "Skin.png#main"),
        ("skin#1.png", "skin#1.png"),
        ("a b/skin.png", "a%20b\\Skin.png?v=3"),
    ],
)
def test_finds_what_is_meant(tmp_path: Path, there: str, name: str, uri: bool) -> None:
    make(tmp_path, there, "another.png")
    assert found(tmp_path, name, uri) == there


@pytest.mark.parametrize(
    ("there", "name", "uri", "meant"),
    [
        (("skin.png", "Skin.png", "SKIN.png"), "Skin.png", False, "Skin.png"),
        (("skin.png", "Skin.png", "SKIN.png"), "sKiN.png", False, "SKIN.png"),  # of several always the same
        ((COMPOSED, DECOMPOSED), COMPOSED, False, COMPOSED),
        ((COMPOSED, DECOMPOSED), DECOMPOSED, True, DECOMPOSED),
        ((DECOMPOSED, COMPOSED.lower()), COMPOSED, False, DECOMPOSED),  # rather other accents than another case
        (("a b.png", "a%20b.png"), "a%20b.png", False, "a%20b.png"),
        (("a b.png", "a%20b.png"), "a%20b.png", True, "a b.png"),
        (("maps/skin.png", "skin.png"), "maps\\Skin.png", False, "maps/skin.png"),
        (("maps/skin.png", "skin.png"), "D:\\x\\maps\\skin.png", False, "maps/skin.png"),
        (("Maps/other.png", "maps/Skin.png"), "MAPS/skin.png", False, "maps/Skin.png"),  # both folders are looked into
    ],
)
def test_prefers(tmp_path: Path, there: tuple[str, ...], name: str, uri: bool, meant: str) -> None:
    make(tmp_path, *there)
    assert found(tmp_path, name, uri) == meant


@pytest.mark.parametrize("uri", [False, True], ids=["name", "uri"])
@pytest.mark.parametrize(
    "name", ["", " ", ".", "..", "/", "\\", "?", "#x", "a\0b", "missing.png", "in", "x" * 5000, "a/" * 2000 + "b"]
)
def test_finds_nothing(tmp_path: Path, name: str, uri: bool) -> None:
    make(tmp_path, "in/skin.png")
    assert find_companion(tmp_path, name, uri) is None


@pytest.mark.parametrize(
    "name", ["../secret.png", "..\\Secret.png", "%2e%2e/secret.png", "link/secret.png", "Link.png"]
)
def test_stays_in_the_folder(tmp_path: Path, name: str) -> None:
    inner = tmp_path / "inner"
    make(tmp_path, "inner/a.gltf", "secret.png", "other/secret.png")
    (inner / "link").symlink_to(tmp_path / "other")
    (inner / "link.png").symlink_to(tmp_path / "secret.png")
    assert find_companion(inner, name) is find_companion(inner, name, uri=True) is None
    assert find_companion(inner, str(tmp_path / "secret.png")) is None


def test_sees_what_changed(tmp_path: Path) -> None:
    make(tmp_path, "Skin.png")
    os.utime(tmp_path, (1e9, 1e9))
    assert found(tmp_path, "skin.PNG", False) == "Skin.png"
    (tmp_path / "Skin.png").rename(tmp_path / "SKIN.png")
    assert found(tmp_path, "skin.PNG", False) == "SKIN.png"


def test_folders_that_differ_in_case_are_bounded(tmp_path: Path) -> None:
    """Links to the folder itself would double the paths with each step."""
    for name in ("aa", "aA", "Aa", "AA"):
        (tmp_path / name).symlink_to(".")
    make(tmp_path, "skin.png")
    assert found(tmp_path, "aa\\" * 30 + "SKIN.png", False) == "skin.png"


TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
CODED = base64.b64encode(TRIANGLE + b"\xfb\xff").decode()


@pytest.mark.parametrize(
    "uri",
    [
        f"data:application/octet-stream;base64,{CODED}",
        f"data:;base64,{CODED.rstrip('=')}",
        f"DATA:application/gltf-buffer;Base64,{CODED}",
        f"data:;base64,{CODED.replace('+', '-').replace('/', '_')}",
        f"data:;base64,{CODED.replace('+', '%2B').replace('/', '%2F').replace('=', '%3D')}",
        f"data:;base64,{CODED[:20]}\n {CODED[20:]}",
        "data:application/octet-stream," + "".join(f"%{byte:02X}" for byte in TRIANGLE + b"\xfb\xff"),
    ],
)
def test_embedded_data(tmp_path: Path, uri: str) -> None:
    path = tmp_path / "a.gltf"
    write_gltf(path, primitives=[{}])
    assert load_shape(path).V
    assert Document(path, path.read_bytes()).resource(uri) == TRIANGLE + b"\xfb\xff"


@pytest.mark.parametrize("uri", ["data:", "data:;base64", "data:;base64,!!!!", "data:;base64,AAAAA"])
def test_embedded_data_that_is_none(tmp_path: Path, uri: str) -> None:
    path = tmp_path / "a.gltf"
    write_gltf(path, primitives=[{}])
    with pytest.raises(InputError, match="not base64"):
        Document(path, path.read_bytes()).resource(uri)
