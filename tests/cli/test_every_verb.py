"""What all verbs that match or register have in common; and a few options that no other test passes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.api import interpolation, matching
from meshmatch.errors import InputError, OutputError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.files import save_map
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import FakeMatching, Run, nearest_map, refused

ROOT = Path(__file__).resolve().parents[2]
PAIR = {
    "match": ("map.npy",),
    "view": ("page.html",),
    "transfer-color": ("out.ply",),
    "transfer-labels": ("out.txt", "--labels", "labels.txt"),
    "transfer-weights": ("out.npz", "--weights", "weights.json"),
    "transfer-landmarks": ("out.csv", "--landmarks", "points.txt"),
    "measure": ("out.csv", "--landmarks", "points.txt", "--measurements", "what.csv"),
    "transfer-texture": ("out.glb", "--size", "32", "--samples", "1"),
    "transfer-garment": ("out.obj",),
    "transfer-shapes": ("out.npz", "--shapes", "moved.ply"),
    "wrap": ("out.obj",),
}
"""Verbs of two shapes: the output, and what else each needs."""
EVERY = PAIR | {"register": ("fitted.ply",)}
FIRST = {"transfer-garment": ("worn.ply",)}
"""What some verbs want before the shapes."""
SHARED: list[tuple[tuple[str, ...], dict[str, Any], dict[str, Any]]] = [
    *((("--refine", name), {"refine": name}, {"refine": name}) for name in ("none", "latent")),
    *((("--up", axis), {"up": axis.lower()}, {"up": axis.lower()}) for axis in ("x", "-z", "Y")),
    (("--front", "-y"), {"front": "-y"}, {"front": "-y"}),
    *((("--mirror", word), {"mirror": word}, {"mirror": word}) for word in ("auto", "no")),
    (("--try-harder",), {"try_harder": True}, {"try_harder": True}),
    (("--seed", "7"), {"seed": 7}, {"seed": 7}),
    (("--device", "cuda"), {"device": "cuda"}, {"device": "cuda"}),
    (("--partial",), {"partial": "yes"}, {"partial": "yes"}),
    (("--whole",), {"partial": "no"}, {"partial": "no"}),
    (("--source-up", "z"), {"up": "z"}, {}),
    (("--target-up", "Z", "--up", "y"), {"up": "y"}, {"up": "z"}),
    (("--source-front", "x", "--target-front", "-x"), {"front": "x"}, {"front": "-x"}),
]
"""Options, and what they change for the source and for the target."""
ALL = "--refine latent --up x --source-front y --target-front -z --mirror no --seed 7 --device cuda --partial"
CHOSEN = {"refine": "latent", "up": "x", "mirror": "no", "seed": 7, "device": "cuda", "partial": "yes"}
TOGETHER = [(ALL.split(), CHOSEN | {"front": "y"}, CHOSEN | {"front": "-z"})]


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sphere: Shape, torus: Shape) -> Path:
    """Two colored shapes, and everything that verbs want beside them."""
    monkeypatch.chdir(tmp_path)
    save_shape("worn.ply", Shape(1.1 * sphere.verts, sphere.faces, "worn"))
    save_shape("moved.ply", Shape(sphere.verts + 0.1, sphere.faces, "moved"))
    for name, shape in (("a.ply", sphere), ("b.ply", torus)):
        save_shape(name, Shape(shape.verts, shape.faces, name, np.full((shape.V, 4), 0.5)))
    Path("labels.txt").write_text("1\n" * sphere.V)
    Path("weights.json").write_text(json.dumps({"weights": [[1.0]] * sphere.V}))
    Path("points.txt").write_text("0\n5\n")
    Path("what.csv").write_text("far,distance,0,1\n")
    Path("pairs.txt").write_text("0 10\n5 11\n")
    return tmp_path


@pytest.mark.parametrize("verb", PAIR)
def test_shared_options_reach_the_matching(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    output, *rest = PAIR[verb]
    for words, source, target in SHARED if verb == "match" else TOGETHER:
        answer = run(verb, *FIRST.get(verb, ()), "a.ply", "b.ply", "-o", output, *rest, *words)
        assert answer.status == 0, answer.err
        assert stub.called["config"] == (FitConfig(**source), FitConfig(**target)), words
        assert (stub.called["landmarks"], stub.called["threads"]) == (None, 2)
    pairs = "--pairs" if verb in ("transfer-landmarks", "measure") else "--landmarks"
    more = (pairs, "pairs.txt", "--threads", "3", "--model", "./model")
    (files / "model").mkdir()
    assert run(verb, *FIRST.get(verb, ()), "a.ply", "b.ply", "-o", output, *rest, *more).status == 0
    assert [list(side) for side in stub.called["landmarks"]] == [[0, 5], [10, 11]]
    assert (stub.called["threads"], stub.called["model"]) == (3, "./model")


def call(verb: str, *more: str, output: str = "") -> list[str]:
    """The words of a verb that would go well; another ``output`` has the suffix that the verb wants in place of {}."""
    usual, *rest = EVERY[verb]
    output = output.format(Path(usual).suffix) or usual
    shapes = ["a.ply", "b.ply"][: 1 if verb == "register" else 2]
    return [verb, *FIRST.get(verb, ()), *shapes, "-o", output, *rest, *more]


# Words, those of the message, and the verbs that have no such option.
WRONG: list[tuple[str, str, tuple[str, ...]]] = [
    ("--up y --front -y", "along one axis", ()),
    ("--up y --target-front -y", "along one axis", ("register",)),
    ("--model humna", "did you mean human?", ()),
    ("-o nowhere/out{}", "there is no folder nowhere", ()),
    ("-o folder{}", "is a folder", ()),
    ("-o out.bad", ".bad", ()),
    ("-o out", "", ("transfer-shapes",)),  # a name without a suffix
    ("--picture p.jpg", "a picture is a PNG", ("view",)),
    ("--picture nowhere/p.png", "there is no folder nowhere", ("view",)),
    ("--picture folder.png", "is a folder", ("view",)),
    ("--map in{} -o in{}", "is an input of this command", ("match", "register", "wrap")),
    ("--map gone.npz", "there is no file gone.npz", ("match", "register", "wrap")),
    ("--map back.npz", "runs the wrong way", ("match", "register", "wrap")),
    ("--map other.npz", "made for another target", ("match", "register", "wrap")),
    ("--map short.npy", "made for another source", ("match", "register", "wrap")),
    ("--map broken.npz", "does not hold arrays", ("match", "register", "wrap")),
    ("--map m.xyz", "is not a format for maps", ("match", "register", "wrap")),
    *(
        (f"--map ab.npz {words}", f"{words.split()[0]} does not go with --map", ("match", "register", "wrap"))
        for words in (
            "--model human",
            "--refine none",
            "--partial",
            "--source-up y",
            "--target-front x",
            "--mirror no",
            "--only 1",
            "--try-harder",
        )
    ),
]


@pytest.mark.parametrize("verb", EVERY)
def test_what_cannot_be_is_told_before_the_work(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    """In a line and a hint, with nothing written and no input replaced."""
    a, b = load_shape("a.ply"), load_shape("b.ply")
    suffix = Path(EVERY[verb][0]).suffix
    for name in (f"folder{suffix}", "folder.png"):
        Path(name).mkdir()
    save_map("ab.npz", nearest_map(a, b))
    save_map("back.npz", nearest_map(b, a))
    save_map("other.npz", nearest_map(a, Shape(2 * a.verts, a.faces, "c")))
    np.save("short.npy", np.arange(7))
    Path("broken.npz").write_bytes(b"PK")
    Path("m.xyz").write_text("0\n")
    Path(f"in{suffix}").write_bytes(Path("ab.npz").read_bytes())
    before = {path: path.read_bytes() for path in files.iterdir() if path.is_file()}
    for text, told, without in WRONG:
        if verb in without:
            continue
        words = call(verb, *text.replace("{}", suffix).split())
        if "-o" in text.split():
            del words[words.index("-o") : words.index("-o") + 2]
        refused(run(*words), told, files, {path.name for path in files.iterdir()})
    assert stub.called == {}
    assert before == {path: path.read_bytes() for path in files.iterdir() if path.is_file()}


@pytest.mark.parametrize(
    ("source", "words"), [("a.ply", "register a.ply -o a.ply"), ("c.npy", "match c.npy b.ply -o ./c.npy")]
)
def test_no_shape_is_overwritten(run: Run, files: Path, stub: FakeMatching, source: str, words: str) -> None:
    np.save("c.npy", np.eye(3))
    refused(run(*words.split()), "is an input of this command", files, {path.name for path in files.iterdir()})
    assert stub.called == {}


@pytest.mark.parametrize("verb", EVERY)
def test_a_poor_result_is_a_warning_or_an_error(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    stub.verdict, stub.reasons = "poor", ("an arm is missing",)
    before = {path.name for path in files.iterdir()}
    refused(run(*call(verb, "--strict")), "an arm is missing", files, before)
    answer = run(*call(verb, "--quiet"))
    assert (answer.status, answer.out) == (0, "")
    assert f"warning: the {'fit' if verb == 'register' else 'map'} is poor: an arm is missing\n" in answer.err
    stub.verdict = "fair"
    answer = run(*call(verb, "--strict"))
    assert answer.status == 0 and "note: an arm is missing" in answer.err
    stub.verdict = "good"
    answer = run(*call(verb, "--strict", "--quiet"))
    assert (answer.status, answer.out, answer.err) == (0, "", "")


@pytest.mark.parametrize("verb", EVERY)
@pytest.mark.parametrize("error", [InputError("a bad file"), KeyboardInterrupt()])
def test_a_failure_leaves_what_was_there(
    run: Run, files: Path, monkeypatch: pytest.MonkeyPatch, verb: str, error: BaseException
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(matching, "match", failing)
    monkeypatch.setattr(matching.Matcher, "fit_all", failing)
    output = Path(EVERY[verb][0])
    output.write_bytes(b"old")
    before = {path.name for path in files.iterdir()}
    assert run(*call(verb)).status == (1 if isinstance(error, InputError) else 130)
    assert output.read_bytes() == b"old"
    assert {path.name for path in files.iterdir()} == before


@pytest.mark.parametrize("verb", PAIR)
def test_files_of_one_name_are_told_apart(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    Path("other").mkdir()
    Path("other/a.ply").write_bytes(Path("b.ply").read_bytes())
    words = call(verb, "--json")
    words[words.index("b.ply")] = "other/a.ply"
    record = run(*words).record
    assert (record["source"], record["target"]) == ("a.ply", "other/a.ply")


@pytest.mark.parametrize("verb", EVERY)
def test_the_keys_that_verbs_share_are_on_the_page(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    page = (ROOT / "docs" / "reference" / "cli.md").read_text(encoding="utf-8")
    record = run(*call(verb, "--json")).record
    assert {key for key in record if f"`{key}`" in page} >= {"output", "verdict", "reasons", "model", "seed", "seconds"}
    assert [key for fit in record.get("fits", ()) for key in fit if f"`{key}`" not in page] == []
    assert set(record.get("distance", {})) <= {"mean", "most", "unit"}


@pytest.mark.parametrize("verb", [verb for verb in EVERY if verb != "view"])
def test_a_picture_that_fails_costs_no_output(
    run: Run, files: Path, stub: FakeMatching, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    def failing(*_: object, **__: object) -> None:
        raise OutputError("the disk is full")

    monkeypatch.setattr("meshmatch.render.compose.render_shapes", failing)
    before = {path.name for path in files.iterdir()}
    assert run(*call(verb, "--picture", "p.png")).status == 1
    assert {path.name for path in files.iterdir()} - before == {EVERY[verb][0]}


@pytest.mark.parametrize(("words", "source", "target"), SHARED[:12])
def test_register_hands_options_on(
    run: Run, files: Path, stub: FakeMatching, words: tuple[str, ...], source: dict[str, Any], target: object
) -> None:
    assert run("register", "a.ply", "-o", "fitted.ply", *words).status == 0
    assert stub.called["config"] == FitConfig(**source)


@pytest.mark.parametrize(("flag", "word"), [("--partial", "yes"), ("--whole", "no"), (None, "auto")])
def test_interpolate_hands_partial_on(
    run: Run, two: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, flag: str | None, word: str
) -> None:
    heard: dict[str, Any] = {}

    def stop(*_: object, **choices: object) -> None:
        heard.update(choices)
        raise InputError("far enough")

    monkeypatch.setattr(interpolation, "interpolate", stop)
    out = two[0].with_name("between")
    answer = run("interpolate", *two, "-o", out, *([] if flag is None else [flag]))
    assert (answer.status, heard["config"].partial) == (1, word)
    assert not out.exists()


def test_picture_with_its_defaults_spelled_out(run: Run, two: tuple[Path, Path]) -> None:
    """The same bytes; and others without."""
    bytes_of = []
    for words in ((), ("--ground", "--names"), ("--no-ground", "--no-names")):
        out = two[0].with_name("p.png")
        assert run("picture", two[0], "-o", out, "--size", "96x80", *words).status == 0
        bytes_of.append(out.read_bytes())
    assert bytes_of[0] == bytes_of[1] != bytes_of[2]
