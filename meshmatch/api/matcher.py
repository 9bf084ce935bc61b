"""`Matcher`: fit one model to many shapes, and map between any two of the fits."""

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
    repair_allowing_parts,
    repair_or_raise,
)
from meshmatch.api.results import MatchResult, maps_of_fits, shape_of
from meshmatch.batching import CallBatcher
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit import Fit, check_fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter, check_landmarks, refit_with_landmarks
from meshmatch.maps.build import judge_by_pairs
from meshmatch.maps.places import PlacedFit
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import AUTO, NO_MODEL
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, as_shape, as_shapes, check_is_list
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map, thread_limit, worker_slot

# Network evaluations of up to this many fits are batched; more would save little. Fits of shapes with more vertices than the
# second number are not batched, and no more of them run than there are threads, to bound the memory.
_BATCH_SIZE, _MAX_BATCHED_VERTICES = 8, 50_000


@dataclass(frozen=True, eq=False)
class _Preliminary:
    """Work done for a shape while its model was chosen: its fit, if one was needed, and whether its parts were tried."""

    fit: Fit | None = None
    parts_tried: bool = False


class Matcher:
    """One model for many shapes: fit each of them once, then map between any two of the fits.

    A Matcher can be pickled, for `multiprocessing`, joblib or the workers of a data loader. Its model is loaded again
    by its name or folder when it is unpickled (`ModelError` if the model is missing there, or has other weights);
    ``progress`` is not kept.

    Parameters
    ----------
    model
        Name in the registry, model folder, or what `load_model` returned. With "auto", the first shapes decide the model;
        with "none", two shapes are matched to each other directly, without a model.
    config
        How all shapes are fitted, unless a method is given another config.
    threads
        How many shapes are fitted at once, each on one thread of the numerical libraries; 2 by default. An idle thread
        helps the other fits without changing their results. A single shape uses the number of threads given here for its
        numerical libraries, which may change the last bits. The libraries' own limits are restored afterwards.
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
        self._model_lock = threading.Lock()
        self.config = FitConfig() if config is None else config
        check_config(self.config)
        self.threads = checked_threads(threads)
        self._requested_threads = threads or 1
        self.progress = progress

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_model_lock"} | {"progress": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _model_lock=threading.Lock())

    def __repr__(self) -> str:
        return f"Matcher({self._model.card.name if self._model else NO_MODEL if self._direct else AUTO!r})"

    @property
    def model(self) -> TrainedModel:
        """The model. `OptionError` if it is not chosen yet, or the Matcher has none (``model="none"``)."""
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
            How this shape is fitted, for example its up axis; by default the config of the Matcher.

        Returns
        -------
        Fit
            The template on the shape, with its verdict.

        Raises
        ------
        MeshmatchError
            The shape cannot be read or fitted, or options contradict each other.
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
        """Fit the template to several shapes, ``threads`` of them at once.

        Parameters
        ----------
        shapes
            Each as in `match`.
        config
            One for all shapes, or one for each; by default the config of the Matcher.
        errors
            What to do if a shape cannot be read or fitted. "raise" stops all fits; "return" puts the error into the list in
            place of the fit. With "return", each file is read only when it is fitted, and ``progress`` also reports the
            number of finished shapes (stage "shapes"). For thousands of files, and runs that can be resumed, see
            `Collection`.

        Returns
        -------
        list of Fit
            One for each shape, in order; with ``errors="return"``, some may be errors.

        Raises
        ------
        MeshmatchError
            As for `fit`.
        """
        if errors not in ("raise", "return"):
            raise OptionError(f"errors cannot be {errors!r}", "choose raise or return")
        if errors == "return":
            check_is_list(shapes)
            shapes = list(shapes)
            return self._fit_each(shapes, configs_for(config or self.config, len(shapes)))
        clean = [repair_allowing_parts(shape) for shape in as_shapes(shapes)]
        # a single fit may use all requested threads; of several fits, each uses one
        inner = self._requested_threads if len(clean) == 1 else 1
        configs = configs_for(config or self.config, len(clean))
        clean, kind_notes, preliminary = self._choose_model(clean, configs)
        fits = self._fit_all(clean, configs, preliminary, CallBatcher(len(clean), self.threads, _BATCH_SIZE), inner)
        return [replace(fit, notes=(*kind, *fit.notes)) for kind, fit in zip(kind_notes, fits, strict=True)]

    def follow(self, shape: ShapeLike, last: Fit) -> Fit:
        """Fit the next frame of a sequence, starting from the fit of the previous frame.

        Takes half the time of `fit`, and does not swap left and right between frames. If tracking is lost, the shape is
        fitted from scratch, as by `fit`.

        Parameters
        ----------
        shape
            As in `match`, in the same coordinates as the previous frame.
        last
            The fit of the previous frame.

        Returns
        -------
        Fit
            The template on this frame.

        Raises
        ------
        OptionError
            ``last`` is a fit of another template.
        MeshmatchError
            ``last`` is not a `Fit`; or as for `fit`.
        """
        from meshmatch.fitting.tracking import track

        check_fit(last)
        last.check_template(self.model.template.hash)
        clean = repair_or_raise(as_shape(shape))
        with thread_limit(1):
            found = track(Fitter(self.model, self.config), clean.shape, last)
            best = self._with_shape_and_notes(*self._retry_with_parts(found, clean, self.config), self.config)
            return self._refine_further(best, self.config, turned=False)

    def dense(self, fit: Fit) -> Shape:
        """Return the template at its full resolution, deformed by a fit.

        Parameters
        ----------
        fit
            A fit of this model.

        Returns
        -------
        Shape
            The deformed template, in the frame and unit of the shape's file, with the same triangles for every fit.
        """
        from meshmatch.fitting.fit import dense_shape

        with thread_limit(1):
            return dense_shape(self.model, fit)

    def map(self, source: Fit, target: Fit, *, agree: bool = True) -> VertexMap:
        """Compute the map between the shapes of two fits by the same model.

        Parameters
        ----------
        source
            The fit of the shape to map from.
        target
            The fit of the shape to map to.
        agree
            First refine both fits jointly, as `match` does, so that the template stretches alike in both. The map is more
            accurate, and its confidence reflects where the fits disagreed. Without it, the fits are composed as they are,
            in about three quarters of the time. Fits of a `Collection` are always composed: they were refined jointly
            before, and do not contain the shapes any more.

        Returns
        -------
        VertexMap
            From the source's vertices to the target's.

        Raises
        ------
        OptionError
            A fit is of another template, or does not contain its shape.
        """
        with thread_limit(1):
            for fit in (source, target):
                if not isinstance(fit, Fit):
                    hint = "fit each shape with Matcher.fit; or call match with the shapes themselves"
                    raise OptionError(f"a map is made from fits, not from {type(fit).__name__}", hint)
            agree = agree and not any(isinstance(fit, PlacedFit) for fit in (source, target))
            fits = self._refine_jointly((source, target)) if agree else (source, target)
            return maps_of_fits(fits, (source, target), self.threads)[0]

    def match(
        self,
        source: ShapeLike,
        target: ShapeLike,
        config: FitConfig | Sequence[FitConfig] | None = None,
        landmarks: LandmarkPairs | None = None,
    ) -> MatchResult:
        """Fit two shapes and map one to the other; errors are as for `meshmatch.match`.

        Parameters
        ----------
        source
            As in `meshmatch.match`.
        target
            As in `meshmatch.match`.
        config
            One for both shapes, or one for each; by default the config of the Matcher.
        landmarks
            As in `meshmatch.match`.

        Returns
        -------
        MatchResult
            The map and both fits.
        """
        began = time.monotonic()
        clean = [repair_allowing_parts(as_shape(source, "source")), repair_allowing_parts(as_shape(target, "target"))]
        configs = configs_for(config or self.config, 2)
        if self._direct:
            return match_without_model(clean, configs, landmarks, self.threads, self.progress)
        try:
            clean, kind_notes, preliminary = self._choose_model(clean, configs)
        except UnknownKindsError:
            return match_without_model(clean, configs, landmarks, self.threads, self.progress, unknown=True)
        if landmarks is not None:
            check_landmarks(self.model)
            pairs = landmark_vertices(clean, landmarks, configs)  # checked before the fits
        with thread_limit(1):
            fits = self._fit_all(clean, configs, preliminary, CallBatcher(2, self.threads))
            known_pairs = None
            if landmarks is not None:
                clean = [shape_of(fit) for fit in fits]
                guided, known_pairs = refit_with_landmarks(self.model, clean, fits, pairs, configs)
                fits = [self._with_shape_and_notes(*each) for each in zip(guided, clean, configs, strict=True)]
            before = fits[0], fits[1]
            agreed = self._refine_jointly(before, configs[0], known_pairs)
            found, opposite = maps_of_fits(agreed, before, self.threads)
            if landmarks is not None:
                found = judge_by_pairs(found, clean[1].original, pairs, agreed[1].frame.scale)
        notes = tuple(
            dict.fromkeys((*(words for kind in kind_notes for words in kind), *fits[0].notes, *fits[1].notes))
        )
        result = MatchResult(found, *agreed, time.monotonic() - began, notes, before, self.threads, opposite)
        if self._auto and landmarks is None and found.verdict != "good" and are_whole_meshes(clean, agreed):
            with suppress(InputError):  # if the shapes cannot be matched directly, the model's map stays
                result = match_without_model(clean, configs, None, self.threads, self.progress, guess=result)
        return replace(result, seconds=time.monotonic() - began)

    def _choose_model(
        self, clean: Sequence[Repaired], configs: Sequence[FitConfig]
    ) -> tuple[list[Repaired], list[tuple[str, ...]], list[_Preliminary]]:
        """Choose the model by the shapes, unless it is given.

        Return for each shape what is fitted of it (all, or some parts), its notes, and the preliminary work on its fit.
        """
        if not self._auto:
            with thread_limit(1):
                found = [self._select_parts(*each) for each in zip(clean, configs, strict=True)]
            return [each for each, _ in found], [()] * len(clean), [preliminary for _, preliminary in found]
        from meshmatch.api.kinds import choose_model

        with self._model_lock, thread_limit(1), worker_slot(threading.Semaphore(self.threads)):
            choice = choose_model(clean, configs, self._model, self.progress)
            self._model = choice.model
        preliminary = [_Preliminary(*each) for each in zip(choice.fits, choice.parts_tried, strict=True)]
        return choice.clean, [(each,) for each in choice.notes], preliminary

    def _select_parts(self, clean: Repaired, config: FitConfig) -> tuple[Repaired, _Preliminary]:
        """Select the parts that the model knows, if a shape has large parts far apart; `InputError` if there are none.

        Other shapes are returned unchanged.
        """
        if clean.far_parts:
            from meshmatch.api.known_parts import find_known_parts

            alone = find_known_parts([lambda: self.model], clean.original, config, progress=self.progress)
            if alone is not None:
                return alone.clean, _Preliminary(alone.usable_fit(config), True)
        refuse_far_parts(clean)
        return clean, _Preliminary()

    def _retry_with_parts(
        self, whole: Fit, clean: Repaired, config: FitConfig, progress: ProgressCallback | None = None
    ) -> tuple[Fit, Repaired]:
        """Return the fit of a shape, or a better one of some of its parts if it is poor, and the shape that was fitted."""
        if whole.verdict != "poor":
            return whole, clean
        from meshmatch.api.known_parts import fit_known_parts

        return fit_known_parts(self.model, clean, config, progress) or (whole, clean)

    def _fit_each(self, shapes: Sequence[ShapeLike], configs: Sequence[FitConfig]) -> list[Fit | MeshmatchError]:
        """Fit each shape; errors take the place of fits."""
        done, counter_lock, stop = 0, threading.Lock(), threading.Event()
        gathering = CallBatcher(len(shapes), self.threads, _BATCH_SIZE)

        def fit_one(number: int, config: FitConfig) -> Fit | MeshmatchError:
            nonlocal done
            found: Fit | MeshmatchError
            with gathering.task():
                try:
                    clean, kind_notes, preliminary = self._choose_model(
                        [repair_allowing_parts(as_shape(shapes[number], f"shape {number + 1}"))], [config]
                    )
                    found = self._fit_one(clean[0], config, preliminary[0], gathering, stop, clean[0].shape.name)
                    found = replace(found, notes=(*kind_notes[0], *found.notes))
                except MeshmatchError as error:
                    found = error
            with counter_lock:
                done += 1
                if self.progress is not None:
                    self.progress("shapes", f"{done} of {len(shapes)}", done / len(shapes))
            return found

        with thread_limit(1):
            return parallel_map(fit_one, range(len(shapes)), configs, threads=gathering.in_progress, stop=stop)

    def _fit_all(
        self,
        clean: Sequence[Repaired],
        configs: Sequence[FitConfig],
        preliminary: Sequence[_Preliminary],
        gathering: CallBatcher,
        inner: int = 1,
    ) -> list[Fit]:
        """Fit all shapes as tasks of a gathering, each with ``inner`` threads of the numerical libraries."""
        stop, names = threading.Event(), [part.shape.name for part in clean]
        labels = [f"{name} ({number + 1})" if names.count(name) > 1 else name for number, name in enumerate(names)]

        def fit_one(part: Repaired, config: FitConfig, preliminary: _Preliminary, label: str) -> Fit:
            with gathering.task():
                return self._fit_one(part, config, preliminary, gathering, stop, label)

        with thread_limit(inner):  # after an error or Ctrl-C, the other fits stop at their next progress report
            return parallel_map(fit_one, clean, configs, preliminary, labels, threads=gathering.in_progress, stop=stop)

    def _fit_one(
        self,
        clean: Repaired,
        config: FitConfig,
        preliminary: _Preliminary,
        gathering: CallBatcher,
        stop: threading.Event,
        label: str,
    ) -> Fit:
        """Fit one shape as a task of the gathering; cancelled when ``stop`` is set."""

        def report(stage: str, name: str, share: float) -> None:
            if stop.is_set():
                raise CancelledError
            if self.progress is not None:
                self.progress(stage, label, share)

        with gathering.together() if clean.shape.V <= _MAX_BATCHED_VERTICES else nullcontext():
            found = preliminary.fit or Fitter(self.model, config, report).fit(clean.shape)
        best = (found, clean) if preliminary.parts_tried else self._retry_with_parts(found, clean, config, report)
        return self._refine_further(self._with_shape_and_notes(*best, config), config, report)

    def _with_shape_and_notes(self, fit: Fit, clean: Repaired, config: FitConfig) -> Fit:
        """Add to a fit its shape, and notes on repairs and options."""
        from meshmatch.api.known_parts import may_contain_known_parts

        prefix = f"{clean.shape.name}: " if clean.shape.name else ""
        notes = [f"{prefix}{note}" for note in clean.notes]
        if config.for_model(self.model).refine != config.refine:
            notes.append(f"model {self.model.card.name} is pointwise and has no nodes: its code was refined instead")
        if fit.verdict == "poor" and not config.try_harder and may_contain_known_parts(clean, config):
            notes.append(f"{prefix}--try-harder (in Python FitConfig(try_harder=True)) searches longer")
        return replace(fit, repaired=clean, left_out=clean.left_out, notes=(*notes, *fit.notes))

    def _refine_jointly(
        self,
        fits: tuple[Fit, Fit],
        config: FitConfig | None = None,
        known_pairs: list[tuple[np.ndarray, np.ndarray]] | None = None,
    ) -> tuple[Fit, Fit]:
        if all(fit.model == NO_MODEL for fit in fits):
            return fits  # both come from one direct match
        for fit in fits:
            if fit.template_hash != self.model.template.hash:
                wrong = f"this fit is of another template ({fit.template_hash}, not {self.model.template.hash})"
                raise OptionError(wrong, f"fit the shape with the model {self.model.card.name}")
        config = config or replace(self.config, seed=fits[0].seed)
        shapes = [shape_of(fit).shape for fit in fits]
        done = [False, False]  # joint refinement would discard fits that were refined further
        if not (known_pairs or self.model.card.correspondence):
            from meshmatch.fitting.same_pose import is_refined

            done = [is_refined(self.model, fit) for fit in fits]
        if all(done):
            return fits
        agreed = agreed_fits(self.model, shapes, list(fits), config, known_pairs, threads=self.threads)
        first, second = (fit if keep else other for fit, other, keep in zip(fits, agreed, done, strict=True))
        return first, second

    def _refine_further(
        self, fit: Fit, config: FitConfig, progress: ProgressCallback | None = None, turned: bool = True
    ) -> Fit:
        """Refine the fit of a model without learned correspondence with more nodes; other fits stay as they are."""
        if self.model.card.correspondence:
            return fit
        from meshmatch.fitting.same_pose import refine_fit

        return refine_fit(self.model, shape_of(fit).shape, fit, config, progress, turned)
