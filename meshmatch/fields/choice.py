"""Which representation: the one place that tells them apart by name."""

from __future__ import annotations

from typing import Literal, get_args

from meshmatch.arrays import Float, Floats
from meshmatch.fields.mls import build_field
from meshmatch.fields.rbf import build_rbf
from meshmatch.fields.shape_functions import ShapeFunctions
from meshmatch.geometry.kernels import Kernel

FieldName = Literal["mls", "rbf", "pointwise"]
FIELDS: tuple[FieldName, ...] = get_args(FieldName)


def has_nodes(name: FieldName) -> bool:
    """Whether a deformation is given by node vectors, in which it is linear."""
    return name != "pointwise"


def shape_functions(
    name: FieldName, points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radius: float, kernel: Kernel
) -> ShapeFunctions:
    """A representation that has nodes, on fixed points of the template's frame; radial basis functions take all nodes.

    Raises
    ------
    TemplateError
        The nodes do not carry the points: too few in reach (mls), two in one place (rbf).
    """
    assert has_nodes(name)
    return build_rbf(points, nodes) if name == "rbf" else build_field(points, nodes, radius, kernel)
