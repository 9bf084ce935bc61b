"""Scans of a part, completed by what a fit takes the rest to be.

The network was mostly shown wholes. Where a scan shows a part, the template's fitted surface stands in for what is
missing, and the network is asked again about both together. The refinement then holds what was not seen where the
network wants it, and nothing beyond a cut is pulled onto its edge.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.scan import Scan, with_normals
from meshmatch.fitting.system import NodeSystem
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

# A template vertex is seen if the scan is this near, and if the scan's nearest point belongs this near to the vertex
# on the resting template (units of sqrt(area)).
_NEAR, _HOME = 0.06, 0.06
_MOST = 3  # stand-in points for each point of the scan, at most


def seen(system: NodeSystem, scan: Scan, vectors: np.ndarray) -> np.ndarray:
    """(V,) whether the scan (core frame) shows each vertex of the template as fitted.

    Vertices beyond a cut have the edge of the scan near by, but the edge belongs elsewhere on the template.
    """
    moved = system.moved(vectors)
    normals = system.normals(moved)
    scan = scan.facing(moved, normals)
    features = with_normals(moved, normals)
    distance, point = scan.tree.query(features)
    home = cKDTree(features).query(with_normals(scan.points, scan.normals))[1]
    away = np.linalg.norm(system.verts[home[point]] - system.verts, axis=1)
    return np.asarray((distance < _NEAR) & (away < _HOME))


def completed(
    system: NodeSystem, scan: Scan, vectors: np.ndarray, share: float, rng: np.random.Generator
) -> Scan:
    """A scan (core frame) of a ``share`` of the surface, with points of the fitted template where it shows nothing."""
    moved = system.moved(vectors)
    there = seen(system, scan, vectors)
    faces = system.faces[~there[system.faces].any(axis=1)]
    if not len(faces):
        return scan
    missing = Shape(moved, faces)
    if not missing.area > 0:
        return scan
    P = len(scan.points)
    count = min(round(P * missing.area / share), _MOST * P)
    found = sample_surface(missing, count, rng)
    scan = scan.facing(moved, system.normals(moved))
    order = rng.permutation(P + count)
    return replace(
        scan,
        points=np.concatenate([scan.points, found.points])[order],
        normals=np.concatenate([scan.normals, found.normals])[order],
    )


def seen_area(system: NodeSystem, there: np.ndarray) -> float:
    """Share (0..1) of the resting template's area around vertices (V,) that are seen."""
    area = Shape(system.verts, system.faces).vertex_areas
    return float(area[there].sum() / area.sum())
