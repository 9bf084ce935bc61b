"""What a network is made of, as the model card says it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from meshmatch.errors import ModelError
from meshmatch.fields.shape_functions import FIELDS, FieldName

_MAX = {
    "code": 4096, "width": 8192, "depth": 64, "basis": 8192,
    "align_basis": 8192, "align_width": 8192, "corrections": 64, "correct_width": 8192,
}  # fmt: skip


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes and choices of a deformer; saved in the model card (cards without ``field`` have moving least squares).

    The defaults were chosen on generated bodies (docs/results.md, ablations).

    A pointwise field has a decoder of its own, whatever ``decoder`` says.
    """

    encoder: Literal["basis", "point"] = "basis"
    decoder: Literal["flat", "node"] = "flat"
    code: int = 512
    width: int = 768
    depth: int = 2
    basis: int = 768
    align_basis: int = 512
    align_width: int = 512
    corrections: int = 3
    correct_width: int = 640
    field: FieldName = "mls"

    def __post_init__(self) -> None:
        # A card may come from anywhere: bound what building the network allocates.
        if self.encoder not in ("basis", "point") or self.decoder not in ("flat", "node"):
            raise ModelError(f"unknown network: encoder {self.encoder!r}, decoder {self.decoder!r}", "update meshmatch")
        if self.field not in FIELDS:
            raise ModelError(f"unknown field {self.field!r}, only {', '.join(FIELDS)}", "update meshmatch")
        for name, limit in _MAX.items():
            value = getattr(self, name)
            if type(value) is not int or not 0 <= value <= limit:
                raise ModelError(f"network option {name} must be an integer from 0 to {limit}, not {value!r}")

    @staticmethod
    def from_dict(values: dict) -> NetworkConfig:
        known = NetworkConfig.__dataclass_fields__
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ModelError(f"unknown network options: {', '.join(unknown)}", "update meshmatch")
        return NetworkConfig(**values)

    def to_dict(self) -> dict:
        return asdict(self)


PAPER = NetworkConfig(encoder="point", decoder="node", width=1024, align_basis=0, corrections=0)
