"""Least squares on the node vectors of a template; whatever is constant is computed once per template.

Unknowns are the K node vectors. A data term at template point p is a 3 x 3 weight H_p and a target; its normal matrix is
sum_p (Phi_p^T Phi_p) (x) H_p. The products Phi_pi Phi_pj are constant and are stored as a sparse matrix over pairs of
nodes, so that assembly takes about 6 V n^2 / 2 multiplications (n = 17 nodes in reach), a few milliseconds. Only nodes that
both reach some template point share an entry. With nodes in reverse Cuthill-McKee order the entries lie in a band, and
Cholesky factorization within the band's envelope takes a fifth of the time of a dense one. If nodes reach most points,
stored products would take gigabytes; they are then computed in each step, and the band is the whole matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.derived import derived
from meshmatch.fields.shape_functions import ShapeFunctions
from meshmatch.fitting.solve.banded import Envelope, solved_band
from meshmatch.fitting.solve.regularity import Regularity, Unfolding
from meshmatch.geometry.frames import kabsch
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.triangles import row_sums, triangle_vectors
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.hidden_faces import remove_hidden_faces
from meshmatch.shapes.rims import MIN_RIM_LENGTH, is_sheet, rim_corners, rim_lengths
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape

if TYPE_CHECKING:
    from meshmatch.fields.field import PointwiseField

# Index into the upper triangle xx xy xz yy yz zz for each entry of a 3 x 3 block, row by row.
_BLOCK = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_DIAGONAL = [0, 3, 5]
_REGULARIZATION = 1e-6  # weight of prior and damping where points alone might not determine the node vectors
# More products than this (about a gigabyte during sorting) are not stored.
_MAX_PRODUCTS = 20_000_000


class NodeSystem:
    """A field on a template's vertices, prepared for repeated least squares on its node vectors.

    A field that is not linear can deform the template too, but there is nothing to `solve` for. Deformation gradients F are
    evaluated at ``gradient_points``, at most as many vertices as the argument says.

    ``verts`` (V, 3) and ``faces`` (F, 3) are the template's, in its frame; ``gradient_points`` (G,) are indices of
    vertices.
    """

    phi: Any  # (V, K), sparse or dense; only if the field is linear

    def __init__(self, shape: Shape, field: ShapeFunctions | PointwiseField, gradient_points: int = 1500) -> None:
        self.verts = np.asarray(shape.verts)
        self.faces = np.asarray(shape.faces)
        self.linear = isinstance(field, ShapeFunctions)
        F = len(self.faces)  # the incidence matrix below sums over the faces around each vertex
        corners = self.faces.T.reshape(-1), np.tile(np.arange(F), 3)
        self._incidence = csr_matrix((np.ones(3 * F), corners), shape=(len(self.verts), F))
        self.field = field
        if isinstance(field, ShapeFunctions):
            self.K = field.K
            self.phi = field.phi.astype(np.float64)
        self._gradient_count = min(gradient_points, len(self.verts))

    @property
    @derived
    def gradient_points(self) -> Int[Ints, " G"]:
        return farthest_points(self.verts, self._gradient_count)

    @property
    @derived
    def rim(self) -> Bool[Bools, " V"]:
        """Mask (V,) of vertices where the template ends; cracks are not ends."""
        return rim_lengths(Shape(self.verts, self.faces)) > MIN_RIM_LENGTH

    @property
    @derived
    def is_sheet(self) -> bool:
        """Whether the template is an open sheet, such as a leaf."""
        return is_sheet(Shape(self.verts, self.faces))

    @property
    @derived
    def rim_corners(self) -> Int[Ints, "E 3"]:
        """Boundary edges where the template ends, see `meshmatch.shapes.rims.rim_corners`."""
        return rim_corners(Shape(self.verts, self.faces))

    @property
    @derived
    def equations(self) -> Equations:
        assert isinstance(self.field, ShapeFunctions)
        return Equations.of(self.phi, self.field.gradient_at(self.gradient_points))

    @property
    @derived
    def shows_all(self) -> bool:
        """Whether all of the rest template is visible from outside; the chambers of a heart are not."""
        resting = Shape(self.verts, self.faces)
        return remove_hidden_faces(resting) is resting

    def moved(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "V 3"]:
        """Template vertices under node vectors (or the output rows of a field without nodes)."""
        return self.verts + (self.phi @ vectors if self.linear else self.field.displaced(vectors))

    def vectors_to(self, points: Float[Floats, "V 3"]) -> Float[Floats, "K 3"]:
        """Node vectors that move the template's vertices to given points, exactly or approximately."""
        weights = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], (len(points), 1))
        turns = np.tile(kabsch(self.verts, points).rotation, (len(self.gradient_points), 1, 1))
        return self.solve(weights, points, _REGULARIZATION, turns, _REGULARIZATION, np.zeros((self.K, 3)))

    def deformation_gradient(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "G 3 3"]:
        """F at the gradient points, F[g, a, k] = d x'_a / d x_k."""
        if not self.linear:
            return self.field.deformation_gradient_at(vectors, self.gradient_points)
        return np.asarray((self.equations.gradient @ vectors).reshape(-1, 3, 3).transpose(0, 2, 1) + np.eye(3))

    def regularity(self, vectors: Float[Floats, "K 3"]) -> Regularity:
        """Regularity of the deformation at all vertices."""
        return Regularity.of(self.field.deformation_gradient_at(vectors))

    def unfolded(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
        """Node vectors near the given ones with no folded vertices, or fewer; see `Unfolding`."""
        return self._unfolding(vectors)

    @property
    @derived
    def _unfolding(self) -> Unfolding:
        assert isinstance(self.field, ShapeFunctions)
        return Unfolding(self.field.phi, self.field.gradient)

    def surface(self, vectors: Float[Floats, "K 3"]) -> OrientedPoints:
        """Template vertices under node vectors, with their normals."""
        moved = self.moved(vectors)
        return OrientedPoints(moved, self.normals(moved))

    def normals(self, moved: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
        """Area-weighted unit vertex normals for deformed vertices."""
        summed = np.asarray(self._incidence @ triangle_vectors(moved, self.faces))
        return np.asarray(summed / np.maximum(np.sqrt(row_sums(np.square(summed))), 1e-20)[:, None])

    def solve(
        self,
        weights: Float[Floats, "V 6"],
        pulls: Float[Floats, "V 3"],
        prior_weight: float,
        targets: Float[Floats, "G 3 3"],
        damping: float,
        current: Float[Floats, "K 3"],
    ) -> Float[Floats, "K 3"]:
        """Minimise sum_p |y_p - s_p|^2_{H_p} + w sum_g |F_g - T_g|^2 + damping |u - current|^2 over node vectors u.

        ``weights`` are upper triangles of H_p in the order xx xy xz yy yz zz, ``pulls`` are right-hand sides H_p s_p,
        ``prior_weight`` is w, and ``targets`` are the T_g.
        """
        equations = self.equations
        (xx, xy, xz, yy, yz, zz), (x, y, z) = weights.T, self.verts.T
        weighted_verts = np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], 1)
        right_side = self.phi.T @ (pulls - weighted_verts)
        wanted = (targets - np.eye(3)).transpose(0, 2, 1).reshape(-1, 3)
        right_side += prior_weight * (equations.gradient.T @ wanted) + damping * current
        right_side, solved = right_side[equations.order], np.empty((self.K, 3))
        if not (xy.any() or xz.any() or yz.any()) and (xx == yy).all() and (xx == zz).all():
            solved[equations.order] = self._solve_isotropic(weights[:, :1], prior_weight, damping, right_side)
            return solved
        blocks = equations.pairs @ weights  # pairs 6
        blocks[:, _DIAGONAL] += prior_weight * equations.gradient_pairs[:, None]
        normal = np.zeros((3 * self.K, equations.envelope.columns))
        normal.reshape(-1)[equations.place] = blocks.reshape(-1).take(equations.entry)
        normal[:, 0] += damping
        solved[equations.order] = equations.envelope.solve(normal, right_side.reshape(-1)).reshape(-1, 3)
        return solved

    def _solve_isotropic(
        self, weights: Float[Floats, "V 1"], prior_weight: float, damping: float, right_side: Float[Floats, "K 3"]
    ) -> Float[Floats, "K 3"]:
        """Solve if every H_p is a multiple of the identity: x, y and z then share one matrix of a third of the size."""
        equations = self.equations
        normal = np.zeros((self.K, equations.node_band + 1))
        blocks = equations.pairs @ weights
        normal.reshape(-1)[equations.node_place] = blocks[:, 0] + prior_weight * equations.gradient_pairs
        normal[:, 0] += damping
        return solved_band(normal, np.ascontiguousarray(right_side.T)).T


@dataclass(frozen=True, eq=False, kw_only=True)
class Equations:
    """The constant parts of a linear field's normal equations."""

    gradient: Any  # (3 G, K), gradient of the shape functions at the gradient points
    pairs: Any  # (pairs, V), products Phi_pi Phi_pj for pairs of nodes that reach a common vertex
    gradient_pairs: Float[Floats, " pairs"]  # the same for the gradient, summed over the gradient points
    order: Int[Ints, " K"]  # order of the nodes with a small bandwidth
    envelope: Envelope  # envelope of the band
    place: Int[Ints, " entries"]  # indices into the band's array, see `_band_places`, in ascending order
    entry: Int[Ints, " entries"]  # index into the blocks (pairs, 6) for each of these
    node_band: int  # half bandwidth with one unknown per node
    node_place: Int[Ints, " pairs"]

    @classmethod
    def of(cls, phi: Any, gradient: Any) -> Equations:
        """Precompute from the shape functions at the vertices, and their gradient at the gradient points."""
        K, gradient = phi.shape[1], gradient.astype(np.float64)
        row, column, pairs = _pair_products(phi)
        graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), (K, K))
        order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True).astype(np.int64)
        met = gradient.T @ gradient
        summed = (met if isinstance(met, np.ndarray) else met.toarray())[row, column]
        rank = np.argsort(order)
        reach = np.arange(K)  # last node, in that order, with which each node shares an entry
        np.maximum.at(reach, np.minimum(rank[row], rank[column]), np.maximum(rank[row], rank[column]))
        envelope = Envelope(np.repeat(3 * np.maximum.accumulate(reach) + 3, 3))
        node_band = int((reach - np.arange(K)).max())
        places = _band_places(row, column, rank, 3, envelope.columns)
        place, first = np.unique(places, return_index=True)
        entry = (6 * np.arange(len(row))[:, None] + _BLOCK).reshape(-1)[first]
        return cls(
            gradient=gradient,
            pairs=pairs,
            gradient_pairs=summed,
            order=order,
            envelope=envelope,
            place=place,
            entry=entry,
            node_band=node_band,
            node_place=_band_places(row, column, rank, 1, node_band + 1)[:, 0],
        )


@derived
def node_system(model: TrainedModel) -> NodeSystem:
    """The least-squares system of a model's template and field."""
    shape = model.template.shape
    return NodeSystem(shape, model.field(shape.verts))


class _DensePairs:
    """The matrix (pairs, V) of Phi_pi Phi_pj for all pairs of nodes, computed only when it is multiplied."""

    def __init__(self, phi: Float[Floats, "V K"], row: Ints, column: Ints) -> None:
        self._phi, self._at = phi, (row, column)

    def __matmul__(self, weights: Float[Floats, "V N"]) -> Float[Floats, "pairs N"]:
        columns = [(self._phi.T * weight) @ self._phi for weight in weights.T]
        return np.stack([column[self._at] for column in columns], 1)


def _pair_products(phi: Any) -> tuple[Ints, Ints, Any]:
    """Pairs of nodes (i <= j) that reach a common vertex, and the sparse matrix (pairs, V) of Phi_pi Phi_pj."""
    V, K = phi.shape
    if not isinstance(phi, np.ndarray):
        counts = np.diff(phi.indptr).astype(np.int64)
        sizes = counts**2
        phi = phi.toarray() if sizes.sum() > _MAX_PRODUCTS else phi
    if isinstance(phi, np.ndarray):
        row, column = np.triu_indices(K)
        return row, column, _DensePairs(phi, row, column)
    # Group vertices by their number of nodes in reach; pair each node of a vertex with itself and those after it.
    phi.sort_indices()
    rows, codes, products = [], [], []
    for count in np.unique(counts[counts > 0]):
        at = np.flatnonzero(counts == count)
        first, second = np.triu_indices(count)
        here = phi.indptr[at][:, None] + np.arange(count, dtype=np.int32)
        nodes, values = phi.indices[here], phi.data[here]
        codes.append((nodes[:, first] * np.int32(K) + nodes[:, second]).ravel())
        products.append((values[:, first] * values[:, second]).ravel())
        rows.append(np.repeat(at.astype(np.int32), len(first)))
    code, where = np.concatenate(codes), np.concatenate(rows)
    met = np.zeros(K * K, bool)
    met[code] = True
    pairs, number = np.flatnonzero(met), np.cumsum(met, dtype=np.int32) - np.int32(1)
    # Stored by columns, as the product then takes half as long.
    found = coo_matrix((np.concatenate(products), (number[code], where)), shape=(len(pairs), V)).tocsc()
    return pairs // K, pairs % K, found


def _band_places(row: Ints, column: Ints, rank: Int[Ints, " K"], size: int, columns: int) -> Int[Ints, "pairs places"]:
    """Index of every entry of each pair's block in the band array, with ``size`` unknowns per node.

    The band is stored column by column, each from the diagonal down: entry (i, j), i >= j, is at j columns + i - j. The
    block of a node with itself has each off-diagonal index twice.
    """
    a, b = np.divmod(np.arange(size**2), size)
    i, j = size * rank[row][:, None] + a, size * rank[column][:, None] + b
    return np.asarray(np.minimum(i, j) * columns + np.abs(i - j))
