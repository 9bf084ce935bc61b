"""The rows of the comparison (`METHODS`): classical methods by themselves and from our orientation, learned ones, ours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from meshmatch.api.matching import Matcher
from meshmatch.experiments.bench.classical import Registration, ZoomOut
from meshmatch.experiments.bench.methods import Method, OurMethod
from meshmatch.experiments.bench.orientation import upright
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.search.latent import LatentRefineConfig
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import find_model
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True)
class Coded:
    """3D-CODED behind the benchmark's `Method`: its code is refined by the Chamfer distance alone.

    ``model`` is a folder of `meshmatch.experiments.learned_baselines`: its losses had no constraint. ``oriented_by``: a
    model whose unrefined fit finds the orientation, which is then told.
    """

    model: str
    steps: int = 2000
    seed: int = 0
    oriented_by: str = ""

    def fit(self, shape: Shape) -> Fit:
        """Orient, predict, search the code."""
        latent = replace(LatentRefineConfig(steps=self.steps), volume=0.0, arap=0.0)
        config = FitConfig(refine="latent", seed=self.seed, partial="no", latent=latent)
        if self.oriented_by:
            shape = upright(self.oriented_by, shape, self.seed)
            config = replace(config, up="y", front="z")
        return Matcher(self.model, config).fit(shape)

    def map(self, source: Shape, source_fit: Fit, target: Shape, target_fit: Fit) -> VertexMap:
        """Through the template."""
        return Matcher(self.model).map(source_fit, target_fit, agree=False)


@dataclass(frozen=True)
class Baseline:
    """One row of the comparison."""

    name: str  # of its files
    label: str  # for people
    method: Method | None  # None where it cannot run
    missing: str = ""  # why it cannot run
    minutes: float | None = None  # how long it was trained; None for a method that learns nothing
    model: str = ""  # tells its weights from others


@dataclass(frozen=True)
class Choices:
    """The words of the command that methods ask for."""

    model: str = "human"
    coded: str | None = None
    coded_steps: int = 2000
    transmatch: Path | None = None
    seed: int = 0
    threads: int = 1


def _plain(
    choices: Choices, name: str, label: str, method: Registration | ZoomOut, package: str = ""
) -> list[Baseline]:
    """The rows of a method that learns nothing: by itself, and from our orientation; it cannot run without its package."""
    method = replace(method, seed=choices.seed)
    digest = find_model(choices.model)[1].weights_sha256
    rows = [Baseline(name, label, method)]
    oriented = replace(method, oriented_by=choices.model)
    rows.append(Baseline(f"{name}-oriented", f"{label}, our orientation", oriented, model=digest))
    if not package or find_spec(package) is not None:
        return rows
    missing = f"{package} is not installed: pip install 'meshmatch[bench]'"
    return [replace(row, method=None, missing=missing) for row in rows]


def _coded(choices: Choices) -> list[Baseline]:
    if choices.coded is None:
        return [Baseline("coded", "3D-CODED", None, _NOT_GIVEN.format("coded"))]
    card, method = find_model(choices.coded)[1], Coded(choices.coded, choices.coded_steps, choices.seed)
    oriented = replace(method, oriented_by=choices.model)
    told = f"{card.weights_sha256} {find_model(choices.model)[1].weights_sha256}"
    minutes = card.training_minutes
    return [
        Baseline("coded", "3D-CODED", method, "", minutes, card.weights_sha256),
        Baseline("coded-oriented", "3D-CODED, our orientation", oriented, "", minutes, told),
    ]


def _transmatch(choices: Choices) -> list[Baseline]:
    if choices.transmatch is None:
        return [Baseline("transmatch", "TransMatch", None, _NOT_GIVEN.format("transmatch"))]
    from meshmatch.experiments.paper.learned_baselines import TransMatch, load_transmatch

    words = load_transmatch(choices.transmatch).words
    method, minutes = TransMatch(str(choices.transmatch), seed=choices.seed), float(words.get("minutes", 0.0))
    return [Baseline("transmatch", "TransMatch", method, "", minutes, f"{words.get('date')} step {words.get('steps')}")]


def _ours(choices: Choices) -> list[Baseline]:
    card = find_model(choices.model)[1]
    nodes = OurMethod(choices.model, "nodes", choices.seed, threads=choices.threads)
    none = replace(nodes, refine="none")
    rows = ("ours-none", "ours, unrefined", none), ("ours", "ours, refined", nodes)
    return [Baseline(*row, "", card.training_minutes, card.weights_sha256) for row in rows]


_NOT_GIVEN = "give --{0} MODEL, made by python -m meshmatch.experiments.paper.learned_baselines {0}"
METHODS: dict[str, Callable[[Choices], list[Baseline]]] = {
    "rigid": partial(_plain, name="rigid", label="rigid, nearest", method=Registration("rigid")),
    "zoomout": partial(_plain, name="zoomout", label="ZoomOut (pyfmaps)", method=ZoomOut(), package="pyFM"),
    "nricp": partial(
        _plain, name="nricp", label="nricp (trimesh)", method=Registration("nricp", 5000), package="trimesh"
    ),
    "meshmonk": partial(
        _plain, name="meshmonk", label="meshmonk", method=Registration("meshmonk", 20_000), package="meshmonk"
    ),
    "coded": _coded,
    "transmatch": _transmatch,
    "ours": _ours,
}
"""The rows of each method that can be asked for. `ModelError` or `TemplateError` for a model that cannot be read."""
