"""Labels carried by models of generated shapes: the templates, one small training of ours, its tests."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("skimage", reason="scikit-image is of the extra `bench`")

from meshmatch.experiments.makers.furniture import KINDS, furniture
from meshmatch.experiments.paper import part_transfer
from meshmatch.experiments.paper.part_transfer import Learned, chosen_templates, cloud_template, learned_shapes
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.network import PAPER
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, template_radius
from meshmatch.training.recipes import Recipe
from tests.conftest import icosphere


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Learned:
    return learned_shapes("plane", 4, 0, tmp_path_factory.mktemp("learned") / "samples.npz")


def test_shapes_are_drawn_once_and_of_radius_one(learned: Learned, tmp_path: Path) -> None:
    again = learned_shapes("plane", 4, 0, tmp_path / "samples.npz")
    kept = learned_shapes("plane", 4, 0, tmp_path / "samples.npz")
    for one in (again, kept):
        assert np.array_equal(one.points, learned.points) and np.array_equal(one.parts, learned.parts)
    assert 0.95 < np.linalg.norm(learned.points, axis=2).max() <= 1.001
    assert np.allclose(np.linalg.norm(learned.normals, axis=2), 1, atol=1e-5)


def test_templates_are_near_to_all_and_the_first_has_every_part() -> None:
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(300, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    sizes = [1.0, 1.01, 0.99, 3.0, 3.02, 0.2]
    points = np.stack([size * ball for size in sizes]).astype(np.float32)
    parts = np.zeros((6, 300), np.int64)
    parts[[1, 5], :100] = 1
    shapes = Learned(points, points, parts)
    chosen = chosen_templates(shapes, 2, 2)
    assert chosen[0] == 1 and chosen[1] in (3, 4)


def test_the_papers_template_is_a_labelled_cloud() -> None:
    template = cloud_template("plane", 0, 2)
    assert template.radius == pytest.approx(0.4 * template_radius(template), rel=0.02)  # a fifth of the diameter
    assert 300 <= template.K < 330
    assert template.dense is template.shape and set(template.labels) == {0, 1, 2}


def test_the_papers_way_is_the_papers(learned: Learned, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cloud as the template, its network and weights, as it is fitted and after 200 steps on the code."""
    asked: dict[str, Any] = {}

    def learn(folder: Path, template: Template, shapes: Learned, recipe: Recipe) -> Any:
        asked.update(template=template, recipe=recipe)
        return SimpleNamespace(card=SimpleNamespace(training_minutes=1.0))

    def overlap(give: Any, kind: str, numbers: range, seed: int) -> dict[str, Any]:
        asked.setdefault("configs", []).append(give)
        return {"generated_iou": 0.5}

    monkeypatch.setattr(part_transfer, "learn", learn)
    monkeypatch.setattr(part_transfer, "by_models", lambda models, config: config)
    monkeypatch.setattr(part_transfer, "part_overlap", overlap)
    monkeypatch.setattr(part_transfer, "best_maps", lambda *given: {})
    monkeypatch.setattr(part_transfer, "real_shapes", lambda *given: ({}, {}))
    monkeypatch.setattr(part_transfer, "keypoint_errors", lambda *given: {"arrived": 1.0})
    monkeypatch.setattr(part_transfer, "learned_shapes", lambda *given: learned)
    plan = part_transfer.Plan(tmp_path, tmp_path, 4, 1, {"paper": 7}, 3, 1, 0)
    rows = part_transfer.measure("plane", plan, ["paper"])
    assert [row["method"] for row in rows] == ["paper, network alone", "paper, 200 steps"]
    assert asked["template"].dense is asked["template"].shape and 300 <= asked["template"].K < 330
    recipe = asked["recipe"]
    assert (recipe.network, recipe.train.steps, recipe.train.loss.plain) == (PAPER, 7, True)
    assert (recipe.train.loss.volume, recipe.train.loss.arap, recipe.train.loss.blend) == (1e-4, 1e-3, 1e-4)
    alone, searched = asked["configs"]
    assert (alone.refine, searched.refine, searched.latent.steps) == ("none", "latent", 200)


@pytest.mark.parametrize("kind", KINDS)
def test_real_shapes_are_turned_like_generated_ones(kind: str) -> None:
    turn = part_transfer.UPRIGHT[kind]
    assert np.linalg.det(turn) == 1 and np.array_equal(turn @ turn.T, np.eye(3))
    assert furniture(kind, 0, 0).kind == kind


def test_errors_of_keypoints_by_hand(cube: Shape) -> None:
    shapes, points = {"a": cube, "b": cube}, {"a": np.arange(4), "b": np.arange(4)}
    index = np.arange(8)
    index[3] = 2  # an edge away: 1 / sqrt(3) of the diagonal
    found = part_transfer.keypoint_errors(shapes, points, {("a", "b"): VertexMap("a", "b", index)})
    assert found["mean"] == pytest.approx(1 / np.sqrt(3) / 4, abs=1e-3)
    assert (found["median"], found["arrived"], found["pairs"]) == (0.0, 0.75, 1)


def test_overlap_of_parts_by_hand() -> None:
    truth, found = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 1])
    area = np.array([1.0, 1.0, 2.0, 0.0])
    assert part_transfer.mean_overlap(found, truth, area) == pytest.approx((1 / 2 + 2 / 3) / 2)
    ball = icosphere(1)
    at = np.array([ball.verts[:, 2].argmin(), ball.verts[:, 2].argmax()])
    parts = part_transfer.keypoint_parts(ball, at)
    assert parts[at[0]] == 0 and parts[at[1]] == 1
    assert (parts[ball.verts[:, 2] > 0.01] == 1).all()


def test_shapes_are_stood_alike() -> None:
    ball = icosphere(1)
    verts = ball.verts * [1, 2, 3]
    points = np.array([verts[:, k].argmax() for k in range(3)])
    turn = Rotation.create_group("O").as_matrix()[7]
    shapes = {"a": Shape(verts, ball.faces), "b": Shape(verts @ turn.T, ball.faces)}
    stood = part_transfer.stood_alike(shapes, {"a": points, "b": points})
    assert np.allclose(stood["b"].verts, verts)
