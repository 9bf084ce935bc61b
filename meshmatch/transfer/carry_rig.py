"""Transfer of a skeleton, with its clips, from one shape to another along a map.

Every joint follows the skin around it: its position by the similarity that takes the source's skin near the joint to its
places on the target, its rotation by that of the skin that it moves. Nodes above all joints that move vertices stay upright
and on the ground, at the target's scale.

Where the parent of a joint moves no vertex, as of feet that hang from the root, the joint follows its neighbour on the skin
into the source's pose, and in clips.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, ShortRepr
from meshmatch.geometry.frames import RigidPose, kabsch
from meshmatch.shapes.formats.gltf_rig import Rig
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.retarget_clips import retargeted

UP = 1
"""The axis that points up: y, as in glTF."""
# All set by hand. A joint moves vertices if its weights sum to this.
_MIN_WEIGHT = 3.0
# The skin near a joint reaches to this many vertices, at least this share of the shape's size; times the last factor.
_N_NEAREST, _MIN_RADIUS, _RADIUS_FACTOR = 20, 0.03, 1.5
# The parent's own skin counts too, if it comes as near to the joint as the joint's, up to this factor.
_MAX_DISTANCE_RATIO = 2.0


@dataclass(frozen=True, eq=False, repr=False)
class CarriedRig(ShortRepr):
    """A skeleton on a target, in two poses, without scales. The first node is new, and all others hang from it."""

    bind: Rig  # in the target's pose
    source_pose: Rig  # in the source's pose; with the clips


@dataclass(frozen=True, eq=False)
class _Similarity:
    scale: float
    pose: RigidPose

    def __call__(self, points: Floats) -> Floats:
        return np.asarray(self.scale * points @ self.pose.rotation.T + self.pose.center)


def _similarity(
    source_points: Float[Floats, "V 3"], target_points: Float[Floats, "V 3"], weights: Float[Floats, " V"]
) -> _Similarity:
    """The best similarity by least squares (Umeyama 1991)."""
    share = weights / max(weights.sum(), 1e-300)
    rotation = kabsch(source_points, target_points, weights).rotation
    a, b = share @ source_points, share @ target_points
    spread = share @ ((source_points - a) ** 2).sum(axis=1)
    covariance = share @ (((source_points - a) @ rotation.T) * (target_points - b)).sum(axis=1)
    scale = float(covariance / spread) if spread > 0 and covariance > 0 else 1.0
    return _Similarity(scale, RigidPose(rotation, b - scale * rotation @ a))


def rotation_to_upright(
    source: Shape, points: Float[Floats, "V 3"], trust: Float[Floats, " V"]
) -> Float[Floats, "3 3"]:
    """Rotation by right angles, about one axis, after which the places of the source's vertices stand along y as it does."""
    return rotation_to_y(kabsch(source.verts, points, trust).rotation[:, UP])


def rotation_to_y(up: Float[Floats, " 3"]) -> Float[Floats, "3 3"]:
    """Rotation by right angles, about one axis, that takes the axis nearest to a direction to y."""
    axis = int(np.abs(up).argmax())
    if axis == UP:
        return np.eye(3) if up[UP] > 0 else np.diag([1.0, -1.0, -1.0])
    turn, sign = np.zeros((3, 3)), np.sign(up[axis])
    turn[UP, axis], turn[axis, UP], turn[3 - axis - UP, 3 - axis - UP] = sign, -sign, 1.0
    return turn


def transfer_skeleton(
    rig: Rig,
    weights: csr_array,
    source: Shape,
    points: Float[Floats, "V_source 3"],
    trust: Float[Floats, " V_source"],
    ground: float,
) -> CarriedRig:
    """Transfer the skeleton to the target, below a new node with the name of the source.

    Parameters
    ----------
    rig
        The source's skeleton.
    weights
        (V_source, J) skin weights of its joints.
    source
        The shape that it moves.
    points
        Positions of the source's vertices on the target, whose up axis is y.
    trust
        Weight of each position.
    ground
        The lowest y of the target.
    """
    rig = _add_root(rig, source.name.rpartition(".")[0] or source.name or "rig")
    skin = _Skin(rig, weights)
    worlds, rotations, parents = rig.worlds(), _world_rotations(rig), rig.parents.tolist()
    places, target_rotations = np.zeros((len(parents), 3)), np.zeros((len(parents), 3, 3))
    size = float(np.ptp(source.bounds, axis=0).max())
    similarities: dict[int, _Similarity] = {}
    for node in np.flatnonzero(skin.body).tolist():
        at, parent = worlds[node, :3, 3], parents[node]
        if skin.moves[node]:
            own_weights, parent_weights = skin.of(node), skin.of(parent)
            target_rotations[node] = kabsch(source.verts, points, own_weights**2 * trust).rotation
            parts = [own_weights + parent_weights]
            if parent_weights.any() and _near_radius(
                at, source.verts, parent_weights, size
            ) <= _MAX_DISTANCE_RATIO * _near_radius(at, source.verts, own_weights, size):
                parts += [own_weights, parent_weights]  # each moves rigidly, and the joint with both
            local_weights = [_near_weights(at, source.verts, part, size) * trust for part in parts]
            candidates = [_similarity(source.verts, points, each) for each in local_weights]
            similarities[node] = candidates[0]
            places[node] = np.mean([each(at) for each in candidates], axis=0)
        else:
            target_rotations[node], similarities[node] = target_rotations[parent], similarities[parent]
            places[node] = similarities[node](at)
    upper = ~skin.body
    scale = _bone_ratio(rig, skin.body, worlds[:, :3, 3], places)
    heading = _heading(_similarity(source.verts, points, trust).pose.rotation)
    source_origin, target_origin = worlds[skin.first, :3, 3].copy(), places[skin.first].copy()
    source_origin[UP], target_origin[UP] = source.bounds[0, UP], ground
    upright_places = scale * (worlds[:, :3, 3] - source_origin) @ heading.T + target_origin
    places[upper], target_rotations[upper] = upright_places[upper], heading
    bind = _with_world_poses(rig, target_rotations @ rotations, places)

    # The same skeleton in the source's pose.
    posed_rotations = heading @ rotations
    posed_places = upright_places.copy()
    for node in skin.order:
        anchor = skin.anchors[node]
        if anchor >= 0:
            offset = (target_rotations[anchor] @ rotations[anchor]).T @ (places[node] - places[anchor])
            posed_places[node] = posed_places[anchor] + posed_rotations[anchor] @ offset
    posed = _with_world_poses(rig, posed_rotations, posed_places)
    lengths = scale * np.cbrt(np.abs(np.linalg.det(worlds[:, :3, :3])))
    loose = {node: int(skin.anchors[node]) for node in skin.order if skin.anchors[node] not in (-1, parents[node])}
    clips = tuple(retargeted(clip, rig, posed, lengths, loose) for clip in rig.clips)
    return CarriedRig(replace(bind, clips=()), replace(posed, clips=clips))


def _add_root(rig: Rig, name: str) -> Rig:
    """The skeleton with a new first node, the parent of all nodes without one."""
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


def _world_rotations(rig: Rig) -> Float[Floats, "N 3 3"]:
    """World rotation of each node, regardless of scales."""
    return replace(rig, scales=np.ones_like(rig.scales)).worlds()[:, :3, :3]


def _with_world_poses(rig: Rig, rotations: Float[Floats, "N 3 3"], places: Float[Floats, "N 3"]) -> Rig:
    """The skeleton without scales, with these world rotations and positions of its nodes."""
    above = np.where(rig.parents >= 0, rig.parents, len(rig.parents))
    frames = np.concatenate([rotations, np.eye(3)[None]])[above]
    origins = np.concatenate([places, np.zeros((1, 3))])[above]
    return replace(
        rig,
        rotations=Rotation.from_matrix(frames.swapaxes(1, 2) @ rotations).as_quat(),
        translations=np.einsum("nji,nj->ni", frames, places - origins),
        scales=np.ones_like(rig.scales),
    )


class _Skin:
    """Find the nodes that move vertices, and how they are connected over the skin.

    Attributes
    ----------
    moves : (N,) nodes that move vertices
    body : (N,) these and their descendants
    first : topmost node of the body with the most skin below it
    anchors : (N,) what each node of the body follows on the skin: its parent, or of a topmost one a neighbour; else -1
    order : nodes of the body, anchors first
    """

    def __init__(self, rig: Rig, weights: csr_array) -> None:
        self._columns, self._column = csc_array(weights), {int(node): k for k, node in enumerate(rig.joints)}
        N, parents = len(rig.parents), rig.parents.tolist()
        amount = np.zeros(N)
        amount[rig.joints] = np.asarray(weights.sum(axis=0)).ravel()
        self.moves: Bool[Bools, " N"] = amount >= min(_MIN_WEIGHT, float(amount.max()))
        self.body: Bool[Bools, " N"] = self.moves.copy()
        top = np.arange(N)
        for node, parent in enumerate(parents):
            if parent >= 0 and self.body[parent]:
                self.body[node], top[node] = True, top[parent]
        self.anchors: Int[Ints, " N"] = np.where(top == np.arange(N), -1, rig.parents)
        tops = np.unique(top[self.body])
        self.first = int(tops[np.bincount(top, amount, N)[tops].argmax()])
        self.order = np.flatnonzero(self.body & (top == self.first)).tolist()
        # Other groups follow the node that they share the most skin with.
        number = np.zeros(N, np.int64)
        number[tops] = np.arange(len(tops))
        common = csr_array(weights.T @ weights)
        group = number[top[rig.joints]]
        groups = csr_array((np.ones(len(group)), (group, np.arange(len(group)))), (len(tops), len(group)))
        shared = np.zeros((len(tops), N))
        shared[:, rig.joints] = (groups @ common).toarray()
        shared[:, ~self.moves] = 0.0
        best, neighbour = np.zeros(len(tops)), np.full(len(tops), -1)
        pending = set(range(len(tops))) - {int(number[self.first])}
        added = self.order
        while pending:
            nearest = shared[:, added].argmax(axis=1)
            found = shared[np.arange(len(tops)), np.array(added)[nearest]]
            neighbour = np.where(found > best, np.array(added)[nearest], neighbour)
            best = np.maximum(best, found)
            chosen = max(pending, key=lambda k: (best[k], -k))
            pending.remove(chosen)
            self.anchors[tops[chosen]] = neighbour[chosen]
            added = np.flatnonzero(self.body & (top == tops[chosen])).tolist()
            self.order = self.order + added

    def of(self, node: int) -> Float[Floats, " V"]:
        """(V,) the weights of a node."""
        if node not in self._column:
            return np.zeros(self._columns.shape[0])
        return np.asarray(self._columns[:, [self._column[node]]].toarray()[:, 0])


def _near_radius(at: Floats, verts: Floats, weights: Floats, size: float) -> float:
    """Radius around a place that contains the nearest vertices with weights, with a margin."""
    away = np.linalg.norm(verts[weights > 0] - at, axis=1)
    nearest = np.partition(away, min(_N_NEAREST, len(away) - 1))[: _N_NEAREST + 1]
    return _RADIUS_FACTOR * max(float(nearest.max()), _MIN_RADIUS * size)


def _near_weights(at: Floats, verts: Floats, weights: Floats, size: float) -> Float[Floats, " V"]:
    """Weights (V,) of vertices, with a Gaussian falloff around a place."""
    away = np.linalg.norm(verts - at, axis=1) / _near_radius(at, verts, weights, size)
    return np.asarray(weights * np.exp(-np.square(away)))


def _bone_ratio(rig: Rig, body: Bools, source_places: Floats, target_places: Floats) -> float:
    """Total length of the bones on the target relative to the source, which does not depend on poses."""
    rows = np.flatnonzero(body & (rig.parents >= 0) & body[rig.parents])
    source_length, target_length = (
        np.linalg.norm(at[rows] - at[rig.parents[rows]], axis=1).sum() for at in (source_places, target_places)
    )
    return float(target_length / source_length) if source_length > 0 and target_length > 0 else 1.0


def _heading(rotation: Float[Floats, "3 3"]) -> Float[Floats, "3 3"]:
    """The rotation about y nearest to a rotation."""
    angle = np.arctan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2])
    return np.asarray(Rotation.from_euler("y", angle).as_matrix())
