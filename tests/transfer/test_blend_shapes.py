"""Blendshapes along a map, on small shapes of which the truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Floats, Floats32
from meshmatch.errors import InputError, OptionError
from meshmatch.maps.mapped_mesh import invert_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.blend_shapes import carry_moves
from tests.transfer.worn import RADIUS, bent, rod, same_numbers, tube


def carried(moves: Floats, source: Shape, target: Shape, forward: VertexMap | None = None) -> Floats32:
    forward = forward or same_numbers(source, target)
    backward = invert_map(forward, source, target)
    return carry_moves(np.asarray(moves, np.float32), forward, backward, source, target)


def bulge(points: Floats) -> Floats:
    """A swelling of the rod's middle, out of its axis."""
    out = points * [1.0, 0.0, 1.0] / RADIUS
    return 0.1 * np.exp(-((points[:, 1:2] / 0.3) ** 2)) * out


def wave(points: Floats) -> Floats:
    """A move along the rod, on its upper half."""
    return 0.05 * np.clip(points[:, 1:2], 0.0, 1.0) * [0.0, 1.0, 0.0]


def error(found: Floats32, true: Floats) -> float:
    """The mean error as a share of the mean move."""
    return float(np.linalg.norm(found - true, axis=2).mean() / np.linalg.norm(true, axis=2).mean())


def along_the_arc(points: Floats, move: Floats) -> Floats:
    """How a small move of the straight rod looks on the bent one."""
    step = 1e-4
    return (bent(points + step * move) - bent(points - step * move)) / (2 * step)


def test_moves_turn_with_the_surface() -> None:
    body = rod()
    target = replace(body, verts=bent(body.verts))
    moves = np.stack([bulge(body.verts), wave(body.verts)])
    true = np.stack([along_the_arc(body.verts, move) for move in moves])
    found = carried(moves, body, target)
    assert error(found, true) < 0.06
    assert error(moves.astype(np.float32), true) > 0.15  # unturned


def test_they_turn_and_grow_exactly_with_the_whole() -> None:
    body, turn = rod(), Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    target = replace(body, verts=3.0 * body.verts @ turn.T + 5.0)
    moves = np.stack([bulge(body.verts), wave(body.verts)])
    assert error(carried(moves, body, target), 3.0 * moves @ turn.T) < 0.01


def test_another_mesh_of_the_same_surface() -> None:
    body, target = rod(), tube(RADIUS, 2.0, 17, 60, "finer", closed=True)
    near = np.linalg.norm(body.verts[:, None] - target.verts[None], axis=2).argmin(axis=1)
    moves = np.stack([bulge(body.verts), wave(body.verts)])
    true = np.stack([bulge(target.verts), wave(target.verts)])
    assert error(carried(moves, body, target, VertexMap.between(body, target, near)), true) < 0.08


def test_a_vertex_that_faces_another_way_is_outvoted() -> None:
    """Some of the front was taken for the back: its moves are those of its surroundings all the same."""
    body = rod()
    move = np.where(body.verts[:, 2:] > 0, [0.0, 0.0, 0.1], [0.0, 0.0, 0.0])
    places = np.arange(body.V)
    front = np.flatnonzero(body.verts[:, 2] > 0.99 * RADIUS)[10:12]
    for vertex in front:
        places[vertex] = np.linalg.norm(body.verts * [1, 1, -1] - body.verts[vertex], axis=1).argmin()
    wrong = replace(same_numbers(body, body), index=places)
    found = carry_moves(move[None].astype(np.float32), same_numbers(body, body), wrong, body, body)
    assert np.allclose(found[0, front], move[front], atol=0.02)


def with_ball(body: Shape, height: float) -> tuple[Shape, slice]:
    """A body with a small ball within, as an eye is."""
    ball = tube(0.04, 0.06, 8, 4, "ball", closed=True)
    verts = np.concatenate([body.verts, ball.verts + np.array([0.1, height, 0.1])])
    return Shape(verts, np.concatenate([body.faces, ball.faces + body.V]), "with a ball"), slice(body.V, len(verts))


def test_a_separate_part_moves_as_a_whole_with_its_surroundings() -> None:
    body = rod()
    target, inside = with_ball(body, 0.5)
    turn = Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix()
    moves = np.stack([body.verts @ turn.T - body.verts, np.tile([0.0, 0.1, 0.0], (body.V, 1))])
    found = carried(moves, body, target, VertexMap.between(body, target, np.arange(body.V)))
    true = np.stack([target.verts @ turn.T - target.verts, np.tile([0.0, 0.1, 0.0], (target.V, 1))])
    assert np.allclose(found, true, atol=4e-3)
    before, after = (
        np.linalg.norm(v[inside, None] - v[None, inside], axis=2) for v in (target.verts, target.verts + found[0])
    )
    assert np.allclose(before, after, atol=1e-4)


def test_a_part_with_a_counterpart_moves_as_that_does() -> None:
    body, inside = with_ball(rod(), 0.5)
    moves = np.zeros((1, body.V, 3))
    turn = Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix()
    center = body.verts[inside].mean(axis=0)
    moves[0, inside] = (body.verts[inside] - center) @ turn.T - (body.verts[inside] - center)
    found = carried(moves, body, replace(body, verts=body.verts + 1.0))
    assert np.allclose(found, moves, atol=2e-3)


def test_what_nothing_is_near_stays() -> None:
    body = rod()
    far = replace(rod(), verts=0.2 * rod().verts + [30.0, 0, 0])
    target = Shape(np.concatenate([body.verts, far.verts]), np.concatenate([body.faces, far.faces + body.V]), "two")
    found = carried(wave(body.verts)[None], body, target, VertexMap.between(body, target, np.arange(body.V)))
    assert not found[0, body.V :].any()
    assert error(found[:, : body.V], wave(body.verts)[None]) < 0.05


def lips(gap: float) -> Shape:
    """Two blocks with a slit between them, one piece at the back."""
    x, n = np.linspace(-1, 1, 21), 21
    profile = np.array(
        [
            [0.5, 0.6],
            [gap / 2, 0.6],
            [gap / 2, -0.4],
            [-gap / 2, -0.4],
            [-gap / 2, 0.6],
            [-0.5, 0.6],
            [-0.5, -0.8],
            [0.5, -0.8],
        ]
    )
    finer = np.concatenate(
        [
            a + np.linspace(0, 1, 8, endpoint=False)[:, None] * (b - a)
            for a, b in zip(profile, np.roll(profile, -1, 0), strict=True)
        ]
    )
    around = len(finer)
    verts = np.concatenate([np.column_stack([np.full(around, each), finer]) for each in x])
    low = np.arange((n - 1) * around).reshape(n - 1, around)
    right = np.roll(low, -1, axis=1)
    faces = np.stack([np.stack([low, right + around, right], -1), np.stack([low, low + around, right + around], -1)])
    return Shape(verts, faces.reshape(-1, 3), "lips")


def test_lips_stay_closed_where_they_should() -> None:
    """The map is a little off along the lips, differently above and below."""
    shape = lips(0.002)
    front = np.clip(shape.verts[:, 2:] + 0.4, 0.0, 1.0)
    smile = front * np.abs(shape.verts[:, :1]) * [0.0, 0.3, 0.0]
    jaw = np.where(shape.verts[:, 1:2] < 0, front * [0.0, -0.3, 0.0], 0.0)
    beside = np.arange(shape.V)
    upper = shape.verts[:, 1] > 0
    beside[upper] = np.clip(beside[upper] + 64, 0, shape.V - 1 - (shape.V - 1 - beside[upper]) % 64)
    off = replace(same_numbers(shape, shape), index=beside)
    found = carry_moves(np.stack([smile, jaw]).astype(np.float32), same_numbers(shape, shape), off, shape, shape)
    rim = np.flatnonzero(upper & (np.abs(shape.verts[:, 1]) < 0.01) & (shape.verts[:, 2] > -0.3))
    other = [int(np.linalg.norm(shape.verts * [1, -1, 1] - shape.verts[v], axis=1).argmin()) for v in rim]
    apart = np.linalg.norm(found[:, rim] - found[:, other], axis=2)
    unmended = np.linalg.norm(smile[beside[rim]] - smile[other], axis=1)
    corners = np.abs(shape.verts[rim, 0]) > 0.5
    assert unmended[corners].max() > 0.02
    assert apart[0, corners].max() < 0.25 * unmended[corners].max()
    assert apart[1].max() == pytest.approx(0.3, abs=0.05)


def test_what_cannot_be() -> None:
    body = rod()
    cloud = Shape(body.verts, np.empty((0, 3), int), "cloud")
    with pytest.raises(InputError, match="cloud is a point cloud"):
        carry_moves(
            np.zeros((1, body.V, 3), np.float32), same_numbers(cloud, body), same_numbers(body, cloud), cloud, body
        )
    mirrored = Shape(body.verts * [-1, 1, 1], body.faces[:, ::-1], "mirrored")
    with pytest.raises(OptionError, match="inside out"):
        carried(np.zeros((1, body.V, 3)), body, mirrored)
