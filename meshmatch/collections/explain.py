"""Linear models of the shapes of an atlas: parse the `formula`, join the `covariates`, run the `anova`, and allometry."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from meshmatch.arrays import Float, Floats, set_read_only
from meshmatch.collections.anova import Variances, analyse
from meshmatch.collections.covariates import SIZE, Covariates, DesignTerm, complete_rows, design_terms
from meshmatch.collections.formula import Factor, parse
from meshmatch.collections.groups import STATISTICS, Statistic
from meshmatch.collections.permutation import check_permutations
from meshmatch.errors import OptionError
from meshmatch.scalars import check_seed


@dataclass(frozen=True, eq=False)
class Allometry:
    """Allometry: the covariation of shape with size, for the S shapes of a model.

    Attributes
    ----------
    label : the size as in the model, such as log(size)
    sizes : (S,) its values
    axis : (V, 3) the common allometric component, the direction in which shapes change with size within groups:
        displacement of the surface by one unit of ``cac``
    cac : (S,) scores along that component (Mitteroecker et al. 2004)
    regression_scores : (S,) scores along the regression of shape on size alone (Drake and Klingenberg 2008)
    predicted : (S,) first principal component of the shapes predicted by the whole model (Adams and Nistri 2010)
    residual : (S,) first principal component of the shapes after the common allometric component is removed
    """

    label: str
    sizes: Float[Floats, " S"]
    axis: Float[Floats, "V 3"]
    cac: Float[Floats, " S"]
    regression_scores: Float[Floats, " S"]
    predicted: Float[Floats, " S"]
    residual: Float[Floats, " S"]


@dataclass(frozen=True, eq=False)
class Explained:
    """The result of a linear model of the shapes of an atlas.

    Attributes
    ----------
    formula : the formula as it was parsed
    kind : what is tested at vertices: displacements along the normal ("normal") or in all directions ("hotelling")
    names : names of the S shapes in the model
    left_out : names of shapes with incomplete data, each with a column whose value is missing
    columns : how each column was interpreted: as numbers or as categories
    blocks : the column within whose values shapes were exchanged; "" for none
    groups : (S,) values of the first column of categories; empty if there is none
    grouped_by : name of that column; "" if there is none
    table : sums of squares, effects and their tests
    allometry : covariation of shape with size; None if size is not a term of the model
    """

    formula: str
    kind: Statistic
    names: tuple[str, ...]
    left_out: dict[str, str]
    columns: dict[str, str]
    blocks: str
    groups: tuple[str, ...]
    grouped_by: str
    table: Variances
    allometry: Allometry | None


def explain(
    formula: str,
    known: Covariates,
    points: Float[Floats, "S M"],
    offsets: Callable[[Floats], Floats],
    normals: Float[Floats, "V 3"],
    scale: Literal["keep", "remove"],
    *,
    blocks: str | None = None,
    kind: Statistic = "normal",
    permutations: int = 1000,
    seed: int = 0,
) -> Explained:
    """Fit and test a linear model of shapes; see `Atlas.anova`.

    ``points`` are the shapes in an orthonormal frame, which ``offsets`` converts from (N, M) to displacements (N, V, 3).
    """
    if kind not in STATISTICS:
        raise OptionError(f"invalid statistic {kind!r}", f"choose one of {', '.join(STATISTICS)}")
    check_permutations(permutations)
    check_seed(seed)
    model = parse(formula)
    if (model.space == "shape") != (scale == "remove"):
        kept = "keeps the shapes' sizes" if scale == "keep" else "has shapes of one size"
        other = "form" if scale == "keep" else "shape"
        raise OptionError(f"the atlas {kept}, and the formula is of {model.space}", f"write {other} ~ ...")
    rows, left_out = complete_rows(model, blocks, known)
    used = known.select(rows)
    terms, interpretation = design_terms(model, used)
    centered = points[rows] - points[rows].mean(axis=0)
    groups = None if blocks is None else np.unique(used.column(blocks), return_inverse=True)[1]
    table = analyse(
        centered,
        offsets(centered),
        terms,
        normals,
        along=kind == "normal",
        blocks=groups,
        permutations=permutations,
        seed=seed,
    )
    singles = {term[0]: design_term for term, design_term in zip(model.terms, terms, strict=True) if len(term) == 1}
    categories = [factor for factor, term in singles.items() if term.coefficients != (str(factor),)]
    return Explained(
        formula=str(model),
        kind=kind,
        names=used.names,
        left_out=left_out,
        columns=interpretation,
        blocks=blocks or "",
        groups=used.column(categories[0].column) if categories else (),
        grouped_by=categories[0].column if categories else "",
        table=table,
        allometry=_allometry(centered, offsets, terms, singles, categories),
    )


def _allometry(
    points: Float[Floats, "S M"],
    offsets: Callable[[Floats], Floats],
    terms: list[DesignTerm],
    singles: dict[Factor, DesignTerm],
    categories: list[Factor],
) -> Allometry | None:
    """Compute the allometry, None if size is not a term by itself; ``points`` have mean 0."""
    size = next((each for each in singles if each.column == SIZE and each not in categories), None)
    if size is None:
        return None
    x = singles[size].columns[:, 0]
    pooled = _residuals(np.column_stack([x, points]), [singles[each].columns for each in categories])
    common = _unit(pooled[:, 0] @ pooled[:, 1:])
    regression = _unit((x - x.mean()) @ points)
    residual = points - np.outer(points @ common, common)
    fitted = points - _residuals(points, [term.columns for term in terms])
    scores = [points @ common, points @ regression, _first_component(fitted, x), _first_component(residual, x)]
    return Allometry(
        str(size), set_read_only(x), set_read_only(offsets(common[None])[0]), *(set_read_only(each) for each in scores)
    )


def _residuals(values: Float[Floats, "S N"], columns: list[Float[Floats, "S C"]]) -> Float[Floats, "S N"]:
    """Residuals of a regression on columns and the mean."""
    given = np.concatenate([np.ones((len(values), 1)), *columns], axis=1)
    given = given / np.linalg.norm(given, axis=0)
    return np.asarray(values - given @ np.linalg.lstsq(given, values, rcond=1e-7)[0])


def _unit(direction: Float[Floats, " M"]) -> Float[Floats, " M"]:
    """Scale a direction to unit length."""
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-300))


def _first_component(points: Float[Floats, "S M"], x: Float[Floats, " S"]) -> Float[Floats, " S"]:
    """Scores along the first principal component, with the sign that makes them increase with x."""
    scores = points @ np.linalg.svd(points, full_matrices=False)[2][0]
    return np.asarray(scores * (1 if (x - x.mean()) @ scores >= 0 else -1))
