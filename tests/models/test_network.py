"""The networks: what must not matter does not, and what goes in one by one comes out as in a batch."""

import shutil
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import threadpoolctl
import torch

from meshmatch.errors import InputError, ModelError
from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import build_field
from meshmatch.models.checkpoint import save_weights
from meshmatch.models.deformer import Deformer, blank_deformer, rotation_from_six, with_weights
from meshmatch.models.inference import NodeNetwork, load_network
from meshmatch.models.layers import (
    BasisEncoder,
    FlatDecoder,
    NodeDecoder,
    PointEncoder,
    ResidualBlock,
    nearest,
    residual_mlp,
    two_way_offsets,
)
from meshmatch.models.network import PAPER, NetworkConfig, weight_shapes
from meshmatch.models.registry import built_in_folder, load_model
from meshmatch.models.trained import TrainedModel
from meshmatch.training.train import build_deformer
from tests.fitting.eggs import egg_model
from tests.training.small import NETWORK, POINTS, SCAN, UPRIGHT, bent_eggs, egg_template

CONFIGS = pytest.mark.parametrize("config", [NETWORK, POINTS], ids=["basis", "point"])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def clouds(B: int = 3, P: int = 60, seed: int = 0) -> torch.Tensor:
    return 0.3 * torch.randn(B, P, 3, generator=seeded(seed))


def network(config: NetworkConfig, seed: int = 0) -> Deformer:
    """An egg's network whose last layers speak up: fresh ones hardly move anything."""
    egg = egg_template()
    scan = SCAN if config.encoder == "basis" else UPRIGHT
    model = build_deformer(egg, bent_eggs(egg), config, scan, "smooth", seed)
    generator = seeded(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
    return model.eval()


@pytest.fixture(scope="module")
def networks() -> dict[str, Deformer]:
    return {config.encoder: network(config) for config in (NETWORK, POINTS)}


@pytest.fixture(scope="module")
def human() -> TrainedModel:
    return load_model("human")


# neighbours


def test_nearest_points_by_hand() -> None:
    points = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 5, 0]]])
    queries = torch.tensor([[[0.9, 0, 0], [0, 3, 1]]])
    index, offset = nearest(queries, points)
    assert index.tolist() == [[1, 2]]
    assert torch.allclose(offset, torch.tensor([[[0.1, 0, 0], [0, 2, -1]]]))


def test_the_tree_and_every_pair_agree() -> None:
    queries, points = clouds(4, 80, 1), clouds(4, 50, 2)
    index, offset = nearest(queries, points)
    assert torch.equal(index, torch.cdist(queries, points).argmin(-1))
    slow = (queries[:, :, None] - points[:, None]).norm(dim=-1).amin(-1)
    assert torch.allclose(offset.norm(dim=-1), slow, atol=1e-6)


def test_two_way_offsets_by_hand() -> None:
    """Two anchors; three points see the first, none the second."""
    anchors = torch.tensor([[[0.0, 0, 0], [0, 0, 9]]])
    points = torch.tensor([[[1.0, 0, 0], [0, 2, 0], [0, 0, 3]]])
    seen = two_way_offsets(anchors, points)[0]
    assert torch.allclose(seen[0, :3], torch.tensor([1.0, 0, 0]))
    assert torch.allclose(seen[0, 3:6], torch.tensor([1 / 3, 2 / 3, 1.0]))
    assert float(seen[0, 6]) == pytest.approx(float(torch.tensor(3.0).log()), abs=1e-6)  # log(1 + 3 * 2/3)
    assert torch.allclose(seen[1], torch.tensor([0.0, 0, -6, 0, 0, 0, 0]))


def test_two_way_offsets_ignore_the_order_of_the_points() -> None:
    anchors, points = clouds(2, 20, 1), clouds(2, 90, 2)
    shuffled = points[:, torch.randperm(90, generator=seeded())]
    assert torch.allclose(two_way_offsets(anchors, points), two_way_offsets(anchors, shuffled), atol=1e-6)


# encoders and decoders


@CONFIGS
def test_the_encoder_ignores_the_order_of_the_points(networks: dict[str, Deformer], config) -> None:
    encoder = networks[config.encoder].encoder
    points = clouds()
    shuffled = points[:, torch.randperm(60, generator=seeded())]
    code = encoder(encoder.features(points))
    assert code.shape == (3, 16)
    assert torch.allclose(encoder(encoder.features(shuffled)), code, atol=1e-5)
    assert (encoder(encoder.features(points + 0.1)) - code).abs().max() > 1e-3  # but not the points


@CONFIGS
def test_the_encoder_takes_any_number_of_points_and_repeated_ones(networks, config) -> None:
    encoder = networks[config.encoder].encoder
    points = clouds(2, 33)
    code = encoder(encoder.features(points))
    twice = torch.cat([points, points], 1)
    assert torch.allclose(encoder(encoder.features(twice)), code, atol=1e-5)


@CONFIGS
def test_a_batch_of_one_equals_one_of_a_batch(networks: dict[str, Deformer], config) -> None:
    model, points = networks[config.encoder], clouds()
    together = model(points)
    for n in range(3):
        assert torch.allclose(model(points[n : n + 1])[0], together[n], atol=1e-5)
    assert (together[0] - together[1]).abs().max() > 1e-3
    assert together.shape == (3, model.K, 3)


@CONFIGS
def test_points_are_a_batch_of_clouds(networks: dict[str, Deformer], config) -> None:
    for wrong in (clouds()[0], clouds()[..., :2], clouds()[:0], clouds()[:, :0]):
        with pytest.raises(InputError, match="points must be"):
            networks[config.encoder](wrong)


@CONFIGS
def test_points_are_finite_tensors_of_any_precision(networks: dict[str, Deformer], config) -> None:
    points = clouds()
    for wrong, words in ((points.numpy(), "a tensor, not ndarray"), (points * float("nan"), "must be finite")):
        with pytest.raises(InputError, match=words) as caught:
            networks[config.encoder](wrong)
        assert caught.value.hint
    assert torch.equal(networks[config.encoder](points.double()), networks[config.encoder](points))


def test_features_of_points_that_are_not_finite_are_refused(networks: dict[str, Deformer]) -> None:
    with pytest.raises(InputError, match="no point is nearest"):
        networks["basis"].encoder.features(clouds() * float("inf"))


@CONFIGS
def test_it_is_differentiable_up_to_the_points(networks: dict[str, Deformer], config) -> None:
    model = deepcopy(networks[config.encoder]).double().eval()
    assert torch.autograd.gradcheck(model, clouds(2).double().requires_grad_(), fast_mode=True)


def test_the_positional_encoding_lies_on_a_sphere() -> None:
    encoder = PointEncoder(8)
    features = encoder.features(clouds())
    assert features.shape == (3, 60, 128)
    assert torch.allclose(features.norm(dim=-1), torch.ones(3, 60), atol=1e-5)
    at_zero = encoder.features(torch.zeros(1, 1, 3))[0, 0] * 8
    assert torch.allclose(at_zero, torch.tensor([0.0] * 64 + [1.0] * 64), atol=1e-6)
    wave = encoder.frequencies[5]
    there = encoder.features((wave / wave.square().sum() / 4)[None, None])[0, 0] * 8  # a quarter of its period along
    assert there[5] == pytest.approx(1.0)
    assert there[64 + 5] == pytest.approx(0.0, abs=1e-6)


def test_the_positional_encodings_frequencies_are_gaussian() -> None:
    torch.manual_seed(0)
    waves = torch.cat([PointEncoder(8, latent=8).frequencies for _ in range(50)])  # 3,200
    assert waves.mean(0).abs().max() < 0.1
    assert (waves.std(0) - 1.5).abs().max() < 0.1  # alike along every axis
    assert waves.T.cov().fill_diagonal_(0).abs().max() < 0.15
    fourth = (waves / waves.std(0)).pow(4).mean(0)
    assert (fourth - 3).abs().max() < 0.5  # 1.8 where they are uniform, 1 where they are two numbers


def test_basis_features_are_offsets() -> None:
    encoder = BasisEncoder(torch.tensor([[0.0, 0, 0], [1, 1, 1]]), 8, 1, 4)
    points = torch.tensor([[[0.2, 0, 0], [1, 1, 1.4]]])
    assert torch.allclose(encoder.features(points), torch.tensor([[[1.0, 0, 0], [0, 0, 2]]]), atol=1e-6)


def test_the_node_decoder_is_one_mlp_over_nodes() -> None:
    """[q_i, code] through one matrix is the same as the code's part, broadcast, plus the node's."""
    torch.manual_seed(0)
    nodes = clouds(1, 12)[0]
    decoder = NodeDecoder(5, nodes, 16).eval()
    code = torch.randn(3, 5, generator=seeded())
    found = decoder(code)
    assert found.shape == (3, 12, 3)
    matrix = torch.cat([decoder.from_node.weight, decoder.from_code.weight], 1)
    for b in range(3):
        for k in range(12):
            hidden = matrix @ torch.cat([nodes[k], code[b]]) + decoder.from_code.bias
            one = 2 * torch.tanh(decoder.network(hidden[None]))[0]
            assert torch.allclose(found[b, k], one, atol=1e-5)
    shuffled = NodeDecoder(5, nodes.flip(0), 16).eval()
    shuffled.load_state_dict(decoder.state_dict() | {"nodes": nodes.flip(0)})
    assert torch.allclose(shuffled(code), found.flip(1), atol=1e-6)


def test_the_flat_decoder_has_a_row_for_each_node() -> None:
    assert FlatDecoder(5, 16, 1, 12)(torch.zeros(3, 5)).shape == (3, 12, 3)


def test_a_fresh_residual_block_is_the_identity() -> None:
    x = torch.randn(4, 8, generator=seeded())
    assert torch.equal(ResidualBlock(8)(x), x)
    torch.manual_seed(0)
    assert residual_mlp(8, 64, 2, 30)(x).abs().max() < 0.2  # near zero: an untrained template stays at rest


def test_predicted_rotations_are_rotations() -> None:
    R = rotation_from_six(torch.randn(50, 6, generator=seeded()))
    assert torch.allclose(R.transpose(1, 2) @ R, torch.eye(3).expand(50, 3, 3), atol=1e-5)
    assert torch.allclose(torch.det(R), torch.ones(50), atol=1e-5)
    hand = rotation_from_six(torch.tensor([[0.0, 2, 0, 1, 1, 0]]))[0]
    assert torch.allclose(hand, torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), atol=1e-6)


# the whole


def test_zero_nodes_move_nothing() -> None:
    egg = egg_template()
    field = Field.of(build_field(egg.shape.verts, egg.nodes, egg.radius, "smooth"))
    zero = torch.zeros(1, egg.K, 3)
    assert torch.equal(field.displacement(zero), torch.zeros(1, 162, 3))
    assert torch.equal(field.deformation_gradient(zero), torch.eye(3).expand(1, 162, 3, 3))


def test_an_untrained_template_stays_nearly_at_rest() -> None:
    egg = egg_template()
    model = build_deformer(egg, bent_eggs(egg), NETWORK, SCAN, "smooth", 0).eval()
    assert model(clouds()).abs().max() < 0.05


def test_a_seed_fixes_the_network() -> None:
    first, again, other = (network(NETWORK, seed).state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["encoder.basis"], other["encoder.basis"])


def test_a_correction_is_relative_to_where_the_template_is(networks: dict[str, Deformer]) -> None:
    model = networks["basis"]
    vectors, points = 0.05 * torch.randn(2, model.K, 3, generator=seeded()), clouds(2)
    step = model.correct(vectors, points) - vectors
    assert torch.allclose(model.correct(vectors, points.flip(1)) - vectors, step, atol=1e-6)
    assert (model.correct(vectors, points + 0.2) - vectors - step).abs().max() > 1e-3


def test_the_aligner_answers_with_a_rigid_motion(networks: dict[str, Deformer]) -> None:
    model = networks["basis"]
    assert model.aligner is not None
    R, t = model.align(model.aligner.features(clouds()))
    assert (R.shape, t.shape) == ((3, 3, 3), (3, 3))
    assert torch.allclose(torch.det(R), torch.ones(3), atol=1e-5)


def test_what_a_config_leaves_out_is_not_there(networks: dict[str, Deformer]) -> None:
    assert networks["point"].aligner is None
    assert networks["point"].corrector is None
    assert (PAPER.encoder, PAPER.decoder, PAPER.code) == ("point", "node", 512)


@CONFIGS
def test_saved_networks_come_back_bit_for_bit(networks, config, tmp_path: Path) -> None:
    model = networks[config.encoder]
    save_weights(model.state_dict(), tmp_path / "weights.safetensors", storage="float32")
    found = load_network(tmp_path / "weights.safetensors", config, model.K)
    assert isinstance(found, NodeNetwork)
    points = clouds()
    assert torch.equal(with_weights(config, model.K, found.weights)(points), model(points))


@pytest.mark.parametrize("config", [NETWORK, POINTS, PAPER, NetworkConfig()], ids=str)
def test_the_names_and_shapes_of_weights_are_those_of_torch(config: NetworkConfig) -> None:
    wanted = {name: tuple(value.shape) for name, value in blank_deformer(config, 7).state_dict().items()}
    assert weight_shapes(config, 7) == wanted


@CONFIGS
def test_arrays_and_torch_give_the_same_answers(networks: dict[str, Deformer], config: NetworkConfig) -> None:
    model = networks[config.encoder]
    inference = NodeNetwork(config, {name: value.numpy() for name, value in model.state_dict().items()})
    points = clouds(3, 60).double().numpy()
    several = [points[0], points[1], points[2, :40]]
    assert np.allclose(inference.predict(several), model_answers(model, several), atol=2e-5)
    turn = rotation_from_six(torch.randn(1, 6, generator=seeded()))[0].double().numpy()
    rows = inference.predict(several)[0]
    assert np.allclose(inference.rotate_rows(rows, turn), model.rotate_rows(rows, turn), atol=1e-6)
    assert np.allclose(inference.encode(points[0]), model.encode(points[0]), atol=2e-5)
    code = model.encode(points[0])
    assert np.allclose(inference.decode(code), model.decode(code), atol=2e-5)
    if config.align_basis:
        offsets = torch.randn(4, config.align_basis, 3, generator=seeded()).numpy()
        for ours, theirs in zip(inference.read_frames(offsets), model.read_frames(offsets), strict=True):
            assert np.allclose(ours, theirs, atol=2e-5)


def model_answers(model: Deformer, clouds: list[np.ndarray]) -> np.ndarray:
    """One cloud at a time: torch has no batches of different sizes."""
    with torch.inference_mode():
        return np.concatenate([model(torch.from_numpy(c).float()[None]).numpy() for c in clouds])


def test_the_model_that_ships_answers_the_same_in_arrays_and_in_torch(human: TrainedModel) -> None:
    rng = np.random.default_rng(0)
    several = [rng.permutation(human.template.shape.verts)[:count] for count in (700, 1400, 2048)]
    wanted = model_answers(human.network, several)
    for times in (1, 2, 11):  # few rows, some and many are multiplied in ways of their own
        apart = np.abs(human.inference.predict(times * several) - np.tile(wanted, (times, 1, 1)))
        assert apart.max() < 1e-5


def test_questions_that_are_asked_together_are_answered_as_each_alone(human: TrainedModel) -> None:
    """Bit for bit with OpenBLAS, whatever their sizes and neighbours: a fit must not depend on what is fitted beside it."""
    network, rng = human.inference, np.random.default_rng(0)
    assert isinstance(network, NodeNetwork)
    verts = human.template.shape.verts
    questions = [
        [rng.permutation(verts)[:300] + 0.02 * rng.standard_normal(3) for _ in range(size)]
        for size in (2, 12, 1, 4, 6, 3, 24, 40, 2, 12)
    ]
    alone = [network.predict(question) for question in questions]
    blas = {each["internal_api"] for each in threadpoolctl.threadpool_info() if each["user_api"] == "blas"}
    for together in (questions, questions[::-1], questions[3:5], questions[:1]):
        for question, found in zip(together, network.predict_each(together), strict=True):
            wanted = alone[next(k for k, each in enumerate(questions) if each is question)]
            assert np.abs(found - wanted).max() < 1e-5
            assert blas != {"openblas"} or np.array_equal(found, wanted)


def test_configs_survive_their_card_and_unknown_options_do_not() -> None:
    for config in (NetworkConfig(), PAPER, replace(NETWORK, basis=77)):
        assert NetworkConfig.from_dict(config.to_dict()) == config
    with pytest.raises(ModelError, match="unknown network options: wings") as caught:
        NetworkConfig.from_dict(NETWORK.to_dict() | {"wings": 2})
    assert "update" in caught.value.hint
    for name in ("code", "width"):  # through which nothing would pass
        with pytest.raises(ModelError, match=f"{name} must be an integer from 1 to"):
            NetworkConfig.from_dict(NETWORK.to_dict() | {name: 0})


# the model that ships


def test_the_model_that_ships_loads_and_is_the_one_of_its_card(human: TrainedModel) -> None:
    assert human.card.template_hash == human.template.hash
    assert human.network.K == human.template.K == len(human.network.nodes)
    assert torch.allclose(human.network.nodes, torch.from_numpy(human.template.nodes).float(), atol=1e-6)
    phi = human.network.anchor_phi
    assert torch.allclose(phi.sum(1), torch.ones(len(phi)), atol=1e-4)  # the field's law, after storage
    assert torch.allclose(phi @ human.network.nodes, human.network.anchors, atol=1e-4)
    assert not human.network.training


def test_the_model_that_ships_leaves_its_own_template_at_rest(human: TrainedModel) -> None:
    rest = torch.from_numpy(human.template.shape.verts[::3].copy()).float()[None]
    field = human.field(human.template.shape.verts)
    with torch.inference_mode():
        moved = field.displaced(human.network(rest)[0].double().numpy())
    assert np.linalg.norm(moved, axis=1).mean() < 0.035  # 5 cm on a body


def test_another_template_beside_the_weights_is_refused(tmp_path: Path) -> None:
    from meshmatch.templates.template import load_template, save_template

    shutil.copytree(built_in_folder() / "human", tmp_path / "human")
    template = load_template(tmp_path / "human" / "template.safetensors")
    save_template(replace(template, radius=0.14), tmp_path / "human" / "template.safetensors")
    with pytest.raises(ModelError, match="trained with another template"):
        load_model(tmp_path / "human")
    with pytest.raises(ModelError, match="no model 'humna'") as caught:
        load_model("humna")
    assert "human" in caught.value.hint


def test_a_model_in_memory_must_be_of_one_piece() -> None:
    model = egg_model()
    made = TrainedModel.of(model.card, model.template, deepcopy(model.network))
    points = torch.randn(1, 40, 3, generator=torch.Generator().manual_seed(0)) * 0.2
    assert torch.equal(made.network(points), model.network(points))
    spoiled = deepcopy(model.network)
    with torch.no_grad():
        next(spoiled.decoder.parameters()).fill_(float("nan"))
    fewer = replace(model.template, nodes=model.template.nodes[:-1])
    card = replace(model.card, template_hash=fewer.hash, field={**model.card.field, "nodes": fewer.K})
    for words, make in (
        ("Linear is not the network", lambda: TrainedModel.of(model.card, model.template, torch.nn.Linear(3, 3))),  # type: ignore[arg-type]
        ("another template", lambda: TrainedModel.of(model.card, fewer, model.network)),
        (f"moves {fewer.K + 1} nodes", lambda: TrainedModel.of(card, fewer, model.network)),
        ("nan or infinite", lambda: TrainedModel.of(model.card, model.template, spoiled)),
    ):
        with pytest.raises(ModelError, match=words) as caught:
            make()
        assert caught.value.hint
