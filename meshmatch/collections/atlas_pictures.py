"""Pictures and charts of an atlas: modes, shapes, and the results of analyses."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from meshmatch.arrays import Float, Floats, UInts8
from meshmatch.collections.asymmetry import Asymmetry
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.explain import Allometry, Explained
from meshmatch.collections.groups import Comparison
from meshmatch.collections.measures import Measures
from meshmatch.collections.model_files import LEVEL
from meshmatch.collections.permutation import PlaceTests
from meshmatch.render.charts import Dots, draw_dots, draw_histogram, draw_panels, draw_scree
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, draw_apart, render_shapes
from meshmatch.render.scales import Scale, nice_step, readable
from meshmatch.shapes.shape import Shape

ChartFormat = Literal["png", "svg", "pdf"]
REACH = 2.0
"""Modes are shown at plus and minus this many standard deviations."""
SHOWN, FURTHEST = 3, 3
"""Number of modes, and of the shapes furthest from the mean, in pictures."""
_MAX_EFFECTS = 12  # pictures of a linear model
_AXIS_IMAGE_SIZE = 260  # longest side of the images at the ends of axes, in pixels
_BACK = np.diag([-1.0, 1.0, -1.0])
_STEEP = 0.95  # cosine with the up axis from which on a view counts as straight from above or below
_NEIGHBOURHOOD = 0.1  # radius around a vertex within which normals are averaged for the view, in sqrt(area)


def furthest(atlas: Atlas) -> list[int]:
    """Rows of the shapes furthest from the mean, the furthest first."""
    rows: list[int] = np.argsort(-atlas.distances, kind="stable")[:FURTHEST].tolist()
    return rows


def draw_modes(path: Path, atlas: Atlas, turn: Float[Floats, "3 3"]) -> None:
    """Draw the mean and the first modes at one scale.

    Colors show displacement along the normal, as a share of the mode's largest displacement. ``turn`` rotates the atlas
    to y up and z to the front, here and below.
    """
    mean, normals = atlas.mean_shape, atlas.mean_shape.vertex_normals
    scores = np.zeros((2 * min(SHOWN, len(atlas.modes)), len(atlas.modes)))
    for row in range(len(scores)):
        scores[row, row // 2] = REACH if row % 2 else -REACH
    offsets = atlas.offsets(scores)
    along = np.einsum("nvi,vi->nv", offsets, normals)
    along /= np.maximum(np.linalg.norm(offsets, axis=2).max(axis=1), 1e-300)[:, None]
    scale = Scale(-1, 1, "displacement outwards, as a share of the mode's largest displacement")
    unit = float(np.sqrt(mean.area))
    panels = [Panel(mean, label="mean", rotation=turn, unit=unit)]
    for row, offset in enumerate(offsets):
        share = 100 * atlas.variances[row // 2] / atlas.total
        label = f"mode {row // 2 + 1} ({share:.3g} %), {'+' if row % 2 else '-'}{REACH:g} sd"
        moved = Shape(mean.verts + offset, mean.faces)
        panels.append(Panel(moved, scale.colors(along[row]), label, rotation=turn, unit=unit))
    render_shapes(panels, path, Look(legend=scale))


def draw_distances(path: Path, atlas: Atlas, turn: Float[Floats, "3 3"]) -> None:
    """Draw distances from the mean: their root mean square over all shapes, and the shapes furthest from the mean."""
    mean = atlas.mean_shape
    spread = np.sqrt(np.einsum("m,mvi->v", atlas.variances, np.square(atlas.modes)))
    rows = furthest(atlas)
    offsets = atlas.offsets(atlas.scores[rows])
    apart = np.linalg.norm(offsets, axis=2)
    scale = Scale.of(np.concatenate([spread, apart.ravel()]), "distance from the mean (unit of the files)")
    unit = float(np.sqrt(mean.area))
    panels = [Panel(mean, scale.colors(spread), "all: root mean square", rotation=turn, unit=unit)]
    for row, offset, far in zip(rows, offsets, apart, strict=True):
        shape = Shape(mean.verts + offset, mean.faces)
        panels.append(Panel(shape, scale.colors(far), atlas.names[row], rotation=turn, unit=unit))
    render_shapes(panels, path, Look(legend=scale))


def draw_effects(folder: Path, mean: Shape, found: Explained, turn: Float[Floats, "3 3"]) -> None:
    """Draw a picture of each tested coefficient of a linear model, at most 12."""
    shown = [
        (name, along, effect.places)
        for effect in found.table.effects
        for name, along in zip(effect.coefficients, effect.along_normal, strict=True)
        if effect.places is not None
    ]
    for number, (name, along, places) in enumerate(shown[:_MAX_EFFECTS], 1):
        slug = re.sub(r"[^a-z0-9]+", "-", readable(name).lower()).strip("-")[:40]
        draw_effect(folder / f"effect-{number}-{slug}.png", mean, name, along, places, turn)


def draw_effect(
    path: Path,
    mean: Shape,
    name: str,
    along: Float[Floats, " V"],
    found: Comparison | PlaceTests,
    turn: Float[Floats, "3 3"],
) -> None:
    """Draw a displacement of the mean along its normals: everywhere, and where it is significant.

    The view is towards the largest significant displacement, or the largest statistic if none is significant; a second
    view is from behind.
    """
    most = float(np.abs(along).max()) or 1.0
    step = nice_step(most, 4)
    most = step * np.ceil(most / step)
    scale = Scale.of(along, f"{name}: displacement outwards (unit of the files)", (-most, most))
    significant = found.p_corrected <= LEVEL
    front = _view_of(mean, int(np.argmax(significant * np.abs(along) if significant.any() else found.statistic)), turn)
    shown = {
        "displacement": np.ones(len(along), bool),
        f"false discovery rate <= {LEVEL:g}": found.p_fdr <= LEVEL,
        f"family-wise p <= {LEVEL:g}": significant,
    }
    panels = []
    for label, kept in shown.items():
        colors = scale.colors(np.where(kept, along, np.nan))
        panels.append(Panel(mean, colors, label, rotation=front))
        panels.append(Panel(mean, colors, "from behind", rotation=_BACK @ front))
    render_shapes(panels, path, Look(turn=0, tilt=0, legend=scale))


def draw_asymmetry(folder: Path, mean: Shape, found: Asymmetry, turn: Float[Floats, "3 3"]) -> None:
    """Draw directional asymmetry (see `draw_effect`) and the size of fluctuating asymmetry, viewed where it is largest.

    If errors of measurement are known, also where fluctuating asymmetry is significantly larger than these.
    """
    side = found.directional
    if side.places is not None:
        name = side.coefficients[0] if found.matching else "a side less the mirror image of the other"
        draw_effect(folder / "asymmetry.png", mean, name, side.along_normal[0], side.places, turn)
    scale = Scale.of(found.fluctuating, "fluctuating asymmetry, root mean square (unit of the files)")
    front = _view_of(mean, int(np.argmax(found.fluctuating)), turn)
    shown = {"": np.ones(len(found.fluctuating), bool)}
    places = found.table.effects[-1].places
    if found.error is not None and places is not None:
        shown = {"all": shown[""], f"more than errors, family-wise p <= {LEVEL:g}": places.p_corrected <= LEVEL}
    panels = []
    for label, kept in shown.items():
        colors = scale.colors(np.where(kept, found.fluctuating, np.nan))
        panels.append(Panel(mean, colors, label, rotation=front))
        panels.append(Panel(mean, colors, "from behind", rotation=_BACK @ front))
    render_shapes(panels, folder / "fluctuating.png", Look(turn=0, tilt=0, legend=scale))


def _view_of(mean: Shape, vertex: int, turn: Float[Floats, "3 3"]) -> Float[Floats, "3 3"]:
    """The rotation that turns a vertex of a surface towards the viewer, with the shape's up axis as upright as possible."""
    near = np.linalg.norm(mean.verts - mean.verts[vertex], axis=1) < _NEIGHBOURHOOD * np.sqrt(mean.area)
    ahead = mean.vertex_normals[near].sum(axis=0)
    ahead = ahead / np.linalg.norm(ahead) if np.linalg.norm(ahead) > 1e-9 else turn[2]
    right = np.cross(turn[1] if abs(turn[1] @ ahead) < _STEEP else -turn[2], ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def draw_charts(folder: Path, atlas: Atlas, measures: Measures | None, kind: ChartFormat) -> None:
    """Draw a histogram of distances from the mean, and the measures of the atlas by number of modes."""
    apart = atlas.distances.tolist()
    far = furthest(atlas)[0]
    marks = {apart[far]: atlas.names[far]}
    draw_histogram(folder / f"histogram.{kind}", apart, "distance from the mean (unit of the files)", "shapes", marks)
    if measures is None:
        return
    x, unit = measures.counts.tolist(), "distance (unit of the files)"
    both = {"generalisation": "left out one by one", "specificity": "random shapes"}
    charts: dict[str, Any] = {"compactness": ("share of the variance", {"": (x, measures.compactness.tolist())})}
    for name, title in both.items():
        lines = {"points": getattr(measures, name), "surfaces": getattr(measures, f"{name}_surface")}
        charts[f"{name}: {title}"] = (unit, {key: (x, values.tolist()) for key, values in lines.items()})
    draw_panels(charts, folder / f"measures.{kind}", "modes")


def draw_scores(
    folder: Path,
    atlas: Atlas,
    groups: Sequence[str],
    kind: ChartFormat,
    turn: Float[Floats, "3 3"],
    grouped_by: str = "",
) -> None:
    """Draw the share of the variance of each mode (scree plot), and the scores of the shapes along the first two modes.

    The latter has hulls of groups, and images of the mean at the ends of both axes.
    """
    shares = atlas.variances / atlas.total
    draw_scree(folder / f"scree.{kind}", shares.tolist(), len(atlas.names) - 1)
    if len(shares) < 2:
        return
    points = (atlas.scores * atlas.deviations)[:, :2]
    names = {row: atlas.names[row] for row in furthest(atlas)}
    axes = [f"PC{k + 1} ({100 * shares[k]:.3g} %)" for k in range(2)]
    dots = Dots(
        points[:, 0].tolist(),
        points[:, 1].tolist(),
        f"{axes[0]}, unit of the files",
        axes[1],
        names,
        _axis_images(atlas, turn),
    )
    draw_dots(folder / f"components.{kind}", [dots], groups, hulls=True, grouped_by=grouped_by)


def _axis_images(atlas: Atlas, turn: Float[Floats, "3 3"]) -> list[tuple[str, UInts8]]:
    """Labels and images of the mean at minus and plus `REACH` deviations along the first mode, then the second."""
    mean = atlas.mean_shape
    ends = {f"PC{k + 1} {sign * REACH:+g} sd": (k, sign * REACH) for k in range(2) for sign in (-1, 1)}
    scores = np.zeros((len(ends), len(atlas.modes)))
    for row, (mode, score) in zip(scores, ends.values(), strict=True):
        row[mode] = score
    unit = float(np.sqrt(mean.area))
    panels = [Panel(Shape(mean.verts + by, mean.faces), rotation=turn, unit=unit) for by in atlas.offsets(scores)]
    return list(zip(ends, draw_apart(panels, _AXIS_IMAGE_SIZE), strict=True))


def draw_allometry(folder: Path, found: Explained, about: Allometry, kind: ChartFormat) -> None:
    """Draw the allometry scores of each shape of a linear model against size, with a regression line for each group."""
    scores = {
        "common allometric component (CAC)": about.cac,
        "regression score (RegScore)": about.regression_scores,
        "PC1 of predicted shapes": about.predicted,
    }
    dots = [Dots(about.sizes.tolist(), values.tolist(), about.label, title) for title, values in scores.items()]
    groups = found.groups or [""] * len(found.names)
    draw_dots(folder / f"allometry.{kind}", dots, groups, hulls=False, grouped_by=found.grouped_by)
