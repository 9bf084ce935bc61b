"""A collection of aligned shapes registered to each other without training: each is the template once.

Each template is fitted to all others without a network (`meshmatch.fitting.viscous`). Of the maps of a pair
through all templates the median is taken on the target, where errors along the surface are partly independent, and then
the nearest vertex that faces the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.sets import Pair
from meshmatch.fields.shape_functions import build_field
from meshmatch.fitting.system import NodeSystem
from meshmatch.fitting.viscous import ViscousConfig, viscous_vectors
from meshmatch.geometry.oriented import with_normals
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.maps.footpoints import Footpoints, Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.normalise import align, sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, choose_nodes, low_mesh

Shapes = Mapping[str, Shape]
_ALIGNED_BY = 2400  # samples
_NORMAL_WEIGHT = 0.0075  # of normals where the nearest vertex is looked for, units of sqrt(area)
_FOOT_NORMALS = 0.5  # how much normals count where footpoints are, beside a map of bodies


def aligned(shapes: Shapes, first: str, seed: int = 0) -> dict[str, Shape]:
    """All shapes at area 1, turned to one of them as scans of one machine are (`align`: near)."""
    frames = {name: sqrt_area_frame(shape) for name, shape in shapes.items()}
    seen = {
        name: sample_surface(shape, _ALIGNED_BY, np.random.default_rng(seed)).in_frame(frames[name])
        for name, shape in shapes.items()
    }
    found = {}
    for name, shape in shapes.items():
        verts = frames[name].apply(shape.verts)
        if name != first:
            verts = align(seen[name], seen[first], "near")[0].pose.to_local(verts)
        found[name] = Shape(verts, shape.faces, name)
    return found


def thinned(shape: Shape, faces: int) -> Shape:
    """A shape as a template, with about so many triangles."""
    keep, corners = low_mesh(shape, faces)
    return Shape(shape.verts[keep], corners, shape.name)


def system_of(thin: Shape, config: ViscousConfig) -> NodeSystem:
    """A template with nodes anywhere near its surface."""
    nodes = choose_nodes(thin, NodeConfig("uniform", config.nodes, config.radius, 0.01, seed=config.seed))
    return NodeSystem(thin, build_field(thin.verts, nodes, config.radius, "smooth"))


@dataclass(frozen=True, eq=False)
class Registered:
    """One template on all shapes: its vertices (V, 3) on each, and where the vertices of each lie on it."""

    faces: Int[Ints, "F 3"]
    places: Mapping[str, Floats]
    feet: Mapping[str, Footpoints]

    @classmethod
    def of(cls, shapes: Shapes, places: Mapping[str, Floats], faces: Int[Ints, "F 3"]) -> Registered:
        """Find the feet."""
        feet = {}
        for name, shape in shapes.items():
            normals = _FOOT_NORMALS * vertex_normals(places[name], faces)
            feet[name] = Surface(places[name], faces, normals).query(shape.verts, _FOOT_NORMALS * shape.vertex_normals)
        return cls(faces, places, feet)

    def carried(self, source: str, target: str) -> Float[Floats, "V_src 3"]:
        """Where the vertices of one shape lie on another one."""
        return self.feet[source].values(self.faces, self.places[target])


def registered(shapes: Shapes, template: str, config: ViscousConfig, kept: Path) -> Registered:
    """One shape as the template of all, each fit kept as a file."""
    runner.once(kept / f"{template}.json", asdict(config), lambda: runner.circumstances(1))
    thin = thinned(shapes[template], config.faces)
    system, places = None, {template: np.asarray(thin.verts)}
    for name in (each for each in shapes if each != template):
        file = kept / f"{template}-{name}.npy"
        if not file.is_file():
            runner.tell(f"fitting {template} to {name}")
            system = system or system_of(thin, config)
            samples = sample_surface(shapes[name], config.samples, np.random.default_rng(config.seed + 1))
            np.save(file, system.moved(viscous_vectors(system, samples, config)))
        places[name] = np.load(file, allow_pickle=False)
    return Registered.of(shapes, places, np.asarray(thin.faces))


def collection_maps(
    shapes: Shapes, first: str, config: ViscousConfig, kept: Path, templates: Sequence[str] = ()
) -> dict[Pair, VertexMap]:
    """Maps of all ordered pairs: the median over templates (by default all shapes) of where each vertex goes."""
    there = aligned(shapes, first, config.seed)
    used = list(templates) or list(shapes)
    known = [registered(there, name, config, kept) for name in used]
    # the shapes stand alike, so their normals may be compared: a sheet of a wall is not the other one
    normals = {name: shape.vertex_normals for name, shape in there.items()}
    trees = {name: cKDTree(with_normals(shape.verts, normals[name], _NORMAL_WEIGHT)) for name, shape in there.items()}
    maps = {}
    for a, b in permutations(shapes, 2):
        points = np.median([each.carried(a, b) for each in known], axis=0)
        index = trees[b].query(with_normals(points, normals[a], _NORMAL_WEIGHT))[1]
        maps[a, b] = VertexMap.between(shapes[a], shapes[b], index)
    return maps
