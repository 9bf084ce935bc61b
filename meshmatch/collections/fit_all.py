"""Fit all shapes of a collection in three stages, each run by the workers: fit alone, agree, finish."""

from __future__ import annotations

import csv
import io
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from meshmatch.arrays import Floats
from meshmatch.collections.compare import Compared, opposite_side_names
from meshmatch.collections.select_setting import rebase_on_mean, save_text, select_setting, subsample
from meshmatch.collections.setting import (
    AGREEING,
    FAILED,
    FIRST,
    FITS,
    LEFT_OUT,
    SECOND,
    SECOND_TEMPLATE,
    SINGLE_FITS,
    SUFFIX,
    TEMPLATE,
    Record,
    Setting,
    Source,
    digest_of,
)
from meshmatch.collections.sources import natural_key
from meshmatch.collections.stores import Store
from meshmatch.collections.tasks import (
    AgreeTask,
    Finished,
    FinishTask,
    FitTask,
    Group,
    agree_group,
    common_file,
    finish,
    fit_alone,
    is_finished,
    load_array,
    regularity_fields,
    save_array,
)
from meshmatch.collections.workers import DeadWorkerError, Item, Result, Workers
from meshmatch.errors import InputError, warn
from meshmatch.fitting.reference_statistics import MIN_FAIR_TRUST
from meshmatch.fitting.solve.agreement import AgreeConfig, damped_mean, log_stretch, stretch_of
from meshmatch.fitting.without_model import has_template_pose
from meshmatch.maps.vertex_map import VERDICTS
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import plain_text
from meshmatch.progress import ProgressCallback
from meshmatch.scalars import counted

TABLE = "fits.csv"
COLUMNS = (
    *(
        "name",
        "file",
        "verdict",
        "trust",
        "reasons",
        "residual",
        "distance",
        "furthest",
        "stretch",
        "inverted",
        "volume",
    ),
    *("mirrored", "up", "front", "vertices", "seconds", "notes", "kind"),
)
_MAX_NAMES = 10  # names listed in one message
_MIN_ALIKE = 0.8  # share of shapes in the pose of their mean above which the template gets the finest nodes
_GROUP = 4  # fits per agreement task; fixed, so that rounding of sums does not depend on the number of workers


@dataclass(frozen=True)
class Fitted:
    """The result for every shape of a collection, failed ones included, and the model.

    ``elsewhere`` maps the names of shapes of another kind to the folders of their fits.
    """

    records: tuple[Record, ...]
    agreed: int  # number of fits that took part in an agreement, elsewhere too
    model: str
    elsewhere: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.counts.items() if count)
        return f"Fitted(model {self.model!r}, {counts or 'nothing'}, {len(self.elsewhere)} elsewhere)"

    @property
    def counts(self) -> dict[str, int]:
        """Number of good, fair and poor fits, and of shapes that failed."""
        found = Counter(record.verdict for record in self.records)
        return {verdict: found[verdict] for verdict in (*VERDICTS[:3], FAILED)}


def fit_all(
    setting: Setting,
    sources: Sequence[Source],
    workers: Workers,
    agree: bool = True,
    progress: ProgressCallback | None = None,
    tell: Callable[[Record], None] | None = None,
) -> Fitted:
    """Fit all shapes of a collection; see `Collection.fit`. `InputError` if none can be fitted."""
    report = progress or (lambda stage, name, share: None)
    opposite: set[str] = set()
    cut: dict[str, float] = {}
    if setting.model == NO_MODEL:
        first = _Run(setting, sources, workers, report).fit_alone(None, FIRST)
        cut, opposite = _maybe_partial(first), opposite_side_names(first)
        usual = Compared.of(first)
        setting = _refine_mean_template(
            _Run(setting, sources, workers, report),
            subsample([each.name for each in first if _is_credible(each, usual) and each.name not in opposite]),
        )
    run = _Run(setting, sources, workers, report)
    records = run.fit_alone(tell if setting.learned else None, opposite=opposite, cut=cut)
    if not (setting.learned or setting.model == NO_MODEL) and (cut := _maybe_partial(records)):
        records = run.fit_alone(None, cut=cut)
    fitted = [number for number, record in enumerate(records) if record.fitted]
    if not fitted:
        _write_table(setting.store, records)
        raise InputError(
            f"none of {counted(len(records), 'shape')} could be fitted: {records[0].name}: {records[0].reasons}"
        )
    usual = None if setting.learned else Compared.of(records)
    agreeing = [number for number in fitted if _is_credible(records[number], usual)]
    parts = [f"{records[number].name} {records[number].digest} {records[number].verdict}" for number in fitted]
    how = AgreeConfig.for_collection(setting.trained) if setting.agrees else None
    agreement = digest_of(
        *parts, str(how), *([str(usual)] if usual else [])
    )  # fits agree again if any of this changes, including the reprs of configurations
    groups = run.groups(agreeing, agreement) if agree and setting.agrees and len(agreeing) > 1 else []
    tasks = run.finish_tasks({number: records[number] for number in fitted}, groups, usual)
    if groups and not all(is_finished(setting.store, task) for task in tasks.values()):
        run.agree(groups, len(agreeing))
    for number, done in run.finish(tasks):
        records[number] = _with_outcome(records[number], done)
    if tell is not None and not setting.learned:  # the verdict of each depends on all the fits
        for record in records:
            tell(record)
    setting.store.remove(AGREEING)
    _remove_stale_fits(setting.store, records)
    _write_table(setting.store, records)
    return Fitted(tuple(records), len(agreeing) if groups else 0, setting.model)


def _refine_mean_template(run: _Run, names: Sequence[str]) -> Setting:
    """Replace the template by the mean of the named shapes, estimated twice.

    The first mean is still biased towards the shape that served as the first template, so the shapes are fitted to it
    and averaged again. The final template gets more nodes if nearly all shapes have the pose of the mean, except for
    sequences: a beating heart is tracked to 0.49 mm with fewer nodes, and to 0.67 mm with more.
    """
    setting, alike = rebase_on_mean(run.setting, names, FIRST, SECOND_TEMPLATE), 0
    if names:
        chosen = [source for source in run.sources if source.name in set(names)]
        again = replace(run, setting=setting, sources=chosen).fit_alone(None, SECOND)
        sound = [each for each in again if each.fitted and each.verdict != "poor"]
        alike = sum(has_template_pose(each.residual, each.stretch) for each in sound)
        names = [each.name for each in sound]
    fine = alike > _MIN_ALIKE * len(names) and not setting.sequence
    return rebase_on_mean(setting, names, SECOND, TEMPLATE, fine=fine)


def _maybe_partial(records: Sequence[Record]) -> dict[str, float]:
    """Names of shapes that may be partial, each with the sqrt(area) of a whole shape in the unit of the files."""
    usual = Compared.of(records)
    return {} if usual is None else {each.name: usual.scale for each in records if usual.may_lack(each)}


def fit_all_kinds(
    setting: Setting,
    requested: Setting,
    sources: Sequence[Source],
    workers: Workers,
    agree: bool = True,
    progress: ProgressCallback | None = None,
    tell: Callable[[Record], None] | None = None,
) -> Fitted:
    """Fit all shapes with the model chosen from the first ones, then shapes of another kind with the model of theirs.

    Fits of another kind are in a subfolder named after the kind, and their records name it. ``tell`` gets the record of
    the second fit, or of the first one where the second failed. ``requested`` is the setting as the user gave it, before
    a model was chosen.
    """
    result = fit_all(setting, sources, workers, agree, progress, _skip_other_kinds(tell))
    numbers_by_kind: dict[str, list[int]] = defaultdict(list)
    for number, record in enumerate(result.records):
        if record.kind:
            numbers_by_kind[record.kind].append(number)
    records, agreed, elsewhere = list(result.records), result.agreed, {}
    for kind, numbers in numbers_by_kind.items():
        store, own = Store.of(f"{requested.store.location}/{kind}"), [sources[number] for number in numbers]
        try:
            with store.exclusive():
                setting = select_setting(replace(requested, store=store), own)
                found = fit_all(setting, own, workers, agree, progress, tell)
        except InputError:  # no model can be chosen, or none can be fitted: keep the first fits
            if tell is not None:
                for number in numbers:
                    tell(records[number])
            continue
        agreed += found.agreed
        for number, record in zip(numbers, found.records, strict=True):
            where = f"{kind}: its fit is in {store.location}"
            records[number] = replace(record, kind=kind, notes=f"{where}; {record.notes}".removesuffix("; "))
            if record.fitted:
                elsewhere[record.name] = store.location
    if numbers_by_kind:
        _write_table(requested.store, records)
    return replace(result, records=tuple(records), agreed=agreed, elsewhere=elsewhere)


def _skip_other_kinds(tell: Callable[[Record], None] | None) -> Callable[[Record], None] | None:
    """Wrap ``tell`` to skip shapes of another kind, which are fitted and reported again."""
    return None if tell is None else lambda record: None if record.kind else tell(record)


def with_left_out(result: Fitted, store: Store, left_out: Sequence[Record]) -> Fitted:
    """Add the records of files that were left out, and rewrite the table with them."""
    if not left_out:
        return result
    result = replace(result, records=(*result.records, *left_out))
    _write_table(store, result.records)
    return result


def file_table(store: Store) -> dict[str, str]:
    """Read the file of each shape, by name, from ``fits.csv``; `InputError` if the table is missing or damaged."""
    try:
        with store.reading(TABLE) as path, path.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row.get("verdict") != LEFT_OUT]
            return {str(row.get("name")): str(row.get("file")) for row in rows}
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{store.location}/{TABLE} cannot be read", "run `meshmatch fit` again") from error


def elsewhere_messages(elsewhere: Mapping[str, str]) -> list[str]:
    """Return one message per folder of fits of another kind, with the names of the shapes fitted there."""
    lines = []
    for where in dict.fromkeys(elsewhere.values()):
        names = [name for name in elsewhere if elsewhere[name] == where]
        lines.append(f"{_list_names(names)}: of another kind, see {where}")
    return lines


def _list_names(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    return f"{', '.join(map(plain_text, names[:_MAX_NAMES]))}{more}"


def _remove_stale_fits(store: Store, records: Sequence[Record]) -> None:
    """Remove finished fits of shapes that failed this time or left the collection, with a warning about the latter."""
    fitted = {record.name: record.fitted for record in records}
    names = [file.removesuffix(SUFFIX) for file in store.names(FITS)]
    stale = [name for name in names if not fitted.get(name)]
    for name in stale:
        store.remove(f"{FITS}/{name}{SUFFIX}")
    if gone := [name for name in stale if name not in fitted]:
        why = "no longer in it, for their files are gone or have other names"
        warn(f"{store.location}: {why}: {_list_names(gone)}; give them again to fit them again")


@dataclass(frozen=True)
class _Run:
    """The stages of one run; the workers do everything that takes long."""

    setting: Setting
    sources: Sequence[Source]
    workers: Workers
    report: ProgressCallback

    def _map(
        self, task: Callable[[Item], Result], items: Sequence[Item], stage: str
    ) -> Iterator[tuple[int, Result | DeadWorkerError]]:
        self.report(stage, self.setting.store.location, 0.0)
        for done, (number, result) in enumerate(self.workers.map_unordered(task, items)):
            self.report(stage, self.setting.store.location, (done + 1) / len(items))
            yield number, result

    def fit_alone(
        self,
        tell: Callable[[Record], None] | None,
        folder: str = SINGLE_FITS,
        opposite: Set[str] = frozenset(),
        cut: Mapping[str, float] = MappingProxyType({}),
    ) -> list[Record]:
        """Fit every shape on its own. Frames of a sequence are fitted one after another, several sequences in parallel.

        ``opposite`` names shapes to fit with the opposite handedness to that found before. ``cut`` maps names of shapes
        that may be partial to the sqrt(area) of a whole shape. Returns the records in the order of the sources.
        """
        found: dict[int, Record] = {}
        chains = self._chains()
        for position in range(max(map(len, chains))):
            numbers = [chain[position] for chain in chains if position < len(chain)]
            before = [self._last_fitted(chain[:position], found) for chain in chains if position < len(chain)]
            pairs = zip(numbers, before, strict=True)
            tasks = []
            for number, last in pairs:
                source = self.sources[number]
                how = source.name in opposite, cut.get(source.name)
                tasks.append(FitTask(self.setting, source, last, folder, *how))
            for index, result in self._map(
                fit_alone, tasks, "fitting" if folder == SINGLE_FITS else "choosing the template"
            ):
                source = self.sources[numbers[index]]
                if isinstance(result, DeadWorkerError):
                    result = Record(source.name, source.path, reasons=result.message)
                found[numbers[index]] = result
                if tell is not None:
                    tell(result)
        return [found[number] for number in range(len(self.sources))]

    def _chains(self) -> list[list[int]]:
        """Indices of shapes in chains fitted one after another: one shape each, or the frames of a folder."""
        if not self.setting.sequence:
            return [[number] for number in range(len(self.sources))]
        folders: dict[str, list[int]] = defaultdict(list)
        for number in sorted(range(len(self.sources)), key=lambda number: natural_key(self.sources[number].name)):
            folders[self.sources[number].path.rpartition("/")[0]].append(number)
        return list(folders.values())

    def _last_fitted(self, before: Sequence[int], found: Mapping[int, Record]) -> Record | None:
        """The record of the last frame before that could be fitted."""
        return next((found[number] for number in reversed(before) if found[number].fitted), None)

    def groups(self, numbers: Sequence[int], agreement: str) -> list[Group]:
        """Split the shapes that take part in the agreement into groups, one per task."""
        names = [self.sources[number].name for number in numbers]
        parts = [tuple(names[first : first + _GROUP]) for first in range(0, len(names), _GROUP)]
        return [Group(number, part, agreement) for number, part in enumerate(parts)]

    def finish_tasks(
        self, records: Mapping[int, Record], groups: Sequence[Group], usual: Compared | None
    ) -> dict[int, FinishTask]:
        """Tasks that finish the fits, by number; the digest of the agreement tells whether a fit is finished already."""
        steps = AgreeConfig.for_collection(self.setting.trained).schedule.steps if groups else 0
        group_of = {name: group for group in groups for name in group.names}
        found = {}
        for number, record in records.items():
            own = group_of.get(record.name)
            agreed_with = ("nobody" if own is None else own.agreement) + ("" if usual is None else f" {usual}")
            task = FinishTask(self.setting, self.sources[number], record.digest, agreed_with, own, steps, usual)
            found[number] = task
        return found

    def agree(self, groups: Sequence[Group], count: int) -> None:
        """Take all steps of the agreement that no earlier run took; the cost is linear in the number of fits.

        Sums are accumulated in the order of the groups, so that results do not depend on the order of completion.
        """
        how, store = AgreeConfig.for_collection(self.setting.trained), self.setting.store
        steps, first = how.schedule.steps, common_file(groups[0].agreement, 1)
        for step in range(steps + 1):
            common = common_file(groups[0].agreement, step + 1)
            if store.exists(common):
                continue
            total, next_one = None, 0
            waiting: dict[int, Floats] = {}
            tasks = [AgreeTask(self.setting, group, step) for group in groups]
            for number, result in self._map(agree_group, tasks, f"agreeing, step {step} of {steps}"):
                if isinstance(result, DeadWorkerError):
                    raise result
                waiting[number] = result
                while next_one in waiting:
                    here = waiting.pop(next_one)
                    total, next_one = here if total is None else total + here, next_one + 1
            assert total is not None
            if step < steps:
                mean = total / count
                if step > 0:
                    mean = damped_mean(log_stretch(load_array(store, first)), mean, how)
                save_array(store, common, stretch_of(mean))

    def finish(self, tasks: Mapping[int, FinishTask]) -> Iterator[tuple[int, Finished]]:
        """Place the vertices of every shape; yield (number of the shape, outcome)."""
        numbers = list(tasks)
        for index, done in self._map(finish, list(tasks.values()), "placing vertices"):
            yield numbers[index], Finished(done.message) if isinstance(done, DeadWorkerError) else done


def _with_outcome(alone: Record, done: Finished) -> Record:
    """Update the record of a fit with the outcome of its last stage."""
    if done.error:
        return replace(alone, verdict=FAILED, reasons=done.error)
    known, trust = replace(alone, **regularity_fields(done.regularity)), round(done.trust, 4)
    if (done.verdict, trust) == (alone.verdict, alone.trust):
        return known
    return replace(known, verdict=done.verdict, trust=trust, reasons="; ".join(done.reasons))


def _is_credible(record: Record, usual: Compared | None) -> bool:
    """Whether a fit is not poor, neither by itself nor by comparison with the others."""
    return record.verdict not in ("poor", FAILED) and (usual is None or usual.trust(record) >= MIN_FAIR_TRUST)


def _write_table(store: Store, records: Sequence[Record]) -> None:
    """Write ``fits.csv``, a row for each shape in natural order (frame2 before frame10)."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    ordered = sorted(records, key=lambda record: natural_key(record.name))
    table.writerows([getattr(record, name) for name in COLUMNS] for record in ordered)
    save_text(store, TABLE, text.getvalue())
