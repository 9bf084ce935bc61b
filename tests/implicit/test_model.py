"""Models come back as they were, or not at all; their surfaces are closed, and their maps go through the template."""

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("skimage", reason="scikit-image is of the extra `implicit`")

from meshmatch.errors import MeshmatchError, ModelError, OptionError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.triangles import is_watertight
from meshmatch.implicit.codes import fit_implicit, nearest_code
from meshmatch.implicit.fit import ImplicitFit
from meshmatch.implicit.model import ImplicitModel, load_implicit, nearest_on_template
from meshmatch.implicit.training import train_implicit
from meshmatch.models.card import IMPLICIT, is_implicit, read_implicit_card
from meshmatch.models.registry import WEIGHTS
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from tests.implicit.boxes import TRAIN, box, box_sdf, config


@pytest.fixture(scope="module")
def model(learned: Path) -> ImplicitModel:
    return load_implicit(learned)


def sides(shape: Shape) -> np.ndarray:
    return np.ptp(shape.verts, axis=0)


def test_surfaces_are_closed_and_in_the_files_frame(model: ImplicitModel, folder: Path) -> None:
    truth = load_shape(folder / "box1.ply")
    found = model.surface(model.known("box1"), resolution=32)
    assert is_watertight(found.faces)
    corners = found.verts[found.faces]
    assert (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum() > 0  # outwards
    assert np.abs(found.bounds - truth.bounds).max() < 0.25 * truth.diagonal
    half_way = model.surface(model.blend(model.known("box0"), model.known("box1"), 0.5), 32)
    assert is_watertight(half_way.faces)
    with pytest.raises(OptionError, match="no shape"):
        model.known("nobody")
    with pytest.raises(OptionError, match="even"):
        model.surface(model.known("box0"), resolution=33)


def test_a_blend_ends_at_both_shapes(model: ImplicitModel) -> None:
    a, b = model.known("box0"), model.known("box2")
    for time, end in ((0, a), (1, b)):
        found = model.blend(a, b, time)
        assert np.allclose(found.code, end.code)
        assert found.frame.scale == pytest.approx(end.frame.scale)
        assert np.allclose(found.frame.center, end.frame.center)


def test_maps_go_through_the_template(model: ImplicitModel, folder: Path) -> None:
    a, b = (load_shape(folder / f"box{k}.ply") for k in (0, 1))
    one, other = model.known("box0"), model.known("box1")
    found = model.match(one, other, a, b)
    assert (found.source_vertices, found.target_vertices) == (a.V, b.V)
    same = model.match(one, one, a, a)
    assert np.array_equal(same.index, np.arange(a.V))
    assert same.confidence.min() == 1
    assert np.array_equal(np.sign(b.verts[found.index]), np.sign(a.verts))  # corner to corner


def test_normals_tell_the_sides_of_a_board() -> None:
    """Nearer on the template, but facing the other way."""
    down, up = np.array([[0, -1.0, 0]]), np.array([[0, 1.0, 0]])
    source, target = np.array([[0, 0.02, 0]]), np.array([[0, 0.03, 0], [0, 0.0, 0]])
    assert nearest_on_template(source, target, 0 * up, np.zeros((2, 3))) == [0]
    assert nearest_on_template(source, target, down, np.concatenate([up, down])) == [1]


def test_an_unseen_shape_finds_its_code(model: ImplicitModel, tmp_path: Path) -> None:
    half = np.array([0.8, 0.35, 0.6])
    moved = Shape(3 * box(half).verts + 5, box(half).faces, "unseen")
    first = fit_implicit(model, moved, steps=1)
    found = fit_implicit(model, moved, steps=120)
    assert found.residual < min(0.8 * first.residual, 3)
    assert np.abs(sides(model.surface(found, 32)) / sides(moved) - 1).max() < 0.3
    again = fit_implicit(model, moved, steps=1)
    assert np.array_equal(first.code, again.code)
    assert (first.verdict == "good") == (not first.reasons)
    # the same from given distances
    points = np.random.default_rng(0).uniform(-1.3, 1.3, (20_000, 3))
    np.savez(tmp_path / "unseen.npz", points=points, distances=box_sdf(points, half))
    given = fit_implicit(model, tmp_path / "unseen.npz", steps=120)
    assert given.residual < 3
    with pytest.raises(OptionError, match="steps"):
        fit_implicit(model, moved, steps=0)


def test_a_shape_that_stands_otherwise_is_turned(tmp_path: Path) -> None:
    """A plane whose wings lie along z in its file; after its turn all is as it is for the same plane as it should stand."""
    axes = (1, 2, 0)

    def plane(span: float) -> tuple[np.ndarray, np.ndarray]:
        points = np.random.default_rng(int(1000 * span)).uniform(-1.1, 1.1, (20_000, 3))
        parts = [((1, 0, 0), (span, 0.1, 0.2)), ((0, 0, 0), (0.15, 0.15, 1)), ((0, 0.3, -0.8), (0.1, 0.4, 0.2))]
        found = [box_sdf(points - np.array(middle) * (0, 1, 1), np.array(half)) for middle, half in parts]
        return points, np.min(found, axis=0)

    folder = tmp_path / "planes"
    folder.mkdir()
    for number, span in enumerate((0.7, 0.8, 0.9)):
        points, distances = plane(span)
        np.savez(folder / f"plane{number}.npz", points=points, distances=distances)
    training = replace(TRAIN, steps=150, rate=3e-3, average=0.9)
    model = load_implicit(train_implicit(tmp_path / "m", folder, config=config("mls"), training=training))
    points, distances = plane(0.85)
    files = [tmp_path / name for name in ("as-they.npz", "turned.npz")]
    np.savez(files[0], points=points, distances=distances)
    np.savez(files[1], points=points[:, axes], distances=distances)
    as_they, turned = (fit_implicit(model, file, steps=5) for file in files)
    assert as_they.notes == ()
    assert np.array_equal(as_they.frame.rotation, np.eye(3))
    assert len(turned.notes) == 1
    assert np.allclose(turned.frame.apply(points[:, axes]), as_they.frame.apply(points))
    between = model.blend(as_they, turned, 0.5).frame
    assert np.allclose(between.rotation @ between.rotation, turned.frame.rotation)
    found = model.register(turned, 32)
    assert np.argmax(np.ptp(found.verts, axis=0)) == axes.index(2)  # the fuselage


def test_a_code_is_searched_as_its_model_was_trained(model: ImplicitModel) -> None:
    """By its terms, in steps of the length of its codes."""
    shape = box(np.array([0.8, 0.35, 0.6]))
    usual = fit_implicit(model, shape, steps=1).code
    published = ImplicitModel(replace(model.card, recipe={"loss": {"published": True}}), model.network)
    assert not torch.equal(fit_implicit(published, shape, steps=3).code, fit_implicit(model, shape, steps=3).code)
    short = deepcopy(model.network)
    short.config = replace(short.config, length=0.01 * short.config.length)
    moved = fit_implicit(ImplicitModel(model.card, short), shape, steps=1).code
    start = min(model.network.codes.detach(), key=lambda code: float((code - moved).norm()))
    assert 0 < (moved - start).abs().max() < 0.02 * (usual - start).abs().max()


def test_what_a_model_invents_is_told(model: ImplicitModel) -> None:
    whole = box(np.array([0.8, 0.35, 0.6]), "whole")
    half = Shape(whole.verts, whole.faces[whole.verts[whole.faces].mean(1)[:, 0] < 0.1], "half")
    assert 0 < half.F < whole.F
    found = {shape.name: fit_implicit(model, shape, steps=120) for shape in (whole, half)}
    assert found["whole"].invented < 0.15  # 0.04 to 0.06, by processor: the training is short
    assert found["half"].invented > 0.3
    assert found["half"].verdict == "poor"
    assert "of the model's surface is over" in " ".join(found["half"].reasons)


def test_a_fit_is_as_good_as_its_worst_number() -> None:
    fit = ImplicitFit("one", torch.zeros(2), Frame(1.0, np.eye(3), np.zeros(3)))
    assert (fit.verdict, fit.reasons) == ("unknown", ())
    for numbers, verdict, count in (
        ({"residual": 1.0}, "good", 0),
        ({"residual": 1.0, "missed": 0.01, "invented": 0.05}, "fair", 1),
        ({"residual": 3.0, "missed": 0.2, "invented": 0.05}, "poor", 3),
    ):
        judged = replace(fit, **numbers)
        assert (judged.verdict, len(judged.reasons)) == (verdict, count)


def test_the_template_comes_onto_a_shape(model: ImplicitModel, monkeypatch: pytest.MonkeyPatch) -> None:
    rest = model.template(32)
    inside = (np.abs(rest.verts) < 0.8).all(1)  # away from the cube's sides, where points are held
    for name in ("box0", "box1"):
        shape = model.known(name)
        found = model.register(shape, 32)
        assert np.array_equal(found.faces, rest.faces)
        away, _ = model.distance(shape.frame.apply(found.verts), shape.code)
        assert np.abs(away).mean() < 0.01  # on the surface
        with monkeypatch.context() as patch:
            patch.setattr("meshmatch.implicit.model._PROJECTION_STEPS", 0)
            places = model.to_template(model.register(shape, 32).verts, shape)
        assert np.linalg.norm(places - rest.verts, axis=1)[inside].max() < 1e-3  # of the vertex's own place


def test_a_descent_begins_with_the_nearest_shape_of_the_training(model: ImplicitModel, folder: Path) -> None:
    drawn = sample_surface(load_shape(folder / "box2.ply"), 400, np.random.default_rng(0)).points
    rows = np.column_stack([model.known("box2").frame.apply(drawn), np.zeros((400, 4))])
    found = nearest_code(model, torch.from_numpy(rows.astype(np.float32)))
    assert torch.equal(found, model.known("box2").code)


def test_models_come_back_as_they_were(learned: Path) -> None:
    a, b = load_implicit(learned), load_implicit(learned)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert np.array_equal(a.distance(points, a.known("box0").code)[0], b.distance(points, b.known("box0").code)[0])
    assert is_implicit(learned)
    card = read_implicit_card(learned)
    assert card.shapes == ["box0", "box1", "box2", "box3"]
    assert card.steps == 120


def damaged(learned: Path, folder: Path, change: dict[str, object]) -> Path:
    folder.mkdir()
    card = json.loads((learned / IMPLICIT).read_text())
    card["network"] |= change.pop("network", {})
    (folder / IMPLICIT).write_text(json.dumps(card | change))
    (folder / WEIGHTS).write_bytes((learned / WEIGHTS).read_bytes())
    return folder


@pytest.mark.parametrize(
    "change",
    [
        {"schema": 2},
        {"unheard": 1},
        {"steps": "many"},
        {"name": "../up"},
        {"shapes": ["box0"]},
        {"shapes": ["a", "a", "a", "a"]},
        {"frames": [[0, 0, 0, 0]] * 4},
        {"frames": [["x"]] * 4},
        {"frames": 7},
        {"weights_sha256": 64 * "0"},
        {"network": {"width": 10**9}},
        {"network": {"width": -1}},
        {"network": {"layers": 10**9}},
        {"network": {"maker": 10**9}},
        {"network": {"length": "far"}},
        {"network": {"length": 0.0}},
        {"network": {"length": 101.0}},
        {"network": {"length": float("nan")}},
        {"network": {"code": "8"}},
        {"network": {"code": 9}},
        {"network": {"unheard": 1}},
        {"network": {"field": "pointwise"}},
        {"network": {"frequency": "fast"}},
        {"network": {"kernel": "unknown"}},
        {"network": {"field": "unknown"}},
    ],
    ids=str,
)
def test_hostile_cards_are_told_in_a_line(learned: Path, tmp_path: Path, change: dict[str, object]) -> None:
    with pytest.raises(ModelError) as caught:
        load_implicit(damaged(learned, tmp_path / "bad", dict(change)))
    assert caught.value.hint


def test_hostile_files_are_told_in_a_line(learned: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no implicit model"):
        load_implicit(tmp_path)
    bad = damaged(learned, tmp_path / "bad", {})
    for content in (b"", b"{", b"[" * 100_000, b"\x00" * 100, b"[]", b"1" * 2_000_000):
        (bad / IMPLICIT).write_bytes(content)
        with pytest.raises(ModelError):
            load_implicit(bad)
    weights = (learned / WEIGHTS).read_bytes()
    for content in (b"", weights[:-10], weights[:100]):
        (bad / WEIGHTS).write_bytes(content)
        (bad / IMPLICIT).write_bytes((learned / IMPLICIT).read_bytes())
        with pytest.raises(MeshmatchError):
            load_implicit(bad)
