"""Who does the work, and what happens when a process dies."""

import multiprocessing
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

from meshmatch.collections.workers import DeadWorkerError, Processes, open_workers
from meshmatch.errors import MeshmatchWarning, OptionError

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
    with open_workers(count) as crew:
        assert dict(crew.map_unordered(squared, range(7))) == {number: number * number for number in range(7)}
        assert dict(crew.map_unordered(squared, [5])) == {0: 25}
        assert dict(crew.map_unordered(squared, [])) == {}


def test_a_process_that_dies_takes_no_other_result_with_it() -> None:
    with open_workers(2) as crew:
        found = dict(crew.map_unordered(squared_or_dead, range(6)))
        assert isinstance(found.pop(3), DeadWorkerError)
        assert found == {number: number * number for number in (0, 1, 2, 4, 5)}
        assert dict(crew.map_unordered(squared, range(3))) == {0: 0, 1: 1, 2: 4}  # and the crew is whole again


@pytest.mark.parametrize("count", [1, 2])
def test_what_a_task_raises_ends_the_work(count: int) -> None:
    with open_workers(count) as crew, pytest.raises(OptionError, match="not "):
        list(crew.map_unordered(refused, range(3)))


def test_no_workers_are_refused() -> None:
    with pytest.raises(OptionError, match="1 or more"), open_workers(0):
        pass


def test_workers_do_not_outlive_a_parent_that_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "parent.py"
    program.write_text(
        "import os\n"
        "from meshmatch.collections.workers import Processes\n"
        "from tests.collections.test_workers import asleep\n"
        "if __name__ == '__main__':\n"
        "    crew = Processes(2)\n"
        "    list(crew.map_unordered(asleep, [1, 2]))\n"
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
    assert dict(Processes(1).map_unordered(own_process, [0, 0])) == {0: os.getpid(), 1: os.getpid()}


def own_process(_: int) -> int:
    return os.getpid()


def pid_after_a_while(_: int) -> int:
    time.sleep(0.2)
    return os.getpid()


PROGRAM = """
import os
from meshmatch.collections.workers import Processes
from tests.collections.test_workers import pid_after_a_while
print("once")
found = dict(Processes(2).map_unordered(pid_after_a_while, range(4)))
print(len(found), os.getpid() in found.values())
"""


@pytest.mark.parametrize("way", ["standard input", "unguarded script", "command"])
def test_a_program_of_any_kind_has_processes(tmp_path: Path, way: str) -> None:
    """A spawned process must not look for a program that is no file, nor run an unguarded one again."""
    script = tmp_path / "unguarded.py"
    script.write_text(PROGRAM)
    words = {"standard input": ["-"], "unguarded script": [str(script)], "command": ["-c", PROGRAM]}[way]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    given = PROGRAM if way == "standard input" else ""
    done = subprocess.run([sys.executable, *words], input=given, capture_output=True, text=True, env=environment)
    assert (done.stdout, done.stderr, done.returncode) == ("once\n4 False\n", "", 0)


OWN_CLASS = """
import os, warnings
from dataclasses import dataclass
from meshmatch.collections.workers import Processes
from tests.collections.test_workers import name_of
@dataclass
class Own:
    name: str
warnings.simplefilter("always")
if __name__ == "__main__":
    print(sorted(Processes(2).map_unordered(name_of, [Own("a"), Own("b")])))
"""


def name_of(item: SimpleNamespace) -> str:
    return str(item.name)


@pytest.mark.parametrize("way", ["standard input", "script"])
def test_classes_of_the_program_itself_reach_the_work(tmp_path: Path, way: str) -> None:
    script = tmp_path / "guarded.py"
    script.write_text(OWN_CLASS)
    words = ["-"] if way == "standard input" else [str(script)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    given = OWN_CLASS if way == "standard input" else ""
    done = subprocess.run([sys.executable, *words], input=given, capture_output=True, text=True, env=environment)
    assert done.stdout == "[(0, 'a'), (1, 'b')]\n" and "Traceback" not in done.stderr
    assert ("cannot import the program" in done.stderr) == (way == "standard input")


def no_semaphores(*_: object, **__: object) -> None:
    raise OSError(38, "Function not implemented")


def test_without_shared_memory_this_process_works_and_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.collections.workers.ProcessPoolExecutor", no_semaphores)
    check_alone("Function not implemented")


def test_a_frozen_program_works_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    check_alone("frozen")


def test_processes_that_end_at_once_are_not_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "meshmatch.collections.workers._init_worker", os._exit
    )  # of the parent's number: as if it could not start
    check_alone("ended at once")


def check_alone(why: str) -> None:
    with warnings.catch_warnings(record=True) as said, open_workers(2) as crew:
        warnings.simplefilter("always")
        for _ in range(2):
            assert dict(crew.map_unordered(own_process, range(3))) == dict.fromkeys(range(3), os.getpid())
    assert [each.category for each in said] == [MeshmatchWarning] and why in str(said[0].message)


def in_a_daemon(count: int) -> tuple[dict[int, object], list[str], int]:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        return (
            dict(Processes(count).map_unordered(own_process, range(3))),
            [str(each.message) for each in said],
            os.getpid(),
        )


def test_a_daemonic_process_works_alone() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found, said, own = pool.apply(in_a_daemon, (2,))
    assert found == dict.fromkeys(range(3), own) and len(said) == 1 and "daemonic" in said[0]
