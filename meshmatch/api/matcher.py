"""From shapes to fits, and from fits to maps: `match`, `register`, and `Matcher` for many shapes."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import CancelledError
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np

from meshmatch.api.direct import are_whole_meshes, match_without_model
from meshmatch.api.inputs import (
    LandmarkPairs,
    UnknownKindsError,
    as_model,
    check_config,
    checked_threads,
    configs_for,
    landmark_vertices,
    refuse_far_parts,
    usable,
    validated,
)
from meshmatch.api.results import MatchResult, maps_of_fits, shape_of
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit import Fit, check_fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter, check_landmarks, fits_with_landmarks
from meshmatch.gathering import Gathering
from meshmatch.maps.build import judged_by_pairs
from meshmatch.maps.places import PlacedFit
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import AUTO, NO_MODEL
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, as_shape, as_shapes, check_list
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map, thread_limit, worker_slot

# So many fits ask the network together, and more would save little, of shapes of so many vertices at most: of larger ones no
# more are in progress than there are threads, for these take memory.
_TOGETHER, _SMALL = 8, 50_000


@dataclass(frozen=True, eq=False)
class _Begun:
    """What choosing the model has done for a shape: a fit, if it took one, and whether parts were tried apart."""

    fit: Fit | None = None
    tried: bool = False


class Matcher:
    """One model for many shapes: fit each of them once, then map between any two of the fits.

    A Matcher can be pickled, for `multiprocessing`, joblib or the workers of a data loader. Its model is loaded again
    by its name or folder where the pickle is opened (`ModelError` if it is missing there, or has other weights);
    ``progress`` is not kept.

    Parameters
    ----------
    model
        Name in the registry, model folder, or what `load_model` returned; with "auto" the first shapes decide; with "none"
        two shapes are matched to each other directly, without a model.
    config
        How all shapes are fitted.
    threads
        How many shapes are fitted at once, each on one thread of the numerical libraries; 2 by default. A spare thread
        helps the other fits and does not change their results. A single shape gets as many threads as are asked for,
        which may change the last bits. The libraries' own limits are restored afterwards.
    progress
        Called with the stage, the name of the shape and the share of the stage that is done (0..1).

    Raises
    ------
    ModelError
        There is no such model, or it is damaged.

    Examples
    --------
    >>> matcher = meshmatch.Matcher("human")
    >>> fits = [matcher.fit(f"templates/samples/{name}.ply") for name in ("climber", "dancer")]
    >>> climber_to_dancer = matcher.map(fits[0], fits[1])
    """

    def __init__(
        self,
        model: str | Path | TrainedModel = AUTO,
        config: FitConfig | None = None,
        threads: int | None = None,
        progress: ProgressCallback | None = None,
    ) -> None:
        self._auto = model == AUTO if isinstance(model, str) else False
        self._direct = model == NO_MODEL if isinstance(model, str) else False
        self._model = None if self._auto or self._direct else as_model(model)
        self._choosing = threading.Lock()
        self.config = FitConfig() if config is None else config
        check_config(self.config)
        self.threads = checked_threads(threads)
        self._asked_threads = threads or 1
        self.progress = progress

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_choosing"} | {"progress": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _choosing=threading.Lock())

    def __repr__(self) -> str:
        return f"Matcher({self._model.card.name if self._model else NO_MODEL if self._direct else AUTO!r})"

    @property
    def model(self) -> TrainedModel:
        """The model; `OptionError` before the first shapes have decided."""
        if self._direct:
            hint = "match two shapes (register --onto), fit a collection (meshmatch fit --model none), or name a model"
            raise OptionError("one shape alone has no fit without a model", hint)
        if self._model is None:
            raise OptionError("no model is chosen yet: the first shape decides", "fit a shape first, or name the model")
        return self._model

    def fit(self, shape: ShapeLike, config: FitConfig | None = None) -> Fit:
        """Fit the model's template to one shape.

        Parameters
        ----------
        shape
            As in `match`.
        config
            How this shape alone is fitted, for example its up axis; by default that of the Matcher.

        Returns
        -------
        Fit
            The template on the shape, with its verdict.

        Raises
        ------
        MeshmatchError
            The shape cannot be read or fitted, or choices contradict each other.
        """
        return self.fit_all([shape], config)[0]

    @overload
    def fit_all(
        self,
        shapes: Sequence[ShapeLike],
        config: FitConfig | Sequence[FitConfig] | None = None,
        *,
        errors: Literal["raise"] = "raise",
    ) -> list[Fit]: ...

    @overload
    def fit_all(
        self,
        shapes: Sequence[ShapeLike],
        config: FitConfig | Sequence[FitConfig] | None = None,
        *,
        errors: Literal["return"],
    ) -> list[Fit | MeshmatchError]: ...

    def fit_all(
        self,
        shapes: Sequence[ShapeLike],
        config: FitConfig | Sequence[FitConfig] | None = None,
        *,
        errors: Literal["raise", "return"] = "raise",
    ) -> list[Fit] | list[Fit | MeshmatchError]:
        """Fit the template to several shapes, some at once.

        Parameters
        ----------
        shapes
            Each as in `match`.
        config
            One for all shapes, or one for each.
        errors
            Where a shape cannot be read or fitted, "raise" stops all others; with "return" its error takes the place of
            its fit. Files are then read one by one, when it is their turn, and ``progress`` is also told how many shapes
            are done (stage "shapes"). For thousands of files, from which a stopped run is to go on, see `Collection`.

        Returns
        -------
        list of Fit
            In the order of the shapes.

        Raises
        ------
        MeshmatchError
            As for `fit`.
        """
        if errors not in ("raise", "return"):
            raise OptionError(f"errors cannot be {errors!r}", "choose raise or return")
        if errors == "return":
            check_list(shapes)
            shapes = list(shapes)
            return self._fit_each(shapes, configs_for(config or self.config, len(shapes)))
        clean = [usable(shape) for shape in as_shapes(shapes)]
        # one fit alone may have all threads that were asked for; several have one each
        inner = self._asked_threads if len(clean) == 1 else 1
        configs = configs_for(config or self.config, len(clean))
        clean, kinds, begun = self._choose(clean, configs)
        fits = self._fit_all(clean, configs, begun, Gathering(len(clean), self.threads, _TOGETHER), inner)
        return [replace(fit, notes=(*kind, *fit.notes)) for kind, fit in zip(kinds, fits, strict=True)]

    def follow(self, shape: ShapeLike, last: Fit) -> Fit:
        """Fit the next frame of a sequence, starting from the fit of the last one; from nothing where tracking is lost.

        Takes half the time of `fit`, and left and right are never exchanged on the way.

        Parameters
        ----------
        shape
            As in `match`, in the same coordinates as the last frame.
        last
            The fit of the last frame.

        Returns
        -------
        Fit
            The template on this frame.

        Raises
        ------
        OptionError
            The last fit is of another template.
        MeshmatchError
            It is no fit; or as for `fit`.
        """
        from meshmatch.fitting.following import follow

        check_fit(last)
        last.check_template(self.model.template.hash)
        clean = validated(as_shape(shape))
        with thread_limit(1):
            found = follow(Fitter(self.model, self.config), clean.shape, last)
            best = self._finished(*self._best(found, clean, self.config), self.config)
            return self._finer(best, self.config, turned=False)

    def dense(self, fit: Fit) -> Shape:
        """The template at its full resolution on the shape of a fit.

        Parameters
        ----------
        fit
            A fit of this model.

        Returns
        -------
        Shape
            In the frame and unit of the shape's file; the same triangles for every fit.
        """
        from meshmatch.fitting.fit import dense_shape

        with thread_limit(1):
            return dense_shape(self.model, fit)

    def map(self, source: Fit, target: Fit, *, agree: bool = True) -> VertexMap:
        """The map from the shape of one fit to the shape of another, both of the same model.

        Parameters
        ----------
        source
            The fit whose vertices get a partner.
        target
            The fit in which the partners are looked for.
        agree
            Refine both fits together first, so that the template stretches alike, as `match` does: a more accurate map,
            and a confidence that knows where the fits disagreed. Without it the fits are only composed, in a tenth of
            the time; so are fits of a `Collection`, which have agreed already, and know the shapes' vertices no more.

        Returns
        -------
        VertexMap
            From the source's vertices to the target's.

        Raises
        ------
        OptionError
            A fit is of another template, or does not hold its shape.
        """
        with thread_limit(1):
            for fit in (source, target):
                if not isinstance(fit, Fit):
                    hint = "fit each shape with Matcher.fit; or call match with the shapes themselves"
                    raise OptionError(f"a map is made from fits, not from {type(fit).__name__}", hint)
            agree = agree and not any(isinstance(fit, PlacedFit) for fit in (source, target))
            fits = self._agreed((source, target)) if agree else (source, target)
            return maps_of_fits(fits, (source, target), self.threads)[0]

    def match(
        self,
        source: ShapeLike,
        target: ShapeLike,
        config: FitConfig | Sequence[FitConfig] | None = None,
        landmarks: LandmarkPairs | None = None,
    ) -> MatchResult:
        """Fit both shapes and map one to the other; parameters and errors are those of `meshmatch.match`.

        Parameters
        ----------
        source
            As in `meshmatch.match`.
        target
            As in `meshmatch.match`.
        config
            One for both shapes, or one for each.
        landmarks
            As in `meshmatch.match`.

        Returns
        -------
        MatchResult
            The map and both fits.
        """
        began = time.monotonic()
        clean = [usable(as_shape(source, "source")), usable(as_shape(target, "target"))]
        configs = configs_for(config or self.config, 2)
        if self._direct:
            return match_without_model(clean, configs, landmarks, self.threads, self.progress)
        try:
            clean, kinds, begun = self._choose(clean, configs)
        except UnknownKindsError:
            return match_without_model(clean, configs, landmarks, self.threads, self.progress, unknown=True)
        if landmarks is not None:
            check_landmarks(self.model)
            pairs = landmark_vertices(clean, landmarks, configs)  # before the long work
        with thread_limit(1):
            fits = self._fit_all(clean, configs, begun, Gathering(2, self.threads))
            known = None
            if landmarks is not None:
                clean = [shape_of(fit) for fit in fits]
                pulled, known = fits_with_landmarks(self.model, clean, fits, pairs, configs)
                fits = [self._finished(*each) for each in zip(pulled, clean, configs, strict=True)]
            before = fits[0], fits[1]
            agreed = self._agreed(before, configs[0], known)
            found, opposite = maps_of_fits(agreed, before, self.threads)
            if landmarks is not None:
                found = judged_by_pairs(found, clean[1].original, pairs, agreed[1].frame.scale)
        notes = tuple(dict.fromkeys((*(words for kind in kinds for words in kind), *fits[0].notes, *fits[1].notes)))
        result = MatchResult(found, *agreed, time.monotonic() - began, notes, before, self.threads, opposite)
        if self._auto and landmarks is None and found.verdict != "good" and are_whole_meshes(clean, agreed):
            with suppress(InputError):  # one that cannot be matched directly has the model's map
                result = match_without_model(clean, configs, None, self.threads, self.progress, guess=result)
        return replace(result, seconds=time.monotonic() - began)

    def _choose(
        self, clean: Sequence[Repaired], configs: Sequence[FitConfig]
    ) -> tuple[list[Repaired], list[tuple[str, ...]], list[_Begun]]:
        """Let the shapes decide on the model, if nobody did. Gives what is fitted of each shape, what is to be said of it,
        and what was done of its fit.
        """
        if not self._auto:
            with thread_limit(1):
                found = [self._near(*each) for each in zip(clean, configs, strict=True)]
            return [each for each, _ in found], [()] * len(clean), [begun for _, begun in found]
        from meshmatch.api.kinds import choose_model

        with self._choosing, thread_limit(1), worker_slot(threading.Semaphore(self.threads)):
            choice = choose_model(clean, configs, self._model, self.progress)
            self._model = choice.model
        begun = [_Begun(*each) for each in zip(choice.fits, choice.tried, strict=True)]
        return choice.clean, [(each,) for each in choice.words], begun

    def _near(self, clean: Repaired, config: FitConfig) -> tuple[Repaired, _Begun]:
        """A shape; of one with parts far apart those that the model knows, with a fit if that took one, or `InputError`."""
        if clean.far_parts:
            from meshmatch.api.apart import find_known_parts

            alone = find_known_parts([lambda: self.model], clean.original, config, progress=self.progress)
            if alone is not None:
                return alone.clean, _Begun(alone.usable_fit(config), True)
        refuse_far_parts(clean)
        return clean, _Begun()

    def _best(
        self, whole: Fit, clean: Repaired, config: FitConfig, progress: ProgressCallback | None = None
    ) -> tuple[Fit, Repaired]:
        """The fit of a shape, or where that is poor the better one of some of its parts; and what it is a fit of."""
        if whole.verdict != "poor":
            return whole, clean
        from meshmatch.api.apart import fit_known_parts

        return fit_known_parts(self.model, clean, config, progress) or (whole, clean)

    def _fit_each(self, shapes: Sequence[ShapeLike], configs: Sequence[FitConfig]) -> list[Fit | MeshmatchError]:
        """What becomes of each shape: a fit or an error."""
        done, counting, stop = 0, threading.Lock(), threading.Event()
        gathering = Gathering(len(shapes), self.threads, _TOGETHER)

        def one(number: int, config: FitConfig) -> Fit | MeshmatchError:
            nonlocal done
            found: Fit | MeshmatchError
            with gathering.task():
                try:
                    clean, kinds, begun = self._choose(
                        [usable(as_shape(shapes[number], f"shape {number + 1}"))], [config]
                    )
                    found = self._fit_one(clean[0], config, begun[0], gathering, stop, clean[0].shape.name)
                    found = replace(found, notes=(*kinds[0], *found.notes))
                except MeshmatchError as error:
                    found = error
            with counting:
                done += 1
                if self.progress is not None:
                    self.progress("shapes", f"{done} of {len(shapes)}", done / len(shapes))
            return found

        with thread_limit(1):
            return parallel_map(one, range(len(shapes)), configs, threads=gathering.in_progress, stop=stop)

    def _fit_all(
        self,
        clean: Sequence[Repaired],
        configs: Sequence[FitConfig],
        begun: Sequence[_Begun],
        gathering: Gathering,
        inner: int = 1,
    ) -> list[Fit]:
        """Fits of a gathering, each with ``inner`` threads of the numerical libraries."""
        stop, names = threading.Event(), [part.shape.name for part in clean]
        labels = [f"{name} ({number + 1})" if names.count(name) > 1 else name for number, name in enumerate(names)]

        def one(here: Repaired, config: FitConfig, begun: _Begun, label: str) -> Fit:
            with gathering.task():
                return self._fit_one(here, config, begun, gathering, stop, label)

        with thread_limit(inner):  # after an error, or Ctrl-C, the other fits end at their next report
            return parallel_map(one, clean, configs, begun, labels, threads=gathering.in_progress, stop=stop)

    def _fit_one(
        self, here: Repaired, config: FitConfig, begun: _Begun, gathering: Gathering, stop: threading.Event, label: str
    ) -> Fit:
        """The fit of a task of the gathering, until ``stop`` is set."""

        def report(stage: str, name: str, share: float) -> None:
            if stop.is_set():
                raise CancelledError
            if self.progress is not None:
                self.progress(stage, label, share)

        with gathering.together() if here.shape.V <= _SMALL else nullcontext():
            found = begun.fit or Fitter(self.model, config, report).fit(here.shape)
        best = (found, here) if begun.tried else self._best(found, here, config, report)
        return self._finer(self._finished(*best, config), config, report)

    def _finished(self, fit: Fit, clean: Repaired, config: FitConfig) -> Fit:
        """The fit with its shape, and with what its user should know."""
        from meshmatch.api.apart import may_contain_known_parts

        whose = f"{clean.shape.name}: " if clean.shape.name else ""
        notes = [f"{whose}{note}" for note in clean.notes]
        if config.for_model(self.model).refine != config.refine:
            notes.append(f"model {self.model.card.name} is pointwise and has no nodes: its code was refined instead")
        if fit.verdict == "poor" and not config.try_harder and may_contain_known_parts(clean, config):
            notes.append(f"{whose}--try-harder (in Python FitConfig(try_harder=True)) searches for longer")
        return replace(fit, repaired=clean, left_out=clean.left_out, notes=(*notes, *fit.notes))

    def _agreed(
        self,
        fits: tuple[Fit, Fit],
        config: FitConfig | None = None,
        known: list[tuple[np.ndarray, np.ndarray]] | None = None,
    ) -> tuple[Fit, Fit]:
        if all(fit.model == NO_MODEL for fit in fits):
            return fits  # they are of one template, and of two shapes alone
        for fit in fits:
            if fit.template_hash != self.model.template.hash:
                wrong = f"this fit is of another template ({fit.template_hash}, not {self.model.template.hash})"
                raise OptionError(wrong, f"fit the shape with the model {self.model.card.name}")
        config = config or replace(self.config, seed=fits[0].seed)
        shapes = [shape_of(fit).shape for fit in fits]
        done = [False, False]  # a finer fit would be lost by agreement
        if not (known or self.model.card.correspondence):
            from meshmatch.fitting.alike import is_finer

            done = [is_finer(self.model, fit) for fit in fits]
        if all(done):
            return fits
        agreed = agreed_fits(self.model, shapes, list(fits), config, known, threads=self.threads)
        first, second = (fit if keep else other for fit, other, keep in zip(fits, agreed, done, strict=True))
        return first, second

    def _finer(self, fit: Fit, config: FitConfig, progress: ProgressCallback | None = None, turned: bool = True) -> Fit:
        """A fit that knows its shape, made finer where no correspondence was learned that this could lose."""
        if self.model.card.correspondence:
            return fit
        from meshmatch.fitting.alike import finer

        return finer(self.model, shape_of(fit).shape, fit, config, progress, turned)
