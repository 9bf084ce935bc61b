"""Fitting moves the template with the kernel that the network was trained with, wherever it moves it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.errors import ModelError, OptionError
from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import build_field
from meshmatch.fitting.fit import dense_shape
from meshmatch.fitting.fit_config import FitConfig, Refine
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.latent import LatentRefineConfig, PaperEnergy
from meshmatch.fitting.search.refinement import REFINEMENTS
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.kernels import KERNELS, Kernel
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.registry import built_in_folder, load_model
from meshmatch.models.trained import TrainedModel
from tests.fitting.eggs import egg_model

OTHER: dict[Kernel, Kernel] = {"cubic": "smooth", "smooth": "cubic"}


@pytest.fixture(scope="module", params=KERNELS)
def model(request: pytest.FixtureRequest) -> TrainedModel:
    return egg_model(request.param)


def shape_functions(model: TrainedModel, kernel: Kernel) -> tuple[np.ndarray, np.ndarray]:
    """Dense phi (V, K) and gradient (3 V, K) on the template's vertices, float64."""
    template = model.template
    field = Field.of(build_field(template.shape.verts, template.nodes, template.radius, kernel))
    return field.phi.to_dense().double().numpy(), field.gradient.to_dense().double().numpy()


def small_vectors(model: TrainedModel) -> np.ndarray:
    return np.random.default_rng(0).normal(0, 0.05, (model.template.K, 3))


def test_the_two_kernels_differ_enough_to_tell(model: TrainedModel) -> None:
    kernel = model.card.field["kernel"]
    (one, one_slope), (two, two_slope) = (shape_functions(model, k) for k in (kernel, OTHER[kernel]))
    assert np.abs(one - two).max() > 0.05
    assert np.abs(one_slope - two_slope).max() > 0.5


def test_the_least_squares_system_has_the_models_kernel(model: TrainedModel) -> None:
    phi, gradient = shape_functions(model, model.card.field["kernel"])
    system = node_system(model)
    assert np.allclose(system.phi.toarray(), phi, atol=1e-6)
    rows = (3 * system.gradient_points[:, None] + np.arange(3)).ravel()
    assert np.allclose(system.equations.gradient.toarray(), gradient[rows], atol=1e-5)


def test_the_papers_energy_has_the_models_kernel(model: TrainedModel) -> None:
    phi, gradient = shape_functions(model, model.card.field["kernel"])
    rng = np.random.default_rng(1)
    points = rng.normal(0, 0.3, (50, 3))
    vectors = small_vectors(model)
    config = LatentRefineConfig(chamfer=1.0, volume=0.3, arap=0.7)
    energy = PaperEnergy(model, OrientedPoints(points, points), config, rng)

    moved = model.template.shape.verts + phi @ vectors
    squared = np.square(moved[:, None] - points).sum(-1)
    F = (gradient @ vectors).reshape(-1, 3, 3).transpose(0, 2, 1) + np.eye(3)
    wanted = (
        squared.min(1).mean()
        + squared.min(0).mean()
        + 0.3 * np.square(np.linalg.det(F) - 1).mean()
        + 0.7 * np.linalg.norm(F.transpose(0, 2, 1) @ F - np.eye(3), axis=(1, 2)).mean()
    )
    assert energy.value(vectors) == pytest.approx(wanted, rel=1e-4)
    assert float(energy(torch.from_numpy(vectors).float()[None])) == pytest.approx(wanted, rel=1e-4)


@pytest.mark.parametrize("refine", REFINEMENTS)
def test_a_fit_is_the_template_moved_with_the_models_kernel(model: TrainedModel, refine: Refine) -> None:
    config = FitConfig(refine=refine, samples=400, copies=4, variants=2, latent=LatentRefineConfig(steps=3))
    fit = Fitter(model, config).fit(model.template.shape)
    phi, _ = shape_functions(model, model.card.field["kernel"])
    assert np.allclose(fit.points, model.template.shape.verts + phi @ fit.vectors, atol=1e-6)


def test_the_dense_mesh_is_moved_with_the_models_kernel(model: TrainedModel) -> None:
    # Where the dense mesh is the coarse one, a fit's dense shape is the fit.
    template = model.template
    assert np.array_equal(template.dense.verts, template.shape.verts)
    fit = Fitter(model, FitConfig(refine="none", samples=400, copies=4)).fit(template.shape)
    strong = replace(fit, vectors=small_vectors(model))
    strong = replace(strong, points=node_system(model).moved(strong.vectors))
    assert np.allclose(dense_shape(model, strong).verts, strong.points_in_file, atol=1e-6)
    with pytest.raises(OptionError, match="of another template"):
        dense_shape(model, replace(fit, template_hash="0" * 16))


def test_a_model_with_a_kernel_that_is_not_known_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "human"
    shutil.copytree(built_in_folder() / "human", folder)
    card = json.loads((folder / "card.json").read_text())
    card["field"]["kernel"] = "wendland"
    (folder / "card.json").write_text(json.dumps(card))
    with pytest.raises(ModelError, match="kernel 'wendland'") as caught:
        load_model(folder)
    assert "update" in caught.value.hint
