"""Surfaces of labels in voxels: surface nets (Gibson, MICCAI 1998).

Each cell between eight voxel centers that are not all inside has one vertex: the mean of where the surface crosses its
edges, smoothed without leaving the cell. On balls of radius 5 to 30 voxels it is 0.1 of a voxel from the truth, and normals
are 7 degrees off; marching cubes (scikit-image 0.26) on the same labels leave steps: 0.2 of a voxel, and 21 degrees.
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
"""Bytes of memory that a voxel takes beside its own: a small number for its label, and a comparison."""
_SLAB = 1 << 20  # voxels at a time
_MOST_WORK = 4 << 30  # voxels in the boxes of all labels
_BOX_BYTES = 8  # and those within the box around a label
_SHARES = 4 * (0.7, -0.73)  # of the way to the mean of the neighbours, and back: nothing shrinks (Taubin 1995)
_MOST_LABELS = 1000
_MOST_CHANGES = (
    0.5  # share of neighbours that differ, among voxels that are not 0: labels have regions, grey values do not
)
_SEGMENT_FIRST = "segment it first, such as in 3D Slicer, and save the label map"


def label_surfaces(
    name: str,
    size: int,
    layers: Sequence[NDArray[Any]],
    names: Mapping[tuple[int, int], str],
    origin: Float[Floats, " 3"],
    steps: Float[Floats, "3 3"],
) -> Raw:
    """The surfaces of all labels of a file of so many bytes, each a mesh that has the label as its name.

    Parameters
    ----------
    name, size
        Of the file.
    layers
        Voxels (x, y, z) with 0 where there is nothing.
    names
        Of labels, by the number of their layer and their own.
    origin, steps
        Where voxel centers lie: origin + index @ steps.

    Raises
    ------
    InputError
        The voxels are grey values, no label is there, or the surfaces would be too large for the file.
    """
    from scipy import ndimage  # not needed to read other files, which load it late

    verts, faces, meshes, cut, count, many, work = [], [], [], [], 0, 0, 0
    if len(layers) > _MOST_LABELS:
        raise InputError(f"{name} has {len(layers)} layers, of {_MOST_LABELS} at most", "save one label map")
    for number, layer in enumerate(layers):
        labels = _labels_of(name, layer)
        codes = np.zeros(layer.shape, np.uint16, order="F")
        for part in _slabs(layer):
            codes[part] = np.searchsorted(labels, layer[part])
        for code, box in enumerate(ndimage.find_objects(codes)):
            label = int(labels[code + 1]) if box is not None else 0
            if label == 0:
                continue
            at_edge = any(side.start == 0 or side.stop == codes.shape[axis] for axis, side in enumerate(box))
            box = tuple(slice(max(side.start - 1, 0), side.stop + 1) for side in box)
            voxels = math.prod(side.stop - side.start for side in box)
            work += voxels
            if work > _MOST_WORK:
                hint = "save fewer labels, or cut the image to what you need"
                raise InputError(f"{name}: the {len(labels) - 1} labels are scattered over the whole image", hint)
            check_memory(name, size, CODE_BYTES * codes.size + _BOX_BYTES * voxels)
            inside = codes[box] == code + 1
            crossed = sum(int(np.count_nonzero(np.diff(inside, axis=axis))) for axis in range(3))
            many += crossed
            check_element_count(name, size, many, 2 * many)
            points, own = _net(inside)
            if len(points) == 0:
                continue
            if at_edge:
                cut.append(str(label))
            points = (points + [side.start for side in box]) @ steps + origin
            faces.append((own if np.linalg.det(steps) > 0 else own[:, ::-1]) + count)
            verts.append(points)
            count += len(points)
            given = names.get((number, label))
            meshes.append(((*([plain_text(given)] if given else []), str(label)), len(points)))
    if not verts:
        raise InputError(f"no label of {name} has a surface within the image", _SEGMENT_FIRST)
    if cut:
        of = f"label {cut[0]} reaches" if len(cut) == 1 else f"labels {', '.join(cut[:10])} reach"
        warn(f"{name}: {of} the edge of the image, where the surface is left open")
    return Raw(np.concatenate(verts), np.concatenate([NO_FACES, *faces]), meshes=tuple(meshes))


def _labels_of(name: str, voxels: NDArray[Any]) -> NDArray[Any]:
    """0 and all numbers that are there, sorted; `InputError` if they are grey values."""
    found: set[Any] = {0}
    pairs = changes = 0
    for slab in _slabs(voxels):
        part = voxels[slab]
        if part.dtype.kind == "f" and not (part == np.rint(part)).all():
            raise InputError(f"{name} holds fractions or grey values, not labels", _SEGMENT_FIRST)
        found.update(np.unique(part).tolist())
        one, other = part[:-1], part[1:]
        both = (one != 0) & (other != 0)
        pairs += int(np.count_nonzero(both))
        changes += int(np.count_nonzero(both & (one != other)))
        if len(found) > _MOST_LABELS:
            break
    if len(found) > _MOST_LABELS or changes > _MOST_CHANGES * pairs:
        many = f"{len(found)}{' or more' if len(found) > _MOST_LABELS else ''} different numbers"
        raise InputError(
            f"{name} holds grey values, not labels: {many}, {min(found):g} to {max(found):g}", _SEGMENT_FIRST
        )
    if min(found) < 0 or max(found) >= 2**53:
        raise InputError(
            f"{name} holds labels from {min(found):g} to {max(found):g}",
            "labels are whole numbers, and 0 is where nothing is",
        )
    if len(found) == 1:
        raise InputError(f"{name} holds no label: all its voxels are 0", _SEGMENT_FIRST)
    return np.array(sorted(found), voxels.dtype.newbyteorder("="))


def _slabs(voxels: NDArray[Any]) -> Iterator[tuple[slice, slice, slice]]:
    """Some slices at a time."""
    step = max(1, _SLAB // (voxels.shape[0] * voxels.shape[1]))
    for low in range(0, voxels.shape[2], step):
        yield slice(None), slice(None), slice(low, low + step)


def _net(inside: Bool[Bools, "X Y Z"]) -> tuple[Float[Floats, "V 3"], Int[Ints, "F 3"]]:
    """The surface between what is inside and what is not, in indices of voxels; open where both meet the edge."""
    cells = np.array(inside.shape) - 1
    corners = np.zeros(cells, np.uint8)
    for each in product((0, 1), repeat=3):
        corners += inside[tuple(slice(first, first + length) for first, length in zip(each, cells, strict=True))]
    at = np.argwhere((corners > 0) & (corners < 8))
    number = np.full(cells, -1, np.int32)
    number[tuple(at.T)] = np.arange(len(at))
    total, crossings, quads = np.zeros((len(at), 3)), np.zeros(len(at)), []
    for axis in range(3):
        first, last = (np.moveaxis(inside, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        edges = np.argwhere(np.moveaxis(first != last, 0, axis))
        across, up = (axis + 1) % 3, (axis + 2) % 3
        around = np.full((len(edges), 4), -1)
        for k, (a, b) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
            cell = edges.copy()
            cell[:, across] -= a
            cell[:, up] -= b
            there = ((cell >= 0) & (cell < cells)).all(axis=1)
            own = number[tuple(cell[there].T)]
            around[there, k] = own
            middle = edges[there] + 0.5 * (np.arange(3) == axis)
            total += np.stack([np.bincount(own, column, len(at)) for column in middle.T], axis=1)
            crossings += np.bincount(own, minlength=len(at))
        outwards = inside[tuple(edges.T)]
        around[~outwards] = around[~outwards, ::-1]
        quads.append(around[(around >= 0).all(axis=1)])
    used, inverse = np.unique(np.concatenate(quads), return_inverse=True)  # at the edge of the image some have no face
    corners_of = inverse.reshape(-1, 4)
    verts = _relaxed((total / crossings[:, None])[used], corners_of, at[used])
    return verts, np.concatenate([corners_of[:, [0, 1, 2]], corners_of[:, [0, 2, 3]]])


def _relaxed(verts: Float[Floats, "V 3"], quads: Int[Ints, "N 4"], cells: Int[Ints, "V 3"]) -> Float[Floats, "V 3"]:
    """Each vertex towards the mean of its neighbours and away again, within its cell."""
    from scipy.sparse import csr_array

    sides = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    pairs = np.concatenate([sides, sides[:, ::-1]])
    beside = csr_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(verts), len(verts)))
    beside.data[:] = 1.0
    many: Floats = np.asarray(beside.sum(axis=1))[:, None]
    for share in _SHARES:
        mean = np.asarray(beside @ verts) / many
        verts = np.clip(verts + share * (mean - verts), cells, cells + 1.0)
    return verts
