"""Extract the surfaces of labelled voxels by surface nets (Gibson, MICCAI 1998).

Each cell between eight voxel centers that are neither all inside nor all outside has one vertex: the mean of the points
where the surface crosses the cell's edges, smoothed without leaving the cell. On balls of radius 5 to 30 voxels, vertices
are 0.1 voxels and normals 7 degrees off; marching cubes (scikit-image 0.26) on the same labels produce steps: 0.2 voxels
and 21 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.errors import InputError, warn
from meshmatch.outputs import plain_text
from meshmatch.shapes.formats import NO_FACES, Raw, check_element_count
from meshmatch.shapes.input_files import check_memory

CODE_BYTES = 3
"""Memory per voxel besides its value: a 16-bit label code and a comparison."""
_SLAB = 1 << 20  # number of voxels processed at a time
_MAX_BOX_VOXELS = 4 << 30  # total number of voxels in the bounding boxes of all labels
_BOX_BYTES = 8  # additional memory per voxel in the bounding box of a label
_STEP_SIZES = 4 * (0.7, -0.73)  # alternating smoothing steps, which avoid shrinkage (Taubin 1995)
_MAX_LABELS = 1000
# Maximum share of differing neighbours, among voxels that are not 0: labels form regions, grey values do not.
_MAX_CHANGES = 0.5
_SEGMENT_FIRST = "segment it first, such as in 3D Slicer, and save the label map"


def label_surfaces(
    name: str,
    size: int,
    layers: Sequence[NDArray[Any]],
    names: Mapping[tuple[int, int], str],
    origin: Float[Floats, " 3"],
    steps: Float[Floats, "3 3"],
) -> Raw:
    """Extract the surfaces of all labels of a file, each as a mesh named after its label.

    Parameters
    ----------
    name, size
        Name and number of bytes of the file.
    layers
        Voxels indexed (x, y, z), 0 for background.
    names
        Names of labels, by layer number and label.
    origin, steps
        Frame of the voxel centers: origin + index @ steps.

    Raises
    ------
    InputError
        The voxels are grey values, there is no label, or the surfaces would be too large for the size of the file.
    """
    from scipy import ndimage  # imported late, since other formats do not need it

    verts, faces, meshes, open_labels, n_verts, n_crossings, n_box_voxels = [], [], [], [], 0, 0, 0
    if len(layers) > _MAX_LABELS:
        raise InputError(f"{name} has {len(layers)} layers, of {_MAX_LABELS} at most", "save one label map")
    for number, layer in enumerate(layers):
        labels = _labels_of(name, layer)
        codes = np.zeros(layer.shape, np.uint16, order="F")
        for part in _slabs(layer):
            codes[part] = np.searchsorted(labels, layer[part])
        for code, box in enumerate(ndimage.find_objects(codes)):
            label = int(labels[code + 1]) if box is not None else 0
            if label == 0:
                continue
            touches_edge = any(side.start == 0 or side.stop == codes.shape[axis] for axis, side in enumerate(box))
            box = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in box)
            voxels = math.prod(side.stop - side.start for side in box)
            n_box_voxels += voxels
            if n_box_voxels > _MAX_BOX_VOXELS:
                hint = "save fewer labels, or cut the image to what you need"
                raise InputError(f"{name}: the {len(labels) - 1} labels are scattered over the whole image", hint)
            check_memory(name, size, CODE_BYTES * codes.size + _BOX_BYTES * voxels)
            inside = codes[box] == code + 1
            crossed = sum(int(np.count_nonzero(np.diff(inside, axis=axis))) for axis in range(3))
            n_crossings += crossed
            check_element_count(name, size, n_crossings, 2 * n_crossings)
            points, triangles = _surface_net(inside)
            if len(points) == 0:
                continue
            if touches_edge:
                open_labels.append(str(label))
            points = (points + [side.start for side in box]) @ steps + origin
            faces.append((triangles if np.linalg.det(steps) > 0 else triangles[:, ::-1]) + n_verts)
            verts.append(points)
            n_verts += len(points)
            label_name = names.get((number, label))
            meshes.append(((*([plain_text(label_name)] if label_name else []), str(label)), len(points)))
    if not verts:
        raise InputError(f"no label of {name} has a surface within the image", _SEGMENT_FIRST)
    if open_labels:
        what = (
            f"label {open_labels[0]} reaches"
            if len(open_labels) == 1
            else f"labels {', '.join(open_labels[:10])} reach"
        )
        warn(f"{name}: {what} the edge of the image, where the surface is left open")
    return Raw(np.concatenate(verts), np.concatenate([NO_FACES, *faces]), meshes=tuple(meshes))


def _labels_of(name: str, voxels: NDArray[Any]) -> NDArray[Any]:
    """0 and all labels that occur, sorted; `InputError` if the voxels are grey values."""
    labels: set[Any] = {0}
    pairs = changes = 0
    for slab in _slabs(voxels):
        values = voxels[slab]
        if values.dtype.kind == "f" and not (values == np.rint(values)).all():
            raise InputError(f"{name} holds fractions or grey values, not labels", _SEGMENT_FIRST)
        labels.update(np.unique(values).tolist())
        first, second = values[:-1], values[1:]
        both_labeled = (first != 0) & (second != 0)
        pairs += int(np.count_nonzero(both_labeled))
        changes += int(np.count_nonzero(both_labeled & (first != second)))
        if len(labels) > _MAX_LABELS:
            break
    if len(labels) > _MAX_LABELS or changes > _MAX_CHANGES * pairs:
        what = f"{len(labels)}{' or more' if len(labels) > _MAX_LABELS else ''} different numbers"
        raise InputError(
            f"{name} holds grey values, not labels: {what}, {min(labels):g} to {max(labels):g}", _SEGMENT_FIRST
        )
    if min(labels) < 0 or max(labels) >= 2**53:
        raise InputError(
            f"{name} holds labels from {min(labels):g} to {max(labels):g}",
            "labels are positive integers, and 0 is the background",
        )
    if len(labels) == 1:
        raise InputError(f"{name} holds no label: all its voxels are 0", _SEGMENT_FIRST)
    return np.array(sorted(labels), voxels.dtype.newbyteorder("="))


def _slabs(voxels: NDArray[Any]) -> Iterator[tuple[slice, slice, slice]]:
    """Split the voxels into slabs of whole slices along the last axis."""
    step = max(1, _SLAB // (voxels.shape[0] * voxels.shape[1]))
    for low in range(0, voxels.shape[2], step):
        yield slice(None), slice(None), slice(low, low + step)


def _surface_net(inside: Bool[Bools, "X Y Z"]) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"]]:
    """Surface between inside and outside voxels, in voxel coordinates; open where it meets the edge of the array."""
    cells = np.array(inside.shape) - 1
    n_inside = np.zeros(cells, np.uint8)
    for each in product((0, 1), repeat=3):
        n_inside += inside[tuple(slice(first, first + length) for first, length in zip(each, cells, strict=True))]
    active = np.argwhere((n_inside > 0) & (n_inside < 8))
    vertex_of_cell = np.full(cells, -1, np.int32)
    vertex_of_cell[tuple(active.T)] = np.arange(len(active))
    crossing_sum, n_crossings, quads = np.zeros((len(active), 3)), np.zeros(len(active)), []
    for axis in range(3):
        first, last = (np.moveaxis(inside, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        edges = np.argwhere(np.moveaxis(first != last, 0, axis))
        axis1, axis2 = (axis + 1) % 3, (axis + 2) % 3
        quad = np.full((len(edges), 4), -1)
        for k, (a, b) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
            cell = edges.copy()
            cell[:, axis1] -= a
            cell[:, axis2] -= b
            is_inside_grid = ((cell >= 0) & (cell < cells)).all(axis=1)
            vertex = vertex_of_cell[tuple(cell[is_inside_grid].T)]
            quad[is_inside_grid, k] = vertex
            midpoint = edges[is_inside_grid] + 0.5 * (np.arange(3) == axis)
            crossing_sum += np.stack([np.bincount(vertex, column, len(active)) for column in midpoint.T], axis=1)
            n_crossings += np.bincount(vertex, minlength=len(active))
        starts_inside = inside[tuple(edges.T)]
        quad[~starts_inside] = quad[~starts_inside, ::-1]
        quads.append(quad[(quad >= 0).all(axis=1)])
    used, inverse = np.unique(np.concatenate(quads), return_inverse=True)  # some vertices at the edge have no face
    corners_of = inverse.reshape(-1, 4)
    verts = _smooth((crossing_sum / n_crossings[:, None])[used], corners_of, active[used])
    return verts, np.concatenate([corners_of[:, [0, 1, 2]], corners_of[:, [0, 2, 3]]])


def _smooth(verts: Float[Floats, "V 3"], quads: Int[Ints, "N 4"], cells: Int[Ints, "V 3"]) -> Float[Floats, "V 3"]:
    """Smooth vertices by alternating steps towards and away from the mean of their neighbours, each within its cell."""
    from scipy.sparse import csr_array

    sides = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    pairs = np.concatenate([sides, sides[:, ::-1]])
    neighbours = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(verts), len(verts)))
    neighbours.data[:] = 1.0
    n_neighbours: Floats = np.asarray(neighbours.sum(axis=1))[:, None]
    for step_size in _STEP_SIZES:
        mean = np.asarray(neighbours @ verts) / n_neighbours
        verts = np.clip(verts + step_size * (mean - verts), cells, cells + 1.0)
    return verts
