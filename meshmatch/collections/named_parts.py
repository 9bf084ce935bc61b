"""Find parts of registered shapes, such as the bones of a joint, by name or number."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from meshmatch.arrays import Bool, Bools, Int, Ints
from meshmatch.collections.superimpose import MAX_GROUPS
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.places import Places
from meshmatch.shapes.files import list_meshes
from meshmatch.shapes.parts import Parts
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

_MIN_MAJORITY = 0.9  # share of a connected part's votes above which the whole part gets the name
WHOLE, EACH = "whole", "each"
"""Values of ``align_by``: superimpose whole shapes, or each connected part on its own."""
Masks = Mapping[str, Bool[Bools, " V"]]
"""Vertex masks of parts, by name."""


class _LabelMasks(Mapping[str, "Bool[Bools, ' V']"]):
    """Masks computed on access from the label of each vertex, as there may be thousands of names and vertices."""

    def __init__(self, names: Sequence[str], labels: Int[Ints, " V"]) -> None:
        self.labels, self._numbers = labels, {name: k for k, name in enumerate(names)}

    def __getitem__(self, name: str) -> Bool[Bools, " V"]:
        return np.asarray(self.labels == self._numbers[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)


def groups_of(shape: Shape, by: str, named: Callable[[], Masks]) -> Int[Ints, " V"] | None:
    """Groups of vertices for `superimpose`; None for whole shapes.

    ``by`` is "whole", "each", the number of a connected part (1 is the largest), or a name in the masks that ``named``
    returns.

    `OptionError`: there is no such part; or, with "each", only one part or too many.
    """
    if by == WHOLE:
        return None
    parts = Parts.of(shape)
    if by == EACH:
        if len(parts) < 2:
            raise OptionError("these shapes have one part, and it is superimposed alone", "leave out --align-by")
        if len(parts) > MAX_GROUPS:
            what = f"these shapes have {len(parts):,} connected parts, too many to superimpose each alone"
            raise OptionError(what, f"{MAX_GROUPS} can be; merge vertices at one place, or leave out --align-by")
        return parts.number - 1
    if by.isascii() and by.isdecimal():
        if not 1 <= int(by[:9]) <= len(parts):
            count = "one connected part" if len(parts) == 1 else f"connected parts 1 to {len(parts)}"
            raise OptionError(f"these shapes have no part {by[:20]}", f"they have {count}, the largest first")
        return np.where(parts.number == int(by), 0, -1)
    masks = named()
    if by not in masks or not masks[by].any():
        there = [name for name, mask in masks.items() if mask.any()]
        close = get_close_matches(by, there, n=1)
        known = f"did you mean {close[0]}? " if close else ""
        names = f"names: {', '.join(there[:12])}; " if there else "they have no names; "
        numbers = f"numbers: 1 to {len(parts)}, the largest first; or {EACH}" if len(parts) > 1 else "and one part"
        hint = f"{known}{names}{numbers}"
        raise OptionError(f"these shapes have no part called {by!r}", hint)
    return np.where(masks[by], 0, -1)


def parts_of_file(path: str | Path) -> _LabelMasks:
    """Masks of the meshes of a file, by name; empty for formats without names."""
    meshes = list_meshes(path)
    numbers = {name: k for k, name in enumerate(dict.fromkeys(name for name, _ in meshes))}
    each = np.array([(numbers[name], count) for name, count in meshes], np.int64).reshape(-1, 2)
    return _LabelMasks(list(numbers), np.repeat(*each.T))


def parts_of_template(
    template: Template, names: Sequence[str], file_of: Mapping[str, str], places_of: Callable[[str], Places]
) -> Masks:
    """Masks of a template's parts by name: its own labels, or else the meshes of the first shape whose file names them.

    In the latter case, a connected part of the template gets the name of the mesh to which at least 90 % of the vertices
    placed on it belong. If no mesh has so many, each vertex of the part gets the name at the nearest placed vertex. Empty
    if there are no names.
    """
    if len(template.label_names) > 1:
        return _LabelMasks(template.label_names, template.labels)
    number = Parts.of(template.shape).number
    for name in names:
        file = file_of.get(name)
        try:
            if file is None or len((named := parts_of_file(file)).labels) == 0:
                continue
            if len(named.labels) != len((places := places_of(name)).resting):
                continue
        except InputError:  # the file has moved since it was fitted
            continue
        part, count = number[places.on(template.shape).vertex], int(number.max()) + 1
        votes = np.bincount(named.labels * count + part, minlength=len(named) * count).reshape(len(named), count)
        labels = votes.argmax(axis=0)[number]
        mixed = (votes.max(axis=0) < _MIN_MAJORITY * votes.sum(axis=0))[number]
        if mixed.any():
            labels[mixed] = named.labels[cKDTree(places.resting).query(template.shape.verts[mixed])[1]]
        return _LabelMasks(list(named), labels)
    return {}
