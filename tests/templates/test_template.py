"""The template bundle: what is written comes back, and a damaged one is refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from meshmatch.errors import TemplateError
from meshmatch.geometry.triangles import normalized
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, low_mesh, make_template
from meshmatch.templates.template import Template, load_template, read_template, save_template

HASHES = {
    "human-A": "d91cee1d88d8f8db",
    "human-I": "b8cd6a11c4286c82",
    "human-T": "c91d3177ea53fad4",
    "human-T-300": "d36184158b055c6d",
}
FEW = NodeConfig(strategy="uniform", K=60, radius=0.3)


@pytest.fixture(scope="module")
def ball(sphere: Shape) -> Template:
    labels = (sphere.verts[:, 1] > 0).astype(int)
    core = np.flatnonzero(sphere.verts[:, 1] < 0)
    made = make_template(
        Shape(sphere.verts * 70 + 9, sphere.faces, "ball.obj"),
        "ball",
        FEW,
        labels=labels,
        label_names=("south", "north"),
        core=core,
        low=low_mesh(sphere, 500),
    )
    return replace(made, pose="none", source="arithmetic", licence="CC0-1.0")


def test_a_template_stands_in_its_own_frame(ball: Template) -> None:
    assert ball.shape.area == pytest.approx(1)
    corners = ball.shape.verts[ball.shape.faces].mean(1)
    assert np.allclose((ball.shape.face_areas[:, None] * corners).sum(0), 0, atol=1e-12)
    # the dense mesh lies on the same surface, in the same frame
    assert np.linalg.norm(ball.dense.verts, axis=1).std() < 1e-3
    assert ball.dense.V == 642
    assert ball.shape.F <= 500


def test_labels_and_core_follow_their_vertices(ball: Template, sphere: Shape) -> None:
    height = sphere.verts[low_mesh(sphere, 500)[0], 1]
    assert np.array_equal(ball.labels, height > 0)
    assert np.array_equal(ball.core, np.flatnonzero(height < 0))
    assert 0 < len(ball.core) < ball.shape.V


def test_low_mesh_keeps_a_subset_of_the_vertices(sphere: Shape) -> None:
    keep, faces = low_mesh(sphere, 300)
    assert len(keep) < sphere.V
    assert np.array_equal(keep, np.unique(keep))
    assert len(faces) <= 306  # the target and 2 %
    assert np.array_equal(np.unique(faces), np.arange(len(keep)))
    a, b, c = faces.T
    assert ((a != b) & (b != c) & (c != a)).all()
    small = Shape(sphere.verts[keep], faces)
    assert small.area == pytest.approx(4 * np.pi, rel=0.05)  # still the sphere
    assert (np.einsum("fi,fi->f", normalized(small.face_vectors), small.verts[faces].mean(1)) > 0.9).mean() > 0.98
    same, all_faces = low_mesh(sphere, 5000)
    assert np.array_equal(same, np.arange(sphere.V))
    assert np.array_equal(all_faces, sphere.faces)


def test_walls_that_touch_stay_apart(sphere: Shape) -> None:
    """Two balls that share nothing but a flat wall, whose vertices lie beside each other."""
    low = sphere.verts * [1, 1, 0.7]
    low[:, 2] = np.minimum(low[:, 2], 0)
    turned = low[:, [1, 0, 2]] * [1, 1, -1] + [0, 0, 1e-4]
    both = Shape(np.concatenate([low, turned]), np.concatenate([sphere.faces, sphere.faces + sphere.V]))
    keep, faces = low_mesh(both, 400)
    found = Shape(both.verts[keep], faces)
    assert found.vertex_parts.max() == 1
    assert np.ptp(keep[faces] // sphere.V, axis=1).max() == 0


def test_written_bundle_comes_back(ball: Template, tmp_path: Path) -> None:
    save_template(ball, tmp_path / "ball.safetensors")
    found = load_template(tmp_path / "ball.safetensors")
    assert found.hash == ball.hash
    for name in ("name", "radius", "label_names", "pose", "source", "licence", "K"):
        assert getattr(found, name) == getattr(ball, name), name
    for name in ("nodes", "labels", "core"):
        assert np.array_equal(getattr(found, name), getattr(ball, name)), name
    assert np.array_equal(found.shape.verts, ball.shape.verts)
    assert np.array_equal(found.shape.faces, ball.shape.faces)
    assert np.array_equal(found.dense.faces, ball.dense.faces)
    assert np.allclose(found.dense.verts, ball.dense.verts, atol=1e-7)


def test_nodes_may_have_radii_of_their_own(ball: Template, tmp_path: Path) -> None:
    radii = np.linspace(0.3, 0.4, ball.K)
    own = replace(ball, radius=radii)
    assert own.reach == 0.4 and ball.reach == 0.3
    assert own.hash != ball.hash != replace(ball, radius=radii[::-1].copy()).hash
    save_template(own, tmp_path / "own.safetensors")
    found = load_template(tmp_path / "own.safetensors")
    assert np.array_equal(found.radius, radii) and found.hash == own.hash
    # one radius is one, however it is given
    same = replace(ball, radius=np.full(ball.K, 0.3))
    assert same.radius == 0.3 and same.hash == ball.hash


def test_a_bundle_of_one_radius_is_what_it_was(ball: Template, tmp_path: Path) -> None:
    """Older versions read it, and bundles that are out there have the hashes that their models know."""
    save_template(ball, tmp_path / "ball.safetensors")
    with safe_open(str(tmp_path / "ball.safetensors"), framework="np") as file:
        words = json.loads(file.metadata()["template"])
        assert set(file.keys()) == {"verts", "faces", "dense_verts", "dense_faces", "nodes", "labels", "core"}
    assert (words["schema"], words["radius"]) == (1, 0.3)
    assert {name: read_template(name).hash for name in HASHES} == HASHES


def test_a_damaged_bundle_of_radii_is_refused(ball: Template, tmp_path: Path) -> None:
    path = tmp_path / "own.safetensors"
    for arrays, drop, words, told in (
        ({"radii": np.linspace(0.3, 0.41, ball.K)}, "", {}, "does not match its hash"),
        ({"radii": np.linspace(0.3, 0.4, ball.K - 1)}, "", {}, "one for each node"),
        ({}, "radii", {}, "not a template bundle"),
        ({}, "", {"schema": 1, "radius": 0.3}, "not a template bundle"),
    ):
        save_template(replace(ball, radius=np.linspace(0.3, 0.4, ball.K)), path)
        rewrite(path, arrays, words, drop)
        with pytest.raises(TemplateError, match=told):
            load_template(path)


def test_the_hash_is_of_what_a_model_depends_on(ball: Template) -> None:
    shape = ball.shape
    moved = Shape(shape.verts + 1e-9, shape.faces, shape.name)
    turned = Shape(shape.verts, shape.faces[:, [1, 2, 0]], shape.name)
    others = [
        replace(ball, shape=moved),
        replace(ball, shape=turned),
        replace(ball, nodes=ball.nodes + 1e-9),
        replace(ball, radius=0.31),
        replace(ball, core=ball.core[1:]),
    ]
    assert len({ball.hash, *(other.hash for other in others)}) == 6
    assert replace(ball, name="other", licence="none", label_names=("a", "b")).hash == ball.hash
    coarse = Shape(ball.shape.verts[:3], np.array([[0, 1, 2]]))
    assert replace(ball, dense=coarse, labels=np.zeros(ball.shape.V, int)).hash == ball.hash


def _nan(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array[0] = np.nan
    return array


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: {"nodes": t.nodes[:, :2]}, "nodes"),
        (lambda t: {"nodes": _nan(t.nodes)}, "nodes"),
        (lambda t: {"labels": t.labels[1:]}, "one label per vertex"),
        (lambda t: {"labels": t.labels - 1}, "one label per vertex"),
        (lambda t: {"label_names": ("only",)}, "a label has no name"),
        (lambda t: {"core": t.core[:2]}, "core"),
        (lambda t: {"core": t.core + t.shape.V}, "core"),
        (lambda t: {"radius": 0.0}, "radius"),
        (lambda t: {"radius": float("nan")}, "radius"),
        (lambda t: {"radius": np.full(t.K - 1, 0.3)}, "radius"),
        (lambda t: {"radius": np.linspace(0.0, 0.3, t.K)}, "radius"),
        (lambda t: {"radius": _nan(np.linspace(0.2, 0.3, t.K))}, "radius"),
    ],
)
def test_an_impossible_template_is_refused(ball: Template, change, told: str) -> None:
    with pytest.raises(TemplateError, match=told):
        replace(ball, **change(ball))


def rewrite(path: Path, arrays: dict | None = None, words: dict | None = None, drop: str = "") -> None:
    """Damage a bundle, its container kept whole."""
    with safe_open(str(path), framework="np") as file:
        header = json.loads(file.metadata()["template"])
    held = load_file(path) | (arrays or {})
    header |= words or {}
    header.pop(drop, None)
    held.pop(drop, None)
    save_file(held, path, {"template": json.dumps(header)})


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ({"words": {"schema": 3}}, "schema 3, not at most 2"),
        ({"words": {"hash": "0" * 16}}, "does not match its hash"),
        ({"words": {"radius": 0.4}}, "does not match its hash"),
        ({"words": {"radius": "wide"}}, "not a template bundle"),
        ({"drop": "radius"}, "not a template bundle"),
        ({"drop": "name"}, "not a template bundle"),
        ({"drop": "hash"}, "does not match its hash"),
        ({"drop": "nodes"}, "not a template bundle"),
        ({"arrays": {"extra": np.zeros(3)}}, "not a template bundle"),
        ({"arrays": {"faces": np.full((4, 3), 99_999, np.int32)}}, "not a template bundle"),
        ({"arrays": {"dense_faces": np.full((4, 3), np.nan)}}, "not a template bundle"),
        ({"arrays": {"verts": np.full((600, 3), np.nan)}}, "not a template bundle"),
        ({"arrays": {"dense_verts": np.full((9, 3), 0x7FA00001, np.uint32).view(np.float32)}}, "not a template bundle"),
        ({"arrays": {"nodes": np.zeros((60, 3))}}, "does not match its hash"),
    ],
)
def test_a_damaged_bundle_is_refused(ball: Template, tmp_path: Path, how: dict, told: str) -> None:
    path = tmp_path / "ball.safetensors"
    save_template(ball, path)
    rewrite(path, **how)
    with pytest.raises(TemplateError, match=told) as caught:
        load_template(path)
    assert caught.value.hint


def test_a_huge_bundle_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.safetensors").open("wb") as file:
        file.truncate(51_000_000)
    with pytest.raises(TemplateError, match="larger than a template may be"):
        load_template(tmp_path / "a.safetensors")


@pytest.mark.parametrize("content", [b"", b"ply\n", b"\xff" * 40])
def test_what_is_no_bundle_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.safetensors"
    path.write_bytes(content)
    with pytest.raises(TemplateError, match="not a template bundle"):
        load_template(path)
    for words in ("[1]", "[" * 100_000):
        save_file({"a": np.zeros(3)}, path, {"template": words})
        with pytest.raises(TemplateError, match="not a template bundle"):
            load_template(path)
    with pytest.raises(TemplateError, match="no template bundle at"):
        load_template(tmp_path / "none.safetensors")


def test_the_points_of_a_cloud_are_joined_to_a_template(sphere: Shape) -> None:
    made = make_template(Shape(sphere.verts, np.empty((0, 3), int), "dots"), "dots", FEW)
    assert made.shape.F > 600
    assert np.allclose(np.linalg.norm(made.shape.verts, axis=1), (4 * np.pi) ** -0.5, rtol=0.05)  # area 1


def test_labels_must_fit(sphere: Shape) -> None:
    with pytest.raises(TemplateError, match="5 labels for 642"):
        make_template(sphere, "ball", FEW, labels=np.zeros(5, int))
    with pytest.raises(TemplateError, match="a label below 0"):
        make_template(sphere, "ball", FEW, labels=np.full(642, -1))
