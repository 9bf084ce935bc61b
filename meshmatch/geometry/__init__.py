"""Geometry of plain arrays: frames, oriented points, triangles.

SciPy copies all names of NumPy, and with two of them it would load NumPy's Fortran compiler and its tools for tests:
0.05 s in every process. These two are hidden from it while it is loaded, here, before anything else of this package is.
"""

import sys

import numpy

if "scipy.spatial" not in sys.modules:
    _hidden = [name for name in ("f2py", "testing") if name not in vars(numpy)]
    for _name in _hidden:
        setattr(numpy, _name, None)
    try:
        import scipy.spatial  # noqa: F401
    finally:
        for _name in _hidden:
            delattr(numpy, _name)
