"""Write the folder of an atlas: arrays, tables, shapes, pictures and a page.

==================  ==============================================================================================
atlas.npz           the arrays of `Atlas`, for `Atlas.load`
mean.ply            the mean
mean.vtp            the mean, with its spread and the displacements by the first modes, for ParaView and 3D Slicer
modes.glb           the mean; the first modes at +2 and -2 standard deviations as morph targets
scores.csv          a row for each shape: size, distance from the mean, scores in standard deviations
components.csv      the same scores in the unit of the files
distances.npy       (V, S) 32-bit floats: distance of each vertex of each shape from the mean
measures.csv        compactness, generalisation and specificity
groups.csv          where two groups differ, a row for each vertex
groups.vtp          the same on the mean
anova.csv, effects.csv, effects.vtp, allometry.csv   a linear model, see `model_files`
atlas.json          all results that are single numbers or short lists
modes.png           the mean and the first three modes at -2 and +2 standard deviations
distances.png       distance from the mean: root mean square of all shapes, and the furthest shapes
groups.png          where two groups differ
histogram.png, measures.png, scree.png, components.png, allometry.png   charts, where matplotlib is installed
symmetry.csv, asymmetry.csv, asymmetry.vtp, asymmetry.png, fluctuating.png   shapes compared with their mirror images
effect-1-sex-m-f.png   displacement by each coefficient of a model, and where it is significant
samples/            random shapes
page.html           a page with a slider for each mode
==================  ==============================================================================================
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.collections.asymmetry import Asymmetry
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.atlas_arrays import FILE
from meshmatch.collections.atlas_pictures import (
    REACH,
    ChartFormat,
    draw_allometry,
    draw_asymmetry,
    draw_charts,
    draw_distances,
    draw_effect,
    draw_effects,
    draw_modes,
    draw_scores,
    furthest,
)
from meshmatch.collections.explain import Explained
from meshmatch.collections.groups import Comparison
from meshmatch.collections.measures import Measures
from meshmatch.collections.model_files import (
    LEVEL,
    asymmetry_record,
    model_record,
    rounded,
    write_asymmetry,
    write_model,
)
from meshmatch.collections.named_parts import WHOLE
from meshmatch.collections.registered import find_outliers
from meshmatch.render.facing import guess_rotation
from meshmatch.render.viewer.single_pages import Varying, write_atlas_page
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.formats.gltf_write import write_morphs
from meshmatch.shapes.formats.vtk import write_vtp
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_rows

MORPHS = 10
"""Largest number of modes in modes.glb."""
_NOT_ON_PAGE = ("modes", "distances", "histogram")
_BLOCK = 64  # shapes processed at a time


@dataclass(frozen=True, eq=False)
class AtlasResults:
    """Results of analyses of an atlas, None for those that were not requested; and options of the output.

    ``groups`` are the names of the two compared groups, and ``members`` maps the names of shapes to the group of each.
    ``samples`` random shapes are written, drawn with ``seed``. ``charts`` is the format of charts; ``align_by`` says what
    was superimposed.
    """

    measures: Measures | None = None
    comparison: Comparison | None = None
    groups: tuple[str, str] = ("A", "B")
    explained: Explained | None = None
    samples: int = 0
    seed: int = 0
    charts: ChartFormat = "png"
    members: Mapping[str, str] = field(default_factory=dict)
    asymmetry: Asymmetry | None = None
    align_by: str = WHOLE

    def classes(self, atlas: Atlas) -> list[str]:
        """The group of each shape in charts: of the comparison, else of the linear model; "" if it has none."""
        known = self.members
        if self.explained is not None and not known:
            known = dict(zip(self.explained.names, self.explained.groups, strict=False))
        return [known.get(name, "") for name in atlas.names]


def write_folder(
    folder: Path,
    atlas: Atlas,
    findings: AtlasResults = AtlasResults(),
    *,
    rotation: Float[Floats, "3 3"] | None = None,
    title: str = "atlas",
) -> list[str]:
    """Write an atlas into an empty folder, and return the names of the files.

    ``rotation`` turns the mean to y up and z to the front; it is guessed if not given. `OutputError` if a file cannot be
    written.
    """
    turn = guess_rotation(atlas.mean_shape) if rotation is None else rotation
    atlas.save(folder / FILE)
    save_shape(folder / "mean.ply", atlas.mean_shape)
    _write_mean(folder / "mean.vtp", atlas)
    _write_morphs(folder / "modes.glb", atlas)
    _write_scores(folder / "scores.csv", atlas)
    _write_components(folder / "components.csv", atlas)
    _write_distances(folder / "distances.npy", atlas)
    if findings.measures is not None:
        _write_measures(folder / "measures.csv", findings.measures)
    if findings.comparison is not None:
        _write_comparison(folder, atlas.mean_shape, findings.comparison)
        first, second = findings.groups
        about = findings.comparison
        name = f"{second} - {first}"
        draw_effect(folder / "groups.png", atlas.mean_shape, name, about.along_normal, about, turn)
    if findings.explained is not None:
        write_model(folder, atlas.mean_shape, findings.explained)
        draw_effects(folder, atlas.mean_shape, findings.explained, turn)
    if findings.asymmetry is not None:
        write_asymmetry(folder, atlas.mean_shape, findings.asymmetry)
        draw_asymmetry(folder, atlas.mean_shape, findings.asymmetry, turn)
    (folder / "atlas.json").write_text(json.dumps(atlas_record(atlas, findings), indent=1) + "\n", encoding="utf-8")
    draw_modes(folder / "modes.png", atlas, turn)
    draw_distances(folder / "distances.png", atlas, turn)
    if find_spec("matplotlib") is not None:
        draw_charts(folder, atlas, findings.measures, findings.charts)
        grouped_by = "" if findings.members or findings.explained is None else findings.explained.grouped_by
        draw_scores(folder, atlas, findings.classes(atlas), findings.charts, turn, grouped_by)
        if findings.explained is not None and findings.explained.allometry is not None:
            draw_allometry(folder, findings.explained, findings.explained.allometry, findings.charts)
    if findings.samples:
        (folder / "samples").mkdir()
        for shape in atlas.sample(findings.samples, findings.seed):
            save_shape(folder / "samples" / f"{shape.name}.ply", shape)
    by_one = atlas.modes * atlas.deviations[:, None, None]
    varying = Varying(
        atlas.mean_shape, by_one, atlas.variances / atlas.total, atlas.scores, atlas.names, _figures(folder)
    )
    write_atlas_page(folder / "page.html", varying, rotation=turn, title=title)
    return sorted(path.name for path in folder.iterdir())


def _figures(folder: Path) -> list[Path]:
    """Pictures to show on the page: charts and effects, but not the modes, which are interactive there."""
    shown = [path for path in folder.iterdir() if path.suffix in (".png", ".svg")]
    return sorted(path for path in shown if path.stem not in _NOT_ON_PAGE)


def atlas_record(atlas: Atlas, findings: AtlasResults) -> dict[str, Any]:
    """Summary of an atlas and of the analyses, as JSON values."""
    found: dict[str, Any] = {
        "shapes": len(atlas.names),
        "vertices": len(atlas.mean),
        "modes": len(atlas.modes),
        "scale": atlas.scale,
        "align_by": findings.align_by,
        "robust": atlas.robust,
        "deviations": rounded(atlas.deviations),
        "compactness": rounded(atlas.compactness),
        "outliers": [atlas.names[k] for k in find_outliers(atlas.distances)],
        "furthest": {atlas.names[k]: rounded(atlas.distances[k]) for k in furthest(atlas)},
        "samples": findings.samples,
        "seed": findings.seed,
    }
    if findings.measures is not None:
        found["measures"] = {each.name: rounded(getattr(findings.measures, each.name)) for each in fields(Measures)}
    if findings.comparison is not None:
        about = findings.comparison
        found["groups"] = {
            "names": list(findings.groups),
            "counts": list(about.counts),
            "statistic": about.kind,
            "p_overall": rounded(about.p_overall),
            "p_anywhere": rounded(float(about.p_corrected.min())),
            "vertices_corrected": int((about.p_corrected <= LEVEL).sum()),
            "vertices_fdr": int((about.p_fdr <= LEVEL).sum()),
            "level": LEVEL,
            "labellings": about.labellings,
            "exact": about.exact,
            "seed": about.seed,
        }
    if findings.explained is not None:
        found["model"] = model_record(findings.explained)
    if findings.asymmetry is not None:
        found["asymmetry"] = asymmetry_record(findings.asymmetry)
    return found


def _write_mean(path: Path, atlas: Atlas) -> None:
    """Write the mean with the spread of its vertices and their displacements by one standard deviation of each mode."""
    spread = np.sqrt(np.einsum("m,mvi->v", atlas.variances, np.square(atlas.modes)))
    modes = {f"mode_{k + 1}": atlas.deviations[k] * mode for k, mode in enumerate(atlas.modes[:MORPHS])}
    write_vtp(path, atlas.mean_shape, {"spread": spread} | modes)


def _write_morphs(path: Path, atlas: Atlas) -> None:
    targets = {}
    for k in range(min(MORPHS, len(atlas.modes))):
        for sign in (1, -1):
            name = f"mode {k + 1}, {sign * REACH:+g} sd"
            targets[name] = atlas.mean + sign * REACH * atlas.deviations[k] * atlas.modes[k]
    write_morphs(path, atlas.mean_shape, targets)


def _write_scores(path: Path, atlas: Atlas) -> None:
    header = ["name", "size", "distance", *(f"mode_{k + 1}" for k in range(len(atlas.modes)))]
    table = np.column_stack([atlas.sizes, atlas.distances, atlas.scores])
    write_rows(path, header, ([name, *rounded(row)] for name, row in zip(atlas.names, table, strict=True)))


def _write_components(path: Path, atlas: Atlas) -> None:
    """Write scores in the unit of the files, so that their variances are those of the modes."""
    table = atlas.scores * atlas.deviations
    header = ["name", *(f"PC{k + 1}" for k in range(len(atlas.modes)))]
    write_rows(path, header, ([name, *rounded(row)] for name, row in zip(atlas.names, table, strict=True)))


def _write_distances(path: Path, atlas: Atlas) -> None:
    size = len(atlas.mean), len(atlas.names)
    found = np.lib.format.open_memmap(path, mode="w+", dtype="<f4", shape=size)
    for low in range(0, len(atlas.names), _BLOCK):
        some = slice(low, low + _BLOCK)
        found[:, some] = np.linalg.norm(atlas.offsets(atlas.scores[some]), axis=2).T
    found.flush()


def _write_measures(path: Path, measures: Measures) -> None:
    names = [each.name for each in fields(Measures) if isinstance(getattr(measures, each.name), np.ndarray)]
    columns = [rounded(getattr(measures, name)) for name in names]
    write_rows(path, ["modes", *names[1:]], zip(*columns, strict=True))


def _write_comparison(folder: Path, mean: Shape, found: Comparison) -> None:
    names = ["along_normal", "statistic", "p", "p_corrected", "p_fdr"]
    arrays = {"difference": found.difference} | {name: getattr(found, name) for name in names}
    write_vtp(folder / "groups.vtp", mean, arrays)
    table = np.column_stack(list(arrays.values()))
    rows = ([k, *rounded(row)] for k, row in enumerate(table))
    write_rows(folder / "groups.csv", ["vertex", "dx", "dy", "dz", *names], rows)
