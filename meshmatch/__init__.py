"""Dense matching of non-rigid 3D shapes.

The public names below are loaded when they are first used: importing `meshmatch` itself costs nothing heavy.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Fit": "meshmatch.fitting.fit",
    "Frame": "meshmatch.geometry.frames",
    "MeshmatchError": "meshmatch.errors",
    "Shape": "meshmatch.shapes.shape",
    "VertexMap": "meshmatch.maps.vertex_map",
    "interpolate": "meshmatch.interpolation",
    "load_shape": "meshmatch.shapes.files",
    "match": "meshmatch.pipeline",
    "register": "meshmatch.pipeline",
    "save_shape": "meshmatch.shapes.files",
}

__all__ = ["__version__", *sorted(_PUBLIC)]  # noqa: PLE0604  (names come from __getattr__)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'meshmatch' has no attribute {name!r}")
    value = getattr(import_module(_PUBLIC[name]), name)
    globals()[name] = value  # next time without this function
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
