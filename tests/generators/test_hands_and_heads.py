"""Generated hands and heads: limits of joints and expressions, seeds, parts; where anny is installed, the shapes."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.errors import OptionError
from meshmatch.generators import rig as rigs
from meshmatch.generators.cutouts import boundary_loop
from meshmatch.generators.generator import Generator
from meshmatch.generators.hands import LIMITS, THUMB_LIMITS, HandAngles, draw_angles
from meshmatch.generators.heads import LIMITS as HEAD_LIMITS
from meshmatch.generators.heads import PARTS, Face, draw_turns
from meshmatch.generators.kinds import Kind
from meshmatch.models.registry import load_model
from meshmatch.training import aligner
from meshmatch.training.recipes import recipe_for
from meshmatch.training.train import train
from tests.generators.stick import seeded

needs_anny = pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny is not installed")


def within(values: torch.Tensor, limits: tuple[float, float]) -> bool:
    return bool((values >= limits[0] - 1e-4).all() and (values <= limits[1] + 1e-4).all())


def same(a: HandAngles, b: HandAngles) -> bool:
    return torch.equal(a.knuckle, b.knuckle) and torch.equal(a.wrist, b.wrist) and torch.equal(a.turn, b.turn)


def test_fingers_bend_within_the_limits_of_their_joints() -> None:
    angles = draw_angles(400, seeded())
    for name in ("knuckle", "spread", "middle", "tip", "wrist"):
        assert within(getattr(angles, name), LIMITS[name]), name
    for name, limits in THUMB_LIMITS.items():
        assert within(angles.thumb[name], limits), name
    flat, clenched = (angles.middle < 15).all(1), (angles.middle > 70).all(1)
    pointing = (angles.middle[:, 0] < 20) & (angles.middle[:, 1:] > 70).all(1)
    assert min(float(pose.float().mean()) for pose in (flat, clenched, pointing)) > 0.05
    assert same(angles, draw_angles(400, seeded()))
    assert not same(angles, draw_angles(400, seeded(1)))


def test_heads_turn_within_their_limits() -> None:
    turns = draw_turns(500, seeded())
    assert all(within(turns[:, axis], limits) for axis, limits in enumerate(HEAD_LIMITS))
    assert (turns.std(0) > 5).all()


def test_expressions_are_drawn_on_both_sides_or_on_one() -> None:
    names = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthClose")
    amounts = Face(torch.zeros(4, 1, 3), names, 1.0).draw(2000, seeded())
    assert within(amounts, (0.0, 1.0))
    jaw, left, right, never = amounts.T
    assert (never == 0).all()  # it goes with an open jaw alone
    assert 0.1 < float((jaw > 0).float().mean()) < 0.4
    winking = (left - right).abs() > 1e-6
    assert 0.02 < float(winking.float().mean()) < 0.5 * float((left > 0).float().mean())
    assert float((amounts.sum(1) == 0).float().mean()) > 0.3  # at rest


def test_there_are_no_other_kinds() -> None:
    with pytest.raises(OptionError, match="unknown kind 'foot'") as caught:
        Kind("foot")
    assert "hand" in caught.value.hint


@pytest.fixture(scope="module", params=["hand", "head"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Generator]:
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rigs, "home_folder", lambda kind: cache)
        yield Kind(request.param, 3).generator(0)


@needs_anny
def test_shapes_are_open_at_the_cut_alone(made: Generator) -> None:
    template = made.template
    faces = np.asarray(template.shape.faces)
    assert boundary_loop(faces).size > 8
    drawn = made.draw(6, seeded())
    assert drawn.shape == (6, template.shape.V, 3)
    assert torch.isfinite(drawn).all()
    assert torch.equal(drawn, made.draw(6, seeded()))
    assert not torch.equal(drawn, made.draw(6, seeded(1)))
    size = drawn.amax(1) - drawn.amin(1)
    assert 0.05 < float(size.min()) < float(size.max()) < 0.6  # metres


@needs_anny
def test_parts(made: Generator) -> None:
    template = made.template
    assert set(template.labels.tolist()) == set(range(len(template.label_names)))
    verts = template.shape.verts

    def place(part: str) -> np.ndarray:
        return verts[template.labels == template.label_names.index(part)].mean(0)

    if made.kind == "hand":  # a right one, its palm to the front
        assert len(template.label_names) == 2 + 5 * 3
        assert place("thumb tip")[0] > place("index tip")[0] > place("little finger tip")[0]
        assert place("middle finger tip")[1] > place("palm")[1] > place("wrist")[1]
    else:
        assert template.label_names == PARTS
        assert place("left ear")[0] > place("left eye")[0] > 0 > place("right eye")[0] > place("right ear")[0]
        assert place("scalp")[1] > place("nose")[1] > place("mouth")[1] > place("neck")[1]
        assert place("nose")[2] > place("left ear")[2]


@needs_anny
@pytest.mark.slow
def test_a_kind_is_trained_from_its_name(made: Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aligner, "_SHAPES", 32)
    recipe = recipe_for(kind=made.kind).changed(steps=2, workers=0, points=64, align_steps=2)
    folder = train(tmp_path / "mine", kind=Kind(made.kind, 3), recipe=recipe)
    model = load_model(folder)
    assert (model.card.category, model.card.steps) == (made.kind, 2)
    assert "3 generated people" in model.card.data
    assert model.template.hash == made.template.hash
