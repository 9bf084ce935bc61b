"""The page that shows a shape in motion, with a slider."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.render.scales import CLAY
from meshmatch.render.viewer.assembly import check_page, plain_text, scaled, small_integers, write_html
from meshmatch.render.viewer.drawn import MOST, draw
from meshmatch.shapes.faces import seams
from meshmatch.shapes.shape import Shape

MOST_PLACES = 4_000_000
"""Vertices times frames up to which a shape is drawn whole."""


def write_motion(
    path: str | Path,
    frames: Sequence[Shape],
    times: Sequence[float],
    *,
    rotation: Float[Floats, "3 3"],
    met: Mapping[float, str] | None = None,
    title: str = "",
    most: int = MOST,
) -> int:
    """Write a page on which a shape goes through frames; how many bytes it has. The same input gives the same bytes.

    The ``frames`` are at least two shapes with the same vertices and faces, in one frame and unit, each with its time,
    which increase; the first gives the colours. ``rotation`` leads from there into y up, z to the front. ``met`` are names
    to show at some of the times. Up to ``most`` vertices are drawn, and fewer where there are many frames.

    `OptionError` for a suffix that is no page's, and for other frames or times; `OutputError` where the file cannot be
    written.
    """
    check_page(path)
    first = frames[0] if frames else None
    if first is None or len(frames) < 2 or len(times) != len(frames) or not (np.diff(times) > 0).all():
        raise OptionError("a motion needs two frames or more, each later than the one before")
    if any(shape.V != first.V or not np.array_equal(shape.faces, first.faces) for shape in frames):
        raise OptionError("the frames of a motion have the same vertices and faces")
    part = draw(first, min(most, MOST_PLACES // len(frames)))
    rows, faces = part.vertex, part.faces
    turned = [shape.verts[rows] @ rotation.T for shape in frames]
    used = np.concatenate([verts[part.used] for verts in turned])
    low, extent = used.min(axis=0), np.ptp(used, axis=0)
    edge = float(extent.max()) or 1.0
    normals = [np.zeros_like(verts) for verts in turned]  # of points, which then face the viewer
    if len(faces):  # the same on both sides of a seam
        joined = seams(turned[0], faces)
        normals = [Shape(verts, joined[faces]).vertex_normals[joined] for verts in turned]
    colors = np.tile(CLAY, (first.V, 1)) if first.colors is None else first.colors[:, :3]
    arrays: dict[str, NDArray[Any]] = {
        "position": scaled((np.stack(turned) - low) / edge, np.uint16),
        "normal": scaled(np.stack(normals), np.int8),
        "color": scaled(colors[rows], np.uint8),
        "face": small_integers(faces),
    }
    words: dict[str, Any] = {
        "title": plain_text(title),
        "note": part.note or f"{first.V:,} vertices",
        "times": [round(float(time), 9) for time in times],
        "met": [[float(time), plain_text(name)] for time, name in (met or {}).items() if times[0] <= time <= times[-1]],
        "cloud": len(faces) == 0,
        "low": (-extent / edge / 2).round(6).tolist(),
        "extent": (extent / edge).round(6).tolist(),
        "radius": float(f"{part.radius / edge:.4g}"),
    }
    return write_html(Path(path), "motion", ("data", "materials", "motion"), words, arrays, title)
