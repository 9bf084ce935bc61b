"""Mirror images among the shapes of a folder."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from meshmatch.progress import Progress
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates.prepare import PrepareConfig, prepare
from meshmatch.templates.prepared_folder import has_sides
from meshmatch.templates.sides import is_other_side, mirrored, other_side
from tests.conftest import icosphere


def hook(number: int, left: bool, straight: bool = False) -> Shape:
    """A bent and twisted bar, unlike its mirror image unless straight; each a little different, in no special direction."""
    rng = np.random.default_rng(number)
    ball = icosphere(3)
    verts = ball.verts * [0.25, 0.35, 1.0 + 0.1 * rng.random()]
    x, y, z = verts.T
    if not straight:
        angle = (0.9 + 0.2 * rng.random()) * z
        x, y = x + 0.8 * z**2 - 0.2, y + 0.5 * np.maximum(z, 0)
        x, y = np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    shape = Shape(np.stack([x, y, z], 1) @ turn.T, ball.faces, f"{number}")
    return mirrored(shape) if left else shape


LEFT = [False, True, False, False, True, False]


def test_mirror_images_are_found() -> None:
    shapes = [repair(hook(number, left)) for number, left in enumerate(LEFT)]
    said: list[float] = []
    progress = Progress(lambda stage, name, share: said.append(share), "hooks").stage("sides")
    assert other_side(shapes, "area", 0, progress).tolist() == LEFT
    assert said[-1] == 1.0
    # most decide: of as many the other way round, the same shapes are the odd ones
    turned = [repair(mirrored(each.original)) for each in shapes]
    assert other_side(turned, "area", 0, Progress()).tolist() == LEFT


def test_shapes_without_sides_have_none() -> None:
    bars = [repair(hook(number, left, straight=True)) for number, left in enumerate(LEFT)]
    assert not other_side(bars, "area", 0, Progress()).any()
    assert not other_side(bars[:2], "area", 0, Progress()).any()  # two cannot outvote each other


@pytest.fixture
def hooks(tmp_path: Path) -> Path:
    (tmp_path / "hooks").mkdir()
    for number, left in enumerate(LEFT):
        shape = hook(number, left)
        shuffled = np.random.default_rng(number).permutation(shape.F)  # not registered
        save_shape(tmp_path / "hooks" / f"{number}.ply", Shape(shape.verts, shape.faces[shuffled]))
        np.save(tmp_path / "hooks" / f"{number}.landmarks.npy", shape.verts[[0, 5, 9, 200]])
    return tmp_path / "hooks"


def test_prepare_mirrors_them_with_their_landmarks(hooks: Path, tmp_path: Path) -> None:
    plan: Callable[..., PrepareConfig] = lambda mirror: PrepareConfig(  # noqa: E731
        faces=500, template="0", mirror=mirror, landmarks=".landmarks.npy"
    )
    made = prepare(hooks, tmp_path / "made", plan("auto"))
    assert made.mirrored == ("1.ply", "4.ply")
    assert any(
        note.startswith("2 of 6 shapes are mirror images of the others, and were mirrored") for note in made.notes
    )
    assert has_sides(tmp_path / "made") and not has_sides(hooks)
    as_given = prepare(hooks, tmp_path / "as_given", plan("no"))
    assert as_given.mirrored == () and not has_sides(tmp_path / "as_given")
    from safetensors.numpy import load_file

    spread = []
    for folder in ("made", "as_given"):
        known = load_file(tmp_path / folder / "points.safetensors")["landmarks"]
        spread.append(np.linalg.norm(known - known[:1], axis=2).mean(1))
    assert spread[0].max() < 0.1 < spread[1][[1, 4]].min()


@pytest.mark.parametrize("named", ["1", "4.ply", "file"])
def test_a_template_of_the_rarer_side_is_the_side(hooks: Path, tmp_path: Path, named: str) -> None:
    """By its name in the folder, or a file of its own: the four others are mirrored then."""
    if named == "file":
        save_shape(tmp_path / "another.ply", hook(9, left=True))
        named = str(tmp_path / "another.ply")
    made = prepare(hooks, tmp_path / "made", PrepareConfig(faces=500, template=named))
    assert made.mirrored == ("0.ply", "2.ply", "3.ply", "5.ply")
    made = prepare(hooks, tmp_path / "as_given", PrepareConfig(faces=500, template=named, mirror="no"))
    assert made.mirrored == ()


def test_a_template_of_the_usual_side_changes_nothing(hooks: Path, tmp_path: Path) -> None:
    save_shape(tmp_path / "another.ply", hook(9, left=False))
    made = prepare(hooks, tmp_path / "made", PrepareConfig(faces=500, template=tmp_path / "another.ply"))
    assert made.mirrored == ("1.ply", "4.ply")
    usual = [repair(hook(number, left=False)) for number in range(3)]
    assert [is_other_side(repair(hook(9, left)), usual, "area", 0) for left in (False, True)] == [False, True]
