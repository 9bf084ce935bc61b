"""The comparison with other methods: every method's map, results that are kept, what is skipped and what fails."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError
from meshmatch.experiments.bench import baselines
from meshmatch.experiments.bench.baselines import METHODS, Baseline, Choices, main
from meshmatch.experiments.bench.methods import (
    Method,
    Registration,
    ZoomOut,
    coded,
    interpolate_thin,
    library,
    normalize_shape,
)
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
    ("package", "method"),
    [
        (None, Registration("rigid", seed=1)),
        ("trimesh", Registration("nricp", 400)),
        ("meshmonk", Registration("meshmonk", 900)),
        ("pyFM", ZoomOut(faces=1000, first=10, last=30)),
    ],
    ids=["rigid", "nricp", "meshmonk", "zoomout"],
)
def test_a_moved_copy_is_found_again(package: str | None, method: Method) -> None:
    if package is not None:
        pytest.importorskip(package)
    source = lump()
    target, truth = moved(source)
    found = method.map(source, method.fit(source), target, method.fit(target))
    far = np.linalg.norm(target.verts[found.index] - target.verts[truth], axis=1) / np.sqrt(target.area)
    guess = np.linalg.norm(target.verts[::-1] - target.verts[truth], axis=1) / np.sqrt(target.area)
    assert far.mean() < 0.05 < 0.3 < guess.mean()


def test_3d_coded_searches_its_code_without_constraints() -> None:
    method = coded("model", 7, 5)
    assert (method.model, method.refine, method.seed, method.partial) == ("model", "latent", 5, "no")
    assert (method.latent.steps, method.latent.volume, method.latent.arap) == (7, 0, 0)


@pytest.mark.parametrize("method", [Registration("nricp"), Registration("meshmonk"), ZoomOut()])
def test_a_method_that_needs_triangles_says_so(method: Method) -> None:
    cloud = Shape(lump(2).verts, np.empty((0, 3), np.int64), "points")
    with pytest.raises(InputError, match="needs triangles"):
        method.fit(cloud)
    Registration("rigid").fit(cloud)


def test_the_whole_goes_where_the_thin_one_goes() -> None:
    whole = normalize_shape(lump())
    there = whole.whole.verts * [1, 2, 3] + 4
    assert np.allclose(interpolate_thin(whole, there), there)
    thin = normalize_shape(lump(), faces=300)
    assert thin.thin.F < 400
    there = thin.thin.verts @ np.diag([1.0, 2.0, 3.0]) + 4
    assert np.abs(interpolate_thin(thin, there) - (thin.whole.verts * [1, 2, 3] + 4)).max() < 0.2


def test_a_librarys_failure_is_a_failed_pair_and_a_bug_is_a_bug() -> None:
    with pytest.raises(InputError, match="abc gave up: no way"), library("abc"):
        raise ValueError("no way")
    with pytest.raises(InputError, match="gave up"), library("abc"):
        np.linalg.cholesky(-np.eye(2))
    with pytest.raises(TypeError), library("abc"):
        raise TypeError


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("bench"))


@pytest.fixture
def words(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command's words, with oracles for two of the methods; one of them refuses a shape."""
    for row in (
        Baseline("rigid", "turned round", Oracle(turned=True)),
        Baseline("nricp", "n", None, "gone"),
        Baseline("ours", "ours", Oracle(refuses="2"), "", 12.5, "abc"),
    ):
        monkeypatch.setitem(METHODS, row.name, lambda _, row=row: [row])
    words = ["--data", str(small), "--cache", str(tmp_path / "cache"), "--output", str(tmp_path / "kept")]
    return [*words, "--methods", "rigid,ours"]


def answer(capsys: pytest.CaptureFixture[str]) -> tuple[str, dict[str, Any]]:
    text = capsys.readouterr().out
    return text, json.loads(text.strip().splitlines()[-1])


def test_the_command(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--sets", "shrec19,scape"]) == 0
    text, record = answer(capsys)
    rows = {(row["set"], row["name"]): row for row in record["rows"]}
    # A shape that cannot be fitted costs its pairs; none is left out.
    ours = rows["shrec19", "ours"]
    assert (ours["measured"], ours["failures"], ours["minutes"]) == ("3 of 3", 2, 12.5)
    assert ours["flips"] == pytest.approx(2 / 3, abs=1e-4)
    assert rows["scape", "ours"]["mean_cm"] == 0
    assert rows["scape", "rigid"]["mean_cm"] > 10
    line = next(line for line in text.splitlines() if "shrec19" in line and "ours" in line)
    assert "3 of 3" in line and "12.5" in line and "67 %" in line
    assert "Not all pairs" not in text

    # A second run reads them, and measures only what is not there.
    (tmp_path / "kept" / "scape-rigid.json").unlink()
    fitted: list[str] = []
    plain = Oracle.fit
    monkeypatch.setattr(Oracle, "fit", lambda self, shape: fitted.append(shape.name) or plain(self, shape))
    assert main([*words, "--sets", "shrec19,scape"]) == 0
    again = {(row["set"], row["name"]): row for row in answer(capsys)[1]["rows"]}
    assert len(fitted) == 2
    assert again["shrec19", "ours"] == ours
    assert again["scape", "rigid"]["mean_cm"] == pytest.approx(rows["scape", "rigid"]["mean_cm"])


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "find_spec", lambda name: None)
    assert all(row.method is not None for row in METHODS["rigid"](Choices()))
    for name in ("zoomout", "nricp", "meshmonk"):
        rows = METHODS[name](Choices())
        assert all(row.method is None and "pip install 'meshmatch[bench]'" in row.missing for row in rows)
