"""Mesh simplification.

The only module that imports pymeshlab, which is optional and under the GPL; the other modules do not need it.
"""

from __future__ import annotations

import threading
from typing import Literal

import numpy as np

from meshmatch.arrays import Floats, Ints
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.triangles import edges_of, is_watertight
from meshmatch.shapes.shape import Shape

Quality = Literal["fast", "meshlab"]
_AGGRESSIVENESS = (3.0, 4.0, 2.5, 5.0)
"""Values to try, in order. On closed bodies 3 kept the mesh closed with the least error, and 7, the library's default,
did not; but 3 can stop short of the target, which higher values reach.
"""
_lock = threading.Lock()  # fast_simplification keeps its mesh in global variables
_COLLAPSE = "meshing_decimation_quadric_edge_collapse"


def decimate(shape: Shape, faces: int, quality: Quality = "fast") -> Shape:
    """Simplify a mesh to about `faces` triangles by quadric edge collapse (Garland and Heckbert 1997).

    A mesh with no more faces is returned unchanged. A closed mesh stays closed, if need be with more triangles than
    requested; if that fails, the result has as few open and non-manifold edges as possible. Non-manifold input is
    accepted. Vertices without faces are dropped; colors are those of the nearest original vertex.

    `faces` is at least 4; borders and closedness can prevent the target. Quality "meshlab" (by pymeshlab) takes ten
    times as long, and makes well-shaped triangles in flat regions. `InputError`: the shape is a cloud. `OptionError`:
    unknown quality, fewer than 4 faces, or pymeshlab is missing or lacks its filters.
    """
    if quality not in ("fast", "meshlab"):
        raise OptionError(f"unknown decimation quality {quality!r}", "choose fast or meshlab")
    if faces < 4:
        raise OptionError(f"cannot decimate to {faces} faces", "use at least 4")
    if shape.is_cloud:
        raise InputError(f"{shape.name or 'the shape'} is a point cloud: it has no faces to decimate")
    if faces >= shape.F:
        return shape
    # normalised, because the library compares with absolute tolerances
    center, size = shape.bounds.mean(axis=0), shape.diagonal or 1.0
    collapse = _by_pymeshlab if quality == "meshlab" else _fast
    verts, corners = collapse((shape.verts - center) / size, shape.faces, faces)
    verts = verts * size + center
    used, corner = np.unique(corners, return_inverse=True)
    colors = None
    if shape.colors is not None:
        from meshmatch.geometry.trees import cKDTree

        colors = shape.colors[cKDTree(shape.verts).query(verts[used])[1]]
    return Shape(verts[used], corner.reshape(-1, 3), shape.name, colors)


def _fast(verts: Floats, faces: Ints, target: int) -> tuple[Floats, Ints]:
    """Simplify with fast_simplification: the first of `_AGGRESSIVENESS` without faults, else the best."""
    import fast_simplification

    closed = is_watertight(faces)
    best: tuple[tuple[int, int], Floats, Ints] | None = None
    for aggressiveness in _AGGRESSIVENESS:
        with _lock:
            simplified = fast_simplification.simplify(
                verts, faces.astype(np.int32), target_count=target, agg=aggressiveness
            )
        new_faces = np.asarray(simplified[1], np.int64)
        # drops faces that repeat a vertex
        new_faces = new_faces[(new_faces != np.roll(new_faces, 1, axis=1)).all(axis=1)]
        if len(new_faces) == 0:
            continue
        faults = sum(edges_of(new_faces).counts) if closed else 0
        penalty = faults, max(len(new_faces) - int(1.02 * target) - 2, 0)
        if best is None or penalty < best[0]:
            best = penalty, np.asarray(simplified[0], np.float64), new_faces
        if penalty == (0, 0):
            break
    return (verts, faces) if best is None else best[1:]


def _by_pymeshlab(verts: Floats, faces: Ints, target: int) -> tuple[Floats, Ints]:
    """Well-shaped triangles with the same topology.

    Without Debian's libopengl0 pymeshlab silently lacks some filters.
    """
    try:
        import pymeshlab
    except ModuleNotFoundError as error:
        hint = "pip install pymeshlab (it is under the GPL), or choose fast"
        raise OptionError("this choice needs pymeshlab, which is not installed", hint) from error
    except ImportError as error:
        hint = "on Debian: apt-get install libgl1 libopengl0"
        raise OptionError(f"pymeshlab cannot start ({str(error)[:100]})", hint) from error
    if not hasattr(pymeshlab.MeshSet, _COLLAPSE):
        raise OptionError(f"pymeshlab lacks its filter {_COLLAPSE}", "on Debian: apt-get install libopengl0")
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.array(verts), np.array(faces, np.int32)))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(target), qualitythr=0.5, planarquadric=True, preservetopology=True, preservenormal=True
    )
    mesh = meshes.current_mesh()
    mesh.compact()
    return np.array(mesh.vertex_matrix(), np.float64), np.array(mesh.face_matrix(), np.int64)
