"""Pictures of files rendered by other programs: comparison of covered pixels, and one sheet of all pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from meshmatch.arrays import Bools

ENDINGS = ("-blender", "-three", "-blender-moved", "-three-moved")
_SIZE, _TITLE_HEIGHT, _FILES_PER_ROW = 200, 14, 2  # size of a picture and height of a title in pixels; files per row


def mask(path: Path) -> Bools:
    """Return the covered pixels (H, W) of a picture with a transparent background."""
    return np.asarray(Image.open(path).convert("RGBA"))[:, :, 3] > 127


def covered(path: Path) -> float:
    """Return the covered share of a picture."""
    return float(mask(path).mean())


def overlap(one: Path, other: Path) -> float:
    """Compute the intersection over union of the covered pixels of two pictures."""
    a, b = mask(one), mask(other)
    return float((a & b).sum() / max((a | b).sum(), 1))


def draw_sheet(path: Path, names: Sequence[str], pictures: Path) -> None:
    """Draw one sheet with the pictures of each file by Blender and three.js, at rest and moved, two files per row."""
    wide = len(ENDINGS) * _SIZE
    rows = -(-len(names) // _FILES_PER_ROW)
    sheet = Image.new("RGB", (_FILES_PER_ROW * wide, rows * (_SIZE + _TITLE_HEIGHT)), "white")
    pen = ImageDraw.Draw(sheet)
    for k, name in enumerate(names):
        x, y = k % _FILES_PER_ROW * wide, k // _FILES_PER_ROW * (_SIZE + _TITLE_HEIGHT)
        pen.text((x + 2, y), name, fill="black")
        for j, ending in enumerate(ENDINGS):
            file = pictures / f"{name}{ending}.png"
            if file.exists():
                picture = Image.open(file).convert("RGBA").resize((_SIZE, _SIZE))
                sheet.paste(picture, (x + j * _SIZE, y + _TITLE_HEIGHT), picture)
    sheet.save(path)
