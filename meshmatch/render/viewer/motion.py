"""One HTML file that shows a shape in motion, with a slider. It needs no network, and forbids it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch import __version__
from meshmatch.arrays import Floats
from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success
from meshmatch.render.colors import CLAY
from meshmatch.render.viewer.drawn import MOST, draw
from meshmatch.render.viewer.packing import pack, small_integers, to_bytes, to_shorts, to_signed_bytes
from meshmatch.render.viewer.page import assemble, check_page, plain_text
from meshmatch.shapes.debris import seams
from meshmatch.shapes.shape import Shape

MOST_PLACES = 4_000_000
"""Vertices times frames up to which a shape is drawn whole."""
_SCRIPTS = ("data", "materials", "motion")


def write_motion(
    path: str | Path,
    frames: Sequence[Shape],
    times: Sequence[float],
    *,
    rotation: Floats,
    met: Mapping[float, str] | None = None,
    title: str = "",
    most: int = MOST,
) -> int:
    """Write a page on which a shape goes through frames. The same input gives the same bytes.

    Parameters
    ----------
    frames
        At least two shapes with the same vertices and faces, in one frame and unit. The first gives the colours.
    times
        (N,) increasing, one for each frame.
    rotation
        (3, 3) from the frame of the shapes into y up, z to the front.
    met
        Names to show at some of the times.
    most
        Vertices up to which the shape is drawn whole; less where there are many frames.

    Returns
    -------
    int
        Bytes written.

    Raises
    ------
    OptionError
        The suffix is no page's; fewer than two frames; frames of different shapes; times that do not increase.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
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
    joined = seams(turned[0], faces) if len(faces) else rows
    arrays: dict[str, NDArray[Any]] = {
        "position": to_shorts((np.stack(turned) - low) / edge),
        "normal": to_signed_bytes(np.stack([_normals(verts, faces, joined) for verts in turned])),
        "color": to_bytes(_colors(first)[rows]),
        "face": small_integers(faces),
    }
    table, packed = pack(arrays)
    words: dict[str, Any] = {
        "title": plain_text(title),
        "note": part.note or f"{first.V:,} vertices",
        "times": [round(float(time), 9) for time in times],
        "met": [[float(time), plain_text(name)] for time, name in (met or {}).items() if times[0] <= time <= times[-1]],
        "cloud": len(faces) == 0,
        "low": (-extent / edge / 2).round(6).tolist(),
        "extent": (extent / edge).round(6).tolist(),
        "radius": float(f"{part.radius / edge:.4g}"),
        "version": __version__,
        "arrays": table,
    }
    text = assemble("motion", _SCRIPTS, words, packed, title)
    with replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    return len(text.encode())


def _normals(verts: Floats, faces: np.ndarray, joined: np.ndarray) -> Floats:
    """Unit normals (N, 3), the same on both sides of a seam; zeros for points, which then face the viewer."""
    if not len(faces):
        return np.zeros_like(verts)
    return Shape(verts, joined[faces]).vertex_normals[joined]


def _colors(shape: Shape) -> Floats:
    return np.tile(np.array(CLAY), (shape.V, 1)) if shape.colors is None else shape.colors[:, :3]
