"""Two shapes registered to each other without a model: one of them is the template of both.

Proposals of where the vertices of the source belong on the target (`meshmatch.fitting.search.proposals`) are fitted on few
nodes, the best of these on more, and the energy of the fits decides. What comes out are two fits of one template, as of a
model: the source as it is, and the source moved onto the target.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit import Fit, axis_name
from meshmatch.fitting.fit_config import NodeRefineConfig, Schedule
from meshmatch.fitting.judge.direct import DirectFeatures, judge_direct
from meshmatch.fitting.judge.reasons import Reason, Verdict
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
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.fitting.solve.surface_nodes import SurfaceNodes
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import GoalTerm, LandmarkTerm, PairTerm, Term
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.registry import NO_MODEL
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.sides import mirrored, nearer_mirrored
from meshmatch.threads import parallel_map

KnownPairs = tuple[Float[Floats, "N 3"], Float[Floats, "N 3"]]
"""Positions on the source and on the target that belong together."""
_KNOWN_WEIGHT = 0.05  # of each known pair; all other pairs together have about 1
_SAME = 0.1  # share of vertices by which a map differs from a guess, if it is much the same
# How much nearer a mirror image must lie, after rigid motions, to be tried (0.2 to 0.3 of femurs, up to 0.12 of creatures in
# other poses), and what share of the energy its fit may have at most (see `meshmatch.fitting.without_model`).
_MAYBE_MIRRORED, MIRRORED_SHARE = 0.15, 0.85
MIRROR = Frame(1.0, np.diag([-1.0, 1.0, 1.0]), np.zeros(3))
_NEAR = 3  # vertices of the coarse mesh by which one of the fine mesh moves


def _pairs(steps: int, prior: tuple[float, float], scale: tuple[float, float], back: int) -> NodeRefineConfig:
    schedule = Schedule(steps=steps, prior=prior, scale=scale, damping=1e-6)
    return NodeRefineConfig(schedule=schedule, point_share=0.1, back_points=back)


_COARSE_NODES = SurfaceNodes(K=120, radius=0.2, gradient_points=400)
_FINE_NODES = SurfaceNodes(K=320, radius=0.13)


@dataclass(frozen=True, kw_only=True)
class DirectConfig:
    """How two shapes are matched without a model; lengths in units of sqrt(area). Set by hand on 30 pairs of 15 kinds.

    Attributes
    ----------
    coarse, fine : triangles of the thinned meshes that are fitted first and last
    samples, few, fewer : points of the target: for the last fits, for the better coarse ones, and for all
    coarse_nodes, fine_nodes : nodes of both meshes
    first, second, third, last : least squares of all proposals, of the better ones, of the best on the fine mesh, of which
        the energies decide, and of the one that is taken, which may stretch more
    better, best : how many proposals are fitted a second, and a third time
    unlike : share of vertices by which these differ at least
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
    third: NodeRefineConfig = field(default_factory=lambda: _pairs(8, (3e-4, 1e-4), (0.06, 0.02), 4000))
    last: NodeRefineConfig = field(default_factory=lambda: _pairs(6, (1e-4, 3e-5), (0.03, 0.02), 4000))
    better: int = 16
    best: int = 6
    unlike: float = 0.03
    seed: int = 0


@dataclass(frozen=True, eq=False)
class _Level:
    """A thinned source, its least squares, and the prior by which its parts may stretch."""

    mesh: ThinMesh
    system: NodeSystem
    viscous: ViscousGradient
    known: tuple[LandmarkTerm, ...]

    @classmethod
    def of(cls, mesh: ThinMesh, nodes: SurfaceNodes, known: KnownPairs | None, seed: int) -> _Level:
        terms: tuple[LandmarkTerm, ...] = ()
        if known is not None:
            nearest = np.asarray(cKDTree(mesh.verts).query(known[0])[1])
            terms = (LandmarkTerm((nearest, known[1]), _KNOWN_WEIGHT),)
        return cls(mesh, *nodes.system(mesh.shape, mesh.graph, seed), terms)

    def features(
        self, samples: OrientedPoints, vectors: Float[Floats, "K 3"], pairs: Pairs | None = None
    ) -> DirectFeatures:
        """Of node vectors; how far known pairs are missed counts as a residual."""
        found = DirectFeatures.of(self.system, samples, vectors, pairs)
        for term in self.known:
            at, goal = term.landmarks
            off = np.linalg.norm(self.system.moved(vectors)[at] - goal, axis=1).mean()
            found = replace(found, residual=found.residual + float(off))
        return found

    @property
    def rigid(self) -> Prior:
        """As rigid as possible, about the shape as it is."""
        return RotatedReference(np.tile(np.eye(3), (len(self.system.gradient_points), 1, 1)))

    def onto(self, goals: Float[Floats, "V 3"], schedule: Schedule, prior: Prior) -> Float[Floats, "K 3"]:
        """Node vectors that bring each vertex near a goal of its own."""
        problem = Problem(system=self.system, terms=[GoalTerm(goals), *self.known], schedule=schedule)
        return minimise(problem, prior, np.zeros((self.system.K, 3)))

    def begun(self, proposal: Proposal) -> Float[Floats, "K 3"]:
        """Near a proposal: as rigid as possible, or with limbs that may be longer or shorter than its own."""
        if proposal.kind in ("rigid", "affine"):
            return self.onto(proposal.points, _ONTO, self.rigid)
        return self.onto(proposal.points, _ONTO_STRETCHED, self.viscous)

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


_ONTO = Schedule(steps=6, prior=(3e-2, 1e-3), scale=(1.0, 0.15), damping=1e-6)
_ONTO_STRETCHED = Schedule(steps=6, prior=(3e-2, 1e-3), scale=(1.0, 0.3), damping=1e-6)
_ONTO_AGAIN = Schedule(steps=4, prior=(1e-3, 3e-4), scale=(1.0, 0.15), damping=1e-6)


@dataclass(frozen=True, eq=False)
class _Tried:
    """Node vectors of one proposal, where they take the vertices, and how well."""

    proposal: Proposal
    vectors: Float[Floats, "K 3"]
    moved: Float[Floats, "V 3"]
    features: DirectFeatures


@dataclass(frozen=True, eq=False)
class DirectMatch:
    """Two fits of one template: the source as it is, and the source moved onto the target.

    ``system`` moves the template by node vectors: the same for every shape that one source is registered to. ``tried`` are
    the features of the fits that were compared in the end, best first, each with what it began from; ``leads`` how much
    higher the energies of those are that differ from the best one, and ``over_guess`` that of the guess, if there was one: 0
    where it is much the same map.
    """

    source: Fit
    target: Fit
    tried: tuple[tuple[str, DirectFeatures], ...]
    system: NodeSystem
    leads: tuple[float, ...] = ()
    over_guess: float = np.inf

    @property
    def energy(self) -> float:
        return self.tried[0][1].energy


def match_directly(
    source: Shape,
    target: Shape,
    config: DirectConfig | None = None,
    known: KnownPairs | None = None,
    progress: ProgressCallback | None = None,
    guess: KnownPairs | None = None,
) -> DirectMatch:
    """Register a repaired shape to another one, without a model.

    Parameters
    ----------
    source, target
        Meshes, or clouds whose points lie on a surface; in any size and orientation.
    config
        How hard the search is.
    known
        Positions (N, 3) on the source and (N, 3) on the target, in their files' coordinates, that belong together.
    progress
        Called with the stage, the name of the source, and the share that is done.
    guess
        Positions (T, 3) all over the source and where they may belong on the target, (T, 3), as another method found; one
        more proposal.

    Returns
    -------
    DirectMatch
        Two fits of one template, with the verdict on the second.

    Raises
    ------
    InputError
        A shape without area, or a cloud whose points lie on no surface.
    """
    config, began = config or DirectConfig(), time.monotonic()
    report = Progress(progress, source.name).stage("matching without a model")
    frames = sqrt_area_frame(source), sqrt_area_frame(target)
    shapes = [Shape(frame.apply(each.verts), each.faces) for frame, each in zip(frames, (source, target), strict=True)]
    known, guess = (pairs and (frames[0].apply(pairs[0]), frames[1].apply(pairs[1])) for pairs in (known, guess))
    coarse = parallel_map(ThinMesh.of, shapes, [config.coarse] * 2)
    report(0.05)
    proposals = _proposals(coarse, report.stage("guesses without a model", 0.05, 0.4))
    if guess is not None:
        proposals.append(Proposal("guess", _carried(coarse[0].verts, *guess)))
    samples = sample_surface(shapes[1], config.samples, np.random.default_rng(config.seed))
    level = _Level.of(coarse[0], config.coarse_nodes, known, config.seed)
    trying = report.stage(f"fits of {len(proposals)} guesses", 0.4, 0.75)
    tried = _screened(level, proposals, samples, config, trying)
    fine = _Level.of(ThinMesh.of(shapes[0], config.fine), config.fine_nodes, known, config.seed)
    finished = _finished(level, fine, tried, samples, config, report.stage("fits of the best guesses", 0.75, 0.9))
    best, *others = finished
    apart = [each.features.energy for each in others if differ(each.moved, best.moved) > config.unlike]
    leads = tuple(energy - best.features.energy for energy in apart)
    judged = judge_direct(best.features.energy, leads)
    vectors = fine.refined(samples, best.vectors, config.last, fine.viscous)
    first, second = _fits(fine, frames, (source, target), vectors, best.features.residual, judged, config.seed)
    seconds = time.monotonic() - began
    compared = tuple((each.proposal.kind, each.features) for each in finished)
    over_guess = np.inf
    if guess is not None and differ(best.moved, _carried(fine.mesh.verts, *guess)) < _SAME:
        over_guess = 0.0
    elif guess is not None:
        energies = [features.energy for kind, features in compared if kind == "guess"]
        over_guess = min(energies, default=np.inf) - best.features.energy
    report(1.0)
    first, second = (replace(fit, seconds=seconds) for fit in (first, second))
    return DirectMatch(first, second, compared, fine.system, leads, over_guess)


def match_either_side(
    source: Shape,
    target: Shape,
    config: DirectConfig | None = None,
    known: KnownPairs | None = None,
    progress: ProgressCallback | None = None,
    guess: KnownPairs | None = None,
) -> DirectMatch:
    """As `match_directly`, with the mirror image of the target where that may be meant, and fits clearly better: a left bone
    onto a right one. The second fit then says that it is mirrored."""
    config = config or DirectConfig()
    found = match_directly(source, target, config, known, progress, guess)
    if nearer_mirrored(source, target, config.seed) < _MAYBE_MIRRORED:
        return found
    known, guess = (pairs and (pairs[0], MIRROR.apply(pairs[1])) for pairs in (known, guess))
    image = match_directly(source, mirrored(target), config, known, progress, guess)
    if image.energy > MIRRORED_SHARE * found.energy:
        return found
    frame = MIRROR.compose(image.target.frame)
    up, front = (axis_name(frame.rotation[row]) for row in (1, 2))
    return replace(image, target=replace(image.target, frame=frame, verts=target.verts, up=up, front=front))


def _proposals(meshes: Sequence[ThinMesh], report: Progress) -> list[Proposal]:
    source, target = (Intrinsic(mesh) for mesh in meshes)
    found = rigid_proposals(*meshes)
    for number, make in enumerate((extremity_proposals, spectral_proposals)):
        found += make(source, target)
        report((number + 1) / 3)
    return found


def _screened(
    level: _Level, proposals: list[Proposal], samples: OrientedPoints, config: DirectConfig, report: Progress
) -> list[_Tried]:
    """Proposals fitted on few nodes: all for a few steps, then those that look better; no two alike, best first."""
    done = 0

    def fit(
        proposal: Proposal, some: OrientedPoints, vectors: Floats, how: NodeRefineConfig, pairs: Pairs | None = None
    ) -> _Tried:
        nonlocal done
        vectors = level.refined(some, vectors, how)
        features = level.features(some, vectors, pairs)
        done += 1
        report(min(done / (len(proposals) + config.better), 1.0))
        return _Tried(proposal, vectors, level.system.moved(vectors), features)

    fewer, few = samples.first(config.fewer), samples.first(config.few)
    first = parallel_map(lambda each: fit(each, fewer, level.begun(each), config.first), proposals)
    better = _distinct(first, config.better, config.unlike)
    pairs = neighbours(few)
    return parallel_map(lambda each: fit(each.proposal, few, each.vectors, config.second, pairs), better)


def _finished(
    level: _Level, fine: _Level, tried: list[_Tried], samples: OrientedPoints, config: DirectConfig, report: Progress
) -> list[_Tried]:
    """The best fits on the fine mesh, best first."""
    pairs = neighbours(samples)
    chosen = _distinct(tried, config.best, config.unlike)

    def fit(each: _Tried) -> _Tried:
        goals = fine.mesh.verts + _carried(fine.mesh.verts, level.mesh.verts, each.moved - level.mesh.verts)
        vectors = fine.refined(samples, fine.onto(goals, _ONTO_AGAIN, fine.rigid), config.third)
        features = fine.features(samples, vectors, pairs)
        report(0.9)
        return _Tried(each.proposal, vectors, fine.system.moved(vectors), features)

    return sorted(parallel_map(fit, chosen), key=lambda each: each.features.energy)


def _carried(
    points: Float[Floats, "V 3"], at: Float[Floats, "T 3"], values: Float[Floats, "T 3"]
) -> Float[Floats, "V 3"]:
    """Values at some points carried to others, from the nearest ones."""
    distance, near = cKDTree(at).query(points, _NEAR)
    weights = 1 / (np.asarray(distance) + 1e-3)
    return np.asarray((weights[..., None] * values[near]).sum(1) / weights.sum(1, keepdims=True))


def _distinct(tried: list[_Tried], count: int, unlike: float) -> list[_Tried]:
    """The best of the fits, no two of which are alike."""
    kept: list[_Tried] = []
    for each in sorted(tried, key=lambda each: each.features.energy):
        if len(kept) < count and all(differ(each.moved, other.moved) > unlike for other in kept):
            kept.append(each)
    return kept


def _fits(
    level: _Level,
    frames: tuple[Frame, Frame],
    shapes: tuple[Shape, Shape],
    vectors: Float[Floats, "K 3"],
    residual: float,
    judged: tuple[Verdict, float, tuple[Reason, ...]],
    seed: int,
) -> tuple[Fit, Fit]:
    """The source as the template, unmoved, and the template moved onto the target, whose core frame is turned to the
    source's."""
    system, (verdict, trust, reasons) = level.system, judged
    still, moved = np.zeros((system.K, 3)), system.moved(vectors)
    turn = kabsch(system.verts, moved)
    core = frames[1].compose(turn.frame)
    source = Fit(
        template_hash=level.mesh.shape.hash,
        frame=frames[0],
        points=system.verts,
        vectors=still,
        resting=system.verts,
        faces=system.faces,
        residual=0.0,
        verts=shapes[0].verts,
        verdict="good",
        reasons=(),
        up="+y",
        front="+z",
        seconds=0.0,
        seed=seed,
        model=NO_MODEL,
        regularity=Regularity(),
    )
    target = replace(
        source,
        frame=core,
        points=turn.to_local(moved),
        vectors=system.vectors_to(turn.to_local(moved)),
        residual=residual,
        verts=shapes[1].verts,
        verdict=verdict,
        reasons=reasons,
        trust=trust,
        regularity=system.regularity(vectors),
        up=axis_name(core.rotation[1]),
        front=axis_name(core.rotation[2]),
    )
    return source, target
