"""Settings that all fits of a collection share: the model and options, or a template built from the shapes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.api.inputs import as_model, check_config, repair_allowing_parts, repair_or_raise
from meshmatch.api.kinds import choose_model
from meshmatch.collections.setting import FIRST_TEMPLATE, TEMPLATE, Setting, Source, read_template
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.fitting.kind_templates import mean_shape, template_of, with_final_nodes
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.models.registry import AUTO, NO_MODEL
from meshmatch.outputs import replace_on_success
from meshmatch.scalars import counted
from meshmatch.shapes.input_files import read_json
from meshmatch.shapes.rims import is_sheet
from meshmatch.shapes.shape import Shape
from meshmatch.templates.prepared_folder import medoid
from meshmatch.templates.template import Template, save_template

SCHEMA = 1
MANIFEST = "collection.json"
_MAX_KIND_TRIES = 20  # shapes tried, in order, until one is of a known kind
_MAX_CANDIDATES = 40  # shapes among which the first template is searched
_MAX_AVERAGED = 200  # shapes that the mean is computed from


def select_setting(requested: Setting, sources: Sequence[Source]) -> Setting:
    """Resolve the requested setting: choose the model if it is "auto", and determine the template.

    A new folder of fits gets its template and ``collection.json``; an existing one is checked against the setting.
    `OptionError` if its fits were made with another model or other options. Other errors as `choose_model`.
    """
    check_config(requested.config)
    store, about, model = requested.store, read_manifest(requested.store), requested.model
    if model == AUTO:
        model = _choose_model(sources, requested) if about is None else str(about["model"])
    if model == NO_MODEL:
        template, file = _first_template(requested, sources, about is None), FIRST_TEMPLATE
    else:
        trained = as_model(model)
        template, file = trained.template, TEMPLATE
        model = model if model == trained.card.name else str(Path(model).resolve())
    setting = replace(requested, model=model, template_file=file, template_hash=template.hash)
    wanted = {"schema": SCHEMA} | setting.choices() | {"template": template.hash}
    if about is None:
        with store.writing(file) as path:
            save_template(template, path)
        save_text(store, MANIFEST, json.dumps(wanted, indent=2) + "\n")  # last: a folder without it is not a collection
    elif differs := [name for name in wanted if about[name] != wanted[name]]:
        other = f"the fits in {store.location} were made with another {_describe_difference(differs[0], about, wanted)}"
        hint = "choose another folder, or the options used before"
        if isinstance(about["fit"], dict) and about["fit"].keys() != wanted["fit"].keys():
            other = f"the fits in {store.location} were made by another version of meshmatch, which fits differently"
            hint = "choose another folder, or keep using that version; maps and atlases of these fits still work"
        raise OptionError(other, hint)
    return setting


def _describe_difference(name: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Describe the first option that differs, with both values; nested options are named by the innermost key."""
    then, wanted = before[name], now[name]
    if isinstance(then, dict) and isinstance(wanted, dict):
        inner = next((key for key in wanted if then.get(key) != wanted[key]), None)
        if inner is not None and inner in then:
            return _describe_difference(inner, then, wanted)
    return f"{name}: {then}, not {wanted}" if isinstance(then, str | int | float) else name


def _first_template(requested: Setting, sources: Sequence[Source], new: bool) -> Template:
    """Make a template of the medoid of some shapes, for fits without a model; an existing collection's one is read."""
    if not new:
        return read_template(requested.store, FIRST_TEMPLATE)
    some = np.unique(np.linspace(0, len(sources) - 1, min(len(sources), _MAX_CANDIDATES)).astype(int))
    found = []
    for number in some:
        with suppress(MeshmatchError):
            found.append(repair_or_raise(sources[number].load(requested.only, requested.without)))
    if not found:
        raise InputError(f"none of {counted(len(some), 'shape')} can be a template", "are they meshes?")
    sided = requested.config.mirror != "no" and not all(
        is_sheet(each.shape) for each in found
    )  # a leaf only turns over
    chosen = found[medoid(found, "rigid", "area", 0, either_side=sided)]
    return template_of(chosen.shape, chosen.shape.name, ViscousConfig())


def subsample(names: Sequence[str]) -> list[str]:
    """Choose the shapes that the mean is computed from, evenly spaced in the list."""
    return [
        names[number]
        for number in np.unique(np.linspace(0, len(names) - 1, min(len(names), _MAX_AVERAGED)).astype(int))
    ]


def rebase_on_mean(setting: Setting, names: Sequence[str], folder: str, file: str, fine: bool = False) -> Setting:
    """Replace the template by the mean of the named shapes, which has less far to deform than any one of them.

    The shapes are read from the fits in ``folder``, and the template is written to ``file``, with more nodes
    (`with_final_nodes`) if ``fine``. Without names the template stays as it is.
    """
    before = mean = setting.template
    if names:
        fits = [setting.read(folder, name).fit for name in names]
        mean = template_of(Shape(mean_shape(before, fits), before.shape.faces), "mean", ViscousConfig())
        mean = with_final_nodes(mean, ViscousConfig()) if fine else mean
    with setting.store.writing(file) as path:
        save_template(mean, path)
    return replace(setting, template_file=file, template_hash=mean.hash)


def _choose_model(sources: Sequence[Source], requested: Setting) -> str:
    """Name the installed model for the first shape that can be read and is of a known kind.

    If there is none among the first shapes, the error of the first one is raised.
    """
    first_error: MeshmatchError | None = None
    for source in sources[:_MAX_KIND_TRIES]:
        try:
            chosen = choose_model(
                [repair_allowing_parts(source.load(requested.only, requested.without))], [requested.config]
            ).model
        except MeshmatchError as error:
            first_error = first_error or error
        else:
            return chosen.card.name
    assert first_error is not None
    raise first_error


def is_collection(folder: str | Path) -> bool:
    """Whether a folder is a collection: it has a ``collection.json``."""
    return (Path(folder) / MANIFEST).is_file()


def read_manifest(store: Store) -> dict[str, Any] | None:
    """Read ``collection.json``, the model and options of a folder of fits; None if the folder is not one."""
    if not store.exists(MANIFEST):
        return None
    try:
        with store.reading(MANIFEST) as path:
            about = read_json(path)
        if about["schema"] != SCHEMA:
            raise InputError(f"{MANIFEST} has schema {about['schema']!r}, not {SCHEMA}", "update meshmatch")
        return {name: about[name] for name in ("schema", "template", "model", "only", "without", "sequence", "fit")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{store.location}/{MANIFEST} is damaged", "remove the folder, and fit again") from error


def save_text(store: Store, name: str, text: str) -> None:
    """Write a text file atomically."""
    with store.writing(name) as path, replace_on_success(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
