"""Deformation fields, which move points by the vectors of a few nodes, and energies of such deformations.

`node_field` is for arbitrary nodes and points, in NumPy or torch (docs/fields.md). The public names are imported on first
use; the two energies need torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from meshmatch.fields.field import arap_energy as arap_energy
    from meshmatch.fields.field import volume_energy as volume_energy
    from meshmatch.fields.own_nodes import NodeField as NodeField
    from meshmatch.fields.own_nodes import node_field as node_field

_HOMES = {
    "NodeField": "meshmatch.fields.own_nodes",
    "node_field": "meshmatch.fields.own_nodes",
    "arap_energy": "meshmatch.fields.field",
    "volume_energy": "meshmatch.fields.field",
}


__all__ = ["NodeField", "arap_energy", "node_field", "volume_energy"]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'meshmatch.fields' has no attribute {name!r}")
    from importlib import import_module

    from meshmatch.errors import needs

    with needs("torch", "train"):
        return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
