"""Save and load single fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from meshmatch.api.inputs import as_model, repair_allowing_parts
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.fitting.fit import Fit, check_fit
from meshmatch.maps.fit_files import read_fit, read_fit_header, write_fit
from meshmatch.maps.places import PlacedFit
from meshmatch.models.registry import NO_MODEL, list_models
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import as_path
from meshmatch.shapes.tables import check_suffix

_SUFFIX = ".safetensors"


def save_fit(path: str | Path, fit: Fit) -> None:
    """Write a fit and its shape to a file, in the format that a `Collection` uses.

    The file contains the model's name, not the model. It is written completely or not at all.

    Parameters
    ----------
    path
        A file with the suffix .safetensors.
    fit
        A fit by a model.

    Raises
    ------
    OptionError
        The suffix is not .safetensors, or the fit was made without a model: its template is the other shape, which the
        file would not contain.
    InputError
        ``fit`` is not a `Fit`, or does not contain its shape.
    OutputError
        The file cannot be written.

    Examples
    --------
    >>> meshmatch.save_fit("climber.safetensors", meshmatch.register("templates/samples/climber.ply"))
    >>> meshmatch.load_fit("climber.safetensors").verdict
    """
    check_fit(fit)
    check_suffix(path, (_SUFFIX,), "fits")
    if fit.model == NO_MODEL:
        raise OptionError(
            "a fit without a model cannot be saved: its template is the other shape", "save the map: save_map"
        )
    if fit.repaired is None and not isinstance(fit, PlacedFit):
        raise InputError("this fit does not contain its shape", "make it with meshmatch.register or Matcher.fit")
    write_fit(path, fit, shape=None if fit.repaired is None else fit.repaired.original)


def load_fit(path: str | Path, model: str | Path | TrainedModel | None = None) -> Fit:
    """Read a fit from a file. `Matcher.map` and `Matcher.follow` accept it like a new one.

    Parameters
    ----------
    path
        A file that `save_fit` wrote; or a file in the folder ``fits`` of a `Collection`, whose fit does not contain its
        shape.
    model
        The model of the fit; by default the installed model with the name in the file.

    Returns
    -------
    Fit
        The fit, with ``seconds`` 0 and without ``signs``.

    Raises
    ------
    InputError
        The file is missing, damaged or unfinished, or its fit is of another template.
    ModelError
        The model is not installed.

    Examples
    --------
    >>> meshmatch.save_fit("climber.safetensors", meshmatch.register("templates/samples/climber.ply"))
    >>> climber = meshmatch.load_fit("climber.safetensors")
    >>> meshmatch.Matcher("human").map(climber, meshmatch.register("templates/samples/dancer.ply"))
    """
    path = as_path(path)
    if model is None:
        model = str(read_fit_header(path)[0]["model"])
        if model == NO_MODEL:
            raise InputError(f"{path.name} is a fit without a model", "open its folder: meshmatch.Collection(folder)")
        if model not in {entry.name for entry in list_models()}:
            raise ModelError(
                f"{path.name} is a fit of a model {model[:80]!r}", "pass that model: load_fit(path, model)"
            )
    read = read_fit(path, as_model(model).template)
    if read.shape is None:
        if not isinstance(read.fit, PlacedFit):
            hint = "give a file of save_fit or of a collection's folder `fits`, or fit the shape again"
            raise InputError(f"{path.name} contains neither the shape of its fit nor the places of its vertices", hint)
        return read.fit
    clean = replace(repair_allowing_parts(read.shape), left_out=read.fit.left_out)
    return replace(read.fit, verts=clean.shape.verts, repaired=clean)
