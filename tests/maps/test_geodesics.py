"""Distances along a surface: by hand, against exact ones, by law."""

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.maps.geodesics import GeodesicDistances, diagonal_arcs, edge_arcs
from meshmatch.shapes.shape import Shape
from tests.maps.solids import bumpy_sphere, grid


def test_the_unfolded_diagonal_of_a_square_is_its_other_diagonal() -> None:
    square = grid(1, 1)
    i, j, length = diagonal_arcs(square.verts, square.faces)
    assert {*i, *j} == {1, 2}
    assert length == pytest.approx([np.sqrt(2)])
    assert len(edge_arcs(square.verts, square.faces)[0]) == 5


def test_a_fold_does_not_shorten_the_diagonal() -> None:
    verts = grid(1, 1).verts.copy()
    # Fold the corner 1 over the edge 0-3: it comes to lie on corner 2, but the way along the paper stays.
    verts[1] = verts[2]
    i, j, length = diagonal_arcs(verts, grid(1, 1).faces)
    assert {*i, *j} == {1, 2}
    assert length == pytest.approx([np.sqrt(2)])


def test_no_diagonal_where_the_straight_line_leaves_the_two_faces() -> None:
    # A dart: both far corners lie far beyond one end of the shared edge.
    verts = np.array([[0, 0, 0], [1, 0, 0], [3, 1, 0], [3, -1, 0]], dtype=float)
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    assert len(diagonal_arcs(verts, faces)[0]) == 0


def test_unit_of_distance() -> None:
    sheet = grid(3, 4, step=2.0)  # area 48
    raw = GeodesicDistances(sheet, unit=1.0).rows(np.array([0]))[0]
    assert raw[4] == pytest.approx(8.0)
    assert raw[3 * 5] == pytest.approx(6.0)
    assert GeodesicDistances(sheet).rows(np.array([0]))[0] == pytest.approx(raw / np.sqrt(48))


def test_against_exact_geodesics() -> None:
    """Along edges alone distances are 3 % too long."""
    igl = pytest.importorskip("igl", reason="libigl measures exact geodesics")
    shape = bumpy_sphere()
    sources = np.arange(0, shape.V, 97)
    too_long = []
    for source, row in zip(sources, GeodesicDistances(shape, unit=1.0).rows(sources), strict=True):
        exact = igl.exact_geodesic(shape.verts, shape.faces, VS=np.array([source]), VT=np.arange(shape.V))
        assert (row >= exact - 1e-7).all(), "a path on the surface cannot be shorter than the shortest"
        too_long.append((row - exact).mean() / exact.mean())
    assert np.mean(too_long) < 0.02


def test_rows_are_symmetric_and_obey_the_triangle_inequality() -> None:
    shape = bumpy_sphere(10, 12)
    table = GeodesicDistances(shape).rows(np.arange(shape.V))
    assert np.allclose(table, table.T, atol=1e-12)
    assert (table <= table[:, 5][:, None] + table[5][None] + 1e-12).all()
    assert (np.diag(table) == 0).all()


def test_chunks_and_pairs_agree_with_rows() -> None:
    shape = bumpy_sphere(10, 12)
    geodesics = GeodesicDistances(shape)
    table = geodesics.rows(np.arange(shape.V))
    tiny = 8 * shape.V * 7  # seven rows at a time
    parts = list(geodesics.chunks(np.arange(shape.V), chunk_bytes=tiny))
    assert [first for first, _ in parts] == list(range(0, shape.V, 7))
    assert np.array_equal(np.concatenate([rows for _, rows in parts]), table)
    rng = np.random.default_rng(0)
    for few in (3, shape.V):  # the smaller side decides from where Dijkstra starts
        a, b = rng.integers(0, few, 200), rng.integers(0, shape.V, 200)
        assert geodesics.between(a, b) == pytest.approx(table[a, b], abs=1e-12)
        assert geodesics.between(b, a) == pytest.approx(table[a, b], abs=1e-12)
    assert geodesics.between(np.arange(9), np.arange(9)).tolist() == [0.0] * 9


def test_pairs_near_each_other_are_as_far_as_in_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two sheets that nearly touch, and a bridge to a third: some pairs are near in space and far along the surface."""
    first = grid(30, 30)
    above = first.verts + np.array([0.2, 0.1, 0.05])
    verts = np.concatenate([first.verts, above, first.verts + np.array([40.0, 0, 0])])
    faces = np.concatenate([first.faces + k * first.V for k in range(3)])
    shape = Shape(verts, faces, "sheets")
    geodesics = GeodesicDistances(shape)
    rng = np.random.default_rng(0)
    a = rng.integers(0, shape.V, 2000)
    near = np.clip(a + rng.integers(-3, 4, 2000) + 31 * rng.integers(-3, 4, 2000), 0, shape.V - 1)
    b = np.where(rng.random(2000) < 0.2, (a + first.V) % shape.V, near)
    true = geodesics.rows(a)[np.arange(2000), b]
    asked: list[int] = []
    monkeypatch.setattr(
        geodesics, "chunks", lambda starts: asked.append(len(starts)) or GeodesicDistances.chunks(geodesics, starts)
    )
    monkeypatch.setattr("meshmatch.maps.geodesics._MAX_REACH", 0.5)
    shares: list[float] = []
    assert geodesics.between(a, b, shares.append) == pytest.approx(true, abs=1e-12)
    assert asked[0] < 700  # most pairs did not need all of the surface
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 2
    monkeypatch.setattr("meshmatch.maps.geodesics.CHUNK_BYTES", 4000)
    assert geodesics.between(a, b) == pytest.approx(true, abs=1e-12)


def test_many_far_pairs_are_bounded_from_few_vertices(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    sheet = grid(40, 40)
    bent = Shape(sheet.verts + np.array([0.0, 0.0, 3.0]) * np.sin(sheet.verts[:, :1] / 4), sheet.faces, "bent")
    geodesics = GeodesicDistances(bent)
    a, b = rng.integers(0, bent.V, (2, 3000))
    b[:300] = a[:300]
    true = geodesics.rows(a)[np.arange(3000), b]
    monkeypatch.setattr("meshmatch.maps.geodesics._MAX_DISTANCES", 100 * bent.V)
    asked: list[int] = []
    rows = geodesics.rows
    monkeypatch.setattr(geodesics, "rows", lambda sources: asked.extend(sources) or rows(sources))
    shares: list[float] = []
    found = geodesics.between(a, b, shares.append)
    assert len(asked) < 600  # 1,400 different ones
    assert (found[:300] == 0).all()
    assert (np.abs(found - true) <= 0.031 * true + 2e-9).all()
    assert found.mean() == pytest.approx(true.mean(), rel=0.005)
    assert shares == sorted(shares) and shares[-1] == 1.0


def test_a_seam_costs_nothing() -> None:
    sheet = grid(2, 2, name="cut")
    # The same sheet as two halves that share no vertex, as an OBJ with texture seams has them.
    left = sheet.faces[(sheet.verts[sheet.faces][:, :, 0] <= 1).all(axis=1)]
    right = sheet.faces[(sheet.verts[sheet.faces][:, :, 0] >= 1).all(axis=1)]
    cut = Shape(np.concatenate([sheet.verts, sheet.verts]), np.concatenate([left, right + 9]), "cut")
    row = GeodesicDistances(cut, unit=1.0).rows(np.array([0]))[0]
    assert row[9 + 2] == pytest.approx(2.0)
    assert row[9 + 0] == pytest.approx(0.0, abs=1e-9)


def test_a_separate_part_is_bridged_at_its_nearest_point() -> None:
    near, far = grid(2, 2).verts, grid(1, 1).verts + np.array([5.0, 0, 0])
    both = Shape(np.concatenate([near, far]), np.concatenate([grid(2, 2).faces, grid(1, 1).faces + 9]))
    row = GeodesicDistances(both, unit=1.0).rows(np.array([0]))[0]
    assert np.isfinite(row).all()
    assert row[9] == pytest.approx(2 + 3)
    assert row[10] == pytest.approx(2 + 3 + 1)


def test_a_vertex_without_a_position_is_no_shortcut() -> None:
    sheet = grid(2, 2)
    broken = Shape(sheet.verts, sheet.faces, "broken", invalid=np.arange(9) == 4)
    whole, around = (GeodesicDistances(s, unit=1.0).rows(np.array([0]))[0] for s in (sheet, broken))
    assert whole[8] == pytest.approx(np.sqrt(8))
    assert around[8] == pytest.approx(2 + np.sqrt(2))  # around vertex 4, whose place is a stand-in
    assert np.isfinite(around).all()


def test_of_several_ways_between_two_vertices_the_shortest_counts() -> None:
    # A double pyramid: its tips see each other over three edges, at three lengths.
    verts = np.array([[-3, 0, 0], [0.2, 2, 0], [0.2, -2, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 3], [2, 1, 3], [1, 0, 3], [2, 0, 4], [1, 2, 4], [0, 1, 4]])
    found = GeodesicDistances(Shape(verts, faces), unit=1.0).rows(np.array([3]))[0]
    assert found[4] == pytest.approx(2 * np.hypot(0.2, 1))


def test_a_cloud_and_a_shape_without_area_are_refused() -> None:
    with pytest.raises(InputError, match="no faces") as caught:
        GeodesicDistances(Shape(np.eye(3), np.zeros((0, 3), int), "dots"))
    assert "mesh" in caught.value.hint
    with pytest.raises(InputError, match="no surface area"):
        GeodesicDistances(Shape(np.zeros((3, 3)), np.array([[0, 1, 2]]), "flat"))
