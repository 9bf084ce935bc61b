"""Dense matching of non-rigid 3D shapes.

The public names below are loaded when they are first used: importing `meshmatch` itself costs nothing heavy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.2.0"

if TYPE_CHECKING:
    from meshmatch.api.interpolation import interpolate as interpolate
    from meshmatch.api.matching import Matcher as Matcher
    from meshmatch.api.matching import match as match
    from meshmatch.api.matching import register as register
    from meshmatch.errors import MeshmatchError as MeshmatchError
    from meshmatch.fitting.fit import Fit as Fit
    from meshmatch.fitting.fit_config import FitConfig as FitConfig
    from meshmatch.geometry.frames import Frame as Frame
    from meshmatch.maps.vertex_map import VertexMap as VertexMap
    from meshmatch.models.trained import load_model as load_model
    from meshmatch.shapes.files import load_shape as load_shape
    from meshmatch.shapes.files import save_shape as save_shape
    from meshmatch.shapes.shape import Shape as Shape

_HOMES = {
    "Fit": "meshmatch.fitting.fit",
    "FitConfig": "meshmatch.fitting.fit_config",
    "Frame": "meshmatch.geometry.frames",
    "Matcher": "meshmatch.api.matching",
    "MeshmatchError": "meshmatch.errors",
    "Shape": "meshmatch.shapes.shape",
    "VertexMap": "meshmatch.maps.vertex_map",
    "interpolate": "meshmatch.api.interpolation",
    "load_model": "meshmatch.models.trained",
    "load_shape": "meshmatch.shapes.files",
    "match": "meshmatch.api.matching",
    "register": "meshmatch.api.matching",
    "save_shape": "meshmatch.shapes.files",
}

__all__ = ["__version__", *sorted(_HOMES)]  # noqa: PLE0604  (names come from __getattr__)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'meshmatch' has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value  # next time without this function
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
