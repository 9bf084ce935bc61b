"""The network's candidates for a shape that is assumed to be complete, or to be a part.

Clouds: their area is only an estimate, which is too small where points are few and noisy, and outliers look like surface.
The network's own fit gives a better scale, as its template has the area of a body; isolated points far from it are outliers.

Parts: the size of the whole is unknown, so several shares of the surface are tried. The samples must lie on the template;
the rest of the template is left to the network and to the prior on its gradient.

The network was mostly trained on complete shapes. For a part, the fitted template therefore fills in what is missing, and
the network predicts again from both together. Refinement then holds hidden template where the network predicts it, and
nothing beyond a cut is pulled onto the border of the cut.
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
from meshmatch.shapes.alignment import ALIGNS
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map

STAGE = "fitting as a part"
_HALF_TURN = np.array([-1.0, 1.0, -1.0])  # signs of a rotation's columns after half a turn about its own y axis


@dataclass(frozen=True, kw_only=True)
class CandidateSettings:
    """How the network's candidates are found. All set by hand; lengths and residuals are in units of sqrt(area).

    Attributes
    ----------
    scale_rounds : how often the scale and the outliers of a cloud are estimated
    max_scale_change : largest total change of scale, as a factor; more indicates a wrong fit rather than a wrong area
    outlier_distance : isolated points farther than this from the fitted template are outliers
    isolation_ratio : a point is isolated if its neighbours reach this many times as far as the cloud's median
    n_neighbours : number of neighbours for this
    scale_tolerance : relative change of the scale below which the estimate has converged
    scale_margin : candidates with a residual up to this multiple of the best one's estimate a cloud's scale
    unusual_residual : if all candidates have a larger residual, the aligner may not know the shape's pose
    n_careful_if_unusual : how many of the frames that are then tried are fitted on all samples
    half_turn_margin : the best candidate is also kept after half a turn if its residual then is below this multiple
    shares : shares of the surface that a part may show
    min_share : the smallest share that a shape is assumed to show
    max_narrow_residual : if all residuals exceed this, the candidates of a narrow search are not worth refining: those of
        people's parts that were fitted right are 0.020 to 0.030
    wide_shares : shares for which a wide search tries all frames
    wide_kept_divisor : one in this many of these frames, the best, is tried for the other shares
    ranking_samples, ranking_samples_if_wide : number of samples for ranking frames
    n_careful : candidates per share that are fitted on all samples
    careful_margin_if_wide : in a wide search, only those with a residual up to this multiple of the best one's
    n_completed : how many candidates are completed and fitted again in each of the rounds
    n_varied : candidates for which variants are sought
    coarse_samples : number of samples for comparing variants and for finding visible vertices
    max_added_per_sample : maximum number of points per sample that complete the samples
    """

    scale_rounds: int = 3
    max_scale_change: float = 1.3
    outlier_distance: float = 0.06
    isolation_ratio: float = 1.5
    n_neighbours: int = 8
    scale_tolerance: float = 0.005
    scale_margin: float = 1.1
    unusual_residual: float = 0.045
    n_careful_if_unusual: int = 12
    half_turn_margin: float = 1.1
    shares: tuple[float, ...] = (1.0, 0.8, 0.62, 0.48, 0.36)
    min_share: float = 0.2
    max_narrow_residual: float = 0.034
    wide_shares: tuple[float, ...] = (0.62,)
    wide_kept_divisor: int = 8
    ranking_samples: int = 768
    ranking_samples_if_wide: int = 512
    n_careful: int = 5
    careful_margin_if_wide: float = 1.3
    n_completed: tuple[int, ...] = (10, 5, 3)
    n_varied: int = 1
    coarse_samples: int = 2048
    max_added_per_sample: int = 3


SETTINGS = CandidateSettings()


def candidates_of_whole(task: FitTask) -> tuple[FitTask, list[Candidate]]:
    """The network's candidates for a shape that is assumed to be complete, best first; and the task.

    For a cloud, the task has the scale that the best candidate gives, without the outliers that it shows.
    """
    orientation = task.progress.stage("orientation")
    orientation(0.0)
    # The residual of a cloud is unreliable until its core frame is found, which takes a second round.
    repeats = 2 if task.shape.is_cloud else 1
    starts = [(task.coarse, pose) for pose in frames_to_try(task.model, task.samples, task.config, task.shape.upright)]
    candidates = best_first(task.predictor.fit_all(starts, rounds=repeats, draws=repeats))
    orientation(0.6)
    if task.shape.is_cloud:
        task, candidates = _rescaled(task, candidates)
    chosen = candidates[: task.config.careful]
    chosen += [each for each in upright_candidate(task, candidates) if each not in chosen]
    best = best_first(task.predictor.fit_all([(task.samples, each.pose) for each in chosen]))
    orientation(0.8)
    unusual = best[0].residual > SETTINGS.unusual_residual and not task.shape.is_cloud
    # with `again`, a fit with a specific reason against it is repeated anyway, with this search
    if unusual and task.config.partial != "yes" and not task.config.again:
        best = best_first([*best, *_candidates_from_all_rotations(task)])
    best += _half_turned(task, best[0])
    orientation(1.0)
    return task, best_first(best)


def _candidates_from_all_rotations(task: FitTask) -> list[Candidate]:
    """Candidates from the best of many evenly spread frames, for a shape whose core frame the aligner does not find.

    The network predicts people who fold forward, do the splits or have a large head well once their core is found.
    """
    frames = frames_anywhere(task.model, task.samples, task.config)
    if not frames:  # this category has a fixed orientation
        return []
    rough = task.predictor.fit_all([(task.coarse, pose) for pose in frames], draws=1, measure=ranking_residual)
    careful = SETTINGS.n_careful_if_unusual
    return task.predictor.fit_all([(task.samples, each.pose) for each in best_first(rough)[:careful]])


def _half_turned(task: FitTask, best: Candidate) -> list[Candidate]:
    """The best candidate after half a turn about its up axis, as a list, if that fits about as well.

    Empty if the user gives the front. Flipped votes are ranked by single predictions, which are wrong if a vote is far from
    the core frame: people in a bridge were read as being on all fours.
    """
    if task.config.front is not None or task.model.card.frame["orientation"] in ALIGNS:
        return []
    # A generator of its own, so that later steps draw the same numbers as without this one.
    predictor = replace(task.predictor, rng=np.random.default_rng(task.config.seed))
    turned = predictor.fit_all([(task.samples, RigidPose(best.pose.rotation * _HALF_TURN, best.pose.center))])
    return [each for each in turned if each.residual < SETTINGS.half_turn_margin * best.residual]


def upright_candidate(task: FitTask, candidates: Sequence[Candidate]) -> list[Candidate]:
    """For an upright file: the best upright candidate, as a list, if the best of all is not upright; otherwise empty."""
    if not task.shape.upright or stands_upright(candidates[0].pose):
        return []
    return [each for each in candidates if stands_upright(each.pose)][:1]


def _rescaled(task: FitTask, candidates: list[Candidate]) -> tuple[FitTask, list[Candidate]]:
    """The task and its best candidates for a cloud, in the scale that the best fit gives and without its outliers."""

    def fit_again(samples: OrientedPoints, pose: RigidPose) -> Candidate:
        return task.predictor.fit(samples, pose, draws=1, measure=lambda *_: 0.0)

    max_residual = SETTINGS.scale_margin * candidates[0].residual
    best = [each for each in candidates[: task.config.careful] if each.residual <= max_residual]
    isolated = isolated_points(task.samples.points)
    found = [estimate_scale(task.system, task.samples, isolated, candidate, fit_again) for candidate in best]
    # only the final fits need residuals
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
    """Rescale samples of a cloud (estimated area 1) by the network's fit, drop outliers and fit again, in a few rounds.

    Outliers are ``isolated`` samples (see `isolated_points`) that are far from the fit. Returns the scale by which lengths
    of the old frame are to be divided, the remaining samples in the new frame, and their fit.
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
    """Whether the nearest few neighbours of each point (P,) are farther away than is usual for the cloud.

    Samples of a small cloud repeat its points; copies of a point are not its neighbours.
    """
    unique_points, index = np.unique(points, axis=0, return_inverse=True)
    reach = cKDTree(unique_points).query(unique_points, min(SETTINGS.n_neighbours + 1, len(unique_points)))[0][:, -1]
    return np.asarray((reach > SETTINGS.isolation_ratio * np.median(reach))[index.reshape(-1)])


def candidates_of_part(task: FitTask, wide: bool = False) -> tuple[FitTask, list[Candidate]]:
    """The network's candidates for a shape that may show only a part, best first; and the task.

    Each candidate has the share that the shape shows. The task's predictor restarts from its seed, so every search draws
    the same random numbers. A ``wide`` search tries more orientations. Any other search returns no candidates if none is
    near, except for clouds, whose residuals are as large as their noise. Residuals are from the samples to the template
    only.
    """
    config = task.config
    if wide:
        config = replace(config, copies=2 * config.copies, hypotheses=2 * config.hypotheses)
    predictor = Predictor.of(task.model, np.random.default_rng(config.seed), config.device)
    task = replace(task, config=config, predictor=predictor)
    progress = task.progress.stage(STAGE)
    candidates = _careful(task, wide, progress.between(0.0, 0.4))
    if not (wide or task.shape.is_cloud) and min(each.residual for each in candidates) > SETTINGS.max_narrow_residual:
        return task, []
    for number, count in enumerate(SETTINGS.n_completed):
        candidates = _refit_completed(task, best_first(candidates)[:count])
        progress(0.4 + 0.2 * (number + 1) / len(SETTINGS.n_completed))
    candidates = best_first(candidates)
    for candidate in candidates[: SETTINGS.n_varied]:
        # further candidates from the completed samples
        local, config = candidate.local(task.samples), task.config
        whole = completed(task.system, local, candidate.vectors, candidate.share, task.predictor.rng)
        near = local.first(SETTINGS.coarse_samples)
        for each in task.predictor.variants(whole, near, candidate.pose, config.variants, config.tilt):
            residual = one_way_residual(task.system, local, each.vectors)
            candidates.append(replace(each, residual=residual, share=candidate.share))
    return task, best_first(candidates)


def _careful(task: FitTask, wide: bool, progress: Progress) -> list[Candidate]:
    """Candidates from the best frames, for each share of the surface that the samples may show.

    A wide search tries all its frames for some of the shares, and the best of them for the other shares.
    """
    found: list[Candidate] = []
    best: dict[int, float] = {}  # residuals, by index, of the frames that are common to all shares
    order = sorted(SETTINGS.shares, key=lambda share: wide and share not in SETTINGS.wide_shares)
    for number, share in enumerate(order):
        samples = scaled_to_area(task.samples, share)
        frames, others = frames_of_part(task.model, samples, task.config, wide, task.shape.upright)
        frame_numbers = list(range(len(others)))
        if wide and number >= len(SETTINGS.wide_shares):
            frame_numbers = sorted(best, key=lambda frame: best[frame])[: len(others) // SETTINGS.wide_kept_divisor]
        ranking = samples.first(SETTINGS.ranking_samples_if_wide if wide else SETTINGS.ranking_samples)
        starts = [(ranking, pose) for pose in [*(others[k] for k in frame_numbers), *frames]]
        ranked = task.predictor.fit_all(starts, 1, 1, ranking_residual if wide else one_way_residual)
        for k, candidate in zip(frame_numbers, ranked, strict=False):
            best[k] = min(candidate.residual, best.get(k, np.inf))
        ranked.sort(key=lambda candidate: candidate.residual)
        limit = SETTINGS.careful_margin_if_wide * ranked[0].residual if wide else np.inf
        careful = [(samples, each.pose) for each in ranked[: SETTINGS.n_careful] if each.residual <= limit]
        found += [replace(fit, share=share) for fit in task.predictor.fit_all(careful, measure=one_way_residual)]
        progress((number + 1) / len(order))
    return found


def _refit_completed(task: FitTask, candidates: Sequence[Candidate]) -> list[Candidate]:
    """Fit the samples again, completed by the last fits; the visible share of these becomes the new share."""
    system, starts, shares = task.system, [], []
    local_samples = [candidate.local(task.samples) for candidate in candidates]
    visible_of_each = parallel_map(
        lambda local, each: visible_vertices(system, local.first(SETTINGS.coarse_samples), each.vectors),
        local_samples,
        candidates,
    )
    for candidate, local, visible in zip(candidates, local_samples, visible_of_each, strict=True):
        vectors = candidate.vectors
        shares.append(float(np.clip(area_share(system, visible), SETTINGS.min_share, 1.0)))
        whole = completed(system, local, vectors, candidate.share, task.predictor.rng, visible)
        growth = np.sqrt(shares[-1] / candidate.share)
        starts.append((replace(whole, points=whole.points * growth), RigidPose.identity()))
    # The residual is measured below, on the original samples.
    refitted = task.predictor.fit_all(starts, measure=lambda *_: 0.0)

    def measured(candidate: Candidate, fit: Candidate, share: float) -> Candidate:
        last_pose = candidate.pose
        pose = RigidPose(last_pose.rotation, np.sqrt(share / candidate.share) * last_pose.center) @ fit.pose
        moved = replace(fit, pose=pose, share=share)
        return replace(moved, residual=one_way_residual(system, moved.local(task.samples), fit.vectors))

    return parallel_map(measured, candidates, refitted, shares)


def completed(
    system: NodeSystem,
    local: OrientedPoints,
    vectors: Float[Floats, "K 3"],
    share: float,
    rng: np.random.Generator,
    visible: Bool[Bools, " V"] | None = None,
) -> OrientedPoints:
    """Complete samples of a ``share`` of the surface by points of the fitted template where they show nothing.

    Samples are in the core frame. ``visible`` are the `visible_vertices` of the template, computed from the samples if not
    given.
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
    count = min(round(P * missing.area / share), SETTINGS.max_added_per_sample * P)
    added = sample_surface(missing, count, rng)
    local = local.facing(surface)
    order = rng.permutation(P + count)
    return replace(
        local,
        points=np.concatenate([local.points, added.points])[order],
        normals=np.concatenate([local.normals, added.normals])[order],
        weights=None if local.weights is None else np.append(local.weights, np.ones(count))[order],
    )
