"""Shapes without correspondence as training data: smooth warps, normals, known points, the Chamfer objective."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from meshmatch.models.network import NetworkConfig
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.prepared_folder import ShapeSamples
from meshmatch.templates.template import Template
from meshmatch.training import datasets
from meshmatch.training.datasets import CloudDataset, build_lattice, deformed_normals, deformed_source
from meshmatch.training.loop import TrainConfig, Trainer
from meshmatch.training.losses import ChamferLoss, chamfer, held_out_error, robust
from meshmatch.training.recipes import Recipe
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import build_cloud_dataset, build_deformer, build_surface_points
from tests.training.small import egg_template

SMALL = Recipe(
    NetworkConfig(code=16, width=32, depth=1, basis=24, align_basis=0, corrections=1, correct_width=16),
    TrainConfig(
        steps=40,
        shapes=4,
        scans_per_shape=1,
        warm_up=5,
        workers=0,
        loss=ChamferLoss(volume=1e-4, arap=1e-3, blend=1e-4),
    ),
    ScanConfig(points=128),
    "smooth",
)
TOP = 0  # a known point: the template's first vertex


@pytest.fixture(scope="module")
def template() -> Template:
    return egg_template()


@pytest.fixture(scope="module")
def eggs(template: Template) -> ShapeSamples:
    """Three eggs, of which one lacks its known point; the first two samples of each are vertices 0 and 1."""
    verts, faces = template.shape.verts, template.shape.faces
    points, normals, known = [], [], []
    for n in range(3):
        shape = Shape(verts * [1, 1 + 0.15 * n, 1], faces)
        samples = sample_surface(shape, 200, np.random.default_rng(n))
        points.append(np.concatenate([shape.verts[:2], samples.points]))
        normals.append(np.concatenate([shape.vertex_normals[:2], samples.normals]))
        known.append(shape.verts[[TOP]] if n else np.full((1, 3), np.nan))
    stack = [np.stack(each).astype(np.float32) for each in (points, normals, known)]
    return ShapeSamples(*stack, np.array([TOP]), "none", "area")


@pytest.fixture(scope="module")
def data(eggs: ShapeSamples, template: Template) -> CloudDataset:
    data = build_cloud_dataset(eggs, SMALL.train, SMALL.scan)
    return replace(data, encoder=build_deformer(template, data, SMALL.network, SMALL.scan, SMALL.kernel, 0).encoder)


def test_a_lattice_reproduces_affine_maps_and_their_normals(eggs: ShapeSamples) -> None:
    lattice = build_lattice(eggs)
    assert lattice is not None
    points = torch.from_numpy(eggs.points)
    low, high = points.amin((0, 1)), points.amax((0, 1))
    half = 0.55 * float((high - low).max())
    ticks = torch.linspace(-half, half, 4)
    nodes = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    nodes = nodes + 0.5 * (low + high)
    A = torch.eye(3) + torch.tensor([[0.1, 0.2, 0.0], [0.0, -0.1, 0.1], [0.05, 0.0, 0.2]])
    vectors = nodes @ (A - torch.eye(3)).T
    for n in range(3):
        assert torch.allclose(points[n] + lattice.phi[n] @ vectors, points[n] @ A.T, atol=1e-5)
        F = (lattice.gradient[n] @ vectors[None]).transpose(-1, -2) + torch.eye(3)
        assert torch.allclose(F, A.expand_as(F), atol=1e-4)


def test_deformed_normals_by_the_inverse_transpose() -> None:
    generator = torch.Generator().manual_seed(0)
    F = torch.eye(3) + 0.3 * torch.randn(7, 3, 3, generator=generator)
    F = F * torch.det(F).sign()[:, None, None]
    n = torch.nn.functional.normalize(torch.randn(7, 3, generator=generator), dim=-1)
    slow = torch.linalg.inv(F).transpose(1, 2) @ n[..., None]
    slow = torch.nn.functional.normalize(torch.det(F)[:, None] * slow[..., 0], dim=-1)
    assert torch.allclose(deformed_normals(F, n), slow, atol=1e-5)


def test_batches_are_functions_of_seed_and_step(data: CloudDataset) -> None:
    assert torch.equal(data[3].points, data[3].points)
    assert not torch.equal(data[3].points, data[4].points)
    assert not torch.equal(data[3].points, replace(data, seed=1)[3].points)
    batch = data[0]
    assert batch.points.shape == batch.normals.shape == (4, 128, 3)
    assert torch.allclose(batch.normals.norm(dim=-1), torch.ones(4, 128), atol=1e-5)


def test_every_shape_is_drawn_before_one_comes_again(eggs: ShapeSamples, data: CloudDataset) -> None:
    still = replace(data, deform=0.0, scan=ScanConfig(points=202, noise=0, scale=0), shapes=3)
    heights = sorted(float(each[:, 1].max() - each[:, 1].min()) for each in still[0].points)
    true = sorted(float(np.ptp(each[:, 1])) for each in eggs.points)
    assert np.allclose(heights, true, atol=0.15)
    assert len({round(height, 2) for height in heights}) == 3


def test_known_points_move_with_their_shape(eggs: ShapeSamples, data: CloudDataset) -> None:
    """Vertex 0 is a sample of every shape as well as its known point: both must land on one place."""
    whole = replace(data, scan=ScanConfig(points=202, noise=0.0), shapes=6)
    seen = 0
    for step in range(3):
        batch = whole[step]
        for points, known in zip(batch.points, batch.landmarks, strict=True):
            if known.isnan().any():
                continue
            seen += 1
            assert (points - known).norm(dim=1).min() < 1e-5
    assert seen >= 6


def test_a_warp_changes_shapes_and_many_shapes_have_none(eggs: ShapeSamples, data: CloudDataset) -> None:
    calm = replace(data, deform=0.0)
    assert (data[0].points - calm[0].points).abs().max() > 0.01
    many = replace(eggs, points=np.zeros((400, 1024, 3), np.float32))
    assert build_lattice(many) is None


def test_chamfer_against_all_pairs() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 30, 3, generator=generator), torch.randn(2, 40, 3, generator=generator)
    n, m = torch.zeros(2, 30, 3), torch.zeros(2, 40, 3)
    there, back = chamfer(a, n, b, m)
    every = (a[:, :, None] - b[:, None]).square().sum(-1)
    assert torch.allclose(there, every.amin(2), atol=1e-6)
    assert torch.allclose(back, every.amin(1), atol=1e-6)


def test_neighbours_face_the_same_way() -> None:
    point = torch.zeros(1, 1, 3)
    up, down = torch.tensor([[[0.0, 0, 1]]]), torch.tensor([[[0.0, 0, -1]]])
    sheets = torch.tensor([[[0.0, 0, 0.01], [0.0, 0, -0.05]]])
    there, _ = chamfer(point, up, sheets, torch.cat([down, up], 1))
    assert there.item() == pytest.approx(0.05**2)  # not the nearer sheet, which faces away


def test_the_robust_function() -> None:
    squared = torch.tensor([1e-6, 100.0, 400.0])
    small, far, further = robust(squared).tolist()
    assert small == pytest.approx(1e-6, rel=1e-3)
    assert further - far < 0.01 * far  # what is far away pulls no harder


def test_plain_chamfer_is_squared_distances_by_position(template: Template, data: CloudDataset) -> None:
    model = build_deformer(template, data, SMALL.network, SMALL.scan, SMALL.kernel, 0).eval()
    points = build_surface_points(template, "smooth", model, np.zeros(0, np.int64), 60)
    batch = data[0]
    loss = ChamferLoss(blend=0.0, landmarks=0.0, plain=True)
    terms = loss(model, batch, points, torch.Generator())
    with torch.no_grad():
        moved = points.moved(model.decoder(model.encoder(batch.encode_features)))
    every = (moved[:, :, None] - batch.points[:, None]).square().sum(-1)
    assert terms["reconstruction"].item() == pytest.approx(float(every.amin(2).mean() + every.amin(1).mean()), rel=1e-4)


def test_known_points_are_pulled_to_their_places(eggs: ShapeSamples, template: Template, data: CloudDataset) -> None:
    model = build_deformer(template, data, SMALL.network, SMALL.scan, SMALL.kernel, 0).eval()
    points = build_surface_points(template, "smooth", model, eggs.template_landmarks, 60)
    batch = data[0]
    loss = ChamferLoss(blend=0.0, landmarks=2.0)
    terms = loss(model, batch, points, torch.Generator())
    with torch.no_grad():
        vectors = model.decoder(model.encoder(batch.encode_features))
    placed = points.landmarks + points.landmark_field.displacement(vectors)
    apart = (placed - batch.landmarks).square().sum(-1)
    known = ~apart.isnan()
    assert 0 < int(known.sum()) < 4  # the egg without one pulls nothing
    assert terms["landmarks"].item() == pytest.approx(2.0 * float(apart[known].mean()), rel=1e-4)
    without = replace(loss, landmarks=0.0)(model, batch, points, torch.Generator())
    assert "landmarks" not in without
    names = {"total", "reconstruction", "volume", "arap", "correct", "error"}
    assert set(without) == names
    assert without["total"].item() == pytest.approx(
        sum(float(without[name].detach()) for name in names - {"total", "error"}), rel=1e-5
    )


def test_it_learns(eggs: ShapeSamples, template: Template, data: CloudDataset) -> None:
    model = build_deformer(template, data, SMALL.network, SMALL.scan, SMALL.kernel, 0)
    points = build_surface_points(template, "smooth", model, eggs.template_landmarks, 150)
    stretched = replace(data, encoder=model.encoder, length=150)
    held_out = replace(stretched, seed=99, shapes=6)[0]
    before = held_out_error(model, held_out, points)
    trainer = Trainer(model, points, replace(SMALL.train, steps=150, rate=3e-3))
    trainer.run(stretched)
    assert held_out_error(model, held_out, points) < 0.9 * before


def test_few_registered_shapes_are_deformed_at_every_drawing(
    template: Template, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(datasets, "_UNDEFORMED_SHARE", 0.5)
    verts = torch.from_numpy(np.array(template.shape.verts)).float()
    shapes = torch.stack([verts, verts * torch.tensor([1.0, 1.2, 1.0])])
    generator = torch.Generator().manual_seed(0)
    drawn = deformed_source(100 + 20 * shapes, deform=0.1)(64, generator)
    centred = shapes - shapes.mean(1, keepdim=True)
    own = 0.3 * centred / centred.flatten(1).std(1)[:, None, None]
    apart = (drawn[:, None] - own[None]).norm(dim=-1).mean(-1).min(1).values
    assert 0.3 < float((apart < 1e-5).float().mean()) < 0.7  # plain ones, of both shapes, in one size
    assert 0.01 < float(apart.max()) < 0.2
    # smooth: neighbours move together
    ends = torch.from_numpy(np.array(template.shape.faces[:, :2]))
    moved = drawn[int(apart.argmax())] - own[0]
    step = (moved[ends[:, 0]] - moved[ends[:, 1]]).norm(dim=1).mean()
    assert float(step) < 0.5 * float(moved.norm(dim=1).mean())
    plain = deformed_source(shapes, deform=0.0)(3, generator)
    assert any(torch.allclose(plain[0], each) for each in centred)
