"""One transfer to many targets from Python: poses of one mesh, so that nothing is matched."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch import Collection, MeshmatchWarning, Transfers
from meshmatch.api.results import MapPair, Transferred
from meshmatch.collections.transfer_table import TransferRecord, fingerprint
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.weight_files import weights_of


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sphere: Shape) -> Path:
    """A source and a folder of two targets."""
    monkeypatch.chdir(tmp_path)
    Path("in/sub").mkdir(parents=True)
    save_shape("a.ply", Shape(sphere.verts, sphere.faces, "a", np.full((sphere.V, 4), 0.5)))
    save_shape("worn.obj", Shape(1.1 * sphere.verts, sphere.faces, "worn"))
    for number, name in enumerate(("in/b.ply", "in/sub/c.obj")):
        save_shape(name, Shape(sphere.verts + number + 1.0, sphere.faces))
    Path("labels.txt").write_text("".join(f"{number % 3}\n" for number in range(sphere.V)))
    return tmp_path


def labels(targets: Any = "in", **choices: Any) -> Transfers[Transferred[Any]]:
    return Transfers(meshmatch.transfer_labels, "a.ply", targets, **{"labels": "labels.txt"} | choices)


def outcome(records: list[TransferRecord]) -> list[tuple[str, str, bool]]:
    return [(record.name, record.verdict, record.kept) for record in records]


def written(folder: str = "out") -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in Path(folder).rglob("*.*") if path.name != ".lock")


def test_results_come_one_by_one(files: Path) -> None:
    moved = labels()
    assert (len(moved), list(moved.files), repr(moved)) == (2, ["b", "sub/c"], "Transfers(transfer_labels, 2 targets)")
    given = np.loadtxt("labels.txt")
    for name, result in moved:
        assert np.array_equal(result.data.values, given)
        assert result.maps.target.name == moved.files[name].name


WRITTEN = {
    meshmatch.transfer_colors: ({}, ["b.ply", "sub/c.obj"]),
    meshmatch.transfer_values: ({"values": np.arange(642.0)}, ["b.ply", "sub/c.ply"]),
    meshmatch.transfer_labels: ({"labels": "labels.txt"}, ["b.npy", "sub/c.npy"]),
    meshmatch.transfer_weights: ({"weights": np.ones((642, 1))}, ["b.npz", "sub/c.npz"]),
    meshmatch.transfer_landmarks: ({"landmarks": np.array([0, 5])}, ["b.csv", "sub/c.csv"]),
    meshmatch.measure: (
        {"landmarks": np.array([0, 5]), "measurements": [meshmatch.Measurement("far", "distance", ("0", "1"))]},
        ["b.csv", "sub/c.csv"],
    ),
    meshmatch.transfer_garment: ({"garment": "worn.obj"}, ["b.obj", "sub/c.obj"]),
    meshmatch.transfer_texture: ({"options": meshmatch.BakeOptions(size=64)}, ["b.glb", "sub/c.mtl", "sub/c.obj"]),
}


@pytest.mark.parametrize("transfer", WRITTEN, ids=lambda transfer: transfer.__name__)
def test_each_writes_what_its_command_would_and_keeps_it(files: Path, transfer: Any) -> None:
    choices, names = WRITTEN[transfer]
    many = Transfers(transfer, "a.ply", "in", **choices)
    assert outcome(many.save("out")) == [("b", "unknown", False), ("sub/c", "unknown", False)]
    assert [name for name in written() if not name.endswith(".png")] == [*names, "transfers.csv"]
    before = {path: path.read_bytes() for path in Path("out").rglob("*.*")}
    assert outcome(many.save("out")) == [("b", "unknown", True), ("sub/c", "unknown", True)]
    assert before == {path: path.read_bytes() for path in Path("out").rglob("*.*")}
    with Path("out/transfers.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["name"], row["verdict"], row["confidence"]) for row in rows] == [
        ("b", "unknown", ""), ("sub/c", "unknown", "")
    ]  # fmt: skip


def test_what_was_saved_is_what_arrived(files: Path) -> None:
    def saved(result: Transferred[Any], name: str) -> Any:
        result.save(name)
        return np.load(name)

    values = np.random.default_rng(0).random((642, 2))
    moved = meshmatch.transfer_values("a.ply", "in/b.ply", values)
    assert np.array_equal(saved(moved, "v.npy"), moved.data)
    colored = meshmatch.transfer_colors("a.ply", "in/sub/c.obj")
    colored.save("c.obj")
    assert np.allclose(load_shape("c.obj").colors[:, :3], 0.5, atol=0.01)  # type: ignore[index]
    placed = meshmatch.transfer_landmarks("a.ply", load_shape("in/b.ply"), [7])
    placed.save("l.csv")
    assert meshmatch.transfer_landmarks("in/b.ply", "a.ply", "l.csv").data.points == pytest.approx(
        load_shape("a.ply").verts[[7]]
    )
    with pytest.raises(OptionError, match="labels"):
        meshmatch.transfer_labels("a.ply", "in/b.ply", "labels.txt").save("l.npz")
    assert not Path("l.npz").exists()


def test_other_choices_and_files_are_done_again(files: Path) -> None:
    def kept(**choices: Any) -> list[bool]:
        return [record.kept for record in labels(**choices).save("out")]

    assert (kept(), kept()) == ([False] * 2, [True] * 2)
    assert (kept(to="faces"), kept(to="faces")) == ([False] * 2, [True] * 2)
    given = np.loadtxt("labels.txt").astype(int)
    assert (kept(labels=given), kept(labels=given.copy()), kept(labels=given[::-1])) == (
        [False] * 2, [True] * 2, [False] * 2
    )  # fmt: skip
    assert kept() == [False] * 2
    Path("out/b.npy").unlink()
    assert kept() == [False, True]
    save_shape("in/b.ply", load_shape("in/sub/c.obj"))
    assert kept() == [False, True]
    Path("labels.txt").write_text("1\n" * 642)
    assert kept() == [False] * 2

    def between(a: Shape, b: Shape) -> MapPair:
        return meshmatch.find_maps(a, b)

    assert (kept(match=between), kept(match=between)) == ([False] * 2, [False] * 2)  # it may have changed


def test_one_that_fails_stops_no_other(files: Path) -> None:
    Path("in/a-bad.ply").write_text("nothing")
    with pytest.warns(MeshmatchWarning, match=r"^a-bad: a-bad\.ply is not a ply file"):
        assert [name for name, _ in labels()] == ["b", "sub/c"]
    told: list[TransferRecord] = []
    with pytest.warns(MeshmatchWarning, match="a-bad"):
        records = labels().save("out", tell=told.append)
    assert records == told
    assert [record.verdict for record in records] == ["failed", "unknown", "unknown"]
    assert "is not a ply file" in records[0].error and not Path("out/a-bad.npy").exists()


def test_lists_patterns_and_what_is_no_target(files: Path) -> None:
    assert list(labels(["in/*.ply", "a.ply"]).files) == ["b"]  # not to itself
    with pytest.raises(InputError, match="there is no target in in"):
        Transfers(meshmatch.transfer_garment, "in/b.ply", "in", garment="in/sub/c.obj")
    labels().save("in/out", "ply")
    assert [record.name for record in labels().save("in/out", "ply")] == ["b", "sub/c"]


def test_shapes_at_hand_are_sources(files: Path) -> None:
    sphere = load_shape("a.ply")
    red, blue = (
        Shape(sphere.verts, sphere.faces, "a", np.tile(each, (642, 1))) for each in ([1.0, 0, 0, 1], [0, 0, 1.0, 1])
    )
    for shape, kept in ((red, False), (red, True), (blue, False)):
        records = Transfers(meshmatch.transfer_colors, shape, "in").save("out", ".npy")
        assert [record.kept for record in records] == [kept, kept]
    assert np.allclose(np.load("out/b.npy"), [0, 0, 1, 1])


def test_maps_of_fits_are_looked_up(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("fits").mkdir()
    with Path("fits/fits.csv").open("w", newline="") as file:
        rows = [["name", "file", "verdict"], ["a", "a.ply", "good"], ["b", "in/b.ply", "good"], ["c", "no", "failed"]]
        csv.writer(file).writerows(rows)
    asked = []

    def maps_between(self: Collection, a: Shape, b: Shape) -> MapPair:
        asked.append((a.name, b.name))
        return meshmatch.find_maps(a, b)

    monkeypatch.setattr(Collection, "holds", lambda self, shape: shape == "a.ply")
    monkeypatch.setattr(Collection, "maps_between", maps_between)
    for targets in ("fits", Collection("fits")):
        assert [name for name, _ in labels(targets)] == ["b"]
    assert asked == [("a.ply", "b.ply")] * 2
    assert [record.kept for _ in range(2) for record in labels("fits").save("out")] == [False, True]
    assert len(list(Transfers(meshmatch.transfer_labels, "in/sub/c.obj", "fits", labels="labels.txt"))) == 2
    assert len(asked) == 3  # it is not among them


def test_own_functions_transfer_too(files: Path) -> None:
    def mine(source: str, target: Path, times: float) -> Transferred[Any]:
        moved = meshmatch.transfer_values(source, target, times * np.ones(642))
        assert moved.data.shape == (642,)
        return moved

    many = Transfers(mine, "a.ply", "in", times=2.0)
    with pytest.raises(OptionError, match="what mine writes is not known"):
        many.save("out")
    assert [record.kept for _ in range(2) for record in many.save("out", "npy")] == [False] * 4
    assert np.array_equal(np.load("out/b.npy"), 2 * np.ones(642))


@pytest.mark.parametrize(
    ("targets", "suffix", "message"),
    [
        ([], None, "there are no targets"),
        ("empty", None, "there are no shapes in empty"),
        ("in", "gbl", "gbl"),
        ("in", "../x.npy", "is a suffix"),
        ("in", "", "a name without a suffix"),
    ],
)
def test_what_cannot_be_is_told_first(files: Path, targets: Any, suffix: str | None, message: str) -> None:
    Path("empty").mkdir()
    with pytest.raises(MeshmatchError, match=message):
        labels(targets).save("out", suffix)
    assert not Path("out").exists()


def test_tokens_tell_choices_apart(sphere: Shape) -> None:
    def twice(value: object) -> bool:
        return fingerprint(value) == fingerprint(value)

    fast, near = FitConfig(), FitConfig(seed=1)
    assert fingerprint(fast) != fingerprint(near) and twice(fast)
    assert fingerprint(meshmatch.Matcher("human", fast)) != fingerprint(meshmatch.Matcher("human", near))
    assert twice(meshmatch.Matcher("human")) and twice(meshmatch.Matcher())
    first, second = (weights_of(np.eye(642)[:, [0, 1 + number]] + 0.1, sphere) for number in (0, 1))
    assert twice(first) and fingerprint(first) != fingerprint(second)
    assert fingerprint([1, "1"]) != fingerprint(["1", 1]) and fingerprint({"a": 1}) != fingerprint({"a": 2})
    assert fingerprint("x" * 5000) != fingerprint("\0")
    assert not twice(lambda: None) and not twice(object())
    assert twice(Collection("fits").maps_between)
