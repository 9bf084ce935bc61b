"""Training of implicit models: a folder of shapes that stand alike becomes one deformed template, with a code for each.

SHAPES holds watertight meshes, clouds, or .npz samples (docs/method.md). A run that was stopped goes on from its
checkpoint in OUT. `experiments.implicit_surfaces` makes surfaces and maps of the model.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from typer import Argument, Option

from meshmatch.arrays import Float, Int
from meshmatch.experiments import runner
from meshmatch.experiments.implicit_model import ImplicitModel, save_implicit
from meshmatch.experiments.implicit_network import Deformation, ImplicitConfig, ImplicitNetwork, ReducedDeformation
from meshmatch.experiments.implicit_nodes import CUBE_RADIUS, cube_nodes
from meshmatch.experiments.implicit_samples import ImplicitSamples, read_implicit_samples
from meshmatch.fields.field import arap_energy, volume_energy
from meshmatch.outputs import make_folder
from meshmatch.shapes.sampling import farthest_points
from meshmatch.training.datasets import OnDevice
from meshmatch.training.loop import StepReport, TrainConfig, Trainer
from meshmatch.training.losses import Objective, Terms
from meshmatch.training.train import CHECKPOINT

_POINTS, _BLENDED = 512, 4  # points of a shape in a step; every so many-th for the energies between codes
_FAR = 0.05  # from the surface: where a distance of zero is an error


@dataclass(frozen=True, eq=False)
class ImplicitBatch(OnDevice):
    """Which B of the shapes, and samples of each."""

    shape: Int[torch.Tensor, " B"]
    rows: Float[torch.Tensor, "B P 7"]


@dataclass(frozen=True)
class ImplicitLoss(Objective):
    """DIF-Net's terms (docs/method.md); volume, arap and blend (L_Z) are of the reduced field alone."""

    needs_correspondence: ClassVar[bool] = False
    volume: float = 1e-3
    arap: float = 2e-3
    blend: float = 1e-3
    correct: float = 0.1
    sdf: float = 3.0
    normal: float = 0.1
    eikonal: float = 0.05
    off: float = 0.1
    smooth: float = 5e-3
    prior: float = 1e-3

    def __call__(self, model: Any, batch: ImplicitBatch, points: None, generator: torch.Generator) -> Terms:
        code, eye = model.codes[batch.shape], torch.eye(3).to(batch.rows)
        at, sdf, normals = batch.rows.split((3, 1, 3), -1)
        found = model(at, code)
        known = normals.square().sum(-1) > 0
        angles = (
            2 - sum(torch.cosine_similarity(g, normals, -1) for g in (found.gradient, found.template_gradient))
        ) * known
        far = (sdf[..., 0].abs() > _FAR) * torch.exp(-100 * found.distance.abs())
        terms = {
            "sdf": self.sdf * (found.distance - sdf[..., 0]).abs().mean(),
            "normal": self.normal * angles.sum() / known.sum().clamp_min(1),
            "eikonal": self.eikonal * ((found.gradient.square().sum(-1) + 1e-12).sqrt() - 1).abs().mean(),
            "off": self.off * far.mean(),
            "smooth": self.smooth * ((found.F - eye).square().sum((-1, -2)) + 1e-12).sqrt().mean(),
            "correct": self.correct * found.correction.abs().mean(),
            "prior": self.prior * code.square().sum(-1).mean(),
        }
        if isinstance(model.deformation, ReducedDeformation):
            share = torch.rand(len(code), 1, generator=generator).to(code)
            field = model.deformation.field(at[:, ::_BLENDED])
            F = eye + model.deformation.jacobian(field, share * code + (1 - share) * code.roll(1, 0))
            terms |= self.rigidity(found.F)
            terms["blend"] = self.blend * (volume_energy(F).mean() + arap_energy(F).mean())
        return {"total": torch.stack(list(terms.values())).sum(), **terms}


TRAINING = TrainConfig(
    steps=1500, shapes=6, warm_up=50, decay=0.7, weight_decay=0.0, average=0.99, workers=0, loss=ImplicitLoss()
)
"""How an implicit model is trained unless said otherwise."""
SIZES = ImplicitConfig()


@dataclass(frozen=True, eq=False)
class ImplicitDataset(torch.utils.data.Dataset):
    """Batch s of the samples depends on the seed and s alone."""

    samples: ImplicitSamples
    config: TrainConfig

    def __getitem__(self, step: int) -> ImplicitBatch:
        rng = np.random.default_rng([self.config.seed, step])
        S, N, _ = self.samples.rows.shape
        shape = rng.permutation(S)[: self.config.shapes]
        half = rng.integers(N // 2, size=(2, len(shape), _POINTS // 2))
        rows = self.samples.rows[shape[:, None], np.concatenate([half[0], half[1] + N // 2], 1)]
        return ImplicitBatch(torch.from_numpy(shape), torch.from_numpy(rows))


def build_implicit(samples: ImplicitSamples, config: ImplicitConfig, seed: int) -> ImplicitNetwork:
    """An untrained network: nodes spread over the surfaces of all shapes, and on the cube with a larger radius."""
    rng = np.random.default_rng(seed)
    surface = samples.rows[:, : samples.rows.shape[1] // 2, :3].reshape(-1, 3).astype(np.float64)
    some = surface[rng.choice(len(surface), min(20_000, len(surface)), replace=False)]
    near, far = some[farthest_points(some, min(config.nodes, len(some)))], cube_nodes()
    radii = torch.tensor([config.radius] * len(near) + [CUBE_RADIUS] * len(far))
    torch.manual_seed(seed)
    return ImplicitNetwork(config, len(samples.names), torch.from_numpy(np.concatenate([near, far])).float(), radii)


def train_implicit(
    output: str | Path,
    shapes: str | Path | ImplicitSamples,
    *,
    config: ImplicitConfig = SIZES,
    training: TrainConfig = TRAINING,
    resume: bool = True,
    report: Callable[[StepReport], None] | None = None,
) -> Path:
    """Learn a folder of shapes as one deformed template (`ImplicitModel`), or go on from the checkpoint, exactly.

    ``shapes`` is a folder of watertight meshes, clouds or .npz samples that stand alike; they are centred and scaled, not
    turned. Returns the folder ``output``, with ``weights.safetensors`` and last ``implicit.json``.

    `InputError` for shapes that cannot be learned from; `ModelError` for a checkpoint of another training; `OutputError`
    if the folder cannot be written.
    """
    output, checkpoint = Path(output), Path(output) / CHECKPOINT
    make_folder(checkpoint.parent)
    samples = shapes if isinstance(shapes, ImplicitSamples) else read_implicit_samples(shapes, training.seed)
    network = build_implicit(samples, config, training.seed)
    trainer = Trainer(network, None, replace(training, shapes=min(training.shapes, len(samples.names))))
    if resume and checkpoint.is_file():
        trainer.load(checkpoint)
    trainer.run(ImplicitDataset(samples, trainer.config), checkpoint, report)
    trainer.close()
    if trainer.rank == 0:
        network.load_state_dict(trainer.averaged_state())
        facts = {"train": asdict(training), "steps": trainer.step, "minutes": round(trainer.seconds / 60, 1)}
        save_implicit(output, ImplicitModel(network.cpu().eval(), samples.names, samples.frames), facts)
    return output


@runner.command
def main(
    shapes: Annotated[Path, Argument(help="folder of the shapes")],
    output: Annotated[Path, Option("-o", "--output", help="folder of the model")],
    deformation: Annotated[Deformation, Option(help="reduced moves nodes, pointwise is DIF-Net's")] = "reduced",
    steps: Annotated[int, Option(min=1, help="of the whole training")] = TRAINING.steps,
    minutes: Annotated[float | None, Option(help="of this run at most")] = None,
    fresh: Annotated[bool, Option("--fresh", help="do not go on from a checkpoint")] = False,
    seed: runner.Seed = 0,
    threads: runner.Threads = 1,
) -> runner.Report:
    training = replace(TRAINING, steps=steps, minutes=minutes, seed=seed, threads=threads)
    reports: list[StepReport] = []

    def report(now: StepReport) -> None:
        reports.append(now)
        runner.tell(now.words)

    config = ImplicitConfig(deformation)
    train_implicit(output, shapes, config=config, training=training, resume=not fresh, report=report)
    return runner.Report({"output": output, "steps": reports[-1].step if reports else None})


if __name__ == "__main__":
    sys.exit(main())
