"""A single HTML file that shows two shapes and the map between them, without network access."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch import __version__
from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import replace_on_success
from meshmatch.render.colors import position_colors
from meshmatch.render.compose import matched_colors
from meshmatch.render.facing import Rotations
from meshmatch.render.scales import Scale
from meshmatch.render.viewer.display_mesh import MAX_VERTICES, DisplayMesh, display_mesh
from meshmatch.render.viewer.looks import Looks, look_arrays
from meshmatch.render.viewer.packing import pack, small_integers, to_bytes, to_shorts, to_signed_bytes
from meshmatch.render.viewer.placement import Box, boxes, upright
from meshmatch.shapes.shape import Shape

PAGE_SUFFIXES = (".html", ".htm")
# Control characters, line ends, and marks that change the direction of writing.
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
_SCRIPTS = ("data", "picking", "materials", "drawing", "cameras", "points", "words", "viewer")


@dataclass(frozen=True)
class PageReport:
    """A written page: how many vertices of each shape it draws, what was left out, its size in bytes."""

    drawn: tuple[int, int]
    notes: tuple[str, ...]
    size: int


def write_page(
    path: str | Path,
    source: Shape,
    target: Shape,
    there: VertexMap,
    back: VertexMap,
    *,
    rotations: Rotations = (None, None),
    names: tuple[str, str] | None = None,
    looks: Looks | None = None,
) -> PageReport:
    """Write a page that shows two shapes side by side, and for each point of one its match on the other.

    The source is colored by position, the target by its colors transferred by the map. A shape of more than
    `MAX_VERTICES` vertices is drawn coarser, and the page says so. The same input gives the same bytes.

    Parameters
    ----------
    there, back
        From source to target, and from target to source.
    rotations
        Of source and target into y up, z front, as `Frame.rotation` of a fit. By default the source's is guessed, and
        the target's follows from the map.
    names
        To show; by default the shapes' own.
    looks
        Textures or colors, for the button that shows them.

    Raises
    ------
    OptionError
        The suffix is not one of `PAGE_SUFFIXES`.
    InputError
        A map does not belong to these shapes.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    check_page(path)
    there, back = there.for_shapes(source, target), back.for_shapes(target, source, "the map back")
    shapes, maps = (source, target), (there, back)
    parts = display_mesh(source, MAX_VERTICES), display_mesh(target, MAX_VERTICES)
    turns = upright(source, target, there, rotations)
    cubes = boxes(shapes, parts, there, turns)
    position = position_colors(source, turns[0])
    tints = position, matched_colors(position, there, back, source)
    labels = names or (source.name or "source", target.name or "target")
    arrays: dict[str, NDArray[Any]] = {}
    words: dict[str, Any] = {}
    for k, side in enumerate(("source", "target")):
        own = _arrays(parts[k], cubes[k], maps[k], tints[k])
        own["place"] = to_shorts(cubes[1 - k].place(maps[k].points(shapes[1 - k])[parts[k].vertex]))
        if not np.array_equal(parts[k].vertex, np.arange(shapes[k].V)):
            own["vertex"] = small_integers(parts[k].vertex)
        words[side] = _words(shapes[k], labels[k], parts[k], cubes[k])
        for name, look in looks.of(k) if looks is not None else []:
            shown, words[side][name] = look_arrays(look, shapes[k], parts[k])
            own |= {f"{name}.{key}": array for key, array in shown.items()}
        arrays |= {f"{side}.{name}": array for name, array in own.items()}
    table, packed = pack(arrays)
    words |= {"look": None, "own": False} if looks is None else looks.words
    words |= {
        "verdict": there.verdict,
        "reasons": [plain_text(reason) for reason in there.reasons],
        "confidence": [round(float(found.confidence.mean()), 4) for found in maps]
        if _is_known(there)
        else None,
        "ramp": Scale(0.0, 1.0, reverse=True).colors(np.linspace(0, 1, 9)).round(4).tolist(),
        "version": __version__,
        "arrays": table,
    }
    text = assemble("viewer", _SCRIPTS, words, packed, f"{labels[0]} → {labels[1]}")
    with replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    notes = tuple(f"{name}: {part.note}" for name, part in zip(labels, parts, strict=True) if part.note)
    return PageReport((len(parts[0].vertex), len(parts[1].vertex)), notes, len(text.encode()))


def _is_known(found: VertexMap) -> bool:
    """Whether the map says how confident it is: files of indices alone are read as confident everywhere."""
    return found.verdict != "unknown" or bool((found.confidence < 1).any())


def check_page(path: str | Path) -> None:
    """Refuse a suffix that no browser would open (`OptionError`)."""
    if Path(path).suffix.lower() not in PAGE_SUFFIXES:
        raise OptionError(f"{Path(path).name}: a page is HTML", "end the name in .html")


def _arrays(
    part: DisplayMesh, box: Box, found: VertexMap, color: Float[Floats, "V 3"]
) -> dict[str, NDArray[Any]]:
    """Arrays of one shape, a row for each drawn vertex (see `drawing.js`)."""
    rows = part.vertex
    return {
        "position": to_shorts(box.place(part.verts)),
        "normal": to_signed_bytes(part.normals @ box.rotation.T),
        "color": to_bytes(color[rows]),
        "confidence": to_bytes(found.confidence[rows]),
        "match": small_integers(found.index[rows]),
        "face": small_integers(part.faces),
    }


def _words(shape: Shape, name: str, part: DisplayMesh, box: Box) -> dict[str, Any]:
    """Sizes are in units of the page, the same for both shapes."""
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


def plain_text(value: str) -> str:
    """A name of any bytes as text that UTF-8 can hold, without characters that would disturb the text around it."""
    return _CONTROL.sub("\ufffd", value.encode("utf-8", "replace").decode("utf-8"))


def assemble(name: str, scripts: Sequence[str], words: dict[str, Any], packed: str, title: str) -> str:
    """The whole file: ``name``.html in page.html, with page.css, ``name``.css and scripts.

    Every part is inserted once, in one pass: a name cannot pose as a part.
    """
    style = _asset("page.css") + _asset(f"{name}.css")
    library = _asset("three.min.js")
    program = "(() => {\n'use strict';\n" + "\n".join(_asset(f"{part}.js") for part in scripts) + "})();\n"
    # Scripts and styles are allowed by their hashes alone, and nothing may be fetched from anywhere.
    policy = "; ".join(
        [
            "default-src 'none'",
            f"script-src {_hash(library)} {_hash(program)}",
            f"style-src {_hash(style)}",
            "img-src data:",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    parts = {
        "policy": policy,
        "title": html.escape(plain_text(title)),
        "style": style,
        "body": _asset(f"{name}.html"),
        "library": library,
        "program": program,
        "words": _json(words),
        "packed": packed,
    }
    return re.sub(r"<!--(\w+)-->", lambda found: parts[found[1]], _asset("page.html"))


def _asset(name: str) -> str:
    return files("meshmatch.render.viewer").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def _json(value: Any) -> str:
    """JSON that stays inside a script element, whatever its strings say."""
    text = json.dumps(value, ensure_ascii=True, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
