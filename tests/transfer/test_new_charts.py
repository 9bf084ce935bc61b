"""New charts: they lie flat and apart, hold together, and do not cover themselves."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from meshmatch.geometry.triangles import planar_areas, triangle_areas
from meshmatch.shapes.shape import Shape
from meshmatch.transfer import chart_regions as chart_regions_module
from meshmatch.transfer import hinged_charts
from meshmatch.transfer import pack_charts as pack_charts_module
from meshmatch.transfer.chart_regions import chart_regions
from meshmatch.transfer.flat_layout import Layout, flatten_faces
from meshmatch.transfer.new_charts import new_charts
from meshmatch.transfer.pack_charts import Chart, pack_charts, smallest_rectangle
from meshmatch.transfer.texels import draw_triangles
from meshmatch.transfer.tighten_charts import tighten
from meshmatch.transfer.whole_polygons import unfold_polygon
from tests.conftest import icosphere
from tests.growth import grows_with_size


def sheet(count: int = 12, bend: float = 1.0) -> Shape:
    """A square bent about the y axis by an angle."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, 1, count + 1)] * 2, indexing="ij"))
    angle = bend * (x - 0.5)
    verts = np.stack([np.sin(angle) / max(bend, 1e-9), y, np.cos(angle) / max(bend, 1e-9)], axis=1)
    at = np.arange((count + 1) ** 2).reshape(count + 1, -1)
    a, b, c, d = (each.ravel() for each in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return Shape(verts, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def scaled(shape: Shape) -> np.ndarray:
    return np.asarray(shape.verts / np.sqrt(shape.face_areas.sum()))


@pytest.mark.parametrize("bend", [0.01, 3.0])
def test_what_can_be_unrolled_is_laid_flat_without_stretch(bend: float) -> None:
    shape = sheet(bend=bend)
    laid = flatten_faces(shape.verts, shape.faces, 1.5, 128)
    assert laid is not None and not len(laid.bad)
    np.testing.assert_allclose(np.linalg.det(np.diff(laid.uv[laid.corners], axis=1)) / 2, shape.face_areas, rtol=0.01)


def test_what_cannot_lie_flat_is_told() -> None:
    ball, two = icosphere(2), sheet(2)
    assert flatten_faces(ball.verts, ball.faces, 1.5, 128) is None
    assert flatten_faces(two.verts, two.faces[[0, 7]], 1.5, 128) is None  # they do not hang together
    spiral = sheet(40, bend=0.01)
    whole = flatten_faces(spiral.verts, spiral.faces, 1.5, 128)
    assert whole is not None
    uv = whole.uv.copy()
    uv[:, 0] = np.abs(uv[:, 0] - uv[:, 0].mean())  # folded in the middle
    folded = type(whole).of(uv, whole.corners, whole.visible, 512)
    assert len(folded.bad) > spiral.F / 3


def strip(turns: float, wider: float, closed: bool = False, hole: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A band around 0, counterclockwise, so much wider after each turn; its ends may be one."""
    steps = int(40 * turns)
    angle = 2 * np.pi * np.linspace(0, turns, steps, endpoint=not closed)
    inner = hole + wider * angle / (2 * np.pi)
    uv = np.concatenate([r[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1) for r in (inner, inner + 0.5)])
    a = np.arange(steps if closed else steps - 1)
    b, c, d = (a + 1) % steps, a + steps, (a + 1) % steps + steps
    return uv, np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)])


@pytest.mark.parametrize(
    ("turns", "wider", "closed", "covered"),
    [
        (0.9, 0.0, False, False),
        (1.2, 0.0, False, True),
        (2.5, 0.6, False, False),  # a spiral beside itself
        (2.5, 0.3, False, True),
        (1.0, 0.0, True, False),  # a ring
        (2.0, 0.0, True, True),  # a ring that goes round twice
    ],
)
def test_what_lies_on_itself_is_found(turns: float, wider: float, closed: bool, covered: bool) -> None:
    uv, corners = strip(turns, wider, closed)
    layout = Layout.of(uv, corners, np.ones(len(corners), bool), 256)
    assert bool(len(layout.bad)) == covered and (layout.pair is not None) == covered
    image = (uv[corners] / np.abs(uv).max() + 1) * 512
    assert bool(draw_triangles(image, 1024)[1]) == covered


def test_two_pieces_on_one_another_are_found() -> None:
    uv, corners = strip(1.0, 0.0, True)
    disk, rest = strip(1.0, 0.0, True, 0.3)
    for scale, covered in ((0.2, False), (1.5, True)):  # within its hole, and on it
        both = Layout.of(
            np.concatenate([uv, scale * disk]), np.concatenate([corners, rest + len(uv)]), np.ones(160, bool), 256
        )
        assert bool(len(both.bad)) == covered


def test_a_smooth_surface_needs_few_charts(torus: Shape) -> None:
    charts = chart_regions(scaled(torus), torus.faces, np.arange(torus.F))
    assert 2 <= len(charts) <= 24
    members = np.concatenate([chart.members for chart in charts])
    np.testing.assert_array_equal(np.sort(members), np.arange(torus.F))
    areas = triangle_areas(scaled(torus), torus.faces)
    for chart in charts:
        laid = chart.uv[chart.corners]
        assert (np.linalg.det(np.diff(laid, axis=1)) > 0).all()
        assert planar_areas(laid).sum() == pytest.approx(areas[chart.members].sum(), rel=1e-6)


def test_borders_on_fine_surfaces_are_smoothed_by_way_of_a_copy_between(monkeypatch: pytest.MonkeyPatch) -> None:
    """All triangles, as often as the surface is finer than its copy, would grow with the square of their number."""
    done = []

    def counted(surface: Any, region: np.ndarray, steps: int) -> np.ndarray:
        done.append((len(surface.faces), steps))
        return smooth(surface, region, steps)

    smooth = chart_regions_module._smooth_regions
    monkeypatch.setattr(chart_regions_module, "_smooth_regions", counted)
    monkeypatch.setattr(chart_regions_module, "_COARSE_FACES", 100)
    monkeypatch.setattr(chart_regions_module, "_MAX_SMOOTHING", 40)
    ball = icosphere(4)  # 5,120 triangles
    charts = chart_regions(scaled(ball), ball.faces, np.arange(ball.F))
    np.testing.assert_array_equal(np.sort(np.concatenate([chart.members for chart in charts])), np.arange(ball.F))
    assert len(charts) < 30
    assert max(steps for _, steps in done) < 10 and done[-1][0] == ball.F


def test_charts_fill_the_image(torus: Shape) -> None:
    uv = new_charts(scaled(torus), torus.faces, 1024, 4)
    assert planar_areas(uv).sum() > 0.55
    assert draw_triangles(uv * 2048, 2048)[1] == 0


def test_loose_triangles_end_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is a chart of its own, and all of them have room; all but some stand in rows."""
    monkeypatch.setattr(pack_charts_module, "_MAX_PIECES", 12)
    rng = np.random.default_rng(0)
    verts = (rng.random((600, 1, 3)) + 0.01 * rng.normal(size=(600, 3, 3))).reshape(-1, 3)
    faces = np.arange(1800).reshape(-1, 3)
    uv = new_charts(scaled(Shape(verts, faces)), faces, 1024, 8)
    assert uv.min() >= 0 and uv.max() <= 1
    assert (planar_areas(uv) > 0).all()
    assert draw_triangles(uv * 4096, 4096)[1] == 0


def test_small_closed_pieces_are_unfolded() -> None:
    """Boxes of one kind, each of which needs two charts or more where all of their common border must stay closed."""
    box = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([[a, b, c] for a, b, c, d in sides for a, b, c in ((a, b, c), (a, c, d))])
    rng = np.random.default_rng(0)
    verts = np.concatenate([box * rng.uniform(0.5, 1.5, 3) + [3.0 * k, 0, 0] for k in range(300)])
    faces = np.concatenate([faces + 8 * k for k in range(300)])
    verts = scaled(Shape(verts, faces))
    charts = chart_regions(verts, faces, np.arange(len(faces)) // 2)
    assert len(charts) < 450
    assert np.array_equal(np.sort(np.concatenate([chart.members for chart in charts])), np.arange(len(faces)))
    for chart in charts:
        laid = chart.uv[chart.corners]
        one, two = laid[:, 1] - laid[:, 0], laid[:, 2] - laid[:, 0]
        assert (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0] > 0).all()
        image = (laid - laid.min(axis=(0, 1))) / np.ptp(laid, axis=(0, 1)).max()
        assert draw_triangles(image * 512, 512)[1] == 0


def test_a_polygon_of_thousands_of_corners_is_unfolded() -> None:
    """A disc, cut in triangles between its rim's ends from both sides, which all lie in one plane."""

    def prepared(count: int) -> Callable[[], tuple[Any, ...]]:
        angle = 2 * np.pi * np.arange(count) / count
        disc = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
        low, high = np.arange(count // 2 - 1), count - 1 - np.arange(count // 2 - 1)
        faces = np.concatenate([np.stack([low, low + 1, high], 1), np.stack([low + 1, high - 1, high], 1)])
        return lambda: (disc, faces, *unfold_polygon(disc, faces))

    disc, faces, laid, corners = grows_with_size(prepared, 16_000)
    sides = [np.linalg.norm(each[:, [1, 2, 0]] - each, axis=2) for each in (laid[corners], disc[faces])]
    assert np.allclose(*sides, atol=1e-9)


def strand(bend: float, count: int = 12, around: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """A closed tube with pointed ends, bent by an angle."""
    along, turn = np.linspace(0, 1, count + 1), 2 * np.pi * np.arange(around) / around
    radius = (0.02 + 0.1 * np.sin(np.pi * along))[:, None]
    away, angle = 1 / bend + radius * np.cos(turn), bend * along[:, None]
    verts = np.stack([away * np.cos(angle), away * np.sin(angle), radius * np.sin(turn)], axis=2).reshape(-1, 3)
    at = np.arange(len(verts)).reshape(count + 1, around)
    a, b, c, d = (each.ravel() for each in (at[:-1], at[1:], np.roll(at, -1, 1)[1:], np.roll(at, -1, 1)[:-1]))
    ends = [
        [at[end, 0], at[end, k], at[end, k + 1]][:: 1 if end else -1] for end in (0, -1) for k in range(1, around - 1)
    ]
    return verts, np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1), np.array(ends)])


def test_pairs_that_both_bend_are_laid_flat_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Strands of hair need two charts each where both keep their form: there are too many then."""
    pieces = [strand(bend) for bend in np.linspace(1.0, 2.5, 40)]
    verts = np.concatenate([verts + np.array([4.0 * k, 0, 0]) for k, (verts, _) in enumerate(pieces)])
    faces = np.concatenate([faces + len(pieces[0][0]) * k for k, (_, faces) in enumerate(pieces)])
    verts = scaled(Shape(verts, faces))
    charts = chart_regions(verts, faces, np.arange(len(faces)))
    assert len(charts) <= 60
    assert np.array_equal(np.sort(np.concatenate([chart.members for chart in charts])), np.arange(len(faces)))
    for chart in charts:
        layout = Layout.of(chart.uv, chart.corners, np.ones(len(chart.members), bool), 512)
        assert not len(layout.bad)
    monkeypatch.setattr(hinged_charts, "_MIN_CHARTS_REFLATTEN", len(faces))
    assert len(chart_regions(verts, faces, np.arange(len(faces)))) > 60


def test_pieces_come_closer_and_stay_apart() -> None:
    rng = np.random.default_rng(0)
    images, at = [], []
    for k in range(25):  # disks and rectangles, one in the middle of each cell of a grid
        high, wide = rng.integers(12, 24, 2)
        image = np.ones((high, wide), bool)
        if k % 2:
            y, x = np.ogrid[:high, :wide]
            image = ((y - high / 2 + 0.5) / high) ** 2 + ((x - wide / 2 + 0.5) / wide) ** 2 < 0.25
        images.append(image)
        at.append((32 * (k // 5), 32 * (k % 5)))
    found, end = tighten(images, np.array(at), 2, 400, np.random.default_rng(0))
    assert end < 130  # from 4 * 32 and a piece
    where = np.zeros((end, end), int)
    for number, (image, (y, x)) in enumerate(zip(images, found.tolist(), strict=True), 1):
        assert y >= 0 and x >= 0 and not where[y : y + len(image), x : x + image.shape[1]][image].any()
        where[y : y + len(image), x : x + image.shape[1]][image] = number
    for number in range(1, 26):
        near = where[maximum_filter(where == number, 5)]  # two texels around
        assert set(near.tolist()) <= {0, number}
    assert tighten(images, np.array(at), 2, 0, np.random.default_rng(0))[1] > end + 10


def test_packed_rectangles_are_apart() -> None:
    rng = np.random.default_rng(1)
    corners = np.array([[0, 1, 2], [0, 2, 3]])
    charts = [
        Chart(np.array([2 * k, 2 * k + 1]), np.array([[0, 0], [w, 0], [w, h], [0, h]]), corners)
        for k, (w, h) in enumerate(rng.uniform(0.2, 1.0, (12, 2)))
    ]
    places = pack_charts(charts, 8 / 512)
    low, high = (np.array([getattr(each, end)(axis=0) for each in places]) * 512 for end in ("min", "max"))
    for one in range(12):
        for two in range(one):
            gap = np.maximum(low[one] - high[two], low[two] - high[one]).max()
            assert gap >= 8
    scales = [
        np.ptp(each, axis=0).prod() / np.ptp(chart.uv, axis=0).prod()
        for each, chart in zip(places, charts, strict=True)
    ]
    np.testing.assert_allclose(scales, scales[0], rtol=1e-6)  # of one density
    assert sum(np.ptp(each, axis=0).prod() for each in places) > 0.6


def test_the_smallest_rectangle() -> None:
    angle = 0.3
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    found, area = smallest_rectangle(np.array([[0, 0], [3, 0], [3, 1], [0, 1], [1, 0.5]]) @ turn)
    assert found == pytest.approx(angle) and area == pytest.approx(3.0)


def test_padding_that_leaves_no_room_is_less() -> None:
    square, corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    charts = [Chart(np.arange(2), square, corners) for _ in range(70)]
    found = pack_charts(charts, 0.125)  # an eighth of the image around each of 70
    assert all(uv.min() >= 0 and uv.max() <= 1 for uv in found)
    low, high = (np.array([edge(uv, axis=0) for uv in found]) for edge in (np.min, np.max))
    assert (high - low).min() > 0.01
    gaps = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=2)
    assert gaps[~np.eye(70, dtype=bool)].min() > 0.02
