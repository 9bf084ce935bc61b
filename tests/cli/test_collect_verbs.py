"""``meshmatch fit`` and ``map`` as their users meet them."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from meshmatch.cli.collect import _report_distances
from meshmatch.cli.user_messages import Console
from meshmatch.collections.collection import Collection
from meshmatch.collections.export import Export, Fits, export
from meshmatch.collections.setting import Record
from meshmatch.collections.sources import frame_times
from meshmatch.collections.superimpose import Superimposed
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.maps.files import load_map
from meshmatch.maps.fit_files import read_fit, write_fit
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import Run
from tests.conftest import vtp_arrays

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory, remembered_fits: Any) -> Path:
    """Fits that the verb made, of two bodies and of a file that is none."""
    from meshmatch.cli import main

    folder = tmp_path_factory.mktemp("collection")
    (folder / "shapes").mkdir()
    for name in ("climber", "dancer"):
        shutil.copy(SAMPLES / f"{name}.ply", folder / "shapes")
    (folder / "shapes" / "empty.obj").write_text("")
    words = ["fit", str(folder / "shapes"), "-o", str(folder / "fits"), "--model", "human", "--jobs", "1", "-q"]
    assert main(words) == 0
    return folder / "fits"


def test_what_is_said(fits: Path, run: Run) -> None:
    """The second time nothing is left to do, and all is said again."""
    words = ["fit", fits.parent / "shapes", "-o", fits, "--jobs", "1"]
    answer = run(*words, "--json")
    assert answer.status == 0
    assert answer.err.splitlines()[0].split() == [
        "shape",
        "verdict",
        "trust",
        "residual",
        "distance",
        "up",
        "front",
        "vertices",
        "seconds",
    ]
    assert answer.err.count("verdict") == 1
    assert re.search(
        r"^dancer +good +[01]\.\d\d +\d\.\d % +0\.\d+ +\+y +\+z +4,002 +\d+\.\d$", answer.err, re.MULTILINE
    )
    assert re.search("^empty +failed$", answer.err, re.MULTILINE)
    assert "warning: empty: not fitted: empty.obj is empty (0 bytes)" in answer.err
    assert f"wrote 2 fits to {fits} (model human): 2 good, 1 failed" in answer.err
    record = answer.record
    assert record["verdicts"] == {"good": 2, "fair": 0, "poor": 0, "failed": 1}
    assert (record["model"], record["agreed"], record["seed"]) == ("human", 2, 0)
    strict = run(*words, "--strict", "-q")
    assert strict.status == 1 and "not every fit is to be trusted: 2 good, 1 failed" in strict.err


def test_fits_of_each_kind_are_counted_under_their_model(run: Run, tmp_path: Path) -> None:
    shapes, fits = [SAMPLES / f"{name}.ply" for name in ("dancer", "calf", "fox")], tmp_path / "fits"
    answer = run("fit", *shapes, "-o", fits, "--jobs", "1", "--refine", "none", "--alone", "--json")
    assert [line.partition("): ")[0] for line in answer.err.splitlines() if line.startswith("wrote")] == [
        f"wrote 2 fits to {fits} (model quadruped", f"wrote 1 fit to {fits / 'human'} (model human"
    ]  # fmt: skip
    assert sum(answer.record["verdicts"].values()) == 3


def test_lengths_have_one_unit_or_none_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    fit = Record("a", "a.ply", "good", distance=0.2, furthest=3.0, scale=90.0)
    _report_distances(Console(False), [fit, replace(fit, name="b", scale=110.0)], "none")
    assert "surfaces lie 0.2 apart on average, 3 at most, in the unit of the files" in capsys.readouterr().err
    _report_distances(Console(False), [fit, replace(fit, name="metres", scale=0.09)], "none")
    told = " ".join(capsys.readouterr().err.split())
    assert told == "warning: a is 1,000 times as large as metres: do the files have one unit?"


def test_copies_of_one_file_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    a = Record("a", "a.ply", "good", distance=0.2, furthest=3.0, scale=90.0, digest="1")
    _report_distances(Console(False), [a, replace(a, name="other", digest="2"), replace(a, name="again")], "none")
    assert "warning: a and again are copies of one file: an atlas counts each of them" in capsys.readouterr().err
    _report_distances(Console(False), [a, replace(a, name="b", digest="2")], "none")
    assert "warning" not in capsys.readouterr().err


def test_maps_of_names(fits: Path, run: Run, tmp_path: Path) -> None:
    answer = run("map", fits, "-o", tmp_path / "maps", "--to", "dancer", "--jobs", "1", "--json")
    assert answer.record["maps"] == 1
    found = load_map(tmp_path / "maps" / "climber" / "dancer.npz", SAMPLES / "climber.ply", SAMPLES / "dancer.ply")
    assert found.verdict == "good"
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("# both ways\nclimber, dancer\ndancer\tclimber\n\n")
    answer = run("map", fits, "-o", tmp_path / "some", "--pairs", pairs, "--format", ".csv", "-q", "--jobs", "1")
    assert (answer.status, answer.err) == (0, "")
    assert len(list((tmp_path / "some").rglob("*.csv"))) == 2


def test_a_map_of_two_names(fits: Path, run: Run, tmp_path: Path) -> None:
    """Into a folder or a file; shapes may be called by their files."""
    shapes = SAMPLES / "climber.ply", SAMPLES / "dancer.ply"
    answer = run("map", fits, "climber", shapes[1], "-o", tmp_path / "maps", "--jobs", "1", "-q")
    assert (answer.status, answer.err) == (0, "")
    assert [path.relative_to(tmp_path) for path in tmp_path.rglob("*.npz")] == [Path("maps", "climber", "dancer.npz")]
    answer = run("map", fits, *shapes, "-o", tmp_path / "one.npz", "--json")
    assert f"wrote {tmp_path / 'one.npz'}: climber to dancer, good" in answer.err
    record = answer.record
    assert (record["source"], record["target"], record["maps"]) == ("climber", "dancer", 1)
    one, other = (load_map(path, *shapes) for path in (tmp_path / "one.npz", tmp_path / "maps/climber/dancer.npz"))
    np.testing.assert_array_equal(one.index, other.index)


@pytest.mark.parametrize("suffix", ["vtp", ".obj"])
def test_registered_meshes_are_exported(fits: Path, run: Run, tmp_path: Path, suffix: str) -> None:
    answer = run("export", fits, "-o", tmp_path / "out", "--format", suffix, "--json")
    ending = f".{suffix.removeprefix('.')}"
    assert answer.record["files"] == [f"climber{ending}", f"dancer{ending}"]
    assert f"wrote {tmp_path / 'out'}: 2 shapes, 4995 vertices each" in " ".join(answer.err.split())
    climber, dancer = (load_shape(tmp_path / "out" / f"{name}{ending}") for name in ("climber", "dancer"))
    np.testing.assert_array_equal(climber.faces, dancer.faces)
    for name, shape in (("climber", climber), ("dancer", dancer)):
        file = load_shape(SAMPLES / f"{name}.ply")
        np.testing.assert_allclose(shape.bounds, file.bounds, atol=0.05 * file.diagonal)
        assert np.quantile(MappedMesh.of(file).query(shape.verts).distance, 0.9) < 0.005 * file.diagonal


def test_what_is_exported_stands_upright_in_a_glb(fits: Path, run: Run, tmp_path: Path) -> None:
    """If the file of the shape has no axes; the frames of a folder as the first of them."""
    assert run("export", fits, "-o", tmp_path / "out", "--format", "glb").status == 0
    own = Collection(fits).fit_of("climber")
    assert own.up == "+z"
    upright = own.points_in_file @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(load_shape(tmp_path / "out" / "climber.glb").verts, upright, atol=1e-5)
    frames = all_climber(fits, "b", "left/f2", "left/f10", sequence=True)
    frames = replace(
        frames, files={"b": "b.glb"}, fit_of=lambda name: replace(own, up="-x") if name == "left/f10" else own
    )
    export(tmp_path / "frames", frames, Export(".glb"), None)
    for name, verts in {"b": own.points_in_file, "left/f2": upright, "left/f10": upright}.items():
        np.testing.assert_allclose(load_shape(tmp_path / "frames" / f"{name}.glb").verts, verts, atol=1e-5)
    export(tmp_path / "template", frames, Export(".glb", "template"), None)
    verts = load_shape(tmp_path / "template" / "b.glb").verts
    np.testing.assert_allclose(verts, own.points * own.frame.scale, atol=1e-5)


def test_shapes_of_folders_are_exported_into_folders(fits: Path, tmp_path: Path) -> None:
    """Frames of a sequence with ParaView's list of each folder."""
    given = all_climber(fits, "b", "left/f2", "left/f10", sequence=True)
    files = export(tmp_path / "out", given, Export(".vtp"), None)
    assert files == ["b.vtp", "left/f2.vtp", "left/f10.vtp", "sequence.pvd", "left/sequence.pvd"]
    assert {str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*.*")} == set(files)
    frames = ElementTree.parse(tmp_path / "out" / "left" / "sequence.pvd").iter("DataSet")
    assert [(frame.get("timestep"), frame.get("file")) for frame in frames] == [("0", "f2.vtp"), ("1", "f10.vtp")]


def all_climber(folder: Path, *names: str, sequence: bool = False) -> Fits:
    """The same fit under several names."""
    own = Collection(folder)
    fit, places = own.fit_of("climber"), own.places_of("climber")
    files = dict.fromkeys(names, str(SAMPLES / "climber.ply"))
    return Fits(names, lambda name: fit, lambda name: places, files, own.template, sequence, frame_times(names))


def test_originals_are_exported_with_what_is_known_of_them(fits: Path, tmp_path: Path) -> None:
    given = all_climber(fits, "a")
    fit, file = given.fit_of("a"), load_shape(SAMPLES / "climber.ply")
    own = Shape(fit.points * fit.frame.scale, fit.faces)
    away, areas = 0.001 * file.diagonal, vertex_areas(own.verts, own.faces)
    thinner, weights = own.verts - away * own.vertex_normals, areas / areas.sum()
    mean = Superimposed(thinner - weights @ thinner, weights, None)
    np.save(tmp_path / "heights.npy", fit.points_in_file[:, 1])
    export(tmp_path / "out", given, Export(original=True, values=tmp_path / "heights.npy"), mean)
    np.testing.assert_array_equal(load_shape(tmp_path / "out" / "a.vtp").verts, file.verts)
    arrays = vtp_arrays(tmp_path / "out" / "a.vtp")
    assert set(arrays) == {"distance_to_mean", "displacement", "thickness", "label", "value_0"}
    assert np.median(arrays["distance_to_mean"]) == pytest.approx(away, rel=0.05)
    outwards = np.einsum("vi,vi->v", arrays["displacement"].reshape(-1, 3), file.vertex_normals)
    assert np.median(outwards) == pytest.approx(away, rel=0.1)
    assert np.quantile(np.abs(arrays["value_0"] - file.verts[:, 1]), 0.9) < 0.01 * file.diagonal
    assert len(np.unique(arrays["label"])) > 3
    assert 0.01 * file.diagonal < np.median(arrays["thickness"]) < 0.2 * file.diagonal


def test_originals_of_the_verb(fits: Path, run: Run, tmp_path: Path) -> None:
    answer = run("export", fits, "-o", tmp_path / "out", "--original", "--json")
    assert answer.record["files"] == ["climber.vtp", "dancer.vtp"], answer.err
    assert set(vtp_arrays(tmp_path / "out" / "climber.vtp")) == {"thickness", "label"}  # two shapes have no mean
    for words, told in {
        ("--values", "v.npy"): "values go with the original meshes",
        ("--original", "--format", "csv"): "original meshes are not exported as .csv",
        ("--original", "--place", "template"): "original meshes stay where their files have them",
    }.items():
        answer = run("export", fits, "-o", tmp_path / "none", *words)
        assert answer.status == 1 and told in answer.err and not (tmp_path / "none").exists()
    copy = shutil.copytree(fits, tmp_path / "copy")
    for damage in (b"name,file\n\xff\n", b"name\n" + b"x" * 200_000, None):
        (copy / "fits.csv").unlink() if damage is None else (copy / "fits.csv").write_bytes(damage)
        answer = run("export", copy, "-o", tmp_path / "none", "--original")
        assert answer.status == 1 and "fits.csv cannot be read" in answer.err, answer.err
    assert run("export", copy, "-o", tmp_path / "without-a-table").status == 0
    changed = replace(all_climber(fits, "a"), files={"a": str(SAMPLES / "dancer.ply")})
    with pytest.raises(InputError, match=r"dancer\.ply has changed since it was fitted"):
        export(tmp_path / "none", changed, Export(original=True), None)
    assert not (tmp_path / "none").exists()


def test_coordinates_are_exported_as_tables(fits: Path, run: Run, tmp_path: Path) -> None:
    collection = Collection(fits)
    (tmp_path / "table.csv").write_text("shape;sex;verdict;age\ndancer.ply;f;yes;62,5\nclimber;m;no;30\n")
    for suffix in (".csv", ".npz"):
        words = ["export", fits, "-o", tmp_path / suffix, "--format", suffix, "--place", "template", "-q"]
        answer = run(*words, "--metadata", tmp_path / "table.csv")
        assert answer.status == 0
        assert "columns of its own called verdict;" in answer.err
    with np.load(tmp_path / ".npz" / "coords.npz", allow_pickle=False) as found:
        points, faces, names = found["points"], found["faces"], found["names"].tolist()
        sizes, mirrored = found["centroid_size"].tolist(), found["mirrored"]
    np.testing.assert_allclose(sizes, np.sqrt(((points - points.mean(axis=1, keepdims=True)) ** 2).sum(axis=(1, 2))))
    rows = (tmp_path / ".csv" / "metadata.csv").read_text().splitlines()
    assert (
        rows
        == [
            "name,centroid_size,mirrored,verdict,sex,age",
            f"climber,{sizes[0]!r},0,good,m,30",
            f"dancer,{sizes[1]!r},0,good,f,62.5",
        ]
        and not mirrored.any()
    )
    assert names == ["climber", "dancer"] and points.shape == (2, len(collection.template.shape.verts), 3)
    np.testing.assert_array_equal(faces, collection.template.shape.faces)
    for name, own in zip(names, points, strict=True):
        fit = collection.fit_of(name)
        np.testing.assert_array_equal(own, fit.points * fit.frame.scale)
    head, *rows = (tmp_path / ".csv" / "coords.csv").read_text().splitlines()
    assert head.startswith("name,x0,y0,z0,x1,") and [row.split(",")[0] for row in rows] == names
    table = np.array([row.split(",")[1:] for row in rows], float).reshape(points.shape)
    np.testing.assert_array_equal(table, points)


def test_what_cannot_be_exported(fits: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    assert "wrl" in run("export", fits, "-o", out, "--format", "wrl").err
    assert run("export", tmp_path, "-o", out).status == 1 and not out.exists()
    named = run("export", fits, "-o", tmp_path / "points.npz")
    assert named.status == 1 and "name the folder points, and the files --format .npz" in named.err
    assert not (tmp_path / "points.npz").exists()
    (tmp_path / "made.obj").mkdir()
    assert run("export", fits, "-o", tmp_path / "made.obj").status == 0  # a folder already
    out.mkdir()
    (out / "mine.txt").write_text("kept")
    answer = run("export", fits, "-o", out)
    assert answer.status == 1 and (out / "mine.txt").read_text() == "kept" and len(list(out.iterdir())) == 1
    words = Collection._metadata
    monkeypatch.setattr(Collection, "_metadata", lambda self, name: words(self, name) | {"verdict": "poor"})
    assert "are poor" in run("export", fits, "-o", tmp_path / "none").err
    assert run("export", fits, "-o", tmp_path / "all", "--poor").status == 0


def test_shapes_of_another_kind_are_left_out(fits: Path, run: Run, tmp_path: Path) -> None:
    """They are in a folder of their own, and are found there."""
    mixed = tmp_path / "mixed"
    shutil.copytree(fits, mixed)
    (mixed / "human" / "fits").mkdir(parents=True)
    for name in ("fits.csv", "template.safetensors", "collection.json"):
        shutil.copy(fits / name, mixed / "human")
    template = Collection(fits).template
    for name in ("climber", "dancer"):
        file = mixed / "fits" / f"{name}.safetensors"
        shutil.copy(file, mixed / "human" / "fits")
        for animal in ("cow", "fox"):
            shutil.copy(file, file.with_name(f"{animal}.safetensors"))
        kept = read_fit(file, template)
        write_fit(file, replace(kept.fit, verdict="poor", model="quadruped"), words=kept.words)
    (mixed / "bird").mkdir()
    (mixed / "bird" / "fits.csv").touch()  # of shapes that could not be fitted
    said = f"warning: climber, dancer: of another kind, see {mixed / 'human'}"

    answer = run("map", mixed, "-o", tmp_path / "maps", "--all", "--jobs", "1")
    assert answer.status == 0 and answer.err.splitlines()[0] == said and answer.err.count("another kind") == 1
    assert sorted(file.stem for file in (tmp_path / "maps").rglob("*.npz")) == ["cow", "fox"]
    refused = run("map", mixed, "-o", tmp_path / "none", "--to", "dancer")
    assert refused.status == 1 and "dancer is of another kind" in refused.err
    answer = run("export", mixed, "-o", tmp_path / "out", "--poor")
    assert answer.err.splitlines()[0] == said and len(list((tmp_path / "out").iterdir())) == 2
    answer = run("atlas", mixed, "-o", tmp_path / "atlas")
    assert answer.err.splitlines()[0] == said and f"{mixed} holds 2 fits\n" in answer.err
    collection, shapes = Collection(mixed), [SAMPLES / f"{name}.ply" for name in ("climber", "dancer")]
    assert collection.names == ["cow", "fox"] and collection.holds(shapes[0])
    assert collection.maps_between(*shapes).forward.verdict == "good"


def test_what_cannot_be_mapped(fits: Path, run: Run, tmp_path: Path) -> None:
    def refused(*words: str | Path) -> str:
        answer = run("map", *words, "-o", tmp_path / "maps")
        assert answer.status == 1 and not (tmp_path / "maps").exists()
        return answer.err

    assert "no maps are chosen" in refused(fits)
    assert "more than one choice of maps" in refused(fits, "--all", "--to", "dancer")
    assert "more than one choice of maps" in refused(fits, "climber", "dancer", "--all")
    assert "one name was given" in refused(fits, "climber")
    assert "did you mean dancer?" in refused(fits, "climber", "dancr")
    assert "is not a folder of fits" in refused(fits.parent / "shapes", "--all")
    assert "did you mean dancer?" in refused(fits, "--to", "dancr")
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("climber dancer climber\n")
    assert "pairs.txt, line 1: not two names" in refused(fits, "--pairs", pairs)
    pairs.write_bytes(b"\x81\x00 climber dancer\n")
    assert "pairs.txt is not text" in refused(fits, "--pairs", pairs)
    pairs.write_text("# nothing\n")
    assert "holds no pair of names" in refused(fits, "--pairs", pairs)


def test_a_model_that_is_not_there_is_told_before_the_work(fits: Path, run: Run, tmp_path: Path) -> None:
    answer = run("fit", fits.parent / "shapes", "-o", tmp_path / "new", "--model", "humann")
    assert answer.status == 1 and not (tmp_path / "new").exists()


def test_transfers_and_measures_follow_fits(fits: Path, run: Run, tmp_path: Path) -> None:
    """Without matching again, and to the same end as along the map that was written."""
    climber, dancer = SAMPLES / "climber.ply", SAMPLES / "dancer.ply"
    values = tmp_path / "values.npy"
    np.save(values, load_shape(climber).verts[:, 2])
    words = "transfer-color", climber, dancer, "--values", values, "-o", tmp_path / "there.npy"
    answer = run(*words, "--map", fits, "--json")
    assert answer.status == 0, answer.err
    maps, other = Collection(fits).maps_between(climber, dancer), Collection(fits).maps_between(dancer, climber)
    assert np.array_equal(maps.forward.barycentric, other.backward.barycentric)  # one pair, whichever comes first
    followed = maps.backward.apply(np.load(values))
    assert np.allclose(np.load(tmp_path / "there.npy"), followed)
    assert run("evaluate", fits, climber, dancer, "--json").status == 0
    drawn = run("picture", climber, dancer, "--map", fits, "-o", tmp_path / "p.png", "--size", "80x60", "--no-names")
    assert drawn.status == 0 and "corresponding points in the same color" in drawn.err
    many = run(words[0], climber, fits, *words[3:5], "-o", tmp_path / "all", "--format", "npy", "--json")
    assert [(each["name"], each["map"]) for each in many.record["targets"]] == [
        ("climber", str(fits)), ("dancer", str(fits))
    ]  # fmt: skip
    assert np.allclose(np.load(tmp_path / "all" / "dancer.npy"), followed)
    np.save(values, np.zeros(load_shape(SAMPLES / "child.ply").V))
    other = run(words[0], SAMPLES / "child.ply", fits, *words[3:5], "-o", tmp_path / "others", "--model", "nowhere")
    assert other.status == 1 and "nowhere" in other.err.splitlines()[0]  # it would be matched
    np.save(values, load_shape(climber).verts[:, 2])
    stranger = run(*words[:2], SAMPLES / "child.ply", *words[3:], "--map", fits)
    assert stranger.status == 1 and "holds no fit of child" in stranger.err
    assert run(*words, "--map", tmp_path).status == 1
