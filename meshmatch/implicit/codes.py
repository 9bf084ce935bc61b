"""The code of a shape that no training saw: found by gradient descent on its samples, the network as it is.

As for the shapes of the training (an auto-decoder), there is no encoder. The descent begins with the code of the training
whose distances fit the samples best.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from meshmatch.arrays import Float
from meshmatch.errors import OptionError
from meshmatch.implicit.model import ImplicitFit, ImplicitModel, percent_of_side
from meshmatch.implicit.objective import PUBLISHED, ImplicitLoss
from meshmatch.implicit.samples import is_samples, samples_of
from meshmatch.models.implicit_card import ImplicitCard
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, as_shape

_SAMPLES, _POINTS, _FEW = 8192, 1024, 512  # of the shape, in a step, and to choose where to begin
_RATE = 1e-2  # of codes of length 1
_THIN, _ENOUGH = 0.02, 100  # nearer than this, samples are taken for the surface if there are so many


def fit_implicit(
    model: ImplicitModel, shape: ShapeLike, *, steps: int = 200, seed: int = 0, progress: ProgressCallback | None = None
) -> ImplicitFit:
    """The code of a shape, so that the model's surface is the shape's.

    Parameters
    ----------
    model
        The model.
    shape
        A mesh, a cloud, or the path of one or of ``.npz`` samples (the page on formats), oriented as the shapes of the
        training were. Of meshes that are not watertight only the surface is known, as of clouds.
    steps
        Of the search.
    seed
        The same seed gives the same code.
    progress
        As in `match`.

    Returns
    -------
    ImplicitFit
        The code, and how well the model knows the shape.

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
    if steps < 1:
        raise OptionError(f"a latent code cannot be found in {steps} steps", "200 are usual")
    source = Path(shape) if is_samples(shape) else as_shape(shape)  # type: ignore[arg-type]
    name = Path(source).stem if isinstance(source, str | Path) else source.name or "shape"
    rng = np.random.default_rng(seed)
    frame, found = samples_of(source, _SAMPLES, rng, closed=False)
    rows, half = torch.from_numpy(found), _SAMPLES // 2
    network, loss, rate = model.network, loss_of(model.card), _RATE * model.network.config.length
    generator = torch.Generator().manual_seed(seed)
    code = nearest_code(model, rows[:: _SAMPLES // _FEW]).clone().requires_grad_(True)
    descent = torch.optim.Adam([code], rate)
    for step in range(steps):
        for group in descent.param_groups:
            group["lr"] = rate * (1 - step / steps)
        drawn = rng.integers(half, size=(2, _POINTS // 2))
        some = rows[np.concatenate([drawn[0], drawn[1] + half])]
        total = loss.of(network, code[None], some[None], generator)["total"]
        (code.grad,) = torch.autograd.grad(total, [code])
        descent.step()
        if progress is not None:
            progress("code", name, (step + 1) / steps)
    with torch.no_grad():
        on = rows[:half]
        away = network.distance(on[None, :, :3], code[None])[0][0] - on[:, 3]
    fit = ImplicitFit(name, code.detach(), frame, percent_of_side(float(away.abs().mean())))
    surface = on[on[:, 3].abs() < _THIN, :3].double().numpy()
    if len(surface) < _ENOUGH:
        return fit
    missed, invented = model.shares(fit, surface, seed)
    return replace(fit, missed=missed, invented=invented)


def loss_of(card: ImplicitCard) -> ImplicitLoss:
    """The terms and weights that the model was trained by, as far as they act on a code: DIF-Net's, or the usual ones."""
    known = card.recipe.get("loss")
    return PUBLISHED if isinstance(known, dict) and known.get("published") is True else ImplicitLoss()


@torch.no_grad()
def nearest_code(model: ImplicitModel, rows: Float[torch.Tensor, "P 7"]) -> Float[torch.Tensor, " D"]:
    """The code of the training that fits samples best."""
    network, known = model.network, rows[rows[:, 3].isfinite()]
    errors = [
        (network.distance(known[None, :, :3], code[None])[0][0] - known[:, 3]).abs().mean() for code in network.codes
    ]
    return network.codes[int(torch.stack(errors).argmin())].detach()
