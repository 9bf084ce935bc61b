"""A shape that is nearly symmetric, matched to its own mirror image: what lies across from what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.errors import InputError
from meshmatch.fitting.alike import match_alike
from meshmatch.fitting.direct import DirectMatch, match_where_it_lies
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.one_way import DirectConfig
from meshmatch.fitting.search.planes import MirrorPlane, mirror_planes
from meshmatch.geometry.frames import Frame
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

_PLANES = 5  # that are tried
_SAMPLES = 1500


def match_across(
    shape: Shape, config: FitConfig, progress: ProgressCallback | None = None
) -> tuple[MirrorPlane, DirectMatch]:
    """Match a repaired mesh to its mirror image.

    Parameters
    ----------
    shape
        A mesh.
    config
        The seed.
    progress
        As of `match_directly`.

    Returns
    -------
    MirrorPlane
        A plane near which the shape is symmetric, in the coordinates of its file.
    DirectMatch
        Of the shape, and of its image in that plane (`image_in`).

    Raises
    ------
    InputError
        A cloud of points.
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
    images = [image_in(plane, shape) for plane in planes]
    number, found = match_where_it_lies(shape, images, DirectConfig(seed=config.seed, from_source=True), progress)
    how = replace(config, mirror="no", partial="no")
    return planes[number], match_alike(shape, images[number], found, how, progress, turned=False)


def image_in(plane: MirrorPlane, shape: Shape) -> Shape:
    """The mirror image of a shape, facing out."""
    return replace(shape, verts=plane.reflect(shape.verts), faces=shape.faces[:, ::-1])


def _in_file(plane: MirrorPlane, frame: Frame) -> MirrorPlane:
    """A plane of a frame without rotation in the coordinates of the file."""
    origin = frame.undo(np.outer([plane.offset], plane.normal))[0]
    return replace(plane, offset=float(plane.normal @ origin))
