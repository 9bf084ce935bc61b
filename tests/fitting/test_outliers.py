"""Strays among the points of a cloud, normals whose side nobody knows, clouds that are none, and what shapes hide."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.api.inputs import repair_or_raise
from meshmatch.api.matching import register
from meshmatch.errors import InputError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.discontinuities import discontinuous_share, neighbours
from meshmatch.fitting.search.predictor import one_way_residual, two_way_residual
from meshmatch.fitting.search.task import take_samples, without_interior, without_outliers
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.fitting.eggs import egg_model, scan_of

NO_FACES = np.empty((0, 3), np.int64)
FEW = FitConfig(variants=2, finalists=1, careful=1)


def body(P: int, seed: int = 0) -> np.ndarray:
    """Points (P, 3) of a sample body, in centimetres."""
    dancer = load_shape(bundled_folder() / "samples" / "dancer.ply")
    return sample_surface(dancer, P, np.random.default_rng(seed)).points


def around(points: np.ndarray, P: int, seed: int = 1) -> np.ndarray:
    """Points (P, 3) anywhere in a box a little larger than a cloud's."""
    low, high = points.min(0), points.max(0)
    return np.random.default_rng(seed).uniform(1.2 * low - 0.2 * high, 1.2 * high - 0.2 * low, (P, 3))


def test_strays_are_left_out_and_surface_is_not(system: NodeSystem) -> None:
    surface = Shape(system.verts, system.faces, "egg")
    points = sample_surface(surface, 900, np.random.default_rng(0)).points
    away = np.random.default_rng(1).standard_normal((40, 3))
    strays = away / np.linalg.norm(away, axis=1)[:, None] * np.linspace(0.6, 0.9, 40)[:, None]
    kept = {tuple(point) for point in without_outliers(Shape(np.concatenate([points, strays]), NO_FACES)).verts}
    assert sum(tuple(point) in kept for point in strays) < 15
    assert sum(tuple(point) in kept for point in points) > 0.97 * len(points)
    assert without_outliers(surface) is surface


def test_only_clouds_have_strays(system: NodeSystem) -> None:
    """A spike of a mesh is surface: its triangles say so."""
    verts = np.array(system.verts)
    verts[7] *= 5
    mesh, cloud = Shape(verts, system.faces), Shape(verts, NO_FACES, "thorn")
    assert without_outliers(mesh) is mesh
    left = without_outliers(cloud)
    assert left.name == "thorn"
    assert tuple(verts[7]) not in {tuple(point) for point in left.verts}


def test_a_sparse_region_is_not_stray() -> None:
    """Far from each other, but not further than their neighbours are from theirs."""
    fine = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0), [0.0]), -1).reshape(-1, 3)
    corner = np.array([30.5, 0.0, 0.0])
    coarse = corner + 4 * np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0), [0.0]), -1).reshape(-1, 3)
    inside = (coarse[:, 0] > 40) & (coarse[:, 0] < 70) & (coarse[:, 1] > 6) & (coarse[:, 1] < 38)
    left = {tuple(point) for point in without_outliers(Shape(np.concatenate([fine, coarse]), NO_FACES)).verts}
    assert all(tuple(point) in left for point in coarse[inside])


def test_samples_of_a_cloud_have_no_sure_side_and_no_strays(system: NodeSystem) -> None:
    surface = Shape(system.verts, system.faces)
    assert take_samples(surface, 50, np.random.default_rng(0))[1].signed
    points = sample_surface(surface, 400, np.random.default_rng(0)).points
    cloud = Shape(np.concatenate([points, [[0.0, 0.0, 0.9], [0.0, 0.9, 0.0]]]), NO_FACES)
    frame, scan = take_samples(cloud, 402, np.random.default_rng(0))
    assert not scan.signed
    assert not scan.to_local(RigidPose(np.eye(3), np.ones(3))).signed and not scan.first(10).signed
    assert np.linalg.norm(frame.undo(scan.points), axis=1).max() < 0.8


def test_normals_take_the_side_of_the_template(system: NodeSystem) -> None:
    scan = scan_of(Shape(system.verts, system.faces), 700)
    wrong = np.random.default_rng(0).random(700) < 0.5
    mixed = OrientedPoints(scan.points, np.where(wrong[:, None], -scan.normals, scan.normals), signed=False)
    surface = system.surface(np.zeros((system.K, 3)))
    faced = mixed.facing(surface)
    assert faced.signed
    assert ((faced.normals * scan.normals).sum(1) > 0.99).mean() > 0.97
    assert scan.facing(surface) is scan


def test_residuals_and_tears_ignore_a_side_that_is_not_known(system: NodeSystem) -> None:
    scan, still = scan_of(Shape(system.verts, system.faces), 900), np.zeros((system.K, 3))
    flipped = OrientedPoints(scan.points, -scan.normals)
    for residual in (two_way_residual, one_way_residual):
        right = residual(system, scan, still)
        assert residual(system, flipped, still) > 2 * right
        assert residual(system, OrientedPoints(scan.points, -scan.normals, signed=False), still) == pytest.approx(right)
    unsure = OrientedPoints(scan.points, -scan.normals, signed=False)
    right, wrong, turned = (
        discontinuous_share(system, neighbours(each), each, still) for each in (scan, flipped, unsure)
    )
    assert wrong != right == turned


def test_a_cloud_is_tried_as_a_part_only_where_it_leaves_the_template_bare(
    monkeypatch: pytest.MonkeyPatch, system: NodeSystem
) -> None:
    """A residual says that a cloud is sparse and noisy, not that something is missing."""
    tried = []

    def part(task):
        tried.append(task)
        raise KeyboardInterrupt

    monkeypatch.setattr("meshmatch.fitting.fitter.fit_part", part)
    points = sample_surface(Shape(system.verts, system.faces), 900, np.random.default_rng(0)).points
    noise = 0.05 * np.random.default_rng(1).standard_normal(points.shape)
    Fitter(egg_model(), FEW).fit(Shape(points + noise, NO_FACES))
    assert not tried
    half = sample_surface(Shape(system.verts, system.faces), 3000, np.random.default_rng(0)).points
    half = half[np.abs(half[:, 1]) > 0.18]  # two caps with nothing between
    with pytest.raises(KeyboardInterrupt):
        Fitter(egg_model(), FEW).fit(Shape(half, NO_FACES))


@pytest.mark.slow
def test_a_tenth_of_strays_changes_little_and_nine_tenths_are_told() -> None:
    points = body(1000)
    with_strays = np.concatenate([points[:900], around(points, 100)])
    clean, rough = (register(Shape(cloud, NO_FACES), config=FEW) for cloud in (points, with_strays))
    assert rough.verdict != "poor" and not rough.partial
    apart = np.linalg.norm(rough.points_in_file - clean.points_in_file, axis=1)
    assert apart.mean() < 4  # centimetres
    assert len(rough.vertex_distance) == repair_or_raise(Shape(with_strays, NO_FACES)).shape.V > 950
    nowhere = Shape(np.concatenate([points[:100], around(points, 900)]), NO_FACES)
    lost = register(nowhere, config=replace(FEW, partial="no"))
    assert lost.verdict == "poor" and lost.reasons


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.ones((500, 3)), "has only 1 distinct point position"),
        (np.eye(3), "has only 3 distinct point positions"),
        (np.outer(np.linspace(0, 1, 500), [1.0, 2.0, 3.0]), "all its points lie on a line"),
        (np.full((500, 3), np.nan), "not finite"),
    ],
    ids=["equal", "three", "line", "nan"],
)
def test_what_is_no_cloud_is_refused_in_one_line(points: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        register(Shape(points, NO_FACES, "thing"))
    assert "\n" not in str(caught.value) and caught.value.hint


@pytest.mark.slow
def test_a_point_at_the_end_of_the_world_is_a_stray() -> None:
    points = body(600)
    far = np.concatenate([points, [[1e30, 0.0, 0.0], [0.0, -1e15, 0.0]]])
    here, there = (register(Shape(cloud, NO_FACES), config=replace(FEW, refine="none")) for cloud in (points, far))
    assert there.verdict == here.verdict != "poor"
    assert np.linalg.norm(here.points_in_file - there.points_in_file, axis=1).mean() < 4  # centimetres


def nested(outer: Shape, size: float) -> Shape:
    """A shape with a smaller copy inside."""
    return Shape(
        np.concatenate([outer.verts, size * outer.verts]), np.concatenate([outer.faces, outer.faces + outer.V])
    )


def test_what_lies_inside_neither_pulls_nor_counts(system: NodeSystem) -> None:
    egg = Shape(system.verts, system.faces, "egg")
    assert without_interior(nested(egg, 0.7), system).F == egg.F
    alone, with_it = (Fitter(egg_model(), FEW).fit(shape) for shape in (egg, nested(egg, 0.7)))
    assert with_it.residual < 1.2 * alone.residual


def test_a_template_with_chambers_keeps_those_of_shapes(system: NodeSystem) -> None:
    hollow = nested(Shape(system.verts, system.faces), 0.7)
    assert system.shows_all and not NodeSystem(hollow, system.field).shows_all
    shape = nested(Shape(system.verts, system.faces), 0.6)
    assert without_interior(shape, NodeSystem(hollow, system.field)) is shape
