"""``meshmatch models``: list and manage the trained models."""

import re
from json import loads
from pathlib import Path
from textwrap import shorten
from typing import Annotated

import typer

from meshmatch.cli import options
from meshmatch.cli.user_messages import Console, print_json, print_rows, print_text
from meshmatch.errors import ModelError
from meshmatch.models import registry
from meshmatch.models.card import card_to_json

models = typer.Typer(
    help="List, show, add, remove and verify trained models.", no_args_is_help=True, rich_markup_mode=None
)
Name = Annotated[str, typer.Argument(metavar="NAME", help="The model's name.")]


@models.command("list")
def list_all(json: options.Json = False) -> None:
    """List included models and your own."""
    entries = registry.list_models()
    if json:
        keys = ("category", "created", "licence", "data")
        record = [
            {"name": entry.name, "built_in": entry.built_in, "folder": str(entry.folder)}
            | {key: getattr(entry.card, key, None) for key in keys}
            | {"problem": entry.problem}
            for entry in entries
        ]
        print_json({"models": record})
        return
    rows = [("NAME", "CATEGORY", "CREATED", "FROM", "LICENCE", "LEARNED FROM")]
    for entry in entries:
        origin = "package" if entry.built_in else "own"
        card = entry.card
        if card is None:
            rows.append((entry.name, "", "", origin, "damaged", ""))
        else:
            rows.append((entry.name, card.category, card.created, origin, card.licence, _shorten(card.data)))
    print_rows(rows)
    for entry in entries:
        if entry.problem:
            Console().warn(f"model {entry.name}: {entry.problem}")


def _shorten(data: str) -> str:
    """Shorten the description of training data, without text in parentheses."""
    return shorten(re.sub(r" \([^)]*\)", "", data), 64, placeholder=" ...")


@models.command()
def show(name: Name, json: options.Json = False) -> None:
    """Show a model's card as JSON.

    The card lists template, data, licence, recipe, training time, errors and hashes. With --json it is on one line.
    """
    card = card_to_json(registry.read_any_card(registry.locate_model(name)))
    if json:
        print_json(loads(card))
    else:
        print_text(card)


@models.command()
def add(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="A model folder, such as `meshmatch train` writes.")],
    replace: Annotated[bool, typer.Option("--replace", help="Replace your own model of the same name.")] = False,
    json: options.Json = False,
) -> None:
    """Copy a model into your registry.

    The model is checked first. Its name in the registry is the one on its card.
    """
    entry = registry.add_model(folder, replace=replace)
    Console().say(f"added model {entry.name} to {entry.folder.parent}")
    if json:
        print_json({"added": entry.name, "folder": str(entry.folder)})


@models.command()
def remove(name: Name, json: options.Json = False) -> None:
    """Remove one of your own models."""
    registry.remove_model(name)
    Console().say(f"removed model {name}")
    if json:
        print_json({"removed": name})


@models.command()
def verify(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Models to check. Default: all.")
    ] = None,
    json: options.Json = False,
) -> None:
    """Check that models are complete and unchanged."""
    checked: list[dict[str, str | None]] = []
    for name in names or [entry.name for entry in registry.list_models()]:
        try:
            digest = registry.verify_model(name).weights_sha256
        except ModelError as error:
            checked.append({"name": name, "sha256": None, "problem": error.message})
            Console().problem(name, error.message, error.hint)
        else:
            checked.append({"name": name, "sha256": digest, "problem": ""})
            if not json:
                print_text(f"{name}: ok, sha256 {digest}\n")
    if json:
        print_json({"models": checked})
    wrong = sum(model["sha256"] is None for model in checked)
    if wrong:
        raise ModelError(f"{wrong} of {len(checked)} models could not be verified", "see the lines above")
