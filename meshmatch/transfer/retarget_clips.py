"""Animation clips of one skeleton for the same skeleton on another shape.

Clips keep the source's rotations, so that a body in any pose can play them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats
from meshmatch.shapes.formats.gltf_rig import Clip, Moved, Rig, Track

_SAME = 1e-9
_MOST_LOOSE, _MOST_TIMES = 32, 2000  # joints of a clip that follow others, and keys of each
Tracks = dict[tuple[int, Moved], Track]


def retargeted(clip: Clip, rig: Rig, posed: Rig, lengths: Float[Floats, " N"], loose: Mapping[int, int]) -> Clip:
    """A clip for the skeleton that stands in the source's pose: rotations as they are, translations scaled from there.

    Parameters
    ----------
    clip
        For the source's skeleton.
    rig
        That skeleton.
    posed
        The same on the target.
    lengths
        What a unit of length in the frame of each of its nodes becomes.
    loose
        Nodes that follow others on the skin, in the order in which they depend on one another.
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
    made = {(track.node, track.moves): track for track in tracks}
    given = {(track.node, track.moves): track for track in clip.tracks}
    for node, anchor in list(loose.items())[:_MOST_LOOSE]:
        times = _times(given, _chain(rig, node) | _chain(rig, anchor))
        if len(times):
            made[node, "translation"] = _following(node, anchor, times, (rig, given), (posed, made), lengths[anchor])
    return replace(clip, tracks=tuple(made.values()))


def _chain(rig: Rig, node: int) -> set[int]:
    """A node and all above it."""
    found = set()
    while node >= 0:
        found.add(node)
        node = int(rig.parents[node])
    return found


def _times(tracks: Tracks, nodes: set[int]) -> Float[Floats, " T"]:
    """All times at which any of these nodes has a key; of very many a part."""
    own = [track.times for (node, _), track in tracks.items() if node in nodes]
    times = np.unique(np.concatenate(own)) if own else np.empty(0)
    return times[np.linspace(0, len(times) - 1, min(len(times), _MOST_TIMES)).astype(np.int64)]


def _following(
    node: int,
    anchor: int,
    times: Float[Floats, " T"],
    source: tuple[Rig, Tracks],
    target: tuple[Rig, Tracks],
    length: float,
) -> Track:
    """How a node moves that stays where it is beside its anchor, but for what it moves there on the source."""
    before, moving = (
        _beside(_worlds(source[0], tracks, anchor, at), _worlds(source[0], tracks, node, at)[:, :3, 3])
        for tracks, at in (({}, times[:1]), (source[1], times))
    )
    rest = {key: track for key, track in target[1].items() if key[0] != node}
    frames = _worlds(target[0], rest, anchor, times)
    standing = _beside(_worlds(target[0], {}, anchor, times[:1]), _worlds(target[0], {}, node, times[:1])[:, :3, 3])
    beside = standing + length * (moving - before)
    place = np.einsum("tij,tj->ti", frames[:, :3, :3], beside) + frames[:, :3, 3]
    parent = _worlds(target[0], target[1], int(target[0].parents[node]), times)
    chains = _chain(source[0], node) | _chain(source[0], anchor)
    steps = {track.interpolation for (moved, _), track in source[1].items() if moved in chains} == {"STEP"}
    return Track(node, "translation", times, _beside(parent, place), "STEP" if steps else "LINEAR")


def _beside(frames: Float[Floats, "T 4 4"], places: Float[Floats, "T 3"]) -> Float[Floats, "T 3"]:
    """Places in the coordinates of a frame, at each time."""
    return np.asarray(np.linalg.solve(frames[:, :3, :3], (places - frames[:, :3, 3])[..., None])[..., 0])


def _worlds(rig: Rig, tracks: Tracks, node: int, times: Float[Floats, " T"]) -> Float[Floats, "T 4 4"]:
    """Where a node stands in the scene, at each time."""
    world = np.tile(np.eye(4), (len(times), 1, 1))
    while node >= 0:
        rotations, translations, scales = (
            _sampled(tracks.get((node, moves)), rest[node], times) for moves, rest in _parts(rig)
        )
        local = np.tile(np.eye(4), (len(times), 1, 1))
        local[:, :3, :3] = Rotation.from_quat(rotations).as_matrix() * scales[:, None, :]
        local[:, :3, 3] = translations
        world = local @ world
        node = int(rig.parents[node])
    return world


def _parts(rig: Rig) -> tuple[tuple[Moved, Floats], ...]:
    return ("rotation", rig.rotations), ("translation", rig.translations), ("scale", rig.scales)


def _sampled(track: Track | None, rest: Float[Floats, " D"], times: Float[Floats, " T"]) -> Float[Floats, "T D"]:
    """The values of a track at these times; a spline's are taken as straight between its keys."""
    if track is None:
        return np.tile(rest, (len(times), 1))
    values = track.values[1::3] if track.interpolation == "CUBICSPLINE" else track.values
    if track.interpolation == "STEP":
        return values[np.maximum(np.searchsorted(track.times, times, side="right") - 1, 0)]
    if track.moves == "rotation":  # the shorter way round
        turns = np.sign(np.einsum("td,td->t", values[1:], values[:-1]))
        values = values * np.cumprod(np.concatenate([[1.0], np.where(turns == 0, 1.0, turns)]))[:, None]
    return np.stack([np.interp(times, track.times, column) for column in values.T], axis=1)


def points_at_start(clip: Clip, rig: Rig, node: int, along: Float[Floats, " 3"]) -> Float[Floats, " 3"]:
    """Where what goes with a node points as a clip begins, if it points ``along`` a direction as the file stands."""
    tracks = {(track.node, track.moves): track for track in clip.tracks}
    begins = min((float(track.times[0]) for track in clip.tracks), default=0.0)
    there, here = _worlds(rig, tracks, node, np.array([begins]))[0], rig.worlds()[node]
    found = there[:3, :3] @ np.linalg.pinv(here[:3, :3]) @ along
    return np.asarray(found / max(float(np.linalg.norm(found)), 1e-300))


def standing_clips(bind: Rig, posed: Rig) -> tuple[Clip, ...]:
    """The clips of a skeleton in the source's pose, for one that stands as `bind` does: what they leave alone is held as the
    source has it.
    """
    found = []
    for clip in posed.clips:
        moved = {(track.node, track.moves) for track in clip.tracks}
        poses: tuple[tuple[Moved, Floats, Floats], ...] = (
            ("rotation", bind.rotations, posed.rotations),
            ("translation", bind.translations, posed.translations),
        )
        held = [
            Track(node, moves, np.zeros(1), there[node : node + 1], "LINEAR")
            for moves, here, there in poses
            for node in np.flatnonzero(np.abs(here - there).max(axis=1) > _SAME).tolist()
            if (node, moves) not in moved
        ]
        found.append(replace(clip, tracks=(*clip.tracks, *held)))
    return tuple(found)
