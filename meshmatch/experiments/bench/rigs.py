"""Rigs from one character to another: joints and weights of characters that share the names of their bones.

Every ordered pair of a folder of rigged files, as `transfer_rig` does it. The truth is the target's own rig: the share
of the vertices that it moves whose main joint has the same name; or that of a neighbour: a parent, a child, a sibling,
or a joint where a bone of the other ends (feet of inverse kinematics hang from the root). A joint that only one of the
two rigs has, or moves, counts as its nearest ancestor that both have: no rig of an animal without joints in its ears
could be right there. Then how far joints that move vertices on both lie from where they belong, in centimetres with the
target's longest side scaled to 1.8 m. Beside it the neighbours that two other methods find, from the same alignment;
and how far joints lie from the bones that meet at the true joint, which tells those that only sit further up or down.
Then the target moves, in a clip of the source, or sits: how much of its volume stays, and the share of vertices that are
over a centimetre further from the bone of their joint than at rest, by the new rig and by its own.
"""

from __future__ import annotations

import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from typer import Option

import meshmatch
from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Floats
from meshmatch.experiments import runner
from meshmatch.experiments.bench.pairs import VERDICTS
from meshmatch.experiments.bench.sets import ordered_pairs
from meshmatch.experiments.bench.skinning import from_bones, in_motion, nearest_and_inpainted, skinned, volume
from meshmatch.shapes.formats.gltf_rig import Rig, read_rig
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import most_votes
from meshmatch.transfer.weight_files import SkinWeights, load_weights

FOLDERS = "men,women,animals,dinosaurs,fish"
HEIGHT = 180.0
Names: TypeAlias = NDArray[np.str_]
_PATTERNS = {"rocketbox": "*.fbx"}
_FURTHER = 1.0  # cm
_TOUCHING = 0.01  # of the longest side
_MEANS = "same", "near", "volume", "volume_own", "further", "further_own", "seconds"
COLUMNS = {
    "folder": "folder", "pairs": "pairs:d", "good / fair / poor": "verdicts:>", "same joint": "same:.1%",
    "or a neighbour": "near:.1%", "where good": "near_good:.1%", "nearest point": "nearest_good:.1%",
    "inpainting": "inpainted_good:.1%", "joints median cm": "median_cm:.2f", "95 %": "high_cm:.2f",
    "where good, median": "median_good_cm:.2f", "95 % ": "high_good_cm:.2f", "CPU s": "seconds:.1f",
}  # fmt: skip
MOVED = {
    "folder": "folder", "joints off the bone, median cm": "median_bone_cm:.2f", "95 %": "high_bone_cm:.2f",
    "volume kept": "volume:.1%", "at least": "volume_least:.1%", "by its own rig": "volume_own:.1%",
    "further from the bone": "further:.2%", "by its own rig ": "further_own:.2%",
}  # fmt: skip


class _Character:
    def __init__(self, path: Path) -> None:
        self.path, self.shape = path, meshmatch.load_shape(path)
        self.rig: Rig = read_rig(path, read_bytes(path))
        self.weights: SkinWeights = load_weights(path, self.shape)
        self.places = dict(zip(self.rig.names, self.rig.worlds()[:, :3, 3], strict=True))
        self.above = _parents(self.rig)
        self.near = neighbours(self.rig, _TOUCHING * float(np.ptp(self.shape.bounds, axis=0).max()))

    def counted_as(self, name: str, shared: set[str]) -> str:
        """The nearest of a joint and its ancestors that is shared; "" if there is none."""
        while name and name not in shared:
            name = self.above[name]
        return name

    def off_the_bone(self, place: Floats, name: str) -> float:
        """How far a place is from the bones that begin or end at a joint."""
        names, parents = self.rig.names, self.rig.parents.tolist()
        ends = [(names[parent], own) for own, parent in zip(names, parents, strict=True) if parent >= 0]
        return min(
            _from_segment(place, self.places[one], self.places[two])
            for one, two in [*(pair for pair in ends if name in pair), (name, name)]
        )

    def moving(self, weights: SkinWeights) -> set[str]:
        return {name for name, amount in zip(weights.names, weights.matrix.sum(axis=0), strict=True) if amount >= 3}


def _parents(rig: Rig) -> dict[str, str]:
    return {name: rig.names[parent] if parent >= 0 else "" for name, parent in zip(rig.names, rig.parents, strict=True)}


def neighbours(rig: Rig, touching: float) -> set[tuple[str, str]]:
    """Pairs of joints, each both ways: equal ones, parents and children, siblings, and those as near as `touching` to
    where a bone of the other ends."""
    above, places = _parents(rig), rig.worlds()[:, :3, 3]
    near = {(a, b) for a in above for b in above if a == b or above[a] in (b, above[b]) or above[b] == a}
    for end, bone in above.items():
        away = np.linalg.norm(places - places[rig.names.index(end)], axis=1)
        ends = [name for name, distance in zip(rig.names, away, strict=True) if bone and distance < touching]
        near |= {(bone, name) for name in ends} | {(name, bone) for name in ends}
    return near


def _from_segment(place: Floats, begin: Floats, end: Floats) -> float:
    along = end - begin
    share = float(np.clip((place - begin) @ along / max(float(along @ along), 1e-300), 0.0, 1.0))
    return float(np.linalg.norm(begin + share * along - place))


def measured(source: _Character, target: _Character, matcher: Matcher) -> dict[str, Any]:
    """What one pair comes to."""
    began = time.process_time()
    made = meshmatch.transfer_rig(source.path, target.path, matcher)
    seconds = time.process_time() - began
    shared = source.moving(source.weights) & target.moving(target.weights)
    true = _main(target, target.weights, shared)
    known = true != ""  # what the target's own rig does not move has no truth
    mine = _main(source, made.weights, shared)
    same = (mine == true)[known]
    aligned = made.maps.forward.points(target.shape)
    others = nearest_and_inpainted(source.shape, aligned, source.weights.matrix, target.shape)
    near, nearest, inpainted = (
        float(np.mean([pair in target.near for pair in zip(names[known].tolist(), true[known].tolist(), strict=True)]))
        for names in (mine, *(_main(source, SkinWeights(each, source.weights.names), shared) for each in others))
    )
    carried = dict(zip(made.rig.names, made.rig.worlds()[:, :3, 3], strict=True))
    common = sorted(shared)
    unit = HEIGHT / float(np.ptp(target.shape.bounds, axis=0).max())
    off = [unit * float(np.linalg.norm(carried[name] - target.places[name])) for name in common]
    beside = [unit * target.off_the_bone(carried[name], name) for name in common]
    row: dict[str, Any] = {"source": source.path.stem, "target": target.path.stem, "verdict": made.maps.forward.verdict}
    row |= {
        "same": float(same.mean()),
        "near": near,
        "nearest": nearest,
        "inpainted": inpainted,
        "cm": off,
        "bone_cm": beside,
        "joints": common,
    }
    row["volume"], row["further"] = _moved(target.shape, made.weights, made.rig, unit)
    row["volume_own"], row["further_own"] = _moved(target.shape, target.weights, target.rig, unit)
    return row | {"seconds": seconds}


def _main(character: _Character, weights: SkinWeights, shared: set[str]) -> Names:
    """The name of each vertex's main joint, or of the nearest above it that both rigs have."""
    return np.array([*(character.counted_as(name, shared) for name in weights.names), ""])[most_votes(weights.matrix)]


def _moved(shape: Shape, weights: SkinWeights, rig: Rig, unit: float) -> tuple[float, float]:
    """In motion: the share of the volume that is left, and of the vertices that are further from their bones."""
    posed, main = in_motion(rig), most_votes(weights.matrix)
    verts = skinned(shape.verts, weights.matrix, rig, posed)
    away = from_bones(verts, main, posed) - from_bones(shape.verts, main, rig)
    return volume(verts, shape) / volume(shape.verts, shape), float((unit * away > _FURTHER).mean())


def row_of(folder: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """All pairs of a folder; joints of all pairs count alike."""
    good = [row for row in rows if row["verdict"] == "good"]
    verdicts = Counter(row["verdict"] for row in rows)
    found: dict[str, Any] = {"folder": folder, "pairs": len(rows)}
    found["verdicts"] = " / ".join(str(verdicts[word]) for word in VERDICTS)
    found |= {key: float(np.mean([row[key] for row in rows])) for key in _MEANS}
    found["volume_least"] = min(row["volume"] for row in rows)
    if good:
        found |= {f"{key}_good": float(np.mean([row[key] for row in good])) for key in ("near", "nearest", "inpainted")}
    for ending, key, some in (("", "cm", rows), ("_good", "cm", good), ("_bone", "bone_cm", rows)):
        if joints := [cm for row in some for cm in row[key]]:
            found |= {
                f"median{ending}_cm": float(np.median(joints)),
                f"high{ending}_cm": float(np.percentile(joints, 95)),
            }
    return found


def _short(row: dict[str, Any]) -> dict[str, Any]:
    """A pair without its joints one by one."""
    lists = {key: row[key] for key in ("cm", "bone_cm") if row[key]}
    rest = {key: value for key, value in row.items() if not isinstance(value, list)}
    return rest | {f"median_{key}": float(np.median(value)) for key, value in lists.items()}


@runner.command
def main(
    folders: Annotated[str, Option(help="folders of rigged files in DATA/rigs")] = FOLDERS,
    data: runner.Data = runner.DATA,
    limit_pairs: runner.LimitPairs = None,
    work: runner.Work = None,
    threads: runner.Threads = 1,
) -> runner.Report:
    rows, each = [], {}
    for folder in folders.split(","):
        files = runner.files_in(data / "rigs" / folder, _PATTERNS.get(folder, "*.glb"), 2)
        cast, matcher = {file.stem: _Character(file) for file in files}, Matcher(threads=threads)
        pairs = runner.evenly_spread(ordered_pairs(cast), limit_pairs)
        each[folder] = [
            runner.cached_in(work, f"{folder}-{a}-{b}", {}, partial(measured, cast[a], cast[b], matcher))
            for a, b in runner.track(pairs, folder)
        ]
        rows.append(row_of(folder, each[folder]))
    short = {folder: [_short(row) for row in some] for folder, some in each.items()}
    tables = [runner.table("Rigs", rows, COLUMNS), runner.table("In motion", rows, MOVED)]
    return runner.Report({"rows": rows, "each": short}, tables)
