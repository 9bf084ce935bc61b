"""The registry: models by name, added whole, and not trusted."""

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from meshmatch.errors import ModelError, OutputError
from meshmatch.models import registry, transactions
from meshmatch.models.card import card_to_json, write_card
from meshmatch.models.registry import (
    add_model,
    find_model,
    list_models,
    locate_model,
    remove_model,
    user_folder,
    verify_model,
)

from .small_model import NETWORK, small_card, write_model


@pytest.fixture(autouse=True)
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One built-in model, `human`, and an empty registry of the user's own."""
    monkeypatch.setenv("MESHMATCH_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(registry, "built_in_folder", lambda: tmp_path / "built-in")
    write_model(tmp_path / "built-in" / "human", name="human")


@pytest.fixture()
def blob(tmp_path: Path) -> Path:
    write_model(tmp_path / "somewhere" / "blob")
    return tmp_path / "somewhere" / "blob"


def names() -> list[str]:
    return [entry.name for entry in list_models()]


def test_added_models_are_found_and_removed_ones_are_not(blob: Path) -> None:
    entry = add_model(blob)
    assert (entry.name, entry.built_in, entry.folder) == ("blob", False, user_folder() / "blob")
    assert names() == ["human", "blob"]
    assert find_model("blob")[0] == user_folder() / "blob"
    assert sorted(os.listdir(entry.folder)) == ["card.json", "template.safetensors", "weights.safetensors"]
    assert verify_model("blob") == verify_model(blob)
    remove_model("blob")
    assert names() == ["human"]
    assert list(user_folder().iterdir()) == []


def test_environment_moves_the_user_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert user_folder() == tmp_path / "home" / "models"
    monkeypatch.delenv("MESHMATCH_HOME")
    assert user_folder().parts[-2:] == ("meshmatch", "models")
    assert tmp_path not in user_folder().parents


def test_a_model_is_found_by_name_or_by_folder(blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert locate_model("human") == tmp_path / "built-in" / "human"
    assert locate_model(str(blob)) == blob
    assert locate_model(blob) == blob
    monkeypatch.chdir(blob.parent)
    assert find_model("blob")[1].name == "blob"  # no such name, but such a folder here
    write_model(blob.parent / "human", name="mine")
    assert find_model("human")[1].name == "human"  # the name wins
    assert find_model("./human")[1].name == "mine"
    assert find_model(Path("human"))[1].name == "mine"
    (blob.parent / "zebra").mkdir()
    with pytest.raises(ModelError, match="no model 'zebra', and the folder of this name has no card"):
        find_model("zebra")


@pytest.mark.parametrize("wrong", ["humna", "Human", "human "])
def test_a_mistyped_name_is_told_its_neighbours(wrong: str) -> None:
    with pytest.raises(ModelError, match=f"there is no model '{wrong}'") as caught:
        find_model(wrong)
    assert "did you mean human?" in caught.value.hint
    with pytest.raises(ModelError, match="there is no model 'zebra'") as caught:
        find_model("zebra")
    assert "there are: human" in caught.value.hint


@pytest.mark.parametrize("name", ["../somewhere/blob", "..", ".", "a/../../b", "/etc", "\\..\\x", "~root", ""])
def test_names_cannot_leave_the_registry(name: str, blob: Path) -> None:
    with pytest.raises(ModelError):
        remove_model(name)
    assert (blob / "card.json").is_file()


def test_a_card_cannot_name_a_place_outside(blob: Path, tmp_path: Path) -> None:
    text = (blob / "card.json").read_text().replace('"name": "blob"', '"name": "../../evil"')
    (blob / "card.json").write_text(text)
    with pytest.raises(ModelError, match="cannot be the name of a model"):
        add_model(blob)
    assert not (tmp_path / "home").exists() or list(user_folder().iterdir()) == []
    assert not (tmp_path / "evil").exists()


def test_built_in_models_stay(blob: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="included model and cannot be removed"):
        remove_model("human")
    write_model(blob, name="human")
    with pytest.raises(ModelError, match="an included model is called human"):
        add_model(blob, replace=True)
    assert verify_model("human").name == "human"


@pytest.mark.parametrize("name", ["auto", "none"])
def test_no_model_is_called_as_a_choice_is(tmp_path: Path, name: str) -> None:
    write_model(tmp_path / name, name=name)
    with pytest.raises(ModelError, match=f"no model can be called {name}"):
        add_model(tmp_path / name)


def test_a_taken_name_needs_replace(blob: Path) -> None:
    add_model(blob)
    write_model(blob, seed=7)
    with pytest.raises(ModelError, match="there is a model called blob already"):
        add_model(blob)
    assert verify_model("blob").seed == 1
    add_model(blob, replace=True)
    assert verify_model("blob").seed == 7
    assert len(list(user_folder().iterdir())) == 1


def test_wrong_weights_are_refused_and_not_added(blob: Path) -> None:
    add_model(blob)
    for folder in (blob, user_folder() / "blob"):
        data = bytearray((folder / "weights.safetensors").read_bytes())
        data[-1] ^= 1
        (folder / "weights.safetensors").write_bytes(data)
    for act in (verify_model, find_model):
        with pytest.raises(ModelError, match="are not those of its card"):
            act("blob")
    remove_model("blob")
    with pytest.raises(ModelError, match="are not those of its card"):
        add_model(blob)
    assert list(user_folder().iterdir()) == []  # no half-added copy either


def test_what_is_wrong_with_a_copy_is_said_of_its_source(blob: Path) -> None:
    """The copy is gone when the words are read."""
    data = bytearray((blob / "template.safetensors").read_bytes())
    (blob / "template.safetensors").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ModelError, match=r"^model blob: template"):
        add_model(blob)
    write_model(blob)
    write_card(small_card(**_true(blob) | {"network": NETWORK.to_dict() | {"width": 48}}), blob / "card.json")
    with pytest.raises(ModelError, match=re.escape(f"{blob / 'weights.safetensors'} does not fit")):
        add_model(blob)


def test_another_template_is_refused(blob: Path) -> None:
    write_card(small_card(**_true(blob) | {"template_hash": "0" * 16}), blob / "card.json")
    with pytest.raises(ModelError, match="trained with another template"):
        verify_model(blob)
    write_card(
        small_card(**_true(blob) | {"field": {"kernel": "smooth", "radius": 0.5, "nodes": 7}}), blob / "card.json"
    )
    with pytest.raises(ModelError, match="trained with another template"):
        verify_model(blob)


def test_a_changed_template_is_refused(blob: Path) -> None:
    path = blob / "template.safetensors"
    data = bytearray(path.read_bytes())
    data[8 + int.from_bytes(data[:8], "little")] ^= 1  # in the first tensor: the nodes
    path.write_bytes(data)
    with pytest.raises(ModelError, match="model blob"):
        verify_model(blob)


@pytest.mark.parametrize("file", ["weights.safetensors", "template.safetensors"])
def test_a_header_of_10_gb_is_refused_by_every_door(file: str, blob: Path) -> None:
    data = (blob / file).read_bytes()
    (blob / file).write_bytes((10_000_000_000).to_bytes(8, "little") + data[8:])
    for act in (verify_model, find_model, add_model):
        with pytest.raises(ModelError, match=r"is damaged.*header"):
            act(blob)


@pytest.mark.parametrize("file", ["card.json", "weights.safetensors", "template.safetensors"])
def test_a_missing_file_is_told(file: str, blob: Path) -> None:
    (blob / file).unlink()
    for act in (verify_model, find_model, add_model):
        with pytest.raises(ModelError, match=file.replace(".", r"\.")):
            act(blob)


def test_extra_keys_in_a_card_are_refused(blob: Path) -> None:
    words = json.loads((blob / "card.json").read_text()) | {"run": "rm"}
    (blob / "card.json").write_text(json.dumps(words))
    with pytest.raises(ModelError, match="unknown entries: 'run'"):
        add_model(blob)


@pytest.mark.parametrize("damage", ["cut", "gone", "no header", "long", "pipe"])
def test_weights_that_were_cut_short_are_listed_as_damaged(damage: str) -> None:
    copy = user_folder() / "mine"
    shutil.copytree(locate_model("human"), copy)
    weights = copy / "weights.safetensors"
    content = weights.read_bytes()
    weights.unlink()
    if damage == "pipe":
        os.mkfifo(weights)
    elif damage != "gone":
        weights.write_bytes({"cut": content[:-9], "no header": b"\xff" * 64, "long": content + b"more"}[damage])
    entry = {entry.name: entry for entry in list_models()}["mine"]
    assert entry.card is None
    assert entry.problem == "weights.safetensors is missing or damaged"


def test_a_folder_without_a_card_is_listed_as_damaged_and_can_be_removed(tmp_path: Path) -> None:
    (user_folder() / "half").mkdir(parents=True)
    (user_folder() / ".blob.12345678").mkdir()  # a copy in the making
    (user_folder() / "file").touch()
    entry = {entry.name: entry for entry in list_models()}
    assert entry.keys() == {"human", "half"}
    assert entry["half"].card is None
    assert "no model" in entry["half"].problem
    assert entry["human"].card is not None
    assert entry["human"].problem == ""
    remove_model("half")
    assert names() == ["human"]


def test_a_renamed_folder_does_not_verify(blob: Path) -> None:
    os.rename(add_model(blob).folder, user_folder() / "other")
    with pytest.raises(ModelError, match="the folder other holds a model called blob"):
        verify_model("other")


def test_removing_a_link_keeps_what_it_points_to(blob: Path) -> None:
    user_folder().mkdir(parents=True)
    (user_folder() / "blob").symlink_to(blob, target_is_directory=True)
    remove_model("blob")
    assert names() == ["human"]
    assert verify_model(blob).name == "blob"


def test_only_the_three_files_are_copied(blob: Path) -> None:
    (blob / "checkpoint").mkdir()
    (blob / "checkpoint" / "last.safetensors").write_bytes(b"x")
    assert len(os.listdir(add_model(blob).folder)) == 3


def test_a_registry_that_cannot_be_written_is_told(blob: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("MESHMATCH_HOME", str(tmp_path / "file"))
    with pytest.raises(OutputError, match="cannot write") as caught:
        add_model(blob)
    assert "MESHMATCH_HOME" in caught.value.hint


def test_a_user_without_a_home_has_the_models_that_ship(blob: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a container runs for a user that it does not know."""
    for name in ("HOME", "MESHMATCH_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # the user has no entry either
    assert names() == ["human"]
    assert verify_model("human").name == "human"
    with pytest.raises(OutputError, match="cannot write") as caught:
        add_model(blob)
    assert "MESHMATCH_HOME" in caught.value.hint


def test_a_model_that_changes_while_it_is_copied_is_refused(blob: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = registry.shutil.copyfile

    def swap(source: Path, target: Path) -> None:
        copy(source, target)
        if source.name == "card.json":
            card = registry.read_card(source)
            target.write_text(card_to_json(card).replace('"seed": 1,', '"seed": 99,'))

    monkeypatch.setattr(registry.shutil, "copyfile", swap)
    with pytest.raises(ModelError, match="changed while it was copied"):
        add_model(blob)
    assert names() == ["human"]


def test_an_interrupted_add_leaves_nothing(blob: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(name: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(registry, "verify_model", interrupted)
    with pytest.raises(KeyboardInterrupt):
        add_model(blob)
    assert list(user_folder().iterdir()) == []


def test_a_killed_replacement_gives_the_old_model_back(blob: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add_model(blob)
    write_model(blob, seed=7)
    rename = os.rename

    def killed(source: Path, target: Path) -> None:
        rename(source, target)
        if str(target).endswith(".replaced"):
            monkeypatch.setattr(transactions, "_restore", lambda folder: None)  # no time left
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(transactions.os, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            add_model(blob, replace=True)
    assert names() == ["human"]
    monkeypatch.undo()
    monkeypatch.setenv("MESHMATCH_HOME", str(blob.parents[1] / "home"))
    assert verify_model(blob).seed == 7
    assert registry.user_folder() / "blob" == locate_model("blob")
    assert verify_model("blob").seed == 1
    assert os.listdir(user_folder()) == ["blob"]


@pytest.mark.parametrize("replace", [False, True])
def test_of_two_that_add_one_name_the_later_waits(blob: Path, monkeypatch: pytest.MonkeyPatch, replace: bool) -> None:
    """Locks are of open files: a thread meets them as another process does."""
    copy, told, threads = registry.shutil.copyfile, [], []

    def other() -> None:
        try:
            told.append(add_model(blob, replace=replace).name)
        except ModelError as error:
            told.append(error.message)

    def other_in_between(source: Path, target: Path) -> None:
        copy(source, target)
        if not threads:
            threads.append(threading.Thread(target=other))
            threads[0].start()
            threads[0].join(0.2)  # it would be done if nothing held it

    monkeypatch.setattr(registry.shutil, "copyfile", other_in_between)
    add_model(blob, replace=replace)
    threads[0].join()
    assert told == ["blob" if replace else "there is a model called blob already"]
    assert os.listdir(user_folder()) == ["blob"]
    assert verify_model("blob").name == "blob"


def test_what_killed_ones_left_is_swept_up(blob: Path) -> None:
    for left in (".blob.0123abcd", ".other.89abcdef"):
        write_model(user_folder() / left)
    add_model(blob)
    assert os.listdir(user_folder()) == ["blob"]


@pytest.mark.parametrize("file", ["card.json", "weights.safetensors", "template.safetensors"])
def test_a_pipe_is_not_waited_for(file: str, blob: Path) -> None:
    (blob / file).unlink()
    os.mkfifo(blob / file)
    for act in (verify_model, find_model, add_model):
        with pytest.raises(ModelError):
            act(blob)


def test_a_card_cannot_ask_for_gigabytes(blob: Path) -> None:
    largest = {"width": 8192, "depth": 64, "corrections": 64, "correct_width": 8192}
    write_card(small_card(**_true(blob), network=NETWORK.to_dict() | largest), blob / "card.json")
    for act in (verify_model, add_model):
        with pytest.raises(ModelError, match="does not fit its model card"):
            act(blob)


@pytest.mark.parametrize("name", ["x" * 5000, "x" * 300 + "/y", "~nouser/x", Path("x" * 5000)])
def test_names_that_no_file_can_have_are_told(name: str | Path) -> None:
    for act in (locate_model, add_model):
        with pytest.raises(ModelError):
            act(name)


def test_listing_loads_nothing_heavy(tmp_path: Path) -> None:
    """In a fresh interpreter: listing and finding a folder need neither a network nor NumPy."""
    code = (
        "import sys; from meshmatch.models import card, registry; "
        "assert 'human' in [e.name for e in registry.list_models()]; registry.locate_model('human'); "
        "print(sorted({'torch', 'scipy', 'trimesh', 'pymeshlab', 'numpy', 'safetensors'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def _true(folder: Path) -> dict[str, object]:
    card = registry.read_card(folder / "card.json")
    return {"template_hash": card.template_hash, "weights_sha256": card.weights_sha256}
