"""`train` as `torchrun` starts it: two processes on the CPU, one model, one voice."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch.distributed as dist
from safetensors import safe_open

from meshmatch.models.registry import verify_model
from tests.training.small import prepared_eggs

ROOT = Path(__file__).resolve().parents[2]

# The verb with a small recipe; each process leaves the weights that it ended with.
TRAIN = """
import os, sys
from dataclasses import replace
from pathlib import Path
from safetensors.torch import save_file
from meshmatch.cli import main
from meshmatch.training import loop, recipes
from tests.training.small import POINTS, SCAN

plain, finish = recipes.recipe_for, loop.Trainer.close

def small(*words):
    chosen = plain(*words)
    train = replace(chosen.train, shapes=4, scans_per_shape=1, workers=0, warm_up=1)
    return replace(chosen, network=POINTS, scan=SCAN, train=train)

def close(trainer):
    kept = {**trainer.averaged_state(), **{"now." + n: t for n, t in trainer.model.state_dict().items()}}
    save_file({n: t.clone() for n, t in kept.items()}, Path(os.environ["KEPT"]) / f"rank{trainer.rank}.safetensors")
    finish(trainer)

recipes.recipe_for, loop.Trainer.close = small, close
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepared_eggs(tmp_path_factory.mktemp("eggs"), 3)


@pytest.mark.slow
@pytest.mark.skipif(not dist.is_gloo_available(), reason="this torch has no gloo")
def test_two_processes_train_one_model(prepared: Path, tmp_path: Path) -> None:
    script = tmp_path / "train.py"
    script.write_text(TRAIN)
    output = tmp_path / "model"
    launcher = ["-m", "torch.distributed.run", "--nproc-per-node=2", "--standalone"]
    words = ["train", "--shapes", prepared, "-o", output, "--steps", "3", "--json"]
    outside = {"PYTHONPATH": str(ROOT), "KEPT": str(tmp_path), "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *launcher, str(script), *map(str, words)],
        capture_output=True, text=True, env=os.environ | outside, cwd=tmp_path, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    # one of them speaks
    assert json.loads(done.stdout)["steps"] == 3
    assert done.stderr.count("step 3 of 3") == 1
    assert done.stderr.count("wrote model") == 1
    # one writes, once
    assert sorted(path.name for path in (output / "checkpoint").iterdir()) == ["last.safetensors", "lock"]
    with safe_open(str(output / "checkpoint" / "last.safetensors"), framework="np") as file:
        assert file.metadata()["step"] == "3"
        held = [name for name in file.keys() if name.startswith("model.")]  # noqa: SIM118 (it is no dictionary)
        kept = {name.removeprefix("model."): file.get_tensor(name) for name in held}
    card = verify_model(output)
    assert (card.steps, card.recipe["processes"]) == (3, 2)
    # both ended with the same weights, which are the checkpoint's
    ranks = []
    for rank in (0, 1):
        with safe_open(str(tmp_path / f"rank{rank}.safetensors"), framework="np") as file:
            ranks.append({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118 (as above)
    assert ranks[0].keys() == ranks[1].keys()
    assert all(np.array_equal(ranks[0][name], ranks[1][name]) for name in ranks[0])  # statistics of batch norms too
    assert any("running_mean" in name for name in kept)
    assert all(np.array_equal(ranks[0][f"now.{name}"], kept[name]) for name in kept)
    assert any((ranks[0][name] != kept[name]).any() for name in kept)  # the average lags behind
