"""What a network is made of; what fitting asks of it (`Network`, on whatever device), and NumPy's answers (`NodeNetwork`).

The layers are few, dense and small: their weights are read from memory once for a batch, so that twenty clouds cost about
as much as four. `models.deformer` is the same network for training; a test holds both to the same answers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import erf

from meshmatch.arrays import Float, Floats, Floats32
from meshmatch.errors import ModelError
from meshmatch.fields.shape_functions import FIELDS, FieldName

_EPSILON = np.float32(1e-5)  # of layer and batch norms, as in torch
_POINT_SIZES = (126, 128, 256, 512, 1024)  # of the layers of `models.layers.PointEncoder`
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


class Network(Protocol):
    """What fitting asks of a network; rows are node vectors, or a code where the field is pointwise."""

    @property
    def config(self) -> NetworkConfig: ...

    @property
    def align_basis(self) -> Float[Floats32, "M 3"]:
        """Basis points of the aligner."""

    def predict(self, clouds: Sequence[Float[Floats, "P 3"]]) -> Float[Floats, "B R 3"]:
        """Rows for several clouds, of any number of points each, in their core frames."""

    def read_frames(self, offsets: Float[Floats32, "B M 3"]) -> tuple[Float[Floats, "B 3 3"], Float[Floats, "B 3"]]:
        """Rotations R and centers t of the core, scan = R core + t, from offsets of basis points to nearest points."""

    def encode(self, cloud: Float[Floats, "P 3"]) -> Float[Floats, " D"]:
        """The code of a cloud in its core frame."""

    def decode(self, code: Float[Floats, " D"]) -> Float[Floats, "R 3"]:
        """The rows of a code, without corrections."""

    def rotate_rows(self, rows: Float[Floats, "R 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "R 3"]:
        """Rows of the deformation whose moved points (rows) are those of ``rows`` times ``turn``."""


class NodeNetwork:
    """A network whose answers are node vectors; weights have the names of `models.deformer.Deformer`."""

    def __init__(self, config: NetworkConfig, weights: Mapping[str, np.ndarray]) -> None:
        self.config, self.weights = config, weights

    @property
    def align_basis(self) -> Float[Floats32, "M 3"]:
        return self.weights["aligner.basis"]

    def predict(self, clouds: Sequence[Float[Floats, "P 3"]]) -> Float[Floats, "B K 3"]:
        points = [np.asarray(cloud, np.float32) for cloud in clouds]
        trees = [quick_tree(cloud) for cloud in points]
        vectors = self._decode(self._encode(points, trees))
        for _ in range(self.config.corrections):
            vectors = self._correct(vectors, points, trees)
        return vectors.astype(np.float64)

    def read_frames(self, offsets: Float[Floats32, "B M 3"]) -> tuple[Float[Floats, "B 3 3"], Float[Floats, "B 3"]]:
        out = self._residual_mlp("aligner.network", 5 * offsets.reshape(len(offsets), -1)).astype(np.float64)
        return rotation_from_six(out[:, :6]), out[:, 6:]

    def encode(self, cloud: Float[Floats, "P 3"]) -> Float[Floats, " D"]:
        points = np.asarray(cloud, np.float32)
        return self._encode([points], [quick_tree(points)])[0].astype(np.float64)

    def decode(self, code: Float[Floats, " D"]) -> Float[Floats, "K 3"]:
        return self._decode(code[None].astype(np.float32))[0].astype(np.float64)

    def rotate_rows(self, rows: Float[Floats, "K 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "K 3"]:
        nodes = self.weights["nodes"].astype(np.float64)
        # A node at q moves to Q^T (q + u), so its vector in the turned frame is that minus q.
        return (nodes + rows) @ turn - nodes

    def _encode(self, clouds: Sequence[Floats32], trees: Sequence[cKDTree]) -> Float[Floats32, "B D"]:
        if self.config.encoder == "point":
            return np.stack([self._encode_points(cloud) for cloud in clouds])
        basis = self.weights["encoder.basis"]
        seen = [5 * _offsets(basis, cloud, tree) for cloud, tree in zip(clouds, trees, strict=True)]
        return self._residual_mlp("encoder.network", np.stack(seen).reshape(len(clouds), -1))

    def _encode_points(self, cloud: Float[Floats32, "P 3"]) -> Float[Floats32, " D"]:
        frequencies = self.weights["encoder.frequencies"]
        angle = np.float32(2 * np.pi) * cloud[:, None, :] * frequencies[:, None]
        x = np.concatenate([np.sin(angle), np.cos(angle)], -1).reshape(len(cloud), -1)
        x /= np.float32(np.sqrt(3 * len(frequencies)))
        for layer in range(0, 3 * len(_POINT_SIZES) - 3, 3):
            x = np.maximum(x, 0) if layer else x
            x = self._batch_norm(f"encoder.points.{layer + 1}", self._linear(f"encoder.points.{layer}", x))
        return self._linear("encoder.head.3", np.maximum(self._linear("encoder.head.0", x.max(0)), 0))

    def _decode(self, codes: Float[Floats32, "B D"]) -> Float[Floats32, "B K 3"]:
        if self.config.decoder == "flat":
            return self._residual_mlp("decoder.network", codes).reshape(len(codes), -1, 3)
        nodes = self.weights["decoder.nodes"]
        x = self._linear("decoder.from_code", codes)[:, None] + self._linear("decoder.from_node", nodes)
        x = np.maximum(self._batch_norm("decoder.network.0", x), 0)
        for layer in (2, 5):
            x = self._linear(f"decoder.network.{layer}", x)
            x = np.maximum(self._batch_norm(f"decoder.network.{layer + 1}", x), 0)
        return 2 * np.tanh(self._linear("decoder.network.8", x))

    def _correct(
        self, vectors: Float[Floats32, "B K 3"], clouds: Sequence[Floats32], trees: Sequence[cKDTree]
    ) -> Float[Floats32, "B K 3"]:
        """One learned registration step."""
        anchors, phi = self.weights["anchors"], self.weights["anchor_phi"]
        B, K, _ = vectors.shape
        moved = (phi @ vectors.transpose(1, 0, 2).reshape(K, -1)).reshape(len(phi), B, 3).transpose(1, 0, 2)
        triples = zip(anchors + moved, clouds, trees, strict=True)
        seen = np.stack([_two_way_offsets(placed, cloud, tree) for placed, cloud, tree in triples])
        features = np.concatenate([10 * seen[..., :6], seen[..., 6:], 3 * moved], -1)
        change = self._residual_mlp("corrector", features.reshape(B, -1))
        return vectors + np.float32(0.1) * change.reshape(B, -1, 3)

    def _linear(self, name: str, x: Floats32) -> Floats32:
        matrix = self.weights[f"{name}.weight"]
        out = x @ matrix.reshape(matrix.shape[:2]).T
        bias = self.weights.get(f"{name}.bias")
        return out if bias is None else out + bias

    def _layer_norm(self, name: str, x: Floats32) -> Floats32:
        offset = x - x.mean(-1, keepdims=True)
        scale = 1 / np.sqrt(np.square(offset).mean(-1, keepdims=True) + _EPSILON)
        return offset * scale * self.weights[f"{name}.weight"] + self.weights[f"{name}.bias"]

    def _batch_norm(self, name: str, x: Floats32) -> Floats32:
        mean, variance = self.weights[f"{name}.running_mean"], self.weights[f"{name}.running_var"]
        scale = self.weights[f"{name}.weight"] / np.sqrt(variance + _EPSILON)
        return (x - mean) * scale + self.weights[f"{name}.bias"]

    def _residual_mlp(self, name: str, x: Float[Floats32, "B I"]) -> Float[Floats32, "B O"]:
        """`models.layers.residual_mlp`."""
        numbers = (key[len(name) + 1 :].split(".")[0] for key in self.weights if key.startswith(f"{name}."))
        last = max(map(int, numbers))
        x = self._linear(f"{name}.0", x)
        for block in range(1, last - 2):
            hidden = self._linear(f"{name}.{block}.widen", self._layer_norm(f"{name}.{block}.norm", x))
            x = x + self._linear(f"{name}.{block}.narrow", _gelu(hidden))
        return self._linear(f"{name}.{last}", _gelu(self._layer_norm(f"{name}.{last - 2}", x)))


def weight_shapes(config: NetworkConfig, K: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the weights and buffers of a network with K nodes, by name; not for pointwise fields."""
    found: dict[str, tuple[int, ...]] = {"nodes": (K, 3), "anchors": (K, 3), "anchor_phi": (K, K)}

    def linear(name: str, inputs: int, outputs: int, *rest: int) -> None:
        found.update({f"{name}.weight": (outputs, inputs, *rest), f"{name}.bias": (outputs,)})

    def norm(name: str, width: int) -> None:
        found.update({f"{name}.weight": (width,), f"{name}.bias": (width,)})

    def batch_norm(name: str, width: int) -> None:
        norm(name, width)
        found.update({f"{name}.running_mean": (width,), f"{name}.running_var": (width,)})
        found[f"{name}.num_batches_tracked"] = ()

    def residual_mlp(name: str, inputs: int, width: int, depth: int, outputs: int) -> None:
        linear(f"{name}.0", inputs, width)
        for block in range(1, depth + 1):
            norm(f"{name}.{block}.norm", width)
            linear(f"{name}.{block}.widen", width, width)
            linear(f"{name}.{block}.narrow", width, width)
        norm(f"{name}.{depth + 1}", width)
        linear(f"{name}.{depth + 3}", width, outputs)

    code, width = config.code, config.width
    if config.encoder == "basis":
        found["encoder.basis"] = (config.basis, 3)
        residual_mlp("encoder.network", 3 * config.basis, width, config.depth, code)
    else:
        found["encoder.frequencies"] = (21,)
        for number, (inputs, outputs) in enumerate(pairwise(_POINT_SIZES)):
            linear(f"encoder.points.{3 * number}", inputs, outputs, 1)
            batch_norm(f"encoder.points.{3 * number + 1}", outputs)
        linear("encoder.head.0", 1024, 1024)
        linear("encoder.head.3", 1024, code)
    if config.decoder == "flat":
        residual_mlp("decoder.network", code, width, 1, 3 * K)
    else:
        found["decoder.nodes"] = (K, 3)
        linear("decoder.from_code", code, width)
        found["decoder.from_node.weight"] = (width, 3)
        batch_norm("decoder.network.0", width)
        for layer, inputs in ((2, width), (5, width // 2)):
            linear(f"decoder.network.{layer}", inputs, inputs // 2)
            batch_norm(f"decoder.network.{layer + 1}", inputs // 2)
        linear("decoder.network.8", width // 4, 3)
    if config.align_basis:
        found["aligner.basis"] = (config.align_basis, 3)
        residual_mlp("aligner.network", 3 * config.align_basis, config.align_width, 2, 9)
    if config.corrections:
        residual_mlp("corrector", 10 * K, config.correct_width, 1, 3 * K)
    return found


def rotation_from_six(six: Float[Floats, "B 6"]) -> Float[Floats, "B 3 3"]:
    """Rotations by Gram-Schmidt on two predicted columns (Zhou et al., CVPR 2019)."""
    a, b = six[:, :3], six[:, 3:]
    a = a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-12)
    b = b - (a * b).sum(-1, keepdims=True) * a
    b = b / np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 1e-12)
    return np.stack([a, b, np.cross(a, b)], -1)


def quick_tree(points: Float[Floats32, "P D"]) -> cKDTree:
    """A tree that is asked a few times only: built quickly rather than balanced."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _gelu(x: Floats32) -> Floats32:
    return np.float32(0.5) * x * (1 + erf(x * np.float32(np.sqrt(0.5))))


def _offsets(queries: Float[Floats32, "Q 3"], points: Floats32, tree: cKDTree) -> Float[Floats32, "Q 3"]:
    """From each query to the nearest of the points, which the tree holds."""
    return points[tree.query(queries)[1]] - queries


def _two_way_offsets(anchors: Float[Floats32, "A 3"], points: Floats32, tree: cKDTree) -> Floats32:
    """What a registration sees at its anchors (A, 7); see `models.layers.two_way_offsets`."""
    A = len(anchors)
    forward = _offsets(anchors, points, tree)
    owner = quick_tree(anchors).query(points)[1]
    back = points - anchors[owner]
    count = np.bincount(owner, minlength=A).astype(np.float32)[:, None]
    total = np.stack([np.bincount(owner, back[:, k], A) for k in range(3)], 1).astype(np.float32)
    share = np.log1p(count * np.float32(A / len(points)))
    return np.concatenate([forward, total / np.maximum(count, 1), share], 1)
