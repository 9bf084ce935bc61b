"""Which representation: the one place that tells them apart by name."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import torch

from meshmatch.arrays import Float, Floats
from meshmatch.fields.field import PointField
from meshmatch.fields.mls import build_field
from meshmatch.fields.pointwise import Motion, PointwiseField
from meshmatch.fields.rbf import build_rbf
from meshmatch.geometry.kernels import Kernel

FieldName = Literal["mls", "rbf", "pointwise"]
FIELDS: tuple[FieldName, ...] = get_args(FieldName)


def has_nodes(name: FieldName) -> bool:
    """Whether a deformation is given by node vectors, in which it is linear."""
    return name != "pointwise"


def field_at(
    name: FieldName,
    points: Float[Floats, "P 3"],
    nodes: Float[Floats, "K 3"],
    radius: float,
    kernel: Kernel,
    motion: Motion | None = None,
    D: int = 0,
) -> PointField:
    """A representation on fixed points of the template's frame.

    ``nodes``, ``radius`` and ``kernel`` are for those that have them; ``motion``, with codes of ``D`` numbers, for
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
