"""Weights: compact on disk, strict on the way back."""

import hashlib
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from meshmatch.errors import ModelError, OptionError, OutputError
from meshmatch.models.checkpoint import STORAGES, load_weights, save_weights

State = dict[str, torch.Tensor]


@pytest.fixture()
def state() -> State:
    generator = torch.Generator().manual_seed(0)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator)

    scales = torch.logspace(-3, 2, 40)[:, None]  # rows of very different size
    return {
        "layer.weight": normal(40, 128) * scales,
        "layer.bias": normal(40),
        "short.weight": normal(5, 3),
        "conv.weight": normal(4, 6, 1),
        "norm.running_var": torch.tensor([1e-12, 1.0, 1e9]),
        "norm.num_batches_tracked": torch.tensor(12345678),
        "nodes": normal(100, 128),
        "mask": torch.tensor([True, False]),
    }


def shapes(state: State) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


def loaded(path: Path, state: State) -> State:
    return {name: torch.from_numpy(array) for name, array in load_weights(path, shapes(state)).items()}


@pytest.mark.parametrize("storage", STORAGES)
def test_round_trip(storage: str, state: State, tmp_path: Path) -> None:
    path = tmp_path / "weights.safetensors"
    digest = save_weights(state, path, storage=storage)
    found = loaded(path, state)
    assert digest == hashlib.sha256(path.read_bytes()).hexdigest()
    assert found.keys() == state.keys()
    for name, tensor in state.items():
        assert found[name].dtype == tensor.dtype
        assert found[name].shape == tensor.shape
        if not name.endswith(".weight") or storage == "float32":
            assert torch.equal(found[name], tensor), name


def test_int8_errs_by_half_a_scale_at_most(state: State, tmp_path: Path) -> None:
    save_weights(state, tmp_path / "w", storage="int8")
    weight, found = state["layer.weight"], loaded(tmp_path / "w", state)["layer.weight"]
    scale = weight.abs().amax(1, keepdim=True) / 127
    error = (found - weight).abs() / scale
    assert error.max() <= 0.5 + 1e-4
    assert error.max() > 0.4  # it is int8, not something finer
    # of a normal row of 128 the rounding error is scale / sqrt(12): about 0.6 % of its standard deviation
    relative = (found - weight).norm(dim=1) / weight.norm(dim=1)
    assert 0.004 < relative.mean() < 0.009
    assert relative.max() < 0.012


def test_float16_errs_by_its_precision(state: State, tmp_path: Path) -> None:
    save_weights(state, tmp_path / "w", storage="float16")
    found = loaded(tmp_path / "w", state)
    for name in ("layer.weight", "short.weight", "conv.weight"):
        close = (found[name] - state[name]).abs() <= state[name].abs() * 2**-11 + 2**-25
        assert close.all(), name
    assert not torch.equal(found["layer.weight"], state["layer.weight"])


def test_a_weight_too_large_for_float16_stays_float32(tmp_path: Path) -> None:
    large = {"a.weight": torch.full((2, 3), 1e6)}
    save_weights(large, tmp_path / "w", storage="float16")
    assert torch.equal(loaded(tmp_path / "w", large)["a.weight"], large["a.weight"])


def test_rows_of_zeros_stay_zeros(tmp_path: Path) -> None:
    state = {"a.weight": torch.zeros(3, 64)}
    save_weights(state, tmp_path / "w", storage="int8")
    assert torch.equal(loaded(tmp_path / "w", state)["a.weight"], state["a.weight"])


def test_int8_is_a_quarter_and_float16_a_half(tmp_path: Path) -> None:
    state = {"a.weight": torch.randn(512, 512, generator=torch.Generator().manual_seed(0))}
    size = {}
    for storage in STORAGES:
        save_weights(state, tmp_path / storage, storage=storage)
        size[storage] = (tmp_path / storage).stat().st_size
    assert size["float16"] < 0.51 * size["float32"]
    assert size["int8"] < 0.26 * size["float32"]


def test_the_same_state_gives_the_same_file(state: State, tmp_path: Path) -> None:
    turned_round = dict(reversed(state.items()))
    assert save_weights(state, tmp_path / "a") == save_weights(turned_round, tmp_path / "b")


def test_shared_memory_can_be_saved(tmp_path: Path) -> None:
    whole = torch.arange(12.0).reshape(3, 4)
    state = {"a": whole, "b": whole, "c": whole[:, 1], "d": whole.t()}
    save_weights(state, tmp_path / "w", storage="float32")
    found = loaded(tmp_path / "w", state)
    assert all(torch.equal(found[name], tensor) for name, tensor in state.items())


def test_diverged_weights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="a is not finite"):
        save_weights({"a": torch.tensor([1.0, float("nan")])}, tmp_path / "w")
    assert not (tmp_path / "w").exists()


def test_unknown_storage_and_folder_are_refused(state: State, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="unknown storage 'int4'"):
        save_weights(state, tmp_path / "w", storage="int4")
    with pytest.raises(OutputError, match="there is no folder"):
        save_weights(state, tmp_path / "none" / "w")


def test_missing_unexpected_and_misshapen_tensors_are_named(state: State, tmp_path: Path) -> None:
    save_weights(state, tmp_path / "w", storage="int8")
    wanted = shapes(state)
    with pytest.raises(ModelError, match="missing extra"):
        load_weights(tmp_path / "w", wanted | {"extra": (1,)})
    with pytest.raises(ModelError, match=r"unexpected layer\.bias"):
        load_weights(tmp_path / "w", {n: s for n, s in wanted.items() if n != "layer.bias"})
    with pytest.raises(ModelError, match=r"unexpected layer\.weight"):  # and its scale is not left over
        load_weights(tmp_path / "w", {n: s for n, s in wanted.items() if n != "layer.weight"})
    with pytest.raises(ModelError, match=r"layer\.weight has shape \(40, 128\), not \(128, 40\)"):
        load_weights(tmp_path / "w", wanted | {"layer.weight": (128, 40)})


def test_scales_must_fit(state: State, tmp_path: Path) -> None:
    save_weights(state, tmp_path / "w", storage="int8")
    stored = load_file(tmp_path / "w")
    words = {"meshmatch": "weights 1"}
    wrong: list[State] = [
        {n: t for n, t in stored.items() if n != "layer.weight.scale"},
        stored | {"layer.weight.scale": torch.ones(39)},
        stored | {"layer.weight.scale": torch.ones(40).half()},
        stored | {"layer.weight": stored["layer.weight"].float()},
    ]
    for tensors in wrong:
        save_file(tensors, tmp_path / "x", words)
        with pytest.raises(ModelError, match=r"the scale of layer\.weight"):
            load_weights(tmp_path / "x", shapes(state))


def test_infinite_scales_and_foreign_files_are_refused(state: State, tmp_path: Path) -> None:
    save_weights(state, tmp_path / "w", storage="int8")
    stored = load_file(tmp_path / "w")
    save_file(stored, tmp_path / "x")
    with pytest.raises(ModelError, match="not a weights file of meshmatch"):
        load_weights(tmp_path / "x", shapes(state))
    for scale in (float("inf"), 3e38):
        stored["layer.weight.scale"][3] = scale
        save_file(stored, tmp_path / "x", {"meshmatch": "weights 1"})
        with pytest.raises(ModelError, match=r"layer\.weight is not finite"):
            load_weights(tmp_path / "x", shapes(state))


def test_a_damaged_file_is_refused(state: State, tmp_path: Path) -> None:
    save_weights(state, tmp_path / "w")
    data = (tmp_path / "w").read_bytes()
    (tmp_path / "w").write_bytes(data[:-1])
    with pytest.raises(ModelError, match="damaged"):
        load_weights(tmp_path / "w", shapes(state))
