"""Making neighbours agree which side is out: one tool for faces of a mesh and for normals of a cloud."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.topology import Edges, directed_edges


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
    graph = coo_array((1.0 + cost, (low, high)), (count, count)).tocsr()  # scipy takes an explicit 0 for no edge
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
    shape is turned as a whole, and only if its volume is clearly negative. An edge of more than two faces
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
    # the volume under each face, seen from the middle
    above = np.einsum("fi,fi->f", corner - areas @ corner / total, cross) / 6.0
    if np.where(flip, -above, above).sum() < -1e-3 * total**1.5:
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
    face = np.argsort(directed_edges(faces)) % len(faces)
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
