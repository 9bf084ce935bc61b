"""Simulated scans: by hand on flat squares, by law on eggs, and every roughness seen to do something."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from meshmatch.shapes.shape import Shape
from meshmatch.training.scans import (
    ScanConfig,
    bump,
    normalise,
    random_rotations,
    rigid_fit,
    sample_scan,
    seen_from_outside,
    seen_share,
    small_rotations,
    stray_points,
    surface_area,
    yaw_rotations,
)
from tests.conftest import icosphere

CLEAN = ScanConfig(points=4000, noise=0, holes=0, outliers=0, partial=0, density=0)
# The unit square z = 0 in two triangles, the second of them cut in four.
SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0], [0, 0.5, 0], [0.5, 1, 0]])
CORNERS = torch.tensor([[0, 1, 2], [0, 4, 5], [4, 2, 6], [5, 6, 3], [4, 6, 5]])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scan(config: ScanConfig, seed: int = 0, B: int = 1) -> torch.Tensor:
    verts = SQUARE.expand(B, -1, -1)
    areas, _ = surface_area(verts, CORNERS)
    return sample_scan(verts, areas, CORNERS, config, seeded(seed))


def test_areas_and_centroid_by_hand() -> None:
    area, centroid = surface_area(SQUARE[None] * 2 + 5, CORNERS)
    assert torch.allclose(area, torch.tensor([[2.0, 0.5, 0.5, 0.5, 0.5]]))
    assert torch.allclose(centroid, torch.tensor([[6.0, 6, 5]]))


def test_normalised_shapes_agree_with_the_shapes_room(torus: Shape) -> None:
    verts = torch.from_numpy(np.stack([torus.verts * [3, 1, 1] + 4, torus.verts])).float()
    out, areas = normalise(verts, torch.from_numpy(torus.faces.copy()))
    assert torch.allclose(areas.sum(1), torch.ones(2), atol=1e-5)
    for one in out:
        shape = Shape(one.double().numpy(), torus.faces)
        assert shape.area == pytest.approx(1, rel=1e-4)
        middle = (shape.face_areas[:, None] * shape.verts[shape.faces].mean(1)).sum(0)
        assert np.allclose(middle, 0, atol=1e-4)


@pytest.mark.parametrize("draw", [random_rotations, small_rotations, yaw_rotations])
def test_rotations_are_proper_and_seeded(draw) -> None:
    R = draw(300, seeded(1))
    assert torch.allclose(R @ R.transpose(1, 2), torch.eye(3).expand(300, 3, 3), atol=1e-5)
    assert torch.allclose(torch.det(R), torch.ones(300), atol=1e-5)
    assert torch.equal(R, draw(300, seeded(1)))
    assert not torch.equal(R, draw(300, seeded(2)))
    turned = R @ torch.tensor([0.0, 1.0, 0.0])
    if draw is random_rotations:
        assert turned.mean(0).norm() < 0.15  # every direction alike
        assert turned[:, 1].min() < -0.9
    elif draw is yaw_rotations:
        assert torch.allclose(turned[:, 1], torch.ones(300))
        assert (R @ torch.tensor([1.0, 0, 0])).mean(0).norm() < 0.15
    else:
        angle = torch.rad2deg(torch.acos(((R.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
        assert 5 < angle.median() < 15
        assert angle.max() > 25


def test_the_rigid_fit_finds_a_rigid_motion_and_never_a_mirror() -> None:
    source = torch.randn(30, 3, generator=seeded())
    R, t = random_rotations(8, seeded(1)), torch.randn(8, 3, generator=seeded(2))
    target = source @ R.transpose(1, 2) + t[:, None]
    found, shift = rigid_fit(source, target)
    assert torch.allclose(found, R, atol=1e-5)
    assert torch.allclose(shift, t, atol=1e-5)
    mirrored = source * torch.tensor([-1.0, 1, 1])
    assert torch.det(rigid_fit(source, mirrored[None])[0]) > 0.99


def test_clean_scans_lie_on_the_surface_evenly() -> None:
    points = scan(CLEAN)[0]
    assert points.shape == (4000, 3)
    assert torch.equal(points[:, 2], torch.zeros(4000))
    assert points.min() >= 0 and points.max() <= 1
    counts = torch.histogramdd(points[:, :2], bins=[4, 4], range=[0.0, 1, 0, 1]).hist
    assert counts.sum() == 4000
    assert ((counts - 250).abs() < 90).all()  # six sigma


def test_noise_has_the_size_asked_for() -> None:
    rough = scan(replace(CLEAN, noise=0.05), B=40)[..., 2].std(1)
    assert 0 <= rough.min() and rough.max() < 0.055
    assert rough.max() > 0.02


def test_holes_swallow_a_ball() -> None:
    config = replace(CLEAN, holes=1.0)
    widest = []
    for seed in range(12):
        points = scan(config, seed)[0, :, :2]
        grid = torch.cartesian_prod(torch.linspace(0.05, 0.95, 19), torch.linspace(0.05, 0.95, 19))
        widest.append(float(torch.cdist(grid, points).amin(1).max()))
    # faces are swallowed whole, by their centers: of a coarse square only some seeds show one
    assert max(widest) > 0.1
    assert float(torch.cdist(grid, scan(CLEAN)[0, :, :2]).amin(1).max()) < 0.05


def test_density_is_uneven_when_asked() -> None:
    def unevenness(config: ScanConfig) -> float:
        left = (scan(config, B=30)[..., :2].sum(-1) < 1).float().mean(1)
        return float(left.std())

    assert unevenness(replace(CLEAN, density=2.0)) > 3 * unevenness(CLEAN)


def test_outliers_stray_far_from_the_surface() -> None:
    def strays(config: ScanConfig) -> float:
        return float((scan(config, B=30)[..., 2].abs() > 1e-3).float().mean())

    assert strays(CLEAN) == 0
    assert 0.02 < strays(replace(CLEAN, outliers=1.0)) < 0.08  # half of 10 %, on the mean


def test_partial_scans_see_one_side_or_lose_a_part() -> None:
    ball = icosphere(3)
    centers = torch.from_numpy(ball.verts[ball.faces].mean(axis=1)).float().expand(200, -1, -1)
    seen = seen_share(centers, centers, 1.0, seeded()) > 0.5
    share = seen.float().mean(1)
    assert 0.45 < share.min() and share.max() <= 1
    assert ((share - 0.5).abs() < 0.03).float().mean() > 0.4  # what faces one way is a half of a ball
    assert (share > 0.6).float().mean() > 0.25
    apart = (centers * seen[..., None]).sum(1) / seen.sum(1)[:, None]
    assert apart.norm(dim=-1).mean() > 0.2  # and all of it on one side
    assert (seen_share(centers, centers, 0.0, seeded()) == 1).all()
    some = seen_share(centers, centers, 0.25, seeded()).amin(1) < 0.5
    assert 0.15 < some.float().mean() < 0.35


def test_bumps_are_small_and_smooth() -> None:
    verts = SQUARE.expand(50, -1, -1)
    moved = bump(verts, 0.01, seeded()) - verts
    # an amplitude of up to 0.01 for each of two waves along three axes
    assert 0.003 < moved.norm(dim=-1).max() < 0.02 * 3**0.5
    assert torch.equal(bump(verts, 0.0, seeded()), verts)
    near = torch.stack([SQUARE, SQUARE + 1e-4])
    shifted = bump(near[:1], 0.01, seeded())[0] - bump(near[1:], 0.01, seeded())[0]
    assert torch.allclose(shifted, torch.full_like(shifted, -1e-4), atol=4e-4)


def test_a_scan_is_a_function_of_its_seed() -> None:
    rough = ScanConfig(points=100)
    assert torch.equal(scan(rough, 5), scan(rough, 5))
    assert not torch.equal(scan(rough, 5), scan(rough, 6))


def test_what_lies_inside_is_not_seen_from_outside() -> None:
    ball = icosphere(5)
    verts = torch.from_numpy(np.concatenate([ball.verts, 0.5 * ball.verts]) * 0.3).float()
    faces = torch.from_numpy(np.concatenate([ball.faces, ball.faces + ball.V]))
    seen = seen_from_outside(verts.expand(2, -1, -1), faces, seeded())
    outer, inner = seen[:, : ball.F], seen[:, ball.F :]
    assert outer.float().mean() > 0.98
    assert inner.float().mean() < 0.02


def test_strays_are_things_beside_the_body_or_slabs_below_it() -> None:
    verts = torch.randn(200, 50, 3, generator=seeded(1)) * torch.tensor([0.1, 0.5, 0.1])
    points = stray_points(verts, 300, seeded())
    assert torch.isfinite(points).all()
    below = (points[..., 1] <= verts[..., 1].amin(1, keepdim=True) + 1e-5).all(1)
    assert 0.2 < below.float().mean() < 0.5
    nearest = torch.cdist(points, verts).amin((1, 2))
    assert (nearest < 0.6).all()
