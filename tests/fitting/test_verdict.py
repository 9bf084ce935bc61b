"""Verdicts: each sign of a wrong fit lowers the trust in it, and shapes that nobody could match are not called good."""

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
import trimesh

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Floats, Ints
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter, cap_verdict
from meshmatch.fitting.judge import calibration
from meshmatch.fitting.judge.calibration import CALIBRATION, Calibration, calibration_of
from meshmatch.fitting.judge.features import (
    FitFeatures,
    astray_share,
    compute_features,
    connected_parts,
    multipart_allowance,
    shortening,
    stretch_spread_of,
    subtract_in_quadrature,
    uncut_share,
)
from meshmatch.fitting.judge.joints import knees_forward
from meshmatch.fitting.judge.reasons import Reason
from meshmatch.fitting.judge.verdict import LIMITS, Judgement, judge, judge_with_allowance
from meshmatch.fitting.search.discontinuities import discontinuous_share, neighbours
from meshmatch.fitting.search.visibility import visible_vertices
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.conftest import some_fit
from tests.fitting.eggs import egg_model, scan_of

RANK = {"good": 0, "fair": 1, "poor": 2}
SOUND = FitFeatures(residual=0.023, discontinuous=0.001, stretch=0.5, stretch_spread=0.22, flipped=0.015, spread=0.02)
RISING = {
    "residual": np.linspace(0.02, 0.1, 30),
    "uncovered_shape": np.linspace(0, 1, 30),
    "uncovered_template": np.linspace(0, 1, 30),
    "discontinuous": np.linspace(0, 1, 30),
    "stretch": np.linspace(0.1, 4, 30),
    "stretch_spread": np.linspace(0.05, 2, 30),
    "flipped": np.linspace(0, 1, 30),
    "partial": [False, True],
    "hidden": np.linspace(0, 1, 30),
    "astray": np.linspace(0, 1, 30),
    "uncut": np.linspace(0, 1, 30),
    "forward": np.linspace(0, 90, 30),
    "spread": np.geomspace(0.005, 0.3, 30),
    "inverted": np.linspace(0, 0.2, 30),
}


APART = {"uncovered_template", "stretch", "flipped", "partial", "inverted"}  # bound the verdict, or are reasons alone
ALONE = {"astray", "uncut", "forward"}  # decide alone


def test_all_features_are_tried() -> None:
    assert list(RISING) == [each.name for each in fields(FitFeatures)]
    assert len(SOUND.values()) == len(RISING) - len(APART | ALONE)


@pytest.mark.parametrize("sign", RISING)
def test_trust_falls_as_a_sign_rises_and_verdicts_never_improve(sign: str) -> None:
    found = [replace(SOUND, **{sign: value}) for value in RISING[sign]]
    trust = [each.p_correct() for each in found]
    assert trust == sorted(trust, reverse=True) and (trust[-1] < trust[0] or sign in APART)
    judged = [judge(each) for each in found]
    ranks = [RANK[each.verdict] for each in judged]
    assert ranks == sorted(ranks) and ranks[0] == 0
    assert ranks[-1] > 0 or sign == "flipped"
    for each in judged:
        assert bool(each.reasons) == (each.verdict != "good")
        assert each.trust == each.features.p_correct()


@pytest.mark.parametrize(("sign", "code"), [("astray", "pieces"), ("uncut", "uncut"), ("forward", "bent")])
def test_some_signs_tell_by_themselves(sign: str, code: str) -> None:
    """A fit that is fair otherwise is poor, and says by which sign; below its limit a sign does not count."""
    fair = replace(SOUND, residual=0.03, partial=True)
    assert fair.p_correct() > 0.9 and judge(fair).verdict == "fair"
    limits = {"astray": 0.03, "uncut": 0.3, "forward": 27.0}
    below, above = (replace(fair, **{sign: factor * limits[sign]}) for factor in (0.99, 1.01))
    assert below.p_correct() == fair.p_correct() and judge(below).verdict == "fair"
    assert above.p_correct() < 0.3 and judge(above).verdict == "poor"
    told = {reason.code for reason in judge(above).reasons}
    assert code in told and code not in {reason.code for reason in judge(below).reasons}


def test_where_verdicts_change() -> None:
    found = [judge(replace(SOUND, residual=value)) for value in np.linspace(0.02, 0.12, 200)]
    assert {each.verdict for each in found} == {"good", "fair", "poor"}
    for each in found:
        expected = "good" if each.trust >= LIMITS.good_trust else "fair" if each.trust >= LIMITS.fair_trust else "poor"
        assert each.verdict == expected
    assert judge(replace(SOUND, partial=True, hidden=0.3)).verdict == "fair"  # a part is fair at best


def test_where_nearness_says_nothing_a_fit_is_as_likely_wrong_as_right() -> None:
    doubt = Reason("side", "its mirror image fits as well")
    sound = some_fit(np.eye(3), np.array([[0, 1, 2]]))
    assert cap_verdict(sound, []) is sound
    for verdict, trust in (("good", 0.99), ("fair", 0.7), ("poor", 0.2)):
        found = cap_verdict(replace(sound, verdict=verdict, trust=trust), [doubt])
        assert found.verdict == ("fair" if verdict == "good" else verdict)
        assert (found.trust, found.reasons) == (min(trust, 0.5), (doubt,))


def test_reasons_are_sentences_with_codes() -> None:
    (reason,) = judge(replace(SOUND, residual=0.1)).reasons
    assert reason.code == "residual"
    assert (
        str(reason) == "template and shape are 10.0 % of sqrt(area) apart on average, as 13.8 cm would be on a person"
    )
    judged = (
        judge(replace(SOUND, residual=0.028, stretch=0.98, spread=value)) for value in np.linspace(0.02, 0.06, 400)
    )
    doubtful = next(each for each in judged if each.verdict == "fair")
    assert doubtful.reasons == ("98 % likely to be right, where a good fit needs 99 %",)
    again = pickle.loads(pickle.dumps(reason))
    assert (again, again.code) == (reason, reason.code)
    assert "unsure" in {reason.code for reason in judge(replace(SOUND, residual=0.05, spread=0.1)).reasons}
    assert "unsure" not in {reason.code for reason in judge(replace(SOUND, residual=0.05)).reasons}


def system() -> NodeSystem:
    return node_system(egg_model())


def labels() -> Ints:
    return egg_model().template.labels


def test_signs_of_a_template_on_itself() -> None:
    still = np.zeros((system().K, 3))
    features = compute_features(system(), still, scan_of(egg_model().template.shape, 2000), 0.02, labels())
    assert (features.residual, features.partial) == (0.02, False)
    assert (features.uncovered_shape, features.uncovered_template) == (0.0, 0.0)
    assert features.stretch < 0.01 and features.flipped < 0.02 and features.discontinuous < 0.02


def test_signs_of_a_template_on_a_part_and_on_more() -> None:
    still, scan = np.zeros((system().K, 3)), scan_of(egg_model().template.shape, 2000)
    half = replace(scan.rows(scan.points[:, 1] > 0))
    assert 0.3 < compute_features(system(), still, half, 0.02, labels()).uncovered_template < 0.6
    assert compute_features(system(), still, half, 0.02, labels(), partial=True).uncovered_template == 0.0
    more = replace(scan, points=scan.points + np.where(scan.points[:, 1:2] > 0, [0.0, 1.0, 0.0], 0.0))
    assert 0.3 < compute_features(system(), still, more, 0.02, labels()).uncovered_shape < 0.6


def pressed_egg(axis: int, left: float) -> tuple[Floats, OrientedPoints]:
    """Node vectors that press the egg along an axis to so much of its length, and a scan of it."""
    nodes, scan = egg_model().template.nodes, scan_of(egg_model().template.shape, 2000)
    along = np.eye(3)[axis]
    return (left - 1) * nodes * along, replace(scan, points=scan.points * (1 + (left - 1) * along))


def test_signs_of_a_template_pressed_flat() -> None:
    scan = scan_of(egg_model().template.shape, 2000)
    flat, pressed = pressed_egg(2, 0.02)
    features = compute_features(system(), flat, pressed, 0.025, labels())
    assert features.stretch > 2 and judge(features).verdict == "poor"
    assert "crushed" in {reason.code for reason in judge(features).reasons}
    turned = replace(scan, normals=-scan.normals)
    assert compute_features(system(), np.zeros_like(flat), turned, 0.025, labels()).flipped > 0.9


def test_how_much_a_surface_is_shortened_is_its_least_stretch() -> None:
    rng, points = np.random.default_rng(0), system().gradient_points
    gradient = np.eye(3) + 0.4 * rng.normal(size=(len(points), 3, 3))
    normals = system().normals(system().verts)[points]
    inside = np.linalg.svd(normals[:, None])[2][:, 1:]  # two directions of each surface
    least = np.linalg.svd(gradient @ inside.transpose(0, 2, 1), compute_uv=False)[:, 1]
    assert shortening(system(), gradient)[points] == pytest.approx(np.clip(least, 0.2, 1), abs=1e-6)
    assert np.allclose(shortening(system(), np.broadcast_to(2 * np.eye(3), gradient.shape)), 1)


def test_stretch_is_uneven_about_the_mean_of_its_part() -> None:
    rng, parts = np.random.default_rng(0), np.repeat([0, 2, 3], 40)
    own = rng.normal(size=(4, 3, 3))[parts]
    assert stretch_spread_of(own, parts) == pytest.approx(0, abs=1e-12)
    away = rng.normal(size=(60, 3, 3)).repeat(2, 0) * np.tile([1, -1], 60)[:, None, None]
    assert stretch_spread_of(own + away, parts) == pytest.approx(np.median(np.linalg.norm(away, axis=(1, 2))))


def test_parts_of_other_proportions_are_even() -> None:
    upper, nodes = system().verts[:, 1] > 0, egg_model().template.nodes
    short = -0.7 * np.maximum(nodes, 0) * [0, 1, 0]
    scan = scan_of(egg_model().template.shape, 2000)
    one, two = (
        compute_features(system(), short, scan, 0.02, parts).stretch_spread
        for parts in (0 * labels(), upper.astype(int))
    )
    assert 0.2 < one and two < 0.5 * one
    even, level = (replace(SOUND, stretch_spread=value).p_correct() for value in (0.05, 0.2))
    assert even == level > replace(SOUND, stretch_spread=0.3).p_correct()


def test_a_category_is_judged_by_its_own_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    assert calibration_of("head") != calibration_of("human") == calibration_of("egg") == CALIBRATION
    own = replace(CALIBRATION, offset=CALIBRATION.offset + 50)
    fitter = Fitter(egg_model(), FitConfig(samples=900, variants=0, finalists=1, careful=1, partial="no"))
    usual = fitter.fit(egg_model().template.shape)
    monkeypatch.setitem(calibration._OF_CATEGORY, egg_model().card.category, own)
    doubted = fitter.fit(egg_model().template.shape)
    assert usual.trust > 0.9 and doubted.verdict == "poor"
    assert usual.signs == doubted.signs and doubted.trust == pytest.approx(doubted.signs.p_correct(own))


def test_a_shortened_template_is_not_torn() -> None:
    short, pressed = pressed_egg(1, 0.3)
    assert discontinuous_share(system(), neighbours(pressed), pressed, short) > 0.03
    assert compute_features(system(), short, pressed, 0.02, labels()).discontinuous < 0.005


@pytest.mark.slow
def test_the_network_reads_what_it_knows_alike_and_a_box_in_many_ways() -> None:
    matcher = Matcher("human", threads=1)
    known = matcher.fit(load_shape(bundled_folder() / "samples" / "dancer.ply")).signs
    box = trimesh.creation.box((1, 2, 0.5)).subdivide().subdivide().subdivide()
    unknown = matcher.fit(Shape(box.vertices, box.faces, "box")).signs
    assert known is not None and unknown is not None
    assert known.spread < 0.02 < 0.05 < unknown.spread


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["flat", "leg"])
def test_what_nobody_could_match_is_poor(damage: str) -> None:
    """A body pressed onto a plane was called good at 32 cm, and a leg alone fair at 35."""
    body = load_shape(bundled_folder() / "samples" / "dancer.ply")
    if damage == "flat":
        shape = Shape(body.verts * [1, 1, 0], body.faces, damage)
    else:
        low = body.verts[:, 1] < np.quantile(body.verts[:, 1], 0.35)
        kept = (low & (body.verts[:, 0] > np.median(body.verts[low, 0])))[body.faces].all(1)
        used, faces = np.unique(body.faces[kept], return_inverse=True)
        shape = Shape(body.verts[used], faces.reshape(-1, 3), damage)
    assert Matcher("human", threads=1).fit(shape).verdict == "poor"


def test_the_residual_of_many_solids_is_allowed_for() -> None:
    egg = node_system(egg_model())

    def solids(count: int) -> Shape:
        verts = np.concatenate([egg.verts + 3.0 * k for k in range(count)])
        return Shape(verts, np.concatenate([egg.faces + len(egg.verts) * k for k in range(count)]))

    allowed = [multipart_allowance(each, each) for each in map(solids, (1, 2, 5, 8, 12))]
    assert allowed == pytest.approx([0.0, 0.0, 0.033 * np.sqrt(0.5), 0.033, 0.033], abs=1e-6)
    many = solids(12)
    shown = Shape(many.verts, many.faces[: 5 * len(egg.faces)])  # the others are inside
    assert multipart_allowance(many, shown) == pytest.approx(allowed[2])


def test_what_is_excused_lets_a_fit_be_fair_but_not_good() -> None:
    fair, poor = replace(SOUND, residual=0.06), replace(SOUND, residual=0.1)
    assert [judge(each).verdict for each in (SOUND, fair, poor)] == ["good", "fair", "poor"]
    assert judge_with_allowance(SOUND, 0.024) == judge(SOUND)
    judged = judge_with_allowance(SOUND, 0.055)
    assert (judged.verdict, judged.features, [reason.code for reason in judged.reasons]) == (
        "fair",
        SOUND,
        ["residual"],
    )
    assert "5.5 %" in judged.reasons[0]
    assert judge_with_allowance(fair, 0.1) == judge(fair)
    assert judge_with_allowance(poor, 0.11) == judge(poor)


def _two_sheets() -> tuple[Shape, OrientedPoints]:
    """Two sheets of 20 x 20 points, one close above the other, and samples of them."""
    x, z = (side.ravel() for side in np.meshgrid(np.arange(20.0), np.arange(20.0), indexing="ij"))
    corner = np.arange(400).reshape(20, 20)
    a, b, c, d = (corner[i : i + 19, j : j + 19].ravel() for i in range(2) for j in range(2))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    sheets = [np.stack([x, np.full(400, 0.01 * k), z], 1) for k in range(2)]
    shape = Shape(np.concatenate(sheets), np.concatenate([faces, faces + 400]))
    return shape, sample_surface(shape, 900, np.random.default_rng(0))


def test_neighbours_of_two_parts_are_none() -> None:
    shape, samples = _two_sheets()
    part = connected_parts(shape, samples)
    assert part is not None and part.tolist() == (samples.points[:, 1] > 0.005).astype(int).tolist()
    moved = samples.to_local(RigidPose(np.eye(3)[[1, 2, 0]], np.ones(3))).first(50)
    assert np.array_equal(connected_parts(shape, moved), part[:50])
    start, end = neighbours(samples)
    assert 0.3 < (part[start] != part[end]).mean() < 0.5
    near, far = neighbours(samples, part)
    assert (part[near] == part[far]).all() and len(near) == (part[start] == part[end]).sum()
    assert len(neighbours(samples, np.arange(900) // 2)[0]) == len(start)  # in pieces: most neighbours are on two


def test_shapes_of_one_part_and_clouds_have_no_parts_to_tell() -> None:
    shape, rng = egg_model().template.shape, np.random.default_rng(0)
    assert connected_parts(shape, sample_surface(shape, 100, rng)) is None
    cloud = Shape(shape.verts, np.empty((0, 3), np.int64))
    assert connected_parts(cloud, sample_surface(cloud, 100, rng)) is None


def test_a_registration_is_judged_by_the_parts_of_its_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    """A template in twelve pieces is excused for those that are shown, and asked for tears only within them."""
    whole = egg_model().template.shape
    order = np.argsort(whole.verts[whole.faces].mean(1) @ [1.0, 0.3, 0.1])
    verts, faces, V = [], [], 0
    for rows in np.array_split(order, 12):
        used, piece = np.unique(whole.faces[rows], return_inverse=True)
        verts.append(whole.verts[used])
        faces.append(piece.reshape(-1, 3) + V)
        V += len(used)
    shape = Shape(np.concatenate(verts), np.concatenate(faces))
    assert shape.face_parts.max() == 11
    shown = Shape(shape.verts, shape.faces[shape.face_parts < 3])
    monkeypatch.setattr("meshmatch.fitting.judge.verdict.without_interior", lambda *_: shown)
    asked = []

    def watched(*args, **kwargs):
        asked.append((*args[:3], kwargs["connected"]))
        return compute_features(*args, **kwargs)

    def excused(features: FitFeatures, residual: float, calibration: Calibration) -> Judgement:
        asked.append(residual)
        return judge_with_allowance(features, residual, calibration)

    monkeypatch.setattr("meshmatch.fitting.judge.verdict.compute_features", watched)
    monkeypatch.setattr("meshmatch.fitting.judge.verdict.judge_with_allowance", excused)
    fit = Fitter(egg_model(), FitConfig(samples=900, variants=0, finalists=1, careful=1, partial="no")).fit(shape)
    assert fit.signs is not None
    assert fit.signs.residual == pytest.approx(subtract_in_quadrature(fit.residual, multipart_allowance(shape, shown)))
    assert 0 < fit.signs.residual < fit.residual
    (system, vectors, local, connected), residual = asked[-2:]
    assert residual == fit.residual
    assert np.array_equal(connected, shape.vertex_parts[local.vertex])
    pairs, strict = neighbours(local), neighbours(local, connected)
    assert 0 < len(strict[0]) < len(pairs[0])
    shortened = shortening(system, system.deformation_gradient(vectors))
    assert fit.signs.discontinuous == discontinuous_share(system, strict, local, vectors, shortened)


@pytest.mark.parametrize("bend", [-120.0, -30.0, 0.0, 20.0, 60.0])
def test_a_knee_bends_forward_by_so_many_degrees(bend: float) -> None:
    """The lower half of an egg that is called a shin swings about the egg's middle; the upper half is called a thigh."""
    template = egg_model().template
    upper = template.shape.verts[:, 1] > 0
    names = ("left thigh", "left shin", "right thigh", "right shin")
    legs = replace(template, labels=np.where(upper, 0, 1), label_names=names)
    angle, nodes = np.radians(bend), template.nodes
    swing = np.array([[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]])  # front is +z
    low = nodes[:, 1] < -0.15 * np.ptp(nodes[:, 1])
    low_points = system().verts[system().gradient_points][:, 1]
    vectors = np.where(low[:, None], nodes @ swing.T - nodes, 0.0)
    found = knees_forward(system(), vectors, legs)
    assert (low_points < 0).any()
    assert found == 0 if bend <= 0 else 0.4 * bend < found < 1.1 * bend
    assert knees_forward(system(), vectors, template) == 0  # an egg has no knees
    for shown, known in ((upper, 0.0), (np.ones(len(upper), bool), found)):
        assert knees_forward(system(), vectors, legs, shown) == known  # a part without shins has none that bends


def test_pieces_beside_the_template_are_astray() -> None:
    part, gap = np.repeat([0, 1, 2], [70, 20, 10]), np.repeat([0.008, 0.03, 0.015], [70, 20, 10])
    assert astray_share(part, gap) == pytest.approx(0.2)
    weights = np.where(part == 1, 2.0, 1.0)
    assert astray_share(part, gap, weights) == pytest.approx(40 / 120)
    assert astray_share(part, 0.5 * gap) == 0


def test_the_border_of_a_part_is_where_it_is_cut() -> None:
    """Half an egg whose edge is known, is elsewhere, or is known on one side alone."""
    still, scan = np.zeros((system().K, 3)), scan_of(egg_model().template.shape, 2000)
    half, turn = scan.rows(scan.points[:, 1] > 0), np.linspace(0, 2 * np.pi, 200, endpoint=False)
    radius = np.linalg.norm(half.points[half.points[:, 1] < 0.05][:, [0, 2]], axis=1).mean()
    ring = radius * np.stack([np.cos(turn), 0 * turn, np.sin(turn)], 1)
    assert uncut_share(system(), half, still, ring) == 0
    assert uncut_share(system(), half, still, ring + np.array([0, 0.5, 0])) > 0.9
    assert 0.2 < uncut_share(system(), half, still, ring[:100]) < 0.5
    assert uncut_share(system(), half, still, ring[:0]) == 0  # a cloud, or a closed mesh, says nothing
    away = np.linalg.norm(half.points - half.points[half.points[:, 1].argmax()], axis=1)
    spotted = half.rows(away > 0.08)  # what is hidden in the middle is too little to be cut off
    assert visible_vertices(system(), half, still).sum() > visible_vertices(system(), spotted, still).sum()
    assert uncut_share(system(), spotted, still, ring) == 0
