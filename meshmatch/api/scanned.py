"""A rig with shapes learned from scans, laid under a human template: what it may be trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshmatch.api.matcher import Matcher
from meshmatch.generators.momentum_rig import Scanned, read_momentum_rig
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.maps.footpoints import Surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import read_template
from meshmatch.transfer.wrap import wrap_onto

_FITTED_BY = "human"


def scanned_bodies(folder: str | Path, share: float = 0.5, template: str | Path | None = None) -> Scanned:
    """Bodies of Meta's Momentum Human Rig as `meshmatch.generators.bodies.Bodies` takes them.

    The rig's body at rest is fitted with the included model, and the template laid onto it.

    Parameters
    ----------
    folder
        With ``lod3.fbx`` and ``compact_v6_1.model`` of a release (github.com/facebookresearch/MHR, Apache-2.0).
    share
        Of the generated people, 0 to 1.
    template
        A human one; by default that of the included model.

    Returns
    -------
    Scanned
        The rig on the template's vertices.

    Raises
    ------
    InputError
        A file is missing or is not what it should be.
    OptionError
        The share is none.
    TemplateError
        The template is missing or damaged.
    """
    rig = read_momentum_rig(folder)
    body, matcher = Shape(rig.verts, rig.faces), Matcher(_FITTED_BY)
    model = matcher.model
    fit, resting = matcher.fit(body), (model.template if template is None else read_template(template)).shape
    near = fit.frame.undo(resting.verts + model.field(resting.verts).displaced(fit.vectors))
    laid = wrap_onto(resting, near, body, np.zeros(resting.V, bool)).verts
    facing = vertex_normals(body.verts, body.faces)
    found = Surface(body.verts, body.faces, facing).query(laid, vertex_normals(laid, resting.faces))
    return Scanned(rig, body.faces[found.face], found.barycentric, share)
