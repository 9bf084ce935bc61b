"""A template from one shape: two resolutions, control nodes, labels.

Nodes are chosen among candidates in the volume near the surface, by a rejection rule and farthest points. Rejection
keeps a node from moving two pieces of surface that are close in space but not along the body (two thighs, an arm and a
flank). Four rules, all measured by the paper: body ``parts``, ``spectral`` clusters, ``geodesic`` distance, and
``uniform`` (no rejection).
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
from meshmatch.shapes.decimate import Quality, decimate
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import Samples, farthest_points, sample_surface, triangulate_cloud
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

LOW_FACES = 10_000
Strategy = Literal["parts", "spectral", "geodesic", "uniform"]
STRATEGIES: tuple[Strategy, ...] = get_args(Strategy)
# Of the diameter along the surface: how far apart what one node moves may be. Where parts lie so close that a vertex
# is left without nodes, the next share is tried. Set by hand.
_GEODESIC_SHARES = (0.2, 0.3, 0.45, 1.0)
_FUNCTIONS = 4  # eigenvectors that tell clusters apart, as in the paper
_GROWN, _GROWTH, _MAX_GROWTHS = (
    6,
    1.05,
    15,
)  # nodes that grow around a vertex, by how much at a time, how often: twofold
_MAX_PAIRED = 8000  # vertices, evenly spread, whose pairs the geodesic rule looks at


@dataclass(frozen=True)
class NodeConfig:
    """How nodes are chosen. Lengths in units of sqrt(surface area).

    radius 0.13 is 0.2 of half a standing body's height (0.65), about the radius of a sphere around it. The paper's 0.2 is of
    the diameter, as its captions read: 0.27 to 0.29, by pose. Candidates lie up to ``depth`` below the surface;
    ``spectral`` begins with so many ``clusters``. ``grow``: vertices that lack nodes widen those around them (the
    supplement's other way, section 3.3) instead of getting more, or a milder strategy. `OptionError` for an unknown
    strategy, fewer than 4 nodes, or a length or count that is not positive.
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
        if self.K < 4:
            raise OptionError(f"{self.K} nodes are too few", "moving least squares needs at least 4")
        if not 0 < self.radius < np.inf:
            raise OptionError(f"a node radius must be positive, not {self.radius:g}", "0.13 suits a body")
        if not 0 <= self.depth < np.inf:
            raise OptionError(f"a depth of candidates must be 0 or more, not {self.depth:g}")
        if self.clusters < 1:
            raise OptionError(f"at least one cluster is needed, not {self.clusters}")


def low_mesh(
    shape: Shape, faces: int = LOW_FACES, quality: Quality = "fast"
) -> tuple[Int[Ints, " V"], Int[Ints, "F 3"]]:
    """Decimate onto some of the shape's own vertices, or triangulate a cloud: kept indices, by which all that belongs
    to vertices is kept too, and faces.
    """
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
    """The vertex of a shape that is nearest to each one of the decimated shape, of the same connected part: the walls of
    two chambers that touch must not become one."""
    nearest = np.asarray(cKDTree(shape.verts).query(small.verts)[1], np.int64)
    own, parts = shape.vertex_parts, small.vertex_parts
    if own.max() == 0:
        return nearest
    (part, meant), votes = np.unique(np.stack([parts, own[nearest]]), axis=1, return_counts=True)
    order, most = np.argsort(votes, kind="stable"), np.zeros(parts.max() + 1, np.int64)
    most[part[order]] = meant[order]  # the last one, which has most votes, stays
    away = 2 * shape.diagonal
    tree = cKDTree(np.column_stack([shape.verts, away * own]))
    return np.asarray(tree.query(np.column_stack([small.verts, away * most[parts]]))[1], np.int64)


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
    """Template bundle of a shape of the resting category, in any unit.

    A mesh becomes the dense mesh, a cloud is triangulated. `labels` are the part of every vertex (a single part where
    not given), `core` are vertices that fix the category's frame (all where not given), and `low` is a low resolution
    made before (see `low_mesh`). `TemplateError` if nodes cannot support every vertex; `InputError` if a cloud's points
    lie on no surface.
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
    laid = lay_nodes(small, config, None if labels is None else parts[keep], noisy=shape.is_cloud)
    words = tuple(label_names) or tuple(f"part {n}" for n in range(int(parts.max()) + 1))
    core = np.flatnonzero(in_core[keep])
    return Template(name, small, dense, laid.nodes, laid.radius, parts[keep], words, core)


@dataclass(frozen=True, eq=False)
class Laid:
    """Nodes, their support radius (one, or each its own), and which share of the candidates the strategy refuses."""

    nodes: Float[Floats, "K 3"]
    radius: float | Float[Floats, " K"]
    refused: float
    taken: float  # the same of the rule that was taken: a milder one, where vertices went without nodes


def choose_nodes(
    shape: Shape, config: NodeConfig, labels: Int[Ints, " V"] | None = None, noisy: bool = False
) -> Float[Floats, "K 3"]:
    """The nodes of `lay_nodes`."""
    return lay_nodes(shape, config, labels, noisy).nodes


def lay_nodes(shape: Shape, config: NodeConfig, labels: Int[Ints, " V"] | None = None, noisy: bool = False) -> Laid:
    """Nodes such that every vertex of a mesh in the template frame has four non-coplanar ones in reach: ``config.K`` (with
    ``config.grow`` exactly, if there are as many candidates), or more where vertices that farthest points leave short
    need them.

    Strategy ``parts`` needs `labels`, the body parts. `noisy` candidates are the surface's points plus Gaussian noise of
    ``config.depth``, as suits the mesh of a cloud, whose inside is uncertain. `TemplateError` names the vertices that
    cannot be supported.
    """
    if config.strategy == "parts" and labels is None and not shape.is_cloud:
        raise OptionError("node strategy 'parts' needs part labels", "use --strategy spectral or geodesic")
    samples, candidates = _candidates(shape, config, noisy)
    failure: TemplateError | None = None
    refused: float | None = None
    for allowed in _allowed(shape, config, candidates, labels, samples):
        chosen = candidates[allowed]
        taken = 1 - float(allowed.mean())
        refused = taken if refused is None else refused  # by the strategy itself; what follows are milder ones
        if len(chosen) < 4:
            problem = f"strategy {config.strategy!r} rejects all nodes: each moves vertices that do not belong together"
            failure = TemplateError(problem, "use a smaller radius or another strategy")
            continue
        nodes = chosen[farthest_points(chosen, min(config.K, len(chosen)))]
        try:
            if config.grow:
                return Laid(nodes, grown_radii(shape.verts, nodes, config.radius), refused, taken)
            return Laid(_complete(shape, config, nodes, chosen), config.radius, refused, taken)
        except TemplateError as error:
            failure = error
    assert failure is not None
    raise failure


def judged(
    shape: Shape, config: NodeConfig, labels: Int[Ints, " V"] | None = None
) -> tuple[Float[Floats, "N 3"], Int[Ints, " N"], Bool[Bools, " N"]]:
    """Where nodes of a mesh may be, the vertex that each place is next to, and which places the strategy itself keeps."""
    samples, candidates = _candidates(shape, config, noisy=False)
    own = shape.faces[samples.face, samples.barycentric.argmax(1)]
    return candidates, own, next(_allowed(shape, config, candidates, labels, samples))


def _candidates(shape: Shape, config: NodeConfig, noisy: bool) -> tuple[Samples, Float[Floats, "N 3"]]:
    """Samples of the surface, and where nodes may be: below them, or around them."""
    rng = np.random.default_rng(config.seed)
    samples = sample_surface(shape, 30 * config.K, rng)
    if noisy:
        return samples, samples.points + config.depth * rng.standard_normal(samples.points.shape)
    return samples, samples.points - samples.normals * rng.uniform(0, config.depth, (len(samples.points), 1))


def grown_radii(
    points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radius: float
) -> float | Float[Floats, " K"]:
    """Radii that begin at ``radius``, of which those of the nodes nearest to points without four non-coplanar nodes in
    reach grow until there are none, at most twofold; one number where none has to. `TemplateError` where that is too little.
    """
    radii = np.full(len(nodes), radius)
    around = cKDTree(nodes)
    for _ in range(_MAX_GROWTHS):
        bad = poorly_supported(points, nodes, radii)
        if not len(bad):
            return radius if radii.max() == radius else radii
        near = np.unique(around.query(points[bad], k=min(_GROWN, len(nodes)))[1])
        radii[near] *= _GROWTH
    problem = f"{len(bad)} vertices have fewer than four non-coplanar nodes within twice {radius:g}"
    raise TemplateError(problem, "use more nodes, a larger radius or another strategy")


def _complete(
    shape: Shape, config: NodeConfig, nodes: Float[Floats, "K 3"], candidates: Float[Floats, "N 3"]
) -> Float[Floats, "K2 3"]:
    """Add the candidates that poorly supported vertices lack, nearest first, a few rounds."""
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
    """Which candidates a strategy keeps; then those of milder rules, where narrow clusters (fingers, ears) keep none."""
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
        if shape.vertex_parts.max() > 0:  # parts that touch everywhere, as the chambers of a heart do, move together
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
    """Drop candidates that touch a part which does not border on their own."""
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
    """Drop candidates that touch two vertices further apart than a share of the diameter, both along the surface."""
    some, near = _near_pairs(shape, share)
    tree, allowed = cKDTree(shape.verts[some]), np.zeros(len(candidates), bool)
    for k, place in enumerate(candidates):  # one by one, for what wide nodes touch is long
        hits = tree.query_ball_point(place, radius)
        allowed[k] = np.unpackbits(np.bitwise_and.reduce(near[hits], axis=0))[hits].all()
    return allowed


@derived
def _near_pairs(shape: Shape, share: float) -> tuple[Int[Ints, " S"], UInt8[UInts8, "S bytes"]]:
    """Vertices spread over a shape, and which of them lie within a share of the diameter, along the surface: as bits."""
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
    """Labels from 0, at most ``clusters`` and none without a vertex: k-means on the global point signature (Rustamov
    2007) of Laplace-Beltrami eigenvectors.
    """
    stiffness, mass = robust_laplacian.mesh_laplacian(shape.verts, shape.faces)
    count = min(_FUNCTIONS + 1, shape.V - 2)
    # Not a constant start: that is an eigenvector already, and the search would go on from a random one.
    values, vectors = eigsh(stiffness, count, mass, sigma=-1e-8, v0=rng.standard_normal(shape.V))
    signature = vectors[:, 1:] / np.sqrt(np.maximum(values[1:], 1e-9))
    centers = signature[farthest_points(signature, min(clusters, shape.V))]
    for _ in range(20):
        label = cKDTree(centers).query(signature)[1]
        for axis in range(signature.shape[1]):
            total = np.bincount(label, signature[:, axis], len(centers))
            centers[:, axis] = total / np.maximum(np.bincount(label, minlength=len(centers)), 1)
    return np.unique(cKDTree(centers).query(signature)[1], return_inverse=True)[1].astype(np.int64)
