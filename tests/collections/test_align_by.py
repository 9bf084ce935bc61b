"""Shapes of several parts are superimposed by one of them, or each alone: a hinge shows, or it does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from meshmatch.collections import named_parts
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.atlas_arrays import FILE
from meshmatch.collections.measures import measure_atlas
from meshmatch.collections.named_parts import groups_of, parts_of_file, parts_of_template
from meshmatch.collections.registered import registered_meshes
from meshmatch.errors import InputError, OptionError
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.collections.ellipsoids import moved
from tests.conftest import icosphere
from tests.growth import grows_with_size

BALL = icosphere(2)
V = BALL.V
FACES = np.concatenate([BALL.faces, BALL.faces + V])
FIRST = np.arange(2 * V) < V


def joint(degrees: np.ndarray, vary: float = 0.03, grow: float = 0.0) -> np.ndarray:
    """Two bones (S, 2V, 3), the second smaller and turned about the end of the first; both vary in form by themselves."""
    rng = np.random.default_rng(2)
    found = []
    for angle in degrees:
        one, two = (BALL.verts * (axes + vary * rng.standard_normal(3)) for axes in ([1, 1.4, 3.0], [0.7, 0.9, 2.0]))
        pivot = np.array([0, 0, 3.2])
        turn = Rotation.from_rotvec(np.radians(angle) * np.array([1, 0, 0]))
        found.append(np.concatenate([one, turn.apply(two + np.array([0, 0, 5.4]) - pivot) + pivot]))
    return np.array(found) * np.exp(grow * rng.standard_normal(len(found)))[:, None, None]


DEGREES = np.random.default_rng(1).permutation(np.linspace(-12, 12, 12))


def rms(atlas: Atlas, some: np.ndarray, mode: int = 0) -> float:
    """How far a standard deviation of a mode moves some vertices."""
    squared = np.square(atlas.modes[mode, some]).sum(axis=1)
    return float(atlas.deviations[mode] * np.sqrt(atlas.weights[some] @ squared / atlas.weights[some].sum()))


def related(atlas: Atlas, mode: int = 0) -> float:
    return abs(float(np.corrcoef(atlas.scores[:, mode], DEGREES)[0, 1]))


def test_by_one_part_the_hinge_is_the_first_mode_and_nothing_of_that_part() -> None:
    points = joint(DEGREES)
    atlas = Atlas.of(moved(points), FACES, groups=np.where(FIRST, 0, -1))
    assert related(atlas) > 0.999 and atlas.compactness[0] > 0.95
    assert rms(atlas, FIRST) < 0.05 * rms(atlas, ~FIRST)
    whole = Atlas.of(moved(points), FACES)
    assert rms(whole, FIRST) > 0.3 * rms(whole, ~FIRST)  # where the hinge turns both
    apart = atlas.weights[FIRST] @ atlas.mean[FIRST]
    assert np.allclose(apart, 0, atol=1e-9)  # its center is the origin


def test_each_alone_shows_form_without_pose() -> None:
    groups = np.where(FIRST, 0, 1)
    atlas = Atlas.of(moved(joint(DEGREES)), FACES, groups=groups)
    still = Atlas.of(joint(0 * DEGREES), FACES, groups=groups)
    assert atlas.total == pytest.approx(still.total, rel=0.01)
    assert max(related(atlas, mode) for mode in range(4)) < 0.8
    mean = Shape(atlas.mean, FACES)
    gap = mean.verts[~FIRST].mean(axis=0) - mean.verts[FIRST].mean(axis=0)
    assert np.linalg.norm(gap) == pytest.approx(5.4, abs=0.1)  # where it lies on average


def test_size_knows_nothing_of_pose() -> None:
    points, each = joint(3 * DEGREES, 0.0, 0.1), np.where(FIRST, 0, 1)
    grown = Atlas.of(points, FACES, groups=each)
    roots = np.array([np.sqrt(Shape(verts, FACES).area) for verts in points])
    assert np.ptp(roots) > 1 and np.allclose(grown.sizes / roots, grown.sizes[0] / roots[0])
    with pytest.raises(InputError, match="do not differ"):  # once their size and their pose are gone
        Atlas.of(points, FACES, groups=each, scale="remove")
    by_one = Atlas.of(points, FACES, groups=np.where(FIRST, 0, -1), scale="remove")
    assert rms(by_one, FIRST) < 1e-6 * rms(by_one, ~FIRST)


def test_a_further_shape_is_laid_as_the_others() -> None:
    points = joint(DEGREES)
    for groups in (np.where(FIRST, 0, -1), np.where(FIRST, 0, 1)):
        atlas = Atlas.of(points, FACES, groups=groups)
        given = moved(points[[0, 5]], 4)[1]
        found = atlas.project(given)
        assert np.allclose(found.scores, atlas.scores[5], atol=1e-6)
        assert np.allclose(found.shape.verts, given, atol=1e-6)  # each part where it was


def test_a_finer_part_counts_no_more() -> None:
    """The mean's origin, and sizes, are those of the part that was superimposed, whatever the other one is."""
    atlas = Atlas.of(joint(DEGREES), FACES, groups=np.where(FIRST, 0, -1))
    alone = Atlas.of(joint(DEGREES)[:, FIRST], BALL.faces)
    assert np.allclose(atlas.sizes, alone.sizes, rtol=1e-6)
    assert np.allclose(atlas.mean[FIRST], alone.mean, atol=1e-6)


def test_what_is_written_is_read_and_damage_is_told(tmp_path: Path) -> None:
    atlas = Atlas.of(joint(DEGREES), FACES, groups=np.where(FIRST, 0, 1))
    atlas.save(tmp_path / FILE)
    again = Atlas.load(tmp_path)
    assert again.groups is not None and np.array_equal(again.groups, atlas.groups)
    with np.load(tmp_path / FILE) as arrays:
        good = dict(arrays)
    for wrong in (good["groups"] + 1, good["groups"] - 2, good["groups"][:-1], good["groups"] * 10**9):
        np.savez(tmp_path / "bad.npz", **good | {"groups": wrong})
        with pytest.raises(InputError, match="damaged: groups"):
            Atlas.load(tmp_path / "bad.npz")


def test_measures_are_of_what_was_superimposed() -> None:
    """Of form alone, they are those of the same bones that never turned."""
    each = np.where(FIRST, 0, 1)
    points, still = joint(DEGREES), joint(0 * DEGREES)
    atlas = Atlas.of(points, FACES, groups=each)
    found, other = (
        measure_atlas(Atlas.of(some, FACES, groups=each), some, samples=2).generalisation for some in (points, still)
    )
    assert np.allclose(found, other, rtol=0.02)
    with pytest.raises(InputError, match="each part is superimposed alone"):
        measure_atlas(atlas, points, samples=2, surfaces=[BALL] * len(points))


@pytest.mark.parametrize(
    "groups", [np.zeros(3, int), np.full(2 * V, -1), np.full(2 * V, 2), np.zeros(2 * V), np.where(FIRST, 0, -2)]
)
def test_groups_that_are_none_are_refused(groups: np.ndarray) -> None:
    with pytest.raises(InputError, match="group"):
        Atlas.of(joint(DEGREES), FACES, groups=groups)


def test_parts_are_named_or_numbered() -> None:
    shape = Shape(joint(DEGREES)[0], FACES)
    names = {"femur": FIRST, "tibia": ~FIRST, "nothing": np.zeros(2 * V, bool)}
    assert groups_of(shape, "whole", dict) is None
    for word in ("1", "femur"):  # the largest is the first
        assert np.array_equal(groups_of(shape, word, lambda: names), np.where(FIRST, 0, -1))
    assert np.array_equal(groups_of(shape, "tibia", lambda: names), np.where(FIRST, -1, 0))
    assert np.array_equal(groups_of(shape, "each", dict), np.where(FIRST, 0, 1))
    for word, told in {
        "3": "parts 1 to 2",
        "0": "parts 1 to 2",
        "tibla": "did you mean tibia",
        "nothing": "femur",
    }.items():
        with pytest.raises(OptionError) as caught:
            groups_of(shape, word, lambda: names)
        assert told in caught.value.hint
    with pytest.raises(OptionError, match="one part"):
        groups_of(BALL, "each", dict)
    with pytest.raises(OptionError) as caught:
        groups_of(BALL, "femur", dict)
    assert caught.value.hint == "they have no names; and one part"


def test_a_soup_of_triangles_is_not_superimposed_part_by_part(tmp_path: Path) -> None:
    """Each group looks at every vertex: as many groups as a file may hold would take for ever."""
    faces = np.arange(900).reshape(-1, 3)
    points = np.random.default_rng(0).standard_normal((4, 900, 3))
    with pytest.raises(OptionError, match="300 connected parts, too many"):
        groups_of(Shape(points[0], faces), "each", dict)
    with pytest.raises(InputError, match="300 groups of vertices are too many"):
        Atlas.of(points, faces, groups=np.arange(900) // 3)
    Atlas.of(points, faces).save(tmp_path / FILE)
    with np.load(tmp_path / FILE) as arrays:
        given = dict(arrays) | {"groups": np.arange(900) // 3}
    np.savez(tmp_path / "many.npz", **given)
    with pytest.raises(InputError, match="damaged: groups"):
        Atlas.load(tmp_path / "many.npz")


def scene(path: Path, points: np.ndarray) -> None:
    found = trimesh.Scene()
    for name, verts in (("tibia", points[~FIRST]), ("femur", points[FIRST])):
        mesh = trimesh.Trimesh(verts, BALL.faces, process=False)
        found.add_geometry(mesh, node_name=name, geom_name=name)
    found.export(path)


def test_meshes_of_a_scene_have_names(tmp_path: Path) -> None:
    for number, points in enumerate(joint(DEGREES[:4])):
        scene(tmp_path / f"{number}.glb", points)
    with registered_meshes(tmp_path) as shapes:
        atlas = shapes.atlas(align_by="femur")
        assert atlas.groups is not None and atlas.weights[atlas.groups == 0].sum() > 0.5
    save_shape(tmp_path / "plain.ply", BALL)
    assert parts_of_file(tmp_path / "plain.ply") == {}


def test_one_of_thousands_of_meshes(monkeypatch: pytest.MonkeyPatch) -> None:
    """What an assembly of a CAD program has: a mask of each by all vertices would not fit into memory."""

    def prepared(count: int) -> Callable[[], dict[str, Any]]:
        held = [(f"bolt {k % count}", 100) for k in range(2 * count)]
        monkeypatch.setattr(named_parts, "list_meshes", lambda path: held)
        return lambda: parts_of_file("assembly.glb")

    masks = grows_with_size(prepared, 2000)
    assert np.flatnonzero(masks["bolt 7"]).tolist() == [*range(700, 800), *range(200_700, 200_800)]
    assert len(masks) == 2000 and list(masks)[7] == "bolt 7"


def test_parts_of_a_template_are_named_by_the_scans(tmp_path: Path) -> None:
    """Most vertices of a mesh belong to the part; a file that was moved since, or another one, is passed over."""
    points = joint(DEGREES)[0]
    template: Any = SimpleNamespace(shape=Shape(points, FACES), labels=1 * ~FIRST, label_names=("head", "tail"))
    labelled = parts_of_template(template, [], {}, lambda name: pytest.fail(name))
    assert list(labelled) == ["head", "tail"] and np.array_equal(labelled["tail"], ~FIRST)
    template.label_names = ("part 0",)
    scene(tmp_path / "a.glb", points)
    shape = load_shape(tmp_path / "a.glb")
    nearest = np.linalg.norm(shape.verts[:, None] - points[None], axis=2).argmin(axis=1)
    nearest[:20] = nearest[-1]  # some went astray
    places: Any = SimpleNamespace(resting=shape.verts, on=lambda of: SimpleNamespace(vertex=nearest))
    shorter: Any = SimpleNamespace(resting=shape.verts[1:])
    files = {name: str(tmp_path / f"{name}.glb") for name in ("gone", "a")} | {"other": str(tmp_path / "a.glb")}
    masks = parts_of_template(
        template, ["unknown", "gone", "other", "a"], files, lambda name: shorter if name == "other" else places
    )
    assert np.array_equal(masks["femur"], FIRST) and np.array_equal(masks["tibia"], ~FIRST)
    assert parts_of_template(template, ["unknown"], files, lambda name: places) == {}
    template.shape = Shape(points, np.concatenate([FACES, [[0, V, V + 1]]]))  # in one part
    masks = parts_of_template(template, ["a"], files, lambda name: places)
    assert np.array_equal(masks["femur"], FIRST) and np.array_equal(masks["tibia"], ~FIRST)
