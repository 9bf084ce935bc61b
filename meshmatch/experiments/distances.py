"""Distances from the true points of one target, computed once and kept on disk for the next run.

A benchmark asks the same question again and again: how far is vertex p of this target from landmark k? The
answers are the rows of one matrix (a row for each vertex that is a landmark, a column for each vertex), which
depends on the target alone.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import platformdirs
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from meshmatch.errors import OutputError
from meshmatch.maps.geodesics import GEODESIC, GeodesicDistances
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.shape import Shape

READ_BYTES = 64_000_000
CACHE_VARIABLE = "MESHMATCH_GEODESICS"

# Part of every file's name: a change of the graph in maps.geodesics must not meet the distances of the old
# one.
_GRAPH_VERSION = "1"


def default_folder() -> Path:
    """Where distances are kept: ``$MESHMATCH_GEODESICS``, or ``geodesics`` in the user's cache folder."""
    chosen = os.environ.get(CACHE_VARIABLE)
    return Path(chosen) if chosen else platformdirs.user_cache_path("meshmatch") / "geodesics"


class TruthDistances:
    """Distances on one target between its landmarks and all its vertices, in units of sqrt(area).

    Parameters
    ----------
    target
        The shape on which errors are measured.
    landmarks
        Vertex ids ``(N,)`` of its true points.
    folder
        Where the matrix is kept: ``(unique landmarks, V)`` float16, named by the hashes of shape and
        landmarks. float16 rounds a distance by at most one part in 2000.
    """

    def __init__(self, target: Shape, landmarks: NDArray[np.int64], folder: Path) -> None:
        self.target = target
        self.rows, self.row_of_landmark = np.unique(landmarks, return_inverse=True)
        parts = [target.hash, hashlib.sha256(self.rows.tobytes()).hexdigest(), GEODESIC, _GRAPH_VERSION]
        name = hashlib.sha256("|".join(parts).encode()).hexdigest()[:16]
        self.path = Path(folder) / f"{target.hash}-{name}.npy"

    def prepare(self) -> None:
        """Compute and store the matrix unless it is there (1 to 15 ms a row on one core).

        Raises
        ------
        OutputError
            The folder cannot be made or written.
        """
        if self.path.exists():
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"cannot keep distances in {self.path.parent}: {error.strerror}",
                "choose a folder with --cache",
            ) from error
        geodesics = GeodesicDistances(self.target)
        with replace_on_success(self.path) as temporary:
            matrix = open_memmap(temporary, "w+", dtype=np.float16, shape=(len(self.rows), self.target.V))
            for first, rows in geodesics.chunks(self.rows):
                matrix[first : first + len(rows)] = rows
            matrix.flush()
            del matrix

    def of(self, landmarks: NDArray[np.integer]) -> NDArray[np.float16]:
        """Distances (N, V) from some landmarks, given by their numbers (N,), to all vertices."""
        self.prepare()
        matrix = np.load(self.path, mmap_mode="r", allow_pickle=False)
        return np.array(matrix[self.row_of_landmark[landmarks]])

    def errors(self, predictions: Sequence[NDArray[np.integer]]) -> list[NDArray[np.float32]]:
        """Errors ``(N,)`` of each prediction ``(N,)``: the distance from landmark k to vertex
        ``prediction[k]``.

        The matrix is read once, in order, however many predictions there are: give all those of a target
        together.
        """
        self.prepare()
        matrix = np.load(self.path, mmap_mode="r", allow_pickle=False)
        order = np.argsort(self.row_of_landmark, kind="stable")
        bounds = np.searchsorted(self.row_of_landmark[order], np.arange(len(self.rows) + 1))
        results = [np.empty(len(self.row_of_landmark), dtype=np.float32) for _ in predictions]
        step = max(1, READ_BYTES // (2 * self.target.V))
        for first in range(0, len(self.rows), step):
            block = np.array(matrix[first : first + step])
            mine = order[bounds[first] : bounds[first + len(block)]]
            rows = self.row_of_landmark[mine] - first
            for prediction, result in zip(predictions, results, strict=True):
                result[mine] = block[rows, prediction[mine]]
        return results
