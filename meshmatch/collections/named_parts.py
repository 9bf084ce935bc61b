"""The parts of shapes that share their vertices, such as the bones of a joint: by name or number."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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
    masks = {name: mask for name, mask in named().items() if mask.any()}
    if by not in masks:
        close = get_close_matches(by, masks, n=1)
        known = f"did you mean {close[0]}? " if close else ""
        names = f"names: {', '.join(list(masks)[:12])}; " if masks else "they have no names; "
        numbers = f"numbers: 1 to {len(parts)}, the largest first; or {EACH}" if len(parts) > 1 else "and one part"
        hint = f"{known}{names}{numbers}"
        raise OptionError(f"these shapes have no part called {by!r}", hint)
    return np.where(masks[by], 0, -1)


def parts_of_file(path: str | Path) -> Masks:
    """The meshes of a file by name; none for formats without names."""
    meshes = mesh_list(path)
    owner = np.repeat([name for name, _ in meshes], [count for _, count in meshes]) if meshes else np.empty(0, "U1")
    return {name: owner == name for name in dict.fromkeys(name for name, _ in meshes)}


def parts_of_template(
    template: Template, names: Sequence[str], file_of: Mapping[str, str], places_of: Callable[[str], Places]
) -> Masks:
    """The parts of a template by the names that it has itself; or else by the meshes of the first shape whose file has
    names: each connected part by the one to which nearly all vertices there belong; where there is none, each vertex by the
    nearest.
    """
    if len(template.label_names) > 1:
        return {name: template.labels == k for k, name in enumerate(template.label_names)}
    number = Parts.of(template.shape).number
    for name in names:
        file = file_of.get(name)
        try:
            masks = {} if file is None else parts_of_file(file)
            if not masks or len(next(iter(masks.values()))) != len((places := places_of(name)).resting):
                continue
        except InputError:  # it has been moved since
            continue
        part, owners = number[places.on(template.shape).vertex], np.stack(list(masks.values()))
        votes = np.stack([np.bincount(part[mask], minlength=number.max() + 1) for mask in owners])
        owner = votes.argmax(axis=0)[number]
        mixed = (votes.max(axis=0) < _NEARLY_ALL * votes.sum(axis=0))[number]
        if mixed.any():
            owner[mixed] = owners.argmax(axis=0)[cKDTree(places.resting).query(template.shape.verts[mixed])[1]]
        return {title: owner == k for k, title in enumerate(masks)}
    return {}
