"""The training loop: time budget, exact resuming, several GPUs, and averaged weights for inference."""

from __future__ import annotations

import ctypes
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args

import torch
import torch.distributed as dist
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from meshmatch.errors import ModelError, OptionError, warn
from meshmatch.models.deformer import Deformer
from meshmatch.models.inference import training_device
from meshmatch.outputs import replace_on_success
from meshmatch.progress import Progress
from meshmatch.scalars import check_seed, is_integer, is_number
from meshmatch.training.batches import Draw, batches
from meshmatch.training.limits import check_range
from meshmatch.training.losses import CorrespondenceLoss, Objective

OF_THE_MACHINE = ("minutes", "checkpoint_minutes", "threads", "device", "draw", "compile")
"""Settings that depend on the machine; they are not read from a recipe."""
# Buffers that must be equal in a checkpoint and the training that resumes from it.
_TEMPLATE_BUFFERS = ("nodes", "anchors")
_MOMENTS, _STEP_SHAPE = ("exp_avg", "exp_avg_sq"), {"step": torch.Size()}  # Adam's state of each parameter


@dataclass(frozen=True)
class TrainConfig:
    """Optimiser settings, schedule, batch sizes and hardware options of a training.

    ``steps`` determines the learning rate schedule: linear warm-up, constant rate, then cosine decay to zero over the last
    fraction ``decay`` of the steps. ``minutes`` only stops the run, with a checkpoint to resume from. ``align_steps`` is the
    number of steps in which the aligner is first trained on its own. ``device`` is "auto" (CUDA if available), "cpu",
    "cuda" or "mps". ``draw`` is where batches are drawn: "cpu", "device", or "auto" (on the device if that is CUDA).
    ``bf16`` runs the loss in mixed precision, ``tf32`` lets GPUs multiply in TF32, ``compile`` applies torch.compile to the
    loss. `OptionError` if a value is out of range.
    """

    steps: int = 20_000
    shapes: int = 32
    scans_per_shape: int = 2
    rate: float = 1e-3
    warm_up: int = 200
    decay: float = 0.4
    weight_decay: float = 0.01
    average: float = 0.999  # decay of the exponential moving average of the weights; 0 uses the last weights
    momentum: float = 0.99  # decay of the squared gradients, Adam's beta2
    clip: float | None = 1.0  # maximum norm of the gradient
    minutes: float | None = None
    checkpoint_minutes: float = 3.0
    workers: int = 1
    threads: int = 1
    bf16: bool = False
    tf32: bool = False
    compile: bool = False
    seed: int = 0
    align_steps: int = 0
    device: str = "auto"
    draw: Draw = "auto"
    loss: Objective = field(default_factory=CorrespondenceLoss)

    def __post_init__(self) -> None:
        for name in ("steps", "shapes", "scans_per_shape", "workers", "threads"):
            if not is_integer(value := getattr(self, name)):
                raise OptionError(f"{name} must be a whole number, not {value!r}")
            check_range(name, value)
        check_seed(self.seed)
        if self.draw not in get_args(Draw):
            raise OptionError(f"batches are drawn on {', '.join(get_args(Draw))}, not {self.draw!r}")
        if not (is_number(self.rate) and is_number(self.decay) and 0 < self.rate < math.inf and 0 <= self.decay <= 1):
            raise OptionError("a training needs a positive rate and a decay in 0..1")
        if self.minutes is not None and not (is_number(self.minutes) and self.minutes > 0):
            raise OptionError(f"minutes must be positive, not {self.minutes!r}")
        if not isinstance(self.loss, Objective):
            raise OptionError(f"a loss is an Objective, not {self.loss!r}", "see docs/training.md for custom losses")


@dataclass(frozen=True)
class StepReport:
    """Progress after a step: step counts, learning rate, seconds of this run, mean losses since the last report."""

    step: int
    steps: int
    rate: float
    seconds: float
    terms: dict[str, float]
    validation: float | None = None

    @property
    def words(self) -> str:
        """One-line summary."""
        return f"step {self.step:,} of {self.steps:,}{self.losses}"

    @property
    def losses(self) -> str:
        """The part of `words` with the losses and the validation error."""
        terms = ", ".join(f"{name} {value:.4g}" for name, value in self.terms.items())
        validation = "" if self.validation is None else f", validation {self.validation:.4f}"
        return f": {terms}{validation}"


def settings_of(record: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten a recipe's record to dotted names, without the settings that depend on the machine."""
    flat: dict[str, Any] = {}
    for name, value in record.items():
        if isinstance(value, Mapping):
            flat |= settings_of(value, f"{prefix}{name}.")
        elif name not in (*OF_THE_MACHINE, "workers"):
            flat[prefix + name] = value
    return flat


def learning_rate(step: int, config: TrainConfig) -> float:
    """Learning rate of a step: linear warm-up, constant, cosine decay to zero."""
    decay_start = (1 - config.decay) * config.steps
    decayed = min(1.0, max(0.0, step - decay_start) / max(config.steps - decay_start, 1))
    factor = 0.5 * (1 + math.cos(math.pi * decayed))
    return config.rate * min(1.0, (step + 1) / max(config.warm_up, 1)) * factor


def processes() -> int:
    """Number of processes that train together, each on its own batches; set by torchrun."""
    return int(os.environ.get("WORLD_SIZE", 1))


class Trainer:
    """State of a training: weights, their moving average, the optimiser and the next step; a checkpoint contains it all."""

    def __init__(
        self, model: Any, points: Any, config: TrainConfig, digest: str = "", recipe: Mapping[str, Any] | None = None
    ) -> None:
        self.config, self.digest = config, digest  # digest of the shapes, see `TrainingData`; empty if unknown
        self.settings: dict[str, Any] = settings_of(recipe or asdict(config)) | {"processes": processes()}
        # Earlier settings that differed, each with the step until which they applied.
        self.earlier: list[dict[str, Any]] = []
        self.rank = int(os.environ.get("RANK", 0))
        self.world = processes()
        self.device = training_device(int(os.environ.get("LOCAL_RANK", 0)), config.device)
        if self.world > 1 and not dist.is_initialized():
            dist.init_process_group("gloo" if self.device.type == "cpu" else "nccl")
        self.model = model.to(self.device)
        self.points: Any = None if points is None else points.to(self.device)
        self.average = {n: p.detach().clone() for n, p in model.named_parameters()}
        settings: dict[str, Any] = {"betas": (0.9, config.momentum), "weight_decay": config.weight_decay, "fused": True}
        self.optimiser = torch.optim.AdamW(model.parameters(), config.rate, **settings)
        self.loss: Any = torch.compile(config.loss) if config.compile else config.loss
        self.step, self.seconds = 0, 0.0
        # Loss terms and their step, not yet checked to be finite.
        self._unchecked: tuple[dict[str, Tensor], int] | None = None
        self._signals: list[int] = []  # termination signals that this one of several processes received
        self._stop_requested = False  # whether any process received one

    def save(self, path: Path) -> None:
        """Write a checkpoint with everything that the next step depends on (rank 0 only)."""
        self._check_last()
        if self.rank:
            return
        arrays = {f"model.{n}": t for n, t in self.model.state_dict().items()}
        arrays |= {f"average.{n}": t for n, t in self.average.items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            arrays |= {f"optimiser.{index}.{n}": torch.as_tensor(t) for n, t in state.items()}
        arrays = {n: t.detach().cpu().contiguous().clone() for n, t in arrays.items()}
        with replace_on_success(path) as temporary:
            metadata = {"step": str(self.step), "seconds": f"{self.seconds:.1f}", "seed": str(self.config.seed)}
            metadata |= {"settings": json.dumps(self.settings, default=str), "earlier": json.dumps(self.earlier)}
            save_file(arrays, temporary, metadata | {"digest": self.digest})

    def load(self, path: Path) -> None:
        """Restore the state that `save` wrote; warns of changed settings, which are recorded for the card.

        `ModelError` if the file is not a checkpoint, or has another seed, network, template or other shapes.
        """
        hint = "train into another folder, or start afresh"
        current = self.model.state_dict()
        parameter_shapes = {name: tensor.shape for name, tensor in self.average.items()}
        expected = {"model": {name: tensor.shape for name, tensor in current.items()}, "average": parameter_shapes}
        parts: dict[str, dict[str, Tensor]] = {"model": {}, "average": {}, "optimiser": {}}
        state: dict[int, dict[str, Tensor]] = {}
        try:
            with safe_open(str(path), framework="pt") as file:
                metadata = file.metadata() or {}
                step, seconds = int(metadata["step"]), float(metadata.get("seconds", 0.0))
                seed, digest = int(metadata.get("seed", self.config.seed)), metadata.get("digest", "")
                saved, earlier = json.loads(metadata.get("settings", "{}")), json.loads(metadata.get("earlier", "[]"))
                if not isinstance(saved, dict) or not isinstance(earlier, list):
                    raise ValueError("no such settings")
                for name in file.keys():  # noqa: SIM118 (it is no dictionary)
                    part, _, key = name.partition(".")
                    parts[part][key] = file.get_tensor(name)
            for name, tensor in parts["optimiser"].items():
                index, key = name.split(".")
                state.setdefault(int(index), {})[key] = tensor
            if not (0 <= step and 0 <= seconds < math.inf):
                raise ValueError("no such step")
        except (SafetensorError, OSError, LookupError, ValueError) as error:
            raise ModelError(f"{path} is not a checkpoint of a training", hint) from error
        if seed != self.config.seed:
            raise ModelError(f"{path} is a checkpoint of a training with seed {seed}", hint)
        if any({name: t.shape for name, t in parts[part].items()} != expected[part] for part in expected):
            raise ModelError(f"{path} is a checkpoint of another network", hint)
        moments = {n: dict.fromkeys(_MOMENTS, p.shape) | _STEP_SHAPE for n, p in enumerate(self.model.parameters())}
        if any({key: t.shape for key, t in state[n].items()} != moments.get(n) for n in state):
            raise ModelError(f"{path} is not a checkpoint of a training", hint)
        weights = parts["model"]
        if not all(torch.equal(weights[n], current[n].cpu()) for n in current if n.endswith(_TEMPLATE_BUFFERS)):
            raise ModelError(f"{path} is a checkpoint for another template", hint)
        if digest and self.digest and digest != self.digest:
            raise ModelError(
                f"{path} is a checkpoint of a training with other shapes",
                "train into another folder (--start, with this one, begins with its weights), or start afresh",
            )
        self.step, self.seconds = step, seconds
        self.model.load_state_dict(weights)
        for name, tensor in parts["average"].items():
            self.average[name].copy_(tensor)
        groups = self.optimiser.state_dict()["param_groups"]
        self.optimiser.load_state_dict({"state": state, "param_groups": groups})
        self.earlier = earlier
        self._note_changes(saved)

    def _note_changes(self, saved: dict[str, Any]) -> None:
        """Record settings that differ from those of the checkpoint, and warn of them."""
        current = json.loads(json.dumps(self.settings, default=str))
        changed = {name: value for name, value in saved.items() if name in current and current[name] != value}
        if changed and self.step:
            self.earlier = [*self.earlier, {"until_step": self.step} | changed]
            description = ", ".join(
                f"{name.rpartition('.')[2]} {value} is {current[name]} now" for name, value in changed.items()
            )
            warn(f"the {self.step:,} steps of the checkpoint had other settings: {description}")

    def run(
        self,
        data: torch.utils.data.Dataset[Any],
        checkpoint: Path | None = None,
        report: Callable[[StepReport], None] | None = None,
        validate: Callable[[Deformer], float] | None = None,
        every: int = 50,
        spent: float = 0.0,
        progress: Progress | None = None,
    ) -> None:
        """Train until ``steps`` are done or ``minutes`` have passed, counting ``spent`` seconds as used already.

        Writes ``checkpoint`` periodically, at the end, and on Ctrl-C. Several processes stop after the same step.
        ``report`` is called ``every`` so many steps, ``validate`` at every tenth report and at the last.
        """
        config = self.config
        torch.set_num_threads(config.threads)
        _keep_freed_memory()
        step_numbers = range(self.rank, config.steps * self.world, self.world)[self.step : config.steps]
        saved = time.monotonic()
        start, seconds_before = saved - spent, self.seconds - spent
        sums: dict[str, Tensor | float] = {}
        first_step, can_save, n_summed, last_losses = self.step, True, 0, ""
        self.model.train()
        if self.world > 1:  # all processes start with the weights of rank 0
            for tensor in (*self.model.state_dict().values(), *self.average.values()):
                dist.broadcast(tensor.detach(), 0)
        try:
            with _recorded_signals(self.world > 1) as self._signals:
                for batch in batches(data, step_numbers, self.device, config.workers, config.draw):
                    with _delayed_signals() if self.world == 1 else nullcontext():
                        can_save = False
                        terms = self.iterate(batch)
                        can_save = True
                    for name, value in terms.items():
                        # The sums stay on the device, so that no step waits for them.
                        sums[name] = sums.get(name, 0.0) + value.detach().float()
                    n_summed += 1
                    now = time.monotonic()
                    self.seconds = seconds_before + now - start
                    if report is not None and (self.step % every == 0 or self.step == config.steps):
                        validates = self.step % (10 * every) == 0 or self.step == config.steps
                        score = validate(self.model) if validate and validates else None
                        means = {name: float(value) / n_summed for name, value in sums.items()}
                        rate = learning_rate(self.step, config)
                        step_report = StepReport(self.step, config.steps, rate, now - start, means, score)
                        report(step_report)
                        sums, n_summed, last_losses = {}, 0, step_report.losses
                    if progress is not None:  # at every step, since one may take seconds
                        progress.named(f"step {self.step:,} of {config.steps:,}{last_losses}")(self.step / config.steps)
                    if checkpoint is not None and now - saved > 60 * config.checkpoint_minutes:
                        self.save(checkpoint)
                        saved = now
                    if self._stop_requested or (
                        config.minutes is not None and self.any_process(now - start > 60 * config.minutes)
                    ):
                        break
        except KeyboardInterrupt:
            if checkpoint is not None and self.world == 1 and can_save and self.step > first_step:
                self.save(checkpoint)
            raise
        if checkpoint is not None:
            self.save(checkpoint)
        self.model.eval()
        if self._stop_requested:
            _handle_first(self._signals)
            raise KeyboardInterrupt  # the signal went to another process

    def iterate(self, batch: Any) -> dict[str, Tensor]:
        """Run one training step on a batch and return its losses. The model must be in training mode."""
        config = self.config
        seed = config.seed * 7919 + self.step * self.world + self.rank
        generator = torch.Generator().manual_seed(seed)
        # Dropout draws from the global stream, which must be the same after resuming.
        torch.manual_seed(seed + 1)
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.step, config)
        with _matmul_precision("high" if config.tf32 else torch.get_float32_matmul_precision()):
            with torch.autocast(self.device.type, torch.bfloat16) if config.bf16 else nullcontext():
                # torch.compile supports random numbers from the global stream only
                terms: dict[str, Tensor] = self.loss(
                    self.model, batch.to(self.device), self.points, None if config.compile else generator
                )
            _check_terms(terms)
            self._check_last()
            self._unchecked = terms, self.step
            if self.device.type == "cpu":
                self._check_last()
            self.optimiser.zero_grad(set_to_none=True)
            terms["total"].backward()
        if self.world > 1:
            self._exchange()
        if config.clip is not None:
            torch.nn.utils.clip_grad_norm_(self.model.parameters(), config.clip)
        self.optimiser.step()
        self.step += 1
        self._update_average()
        return terms

    def _check_last(self) -> None:
        """Raise `ModelError` if the total of the last unchecked step is not finite.

        On a GPU this is checked one step later, so that no step waits for the result.
        """
        if self._unchecked is not None:
            _check_finite(*self._unchecked)
            self._unchecked = None

    def _exchange(self) -> None:
        """Average gradients over all processes, and share whether any received a signal; in one call to all_reduce, for
        each has a fixed cost.
        """
        gradients = [each.grad for each in self.model.parameters() if each.grad is not None]
        stop_flag = gradients[0].new_tensor([float(bool(self._signals))])
        flat = torch.cat([*(each.flatten() for each in gradients), stop_flag])
        dist.all_reduce(flat)
        flat, self._stop_requested = flat[:-1], bool(flat[-1])
        for each, mean in zip(gradients, (flat / self.world).split([each.numel() for each in gradients]), strict=True):
            each.copy_(mean.view_as(each))

    def _update_average(self) -> None:
        # In the first steps the average follows the weights faster.
        keep = min(self.config.average, (1 + self.step) / (10 + self.step))
        names, values = zip(*self.model.named_parameters(), strict=True)
        torch._foreach_lerp_([self.average[n] for n in names], [v.detach() for v in values], 1 - keep)

    def any_process(self, stop: bool) -> bool:
        """Whether ``stop`` is true in any process: if only one stopped, the others would wait for its gradients forever."""
        if self.world == 1:
            return stop
        flag = torch.tensor(float(stop), device=self.device)
        dist.all_reduce(flag, dist.ReduceOp.MAX)
        return bool(flag)

    def close(self) -> None:
        """Leave the process group, if there is one; no further training is possible."""
        if self.world > 1 and dist.is_initialized():
            dist.destroy_process_group()

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Context in which the model has the averaged weights."""
        original = {n: t.detach().clone() for n, t in self.model.state_dict().items()}
        self.model.load_state_dict(self.averaged_state())
        try:
            yield
        finally:
            self.model.load_state_dict(original)

    def averaged_state(self) -> dict[str, Tensor]:
        """State dict of the model with the averaged weights, on the CPU."""
        state = {n: t.detach().cpu().clone() for n, t in self.model.state_dict().items()}
        return state | {n: t.cpu().clone() for n, t in self.average.items()}


@contextmanager
def _matmul_precision(precision: str) -> Iterator[None]:
    """Context with another precision of float32 matrix products; scans are drawn outside it, with full precision."""
    previous = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(previous)


@contextmanager
def _recorded_signals(wanted: bool = True) -> Iterator[list[int]]:
    """Context that only records termination signals; a further one, more than a second later, is handled at once."""
    received: list[int] = []
    last_time = 0.0
    terminating = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    active = wanted and threading.current_thread() is threading.main_thread()
    handlers: dict[int, Any] = {
        signum: current for signum in terminating if active and callable(current := signal.getsignal(signum))
    }

    def record(number: int, frame: Any) -> None:
        nonlocal last_time
        if received and time.monotonic() - last_time > 1:
            handlers[number](number, frame)
        last_time = time.monotonic()
        received.append(number)

    for number in handlers:
        signal.signal(number, record)
    try:
        yield received
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def _delayed_signals() -> Iterator[None]:
    """Context that delays termination signals until its end, unless they are repeated."""
    with _recorded_signals() as received:
        yield
    _handle_first(received)


def _handle_first(received: list[int]) -> None:
    """Call the handler of the first recorded signal, if there is one."""
    handler: Any = signal.getsignal(received[0]) if received else None
    if callable(handler):
        handler(received[0], None)


def _check_terms(terms: Any) -> None:
    """Raise `OptionError` unless a loss returned a dictionary of scalars whose total has a gradient."""
    if not (isinstance(terms, dict) and all(isinstance(each, Tensor) and not each.shape for each in terms.values())):
        raise OptionError("a loss must return a dictionary of scalar tensors", "Objective describes losses")
    if "total" not in terms or not terms["total"].requires_grad:
        raise OptionError("a loss must return a term 'total' that has a gradient", "Objective describes losses")


def _check_finite(terms: dict[str, Tensor], step: int) -> None:
    if not terms["total"].isfinite():
        not_finite = ", ".join(sorted(name for name, each in terms.items() if not each.isfinite()))
        raise ModelError(f"the training diverged at step {step + 1:,}; not finite: {not_finite}", "lower the rate")


def _keep_freed_memory() -> None:
    """Make glibc keep freed memory: returning large tensors to the system and mapping them again, page by page, takes a
    third of the time of the paper's preset."""
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "mallopt"):
        for option in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
            library.mallopt(option, 2**30)
