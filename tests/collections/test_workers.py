"""Who does the work, and what happens when a process dies."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from meshmatch.collections.workers import Died, Processes, hired
from meshmatch.errors import OptionError

ROOT = Path(__file__).parents[2]


def squared(number: int) -> int:
    return number * number


def squared_or_dead(number: int) -> int:
    if number == 3:
        os._exit(9)
    return number * number


def refused(number: int) -> int:
    raise OptionError(f"not {number}")


def asleep(number: int) -> int:
    time.sleep(600)
    return number


@pytest.mark.parametrize("count", [1, 2])
def test_every_item_is_done_once(count: int) -> None:
    with hired(count) as crew:
        assert dict(crew.each(squared, range(7))) == {number: number * number for number in range(7)}
        assert dict(crew.each(squared, [5])) == {0: 25}
        assert dict(crew.each(squared, [])) == {}


def test_a_process_that_dies_takes_no_other_result_with_it() -> None:
    with hired(2) as crew:
        found = dict(crew.each(squared_or_dead, range(6)))
        assert isinstance(found.pop(3), Died)
        assert found == {number: number * number for number in (0, 1, 2, 4, 5)}
        assert dict(crew.each(squared, range(3))) == {0: 0, 1: 1, 2: 4}  # and the crew is whole again


@pytest.mark.parametrize("count", [1, 2])
def test_what_a_task_raises_ends_the_work(count: int) -> None:
    with hired(count) as crew, pytest.raises(OptionError, match="not "):
        list(crew.each(refused, range(3)))


def test_no_workers_are_refused() -> None:
    with pytest.raises(OptionError, match="1 or more"), hired(0):
        pass


def test_workers_do_not_outlive_a_parent_that_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "parent.py"
    program.write_text(
        "import os\n"
        "from meshmatch.collections.workers import Processes\n"
        "from tests.collections.test_workers import asleep\n"
        "if __name__ == '__main__':\n"
        "    crew = Processes(2)\n"
        "    list(crew.each(asleep, [1, 2]))\n"
    )
    child = subprocess.Popen([sys.executable, str(program)], env=os.environ | {"PYTHONPATH": str(ROOT)})
    try:
        deadline = time.monotonic() + 60
        while len(found := children(child.pid)) < 3 and time.monotonic() < deadline:  # two, and multiprocessing's own
            time.sleep(0.1)
    finally:
        child.kill()
        child.wait()
    assert len(found) >= 3
    deadline = time.monotonic() + 30
    while any(Path(f"/proc/{pid}").exists() for pid in found) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not [pid for pid in found if Path(f"/proc/{pid}").exists()]


def children(pid: int) -> list[int]:
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def test_one_process_is_this_one() -> None:
    assert dict(Processes(1).each(own_process, [0, 0])) == {0: os.getpid(), 1: os.getpid()}


def own_process(_: int) -> int:
    return os.getpid()
