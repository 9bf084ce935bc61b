"""Labels of a new shape by the votes of labelled ones that are fitted to it; no network, no training.

Furniture stands upright and fills its box, so shapes are compared, and brought onto each other, with their boxes stretched
to one cube. The labelled shapes nearest to a new one (points and normals, both ways) are fitted to it as those of a
collection (`experiments.collection`). A point takes the label that the nearest points of these fits, which face the same
way, give it together: a fit that stays further from the shape, or from the point, counts less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments.collection import system_of, thinned
from meshmatch.experiments.furniture import furniture
from meshmatch.experiments.furniture_models import Learned
from meshmatch.fitting.system import NodeSystem
from meshmatch.fitting.viscous import ViscousConfig, viscous_vectors
from meshmatch.geometry.oriented import OrientedPoints, with_normals
from meshmatch.shapes.shape import Shape

_NORMALS = 0.1  # how much normals count beside positions, of shapes of radius 1
_FITS = ViscousConfig(
    **{"nodes": 320, "radius": 0.2, "faces": 6000, "samples": 6000, "steps": 10, "back_points": 3000},  # type: ignore[arg-type]
    **{"strain_last": 1e-5, "point_share": 0.1, "pair_normals": 0.06, "near": 12},  # type: ignore[arg-type]
)


@dataclass(frozen=True)
class VoteConfig:
    """Who votes; lengths in radii of the new shape. Set by hand on twelve tables."""

    labelled: int = 24  # shapes that stand for all
    voters: int = 6  # of them that are fitted
    pool: int = 120  # from which the labelled ones are chosen
    compared: int = 400  # points
    margin: float = 0.01  # a fit whose residual is so much larger than the best one's counts e times less
    reach: float = 0.05  # a point so far from the fit counts e times less
    fits: ViscousConfig = field(default_factory=lambda: _FITS)


def boxed(shape: OrientedPoints, center: Floats, half: Floats) -> OrientedPoints:
    """Points with the box of this center and these half sides stretched to a cube of side 2, and the normals there."""
    normals = shape.normals * half
    return OrientedPoints((shape.points - center) / half, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def box_of(points: Float[Floats, "N 3"]) -> tuple[Floats, Floats]:
    """Center and half sides of the box of points."""
    low, high = points.min(0), points.max(0)
    return (low + high) / 2, (high - low) / 2


def _features(shape: OrientedPoints) -> Float[Floats, "N 6"]:
    return with_normals(shape.points, shape.normals, _NORMALS)


def apart(a: Float[Floats, "N 6"], b: Float[Floats, "M 6"]) -> float:
    """Sum of the mean distances from either of two sets to the other."""
    return float(cKDTree(a).query(b)[0].mean() + cKDTree(b).query(a)[0].mean())


def covering(shapes: Sequence[Float[Floats, "N 6"]], pool: int, count: int) -> list[int]:
    """Numbers of ``count`` of the first ``pool`` shapes that together lie nearest to every fourth shape, best first."""
    others = range(0, len(shapes), 4)
    far = np.array([[apart(shapes[k], shapes[n]) for n in others] for k in range(min(pool, len(shapes)))])
    chosen: list[int] = []
    nearest = np.full(len(others), np.inf)
    for _ in range(min(count, len(far))):
        cost = np.minimum(far, nearest).mean(1)
        cost[chosen] = np.inf
        chosen.append(int(cost.argmin()))
        nearest = np.minimum(nearest, far[chosen[-1]])
    return chosen


@dataclass(frozen=True, eq=False)
class Voter:
    """A labelled mesh, around the center of its box."""

    shape: Shape
    labels: Int[Ints, " V"]
    config: ViscousConfig

    @classmethod
    def of(cls, kind: str, seed: int, number: int, config: ViscousConfig) -> Voter:
        """A generated shape at area 1."""
        made = furniture(kind, seed, number)
        thin = thinned(made.surface, config.faces)
        verts = (thin.verts - box_of(thin.verts)[0]) / np.sqrt(thin.area)
        return cls(Shape(verts, thin.faces, f"{kind}{number}"), made.parts_at(thin.verts), config)

    @cached_property
    def system(self) -> NodeSystem:
        """Its nodes."""
        return system_of(self.shape, self.config)

    def on(self, samples: OrientedPoints) -> OrientedPoints:
        """Its vertices on a shape of boxed samples, boxed too."""
        half = box_of(self.shape.verts)[1]
        vectors = viscous_vectors(self.system, boxed(samples, np.zeros(3), 1 / half), self.config)
        moved = self.system.moved(vectors)
        return boxed(OrientedPoints(moved, self.system.normals(moved)), np.zeros(3), half)


class Electorate:
    """Labelled shapes, and how a new one gets its labels from them."""

    def __init__(self, kind: str, seed: int, shapes: Learned, config: VoteConfig | None = None) -> None:
        self.config = config or VoteConfig()
        few = slice(self.config.compared)
        seen = []
        for points, normals in zip(
            shapes.points[:, few].astype(float), shapes.normals[:, few].astype(float), strict=True
        ):
            seen.append(_features(boxed(OrientedPoints(points, normals), *box_of(points))))
        self.numbers = covering(seen, self.config.pool, self.config.labelled)
        self._seen = [seen[k] for k in self.numbers]
        self._voters = [Voter.of(kind, seed, k, self.config.fits) for k in self.numbers]

    def labels(self, samples: OrientedPoints, points: OrientedPoints) -> Int[Ints, " N"]:
        """Labels of points of a new shape, of which there are samples too."""
        center, half = box_of(samples.points)
        whole = boxed(samples, center, half)
        few = _features(whole.first(self.config.compared))
        near = np.argsort([apart(each, few) for each in self._seen], kind="stable")[: self.config.voters]
        voters = [self._voters[k] for k in near]
        size = half / np.linalg.norm(half)
        own = [boxed(each, np.zeros(3), 1 / size) for each in (whole, boxed(points, center, half))]
        fitted = [boxed(each.on(whole), np.zeros(3), 1 / size) for each in voters]
        return vote(fitted, [each.labels for each in voters], own[0], own[1], self.config)


def vote(
    fitted: Sequence[OrientedPoints],
    labels: Sequence[Int[Ints, " V"]],
    shape: OrientedPoints,
    points: OrientedPoints,
    config: VoteConfig,
) -> Int[Ints, " N"]:
    """The label of every point that fits, each of labelled vertices, give together; all of a shape of radius 1."""
    seen, asked = _features(shape.first(3000)), _features(points)
    residuals = np.array([apart(_features(each), seen) for each in fitted])
    sure = np.exp(-(residuals - residuals.min()) / config.margin)
    votes = np.zeros((len(asked), 1 + max(int(each.max()) for each in labels)))
    for each, known, weight in zip(fitted, labels, sure, strict=True):
        distance, at = cKDTree(_features(each)).query(asked)
        votes[np.arange(len(asked)), known[at]] += weight * np.exp(-np.square(distance / config.reach)) + 1e-12
    return votes.argmax(1)
