"""Rivals that bend one shape onto the other, each behind the benchmark's `Matcher`; the libraries do the work.

All begin with the same rigid alignment: both shapes scaled to area 1 and centred, all orientations tried
(`shapes.align`). A library that gives up on a pair fails that pair (`InputError`); a bug of ours stays a bug.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.errors import InputError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.latent import LatentRefineConfig
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.surface import Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.pipeline import map_between, read_model, usable
from meshmatch.shapes.align import align
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

_SAMPLES = 2400
MONK_UNIT = 100.0
"""What sqrt(area) is for meshmonk, whose defaults are for faces in millimetres."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A shape of area 1, centred, and samples of it; ``thin`` is the same with fewer triangles, where one is asked for."""

    whole: Shape
    thin: Shape
    samples: OrientedPoints


def placed(shape: Shape, seed: int = 0, faces: int | None = None) -> Placed:
    """Scale and center a shape, sample it, and thin it to about so many faces."""
    frame = sqrt_area_frame(shape)
    drawn = sample_surface(shape, _SAMPLES, np.random.default_rng(seed))
    whole = Shape(frame.apply(shape.verts), shape.faces, shape.name, invalid=shape.invalid)
    thin = whole if faces is None or whole.is_cloud else decimate(whole, faces)
    return Placed(whole, thin, drawn.in_frame(frame))


def turn_to(source: Placed, target: Placed) -> Frame:
    """The rigid motion that lays a source on a target."""
    best = align(source.samples, target.samples, "rigid")[0]
    return best.pose.frame


def nearest_map(source: Shape, target: Shape, moved: np.ndarray, there: Placed) -> VertexMap:
    """From where the source's vertices (V_src, 3) came to lie, each to the nearest vertex of the placed target."""
    if not np.isfinite(moved).all():
        raise InputError(f"{source.name}: the registration went astray")
    return VertexMap.between(source, target, cKDTree(there.whole.verts).query(moved)[1])


def carried(source: Placed, moved: np.ndarray) -> np.ndarray:
    """Where the whole source's vertices (V_src, 3) go when those of the thin one go to ``moved`` (V_thin, 3)."""
    thin = source.thin
    surface = Surface(thin.verts, thin.faces, thin.vertex_normals)
    foot = surface.query(source.whole.verts, source.whole.vertex_normals)
    return interpolate(moved, thin.faces[foot.face], foot.barycentric)


def need_meshes(name: str, *shapes: Shape) -> None:
    """Refuse clouds (`InputError`)."""
    for shape in shapes:
        if shape.is_cloud:
            raise InputError(f"{name} needs triangles: {shape.name} is a point cloud")


@contextmanager
def library(name: str) -> Iterator[None]:
    """What a library does with its input: failures become `InputError`, its warnings and words go nowhere."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (ValueError, ArithmeticError, RuntimeError, IndexError) as error:
        raise InputError(f"{name} gave up: {error or type(error).__name__}") from error
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@dataclass(frozen=True)
class RigidMatcher:
    """Rigid alignment, then the nearest vertex."""

    seed: int = 0

    def fit(self, shape: Shape) -> Placed:
        """Scale, center, sample."""
        return placed(shape, self.seed)

    def map(self, source: Shape, source_fit: Placed, target: Shape, target_fit: Placed) -> VertexMap:
        """Turn the source to the target."""
        moved = turn_to(source_fit, target_fit).apply(source_fit.whole.verts)
        return nearest_map(source, target, moved, target_fit)


@dataclass(frozen=True)
class NricpMatcher:
    """Non-rigid ICP (Amberg et al. 2007) of trimesh with its own weights, of the thinned source onto the target.

    Nearest points are the target's vertices: the nearest on its faces would take rtree. Landmarks are not given.
    """

    faces: int = 5000
    seed: int = 0

    def fit(self, shape: Shape) -> Placed:
        """Scale, center, sample, thin."""
        need_meshes("nricp", shape)
        return placed(shape, self.seed, self.faces)

    def map(self, source: Shape, source_fit: Placed, target: Shape, target_fit: Placed) -> VertexMap:
        """Align, register."""
        import trimesh

        turn = turn_to(source_fit, target_fit)
        thin = source_fit.thin
        with library("nricp"):
            moved = trimesh.registration.nricp_amberg(
                trimesh.Trimesh(turn.apply(thin.verts), thin.faces, process=False),
                trimesh.PointCloud(target_fit.whole.verts),
                use_faces=False,
            )
        return nearest_map(source, target, carried(source_fit, np.asarray(moved, float)), target_fit)


@dataclass(frozen=True)
class MeshmonkMatcher:
    """meshmonk's viscoelastic registration with its defaults, of the source onto the target, both thinned if large."""

    faces: int = 20_000
    seed: int = 0

    def fit(self, shape: Shape) -> Placed:
        """Scale, center, sample, thin."""
        need_meshes("meshmonk", shape)
        return placed(shape, self.seed, self.faces)

    def map(self, source: Shape, source_fit: Placed, target: Shape, target_fit: Placed) -> VertexMap:
        """Align, register."""
        turn = turn_to(source_fit, target_fit)
        thin, there = source_fit.thin, target_fit.thin
        moved = viscoelastic(
            (turn.apply(thin.verts), thin.vertex_normals @ turn.rotation.T, thin.faces),
            (there.verts, there.vertex_normals, there.faces),
        )
        return nearest_map(source, target, carried(source_fit, moved), target_fit)


Parts = tuple[np.ndarray, np.ndarray, np.ndarray]


def viscoelastic(floating: Parts, target: Parts) -> np.ndarray:
    """meshmonk: where the vertices (V, 3) of a floating mesh go; meshes as (vertices, unit normals, faces), area 1."""
    import meshmonk

    with library("meshmonk"):
        found = meshmonk.nonrigid_register(
            floating_features=np.concatenate([MONK_UNIT * floating[0], floating[1]], 1).astype(np.float32),
            target_features=np.concatenate([MONK_UNIT * target[0], target[1]], 1).astype(np.float32),
            floating_faces=floating[2].astype(np.int32),
            target_faces=target[2].astype(np.int32),
        )
    return np.asarray(found.aligned_vertices, float) / MONK_UNIT


@dataclass(frozen=True)
class CodedMatcher:
    """3D-CODED: a model with a pointwise decoder, its code refined by the Chamfer distance alone.

    ``model`` is a folder that `meshmatch.experiments.coded` wrote: its losses had no constraint.
    """

    model: str
    steps: int = 2000
    seed: int = 0

    def fit(self, shape: Shape) -> Fit:
        """Orient, predict, search the code."""
        latent = replace(LatentRefineConfig(steps=self.steps), volume=0.0, arap=0.0)
        config = FitConfig(refine="latent", seed=self.seed, partial="no", latent=latent)
        return Fitter(read_model(self.model), config).fit(usable(shape).shape)

    def map(self, source: Shape, source_fit: Fit, target: Shape, target_fit: Fit) -> VertexMap:
        """Through the template."""
        return map_between(source, source_fit, target, target_fit)
