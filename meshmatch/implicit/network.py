"""Signed distances of a whole category: one template, and for every shape a code that deforms and corrects it.

After *Deformed Implicit Field* (Deng, Yang and Tong, CVPR 2021), in the cube from -1 to 1:

    f(x) = T(x + u(x)) + c(x)

T is the template's signed distance, u the deformation and c the correction of the shape with code z. Codes are learned
with the weights, one for each shape. There are two deformations, which answer the same questions: `PointwiseDeformation`
is that paper's, a network whose weights a second one makes of z; `ReducedDeformation` is the field of control nodes
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
# Of decoded vectors: without it the correction, which learns faster, explains what the deformation should.
_GAIN = 5.0


@dataclass(frozen=True)
class ImplicitConfig:
    """Sizes: of codes, of the template's network, of the networks that a code makes (``inner`` wide, ``layers`` deep) and of
    what makes them (``maker``); nodes near surfaces, their radius in mean distances to the next node, the frequency that
    sines begin with, and how long a code is at first.
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
    """What a network says of P points of each of B shapes; gradients are with respect to the points."""

    distance: Float[torch.Tensor, "B P"]
    gradient: Float[torch.Tensor, "B P 3"]
    F: Float[torch.Tensor, "B P 3 3"]  # of the deformation
    correction: Float[torch.Tensor, "B P"]
    template_gradient: Float[torch.Tensor, "B P 3"]


class SineNetwork(nn.Module):
    """Points to a number: layers of sines (Sitzmann et al., *Implicit Neural Representations with Periodic Activation
    Functions*, NeurIPS 2020), first weights as that paper draws them.
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
    """A network of sines on points whose weights are made of a code by another network."""

    def __init__(self, config: ImplicitConfig, outputs: int) -> None:
        super().__init__()
        self.frequency, self.sizes = config.frequency, [3, *[config.inner] * config.layers, outputs]
        self.counts = [count for a, b in pairwise(self.sizes) for count in (a * b, b)]
        last = nn.Linear(config.maker, sum(self.counts))
        self.maker = nn.Sequential(nn.Linear(config.code, config.maker), nn.ReLU(), last)
        bounds = np.repeat(_sine_bounds(self.sizes, self.frequency), 2)
        bounds[-2:] *= 0.1  # hardly a deformation at first
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
    """Of uniform first weights, for each layer."""
    return [1 / sizes[0], *(math.sqrt(6 / size) / frequency for size in sizes[1:-1])]


class PointwiseDeformation(nn.Module):
    """DIF-Net's: a network at every point says displacement and correction. F takes a backward pass for each of them."""

    def __init__(self, config: ImplicitConfig, nodes: torch.Tensor, _: object) -> None:
        super().__init__()
        self.nodes = nn.Buffer(nodes)  # not used, but known: a checkpoint of other shapes has others
        self.network = HyperNetwork(config, 4)

    def forward(self, points: torch.Tensor, code: torch.Tensor, slopes: bool = True) -> tuple[torch.Tensor, ...]:
        """u and c at points (B, P, 3); with ``slopes`` also their gradients."""
        if not slopes:
            answer = self.network(points, code)
            return answer[..., :3], answer[..., 3]
        answer, J = value_and_jacobian(self.network, points, code)
        return answer[..., :3], answer[..., 3], J[..., :3, :], J[..., 3, :]


class ReducedDeformation(nn.Module):
    """Displacements of nodes are decoded from the code, and moving least squares carry them everywhere; F is a formula.

    The correction is a network whose weights are made of the code, as in the other.
    """

    def __init__(self, config: ImplicitConfig, nodes: torch.Tensor, radii: torch.Tensor) -> None:
        super().__init__()
        self.kernel = config.kernel
        self.nodes, self.radii = nn.Buffer(nodes), nn.Buffer(radii)
        last = nn.Linear(128, 3 * len(nodes))
        last.weight.data.mul_(0.01)  # as above
        last.bias.data.zero_()
        self.decoder = nn.Sequential(nn.Linear(config.code, 128), nn.ReLU(), last)
        self.network = HyperNetwork(config, 1)

    def at(self, points: Float[torch.Tensor, "B P 3"], gradient: bool = True) -> SpaceField:
        """Shape functions at the points of all shapes."""
        return SpaceField.at(points, self.nodes, self.radii, self.kernel, gradient)

    def vectors(self, code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B K 3"]:
        """Where the nodes go, relative to where they are."""
        result: torch.Tensor = _GAIN * self.decoder(code).unflatten(1, (-1, 3))
        return result

    def forward(self, points: torch.Tensor, code: torch.Tensor, slopes: bool = True) -> tuple[torch.Tensor, ...]:
        """u and c at points (B, P, 3); with ``slopes`` also their gradients."""
        field, vectors = self.at(points, slopes), self.vectors(code)
        u = field.displacement(vectors)
        if not slopes:
            return u, self.network(points, code)[..., 0]
        answer, slope = value_and_jacobian(self.network, points, code)
        return u, answer[..., 0], field.jacobian(vectors), slope[..., 0, :]


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
        """Distances and gradients at points of the cube, for shapes with these codes."""
        u, correction, J, slope = self.deformation(points, code)
        F = J + torch.eye(3).to(J)
        value, steep = value_and_jacobian(self.template, points + u, code)
        gradient = (F.transpose(-1, -2) @ steep[..., 0, :, None])[..., 0] + slope
        return Evaluated(value[..., 0] + correction, gradient, F, correction, steep[..., 0, :])

    def distance(
        self, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]
    ) -> tuple[Float[torch.Tensor, "B P"], Float[torch.Tensor, "B P 3"]]:
        """Distances alone, and where the points lie on the template."""
        u, correction = self.deformation(points, code, False)
        return self.template(points + u)[..., 0] + correction, points + u
