"""Pages of one shape that changes: in motion, or by a slider for each of its modes of variation."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.render.scales import CLAY, Scale
from meshmatch.render.viewer.assembly import check_page, plain_text, scaled, small_integers, write_html
from meshmatch.render.viewer.drawn import MOST, draw, span
from meshmatch.shapes.faces import seams
from meshmatch.shapes.shape import Shape

MOST_MODES = 12
"""Of an atlas with more modes the page shows the first."""
MOST_PLACES = 4_000_000
"""Vertices times frames, or modes, up to which a shape is drawn whole."""
_RAMP = 33  # colors


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
    which increase; the first gives the colors. ``rotation`` leads from there into y up, z to the front. ``met`` are names
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
    low, edge, cube = span(np.concatenate([verts[part.used] for verts in turned]))
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
        "times": [round(float(time), 9) for time in times],
        "met": [[float(time), plain_text(name)] for time, name in (met or {}).items() if times[0] <= time <= times[-1]],
        "cloud": len(faces) == 0,
        "radius": float(f"{part.radius / edge:.4g}"),
    }
    return _write(path, "motion", title, part.note or f"{first.V:,} vertices", words | cube, arrays)


@dataclass(frozen=True, eq=False)
class Varying:
    """A mean shape and how it varies: M modes, each a displacement (V, 3) by one standard deviation, and which ``shares``
    (M,) of the variance they explain; the ``scores`` (S, M) of known shapes, in standard deviations, and their names.
    ``figures`` are files (.png, .svg) of pictures and charts of it.
    """

    mean: Shape
    modes: Float[Floats, "M V 3"]
    shares: Float[Floats, " M"]
    scores: Float[Floats, "S M"]
    names: Sequence[str]
    figures: Sequence[Path] = ()


def write_atlas_page(
    path: str | Path, atlas: Varying, *, rotation: Float[Floats, "3 3"], title: str = "", most: int = MOST
) -> int:
    """Write a page on which sliders vary a shape, colored by its distance from the mean; how many bytes it has.

    The same input gives the same bytes. ``rotation`` leads into y up, z to the front. Up to ``most`` vertices are drawn,
    fewer of a shape with many modes. `OptionError` for a suffix that is no page's, and for a mean that has no surface or
    no modes; `OutputError` where the file cannot be written.
    """
    check_page(path)
    count = min(len(atlas.modes), MOST_MODES)
    if count == 0 or atlas.mean.is_cloud:
        raise OptionError("a page of modes needs a surface and a mode")
    part = draw(atlas.mean, min(most, MOST_PLACES // count))
    mean = atlas.mean.verts[part.vertex] @ rotation.T
    modes = atlas.modes[:count, part.vertex] @ rotation.T
    low, edge, cube = span(np.concatenate([mean, *(mean + sign * mode for mode in modes for sign in (-2, 2))]))
    reach = np.abs(modes).max(axis=(1, 2))
    # Colors reach as far as two standard deviations of the first mode do.
    scale = Scale.of(2 * np.linalg.norm(atlas.modes[0], axis=1))
    arrays: dict[str, NDArray[Any]] = {
        "position": scaled((mean - low) / edge, np.uint16),
        "mode": scaled(modes / np.maximum(reach, 1e-300)[:, None, None], np.int16),
        "face": small_integers(part.faces),
        "score": atlas.scores[:, :count].astype(np.float32),
    }
    words = {
        "kept": f"{100 * float(atlas.shares[:count].sum()):.1f} % of the variance in {count} of {len(atlas.modes)} modes",
        "names": [plain_text(name) for name in atlas.names],
        "shares": [round(float(share), 6) for share in atlas.shares[:count]],
        "reach": [float(f"{value:.7g}") for value in reach / edge],
        "unit": edge,
        "far": scale.high,
        "high": f"{scale.high:.4g}",
        "ramp": Scale(0.0, 1.0).colors(np.linspace(0, 1, _RAMP)).round(4).tolist(),
        "clay": list(CLAY),
        "figures": [[plain_text(figure.stem), _address(figure)] for figure in atlas.figures],
    }
    note = f"{len(atlas.names):,} shapes, {part.note or f'{atlas.mean.V:,} vertices'}"
    return _write(path, "atlas", title, note, words | cube, arrays)


def _address(figure: Path) -> str:
    """A picture as an address that holds it."""
    kind = {".png": "image/png", ".svg": "image/svg+xml"}[figure.suffix]
    return f"data:{kind};base64,{base64.b64encode(figure.read_bytes()).decode('ascii')}"


def _write(
    path: str | Path, name: str, title: str, note: str, words: dict[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> int:
    scripts = ("data", "materials", "single", name)
    return write_html(Path(path), name, scripts, {"title": plain_text(title), "note": note} | words, arrays, title)
