"""Progress reports of long work: the callback that users pass, and how stages share one progress bar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

# Called with the stage ("orientation"), the name of the shape, and the finished share of the stage (0..1).
ProgressCallback = Callable[[str, str, float], None]


@dataclass(frozen=True)
class Progress:
    """A range of a progress bar; call it with a share (0..1) of that range to report it."""

    callback: ProgressCallback | None = None  # None: nothing is reported
    name: str = ""  # of the shape
    stage_name: str = ""  # the current stage
    start: float = 0.0  # share of the stage's bar where this range begins
    end: float = 1.0

    def __call__(self, share: float) -> None:
        if self.callback is not None:
            self.callback(self.stage_name, self.name, self.start + share * (self.end - self.start))

    def stage(self, name: str, start: float = 0.0, end: float = 1.0) -> Progress:
        """A range of the bar of another stage."""
        return replace(self, stage_name=name, start=start, end=end)

    def named(self, name: str) -> Progress:
        """The same range of another stage's bar."""
        return replace(self, stage_name=name)

    def between(self, start: float, end: float) -> Progress:
        """A subrange; both ends are shares (0..1) of this range."""
        width = self.end - self.start
        return replace(self, start=self.start + start * width, end=self.start + end * width)
