"""What the benchmark measures: the interface of a method, this project behind it, and other methods.

Those that know no category and bend one shape onto the other begin with the same rigid alignment: both shapes scaled to
area 1 and centered, all orientations tried (`shapes.align`). The libraries do the work. One that gives up on a pair fails
that pair (`InputError`); a bug of ours stays a bug.
"""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, Protocol

import numpy as np

from meshmatch.api.inputs import as_model, repair_or_raise
from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import ON_NODES, FitConfig, LatentRefineConfig, Partial, Refine
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.fit_files import read_fit, write_fit
from meshmatch.maps.footpoints import Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import make_folder
from meshmatch.shapes.alignment import align, sqrt_area_frame
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

_SAMPLES = 2400
MONK_UNIT = 100.0
"""What sqrt(area) is for meshmonk, whose defaults are for faces in millimeters."""


class Method(Protocol):
    """What is measured: something that fits one shape, and makes a map of two fits. It must survive a pickle."""

    def fit(self, shape: Shape) -> Any:
        """Whatever is worth knowing about one shape."""

    def map(self, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        """The map between two shapes that were fitted."""


@dataclass(frozen=True)
class OurMethod:
    """This project with its options.

    ``kept``: a folder of fits, of this method alone; a shape that has one there is not fitted again.
    """

    model: str = "human"
    refine: Refine = "nodes"
    seed: int = 0
    partial: Partial = "auto"
    threads: int = 1
    kept: Path | None = None
    latent: LatentRefineConfig = field(default_factory=LatentRefineConfig)  # of the search over codes
    quick: bool = False

    def _matcher(self) -> Matcher:
        made = FitConfig.quick if self.quick else FitConfig
        config = made(refine=self.refine, seed=self.seed, partial=self.partial, latent=self.latent)
        return Matcher(self.model, config, self.threads)

    def fit(self, shape: Shape) -> Fit:
        """Fit the model's template to the shape; `MeshmatchError` of a kept fit of another template, or a damaged one."""
        path = None if self.kept is None else self.kept / f"{shape.hash}.safetensors"
        if path is not None and path.is_file():
            known, clean = read_fit(path, as_model(self.model).template), repair_or_raise(shape)
            return replace(known.fit, verts=clean.shape.verts, repaired=clean, seconds=float(known.words["seconds"]))
        fit = self._matcher().fit(shape)
        if path is not None:
            make_folder(path.parent)
            write_fit(path, fit, words={"seconds": fit.seconds})
        return fit

    def map(self, source: Shape, source_fit: Fit, target: Shape, target_fit: Fit) -> VertexMap:
        """Build the map from two fits."""
        return self._matcher().map(source_fit, target_fit, agree=self.refine in ON_NODES)


@dataclass(frozen=True)
class DirectMethod:
    """This project without a model: nothing is known of one shape alone."""

    seed: int = 0
    threads: int = 1

    def fit(self, shape: Shape) -> None:
        """Nothing."""

    def map(self, source: Shape, source_fit: None, target: Shape, target_fit: None) -> VertexMap:
        """The map of two shapes that are registered to each other."""
        return Matcher(NO_MODEL, FitConfig(seed=self.seed), self.threads).match(source, target).map


@dataclass(frozen=True)
class EarlierVersion:
    """`fit --model none` of both shapes and the map of these fits, as an earlier version did them: by its own commands, in a
    checkout of it."""

    checkout: Path

    def fit(self, shape: Shape) -> None:
        """Nothing."""

    def map(self, source: Shape, source_fit: None, target: Shape, target_fit: None) -> VertexMap:
        """Fit both, map."""
        with TemporaryDirectory() as folder:
            for name, shape in (("source", source), ("target", target)):
                save_shape(Path(folder) / f"{name}.ply", shape)
            self._run(folder, "fit", "source.ply", "target.ply", "--model", NO_MODEL, "--output", "fits", "--jobs", "1")
            self._run(folder, "map", "fits", "--to", "target", "--output", "maps", "--format", ".npy")
            index = np.load(Path(folder) / "maps/source/target.npy")
        return VertexMap.between(source, target, index)

    def _run(self, folder: str, *words: str) -> None:
        """`InputError` with the last line of what the command says, if it fails."""
        environment = {**os.environ, "PYTHONPATH": str(self.checkout.resolve())}
        command = [sys.executable, "-m", "meshmatch", *words, "--quiet"]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{words[0]} gave up: {' '.join(done.stderr.split())[-200:]}")


def in_frame(shape: Shape, frame: Frame) -> Shape:
    """The same shape, vertex by vertex, in another frame than its file's."""
    return replace(shape, verts=frame.apply(shape.verts))


def coded(model: str, steps: int = 2000, seed: int = 0) -> OurMethod:
    """3D-CODED, a model of ``meshmatch train --preset paper --field pointwise`` whose losses had no constraint (``--volume 0
    --arap 0 --blend 0``): its code is refined by the Chamfer distance alone.
    """
    latent = replace(LatentRefineConfig(steps=steps), volume=0.0, arap=0.0)
    return OurMethod(model, "latent", seed, "no", latent=latent)


@dataclass(frozen=True, eq=False)
class Placed:
    """A shape of area 1, centered, and samples of it; ``thin`` is the same with fewer triangles, where asked for."""

    whole: Shape
    thin: Shape
    samples: OrientedPoints


def placed(shape: Shape, seed: int = 0, faces: int | None = None) -> Placed:
    """Scale a shape to area 1, center it, sample it, and thin it to about so many faces."""
    frame = sqrt_area_frame(shape)
    drawn = sample_surface(shape, _SAMPLES, np.random.default_rng(seed))
    whole = in_frame(shape, frame)
    thin = whole if faces is None or whole.is_cloud else decimate(whole, faces)
    return Placed(whole, thin, drawn.in_frame(frame))


def turn_to(source: Placed, target: Placed) -> Frame:
    """The rigid motion that brings a source onto a target."""
    return align(source.samples, target.samples, "rigid")[0].pose.frame


def carried(source: Placed, moved: Float[Floats, "V_thin 3"]) -> Float[Floats, "V_src 3"]:
    """Where the whole source's vertices go when those of the thin one go to ``moved``."""
    thin = source.thin
    surface = Surface(thin.verts, thin.faces, thin.vertex_normals)
    foot = surface.query(source.whole.verts, source.whole.vertex_normals)
    return interpolate(moved, thin.faces[foot.face], foot.barycentric)


def need_meshes(name: str, shape: Shape) -> None:
    """Refuse clouds (`InputError`)."""
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
class Registration:
    """Rigid alignment, a registration of the source (thinned to ``faces``) onto the target, the nearest vertex.

    - rigid: no registration.
    - nricp: non-rigid ICP (Amberg et al. 2007) of trimesh with its own weights. Nearest points are the target's
      vertices: the nearest on its faces would take rtree. Landmarks are not given.
    - meshmonk: viscoelastic registration with its defaults; the target is thinned too.
    """

    kind: Literal["rigid", "nricp", "meshmonk"]
    faces: int | None = None
    seed: int = 0

    def fit(self, shape: Shape) -> Placed:
        """Scale, center, sample, thin."""
        if self.kind != "rigid":
            need_meshes(self.kind, shape)
        return placed(shape, self.seed, self.faces)

    def map(self, source: Shape, source_fit: Placed, target: Shape, target_fit: Placed) -> VertexMap:
        """Align, register."""
        turn = turn_to(source_fit, target_fit)
        if self.kind == "rigid":
            moved = turn.apply(source_fit.whole.verts)
        else:
            register = nricp if self.kind == "nricp" else viscoelastic
            thin, there = source_fit.thin, target_fit.thin if self.kind == "meshmonk" else target_fit.whole
            moved = carried(
                source_fit,
                register(
                    (turn.apply(thin.verts), thin.vertex_normals @ turn.rotation.T, thin.faces),
                    (there.verts, there.vertex_normals, there.faces),
                ),
            )
        if not np.isfinite(moved).all():
            raise InputError(f"{source.name}: the registration diverged")
        return VertexMap.between(source, target, cKDTree(target_fit.whole.verts).query(moved)[1])


Mesh = tuple[Floats, Floats, Ints]
"""Vertices (V, 3), unit normals (V, 3), faces (F, 3); of area 1."""


def nricp(floating: Mesh, target: Mesh) -> Float[Floats, "V 3"]:
    """trimesh: where the vertices of a floating mesh go."""
    import trimesh

    with library("nricp"):
        mesh = trimesh.Trimesh(floating[0], floating[2], process=False)
        moved = trimesh.registration.nricp_amberg(mesh, trimesh.PointCloud(target[0]), use_faces=False)
    return np.asarray(moved, float)


def viscoelastic(floating: Mesh, target: Mesh) -> Float[Floats, "V 3"]:
    """meshmonk: where the vertices of a floating mesh go."""
    import meshmonk

    with library("meshmonk"):
        found = meshmonk.nonrigid_register(
            floating_features=np.concatenate([MONK_UNIT * floating[0], floating[1]], 1).astype(np.float32),
            target_features=np.concatenate([MONK_UNIT * target[0], target[1]], 1).astype(np.float32),
            floating_faces=floating[2].astype(np.int32),
            target_faces=target[2].astype(np.int32),
        )
    return np.asarray(found.aligned_vertices, float) / MONK_UNIT


@dataclass(frozen=True, eq=False)
class Spectrum:
    """A thinned mesh of pyFM (V_thin vertices, area 1) with its eigenfunctions."""

    mesh: Any
    at: Float[Floats, "V k"]  # the eigenfunctions at the original's vertices
    original: Int[Ints, " V_thin"]  # the original vertex nearest to each of the thinned mesh


@dataclass(frozen=True)
class ZoomOut:
    """pyfmaps: HKS and WKS give a functional map of ``first`` functions; ZoomOut takes it to ``last`` by ``step``.

    Meshes of more than ``faces`` triangles are thinned to that first. Source vertices keep their exact place in the
    spectrum; targets are the vertices nearest to the thinned mesh's, so large targets cost about half an edge there.
    ``first`` and the weight of orientation were the best of seven choices on seven pairs of the benchmark.
    """

    faces: int = 10_000
    first: int = 30
    last: int = 120
    step: int = 5
    descriptors: int = 100
    orient: float = 1.0
    seed: int = 0

    def fit(self, shape: Shape) -> Spectrum:
        """Thin, and find the eigenfunctions."""
        need_meshes("ZoomOut", shape)
        whole = in_frame(shape, sqrt_area_frame(shape))
        thin = decimate(whole, self.faces)
        used, faces = np.unique(thin.faces, return_inverse=True)  # a lone vertex makes the mass matrix singular
        thin = Shape(thin.verts[used], faces.reshape(-1, 3), thin.name)
        with library("ZoomOut"):
            from pyFM.mesh import TriMesh

            mesh = TriMesh(np.array(thin.verts), np.array(thin.faces), area_normalize=True, center=True)
            mesh.process(k=self.last, robust=True)
        surface = Surface(thin.verts, thin.faces, thin.vertex_normals)
        foot = surface.query(whole.verts, whole.vertex_normals)
        at = interpolate(mesh.eigenvectors, thin.faces[foot.face], foot.barycentric)
        return Spectrum(mesh, at, cKDTree(whole.verts).query(thin.verts)[1])

    def map(self, source: Shape, source_fit: Spectrum, target: Shape, target_fit: Spectrum) -> VertexMap:
        """Fit the functional map from target to source, which pulls vertices from source to target, and refine it."""
        first, second = target_fit.mesh, source_fit.mesh
        with library("ZoomOut"):
            from pyFM.refine.zoomout import zoomout_refine
            from pyFM.spectral import FM_to_p2p

            coarse = self._described(first, second)
            rounds = (self.last - self.first) // self.step
            vectors = first.eigenvectors, second.eigenvectors
            refined = zoomout_refine(coarse, *vectors, rounds, self.step, A2=second.A, n_jobs=1)
            index = FM_to_p2p(refined, first.eigenvectors, source_fit.at, n_jobs=1)
        return VertexMap.between(source, target, target_fit.original[index])

    def _described(self, first: Any, second: Any) -> Float[Floats, "k k"]:
        """The functional map from one mesh to another that preserves their descriptors best."""
        from pyFM.functional import FunctionalMapping
        from pyFM.signatures import mesh_HKS

        model = FunctionalMapping(first, second)
        model.preprocess(self.descriptors, "WKS", subsample_step=5, k_process=self.last, k_descr=self.last)
        heat = [mesh_HKS(mesh, self.descriptors, k=self.last)[:, ::5] for mesh in (first, second)]
        model.add_descriptors(*heat)
        model.fit(K=(self.first, self.first), w_orient=self.orient)
        return np.asarray(model.FM)
