"""The colours of labels, in pictures and in files, and the space in which they are evenly apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats
from meshmatch.shapes.srgb import to_srgb

UNKNOWN = (0.62, 0.64, 0.67)
"""What has no value."""


def oklab_to_linear(lab: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
    """Light (N, 3) of colours (N, 3) in Oklab, where equal steps look equal (Ottosson 2020)."""
    roots = lab @ np.array(
        [[1.0, 1.0, 1.0], [0.3963377774, -0.1055613458, -0.0894841775], [0.2158037573, -0.0638541728, -1.291485548]]
    )
    return np.asarray(
        roots**3
        @ np.array(
            [
                [4.0767416621, -1.2684380046, -0.0041960863],
                [-3.3077115913, 2.6097574011, -0.7034186147],
                [0.2309699292, -0.3413193965, 1.7076147010],
            ]
        )
    )


def label_colors(labels: ArrayLike) -> Float[Floats, "N 3"]:
    """Written colours (N, 3) of labels (N,): the same for the same label always, and neighbours far apart."""
    number = np.asarray(labels, dtype=np.int64)
    # Hue by the golden angle; three rings of lightness, so that many labels stay apart.
    hue = np.radians(28.0 + 137.50776 * (number % 1000))
    light = np.array([0.68, 0.80, 0.55])[number % 3]
    chroma = np.array([0.145, 0.115, 0.12])[number % 3]
    lab = np.stack([light, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    return np.where((number >= 0)[..., None], to_srgb(oklab_to_linear(lab)), UNKNOWN)
