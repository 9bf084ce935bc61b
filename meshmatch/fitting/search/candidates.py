"""The network's candidates for a shape that is taken for complete, or for a part.

The area of a cloud is only estimated, too small where points are few and noisy, and outliers look like surface. The
network's own fit knows better: its template has the area of a body, and a point far from it, with few others around, is
not on its surface.

A part does not say how large the whole is, so its share of the surface is one more thing to try. What the samples show
must lie on the template; what the template has besides is left to the network and to the prior on its gradient.

The network was mostly shown complete shapes. Where samples show a part, the template's fitted surface stands in for
what is missing, and the network is asked again about both together. The refinement then holds what is not visible where
the network wants it, and nothing beyond a cut is pulled onto its edge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.fitting.search.frames import frames_anywhere, frames_of_part, frames_to_try, stands_upright
from meshmatch.fitting.search.predictor import (
    Candidate,
    Predictor,
    best_first,
    one_way_residual,
    ranking_residual,
    scaled_to_area,
    two_way_residual,
)
from meshmatch.fitting.search.task import FitTask
from meshmatch.fitting.search.visibility import area_share, visible_vertices
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.progress import Progress
from meshmatch.shapes.normalise import ALIGNS
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map

STAGE = "fitting as a part"
_ABOUT = np.array([-1.0, 1.0, -1.0])  # of the columns of a rotation: half a turn about its own y axis


@dataclass(frozen=True, kw_only=True)
class CandidateSettings:
    """How the network's candidates are found. All set by hand; lengths and residuals are in units of sqrt(area).

    Attributes
    ----------
    scale_rounds : how often the scale and the outliers of a cloud are estimated anew
    max_scale_change : factor by which the scale may change in all: more is a wrong fit, not a wrong area
    outlier_distance : isolated points further than this from the fitted template are outliers
    isolation : a point is isolated whose neighbours reach so many times as far as the median of the cloud
    neighbours : how many neighbours those are
    scale_tolerance : relative change of the scale that ends the search
    scale_margin : candidates whose residual is more than this times the best one say nothing about a cloud's scale
    unusual_residual : a shape that the network's fits miss by more may stand as nothing that the aligner knows
    careful_if_unusual : of the frames that are then tried, how many are fitted with care
    about_margin : residual, as a multiple of the best one, up to which this is refined the other way round as well
    shares : shares of the surface that a part may show
    min_share : the smallest share that a shape is taken to show
    lost : residual from which on the candidates of a narrow search are not worth refining: of parts of people that are found
        it is 0.020 to 0.030
    wide_shares : shares for which a wide search tries all frames
    wide_kept : one in so many of these, the best, is tried for the other shares
    ranking_samples, ranking_samples_if_wide : samples by which frames are ranked
    careful : candidates of each share that are fitted with care
    worth_if_wide : multiple of the best residual up to which they are worth it in a wide search
    completed : candidates that are completed and fitted again: so many once, of these so many twice, and so many three times
    varied : candidates of which variants are sought
    coarse_samples : samples by which variants are compared, and visible vertices found
    max_added : points that complete the samples, for each of them, at most
    """

    scale_rounds: int = 3
    max_scale_change: float = 1.3
    outlier_distance: float = 0.06
    isolation: float = 1.5
    neighbours: int = 8
    scale_tolerance: float = 0.005
    scale_margin: float = 1.1
    unusual_residual: float = 0.045
    careful_if_unusual: int = 12
    about_margin: float = 1.1
    shares: tuple[float, ...] = (1.0, 0.8, 0.62, 0.48, 0.36)
    min_share: float = 0.2
    lost: float = 0.034
    wide_shares: tuple[float, ...] = (0.62,)
    wide_kept: int = 8
    ranking_samples: int = 768
    ranking_samples_if_wide: int = 512
    careful: int = 5
    worth_if_wide: float = 1.3
    completed: tuple[int, ...] = (10, 5, 3)
    varied: int = 1
    coarse_samples: int = 2048
    max_added: int = 3


SETTINGS = CandidateSettings()


def candidates_of_whole(task: FitTask) -> tuple[FitTask, list[Candidate]]:
    """The network's fits of a shape that is taken for complete, best first; and the task, a cloud's in the scale, and
    without the outliers, that the best fit tells.
    """
    orientation = task.progress.stage("orientation")
    orientation(0.0)
    # A cloud's residual says little before its core frame is found; a second round finds it.
    care = 2 if task.shape.is_cloud else 1
    starts = [(task.coarse, pose) for pose in frames_to_try(task.model, task.samples, task.config, task.shape.upright)]
    candidates = best_first(task.predictor.fit_all(starts, rounds=care, draws=care))
    orientation(0.6)
    if task.shape.is_cloud:
        task, candidates = _rescaled(task, candidates)
    chosen = candidates[: task.config.careful]
    chosen += [each for each in of_file(task, candidates) if each not in chosen]
    best = best_first(task.predictor.fit_all([(task.samples, each.pose) for each in chosen]))
    orientation(0.8)
    unusual = best[0].residual > SETTINGS.unusual_residual and not task.shape.is_cloud
    if unusual and task.config.partial != "yes" and not task.config.again:  # else it is asked again
        best = best_first([*best, *_turned_anywhere(task)])
    best += _about_face(task, best[0])
    orientation(1.0)
    return task, best_first(best)


def _turned_anywhere(task: FitTask) -> list[Candidate]:
    """Fits from the best of many frames, of a shape whose core frame the aligner does not know.

    People who fold forward, do the splits or wear a large head are read well by the network once their core is found.
    """
    frames = frames_anywhere(task.model, task.samples, task.config)
    if not frames:  # the orientation of this category is not searched
        return []
    rough = task.predictor.fit_all([(task.coarse, pose) for pose in frames], draws=1, measure=ranking_residual)
    careful = SETTINGS.careful_if_unusual
    return task.predictor.fit_all([(task.samples, each.pose) for each in best_first(rough)[:careful]])


def _about_face(task: FitTask, best: Candidate) -> list[Candidate]:
    """The best candidate turned about by its own up axis, where that fits about as well, and nobody says where the front is.

    The turned votes are ranked by single predictions, which are wrong where a vote is far from the core frame: people who
    make a bridge were taken to stand on all fours.
    """
    if task.config.front is not None or task.model.card.frame["orientation"] in ALIGNS:
        return []
    predictor = replace(task.predictor, rng=np.random.default_rng(task.config.seed))  # others draw what they would
    turned = predictor.fit_all([(task.samples, RigidPose(best.pose.rotation * _ABOUT, best.pose.center))])
    return [each for each in turned if each.residual < SETTINGS.about_margin * best.residual]


def of_file(task: FitTask, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Of a shape whose file says how it stands, the best candidate that stands so, where the best of all (the first) does
    not: it is to be tried too.
    """
    if not task.shape.upright or stands_upright(candidates[0].pose):
        return []
    return [each for each in candidates if stands_upright(each.pose)][:1]


def _rescaled(task: FitTask, candidates: list[Candidate]) -> tuple[FitTask, list[Candidate]]:
    """The task and the best candidates of a cloud in the scale, and without the outliers, that the best fit tells."""

    def fit_again(samples: OrientedPoints, pose: RigidPose) -> Candidate:
        return task.predictor.fit(samples, pose, draws=1, measure=lambda *_: 0.0)

    near = SETTINGS.scale_margin * candidates[0].residual
    best = [each for each in candidates[: task.config.careful] if each.residual <= near]
    isolated = isolated_points(task.samples.points)
    found = [estimate_scale(task.system, task.samples, isolated, candidate, fit_again) for candidate in best]
    # the last fits alone need their residuals
    residuals = [two_way_residual(task.system, left.to_local(fit.pose), fit.vectors) for _, left, fit in found]
    scale, samples, first = found[int(np.argmin(residuals))]
    first = replace(first, residual=min(residuals))
    others = [
        Candidate(RigidPose(each.pose.rotation, each.pose.center / scale), each.vectors, each.residual) for each in best
    ]
    return task.rescaled(scale, samples), [first, *others]


def estimate_scale(
    system: NodeSystem,
    samples: OrientedPoints,
    isolated: Bool[Bools, " P"],
    candidate: Candidate,
    fit_again: Callable[[OrientedPoints, RigidPose], Candidate],
) -> tuple[float, OrientedPoints, Candidate]:
    """Rescale samples of a cloud (area 1 by estimate) by the network's fit, drop outliers, fit again, a few times.

    Outliers are those of the ``isolated`` samples, see `isolated_points`, that lie far from the fit.

    Returns the scale, by which lengths of the old frame are to be divided; the samples that are left, in the new frame;
    and their fit.
    """
    resting = vertex_areas(system.verts, system.faces).sum()
    total = 1.0
    for _ in range(SETTINGS.scale_rounds):
        moved, pose = system.moved(candidate.vectors), candidate.pose
        step = np.sqrt(vertex_areas(moved, system.faces).sum() / resting)
        step = np.clip(step, 1 / SETTINGS.max_scale_change / total, SETTINGS.max_scale_change / total)
        keep = ~isolated
        keep[isolated] = cKDTree(pose.to_world(moved)).query(samples.points[isolated])[0] <= SETTINGS.outlier_distance
        total *= step
        samples, isolated = samples.rows(keep), isolated[keep]
        samples = replace(samples, points=samples.points / step)
        candidate = fit_again(samples, RigidPose(pose.rotation, pose.center / step))
        if keep.all() and abs(step - 1) < SETTINGS.scale_tolerance:
            break
    return float(total), samples, candidate


def isolated_points(points: Float[Floats, "P 3"]) -> Bool[Bools, " P"]:
    """Whether the nearest few points lie further away than is usual on the cloud.

    Samples of a small cloud repeat its points; copies of a point do not count as its neighbours.
    """
    own, which = np.unique(points, axis=0, return_inverse=True)
    reach = cKDTree(own).query(own, min(SETTINGS.neighbours + 1, len(own)))[0][:, -1]
    return np.asarray((reach > SETTINGS.isolation * np.median(reach))[which.reshape(-1)])


def candidates_of_part(task: FitTask, wide: bool = False) -> tuple[FitTask, list[Candidate]]:
    """The network's fits of a shape that may show only a part, best first, each with the share that it shows; and the task,
    whose predictor draws from its seed anew: each search draws the same random numbers.

    A ``wide`` search starts from more orientations; another one has no candidates where none is near, except for clouds,
    whose residuals are as large as their noise. Residuals are from the samples to the template only.
    """
    config = task.config
    if wide:
        config = replace(config, copies=2 * config.copies, hypotheses=2 * config.hypotheses)
    predictor = Predictor.of(task.model, np.random.default_rng(config.seed), config.device)
    task = replace(task, config=config, predictor=predictor)
    progress = task.progress.stage(STAGE)
    candidates = _careful(task, wide, progress.between(0.0, 0.4))
    if not (wide or task.shape.is_cloud) and min(each.residual for each in candidates) > SETTINGS.lost:
        return task, []
    for number, count in enumerate(SETTINGS.completed):
        candidates = _fitted_again(task, best_first(candidates)[:count])
        progress(0.4 + 0.2 * (number + 1) / len(SETTINGS.completed))
    candidates = best_first(candidates)
    for candidate in candidates[: SETTINGS.varied]:
        # other interpretations of the completed samples
        local, config = candidate.local(task.samples), task.config
        whole = completed(task.system, local, candidate.vectors, candidate.share, task.predictor.rng)
        near = local.first(SETTINGS.coarse_samples)
        for each in task.predictor.variants(whole, near, candidate.pose, config.variants, config.tilt):
            residual = one_way_residual(task.system, local, each.vectors)
            candidates.append(replace(each, residual=residual, share=candidate.share))
    return task, best_first(candidates)


def _careful(task: FitTask, wide: bool, progress: Progress) -> list[Candidate]:
    """Fits from the best frames if the samples show each of the shares.

    A wide search tries all its frames for some of the shares, and the best of these frames for the others.
    """
    found: list[Candidate] = []
    best: dict[int, float] = {}  # residuals of the frames that all shares have in common
    order = sorted(SETTINGS.shares, key=lambda share: wide and share not in SETTINGS.wide_shares)
    for number, share in enumerate(order):
        samples = scaled_to_area(task.samples, share)
        frames, others = frames_of_part(task.model, samples, task.config, wide, task.shape.upright)
        tried = list(range(len(others)))
        if wide and number >= len(SETTINGS.wide_shares):
            tried = sorted(best, key=lambda frame: best[frame])[: len(others) // SETTINGS.wide_kept]
        thin = samples.first(SETTINGS.ranking_samples_if_wide if wide else SETTINGS.ranking_samples)
        starts = [(thin, pose) for pose in [*(others[k] for k in tried), *frames]]
        rough = task.predictor.fit_all(starts, 1, 1, ranking_residual if wide else one_way_residual)
        for k, candidate in zip(tried, rough, strict=False):
            best[k] = min(candidate.residual, best.get(k, np.inf))
        rough.sort(key=lambda candidate: candidate.residual)
        limit = SETTINGS.worth_if_wide * rough[0].residual if wide else np.inf
        careful = [(samples, each.pose) for each in rough[: SETTINGS.careful] if each.residual <= limit]
        found += [replace(fit, share=share) for fit in task.predictor.fit_all(careful, measure=one_way_residual)]
        progress((number + 1) / len(order))
    return found


def _fitted_again(task: FitTask, candidates: Sequence[Candidate]) -> list[Candidate]:
    """New fits of the samples, completed by the last fits; how much of these was visible is the new share."""
    system, starts, shares = task.system, [], []
    placed = [candidate.local(task.samples) for candidate in candidates]
    shown = parallel_map(
        lambda local, each: visible_vertices(system, local.first(SETTINGS.coarse_samples), each.vectors),
        placed,
        candidates,
    )
    for candidate, local, visible in zip(candidates, placed, shown, strict=True):
        vectors = candidate.vectors
        shares.append(float(np.clip(area_share(system, visible), SETTINGS.min_share, 1.0)))
        whole = completed(system, local, vectors, candidate.share, task.predictor.rng, visible)
        growth = np.sqrt(shares[-1] / candidate.share)
        starts.append((replace(whole, points=whole.points * growth), RigidPose.identity()))
    # unmeasured: the residual is that of other samples, once these are placed
    again = task.predictor.fit_all(starts, measure=lambda *_: 0.0)

    def measured(candidate: Candidate, fit: Candidate, share: float) -> Candidate:
        last = candidate.pose
        pose = RigidPose(last.rotation, np.sqrt(share / candidate.share) * last.center) @ fit.pose
        moved = replace(fit, pose=pose, share=share)
        return replace(moved, residual=one_way_residual(system, moved.local(task.samples), fit.vectors))

    return parallel_map(measured, candidates, again, shares)


def completed(
    system: NodeSystem,
    local: OrientedPoints,
    vectors: Float[Floats, "K 3"],
    share: float,
    rng: np.random.Generator,
    visible: Bool[Bools, " V"] | None = None,
) -> OrientedPoints:
    """Samples (core frame) of a ``share`` of the surface, with points of the fitted template where they show nothing.

    ``visible`` says where they do, if that is known: `visible_vertices` of as many samples as are asked.
    """
    surface = system.surface(vectors)
    if visible is None:
        visible = visible_vertices(system, local, vectors)
    faces = system.faces[~visible[system.faces].any(axis=1)]
    if not len(faces):
        return local
    missing = Shape(surface.points, faces)
    if not missing.area > 0:
        return local
    P = len(local.points)
    count = min(round(P * missing.area / share), SETTINGS.max_added * P)
    added = sample_surface(missing, count, rng)
    local = local.facing(surface)
    order = rng.permutation(P + count)
    return replace(
        local,
        points=np.concatenate([local.points, added.points])[order],
        normals=np.concatenate([local.normals, added.normals])[order],
        weights=None if local.weights is None else np.append(local.weights, np.ones(count))[order],
    )
