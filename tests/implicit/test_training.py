"""Trainings learn, end where an unbroken one does, and refuse checkpoints of others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.errors import ModelError, OptionError
from meshmatch.implicit.model import load_implicit
from meshmatch.implicit.objective import ImplicitLoss
from meshmatch.implicit.samples import ImplicitSamples, read_implicit_samples
from meshmatch.implicit.space import CUBE_RADIUS, cube_nodes
from meshmatch.implicit.training import AS_PUBLISHED, build_implicit, train_implicit
from meshmatch.models.card import IMPLICIT
from meshmatch.models.registry import WEIGHTS
from meshmatch.shapes.sampling import sample_surface
from meshmatch.training.loop import StepReport
from tests.implicit.boxes import TRAIN, box, config

BOTH = pytest.mark.parametrize("deformation", ["mls", "pointwise"])


@pytest.fixture(scope="module")
def samples(folder: Path) -> ImplicitSamples:
    return read_implicit_samples(folder)


@BOTH
def test_a_stopped_training_ends_where_an_unbroken_one_does(
    samples: ImplicitSamples, tmp_path: Path, deformation: str
) -> None:
    """Bit for bit; and the same seed gives the same weights."""
    settings = {"config": config(deformation), "training": replace(TRAIN, checkpoint_minutes=0)}
    whole = train_implicit(tmp_path / "whole", samples, **settings)

    def stop(now: StepReport) -> None:
        if now.step == 3:
            raise KeyboardInterrupt

    broken = tmp_path / "broken"
    with pytest.raises(KeyboardInterrupt), pytest.MonkeyPatch.context() as patch:
        patch.setattr("meshmatch.training.loop.Trainer.run", every_step(stop))
        train_implicit(broken, samples, **settings)
    assert not (broken / IMPLICIT).exists()
    torch.rand(17)  # another process has another global stream
    train_implicit(broken, samples, **settings)
    assert (broken / WEIGHTS).read_bytes() == (whole / WEIGHTS).read_bytes()


def test_published_terms_are_dif_nets(samples: ImplicitSamples) -> None:
    """By gradients that torch makes, for one shape."""
    made = build_implicit(samples, replace(config("pointwise"), length=0.1), 0).double()
    rows = torch.from_numpy(samples.rows[:1, ::400].astype(np.float64))
    at, distance, normals = rows[..., :3].clone().requires_grad_(), rows[..., 3].clone(), rows[..., 4:]
    half = at.shape[1] // 2
    distance[0, half + 1] = 3.0  # beyond what is told apart
    rows = torch.cat([rows[..., :3], distance[..., None], normals], -1)
    loss = AS_PUBLISHED.loss
    terms = loss.of(made, made.codes[:1], rows, torch.Generator())

    def slope(values: torch.Tensor, of: torch.Tensor) -> torch.Tensor:
        return torch.autograd.grad(values.sum(), of, retain_graph=True)[0][0]

    f, there = made.distance(at, made.codes[:1])
    u = there - at
    base = there.detach().requires_grad_()
    turned, steep = (slope(*each) for each in ((f, at), (made.template(base), base)))
    known = torch.ones(at.shape[1], dtype=torch.bool)
    known[half::2] = False
    off = 1 - torch.nn.functional.cosine_similarity(turned, normals[0], dim=-1)
    off = off + 1 - torch.nn.functional.cosine_similarity(steep, normals[0], dim=-1)
    expected = {
        "sdf": 3.0 * ((f[0].clamp(-0.5, 0.5) - distance[0].clamp(-0.5, 0.5)).abs() * known).mean(),
        "normal": 0.1 * (off * (normals[0].norm(dim=-1) > 0)).mean(),
        "eikonal": 0.05 * (turned.norm(dim=-1) - 1).abs().mean(),
        "off": 0.5 * ((-100 * f[0].abs()).exp() * ~known).mean(),
        "smooth": 5e-3 * torch.stack([slope(u[..., k], at).norm(dim=-1) for k in range(3)]).mean(),
        "correct": 0.1 * (f - made.template(there)[..., 0]).abs().mean(),
        "prior": 1e3 * made.codes[0].square().mean(),
    }
    assert {name: float(value.detach()) for name, value in terms.items() if name != "total"} == pytest.approx(
        {name: float(value.detach()) for name, value in expected.items()}, rel=1e-4
    )
    assert float(terms["total"].detach()) == pytest.approx(float(sum(expected.values()).detach()), rel=1e-4)


def test_the_reduced_field_adds_its_energies_to_dif_nets_terms(samples: ImplicitSamples) -> None:
    made = build_implicit(samples, config("mls"), 0)
    rows = torch.from_numpy(samples.rows[:2, ::200])
    found = {}
    for scale in (1.0, 3.0):
        weights = {name: scale * getattr(AS_PUBLISHED.loss, name) for name in ("volume", "arap", "blend")}
        loss = replace(AS_PUBLISHED.loss, **weights)
        found[scale] = loss.of(made, made.codes[:2], rows, torch.Generator().manual_seed(0))
    assert found[1.0]["arap"] > 0
    for name in ("volume", "arap", "blend"):
        assert torch.isclose(found[3.0][name], 3 * found[1.0][name])
    for each in found.values():
        assert torch.isclose(each.pop("total"), torch.stack(list(each.values())).sum())


def test_nodes_of_the_cube_reach_further_than_those_near_the_surfaces(samples: ImplicitSamples) -> None:
    made = build_implicit(samples, config("mls"), 0)
    nodes, radii = made.deformation.nodes, made.deformation.radii
    near, cube = slice(0, len(nodes) - len(cube_nodes())), slice(len(nodes) - len(cube_nodes()), None)
    assert np.array_equal(nodes[cube].numpy(), cube_nodes().astype(np.float32))
    assert nodes[cube].abs().amax(1).min() == 1  # on its edges and corners
    assert (radii[cube] == CUBE_RADIUS).all() and radii[near].max() < CUBE_RADIUS


def test_energies_between_codes_are_those_of_the_blended_field(samples: ImplicitSamples) -> None:
    """L_Z: of the deformation that a random blend of neighbouring codes makes."""
    made = build_implicit(samples, config("mls"), 0).double()
    with torch.no_grad():
        made.deformation.decoder[-1].weight.mul_(100)  # a deformation that is seen
    rows = torch.from_numpy(samples.rows[:2, ::400].astype(np.float64))
    loss = ImplicitLoss(blend=0.7)
    found = loss.of(made, made.codes[:2], rows, torch.Generator().manual_seed(5))["blend"]
    share = torch.rand(2, 1, generator=torch.Generator().manual_seed(5)).to(rows)
    code = share * made.codes[:2] + (1 - share) * made.codes[[1, 0]]
    at, h = rows[:, ::4, :3], 1e-5
    ends = [[made.distance(at + s * h * torch.eye(3).to(at)[k], code)[1] for s in (1, -1)] for k in range(3)]
    F = torch.stack([(a - b) / (2 * h) for a, b in ends], -1)
    volume = (torch.linalg.det(F) - 1).square().mean()
    arap = torch.linalg.matrix_norm(F.transpose(-1, -2) @ F - torch.eye(3).to(F)).mean()
    assert volume > 1e-3
    assert float(found.detach()) == pytest.approx(0.7 * float((volume + arap).detach()), rel=1e-3)


def every_step(stop):
    """`Trainer.run`, which reports each step and writes a checkpoint after each."""
    from meshmatch.training.loop import Trainer

    run = Trainer.run

    def changed(self, data, checkpoint=None, report=None, validate=None, **more):
        def both(now):
            self.save(checkpoint)
            stop(now)

        run(self, data, checkpoint, both, validate, 1, **more)

    return changed


@BOTH
def test_a_training_lowers_its_loss(samples: ImplicitSamples, tmp_path: Path, deformation: str) -> None:
    reports: list[StepReport] = []
    training = replace(TRAIN, steps=100, rate=2e-3)
    train_implicit(tmp_path, samples, config=config(deformation), training=training, report=reports.append)
    assert reports[-1].terms["sdf"] < 0.7 * reports[0].terms["sdf"]
    energies = {"volume", "arap", "blend"} & reports[-1].terms.keys()
    assert bool(energies) == (deformation == "mls")


def test_a_checkpoint_of_other_shapes_or_another_network_is_refused(
    samples: ImplicitSamples, tmp_path: Path, folder: Path
) -> None:
    train_implicit(tmp_path, samples, config=config("pointwise"), training=TRAIN)
    others = replace(samples, rows=0.9 * samples.rows)
    for given, deformation in ((others, "pointwise"), (samples, "mls")):
        with pytest.raises(ModelError, match="checkpoint"):
            train_implicit(tmp_path, given, config=config(deformation), training=TRAIN)


def test_a_training_needs_full_precision(samples: ImplicitSamples, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="bfloat16"):
        train_implicit(tmp_path, samples, config=config("mls"), training=replace(TRAIN, bf16=True))


def test_the_sign_of_clouds_comes_from_their_normals(tmp_path: Path) -> None:
    """No distance but 0 is known; still the inside becomes negative, and the corners of the cube positive."""
    rng = np.random.default_rng(0)
    for number in range(3):
        half = rng.uniform([0.5, 0.4, 0.4], [1.0, 0.6, 0.8])
        drawn = sample_surface(box(half), 4000, rng)
        np.savez(tmp_path / f"cloud{number}.npz", points=drawn.points, normals=drawn.normals)
    training = replace(TRAIN, steps=150, rate=2e-3, average=0.9)
    model = load_implicit(train_implicit(tmp_path / "model", tmp_path, config=config("mls"), training=training))
    for name in model.card.shapes:
        values = model.distance(np.array([[0.0, 0, 0], [0.95, 0.95, 0.95]]), model.known(name).code)[0]
        assert values[0] < -0.05
        assert values[1] > 0.05
