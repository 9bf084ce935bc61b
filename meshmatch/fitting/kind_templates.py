"""Templates for shapes without a model: one of the shapes, or their mean, with nodes for fits without a model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.derived import derived
from meshmatch.fields.shape_functions import build_field
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.solve.blend import FieldPath
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.geometry.frames import kabsch
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, low_mesh, make_template
from meshmatch.templates.template import Template

# If the plain mean has less than this share of the fits' mean area, poses differ: 0.997 for femurs, 0.87 for ants.
_MIN_MEAN_AREA = 0.93


def template_of(shape: Shape, name: str, config: ViscousConfig) -> Template:
    """Make a template of one shape, with nodes anywhere near its surface."""
    nodes = NodeConfig("uniform", config.nodes, config.radius, 0.01, seed=config.seed)
    return make_template(shape, name, nodes, low=low_mesh(shape, config.faces))


@derived
def with_more_nodes(template: Template, config: ViscousConfig) -> Template:
    """The same template vertices with the nodes that fits without a model use."""
    shape = template.shape
    nodes = NodeConfig("uniform", config.nodes, config.radius, 0.01, seed=config.seed)
    return make_template(shape, template.name, nodes, low=(np.arange(shape.V), np.asarray(shape.faces)))


def with_final_nodes(template: Template, config: ViscousConfig) -> Template:
    """The same template vertices with more nodes, for the final fits of shapes in the same pose.

    Sheets such as leaves keep their nodes: they slide along themselves, and more nodes made them worse (0.67 to 1.86 mm).
    """
    return template if viscous_system(template).is_sheet else with_more_nodes(template, config.finest())


@derived
def viscous_system(template: Template) -> NodeSystem:
    """The least-squares system of a template without a model."""
    verts = template.shape.verts
    return NodeSystem(template.shape, build_field(verts, template.nodes, template.radius, "smooth"))


def mean_shape(template: Template, fits: Sequence[Fit]) -> Float[Floats, "V 3"]:
    """Mean of a template's vertices (V, 3) over several fits.

    This is the mean after rigid alignment to the mean so far, in two rounds. If poses differ, that mean would shrink
    whatever is rotated; the mean of the deformation fields is used instead (`FieldPath`).
    """
    mean = np.asarray(template.shape.verts)
    for _ in range(2):
        mean = np.mean([kabsch(fit.points, mean).to_world(fit.points) for fit in fits], axis=0)
    faces = template.shape.faces
    if Shape(mean, faces).area > _MIN_MEAN_AREA * np.mean([Shape(fit.points, faces).area for fit in fits]):
        return np.asarray(mean)
    path = FieldPath(viscous_system(template), [fit.vectors for fit in fits], template.core)
    return viscous_system(template).moved(path(np.full(len(fits), 1 / len(fits))))
