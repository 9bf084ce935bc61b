"""People in clothes, stylised characters, robots of many parts and soldiers in armour, none of them seen in training.

Generated ones know their truth. In clothes, and stylised: the distance along the naked target body below the clothes
between the matched place and the true one, at every twentieth vertex of the body, in centimetres at 1.9 m2 of skin. All of
them, and those of the evaluation data (Rogue and Rogue_Hooded, which share a skeleton, without what they hold or wear
loosely): the share of vertices whose partner hangs on the same bone. Every ordered pair of a group counts, matched as
`match` does it, from files turned anywhere where they are generated. Seconds are of CPU: two fits and the map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
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
from meshmatch.experiments.makers.character_designs import Character, Designer
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.generators.proportions import BUILT, CHILD, PLAIN, TOON
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf_attributes import read_skin
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import read_template

GROUPS = ("clothed", "children", "stylised", "built", "robots", "soldiers", "rogues")
KINDS = {"clothed": PLAIN, "children": CHILD, "stylised": TOON, "built": BUILT}
HELD = ("Knife*", "*Crossbow*", "Throwable*", "*Cape*")
"""Meshes of the evaluation data's characters that are no part of them."""
_EVERY = 20  # vertex of the body is a place where errors are measured
COLUMNS = {
    "group": "group", "pairs": "pairs:d", "mean cm": "mean_cm:.2f", "median": "median_cm:.2f", "worst": "worst_cm:.1f",
    "same bone": "bone:.3f", "lowest": "lowest:.3f", "good / fair / poor": "verdicts:>", "CPU s a pair": "seconds:.1f",
    "at most": "slowest:.1f",
}  # fmt: skip


def characters_of(group: str, count: int, designer: Designer, data: Path) -> list[Character]:
    """The characters of a group; generated ones are turned anywhere."""
    if group == "rogues":
        return list(rogues(data / "textured"))
    if group in KINDS:
        made = designer.people(count, (KINDS[group],), group)
    else:
        made = designer.robots(count) if group == "robots" else designer.soldiers(count)
    turns = Rotation.random(count, random_state=np.random.default_rng([designer.seed, 3])).as_matrix()
    return [
        replace(each, shape=Shape(each.shape.verts @ turn.T, each.shape.faces, each.shape.name))
        for each, turn in zip(made, turns, strict=True)
    ]


def rogues(folder: Path) -> Iterator[Character]:
    """The evaluation data's two characters; vertices of what they hold hang on no bone (-1)."""
    bones: list[str] = []
    for name in ("Rogue", "Rogue_Hooded"):
        path = folder / f"{name}.glb"
        shape = load_shape(path, without=HELD)
        weights, names = read_skin(path, path.read_bytes())
        bones += [bone for bone in names if bone not in bones]
        main = np.array([bones.index(bone) for bone in names])[np.asarray(weights.toarray()).argmax(1)]
        assert shape.weights is not None
        yield Character(shape, np.where(shape.weights > 0, main, -1))


def measured(source: Character, target: Character, found: VertexMap, cache: Path | None) -> dict[str, float]:
    """Error in centimetres on the body below, where there is one, and the share of vertices on the same bone."""
    own = np.flatnonzero(source.bones >= 0)
    record = {"bone": float((target.bones[found.index[own]] == source.bones[own]).mean())}
    if source.places is not None and target.places is not None and target.body is not None:
        known = np.arange(0, target.body.V, _EVERY)
        at = np.flatnonzero(source.places % _EVERY == 0)
        rows = TruthDistances(target.body, known, cache).of(source.places[at] // _EVERY)
        matched = target.places[found.index[at]]
        record["cm"] = CM_PER_UNIT * float(rows[np.arange(len(at)), matched].mean(dtype=np.float64))
    return record


def row_of(group: str, cast: Sequence[Character], matcher: Matcher, cache: Path | None) -> dict[str, Any]:
    """All ordered pairs of a group."""
    of = {each.shape.name: each for each in cast}
    shapes = {name: each.shape for name, each in of.items()}
    fits, found = matched(matcher, shapes, ordered_pairs(of), group)
    errors = {(a, b): measured(of[a], of[b], each.map, cache) for (a, b), each in found.items()}
    bone = [each["bone"] for each in errors.values()]
    row = {"group": group, "pairs": len(found), "bone": float(np.mean(bone)), "lowest": min(bone)}
    if cm := [each["cm"] for each in errors.values() if "cm" in each]:
        row |= {"mean_cm": float(np.mean(cm)), "median_cm": float(np.median(cm)), "worst_cm": max(cm)}
    verdicts = Counter(each.verdict for each in found.values())
    seconds = [each.seconds for each in found.values()]
    return row | {
        "verdicts": " / ".join(str(verdicts[word]) for word in VERDICTS),
        "seconds": float(np.mean(seconds)),
        "slowest": max(seconds),
        "each": [[*pair, each] for pair, each in errors.items()],
        "fits": {name: [fit.verdict, [reason.code for reason in fit.reasons]] for name, fit in fits.items()},
    }


@runner.command
def main(
    data: runner.Data = runner.DATA,
    groups: Annotated[str, Option(help=f"of {', '.join(GROUPS)}")] = ",".join(GROUPS),
    model: runner.Model = "human",
    count: Annotated[int, Option(min=2, help="generated characters of each group")] = 4,
    cache: runner.Cache = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    matcher = Matcher(model, FitConfig(), threads)
    designer = Designer.unseen(read_template("human-T"), seed)
    rows = [
        row_of(group, characters_of(group, count, designer, data), matcher, cache)
        for group in runner.names_of(groups, GROUPS, "group")
    ]
    return runner.Report({"rows": rows}, [runner.table(f"Characters with {matcher.model.card.name}", rows, COLUMNS)])
