"""Register two shapes to each other without a model; one of them becomes the template of both.

Proposals of where the source's vertices belong on the target (`meshmatch.fitting.search.proposals`) are fitted coarse to
fine (`meshmatch.fitting.one_way`), and the energy of the fits decides. If it does not decide clearly, the target is fitted
to the source as well. What either search finds is then continued in the other direction, and the mean of both energies
decides. The result is two fits of one template, as from a model: one shape undeformed, and the same shape deformed to the
other.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import attrgetter

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit import Fit, axis_name
from meshmatch.fitting.fitter import cap_verdict
from meshmatch.fitting.judge.calibration import DIRECT, DIRECT_BOTH_WAYS, DirectCalibration
from meshmatch.fitting.judge.direct import LIKELY, DirectFeatures, judge_direct
from meshmatch.fitting.judge.reasons import SIDE_IN_DOUBT, Reason, Verdict
from meshmatch.fitting.one_way import (
    DirectConfig,
    KnownPairs,
    ShapeData,
    ShapeFit,
    distinct,
    fit_fine,
    fit_one_way,
    interpolate,
    simplify_if_large,
    slide,
)
from meshmatch.fitting.search.intrinsic import SimplifiedMesh
from meshmatch.fitting.search.motions import turns_onto_itself
from meshmatch.fitting.search.proposals import Proposal, changed_share
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.oriented import with_normals
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.models.registry import NO_MODEL
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.mirror_images import alignment_residuals, mirrored
from meshmatch.threads import parallel_calls, parallel_map

# Two maps, for example a map and the guess, are the same if no more than this share of vertices differs.
_MAX_SAME_DIFFERENCE = 0.1
# The mirror image is tried if rigid motions bring it this much nearer (log ratio): 0.2 to 0.3 for femurs, up to 0.12 for
# creatures in other poses. The second, smaller limit holds if the relief correlates less than the third number, as for a
# palm on the back of a hand: 0.6 to 0.71, but 0.8 for two hands of one side. The mirror image is accepted if its energy is
# below the fourth number as a share: 0.64 to 0.97 for hands, 1 for symmetric shapes.
_MIRROR_LEAD, _MIRROR_LEAD_IF_UNLIKE, _MIN_LIKENESS, _MIRROR_ENERGY_RATIO = 0.15, 0.03, 0.75, 0.93
# If no rigid motion brings the shapes nearer than the first number, poses differ; the mirror image is then accepted only if
# the difference of relief falls below the second number as a share: 0.24 to 0.92 for hands, mostly below 0.6; 0.5 to 1 for
# animals, mostly above 0.75.
_MAX_RIGID_DISTANCE, _MIRROR_RELIEF_RATIO = 0.07, 0.6
MIN_ENERGY_LEAD = 0.003
"""How much lower the energy of a doubtful map must be for it to replace what a model found."""
MIRROR = Frame(1.0, np.diag([-1.0, 1.0, 1.0]), np.zeros(3))
_NORMAL_WEIGHT = 0.1  # weight of unit normals against positions when vertices are transferred between deformed shapes


@dataclass(frozen=True, eq=False)
class _BothWays:
    """One correspondence, fitted in both directions: the source to the target, and the target to the source."""

    forward: ShapeFit
    backward: ShapeFit

    @property
    def proposal(self) -> Proposal:
        return self.forward.proposal

    @property
    def moved(self) -> Float[Floats, "V 3"]:
        return self.forward.moved

    @property
    def energy(self) -> float:
        return (self.forward.energy + self.backward.energy) / 2


@dataclass(frozen=True, eq=False)
class DirectMatch:
    """Two fits of one template, which is the source or the target: one undeformed, and one deformed to the other shape.

    Attributes
    ----------
    source, target : the fits
    tried : kind of proposal and energy of each fit that was compared in the end, best first
    system : deforms the template by node vectors; if the source is the template, one system serves all of its targets
    leads : energies of the fits that differ from the best one, minus its energy
    guess_lead : energy of the guess minus that of the best fit; 0 if they are the same map, infinite without a guess
    earlier : computes the match that the first direction alone would have given, if both directions were used
    turns : number of rotations that map one of the shapes onto itself, and thus of equally good maps
    apart : distances (units of sqrt(area)) that rigid motions leave between the shapes, and between the source and the
        mirror image of the target; None if they were not computed
    """

    source: Fit
    target: Fit
    tried: tuple[tuple[str, float], ...]
    system: NodeSystem
    leads: tuple[float, ...] = ()
    guess_lead: float = np.inf
    earlier: Callable[[], DirectMatch] | None = None
    turns: int = 1
    apart: tuple[float, float] | None = None

    @property
    def energy(self) -> float:
        """Energy of the best fit."""
        return self.tried[0][1]

    @property
    def before(self) -> DirectMatch | None:
        """The match that the first direction alone would have given; None if only one was used."""
        return None if self.earlier is None else self.earlier()

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Reasons of both fits."""
        return (*self.source.reasons, *self.target.reasons)

    @property
    def verdict(self) -> Verdict:
        """Verdict of the fit that deforms the template; the other one is good."""
        return self.source.verdict if self.target.verdict == "good" else self.target.verdict


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
        How thoroughly to search.
    known
        Corresponding positions (N, 3) on the source and (N, 3) on the target, in their files' coordinates.
    progress
        Called with the stage, the name of the source, and the completed share.
    guess
        Positions (T, 3) all over the source and (T, 3) on the target where another method puts them; used as one more
        proposal.

    Returns
    -------
    DirectMatch
        Two fits of one template; the one that deforms it has the verdict.

    Raises
    ------
    InputError
        A shape has no area, or the points of a cloud do not lie on a surface.
    """
    began, report = time.monotonic(), Progress(progress, source.name)
    search = _Search.of(source, target, config or DirectConfig(), known, guess)
    return search.matched(search.one_way(report.stage("", 0.0, 0.6)), report, began)


def match_either_side(
    source: Shape,
    target: Shape,
    config: DirectConfig | None = None,
    known: KnownPairs | None = None,
    progress: ProgressCallback | None = None,
    guess: KnownPairs | None = None,
) -> DirectMatch:
    """As `match_directly`, but use the mirror image of the target if it may be meant and fits clearly better.

    This matches a left bone to a right one, for example. The fit of the target is then marked as mirrored (its frame).
    """
    config = config or DirectConfig()
    began, report = time.monotonic(), Progress(progress, source.name)
    search = _Search.of(source, target, config, known, guess)
    plain_fits = search.one_way(report.stage("", 0.0, 0.3), [lambda: search.apart])
    mirror_lead = float(np.log(search.apart[0] / search.apart[1]))
    if mirror_lead < (_MIRROR_LEAD_IF_UNLIKE if plain_fits[0].features.likeness < _MIN_LIKENESS else _MIRROR_LEAD):
        return replace(search.matched(plain_fits, report, began), apart=search.apart)
    known, guess = (pairs and (pairs[0], MIRROR.apply(pairs[1])) for pairs in (known, guess))
    image = _Search.of(source, mirrored(target), config, known, guess)
    to_image = image.one_way(report.stage("", 0.3, 0.6))
    if to_image[0].energy > _MIRROR_ENERGY_RATIO * plain_fits[0].energy:
        return replace(search.matched(plain_fits, report, began), apart=search.apart)
    if not _mirror_is_meant(plain_fits[0].features, to_image[0].features, min(search.apart)):
        return replace(_with_side_in_doubt(search.matched(plain_fits, report, began)), apart=search.apart)
    return replace(_unmirrored(image.matched(to_image, report, began), target), apart=search.apart)


def match_to_best_of(
    source: Shape,
    targets: Sequence[Shape],
    config: DirectConfig | None = None,
    progress: ProgressCallback | None = None,
) -> tuple[int, DirectMatch]:
    """As `match_directly`, but without a search and in one direction: to whichever of several targets fits best.

    Parameters
    ----------
    targets
        Rigidly moved copies of one shape, each in a position where it may coincide with the source.

    Returns
    -------
    int
        The index of the target.
    DirectMatch
        The match of the source to that target.
    """
    began, report = time.monotonic(), Progress(progress, source.name).stage("fits of the guesses")
    config = config or DirectConfig()
    searches = [_Search.of(source, target, config, None, None) for target in targets]
    own, sides = searches[0].source, [each.target for each in searches]
    at = own.frame.undo(own.fine_mesh.verts)
    places = [Proposal("guess", side.frame.apply(at)) for side in sides]

    def number_of(found: ShapeFit) -> int:
        return next(k for k, place in enumerate(places) if place is found.proposal)

    def in_first_target(found: ShapeFit) -> ShapeFit:
        """A fit as if the target were the first one."""
        number = number_of(found)
        back = kabsch(targets[number].verts, targets[0].verts)
        points = sides[number].frame.undo(own.fine.system.moved(found.vectors))
        return replace(found, moved=sides[0].frame.apply(back.to_world(points)))

    def fit(place: Proposal, side: ShapeData) -> ShapeFit:
        return in_first_target(fit_fine(own, side, place, place.points))

    def continue_fit(found: ShapeFit) -> ShapeFit:
        return in_first_target(slide(own, sides[number_of(found)], found))

    _ = own.fine  # compute once, before threads start
    report(0.0)
    tried = parallel_map(fit, places, sides)
    report(0.6)
    best = distinct(tried, config.n_slid, config.min_difference)
    rest = [each for each in tried if each not in best]
    found = sorted([*parallel_map(continue_fit, best), *rest], key=attrgetter("energy"))
    chosen = number_of(found[0])
    turns = turns_onto_itself(own.coarse_mesh)
    match = replace(searches[chosen], source=own)._match(_Judged(found, config.min_difference, DIRECT, turns))
    report(1.0)
    first, second = (replace(each, seconds=time.monotonic() - began) for each in (match.source, match.target))
    return chosen, replace(match, source=first, target=second)


def _mirror_is_meant(plain: DirectFeatures, image: DirectFeatures, apart: float) -> bool:
    """Return whether the mirror image, which fits better, is really meant.

    A creature in another pose may bend less onto the mirror image of a target whose other leg is in front. If poses differ,
    the relief must therefore prefer the mirror image too.
    """
    return apart < _MAX_RIGID_DISTANCE or 1.0 - image.likeness < _MIRROR_RELIEF_RATIO * (1.0 - plain.likeness)


def _with_side_in_doubt(found: DirectMatch) -> DirectMatch:
    """Add a reason to a match: left and right may be exchanged."""
    doubt = [Reason("side", SIDE_IN_DOUBT)]
    if found.source.vectors.any():
        return replace(found, source=cap_verdict(found.source, doubt))
    return replace(found, target=cap_verdict(found.target, doubt))


def _unmirrored(found: DirectMatch, target: Shape) -> DirectMatch:
    """Turn a match to the mirror image of a target into one to the target, whose fit then has a mirrored frame."""
    frame, earlier = MIRROR.compose(found.target.frame), found.earlier
    up, front = (axis_name(frame.rotation[row]) for row in (1, 2))
    return replace(
        found,
        target=replace(found.target, frame=frame, verts=target.verts, up=up, front=front),
        earlier=None if earlier is None else lambda: _unmirrored(earlier(), target),
    )


@dataclass(frozen=True, eq=False)
class _Search:
    """Two shapes, and a guess by another method: positions on the first and their counterparts on the second."""

    source: ShapeData
    target: ShapeData
    guess: KnownPairs | None

    @classmethod
    def of(
        cls, source: Shape, target: Shape, config: DirectConfig, known: KnownPairs | None, guess: KnownPairs | None
    ) -> _Search:
        """Prepare the shapes; ``known`` and ``guess`` are in the files' coordinates."""
        frames = sqrt_area_frame(source), sqrt_area_frame(target)
        shapes = [
            Shape(frame.apply(each.verts), each.faces) for frame, each in zip(frames, (source, target), strict=True)
        ]
        base = parallel_map(simplify_if_large, shapes)
        coarse = parallel_map(SimplifiedMesh.of, base, [config.coarse] * 2)
        known, guess = (pairs and (frames[0].apply(pairs[0]), frames[1].apply(pairs[1])) for pairs in (known, guess))
        first = ShapeData(source, frames[0], shapes[0], base[0], coarse[0], known, config)
        second = ShapeData(target, frames[1], shapes[1], base[1], coarse[1], known and known[::-1], config)
        return cls(first, second, guess)

    @cached_property
    def apart(self) -> tuple[float, float]:
        """Distances that rigid motions leave between the shapes, and between the source and the target's mirror image."""
        return alignment_residuals(self.source.original, self.target.original, self.source.config.seed)

    def one_way(self, report: Progress, meanwhile: Sequence[Callable[[], object]] = ()) -> list[ShapeFit]:
        """The best fits of the source to the target, best first; see `fit_one_way`."""
        return fit_one_way(self.source, self.target, self.guess, report, meanwhile)

    def both_ways(self, forward: list[ShapeFit], report: Progress) -> list[_BothWays]:
        """The best fits in both directions, best first: those of either direction, each continued in the other one."""
        reverse = _Search(self.target, self.source, self.guess and self.guess[::-1])
        forward, backward = self._best(forward), self._best(reverse.one_way(report.between(0.0, 0.7)))
        report = report.named("fits both ways")
        report(0.7)
        returned = parallel_calls((*self._reverse_calls(forward), *reverse._reverse_calls(backward)))
        ways = zip(forward, returned, strict=False)
        ways_back = zip(returned[len(forward) :], backward, strict=True)
        found = [_BothWays(*each) for each in (*ways, *ways_back)]
        report(0.9)
        best = distinct(found, self.source.config.n_slid, _MAX_SAME_DIFFERENCE)
        sides = (self.source, self.target), (self.target, self.source)
        tasks = [
            partial(slide, *sides[direction], (each.forward, each.backward)[direction])
            for direction in (0, 1)
            for each in best
        ]
        moved = parallel_calls(tasks)
        report(1.0)
        further = [_BothWays(*each) for each in zip(moved[: len(best)], moved[len(best) :], strict=True)]
        return sorted([*further, *(each for each in found if each not in best)], key=attrgetter("energy"))

    def _best(self, tried: list[ShapeFit]) -> list[ShapeFit]:
        """The best few fits that differ, and that of the guess, whose energy is reported."""
        best = distinct(tried, self.source.config.n_returned, self.source.config.min_difference)
        return best + [each for each in tried if each.proposal.kind == "guess" and each not in best]

    def _reverse_calls(self, tried: Sequence[ShapeFit]) -> list[Callable[[], ShapeFit]]:
        """Calls that fit the target to the source, starting from the inverses of given fits of the source to the target."""
        own, other = self.source.fine, self.target.fine
        at = with_normals(other.mesh.verts, vertex_normals(other.mesh.verts, other.system.faces), _NORMAL_WEIGHT)
        tasks: list[Callable[[], ShapeFit]] = []
        for each in tried:
            moved = with_normals(each.moved, vertex_normals(each.moved, own.system.faces), _NORMAL_WEIGHT)
            goals = interpolate(at, moved, own.mesh.verts)
            tasks.append(partial(fit_fine, self.target, self.source, each.proposal, goals))
        return tasks

    def matched(self, forward_fits: list[ShapeFit], report: Progress, began: float) -> DirectMatch:
        """The best fit as a match. Fits in both directions, if the configuration or doubt asks for it."""
        how, source, target = self.source.config.both_ways, self.source, self.target
        turns = max(turns_onto_itself(each.coarse_mesh, each.known and each.known[0]) for each in (source, target))
        found = _Judged(forward_fits, self.source.config.min_difference, DIRECT, turns)
        if how == "always" or (how == "in doubt" and not found.clear):
            both = self.both_ways(forward_fits, report.stage("", 0.6, 0.95))
            found = _Judged(both, _MAX_SAME_DIFFERENCE, DIRECT_BOTH_WAYS, turns, found)
        match = self._match(found)
        report.stage("matching without a model")(1.0)
        first, second = (replace(fit, seconds=time.monotonic() - began) for fit in (match.source, match.target))
        return replace(match, source=first, target=second)

    def _match(self, judged: _Judged) -> DirectMatch:
        """The match of the best fit, after a last refinement."""
        best, own, other = judged.found[0], self.source, self.target
        chosen = best.forward if isinstance(best, _BothWays) else best
        if isinstance(best, _BothWays) and not own.config.from_source and best.backward.energy < best.forward.energy:
            own, other, chosen = other, own, best.backward
        vectors = own.fine.refined(other.samples, chosen.vectors, own.config.last, own.fine.viscous)
        fits = _fits(own, other, vectors, chosen.features.residual, judged.judged)
        source, target = fits if own is self.source else fits[::-1]
        earlier = None if judged.earlier is None else partial(self._match, judged.earlier)
        return DirectMatch(
            source,
            target,
            tuple((each.proposal.kind, each.energy) for each in judged.found),
            own.fine.system,
            judged.leads,
            self._over_guess(judged.found),
            earlier,
            judged.turns,
        )

    def _over_guess(self, found: Sequence[ShapeFit | _BothWays]) -> float:
        """Energy of the guess minus that of the best fit; 0 if they are the same map."""
        if self.guess is None:
            return np.inf
        if changed_share(found[0].moved, interpolate(self.source.fine.mesh.verts, *self.guess)) < _MAX_SAME_DIFFERENCE:
            return 0.0
        guessed = [each.energy for each in found if each.proposal.kind == "guess"]
        return min(guessed, default=np.inf) - found[0].energy


@dataclass(frozen=True, eq=False)
class _Judged:
    """Fits, best first, and their judgement.

    Fits differ if more than ``min_difference`` of the vertices do. ``earlier`` are the fits of one direction, if these
    are of both.
    """

    found: Sequence[ShapeFit | _BothWays]
    min_difference: float
    calibration: DirectCalibration
    turns: int
    earlier: _Judged | None = None

    @cached_property
    def leads(self) -> tuple[float, ...]:
        """Energies of the fits that differ from the best one, minus its energy."""
        best, *others = self.found
        return tuple(
            each.energy - best.energy for each in others if changed_share(each.moved, best.moved) > self.min_difference
        )

    @property
    def judged(self) -> tuple[Verdict, float, tuple[Reason, ...]]:
        """Verdict, trust and reasons of the best fit."""
        return judge_direct(self.found[0].energy, self.leads, self.calibration, self.turns)

    @property
    def clear(self) -> bool:
        """Whether the best fit is likely enough to be right without fits in the other direction.

        Ties and symmetries do not count, as fits in the other direction hardly resolve them.
        """
        return self.judged[1] >= LIKELY


def _fits(
    own: ShapeData,
    other: ShapeData,
    vectors: Float[Floats, "K 3"],
    residual: float,
    judged: tuple[Verdict, float, tuple[Reason, ...]],
) -> tuple[Fit, Fit]:
    """The fits of both shapes: the undeformed template on its own shape, and the deformed one on the other.

    The core frame of the other shape is chosen so that the deformed template is rigidly aligned to the undeformed one.
    """
    system, (verdict, trust, reasons) = own.fine.system, judged
    zero_vectors, moved = np.zeros((system.K, 3)), system.moved(vectors)
    pose = kabsch(system.verts, moved)
    core = other.frame.compose(pose.frame)
    first = Fit(
        template_hash=own.fine.mesh.shape.hash,
        frame=own.frame,
        points=system.verts,
        vectors=zero_vectors,
        resting=system.verts,
        faces=system.faces,
        residual=0.0,
        verts=own.original.verts,
        verdict="good",
        reasons=(),
        up="+y",
        front="+z",
        seconds=0.0,
        seed=own.config.seed,
        model=NO_MODEL,
        regularity=Regularity(),
    )
    second = replace(
        first,
        frame=core,
        points=pose.to_local(moved),
        vectors=system.vectors_to(pose.to_local(moved)),
        residual=residual,
        verts=other.original.verts,
        verdict=verdict,
        reasons=reasons,
        trust=trust,
        regularity=system.regularity(vectors),
        up=axis_name(core.rotation[1]),
        front=axis_name(core.rotation[2]),
    )
    return first, second
