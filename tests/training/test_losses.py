"""Losses: nothing to lose at the truth, hand-made numbers elsewhere, and every weight does something."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import FIELDS, FieldName, build_field
from meshmatch.models.deformer import Deformer
from meshmatch.models.network import NetworkConfig
from meshmatch.templates.template import Template
from meshmatch.training.datasets import Batch
from meshmatch.training.losses import CorrespondenceLoss, LossPoints, distance
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import loss_vertices
from tests.training.small import NETWORK, POINTS, SCAN, UPRIGHT, egg_template, small_data, small_network, small_points


@pytest.fixture(scope="module")
def egg() -> Template:
    return egg_template()


@pytest.fixture(scope="module")
def points(egg: Template) -> LossPoints:
    return small_points(egg)


class Constant(torch.nn.Module):
    """A decoder that answers the same node vectors to every code."""

    def __init__(self, vectors: torch.Tensor) -> None:
        super().__init__()
        self.vectors = vectors

    def forward(self, code: torch.Tensor) -> torch.Tensor:
        return self.vectors.expand(len(code), -1, -1)


def answering(egg: Template, vectors: torch.Tensor) -> tuple[Deformer, Batch]:
    """A network that always answers these vectors, and a batch whose targets are the resting template."""
    model = small_network(egg, POINTS, UPRIGHT)
    model.decoder = Constant(vectors)  # type: ignore[assignment]
    batch = small_data(egg, model, UPRIGHT)[0]
    rest = torch.from_numpy(egg.shape.verts[loss_vertices(egg, 1000)]).float()
    return model.eval(), replace(batch, targets=rest.expand(len(batch.points), -1, -1))


def terms(
    model: Deformer, batch: Batch, points: LossPoints, config: CorrespondenceLoss, seed: int = 0
) -> dict[str, float]:
    found = config(model, batch, points, torch.Generator().manual_seed(seed))
    return {name: float(value.detach()) for name, value in found.items()}


def test_the_truth_costs_nothing(egg: Template, points: LossPoints) -> None:
    found = terms(*answering(egg, torch.zeros(1, egg.K, 3)), points, CorrespondenceLoss())
    assert found["reconstruction"] == 0
    assert found["volume"] < 1e-9
    assert found["arap"] < 1e-5 * 1.01
    assert found["total"] < 2e-5


def test_terms_by_hand(egg: Template, points: LossPoints) -> None:
    """Twice as large, with the field exact for affine motions: det F = 8, F^T F - I = 3 I."""
    nodes = torch.from_numpy(egg.nodes).float()[None]
    model, batch = answering(egg, nodes)
    config = CorrespondenceLoss(reconstruction=2.0, volume=0.5, arap=0.25, blend=0.1)
    found = terms(model, batch, points, config)
    rest = batch.targets[0]
    assert found["reconstruction"] == pytest.approx(2 * float(rest.square().sum(1).mean()), rel=1e-3)
    assert found["volume"] == pytest.approx(0.5 * 49, rel=1e-2)
    assert found["arap"] == pytest.approx(0.25 * 27**0.5, rel=1e-2)
    assert found["blend"] == pytest.approx(0.1 * (49 + 27**0.5), rel=1e-2)
    assert found["error_code"] == pytest.approx(float(rest.norm(dim=1).mean()), rel=1e-3)
    weighted = sum(value for name, value in found.items() if name != "total" and "error" not in name)
    assert found["total"] == pytest.approx(weighted, rel=1e-5)
    robust = terms(model, batch, points, replace(config, robust=True))
    assert robust["reconstruction"] == pytest.approx(2 * found["error_code"], rel=1e-5)
    assert "blend" not in terms(model, batch, points, replace(config, blend=0.0))


def test_distances_by_hand() -> None:
    a = torch.tensor([[[0.0, 0, 0], [1, 1, 1]]])
    b = torch.tensor([[[3.0, 4, 0], [1, 1, 1]]])
    assert float(distance(a, b)) == pytest.approx(2.5, abs=1e-4)


def test_loss_points_are_the_field(egg: Template, points: LossPoints) -> None:
    at = loss_vertices(egg, 1000)
    field = Field.of(build_field(egg.shape.verts[at], egg.nodes, egg.radius, "smooth"))
    vectors = 0.1 * torch.randn(2, egg.K, 3, generator=torch.Generator().manual_seed(0))
    moved = field.displacement(vectors) + torch.from_numpy(egg.shape.verts[at]).float()
    assert torch.allclose(points.moved(vectors), moved, atol=1e-6)
    assert torch.allclose(points.field.deformation_gradient(vectors), field.deformation_gradient(vectors), atol=1e-4)


def test_the_kernel_reaches_the_loss(egg: Template, points: LossPoints) -> None:
    vectors = torch.randn(1, egg.K, 3, generator=torch.Generator().manual_seed(0))
    other = small_points(egg, "cubic")
    assert not torch.allclose(points.moved(vectors), other.moved(vectors), atol=1e-3)


@pytest.mark.parametrize("field", FIELDS)
def test_every_part_of_the_network_learns(egg: Template, field: FieldName) -> None:
    model = small_network(egg, replace(NETWORK, field=field))
    batch, points = small_data(egg, model)[0], small_points(egg, model=model)
    found = CorrespondenceLoss()(model, batch, points, torch.Generator().manual_seed(0))
    assert {"volume", "arap", "align", "correct", "blend", "error_align", "error_corrected"} <= found.keys()
    found["total"].backward()
    still = {n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0}
    # the last layer of a fresh residual block is zero: what stands before it learns from the second step on
    assert {name for name in still if ".widen." not in name and ".norm." not in name} == set()
    off = CorrespondenceLoss(align=0.0)(model, batch, points, torch.Generator().manual_seed(0))
    assert float(off["align"].detach()) == 0


@pytest.mark.parametrize(("network", "scan"), [(NETWORK, SCAN), (POINTS, UPRIGHT)], ids=["default", "paper"])
def test_a_step_on_another_device_waits_for_no_number_of_it(
    egg: Template, network: NetworkConfig, scan: ScanConfig
) -> None:
    """On torch's meta device, which has shapes alone: whatever asks for a value fails, as it would hold up a GPU."""
    there, model = torch.device("meta"), small_network(egg, network, scan)
    batch, points = small_data(egg, model, scan)[0], small_points(egg, model=model)
    found = CorrespondenceLoss()(model.to(there), batch.to(there), points.to(there), torch.Generator())
    found["total"].backward()
    assert all(value.is_meta and not value.shape for value in found.values())
    assert all(each.grad is not None and each.grad.shape == each.shape for each in model.parameters())


@pytest.mark.parametrize(("network", "scan"), [(NETWORK, SCAN), (POINTS, UPRIGHT)], ids=["default", "paper"])
def test_off_the_cpu_a_loss_is_one_graph(egg: Template, network: NetworkConfig, scan: ScanConfig) -> None:
    """torch can compile it as a whole, its draws included."""
    there, model = torch.device("meta"), small_network(egg, network, scan)
    batch, points = small_data(egg, model, scan)[0], small_points(egg, model=model)
    loss = torch.compile(CorrespondenceLoss(), backend="aot_eager", fullgraph=True)
    found = loss(model.to(there), batch.to(there), points.to(there), None)
    found["total"].backward()
    assert found["blend"].is_meta and all(each.grad is not None for each in model.parameters())


def test_blends_come_from_the_generator(egg: Template, points: LossPoints) -> None:
    model = small_network(egg)
    torch.nn.init.normal_(model.decoder.network[-1].weight, std=0.3)  # a fresh one hardly moves anything
    batch = small_data(egg, model)[0]
    a, b, c = (terms(model, batch, points, CorrespondenceLoss(blend=1.0), seed)["blend"] for seed in (0, 0, 1))
    assert a == b != c


def test_blends_are_of_different_shapes(egg: Template, points: LossPoints) -> None:
    """Two scans of each of three shapes, codes that name the shape: no blend is of one shape alone."""
    model = small_network(egg, POINTS, UPRIGHT)
    batch = small_data(egg, model, UPRIGHT)[0]
    batch = replace(batch, points=batch.points[:1].expand(6, -1, -1), targets=batch.targets[:1].expand(6, -1, -1))
    seen: list[torch.Tensor] = []

    class Names(torch.nn.Module):
        def forward(self, features: torch.Tensor) -> torch.Tensor:
            return torch.eye(3).repeat_interleave(2, 0)

    class Listener(torch.nn.Module):
        def forward(self, code: torch.Tensor) -> torch.Tensor:
            seen.append(code)
            return torch.zeros(len(code), egg.K, 3)

    model.encoder, model.decoder = Names(), Listener()  # type: ignore[assignment]
    terms(model, batch, points, CorrespondenceLoss(blend=1.0))
    blended = seen[1]
    assert torch.allclose(blended.sum(1), torch.ones(6)) and ((blended > 0).sum(1) == 2).all()


def test_the_aligner_errs_by_nothing_when_it_is_right(egg: Template, points: LossPoints) -> None:
    model = small_network(egg)
    batch = small_data(egg, model)[0]
    assert batch.align_rotation is not None and batch.align_center is not None
    right = torch.cat([batch.align_rotation.transpose(1, 2).flatten(1)[:, :6], batch.align_center], 1)

    class Oracle(torch.nn.Module):
        def forward(self, features: torch.Tensor) -> torch.Tensor:
            return right

    model.aligner = Oracle()  # type: ignore[assignment]
    found = terms(model, batch, points, CorrespondenceLoss())
    assert found["error_align"] < 1e-3
    assert found["align"] < 1e-3
    assert np.isfinite(found["total"])
