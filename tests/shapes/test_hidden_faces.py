"""What of a shape can be seen from outside."""

import numpy as np
import pytest
import trimesh

from meshmatch.shapes.hidden_faces import remove_hidden_faces
from meshmatch.shapes.shape import Shape


def ball(radius: float, center: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    made = trimesh.creation.icosphere(3, radius)
    return made.apply_translation(center)


def joined(*solids: trimesh.Trimesh) -> Shape:
    whole = trimesh.util.concatenate(list(solids))
    return Shape(np.asarray(whole.vertices), np.asarray(whole.faces), "solids")


def kept(outer: trimesh.Trimesh, inner: trimesh.Trimesh) -> tuple[float, float]:
    """Shares of the faces of two solids that are left; all vertices stay."""
    shape = joined(outer, inner)
    bare = remove_hidden_faces(shape)
    assert bare.V == shape.V
    is_inner = bare.faces[:, 0] >= len(outer.vertices)
    return (~is_inner).sum() / len(outer.faces), is_inner.sum() / len(inner.faces)


def test_what_lies_inside_is_left_out() -> None:
    assert kept(ball(1.0), ball(0.6)) == (1.0, 0.0)


@pytest.mark.parametrize("inverted", [False, True])
def test_layers_close_to_each_other_are_told_apart_whichever_way_they_face(inverted: bool) -> None:
    outer, inner = ball(1.0), ball(0.99)
    if inverted:
        outer.invert()
    of_outer, of_inner = kept(outer, inner)
    assert of_outer > 0.99 and of_inner < 0.1


def test_parts_that_run_into_each_other_lose_what_is_inside() -> None:
    shape = joined(ball(1.0), ball(1.0, (1.0, 0, 0)))
    bare = remove_hidden_faces(shape)
    centers = bare.verts[bare.faces].mean(1)
    inside = np.minimum(np.linalg.norm(centers, axis=1), np.linalg.norm(centers - [1.0, 0, 0], axis=1)) < 0.95
    assert inside.mean() < 0.02
    assert 0.7 < bare.area / shape.area < 0.8  # half of each ball's radius lies inside the other one: a quarter


@pytest.mark.parametrize(
    "shape",
    [joined(ball(1.0)), joined(ball(1.0), ball(1.0, (3.0, 0, 0))), Shape(ball(1.0).vertices, np.empty((0, 3), int))],
    ids=["one", "apart", "cloud"],
)
def test_what_hides_nothing_stays_as_it_is(shape: Shape) -> None:
    assert remove_hidden_faces(shape) is shape


def test_what_is_not_trusted_hides_nothing() -> None:
    shape = joined(ball(1.0), ball(0.6))
    weights = np.repeat([0.2, 1.0], shape.V // 2)
    doubted = Shape(shape.verts, shape.faces, weights=weights)
    assert remove_hidden_faces(doubted) is doubted


def test_foliage_and_what_reaches_far_stay_as_they_are() -> None:
    rng = np.random.default_rng(0)
    leaves = rng.uniform(-1, 1, (4000, 1, 3)) + 0.3 * rng.standard_normal((4000, 3, 3))
    soup = Shape(leaves.reshape(-1, 3), np.arange(12_000).reshape(-1, 3))
    assert remove_hidden_faces(soup) is soup
    needle = trimesh.creation.box((100.0, 0.05, 0.05)).subdivide_to_size(0.5)
    far = joined(ball(1.0), ball(0.6), needle)
    assert remove_hidden_faces(far) is far
