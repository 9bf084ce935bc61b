"""Two shapes matched without a model: proposals, nodes on the shape itself, the energy that decides."""

from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from meshmatch.fitting.direct import match_directly, match_either_side
from meshmatch.fitting.fit import axis_name
from meshmatch.fitting.judge.direct import DirectFeatures, judge_direct
from meshmatch.fitting.one_way import DirectConfig, ShapeData, fit_all_fine, slide_all
from meshmatch.fitting.search.intrinsic import Intrinsic, SimplifiedMesh, shortest_tour
from meshmatch.fitting.search.motions import turns_onto_itself
from meshmatch.fitting.search.proposals import (
    Assignments,
    Proposal,
    extremity_proposals,
    rigid_proposals,
    spectral_proposals,
)
from meshmatch.fitting.solve.driver import minimise
from meshmatch.fitting.solve.surface_nodes import SurfaceNodes
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.progress import Progress
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.mirror_images import alignment_residuals, mirrored

QUICK = DirectConfig(coarse=900, fine=1800, samples=2500, second_samples=1000, first_samples=600, n_second=6, n_third=3)
QUICKER = replace(
    QUICK, coarse=300, fine=600, samples=1000, second_samples=400, first_samples=300, n_second=4, n_third=2
)
# limbs of a creature: where they point, how long and how wide they are
LIMBS = (
    ((1, 0.2, 0), 1.2, 0.04),
    ((-1, 0.2, 0.1), 0.9, 0.04),
    ((0.2, 1, 0), 1.5, 0.03),
    ((0, -0.4, 1), 0.7, 0.05),
    ((0.1, -1, -0.5), 0.5, 0.06),
)


def creature(fineness: int = 4) -> Shape:
    """A ball with limbs of different lengths."""
    ball = trimesh.creation.icosphere(subdivisions=fineness)
    way = np.asarray(ball.vertices)
    radius = np.full(len(way), 0.5)
    for direction, length, width in LIMBS:
        unit = np.array(direction) / np.linalg.norm(direction)
        radius += length * np.exp(-(1 - way @ unit) / width)
    return frame_applied(Shape(way * radius[:, None], np.asarray(ball.faces), "creature"))


def frame_applied(shape: Shape) -> Shape:
    return Shape(sqrt_area_frame(shape).apply(shape.verts), shape.faces, shape.name)


def bent(shape: Shape, turn: Rotation, size: float = 1.0) -> Shape:
    """Another pose of the same vertices: its upper half twisted and bent; turned, and in another unit."""
    x, y, z = shape.verts.T
    angle = 0.8 * y
    verts = np.stack([x * np.cos(angle) + z * np.sin(angle) + 0.3 * y**2, y, z * np.cos(angle) - x * np.sin(angle)], 1)
    return Shape(size * turn.apply(verts), shape.faces, "bent")


def thinned(shape: Shape, faces: int) -> Any:
    """Which vertices of a shape are those of its thinned mesh."""
    return cKDTree(shape.verts).query(SimplifiedMesh.of(shape, faces).verts)[1]


@pytest.fixture(scope="module")
def pair() -> tuple[Shape, Shape]:
    source = creature(3)
    return source, bent(source, Rotation.from_euler("xyz", (70, 130, -40), degrees=True), 250.0)


@pytest.fixture(scope="module")
def thin() -> SimplifiedMesh:
    return SimplifiedMesh.of(creature(), 900)


def test_extremities_are_the_ends_of_limbs_and_limbs_run_from_zero_to_one(thin: SimplifiedMesh) -> None:
    surface = Intrinsic(thin)
    ends = thin.verts[surface.extremities]
    tips = np.array([np.array(way) / np.linalg.norm(way) for way, *_ in LIMBS])
    own = (ends / np.linalg.norm(ends, axis=1, keepdims=True)) @ tips.T
    assert len(ends) == len(LIMBS) and sorted(own.argmax(1)) == list(range(len(LIMBS)))
    assert own.max(1).min() > 0.95
    reach, along = surface.limbs
    assert np.allclose(along[surface.extremities, np.arange(len(ends))], 1) and along.min() > -1e-9
    assert (reach > 0.2).all()
    assert surface.landmark_distances.max() <= 1 and (surface.landmark_distances[~np.eye(300, dtype=bool)] > 0).all()


def test_distances_bridge_separate_parts() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    verts = np.concatenate([ball.vertices, ball.vertices + np.array([3, 0, 0]), ball.vertices + np.array([6, 0, 0])])
    faces = np.concatenate([ball.faces + k * len(ball.vertices) for k in range(3)])
    surface = Intrinsic(SimplifiedMesh.of(Shape(verts, faces), 10_000))
    distances = surface.distances_from(np.arange(len(surface.mesh.verts)))
    assert np.isfinite(distances).all() and np.allclose(distances, distances.T)
    assert np.allclose(distances @ surface.mesh.areas, surface.eccentricity, atol=0.02)


@pytest.mark.parametrize("make", [extremity_proposals, spectral_proposals])
def test_a_map_of_the_surface_is_among_the_proposals(make: Any, pair: tuple[Shape, Shape]) -> None:
    meshes = [SimplifiedMesh.of(frame_applied(shape), 900) for shape in pair]
    found = make(*(Intrinsic(mesh) for mesh in meshes))
    true = frame_applied(pair[1]).verts[thinned(frame_applied(pair[0]), 900)]
    every = np.arange(len(true))
    errors = [
        np.linalg.norm(each.points - true[every if each.at is None else each.at], axis=1).mean() for each in found
    ]
    assert min(errors) < 0.08


def test_the_right_assignment_costs_least_and_a_mirror_image_costs_more(thin: SimplifiedMesh) -> None:
    surface = Intrinsic(thin)
    right = tuple(range(len(LIMBS)))
    same = Assignments(surface, surface)
    for way in same.candidates():  # each way to compare
        assert way[0] == right
    assert min(same.candidates()[0], key=same.cost) == right and same.cost(right) < same.cost((0, 2, 1, 4, 3))
    mirrored = SimplifiedMesh(thin.verts * [-1, 1, 1], thin.faces[:, ::-1])  # as far apart, but turned over
    assert Assignments(surface, Intrinsic(mirrored)).cost(right) > same.cost(right) + 0.02


def test_arms_of_other_lengths_are_found_by_their_order() -> None:
    """Around a ball as the arms of an octopus, a pair of them closer than the others, in both shapes."""
    angles = np.radians([0, 40, 100, 160, 220, 290])

    def armed(lengths: np.ndarray) -> Intrinsic:
        ball = trimesh.creation.icosphere(subdivisions=4)
        way = np.asarray(ball.vertices)
        radius = np.full(len(way), 0.5)
        for angle, length in zip(angles, lengths, strict=True):
            radius += length * np.exp(-(1 - way @ [np.cos(angle), np.sin(angle), 0]) / 0.03)
        return Intrinsic(SimplifiedMesh.of(frame_applied(Shape(way * radius[:, None], np.asarray(ball.faces))), 1200))

    def arms(surface: Intrinsic) -> np.ndarray:
        ends = surface.mesh.verts[surface.extremities]
        return np.abs((np.arctan2(ends[:, 1], ends[:, 0])[:, None] - angles + np.pi) % (2 * np.pi) - np.pi).argmin(1)

    source, target = armed(np.full(6, 1.0)), armed(np.array([1.6, 0.9, 1.3, 0.8, 1.5, 1.1]))
    to = {int(arm): number for number, arm in enumerate(arms(target))}
    right = tuple(to[int(arm)] for arm in arms(source))
    ways = Assignments(source, target).candidates()
    lengths, *orders = (way.index(right) if right in way else 99 for way in ways[:3])
    assert max(orders) < 4 and min(orders) <= lengths
    around = np.unwrap(angles[arms(target)[target.tour]], period=2 * np.pi)  # the tour goes around once
    assert np.ptp(np.sign(np.diff(around))) == 0 and abs(around[-1] - around[0]) < 2 * np.pi
    assert right in ways[3]


def test_a_tour_is_the_shortest() -> None:
    rng = np.random.default_rng(0)
    for count in (3, 4, 5, 7):
        lengths = rng.random((count, count))
        lengths += lengths.T
        tour = np.array(shortest_tour(lengths))
        others = np.array(list(permutations(range(count))))
        assert sorted(tour) == list(range(count))
        assert lengths[tour, np.roll(tour, 1)].sum() == pytest.approx(
            lengths[others, np.roll(others, 1, 1)].sum(1).min()
        )


def test_a_turned_copy_is_found_by_a_rigid_motion(thin: SimplifiedMesh) -> None:
    turn = Rotation.from_euler("xyz", (100, 20, 200), degrees=True)
    copy = SimplifiedMesh(turn.apply(thin.verts), thin.faces)
    best = rigid_proposals(thin, copy)[0]
    assert best.kind == "rigid" and np.abs(best.points - copy.verts).max() < 0.02


def around(radius: Any) -> SimplifiedMesh:
    """A turned piece whose radius may change with the height and the angle."""
    piece = trimesh.creation.cylinder(0.5, 1.0, sections=64).subdivide_to_size(0.08)
    x, y, z = np.asarray(piece.vertices).T
    wide = radius(z, np.arctan2(y, x))
    return SimplifiedMesh.of(
        frame_applied(Shape(np.column_stack([x * wide, y * wide, z]), np.asarray(piece.faces))), 1800
    )


def test_turns_that_bring_a_shape_onto_itself_are_counted(thin: SimplifiedMesh) -> None:
    assert turns_onto_itself(thin) == 1
    assert turns_onto_itself(around(lambda z, _: 1 + 0.5 * z)) > 12  # a cup without a handle
    assert turns_onto_itself(around(lambda z, angle: (1 + 0.5 * z) * (1 + 0.3 * np.cos(3 * angle)))) == 3
    handle = around(lambda z, angle: (1 + 0.5 * z) * (1 + 0.8 * np.exp(-((angle / 0.3) ** 2))))
    assert turns_onto_itself(handle) == 1


def test_turns_that_move_known_positions_do_not_count() -> None:
    prism = around(lambda z, angle: (1 + 0.5 * z) * (1 + 0.3 * np.cos(2 * angle)))
    top, side = prism.verts[prism.verts[:, 2].argmax()] * [0, 0, 1], prism.verts[prism.verts[:, 0].argmax()]
    assert [turns_onto_itself(prism, held) for held in (None, top[None], side[None])] == [2, 2, 1]


def test_nodes_move_one_side_of_a_thin_sheet(thin: SimplifiedMesh) -> None:
    sheet = trimesh.creation.box((1, 1, 0.01)).subdivide_loop(0)
    for _ in range(4):
        sheet = sheet.subdivide()
    shape = Shape(np.asarray(sheet.vertices), np.asarray(sheet.faces))
    mesh = SimplifiedMesh.of(shape, 10_000)
    system, prior = SurfaceNodes(K=150, radius=0.13, min_nodes=4).system(mesh.shape, mesh.graph)
    assert np.allclose(np.asarray(system.phi.sum(1)), 1)
    turn = Rotation.from_rotvec([0.2, 0.1, 0.3])
    top = mesh.verts[:, 2] > 0
    inside = (np.abs(mesh.verts[:, :2]) < 0.25).all(1)
    # a node that moves vertices of the top far from the rim moves none of the bottom there
    moved = np.asarray((system.phi != 0).todense())
    shared = moved[top & inside].any(0) & moved[~top & inside].any(0)
    assert not shared.any()
    alike = np.tile(turn.as_matrix(), (len(system.gradient_points), 1, 1))
    assert np.allclose(prior.targets(alike), alike)


def test_relief_is_alike_where_a_bump_lies_on_a_bump() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    verts = np.asarray(ball.vertices) * 0.3
    nose = np.exp(-np.square(np.linalg.norm(verts - [0.3, 0, 0], axis=1) / 0.06))
    with_nose = SimplifiedMesh.of(Shape(verts * (1 + 0.2 * nose[:, None]), np.asarray(ball.faces)), 10_000)
    likeness = {}
    for degrees in (0, 90):
        turn = Rotation.from_euler("z", degrees, degrees=True)
        moved = OrientedPoints(turn.apply(with_nose.verts), turn.apply(with_nose.normals))
        likeness[degrees] = with_nose.likeness(with_nose, moved)
    assert likeness[0] == pytest.approx(1) and likeness[90] < 0.6
    inside_out = SimplifiedMesh(with_nose.verts, with_nose.faces[:, ::-1])
    assert with_nose.likeness(inside_out, OrientedPoints(with_nose.verts, -with_nose.normals)) == pytest.approx(1)
    assert np.allclose(with_nose.areas @ with_nose.relief, 0)
    flat = trimesh.creation.box((1, 1, 0)).subdivide().subdivide().subdivide()
    tilted = Rotation.from_rotvec([0.3, 0.2, 0.1]).apply(np.asarray(flat.vertices))
    upper = np.asarray(flat.faces)[np.asarray(flat.face_normals)[:, 2] > 0]
    assert np.ptp(SimplifiedMesh.of(Shape(tilted, upper), 10_000).relief) == 0


def test_energy_prefers_what_is_near_unstretched_and_whole() -> None:
    best = DirectFeatures(residual=0.02, stretch=0.4, discontinuous=0.0)
    for name, worse in (("residual", 0.03), ("stretch", 0.8), ("discontinuous", 0.1), ("likeness", 0.2)):
        assert replace(best, **{name: worse}).energy > best.energy


def test_equal_fits_are_ambiguous_and_distant_ones_are_not() -> None:
    best = DirectFeatures(residual=0.012, stretch=0.2)
    alone = judge_direct(best.energy, [])
    assert alone[0] == "good" and not alone[2]
    verdict, _, reasons = judge_direct(best.energy, [0.0, 0.0, 0.04])
    assert verdict == "fair" and reasons[0].code == "ambiguous" and "3 different" in reasons[0]
    turned = judge_direct(best.energy, [], turns=4)
    assert turned[0] == "fair" and turned[1] == alone[1] and "4 different" in turned[2][0]
    trusts = [judge_direct(energy, [])[1] for energy in (0.01, 0.03, 0.06, 0.1)]
    assert trusts == sorted(trusts, reverse=True)
    assert judge_direct(0.1, [])[0] == "poor"


def test_a_bent_turned_and_scaled_shape_is_found(pair: tuple[Shape, Shape]) -> None:
    source, target = pair
    shown: list[float] = []
    found = match_directly(source, target, QUICK, progress=lambda stage, name, share: shown.append(share))
    assert found.target.frame.scale == pytest.approx(sqrt_area_frame(target).scale)
    at = thinned(frame_applied(source), QUICK.fine)
    error = np.linalg.norm(found.target.points_in_file - target.verts[at], axis=1) / found.target.frame.scale
    assert error.mean() < 0.02 and found.target.verdict != "poor"
    assert np.allclose(found.source.points_in_file, source.verts[at])
    assert found.source.template_hash == found.target.template_hash and shown == sorted(shown)
    energies = [energy for _, energy in found.tried]
    assert energies == sorted(energies) and len(energies) > 1
    again = match_directly(source, target, QUICK)
    assert np.array_equal(again.target.points, found.target.points)


def curled() -> Shape:
    """An egg bent and curled as no mirror image of it is."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    x, y, z = (np.asarray(ball.vertices) * [0.5, 1.3, 0.35]).T
    curl = np.stack([x + 0.5 * y**2, y + 0.2 * x, z + 0.5 * y**3 + 0.4 * x * y], 1)
    return Shape(curl, np.asarray(ball.faces), "curl")


def test_a_mirror_image_is_found_where_it_fits_clearly_better() -> None:
    source = curled()
    turn = Rotation.from_euler("xyz", (70, 130, -40), degrees=True)
    plain = Shape(turn.apply(np.array(source.verts)), source.faces, "turned")
    target = mirrored(plain)
    for other, nearer in ((plain, False), (target, True)):
        same, image = alignment_residuals(source, other, 0)
        assert (image < 0.6 * same) is nearer
    finer = replace(QUICK, fine=5000, samples=8000, n_second=4, n_third=2)
    found = match_either_side(source, target, finer, known=(source.verts[:3], target.verts[:3])).target
    assert found.frame.mirrored and np.array_equal(found.verts, target.verts)
    assert (found.up, found.front) == tuple(axis_name(found.frame.rotation[row]) for row in (1, 2))
    at = thinned(frame_applied(source), finer.fine)
    error = np.linalg.norm(found.points_in_file - target.verts[at], axis=1) / np.sqrt(target.area)
    assert error.mean() < 0.02


def test_a_guess_is_much_the_same_as_what_is_found_or_its_energy_is_known(pair: tuple[Shape, Shape]) -> None:
    source, target = pair
    rng = np.random.default_rng(0)
    for right, goals in ((True, target.verts), (False, rng.permutation(target.verts))):
        found = match_directly(source, target, QUICK, guess=(source.verts, goals))
        assert found.guess_lead == 0 if right else found.guess_lead > 0.01
    assert dict(found.tried)["guess"] == pytest.approx(found.energy + found.guess_lead)
    both = match_directly(source, target, replace(QUICK, both_ways="always", n_returned=1), guess=(source.verts, goals))
    assert both.before is not None and 0.01 < both.guess_lead < np.inf


def test_a_heavy_mesh_is_matched_by_a_lighter_one(pair: tuple[Shape, Shape], monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = pair
    monkeypatch.setattr("meshmatch.fitting.one_way._HEAVY", source.F - 1)
    monkeypatch.setattr("meshmatch.fitting.one_way._LIGHT", source.F // 2)
    found = match_directly(source, target, replace(QUICK, fine=source.F, both_ways="no"))
    assert len(found.source.faces) == pytest.approx(source.F // 2, rel=0.05)
    moved = found.target.points_in_file
    at = cKDTree(source.verts).query(found.source.points_in_file)[1]
    assert np.linalg.norm(moved - target.verts[at], axis=1).mean() < 0.05 * np.sqrt(target.area)


def test_known_pairs_settle_what_symmetry_leaves_open() -> None:
    box = trimesh.creation.box((1.0, 0.7, 0.4))
    for _ in range(4):
        box = box.subdivide()
    shape = Shape(np.asarray(box.vertices), np.asarray(box.faces), "box")
    plain = match_directly(shape, shape, QUICK)
    assert min(plain.leads) < 0.005  # half turns are nearly as good
    assert any(reason.code == "ambiguous" for reason in plain.reasons)
    half = Rotation.from_euler("z", 180, degrees=True)
    corners = np.array(shape.verts[:8])
    known = corners, half.apply(corners)
    found = match_directly(shape, shape, QUICK, known)
    at = thinned(frame_applied(shape), QUICK.fine)
    off = np.linalg.norm(found.target.points_in_file - half.apply(np.array(shape.verts[at])), axis=1)
    assert off.mean() < 0.03
    assert min(found.leads, default=np.inf) > 0.01 and not any(reason.code == "ambiguous" for reason in found.reasons)


def test_goals_are_reached_by_vectors(thin: SimplifiedMesh) -> None:
    from meshmatch.fitting.fit_config import Schedule
    from meshmatch.fitting.solve.driver import Problem
    from meshmatch.fitting.solve.priors import RotatedReference
    from meshmatch.fitting.solve.terms import GoalTerm

    system, _ = SurfaceNodes(K=60, radius=0.3, gradient_points=100).system(thin.shape, thin.graph)
    goals = Rotation.from_rotvec([0, 1.5, 0]).apply(thin.verts) + 0.1
    prior = RotatedReference(np.tile(np.eye(3), (len(system.gradient_points), 1, 1)))
    schedule = Schedule(steps=10, prior=(1e-2, 1e-3), scale=(1.0, 1.0))
    vectors = minimise(
        Problem(system=system, terms=[GoalTerm(goals)], schedule=schedule), prior, np.zeros((system.K, 3))
    )
    assert np.linalg.norm(system.moved(vectors) - goals, axis=1).mean() < 0.01


def test_one_correspondence_is_found_from_either_side() -> None:
    quick = replace(QUICKER, both_ways="always")
    box = trimesh.creation.box((1.0, 0.7, 0.4)).subdivide().subdivide()
    first = Shape(np.asarray(box.vertices), np.asarray(box.faces), "box")
    second = Shape(first.verts * [1.05, 1.0, 0.97], first.faces, "longer box")
    there, back = match_directly(first, second, quick), match_directly(second, first, quick)
    assert there.before is not None and back.before is not None
    assert there.energy == pytest.approx(back.energy, rel=1e-6)
    assert there.source.template_hash == back.source.template_hash  # the one that fits the other better
    backwards = (first, second) if np.any(there.source.vectors) else (second, first)
    kept = match_directly(*backwards, replace(quick, from_source=True))
    assert not np.any(kept.source.vectors) and np.any(kept.target.vectors)


def test_a_limb_glides_along_itself_until_its_end_is_at_the_end() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    way = np.asarray(ball.vertices)
    rod = np.clip((way[:, 0] - 0.5) / 0.5, 0, 1)  # a ball with one long limb
    shape = frame_applied(Shape(way * [1, 1, 1] + rod[:, None] * [3.0, 0, 0], np.asarray(ball.faces), "club"))

    def errors() -> list[float]:
        config = replace(QUICK, fine=2400, samples=4000)
        frame, thin = sqrt_area_frame(shape), SimplifiedMesh.of(shape, config.coarse)
        side = ShapeData(shape, frame, shape, shape, thin, None, config)
        verts = side.fine_mesh.verts
        along = np.clip((verts[:, 0] - 0.1) / np.ptp(shape.verts[:, 0]), 0, 1)
        short = verts - 0.15 * np.sqrt(along)[:, None] * [1, 0, 0]
        report = Progress(None, "club")
        found = fit_all_fine(side, side, [(Proposal("guess", short), short)], report)
        further = slide_all(side, side, found, report)
        assert slide_all(side, side, further, report) == further  # once is enough
        return [float(np.linalg.norm(each.moved - verts, axis=1).mean()) for (each,) in (found, further)]

    before, after = errors()
    assert after < 0.6 * before


@pytest.mark.parametrize(
    ("nearer", "apart", "alike", "asked"),
    [(0.1, 0.06, 0.6, True), (0.1, 0.06, 0.8, False), (0.01, 0.06, 0.6, False), (0.1, 0.09, 0.6, False)],
)
def test_a_palm_on_the_back_of_a_hand_asks_for_the_mirror_image(
    nearer: float, apart: float, alike: float, asked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = curled()
    monkeypatch.setattr("meshmatch.fitting.direct.alignment_residuals", lambda *_: (apart * np.exp(nearer), apart))
    monkeypatch.setattr(SimplifiedMesh, "likeness", lambda *_: alike)
    found = match_either_side(source, mirrored(source), replace(QUICKER, both_ways="no"))
    assert found.target.frame.mirrored is asked
    doubt = any(reason.code == "side" for reason in found.reasons)
    assert doubt == (apart == 0.09) and (not doubt or found.verdict != "good")  # it fits better, but is no more alike
