"""Girths, lengths and angles on shapes whose measurements are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.api.measure import own_points
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.transfer.landmarks import at_points, load_landmarks
from meshmatch.transfer.measurements import (
    Measurement,
    Measurements,
    MeasuringPoints,
    load_measurements,
    measured_values,
    save_measurements,
)

AROUND = Measurement("around", "girth", ("side", "bottom", "top"))
ALONG = Measurement("along", "distance", ("bottom", "top"))
SQUARE = Measurement("square", "angle", ("side", "bottom", "corner"))
NAMES = ("side", "bottom", "top", "corner")


def tube(outline: np.ndarray, x: float = 0.0) -> Shape:
    """An upright tube of height 2 around an outline (N, 2), in rows of triangles."""
    N, heights = len(outline), np.linspace(0, 2, 9)
    verts = np.concatenate([np.column_stack([outline[:, 0] + x, np.full(N, y), outline[:, 1]]) for y in heights])
    row = np.arange(N)
    lower, upper, after = row, row + N, (row + 1) % N
    one = np.concatenate([np.stack([lower, upper, after], 1), np.stack([after, upper, after + N], 1)])
    return Shape(verts, np.concatenate([one + k * N for k in range(8)]), "tube")


def circle(radius: float, N: int = 40) -> np.ndarray:
    angle = 2 * np.pi * np.arange(N) / N
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def points_on(shape: Shape, measurements: list[Measurement], x: float = 0.0, height: float = 1.1) -> MeasuringPoints:
    marks = np.array([[x + 1, height, 0], [x + 1, 0, 0], [x + 1, 2, 0], [x, 0, 1]])
    return MeasuringPoints.of(shape, at_points(shape, marks, NAMES)[0], measurements)


def taken(points: MeasuringPoints) -> Measurements:
    return points.taken(points.points)


def test_a_tube_is_measured() -> None:
    shape = tube(circle(1.0))
    found = taken(points_on(shape, [AROUND, ALONG, SQUARE]))
    assert found.names == ("around", "along", "square") and found.confidence.tolist() == [1, 1, 1]
    assert found.values == pytest.approx([2 * 40 * np.sin(np.pi / 40), 2.0, 90.0], rel=1e-9)
    assert np.allclose(found.lines[0][:, 1], 1.1) and np.allclose(found.lines[0][0], found.lines[0][-1])


def test_a_girth_through_vertices_is_the_same() -> None:
    """The plane may pass through a whole row of vertices, or stand oblique."""
    shape = tube(circle(1.0))
    for height in (0.25, 1.0):
        assert taken(points_on(shape, [AROUND], height=height)).values[0] == pytest.approx(6.2767, rel=1e-4)
    oblique = Measurement("oblique", "girth", ("side", "corner", "top"))
    assert taken(points_on(shape, [oblique])).values[0] > 6.4


def test_a_tape_does_not_follow_hollows() -> None:
    star = circle(1.0) * np.where(np.arange(40) % 2, 0.7, 1.0)[:, None]
    assert taken(points_on(tube(star), [AROUND])).values[0] == pytest.approx(2 * 20 * np.sin(np.pi / 20))


def test_a_girth_goes_around_what_its_landmark_lies_on() -> None:
    """Not around the other leg, which the same plane cuts; also where copies of vertices make a seam."""
    first, second = tube(circle(1.0)), tube(circle(0.5), x=4.0)
    both = Shape(
        np.concatenate([first.verts, second.verts]), np.concatenate([first.faces, second.faces + first.V]), "legs"
    )
    apart = Shape(both.verts[both.faces].reshape(-1, 3), np.arange(3 * both.F).reshape(-1, 3), "soup")
    for shape in (both, apart):
        assert taken(points_on(shape, [AROUND])).values[0] == pytest.approx(6.2767, rel=1e-4)
        points = [[4.5, 1.1, 0], [4.5, 0, 0], [4.5, 2, 0]]
        marks = at_points(shape, np.array(points), NAMES[:3])[0]
        assert taken(MeasuringPoints.of(shape, marks, [AROUND])).values[0] == pytest.approx(6.2767 / 2, rel=1e-4)


def test_points_of_coarse_outlines_are_near_to_each_other() -> None:
    """So that a girth of a finer target is not that of the few edges of its source."""
    points = points_on(tube(circle(1.0, 4)), [AROUND]).points.points
    steps = np.linalg.norm(np.diff(points[np.argsort(np.arctan2(points[:, 2], points[:, 0]))], axis=0), axis=1)
    assert steps.max() < 0.1


def test_what_is_not_trusted_is_missing() -> None:
    points = points_on(tube(circle(1.0)), [AROUND, ALONG])
    places = points.points
    around = places.points[: points.ends[0]]

    def with_low(low: np.ndarray, minimum: float = 0.3) -> np.ndarray:
        rest = np.zeros(len(places.names) - len(low), bool)
        sure = np.where(np.concatenate([low, rest]), 0.1, 0.9)
        return points.taken(replace(places, confidence=sure), minimum).values

    fifth, half = np.abs(np.arctan2(around[:, 2], around[:, 0])) < 0.2 * np.pi, around[:, 0] < 0
    assert with_low(fifth)[0] == pytest.approx(2 * np.pi * 0.8 + 2 * np.sin(0.2 * np.pi), rel=0.01)  # straight across
    assert np.isnan(with_low(half)[0]) and with_low(half)[1] == pytest.approx(2.0)
    assert with_low(half, 0.0)[0] == pytest.approx(6.2767, rel=1e-4)
    sure = np.ones(len(places.names))
    sure[-1] = 0.1  # an end of the distance
    found = points.taken(replace(places, confidence=sure), 0.3)
    assert np.isnan(found.values).tolist() == [False, True] and len(found.lines[1]) == 0
    unknown = points.taken(replace(places, confidence=np.full(len(sure), np.nan)), 0.3)  # as of others' maps
    assert np.isfinite(unknown.values).all() and np.isnan(unknown.confidence).all()


def test_a_shape_is_measured_along_a_map(sphere: Shape) -> None:
    """In the unit of its own file."""
    stretched = Shape(sphere.verts * [2, 3, 2], sphere.faces[::-1], "stretched")
    marks = at_points(sphere, np.array([[1.0, 0, 0], [0, -1, 0], [0, 1, 0]]), NAMES[:3])[0]
    map = VertexMap.between(sphere, stretched, np.arange(sphere.V))
    found = meshmatch.measure(sphere, stretched, [AROUND, ALONG], marks, map)
    assert found.data.values == pytest.approx([4 * np.pi, 6.0], rel=0.01)
    cloud = Shape(stretched.verts, np.empty((0, 3), np.int64), "cloud")
    map = VertexMap.between(sphere, cloud, np.arange(sphere.V))
    assert meshmatch.measure(sphere, cloud, [AROUND], marks, map).data.values[0] == pytest.approx(4 * np.pi, rel=0.02)


def test_files(tmp_path: Path) -> None:
    table = tmp_path / "what.csv"
    table.write_text("name,kind,a,b,c\naround,girth,side,bottom,top\nalong,Distance,bottom,top,\n")
    assert load_measurements(table) == (AROUND, ALONG)
    table.write_text("around;girth;side;bottom;top\n")  # without a header, as spreadsheets write it
    assert load_measurements(table) == (AROUND,)
    found = taken(points_on(tube(circle(1.0)), [AROUND, ALONG]))
    found = replace(found, values=np.array([found.values[0], np.nan]))
    for name in ("m.csv", "m.json"):
        save_measurements(tmp_path / name, found)
        values = measured_values(tmp_path / name)
        assert list(values) == ["around", "along"] and np.isnan(values["along"])
        assert values["around"] == pytest.approx(found.values[0])
    with pytest.raises(MeshmatchError, match=r"'\.txt' is not a format for measurements"):
        save_measurements(tmp_path / "m.txt", found)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,height,top,bottom", "'height' is no kind of measurement"),
        ("a,girth,top,bottom,", "girth needs three landmarks, not 2"),
        ("a,angle,top,side,bottom,corner", "angle needs three landmarks, not 4"),
        ("a,distance,top,", "distance needs two landmarks or more, not 1"),
        ("a,distance,top,bottom\na,distance,side,top", "two measurements are called 'a'"),
        ("a,distance,top,botom", "no landmark is called 'botom'"),
        ("name,kind,first,second", "there is nothing to measure"),
        ("a,girth,side,top,top", "are one point"),
    ],
)
def test_what_cannot_be_measured_is_told(tmp_path: Path, text: str, message: str) -> None:
    table = tmp_path / "what.csv"
    table.write_text(text + "\n")
    with pytest.raises(InputError, match=message):
        points_on(tube(circle(1.0)), list(load_measurements(table)))


def test_a_girth_needs_a_surface_that_its_plane_cuts() -> None:
    shape = tube(circle(1.0))
    cloud = Shape(shape.verts, np.empty((0, 3), np.int64), "cloud")
    with pytest.raises(InputError, match="a girth needs a surface, and cloud has none"):
        points_on(cloud, [AROUND])
    flat = Shape(shape.verts * [1, 0, 1], shape.faces, "flat")
    marks = at_points(flat, np.tile([1.0, 0, 0], (3, 1)), NAMES[:3])[0]
    marks = replace(marks, points=np.array([[1.0, 0, 0], [0, 0, 0], [0, 1, 0]]))
    with pytest.raises(InputError, match="does not cut the surface"):
        MeasuringPoints.of(flat, marks, [AROUND])


def test_the_body_has_the_measurements_of_a_person() -> None:
    """In meters: what its maker read off sections of the template."""
    points = own_points("body")
    found = taken(points)
    assert len(found.names) == 30
    values = dict(zip(found.names, 100 * found.values, strict=True))
    known = {
        "head girth": 57.6,
        "waist girth": 78.6,
        "left calf girth": 37.4,
        "left inside leg length": 82.5,
        "right wrist girth": 16.2,
        "left foot length": 26.9,
    }
    assert {name: values[name] for name in known} == pytest.approx(known, abs=0.3)
    for name in found.names:
        if name.startswith("left "):
            assert values[name] == pytest.approx(values["right" + name[4:]], rel=0.02)
    side = {"left": 1, "right": -1}
    landmarks = load_landmarks(bundled_folder() / "measurements" / "body-landmarks.csv", points.shape)[0]
    for name, x in zip(landmarks.names, landmarks.points[:, 0], strict=True):
        if (first := name.split()[0]) in side:
            assert 0.1 < side[first] * x, name


def test_a_source_of_ones_own_needs_both(sphere: Shape) -> None:
    with pytest.raises(MeshmatchError, match="the measurements are needed"):
        meshmatch.measure(sphere, sphere)
    with pytest.raises(MeshmatchError, match="the landmarks are needed"):
        meshmatch.measure(sphere, sphere, [ALONG])
    with pytest.raises(MeshmatchError, match="str is no measurement"):
        meshmatch.measure(sphere, sphere, ["waist"], [0])  # type: ignore[list-item]
