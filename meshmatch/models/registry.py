"""Models by name: those that ship with the package, and the user's own.

A model is a folder with ``card.json`` (written last), ``weights.safetensors`` and ``template.safetensors``.
Nothing here loads a network: listing models is cheap.
"""

import hashlib
import os
import secrets
import shutil
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from meshmatch.errors import MeshmatchError, ModelError, OutputError
from meshmatch.models.card import ModelCard, check_name, read_card
from meshmatch.models.tensor_file import check_tensor_file

CARD, WEIGHTS, TEMPLATE = "card.json", "weights.safetensors", "template.safetensors"
HOME_VARIABLE = "MESHMATCH_HOME"


@dataclass(frozen=True)
class Entry:
    """One model of the registry.

    Parameters
    ----------
    name : str
    folder : Path
    built_in : bool
        It came with the package and cannot be removed.
    card : ModelCard or None
        None if it cannot be read; then `problem` says why.
    problem : str
    """

    name: str
    folder: Path
    built_in: bool
    card: ModelCard | None
    problem: str = ""


def built_in_folder() -> Path:
    """Where the models of the package are."""
    from meshmatch.templates.location import bundled_folder

    return bundled_folder() / "models"


def user_folder() -> Path:
    """Where the user's own models are; may not exist yet. The variable MESHMATCH_HOME moves it."""
    home = os.environ.get(HOME_VARIABLE)
    if home:
        return Path(home).expanduser() / "models"
    from platformdirs import user_data_path

    return user_data_path("meshmatch", appauthor=False) / "models"


def list_models() -> tuple[Entry, ...]:
    """All models, built-in ones first, by name; damaged ones too, with their problem."""
    found: dict[str, Entry] = {}
    for parent, built_in in ((built_in_folder(), True), (user_folder(), False)):
        try:
            folders = sorted(folder for folder in parent.iterdir() if folder.is_dir())
        except OSError:
            continue
        for folder in folders:
            # a hidden folder is a copy in the making
            if not folder.name.startswith(".") and folder.name not in found:
                found[folder.name] = _entry(folder, built_in)
    return tuple(found.values())


def get_entry(name: str) -> Entry:
    """The registered model of this name.

    Raises
    ------
    ModelError
        There is none; the hint names those that are spelled alike.
    """
    check_name(name)
    for parent, built_in in ((built_in_folder(), True), (user_folder(), False)):
        if (parent / name).is_dir():
            return _entry(parent / name, built_in)
    names = [entry.name for entry in list_models()]
    near = get_close_matches(name, names, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(names) or 'none'}"
    raise ModelError(f"there is no model {name!r}", f"{hint} (see `meshmatch models list`)")


def locate_model(name: str | Path) -> Path:
    """The folder of a model, given by its name or by its folder. A name wins over a folder of the same name
    here; write ``./name`` for the folder.

    Raises
    ------
    ModelError
        Neither a registered name nor a model folder.
    """
    folder = Path(name).expanduser()
    text = str(name)
    if isinstance(name, Path) or os.sep in text or "/" in text or text in (".", ".."):
        if not folder.is_dir():
            raise ModelError(
                f"there is no model folder {folder}", "give the name of a model, or a folder with a card.json"
            )
        return folder
    try:
        return get_entry(text).folder
    except ModelError:
        if (folder / CARD).is_file():
            return folder
        raise


def find_model(name: str | Path) -> tuple[Path, ModelCard]:
    """Folder and card of a model that is safe to load: headers are bounded, the weights have the card's hash.

    Raises
    ------
    ModelError
        No such model, or it is damaged.
    """
    folder = locate_model(name)
    card = read_card(folder / CARD)
    check_tensor_file(folder / TEMPLATE)
    check_tensor_file(folder / WEIGHTS)
    with (folder / WEIGHTS).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != card.weights_sha256:
        raise ModelError(
            f"the weights of model {card.name} are not those of its card "
            f"(sha256 {digest[:12]}..., not {card.weights_sha256[:12]}...)",
            "fetch or add the model again",
        )
    return folder, card


def verify_model(name: str | Path) -> ModelCard:
    """`find_model`, and the template is the one of the card. Returns the card.

    Raises
    ------
    ModelError
        No such model, or anything about it is wrong.
    """
    folder, card = find_model(name)
    from meshmatch.templates.template import load_template

    try:
        template = load_template(folder / TEMPLATE)
    except MeshmatchError as error:
        raise ModelError(f"model {card.name}: {error.message}", "fetch or add the model again") from error
    if template.hash != card.template_hash or card.field["nodes"] != template.K:
        raise ModelError(
            f"model {card.name} was trained with another template "
            f"({card.template_hash}, {card.field['nodes']} nodes; here {template.hash}, {template.K} nodes)",
            "fetch or add the model again",
        )
    registered = folder.parent in (built_in_folder(), user_folder()) and not folder.name.startswith(".")
    if registered and folder.name != card.name:
        raise ModelError(
            f"the folder {folder.name} holds a model called {card.name}",
            "remove it, and add it again from its source",
        )
    return card


def add_model(folder: str | Path, *, replace: bool = False) -> Entry:
    """Copy a model folder into the registry, under the name on its card.

    The copy is verified before it gets its name: what is registered is what was checked.

    Parameters
    ----------
    replace
        Overwrite the user's own model of the same name.

    Raises
    ------
    ModelError
        It is no model, damaged, or its name is taken.
    OutputError
        The registry's folder cannot be written.
    """
    source = Path(folder).expanduser()
    if not source.is_dir():
        raise ModelError(f"there is no folder {source}", "a model is a folder with a card.json")
    card = read_card(source / CARD)
    for file in (TEMPLATE, WEIGHTS):
        check_tensor_file(source / file)  # before a huge file is copied
    if (built_in_folder() / card.name).exists():
        raise ModelError(f"a built-in model is called {card.name}", "change the name on its card")
    target = user_folder() / card.name
    if target.exists() and not replace:
        raise ModelError(
            f"there is a model called {card.name} already",
            f"`meshmatch models remove {card.name}`, or --replace",
        )
    temporary = user_folder() / f".{card.name}.{secrets.token_hex(4)}"
    try:
        temporary.mkdir(parents=True)
        for file in (TEMPLATE, WEIGHTS, CARD):
            shutil.copyfile(source / file, temporary / file)
        if verify_model(temporary) != card:
            raise ModelError(f"{source} changed while it was copied", "try again")
        if target.exists():
            _discard(target)
        os.rename(temporary, target)
    except OSError as error:
        raise OutputError(
            f"cannot write {user_folder()}: {error.strerror}", f"set {HOME_VARIABLE} to a folder of yours"
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return _entry(target, False)


def remove_model(name: str) -> None:
    """Remove one of the user's own models.

    Raises
    ------
    ModelError
        There is no such model, or it is built in.
    OutputError
        Its folder cannot be removed.
    """
    entry = get_entry(name)
    if entry.built_in:
        raise ModelError(f"{name} is a built-in model and cannot be removed")
    try:
        _discard(entry.folder)
    except OSError as error:
        raise OutputError(f"cannot remove {entry.folder}: {error.strerror}") from error


def _discard(folder: Path) -> None:
    """Remove a folder; it loses its name at once, so that a half-removed model is never found."""
    if folder.is_symlink():
        folder.unlink()
        return
    grave = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}")
    os.rename(folder, grave)
    shutil.rmtree(grave)


def _entry(folder: Path, built_in: bool) -> Entry:
    try:
        return Entry(folder.name, folder, built_in, read_card(folder / CARD))
    except ModelError as error:
        return Entry(folder.name, folder, built_in, None, error.message)
