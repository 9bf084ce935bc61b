"""Pages of one shape that changes: in motion, or with a slider for each of its modes of variation."""

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
from meshmatch.render.viewer.drawn_shapes import MAX_VERTICES, draw, span
from meshmatch.shapes.faces import seam_representatives
from meshmatch.shapes.shape import Shape

MAX_MODES = 12
"""A page shows only the first modes of an atlas with more."""
MAX_PLACES = 4_000_000
"""Maximum number of vertices, times frames or modes, of a shape that is drawn completely."""
_RAMP = 33  # number of colors


def write_motion(
    path: str | Path,
    frames: Sequence[Shape],
    times: Sequence[float],
    *,
    rotation: Float[Floats, "3 3"],
    met: Mapping[float, str] | None = None,
    title: str = "",
    most: int = MAX_VERTICES,
) -> int:
    """Write a page on which a shape moves through frames; return its size in bytes. The same input gives the same bytes.

    ``frames`` are at least two shapes with the same vertices and faces, in one frame and unit, with increasing ``times``;
    the first gives the colors. ``rotation`` leads into y up, z to the front. ``met`` are names to show at some of the times.
    Up to ``most`` vertices are drawn, and fewer with many frames.

    `OptionError` for a suffix other than of pages, and for invalid frames or times; `OutputError` if the file cannot be
    written.
    """
    check_page(path)
    first = frames[0] if frames else None
    if first is None or len(frames) < 2 or len(times) != len(frames) or not (np.diff(times) > 0).all():
        raise OptionError("a motion needs two frames or more, each later than the one before")
    if any(shape.V != first.V or not np.array_equal(shape.faces, first.faces) for shape in frames):
        raise OptionError("the frames of a motion have the same vertices and faces")
    part = draw(first, min(most, MAX_PLACES // len(frames)))
    rows, faces = part.vertex, part.faces
    turned = [shape.verts[rows] @ rotation.T for shape in frames]
    low, edge, cube = span(np.concatenate([verts[part.used] for verts in turned]))
    normals = [np.zeros_like(verts) for verts in turned]  # of points, which face the viewer then
    if len(faces):  # equal on both sides of a seam
        welded = seam_representatives(turned[0], faces)
        normals = [Shape(verts, welded[faces]).vertex_normals[welded] for verts in turned]
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
    """A mean shape and how it varies.

    ``modes`` are displacements (M, V, 3) by one standard deviation each, and ``shares`` (M,) the shares of the variance that
    they explain; ``scores`` (S, M) are those of known shapes, in standard deviations, with their ``names``. ``figures`` are
    files (.png, .svg) of pictures and charts to show.
    """

    mean: Shape
    modes: Float[Floats, "M V 3"]
    shares: Float[Floats, " M"]
    scores: Float[Floats, "S M"]
    names: Sequence[str]
    figures: Sequence[Path] = ()


def write_atlas_page(
    path: str | Path, atlas: Varying, *, rotation: Float[Floats, "3 3"], title: str = "", most: int = MAX_VERTICES
) -> int:
    """Write a page on which sliders vary a shape, colored by its distance from the mean; return its size in bytes.

    The same input gives the same bytes. ``rotation`` leads into y up, z to the front. Up to ``most`` vertices are drawn, and
    fewer with many modes. `OptionError` for a suffix other than of pages, and for a mean without a surface or without modes;
    `OutputError` if the file cannot be written.
    """
    check_page(path)
    count = min(len(atlas.modes), MAX_MODES)
    if count == 0 or atlas.mean.is_cloud:
        raise OptionError("a page of modes needs a surface and a mode")
    part = draw(atlas.mean, min(most, MAX_PLACES // count))
    mean = atlas.mean.verts[part.vertex] @ rotation.T
    modes = atlas.modes[:count, part.vertex] @ rotation.T
    low, edge, cube = span(np.concatenate([mean, *(mean + sign * mode for mode in modes for sign in (-2, 2))]))
    reach = np.abs(modes).max(axis=(1, 2))
    # The color scale reaches to two standard deviations of the first mode.
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
        "figures": [[plain_text(figure.stem), _data_url(figure)] for figure in atlas.figures],
    }
    note = f"{len(atlas.names):,} shapes, {part.note or f'{atlas.mean.V:,} vertices'}"
    return _write(path, "atlas", title, note, words | cube, arrays)


def _data_url(figure: Path) -> str:
    """A picture file as a data URL."""
    kind = {".png": "image/png", ".svg": "image/svg+xml"}[figure.suffix]
    return f"data:{kind};base64,{base64.b64encode(figure.read_bytes()).decode('ascii')}"


def _write(
    path: str | Path, name: str, title: str, note: str, words: dict[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> int:
    scripts = ("data", "materials", "single", name)
    return write_html(Path(path), name, scripts, {"title": plain_text(title), "note": note} | words, arrays, title)
