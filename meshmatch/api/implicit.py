"""`Matcher` for implicit models: a fit is a latent code, and maps go through the implicit template."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from meshmatch.api.inputs import configs_for
from meshmatch.api.results import MatchResult, maps_of_fits
from meshmatch.errors import OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.implicit.codes import fit_implicit
from meshmatch.implicit.fit import ImplicitFit
from meshmatch.implicit.model import ImplicitModel, load_implicit
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit


class ImplicitMatcher:
    """Match shapes with one implicit model; has the methods of `meshmatch.Matcher` that apply to such models."""

    def __init__(
        self,
        model: str | Path | ImplicitModel,
        config: FitConfig | None = None,
        threads: int = 1,
        progress: ProgressCallback | None = None,
    ) -> None:
        self.model = model if isinstance(model, ImplicitModel) else load_implicit(model)
        self.config, self.threads, self.progress = config or FitConfig(), threads, progress

    def fit(self, shape: ShapeLike, config: FitConfig | None = None) -> ImplicitFit:
        return self.fit_all([shape], config)[0]

    def fit_all(
        self, shapes: Sequence[ShapeLike], config: FitConfig | Sequence[FitConfig] | None = None
    ) -> list[ImplicitFit]:
        configs = configs_for(self.config if config is None else config, len(shapes))
        for each in configs:
            refuse_changed(each, ("seed",))
        with thread_limit(1):  # the tensors are small
            return [
                fit_implicit(self.model, shape, seed=each.seed, progress=self.progress)
                for shape, each in zip(shapes, configs, strict=True)
            ]

    def match(
        self,
        source: ShapeLike,
        target: ShapeLike,
        config: FitConfig | Sequence[FitConfig] | None = None,
        landmarks: object = None,
    ) -> MatchResult:
        if landmarks is not None:
            raise OptionError("landmarks do not go with an implicit model", "leave them out")
        began = time.monotonic()
        a, b = self.fit_all([source, target], config)
        with thread_limit(1):
            found, _ = maps_of_fits((a, b), (a, b), self.threads)
        return MatchResult(found, a, b, time.monotonic() - began, (*a.notes, *b.notes), (a, b), self.threads)

    def dense(self, fit: ImplicitFit) -> Shape:
        raise OptionError("an implicit model has no template of a full resolution", "leave out --dense")


def refuse_changed(options: object, allowed: Sequence[str]) -> None:
    """Raise `OptionError` if an option that does not apply to implicit models differs from its default."""
    defaults = type(options)()
    for each in fields(options):  # type: ignore[arg-type]
        if each.name not in allowed and getattr(options, each.name) != getattr(defaults, each.name):
            raise OptionError(f"{each.name} does not go with an implicit model", "leave it out")
