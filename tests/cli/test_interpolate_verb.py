"""`interpolate` through the front door, on eggs, and once on the samples."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.api import interpolation
from meshmatch.fitting.fit import Fit
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from meshmatch.templates.location import bundled_folder
from tests.cli.conftest import Run
from tests.fitting.eggs import bent_egg, egg_model, write_model
from tests.shapes.painted import quarters

pytestmark = pytest.mark.usefixtures("remembered_fits")


@pytest.fixture(scope="module")
def eggs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder: model, a.ply, b.ply, c.ply; big.ply is b in another unit."""
    folder = tmp_path_factory.mktemp("eggs")
    model = egg_model()
    write_model(model, folder / "model")
    for number, name in enumerate("abc"):
        save_shape(folder / f"{name}.ply", bent_egg(model, number))
    b = load_shape(folder / "b.ply")
    save_shape(folder / "big.ply", Shape(100 * b.verts, b.faces))
    return folder


def test_a_folder_of_shapes(run: Run, eggs: Path, tmp_path: Path) -> None:
    out = tmp_path / "between"
    call = ("interpolate", eggs / "a.ply", eggs / "b.ply", "-o", out, "-n", 4, "--model", eggs / "model")
    done = run(*call, "--json", "--threads", 1)
    assert done.status == 0, done.err
    names = [f"frame-{number:03d}.ply" for number in range(4)]
    assert sorted(path.name for path in out.iterdir()) == [*names, "frames.json"]
    a = load_shape(eggs / "a.ply")
    first, last = load_shape(out / names[0]), load_shape(out / names[3])
    assert np.abs(first.verts - a.verts).max() < 1e-6 * a.diagonal
    assert all(np.array_equal(load_shape(out / name).faces, a.faces) for name in names)
    assert np.abs(last.verts - a.verts).max() > 0.05 * a.diagonal
    record = done.record
    assert [frame["time"] for frame in record["frames"]] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [shape["time"] for shape in record["shapes"]] == [0, 1]
    assert (record["place"], record["vertices"], record["mesh"]) == ("files", a.V, "source")
    assert record["frames"][0]["arap"] < 1e-6 < record["frames"][1]["arap"]
    assert record["frames"][0]["template_arap"] > 1e-3
    listed = json.loads((out / "frames.json").read_text())
    assert [frame.pop("file") for frame in listed["frames"]] == names
    assert listed["frames"] == record["frames"]
    assert f"wrote {out}: 4 shapes" in done.err
    again = run(*call)
    assert again.status == 1
    assert "is not empty" in again.err


def test_the_mesh_of_a_file_keeps_its_look(run: Run, eggs: Path, tmp_path: Path) -> None:
    """An obj its text and materials, in a glb its image; what another format loses is said once."""
    a = load_shape(eggs / "a.ply")
    uv = np.random.default_rng(0).random((a.F, 3, 2))
    worn = tmp_path / "worn.obj"
    save_textured(worn, TexturedMesh(a.verts, a.faces, uv), quarters())
    call = ("interpolate", worn, eggs / "b.ply", "-n", 2, "--model", eggs / "model", "--quiet", "--threads", 1)
    frames = {kind: tmp_path / kind / f"frame-001.{kind}" for kind in ("obj", "glb", "ply")}
    for kind, frame in frames.items():
        done = run(*call, "-o", frame.parent, "--format", kind)
        lost = "frame-000.ply does not have the texture coordinates and the materials of worn.obj"
        assert (done.status, done.err) == (0, f"warning: {lost}\n" if kind == "ply" else "")
        if kind != "ply":
            given, kept = (load_appearance(file, load_shape(file)) for file in (worn, frame))
            np.testing.assert_allclose(kept.uv, given.uv, atol=1e-6)
            np.testing.assert_array_equal(kept.materials[0].image, given.materials[0].image)
    text, before = (file.read_text().splitlines() for file in (frames["obj"], worn))
    assert [line for line in text if line[:2] != "v "] == [line for line in before if line[:2] != "v "]
    np.testing.assert_allclose(load_shape(frames["obj"]).verts, load_shape(frames["ply"]).verts, atol=1e-9)


def test_a_glb_stands_as_the_first_shape_does(eggs: Path, tmp_path: Path) -> None:
    shapes = [load_shape(eggs / f"{name}.ply") for name in "ab"]
    result = interpolation.interpolate(shapes, 2, model=eggs / "model", threads=1)
    fit = result.fits[0]
    assert isinstance(fit, Fit)
    lying = replace(result, fits=(replace(fit, up="+z"), result.fits[1]))
    for each, folder in ((replace(result, fits=(replace(fit, up="+y"), fit)), "stands"), (lying, "lies")):
        interpolation.save_folder(tmp_path / folder, each, "glb")
    for name in ("frame-000.glb", "frame-001.glb"):
        before, after = (load_shape(tmp_path / folder / name).verts for folder in ("stands", "lies"))
        np.testing.assert_allclose(after, before @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-5)


def test_there_and_back_through_a_third(run: Run, eggs: Path, tmp_path: Path) -> None:
    """The template's shapes backwards are those of the reversed way; in the middle they are the third's."""
    common = ("--model", eggs / "model", "--mesh", "template", "-n", 5, "--format", "obj", "--quiet")
    a, b, c = (eggs / f"{name}.ply" for name in "abc")
    for name, ends in (("there", (a, b)), ("back", (b, a))):
        done = run("interpolate", *ends, "--through", c, "-o", tmp_path / name, *common, "--json")
        assert (done.status, done.err) == (0, ""), done.err
        assert [shape["time"] for shape in done.record["shapes"]] == [0, 0.5, 1]
    for number in range(5):
        there = load_shape(tmp_path / "there" / f"frame-{number:03d}.obj")
        back = load_shape(tmp_path / "back" / f"frame-{4 - number:03d}.obj")
        assert there.V == egg_model().template.shape.V
        assert np.abs(there.verts - back.verts).max() < 1e-6 * there.diagonal
    middle = load_shape(tmp_path / "there" / "frame-002.obj")
    c_to_b = run("interpolate", c, b, "--through", a, "-o", tmp_path / "third", *common)
    assert c_to_b.status == 0
    own = load_shape(tmp_path / "third" / "frame-000.obj")
    assert np.abs(middle.verts - own.verts).max() < 1e-6 * own.diagonal


def test_a_strip_and_a_plot(run: Run, eggs: Path, tmp_path: Path) -> None:
    strip, plot = tmp_path / "strip.png", tmp_path / "plot.png"
    done = run(
        *("interpolate", eggs / "a.ply", eggs / "b.ply", "-o", strip, "--plot", plot, "-n", 3),
        *("--from", -0.2, "--to", 1.2, "--model", eggs / "model", "--blend", "codes", "--seed", 3),
        *("--refine", "none", "--up", "y", "--front", "z", "--whole", "--json"),
    )
    record = done.record
    assert [frame["time"] for frame in record["frames"]] == pytest.approx([-0.2, 0.5, 1.2])
    chosen = ("codes", "none", 3, str(plot))
    assert tuple(record[key] for key in ("blend", "refine", "seed", "plot")) == chosen
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plot.png", "strip.png"]
    with Image.open(strip) as image:
        assert image.width > 2 * image.height
    with Image.open(plot) as image:
        assert len(image.convert("RGB").getcolors(1 << 20) or []) > 20


def test_a_page(run: Run, eggs: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    done = run(
        *("interpolate", eggs / "a.ply", eggs / "b.ply", "-o", page, "-n", 3, "--through", eggs / "c.ply"),
        *("--model", eggs / "model"),
    )
    assert done.status == 0, done.err
    text = page.read_text(encoding="utf-8")
    assert '"met":[[0.0,"a.ply"],[0.5,"c.ply"],[1.0,"b.ply"]]' in text
    assert "<title>a.ply → c.ply → b.ply</title>" in text


def test_files_of_different_units_stay_with_the_first(run: Run, eggs: Path, tmp_path: Path) -> None:
    common = ("--model", eggs / "model", "-n", 2, "--json")
    a, big = load_shape(eggs / "a.ply"), load_shape(eggs / "big.ply")
    last = {}
    for place in ("auto", "files", "source"):
        out = tmp_path / place
        done = run("interpolate", eggs / "a.ply", eggs / "big.ply", "-o", out, "--place", place, *common)
        assert ("differ much in size" in done.err) == (place == "auto")
        assert done.record["place"] == ("files" if place == "files" else "source")
        last[place] = load_shape(out / "frame-001.ply")
    assert np.array_equal(last["auto"].verts, last["source"].verts)
    assert last["source"].area == pytest.approx(a.area, rel=0.3)
    assert last["files"].area == pytest.approx(big.area, rel=0.3)


def test_a_shape_and_itself(eggs: Path) -> None:
    a = load_shape(eggs / "a.ply")
    result = interpolation.interpolate([a, a], 3, model=eggs / "model", threads=1)
    assert all(np.abs(step.shape.verts - a.verts).max() < 1e-6 * a.diagonal for step in result.steps)
    assert result.to_target < 1e-6


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("-o", "x.mp4"), "unsupported format for a sequence: .mp4"),
        (("-o", "no/such/folder"), "there is no folder no/such"),
        (("-o", "x.png", "--plot", "x.jpg"), "unsupported chart format"),
        (("-o", "x.png", "--plot", "x.png"), "is an output of this command already"),
        (("-o", "x", "--from", 1, "--to", 0), "cannot run from 1 to 0"),
        (("-o", "x", "--to", 9), "cannot run from 0 to 9"),
        (("-o", "x", "--from", "nan"), "cannot run from nan to 1"),
        (("-o", "x", "--through", "missing.ply"), "there is no file missing.ply"),
        (("-o", "x", "--model", "nobody"), "nobody"),
        (("-o", "x", "--up", "y", "--front", "-y"), "along one axis"),
    ],
)
def test_bad_choices_write_nothing(
    run: Run, eggs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str | float, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    model = () if "--model" in words else ("--model", eggs / "model")
    done = run("interpolate", eggs / "a.ply", eggs / "b.ply", *model, *map(str, words))
    assert done.status == 1
    assert said in done.err
    assert done.err.count("\n") <= 2
    assert list(tmp_path.iterdir()) == []


def test_one_shape_is_no_sequence(run: Run, eggs: Path) -> None:
    assert run("interpolate", eggs / "a.ply", eggs / "b.ply", "-o", "x", "-n", 1).status == 2
    with pytest.raises(interpolation.OptionError, match="at least two shapes to make, not 1"):
        interpolation.interpolate([eggs / "a.ply", eggs / "b.ply"], 1)
    with pytest.raises(interpolation.OptionError, match=r"must be an integer, not '3'"):
        interpolation.interpolate([eggs / "a.ply", eggs / "b.ply"], "3")  # type: ignore[arg-type]
    with pytest.raises(interpolation.OptionError, match="invalid mesh 'hat'"):
        interpolation.InterpolationOptions(mesh="hat")  # type: ignore[arg-type]
    with pytest.raises(interpolation.OptionError, match="invalid place 'moon'"):
        interpolation.InterpolationOptions(place="moon")  # type: ignore[arg-type]
    with pytest.raises(interpolation.OptionError, match="start must be a number, not 'a'"):
        interpolation.InterpolationOptions(start="a")  # type: ignore[arg-type]


def test_strict_wants_fits_that_are_not_poor(run: Run, eggs: Path, tmp_path: Path, torus: Shape) -> None:
    save_shape(tmp_path / "torus.ply", torus)
    out = tmp_path / "out"
    call = ("interpolate", eggs / "a.ply", tmp_path / "torus.ply", "-o", out, "-n", 2)
    strict = run(*call, "--model", eggs / "model", "--strict")
    assert strict.status == 1
    assert strict.err.startswith("error: the fit is poor, nothing was written: ")
    assert ".ply: template and shape are" in strict.err
    assert not out.exists()
    lax = run(*call, "--model", eggs / "model", "--quiet")
    assert lax.status == 0
    assert "the fit of torus.ply is poor" in lax.err
    assert out.is_dir()


@pytest.mark.slow
def test_the_samples(run: Run, tmp_path: Path) -> None:
    """With the model that ships: volume and distances are kept, the dancer's own mesh arrives at the climber."""
    samples = bundled_folder() / "samples"
    dancer = samples / "dancer.ply"
    done = run("interpolate", dancer, samples / "climber.ply", "-n", 3, "-o", tmp_path / "out", "--json")
    record = done.record
    assert record["distance_to_target"] < 0.006
    assert record["frames"][1]["volume"] < 0.03  # node vectors on straight lines: 0.21
    assert record["frames"][1]["arap"] < 0.07
    own = load_shape(dancer)
    assert np.array_equal(load_shape(tmp_path / "out" / "frame-000.ply").verts, own.verts)
