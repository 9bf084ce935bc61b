"""The ground: errors, output files, threads, lazy public names."""

import errno
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

import meshmatch
from meshmatch import errors
from meshmatch.errors import InputError, MeshmatchError, OutputError
from meshmatch.locks import locked
from meshmatch.outputs import folder_on_success, replace_on_success
from meshmatch.threads import parallel_map, set_threads, thread_limit, worker_slot


def test_error_has_a_line_and_a_hint() -> None:
    error = InputError("cannot\n read  it", "try\nagain")
    assert (error.message, error.hint, str(error)) == ("cannot read it", "try again", "cannot read it")
    assert InputError("x").hint == ""


def test_a_message_is_short_and_commands_no_terminal() -> None:
    error = InputError("\x1b]0;pwned\x07\x9b31m a\u202eb " + "x" * 5000 + " end", "y" * 301)
    assert len(error.message) == len(error.hint) == 300
    assert error.message.startswith("\ufffd]0;pwned\ufffd\ufffd31m a\ufffdb xxx") and error.message.endswith("x end")


def test_every_error_is_one_family() -> None:
    names = ["InputError", "ModelError", "TemplateError", "OptionError", "OutputError", "PoorFit"]
    assert all(issubclass(getattr(errors, name), MeshmatchError) for name in names)
    assert not issubclass(MeshmatchError, (OSError, ValueError))


def test_error_keeps_its_hint_through_a_process_pool() -> None:
    error = pickle.loads(pickle.dumps(OutputError("a", "b")))
    assert type(error) is OutputError
    assert (error.message, error.hint) == ("a", "b")


def test_output_appears_whole(tmp_path: Path) -> None:
    with replace_on_success(tmp_path / "map.npy") as temporary:
        assert temporary.suffix == ".npy"
        assert temporary.parent == tmp_path
        temporary.write_text("new")
        assert not (tmp_path / "map.npy").exists()
    assert (tmp_path / "map.npy").read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["map.npy"]


def test_output_is_replaced_not_rewritten(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    with (tmp_path / "a.txt").open() as reader:
        with replace_on_success(tmp_path / "a.txt") as temporary:
            temporary.write_text("new")
        assert reader.read() == "old"  # whoever was reading reads on


@pytest.mark.parametrize("stop", [ValueError, KeyboardInterrupt])
def test_failed_output_leaves_the_old_one(tmp_path: Path, stop: type[BaseException]) -> None:
    (tmp_path / "a.txt").write_text("old")

    def stop_halfway() -> None:
        with replace_on_success(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise stop

    with pytest.raises(stop):
        stop_halfway()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_output_folder_is_checked_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no folder") as caught, replace_on_success(tmp_path / "no" / "a.npy"):
        pytest.fail("the block must not run")
    assert "mkdir" in caught.value.hint
    with pytest.raises(OutputError, match="it is a folder"), replace_on_success(tmp_path):
        pytest.fail("the block must not run")


@pytest.mark.parametrize("name", ["x" * 300 + ".npy", "file/a.npy", "a\0.npy"])
def test_names_that_no_output_can_have(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    for claim in (replace_on_success, folder_on_success):
        with pytest.raises(OutputError, match=r"cannot write|cannot make|there is no folder"), claim(tmp_path / name):
            pytest.fail("the block must not run")


def test_folder_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, **_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(self))

    monkeypatch.setattr(Path, "touch", refuse)  # root may write anywhere
    with pytest.raises(OutputError, match="Permission denied"), replace_on_success(tmp_path / "a.npy"):
        pytest.fail("the block must not run")


def test_full_disk_is_an_output_error_but_a_missing_input_is_not(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No space left"), replace_on_success(tmp_path / "a.npy") as temporary:
        raise OSError(errno.ENOSPC, "No space left on device", str(temporary))
    with pytest.raises(FileNotFoundError), replace_on_success(tmp_path / "a.npy"):
        (tmp_path / "other").read_bytes()


@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files")
def test_a_disk_that_is_full_for_a_library_of_rust(tmp_path: Path) -> None:
    """It has an error of its own, which is no OSError."""
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.raises(OutputError, match="File too large") as caught, replace_on_success(tmp_path / "a") as temporary:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
        try:
            save_file({"a": np.zeros(100_000)}, temporary)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.hint == "is the disk full?"


def test_a_full_disk_is_told_by_the_name_of_the_folder_that_is_made(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match=f"^cannot write {tmp_path / 'made' / 'a.ply'}: No space left on device$"),
        folder_on_success(tmp_path / "made") as folder,
        replace_on_success(folder / "a.ply"),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_told_by_the_name_of_the_output_however_often_it_is_guarded(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match=f"^cannot write {tmp_path / 'a'}: File too large$"),
        replace_on_success(tmp_path / "a") as outer,
        replace_on_success(outer),
    ):
        raise OSError(errno.EFBIG, "File too large")
    assert list(tmp_path.iterdir()) == []
    assert list(tmp_path.iterdir()) == []


def test_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("MKL_NUM_THREADS", "7")
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    monkeypatch.setenv("NUMEXPR_NUM_THREADS", "7")
    told = []
    torch = type("torch", (), {"set_num_threads": staticmethod(told.append)})
    monkeypatch.setitem(sys.modules, "torch", torch)
    set_threads(3)
    assert (os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"], told) == ("3", "3", [3])
    with pytest.raises(ValueError, match="at least one"):
        set_threads(0)


def test_public_names() -> None:
    from meshmatch.shapes.files import load_shape

    assert meshmatch.load_shape is load_shape
    assert {"Shape", "match", "register", "VertexMap", "__version__"} <= set(dir(meshmatch))
    with pytest.raises(AttributeError, match="no attribute 'lod_shape'"):
        _ = meshmatch.lod_shape


@pytest.mark.parametrize(
    ("statement", "heavy"),
    [
        ("import meshmatch.errors, meshmatch.outputs, meshmatch.threads", {"numpy"}),
        ("import meshmatch; meshmatch.load_shape('a.xyz')", set()),
    ],
    ids=["the ground", "a shape"],
)
def test_nothing_heavy_is_loaded_by(statement: str, heavy: set[str], tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    code = f"import sys\n{statement}\nprint(*sys.modules)"
    path = {"PYTHONPATH": str(Path(meshmatch.__file__).parents[1])}
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path, env=os.environ | path
    )
    assert set(out.stdout.split()) & ({"scipy", "torch", "trimesh", "pymeshlab"} | heavy) == set()


def test_a_folder_appears_whole(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("new", "empty"):
        with folder_on_success(tmp_path / name) as temporary:
            assert temporary.parent == tmp_path
            (temporary / "a.txt").write_text("a")
            assert not (tmp_path / name / "a.txt").exists()
        assert (tmp_path / name / "a.txt").read_text() == "a"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "new"]


@pytest.mark.parametrize("stop", [ValueError, KeyboardInterrupt])
def test_a_failed_folder_leaves_nothing(tmp_path: Path, stop: type[BaseException]) -> None:
    with pytest.raises(stop), folder_on_success(tmp_path / "new") as temporary:
        (temporary / "a.txt").write_text("a")
        raise stop
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    wrong = {"full": "is not empty", "file": "it is a file", "no/where": "there is no folder"}
    for name, words in wrong.items():
        with pytest.raises(OutputError, match=words), folder_on_success(tmp_path / name):
            pytest.fail("the block must not run")
    with pytest.raises(OutputError, match="is not empty"), folder_on_success(tmp_path / "late"):
        (tmp_path / "late").mkdir()
        (tmp_path / "late" / "theirs.txt").write_text("came in between")
    assert (tmp_path / "full" / "mine.txt").read_text() == "mine"
    assert (tmp_path / "late" / "theirs.txt").read_text() == "came in between"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "full", "late"]


# Holds the lock of a file, as does a process that it forked, and waits.
HOLDING = """
import os, sys, time
from pathlib import Path
from meshmatch.locks import locked
with locked(Path(sys.argv[1]), "busy", ""):
    child = os.fork()
    if child:
        print(child, flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_lock_ends_with_its_owner(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with subprocess.Popen([sys.executable, "-c", HOLDING, path], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        try:
            with pytest.raises(OutputError, match="busy"), locked(path, "busy", "", wait=0.1):
                pytest.fail("two hold one lock")
            process.kill()
            process.wait()
            with locked(path, "busy", "", wait=5.0):
                os.kill(child, 0)  # the forked one is still there
        finally:
            os.kill(child, signal.SIGKILL)
    with pytest.raises(OutputError, match="cannot write"), locked(path / "lock", "busy", ""):
        pytest.fail("there is no such folder")


def counts() -> dict[str, int]:
    """Threads of every BLAS that is loaded, and of torch."""
    import torch
    from threadpoolctl import threadpool_info

    found = {each["filepath"]: each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}
    return found | {"torch": torch.get_num_threads()}


@pytest.fixture
def three_threads() -> Iterator[dict[str, int]]:
    import torch
    from threadpoolctl import threadpool_limits

    before = torch.get_num_threads()
    with threadpool_limits(3, user_api="blas"):
        torch.set_num_threads(3)
        yield counts()
    torch.set_num_threads(before)


def test_a_limit_of_threads_is_given_back(three_threads: dict[str, int]) -> None:
    assert set(three_threads.values()) == {3}
    with thread_limit(1):
        assert set(counts().values()) == {1}
        with thread_limit(2):
            assert set(counts().values()) == {2}
        assert set(counts().values()) == {1}
    assert counts() == three_threads
    with pytest.raises(KeyError), thread_limit(1):
        raise KeyError
    assert counts() == three_threads
    with pytest.raises(ValueError, match="at least one"), thread_limit(0):
        pass


def test_limits_of_threads_may_overlap(three_threads: dict[str, int]) -> None:
    """The first block ends while another one runs elsewhere: afterwards all is as it was."""
    entered, leave = threading.Event(), threading.Event()

    def second() -> None:
        with thread_limit(2):
            entered.set()
            assert leave.wait(10)

    other = threading.Thread(target=second)
    with thread_limit(1):
        other.start()
        assert entered.wait(10)
    assert counts()["torch"] == 3
    leave.set()
    other.join()
    assert counts() == three_threads


def test_work_is_shared_by_threads_that_are_free() -> None:
    """Two calls wait for each other on two threads; results come in order; errors are handed on, and threads back."""
    meeting = threading.Barrier(2, timeout=10)
    threads = threading.Semaphore(2)
    with worker_slot(threads):
        assert sorted(set(parallel_map(lambda n: (meeting.wait(), n)[1], range(4)))) == [0, 1, 2, 3]
        assert parallel_map(lambda n, m: n * m, range(5), range(5)) == [0, 1, 4, 9, 16]
        with pytest.raises(ZeroDivisionError):
            parallel_map(lambda n: 1 // n, range(3))
        with threads:  # another has the second thread
            assert set(parallel_map(lambda _: threading.get_ident(), range(3))) == {threading.get_ident()}
    assert set(parallel_map(lambda _: threading.get_ident(), range(3))) == {threading.get_ident()}
    assert all(threads.acquire(blocking=False) for _ in range(2))


def test_an_error_ends_the_work_and_tells_those_who_are_at_it() -> None:
    stop, begun = threading.Event(), []

    def work(number: int) -> int:
        begun.append(number)
        if number == 1:
            raise KeyError(number)
        assert stop.wait(10)
        raise CancelledError

    with pytest.raises(KeyError):
        parallel_map(work, range(6), threads=2, stop=stop)
    assert sorted(begun) == [0, 1]
    assert parallel_map(abs, [-2, -1], threads=8) == [2, 1] and parallel_map(abs, [], threads=8) == []
