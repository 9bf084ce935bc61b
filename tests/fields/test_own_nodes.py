"""A field on nodes and points of one's own: derivatives by differences and by torch, batches, points out of reach."""

from typing import Any

import numpy as np
import pytest
import torch

from meshmatch import fields
from meshmatch.errors import InputError, MeshmatchError, MeshmatchWarning, OptionError, TemplateError
from meshmatch.fields import NodeField, arap_energy, node_field, volume_energy
from meshmatch.fields.shape_functions import build_field

RNG = np.random.default_rng(0)
POINTS, NODES = RNG.uniform(-0.6, 0.6, (12, 3)), RNG.uniform(-1, 1, (150, 3))
VECTORS = RNG.normal(size=(150, 3))
FAR = np.concatenate([POINTS, [[1.5, 1.5, 1.5], [1.9, 0.0, 0.0], [5.0, 0.0, 0.0]]])


def differences(of: Any, points: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """The derivative of an array-valued function of points, along a last axis."""
    return np.stack([(of(points + h * e) - of(points - h * e)) / (2 * h) for e in np.eye(3)], -1)


@pytest.mark.parametrize("kernel", ["smooth", "cubic"])
@pytest.mark.parametrize("radius", [0.8, np.linspace(0.6, 1.2, 150)], ids=["one", "each"])
@pytest.mark.parametrize("points", [POINTS, FAR], ids=["in reach", "beyond"])
def test_derivatives_are_those_of_finite_differences(kernel: Any, radius: Any, points: np.ndarray) -> None:
    def at(places: np.ndarray) -> NodeField:
        return node_field(places, NODES, radius, kernel=kernel, outside="nearest")

    field = at(points)
    assert field.gradient(VECTORS) == pytest.approx(
        differences(lambda x: at(x).displacement(VECTORS), points), abs=1e-6
    )
    second = field.second_derivative(VECTORS)
    assert second == pytest.approx(differences(lambda x: at(x).gradient(VECTORS), points), abs=1e-4)
    assert second == pytest.approx(second.swapaxes(-1, -2), abs=1e-9)


def test_it_is_the_field_that_fits_are_made_of() -> None:
    field, ours = node_field(POINTS, NODES, 0.8), build_field(POINTS, NODES, 0.8, "smooth")
    assert field.displacement(VECTORS) == pytest.approx(ours.displaced(VECTORS), abs=1e-5)
    assert field.deformation_gradient(VECTORS) == pytest.approx(ours.deformation_gradient_at(VECTORS), abs=1e-4)
    assert field.matrix() @ VECTORS == pytest.approx(field.displacement(VECTORS))
    assert field.lebesgue == pytest.approx(np.asarray(abs(ours.phi).sum(1)).ravel(), rel=1e-5) and field.reached.all()
    assert repr(field) == "NodeField(12 points, 150 nodes, ndarray float64, 100% reached)"


def test_affine_motions_are_exact_in_float64() -> None:
    matrix, shift = np.random.default_rng(1).normal(size=(3, 3)), np.array([1.0, -2.0, 0.5])
    field = node_field(POINTS, NODES, 0.8)
    vectors = NODES @ (matrix - np.eye(3)).T + shift
    assert field.moved(vectors) == pytest.approx(POINTS @ matrix.T + shift, abs=1e-12)
    assert field.deformation_gradient(vectors) == pytest.approx(np.broadcast_to(matrix, (12, 3, 3)), abs=1e-11)
    assert field.second_derivative(vectors) == pytest.approx(np.zeros((12, 3, 3, 3)), abs=1e-9)
    assert field.displacement(VECTORS[:, :1]).shape == (12, 1)  # of anything, not of positions alone


@pytest.mark.parametrize("radius", [1e3, 1e8, 1e50])
def test_nodes_that_reach_far_make_one_affine_motion(radius: float) -> None:
    """All weigh alike: what NumPy's least squares find."""
    best = np.linalg.lstsq(np.column_stack([np.ones(150), NODES]), VECTORS)[0]
    for outside in ("error", "mask"):
        field = node_field(POINTS, NODES, radius, outside=outside)  # type: ignore[arg-type]
        assert field.reached.all()
        assert field.displacement(VECTORS) == pytest.approx(best[0] + POINTS @ best[1:], abs=1e-5)
        assert field.gradient(VECTORS) == pytest.approx(np.broadcast_to(best[1:].T, (12, 3, 3)), abs=1e-5)
    with pytest.raises(TemplateError, match="non-coplanar"):
        node_field(POINTS, NODES * [1, 1, 0], radius)
    with pytest.raises(InputError, match="the radius is too large"):
        node_field(POINTS, NODES, 1e300)


@pytest.mark.parametrize("what", ["displacement", "deformation_gradient", "second_derivative"])
def test_torch_has_gradients_to_vectors_points_nodes_and_radii(what: str) -> None:
    given = [torch.tensor(each, requires_grad=True) for each in (POINTS[:3], NODES, np.full(150, 0.8), VECTORS)]

    def of(points: Any, nodes: Any, radii: Any, vectors: Any) -> torch.Tensor:
        result: torch.Tensor = getattr(node_field(points, nodes, radii), what)(vectors)
        return result

    assert torch.autograd.gradcheck(of, given, fast_mode=True, atol=1e-3)
    assert of(*given).detach().numpy() == pytest.approx(getattr(node_field(POINTS[:3], NODES, 0.8), what)(VECTORS))
    # the gradient to the points is the one in closed form
    moved = of(*given)
    if what == "displacement":
        rows = [torch.autograd.grad(moved[..., a].sum(), given[0], retain_graph=True)[0] for a in range(3)]
        found = node_field(POINTS[:3], NODES, 0.8).gradient(VECTORS)
        assert torch.stack(rows, 1).numpy() == pytest.approx(found)


def test_gradients_are_finite_at_a_node_and_out_of_reach() -> None:
    at = torch.tensor(np.concatenate([NODES[:1] * 0, FAR[-2:]]), requires_grad=True)
    nodes = torch.tensor(np.concatenate([NODES[:1] * 0, NODES]), requires_grad=True)
    for outside in ("mask", "nearest"):
        field = node_field(at, nodes, 0.8, outside=outside)  # type: ignore[arg-type]
        vectors = torch.ones(151, 3, dtype=torch.float64, requires_grad=True)
        total = field.displacement(vectors).sum() + field.second_derivative(vectors).square().sum()
        for each in torch.autograd.grad(total, (at, nodes, vectors)):
            assert each.isfinite().all()


def test_batches_are_what_each_is_alone() -> None:
    many, moves = np.stack([NODES, 1.1 * NODES + 0.01]), np.stack([VECTORS, 2 * VECTORS])
    for what in ("displacement", "gradient", "second_derivative"):
        alone = [getattr(node_field(FAR, nodes, 0.9, outside="nearest"), what) for nodes in many]
        field = getattr(node_field(FAR, many, 0.9, outside="nearest"), what)
        assert field(moves) == pytest.approx(np.stack([f(u) for f, u in zip(alone, moves, strict=True)]))
        assert field(VECTORS) == pytest.approx(np.stack([f(VECTORS) for f in alone]))
        assert alone[0](moves) == pytest.approx(np.stack([alone[0](u) for u in moves]))
        tensor = getattr(node_field(torch.tensor(FAR), torch.tensor(many), 0.9, outside="nearest"), what)
        assert tensor(torch.tensor(moves)).numpy() == pytest.approx(field(moves))


@pytest.mark.parametrize(("points", "vectors", "result"), [
    (np.float32, np.float32, np.float32), (np.float64, np.float32, np.float64),
    (torch.float32, torch.float32, torch.float32), (torch.float32, torch.float64, torch.float64),
    (torch.float16, torch.bfloat16, torch.float32), (np.float64, torch.float32, torch.float64),
    (torch.float32, np.float32, torch.float32), (torch.float32, np.longdouble, torch.float64),
])  # fmt: skip
def test_results_have_the_kind_and_precision_of_both(points: Any, vectors: Any, result: Any) -> None:
    def cast(array: np.ndarray, kind: Any) -> Any:
        return torch.tensor(array).to(kind) if isinstance(kind, torch.dtype) else array.astype(kind)

    found = node_field(cast(POINTS, points), NODES, 0.8).moved(cast(VECTORS, vectors))
    assert found.dtype == result
    assert np.asarray(found) == pytest.approx(node_field(POINTS, NODES, 0.8).moved(VECTORS), abs=0.05)


def test_points_out_of_reach_are_refused_masked_or_carried() -> None:
    with pytest.raises(TemplateError, match="3 points have fewer than four") as caught:
        node_field(FAR, NODES, 0.8)
    assert caught.value.hint
    masked, carried = (node_field(FAR, NODES, 0.8, outside=each) for each in ("mask", "nearest"))
    assert masked.reached.tolist() == carried.reached.tolist() == [True] * 12 + [False] * 3
    assert not masked.displacement(VECTORS)[12:].any() and not masked.gradient(VECTORS)[12:].any()
    assert np.array_equal(masked.deformation_gradient(VECTORS)[12], np.eye(3))
    assert carried.displacement(np.ones((150, 3))) == pytest.approx(np.ones((15, 3)))
    assert carried.displacement(VECTORS)[:12] == pytest.approx(node_field(POINTS, NODES, 0.8).displacement(VECTORS))
    nobody = node_field(FAR[14:], NODES, 0.8, outside="mask")
    assert not nobody.reached.any() and np.array_equal(nobody.moved(VECTORS), FAR[14:])


def test_badly_placed_nodes_are_told() -> None:
    sheet = NODES * [1.0, 1.0, 0.004]
    with pytest.warns(MeshmatchWarning, match="times as much"):
        field = node_field(np.array([[0.0, 0.0, 0.3]]), sheet, 0.8)
    assert field.lebesgue[0] > 50
    with pytest.raises(TemplateError, match="non-coplanar"):
        node_field(POINTS * [1, 1, 0], NODES * [1, 1, 0], 0.8)


@pytest.mark.parametrize(("changes", "error"), [
    ({"points": np.full((2, 3), np.nan)}, InputError), ({"points": np.zeros((2, 2))}, InputError),
    ({"points": np.zeros((0, 3))}, InputError), ({"points": "a"}, InputError), ({"points": np.zeros(3)}, InputError),
    ({"points": torch.full((2, 3), torch.inf)}, InputError), ({"points": torch.eye(3).to_sparse()}, InputError),
    ({"nodes": np.zeros((2, 3, 4))}, InputError), ({"nodes": [[1, 2], [3]]}, InputError), ({"radius": -1.0}, InputError),
    ({"radius": np.ones(3)}, InputError), ({"radius": torch.tensor(torch.nan)}, InputError), ({"radius": None}, InputError),
    ({"points": np.zeros((2, 4, 3)), "nodes": np.stack([NODES] * 3)}, InputError),
    ({"radius": 1e200}, InputError), ({"points": POINTS * 1e-170, "nodes": NODES * 1e-170, "radius": 1e-170}, InputError),
    ({"points": POINTS * 1e200}, InputError), ({"points": np.zeros((0, 5, 3))}, InputError),
    ({"kernel": "gaussian"}, OptionError), ({"kernel": ["smooth"]}, MeshmatchError), ({"outside": "drop"}, OptionError),
])  # fmt: skip
def test_what_no_field_can_be_made_of_is_refused(changes: Any, error: type[MeshmatchError]) -> None:
    given = {"points": POINTS, "nodes": NODES, "radius": 0.8} | changes
    with pytest.raises(error) as caught:
        node_field(given.pop("points"), given.pop("nodes"), given.pop("radius"), **given)
    assert caught.value.hint


def test_a_missing_argument_is_not_called_nan() -> None:
    for given in ((None, NODES, 0.8), (POINTS, None, 0.8), (POINTS, NODES, None)):
        with pytest.raises(InputError, match="must be numbers, not None"):
            node_field(*given)


def test_transforms_of_torch_apply_to_the_vectors_alone() -> None:
    nodes, vectors = torch.tensor(NODES), torch.tensor(VECTORS)
    field = node_field(POINTS, NODES, 0.8)
    both = torch.func.vmap(field.moved)(torch.stack([vectors, 2 * vectors]))
    assert torch.allclose(both[1], field.moved(2 * vectors))
    assert torch.func.jacrev(field.displacement)(vectors).shape == (len(POINTS), 3, len(NODES), 3)
    with pytest.raises(InputError, match=r"points cannot be read inside a transform of torch\.func") as caught:
        torch.func.grad(lambda points: node_field(points, nodes, 0.8).moved(vectors).sum())(torch.tensor(POINTS))
    assert "autograd" in caught.value.hint


def test_vectors_must_be_one_for_each_node() -> None:
    field = node_field(np.stack([POINTS, POINTS]), NODES, 0.8)
    lists: list[Any] = [VECTORS[:-1], VECTORS[0], np.stack([VECTORS] * 3), VECTORS * np.nan, "words", VECTORS[:, :0]]
    tensors = [torch.zeros(3, 150, 3), torch.zeros(150, 3).to_sparse(), torch.zeros(0, 150, 3)]
    for wrong in (*lists, *tensors):
        with pytest.raises(InputError, match="vectors") as caught:
            field.displacement(wrong)
        assert caught.value.hint
    for of in (field.moved, field.deformation_gradient):
        with pytest.raises(InputError, match="3 components"):
            of(VECTORS[:, :2])
    with pytest.raises(AttributeError, match="no attribute"):
        _ = fields.nothing  # type: ignore[attr-defined]


@pytest.mark.parametrize("energy", [volume_energy, arap_energy])
def test_energies_are_of_arrays_and_of_tensors(energy: Any) -> None:
    F = node_field(POINTS, NODES, 0.8).deformation_gradient(VECTORS)
    found, tensor = energy(F), torch.tensor(F, requires_grad=True)
    assert isinstance(found, np.ndarray) and found.shape == (12,) and energy(np.eye(3, dtype=int)) < 1e-5
    assert energy(F.astype(np.float32)).dtype == np.float32
    assert torch.autograd.gradcheck(energy, tensor) and energy(tensor).detach().numpy() == pytest.approx(found)
    for scale in (1, 12):  # the fourth power of 12 is near the largest number in half precision
        half = (scale * F).astype(np.float16)
        exact = energy(half.astype(float))
        limit = np.where(exact < 65504, exact, np.inf)
        for made in (energy(half), energy(torch.from_numpy(half)).numpy()):
            assert made.dtype == np.float16 and made == pytest.approx(limit, rel=1e-3)
    resting = torch.eye(3, dtype=torch.float16, requires_grad=True)
    energy(resting).backward()
    assert resting.grad is not None and (resting.grad == 0).all()
    for wrong in (F[:, :2], torch.zeros(3, 2), "a", 1.0, np.zeros((0, 3))):
        with pytest.raises(InputError, match="deformation gradients"):
            energy(wrong)
