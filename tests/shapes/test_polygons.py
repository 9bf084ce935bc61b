"""Polygons become triangles that cover them once, whatever their shape, and fans where they are convex."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import MeshmatchWarning
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats import polygons
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.textured_files import load_appearance, load_coordinates


def polygon(corners: str) -> list[tuple[int, int]]:
    """Corners of one digit each: "00 10 01" is a triangle."""
    return [(int(x), int(y)) for x, y in corners.split()]


ARROW = [(0, 0), (2, -1), (0, 3), (-2, -1)]
ELL = polygon("00 40 41 11 13 03")
COMB = polygon("00 70 74 64 61 51 54 44 41 31 34 24 21 01")
CEE = polygon("00 30 31 11 12 32 33 03")
ON_A_LINE = polygon("00 10 20 30 33 23 11 13 03 02 01")
KEYHOLE = polygon("00 60 66 06 00 22 24 44 42 22")  # a square with a square hole
SPIRAL = polygon("00 60 66 16 12 42 44 34 33 23 25 55 51 01")


def star(count: int, seed: int = 0) -> np.ndarray:
    """A polygon around the origin, of any radii."""
    rng = np.random.default_rng(seed)
    angle = (np.arange(count) + rng.uniform(0, 0.8, count)) * 2 * np.pi / count
    return rng.uniform(0.2, 1.0, count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def snake(count: int) -> np.ndarray:
    """A thin band that winds through the plane, `count` corners along each side."""
    t = np.linspace(0, 1, count)
    middle = np.stack([10 * t, np.sin(40 * t)], axis=1)
    return np.concatenate([middle, middle[::-1] + np.array([0, 0.05])])


def shoelace(points: np.ndarray) -> float:
    x, y = np.asarray(points, float).T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def signed(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (np.asarray(points, float)[triangles[:, k]] for k in range(3))
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def in_space(points: np.ndarray, seed: int) -> np.ndarray:
    """The same polygon somewhere in space."""
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return np.c_[np.asarray(points, float), np.zeros(len(points))] @ turn.T + [7.0, -3.0, 11.0]


@pytest.mark.parametrize(
    "points",
    [ARROW, ELL, COMB, CEE, ON_A_LINE, KEYHOLE, SPIRAL, star(5), star(9), star(40), star(150), snake(80)],
    ids=["arrow", "ell", "comb", "cee", "line", "keyhole", "spiral", "star5", "star9", "star40", "star150", "snake"],
)
def test_concave_polygons_are_covered_once(points: np.ndarray) -> None:
    """Whichever corner comes first, and from both sides."""
    area = shoelace(points)
    for first in range(0, len(points), max(1, len(points) // (1 if len(points) > 30 else 5))):
        for way in (1, -1):
            turned = np.roll(np.asarray(points, float), first, axis=0)[::way]
            triangles = triangles_of("a", in_space(turned, first), np.arange(len(points)), np.array([len(points)]))
            areas = way * signed(turned, triangles)
            assert triangles.shape == (len(points) - 2, 3)
            assert set(triangles.ravel()) == set(range(len(points)))
            assert areas.min() > -1e-9 and areas.sum() == pytest.approx(area)


def test_convex_polygons_are_fans() -> None:
    rng = np.random.default_rng(3)
    sizes = rng.integers(0, 12, 500)
    verts, start = [], 0
    for size in sizes:
        angle = np.sort(rng.uniform(0, 2 * np.pi, size))
        circle = np.stack([3 * np.cos(angle), np.sin(angle)], axis=1)
        verts.append(in_space(circle, int(size)).round(5) if size else np.empty((0, 3)))
    corners = rng.permutation(int(sizes.sum()))
    places = triangles_of("a", np.concatenate(verts)[np.argsort(corners)], corners, sizes)
    expected = []
    for size in sizes.tolist():
        expected += [[start, start + k, start + k + 1] for k in range(1, size - 1)]
        start += size
    np.testing.assert_array_equal(places, expected)


@pytest.mark.parametrize(
    "points",
    [
        [(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0)],  # a bow tie
        [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), (1, 0, 0)],  # no area
        [(0, 0, 0)] * 6,
        [(0, 0, 0), (2, 0, 0), (np.nan, 0, 0), (1, 0.2, 0)],
        [(0, 0, 0), (2, 0, 0), (2, 2, 0), (1, 1e300, 0), (0, 2, 0)],
        [(np.cos(4 * np.pi * k / 5), np.sin(4 * np.pi * k / 5), 0) for k in range(5)],  # a star of five strokes
        [(0, 0, 0), (4, 0, 0), (4, 2, 0), (0, -2, 0), (0, -4, 0), (5, -4, 0)],  # crosses itself
    ],
)
def test_what_is_no_polygon_is_a_fan(points: list[tuple[float, float, float]]) -> None:
    many = len(points)
    places = triangles_of("a", np.array(points, float), np.arange(many), np.array([many]))
    np.testing.assert_array_equal(places, [[0, k, k + 1] for k in range(1, many - 1)])


def test_corners_that_are_no_vertices_are_left_to_whoever_judges_them() -> None:
    places = triangles_of("a", in_space(ARROW, 1), np.array([0, 1, 2, 99, -3, 1, 2, 3, 0]), np.array([4, 5]))
    assert len(places) == 5


def test_each_polygon_is_split_as_if_it_were_alone() -> None:
    shapes = [ARROW, ELL, star(6), star(40, 1), polygon("00 10 01"), COMB, CEE, star(7, 4), ARROW[::-1], star(33, 5)]
    verts = np.concatenate([in_space(points, k) for k, points in enumerate(shapes)])
    sizes = np.array([len(points) for points in shapes])
    starts = np.cumsum(sizes) - sizes
    alone = [
        triangles_of("a", verts, np.arange(start, start + size), np.array([size])) + start
        for start, size in zip(starts, sizes, strict=True)
    ]
    np.testing.assert_array_equal(triangles_of("a", verts, np.arange(len(verts)), sizes), np.concatenate(alone))


def test_polygons_of_too_many_corners_are_said() -> None:
    def crescent(half: int) -> np.ndarray:
        t = np.linspace(0.1, np.pi - 0.1, half)
        arc = np.stack([np.cos(t), np.sin(t)], axis=1)
        return np.concatenate([arc, (arc * [1.0, 0.8])[::-1]])

    def split(points: np.ndarray) -> float:
        verts, many = in_space(points, 0), len(points)
        places = triangles_of("moon.ply", verts, np.arange(many), np.array([many]))
        return float(np.abs(signed(points, places)).sum())

    points = crescent(200)
    assert split(points) == pytest.approx(abs(shoelace(points)))
    points = crescent(polygons.MAX_CORNERS // 2 + 1)
    with pytest.warns(MeshmatchWarning, match="moon.ply: a polygon has too many corners"):
        assert split(points) > 1.5 * abs(shoelace(points))


def test_the_work_on_one_file_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polygons, "MAX_TESTS", 2 * len(COMB) ** 2)
    verts = np.concatenate([in_space(COMB, k) for k in range(5)])
    with pytest.warns(MeshmatchWarning, match="3 polygons have too many corners"):
        triangles_of("a", verts, np.arange(len(verts)), np.full(5, len(COMB)))


def test_quads_are_split_together(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    ears = polygons._clip_ears
    monkeypatch.setattr(
        polygons, "_clip_ears", lambda places, sizes: [calls.append(len(sizes)), ears(places, sizes)][1]
    )
    rng = np.random.default_rng(0)
    verts = rng.normal(size=(100_000, 3))
    corners, sizes = rng.integers(0, len(verts), 4 * 50_000), np.full(50_000, 4)
    assert len(triangles_of("a", verts, corners, sizes)) == 100_000
    assert sum(calls) > 10_000 and len(calls) < 5


@pytest.mark.parametrize("suffix", ["obj", "off", "ply", "faces first"])
@pytest.mark.parametrize("points", [ARROW, ELL, COMB], ids=["arrow", "ell", "comb"])
def test_files_of_every_format(tmp_path: Path, suffix: str, points: list[tuple[float, float]]) -> None:
    verts, many = in_space(points, 5), len(points)
    rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in verts.tolist())
    face = " ".join(map(str, range(many)))
    ply = f"element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}{many} {face}\n"
    of_vertices = f"element vertex {many}\nproperty double x\nproperty double y\nproperty double z\n"
    of_faces, start = "element face 1\nproperty list uchar int vertex_indices\n", "ply\nformat ascii 1.0\n"
    text = {
        "obj": "".join(f"v {row}\n" for row in rows.splitlines()) + "f " + " ".join(str(k + 1) for k in range(many)),
        "off": f"OFF\n{many} 1 0\n{rows}{many} {face}\n",
        "ply": f"{start}{of_vertices}{ply}",
        "faces first": f"{start}{of_faces}{of_vertices}end_header\n{many} {face}\n{rows}",
    }[suffix]
    path = tmp_path / ("a.ply" if suffix == "faces first" else f"a.{suffix}")
    path.write_text(text)
    shape = load_shape(path)
    assert shape.area == pytest.approx(shoelace(points)) and shape.F == many - 2


def test_texture_coordinates_are_split_with_the_polygon(tmp_path: Path) -> None:
    """Each corner keeps its own, which are those of its place: u = x, v = y."""
    text, places = "mtllib a.mtl\n", []
    for k, points in enumerate([ARROW, ELL, [(0, 0), (1, 0), (1, 1), (0, 1)], CEE]):
        first = len(places) + 1
        places += [(x, y) for x, y in points]
        text += "".join(f"v {x} {y} {k}\nvt {x / 10} {y / 10}\n" for x, y in points)
        text += f"usemtl m{k % 2}\nf " + " ".join(f"{first + n}/{n - len(points)}" for n in range(len(points))) + "\n"
    path = tmp_path / "a.obj"
    path.write_text(text)
    (tmp_path / "a.mtl").write_text("newmtl m0\nKd 1 0 0\nnewmtl m1\nKd 0 1 0\n")
    shape = load_shape(path)
    expected = shape.verts[shape.faces][..., :2] / 10
    found = load_coordinates(path, shape)
    assert found is not None
    np.testing.assert_allclose(found[..., 0], expected[..., 0])
    np.testing.assert_allclose(1 - found[..., 1], expected[..., 1])
    look = load_appearance(path, shape)
    names = [look.materials[k].name for k in look.material.tolist()]
    assert names == ["m0"] * 2 + ["m1"] * 4 + ["m0"] * 2 + ["m1"] * 6
