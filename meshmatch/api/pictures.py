"""Pictures of shapes, maps, values and labels, and the interactive page of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.api.inputs import checked_threads
from meshmatch.api.results import MapPair
from meshmatch.api.transfer import MapLike, find_maps
from meshmatch.arrays import Floats, as_numbers
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.render import compose
from meshmatch.render.compose import Composition, merge_labels
from meshmatch.render.facing import guess_rotation, rotation_like
from meshmatch.render.picture import Look, check_picture
from meshmatch.render.viewer.looks import share_look
from meshmatch.render.viewer.page import PageReport, write_page
from meshmatch.shapes.appearance import Appearance, vertex_colors_alone
from meshmatch.shapes.files import ShapeLike, as_shape, as_shapes
from meshmatch.shapes.formats.gltf import SUFFIXES as GLTF_SUFFIXES
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import find_appearance, load_coordinates
from meshmatch.threads import thread_limit
from meshmatch.transfer.label_files import Labels, labels_of


def picture(
    shapes: Sequence[ShapeLike] | Composition,
    path: str | Path,
    *,
    match: MapLike = None,
    values: Sequence[ArrayLike] | None = None,
    labels: Sequence[Labels | ArrayLike] | None = None,
    fit: Fit | None = None,
    look: Look | None = None,
    names: Sequence[str] | None = None,
) -> tuple[int, int]:
    """Draw shapes side by side as a PNG, without a GPU, a display or OpenGL.

    Parameters
    ----------
    shapes
        Each as in `match`; files are drawn with their textures. Or the result of a function of `meshmatch.render.compose`.
    path
        The .png to write.
    match
        The map between two shapes, as in `find_maps`: corresponding points get the same color.
    values
        For each shape, numbers per vertex (V,), drawn with a color map, or colors (V, 3 or 4) in 0..1.
    labels
        For each shape, one label per vertex or face.
    fit
        The fit of a single shape: the deformed template is drawn over the shape, colored by distance.
    look
        Size, background, axes and direction of view.
    names
        Captions below the shapes.

    Returns
    -------
    (width, height)
        Size of the picture in pixels.

    Raises
    ------
    MeshmatchError
        More than one of `match`, `values`, `labels` and `fit` is given, or one does not belong to the shapes.

    Examples
    --------
    >>> climber, dancer = "templates/samples/climber.ply", "templates/samples/dancer.ply"
    >>> result = meshmatch.match(climber, dancer)
    >>> meshmatch.picture([climber, dancer], "match.png", match=result)
    """
    look = look or Look()
    check_picture(path)
    with thread_limit(1):
        shown = composed(shapes, look, match=match, values=values, labels=labels, fit=fit)
        if names is not None:
            names = [names] if isinstance(names, str) else names
            if len(names) != len(shown.panels):
                raise OptionError(f"{len(shown.panels)} shapes need as many names, not {len(names)}")
            shown = shown.named(names)
        return shown.render(path, look)


def composed(
    given: Sequence[ShapeLike] | Composition,
    look: Look,
    *,
    match: MapLike = None,
    values: Sequence[ArrayLike] | None = None,
    labels: Sequence[Labels | ArrayLike] | None = None,
    fit: Fit | None = None,
    title: str = "",
    limits: tuple[float, float] | None = None,
) -> Composition:
    """Compose what `picture` draws; ``title`` and ``limits`` belong to the color scale of ``values``."""
    if isinstance(given, Composition):
        return given
    known = {"match": match, "values": values, "labels": labels, "fit": fit}
    chosen = [name for name, one in known.items() if one is not None]
    if len(chosen) > 1:
        raise OptionError(f"{' and '.join(chosen)} do not go together", "make a picture for each")
    shapes = as_shapes(given)
    for name, given_of in (("values", values), ("labels", labels)):
        if given_of is not None and len(given_of) != len(shapes):
            raise OptionError(f"{len(shapes)} shapes need as many {name}, not {len(given_of)}")
    if match is not None:
        if len(shapes) != 2:
            raise OptionError(f"a map is of two shapes, not of {len(shapes)}", "give the source, then the target")
        maps = find_maps(shapes[0], shapes[1], match)
        fitted = maps.match.shapes if maps.match is not None else None
        return compose.compose_match(*(fitted or (shapes[0], shapes[1])), maps.forward, maps.rotations, look)
    if values is not None:
        tables = []
        for numbers, shape in zip(values, shapes, strict=True):
            what = f"values of {shape.name or 'the shape'}"
            tables.append(table := as_numbers(numbers, what))
            if table.ndim not in (1, 2) or len(table) != shape.V:
                hint = "one number or one color for each vertex, and one array for each shape"
                raise InputError(f"{what} must be an array of ({shape.V},), not {table.shape}", hint)
        return compose.compose_values(shapes, tables, title, limits)
    if labels is not None:
        pairs = zip(labels, shapes, strict=True)
        read = [own if isinstance(own, Labels) else labels_of(own, shape) for own, shape in pairs]
        return compose.compose_labels(shapes, *merge_labels(read), [own.on == "faces" for own in read])
    if fit is not None:
        if len(shapes) != 1:
            raise OptionError(f"a fit is of one shape, not of {len(shapes)}", "make a picture for each")
        own = None if fit.repaired is None else fit.repaired.original
        if own is not None and own.hash != shapes[0].hash:
            what = f"the fit is of {own.name or 'another shape'}, not of {shapes[0].name or 'this one'}"
            raise InputError(what, "draw the shape that was fitted")
        return compose.compose_fit(shapes[0], fit.shape, fit.frame.turn)
    looks = [read_look(source, shape)[0] for source, shape in zip(given, shapes, strict=True)]
    return compose.compose_shapes(list(zip(shapes, looks, strict=True)))


@dataclass(frozen=True, eq=False)
class Page(PageReport):
    """Report on a written page, with the maps that it shows."""

    maps: MapPair


def view(
    source: ShapeLike,
    target: ShapeLike,
    path: str | Path,
    match: MapLike = None,
    *,
    up: str | None = None,
    front: str | None = None,
    names: Sequence[str] | None = None,
    threads: int = 2,
) -> Page:
    """Write an interactive page of two shapes and the map between them: one .html file for any recent browser.

    Parameters
    ----------
    source
        As in `match`; if it is a path, its textures are shown.
    target
        As in `match`; if it is a path, its textures are shown.
    path
        The .html to write.
    match
        As in `find_maps`.
    up
        Up axis of the source, such as "z"; used if the map comes without fits, or is poor. Guessed by default.
    front
        Axis that the source faces, such as "-y"; used like ``up``. Guessed by default.
    names
        Captions of source and target, instead of the shapes' names.
    threads
        Number of threads.

    Returns
    -------
    Page
        Report on the written page: ``drawn`` vertices, ``notes``, ``size`` in bytes, and ``maps``.

    Raises
    ------
    MeshmatchError
        As for `meshmatch.match`; or the map belongs to other shapes.

    Examples
    --------
    >>> climber, dancer = "templates/samples/climber.ply", "templates/samples/dancer.ply"
    >>> result = meshmatch.match(climber, dancer)
    >>> meshmatch.view(climber, dancer, "match.html", result)
    """
    threads = checked_threads(threads)
    if names is not None and (isinstance(names, str) or len(names) != 2):
        raise OptionError("a page needs two names, of the source and of the target")
    shapes = as_shape(source, "source"), as_shape(target, "target")
    maps = find_maps(*shapes, match)
    with thread_limit(1):
        (look, uv, note), (other, other_uv, other_note) = map(read_look, (source, target), shapes)
        both = maps.forward, maps.backward
        looks = share_look(shapes, (look, other), *both, coordinates=(uv, other_uv), workers=threads)
        shown = None if names is None else (names[0], names[1])
        rotations = _rotations(source, maps, up, front)
        report = write_page(path, *shapes, *both, rotations=rotations, names=shown, looks=looks)
    notes = tuple(each for each in (note, other_note) if each)
    return Page(report.drawn, (*notes, *report.notes), report.size, maps)


def _rotations(
    source: ShapeLike, maps: MapPair, up: str | None, front: str | None
) -> tuple[Floats | None, Floats | None]:
    """Rotations that make the shapes upright: from their fits unless these are poor, else for the source alone.

    The source's then come from ``up`` and ``front``, or from its format if that is glTF.
    """
    first, second = maps.rotations
    if first is not None and second is not None and maps.forward.verdict != "poor":
        # The frame of a fit follows the trunk; standing shapes are to stay on the ground.
        pairs = (maps.source, first), (maps.target, second)
        first, second = (rotation_like(shape, shape.verts, shape.verts @ turn.T) for shape, turn in pairs)
        return first, second
    if up is not None or front is not None:
        return guess_rotation(maps.source, up, front), None
    if isinstance(source, str | Path) and Path(source).suffix.lower() in GLTF_SUFFIXES:
        return np.eye(3), None  # the format says: y up, z to the front
    return None, None


def read_look(
    source: ShapeLike, shape: Shape, image: Path | None = None
) -> tuple[Appearance | None, Floats | None, str]:
    """Read the textures and texture coordinates of a shape's file.

    Return the appearance, the texture coordinates and a note. If the file's own textures cannot be read, the note says so
    and vertex colors are used; if ``image`` is given and cannot be used, raise `InputError`.
    """
    if not isinstance(source, str | Path):
        return None, None, ""
    try:
        return find_appearance(source, shape, image), load_coordinates(source, shape), ""
    except InputError as error:
        if image is not None:
            raise
        colors = None if shape.colors is None else vertex_colors_alone(shape)
        return colors, None, f"shown without its {'look' if colors is None else 'texture'}: {error.message}"
