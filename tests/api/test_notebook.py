"""What a notebook shows: the verdict in words, and a picture within the page."""

import base64
import io
import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.sparse import csr_array

import meshmatch
from meshmatch.api.garment import GarmentResult
from meshmatch.api.notebook import result_html
from meshmatch.api.results import MapPair, MatchResult
from meshmatch.api.rig import RiggedResult
from meshmatch.api.wrap import WrapResult
from meshmatch.errors import InputError
from meshmatch.fitting.fit import Fit
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.compose import compose_shapes
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.weight_files import SkinWeights
from tests.transfer.rigs import tube

HERE = replace(tube(), name="<script>alert(1)</script>")
LARGER = Shape(1.1 * HERE.verts, HERE.faces, "larger")
MAP = VertexMap(
    HERE.name, LARGER.name, np.arange(HERE.V), target_vertices=HERE.V, verdict="fair", reasons=("a < b",),
    confidence=np.full(HERE.V, 0.75),
)  # fmt: skip
PAIR = MapPair(HERE, LARGER, MAP, opposite=replace(MAP, source=LARGER.name, target=HERE.name))


def pictured(html: str) -> tuple[int, int]:
    """The size of the one picture of a page that has no scripts and needs no other file."""
    assert "<script" not in html and "http" not in html
    (data,) = re.findall(r'<img [^>]*src="data:image/png;base64,([^"]+)"', html)
    image = Image.open(io.BytesIO(base64.b64decode(data)))
    assert len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)) > 50  # something is drawn
    return image.size


def some(kind: type, **given: Any) -> Any:
    """A result of which only what is shown is given."""
    made = object.__new__(kind)
    for name, value in given.items():
        object.__setattr__(made, name, value)
    return made


RESULTS = {
    "maps": PAIR,
    "garment": some(GarmentResult, shape=LARGER, pushed=np.arange(3), sunk=np.arange(2), maps=PAIR),
    "wrap": some(WrapResult, shape=LARGER, distance=np.full(HERE.V, 0.25), match=some(MatchResult, map=MAP)),
    "rig": some(
        RiggedResult, weights=SkinWeights(csr_array(np.eye(HERE.V, 2)), ("hip", "knee")), unused=("tail",), maps=PAIR,
        rig=some(meshmatch.api.rig.Rig, joints=np.arange(3), clips=()),
    ),
}  # fmt: skip
TOLD = {
    "maps": "0.75 on average",
    "garment": "3 pushed out, 2 below the skin",
    "wrap": "0.25 on average, 0.25 at most",
    "rig": "3, 1 of them without a vertex on the target",
}


@pytest.mark.parametrize("kind", RESULTS)
def test_a_result_shows_verdict_and_picture(kind: str) -> None:
    html = RESULTS[kind]._repr_html_()
    assert pictured(html) == (720, 420) and len(html) < 400_000
    assert "fair; a &lt; b" in html and TOLD[kind] in html
    assert html.count("<script>") == 0 and "&lt;script&gt;" in html


def test_values_that_arrived_show_the_map_and_what_is_missing() -> None:
    result = meshmatch.transfer_values(HERE, LARGER, HERE.verts[:, 1], MAP)
    html = result._repr_html_()
    assert pictured(html) == (720, 420) and f"of {HERE.V:,} values" in html


def test_a_match_shows_both_shapes_and_its_notes(monkeypatch: pytest.MonkeyPatch) -> None:
    fits = [some(Fit, repaired=some(meshmatch.shapes.repair.Repaired, original=shape)) for shape in (HERE, LARGER)]
    match = some(MatchResult, map=MAP, source_fit=fits[0], target_fit=fits[1], seconds=2.5, notes=("larger: a cube",))
    monkeypatch.setattr(MatchResult, "rotations", (None, None))
    html = match._repr_html_()
    assert pictured(html) == (720, 420) and "2.5 s" in html and "larger: a cube" in html
    object.__setattr__(match, "source_fit", some(Fit, repaired=None))  # as those that are read from files
    assert "<img" not in match._repr_html_() and "fair" in match._repr_html_()


def test_a_fit_shows_a_table() -> None:
    fit = some(
        Fit, repaired=None, model="human", partial=True, verdict="poor", reasons=("x < y",), trust=0.25, up="+y",
        front="+z", notes=("one", "two"),
    )  # fmt: skip
    html = fit._repr_html_()
    for words in ("human, fitted to a part", "poor; x &lt; y", "0.25", "up +y, front +z", "one; two"):
        assert words in html


def test_what_cannot_be_drawn_is_told_all_the_same() -> None:
    def draw() -> Any:
        raise InputError("no such image")

    assert "<img" not in result_html("a", {"b": "c", "empty": ""}, draw)
    assert result_html("a", {"b": "c", "empty": ""}, draw).count("<tr>") == 1
    assert pictured(result_html("a", {}, partial(compose_shapes, [(HERE, None)]))) == (720, 420)
