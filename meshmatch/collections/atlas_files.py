"""The folder of an atlas: its arrays, tables, shapes, pictures and page.

==================  ==============================================================================================
atlas.npz           the arrays of `Atlas`, for `Atlas.load`
mean.ply            the mean
modes.glb           the mean; the first modes at +2 and -2 standard deviations as morph targets
scores.csv          a line for each shape: size, distance from the mean, scores in standard deviations
distances.npy       (V, S) 32-bit floats: distance of each vertex of each shape from the mean
measures.csv        compactness, generalisation and specificity
groups.csv          where two groups differ, a line for each vertex
anova.csv, effects.csv, effects.vtp, allometry.csv   a linear model, see `model_files`
atlas.json          all that is one number, or a few
modes.png           the mean and the first three modes at -2 and +2 standard deviations
distances.png       distance from the mean: of all shapes, and of those that are furthest
groups.png          where two groups differ
histogram.png, measures.png   charts, where matplotlib is installed
samples/            random shapes
page.html           a page with a slider for each mode
==================  ==============================================================================================
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.atlas_arrays import FILE
from meshmatch.collections.explain import Explained
from meshmatch.collections.groups import Comparison
from meshmatch.collections.measures import Measures
from meshmatch.collections.model_files import LEVEL, model_record, short, write_model
from meshmatch.render.charts import draw_beside, draw_histogram
from meshmatch.render.facing import facing
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import Scale
from meshmatch.render.viewer.single_pages import Varying, write_atlas_page
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.formats.gltf_out import write_morphs
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_rows

MORPHS = 10
"""Modes in modes.glb."""
REACH = 2.0
"""Standard deviations at which modes are shown."""
_SHOWN, _FURTHEST = 3, 3  # modes and shapes in pictures
_BLOCK = 64  # shapes at a time


@dataclass(frozen=True, eq=False)
class Findings:
    """What was found out about an atlas beside itself; what was not asked for is None. ``groups`` are names of A and B."""

    measures: Measures | None = None
    comparison: Comparison | None = None
    groups: tuple[str, str] = ("A", "B")
    explained: Explained | None = None
    samples: int = 0
    seed: int = 0


def write_folder(
    folder: Path,
    atlas: Atlas,
    findings: Findings = Findings(),
    *,
    rotation: Float[Floats, "3 3"] | None = None,
    title: str = "atlas",
) -> list[str]:
    """Write an atlas into an empty folder; the names of the files. ``rotation`` leads into y up, z to the front, and is
    guessed if not given. `OutputError` where something cannot be written.
    """
    turn = facing(atlas.mean_shape) if rotation is None else rotation
    atlas.save(folder / FILE)
    save_shape(folder / "mean.ply", atlas.mean_shape)
    _write_morphs(folder / "modes.glb", atlas)
    _write_scores(folder / "scores.csv", atlas)
    _write_distances(folder / "distances.npy", atlas)
    if findings.measures is not None:
        _write_measures(folder / "measures.csv", findings.measures)
    if findings.comparison is not None:
        _write_comparison(folder / "groups.csv", findings.comparison)
        _draw_comparison(folder / "groups.png", atlas, findings, turn)
    if findings.explained is not None:
        write_model(folder, atlas.mean_shape, findings.explained)
    (folder / "atlas.json").write_text(json.dumps(record(atlas, findings), indent=1) + "\n", encoding="utf-8")
    _draw_modes(folder / "modes.png", atlas, turn)
    _draw_distances(folder / "distances.png", atlas, turn)
    if find_spec("matplotlib") is not None:
        _draw_charts(folder, atlas, findings.measures)
    if findings.samples:
        (folder / "samples").mkdir()
        for shape in atlas.sample(findings.samples, findings.seed):
            save_shape(folder / "samples" / f"{shape.name}.ply", shape)
    by_one = atlas.modes * atlas.deviations[:, None, None]
    varying = Varying(atlas.mean_shape, by_one, atlas.variances / atlas.total, atlas.scores, atlas.names)
    write_atlas_page(folder / "page.html", varying, rotation=turn, title=title)
    return sorted(path.name for path in folder.iterdir())


def record(atlas: Atlas, findings: Findings) -> dict[str, Any]:
    """What an atlas is, and what was found out about it, for JSON."""
    found: dict[str, Any] = {
        "shapes": len(atlas.names),
        "vertices": len(atlas.mean),
        "modes": len(atlas.modes),
        "scale": atlas.scale,
        "robust": atlas.robust,
        "deviations": short(atlas.deviations),
        "compactness": short(atlas.compactness),
        "furthest": {atlas.names[k]: short(atlas.distances[k]) for k in _furthest(atlas)},
        "samples": findings.samples,
        "seed": findings.seed,
    }
    if findings.measures is not None:
        found["measures"] = {each.name: short(getattr(findings.measures, each.name)) for each in fields(Measures)}
    if findings.comparison is not None:
        about = findings.comparison
        found["groups"] = {
            "names": list(findings.groups),
            "counts": list(about.counts),
            "statistic": about.kind,
            "p_overall": short(about.p_overall),
            "p_anywhere": short(float(about.p_corrected.min())),
            "vertices_corrected": int((about.p_corrected <= LEVEL).sum()),
            "vertices_fdr": int((about.p_fdr <= LEVEL).sum()),
            "level": LEVEL,
            "labellings": about.labellings,
            "exact": about.exact,
            "seed": about.seed,
        }
    if findings.explained is not None:
        found["model"] = model_record(findings.explained)
    return found


def _furthest(atlas: Atlas) -> list[int]:
    rows: list[int] = np.argsort(-atlas.distances, kind="stable")[:_FURTHEST].tolist()
    return rows


def _write_morphs(path: Path, atlas: Atlas) -> None:
    targets = {}
    for k in range(min(MORPHS, len(atlas.modes))):
        for sign in (1, -1):
            name = f"mode {k + 1}, {sign * REACH:+g} sd"
            targets[name] = atlas.mean + sign * REACH * atlas.deviations[k] * atlas.modes[k]
    write_morphs(path, atlas.mean_shape, targets)


def _write_scores(path: Path, atlas: Atlas) -> None:
    header = ["name", "centroid_size", "distance", *(f"mode_{k + 1}" for k in range(len(atlas.modes)))]
    table = np.column_stack([atlas.sizes, atlas.distances, atlas.scores])
    write_rows(path, header, ([name, *short(row)] for name, row in zip(atlas.names, table, strict=True)))


def _write_distances(path: Path, atlas: Atlas) -> None:
    size = len(atlas.mean), len(atlas.names)
    found = np.lib.format.open_memmap(path, mode="w+", dtype="<f4", shape=size)
    for low in range(0, len(atlas.names), _BLOCK):
        some = slice(low, low + _BLOCK)
        found[:, some] = np.linalg.norm(atlas.offsets(atlas.scores[some]), axis=2).T
    found.flush()


def _write_measures(path: Path, measures: Measures) -> None:
    names = [each.name for each in fields(Measures) if isinstance(getattr(measures, each.name), np.ndarray)]
    columns = [short(getattr(measures, name)) for name in names]
    write_rows(path, ["modes", *names[1:]], zip(*columns, strict=True))


def _write_comparison(path: Path, found: Comparison) -> None:
    names = ["along_normal", "statistic", "p", "p_corrected", "p_fdr"]
    table = np.column_stack([found.difference, *(getattr(found, name) for name in names)])
    rows = ([k, *short(row)] for k, row in enumerate(table))
    write_rows(path, ["vertex", "dx", "dy", "dz", *names], rows)


def _draw_modes(path: Path, atlas: Atlas, turn: Float[Floats, "3 3"]) -> None:
    """In one scale; colors say where the surface moves in and out, of each mode by itself."""
    mean, normals = atlas.mean_shape, atlas.mean_shape.vertex_normals
    scores = np.zeros((2 * min(_SHOWN, len(atlas.modes)), len(atlas.modes)))
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


def _draw_distances(path: Path, atlas: Atlas, turn: Float[Floats, "3 3"]) -> None:
    mean = atlas.mean_shape
    spread = np.sqrt(np.einsum("m,mvi->v", atlas.variances, np.square(atlas.modes)))
    rows = _furthest(atlas)
    offsets = atlas.offsets(atlas.scores[rows])
    apart = np.linalg.norm(offsets, axis=2)
    scale = Scale.of(np.concatenate([spread, apart.ravel()]), "distance from the mean (unit of the files)")
    unit = float(np.sqrt(mean.area))
    panels = [Panel(mean, scale.colors(spread), "all: root mean square", rotation=turn, unit=unit)]
    for row, offset, far in zip(rows, offsets, apart, strict=True):
        shape = Shape(mean.verts + offset, mean.faces)
        panels.append(Panel(shape, scale.colors(far), atlas.names[row], rotation=turn, unit=unit))
    render_shapes(panels, path, Look(legend=scale))


def _draw_comparison(path: Path, atlas: Atlas, findings: Findings, turn: Float[Floats, "3 3"]) -> None:
    found, (first, second) = findings.comparison, findings.groups
    assert found is not None
    along = found.along_normal
    title = f"{second} - {first}, along the outward normal (unit of the files)"
    scale = Scale.of(np.concatenate([along, -along]), title)
    panels = [
        Panel(atlas.mean_shape, scale.colors(np.where(shown, along, np.nan)), label, rotation=turn)
        for label, shown in {
            "difference": np.ones(len(along), bool),
            f"false discovery rate <= {LEVEL:.0%}": found.p_fdr <= LEVEL,
            f"family-wise p <= {LEVEL:g}": found.p_corrected <= LEVEL,
        }.items()
    ]
    render_shapes(panels, path, Look(legend=scale))


def _draw_charts(folder: Path, atlas: Atlas, measures: Measures | None) -> None:
    furthest = _furthest(atlas)[0]
    apart = atlas.distances.tolist()
    marks = {apart[furthest]: atlas.names[furthest]}
    draw_histogram(folder / "histogram.png", apart, "distance from the mean (unit of the files)", "shapes", marks)
    if measures is None:
        return
    x, unit = measures.counts.tolist(), "distance (unit of the files)"
    both = {"generalisation": "left out one by one", "specificity": "random shapes"}
    charts: dict[str, Any] = {"compactness": ("share of the variance", {"": (x, measures.compactness.tolist())})}
    for name, title in both.items():
        lines = {"points": getattr(measures, name), "surfaces": getattr(measures, f"{name}_surface")}
        charts[f"{name}: {title}"] = (unit, {key: (x, values.tolist()) for key, values in lines.items()})
    draw_beside(charts, folder / "measures.png", "modes")
