"""Standard splits: how folders are read, which shapes and pairs count, and what errors are; balls that share a truth."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.arrays import Ints
from meshmatch.errors import InputError
from meshmatch.experiments.bench.standard import errors_of, interval_over_shapes, main, not_published, split_of
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.fitting.eggs import egg_model, write_model

BALL = icosphere(2)


def write(folder: Path, name: str, corres: Ints | None, suffix: str = "") -> Shape:
    """A ball whose vertices stand in another order, and a list of vertices, counted from 1."""
    for part in ("off", "corres"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    save_shape(folder / "off" / f"{name}.off", BALL)
    if corres is not None:
        np.savetxt(folder / "corres" / f"{name}{suffix}.vts", corres + 1, "%d")
    return BALL


def write_pair(folder: Path, name: str, corres: Ints) -> None:
    """The balls 1 and 2 and the part 40, and a list for a pair of them, counted from 1."""
    for each in ("1", "2", "40"):
        write(folder, each, None)
    np.savetxt(folder / "corres" / f"{name}.map", corres + 1, "%d")


def test_the_splits_are_the_published_ones(tmp_path: Path) -> None:
    for number in range(78, 100):
        write(tmp_path / "FAUST_r", f"tr_reg_{number:03d}", np.arange(5))
    found = split_of("FAUST_r", tmp_path)
    assert list(found.shapes) == [f"tr_reg_{number:03d}" for number in range(80, 100)] and len(found.pairs) == 380
    assert not not_published("FAUST_r", list(found.shapes)) and not not_published("SMAL_r", ["cow_b"])
    for name in ("cow_a", "cow_b", "dog"):
        write(tmp_path / "SMAL_r", name, np.arange(3))
    with pytest.raises(InputError, match=r"has no test_cat\.txt"):
        split_of("SMAL_r", tmp_path)
    (tmp_path / "SMAL_r" / "test_cat.txt").write_text("cow_b\ncow_a\n")
    assert split_of("SMAL_r", tmp_path).pairs == [("cow_b", "cow_a"), ("cow_a", "cow_b")]


def test_lists_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "FAUST_r"
    write(folder, "1", np.arange(4))
    write(folder, "2", np.arange(3))
    with pytest.raises(InputError, match="different length"):
        split_of("FAUST_r", tmp_path)
    write(folder, "2", np.array([0, 1, 2, BALL.V]))
    with pytest.raises(InputError, match="not there"):
        split_of("FAUST_r", tmp_path)
    (folder / "corres" / "2.vts").write_text("a\n")
    with pytest.raises(InputError, match="cannot read"):
        split_of("FAUST_r", tmp_path)
    write(tmp_path / "TOPKIDS", "kid00", None)
    write(tmp_path / "TOPKIDS", "kid01", np.arange(4), "_ref")
    with pytest.raises(InputError, match="one line for each"):
        split_of("TOPKIDS", tmp_path)


def test_errors_are_at_the_points_of_the_truth(tmp_path: Path) -> None:
    write(tmp_path / "FAUST_r", "1", np.array([3, 4, 5]))
    write(tmp_path / "FAUST_r", "2", np.array([7, 8, 9]))
    split = split_of("FAUST_r", tmp_path)
    index = np.zeros(BALL.V, np.int64)
    index[[3, 4, 5]] = 7, 8, 8
    errors = errors_of(split, {("1", "2"): index}, tmp_path)["1", "2"]
    assert errors[:2].tolist() == [0, 0] and errors[2] > 1
    write(tmp_path / "TOPKIDS", "kid00", None)
    write(tmp_path / "TOPKIDS", "kid01", np.roll(np.arange(BALL.V), 1), "_ref")
    split = split_of("TOPKIDS", tmp_path)
    assert split.pairs == [("kid01", "kid00")]
    right = errors_of(split, {("kid01", "kid00"): np.roll(np.arange(BALL.V), 1)}, tmp_path)["kid01", "kid00"]
    wrong = errors_of(split, {("kid01", "kid00"): np.arange(BALL.V)}, tmp_path)["kid01", "kid00"]
    assert right.max() == 0 < wrong.min()


def test_pairs_of_shrec19_are_those_of_its_maps_measured_as_others_do(tmp_path: Path) -> None:
    """Vertex k of 1 is vertex turned[k] of 2: maps are from 2 to 1, and errors on 1."""
    folder, turned = tmp_path / "SHREC19_r", np.roll(np.arange(BALL.V), 5)
    write_pair(folder, "1_2", turned)
    write_pair(folder, "40_1", turned[:9])
    write_pair(folder, "2_40", turned[:9])
    split = split_of("SHREC19_r", tmp_path)
    assert split.pairs == [("2", "1")] and list(split.shapes) == ["1", "2"]
    right, wrong = (errors_of(split, {("2", "1"): each}, tmp_path)["2", "1"] for each in (np.argsort(turned), turned))
    assert right.shape == (BALL.V,) and right.max() == 0 < wrong.min()
    for name, corres in (("1_3", turned), ("1", turned), ("2_1", turned[:9]), ("2_1", turned + 1), ("2_1", turned - 1)):
        write_pair(folder, name, corres)
        with pytest.raises(InputError, match=name):
            split_of("SHREC19_r", tmp_path)
        (folder / "corres" / f"{name}.map").unlink()


def test_intervals_are_of_shapes() -> None:
    one_odd = {(a, b): 1.0 + 8.0 * ("c" in (a, b)) for a in "abcdefgh" for b in "abcdefgh" if a != b}
    low, high = interval_over_shapes(one_odd)
    assert 1.0 <= low < 3.0 < high < 9.0
    same = interval_over_shapes(dict.fromkeys(one_odd, 2.0))
    assert same == (2.0, 2.0)
    to_reference = {(str(k), "kid00"): float(k) for k in range(20)}
    low, high = interval_over_shapes(to_reference)
    assert 6 < low < 9.5 < high < 13


def test_the_command_finds_the_sets_that_are_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = write_model(egg_model(), tmp_path / "egg")
    for name in ("1", "2", "3"):
        write(tmp_path / "FAUST_r", name, np.arange(10))
    words = ["--data", str(tmp_path), "--cache", str(tmp_path / "cache"), "--model", str(model)]
    assert main(words) == 0
    told = capsys.readouterr()
    assert "published split of FAUST_r is 080 to 099, not these 3: 1 to 3" in told.err
    (row,) = json.loads(told.out.splitlines()[-1])["rows"]
    assert (row["set"], row["shapes"], row["pairs"]) == ("FAUST_r", 3, 6) and row["low"] <= row["mean"] <= row["high"]
    assert row["minutes"] > 0
    assert main(["--data", str(tmp_path / "egg")]) == 1
    assert "docs/datasets.md" in capsys.readouterr().err


def test_remeshed_shapes_lead_to_the_first_of_faust(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "discretization"
    for kind in ("iso", "cloud"):
        (folder / kind).mkdir(parents=True)
    save_shape(folder / "tr_reg_000.ply", BALL)
    some = np.arange(0, BALL.V, 3)
    save_shape(folder / "iso" / "tr_reg_iso_080.ply", BALL)
    np.savetxt(folder / "iso" / "tr_reg_iso_080.txt", np.roll(np.arange(BALL.V), 1), "%d")
    save_shape(folder / "cloud" / "tr_reg_cloud_080.ply", Shape(BALL.verts[some], np.empty((0, 3), np.int64)))
    np.savetxt(folder / "cloud" / "tr_reg_cloud_080.txt", some, "%d")
    split = split_of("cloud", tmp_path)
    assert split.pairs == [("tr_reg_cloud_080", "tr_reg_000")] and split.shapes["tr_reg_cloud_080"].is_cloud
    right, wrong = (errors_of(split, {split.pairs[0]: index}, None)[split.pairs[0]] for index in (some, some[::-1]))
    assert right.max() == 0 < wrong.max()
    model = write_model(egg_model(), tmp_path / "egg")
    assert main(["--data", str(tmp_path), "--model", str(model), "--sets", "iso"]) == 0
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert (row["set"], row["shapes"], row["pairs"]) == ("iso", 2, 1)
    np.savetxt(folder / "iso" / "tr_reg_iso_080.txt", np.arange(BALL.V) + 1, "%d")  # counted from 1
    with pytest.raises(InputError, match="not there"):
        split_of("iso", tmp_path)
