"""Dense matching of non-rigid 3D shapes.

The public names below are loaded when they are first used: importing `meshmatch` itself costs nothing heavy. They are
described on the site, whose pages docs/reference lists.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.3.0"

if TYPE_CHECKING:
    from meshmatch.api.interpolation import Interpolation as Interpolation
    from meshmatch.api.interpolation import InterpolationOptions as InterpolationOptions
    from meshmatch.api.interpolation import interpolate as interpolate
    from meshmatch.api.matching import Matcher as Matcher
    from meshmatch.api.matching import match as match
    from meshmatch.api.matching import register as register
    from meshmatch.api.pictures import picture as picture
    from meshmatch.api.pictures import view as view
    from meshmatch.api.results import ConfidenceRule as ConfidenceRule
    from meshmatch.api.results import MatchResult as MatchResult
    from meshmatch.api.results import Transferred as Transferred
    from meshmatch.api.results import evaluate as evaluate
    from meshmatch.api.texture import TexturedResult as TexturedResult
    from meshmatch.api.texture import transfer_texture as transfer_texture
    from meshmatch.api.transfer import find_maps as find_maps
    from meshmatch.api.transfer import transfer_colors as transfer_colors
    from meshmatch.api.transfer import transfer_labels as transfer_labels
    from meshmatch.api.transfer import transfer_landmarks as transfer_landmarks
    from meshmatch.api.transfer import transfer_values as transfer_values
    from meshmatch.api.transfer import transfer_weights as transfer_weights
    from meshmatch.collections.atlas import Atlas as Atlas
    from meshmatch.collections.collection import Collection as Collection
    from meshmatch.collections.measures import measure_atlas as measure_atlas
    from meshmatch.errors import MeshmatchError as MeshmatchError
    from meshmatch.errors import MeshmatchWarning as MeshmatchWarning
    from meshmatch.fitting.fit import Fit as Fit
    from meshmatch.fitting.fit_config import FitConfig as FitConfig
    from meshmatch.geometry.frames import Frame as Frame
    from meshmatch.implicit.codes import fit_implicit as fit_implicit
    from meshmatch.implicit.model import ImplicitFit as ImplicitFit
    from meshmatch.implicit.model import ImplicitModel as ImplicitModel
    from meshmatch.implicit.model import load_implicit as load_implicit
    from meshmatch.implicit.sequence import implicit_sequence as implicit_sequence
    from meshmatch.implicit.training import train_implicit as train_implicit
    from meshmatch.maps.files import load_map as load_map
    from meshmatch.maps.files import save_map as save_map
    from meshmatch.maps.vertex_map import VertexMap as VertexMap
    from meshmatch.models.registry import load_model as load_model
    from meshmatch.shapes.files import load_shape as load_shape
    from meshmatch.shapes.files import save_shape as save_shape
    from meshmatch.shapes.shape import Shape as Shape
    from meshmatch.templates.prepare import prepare as prepare
    from meshmatch.training.train import train as train
    from meshmatch.transfer.bake import BakeOptions as BakeOptions

_HOMES = {
    "Atlas": "meshmatch.collections.atlas",
    "BakeOptions": "meshmatch.transfer.bake",
    "Collection": "meshmatch.collections.collection",
    "ConfidenceRule": "meshmatch.api.results",
    "Fit": "meshmatch.fitting.fit",
    "FitConfig": "meshmatch.fitting.fit_config",
    "Frame": "meshmatch.geometry.frames",
    "ImplicitFit": "meshmatch.implicit.model",
    "ImplicitModel": "meshmatch.implicit.model",
    "Interpolation": "meshmatch.api.interpolation",
    "InterpolationOptions": "meshmatch.api.interpolation",
    "MatchResult": "meshmatch.api.results",
    "Matcher": "meshmatch.api.matching",
    "MeshmatchError": "meshmatch.errors",
    "MeshmatchWarning": "meshmatch.errors",
    "Shape": "meshmatch.shapes.shape",
    "TexturedResult": "meshmatch.api.texture",
    "Transferred": "meshmatch.api.results",
    "VertexMap": "meshmatch.maps.vertex_map",
    "evaluate": "meshmatch.api.results",
    "find_maps": "meshmatch.api.transfer",
    "fit_implicit": "meshmatch.implicit.codes",
    "implicit_sequence": "meshmatch.implicit.sequence",
    "interpolate": "meshmatch.api.interpolation",
    "load_implicit": "meshmatch.implicit.model",
    "load_map": "meshmatch.maps.files",
    "load_model": "meshmatch.models.registry",
    "load_shape": "meshmatch.shapes.files",
    "match": "meshmatch.api.matching",
    "measure_atlas": "meshmatch.collections.measures",
    "picture": "meshmatch.api.pictures",
    "prepare": "meshmatch.templates.prepare",
    "register": "meshmatch.api.matching",
    "save_map": "meshmatch.maps.files",
    "save_shape": "meshmatch.shapes.files",
    "train": "meshmatch.training.train",
    "train_implicit": "meshmatch.implicit.training",
    "transfer_colors": "meshmatch.api.transfer",
    "transfer_labels": "meshmatch.api.transfer",
    "transfer_landmarks": "meshmatch.api.transfer",
    "transfer_texture": "meshmatch.api.texture",
    "transfer_values": "meshmatch.api.transfer",
    "transfer_weights": "meshmatch.api.transfer",
    "view": "meshmatch.api.pictures",
}

__all__ = ["__version__", *sorted(_HOMES)]  # noqa: PLE0604  (names come from __getattr__)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'meshmatch' has no attribute {name!r}")
    from importlib import import_module

    from meshmatch.errors import needs

    extra = "implicit" if _HOMES[name].startswith("meshmatch.implicit") else "train"
    with needs("torch", extra):
        value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value  # next time without this function
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
