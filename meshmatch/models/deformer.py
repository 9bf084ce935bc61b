"""The network of a category in torch: from point sets to rows of the template's field (node vectors, or a code).

Frames. ``scan frame``: centroid 0, surface area 1, any rotation. ``core frame``: the scan rotated and translated
so that the fitted template's core (a body's torso, or the whole shape in other categories) lies on the template's own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import nn

from meshmatch.arrays import Float, Floats, Floats32
from meshmatch.errors import InputError
from meshmatch.fields import field as fields
from meshmatch.fields.field import TURN_ROWS, PointField, PointwiseField
from meshmatch.fields.shape_functions import has_nodes, shape_functions
from meshmatch.geometry.kernels import Kernel
from meshmatch.models import layers
from meshmatch.models.network import NetworkConfig, encoder_errors


def rotation_from_six(six: Float[torch.Tensor, "B 6"]) -> Float[torch.Tensor, "B 3 3"]:
    """Rotations by Gram-Schmidt on two predicted columns (Zhou et al., CVPR 2019)."""
    a = nn.functional.normalize(six[:, :3], dim=-1)
    b = six[:, 3:] - (a * six[:, 3:]).sum(-1, keepdim=True) * a
    b = nn.functional.normalize(b, dim=-1)
    return torch.stack([a, b, torch.linalg.cross(a, b)], -1)


class Deformer(nn.Module):
    """Aligner, encoder, decoder and corrector for the nodes of one template.

    Nodes and anchors are in the template frame. Anchors are points at which corrections compare the deformed template with
    the scan; ``anchor_phi`` are the field's shape functions there, None if the field has no nodes. Basis points of the
    encoder and the aligner are ignored, and may be empty, if the config does not use them.
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
        self.encoder: layers.Encoder
        if isinstance(config.encoder, type):
            with encoder_errors(config.encoder):
                self.encoder = config.encoder(basis, config.code)
        elif config.encoder == "basis":
            self.encoder = layers.BasisEncoder(basis, config.width, config.depth, config.code)
        else:
            self.encoder = layers.PointEncoder(config.code)
        self.decoder: layers.FlatDecoder | layers.NodeDecoder | layers.PointDecoder
        rows = K
        if not has_nodes(config.field):
            self.decoder, rows = layers.PointDecoder(config.code, config.width), fields.code_rows(config.code)
        elif config.decoder == "flat":
            self.decoder = layers.FlatDecoder(config.code, config.width, 1, K)
        else:
            self.decoder = layers.NodeDecoder(config.code, nodes, config.width)
        self.aligner = layers.BasisEncoder(align_basis, config.align_width, 2, 9) if config.align_basis else None
        self.corrector = layers.residual_mlp(A * 10, config.correct_width, 1, 3 * rows) if config.corrections else None

    @property
    def K(self) -> int:
        return len(self.nodes)

    def field(
        self,
        points: Float[Floats, "P 3"],
        nodes: Float[Floats, "K 3"],
        radius: float | Float[Floats, " K"],
        kernel: Kernel,
    ) -> PointField:
        """The field on points of the template's frame that this network's rows parameterize.

        ``nodes`` are the template's, in full precision.
        """
        if isinstance(self.decoder, layers.PointDecoder):
            return self.pointwise_field(points)
        return fields.Field.of(shape_functions(self.config.field, points, nodes, radius, kernel))

    def pointwise_field(self, points: Float[Floats, "P 3"]) -> PointwiseField:
        """The field of a pointwise network."""
        assert isinstance(self.decoder, layers.PointDecoder)
        at = torch.from_numpy(np.array(points)).float()
        return PointwiseField(at, at, self.decoder.displacement, self.config.code)

    def rotate_rows(self, vectors: Float[Floats, "R 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "R 3"]:
        if isinstance(self.decoder, layers.PointDecoder):
            return fields.rotated_rows(vectors, turn)
        nodes = _array(self.nodes)  # as `NodeNetwork` does
        return (nodes + vectors) @ turn - nodes

    def align(
        self, features: Float[torch.Tensor, "B N 3"]
    ) -> tuple[Float[torch.Tensor, "B 3 3"], Float[torch.Tensor, "B 3"]]:
        """Predict rotation R and center t of the core: scan = R core + t."""
        assert self.aligner is not None
        out = self.aligner(features)
        return rotation_from_six(out[:, :6]), out[:, 6:]

    def correct(
        self, vectors: Float[torch.Tensor, "B R 3"], points: Float[torch.Tensor, "B P 3"]
    ) -> Float[torch.Tensor, "B R 3"]:
        """Apply one learned registration step to rows, given the scan's points; both in the core frame."""
        assert self.corrector is not None
        if isinstance(self.decoder, layers.PointDecoder):
            motion = self.decoder.displacement
            moved = PointwiseField(self.anchors, self.anchors, motion, self.config.code).displacement(vectors)
        else:
            assert self.anchor_phi is not None
            moved = fields.apply_shape_functions(self.anchor_phi, vectors)  # B A 3
        offsets = layers.two_way_offsets(self.anchors + moved, points)
        features = torch.cat([offsets[..., :6] * 10.0, offsets[..., 6:], moved * 3.0], -1)
        change = 0.1 * self.corrector(features.flatten(1)).unflatten(-1, (-1, 3))
        if isinstance(self.decoder, layers.PointDecoder):
            change = nn.functional.pad(change, (0, 0, 0, TURN_ROWS))  # corrections change the code only
        result: torch.Tensor = vectors + change
        return result

    def forward(self, points: torch.Tensor) -> Float[torch.Tensor, "B R 3"]:
        """Predict the rows of scans (B, P, 3) in the core frame, in the network's precision; node vectors if it has nodes.

        `InputError` if ``points`` are not a tensor of this shape, or not finite.
        """
        if not isinstance(points, torch.Tensor):
            raise InputError(f"points must be a tensor, not {type(points).__name__}", "torch.as_tensor makes one")
        if points.ndim != 3 or points.shape[2] != 3 or 0 in points.shape:
            raise InputError(
                f"points must be (B, P, 3), not {tuple(points.shape)}", "one cloud is a batch: points[None]"
            )
        if not points.isfinite().all():
            raise InputError("points must be finite, but hold nan or infinite values", "leave such points out")
        points = points.to(self.nodes.dtype)
        vectors = self.decoder(self.code_of(points))
        for _ in range(self.config.corrections):
            vectors = self.correct(vectors, points)
        result: torch.Tensor = vectors
        return result

    def code_of(self, points: Float[torch.Tensor, "B P 3"]) -> Float[torch.Tensor, "B D"]:
        """Encode scans in the core frame; `ModelError` if a custom encoder fails, or returns another shape."""
        with encoder_errors(self.config.encoder):
            code: torch.Tensor = self.encoder(self.encoder.features(points))
            if tuple(code.shape) != (wanted := (len(points), self.config.code)):
                raise ValueError(f"it gives {tuple(code.shape)} instead of {wanted}")
        return code

    # The interface `models.network.Network`, with arrays: for fits with networks that only torch can evaluate.

    @property
    def align_basis(self) -> Float[Floats32, "M 3"]:
        assert self.aligner is not None
        return self.aligner.basis.cpu().numpy()

    @torch.inference_mode()
    def predict(self, clouds: Sequence[Float[Floats, "P 3"]]) -> Float[Floats, "B R 3"]:
        return np.stack([_array(self(self._tensor(cloud)))[0] for cloud in clouds])

    @torch.inference_mode()
    def read_frames(self, offsets: Float[Floats32, "B M 3"]) -> tuple[Float[Floats, "B 3 3"], Float[Floats, "B 3"]]:
        R, t = self.align(torch.from_numpy(5 * offsets).to(self.nodes.device))
        return _array(R), _array(t)

    @torch.inference_mode()
    def encode(self, cloud: Float[Floats, "P 3"]) -> Float[Floats, " D"]:
        return np.asarray(_array(self.code_of(self._tensor(cloud)))[0])

    @torch.inference_mode()
    def decode(self, code: Float[Floats, " D"]) -> Float[Floats, "R 3"]:
        return np.asarray(_array(self.decoder(self._tensor(code)))[0])

    def _tensor(self, array: Floats) -> torch.Tensor:
        return torch.from_numpy(np.asarray(array, np.float32))[None].to(self.nodes.device)


def blank_deformer(config: NetworkConfig, K: int) -> Deformer:
    """A network for K nodes on the meta device: shapes of weights and buffers, without allocating what a card asks for."""
    with torch.device("meta"):
        nodes, anchors = torch.zeros(K, 3), torch.zeros(K, 3)
        phi = torch.zeros(K, K) if has_nodes(config.field) else None
        basis, align_basis = torch.zeros(config.basis, 3), torch.zeros(max(config.align_basis, 1), 3)
        return Deformer(config, nodes, anchors, phi, basis, align_basis)


def with_weights(config: NetworkConfig, K: int, weights: Mapping[str, np.ndarray]) -> Deformer:
    """Build a network for K nodes with given weights (`models.network.weight_shapes`), in evaluation mode."""
    network = blank_deformer(config, K)
    # copies, because training changes weights in place
    network.load_state_dict({name: torch.from_numpy(np.array(w)) for name, w in weights.items()}, assign=True)
    return network.eval()


def _array(tensor: torch.Tensor) -> Floats:
    """Convert to a float64 array, on the CPU because other devices may not support float64."""
    return tensor.cpu().double().numpy()
