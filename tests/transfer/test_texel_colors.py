"""Where on the source the texels of the target lie."""

import numpy as np
import pytest

from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_colors import TexelLocator, edge_bends


def grid(N: int) -> Shape:
    """A square of 1 by 1 in the plane z = 0."""
    x, y = np.meshgrid(np.linspace(0, 1, N), np.linspace(0, 1, N))
    first = (np.arange(N - 1)[:, None] * N + np.arange(N - 1)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + 1, first + N + 1], 1), np.stack([first, first + N + 1, first + N], 1)]
    )
    return Shape(np.stack([x.ravel(), y.ravel(), np.zeros(N * N)], 1), faces)


def bent(points: np.ndarray) -> np.ndarray:
    """Where points of the target belong on the source."""
    x, y, z = points.T
    return np.stack([x + 0.1 * np.sin(np.pi * x), y + 0.1 * np.sin(np.pi * y), z], 1)


def put(source: Shape, target: Shape, places: np.ndarray) -> VertexMap:
    foot = MappedMesh.of(target).query(places)
    return VertexMap.between(source, target, foot.vertex, face=foot.face, barycentric=foot.barycentric)


SOURCE, TARGET = grid(61), grid(6)
BACK = put(TARGET, SOURCE, bent(TARGET.verts))


@pytest.fixture(scope="module")
def forward() -> VertexMap:
    fine = grid(201)
    there = MappedMesh.of(Shape(bent(fine.verts), fine.faces)).query(SOURCE.verts)
    return put(SOURCE, TARGET, interpolate(fine.verts, fine.faces[there.face], there.barycentric))


def missed(bends: np.ndarray | None) -> np.ndarray:
    """How far places of texels all over the target lie from where they belong on the source, in sides of the square."""
    walker, corners = SurfaceWalker(SOURCE), 100 * TARGET.verts[TARGET.faces][..., :2]
    locator = TexelLocator(walker, TARGET, BACK, corners, bends)
    weights = np.random.default_rng(0).dirichlet([1, 1, 1], TARGET.F)
    asked = interpolate(TARGET.verts, TARGET.faces, weights)
    x, y = (100 * asked[:, :2]).T.astype(np.float32)
    _, place, held = locator.locate(np.arange(TARGET.F, dtype=np.int32), x, y)
    found = interpolate(SOURCE.verts, SOURCE.faces[place], held.T.astype(np.float64))
    return np.asarray(np.linalg.norm(found - bent(asked), axis=1))


def test_the_way_there_bends_the_images_of_triangles(forward: VertexMap) -> None:
    straight, curved = missed(None), missed(edge_bends(SOURCE, TARGET, forward, BACK))
    assert straight.max() > 0.003
    assert curved.mean() < 0.4 * straight.mean()
    assert curved.max() < 0.5 * straight.max()


def test_a_map_that_is_straight_bends_nothing() -> None:
    found = edge_bends(SOURCE, TARGET, put(SOURCE, TARGET, SOURCE.verts), put(TARGET, SOURCE, TARGET.verts))
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


def test_maps_that_disagree_bend_no_more_than_one_of_them(forward: VertexMap) -> None:
    shifted = put(TARGET, SOURCE, bent(TARGET.verts + np.array([0.02, 0, 0])))
    found, alone = edge_bends(SOURCE, TARGET, forward, shifted), edge_bends(SOURCE, TARGET, forward, BACK)
    assert found is not None and alone is not None
    same = (found == alone).all(axis=2)
    assert same.mean() > 0.9 and (found[~same] == 0).all()
    far = put(TARGET, SOURCE, bent(TARGET.verts + np.array([0.15, 0, 0])))
    assert (edge_bends(SOURCE, TARGET, forward, far) == 0).mean() > 0.9


def test_what_the_way_there_does_not_know_bends_nothing(forward: VertexMap, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = put(SOURCE, TARGET, SOURCE.verts[::-1])  # turned about: the middles belong far from the ends
    turned = edge_bends(SOURCE, TARGET, elsewhere, BACK)
    assert np.linalg.norm(turned, axis=2).max() < 0.5 * 0.25
    cloud = Shape(SOURCE.verts, np.empty((0, 3), int))
    assert edge_bends(cloud, TARGET, forward, BACK) is None
    rounded = VertexMap.between(SOURCE, TARGET, forward.index)  # to vertices: it would bend by what it is wrong
    assert edge_bends(SOURCE, TARGET, rounded, BACK) is None
    monkeypatch.setattr("meshmatch.transfer.texel_colors._MAX_BEND_FACES", TARGET.F - 1)
    assert edge_bends(SOURCE, TARGET, forward, BACK) is None
