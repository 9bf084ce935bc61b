"""Tasks of a collection that workers run: fit one shape, take one agreement step for a group of fits, finish one fit.

Each task reads its input from files and writes its result to one file, atomically. It can therefore be repeated by any
worker, with the same result bit for bit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from meshmatch.api.inputs import repair_or_raise
from meshmatch.api.kinds import differing_kind
from meshmatch.arrays import Float, Floats
from meshmatch.collections.compare import Compared
from meshmatch.collections.setting import AGREEING, FITS, SINGLE_FITS, SUFFIX, Record, Setting, Source, digest_of
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.fitting.agree import make_member, with_vectors
from meshmatch.fitting.fitter import mirror_note
from meshmatch.fitting.judge.calibration import calibration_of
from meshmatch.fitting.same_pose import is_refined
from meshmatch.fitting.solve.agreement import AgreeConfig, Member, agree_step, log_stretch
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.fitting.solve.system import node_system
from meshmatch.maps.fit_files import StoredFit, read_fit_header, regularity_of, write_fit
from meshmatch.maps.places import PlacedFit, Places, surface_distance
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.input_files import read_npy
from meshmatch.shapes.parts import leave_out


@dataclass(frozen=True)
class FitTask:
    """One shape to fit on its own; see `Setting.fit` for ``other_side`` and ``whole``."""

    setting: Setting
    source: Source
    last: Record | None = None  # the previous frame, in a sequence
    folder: str = SINGLE_FITS  # subfolder that the fit is written to
    other_side: bool = False
    whole: float | None = None


def fit_alone(task: FitTask) -> Record:
    """Fit one shape, unless its fit exists; a frame of a sequence starts from the fit of the previous frame.

    A shape that cannot be fitted gives a record with the reason, not an error.
    """
    source, setting = task.source, task.setting
    file, began = f"{task.folder}/{source.name}{SUFFIX}", time.monotonic()
    try:
        variant = "" if task.last is None else task.last.digest
        variant += ("other side" if task.other_side else "") + (f"part of {task.whole}" if task.whole else "")
        digest = digest_of(source.digest(), setting.digest(), variant)
        harder = digest_of(digest, "try_harder")
        known = _read_matching_record(setting.store, file, (digest, harder))
        if known is not None and (known.verdict != "poor" or known.digest == harder or not setting.config.try_harder):
            return replace(known, file=source.path)  # the same bytes may have moved
        last = None if task.last is None else setting.read(task.folder, task.last.name).fit
        fit = setting.fit(source.load(setting.only, setting.without), last, task.other_side, task.whole)
        assert fit.repaired is not None
        reasons, other, samples = "; ".join(fit.reasons), "", None
        if fit.verdict == "poor" and setting.model != NO_MODEL:
            other = differing_kind(setting.trained, fit.repaired.shape, setting.config) or ""
            reasons = f"it is of another kind: {other}; {reasons}" if other else reasons
        if setting.agrees:
            how = AgreeConfig.for_collection(setting.trained)
            samples = make_member(node_system(setting.trained), fit.repaired.shape, fit, setting.config, how).samples
        likely, uncertain = fit.trust, setting.model == NO_MODEL or (fit.verdict == "poor" and not setting.learned)
        if fit.signs is not None and not uncertain:
            likely = fit.signs.p_correct(calibration_of(setting.trained.card.category))
        distance, furthest = surface_distance(fit.repaired.shape, fit.shape, fit.partial)
        notes = list(fit.repaired.notes[:1]) if fit.left_out else []
        if setting.model == NO_MODEL:
            notes += fit.notes
        elif fit.frame.mirrored:
            notes.append(mirror_note(setting.trained.card))
        record = Record(
            name=source.name,
            file=source.path,
            verdict=fit.verdict,
            trust=round(fit.trust, 4),
            reasons=reasons,
            residual=float(fit.residual),
            distance=distance,
            furthest=furthest,
            **regularity_fields(fit.regularity),
            stretch=math.nan if fit.signs is None else fit.signs.stretch,
            likely=likely,
            mirrored=int(fit.frame.mirrored),
            side=fit.side,
            scale=fit.frame.scale,
            up=fit.up,
            front=fit.front,
            vertices=fit.repaired.original.V,
            seconds=round(time.monotonic() - began, 3),
            digest=harder if setting.config.try_harder else digest,
            notes="; ".join(notes),
            kind=other,
        )
        words = {"record": asdict(record), "roughness": fit.repaired.shape.roughness}
        with setting.store.writing(file) as path:
            write_fit(path, fit, samples=samples, words=words)
    except MeshmatchError as error:
        return Record(source.name, source.path, reasons=str(error.message))
    return record


def _read_matching_record(store: Store, file: str, digests: Sequence[str]) -> Record | None:
    """Read the record of an existing fit; None if it does not exist or has none of these digests."""
    if not store.exists(file):
        return None
    try:
        with store.reading(file) as path:
            record = Record.of(read_fit_header(path)[1]["record"])
    except (InputError, KeyError, TypeError):
        return None
    return record if record.digest in digests else None


@dataclass(frozen=True)
class Group:
    """The fits of one agreement task; ``agreement`` is the digest of the whole agreement."""

    number: int
    names: tuple[str, ...]
    agreement: str

    def file(self, step: int) -> str:
        """File of their node vectors after a step."""
        return f"{AGREEING}/{self.agreement}/{step}/{self.number}.npy"


@dataclass(frozen=True)
class AgreeTask:
    """One step of the agreement for a group of fits; step 0 only measures their stretch."""

    setting: Setting
    group: Group
    step: int


def common_file(agreement: str, step: int) -> str:
    """File of the common stretch that a step of an agreement pulls towards."""
    return f"{AGREEING}/{agreement}/{step}/common.npy"


def save_array(store: Store, name: str, array: Floats) -> None:
    """Write one array atomically."""
    with store.writing(name) as path, replace_on_success(path) as temporary, temporary.open("wb") as file:
        np.save(file, array)


def load_array(store: Store, name: str) -> Floats:
    """Read one array, as float64."""
    with store.reading(name) as path:
        return np.asarray(read_npy(path), np.float64)


def agree_group(task: AgreeTask) -> Float[Floats, "G 3 3"]:
    """Take one agreement step for a group of fits, unless its result exists.

    Returns the sum over the group of the logarithms of stretch at the G points, where the next step starts. Step 0 moves
    nothing and only returns the sum.
    """
    setting, group, store = task.setting, task.group, task.setting.store
    system, how = node_system(setting.trained), AgreeConfig.for_collection(setting.trained)
    members = [_build_member(setting.read(SINGLE_FITS, name), how) for name in group.names]

    def after(step: int) -> Floats:
        return load_array(store, group.file(step)) if step > 0 else np.array([member.vectors for member in members])

    now, before = after(0), after(max(task.step - 1, 0))
    if task.step > 0 and store.exists(group.file(task.step)):
        now = after(task.step)
    elif task.step > 0:
        common = load_array(store, common_file(group.agreement, task.step))
        starts = _extrapolate(members, before, after(max(task.step - 2, 0)))
        gradients = [system.deformation_gradient(start) for start in starts]
        steps = zip(members, starts, gradients, strict=True)
        now = np.array([agree_step(system, *each, common) for each in steps])
        save_array(store, group.file(task.step), now)
    gradients = [system.deformation_gradient(start) for start in _extrapolate(members, now, before)]
    return np.asarray(np.sum([log_stretch(F) for F in gradients], axis=0))


def _build_member(read: StoredFit, how: AgreeConfig) -> Member:
    """The part of a stored fit that the agreement needs; `InputError` if the fit was stored without samples."""
    roughness = read.words.get("roughness")
    if read.samples is None or type(roughness) is not float:
        raise InputError("a fit that should agree has no samples", "remove the folder of fits, and make it again")
    return Member(
        samples=read.samples,
        vectors=read.fit.vectors,
        config=how.for_noise(roughness),
        landmarks=None,
        partial=read.fit.partial,
    )


def _extrapolate(members: Sequence[Member], now: Floats, before: Floats) -> list[Floats]:
    """Where a step starts: the current node vectors, extrapolated along the last step (momentum)."""
    paths = zip(members, now, before, strict=True)
    return [here + member.config.schedule.momentum * (here - last) for member, here, last in paths]


@dataclass(frozen=True)
class FinishTask:
    """One fit to finish, with the node vectors of the agreement if it took part."""

    setting: Setting
    source: Source
    digest: str  # digest of the fit before the agreement
    agreed_with: str  # digest of the agreement, and what the fit is compared with
    group: Group | None = None
    step: int = 0
    usual: Compared | None = None

    @property
    def file(self) -> str:
        """File of the finished fit."""
        return f"{FITS}/{self.source.name}{SUFFIX}"


def is_finished(store: Store, task: FinishTask) -> bool:
    """Whether the result of the task exists already."""
    if not store.exists(task.file):
        return False
    with store.reading(task.file) as path, suppress(InputError):
        words = read_fit_header(path)[1]
        return (words.get("digest"), words.get("agreed_with")) == (task.digest, task.agreed_with)
    return False


@dataclass(frozen=True)
class Finished:
    """The outcome of a `FinishTask`: verdict, reasons, trust and regularity, or the message of an error."""

    error: str = ""
    verdict: str = ""
    reasons: tuple[str, ...] = ()
    trust: float = 0.0
    regularity: Regularity | None = None


def finish(task: FinishTask) -> Finished:
    """Place the vertices of a shape on its fit and judge it, unless the result exists."""
    try:
        if not is_finished(task.setting.store, task):
            _write_finished_fit(task)
        with task.setting.store.reading(task.file) as path:
            about = read_fit_header(path)[0]
            reasons = tuple(str(sentence) for _, sentence in about["reasons"])
            return Finished("", about["verdict"], reasons, about["trust"], regularity_of(about))
    except MeshmatchError as error:
        return Finished(error.message)


def _write_finished_fit(task: FinishTask) -> None:
    """Judge a fit by comparison, apply the result of the agreement, and store it with the places of its vertices."""
    setting, name = task.setting, task.source.name
    alone = setting.read(SINGLE_FITS, name)
    part = repair_or_raise(leave_out(task.source.load(setting.only, setting.without), alone.fit.left_out))
    before = replace(alone.fit, repaired=part, verts=part.shape.verts)
    if task.usual is not None:
        before = task.usual.judged(before, Record.of(alone.words["record"]))
    fit = before
    group = None if not setting.learned and setting.agrees and is_refined(setting.trained, before) else task.group
    if group is not None:
        vectors = load_array(setting.store, group.file(task.step))[group.names.index(name)]
        system = node_system(setting.trained)
        fit = with_vectors(system, before, system.unfolded(vectors))
    places = Places.of(part, fit, before if group is not None else None)
    words = {"digest": task.digest, "agreed_with": task.agreed_with}
    with setting.store.writing(task.file) as path:
        write_fit(path, PlacedFit.of(fit, places), words=words)


def regularity_fields(regularity: Regularity | None) -> dict[str, Any]:
    """The fields of a `Record` that describe regularity; none if it is not known."""
    return {} if regularity is None else {name: round(value, 5) for name, value in asdict(regularity).items()}
