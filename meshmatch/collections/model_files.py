"""Write the results of linear models and of asymmetry into the folder of an atlas.

=============  ===================================================================================================
anova.csv      a row for each term, the residuals and the total: df, SS, MS, R2, F, Z, p, and p anywhere
effects.csv    a row for each vertex: displacement by each coefficient; F and p-values of each term
effects.vtp    the same on the mean, for ParaView and 3D Slicer
allometry.csv  a row for each shape: size, allometry scores, group
asymmetry.csv  a row for each individual: difference between its sides, and the same less the mean difference
asymmetry.vtp  directional and fluctuating asymmetry on the mean, and errors of measurement
symmetry.csv   effects of individuals and sides, fluctuating asymmetry and errors of measurement, as in anova.csv
=============  ===================================================================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.collections.anova import Effect, Variances
from meshmatch.collections.asymmetry import Asymmetry
from meshmatch.collections.explain import Allometry, Explained
from meshmatch.errors import visible
from meshmatch.shapes.formats.vtk import write_vtp
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_rows

LEVEL = 0.05
"""Significance level."""
_HEADER = "term", "df", "SS", "MS", "R2", "F", "Z", "p", "p_anywhere"


def write_model(folder: Path, mean: Shape, found: Explained) -> None:
    """Write the tables and maps of a linear model into a folder."""
    write_rows(folder / "anova.csv", _HEADER, _table_rows(model_record(found)))
    arrays = _vertex_arrays(found.table.effects)
    write_vtp(folder / "effects.vtp", mean, arrays)
    header = ["vertex"]
    for name, array in arrays.items():
        header += [name] if array.ndim == 1 else [f"{name}, {axis}" for axis in "xyz"]
    table = np.column_stack(list(arrays.values()))
    write_rows(folder / "effects.csv", header, ([k, *rounded(row)] for k, row in enumerate(table)))
    if found.allometry is not None:
        _write_allometry(folder / "allometry.csv", found, found.allometry)


def write_asymmetry(folder: Path, mean: Shape, found: Asymmetry) -> None:
    """Write the tables and the map of asymmetry into a folder."""
    write_rows(folder / "symmetry.csv", _HEADER, _table_rows(asymmetry_record(found)))
    rows = zip(found.names, rounded(found.total_of), rounded(found.fluctuating_of), strict=True)
    write_rows(folder / "asymmetry.csv", ["name", "asymmetry", "fluctuating"], rows)
    arrays = _vertex_arrays(found.table.effects[1:]) | {"fluctuating": found.fluctuating}
    write_vtp(folder / "asymmetry.vtp", mean, arrays | ({} if found.error is None else {"error": found.error}))


def _vertex_arrays(effects: Sequence[Effect]) -> dict[str, np.ndarray]:
    """Values of the vertices by name; control characters in names are replaced."""
    arrays: dict[str, np.ndarray] = {}
    for effect in effects:
        for name, change, along in zip(effect.coefficients, effect.change, effect.along_normal, strict=True):
            arrays[name] = change
            arrays[f"{name}, along the normal"] = along
        if effect.places is not None:
            about = effect.places
            values = {"F": about.statistic, "p": about.p, "p corrected": about.p_corrected, "p fdr": about.p_fdr}
            arrays |= {f"{effect.name}, {what}": each for what, each in values.items()}
    return {visible(name): values for name, values in arrays.items()}


def _write_allometry(path: Path, found: Explained, about: Allometry) -> None:
    scores = [about.sizes, about.cac, about.regression_scores, about.predicted, about.residual]
    groups = found.groups or ("",) * len(found.names)
    rows = zip(found.names, np.column_stack(scores), groups, strict=True)
    header = ["name", about.label, "CAC", "RegScore", "predicted_PC1", "residual_PC1", "group"]
    write_rows(path, header, ([name, *rounded(row), group] for name, row, group in rows))


def model_record(found: Explained) -> dict[str, Any]:
    """A linear model and its table, as JSON values; None for what was not tested."""
    return {
        "formula": found.formula,
        "shapes": len(found.names),
        "left_out": found.left_out,
        "columns": found.columns,
        "statistic": found.kind,
        "blocks": found.blocks,
        **_table_record(found.table),
    }


def asymmetry_record(found: Asymmetry) -> dict[str, Any]:
    """Asymmetry and its table, as JSON values."""
    told = {
        "matching": found.matching,
        "of_mean": rounded(found.of_mean),
        "of_shapes": dict(zip(found.names, rounded(found.total_of), strict=True)),
        "fluctuating_of_shapes": dict(zip(found.names, rounded(found.fluctuating_of), strict=True)),
    }
    return told | _table_record(found.table, "fluctuating" if found.error is None else "error")


def _table_record(about: Variances, left: str = "residuals") -> dict[str, Any]:
    rest = {"SS": about.residual_ss, "MS": about.residual_ss / about.residual_df}
    rest["R2"] = about.residual_ss / about.total_ss
    return {
        "permutations": about.permutations,
        "exact": about.exact,
        "seed": about.seed,
        "level": LEVEL,
        "terms": [_effect_record(effect) for effect in about.effects],
        "residuals": {"term": left, "df": about.residual_df} | {name: rounded(value) for name, value in rest.items()},
        "total": {"term": "total", "df": about.total_df, "SS": rounded(about.total_ss)},
    }


def _effect_record(effect: Effect) -> dict[str, Any]:
    numbers = effect.ss, effect.ms, effect.r2, effect.f, effect.z, effect.p, effect.p_anywhere
    told = [None if np.isnan(number) else rounded(number) for number in numbers]
    found: dict[str, Any] = dict(zip(_HEADER, (effect.name, effect.df, *told), strict=True))
    if effect.places is not None:
        found["vertices_corrected"] = int((effect.places.p_corrected <= LEVEL).sum())
        found["vertices_fdr"] = int((effect.places.p_fdr <= LEVEL).sum())
    return found


def _table_rows(record: dict[str, Any]) -> list[list[Any]]:
    rows = [*record["terms"], record["residuals"], record["total"]]
    return [["" if row.get(name) is None else row[name] for name in _HEADER] for row in rows]


def anova_rows(record: dict[str, Any]) -> list[list[str]]:
    """The table of a model as text, with the number of vertices at which each term is significant."""
    titles = [*_HEADER[:-1], "p anywhere", f"vertices p <= {LEVEL:g}", f"FDR <= {LEVEL:g}"]
    numbers = [[cell if isinstance(cell, str) else f"{cell:.4g}" for cell in line] for line in _table_rows(record)]
    counts = [[str(term.get(name, "")) for name in ("vertices_corrected", "vertices_fdr")] for term in record["terms"]]
    return [titles, *(line + count for line, count in zip(numbers, [*counts, ["", ""], ["", ""]], strict=True))]


def rounded(values: Any) -> Any:
    """Round floats to six significant digits and convert arrays to lists, for JSON."""
    if isinstance(values, np.ndarray):
        return [rounded(value) for value in values.tolist()]
    return float(f"{values:.6g}") if isinstance(values, float) else values
