"""Which part of the picture plane the pixels of a picture show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Window:
    """Which part of the picture plane the pixels show: ``left`` and ``top`` of the first one's corner."""

    width: int
    height: int
    left: float
    top: float
    pixel: float

    def at(self, column: NDArray[Any], row: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """x and y of places in the picture, counted in pixels from its upper left corner."""
        return self.left + self.pixel * column, self.top - self.pixel * row
