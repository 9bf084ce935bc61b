"""What was left out of a shape neither hinders the two maps of a pair nor takes part in them."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.maps.unfold_pair import unfold_pair
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from tests.maps.solids import grid
from tests.maps.test_unfold import ball, folded, put


def on_floor(shape: Shape, first: bool) -> Shape:
    """The shape and a floor that is left out, before or after it in the file."""
    sheet = grid(12, 12, 0.5)
    both = [Shape(sheet.verts - [3.0, 3, 1.5], sheet.faces), shape][:: 1 if first else -1]
    weights = np.concatenate([np.full(each.V, float(each is shape)) for each in both])
    faces = np.concatenate([both[0].faces, both[1].faces + both[0].V])
    return Shape(np.concatenate([each.verts for each in both]), faces, weights=weights)


def in_scene(found: VertexMap, source: Shape, target: Shape) -> VertexMap:
    """A map between two bodies as one between two such files; floors go to one vertex, as to the nearest that was fitted."""
    rows, onto = np.flatnonzero(source.weights), np.flatnonzero(target.weights)
    first_face = int(np.flatnonzero((target.weights > 0)[target.faces].all(axis=1))[0])
    index, face = np.full(source.V, onto[0]), np.full(source.V, -1)
    index[rows], face[rows] = onto[found.index], found.face + first_face
    weights = np.tile([1.0, 0.0, 0.0], (source.V, 1))
    weights[rows] = found.barycentric
    return VertexMap.between(source, target, index, face=face, barycentric=weights, verdict=found.verdict)


@pytest.mark.parametrize("verdict", ["good", "fair"])
def test_bodies_on_floors_have_the_maps_that_they_have_alone(verdict: str) -> None:
    source, target = ball(3), ball(3, 0.0)
    there = replace(folded(source, target), verdict=verdict)
    back = replace(put(target, source, target.verts), verdict=verdict)
    alone = unfold_pair(there, lambda: back, source, target, False)
    scenes = on_floor(source, True), on_floor(target, False)
    before = in_scene(there, *scenes), in_scene(back, *scenes[::-1])
    found = unfold_pair(before[0], lambda: before[1], *scenes, False)
    assert (found[1] is None) == (alone[1] is None) == (verdict == "fair")
    for way, (one, other) in enumerate((scenes, scenes[::-1])):
        if found[way] is None:
            continue
        kept = one.weights > 0
        np.testing.assert_allclose(found[way].points(other)[kept], alone[way].points((target, source)[way]), atol=1e-6)
        assert not np.array_equal(found[way].face[kept], before[way].face[kept])
        np.testing.assert_array_equal(found[way].index[~kept], before[way].index[~kept])


def test_a_map_onto_what_was_left_out_stays_as_it_is() -> None:
    source, target = ball(3), on_floor(ball(3), True)
    onto_floor = VertexMap.between(source, target, np.zeros(source.V, int), verdict="good")
    found, opposite = unfold_pair(onto_floor, lambda: onto_floor, source, target, False)
    assert found is onto_floor and opposite is None


def test_vertices_without_a_position_or_a_face_keep_the_images_of_those_that_stand_for_them() -> None:
    """They lie somewhere else than on the surface, where an inverse would look for what is nearest."""
    whole, target = ball(3), ball(3, 0.0)
    lost = np.array([7, 300, whole.V, whole.V + 1])
    invalid = np.isin(np.arange(whole.V + 2), lost[:3])
    verts = np.concatenate([whole.verts, [[0, 0, 0], [0.1, 0, 0]]])
    verts[invalid] = 0.0
    source = Shape(verts, whole.faces, invalid=invalid)
    alone, rows = put(whole, target, whole.verts), np.append(np.arange(whole.V), [9, 9])
    rows[lost[:2]] = [8, 301]  # which stand for them
    rest = {"face": alone.face[rows], "barycentric": alone.barycentric[rows], "verdict": "good"}
    there = VertexMap.between(source, target, alone.index[rows], **rest)
    back = replace(put(target, source, target.verts), verdict="good")
    found, opposite = unfold_pair(there, lambda: back, source, target, False)
    assert opposite is not None
    np.testing.assert_allclose(found.points(target)[lost], there.points(target)[lost])
