"""The folder of an atlas: every file says what the atlas knows."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
from PIL import Image

from meshmatch.collections import atlas_pictures
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.atlas_files import AtlasResults, atlas_record, write_folder
from meshmatch.collections.atlas_pictures import draw_effect, draw_scores
from meshmatch.collections.measures import Measures, measure_atlas
from meshmatch.collections.permutation import PlaceTests
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from tests.collections.ellipsoids import AXES, ellipsoids
from tests.conftest import icosphere, vtp_arrays


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.render.picture.HEIGHT", 120)


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    given = ellipsoids(8, splits=1)
    return Atlas.of(given.points, given.faces, [f"é, {k}.ply" for k in range(8)])


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pictures and charts, which have tests of their own."""
    for name in ("render_shapes", "draw_panels", "draw_histogram", "draw_scree", "draw_dots"):
        monkeypatch.setattr(f"meshmatch.collections.atlas_pictures.{name}", lambda *_, **__: None)


def table(path: Path) -> tuple[list[str], list[list[str]]]:
    with path.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    return head, rows


def glb(path: Path) -> tuple[dict, list[np.ndarray]]:
    """The document of a glb, and its accessors as arrays, read by the specification."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    body = data[28 + length :]
    arrays = []
    for each in document["accessors"]:
        view = document["bufferViews"][each["bufferView"]]
        kind, width = {5126: "<f4", 5125: "<u4"}[each["componentType"]], {"VEC3": 3, "SCALAR": 1}[each["type"]]
        arrays.append(np.frombuffer(body, kind, each["count"] * width, view["byteOffset"]).reshape(-1, width))
    return document, arrays


def test_every_file_says_what_the_atlas_knows(tmp_path: Path, atlas: Atlas) -> None:
    given = ellipsoids(8, splits=1)
    measures = measure_atlas(atlas, given.points, samples=2)
    comparison = atlas.compare(atlas.names[:4], atlas.names[4:])
    explained = atlas.anova("form ~ log(size)", permutations=20)
    findings = AtlasResults(measures, comparison, ("thin", "thick"), explained, 2, 7)
    names = write_folder(tmp_path, atlas, findings, rotation=np.eye(3), title="eggs")
    assert names == sorted(path.name for path in tmp_path.iterdir())
    assert np.array_equal(Atlas.load(tmp_path).modes, atlas.modes)
    assert np.allclose(load_shape(tmp_path / "mean.ply").verts, atlas.mean)
    head, rows = table(tmp_path / "scores.csv")
    assert head[:4] == ["name", "size", "distance", "mode_1"]
    assert tuple(row[0] for row in rows) == atlas.names
    numbers = np.array([[float(cell) for cell in row[1:]] for row in rows])
    assert np.allclose(numbers, np.column_stack([atlas.sizes, atlas.distances, atlas.scores]), rtol=1e-5, atol=1e-6)
    head, rows = table(tmp_path / "components.csv")
    assert head[:3] == ["name", "PC1", "PC2"] and tuple(row[0] for row in rows) == atlas.names
    numbers = np.array([[float(cell) for cell in row[1:]] for row in rows])
    assert np.allclose((numbers**2).sum(axis=0) / (len(numbers) - 1), atlas.variances, rtol=1e-4)
    apart = np.load(tmp_path / "distances.npy")
    assert apart.shape == (len(atlas.mean), 8)
    assert np.allclose(apart[:, 3], atlas.distance_from_mean(atlas.names[3]), atol=1e-6)
    head, rows = table(tmp_path / "measures.csv")
    assert head[:3] == ["modes", "compactness", "generalisation"]
    assert [int(row[0]) for row in rows] == measures.counts.tolist()
    assert [float(row[2]) for row in rows] == pytest.approx(measures.generalisation, rel=1e-5)
    head, rows = table(tmp_path / "groups.csv")
    assert len(rows) == len(atlas.mean)
    assert [float(row[head.index("p_corrected")]) for row in rows] == pytest.approx(comparison.p_corrected, rel=1e-5)
    arrays = vtp_arrays(tmp_path / "groups.vtp")
    assert list(arrays) == ["difference", "along_normal", "statistic", "p", "p_corrected", "p_fdr"]
    assert np.array_equal(arrays["difference"].reshape(-1, 3), comparison.difference)
    assert np.array_equal(arrays["p_corrected"], comparison.p_corrected)
    arrays = vtp_arrays(tmp_path / "mean.vtp")
    assert np.allclose(arrays["mode_2"].reshape(-1, 3), atlas.deviations[1] * atlas.modes[1])
    every = np.linalg.norm(atlas.offsets(atlas.scores), axis=2)
    assert np.allclose(arrays["spread"], np.sqrt((every**2).sum(axis=0) / (len(every) - 1)), rtol=1e-6)
    assert np.allclose(load_shape(tmp_path / "mean.vtp").verts, atlas.mean)
    samples = sorted((tmp_path / "samples").iterdir())
    assert [path.name for path in samples] == ["sample-000.ply", "sample-001.ply"]
    assert np.allclose(load_shape(samples[1]).verts, atlas.sample(2, 7)[1].verts)
    told = json.loads((tmp_path / "atlas.json").read_text())
    assert told == json.loads(json.dumps(atlas_record(atlas, findings)))
    assert told["groups"]["names"] == ["thin", "thick"]
    assert told["groups"]["labellings"] == 70
    assert told["seed"] == 7
    assert told["measures"]["counts"] == measures.counts.tolist()
    assert "<title>eggs</title>" in (tmp_path / "page.html").read_text(encoding="utf-8")
    pictures = ["modes", "distances", "groups", "histogram", "measures", "scree", "components", "allometry"]
    for name in [*pictures, "effect-1-log-size"]:
        with Image.open(tmp_path / f"{name}.png") as image:
            assert np.asarray(image.convert("L")).std() > 5, name


def test_pictures_of_effects_have_names_in_plain_letters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    effect = SimpleNamespace(coefficients=("Gruppe: ödem",), along_normal=(np.zeros(3),), places=object())
    drawn: list[str] = []
    monkeypatch.setattr(atlas_pictures, "draw_effect", lambda path, *_: drawn.append(path.name))
    found: Any = SimpleNamespace(table=SimpleNamespace(effects=[effect]))
    atlas_pictures.draw_effects(tmp_path, icosphere(0), found, np.eye(3))
    assert drawn == ["effect-1-gruppe-odem.png"]


@pytest.mark.parametrize("kind", ["svg", "pdf"])
def test_the_ends_of_the_first_modes_are_drawn(tmp_path: Path, atlas: Atlas, kind: Literal["svg", "pdf"]) -> None:
    draw_scores(tmp_path, atlas, [""] * len(atlas.names), kind, np.eye(3))
    drawn = (tmp_path / f"components.{kind}").read_bytes()
    assert drawn.count(b"<image" if kind == "svg" else b"/Subtype /Image") >= 4


def test_morph_targets_are_the_modes(tmp_path: Path, atlas: Atlas, undrawn: None) -> None:
    write_folder(tmp_path, atlas, rotation=np.eye(3))
    document, arrays = glb(tmp_path / "modes.glb")
    (mesh,) = document["meshes"]
    (primitive,) = mesh["primitives"]
    names = mesh["extras"]["targetNames"]
    assert names[:4] == ["mode 1, +2 sd", "mode 1, -2 sd", "mode 2, +2 sd", "mode 2, -2 sd"]
    assert mesh["weights"] == [0] * len(names)
    assert len(primitive["targets"]) == len(names) == 2 * len(atlas.modes)
    base = arrays[primitive["attributes"]["POSITION"]]
    assert np.allclose(base, atlas.mean, atol=1e-6)
    for k, target in enumerate(primitive["targets"]):
        moved = arrays[target["POSITION"]]
        accessor = document["accessors"][target["POSITION"]]
        assert np.allclose(accessor["max"], moved.max(axis=0))
        sign = -1 if k % 2 else 1
        assert np.allclose(moved, sign * 2 * atlas.deviations[k // 2] * atlas.modes[k // 2], atol=1e-6)
        normals = arrays[primitive["attributes"]["NORMAL"]] + arrays[target["NORMAL"]]
        assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert np.allclose(load_shape(tmp_path / "modes.glb").verts, atlas.mean, atol=1e-6)


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_same_atlas_gives_the_same_bytes(
    tmp_path: Path, atlas: Atlas, drawn: bool, request: pytest.FixtureRequest
) -> None:
    """And what was not asked for is not there."""
    if not drawn:
        request.getfixturevalue("undrawn")
    folders = [tmp_path / name for name in "ab"]
    for folder in folders:
        folder.mkdir()
        write_folder(folder, atlas)
    first, second = ({path.name: path.read_bytes() for path in folder.iterdir()} for folder in folders)
    assert first == second
    assert not {"measures.csv", "measures.png", "groups.csv", "groups.vtp", "groups.png", "samples"} & set(first)


@pytest.mark.parametrize(("statistic", "sure"), [(1.0, True), (-1.0, True), (1.0, False)])
def test_an_effect_is_seen_from_where_it_is(tmp_path: Path, statistic: float, sure: bool) -> None:
    """A bump on the far side of a ball; the first panel shows it, and the last but one if that is sure, the others are
    grey or blank. Where the test is surest is another matter.
    """
    ball = ellipsoids(1, splits=3, spread=np.zeros(3))
    mean = Shape(ball.points[0], ball.faces)
    away = np.array([-0.6, 0.0, -0.8])
    bump = np.exp(-20 * np.square(mean.verts / AXES - away).sum(axis=1))
    p = np.where(sure & (bump > 0.5), 0.01, 1.0)
    tested = PlaceTests(statistic * bump, p, p, np.ones_like(p), bump)
    draw_effect(tmp_path / "a.png", mean, "bump", bump, tested, np.eye(3))
    with Image.open(tmp_path / "a.png") as image:
        pixels = np.asarray(image.convert("RGB"), int)[: image.height * 2 // 3]
    red = np.array_split(pixels[:, :, 0] - pixels[:, :, 2] > 80, 6, axis=1)
    assert [bool(panel.sum() > 20) for panel in red] == [True, False, False, False, sure, False]


def test_no_charts_without_matplotlib(tmp_path: Path, atlas: Atlas, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.collections.atlas_files.find_spec", lambda name: None)
    nothing = np.zeros(1)
    empty = Measures(np.ones(1, np.int64), *(7 * [nothing]), 1, 0, 1)
    names = write_folder(tmp_path, atlas, AtlasResults(empty))
    assert "histogram.png" not in names
    assert "measures.csv" in names
