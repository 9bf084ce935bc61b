"""Find the rotation that makes a shape upright (up along y), if its file format does not define the up axis."""

from __future__ import annotations

import numpy as np

from meshmatch.api.results import MapPair
from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit import Fit
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.carry_rig import rotation_to_upright, rotation_to_y


def vertex_weights(source: Shape, maps: MapPair) -> Float[Floats, " V"]:
    """Weights of the source's vertices: area times confidence of the map."""
    share = source.vertex_areas / max(source.area, 1e-300) * source.V
    return np.where(source.valid, (share + 1e-3) * (maps.forward.assumed_confidence + 1e-3), 0.0)


def upright_rotation_of_fit(fit: object) -> Float[Floats, "3 3"] | None:
    """The rotation that makes y the up axis of a fitted shape; None if the fit does not know its up axis."""
    return _turn_of_axis(fit.up) if isinstance(fit, Fit) else None


def _turn_of_axis(name: str) -> Float[Floats, "3 3"] | None:
    """The rotation that takes an axis, such as "+z", to y; None for an empty name."""
    if not name:
        return None
    up = np.zeros(3)
    up["xyz".index(name[1])] = -1.0 if name[0] == "-" else 1.0
    return rotation_to_y(up)


def turn_upright(maps: MapPair, along_y: bool) -> Float[Floats, "3 3"]:
    """The rotation, by right angles about one axis, that makes y the target's up axis.

    Its up axis comes from its fit, or from the map; else it is found from the source, if that stands ``along_y``. The
    identity if the up axis is unknown.
    """
    known = None if maps.match is None else upright_rotation_of_fit(maps.match.target_fit)
    known = _turn_of_axis(maps.forward.target_up) if known is None else known
    if known is not None:
        return known
    if not along_y:
        return np.eye(3)
    with thread_limit(1):
        return rotation_to_upright(maps.source, maps.forward.points(maps.target), vertex_weights(maps.source, maps))


def turn_of_moved(mesh: Shape, verts: Float[Floats, "V 3"], surface: Shape, fit: object) -> Float[Floats, "3 3"] | None:
    """The rotation that makes y the up axis of a mesh that was moved onto a ``surface``.

    The up axis comes from the ``fit`` of the surface, or else from the mesh as it was, if its file format defines axes. None
    if the format of the surface's file defines y as up, or the up axis is unknown.
    """
    known = None if surface.upright else upright_rotation_of_fit(fit)
    if known is not None or surface.upright or not mesh.upright:
        return known
    with thread_limit(1):
        return rotation_to_upright(mesh, verts, mesh.vertex_areas)
