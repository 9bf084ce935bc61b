"""Rigs from one character to another: joints and weights of characters that share the names of their bones.

Every ordered pair of a folder of rigged glb files, as `transfer_rig` does it. The truth is the target's own rig: the share
of its vertices whose main joint has the same name; or that of a parent, a child or a sibling; and how far joints that
move vertices on both lie from where they belong, in centimetres with the target's longest side scaled to 1.8 m.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

import meshmatch
from meshmatch.api.matcher import Matcher
from meshmatch.experiments import runner
from meshmatch.experiments.bench.pairs import VERDICTS
from meshmatch.experiments.bench.sets import ordered_pairs
from meshmatch.shapes.formats.gltf_rig import Rig, read_rig
from meshmatch.transfer.attributes import most_votes
from meshmatch.transfer.weight_files import SkinWeights, load_weights

FOLDERS = "men,women,animals,dinosaurs,fish"
HEIGHT = 180.0
COLUMNS = {
    "folder": "folder", "pairs": "pairs:d", "good / fair / poor": "verdicts:>", "same joint": "same:.1%",
    "or a neighbour": "near:.1%", "where good": "near_good:.1%", "joints median cm": "median_cm:.2f",
    "95 %": "high_cm:.2f", "where good, median": "median_good_cm:.2f", "95 % ": "high_good_cm:.2f", "CPU s": "seconds:.1f",
}  # fmt: skip


class _Character:
    def __init__(self, path: Path) -> None:
        self.path, self.shape = path, meshmatch.load_shape(path)
        self.rig: Rig = read_rig(path, path.read_bytes())
        self.weights: SkinWeights = load_weights(path, self.shape)
        self.places = dict(zip(self.rig.names, self.rig.worlds()[:, :3, 3], strict=True))
        names, parents = self.rig.names, self.rig.parents.tolist()
        above = {name: names[parent] if parent >= 0 else "" for name, parent in zip(names, parents, strict=True)}
        self.near = {(a, b) for a in above for b in above if a == b or above[a] in (b, above[b]) or above[b] == a}

    def moving(self, weights: SkinWeights) -> set[str]:
        return {name for name, amount in zip(weights.names, weights.matrix.sum(axis=0), strict=True) if amount >= 3}


def measured(source: _Character, target: _Character, matcher: Matcher) -> dict[str, Any]:
    """What one pair comes to."""
    began = time.process_time()
    made = meshmatch.transfer_rig(source.path, target.path, matcher)
    seconds = time.process_time() - began
    mine, true = (np.array([*each.names, ""])[most_votes(each.matrix)] for each in (made.weights, target.weights))
    same = mine == true
    near = np.array([pair in target.near for pair in zip(mine.tolist(), true.tolist(), strict=True)])
    carried = dict(zip(made.rig.names, made.rig.worlds()[:, :3, 3], strict=True))
    common = sorted(source.moving(source.weights) & target.moving(target.weights))
    unit = HEIGHT / float(np.ptp(target.shape.bounds, axis=0).max())
    off = [unit * float(np.linalg.norm(carried[name] - target.places[name])) for name in common]
    row = {"source": source.path.stem, "target": target.path.stem, "verdict": made.maps.forward.verdict}
    return row | {"same": float(same.mean()), "near": float(near.mean()), "cm": off, "seconds": seconds}


def row_of(folder: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """All pairs of a folder; joints of all pairs count alike."""
    good = [row for row in rows if row["verdict"] == "good"]
    verdicts = Counter(row["verdict"] for row in rows)
    found: dict[str, Any] = {"folder": folder, "pairs": len(rows)}
    found["verdicts"] = " / ".join(str(verdicts[word]) for word in VERDICTS)
    found |= {key: float(np.mean([row[key] for row in rows])) for key in ("same", "near", "seconds")}
    if good:
        found["near_good"] = float(np.mean([row["near"] for row in good]))
    for ending, some in (("", rows), ("_good", good)):
        if joints := [cm for row in some for cm in row["cm"]]:
            found |= {
                f"median{ending}_cm": float(np.median(joints)),
                f"high{ending}_cm": float(np.percentile(joints, 95)),
            }
    return found


@runner.command
def main(
    folders: Annotated[str, Option(help="folders of rigged .glb files in DATA/rigs")] = FOLDERS,
    data: runner.Data = runner.DATA,
    limit_pairs: runner.LimitPairs = None,
    threads: runner.Threads = 1,
) -> runner.Report:
    rows, each = [], {}
    for folder in folders.split(","):
        files = runner.files_in(data / "rigs" / folder, "*.glb", 2)
        cast, matcher = {file.stem: _Character(file) for file in files}, Matcher(threads=threads)
        pairs = runner.spread(ordered_pairs(cast), limit_pairs)
        each[folder] = [measured(cast[a], cast[b], matcher) for a, b in runner.track(pairs, folder)]
        rows.append(row_of(folder, each[folder]))
    return runner.Report({"rows": rows, "each": each}, [runner.table("Rigs", rows, COLUMNS)])
