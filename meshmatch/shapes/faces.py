"""Faces of a mesh: duplicate and degenerate ones, outlier parts, and consistent orientation.

`agreeing_flips` makes orientations consistent between neighbours, of faces as well as of normals of a cloud.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry import triangles
from meshmatch.geometry.triangles import Edges, component_minima, edge_keys, normalized, same_rows, squared_lengths

OUTLIER_SHARE = 0.02
"""A part with less than this share of the largest part's area is an outlier. All constants here are set by hand."""
_MIN_FAR_GAP = 0.25  # minimum gap between big parts that are far apart, in diagonals of the largest
# minimum length of a sheet's mean normal: 0.5 for half a sphere, 0.64 for half a cylinder, 0.9 for leaves
_MIN_SHEET_NORMAL = 0.8
_DEGENERATE_LENGTH = 1e-9  # maximum length of a degenerate edge, as a fraction of the median edge
# Vertices needed to detect spikes, and faces of other parts to detect hulls and grounds; quantile of the distances from the
# middle that is the usual one.
_MIN_VERTICES, _USUAL_QUANTILE = 100, 0.99
# minimum length of a spike, in usual distances; maximum width of its foot, in its lengths
_MIN_SPIKE_LENGTH, _MAX_SPIKE_WIDTH = 1.5, 0.1
# Maximum faces of a hull or ground, and how far enclosed parts may protrude from it, as a fraction of its length.
_MAX_HULL_FACES, _HULL_TOLERANCE = 64, 1e-3
_MAX_NESTED = 4  # maximum number of nested hulls and grounds
# minimum extent of a ground relative to what is on it; share of the latter's height that may be below the ground
_MIN_GROUND_EXTENT, _MAX_SUNK = 1.5, 0.1
_MAX_NEAR_GAP = 0.05  # gap up to which a small part belongs to a shape that is made of small parts


def seam_representatives(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Int[Ints, " V"]:
    """The vertex that represents each vertex: the first one at the same position, if both lie on open edges."""
    twin = same_rows(verts)
    is_duplicate = twin != np.arange(len(verts))
    if not is_duplicate.any():
        return twin
    shared = np.zeros(len(verts), bool)
    shared[twin[is_duplicate]] = True
    shared = shared[twin]
    del twin, is_duplicate  # saves memory for millions of vertices
    border = np.zeros(len(verts), bool)
    border[triangles.edges_of(faces[shared[faces].any(axis=1)]).open] = True
    # the first of a group need not be on the border: group the border vertices alone
    candidates = np.flatnonzero(border & shared)
    representative = np.arange(len(verts))
    representative[candidates] = candidates[same_rows(verts[candidates])]
    return representative


def find_spikes(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Bool[Bools, " V"]:
    """Single vertices far from all others, at the tip of a needle of faces, as scanners produce by error."""
    is_spike = np.zeros(len(verts), bool)
    used = np.flatnonzero(np.bincount(faces.ravel(), minlength=len(verts)))
    if len(used) < _MIN_VERTICES:
        return is_spike
    distance = np.linalg.norm(verts - np.median(verts[used], axis=0), axis=1)
    usual = float(np.quantile(distance[used], _USUAL_QUANTILE))
    far = distance > _MIN_SPIKE_LENGTH * usual
    corners = faces[far[faces].any(axis=1)]
    is_single = far[corners].sum(axis=1) == 1
    far[corners[~is_single]] = False  # the end of a thin part has more than one far vertex
    corners = corners[is_single & far[corners].any(axis=1)]
    if not len(corners):
        return is_spike
    tip_column = far[corners].argmax(axis=1)[:, None]
    tips, tip = np.unique(np.take_along_axis(corners, tip_column, axis=1)[:, 0], return_inverse=True)
    ring = verts[np.take_along_axis(corners, (tip_column + np.array([1, 2])) % 3, axis=1)]
    low, high, length = np.full((len(tips), 3), np.inf), np.full((len(tips), 3), -np.inf), np.full(len(tips), np.inf)
    for side in range(2):
        np.minimum.at(low, tip, ring[:, side])
        np.maximum.at(high, tip, ring[:, side])
        np.minimum.at(length, tip, np.linalg.norm(verts[tips[tip]] - ring[:, side], axis=1))
    is_spike[tips] = (length > _MIN_SPIKE_LENGTH * usual) & (
        np.linalg.norm(high - low, axis=1) < _MAX_SPIKE_WIDTH * length
    )
    return is_spike


def collapse_short_edges(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"], diagonal: float
) -> Int[Ints, " V"]:
    """The vertex that represents each vertex: the first of all vertices connected by edges without length.

    `cross` is the normal of each face, with a length of twice its area. Unlike dropping the faces at such edges, this
    keeps a closed surface closed.
    """
    # no edge is longer than the diagonal
    thin = np.flatnonzero(squared_lengths(cross) <= (_DEGENERATE_LENGTH * diagonal**2) ** 2)
    if not len(thin):
        return np.arange(len(verts))
    usual = np.median(squared_lengths(verts[faces[:, 1]] - verts[faces[:, 0]]))
    edges = faces[thin][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    start, end = edges[squared_lengths(verts[edges[:, 1]] - verts[edges[:, 0]]) < _DEGENERATE_LENGTH**2 * usual].T
    return component_minima(len(verts), start, end)


def degenerate_faces(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"], diagonal: float
) -> Bool[Bools, " F"]:
    """Whether each face is degenerate: it repeats a vertex, or its height is within rounding of its longest edge.

    `cross` is the normal of each face, with a length of twice its area.
    """
    double_areas = squared_lengths(cross)
    flat = double_areas <= (1e-12 * diagonal**2) ** 2  # no edge is longer than the diagonal
    small = np.flatnonzero(flat)
    a, b, c = (verts[faces[small, k]] for k in range(3))
    longest = np.maximum(np.maximum(squared_lengths(b - a), squared_lengths(c - a)), squared_lengths(c - b))
    flat[small] = double_areas[small] <= (1e-12 * longest) ** 2
    return np.asarray(flat)


def duplicate_faces(faces: Int[Ints, "F 3"]) -> Bool[Bools, " F"]:
    """Duplicate faces to drop: all but the first with the same corners, or both faces of a flap.

    Two duplicates with opposite orientation cancel. If the surface continues around them they are a fold without
    volume, and the surface is closed without both. In a sheet that is doubled everywhere, one of each pair is the
    surface.
    """
    a, b, c = np.ascontiguousarray(faces.T)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    first = same_rows(np.stack([low, a + b + c - low - high, high], axis=1))
    double = first != np.arange(len(faces))
    if not double.any():
        return np.asarray(double)
    multiplicity = np.bincount(first, minlength=len(faces))
    second = np.flatnonzero(double & (multiplicity[first] == 2))
    pair = np.stack([first[second], second], axis=1)
    pair = pair[_orientation(faces[pair[:, 0]]) != _orientation(faces[pair[:, 1]])]
    touches_pair = np.zeros(int(faces.max()) + 1, bool)
    touches_pair[faces[pair.ravel()]] = True
    is_adjacent = touches_pair[faces].any(axis=1) & (multiplicity[first] == 1)
    single_keys = np.sort(edge_keys(faces[is_adjacent], len(touches_pair)))
    keys = edge_keys(faces[pair[:, 0]], len(touches_pair)).reshape(3, -1).T
    others = np.searchsorted(single_keys, keys, "right") - np.searchsorted(single_keys, keys, "left")  # pairs 3
    is_flap = ((others == 0) | (others == 2)).all(axis=1) & (others == 2).any(axis=1)
    double[pair[is_flap, 0]] = True
    return np.asarray(double)


def _orientation(faces: Ints) -> Bools:
    """Orientation of each face, as one of two classes: the same for the corners a b c, b c a and c a b."""
    rotated = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return np.asarray(rotated[:, 1] < rotated[:, 2])


def find_outlier_parts(
    verts: Float[Floats, "V 3"],
    faces: Int[Ints, "F 3"],
    cross: Float[Floats, "F 3"],
    spared: Bool[Bools, " V"] | None = None,
    around: int = _MAX_NESTED,
) -> tuple[Bool[Bools, " F"], int, int, int, float]:
    """Classify the connected parts of a mesh; `cross` as in `degenerate_faces`.

    A part with a `spared` vertex is never an outlier. A simple hull of all other parts is an outlier, and so is a flat
    ground that extends far beyond them, up to ``around`` of these, one around another.

    Returns the faces of outlier parts; the number of parts that are outliers, and of those that are not; how many of
    the latter are big but far from the rest; and the share of the surface that these have, in 0..1.
    """
    part = triangles.face_parts(faces, len(verts))
    if part.max() == 0:
        return np.zeros(len(faces), bool), 0, 1, 0, 0.0
    outer = None
    if spared is None and around:
        outer = _find_hull(verts, faces, part)
        outer = _find_ground(verts, faces, part, cross) if outer is None else outer
    if outer is not None:
        inside = part != outer
        dropped = np.ones(len(faces), bool)
        dropped[inside], n_outliers, kept, apart, share = find_outlier_parts(
            verts, faces[inside], cross[inside], None, around - 1
        )
        return dropped, n_outliers + 1, kept, apart, share
    face_areas = 0.5 * np.sqrt(squared_lengths(cross))
    areas = np.bincount(part, weights=face_areas)
    largest = int(areas.argmax())
    small = areas < OUTLIER_SHARE * areas[largest]
    counts = np.bincount(part)
    finest = counts[small].max(initial=0)
    if counts[~small].max() <= _MAX_HULL_FACES < finest and ((~small).sum() == 1 or 2 * finest > len(faces)):
        # next to something simple and huge, such as the ground of a scene, a body is not debris
        small = areas < OUTLIER_SHARE * areas[counts > _MAX_HULL_FACES].max(initial=0.0)
    big = np.flatnonzero(~small)
    # grow the body from the largest part by all big parts that are near
    body = np.array([largest])
    while len(body) < len(big):
        gap, diagonal = _gaps(verts, faces, face_areas, part, body, np.setdiff1d(big, body))
        near = np.setdiff1d(big[gap[big] <= _MIN_FAR_GAP * diagonal], body)
        if len(near) == 0:
            break
        body = np.concatenate([body, near])
    far = np.setdiff1d(big, body)
    outlier = small.copy()
    if areas[small].sum() > 0.1 * areas.sum():
        gap, diagonal = _gaps(verts, faces, face_areas, part, big, np.flatnonzero(small))
        outlier &= gap > _MAX_NEAR_GAP * diagonal
    if spared is not None:
        outlier[part[spared[faces].any(axis=1)]] = False
    n_outliers = int(outlier.sum())
    return outlier[part], n_outliers, len(areas) - n_outliers, len(far), float(areas[far].sum() / areas.sum())


def _find_hull(verts: Floats, faces: Ints, part: Ints) -> int | None:
    """The part that is a simple convex hull of all others, if any: a bounding box, or the collision shape of a game."""
    is_simple = np.bincount(part) <= _MAX_HULL_FACES
    chosen = is_simple[part]
    if not chosen.any() or np.count_nonzero(~chosen) < _MIN_VERTICES:
        return None
    used = verts[np.flatnonzero(np.bincount(faces.ravel(), minlength=len(verts)))]
    low, high = used.min(axis=0), used.max(axis=0)
    slack = _HULL_TOLERANCE * float((high - low).max())
    least, most = (np.full((len(is_simple), 3), end) for end in (np.inf, -np.inf))
    corners = verts[faces[chosen]]
    np.minimum.at(least, part[chosen], corners.min(axis=1))
    np.maximum.at(most, part[chosen], corners.max(axis=1))
    outermost = np.flatnonzero(((least <= low + slack) & (most >= high - slack)).all(axis=1))
    for each in outermost[:1].tolist():
        a, b, c = np.swapaxes(verts[faces[part == each]], 0, 1)
        normals = normalized(triangles.cross_product(b - a, c - a))
        heights = [(used - corner) @ normal for corner, normal in zip(a, normals, strict=True)]
        is_inside = all(height.max() <= slack or height.min() >= -slack for height in heights)
        if is_inside and np.linalg.matrix_rank(normals, 1e-3) == 3:
            return int(each)
    return None


def _find_ground(verts: Floats, faces: Ints, part: Ints, cross: Floats) -> int | None:
    """The largest part, if it is simple and flat, extends far beyond all others, and has them on one side."""
    areas = np.bincount(part, np.sqrt(squared_lengths(cross)))
    largest = int(areas.argmax())
    in_largest = part == largest
    if np.count_nonzero(in_largest) > _MAX_HULL_FACES or np.count_nonzero(~in_largest) < _MIN_VERTICES:
        return None
    ground, others = (verts[np.flatnonzero(np.bincount(faces[some].ravel()))] for some in (in_largest, ~in_largest))
    middle = ground.mean(axis=0)
    axes = np.linalg.svd(ground - middle, full_matrices=False)[2]
    ground, others = (ground - middle) @ axes.T, (others - middle) @ axes.T
    slack = _HULL_TOLERANCE * float(np.ptp(ground, axis=0).max())
    is_larger = (np.ptp(ground[:, :2], axis=0) >= _MIN_GROUND_EXTENT * np.ptp(others[:, :2], axis=0)).all()
    is_beneath = (ground.min(axis=0)[:2] <= others.min(axis=0)[:2]).all() and (
        ground.max(axis=0)[:2] >= others.max(axis=0)[:2]
    ).all()
    height = float(np.abs(others[:, 2]).max())
    is_one_sided = min(-others[:, 2].min(), others[:, 2].max()) <= _MAX_SUNK * height
    return largest if np.ptp(ground[:, 2]) <= slack and is_larger and is_beneath and is_one_sided else None


def _gaps(verts: Floats, faces: Ints, face_areas: Floats, part: Ints, body: Ints, others: Ints) -> tuple[Floats, float]:
    """Distance (parts,) of each of the `others` to the parts in `body`, and the diagonal of the body.

    Distances are infinite beyond `_MIN_FAR_GAP`, and 0 for parts that are not among the others.
    """
    from meshmatch.geometry.trees import cKDTree

    gap = np.zeros(int(part.max()) + 1)
    ours, theirs = np.isin(part, body), np.isin(part, others)
    anchor, chosen = faces[ours], faces[theirs]
    diagonal = float(np.linalg.norm(np.ptp(verts[anchor].reshape(-1, 3), axis=0)))
    if len(others):
        # sampled points of the body's faces, because its vertices may be far apart
        rng = np.random.default_rng(0)
        total = np.cumsum(face_areas[ours])
        face = np.searchsorted(total, rng.random(20_000) * total[-1]).clip(max=len(anchor) - 1)
        points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), len(face)), verts[anchor[face]])
        corners = np.flatnonzero(np.bincount(chosen.ravel()))
        of_vertex = np.zeros(len(verts), np.int64)
        of_vertex[chosen] = part[theirs, None]
        gap[others] = np.inf
        reach = np.nextafter(_MIN_FAR_GAP * diagonal, np.inf)
        np.minimum.at(gap, of_vertex[corners], cKDTree(points).query(verts[corners], distance_upper_bound=reach)[0])
    return gap, diagonal


def agreeing_flips(
    count: int, pairs: Int[Ints, "N 2"], differ: Bool[Bools, " N"], cost: Float[Floats, " N"]
) -> tuple[Bool[Bools, " count"], Int[Ints, " count"]]:
    """Flip some of `count` items so that neighbours agree along a minimum spanning forest.

    `differ` says which `pairs` of neighbours disagree now; `cost` is small where a pair is reliable. Returns which items
    to flip, relative to an arbitrary member of their component, and the component of each item.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    low, high = pairs.min(axis=1), pairs.max(axis=1)
    order = np.argsort(low * count + high, kind="stable")
    keys = (low * count + high)[order]
    first = order[np.flatnonzero(np.diff(keys, prepend=-1))]  # duplicate pairs would be summed
    low, high, differ, cost = low[first], high[first], differ[first], cost[first]
    ends = low.astype(np.int32), high.astype(np.int32)  # spanning trees need int32 before scipy 1.17.1
    graph = coo_array((1.0 + cost, ends), (count, count)).tocsr()  # scipy treats an explicit 0 as no edge
    forest = minimum_spanning_tree(graph).tocoo()
    a, b = forest.row.astype(np.int64), forest.col.astype(np.int64)
    across = differ[np.searchsorted(low * count + high, a * count + b)]
    # the graph has each item twice, as it is and flipped; consistent orientations are connected
    rows, columns = np.concatenate([a, a + count]), np.concatenate([b + count * across, b + count * ~across])
    both = coo_array((np.ones(len(rows), np.int8), (rows, columns)), (2 * count, 2 * count))
    side = connected_components(both, directed=False)[1]
    component = connected_components(graph, directed=False)[1].astype(np.int64)
    first = np.unique(component, return_index=True)[1]
    return side[:count] != side[first[component]], component


def orient_faces(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"], edges: Edges
) -> tuple[Int[Ints, "F 3"], int]:
    """Orient faces consistently and outwards; returns the faces and how many were reversed.

    A part with inconsistent faces is oriented outwards by the sign of its volume. If all faces were consistent, the
    shape is reversed as a whole, and only if its volume is clearly negative and it is not a sheet. Edges with more than
    two faces connect nothing. `cross` is the normal of each face, with a length of twice its area.
    """
    flip = np.zeros(len(faces), bool)
    areas = 0.5 * np.sqrt(np.einsum("fi,fi->f", cross, cross))
    corner = verts[faces[:, 0]]
    total = areas.sum()
    disagreeing = edges.disagreeing
    if disagreeing.any():
        flip, part, is_inconsistent = _consistent_flips(faces, edges)
        weight = np.maximum(np.bincount(part, weights=areas), 1e-300)
        center = np.stack([np.bincount(part, weights=areas * corner[:, i]) for i in range(3)], axis=1)
        above = np.einsum("fi,fi->f", corner - (center / weight[:, None])[part], cross) / 6.0
        volume = np.bincount(part, weights=np.where(flip, -above, above))
        # a sheet has no outside: reverse as few faces as possible
        is_majority = np.bincount(part, weights=np.where(flip, areas, -areas)) > 0
        reverse = np.where(np.abs(volume) > 1e-3 * weight**1.5, volume < 0, is_majority)
        flip = np.where(is_inconsistent[part], flip ^ reverse[part], False)
    # volume between each face and the middle; a bent sheet, such as a leaf, has no outside
    above = np.einsum("fi,fi->f", corner - areas @ corner / total, cross) / 6.0
    is_sheet = np.linalg.norm(np.where(flip, -1.0, 1.0) @ cross) > 2 * total * _MIN_SHEET_NORMAL
    if not is_sheet and np.where(flip, -above, above).sum() < -1e-3 * total**1.5:
        flip = ~flip
    if not flip.any():
        return faces, 0
    oriented = faces.copy()
    oriented[flip] = oriented[flip][:, ::-1]
    return oriented, int(flip.sum())


def _consistent_flips(faces: Ints, edges: Edges) -> tuple[Bools, Ints, Bools]:
    """(F,) faces to flip so that all agree, (F,) their part, and for each part whether any faces disagreed."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    disagreeing = edges.disagreeing
    face = np.argsort(triangles.directed_edges(faces)) % len(faces)
    interior = edges.begins[edges.sizes == 2]
    first, second = face[interior], face[interior + 1]
    # contract faces that agree already, which leaves a much smaller graph
    same = ~disagreeing
    graph = coo_array((np.ones(same.sum(), np.int8), (first[same], second[same])), (len(faces), len(faces)))
    groups, group = connected_components(graph, directed=False)
    pairs = np.stack([group[first[disagreeing]], group[second[disagreeing]]], axis=1).astype(np.int64)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]  # a one-sided band, like that of Moebius, is left as it is
    flip, part = agreeing_flips(groups, pairs, np.ones(len(pairs), bool), np.zeros(len(pairs)))
    is_inconsistent = np.zeros(int(part.max()) + 1, bool)
    is_inconsistent[part[pairs[:, 0]]] = True
    return flip[group], part[group], is_inconsistent
