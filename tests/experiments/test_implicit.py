"""What the table of implicit surfaces counts, and how real shapes are compared."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("skimage", reason="scikit-image is of the extra `implicit`")


from meshmatch.experiments.paper import implicit
from meshmatch.experiments.paper.implicit import (
    FRAMES,
    chamfer,
    interpolation,
    label_transfer,
    labelled_points,
    means,
    pairs_of,
    reconstruction,
)
from meshmatch.implicit.model import ImplicitModel
from meshmatch.implicit.network import ImplicitConfig, ImplicitNetwork
from meshmatch.implicit.space import CUBE_RADIUS, cube_nodes
from meshmatch.models.card import ImplicitCard
from meshmatch.shapes.sampling import sample_surface
from tests.implicit.boxes import box, box_sdf

ONE, TWO = ((0.0, 0.0, 0.0),), ((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0))


def card_of(count: int, scale: float) -> ImplicitCard:
    names, frames = [f"plane{k}" for k in range(count)], [[scale, 0, 0, 0]] * count
    return ImplicitCard(
        name="planes", category="plane", network={}, shapes=names, frames=frames, data="", licence="", recipe={}, seed=0,
        steps=0, training_minutes=0.0, weights_sha256="0" * 64, created="2026-01-31",
    )  # fmt: skip


class Balls:
    """In place of a network: balls whose radius is the square of the code, all of them moved along x to the template."""

    def __init__(self, codes: list[float], centers: tuple[tuple[float, ...], ...], moved: float = 0.0) -> None:
        self.codes, self.centers, self.moved = torch.tensor(codes)[:, None], torch.tensor(centers), moved

    def distance(self, points: torch.Tensor, code: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        off = (points[:, :, None] - self.centers).norm(dim=-1).amin(2) - code.square()
        return off, points + torch.tensor([self.moved, 0.0, 0.0])

    def __call__(self, points: torch.Tensor, code: torch.Tensor) -> Any:
        return SimpleNamespace(F=torch.diag(torch.tensor([2.0, 1.0, 1.0])).expand(*points.shape, 3))


def balls(*codes: float, centers: tuple[tuple[float, ...], ...] = ONE, moved: float = 0.0) -> ImplicitModel:
    """A model of balls, in files that are twice as large as the cube."""
    network: Any = Balls(list(codes), centers, moved)
    return ImplicitModel(card_of(len(codes), 2.0), network)


@pytest.fixture(scope="module")
def model() -> ImplicitModel:
    """Two planes whose deformation is a random one."""
    card = card_of(2, 0.6)
    torch.manual_seed(0)
    nodes = torch.from_numpy(cube_nodes()).float()
    config = ImplicitConfig("mls", code=8, width=16, depth=2, inner=8, nodes=4)
    return ImplicitModel(card, ImplicitNetwork(config, 2, nodes, torch.full((len(nodes),), CUBE_RADIUS)).eval())


def test_labels_arrive_where_they_came_from(model: ImplicitModel) -> None:
    points = labelled_points("plane", [0, 1], 0)
    same = label_transfer(model, points, [(0, 0), (1, 1)])
    assert same == {"label_iou": 1, "facing_iou": 1, "undeformed_iou": 1}
    other = label_transfer(model, points, [(0, 1)])
    assert 0.1 < other["label_iou"] < 1


def test_distances_of_both_ways_count_alike() -> None:
    one, two = np.array([[0.0, 0, 0]]), np.array([[0.0, 0, 0], [3, 0, 0]])
    assert chamfer(one, two) == chamfer(two, one) == pytest.approx(0.75)  # (0 + (0 + 3) / 2) / 2
    assert chamfer(two, two) == 0


@pytest.mark.parametrize("centers", [ONE, TWO])
def test_the_way_from_a_shape_to_itself_is_a_standstill(centers: tuple[tuple[float, ...], ...]) -> None:
    with np.errstate(invalid="ignore"):  # nothing moves, so no part of the motion is bent
        found = interpolation(balls(0.6, centers=centers), [(0, 0)])
    assert [found["bend"], found["volume_change"]] == pytest.approx([0, 0], abs=1e-4)
    assert found["pieces"] == len(centers)
    assert found["volume_energy"] == pytest.approx(1)  # (det F - 1)^2
    assert found["arap_energy"] == pytest.approx(3)  # |F'F - I|


def test_the_way_between_two_balls_by_hand() -> None:
    """Radii are squares of codes that go evenly, so their second difference is 2 h^2, and the first 2 c h."""
    codes = np.linspace(0.6, 0.8, FRAMES)
    h, times = codes[1] - codes[0], np.linspace(0, 1, FRAMES)
    found = interpolation(balls(0.6, 0.8), [(0, 1)])
    assert found["bend"] == pytest.approx(100 / 1.7 * 2 * h**2, rel=1e-3)
    assert found["bend_share"] == pytest.approx(np.mean(h / codes[1:-1]), rel=1e-3)
    volumes = codes**6
    even = volumes[0] + times * (volumes[-1] - volumes[0])
    assert found["volume_change"] == pytest.approx(100 * np.abs(volumes / even - 1).mean(), rel=0.02)
    assert found["pieces"] == 1


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_errors_of_a_box_that_is_learned_in_part(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is learned is the whole box, or what of it lies at x below 0."""
    half = np.array([0.8, 0.4, 0.5])
    part, center = half * [share, 1, 1], np.array([(share - 1) * half[0], 0, 0])

    def drawn(count: int, rng: np.random.Generator) -> tuple[np.ndarray]:
        return (sample_surface(box(2 * half), count, rng).points,)

    truth = SimpleNamespace(sample=drawn, field=lambda at: box_sdf(at, 2 * half), surface=box(2 * half))
    monkeypatch.setattr(implicit, "furniture", lambda kind, seed, number: truth)
    learned = balls(0.0)
    monkeypatch.setattr(
        learned.network,
        "distance",
        lambda at, code: (torch.from_numpy(box_sdf(at[0].numpy() - center, part))[None], at),
    )
    found = reconstruction(learned, "plane", [0], 0)
    assert found["iou"] == pytest.approx(share, abs=0.03)
    if share == 1:
        assert found["chamfer"] < 1  # % of the side: about the spacing of points
    else:
        assert 5 < found["chamfer"] < 25  # half of the points are up to half a side away


def test_means_over_trainings_keep_what_they_are_of() -> None:
    one = {"chamfer": 1.0, "label_iou": 0.5, "facing_iou": 0.6, "bend": 1.0, "asked": {"seed": 0}}
    assert "label_iou_sd" not in means([one])
    found = means([one, one | {"label_iou": 0.7}])
    assert found["label_iou"] == pytest.approx(0.6)
    assert found["label_iou_sd"] == pytest.approx(np.sqrt(0.02))
    assert found["trainings"]["label_iou"] == [0.5, 0.7]


def test_pairs_are_of_different_shapes() -> None:
    assert all(a != b for a, b in pairs_of(4, 50, 0))
    assert pairs_of(4, 50, 0) == pairs_of(4, 50, 0)
