"""One shape fitted to another without a model: guesses of where its vertices belong, fitted coarse to fine.

Proposals (`meshmatch.fitting.search.proposals`) are fitted on few nodes, all for a few steps, then those that look better,
and the best of these on more nodes. Their energies say which is right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Literal, Protocol, TypeVar

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.fit_config import NodeRefineConfig, Schedule
from meshmatch.fitting.judge.direct import DirectFeatures
from meshmatch.fitting.search.discontinuities import Pairs, neighbours
from meshmatch.fitting.search.intrinsic import Intrinsic, ThinMesh
from meshmatch.fitting.search.proposals import (
    Proposal,
    differ,
    extremity_proposals,
    rigid_proposals,
    spectral_proposals,
)
from meshmatch.fitting.solve.driver import Problem, minimise
from meshmatch.fitting.solve.priors import Prior, RotatedReference, ViscousGradient
from meshmatch.fitting.solve.surface_nodes import SurfaceNodes
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import GoalTerm, LandmarkTerm, PairTerm, Term
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.progress import Progress
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_calls, parallel_map

_HEAVY, _LIGHT = 60_000, 24_000  # triangles: a mesh with more is thinned to so many at once, which takes long
KnownPairs = tuple[Float[Floats, "N 3"], Float[Floats, "N 3"]]
"""Positions on the source and on the target that belong together."""
BothWays = Literal["no", "in doubt", "always"]
_KNOWN_WEIGHT = 0.05  # of each known pair; all other pairs together have about 1
_BEGUN = "features.energy_begun"
_NEAR = 3  # vertices of the coarse mesh by which one of the fine mesh moves


def _pairs(
    steps: int,
    prior: tuple[float, float],
    scale: tuple[float, float],
    back: int,
    along: float = 0.1,
    momentum: float = 0.0,
) -> NodeRefineConfig:
    schedule = Schedule(steps=steps, prior=prior, scale=scale, damping=1e-6, momentum=momentum)
    return NodeRefineConfig(schedule=schedule, point_share=along, back_points=back)


_COARSE_NODES = SurfaceNodes(K=120, radius=0.2, gradient_points=400)
_FINE_NODES = SurfaceNodes(K=320, radius=0.13)


@dataclass(frozen=True, kw_only=True)
class DirectConfig:
    """How two shapes are matched without a model; lengths in units of sqrt(area). Set by hand on 30 pairs of 15 kinds;
    ``third``, ``along`` and ``gliding`` on these and six pairs of FAUST.

    Attributes
    ----------
    coarse, fine : triangles of the thinned meshes that are fitted first and last
    samples, few, fewer : points of the target: for the last fits, for the better coarse ones, and for all
    coarse_nodes, fine_nodes : nodes of both meshes
    first, second, third, last : least squares of all proposals, of the better ones, of the best on the fine mesh, of which
        the energies decide, and of the one that is taken, which may stretch more
    along : least squares that go on from the third of those with the lowest energies, and are kept where they lower it:
        samples hold vertices across the surface only, so that a limb glides along itself until its end is at an end
    better, best, gliding, returned : how many proposals are fitted a second, and a third time, and glide, of one way and of
        both, and how many of each direction are continued in the other one
    unlike : share of vertices by which these differ at least
    both_ways : when the target is fitted to the source as well; "in doubt" is where one way alone is not likely to be right
    from_source : whether the source is to be the template both ways too, and not the one that fits the other better
    seed : of all random numbers
    """

    coarse: int = 2400
    fine: int = 6000
    samples: int = 8000
    few: int = 2500
    fewer: int = 1200
    coarse_nodes: SurfaceNodes = _COARSE_NODES
    fine_nodes: SurfaceNodes = _FINE_NODES
    first: NodeRefineConfig = field(default_factory=lambda: _pairs(4, (3e-3, 1e-3), (0.12, 0.07), 1200))
    second: NodeRefineConfig = field(default_factory=lambda: _pairs(8, (1e-3, 1e-4), (0.1, 0.03), 1500))
    third: NodeRefineConfig = field(default_factory=lambda: _pairs(8, (3e-4, 1e-4), (0.06, 0.02), 4000, 0.1, 0.6))
    along: NodeRefineConfig = field(default_factory=lambda: _pairs(24, (3e-4, 1e-4), (0.06, 0.02), 4000, 0.02, 0.8))
    last: NodeRefineConfig = field(default_factory=lambda: _pairs(6, (1e-4, 3e-5), (0.03, 0.02), 4000))
    better: int = 16
    best: int = 6
    gliding: int = 2
    returned: int = 3
    unlike: float = 0.03
    both_ways: BothWays = "in doubt"
    from_source: bool = False
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Level:
    """A thinned shape, its least squares, and the prior by which its parts may stretch."""

    mesh: ThinMesh
    system: NodeSystem
    viscous: ViscousGradient
    known: tuple[LandmarkTerm, ...]

    @classmethod
    def of(cls, mesh: ThinMesh, nodes: SurfaceNodes, known: KnownPairs | None, seed: int) -> Level:
        terms: tuple[LandmarkTerm, ...] = ()
        if known is not None:
            nearest = np.asarray(cKDTree(mesh.verts).query(known[0])[1])
            terms = (LandmarkTerm((nearest, known[1]), _KNOWN_WEIGHT),)
        return cls(mesh, *nodes.system(mesh.shape, mesh.graph, seed), terms)

    def features(
        self, onto: ThinMesh, samples: OrientedPoints, vectors: Float[Floats, "K 3"], pairs: Pairs | None = None
    ) -> DirectFeatures:
        """Of node vectors; how far known pairs are missed counts as a residual."""
        found = DirectFeatures.of(self.system, samples, vectors, pairs)
        found = replace(found, likeness=self.mesh.likeness(onto, self.system.surface(vectors)))
        for term in self.known:
            at, goal = term.landmarks
            off = np.linalg.norm(self.system.moved(vectors)[at] - goal, axis=1).mean()
            found = replace(found, residual=found.residual + float(off))
        return found

    @property
    def rigid(self) -> Prior:
        """As rigid as possible, about the shape as it is."""
        return RotatedReference(np.tile(np.eye(3), (len(self.system.gradient_points), 1, 1)))

    def limbs_onto(self, at: Int[Ints, " N"], goals: Float[Floats, "N 3"]) -> Float[Floats, "K 3"]:
        """Node vectors that bring some vertices to their goals, from the rigid motion that does it best."""
        start = self.system.vectors_to(kabsch(self.mesh.verts[at], goals).to_world(self.mesh.verts))
        terms = [LandmarkTerm((at, goals), 1 / len(at)), *self.known]
        return minimise(Problem(system=self.system, terms=terms, schedule=_LIMBS_ONTO), self.rigid, start)

    def begun(self, proposal: Proposal) -> Float[Floats, "K 3"]:
        """Near a proposal; limbs may be longer or shorter than its own."""
        if proposal.at is not None:
            return self.limbs_onto(proposal.at, proposal.points)
        if proposal.kind in ("rigid", "affine"):
            return self.system.vectors_to(proposal.points)
        terms: list[Term] = [GoalTerm(proposal.points), *self.known]
        problem = Problem(system=self.system, terms=terms, schedule=_ONTO)
        return minimise(problem, self.viscous, np.zeros((self.system.K, 3)))

    def refined(
        self,
        samples: OrientedPoints,
        vectors: Float[Floats, "K 3"],
        config: NodeRefineConfig,
        prior: Prior | None = None,
    ) -> Float[Floats, "K 3"]:
        """Node vectors after pairing with the samples of the target."""
        facing = samples.facing(self.system.surface(vectors))
        terms: list[Term] = [PairTerm(facing, config), *self.known]
        problem = Problem(system=self.system, terms=terms, schedule=config.schedule)
        return minimise(problem, prior or self.rigid, vectors)

    def tried(
        self,
        onto: ThinMesh,
        samples: OrientedPoints,
        proposal: Proposal,
        vectors: Float[Floats, "K 3"],
        how: NodeRefineConfig,
        pairs: Pairs | None = None,
    ) -> Tried:
        """A proposal, refined from node vectors, and how well that fits."""
        vectors = self.refined(samples, vectors, how)
        features = self.features(onto, samples, vectors, pairs)
        return Tried(proposal, vectors, self.system.moved(vectors), features)


_ONTO = Schedule(steps=6, prior=(3e-2, 1e-3), scale=(1.0, 0.3), damping=1e-6)
_LIMBS_ONTO = Schedule(steps=8, prior=(3e-2, 3e-3), damping=1e-6)


@dataclass(frozen=True, eq=False)
class Tried:
    """Node vectors of one proposal, where they take the vertices, and how well; whether they went on along the surface."""

    proposal: Proposal
    vectors: Float[Floats, "K 3"]
    moved: Float[Floats, "V 3"]
    features: DirectFeatures
    glided: bool = False

    @property
    def energy(self) -> float:
        return self.features.energy


@dataclass(frozen=True, eq=False)
class Side:
    """One of two shapes; what it needs to be fitted to the other one, and the other one to it.

    ``frame`` is that of its file; all else is in units of sqrt(area). ``light`` is the shape, or one with fewer triangles
    from which those that are fitted are thinned, ``thin`` the coarse one, and ``known`` are positions (N, 3) on it, and
    (N, 3) on the other one.
    """

    original: Shape
    frame: Frame
    shape: Shape
    light: Shape
    thin: ThinMesh
    known: KnownPairs | None
    config: DirectConfig

    @cached_property
    def coarse(self) -> Level:
        return Level.of(self.thin, self.config.coarse_nodes, self.known, self.config.seed)

    @cached_property
    def fine_mesh(self) -> ThinMesh:
        return ThinMesh.of(self.light, self.config.fine)

    @cached_property
    def fine(self) -> Level:
        return Level.of(self.fine_mesh, self.config.fine_nodes, self.known, self.config.seed)

    @cached_property
    def intrinsic(self) -> Intrinsic:
        return Intrinsic(self.thin)

    @cached_property
    def samples(self) -> OrientedPoints:
        return sample_surface(self.shape, self.config.samples, np.random.default_rng(self.config.seed))

    @cached_property
    def neighbours(self) -> Pairs:
        return neighbours(self.samples)


def lightened(shape: Shape) -> Shape:
    """The shape, or one that is thinned faster."""
    return ThinMesh.of(shape, _LIGHT).shape if shape.F > _HEAVY else shape


def finished(
    own: Side, onto: Side, begun: Sequence[tuple[Proposal, Float[Floats, "V 3"]]], report: Progress
) -> list[Tried]:
    """The fine mesh of one shape fitted to another from where its vertices (V, 3) may belong, for each proposal."""
    report(0.0)
    _ = own.fine, onto.neighbours, onto.fine_mesh.relief, onto.fine_mesh.tree  # once, and not by each thread
    found = parallel_map(lambda each: finish(own, onto, *each), begun)
    report(1.0)
    return found


def finish(own: Side, onto: Side, proposal: Proposal, goals: Float[Floats, "V 3"]) -> Tried:
    """One of these fits."""
    return _fine(own, onto, proposal, own.fine.system.vectors_to(goals), own.config.third)


def glided(own: Side, onto: Side, tried: Sequence[Tried], report: Progress) -> list[Tried]:
    """Fine fits that go on along the surface, if they have not; each as it was where that does not lower its energy."""
    report(0.0)
    found = parallel_map(lambda each: glide(own, onto, each), tried)
    report(1.0)
    return found


def glide(own: Side, onto: Side, tried: Tried) -> Tried:
    """One of these fits."""
    if tried.glided:
        return tried
    found = _fine(own, onto, tried.proposal, tried.vectors, own.config.along)
    return replace(min(tried, found, key=attrgetter("energy")), glided=True)


def _fine(own: Side, onto: Side, proposal: Proposal, vectors: Float[Floats, "K 3"], how: NodeRefineConfig) -> Tried:
    return own.fine.tried(onto.fine_mesh, onto.samples, proposal, vectors, how, onto.neighbours)


def fitted(
    own: Side, onto: Side, guess: KnownPairs | None, report: Progress, meanwhile: Sequence[Callable[[], object]] = ()
) -> list[Tried]:
    """The best fits of one shape to another, best first; ``guess`` is one more proposal. What is to be done ``meanwhile`` is
    called where a thread would wait."""
    config, rested = own.config, own.thin.verts
    guesses = [] if guess is None else [Proposal("guess", carried(rested, *guess))]
    begun = _begun(own, onto, guesses, report.named("guesses without a model").between(0.0, 0.6), meanwhile)
    tried = _better(own, onto, begun, report.named("fits of the better guesses").between(0.6, 0.8))
    verts = own.fine.mesh.verts
    goals = [(each.proposal, verts + carried(verts, rested, each.moved - rested)) for each in tried]
    for each in guesses:  # its energy is asked for
        if all(other.proposal is not each for other in tried):
            goals.append((each, verts + carried(verts, rested, each.points - rested)))
    report = report.named("fits of the best guesses").between(0.8, 1.0)
    found = finished(own, onto, goals, report.between(0.0, 0.6))
    best = distinct(found, config.gliding, config.unlike)
    rest = [each for each in found if each not in best]
    return sorted([*glided(own, onto, best, report.between(0.6, 1.0)), *rest], key=attrgetter("energy"))


def _begun(
    own: Side, onto: Side, guesses: list[Proposal], report: Progress, meanwhile: Sequence[Callable[[], object]]
) -> list[Tried]:
    """Guesses of all kinds, fitted on few nodes for a few steps.

    To know lengths along the surface takes long, and keeps Python's lock. So the rigid guesses and their fits, what later
    fits need, and what else is to be done are done beside that.
    """
    level, samples = own.coarse, onto.samples.first(own.config.fewer)
    _ = onto.thin.relief, onto.thin.tree, own.thin.normals  # once, and not by each thread

    def tried(proposal: Proposal) -> Tried:
        return level.tried(onto.thin, samples, proposal, level.begun(proposal), own.config.first)

    def bent() -> list[Proposal]:
        pair = own.intrinsic, onto.intrinsic
        return [*extremity_proposals(*pair), *spectral_proposals(*pair)]

    def rigid() -> list[Tried]:
        return [tried(each) for each in rigid_proposals(own.thin, onto.thin)]

    def next_level() -> None:
        _ = onto.neighbours, onto.fine_mesh.relief, onto.fine_mesh.tree

    report(0.0)
    others, found, *_ = parallel_calls((bent, rigid, lambda: own.fine, *meanwhile, next_level))
    report(0.6)
    found = [*found, *parallel_map(tried, [*others, *guesses])]
    report(1.0)
    return found


def _better(own: Side, onto: Side, begun: list[Tried], report: Progress) -> list[Tried]:
    """Those that look better, fitted on few nodes for more steps; the best, no two alike."""
    config, samples = own.config, onto.samples.first(own.config.few)
    pairs = neighbours(samples)

    def tried(each: Tried) -> Tried:
        return own.coarse.tried(onto.thin, samples, each.proposal, each.vectors, config.second, pairs)

    report(0.0)
    found = parallel_map(tried, distinct(begun, config.better, config.unlike, _BEGUN))
    report(1.0)
    return distinct(found, config.best, config.unlike, _BEGUN)


def carried(
    points: Float[Floats, "V D"], at: Float[Floats, "T D"], values: Float[Floats, "T 3"]
) -> Float[Floats, "V 3"]:
    """Values at some points carried to others, from the nearest ones."""
    distance, near = cKDTree(at).query(points, _NEAR)
    weights = 1 / (np.asarray(distance) + 1e-3)
    return np.asarray((weights[..., None] * values[near]).sum(1) / weights.sum(1, keepdims=True))


class _Fitted(Protocol):
    @property
    def energy(self) -> float: ...

    @property
    def moved(self) -> Float[Floats, "V 3"]: ...


F = TypeVar("F", bound=_Fitted)


def distinct(tried: Sequence[F], count: int, unlike: float, by: str = "energy") -> list[F]:
    """The best of the fits, no two of which are alike."""
    kept: list[F] = []
    for each in sorted(tried, key=attrgetter(by)):
        if len(kept) < count and all(differ(each.moved, other.moved) > unlike for other in kept):
            kept.append(each)
    return kept
