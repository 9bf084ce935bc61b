"""A benchmark of small bumpy spheres in the layout of the real one, and a method that knows the true maps."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.errors import InputError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.maps.solids import bumpy_sphere

BODY = bumpy_sphere(8, 10)
FAUST_NAMES = ("tr_reg_000", "tr_reg_001", "tr_reg_010")


def order(name: str) -> np.ndarray:
    """Return the vertex of `BODY` that each vertex of a shape is: a permutation seeded by the name."""
    return np.random.default_rng([ord(c) for c in name]).permutation(BODY.V)


def build(folder: Path) -> Path:
    """Write the three sets; vertex k of `BODY` is landmark k. SCAPE shapes keep its order, the others are permuted."""
    for number, name in enumerate(("1", "2", "10")):
        _save(folder / "shrec19", name, order(name), 1.0 + number)
    (folder / "shrec19" / "pairs.txt").write_text("1 2\n1 10\n10 2\n\n")
    for number, name in enumerate(("mesh000", "mesh001")):
        _save(folder / "scape", name, np.arange(BODY.V), 1.0 + number)
    for name in FAUST_NAMES:
        _save(folder / "faust", name, order(name), 0.3)
    return folder


def _save(folder: Path, name: str, vertices: np.ndarray, scale: float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    landmarks = np.argsort(vertices)  # vertex of the shape for vertex k of the body
    save_shape(folder / f"{name}.ply", Shape(scale * BODY.verts[vertices], landmarks[BODY.faces], name))
    if folder.name != "scape":
        np.save(folder / f"{name}.landmarks.npy", landmarks.astype(np.int32))


def truth(source: str, target: str) -> np.ndarray:
    """Return the true map ``(V,)`` between two shapes of a set."""
    if source.startswith("mesh"):
        return np.arange(BODY.V)
    return np.argsort(order(target))[order(source)]


@dataclass(frozen=True)
class Oracle:
    """Method that knows every map; its fit of a shape is the shape's name.

    It raises `InputError` for the shape ``refuses``, and reverses maps if ``turned``.
    """

    refuses: str = ""
    turned: bool = False

    def fit(self, shape: Shape) -> Any:
        name = Path(shape.name).stem
        if name == self.refuses:
            raise InputError(f"{name} cannot be fitted")
        return name

    def map(self, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        index = truth(source_fit, target_fit)
        return VertexMap.between(source, target, index[::-1].copy() if self.turned else index)
