"""Assembly of a page: one HTML file of scripts, words and packed arrays. It needs no network, and forbids its use."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch import __version__
from meshmatch.errors import OptionError
from meshmatch.outputs import replace_on_success

# Control characters, line ends, and marks that change the direction of writing.
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
_TYPED_ARRAYS = {
    "u1": "Uint8Array",
    "i1": "Int8Array",
    "u2": "Uint16Array",
    "i2": "Int16Array",
    "u4": "Uint32Array",
    "f4": "Float32Array",
}


def check_page(path: str | Path) -> None:
    """Raise `OptionError` for a file name that no browser would open as a page. Call it before long work."""
    if Path(path).suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"{Path(path).name}: a page is HTML", "end the name in .html")


def plain_text(value: str) -> str:
    """A name as text that UTF-8 can encode, without characters that would reverse or break the text around it."""
    return _UNPRINTABLE.sub("\ufffd", value.encode("utf-8", "replace").decode("utf-8"))


def scaled(values: ArrayLike, kind: type[np.integer[Any]]) -> NDArray[Any]:
    """0..1, or -1..1 for a signed type, as integers up to the largest of the type."""
    lowest = -1.0 if np.iinfo(kind).min else 0.0
    return np.round(np.iinfo(kind).max * np.clip(np.asarray(values, np.float64), lowest, 1.0)).astype(kind)


def small_integers(values: NDArray[np.int64]) -> NDArray[Any]:
    """Integers from 0, as 16 bits if they fit (65535 has a special meaning in WebGL), else as 32."""
    return values.astype(np.uint16 if len(values) == 0 or values.max() < 65535 else np.uint32)


def pack(arrays: Mapping[str, NDArray[Any]]) -> tuple[list[dict[str, Any]], str]:
    """Pack arrays: a table ``[{name, kind, start, length}]``, and text with the data.

    The data are little-endian, each array at a multiple of 4 bytes, zlib (RFC 1950), base64. The kind is JavaScript's typed
    array; the start is in bytes, the length in numbers.
    """
    table, parts, start = [], [], 0
    for name, array in arrays.items():
        code = array.dtype.kind + str(array.dtype.itemsize)
        data = np.ascontiguousarray(array, dtype="<" + code).tobytes()
        table.append({"name": name, "kind": _TYPED_ARRAYS[code], "start": start, "length": int(array.size)})
        parts += [data, bytes(-len(data) % 4)]
        start += len(data) + len(parts[-1])
    return table, base64.b64encode(zlib.compress(b"".join(parts), 6)).decode("ascii")


def write_html(
    path: Path, name: str, scripts: Sequence[str], words: dict[str, Any], arrays: Mapping[str, NDArray[Any]], title: str
) -> int:
    """Write a page of ``name``.html, ``name``.css, scripts, words and arrays; return its size in bytes.

    Every part is inserted once, in one pass, so that a name cannot pose as a part. `OutputError` if the file cannot be
    written.
    """
    table, packed = pack(arrays)
    # Escaped below, so that the JSON stays inside its script element whatever its strings contain.
    record = json.dumps(words | {"version": __version__, "arrays": table}, ensure_ascii=True, separators=(",", ":"))
    style = _asset("page.css") + _asset(f"{name}.css")
    library = _asset("three.min.js")
    program = "(() => {\n'use strict';\n" + "\n".join(_asset(f"{part}.js") for part in scripts) + "})();\n"
    # Scripts and styles are allowed by their hashes alone, and nothing may be fetched.
    policy = (
        f"default-src 'none'; script-src {_hash(library)} {_hash(program)}; style-src {_hash(style)}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    parts = {
        "policy": policy,
        "title": html.escape(plain_text(title)),
        "style": style,
        "body": _asset(f"{name}.html"),
        "library": library,
        "program": program,
        "words": record.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"),
        "packed": packed,
    }
    text = re.sub(r"<!--(\w+)-->", lambda found: parts[found[1]], _asset("page.html"))
    with replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")
    return len(text.encode())


def _asset(name: str) -> str:
    return files("meshmatch.render.viewer").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"
