"""Models by name: those that ship with the package, and the user's own.

A model is a folder with ``card.json`` (written last), ``weights.safetensors`` and ``template.safetensors``, and maybe
``pairs.safetensors`` (`meshmatch.models.pair_statistics`); an implicit model one with ``implicit.json`` (written last) and
``weights.safetensors``.
Listing models loads neither NumPy nor torch.
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
from meshmatch.models.unfinished import changing, copy_for, needs_settling, put, settle
from meshmatch.outputs import as_path, home_folder

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

CARD, WEIGHTS, TEMPLATE = "card.json", "weights.safetensors", "template.safetensors"
PAIRS = "pairs.safetensors"
HOME_VARIABLE = "MESHMATCH_HOME"
AUTO = "auto"
"""In place of a model's name: the shapes decide which of the installed models fits them."""
NO_MODEL = "none"
"""In place of a model's name: shapes are registered without one."""
_ELSEWHERE = f"try again, or set {HOME_VARIABLE} to a folder of yours"
_loading = threading.Lock()


@dataclass(frozen=True)
class Entry:
    """One model of the registry. A built-in one came with the package and cannot be removed."""

    name: str
    folder: Path
    built_in: bool
    card: ModelCard | ImplicitCard | None  # None if it cannot be read
    problem: str = ""  # then why


def built_in_folder() -> Path:
    """Where the models of the package are."""
    from meshmatch.templates.location import bundled_folder

    return bundled_folder() / "models"


def user_folder() -> Path:
    """Where the user's own models are; may not exist yet. The variable MESHMATCH_HOME moves it."""
    home = os.environ.get(HOME_VARIABLE)
    if home:
        return _expanded(home) / "models"
    return home_folder("data") / "models"


def list_models() -> tuple[Entry, ...]:
    """All models, built-in ones first, by name; damaged ones too, with their problem."""
    if needs_settling(user_folder()):
        settle(user_folder())
    found: dict[str, Entry] = {}
    for parent, built_in in ((built_in_folder(), True), (user_folder(), False)):
        for folder in sorted(parent.glob("[!.]*/")):  # a hidden folder is a copy in the making
            if folder.name not in found:
                found[folder.name] = _entry(folder, built_in)
    return tuple(found.values())


def locate_model(name: str | Path) -> Path:
    """The folder of a model, given by its name or by its folder; `ModelError` if it is neither.

    A name wins over a folder of the same name here; write ``./name`` for the folder.
    """
    text, folder = str(name), _expanded(name)
    if isinstance(name, Path) or os.sep in text or "/" in text or text in (".", ".."):
        if not os.path.isdir(folder):
            hint = "give the name of a model, or a folder with a card.json"
            raise ModelError(f"there is no model folder {text[:200]}", hint)
        return folder
    try:
        return _registered(text)
    except ModelError:
        if os.path.isdir(folder) and ((folder / CARD).is_file() or is_implicit(folder)):
            return folder
        raise


def check_model(name: str | Path) -> None:
    """`ModelError` if a model is neither ``auto`` or ``none`` nor the name or the folder of one."""
    if name not in (AUTO, NO_MODEL):
        locate_model(name)


def implicit_folder(name: str | Path) -> Path | None:
    """The folder of an implicit model, given by its name or its folder; None if it is anything else."""
    try:
        folder = None if name in (AUTO, NO_MODEL) else locate_model(name)
    except ModelError:
        return None
    return folder if folder is not None and is_implicit(folder) else None


def read_any_card(folder: Path) -> ModelCard | ImplicitCard:
    """The card of a model of either kind; `ModelError` as `read_card` has it."""
    return read_implicit_card(folder) if is_implicit(folder) else read_card(folder / CARD)


def find_model(name: str | Path) -> tuple[Path, ModelCard]:
    """Folder and card of a model that is safe to load: headers are bounded, the weights have the card's hash.

    `ModelError` if there is no such model, or it is damaged.
    """
    folder = locate_model(name)
    if is_implicit(folder):
        hint = "it goes with `match`, `register` and `interpolate`, or in Python with `load_implicit`"
        raise ModelError(f"{folder.name} is an implicit model, which has no template of vertices", hint)
    card = read_card(folder / CARD)
    for part in (TEMPLATE, WEIGHTS):
        read_header(folder / part)
    check_weights(folder, card)
    return folder, card


def check_weights(folder: Path, card: ModelCard | ImplicitCard) -> None:
    """`ModelError` if a model's weights are not those of its card."""
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
        The class of its encoder, if the model was trained with one of somebody's own: no code is run that a file names.

    Returns
    -------
    TrainedModel
        For `match`, `register`, `Matcher` and `interpolate`.

    Raises
    ------
    ModelError
        Unknown name, damaged files, an unknown kernel, weights that are not those of the card's network, a template
        that is not the one the model was trained with, or another encoder than the card's.
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
    known_as = folder.name if _is_registered(folder) else os.path.abspath(folder)
    again = partial(_unpickled, known_as, card, encoder)
    return trained_model(card, folder / TEMPLATE, folder / WEIGHTS, again, encoder, folder / PAIRS)


def load_once(name: str | Path, encoder: type | None = None) -> TrainedModel:
    """As `load_model`, but once in each process, and again if the model's files have changed since."""
    folder = locate_model(name)
    try:
        changed = max(os.stat(folder / name).st_mtime_ns for name in (WEIGHTS, CARD))
    except OSError:
        changed = 0  # the reader says what is missing
    with _loading:
        return _loaded(folder.resolve(), changed, encoder)


@lru_cache(maxsize=8)
def _loaded(folder: Path, changed: int, encoder: type | None) -> TrainedModel:
    return load_model(folder, encoder)


def _unpickled(name: str, card: ModelCard, encoder: type | None = None) -> TrainedModel:
    """What a pickled model becomes: the model of this name or folder, which must be the same."""
    hint = "add the same model here (`meshmatch models add`), or make the Matcher where it is used"
    try:
        model = load_once(name, encoder)
    except ModelError as error:
        raise ModelError(f"the pickled model {card.name} cannot be loaded here: {error.message}", hint) from error
    if model.card != card:
        raise ModelError(f"the model {name} is not the one that was pickled", hint)
    return model


def verify_model(name: str | Path) -> ModelCard | ImplicitCard:
    """The card of a model that was loaded to be sure that it can be; `ModelError` if anything about it is wrong.

    Of an implicit model its card and the checksum of its weights are looked at.
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
    """Copy a model folder into the registry, under the name on its card, in place of the user's own one with ``replace``.

    The copy is verified before it gets its name: what is registered is what was checked. `ModelError` if it is not a model,
    damaged, or its name is taken; `OutputError` if the registry's folder cannot be written.
    """
    source = _expanded(folder)
    if not os.path.isdir(source):
        raise ModelError(f"there is no folder {str(source)[:200]}", "a model is a folder with a card.json")
    card = read_any_card(source)
    if card.name in (AUTO, NO_MODEL):
        raise ModelError(f"no model can be called {card.name}", "change the name on its card")
    large: tuple[str, ...] = (WEIGHTS,) if isinstance(card, ImplicitCard) else (TEMPLATE, WEIGHTS)
    last = IMPLICIT if isinstance(card, ImplicitCard) else CARD
    if last == CARD and (source / PAIRS).is_file():
        large = (*large, PAIRS)
    for file in large:
        read_header(source / file)  # before a huge file is copied
    if (built_in_folder() / card.name).exists():
        raise ModelError(f"an included model is called {card.name}", "change the name on its card")
    target, temporary = user_folder() / card.name, copy_for(user_folder(), card.name)
    with changing(user_folder(), _ELSEWHERE):
        if target.exists() and not replace:
            hint = f"`meshmatch models remove {card.name}`, or --replace"
            raise ModelError(f"there is a model called {card.name} already", hint)
        try:
            temporary.mkdir()
            for file in (*large, last):
                shutil.copyfile(source / file, temporary / file)
            if verify_model(temporary) != card:
                raise ModelError(f"{source} changed while it was copied", "try again")
            put(temporary, target)
        except ModelError as error:  # of the copy, which is gone when it is read
            message = error.message.replace(str(temporary), str(source)).replace(temporary.name, card.name)
            raise ModelError(message, error.hint) from error
        except OSError as error:
            raise OutputError(f"cannot write {user_folder()}: {error.strerror}", _ELSEWHERE) from error
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return _entry(target, False)


def remove_model(name: str) -> None:
    """Remove one of the user's own models: `ModelError` if there is no such model, `OutputError` if it cannot be done."""
    folder = _registered(name)
    if folder.parent == built_in_folder():
        raise ModelError(f"{name} is an included model and cannot be removed", "only models that you added can be")
    with changing(user_folder(), _ELSEWHERE):
        try:
            if folder.is_symlink():
                folder.unlink()
                return
            grave = copy_for(user_folder(), name)
            os.rename(folder, grave)  # it loses its name at once, so that a half-removed model is never found
            shutil.rmtree(grave)
        except OSError as error:
            raise OutputError(f"cannot remove {folder}: {error.strerror}") from error


def _registered(name: str) -> Path:
    """The folder of a registered model; `ModelError` if there is none."""
    for again in (False, True):
        if again:
            settle(user_folder())
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
