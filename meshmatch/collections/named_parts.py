"""The parts of shapes that share their vertices, such as the bones of a joint: by name or number."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from meshmatch.arrays import Bool, Bools, Int, Ints
from meshmatch.collections.superimpose import MOST_GROUPS
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.places import Places
from meshmatch.shapes.files import mesh_list
from meshmatch.shapes.parts import Parts
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

_NEARLY_ALL = 0.9  # of the vertices of a connected part
WHOLE, EACH = "whole", "each"
"""Words for what is superimposed: the whole shape, or each of its connected parts alone."""
Masks = Mapping[str, Bool[Bools, " V"]]
"""Which vertices the parts of a name have."""


class _Owned(Mapping[str, "Bool[Bools, ' V']"]):
    """Masks of names, one at a time, for there may be thousands of both: of each vertex the number of its name is kept."""

    def __init__(self, names: Sequence[str], owner: Int[Ints, " V"]) -> None:
        self.owner, self._numbers = owner, {name: k for k, name in enumerate(names)}

    def __getitem__(self, name: str) -> Bool[Bools, " V"]:
        return np.asarray(self.owner == self._numbers[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)


def groups_of(shape: Shape, by: str, named: Callable[[], Masks]) -> Int[Ints, " V"] | None:
    """Which vertices of shapes with this mesh are superimposed together, as `superimpose` has it.

    ``by`` is "whole", "each", the number of a connected part, the largest first, or a name among those that ``named`` gives.

    `OptionError`: there is no such part, or only one or too many where each is asked for.
    """
    if by == WHOLE:
        return None
    parts = Parts.of(shape)
    if by == EACH:
        if len(parts) < 2:
            raise OptionError("these shapes have one part, and it is superimposed alone", "leave out --align-by")
        if len(parts) > MOST_GROUPS:
            what = f"these shapes have {len(parts):,} connected parts, too many to superimpose each alone"
            raise OptionError(what, f"{MOST_GROUPS} can be; merge vertices at one place, or leave out --align-by")
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


def parts_of_file(path: str | Path) -> _Owned:
    """The meshes of a file by name; none for formats without names."""
    meshes = mesh_list(path)
    numbers = {name: k for k, name in enumerate(dict.fromkeys(name for name, _ in meshes))}
    each = np.array([(numbers[name], count) for name, count in meshes], np.int64).reshape(-1, 2)
    return _Owned(list(numbers), np.repeat(*each.T))


def parts_of_template(
    template: Template, names: Sequence[str], file_of: Mapping[str, str], places_of: Callable[[str], Places]
) -> Masks:
    """The parts of a template by the names that it has itself; or else by the meshes of the first shape whose file has
    names: each connected part by the one to which nearly all vertices there belong; where there is none, each vertex by the
    nearest.
    """
    if len(template.label_names) > 1:
        return _Owned(template.label_names, template.labels)
    number = Parts.of(template.shape).number
    for name in names:
        file = file_of.get(name)
        try:
            if file is None or len((named := parts_of_file(file)).owner) == 0:
                continue
            if len(named.owner) != len((places := places_of(name)).resting):
                continue
        except InputError:  # it has been moved since
            continue
        part, count = number[places.on(template.shape).vertex], int(number.max()) + 1
        votes = np.bincount(named.owner * count + part, minlength=len(named) * count).reshape(len(named), count)
        owner = votes.argmax(axis=0)[number]
        mixed = (votes.max(axis=0) < _NEARLY_ALL * votes.sum(axis=0))[number]
        if mixed.any():
            owner[mixed] = named.owner[cKDTree(places.resting).query(template.shape.verts[mixed])[1]]
        return _Owned(list(named), owner)
    return {}
