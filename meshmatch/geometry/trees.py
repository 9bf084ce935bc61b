"""SciPy's k-d tree, typed for queries of several points at once: the results are arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scipy.spatial import cKDTree as _cKDTree

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import ArrayLike

    from meshmatch.arrays import Floats, Ints

    class cKDTree(_cKDTree):
        """SciPy's k-d tree."""

        def query(self, x: ArrayLike, k: Any = 1, **options: Any) -> tuple[Floats, Ints]:  # type: ignore[override]
            """Distances to the nearest points, and their indices."""

else:
    cKDTree = _cKDTree
