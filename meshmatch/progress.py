"""Reports of how far long work has come: the callback that users pass, and how stages share one bar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

# Called with the stage ("orientation"), the name of the shape, and the share of the stage that is done (0..1).
ProgressCallback = Callable[[str, str, float], None]


@dataclass(frozen=True)
class Progress:
    """A range of one progress bar; calling it with a share (0..1) of that range reports it."""

    callback: ProgressCallback | None = None  # without one nothing happens
    name: str = ""  # the shape that is worked on
    stage_name: str = ""  # what is going on
    start: float = 0.0  # where on the bar of the stage this range lies
    end: float = 1.0

    def __call__(self, share: float) -> None:
        if self.callback is not None:
            self.callback(self.stage_name, self.name, self.start + share * (self.end - self.start))

    def stage(self, name: str, start: float = 0.0, end: float = 1.0) -> Progress:
        """A range of the bar of another stage."""
        return replace(self, stage_name=name, start=start, end=end)

    def named(self, name: str) -> Progress:
        """This range, as another stage."""
        return replace(self, stage_name=name)

    def between(self, start: float, end: float) -> Progress:
        """A part of this range; both ends are shares of it."""
        width = self.end - self.start
        return replace(self, start=self.start + start * width, end=self.start + end * width)
