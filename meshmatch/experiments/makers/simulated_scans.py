"""Scans that may be shown: generated bodies as a ring of cameras sees them, with noise and holes.

Pictures of scanned people are not for everybody; these are of nobody. A surface is left where enough cameras see it, so
that armpits, crotch, soles and what an arm hides are holes, with ragged edges where few cameras do. Noise is along the
normals.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.experiments.bench.partial import seen_faces
from meshmatch.experiments.makers.human_bodies import unseen_bodies
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import read_template

CAMERAS, ENOUGH = 8, 2
NOISE = 0.0015  # of the bounding box's diagonal: 3 mm on a person
_HEIGHTS = (-0.15, 0.45)  # of the cameras' directions, by turns: from below the middle and from above


def ring(cameras: int = CAMERAS) -> Float[Floats, "C 3"]:
    """Directions from a body, y up, to cameras around it."""
    angle = 2 * np.pi * np.arange(cameras) / cameras + 0.2
    height = np.resize(_HEIGHTS, cameras)
    direction = np.stack([np.sin(angle), height, np.cos(angle)], axis=1)
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


def scanned(body: Shape, seed: int) -> Shape:
    """What the cameras see of a body: its faces that enough of them do, with noise."""
    centers = body.verts[body.faces].mean(axis=1)
    views = np.sum([seen_faces(body, centers, direction) for direction in ring()], axis=0)
    faces = body.faces[views >= ENOUGH]
    used = np.unique(faces)
    rng = np.random.default_rng(seed)
    off = NOISE * body.diagonal * rng.standard_normal((len(used), 1))
    return Shape(body.verts[used] + off * body.vertex_normals[used], np.searchsorted(used, faces), body.name)


def simulated_scans(count: int, seed: int = 0) -> list[tuple[Shape, Shape]]:
    """So many generated bodies that no training drew, metres, y up, and the scan of each."""
    template = read_template("human-T")
    bodies = unseen_bodies(template, count, seed=seed)
    found = []
    for number, verts in enumerate(bodies):
        body = Shape(verts, template.shape.faces, f"body {number + 1}")
        found.append((body, scanned(body, seed + number)))
    return found
