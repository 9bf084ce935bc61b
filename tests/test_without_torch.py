"""Matching where torch is not installed: it works, and what does need torch says which extra brings it."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import meshmatch
from meshmatch.errors import needs
from meshmatch.shapes.files import save_shape
from tests.fitting.eggs import egg_model, write_model

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "templates" / "samples" / "climber.ply"
BLOCKED = """
import sys
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")
sys.meta_path.insert(0, Without())
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter without torch."""
    return subprocess.run([sys.executable, "-c", BLOCKED + code], capture_output=True, text=True, cwd=ROOT)


@pytest.mark.slow
def test_a_shape_is_matched_without_torch() -> None:
    done = run(
        "import meshmatch\n"
        "few = meshmatch.FitConfig(variants=4, finalists=2)\n"
        f"found = meshmatch.match({str(SAMPLE)!r}, {str(SAMPLE)!r}, config=few)\n"
        "print(found.map.verdict, found.map.confidence.mean() > 0.8)"
    )
    assert (done.stdout.strip(), done.stderr) == ("good True", "")


@pytest.mark.parametrize(
    "words",
    [
        ["train", "-o", "model", "--shapes", "nowhere"],
        ["register", "egg.ply", "-o", "fitted.ply", "--refine", "latent", "--model", "./model"],
    ],
    ids=lambda words: words[0],
)
def test_what_needs_torch_says_so_in_a_line(words: list[str], tmp_path: Path) -> None:
    egg = egg_model()
    write_model(egg, tmp_path / "model")
    save_shape(tmp_path / "egg.ply", egg.template.shape)
    done = run(f"import os\nos.chdir({str(tmp_path)!r})\nfrom meshmatch.cli import main\nsys.exit(main({words!r}))")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-2:] == [
        "error: this needs torch, which is not installed",
        "hint: pip install 'meshmatch[train]'",
    ]
    assert not (tmp_path / "fitted.ply").exists()


def test_a_search_over_codes_says_so_before_anything_is_fitted(tmp_path: Path) -> None:
    egg = egg_model()
    write_model(egg, tmp_path / "model")
    save_shape(tmp_path / "egg.ply", egg.template.shape)
    done = run(
        f"import os\nos.chdir({str(tmp_path)!r})\nimport meshmatch\ntold = []\n"
        "try:\n    meshmatch.register('egg.ply', model='./model', config=meshmatch.FitConfig(refine='latent'),"
        " progress=lambda *words: told.append(words))\n"
        "except meshmatch.MeshmatchError as error:\n    print(told, error.hint)"
    )
    assert done.stdout.strip() == "[] pip install 'meshmatch[train]'"


def test_the_library_says_it_too() -> None:
    done = run(
        "import meshmatch\ntry:\n    meshmatch.train\nexcept meshmatch.MeshmatchError as error:\n    print(error.hint)"
    )
    assert done.stdout.strip() == "pip install 'meshmatch[train]'"


LACKING = {"ImplicitFit", "ImplicitModel", "Recipe"}
LACKING |= {"fit_implicit", "load_implicit", "recipe_for", "train", "train_implicit"}


def test_the_names_that_need_no_torch_are_listed_and_imported() -> None:
    """Else `from meshmatch import *`, `help(meshmatch)` and `inspect.getmembers` would end in an error."""
    done = run("before = set(globals())\nfrom meshmatch import *\nprint(*sorted(set(globals()) - before))")
    assert done.stderr == ""
    names = {*done.stdout.split()} - {"before"}
    assert set(meshmatch.__all__) - names == LACKING and names < set(meshmatch.__all__)
    done = run("import inspect, meshmatch\nprint(*dir(meshmatch))\ninspect.getmembers(meshmatch)")
    assert set(done.stdout.split()) == names and done.stderr == ""


def test_another_missing_library_is_not_taken_for_torch() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_library"), needs("torch", "train"):
        import_module("no_such_library")
