"""The registry: models by name, those that ship with the package and the user's own.

A model is a folder with ``card.json`` (written last), ``weights.safetensors``, ``template.safetensors`` and optionally
``pairs.safetensors`` (`meshmatch.models.pair_statistics`). An implicit model is a folder with ``implicit.json`` (written
last) and ``weights.safetensors``. Listing models loads neither NumPy nor torch.
"""

from __future__ import annotations

import os
import shutil
import threading
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from meshmatch.errors import MeshmatchError, ModelError, OutputError
from meshmatch.models.card import (
    IMPLICIT,
    ImplicitCard,
    ModelCard,
    check_name,
    is_implicit,
    is_name,
    read_card,
    read_implicit_card,
)
from meshmatch.models.tensor_file import is_whole, read_header
from meshmatch.models.transactions import exclusive_changes, incomplete_path, needs_recovery, put_in_place, recover
from meshmatch.outputs import as_path, home_folder

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

CARD, WEIGHTS, TEMPLATE = "card.json", "weights.safetensors", "template.safetensors"
PAIRS = "pairs.safetensors"
HOME_VARIABLE = "MESHMATCH_HOME"
AUTO = "auto"
"""In place of a model's name: choose the installed model that fits the shapes."""
NO_MODEL = "none"
"""In place of a model's name: register shapes without a model."""
_FOLDER_HINT = f"try again, or set {HOME_VARIABLE} to a folder of yours"
_loading = threading.Lock()


@dataclass(frozen=True)
class Entry:
    """One model of the registry. Built-in models are part of the package and cannot be removed."""

    name: str
    folder: Path
    built_in: bool
    card: ModelCard | ImplicitCard | None  # None if the model is damaged
    problem: str = ""  # what is wrong with a damaged model


def built_in_folder() -> Path:
    """Folder of the models that are part of the package."""
    from meshmatch.templates.location import bundled_folder

    return bundled_folder() / "models"


def user_folder() -> Path:
    """Folder of the user's own models, which may not exist yet; the environment variable MESHMATCH_HOME changes it."""
    home = os.environ.get(HOME_VARIABLE)
    if home:
        return _expanded(home) / "models"
    return home_folder("data") / "models"


def list_models() -> tuple[Entry, ...]:
    """List all models, built-in ones first, sorted by name; damaged ones are included, with their problem."""
    if needs_recovery(user_folder()):
        recover(user_folder())
    found: dict[str, Entry] = {}
    for parent, built_in in ((built_in_folder(), True), (user_folder(), False)):
        for folder in sorted(parent.glob("[!.]*/")):  # hidden folders are incomplete copies
            if folder.name not in found:
                found[folder.name] = _entry(folder, built_in)
    return tuple(found.values())


def locate_model(name: str | Path) -> Path:
    """Find the folder of a model, given by name or folder; `ModelError` if there is no such model.

    A name takes precedence over a folder of that name in the working directory; write ``./name`` for the folder.
    """
    text, folder = str(name), _expanded(name)
    if isinstance(name, Path) or os.sep in text or "/" in text or text in (".", ".."):
        if not os.path.isdir(folder):
            hint = "give the name of a model, or a folder with a card.json"
            raise ModelError(f"there is no model folder {text[:200]}", hint)
        return folder
    try:
        return _registered(text)
    except ModelError as error:
        if not os.path.isdir(folder):
            raise
        if (folder / CARD).is_file() or is_implicit(folder):
            return folder
        what = f"{error.message}, and the folder of this name has no {CARD}"
        raise ModelError(what, "train a model into it first, or see `meshmatch models list`") from error


def check_model(name: str | Path) -> None:
    """Raise `ModelError` unless ``name`` is ``auto``, ``none``, or the name or folder of a model."""
    if name not in (AUTO, NO_MODEL):
        locate_model(name)


def implicit_folder(name: str | Path) -> Path | None:
    """Folder of an implicit model, given by name or folder; None for anything else."""
    try:
        folder = None if name in (AUTO, NO_MODEL) else locate_model(name)
    except ModelError:
        return None
    return folder if folder is not None and is_implicit(folder) else None


def read_any_card(folder: Path) -> ModelCard | ImplicitCard:
    """Read the card of a model, implicit or not; `ModelError` as `read_card`."""
    return read_implicit_card(folder) if is_implicit(folder) else read_card(folder / CARD)


def find_model(name: str | Path) -> tuple[Path, ModelCard]:
    """Find a model and check that it is safe to load: sizes are bounded, the weights have the hash on the card.

    Returns its folder and card. `ModelError` if there is no such model, it is implicit, or it is damaged.
    """
    folder = locate_model(name)
    if is_implicit(folder):
        hint = "use it with `match`, `register` and `interpolate`, or `load_implicit` in Python"
        raise ModelError(f"{folder.name} is an implicit model, which has no template of vertices", hint)
    card = read_card(folder / CARD)
    for part in (TEMPLATE, WEIGHTS):
        read_header(folder / part)
    check_weights(folder, card)
    return folder, card


def check_weights(folder: Path, card: ModelCard | ImplicitCard) -> None:
    """Raise `ModelError` if the hash of a model's weights is not that on its card."""
    import hashlib

    with (folder / WEIGHTS).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != card.weights_sha256:
        hashes = f"sha256 {digest[:12]}..., not {card.weights_sha256[:12]}..."
        problem = f"the weights of model {card.name} are not those of its card ({hashes})"
        raise ModelError(problem, "fetch or add the model again")


def load_model(name: str | Path = "human", encoder: type | None = None) -> TrainedModel:
    """Load a model.

    Parameters
    ----------
    name
        Registry name or folder.
    encoder
        The class of its encoder, if the model was trained with a custom one: code that a file names is never run.

    Returns
    -------
    TrainedModel
        For use with `match`, `register`, `Matcher` and `interpolate`.

    Raises
    ------
    ModelError
        The name or the kernel is unknown, files are damaged, the weights do not match the network on the card, or the
        template or the encoder is not the one that the model was trained with.
    TemplateError
        The template's file is damaged.

    Examples
    --------
    >>> model = meshmatch.load_model("human")
    >>> model.card.name
    >>> fit = meshmatch.register("templates/samples/climber.ply", model=model)
    """
    from meshmatch.models.trained import trained_model  # torch

    folder, card = find_model(name)
    reference = folder.name if _is_registered(folder) else os.path.abspath(folder)
    reload = partial(_unpickled, reference, card, encoder)
    return trained_model(card, folder / TEMPLATE, folder / WEIGHTS, reload, encoder, folder / PAIRS)


def load_once(name: str | Path, encoder: type | None = None) -> TrainedModel:
    """Load a model as `load_model`, cached per process until its files change."""
    folder = locate_model(name)
    try:
        changed = max(os.stat(folder / name).st_mtime_ns for name in (WEIGHTS, CARD))
    except OSError:
        changed = 0  # loading reports what is missing
    with _loading:
        return _loaded(folder.resolve(), changed, encoder)


@lru_cache(maxsize=8)
def _loaded(folder: Path, changed: int, encoder: type | None) -> TrainedModel:
    return load_model(folder, encoder)


def _unpickled(name: str, card: ModelCard, encoder: type | None = None) -> TrainedModel:
    """Load the model that a pickle refers to by name or folder; `ModelError` if its card is another."""
    hint = "add the same model here (`meshmatch models add`), or make the Matcher where it is used"
    try:
        model = load_once(name, encoder)
    except ModelError as error:
        raise ModelError(f"the pickled model {card.name} cannot be loaded here: {error.message}", hint) from error
    if model.card != card:
        raise ModelError(f"the model {name} is not the one that was pickled", hint)
    return model


def verify_model(name: str | Path) -> ModelCard | ImplicitCard:
    """Load a model to verify it, and return its card; `ModelError` if anything about it is wrong.

    For an implicit model only the card and the hash of the weights are checked.
    """
    folder = locate_model(name)
    card: ModelCard | ImplicitCard
    try:
        if is_implicit(folder):
            card = read_implicit_card(folder)
            read_header(folder / WEIGHTS)
            check_weights(folder, card)
        else:
            card = load_model(folder).card
    except ModelError:
        raise
    except MeshmatchError as error:
        raise ModelError(f"model {folder.name}: {error.message}", "fetch or add the model again") from error
    if _is_registered(folder) and folder.name != card.name:
        hint = "remove it, and add it again from its source"
        raise ModelError(f"the folder {folder.name} holds a model called {card.name}", hint)
    return card


def add_model(folder: str | Path, *, replace: bool = False) -> Entry:
    """Copy a model folder into the registry, under the name on its card; ``replace`` allows replacing the user's own models.

    The copy is verified before it is registered. `ModelError` if it is not a model, is damaged, or its name is taken;
    `OutputError` if the registry's folder cannot be written.
    """
    source = _expanded(folder)
    if not os.path.isdir(source):
        raise ModelError(f"there is no folder {str(source)[:200]}", "a model is a folder with a card.json")
    card = read_any_card(source)
    if card.name in (AUTO, NO_MODEL):
        raise ModelError(f"no model can be called {card.name}", "change the name on its card")
    files: tuple[str, ...] = (WEIGHTS,) if isinstance(card, ImplicitCard) else (TEMPLATE, WEIGHTS)
    last = IMPLICIT if isinstance(card, ImplicitCard) else CARD
    if last == CARD and (source / PAIRS).is_file():
        files = (*files, PAIRS)
    for file in files:
        read_header(source / file)  # check sizes before copying
    if (built_in_folder() / card.name).exists():
        raise ModelError(f"an included model is called {card.name}", "change the name on its card")
    target, temporary = user_folder() / card.name, incomplete_path(user_folder(), card.name)
    with exclusive_changes(user_folder(), _FOLDER_HINT):
        if target.exists() and not replace:
            hint = f"`meshmatch models remove {card.name}`, or --replace"
            raise ModelError(f"there is a model called {card.name} already", hint)
        try:
            temporary.mkdir()
            for file in (*files, last):
                shutil.copyfile(source / file, temporary / file)
            if verify_model(temporary) != card:
                raise ModelError(f"{source} changed while it was copied", "try again")
            put_in_place(temporary, target)
        except ModelError as error:  # the message names the copy, which is about to be deleted
            message = error.message.replace(str(temporary), str(source)).replace(temporary.name, card.name)
            raise ModelError(message, error.hint) from error
        except OSError as error:
            raise OutputError(f"cannot write {user_folder()}: {error.strerror}", _FOLDER_HINT) from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return _entry(target, False)


def remove_model(name: str) -> None:
    """Remove one of the user's own models.

    `ModelError` if there is no such model or it is built in, `OutputError` if it cannot be removed.
    """
    folder = _registered(name)
    if folder.parent == built_in_folder():
        raise ModelError(f"{name} is an included model and cannot be removed", "only models that you added can be")
    with exclusive_changes(user_folder(), _FOLDER_HINT):
        try:
            if folder.is_symlink():
                folder.unlink()
                return
            trash = incomplete_path(user_folder(), name)
            os.rename(folder, trash)  # atomic, so that a half-removed model is never found
            shutil.rmtree(trash)
        except OSError as error:
            raise OutputError(f"cannot remove {folder}: {error.strerror}") from error


def _registered(name: str) -> Path:
    """Find the folder of a registered model; `ModelError` if there is none."""
    for after_recovery in (False, True):
        if after_recovery:
            recover(user_folder())
        for parent in (built_in_folder(), user_folder()):
            if is_name(name) and (parent / name).is_dir():
                return parent / name
    names = [entry.name for entry in list_models()]
    near = get_close_matches(name[:80].lower(), names, n=3, cutoff=0.5)
    if not near:
        check_name(name)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(names) or 'none'}"
    raise ModelError(f"there is no model {name[:80]!r}", f"{hint} (see `meshmatch models list`)")


def _is_registered(folder: Path) -> bool:
    return folder.parent in (built_in_folder(), user_folder()) and not folder.name.startswith(".")


def _expanded(path: str | Path) -> Path:
    try:
        return as_path(path).expanduser()
    except RuntimeError as error:
        raise ModelError(f"cannot use {str(path)[:200]}: {error}", "write out the home folder") from error


def _entry(folder: Path, built_in: bool) -> Entry:
    try:
        card = read_any_card(folder)
    except ModelError as error:
        return Entry(folder.name, folder, built_in, None, error.message)
    files = (TEMPLATE, WEIGHTS) if isinstance(card, ModelCard) else (WEIGHTS,)
    if cut := [name for name in files if not is_whole(folder / name)]:
        return Entry(folder.name, folder, built_in, None, f"{cut[0]} is missing or damaged")
    return Entry(folder.name, folder, built_in, card)
