"""What the table of implicit surfaces counts, and how real shapes are compared."""

import numpy as np
import pytest
import torch

pytest.importorskip("skimage", reason="scikit-image is of the extra `implicit`")

from meshmatch.experiments.implicit import label_transfer, labelled_points, means, pairs_of, part_iou
from meshmatch.experiments.implicit_real import undeformed
from meshmatch.geometry.frames import Frame
from meshmatch.implicit.model import ImplicitFit, ImplicitModel
from meshmatch.implicit.network import ImplicitConfig, ImplicitNetwork
from meshmatch.implicit.space import CUBE_RADIUS, cube_nodes
from meshmatch.models.implicit_card import ImplicitCard
from tests.implicit.boxes import box


@pytest.fixture(scope="module")
def model() -> ImplicitModel:
    """Two planes whose deformation is a random one."""
    card = ImplicitCard(
        name="planes", category="plane", network={}, shapes=["plane0", "plane1"], frames=[[0.6, 0, 0, 0]] * 2, data="",
        licence="", recipe={}, seed=0, steps=0, training_minutes=0.0, weights_sha256="", created="",
    )  # fmt: skip
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


def test_overlap_of_parts() -> None:
    truth, found = np.array([0, 0, 1, 1]), np.array([0, 1, 1, 1])
    assert part_iou(truth, found, [0, 1]) == pytest.approx((1 / 2 + 2 / 3) / 2)


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


def test_undeformed_shapes_are_matched_in_the_cube() -> None:
    small, large = box(np.array([0.5, 0.2, 0.3])), box(np.array([5.0, 2.0, 3.0]))
    fits = [ImplicitFit("box", torch.zeros(1), Frame(size, np.eye(3), np.zeros(3))) for size in (1.0, 10.0)]
    assert np.array_equal(undeformed(small, large, *fits).index, np.arange(8))
