"""Hands and heads that no training drew: other people, other triangles, cut at random, turned anywhere, clutter beside half;
of hands, which come in two sides, about half are mirror images: left ones.

Landmarks are places of the whole body, the forearm or the shoulders included; a shape that ends before one lacks it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments.other_triangles import other_triangles
from meshmatch.experiments.scores import TruthDistances
from meshmatch.experiments.sets import Pair
from meshmatch.generators.cutouts import CutShapes
from meshmatch.generators.kinds import Kind
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.templates.sides import mirrored
from meshmatch.templates.template import Template

STUMPS = {"hand": "wrist", "head": "neck"}
"""The part of each kind that is cut, which does not count as its length."""
_SEED = 7001  # further from that of a training than anyone counts
_LANDMARKS = 300
_NEAR = 0.02  # of the length: a landmark further from the surface is cut off


@dataclass(frozen=True, eq=False)
class CutScan:
    """A shape, the vertex at each landmark (-1: cut off), and the length of the hand or head in the shape's unit."""

    shape: Shape
    landmarks: Int[Ints, " L"]
    length: float
    mirrored: bool = False


def make_scans(kind: str, count: int, seed: int = 0) -> list[CutScan]:
    """So many of a kind; `OptionError` if the extra ``train`` is not installed."""
    made = Kind(kind, 64).generator(_SEED + seed)
    source, template = made.draw, made.template
    assert isinstance(source, CutShapes)
    whole, cut = (each.double().numpy() for each in source.both(count, torch.Generator().manual_seed(_SEED + seed)))
    marks = farthest_points(whole[0], _LANDMARKS)
    scans = [
        _scan(template, verts, places[marks], f"{kind}-{number:02d}", np.random.default_rng([seed, number]))
        for number, (places, verts) in enumerate(zip(whole, cut, strict=True))
    ]
    left = np.random.default_rng(_SEED + seed).random(count) < (0.5 if made.mirror == "auto" else 0.0)
    return [
        replace(scan, shape=mirrored(scan.shape), mirrored=True) if flag else scan
        for scan, flag in zip(scans, left, strict=True)
    ]


def _scan(
    template: Template, verts: Float[Floats, "V 3"], places: Float[Floats, "L 3"], name: str, rng: np.random.Generator
) -> CutScan:
    faces = np.asarray(template.shape.faces)
    length = length_of(template, verts)
    weights, fine = other_triangles(faces, len(verts))
    small = decimate(Shape(weights @ verts, fine, name), int(rng.uniform(0.8, 2.4) * len(faces)))
    own = cKDTree(trimesh.Trimesh(small.verts, small.faces, process=False).sample(40_000, seed=0)).query(places)[0]
    marks = np.where(own < _NEAR * length, cKDTree(small.verts).query(places)[1], -1)
    if rng.uniform() < 0.5:
        small = with_clutter(small, length, rng)
    turn, unit = Rotation.random(random_state=rng).as_matrix(), 10.0 ** rng.uniform(-1, 3)
    shape = Shape(unit * (small.verts @ turn.T + rng.normal(size=3)), small.faces, name)
    return CutScan(shape, marks.astype(np.int64), unit * length)


def length_of(template: Template, verts: Float[Floats, "V 3"]) -> float:
    """From the wrist to the tips of the fingers, or from the chin to the crown, were the shape at rest: its palm, or
    skull, says how large it is."""
    resting, core = template.shape.verts, template.core
    stump = template.label_names.index(STUMPS[template.name])
    size = np.linalg.norm(verts[core] - verts[core].mean(0)) / np.linalg.norm(resting[core] - resting[core].mean(0))
    return float(size * np.ptp(resting[template.labels != stump, 1]))


def with_clutter(shape: Shape, length: float, rng: np.random.Generator) -> Shape:
    """The shape with a box, a rod or a plate beside it that touches it somewhere; its vertices come last."""
    sides = length * 0.03 * 10 ** rng.uniform(0, 1, 3)
    thing = trimesh.creation.box(sides).subdivide().subdivide().subdivide()
    turned = thing.vertices @ Rotation.random(random_state=rng).as_matrix().T
    at = int(rng.integers(shape.V))
    place = shape.verts[at] + 0.5 * sides.max() * shape.vertex_normals[at]
    verts = np.concatenate([shape.verts, turned + place])
    return Shape(verts, np.concatenate([shape.faces, thing.faces + shape.V]), shape.name)


def scan_errors(
    scans: Mapping[str, CutScan], maps: Mapping[Pair, VertexMap], cache: Path | None
) -> dict[Pair, np.ndarray]:
    """Distances along the target at every landmark that both shapes have, in units of the target's length."""
    found: dict[Pair, np.ndarray] = {}
    for target in sorted({b for _, b in maps}):
        scan = scans[target]
        has = scan.landmarks >= 0
        mine = [pair for pair in maps if pair[1] == target]
        predicted = [np.where(scans[a].landmarks >= 0, maps[a, b].index[scans[a].landmarks], 0)[has] for a, b in mine]
        errors = TruthDistances(scan.shape, scan.landmarks[has], cache).errors(predicted)
        for pair, values in zip(mine, errors, strict=True):
            common = scans[pair[0]].landmarks[has] >= 0
            found[pair] = values[common] * float(np.sqrt(scan.shape.area)) / scan.length
    return found
