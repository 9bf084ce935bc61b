"""Laplacian eigenfunctions, functional maps both ways, and what is measured of maps besides errors."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pyFM import spectral

from meshmatch.api.results import evaluate
from meshmatch.errors import InputError
from meshmatch.maps.evaluate import dirichlet_energy
from meshmatch.maps.functional import laplacian_basis, map_from_functional
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from tests.maps.solids import bumpy_sphere, grid
from tests.maps.test_vertex_map import random_map

BUMPY = bumpy_sphere()


def shuffled(shape: Shape, seed: int = 0) -> tuple[Shape, np.ndarray]:
    """The same mesh with its vertices in another order, and where each went."""
    order = np.random.default_rng(seed).permutation(shape.V)
    return Shape(shape.verts[order], np.argsort(order)[shape.faces], "shuffled"), np.argsort(order)


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_eigenfunctions_are_orthonormal_and_those_of_a_sphere(unit: float) -> None:
    polar, around = np.meshgrid(np.arccos(np.linspace(-0.99, 0.99, 25)), np.linspace(0, 6, 50))
    round_cloud = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    ball = bumpy_sphere(40, 60)
    ball = replace(ball, verts=unit * ball.verts / np.linalg.norm(ball.verts, axis=1, keepdims=True))
    basis = laplacian_basis(ball, 9)
    assert basis.vectors.T @ (basis.mass[:, None] * basis.vectors) == pytest.approx(np.eye(9), abs=1e-8)
    assert basis.values * unit**2 == pytest.approx([0, 2, 2, 2, 6, 6, 6, 6, 6], rel=0.02, abs=1e-6)  # l (l + 1)
    assert np.array_equal(laplacian_basis(ball, 9).vectors, basis.vectors)
    assert laplacian_basis(unit * round_cloud.reshape(-1, 3), 3).vectors.shape == (1250, 3)


def test_weighted_by_areas_it_is_the_functional_map_of_the_literature() -> None:
    """`pyFM.spectral.p2p_to_FM(p2p_21, evects1, evects2, A2)` is ``evects2.T @ (A2[:, None] * evects1[p2p_21])``."""
    other = shuffled(bumpy_sphere(20, 30))[0]
    here, there = laplacian_basis(BUMPY, 12), laplacian_basis(other, 9)
    p2p = np.random.default_rng(1).integers(0, other.V, BUMPY.V)
    found = VertexMap.between(BUMPY, other, p2p).functional(here.vectors, there.vectors, here.mass)
    assert found == pytest.approx(here.vectors.T @ (here.mass[:, None] * there.vectors[p2p]), abs=1e-9)


def test_it_is_that_of_pyfm_both_ways() -> None:
    other = shuffled(bumpy_sphere(20, 30))[0]
    here, there = laplacian_basis(BUMPY, 12), laplacian_basis(other, 9)
    p2p = np.random.default_rng(1).integers(0, other.V, BUMPY.V)
    theirs = spectral.p2p_to_FM(p2p, there.vectors, here.vectors, A2=here.mass)
    assert VertexMap.between(BUMPY, other, p2p).functional(here.vectors, there.vectors, here.mass) == pytest.approx(
        theirs
    )
    back = map_from_functional(theirs, BUMPY, other, here.vectors, there.vectors).index
    assert (back == spectral.FM_to_p2p(theirs, there.vectors, here.vectors)).mean() > 0.99


def test_there_and_back() -> None:
    other, went = shuffled(BUMPY)
    here, there = laplacian_basis(BUMPY, 40), laplacian_basis(other, 50)
    matrix = VertexMap.between(BUMPY, other, went).functional(here.vectors, there.vectors, here.mass)
    back = map_from_functional(matrix, BUMPY, other, here.vectors, there.vectors)
    assert (back.index == went).mean() > 0.98
    for wrong, words in ((matrix[:, :, None], "functional map must be"), (matrix.T, "basis of the source must be")):
        with pytest.raises(InputError, match=words):
            map_from_functional(wrong, BUMPY, other, here.vectors, there.vectors)


def test_what_has_no_eigenfunctions_or_masses_is_told(cube: Shape) -> None:
    with pytest.raises(InputError, match="no 50 eigenfunctions") as caught:
        laplacian_basis(cube, 50)
    assert str(cube.V - 2) in caught.value.hint
    with pytest.raises(InputError, match="without a position"):
        laplacian_basis(Shape.with_invalid(np.vstack([cube.verts, [[np.nan] * 3]]), cube.faces, "holed"), 3)
    wrong: tuple[Any, ...] = (True, "5", 5.0, None)
    for K in wrong:
        with pytest.raises(InputError, match=f"must be an integer, not {K!r}"):
            laplacian_basis(cube, K)
    with pytest.raises(InputError, match="no surface"):
        laplacian_basis(np.arange(60.0)[:, None] * [1.0, 0.0, 0.0], 3)
    for mass in (np.ones(3), np.zeros(cube.V), np.full(cube.V, np.nan)):
        with pytest.raises(InputError, match="masses"):
            VertexMap.identity(cube).functional(np.ones((cube.V, 1)), np.ones((cube.V, 1)), mass)


def test_energy_and_round_trip() -> None:
    other, went = shuffled(BUMPY)
    there, back = VertexMap.between(BUMPY, other, went), VertexMap.between(other, BUMPY, np.argsort(went))
    found = evaluate(there, BUMPY, other, backward=back)
    assert found.dirichlet == pytest.approx(1.0) and found.bijectivity == 0.0
    larger = Shape(7 * other.verts, other.faces, "larger")
    assert dirichlet_energy(VertexMap.between(BUMPY, larger, went), BUMPY, larger) == pytest.approx(1.0)
    sheet = grid(8, 8)
    wide = Shape(sheet.verts * [2.0, 0.5, 1.0], sheet.faces, "wide")  # of the same area: (4 + 1 / 4) / 2
    assert dirichlet_energy(VertexMap.between(sheet, wide, np.arange(sheet.V)), sheet, wide) == pytest.approx(2.125)
    rough = evaluate(random_map(BUMPY, other, 0), BUMPY, other, backward=random_map(other, BUMPY, 1))
    assert rough.dirichlet and rough.dirichlet > 10 and rough.bijectivity and rough.bijectivity > 0.3
    assert evaluate(there, BUMPY, other).bijectivity is None
    with pytest.raises(InputError, match="the map back"):
        evaluate(there, BUMPY, other, backward=VertexMap.between(other, grid(2, 2), np.zeros(other.V, int)))
