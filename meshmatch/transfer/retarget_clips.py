"""Retargeting of animation clips to the same skeleton on another shape.

Clips keep the source's rotations, so that a body in any rest pose can play them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats
from meshmatch.shapes.formats.gltf_rig import Clip, Moved, Rig, Track

_TOLERANCE = 1e-9
_MAX_LOOSE, _MAX_TIMES = 32, 2000  # maximum number of following joints in a clip, and of keys of each
Tracks = dict[tuple[int, Moved], Track]


def retargeted(clip: Clip, rig: Rig, posed: Rig, lengths: Float[Floats, " N"], loose: Mapping[int, int]) -> Clip:
    """Retarget a clip to the skeleton in the source's pose: rotations are kept, translations are scaled about the rest pose.

    Parameters
    ----------
    clip
        A clip of the source's skeleton.
    rig
        The source's skeleton.
    posed
        The same skeleton on the target, in the source's pose.
    lengths
        (N,) scale from source to target of lengths in the frame of each node.
    loose
        Nodes that follow another node on the skin instead of their parent, in order of dependence.
    """
    tracks = []
    for track in clip.tracks:
        node, values = track.node, track.values
        if track.moves == "translation":
            values = values * lengths[rig.parents[node]]
            shift = posed.translations[node] - rig.translations[node] * lengths[rig.parents[node]]
            values[slice(1, None, 3) if track.interpolation == "CUBICSPLINE" else slice(None)] += shift
        elif track.moves == "scale":
            if not rig.scales[node].all():
                continue
            values = values / rig.scales[node]
        tracks.append(replace(track, values=values))
    new_tracks = {(track.node, track.moves): track for track in tracks}
    source_tracks = {(track.node, track.moves): track for track in clip.tracks}
    for node, anchor in list(loose.items())[:_MAX_LOOSE]:
        times = _key_times(source_tracks, _chain(rig, node) | _chain(rig, anchor))
        if len(times):
            new_tracks[node, "translation"] = _following_track(
                node, anchor, times, (rig, source_tracks), (posed, new_tracks), lengths[anchor]
            )
    return replace(clip, tracks=tuple(new_tracks.values()))


def _chain(rig: Rig, node: int) -> set[int]:
    """A node and all its ancestors."""
    found = set()
    while node >= 0:
        found.add(node)
        node = int(rig.parents[node])
    return found


def _key_times(tracks: Tracks, nodes: set[int]) -> Float[Floats, " T"]:
    """(T,) all key times of these nodes, thinned out if there are very many."""
    own = [track.times for (node, _), track in tracks.items() if node in nodes]
    times = np.unique(np.concatenate(own)) if own else np.empty(0)
    return times[np.linspace(0, len(times) - 1, min(len(times), _MAX_TIMES)).astype(np.int64)]


def _following_track(
    node: int,
    anchor: int,
    times: Float[Floats, " T"],
    source: tuple[Rig, Tracks],
    target: tuple[Rig, Tracks],
    length: float,
) -> Track:
    """Translations of a node that stays in place relative to its anchor, up to its relative motion on the source."""
    rest_offset, offsets = (
        _to_local(
            _world_matrices(source[0], tracks, anchor, at), _world_matrices(source[0], tracks, node, at)[:, :3, 3]
        )
        for tracks, at in (({}, times[:1]), (source[1], times))
    )
    rest = {key: track for key, track in target[1].items() if key[0] != node}
    frames = _world_matrices(target[0], rest, anchor, times)
    rest_place = _to_local(
        _world_matrices(target[0], {}, anchor, times[:1]), _world_matrices(target[0], {}, node, times[:1])[:, :3, 3]
    )
    local_place = rest_place + length * (offsets - rest_offset)
    place = np.einsum("tij,tj->ti", frames[:, :3, :3], local_place) + frames[:, :3, 3]
    parent = _world_matrices(target[0], target[1], int(target[0].parents[node]), times)
    chains = _chain(source[0], node) | _chain(source[0], anchor)
    steps = {track.interpolation for (moved, _), track in source[1].items() if moved in chains} == {"STEP"}
    return Track(node, "translation", times, _to_local(parent, place), "STEP" if steps else "LINEAR")


def _to_local(frames: Float[Floats, "T 4 4"], places: Float[Floats, "T 3"]) -> Float[Floats, "T 3"]:
    """Places in the coordinates of a frame, at each time."""
    return np.asarray(np.linalg.solve(frames[:, :3, :3], (places - frames[:, :3, 3])[..., None])[..., 0])


def _world_matrices(rig: Rig, tracks: Tracks, node: int, times: Float[Floats, " T"]) -> Float[Floats, "T 4 4"]:
    """World matrices of a node, at each time."""
    world = np.tile(np.eye(4), (len(times), 1, 1))
    while node >= 0:
        rotations, translations, scales = (
            _sample_track(tracks.get((node, moves)), rest[node], times) for moves, rest in _rest_values(rig)
        )
        local = np.tile(np.eye(4), (len(times), 1, 1))
        local[:, :3, :3] = Rotation.from_quat(rotations).as_matrix() * scales[:, None, :]
        local[:, :3, 3] = translations
        world = local @ world
        node = int(rig.parents[node])
    return world


def _rest_values(rig: Rig) -> tuple[tuple[Moved, Floats], ...]:
    return ("rotation", rig.rotations), ("translation", rig.translations), ("scale", rig.scales)


def _sample_track(track: Track | None, rest: Float[Floats, " D"], times: Float[Floats, " T"]) -> Float[Floats, "T D"]:
    """Values of a track at these times; splines are interpolated linearly between keys."""
    if track is None:
        return np.tile(rest, (len(times), 1))
    values = track.values[1::3] if track.interpolation == "CUBICSPLINE" else track.values
    if track.interpolation == "STEP":
        return values[np.maximum(np.searchsorted(track.times, times, side="right") - 1, 0)]
    if track.moves == "rotation":  # signs of quaternions, for the shorter way
        signs = np.sign(np.einsum("td,td->t", values[1:], values[:-1]))
        values = values * np.cumprod(np.concatenate([[1.0], np.where(signs == 0, 1.0, signs)]))[:, None]
    return np.stack([np.interp(times, track.times, column) for column in values.T], axis=1)


def points_at_start(clip: Clip, rig: Rig, node: int, along: Float[Floats, " 3"]) -> Float[Floats, " 3"]:
    """Direction at the start of a clip of what is attached to a node and points ``along`` a direction in the rest pose."""
    tracks = {(track.node, track.moves): track for track in clip.tracks}
    begins = min((float(track.times[0]) for track in clip.tracks), default=0.0)
    start_matrix, rest_matrix = _world_matrices(rig, tracks, node, np.array([begins]))[0], rig.worlds()[node]
    direction = start_matrix[:3, :3] @ np.linalg.pinv(rest_matrix[:3, :3]) @ along
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-300))


def standing_clips(bind: Rig, posed: Rig) -> tuple[Clip, ...]:
    """Clips of a skeleton in the source's pose, for one in the pose of `bind`: nodes that a clip does not animate get
    constant tracks that hold them in the source's pose.
    """
    found = []
    for clip in posed.clips:
        moved = {(track.node, track.moves) for track in clip.tracks}
        poses: tuple[tuple[Moved, Floats, Floats], ...] = (
            ("rotation", bind.rotations, posed.rotations),
            ("translation", bind.translations, posed.translations),
        )
        holding = [
            Track(node, moves, np.zeros(1), there[node : node + 1], "LINEAR")
            for moves, here, there in poses
            for node in np.flatnonzero(np.abs(here - there).max(axis=1) > _TOLERANCE).tolist()
            if (node, moves) not in moved
        ]
        found.append(replace(clip, tracks=(*clip.tracks, *holding)))
    return tuple(found)
