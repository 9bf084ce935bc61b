"""What is cut off: a tube that ends at any cut, and a rig on the joints of a region."""

import numpy as np
import pytest
import torch

from meshmatch.generators.cutouts import Cutout, Region, Stump, boundary_loop, build_cutout, restrict_to_region
from tests.generators.stick import stick_figure

STUMP = Stump(np.zeros(3), np.array([0.0, -1.0, 0.0]), 0.2, 0.05, 0.5, (0.3, 0.3))


def tube(around: int = 12, rows: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """A tube of radius 0.1 along y, from -0.7 up to a tip at 0.2."""
    y = np.linspace(-0.7, 0.1, rows)
    angle = 2 * np.pi * np.arange(around) / around
    rings = np.stack([np.tile(0.1 * np.cos(angle), rows), np.repeat(y, around), np.tile(-0.1 * np.sin(angle), rows)], 1)
    at = np.arange(rows * around).reshape(rows, around)
    a, b, c, d = at[:-1], np.roll(at, -1, 1)[:-1], np.roll(at, -1, 1)[1:], at[1:]
    faces = [np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    tip = np.stack([at[-1], np.roll(at[-1], -1), np.full(around, rows * around)], -1)
    return np.concatenate([rings, [[0, 0.2, 0]]]), np.concatenate([*faces, tip])


@pytest.fixture(scope="module")
def cutout() -> Cutout:
    return build_cutout(*tube(), STUMP, STUMP.draw_cuts(6))


def test_cuts_lie_within_their_limits() -> None:
    cuts = STUMP.draw_cuts(50, seed=3)
    assert cuts[0].tolist() == [0.2, 0, 0]  # the template's
    assert STUMP.shortest <= cuts[1:, 0].min() < cuts[1:, 0].max() <= STUMP.longest
    assert 0.2 < np.abs(cuts[:, 1:]).max() <= 0.3
    assert np.array_equal(cuts, STUMP.draw_cuts(50, seed=3))
    assert not np.array_equal(cuts, STUMP.draw_cuts(50, seed=4))


def test_every_shape_ends_at_its_cut(cutout: Cutout) -> None:
    verts, _ = tube()
    cuts = STUMP.draw_cuts(6)
    shapes = cutout.cut(torch.from_numpy(verts).float()[None].expand(7, -1, -1), torch.arange(7)).numpy()
    loop = boundary_loop(cutout.faces)
    assert len(loop) == 12
    assert np.abs(shapes[0, loop, 1] + 0.2).max() < 1e-6
    for shape, (where, *slopes) in zip(shapes, cuts, strict=True):
        assert shape[loop, 1].mean() == pytest.approx(-where, abs=1e-3)
        assert np.ptp(shape[loop, 1]) == pytest.approx(0.2 * np.linalg.norm(slopes), abs=0.01)
        # on the tube, and nothing but the stump has moved
        assert np.abs(np.linalg.norm(shape[loop][:, [0, 2]], axis=1) - 0.1).max() < 0.005
        kept = verts[cutout.keep, 1] >= 0
        assert np.allclose(shape[kept], verts[cutout.keep][kept], atol=1e-6)


def test_a_place_on_the_stump_is_one_of_the_body(cutout: Cutout) -> None:
    """It moves with the triangle that it lies on, whatever the body does."""
    verts, _ = tube()
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    stretched = torch.from_numpy(np.stack([verts, verts @ turn + 3, verts * [2, 1, 1]])).float()
    plain, turned, wide = cutout.cut(stretched, torch.full((3,), 4)).numpy()
    assert np.allclose(turned, plain @ turn + 3, atol=1e-5)
    assert np.allclose(wide, plain * [2, 1, 1], atol=1e-5)


def test_a_region_keeps_its_joints_alone() -> None:
    rig = stick_figure()
    arm = restrict_to_region(rig, Region("arm", "lowerarm01.R", ("lowerarm02", "wrist", "finger"), ".R"))
    assert set(arm.names) == {
        n for n in rig.names if n.endswith(".R") and n.startswith(("lowerarm", "wrist", "finger"))
    }
    assert torch.allclose(arm.weights.sum(1), torch.ones(len(arm.weights)))
    assert arm.parents[arm.joint("lowerarm01.R")] == -1
    assert arm.names[arm.parents[arm.joint("wrist.R")]] == "lowerarm02.R"
    assert (arm.weights[4 * rig.joint("head"), arm.joint("lowerarm01.R")]) == 1  # the root carries all else
