"""Two shapes registered to each other without a model: one of them is the template of both.

Proposals of where the vertices of the source belong on the target (`meshmatch.fitting.search.proposals`) are fitted on few
nodes, the best of these on more, and the energy of the fits decides. Where it does not decide clearly, the target is fitted
to the source as well: what either search finds is fitted in the other direction too, and both energies decide. What comes
out are two fits of one template, as of a model: one shape as it is, and moved onto the other.
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
    DirectFit,
    KnownPairs,
    ShapeData,
    decimate_if_large,
    distinct,
    fit_fine,
    fit_one_way,
    interpolate,
    slide,
)
from meshmatch.fitting.search.intrinsic import DecimatedMesh
from meshmatch.fitting.search.motions import turns_onto_itself
from meshmatch.fitting.search.proposals import Proposal, differ
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.oriented import with_normals
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.models.registry import NO_MODEL
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.sides import apart, mirrored
from meshmatch.threads import parallel_calls, parallel_map

# Share of vertices by which a map differs from a guess, or from the same map found from the other side, if it is much the
# same.
_SAME = 0.1
# How much nearer a mirror image must lie, after rigid motions, to be tried (0.2 to 0.3 of femurs, up to 0.12 of creatures in
# other poses), or to be tried where the relief is as little alike as of a palm and the back of a hand (0.6 to 0.71; 0.8 of
# two hands of one side). What share of the energy its fit may have at most: 0.64 to 0.97 of hands, 1 of symmetric shapes;
# and, of shapes that a rigid motion brings no nearer than so, what share of the relief may be min_difference: 0.24 to 0.92 of
# hands, mostly less than 0.6, and 0.5 to 1 of animals, mostly more than 0.75.
_MIRRORED, _MAYBE_MIRRORED, _UNLIKE, _SHARE = 0.15, 0.03, 0.75, 0.93
_POSED, _SHARE_UNLIKE = 0.07, 0.6
CLEARLY = 0.003
"""How much lower the energy must be of a map that leaves doubt, for it to replace what a model found."""
MIRROR = Frame(1.0, np.diag([-1.0, 1.0, 1.0]), np.zeros(3))
_NORMALS = 0.1  # of unit normals beside positions, where vertices look for what was moved near them


@dataclass(frozen=True, eq=False)
class _BothWays:
    """One correspondence: the source fitted to the target, and the target to the source."""

    there: DirectFit
    back: DirectFit

    @property
    def proposal(self) -> Proposal:
        return self.there.proposal

    @property
    def moved(self) -> Float[Floats, "V 3"]:
        return self.there.moved

    @property
    def energy(self) -> float:
        return (self.there.energy + self.back.energy) / 2


@dataclass(frozen=True, eq=False)
class DirectMatch:
    """Two fits of one template, which is the source or the target: the one as it is, and moved onto the other.

    ``system`` moves the template by node vectors: where that is the source, the same for every shape that one source is
    registered to. ``tried`` are what the fits that were compared in the end began from, and their energies, best first;
    ``leads`` how much higher the energies of those are that differ from the best one, and ``over_guess`` that of the
    guess, if there was one: 0 where it is much the same map. ``turns`` is by how many turns one of the shapes comes onto
    itself, which makes so many maps equally good. ``apart`` is how far apart a rigid motion leaves the shapes, and the
    source and the mirror image of the target (units of sqrt(area)), if that was asked. Where the energies are means of both
    directions, ``before`` is what the first of them alone would have given.
    """

    source: Fit
    target: Fit
    tried: tuple[tuple[str, float], ...]
    system: NodeSystem
    leads: tuple[float, ...] = ()
    over_guess: float = np.inf
    earlier: Callable[[], DirectMatch] | None = None
    turns: int = 1
    apart: tuple[float, float] | None = None

    @property
    def energy(self) -> float:
        return self.tried[0][1]

    @property
    def before(self) -> DirectMatch | None:
        return None if self.earlier is None else self.earlier()

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Of the verdict."""
        return (*self.source.reasons, *self.target.reasons)

    @property
    def verdict(self) -> Verdict:
        """That of the fit that moves the template; the other one is good."""
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
        Two fits of one template, with the verdict on the one that moves it.

    Raises
    ------
    InputError
        A shape without area, or a cloud whose points lie on no surface.
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
    """As `match_directly`, with the mirror image of the target where that may be meant, and fits clearly better: a left bone
    onto a right one. The second fit then says that it is mirrored."""
    config = config or DirectConfig()
    began, report = time.monotonic(), Progress(progress, source.name)
    search = _Search.of(source, target, config, known, guess)
    there = search.one_way(report.stage("", 0.0, 0.3), [lambda: search.apart])
    nearer = float(np.log(search.apart[0] / search.apart[1]))
    if nearer < (_MAYBE_MIRRORED if there[0].features.likeness < _UNLIKE else _MIRRORED):
        return replace(search.matched(there, report, began), apart=search.apart)
    known, guess = (pairs and (pairs[0], MIRROR.apply(pairs[1])) for pairs in (known, guess))
    image = _Search.of(source, mirrored(target), config, known, guess)
    to_image = image.one_way(report.stage("", 0.3, 0.6))
    if to_image[0].energy > _SHARE * there[0].energy:
        return replace(search.matched(there, report, began), apart=search.apart)
    if not _alike(there[0].features, to_image[0].features, min(search.apart)):
        return replace(_side_in_doubt(search.matched(there, report, began)), apart=search.apart)
    return replace(_of_mirror_image(image.matched(to_image, report, began), target), apart=search.apart)


def match_where_it_lies(
    source: Shape,
    targets: Sequence[Shape],
    config: DirectConfig | None = None,
    progress: ProgressCallback | None = None,
) -> tuple[int, DirectMatch]:
    """As `match_directly`, one way and without a search: to the one of some targets that fits best.

    Parameters
    ----------
    targets
        One shape, moved rigidly in some ways, in each of which it may lie on the source.

    Returns
    -------
    int
        The number of the target.
    DirectMatch
        Of the source and of that target.
    """
    began, report = time.monotonic(), Progress(progress, source.name).stage("fits of the guesses")
    config = config or DirectConfig()
    searches = [_Search.of(source, target, config, None, None) for target in targets]
    own, sides = searches[0].source, [each.target for each in searches]
    at = own.frame.undo(own.fine_mesh.verts)
    places = [Proposal("guess", side.frame.apply(at)) for side in sides]

    def number_of(found: DirectFit) -> int:
        return next(k for k, place in enumerate(places) if place is found.proposal)

    def as_of_first(found: DirectFit) -> DirectFit:
        """A fit as if the target were the first one."""
        number = number_of(found)
        back = kabsch(targets[number].verts, targets[0].verts)
        there = sides[number].frame.undo(own.fine.system.moved(found.vectors))
        return replace(found, moved=sides[0].frame.apply(back.to_world(there)))

    def fit(place: Proposal, side: ShapeData) -> DirectFit:
        return as_of_first(fit_fine(own, side, place, place.points))

    def go_on(found: DirectFit) -> DirectFit:
        return as_of_first(slide(own, sides[number_of(found)], found))

    _ = own.fine  # once, and not by each thread
    report(0.0)
    tried = parallel_map(fit, places, sides)
    report(0.6)
    best = distinct(tried, config.n_slid, config.min_difference)
    rest = [each for each in tried if each not in best]
    found = sorted([*parallel_map(go_on, best), *rest], key=attrgetter("energy"))
    chosen = number_of(found[0])
    turns = turns_onto_itself(own.coarse_mesh)
    match = replace(searches[chosen], source=own)._match(_Judged(found, config.min_difference, DIRECT, turns))
    report(1.0)
    first, second = (replace(each, seconds=time.monotonic() - began) for each in (match.source, match.target))
    return chosen, replace(match, source=first, target=second)


def _alike(plain: DirectFeatures, image: DirectFeatures, apart: float) -> bool:
    """Whether the mirror image is meant, if it fits better. A creature in another pose may have less to bend onto the mirror
    image of a target, whose other leg is in front; there the relief must say so too.
    """
    return apart < _POSED or 1.0 - image.likeness < _SHARE_UNLIKE * (1.0 - plain.likeness)


def _side_in_doubt(found: DirectMatch) -> DirectMatch:
    """A match whose sides may be exchanged."""
    doubt = [Reason("side", SIDE_IN_DOUBT)]
    if found.source.vectors.any():
        return replace(found, source=cap_verdict(found.source, doubt))
    return replace(found, target=cap_verdict(found.target, doubt))


def _of_mirror_image(found: DirectMatch, target: Shape) -> DirectMatch:
    """A match to the mirror image of a target as one to the target: its fit says that it is mirrored."""
    frame, earlier = MIRROR.compose(found.target.frame), found.earlier
    up, front = (axis_name(frame.rotation[row]) for row in (1, 2))
    return replace(
        found,
        target=replace(found.target, frame=frame, verts=target.verts, up=up, front=front),
        earlier=None if earlier is None else lambda: _of_mirror_image(earlier(), target),
    )


@dataclass(frozen=True, eq=False)
class _Search:
    """Two shapes, and what another method says of where positions on the first belong on the second."""

    source: ShapeData
    target: ShapeData
    guess: KnownPairs | None

    @classmethod
    def of(
        cls, source: Shape, target: Shape, config: DirectConfig, known: KnownPairs | None, guess: KnownPairs | None
    ) -> _Search:
        """``known`` and ``guess`` in the files' coordinates."""
        frames = sqrt_area_frame(source), sqrt_area_frame(target)
        shapes = [
            Shape(frame.apply(each.verts), each.faces) for frame, each in zip(frames, (source, target), strict=True)
        ]
        light = parallel_map(decimate_if_large, shapes)
        thin = parallel_map(DecimatedMesh.of, light, [config.coarse] * 2)
        known, guess = (pairs and (frames[0].apply(pairs[0]), frames[1].apply(pairs[1])) for pairs in (known, guess))
        first = ShapeData(source, frames[0], shapes[0], light[0], thin[0], known, config)
        second = ShapeData(target, frames[1], shapes[1], light[1], thin[1], known and known[::-1], config)
        return cls(first, second, guess)

    @cached_property
    def apart(self) -> tuple[float, float]:
        """How far apart a rigid motion leaves the shapes, and the source and the mirror image of the target."""
        return apart(self.source.original, self.target.original, self.source.config.seed)

    def one_way(self, report: Progress, meanwhile: Sequence[Callable[[], object]] = ()) -> list[DirectFit]:
        """The best fits of the source to the target, best first; see `fitted`."""
        return fit_one_way(self.source, self.target, self.guess, report, meanwhile)

    def both_ways(self, there: list[DirectFit], report: Progress) -> list[_BothWays]:
        """The best fits of the source to the target, and of the target to the source, each continued the other way; best
        first."""
        reverse = _Search(self.target, self.source, self.guess and self.guess[::-1])
        there, back = self._best(there), self._best(reverse.one_way(report.between(0.0, 0.7)))
        report = report.named("fits both ways")
        report(0.7)
        returned = parallel_calls((*self._returned(there), *reverse._returned(back)))
        ways = zip(there, returned, strict=False)
        ways_back = zip(returned[len(there) :], back, strict=True)
        found = [_BothWays(*each) for each in (*ways, *ways_back)]
        report(0.9)
        best = distinct(found, self.source.config.n_slid, _SAME)
        sides = (self.source, self.target), (self.target, self.source)
        tasks = [partial(slide, *sides[back], (each.there, each.back)[back]) for back in (0, 1) for each in best]
        moved = parallel_calls(tasks)
        report(1.0)
        further = [_BothWays(*each) for each in zip(moved[: len(best)], moved[len(best) :], strict=True)]
        return sorted([*further, *(each for each in found if each not in best)], key=attrgetter("energy"))

    def _best(self, tried: list[DirectFit]) -> list[DirectFit]:
        """The best few that differ, and the guess, whose energy is asked for."""
        best = distinct(tried, self.source.config.n_returned, self.source.config.min_difference)
        return best + [each for each in tried if each.proposal.kind == "guess" and each not in best]

    def _returned(self, tried: Sequence[DirectFit]) -> list[Callable[[], DirectFit]]:
        """What fits the target to the source by what takes the source to the target."""
        own, other = self.source.fine, self.target.fine
        at = with_normals(other.mesh.verts, vertex_normals(other.mesh.verts, other.system.faces), _NORMALS)
        tasks: list[Callable[[], DirectFit]] = []
        for each in tried:
            moved = with_normals(each.moved, vertex_normals(each.moved, own.system.faces), _NORMALS)
            goals = interpolate(at, moved, own.mesh.verts)
            tasks.append(partial(fit_fine, self.target, self.source, each.proposal, goals))
        return tasks

    def matched(self, there: list[DirectFit], report: Progress, began: float) -> DirectMatch:
        """The best of the fits as a match; of both ways, if one way leaves doubt."""
        how, source, target = self.source.config.both_ways, self.source, self.target
        turns = max(turns_onto_itself(each.coarse_mesh, each.known and each.known[0]) for each in (source, target))
        found = _Judged(there, self.source.config.min_difference, DIRECT, turns)
        if how == "always" or (how == "in doubt" and not found.clear):
            both = self.both_ways(there, report.stage("", 0.6, 0.95))
            found = _Judged(both, _SAME, DIRECT_BOTH_WAYS, turns, found)
        match = self._match(found)
        report.stage("matching without a model")(1.0)
        first, second = (replace(fit, seconds=time.monotonic() - began) for fit in (match.source, match.target))
        return replace(match, source=first, target=second)

    def _match(self, judged: _Judged) -> DirectMatch:
        """The best fit, refined to the end, beside those that were found."""
        best, own, other = judged.found[0], self.source, self.target
        chosen = best.there if isinstance(best, _BothWays) else best
        if isinstance(best, _BothWays) and not own.config.from_source and best.back.energy < best.there.energy:
            own, other, chosen = other, own, best.back
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

    def _over_guess(self, found: Sequence[DirectFit | _BothWays]) -> float:
        """How much lower the energy of the best fit is than that of the guess."""
        if self.guess is None:
            return np.inf
        if differ(found[0].moved, interpolate(self.source.fine.mesh.verts, *self.guess)) < _SAME:
            return 0.0
        guessed = [each.energy for each in found if each.proposal.kind == "guess"]
        return min(guessed, default=np.inf) - found[0].energy


@dataclass(frozen=True, eq=False)
class _Judged:
    """Fits, the best one first, and what is said of it; those are alike that differ at ``min_difference`` of the vertices, and
    the ``earlier`` ones, of one direction, left doubt."""

    found: Sequence[DirectFit | _BothWays]
    min_difference: float
    calibration: DirectCalibration
    turns: int
    earlier: _Judged | None = None

    @cached_property
    def leads(self) -> tuple[float, ...]:
        """How much higher the energies of those are that differ from the first one, which has the lowest."""
        best, *others = self.found
        return tuple(
            each.energy - best.energy for each in others if differ(each.moved, best.moved) > self.min_difference
        )

    @property
    def judged(self) -> tuple[Verdict, float, tuple[Reason, ...]]:
        return judge_direct(self.found[0].energy, self.leads, self.calibration, self.turns)

    @property
    def clear(self) -> bool:
        """Whether the best is likely enough to be right; of ties and of turned shapes more fits know little more."""
        return self.judged[1] >= LIKELY


def _fits(
    own: ShapeData,
    other: ShapeData,
    vectors: Float[Floats, "K 3"],
    residual: float,
    judged: tuple[Verdict, float, tuple[Reason, ...]],
) -> tuple[Fit, Fit]:
    """A shape as the template, unmoved, and the template moved onto the other one, whose core frame is turned to its."""
    system, (verdict, trust, reasons) = own.fine.system, judged
    still, moved = np.zeros((system.K, 3)), system.moved(vectors)
    turn = kabsch(system.verts, moved)
    core = other.frame.compose(turn.frame)
    first = Fit(
        template_hash=own.fine.mesh.shape.hash,
        frame=own.frame,
        points=system.verts,
        vectors=still,
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
        points=turn.to_local(moved),
        vectors=system.vectors_to(turn.to_local(moved)),
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
