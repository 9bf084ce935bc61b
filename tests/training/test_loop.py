"""The loop: it learns, it stops in time, and a run that was stopped ends exactly where an unbroken one does."""

import math
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from meshmatch.errors import MeshmatchWarning, ModelError, OptionError, OutputError
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import BatchNorm
from meshmatch.models.network import NetworkConfig
from meshmatch.templates.template import Template
from meshmatch.training.datasets import Batch, BatchDataset
from meshmatch.training.loop import StepReport, TrainConfig, Trainer, learning_rate
from meshmatch.training.losses import CorrespondenceLoss
from meshmatch.training.scans import ScanConfig
from tests.training.small import NETWORK, POINTS, SCAN, UPRIGHT, egg_template, small_data, small_network, small_points

CONFIG = TrainConfig(
    steps=10, shapes=4, scans_per_shape=2, warm_up=3, decay=0.5, workers=0, loss=CorrespondenceLoss(robust=True)
)


@pytest.fixture(scope="module")
def egg() -> Template:
    return egg_template()


def trainer(egg: Template, config: TrainConfig, network: NetworkConfig = NETWORK, scan: ScanConfig = SCAN) -> Trainer:
    return Trainer(small_network(egg, network, scan), small_points(egg), config)


def state(run: Trainer) -> dict[str, torch.Tensor]:
    """All that the next step depends on."""
    held = {f"model.{n}": t.clone() for n, t in run.model.state_dict().items()}
    held |= {f"average.{n}": t.clone() for n, t in run.average.items()}
    for index, moments in run.optimiser.state_dict()["state"].items():
        held |= {f"optimiser.{index}.{n}": torch.as_tensor(t).clone() for n, t in moments.items()}
    return held


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize(("network", "scan"), [(NETWORK, SCAN), (POINTS, UPRIGHT)], ids=["default", "paper"])
def test_a_stopped_run_ends_where_an_unbroken_one_does(
    egg: Template, tmp_path: Path, network: NetworkConfig, scan: ScanConfig
) -> None:
    """Bit for bit, dropout and batch norm of the paper's network included."""
    whole = trainer(egg, CONFIG, network, scan)
    whole.run(small_data(egg, whole.model, scan, length=10))

    path = tmp_path / "last.safetensors"
    first = trainer(egg, CONFIG, network, scan)

    def stop(now: StepReport) -> None:
        if now.step == 4:
            raise KeyboardInterrupt  # a kill

    with pytest.raises(KeyboardInterrupt):
        first.run(small_data(egg, first.model, scan, length=10), None, stop, every=1)
    first.save(path)
    torch.rand(17)  # another process has another global stream
    second = trainer(egg, CONFIG, network, scan)
    second.load(path)
    assert second.step == 4
    assert same(state(second), state(first))
    second.run(small_data(egg, second.model, scan, length=10))
    assert second.step == whole.step == 10
    assert same(state(second), state(whole))
    assert same(second.averaged_state(), whole.averaged_state())


@dataclass(frozen=True)
class Interrupting(CorrespondenceLoss):
    """Ctrl-C in the middle of the third step."""

    own: bool = True

    def __call__(self, *inputs: Any) -> dict[str, torch.Tensor]:
        if (step := CALLS.pop() + 1) == 3 and self.own:
            signal.raise_signal(signal.SIGINT)
        CALLS.append(step)
        return super().__call__(*inputs)


CALLS: list[int] = []


def test_ctrl_c_ends_a_training_after_its_step_with_a_checkpoint(egg: Template, tmp_path: Path) -> None:
    config = replace(CONFIG, steps=5)
    whole = trainer(egg, config)
    whole.run(small_data(egg, whole.model, length=5))
    path, stopped = tmp_path / "last.safetensors", trainer(egg, replace(config, loss=Interrupting(robust=True)))
    CALLS[:] = [0]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a run in the background ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            stopped.run(small_data(egg, stopped.model, length=5), path)
        assert CALLS == [3] and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    second = trainer(egg, config)
    second.load(path)
    assert second.step == 3
    second.run(small_data(egg, second.model, length=5))
    assert same(state(second), state(whole))


@pytest.mark.parametrize("own", [True, False], ids=["first", "second"])
def test_ctrl_c_of_one_process_ends_both_after_a_step_with_a_checkpoint(
    egg: Template, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: bool
) -> None:
    def meet(sums: torch.Tensor) -> None:
        """The second process has the same gradients, and is told to end in the third step."""
        sums.mul_(2)
        sums[-1] += len(sums) > 1 and not own and CALLS == [3]

    monkeypatch.setattr("torch.distributed.broadcast", lambda *_: None)
    monkeypatch.setattr("torch.distributed.all_reduce", meet)
    path, stopped = tmp_path / "last.safetensors", trainer(egg, replace(CONFIG, steps=5, loss=Interrupting(own=own)))
    stopped.world, CALLS[:] = 2, [0]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            stopped.run(small_data(egg, stopped.model, length=10), path)
        assert CALLS == [3] and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    second = trainer(egg, replace(CONFIG, steps=5, loss=Interrupting(own=own)))
    second.load(path)
    assert second.step == 3 and same(state(second), state(stopped))


def test_other_settings_of_a_checkpoint_are_told_and_kept(egg: Template, tmp_path: Path) -> None:
    path, first = tmp_path / "last.safetensors", trainer(egg, CONFIG)
    first.run(small_data(egg, first.model, length=10))
    first.save(path)
    again = trainer(egg, replace(CONFIG, minutes=3, workers=2))
    again.load(path)
    assert again.earlier == []
    other = trainer(egg, replace(CONFIG, steps=20, loss=replace(CONFIG.loss, volume=5.0)))
    with pytest.warns(MeshmatchWarning, match="steps 10 is 20 now, volume 0.* is 5.0 now"):
        other.load(path)
    assert other.earlier == [{"until_step": 10, "steps": 10, "loss.volume": CONFIG.loss.volume}]
    other.save(path)
    last = trainer(egg, replace(CONFIG, steps=20, loss=replace(CONFIG.loss, volume=5.0)))
    last.load(path)
    assert last.earlier == other.earlier


def test_another_number_of_processes_is_told_and_kept(
    egg: Template, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, alone = tmp_path / "last.safetensors", trainer(egg, CONFIG)
    alone.step = 4
    alone.save(path)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    both = trainer(egg, CONFIG)
    with pytest.warns(MeshmatchWarning, match="processes 1 is 2 now"):
        both.load(path)
    assert both.earlier == [{"until_step": 4, "processes": 1}]


def test_a_seed_fixes_the_training(egg: Template) -> None:
    def trained(seed: int) -> dict[str, torch.Tensor]:
        run = trainer(egg, replace(CONFIG, steps=2, seed=seed))
        run.run(small_data(egg, run.model, seed=seed, length=2))
        return state(run)

    first = trained(0)
    assert same(first, trained(0))
    assert not same(first, trained(1))


def test_worker_processes_change_nothing(egg: Template) -> None:
    def trained(workers: int) -> dict[str, torch.Tensor]:
        run = trainer(egg, replace(CONFIG, steps=3, workers=workers))
        run.run(small_data(egg, run.model, length=3))
        return state(run)

    assert same(trained(0), trained(1))


def test_half_precision_changes_the_loss_a_little(egg: Template) -> None:
    found = []
    for bf16 in (False, True):
        run = trainer(egg, replace(CONFIG, steps=2, bf16=bf16))
        run.run(small_data(egg, run.model, length=2), None, lambda now: found.append(now.terms["total"]), every=2)
    assert found[0] != found[1] == pytest.approx(found[0], rel=0.05)


@pytest.mark.parametrize("bf16", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_little_training_lowers_the_loss(egg: Template, bf16: bool) -> None:
    config = replace(CONFIG, steps=80, rate=3e-3, bf16=bf16)
    run = trainer(egg, config)
    seen: list[StepReport] = []
    run.run(small_data(egg, run.model, length=80), None, seen.append, every=10)
    first, last = seen[0].terms, seen[-1].terms
    assert last["total"] < 0.95 * first["total"]  # mostly the aligner's, and an egg looks alike from many sides
    assert last["error_code"] < 0.8 * first["error_code"]
    assert last["error_corrected"] < 0.7 * first["error_corrected"]
    assert [now.step for now in seen] == [10, 20, 30, 40, 50, 60, 70, 80]
    assert not run.model.training


def test_reports_are_means_over_what_they_cover(egg: Template) -> None:
    def reports(every: int) -> list[StepReport]:
        run = trainer(egg, replace(CONFIG, steps=5))
        seen: list[StepReport] = []
        run.run(small_data(egg, run.model, length=5), None, seen.append, every=every)
        return seen

    one, three = reports(1), reports(3)
    assert [now.step for now in three] == [3, 5]
    for now, covered in zip(three, (one[:3], one[3:]), strict=True):
        for name, value in now.terms.items():
            assert value == pytest.approx(sum(other.terms[name] for other in covered) / len(covered), rel=1e-4)


def test_the_rate_by_hand() -> None:
    config = TrainConfig(steps=100, rate=2.0, warm_up=4, decay=0.5)
    rates = [learning_rate(step, config) for step in range(101)]
    assert rates[:5] == [0.5, 1.0, 1.5, 2.0, 2.0]
    assert rates[50] == 2.0
    assert rates[75] == pytest.approx(1.0)
    assert rates[60] == pytest.approx(2.0 * 0.5 * (1 + math.cos(math.pi * 0.2)))
    assert rates[100] == pytest.approx(0.0)
    assert learning_rate(99, replace(config, decay=0.0)) == 2.0
    assert learning_rate(0, replace(config, warm_up=0)) == 2.0


def test_minutes_stop_a_run_with_a_checkpoint_to_go_on_from(egg: Template, tmp_path: Path) -> None:
    run = trainer(egg, replace(CONFIG, steps=100_000, minutes=0.2 / 60))
    path = tmp_path / "last.safetensors"
    run.run(small_data(egg, run.model, length=100_000), path)
    assert 0 < run.step < 100_000
    other = trainer(egg, replace(CONFIG, steps=100_000))
    other.load(path)
    assert other.step == run.step
    assert other.seconds == pytest.approx(run.seconds, abs=0.06)
    assert other.seconds > 0


def test_a_finished_run_has_nothing_left_to_do(egg: Template) -> None:
    run = trainer(egg, CONFIG)
    run.step = CONFIG.steps
    before = state(run)
    run.run(small_data(egg, run.model, length=10))
    assert same(before, state(run))


def test_the_average_follows_quickly_at_first(egg: Template) -> None:
    run = trainer(egg, CONFIG)
    name, parameter = next(iter(run.model.named_parameters()))
    start = run.average[name].clone()
    with torch.no_grad():
        parameter += 1.0
    run.step = 1
    run._update_average()
    assert torch.allclose(run.average[name], start + (1 - 2 / 11), atol=1e-6)  # keep = (1 + 1) / (10 + 1)
    run.step = 10**9
    run._update_average()
    assert torch.allclose(run.average[name], start + 1 - (2 / 11) * 0.999, atol=1e-6)
    averaged = run.averaged_state()
    assert averaged.keys() == run.model.state_dict().keys()
    assert torch.equal(averaged[name], run.average[name])
    assert torch.equal(averaged["nodes"], run.model.nodes)


def test_validation_is_asked_now_and_then(egg: Template) -> None:
    run = trainer(egg, replace(CONFIG, steps=10))
    seen: list[StepReport] = []
    asked: list[Deformer] = []

    def validate(model: Deformer) -> float:
        asked.append(model)
        return 0.25

    run.run(small_data(egg, run.model, length=10), None, seen.append, validate, every=1)
    assert [now.validation for now in seen] == [None] * 9 + [0.25]
    assert asked == [run.model]


def test_a_checkpoint_that_does_not_fit_is_refused(egg: Template, tmp_path: Path) -> None:
    path = tmp_path / "last.safetensors"
    run = trainer(egg, CONFIG)
    run.save(path)
    before = state(run)
    other = trainer(egg, CONFIG, replace(NETWORK, width=40))
    with pytest.raises(ModelError, match="another network") as caught:
        other.load(path)
    assert caught.value.hint
    with pytest.raises(ModelError, match="of a training with seed 0"):
        trainer(egg, replace(CONFIG, seed=CONFIG.seed + 1)).load(path)
    held = load_file(path)
    held["model.nodes"] = held["model.nodes"] + 1e-3
    save_file(held, path, {"step": "4"})
    with pytest.raises(ModelError, match="another template"):
        run.load(path)
    for content in (b"", b"\x00" * 100):
        path.write_bytes(content)
        with pytest.raises(ModelError, match="not a checkpoint"):
            run.load(path)
    save_file(held, path)  # a safetensors file, but not of a trainer
    with pytest.raises(ModelError, match="not a checkpoint"):
        run.load(path)
    assert run.step == 0
    assert same(before, state(run))  # untouched
    with pytest.raises(OutputError):
        run.save(tmp_path / "nowhere" / "last.safetensors")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda held, about: held.update({"average.other": torch.zeros(1)}), "another network"),
        (lambda held, about: held.update({"optimiser.0.step": torch.zeros(2)}), "not a checkpoint"),
        (lambda held, about: held.pop("optimiser.0.exp_avg"), "not a checkpoint"),
        (lambda held, about: held.update({"optimiser.first.step": torch.zeros(())}), "not a checkpoint"),
        (lambda held, about: held.update({"optimiser.9999.step": torch.zeros(())}), "not a checkpoint"),
        (lambda held, about: about.update({"step": "-1"}), "not a checkpoint"),
        (lambda held, about: about.update({"seconds": "inf"}), "not a checkpoint"),
        (lambda held, about: about.update({"settings": "[1]"}), "not a checkpoint"),
        (lambda held, about: about.update({"earlier": "{"}), "not a checkpoint"),
    ],
)
def test_a_damaged_checkpoint_changes_nothing(
    egg: Template, tmp_path: Path, change: Callable[[dict, dict], object], words: str
) -> None:
    path = tmp_path / "last.safetensors"
    run = trainer(egg, replace(CONFIG, steps=1))
    run.run(small_data(egg, run.model, length=1), path)
    held, about = load_file(path), {"step": "1", "seconds": "2.0", "seed": str(CONFIG.seed)}
    trainer(egg, run.config).load(path)
    change(held, about)
    save_file(held, path, about)
    before = state(run)
    with pytest.raises(ModelError, match=words):
        run.load(path)
    assert same(before, state(run))


@pytest.mark.parametrize(
    "values",
    [
        {"steps": 0},
        {"shapes": 0},
        {"scans_per_shape": 0},
        {"threads": 0},
        {"workers": -1},
        {"rate": 0.0},
        {"steps": 5.5},
        {"shapes": "8"},
        {"decay": 1.5},
        {"minutes": 0.0},
    ],
)
def test_impossible_settings_are_refused(values: dict) -> None:
    with pytest.raises(OptionError):
        TrainConfig(**values)


@dataclass(frozen=True)
class Spoilt(CorrespondenceLoss):
    """A loss of one's own, gone wrong."""

    how: Callable[[Any], Any] = dict

    def __call__(self, *given: Any) -> Any:
        return self.how(super().__call__(*given))


@pytest.mark.parametrize(("how", "error", "words"), [
    (lambda terms: terms["total"], OptionError, "a dictionary of scalar tensors"),
    (lambda terms: {**terms, "mine": 1.0}, OptionError, "a dictionary of scalar tensors"),
    (lambda terms: {**terms, "mine": terms["total"].expand(3)}, OptionError, "scalar tensors"),
    (lambda terms: {"mine": terms["total"]}, OptionError, "'total'"),
    (lambda terms: {"total": terms["total"].detach()}, OptionError, "gradient"),
    (lambda terms: {**terms, "total": terms["total"] / 0}, ModelError, "at step 1; not finite: total"),
])  # fmt: skip
def test_a_loss_that_nothing_can_be_learned_from_is_told(egg: Template, how: Any, error: Any, words: str) -> None:
    run = trainer(egg, replace(CONFIG, loss=Spoilt(how=how)))
    before = state(run)
    with pytest.raises(error, match=words) as caught:
        run.run(small_data(egg, run.model, length=10))
    assert caught.value.hint and same(state(run), before)


_TWO = replace(CONFIG, steps=4, minutes=60.0, loss=CorrespondenceLoss(robust=True, blend=0.0))
_ONE_OF_TWO = """
import sys
import torch.distributed as dist
from safetensors.torch import save_file
from tests.training.test_loop import _TWO, egg_template, small_data, trainer

egg = egg_template()
run = trainer(egg, _TWO)
run.run(small_data(egg, run.model, length=8))
save_file(run.averaged_state(), f"{sys.argv[1]}/{run.rank}.safetensors")
dist.destroy_process_group()
"""


class Joined(torch.utils.data.Dataset):
    """Item s is what two processes see at step s."""

    def __init__(self, data: BatchDataset) -> None:
        self.data = data

    def __getitem__(self, step: int) -> Batch:
        pair = zip(vars(self.data[2 * step]).values(), vars(self.data[2 * step + 1]).values(), strict=True)
        return Batch(*(torch.cat(both) for both in pair))


def in_two_processes(program: str, folder: Path) -> list[dict[str, torch.Tensor]]:
    """What each leaves in the folder, under the number of its rank."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    words = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-c", program, str(folder)]
    root = Path(__file__).resolve().parents[2]
    both = [subprocess.Popen(command, env=os.environ | words | {"RANK": rank}, cwd=root) for rank in "01"]
    assert [process.wait(timeout=300) for process in both] == [0, 0]
    return [load_file(folder / f"{rank}.safetensors") for rank in "01"]


@pytest.mark.slow
def test_two_processes_learn_as_one_that_sees_both_their_batches(egg: Template, tmp_path: Path) -> None:
    ranks = in_two_processes(_ONE_OF_TWO, tmp_path)
    assert same(ranks[0], ranks[1])

    alone = trainer(egg, _TWO)
    fresh = alone.averaged_state()
    alone.run(Joined(small_data(egg, alone.model, length=8)))  # type: ignore[arg-type]
    found = alone.averaged_state()
    for name, _ in alone.model.named_parameters():
        learned = (found[name] - fresh[name]).abs().mean()
        assert (found[name] - ranks[0][name]).abs().mean() <= 0.02 * learned + 1e-7, name


def test_a_step_on_another_device_waits_for_no_number_of_it(
    egg: Template, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On torch's meta device, which has shapes alone: whether a total is finite is asked a step later, and before a save."""
    monkeypatch.setattr("meshmatch.training.loop.training_device", lambda *_: torch.device("meta"))
    run = trainer(egg, CONFIG)
    run.optimiser = torch.optim.AdamW(run.model.parameters())  # its fused steps know no such device
    batch = small_data(egg, small_network(egg), length=8)[0]
    assert all(term.is_meta for term in run.iterate(batch).values()) and run.step == 1
    for ask in (lambda: run.iterate(batch), lambda: run.save(tmp_path / "last.safetensors")):
        with pytest.raises(RuntimeError, match="meta"):
            ask()
    assert run.step == 1 and not list(tmp_path.iterdir())


@dataclass(frozen=True)
class Told(CorrespondenceLoss):
    """The usual one; it writes down how exact products are, and whose numbers are drawn."""

    seen: tuple[list[Any], ...] = ([],)

    def __call__(self, model: Any, batch: Any, points: Any, generator: Any) -> Any:
        self.seen[0].append((torch.get_float32_matmul_precision(), generator is None))
        return super().__call__(model, batch, points, generator)


@pytest.mark.parametrize("how", [{}, {"tf32": True}, {"compile": True}])
def test_products_are_rounded_in_steps_alone(egg: Template, how: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "compile", lambda loss: loss)
    usual, drawn, loss = torch.get_float32_matmul_precision(), [], Told(seen=([],))
    run = trainer(egg, replace(CONFIG, steps=2, loss=loss, **how))
    data = small_data(egg, run.model, length=2)

    def source(count: int, generator: torch.Generator) -> torch.Tensor:
        drawn.append(torch.get_float32_matmul_precision())
        return data.source(count, generator)

    run.run(replace(data, source=source))
    assert loss.seen[0] == 2 * [("high" if "tf32" in how else usual, "compile" in how)]
    assert drawn == 2 * [usual] and torch.get_float32_matmul_precision() == usual


def test_a_compiled_loss_learns_the_same(egg: Template, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled, found = torch.compile, []
    monkeypatch.setattr(torch, "compile", lambda loss: compiled(loss, backend="aot_eager"))  # what it needs no C++ for
    for compile_it in (False, True):
        config = replace(CONFIG, steps=3, compile=compile_it, loss=CorrespondenceLoss(blend=0.0))
        run = trainer(egg, config, replace(NETWORK, align_basis=0, corrections=0))
        run.run(small_data(egg, run.model, length=3))
        found.append(run.averaged_state())
    for name, plain in found[0].items():
        assert torch.allclose(found[1][name], plain, atol=1e-6), name


_NORMS = """
import sys
import torch
import torch.distributed as dist
from safetensors.torch import save_file
from tests.training.test_loop import normed, ROWS

dist.init_process_group("gloo")
rank = dist.get_rank()
layer, out = normed(ROWS[:10] if rank == 0 else ROWS[10:])
grads = layer.weight.grad, layer.bias.grad
for each in grads:
    dist.all_reduce(each)
save_file({**layer.state_dict(), "weight.grad": grads[0], "bias.grad": grads[1], **out}, f"{sys.argv[1]}/{rank}.safetensors")
dist.destroy_process_group()
"""
ROWS = torch.randn(30, 4, generator=torch.Generator().manual_seed(0)) * 3 + 5


def normed(rows: torch.Tensor) -> tuple[BatchNorm, dict[str, torch.Tensor]]:
    """A layer after a step, what it gave, and the gradient of its input."""
    layer, rows = BatchNorm(4), rows.clone().requires_grad_()
    with torch.no_grad():
        layer.weight += torch.arange(4)
    out = layer(rows)
    (out * out.detach().sin()).sum().backward()
    assert rows.grad is not None
    return layer, {"out": out.detach(), "in.grad": rows.grad}


@pytest.mark.slow
def test_processes_norm_their_batches_together(tmp_path: Path) -> None:
    """As one process does that has all rows, gradients included; the processes have different numbers of them."""
    both = in_two_processes(_NORMS, tmp_path)
    layer, whole = normed(ROWS)
    assert layer.weight.grad is not None and layer.bias.grad is not None
    for name in ("out", "in.grad"):
        assert torch.allclose(torch.cat([each[name] for each in both]), whole[name], atol=1e-5), name
    wanted = {**layer.state_dict(), "weight.grad": layer.weight.grad, "bias.grad": layer.bias.grad}
    for each in both:
        assert all(torch.allclose(each[name], value, rtol=1e-5, atol=1e-4) for name, value in wanted.items())
