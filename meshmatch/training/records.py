"""Write a training's reports while it runs, to metrics.jsonl and as curves for TensorBoard."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from meshmatch.errors import OutputError, needs
from meshmatch.outputs import replace_on_success
from meshmatch.training.loop import StepReport, Trainer

METRICS = "metrics.jsonl"
CURVES = "tensorboard"
Report = Callable[[StepReport], None]


class Metrics:
    """Append reports to a file as lines of JSON: step, rate, seconds of all runs, loss terms, validation error.

    Lines of an existing file are kept up to the step that training resumes from. ``best`` is the lowest validation error
    in the file. `OutputError` if it cannot be written.
    """

    def __init__(self, path: Path, trainer: Trainer) -> None:
        self.path, self.trainer, kept_lines = path, trainer, []
        scores = []
        with suppress(OSError, ValueError, KeyError, TypeError):
            for line in path.read_text(encoding="utf-8").splitlines() if trainer.step else []:
                row = json.loads(line)
                if row["step"] <= trainer.step:
                    kept_lines.append(line)
                    scores += [float(row["validation"])] if "validation" in row else []
        self.best = min(scores, default=float("inf"))
        with replace_on_success(path) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in kept_lines), encoding="utf-8")

    def __call__(self, now: StepReport) -> None:
        record = {"step": now.step, "rate": now.rate, "seconds": round(self.trainer.seconds, 3), **now.terms}
        record |= {} if now.validation is None else {"validation": now.validation}
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
        except OSError as error:
            hint = "the same command goes on from the last checkpoint"
            raise OutputError(f"cannot write {self.path}: {error.strerror}", hint) from error

    def is_best(self, score: float) -> bool:
        """Whether a validation error is the lowest so far; it is then stored in ``best``."""
        lower = score < self.best
        self.best = min(score, self.best)
        return lower


def curves(folder: Path, step: int) -> Report:
    """Report function that writes curves for TensorBoard after a step; `OptionError` if TensorBoard is not installed."""
    check_curves()
    from torch.utils.tensorboard import SummaryWriter

    writer: Any = SummaryWriter(folder, purge_step=step + 1)

    def write_curves(now: StepReport) -> None:
        values = {"rate": now.rate} | {f"loss/{name}": value for name, value in now.terms.items()}
        values |= {} if now.validation is None else {"validation": now.validation}
        for name, value in values.items():
            writer.add_scalar(name, value, now.step)
        writer.flush()

    return write_curves


def check_curves() -> None:
    """Raise `OptionError` if TensorBoard is not installed."""
    with needs("tensorboard", "tensorboard"):
        import tensorboard  # noqa: F401


def combine_reports(*reports: Report | None) -> Report:
    """Report function that calls several others in order, skipping None."""

    def combined(now: StepReport) -> None:
        for report in reports:
            if report is not None:
                report(now)

    return combined
