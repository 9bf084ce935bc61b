"""Find the code of a new shape by gradient descent on its samples, with the network fixed.

There is no encoder (the model is an auto-decoder). The descent starts from the code of the training shape whose distances
fit the samples best. Codes represent one orientation only: a shape in another orientation than the training shapes is
rotated first, by the rotation of the cube after which some training shape fits it best.
"""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import permutations, product
from pathlib import Path

import numpy as np
import torch

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.geometry.frames import Frame
from meshmatch.implicit.fit import ImplicitFit
from meshmatch.implicit.model import ImplicitModel, percent_of_side
from meshmatch.implicit.objective import PUBLISHED, ImplicitLoss
from meshmatch.implicit.samples import load_source, sample_shape
from meshmatch.models.card import ImplicitCard
from meshmatch.progress import ProgressCallback
from meshmatch.scalars import check_seed, is_integer
from meshmatch.shapes.files import ShapeLike, as_shape

# samples of the shape, in one step, and to choose the initial code
_N_SAMPLES, _STEP_SAMPLES, _INITIAL_SAMPLES = 8192, 1024, 512
_RATE = 1e-2  # learning rate of codes of length 1
_TURN_CODES, _TURN_SAMPLES = 32, 256  # training codes, and samples, that are used to choose a rotation
_MAX_ERROR_RATIO = 0.6  # a shape is rotated if that reduces the error below this share; set by hand
# samples nearer than this count as surface points; minimum number of them
_SURFACE_DISTANCE, _MIN_SURFACE_POINTS = 0.02, 100


def fit_implicit(
    model: ImplicitModel, shape: ShapeLike, *, steps: int = 200, seed: int = 0, progress: ProgressCallback | None = None
) -> ImplicitFit:
    """Find the code with which the model's surface is that of a shape.

    Parameters
    ----------
    model
        The model.
    shape
        A mesh, a cloud, or the path of one or of ``.npz`` samples (the page on formats). It is rotated by quarter turns if
        its orientation clearly differs from that of the training shapes; ``notes`` then say so. For meshes that are not
        watertight only the surface is known, as for clouds.
    steps
        Number of steps of the gradient descent.
    seed
        The same seed gives the same code.
    progress
        As in `match`.

    Returns
    -------
    ImplicitFit
        The code, and how well the model represents the shape.

    Raises
    ------
    MeshmatchError
        The shape cannot be read, or has fewer than four points; or steps are below 1.

    Examples
    --------
    >>> model = meshmatch.load_implicit("chair-model")
    >>> chair = meshmatch.fit_implicit(model, "chair.ply")
    >>> chair.verdict, chair.reasons
    """
    if not is_integer(steps, 1):
        raise OptionError(f"a latent code cannot be found in {steps!r} steps", "200 are usual")
    check_seed(seed)
    start = time.monotonic()
    source = load_source(shape) if isinstance(shape, str | Path) else as_shape(shape)
    name = source.name or "shape"
    rng = np.random.default_rng(seed)
    frame, found = sample_shape(source, _N_SAMPLES, rng, closed=False)
    rows, half = torch.from_numpy(found), _N_SAMPLES // 2
    turn = best_turn(model, rows[:: _N_SAMPLES // _TURN_SAMPLES])
    notes: tuple[str, ...] = ()
    if not np.array_equal(turn, np.eye(3)):
        frame, rows = Frame(frame.scale, turn, frame.center), _rotated(rows, turn)
        notes = (f"{name}: rotated, since its orientation is not that of the training shapes: {_axes_text(turn)}",)
    network, loss, rate = model.network, loss_of(model.card), _RATE * model.network.config.length
    generator = torch.Generator().manual_seed(seed)
    code = nearest_code(model, rows[:: _N_SAMPLES // _INITIAL_SAMPLES]).clone().requires_grad_(True)
    descent = torch.optim.Adam([code], rate)
    for step in range(steps):
        for group in descent.param_groups:
            group["lr"] = rate * (1 - step / steps)
        drawn = rng.integers(half, size=(2, _STEP_SAMPLES // 2))
        batch = rows[np.concatenate([drawn[0], drawn[1] + half])]
        total = loss.of(network, code[None], batch[None], generator)["total"]
        (code.grad,) = torch.autograd.grad(total, [code])
        descent.step()
        if progress is not None:
            progress("code", name, (step + 1) / steps)
    with torch.no_grad():
        surface_half = rows[:half]
        errors = network.distance(surface_half[None, :, :3], code[None])[0][0] - surface_half[:, 3]
    fit = ImplicitFit(name, code.detach(), frame, percent_of_side(float(errors.abs().mean())))
    fit = replace(fit, owner=model, source=source, seed=seed, notes=notes)
    surface = surface_half[surface_half[:, 3].abs() < _SURFACE_DISTANCE, :3].double().numpy()
    if len(surface) >= _MIN_SURFACE_POINTS:
        missed, invented = model.shares(fit, surface, seed)
        fit = replace(fit, missed=missed, invented=invented)
    return replace(fit, seconds=time.monotonic() - start)


def loss_of(card: ImplicitCard) -> ImplicitLoss:
    """Loss with which codes of a model are found: DIF-Net's if the model was trained with that, otherwise the default."""
    known = card.recipe.get("loss")
    return PUBLISHED if isinstance(known, dict) and known.get("published") is True else ImplicitLoss()


def nearest_code(model: ImplicitModel, rows: Float[torch.Tensor, "P 7"]) -> Float[torch.Tensor, " D"]:
    """The code of the training shape that fits samples best."""
    return model.network.codes[int(_errors(model, rows, model.network.codes).argmin())].detach()


def best_turn(model: ImplicitModel, rows: Float[torch.Tensor, "P 7"]) -> Float[Floats, "3 3"]:
    """Rotation of the cube after which a training code fits samples best; the identity unless another is clearly better."""
    codes = model.network.codes
    chosen = codes[torch.linspace(0, len(codes) - 1, min(_TURN_CODES, len(codes))).round().long()]
    errors = [float(_errors(model, _rotated(rows, turn), chosen).min()) for turn in TURNS]
    best = int(np.argmin(errors))
    return TURNS[best] if errors[best] < _MAX_ERROR_RATIO * errors[0] else TURNS[0]


def _cube_turns() -> list[Float[Floats, "3 3"]]:
    """The 24 rotations of a cube onto itself, the identity first."""
    signed = (
        np.diag(signs)[:, list(axes)] for axes in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)
    )
    return [matrix for matrix in signed if np.linalg.det(matrix) > 0]


TURNS = _cube_turns()


def _axes_text(turn: Float[Floats, "3 3"]) -> str:
    """Text that says which axes of the file become x, y and z."""
    rows = ("-+"[int(row.sum() > 0)] + "xyz"[int(np.abs(row).argmax())] for row in turn)
    return ", ".join(f"{one} for {axis}" for one, axis in zip(rows, "xyz", strict=True))


def _rotated(rows: Float[torch.Tensor, "P 7"], turn: Float[Floats, "3 3"]) -> Float[torch.Tensor, "P 7"]:
    R = torch.from_numpy(turn).to(rows)
    return torch.cat([rows[:, :3] @ R.T, rows[:, 3:4], rows[:, 4:] @ R.T], 1)


@torch.no_grad()
def _errors(
    model: ImplicitModel, rows: Float[torch.Tensor, "P 7"], codes: Float[torch.Tensor, "S D"]
) -> Float[torch.Tensor, " S"]:
    """Mean absolute error of the signed distances of samples, for each of several codes."""
    known = rows[rows[:, 3].isfinite()]
    predicted = (model.network.distance(known[None, :, :3], code[None])[0][0] for code in codes)
    return torch.stack([(each - known[:, 3]).abs().mean() for each in predicted])
