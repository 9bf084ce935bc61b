"""Errors, coverage and distortion by hand."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.maps.evaluate import CM_PER_UNIT, Errors, coverage, distortion, evaluate_map, map_errors
from meshmatch.maps.geodesics import GeodesicDistances
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from tests.maps.solids import bumpy_sphere, grid


def test_a_unit_is_137_point_8_centimetres() -> None:
    assert pytest.approx(137.84, abs=0.01) == CM_PER_UNIT
    errors = Errors(np.array([0.0, 0.1, 0.2, 0.5]))
    assert errors.mean == pytest.approx(0.2)
    assert errors.median == pytest.approx(0.15)
    assert errors.mean_cm == pytest.approx(27.568, abs=1e-3)
    assert errors.share_over(15.0) == 0.5  # 13.8 cm is not, 27.6 cm is
    assert errors.curve([0.0, 0.15, 1.0]).tolist() == [0.25, 0.5, 1.0]


@pytest.mark.parametrize("values", [[], [np.nan], [np.inf], [-0.1]])
def test_errors_leave_nothing_out(values: list[float]) -> None:
    with pytest.raises(InputError, match="finite"):
        Errors(np.array(values))


def test_errors_by_hand() -> None:
    sheet = grid(2, 2)  # area 4, so a unit is 2
    index = np.arange(9)
    index[0] = 2  # two to the right: 2 / 2 = 1
    geodesics = GeodesicDistances(sheet)
    assert map_errors(index, np.arange(9), np.arange(9), geodesics).values.tolist() == [1.0] + [0.0] * 8
    assert map_errors(index, [0, 1], [2, 0], geodesics).values.tolist() == [0.0, 0.5]
    assert map_errors(index, np.array([0.0, 1.0]), np.array([2.0, 0.0]), geodesics).values.tolist() == [0.0, 0.5]
    with pytest.raises(InputError, match="whole numbers"):
        map_errors(index, [0.5, 1], [2, 0], geodesics)
    for bad in (([0, 1], [0]), ([0, 9], [0, 1]), ([0, 1], [0, 9]), ([-1], [0]), ([], [])):
        with pytest.raises(InputError):
            map_errors(index, np.array(bad[0], int), np.array(bad[1], int), geodesics)


def test_points_without_a_counterpart_are_left_out() -> None:
    geodesics, index = GeodesicDistances(grid(2, 2)), np.arange(9)
    truth = np.array([0, 1, -1, 3, 4, -1, 6, 7, 2])
    with pytest.warns(MeshmatchWarning, match="2 of 9 vertices have no counterpart: left out"):
        found = map_errors(index, np.arange(9), truth, geodesics)
    assert (len(found.values), np.count_nonzero(found.values)) == (7, 1)
    with pytest.raises(InputError, match="no vertex with a counterpart"):
        map_errors(index, np.arange(9), np.full(9, -1), geodesics)


def test_errors_do_not_depend_on_the_unit_of_the_file() -> None:
    shape = bumpy_sphere(8, 9)
    large = Shape(shape.verts * 1000, shape.faces)
    index = np.random.default_rng(0).permutation(shape.V)
    truth = np.arange(shape.V)
    small, big = (map_errors(index, truth, truth, GeodesicDistances(s)).values for s in (shape, large))
    assert small == pytest.approx(big, rel=1e-5)
    assert small.mean() > 0.1


def test_coverage_by_hand() -> None:
    sheet = grid(1, 2)
    everything = coverage(np.arange(6), sheet)
    assert (everything.vertices, everything.area) == (1.0, pytest.approx(1.0))
    one = coverage(np.ones(100, int), sheet)
    assert one.vertices == pytest.approx(1 / 6)
    assert one.area == pytest.approx(1 / 4)  # three of the four triangles touch it, a third of each is its own


def test_distortion_is_0_for_an_isometry_and_grows() -> None:
    shape = bumpy_sphere(10, 12)
    moved = Shape(7 * shape.verts[:, [1, 2, 0]] + 3, shape.faces)
    a, b = GeodesicDistances(shape), GeodesicDistances(moved)
    rng = np.random.default_rng(0)
    assert distortion(np.arange(shape.V), a, b, rng) == pytest.approx(0, abs=1e-9)
    swapped = np.arange(shape.V)
    swapped[::4] = 0
    some = distortion(swapped, a, b, np.random.default_rng(0))
    much = distortion(rng.integers(0, shape.V, shape.V), a, b, np.random.default_rng(0))
    assert 0.01 < some < much
    assert distortion(swapped, a, b, np.random.default_rng(0)) == some


def test_evaluate_map() -> None:
    shape = bumpy_sphere(10, 12, "ball")
    truth = np.arange(shape.V)
    record = evaluate_map(VertexMap.identity(shape), shape, shape, target_points=truth).as_dict()
    assert record["mean_cm"] == 0
    assert record["share_over_threshold"] == 0
    assert record["distortion"] == 0
    assert record["points"] == shape.V
    assert record["coverage_vertices"] == 1
    blind = evaluate_map(VertexMap.identity(shape), shape, shape)
    assert blind.errors is None
    assert "mean_cm" not in blind.as_dict()
    cloud = Shape(shape.verts, np.zeros((0, 3), int), "dots")
    assert evaluate_map(VertexMap.identity(cloud), cloud, cloud).distortion is None
    with pytest.raises(InputError, match="made for another"):
        evaluate_map(VertexMap.identity(shape), shape, grid(1, 1))
    with pytest.raises(InputError, match="no faces"):
        evaluate_map(VertexMap.identity(cloud), cloud, cloud, target_points=truth)


def test_distortion_is_a_mean_over_pairs() -> None:
    """A map to a single vertex loses all of every distance; that of a vertex to itself does not count."""
    shape = bumpy_sphere(6, 7)
    geodesics = GeodesicDistances(shape)
    distances = geodesics.rows(np.arange(shape.V))
    found = distortion(np.zeros(shape.V, int), geodesics, geodesics, np.random.default_rng(0), samples=shape.V)
    assert found == pytest.approx(distances.sum() / (shape.V * (shape.V - 1)))


def test_vertices_on_no_surface_do_not_count() -> None:
    """Those that no face uses, and those without a position, which the map sends with the vertex that stands for them."""
    shape = bumpy_sphere(6, 7)
    strays = np.concatenate([50.0 + np.arange(60).reshape(20, 3), np.zeros((20, 3))])
    invalid = np.arange(shape.V + 40) >= shape.V + 20
    scene = Shape(np.concatenate([shape.verts, strays]), shape.faces, invalid=invalid)
    there = VertexMap.between(scene, shape, np.concatenate([np.arange(shape.V), np.zeros(40, int)]))
    back = VertexMap.between(shape, scene, np.arange(shape.V))
    for found in (evaluate_map(there, scene, shape, backward=back), evaluate_map(back, shape, scene, backward=there)):
        assert (found.distortion, found.bijectivity) == (pytest.approx(0, abs=1e-9), 0)


def test_known_points_without_a_position_do_not_count() -> None:
    shape = bumpy_sphere(6, 7)
    torn = Shape(shape.verts, shape.faces, invalid=np.arange(shape.V) < 4)
    there, truth = VertexMap.between(shape, torn, np.arange(shape.V)), np.arange(shape.V)
    for one, other, n in ((shape, torn, 4), (torn, shape, 4), (torn, torn, 7)):
        found = replace(there, source_hash="", target_hash="")
        with pytest.warns(MeshmatchWarning, match=f"{n} of {shape.V} known points have a vertex without a position"):
            measured = evaluate_map(found, one, other, np.roll(truth, 3) if n == 7 else None, truth)
        assert measured.errors is not None and measured.errors.values.size == shape.V - n
    with pytest.raises(InputError, match="has 37"), pytest.warns(MeshmatchWarning):
        evaluate_map(found, torn, torn, target_points=truth + 1)
