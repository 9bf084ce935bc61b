"""HTML of results in notebooks: a short table and a small picture."""

from __future__ import annotations

import base64
import math
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from html import escape
from pathlib import Path

from meshmatch.arrays import table_html
from meshmatch.errors import MeshmatchError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.compose import Composition, compose_match
from meshmatch.render.facing import Rotations
from meshmatch.render.picture import Look
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit

_LOOK = Look(size=(720, 420))


def result_html(title: str, rows: Mapping[str, str], draw: Callable[[], Composition] | None) -> str:
    """Format a heading, the non-empty rows and a picture, if it can be drawn, as self-contained HTML without scripts."""
    picture = ""
    with suppress(MeshmatchError), tempfile.TemporaryDirectory() as folder, thread_limit(1):
        if draw is not None:
            path = Path(folder, "picture.png")
            draw().render(path, _LOOK)
            data = base64.b64encode(path.read_bytes()).decode()
            picture = f'<img alt="{escape(title)}" src="data:image/png;base64,{data}">'
    return f"<div>{table_html(title, rows)}{picture}</div>"


def map_html(
    kind: str,
    found: VertexMap,
    shapes: tuple[Shape, Shape] | None,
    rotations: Rotations = (None, None),
    more: Mapping[str, str] | None = None,
) -> str:
    """Format a map; with both shapes, corresponding points are drawn in the same color."""

    def draw() -> Composition:
        assert shapes is not None
        return compose_match(*shapes, found, rotations).named([shape.name for shape in shapes])

    return transfer_html(kind, found, None if shapes is None else draw, more)


def transfer_html(
    kind: str, found: VertexMap, draw: Callable[[], Composition] | None, more: Mapping[str, str] | None = None
) -> str:
    """Format the result of a transfer: verdict and confidence of its map, and a picture."""
    confidence = float(found.confidence.mean())
    rows = {
        "verdict": "; ".join([found.verdict, *found.reasons]),
        "vertices": f"{found.source_vertices:,} of {found.source or 'the source'}",
        "confidence": "unknown" if math.isnan(confidence) else f"{confidence:.2f} on average",
    }
    return result_html(f"{kind}: {found.source} → {found.target}", rows | dict(more or {}), draw)
