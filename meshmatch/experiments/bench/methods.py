"""Methods that the benchmark measures: their interface, this project, and methods of other libraries.

Methods without a category model that deform one shape onto the other start from the same rigid alignment: both shapes are
scaled to area 1 and centred, and all orientations are tried (`shapes.align`). An error of a library on a pair becomes an
`InputError`, a failure of that pair; other exceptions are raised.
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
"""Value of sqrt(area) for meshmonk, whose defaults are meant for faces in millimetres."""


class Method(Protocol):
    """A method that fits single shapes and maps pairs of fits; must be picklable."""

    def fit(self, shape: Shape) -> Any:
        """Compute what depends on one shape alone."""

    def map(self, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        """Map one fitted shape to another."""


@dataclass(frozen=True)
class OurMethod:
    """This project with its options.

    ``kept`` is a folder of fits by this method with these options; a shape with a fit there is not fitted again.
    """

    model: str = "human"
    refine: Refine = "nodes"
    seed: int = 0
    partial: Partial = "auto"
    threads: int = 1
    kept: Path | None = None
    latent: LatentRefineConfig = field(default_factory=LatentRefineConfig)  # refinement of the latent code
    quick: bool = False

    def _matcher(self) -> Matcher:
        made = FitConfig.quick if self.quick else FitConfig
        config = made(refine=self.refine, seed=self.seed, partial=self.partial, latent=self.latent)
        return Matcher(self.model, config, self.threads)

    def fit(self, shape: Shape) -> Fit:
        """Fit the model's template to the shape; `MeshmatchError` if a stored fit is damaged or has another template."""
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
    """This project without a model: there are no fits of single shapes."""

    seed: int = 0
    threads: int = 1

    def fit(self, shape: Shape) -> None:
        """Do nothing."""

    def map(self, source: Shape, source_fit: None, target: Shape, target_fit: None) -> VertexMap:
        """Register two shapes to each other and return the map."""
        return Matcher(NO_MODEL, FitConfig(seed=self.seed), self.threads).match(source, target).map


@dataclass(frozen=True)
class EarlierVersion:
    """An earlier version of this project, run by its commands `fit --model none` and `map` in a checkout."""

    checkout: Path

    def fit(self, shape: Shape) -> None:
        """Do nothing."""

    def map(self, source: Shape, source_fit: None, target: Shape, target_fit: None) -> VertexMap:
        """Fit both shapes and map one to the other."""
        with TemporaryDirectory() as folder:
            for name, shape in (("source", source), ("target", target)):
                save_shape(Path(folder) / f"{name}.ply", shape)
            self._run(folder, "fit", "source.ply", "target.ply", "--model", NO_MODEL, "--output", "fits", "--jobs", "1")
            self._run(folder, "map", "fits", "--to", "target", "--output", "maps", "--format", ".npy")
            index = np.load(Path(folder) / "maps/source/target.npy")
        return VertexMap.between(source, target, index)

    def _run(self, folder: str, *words: str) -> None:
        """Run a command; `InputError` with the end of its stderr if it fails."""
        environment = {**os.environ, "PYTHONPATH": str(self.checkout.resolve())}
        command = [sys.executable, "-m", "meshmatch", *words, "--quiet"]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"{words[0]} gave up: {' '.join(done.stderr.split())[-200:]}")


def in_frame(shape: Shape, frame: Frame) -> Shape:
    """Transform the vertices of a shape from its file's coordinates to a frame."""
    return replace(shape, verts=frame.apply(shape.verts))


def coded(model: str, steps: int = 2000, seed: int = 0) -> OurMethod:
    """Return 3D-CODED as a method: the code is refined by the Chamfer distance alone.

    ``model`` was trained by ``meshmatch train --preset paper --field pointwise`` without regularisation (``--volume 0
    --arap 0 --blend 0``).
    """
    latent = replace(LatentRefineConfig(steps=steps), volume=0.0, arap=0.0)
    return OurMethod(model, "latent", seed, "no", latent=latent)


@dataclass(frozen=True, eq=False)
class NormalizedShape:
    """A centred shape of area 1, a decimated copy of it (``thin``; the same if not decimated), and samples."""

    whole: Shape
    thin: Shape
    samples: OrientedPoints


def normalize_shape(shape: Shape, seed: int = 0, faces: int | None = None) -> NormalizedShape:
    """Scale a shape to area 1, center it, sample it, and decimate it to about ``faces`` faces."""
    frame = sqrt_area_frame(shape)
    drawn = sample_surface(shape, _SAMPLES, np.random.default_rng(seed))
    whole = in_frame(shape, frame)
    thin = whole if faces is None or whole.is_cloud else decimate(whole, faces)
    return NormalizedShape(whole, thin, drawn.in_frame(frame))


def align_rigidly(source: NormalizedShape, target: NormalizedShape) -> Frame:
    """Find the rigid motion that aligns a source with a target."""
    return align(source.samples, target.samples, "rigid")[0].pose.frame


def interpolate_thin(source: NormalizedShape, moved: Float[Floats, "V_thin 3"]) -> Float[Floats, "V_src 3"]:
    """Interpolate positions of the decimated source's vertices at the vertices of the whole source."""
    thin = source.thin
    surface = Surface(thin.verts, thin.faces, thin.vertex_normals)
    foot = surface.query(source.whole.verts, source.whole.vertex_normals)
    return interpolate(moved, thin.faces[foot.face], foot.barycentric)


def need_meshes(name: str, shape: Shape) -> None:
    """Raise `InputError` for point clouds."""
    if shape.is_cloud:
        raise InputError(f"{name} needs triangles: {shape.name} is a point cloud")


@contextmanager
def library(name: str) -> Iterator[None]:
    """Context for calls of a library: failures become `InputError`; warnings and stderr are suppressed."""
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
    """Rigid alignment, registration of the source (decimated to ``faces``) onto the target, and nearest vertices.

    - rigid: no registration.
    - nricp: non-rigid ICP (Amberg et al. 2007) of trimesh with its own weights. Nearest points are target
      vertices; nearest points on faces would need rtree. No landmarks are given.
    - meshmonk: viscoelastic registration with its defaults; the target is decimated too.
    """

    kind: Literal["rigid", "nricp", "meshmonk"]
    faces: int | None = None
    seed: int = 0

    def fit(self, shape: Shape) -> NormalizedShape:
        """Scale, center, sample and decimate."""
        if self.kind != "rigid":
            need_meshes(self.kind, shape)
        return normalize_shape(shape, self.seed, self.faces)

    def map(self, source: Shape, source_fit: NormalizedShape, target: Shape, target_fit: NormalizedShape) -> VertexMap:
        """Align, register, and map to nearest vertices."""
        turn = align_rigidly(source_fit, target_fit)
        if self.kind == "rigid":
            moved = turn.apply(source_fit.whole.verts)
        else:
            register = nricp if self.kind == "nricp" else viscoelastic
            thin, there = source_fit.thin, target_fit.thin if self.kind == "meshmonk" else target_fit.whole
            moved = interpolate_thin(
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
    """Register a floating mesh by trimesh's non-rigid ICP; return its deformed vertices."""
    import trimesh

    with library("nricp"):
        mesh = trimesh.Trimesh(floating[0], floating[2], process=False)
        moved = trimesh.registration.nricp_amberg(mesh, trimesh.PointCloud(target[0]), use_faces=False)
    return np.asarray(moved, float)


def viscoelastic(floating: Mesh, target: Mesh) -> Float[Floats, "V 3"]:
    """Register a floating mesh by meshmonk; return its deformed vertices."""
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
    """A decimated mesh of pyFM (V_thin vertices, area 1) with its eigenfunctions."""

    mesh: Any
    at: Float[Floats, "V k"]  # eigenfunctions at the vertices of the original mesh
    original: Int[Ints, " V_thin"]  # nearest original vertex of each vertex of the decimated mesh


@dataclass(frozen=True)
class ZoomOut:
    """Functional maps by pyfmaps: fitted to HKS and WKS at size ``first``, upsampled by ZoomOut to ``last`` by ``step``.

    Meshes of more than ``faces`` triangles are decimated to that first. Source vertices have exact spectral coordinates;
    targets are the vertices nearest to those of the decimated mesh, which costs about half an edge of it on large targets.
    ``first`` and the weight ``orient`` were the best of seven choices on seven pairs of the benchmark.
    """

    faces: int = 10_000
    first: int = 30
    last: int = 120
    step: int = 5
    descriptors: int = 100
    orient: float = 1.0
    seed: int = 0

    def fit(self, shape: Shape) -> Spectrum:
        """Decimate the mesh and compute its eigenfunctions."""
        need_meshes("ZoomOut", shape)
        whole = in_frame(shape, sqrt_area_frame(shape))
        thin = decimate(whole, self.faces)
        # Unreferenced vertices would make the mass matrix singular.
        used, faces = np.unique(thin.faces, return_inverse=True)
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
        """Fit the functional map from target to source, refine it, and convert it to a vertex map from source to target."""
        first, second = target_fit.mesh, source_fit.mesh
        with library("ZoomOut"):
            from pyFM.refine.zoomout import zoomout_refine
            from pyFM.spectral import FM_to_p2p

            coarse = self._fit_descriptors(first, second)
            rounds = (self.last - self.first) // self.step
            vectors = first.eigenvectors, second.eigenvectors
            refined = zoomout_refine(coarse, *vectors, rounds, self.step, A2=second.A, n_jobs=1)
            index = FM_to_p2p(refined, first.eigenvectors, source_fit.at, n_jobs=1)
        return VertexMap.between(source, target, target_fit.original[index])

    def _fit_descriptors(self, first: Any, second: Any) -> Float[Floats, "k k"]:
        """Fit the functional map between two meshes to their descriptors."""
        from pyFM.functional import FunctionalMapping
        from pyFM.signatures import mesh_HKS

        model = FunctionalMapping(first, second)
        model.preprocess(self.descriptors, "WKS", subsample_step=5, k_process=self.last, k_descr=self.last)
        heat = [mesh_HKS(mesh, self.descriptors, k=self.last)[:, ::5] for mesh in (first, second)]
        model.add_descriptors(*heat)
        model.fit(K=(self.first, self.first), w_orient=self.orient)
        return np.asarray(model.FM)
