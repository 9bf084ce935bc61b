"""Finer matches of alike shapes, of a part and its whole, and of a shape and a model's template.

A search without a model (`meshmatch.fitting.direct`) allows for any pose, so its fits have few nodes and are held along the
surface. Shapes of one kind in the same pose ("alike"), such as two femurs, need less freedom and can have more nodes. A
part, such as a broken bone, needs the size of its whole.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError
from meshmatch.fitting.direct import MIN_ENERGY_LEAD, MIRROR, DirectMatch, match_directly
from meshmatch.fitting.fit import Fit, axis_name
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import cap_verdict, judge_unsupervised, may_be_part, with_mirror_note
from meshmatch.fitting.judge.reasons import SIDE_IN_DOUBT, Reason
from meshmatch.fitting.kind_templates import template_of, viscous_system, with_final_nodes, with_more_nodes
from meshmatch.fitting.one_way import DirectConfig
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.fitting.without_model import (
    fit_from,
    fit_other_pose,
    fit_same_pose,
    fit_same_pose_near,
    fit_without_model,
)
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.rims import MIN_RIM_LENGTH, rim_lengths
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import low_mesh
from meshmatch.templates.mirror_images import alignment_residuals, mirrored
from meshmatch.templates.template import Template
from meshmatch.threads import parallel_map

# Shapes are alike if a rigid motion brings them this near (units of sqrt(area)): femurs, knees and molars come to 0.04 to
# 0.06, hearts and leaves up to 0.066; people, ants and fish to 0.069 and more.
_MAX_ALIKE_DISTANCE = 0.067
_MAX_SIZE_RATIO = 3.0  # of two sqrt(area), above which the files probably have different units
_CLEAR_SIDE = 0.05  # least `Fit.side` of a clear side: 0.15 and more for molars


def refine_match(
    source: Shape,
    target: Shape,
    found: DirectMatch,
    config: FitConfig,
    progress: ProgressCallback | None = None,
    turned: bool = True,
) -> DirectMatch:
    """Refine a direct match of two shapes in the same pose, or of a part and its whole.

    A fit as a part is used only if it explains an open shape clearly better. The files of part and whole are assumed to
    have the same unit.

    Parameters
    ----------
    source, target
        Repaired shapes.
    found
        Their match by `match_either_side`.
    config
        Whether parts and mirror images are allowed, and the seed.
    progress
        As for `match_directly`.
    turned
        Whether the shapes may have another rotation than the match says. Not for a shape and its mirror image: one of the
        two, not their mean, is then the template, as busts come nearer to their own symmetry so (2.4 % of sqrt(area)
        instead of 3.1).

    Returns
    -------
    DirectMatch
        ``found`` itself; or two fits of one template with more nodes. The template is halfway between the shapes, or the
        larger shape if the other is a part.
    """
    if source.is_cloud or target.is_cloud:
        return found
    smaller, larger = sorted((source, target), key=lambda shape: shape.area)
    part = may_be_part(smaller, config) and rim_lengths(smaller).max() > MIN_RIM_LENGTH
    whole, other = (larger, smaller) if part else (source, target)
    if part and found.verdict == "good":
        found = _doubted_if_sizes_differ(found, smaller, larger, smaller is source)
    if not part and min(found.apart or alignment_residuals(source, target, config.seed)) > _MAX_ALIKE_DISTANCE:
        return found
    report = Progress(progress, other.name).stage("fits of shapes that stand alike")
    report(0.0)
    viscous = ViscousConfig(seed=config.seed)
    template, frame = template_of(whole, whole.name, viscous), _frame_of(whole, viscous)
    of_whole, of_other = (found.source, found.target) if whole is source else (found.target, found.source)
    resting = frame.apply(of_whole.points_in_file)
    if of_whole.frame.mirrored:  # the template is not mirrored
        of_other = replace(of_other, frame=of_other.frame.compose(MIRROR), points=MIRROR.apply(of_other.points))
    size = float(np.sqrt(whole.area)) if part else None
    finer = fit_same_pose(template, other, (resting, of_other), viscous, config.mirror != "no", size, turned)
    report(0.5)
    if finer is None:
        return found
    fit, as_found = finer
    if as_found:
        moving = found.target if found.source.verdict == "good" else found.source
        fit = replace(fit, verdict=found.verdict, reasons=moving.reasons, trust=moving.trust)
    else:
        fit = cap_verdict(fit, [reason for reason in found.reasons if reason.code == "ambiguous"])
    fits = _fit_of_itself(fit, template, whole, frame), _aligned_to_rest(fit, template)
    system = viscous_system(template)
    if turned and not part:
        fits, system = _fits_from_mean((whole, other), fits, viscous) or (fits, system)
    report(1.0)
    first, second = fits if whole is source else fits[::-1]
    return replace(found, source=first, target=second, system=system)


def _doubted_if_sizes_differ(found: DirectMatch, part: Shape, whole: Shape, part_is_source: bool) -> DirectMatch:
    """A good match, made fair if an open shape may be a part of a closed one, but cannot be fitted as one at its size."""
    ratio = float(np.sqrt(whole.area / part.area))
    if ratio <= _MAX_SIZE_RATIO or rim_lengths(whole).max() > MIN_RIM_LENGTH:
        return found
    doubt = [Reason("doubt", f"it may be a part, but the sizes in the files differ {ratio:.0f}-fold: use one unit")]
    if part_is_source:
        return replace(found, source=cap_verdict(found.source, doubt))
    return replace(found, target=cap_verdict(found.target, doubt))


def refine_fit(
    model: TrainedModel,
    shape: Shape,
    fit: Fit,
    config: FitConfig,
    progress: ProgressCallback | None = None,
    turned: bool = True,
) -> Fit:
    """Refine a fit of a model that was trained without correspondence.

    If the shape has the template's pose, in any rotation or mirrored, the template gets more nodes, and the fit is judged
    anew. Otherwise the template is matched to the shape directly, with this fit as one of the guesses; if another guess is
    clearly better, the fit is at most fair. A poor fit of such a shape is not searched and stays poor. The fit is returned
    unchanged if the model learned correspondence or has no nodes, and for a cloud or a part.

    Parameters
    ----------
    model
        The model of the fit.
    shape
        The repaired shape.
    fit
        Fit of the model's template to it.
    config
        Whether mirror images are allowed.
    progress
        As for `match_directly`, for the search.
    turned
        Whether to try other rotations than that of the fit.

    Returns
    -------
    Fit
        Of the same template; its node vectors only approximate its points.
    """
    card = model.card
    if card.correspondence or shape.is_cloud or fit.partial or not model.has_nodes:
        return fit
    viscous, both = ViscousConfig(seed=fit.seed), turned and (config.mirror or card.mirror) != "no"
    near = fit_same_pose_near(
        with_more_nodes(model.template, viscous), shape, fit, viscous, turned, both, card.mirror != "no"
    )
    poor = near is None and fit.verdict == "poor"
    doubts = [] if near is None or not both or near.side > _CLEAR_SIDE else [Reason("side", SIDE_IN_DOUBT)]
    if near is None:
        doubts = [reason for reason in fit.reasons if reason.code == "side"]
        found = fit if poor else _search_again(model.template, shape, fit, progress)
        near, moved = fit_other_pose(with_more_nodes(model.template, viscous), shape, found, viscous)
        if moved:
            near = replace(near, points=found.points)
    result = cap_verdict(judge_unsupervised(card, _as_of(model, near)), doubts)
    if near.points is fit.points:  # keep them, as the fit may yet agree with others
        result = replace(result, vectors=fit.vectors)
    if poor:
        result = replace(result, verdict="poor", reasons=fit.reasons, trust=min(fit.trust, result.trust))
    notes = with_mirror_note(fit.notes, shape.name, card, result.frame.mirrored)
    return replace(result, repaired=fit.repaired, left_out=fit.left_out, notes=notes)


def is_refined(model: TrainedModel, fit: Fit) -> bool:
    """Return whether the points of a fit are finer than its node vectors give, as after `refine_fit`."""
    return model.has_nodes and not np.allclose(fit.points, node_system(model).moved(fit.vectors), atol=1e-6)


def _as_of(model: TrainedModel, fit: Fit) -> Fit:
    """Convert a fit of the same vertices with more nodes to one of a model."""
    return replace(
        fit,
        model=model.card.name,
        template_hash=model.template.hash,
        resting=np.asarray(model.template.shape.verts),
        faces=np.asarray(model.template.shape.faces),
        vectors=node_system(model).vectors_to(fit.points),
    )


def _search_again(template: Template, shape: Shape, fit: Fit, progress: ProgressCallback | None) -> Fit:
    """Replace the points of a fit by those that a search finds, with its trust and reasons, if these are clearly better."""
    rested = Shape(template.shape.verts, template.shape.faces, shape.name)  # the name is for progress reports
    side = MIRROR if fit.frame.mirrored else None
    image, guess = shape, fit.points_in_file
    if side is not None:
        image, guess = mirrored(shape), side.apply(guess)
    config = DirectConfig(fine=max(DirectConfig.fine, rested.F), from_source=True, seed=fit.seed)
    try:
        found = match_directly(rested, image, config, progress=progress, guess=(rested.verts, guess))
    except InputError:  # the shape is not a surface
        return fit
    if found.verdict == "poor" or 0 < found.guess_lead < MIN_ENERGY_LEAD:
        return fit
    points = found.target.points_in_file[cKDTree(found.source.points_in_file).query(rested.verts)[1]]
    if side is not None:
        points = side.apply(points)
    reasons = found.reasons if found.guess_lead else ()
    return replace(fit, points=fit.frame.apply(points), trust=found.target.trust, reasons=reasons)


def fit_as_part(model: TrainedModel, shape: Shape, whole: float, config: FitConfig) -> Fit | None:
    """Fit the template of a model that was trained without correspondence to a repaired shape that is cut.

    Parameters
    ----------
    model
        A model of the kind.
    shape
        An open mesh.
    whole
        The sqrt(area) of a whole shape, in the unit of the file.
    config
        Whether mirror images are allowed, and the seed.

    Returns
    -------
    Fit
        As a part, at most fair; None if the shape is better explained as a whole, and for a pointwise model.
    """
    if not model.has_nodes:
        return None
    viscous = ViscousConfig(seed=config.seed)
    template = with_more_nodes(model.template, viscous)
    found = fit_without_model(template, shape, viscous, mirror=config.mirror != "no", whole=whole)
    if not found.partial:
        return None
    return _as_of(model, found)


def _aligned_to_rest(fit: Fit, template: Template) -> Fit:
    """The same fit in the core frame in which the deformed template is rigidly aligned to the rest template."""
    system = viscous_system(template)
    return _rigidly_aligned(system.verts, fit, system)


def _rigidly_aligned(points_of_other: Float[Floats, "N 3"], fit: Fit, system: NodeSystem) -> Fit:
    """The same fit in the core frame in which it is rigidly aligned to given positions of the same vertices."""
    turn = kabsch(points_of_other, fit.points)
    core, points = fit.frame.compose(turn.frame), turn.to_local(fit.points)
    up, front = (axis_name(core.rotation[row]) for row in (1, 2))
    return replace(fit, frame=core, points=points, vectors=system.vectors_to(points), up=up, front=front)


def _fits_from_mean(
    shapes: tuple[Shape, Shape], fits: tuple[Fit, Fit], config: ViscousConfig
) -> tuple[tuple[Fit, Fit], NodeSystem] | None:
    """Fits of a template halfway between two shapes to both of them.

    Each shape then has half as far to go, and neither is favoured. The mean of two fits contains their errors, so it is
    computed again twice. None if one of the shapes has another pose than the template.
    """
    first, second = fits
    for stage_config in (config.rough(), config.rough(), config):
        mean = (first.points + kabsch(first.points, second.points).to_local(second.points)) / 2
        template = template_of(Shape(mean, first.faces), "half way", config)
        if stage_config is config:
            template = with_final_nodes(template, config)
        one, other = parallel_map(partial(fit_from, template, config=stage_config), shapes, (first, second))
        if one is None or other is None:
            return None
        first, second = one, other
    system = viscous_system(template)
    second = _rigidly_aligned(first.points, second, system)
    return (_judged_as(first, fits[0]), _judged_as(second, fits[1])), system


def _judged_as(fit: Fit, before: Fit) -> Fit:
    """Give a fit the verdict of another fit of the same shape."""
    return replace(fit, verdict=before.verdict, reasons=before.reasons, trust=before.trust, notes=before.notes)


def _frame_of(shape: Shape, config: ViscousConfig) -> Frame:
    """Frame from the file of a shape to the template that is made of it."""
    kept, faces = low_mesh(shape, config.faces)
    return sqrt_area_frame(Shape(shape.verts[kept], faces))


def _fit_of_itself(fit: Fit, template: Template, shape: Shape, frame: Frame) -> Fit:
    """The fit of a template to the shape that it was made of, given its fit to another shape."""
    return replace(
        fit,
        frame=frame,
        points=np.asarray(template.shape.verts),
        vectors=np.zeros_like(fit.vectors),
        residual=0.0,
        verts=shape.verts,
        verdict="good",
        reasons=(),
        notes=(),
        trust=1.0,
        signs=None,
        regularity=Regularity(),
        partial=False,
        side=0.0,
        up="+y",
        front="+z",
    )
