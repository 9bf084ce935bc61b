"""A skeleton carried from one shape to another by a map, and its clips with it.

Every joint follows the skin around it: by the similarity that takes the source's skin near the joint to its places on the
target, and turned as the skin that the joint moves is turned. Nodes above all joints that move vertices stay upright
and on the ground, in the size of the target.

Where the parent of a joint moves no vertex, as of feet that hang from the root, the joint follows its neighbour on the
skin into the source's pose, and in clips.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Bool, Bools, Brief, Float, Floats, Int, Ints
from meshmatch.geometry.frames import RigidPose, kabsch
from meshmatch.shapes.formats.gltf_rig import Rig
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.retarget_clips import retargeted

UP = 1
"""glTF stands along y."""
# All set by hand. A joint moves vertices if its weights sum to so much.
_LEAST = 3.0
# The skin near a joint: as far as so many vertices, at least this share of the shape's size, and this many times that.
_NEAREST, _NEAR, _REACH = 20, 0.03, 1.5
# A parent's own skin is asked too where it reaches as near to the joint, but for this factor, as the joint's does.
_ALIKE = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class CarriedRig(Brief):
    """A skeleton on a target, in two poses; no node has a scale. The first node is new, and all others hang from it."""

    bind: Rig  # as the target stands
    source_pose: Rig  # as the source stands; with the clips


@dataclass(frozen=True, eq=False)
class _Similarity:
    scale: float
    pose: RigidPose

    def __call__(self, points: Floats) -> Floats:
        return np.asarray(self.scale * points @ self.pose.rotation.T + self.pose.center)


def _similarity(here: Float[Floats, "V 3"], there: Float[Floats, "V 3"], weights: Float[Floats, " V"]) -> _Similarity:
    """The best similarity by least squares (Umeyama 1991)."""
    share = weights / max(weights.sum(), 1e-300)
    rotation = kabsch(here, there, weights).rotation
    a, b = share @ here, share @ there
    spread = share @ ((here - a) ** 2).sum(axis=1)
    along = share @ (((here - a) @ rotation.T) * (there - b)).sum(axis=1)
    scale = float(along / spread) if spread > 0 and along > 0 else 1.0
    return _Similarity(scale, RigidPose(rotation, b - scale * rotation @ a))


def upright(source: Shape, points: Float[Floats, "V 3"], trust: Float[Floats, " V"]) -> Float[Floats, "3 3"]:
    """The turn about one axis, by right angles, after which the places of the source's vertices stand along y as it does."""
    return turn_of(kabsch(source.verts, points, trust).rotation[:, UP])


def turn_of(up: Float[Floats, " 3"]) -> Float[Floats, "3 3"]:
    """The turn about one axis, by right angles, that takes the axis nearest to a direction to y."""
    axis = int(np.abs(up).argmax())
    if axis == UP:
        return np.eye(3) if up[UP] > 0 else np.diag([1.0, -1.0, -1.0])
    turn, sign = np.zeros((3, 3)), np.sign(up[axis])
    turn[UP, axis], turn[axis, UP], turn[3 - axis - UP, 3 - axis - UP] = sign, -sign, 1.0
    return turn


def carry(
    rig: Rig,
    weights: csr_array,
    source: Shape,
    points: Float[Floats, "V_source 3"],
    trust: Float[Floats, " V_source"],
    ground: float,
) -> CarriedRig:
    """The skeleton on the target, below a new node with the name of the source.

    Parameters
    ----------
    rig
        That of the source.
    weights
        (V_source, J) of its joints.
    source
        The shape that it moves.
    points
        Where the source's vertices lie on the target, which stands along y.
    trust
        How much each of them counts.
    ground
        The lowest y of the target.
    """
    rig = _below_a_root(rig, source.name.rpartition(".")[0] or source.name or "rig")
    skin = _Skin(rig, weights)
    worlds, turns, parents = rig.worlds(), _turns(rig), rig.parents.tolist()
    places, carried = np.zeros((len(parents), 3)), np.zeros((len(parents), 3, 3))
    size = float(np.ptp(source.bounds, axis=0).max())
    similarities: dict[int, _Similarity] = {}
    for node in np.flatnonzero(skin.body).tolist():
        at, parent = worlds[node, :3, 3], parents[node]
        if skin.moves[node]:
            own, above = skin.of(node), skin.of(parent)
            carried[node] = kabsch(source.verts, points, own**2 * trust).rotation
            parts = [own + above]
            if above.any() and _reach(at, source.verts, above, size) <= _ALIKE * _reach(at, source.verts, own, size):
                parts += [own, above]  # each moves rigidly, and the joint with both
            near = [_near(at, source.verts, part, size) * trust for part in parts]
            follow = [_similarity(source.verts, points, each) for each in near]
            similarities[node] = follow[0]
            places[node] = np.mean([each(at) for each in follow], axis=0)
        else:
            carried[node], similarities[node] = carried[parent], similarities[parent]
            places[node] = similarities[node](at)
    upper = ~skin.body
    scale = _bone_ratio(rig, skin.body, worlds[:, :3, 3], places)
    heading = _heading(_similarity(source.verts, points, trust).pose.rotation)
    here, there = worlds[skin.first, :3, 3].copy(), places[skin.first].copy()
    here[UP], there[UP] = source.bounds[0, UP], ground
    standing = scale * (worlds[:, :3, 3] - here) @ heading.T + there
    places[upper], carried[upper] = standing[upper], heading
    bind = _posed(rig, carried @ turns, places)

    # The same skeleton in the source's pose.
    turned = heading @ turns
    moved = standing.copy()
    for node in skin.order:
        anchor = skin.anchors[node]
        if anchor >= 0:
            offset = (carried[anchor] @ turns[anchor]).T @ (places[node] - places[anchor])
            moved[node] = moved[anchor] + turned[anchor] @ offset
    posed = _posed(rig, turned, moved)
    lengths = scale * np.cbrt(np.abs(np.linalg.det(worlds[:, :3, :3])))
    loose = {node: int(skin.anchors[node]) for node in skin.order if skin.anchors[node] not in (-1, parents[node])}
    clips = tuple(retargeted(clip, rig, posed, lengths, loose) for clip in rig.clips)
    return CarriedRig(replace(bind, clips=()), replace(posed, clips=clips))


def _below_a_root(rig: Rig, name: str) -> Rig:
    """The skeleton with one more node at its beginning, from which all hangs that hung from nothing."""
    tracks = [tuple(replace(track, node=track.node + 1) for track in clip.tracks) for clip in rig.clips]
    return Rig(
        (name, *rig.names),
        np.concatenate([[-1], rig.parents + 1]),
        rig.joints + 1,
        np.concatenate([[[0.0, 0, 0, 1]], rig.rotations]),
        np.concatenate([np.zeros((1, 3)), rig.translations]),
        np.concatenate([np.ones((1, 3)), rig.scales]),
        tuple(replace(clip, tracks=own) for clip, own in zip(rig.clips, tracks, strict=True)),
        (None, *rig.extras),
    )


def _turns(rig: Rig) -> Float[Floats, "N 3 3"]:
    """How each node is turned in the scene, whatever its scale."""
    return replace(rig, scales=np.ones_like(rig.scales)).worlds()[:, :3, :3]


def _posed(rig: Rig, turns: Float[Floats, "N 3 3"], places: Float[Floats, "N 3"]) -> Rig:
    """The skeleton without scales, its nodes turned and placed so in the scene."""
    above = np.where(rig.parents >= 0, rig.parents, len(rig.parents))
    frames = np.concatenate([turns, np.eye(3)[None]])[above]
    origins = np.concatenate([places, np.zeros((1, 3))])[above]
    return replace(
        rig,
        rotations=Rotation.from_matrix(frames.swapaxes(1, 2) @ turns).as_quat(),
        translations=np.einsum("nji,nj->ni", frames, places - origins),
        scales=np.ones_like(rig.scales),
    )


class _Skin:
    """Which nodes move vertices, and how they hang together on the skin.

    Attributes
    ----------
    moves : (N,) nodes that move vertices
    body : (N,) these, and all below them
    first : of the topmost of them, the one from which most of the skin hangs
    anchors : (N,) what each of the body hangs from on the skin: its parent, or of a topmost one a neighbour; else -1
    order : the body's nodes, what they hang from first
    """

    def __init__(self, rig: Rig, weights: csr_array) -> None:
        self._columns, self._column = csc_array(weights), {int(node): k for k, node in enumerate(rig.joints)}
        N, parents = len(rig.parents), rig.parents.tolist()
        amount = np.zeros(N)
        amount[rig.joints] = np.asarray(weights.sum(axis=0)).ravel()
        self.moves: Bool[Bools, " N"] = amount >= min(_LEAST, float(amount.max()))
        self.body: Bool[Bools, " N"] = self.moves.copy()
        top = np.arange(N)
        for node, parent in enumerate(parents):
            if parent >= 0 and self.body[parent]:
                self.body[node], top[node] = True, top[parent]
        self.anchors: Int[Ints, " N"] = np.where(top == np.arange(N), -1, rig.parents)
        tops = np.unique(top[self.body])
        self.first = int(tops[np.bincount(top, amount, N)[tops].argmax()])
        self.order = np.flatnonzero(self.body & (top == self.first)).tolist()
        # Other groups are joined to what shares most of the skin with them.
        number = np.zeros(N, np.int64)
        number[tops] = np.arange(len(tops))
        common = csr_array(weights.T @ weights)
        group = number[top[rig.joints]]
        groups = csr_array((np.ones(len(group)), (group, np.arange(len(group)))), (len(tops), len(group)))
        shared = np.zeros((len(tops), N))
        shared[:, rig.joints] = (groups @ common).toarray()
        shared[:, ~self.moves] = 0.0
        best, neighbour = np.zeros(len(tops)), np.full(len(tops), -1)
        waiting = set(range(len(tops))) - {int(number[self.first])}
        fresh = self.order
        while waiting:
            nearest = shared[:, fresh].argmax(axis=1)
            found = shared[np.arange(len(tops)), np.array(fresh)[nearest]]
            neighbour = np.where(found > best, np.array(fresh)[nearest], neighbour)
            best = np.maximum(best, found)
            chosen = max(waiting, key=lambda k: (best[k], -k))
            waiting.remove(chosen)
            self.anchors[tops[chosen]] = neighbour[chosen]
            fresh = np.flatnonzero(self.body & (top == tops[chosen])).tolist()
            self.order = self.order + fresh

    def of(self, node: int) -> Float[Floats, " V"]:
        """The weights of a node."""
        if node not in self._column:
            return np.zeros(self._columns.shape[0])
        return np.asarray(self._columns[:, [self._column[node]]].toarray()[:, 0])


def _reach(at: Floats, verts: Floats, weights: Floats, size: float) -> float:
    """How far from a place the nearest vertices with weights lie."""
    away = np.linalg.norm(verts[weights > 0] - at, axis=1)
    nearest = np.partition(away, min(_NEAREST, len(away) - 1))[: _NEAREST + 1]
    return _REACH * max(float(nearest.max()), _NEAR * size)


def _near(at: Floats, verts: Floats, weights: Floats, size: float) -> Float[Floats, " V"]:
    """Weights (V,) of vertices that fall with the distance from a place."""
    away = np.linalg.norm(verts - at, axis=1) / _reach(at, verts, weights, size)
    return np.asarray(weights * np.exp(-np.square(away)))


def _bone_ratio(rig: Rig, body: Bools, here: Floats, there: Floats) -> float:
    """How many times as long the bones are on the target, whatever their pose."""
    rows = np.flatnonzero(body & (rig.parents >= 0) & body[rig.parents])
    before, after = (np.linalg.norm(at[rows] - at[rig.parents[rows]], axis=1).sum() for at in (here, there))
    return float(after / before) if before > 0 and after > 0 else 1.0


def _heading(rotation: Float[Floats, "3 3"]) -> Float[Floats, "3 3"]:
    """The turn about y that is nearest to a rotation."""
    angle = np.arctan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2])
    return np.asarray(Rotation.from_euler("y", angle).as_matrix())
