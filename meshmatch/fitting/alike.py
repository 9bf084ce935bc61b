"""Two shapes that stand alike, such as two femurs, or of which one is a part of the other, matched more finely.

The same of a shape and the template of a model of its kind.

A search without a model (`meshmatch.fitting.direct`) allows for any pose, so its fits have few nodes, and are held along the
surface. Specimens of one kind need less freedom, and the whole of a broken bone is larger than what is left of it.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError
from meshmatch.fitting.direct import CLEARLY, MIRROR, DirectMatch, match_directly
from meshmatch.fitting.fit import Fit, axis_name
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import cap_verdict, judge_unsupervised, may_show_part, with_mirror_note
from meshmatch.fitting.judge.reasons import SIDE_IN_DOUBT, Reason
from meshmatch.fitting.kind_templates import finest, template_of, viscous_system, with_more_nodes
from meshmatch.fitting.one_way import DirectConfig
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.fitting.without_model import fit_alike, fit_from, fit_near, fit_otherwise, fit_without_model
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.rims import RIM, rim_lengths
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import low_mesh
from meshmatch.templates.sides import apart, mirrored
from meshmatch.templates.template import Template
from meshmatch.threads import parallel_map

# How near shapes that stand alike must come by a rigid motion, in units of sqrt(area): femurs, knees and molars come to 0.04
# to 0.06, hearts and leaves up to 0.066; people, ants and fish to 0.069 and more.
_ALIKE = 0.067
_CLEAR_SIDE = 0.05  # see `Fit.side`: 0.15 and more of molars


def match_alike(
    source: Shape,
    target: Shape,
    found: DirectMatch,
    config: FitConfig,
    progress: ProgressCallback | None = None,
    turned: bool = True,
) -> DirectMatch:
    """A direct match, made finer where the shapes stand alike, or where one is open and clearly better seen as a part.

    A part is as large as it is in the whole: the files are in one unit.

    Parameters
    ----------
    source, target
        Repaired shapes.
    found
        What `match_either_side` made of them.
    config
        Whether parts and mirror images are looked for, and the seed.
    progress
        As of `match_directly`.
    turned
        Whether the shapes may be turned otherwise than the match says. A shape and its mirror image may not; one of them is
        the template then, for busts come nearer to their own symmetry so (2.4 % of sqrt(area), 3.1 from half way).

    Returns
    -------
    DirectMatch
        The same; or two fits of one template with more nodes, which lies half way between the shapes; or is the larger one
        where one is open.
    """
    if source.is_cloud or target.is_cloud:
        return found
    smaller, larger = sorted((source, target), key=lambda shape: shape.area)
    part = may_show_part(smaller, config) and rim_lengths(smaller).max() > RIM
    whole, other = (larger, smaller) if part else (source, target)
    if not part and min(found.apart or apart(source, target, config.seed)) > _ALIKE:
        return found
    report = Progress(progress, other.name).stage("fits of shapes that stand alike")
    report(0.0)
    viscous = ViscousConfig(seed=config.seed)
    template, frame = template_of(whole, whole.name, viscous), _frame_of(whole, viscous)
    of_whole, of_other = (found.source, found.target) if whole is source else (found.target, found.source)
    resting = frame.apply(of_whole.points_in_file)
    if of_whole.frame.mirrored:  # the template is not
        of_other = replace(of_other, frame=of_other.frame.compose(MIRROR), points=MIRROR.apply(of_other.points))
    size = float(np.sqrt(whole.area)) if part else None
    finer = fit_alike(template, other, (resting, of_other), viscous, config.mirror != "no", size, turned)
    report(0.5)
    if finer is None:
        return found
    fit, as_found = finer
    if as_found:
        moving = found.target if found.source.verdict == "good" else found.source
        fit = replace(fit, verdict=found.verdict, reasons=moving.reasons, trust=moving.trust)
    else:
        fit = cap_verdict(fit, [reason for reason in found.reasons if reason.code == "ambiguous"])
    fits = _at_rest(fit, template, whole, frame), _as_it_rests(fit, template)
    system = viscous_system(template)
    if turned and not part:
        fits, system = _from_half_way((whole, other), fits, viscous) or (fits, system)
    report(1.0)
    first, second = fits if whole is source else fits[::-1]
    return replace(found, source=first, target=second, system=system)


def finer(
    model: TrainedModel,
    shape: Shape,
    fit: Fit,
    config: FitConfig,
    progress: ProgressCallback | None = None,
    turned: bool = True,
) -> Fit:
    """A fit of a model that learned a kind without correspondence, made finer.

    Where the shape stands as the template does, in any turn, or mirrored, the template is given more nodes, and is judged
    anew. Elsewhere it is matched to the shape directly, with this fit as one of the guesses; where another guess
    is clearly better, the fit is fair at most. A poor fit of such a shape is not searched, and stays poor. All is as it was
    where the model learned correspondence, and of a cloud or a part.

    Parameters
    ----------
    model
        Of the fit.
    shape
        The repaired shape.
    fit
        Of the model's template to it.
    config
        Whether mirror images are looked for.
    progress
        As of `match_directly`, of what is searched.
    turned
        Whether other turns than that of the fit are tried.

    Returns
    -------
    Fit
        Of the same template; its node vectors come near its points.
    """
    card = model.card
    if card.correspondence or shape.is_cloud or fit.partial or not model.has_nodes:
        return fit
    viscous, both = ViscousConfig(seed=fit.seed), turned and (config.mirror or card.mirror) != "no"
    near = fit_near(with_more_nodes(model.template, viscous), shape, fit, viscous, turned, both, card.mirror != "no")
    poor = near is None and fit.verdict == "poor"
    doubts = [] if near is None or not both or near.side > _CLEAR_SIDE else [Reason("side", SIDE_IN_DOUBT)]
    if near is None:
        doubts = [reason for reason in fit.reasons if reason.code == "side"]
        found = fit if poor else _searched(model.template, shape, fit, progress)
        near, moved = fit_otherwise(with_more_nodes(model.template, viscous), shape, found, viscous)
        if moved:
            near = replace(near, points=found.points)
    made = cap_verdict(judge_unsupervised(card, _as_of(model, near)), doubts)
    if near.points is fit.points:  # it may yet agree with others
        made = replace(made, vectors=fit.vectors)
    if poor:
        made = replace(made, verdict="poor", reasons=fit.reasons, trust=min(fit.trust, made.trust))
    notes = with_mirror_note(fit.notes, shape.name, card, made.frame.mirrored)
    return replace(made, repaired=fit.repaired, left_out=fit.left_out, notes=notes)


def is_finer(model: TrainedModel, fit: Fit) -> bool:
    """Whether a fit was made finer than its node vectors are."""
    return model.has_nodes and not np.allclose(fit.points, node_system(model).moved(fit.vectors), atol=1e-6)


def _as_of(model: TrainedModel, fit: Fit) -> Fit:
    """A fit of the same vertices with more nodes, as one of a model."""
    return replace(
        fit,
        model=model.card.name,
        template_hash=model.template.hash,
        resting=np.asarray(model.template.shape.verts),
        faces=np.asarray(model.template.shape.faces),
        vectors=node_system(model).vectors_to(fit.points),
    )


def _searched(template: Template, shape: Shape, fit: Fit, progress: ProgressCallback | None) -> Fit:
    """Where a search finds the template's vertices on a shape, with its trust and reasons; the fit itself where the search
    finds nothing that is clearly better."""
    rested = Shape(template.shape.verts, template.shape.faces, shape.name)  # the name is what progress tells
    side = MIRROR if fit.frame.mirrored else None
    image, guess = shape, fit.points_in_file
    if side is not None:
        image, guess = mirrored(shape), side.apply(guess)
    config = DirectConfig(fine=max(DirectConfig.fine, rested.F), from_source=True, seed=fit.seed)
    try:
        found = match_directly(rested, image, config, progress=progress, guess=(rested.verts, guess))
    except InputError:  # no surface without its loose ends
        return fit
    if found.verdict == "poor" or 0 < found.over_guess < CLEARLY:
        return fit
    points = found.target.points_in_file[cKDTree(found.source.points_in_file).query(rested.verts)[1]]
    if side is not None:
        points = side.apply(points)
    reasons = found.reasons if found.over_guess else ()
    return replace(fit, points=fit.frame.apply(points), trust=found.target.trust, reasons=reasons)


def as_part(model: TrainedModel, shape: Shape, whole: float, config: FitConfig) -> Fit | None:
    """A fit of the template of a model that learned a kind without correspondence to a repaired shape that is cut.

    Parameters
    ----------
    model
        Of the kind.
    shape
        A mesh that is open.
    whole
        The sqrt(area) of a whole shape, in the unit of the file.
    config
        Whether mirror images are looked for, and the seed.

    Returns
    -------
    Fit
        As a part, fair at best; None where it is better seen as a whole, and for a pointwise model.
    """
    if not model.has_nodes:
        return None
    viscous = ViscousConfig(seed=config.seed)
    template = with_more_nodes(model.template, viscous)
    found = fit_without_model(template, shape, viscous, mirror=config.mirror != "no", whole=whole)
    if not found.partial:
        return None
    return _as_of(model, found)


def _as_it_rests(fit: Fit, template: Template) -> Fit:
    """The same fit in the core frame in which the moved template is not turned against the resting one."""
    system = viscous_system(template)
    return _turned_to(system.verts, fit, system)


def _turned_to(points_of_other: Float[Floats, "N 3"], fit: Fit, system: NodeSystem) -> Fit:
    """The same fit in the core frame in which it is not turned against another one of the same vertices."""
    turn = kabsch(points_of_other, fit.points)
    core, points = fit.frame.compose(turn.frame), turn.to_local(fit.points)
    up, front = (axis_name(core.rotation[row]) for row in (1, 2))
    return replace(fit, frame=core, points=points, vectors=system.vectors_to(points), up=up, front=front)


def _from_half_way(
    shapes: tuple[Shape, Shape], fits: tuple[Fit, Fit], config: ViscousConfig
) -> tuple[tuple[Fit, Fit], NodeSystem] | None:
    """Fits of a template that lies half way between two shapes to both of them: each has half as far to go, and neither
    shape is favoured. The mean of two fits leans on what they got wrong, so it is taken anew twice. None where one of the
    shapes does not stand as the mean does.
    """
    first, second = fits
    for how in (config.rough(), config.rough(), config):
        middle = (first.points + kabsch(first.points, second.points).to_local(second.points)) / 2
        template = template_of(Shape(middle, first.faces), "half way", config)
        if how is config:
            template = finest(template, config)
        one, other = parallel_map(partial(fit_from, template, config=how), shapes, (first, second))
        if one is None or other is None:
            return None
        first, second = one, other
    system = viscous_system(template)
    second = _turned_to(first.points, second, system)
    return (_judged_as(first, fits[0]), _judged_as(second, fits[1])), system


def _judged_as(fit: Fit, before: Fit) -> Fit:
    """A fit with the verdict of another one of the same shape."""
    return replace(fit, verdict=before.verdict, reasons=before.reasons, trust=before.trust, notes=before.notes)


def _frame_of(shape: Shape, config: ViscousConfig) -> Frame:
    """From the file of a shape to the template that is made of it."""
    kept, faces = low_mesh(shape, config.faces)
    return sqrt_area_frame(Shape(shape.verts[kept], faces))


def _at_rest(fit: Fit, template: Template, shape: Shape, frame: Frame) -> Fit:
    """The fit of the template to the shape that it is made of, beside that to another one."""
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
