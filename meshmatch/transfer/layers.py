"""Baking of the layers besides color: those of a source's finish, each an image on the same coordinates.

Normals are directions in a tangent frame: along u, against v, and outwards. From source to target the tangential part is
rotated from the frame at the point of the source to that of the target's point, pushed onto the source by the map (the
nearest rotation, or reflection where the coordinates of one of them are mirrored).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Floats, Floats32, Ints, Ints32
from meshmatch.geometry.triangles import cross_product
from meshmatch.shapes.appearance import Appearance, Finish, Pixels
from meshmatch.shapes.colors import linear_to_bytes
from meshmatch.shapes.formats.gltf_write import smooth_normals
from meshmatch.shapes.formats.seams import split_at_seams, vertex_tangents
from meshmatch.transfer.surface_walk import SurfaceWalker, weighted_sum
from meshmatch.transfer.texel_colors import MaterialSampler, TexelLocator


@dataclass(frozen=True, eq=False)
class Samples:
    """N points of the target and their places on the source.

    ``triangle`` (N,) and ``weights`` (3, N) on the target; ``face`` (N,) and ``source_weights`` (3, N) on the source;
    ``reach`` (N,) the size of each on the source.
    """

    triangle: Ints32
    weights: Floats32
    face: Ints32
    source_weights: Floats32
    reach: Floats32


class Painter(Protocol):
    """Samples the values of one image of a baked material."""

    linear: bool  # bytes are plain numbers, not sRGB colors
    samplers: list[MaterialSampler]

    def sample(self, samples: Samples) -> Floats32:
        """(4, N) amounts and alpha at the samples."""


class ColorPainter:
    """Samples colors and alpha of a source, in linear light."""

    def __init__(self, look: Appearance, walker: SurfaceWalker) -> None:
        self.sampler = MaterialSampler(look, walker)
        self.samplers = [self.sampler]
        self.linear = look.materials[0].linear

    def sample(self, samples: Samples) -> Floats32:
        """(4, N) colors and alpha at the samples."""
        return self.sampler.colors(
            samples.face, samples.source_weights, self.sampler.footprint(samples.face, samples.reach)
        )


class SurfacePainter:
    """Samples occlusion, roughness and metalness, as red, green and blue."""

    linear = True

    def __init__(self, finish: Finish, walker: SurfaceWalker) -> None:
        self.surface, occlusion = ColorPainter(finish.layers["surface"], walker), finish.layers.get("occlusion")
        self.occlusion = None if occlusion is None or not occlusion.textured else ColorPainter(occlusion, walker)
        self.strength = np.ones(0, np.float32) if occlusion is None else strengths(occlusion)
        self.samplers = [each.sampler for each in (self.surface, self.occlusion) if each is not None]

    def sample(self, samples: Samples) -> Floats32:
        """(4, N) amounts and alpha at the samples."""
        out = self.surface.sample(samples)
        out[0] = 1.0
        if self.occlusion is not None:
            strength = self.strength.take(samples.face)
            out[0] += strength * (self.occlusion.sample(samples)[0] - 1)
        return out


class NormalPainter:
    """Samples normals in the tangent frames of the target."""

    linear = True

    def __init__(self, look: Appearance, walker: SurfaceWalker, locator: TexelLocator, uv: Floats) -> None:
        self.colors, self.strength = ColorPainter(look, walker), strengths(look)
        self.samplers = self.colors.samplers
        self.source = _as_columns(_tangent_frames(walker.verts, walker.faces, look.uv))
        self.target = _as_columns(locator.push_directions(_tangent_frames(locator.verts, locator.faces, uv)))

    def sample(self, samples: Samples) -> Floats32:
        """(4, N) encoded normals (0.5 + 0.5 n) and alpha at the samples."""
        out = self.colors.sample(samples)
        strength = self.strength.take(samples.face)
        x, y = ((2 * out[k] - 1) * strength for k in (0, 1))
        z = 2 * out[2] - 1
        source_frames = _interpolate_frames(self.source, samples.face, samples.source_weights)
        target_frames = _interpolate_frames(self.target, samples.triangle, np.clip(samples.weights, 0, 1))
        (a, b), (c, d) = ([weighted_sum(one, other) for other in target_frames] for one in source_frames)
        mirrored = a * d < b * c
        cosine, sine = np.where(mirrored, a - d, a + d), np.where(mirrored, c + b, c - b)
        length = np.maximum(np.sqrt(cosine * cosine + sine * sine), np.float32(1e-20))
        cosine, sine = cosine / length, sine / length
        right = cosine * x + sine * y
        up = np.where(mirrored, sine * x - cosine * y, cosine * y - sine * x)
        size = np.maximum(np.sqrt(right * right + up * up + z * z), np.float32(1e-20))
        for k, part in enumerate((right, up, z)):
            out[k] = 0.5 + 0.5 * part / size
        return out


def strengths(look: Appearance) -> Floats32:
    """(F,) strength of the layer's image on each face."""
    return np.array([made.strength for made in look.materials], np.float32)[look.material]


def _tangent_frames(verts: Floats, faces: Ints, uv: Floats) -> Floats:
    """(F, 3, 2, 3) directions along u and against v, at each corner of each face."""
    vertex, coordinates, corners = split_at_seams(len(verts), faces, uv)
    normals = smooth_normals(verts, faces)[vertex]
    tangents = vertex_tangents(verts[vertex], normals, corners, coordinates)
    up = tangents[:, 3:] * cross_product(normals, np.ascontiguousarray(tangents[:, :3]))
    return np.stack([tangents[:, :3], up], axis=1)[corners]


def _as_columns(frames: Floats) -> list[list[list[Floats32]]]:
    """Frames (F, 3, 2, 3) as columns: by direction, axis and corner."""
    table = frames.transpose(2, 3, 1, 0).astype(np.float32, order="C")
    return [[list(axis) for axis in direction] for direction in table]


def _interpolate_frames(
    columns: list[list[list[Floats32]]], face: NDArray[np.integer], weights: Floats32
) -> list[list[Floats32]]:
    """Both frame directions, three columns (N,) each, at weights (3, N) in faces (N,)."""
    return [
        [weighted_sum(weights, [corner.take(face) for corner in axis]) for axis in direction] for direction in columns
    ]


def painted_bytes(painter: Painter, amounts: Floats32) -> Pixels:
    """(N, 4) image bytes of amounts and alpha (4, N)."""
    out = np.empty((amounts.shape[1], 4), np.uint8)
    shares = np.round(np.clip(amounts, 0, 1) * 255)
    out[:, :3] = shares[:3].T if painter.linear else linear_to_bytes(amounts[:3]).T
    out[:, 3] = shares[3]
    return out
