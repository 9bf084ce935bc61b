"""A collection is fitted, stopped, gone on with and mapped."""

import csv
import json
import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file
from scipy.spatial.transform import Rotation

import meshmatch
from meshmatch.cli import main
from meshmatch.collections.fit_all import file_table
from meshmatch.collections.setting import Record, clear_caches
from meshmatch.collections.sources import find_sources
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError, MeshmatchError, MeshmatchWarning, OptionError, OutputError, TemplateError
from meshmatch.experiments.hostile.learned import write_eggs
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.solve.agreement import agree_step
from meshmatch.fitting.solve.system import node_system
from meshmatch.locks import locked
from meshmatch.maps.fit_files import read_fit, read_fit_header, write_fit
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import load_template
from tests.conftest import icosphere
from tests.fitting.small_viscous import SmallViscous, use_small_fits

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"
NAMES = ["climber", "dancer", "turned"]
QUICK = meshmatch.FitConfig(refine="none", copies=16, careful=1)
pytestmark = pytest.mark.usefixtures("remembered_fits")


@pytest.fixture(scope="module")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two bodies, one of them also on its side and ten times as large, and a file that is none."""
    folder = tmp_path_factory.mktemp("shapes")
    for name in ("climber", "dancer"):
        shutil.copy(SAMPLES / f"{name}.ply", folder)
    dancer = load_shape(SAMPLES / "dancer.ply")
    save_shape(folder / "turned.obj", Shape(10 * dancer.verts[:, [1, 2, 0]], dancer.faces))
    (folder / "broken.ply").write_text("ply\nnothing of the sort\n")
    (folder / "turned.truth.npy").write_bytes(b"not of this format")
    return folder


@pytest.fixture(scope="module")
def made(
    shapes: Path, tmp_path_factory: pytest.TempPathFactory, remembered_fits: Callable
) -> tuple[Path, tuple[Record, ...]]:
    folder = tmp_path_factory.mktemp("out") / "fits"
    told: list[Record] = []
    found = meshmatch.Collection(folder, workers=1).fit(shapes, model="human", tell=told.append)
    finished = [replace(record, inverted=0.0, volume=0.0) for record in found.records]  # of the fits that agreed
    assert finished == [replace(record, inverted=0.0, volume=0.0) for record in told] and found.agreed == 3
    return folder, found.records


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((folder / "fits").rglob("*.safetensors"))}


def test_a_bad_shape_is_told_and_stops_nobody(made: tuple[Path, tuple[Record, ...]]) -> None:
    folder, records = made
    assert [record.name for record in records] == ["broken", *NAMES]
    assert [record.verdict for record in records] == ["failed", "good", "good", "good"]
    assert "broken.ply" in records[0].reasons
    with open(folder / "fits.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["broken", *NAMES]
    assert 0 <= float(rows[1]["inverted"]) < 0.003 and 0 < float(rows[1]["volume"]) < 0.4
    assert float(rows[1]["residual"]) == records[1].residual and rows[1]["file"].endswith("/climber.ply")
    assert meshmatch.Collection(folder).names == NAMES


def test_a_body_on_its_side_is_the_same_body(made: tuple[Path, tuple[Record, ...]]) -> None:
    collection = meshmatch.Collection(made[0])
    found = collection.map("dancer", "turned")
    assert (found.source_up, found.target_up) == ("+y", "+x")  # by which transfers turn a glb upright
    dancer = load_shape(SAMPLES / "dancer.ply")
    off = np.linalg.norm(dancer.verts[found.index] - dancer.verts, axis=1) / np.sqrt(dancer.area)
    assert off.mean() < 0.01
    assert (found.source, found.target, found.verdict) == ("dancer", "turned", "good")
    assert found.source_hash == dancer.hash and found.confidence.mean() > 0.8
    assert (collection.map("dancer", "dancer").index == np.arange(dancer.V)).mean() > 0.95


def test_a_fit_that_was_read_is_the_fit(made: tuple[Path, tuple[Record, ...]]) -> None:
    collection = meshmatch.Collection(made[0])
    fit, alone = collection.fit_of("dancer"), meshmatch.register(SAMPLES / "dancer.ply", model="human")
    assert (fit.verdict, fit.up, fit.front, fit.residual) == (alone.verdict, alone.up, alone.front, alone.residual)
    assert np.array_equal(fit.frame.rotation, alone.frame.rotation) and fit.frame.scale == alone.frame.scale
    moved = np.linalg.norm(fit.points - alone.points, axis=1)
    assert 0 < moved.mean() < 0.02  # it has agreed with the others
    model = meshmatch.load_model("human")
    system = node_system(model)
    assert fit.regularity == system.regularity(fit.vectors) != alone.regularity == system.regularity(alone.vectors)


def test_the_maps_are_close_to_those_of_a_pair(made: tuple[Path, tuple[Record, ...]]) -> None:
    pair = meshmatch.match(SAMPLES / "climber.ply", SAMPLES / "dancer.ply", model="human").map
    found = meshmatch.Collection(made[0]).map("climber", "dancer")
    dancer = load_shape(SAMPLES / "dancer.ply")
    apart = np.linalg.norm(dancer.verts[found.index] - dancer.verts[pair.index], axis=1) / np.sqrt(dancer.area)
    assert apart.mean() < 0.01


def test_nothing_is_done_twice_and_more_may_come(shapes: Path, tmp_path: Path) -> None:
    """Two processes, and a shape that comes later: the fits are those of one run in one process, bit for bit."""
    first, whole = tmp_path / "first", tmp_path / "whole"
    two = [shapes / "dancer.ply", shapes / "climber.ply"]
    collection = meshmatch.Collection(first, workers=2)
    collection.fit(two, model="human", config=QUICK)
    before = contents(first)
    times = {path: path.stat().st_mtime_ns for path in first.rglob("*.safetensors")}
    collection.fit(two, config=QUICK)
    assert {path: path.stat().st_mtime_ns for path in first.rglob("*.safetensors")} == times
    collection.fit(shapes, config=QUICK)
    meshmatch.Collection(whole, workers=1).fit(shapes, model="human", config=QUICK)
    assert contents(first) == contents(whole) != before and set(before) < set(contents(first))
    assert not (first / "agreeing").exists()


def test_an_agreement_goes_on_where_it_was_stopped(
    shapes: Path, made: tuple[Path, tuple[Record, ...]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole steps and parts of steps are not taken again."""
    taken: list[int] = []

    def counted(*arguments: Any) -> Any:
        taken.append(1)
        if len(taken) == 15:  # of three fits in groups of two: the second group of the fifth step
            raise KeyboardInterrupt
        return agree_step(*arguments)

    monkeypatch.setattr("meshmatch.collections.tasks.agree_step", counted)
    monkeypatch.setattr("meshmatch.collections.fit_all._GROUP", 2)
    stopped, straight = tmp_path / "stopped", tmp_path / "straight"
    with pytest.raises(KeyboardInterrupt):
        meshmatch.Collection(stopped, workers=1).fit(shapes, model="human")
    meshmatch.Collection(stopped, workers=1).fit(shapes)
    assert len(taken) == 3 * 12 + 1  # the one that was interrupted is taken twice
    meshmatch.Collection(straight, workers=1).fit(shapes, model="human")
    assert contents(stopped) == contents(straight) and not (stopped / "agreeing").exists()


def test_what_a_killed_run_left_is_swept_and_two_at_once_are_refused(
    shapes: Path, made: tuple[Path, tuple[Record, ...]]
) -> None:
    folder, _ = made
    left = [folder / "fits" / ".dancer.0a1b2c3d.safetensors", folder / ".fits.00000000.csv"]
    for path in left:
        path.write_bytes(b"half")
    mine = folder / ".mine.safetensors"
    mine.write_bytes(b"somebody's own")
    collection = meshmatch.Collection(folder, workers=1)

    def again(_: Record) -> None:
        with pytest.raises(OutputError, match="another process writes"):
            meshmatch.Collection(folder, workers=1).fit(shapes)

    collection.fit(shapes, tell=again)
    assert not any(path.exists() for path in left) and mine.exists()


def test_fits_alone_do_not_move(shapes: Path, tmp_path: Path) -> None:
    collection = meshmatch.Collection(tmp_path / "alone", workers=1)
    made = collection.fit(str(shapes / "[cd]*.ply"), model="human", agree=False)
    assert made.agreed == 0 and collection.names == ["climber", "dancer"]
    alone = meshmatch.register(SAMPLES / "climber.ply", model="human")
    assert np.array_equal(collection.fit_of("climber").points, alone.points)
    assert collection.places_of("climber").moved is None


def test_maps_are_written_once(made: tuple[Path, tuple[Record, ...]], tmp_path: Path) -> None:
    collection, folder = meshmatch.Collection(made[0], workers=1), tmp_path / "maps"
    assert collection.save_maps(folder) == 6
    written = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.npz"))
    assert written == [f"{a}/{b}.npz" for a in NAMES for b in NAMES if a != b]
    read = meshmatch.load_map(folder / "dancer" / "turned.npz", SAMPLES / "dancer.ply")
    assert np.array_equal(read.index, collection.map("dancer", "turned").index) and read.target_up == "+x"
    times = [path.stat().st_mtime_ns for path in sorted(folder.rglob("*.npz"))]
    assert collection.save_maps(folder, [("dancer", "turned")]) == 1
    assert collection.save_maps(folder, [("dancer", "turned")], suffix="npy") == 1
    assert (folder / "dancer" / "turned.npy").is_file()
    assert [path.stat().st_mtime_ns for path in sorted(folder.rglob("*.npz"))] == times


def test_what_a_killed_map_left_is_swept_and_two_at_once_are_refused(
    made: tuple[Path, tuple[Record, ...]], tmp_path: Path
) -> None:
    collection, maps = meshmatch.Collection(made[0], workers=1), tmp_path / "maps"
    half = maps / "climber" / ".dancer.0123abcd.npz"
    half.parent.mkdir(parents=True)
    half.write_bytes(b"half")
    with locked(maps / ".lock", "", ""), pytest.raises(OutputError, match="another process writes to"):
        collection.save_maps(maps, [("climber", "dancer")])
    assert half.exists()
    assert collection.save_maps(maps, [("climber", "dancer")]) == 1
    assert [path.name for path in half.parent.iterdir()] == ["dancer.npz"]


def test_what_is_wrong_is_said(made: tuple[Path, tuple[Record, ...]], shapes: Path, tmp_path: Path) -> None:
    folder, _ = made
    collection = meshmatch.Collection(folder)
    with pytest.raises(InputError, match="no fit of dancr") as error:
        collection.map("dancr", "climber")
    assert error.value.hint == "did you mean dancer?"
    with pytest.raises(OptionError, match="not a format"):
        collection.save_maps(tmp_path / "maps", suffix=".png")
    with pytest.raises(OptionError, match="another seed: 0, not 1"):
        collection.fit(shapes, config=meshmatch.FitConfig(seed=1))
    with pytest.raises(OptionError, match="another refine: nodes, not none"):
        collection.fit(shapes, config=meshmatch.FitConfig(refine="none"))
    with pytest.raises(InputError, match=r"cannot fit .* into itself"):
        meshmatch.Collection(shapes).fit(shapes)
    with pytest.raises(OptionError, match="another model"):
        collection.fit(shapes, model="quadruped")
    shutil.copytree(folder, tmp_path / "older")
    about = json.loads((folder / "collection.json").read_text())
    del about["fit"]["again"]  # a choice that there was not in 0.2.0
    (tmp_path / "older" / "collection.json").write_text(json.dumps(about))
    with pytest.raises(OptionError, match="made by another version of meshmatch"):
        meshmatch.Collection(tmp_path / "older").fit(shapes)
    with pytest.raises(InputError, match="not a folder of fits"):
        meshmatch.Collection(tmp_path).names  # noqa: B018
    with pytest.raises(InputError, match="no shapes"):
        meshmatch.Collection(tmp_path / "new").fit(tmp_path)
    with pytest.raises(InputError, match="two shapes are called dancer") as told:
        meshmatch.Collection(tmp_path / "new").fit([shapes / "dancer.ply", SAMPLES / "dancer.ply"])
    with pytest.raises(InputError, match=r"dancer\.ply is named 2 times"):
        meshmatch.Collection(tmp_path / "new").fit([shapes, shapes / "dancer.ply"])
    assert f"{SAMPLES}/dancer.ply" in told.value.message and "the folder that both folders are in" in told.value.hint
    with pytest.raises(MeshmatchError, match="none of 1 shape could"):
        meshmatch.Collection(tmp_path / "new").fit(shapes / "broken.ply", model="human")


def test_damaged_fits_are_refused(made: tuple[Path, tuple[Record, ...]], tmp_path: Path) -> None:
    template = meshmatch.Collection(made[0]).template
    whole = (made[0] / "fits" / "dancer.safetensors").read_bytes()
    broken = tmp_path / "dancer.safetensors"
    for data in (b"", whole[:1000], whole[:-1], whole.replace(b'"schema', b'"schemo', 1), b"\xff" * 100):
        broken.write_bytes(data)
        with pytest.raises(InputError):
            read_fit(broken, template)
    for words in ("[" * 100_000, "[1]", '{"schema": 1, "fit": [], "more": 3}'):
        save_file({"a": np.zeros(3)}, broken, {"fit": words})
        with pytest.raises(InputError):
            read_fit(broken, template)
    about = tmp_path / "about"
    about.mkdir()
    for text in ("[" * 100_000, "{}", "\x00", '{"schema": 2}'):
        (about / "collection.json").write_text(text)
        with pytest.raises(InputError, match=r"damaged|schema 2"):
            meshmatch.Collection(about).names  # noqa: B018
    whole_template = (made[0] / "template.safetensors").read_bytes()
    shutil.copytree(made[0], tmp_path / "copy")
    for data in (b"", whole_template[:1000], whole_template[:-1] + bytes([whole_template[-1] ^ 1])):
        (tmp_path / "copy" / "template.safetensors").write_bytes(data)
        clear_caches()
        with pytest.raises(TemplateError, match=r"of these fits, .*copy/template\.safetensors, cannot") as found:
            meshmatch.Collection(tmp_path / "copy").map("dancer", "climber")
        assert found.value.hint == "remove the folder, and fit again"
    size = 8 + int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8:size])
    about_fit = json.loads(header["__metadata__"]["fit"])
    about_fit["fit"]["scale"] = 10**400
    text = json.dumps(header | {"__metadata__": {"fit": json.dumps(about_fit)}}).encode()
    broken.write_bytes(len(text).to_bytes(8, "little") + text + whole[size:])
    with pytest.raises(InputError, match="too large"):
        read_fit(broken, template)
    del about_fit["fit"]["verdict"]
    text = json.dumps(header | {"__metadata__": {"fit": json.dumps(about_fit)}}).encode()
    broken.write_bytes(len(text).to_bytes(8, "little") + text + whole[size:])
    with pytest.raises(InputError, match="not a fit's file"):
        read_fit_header(broken)
    broken.write_bytes(whole)
    fit = read_fit(broken, template).fit
    for wrong in (
        replace(fit, verdict="fine"),
        replace(fit, seed="0"),
        replace(fit, frame=replace(fit.frame, scale=1e70)),
        replace(fit, points=1e200 * fit.points),
    ):
        write_fit(broken, wrong)
        with pytest.raises(InputError, match=r"invalid|cannot be"):
            read_fit(broken, template)
    numbers = whole.replace(b'\\"schema\\": 1', b'\\"schema\\": 9')
    assert numbers != whole
    broken.write_bytes(numbers)
    with pytest.raises(InputError, match="schema 9"):
        read_fit_header(broken)
    broken.write_bytes(whole)
    other = meshmatch.load_model("quadruped").template
    with pytest.raises(InputError, match="another template"):
        read_fit(broken, other)


def test_a_matcher_maps_fits_of_a_collection(made: tuple[Path, tuple[Record, ...]]) -> None:
    collection, matcher = meshmatch.Collection(made[0]), meshmatch.Matcher("human")
    climber, dancer = collection.fit_of("climber"), meshmatch.load_fit(made[0] / "fits" / "dancer.safetensors")
    found, known = matcher.map(climber, dancer), collection.map("climber", "dancer")
    for name in ("index", "barycentric", "confidence", "source_hash", "verdict"):
        assert np.array_equal(getattr(found, name), getattr(known, name)), name
    assert repr(climber).startswith("Fit('climber', model 'human'")


def test_maps_of_unfinished_fits_are_refused(made: tuple[Path, tuple[Record, ...]], tmp_path: Path) -> None:
    folder = tmp_path / "fits"
    shutil.copytree(made[0], folder)
    collection = meshmatch.Collection(folder)
    finished = collection.fit_of("turned")
    alone = Fit(**{field.name: getattr(finished, field.name) for field in fields(Fit)})
    write_fit(folder / "fits" / "turned.safetensors", alone)
    for read in (
        lambda: collection.save_maps(tmp_path / "maps"),
        lambda: meshmatch.Collection(folder).fit_of("turned"),
    ):
        with pytest.raises(InputError, match="turned is not finished"):
            read()


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders of atlases without pictures."""
    monkeypatch.setattr("meshmatch.collections.atlas_pictures.render_shapes", lambda *_: None)


def test_a_collection_has_an_atlas(made: tuple[Path, tuple[Record, ...]], tmp_path: Path, undrawn: None) -> None:
    """In the axes of the template and the unit of the files: a body on its side, ten times as large, is the same body."""
    collection = meshmatch.Collection(made[0])
    with collection.registered() as shapes:
        assert shapes.names == tuple(NAMES) and not shapes.left_out
        for points, name in zip(shapes.points, NAMES, strict=True):
            fit = collection.fit_of(name)
            assert np.allclose(points @ fit.frame.rotation, fit.points_in_file - fit.frame.center)
            assert np.ptp(points, axis=0).argmax() in (0, 1)  # upright, or arms that are spread
    atlas = collection.atlas(scale="remove")
    assert atlas.names == tuple(NAMES)
    apart = np.linalg.norm((atlas.scores[:, None] - atlas.scores) * atlas.deviations, axis=2)
    assert apart[1, 2] < 0.1 * apart[0, 1]
    found = atlas.project(meshmatch.register(SAMPLES / "dancer.ply", model="human"))
    assert found.scores[0] == pytest.approx(atlas.scores[1, 0], abs=0.1)  # the second mode is next to nothing
    assert atlas.sizes[2] == pytest.approx(10 * atlas.sizes[1], rel=0.02)
    output = tmp_path / "atlas"
    assert main(["atlas", str(made[0]), "-o", str(output), "--scale", "remove", "-q"]) == 0
    assert np.allclose(meshmatch.Atlas.load(output).scores, atlas.scores)
    assert not (output / "measures.csv").exists()  # three shapes are too few


def test_a_model_can_learn_from_fits(
    made: tuple[Path, tuple[Record, ...]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}

    def train(output: Path, **given: Any) -> None:
        asked.update(given)
        output.mkdir()
        shutil.copy(bundled_folder() / "models" / "human" / "card.json", output / "card.json")

    monkeypatch.setattr("meshmatch.training.train.train", train)
    assert main(["train", "--shapes", str(made[0]), "--steps", "1", "-o", str(tmp_path / "mine"), "-q"]) == 0
    found, start = asked["shapes"], asked["facts"].start
    assert found.verts.shape == (3, found.template.shape.V, 3) and found.template.hash == start.template.hash
    assert (found.name, start.card.name, asked["recipe"].network) == ("fits", "human", start.inference.config)
    for odd in ("--unsupervised", "--preset=paper", "--template=human-A", "--identities=8"):
        assert main(["train", "--shapes", str(made[0]), odd, "-o", str(tmp_path / "mine"), "-q"]) == 1


def with_turned(fits: Path, folder: Path, **changes: Any) -> meshmatch.Collection:
    """A copy of a collection in which the fit of ``turned`` is changed."""
    shutil.copytree(fits, folder)
    collection, file = meshmatch.Collection(folder), folder / "fits" / "turned.safetensors"
    write_fit(file, replace(read_fit(file, collection.template).fit, **changes))
    return collection


def test_poor_fits_are_left_out_of_an_atlas(
    made: tuple[Path, tuple[Record, ...]], tmp_path: Path, capsys: pytest.CaptureFixture[str], undrawn: None
) -> None:
    folder = tmp_path / "fits"
    collection = with_turned(made[0], folder, verdict="poor")
    with pytest.raises(InputError, match="holds 2 fits and 1 that are left out"):
        collection.atlas()
    with collection.registered(poor=True) as shapes:
        assert shapes.names == tuple(NAMES)
    with pytest.raises(InputError, match="holds 1 fits and 2 that are left out"):
        collection.atlas(leave_out=["danc*"])
    shutil.copy(folder / "fits" / "dancer.safetensors", folder / "fits" / "again.safetensors")
    output = tmp_path / "atlas"
    assert main(["atlas", str(folder), "-o", str(output), "-q", "--scale", "remove"]) == 0
    assert capsys.readouterr().err == "warning: turned: left out, as its fit is poor\n"
    assert meshmatch.Atlas.load(output).names == ("again", "climber", "dancer")
    assert main(["atlas", str(tmp_path / "gone"), "-o", str(tmp_path / "b"), "-q"]) == 1


def test_a_cut_shape_in_an_atlas_of_whole_ones_is_told(
    made: tuple[Path, tuple[Record, ...]], tmp_path: Path, capsys: pytest.CaptureFixture[str], undrawn: None
) -> None:
    folder = tmp_path / "fits"
    collection = with_turned(made[0], folder, partial=True)
    with pytest.warns(MeshmatchWarning, match="turned: cut, among whole shapes"):
        collection.atlas(scale="remove")
    words = ["atlas", str(folder), "-o", str(tmp_path / "atlas"), "-q", "--scale", "remove", "--json"]
    assert main(words) == 0
    answer = capsys.readouterr()
    assert answer.err.startswith("warning: turned: cut") and answer.err.count("\n") == 1
    assert json.loads(answer.out)["cut"] == ["turned"]


def test_a_sequence_is_followed_and_a_lost_frame_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A body walks; in one frame it is somebody else, standing on his head."""
    dancer, climber = (load_shape(SAMPLES / f"{name}.ply") for name in ("dancer", "climber"))
    folder = tmp_path / "frames"
    folder.mkdir()
    step = 0.02 * dancer.diagonal
    for number in range(8, 12):
        verts = dancer.verts + number * step * np.array([0, 0, 1.0])
        save_shape(folder / f"frame{number}.ply", Shape(verts, dancer.faces))
    other = np.sqrt(dancer.area / climber.area) * climber.verts * [1, -1, -1]
    save_shape(folder / "frame9.ply", Shape(other, climber.faces))
    order: list[str] = []
    anew: list[str] = []
    fit = Fitter.fit

    def counted(self: Fitter, shape: Shape, *rest: Any) -> Any:
        anew.append(shape.name)
        return fit(self, shape, *rest)

    monkeypatch.setattr(Fitter, "fit", counted)
    collection = meshmatch.Collection(tmp_path / "fits", workers=1)
    few = meshmatch.FitConfig(variants=4, finalists=2, samples=3000)
    tell = lambda record: order.append(record.name)  # noqa: E731
    made = collection.fit(folder, model="human", config=few, sequence=True, agree=False, tell=tell)
    assert order == [f"frame{number}" for number in range(8, 12)]
    assert {record.verdict for record in made.records} == {"good"}
    assert (collection.map("frame8", "frame10").index == np.arange(dancer.V)).mean() > 0.5
    assert anew == ["frame8", "frame9", "frame10"]
    ups = {record.name: record.up for record in made.records}
    assert [ups[f"frame{number}"] for number in (8, 9, 10)] == ["+y", "-z", "+y"]
    places = [collection.fit_of(f"frame{number}").points_in_file.mean(0)[2] for number in (10, 11)]
    assert np.allclose(np.diff(places), step, rtol=0.1)


def test_without_a_model_the_shapes_make_their_template(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Eggs of four shapes, meshed apart and tipped a little: their poles are found, and nothing is called good."""
    use_small_fits(monkeypatch)
    folder = tmp_path / "eggs"
    folder.mkdir()
    eggs = {}
    for number, squash in enumerate((0.8, 0.9, 1.1, 1.2)):
        ball = icosphere(3)
        x, y, z = (ball.verts @ Rotation.random(rng=number).as_matrix()).T  # other triangles in the same places
        radius = 1 + 0.15 * z + 0.1 * x  # its ends, and its sides, differ
        eggs[f"egg{number}"] = Shape(radius[:, None] * np.stack([x, y, z], 1) * [1, squash, 1.4], ball.faces)
        save_shape(folder / f"egg{number}.ply", eggs[f"egg{number}"])
    collection = meshmatch.Collection(tmp_path / "fits", workers=1)
    made = collection.fit(folder, model="none")
    assert {record.verdict for record in made.records} == {"fair"} and made.agreed == 0
    assert "without a trained model" in made.records[0].reasons
    for source, target in collection.pairs():
        found, here, there = collection.map(source, target), eggs[source], eggs[target]
        place, matched = here.verts / np.abs(here.verts).max(0), there.verts[found.index] / np.abs(there.verts).max(0)
        assert np.linalg.norm(place - matched, axis=1).mean() < 0.15
    template = collection.template.hash
    collection.fit(folder, model="none")
    assert collection.template.hash == template
    means = {load_template(tmp_path / "fits" / name).hash for name in ("first.safetensors", "second.safetensors")}
    assert len(means | {template}) == 3  # the mean of the first fits, and of those that it has
    assert collection.template.K == SmallViscous().finest().nodes > SmallViscous.nodes
    with pytest.raises(OptionError, match="another model"):
        collection.fit(folder, model="human")
    frames = meshmatch.Collection(tmp_path / "frames", workers=1)
    frames.fit(folder, model="none", sequence=True)
    assert frames.template.K < SmallViscous().finest().nodes


def test_where_no_fit_is_to_be_trusted_maps_can_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Triangles that are too large for a close fit: the first template remains that of all."""
    use_small_fits(monkeypatch)
    write_eggs(tmp_path / "eggs", 2, splits=1)
    collection = meshmatch.Collection(tmp_path / "fits", workers=1)
    made = collection.fit(tmp_path / "eggs", model="none")
    assert {record.verdict for record in made.records} == {"poor"}
    assert collection.map("egg0", "egg1").verdict == "poor"
    assert collection.save_maps(tmp_path / "maps") == 2


def test_a_collection_has_the_shapes_of_before_as_long_as_their_files_are_there(shapes: Path, tmp_path: Path) -> None:
    """A specimen that is added by itself joins the others; one that was deleted, renamed or damaged is in it no more."""
    scans, moved = tmp_path / "scans", tmp_path / "moved"
    shutil.copytree(shapes, scans)
    collection = meshmatch.Collection(tmp_path / "fits", workers=1)

    def fitted(*given: Path) -> dict[str, bool]:
        made = collection.fit(given, model="human", config=QUICK, agree=False)
        assert collection.names == sorted(record.name for record in made.records if record.fitted)
        return {record.name: record.fitted for record in made.records}

    assert fitted(scans / "dancer.ply", scans / "turned.obj") == {"dancer": True, "turned": True}
    assert fitted(scans / "climber.ply") == dict.fromkeys(NAMES, True)
    scans.rename(moved)
    assert fitted(moved) == {"broken": False} | dict.fromkeys(NAMES, True)
    assert fitted(moved / "dancer.ply") == dict.fromkeys(NAMES, True)  # the others are known where they lie now
    (moved / "dancer.ply").rename(moved / "anna.ply")
    (moved / "turned.obj").write_text("damaged")
    with pytest.warns(MeshmatchWarning, match="no longer in it, .* gone or have other names: dancer; "):
        assert fitted(moved) == {"anna": True, "broken": False, "climber": True, "turned": False}


def test_a_shape_of_another_kind_is_called_so(tmp_path: Path) -> None:
    """And a shape in a format that no reader knows has a row, too."""
    shutil.copy(SAMPLES / "dancer.ply", tmp_path)
    (tmp_path / "scan.wrl").write_text("#VRML")
    with pytest.warns(MeshmatchWarning, match=r"formats that are not read are left out: scan\.wrl"):
        made = meshmatch.Collection(tmp_path / "fits", workers=1).fit(tmp_path, model="quadruped")
    record, other = made.records
    assert (record.verdict, record.reasons.split("; ")[0]) == ("poor", "it is of another kind: human")
    with (tmp_path / "fits" / "fits.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    told = "scan.wrl", str(tmp_path / "scan.wrl"), "failed", "left out: shapes in formats that are not read"
    assert [row["name"] for row in rows] == ["dancer", "scan.wrl"] and made.counts["failed"] == 1
    assert (
        tuple(rows[1][name] for name in ("name", "file", "verdict", "reasons"))
        == told
        == (*(other.name, other.file, other.verdict, other.reasons),)
    )


def test_one_part_may_be_a_string(tmp_path: Path) -> None:
    for choice in ("only", "without"):
        with pytest.raises(InputError, match=r"has no part 12$"):
            meshmatch.Collection(tmp_path / choice, workers=1).fit(SAMPLES / "fox.ply", model="human", **{choice: "12"})


def test_every_file_of_a_folder_has_a_row(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """But what belongs to a shape; and nothing takes the others for shapes, nor for failures."""
    scans, fits = tmp_path / "scans", tmp_path / "fits"
    (scans / "more").mkdir(parents=True)
    for name in ("dancer", "climber"):
        shutil.copy(SAMPLES / f"{name}.ply", scans)
    for name in ("README", "stack.tif", "more/notes.docx", "dancer.mtl", "dancer.landmarks.csv", "climber.npy"):
        (scans / name).write_text("no shape")
    np.save(scans / "points.npy", np.eye(3))
    command = ["fit", str(scans), "-o", str(fits), "--model", "human", "--refine", "none", "--alone", "--jobs", "1"]
    assert main(command) == 0
    err = capsys.readouterr().err
    assert f"ignored, as they are not shapes: README, more/notes.docx, points.npy, stack.tif; see {fits}" in err
    assert "wrote 2 fits" in err and "failed" not in err
    with (fits / "fits.csv").open(newline="") as table:
        rows = {row["name"]: (row["verdict"], row["reasons"]) for row in csv.DictReader(table)}
    others = {name: rows.pop(name) for name in ("README", "more/notes.docx", "points.npy", "stack.tif")}
    assert set(rows) == {"dancer", "climber"} == set(file_table(Store.of(fits)))
    assert others.pop("points.npy") == ("left out", "an array next to shapes")
    assert set(others.values()) == {("left out", "not a format of shapes")}
    assert set(meshmatch.Transfers(meshmatch.transfer_landmarks, scans / "dancer.ply", fits).files) == {"climber"}
    for number in range(3):
        (scans / f"{number}.png").write_bytes(b"no shape")
    (scans / "more.bak").write_bytes(b"no shape")
    assert main([*command, "--strict"]) == 0
    err = capsys.readouterr().err
    assert "files of unknown format are left out: more.bak" in err
    assert "they are not shapes: 3 .png, 1 without a suffix, 1 .docx, 1 .npy, 1 .tif; see" in err
    assert err.count("bak") == 1  # not named again
    assert "more.bak" not in file_table(Store.of(fits))  # not a frame of a sequence
    (scans / "scan.wrl").write_text("#VRML")
    assert main([*command, "--strict"]) == 1
    assert "2 good, 1 failed" in capsys.readouterr().err
    _, left_out = find_sources([f"{scans}/*.[pt]*"])
    assert sorted(Path(each.file).name for each in left_out) == ["0.png", "1.png", "2.png", "stack.tif"]


def test_links_of_a_folder_are_not_passed_over(tmp_path: Path) -> None:
    """One that leads nowhere is a shape that fails; one to a folder, which may be a circle, has a row."""
    (tmp_path / "more").mkdir()
    for name, leads_to in {"a.ply": SAMPLES / "fox.ply", "gone.ply": "nowhere.ply", "self.ply": "self.ply"}.items():
        (tmp_path / name).symlink_to(leads_to)
    (tmp_path / "more" / "up").symlink_to("..")
    (tmp_path / ".hidden").symlink_to("more")
    found, left_out = find_sources(tmp_path)
    assert [source.name for source in found] == ["a", "gone", "self"]
    for source in found[1:]:
        with pytest.raises(InputError, match="a link to a file that is not there"):
            source.load((), ())
    assert [(each.name, each.verdict) for each in left_out] == [("more/up", "left out")]
    assert find_sources(tmp_path, Store.of(tmp_path / "fits")) == (found, left_out)


def test_each_shape_of_a_mixed_folder_gets_the_model_of_its_kind(tmp_path: Path) -> None:
    (tmp_path / "shapes").mkdir()
    for name in ("dancer", "calf", "fox"):
        shutil.copy(SAMPLES / f"{name}.ply", tmp_path / "shapes" / f"{'a-' if name == 'dancer' else ''}{name}.ply")
    collection = meshmatch.Collection(tmp_path / "fits", workers=1)
    told: list[Record] = []
    few = meshmatch.FitConfig.quick(again=False, samples=2000, copies=8)
    made = collection.fit(tmp_path / "shapes", config=few, tell=told.append)
    assert sorted((record.name, record.verdict) for record in told) == [
        ("a-dancer", "good"), ("calf", "good"), ("fox", "good")
    ]  # fmt: skip
    assert collection.names == ["a-dancer"]
    assert made.elsewhere == dict.fromkeys(("calf", "fox"), str(tmp_path / "fits" / "quadruped"))
    assert (made.model, [record.verdict for record in made.records]) == ("human", ["good"] * 3)
    assert made.agreed == 2  # the two animals
    assert [record.kind for record in made.records] == ["", "quadruped", "quadruped"]
    assert made.records[1].notes.startswith(f"quadruped: its fit is in {tmp_path / 'fits' / 'quadruped'}")
    animals = meshmatch.Collection(tmp_path / "fits" / "quadruped")
    assert (animals.model, animals.names) == ("quadruped", ["calf", "fox"])
    files = [tmp_path / "shapes" / f"{name}.ply" for name in ("calf", "fox")]
    assert collection.maps_between(*files).forward.verdict == "good"
    before = {path: path.read_bytes() for path in (tmp_path / "fits").rglob("*.safetensors")}
    assert [record.verdict for record in collection.fit(tmp_path / "shapes", config=few).records] == ["good"] * 3
    assert before == {path: path.read_bytes() for path in (tmp_path / "fits").rglob("*.safetensors")}


def test_only_poor_fits_are_made_again_where_the_search_may_take_longer(
    shapes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    fit = Fitter.fit

    def poor_dancer(self: Fitter, shape: Shape) -> meshmatch.Fit:
        made.append(shape.name)
        found = fit(self, shape)
        return replace(found, verdict="poor") if shape.name == "dancer" else found

    monkeypatch.setattr(Fitter, "fit", poor_dancer)
    collection = meshmatch.Collection(tmp_path / "fits", workers=1)
    two = [shapes / "climber.ply", shapes / "dancer.ply"]
    for harder, expected in ((False, ["climber", "dancer"]), (True, ["dancer"]), (True, []), (False, [])):
        made.clear()
        collection.fit(two, model="human", config=replace(QUICK, try_harder=harder), agree=False)
        assert made == expected
