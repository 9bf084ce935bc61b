"""How a target stands in its file, which its format does not say."""

from __future__ import annotations

import numpy as np

from meshmatch.api.results import MapPair
from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit import Fit
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.carry_rig import turn_of, upright


def trust(source: Shape, maps: MapPair) -> Float[Floats, " V"]:
    """How much each vertex of the source counts: by its area, and the confidence of the map."""
    share = source.vertex_areas / max(source.area, 1e-300) * source.V
    return np.where(source.valid, (share + 1e-3) * (maps.forward.assumed_confidence + 1e-3), 0.0)


def turn_of_fit(fit: object) -> Float[Floats, "3 3"] | None:
    """The turn after which a shape stands along y, by its fit; None if that does not know how it stands."""
    return _turn_of_axis(fit.up) if isinstance(fit, Fit) else None


def _turn_of_axis(name: str) -> Float[Floats, "3 3"] | None:
    """The turn that takes an axis such as "+z" to y; None for an empty name."""
    if not name:
        return None
    up = np.zeros(3)
    up["xyz".index(name[1])] = -1.0 if name[0] == "-" else 1.0
    return turn_of(up)


def turn_upright(maps: MapPair, along_y: bool) -> Float[Floats, "3 3"]:
    """The turn about one axis, by right angles, after which the target stands along y: by its fit, or what the map says of
    that, or else as the source does, if that stands ``along_y``; where neither is known, none.
    """
    known = None if maps.match is None else turn_of_fit(maps.match.target_fit)
    known = _turn_of_axis(maps.forward.target_up) if known is None else known
    if known is not None:
        return known
    if not along_y:
        return np.eye(3)
    with thread_limit(1):
        return upright(maps.source, maps.forward.points(maps.target), trust(maps.source, maps))


def turn_of_moved(mesh: Shape, verts: Float[Floats, "V 3"], surface: Shape, fit: object) -> Float[Floats, "3 3"] | None:
    """The same for a mesh that was moved onto a surface: by the fit of that, or else as the mesh stood, if it came from a
    file with axes; None where it stands so, or that is not known.
    """
    known = None if surface.upright else turn_of_fit(fit)
    if known is not None or surface.upright or not mesh.upright:
        return known
    with thread_limit(1):
        return upright(mesh, verts, mesh.vertex_areas)
