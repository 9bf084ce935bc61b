"""Properties of every animal rig."""

import numpy as np

from meshmatch.generators.quadruped_rig import LIMITS, AnimalRig, group_of
from meshmatch.geometry.triangles import is_watertight


def check_rig(rig: AnimalRig) -> None:
    assert is_watertight(rig.faces)
    mirrored = rig.verts[rig.mirror] * [-1, 1, 1]
    assert np.abs(mirrored - rig.verts).max() < 1e-12
    assert np.abs(rig.weights.sum(1) - 1).max() < 1e-6
    other = [
        rig.names.index({"L": n[:-1] + "R", "R": n[:-1] + "L"}.get(n[-1], n) if n[-2] == "_" else n) for n in rig.names
    ]
    assert np.abs(rig.weights[rig.mirror][:, other] - rig.weights).max() < 1e-9
    assert (rig.parents < np.arange(len(rig.names))).all()
    assert set(map(group_of, rig.names)) <= set(LIMITS)
