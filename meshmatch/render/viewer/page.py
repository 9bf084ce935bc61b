"""The page that shows two shapes and the map between them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.compose import matched_colors
from meshmatch.render.facing import Rotations
from meshmatch.render.scales import Scale, position_colors
from meshmatch.render.viewer.assembly import check_page, plain_text, scaled, small_integers, write_html
from meshmatch.render.viewer.drawn_shapes import MAX_VERTICES, Box, Drawn, boxes, draw, view_rotations
from meshmatch.render.viewer.looks import Looks, look_arrays
from meshmatch.shapes.shape import Shape

SCRIPTS = ("data", "picking", "materials", "drawing", "cameras", "points", "words", "viewer")


@dataclass(frozen=True, eq=False)
class PageReport:
    """What went into a page: vertices drawn of each shape, notes on what was left out, and the size in bytes."""

    drawn: tuple[int, int]
    notes: tuple[str, ...]
    size: int


def write_page(
    path: str | Path,
    source: Shape,
    target: Shape,
    there: VertexMap,  # from source to target
    back: VertexMap,
    *,
    rotations: Rotations = (None, None),
    names: tuple[str, str] | None = None,
    looks: Looks | None = None,
) -> PageReport:
    """Write a page that shows two shapes side by side, and for each point of one its match on the other.

    The source is colored by position, the target by the source's colors transferred along the map. The same input gives the
    same bytes. ``rotations`` are as the `Frame.rotation` of fits; by default the source's is guessed, and the target's
    follows from the map. ``names`` are shown instead of the shapes' own, and ``looks`` can be switched on by a button.

    `OptionError` for a suffix other than of pages, `InputError` for a map that is not of these shapes, `OutputError` if the
    file cannot be written.
    """
    check_page(path)
    there, back = there.for_shapes(source, target), back.for_shapes(target, source, "the map back")
    shapes, maps = (source, target), (there, back)
    parts = draw(source, MAX_VERTICES), draw(target, MAX_VERTICES)
    turns = view_rotations(source, target, there, rotations)
    cubes = boxes(shapes, parts, there, turns)
    position = position_colors(source, turns[0])
    tints = position, matched_colors(position, there, back, source)
    shown = names or (source.name or "source", target.name or "target")
    arrays: dict[str, NDArray[Any]] = {}
    words: dict[str, Any] = {}
    for k, side in enumerate(("source", "target")):
        part, box, rows = parts[k], cubes[k], parts[k].vertex
        own = {  # a row for each drawn vertex (see `drawing.js`)
            "position": scaled(box.place(part.verts), np.uint16),
            "normal": scaled(part.normals @ box.rotation.T, np.int8),
            "color": scaled(tints[k][rows], np.uint8),
            "confidence": scaled(maps[k].assumed_confidence[rows], np.uint8),
            "match": small_integers(maps[k].index[rows]),
            "face": small_integers(part.faces),
            "place": scaled(cubes[1 - k].place(maps[k].points(shapes[1 - k])[rows]), np.uint16),
        }
        if not np.array_equal(rows, np.arange(shapes[k].V)):
            own["vertex"] = small_integers(rows)
        words[side] = _words(shapes[k], shown[k], part, box)
        for name, look in looks.of(k) if looks is not None else []:
            shown_arrays, words[side][name] = look_arrays(look, shapes[k], part)
            own |= {f"{name}.{key}": array for key, array in shown_arrays.items()}
        arrays |= {f"{side}.{name}": array for name, array in own.items()}
    words |= {"look": None, "own": False} if looks is None else looks.words
    # Files with indices alone were once read with confidence 1 everywhere, which means that it is unknown.
    known = not np.isnan(there.confidence).any() and (there.verdict != "unknown" or bool((there.confidence < 1).any()))
    words |= {
        "verdict": there.verdict,
        "reasons": [plain_text(reason) for reason in there.reasons],
        "confidence": [round(float(found.assumed_confidence.mean()), 4) for found in maps] if known else None,
        "ramp": Scale(0.0, 1.0, reverse=True).colors(np.linspace(0, 1, 9)).round(4).tolist(),
    }
    size = write_html(Path(path), "viewer", SCRIPTS, words, arrays, f"{shown[0]} → {shown[1]}")
    notes = tuple(f"{name}: {part.note}" for name, part in zip(shown, parts, strict=True) if part.note)
    return PageReport((len(parts[0].vertex), len(parts[1].vertex)), notes, size)


def _words(shape: Shape, name: str, part: Drawn, box: Box) -> dict[str, Any]:
    """Description of one shape for the page; sizes are in units of the page, the same for both shapes."""
    scale = box.size / box.edge
    extent = np.ptp(part.verts[part.used] @ box.rotation.T, axis=0) * scale
    return {
        "name": plain_text(name),
        "vertices": shape.V,
        "faces": shape.F,
        "cloud": len(part.faces) == 0,
        "note": part.note,
        "size": float(f"{box.size:.6g}"),
        "extent": [float(f"{length:.4g}") for length in extent],
        "radius": float(f"{part.radius * scale:.4g}"),
    }
