"""Figures of the ablations (to be drawn)."""

from collections.abc import Sequence
from pathlib import Path

from meshmatch.experiments.ablation_cells import Known


def draw_views(
    known: Known, views: Sequence[str], sets: Sequence[str], words: str, folder: Path
) -> list[Path]:
    """Draw what is there."""
    return []
