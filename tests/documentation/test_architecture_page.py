"""The page on architecture is true: the road of a match is the one that a match takes, and every place exists."""

import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import meshmatch
from tests.fitting.eggs import bent_egg, egg_model

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


@contextmanager
def calls_of(package: Path) -> Iterator[list[tuple[str, str]]]:
    """Files and names of the functions that are called, each at its first call."""
    seen: dict[tuple[str, str], None] = {}
    called: list[tuple[str, str]] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(str(package)):
            file = Path(frame.f_code.co_filename).relative_to(package).as_posix()
            seen.setdefault((file, frame.f_code.co_qualname))

    before = sys.getprofile()
    sys.setprofile(note)
    threading.setprofile(note)
    try:
        yield called
    finally:
        sys.setprofile(before)
        threading.setprofile(before)
        called += seen


def test_the_road_of_a_match_is_as_told() -> None:
    told = re.findall(r"^\d+\. `([\w/]+\.py)` `([\w.]+)`", PAGE, re.MULTILINE)
    assert len(told) == 11
    model = egg_model()
    with calls_of(ROOT / "meshmatch") as called:
        meshmatch.match(bent_egg(model, 0), bent_egg(model, 1), model=model, threads=1)
    assert [step for step in told if step not in called] == []
    assert sorted(told, key=called.index) == told


def test_every_file_and_folder_that_the_page_names_exists() -> None:
    paths = {path for path in re.findall(r"`((?:[\w.-]+/)+(?:[\w.-]+)?)`", PAGE) if not path.startswith("meshmatch/_")}
    assert len(paths) > 20
    assert [path for path in paths if not ((ROOT / path).exists() or (ROOT / "meshmatch" / path).exists())] == []


def test_every_package_has_its_line() -> None:
    told = set(re.findall(r"`(\w+)/?`", "".join(re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE))))
    there = {path.stem for path in (ROOT / "meshmatch").iterdir() if path.suffix in (".py", "") and path.name[0] != "_"}
    assert {name for name in there if name != "py"} <= told
