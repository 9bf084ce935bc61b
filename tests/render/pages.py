"""Parse the file of a page: its elements, and the words and arrays embedded for its scripts."""

import base64
import json
import zlib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

DTYPES = {
    "Uint8Array": np.uint8,
    "Int8Array": np.int8,
    "Uint16Array": np.uint16,
    "Int16Array": np.int16,
    "Uint32Array": np.uint32,
    "Float32Array": np.float32,
}


class Page(HTMLParser):
    """Elements of a page, with the text of scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text, self.elements, self.open = text, [], False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs), ""))
        self.open = True

    def handle_endtag(self, tag: str) -> None:
        self.open = False

    def handle_data(self, data: str) -> None:
        if self.open:
            tag, attrs, text = self.elements[-1]
            self.elements[-1] = (tag, attrs, text + data)

    def all(self, tag: str) -> list[tuple[dict[str, str | None], str]]:
        return [(attrs, text) for name, attrs, text in self.elements if name == tag]

    def script(self, name: str) -> str:
        (found,) = (text for attrs, text in self.all("script") if attrs.get("id") == name)
        return found

    @property
    def words(self) -> dict[str, Any]:
        return dict(json.loads(self.script("words")))

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return unpacked(self.words["arrays"], self.script("packed"))


def read(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def unpacked(table: list[dict[str, Any]], text: str) -> dict[str, np.ndarray]:
    """Decode the arrays of a table; each must start at a multiple of 4 bytes."""
    data = zlib.decompress(base64.b64decode(text, validate=True))
    assert all(row["start"] % 4 == 0 for row in table)
    return {row["name"]: np.frombuffer(data, DTYPES[row["kind"]], row["length"], row["start"]) for row in table}
