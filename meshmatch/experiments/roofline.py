"""How near the dearest stages of a match come to what one thread of this machine can do.

Operations and bytes are counted from the shapes of the model's arrays; what the machine can do is measured: a product of
large matrices, and a copy of a large array (bytes read and written). A kernel cannot be quicker than the larger of
operations / product and bytes / copy; the share of its own time that this bound is says what could be gained at most
without fewer operations. Each number is the median CPU time of several runs.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from meshmatch.experiments import runner
from meshmatch.fitting.fit_config import FitConfig, NodeRefineConfig
from meshmatch.fitting.system import NodeSystem, node_system
from meshmatch.geometry.oriented import with_normals
from meshmatch.models.inference import NodeNetwork
from meshmatch.models.registry import load_model
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.threads import thread_limit

_PRODUCT, _COPY = 1500, 1 << 27  # rows of the matrices; bytes
_LEAF = 16  # points in a leaf of SciPy's trees
_MULTIPLY_ADD = 2


@dataclass(frozen=True)
class Kernel:
    """Part of a stage: how many operations and bytes it needs at least, the bytes of its numbers, and itself to be run."""

    name: str
    operations: float
    bytes: float
    itemsize: int
    run: Callable[[], object]


def cpu_seconds(run: Callable[[], object], runs: int) -> float:
    """Median CPU seconds of a call, each of `runs` times measured over a twentieth of a second; one run warms up."""
    run()
    found = []
    for _ in range(runs):
        count, began = 0, time.process_time()
        while not count or time.process_time() - began < 0.05:
            run()
            count += 1
        found.append((time.process_time() - began) / count)
    return statistics.median(found)


def machine(runs: int) -> dict[str, float]:
    """What one thread does: operations a second of a product by the bytes of its numbers, bytes a second of a copy."""
    found = {}
    for kind in (np.float32, np.float64):
        a = np.random.default_rng(0).random((_PRODUCT, _PRODUCT)).astype(kind)
        seconds = cpu_seconds(lambda a=a: a @ a, runs)  # type: ignore[misc]
        found[str(a.itemsize)] = _MULTIPLY_ADD * _PRODUCT**3 / seconds
    source = np.ones(_COPY // 8)
    target = np.empty_like(source)
    return {**found, "copy": 2 * _COPY / cpu_seconds(lambda: np.copyto(target, source), runs)}


def layers(network: NodeNetwork, clouds: int) -> Kernel:
    """All layers that one question about several clouds passes: encoder, decoder, and the corrector several times."""
    passes = {"encoder.network": 1, "decoder.network": 1, "corrector": network.config.corrections}
    operations, moved, inputs = 0.0, 0.0, {}
    for name, times in passes.items():
        matrices = [w for key, w in network.weights.items() if key.startswith(f"{name}.") and w.ndim == 2]
        inputs[name] = np.random.default_rng(0).standard_normal((clouds, matrices[0].shape[1])).astype(np.float32)
        operations += times * clouds * sum(_MULTIPLY_ADD * w.size for w in matrices)
        moved += times * sum(w.nbytes + clouds * sum(w.shape) * w.itemsize for w in matrices)

    def run() -> None:
        for name, times in passes.items():
            for _ in range(times):
                network._residual_mlp(name, inputs[name])

    return Kernel(
        f"network's layers, {clouds} clouds" if clouds > 1 else "network's layers, 1 cloud", operations, moved, 4, run
    )


def pair_search(model: TrainedModel, system: NodeSystem) -> Kernel:
    """Both searches of one Gauss-Newton step: a query reads at least one path down and one leaf of a tree."""
    config = FitConfig()
    rng = np.random.default_rng(0)
    samples = sample_surface(model.template.shape, config.samples, rng)
    surface = system.surface(0.02 * rng.standard_normal((system.K, 3)))
    weight = NodeRefineConfig().pair_normals
    here, there = (with_normals(each.points, each.normals, weight) for each in (surface, samples))
    some, tree = there[:: len(there) // config.nodes.back_points], cKDTree(there)
    D, V, S, B = here.shape[1], len(here), len(there), len(some)

    def query(queries: int, points: int) -> float:
        return queries * (np.log2(points / _LEAF) + 3 * D * _LEAF)

    operations = query(V, S) + query(B, V) + V * np.log2(V / _LEAF)
    moved = 8 * D * (S + 3 * V + B) + 16 * (V + B)

    def run() -> None:
        tree.query(here)
        cKDTree(here).query(some)

    return Kernel(f"pair search, {V} + {B} of {S}", operations, moved, 8, run)


def assembly(system: NodeSystem) -> Kernel:
    """The products of node pairs, each times the six numbers of a weight."""
    products, weights = system.equations.pairs, np.random.default_rng(0).random((len(system.verts), 6))
    operations = 6 * _MULTIPLY_ADD * products.nnz
    moved = products.data.nbytes + products.indices.nbytes + weights.nbytes + 8 * 6 * products.shape[0]
    return Kernel(f"assembly, {products.nnz} products", operations, moved, 8, lambda: products @ weights)


def band_solve(system: NodeSystem) -> Kernel:
    """Cholesky in the band of all unknowns, and both triangles solved."""
    n, w = 3 * system.K, system.equations.band
    matrix = np.random.default_rng(0).standard_normal((w + 1, n))
    matrix[0] = 4 * w
    operations = (n - w) * w**2 + w**3 / 3 + 4 * n * w
    matrix = np.asfortranarray(matrix)

    def run() -> None:
        solveh_banded(matrix.copy(order="F"), np.ones(n), overwrite_ab=True, lower=True, check_finite=False)

    return Kernel(f"band Cholesky, {n} by {w}", operations, 2 * matrix.nbytes, 8, run)


def row_of(kernel: Kernel, able: Mapping[str, float], runs: int) -> dict[str, Any]:
    """A kernel's numbers, its bound, and which of both it is."""
    seconds = cpu_seconds(kernel.run, runs)
    bounds = {"product": kernel.operations / able[str(kernel.itemsize)], "copy": kernel.bytes / able["copy"]}
    limit = max(bounds, key=lambda name: bounds[name])
    return {
        "kernel": kernel.name,
        "mflop": kernel.operations / 1e6,
        "megabytes": kernel.bytes / 1e6,
        "ms": 1e3 * seconds,
        "gflops": kernel.operations / seconds / 1e9,
        "bound_ms": 1e3 * bounds[limit],
        "limit": limit,
        "share": bounds[limit] / seconds,
    }


COLUMNS = {
    **{"kernel": "kernel", "MFLOP": "mflop:.1f", "MB": "megabytes:.1f", "CPU ms": "ms:.2f", "GFLOP/s": "gflops:.1f"},
    **{"bound, ms": "bound_ms:.2f", "by": "limit", "reached": "share:.0%"},
}


def report(runs: int) -> runner.Report:
    """The table of the machine's bounds and of every kernel of the model ``human``."""
    model = load_model("human")
    network, system = model.inference, node_system(model)
    assert isinstance(network, NodeNetwork)
    with thread_limit(1):
        able = machine(runs)
        kernels = [
            layers(network, 24),
            layers(network, 1),
            pair_search(model, system),
            assembly(system),
            band_solve(system),
        ]
        rows = [row_of(kernel, able, runs) for kernel in kernels]
    note = (
        f"one thread: product {able['4'] / 1e9:.0f} GFLOP/s in float32, {able['8'] / 1e9:.0f} in float64; "
        f"copy {able['copy'] / 1e9:.1f} GB/s"
    )
    record = {"gflops_float32": able["4"] / 1e9, "gflops_float64": able["8"] / 1e9, "copy_gb": able["copy"] / 1e9}
    title = f"Dearest stages against the machine, median of {runs} runs"
    return runner.Report({**record, "kernels": rows}, [runner.table(title, rows, COLUMNS)], [note])
