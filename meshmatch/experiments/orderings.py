"""The orderings that the paper claims, as statements about cells: does each hold here?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import fmean

from meshmatch.experiments.ablation_cells import GRID, Known
from meshmatch.experiments.ablation_tables import cost_of
from meshmatch.experiments.cells import BASE, Cell
from meshmatch.fields.choice import FIELDS, FieldName, has_nodes

_FULL, _PLAIN = "vol+arap+Z", "none"


@dataclass(frozen=True)
class Claim:
    """A statement, the numbers that it is about from the one that should be least to the largest, and whether it holds.

    ``holds`` is None where something was not measured; ``where`` is empty, a set, or "held out".
    """

    words: str
    numbers: tuple[float, ...]
    holds: bool | None
    where: str = ""


def claims(known: Known, sets: Sequence[str]) -> list[Claim]:
    """All claims, on the held-out shapes and each set."""
    found = _costs(known)
    for where in ("held out", *sets):
        fields = [replace(BASE, field=field) for field in ("mls", "rbf", "pointwise")]
        found.append(_rising(known, where, "with vol+arap+Z: mls < rbf < pointwise", fields))
        under = [replace(BASE, constraint=each) for each in (_FULL, "vol+arap", _PLAIN)]
        found.append(_rising(known, where, "mls: vol+arap+Z < vol+arap < none", under))
        both = [replace(BASE, constraint=each) for each in ("vol+arap", _PLAIN)]
        found.append(_rising(known, where, "mls: both regularisers < none", both))
        worse = [replace(BASE, field="pointwise", constraint=each) for each in ("vol+arap", _FULL)]
        found.append(_rising(known, where, "pointwise: vol+arap < vol+arap+Z (Z does not pay)", worse))
        found.append(_least(known, where))
        parts = [BASE, replace(BASE, strategy="uniform")]
        found.append(_rising(known, where, "nodes by parts < uniform nodes (T)", parts))
        poses = [BASE, replace(BASE, pose="I")]
        found.append(_rising(known, where, "template pose T < I", poses))
        more = [replace(BASE, shapes=count) for count in (2000, 1000, 500, 250)]
        found.append(_rising(known, where, "more shapes are better: 2000 < 1000 < 500 < 250", more))
        points = [BASE, replace(BASE, supervised=50)]
        found.append(_rising(known, where, "1000 supervised points < 50", points))
        if where != "held out":
            hows = ("code", "chamfer", "none")
            alike = [
                cell
                for cell in known.trained
                if replace(cell, seed=BASE.seed) == BASE
                and all(
                    (cell, where, how) in known.errors for how in hows
                )  # what is measured once is not compared
            ]
            tests = [[known.errors[cell, where, how]["mean_cm"] for cell in alike] for how in hows]
            words = "refined with regularisers < by Chamfer alone < not at all"
            found.append(_claim(where, words, tests))
    return found


def _costs(known: Known) -> list[Claim]:
    """What constraints cost: factors of the milliseconds of an iteration."""
    factor: dict[FieldName, float] = {}
    for field in FIELDS:
        plain, full = (
            cost_of(known, replace(BASE, field=field, constraint=each)) for each in (_PLAIN, _FULL)
        )
        if plain and full:
            factor[field] = full / plain
    words = "vol+arap+Z makes an iteration of {} {} times as dear"
    found = [
        Claim(words.format(field, "at most 2"), (factor[field],), factor[field] <= 2)
        if field in factor
        else Claim(words.format(field, "at most 2"), (), None)
        for field in FIELDS
        if has_nodes(field)
    ]
    there = tuple(factor[field] for field in ("mls", "pointwise") if field in factor)
    both = len(there) == 2
    words = "vol+arap+Z makes an iteration dearer by less for mls than for pointwise"
    found.append(Claim(words, there, there[0] < there[1] if both else None))
    dear = tuple(_there([cost_of(known, replace(BASE, field=field)) for field in ("mls", "pointwise")]))
    words = "with vol+arap+Z an iteration costs pointwise at least 3 times what it costs mls"
    found.append(Claim(words, dear, dear[1] > 3 * dear[0] if len(dear) == 2 else None))
    return found


def _rising(known: Known, where: str, words: str, cells: Sequence[Cell]) -> Claim:
    return _claim(where, words, [known.error(cell, where) for cell in cells])


def _least(known: Known, where: str) -> Claim:
    cells = [replace(BASE, nodes=K, radius=r) for K, r in GRID]
    grid = {cell: known.error(cell, where) for cell in known.trained if cell in cells}
    words = "300 nodes of radius 0.2 are the best of the grid"
    if not grid.get(BASE) or len([errors for errors in grid.values() if errors]) < 2:
        return Claim(words, (), None, where)
    means = {cell: fmean(errors) for cell, errors in grid.items() if errors}
    others = min(value for cell, value in means.items() if cell != BASE)
    return Claim(words, (means[BASE], others), means[BASE] <= others, where)


def _claim(where: str, words: str, errors: Sequence[Sequence[float]]) -> Claim:
    means = [fmean(each) if each else None for each in errors]
    if None in means:
        return Claim(words, _there(means), None, where)
    numbers = _there(means)
    return Claim(words, numbers, all(a < b for a, b in pairwise(numbers)), where)


def _there(numbers: Sequence[float | None]) -> tuple[float, ...]:
    return tuple(value for value in numbers if value is not None)
