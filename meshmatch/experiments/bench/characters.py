"""People in clothes, stylised characters and people who touch themselves, none of them seen in training.

They are generated, so that the truth is known: the distance along the naked target body below the clothes between the
matched place and the true one, at every twentieth vertex of the body, in centimetres at 1.9 m2 of skin; and the share of
vertices whose partner hangs on the same bone. A pair that is more than 8 cm off on average is wrong. Every ordered pair of a
group counts, matched as `match` does it, from files turned anywhere. Seconds are of CPU: two fits and the map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.experiments import runner
from meshmatch.experiments.bench.pairs import VERDICTS, matched
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import ordered_pairs
from meshmatch.experiments.makers.character_designs import Character, clothed_people, people_in_contact
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.generators.proportions import BUILT, CHILD, PLAIN, TOON
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.templates.template import read_template

KINDS = {"clothed": PLAIN, "children": CHILD, "stylised": TOON, "built": BUILT}
CONTACTS = {"touching": False, "fused": True}  # fused where they touch?
GROUPS = (*KINDS, *CONTACTS)
_WRONG = 8.0  # centimetres: a pair that is farther off on average
_EVERY = 20  # vertex of the body is a place where errors are measured
COLUMNS = {
    "group": "group", "pairs": "pairs:d", "mean cm": "mean_cm:.2f", "median": "median_cm:.2f", "worst": "worst_cm:.1f",
    "same bone": "bone:.3f", "lowest": "lowest:.3f", "good / fair / poor": "verdicts:>",
    "wrong and good": "wrong_good:d", "CPU s a pair": "seconds:.1f",
    "at most": "slowest:.1f",
}  # fmt: skip


def measured(source: Character, target: Character, found: VertexMap, cache: Path | None) -> dict[str, float]:
    """Error in centimetres on the body below, and the share of vertices on the same bone."""
    known = np.arange(0, target.body.V, _EVERY)
    at = np.flatnonzero(source.places % _EVERY == 0)
    rows = TruthDistances(target.body, known, cache).of(source.places[at] // _EVERY)
    off = rows[np.arange(len(at)), target.places[found.index[at]]]
    same = target.bones[found.index] == source.bones
    return {"bone": float(same.mean()), "cm": CM_PER_UNIT * float(off.mean(dtype=np.float64))}


def row_of(group: str, cast: Sequence[Character], matcher: Matcher, cache: Path | None) -> dict[str, Any]:
    """All ordered pairs of a group."""
    of = {each.shape.name: each for each in cast}
    shapes = {name: each.shape for name, each in of.items()}
    fits, found = matched(matcher, shapes, ordered_pairs(of), group)
    errors = {(a, b): measured(of[a], of[b], each.map, cache) for (a, b), each in found.items()}
    bone, cm = ([each[name] for each in errors.values()] for name in ("bone", "cm"))
    verdicts = Counter(each.verdict for each in found.values())
    seconds = [each.seconds for each in found.values()]
    return {
        **{"group": group, "pairs": len(found), "bone": float(np.mean(bone)), "lowest": min(bone)},
        **{"mean_cm": float(np.mean(cm)), "median_cm": float(np.median(cm)), "worst_cm": max(cm)},
        "verdicts": " / ".join(str(verdicts[word]) for word in VERDICTS),
        "wrong_good": sum(found[pair].verdict == "good" and each["cm"] > _WRONG for pair, each in errors.items()),
        **{"seconds": float(np.mean(seconds)), "slowest": max(seconds)},
        "each": [[*pair, each] for pair, each in errors.items()],
        "fits": {name: [fit.verdict, [reason.code for reason in fit.reasons]] for name, fit in fits.items()},
    }


@runner.command
def main(
    groups: Annotated[str, Option(help=f"of {', '.join(GROUPS)}")] = ",".join(GROUPS),
    model: runner.Model = "human",
    count: Annotated[int, Option(min=2, help="generated characters of each group")] = 4,
    cache: runner.Cache = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    matcher, template, rows = Matcher(model, FitConfig(), threads), read_template("human-T"), []
    for group in runner.split_names(groups, GROUPS, "group"):
        if group in KINDS:
            made = clothed_people(template, count, KINDS[group], seed, group)
        else:
            made = people_in_contact(template, count, seed, group, CONTACTS[group])
        turns = Rotation.random(count, random_state=np.random.default_rng([seed, 3])).as_matrix()
        cast = [
            replace(each, shape=replace(each.shape, verts=each.shape.verts @ turn.T))
            for each, turn in zip(made, turns, strict=True)
        ]
        rows.append(row_of(group, cast, matcher, cache))
    return runner.Report({"rows": rows}, [runner.table(f"Characters with {matcher.model.card.name}", rows, COLUMNS)])
