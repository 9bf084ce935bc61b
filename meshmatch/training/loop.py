"""The training loop: time budget, exact resume, several GPUs, an average of the weights for use."""

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
from numbers import Integral
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
from meshmatch.training.batches import Draw, batches
from meshmatch.training.losses import CorrespondenceLoss, Objective

OF_THE_MACHINE = ("minutes", "checkpoint_minutes", "threads", "device", "draw", "compile")
"""Settings of a training that a recipe does not pass on."""
_OF_TEMPLATE = ("nodes", "anchors")  # what a checkpoint must share with the training that goes on from it
_MOMENTS, _COUNT = ("exp_avg", "exp_avg_sq"), {"step": torch.Size()}  # of Adam: what it knows of each parameter


@dataclass(frozen=True)
class TrainConfig:
    """How long and how fast to learn.

    ``steps`` fixes the schedule: warm-up, a constant rate, then a cosine to zero over the last ``decay`` share.
    ``minutes`` only stops the run (with a checkpoint to go on from). ``align_steps``: so many steps of the aligner alone
    come first. ``device``: "auto" (a GPU of CUDA if there is one), "cpu", "cuda" or "mps"; ``draw``: where batches are
    drawn: "cpu", "device", or "auto" (on a GPU of CUDA). ``bf16``, and on GPUs that have it ``tf32``, round the factors of
    products; torch may ``compile`` the loss. `OptionError` if a number cannot be.
    """

    steps: int = 20_000
    shapes: int = 32
    scans_per_shape: int = 2
    rate: float = 1e-3
    warm_up: int = 200
    decay: float = 0.4
    weight_decay: float = 0.01
    average: float = 0.999  # how much of the averaged weights a step keeps; 0: the last weights are the model's
    momentum: float = 0.99  # of squared gradients: the second beta of Adam
    clip: float | None = 1.0  # largest norm of a gradient
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
        for name in ("steps", "shapes", "scans_per_shape", "threads"):
            value = getattr(self, name)
            if not isinstance(value, Integral) or value < 1:
                raise OptionError(f"{name} must be 1 or more, a whole number, not {value!r}")
        if self.draw not in get_args(Draw):
            raise OptionError(f"batches are drawn on {', '.join(get_args(Draw))}, not {self.draw!r}")
        numbers = isinstance(self.rate, int | float) and isinstance(self.decay, int | float)
        whole = isinstance(self.workers, Integral)
        if not (numbers and whole and self.rate > 0 and 0 <= self.decay <= 1 and self.workers >= 0):
            raise OptionError("a training needs a positive rate, a decay in 0..1 and workers of 0 or more")
        if self.minutes is not None and not (isinstance(self.minutes, int | float) and self.minutes > 0):
            raise OptionError(f"minutes must be positive, not {self.minutes!r}")
        if not isinstance(self.loss, Objective):
            raise OptionError(f"a loss is an Objective, not {self.loss!r}", "docs/training.md has one of your own")


@dataclass(frozen=True)
class StepReport:
    """What a caller may show after a step: step counts, rate, seconds of this run, means of the losses since the last."""

    step: int
    steps: int
    rate: float
    seconds: float
    terms: dict[str, float]
    validation: float | None = None

    @property
    def words(self) -> str:
        """One line for people."""
        return f"step {self.step:,} of {self.steps:,}{self.losses}"

    @property
    def losses(self) -> str:
        """What `words` say of them."""
        words = ", ".join(f"{name} {value:.4g}" for name, value in self.terms.items())
        known = "" if self.validation is None else f", validation {self.validation:.4f}"
        return f": {words}{known}"


def settings_of(record: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Numbers and words of a recipe, by dotted names, without what belongs to the machine."""
    found: dict[str, Any] = {}
    for name, value in record.items():
        if isinstance(value, Mapping):
            found |= settings_of(value, f"{prefix}{name}.")
        elif name not in (*OF_THE_MACHINE, "workers"):
            found[prefix + name] = value
    return found


def learning_rate(step: int, config: TrainConfig) -> float:
    """Rate of a step: linear warm-up, constant, cosine to zero."""
    start = (1 - config.decay) * config.steps
    faded = min(1.0, max(0.0, step - start) / max(config.steps - start, 1))
    fade = 0.5 * (1 + math.cos(math.pi * faded))
    return config.rate * min(1.0, (step + 1) / max(config.warm_up, 1)) * fade


def processes() -> int:
    """How many learn together, each from batches of its own, as torchrun says."""
    return int(os.environ.get("WORLD_SIZE", 1))


class Trainer:
    """State of a run: weights, their average, the optimiser and the next step. All of it is in a checkpoint."""

    def __init__(
        self, model: Any, points: Any, config: TrainConfig, digest: str = "", recipe: Mapping[str, Any] | None = None
    ) -> None:
        self.config, self.digest = config, digest  # of the shapes, see `Lessons`; empty where it is not known
        self.settings: dict[str, Any] = settings_of(recipe or asdict(config)) | {"processes": processes()}
        self.earlier: list[dict[str, Any]] = []  # until which step other settings held, and which
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
        self._unchecked: tuple[dict[str, Tensor], int] | None = None  # terms of a step, which a GPU still computes
        self._came: list[int] = []  # signals that are to end one of several processes
        self._ends = False  # whether one came to any of them

    def save(self, path: Path) -> None:
        """Write everything that the next step depends on (rank 0 only)."""
        self._check_last()
        if self.rank:
            return
        arrays = {f"model.{n}": t for n, t in self.model.state_dict().items()}
        arrays |= {f"average.{n}": t for n, t in self.average.items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            arrays |= {f"optimiser.{index}.{n}": torch.as_tensor(t) for n, t in state.items()}
        arrays = {n: t.detach().cpu().contiguous().clone() for n, t in arrays.items()}
        with replace_on_success(path) as temporary:
            words = {"step": str(self.step), "seconds": f"{self.seconds:.1f}", "seed": str(self.config.seed)}
            words |= {"settings": json.dumps(self.settings, default=str), "earlier": json.dumps(self.earlier)}
            save_file(arrays, temporary, words | {"digest": self.digest})

    def load(self, path: Path) -> None:
        """Go on where `save` was called; `ModelError` if the file is none, or of another seed, network or template, or of
        other shapes. Other settings than before are told, and kept for the card."""
        hint = "train into another folder, or start afresh"
        here = self.model.state_dict()
        of_parameters = {name: tensor.shape for name, tensor in self.average.items()}
        expected = {"model": {name: tensor.shape for name, tensor in here.items()}, "average": of_parameters}
        parts: dict[str, dict[str, Tensor]] = {"model": {}, "average": {}, "optimiser": {}}
        state: dict[int, dict[str, Tensor]] = {}
        try:
            with safe_open(str(path), framework="pt") as file:
                words = file.metadata() or {}
                step, seconds = int(words["step"]), float(words.get("seconds", 0.0))
                seed, digest = int(words.get("seed", self.config.seed)), words.get("digest", "")
                known, earlier = json.loads(words.get("settings", "{}")), json.loads(words.get("earlier", "[]"))
                if not isinstance(known, dict) or not isinstance(earlier, list):
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
        moments = {n: dict.fromkeys(_MOMENTS, p.shape) | _COUNT for n, p in enumerate(self.model.parameters())}
        if any({key: t.shape for key, t in state[n].items()} != moments.get(n) for n in state):
            raise ModelError(f"{path} is not a checkpoint of a training", hint)
        weights = parts["model"]
        if not all(torch.equal(weights[n], here[n].cpu()) for n in here if n.endswith(_OF_TEMPLATE)):
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
        self._note_changes(known)

    def _note_changes(self, before: dict[str, Any]) -> None:
        """Tell which settings of the training up to here were others."""
        now = json.loads(json.dumps(self.settings, default=str))
        changed = {name: value for name, value in before.items() if name in now and now[name] != value}
        if changed and self.step:
            self.earlier = [*self.earlier, {"until_step": self.step} | changed]
            words = ", ".join(
                f"{name.rpartition('.')[2]} {value} is {now[name]} now" for name, value in changed.items()
            )
            warn(f"the {self.step:,} steps of the checkpoint had other settings: {words}")

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
        """Train until ``steps`` or ``minutes`` are over, of which so many seconds are ``spent``; writes ``checkpoint`` now
        and then, at the end, and where Ctrl-C ends it; several processes end after the same step."""
        config = self.config
        torch.set_num_threads(config.threads)
        _keep_memory()
        ours = range(self.rank, config.steps * self.world, self.world)[self.step : config.steps]
        saved = time.monotonic()
        began, before = saved - spent, self.seconds - spent
        sums: dict[str, Tensor | float] = {}
        first, between, summed, lately = self.step, True, 0, ""
        self.model.train()
        if self.world > 1:  # which begin with the same weights
            for held in (*self.model.state_dict().values(), *self.average.values()):
                dist.broadcast(held.detach(), 0)
        try:
            with _noted(self.world > 1) as self._came:
                for batch in batches(data, ours, self.device, config.workers, config.draw):
                    with _whole() if self.world == 1 else nullcontext():
                        between = False
                        terms = self.iterate(batch)
                        between = True
                    for name, value in terms.items():
                        sums[name] = (
                            sums.get(name, 0.0) + value.detach().float()
                        )  # there: no step waits for a GPU's numbers
                    summed += 1
                    now = time.monotonic()
                    self.seconds = before + now - began
                    if report is not None and (self.step % every == 0 or self.step == config.steps):
                        asked = self.step % (10 * every) == 0 or self.step == config.steps
                        score = validate(self.model) if validate and asked else None
                        means = {name: float(value) / summed for name, value in sums.items()}
                        rate = learning_rate(self.step, config)
                        reported = StepReport(self.step, config.steps, rate, now - began, means, score)
                        report(reported)
                        sums, summed, lately = {}, 0, reported.losses
                    if progress is not None:  # at every step, for one may take seconds
                        progress.named(f"step {self.step:,} of {config.steps:,}{lately}")(self.step / config.steps)
                    if checkpoint is not None and now - saved > 60 * config.checkpoint_minutes:
                        self.save(checkpoint)
                        saved = now
                    if self._ends or (config.minutes is not None and self.any_says(now - began > 60 * config.minutes)):
                        break
        except KeyboardInterrupt:
            if checkpoint is not None and self.world == 1 and between and self.step > first:
                self.save(checkpoint)
            raise
        if checkpoint is not None:
            self.save(checkpoint)
        self.model.eval()
        if self._ends:
            _obey(self._came)
            raise KeyboardInterrupt  # another process was told to

    def iterate(self, batch: Any) -> dict[str, Tensor]:
        """One step of training on a batch; returns its losses. The model must be in training mode."""
        config = self.config
        seed = config.seed * 7919 + self.step * self.world + self.rank
        generator = torch.Generator().manual_seed(seed)
        # Dropout draws from the global stream: a resumed run must meet the same.
        torch.manual_seed(seed + 1)
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(self.step, config)
        with _products("high" if config.tf32 else torch.get_float32_matmul_precision()):
            with torch.autocast(self.device.type, torch.bfloat16) if config.bf16 else nullcontext():
                # torch compiles draws from its global stream alone
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
        """`ModelError` if the total of the last step is not finite. Where that waits for a GPU it is asked a step later."""
        if self._unchecked is not None:
            _check_finite(*self._unchecked)
            self._unchecked = None

    def _exchange(self) -> None:
        """Gradients become the means over all processes, and all know whether one is to end: all at once, for each exchange
        takes time of its own.
        """
        held = [each.grad for each in self.model.parameters() if each.grad is not None]
        ends = held[0].new_tensor([float(bool(self._came))])
        flat = torch.cat([*(each.flatten() for each in held), ends])
        dist.all_reduce(flat)
        flat, self._ends = flat[:-1], bool(flat[-1])
        for each, mean in zip(held, (flat / self.world).split([each.numel() for each in held]), strict=True):
            each.copy_(mean.view_as(each))

    def _update_average(self) -> None:
        # A young average follows quickly, an old one slowly.
        keep = min(self.config.average, (1 + self.step) / (10 + self.step))
        names, values = zip(*self.model.named_parameters(), strict=True)
        torch._foreach_lerp_([self.average[n] for n in names], [v.detach() for v in values], 1 - keep)

    def any_says(self, stop: bool) -> bool:
        """Whether any process says so: one that stopped alone would leave the others waiting for its gradients."""
        if self.world == 1:
            return stop
        said = torch.tensor(float(stop), device=self.device)
        dist.all_reduce(said, dist.ReduceOp.MAX)
        return bool(said)

    def close(self) -> None:
        """Part from the other processes, if there are any; nothing more can be trained."""
        if self.world > 1 and dist.is_initialized():
            dist.destroy_process_group()

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """The model with the averaged weights, within the block."""
        before = {n: t.detach().clone() for n, t in self.model.state_dict().items()}
        self.model.load_state_dict(self.averaged_state())
        try:
            yield
        finally:
            self.model.load_state_dict(before)

    def averaged_state(self) -> dict[str, Tensor]:
        """State dict of the model with the averaged weights, on the CPU."""
        state = {n: t.detach().cpu().clone() for n, t in self.model.state_dict().items()}
        return state | {n: t.cpu().clone() for n, t in self.average.items()}


@contextmanager
def _products(precision: str) -> Iterator[None]:
    """How exact products of float32 matrices are within the block: scans are always drawn with exact ones."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@contextmanager
def _noted(wanted: bool = True) -> Iterator[list[int]]:
    """Signals that end the program are noted alone within the block; one that comes again, a second later, ends it."""
    came: list[int] = []
    began = 0.0
    named = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    ours = wanted and threading.current_thread() is threading.main_thread()
    handlers: dict[int, Any] = {each: found for each in named if ours and callable(found := signal.getsignal(each))}

    def note(number: int, frame: Any) -> None:
        nonlocal began
        if came and time.monotonic() - began > 1:
            handlers[number](number, frame)
        began = time.monotonic()
        came.append(number)

    for number in handlers:
        signal.signal(number, note)
    try:
        yield came
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def _whole() -> Iterator[None]:
    """Signals that end the program wait until the block is done, unless they come again."""
    with _noted() as came:
        yield
    _obey(came)


def _obey(came: list[int]) -> None:
    """Let the first of some signals do what it does."""
    handler: Any = signal.getsignal(came[0]) if came else None
    if callable(handler):
        handler(came[0], None)


def _check_terms(terms: Any) -> None:
    """What a loss gave: `OptionError` if nothing can be learned from it."""
    if not (isinstance(terms, dict) and all(isinstance(each, Tensor) and not each.shape for each in terms.values())):
        raise OptionError("a loss must give a dictionary of tensors, each of one number", "Objective describes losses")
    if "total" not in terms or not terms["total"].requires_grad:
        raise OptionError("a loss must give a term 'total' that has a gradient", "Objective describes losses")


def _check_finite(terms: dict[str, Tensor], step: int) -> None:
    if not terms["total"].isfinite():
        strange = ", ".join(sorted(name for name, each in terms.items() if not each.isfinite()))
        raise ModelError(f"the training diverged: not finite at step {step + 1:,} are {strange}", "take a lower rate")


def _keep_memory() -> None:
    """Let glibc keep what is freed: returning large tensors to the system and getting them again, page by page, costs the
    paper's preset a third of its time."""
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "mallopt"):
        for option in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
            library.mallopt(option, 2**30)
