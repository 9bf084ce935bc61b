"""The one door to pymeshlab, which is under the GPL and optional: nothing on the main path comes here.

Its filters sit in plugins. Without Debian's libopengl0 some of them are silently missing; without libgl1 the
import fails.
"""

from typing import Any

import numpy as np

from meshmatch.arrays import Floats, Ints
from meshmatch.errors import OptionError
from meshmatch.shapes.shape import Shape

_COLLAPSE = "meshing_decimation_quadric_edge_collapse"
_REMESH = "meshing_isotropic_explicit_remeshing"


def missing_filters() -> str:
    """What is wrong with pymeshlab here, in words; empty if all the filters used are there."""
    try:
        _pymeshlab(_COLLAPSE, _REMESH)
    except OptionError as error:
        return f"{error.message}: {error.hint}"
    return ""


def collapse_edges(verts: Floats, faces: Ints, target: int) -> tuple[Floats, Ints]:
    """Decimate with planar quadrics: well-shaped triangles, topology kept.

    Raises
    ------
    OptionError
        pymeshlab is not installed, or has lost the filter.
    """
    meshes = _loaded(verts, faces, _COLLAPSE)
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(target),
        qualitythr=0.5,
        planarquadric=True,
        preservetopology=True,
        preservenormal=True,
    )
    return _current(meshes)


def remesh(shape: Shape, edge: float, iterations: int = 5) -> Shape:
    """The same surface with other, even triangles, for tests and training. Slow: 15 s for 100,000 faces.

    Parameters
    ----------
    shape : Shape
        A mesh, best below 20,000 faces.
    edge : float
        Wanted length of an edge, units of the file.
    iterations : int

    Raises
    ------
    OptionError
        pymeshlab is not installed, or has lost the filter.
    """
    meshes = _loaded(shape.verts, shape.faces, _REMESH)
    import pymeshlab

    meshes.meshing_isotropic_explicit_remeshing(iterations=iterations, targetlen=pymeshlab.PureValue(edge))
    verts, faces = _current(meshes)
    return Shape(verts, faces, shape.name)


def _loaded(verts: Floats, faces: Ints, *filters: str) -> Any:
    pymeshlab = _pymeshlab(*filters)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.array(verts), np.array(faces, np.int32)))
    return meshes


def _current(meshes: Any) -> tuple[Floats, Ints]:
    mesh = meshes.current_mesh()
    mesh.compact()
    return np.array(mesh.vertex_matrix(), np.float64), np.array(mesh.face_matrix(), np.int64)


def _pymeshlab(*filters: str) -> Any:
    try:
        import pymeshlab
    except ModuleNotFoundError as error:
        raise OptionError(
            "this choice needs pymeshlab, which is not installed",
            "pip install pymeshlab (it is under the GPL), or choose fast",
        ) from error
    except ImportError as error:
        raise OptionError(
            f"pymeshlab cannot start ({str(error)[:100]})", "on Debian: apt-get install libgl1 libopengl0"
        ) from error
    lost = [name for name in filters if not hasattr(pymeshlab.MeshSet, name)]
    if lost:
        raise OptionError(f"pymeshlab has lost its filter {lost[0]}", "on Debian: apt-get install libopengl0")
    return pymeshlab
