"""Where the shapes of an atlas come from."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import numpy as np
import pytest

from meshmatch.collections.registered import (
    Registered,
    load_points,
    match_names,
    mixed_units,
    read_group,
    registered_meshes,
    size_ratio,
)
from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.collections.ellipsoids import ellipsoids


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    given = ellipsoids(4, splits=1)
    for k, points in enumerate(given.points):
        save_shape(tmp_path / f"b{3 - k}.ply", Shape(points, given.faces))
    (tmp_path / "words.txt").write_text("no mesh\n")
    return tmp_path


def test_meshes_come_in_the_order_of_their_names(folder: Path) -> None:
    given = ellipsoids(4, splits=1)
    with registered_meshes(folder) as found:
        assert found.names == ("b0", "b1", "b2", "b3")
        assert np.array_equal(found.points, given.points[::-1])
        assert np.array_equal(found.faces, given.faces)


def test_what_is_named_is_left_out(folder: Path) -> None:
    given = ellipsoids(4, splits=1)
    with registered_meshes(folder, ["b2.ply"]) as found:
        assert (found.names, found.left_out) == (("b0", "b1", "b3"), {"b2": "asked"})
        assert np.array_equal(found.points, given.points[[3, 2, 0]])
        (folder / "group.txt").write_text("b1\nb2\n")
        assert read_group(folder / "group.txt", found) == ["b1"]
    assert match_names(["cut-1", "cut-2", "b"], ["cut-*"]) == {"cut-1", "cut-2"}
    assert match_names(["cut-1", "cut-2", "b"], "cut-*") == {"cut-1", "cut-2"}
    with pytest.raises(InputError, match="no shape called b9") as caught, registered_meshes(folder, ["b9"]):
        pass
    assert caught.value.hint.startswith("did you mean b")


def test_many_are_kept_in_a_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.collections.registered._IN_MEMORY", 100)
    with registered_meshes(folder) as found:
        assert isinstance(found.points, np.memmap)
        file = Path(found.points.filename)
        assert np.array_equal(found.points, ellipsoids(4, splits=1).points[::-1])
    assert not file.exists()
    with load_points(3, 5, lambda k: np.full((5, 3), float(k))) as points:
        assert points[:, 0, 0].tolist() == [0, 1, 2]


def test_other_meshes_are_refused(folder: Path) -> None:
    ball = ellipsoids(1, splits=2)
    wrong = folder / "c.obj"
    for other, message in {
        Shape(ball.points[0], ball.faces): "does not have the vertices",
        Shape(ellipsoids(1, splits=1).points[0], ellipsoids(1, splits=1).faces[::-1]): "does not have the vertices",
    }.items():
        save_shape(wrong, other)
        with pytest.raises(InputError, match=message), registered_meshes(folder):
            pass
    wrong.unlink()
    save_shape(folder / "b1.off", Shape(ball.points[0], ball.faces))
    with pytest.raises(InputError, match="two meshes called b1"), registered_meshes(folder):
        pass
    for path in folder.glob("b*"):
        path.unlink()
    with pytest.raises(InputError, match="0 meshes"), registered_meshes(folder):
        pass
    for k in range(3):
        save_shape(folder / f"a{k}.ply", Shape(ball.points[0], np.empty((0, 3), np.int64)))
    with pytest.raises(InputError, match="no faces"), registered_meshes(folder):
        pass


def test_a_mirror_image_is_told_where_meshes_were_exported_as_their_files_have_them(folder: Path) -> None:
    given = ellipsoids(4, splits=1)
    save_shape(folder / "b2.ply", Shape(given.points[1] * [-1.0, 1.0, 1.0], given.faces[:, [0, 2, 1]]))
    with pytest.raises(InputError, match=r"b2\.ply does not have") as caught, registered_meshes(folder):
        pass
    assert "--place template" in caught.value.hint
    save_shape(folder / "b2.ply", Shape(given.points[1], given.faces[:-1]))
    with pytest.raises(InputError, match=r"b2\.ply does not have") as caught, registered_meshes(folder):
        pass
    assert "--place template" not in caught.value.hint


def test_a_group_is_a_list_of_names(tmp_path: Path) -> None:
    shapes = Registered(np.empty((2, 1, 3)), np.empty((0, 3), np.int64), ("a.b", "é c"), None, {"worse": "poor"})
    file = tmp_path / "group.txt"
    file.write_text("a.b.ply\n\n  é c \nworse.ply\n", encoding="utf-8")
    assert read_group(file, shapes) == ["a.b", "é c"]
    file.write_text("a.b\né d\n", encoding="utf-8")
    with pytest.raises(InputError, match="no shape called é d") as refused:
        read_group(file, shapes)
    assert refused.value.hint == "did you mean é c?"
    file.write_text("/\n")
    with pytest.raises(InputError, match="no shape called /") as refused:
        read_group(file, shapes)
    assert "--metadata TABLE" in (refused.value.hint or "")
    with pytest.raises(InputError):
        read_group(tmp_path / "gone.txt", shapes)


def test_names_of_files_have_the_suffix_of_the_format_and_any_unicode(tmp_path: Path) -> None:
    decomposed, composed = (unicodedata.normalize(form, "é") for form in ("NFD", "NFC"))
    names = (decomposed, "ct-1", "ct-2.seg")
    assert match_names(names, [f"{composed}.ply", "ct-*.nii.gz"]) == set(names)
    for word in (f"{decomposed}.1", f"{decomposed}.1.ply"):
        assert match_names([f"{composed}.1"], word) == {f"{composed}.1"}
    shapes = Registered(np.empty((3, 1, 3)), np.empty((0, 3), np.int64), names, None, {})
    file = tmp_path / "group.txt"
    file.write_text(f"ct-1.nii.gz\nct-2.seg.nrrd\n{composed}\n", encoding="utf-8")
    assert read_group(file, shapes) == ["ct-1", "ct-2.seg", decomposed]


def test_cut_shapes_among_whole_ones_are_told() -> None:
    given = ellipsoids(4, splits=1)
    names = ("a", "b", "c", "d")
    for cut in (("b",), ("b", "d")):
        shapes = Registered(given.points, given.faces, names, None, {}, partial=cut)
        with pytest.warns(MeshmatchWarning, match=f"^{', '.join(cut)}: cut, among whole shapes") as told:
            shapes.atlas()
        assert len(told) == 1 and shapes.cut == cut
    for alike in ((), names):
        shapes = Registered(given.points, given.faces, names, None, {}, partial=alike)
        assert shapes.cut == () and shapes.atlas().names == names


def test_sizes_that_are_far_apart_are_told() -> None:
    assert size_ratio([2.0, 1.0, 5.0]) == 5
    assert mixed_units(["a", "b", "c"], [2.0, 1.0, 5.0]) == "c is 5 times as large as b: do the files have one unit?"
    assert mixed_units(["a", "b"], [2.0, 1.0]) == mixed_units([], []) == ""
