"""Find the pixels of a line in the picture of a chart."""

from pathlib import Path

import numpy as np
from PIL import Image

from meshmatch.render.charts import COLORS


def spots(path: Path, number: int, left: float = 0.0, top: float = 0.15, right: float = 0.78) -> np.ndarray:
    """Return x (to the right) and y (upward), (N, 2), of the pixels in a line's color.

    ``left``, ``top`` and ``right``, as fractions of the picture, exclude the legend.
    """
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"), int)
    wanted = [int(COLORS[number][k : k + 2], 16) for k in (1, 3, 5)]
    rows, columns = np.nonzero(np.abs(pixels - wanted).max(2) < 16)
    inside = (rows > top * len(pixels)) & (columns > left * pixels.shape[1]) & (columns < right * pixels.shape[1])
    return np.stack([columns, len(pixels) - rows], 1)[inside]


def middle(points: np.ndarray) -> np.ndarray:
    return (points.min(0) + points.max(0)) / 2
