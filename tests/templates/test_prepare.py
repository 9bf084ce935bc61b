"""A folder made ready: what is registered, what is left out and why, and what lies on the disk afterwards."""

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from meshmatch.api.prepare import PrepareConfig, Prepared, prepare
from meshmatch.errors import InputError, OptionError, OutputError
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates import prepared_folder
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepared_folder import card_frame, read_registered, read_samples
from meshmatch.templates.template import load_template

FEW = NodeConfig(strategy="uniform", K=60, radius=0.3)


def prepared(folder: Path, output: Path, nodes: NodeConfig = FEW, progress=None, **choices) -> Prepared:
    return prepare(folder, output, PrepareConfig(nodes, **choices), progress)


FAR = np.array([1e6, -3e5, 2e4])  # a surveyor's coordinates


def egg(sphere: Shape, n: int) -> np.ndarray:
    return sphere.verts * [1, 1 + 0.2 * n, 1]


@pytest.fixture
def folder(tmp_path: Path, sphere: Shape) -> Path:
    """Three registered shapes far from the origin."""
    shapes = tmp_path / "eggs"
    shapes.mkdir()
    for n in range(3):
        save_shape(shapes / f"egg{n}.obj", Shape(egg(sphere, n) + FAR, sphere.faces))
    return shapes


def test_registered_shapes_keep_their_correspondence(folder: Path, sphere: Shape, tmp_path: Path) -> None:
    seen: list[float] = []
    made = prepared(folder, tmp_path / "out", FEW, faces=600, progress=lambda _stage, _name, share: seen.append(share))
    template = load_template(tmp_path / "out" / "template.safetensors")
    assert template.hash == made.template.hash
    assert template.name == "eggs"
    assert template.shape.F <= 612
    stack = read_registered(tmp_path / "out", template)
    assert np.array_equal(stack, made.shapes)
    assert (stack.shape, stack.dtype) == ((3, template.shape.V, 3), np.float32)
    # each row is the same vertex on every shape; which one, the template's own positions tell
    rest = template.shape.verts / template.shape.verts.std() * sphere.verts.std()
    vertex = np.linalg.norm(rest[:, None] - sphere.verts, axis=2).argmin(1)
    for n in range(3):
        wanted = egg(sphere, n)[vertex]
        assert np.allclose(stack[n], wanted - wanted.mean(0), atol=2e-5)  # not lost at a million metres
    read, together = [n / 6 for n in (1, 2, 3)], [0.6 + 0.4 * n / 3 for n in (1, 2, 3)]
    assert seen == pytest.approx(read + together)
    assert made.names == ("egg0.obj", "egg1.obj", "egg2.obj")
    words = json.loads((tmp_path / "out" / "prepared.json").read_text())
    assert words["registered"] is True
    assert words["template"] == template.hash
    assert words["config"]["K"] == 60


def test_normalised_shapes_have_area_one_and_few_faces(folder: Path, tmp_path: Path) -> None:
    prepared(folder, tmp_path / "out", FEW, faces=600)
    files = sorted((tmp_path / "out" / "normalised").iterdir())
    assert [file.name for file in files] == ["egg0.ply", "egg1.ply", "egg2.ply"]
    for file in files:
        shape = load_shape(file)
        assert shape.area == pytest.approx(1, rel=0.01)  # of the file: decimation loses a little
        assert shape.F <= 612
        assert np.abs((shape.face_areas[:, None] * shape.verts[shape.faces].mean(1)).sum(0)).max() < 1e-3


def test_files_of_one_stem_do_not_overwrite_each_other(folder: Path, torus: Shape, tmp_path: Path) -> None:
    save_shape(folder / "egg0.ply", torus)
    prepared(folder, tmp_path / "out", FEW, align="none", mirror="no")
    files = sorted(file.name for file in (tmp_path / "out" / "normalised").iterdir())
    assert files == ["egg0.obj.ply", "egg0.ply.ply", "egg1.ply", "egg2.ply"]


def test_shapes_of_another_connectivity_are_not_registered(folder: Path, sphere: Shape, tmp_path: Path) -> None:
    save_shape(folder / "odd.ply", Shape(egg(sphere, 1), sphere.faces[:, [1, 2, 0]]))
    made = prepared(folder, tmp_path / "out", FEW, align="none", mirror="no")
    assert made.shapes.shape == (0, 642, 3)
    assert len(made.names) == 4
    with pytest.raises(InputError, match="do not share one connectivity") as caught:
        read_registered(tmp_path / "out", made.template)
    assert "registered" in caught.value.hint


def test_what_cannot_be_read_is_noted_and_left_out(folder: Path, tmp_path: Path, sphere: Shape) -> None:
    (folder / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\n")
    (folder / "empty.off").touch()
    (folder / "notes.txt").write_text("not a shape")
    np.save(folder / "point.npy", np.zeros((300, 3)))  # has no area
    for name in ("left/old", ".hidden", "tables"):
        (folder / name).mkdir(parents=True)
    save_shape(folder / "left" / "old" / "a.ply", sphere)
    save_shape(folder / ".hidden" / "a.ply", sphere)
    (folder / "tables" / "a.csv").touch()
    save_shape(folder / "dirty.obj", Shape(np.concatenate([sphere.verts, FAR[None]]), sphere.faces))
    made = prepared(folder, tmp_path / "out", FEW, align="none", mirror="no")
    notes = "\n".join(made.notes)
    for name in ("broken.ply left out", "empty.off left out", "point.npy left out", "dirty.obj: 1 vertex"):
        assert name in notes
    assert f"left out, as subfolders of {folder.name} are not searched: shapes of left" in made.notes
    assert len(made.names) == 4


def test_a_template_is_made_after_repair(tmp_path: Path, sphere: Shape, torus: Shape) -> None:
    """Every corner of an STL is a vertex of its own; a registered folder may carry vertices that no face uses."""
    shapes = tmp_path / "soup"
    shapes.mkdir()
    save_shape(shapes / "ball.stl", sphere)
    made = prepared(shapes, tmp_path / "out", FEW)
    assert made.template.shape.V == 642
    loose = tmp_path / "loose"
    loose.mkdir()
    for n in range(2):
        verts = np.concatenate([FAR[None], egg(sphere, n)])
        save_shape(loose / f"egg{n}.off", Shape(verts, sphere.faces + 1))
    made = prepared(loose, tmp_path / "out2", FEW)
    assert made.shapes.shape == (2, 642, 3)
    assert np.allclose(made.shapes[1], egg(sphere, 1) - egg(sphere, 1).mean(0), atol=1e-5)


def test_a_registered_shape_with_lost_positions_is_left_out(folder: Path, tmp_path: Path) -> None:
    text = (folder / "egg2.obj").read_text().splitlines()
    text[[line.startswith("v ") for line in text].index(True)] = "v nan nan nan"
    (folder / "egg2.obj").write_text("\n".join(text))
    made = prepared(folder, tmp_path / "out", FEW)
    assert len(made.shapes) == 2
    assert any("egg2.obj: not among the registered" in note for note in made.notes)


def test_a_template_of_clouds_is_a_mesh_or_one_of_them(folder: Path, tmp_path: Path, sphere: Shape) -> None:
    np.save(folder / "a_cloud.npy", sphere.verts)
    made = prepared(folder, tmp_path / "out", FEW, align="none", mirror="no")
    assert made.template.shape.F == 1280  # of the first mesh
    assert len(made.shapes) == 0
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    np.save(clouds / "a.npy", sphere.verts)
    made = prepared(clouds, tmp_path / "out2", FEW, align="none", mirror="no")
    assert made.template.shape.V > 600  # triangulated
    made = prepared(clouds, tmp_path / "out2", FEW, align="none", mirror="no", template=folder / "egg0.obj")
    assert made.template.shape.F == 1280
    assert made.names == ("a.npy",)


def test_no_usable_shape_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    with pytest.raises(InputError, match="no shapes in") as caught:
        prepared(tmp_path / "in", tmp_path / "out", FEW)
    assert ".ply" in caught.value.hint
    (tmp_path / "in" / "x.ply").touch()
    with pytest.raises(InputError, match="could be used") as caught:
        prepared(tmp_path / "in", tmp_path / "out", FEW)
    assert "x.ply left out" in caught.value.hint
    with pytest.raises(InputError, match="there is no file"):
        prepared(tmp_path / "nowhere", tmp_path / "out", FEW)


def test_an_output_that_cannot_be_made_is_told(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(OutputError, match="cannot make the folder"):
        prepared(folder, tmp_path / "taken", FEW)


def test_a_prepared_folder_is_replaced_whole_and_nothing_else_is(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    first = prepared(folder, out, FEW)
    (out / "nodes.png").write_bytes(b"a picture of before")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        stopped.setattr("meshmatch.api.prepare.save_template", stop)
        prepared(folder, out, FEW)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted({"out", folder.name})
    (folder / sorted(path.name for path in folder.iterdir())[-1]).unlink()
    second = prepared(folder, out, FEW)
    assert len(second.names) == len(first.names) - 1 == len(list((out / "normalised").iterdir()))
    assert not (out / "nodes.png").exists()
    (out / "notes.txt").write_text("the user's own")
    with pytest.raises(OutputError, match="is not empty"):
        prepared(folder, out, FEW)
    with pytest.raises(OptionError, match="into itself"):
        prepared(out / "normalised", out, FEW)


def test_labels_are_of_one_shape_and_for_parts(folder: Path, tmp_path: Path) -> None:
    parts = NodeConfig(strategy="parts", K=60, radius=0.3)
    with pytest.raises(OptionError, match="labels are of one shape"):
        prepared(folder, tmp_path / "out", parts, labels=np.zeros(5, int))
    with pytest.raises(OptionError, match="labels need each other"):
        prepared(folder, tmp_path / "out", parts)


def test_a_folder_of_another_template_or_none_is_refused(folder: Path, tmp_path: Path) -> None:
    made = prepared(folder, tmp_path / "out", FEW)
    other = prepared(folder, tmp_path / "other", NodeConfig(strategy="uniform", K=61, radius=0.3))
    with pytest.raises(InputError, match="prepared for another template") as caught:
        read_registered(tmp_path / "out", other.template)
    assert "`meshmatch prepare --template`" in caught.value.hint
    with pytest.raises(InputError, match="not a prepared folder") as caught:
        read_registered(tmp_path, made.template)
    assert "meshmatch prepare" in caught.value.hint
    (tmp_path / "other" / "prepared.json").write_text("[]")
    with pytest.raises(InputError, match="not a prepared folder"):
        read_registered(tmp_path / "other", other.template)
    with pytest.raises(InputError, match="not a prepared folder"):
        read_samples(tmp_path / "other", other.template)
    (tmp_path / "out" / "shapes.safetensors").write_bytes(b"?")
    with pytest.raises(InputError, match="not a prepared folder"):
        read_registered(tmp_path / "out", made.template)
    assert load_file(tmp_path / "other" / "shapes.safetensors")["verts"].shape[0] == 3


def test_correspondence_says_whether_registered_shapes_stand_alike(
    folder: Path, sphere: Shape, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert prepared(folder, tmp_path / "alike", FEW).align == "near"
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    save_shape(folder / "egg3.obj", Shape(egg(sphere, 2) @ quarter.T, sphere.faces))
    made = prepared(folder, tmp_path / "turned", FEW)
    assert (len(made.shapes), made.align) == (4, "rigid")
    assert card_frame(tmp_path / "turned") == {"orientation": "rigid", "scale": "area"}
    assert prepared(folder, tmp_path / "given", FEW, align="none").align == "none"
    assert card_frame(tmp_path / "nowhere") is None
    monkeypatch.setattr(prepared_folder, "SMALL_DATA", 4)
    assert prepared(folder, tmp_path / "many", FEW).align == "none"
    assert card_frame(tmp_path / "many") is None


def test_registered_shapes_are_learned_at_equal_areas_alone(folder: Path, tmp_path: Path) -> None:
    made = prepared(folder, tmp_path / "out", FEW, scale="sphere")
    with pytest.raises(InputError, match="prepared with --scale sphere") as caught:
        read_registered(tmp_path / "out", made.template)
    assert "--unsupervised" in caught.value.hint
    assert read_samples(tmp_path / "out", made.template).scale == "sphere"
    assert card_frame(tmp_path / "out") is None
