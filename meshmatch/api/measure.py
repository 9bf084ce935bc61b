"""`measure`: girths, lengths and angles of a shape, defined by landmarks of another shape or of the included body."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.api.results import ConfidenceRule, Transferred
from meshmatch.api.transfer import MapLike, find_maps, given_landmarks
from meshmatch.errors import OptionError
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.landmark_files import mesh_space
from meshmatch.templates.location import bundled_folder
from meshmatch.threads import thread_limit
from meshmatch.transfer.landmarks import Landmarks, push_landmarks
from meshmatch.transfer.low_confidence import LowConfidence
from meshmatch.transfer.measurements import (
    Measurement,
    Measurements,
    MeasuringPoints,
    check_unique,
    load_measurements,
    save_measurements,
)

BODY = "body"
"""Source name of the included body: a person with landmarks and measurements."""


def measure(
    source: ShapeLike,
    target: ShapeLike,
    measurements: Sequence[Measurement] | str | Path | None = None,
    landmarks: Landmarks | ArrayLike | str | Path | None = None,
    match: MapLike = None,
    *,
    rule: ConfidenceRule = ConfidenceRule(),
) -> Transferred[Measurements]:
    """Measure girths, lengths and angles of a shape, defined by landmarks of another shape.

    Parameters
    ----------
    source
        The shape with the landmarks, as in `find_maps`; or ``"body"``: a person with 39 landmarks and 30 measurements,
        which is included in meshmatch.
    target
        The shape to measure, a mesh or point cloud.
    measurements
        The measurements, or the path of a table that defines them. Required unless the source is ``"body"``.
    landmarks
        As in `transfer_landmarks`; landmarks without names are called 0, 1, 2, ... in their order. Required unless the
        source is ``"body"``.
    match
        As in `find_maps`.
    rule
        Its ``minimum`` applies: a distance or an angle is nan if the confidence of one of its landmarks is below it. A girth
        is nan if more than a quarter of its line is below it, or if the map is discontinuous along it.

    Returns
    -------
    Transferred
        ``data`` is `Measurements`: ``values`` (N,) in the unit of the target's file, angles in degrees, and the measured
        ``lines``.

    Raises
    ------
    MeshmatchError
        The source lacks a landmark of a measurement, or a measurement cannot be taken on it; or as for `find_maps`.

    Examples
    --------
    >>> found = meshmatch.measure("body", "templates/samples/dancer.ply").data
    >>> dict(zip(found.names, found.values))  # unit of the dancer's file
    """
    points = measuring_points(source, measurements, landmarks)
    maps = find_maps(points.shape, target, match)
    with thread_limit(1):
        found = points.taken(push_landmarks(maps.forward, maps.source, maps.target, points.points), rule.minimum)
    lost = int(np.isnan(found.values).sum())
    write = partial(_write_measurements, found)
    return Transferred(found, found.confidence, LowConfidence(len(found.names), lost, lost), maps, write)


def measuring_points(
    source: ShapeLike,
    measurements: Sequence[Measurement] | str | Path | None = None,
    landmarks: Landmarks | ArrayLike | str | Path | None = None,
) -> MeasuringPoints:
    """The points of a source that its measurements need; parameters as in `measure`."""
    source, measurements, landmarks = measure_inputs(source, measurements, landmarks)
    space = mesh_space(source) if isinstance(source, str | Path) else ""
    shape = as_shape(source, "source")
    given = load_measurements(measurements) if isinstance(measurements, str | Path) else check_unique(measurements)
    return MeasuringPoints.of(shape, given_landmarks(landmarks, shape, space), given)


def measure_inputs(
    source: ShapeLike,
    measurements: Sequence[Measurement] | str | Path | None,
    landmarks: Landmarks | ArrayLike | str | Path | None,
) -> tuple[ShapeLike, Sequence[Measurement] | str | Path, Landmarks | ArrayLike | str | Path]:
    """Resolve the source, measurements and landmarks, with the defaults of the included body.

    `OptionError` if measurements or landmarks are missing for another source.
    """
    if is_body(source):
        folder = bundled_folder() / "measurements"  # made by makers/body_measurements.py of commit a77b931897
        own = folder / "body-measurements.csv", folder / "body-landmarks.csv"
        source = resolve_source(source)
        return source, own[0] if measurements is None else measurements, own[1] if landmarks is None else landmarks
    if measurements is None or landmarks is None:
        what = "measurements" if measurements is None else "landmarks"
        hint = f"give them, or use {BODY} as the source: an included person with its own"
        raise OptionError(f"with a source of your own the {what} are needed", hint)
    return source, measurements, landmarks


def is_body(source: object) -> bool:
    """Whether the source is `BODY`, the included body."""
    return isinstance(source, str | Path) and str(source) == BODY


def resolve_source(source: ShapeLike) -> ShapeLike:
    """Return the source; for `BODY`, the path of the included body."""
    return bundled_folder() / "measurements" / "body.ply" if is_body(source) else source


def _write_measurements(found: Measurements, path: Path, final: Path) -> None:
    save_measurements(path, found)
