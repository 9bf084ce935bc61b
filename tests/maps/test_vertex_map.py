"""The noun: what it accepts, what it refuses, how two are joined."""

import numpy as np
import pytest
import torch

from meshmatch.errors import InputError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from tests.maps.solids import bumpy_sphere, grid


def random_map(source: Shape, target: Shape, seed: int) -> VertexMap:
    rng = np.random.default_rng(seed)
    face = rng.integers(-1, target.F, source.V)
    weights = rng.dirichlet(np.ones(3), source.V)
    weights[face < 0] = [1, 0, 0]
    corner = target.faces[face, weights.argmax(axis=1)]
    index = np.where(face < 0, rng.integers(0, target.V, source.V), corner)
    return VertexMap.between(
        source,
        target,
        index,
        face=face,
        barycentric=weights,
        confidence=rng.random(source.V).astype(np.float32),
        verdict="fair",
        reasons=(f"made up with seed {seed}", "µ and é survive"),
        source_up=("+x", "-y", "+z")[seed % 3],
        target_up=("-z", "+y")[seed % 2],
    )


A, B, C, D = grid(2, 3, name="a"), grid(3, 3, name="b"), bumpy_sphere(6, 7, "c"), grid(4, 4, name="d")


def test_between_knows_both_shapes() -> None:
    m = random_map(A, B, 0)
    assert (m.source, m.target) == ("a", "b")
    assert (m.source_vertices, m.target_vertices) == (A.V, B.V)
    assert (m.source_hash, m.target_hash) == (A.hash, B.hash)
    assert repr(m) == "VertexMap(a -> b, 12 -> 16 vertices, fair)"


def test_a_bare_list_is_a_map_with_unknowns() -> None:
    m = VertexMap("a", "b", np.array([2, 0, 1], dtype=np.int32))
    assert m.index.dtype == np.int64
    assert m.target_vertices == -1
    assert m.source_vertices == 3
    assert m.face.tolist() == [-1] * 3
    assert m.barycentric.tolist() == [[1, 0, 0]] * 3
    assert m.confidence.dtype == np.float32
    assert np.isnan(m.confidence).all() and m.assumed_confidence.tolist() == [1] * 3
    assert m.verdict == "unknown"


def test_arrays_are_its_own_and_read_only() -> None:
    index = np.array([1, 0])
    m = VertexMap("", "", index)
    index[0] = 0
    assert m.index.tolist() == [1, 0]
    for array in (m.index, m.face, m.barycentric, m.confidence):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


@pytest.mark.parametrize(
    ("change", "message", "hint"),
    [
        ({"index": np.array([0, 16])}, "has only 16", "another shape"),
        ({"index": np.array([1, 16])}, "has only 16", "1-based"),
        ({"index": np.array([-1, 3])}, "start at 0", "any vertex and confidence 0"),
        ({"index": np.zeros((2, 2), int)}, "list of", ""),
        ({"index": np.zeros(0, int)}, "list of", ""),
        ({"index": np.array([0.5, 1])}, "whole numbers", ""),
        ({"index": np.array(["0", "1"])}, "whole numbers", ""),
        ({"index": np.array([0.0, np.nan])}, "whole numbers", ""),
        ({"source_vertices": 3}, "2 entries for 3", ""),
        ({"target_vertices": 0}, "needs vertices", ""),
        ({"face": np.array([0])}, "face must be an array", ""),
        ({"face": np.array([0, -2])}, "face -2", ""),
        ({"barycentric": np.ones((2, 3))}, "sum to 1", ""),
        ({"barycentric": np.array([[1, 0, 0], [2, -1, 0]])}, "sum to 1", ""),
        ({"barycentric": np.full((2, 3), np.nan)}, "sum to 1", ""),
        ({"face": np.array([0, -1])}, "faces without barycentric weights", "give both"),
        ({"barycentric": np.full((2, 3), 1 / 3)}, "barycentric weights without faces", "give both"),
        ({"confidence": np.array([0, 1.5])}, "0..1", ""),
        ({"confidence": np.array([0, np.nan])}, "0..1", ""),
        ({"confidence": np.array([0, 0x7F800001], np.uint32).view(np.float32)}, "0..1", ""),  # a nan that signals
        ({"barycentric": np.full(6, 0x7F800001, np.uint32).view(np.float32).reshape(2, 3)}, "sum to 1", ""),
        ({"verdict": "splendid"}, "verdict", ""),
    ],
)
def test_refusals(change: dict, message: str, hint: str) -> None:
    fields = {"source": "a", "target": "b", "index": np.array([0, 1]), "target_vertices": 16, **change}
    with pytest.raises(InputError, match=message) as caught:
        VertexMap(**fields)
    assert hint in caught.value.hint


def test_names_of_files_are_no_shapes(cube: Shape) -> None:
    for call in (lambda: VertexMap.identity(cube).points("b.ply"), lambda: VertexMap.between("a.ply", cube, [0])):
        with pytest.raises(InputError, match="must be a Shape, not str") as caught:
            call()  # type: ignore[no-untyped-call]
        assert "load_shape" in caught.value.hint


def test_a_face_that_the_target_lacks_is_refused() -> None:
    with pytest.raises(InputError, match=r"face 18, but its target has only 18"):
        VertexMap.between(A, B, np.zeros(A.V, int), face=np.full(A.V, B.F), barycentric=np.eye(3)[np.zeros(A.V, int)])


def test_points_lie_where_face_and_weights_say() -> None:
    m = random_map(A, B, 1)
    points = m.points(B)
    for i in range(A.V):
        if m.face[i] < 0:
            assert np.array_equal(points[i], B.verts[m.index[i]])
        else:
            assert points[i] == pytest.approx(m.barycentric[i] @ B.verts[B.faces[m.face[i]]])
    with pytest.raises(InputError, match="leads to b with 16"):
        m.points(C)
    with pytest.raises(InputError, match="has only 12"):
        VertexMap("", "", np.array([14])).points(A)


def test_composition_follows_both_maps_and_is_associative() -> None:
    ab, bc, cd = random_map(A, B, 1), random_map(B, C, 2), random_map(C, D, 3)
    ac = ab.compose(bc)
    assert (ac.source, ac.target, ac.source_hash, ac.target_hash) == ("a", "c", A.hash, C.hash)
    assert (ac.source_up, ac.target_up) == (ab.source_up, bc.target_up)
    for i in range(A.V):
        assert ac.index[i] == bc.index[ab.index[i]]
        assert ac.points(C)[i] == pytest.approx(bc.points(C)[ab.index[i]])
        assert ac.confidence[i] == min(ab.confidence[i], bc.confidence[ab.index[i]])
    assert ac.reasons == ("made up with seed 1", "µ and é survive", "made up with seed 2")
    left, right = ac.compose(cd), ab.compose(bc.compose(cd))
    for name in ("index", "face", "barycentric", "confidence", "reasons", "verdict"):
        assert np.array_equal(getattr(left, name), getattr(right, name)), name


def test_identity_is_neutral() -> None:
    assert np.array_equal(VertexMap.identity(C).points(C), C.verts)
    ab = random_map(A, B, 4)
    before, after = VertexMap.identity(A).compose(ab), ab.compose(VertexMap.identity(B))
    for name in ("index", "face", "barycentric", "confidence", "verdict"):
        assert np.array_equal(getattr(before, name), getattr(ab, name)), name
    assert np.array_equal(after.index, ab.index)


def test_the_worse_verdict_wins() -> None:
    good, poor = VertexMap.identity(A), VertexMap.between(A, A, np.arange(A.V), verdict="poor")
    unknown = VertexMap.between(A, A, np.arange(A.V))
    assert good.compose(poor).verdict == poor.compose(good).verdict == "poor"
    assert good.compose(unknown).verdict == "unknown"
    assert unknown.compose(poor).verdict == "poor"


def test_maps_that_do_not_meet_are_not_joined() -> None:
    ab = random_map(A, B, 1)
    with pytest.raises(InputError, match="cannot join a -> b with c -> d") as caught:
        ab.compose(random_map(C, D, 2))
    assert "16 vertices" in caught.value.message
    assert f"{C.V} vertices" in caught.value.message
    assert caught.value.hint == "the first must end where the second starts"
    with pytest.raises(InputError) as caught:
        ab.compose(random_map(C, B, 2))
    assert "wrong way round" in caught.value.hint
    moved = Shape(B.verts + 1, B.faces, "b")  # as many vertices, another geometry
    with pytest.raises(InputError, match="cannot join"):
        ab.compose(random_map(moved, C, 2))
    # Where hashes are not known the counts decide.
    assert ab.compose(VertexMap("b", "x", np.arange(16))).target == "x"
    with pytest.raises(InputError, match="cannot join"):
        ab.compose(VertexMap("b", "x", np.arange(15)))
    with pytest.raises(InputError, match="matched to vertex"):
        VertexMap("a", "b", np.array([0, 20])).compose(VertexMap("b", "x", np.arange(15)))


def test_apply_keeps_the_gradient_of_a_tensor() -> None:
    m = random_map(A, C, 3)
    values = torch.tensor(C.verts, requires_grad=True)
    found = m.apply(values)
    assert found.detach().numpy() == pytest.approx(m.apply(C.verts), abs=1e-12)
    weights = torch.arange(3.0 * A.V, dtype=torch.float64).reshape(A.V, 3)
    (found * weights).sum().backward()
    assert values.grad is not None and values.grad.numpy() == pytest.approx(m.sparse().T @ weights.numpy())
    assert m.apply(values[:, 0].float()).dtype == torch.float32 and m.apply(values[:, 0]).shape == (A.V,)
    assert m.apply(torch.arange(C.V)).tolist() == pytest.approx(m.apply(np.arange(C.V)).tolist())
    with pytest.raises(InputError, match="vertices of its target"):
        m.apply(values[:-1])


def test_apply_interpolates_on_the_target() -> None:
    m = random_map(A, C, 5)
    assert m.apply(C.verts) == pytest.approx(m.points(C))
    one = m.apply(C.verts[:, 2])
    assert one.shape == (A.V,)
    assert one == pytest.approx(m.points(C)[:, 2])
    assert np.array_equal(VertexMap.identity(A).apply(A.verts), A.verts)
    ab, bc = random_map(A, B, 1), VertexMap.between(B, C, np.arange(B.V) % C.V)
    whole = VertexMap.between(A, B, ab.index)  # vertices to vertices: one after the other is the composition
    assert whole.apply(bc.apply(C.verts)) == pytest.approx(whole.compose(bc).apply(C.verts))


def test_the_matrix_of_a_map() -> None:
    m = random_map(A, C, 6)
    matrix = m.sparse()
    assert matrix.shape == (A.V, C.V)
    assert matrix.sum(axis=1) == pytest.approx(np.ones(A.V))
    values = np.random.default_rng(0).random((C.V, 2))
    assert np.array_equal(matrix @ values, m.apply(values))
    assert (VertexMap.identity(A).sparse().toarray() == np.eye(A.V)).all()


def test_the_functional_map() -> None:
    rng = np.random.default_rng(0)
    bases = {shape.name: rng.normal(size=(shape.V, 5)) for shape in (A, B, C)}
    assert VertexMap.identity(A).functional(bases["a"], bases["a"]) == pytest.approx(np.eye(5))
    m = random_map(A, C, 7)
    found = m.functional(bases["a"], bases["c"][:, :3])
    assert found.shape == (5, 3)
    # What least squares leaves over is orthogonal to the source's functions.
    assert bases["a"].T @ (bases["a"] @ found - m.apply(bases["c"][:, :3])) == pytest.approx(np.zeros((5, 3)))
    # With a whole basis nothing is lost, and composition turns round: C(ab then bc) = C(ab) C(bc).
    eye = {shape.name: np.eye(shape.V) for shape in (A, B, C)}
    ab, bc = VertexMap.between(A, B, np.arange(A.V)), random_map(B, C, 8)
    both = ab.functional(eye["a"], eye["b"]) @ bc.functional(eye["b"], eye["c"])
    assert ab.compose(bc).functional(eye["a"], eye["c"]) == pytest.approx(both)


def test_what_a_bare_map_cannot_say() -> None:
    with pytest.raises(InputError, match="number of vertices that the map a -> b leads to is unknown"):
        VertexMap("a", "b", np.array([1, 0])).apply(np.ones(2))
    inside = VertexMap("a", "b", np.array([1]), face=[0], barycentric=[[0.5, 0.5, 0]], target_vertices=3)
    with pytest.raises(InputError, match="faces that the map a -> b leads to are unknown") as told:
        inside.sparse()
    assert "load_map" in told.value.hint
    for wrong in (np.ones(A.V - 1), np.ones((A.V, 2, 2)), 3.0):
        with pytest.raises(InputError, match="needs values"):
            VertexMap.identity(A).apply(wrong)
    with pytest.raises(InputError, match="a basis of the source must be an array"):
        VertexMap.identity(A).functional(np.ones((3, 2)), np.ones((A.V, 2)))


def test_values_that_are_no_numbers(cube: Shape) -> None:
    found = VertexMap.identity(cube)
    with pytest.raises(InputError, match="must be numbers"):
        found.apply(["a"] * cube.V)
    with pytest.raises(InputError, match="must be finite"):
        found.functional(np.full((cube.V, 1), np.nan), np.ones((cube.V, 1)))
