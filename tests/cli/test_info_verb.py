"""`info` says what a file holds, and writes nothing."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import meshmatch
from meshmatch.collections.select_setting import SCHEMA
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.cli.conftest import Run
from tests.fitting.eggs import egg_model, write_model


def record(run: Run, file: Path) -> dict[str, object]:
    answer = run("info", file, "--json")
    assert answer.out.count("\n") == 1
    return answer.record


def test_a_mesh(run: Run, two: tuple[Path, Path]) -> None:
    found = record(run, two[0])
    assert (found["kind"], found["vertices"], found["faces"]) == ("mesh", 642, 1280)
    assert found["size"] == pytest.approx([2.0, 2.0, 2.0], abs=0.1)
    assert found["watertight"] is found["repaired_watertight"] is True
    assert found["repair"] == []
    assert found["hash"] == load_shape(two[0]).hash


def test_a_mesh_that_needs_repair(run: Run, tmp_path: Path, sphere: Shape) -> None:
    faces = np.concatenate([sphere.faces[1:], sphere.faces[-1:], [[0, 0, 1]]])
    save_shape(tmp_path / "bad.ply", Shape(sphere.verts, faces))
    before = (tmp_path / "bad.ply").read_bytes()
    found = record(run, tmp_path / "bad.ply")
    assert found["watertight"] is False
    assert found["faces"] == 1281
    assert found["repaired_faces"] == 1279
    assert len(found["repair"]) >= 2  # type: ignore[arg-type]
    assert (tmp_path / "bad.ply").read_bytes() == before
    shown = run("info", tmp_path / "bad.ply").out
    assert all(note in shown for note in found["repair"])  # type: ignore[attr-defined]


def test_a_seam_is_no_hole(run: Run, tmp_path: Path, sphere: Shape) -> None:
    verts = sphere.verts[sphere.faces[:100]].reshape(-1, 3)  # a hundred triangles with corners of their own
    apart = np.concatenate([sphere.faces[100:], 642 + np.arange(300).reshape(-1, 3)])
    save_shape(tmp_path / "seam.ply", Shape(np.concatenate([sphere.verts, verts]), apart))
    found = record(run, tmp_path / "seam.ply")
    assert (found["watertight"], found["repaired_watertight"]) == (False, True)
    save_shape(tmp_path / "hole.ply", Shape(sphere.verts, sphere.faces[1:]))
    assert record(run, tmp_path / "hole.ply")["repaired_watertight"] is False


def test_parts_holes_axis_and_unit(run: Run, tmp_path: Path, sphere: Shape) -> None:
    tall = sphere.verts * [12, 18, 88]  # as long as a person in centimetres, along z
    twice = np.concatenate([tall, tall + np.array([45.0, 0, 0])])
    faces = np.concatenate([sphere.faces[1:], sphere.faces + 642])
    save_shape(tmp_path / "two.ply", Shape(twice, faces))
    found = record(run, tmp_path / "two.ply")
    assert (found["parts"], found["open_edges"], found["non_manifold_edges"]) == (2, 3, 0)
    assert found["watertight"] is False
    assert found["longest_along"] == "z"
    assert found["unit_if_a_person"] == "centimetres"
    save_shape(tmp_path / "ball.ply", sphere)
    round_one = record(run, tmp_path / "ball.ply")
    assert (round_one["parts"], round_one["open_edges"], round_one["watertight"]) == (1, 0, True)
    assert round_one["longest_along"] is None
    shown = run("info", tmp_path / "ball.ply").out
    assert "longest along" in shown
    assert "unknown" in shown


@pytest.mark.parametrize(
    ("length", "unit"),
    [(1.75, "metres"), (175, "centimetres"), (1750, "millimetres"), (69, "inches"), (5.7, "feet"), (12, None)],
)
def test_unit_of_a_person(run: Run, tmp_path: Path, sphere: Shape, length: float, unit: str | None) -> None:
    save_shape(tmp_path / "a.ply", Shape(sphere.verts * [0.1 * length, 0.5 * length, 0.1 * length], sphere.faces))
    found = record(run, tmp_path / "a.ply")
    assert (found["longest_along"], found["unit_if_a_person"]) == ("y", unit)


def test_what_is_too_stout_for_a_person_has_no_such_unit(run: Run, tmp_path: Path, sphere: Shape) -> None:
    """As a bone of a hand's length, which would be a child in centimetres."""
    save_shape(tmp_path / "bone.ply", Shape(sphere.verts * [40.0, 45.0, 60.0], sphere.faces))
    assert record(run, tmp_path / "bone.ply")["unit_if_a_person"] is None
    assert "person" not in run("info", tmp_path / "bone.ply").out


def test_nothing_to_repair_is_said(run: Run, two: tuple[Path, Path]) -> None:
    assert "nothing to do" in run("info", two[0]).out


@pytest.mark.parametrize("suffix", [".npy", ".xyz", ".ply"])
def test_a_cloud(run: Run, tmp_path: Path, sphere: Shape, suffix: str) -> None:
    save_shape(tmp_path / f"cloud{suffix}", Shape(sphere.verts, np.empty((0, 3), int)))
    found = record(run, tmp_path / f"cloud{suffix}")
    assert (found["kind"], found["vertices"], found["faces"]) == ("point cloud", 642, 0)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".csv", ".txt", ".mat", ".json"])
def test_a_map(run: Run, tmp_path: Path, sphere: Shape, suffix: str) -> None:
    save_map(tmp_path / f"map{suffix}", VertexMap.identity(sphere))
    found = record(run, tmp_path / f"map{suffix}")
    assert (found["kind"], found["source_vertices"]) == ("map", 642)
    assert found["target_vertices"] == (642 if suffix in (".npz", ".mat", ".json") else None)
    assert "index[i]" in str(found["direction"])
    assert ("unknown" in run("info", tmp_path / f"map{suffix}").out) == (suffix in (".npy", ".csv", ".txt"))


def test_a_template(run: Run) -> None:
    found = record(run, bundled_folder() / "human" / "human-T.safetensors")
    assert (found["kind"], found["name"], found["pose"]) == ("template", "human-T", "T")
    assert "head" in found["parts"]  # type: ignore[operator]


@pytest.mark.parametrize("name", ["empty.ply", "empty.npy", "empty.safetensors", "empty.npz", "what.docx"])
def test_a_file_that_is_none_of_these_is_an_error(run: Run, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"")
    answer = run("info", tmp_path / name)
    assert answer.status == 1
    assert answer.out == ""
    assert name in answer.err


def test_what_is_no_map_is_called_what_it_is(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("name;x;y;z\ntip;0,5;1,5;2\nend;;;\n")
    (tmp_path / "a.fcsv").write_text("# columns = id,x,y,z,label\n1,0,0,1,tip\n2,,,,end\n")
    points = [{"label": "tip", "position": [0, 0, 1]}, {"label": "end", "positionStatus": "undefined"}]
    (tmp_path / "a.mrk.json").write_text(json.dumps({"markups": [{"controlPoints": points}]}))
    for name in ("a.csv", "a.fcsv", "a.mrk.json"):
        found = record(run, tmp_path / name)
        assert (found["kind"], found["names"], found["missing"]) == ("landmarks", ["tip", "end"], 1)
    np.savez(tmp_path / "a.npz", names=["smile"], moves=np.zeros((1, 3, 3)))
    assert record(run, tmp_path / "a.npz")["kind"] == "blendshapes"
    (tmp_path / "t.csv").write_text("name;age\nanna;30,5\n")
    refused = run("info", tmp_path / "t.csv")
    assert refused.status == 1 and "'anna' is not a number" in refused.err and "decimal comma" not in refused.err


def test_folders_are_called_what_they_are(run: Run, tmp_path: Path) -> None:
    assert "fit`, `prepare` or `atlas` made" in run("info", tmp_path).err
    words = ("schema", "template", "model", "only", "without", "sequence", "fit")
    (tmp_path / "collection.json").write_text(
        json.dumps(dict.fromkeys(words, "") | {"schema": SCHEMA, "model": "hand"})
    )
    (tmp_path / "fits.csv").write_text("name,verdict\na,good\nb,poor\nc,good\n")
    found = record(run, tmp_path)
    assert (found["kind"], found["model"], found["shapes"]) == ("fits of a collection", "hand", ["2 good", "1 poor"])
    (tmp_path / "atlas").mkdir()
    (tmp_path / "atlas" / "atlas.npz").touch()
    assert record(run, tmp_path / "atlas")["kind"] == "atlas"


def test_a_prepared_folder(run: Run, tmp_path: Path, sphere: Shape) -> None:
    (tmp_path / "shapes").mkdir()
    for number in range(3):
        save_shape(tmp_path / "shapes" / f"{number}.ply", Shape(sphere.verts * (1, 1, 1 + 0.1 * number), sphere.faces))
    sizes = ("--nodes", "60", "--radius", "0.3")
    assert run("prepare", tmp_path / "shapes", "-o", tmp_path / "made", *sizes).status == 0
    found = record(run, tmp_path / "made")
    assert (found["kind"], found["shapes"], found["registered"]) == ("prepared folder", 3, True)
    assert (found["align"], found["scale"], found["landmarks"]) == ("near", "area", 0)
    assert (found["template_vertices"], found["template_nodes"]) == (sphere.V, 60)
    shown = run("info", tmp_path / "made").out
    assert "prepared folder" in shown and "registered" in shown
    assert run("prepare", tmp_path / "shapes" / "0.ply", "-o", tmp_path / "one", *sizes).status == 0
    assert record(run, tmp_path / "one")["kind"] == "template"
    (tmp_path / "made" / "prepared.json").write_text("{")
    assert "is not a prepared folder" in run("info", tmp_path / "made").err


def test_a_fit_and_a_model(run: Run, tmp_path: Path) -> None:
    egg = egg_model()
    write_model(egg, tmp_path / "egg")
    fit = meshmatch.register(egg.template.shape, model=egg, config=meshmatch.FitConfig(refine="none"))
    meshmatch.save_fit(tmp_path / "fit.safetensors", fit)
    found = record(run, tmp_path / "fit.safetensors")
    assert (found["kind"], found["model"], found["verdict"]) == ("fit", "egg", fit.verdict)
    assert found["reasons"] == [str(reason) for reason in fit.reasons]
    found = record(run, tmp_path / "egg")
    assert (found["kind"], found["name"], found["category"]) == ("model", "egg", "eggs")
    done = run("info", tmp_path / "egg" / "weights.safetensors")
    assert done.status == 1 and "contains the weights of a model" in done.err
    assert record(run, tmp_path / "egg" / "template.safetensors")["kind"] == "template"


def test_materials_and_their_textures(run: Run, tmp_path: Path, sphere: Shape) -> None:
    save_shape(tmp_path / "plain.obj", sphere)
    assert "materials" not in record(run, tmp_path / "plain.obj")
    (tmp_path / "dressed.mtl").write_text("newmtl cloth\nmap_Kd cloth.png\nnewmtl skin\nKd 1 0 0\n")
    corners = "mtllib dressed.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
    (tmp_path / "dressed.obj").write_text(corners + "usemtl cloth\nf 1/1 2/2 3/3\nusemtl skin\nf 1 2 4\n")
    Image.new("RGB", (20, 10)).save(tmp_path / "cloth.png")
    found = record(run, tmp_path / "dressed.obj")
    assert found["materials"] == ["cloth (a texture of 20 x 10)", "skin (one color)"]
    assert "skin (one color)" in run("info", tmp_path / "dressed.obj").out
    (tmp_path / "cloth.png").write_bytes(b"no image")
    (why,) = record(run, tmp_path / "dressed.obj")["materials"]  # type: ignore[misc, attr-defined]
    assert "cloth.png cannot be read as an image" in why
