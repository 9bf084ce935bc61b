"""The mean and the modes: by hand, against a textbook, and found where they are known."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.collections.atlas import Atlas
from meshmatch.collections.atlas_arrays import FILE
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.shapes.shape import Shape
from tests.collections.ellipsoids import AXES, SPREAD, ellipsoids, moved
from tests.conftest import icosphere, some_fit

OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 3], [0, 0, -3]], float)
OCTAHEDRON_FACES = np.array([[i, j, k] for i in (0, 1) for j in (2, 3) for k in (4, 5)])


def angle(one: np.ndarray, other: np.ndarray, weights: np.ndarray) -> float:
    """Degrees between two modes (V, 3), whichever way they point."""
    dot = np.einsum("vi,v,vi->", one, weights, other)
    lengths = [np.sqrt(np.einsum("vi,v,vi->", each, weights, each)) for each in (one, other)]
    return float(np.degrees(np.arccos(min(1.0, abs(dot) / (lengths[0] * lengths[1])))))


def test_three_octahedra_by_hand() -> None:
    """Two of six vertices move by -1, 0 and 1, all of the same weight: a deviation of sqrt(2 / 6)."""
    points = OCTAHEDRON * (1 + np.array([-1, 0, 1])[:, None, None] / 3 * [0, 0, 1])
    atlas = Atlas.of(points, OCTAHEDRON_FACES, ["a", "b", "c"])
    assert np.allclose(atlas.weights, 1 / 6)
    assert np.allclose(atlas.mean, OCTAHEDRON)
    assert len(atlas.modes) == 1
    assert np.allclose(atlas.deviations, np.sqrt(1 / 3))
    assert np.allclose(atlas.scores, [[-1], [0], [1]])  # a positive score is a larger shape
    assert np.allclose(atlas.modes[0], OCTAHEDRON * [0, 0, 1] / 3 / np.sqrt(1 / 3))
    assert np.allclose(atlas.distances, [np.sqrt(1 / 3), 0, np.sqrt(1 / 3)])
    assert np.allclose(atlas.distance_from_mean("a"), [0, 0, 0, 0, 1, 1])
    assert np.allclose(atlas.sizes**2, [(1 + 4 + 4) / 3, (1 + 4 + 9) / 3, (1 + 4 + 16) / 3])
    assert np.allclose(atlas.compactness, 1)


def test_shapes_and_generators_are_points_too() -> None:
    points = OCTAHEDRON * (1 + np.array([-1, 0, 1])[:, None, None] / 3 * [0, 0, 1])
    for given in ([Shape(each, OCTAHEDRON_FACES) for each in points], (each for each in points)):
        assert np.array_equal(Atlas.of(given, OCTAHEDRON_FACES).mean, Atlas.of(points, OCTAHEDRON_FACES).mean)


def test_the_textbook_says_the_same() -> None:
    """Singular values of the aligned coordinates, each times the root of its vertex's weight."""
    given = ellipsoids(12, splits=1)
    rough = given.points + 0.02 * np.random.default_rng(1).standard_normal(given.points.shape)
    atlas = Atlas.of(moved(rough), given.faces)
    aligned, _ = atlas.align(moved(rough))
    offsets = aligned - atlas.mean
    assert np.abs(offsets.mean(axis=0)).max() < 1e-8
    scaled = (offsets * np.sqrt(atlas.weights)[:, None]).reshape(12, -1)
    left, values, right = np.linalg.svd(scaled, full_matrices=False)
    assert len(atlas.modes) == 11
    assert np.allclose(atlas.deviations, values[:11] / np.sqrt(11), rtol=1e-6)
    assert np.allclose(atlas.total, values @ values / 11)
    assert np.allclose(np.abs(atlas.scores), np.abs(left[:, :11]) * np.sqrt(11), atol=1e-5)
    modes = (right[:11].reshape(11, -1, 3)) / np.sqrt(atlas.weights)[:, None]
    assert max(angle(one, other, atlas.weights) for one, other in zip(atlas.modes, modes, strict=True)) < 1e-3
    areas = vertex_areas(atlas.mean, given.faces)
    assert np.allclose(atlas.weights, areas / areas.sum(), atol=1e-7)


def test_every_pose_is_the_best() -> None:
    """No small turn or move brings a shape closer to the mean."""
    given = ellipsoids(6)
    atlas = Atlas.of(moved(given.points + 0.03 * np.sin(9 * given.points)), given.faces)
    for offset in atlas.offsets(atlas.scores):
        assert np.abs(atlas.weights @ offset).max() < 1e-9
        assert np.abs(atlas.weights @ np.cross(atlas.mean, offset)).max() < 1e-8


def test_a_mirror_image_is_another_shape() -> None:
    """It is turned to lie as well as it can, and never reflected."""
    given = ellipsoids(4, spread=np.full(3, 0.01))
    handed = given.points + 0.4 * np.prod(given.points, axis=2)[..., None] * [1, 0.5, 0.2]
    handed[3] = handed[0] * [-1, 1, 1]
    atlas = Atlas.of(handed, given.faces)
    assert np.allclose(np.linalg.det(atlas.align(handed)[1].rotations), 1)
    assert atlas.distances.argmax() == 3
    assert atlas.distances[3] > 5 * np.abs(handed[1] - handed[0]).max()


def test_known_modes_are_found() -> None:
    given = ellipsoids(400, splits=1)
    atlas = Atlas.of(moved(given.points), given.faces)
    assert len(atlas.modes) == 3
    ball = icosphere(1).verts
    true = [ball * np.eye(3)[k] for k in (2, 1, 0)]
    length = [np.sqrt(np.einsum("vi,v,vi->", each, atlas.weights, each)) for each in true]
    for mode, each in zip(atlas.modes, true, strict=True):
        assert angle(mode, each, atlas.weights) < 8  # random axes are not quite uncorrelated
    assert atlas.deviations == pytest.approx(SPREAD[::-1] * length, rel=0.12)
    assert np.allclose(atlas.mean, ball * given.axes.mean(axis=0), atol=1e-9)
    assert abs(np.corrcoef(atlas.scores[:, 0], given.axes[:, 2])[0, 1]) > 0.99
    assert atlas.scores.std(axis=0, ddof=1) == pytest.approx(1)


def test_poses_order_and_unit_do_not_matter() -> None:
    given = ellipsoids(9)
    plain = Atlas.of(given.points, given.faces)
    other = Atlas.of(moved(given.points), given.faces)
    assert np.allclose(plain.scores, other.scores)
    assert np.allclose(plain.mean, other.mean)
    back = Atlas.of(list(given.points[::-1]), given.faces)
    assert np.allclose(plain.scores[::-1], back.scores)
    large = Atlas.of(1000 * given.points, given.faces)
    assert np.allclose(plain.scores, large.scores)
    assert np.allclose(1000 * plain.deviations, large.deviations)


def test_finer_triangles_count_no_more() -> None:
    """A side of the shape in four times as many triangles: plain components would follow it."""
    given = ellipsoids(8, splits=3)
    plain = Atlas.of(given.points, given.faces)
    centers = icosphere(3).verts[given.faces].mean(axis=1)
    fine = centers[:, 0] > 0
    V = given.points.shape[1]
    number = V + np.cumsum(fine) - 1
    points = np.concatenate([given.points, given.points[:, given.faces[fine]].mean(axis=2)], axis=1)
    a, b, c = given.faces[fine].T
    split = [np.stack(each, 1) for each in ((a, b, number[fine]), (b, c, number[fine]), (c, a, number[fine]))]
    finer = Atlas.of(points, np.concatenate([given.faces[~fine], *split]))
    assert finer.deviations == pytest.approx(plain.deviations, rel=0.01)
    unweighted = np.linalg.svd((points - points.mean(axis=0)).reshape(8, -1) / np.sqrt(points.shape[1]))[1] / np.sqrt(7)
    assert unweighted[0] != pytest.approx(plain.deviations[0], rel=0.01)


def test_size_is_kept_or_removed() -> None:
    given = ellipsoids(10, spread=np.array([0, 0, 0.05]))
    factors = np.linspace(0.5, 2, 10)
    points = moved(given.points * factors[:, None, None])
    kept = Atlas.of(points, given.faces)
    assert np.corrcoef(kept.scores[:, 0], factors)[0, 1] > 0.99
    removed = Atlas.of(points, given.faces, scale="remove")
    assert np.corrcoef(removed.scores[:, 0], given.axes[:, 2])[0, 1] > 0.99
    assert removed.compactness[0] > 0.999
    assert removed.sizes == pytest.approx(kept.sizes, rel=1e-3)
    size = np.sqrt(removed.weights @ np.square(removed.mean).sum(axis=1))
    assert size == pytest.approx(removed.sizes.mean(), rel=1e-3)
    found = removed.project(7 * points[3])
    assert np.allclose(found.scores, removed.scores[3])
    assert np.allclose(found.shape.verts, 7 * points[3])


def spoilt(count: int, outliers: int) -> tuple[np.ndarray, np.ndarray]:
    """Ellipsoids with a little noise, the last of which are something else."""
    given = ellipsoids(count)
    random = np.random.default_rng(3)
    points = given.points + 0.002 * random.standard_normal(given.points.shape)
    points[-outliers:, :, 0] += 4 * np.sin(3 * points[-outliers:, :, 1])
    return moved(points), given.faces


def test_outliers_lead_astray_unless_asked() -> None:
    points, faces = spoilt(24, 5)
    ball = icosphere(2).verts
    classical, robust = (Atlas.of(points, faces, robust=robust) for robust in (False, True))
    assert angle(classical.modes[0], ball * [0, 0, 1], classical.weights) > 45
    assert angle(robust.modes[0], ball * [0, 0, 1], robust.weights) < 12
    clean = Atlas.of(points[:-5], faces)
    size = np.sqrt(clean.weights @ np.square(clean.mean).sum(axis=1))
    wrong = [np.linalg.norm(each.mean - clean.mean, axis=1).mean() / size for each in (classical, robust)]
    assert wrong[1] < 0.05 < wrong[0]
    assert robust.deviations[0] == pytest.approx(clean.deviations[0], rel=0.5)
    far = np.argsort(-robust.distances)[:5]
    assert set(far.tolist()) == {19, 20, 21, 22, 23}


def test_robust_modes_of_clean_shapes_are_the_usual_ones() -> None:
    given = ellipsoids(300, splits=1)
    usual, robust = (Atlas.of(given.points, given.faces, robust=robust) for robust in (False, True))
    for one, other in zip(usual.modes, robust.modes, strict=True):
        assert angle(one, other, usual.weights) < 6
    assert robust.deviations == pytest.approx(usual.deviations, rel=0.15)
    some = given.points[7]
    assert np.allclose(robust.project(some).shape.verts, some, atol=1e-6)


def test_a_further_shape_is_projected() -> None:
    given = ellipsoids(20)
    atlas = Atlas.of(given.points, given.faces)
    for k in (0, 7):
        again = atlas.project(moved(given.points[[0, k]], 5)[1])
        assert np.allclose(again.scores, atlas.scores[k])
        assert again.residual < 1e-9
    new = AXES + np.array([0.01, -0.02, 0.3])
    ball = icosphere(2).verts
    found = atlas.project(ball * new)
    assert np.allclose(found.shape.verts, ball * new)
    assert np.allclose(atlas.shape(found.scores).verts, ball * new)
    assert np.array_equal(found.shape.faces, given.faces)
    dented = ball * new
    dented[5] *= 1.3
    found = atlas.project(dented)
    assert found.distance.argmax() == 5
    assert found.residual == pytest.approx(atlas.weights @ found.distance)
    assert found.residual > 1e-3


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_fit_is_projected_in_its_file(mirrored: bool) -> None:
    """Wherever the file has it, whatever its unit, and as its mirror image if it is one."""
    given = ellipsoids(20)
    points = given.points + 0.05 * np.sin(7 * given.points[..., ::-1])  # with a left and a right
    atlas = Atlas.of(points, given.faces, template="abc")
    rotation = Rotation.random(rng=1).as_matrix() * ([[-1], [1], [1]] if mirrored else 1)
    fit = some_fit(points[4] / 50, given.faces, frame=Frame(50.0, rotation, np.array([7.0, 8, 9])), template_hash="abc")
    found = atlas.project(fit)
    assert np.allclose(found.scores, atlas.scores[4], atol=1e-4)
    assert np.allclose(found.shape.verts, fit.points_in_file)
    assert np.array_equal(found.shape.faces, fit.shape.faces)
    with pytest.raises(OptionError, match="another template"):
        atlas.project(some_fit(points[4], given.faces, template_hash="abd"))


def test_few_modes_are_the_first_of_all() -> None:
    given = ellipsoids(20)
    atlas, few = Atlas.of(given.points, given.faces), Atlas.of(given.points, given.faces, modes=1)
    assert np.allclose(few.modes, atlas.modes[:1])
    assert np.allclose(few.compactness, atlas.compactness[:1])
    assert few.compactness[0] < 0.98
    assert few.project(given.points[2]).residual > 1e-3
    assert np.allclose(atlas.shape([2.0]).verts, atlas.mean + 2 * atlas.deviations[0] * atlas.modes[0])


def test_random_shapes_vary_like_the_collection() -> None:
    given = ellipsoids(50)
    atlas = Atlas.of(given.points, given.faces)
    first, again, longer = atlas.sample(3, 1), atlas.sample(3, 1), atlas.sample(400, 1)
    assert all(np.array_equal(one.verts, other.verts) for one, other in zip(first, again, strict=True))
    assert all(np.array_equal(one.verts, other.verts) for one, other in zip(first, longer, strict=False))
    assert not np.array_equal(first[0].verts, atlas.sample(1, 2)[0].verts)
    scores = np.stack([atlas.project(shape.verts).scores for shape in longer])
    assert scores.std(axis=0) == pytest.approx(1, abs=0.12)
    assert scores.mean(axis=0) == pytest.approx(0, abs=0.2)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    given = ellipsoids(5)
    atlas = Atlas.of(
        given.points, given.faces, [f"é-{k}.ply" for k in range(5)], scale="remove", robust=True, template="abc"
    )
    atlas.save(tmp_path / FILE)
    for path in (tmp_path, tmp_path / FILE, str(tmp_path)):
        again = Atlas.load(path)
        for name, value in vars(atlas).items():
            if name not in ("mean_shape", "laid"):
                assert np.array_equal(getattr(again, name), value), name
    atlas.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / FILE).read_bytes()


def test_short_numbers_become_long_ones(tmp_path: Path) -> None:
    given = ellipsoids(5)
    atlas = Atlas.of(given.points, given.faces)
    short = {each.name: np.asarray(getattr(atlas, each.name)) for each in fields(atlas) if each.name != "groups"}
    np.savez(tmp_path / FILE, **short | {"weights": short["weights"].astype(np.float16), "version": np.int64(1)})
    found = Atlas.load(tmp_path)
    assert found.weights.dtype == np.float64 and np.allclose(found.weights, atlas.weights, rtol=1e-2)


def test_another_file_is_refused(tmp_path: Path) -> None:
    given = ellipsoids(5)
    Atlas.of(given.points, given.faces).save(tmp_path / FILE)
    with np.load(tmp_path / FILE) as arrays:
        good = dict(arrays)
    file = tmp_path / "bad.npz"
    bad = {
        "version": good | {"version": np.int64(2)},
        "versions": good | {"version": np.array([1, 1])},
        "word": good | {"version": np.array("1")},
        "still": good | {"deviations": good["deviations"] * 0},
        "no size": good | {"sizes": -good["sizes"]},
        "weightless": good | {"weights": good["weights"] * 0},
        "huge": good | {"deviations": good["deviations"] * 1e200},
        "one": good | {"modes": np.array(1.0)},
        "missing": {name: array for name, array in good.items() if name != "modes"},
        "sizes": good | {"scores": good["scores"][:-1]},
        "nan": good | {"mean": good["mean"] * np.nan},
        "faces": good | {"faces": good["faces"] + 10_000},
        "scale": good | {"scale": np.array("huge")},
        "objects": good | {"names": np.array([None] * 5)},
    }
    for what, arrays in bad.items():
        np.savez(file, **arrays)
        with pytest.raises(InputError) as refused:
            Atlas.load(file)
        assert "\n" not in str(refused.value), what
    file.write_bytes((tmp_path / FILE).read_bytes()[:200])
    with pytest.raises(InputError, match="can be read"):
        Atlas.load(file)
    with pytest.raises(InputError, match="no atlas"):
        Atlas.load(tmp_path / "nowhere")


def test_what_is_no_collection() -> None:
    given = ellipsoids(4)
    points, faces = given.points, given.faces
    with pytest.raises(InputError, match="three shapes"):
        Atlas.of(points[:2], faces)
    with pytest.raises(InputError, match="do not differ"):
        Atlas.of([points[0]] * 4, faces)
    with pytest.raises(InputError, match="different names"):
        Atlas.of(points, faces, ["a", "b", "c", "a"])
    with pytest.raises(InputError, match="shape 2 is an array"):
        Atlas.of([points[0], points[1], points[2][:-1]], faces)
    with pytest.raises(InputError, match="not finite"):
        Atlas.of([*points[:3], points[3] * np.nan], faces)
    with pytest.raises(InputError, match="faces"):
        Atlas.of(points, faces + 1)
    with pytest.raises(OptionError, match="scale"):
        Atlas.of(points, faces, scale="size")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="mode"):
        Atlas.of(points, faces, modes=0)
    atlas = Atlas.of(points, faces)
    with pytest.raises(InputError, match="scores"):
        atlas.shape(np.zeros(9))
    with pytest.raises(InputError, match="points"):
        atlas.project(points[0][:-1])
    with pytest.raises(InputError, match="'nobody'"):
        atlas.distance_from_mean("nobody")
    with pytest.raises(OptionError):
        atlas.sample(-1)


def test_many_shapes_are_read_in_parts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The same atlas, from a file, a few shapes at a time."""
    given = ellipsoids(11)
    plain = Atlas.of(given.points, given.faces)
    np.save(tmp_path / "points.npy", given.points)
    monkeypatch.setattr("meshmatch.collections.superimpose._BLOCK", 3 * given.points[0].size)
    parts = Atlas.of(np.load(tmp_path / "points.npy", mmap_mode="r"), given.faces)
    assert np.allclose(plain.scores, parts.scores)
    assert np.allclose(plain.mean, parts.mean)


def test_nothing_of_the_callers_is_changed() -> None:
    given = ellipsoids(4)
    points, faces = given.points.copy(), given.faces.copy()
    atlas = Atlas.of(points, faces)
    assert np.array_equal(given.points, points)
    assert points.flags.writeable
    assert faces.flags.writeable
    assert not atlas.mean.flags.writeable


@pytest.mark.parametrize("robust", [False, True])
def test_a_sketch_of_many_shapes_is_enough(monkeypatch: pytest.MonkeyPatch, robust: bool) -> None:
    """No matrix of all inner products, and still the same modes."""
    given = ellipsoids(60, splits=1)
    points = moved(given.points + 0.005 * np.random.default_rng(1).standard_normal(given.points.shape))
    plain = Atlas.of(points, given.faces, modes=3, robust=robust)
    monkeypatch.setattr("meshmatch.collections.modes._MAX_EXACT", 20)
    monkeypatch.setattr("meshmatch.collections.superimpose._BLOCK", 7 * points[0].size)
    sketch = Atlas.of(points, given.faces, modes=3, robust=robust)
    assert np.allclose(sketch.mean, plain.mean, atol=1e-5)
    assert sketch.deviations == pytest.approx(plain.deviations, rel=1e-4)
    assert np.allclose(sketch.scores, plain.scores, atol=2e-3)
    assert np.allclose(sketch.modes, plain.modes, atol=2e-3)
    assert sketch.total == pytest.approx(plain.total, rel=0.1 if robust else 1e-6)
    with pytest.raises(InputError, match="do not differ"):
        Atlas.of([points[0]] * 30, given.faces)
