"""What the first modules that need SciPy take from it.

SciPy copies all names of NumPy, and with two of them would load NumPy's Fortran compiler and its tools for tests, 0.05 s
in every process: they are hidden while it is loaded.
"""

import numpy

_hidden = {"f2py", "testing"} - vars(numpy).keys()
vars(numpy).update(dict.fromkeys(_hidden))
try:
    from scipy.sparse import csr_array as csr_array
    from scipy.spatial import cKDTree as cKDTree
finally:
    for _name in _hidden:
        del vars(numpy)[_name]
