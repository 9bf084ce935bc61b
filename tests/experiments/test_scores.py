"""The protocol on a small benchmark with known maps, and on the real one where it is there."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.errors import InputError
from meshmatch.experiments.bench import scores as room
from meshmatch.experiments.bench.scores import TruthDistances, area_under_curve, evaluate_set, summary
from meshmatch.experiments.bench.sets import OUTLIERS, OUTLIERS_FILE, SET_NAMES, load_clouds, load_set, ordered_pairs
from meshmatch.maps.evaluate import CM_PER_UNIT, Errors, map_errors
from meshmatch.maps.geodesics import GeodesicDistances
from tests.experiments.small_bench import BODY, build, truth


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache") / "made" / "by us"


def test_pairs_and_groups(small: Path) -> None:
    shrec, scape, faust = (load_set(name, small) for name in SET_NAMES)
    assert shrec.shapes == ("1", "2", "10")
    assert shrec.pairs == (("1", "2"), ("1", "10"), ("10", "2"))
    assert scape.pairs == (("mesh000", "mesh001"), ("mesh001", "mesh000"))
    assert len(faust.pairs) == 6
    assert [pair for pair in faust.pairs if faust.group(pair) == "same subject"] == [
        ("tr_reg_000", "tr_reg_001"),
        ("tr_reg_001", "tr_reg_000"),
    ]
    assert {scape.group(pair) for pair in scape.pairs} == {""}


@pytest.mark.parametrize("name", SET_NAMES)
def test_right_maps_have_no_error(small: Path, kept: Path, name: str) -> None:
    bench = load_set(name, small)
    scores = evaluate_set(bench, {pair: truth(*pair) for pair in bench.pairs}, cache=kept)
    record = scores.as_dict()
    assert record["pairs"] == len(bench.pairs)
    assert record["complete"]
    assert record["points_per_pair"] == BODY.V
    assert record["mean_cm"] == record["share_over_15cm"] == record["flips"] == record["worst"][0][2] == 0


@pytest.mark.parametrize("name", SET_NAMES)
def test_errors_are_those_of_the_plain_way(small: Path, kept: Path, name: str) -> None:
    bench = load_set(name, small)
    rng = np.random.default_rng(0)
    maps = {pair: rng.integers(0, BODY.V, BODY.V) for pair in bench.pairs}
    scores = evaluate_set(bench, maps, cache=kept)
    total = []
    for source, target in bench.pairs:
        expected = map_errors(
            maps[source, target],
            bench.landmarks(source),
            bench.landmarks(target),
            GeodesicDistances(bench.shape(target)),
        )
        assert scores.errors[source, target].values == pytest.approx(expected.values, rel=1e-3)
        total.append(expected.mean_cm)
    assert scores.joined.mean_cm == pytest.approx(np.mean(total), rel=1e-3)
    assert scores.as_dict()["median_pair_cm"] == pytest.approx(np.median(total), rel=1e-3)
    assert scores.as_dict()["flips"] == 1.0
    assert scores.joined.mean_cm > 40
    worst = scores.as_dict()["worst"][0]
    assert worst[2] == pytest.approx(max(total), abs=0.1)


def test_one_pair_of_three_is_wrong(small: Path, kept: Path) -> None:
    bench = load_set("shrec19", small)
    maps = {pair: truth(*pair) for pair in bench.pairs}
    maps["1", "10"] = np.zeros(BODY.V, dtype=int)
    scores = evaluate_set(bench, maps, cache=kept)
    assert scores.as_dict()["flips"] == pytest.approx(1 / 3, abs=1e-4)
    assert next(iter(scores.means_cm)) == ("1", "10")
    assert scores.joined.median == 0
    assert scores.joined.mean > 0.1


def test_groups_share_the_pairs(small: Path, kept: Path) -> None:
    bench = load_set("faust", small)
    maps = {pair: truth(*pair) for pair in bench.pairs}
    maps["tr_reg_000", "tr_reg_001"] = np.zeros(BODY.V, dtype=int)
    cross, same = evaluate_set(bench, maps, cache=kept).groups()
    assert (cross.group, len(cross.errors), cross.joined.mean) == ("cross subject", 4, 0)
    assert (same.group, len(same.errors)) == ("same subject", 2)
    assert same.as_dict()["flips"] == 0.5
    assert same.expected == 2
    assert cross.as_dict()["complete"]


def test_nothing_is_left_out_in_silence(small: Path, kept: Path) -> None:
    bench = load_set("shrec19", small)
    maps = {pair: truth(*pair) for pair in bench.pairs[:2]}
    with pytest.raises(InputError, match=r"1 maps are missing, the first 10 -> 2"):
        evaluate_set(bench, maps, cache=kept)
    part = evaluate_set(bench, maps, cache=kept, pairs=bench.pairs[:2])
    assert not part.as_dict()["complete"]
    assert part.expected == 3
    with pytest.raises(InputError, match="has no pair 2 -> 1"):
        evaluate_set(bench, maps, cache=kept, pairs=[("2", "1")])
    with pytest.raises(InputError, match="nothing to evaluate"):
        evaluate_set(bench, maps, cache=kept, pairs=[])
    for bad in (np.zeros(3, int), np.full(BODY.V, BODY.V), np.full(BODY.V, -1), np.zeros(BODY.V)):
        with pytest.raises(InputError, match="shrec19 1 -> 2"):
            evaluate_set(bench, {("1", "2"): bad}, cache=kept, pairs=[("1", "2")])


def test_distances_are_computed_once(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = load_set("scape", small)
    shape, landmarks = bench.shape("mesh000"), np.array([5, 3, 5, 70])
    first = TruthDistances(shape, landmarks, tmp_path)
    index = np.array([5, 8, 1, 70])
    (errors,) = first.errors([index])
    assert errors[0] == errors[3] == 0
    assert (errors[1:3] > 0).all()
    assert np.load(first.path).shape == (3, shape.V)
    monkeypatch.setattr(room, "GeodesicDistances", None)  # would fail if it were asked again
    monkeypatch.setattr(room, "READ_BYTES", 1)  # one row at a time
    again = TruthDistances(bench.shape("mesh000"), landmarks, tmp_path)
    assert np.array_equal(again.errors([index])[0], errors)
    one, other = again.errors([index, index[::-1]])
    assert np.array_equal(one, errors)
    assert not np.array_equal(other, errors)
    # Another shape, or other landmarks, are other distances.
    paths = {
        first.path,
        TruthDistances(bench.shape("mesh001"), landmarks, tmp_path).path,
        TruthDistances(shape, landmarks[:2], tmp_path).path,
    }
    assert len(paths) == 3


def test_pairs_are_spread_evenly() -> None:
    assert len(ordered_pairs("abcd")) == len(ordered_pairs("abcd", 99)) == 12
    assert [pair[0] for pair in ordered_pairs("abcd", 4)] == list("abcd")


def test_the_area_under_the_curve() -> None:
    assert area_under_curve([1, 2, 3, 4], [False, False, True, True]) == 1.0
    assert area_under_curve([4, 3, 2, 1], [False, False, True, True]) == 0.0
    assert np.isnan(area_under_curve([1, 2], [True, True]))
    rng = np.random.default_rng(0)
    score, right = rng.integers(0, 9, 60), rng.random(60) < 0.4
    pairs = [(a > b) + 0.5 * (a == b) for a in score[right] for b in score[~right]]
    assert area_under_curve(score, right) == pytest.approx(np.mean(pairs))


def test_a_summary_by_hand() -> None:
    pairs = [Errors(np.array(cm) / CM_PER_UNIT) for cm in ([0, 2], [10, 20], [30, 40])]
    found = summary(pairs)
    assert found["mean_cm"] == pytest.approx(17)
    assert (found["median_cm"], found["median_pair_cm"]) == pytest.approx((15, 15))
    assert found["share_over_15cm"] == pytest.approx(0.5)
    assert found["flips"] == pytest.approx(1 / 3)


def test_the_real_sets_have_the_protocols_pairs(bench: Path) -> None:
    counts = {name: (len(found.shapes), len(found.pairs)) for name in SET_NAMES for found in [load_set(name, bench)]}
    assert counts["shrec19"][1] == len((bench / "shrec19" / "pairs.txt").read_text().split()) // 2
    assert counts["scape"] == (20, 380)
    assert counts["faust"] == (30, 870)
    faust = load_set("faust", bench)
    assert sum(faust.group(pair) == "same subject" for pair in faust.pairs) == 270
    for name, points in (("shrec19", 6890), ("scape", 12_500), ("faust", 5000)):
        found = load_set(name, bench)
        for shape in found.shapes[:3]:
            assert found.landmarks(shape).shape == (points,)


def test_truth_of_the_real_sets_is_a_map_of_the_surface(bench: Path) -> None:
    """Landmarks next to each other on one shape are so on the next: ids are not shifted, mirrored or
    shuffled.
    """
    for name in SET_NAMES:
        found = load_set(name, bench)
        a, b = found.shapes[0], found.shapes[-1]
        one, other = found.shape(a), found.shape(b)
        landmark = np.full(one.V, -1)
        landmark[found.landmarks(a)] = np.arange(len(found.landmarks(a)))
        corners = landmark[one.faces]
        placed = other.verts[found.landmarks(b)[corners[(corners >= 0).all(axis=1)]]]
        longest = np.linalg.norm(placed - np.roll(placed, 1, axis=1), axis=2).max(axis=1) / np.sqrt(other.area)
        assert np.median(longest) * CM_PER_UNIT < 5
        normals = np.cross(placed[:, 1] - placed[:, 0], placed[:, 2] - placed[:, 0])
        nearest = cKDTree(other.verts).query(placed[:, 0])[1]
        outward = np.einsum("ni,ni->n", normals, other.vertex_normals[nearest])
        assert (outward[outward != 0] > 0).mean() > 0.85


def test_the_noisy_cloud_set_is_scape_without_faces_and_with_noise(tmp_path: Path) -> None:
    data = build(tmp_path)
    clean, noisy = load_set("scape", data), load_set("scape-pcn", data)
    assert (noisy.shapes, noisy.pairs) == (clean.shapes, clean.pairs)
    for name in noisy.shapes:
        mesh, cloud = noisy.shape(name), noisy.seen(name)
        assert not mesh.is_cloud and cloud.is_cloud
        assert mesh.hash == clean.shape(name).hash == clean.seen(name).hash
        moved = (cloud.verts - mesh.verts) / mesh.diagonal
        assert 0.008 < moved.std() < 0.012
        assert noisy.seen(name).hash == cloud.hash
        assert np.array_equal(noisy.landmarks(name), clean.landmarks(name))
    first, second = (noisy.seen(name).verts - noisy.shape(name).verts for name in noisy.shapes)
    assert not np.allclose(first * 2, second)


def test_clouds_with_outliers_are_measured_straight_and_every_row_counts(tmp_path: Path, kept: Path) -> None:
    points = np.zeros((3, 40, 3), np.float32)
    points[:, :, 0] = 0.2 * np.arange(40)  # metres: neighbours are 20 cm apart
    np.save(tmp_path / OUTLIERS_FILE, points)
    bench = load_set(OUTLIERS, tmp_path)
    assert (len(bench.pairs), bench.seen("cloud 0").is_cloud, len(bench.landmarks("cloud 2"))) == (6, True, 40)
    index = np.where(np.arange(40) < 30, np.arange(40), (np.arange(40) + 1) % 40)  # the last go to their neighbours
    record = evaluate_set(bench, dict.fromkeys(bench.pairs, index), cache=kept).as_dict()
    assert record["mean_cm"] == pytest.approx((9 * 20 + 39 * 20) / 40, rel=1e-5)
    assert (record["median_cm"], record["share_over_15cm"], record["flips"]) == (0, 0.25, 1)
    np.save(tmp_path / OUTLIERS_FILE, points[0])
    load_clouds.cache_clear()
    with pytest.raises(InputError, match="holds"):
        load_set(OUTLIERS, tmp_path)
    with pytest.raises(InputError, match="cannot read"):
        load_set(OUTLIERS, tmp_path / "nowhere")
