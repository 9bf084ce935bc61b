"""What an implicit model learns from: points with signed distances and normals, of a folder of shapes.

Watertight meshes, clouds, and .npz files with `points` and either their `normals` or their `sdf` (signed distances,
negative inside). Each is centred and scaled by its box into the cube from -1 to 1; none is turned.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Floats32
from meshmatch.errors import InputError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.triangles import is_watertight
from meshmatch.shapes.files import SUFFIXES, load_shape
from meshmatch.shapes.input_files import existing, read_npz
from meshmatch.shapes.sampling import sample_surface

FILLED = 0.85
"""Half the longest side of a shape's box, in the cube of half side 1."""
_DENSE, _MOST, _ALL = 40_000, 16_384, 40_000_000  # surface points; samples of a shape, and of a folder
_NEAR = 0.05  # deviation of the free points that lie near a surface
_KINDS = {*SUFFIXES, ".npz"} - {".npy"}  # arrays beside shapes are labels or landmarks


@dataclass(frozen=True, eq=False)
class ImplicitSamples:
    """N samples of each of S shapes in the cube, the first half on the surface: point, signed distance, normal (0 where it
    is not known).
    """

    names: tuple[str, ...]
    frames: tuple[Frame, ...]  # from each file into the cube
    rows: Float[Floats32, "S N 7"]


def read_implicit_samples(folder: str | Path, seed: int = 0) -> ImplicitSamples:
    """Samples of all shapes of a folder, the same for a seed.

    `InputError` if there are fewer than two, or one cannot be read or tells no inside: a mesh with holes.
    """
    files = sorted(file for file in Path(folder).glob("*") if file.suffix.lower() in _KINDS)
    names = tuple(file.stem for file in files)
    if len(files) < 2 or len(set(names)) < len(names):
        hint = f"give a folder of watertight meshes, clouds or .npz ({', '.join(sorted(_KINDS))}), each once"
        raise InputError(f"{folder} has {len(set(names))} shapes of different names; two are needed", hint)
    N = int(np.clip(_ALL // len(files), 1024, _MOST)) // 4 * 4
    found = [_samples(file, N, np.random.default_rng([seed, number])) for number, file in enumerate(files)]
    frames, rows = zip(*found, strict=True)
    return ImplicitSamples(names, frames, np.stack(rows).astype(np.float32))


def _samples(file: Path, N: int, rng: np.random.Generator) -> tuple[Frame, Float[Floats, "N 7"]]:
    """A shape's frame; points, distances and normals in the cube."""
    sdf = np.zeros(0)
    if file.suffix.lower() == ".npz":
        held = read_npz(existing(file), ("points", "sdf", "normals"))
        points, sdf, normals = (np.asarray(held.get(name, ())) for name in ("points", "sdf", "normals"))
        alike = sdf.shape == points.shape[:1] or normals.shape == points.shape
        if not (points.ndim == 2 and points.shape[1] == 3 and alike and len(points)):
            raise InputError(f"{file.name} needs points (N, 3), and sdf (N,) or normals (N, 3)", "see docs/method.md")
        if any(each.dtype.kind not in "fiu" or not np.isfinite(each).all() for each in (points, sdf, normals)):
            raise InputError(f"{file.name} holds what is no finite number", "leave these points out")
        points, sdf, normals = (each.astype(np.float64) for each in (points, sdf, normals))
    else:
        shape = load_shape(file)
        if not shape.is_cloud and (shape.invalid is not None or not is_watertight(shape.faces)):
            raise InputError(f"{file.name} is not watertight: it has no inside", "close its holes, or give its points")
        drawn = sample_surface(shape, shape.V if shape.is_cloud else _DENSE, rng)
        points, normals = drawn.points, drawn.normals
    inside = points[sdf < 0] if len(sdf) else points
    if len(inside) < 4:
        raise InputError(
            f"{file.name} has {len(inside)} points of the shape; four are needed", "sdf is negative inside"
        )
    low, high = inside.min(0), inside.max(0)
    frame = Frame(float((high - low).max()) / (2 * FILLED), np.eye(3), (low + high) / 2)
    points = frame.apply(points)
    if not len(sdf):
        return frame, free_and_surface(points, normals, N, rng)
    kept = np.flatnonzero((np.abs(points) <= 1).all(1))
    near = kept[np.argsort(np.abs(sdf[kept]), kind="stable")[: max(1, len(kept) // 4)]]
    rows = np.concatenate([rng.choice(near, N // 2), rng.choice(kept, N // 2)])
    return frame, np.column_stack([points[rows], sdf[rows] / frame.scale, np.zeros((N, 3))])


def free_and_surface(
    points: Float[Floats, "P 3"], normals: Float[Floats, "P 3"], N: int, rng: np.random.Generator
) -> Float[Floats, "N 7"]:
    """Half on the surface, a quarter near it, a quarter anywhere in the cube, with distances to the surface.

    The nearest points say how far it is, and the nearest eight together on which side.
    """
    on, near = (rng.choice(len(points), count, replace=len(points) < count) for count in (N // 2, N // 4))
    beside = np.clip(points[near] + _NEAR * rng.standard_normal((N // 4, 3)), -1, 1)
    free = np.concatenate([beside, rng.uniform(-1, 1, (N // 4, 3))])
    far, index = cKDTree(points).query(free, min(8, len(points)))
    height = ((free[:, None] - points[index]) * normals[index]).sum(2)
    spacing = np.median(far[:, -1] - far[:, 0])
    length = np.where(far[:, 0] < spacing, np.minimum(np.abs(height[:, 0]), far[:, 0]), far[:, 0])
    sdf = np.where(height.sum(1) < 0, -length, length)
    surface = np.column_stack([points[on], np.zeros(len(on)), normals[on]])
    return np.concatenate([surface, np.column_stack([free, sdf, np.zeros_like(free)])])
