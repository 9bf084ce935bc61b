"""What every generator is: a resting shape with its parts, and shapes without end on its vertices, in random poses."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from meshmatch.arrays import Float

Source = Callable[[int, torch.Generator], Float[Tensor, "N V 3"]]
"""Draws shapes with the template's connectivity: (count, generator) -> vertices (count, V, 3), any unit."""
