"""Meshes of a scene, chosen by name: weights for a fit, and no vertex is lost."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshmatch.cli import main
from meshmatch.errors import InputError
from meshmatch.shapes.files import list_meshes, load_shape, load_shapes, save_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape


@pytest.fixture
def knight(tmp_path: Path) -> Path:
    """A body with a sword and a shield, and how many vertices each has."""
    scene = trimesh.Scene()
    for name, mesh in (
        ("Body", trimesh.creation.icosphere(3)),
        ("Sword_L", trimesh.creation.box((0.1, 4, 0.1)).apply_translation((2, 0, 0))),
        ("Shield", trimesh.creation.icosphere(1).apply_translation((-3, 0, 0))),
    ):
        scene.add_geometry(mesh, geom_name=name, node_name=f"{name.lower()}_node")
    path = tmp_path / "knight.glb"
    path.write_bytes(scene.export(file_type="glb"))
    return path


def test_names_are_told(knight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert list_meshes(knight) == [("body_node", 642), ("sword_l_node", 8), ("shield_node", 42)]
    assert main(["info", str(knight), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["meshes"][1] == "sword_l_node (8 vertices)"
    save_shape(tmp_path / "plain.ply", load_shape(knight))
    assert list_meshes(tmp_path / "plain.ply") == []


@pytest.mark.parametrize(
    "choice",
    [{"only": ["body"]}, {"only": ["BODY*"]}, {"without": ["sword_?", "shield"]}, {"without": ["s*"]},
     {"only": ["body", "shield_node"], "without": ["Shield"]}],
)  # fmt: skip
def test_the_chosen_meshes_alone_are_fitted(knight: Path, choice: dict[str, list[str]]) -> None:
    whole, chosen = load_shape(knight), load_shape(knight, **choice)
    assert whole.weights is None and chosen.weights is not None
    assert np.array_equal(chosen.verts, whole.verts) and np.array_equal(chosen.faces, whole.faces)
    assert np.array_equal(chosen.weights, np.arange(692) < 642)
    clean = repair(chosen)
    assert (clean.shape.V, clean.shape.F) == (642, 1280)
    assert any("92 faces left out, as was asked for (weight 0)" in note for note in clean.notes)
    # what was left out is answered for by the nearest that was not
    tip = int(whole.verts[642:650, 0].argmin()) + 642
    near = clean.shape.verts[clean.original_to_repaired[tip]]
    away = np.linalg.norm(clean.shape.verts - whole.verts[tip], axis=1)
    assert np.linalg.norm(near - whole.verts[tip]) < away.min() + 1e-9


def test_points_without_weight_are_left_out() -> None:
    points = np.random.default_rng(0).standard_normal((200, 3))
    clean = repair(Shape(points, np.empty((0, 3), np.int64), "cloud", weights=(np.arange(200) < 150) * 0.5))
    assert clean.shape.V == 150 and np.all(clean.shape.weights == 0.5)
    assert len(clean.original_to_repaired) == 200


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"only": ["horse"]}, "no mesh of knight.glb is called 'horse'"),
        ({"without": ["body", "lance"]}, "no mesh of knight.glb is called 'lance'"),
        ({"without": ["*"]}, "no mesh of knight.glb is left"),
    ],
)
def test_wrong_names_are_told(knight: Path, choice: dict[str, list[str]], words: str) -> None:
    with pytest.raises(InputError, match=words.replace("*", r"\*")) as caught:
        load_shape(knight, **choice)
    if "called" in words:
        assert "body_node, sword_l_node, shield_node" in caught.value.hint


def test_shapes_together_are_asked_for_the_names_they_know(
    knight: Path, tmp_path: Path, make_sphere: Callable[[int], Shape]
) -> None:
    """A character with a sword beside a scan, which has no meshes to choose from."""
    scan = tmp_path / "a.ply"
    save_shape(scan, make_sphere(1))
    first, second = load_shapes([knight, scan], only="body")
    assert second.weights is None
    assert np.array_equal(first.weights, load_shape(knight, only=["body"]).weights)
    with pytest.raises(InputError, match=r"no mesh of knight\.glb or a\.ply is called 'lance'"):
        load_shapes([knight, scan], only=["body"], without=["lance"])
    with pytest.raises(InputError, match=r"a\.ply or a\.ply names no meshes"):
        load_shapes([scan, scan], without="body")
    with pytest.raises(InputError, match=r"a\.ply names no meshes to choose from"):
        load_shape(scan, only=["body"])


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["match", "-o", "map.npy", "--only", "body", "--only", "lance"], "called 'lance'"),
        (["transfer-color", "-o", "c.ply", "--map", "m.npy", "--without", "s*"], "--without"),
        (["view", "--only", "lance", "-o", "page.html"], "called 'lance'"),
    ],
)
def test_the_command_line_hands_the_names_on(
    knight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    words: list[str], told: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main([words[0], str(knight), str(knight), *words[1:]]) == 1
    assert told in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["knight.glb"]
