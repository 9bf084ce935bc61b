"""Load and evaluate networks: in NumPy for matching (`NodeNetwork`), or in torch for pointwise fields and on a GPU.

The layers are few, dense and small: their weights are read from memory once per batch, so that twenty clouds cost about
as much as four. Fits of many shapes have few clouds each, and evaluate them in common batches (`meshmatch.batching`);
results are bitwise those of separate calls. `models.deformer` is the same network in torch; a test compares the two.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import erf

from meshmatch.arrays import Float, Floats, Floats32
from meshmatch.batching import batched_call
from meshmatch.errors import OptionError, needs
from meshmatch.geometry.oriented import nearest_by_brute_force, quick_tree
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.checkpoint import load_weights
from meshmatch.models.network import POINT_SIZES, Network, NetworkConfig, weight_shapes
from meshmatch.threads import parallel_map

if TYPE_CHECKING:
    import torch

    from meshmatch.models.deformer import Deformer

_EPSILON = np.float32(1e-5)  # of layer and batch norms, as in torch
_SINGLE_ROWS, _FEW_ROWS = 3, 32  # up to these numbers, rows are multiplied one by one, or as columns
# Requests are multiplied together only by matrices of at least this size. Smaller ones stay in the cache anyway, and BLAS
# may sum their products in another order if there are more rows.
_MIN_WEIGHTS = 2**18

Clouds = Sequence[Float[Floats, "P 3"]]


def load_network(path: str | Path, config: NetworkConfig, K: int) -> Network:
    """Load a network for K nodes, in evaluation mode; one that is pointwise or has a custom encoder needs torch.

    `ModelError` if the file is damaged, or contains the weights of another network.
    """
    if not config.in_torch:
        return NodeNetwork(config, load_weights(path, weight_shapes(config, K)))
    with needs("torch", "train"):
        from meshmatch.models.deformer import blank_deformer, with_weights

    expected = {key: tuple(value.shape) for key, value in blank_deformer(config, K).state_dict().items()}
    return with_weights(config, K, load_weights(path, expected))


def in_torch(network: Network, K: int, device: str = "cpu") -> Deformer:
    """Convert a network for K nodes to torch, on a device such as "cuda"; `OptionError` if the device is not available."""
    with needs("torch", "train"):
        import torch

        from meshmatch.models.deformer import Deformer, with_weights

    if isinstance(network, NodeNetwork):
        found = with_weights(network.config, K, network.weights)
    else:  # in torch already; moved to a device as a copy, because others may use it on the CPU
        assert isinstance(network, Deformer)
        found = network if device == "cpu" else copy.deepcopy(network)
    try:
        return found.to(torch.device(device))
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        why = str(error).splitlines()[0][:80]  # torch may list all devices that it knows
        problem = f"device {device!r} cannot be used{'' if why.startswith('Expected one of') else f': {why}'}"
        raise OptionError(problem, "use cpu; cuda needs a GPU and a torch that was built for it") from error


def training_device(rank: int = 0, wanted: str = "auto") -> torch.device:
    """Device for training: the GPU with the number of this rank, or the CPU if there is no GPU.

    ``wanted`` selects "cpu", "cuda" or "mps" instead; `OptionError` if that is not available.
    """
    import torch

    available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if wanted == "auto":
        wanted = "cuda" if available["cuda"] else "cpu"
    if not available.get(wanted, False):
        names = ", ".join(name for name in available if available[name])
        raise OptionError(f"there is no device {wanted!r} to train on", f"this machine and its torch have: {names}")
    return torch.device("cuda", rank) if wanted == "cuda" else torch.device(wanted)


class NodeNetwork:
    """A network that predicts node vectors, in NumPy; weights have the names of `models.deformer.Deformer`."""

    def __init__(self, config: NetworkConfig, weights: Mapping[str, np.ndarray]) -> None:
        self.config, self.weights = config, weights

    @property
    def align_basis(self) -> Float[Floats32, "M 3"]:
        return self.weights["aligner.basis"]

    def predict(self, clouds: Sequence[Float[Floats, "P 3"]]) -> Float[Floats, "B K 3"]:
        return batched_call(self.predict_each, clouds)

    def predict_each(self, requests: Sequence[Clouds]) -> list[Float[Floats, "B K 3"]]:
        """Evaluate `predict` for several requests in one batch.

        Results are those of separate calls: bitwise if a column of a matrix product does not depend on the number of
        columns, as with OpenBLAS; otherwise up to float32 rounding.
        """
        sizes = [len(clouds) for clouds in requests]
        points = [np.asarray(cloud, np.float32) for clouds in requests for cloud in clouds]
        vectors = self._decode(self._encode(points, sizes), sizes)
        trees = parallel_map(quick_tree, points) if self.config.corrections else []
        for _ in range(self.config.corrections):
            vectors = self._correct(vectors, points, trees, sizes)
        return np.split(vectors.astype(np.float64), np.cumsum(sizes)[:-1])

    def read_frames(self, offsets: Float[Floats32, "B M 3"]) -> tuple[Float[Floats, "B 3 3"], Float[Floats, "B 3"]]:
        flat = 5 * offsets.reshape(len(offsets), -1)
        out = self._residual_mlp("aligner.network", flat, [len(flat)]).astype(np.float64)
        return rotation_from_six(out[:, :6]), out[:, 6:]

    def encode(self, cloud: Float[Floats, "P 3"]) -> Float[Floats, " D"]:
        points = np.asarray(cloud, np.float32)
        return np.asarray(self._encode([points], [1])[0].astype(np.float64))

    def decode(self, code: Float[Floats, " D"]) -> Float[Floats, "K 3"]:
        return np.asarray(self._decode(code[None].astype(np.float32), [1])[0].astype(np.float64))

    def rotate_rows(self, rows: Float[Floats, "K 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "K 3"]:
        nodes = self.weights["nodes"].astype(np.float64)
        # A node at q moves to Q^T (q + u), so its vector in the rotated frame is that minus q.
        return (nodes + rows) @ turn - nodes

    def _encode(self, clouds: Sequence[Floats32], sizes: Sequence[int]) -> Float[Floats32, "B D"]:
        if self.config.encoder == "point":
            return np.stack([self._encode_points(cloud) for cloud in clouds])
        basis = self.weights["encoder.basis"]
        offsets = parallel_map(lambda cloud: 5 * (cloud[nearest_by_brute_force(cloud, basis)] - basis), clouds)
        return self._residual_mlp("encoder.network", np.stack(offsets).reshape(len(clouds), -1), sizes)

    def _encode_points(self, cloud: Float[Floats32, "P 3"]) -> Float[Floats32, " D"]:
        frequencies = self.weights["encoder.frequencies"]
        angle = np.float32(2 * np.pi) * cloud @ frequencies.T
        x = np.concatenate([np.sin(angle), np.cos(angle)], -1)
        x /= np.float32(np.sqrt(len(frequencies)))
        for layer in range(0, 3 * len(POINT_SIZES) - 3, 3):
            x = np.maximum(x, 0) if layer else x
            x = self._batch_norm(f"encoder.points.{layer + 1}", self._linear(f"encoder.points.{layer}", x))
        return self._linear("encoder.head.3", np.maximum(self._linear("encoder.head.0", x.max(0)), 0))

    def _decode(self, codes: Float[Floats32, "B D"], sizes: Sequence[int]) -> Float[Floats32, "B K 3"]:
        if self.config.decoder == "flat":
            return self._residual_mlp("decoder.network", codes, sizes).reshape(len(codes), -1, 3)
        nodes = self.weights["decoder.nodes"]
        x = self._linear("decoder.from_code", codes, sizes)[:, None] + self._linear("decoder.from_node", nodes)
        x = np.maximum(self._batch_norm("decoder.network.0", x), 0)
        for layer in (2, 5):
            x = self._linear(f"decoder.network.{layer}", x)
            x = np.maximum(self._batch_norm(f"decoder.network.{layer + 1}", x), 0)
        return 2 * np.tanh(self._linear("decoder.network.8", x))

    def _correct(
        self,
        vectors: Float[Floats32, "B K 3"],
        clouds: Sequence[Floats32],
        trees: Sequence[cKDTree],
        sizes: Sequence[int],
    ) -> Float[Floats32, "B K 3"]:
        """One learned registration step."""
        anchors, B = self.weights["anchors"], len(vectors)
        moved = np.concatenate([self._moved_anchors(each) for each in np.split(vectors, np.cumsum(sizes)[:-1])])
        offsets = np.stack(parallel_map(_two_way_offsets, anchors + moved, clouds, trees))
        features = np.concatenate([10 * offsets[..., :6], offsets[..., 6:], 3 * moved], -1)
        change = self._residual_mlp("corrector", features.reshape(B, -1), sizes)
        return vectors + np.float32(0.1) * change.reshape(B, -1, 3)

    def _moved_anchors(self, vectors: Float[Floats32, "B K 3"]) -> Float[Floats32, "B A 3"]:
        """Displacements of the anchors by node vectors."""
        phi, (B, K, _) = self.weights["anchor_phi"], vectors.shape
        moved = phi @ vectors.transpose(1, 0, 2).reshape(K, -1)
        return np.asarray(moved.reshape(len(phi), B, 3).transpose(1, 0, 2))

    def _linear(self, name: str, x: Floats32, sizes: Sequence[int] | None = None) -> Floats32:
        """Apply a linear layer to rows ``x``; ``sizes`` are the numbers of rows of each request."""
        weight = self.weights[f"{name}.weight"]
        out = _product(x, weight) if sizes is None else _products(x, weight, sizes)
        bias = self.weights.get(f"{name}.bias")
        return np.asarray(out if bias is None else out + bias)

    def _layer_norm(self, name: str, x: Floats32) -> Floats32:
        offset = x - x.mean(-1, keepdims=True)
        scale = 1 / np.sqrt(np.square(offset).mean(-1, keepdims=True) + _EPSILON)
        return np.asarray(offset * scale * self.weights[f"{name}.weight"] + self.weights[f"{name}.bias"])

    def _batch_norm(self, name: str, x: Floats32) -> Floats32:
        mean, variance = self.weights[f"{name}.running_mean"], self.weights[f"{name}.running_var"]
        scale = self.weights[f"{name}.weight"] / np.sqrt(variance + _EPSILON)
        return np.asarray((x - mean) * scale + self.weights[f"{name}.bias"])

    def _residual_mlp(self, name: str, x: Float[Floats32, "B I"], sizes: Sequence[int]) -> Float[Floats32, "B O"]:
        """`models.layers.residual_mlp`."""
        numbers = (key[len(name) + 1 :].split(".")[0] for key in self.weights if key.startswith(f"{name}."))
        last = max(map(int, numbers))
        x = self._linear(f"{name}.0", x, sizes)
        for block in range(1, last - 2):
            hidden = self._linear(f"{name}.{block}.widen", self._layer_norm(f"{name}.{block}.norm", x), sizes)
            x = x + self._linear(f"{name}.{block}.narrow", _gelu(hidden), sizes)
        return self._linear(f"{name}.{last}", _gelu(self._layer_norm(f"{name}.{last - 2}", x)), sizes)


def rotation_from_six(six: Float[Floats, "B 6"]) -> Float[Floats, "B 3 3"]:
    """Rotations by Gram-Schmidt on two predicted columns (Zhou et al., CVPR 2019)."""
    a, b = six[:, :3], six[:, 3:]
    a = a / np.maximum(np.linalg.norm(a, axis=-1, keepdims=True), 1e-12)
    b = b - (a * b).sum(-1, keepdims=True) * a
    b = b / np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 1e-12)
    return np.stack([a, b, np.cross(a, b)], -1)


def _product(x: Floats32, weight: Float[Floats32, "O I"]) -> Floats32:
    """``x @ weight.T``, in other forms for few rows, where BLAS takes longer to copy the matrix than to multiply."""
    if x.ndim != 2 or len(x) > _FEW_ROWS:
        return np.asarray(x @ weight.T)
    if len(x) <= _SINGLE_ROWS:
        return np.stack([weight @ row for row in x])
    return np.ascontiguousarray((weight @ x.T).T)


def _products(x: Floats32, weight: Float[Floats32, "O I"], sizes: Sequence[int]) -> Floats32:
    """`_product` for each request, whose rows are concatenated; in one product where the result is bitwise the same."""
    if len(sizes) == 1:
        return _product(x, weight)
    rows = np.repeat(sizes, sizes)
    together = (rows > _SINGLE_ROWS) & (rows <= _FEW_ROWS) & (weight.size >= _MIN_WEIGHTS)
    out = np.empty((len(x), len(weight)), np.float32)
    if together.any():
        out[together] = (weight @ x[together].T).T
    for end, size in zip(np.cumsum(sizes), sizes, strict=True):
        if not together[end - 1]:
            out[end - size : end] = _product(x[end - size : end], weight)
    return out


def _gelu(x: Floats32) -> Floats32:
    return np.asarray(np.float32(0.5) * x * (1 + erf(x * np.float32(np.sqrt(0.5)))))


def _two_way_offsets(anchors: Float[Floats32, "A 3"], points: Floats32, tree: cKDTree) -> Floats32:
    """(A, 7) features of a correction; see `models.layers.two_way_offsets`."""
    A = len(anchors)
    forward = points[tree.query(anchors)[1]] - anchors
    owner = nearest_by_brute_force(anchors, points)
    back = points - anchors[owner]
    count = np.bincount(owner, minlength=A).astype(np.float32)[:, None]
    total = np.stack([np.bincount(owner, back[:, k], A) for k in range(3)], 1).astype(np.float32)
    share = np.log1p(count * np.float32(A / len(points)))
    return np.concatenate([forward, total / np.maximum(count, 1), share], 1)
