"""Girths, lengths and angles on shapes whose measurements are known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.api.measure import measuring_points
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.transfer import measurements
from meshmatch.transfer.landmarks import at_points, at_vertices, join_landmarks, load_landmarks
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


def measured(source: Shape, target: Shape, index: np.ndarray, sure: np.ndarray | None = None) -> Measurements:
    marks = at_points(source, np.array([[1, 1.1, 0], [1, 0, 0], [1, 2, 0], [0, 0, 1]]), NAMES)[0]
    map = VertexMap.between(source, target, index, confidence=sure)
    return meshmatch.measure(source, target, [AROUND, SQUARE], marks, map).data


def test_what_is_lost_of_a_girth_goes_by_its_length() -> None:
    """Not by points: one half of the outline has many small edges."""
    angle = np.concatenate([np.linspace(-0.5, 0.5, 200, endpoint=False), np.linspace(0.5, 1.5, 6, endpoint=False)])
    shape = tube(np.column_stack([np.cos(np.pi * angle), np.sin(np.pi * angle)]))
    far = shape.verts[:, 0] < -0.01
    found = measured(shape, shape, np.arange(shape.V), np.where(far, 0.1, 0.9))
    assert np.isnan(found.values[0]) and 0.4 < found.confidence[0] < 0.6
    assert measured(shape, shape, np.arange(shape.V), np.where(far, 0.9, 0.1)).confidence[1] == pytest.approx(0.1)


def test_a_girth_that_a_map_tears_is_missing() -> None:
    """Some of it goes to another limb, or all of it goes to a few points of a cloud."""
    shape = tube(circle(1.0))
    other = tube(circle(1.0), x=6.0)
    two = Shape(np.concatenate([shape.verts, other.verts]), np.concatenate([shape.faces, other.faces + shape.V]))
    index, ahead = np.arange(shape.V), shape.verts[:, 0] > 0.98
    assert measured(shape, two, index).values[0] == pytest.approx(6.2767, rel=1e-4)
    assert np.isnan(measured(shape, two, np.where(ahead, index + shape.V, index)).values[0])
    for count, known in ((5, False), (10, True)):
        cloud = Shape(np.column_stack([circle(1.0, count), np.ones(count)])[:, [0, 2, 1]], np.empty((0, 3), np.int64))
        value = measured(shape, cloud, (index % 40) * count // 40).values[0]
        assert np.isnan(value) != known and (not known or value == pytest.approx(6.28, rel=0.02))


def test_an_angle_needs_two_ways() -> None:
    shape = tube(circle(1.0))
    found = measured(shape, shape, np.zeros(shape.V, np.int64))
    assert np.isnan(found.values[1]) and len(found.lines[1]) == 0
    with pytest.raises(InputError, match="two of its landmarks are one point"):
        points_on(shape, [Measurement("none", "angle", ("side", "side", "top"))])


def test_a_girth_of_a_surface_that_is_open_there_is_refused() -> None:
    shape = tube(circle(1.0))
    for least, is_open in ((-0.8, False), (0.0, True)):
        part = Shape(shape.verts, shape.faces[shape.verts[shape.faces][:, :, 0].min(axis=1) > least], "part")
        if is_open:
            with pytest.raises(
                InputError, match="more than a quarter of the girth is missing, because the surface is open"
            ):
                points_on(part, [AROUND])
        else:
            assert taken(points_on(part, [AROUND])).values[0] == pytest.approx(6.2, rel=0.02)


def test_it_is_clear_which_landmarks_are_meant() -> None:
    """Also where they are numbers, or their letters are composed otherwise; not if two have one name, or one is missing."""
    shape = tube(circle(1.0))
    marks = at_vertices(shape, np.array([3, 5, 9, 9]), ("\u00e9pine\u00a0iliaque", "5", "end", "end"))
    meant = Measurement("a", "distance", ["e\u0301pine  iliaque", 5])  # type: ignore[arg-type]
    assert MeasuringPoints.of(shape, marks, [meant]).points.vertex.tolist() == [3, 5]
    with pytest.raises(InputError, match="two landmarks are called 'end'"):
        MeasuringPoints.of(shape, marks, [Measurement("a", "distance", ("5", "end"))])
    with pytest.raises(InputError, match="landmark 5 is missing"):
        MeasuringPoints.of(shape, marks.without(np.array([False, True, False, False])), [meant])
    with pytest.raises(InputError, match="its landmarks are one word"):
        Measurement("a", "distance", "ab")  # type: ignore[arg-type]


def test_each_landmark_is_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many there are, and distances between them."""
    shape, calls = tube(circle(1.0)), []
    monkeypatch.setattr(measurements, "join_landmarks", lambda *given: calls.append(1) or join_landmarks(*given))
    points_on(shape, [replace(ALONG, name=str(k)) for k in range(9)])
    assert len(calls) == 1
    monkeypatch.setattr(measurements, "_MAX_POINTS", 400)
    with pytest.raises(InputError, match="the girths up to 2 go through more than 400 points"):
        points_on(shape, [replace(AROUND, name=str(k)) for k in range(9)])


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
    table.write_text("name,kind,landmarks\nalong, distance,bottom ,top\n,,,\naround,girth,side,bottom,top\n")
    assert load_measurements(table) == (ALONG, AROUND)  # rows as long as they need be
    found = taken(points_on(tube(circle(1.0)), [AROUND, ALONG]))
    found = replace(found, values=np.array([found.values[0], np.nan]))
    for name in ("m.csv", "m.json"):
        save_measurements(tmp_path / name, found)
        values = measured_values(tmp_path / name)
        assert list(values) == ["around", "along"] and np.isnan(values["along"])
        assert values["around"] == pytest.approx(found.values[0])
        odd = ("#1; left", 'the "long"\tone')
        save_measurements(tmp_path / name, replace(found, names=odd))
        assert tuple(measured_values(tmp_path / name)) == odd
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
        ("a,distance,side,,top", "one of its landmarks has no name"),
        (",distance,side,top", "a measurement has no name"),
        ("a", "'' is no kind of measurement"),
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
    """In metres: what its maker read off sections of the template."""
    points = measuring_points("body")
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
    with pytest.raises(MeshmatchError, match="no landmark is called 'bottom'"):  # one, not in a list
        meshmatch.measure(sphere, sphere, ALONG, [0])  # type: ignore[arg-type]
    with pytest.raises(MeshmatchError, match="str is no measurement"):
        meshmatch.measure(sphere, sphere, ["waist"], [0])  # type: ignore[list-item]
