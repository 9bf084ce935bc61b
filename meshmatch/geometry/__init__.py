"""Geometry of plain arrays: frames, oriented points, triangles.

SciPy copies all names of NumPy, and with two of them would load NumPy's Fortran compiler and its tools for tests, 0.05 s
in every process: they are hidden while it is loaded, here, before anything else of this package is.
"""

import numpy

_hidden = {"f2py", "testing"} - vars(numpy).keys()
vars(numpy).update(dict.fromkeys(_hidden))
try:
    import scipy.spatial  # noqa: F401
finally:
    for _name in _hidden:
        del vars(numpy)[_name]
