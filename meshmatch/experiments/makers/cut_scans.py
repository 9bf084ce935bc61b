"""Hands and heads that no training drew: other people, other triangles, cut at random, turned anywhere, clutter beside half;
of hands, which come in two sides, about half are mirror images: left ones.

Truth is a place of the whole body, the forearm or the shoulders included; a shape that ends before one lacks it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import Pair
from meshmatch.experiments.makers.other_triangles import other_triangles
from meshmatch.generators.cutouts import CutShapes
from meshmatch.generators.kinds import Kind
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.templates.sides import mirrored
from meshmatch.templates.template import Template

STUMPS = {"hand": "wrist", "head": "neck"}
"""The part of each kind that is cut, which does not count as its length."""
_SEED = 7001  # further from that of a training than anyone counts
_EVERY = 20  # vertex of the whole is a place where errors are measured
_NEAR = 0.02  # of the length: a place further from the surface is cut off, and a vertex further from the whole is none of it


@dataclass(frozen=True, eq=False)
class CutScan:
    """A shape, and the whole that it is cut from.

    ``places`` are the vertices of the whole where those of the shape lie (-1: on what is none of it); ``kept`` says which of
    the whole's the shape shows; ``length`` is that of the hand or head in the unit of the whole.
    """

    shape: Shape
    whole: Shape
    places: Int[Ints, " V"]
    kept: Bool[Bools, " W"]
    length: float
    mirrored: bool = False


def make_scans(kind: str, count: int, seed: int = 0) -> list[CutScan]:
    """So many of a kind; `OptionError` if the extra ``train`` is not installed."""
    made = Kind(kind, 64).generator(_SEED + seed)
    source, template = made.draw, made.template
    assert isinstance(source, CutShapes)
    wholes, cut = (each.double().numpy() for each in source.both(count, torch.Generator().manual_seed(_SEED + seed)))
    faces = source.faces.numpy()
    bodies = [Shape(verts, faces, f"whole {kind}-{k:02d}") for k, verts in enumerate(wholes)]
    scans = [
        _scan(template, bodies[k], cut[k], f"{kind}-{k:02d}", np.random.default_rng([seed, k])) for k in range(count)
    ]
    left = np.random.default_rng(_SEED + seed).random(count) < (0.5 if made.mirror == "auto" else 0.0)
    return [
        replace(scan, shape=mirrored(scan.shape), mirrored=True) if flag else scan
        for scan, flag in zip(scans, left, strict=True)
    ]


def _scan(template: Template, body: Shape, verts: Float[Floats, "V 3"], name: str, rng: np.random.Generator) -> CutScan:
    faces = np.asarray(template.shape.faces)
    length = length_of(template, verts)
    weights, fine = other_triangles(faces, len(verts))
    small = decimate(Shape(weights @ verts, fine, name), int(rng.uniform(0.8, 2.4) * len(faces)))
    weights, fine = other_triangles(np.asarray(body.faces), body.V)
    whole = Shape(weights @ body.verts, fine, body.name)
    surface = trimesh.Trimesh(small.verts, small.faces, process=False).sample(40_000, seed=0)
    kept = cKDTree(surface).query(whole.verts)[0] < _NEAR * length
    gap, places = cKDTree(whole.verts).query(small.verts)
    places = np.where(gap < _NEAR * length, places, -1)
    if rng.uniform() < 0.5:
        small = with_clutter(small, length, rng)
        places = np.pad(places, (0, small.V - len(places)), constant_values=-1)
    turn, unit = Rotation.random(random_state=rng).as_matrix(), 10.0 ** rng.uniform(-1, 3)
    shape = Shape(unit * (small.verts @ turn.T + rng.normal(size=3)), small.faces, name)
    return CutScan(shape, whole, places.astype(np.int64), kept, length)


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
    """Distances along the target's whole between matched and true places, in units of its length: of the source's vertices
    at every twentieth vertex of its whole, where the target shows it. What is matched to no place is a length off.
    """
    found: dict[Pair, np.ndarray] = {}
    for pair, made in maps.items():
        source, target = (scans[name] for name in pair)
        known = np.arange(0, target.whole.V, _EVERY)
        asked = (source.places >= 0) & (source.places % _EVERY == 0)
        at = np.flatnonzero(asked)
        at = at[target.kept[source.places[at]]]
        rows = TruthDistances(target.whole, known, cache).of(source.places[at] // _EVERY)
        matched = target.places[made.index[at]]
        apart = rows[np.arange(len(at)), matched] * (target.whole.area**0.5 / target.length)
        found[pair] = np.where(matched < 0, 1.0, apart)
    return found
