"""Fit one shape to another without a model, in one direction, coarse to fine.

Proposals of where the source's vertices belong (`meshmatch.fitting.search.proposals`) are each fitted with few nodes for a
few steps; the better ones for more steps; and the best of these with more nodes. The energy of the fits decides.
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
from meshmatch.fitting.search.intrinsic import Intrinsic, SimplifiedMesh
from meshmatch.fitting.search.proposals import (
    Proposal,
    changed_share,
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

# A mesh with more triangles than the first number is simplified to the second at once, as this is slow.
_HEAVY, _LIGHT = 60_000, 24_000
KnownPairs = tuple[Float[Floats, "N 3"], Float[Floats, "N 3"]]
"""Corresponding positions on the source and on the target."""
BothWays = Literal["no", "in doubt", "always"]
_KNOWN_WEIGHT = 0.05  # per known pair; the weights of all other pairs sum to about 1
_EARLY_ENERGY = "features.early_energy"
_NEIGHBOURS = 3  # number of vertices of the coarse mesh from which a vertex of the fine mesh is interpolated


def _stage(
    steps: int,
    prior: tuple[float, float],
    scale: tuple[float, float],
    back: int,
    along: float = 0.1,
    momentum: float = 0.0,
) -> NodeRefineConfig:
    """Settings of least squares with pairs; ``back`` samples are paired, and ``along`` is the weight along the surface."""
    schedule = Schedule(steps=steps, prior=prior, scale=scale, damping=1e-6, momentum=momentum)
    return NodeRefineConfig(schedule=schedule, point_share=along, back_points=back)


_COARSE_NODES = SurfaceNodes(K=120, radius=0.2, gradient_points=400)
_FINE_NODES = SurfaceNodes(K=320, radius=0.13)


@dataclass(frozen=True, kw_only=True)
class DirectConfig:
    """How two shapes are matched without a model; lengths in units of sqrt(area).

    Set by hand on 30 pairs of 15 kinds; ``third``, ``slide`` and ``n_slid`` on these and six pairs of FAUST.

    Attributes
    ----------
    coarse, fine : number of triangles of the coarse and of the fine mesh
    samples, second_samples, first_samples : samples of the target for fits of the fine mesh, for the second fits of the
        coarse mesh, and for the first ones
    coarse_nodes, fine_nodes : nodes on the two meshes
    first, second : least squares for all proposals, and for the better ones, on the coarse mesh
    third : for the best ones, on the fine mesh; their energies decide
    slide : continues the best of these, and is kept if the energy decreases: with a weaker pull along the surface, limbs
        slide along themselves until their ends meet
    last : for the chosen fit, which may then stretch more
    n_second, n_third, n_slid : how many proposals get ``second``, ``third`` and ``slide``; the last in one direction or in
        both
    n_returned : how many fits of each direction are continued in the other one
    min_difference : smallest share of vertices at which two of these differ
    both_ways : when to fit the target to the source too; "in doubt" means if one direction alone is not likely to be right
    from_source : always use the source as the template, instead of the shape that fits the other one better
    seed : seed of all random numbers
    """

    coarse: int = 2400
    fine: int = 6000
    samples: int = 8000
    second_samples: int = 2500
    first_samples: int = 1200
    coarse_nodes: SurfaceNodes = _COARSE_NODES
    fine_nodes: SurfaceNodes = _FINE_NODES
    first: NodeRefineConfig = field(default_factory=lambda: _stage(4, (3e-3, 1e-3), (0.12, 0.07), 1200))
    second: NodeRefineConfig = field(default_factory=lambda: _stage(8, (1e-3, 1e-4), (0.1, 0.03), 1500))
    third: NodeRefineConfig = field(default_factory=lambda: _stage(8, (3e-4, 1e-4), (0.06, 0.02), 4000, 0.1, 0.6))
    slide: NodeRefineConfig = field(default_factory=lambda: _stage(24, (3e-4, 1e-4), (0.06, 0.02), 4000, 0.02, 0.8))
    last: NodeRefineConfig = field(default_factory=lambda: _stage(6, (1e-4, 3e-5), (0.03, 0.02), 4000))
    n_second: int = 16
    n_third: int = 6
    n_slid: int = 2
    n_returned: int = 3
    min_difference: float = 0.03
    both_ways: BothWays = "in doubt"
    from_source: bool = False
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Level:
    """A simplified shape at one resolution, its least-squares system, and the prior under which its parts may stretch."""

    mesh: SimplifiedMesh
    system: NodeSystem
    viscous: ViscousGradient
    known: tuple[LandmarkTerm, ...]

    @classmethod
    def of(cls, mesh: SimplifiedMesh, nodes: SurfaceNodes, known: KnownPairs | None, seed: int) -> Level:
        terms: tuple[LandmarkTerm, ...] = ()
        if known is not None:
            nearest = np.asarray(cKDTree(mesh.verts).query(known[0])[1])
            terms = (LandmarkTerm((nearest, known[1]), _KNOWN_WEIGHT),)
        return cls(mesh, *nodes.system(mesh.shape, mesh.graph, seed), terms)

    def features(
        self, onto: SimplifiedMesh, samples: OrientedPoints, vectors: Float[Floats, "K 3"], pairs: Pairs | None = None
    ) -> DirectFeatures:
        """Features of node vectors; the mean distance of known pairs is added to the residual."""
        found = DirectFeatures.of(self.system, samples, vectors, pairs)
        found = replace(found, likeness=self.mesh.likeness(onto, self.system.surface(vectors)))
        for term in self.known:
            at, goal = term.landmarks
            distance = np.linalg.norm(self.system.moved(vectors)[at] - goal, axis=1).mean()
            found = replace(found, residual=found.residual + float(distance))
        return found

    @property
    def rigid(self) -> Prior:
        """As-rigid-as-possible prior about the undeformed shape."""
        return RotatedReference(np.tile(np.eye(3), (len(self.system.gradient_points), 1, 1)))

    def vectors_reaching(self, at: Int[Ints, " N"], goals: Float[Floats, "N 3"]) -> Float[Floats, "K 3"]:
        """Node vectors that move some vertices to their goals, starting from the best rigid motion."""
        start = self.system.vectors_to(kabsch(self.mesh.verts[at], goals).to_world(self.mesh.verts))
        terms = [LandmarkTerm((at, goals), 1 / len(at)), *self.known]
        return minimise(Problem(system=self.system, terms=terms, schedule=_REACHING_SCHEDULE), self.rigid, start)

    def initial_vectors(self, proposal: Proposal) -> Float[Floats, "K 3"]:
        """Node vectors close to a proposal; the lengths of limbs may change."""
        if proposal.at is not None:
            return self.vectors_reaching(proposal.at, proposal.points)
        if proposal.kind in ("rigid", "affine"):
            return self.system.vectors_to(proposal.points)
        terms: list[Term] = [GoalTerm(proposal.points), *self.known]
        problem = Problem(system=self.system, terms=terms, schedule=_GOAL_SCHEDULE)
        return minimise(problem, self.viscous, np.zeros((self.system.K, 3)))

    def refined(
        self,
        samples: OrientedPoints,
        vectors: Float[Floats, "K 3"],
        config: NodeRefineConfig,
        prior: Prior | None = None,
    ) -> Float[Floats, "K 3"]:
        """Node vectors after least squares against samples of the target."""
        facing = samples.facing(self.system.surface(vectors))
        terms: list[Term] = [PairTerm(facing, config), *self.known]
        problem = Problem(system=self.system, terms=terms, schedule=config.schedule)
        return minimise(problem, prior or self.rigid, vectors)

    def fit_proposal(
        self,
        onto: SimplifiedMesh,
        samples: OrientedPoints,
        proposal: Proposal,
        vectors: Float[Floats, "K 3"],
        how: NodeRefineConfig,
        pairs: Pairs | None = None,
    ) -> ShapeFit:
        """Refine a proposal from the given node vectors and evaluate the fit."""
        vectors = self.refined(samples, vectors, how)
        features = self.features(onto, samples, vectors, pairs)
        return ShapeFit(proposal, vectors, self.system.moved(vectors), features)


_GOAL_SCHEDULE = Schedule(steps=6, prior=(3e-2, 1e-3), scale=(1.0, 0.3), damping=1e-6)
_REACHING_SCHEDULE = Schedule(steps=8, prior=(3e-2, 3e-3), damping=1e-6)


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """A fitted proposal: node vectors, deformed vertices and features; ``slid`` after the fit along the surface."""

    proposal: Proposal
    vectors: Float[Floats, "K 3"]
    moved: Float[Floats, "V 3"]
    features: DirectFeatures
    slid: bool = False

    @property
    def energy(self) -> float:
        return self.features.energy


@dataclass(frozen=True, eq=False)
class ShapeData:
    """One of two shapes, with what is needed to fit it to the other one and the other one to it.

    ``frame`` is that of its file; everything else is in units of sqrt(area). ``base_mesh`` is the shape, simplified if it is
    large, from which coarse and fine meshes are made; ``known`` are corresponding positions (N, 3) on this shape and on the
    other one.
    """

    original: Shape
    frame: Frame
    shape: Shape
    base_mesh: Shape
    coarse_mesh: SimplifiedMesh
    known: KnownPairs | None
    config: DirectConfig

    @cached_property
    def coarse(self) -> Level:
        """The coarse mesh with its least-squares system."""
        return Level.of(self.coarse_mesh, self.config.coarse_nodes, self.known, self.config.seed)

    @cached_property
    def fine_mesh(self) -> SimplifiedMesh:
        return SimplifiedMesh.of(self.base_mesh, self.config.fine)

    @cached_property
    def fine(self) -> Level:
        """The fine mesh with its least-squares system."""
        return Level.of(self.fine_mesh, self.config.fine_nodes, self.known, self.config.seed)

    @cached_property
    def intrinsic(self) -> Intrinsic:
        return Intrinsic(self.coarse_mesh)

    @cached_property
    def samples(self) -> OrientedPoints:
        """Samples of the shape, for fits of the other one to it."""
        return sample_surface(self.shape, self.config.samples, np.random.default_rng(self.config.seed))

    @cached_property
    def neighbours(self) -> Pairs:
        return neighbours(self.samples)


def simplify_if_large(shape: Shape) -> Shape:
    """The shape, simplified once if it is large."""
    return SimplifiedMesh.of(shape, _LIGHT).shape if shape.F > _HEAVY else shape


def fit_all_fine(
    own: ShapeData, onto: ShapeData, proposals: Sequence[tuple[Proposal, Float[Floats, "V 3"]]], report: Progress
) -> list[ShapeFit]:
    """Fine fits of one shape to another, from proposals with the positions (V, 3) where its vertices may belong."""
    report(0.0)
    _ = own.fine, onto.neighbours, onto.fine_mesh.relief, onto.fine_mesh.tree  # compute once, before threads start
    found = parallel_map(lambda each: fit_fine(own, onto, *each), proposals)
    report(1.0)
    return found


def fit_fine(own: ShapeData, onto: ShapeData, proposal: Proposal, goals: Float[Floats, "V 3"]) -> ShapeFit:
    """One fine fit."""
    return _fit_on_fine_mesh(own, onto, proposal, own.fine.system.vectors_to(goals), own.config.third)


def slide_all(own: ShapeData, onto: ShapeData, tried: Sequence[ShapeFit], report: Progress) -> list[ShapeFit]:
    """Continue fine fits along the surface, unless that was done.

    A fit is kept as it was if its energy does not decrease.
    """
    report(0.0)
    found = parallel_map(lambda each: slide(own, onto, each), tried)
    report(1.0)
    return found


def slide(own: ShapeData, onto: ShapeData, tried: ShapeFit) -> ShapeFit:
    """Continue one fine fit along the surface."""
    if tried.slid:
        return tried
    found = _fit_on_fine_mesh(own, onto, tried.proposal, tried.vectors, own.config.slide)
    return replace(min(tried, found, key=attrgetter("energy")), slid=True)


def _fit_on_fine_mesh(
    own: ShapeData, onto: ShapeData, proposal: Proposal, vectors: Float[Floats, "K 3"], how: NodeRefineConfig
) -> ShapeFit:
    return own.fine.fit_proposal(onto.fine_mesh, onto.samples, proposal, vectors, how, onto.neighbours)


def fit_one_way(
    own: ShapeData,
    onto: ShapeData,
    guess: KnownPairs | None,
    report: Progress,
    meanwhile: Sequence[Callable[[], object]] = (),
) -> list[ShapeFit]:
    """The best fits of one shape to another, best first.

    ``guess`` is one more proposal. The calls in ``meanwhile`` run where a thread would otherwise wait.
    """
    config, coarse_verts = own.config, own.coarse_mesh.verts
    guesses = [] if guess is None else [Proposal("guess", interpolate(coarse_verts, *guess))]
    first_fits = _fit_all_proposals(
        own, onto, guesses, report.named("guesses without a model").between(0.0, 0.6), meanwhile
    )
    better_fits = _refit_better(own, onto, first_fits, report.named("fits of the better guesses").between(0.6, 0.8))
    verts = own.fine.mesh.verts
    goals = [
        (each.proposal, verts + interpolate(verts, coarse_verts, each.moved - coarse_verts)) for each in better_fits
    ]
    for each in guesses:  # always fitted, as its energy is reported
        if all(other.proposal is not each for other in better_fits):
            goals.append((each, verts + interpolate(verts, coarse_verts, each.points - coarse_verts)))
    report = report.named("fits of the best guesses").between(0.8, 1.0)
    found = fit_all_fine(own, onto, goals, report.between(0.0, 0.6))
    best = distinct(found, config.n_slid, config.min_difference)
    rest = [each for each in found if each not in best]
    return sorted([*slide_all(own, onto, best, report.between(0.6, 1.0)), *rest], key=attrgetter("energy"))


def _fit_all_proposals(
    own: ShapeData,
    onto: ShapeData,
    guesses: list[Proposal],
    report: Progress,
    meanwhile: Sequence[Callable[[], object]],
) -> list[ShapeFit]:
    """Proposals of all kinds, fitted on the coarse mesh for a few steps.

    Distances along the surface are slow and hold Python's lock. The rigid proposals with their fits, whatever later fits
    need, and ``meanwhile`` are therefore computed in parallel.
    """
    level, samples = own.coarse, onto.samples.first(own.config.first_samples)
    _ = onto.coarse_mesh.relief, onto.coarse_mesh.tree, own.coarse_mesh.normals  # compute once, before threads start

    def fit(proposal: Proposal) -> ShapeFit:
        return level.fit_proposal(
            onto.coarse_mesh, samples, proposal, level.initial_vectors(proposal), own.config.first
        )

    def intrinsic_proposals() -> list[Proposal]:
        pair = own.intrinsic, onto.intrinsic
        return [*extremity_proposals(*pair), *spectral_proposals(*pair)]

    def rigid_fits() -> list[ShapeFit]:
        return [fit(each) for each in rigid_proposals(own.coarse_mesh, onto.coarse_mesh)]

    def next_level() -> None:
        _ = onto.neighbours, onto.fine_mesh.relief, onto.fine_mesh.tree

    report(0.0)
    proposals, found, *_ = parallel_calls((intrinsic_proposals, rigid_fits, lambda: own.fine, *meanwhile, next_level))
    report(0.6)
    found = [*found, *parallel_map(fit, [*proposals, *guesses])]
    report(1.0)
    return found


def _refit_better(own: ShapeData, onto: ShapeData, first_fits: list[ShapeFit], report: Progress) -> list[ShapeFit]:
    """The better proposals, fitted on the coarse mesh for more steps; the best of these that differ from each other."""
    config, samples = own.config, onto.samples.first(own.config.second_samples)
    pairs = neighbours(samples)

    def refit(each: ShapeFit) -> ShapeFit:
        return own.coarse.fit_proposal(onto.coarse_mesh, samples, each.proposal, each.vectors, config.second, pairs)

    report(0.0)
    found = parallel_map(refit, distinct(first_fits, config.n_second, config.min_difference, _EARLY_ENERGY))
    report(1.0)
    return distinct(found, config.n_third, config.min_difference, _EARLY_ENERGY)


def interpolate(
    points: Float[Floats, "V D"], at: Float[Floats, "T D"], values: Float[Floats, "T 3"]
) -> Float[Floats, "V 3"]:
    """Interpolate values (T, 3) at some points to other points, by inverse distance weights of the nearest few."""
    distance, near = cKDTree(at).query(points, _NEIGHBOURS)
    weights = 1 / (np.asarray(distance) + 1e-3)
    return np.asarray((weights[..., None] * values[near]).sum(1) / weights.sum(1, keepdims=True))


class _Fitted(Protocol):
    @property
    def energy(self) -> float: ...

    @property
    def moved(self) -> Float[Floats, "V 3"]: ...


F = TypeVar("F", bound=_Fitted)


def distinct(tried: Sequence[F], count: int, min_difference: float, by: str = "energy") -> list[F]:
    """The best ``count`` fits that differ from each other at more than ``min_difference`` of the vertices.

    ``by`` is the attribute by which they are ordered; the smallest is the best.
    """
    kept: list[F] = []
    for each in sorted(tried, key=attrgetter(by)):
        if len(kept) < count and all(changed_share(each.moved, other.moved) > min_difference for other in kept):
            kept.append(each)
    return kept
