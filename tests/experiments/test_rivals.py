"""The comparison with other methods: every rival's map, cells that are kept, what is skipped and what fails."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError
from meshmatch.experiments import adapters, rivals
from meshmatch.experiments.adapters import (
    CodedMatcher,
    MeshmonkMatcher,
    NricpMatcher,
    RigidMatcher,
    carried,
    library,
    placed,
)
from meshmatch.experiments.bench import Matcher
from meshmatch.experiments.rival_cells import Rival
from meshmatch.experiments.rivals import NAMES, main
from meshmatch.experiments.spectral import ZoomOutMatcher
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.experiments.small_bench import Oracle, build


def lump(splits: int = 3) -> Shape:
    """A bent pear that no turn and no mirror takes to itself."""
    verts = icosphere(splits).verts
    x, y, z = (verts * (1 + 0.45 * verts[:, 1:2]) * [0.6, 1.6, 1.0]).T
    verts = np.stack([x + 0.3 * y**2 + 0.15 * z * y, y, z + 0.25 * x * y + 0.12 * y**3], 1)
    return Shape(verts, icosphere(splits).faces, "lump")


def moved(shape: Shape) -> tuple[Shape, np.ndarray]:
    """A copy, a little bent, turned, scaled and shuffled; and the true map to it (V,)."""
    verts = shape.verts + 0.02 * np.sin(3 * shape.verts[:, [1, 2, 0]])
    turn = Rotation.from_rotvec([1.4, 0.4, -0.9]).as_matrix()
    order = np.random.default_rng(3).permutation(shape.V)
    truth = np.argsort(order)
    return Shape((7 * verts @ turn.T + [3, 1, 2])[order], truth[shape.faces], "copy"), truth


@pytest.mark.parametrize(
    ("package", "matcher"),
    [
        (None, RigidMatcher(seed=1)),
        ("trimesh", NricpMatcher(faces=400)),
        ("meshmonk", MeshmonkMatcher(faces=900)),
        ("pyFM", ZoomOutMatcher(faces=1000, first=10, last=30)),
    ],
    ids=["rigid", "nricp", "meshmonk", "zoomout"],
)
def test_a_moved_copy_is_found_again(package: str | None, matcher: Matcher) -> None:
    if package is not None and rivals.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    source = lump()
    target, truth = moved(source)
    found = matcher.map(source, matcher.fit(source), target, matcher.fit(target))
    far = np.linalg.norm(target.verts[found.index] - target.verts[truth], axis=1) / np.sqrt(target.area)
    guess = np.linalg.norm(target.verts[::-1] - target.verts[truth], axis=1) / np.sqrt(target.area)
    assert far.mean() < 0.05 < 0.3 < guess.mean()


@pytest.mark.parametrize("matcher", [NricpMatcher(), MeshmonkMatcher(), ZoomOutMatcher()])
def test_who_needs_triangles_says_so(matcher: Matcher) -> None:
    if isinstance(matcher, ZoomOutMatcher) and rivals.find_spec("pyFM") is None:
        pytest.skip("pyFM is not installed")
    cloud = Shape(lump(2).verts, np.empty((0, 3), np.int64), "points")
    with pytest.raises(InputError, match="needs triangles"):
        matcher.fit(cloud)


def test_a_cloud_is_aligned_too() -> None:
    source = lump()
    target, truth = moved(source)
    cloud = Shape(target.verts, np.empty((0, 3), np.int64), "points")
    found = RigidMatcher().map(source, RigidMatcher().fit(source), cloud, RigidMatcher().fit(cloud))
    far = np.linalg.norm(cloud.verts[found.index] - cloud.verts[truth], axis=1) / np.sqrt(target.area)
    assert far.mean() < 0.06


def test_the_whole_goes_where_the_thin_one_goes() -> None:
    whole = placed(lump())
    assert whole.thin is whole.whole
    there = whole.whole.verts * [1, 2, 3] + 4
    assert np.allclose(carried(whole, there), there)
    thin = placed(lump(), faces=300)
    assert thin.thin.F < 400
    there = thin.thin.verts @ np.diag([1.0, 2.0, 3.0]) + 4
    assert np.abs(carried(thin, there) - (thin.whole.verts * [1, 2, 3] + 4)).max() < 0.2


def test_a_librarys_failure_is_a_failed_pair_and_a_bug_is_a_bug(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="abc gave up: no way"), library("abc"):
        raise ValueError("no way")
    with pytest.raises(InputError, match="gave up"), library("abc"):
        np.linalg.cholesky(-np.eye(2))
    with pytest.raises(TypeError), library("abc"):
        raise TypeError


def test_3d_coded_searches_by_the_chamfer_distance_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(adapters, "read_model", lambda name: name)
    monkeypatch.setattr(adapters, "lay_template", lambda *words: seen.extend(words))
    CodedMatcher("folder", steps=9, seed=4).fit(lump(2))
    model, _, config = seen
    assert (model, config.refine, config.seed, config.latent.steps) == ("folder", "latent", 4, 9)
    assert config.latent.chamfer == 1 and config.latent.volume == config.latent.arap == 0


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("bench"))


@pytest.fixture
def words(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command's words, with oracles for two of the rivals; one of them refuses a shape."""
    lookups = {
        "rigid": lambda given: [Rival("rigid", "turned round", Oracle(turned=True))],
        "ours": lambda given: [Rival("ours", "ours", Oracle(refuses="2"), "", 12.5, "abc")],
    }
    for name, maker in lookups.items():
        monkeypatch.setitem(rivals._MAKERS, name, maker)
    words = ["--data", str(small), "--cache", str(tmp_path / "cache"), "--output", str(tmp_path / "cells")]
    return [*words, "--rivals", "rigid,ours", "--threads", "1", "--jobs", "1", "--seed", "0"]


def answer(capsys: pytest.CaptureFixture[str]) -> tuple[str, dict[str, Any]]:
    text = capsys.readouterr().out
    return text, json.loads(text.strip().splitlines()[-1])


def test_the_command(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    picture = tmp_path / "plot.png"
    assert main([*words, "--sets", "shrec19,scape", "--picture", str(picture)]) == 0
    text, record = answer(capsys)
    assert picture.stat().st_size > 1000
    assert {"date", "commit", "machine", "geodesic", "seed", "limit_pairs"} <= record.keys()
    # A shape that cannot be fitted costs its pairs; none is left out.
    ours = record["sets"]["shrec19"]["ours"]
    assert (ours["scores"]["pairs"], ours["of"], len(ours["scores"]["failed"])) == (3, 3, 2)
    assert ours["scores"]["flips"] == pytest.approx(2 / 3, abs=1e-4)
    assert ours["training_minutes"] == 12.5
    assert record["sets"]["scape"]["ours"]["scores"]["mean_cm"] == 0
    assert record["sets"]["scape"]["rigid"]["scores"]["mean_cm"] > 10
    line = next(line for line in text.splitlines() if "shrec19" in line and "ours" in line)
    assert "3 of 3" in line and "12.5 min" in line and "67 %" in line
    assert "Not all pairs" not in text
    assert len(list((tmp_path / "cells").glob("*.json"))) == 4

    # A second run reads them, and measures only what is not there.
    (tmp_path / "cells" / "scape-rigid.json").unlink()
    fitted: list[str] = []
    plain = Oracle.fit
    monkeypatch.setattr(Oracle, "fit", lambda self, shape: fitted.append(shape.name) or plain(self, shape))
    assert main([*words, "--sets", "shrec19,scape"]) == 0
    again = answer(capsys)[1]
    assert len(fitted) == 2
    assert again["sets"]["shrec19"] == record["sets"]["shrec19"]
    assert again["sets"]["scape"]["rigid"]["scores"]["mean_cm"] == pytest.approx(
        record["sets"]["scape"]["rigid"]["scores"]["mean_cm"]
    )
    assert (tmp_path / "cells" / "rivals.png").stat().st_size > 1000


def test_a_part_says_so_and_is_not_taken_for_another(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--sets", "faust", "--limit-pairs", "2"]) == 0
    text, record = answer(capsys)
    assert "2 of 6" in text and "Not all pairs were measured" in text
    assert record["limit_pairs"] == 2
    assert main([*words, "--sets", "faust"]) == 1
    assert "other choices (pairs)" in " ".join(capsys.readouterr().err.split())


def test_a_damaged_cell_is_told(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, "--sets", "scape"]) == 0
    (tmp_path / "cells" / "scape-ours.json").write_text("{}")
    assert main([*words, "--sets", "scape"]) == 1
    assert "no cell of this benchmark" in " ".join(capsys.readouterr().err.split())


def test_what_is_not_there_is_skipped_with_a_reason(
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(rivals, "find_spec", lambda name: None)
    assert main([*words, "--sets", "scape", "--rivals", ",".join(NAMES)]) == 0
    text, record = answer(capsys)
    row = record["sets"]["scape"]
    assert {name for name in row if "skipped" in row[name]} == {*NAMES} - {"rigid", "ours"}
    for reason in ("pyFM is not installed", "trimesh is not", "meshmonk is not", "--coded", "--transmatch"):
        assert reason in text
    assert "pip install 'meshmatch[bench]'" in text
    assert {path.stem for path in (tmp_path / "cells").glob("*.json")} == {"scape-rigid", "scape-ours"}


def test_no_cell_is_begun_when_the_time_is_up(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--sets", "scape", "--minutes", "0", "--rivals", "rigid,coded"]
    assert main([*words, *given, "--coded", "human", "--coded-steps", "7"]) == 0
    text, record = answer(capsys)
    assert text.count("the time was up") >= 2
    assert all("skipped" in found for found in record["sets"]["scape"].values())
    assert not list((tmp_path / "cells").iterdir())


def test_our_own_rows(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    plain, refined = rivals._MAKERS["ours"](rivals.options_of(["--model", "human", "--seed", "5"]))
    assert (plain.matcher.refine, refined.matcher.refine) == ("none", "nodes")  # type: ignore[union-attr]
    assert refined.matcher.seed == 5  # type: ignore[union-attr]
    assert refined.minutes and refined.minutes > 0
    (coded,) = rivals._MAKERS["coded"](rivals.options_of(["--coded", "human", "--coded-steps", "7"]))
    assert coded.matcher == CodedMatcher("human", 7, 0)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--rivals", "rigid,smpl"], "no rival 'smpl'"),
        (["--sets", "tosca"], "no set 'tosca'"),
        (["--rivals", "transmatch", "--transmatch", "nowhere"], "holds no TransMatch"),
        (["--rivals", "coded", "--coded", "nobody"], "nobody"),
    ],
)
def test_what_cannot_be_is_told(
    words: list[str], more: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, *more]) == 1
    assert said in " ".join(capsys.readouterr().err.split())
