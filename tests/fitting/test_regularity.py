"""How regular fits are: folds are counted and opened, and fits that agree keep their faces."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch.fitting.agree import agreed_fits, with_vectors
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.solve.agreement import AgreeConfig, Member, agree
from meshmatch.fitting.solve.regularity import Regularity, unfolded_gradients
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape
from meshmatch.templates.location import bundled_folder
from tests.conftest import some_fit
from tests.fitting.eggs import scan_of

SCAPE = tuple(f"scape/mesh{number}" for number in ("000", "010", "020", "030", "040"))
REAL = (*SCAPE, "faust/tr_reg_000", "faust/tr_reg_011")


def pushed_in(model: TrainedModel, depth: float) -> np.ndarray:
    """Node vectors that push the tip of the egg down into it."""
    nodes = model.template.nodes
    high = nodes[:, 1] - np.quantile(nodes[:, 1], 0.85)
    return np.where(high > 0, -depth * high, 0)[:, None] * np.array([0.0, 1.0, 0.0])


def test_where_all_of_space_moves_alike_it_is_the_same_everywhere(system: NodeSystem, model: TrainedModel) -> None:
    nodes = model.template.nodes
    mirrored = system.regularity(nodes * [-2.0, 0.0, 0.0])  # x becomes -x
    assert mirrored.inverted == 1.0 and mirrored.volume == pytest.approx(2.0, abs=1e-3)
    grown = system.regularity(nodes * [0.1, 0.0, 0.0])
    assert grown.inverted == 0.0 and grown.volume == pytest.approx(0.1, abs=1e-3)
    assert system.regularity(np.zeros_like(nodes)) == Regularity(0.0, 0.0)


def test_the_nearest_stretch_that_is_open_has_the_same_axes() -> None:
    rng = np.random.default_rng(0)
    F = rng.normal(size=(50, 3, 3))
    found = unfolded_gradients(F)
    assert (np.linalg.det(found) > 0).all()
    assert np.allclose(unfolded_gradients(found), found)  # what is open stays as it is
    sound = F[np.linalg.svd(F)[1][:, 2] * np.sign(np.linalg.det(F)) > 0.1]
    assert len(sound) and np.allclose(unfolded_gradients(sound), sound)
    others = np.linalg.qr(rng.normal(size=(50, 3, 3)))[0]
    others[:, :, 2] *= np.sign(np.linalg.det(others))[:, None]  # rotations are open, and none is nearer
    assert (np.linalg.norm(F - found, axis=(1, 2)) <= np.linalg.norm(F - others, axis=(1, 2))).all()


def test_folds_open_and_the_rest_stays(system: NodeSystem, model: TrainedModel) -> None:
    folded = pushed_in(model, 2.0)
    before = system.regularity(folded)
    assert before.inverted > 0
    opened_up = system.unfolded(folded)
    assert system.regularity(opened_up).inverted < 0.2 * before.inverted
    low = system.verts[:, 1] < 0
    moved = np.linalg.norm(system.moved(opened_up) - system.moved(folded), axis=1)
    assert moved[low].max() < 0.25 * moved.max()
    slightly = pushed_in(model, 0.3)
    assert system.unfolded(slightly) is slightly


def test_a_folded_fit_is_not_good_and_says_why(system: NodeSystem, model: TrainedModel) -> None:
    still = np.zeros((system.K, 3))
    fit = some_fit(system.moved(still), system.faces, vectors=still)
    assert with_vectors(system, fit, still).verdict == "good"
    turned = model.template.nodes * [-2.0, 0.0, 0.0]
    found = with_vectors(system, fit, turned)
    assert found.verdict == "fair" and found.regularity == system.regularity(turned)
    assert [reason.code for reason in found.reasons] == ["folded"] and "100.0 %" in found.reasons[0]
    assert with_vectors(system, found, turned).reasons == found.reasons  # said once
    assert with_vectors(system, some_fit(fit.points, fit.faces, verdict="poor"), turned).verdict == "poor"


def test_what_all_fits_have_in_common_hardly_drifts(system: NodeSystem, model: TrainedModel) -> None:
    """Two fits that slid in the same way slide on together; less so the more the common stretch is held."""
    scan, nodes = scan_of(model.template.shape, 1500), model.template.nodes
    start = 0.1 * nodes * [1.0, -1.0, 1.0]

    def drifted(drift: float) -> float:
        schedule = replace(AgreeConfig.schedule, prior=(0.01, 0.01))
        config = AgreeConfig(schedule=schedule, drift=drift)
        members = [Member(samples=scan, vectors=start, config=config)] * 2
        found = agree(system, members)[0]
        return float(np.abs(system.deformation_gradient(found) - system.deformation_gradient(start)).mean())

    assert drifted(0.0) < drifted(AgreeConfig().drift) < drifted(1.0)


def agreed(fits: Sequence[Fit], how: AgreeConfig | None = None) -> list[Fit]:
    model = meshmatch.load_model("human")
    shapes = [fit.repaired.shape for fit in fits if fit.repaired is not None]
    return agreed_fits(model, shapes, fits, how=how)


def mean_volume(fits: Sequence[Fit]) -> float:
    return float(np.mean([fit.regularity.volume for fit in fits if fit.regularity is not None]))


def check_regular(before: Sequence[Fit], after: Sequence[Fit]) -> None:
    for alone, fit in zip(before, after, strict=True):
        assert alone.regularity is not None and fit.regularity is not None
        assert fit.verdict == alone.verdict == "good"
        assert fit.regularity.inverted <= 15 / 4995
        assert not np.array_equal(fit.vectors, alone.vectors)
        system = node_system(meshmatch.load_model("human"))
        assert fit.regularity == system.regularity(fit.vectors)
    assert mean_volume(after) < mean_volume(before) + 0.02  # one may give to another what is its own


@pytest.mark.slow
def test_generated_bodies_that_agree_are_regular(remembered_fits: Callable[..., Any]) -> None:
    matcher = meshmatch.Matcher("human", threads=1)
    samples = bundled_folder() / "samples"
    fits = matcher.fit_all([load_shape(samples / f"{name}.ply") for name in ("climber", "dancer")])
    check_regular(fits, agreed(fits))


@pytest.mark.slow
def test_real_bodies_that_agree_keep_their_faces(bench: Path, remembered_fits: Callable[..., Any]) -> None:
    matcher = meshmatch.Matcher("human", threads=1)
    fits = matcher.fit_all([load_shape(bench / f"{name}.ply") for name in REAL])
    scape = fits[: len(SCAPE)]
    how = AgreeConfig.for_collection(matcher.model)
    together = agreed(scape, how)
    check_regular(scape, together)
    check_regular(fits[len(SCAPE) :], agreed(fits[len(SCAPE) :]))
    # A nose stands out from the cheeks as far as it did before: depth of the face, from ear to tip.
    template = matcher.model.template
    verts = template.shape.verts
    head = np.flatnonzero(verts[:, 1] > verts[:, 1].min() + 0.87 * np.ptp(verts[:, 1]))
    tip = head[verts[head, 2].argmax()]
    cheeks = head[np.argsort(np.abs(np.linalg.norm(verts[head] - verts[tip], axis=1) - 0.03))[:60]]

    def stands_out(fit: Fit) -> float:
        around = fit.points[cheeks]
        middle = around.mean(0)
        flat = np.linalg.svd(around - middle)[2][2]
        return float(abs((fit.points[tip] - middle) @ flat))

    for alone, fit in zip(scape, together, strict=True):
        assert stands_out(fit) > 0.75 * stands_out(alone)
