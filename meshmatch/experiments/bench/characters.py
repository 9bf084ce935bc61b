"""People in clothes, stylised characters and people in self-contact, none of them seen in training.

They are generated, so that the true map is known. The error is the geodesic distance, on the naked target body below the
clothes, between the matched point and the true one, at every twentieth vertex of the body, in centimetres at 1.9 m2 of
skin. "same bone" is the share of vertices whose partner follows the same bone. A pair with a mean error over 8 cm is wrong.
Every ordered pair of a group counts, matched as `match` does it, in random orientations. Seconds are CPU time: two fits and
the map.
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
from meshmatch.experiments.bench.pairs import VERDICTS, match_by_fits
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import ordered_pairs
from meshmatch.experiments.makers.character_designs import Character, clothed_people, people_in_contact
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.generators.proportions import BUILT, CHILD, PLAIN, TOON
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.templates.template import read_template

KINDS = {"clothed": PLAIN, "children": CHILD, "stylised": TOON, "built": BUILT}
CONTACTS = {"touching": False, "fused": True}  # whether surfaces in contact are fused
GROUPS = (*KINDS, *CONTACTS)
_WRONG_CM = 8.0  # mean error in centimetres above which a pair is wrong
_STRIDE = 20  # errors are measured at every 20th vertex of the body
COLUMNS = {
    "group": "group", "pairs": "pairs:d", "mean cm": "mean_cm:.2f", "median": "median_cm:.2f", "worst": "worst_cm:.1f",
    "same bone": "bone:.3f", "lowest": "lowest:.3f", "good / fair / poor": "verdicts:>",
    "wrong and good": "wrong_good:d", "CPU s a pair": "seconds:.1f",
    "at most": "slowest:.1f",
}  # fmt: skip


def measure_pair(source: Character, target: Character, found: VertexMap, cache: Path | None) -> dict[str, float]:
    """Return the error in centimetres on the naked body, and the share of vertices mapped to the same bone."""
    known = np.arange(0, target.body.V, _STRIDE)
    at = np.flatnonzero(source.places % _STRIDE == 0)
    rows = TruthDistances(target.body, known, cache).of(source.places[at] // _STRIDE)
    off = rows[np.arange(len(at)), target.places[found.index[at]]]
    same = target.bones[found.index] == source.bones
    return {"bone": float(same.mean()), "cm": CM_PER_UNIT * float(off.mean(dtype=np.float64))}


def row_of(group: str, characters: Sequence[Character], matcher: Matcher, cache: Path | None) -> dict[str, Any]:
    """Match all ordered pairs of a group and return its table row."""
    of = {each.shape.name: each for each in characters}
    shapes = {name: each.shape for name, each in of.items()}
    fits, found = match_by_fits(matcher, shapes, ordered_pairs(of), group)
    errors = {(a, b): measure_pair(of[a], of[b], each.map, cache) for (a, b), each in found.items()}
    bone, cm = ([each[name] for each in errors.values()] for name in ("bone", "cm"))
    verdicts = Counter(each.verdict for each in found.values())
    seconds = [each.seconds for each in found.values()]
    return {
        **{"group": group, "pairs": len(found), "bone": float(np.mean(bone)), "lowest": min(bone)},
        **{"mean_cm": float(np.mean(cm)), "median_cm": float(np.median(cm)), "worst_cm": max(cm)},
        "verdicts": " / ".join(str(verdicts[word]) for word in VERDICTS),
        "wrong_good": sum(found[pair].verdict == "good" and each["cm"] > _WRONG_CM for pair, each in errors.items()),
        **{"seconds": float(np.mean(seconds)), "slowest": max(seconds)},
        "each": [[*pair, each] for pair, each in errors.items()],
        "fits": {name: [fit.verdict, [reason.code for reason in fit.reasons]] for name, fit in fits.items()},
    }


@runner.command
def main(
    groups: Annotated[str, Option(help=f"of {', '.join(GROUPS)}")] = ",".join(GROUPS),
    model: runner.Model = "human",
    count: Annotated[int, Option(min=2, help="generated characters per group")] = 4,
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
        characters = [
            replace(each, shape=replace(each.shape, verts=each.shape.verts @ turn.T))
            for each, turn in zip(made, turns, strict=True)
        ]
        rows.append(row_of(group, characters, matcher, cache))
    return runner.Report({"rows": rows}, [runner.table(f"Characters with {matcher.model.card.name}", rows, COLUMNS)])
