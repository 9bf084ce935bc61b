"""Evaluation of skin weights: posing by linear blend skinning, and two other weight transfer methods as baselines.

The nearest-point baseline copies the weights of the closest point of the aligned source. Robust weight inpainting
(Abdrashitov et al. 2023) does so only where that point is near and has a similar normal, and fills in the rest smoothly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.geometry.smoothing import laplacian
from meshmatch.geometry.triangles import dot, vertex_areas, vertex_normals
from meshmatch.maps.footpoints import Surface
from meshmatch.shapes.faces import seam_representatives
from meshmatch.shapes.formats.gltf_rig import Rig
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import largest_weights

# Thresholds of the method's authors: distance as a fraction of the bounding box's diagonal, and angle in degrees.
_MAX_DISTANCE, _MAX_ANGLE = 0.05, 30.0
_PULL = 1e-6  # weight of the pull to nearest-point values, which determines parts without known vertices
_MOTION_CLIPS = ("run", "gallop", "swim")
# Sitting pose for characters without a clip: substrings of joint names, and rotations about the lateral axis in degrees.
_SITTING = (("upperleg", -90.0), ("thigh", -90.0), ("lowerleg", 90.0), ("calf", 90.0))


def pose_in_motion(rig: Rig) -> Rig:
    """Pose a skeleton in the middle of its first clip of running or swimming, or else sitting; y is up, x lateral."""
    found = [clip for clip in rig.clips if any(word in clip.name.lower() for word in _MOTION_CLIPS)]
    rotations, translations, scales = rig.rotations.copy(), rig.translations.copy(), rig.scales.copy()
    if found:
        held = {"rotation": rotations, "translation": translations, "scale": scales}
        end = max(track.times[-1] for track in found[0].tracks)
        for track in found[0].tracks:
            values = track.values[1::3] if track.interpolation == "CUBICSPLINE" else track.values
            held[track.moves][track.node] = values[np.abs(track.times - end / 2).argmin()]
    else:
        stand = Rotation.from_matrix(_turns(rig))
        for node, name in enumerate(rig.names):
            plain = name.lower().replace(" ", "").replace("_", "")
            for word, angle in _SITTING:
                if word in plain and rig.parents[node] >= 0:
                    above, turn = stand[int(rig.parents[node])], Rotation.from_euler("x", angle, degrees=True)
                    rotations[node] = (above.inv() * turn * stand[node]).as_quat()
    return replace(rig, rotations=rotations, translations=translations, scales=scales)


def _turns(rig: Rig) -> Float[Floats, "N 3 3"]:
    matrices = rig.worlds()[:, :3, :3]
    return np.asarray(matrices / np.linalg.norm(matrices, axis=1, keepdims=True))


def skin_vertices(verts: Float[Floats, "V 3"], weights: csr_array, bind: Rig, posed: Rig) -> Float[Floats, "V 3"]:
    """Move vertices from the pose of `bind` to that of `posed` by linear blend skinning."""
    moves = (posed.worlds() @ np.linalg.inv(bind.worlds()))[bind.joints]
    blended = (weights @ moves.reshape(len(moves), 16)).reshape(-1, 4, 4)
    return np.asarray(np.einsum("vij,vj->vi", blended[:, :3, :3], verts) + blended[:, :3, 3])


def volume(verts: Float[Floats, "V 3"], shape: Shape) -> float:
    """Compute the volume enclosed by the faces; holes are closed by cones to the mean of the vertices."""
    corners = (verts - verts.mean(axis=0))[shape.faces]
    return float(dot(corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)


def distances_from_bones(verts: Float[Floats, "V 3"], main: Int[Ints, " V"], rig: Rig) -> Float[Floats, " V"]:
    """Compute distances (V,) of vertices from the bones of their joints, which run to each joint's children."""
    places, nodes = rig.worlds()[:, :3, 3], rig.joints[main]
    away = np.linalg.norm(verts - places[nodes], axis=1)
    for child, parent in enumerate(rig.parents.tolist()):
        rows = np.flatnonzero(nodes == parent)
        along, own = places[child] - places[parent], verts[rows] - places[parent]
        share = np.clip(own @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
        away[rows] = np.minimum(away[rows], np.linalg.norm(own - share[:, None] * along, axis=1))
    return np.asarray(away)


def nearest_and_inpainted(
    source: Shape, aligned: Float[Floats, "V_src 3"], weights: csr_array, target: Shape, influences: int = 4
) -> tuple[csr_array, csr_array]:
    """Transfer weights (V_target, J) by nearest point and by robust weight inpainting.

    Parameters
    ----------
    source
        The shape with weights.
    aligned
        Its vertices, aligned with the target.
    weights
        Weights of the source, (V_source, J).
    target
        The shape without weights.
    influences
        Maximum number of joints for each vertex.
    """
    foot = Surface(aligned, source.faces).query(target.verts)
    corners = source.faces[foot.face]
    rows = np.repeat(np.arange(target.V), 3)
    pick = coo_array((foot.barycentric.ravel(), (rows, corners.ravel())), (target.V, source.V)).tocsr()
    nearest = csr_array(pick @ weights)
    twin = seam_representatives(target.verts, target.faces)
    normals = vertex_normals(target.verts, twin[target.faces])[twin]
    there = np.einsum("nk,nkd->nd", foot.barycentric, vertex_normals(aligned, source.faces)[corners])
    size = np.linalg.norm(normals, axis=1) * np.linalg.norm(there, axis=1)
    alike = dot(normals, there) > np.cos(np.radians(_MAX_ANGLE)) * np.maximum(size, 1e-300)
    known = alike & (foot.distance < _MAX_DISTANCE * np.linalg.norm(np.ptp(target.bounds, axis=0)))
    return largest_weights(nearest, influences), largest_weights(
        _inpaint_weights(target, twin, known, nearest), influences
    )


def _inpaint_weights(target: Shape, twin: Ints, known: Bools, values: csr_array) -> csr_array:
    """Keep known weights and solve for the others by minimising the bi-Laplacian energy."""
    first, place = np.unique(twin, return_inverse=True)
    faces = place[target.faces]
    held, dense = known[first], values[first].toarray()
    corners = target.verts[first][faces]
    edges, weight = [], []
    for k in range(3):
        one, two = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        weight.append(0.5 * dot(one, two) / np.maximum(np.linalg.norm(np.cross(one, two), axis=1), 1e-12))
        edges.append(faces[:, [(k + 1) % 3, (k + 2) % 3]])
    matrix = laplacian(np.concatenate(edges), np.clip(np.concatenate(weight), 1e-3, 1e3), len(first))
    area = np.maximum(vertex_areas(target.verts[first], faces), 1e-9 * target.area)
    energy = csr_array(matrix @ diags_array(target.area / area) @ matrix + diags_array(np.full(len(first), _PULL)))
    free = np.flatnonzero(~held)
    if len(free):
        right = _PULL * dense[free] - energy[free][:, np.flatnonzero(held)] @ dense[held]
        dense[free] = splu(energy[free][:, free].tocsc()).solve(right)
    return csr_array(np.maximum(dense, 0.0)[place])
