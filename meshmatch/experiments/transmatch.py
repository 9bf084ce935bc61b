"""TransMatch, a rival: a transformer from points of a shape and points of the template to the template's displacement.

After *Shape registration in the time of transformers* (NeurIPS 2021), built here from its idea: a few latent vectors
read the shape's points by attention, talk among themselves, and every template point asks them where it goes. Trained
on the same generated bodies as our models, upright and turned about the vertical, for a stated time:

    python -m meshmatch.experiments.transmatch --minutes 60 -o transmatch

The folder then holds ``template.safetensors``, ``weights.safetensors`` and ``transmatch.json``; the benchmark of rivals
takes it with ``--transmatch``. An interrupted training goes on from ``checkpoint.safetensors``.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import nn

from meshmatch.errors import MeshmatchError, OptionError
from meshmatch.experiments.report import circumstances, explain
from meshmatch.experiments.transformer import TEMPLATE, WEIGHTS, WORDS, TransConfig, TransMatch
from meshmatch.models.checkpoint import load_weights, save_weights
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import Template, load_template, save_template
from meshmatch.threads import set_threads
from meshmatch.training.bodies import human_source
from meshmatch.training.datasets import Source
from meshmatch.training.scans import ScanConfig, bump, normalise, sample_scan, yaw_rotations

CHECKPOINT = "checkpoint.safetensors"


@dataclass(frozen=True)
class Schedule:
    """How long and on how much: ``steps`` or ``minutes`` end the training, whichever comes first, and fade its rate."""

    steps: int = 200_000
    minutes: float = 60.0
    shapes: int = 16
    points: int = 1024
    targets: int = 256
    rate: float = 1e-3
    warm_up: int = 200
    decay: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        if (
            min(self.steps, self.shapes, self.points, self.targets) < 1
            or not self.minutes > 0
            or self.seed < 0
        ):
            raise OptionError("a training needs counts of 1 or more, minutes above 0 and a seed of 0 or more")

    def rate_at(self, step: int, seconds: float) -> float:
        """Linear warm-up, constant, and a cosine to zero over the last ``decay`` share of steps or time."""
        share = min(1.0, max(step / self.steps, seconds / (60 * self.minutes)))
        fade = max(0.0, share - (1 - self.decay)) / max(self.decay, 1e-9)
        return self.rate * min(1.0, (step + 1) / self.warm_up) * 0.5 * (1 + math.cos(math.pi * fade))


@torch.no_grad()
def draw_batch(
    template: Template,
    source: Source,
    scan: ScanConfig,
    shapes: int,
    targets: int,
    generator: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Scans (B, P, 3), chosen template vertices (N,), and where these belong (B, N, 3); upright, turned about y."""
    verts = source(shapes, generator)
    faces = torch.from_numpy(template.shape.faces.copy())
    size = verts.flatten(1).std(1)[:, None, None]
    verts, areas = normalise(bump(verts / size * 0.3, scan.bumps, generator), faces)
    verts = verts * (1 + scan.scale * torch.randn(shapes, 1, 1, generator=generator).clamp(-2, 2))
    points = sample_scan(verts, areas, faces, scan, generator)
    center, turn = points.mean(1, keepdim=True), yaw_rotations(shapes, generator).transpose(1, 2)
    chosen = torch.randperm(verts.shape[1], generator=generator)[:targets]
    return (points - center) @ turn, chosen, (verts[:, chosen] - center) @ turn


def train(
    template: Template,
    source: Source,
    output: Path,
    config: TransConfig,
    schedule: Schedule,
    tell: Callable[[int, float, float], None] = lambda step, seconds, loss: None,
) -> Path:
    """Train, or go on from the folder's checkpoint, and write the folder; ``tell`` hears step, seconds and loss.

    Raises
    ------
    OutputError
        The folder cannot be made.
    ModelError
        The checkpoint is of another network or template.
    """
    make_folder(output)
    torch.manual_seed(schedule.seed)
    network = TransMatch(config)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.to(device)
    optimiser = torch.optim.AdamW(network.parameters(), lr=schedule.rate, weight_decay=0.01)
    rest = torch.from_numpy(template.shape.verts.copy()).float()
    checkpoint = output / CHECKPOINT
    step, before = _resume(network, optimiser, checkpoint) if checkpoint.is_file() else (0, 0.0)
    scan = ScanConfig(points=schedule.points, partial=0.0, upright=True)
    began, saved, seconds, mean = time.monotonic(), time.monotonic(), before, math.nan
    while step < schedule.steps and seconds < 60 * schedule.minutes:
        generator = torch.Generator().manual_seed(schedule.seed * 2_654_435_761 + step)
        points, chosen, goal = draw_batch(
            template, source, scan, schedule.shapes, schedule.targets, generator
        )
        start = rest[chosen].to(device)
        loss = (start + network(points.to(device), start) - goal.to(device)).norm(dim=-1).mean()
        for group in optimiser.param_groups:
            group["lr"] = schedule.rate_at(step, seconds)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        step += 1
        seconds = before + time.monotonic() - began
        mean = float(loss.detach()) if math.isnan(mean) else 0.98 * mean + 0.02 * float(loss.detach())
        tell(step, seconds, mean)
        if time.monotonic() - saved > 180:
            save_weights(_state(network, optimiser, step, seconds), checkpoint, storage="float32")
            saved = time.monotonic()
    state = _state(network, optimiser, step, seconds)
    save_weights(state, checkpoint, storage="float32")
    save_template(template, output / TEMPLATE)
    save_weights(network.state_dict(), output / WEIGHTS, storage="float32")
    words = {
        "network": asdict(config),
        "schedule": asdict(schedule),
        "steps": step,
        "minutes": round(seconds / 60, 2),
        "distance": None if math.isnan(mean) else round(mean, 5),
        **circumstances(torch.get_num_threads(), 1),
    }
    with replace_on_success(output / WORDS) as temporary:
        temporary.write_text(json.dumps(words, indent=1) + "\n", encoding="utf-8")
    return output


def _state(network: TransMatch, optimiser: Any, step: int, seconds: float) -> dict[str, torch.Tensor]:
    state = {f"model/{name}": tensor for name, tensor in network.state_dict().items()}
    for number, kept in optimiser.state_dict()["state"].items():
        state |= {f"optimiser/{number}/{name}": torch.as_tensor(value) for name, value in kept.items()}
    return state | {"step": torch.tensor(step), "seconds": torch.tensor(seconds, dtype=torch.float64)}


def _resume(network: TransMatch, optimiser: Any, path: Path) -> tuple[int, float]:
    expected = {f"model/{name}": tuple(value.shape) for name, value in network.state_dict().items()}
    for number, parameter in enumerate(network.parameters()):
        shape = tuple(parameter.shape)
        expected |= {f"optimiser/{number}/{name}": shape for name in ("exp_avg", "exp_avg_sq")}
        expected[f"optimiser/{number}/step"] = ()
    found = load_weights(path, expected | {"step": (), "seconds": ()})
    network.load_state_dict({name: found[f"model/{name}"] for name in network.state_dict()})
    groups, state = optimiser.state_dict()["param_groups"], {}
    for number, _ in enumerate(network.parameters()):
        names = ("step", "exp_avg", "exp_avg_sq")
        state[number] = {name: found[f"optimiser/{number}/{name}"] for name in names}
    optimiser.load_state_dict({"state": state, "param_groups": groups})
    return int(found["step"]), float(found["seconds"])


def main(words: Sequence[str] | None = None) -> int:
    """Train on generated bodies; 0 when it ran, 1 when a choice or the disk stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.transmatch", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("transmatch"), help="the model's folder")
    parser.add_argument(
        "--minutes", type=float, default=60.0, help="of training at most, resumed runs together"
    )
    parser.add_argument("--steps", type=int, default=Schedule.steps, help="of training at most")
    parser.add_argument("--identities", type=int, default=1024, help="people that bodies are blended from")
    parser.add_argument("--shapes", type=int, default=Schedule.shapes, help="in a batch: %(default)s")
    parser.add_argument("--points", type=int, default=Schedule.points, help="of a scan: %(default)s")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    console = Console(stderr=True)
    try:
        schedule = Schedule(
            steps=options.steps,
            minutes=options.minutes,
            shapes=options.shapes,
            points=options.points,
            seed=options.seed,
        )
        set_threads(max(1, options.threads))
        template = load_template(bundled_folder() / "human" / "human-T.safetensors")
        source = human_source(template, options.identities, options.seed)
        with console.status("training") as status:

            def tell(step: int, seconds: float, loss: float) -> None:
                status.update(
                    f"step {step}, {seconds / 60:.1f} of {options.minutes:g} min, distance {loss:.4f}"
                )

            folder = train(template, source, options.output, TransConfig(), schedule, tell)
    except MeshmatchError as error:
        explain(error)
        return 1
    print((folder / WORDS).read_text(encoding="utf-8").replace("\n", ""), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
