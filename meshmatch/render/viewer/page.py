"""One HTML file that shows two shapes and the map between them. It needs no network, and forbids it."""

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
from meshmatch.arrays import Floats
from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import replace_on_success
from meshmatch.render.colors import position_colors
from meshmatch.render.compose import matched_colors
from meshmatch.render.scales import Scale
from meshmatch.render.viewer.drawn import MOST, Drawn, draw
from meshmatch.render.viewer.looks import Looks, dress
from meshmatch.render.viewer.packing import pack, small_integers, to_bytes, to_shorts, to_signed_bytes
from meshmatch.render.viewer.placement import Box, boxes, upright
from meshmatch.shapes.shape import Shape

PAGE_SUFFIXES = (".html", ".htm")
# Control characters, ends of lines, and marks that turn the direction of writing.
_UNSEEMLY = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
_SCRIPTS = ("data", "picking", "materials", "drawing", "cameras", "points", "words", "viewer")


@dataclass(frozen=True)
class PageReport:
    """What went into a page: how many vertices of each shape are drawn, what was left out, its bytes."""

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
    rotations: tuple[Floats | None, Floats | None] = (None, None),
    names: tuple[str, str] | None = None,
    looks: Looks | None = None,
) -> PageReport:
    """Write a page that shows two shapes side by side, and for each point of one its match on the other.

    The source is coloured by position, the target by its colours carried along the map. The same input gives
    the same bytes.

    Parameters
    ----------
    there, back : VertexMap
        From source to target, and from target to source.
    rotations
        ``(3, 3)`` of source and target into y up, z front, as `Frame.rotation` of a fit. The source's is
        guessed if not given, and the target's then follows from the map.
    names
        To show; the shapes' own if not given.
    looks
        What they wear, for the button that shows it.

    Raises
    ------
    OptionError
        The suffix is none of `PAGE_SUFFIXES`.
    InputError
        A map is not of these shapes.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    check_page(path)
    there, back = there.for_shapes(source, target), back.for_shapes(target, source, "the map back")
    shapes, maps = (source, target), (there, back)
    parts = draw(source, MOST), draw(target, MOST)
    turns = upright(source, target, there, rotations)
    cubes = boxes(shapes, parts, there, turns)
    position = position_colors(source, turns[0])
    tints = position, matched_colors(position, there, back, source)
    shown = names or (source.name or "source", target.name or "target")
    arrays: dict[str, NDArray[Any]] = {}
    words: dict[str, Any] = {}
    for k, side in enumerate(("source", "target")):
        own = _arrays(parts[k], cubes[k], maps[k], tints[k])
        own["place"] = to_shorts(cubes[1 - k].place(maps[k].points(shapes[1 - k])[parts[k].vertex]))
        if not np.array_equal(parts[k].vertex, np.arange(shapes[k].V)):
            own["vertex"] = small_integers(parts[k].vertex)
        words[side] = _words(shapes[k], shown[k], parts[k], cubes[k])
        for name, look in looks.of(k) if looks is not None else []:
            worn, words[side][name] = dress(look, shapes[k], parts[k])
            own |= {f"{name}.{key}": array for key, array in worn.items()}
        arrays |= {f"{side}.{name}": array for name, array in own.items()}
    table, packed = pack(arrays)
    words |= {"look": None, "own": False} if looks is None else looks.words
    words |= {
        "verdict": there.verdict,
        "reasons": [plain_text(reason) for reason in there.reasons],
        "confidence": [round(float(found.confidence.mean()), 4) for found in maps] if _is_known(there) else None,
        "ramp": Scale(0.0, 1.0, reverse=True).colors(np.linspace(0, 1, 9)).round(4).tolist(),
        "version": __version__,
        "arrays": table,
    }
    text = assemble("viewer", _SCRIPTS, words, packed, f"{shown[0]} → {shown[1]}")
    with replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    notes = tuple(f"{name}: {part.note}" for name, part in zip(shown, parts, strict=True) if part.note)
    return PageReport((len(parts[0].vertex), len(parts[1].vertex)), notes, len(text.encode()))


def _is_known(found: VertexMap) -> bool:
    """Whether the map says how confident it is: files of indices alone are read as confident everywhere."""
    return found.verdict != "unknown" or bool((found.confidence < 1).any())


def check_page(path: str | Path) -> None:
    """Refuse a name that no browser would open (`OptionError`). Cheap: ask before work."""
    if Path(path).suffix.lower() not in PAGE_SUFFIXES:
        raise OptionError(f"{Path(path).name}: a page is HTML", "end the name in .html")


def _arrays(part: Drawn, box: Box, found: VertexMap, tint: Floats) -> dict[str, NDArray[Any]]:
    """What the page holds of one shape, a row for each vertex that is drawn (see `drawing.js`)."""
    rows = part.vertex
    return {
        "position": to_shorts(box.place(part.verts)),
        "normal": to_signed_bytes(part.normals @ box.rotation.T),
        "color": to_bytes(tint[rows]),
        "confidence": to_bytes(found.confidence[rows]),
        "match": small_integers(found.index[rows]),
        "face": small_integers(part.faces),
    }


def _words(shape: Shape, name: str, part: Drawn, box: Box) -> dict[str, Any]:
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
    """A name of any bytes as text that UTF-8 can hold, without what would turn or break the words around it."""
    return _UNSEEMLY.sub("\ufffd", value.encode("utf-8", "replace").decode("utf-8"))


def assemble(name: str, scripts: Sequence[str], words: dict[str, Any], packed: str, title: str) -> str:
    """The whole file, of ``name``.html, ``name``.css and scripts.

    Every part is put in once, in one pass: a name cannot pose as a part.
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
