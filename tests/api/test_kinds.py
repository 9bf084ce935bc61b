"""`model="auto"`: the shapes decide, by readings of every installed model."""

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

import meshmatch
from meshmatch.api import kinds, matcher
from meshmatch.api.inputs import as_model, repair_or_raise
from meshmatch.api.kinds import Installed
from meshmatch.api.matcher import Matcher
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.fitting import classify
from meshmatch.fitting.fit_config import FitConfig, Partial
from meshmatch.fitting.judge import category
from meshmatch.fitting.judge.category import has_limbs
from meshmatch.models import registry
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"
CONFIG = FitConfig()
QUICK = FitConfig.quick(again=False, samples=2000)


def ball(name: str, *, opened: bool = False) -> Shape:
    """A closed surface, or half of one."""
    mesh = trimesh.creation.icosphere(3)
    faces = mesh.faces[mesh.triangles_center[:, 2] > 0] if opened else mesh.faces
    return Shape(mesh.vertices, faces, name)


def cloud(name: str) -> Shape:
    return Shape(ball(name).verts, np.empty((0, 3), np.int64), name)


@pytest.fixture
def models(monkeypatch: pytest.MonkeyPatch) -> list[TrainedModel]:
    """Two humans and an animal; what they read of a shape is in its name: "dog 9 9 2" for hundredths."""
    human, animal = as_model("human"), as_model("quadruped")
    twin = TrainedModel(replace(human.card, name="twin"), human.template, human.inference)
    known = [human, twin, animal]

    def read(models: list[TrainedModel], shapes: list[Shape], configs: Any) -> np.ndarray:
        return np.array([[float(word) / 100 for word in shape.name.split()[1:]] for shape in shapes]).T[: len(models)]

    monkeypatch.setattr(kinds, "installed_models", lambda: [Installed.loaded(model) for model in known])
    monkeypatch.setattr(kinds, "category_residuals", read)
    return known


@pytest.fixture
def poor_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """No model fits what reads strangely."""
    poor = SimpleNamespace(verdict="poor", trust=0.0, partial=False)
    monkeypatch.setattr(classify.Fitter, "fit", lambda *_: poor)


def choose(*shapes: Shape, settled: TrainedModel | None = None) -> tuple[str, list[str]]:
    choice = kinds.choose_model([repair_or_raise(shape) for shape in shapes], [QUICK] * len(shapes), settled)
    return choice.model.card.name, choice.notes


@pytest.mark.usefixtures("models")
def test_the_model_that_reads_all_shapes_best_is_chosen() -> None:
    assert choose(ball("man 3 4 6"), ball("boy 3 4 6")) == ("human", ["man 3 4 6: human", "boy 3 4 6: human"])
    assert choose(ball("man 3 2 6"), ball("boy 3 3.5 6"))[0] == "twin"  # by the sum
    assert choose(ball("dog 6 6 4")) == ("quadruped", ["dog 6 6 4: quadruped"])


@pytest.mark.usefixtures("models")
def test_two_kinds_are_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"man 3 4 6: human; dog 6 6 4: quadruped") as caught:
        choose(ball("man 3 4 6"), ball("dog 6 6 4"))
    assert "--model" in caught.value.hint and "--model none matches" in caught.value.hint
    # also where a model of one kind reads both low
    with pytest.raises(InputError, match="two kinds"):
        choose(ball("man 3 4 4.5"), ball("dog 6 6 4"))


def test_later_shapes_are_of_the_kind_before(models: list[TrainedModel]) -> None:
    assert choose(ball("boy 4 3 6"), settled=models[0])[0] == "human"
    with pytest.raises(InputError, match="the shapes before: human; dog 6 6 4: quadruped"):
        choose(ball("dog 6 6 4"), settled=models[0])


@pytest.mark.usefixtures("models", "poor_fits")
def test_a_complete_shape_of_no_kind_is_refused() -> None:
    with pytest.raises(InputError, match=r"chair 7 7 6 does not look like .*: human, quadruped") as caught:
        choose(ball("man 3 4 6"), ball("chair 7 7 6"))
    assert caught.value.hint.startswith(
        "nearest: quadruped, trust 0.00; if it is one, name the model: --model quadruped"
    )
    with pytest.raises(InputError) as caught:  # too strange for a fit
        choose(ball("man 3 4 6"), ball("robot 8 9 9"))
    assert caught.value.hint.startswith("nearest: human; if it is one, name the model: --model human")
    assert caught.value.hint.endswith("; --model none matches two shapes directly")
    with pytest.raises(InputError) as caught:  # one shape alone is matched to nothing
        choose(ball("robot 8 9 9"))
    assert "none" not in caught.value.hint


@pytest.mark.usefixtures("models")
def test_what_hardly_looks_like_the_other_shapes_kind_is_taken_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A character of a large head and short limbs, of which a poor fit still lies right."""

    def fits(trust: float) -> None:
        poor = SimpleNamespace(verdict="poor", trust=trust, partial=False, model="human")
        monkeypatch.setattr(classify.Fitter, "fit", lambda *_: poor)

    fits(0.4)
    name, words = choose(ball("toon 5.5 7 7"), ball("man 3 4 6"))
    assert name == "human" and words[1] == "man 3 4 6: human"
    assert words[0].startswith("toon 5.5 7 7 hardly looks like it (trust 0.40): treated as human; name the model")
    name, words = choose(
        ball("toon 5.5 7 7"), ball("toon 5.6 7 7")
    )  # neither is known, and both come nearest to people
    assert name == "human" and all("hardly looks like it" in word for word in words)
    for others in ((), (ball("dog 6 6 4"),), (ball("toon 7 7 5.5"),)):  # alone, or beside another kind, known or not
        with pytest.raises(InputError, match=r"toon 5\.5 7 7 does not look like"):
            choose(ball("toon 5.5 7 7"), *others)
    fits(0.2)
    for other in (ball("man 3 4 6"), ball("toon 5.6 7 7")):
        with pytest.raises(InputError, match=r"toon 5\.5 7 7 does not look like"):
            choose(ball("toon 5.5 7 7"), other)


@pytest.mark.parametrize(
    ("name", "verdict", "trust", "mesh", "points"),
    [
        ("human", "fair", 0.75, True, True),
        ("human", "fair", 0.65, True, False),  # a cloud may be an aeroplane's
        ("quadruped", "fair", 0.55, True, False),
        ("head", "fair", 0.65, False, False),  # what has no limbs is like much else
        ("head", "fair", 0.75, True, True),
        ("human", "poor", 0.95, False, False),
    ],
)
def test_a_fair_fit_tells_a_strange_mesh_if_the_template_has_limbs(
    monkeypatch: pytest.MonkeyPatch, name: str, verdict: str, trust: float, mesh: bool, points: bool
) -> None:
    fit = SimpleNamespace(verdict=verdict, trust=trust, partial=False)
    monkeypatch.setattr(classify.Fitter, "fit", lambda *_: fit)
    for shape, of_kind in ((ball("man"), mesh), (cloud("man"), points)):
        assert classify.classify(as_model(name), shape, 0.055, CONFIG, None) == (of_kind, fit)


def test_models_know_whether_they_have_limbs() -> None:
    found = {name: has_limbs(as_model(name)) for name in ("human", "quadruped", "hand", "head")}
    assert found == {"human": True, "quadruped": True, "hand": True, "head": False}


def test_a_fit_as_a_part_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = SimpleNamespace(verdict="good", trust=1.0, partial=True)
    monkeypatch.setattr(classify.Fitter, "fit", lambda *_: fit)
    for reading, known in ((0.048, True), (0.055, False)):
        assert classify.classify(as_model("human"), ball("half"), reading, CONFIG, None) == (known, fit)


@pytest.mark.usefixtures("models")
def test_a_part_of_an_uncertain_kind_is_called_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = SimpleNamespace(verdict="good", trust=1.0, partial=True)
    monkeypatch.setattr(classify.Fitter, "fit", lambda *_: fit)
    words = choose(ball("half 5.5 7 7", opened=True), ball("man 3 4 6"))[1]
    assert words[0].startswith("half 5.5 7 7 may be a part, or several objects: treated as human; name the model")
    assert "; --model none matches two shapes directly; " in words[0]


@pytest.mark.usefixtures("models")
def test_a_shape_that_is_said_to_be_a_part_is_not_fitted_to_tell_its_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(classify, "Fitter", None)
    part, config = repair_or_raise(ball("half 7 7 5.5", opened=True)), FitConfig(partial="yes")
    choice = kinds.choose_model([part, repair_or_raise(ball("man 3 4 6"))], [config] * 2)
    assert choice.model.card.name == "human" and "may be a part" in choice.notes[0]
    assert kinds.choose_model([part], [config]).model.card.name == "quadruped"  # alone, what reads it best


@pytest.mark.usefixtures("models")
def test_what_reads_strangely_is_of_the_kind_that_fits_it(monkeypatch: pytest.MonkeyPatch) -> None:
    dancer = load_shape(SAMPLES / "dancer.ply")
    strange = Shape(dancer.verts, dancer.faces, "robot 5.5 5.6 7")
    assert choose(strange) == ("human", ["robot 5.5 5.6 7: human"])
    unrefined = kinds.choose_model([repair_or_raise(strange)], [replace(QUICK, refine="none")])
    assert (unrefined.model.card.name, unrefined.fits) == ("human", [None])  # a refined fit is not what was asked for
    monkeypatch.setattr(matcher, "Fitter", None)  # what told the kind is not fitted again
    fit = Matcher(config=QUICK).fit(strange)
    assert fit.verdict == "good" and fit.repaired is not None
    for words in ("robot 7 7.1 7.2", "robot 7 7.1 5.5"):  # too strange; and no animal
        with pytest.raises(InputError, match="does not look like"):
            choose(Shape(dancer.verts, dancer.faces, words))
    with pytest.raises(InputError, match="does not look like"):  # read like a body, or nearly, but nothing fits it
        choose(ball("aeroplane 4.7 4.8 7"))


@pytest.mark.usefixtures("models")
def test_a_cloud_that_reads_strangely_is_of_the_kind_that_fits_it() -> None:
    dancer = load_shape(SAMPLES / "dancer.ply")
    for points, word in (
        (dancer.verts, "rough 5 5.6 7: human"),
        (ball("").verts, "may be a part, or a rough cloud: treated as human"),
    ):
        _, words = choose(Shape(points[::4], np.empty((0, 3), np.int64), "rough 5 5.6 7"))
        assert word in words[0]


@pytest.mark.usefixtures("models", "poor_fits")
@pytest.mark.parametrize("unsure", [cloud("half 7 7 6"), ball("half 7 7 6", opened=True)])
def test_what_may_be_a_part_takes_the_other_shapes_kind(unsure: Shape) -> None:
    for shapes in ((unsure, ball("man 3 4 6")), (ball("man 3 4 6"), unsure)):
        name, words = choose(*shapes)
        assert name == "human"
        why = "may be a part, or a rough cloud" if unsure.is_cloud else "may be a part, or several objects"
        assert words[shapes.index(unsure)].startswith(f"half 7 7 6 {why}: treated as human")
        assert ("--without" in words[shapes.index(unsure)]) is not unsure.is_cloud
    assert choose(unsure)[0] == "quadruped"  # alone, what reads it best


def asked(monkeypatch: pytest.MonkeyPatch, shapes: list[Shape], partial: Partial = "auto") -> list[str]:
    """Which models are asked about which shapes, where three are installed and one is the user's own."""
    calls: list[str] = []

    def read(model: Any, shape: Shape, *_: Any) -> float:
        name, *words = shape.name.split()
        calls.append(f"{model} {name}")
        return float(words[["human", "quadruped", "own"].index(model)]) / 100

    monkeypatch.setattr(category, "category_residual", read)
    cards = {name: as_model(name).card for name in ("human", "quadruped")}
    cards["own"] = replace(cards["quadruped"], name="own", category="ape")
    models = [Installed(card, lambda name=name: name, name != "own") for name, card in cards.items()]
    kinds.category_residuals(models, shapes, [FitConfig(partial=partial)] * len(shapes))
    return sorted(calls)


def test_who_is_sure_needs_no_other_built_in_model(monkeypatch: pytest.MonkeyPatch) -> None:
    assert asked(monkeypatch, [ball("man 3 7 7"), ball("boy 3 7 7")]) == ["human boy", "human man", "own man"]
    assert asked(monkeypatch, [ball("man 4.5 7 7")]) == ["human man", "own man", "quadruped man"]
    assert asked(monkeypatch, [ball("ape 7 7 3"), ball("kong 7 7 3")]) == ["human ape", "own ape", "own kong"]


def test_a_whole_shape_decides_before_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    half = ball("half 6 6 6", opened=True)
    for shapes in ([half, ball("man 3 7 7")], [ball("man 3 7 7"), half]):
        assert asked(monkeypatch, shapes, "yes") == ["human half", "human man", "own man"]
    # of two with a boundary the one that lacks less
    holed = Shape(half.verts, ball("").faces[trimesh.creation.icosphere(3).triangles_center[:, 2] > -0.7], "man 3 7 7")
    for shapes in ([half, holed], [holed, half]):
        assert asked(monkeypatch, shapes, "yes") == ["human half", "human man", "own man"]
    # a cloud may be of another kind
    found = asked(monkeypatch, [cloud("rough 6 6 6"), ball("man 3 7 7")])
    assert found == ["human man", "human rough", "own man", "own rough", "quadruped rough"]


def test_samples_are_told_apart() -> None:
    names = "climber", "dancer", "calf", "fox"
    shapes = [repair_or_raise(meshmatch.load_shape(SAMPLES / f"{name}.ply")).shape for name in names]
    models = [Installed.loaded(as_model(name)) for name in ("human", "quadruped")]
    found = kinds.category_residuals(models, shapes, [CONFIG] * 4)
    assert (found[0, :2] < 0.042).all() and found[1, 0] > 0.05
    assert found[1, 1] == np.inf  # the dancer is what the climber is: nobody else was asked
    assert (found[1, 2:] < 0.046).all() and (found[0, 2:] > 0.05).all()
    told = kinds.classify_shapes(models, found, shapes, [CONFIG] * 4)
    assert [each.kind for each in told] == ["human", "human", "quadruped", "quadruped"]
    # the same turned and scaled: a reading knows no up
    turned = Shape(7 * shapes[2].verts[:, [2, 0, 1]], shapes[2].faces, "turned")
    (again,) = kinds.category_residuals(models[1:], [turned], [CONFIG])
    assert abs(again[0] - found[1, 2]) < 0.004


def test_hands_and_heads_are_told_apart() -> None:
    models = kinds.installed_models()
    for name, kind in (("waving", "hand"), ("pointing", "hand"), ("laughing", "head"), ("child", "head")):
        shape = repair_or_raise(meshmatch.load_shape(SAMPLES / f"{name}.ply")).shape
        readings = kinds.category_residuals(models, [shape], [CONFIG])
        assert kinds.classify_shapes(models, readings, [shape], [CONFIG])[0].kind == kind, name
        own = [model.card.category for model in models].index(kind)
        assert np.delete(readings[:, 0], own).min() > readings[own, 0] + 0.005, name


def test_a_ring_is_of_no_kind() -> None:
    ring = trimesh.creation.torus(1.0, 0.3)
    with pytest.raises(InputError, match="ring does not look like"):
        meshmatch.register(Shape(ring.vertices, ring.faces, "ring"))


@pytest.mark.usefixtures("models")
def test_a_matcher_decides_with_its_first_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    matcher = Matcher()
    with pytest.raises(OptionError, match="no model is chosen yet"):
        _ = matcher.model
    monkeypatch.setattr(matcher, "_fit_all", lambda clean, *_: [_Fit() for _ in clean])
    (fit,) = matcher.fit_all([ball("dog 6 6 4")])
    assert fit.notes == ("dog 6 6 4: quadruped", "of the fit")
    assert matcher.model.card.name == "quadruped"
    with pytest.raises(InputError, match="the shapes before: quadruped; man 3 4 6: human"):
        matcher.fit(ball("man 3 4 6"))
    assert Matcher("human").model.card.name == "human"


@dataclass(frozen=True)
class _Fit:
    notes: tuple[str, ...] = ("of the fit",)


def test_a_device_that_is_not_there_is_said() -> None:
    """It is true of all models: none of them is damaged."""
    with pytest.raises(OptionError, match=r"device 'gpu' cannot be used$") as caught:
        meshmatch.match(ball("man 3 4 6"), ball("boy 3 4 6"), config=FitConfig(device="gpu"))
    assert "use cpu" in caught.value.hint


def test_damaged_models_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(registry.HOME_VARIABLE, str(tmp_path))
    (tmp_path / "models" / "broken").mkdir(parents=True)
    assert [model.card.name for model in kinds.installed_models()] == ["hand", "head", "human", "quadruped"]
    monkeypatch.setattr(kinds, "list_models", lambda: ())
    with pytest.raises(ModelError, match="no model is installed"):
        kinds.installed_models()


def test_animals_are_told_before_the_rarer_kinds_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    cards = {name: as_model(name).card for name in ("hand", "head", "human", "quadruped")}
    models = [Installed(card, lambda name=name: name, True) for name, card in cards.items()]

    def asked(name: str, known: str) -> list[str]:
        calls.clear()
        monkeypatch.setattr(
            category, "category_residual", lambda model, *_: calls.append(model) or (0.03 if model == known else 0.07)
        )
        found = kinds.category_residuals(models, [ball(name)], [CONFIG])
        assert [*cards][int(found.argmin())] == known
        return calls

    assert asked("dancer", "human") == ["human"]
    assert asked("calf", "quadruped") == ["human", "quadruped", "hand"]  # two at a time
    assert asked("waving", "hand") == ["human", "quadruped", "hand"]
    assert asked("laughing", "head") == ["human", "quadruped", "hand", "head"]


def test_a_folder_of_two_kinds_is_told(tmp_path: Path) -> None:
    (tmp_path / "bad.ply").write_bytes(b"ply")
    files = {name: SAMPLES / f"{name}.ply" for name in ("calf", "dancer", "fox")} | {"bad": tmp_path / "bad.ply"}
    found = kinds.kinds_of(files)
    assert found == {"calf": "quadruped", "dancer": "human", "fox": "quadruped", "bad": None}
    (note,) = kinds.kind_notes(found, tmp_path)
    assert note.startswith("these seem to be 2 kinds of shapes: quadruped (calf, fox); human (dancer);")


def test_of_many_files_some_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kinds, "category_residuals", lambda models, *_: np.full((len(models), 1), 0.03))
    for count, read in ((3, 3), (40, 40), (79, 40), (119, 40)):
        found = list(kinds.kinds_of({f"{k}.ply": SAMPLES / "calf.ply" for k in range(count)}))
        assert len(found) == read
        assert (found[0], found[-1]) == ("0.ply", f"{count - 1}.ply")


def test_a_folder_that_a_model_knows_is_told() -> None:
    (note,) = kinds.kind_notes({"a.ply": "hand", "b.ply": None, "c.ply": "hand"}, Path("my hands"))
    assert note.startswith("the model hand knows these shapes: to begin with it, `meshmatch fit 'my hands' -o fits`")
    assert kinds.kind_notes({"a.ply": "hand", "b.ply": None}, Path("mine")) == []
    assert kinds.kind_notes({"a.ply": None}, Path("mine")) == []
    odd = {f"{k}.ply": "hand" for k in range(20)} | {"odd.ply": "head"}  # one of many is more likely misread
    assert kinds.kind_notes(odd, Path("mine"))[0].startswith("the model hand knows")
