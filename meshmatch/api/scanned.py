"""Training bodies from Meta's Momentum Human Rig, whose body shapes were learned from scans."""

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
    """Read bodies of Meta's Momentum Human Rig for `meshmatch.generators.bodies.Bodies`.

    The included model is fitted to the rig's body in its rest pose, and the template is wrapped onto it.

    Parameters
    ----------
    folder
        Folder with ``lod3.fbx`` and ``compact_v6_1.model`` of a release (github.com/facebookresearch/MHR, Apache-2.0).
    share
        Share (0..1) of the generated people that come from the rig.
    template
        A human template; by default that of the included model.

    Returns
    -------
    Scanned
        The rig, with the template's vertices on its triangles.

    Raises
    ------
    InputError
        A file is missing or invalid.
    OptionError
        The share is not in 0..1.
    TemplateError
        The template is missing or damaged.
    """
    rig = read_momentum_rig(folder)
    body, matcher = Shape(rig.verts, rig.faces), Matcher(_FITTED_BY)
    model = matcher.model
    fit, rest_template = matcher.fit(body), (model.template if template is None else read_template(template)).shape
    near = fit.frame.undo(rest_template.verts + model.field(rest_template.verts).displaced(fit.vectors))
    wrapped = wrap_onto(rest_template, near, body, np.zeros(rest_template.V, bool)).verts
    facing = vertex_normals(body.verts, body.faces)
    found = Surface(body.verts, body.faces, facing).query(wrapped, vertex_normals(wrapped, rest_template.faces))
    return Scanned(rig, body.faces[found.face], found.barycentric, share)
