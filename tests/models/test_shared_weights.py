"""Weights that processes share: the same numbers, never those of a damaged file, and never in the way."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import ModelError
from meshmatch.models import registry, shared_weights
from meshmatch.models.registry import add_model, load_model, remove_model
from tests.models.small_model import write_model

SHAPES = {"b.weight": (3, 5), "a.bias": (7,), "a.num_batches_tracked": ()}
SHARED_FILE = shared_weights.shared_file  # before tests put another in its place
Ask = Callable[..., dict[str, np.ndarray]]


def numbers() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    found = {name: rng.standard_normal(SHAPES[name]).astype(np.float32) for name in ("b.weight", "a.bias")}
    return found | {"a.num_batches_tracked": np.array(2**40 + 1)}


@pytest.fixture()
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "cache" / "weights" / "blob.float32"
    monkeypatch.setattr(shared_weights, "shared_file", lambda name: path.with_stem(name))
    return path


@pytest.fixture()
def ask(file: Path) -> Ask:
    """Ask for shared weights, and expect them to be expanded or not."""

    def asked(expanded: bool, sha256: str = "ab" * 32, shapes: dict = SHAPES) -> dict[str, np.ndarray]:
        calls: list[bool] = []
        found = shared_weights.shared_weights("blob", sha256, shapes, lambda: calls.append(True) or numbers())
        assert calls == [True] * expanded
        assert list(found) == list(shapes)
        for name, value in numbers().items():
            assert (found[name].dtype, found[name].shape) == (value.dtype, shapes[name])
            assert np.array_equal(found[name], value.reshape(shapes[name]))
        return found

    return asked


def is_mapped(array: np.ndarray) -> bool:
    base: object = array
    while isinstance(base, np.ndarray) and not isinstance(base, np.memmap):
        base = base.base
    return isinstance(base, np.memmap)


def test_weights_are_expanded_once_and_the_same(ask: Ask, file: Path) -> None:
    for expanded in (True, False, False):
        found = ask(expanded)
        assert all(is_mapped(array) and not array.flags.writeable for array in found.values())
        assert all(array.ctypes.data % 64 == 0 for array in found.values())
    assert [path.name for path in file.parent.iterdir()] == ["blob.float32"]


@pytest.mark.parametrize("place", [0, 60, 256, 300, -1])
def test_a_changed_byte_is_noticed(ask: Ask, file: Path, place: int) -> None:
    """Also at the padding's end: every byte of the file is checked."""
    ask(True)
    content = bytearray(file.read_bytes())
    content[place] ^= 1
    file.unlink()
    file.write_bytes(content)
    ask(True)  # and replaced
    ask(False)


@pytest.mark.parametrize(
    "change", [lambda raw: raw[:-64], lambda raw: raw + bytes(64), lambda raw: raw[:99], lambda raw: b""]
)
def test_a_file_of_another_length_is_replaced(ask: Ask, file: Path, change: Callable[[bytes], bytes]) -> None:
    ask(True)
    content = file.read_bytes()
    file.unlink()
    file.write_bytes(change(content))
    ask(True)
    assert file.read_bytes() == content


def test_other_weights_shapes_and_layouts_replace_the_file(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    ask(True)
    ask(True, sha256="cd" * 32)
    ask(False, sha256="cd" * 32)
    ask(True)
    ask(True, shapes=SHAPES | {"b.weight": (5, 3)})  # of the same size
    monkeypatch.setattr(shared_weights, "_LAYOUT", "meshmatch weights 2")
    ask(True, shapes=SHAPES | {"b.weight": (5, 3)})
    ask(False, shapes=SHAPES | {"b.weight": (5, 3)})


def test_weights_that_are_replaced_stay_with_those_who_use_them(ask: Ask) -> None:
    before = ask(True)
    ask(True, sha256="cd" * 32)
    assert all(np.array_equal(before[name], value) for name, value in numbers().items())


def test_where_the_folder_cannot_be_made_weights_are_private(ask: Ask, file: Path) -> None:
    file.parents[1].write_text("a file")
    for _ in range(2):
        assert not any(map(is_mapped, ask(True).values()))
    assert file.parents[1].read_text() == "a file"


def test_a_folder_in_the_place_of_the_file(ask: Ask, file: Path) -> None:
    file.mkdir(parents=True)
    assert not any(map(is_mapped, ask(True).values()))


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit of files")
def test_a_full_disk_leaves_nothing(ask: Ask, file: Path) -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, before[1]))
    try:
        found = ask(True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not any(map(is_mapped, found.values()))
    assert list(file.parent.iterdir()) == []


def test_without_a_home_nothing_appears_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    monkeypatch.setattr(shared_weights, "shared_file", SHARED_FILE)
    found = shared_weights.shared_weights("blob", "ab" * 32, SHAPES, numbers)
    assert not any(map(is_mapped, found.values()))
    assert list(tmp_path.iterdir()) == []


def test_the_file_is_in_the_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if sys.platform == "linux":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert SHARED_FILE("blob") == tmp_path / "meshmatch" / "weights" / "blob.float32"
    assert SHARED_FILE("blob").name == "blob.float32"


@pytest.fixture()
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MESHMATCH_HOME", str(tmp_path / "home"))
    return tmp_path


def weight_of(name: str | Path) -> np.ndarray:
    return load_model(name).inference.weights["nodes"]  # type: ignore[attr-defined]


def test_models_of_the_registry_are_shared_until_they_are_removed(home: Path, file: Path) -> None:
    write_model(home / "blob")
    assert not is_mapped(weight_of(home / "blob"))  # a folder of somebody's
    add_model(home / "blob")
    assert not file.exists()  # the copy that was verified has no name
    shared, private = weight_of("blob"), weight_of(home / "blob")
    assert is_mapped(shared) and not is_mapped(private) and np.array_equal(shared, private)
    remove_model("blob")
    assert not file.exists()


def test_weights_of_another_hash_are_refused_though_a_good_file_is_there(home: Path, file: Path) -> None:
    write_model(home / "blob")
    add_model(home / "blob")
    weight_of("blob")
    path = registry.user_folder() / "blob" / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    with pytest.raises(ModelError, match="not those of its card"):
        load_model("blob")
    assert file.exists()


def test_the_network_in_torch_may_change_its_copy(home: Path, file: Path) -> None:
    write_model(home / "blob")
    add_model(home / "blob")
    model = load_model("blob")
    model.network.nodes += 1
    assert (weight_of("blob") == 1).all()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_processes_share_pages(tmp_path: Path) -> None:
    """Two processes that read a million numbers: with the file in common each has half of it, privately all."""
    code = """
import sys, numpy as np
from pathlib import Path
from meshmatch.models import shared_weights
shared_weights.shared_file = lambda name: Path(sys.argv[1]) / name
found = shared_weights.shared_weights("big", "ab", {"a": (4_000_000,)}, lambda: {"a": np.ones(4_000_000, np.float32)})
assert found["a"].sum() == 4_000_000
print("read", flush=True); sys.stdin.readline()
lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
print(next(int(line.split()[1]) for line in lines if line.startswith("Pss:")), flush=True); sys.stdin.readline()
"""

    def proportional(folder: Path) -> int:
        command = [sys.executable, "-c", code, str(folder)]
        processes = []
        subprocess.run(command, input="\n\n", capture_output=True, text=True, check=True)  # writes the file
        for _ in range(2):
            processes.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
            assert processes[-1].stdout.readline() == "read\n"
        sizes = []
        for process in processes:
            process.stdin.write("\n")
            process.stdin.flush()
            sizes.append(int(process.stdout.readline()))
        for process in processes:
            process.communicate("\n")
        return max(sizes)

    (tmp_path / "file").write_text("no folder")
    private, shared = proportional(tmp_path / "file"), proportional(tmp_path / "folder")
    assert private - shared > 6_000  # of the 16,000 kB, a half is saved
