"""Which of several interpretations of a pose is right, where the surface alone hardly tells.

A crossed arm taken for the other one lies on the surface as well as the right one does. But points that are neighbours
on the shape then belong far apart on the template: the map is discontinuous. Interpretations that differ are each
refined in full, and judged by both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.network_fit import Candidate, weighted_mean
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.topology import is_discontinuous
from meshmatch.progress import Progress

# All of these were set by hand. Lengths and residuals are in units of sqrt(area).
_NEIGHBOURS = 6
_DISCONTINUITY_COST = 0.1  # residual that a map discontinuous everywhere is worse by
_CAP = 0.1  # beyond it a distance says no more
# Interpretations differ where this share of the template's vertices lies that far apart.
_SHARE, _FAR = 0.02, 0.1
# Interpretations closer than that are the same, and of these so many at most are averaged.
_NEAR, _MAX_AVERAGED = 0.05, 8
_POOL = 24  # among how many of the best those that are unlike each other are looked for
# One whose score is so many times the best one's after a few steps never caught up: on 78 bodies of SCAPE, FAUST and
# SHREC'19 the order changed within 1.004.
_BEHIND = 1.05

Interpretation = TypeVar("Interpretation")


class Comparison(Protocol[Interpretation]):
    """How interpretations are refined and told apart."""

    def refined(self, candidate: Interpretation, in_full: bool) -> Interpretation:
        """An interpretation after all steps of its refinement, or after a few."""

    def score(self, candidate: Interpretation, in_full: bool) -> float:
        """How well an interpretation fits that was refined in full, or a little; lower is better."""

    def vertices(self, candidate: Interpretation) -> Float[Floats, "V 3"]:
        """Where an interpretation has the template's vertices, in one frame for all."""


def choose(
    candidates: Sequence[Interpretation], count: int, comparison: Comparison[Interpretation], progress: Progress
) -> Interpretation:
    """The best of several interpretations, refined.

    Parameters
    ----------
    candidates : best first by the network's own residual
    count : how many that are unlike each other are tried, at most
    comparison : refines and scores them
    """
    finalists: list[Interpretation] = []
    known: list[Floats] = []
    for candidate in candidates[:_POOL]:
        verts = comparison.vertices(candidate)
        if len(finalists) < count and all(differ(verts, each) for each in known):
            finalists.append(candidate)
            known.append(verts)
    if len(finalists) > 1:
        finalists = _screened(finalists, comparison, progress)
    refined = []
    for number, candidate in enumerate(finalists):
        refined.append(comparison.refined(candidate, in_full=True))
        progress(0.6 + 0.4 * (number + 1) / len(finalists))
    return min(refined, key=lambda each: comparison.score(each, True)) if len(refined) > 1 else refined[0]


def _screened(
    candidates: list[Interpretation], comparison: Comparison[Interpretation], progress: Progress
) -> list[Interpretation]:
    """Those of several interpretations that a few steps neither bring together nor leave far behind, best first."""
    rough = []
    for number, candidate in enumerate(candidates):
        found = comparison.refined(candidate, in_full=False)
        rough.append((comparison.score(found, False), candidate, comparison.vertices(found)))
        progress(0.6 * (number + 1) / len(candidates))
    rough.sort(key=lambda entry: entry[0])
    kept: list[tuple[Interpretation, Floats]] = []
    for score, candidate, verts in rough:
        if score <= _BEHIND * rough[0][0] and all(differ(verts, other) for _, other in kept):
            kept.append((candidate, verts))
    return [candidate for candidate, _ in kept]


class CandidateScorer:
    """Scores candidates for one set of samples: the lower the better.

    Parameters
    ----------
    system : NodeSystem
    samples : OrientedPoints
        In any frame and size; who is whose neighbour is read off them.
    roughness : float
        Of a cloud (0..1, see `Shape.roughness`): normals estimated from noise say little, and squares tell a limb that
        lies beside its points from one whose points scatter about it.
    """

    def __init__(self, system: NodeSystem, samples: OrientedPoints, roughness: float = 0.0) -> None:
        self._system, self._roughness = system, roughness
        count = min(_NEIGHBOURS + 1, len(samples.points))
        index = samples.tree.query(samples.tree.data, count)[1]
        self._from = np.repeat(np.arange(len(index)), index.shape[1] - 1)
        self._to = index[:, 1:].reshape(-1)

    def score(self, local: OrientedPoints, candidate: Candidate) -> float:
        """Residual of a candidate and a cost for discontinuities; ``local``: the same samples in its core frame."""
        residual, rough = candidate.residual, self._roughness
        if rough > 0:
            residual += rough * (self.scatter(local, candidate.vectors) - residual)
        return residual + _DISCONTINUITY_COST * self.discontinuous_share(local, candidate.vectors)

    def scatter(self, local: OrientedPoints, vectors: Float[Floats, "K 3"]) -> float:
        """Root of the mean squared distance of nearest points, both ways, normals left out (units of sqrt(area))."""
        moved = self._system.moved(vectors)
        forward = cKDTree(local.points).query(moved, distance_upper_bound=_CAP)[0]
        back = cKDTree(moved).query(local.points, distance_upper_bound=_CAP)[0]
        squares = [np.square(np.minimum(distance, _CAP)) for distance in (forward, back)]
        return float(np.sqrt(0.5 * (squares[0].mean() + weighted_mean(squares[1], local.weights))))

    def discontinuous_share(self, local: OrientedPoints, vectors: Float[Floats, "K 3"]) -> float:
        """Share (0..1) of neighbours among the samples that belong far apart on the template."""
        surface = self._system.surface(vectors)
        local = local.facing(surface)
        home = self._system.verts[surface.tree.query(local.features)[1]]
        start, end = self._from, self._to
        length = np.linalg.norm(local.points[start] - local.points[end], axis=1)
        apart = is_discontinuous(np.linalg.norm(home[start] - home[end], axis=1), length)
        weights = None if local.weights is None else local.weights[start] * local.weights[end]
        return float(weighted_mean(apart, weights))


def differ(here: Float[Floats, "V 3"], there: Float[Floats, "V 3"], far: float = _FAR) -> bool:
    """Whether two interpretations have parts of the template in different places."""
    return bool((np.linalg.norm(here - there, axis=1) > far).mean() > _SHARE)


def averaged(system: NodeSystem, chosen: Candidate, candidates: Sequence[Candidate]) -> Candidate:
    """A candidate with the mean node vectors of those that agree with it in the same core frame; best first.

    Each prediction errs in its own way, and its stretch is what the refinement holds on to.
    """
    here = system.moved(chosen.vectors)
    alike = [
        other.vectors
        for other in candidates
        if other.pose is chosen.pose and not differ(here, system.moved(other.vectors), _NEAR)
    ]
    return replace(chosen, vectors=np.mean(alike[:_MAX_AVERAGED], axis=0)) if alike else chosen
