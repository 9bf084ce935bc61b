"""Make a template from one shape: two resolutions, control nodes, labels.

Nodes are chosen from candidates in the volume near the surface, by rejection and farthest point sampling. Rejection
prevents a node from moving two pieces of surface that are close in space but not along the surface (two thighs, an arm
and a flank). There are four rejection rules, all evaluated in the paper: body ``parts``, ``spectral`` clusters,
``geodesic`` distance, and ``uniform`` (no rejection).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import robust_laplacian
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import eigsh

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, UInt8, UInts8
from meshmatch.derived import derived
from meshmatch.errors import OptionError, TemplateError
from meshmatch.geometry.kernels import poorly_supported
from meshmatch.geometry.trees import cKDTree
from meshmatch.scalars import check_seed, is_integer
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.decimate import Quality, decimate
from meshmatch.shapes.sampling import Samples, farthest_points, sample_surface, triangulate_cloud
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

LOW_FACES = 10_000
Strategy = Literal["parts", "spectral", "geodesic", "uniform"]
STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)
# Maximum geodesic distance between two vertices that one node moves, as shares of the geodesic diameter. If parts are so
# close that a vertex gets no nodes, the next share is tried. Set by hand.
_GEODESIC_SHARES = (0.2, 0.3, 0.45, 1.0)
_MAX_RADIUS = 1000.0  # of a node, in units of sqrt(area); squares of huge ones overflow
_N_EIGENVECTORS = 4  # eigenvectors used for spectral clusters, as in the paper
# nodes around a vertex whose radii grow, factor per step, maximum number of steps (twofold in all)
_N_GROWING, _GROWTH_FACTOR, _MAX_GROWTH_STEPS = 6, 1.05, 15
_MAX_PAIRED = 8000  # vertices, evenly spread, whose pairs the geodesic rule examines


@dataclass(frozen=True)
class NodeConfig:
    """How nodes are chosen. Lengths in units of sqrt(surface area).

    ``radius`` 0.13 is 0.2 times half a standing body's height (0.65), about the radius of its bounding sphere. According to
    its captions, the paper's 0.2 is relative to the diameter, which makes 0.27 to 0.29, depending on the pose. Candidates
    lie up to ``depth`` below the surface; ``clusters`` is the initial number for ``spectral``. With ``grow``, where
    vertices lack nodes, the radii of the nodes around are increased (the supplement's alternative, section 3.3), instead
    of adding nodes or relaxing the strategy. `OptionError` for an unknown strategy, fewer than 4 nodes, or a length or
    count that is not positive.
    """

    strategy: Strategy = "parts"
    K: int = 320
    radius: float = 0.13
    depth: float = 0.03
    clusters: int = 24
    seed: int = 0
    grow: bool = False

    def __post_init__(self) -> None:
        if self.strategy not in STRATEGIES:
            raise OptionError(f"unknown node strategy {self.strategy!r}", f"choose one of {', '.join(STRATEGIES)}")
        if not is_integer(self.K, 4):
            raise OptionError(
                f"K must be an integer of 4 or more, not {self.K!r}", "moving least squares needs at least 4"
            )
        if not 0 < self.radius <= _MAX_RADIUS:
            raise OptionError(
                f"a node radius must lie above 0 and at most {_MAX_RADIUS:g}, not {self.radius:g}", "0.13 suits a body"
            )
        if not 0 <= self.depth < np.inf:
            raise OptionError(f"a depth of candidates must be 0 or more, not {self.depth:g}")
        if not is_integer(self.clusters, 1):
            raise OptionError(f"at least one cluster is needed, not {self.clusters!r}")
        check_seed(self.seed)


def low_mesh(
    shape: Shape, faces: int = LOW_FACES, quality: Quality = "fast"
) -> tuple[Int[Ints, " V"], Int[Ints, "F 3"]]:
    """Decimate a mesh to a subset of its vertices, or triangulate a cloud; returns which vertices are kept, and faces."""
    if shape.is_cloud:
        return triangulate_cloud(shape, faces)
    if shape.F <= faces:
        return np.arange(shape.V), np.asarray(shape.faces)
    small = decimate(shape, faces, quality)
    keep, renumbered = np.unique(_own_vertices(small, shape), return_inverse=True)
    corners = renumbered.reshape(-1)[small.faces]
    a, b, c = corners.T
    return keep, corners[(a != b) & (b != c) & (c != a)]


def _own_vertices(small: Shape, shape: Shape) -> Int[Ints, " V"]:
    """Nearest vertex of a shape for each vertex of the decimated shape, within the same connected part.

    Otherwise touching walls of two chambers could be merged.
    """
    nearest = np.asarray(cKDTree(shape.verts).query(small.verts)[1], np.int64)
    shape_parts, parts = shape.vertex_parts, small.vertex_parts
    if shape_parts.max() == 0:
        return nearest
    (part, shape_part), votes = np.unique(np.stack([parts, shape_parts[nearest]]), axis=1, return_counts=True)
    order, matched_part = np.argsort(votes, kind="stable"), np.zeros(parts.max() + 1, np.int64)
    matched_part[part[order]] = shape_part[order]  # the last one, with most votes, wins
    separation = 2 * shape.diagonal
    tree = cKDTree(np.column_stack([shape.verts, separation * shape_parts]))
    return np.asarray(tree.query(np.column_stack([small.verts, separation * matched_part[parts]]))[1], np.int64)


def make_template(
    shape: Shape,
    name: str,
    config: NodeConfig,
    *,
    labels: Int[Ints, " V"] | None = None,
    label_names: Sequence[str] = (),
    core: Int[Ints, " C"] | None = None,
    low: tuple[Int[Ints, " V_low"], Int[Ints, "F_low 3"]] | None = None,
) -> Template:
    """Make a template bundle from a shape in the rest pose, in any unit.

    A mesh becomes the dense mesh; a cloud is triangulated. `labels` are the parts of the vertices (default: one part),
    `core` are vertices that define the category's frame (default: all), and `low` is a precomputed low resolution (see
    `low_mesh`). `TemplateError` if nodes cannot support every vertex; `InputError` if a cloud's points lie on no surface.
    """
    keep, faces = low_mesh(shape) if low is None else low
    small = Shape(shape.verts[keep], faces, name)
    frame = sqrt_area_frame(small)
    small = Shape(frame.apply(small.verts), faces, name)
    parts = np.zeros(shape.V, np.int64) if labels is None else np.asarray(labels, np.int64)
    if parts.shape != (shape.V,):
        raise TemplateError(f"{len(parts)} labels for {shape.V} vertices of {shape.name}", "one label a vertex, from 0")
    if parts.min() < 0:
        raise TemplateError(f"{shape.name} has a label below 0: {parts.min()}", "count parts from 0")
    in_core = np.ones(shape.V, bool) if core is None else np.isin(np.arange(shape.V), core)
    dense = small if shape.is_cloud else Shape(frame.apply(shape.verts), shape.faces, name)
    placement = place_nodes(small, config, None if labels is None else parts[keep], noisy=shape.is_cloud)
    names = tuple(label_names) or tuple(f"part {n}" for n in range(int(parts.max()) + 1))
    core = np.flatnonzero(in_core[keep])
    return Template(name, small, dense, placement.nodes, placement.radius, parts[keep], names, core)


@dataclass(frozen=True, eq=False)
class NodePlacement:
    """Nodes, their support radius (one, or one for each), and the share of candidates that was rejected."""

    nodes: Float[Floats, "K 3"]
    radius: float | Float[Floats, " K"]
    refused: float  # share of the candidates that the strategy rejects
    taken: float  # share that the rule in use rejects, which is milder if the strategy left vertices without nodes


def choose_nodes(
    shape: Shape, config: NodeConfig, labels: Int[Ints, " V"] | None = None, noisy: bool = False
) -> Float[Floats, "K 3"]:
    """Return the nodes of `place_nodes`."""
    return place_nodes(shape, config, labels, noisy).nodes


def place_nodes(
    shape: Shape, config: NodeConfig, labels: Int[Ints, " V"] | None = None, noisy: bool = False
) -> NodePlacement:
    """Place nodes such that every vertex of a mesh in the template frame has four non-coplanar ones in reach.

    There are ``config.K`` nodes (exactly, with ``config.grow``, if there are as many candidates), and more where farthest
    points do not support all vertices. Strategy ``parts`` needs `labels`, the body parts. With `noisy`, candidates are
    points of the surface plus Gaussian noise of ``config.depth``; this is for meshes of clouds, whose inside is uncertain.
    `TemplateError` names the vertices that cannot be supported.
    """
    if config.strategy == "parts" and labels is None and not shape.is_cloud:
        raise OptionError("node strategy 'parts' needs part labels", "use --strategy spectral or geodesic")
    samples, candidates = _candidates(shape, config, noisy)
    failure: TemplateError | None = None
    refused: float | None = None
    for allowed in _allowed(shape, config, candidates, labels, samples):
        chosen = candidates[allowed]
        rejected = 1 - float(allowed.mean())
        refused = rejected if refused is None else refused  # by the strategy itself; the following rules are milder
        if len(chosen) < 4:
            problem = f"strategy {config.strategy!r} rejects all nodes: each moves vertices that do not belong together"
            failure = TemplateError(problem, "use a smaller radius or another strategy")
            continue
        nodes = chosen[farthest_points(chosen, min(config.K, len(chosen)))]
        try:
            if config.grow:
                return NodePlacement(nodes, grow_radii(shape.verts, nodes, config.radius), refused, rejected)
            return NodePlacement(_add_missing_nodes(shape, config, nodes, chosen), config.radius, refused, rejected)
        except TemplateError as error:
            failure = error
    assert failure is not None
    raise failure


def judged(
    shape: Shape, config: NodeConfig, labels: Int[Ints, " V"] | None = None
) -> tuple[Float[Floats, "N 3"], Int[Ints, " N"], Bool[Bools, " N"]]:
    """Candidates for nodes of a mesh, the nearest vertex of each, and which candidates the strategy itself keeps."""
    samples, candidates = _candidates(shape, config, noisy=False)
    own = shape.faces[samples.face, samples.barycentric.argmax(1)]
    return candidates, own, next(_allowed(shape, config, candidates, labels, samples))


def _candidates(shape: Shape, config: NodeConfig, noisy: bool) -> tuple[Samples, Float[Floats, "N 3"]]:
    """Samples of the surface, and candidates for nodes: below the samples, or around them if noisy."""
    rng = np.random.default_rng(config.seed)
    samples = sample_surface(shape, 30 * config.K, rng)
    if noisy:
        return samples, samples.points + config.depth * rng.standard_normal(samples.points.shape)
    return samples, samples.points - samples.normals * rng.uniform(0, config.depth, (len(samples.points), 1))


def grow_radii(points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radius: float) -> float | Float[Floats, " K"]:
    """Grow radii of nodes, from ``radius`` to at most twice that, until all points have four non-coplanar nodes in reach.

    Only radii of the nodes nearest to unsupported points grow; if none has to, the result is one number. `TemplateError` if
    points remain unsupported.
    """
    radii = np.full(len(nodes), radius)
    around = cKDTree(nodes)
    for _ in range(_MAX_GROWTH_STEPS):
        bad = poorly_supported(points, nodes, radii)
        if not len(bad):
            return radius if radii.max() == radius else radii
        near = np.unique(around.query(points[bad], k=min(_N_GROWING, len(nodes)))[1])
        radii[near] *= _GROWTH_FACTOR
    problem = f"{len(bad)} vertices have fewer than four non-coplanar nodes within twice {radius:g}"
    raise TemplateError(problem, "use more nodes, a larger radius or another strategy")


def _add_missing_nodes(
    shape: Shape, config: NodeConfig, nodes: Float[Floats, "K 3"], candidates: Float[Floats, "N 3"]
) -> Float[Floats, "K2 3"]:
    """Add candidates near poorly supported vertices, in a few rounds."""
    for _ in range(20):
        bad = poorly_supported(shape.verts, nodes, config.radius)
        if not len(bad):
            return nodes
        extra = candidates[cKDTree(candidates).query(shape.verts[bad], k=min(40, len(candidates)))[1].reshape(-1)]
        spread = farthest_points(np.concatenate([nodes, extra]), min(len(nodes) + 8, len(nodes) + len(extra)))
        fresh = spread[spread >= len(nodes)] - len(nodes)
        if not len(fresh):
            fresh = np.arange(min(8, len(extra)))
        nodes = np.concatenate([nodes, extra[fresh]])
    some = ", ".join(str(index) for index in bad[:5].tolist()) + (", ..." if len(bad) > 5 else "")
    problem = f"{len(bad)} vertices have fewer than four non-coplanar nodes within {config.radius:g} (vertices {some})"
    raise TemplateError(problem, "use more nodes, a larger radius or another strategy")


def _allowed(
    shape: Shape, config: NodeConfig, candidates: Float[Floats, "N 3"], labels: Int[Ints, " V"] | None, samples: Samples
) -> Iterator[Bool[Bools, " N"]]:
    """Yield which candidates a strategy keeps; then those of milder rules, in case narrow parts (fingers, ears) get none."""
    if config.strategy == "uniform" or shape.is_cloud:
        yield np.ones(len(candidates), bool)
        return
    own = shape.faces[samples.face, samples.barycentric.argmax(1)]
    if config.strategy == "parts":
        assert labels is not None
        yield _parts_allowed(shape, labels, candidates, own, config.radius)
    elif config.strategy == "geodesic":
        for share in _GEODESIC_SHARES:
            yield _geodesic_allowed(shape, config.radius, candidates, share)
        if shape.vertex_parts.max() > 0:  # parts that touch everywhere, such as chambers of a heart, move together
            yield np.ones(len(candidates), bool)
    else:
        clusters = config.clusters
        while True:
            parts = spectral_clusters(shape, clusters, np.random.default_rng(config.seed))
            yield _parts_allowed(shape, parts, candidates, own, config.radius)
            if clusters <= 2:
                return
            clusters = clusters * 4 // 5


def _parts_allowed(
    shape: Shape, parts: Int[Ints, " V"], candidates: Float[Floats, "N 3"], own: Int[Ints, " N"], radius: float
) -> Bool[Bools, " N"]:
    """Reject candidates that reach a part not adjacent to their own."""
    count = int(parts.max()) + 1
    joined = np.eye(count, dtype=bool)
    joined[parts[shape.faces], parts[shape.faces[:, [1, 2, 0]]]] = True
    joined |= joined.T
    allowed = np.ones(len(candidates), bool)
    for part in np.unique(parts).tolist():
        foreign = np.flatnonzero(~joined[parts[own], part])
        nearest = cKDTree(shape.verts[parts == part]).query(candidates[foreign])[0]
        allowed[foreign[nearest <= radius]] = False
    return allowed


def _geodesic_allowed(shape: Shape, radius: float, candidates: Float[Floats, "N 3"], share: float) -> Bool[Bools, " N"]:
    """Reject candidates that reach two vertices whose geodesic distance exceeds a share of the geodesic diameter."""
    some, near = _near_pairs(shape, share)
    tree, allowed = cKDTree(shape.verts[some]), np.zeros(len(candidates), bool)
    for k, place in enumerate(candidates):  # one by one: wide nodes reach many vertices
        hits = tree.query_ball_point(place, radius)
        allowed[k] = np.unpackbits(np.bitwise_and.reduce(near[hits], axis=0))[hits].all()
    return allowed


@derived
def _near_pairs(shape: Shape, share: float) -> tuple[Int[Ints, " S"], UInt8[UInts8, "S bytes"]]:
    """Vertices spread over a shape, and as bits which pairs lie within a share of the geodesic diameter."""
    graph = edge_graph(shape)
    some = farthest_points(shape.verts, min(shape.V, _MAX_PAIRED))
    far = dijkstra(graph, indices=some[:40])
    limit = share * far[np.isfinite(far)].max()
    blocks = (dijkstra(graph, indices=some[at : at + 200], limit=limit) for at in range(0, len(some), 200))
    return some, np.concatenate([np.packbits(np.isfinite(block[:, some]), axis=1) for block in blocks])


def edge_graph(shape: Shape) -> csr_matrix:
    """Symmetric sparse graph (V, V) of edge lengths."""
    edges = shape.edges.vertices
    length = np.maximum(np.linalg.norm(shape.verts[edges[:, 0]] - shape.verts[edges[:, 1]], axis=1), 1e-12)
    places = edges.T.reshape(-1), edges[:, ::-1].T.reshape(-1)
    return coo_matrix((np.tile(length, 2), places), (shape.V, shape.V)).tocsr()


def spectral_clusters(shape: Shape, clusters: int, rng: np.random.Generator) -> Int[Ints, " V"]:
    """Cluster vertices by k-means on the global point signature (Rustamov 2007) of Laplace-Beltrami eigenvectors.

    Labels count from 0; there are at most ``clusters``, each with at least one vertex.
    """
    stiffness, mass = robust_laplacian.mesh_laplacian(shape.verts, shape.faces)
    count = min(_N_EIGENVECTORS + 1, shape.V - 2)
    # A constant start is an eigenvector already, after which ARPACK would continue from a random one.
    values, vectors = eigsh(stiffness, count, mass, sigma=-1e-8, v0=rng.standard_normal(shape.V))
    signature = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-9))
    centers = signature[farthest_points(signature, min(clusters, shape.V))]
    for _ in range(20):
        label = cKDTree(centers).query(signature)[1]
        for axis in range(signature.shape[1]):
            total = np.bincount(label, signature[:, axis], len(centers))
            centers[:, axis] = total / np.maximum(np.bincount(label, minlength=len(centers)), 1)
    return np.unique(cKDTree(centers).query(signature)[1], return_inverse=True)[1].astype(np.int64)
