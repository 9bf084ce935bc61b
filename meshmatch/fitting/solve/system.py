"""The linear algebra of a node fit, compiled once per template.

Unknowns are the K node vectors. A data term at template point p is a 3 x 3 weight H_p and a target; its
normal matrix is sum_p (Phi_p^T Phi_p) (x) H_p. The products Phi_pi Phi_pj never change, so they are kept as
one sparse matrix over node pairs: assembling costs about 6 V n^2 / 2 multiplications (n = 17 nodes in
reach), a few milliseconds. Only nodes that meet at some template point share an entry; with the nodes in
reverse Cuthill-McKee order these lie in a band, in whose envelope Cholesky takes a fifth of the dense one's time.
Where nodes reach most points, keeping the products would take gigabytes: they are formed in each step, and the band is
the whole matrix.
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
from meshmatch.shapes.outside import without_hidden
from meshmatch.shapes.rims import RIM, is_sheet, rim_corners, rim_lengths
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape

if TYPE_CHECKING:
    from meshmatch.fields.field import PointwiseField

# Where the upper triangle xx xy xz yy yz zz belongs in a 3 x 3 block, row by row.
_BLOCK = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_DIAGONAL = [0, 3, 5]
_HELD = 1e-6  # weight of what decides where points do not
# More products than this (about a gigabyte while they are sorted) are not kept.
_MAX_PRODUCTS = 20_000_000


class NodeSystem:
    """A field on a template's vertices, arranged for repeated least squares on its node vectors.

    With a field that is not linear it moves the template all the same, but there is nothing to `solve` for. The deformation
    gradient F is asked at ``gradient_points`` of the vertices, at most.

    ``verts`` (V, 3) and ``faces`` (F, 3) are the template's, in its frame; ``gradient_points`` (G,) numbers of vertices.
    """

    phi: Any  # (V, K), sparse or dense, where the field is linear

    def __init__(self, shape: Shape, field: ShapeFunctions | PointwiseField, gradient_points: int = 1500) -> None:
        self.verts = np.asarray(shape.verts)
        self.faces = np.asarray(shape.faces)
        self.linear = isinstance(field, ShapeFunctions)
        F = len(self.faces)  # each vertex with the faces around it
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
        """Which vertices of the template lie where it ends; at cracks it does not."""
        return rim_lengths(Shape(self.verts, self.faces)) > RIM

    @property
    @derived
    def is_sheet(self) -> bool:
        """Whether the template is an open sheet, such as a leaf."""
        return is_sheet(Shape(self.verts, self.faces))

    @property
    @derived
    def rim_corners(self) -> Int[Ints, "E 3"]:
        """Edges of the template where it ends, see `meshmatch.shapes.rims.rim_corners`."""
        return rim_corners(Shape(self.verts, self.faces))

    @property
    @derived
    def equations(self) -> Equations:
        assert isinstance(self.field, ShapeFunctions)
        return Equations.of(self.phi, self.field.gradient_at(self.gradient_points))

    @property
    @derived
    def shows_all(self) -> bool:
        """Whether all of the resting template can be seen from outside; the chambers of a heart cannot."""
        resting = Shape(self.verts, self.faces)
        return without_hidden(resting) is resting

    def moved(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "V 3"]:
        """Template vertices under node vectors, or under whatever rows the field reads."""
        return self.verts + (self.phi @ vectors if self.linear else self.field.displaced(vectors))

    def vectors_to(self, points: Float[Floats, "V 3"]) -> Float[Floats, "K 3"]:
        """Node vectors that take the template's vertices to points that the field can reach, or nearly."""
        weights = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], (len(points), 1))
        turns = np.tile(kabsch(self.verts, points).rotation, (len(self.gradient_points), 1, 1))
        return self.solve(weights, points, _HELD, turns, _HELD, np.zeros((self.K, 3)))

    def deformation_gradient(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "G 3 3"]:
        """F at the gradient points, F[g, a, k] = d x'_a / d x_k."""
        if not self.linear:
            return self.field.deformation_gradient_at(vectors, self.gradient_points)
        return np.asarray((self.equations.gradient @ vectors).reshape(-1, 3, 3).transpose(0, 2, 1) + np.eye(3))

    def regularity(self, vectors: Float[Floats, "K 3"]) -> Regularity:
        """How regular the deformation is, at all vertices."""
        return Regularity.of(self.field.deformation_gradient_at(vectors))

    def unfolded(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
        """Node vectors near the given ones under which no vertex is folded, or fewer; see `Unfolding`."""
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
        """Area-weighted unit vertex normals of moved vertices."""
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

        ``weights`` are upper triangles of H_p in the order xx xy xz yy yz zz, ``pulls`` right-hand sides H_p s_p,
        ``prior_weight`` is w, and ``targets`` are the T_g.
        """
        fixed = self.equations
        (xx, xy, xz, yy, yz, zz), (x, y, z) = weights.T, self.verts.T
        full = np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], 1)
        right = self.phi.T @ (pulls - full)
        wanted = (targets - np.eye(3)).transpose(0, 2, 1).reshape(-1, 3)
        right += prior_weight * (fixed.gradient.T @ wanted) + damping * current
        right, solved = right[fixed.order], np.empty((self.K, 3))
        if not (xy.any() or xz.any() or yz.any()) and (xx == yy).all() and (xx == zz).all():
            solved[fixed.order] = self._solved_alike(weights[:, :1], prior_weight, damping, right)
            return solved
        blocks = fixed.pairs @ weights  # pairs 6
        blocks[:, _DIAGONAL] += prior_weight * fixed.gradient_pairs[:, None]
        normal = np.zeros((3 * self.K, fixed.envelope.columns))
        normal.reshape(-1)[fixed.place] = blocks.reshape(-1).take(fixed.entry)
        normal[:, 0] += damping
        solved[fixed.order] = fixed.envelope.solve(normal, right.reshape(-1)).reshape(-1, 3)
        return solved

    def _solved_alike(
        self, weights: Float[Floats, "V 1"], prior_weight: float, damping: float, right: Float[Floats, "K 3"]
    ) -> Float[Floats, "K 3"]:
        """Where every H_p is a multiple of the identity: x, y and z have the same matrix, of a third of the size."""
        fixed = self.equations
        normal = np.zeros((self.K, fixed.node_band + 1))
        blocks = fixed.pairs @ weights
        normal.reshape(-1)[fixed.node_place] = blocks[:, 0] + prior_weight * fixed.gradient_pairs
        normal[:, 0] += damping
        return solved_band(normal, np.ascontiguousarray(right.T)).T


@dataclass(frozen=True, eq=False, kw_only=True)
class Equations:
    """What never changes of a linear field's normal equations."""

    gradient: Any  # (3 G, K), of the shape functions at the gradient points
    pairs: Any  # (pairs, V), products Phi_pi Phi_pj of the nodes that meet somewhere
    gradient_pairs: Float[Floats, " pairs"]  # the same of the gradient, summed
    order: Int[Ints, " K"]  # of the nodes, in which those that meet are near one another
    envelope: Envelope  # of the band
    place: Int[Ints, " entries"]  # in its array, see `_band_places`, in ascending order
    entry: Int[Ints, " entries"]  # which number of the blocks (pairs, 6) belongs there
    node_band: int  # half width of the band of one unknown for each node
    node_place: Int[Ints, " pairs"]

    @classmethod
    def of(cls, phi: Any, gradient: Any) -> Equations:
        """For shape functions at the vertices, and their gradient at the gradient points."""
        K, gradient = phi.shape[1], gradient.astype(np.float64)
        row, column, pairs = _pair_products(phi)
        graph = coo_matrix((np.ones(len(row), np.int8), (row, column)), (K, K))
        order = reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True).astype(np.int64)
        met = gradient.T @ gradient
        summed = (met if isinstance(met, np.ndarray) else met.toarray())[row, column]
        rank = np.argsort(order)
        reach = np.arange(K)  # the last node that each meets, in that order, or one before it does
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


class _EveryPair:
    """The matrix (pairs, V) of Phi_pi Phi_pj where all nodes meet everywhere, formed when it is multiplied."""

    def __init__(self, phi: Float[Floats, "V K"], row: Ints, column: Ints) -> None:
        self._phi, self._at = phi, (row, column)

    def __matmul__(self, weights: Float[Floats, "V N"]) -> Float[Floats, "pairs N"]:
        columns = [(self._phi.T * weight) @ self._phi for weight in weights.T]
        return np.stack([column[self._at] for column in columns], 1)


def _pair_products(phi: Any) -> tuple[Ints, Ints, Any]:
    """Node pairs (i <= j) that meet somewhere, and the sparse matrix (pairs, V) of Phi_pi Phi_pj."""
    V, K = phi.shape
    if not isinstance(phi, np.ndarray):
        counts = np.diff(phi.indptr).astype(np.int64)
        sizes = counts**2
        phi = phi.toarray() if sizes.sum() > _MAX_PRODUCTS else phi
    if isinstance(phi, np.ndarray):
        row, column = np.triu_indices(K)
        return row, column, _EveryPair(phi, row, column)
    # Vertices with equally many nodes in reach at a time: each node of a vertex with itself and with those after it.
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
    # By columns, with which the product takes half as long as by rows.
    found = coo_matrix((np.concatenate(products), (number[code], where)), shape=(len(pairs), V)).tocsc()
    return pairs // K, pairs % K, found


def _band_places(row: Ints, column: Ints, rank: Int[Ints, " K"], size: int, columns: int) -> Int[Ints, "pairs places"]:
    """Where the block of every pair lies in the band of so many unknowns for each node, row by row.

    The band is stored column by column, each from its diagonal down: entry (i, j), i >= j, lies at j columns + i - j. The
    block of a node with itself names its off-diagonal entries twice.
    """
    a, b = np.divmod(np.arange(size**2), size)
    i, j = size * rank[row][:, None] + a, size * rank[column][:, None] + b
    return np.asarray(np.minimum(i, j) * columns + np.abs(i - j))
