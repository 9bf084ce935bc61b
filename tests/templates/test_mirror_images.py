"""Mirror images among the shapes of a folder."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from meshmatch.api.prepare import PrepareConfig, Prepared, prepare
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.progress import Progress
from meshmatch.shapes.alignment import Mirroring
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.mirror_images import find_mirrored, mirrored
from meshmatch.templates.prepared_folder import has_sides, medoid
from tests.conftest import icosphere


def hook(number: int, left: bool, straight: bool = False, turned: bool = True) -> Shape:
    """A bent and twisted bar, unlike its mirror image unless straight; each a little different."""
    rng = np.random.default_rng(number)
    ball = icosphere(3)
    verts = ball.verts * [0.25, 0.35, 1.0 + 0.1 * rng.random()]
    x, y, z = verts.T
    if not straight:
        angle = (0.9 + 0.2 * rng.random()) * z
        x, y = x + 0.8 * z**2 - 0.2, y + 0.5 * np.maximum(z, 0)
        x, y = np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y
    verts = np.stack([x, y, z], 1)
    if turned:
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        verts = verts @ (turn * np.sign(np.linalg.det(turn))).T
    shape = Shape(verts, ball.faces, f"{number}")
    return mirrored(shape) if left else shape


@pytest.mark.parametrize(
    "left", [[True, False, False], pytest.param([False, True, False, False, True, False], marks=pytest.mark.slow)]
)
def test_mirror_images_are_found(left: list[bool]) -> None:
    shapes = [repair(hook(number, each)) for number, each in enumerate(left)]
    said: list[float] = []
    progress = Progress(lambda stage, name, share: said.append(share), "hooks").stage("sides")
    assert find_mirrored(shapes, "area", 0, progress).tolist() == left
    assert said[-1] == 1.0
    assert not find_mirrored(shapes[:2], "area", 0, Progress()).any()  # two cannot outvote each other


def test_shapes_without_sides_have_none() -> None:
    bars = [repair(hook(number, number == 0, straight=True)) for number in range(3)]
    assert not find_mirrored(bars, "area", 0, Progress()).any()


LEFT = [False, True, False]


@pytest.fixture(scope="module")
def hooks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three hooks that stand alike but for their side, with landmarks."""
    folder = tmp_path_factory.mktemp("hooks")
    for number, left in enumerate(LEFT):
        shape = hook(number, left, turned=False)
        shuffled = np.random.default_rng(number).permutation(shape.F)  # not registered
        save_shape(folder / f"{number}.ply", Shape(shape.verts, shape.faces[shuffled]))
        np.save(folder / f"{number}.landmarks.npy", shape.verts[[0, 5, 9, 200]])
    return folder


def prepared(hooks: Path, output: Path, **choices) -> Prepared:
    return prepare(hooks, output, PrepareConfig(faces=500, align="none", **choices))


def test_prepare_mirrors_them_with_their_landmarks(hooks: Path, tmp_path: Path) -> None:
    made = prepared(hooks, tmp_path / "made", template="0", landmarks=".landmarks.npy")
    assert made.mirrored == ("1.ply",)
    assert any(note.startswith("1 of 3 shapes are mirror images") for note in made.notes)
    assert has_sides(tmp_path / "made") and not has_sides(hooks)
    as_given = prepared(hooks, tmp_path / "as_given", template="0", landmarks=".landmarks.npy", mirror="no")
    assert as_given.mirrored == () and not has_sides(tmp_path / "as_given")
    spread = []
    for folder in ("made", "as_given"):
        known = load_file(tmp_path / folder / "points.safetensors")["landmarks"]
        spread.append(np.linalg.norm(known - known[:1], axis=2).mean(1))
    assert spread[0].max() < 0.1 < spread[1][1]


@pytest.mark.parametrize(
    ("template", "odd"),
    [
        ("1.ply", ("0.ply", "2.ply")),
        (hook(9, True, turned=False), ("0.ply", "2.ply")),
        (hook(9, False, turned=False), ("1.ply",)),
    ],
    ids=["of the folder", "left", "right"],
)
def test_the_side_is_that_of_a_named_template(
    hooks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, template: str | Shape, odd: tuple[str, ...]
) -> None:
    """By its name in the folder, or a file of its own."""
    monkeypatch.setattr("meshmatch.api.prepare.find_mirrored", lambda *_: np.array(LEFT))  # as the test above found
    if isinstance(template, Shape):
        save_shape(tmp_path / "another.ply", template)
        template = str(tmp_path / "another.ply")
    assert prepared(hooks, tmp_path / "made", template=template).mirrored == odd


@pytest.fixture(scope="module")
def turned_hooks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five hooks, three of them left, each turned in its own way."""
    folder = tmp_path_factory.mktemp("turned")
    for number in range(5):
        save_shape(folder / f"{number}.ply", hook(number, number in (1, 2, 4)))
    return folder


@pytest.mark.parametrize(
    ("template", "mirror", "odd"),
    [
        (None, "auto", ("0.ply", "3.ply")),
        ("0", "auto", ("1.ply", "2.ply", "4.ply")),
        pytest.param("0", "no", (), marks=pytest.mark.slow),
    ],
)
def test_fits_tell_sides_and_turns(
    turned_hooks: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    template: str | None,
    mirror: Mirroring,
    odd: tuple[str, ...],
) -> None:
    few = partial(ViscousConfig, nodes=200, radius=0.15, faces=600)
    monkeypatch.setattr("meshmatch.api.prepare.ViscousConfig", few)
    monkeypatch.setattr("meshmatch.fitting.without_model._QUICK_SAMPLES", 800)
    monkeypatch.setattr("meshmatch.api.prepare.find_mirrored", None)  # it is not asked
    nodes = NodeConfig("uniform", 60, 0.35)
    made = prepare(turned_hooks, tmp_path / "made", PrepareConfig(nodes, faces=500, template=template, mirror=mirror))
    assert made.mirrored == odd
    apart = json.loads((tmp_path / "made" / "prepared.json").read_text())["apart"]
    assert max(apart) < 0.08 or mirror == "no"


def test_what_lies_nearest_to_all_may_be_a_mirror_image() -> None:
    one = hook(0, left=False, turned=False)
    sizes = [Shape(one.verts * [1, 1, long], one.faces, f"{long}") for long in (0.75, 1.0, 1.3)]
    shapes = [repair(mirrored(each) if number == 1 else each) for number, each in enumerate(sizes)]
    assert medoid(shapes, "rigid", "area", 0) != 1
    assert medoid(shapes, "rigid", "area", 0, either_side=True) == 1
