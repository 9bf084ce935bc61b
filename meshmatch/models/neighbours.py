"""Nearest-neighbour features: offsets between point sets, on a tree (CPU) or by brute force (GPU)."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Int


def nearest_index(
    queries: Float[torch.Tensor, "B Q D"], points: Float[torch.Tensor, "B P D"]
) -> Int[torch.Tensor, "B Q"]:
    """Index of the nearest of ``points``: trees on a CPU, where comparing all pairs is far slower."""
    if queries.is_cuda:
        return torch.cdist(queries, points).argmin(-1)
    found = [
        cKDTree(cloud, balanced_tree=False, compact_nodes=False).query(query)[1]
        for query, cloud in zip(queries.detach().numpy(), points.detach().numpy(), strict=True)
    ]
    return torch.from_numpy(np.stack(found))


def nearest(
    queries: Float[torch.Tensor, "B Q 3"], points: Float[torch.Tensor, "B P 3"]
) -> tuple[Int[torch.Tensor, "B Q"], Float[torch.Tensor, "B Q 3"]]:
    """Index of the nearest of ``points``, and its offset from the query, in the unit of the input."""
    index = nearest_index(queries, points)
    return index, torch.gather(points, 1, index[..., None].expand(-1, -1, 3)) - queries


def two_way_offsets(
    anchors: Float[torch.Tensor, "B A 3"], points: Float[torch.Tensor, "B P 3"]
) -> Float[torch.Tensor, "B A 7"]:
    """What a registration sees at its anchors.

    Columns 0..2: offset to the nearest point; 3..5: mean offset of the points whose nearest anchor this is
    (0 if there is none); 6: log(1 + their share times A).
    """
    B, A, _ = anchors.shape
    forward = nearest(anchors, points)[1]
    owner, back = nearest(points, anchors)
    total = torch.zeros(B, A, 4).to(anchors)
    total.scatter_add_(1, owner[..., None].expand(-1, -1, 4), torch.cat([-back, torch.ones_like(back[..., :1])], -1))
    count = total[..., 3:]
    return torch.cat([forward, total[..., :3] / count.clamp_min(1), torch.log1p(count * (A / points.shape[1]))], -1)
