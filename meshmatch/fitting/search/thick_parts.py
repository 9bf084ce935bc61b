"""A part much thicker than any of an ordinary body, such as the head of a cartoon, read as if it were smaller.

The network takes a head that is larger than all the rest for a trunk that bends over. So the largest ball inside a shape is
looked for, what lies around it is drawn together, and that shape is fitted. What was found is carried back, and refined on
the shape as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.derived import derived
from meshmatch.fitting.search.predictor import Candidate
from meshmatch.fitting.search.refinement import WholeComparison, fit_whole
from meshmatch.fitting.search.task import FitTask, Registration, take_samples
from meshmatch.geometry.frames import RigidPose, kabsch
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.trained import TrainedModel
from meshmatch.threads import parallel_map


@dataclass(frozen=True, kw_only=True)
class ThicknessSettings:
    """All set by hand on stylised people.

    Attributes
    ----------
    thick : a part that holds a ball so many times as large as the resting template does is thick: trunks of SCAPE and FAUST
        hold 1.0 to 1.14 times its ball, heads of stylised people that are read wrongly 1.17 to 2
    factors : by which it is drawn together, in turn
    around : so many radii around the middle of the ball are drawn together evenly
    balls : samples at which balls that touch the surface are looked for
    margin : the fit is taken if its score is less than this times that of the fit before
    """

    thick: float = 1.1
    factors: tuple[float, ...] = (0.36, 0.5, 0.65)
    around: float = 1.3
    balls: int = 500
    margin: float = 0.98


SETTINGS = ThicknessSettings()
_SAMPLES = 8192  # of the template
_STEPS = 40  # in which a ball is made smaller at most
_TOUCHES = 0.02  # of its radius by which a sample may lie inside a ball
# How far directions from the middle of a ball inside to samples around may agree, and how far normals must agree with them.
_ONE_SIDED, _OUTWARD = 0.6, 0.3


def with_thick_part_smaller(found: Registration) -> Registration | None:
    """A fit of a whole by way of the same shape with its thickest part drawn together, where it has one, and where that is
    better.
    """
    task, best = found.task, found.candidate
    if not (task.samples.signed and task.system.linear):
        return None
    usual, ball = usual_ball(task.model), largest_ball(task.samples, SETTINGS.balls)
    if usual is None or ball is None or ball[1] < SETTINGS.thick * usual:
        return None
    comparison = WholeComparison(task, [])

    def through(factor: float) -> Candidate:
        contraction = Contraction(ball[0], SETTINGS.around * ball[1], factor)
        return comparison.refined(_read_through(task, contraction), in_full=True)

    refined = parallel_map(through, SETTINGS.factors)
    scores = [comparison.score(each, False) for each in refined]
    better = min(scores) < SETTINGS.margin * comparison.score(best, False)
    return replace(found, candidate=refined[int(np.argmin(scores))]) if better else None


@derived
def usual_ball(model: TrainedModel) -> float | None:
    """Radius of the largest ball inside a model's resting template (units of sqrt(area))."""
    samples = take_samples(model.template.shape, _SAMPLES, np.random.default_rng(0))[1]
    ball = largest_ball(samples, SETTINGS.balls)
    return None if ball is None else ball[1]


@dataclass(frozen=True, eq=False)
class Contraction:
    """Draws what lies within ``reach`` of a middle together by a ``factor``; all else follows towards the middle."""

    middle: Float[Floats, " 3"]
    reach: float
    factor: float

    def drawn(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points after the contraction."""
        away, distance = self._from_middle(points)
        nearer = 1 - self.reach * (1 - self.factor) / np.maximum(distance, self.reach)
        return self.middle + away * np.where(distance < self.reach, self.factor, nearer)

    def back(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points before the contraction."""
        away, distance = self._from_middle(points)
        inner = self.reach * self.factor
        farther = 1 + (self.reach - inner) / np.maximum(distance, inner)
        return self.middle + away * np.where(distance < inner, 1 / self.factor, farther)

    def _from_middle(self, points: Floats) -> tuple[Floats, Floats]:
        away = points - self.middle
        return away, np.linalg.norm(away, axis=1, keepdims=True)


def _read_through(task: FitTask, contraction: Contraction) -> Candidate:
    """The candidate that a fit of the contracted shape (contraction: frame of the samples) gives for the shape itself."""
    frame, shape, system = task.frame, task.shape, task.system

    def contracted(points: Floats) -> Floats:
        return np.asarray(frame.undo(contraction.drawn(frame.apply(points))))

    landmarks = None if task.landmarks is None else (task.landmarks[0], contracted(task.landmarks[1]))
    other = replace(shape, verts=contracted(shape.verts))
    config = replace(task.config, finalists=1)
    read = fit_whole(FitTask.of(task.model, config, other, landmarks, mirrored=frame.mirrored))
    placed = frame.apply(read.core_frame.undo(system.moved(read.candidate.vectors)))
    moved = contraction.back(placed)
    core = task.model.template.core
    pose: RigidPose = kabsch(system.verts[core], moved[core])
    return Candidate(pose, system.vectors_to(pose.to_local(moved)), 0.0)


def largest_ball(samples: OrientedPoints, count: int) -> tuple[Float[Floats, " 3"], float] | None:
    """Middle and radius of the largest of ``count`` balls inside a surface; None where there are none.

    Each touches the surface in a sample, and is made smaller until no other sample lies inside it.
    """
    points, normals, tree = samples.points, samples.normals, cKDTree(samples.points)
    touched = np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.int64)
    at, out = points[touched], normals[touched]
    radius = np.full(len(at), float(np.ptp(points, axis=0).max()))
    for _ in range(_STEPS):
        distance, nearest = tree.query(at - radius[:, None] * out)
        across = at - points[nearest]
        along = 2 * np.einsum("nd,nd->n", across, out)
        inside = (distance < radius * (1 - 1e-3)) & (along > 1e-9)
        smaller = np.square(across).sum(1) / np.where(inside, along, 1.0)
        if not inside.any():
            break
        radius = np.where(inside, np.minimum(smaller, radius), radius)
    middles = at - radius[:, None] * out
    empty = tree.query(middles)[0] > radius * (1 - _TOUCHES)
    for k in sorted(np.flatnonzero(empty), key=lambda k: -radius[k]):
        around = tree.query_ball_point(middles[k], 1.5 * radius[k])
        towards = points[around] - middles[k]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        outward = np.einsum("nd,nd->n", towards, normals[around]).mean()
        if np.linalg.norm(towards.mean(0)) < _ONE_SIDED and outward > _OUTWARD:
            return middles[k], float(radius[k])
    return None
