"""Faces of a mesh: which are double, nothing, or no part of the object, and which way they face.

One tool makes neighbours agree which side is out: faces of a mesh, and normals of a cloud.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry import triangles
from meshmatch.geometry.triangles import Edges, edge_keys, same_rows, squared_lengths, together, unit

OUTLIER_SHARE = 0.02
"""A part with less than this share of the largest part's area is an outlier. This and the next two are set by hand."""
_FAR = 0.25  # gap between two big parts, in diagonals of the largest, from which they count as apart
_SHEET = 0.8  # a sheet's mean normal is so long: 0.5 of half a sphere, 0.64 of half a cylinder, 0.9 of leaves
_SHORT = 1e-9  # of the median edge: an edge without length
_FEWEST, _USUAL = 100, 0.99  # vertices that tell how far most lie from their middle, and what share of them does
_SPIKE, _NEEDLE = 1.5, 0.1  # a spike is so many times as long, and its foot that much narrower
_HULL_FACES, _TOUCHING = (
    64,
    1e-3,
)  # that a plain hull has at most; how far what it holds may reach out of it, of its length
_AROUND = 4  # hulls and grounds at most, one around another
_FURTHER, _SUNK = 1.5, 0.1  # times as far a ground reaches as what is on it; how much of that may be below it
_NEAR = 0.05  # gap up to which a small part belongs to a shape that is made of small parts


def seams(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Int[Ints, " V"]:
    """The vertex to use instead of each: the first at the same position, if both lie on an open edge."""
    twin = same_rows(verts)
    again = twin != np.arange(len(verts))
    if not again.any():
        return twin
    shared = np.zeros(len(verts), bool)
    shared[twin[again]] = True
    shared = shared[twin]
    del twin, again  # for millions of vertices ask for little memory
    border = np.zeros(len(verts), bool)
    border[triangles.edges_of(faces[shared[faces].any(axis=1)]).open] = True
    # the first of a group need not be on the border: number the border alone
    place = np.flatnonzero(border & shared)
    own = np.arange(len(verts))
    own[place] = place[same_rows(verts[place])]
    return own


def spikes(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Bool[Bools, " V"]:
    """Single vertices far from all others, each the tip of a needle of faces, as errors of scanners leave them."""
    found = np.zeros(len(verts), bool)
    used = np.flatnonzero(np.bincount(faces.ravel(), minlength=len(verts)))
    if len(used) < _FEWEST:
        return found
    away = np.linalg.norm(verts - np.median(verts[used], axis=0), axis=1)
    usual = float(np.quantile(away[used], _USUAL))
    far = away > _SPIKE * usual
    corners = faces[far[faces].any(axis=1)]
    alone = far[corners].sum(axis=1) == 1
    far[corners[~alone]] = False  # a thin part has more vertices than one at its end
    corners = corners[alone & far[corners].any(axis=1)]
    if not len(corners):
        return found
    at = far[corners].argmax(axis=1)[:, None]
    tips, tip = np.unique(np.take_along_axis(corners, at, axis=1)[:, 0], return_inverse=True)
    ring = verts[np.take_along_axis(corners, (at + np.array([1, 2])) % 3, axis=1)]
    low, high, length = np.full((len(tips), 3), np.inf), np.full((len(tips), 3), -np.inf), np.full(len(tips), np.inf)
    for side in range(2):
        np.minimum.at(low, tip, ring[:, side])
        np.maximum.at(high, tip, ring[:, side])
        np.minimum.at(length, tip, np.linalg.norm(verts[tips[tip]] - ring[:, side], axis=1))
    found[tips] = (length > _SPIKE * usual) & (np.linalg.norm(high - low, axis=1) < _NEEDLE * length)
    return found


def collapsed(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"], diagonal: float
) -> Int[Ints, " V"]:
    """The vertex to use instead of each: the first of all that edges without length join.

    `cross` is the normal of each face, twice its area long. A closed surface stays closed, as it would not if the faces at
    such edges were only dropped.
    """
    thin = np.flatnonzero(squared_lengths(cross) <= (_SHORT * diagonal**2) ** 2)  # no edge is longer than the diagonal
    if not len(thin):
        return np.arange(len(verts))
    usual = np.median(squared_lengths(verts[faces[:, 1]] - verts[faces[:, 0]]))
    edges = faces[thin][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    one, two = edges[squared_lengths(verts[edges[:, 1]] - verts[edges[:, 0]]) < _SHORT**2 * usual].T
    return together(len(verts), one, two)


def flat_faces(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"], diagonal: float
) -> Bool[Bools, " F"]:
    """True for a face that names a vertex twice, or whose height is rounding beside its longest edge.

    `cross` is the normal of each face, twice its area long.
    """
    double_areas = squared_lengths(cross)
    flat = double_areas <= (1e-12 * diagonal**2) ** 2  # no edge is longer than the diagonal
    small = np.flatnonzero(flat)
    a, b, c = (verts[faces[small, k]] for k in range(3))
    longest = np.maximum(np.maximum(squared_lengths(b - a), squared_lengths(c - a)), squared_lengths(c - b))
    flat[small] = double_areas[small] <= (1e-12 * longest) ** 2
    return np.asarray(flat)


def duplicate_faces(faces: Int[Ints, "F 3"]) -> Bool[Bools, " F"]:
    """True for faces to drop: all but the first of the same three corners, and both of a flap.

    Two that face opposite ways cancel. On a surface that goes on around them they are a fold of no volume,
    and without both it is closed as before; in a sheet that is double all over, one of each is the surface.
    """
    a, b, c = np.ascontiguousarray(faces.T)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    first = same_rows(np.stack([low, a + b + c - low - high, high], axis=1))
    double = first != np.arange(len(faces))
    if not double.any():
        return np.asarray(double)
    many = np.bincount(first, minlength=len(faces))
    second = np.flatnonzero(double & (many[first] == 2))
    pair = np.stack([first[second], second], axis=1)
    pair = pair[_handed(faces[pair[:, 0]]) != _handed(faces[pair[:, 1]])]
    at_pair = np.zeros(int(faces.max()) + 1, bool)
    at_pair[faces[pair.ravel()]] = True
    beside = at_pair[faces].any(axis=1) & (many[first] == 1)
    single = np.sort(edge_keys(faces[beside], len(at_pair)))
    keys = edge_keys(faces[pair[:, 0]], len(at_pair)).reshape(3, -1).T
    others = np.searchsorted(single, keys, "right") - np.searchsorted(single, keys, "left")  # pairs 3
    flap = ((others == 0) | (others == 2)).all(axis=1) & (others == 2).any(axis=1)
    double[pair[flap, 0]] = True
    return np.asarray(double)


def _handed(faces: Ints) -> Bools:
    """Which of its two ways round each face goes: the same for a b c, b c a and c a b."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return np.asarray(turned[:, 1] < turned[:, 2])


def find_parts(
    verts: Float[Floats, "V 3"],
    faces: Int[Ints, "F 3"],
    cross: Float[Floats, "F 3"],
    spared: Bool[Bools, " V"] | None = None,
    around: int = _AROUND,
) -> tuple[Bool[Bools, " F"], int, int, int, float]:
    """Judge the connected parts of a mesh; `cross` as in `flat_faces`. A part with a `spared` vertex is no outlier; a plain
    hull of all others is one, and so is a flat ground that reaches far beyond them, as
    long as there are no more than ``around`` of these.

    Returns the faces of outlier parts; how many parts are outliers, and how many are not; how many of the latter are
    big but lie far from the rest; and the share of the surface that these have, in 0..1.
    """
    part = triangles.face_parts(faces, len(verts))
    if part.max() == 0:
        return np.zeros(len(faces), bool), 0, 1, 0, 0.0
    outer = None
    if spared is None and around:
        outer = _container(verts, faces, part)
        outer = _ground(verts, faces, part, cross) if outer is None else outer
    if outer is not None:
        inside = part != outer
        dropped = np.ones(len(faces), bool)
        dropped[inside], many, kept, apart, share = find_parts(verts, faces[inside], cross[inside], None, around - 1)
        return dropped, many + 1, kept, apart, share
    face_areas = 0.5 * np.sqrt(squared_lengths(cross))
    areas = np.bincount(part, weights=face_areas)
    largest = int(areas.argmax())
    small = areas < OUTLIER_SHARE * areas[largest]
    counts = np.bincount(part)
    finest = counts[small].max(initial=0)
    if counts[~small].max() <= _HULL_FACES < finest and ((~small).sum() == 1 or 2 * finest > len(faces)):
        # beside something plain and huge, such as the ground of a scene, a body is no dirt
        small = areas < OUTLIER_SHARE * areas[counts > _HULL_FACES].max(initial=0.0)
    big = np.flatnonzero(~small)
    # the body grows from the largest part by all big parts that are near
    body = np.array([largest])
    while len(body) < len(big):
        gap, diagonal = _gaps(verts, faces, face_areas, part, body, np.setdiff1d(big, body))
        near = np.setdiff1d(big[gap[big] <= _FAR * diagonal], body)
        if len(near) == 0:
            break
        body = np.concatenate([body, near])
    far = np.setdiff1d(big, body)
    outlier = small.copy()
    if areas[small].sum() > 0.1 * areas.sum():
        gap, diagonal = _gaps(verts, faces, face_areas, part, big, np.flatnonzero(small))
        outlier &= gap > _NEAR * diagonal
    if spared is not None:
        outlier[part[spared[faces].any(axis=1)]] = False
    many = int(outlier.sum())
    return outlier[part], many, len(areas) - many, len(far), float(areas[far].sum() / areas.sum())


def _container(verts: Floats, faces: Ints, part: Ints) -> int | None:
    """The part that is a plain convex hull of all others, if one is: a bounding box, or the collision shape of a game."""
    few = np.bincount(part) <= _HULL_FACES
    chosen = few[part]
    if not chosen.any() or np.count_nonzero(~chosen) < _FEWEST:
        return None
    used = verts[np.flatnonzero(np.bincount(faces.ravel(), minlength=len(verts)))]
    low, high = used.min(axis=0), used.max(axis=0)
    slack = _TOUCHING * float((high - low).max())
    least, most = (np.full((len(few), 3), end) for end in (np.inf, -np.inf))
    corners = verts[faces[chosen]]
    np.minimum.at(least, part[chosen], corners.min(axis=1))
    np.maximum.at(most, part[chosen], corners.max(axis=1))
    outermost = np.flatnonzero(((least <= low + slack) & (most >= high - slack)).all(axis=1))
    for each in outermost[:1].tolist():
        a, b, c = np.swapaxes(verts[faces[part == each]], 0, 1)
        normals = unit(triangles.cross_product(b - a, c - a))
        heights = [(used - corner) @ normal for corner, normal in zip(a, normals, strict=True)]
        held = all(height.max() <= slack or height.min() >= -slack for height in heights)
        if held and np.linalg.matrix_rank(normals, 1e-3) == 3:
            return int(each)
    return None


def _ground(verts: Floats, faces: Ints, part: Ints, cross: Floats) -> int | None:
    """The part with the largest area, if it is plain and flat, reaches far beyond all others, and has them on one side."""
    areas = np.bincount(part, np.sqrt(squared_lengths(cross)))
    largest = int(areas.argmax())
    own = part == largest
    if np.count_nonzero(own) > _HULL_FACES or np.count_nonzero(~own) < _FEWEST:
        return None
    flat, rest = (verts[np.flatnonzero(np.bincount(faces[some].ravel()))] for some in (own, ~own))
    middle = flat.mean(axis=0)
    axes = np.linalg.svd(flat - middle, full_matrices=False)[2]
    flat, rest = (flat - middle) @ axes.T, (rest - middle) @ axes.T
    slack = _TOUCHING * float(np.ptp(flat, axis=0).max())
    beyond = (np.ptp(flat[:, :2], axis=0) >= _FURTHER * np.ptp(rest[:, :2], axis=0)).all()
    on_it = (flat.min(axis=0)[:2] <= rest.min(axis=0)[:2]).all() and (
        flat.max(axis=0)[:2] >= rest.max(axis=0)[:2]
    ).all()
    height = float(np.abs(rest[:, 2]).max())
    one_side = min(-rest[:, 2].min(), rest[:, 2].max()) <= _SUNK * height
    return largest if np.ptp(flat[:, 2]) <= slack and beyond and on_it and one_side else None


def _gaps(verts: Floats, faces: Ints, face_areas: Floats, part: Ints, body: Ints, others: Ints) -> tuple[Floats, float]:
    """Distance (parts,) of each of the `others` to the parts in `body`, infinite beyond `_FAR`, else 0; and the body's
    diagonal."""
    from meshmatch.geometry.trees import cKDTree

    gap = np.zeros(int(part.max()) + 1)
    ours, theirs = np.isin(part, body), np.isin(part, others)
    anchor, chosen = faces[ours], faces[theirs]
    diagonal = float(np.linalg.norm(np.ptp(verts[anchor].reshape(-1, 3), axis=0)))
    if len(others):
        # points on the body's faces, because its vertices may be far apart
        rng = np.random.default_rng(0)
        total = np.cumsum(face_areas[ours])
        face = np.searchsorted(total, rng.random(20_000) * total[-1]).clip(max=len(anchor) - 1)
        points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), len(face)), verts[anchor[face]])
        corners = np.flatnonzero(np.bincount(chosen.ravel()))
        of_vertex = np.zeros(len(verts), np.int64)
        of_vertex[chosen] = part[theirs, None]
        gap[others] = np.inf
        reach = np.nextafter(_FAR * diagonal, np.inf)
        np.minimum.at(gap, of_vertex[corners], cKDTree(points).query(verts[corners], distance_upper_bound=reach)[0])
    return gap, diagonal


def agreeing_flips(
    count: int, pairs: Int[Ints, "N 2"], differ: Bool[Bools, " N"], cost: Float[Floats, " N"]
) -> tuple[Bool[Bools, " count"], Int[Ints, " count"]]:
    """Which of `count` things to flip so that neighbours agree along a minimum spanning forest, and their components.

    `differ` says which `pairs` of neighbours disagree as they are; `cost` is small where a pair's word counts. Things
    are flipped relative to an arbitrary member of their component.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

    low, high = pairs.min(axis=1), pairs.max(axis=1)
    order = np.argsort(low * count + high, kind="stable")
    keys = (low * count + high)[order]
    first = order[np.flatnonzero(np.diff(keys, prepend=-1))]  # a pair named twice would add up
    low, high, differ, cost = low[first], high[first], differ[first], cost[first]
    ends = low.astype(np.int32), high.astype(np.int32)  # before scipy 1.17.1 spanning trees have no others
    graph = coo_array((1.0 + cost, ends), (count, count)).tocsr()  # scipy takes an explicit 0 for no edge
    forest = minimum_spanning_tree(graph).tocoo()
    a, b = forest.row.astype(np.int64), forest.col.astype(np.int64)
    across = differ[np.searchsorted(low * count + high, a * count + b)]
    # everything stands there twice, as it is and flipped; what agrees is connected
    rows, columns = np.concatenate([a, a + count]), np.concatenate([b + count * across, b + count * ~across])
    both = coo_array((np.ones(len(rows), np.int8), (rows, columns)), (2 * count, 2 * count))
    side = connected_components(both, directed=False)[1]
    component = connected_components(graph, directed=False)[1].astype(np.int64)
    first = np.unique(component, return_index=True)[1]
    return side[:count] != side[first[component]], component


def turn_faces(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"], edges: Edges
) -> tuple[Int[Ints, "F 3"], int]:
    """Faces turned so that neighbours agree and the shape is not inside out, and how many were turned.

    A part whose faces disagreed is turned outwards by the sign of its volume; if they agreed everywhere, the
    shape is turned as a whole, and only if its volume is clearly negative and it is no sheet. An edge of more than two faces
    joins nothing. `cross` is the normal of each face, twice its area long.
    """
    flip = np.zeros(len(faces), bool)
    areas = 0.5 * np.sqrt(np.einsum("fi,fi->f", cross, cross))
    corner = verts[faces[:, 0]]
    total = areas.sum()
    disagreeing = edges.disagreeing
    if disagreeing.any():
        flip, part, wrong = _flips(faces, edges)
        weight = np.maximum(np.bincount(part, weights=areas), 1e-300)
        center = np.stack([np.bincount(part, weights=areas * corner[:, i]) for i in range(3)], axis=1)
        above = np.einsum("fi,fi->f", corner - (center / weight[:, None])[part], cross) / 6.0
        volume = np.bincount(part, weights=np.where(flip, -above, above))
        # a sheet has no outside: then as few faces as possible are turned
        many = np.bincount(part, weights=np.where(flip, areas, -areas)) > 0
        turn = np.where(np.abs(volume) > 1e-3 * weight**1.5, volume < 0, many)
        flip = np.where(wrong[part], flip ^ turn[part], False)
    # the volume under each face, seen from the middle; a bent sheet, such as a leaf, has no outside
    above = np.einsum("fi,fi->f", corner - areas @ corner / total, cross) / 6.0
    sheet = np.linalg.norm(np.where(flip, -1.0, 1.0) @ cross) > 2 * total * _SHEET
    if not sheet and np.where(flip, -above, above).sum() < -1e-3 * total**1.5:
        flip = ~flip
    if not flip.any():
        return faces, 0
    turned = faces.copy()
    turned[flip] = turned[flip][:, ::-1]
    return turned, int(flip.sum())


def _flips(faces: Ints, edges: Edges) -> tuple[Bools, Ints, Bools]:
    """(F,) faces to flip so that all agree, (F,) their part, and for each part whether any disagreed."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    disagreeing = edges.disagreeing
    face = np.argsort(triangles.directed_edges(faces)) % len(faces)
    two = edges.begins[edges.sizes == 2]
    first, second = face[two], face[two + 1]
    # faces that agree already are one thing: far fewer are left to walk through
    same = ~disagreeing
    graph = coo_array((np.ones(same.sum(), np.int8), (first[same], second[same])), (len(faces), len(faces)))
    groups, group = connected_components(graph, directed=False)
    pairs = np.stack([group[first[disagreeing]], group[second[disagreeing]]], axis=1).astype(np.int64)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]  # a band with one side, like that of Moebius, is left as it is
    flip, part = agreeing_flips(groups, pairs, np.ones(len(pairs), bool), np.zeros(len(pairs)))
    wrong = np.zeros(int(part.max()) + 1, bool)
    wrong[part[pairs[:, 0]]] = True
    return flip[group], part[group], wrong
