"""ZoomOut through pyfmaps (MIT): functional maps from spectral descriptors, then one frequency after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.experiments.adapters import library, need_meshes
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.surface import Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False)
class Spectrum:
    """A thinned mesh with its eigenfunctions, and where the original lies on it.

    Parameters
    ----------
    mesh : pyFM.mesh.TriMesh
        V_thin vertices, area 1.
    at : (V, k)
        The eigenfunctions at the original's vertices.
    original : (V_thin,)
        The original vertex nearest to each of the thinned mesh.
    """

    mesh: Any
    at: np.ndarray
    original: np.ndarray


@dataclass(frozen=True)
class ZoomOutMatcher:
    """HKS and WKS give a functional map of ``first`` functions, ZoomOut takes it to ``last`` in steps of ``step``.

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

    def fit(self, shape: Shape) -> Spectrum:
        """Thin, and find the eigenfunctions."""
        need_meshes("ZoomOut", shape)
        frame = sqrt_area_frame(shape)
        whole = Shape(frame.apply(shape.verts), shape.faces, shape.name, invalid=shape.invalid)
        thin = decimate(whole, self.faces)
        thin = Shape(*_used(thin), thin.name)
        with library("ZoomOut"):
            from pyFM.mesh import TriMesh

            mesh = TriMesh(np.array(thin.verts), np.array(thin.faces), area_normalize=True, center=True)
            mesh.process(k=self.last, robust=True)
        surface = Surface(thin.verts, thin.faces, thin.vertex_normals)
        foot = surface.query(whole.verts, whole.vertex_normals)
        at = interpolate(mesh.eigenvectors, thin.faces[foot.face], foot.barycentric)
        return Spectrum(mesh, at, cKDTree(whole.verts).query(thin.verts)[1])

    def map(self, source: Shape, source_fit: Spectrum, target: Shape, target_fit: Spectrum) -> VertexMap:
        """Fit the functional map from target to source, which pulls vertices from source to target; refine it."""
        first, second = target_fit.mesh, source_fit.mesh
        with library("ZoomOut"):
            from pyFM.functional import FunctionalMapping
            from pyFM.signatures import mesh_HKS
            from pyFM.spectral import FM_to_p2p

            model = FunctionalMapping(first, second)
            model.preprocess(
                self.descriptors, "WKS", subsample_step=5, k_process=self.last, k_descr=self.last
            )
            heat = [mesh_HKS(mesh, self.descriptors, k=self.last)[:, ::5] for mesh in (first, second)]
            model.add_descriptors(*heat)
            model.fit(K=(self.first, self.first), w_orient=self.orient)
            rounds = (self.last - self.first) // self.step
            refined = model.zoomout_refine(nit=rounds, step=self.step)
            index = FM_to_p2p(refined, first.eigenvectors, source_fit.at, n_jobs=1)
        return VertexMap.between(source, target, target_fit.original[index])


def _used(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) that faces use, and the faces in their numbers: a lone vertex makes the mass matrix singular."""
    used, faces = np.unique(shape.faces, return_inverse=True)
    return shape.verts[used], faces.reshape(-1, 3)
