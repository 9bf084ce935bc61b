"""Test scans of hands and heads with ground truth: new identities, other triangles, random cuts and orientations.

Half of them have clutter. About half of the hands are mirrored, that is left hands. The ground truth is a place on the whole
body part, including the forearm or the shoulders; shapes that are cut before it do not show it.
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
from meshmatch.templates.mirror_images import mirrored
from meshmatch.templates.template import Template

STUMPS = {"hand": "wrist", "head": "neck"}
"""The part of each kind that is cut; it is excluded from the length."""
_SEED = 7001  # seed offset, to differ from the seeds of trainings
_EVERY = 20  # errors are measured at every 20th vertex of the whole
# Distance, as a fraction of the length, above which a vertex of the whole is cut off, or a vertex of the scan is clutter.
_MAX_DISTANCE = 0.02


@dataclass(frozen=True, eq=False)
class CutScan:
    """A shape, and the whole from which it was cut.

    ``places`` are the vertices of the whole that correspond to those of the shape (-1 on clutter); ``kept`` is whether the
    shape shows each vertex of the whole; ``length`` is that of the hand or head in the units of the whole.
    """

    shape: Shape
    whole: Shape
    places: Int[Ints, " V"]
    kept: Bool[Bools, " W"]
    length: float
    mirrored: bool = False


def make_scans(kind: str, count: int, seed: int = 0) -> list[CutScan]:
    """Make ``count`` scans of a kind; `OptionError` if the extra ``train`` is not installed."""
    generator = Kind(kind, 64).generator(_SEED + seed)
    source, template = generator.draw, generator.template
    assert isinstance(source, CutShapes)
    wholes, cut = (
        each.double().numpy() for each in source.draw_with_uncut(count, torch.Generator().manual_seed(_SEED + seed))
    )
    faces = source.faces.numpy()
    bodies = [Shape(verts, faces, f"whole {kind}-{k:02d}") for k, verts in enumerate(wholes)]
    scans = [
        _scan(template, bodies[k], cut[k], f"{kind}-{k:02d}", np.random.default_rng([seed, k])) for k in range(count)
    ]
    left = np.random.default_rng(_SEED + seed).random(count) < (0.5 if generator.mirror == "auto" else 0.0)
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
    kept = cKDTree(surface).query(whole.verts)[0] < _MAX_DISTANCE * length
    gap, places = cKDTree(whole.verts).query(small.verts)
    places = np.where(gap < _MAX_DISTANCE * length, places, -1)
    if rng.uniform() < 0.5:
        small = with_clutter(small, length, rng)
        places = np.pad(places, (0, small.V - len(places)), constant_values=-1)
    rotation, unit = Rotation.random(random_state=rng).as_matrix(), 10.0 ** rng.uniform(-1, 3)
    shape = Shape(unit * (small.verts @ rotation.T + rng.normal(size=3)), small.faces, name)
    return CutScan(shape, whole, places.astype(np.int64), kept, length)


def length_of(template: Template, verts: Float[Floats, "V 3"]) -> float:
    """Length from the wrist to the fingertips, or from the chin to the crown, in the rest pose.

    It is that of the template, scaled by the size of the core (palm or skull).
    """
    rest_verts, core = template.shape.verts, template.core
    stump = template.label_names.index(STUMPS[template.name])
    size = np.linalg.norm(verts[core] - verts[core].mean(0)) / np.linalg.norm(
        rest_verts[core] - rest_verts[core].mean(0)
    )
    return float(size * np.ptp(rest_verts[template.labels != stump, 1]))


def with_clutter(shape: Shape, length: float, rng: np.random.Generator) -> Shape:
    """Add a box, rod or plate near a random vertex of the shape; its vertices come last."""
    sides = length * 0.03 * 10 ** rng.uniform(0, 1, 3)
    box = trimesh.creation.box(sides).subdivide().subdivide().subdivide()
    rotated = box.vertices @ Rotation.random(random_state=rng).as_matrix().T
    at = int(rng.integers(shape.V))
    position = shape.verts[at] + 0.5 * sides.max() * shape.vertex_normals[at]
    verts = np.concatenate([shape.verts, rotated + position])
    return Shape(verts, np.concatenate([shape.faces, box.faces + shape.V]), shape.name)


def scan_errors(
    scans: Mapping[str, CutScan], maps: Mapping[Pair, VertexMap], cache: Path | None
) -> dict[Pair, np.ndarray]:
    """Geodesic errors on the target's whole, in units of its length.

    They are measured at source vertices that correspond to every 20th vertex of the whole and are visible on the target. A
    match on clutter counts as an error of one length.
    """
    errors: dict[Pair, np.ndarray] = {}
    for pair, map_ in maps.items():
        source, target = (scans[name] for name in pair)
        tested_vertices = np.arange(0, target.whole.V, _EVERY)
        is_tested = (source.places >= 0) & (source.places % _EVERY == 0)
        at = np.flatnonzero(is_tested)
        at = at[target.kept[source.places[at]]]
        rows = TruthDistances(target.whole, tested_vertices, cache).of(source.places[at] // _EVERY)
        matched = target.places[map_.index[at]]
        distances = rows[np.arange(len(at)), matched] * (target.whole.area**0.5 / target.length)
        errors[pair] = np.where(matched < 0, 1.0, distances)
    return errors
