"""Rig transfer between characters whose skeletons share the names of their bones.

Every ordered pair of a folder of rigged files is transferred by `transfer_rig`, and compared with the target's own rig:

- same joint: the share of vertices whose main joint has the same name as in the target's rig. A joint that only one of the
  two rigs has, or that moves vertices in only one of them, counts as its nearest ancestor that does so in both: an animal
  without joints in its ears cannot give them to another.
- or a neighbour: the same, but a parent, a child, a sibling, or a joint at the end of one of its bones is also right (feet
  of inverse kinematics are children of the root). Two baseline methods, from the same alignment, are measured by this.
- joints: distances of joints that move vertices in both rigs from their true positions, in centimetres with the target's
  longest side scaled to 1.8 m.
- joints off the bone: distances of joints from the bones that meet at the true joint; small for joints that are only
  shifted along a bone.
- in motion: each rig moves the target by its own clip of running or swimming, or else into a sitting pose. The volume that
  is kept, and the share of vertices over a centimetre further from the bones of their joint than at rest, by the new rig
  and by the target's own.
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
from meshmatch.experiments.bench.skinning import (
    distances_from_bones,
    nearest_and_inpainted,
    pose_in_motion,
    skin_vertices,
    volume,
)
from meshmatch.shapes.formats.gltf_rig import Rig, read_rig
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import most_votes
from meshmatch.transfer.weight_files import SkinWeights, load_weights

FOLDERS = "men,women,animals,dinosaurs,fish"
HEIGHT = 180.0  # cm, of the longest side of a target
Names: TypeAlias = NDArray[np.str_]
_PATTERNS = {"rocketbox": "*.fbx"}
_MAX_DRIFT_CM = 1.0  # vertices that move further than this from their bones are counted
_TOUCHING_DISTANCE = 0.01  # of a joint from the end of a bone, as a fraction of the longest side
_AVERAGED = "same", "near", "volume", "volume_own", "further", "further_own", "seconds"
COLUMNS = {
    "folder": "folder", "pairs": "pairs:d", "good / fair / poor": "verdicts:>", "same joint": "same:.1%",
    "or a neighbour": "near:.1%", "where good": "near_good:.1%", "nearest point": "nearest_good:.1%",
    "inpainting": "inpainted_good:.1%", "joints median cm": "median_cm:.2f", "95 %": "high_cm:.2f",
    "where good, median": "median_good_cm:.2f", "95 % ": "high_good_cm:.2f", "CPU s": "seconds:.1f",
}  # fmt: skip
MOTION_COLUMNS = {
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
        self.near = neighbours(self.rig, _TOUCHING_DISTANCE * float(np.ptp(self.shape.bounds, axis=0).max()))

    def nearest_shared(self, name: str, shared: set[str]) -> str:
        """Return the joint or its nearest ancestor that is in ``shared``; "" if there is none."""
        while name and name not in shared:
            name = self.above[name]
        return name

    def distance_from_bones(self, place: Floats, name: str) -> float:
        """Return the distance of a point from the bones that begin or end at a joint."""
        names, parents = self.rig.names, self.rig.parents.tolist()
        ends = [(names[parent], own) for own, parent in zip(names, parents, strict=True) if parent >= 0]
        return min(
            _distance_from_segment(place, self.places[one], self.places[two])
            for one, two in [*(pair for pair in ends if name in pair), (name, name)]
        )

    def moving(self, weights: SkinWeights) -> set[str]:
        """Return the joints that have weights of at least 3 in total."""
        return {name for name, amount in zip(weights.names, weights.matrix.sum(axis=0), strict=True) if amount >= 3}


def _parents(rig: Rig) -> dict[str, str]:
    """Return the parent of each joint by name; "" for roots."""
    return {name: rig.names[parent] if parent >= 0 else "" for name, parent in zip(rig.names, rig.parents, strict=True)}


def neighbours(rig: Rig, touching: float) -> set[tuple[str, str]]:
    """Find pairs of neighbouring joints, in both orders.

    A joint is a neighbour of itself, its parent, children and siblings, and of joints within ``touching`` of the end of one
    of its bones.
    """
    above, places = _parents(rig), rig.worlds()[:, :3, 3]
    near = {(a, b) for a in above for b in above if a == b or above[a] in (b, above[b]) or above[b] == a}
    for end, bone in above.items():
        away = np.linalg.norm(places - places[rig.names.index(end)], axis=1)
        ends = [name for name, distance in zip(rig.names, away, strict=True) if bone and distance < touching]
        near |= {(bone, name) for name in ends} | {(name, bone) for name in ends}
    return near


def _distance_from_segment(place: Floats, begin: Floats, end: Floats) -> float:
    """Return the distance of a point from a line segment."""
    along = end - begin
    share = float(np.clip((place - begin) @ along / max(float(along @ along), 1e-300), 0.0, 1.0))
    return float(np.linalg.norm(begin + share * along - place))


def measure_pair(source: _Character, target: _Character, matcher: Matcher) -> dict[str, Any]:
    """Transfer the rig of one pair and measure it."""
    began = time.process_time()
    made = meshmatch.transfer_rig(source.path, target.path, matcher)
    seconds = time.process_time() - began
    shared = source.moving(source.weights) & target.moving(target.weights)
    true = _main_joints(target, target.weights, shared)
    known = true != ""  # vertices that the target's own rig does not move have no truth
    mine = _main_joints(source, made.weights, shared)
    same = (mine == true)[known]
    aligned = made.maps.forward.points(target.shape)
    others = nearest_and_inpainted(source.shape, aligned, source.weights.matrix, target.shape)
    near, nearest, inpainted = (
        float(np.mean([pair in target.near for pair in zip(names[known].tolist(), true[known].tolist(), strict=True)]))
        for names in (mine, *(_main_joints(source, SkinWeights(each, source.weights.names), shared) for each in others))
    )
    carried = dict(zip(made.rig.names, made.rig.worlds()[:, :3, 3], strict=True))
    common = sorted(shared)
    unit = HEIGHT / float(np.ptp(target.shape.bounds, axis=0).max())
    off = [unit * float(np.linalg.norm(carried[name] - target.places[name])) for name in common]
    beside = [unit * target.distance_from_bones(carried[name], name) for name in common]
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
    row["volume"], row["further"] = _measure_motion(target.shape, made.weights, made.rig, unit)
    row["volume_own"], row["further_own"] = _measure_motion(target.shape, target.weights, target.rig, unit)
    return row | {"seconds": seconds}


def _main_joints(character: _Character, weights: SkinWeights, shared: set[str]) -> Names:
    """Return the name of each vertex's main joint, or of its nearest ancestor in ``shared``; "" if there is none."""
    return np.array([*(character.nearest_shared(name, shared) for name in weights.names), ""])[
        most_votes(weights.matrix)
    ]


def _measure_motion(shape: Shape, weights: SkinWeights, rig: Rig, unit: float) -> tuple[float, float]:
    """Pose a shape; return the ratio of volumes, and the share of vertices that move away from their bones."""
    posed, main = pose_in_motion(rig), most_votes(weights.matrix)
    verts = skin_vertices(shape.verts, weights.matrix, rig, posed)
    away = distances_from_bones(verts, main, posed) - distances_from_bones(shape.verts, main, rig)
    return volume(verts, shape) / volume(shape.verts, shape), float((unit * away > _MAX_DRIFT_CM).mean())


def row_of(folder: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Compute the row of a folder; joints of all pairs have the same weight."""
    good = [row for row in rows if row["verdict"] == "good"]
    verdicts = Counter(row["verdict"] for row in rows)
    found: dict[str, Any] = {"folder": folder, "pairs": len(rows)}
    found["verdicts"] = " / ".join(str(verdicts[word]) for word in VERDICTS)
    found |= {key: float(np.mean([row[key] for row in rows])) for key in _AVERAGED}
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


def _summarize_lists(row: dict[str, Any]) -> dict[str, Any]:
    """Replace the lists of a pair's row by medians."""
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
        characters, matcher = {file.stem: _Character(file) for file in files}, Matcher(threads=threads)
        pairs = runner.evenly_spread(ordered_pairs(characters), limit_pairs)
        each[folder] = [
            runner.cached_in(
                work, f"{folder}-{a}-{b}", {}, partial(measure_pair, characters[a], characters[b], matcher)
            )
            for a, b in runner.track(pairs, folder)
        ]
        rows.append(row_of(folder, each[folder]))
    short = {folder: [_summarize_lists(row) for row in some] for folder, some in each.items()}
    tables = [runner.table("Rigs", rows, COLUMNS), runner.table("In motion", rows, MOTION_COLUMNS)]
    return runner.Report({"rows": rows, "each": short}, tables)
