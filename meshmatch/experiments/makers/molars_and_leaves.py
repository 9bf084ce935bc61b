"""Generate molars, leaves and knees in correspondence: vertex i is the same place on all of a kind. Lengths in millimetres.

Individuals differ in proportions, in the size of cusps, roots and lobes, and by smooth random deformations. A molar has
cusps and roots that distinguish left from right. A leaf is an open sheet with lobes, randomly bent. A knee is a femur, a
tibia and a patella in one shape; each bone is a separate part that varies and rotates in the joint.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments.makers.bones import bump_at, draw_bones, outward


@dataclass(frozen=True, eq=False)
class Registered:
    """S shapes of a kind on the same vertices and triangles."""

    verts: Float[Floats, "S V 3"]
    faces: Int[Ints, "F 3"]


def sphere(count: int) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"]]:
    """Evenly spread directions (Fibonacci lattice), and outward triangles between them."""
    number = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * number / count, np.pi * (1 + np.sqrt(5)) * number
    ring_radius = np.sqrt(1.0 - z**2)
    directions = np.stack([ring_radius * np.cos(angle), ring_radius * np.sin(angle), z], axis=1)
    return directions, outward(directions, ConvexHull(directions).simplices.astype(np.int64))


def deform_randomly(
    verts: Float[Floats, "V 3"], much: float, wide: float, rng: np.random.Generator, places: int = 12
) -> Float[Floats, "V 3"]:
    """Smooth random deformation: Gaussians of width ``wide`` at random places, with amplitudes of deviation ``much``."""
    low, high = verts.min(axis=0), verts.max(axis=0)
    centers = rng.uniform(low, high, (places, 3))
    squared_distance = np.square(verts[:, None] - centers).sum(axis=2)
    return np.asarray(verts + np.exp(-squared_distance / (2 * wide**2)) @ (much * rng.standard_normal((places, 3))))


def molars(count: int, seed: int = 0, vertices: int = 4000) -> Registered:
    """Upper molars: four cusps of different heights with a groove between them, a small cusp at the side, three roots."""
    rng = np.random.default_rng([seed, 10])
    d, faces = sphere(vertices)
    box = np.array([5.2, 4.7, 4.0])
    crown = d * ((np.abs(d / box) ** 3.5).sum(axis=1) ** (-1 / 3.5))[:, None]
    cusps = (((0.55, 0.5, 0.68), 1.7), ((-0.5, 0.55, 0.7), 1.3), ((0.6, -0.5, 0.62), 2.2), ((-0.55, -0.5, 0.7), 1.0))
    roots = (((0.5, 0.5, -0.75), (0.6, 0.8, -6.5)), ((-0.5, 0.5, -0.75), (-0.9, 0.7, -5.5)),
             ((0.05, -0.6, -0.8), (0.1, -1.5, -8.0)))  # fmt: skip
    shapes = []
    for _ in range(count):
        verts = crown - 1.0 * bump_at(d, (0.0, 0.0, 1.0), 9.0) * [0.0, 0.0, 1.0]
        for place, high in cusps:
            verts = verts + high * rng.uniform(0.7, 1.3) * bump_at(d, place, 28.0) * [0.0, 0.0, 1.0]
        verts = verts + rng.uniform(0.5, 1.1) * bump_at(d, (0.75, -0.6, 0.2), 30.0) * [0.6, -0.7, 0.2]
        for place, push in roots:
            verts = verts + rng.uniform(0.8, 1.2) * bump_at(d, place, 14.0) * np.array(push)
        size = 1 + 0.07 * rng.standard_normal() + 0.05 * rng.standard_normal(3)
        shapes.append(deform_randomly(verts * size, 0.35, 3.0, rng))
    return Registered(np.array(shapes), faces)


def leaves(count: int, seed: int = 0, vertices: int = 3000) -> Registered:
    """Leaves with lobes on both sides, asymmetric at the base like a begonia's; folded, bent and twisted."""
    rng = np.random.default_rng([seed, 11])
    number = np.arange(vertices) + 0.5
    angle, radius = np.pi * (1 + np.sqrt(5)) * number, np.sqrt(number / vertices)
    u, v = radius * np.cos(angle), radius * np.sin(angle)
    faces = Delaunay(np.stack([u, v], axis=1)).simplices.astype(np.int64)
    across, t = u / np.sqrt(np.maximum(1 - v**2, 1e-4)), 0.5 + 0.5 * v
    shapes = []
    for _ in range(count):
        lobes, broad = rng.uniform(0.7, 1.3, 2) * [0.16, 18.0]
        outline = broad * (np.sin(np.pi * np.clip(t, 0, 1) ** 0.65) ** 0.8) * (1 + lobes * np.sin(7 * np.pi * t))
        outline = outline * np.where(across < 0, 1.0 - 0.6 * (1 - t) ** 2, 1.0) + 0.8
        x, y = across * outline, 75.0 * (t - 0.5)
        fold, bend, twist = rng.uniform(0.2, 0.45), rng.uniform(-0.004, 0.006), rng.normal(0, 0.006)
        z = fold * np.sqrt(x**2 + 4.0) + bend * y**2 + twist * x * y
        verts = np.stack([x, y, z], axis=1) * (1 + 0.1 * rng.standard_normal())
        shapes.append(deform_randomly(verts, 1.5, 20.0, rng))
    return Registered(np.array(shapes), faces)


def knees(count: int, seed: int = 0, vertices: int = 2400) -> Registered:
    """Femur, tibia and patella in one shape, bent by up to 12 degrees in either direction."""
    rng = np.random.default_rng([seed, 12])
    long, long_faces = sphere(vertices)
    small, small_faces = sphere(vertices // 4)
    faces = np.concatenate([long_faces, long_faces + vertices, small_faces + 2 * vertices])
    half_turn = np.diag([1.0, -1.0, -1.0])
    femurs, tibias = (draw_bones(count, seed + 20 * k) for k in range(2))
    shapes = []
    for femur, tibia in zip(femurs, tibias, strict=True):
        bend = Rotation.from_euler("xz", [rng.uniform(-12, 12), rng.normal(0, 3)], degrees=True).as_matrix()
        lower = tibia.points(long) @ half_turn * [0.95, 0.8, 1.0] * femur.size / tibia.size
        upper = femur.points(long)
        gap = upper[:, 2].min() - lower[:, 2].max() - 3.0
        joint = np.array([0.0, 0.0, upper[:, 2].min()])
        lower = (lower + np.array([2.0, 0.0, gap]) - joint) @ bend.T + joint
        patella = small * [11.0, 5.0, 13.0] * rng.uniform(0.85, 1.15, 3) - 2.5 * bump_at(small, (0.5, -0.8, 0.2), 6.0)
        patella += joint + np.array([1.5, upper[:, 1].max() + 9.0, 24.0 + rng.normal(0, 2)])
        shapes.append(
            np.concatenate([deform_randomly(upper, 0.8, 15.0, rng), deform_randomly(lower, 0.8, 15.0, rng), patella])
        )
    return Registered(np.array(shapes), faces)


MAKERS: Mapping[str, Callable[[int, int], Registered]] = {"molars": molars, "leaves": leaves, "knees": knees}
