"""Building blocks of the networks in torch: nearest neighbours, residual blocks, encoders and decoders.

Encoders map a point set to a shape code, independent of the order and the number of the points. Decoders map a code to
the rows that parameterize a field: one displacement vector per node, or the code itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch
import torch.distributed as dist
from torch import nn
from torch.distributed.nn.functional import all_reduce as over_processes

from meshmatch.arrays import Float, Int
from meshmatch.errors import InputError
from meshmatch.fields.field import pack
from meshmatch.geometry.oriented import quick_tree

_MAX_PAIRS = 1 << 29  # compared at once: 2 GiB of distances
_FREQUENCY = 1.5  # standard deviation of the encoding's frequencies, in waves per sqrt(area); set by hand


def nearest_index(
    queries: Float[torch.Tensor, "B Q D"], points: Float[torch.Tensor, "B P D"]
) -> Int[torch.Tensor, "B Q"]:
    """Index of the point nearest to each query; `InputError` on a CPU if they are not finite.

    Uses search trees on a CPU, where comparing all pairs is far slower.
    """
    if queries.device.type != "cpu":
        return nearest_of_all(queries, points)
    pairs = zip(queries.detach().numpy(), points.detach().numpy(), strict=True)
    try:
        found = [quick_tree(cloud).query(query)[1] for query, cloud in pairs]
    except ValueError as error:
        raise InputError(f"no point is nearest: {error}", "are points and weights finite?") from error
    return torch.from_numpy(np.stack(found))


def nearest_of_all(
    queries: Float[torch.Tensor, "B Q D"], points: Float[torch.Tensor, "B P D"]
) -> Int[torch.Tensor, "B Q"]:
    """`nearest_index` by comparing all pairs, in chunks of clouds.

    Squared differences are summed by coordinate, because settings may reduce the precision of matrix products.
    """
    queries, points = queries.float(), points.float()
    chunk = max(1, _MAX_PAIRS // max(1, queries.shape[1] * points.shape[1]))
    found = []
    for some, cloud in zip(queries.split(chunk), points.split(chunk), strict=True):
        squared = (some[:, :, None, 0] - cloud[:, None, :, 0]).square()
        for k in range(1, some.shape[2]):
            squared = squared + (some[:, :, None, k] - cloud[:, None, :, k]).square()
        found.append(squared.argmin(-1))
    return torch.cat(found)


def nearest(
    queries: Float[torch.Tensor, "B Q 3"], points: Float[torch.Tensor, "B P 3"]
) -> tuple[Int[torch.Tensor, "B Q"], Float[torch.Tensor, "B Q 3"]]:
    """Index of the point nearest to each query, and its offset from the query, in the unit of the input."""
    index = nearest_index(queries, points)
    return index, torch.gather(points, 1, index[..., None].expand(-1, -1, 3)) - queries


def two_way_offsets(
    anchors: Float[torch.Tensor, "B A 3"], points: Float[torch.Tensor, "B P 3"]
) -> Float[torch.Tensor, "B A 7"]:
    """Features of a correction step, at the anchors.

    Columns 0..2: offset to the nearest point; 3..5: mean offset to the points whose nearest anchor this is
    (0 if there are none); 6: log(1 + their share times A).
    """
    B, A, _ = anchors.shape
    forward = nearest(anchors, points)[1]
    owner, back = nearest(points, anchors)
    total = anchors.new_zeros(B, A, 4)
    total.scatter_add_(1, owner[..., None].expand(-1, -1, 4), torch.cat([-back, torch.ones_like(back[..., :1])], -1))
    count = total[..., 3:]
    return torch.cat([forward, total[..., :3] / count.clamp_min(1), torch.log1p(count * (A / points.shape[1]))], -1)


class ResidualBlock(nn.Module):
    """x + W2 gelu(W1 norm(x)), a pre-norm residual layer of constant width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.widen = nn.Linear(width, width)
        self.narrow = nn.Linear(width, width)
        nn.init.zeros_(self.narrow.weight)
        nn.init.zeros_(self.narrow.bias)

    def forward(self, x: Float[torch.Tensor, "*B W"]) -> Float[torch.Tensor, "*B W"]:
        result: torch.Tensor = x + self.narrow(nn.functional.gelu(self.widen(self.norm(x))))
        return result


class BatchNorm(nn.BatchNorm1d):
    """Batch norm over the batches of all training processes; `torch.nn.SyncBatchNorm` works on GPUs only."""

    def forward(self, x: Float[torch.Tensor, "N C"]) -> Float[torch.Tensor, "N C"]:
        if not (self.training and dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1):
            result: torch.Tensor = super().forward(x)
            return result
        assert self.running_mean is not None and self.running_var is not None and self.num_batches_tracked is not None
        assert self.momentum is not None
        rows = x.float()
        *sums, count = over_processes(torch.cat([rows.sum(0), rows.new_full((1,), len(rows))])).split(
            [rows.shape[1], 1]
        )
        centred = rows - sums[0] / count
        variance = over_processes(centred.square().sum(0)) / count
        with torch.no_grad():
            self.num_batches_tracked += 1
            self.running_mean.lerp_(sums[0] / count, self.momentum)
            self.running_var.lerp_(variance * (count / (count - 1)), self.momentum)
        normal = centred * (variance + self.eps).rsqrt() * self.weight + self.bias
        result = normal.to(x.dtype)
        return result


def residual_mlp(inputs: int, width: int, depth: int, outputs: int) -> nn.Sequential:
    """inputs -> width, ``depth`` residual blocks, -> outputs."""
    blocks = [ResidualBlock(width) for _ in range(depth)]
    last = nn.Linear(width, outputs)
    _start_near_zero(last)
    return nn.Sequential(nn.Linear(inputs, width), *blocks, nn.LayerNorm(width), nn.GELU(), last)


def _start_near_zero(last: nn.Module) -> None:
    """Initialise an output layer such that an untrained deformer hardly moves its template."""
    assert isinstance(last, nn.Linear)
    nn.init.normal_(last.weight, std=2e-3)
    nn.init.zeros_(last.bias)


def _shared_mlp(width: int, norm: Callable[[int], nn.Module]) -> nn.Sequential:
    """An MLP shared over points, without its first layer: norm, two layers that halve the width, three outputs."""
    layers: list[nn.Module] = [norm(width), nn.ReLU()]
    for a, b in ((width, width // 2), (width // 2, width // 4)):
        layers += [nn.Linear(a, b), norm(b), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(width // 4, 3))


class Encoder(nn.Module):
    """Base class of encoders.

    Custom encoders are constructed with basis points (M, 3), spread over the region of the category's shapes, and the
    length D of a code. `features` runs while batches are drawn, in other processes or on a GPU, without gradients;
    `forward` is trained.
    """

    def features(self, points: Float[torch.Tensor, "B P 3"]) -> Float[torch.Tensor, "B ..."]:
        """Compute the input of `forward` from point sets in the core frame."""
        raise NotImplementedError

    def forward(self, features: Float[torch.Tensor, "B ..."]) -> Float[torch.Tensor, "B D"]:
        """Compute codes from features."""
        raise NotImplementedError


class BasisEncoder(Encoder):
    """Offsets from a fixed set of basis points to the nearest input point, then an MLP.

    After *Efficient Learning on Point Clouds with Basis Point Sets* (ICCV 2019). The features cost one tree
    query per basis point, about a thousandth of a point MLP of the same quality.
    """

    def __init__(self, basis: Float[torch.Tensor, "M 3"], width: int, depth: int, outputs: int) -> None:
        super().__init__()
        self.basis: torch.Tensor
        self.register_buffer("basis", basis)
        self.network = residual_mlp(3 * len(basis), width, depth, outputs)

    def features(self, points: Float[torch.Tensor, "B P 3"]) -> Float[torch.Tensor, "B M 3"]:
        """Offsets from the basis points, scaled to a standard deviation of about one."""
        offsets = nearest(self.basis.expand(len(points), -1, -1), points)[1]
        return offsets * 5.0

    def forward(self, features: Float[torch.Tensor, "B ..."]) -> Float[torch.Tensor, "B D"]:
        result: torch.Tensor = self.network(features.flatten(1))
        return result


class PointEncoder(Encoder):
    """The paper's encoder: positional encoding on a hypersphere, shared MLP, max-pool, two linear layers.

    The encoding has Gaussian frequencies (Tancik et al., *Fourier Features Let Networks Learn High Frequency Functions in
    Low Dimensional Domains*, NeurIPS 2020), by default 64 of them, which give 128 numbers.
    """

    def __init__(self, outputs: int, latent: int = 1024, frequencies: int = 64, dropout: float = 0.3) -> None:
        super().__init__()
        self.frequencies: torch.Tensor
        self.register_buffer("frequencies", _FREQUENCY * torch.randn(frequencies, 3))
        sizes = [2 * frequencies, latent // 8, latent // 4, latent // 2, latent]
        layers: list[nn.Module] = []
        for i, (a, b) in enumerate(pairwise(sizes)):
            layers += [nn.Linear(a, b), BatchNorm(b)]
            layers += [nn.ReLU()] if i < len(sizes) - 2 else []
        self.points = nn.Sequential(*layers)
        self.head = nn.Sequential(nn.Linear(latent, latent), nn.ReLU(), nn.Dropout(dropout), nn.Linear(latent, outputs))

    def features(self, points: Float[torch.Tensor, "B P 3"]) -> Float[torch.Tensor, "B P E"]:
        """Encodings of unit length."""
        angle = 2 * math.pi * points @ self.frequencies.T
        return torch.cat([angle.sin(), angle.cos()], -1) / math.sqrt(len(self.frequencies))

    def forward(self, features: Float[torch.Tensor, "B ..."]) -> Float[torch.Tensor, "B D"]:
        found = self.points(features.flatten(0, 1)).unflatten(0, features.shape[:2])
        result: torch.Tensor = self.head(found.amax(1))
        return result


class FlatDecoder(nn.Module):
    """A residual MLP from the code to all node vectors."""

    def __init__(self, code: int, width: int, depth: int, K: int) -> None:
        super().__init__()
        self.network = residual_mlp(code, width, depth, 3 * K)

    def forward(self, code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B K 3"]:
        """Node vectors of codes."""
        result: torch.Tensor = self.network(code).unflatten(-1, (-1, 3))
        return result


class NodeDecoder(nn.Module):
    """The paper's decoder: [q_i, code] -> MLP shared over nodes, 2 tanh at the end.

    The code's part of the first layer is computed once per shape and broadcast over the nodes, which gives the same
    result at a fraction of the cost.
    """

    def __init__(self, code: int, nodes: Float[torch.Tensor, "K 3"], width: int = 1024) -> None:
        super().__init__()
        self.nodes: torch.Tensor
        self.register_buffer("nodes", nodes)
        self.from_code = nn.Linear(code, width)
        self.from_node = nn.Linear(3, width, bias=False)
        self.network = _shared_mlp(width, BatchNorm)

    def forward(self, code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B K 3"]:
        """Node vectors of codes."""
        hidden = self.from_code(code)[:, None] + self.from_node(self.nodes)  # B K width
        result: torch.Tensor = 2 * torch.tanh(self.network(hidden.flatten(0, 1))).unflatten(0, hidden.shape[:2])
        return result


class PointDecoder(nn.Module):
    """The decoder of *3D-CODED* (ECCV 2018): [x, code] -> MLP shared over all points, 2 tanh at the end.

    Layer norms replace the batch norms of the original, with which a point's displacement would depend on all other
    points, and its derivative would not be a deformation gradient. `forward` returns the code, as rows for a
    `PointwiseField` with `displacement` as its motion.
    """

    def __init__(self, code: int, width: int = 1024) -> None:
        super().__init__()
        self.from_code = nn.Linear(code, width)
        self.from_point = nn.Linear(3, width, bias=False)
        self.network = _shared_mlp(width, nn.LayerNorm)
        _start_near_zero(self.network[-1])

    def forward(self, code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B R 3"]:
        return pack(code)

    def displacement(
        self, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]
    ) -> Float[torch.Tensor, "B P 3"]:
        return 2 * torch.tanh(self.network(self.from_code(code)[:, None] + self.from_point(points)))
