"""Train implicit models: learn one template and a code for each shape from a folder of shapes with a common orientation."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from meshmatch.errors import OptionError
from meshmatch.geometry.trees import cKDTree
from meshmatch.implicit.network import ImplicitConfig, ImplicitNetwork
from meshmatch.implicit.objective import PUBLISHED, ImplicitBatch, ImplicitLoss
from meshmatch.implicit.samples import ImplicitSamples, read_implicit_samples
from meshmatch.implicit.space import CUBE_RADIUS, cube_nodes
from meshmatch.models.card import IMPLICIT, ImplicitCard, check_name, write_card
from meshmatch.models.checkpoint import save_weights
from meshmatch.models.registry import WEIGHTS
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.sampling import farthest_points
from meshmatch.training.folder_lock import CHECKPOINT, exclusive_folder
from meshmatch.training.loop import StepReport, TrainConfig, Trainer
from meshmatch.training.train import CardFacts

_POINTS = 512  # per shape and step
TRAINING = TrainConfig(
    steps=1500, shapes=6, warm_up=50, decay=0.7, weight_decay=0.0, average=0.99, workers=0, loss=ImplicitLoss()
)
"""Default training of implicit models."""
DIF_NET = ImplicitConfig("pointwise", 128, 128, 4, 128, frequency=30.0, layers=4, maker=256, length=0.01 * 128**0.5)
"""DIF-Net's published sizes, for either field."""
AS_PUBLISHED = replace(
    TRAINING, rate=1e-4, warm_up=0, decay=0.0, average=0.0, momentum=0.999, clip=None, loss=PUBLISHED
)  # fmt: skip
"""DIF-Net's published loss, weights and learning rate."""


@dataclass(frozen=True, eq=False)
class ImplicitDataset(torch.utils.data.Dataset[ImplicitBatch]):
    """Batches of samples; batch s depends on the seed and s only."""

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
    """Build an untrained network, with nodes on the surfaces of all shapes, and on the cube with a larger radius."""
    rng = np.random.default_rng(seed)
    surface = samples.rows[:, : samples.rows.shape[1] // 2, :3].reshape(-1, 3).astype(np.float64)
    chosen = surface[rng.choice(len(surface), min(20_000, len(surface)), replace=False)]
    inner, outer = chosen[farthest_points(chosen, min(config.nodes, len(chosen)))], cube_nodes()
    spacing = float(cKDTree(inner).query(inner, 2)[0][:, 1].mean()) if len(inner) > 1 else 0.0
    radii = torch.tensor([min(config.reach * spacing, CUBE_RADIUS)] * len(inner) + [CUBE_RADIUS] * len(outer))
    torch.manual_seed(seed)
    return ImplicitNetwork(config, len(samples.names), torch.from_numpy(np.concatenate([inner, outer])).float(), radii)


@exclusive_folder
def train_implicit(
    output: str | Path,
    shapes: str | Path | ImplicitSamples,
    *,
    config: ImplicitConfig | None = None,
    training: TrainConfig = TRAINING,
    facts: CardFacts | None = None,
    resume: bool = True,
    report: Callable[[StepReport], None] | None = None,
    progress: ProgressCallback | None = None,
) -> Path:
    """Train an `ImplicitModel` on a folder of shapes, or resume from a checkpoint, exactly.

    Parameters
    ----------
    output
        The model's folder.
    shapes
        A folder of watertight meshes, clouds or .npz samples (the page on formats) that share an orientation; they are
        centred and scaled, not rotated.
    config
        The network; ``ImplicitConfig(field="pointwise")`` is DIF-Net's deformation, "mls" (the default) that of control
        nodes.
    training
        Steps, batches, learning rate and device.
    facts
        Entries of the model's card.
    resume
        Resume from a checkpoint if there is one.
    report
        Called with losses and validation.
    progress
        As in `match`.

    Returns
    -------
    Path
        The folder, with ``weights.safetensors`` and ``implicit.json``, which is written last.

    Raises
    ------
    InputError
        The shapes cannot be used for training.
    OptionError
        Training in bfloat16 was requested.
    ModelError
        The checkpoint is from another training.
    OutputError
        The folder cannot be written, or another training writes to it.

    Examples
    --------
    >>> meshmatch.train_implicit("chair-model", "chairs")
    >>> model = meshmatch.load_implicit("chair-model")
    >>> meshmatch.save_shape("template.ply", model.template())
    """
    output, checkpoint = Path(output), Path(output) / CHECKPOINT
    facts, config = facts or CardFacts(), config or ImplicitConfig()
    name = check_name(facts.name or output.resolve().name)
    if training.bf16:
        raise OptionError("implicit models are not trained in bfloat16", "leave out --bf16")
    data, folder = "samples", "shapes"
    if not isinstance(shapes, ImplicitSamples):
        folder = Path(shapes).resolve().name
        shapes = read_implicit_samples(shapes, training.seed)
        data = f"{len(shapes.names)} shapes of {folder}"
    network = build_implicit(shapes, config, training.seed)
    trainer = Trainer(network, None, replace(training, shapes=min(training.shapes, len(shapes.names))))
    if resume and checkpoint.is_file():
        trainer.load(checkpoint)
    reporter = Progress(progress, "training")
    trainer.run(ImplicitDataset(shapes, trainer.config), checkpoint, report, progress=reporter)
    trainer.close()
    if trainer.rank == 0:
        (output / IMPLICIT).unlink(missing_ok=True)
        digest = save_weights(trainer.averaged_state(), output / WEIGHTS, storage="float32")
        card = ImplicitCard(
            name=name, category=facts.category or folder, network=asdict(config), shapes=list(shapes.names),
            frames=[[frame.scale, *frame.center.tolist()] for frame in shapes.frames], data=facts.data or data,
            licence=facts.licence, recipe=asdict(training), seed=training.seed, steps=trainer.step,
            training_minutes=round(trainer.seconds / 60, 1), weights_sha256=digest,
            created=datetime.date.today().isoformat(),
        )  # fmt: skip
        write_card(card, output / IMPLICIT)
    return output
