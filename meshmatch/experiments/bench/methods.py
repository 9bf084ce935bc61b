"""What the benchmark measures: the interface of a method, and this project behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from meshmatch.api.inputs import as_model, validated
from meshmatch.api.matching import Matcher
from meshmatch.collections.fit_files import load_fit, save_fit
from meshmatch.experiments.bench.orientation import upright
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import ON_NODES, FitConfig, Partial, Refine
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import make_folder
from meshmatch.shapes.shape import Shape


class Method(Protocol):
    """What is measured: something that fits one shape, and makes a map of two fits. It must survive a pickle."""

    def fit(self, shape: Shape) -> Any:
        """Whatever is worth knowing about one shape."""

    def map(self, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        """The map between two shapes that were fitted."""


@dataclass(frozen=True)
class OurMethod:
    """This project with its options.

    ``oriented_by``: a model whose unrefined fit finds the orientation; then a fit searches only what is left of it.
    ``kept``: a folder of fits, of this method alone; a shape that has one there is not fitted again.
    """

    model: str = "human"
    refine: Refine = "nodes"
    seed: int = 0
    partial: Partial = "auto"
    threads: int = 1
    oriented_by: str = ""  # a model; empty: the fitted model searches by itself
    kept: Path | None = None

    def _matcher(self) -> Matcher:
        config = FitConfig(refine=self.refine, seed=self.seed, partial=self.partial)
        return Matcher(self.model, config, self.threads)

    def fit(self, shape: Shape) -> Fit:
        """Fit the model's template to the shape; `MeshmatchError` of a kept fit of another template, or a damaged one."""
        matcher, config = self._matcher(), None
        path = None if self.kept is None else self.kept / f"{shape.hash}.safetensors"
        if self.oriented_by:
            shape, config = upright(self.oriented_by, shape, self.seed), replace(matcher.config, up="y", front="z")
        if path is not None and path.is_file():
            known, clean = load_fit(path, as_model(self.model).template), validated(shape)
            return replace(known.fit, verts=clean.shape.verts, repaired=clean, seconds=float(known.words["seconds"]))
        fit = matcher.fit(shape, config)
        if path is not None:
            make_folder(path.parent)
            save_fit(path, fit, words={"seconds": fit.seconds})
        return fit

    def map(self, source: Shape, source_fit: Fit, target: Shape, target_fit: Fit) -> VertexMap:
        """Build the map from two fits."""
        return self._matcher().map(source_fit, target_fit, agree=self.refine in ON_NODES)
