"""Write maps of many pairs of a collection, with only a few in memory at a time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from meshmatch.collections.setting import FITS, SUFFIX, read_finished_fit
from meshmatch.collections.stores import Store
from meshmatch.collections.workers import DeadWorkerError, Workers
from meshmatch.errors import InputError
from meshmatch.maps.build import map_between_fits
from meshmatch.maps.files import save_map
from meshmatch.outputs import as_path
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.input_files import read_text

Pair = tuple[str, str]
"""Names of a source and a target."""
_SOURCES = 64  # sources per task, enough to amortise the target's search tree
_PAIR_BYTES = 400  # memory needed per pair


@dataclass(frozen=True)
class MapTask:
    """Maps of several sources to one target."""

    fits: Store
    output: Store
    sources: tuple[str, ...]
    target: str
    suffix: str

    def file(self, source: str) -> str:
        """File of the map from a source."""
        return f"{source}/{self.target}{self.suffix}"


def load_pairs(path: str | Path) -> list[Pair]:
    """Read pairs of names from a text file, one source and target per line.

    They are separated by a tab, semicolon, comma or spaces; ``#`` starts a comment. `InputError` if the file is missing, or
    a line is anything else.
    """
    path = as_path(path)
    found = []
    try:
        lines = read_text(path, _PAIR_BYTES).splitlines()
    except ValueError as error:
        raise InputError(f"{path.name} is not text", "save it in UTF-8") from error
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        separator = next((each for each in "\t;," if each in text), None)
        words = [word.strip() for word in text.split(separator)]
        if text and len(words) != 2:
            hint = "each line names a source and a target; put a comma between names that contain spaces"
            raise InputError(f"{path.name}, line {number}: not two names", hint)
        if text:
            found.append((words[0], words[1]))
    if not found:
        raise InputError(f"{path.name} holds no pair of names", "each line names a source and a target")
    return found


def write_maps(task: MapTask) -> int:
    """Write the maps of a task, except those that are newer than the fits; return their number, kept ones included."""
    for source in task.sources:
        if not _is_up_to_date(task, source):
            found = map_between_fits(read_finished_fit(task.fits, source), read_finished_fit(task.fits, task.target))
            with task.output.writing(task.file(source)) as path:
                save_map(path, found)
    return len(task.sources)


def map_all(
    fits: Store,
    output: Store,
    pairs: Sequence[Pair],
    suffix: str,
    workers: Workers,
    progress: ProgressCallback | None = None,
) -> int:
    """Write maps of pairs of fits and return their number; see `Collection.save_maps`."""
    sources: dict[str, list[str]] = defaultdict(list)
    for source, target in pairs:
        sources[target].append(source)
    tasks = [
        MapTask(fits, output, tuple(group[first : first + _SOURCES]), target, suffix)
        for target, group in sources.items()
        for first in range(0, len(group), _SOURCES)
    ]
    done = 0
    for _, result in workers.map_unordered(write_maps, tasks):
        if isinstance(result, DeadWorkerError):
            raise result
        done += result
        if progress is not None:
            progress("mapping", output.location, done / len(pairs))
    return done


def _is_up_to_date(task: MapTask, source: str) -> bool:
    """Whether a map was written after both fits; False if any of the files is remote."""
    if task.fits.remote or task.output.remote:
        return False
    path = Path(task.output.location, task.file(source))
    both = [Path(task.fits.location, FITS, f"{name}{SUFFIX}") for name in (source, task.target)]
    return path.is_file() and path.stat().st_mtime > max(fit.stat().st_mtime for fit in both)
