"""``meshmatch measure``, on copies of the body, which need no match."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.cli.conftest import Run, well

OWN = "name,kind,a,b,c\nlegs,angle,left toe,crotch,right toe\nreach,distance,left fingertip,right fingertip,\n"


@pytest.fixture
def copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Shape:
    """The body twice as large, and in millimetres."""
    monkeypatch.chdir(tmp_path)
    body = load_shape(bundled_folder() / "measurements" / "body.ply")
    Path("in").mkdir()
    save_shape("in/large.ply", Shape(2 * body.verts, body.faces))
    save_shape("in/small.ply", Shape(1000 * body.verts, body.faces))
    Path("own.csv").write_text(OWN)
    return body


def test_a_body_is_measured_in_the_unit_of_its_file(run: Run, copies: Shape) -> None:
    answer = well(run("measure", "body", "in/large.ply", "-o", "out.csv", "--picture", "out.png", "--json"))
    with Path("out.csv").open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert len(rows) == 30 and float(rows["waist girth"]["value"]) == pytest.approx(2 * 0.786, abs=0.01)
    record = answer.record
    assert record["measurements"]["waist girth"] == pytest.approx(float(rows["waist girth"]["value"]))
    assert (record["missing"], record["map"]) == (0, None) and Path("out.png").stat().st_size > 10_000
    assert "30 measurements of large.ply, in the unit of its file" in answer.err


def test_others_by_its_landmarks_with_their_lines(run: Run, copies: Shape) -> None:
    answer = well(run("measure", "body", "in/small.ply", "-o", "out.json", "--measurements", "own.csv"))
    legs, reach = json.loads(Path("out.json").read_text())["measurements"]
    assert (legs["kind"], reach["kind"]) == ("angle", "distance") and "angles in degrees" in answer.err
    assert legs["value"] == pytest.approx(40.3, abs=0.5) and reach["value"] == pytest.approx(1772, abs=5)
    assert np.linalg.norm(np.diff(reach["line"], axis=0)) == pytest.approx(reach["value"])


def test_a_single_measurement_is_in_the_singular(run: Run, copies: Shape) -> None:
    Path("own.csv").write_text("name,kind,a,b\nreach,distance,left fingertip,right fingertip\n")
    answer = well(run("measure", "body", "in/small.ply", "-o", "out.csv", "--measurements", "own.csv"))
    assert "wrote out.csv: 1 measurement of small.ply" in answer.err
    Path("in/large.ply").unlink()
    answer = well(run("measure", "body", "in", "-o", "out", "--measurements", "own.csv", "--table", "all.csv"))
    assert "wrote all.csv: 1 measurement of 1 shape\n" in answer.err


def test_a_name_that_no_landmark_has_fails_once(run: Run, copies: Shape) -> None:
    Path("own.csv").write_text(OWN.replace("crotch", "crotsch"))
    answer = run("measure", "body", "in", "-o", "out", "--measurements", "own.csv")
    assert answer.status == 1
    assert answer.err == "error: measurement legs: no landmark is called 'crotsch'\nhint: did you mean 'crotch'?\n"
    assert not Path("out").exists()


def test_all_are_one_table_whose_units_are_told(run: Run, copies: Shape) -> None:
    Path("own.csv").write_text(f"{OWN}none,distance,crown,crown\n")
    words = ("measure", "body", "in", "-o", "out", "--measurements", "own.csv", "--table", "all.csv")
    for suffix in (".csv", ".json"):
        answer = well(run(*words, "--format", suffix))
        assert "wrote all.csv: 3 measurements of 2 shapes" in answer.err
        assert "small is 500 times as large as large: do the files have one unit?" in " ".join(answer.err.split())
        header, large, small = Path("all.csv").read_text().splitlines()
        assert header == "name,legs,reach,none" and large.split(",")[1][:6] == small.split(",")[1][:6]
    assert "'.npz' is not a format for a table of measurements" in run(*words[:-1], "all.npz").err
    save_shape("mine.ply", copies)
    landmarks = str(bundled_folder() / "measurements" / "body-landmarks.csv")
    well(run("measure", "mine.ply", "in", "--landmarks", landmarks, *words[3:]))
    assert [row.split(",")[0] for row in Path("all.csv").read_text().splitlines()] == ["name", "mine", "large", "small"]


def test_what_the_map_does_not_know_is_missing(run: Run, copies: Shape) -> None:
    large = load_shape("in/large.ply")
    sure = np.where(copies.verts[:, 1] > 1.6, 0.1, 0.9)
    save_map("map.npz", VertexMap.between(copies, large, np.arange(copies.V), confidence=sure))
    answer = well(run("measure", "body", "in/large.ply", "-o", "out.csv", "--map", "map.npz", "--picture", "out.png"))
    assert "large.ply: 2 of 30 measurements are missing" in " ".join(answer.err.split())
    with Path("out.csv").open(newline="") as file:
        assert [row["name"] for row in csv.DictReader(file) if not row["value"]] == ["head girth", "head height"]


def test_a_folder_of_fits_need_not_hold_the_body(run: Run, copies: Shape, monkeypatch: pytest.MonkeyPatch) -> None:
    """And a target may be called as the word for it is."""
    asked = []
    monkeypatch.setattr(meshmatch.Collection, "holds", lambda self, shape: bool(asked.append(load_shape(shape).V)))
    Path("fits").mkdir()
    Path("fits/fits.csv").write_text("name,file,verdict\nbody,in/small.ply,good\nlarge,in/large.ply,good\n")
    well(run("measure", "body", "fits", "-o", "out", "--measurements", "own.csv", "--table", "all.csv"))
    assert [row.split(",")[0] for row in Path("all.csv").read_text().splitlines()] == ["name", "body", "large"]
    assert list(meshmatch.Transfers(meshmatch.measure, "body", "fits").files) == ["body", "large"]
    assert set(asked) == {copies.V}
