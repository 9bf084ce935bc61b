"""Which representation: the one place that tells them apart by name."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import torch

from meshmatch.fields.field import PointField
from meshmatch.fields.mls import Kernel, build_field
from meshmatch.fields.pointwise import Motion, PointwiseField
from meshmatch.fields.rbf import build_rbf

FieldName = Literal["mls", "rbf", "pointwise"]
FIELDS: tuple[FieldName, ...] = get_args(FieldName)


def has_nodes(name: FieldName) -> bool:
    """Whether a deformation is given by node vectors, in which it is linear."""
    return name != "pointwise"


def lay_field(
    name: FieldName,
    points: np.ndarray,
    nodes: np.ndarray,
    radius: float,
    kernel: Kernel,
    motion: Motion | None = None,
    D: int = 0,
) -> PointField:
    """A representation on fixed points (P, 3) of the template's frame.

    ``nodes`` (K, 3), ``radius`` and ``kernel`` are for those that have them; ``motion``, with codes of ``D`` numbers, for
    the pointwise one.

    Raises
    ------
    TemplateError
        The nodes do not carry the points: too few in reach (mls), two in one place (rbf).
    """
    if name == "rbf":
        return build_rbf(points, nodes)
    if name == "pointwise":
        assert motion is not None
        at = torch.from_numpy(np.array(points)).float()
        return PointwiseField(at, at, motion, D)
    return build_field(points, nodes, radius, kernel)
