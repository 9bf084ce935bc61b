"""What workers do for a collection: fit one shape, take one step of the agreement with a few, place one shape's vertices.

Each task reads its input from files and writes its result to one file that appears whole, so it can be done again, by
anybody, with the same result bit for bit.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from meshmatch.api.inputs import as_model, validated
from meshmatch.api.matching import Matcher
from meshmatch.arrays import Float, Floats
from meshmatch.collections.fit_files import StoredFit, load_fit, load_words, save_fit
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.fitting.agree import AgreeConfig, Member, agree_step, log_stretch, member_of
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.system import node_system
from meshmatch.maps.places import Places
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.input_files import read_npy
from meshmatch.shapes.shape import Shape

ALONE, AGREEING, FITS = "alone", "agreeing", "fits"
"""Folders of a collection: fits before they agree, what they agree on so far, and finished fits."""
SUFFIX = ".safetensors"
FAILED = "failed"
"""In place of a verdict, for a shape that could not be fitted."""


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
    reasons: str = ""
    residual: float = float("nan")  # units of sqrt(area)
    up: str = ""
    front: str = ""
    vertices: int = 0
    seconds: float = 0.0
    digest: str = ""

    @property
    def fitted(self) -> bool:
        return self.verdict != FAILED


@dataclass(frozen=True)
class Setting:
    """What all tasks of a collection share."""

    store: Store
    model: str  # name or folder
    config: FitConfig
    only: tuple[str, ...] = ()  # of a glb or gltf file, see `load_shape`
    without: tuple[str, ...] = ()
    sequence: bool = False  # shapes of a folder are frames, in the natural order of their names

    @property
    def trained(self) -> TrainedModel:
        """The model, loaded once in each process."""
        return as_model(self.model)

    def read(self, folder: str, name: str) -> StoredFit:
        """A fit of the collection."""
        with self.store.reading(f"{folder}/{name}{SUFFIX}") as path:
            return load_fit(path, self.trained.template)

    def choices(self) -> dict[str, Any]:
        """How shapes are read and fitted, as JSON has it."""
        chosen: dict[str, Any] = {"model": self.model, "only": self.only, "without": self.without}
        chosen |= {"sequence": self.sequence, "fit": asdict(self.config)}
        return dict(json.loads(json.dumps(chosen)))

    def digest(self) -> str:
        """Of all that decides how a shape is fitted."""
        return digest_of(self.trained.template.hash, json.dumps(self.choices(), sort_keys=True))


@dataclass(frozen=True)
class FitTask:
    """One shape to be fitted alone."""

    setting: Setting
    source: Source
    last: Record | None = None  # of the frame before, in a sequence


def fit_alone(task: FitTask) -> Record:
    """Fit one shape, unless that was done before; a frame of a sequence from where the last one's fit ended.

    A shape that cannot be fitted is a record, not an error.
    """
    source, setting = task.source, task.setting
    file, began = f"{ALONE}/{source.name}{SUFFIX}", time.monotonic()
    try:
        digest = digest_of(source.digest(), setting.digest(), "" if task.last is None else task.last.digest)
        known = _known(setting.store, file, digest)
        if known is not None:
            return known
        matcher, shape = Matcher(setting.trained, setting.config, 1), source.load(setting.only, setting.without)
        last = None if task.last is None else setting.read(ALONE, task.last.name).fit
        fit = matcher.fit(shape) if last is None else matcher.follow(shape, last)
        assert fit.repaired is not None
        samples = None
        if _agrees(setting):
            how = AgreeConfig.for_model(setting.trained)
            samples = member_of(node_system(setting.trained), fit.repaired.shape, fit, setting.config, how).samples
        record = Record(
            name=source.name,
            file=source.path,
            verdict=fit.verdict,
            reasons="; ".join(fit.reasons),
            residual=float(fit.residual),
            up=fit.up,
            front=fit.front,
            vertices=fit.repaired.original.V,
            seconds=round(time.monotonic() - began, 3),
            digest=digest,
        )
        words = {"record": asdict(record), "roughness": fit.repaired.shape.roughness}
        with setting.store.writing(file) as path:
            save_fit(path, fit, samples=samples, words=words)
    except MeshmatchError as error:
        return Record(source.name, source.path, reasons=str(error.message))
    return record


def _agrees(setting: Setting) -> bool:
    """Whether fits of this model, refined so, can agree."""
    return setting.config.for_model(setting.trained).moves_nodes


def _known(store: Store, file: str, digest: str) -> Record | None:
    """What is known of a fit that was made before, from the same file and in the same way."""
    if not store.exists(file):
        return None
    try:
        with store.reading(file) as path:
            record = Record(**load_words(path)[1]["record"])
    except (InputError, KeyError, TypeError):
        return None
    return record if record.digest == digest else None


@dataclass(frozen=True)
class Group:
    """A few fits that one task takes a step with."""

    number: int
    names: tuple[str, ...]

    def file(self, step: int) -> str:
        """Where their node vectors are after a step."""
        return f"{AGREEING}/{step}/{self.number}.npy"


@dataclass(frozen=True)
class AgreeTask:
    """One step of the agreement with a few fits; before the first one, their stretch alone."""

    setting: Setting
    group: Group
    step: int


def common_file(step: int) -> str:
    """Where the common stretch is that a step pulls to."""
    return f"{AGREEING}/{step}/common.npy"


def save_array(store: Store, name: str, array: Floats) -> None:
    """Write one array; it appears whole."""
    with store.writing(name) as path, replace_on_success(path) as temporary, temporary.open("wb") as file:
        np.save(file, array)


def _array(store: Store, name: str) -> Floats:
    with store.reading(name) as path:
        return np.asarray(read_npy(path), np.float64)


def agree_a_little(task: AgreeTask) -> Float[Floats, "G 3 3"]:
    """Take a step with some fits; the sum of the logarithms of their stretches where the next step begins.

    Step 0 only gives the sum.
    """
    setting, group, store = task.setting, task.group, task.setting.store
    system, how = node_system(setting.trained), AgreeConfig.for_model(setting.trained)
    members = [_member(setting.read(ALONE, name), how) for name in group.names]
    now = before = np.array([member.vectors for member in members])
    if task.step > 0:
        common = _array(store, common_file(task.step))
        nodes = setting.config.for_model(setting.trained).nodes
        if task.step > 1:
            now = before = _array(store, group.file(task.step - 1))
        if task.step > 2:
            before = _array(store, group.file(task.step - 2))
        elif task.step == 2:
            before = np.array([member.vectors for member in members])
        starts = _starts(members, now, before)
        gradients = [system.deformation_gradient(start) for start in starts]
        before, steps = now, zip(members, starts, gradients, strict=True)
        now = np.array([agree_step(system, nodes, *each, common) for each in steps])
        save_array(store, group.file(task.step), now)
    gradients = [system.deformation_gradient(start) for start in _starts(members, now, before)]
    return np.sum([log_stretch(F) for F in gradients], axis=0)


def _member(read: StoredFit, how: AgreeConfig) -> Member:
    if read.samples is None:
        raise InputError("a fit that should agree has no samples", "remove the folder of fits, and make it again")
    return Member(read.samples, read.fit.vectors, how.for_noise(float(read.words["roughness"])), None, read.fit.partial)


def _starts(members: Sequence[Member], now: Floats, before: Floats) -> list[Floats]:
    """Where a step begins: a little further on along the last one."""
    paths = zip(members, now, before, strict=True)
    return [here + member.config.momentum * (here - last) for member, here, last in paths]


@dataclass(frozen=True)
class FinishTask:
    """One fit to be finished: with the node vectors of the agreement, if it took part."""

    setting: Setting
    source: Source
    digest: str  # of the fit alone
    agreed_with: str  # a digest of all that took part
    group: Group | None = None
    step: int = 0

    @property
    def file(self) -> str:
        """Where the finished fit is."""
        return f"{FITS}/{self.source.name}{SUFFIX}"


def is_finished(store: Store, task: FinishTask) -> bool:
    """Whether the fit is there that the task would make."""
    if not store.exists(task.file):
        return False
    with store.reading(task.file) as path, suppress(InputError):
        words = load_words(path)[1]
        return (words.get("digest"), words.get("agreed_with")) == (task.digest, task.agreed_with)
    return False


def finish(task: FinishTask) -> str:
    """Find the places of a shape's vertices on its fit, unless that was done before; what went wrong, or nothing."""
    setting, name = task.setting, task.source.name
    try:
        if is_finished(setting.store, task):
            return ""
        alone = setting.read(ALONE, name)
        part = validated(task.source.load(setting.only, setting.without))
        before = replace(alone.fit, repaired=part, verts=part.shape.verts)
        fit = before
        if task.group is not None:
            vectors = _array(setting.store, task.group.file(task.step))[task.group.names.index(name)]
            fit = replace(before, vectors=vectors, points=node_system(setting.trained).moved(vectors))
        places = Places.of(part, fit, before if task.group is not None else None)
        words = {"digest": task.digest, "agreed_with": task.agreed_with}
        with setting.store.writing(task.file) as path:
            save_fit(path, fit, places, words=words)
    except MeshmatchError as error:
        return error.message
    return ""
