"""Many bodies: what is counted, and that each search sees the same ones."""

from collections.abc import Iterator, Sequence
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from meshmatch.api.matcher import Matcher
from meshmatch.experiments.bench import many_bodies
from meshmatch.experiments.bench.many_bodies import error_of, main, row_of
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, read_template


def test_an_error_is_in_centimetres_of_a_person_whatever_the_unit() -> None:
    template = read_template("human-T")
    places = 1000 * template.shape.verts
    aside = np.array([1000 * 0.1 * np.sqrt(template.shape.area), 0, 0])
    off = SimpleNamespace(points_in_file=places + aside)
    assert abs(error_of(off, places, template) - 0.1 * CM_PER_UNIT) < 1e-6  # type: ignore[arg-type]
    row = row_of("all", [(1.0, "good"), (9.0, "poor"), (2.0, "good")], 3.0, 6.0)
    assert (row["cpu"], row["wall"], row["mean"], row["median"]) == (1.0, 2.0, 4.0, 2.0)
    assert (row["off"], row["good"], row["fair"], row["poor"]) == (1 / 3, 2, 0, 1)


def test_bodies_have_about_as_many_vertices_as_is_said_and_lie_where_they_are_said_to(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The body at rest, whose dense mesh is decimated: the template's vertices lie on it."""
    template = read_template("human-T")
    rest = torch.tensor(template.dense.verts, dtype=torch.float32)
    rig = SimpleNamespace(restricted=lambda keep, faces: rest[torch.from_numpy(keep)])
    monkeypatch.setattr(many_bodies, "cached_rig", lambda *_: rig)
    monkeypatch.setattr(many_bodies, "sample_bodies", lambda drawn, count, _: drawn.expand(count, -1, -1))
    (both,) = many_bodies.bodies(template, 2, 0)
    for shape, places in both:
        assert abs(shape.V - many_bodies.VERTICES) < 100
        assert cKDTree(shape.verts).query(places)[0].max() < 0.05 * np.sqrt(shape.area)
        assert abs(Shape(places, template.shape.faces).area / shape.area - 1) < 0.02
    assert np.ptp(both[0][1] - both[1][1], axis=0).max() > 0.1  # turned each its own way


def test_both_searches_fit_the_same_bodies(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[FitConfig, list[int]]] = []

    def bodies(template: Template, count: int, seed: int) -> Iterator[list[many_bodies.Body]]:
        for number in range(count):
            yield [(Shape(template.shape.verts + number, template.shape.faces), template.shape.verts)]

    def fit_all(self: Matcher, shapes: Sequence[Shape]) -> list[SimpleNamespace]:
        seen.append((self.config, [shape.hash for shape in shapes]))  # type: ignore[misc]
        return [SimpleNamespace(points_in_file=shape.verts, verdict="good") for shape in shapes]

    monkeypatch.setattr(many_bodies, "bodies", bodies)
    monkeypatch.setattr(Matcher, "fit_all", fit_all)
    monkeypatch.setattr(Matcher, "fit", lambda self, shape: None)
    assert main(["--bodies", "2"]) == 0
    configs, shapes = zip(*seen, strict=True)
    assert configs == 2 * (FitConfig(), FitConfig.quick()) and shapes[0] == shapes[1] != shapes[2] == shapes[3]
