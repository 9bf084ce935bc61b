"""A stick figure: a hand-made rig with the joints that poses use and a few vertices around each joint."""

import numpy as np
import torch

from meshmatch.generators.rig import Rig

_TRUNK = [
    ("root", "", (0.0, 0.95, 0.0)),
    ("spine05", "root", (0.0, 0.97, 0.0)),
    ("spine04", "spine05", (0.0, 1.04, -0.02)),
    ("spine03", "spine04", (0.0, 1.12, -0.02)),
    ("spine02", "spine03", (0.0, 1.21, -0.02)),
    ("spine01", "spine02", (0.0, 1.34, -0.02)),
    ("neck01", "spine01", (0.0, 1.51, 0.0)),
    ("neck02", "neck01", (0.0, 1.55, 0.01)),
    ("neck03", "neck02", (0.0, 1.59, 0.02)),
    ("head", "neck03", (0.0, 1.62, 0.03)),
]
_SIDE = [
    ("upperleg01", "root", (0.1, 0.92, 0.0)),
    ("upperleg02", "upperleg01", (0.11, 0.83, 0.01)),
    ("lowerleg01", "upperleg02", (0.13, 0.5, 0.02)),
    ("foot", "lowerleg01", (0.15, 0.09, -0.02)),
    ("toe2-1", "foot", (0.16, 0.03, 0.13)),
    ("clavicle", "spine01", (0.02, 1.43, 0.02)),
    ("upperarm01", "clavicle", (0.17, 1.41, 0.0)),
    ("upperarm02", "upperarm01", (0.22, 1.35, 0.0)),
    ("lowerarm01", "upperarm02", (0.35, 1.21, 0.01)),
    ("lowerarm02", "lowerarm01", (0.41, 1.15, 0.06)),
    ("wrist", "lowerarm02", (0.48, 1.08, 0.13)),
    *(
        (f"finger{n}-{k}", f"finger{n}-{k - 1}" if k > 1 else "wrist", tuple(at))
        for n in range(1, 6)
        for k in (1, 2, 3)
        for at in [np.array([0.5, 1.05, 0.2 - 0.02 * n]) + (k - 1) * np.array([0.01, -0.025, 0.02 - 0.004 * k])]
    ),
    ("eye", "head", (0.03, 1.66, 0.11)),
]


def stick_figure(identities: int = 2) -> Rig:
    """Build a rig of several sizes; each joint moves 4 vertices around it (a small tetrahedron), and no others."""
    names, parents, heads = [], [], []
    for name, parent, at in _TRUNK:
        names.append(name)
        parents.append(parent)
        heads.append(at)
    for side, suffix in ((1.0, ".L"), (-1.0, ".R")):
        for name, parent, (x, y, z) in _SIDE:
            trunk = parent in names and not any(parent == other for other, _, _ in _SIDE)
            names.append(name + suffix)
            parents.append(parent if trunk else parent + suffix)
            heads.append((side * x, y, z))
    one = torch.tensor(np.array(heads), dtype=torch.float32)
    sizes = torch.linspace(0.9, 1.1, identities)[:, None, None]
    joints = one * sizes
    corner = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 0.02
    rest = (joints[:, :, None] + corner).flatten(1, 2)
    J = len(names)
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return Rig(
        rest=rest.half(),
        heads=joints,
        weights=torch.eye(J).repeat_interleave(4, 0),
        parents=tuple(names.index(parent) if parent else -1 for parent in parents),
        names=tuple(names),
        faces=(faces + 4 * torch.arange(J)[:, None, None]).flatten(0, 1),
    )


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
