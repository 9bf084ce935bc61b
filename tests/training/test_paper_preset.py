"""The paper's preset from the first word to a map: `train --preset paper`, then `match` and `register` with it."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.api.prepare import PrepareConfig, prepare
from meshmatch.cli import main
from meshmatch.experiments.makers.human_bodies import with_paper_nodes
from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import build_field
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.models.registry import load_model
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepared_folder import ShapeSamples
from meshmatch.templates.template import read_template, template_radius
from meshmatch.training import recipes
from meshmatch.training.loop import TrainConfig, Trainer
from meshmatch.training.losses import ChamferLoss
from meshmatch.training.train import CardFacts, build_dataset, train_model
from tests.training.small import POINTS, egg_template, registered_eggs

pytestmark = pytest.mark.usefixtures("remembered_fits")


@dataclass(frozen=True)
class QuickConfig(FitConfig):
    """Fewer samples."""

    samples: int = 1000
    coarse_samples: int = 300


QUICK = QuickConfig()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.fitting.fit_config.FitConfig", QuickConfig)


@pytest.fixture(scope="module")
def eggs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of registered eggs."""
    return registered_eggs(tmp_path_factory.mktemp("eggs") / "in", 4)


@pytest.fixture(scope="module")
def model(eggs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The preset as it is, but for a narrow network, few points, small batches, and what suits 60 steps."""
    root = tmp_path_factory.mktemp("paper")
    prepare(eggs, root / "prepared", PrepareConfig(NodeConfig("uniform", 36, 0.45)))
    plain = recipes.paper

    def narrow() -> recipes.Recipe:
        chosen = plain()
        same = (chosen.network.encoder, chosen.network.decoder, chosen.network.align_basis, chosen.network.corrections)
        assert same == (POINTS.encoder, POINTS.decoder, POINTS.align_basis, POINTS.corrections)
        train = replace(chosen.train, shapes=6, rate=5e-3, warm_up=5, average=0.99)
        return replace(chosen, network=POINTS, scan=replace(chosen.scan, points=96), train=train)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recipes, "paper", narrow)
        words = ["--preset", "paper", "--steps", "60", "--workers", "0", "--name", "eggs", "-q"]
        prepared = str(root / "prepared")
        assert main(["train", "--shapes", prepared, "-o", str(root / "model"), *words]) == 0
    return root / "model"


@pytest.fixture(scope="module")
def loaded(model: Path) -> TrainedModel:
    return load_model(model)


def test_the_model_has_the_papers_choices(loaded: TrainedModel) -> None:
    card = loaded.card
    assert card.steps == 60
    assert card.field["kernel"] == "cubic"
    assert (card.network["encoder"], card.network["decoder"]) == ("point", "node")
    assert card.recipe["scan"]["upright"] is True
    assert card.frame == {"orientation": "searched", "scale": "sphere"}
    assert loaded.network.aligner is None


def test_the_papers_numbers() -> None:
    """Table 1, what the text says of training, and the search over codes (eq. 11)."""
    chosen = recipes.paper()
    loss, train = chosen.train.loss, chosen.train
    assert (loss.reconstruction, loss.volume, loss.arap, loss.blend) == (1.0, 5e-3, 1e-2, 5e-3)
    assert (train.rate, train.shapes, train.scans_per_shape, train.steps) == (1e-3, 16, 1, 75_000)
    assert (train.warm_up, train.decay, train.weight_decay, train.average, train.clip) == (0, 0.0, 0.0, 0.0, None)
    adam = Trainer(torch.nn.Linear(2, 2), None, train).optimiser.defaults
    assert (adam["lr"], adam["betas"], adam["weight_decay"]) == (1e-3, (0.9, 0.999), 0.0)
    assert (chosen.scan.points, chosen.scan.sphere, chosen.kernel) == (3000, True, "cubic")
    search = FitConfig().latent
    assert (search.steps, search.rate, search.points) == (2000, 1e-3, 3000)
    assert (search.chamfer, search.volume, search.arap) == (1.0, 1e-4, 1e-3)
    clouds = recipes.paper_clouds()
    config = clouds.train.loss  # table 2
    assert (config.reconstruction, config.volume, config.arap, config.blend) == (1.0, 1e-4, 1e-3, 1e-4)
    assert isinstance(config, ChamferLoss) and config.plain and clouds.scan.sphere
    template = read_template(chosen.template)
    assert template.K == 300
    middle = 0.5 * (template.shape.verts.min(0) + template.shape.verts.max(0))
    diameter = 2 * np.linalg.norm(template.shape.verts - middle, axis=1).max()
    assert template.radius == pytest.approx(0.2 * diameter, abs=0.006)
    made = with_paper_nodes(read_template("human-T"))
    assert (made.name, made.hash) == (template.name, template.hash)


def test_shapes_to_learn_from_have_the_templates_radius() -> None:
    template = egg_template()
    stretched = torch.from_numpy(template.shape.verts * [1.0, 2.0, 0.7]).float()
    scan = recipes.paper().scan
    for sphere in (True, False):
        data = build_dataset(
            template, lambda n, _: stretched.expand(n, -1, -1), None, replace(scan, sphere=sphere), 2, 1, 0
        )
        far = data[0].targets.norm(dim=-1).amax(1)
        assert (abs(far - template_radius(template)).max() < 0.05) == sphere


def test_lengths_of_the_loss_are_those_of_the_unit_sphere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A distance in the template's unit is divided by its radius, so its square, and the weight, by the radius squared."""

    class Seen(Exception):
        pass

    def trainer(_model: object, _points: object, config: TrainConfig, *_: object) -> None:
        raise Seen(config.loss.reconstruction)

    monkeypatch.setattr("meshmatch.training.train.Trainer", trainer)
    template, narrow = egg_template(), replace(recipes.paper(), network=POINTS)
    verts = torch.tensor(template.shape.verts).float()
    for sphere, unit in ((True, template_radius(template)), (False, 1.0)):
        recipe = replace(narrow, scan=replace(narrow.scan, points=50, sphere=sphere))
        with pytest.raises(Seen) as found:
            train_model(
                template, lambda n, _: verts.expand(n, -1, -1), tmp_path / str(sphere), recipe, CardFacts("egg")
            )
        assert found.value.args[0] == pytest.approx(unit**-2)
    points = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
    for scale, unit in (("sphere", template_radius(template)), ("area", 1.0)):
        samples = ShapeSamples(points, points, points[:, :0], np.zeros(0, np.int64), "none", scale)
        recipe = replace(recipes.paper_clouds(), network=POINTS)
        with pytest.raises(Seen) as found:
            train_model(template, samples, tmp_path / scale, recipe, CardFacts("egg"))
        assert found.value.args[0] == pytest.approx(unit**-2)


def test_weights_of_losses_can_be_set() -> None:
    loss = recipes.paper().changed(volume=0.5, arap=0.25, blend=0.125).train.loss
    assert (loss.volume, loss.arap, loss.blend) == (0.5, 0.25, 0.125)


def test_its_fits_are_moved_with_the_papers_kernel(loaded: TrainedModel, eggs: Path) -> None:
    fit = Fitter(loaded, QUICK).fit(load_shape(eggs / "egg0.ply"))
    template = loaded.template
    phi = {
        kernel: Field.of(build_field(template.shape.verts, template.nodes, template.radius, kernel))
        .phi.to_dense()
        .double()
        for kernel in ("cubic", "smooth")
    }
    off = {
        kernel: np.abs(template.shape.verts + matrix.numpy() @ fit.vectors - fit.points).max()
        for kernel, matrix in phi.items()
    }
    assert off["cubic"] < 1e-6 < 1e-4 < off["smooth"]


def test_match_uses_it(model: Path, eggs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "map.npy"
    files = eggs / "egg0.ply", eggs / "egg1.ply"
    words = [str(word) for word in ("match", *files, "-o", output, "--model", model, "--json", "-q")]
    residuals = []
    for more in (["--refine", "none"], []):
        assert main(words + more) == 0
        record = json.loads(capsys.readouterr().out)
        assert record["model"] == str(model)
        residuals.append([fit["residual"] for fit in record["fits"]])
    assert (np.array(residuals[1]) < 0.6 * np.array(residuals[0])).all()
    index = np.load(output)
    assert index.shape == (162,)
    assert len(np.unique(index)) > 50


def test_register_uses_it_in_full_resolution(model: Path, eggs: Path, loaded: TrainedModel, tmp_path: Path) -> None:
    files = [tmp_path / "low.ply", tmp_path / "high.ply"]
    for path, more in zip(files, ([], ["--dense"]), strict=True):
        words = ["-o", str(path), "--model", str(model), "--threads", "1", "-q", *more]
        assert main(["register", str(eggs / "egg0.ply"), *words]) == 0
    low, high = (load_shape(path) for path in files)
    # these templates have one resolution: two ways through the field, one shape
    assert loaded.template.dense.V == loaded.template.shape.V
    assert np.allclose(low.verts, high.verts, atol=1e-5)
