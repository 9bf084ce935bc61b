"""The transformer that `experiments.transmatch` trains, its files, and its way to a map."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import nn

from meshmatch.errors import ModelError
from meshmatch.fitting.orientation import standing_grid
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.surface import Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.checkpoint import load_weights
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, load_template

TEMPLATE, WEIGHTS, WORDS = "template.safetensors", "weights.safetensors", "transmatch.json"
_LARGEST = {"width": 2048, "heads": 64, "latents": 4096, "depth": 64, "frequencies": 32}
_MOST_WORDS = 100_000


@dataclass(frozen=True)
class TransConfig:
    """Sizes of the network.

    Raises
    ------
    ModelError
        A size that cannot be, or is too large.
    """

    width: int = 192
    heads: int = 6
    latents: int = 96
    depth: int = 4
    frequencies: int = 6

    def __post_init__(self) -> None:
        for name, most in _LARGEST.items():
            value = getattr(self, name)
            if type(value) is not int or not 1 <= value <= most:
                raise ModelError(f"{name} must be an integer from 1 to {most}, not {value!r}")
        if self.width % self.heads:
            raise ModelError(f"a width of {self.width} cannot be shared among {self.heads} heads")


class Block(nn.Module):
    """Attention of ``x`` (B, N, W) to a memory (B, M, W), then an MLP; pre-norm, residual."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.memory_norm, self.mlp_norm = (nn.LayerNorm(width) for _ in range(3))
        self.query, self.out = nn.Linear(width, width), nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, x: torch.Tensor, memory: torch.Tensor) -> torch.Tensor:
        query = self.query(self.norm(x)).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        pair = self.key_value(self.memory_norm(memory)).unflatten(-1, (2, self.heads, -1))
        key, value = pair.permute(2, 0, 3, 1, 4)
        seen = nn.functional.scaled_dot_product_attention(query, key, value)
        x = x + self.out(seen.transpose(1, 2).flatten(2))
        return x + self.mlp(self.mlp_norm(x))


class TransMatch(nn.Module):
    """Points of a shape (B, P, 3) and of the template (N, 3) -> displacements (B, N, 3); lengths in sqrt(area)."""

    def __init__(self, config: TransConfig) -> None:
        super().__init__()
        self.config = config
        width, heads = config.width, config.heads
        self.frequencies: torch.Tensor
        self.register_buffer("frequencies", 2.0 ** torch.arange(config.frequencies))
        inputs = 3 + 6 * config.frequencies
        self.embed_shape, self.embed_template = nn.Linear(inputs, width), nn.Linear(inputs, width)
        self.latents = nn.Parameter(0.5 * torch.randn(config.latents, width))
        self.read = Block(width, heads)
        self.think = nn.ModuleList(Block(width, heads) for _ in range(config.depth))
        self.ask = nn.ModuleList(Block(width, heads) for _ in range(2))
        self.last_norm, self.last = nn.LayerNorm(width), nn.Linear(width, 3)
        nn.init.normal_(self.last.weight, std=2e-3)  # the template begins at rest
        nn.init.zeros_(self.last.bias)

    def _waves(self, points: torch.Tensor) -> torch.Tensor:
        angle = (math.pi * points[..., None, :] * self.frequencies[:, None]).flatten(-2)
        return torch.cat([points, angle.sin(), angle.cos()], -1)

    def forward(self, points: torch.Tensor, template: torch.Tensor) -> torch.Tensor:
        seen = self.embed_shape(self._waves(points))
        latents = self.read(self.latents.expand(len(points), -1, -1), seen)
        for block in self.think:
            latents = block(latents, latents)
        asked = self.embed_template(self._waves(template)).expand(len(points), -1, -1)
        for block in self.ask:
            asked = block(asked, latents)
        return self.last(self.last_norm(asked))


@dataclass(frozen=True, eq=False)
class TransModel:
    """A trained network in evaluation mode, its template, and the words about its training."""

    network: TransMatch
    template: Template
    words: dict[str, Any]


def load_transmatch(folder: str | Path) -> TransModel:
    """Read a folder that `train` wrote.

    Raises
    ------
    ModelError, TemplateError
        A file is missing, damaged, or does not fit the others.
    """
    path = Path(folder) / WORDS
    hint = "train one: python -m meshmatch.experiments.transmatch"
    try:
        with path.open(encoding="utf-8") as file:
            words = json.loads(file.read(_MOST_WORDS))
        config = TransConfig(**words["network"])
    except OSError as error:
        raise ModelError(f"{folder} holds no TransMatch: cannot read {WORDS}", hint) from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ModelError(f"{path} is damaged", hint) from error
    network = TransMatch(config)
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    network.load_state_dict(load_weights(Path(folder) / WEIGHTS, expected))
    return TransModel(network.eval(), load_template(Path(folder) / TEMPLATE), words)


@dataclass(frozen=True, eq=False)
class Registered:
    """The template laid on one shape: vertices (V, 3) in the file's frame, and the Chamfer distance that chose it."""

    points: np.ndarray
    residual: float


@dataclass(frozen=True)
class TransMatcher:
    """TransMatch behind the benchmark's `Matcher`.

    The network knows upright bodies: 72 turns of the shape (six axes up, twelve turns about each) are tried on few
    points, the best ``keep`` on all, and the Chamfer distance chooses. Nothing is refined. Maps go through the template.
    """

    folder: str
    points: int = 2048
    few: int = 512
    keep: int = 6
    seed: int = 0

    def fit(self, shape: Shape) -> Registered:
        """Predict where the template goes, in every orientation, and keep the best."""
        model = _loaded(self.folder)
        frame = sqrt_area_frame(shape)
        drawn = sample_surface(shape, self.points, np.random.default_rng(self.seed))
        scan = frame.apply(drawn.points)
        turns = np.stack([guess.rotation for guess in standing_grid(scan.mean(0))])
        rest = model.template.shape.verts
        step = max(1, len(rest) // 1000)
        _, far = _lay(model.network, scan[: self.few], turns, rest[::step])
        turns = turns[np.argsort(far, kind="stable")[: self.keep]]
        laid, far = _lay(model.network, scan, turns, rest)
        best = int(np.argmin(far))
        return Registered(frame.undo(laid[best]), float(far[best]))

    def map(self, source: Shape, source_fit: Registered, target: Shape, target_fit: Registered) -> VertexMap:
        """Nearest point of the source's template, the same point of the target's, its nearest vertex."""
        faces = _loaded(self.folder).template.shape.faces
        still = np.zeros_like(source_fit.points)  # no normals: nearest in space alone
        foot = Surface(source_fit.points, faces, still).query(source.verts, np.zeros_like(source.verts))
        moved = interpolate(target_fit.points, faces[foot.face], foot.barycentric)
        return VertexMap.between(source, target, cKDTree(target.verts).query(moved)[1])


@lru_cache(maxsize=2)
def _loaded(folder: str) -> TransModel:
    return load_transmatch(folder)


@torch.inference_mode()
def _lay(
    network: TransMatch, scan: np.ndarray, turns: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Template points on a scan (P, 3), for every turn: (T, N, 3) in the scan's frame, and Chamfer distances (T,)."""
    center = scan.mean(0)
    start = torch.from_numpy(np.array(rest)).float()
    tree = cKDTree(scan)
    laid, far = [], []
    for turn in turns:
        seen = torch.from_numpy((scan - center) @ turn).float()[None]
        there = (start + network(seen, start))[0].double().numpy() @ turn.T + center
        forward, back = tree.query(there)[0], cKDTree(there).query(scan)[0]
        laid.append(there)
        far.append(float(forward.mean() + back.mean()))
    return np.stack(laid), np.array(far)
