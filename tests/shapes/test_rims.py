"""Where a mesh ends."""

import numpy as np
from scipy.spatial import Delaunay

from meshmatch.geometry.frames import Frame
from meshmatch.shapes.rims import RimPoints, is_sheet, rim_corners
from meshmatch.shapes.shape import Shape


def disc(radius: float = 3.0, count: int = 300) -> Shape:
    """A flat one, in the plane z = 0."""
    number = np.arange(count) + 0.5
    turn, far = np.pi * (1 + np.sqrt(5)) * number, np.sqrt(number / count)
    edge = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    flat = np.concatenate([0.9 * (far * [np.cos(turn), np.sin(turn)]).T, np.stack([np.cos(edge), np.sin(edge)], 1)])
    return Shape(np.pad(radius * flat, ((0, 0), (0, 1))), Delaunay(flat).simplices.astype(np.int64), "disc")


def test_points_of_a_rim_are_evenly_apart_and_lead_out() -> None:
    shape = disc()
    rim = RimPoints.of(shape, 0.01)
    assert len(rim.points) >= 2 * np.sqrt(np.pi) / 0.01 - 60
    outward = rim.points / np.linalg.norm(rim.points, axis=1, keepdims=True)
    assert np.abs(np.linalg.norm(rim.points, axis=1) - 3).max() < 0.01
    assert (rim.outward * outward).sum(1).min() > 0.99
    assert np.abs((rim.along * outward).sum(1)).max() < 0.06
    gaps = np.linalg.norm(np.diff(rim.points[np.argsort(np.arctan2(*rim.points.T[:2]))], axis=0), axis=1)
    assert gaps.max() < 0.011 * np.sqrt(shape.area) and gaps.min() > 0.005 * np.sqrt(shape.area)
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [-1, 0, 0]])
    moved = rim.in_frame(Frame(2.0, turn, np.ones(3)))
    assert np.allclose(moved.points, (rim.points - 1) @ turn.T / 2) and np.allclose(moved.outward, rim.outward @ turn.T)


def test_cracks_and_closed_shapes_have_no_rim(sphere: Shape) -> None:
    cracked = Shape(sphere.verts, np.asarray(sphere.faces)[1:])
    for shape in (sphere, cracked):
        assert len(rim_corners(shape)) == len(RimPoints.of(shape, 0.01).points) == 0 and not is_sheet(shape)
    whole = disc(count=1200)
    pierced = Shape(whole.verts, np.delete(whole.faces, 900, axis=0))
    assert pierced.edges.counts[0] == 63 and len(rim_corners(pierced)) == len(rim_corners(whole)) == 60


def test_sheets_are_mostly_rim(sphere: Shape) -> None:
    assert is_sheet(disc()) and is_sheet(Shape(disc().verts * [1, 3, 1], disc().faces))
    bowl = Shape(sphere.verts, np.asarray(sphere.faces)[(sphere.verts[:, 2] < 0.1)[sphere.faces].all(1)])
    assert len(rim_corners(bowl)) and not is_sheet(bowl)
    assert not is_sheet(Shape(sphere.verts, np.empty((0, 3), np.int64)))
