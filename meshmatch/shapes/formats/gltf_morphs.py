"""Blendshapes of glTF scenes (morph targets), read and added: those of one name are one shape, whatever meshes it moves.

Specification: Khronos glTF 2.0, sections 3.7.2.2 and 3.11; names are ``targetNames`` in the ``extras`` of a mesh.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats, Floats32
from meshmatch.derived import derived
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import shortest_turns, unit
from meshmatch.outputs import plain_text
from meshmatch.shapes.blend_shapes import BlendShapes, WeightClip, shape_normals
from meshmatch.shapes.formats import check_element_count, gltf_vrm
from meshmatch.shapes.formats.gltf import Document, understood
from meshmatch.shapes.formats.gltf_edit import Editor, drawn, frames_of
from meshmatch.shapes.shape import Shape

_FEW_WEIGHTS = 3_500_000
"""Weights in clips that a file of any size may have; and one more for every 4 of its bytes: several may share theirs."""
_LARGEST = 1e18


def read_morphs(path: Path, data: bytes) -> BlendShapes:
    """The blendshapes of a scene, on the vertices of `gltf.read` in their order; `InputError` if there are none."""
    return understood(path, data, "morph targets make", _morphs)


def with_morphs(document: Document, shape: Shape, added: BlendShapes, turn: Float[Floats, "3 3"]) -> bytes:
    """The scene as a glb in which these shapes move its vertices: what else is in it stays, but for morph targets of the
    same names. ``shape`` is the scene as it was read, and ``turn`` what turns it upright.

    A mesh that no shape moves gets none; any other gets all of them.
    """
    editor = Editor(document)
    normals = shape_normals(shape, added.moves) if added.normals else None
    moving: dict[int, Floats] = {}
    animated, taken = _animated(document), set(added.names)
    seen = 0
    for number, parts in drawn(document).items():
        start, seen = seen, seen + sum(document.count(part["attributes"]["POSITION"]) for part in parts.values())
        if not added.moves[:, start:seen].any():
            continue
        node, mesh = editor.json["nodes"][number], editor.own_mesh(number)
        before, weights = _names(document, document.nodes[number]["mesh"]), _rest(node, mesh)
        node.pop("weights", None)
        place = {name: k for k, name in enumerate(before)}
        kept = [k for k, name in enumerate(before) if name not in taken]
        for k, own in enumerate(mesh["primitives"]):
            rows = slice(start, start + document.count(own["attributes"]["POSITION"]) if k in parts else start)
            start = rows.stop
            targets = [own["targets"][j] for j in kept]
            turns = normals is not None and "NORMAL" in own["attributes"] and all("NORMAL" in each for each in targets)
            around = normals[:, rows] if normals is not None and turns else None
            own["targets"] = [*targets, *_targets(editor, document, number, own, added.moves[:, rows], around)]
        mesh["weights"] = [*(weights[k] for k in kept), *added.weights.tolist()]
        names = {"targetNames": [*(before[k] for k in kept), *added.names]}
        mesh["extras"] = (mesh["extras"] if isinstance(mesh.get("extras"), dict) else {}) | names
        for own in mesh["primitives"]:
            if isinstance(own.get("extras"), dict) and "targetNames" in own["extras"]:
                own["extras"] |= names
        columns = [*kept, *(place.get(name, -1) for name in added.names)]
        for animation, channel in animated.get(number, ()):
            _follow(editor, document, animation, channel, columns, mesh["weights"])
        gltf_vrm.reorder_targets(editor.json, number, node["mesh"], columns)
        moving[number] = np.array([weights[k] for k in kept])
    quiet: dict[str, list[dict[str, Any]]] = {}  # clips that animate no weights, such as those of a skeleton, by name
    for each in reversed(editor.json.get("animations", [])):
        if all(channel["target"]["path"] != "weights" for channel in each["channels"]):
            quiet.setdefault(str(each.get("name")), []).append(each)
    for clip in added.clips:
        _add_clip(editor, clip, moving, quiet)
    if not np.array_equal(turn, np.eye(3)):
        editor.turn(document, turn)
    return editor.to_bytes()


def _morphs(document: Document) -> BlendShapes:
    parts = list(document.primitives())
    names: dict[str, int] = {}
    weights: list[float] = []
    for number in dict.fromkeys(number for number, _, _ in parts):
        node = document.nodes[number]
        rest = _rest(node, document.json["meshes"][node["mesh"]])
        for name, weight in zip(_names(document, node["mesh"]), rest, strict=True):
            if name not in names:
                names[name] = len(names)
                weights.append(weight)
    if not names:
        hint = "export it with its blendshapes, or give them as files: --shapes FOLDER"
        raise InputError(f"{document.name} has no blendshapes (morph targets)", hint)
    counts = [document.count(part["attributes"]["POSITION"]) for _, part, _ in parts]
    check_element_count(document.name, document.size, len(names) * sum(counts) // 4)
    moves = np.zeros((len(names), sum(counts), 3), np.float32)
    seen, normals = 0, True
    for (number, part, place), count in zip(parts, counts, strict=True):
        own_names = _names(document, document.nodes[number]["mesh"])
        for name, target in zip(own_names, part.get("targets", []), strict=True):
            normals &= "NORMAL" in target
            if "POSITION" in target:
                own = document.accessor(target["POSITION"])
                own = np.hstack([own, np.zeros((len(own), 1))])
                moves[names[name], seen : seen + count] = document.moved(number, part, own, place)
        seen += count
    if not (np.isfinite(moves).all() and np.isfinite(weights).all()):
        raise ValueError("a vertex is moved to nowhere")
    return BlendShapes(tuple(names), moves, np.array(weights), normals, _clips(document, names, np.array(weights)))


@derived
def _names(document: Document, number: int) -> tuple[str, ...]:
    """What the targets of a mesh are called, none alike."""
    mesh = document.json["meshes"][number]
    held = [each.get("extras") for each in (mesh, *mesh["primitives"])]  # those of VRM 0.x have them in primitives
    told = [extras.get("targetNames") for extras in held if isinstance(extras, dict)]
    given = next((names for names in told if isinstance(names, list)), [])
    names, taken = list[str](), set[str]()
    for k in range(len(mesh["primitives"][0].get("targets", []))):
        name = plain_text(given[k]) if k < len(given) and isinstance(given[k], str) and given[k] else f"shape {k}"
        names.append(name if name not in taken else f"{name} ({k})")
        taken.add(names[-1])
    return tuple(names)


def _rest(node: dict[str, Any], mesh: dict[str, Any]) -> list[float]:
    """How much of each target of a node's mesh is on."""
    many = len(mesh["primitives"][0].get("targets", []))
    given = [float(weight) for weight in node.get("weights", mesh.get("weights", []))]
    return (given + [0.0] * many)[:many]


def _channels(document: Document, animation: dict[str, Any]) -> list[tuple[int, dict[str, Any], dict[str, Any]]]:
    """Node, channel and sampler of all that animate weights."""
    found = []
    for channel in animation["channels"]:
        node = channel["target"].get("node", -1)
        if channel["target"]["path"] == "weights" and node in document.world and "mesh" in document.nodes[node]:
            found.append((int(node), channel, animation["samplers"][channel["sampler"]]))
    return found


def _track(document: Document, sampler: dict[str, Any], many: int) -> tuple[Floats, Floats, str]:
    """Times (T,), weights (T or 3 T, many), and how they are interpolated."""
    times, values = document.accessor(sampler["input"])[:, 0], document.accessor(sampler["output"])
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise ValueError(f"weights are interpolated by {interpolation}")
    rows = len(times) * (3 if interpolation == "CUBICSPLINE" else 1)
    if not rows or values.size != rows * many:
        raise ValueError(f"there are {values.size} weights of {many} targets for {len(times)} times")
    if not ((np.abs(values) < _LARGEST).all() and (np.abs(times) < _LARGEST).all()):
        raise ValueError("weights are not numbers")
    return times, values.reshape(rows, many), interpolation


def _clips(document: Document, names: dict[str, int], rest: Float[Floats, " K"]) -> tuple[WeightClip, ...]:
    clips = []
    keys = 0
    for number, animation in enumerate(document.json.get("animations", [])):
        tracks: dict[int, tuple[Floats, Floats, str]] = {}
        for node, _, sampler in _channels(document, animation):
            own = _names(document, document.nodes[node]["mesh"])
            times, values, interpolation = _track(document, sampler, len(own))
            keys += len(times) * len(names)
            if keys > _FEW_WEIGHTS + document.size // 4:
                raise InputError(f"the clips of {document.name} hold over {_FEW_WEIGHTS:,} weights", "export fewer")
            for k, name in enumerate(own):
                tracks.setdefault(names.get(name, -1), (times, values[:, k], interpolation))
        tracks.pop(-1, None)  # of a mesh that the scene does not draw
        if tracks:
            clips.append(_joined(plain_text(str(animation.get("name", f"clip {number}"))), tracks, rest))
    return tuple(clips)


def _joined(name: str, tracks: dict[int, tuple[Floats, Floats, str]], rest: Float[Floats, " K"]) -> WeightClip:
    """One clip of the weights of all shapes; those that have other times than the rest are sampled at the times of all."""
    times, _, interpolation = first = next(iter(tracks.values()))
    alike = all(np.array_equal(times, each[0]) and interpolation == each[2] for each in tracks.values())
    if not alike:
        times, interpolation = np.unique(np.concatenate([each[0] for each in tracks.values()])), "LINEAR"
    rows = len(first[1]) if alike else len(times)
    weights = np.tile(rest, (rows, 1))
    if interpolation == "CUBICSPLINE":
        weights[0::3], weights[2::3] = 0.0, 0.0
    for k, (own, values, kind) in tracks.items():
        keys = values[1::3] if kind == "CUBICSPLINE" and not alike else values
        weights[:, k] = keys if alike else np.interp(times, own, keys)
    return WeightClip(name, times, weights, interpolation)


def _targets(
    editor: Editor,
    document: Document,
    number: int,
    own: dict[str, Any],
    moves: Float[Floats32, "K V 3"],
    normals: Float[Floats32, "N V 3"] | None,
) -> Iterator[dict[str, int]]:
    """Morph targets of one primitive, from how its vertices move in the scene; and the normals there, at rest and with
    each shape on.
    """
    frames = frames_of(document, number, own)
    back, stored = np.linalg.pinv(frames), np.empty((0, 3))
    if normals is not None:
        stored = unit(document.accessor(own["attributes"]["NORMAL"]))
        standing = unit(np.einsum("vji,vj->vi", back, stored))
    for k, move in enumerate(moves):
        local = np.einsum("vij,vj->vi", back, move)
        target = {"POSITION": editor.add_sparse(local.astype("<f4"), bounds=True)}
        if normals is not None:
            rest, now = normals[0], normals[1 + k]
            turned = np.einsum("vij,vj->vi", shortest_turns(rest, now), standing)
            turned = unit(np.einsum("vji,vj->vi", frames, turned)) - stored
            turned[(now == rest).all(axis=1)] = 0.0
            target["NORMAL"] = editor.add_sparse(turned.astype("<f4"))
        yield target


def _animated(document: Document) -> dict[int, list[tuple[int, int]]]:
    """Of each node the clips, and channels of these, that animate its weights, by number."""
    found: dict[int, list[tuple[int, int]]] = {}
    for number, animation in enumerate(document.json.get("animations", [])):
        for k, channel in enumerate(animation["channels"]):
            if channel["target"].get("path") == "weights":
                found.setdefault(channel["target"].get("node", -1), []).append((number, k))
    return found


def _follow(editor: Editor, document: Document, number: int, k: int, columns: list[int], weights: list[float]) -> None:
    """Let a channel of a clip hold the weights of a node's new targets: ``columns`` are their old places, or -1."""
    before, animation = document.json["animations"][number], editor.json["animations"][number]
    channel = before["channels"][k]
    sampler = before["samplers"][channel["sampler"]]
    many = len(_names(document, document.nodes[channel["target"]["node"]]["mesh"]))
    _, values, interpolation = _track(document, sampler, many)
    rows = np.tile(weights, (len(values), 1))
    if interpolation == "CUBICSPLINE":
        rows[0::3] = rows[2::3] = 0.0
    for new, old in enumerate(columns):
        rows[:, new] = rows[:, new] if old < 0 else values[:, old]
    animation["channels"][k]["sampler"] = len(animation["samplers"])
    animation["samplers"].append(sampler | {"output": editor.add_array(rows.reshape(-1, 1).astype("<f4"))})


def _add_clip(
    editor: Editor, clip: WeightClip, moving: dict[int, Float[Floats, " N"]], quiet: dict[str, list[dict[str, Any]]]
) -> None:
    """Animate the weights of nodes; ``moving`` are those of the targets that a node has before the new ones.

    A ``quiet`` clip of that name, which animates no weights, takes them in; each does so once.
    """
    joined = quiet[clip.name].pop() if quiet.get(clip.name) else None
    entry: dict[str, Any] = joined or {"name": clip.name, "samplers": [], "channels": []}
    times = editor.add_array(clip.times.astype("<f4"), bounds=True)
    samplers: dict[bytes, int] = {}
    for number, kept in moving.items():
        if kept.tobytes() not in samplers:
            before = np.tile(kept, (len(clip.weights), 1))
            if clip.interpolation == "CUBICSPLINE":
                before[0::3] = before[2::3] = 0.0
            rows = np.hstack([before, clip.weights]).reshape(-1, 1)
            sampler = {"input": times, "output": editor.add_array(rows.astype("<f4"))}
            samplers[kept.tobytes()] = len(entry["samplers"])
            entry["samplers"].append(sampler | {"interpolation": clip.interpolation})
        target = {"node": number, "path": "weights"}
        entry["channels"].append({"sampler": samplers[kept.tobytes()], "target": target})
    if joined is None and moving:
        editor.add("animations", entry)
