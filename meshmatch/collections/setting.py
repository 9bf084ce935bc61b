"""Data shared by the tasks of a collection: the sources, the setting (model and options), and the record of each fit."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any

from meshmatch.api.inputs import as_model, repair_or_raise
from meshmatch.api.matcher import Matcher
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError, TemplateError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import may_be_part
from meshmatch.fitting.judge.calibration import CALIBRATION, calibration_of
from meshmatch.fitting.same_pose import fit_as_part
from meshmatch.fitting.without_model import fit_without_model
from meshmatch.maps.fit_files import StoredFit, read_fit
from meshmatch.maps.places import PlacedFit
from meshmatch.models.registry import NO_MODEL
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, load_template
from meshmatch.threads import thread_limit

FIRST, SECOND, SINGLE_FITS, AGREEING, FITS = "first", "second", "alone", "agreeing", "fits"
"""Subfolders of a collection: fits to the first and to the second template (without a model); fits before the agreement;
intermediate results of the agreement; and finished fits."""
TEMPLATE, FIRST_TEMPLATE, SECOND_TEMPLATE = "template.safetensors", "first.safetensors", "second.safetensors"
SUFFIX = ".safetensors"
FAILED = "failed"
"""Stands in place of a verdict for a shape that could not be fitted."""
LEFT_OUT = "left out"
"""Stands in place of a verdict for a file among the shapes that is not a shape, such as a table or an image."""


def digest_of(*parts: str | bytes) -> str:
    """Digest of strings or bytes, as 32 hex digits."""
    found = hashlib.blake2b(digest_size=16)
    for part in parts:
        found.update(part if isinstance(part, bytes) else f"{part}\n".encode())
    return found.hexdigest()


@dataclass(frozen=True)
class Source:
    """A shape of a collection: its name there, the folder of its file, and the file's path in that folder."""

    name: str
    folder: Store
    file: str

    def load(self, only: Sequence[str] = (), without: Sequence[str] = ()) -> Shape:
        """Read the shape, under its name in the collection, as `load_shape` does; `InputError` if it cannot be read."""
        with self.folder.reading(self.file) as path:
            return replace(load_shape(path, only=only, without=without), name=self.name)

    @property
    def path(self) -> str:
        """Path or URL of the file."""
        return f"{self.folder.location}/{self.file}"

    def digest(self) -> str:
        """Digest of the file's bytes."""
        with self.folder.reading(self.file) as path:
            try:
                return digest_of(path.read_bytes())
            except OSError as error:
                raise InputError(f"cannot read {path}: {error.strerror}", "check the name") from error


@dataclass(frozen=True)
class Record:
    """The result for one shape: a row of ``fits.csv``."""

    name: str
    file: str
    verdict: str = FAILED  # the fit's verdict, or `FAILED` or `LEFT_OUT`
    trust: float = 0.0
    reasons: str = ""
    residual: float = float("nan")  # units of sqrt(area)
    distance: float = float("nan")  # mean distance between the surfaces, unit of the file
    furthest: float = float("nan")  # largest distance between the surfaces, unit of the file
    inverted: float = float("nan")  # inverted share of the template, see `Regularity`
    volume: float = float("nan")  # mean change of volume, see `Regularity`
    stretch: float = float("nan")  # stretch of the template, see `FitFeatures`
    likely: float = 0.0  # trust of the fit by itself, not capped where correspondence is uncertain
    mirrored: int = 0  # 1 if it was fitted as a mirror image
    side: float = 0.0  # see `Fit.side`
    scale: float = 0.0  # sqrt(area) of a whole shape according to the fit, unit of the file
    up: str = ""
    front: str = ""
    vertices: int = 0
    seconds: float = 0.0
    digest: str = ""
    notes: str = ""  # such as which parts were left out
    kind: str = ""  # kind of the shape, if it is not the model's

    @classmethod
    def of(cls, words: Mapping[str, Any]) -> Record:
        """Build from the metadata stored with a fit; `TypeError` for unknown fields and for values of other types."""
        record = cls(**words)
        for each in fields(cls):
            kind = str if each.default is MISSING else type(each.default)
            if not isinstance(getattr(record, each.name), (float, int) if kind is float else kind):
                raise TypeError(each.name)
        return record

    @property
    def fitted(self) -> bool:
        """Whether there is a fit."""
        return self.verdict not in (FAILED, LEFT_OUT)


@dataclass(frozen=True)
class Setting:
    """Model, template and options that all tasks of a collection share."""

    store: Store
    model: str  # name or folder; or `NO_MODEL`
    config: FitConfig
    only: tuple[str, ...] = ()  # meshes of a glb or gltf file to read, see `load_shape`
    without: tuple[str, ...] = ()
    sequence: bool = False  # shapes of a folder are frames, in the natural order of their names
    template_file: str = TEMPLATE
    template_hash: str = ""

    @property
    def trained(self) -> TrainedModel:
        """The model, loaded once in each process."""
        return as_model(self.model)

    @property
    def template(self) -> Template:
        """The template, read once in each process."""
        found = read_template(self.store, self.template_file)
        if found.hash != self.template_hash:
            raise InputError(
                f"{self.store.location}/{self.template_file} has changed",
                "run `meshmatch fit` again, and one at a time",
            )
        return found

    @property
    def learned(self) -> bool:
        """Whether the model learned correspondences; otherwise fits are judged by comparison with each other."""
        return self.model != NO_MODEL and self.trained.card.correspondence

    @property
    def agrees(self) -> bool:
        """Whether fits with this setting can agree: a trained model moves the nodes of the template."""
        return self.model != NO_MODEL and self.config.for_model(self.trained).moves_nodes

    def read(self, folder: str, name: str) -> StoredFit:
        """Read the fit of a shape from a subfolder of the collection."""
        with self.store.reading(f"{folder}/{name}{SUFFIX}") as path:
            return read_fit(path, self.template)

    def fit(self, shape: Shape, last: Fit | None = None, other_side: bool = False, whole: float | None = None) -> Fit:
        """Fit one shape.

        ``last`` is the fit of the previous frame of a sequence, where the fit starts. ``whole`` is the sqrt(area) of a
        whole shape: a shape with an open boundary is then fitted as a part. ``other_side``, used without a model: fit
        with the opposite handedness to that of the first template's fit.
        """
        if self.model == NO_MODEL:
            part, start, mirror = repair_or_raise(shape), self._find_start(shape.name), self.config.mirror != "no"
            whole = whole if may_be_part(part.shape, self.config) else None
            with thread_limit(1):
                found = fit_without_model(
                    self.template, part.shape, start=start, mirror=mirror, other_side=other_side, whole=whole
                )
            return replace(found, repaired=part)
        if whole is not None:
            part = repair_or_raise(shape)
            with thread_limit(1):
                cut = may_be_part(part.shape, self.config) and fit_as_part(self.trained, part.shape, whole, self.config)
            if cut:
                return replace(cut, repaired=part)
        matcher = Matcher(self.trained, self.config, 1)
        return matcher.fit(shape) if last is None else matcher.follow(shape, last)

    def _find_start(self, name: str) -> Fit | None:
        """Start of a fit to a mean, without a model: the latest fit to an earlier template that is not poor."""
        before = {SECOND_TEMPLATE: 1, TEMPLATE: 2}.get(self.template_file, 0)
        for folder, template in reversed(((FIRST, FIRST_TEMPLATE), (SECOND, SECOND_TEMPLATE))[:before]):
            file = f"{folder}/{name}{SUFFIX}"
            with suppress(InputError):  # it was made with another mean, before shapes were added
                if self.store.exists(file):
                    with self.store.reading(file) as path:
                        found = read_fit(path, read_template(self.store, template)).fit
                    if found.verdict != "poor":
                        return found
        return None

    def choices(self) -> dict[str, Any]:
        """How shapes are read and fitted, as JSON values; without ``try_harder``, which may change between runs."""
        fit = asdict(self.config)
        del fit["try_harder"]
        chosen: dict[str, Any] = {"model": self.model, "only": self.only, "without": self.without}
        chosen |= {"sequence": self.sequence, "fit": fit}
        return dict(json.loads(json.dumps(chosen)))

    def digest(self) -> str:
        """Digest of everything that determines a fit and its verdict: template, options, and calibration.

        The calibration counts where it is not the default one.
        """
        how = "" if self.learned else "compared"
        if self.learned and (judged := calibration_of(self.trained.card.category)) != CALIBRATION:
            how = judged.date
        return digest_of(self.template_hash, json.dumps(self.choices(), sort_keys=True) + how)


def read_template(store: Store, file: str = TEMPLATE) -> Template:
    """Read a template of a collection, once per process, and again if its file has changed.

    `TemplateError` if it is missing or damaged.
    """
    return _template(store, file, store.mtime_ns(file))


@lru_cache(maxsize=4)
def _template(store: Store, file: str, mtime_ns: int) -> Template:
    with store.reading(file) as path:
        try:
            return load_template(path)
        except TemplateError as error:
            problem = f"the template of these fits, {store.location}/{file}, cannot be read: {error.message}"
            raise TemplateError(problem, "remove the folder, and fit again") from error


def read_finished_fit(store: Store, name: str) -> PlacedFit:
    """Read a finished fit, with a cache of 64. Errors as `read_fit`; `InputError` if the fit is not finished."""
    return _read_finished(store, name, store.mtime_ns(f"{FITS}/{name}{SUFFIX}"))


@lru_cache(maxsize=64)
def _read_finished(store: Store, name: str, mtime_ns: int) -> PlacedFit:
    with store.reading(f"{FITS}/{name}{SUFFIX}") as path:
        found = read_fit(path, read_template(store)).fit
    if not isinstance(found, PlacedFit):
        raise InputError(f"the fit of {name} is not finished", "run `meshmatch fit` to its end")
    return found


def clear_caches() -> None:
    """Clear the caches of templates and fits; changes of remote files are not noticed otherwise."""
    _template.cache_clear()
    _read_finished.cache_clear()
