"""Interpolation: a curve through several fits of one template and beyond them, and the deviation of its poses.

Either the deformations themselves are blended (`meshmatch.fitting.solve.blend`), or the network's latent codes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.interpolate import CubicSpline

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.search.task import take_samples
from meshmatch.fitting.solve.blend import FieldPath, RotationBlend, StretchBlend, polar
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape

Way = Literal["field", "codes"]
"""What is blended between fits, see `Blend`."""
WAYS: tuple[Way, ...] = get_args(Way)
_SAMPLES = 2048  # samples from which a shape's code is computed
BlendPath = Callable[[Float[Floats, " n"]], Float[Floats, "K 3"]]
"""From weights of the n key shapes to node vectors."""


@dataclass(frozen=True)
class Deviation:
    """Deviation of a pose from the stretch that it should have, and from the rest template; means over the surface.

    With S the log-Euclidean blend of the fits' stretches, ``volume`` is |det F - det S| and ``arap`` is |F^T F - S^T S|
    (Frobenius); both are 0 at the fits. ``template_volume`` and ``template_arap`` are the same for S = I: the paper's
    energies, without the square. They include the shapes' own difference from the template.
    """

    volume: float
    arap: float
    template_volume: float
    template_arap: float


class Blend:
    """A curve through several fits of one template.

    All quantities are blended with the same weights of the fits: linearly between two fits, by a natural cubic spline
    through more, and linearly beyond the ends. The curve passes through the fits exactly: the difference between path and
    fits is blended and added. For a path of codes this difference is large; it is blended in local frames that rotate with
    the deformation.

    Parameters
    ----------
    model : the model of the fits; or, without a model, the system that deforms the template, which can blend the "field"
        only
    fits : at least two, of one template
    times : (n,) increasing times of the fits; by default evenly spaced from 0 to 1
    shapes : the repaired shapes; for "codes" only
    way : blend the deformation "field", or the latent "codes" of the shapes

    Raises `OptionError` for fewer than two fits, fits of another template, times that do not increase, an unknown ``way``,
    or "field" for a model without nodes.
    """

    def __init__(
        self,
        model: TrainedModel | NodeSystem,
        fits: Sequence[Fit],
        times: Sequence[float] | None = None,
        shapes: Sequence[Shape] | None = None,
        way: Way = "field",
    ) -> None:
        if len(fits) < 2:
            raise OptionError("at least two shapes are needed to blend between them")
        trained = None if isinstance(model, NodeSystem) else model
        for fit in fits:
            fit.check_template(fits[0].template_hash if trained is None else trained.template.hash)
        self.times = np.linspace(0, 1, len(fits)) if times is None else np.asarray(times, float)
        if self.times.shape != (len(fits),) or not (np.diff(self.times) > 0).all():
            raise OptionError(f"{len(fits)} shapes need as many times, each later than the one before")
        self._curve = CubicSpline(self.times, np.eye(len(fits)), bc_type="natural")
        self._keys = np.stack([fit.vectors for fit in fits])
        self._system = model if isinstance(model, NodeSystem) else node_system(model)
        self._stretches = StretchBlend([polar(self._system.deformation_gradient(key))[1] for key in self._keys])
        if way == "field":
            if trained is not None and not trained.has_nodes:
                raise OptionError(
                    f"model {trained.card.name} is pointwise: it has no nodes that could blend what the field does",
                    "blend codes instead (--blend codes), or use a model of another field",
                )
            core = np.arange(len(self._system.verts)) if trained is None else trained.template.core
            self._path: BlendPath = FieldPath(self._system, list(self._keys), core)
        elif way == "codes":
            if trained is None:
                raise OptionError("without a model there are no codes", "blend the field instead")
            if shapes is None or len(shapes) != len(fits):
                raise OptionError("blending codes needs the shape of each fit")
            self._path = _code_path(trained, shapes, fits)
        else:
            raise OptionError(f"unknown way to blend {way!r}", f"choose one of {', '.join(WAYS)}")
        at_keys = [self._path(row) for row in np.eye(len(fits))]
        self._correction = self._keys - np.stack(at_keys)
        self._node_field = None
        if way == "codes" and trained is not None and trained.has_nodes:
            # Template vertices, unlike nodes, are certain to have enough nodes in reach: use the one nearest to each node.
            verts = trained.template.shape.verts
            self._node_field = trained.field(verts[cKDTree(verts).query(trained.template.nodes)[1]])
            rotations = np.stack([polar(self._node_field.deformation_gradient_at(vectors))[0] for vectors in at_keys])
            self._correction = np.einsum("nkij,nki->nkj", rotations, self._correction)
        self._turns = RotationBlend([fit.frame.turn[None] for fit in fits])
        self._scales = np.array([fit.frame.scale for fit in fits])
        self._centers = np.stack([fit.frame.center for fit in fits])

    def weights(self, time: float) -> Float[Floats, " n"]:
        """Weights (n,) of the fits at a time; they sum to one."""
        inside = float(np.clip(time, self.times[0], self.times[-1]))
        near = self._curve(inside)
        if time == inside:
            met = np.flatnonzero(self.times == time)
            return np.eye(len(self.times))[met[0]] if len(met) else near
        return near + (time - inside) * self._curve(inside, 1)

    def vectors(self, time: float) -> Float[Floats, "K 3"]:
        """Node vectors at a time, core frame."""
        weights = self.weights(time)
        if weights.max() == 1.0:  # a fit itself
            return np.asarray(self._keys[weights.argmax()])
        on_path, correction = self._path(weights), np.tensordot(weights, self._correction, 1)
        if self._node_field is not None:
            correction = np.einsum(
                "kij,kj->ki", polar(self._node_field.deformation_gradient_at(on_path))[0], correction
            )
        return on_path + correction

    def points(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "V 3"]:
        """Template vertices of a pose, core frame."""
        return self._system.moved(vectors)

    def turns(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "V 3 3"]:
        """Rotations of the deformation at each template vertex."""
        return polar(self._system.field.deformation_gradient_at(vectors))[0]

    def frame(self, time: float) -> Frame:
        """The fits' frames, blended: rotation, position and scale."""
        weights = self.weights(time)
        scale = float(np.exp(weights @ np.log(self._scales)))
        return Frame(scale, self._turns.at(weights)[0], weights @ self._centers)

    def deviation(self, time: float, vectors: Float[Floats, "K 3"]) -> Deviation:
        """Deviation of a pose at a time."""
        F = self._system.deformation_gradient(vectors)
        S = self._stretches.at(self.weights(time))
        return Deviation(*_energies(F, S), *_energies(F, np.eye(3)[None]))


def _energies(F: Float[Floats, "G 3 3"], S: Float[Floats, "... 3 3"]) -> tuple[float, float]:
    """Means of |det F - det S| and |F^T F - S^T S|."""
    volume = np.abs(np.linalg.det(F) - np.linalg.det(S)).mean()
    difference = F.transpose(0, 2, 1) @ F - S.transpose(0, 2, 1) @ S
    return float(volume), float(np.linalg.norm(difference, axis=(1, 2)).mean())


def _code_path(model: TrainedModel, shapes: Sequence[Shape], fits: Sequence[Fit]) -> BlendPath:
    """A path of blended codes; each code is computed from samples of a shape in the core frame of its fit."""
    network = model.inference
    codes = []
    for shape, fit in zip(shapes, fits, strict=True):
        frame, samples = take_samples(shape, _SAMPLES, np.random.default_rng(fit.seed))
        codes.append(network.encode(fit.frame.apply(frame.undo(samples.points))))
    return lambda weights: network.decode(weights @ np.stack(codes))
