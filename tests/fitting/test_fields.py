"""Every representation as a model: it learns, is saved and loaded, is laid on shapes and refined."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from meshmatch.api.prepare import PrepareConfig, prepare
from meshmatch.cli import main
from meshmatch.errors import ModelError, OptionError
from meshmatch.fields.shape_functions import FIELDS, ShapeFunctions
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.blend import Blend
from meshmatch.fitting.fit import dense_shape
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.latent import LatentRefineConfig
from meshmatch.fitting.solve.nodes import refine_nodes
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.models.network import NetworkConfig
from meshmatch.models.registry import load_model
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.templates.make import NodeConfig
from meshmatch.training import recipes
from meshmatch.training.loop import TrainConfig, Trainer
from meshmatch.training.losses import CorrespondenceLoss, held_out_error
from tests.fitting.eggs import bent_egg, egg_model, gentle_vectors, scan_of
from tests.training.small import NETWORK, SCAN, egg_template, small_data, small_network, small_points

QUICK = FitConfig(
    samples=600, coarse_samples=200, copies=4, hypotheses=1, careful=1, latent=LatentRefineConfig(steps=6, points=100)
)


def config_of(field: str) -> NetworkConfig:
    return replace(NETWORK, field=field)


@pytest.fixture(scope="module", params=FIELDS)
def model(request: pytest.FixtureRequest) -> TrainedModel:
    return egg_model(network=config_of(request.param))


@pytest.fixture(scope="module")
def rbf() -> TrainedModel:
    return egg_model(network=config_of("rbf"))


@pytest.fixture(scope="module")
def pointwise() -> TrainedModel:
    return egg_model(network=config_of("pointwise"))


@pytest.mark.parametrize("field", FIELDS)
def test_it_learns(field: str) -> None:
    egg = egg_template()
    model = small_network(egg, config_of(field))
    points = small_points(egg, model=model)
    config = TrainConfig(
        steps=40, shapes=4, scans_per_shape=2, rate=3e-3, warm_up=3, workers=0, loss=CorrespondenceLoss(robust=True)
    )
    data = small_data(egg, model, length=40)
    held_out = small_data(egg, model, seed=7)[0]
    before = held_out_error(model, held_out, points)
    Trainer(model, points, config).run(data)
    assert held_out_error(model, held_out, points) < 0.97 * before


def test_what_has_no_weight_is_not_computed(monkeypatch: pytest.MonkeyPatch, pointwise: TrainedModel) -> None:
    monkeypatch.setattr("meshmatch.fields.field.value_and_jacobian", None)
    egg, model = pointwise.template, pointwise.network
    bare = CorrespondenceLoss(volume=0, arap=0, blend=0)
    terms = bare(model, small_data(egg, model)[0], small_points(egg, model=model), torch.Generator())
    assert set(terms) == {
        *("total", "reconstruction", "correct", "align"),
        *("error_code", "error_corrected", "error_align"),
    }


def test_an_untrained_model_leaves_its_template_almost_at_rest(model: TrainedModel) -> None:
    system = node_system(model)
    with torch.no_grad():
        answer = model.network(torch.from_numpy(scan_of(model.template.shape).points).float()[None])
    vectors = answer[0].double().numpy()
    assert np.abs(system.moved(vectors) - model.template.shape.verts).max() < 0.1
    assert np.abs(system.deformation_gradient(vectors) - np.eye(3)).max() < 0.5


def test_answers_turn_with_the_points(model: TrainedModel) -> None:
    angle = 0.4
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    system = node_system(model)
    with torch.no_grad():
        answer = model.network(torch.from_numpy(scan_of(model.template.shape).points).float()[None])
    vectors = answer[0].double().numpy()
    turned = system.moved(model.inference.rotate_rows(vectors, turn))
    # radial basis functions turn only nearly
    near = 0.02 if model.network.config.field == "rbf" else 1e-5
    assert np.abs(turned - system.moved(vectors) @ turn).max() < near


def test_it_is_laid_on_a_shape_and_refined(model: TrainedModel) -> None:
    shape = bent_egg(model)
    none = Fitter(model, replace(QUICK, refine="none")).fit(shape)
    fits = {name: Fitter(model, replace(QUICK, refine=name)).fit(shape) for name in ("nodes", "latent")}
    for fit in fits.values():
        assert np.isfinite(fit.points).all()
        assert np.array_equal(fit.points, node_system(model).moved(fit.vectors))
    if model.has_nodes:
        assert fits["nodes"].residual < none.residual
    else:  # there are no nodes: the code is refined
        assert np.array_equal(fits["nodes"].vectors, fits["latent"].vectors)
    high = dense_shape(model, fits["nodes"])
    assert np.allclose(high.verts, fits["nodes"].points_in_file, atol=1e-4)  # one resolution: the same vertices


def test_the_dense_system_is_the_sparse_one(rbf: TrainedModel) -> None:
    """One field, its matrices once dense and once sparse: the same least squares."""
    field, shape = rbf.field(rbf.template.shape.verts), rbf.template.shape
    assert isinstance(field, ShapeFunctions)
    sparse = NodeSystem(shape, ShapeFunctions(csr_matrix(field.phi), csr_matrix(field.gradient)), 50)
    dense = NodeSystem(shape, field, 50)
    rng = np.random.default_rng(0)
    A = rng.standard_normal((shape.V, 3, 3))
    H = A @ A.transpose(0, 2, 1)
    weights = H[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    pulls, targets = rng.standard_normal((shape.V, 3)), rng.standard_normal((50, 3, 3))
    found = [system.solve(weights, pulls, 0.1, targets, 1e-3, np.zeros((system.K, 3))) for system in (sparse, dense)]
    assert np.allclose(*found, rtol=1e-6, atol=1e-8)


def test_least_squares_work_on_radial_basis_functions(rbf: TrainedModel) -> None:
    system = node_system(rbf)
    bent = system.moved(gentle_vectors(rbf))
    scan = scan_of(replace(rbf.template.shape, verts=bent), 2000)
    found = refine_nodes(system, scan, np.zeros((system.K, 3)), QUICK.nodes)

    def away(vectors: np.ndarray) -> float:
        return float(cKDTree(scan.points).query(system.moved(vectors))[0].mean())

    assert away(found) < 0.5 * away(np.zeros((system.K, 3)))


def test_pointwise_fits_are_blended_by_codes_and_agree_as_they_are(pointwise: TrainedModel) -> None:
    shapes = [bent_egg(pointwise, seed) for seed in (0, 1)]
    fits = [Fitter(pointwise, replace(QUICK, refine="none")).fit(shape) for shape in shapes]
    believed = [replace(fit, verdict="good") for fit in fits]
    assert agreed_fits(pointwise, shapes, believed) == believed  # the same objects: nothing to solve for
    with pytest.raises(OptionError, match="pointwise") as caught:
        Blend(pointwise, fits)
    assert "--blend codes" in caught.value.hint
    blend = Blend(pointwise, fits, shapes=shapes, way="codes")
    for time, fit in enumerate(fits):
        assert np.allclose(blend.points(blend.vectors(time)), fit.points)
    assert blend.deviation(0.5, blend.vectors(0.5)).volume < 0.5
    turns = blend.turns(blend.vectors(0.5))
    assert np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-5)


def test_pointwise_models_hold_no_landmarks(pointwise: TrainedModel) -> None:
    known = np.array([0]), np.zeros((1, 3))
    with pytest.raises(OptionError, match="no nodes that landmarks could hold"):
        Fitter(pointwise, QUICK).fit(bent_egg(pointwise), known)


def test_a_field_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ModelError, match="unknown field 'splines'"):
        NetworkConfig.from_dict({"field": "splines"})
    assert NetworkConfig.from_dict({}).field == "mls"  # cards of before


@pytest.fixture(scope="module")
def eggs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three registered eggs, prepared in "prepared" beside it."""
    egg, folder = egg_model(), tmp_path_factory.mktemp("fields") / "eggs"
    folder.mkdir()
    for seed in range(3):
        save_shape(folder / f"egg{seed}.ply", bent_egg(egg, seed))
    prepare(folder, folder.with_name("prepared"), PrepareConfig(NodeConfig("uniform", 36, 0.5)))
    return folder


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("way", ["registered", "clouds"])
def test_train_save_load_and_register(
    field: str,
    way: str,
    eggs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    prepared = eggs.with_name("prepared")

    def small(plain: recipes.Recipe) -> recipes.Recipe:
        train = replace(plain.train, shapes=2, scans_per_shape=1, warm_up=1, workers=0)
        return replace(plain, network=replace(NETWORK, align_basis=0), train=train, scan=SCAN)

    for name in ("small_data", "clouds"):
        monkeypatch.setattr(recipes, name, partial(small, getattr(recipes, name)()))
    monkeypatch.setattr(FitConfig, "for_model", _short(FitConfig.for_model))
    words = ["--field", field, "--steps", "3", "--workers", "0", "--name", "eggs", "-q"]
    if way == "clouds":
        words.append("--unsupervised")
    folder = tmp_path / "model"
    assert main(["train", "--shapes", str(prepared), "-o", str(folder), *words]) == 0
    card = json.loads((folder / "card.json").read_text())
    assert card["network"]["field"] == field
    loaded = load_model(folder)
    assert loaded.has_nodes == (field != "pointwise")
    again = load_model(folder)
    rows = again.network(torch.zeros(1, 9, 3))
    assert torch.equal(rows, loaded.network(torch.zeros(1, 9, 3)))
    capsys.readouterr()
    out = tmp_path / "fitted.ply"
    words = ["-o", str(out), "--model", str(folder), "--json", "--threads", "1"]
    assert main(["register", str(eggs / "egg0.ply"), *words]) == 0
    said = capsys.readouterr()
    notes = json.loads(said.out)["notes"]
    assert any("its code was refined instead" in note for note in notes) == (field == "pointwise")
    assert load_shape(out).V == loaded.template.shape.V
    if way == "clouds":
        return
    words = ["--field", "mls" if field != "mls" else "rbf", "--start", str(folder), "--steps", "3"]
    assert main(["train", "--shapes", str(prepared), "-o", str(tmp_path / "other"), *words]) == 1
    assert f"model {load_model(folder).card.name} has another network" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def _short(for_model):
    """A fit with fewer of everything, so that a test takes seconds."""

    def shorter(self: FitConfig, model: TrainedModel) -> FitConfig:
        asked = replace(QUICK, refine=self.refine, seed=self.seed)
        return for_model(asked, model)

    return shorter
