"""Moving least squares for arbitrary nodes and points: in NumPy or torch, batched, with derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from scipy.sparse import csr_matrix

from meshmatch.arrays import Floats, Ints, as_numbers, is_tensor
from meshmatch.errors import InputError, OptionError
from meshmatch.fields.local_fits import LocalFits, alike, namespace, plain, sums
from meshmatch.fields.shape_functions import check_kernel, checked_radii, warn_amplification
from meshmatch.geometry.kernels import Kernel, poorly_supported, support_pairs
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.shape import LARGEST

Outside = Literal["error", "mask", "nearest"]
_N_NEAREST = 4  # nodes that move a point out of reach
_SOFTENING = 1e-3  # units of a node's radius: the weight grows no further at smaller distances
_USE_AUTOGRAD = "use torch.autograd, or transform a function of the vectors alone"
_SUPPORT_MARGIN = 2.0  # factor on the required support, so that no point that is not masked fails because of rounding


@dataclass(frozen=True, eq=False)
class NodeField:
    """A deformation field of K nodes on P points, with its spatial derivatives. Made by `node_field`.

    Vectors are (K, C), or (B, K, C) for a batch, with any number C of components. Results are tensors if points or vectors
    are, in the precision of both, and batched if either is. Tensors keep their gradients with respect to the vectors, and
    to the points, nodes and radii that the field was made from.

    Attributes
    ----------
    points
        (P, 3), or (B, P, 3) if points or nodes were a batch.
    K
        Number of nodes.
    reached
        (P,) or (B, P) bool array: False for points out of reach of the nodes.
    pieces
        Parts of the calculation: indices of points, and the shape functions there.
    """

    points: Any
    K: int
    reached: Any
    pieces: tuple[tuple[Ints, LocalFits | NearestNodes], ...]

    def __repr__(self) -> str:
        size, kind = " x ".join(map(str, self.points.shape[:-1])), type(self.points).__name__
        return (
            f"NodeField({size} points, {self.K} nodes, {kind} {self.points.dtype}, {self.reached.mean():.0%} reached)"
        )

    @property
    def lebesgue(self) -> Floats:
        """(P,) or (B, P) sums of the absolute shape functions: the factor by which errors of the vectors can grow.

        The maximum is the Lebesgue constant; 1 is best.
        """
        at, _ = self._pairs
        return (
            np.bincount(at, abs(plain(self._values[:, 0])), self.reached.size).astype(float).reshape(self.reached.shape)
        )

    def displacement(self, vectors: Any) -> Any:
        """Displacement of the points by vectors of the nodes.

        Parameters
        ----------
        vectors
            (K, C) or (B, K, C).

        Returns
        -------
        (P, C) or (B, P, C)
            0 where a point is masked.

        Raises
        ------
        InputError
            There is not one vector for each node, or the batch sizes differ.
        """
        return self._applied(self._values, vectors)[..., 0]

    def moved(self, vectors: Any) -> Any:
        """Positions of the points after they are moved by vectors of the nodes.

        Parameters
        ----------
        vectors
            (K, 3) or (B, K, 3).

        Returns
        -------
        (P, 3) or (B, P, 3)
            The points plus their displacement.

        Raises
        ------
        InputError
            As for `displacement`, or the vectors do not have three components.
        """
        found = self.displacement(vectors)
        _check_three(found.shape[-1])
        return _convert(self.points, found) + found

    def gradient(self, vectors: Any) -> Any:
        """The derivative of the displacement with respect to position.

        Parameters
        ----------
        vectors
            (K, C) or (B, K, C).

        Returns
        -------
        (P, C, 3) or (B, P, C, 3)
            ``[..., a, k]`` is the derivative of component a along axis k.

        Raises
        ------
        InputError
            As for `displacement`.
        """
        return self._applied(self._gradients, vectors)

    def deformation_gradient(self, vectors: Any) -> Any:
        """The deformation gradient F, the derivative of moved positions with respect to positions: identity plus `gradient`.

        Parameters
        ----------
        vectors
            (K, 3) or (B, K, 3).

        Returns
        -------
        (P, 3, 3) or (B, P, 3, 3)
            ``[..., a, k]`` is dx'_a / dx_k.

        Raises
        ------
        InputError
            As for `moved`.
        """
        found = self.gradient(vectors)
        _check_three(found.shape[-2])
        return found + _convert(np.eye(3), found)

    def second_derivative(self, vectors: Any) -> Any:
        """The second derivatives of the displacement with respect to position.

        Parameters
        ----------
        vectors
            (K, C) or (B, K, C).

        Returns
        -------
        (P, C, 3, 3) or (B, P, C, 3, 3)
            ``[..., a, k, l]``, symmetric in k and l.

        Raises
        ------
        InputError
            As for `displacement`.
        """
        found = self._applied(self._seconds, vectors)
        return found.reshape(*found.shape[:-1], 3, 3)

    def matrix(self) -> csr_matrix:
        """The shape functions as a SciPy matrix, without gradients: ``matrix() @ vectors`` is `displacement`.

        Returns
        -------
        (P, K) csr_matrix, float64
            For a batch (B P, B K), block diagonal.
        """
        values = plain(self._values[:, 0]).astype(np.float64)
        return csr_matrix((values, self._pairs), (self.reached.size, self._fields * self.K))

    @property
    def _fields(self) -> int:
        """Number of fields in the batch."""
        return len(self.points) if self.points.ndim == 3 else 1

    @cached_property
    def _pairs(self) -> tuple[Ints, Ints]:
        """(N,) indices of points and of nodes, counted over the whole batch."""
        at, nodes = zip(*((rows[plain(fit.at)], plain(fit.of_node)) for rows, fit in self.pieces), strict=True)
        return np.concatenate(at), np.concatenate(nodes)

    @cached_property
    def _values(self) -> Any:
        """(N, 1) shape functions of the pairs."""
        return _concatenate([fit.values[:, None] for _, fit in self.pieces])

    @cached_property
    def _gradients(self) -> Any:
        """(N, 3) their gradients."""
        return _concatenate([fit.gradient for _, fit in self.pieces])

    @cached_property
    def _seconds(self) -> Any:
        """(N, 9) their second derivatives."""
        return _concatenate([fit.second_derivative.reshape(-1, 9) for _, fit in self.pieces])

    def _applied(self, values: Any, vectors: Any) -> Any:
        """(..., P, C, D) sums over nodes of pair values (N, D) times vectors (..., K, C)."""
        given: Any = vectors if is_tensor(vectors) else as_numbers(vectors, "vectors", finite=True)
        shape, B = tuple(given.shape), self._fields
        dense = not is_tensor(given) or str(given.layout) == "torch.strided"
        fits = len(shape) in (2, 3) and 0 not in shape and shape[-2] == self.K
        if not (dense and fits and (len(shape) == 2 or B in (1, len(given)))):
            batch = "B" if self.points.ndim == 2 else B
            layout = "" if dense else f" in the layout {given.layout}"
            what = f"vectors must be ({self.K}, C) or ({batch}, {self.K}, C), not {shape}{layout}"
            raise InputError(what, "give one vector for each node, in the order of the nodes")
        kind = _precision([self.points, vectors], given if is_tensor(given) else values)
        if is_tensor(given) and not is_tensor(values):
            values = alike(values, given.double() if given.device.type != "mps" else given)
        given = _convert(given, values)
        at, of_node = (alike(each, values) for each in self._pairs)
        C, D, single = shape[-1], values.shape[1], len(shape) == 2 and self.points.ndim == 2
        given = given[None] if len(shape) == 2 else given
        if B > 1:  # a field for each of the batch
            flat = namespace(values).broadcast_to(given, (B, self.K, C)).reshape(-1, C)
            products = flat[of_node][:, :, None] * values[:, None]
            found = sums(products.reshape(len(at), len(flat[0]) * D), at, self.reached.size).reshape(B, -1, C, D)
        else:  # one field for all
            flat = given.swapaxes(0, 1).reshape(self.K, -1)
            products = flat[of_node][:, :, None] * values[:, None]
            found = sums(products.reshape(len(at), len(flat[0]) * D), at, self.reached.size)
            found = found.reshape(-1, len(given), C, D).swapaxes(0, 1)
        return _cast(found[0] if single else found, kind)


@dataclass(frozen=True, eq=False)
class NearestNodes:
    """Shape functions of points out of reach: nearest nodes, weighted by 1 / d^2, as N pairs sorted by point."""

    at: Any  # (N,) index of the point
    of_node: Any  # (N,) index of the node
    offset: Any  # (N, 3) from the node to the point
    weight: Any  # (N,)
    P: int

    @classmethod
    def of(cls, points: Any, nodes: Any, radii: Any, pairs: tuple[Ints, Ints]) -> NearestNodes:
        at, of_node = (alike(each, points) for each in pairs)
        offset = points[at] - nodes[of_node]
        return cls(at, of_node, offset, 1 / ((offset**2).sum(1) + (_SOFTENING * radii[of_node]) ** 2), len(points))

    def _total(self, values: Any) -> Any:
        """Sums over the nodes of a point, repeated at each of its pairs."""
        columns = int(np.prod(values.shape[1:]))
        return sums(values.reshape(len(self.at), columns), self.at, self.P)[self.at].reshape(values.shape)

    @property
    def values(self) -> Any:
        return self.weight / self._total(self.weight)

    @property
    def gradient(self) -> Any:
        weight_gradient = -2 * (self.weight**2)[:, None] * self.offset  # dw/dx
        return (weight_gradient - self.values[:, None] * self._total(weight_gradient)) / self._total(self.weight)[
            :, None
        ]

    @property
    def second_derivative(self) -> Any:
        w, o = self.weight[:, None, None], self.offset
        weight_hessian = 8 * w**3 * o[:, :, None] * o[:, None] - 2 * w**2 * alike(np.eye(3), o)
        total = self._total(-2 * (self.weight**2)[:, None] * o)
        mixed = self.gradient[:, :, None] * total[:, None]
        change = (
            weight_hessian - mixed - mixed.swapaxes(1, 2) - self.values[:, None, None] * self._total(weight_hessian)
        )
        return change / self._total(self.weight)[:, None, None]


def node_field(
    points: Any, nodes: Any, radius: Any, *, kernel: Kernel = "smooth", outside: Outside = "error"
) -> NodeField:
    """Build the deformation field of moving least squares for given nodes and points.

    At each point it is the affine motion that best fits the vectors of the nodes in reach; it reproduces affine motions
    exactly. Computed in float64. If points, nodes or radii are torch tensors, results are differentiable with respect to
    them by ``torch.autograd``; the set of nodes that reach a point is treated as constant. Transforms of ``torch.func``,
    such as ``vmap`` and ``jacrev``, apply to functions of the vectors on a field that was made outside.

    Parameters
    ----------
    points
        (P, 3) or (B, P, 3).
    nodes
        (K, 3) or (B, K, 3), in the frame and unit of the points.
    radius
        Support radius of the nodes: one number, or (K,) one for each.
    kernel
        "smooth", (1 - d^2 / r^2)^3, or "cubic", (1 - d / r)^3, whose second derivatives have no limit at a node.
    outside
        Treatment of points without four non-coplanar nodes in reach: "error"; "mask", they are not moved and not
        ``reached``; or "nearest", they follow the mean of the four nearest nodes, weighted by 1 / d^2, which reproduces
        translations, and is discontinuous where the reach of the nodes ends.

    Returns
    -------
    NodeField
        The field on the points.

    Raises
    ------
    TemplateError
        Points are out of reach, and ``outside`` is "error".
    InputError
        Points, nodes or radii are not finite numbers of these shapes.
    OptionError
        ``kernel`` or ``outside`` is unknown.

    Warns
    -----
    MeshmatchWarning
        Nodes are placed so badly that errors of their vectors can grow more than fifty times, see `NodeField.lebesgue`.

    Examples
    --------
    >>> from meshmatch.fields import node_field
    >>> nodes = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    >>> field = node_field(nodes[:50] / 2, nodes, radius=0.8)
    >>> field.moved(0.1 * nodes), field.deformation_gradient(0.1 * nodes), field.lebesgue.max()
    """
    check_kernel(kernel)
    if outside not in get_args(Outside):
        raise OptionError(f"unknown choice {outside!r} for points outside", f"choose {', '.join(get_args(Outside))}")
    like: Any = next((each for each in (points, nodes, radius) if is_tensor(each)), np.empty(0))
    if is_tensor(like):
        like = like.detach().float() if like.device.type == "mps" else like.detach().double()
    x, q = _positions(points, "points", like), _positions(nodes, "nodes", like)
    K = int(q.shape[-2])
    checked_radii(radius, K)
    r = _convert(radius if is_tensor(radius) else np.asarray(radius, np.float64), like)
    batches = {len(each) for each in (x, q) if each.ndim == 3}
    if len(batches) > 1:
        raise InputError(
            f"points are a batch of {len(x)} and nodes one of {len(q)}", "give as many of both, or one batch"
        )
    B, xp = next(iter(batches), 1), namespace(x)
    shown = _cast(x if x.ndim == 3 or not batches else xp.broadcast_to(x, (B, *x.shape)), _precision([points], x))
    P = int(x.shape[-2])
    flat, flat_q = xp.broadcast_to(x, (B, P, 3)).reshape(-1, 3), xp.broadcast_to(q, (B, K, 3)).reshape(-1, 3)
    flat_r = xp.broadcast_to(r, (B, K)).reshape(-1)
    rows = np.arange(B * P)
    out = np.zeros(0, np.int64)
    pieces: list[tuple[Ints, LocalFits | NearestNodes]] = []
    blocks = [(slice(b * P, b * P + P), slice(b * K, b * K + K)) for b in range(B)]
    px, pq, pr = (plain(each).astype(np.float64) for each in (flat, flat_q, flat_r))
    if outside != "error":
        bad = [
            b * P + poorly_supported(px[i], pq[k], pr[k], kernel, _SUPPORT_MARGIN) for b, (i, k) in enumerate(blocks)
        ]
        out = np.concatenate(bad)
        rows = np.setdiff1d(rows, out)
    if len(rows):
        pairs = [support_pairs(px[i], pq[k], pr[k]) for i, k in blocks]
        at = np.concatenate([i.start + pair[0] for (i, _), pair in zip(blocks, pairs, strict=True)])
        of_node = np.concatenate([k.start + pair[1] for (_, k), pair in zip(blocks, pairs, strict=True)])
        here = np.searchsorted(rows, at).clip(max=len(rows) - 1)
        kept = rows[here] == at
        pieces.append(
            (rows, LocalFits.of(flat[alike(rows, flat)], flat_q, flat_r, kernel, (here[kept], of_node[kept])))
        )
    if outside == "nearest" and len(out):
        near = np.concatenate([
            k.start + cKDTree(pq[k]).query(px[out[out // P == b]], range(1, min(_N_NEAREST, K) + 1))[1].astype(np.int64)
            for b, (_, k) in enumerate(blocks)
        ])  # fmt: skip
        pairs_out = np.repeat(np.arange(len(out)), near.shape[1]), near.ravel()
        pieces.append((out, NearestNodes.of(flat[alike(out, flat)], flat_q, flat_r, pairs_out)))
    reached = np.ones(B * P, bool)
    reached[out] = False
    if not pieces:  # all are masked
        no_pairs = np.zeros(0, np.int64), np.zeros(0, np.int64)
        pieces.append((out, NearestNodes.of(flat, flat_q, flat_r, no_pairs)))
    made = NodeField(shown, K, reached.reshape(shown.shape[:-1]), tuple(pieces))
    warn_amplification(made.lebesgue.ravel())
    return made


def _positions(values: Any, what: str, like: Any) -> Any:
    """Positions (N, 3) or (B, N, 3) in the type of `like`; `InputError` if they are not finite numbers of this shape."""
    try:
        found = as_numbers(values, what, finite=True)
    except InputError as error:
        if is_tensor(values) and "storage" in error.message:  # inside a transform, a tensor has no values
            raise InputError(f"{what} cannot be read inside a transform of torch.func", _USE_AUTOGRAD) from error
        raise
    if found.ndim not in (2, 3) or found.shape[-1] != 3 or 0 in found.shape:
        raise InputError(
            f"{what} must be an array of (N, 3) or (B, N, 3), not {found.shape}", "one position in each row"
        )
    if not abs(found).max() < LARGEST:
        raise InputError(f"{what} are too far away", "measure them in another unit")
    return _convert(values if is_tensor(values) else np.array(found), like)


def _convert(array: Any, like: Any) -> Any:
    """Convert an array or tensor to the type, device and precision of `like`."""
    if is_tensor(array) and is_tensor(like):
        return array.to(like.device, like.dtype)
    return alike(plain(array), like) if is_tensor(like) else np.asarray(plain(array), like.dtype)


def _precision(arrays: Sequence[Any], like: Any) -> Any:
    """Result dtype of arrays and tensors, at least float32: one of torch if `like` is a tensor, otherwise of NumPy."""
    if not is_tensor(like):
        kinds = [np.asarray(each).dtype for each in arrays]
        return np.result_type(*(kind if kind.kind == "f" else np.float64 for kind in kinds), np.float32)
    import torch

    kind = torch.float32
    for each in arrays:
        small = not is_tensor(each) and np.asarray(each).dtype in (np.float16, np.float32)
        other = each.dtype if is_tensor(each) else torch.float32 if small else torch.float64
        kind = torch.promote_types(kind, other)
    return kind


def _cast(array: Any, kind: Any) -> Any:
    return array.to(kind) if is_tensor(array) else array.astype(kind, copy=False)


def _concatenate(parts: list[Any]) -> Any:
    return parts[0] if len(parts) == 1 else namespace(parts[0]).concatenate(parts)


def _check_three(C: int) -> None:
    if C != 3:
        raise InputError(
            f"vectors that move points have 3 components, not {C}", "displacement and gradient take others"
        )
