"""Fits of shapes with a part much thicker than any of an ordinary body, such as the head of a cartoon character.

The network mistakes a head that is larger than all the rest for a trunk that bends over. So the largest ball inside the
shape is found, its surroundings are contracted, and the contracted shape is fitted. The fit is mapped back and refined on
the original shape.
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
    min_ball_ratio : a part is thick if it contains a ball this many times as large as the rest template does: trunks of
        SCAPE and FAUST contain 1.0 to 1.14 times its ball, misread heads of stylised people 1.17 to 2
    factors : contraction factors to try, in order
    contracted_radii : the contraction is uniform within this many radii of the ball's center
    n_balls : number of samples at which balls touching the surface are tried
    margin : the fit is accepted if its score is below this multiple of the original fit's
    """

    min_ball_ratio: float = 1.1
    factors: tuple[float, ...] = (0.36, 0.5, 0.65)
    contracted_radii: float = 1.3
    n_balls: int = 500
    margin: float = 0.98


SETTINGS = ThicknessSettings()
_SAMPLES = 8192  # number of samples of the template
_MAX_SHRINKS = 40  # maximum number of times that a ball is shrunk
_MAX_DEPTH = 0.02  # depth, as a share of the radius, at which a sample may lie inside a ball
# A ball is inside the shape if the mean direction from its center to nearby samples is shorter than the first number (they
# are on all sides), and the mean cosine between these directions and the samples' normals exceeds the second.
_MAX_MEAN_DIRECTION, _MIN_OUTWARD_COSINE = 0.6, 0.3


def with_thick_part_smaller(found: Registration) -> Registration | None:
    """Fit a whole shape by way of a copy with its thickest part contracted.

    None if the shape has no thick part, or if the result is no better.
    """
    task, best = found.task, found.candidate
    if not (task.samples.signed and task.system.linear):
        return None
    rest_radius, ball = template_ball_radius(task.model), largest_ball(task.samples, SETTINGS.n_balls)
    if rest_radius is None or ball is None or ball[1] < SETTINGS.min_ball_ratio * rest_radius:
        return None
    comparison = WholeComparison(task, [])

    def fit_with(factor: float) -> Candidate:
        contraction = Contraction(ball[0], SETTINGS.contracted_radii * ball[1], factor)
        return comparison.refined(_fit_contracted(task, contraction), in_full=True)

    refined = parallel_map(fit_with, SETTINGS.factors)
    scores = [comparison.score(each, False) for each in refined]
    better = min(scores) < SETTINGS.margin * comparison.score(best, False)
    return replace(found, candidate=refined[int(np.argmin(scores))]) if better else None


@derived
def template_ball_radius(model: TrainedModel) -> float | None:
    """Radius of the largest ball inside a model's rest template (units of sqrt(area))."""
    samples = take_samples(model.template.shape, _SAMPLES, np.random.default_rng(0))[1]
    ball = largest_ball(samples, SETTINGS.n_balls)
    return None if ball is None else ball[1]


@dataclass(frozen=True, eq=False)
class Contraction:
    """Scales everything within ``reach`` of ``middle`` by ``factor``, and moves the rest towards the middle accordingly."""

    middle: Float[Floats, " 3"]
    reach: float
    factor: float

    def apply(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points after the contraction."""
        away, distance = self._from_middle(points)
        nearer = 1 - self.reach * (1 - self.factor) / np.maximum(distance, self.reach)
        return self.middle + away * np.where(distance < self.reach, self.factor, nearer)

    def invert(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """The inverse: points before the contraction."""
        away, distance = self._from_middle(points)
        inner = self.reach * self.factor
        farther = 1 + (self.reach - inner) / np.maximum(distance, inner)
        return self.middle + away * np.where(distance < inner, 1 / self.factor, farther)

    def _from_middle(self, points: Floats) -> tuple[Floats, Floats]:
        away = points - self.middle
        return away, np.linalg.norm(away, axis=1, keepdims=True)


def _fit_contracted(task: FitTask, contraction: Contraction) -> Candidate:
    """Fit a contracted copy of the shape, and map the result back to a candidate.

    The contraction is in the frame of the samples.
    """
    frame, shape, system = task.frame, task.shape, task.system

    def contracted(points: Floats) -> Floats:
        return np.asarray(frame.undo(contraction.apply(frame.apply(points))))

    landmarks = None if task.landmarks is None else (task.landmarks[0], contracted(task.landmarks[1]))
    other = replace(shape, verts=contracted(shape.verts))
    config = replace(task.config, finalists=1)
    read = fit_whole(FitTask.of(task.model, config, other, landmarks, mirrored=frame.mirrored))
    placed = frame.apply(read.core_frame.undo(system.moved(read.candidate.vectors)))
    moved = contraction.invert(placed)
    core = task.model.template.core
    pose: RigidPose = kabsch(system.verts[core], moved[core])
    return Candidate(pose, system.vectors_to(pose.to_local(moved)), 0.0)


def largest_ball(samples: OrientedPoints, count: int) -> tuple[Float[Floats, " 3"], float] | None:
    """Center and radius of the largest of ``count`` balls inside a surface; None if there are none.

    Each ball touches the surface at a sample and is shrunk until it contains no other sample.
    """
    points, normals, tree = samples.points, samples.normals, cKDTree(samples.points)
    touched = np.linspace(0, len(points) - 1, min(count, len(points))).astype(np.int64)
    at, out = points[touched], normals[touched]
    radius = np.full(len(at), float(np.ptp(points, axis=0).max()))
    for _ in range(_MAX_SHRINKS):
        distance, nearest = tree.query(at - radius[:, None] * out)
        across = at - points[nearest]
        along = 2 * np.einsum("nd,nd->n", across, out)
        inside = (distance < radius * (1 - 1e-3)) & (along > 1e-9)
        smaller = np.square(across).sum(1) / np.where(inside, along, 1.0)
        if not inside.any():
            break
        radius = np.where(inside, np.minimum(smaller, radius), radius)
    middles = at - radius[:, None] * out
    empty = tree.query(middles)[0] > radius * (1 - _MAX_DEPTH)
    for k in sorted(np.flatnonzero(empty), key=lambda k: -radius[k]):
        around = tree.query_ball_point(middles[k], 1.5 * radius[k])
        towards = points[around] - middles[k]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        outward = np.einsum("nd,nd->n", towards, normals[around]).mean()
        if np.linalg.norm(towards.mean(0)) < _MAX_MEAN_DIRECTION and outward > _MIN_OUTWARD_COSINE:
            return middles[k], float(radius[k])
    return None
