"""The network of a category: points in, the rows of the template's field out (node vectors; a code if pointwise).

Frames. ``scan frame``: centroid 0, surface area 1, any rotation. ``core frame``: the scan turned and shifted
so that the fitted template's core (a body's torso; the whole shape elsewhere) lies on the template's own.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import torch
from torch import nn

from meshmatch.arrays import Float, Floats
from meshmatch.errors import ModelError
from meshmatch.fields.choice import FIELDS, FieldName, field_at, has_nodes
from meshmatch.fields.field import PointField, apply_shape_functions
from meshmatch.fields.pointwise import TURN_ROWS, PointwiseField, code_rows, turned_rows
from meshmatch.geometry.kernels import Kernel
from meshmatch.models.decoder import FlatDecoder, NodeDecoder, PointDecoder
from meshmatch.models.encoder import BasisEncoder, PointEncoder
from meshmatch.models.layers import residual_mlp
from meshmatch.models.neighbours import two_way_offsets

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
            raise ModelError(
                f"unknown network: encoder {self.encoder!r}, decoder {self.decoder!r}", "update meshmatch"
            )
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


def rotation_from_six(six: Float[torch.Tensor, "B 6"]) -> Float[torch.Tensor, "B 3 3"]:
    """Rotations by Gram-Schmidt on two predicted columns (Zhou et al., CVPR 2019)."""
    a = nn.functional.normalize(six[:, :3], dim=-1)
    b = six[:, 3:] - (a * six[:, 3:]).sum(-1, keepdim=True) * a
    b = nn.functional.normalize(b, dim=-1)
    return torch.stack([a, b, torch.linalg.cross(a, b)], -1)


class Deformer(nn.Module):
    """Aligner, encoder, decoder and correctors around one template's nodes.

    Parameters
    ----------
    nodes
        Control nodes in the template frame.
    anchors, anchor_phi
        Points of the template where a correction looks at the scan, and the field's shape functions there; None where
        the field has no nodes.
    basis, align_basis
        Basis points of encoder and aligner; ignored (may be empty) where the config does not use them.
    """

    def __init__(
        self,
        config: NetworkConfig,
        nodes: Float[torch.Tensor, "K 3"],
        anchors: Float[torch.Tensor, "A 3"],
        anchor_phi: Float[torch.Tensor, "A K"] | None,
        basis: Float[torch.Tensor, "M 3"],
        align_basis: Float[torch.Tensor, "N 3"],
    ) -> None:
        super().__init__()
        self.config = config
        K, A = len(nodes), len(anchors)
        self.nodes: torch.Tensor
        self.anchors: torch.Tensor
        self.anchor_phi: torch.Tensor | None
        self.register_buffer("nodes", nodes)
        self.register_buffer("anchors", anchors)
        self.register_buffer("anchor_phi", anchor_phi)
        if config.encoder == "basis":
            self.encoder: BasisEncoder | PointEncoder = BasisEncoder(
                basis, config.width, config.depth, config.code
            )
        else:
            self.encoder = PointEncoder(config.code)
        self.decoder: FlatDecoder | NodeDecoder | PointDecoder
        rows = K
        if not has_nodes(config.field):
            self.decoder, rows = PointDecoder(config.code, config.width), code_rows(config.code)
        elif config.decoder == "flat":
            self.decoder = FlatDecoder(config.code, config.width, 1, K)
        else:
            self.decoder = NodeDecoder(config.code, nodes, config.width)
        self.aligner = BasisEncoder(align_basis, config.align_width, 2, 9) if config.align_basis else None
        self.corrector = (
            residual_mlp(A * 10, config.correct_width, 1, 3 * rows) if config.corrections else None
        )

    @property
    def K(self) -> int:
        return len(self.nodes)

    def field(
        self, points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"], radius: float, kernel: Kernel
    ) -> PointField:
        """The field that reads this network's rows, on points of the template's frame.

        ``nodes`` are the template's, in their own precision.
        """
        motion = self.decoder.displacement if isinstance(self.decoder, PointDecoder) else None
        return field_at(self.config.field, points, nodes, radius, kernel, motion, self.config.code)

    def turned(self, vectors: Float[Floats, "R 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "R 3"]:
        """Rows of the deformation whose moved points (rows) are those of ``vectors`` times ``turn``."""
        if isinstance(self.decoder, PointDecoder):
            return turned_rows(vectors, turn)
        nodes = self.nodes.double().cpu().numpy()
        # A node at q moves to Q^T (q + u), so its vector in the turned frame is that minus q.
        return (nodes + vectors) @ turn - nodes

    def align(
        self, features: Float[torch.Tensor, "B N 3"]
    ) -> tuple[Float[torch.Tensor, "B 3 3"], Float[torch.Tensor, "B 3"]]:
        """Rotation R and center t of the core: scan = R core + t."""
        assert self.aligner is not None
        out = self.aligner(features)
        return rotation_from_six(out[:, :6]), out[:, 6:]

    def correct(
        self, vectors: Float[torch.Tensor, "B R 3"], points: Float[torch.Tensor, "B P 3"]
    ) -> Float[torch.Tensor, "B R 3"]:
        """One learned registration step: better rows from rows and scan points, both in the core frame."""
        assert self.corrector is not None
        moved = self._at_anchors(vectors)  # B A 3
        seen = two_way_offsets(self.anchors + moved, points)
        features = torch.cat([seen[..., :6] * 10.0, seen[..., 6:], moved * 3.0], -1)
        change = 0.1 * self.corrector(features.flatten(1)).unflatten(-1, (-1, 3))
        if isinstance(self.decoder, PointDecoder):
            change = nn.functional.pad(change, (0, 0, 0, TURN_ROWS))  # the code alone is learned
        return vectors + change

    def _at_anchors(self, vectors: torch.Tensor) -> torch.Tensor:
        if isinstance(self.decoder, PointDecoder):
            motion = self.decoder.displacement
            return PointwiseField(self.anchors, self.anchors, motion, self.config.code).displacement(vectors)
        assert self.anchor_phi is not None
        return apply_shape_functions(self.anchor_phi, vectors)

    def forward(self, points: Float[torch.Tensor, "B P 3"]) -> Float[torch.Tensor, "B R 3"]:
        """The rows of scans in the core frame; with nodes, these are their vectors."""
        vectors = self.decoder(self.encoder(self.encoder.features(points)))
        for _ in range(self.config.corrections):
            vectors = self.correct(vectors, points)
        return vectors
