"""Fits without a model on few nodes, of few samples: enough for small shapes."""

from dataclasses import dataclass, field

import pytest

from meshmatch.collections import select_setting
from meshmatch.fitting import without_model
from meshmatch.fitting.fit_config import Schedule
from meshmatch.fitting.solve.viscous import ViscousConfig


@dataclass(frozen=True, kw_only=True)
class SmallViscous(ViscousConfig):
    """As `ViscousConfig`, of a fifth of the size."""

    nodes: int = 150
    radius: float = 0.18
    faces: int = 1200
    samples: int = 1500
    back_points: int = 800
    schedule: Schedule = field(default=Schedule(steps=10, prior=(1e-3, 1e-6), scale=(0.1, 0.02), damping=1e-6))


def use_small_fits(patch: pytest.MonkeyPatch) -> None:
    """Let collections without a model fit with `SmallViscous`."""
    for module in (select_setting, without_model):
        patch.setattr(module, "ViscousConfig", SmallViscous)
    patch.setattr(without_model, "_ALIGN_SAMPLES", 300)
