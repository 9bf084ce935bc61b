"""Kernels of moving least squares: how much a node weighs at a distance, up to its support radius.

This is the one place of a new kernel: its name in `Kernel`, its function in `KERNELS`. The functions take NumPy arrays
and torch tensors alike.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

Kernel = Literal["cubic", "smooth"]


def _cubic(distance: Any, radius: Any) -> tuple[Any, Any]:
    """(1 - d/r)^3, the NeurIPS 2022 paper's; its gradient is set to 0 at the node by symmetry."""
    inside = (1 - distance / radius).clip(min=0)
    slope = -3 * inside**2 / (radius * distance.clip(min=1e-30))
    return inside**3, slope * (distance > 0)


def _smooth(distance: Any, radius: Any) -> tuple[Any, Any]:
    """(1 - d^2/r^2)^3, which is C1 at the node."""
    inside = (1 - (distance / radius) ** 2).clip(min=0)
    return inside**3, -6 * inside**2 / radius**2


# (distance, radius) -> weight w(d) and its slope (dw/dd) / d
KERNELS: dict[Kernel, Callable[[Any, Any], tuple[Any, Any]]] = {"cubic": _cubic, "smooth": _smooth}
