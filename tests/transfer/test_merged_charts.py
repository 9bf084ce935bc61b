"""Charts that are joined lie flat, and lie apart."""

import numpy as np
import pytest

from meshmatch.geometry.triangles import face_parts, triangle_areas
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.merged_charts import laid_flat, merged_charts
from meshmatch.transfer.new_charts import flat_areas
from meshmatch.transfer.texels import faces_on
from tests.conftest import icosphere


def sheet(count: int = 12, bend: float = 1.0) -> Shape:
    """A square bent about the y axis by an angle."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, 1, count + 1)] * 2, indexing="ij"))
    angle = bend * (x - 0.5)
    verts = np.stack([np.sin(angle) / max(bend, 1e-9), y, np.cos(angle) / max(bend, 1e-9)], axis=1)
    at = np.arange((count + 1) ** 2).reshape(count + 1, -1)
    a, b, c, d = (each.ravel() for each in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return Shape(verts, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def apart(shape: Shape, chart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Charts of a sheet as xatlas gives them: numbered corners with coordinates, each chart with its own."""
    own = shape.faces + shape.V * chart[:, None]
    used, corners = np.unique(own, return_inverse=True)
    uv = np.stack([shape.verts[used % shape.V, 0] + 9.0 * (used // shape.V), shape.verts[used % shape.V, 1]], axis=1)
    return uv, corners.reshape(-1, 3)


def test_crumbs_in_a_sheet_become_part_of_it_all_at_once() -> None:
    shape = sheet(40)
    middle = shape.verts[shape.faces].mean(axis=1)
    chart = np.zeros(shape.F, np.int64)
    chart[np.arange(0, shape.F, 37)] = 1 + np.arange(len(range(0, shape.F, 37)))  # holes filled by single triangles
    chart[middle[:, 1] < 0.03] = chart.max() + 1 + (40 * middle[middle[:, 1] < 0.03, 0]).astype(int)
    uv, corners = apart(shape, chart)
    assert face_parts(corners, len(uv)).max() > 80
    uv, corners = merged_charts(shape.verts, shape.faces, uv, corners)
    assert face_parts(corners, len(uv)).max() == 0
    np.testing.assert_allclose(flat_areas(uv[corners]), triangle_areas(shape.verts, shape.faces), rtol=0.02)
    again = merged_charts(shape.verts, shape.faces, uv, corners)
    np.testing.assert_array_equal(again[0], uv)


def test_large_charts_stay_as_they_are() -> None:
    shape = sheet()
    uv, corners = apart(shape, (shape.verts[shape.faces].mean(axis=1)[:, 1] > 0.5).astype(np.int64))
    found = merged_charts(shape.verts, shape.faces, uv, corners)
    np.testing.assert_array_equal(found[0][found[1]], uv[corners])


def test_joined_charts_lie_beside_the_others() -> None:
    """A ball in eight pieces, with a crumb in each."""
    ball = icosphere(4)
    middle = ball.verts[ball.faces].mean(axis=1)
    chart = ((middle > 0) @ [1, 2, 4]).astype(np.int64)
    crumbs = [np.flatnonzero(chart == number)[number] for number in range(8)]
    chart[crumbs] = 8 + np.arange(8)
    uv, corners = merged_charts(ball.verts, ball.faces, *apart(ball, chart))
    assert face_parts(corners, len(uv)).max() == 7
    places = (uv - uv.min(axis=0)) / np.ptp(uv, axis=0).max()
    assert faces_on(places[corners] * 2048, 2048)[1] == 0


@pytest.mark.parametrize("bend", [0.01, 3.0])
def test_what_can_be_unrolled_is_laid_flat_without_stretch(bend: float) -> None:
    shape = sheet(bend=bend)
    laid = laid_flat(shape.verts, shape.faces)
    assert laid is not None
    np.testing.assert_allclose(np.linalg.det(np.diff(laid[0][laid[1]], axis=1)) / 2, shape.face_areas, rtol=0.01)


def test_what_cannot_lie_flat_is_left_alone() -> None:
    ball, two = icosphere(2), sheet(2)
    assert laid_flat(ball.verts, ball.faces) is None
    assert laid_flat(two.verts, two.faces[[0, 7]]) is None  # they do not hang together
    tube = sheet(12, bend=2 * np.pi)
    tube = Shape(tube.verts, np.where(tube.faces >= 13 * 12, tube.faces - 13 * 12, tube.faces))
    assert laid_flat(tube.verts, tube.faces) is None
    thin = Shape(two.verts * [1, 1e-12, 1], two.faces)
    assert laid_flat(thin.verts * 0.0, thin.faces) is None
