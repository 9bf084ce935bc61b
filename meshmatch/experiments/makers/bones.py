"""Generate bones similar to the lower ends of femurs, with ground-truth correspondence.

A bone is a smooth function on the sphere: a direction is the same place on all bones, however each is triangulated. Bones
differ in size, in proportions that depend on size (allometry), by sex and at random. The bones of one group have a bump on
the lateral condyle, and no other difference. Lengths are in millimetres.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from typer import Argument, Option

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments import runner
from meshmatch.geometry.frames import Frame
from meshmatch.outputs import make_folder
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape

LANDMARKS: Mapping[str, tuple[float, float, float]] = {
    "medial epicondyle": (-0.92, 0.0, -0.4),
    "lateral epicondyle": (0.92, 0.0, -0.4),
    "medial condyle": (-0.55, -0.45, -0.7),
    "lateral condyle": (0.55, -0.45, -0.7),
    "intercondylar notch": (0.0, -0.6, -0.8),
    "trochlear groove": (0.0, 0.75, -0.66),
    "shaft": (0.0, 0.0, 1.0),
}
"""Directions of anatomical landmarks; x is lateral, y anterior, z along the shaft."""
BUMP, HIGH = (0.8, -0.1, -0.6), 3.0
"""Direction and height of the bump of the group "bump"."""
_PLACES = 10  # number of places with random variation, the same for all bones
_VARY = 0.8  # standard deviation of the variation


@dataclass(frozen=True)
class Bone:
    """One bone: its metadata, relative ``size``, and the random variation at each of P places."""

    name: str
    size: float
    sex: str
    age: int
    group: str
    side: str
    varies: Float[Floats, " P"]

    def points(self, directions: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points in the given directions (unit vectors), as on a right bone; a left bone is the mirror image."""
        x, y, z = directions.T
        roundness = (0.1 + 0.9 * np.hypot(x, y)) ** 0.6
        width = 1 / (1 + np.exp((z + 0.3) / 0.13))
        condyles = 27.0 * self.size**0.4 * (1.03 if self.sex == "m" else 1.0)
        radius = 14.0 + (condyles - 14.0) * width
        points = np.stack([radius * x / roundness, 0.75 * radius * y / roundness + 5.0 * z**2, 45.0 * z], axis=1)
        for place, push, narrow in (
            ((-0.55, -0.6, -0.6), (0.0, -14.0, -10.0), 9.0),
            ((0.6, -0.6, -0.5), (4.0, -7.0, -3.0), 9.0),
            ((0.0, -0.65, -0.75), (0.0, 8.0, 7.0), 16.0),
            ((0.0, 0.75, -0.66), (0.0, -5.0, 3.0), 12.0),
            ((-0.97, 0.0, -0.2), (-5.0, 0.0, 2.0), 25.0),
        ):
            points += bump_at(directions, place, narrow) * np.array(push)
        rng = np.random.default_rng(0)
        for place, amount in zip(rng.standard_normal((_PLACES, 3)), self.varies, strict=True):
            points += amount * bump_at(directions, place, 6.0) * directions
        if self.group == "bump":
            points += HIGH * bump_at(directions, BUMP, 40.0) * np.array(BUMP)
        return np.asarray(self.size * points)


def bump_at(directions: Float[Floats, "N 3"], place: Sequence[float] | Floats, narrow: float) -> Float[Floats, "N 1"]:
    """Bump function on the sphere: 1 in the direction ``place``, decaying around it; larger ``narrow`` decays faster."""
    direction = np.asarray(place) / np.linalg.norm(place)
    return np.asarray(np.exp(narrow * (directions @ direction - 1.0))[:, None])


@dataclass(frozen=True, eq=False)
class BoneScan:
    """A scanned bone: its own triangulation, the ``frame`` from the scan's to the bone's coordinates, and the direction of
    every vertex, which is the ground truth.
    """

    bone: Bone
    shape: Shape
    frame: Frame
    directions: Float[Floats, "V 3"]

    def places(self, directions: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points in the given directions, in the coordinates of the scan."""
        return self.frame.undo(self.bone.points(directions))


def draw_bones(count: int, seed: int = 0) -> list[Bone]:
    """Draw ``count`` random bones; every third one is a left one, every second one has a bump, and half are of each sex."""
    rng = np.random.default_rng([seed, 0])
    bones = []
    for k in range(count):
        sex = "f" if k // 2 % 2 else "m"
        size = float(np.exp(0.07 * rng.standard_normal())) * (1.08 if sex == "m" else 1.0)
        group, side = ("bump", "plain")[k % 2], "left" if k % 3 == 2 else "right"
        varies = _VARY * rng.standard_normal(_PLACES)
        bones.append(Bone(f"bone-{k + 1:02d}", size, sex, int(rng.integers(20, 80)), group, side, varies))
    return bones


def scan(bone: Bone, vertices: int, seed: int = 0) -> BoneScan:
    """Scan a bone at a random position and orientation; the seed determines these and the triangulation."""
    rng = np.random.default_rng([seed, 1])
    number = np.arange(vertices) + 0.5
    z = 1.0 - 2.0 * number / vertices
    angle = np.pi * (1 + np.sqrt(5)) * number
    ring_radius = np.sqrt(1.0 - z**2)
    lattice = np.stack([ring_radius * np.cos(angle), ring_radius * np.sin(angle), z], axis=1)
    directions = Rotation.random(rng=rng).apply(lattice)
    faces = outward(directions, ConvexHull(directions).simplices.astype(np.int64))
    mirror = np.diag([-1.0, 1.0, 1.0]) if bone.side == "left" else np.eye(3)
    frame = Frame(1.0, mirror @ Rotation.random(rng=rng).as_matrix(), rng.uniform(-100, 100, 3))
    verts = frame.undo(bone.points(directions))
    return BoneScan(bone, Shape(verts, faces[:, ::-1] if bone.side == "left" else faces, bone.name), frame, directions)


def outward(directions: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Int[Ints, "F 3"]:
    """Orient the triangles of a sphere outwards."""
    a, b, c = (directions[faces[:, k]] for k in range(3))
    inside = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    return np.where(inside[:, None], faces[:, ::-1], faces)


def write_bones(folder: Path, scans: Sequence[BoneScan]) -> None:
    """Write ``scans/NAME.ply``, ``landmarks/NAME.csv`` with the true landmarks, and ``table.csv`` with the metadata."""
    make_folder(folder / "scans")
    make_folder(folder / "landmarks")
    directions = np.array(list(LANDMARKS.values()))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for each in scans:
        save_shape(folder / "scans" / f"{each.bone.name}.ply", each.shape)
        places = zip(LANDMARKS, each.places(directions).round(4).tolist(), strict=True)
        _write(folder / "landmarks" / f"{each.bone.name}.csv", [("name", "x", "y", "z"), *((n, *p) for n, p in places)])
    columns = ("name", "sex", "age", "group", "side")
    _write(folder / "table.csv", [columns, *([getattr(each.bone, column) for column in columns] for each in scans)])


def _write(path: Path, rows: Sequence[Sequence[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


@runner.command
def main(
    folder: Annotated[Path, Argument(help="output folder, for scans, landmarks and table.csv")],
    count: Annotated[int, Option(min=1, help="number of bones")] = 20,
    vertices: Annotated[int, Option(min=100, help="approximate number of vertices of each")] = 3000,
    seed: runner.Seed = 0,
) -> runner.Report:
    """Write bones similar to the lower ends of femurs, with true landmarks."""
    bones = draw_bones(count, seed)
    rng = np.random.default_rng([seed, 2])
    scans = [scan(bone, int(vertices * rng.uniform(0.7, 1.3)), seed + k) for k, bone in enumerate(bones)]
    write_bones(folder, scans)
    return runner.Report({"folder": str(folder), "bones": count})
