"""What all tasks of a collection share: its shapes, the way in which they are fitted, and what becomes of each."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any

from meshmatch.api.inputs import as_model, validated
from meshmatch.api.matcher import Matcher
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError
from meshmatch.fitting.alike import as_part
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import may_show_part
from meshmatch.fitting.judge.calibration import CALIBRATION, calibration_of
from meshmatch.fitting.without_model import fit_without_model
from meshmatch.maps.fit_files import StoredFit, read_fit
from meshmatch.maps.places import PlacedFit
from meshmatch.models.registry import NO_MODEL
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, load_template
from meshmatch.threads import thread_limit

FIRST, SECOND, ALONE, AGREEING, FITS = "first", "second", "alone", "agreeing", "fits"
"""Folders of a collection: without a model, fits of the shape that is the first template; fits before they agree; what
they agree on so far; and finished fits."""
TEMPLATE, FIRST_TEMPLATE, SECOND_TEMPLATE = "template.safetensors", "first.safetensors", "second.safetensors"
SUFFIX = ".safetensors"
FAILED = "failed"
"""In place of a verdict, for a shape that could not be fitted."""
LEFT_OUT = "left out"
"""The same for a file beside shapes whose format is that of no shape, such as a table or an image."""


def digest_of(*parts: str | bytes) -> str:
    """A digest of words or bytes, 32 hex digits."""
    found = hashlib.blake2b(digest_size=16)
    for part in parts:
        found.update(part if isinstance(part, bytes) else f"{part}\n".encode())
    return found.hexdigest()


@dataclass(frozen=True)
class Source:
    """One shape of a collection: its name there, the folder where its file lies, and the file's name in it."""

    name: str
    folder: Store
    file: str

    def load(self, only: Sequence[str] = (), without: Sequence[str] = ()) -> Shape:
        """The shape, under its name in the collection, as `load_shape`; `InputError` if it cannot be read."""
        with self.folder.reading(self.file) as path:
            return replace(load_shape(path, only=only, without=without), name=self.name)

    @property
    def path(self) -> str:
        """Where the file lies."""
        return f"{self.folder.location}/{self.file}"

    def digest(self) -> str:
        """Of the file's bytes."""
        with self.folder.reading(self.file) as path:
            try:
                return digest_of(path.read_bytes())
            except OSError as error:
                raise InputError(f"cannot read {path}: {error.strerror}", "check the name") from error


@dataclass(frozen=True)
class Record:
    """What became of one shape: a row of ``fits.csv``."""

    name: str
    file: str
    verdict: str = FAILED  # or that of the fit
    trust: float = 0.0
    reasons: str = ""
    residual: float = float("nan")  # units of sqrt(area)
    distance: float = float("nan")  # of the surfaces, on average and at most, unit of the file
    furthest: float = float("nan")
    inverted: float = float("nan")  # share of the template, and mean change of volume, see `Regularity`
    volume: float = float("nan")
    stretch: float = float("nan")  # of the template, see `FitFeatures`
    likely: float = 0.0  # trust of the fit alone, however little is known of what corresponds
    mirrored: int = 0  # 1 where it was fitted as a mirror image
    side: float = 0.0  # see `Fit.side`
    scale: float = 0.0  # of the fit: sqrt(area) of a whole shape, unit of the file
    up: str = ""
    front: str = ""
    vertices: int = 0
    seconds: float = 0.0
    digest: str = ""
    notes: str = ""  # which parts were left out, if any
    kind: str = ""  # that it is of, if that is another one than the model's

    @classmethod
    def of(cls, words: Mapping[str, Any]) -> Record:
        """As it was kept beside a fit; `TypeError` for other words, and values of other types."""
        record = cls(**words)
        for each in fields(cls):
            kind = str if each.default is MISSING else type(each.default)
            if not isinstance(getattr(record, each.name), (float, int) if kind is float else kind):
                raise TypeError(each.name)
        return record

    @property
    def fitted(self) -> bool:
        return self.verdict not in (FAILED, LEFT_OUT)


@dataclass(frozen=True)
class Setting:
    """What all tasks of a collection share."""

    store: Store
    model: str  # name or folder; or `NO_MODEL`
    config: FitConfig
    only: tuple[str, ...] = ()  # of a glb or gltf file, see `load_shape`
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
        found = template_at(self.store, self.template_file)
        if found.hash != self.template_hash:
            raise InputError(
                f"{self.store.location}/{self.template_file} has changed",
                "run `meshmatch fit` again, and one at a time",
            )
        return found

    @property
    def learned(self) -> bool:
        """Whether a model learned what corresponds; else fits are compared with each other."""
        return self.model != NO_MODEL and self.trained.card.correspondence

    @property
    def agrees(self) -> bool:
        """Whether fits made so can agree: they have nodes, which a trained model moves."""
        return self.model != NO_MODEL and self.config.for_model(self.trained).moves_nodes

    def read(self, folder: str, name: str) -> StoredFit:
        """A fit of the collection."""
        with self.store.reading(f"{folder}/{name}{SUFFIX}") as path:
            return read_fit(path, self.template)

    def fit(self, shape: Shape, last: Fit | None = None, other_side: bool = False, whole: float | None = None) -> Fit:
        """Fit one shape; a frame of a sequence from the last one's fit; or as a part of shapes of that sqrt(area), if it has
        an edge. Without a model perhaps as the other side than the first template's fit took it for.
        """
        if self.model == NO_MODEL:
            part, begun, mirror = validated(shape), self._begun(shape.name), self.config.mirror != "no"
            whole = whole if may_show_part(part.shape, self.config) else None
            with thread_limit(1):
                found = fit_without_model(
                    self.template, part.shape, start=begun, mirror=mirror, other_side=other_side, whole=whole
                )
            return replace(found, repaired=part)
        if whole is not None:
            part = validated(shape)
            with thread_limit(1):
                cut = may_show_part(part.shape, self.config) and as_part(self.trained, part.shape, whole, self.config)
            if cut:
                return replace(cut, repaired=part)
        matcher = Matcher(self.trained, self.config, 1)
        return matcher.fit(shape) if last is None else matcher.follow(shape, last)

    def _begun(self, name: str) -> Fit | None:
        """Without a model, where a mean begins: the last fit of a template before it, if that is to be believed."""
        before = {SECOND_TEMPLATE: 1, TEMPLATE: 2}.get(self.template_file, 0)
        for folder, template in reversed(((FIRST, FIRST_TEMPLATE), (SECOND, SECOND_TEMPLATE))[:before]):
            file = f"{folder}/{name}{SUFFIX}"
            with suppress(InputError):  # one of a mean of other shapes, before some were added
                if self.store.exists(file):
                    with self.store.reading(file) as path:
                        found = read_fit(path, template_at(self.store, template)).fit
                    if found.verdict != "poor":
                        return found
        return None

    def choices(self) -> dict[str, Any]:
        """How shapes are read and fitted, as JSON has it. How long poor fits are searched for may change later."""
        fit = asdict(self.config)
        del fit["try_harder"]
        chosen: dict[str, Any] = {"model": self.model, "only": self.only, "without": self.without}
        chosen |= {"sequence": self.sequence, "fit": fit}
        return dict(json.loads(json.dumps(chosen)))

    def digest(self) -> str:
        """Of all that decides how a shape is fitted, and by what weights the fit is judged, where these are no people's."""
        how = "" if self.learned else "compared"
        if self.learned and (judged := calibration_of(self.trained.card.category)) != CALIBRATION:
            how = judged.date
        return digest_of(self.template_hash, json.dumps(self.choices(), sort_keys=True) + how)


def template_at(store: Store, file: str = TEMPLATE) -> Template:
    """A template of a collection, read once in each process, and again when it has changed."""
    return _template(store, file, store.changed(file))


@lru_cache(maxsize=4)
def _template(store: Store, file: str, changed: int) -> Template:
    with store.reading(file) as path:
        return load_template(path)


def finished_fit(store: Store, name: str) -> PlacedFit:
    """A finished fit; some are kept in memory. Errors as `read_fit`."""
    return _finished(store, name, store.changed(f"{FITS}/{name}{SUFFIX}"))


@lru_cache(maxsize=64)
def _finished(store: Store, name: str, changed: int) -> PlacedFit:
    with store.reading(f"{FITS}/{name}{SUFFIX}") as path:
        found = read_fit(path, template_at(store)).fit
    if not isinstance(found, PlacedFit):
        raise InputError(f"the fit of {name} is not finished", "run `meshmatch fit` to its end")
    return found


def forget() -> None:
    """Read templates and fits again, for remote ones may have changed."""
    _template.cache_clear()
    _finished.cache_clear()
