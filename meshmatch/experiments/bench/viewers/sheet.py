"""Pictures of files, as others draw them: what they cover, and all of them on one sheet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from meshmatch.arrays import Bools

ENDINGS = ("-blender", "-three", "-blender-moved", "-three-moved")
_SIZE, _LINE, _ROW = 200, 14, 2  # pixels; files side by side


def mask(path: Path) -> Bools:
    """Which pixels (H, W) of a picture with a transparent ground something covers."""
    return np.asarray(Image.open(path).convert("RGBA"))[:, :, 3] > 127


def covered(path: Path) -> float:
    """The share of a picture that something covers."""
    return float(mask(path).mean())


def overlap(one: Path, other: Path) -> float:
    """The pixels that both pictures cover, of those that either does."""
    a, b = mask(one), mask(other)
    return float((a & b).sum() / max((a | b).sum(), 1))


def draw_sheet(path: Path, names: Sequence[str], pictures: Path) -> None:
    """For each file Blender and three.js side by side, as it lies and moved, two files a row."""
    wide = len(ENDINGS) * _SIZE
    rows = -(-len(names) // _ROW)
    sheet = Image.new("RGB", (_ROW * wide, rows * (_SIZE + _LINE)), "white")
    pen = ImageDraw.Draw(sheet)
    for k, name in enumerate(names):
        x, y = k % _ROW * wide, k // _ROW * (_SIZE + _LINE)
        pen.text((x + 2, y), name, fill="black")
        for j, ending in enumerate(ENDINGS):
            file = pictures / f"{name}{ending}.png"
            if file.exists():
                picture = Image.open(file).convert("RGBA").resize((_SIZE, _SIZE))
                sheet.paste(picture, (x + j * _SIZE, y + _LINE), picture)
    sheet.save(path)
