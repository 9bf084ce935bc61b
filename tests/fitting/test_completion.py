"""Parts completed by the template: what counts as visible, what stands in, and a body that was cut."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.api.inputs import as_model
from meshmatch.experiments.bench.partial import part_of
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.judge.features import area_share, visible_vertices
from meshmatch.fitting.search.candidates import completed
from meshmatch.fitting.search.predictor import Candidate
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.fitting.eggs import egg_model, scan_of


def above(system: NodeSystem, height: float) -> OrientedPoints:
    whole = scan_of(Shape(system.verts, system.faces), 4000)
    keep = whole.points[:, 1] > height
    return OrientedPoints(whole.points[keep], whole.normals[keep])


def test_all_of_a_whole_is_seen_and_nothing_beyond_a_cut(system: NodeSystem) -> None:
    still = np.zeros((system.K, 3))
    assert visible_vertices(system, above(system, -9.0), still).mean() > 0.97
    there = visible_vertices(system, above(system, 0.0), still)
    y = system.verts[:, 1]
    assert there[y > 0.06].mean() > 0.97
    assert not there[y < -0.07].any()
    area = Shape(system.verts, system.faces).vertex_areas
    assert area_share(system, there) == pytest.approx(area[y > 0].sum() / area.sum(), abs=0.08)
    assert area_share(system, np.ones(len(y), bool)) == pytest.approx(1.0)


class Threads:
    """Stands for a system: vertices that face up, each moved by a vector of its own."""

    def __init__(self, verts: np.ndarray) -> None:
        self.verts = verts

    def surface(self, vectors: np.ndarray) -> OrientedPoints:
        return facing_up(self.verts + vectors)


def facing_up(points: np.ndarray) -> OrientedPoints:
    return OrientedPoints(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))


def test_what_is_seen_is_near_and_belongs_there() -> None:
    """A thread that is shown but for a loop that was pulled out of it; and another one, which lies upon it."""
    x = np.linspace(0, 1, 21)
    thread = np.stack([x, 0 * x, 0 * x], 1)
    both = Threads(np.concatenate([thread, thread + np.array([2.0, 0, 0])]))
    vectors = np.zeros_like(both.verts)
    vectors[10] = [0, 0, 0.2]
    vectors[21:] = [-2.0, 0, 0.03]
    shown = np.delete(thread, 10, 0)
    there = visible_vertices(both, facing_up(shown), vectors)  # type: ignore[arg-type]
    assert there.nonzero()[0].tolist() == [n for n in range(21) if n != 10]


def test_the_edge_of_a_cut_is_no_counterpart_of_what_lies_beyond(system: NodeSystem) -> None:
    """A template squeezed towards the cut comes near to its edge everywhere, and is not seen for that."""
    nodes = egg_model().template.nodes
    squeezed = np.zeros_like(nodes)
    squeezed[:, 1] = np.where(nodes[:, 1] < 0, -0.9 * nodes[:, 1], 0)
    there = visible_vertices(system, above(system, 0.0), squeezed)
    assert there[system.verts[:, 1] < -0.12].mean() < 0.1


def test_what_is_missing_stands_in_as_densely(system: NodeSystem) -> None:
    still, scan = np.zeros((system.K, 3)), above(system, 0.0)
    there = visible_vertices(system, scan, still)
    share = area_share(system, there)
    whole = completed(system, scan, still, share, np.random.default_rng(0))
    bare = np.array([face for face in system.faces if not there[face].any()])
    count = round(len(scan.points) * Shape(system.verts, bare).area / share)
    assert len(whole.points) == len(scan.points) + count
    rows = {tuple(point) for point in whole.points}
    assert all(tuple(point) in rows for point in scan.points)
    added = np.array(list(rows - {tuple(point) for point in scan.points}))
    assert added[:, 1].max() < 0.08 and added[:, 1].min() < 0.9 * system.verts[:, 1].min()
    assert len(whole.points) == pytest.approx(len(scan.points) / share, rel=0.15)
    assert np.allclose(np.linalg.norm(whole.normals, axis=1), 1)
    everything = above(system, -9.0)
    assert len(completed(system, everything, still, 1.0, np.random.default_rng(0)).points) < 4200


def test_normals_of_no_sure_side_are_turned_first(system: NodeSystem) -> None:
    scan, still = above(system, 0.0), np.zeros((system.K, 3))
    inward = OrientedPoints(scan.points, -scan.normals, signed=False)
    assert (visible_vertices(system, inward, still) == visible_vertices(system, scan, still)).mean() > 0.97
    whole = completed(system, inward, still, 0.5, np.random.default_rng(0))
    assert ((whole.normals * whole.points).sum(1) > 0).mean() > 0.97


def test_what_stands_in_lies_on_the_fit_and_is_mixed_in(system: NodeSystem) -> None:
    longer = np.zeros((system.K, 3))
    longer[:, 1] = 0.3 * egg_model().template.nodes[:, 1]
    egg = scan_of(Shape(system.moved(longer), system.faces), 4000)
    upper = egg.points[:, 1] > 0
    scan = OrientedPoints(egg.points[upper], egg.normals[upper])
    whole = completed(system, scan, longer, 0.5, np.random.default_rng(0))
    assert cKDTree(egg.points).query(whole.points)[0].max() < 0.06
    assert whole.points[:, 1].min() == pytest.approx(egg.points[:, 1].min(), abs=0.02)
    apart, which = cKDTree(scan.points).query(whole.points)
    own = apart == 0
    assert own.sum() == len(scan.points)
    assert np.array_equal(whole.normals[own], scan.normals[which[own]])
    quarter = len(own) // 4  # what is coarse takes the first points alone
    assert own[:quarter].mean() == pytest.approx(own.mean(), abs=0.1)


def test_a_small_part_is_not_drowned(system: NodeSystem) -> None:
    scan = above(system, float(np.quantile(system.verts[:, 1], 0.9)))
    whole = completed(system, scan, np.zeros((system.K, 3)), 0.2, np.random.default_rng(0))
    assert len(whole.points) == 4 * len(scan.points)


def test_what_is_seen_is_measured_by_area(system: NodeSystem) -> None:
    area = np.zeros(len(system.verts))
    for face in system.faces:
        a, b, c = system.verts[face]
        area[face] += np.linalg.norm(np.cross(b - a, c - a)) / 6
    there = area > np.median(area)
    assert area_share(system, there) == pytest.approx(area[there].sum() / area.sum())
    assert area_share(system, there) > there.mean() + 0.05


def test_a_candidate_knows_its_size_and_what_it_costs() -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    fit = Candidate(RigidPose(turn, np.array([1.0, 0, 0])), np.zeros((1, 3)), 0.02, share=0.25)
    scan = OrientedPoints(np.array([[4.0, 2, 0]]), np.array([[1.0, 0, 0]]))
    local = fit.local(scan)
    assert np.allclose(local.points, (np.array([[2.0, 1, 0]]) - [1, 0, 0]) @ turn)
    assert np.allclose(local.normals, scan.normals @ turn)
    assert fit.cost > replace(fit, share=0.5).cost > fit.residual


@pytest.mark.slow
def test_half_of_a_body_is_read_as_what_it_is(remembered_fits: Callable) -> None:
    body = load_shape(bundled_folder() / "samples" / "dancer.ply")
    half, used = part_of(body, "cut", 0)
    model = as_model("human")
    whole, part = Fitter(model).fit(body), Fitter(model).fit(half)
    assert part.partial and part.verdict == "fair"
    told = float(part.reasons[-1].split(": ")[1].split(" %")[0]) / 100
    assert told > 0.2  # of half of the body that is missing, some lies near to what is not
    rest = whole.resting
    true = rest[cKDTree(whole.points).query(whole.frame.apply(body.verts[used]))[1]]
    found = rest[cKDTree(part.points).query(part.frame.apply(half.verts))[1]]
    assert np.linalg.norm(found - true, axis=1).mean() < 0.03  # units of sqrt(area): 4 cm
