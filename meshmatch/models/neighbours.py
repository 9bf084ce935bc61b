"""Nearest-neighbour features: offsets between point sets, on a tree (CPU) or by brute force (GPU)."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree


def nearest(queries: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Nearest of ``points`` (B, P, 3) to each of ``queries`` (B, Q, 3).

    Returns
    -------
    index : int64 tensor (B, Q)
    offset : tensor (B, Q, 3)
        Nearest point minus query, in the unit of the input.
    """
    if queries.is_cuda:
        index = every_pair(queries, points)
    else:
        found = [
            cKDTree(cloud, balanced_tree=False, compact_nodes=False).query(query)[1]
            for query, cloud in zip(queries.detach().numpy(), points.detach().numpy(), strict=True)
        ]
        index = torch.from_numpy(np.stack(found))
    return index, torch.gather(points, 1, index[..., None].expand(-1, -1, 3)) - queries


def every_pair(queries: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Index (B, Q) of the nearest point by comparing all of them: what suits a GPU."""
    return torch.cdist(queries, points).argmin(-1)


def two_way_offsets(anchors: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """What a registration sees at its anchors (B, A, 7).

    Columns 0..2: offset to the nearest point; 3..5: mean offset of the points whose nearest anchor this is
    (0 if there is none); 6: log(1 + their share times A).
    """
    B, A, _ = anchors.shape
    forward = nearest(anchors, points)[1]
    owner, back = nearest(points, anchors)
    total = torch.zeros(B, A, 4).to(anchors)
    total.scatter_add_(
        1, owner[..., None].expand(-1, -1, 4), torch.cat([-back, torch.ones_like(back[..., :1])], -1)
    )
    count = total[..., 3:]
    return torch.cat(
        [forward, total[..., :3] / count.clamp_min(1), torch.log1p(count * (A / points.shape[1]))], -1
    )
