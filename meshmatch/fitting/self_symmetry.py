"""Self-symmetry: a nearly symmetric shape is matched to its own mirror image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.errors import InputError
from meshmatch.fitting.direct import DirectMatch, match_to_best_of
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.one_way import DirectConfig
from meshmatch.fitting.same_pose import refine_match
from meshmatch.fitting.search.planes import MirrorPlane, mirror_planes
from meshmatch.geometry.frames import Frame
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

_PLANES = 5  # maximum number of mirror planes to try
_SAMPLES = 1500


def match_to_mirror_image(
    shape: Shape, config: FitConfig, progress: ProgressCallback | None = None
) -> tuple[MirrorPlane, DirectMatch]:
    """Match a repaired mesh to its mirror image.

    Parameters
    ----------
    shape
        A mesh.
    config
        Provides the seed.
    progress
        As for `match_directly`.

    Returns
    -------
    MirrorPlane
        A plane of approximate symmetry, in the coordinates of the shape's file.
    DirectMatch
        The match of the shape to its image in that plane (`mirror_image`).

    Raises
    ------
    InputError
        The shape is a point cloud.
    """
    if shape.is_cloud:
        hint = "reconstruct a surface first"
        raise InputError(f"{shape.name or 'the shape'} has no faces, and only a mesh is matched to its image", hint)
    report = Progress(progress, shape.name).stage("planes of symmetry")
    report(0.0)
    frame = sqrt_area_frame(shape)
    samples = sample_surface(Shape(frame.apply(shape.verts), shape.faces), _SAMPLES, np.random.default_rng(config.seed))
    planes = [_in_file(plane, frame) for plane in mirror_planes(samples, _PLANES)]
    report(1.0)
    images = [mirror_image(plane, shape) for plane in planes]
    number, found = match_to_best_of(shape, images, DirectConfig(seed=config.seed, from_source=True), progress)
    alike_config = replace(config, mirror="no", partial="no")
    return planes[number], refine_match(shape, images[number], found, alike_config, progress, turned=False)


def mirror_image(plane: MirrorPlane, shape: Shape) -> Shape:
    """The mirror image of a shape, with faces oriented outwards."""
    return replace(shape, verts=plane.reflect(shape.verts), faces=shape.faces[:, ::-1])


def _in_file(plane: MirrorPlane, frame: Frame) -> MirrorPlane:
    """Transform a plane from a frame without rotation to the coordinates of the file."""
    origin = frame.undo(np.outer([plane.offset], plane.normal))[0]
    return replace(plane, offset=float(plane.normal @ origin))
