"""Networks for the signed distances of a category: one template, which the code of a shape deforms and corrects.

After *Deformed Implicit Field* (Deng, Yang and Tong, CVPR 2021), in the cube from -1 to 1:

    f(x) = T(x + u(x)) + c(x)

T is the template's signed distance, u the deformation and c the correction of the shape with code z. Codes are trained
with the weights, one for each shape. There are two deformations with the same interface: `PointwiseDeformation` is that
paper's, a network whose weights a hypernetwork computes from z; `ReducedDeformation` is the field of control nodes
(NeurIPS 2022 supplement, section 5), with auxiliary nodes on the cube.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from torch import nn

from meshmatch.arrays import Float
from meshmatch.fields.field import value_and_jacobian
from meshmatch.geometry.kernels import Kernel
from meshmatch.implicit.space import SpaceField

Deformation = Literal["mls", "pointwise"]
# Factor on decoded vectors. Without it the correction, which learns faster, takes over the role of the deformation.
_GAIN = 5.0


@dataclass(frozen=True)
class ImplicitConfig:
    """Architecture of an implicit network; stored on the model card.

    Attributes
    ----------
    field
        Deformation: "mls" (control nodes) or "pointwise" (DIF-Net).
    code
        Length D of a code.
    width, depth
        Width and depth of the template's network.
    inner, layers
        Width and depth of the networks whose weights are computed from a code.
    nodes
        Number of control nodes near surfaces.
    reach
        Radius of these nodes, in mean distances to the nearest other node.
    frequency
        Frequency of the sine activations.
    kernel
        Kernel of moving least squares.
    maker
        Width of the hypernetworks, which compute weights from codes.
    length
        Root mean square norm of initial codes.
    """

    field: Deformation = "mls"
    code: int = 64
    width: int = 128
    depth: int = 3
    inner: int = 48
    nodes: int = 240
    reach: float = 1.7
    frequency: float = 15.0
    kernel: Kernel = "smooth"
    layers: int = 2
    maker: int = 128
    length: float = 1.0


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Outputs of a network at P points for each of B shapes; gradients are with respect to the points."""

    distance: Float[torch.Tensor, "B P"]
    gradient: Float[torch.Tensor, "B P 3"]
    F: Float[torch.Tensor, "B P 3 3"]  # deformation gradient
    correction: Float[torch.Tensor, "B P"]
    template_gradient: Float[torch.Tensor, "B P 3"]


class SineNetwork(nn.Module):
    """A scalar function of points with sine activations (Sitzmann et al., *Implicit Neural Representations with Periodic
    Activation Functions*, NeurIPS 2020), initialised as in that paper.
    """

    def __init__(self, width: int, depth: int, frequency: float) -> None:
        super().__init__()
        self.frequency = frequency
        sizes = [3, *[width] * depth, 1]
        layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        for layer, bound in zip(layers, _sine_bounds(sizes, frequency), strict=True):
            layer.weight.data.uniform_(-bound, bound)
        self.layers = nn.ModuleList(layers)

    def forward(self, points: Float[torch.Tensor, "B P 3"], _: object = None) -> Float[torch.Tensor, "B P 1"]:
        for layer in self.layers[:-1]:
            points = torch.sin(self.frequency * layer(points))
        result: torch.Tensor = self.layers[-1](points)
        return result


class HyperNetwork(nn.Module):
    """A sine network on points whose weights another network computes from a code."""

    def __init__(self, config: ImplicitConfig, outputs: int) -> None:
        super().__init__()
        self.frequency, self.sizes = config.frequency, [3, *[config.inner] * config.layers, outputs]
        self.counts = [count for a, b in pairwise(self.sizes) for count in (a * b, b)]
        last = nn.Linear(config.maker, sum(self.counts))
        self.maker = nn.Sequential(nn.Linear(config.code, config.maker), nn.ReLU(), last)
        bounds = np.repeat(_sine_bounds(self.sizes, self.frequency), 2)
        bounds[-2:] *= 0.1  # a small initial deformation
        start = [float(bound) * (2 * torch.rand(n) - 1) for n, bound in zip(self.counts, bounds, strict=True)]
        last.weight.data.mul_(0.05)
        last.bias.data.copy_(torch.cat(start))

    def forward(
        self, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]
    ) -> Float[torch.Tensor, "B P O"]:
        made = self.maker(code).split(self.counts, 1)
        for k, sizes in enumerate(pairwise(self.sizes)):
            points = torch.sin(self.frequency * points) if k else points
            points = torch.baddbmm(made[2 * k + 1][:, None], points, made[2 * k].unflatten(1, sizes))
        return points


def _sine_bounds(sizes: list[int], frequency: float) -> list[float]:
    """Bounds of the uniform distribution of initial weights, for each layer."""
    return [1 / sizes[0], *(math.sqrt(6 / size) / frequency for size in sizes[1:-1])]


class PointwiseDeformation(nn.Module):
    """DIF-Net's deformation: a network of displacement and correction. F takes one backward pass for each output."""

    def __init__(self, config: ImplicitConfig, nodes: torch.Tensor, _: object) -> None:
        super().__init__()
        self.nodes = nn.Buffer(nodes)  # unused, but stored to identify the training shapes of a checkpoint
        self.network = HyperNetwork(config, 4)

    def forward(self, points: torch.Tensor, code: torch.Tensor, derivatives: bool = True) -> tuple[torch.Tensor, ...]:
        """u and c at points (B, P, 3); with ``derivatives`` also their derivatives."""
        if not derivatives:
            output = self.network(points, code)
            return output[..., :3], output[..., 3]
        output, J = value_and_jacobian(self.network, points, code)
        return output[..., :3], output[..., 3], J[..., :3, :], J[..., 3, :]


class ReducedDeformation(nn.Module):
    """Deformation by control nodes: displacements decoded from the code, interpolated by moving least squares.

    F has a closed form. The correction is a network whose weights are computed from the code, as in `PointwiseDeformation`.
    """

    def __init__(self, config: ImplicitConfig, nodes: torch.Tensor, radii: torch.Tensor) -> None:
        super().__init__()
        self.kernel = config.kernel
        self.nodes, self.radii = nn.Buffer(nodes), nn.Buffer(radii)
        last = nn.Linear(128, 3 * len(nodes))
        last.weight.data.mul_(0.01)  # a small initial deformation
        last.bias.data.zero_()
        self.decoder = nn.Sequential(nn.Linear(config.code, 128), nn.ReLU(), last)
        self.network = HyperNetwork(config, 1)

    def at(self, points: Float[torch.Tensor, "B P 3"], gradient: bool = True) -> SpaceField:
        """Shape functions at points of all shapes; ``gradient``: with derivatives."""
        return SpaceField.at(points, self.nodes, self.radii, self.kernel, gradient)

    def vectors(self, code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B K 3"]:
        """Decode displacements of the nodes."""
        result: torch.Tensor = _GAIN * self.decoder(code).unflatten(1, (-1, 3))
        return result

    def forward(self, points: torch.Tensor, code: torch.Tensor, derivatives: bool = True) -> tuple[torch.Tensor, ...]:
        """u and c at points (B, P, 3); with ``derivatives`` also their derivatives."""
        field, vectors = self.at(points, derivatives), self.vectors(code)
        u = field.displacement(vectors)
        if not derivatives:
            return u, self.network(points, code)[..., 0]
        output, slope = value_and_jacobian(self.network, points, code)
        return u, output[..., 0], field.jacobian(vectors), slope[..., 0, :]


class ImplicitNetwork(nn.Module):
    """Template, deformation, and a code for each of S shapes."""

    def __init__(self, config: ImplicitConfig, S: int, nodes: torch.Tensor, radii: torch.Tensor) -> None:
        super().__init__()
        self.config = config
        self.codes = nn.Parameter(torch.randn(S, config.code) * config.length / math.sqrt(config.code))
        self.template = SineNetwork(config.width, config.depth, config.frequency)
        kind = ReducedDeformation if config.field == "mls" else PointwiseDeformation
        self.deformation = kind(config, nodes, radii)

    def forward(self, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]) -> Evaluated:
        """Evaluate distances and gradients at points of the cube, for shapes with these codes."""
        u, correction, J, slope = self.deformation(points, code)
        F = J + torch.eye(3).to(J)
        value, template_slope = value_and_jacobian(self.template, points + u, code)
        gradient = (F.transpose(-1, -2) @ template_slope[..., 0, :, None])[..., 0] + slope
        return Evaluated(value[..., 0] + correction, gradient, F, correction, template_slope[..., 0, :])

    def distance(
        self, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]
    ) -> tuple[Float[torch.Tensor, "B P"], Float[torch.Tensor, "B P 3"]]:
        """Evaluate distances only, and the corresponding points on the template."""
        u, correction = self.deformation(points, code, False)
        return self.template(points + u)[..., 0] + correction, points + u
