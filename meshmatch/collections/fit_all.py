"""All shapes of a collection: fitted alone, agreed, and finished; each stage by whatever workers there are."""

from __future__ import annotations

import csv
import io
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from meshmatch.arrays import Floats
from meshmatch.collections.compare import Compared, on_the_other_side
from meshmatch.collections.setting import (
    AGREEING,
    ALONE,
    FAILED,
    FIRST,
    FITS,
    LEFT_OUT,
    SECOND,
    SECOND_TEMPLATE,
    SUFFIX,
    TEMPLATE,
    Record,
    Setting,
    Source,
    digest_of,
)
from meshmatch.collections.settle import on_the_mean, save_text, settled, some_of
from meshmatch.collections.sources import natural
from meshmatch.collections.stores import Store
from meshmatch.collections.tasks import (
    AgreeTask,
    Finished,
    FinishTask,
    FitTask,
    Group,
    agree_a_little,
    common_file,
    finish,
    fit_alone,
    is_finished,
    load_array,
    regularity_words,
    save_array,
)
from meshmatch.collections.workers import Died, Item, Result, Workers
from meshmatch.errors import InputError, warn
from meshmatch.fitting.solve.agreement import AgreeConfig, held_mean, log_stretch, stretch_of
from meshmatch.fitting.usual import FAIR
from meshmatch.fitting.without_model import stand_alike
from meshmatch.maps.vertex_map import VERDICTS
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import plain_text
from meshmatch.progress import ProgressCallback

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
_MOST_NAMED = 10  # in one line
_MOST_ALIKE = 0.8  # share of shapes that stand as their mean does
_GROUP = 4  # fits that one task of the agreement takes a step with: fixed, for sums must not depend on the workers


@dataclass(frozen=True)
class Fitted:
    """What became of every shape of a collection, also of those that could not be fitted; and with which model.

    ``elsewhere`` are names of shapes of another kind, and the folders of their fits.
    """

    records: tuple[Record, ...]
    agreed: int  # fits that took part in the agreement
    model: str
    elsewhere: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.counts.items() if count)
        return f"Fitted(model {self.model!r}, {counts or 'nothing'}, {len(self.elsewhere)} elsewhere)"

    @property
    def counts(self) -> dict[str, int]:
        """How many fits are good, fair or poor, and how many shapes failed."""
        found = Counter(record.verdict for record in self.records)
        return {verdict: found[verdict] for verdict in (*VERDICTS[:3], FAILED)}


def fit_all(
    setting: Setting,
    sources: Sequence[Source],
    crew: Workers,
    agree: bool = True,
    progress: ProgressCallback | None = None,
    tell: Callable[[Record], None] | None = None,
) -> Fitted:
    """Fit all shapes of a collection; see `Collection.fit`."""
    report = progress or (lambda stage, name, share: None)
    others: set[str] = set()
    cut: dict[str, float] = {}
    if setting.model == NO_MODEL:
        first = _Run(setting, sources, crew, report).fit_alone(None, FIRST)
        cut, others = _perhaps_cut(first), on_the_other_side(first)
        usual = Compared.of(first)
        setting = _on_the_mean(
            _Run(setting, sources, crew, report),
            some_of([each.name for each in first if _believed(each, usual) and each.name not in others]),
        )
    run = _Run(setting, sources, crew, report)
    records = run.fit_alone(tell if setting.learned else None, others=others, cut=cut)
    if not (setting.learned or setting.model == NO_MODEL) and (cut := _perhaps_cut(records)):
        records = run.fit_alone(None, cut=cut)
    fitted = [number for number, record in enumerate(records) if record.fitted]
    if not fitted:
        _write_table(setting.store, records)
        raise InputError(f"none of {len(records)} shapes could be fitted: {records[0].name}: {records[0].reasons}")
    usual = None if setting.learned else Compared.of(records)
    agreeing = [number for number in fitted if _believed(records[number], usual)]
    parts = [f"{records[number].name} {records[number].digest} {records[number].verdict}" for number in fitted]
    how = AgreeConfig.for_collection(setting.trained) if setting.agrees else None
    everybody = digest_of(
        *parts, str(how), *([str(usual)] if usual else [])
    )  # fits that agreed in another way agree again
    groups = run.groups(agreeing, everybody) if agree and setting.agrees and len(agreeing) > 1 else []
    tasks = run.last_tasks({number: records[number] for number in fitted}, groups, usual)
    if groups and not all(is_finished(setting.store, task) for task in tasks.values()):
        run.agree(groups, len(agreeing))
    for number, done in run.finish(tasks):
        records[number] = _finished(records[number], done)
    if tell is not None and not setting.learned:  # what is thought of one depends on all
        for record in records:
            tell(record)
    setting.store.remove(AGREEING)
    _drop_others(setting.store, records)
    _write_table(setting.store, records)
    return Fitted(tuple(records), len(agreeing) if groups else 0, setting.model)


def _on_the_mean(run: _Run, names: Sequence[str]) -> Setting:
    """The setting with the mean of some shapes as the template, estimated anew from fits of a first mean, which still leans
    towards the shape that was the template before. It has more nodes where nearly all of these stand alike, but for the
    frames of a sequence: a beating heart is tracked to 0.49 mm with fewer, and to 0.67 with more.
    """
    setting, alike = on_the_mean(run.setting, names, FIRST, SECOND_TEMPLATE), 0
    if names:
        chosen = [source for source in run.sources if source.name in set(names)]
        again = replace(run, setting=setting, sources=chosen).fit_alone(None, SECOND)
        sound = [each for each in again if each.fitted and each.verdict != "poor"]
        alike = sum(stand_alike(each.residual, each.stretch) for each in sound)
        names = [each.name for each in sound]
    fine = alike > _MOST_ALIKE * len(names) and not setting.sequence
    return on_the_mean(setting, names, SECOND, TEMPLATE, fine=fine)


def _perhaps_cut(records: Sequence[Record]) -> dict[str, float]:
    """Names of shapes that may be parts, and the sqrt(area) of a whole one."""
    usual = Compared.of(records)
    return {} if usual is None else {each.name: usual.scale for each in records if usual.may_lack(each)}


def fit_all_kinds(
    setting: Setting,
    wish: Setting,
    sources: Sequence[Source],
    crew: Workers,
    agree: bool = True,
    progress: ProgressCallback | None = None,
    tell: Callable[[Record], None] | None = None,
) -> Fitted:
    """Fit all shapes by the model that the first of them decided on, and those of another kind by theirs. ``wish`` is the
    setting before that."""
    made = fit_all(setting, sources, crew, agree, progress, _of_this_kind(tell))
    return _fit_other_kinds(made, wish, sources, crew, agree, progress, tell)


def _fit_other_kinds(
    made: Fitted,
    wish: Setting,
    sources: Sequence[Source],
    crew: Workers,
    agree: bool = True,
    progress: ProgressCallback | None = None,
    tell: Callable[[Record], None] | None = None,
) -> Fitted:
    """Fit shapes that are of another kind than the model by the model of their own, in a folder of that name within the
    folder of all; the records say so then. ``wish`` is as it was before the first shapes decided on a model. Their first
    fits are told only where those stay.
    """
    others: dict[str, list[int]] = defaultdict(list)
    for number, record in enumerate(made.records):
        if record.kind:
            others[record.kind].append(number)
    records, elsewhere = list(made.records), {}
    for kind, numbers in others.items():
        store, own = Store.of(f"{wish.store.location}/{kind}"), [sources[number] for number in numbers]
        try:
            with store.alone():
                setting = settled(replace(wish, store=store), own)
                found = fit_all(setting, own, crew, agree, progress, tell)
        except InputError:  # of kinds that change their mind: the first fits stay
            if tell is not None:
                for number in numbers:
                    tell(records[number])
            continue
        for number, record in zip(numbers, found.records, strict=True):
            where = f"{kind}: its fit is in {store.location}"
            records[number] = replace(record, kind=kind, notes=f"{where}; {record.notes}".removesuffix("; "))
            if record.fitted:
                elsewhere[record.name] = store.location
    if others:
        _write_table(wish.store, records)
    return replace(made, records=tuple(records), elsewhere=elsewhere)


def _of_this_kind(tell: Callable[[Record], None] | None) -> Callable[[Record], None] | None:
    """Tells of shapes that are not of another kind: those are fitted again, and told then."""
    return None if tell is None else lambda record: None if record.kind else tell(record)


def with_left_out(made: Fitted, store: Store, left_out: Sequence[Record]) -> Fitted:
    """The same with files that were not taken; the table has their rows."""
    if not left_out:
        return made
    made = replace(made, records=(*made.records, *left_out))
    _write_table(store, made.records)
    return made


def files_of(store: Store) -> dict[str, str]:
    """The file of each shape, by its name, as ``fits.csv`` has them; `InputError` if it is missing or damaged."""
    try:
        with store.reading(TABLE) as path, path.open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row.get("verdict") != LEFT_OUT]
            return {str(row.get("name")): str(row.get("file")) for row in rows}
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{store.location}/{TABLE} cannot be read", "run `meshmatch fit` again") from error


def elsewhere_words(elsewhere: Mapping[str, str]) -> list[str]:
    """A line for each folder of fits of another kind: which names are there."""
    lines = []
    for where in dict.fromkeys(elsewhere.values()):
        names = [name for name in elsewhere if elsewhere[name] == where]
        lines.append(f"{_named(names)}: of another kind, see {where}")
    return lines


def _named(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return f"{', '.join(map(plain_text, names[:_MOST_NAMED]))}{more}"


def _drop_others(store: Store, records: Sequence[Record]) -> None:
    """Remove finished fits of shapes that failed now, or are no longer there: these are named."""
    fitted = {record.name: record.fitted for record in records}
    names = [file.removesuffix(SUFFIX) for file in store.names(FITS)]
    others = [name for name in names if not fitted.get(name)]
    for name in others:
        store.remove(f"{FITS}/{name}{SUFFIX}")
    if gone := [name for name in others if name not in fitted]:
        why = "no longer in it, for their files are gone or have other names"
        warn(f"{store.location}: {why}: {_named(gone)}; shapes that are given again join it again")


@dataclass(frozen=True)
class _Run:
    """The stages of one run, in which workers do all that takes long."""

    setting: Setting
    sources: Sequence[Source]
    crew: Workers
    report: ProgressCallback

    def _each(
        self, task: Callable[[Item], Result], items: Sequence[Item], stage: str
    ) -> Iterator[tuple[int, Result | Died]]:
        self.report(stage, self.setting.store.location, 0.0)
        for done, (number, result) in enumerate(self.crew.each(task, items)):
            self.report(stage, self.setting.store.location, (done + 1) / len(items))
            yield number, result

    def fit_alone(
        self,
        tell: Callable[[Record], None] | None,
        folder: str = ALONE,
        others: Set[str] = frozenset(),
        cut: Mapping[str, float] = MappingProxyType({}),
    ) -> list[Record]:
        """Fit every shape on its own; the frames of a sequence one after the other, of several sequences beside each
        other. ``others`` are names of shapes to be fitted as mirror images of what was thought, ``cut`` of those that may be
        parts, and the sqrt(area) of the whole.
        """
        found: dict[int, Record] = {}
        chains = self._chains()
        for turn in range(max(map(len, chains))):
            numbers = [chain[turn] for chain in chains if turn < len(chain)]
            before = [self._last(chain[:turn], found) for chain in chains if turn < len(chain)]
            places = zip(numbers, before, strict=True)
            tasks = []
            for number, last in places:
                source = self.sources[number]
                how = source.name in others, cut.get(source.name)
                tasks.append(FitTask(self.setting, source, last, folder, *how))
            for at, result in self._each(fit_alone, tasks, "fitting" if folder == ALONE else "choosing the template"):
                source = self.sources[numbers[at]]
                if isinstance(result, Died):
                    result = Record(source.name, source.path, reasons=result.message)
                found[numbers[at]] = result
                if tell is not None:
                    tell(result)
        return [found[number] for number in range(len(self.sources))]

    def _chains(self) -> list[list[int]]:
        """Numbers of shapes that are fitted one after the other: each alone, or the frames of each folder."""
        if not self.setting.sequence:
            return [[number] for number in range(len(self.sources))]
        folders: dict[str, list[int]] = defaultdict(list)
        for number in sorted(range(len(self.sources)), key=lambda number: natural(self.sources[number].name)):
            folders[self.sources[number].path.rpartition("/")[0]].append(number)
        return list(folders.values())

    def _last(self, before: Sequence[int], found: Mapping[int, Record]) -> Record | None:
        """The last frame that was fitted."""
        return next((found[number] for number in reversed(before) if found[number].fitted), None)

    def groups(self, numbers: Sequence[int], agreement: str) -> list[Group]:
        """Who takes part in the agreement, a few together."""
        names = [self.sources[number].name for number in numbers]
        parts = [tuple(names[first : first + _GROUP]) for first in range(0, len(names), _GROUP)]
        return [Group(number, part, agreement) for number, part in enumerate(parts)]

    def last_tasks(
        self, records: Mapping[int, Record], groups: Sequence[Group], usual: Compared | None
    ) -> dict[int, FinishTask]:
        """What finishes each fit; a digest of all that agree tells whether that was done before."""
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
        """All steps of the agreement that were not taken before; the cost grows as the number of fits. Sums are taken in
        the order of the groups.
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
            for number, result in self._each(agree_a_little, tasks, f"agreeing, step {step} of {steps}"):
                if isinstance(result, Died):
                    raise result
                waiting[number] = result
                while next_one in waiting:
                    here = waiting.pop(next_one)
                    total, next_one = here if total is None else total + here, next_one + 1
            assert total is not None
            if step < steps:
                mean = total / count
                if step > 0:
                    mean = held_mean(log_stretch(load_array(store, first)), mean, how)
                save_array(store, common, stretch_of(mean))

    def finish(self, tasks: Mapping[int, FinishTask]) -> Iterator[tuple[int, Finished]]:
        """Place the vertices of every shape; gives numbers, and what is said of each fit now, or what went wrong."""
        numbers = list(tasks)
        for at, done in self._each(finish, list(tasks.values()), "placing vertices"):
            yield numbers[at], Finished(done.message) if isinstance(done, Died) else done


def _finished(alone: Record, done: Finished) -> Record:
    """The record of a fit alone, with what became of it when it agreed with others."""
    if done.trouble:
        return replace(alone, verdict=FAILED, reasons=done.trouble)
    known, trust = replace(alone, **regularity_words(done.regularity)), round(done.trust, 4)
    if (done.verdict, trust) == (alone.verdict, alone.trust):
        return known
    return replace(known, verdict=done.verdict, trust=trust, reasons="; ".join(done.reasons))


def _believed(record: Record, usual: Compared | None) -> bool:
    """Whether a fit is not poor, alone and among the others."""
    return record.verdict not in ("poor", FAILED) and (usual is None or usual.trust(record) >= FAIR)


def _write_table(store: Store, records: Sequence[Record]) -> None:
    """``fits.csv``: a row for each shape, frame2 before frame10."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    ordered = sorted(records, key=lambda record: natural(record.name))
    table.writerows([getattr(record, name) for name in COLUMNS] for record in ordered)
    save_text(store, TABLE, text.getvalue())
