"""Compute `meshmatch.models.pair_statistics` of the human model: how fits of one person differ from fits of two.

Generated people with identities not used in training are fitted, each in two poses; the true places of the template are
known. The statistics describe the differences of logarithmic stretches between fits, for the same and for different people,
by their largest principal components. True stretches are those of the most rigid fields that move the template to its true
places.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from scipy.linalg import eigh
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Float, Floats
from meshmatch.experiments import runner
from meshmatch.fitting.solve.agreement import log_stretch
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.generators.bodies import draw_identities, sample_free_pose, template_rig
from meshmatch.generators.rig import skin
from meshmatch.geometry.frames import kabsch
from meshmatch.models.pair_statistics import PairStatistics, flat, save_pair_statistics
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape

_UNSEEN = 77  # seed of the rig's identities; trainings use 0
_FACES = 10_000
_RIGID, _ROUNDS = 1e-3, 4  # weight of rigidity, and number of updates of the local rotations
_PAIRS = 4000  # number of pairs of two people
_SHRINK = 0.1  # shrinkage of covariances towards their diagonals


def true_vectors(
    system: NodeSystem, initial: Float[Floats, "K 3"], places: Float[Floats, "V 3"]
) -> Float[Floats, "K 3"]:
    """Node vectors of the most rigid field that moves the template to ``places``, starting from vectors near them."""
    weights, vectors = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], (len(places), 1)), initial
    for _ in range(_ROUNDS):
        u, _, v = np.linalg.svd(system.deformation_gradient(vectors))
        u[:, :, 2] *= np.sign(np.linalg.det(u @ v))[:, None]
        vectors = system.solve(weights, places, _RIGID, u @ v, 1e-6, np.zeros_like(vectors))
    return vectors


def statistics_of(
    fitted: Float[Floats, "N 2 D"], true: Float[Floats, "N 2 D"], components: int, telling: int, seed: int
) -> PairStatistics:
    """Statistics of N individuals, each in two poses.

    The basis consists of the ``components`` largest principal components of the true stretch; the first ``telling`` of them
    are used to distinguish two individuals from one.
    """
    stacked = true.reshape(-1, true.shape[2])
    basis = np.linalg.svd(stacked - stacked.mean(0), full_matrices=False)[2][:components]
    fitted_scores, true_scores = fitted @ basis.T, true @ basis.T
    difference = (fitted_scores[:, 0] - fitted_scores[:, 1])[:, :telling]
    same = difference.T @ difference / len(difference)
    different = 2 * np.cov(fitted_scores.reshape(-1, len(basis))[:, :telling].T, bias=True)
    same, different = (each + _SHRINK * (np.diag(np.diag(each)) - each) for each in (same, different))
    ratios, discriminant = eigh(different, same)
    rng = np.random.default_rng(seed)
    (a, b), (i, j) = rng.integers(0, len(fitted_scores), (2, _PAIRS)), rng.integers(0, 2, (2, _PAIRS))
    fitted_gap, true_gap = ((each[a, i] - each[b, j])[a != b] for each in (fitted_scores, true_scores))
    return PairStatistics(basis, discriminant.T, ratios, (fitted_gap * true_gap).mean(0) / (fitted_gap**2).mean(0))


@runner.command
def main(
    output: Annotated[Path, Option(help="output file; a model with this file in its folder uses it")],
    people: Annotated[int, Option(min=8, help="number of people to fit, each in two poses")] = 200,
    components: Annotated[int, Option(min=1, help="number of components of differences")] = 64,
    telling: Annotated[int, Option(min=1, help="number of components that distinguish two people")] = 40,
    model: runner.Model = "human",
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    trained, matcher = as_model(model), Matcher(model, threads=threads)
    template, system = trained.template, node_system(trained)
    rig, generator = template_rig(template, 256, _UNSEEN), torch.Generator().manual_seed(seed)
    rest, heads = (each.repeat_interleave(2, 0) for each in draw_identities(rig, people, generator))
    posed = skin(rig, rest, *sample_free_pose(rig, heads, generator)).double().numpy()
    fitted, true = [], []
    for number, verts in enumerate(runner.track(posed, "fitting")):
        body = Shape(verts, template.shape.faces, str(number))
        fit = matcher.fit(decimate(body, _FACES))
        placed = verts / np.sqrt(body.area)
        turn = kabsch(placed, fit.points)
        vectors = true_vectors(system, fit.vectors, placed @ turn.rotation.T + turn.center)
        fitted.append(flat(log_stretch(system.deformation_gradient(fit.vectors))))
        true.append(flat(log_stretch(system.deformation_gradient(vectors))))
    seen, truth = (np.stack(each).reshape(people, 2, -1) for each in (fitted, true))
    statistics = statistics_of(seen, truth, components, telling, seed)
    metadata = {"model": trained.card.name, "people": str(people), "seed": str(seed)}
    save_pair_statistics(statistics, output, metadata)
    rows = [{"people": people, "gain": float(statistics.gains.mean()), "ratio": float(np.median(statistics.ratios))}]
    columns = {"people": "people:d", "mean gain": "gain:.2f", "median ratio": "ratio:.2f"}
    return runner.Report({"rows": rows}, [runner.table("How fits of people differ", rows, columns)])
