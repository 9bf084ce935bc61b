"""What all fits of a collection share: the model that knows its shapes, or a template that is made of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.api.inputs import as_model, check_config, usable, validated
from meshmatch.api.kinds import choose_model
from meshmatch.collections.setting import FIRST_TEMPLATE, TEMPLATE, Setting, Source
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.fitting.kind_templates import finest, mean_shape, template_of
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.models.registry import AUTO, NO_MODEL
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.input_files import read_json
from meshmatch.shapes.rims import is_sheet
from meshmatch.shapes.shape import Shape
from meshmatch.templates.prepared_folder import medoid
from meshmatch.templates.template import Template, load_template, save_template

SCHEMA = 1
ABOUT = "collection.json"
_READ_AHEAD = 20  # shapes that are asked for their kind before none is known
_COMPARED = 40  # shapes among which the first template is looked for
_AVERAGED = 200  # of which the mean is made


def settled(wish: Setting, sources: Sequence[Source]) -> Setting:
    """What all tasks share: a model that is named. What a folder of fits says of itself is written, or checked if it was
    there before.

    `OptionError` if it holds fits of another model, or made in another way; or as `choose_model`.
    """
    check_config(wish.config)
    store, about, model = wish.store, read_about(wish.store), wish.model
    if model == AUTO:
        model = _chosen(sources, wish) if about is None else str(about["model"])
    if model == NO_MODEL:
        template, file = _first_template(wish, sources, about is None), FIRST_TEMPLATE
    else:
        trained = as_model(model)
        template, file = trained.template, TEMPLATE
        model = model if model == trained.card.name else str(Path(model).resolve())
    setting = replace(wish, model=model, template_file=file, template_hash=template.hash)
    wanted = {"schema": SCHEMA} | setting.choices() | {"template": template.hash}
    if about is None:
        with store.writing(file) as path:
            save_template(template, path)
        save_text(store, ABOUT, json.dumps(wanted, indent=2) + "\n")  # last: a folder without it is no collection
    elif differs := [name for name in wanted if about[name] != wanted[name]]:
        other = f"the fits in {store.location} were made with another {_differing(differs[0], about, wanted)}"
        hint = "choose another folder, or the options of before"
        if isinstance(about["fit"], dict) and about["fit"].keys() != wanted["fit"].keys():
            other = f"the fits in {store.location} were made by another version of meshmatch, which fits otherwise"
            hint = "choose another folder, or go on with that version; maps and atlases can be made of them as they are"
        raise OptionError(other, hint)
    return setting


def _differing(name: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The first choice that differs, by its own name where choices lie within choices, and what it was before."""
    then, wanted = before[name], now[name]
    if isinstance(then, dict) and isinstance(wanted, dict):
        inner = next((key for key in wanted if then.get(key) != wanted[key]), None)
        if inner is not None and inner in then:
            return _differing(inner, then, wanted)
    return f"{name}: {then}, not {wanted}" if isinstance(then, str | int | float) else name


def _first_template(wish: Setting, sources: Sequence[Source], new: bool) -> Template:
    """Without a model, the shape that is nearest to some others, as a template; the one of before, if there is one."""
    if not new:
        with wish.store.reading(FIRST_TEMPLATE) as path:
            return load_template(path)
    some = np.unique(np.linspace(0, len(sources) - 1, min(len(sources), _COMPARED)).astype(int))
    found = []
    for number in some:
        with suppress(MeshmatchError):
            found.append(validated(sources[number].load(wish.only, wish.without)))
    if not found:
        raise InputError(f"none of {len(some)} shapes can be a template", "are they meshes?")
    sided = wish.config.mirror != "no" and not all(is_sheet(each.shape) for each in found)  # a leaf only turns over
    chosen = found[medoid(found, "rigid", "area", 0, either_side=sided)]
    return template_of(chosen.shape, chosen.shape.name, ViscousConfig())


def some_of(names: Sequence[str]) -> list[str]:
    """Of many shapes, those that the mean is made of, evenly chosen."""
    return [
        names[number] for number in np.unique(np.linspace(0, len(names) - 1, min(len(names), _AVERAGED)).astype(int))
    ]


def on_the_mean(setting: Setting, names: Sequence[str], folder: str, file: str, fine: bool = False) -> Setting:
    """The same with the mean of the shapes that its template was fitted to, by fits of a folder, as the template, perhaps
    with `finest` nodes; with the same one where there are none. A template that lies in the middle has less far to go.
    """
    before = mean = setting.template
    if names:
        fits = [setting.read(folder, name).fit for name in names]
        mean = template_of(Shape(mean_shape(before, fits), before.shape.faces), "mean", ViscousConfig())
        mean = finest(mean, ViscousConfig()) if fine else mean
    with setting.store.writing(file) as path:
        save_template(mean, path)
    return replace(setting, template_file=file, template_hash=mean.hash)


def _chosen(sources: Sequence[Source], wish: Setting) -> str:
    """The installed model that knows the kind of the first shape which can be read and is of a known kind."""
    trouble: MeshmatchError | None = None
    for source in sources[:_READ_AHEAD]:
        try:
            chosen = choose_model([usable(source.load(wish.only, wish.without))], [wish.config]).model
        except MeshmatchError as error:
            trouble = trouble or error
        else:
            return chosen.card.name
    assert trouble is not None
    raise trouble


def is_collection(folder: str | Path) -> bool:
    """Whether a folder holds fits."""
    return (Path(folder) / ABOUT).is_file()


def read_about(store: Store) -> dict[str, Any] | None:
    """What a folder says of its fits; None if it is no folder of fits."""
    if not store.exists(ABOUT):
        return None
    try:
        with store.reading(ABOUT) as path:
            about = read_json(path)
        if about["schema"] != SCHEMA:
            raise InputError(f"{ABOUT} has schema {about['schema']!r}, not {SCHEMA}", "update meshmatch")
        return {name: about[name] for name in ("schema", "template", "model", "only", "without", "sequence", "fit")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{store.location}/{ABOUT} is damaged", "remove the folder, and fit again") from error


def save_text(store: Store, name: str, text: str) -> None:
    """Write a file; it appears whole."""
    with store.writing(name) as path, replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
