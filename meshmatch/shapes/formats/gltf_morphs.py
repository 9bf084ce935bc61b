"""Read and add blendshapes (morph targets) of glTF scenes. Targets with the same name, on any meshes, are one blendshape.

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
from meshmatch.geometry.triangles import normalized, rotations_between
from meshmatch.outputs import plain_text
from meshmatch.shapes.blend_shapes import BlendShapes, WeightClip, shape_normals
from meshmatch.shapes.formats import check_element_count, gltf_vrm
from meshmatch.shapes.formats.gltf import Document, parse_document
from meshmatch.shapes.formats.gltf_edit import Editor, drawn_nodes, vertex_frames
from meshmatch.shapes.shape import Shape

_BASE_WEIGHTS = 3_500_000
"""Weights in clips allowed in a file of any size; each 4 bytes allow one more (channels may share their weights)."""
_MAX_VALUE = 1e18


def read_morphs(path: Path, data: bytes) -> BlendShapes:
    """Read the blendshapes of a scene, for the vertices of `gltf.read` in their order; `InputError` if there are none."""
    return parse_document(path, data, "morph targets make", _read_morphs)


def with_morphs(document: Document, shape: Shape, added: BlendShapes, turn: Float[Floats, "3 3"]) -> bytes:
    """Return the scene as a glb with blendshapes added; morph targets with the same names are replaced.

    ``shape`` is the scene as read, and ``turn`` the rotation that makes it upright. A mesh gets all of the blendshapes if
    any of them moves it, else none.
    """
    editor = Editor(document)
    normals = shape_normals(shape, added.moves) if added.normals else None
    moving: dict[int, Floats] = {}
    animated, replaced = _weight_channels(document), set(added.names)
    n_verts = 0
    for number, parts in drawn_nodes(document).items():
        start, n_verts = (
            n_verts,
            n_verts + sum(document.count(part["attributes"]["POSITION"]) for part in parts.values()),
        )
        if not added.moves[:, start:n_verts].any():
            continue
        node, mesh = editor.json["nodes"][number], editor.own_mesh(number)
        before, weights = _names(document, document.nodes[number]["mesh"]), _initial_weights(node, mesh)
        node.pop("weights", None)
        index_of = {name: k for k, name in enumerate(before)}
        kept = [k for k, name in enumerate(before) if name not in replaced]
        for k, primitive in enumerate(mesh["primitives"]):
            rows = slice(start, start + document.count(primitive["attributes"]["POSITION"]) if k in parts else start)
            start = rows.stop
            targets = [primitive["targets"][j] for j in kept]
            has_normals = (
                normals is not None
                and "NORMAL" in primitive["attributes"]
                and all("NORMAL" in each for each in targets)
            )
            own_normals = normals[:, rows] if normals is not None and has_normals else None
            primitive["targets"] = [
                *targets,
                *_add_targets(editor, document, number, primitive, added.moves[:, rows], own_normals),
            ]
        mesh["weights"] = [*(weights[k] for k in kept), *added.weights.tolist()]
        names = {"targetNames": [*(before[k] for k in kept), *added.names]}
        mesh["extras"] = (mesh["extras"] if isinstance(mesh.get("extras"), dict) else {}) | names
        for primitive in mesh["primitives"]:
            if isinstance(primitive.get("extras"), dict) and "targetNames" in primitive["extras"]:
                primitive["extras"] |= names
        columns = [*kept, *(index_of.get(name, -1) for name in added.names)]
        for animation, channel in animated.get(number, ()):
            _retarget_channel(editor, document, animation, channel, columns, mesh["weights"])
        gltf_vrm.reorder_targets(editor.json, number, node["mesh"], columns)
        moving[number] = np.array([weights[k] for k in kept])
    quiet: dict[str, list[dict[str, Any]]] = {}  # by name, clips that animate no weights, such as those of a skeleton
    for each in reversed(editor.json.get("animations", [])):
        if all(channel["target"]["path"] != "weights" for channel in each["channels"]):
            quiet.setdefault(str(each.get("name")), []).append(each)
    for clip in added.clips:
        _add_clip(editor, clip, moving, quiet)
    if not np.array_equal(turn, np.eye(3)):
        editor.turn(document, turn)
    return editor.to_bytes()


def _read_morphs(document: Document) -> BlendShapes:
    parts = list(document.primitives())
    names: dict[str, int] = {}
    weights: list[float] = []
    for number in dict.fromkeys(number for number, _, _ in parts):
        node = document.nodes[number]
        rest = _initial_weights(node, document.json["meshes"][node["mesh"]])
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
    n_verts, normals = 0, True
    for (number, part, matrix), count in zip(parts, counts, strict=True):
        own_names = _names(document, document.nodes[number]["mesh"])
        for name, target in zip(own_names, part.get("targets", []), strict=True):
            normals &= "NORMAL" in target
            if "POSITION" in target:
                displacement = document.accessor(target["POSITION"])
                displacement = np.hstack([displacement, np.zeros((len(displacement), 1))])
                moves[names[name], n_verts : n_verts + count] = document.to_scene(number, part, displacement, matrix)
        n_verts += count
    if not (np.isfinite(moves).all() and np.isfinite(weights).all()):
        raise ValueError("a vertex is moved to nowhere")
    return BlendShapes(tuple(names), moves, np.array(weights), normals, _clips(document, names, np.array(weights)))


@derived
def _names(document: Document, number: int) -> tuple[str, ...]:
    """Unique names of the morph targets of a mesh."""
    mesh = document.json["meshes"][number]
    all_extras = [each.get("extras") for each in (mesh, *mesh["primitives"])]  # VRM 0.x has the names in primitives
    given_lists = [extras.get("targetNames") for extras in all_extras if isinstance(extras, dict)]
    given_names = next((names for names in given_lists if isinstance(names, list)), [])
    names, used_names = list[str](), set[str]()
    for k in range(len(mesh["primitives"][0].get("targets", []))):
        name = (
            plain_text(given_names[k])
            if k < len(given_names) and isinstance(given_names[k], str) and given_names[k]
            else f"shape {k}"
        )
        names.append(name if name not in used_names else f"{name} ({k})")
        used_names.add(names[-1])
    return tuple(names)


def _initial_weights(node: dict[str, Any], mesh: dict[str, Any]) -> list[float]:
    """Initial weights of the morph targets of a node's mesh."""
    n_targets = len(mesh["primitives"][0].get("targets", []))
    weights = [float(weight) for weight in node.get("weights", mesh.get("weights", []))]
    return (weights + [0.0] * n_targets)[:n_targets]


def _channels(document: Document, animation: dict[str, Any]) -> list[tuple[int, dict[str, Any], dict[str, Any]]]:
    """(node, channel, sampler) of all channels of a clip that animate morph weights in the scene."""
    found = []
    for channel in animation["channels"]:
        node = channel["target"].get("node", -1)
        if channel["target"]["path"] == "weights" and node in document.world and "mesh" in document.nodes[node]:
            found.append((int(node), channel, animation["samplers"][channel["sampler"]]))
    return found


def _track(document: Document, sampler: dict[str, Any], n_targets: int) -> tuple[Floats, Floats, str]:
    """Return times (T,), weights (T or 3 T, n_targets) and the interpolation of a sampler."""
    times, values = document.accessor(sampler["input"])[:, 0], document.accessor(sampler["output"])
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise ValueError(f"weights are interpolated by {interpolation}")
    rows = len(times) * (3 if interpolation == "CUBICSPLINE" else 1)
    if not rows or values.size != rows * n_targets:
        raise ValueError(f"there are {values.size} weights of {n_targets} targets for {len(times)} times")
    if not ((np.abs(values) < _MAX_VALUE).all() and (np.abs(times) < _MAX_VALUE).all()):
        raise ValueError("weights are not numbers")
    return times, values.reshape(rows, n_targets), interpolation


def _clips(document: Document, names: dict[str, int], rest: Float[Floats, " K"]) -> tuple[WeightClip, ...]:
    clips = []
    keys = 0
    for number, animation in enumerate(document.json.get("animations", [])):
        tracks: dict[int, tuple[Floats, Floats, str]] = {}
        for node, _, sampler in _channels(document, animation):
            target_names = _names(document, document.nodes[node]["mesh"])
            times, values, interpolation = _track(document, sampler, len(target_names))
            keys += len(times) * len(names)
            if keys > _BASE_WEIGHTS + document.size // 4:
                raise InputError(f"the clips of {document.name} hold over {_BASE_WEIGHTS:,} weights", "export fewer")
            for k, name in enumerate(target_names):
                tracks.setdefault(names.get(name, -1), (times, values[:, k], interpolation))
        tracks.pop(-1, None)  # targets of a mesh that the scene does not draw
        if tracks:
            clips.append(_merge_tracks(plain_text(str(animation.get("name", f"clip {number}"))), tracks, rest))
    return tuple(clips)


def _merge_tracks(name: str, tracks: dict[int, tuple[Floats, Floats, str]], rest: Float[Floats, " K"]) -> WeightClip:
    """Merge tracks (by number of the blendshape) to one clip of the weights of all blendshapes.

    If times or interpolations differ, all tracks are resampled linearly at the union of their times.
    """
    times, _, interpolation = first = next(iter(tracks.values()))
    same_keys = all(np.array_equal(times, each[0]) and interpolation == each[2] for each in tracks.values())
    if not same_keys:
        times, interpolation = np.unique(np.concatenate([each[0] for each in tracks.values()])), "LINEAR"
    rows = len(first[1]) if same_keys else len(times)
    weights = np.tile(rest, (rows, 1))
    if interpolation == "CUBICSPLINE":
        weights[0::3], weights[2::3] = 0.0, 0.0
    for k, (track_times, values, kind) in tracks.items():
        keys = values[1::3] if kind == "CUBICSPLINE" and not same_keys else values
        weights[:, k] = keys if same_keys else np.interp(times, track_times, keys)
    return WeightClip(name, times, weights, interpolation)


def _add_targets(
    editor: Editor,
    document: Document,
    number: int,
    primitive: dict[str, Any],
    moves: Float[Floats32, "K V 3"],
    normals: Float[Floats32, "N V 3"] | None,
) -> Iterator[dict[str, int]]:
    """Add the morph targets of one primitive and yield their attributes.

    ``moves`` are the displacements of its vertices in scene coordinates; ``normals`` the scene normals at rest, followed by
    those with each blendshape at weight 1, or None for targets without normals.
    """
    frames = vertex_frames(document, number, primitive)
    to_local, stored = np.linalg.pinv(frames), np.empty((0, 3))
    if normals is not None:
        stored = normalized(document.accessor(primitive["attributes"]["NORMAL"]))
        scene_normals = normalized(np.einsum("vji,vj->vi", to_local, stored))
    for k, move in enumerate(moves):
        local_moves = np.einsum("vij,vj->vi", to_local, move)
        target = {"POSITION": editor.add_sparse(local_moves.astype("<f4"), bounds=True)}
        if normals is not None:
            rest, deformed = normals[0], normals[1 + k]
            rotated = np.einsum("vij,vj->vi", rotations_between(rest, deformed), scene_normals)
            rotated = normalized(np.einsum("vji,vj->vi", frames, rotated)) - stored  # displacements of local normals
            rotated[(deformed == rest).all(axis=1)] = 0.0
            target["NORMAL"] = editor.add_sparse(rotated.astype("<f4"))
        yield target


def _weight_channels(document: Document) -> dict[int, list[tuple[int, int]]]:
    """Map each node to the (clip, channel) numbers that animate its weights."""
    found: dict[int, list[tuple[int, int]]] = {}
    for number, animation in enumerate(document.json.get("animations", [])):
        for k, channel in enumerate(animation["channels"]):
            if channel["target"].get("path") == "weights":
                found.setdefault(channel["target"].get("node", -1), []).append((number, k))
    return found


def _retarget_channel(
    editor: Editor, document: Document, number: int, k: int, columns: list[int], weights: list[float]
) -> None:
    """Rewrite a channel of a clip for the new targets of its node.

    ``columns`` has the old index of each new target, or -1; ``weights`` are constant values for those without one.
    """
    before, animation = document.json["animations"][number], editor.json["animations"][number]
    channel = before["channels"][k]
    sampler = before["samplers"][channel["sampler"]]
    n_targets = len(_names(document, document.nodes[channel["target"]["node"]]["mesh"]))
    _, values, interpolation = _track(document, sampler, n_targets)
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
    """Add a clip that animates the new targets of nodes.

    ``moving`` has, by node, the constant weights of the targets before the new ones. If ``quiet`` has a clip of this name,
    which animates no weights, the channels are added to that clip, which is then removed from ``quiet``.
    """
    joined = quiet[clip.name].pop() if quiet.get(clip.name) else None
    entry: dict[str, Any] = joined or {"name": clip.name, "samplers": [], "channels": []}
    times = editor.add_array(clip.times.astype("<f4"), bounds=True)
    samplers: dict[bytes, int] = {}
    for number, kept in moving.items():
        if kept.tobytes() not in samplers:
            kept_rows = np.tile(kept, (len(clip.weights), 1))
            if clip.interpolation == "CUBICSPLINE":
                kept_rows[0::3] = kept_rows[2::3] = 0.0
            rows = np.hstack([kept_rows, clip.weights]).reshape(-1, 1)
            sampler = {"input": times, "output": editor.add_array(rows.astype("<f4"))}
            samplers[kept.tobytes()] = len(entry["samplers"])
            entry["samplers"].append(sampler | {"interpolation": clip.interpolation})
        target = {"node": number, "path": "weights"}
        entry["channels"].append({"sampler": samplers[kept.tobytes()], "target": target})
    if joined is None and moving:
        editor.add("animations", entry)
