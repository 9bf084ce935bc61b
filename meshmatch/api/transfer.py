"""Transfer of attributes between shapes: values, colors, labels, skin weights and landmarks, along a pair of maps.

Shapes and ``match`` are as in `find_maps`. `ConfidenceRule` says how values of low confidence are handled.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from meshmatch.api.results import ConfidenceRule, MapPair, MatchResult, Transferred
from meshmatch.api.upright import turn_upright
from meshmatch.arrays import Floats, as_numbers, to_numpy
from meshmatch.errors import InputError, OptionError
from meshmatch.maps.files import load_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.scalars import is_integer
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.colors import linear_to_srgb_alpha, srgb_to_linear_alpha
from meshmatch.shapes.dressed_files import warn_about_losses
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.formats.gltf_vrm import check_character
from meshmatch.shapes.input_files import stem_of
from meshmatch.shapes.landmark_files import Space, mesh_space
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.attributes import pull_directions, pull_face_labels, pull_labels, pull_values, pull_weights
from meshmatch.transfer.bake import colors_of_vertices
from meshmatch.transfer.label_files import Labels, On, labels_of, load_labels, name_labels, save_labels
from meshmatch.transfer.landmarks import (
    Landmarks,
    at_points,
    at_vertices,
    landmarks_with_warnings,
    push_landmarks,
    save_landmarks,
    warn_if_far,
)
from meshmatch.transfer.low_confidence import LowConfidence, replace_low_labels, replace_low_values, replace_low_weights
from meshmatch.transfer.value_files import Values, check_colors, linear_colors, save_colors, save_values
from meshmatch.transfer.weight_files import SkinWeights, load_weights, save_weights, weights_of

if TYPE_CHECKING:
    from meshmatch.api.matcher import Matcher

MapLike: TypeAlias = (
    "MatchResult | MapPair | VertexMap | str | Path | Matcher | Callable[[Shape, Shape], MatchResult | MapPair] | None"
)
"""The map of a transfer: a match, maps, or a map from source to target, or the path of a map; a `Matcher` or a function of
both shapes, which makes it after all other inputs are checked; or None."""


def find_maps(source: ShapeLike, target: ShapeLike, match: MapLike = None) -> MapPair:
    """Find the maps between two shapes, for one or several transfers.

    Parameters
    ----------
    source
        The shape whose attributes are transferred, as in `match`.
    target
        The shape that receives them, as in `match`.
    match
        A `MatchResult`, a `MapPair`, or a `VertexMap` from source to target or its path; or a `Matcher` or a function of
        both shapes that makes one. By default the shapes are matched, unless both are meshes with the same faces: then
        each vertex is mapped to the vertex with the same index.

    Returns
    -------
    MapPair
        Both shapes and the maps in both directions.

    Raises
    ------
    MeshmatchError
        The map belongs to other shapes or has the opposite direction; or as for `meshmatch.match`.

    Examples
    --------
    >>> maps = meshmatch.find_maps("templates/samples/dancer.ply", "templates/samples/climber.ply")
    >>> heights = meshmatch.load_shape("templates/samples/dancer.ply").verts[:, 1]
    >>> moved = meshmatch.transfer_values(maps.source, maps.target, heights, maps)
    """
    source, target = as_shape(source, "source"), as_shape(target, "target")
    if match is None and have_same_faces(source, target):
        return vertex_to_vertex(source, target)
    label = Path(match).name if isinstance(match, str | Path) else "the map"
    found = load_map(match) if isinstance(match, str | Path) else match
    if callable(found):
        found = found(source, target)
    elif not isinstance(found, VertexMap | MatchResult | MapPair):
        from meshmatch.api.matcher import Matcher

        matcher = Matcher() if found is None else found
        if not isinstance(matcher, Matcher):
            hint = "pass a MatchResult, a VertexMap, the path of a map, a Matcher, or nothing to match the shapes"
            raise InputError(f"{type(match).__name__} is not a map", hint)
        found = matcher.match(source, target)
    if isinstance(found, VertexMap):
        return MapPair(source, target, found.for_shapes(source, target, label))
    if isinstance(found, MatchResult):
        return MapPair(source, target, found.map.for_shapes(source, target), found, found.threads)
    found.forward.for_shapes(source, target)
    return found


def is_given(match: MapLike) -> bool:
    """Whether `find_maps` reads a map, or takes one, instead of making it."""
    return isinstance(match, str | Path | VertexMap | MatchResult | MapPair)


def have_same_faces(source: Shape, target: Shape) -> bool:
    """Whether two meshes have the same vertex count and the same triangles in the same order."""
    return source.V == target.V and source.F > 0 and np.array_equal(source.faces, target.faces)


def vertex_to_vertex(source: Shape, target: Shape) -> MapPair:
    """Identity maps between two poses of one mesh. They are not judged: their verdict is "unknown".

    `InputError` if one of them has no area.
    """
    for shape in (source, target):
        sqrt_area_frame(shape)
    there, back = (VertexMap.between(a, b, np.arange(a.V)) for a, b in ((source, target), (target, source)))
    return MapPair(source, target, there, opposite=back)


def transfer_values(
    source: ShapeLike,
    target: ShapeLike,
    values: ArrayLike,
    match: MapLike = None,
    *,
    directions: bool = False,
    rule: ConfidenceRule = ConfidenceRule(),
) -> Transferred[Floats]:
    """Transfer numbers per vertex from the source to the target, interpolated within the source's faces.

    Parameters
    ----------
    source
        As in `find_maps`.
    target
        As in `find_maps`.
    values
        (V_source,) or (V_source, D). Values that are not finite are ignored.
    match
        As in `find_maps`.
    directions
        Treat the values as directions (V_source, 3), such as normals: they rotate with the surface from source to target,
        and are normalised to unit length.
    rule
        How values of low confidence are handled.

    Returns
    -------
    Transferred
        ``data`` is an array (V_target,) or (V_target, D).

    Raises
    ------
    MeshmatchError
        ``values`` does not have a row for each vertex of the source; or as for `find_maps`.

    Examples
    --------
    >>> heights = meshmatch.load_shape("templates/samples/dancer.ply").verts[:, 1]
    >>> moved = meshmatch.transfer_values("templates/samples/dancer.ply", "templates/samples/climber.ply", heights)
    >>> moved.data, moved.confidence  # (V_target,) each
    """
    source = as_shape(source, "source")
    numbers = as_numbers(values, "values")
    if numbers.ndim not in (1, 2) or len(numbers) != source.V:
        hint = "one row for each vertex of the source"
        raise InputError(f"values must be an array of ({source.V},) or ({source.V}, D), not {numbers.shape}", hint)
    blank = None if rule.blank is None else as_numbers(rule.blank, "blank")
    if blank is not None and blank.shape not in ((), (1,), numbers.shape[1:]):
        raise OptionError(f"blank has {blank.shape} numbers and the values {numbers.shape[1:]}", "give one number")
    if directions and numbers.shape != (source.V, 3):
        hint = "give x, y and z of each vector, or transfer plain numbers"
        raise InputError(f"directions must be an array of ({source.V}, 3), not {numbers.shape}", hint)
    maps = find_maps(source, target, match)
    with thread_limit(1):
        if directions:
            found = pull_directions(maps.backward, maps.source, maps.target, numbers)
        else:
            found = pull_values(maps.backward, numbers)
        confidence = maps.backward.confidence.astype(np.float64)
        found, low = replace_low_values(found, confidence < rule.minimum, maps.target, blank, rule.fill)
    write = partial(_write_values, found, maps.target, _file_of(target))
    return Transferred(found, confidence, low, maps, write)


def _file_of(shape: ShapeLike) -> Path | None:
    return Path(shape) if isinstance(shape, str | Path) else None


def _write_values(values: Floats, target: Shape, file: Path | None, path: Path, final: Path) -> None:
    warn_about_losses(file, final, save_values(path, Values(values), target, file))


def transfer_colors(
    source: ShapeLike,
    target: ShapeLike,
    match: MapLike = None,
    *,
    colors: ArrayLike | Appearance | None = None,
    rule: ConfidenceRule = ConfidenceRule(),
) -> Transferred[Floats]:
    """Transfer vertex colors from the source to the target, interpolated in linear light.

    Parameters
    ----------
    source
        As in `find_maps`.
    target
        As in `find_maps`.
    match
        As in `find_maps`.
    colors
        (V_source, 3 or 4) sRGB colors in 0..1, instead of the colors in the source's file; or an `Appearance`, whose
        textures are sampled.
    rule
        How colors of low confidence are handled.

    Returns
    -------
    Transferred
        ``data`` is (V_target, 4): red, green, blue (sRGB) and alpha in 0..1.

    Raises
    ------
    MeshmatchError
        The source has no vertex colors; or as for `find_maps`.

    Examples
    --------
    >>> dancer, climber = "templates/samples/dancer-textured.glb", "templates/samples/climber.ply"
    >>> colored = meshmatch.transfer_colors(dancer, climber, colors=[[0.8, 0.2, 0.2]] * meshmatch.load_shape(dancer).V)
    >>> colored.data  # (V_target, 4)
    """
    source = as_shape(source, "source")
    given = None if isinstance(colors, Appearance) else linear_colors(source, colors)
    blank = None
    if rule.blank is not None:
        chosen = check_colors(as_numbers(rule.blank, "blank"))
        blank = srgb_to_linear_alpha(np.append(chosen, 1.0)[:4])  # opaque unless alpha is given
    maps = find_maps(source, target, match)
    with thread_limit(1):
        if given is not None:
            found = pull_values(maps.backward, given)
        else:
            assert isinstance(colors, Appearance)
            found = colors_of_vertices(maps.source, colors, maps.target, maps.backward)
        confidence = maps.backward.confidence.astype(np.float64)
        found, low = replace_low_values(found, confidence < rule.minimum, maps.target, blank, rule.fill)
    colors = linear_to_srgb_alpha(found)
    return Transferred(colors, confidence, low, maps, partial(_write_colors, colors, maps, _file_of(target)))


def _write_colors(colors: Floats, maps: MapPair, file: Path | None, path: Path, final: Path) -> None:
    check_character(file, final)
    along_y = Path(maps.source.name).suffix.lower() in gltf.SUFFIXES
    turn = turn_upright(maps, along_y) if path.suffix.lower() == ".glb" else None  # an fbx is first written as a glb
    warn_about_losses(file, final, save_colors(path, maps.target, colors, file, turn))


def transfer_labels(
    source: ShapeLike,
    target: ShapeLike,
    labels: Labels | ArrayLike | str | Path,
    match: MapLike = None,
    *,
    to: On | None = None,
    rule: ConfidenceRule = ConfidenceRule(),
) -> Transferred[Labels]:
    """Transfer labels of vertices or faces from the source to the target: chosen by vote, never averaged.

    Parameters
    ----------
    source
        As in `find_maps`.
    target
        As in `find_maps`.
    labels
        (V_source,) or (F_source,) integers or strings, or the path of a file; `Labels` if their number does not determine
        whether they belong to vertices or faces.
    match
        As in `find_maps`.
    to
        Label the "vertices" or the "faces" of the target; by default as on the source. Of a point cloud, always the points.
    rule
        How labels of low confidence are handled.

    Returns
    -------
    Transferred
        ``data.values`` is the label of each vertex (V_target,) or face (F_target,).

    Raises
    ------
    MeshmatchError
        The labels do not belong to the source, ``to`` is "faces" for a point cloud, or as for `find_maps`.

    Examples
    --------
    >>> dancer = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> labels = ["upper" if y > dancer.verts[:, 1].mean() else "lower" for y in dancer.verts[:, 1]]
    >>> meshmatch.transfer_labels(dancer, "templates/samples/climber.ply", labels).data.values
    """
    file = _file_of(target)
    source, target = as_shape(source, "source"), as_shape(target, "target")
    if isinstance(labels, str | Path):
        given = load_labels(labels, source)
    else:
        given = labels if isinstance(labels, Labels) else labels_of(labels, source)
    blank = None if rule.blank is None else str(rule.blank)
    if blank is not None:
        given.check_blank(blank)
    if to not in (None, *get_args(On)):
        raise OptionError(f"labels cannot be given to {to!r}", "choose vertices or faces")
    if to == "faces" and target.is_cloud:
        raise OptionError(f"{target.name} is a point cloud: it has no faces to label", "label its vertices")
    kind: On = "vertices" if target.is_cloud else to or given.on
    maps = find_maps(source, target, match)
    back, of_face = maps.backward, given.on == "faces"
    with thread_limit(1):
        confidence = maps.backward.confidence.astype(np.float64)
        if kind == "faces":
            found = pull_face_labels(back, source, target, given.codes, of_face, maps.threads)
            confidence = confidence[target.faces].mean(axis=1)
        else:
            found = pull_labels(back, source, given.codes, of_face)
        is_low = confidence < rule.minimum
        found, low = replace_low_labels(found, is_low, target, blank is not None, rule.fill, kind == "faces")
    labeled = name_labels(found, given, kind, blank)
    return Transferred(labeled, confidence, low, maps, partial(_write_labels, labeled, target, file))


def _write_labels(labels: Labels, target: Shape, file: Path | None, path: Path, final: Path) -> None:
    warn_about_losses(file, final, save_labels(path, labels, target, file))


def transfer_weights(
    source: ShapeLike,
    target: ShapeLike,
    weights: SkinWeights | csr_array | ArrayLike | str | Path,
    match: MapLike = None,
    *,
    influences: int = 4,
    rule: ConfidenceRule = ConfidenceRule(),
) -> Transferred[SkinWeights]:
    """Transfer skin weights from the source to the target.

    Parameters
    ----------
    source
        As in `find_maps`.
    target
        As in `find_maps`.
    weights
        (V_source, J) dense or sparse weights of J joints, or the path of a file.
    match
        As in `find_maps`.
    influences
        Maximum number of joints per vertex; those with the largest weights are kept.
    rule
        How weights of low confidence are handled: they can be filled or kept, but not left blank.

    Returns
    -------
    Transferred
        ``data.matrix`` is sparse, (V_target, J); its rows sum to 1, except for vertices that no joint moves.

    Raises
    ------
    MeshmatchError
        The weights do not belong to the source; or as for `find_maps`.

    Examples
    --------
    >>> dancer = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> arm = (abs(dancer.verts[:, 0]) > 0.3).astype(float)
    >>> meshmatch.transfer_weights(dancer, "templates/samples/climber.ply", [[a, 1 - a] for a in arm]).data.matrix
    """
    source = as_shape(source, "source")
    if rule.blank is not None:
        raise OptionError("skin weights cannot be left blank", "fill them in, or keep them")
    if not is_integer(influences, 1):
        raise OptionError(
            f"influences must be an integer of 1 or more, not {influences!r}", "4 is what most programs read"
        )
    if isinstance(weights, str | Path):
        given = load_weights(weights, source)
    else:
        given = weights if isinstance(weights, SkinWeights) else weights_of(weights, source)
    maps = find_maps(source, target, match)
    with thread_limit(1):
        confidence = maps.backward.confidence.astype(np.float64)
        found = pull_weights(maps.backward, given.matrix, influences)
        found, low = replace_low_weights(found, confidence < rule.minimum, maps.target, rule.fill, influences)
    skin = SkinWeights(found, given.names)
    return Transferred(skin, confidence, low, maps, partial(_write_weights, skin))


def _write_weights(weights: SkinWeights, path: Path, final: Path) -> None:
    save_weights(path, weights)


def transfer_landmarks(
    source: ShapeLike,
    target: ShapeLike,
    landmarks: Landmarks | ArrayLike | str | Path,
    match: MapLike = None,
    *,
    rule: ConfidenceRule = ConfidenceRule(),
) -> Transferred[Landmarks]:
    """Transfer landmarks from the source to points of the target's surface.

    Parameters
    ----------
    source
        As in `find_maps`.
    target
        As in `find_maps`.
    landmarks
        Vertices (N,); positions (N, 3) in the source's frame, which are moved to the nearest point of the source; or the
        path of a file.
    match
        As in `find_maps`.
    rule
        Landmarks with a confidence below its ``minimum`` are missing on the target, as a nearby point would not be a
        measurement. A minimum of 0 keeps all of them.

    Returns
    -------
    Transferred
        ``data.points`` (N, 3) in the target's frame and unit, also given as ``vertex``, or as ``face`` and ``barycentric``
        weights. Missing landmarks have nan and -1.

    Raises
    ------
    MeshmatchError
        The landmarks are not on the source; or as for `find_maps`.

    Examples
    --------
    >>> moved = meshmatch.transfer_landmarks("templates/samples/dancer.ply", "templates/samples/climber.ply", [0, 100, 200])
    >>> moved.data.points  # (3, 3), unit of the climber's file
    >>> moved.confidence  # (3,)
    """
    space = mesh_space(source) if isinstance(source, str | Path) else ""
    source = as_shape(source, "source")
    given = given_landmarks(landmarks, source, space)
    maps = find_maps(source, target, match)
    with thread_limit(1):
        found = push_landmarks(maps.forward, maps.source, maps.target, given)
    found = found.without(found.missing | (found.confidence < rule.minimum))
    lost = int(found.missing.sum())
    low = LowConfidence(len(found.names), lost, lost)
    file = _file_of(target)
    return Transferred(found, found.confidence, low, maps, partial(_write_landmarks, found, maps.target, file))


def _write_landmarks(landmarks: Landmarks, target: Shape, file: Path | None, path: Path, final: Path) -> None:
    space = "" if file is None else mesh_space(file)
    save_landmarks(path, landmarks, space or "LPS", final.name, stem_of(file or Path(target.name)))


def given_landmarks(landmarks: Landmarks | ArrayLike | str | Path, source: Shape, space: Space) -> Landmarks:
    """Return landmarks of a source, given in any form of `transfer_landmarks`; ``space`` is the frame of its file."""
    if isinstance(landmarks, Landmarks):
        return landmarks
    if isinstance(landmarks, str | Path):
        return landmarks_with_warnings(landmarks, source, space)
    try:
        places = np.asarray(to_numpy(landmarks))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"landmarks are no array of numbers ({error})", "give vertices (N,) or positions (N, 3)"
        ) from error
    if places.ndim == 1 and places.dtype.kind in "iu":
        return at_vertices(source, places)
    if places.ndim == 2 and places.shape[1] == 3 and places.dtype.kind in "iuf":
        found, distance = at_points(source, places.astype(np.float64))
        warn_if_far(source, float(distance.max(initial=0.0)))
        return found
    hint = "give vertices (N,) as integers, or positions (N, 3)"
    raise InputError(f"landmarks cannot be an array of {places.shape} {places.dtype}", hint)
