"""The page on architecture is true: its roads are those that the work takes, and every place exists."""

import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

import meshmatch
from meshmatch.api.prepare import PrepareConfig, prepare
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from tests.fitting.eggs import bent_egg, egg_model, write_model
from tests.training.test_run import SMALL

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = str(ROOT / "meshmatch")
STATIONS = ("shapes", "fitting", "maps", "transfer")
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


class Calls:
    """Functions of the package in the order of their first calls, and the rooms whose functions `api` called."""

    def __init__(self) -> None:
        self._seen: set[tuple[str, str]] = set()
        self.called: list[tuple[str, str]] = []
        self.rooms: list[str] = []

    def note(self, frame: FrameType, event: str, _: object) -> None:
        file, name = frame.f_code.co_filename, frame.f_code.co_qualname
        if event != "call" or not file.startswith(PACKAGE):
            return
        step = Path(file).relative_to(PACKAGE).as_posix(), name
        if step not in self._seen:
            self._seen.add(step)
            self.called.append(step)
        caller = frame.f_back.f_code.co_filename if frame.f_back else ""
        room = step[0].partition("/")[0]
        if caller.startswith(f"{PACKAGE}/api/") and "." not in name and room in STATIONS and [room] != self.rooms[-1:]:
            self.rooms.append(room)


@contextmanager
def calls() -> Iterator[Calls]:
    """What is called inside."""
    made = Calls()
    before = sys.getprofile()
    sys.setprofile(made.note)
    threading.setprofile(made.note)
    try:
        yield made
    finally:
        sys.setprofile(before)
        threading.setprofile(before)


def match(model: TrainedModel, folder: Path) -> Callable[[], object]:
    return lambda: meshmatch.match(bent_egg(model, 0), bent_egg(model, 1), model=model, threads=1)


def transfer_texture(model: TrainedModel, folder: Path) -> Callable[[], object]:
    source, colors = bent_egg(model, 0), np.random.default_rng(0).random((model.template.shape.V, 4))
    save_shape(folder / "source.ply", Shape(source.verts, source.faces, "source", colors))
    save_shape(folder / "target.ply", bent_egg(model, 1))
    return lambda: meshmatch.transfer_texture(
        folder / "source.ply",
        folder / "target.ply",
        meshmatch.Matcher(model, threads=1),
        options=meshmatch.BakeOptions(size=32),
    )


def fit(model: TrainedModel, folder: Path) -> Callable[[], object]:
    shapes, trained = [folder / "a.ply", folder / "b.ply"], write_model(model, folder / "model")
    for seed, shape in enumerate(shapes):
        save_shape(shape, bent_egg(model, seed))
    return lambda: meshmatch.Collection(folder / "fits", workers=1).fit(shapes, model=str(trained))


def train(model: TrainedModel, folder: Path) -> Callable[[], object]:
    (folder / "shapes").mkdir()
    for seed in range(3):
        save_shape(folder / "shapes" / f"{seed}.ply", bent_egg(model, seed))
    nodes = NodeConfig(strategy="uniform", K=36, radius=0.45, depth=0.05)
    prepare(folder / "shapes", folder / "prepared", PrepareConfig(nodes))
    return lambda: meshmatch.train(folder / "trained", shapes=folder / "prepared", recipe=SMALL)


def road(verb: str) -> list[tuple[str, str]]:
    """The files and functions that the page names for a verb."""
    text = PAGE.partition(f"### `{verb}`\n")[2].partition("\n##")[0]
    return re.findall(r"^\d+\. `([\w/]+\.py)` `([\w.]+)`", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("work", "rooms"),
    [
        (match, ["shapes", "fitting", "maps"]),
        (transfer_texture, ["shapes", "transfer", "shapes", "fitting", "maps", "transfer"]),  # as the page says
        (fit, None),
        (train, None),
    ],
)
def test_the_road_of_a_verb_is_as_told(
    work: Callable[..., Callable[[], object]], rooms: list[str] | None, tmp_path: Path
) -> None:
    told = road(work.__name__.replace("_", "-"))
    assert len(told) == 10
    run = work(egg_model(), tmp_path)
    with calls() as made:
        run()
    assert [step for step in told if step not in made.called] == []
    assert sorted(told, key=made.called.index) == told
    assert rooms is None or made.rooms == rooms


def test_every_file_and_folder_that_the_page_names_exists() -> None:
    paths = {path for path in re.findall(r"`((?:[\w.-]+/)+(?:[\w.-]+)?)`", PAGE) if not path.startswith("meshmatch/_")}
    assert len(paths) > 20
    assert [path for path in paths if not ((ROOT / path).exists() or (ROOT / "meshmatch" / path).exists())] == []


def test_every_package_has_its_line() -> None:
    told = set(re.findall(r"`(\w+)/?`", "".join(re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE))))
    there = {path.stem for path in (ROOT / "meshmatch").iterdir() if path.suffix in (".py", "") and path.name[0] != "_"}
    assert {name for name in there if name != "py"} <= told
