"""Batches: functions of (seed, step), and true to the frames that they speak of."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from meshmatch.errors import InputError, TemplateError
from meshmatch.geometry.frames import kabsch
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import BasisEncoder
from meshmatch.templates.template import Template
from meshmatch.training.datasets import Batch, BatchDataset, registered_source, step_generator
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import anchor_vertices, build_dataset, fill_basis, loss_vertices
from tests.training.small import UPRIGHT, egg_template, small_data, small_network

CLEAN = replace(UPRIGHT, upright=False, points=400)


class Seen(BasisEncoder):
    """A reader whose features are the very points it is shown."""

    def features(self, points: torch.Tensor) -> torch.Tensor:
        return points


@pytest.fixture(scope="module")
def egg() -> Template:
    return egg_template()


@pytest.fixture(scope="module")
def network(egg: Template) -> Deformer:
    return small_network(egg)


def still(egg: Template, scan: ScanConfig) -> BatchDataset:
    """Batches of the template itself, in another unit and place, with readers that show what they see."""
    rest = torch.from_numpy(np.array(egg.shape.verts)).float()
    seen = Seen(torch.zeros(2, 3), 4, 0, 9)
    data = build_dataset(egg, lambda count, _: (7 * rest + 2).expand(count, -1, -1), small_network(egg), scan, 3, 2, 0)
    return replace(data, encoder=seen, aligner=seen)


def tensors(batch: Batch) -> list[torch.Tensor]:
    return [value for value in vars(batch).values() if value is not None]


def test_a_batch_is_a_function_of_seed_and_step(egg: Template, network: Deformer) -> None:
    data = small_data(egg, network, seed=3)
    first = tensors(data[7])
    torch.rand(5)  # whatever else draws from the global stream
    small_data(egg, network, seed=3)[2]
    for a, b in zip(first, tensors(small_data(egg, network, seed=3)[7]), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(first[0], data[8].points)
    assert not torch.equal(first[0], small_data(egg, network, seed=4)[7].points)
    assert len(data) == 40


def test_steps_and_seeds_do_not_share_streams(egg: Template, network: Deformer) -> None:
    streams = {step_generator(seed, step).initial_seed() for seed in range(20) for step in range(50)}
    assert len(streams) == 1000


def test_a_batch_has_the_sizes_it_says(egg: Template, network: Deformer) -> None:
    batch = small_data(egg, network)[0]
    assert batch.points.shape == (8, 96, 3)
    assert batch.targets.shape == (8, 162, 3)
    assert batch.encode_features.shape == (8, 24, 3)
    assert batch.align_features is not None and batch.align_features.shape == (8, 16, 3)
    assert all(tensor.isfinite().all() for tensor in tensors(batch))
    moved = batch.to(torch.device("cpu"))
    assert torch.equal(moved.points, batch.points)
    bare = replace(batch, align_features=None, align_rotation=None, align_center=None)
    assert bare.to(torch.device("cpu")).align_rotation is None


def test_scans_lie_nearly_on_the_template_in_the_core_frame(egg: Template) -> None:
    batch = still(egg, CLEAN)[0]
    assert torch.equal(batch.encode_features, batch.points)
    rest = torch.from_numpy(egg.shape.verts[loss_vertices(egg, 1000)]).float()
    for points, targets in zip(batch.points, batch.targets, strict=True):
        # targets are the template, turned and shifted a little; points lie on the same surface
        pose = kabsch(rest.double().numpy(), targets.double().numpy())
        turn, shift = pose.rotation, pose.center
        assert np.allclose(rest.numpy() @ turn.T + shift, targets.numpy(), atol=1e-5)
        assert np.linalg.norm(shift) < 0.2
        assert np.trace(turn) > 1  # less than a quarter turn
        unturned = (points.numpy() - shift) @ turn
        assert cKDTree(egg.shape.verts).query(unturned)[0].max() < 0.12  # half an edge
    turns = [np.trace(kabsch(rest.double().numpy(), t.double().numpy()).rotation) for t in batch.targets]
    assert np.std(turns) > 1e-4


def test_the_aligner_is_told_where_the_core_is(egg: Template) -> None:
    """scan = R core + t: undone, the scan that the aligner sees lies on the resting template."""
    batch = still(egg, CLEAN)[0]
    assert batch.align_features is not None and batch.align_rotation is not None
    assert batch.align_center is not None
    assert torch.allclose(batch.align_features.mean(1), torch.zeros(6, 3), atol=1e-5)
    for points, R, t in zip(batch.align_features, batch.align_rotation, batch.align_center, strict=True):
        in_core = (points - t) @ R
        assert cKDTree(egg.shape.verts).query(in_core.numpy())[0].max() < 0.12
    assert batch.align_rotation.diagonal(dim1=1, dim2=2).sum(1).min() < 0.5  # turned anywhere


def test_upright_scans_turn_about_the_vertical_alone(egg: Template) -> None:
    batch = still(egg, UPRIGHT)[0]
    rest = egg.shape.verts[loss_vertices(egg, 1000)]
    for targets, points in zip(batch.targets, batch.points, strict=True):
        turn = kabsch(rest, targets.double().numpy()).rotation
        assert np.allclose(turn[1], [0, 1, 0], atol=1e-4)
        assert torch.allclose(points.mean(0), torch.zeros(3), atol=1e-5)


def test_upright_scans_without_yaw_stand_as_the_template(egg: Template) -> None:
    (targets, *_) = still(egg, replace(UPRIGHT, yaw=False))[0].targets
    rest = egg.shape.verts[loss_vertices(egg, 1000)]
    assert np.allclose(kabsch(rest, targets.double().numpy()).rotation, np.eye(3), atol=1e-4)


def test_several_scans_of_one_shape_differ(egg: Template, network: Deformer) -> None:
    batch = small_data(egg, network)[0]
    assert not torch.equal(batch.points[0], batch.points[1])
    # the same shape: targets are congruent up to the scan's size
    spread = [np.linalg.norm(t - t.mean(0), axis=1) for t in batch.targets.numpy()]
    same = spread[0] / spread[0].mean() - spread[1] / spread[1].mean()
    other = spread[0] / spread[0].mean() - spread[2] / spread[2].mean()
    assert np.abs(same).max() < 1e-4 < np.abs(other).max()


def test_a_source_gives_shapes_on_the_templates_vertices(egg: Template, network: Deformer) -> None:
    data = small_data(egg, network)

    def drawing(change: Callable[[torch.Tensor], Any]) -> Batch:
        return replace(data, source=lambda count, generator: change(data.source(count, generator)))[0]

    assert torch.equal(drawing(lambda verts: verts.double().numpy()).points, data[0].points)
    for change in (lambda v: v[0], lambda v: v[:3], lambda v: v[:, :9], lambda v: v[..., :2], lambda v: None):
        with pytest.raises(InputError, match="a source must return"):
            drawing(change)
    with pytest.raises(InputError, match="nan or infinite"):
        drawing(lambda verts: verts / 0)
    with pytest.raises(InputError, match="all in one place"):
        drawing(lambda verts: 0 * verts)
    with pytest.raises(InputError, match="a function that draws shapes, not str"):
        replace(data, source="eggs")[0]  # type: ignore[arg-type]


def test_registered_shapes_are_drawn_wherever_they_lie() -> None:
    shapes = torch.stack([torch.full((5, 3), float(n)) for n in range(4)])
    shapes[:, 0] += 1 + torch.arange(4.0)[:, None]
    drawn = registered_source(shapes + 100)(200, torch.Generator().manual_seed(0))
    assert drawn.shape == (200, 5, 3)
    assert torch.allclose(drawn.mean(1), torch.zeros(200, 3), atol=1e-4)
    marks = drawn[:, 0, 0].mul(5 / 4).round().int()
    assert set(marks.tolist()) == {1, 2, 3, 4}
    assert marks.bincount()[1:].min() > 25


def test_basis_points_lie_where_the_shapes_are() -> None:
    generator = torch.Generator().manual_seed(0)
    sphere = torch.nn.functional.normalize(torch.randn(4, 800, 3, generator=generator), dim=-1)
    basis = fill_basis(sphere, 60, generator)
    assert basis.shape == (60, 3)
    assert (basis.norm(dim=1) - 1).abs().max() < 0.25
    assert torch.pdist(basis).min() > 0.15  # spread


def test_more_nodes_than_vertices_are_refused(egg: Template) -> None:
    with pytest.raises(TemplateError, match="200 nodes but only 162 vertices") as caught:
        anchor_vertices(egg, 200)
    assert "fewer nodes" in caught.value.hint
    assert len(set(anchor_vertices(egg, 162))) == 162
