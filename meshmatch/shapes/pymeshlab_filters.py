"""The one door to pymeshlab, which is under the GPL and optional: nothing on the main path comes here.

Its filters sit in plugins. Without Debian's libopengl0 some of them are silently missing; without libgl1 the import
fails.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import OptionError

_COLLAPSE = "meshing_decimation_quadric_edge_collapse"


def collapse_edges(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], target: int
) -> tuple[Float[Floats, "V_new 3"], Int[Ints, "F_new 3"]]:
    """Decimate to `target` faces with planar quadrics: well-shaped triangles, topology kept.

    Raises
    ------
    OptionError
        pymeshlab is not installed, or lacks the filter.
    """
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
