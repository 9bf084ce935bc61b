"""Shapes without correspondence: the typical one, one frame for all, known points, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.api import prepare as preparing
from meshmatch.api.prepare import PrepareConfig, Prepared, prepare
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.without_model import RigidAlignment
from meshmatch.geometry.frames import Frame
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepared_folder import find_landmarks, is_registered, medoid, read_landmarks, read_samples
from meshmatch.templates.template import load_template, template_radius, unit_frame
from tests.conftest import icosphere

FEW = NodeConfig(strategy="uniform", K=60, radius=0.35)
NONE = np.empty((0, 3), np.int64)


def prepared(folder: Path, output: Path, nodes: NodeConfig = FEW, **choices) -> Prepared:
    return prepare(folder, output, PrepareConfig(nodes, mirror="no", **choices))


def pear(splits: int, stretch: float = 1.0) -> Shape:
    """Three different axes and a thick end; the number of triangles differs with `splits`."""
    ball = icosphere(splits)
    verts = ball.verts * [0.8, 1.5 * stretch, 1.0]
    verts[:, 0] *= 1 + 0.5 * ball.verts[:, 1]
    return Shape(verts, ball.faces)


def turn_of(number: int) -> np.ndarray:
    return Rotation.from_rotvec([0, 0, 0.5 * (number - 2)]).as_matrix()


@pytest.fixture
def pears(tmp_path: Path) -> Path:
    """Four pears of different connectivity, unit, place and turn; the third stands as its template does."""
    return write_pears(tmp_path / "pears")


def write_pears(folder: Path) -> Path:
    folder.mkdir()
    for n, (splits, stretch) in enumerate([(2, 0.8), (3, 1.3), (2, 1.0), (3, 1.05)]):
        shape = pear(splits, stretch)
        save_shape(folder / f"pear{n}.ply", Shape(10.0**n * shape.verts @ turn_of(n).T + n, shape.faces))
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Prepared]:
    """Pears with both their tips as landmarks, but one; the folder made of them, and what was said."""
    place = tmp_path_factory.mktemp("made")
    folder = write_pears(place / "pears")
    for n in (1, 2, 3):
        height = pear(2 if n % 2 == 0 else 3).verts[:, 1]
        tips = np.array([height.argmax(), height.argmin()])
        if n == 1:  # as places, one of them missing
            tips = load_shape(folder / "pear1.ply").verts[tips]
            tips[1] = np.nan
        np.save(folder / f"pear{n}.tips.npy", tips)
    return folder, place / "out", prepared(folder, place / "out", landmarks=".tips.npy")


def test_a_folder_without_correspondence(made: tuple[Path, Path, Prepared]) -> None:
    pears, output, said = made
    assert (len(said.shapes), said.align) == (0, "rigid")
    assert any(note.startswith("template: pear") for note in said.notes)
    assert said.names == tuple(f"pear{n}.ply" for n in range(4))  # the files of points are no shapes
    assert not is_registered(output)
    samples = read_samples(output, load_template(output / "template.safetensors"))
    assert samples.points.shape == samples.normals.shape == (4, 4096, 3)
    assert (samples.align, samples.scale) == ("rigid", "area")
    words = json.loads((output / "prepared.json").read_text())
    for number, (name, each) in enumerate(zip(words["names"], words["frames"], strict=True)):
        frame = Frame(each["scale"], np.array(each["rotation"]), np.array(each["center"]))
        original = load_shape(pears / name)
        there = Shape(frame.apply(original.verts), original.faces)
        assert there.area == pytest.approx(1, rel=1e-6)
        gap = np.linalg.norm(there.verts[:, None] - samples.points[number][None, :2000], axis=2).min(0)
        assert gap.max() < 0.15  # samples lie on the shape, in the frame that was written down
    assert max(words["apart"]) < 0.06  # turned to the template
    assert len(list((output / "normalised").iterdir())) == 4


def test_landmarks_follow_their_shapes(made: tuple[Path, Path, Prepared]) -> None:
    _, output, said = made
    assert said.landmarks == 2
    samples = read_samples(output, said.template)
    known = samples.landmarks
    assert np.isnan(known[0]).all() and np.isnan(known[1, 1]).all()
    places = said.template.shape.verts[samples.template_landmarks]
    assert np.linalg.norm(places[0] - places[1]) > 0.5  # the length of a pear
    assert np.linalg.norm(known[2:] - places, axis=2).max() < 0.25
    assert np.linalg.norm(known[1, 0] - places[0]) < 0.25


@pytest.fixture
def five(tmp_path: Path) -> Path:
    """Pears that stand alike, turned, with their tips as landmarks; the typical one is shorter than the mean."""
    folder = tmp_path / "five"
    folder.mkdir()
    for n, stretch in enumerate((0.95, 1.0, 1.0, 1.15, 1.3)):
        shape = pear(2 + n % 2, stretch)
        save_shape(folder / f"pear{n}.ply", Shape(10.0**n * shape.verts @ turn_of(n).T + n, shape.faces))
        np.save(folder / f"pear{n}.tips.npy", [shape.verts[:, 1].argmax(), shape.verts[:, 1].argmin()])
    return folder


def test_of_shapes_that_stand_alike_the_template_is_the_mean(five: Path, tmp_path: Path) -> None:
    made = prepared(five, tmp_path / "out", landmarks=".tips.npy")
    assert made.notes[-1].startswith("template: the mean of 5 shapes, on the vertices of pear")
    verts = made.template.shape.verts
    long, wide, _ = np.ptp(
        (verts - verts.mean(0)) @ np.linalg.svd(verts - verts.mean(0), full_matrices=False)[2].T, axis=0
    )
    assert long / wide == pytest.approx(1.5 * 1.08, rel=0.01)  # 1.5 of the typical one
    samples = read_samples(tmp_path / "out", made.template)
    assert np.linalg.norm(samples.landmarks - verts[samples.template_landmarks], axis=2).max() < 0.1


def test_a_named_template_stays(five: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preparing, "align_by_fits", lambda *_: RigidAlignment(Frame.identity(), 0.1, True))
    made = prepared(five, tmp_path / "out", landmarks=".tips.npy", template="pear4")
    assert made.template.source == "pear4.ply of five"
    as_it_is = prepared(five, tmp_path / "out", landmarks=".tips.npy", template="pear4", align="none")
    assert np.array_equal(made.template.shape.verts, as_it_is.template.shape.verts)


def test_the_typical_shape_is_the_middle_one() -> None:
    shapes = [repair(pear(2, stretch)) for stretch in (0.5, 0.8, 1.0, 1.25, 2.0)]
    assert medoid(shapes, "none", "area", 0) in (1, 2, 3)
    lonely = [repair(pear(2, stretch)) for stretch in (2.0, 1.0, 1.02, 0.98)]
    assert medoid(lonely, "none", "area", 0) != 0
    clouds = [repair(Shape(pear(3).verts, NONE)), repair(pear(2, 0.7)), repair(Shape(pear(3, 1.1).verts, NONE))]
    assert medoid(clouds, "none", "area", 0) == 1  # a mesh, if there is one


def test_the_template_by_name_by_file_and_of_a_cloud(pears: Path, tmp_path: Path) -> None:
    def hash_of(template: str | Path) -> str:
        return prepared(pears, tmp_path / "out", FEW, template=template, align="none").template.hash

    by_stem = hash_of("pear1")
    assert hash_of("pear1.ply") == hash_of(pears / "pear1.ply") == by_stem
    assert hash_of("pear0") != by_stem
    cloud = tmp_path / "cloud.npy"
    np.save(cloud, pear(3).verts)
    made = prepared(pears, tmp_path / "out", FEW, template=cloud, align="none").template
    assert made.shape.V > 600 and made.dense is made.shape
    with pytest.raises(InputError, match="pear9"):
        hash_of("pear9")


def test_nodes_of_a_cloud_scatter_around_it(tmp_path: Path) -> None:
    """Of a mesh they lie below the surface; of a cloud on both sides, by Gaussian noise."""
    ball = icosphere(3)
    for n, faces in enumerate((ball.faces, NONE)):
        (tmp_path / f"in{n}").mkdir()
        for k in range(2):
            save_shape(tmp_path / f"in{n}" / f"{k}.ply", Shape(ball.verts * (1 + k), faces))
    radius = np.sqrt(1 / (4 * np.pi))
    below, around = (
        np.linalg.norm(prepared(tmp_path / f"in{n}", tmp_path / "out", FEW, align="none").template.nodes, axis=1)
        for n in (0, 1)
    )
    assert below.max() < radius * 1.01
    assert 0.2 < (around > radius).mean() < 0.95
    assert around.std() > below.std()


def test_the_sphere_scale_is_the_templates_radius(pears: Path, tmp_path: Path) -> None:
    made = prepared(pears, tmp_path / "out", FEW, scale="sphere", template="pear2", align="none")
    samples = read_samples(tmp_path / "out", made.template)
    assert samples.scale == "sphere"
    reach = np.linalg.norm(samples.points, axis=2).max(1)
    assert np.allclose(reach, template_radius(made.template), rtol=0.12)
    frame = unit_frame(pear(2), "sphere", 0.5)
    assert np.linalg.norm(frame.apply(pear(2).verts), axis=1).max() == pytest.approx(0.5)


def test_landmarks_in_a_folder_of_their_own_and_as_text(pears: Path, tmp_path: Path) -> None:
    points = tmp_path / "points"
    points.mkdir()
    (points / "pear2.txt").write_text("0\n-1\n5\n")
    files = sorted(pears.glob("*.ply"))
    found = find_landmarks(points, pears, files)
    assert found == [None, None, points / "pear2.txt", None]
    clean = repair(load_shape(pears / "pear2.ply"))
    known = read_landmarks(points / "pear2.txt", clean)
    assert np.allclose(known[[0, 2]], clean.original.verts[[0, 5]]) and np.isnan(known[1]).all()
    with pytest.raises(InputError, match="has no landmarks, or not all"):
        prepared(pears, tmp_path / "out", FEW, landmarks=points, template="pear2", align="none")
    with pytest.raises(OptionError, match=r"no shape of .* has landmarks"):
        find_landmarks(".nothing", pears, files)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ([0, 99999], "names vertex 99999"),
        ([0, -2, 1], "names vertex -2"),
        ([0.5, 1.0], "holds no landmarks"),
        ([[1, 2], [3, 4]], "holds no landmarks"),
        ([], "holds no landmarks"),
        ("# only words\n", "holds no landmark"),
        (b"no numbers", "is not an npy file"),
    ],
)
def test_wrong_landmarks_are_told(tmp_path: Path, values: list | bytes | str, told: str) -> None:
    path = tmp_path / ("x.txt" if isinstance(values, str) else "x.npy")
    if isinstance(values, list):
        np.save(path, np.array(values))
    else:
        path.write_bytes(values.encode() if isinstance(values, str) else values)
    with pytest.raises(InputError) as caught:
        read_landmarks(path, repair(pear(2)))
    assert told in caught.value.message + caught.value.hint


def test_files_of_different_length_do_not_belong_together(pears: Path, tmp_path: Path) -> None:
    np.save(pears / "pear0.tips.npy", np.arange(3))
    np.save(pears / "pear2.tips.npy", np.arange(2))
    with pytest.raises(InputError, match="of 2 and of 3 points"):
        prepared(pears, tmp_path / "out", FEW, landmarks=".tips.npy", template="pear2", align="none")


def test_a_template_of_another_kind_is_refused(pears: Path, tmp_path: Path) -> None:
    needle = icosphere(3)
    save_shape(tmp_path / "needle.ply", Shape(needle.verts * [0.05, 1, 0.05], needle.faces))
    wide = NodeConfig(strategy="uniform", K=60, radius=0.6)
    with pytest.raises(InputError, match="do not resemble the template") as caught:
        prepared(pears, tmp_path / "out", wide, template=tmp_path / "needle.ply", scale="sphere", align="none")
    assert "--template" in caught.value.hint
    assert not (tmp_path / "out" / "prepared.json").exists()


def test_few_points_one_point_and_strays_are_left_out_or_told(pears: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    np.save(pears / "three.npy", np.eye(3))
    np.save(pears / "same.npy", np.ones((500, 3)))
    fog = np.concatenate([pear(3).verts[:64], rng.uniform(-9, 9, (576, 3))])  # 90 % of it are strays
    np.save(pears / "fog.npy", fog)
    made = prepared(pears, tmp_path / "out", FEW, template="pear2", align="near")
    notes = "\n".join(made.notes)
    assert "three.npy left out: it has points in only 3 places" in notes
    assert "same.npy left out" in notes
    assert "fog.npy differs much from the template" in notes


def test_a_damaged_or_foreign_folder_is_told(made: tuple[Path, Path, Prepared], pears: Path, tmp_path: Path) -> None:
    template = made[2].template
    other = prepared(pears, tmp_path / "other", FEW, template="pear1", align="none").template
    with pytest.raises(InputError, match="another template"):
        read_samples(made[1], other)
    with pytest.raises(InputError, match="not a prepared folder"):
        read_samples(tmp_path, template)
    (tmp_path / "other" / "points.safetensors").write_bytes(b"?")
    with pytest.raises(InputError, match="not a prepared folder"):
        read_samples(tmp_path / "other", other)
