"""Which of several readings of a pose is right, where the surface alone hardly tells.

A crossed arm taken for the other one lies on the surface as well as the right one does. But points that are neighbours
on the shape then belong far apart on the template: the map is torn. Readings that differ are each fitted to the end,
and judged by both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.network_fit import Candidate
from meshmatch.fitting.scan import Scan, with_normals
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.topology import is_discontinuous

_NEIGHBOURS = 6
_TORN_COST = 0.1  # residual that a map torn everywhere is worse by
_CAP = 0.1  # beyond it a distance says no more
# Readings differ where this share of the template's vertices lies that far apart.
_SHARE, _FAR = 0.02, 0.1
# So near are readings that say the same, of which this many at most are averaged.
_NEAR, _ALIKE = 0.05, 8
# How many readings unlike the finalists are tried too, and among how many they are sought.
_STRANGERS, _POOL = 3, 24

Reading = TypeVar("Reading")


class CandidateScorer:
    """Scores fits of one scan: the lower the better.

    ``roughness`` (0..1, see `Shape.roughness`) of a cloud: normals estimated from noise say little, and squares tell a
    limb that lies beside its points from one whose points scatter about it.
    """

    def __init__(self, system: NodeSystem, scan: Scan, roughness: float = 0.0) -> None:
        self._system, self._roughness = system, roughness
        index = scan.tree.query(
            with_normals(scan.points, scan.normals), min(_NEIGHBOURS + 1, len(scan.points))
        )[1]
        self._from = np.repeat(np.arange(len(index)), index.shape[1] - 1)
        self._to = index[:, 1:].reshape(-1)

    def score(self, scan: Scan, candidate: Candidate) -> float:
        """Residual of a candidate and what it tears; ``scan`` holds the same samples in its core frame and size."""
        residual, rough = candidate.residual, self._roughness
        if rough > 0:
            residual += rough * (self.scatter(scan, candidate.vectors) - residual)
        return residual + _TORN_COST * self.torn(scan, candidate.vectors)

    def scatter(self, scan: Scan, vectors: np.ndarray) -> float:
        """Root of the mean squared distance of nearest points, both ways, normals left out (units of sqrt(area))."""
        moved = self._system.moved(vectors)
        forward = cKDTree(scan.points).query(moved, distance_upper_bound=_CAP)[0]
        back = cKDTree(moved).query(scan.points, distance_upper_bound=_CAP)[0]
        squares = [np.square(np.minimum(apart, _CAP)).mean() for apart in (forward, back)]
        return float(np.sqrt(0.5 * (squares[0] + squares[1])))

    def torn(self, scan: Scan, vectors: np.ndarray) -> float:
        """Share (0..1) of neighbours on the scan that belong far apart on the template."""
        moved = self._system.moved(vectors)
        normals = self._system.normals(moved)
        scan, tree = scan.facing(moved, normals), cKDTree(with_normals(moved, normals))
        belongs = self._system.verts[tree.query(with_normals(scan.points, scan.normals))[1]]
        length = np.linalg.norm(scan.points[self._from] - scan.points[self._to], axis=1)
        return float(is_discontinuous(belongs[self._from], belongs[self._to], length).mean())


def choose(
    readings: Sequence[Reading],
    count: int,
    fitted: Callable[[Reading, bool], Reading],
    score: Callable[[Reading], float],
    place: Callable[[Reading], np.ndarray],
    tell: Callable[[float], None] = lambda share: None,
) -> Reading:
    """The best of several readings, refined.

    Parameters
    ----------
    readings : best first by the network's own residual
    count : how many of the first are tried; a few that are unlike them are tried too
    fitted : refines a reading, by a few steps or, if the second argument is True, by all
    score : of a refined reading, the lower the better
    place : where a reading puts the template's vertices (V, 3), in one frame for all
    """
    finalists = list(readings[:count])
    places = [place(reading) for reading in finalists]
    for other in readings[count:_POOL]:
        there = place(other)
        if len(finalists) < count + _STRANGERS and all(differ(there, known) for known in places):
            finalists.append(other)
            places.append(there)
    screened = []
    for number, reading in enumerate(finalists):
        rough = fitted(reading, False)
        screened.append((score(rough), reading, place(rough)))
        tell(0.6 * (number + 1) / len(finalists))
    screened.sort(key=lambda entry: entry[0])
    kinds: list[tuple[Reading, np.ndarray]] = []
    for _, reading, there in screened:
        if all(differ(there, known) for _, known in kinds):
            kinds.append((reading, there))
    ends = []
    for number, (reading, _) in enumerate(kinds):
        ends.append(fitted(reading, True))
        tell(0.6 + 0.4 * (number + 1) / len(kinds))
    return min(ends, key=score) if len(ends) > 1 else ends[0]


def lying(system: NodeSystem, candidate: Candidate) -> np.ndarray:
    """Template vertices (V, 3) of a candidate in the scan frame."""
    return system.moved(candidate.vectors) @ candidate.rotation.T + candidate.center


def differ(here: np.ndarray, there: np.ndarray, far: float = _FAR) -> bool:
    """Whether two readings lay parts of the template (V, 3) at different places."""
    return bool((np.linalg.norm(here - there, axis=1) > far).mean() > _SHARE)


def averaged(system: NodeSystem, chosen: Candidate, readings: Sequence[Candidate]) -> Candidate:
    """A reading with the mean node vectors of those of one core frame that say the same; readings best first.

    Each reading errs in its own way, and its stretch is what the refinement holds on to.
    """
    here = system.moved(chosen.vectors)
    alike = [
        other.vectors
        for other in readings
        if other.rotation is chosen.rotation and not differ(here, system.moved(other.vectors), _NEAR)
    ]
    return replace(chosen, vectors=np.mean(alike[:_ALIKE], axis=0)) if alike else chosen
