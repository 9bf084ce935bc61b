"""Limbs that a fit has in wrong places, read anew with the other limbs out of the way.

Of people who cross their legs or fold their arms the network takes one limb for another, or misses it among them. Where a
fit is in doubt, samples of its other limbs are therefore moved to where the resting template has these, and the network is
asked again: it reads the one or two limbs that are left much better. What it reads is put together limb by limb, whatever
brings template and samples closest, and refined.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.search.discontinuities import discontinuous_share, neighbours
from meshmatch.fitting.search.limbs import Branch, Limb, Limbs, bare_places, limbs_of
from meshmatch.fitting.search.predictor import Predictor, best_first, reads_alike, weighted_mean
from meshmatch.fitting.search.refinement import WholeComparison, with_limb_bent
from meshmatch.fitting.search.task import Registration
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import kabsch
from meshmatch.geometry.oriented import OrientedPoints


@dataclass(frozen=True, kw_only=True)
class UntanglingSettings:
    """All set by hand on people who touch themselves; lengths and residuals are in units of sqrt(area).

    Attributes
    ----------
    discontinuous : share of neighbouring samples that belong far apart from which on parts touch
    samples, compared : by so many the network is asked, and what it reads is compared
    near : samples so near to a limb are moved with it
    kept : for one limb that stays where it is, and for two: tilts of the samples that are read, and typical degrees
    rounds : how often all limbs are read
    taken : limbs that are taken of one question's readings at most
    cap : a distance beyond this says no more
    gain : residual that a limb taken from a reading must bring
    margin : the fit is taken if its score is less than this times that of the fit before
    """

    discontinuous: float = 0.005
    samples: int = 2048
    compared: int = 512
    near: float = 0.08
    kept: tuple[tuple[int, float], ...] = ((5, 20.0), (4, 30.0))
    rounds: int = 2
    taken: int = 2
    cap: float = 0.1
    gain: float = 0.0002
    margin: float = 0.98


SETTINGS = UntanglingSettings()


def untangled(found: Registration) -> Registration | None:
    """A fit of a whole with its limbs read anew, where parts touch or places are bare, and where that is better."""
    task, best, limbs = found.task, found.candidate, limbs_of(found.task.model)
    if not (limbs.branches and task.samples.signed and reads_alike(task.model)):
        return None
    few = task.coarse
    local = few.to_local(best.pose)
    torn = discontinuous_share(task.system, neighbours(few), local, best.vectors) >= SETTINGS.discontinuous
    if not (torn or bare_places(local, task.system.surface(best.vectors))):
        return None
    predictor = replace(task.predictor, rng=np.random.default_rng(task.config.seed))
    everything = task.samples.to_local(best.pose)
    readings = best_first(predictor.variants(everything, local, best.pose, task.config.variants, task.config.tilt))
    comparison = WholeComparison(task, readings)
    start = comparison.averaged(readings[0])
    read = replace(best, vectors=_read_anew(predictor, limbs, local.first(SETTINGS.samples), start.vectors))
    fit = with_limb_bent(comparison, read, comparison.refined(read, in_full=True))
    better = comparison.score(fit, False) < SETTINGS.margin * comparison.score(best, False)
    return replace(found, candidate=fit) if better else None


def _read_anew(
    predictor: Predictor, limbs: Limbs, samples: OrientedPoints, vectors: Float[Floats, "K 3"]
) -> Float[Floats, "K 3"]:
    """Node vectors whose limbs are taken from readings of samples (core frame) with the other limbs at rest."""
    system = predictor.system
    whole = _Composed(system, samples.first(SETTINGS.compared), vectors)
    for _ in range(SETTINGS.rounds):
        before = whole.residual
        for count in range(len(SETTINGS.kept), 0, -1):
            tilts, degrees = SETTINGS.kept[count - 1]
            for kept in combinations(limbs.branches, count):
                asked = _at_rest(system, samples, whole.vectors, [each for each in limbs.branches if each not in kept])
                readings = predictor.readings(asked, tilts, degrees)
                whole = _with_best_limbs(whole, readings, kept)
        if whole.residual > before - SETTINGS.gain:
            break
    return whole.vectors


def _at_rest(
    system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"], branches: list[Branch]
) -> OrientedPoints:
    """Samples with those of some limbs moved, as rigid pieces, to where the resting template has them."""
    surface = system.surface(vectors)
    nearest = surface.tree.query(samples.features)[1]
    close = np.linalg.norm(samples.points - surface.points[nearest], axis=1) < SETTINGS.near
    points, normals = samples.points.copy(), samples.normals.copy()
    for branch in branches:
        held = kabsch(system.verts[branch.holder], surface.points[branch.holder])
        for piece in branch.pieces:
            at = close & np.isin(nearest, piece)
            motion = kabsch(surface.points[piece], held.to_world(system.verts[piece]))
            points[at], normals[at] = motion.to_world(points[at]), normals[at] @ motion.rotation.T
    return replace(samples, points=points, normals=normals)


class _Composed:
    """Node vectors, and how far template and samples (core frame) are apart under them."""

    def __init__(self, system: NodeSystem, samples: OrientedPoints, vectors: Float[Floats, "K 3"]) -> None:
        self.system, self.samples, self.vectors = system, samples, vectors
        self.surface = system.surface(vectors)
        self.there = self.there_of(self.surface)
        self.residual = self._residual(self.there.sum(), self.back_to(self.surface))
        self._without: dict[Limb, tuple[float, Floats]] = {}

    def there_of(self, surface: OrientedPoints) -> Float[Floats, " N"]:
        """How far some of the template is from the samples."""
        distance = self.samples.tree.query(surface.features, distance_upper_bound=SETTINGS.cap)[0]
        return np.minimum(distance, SETTINGS.cap)

    def back_to(self, surface: OrientedPoints) -> Float[Floats, " S"]:
        """How far the samples are from some of the template."""
        distance = surface.tree.query(self.samples.features, distance_upper_bound=SETTINGS.cap)[0]
        return np.minimum(distance, SETTINGS.cap)

    def residual_with(self, limb: Limb, there: float, back: Float[Floats, " S"]) -> float:
        """The residual with a limb elsewhere, whose distances are given: there their sum."""
        if limb not in self._without:
            others = np.ones(len(self.surface.points), bool)
            others[limb.verts] = False
            self._without[limb] = float(self.there[others].sum()), self.back_to(self.surface.rows(others))
        rest, rest_back = self._without[limb]
        return self._residual(rest + there, np.minimum(rest_back, back))

    def with_limb(self, limb: Limb, reading: Float[Floats, "K 3"]) -> _Composed:
        """The same with a limb as it is read."""
        vectors = self.vectors + limb.share[:, None] * (reading - self.vectors)
        return _Composed(self.system, self.samples, vectors)

    def _residual(self, there: float, back: Floats) -> float:
        return float(0.5 * there / len(self.surface.points) + 0.5 * weighted_mean(back, self.samples.weights))


def _with_best_limbs(whole: _Composed, readings: list[Floats], kept: tuple[Branch, ...]) -> _Composed:
    """What is put together, with the limbs of readings that bring it closest to the samples."""
    limbs = [limb for branch in kept for limb in branch.limbs]
    if len(kept) > 1:
        limbs.append(Branch.together(kept))
    verts = np.concatenate([branch.limbs[0].verts for branch in kept])
    found = []
    for reading in readings:
        surface = whole.system.surface(reading)
        there = np.zeros(len(surface.points))
        there[verts] = whole.there_of(surface.rows(verts))
        found += [(limb, reading, there[limb.verts].sum(), whole.back_to(surface.rows(limb.verts))) for limb in limbs]
    for _ in range(SETTINGS.taken):
        limb, reading = min(found, key=lambda each: whole.residual_with(each[0], *each[2:]))[:2]
        closer = whole.with_limb(limb, reading)
        if closer.residual > whole.residual - SETTINGS.gain:
            break
        whole = closer
    return whole
