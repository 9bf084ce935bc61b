"""Transfers to many targets: files, a folder of shapes, or a folder of fits. Finished outputs are kept."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from meshmatch.api.measure import is_body, resolve_source
from meshmatch.api.results import MapPair
from meshmatch.collections.collection import Collection
from meshmatch.collections.setting import FAILED, LEFT_OUT
from meshmatch.collections.sources import find_sources
from meshmatch.collections.stores import Store
from meshmatch.collections.suffixes import choose_suffix
from meshmatch.collections.transfer_table import TransferRecord, transfer_each, with_hint
from meshmatch.errors import InputError, MeshmatchError, warn
from meshmatch.outputs import as_path
from meshmatch.shapes.files import ShapeLike
from meshmatch.shapes.input_files import stem_of
from meshmatch.shapes.shape import Shape

_FITS = "fits.csv"


class HasMaps(Protocol):
    """The interface that the results of all transfers share."""

    @property
    def maps(self) -> MapPair: ...

    def save(self, path: str | Path) -> None: ...


R = TypeVar("R", bound=HasMaps)


@dataclass(frozen=True)
class Targets:
    """The targets of a transfer.

    ``files`` are the targets by name, without the source and other inputs. ``fits`` is the folder of fits in which maps
    are looked up, None unless it has a fit of the source. ``source`` is the name of the source among the targets.
    """

    files: dict[str, Path]
    fits: Path | None
    source: str

    @classmethod
    def find(
        cls, given: Sequence[str | Path], source: ShapeLike, other: object = None, output: Path | None = None
    ) -> Targets:
        """Find targets in files, folders and patterns, or in one folder of fits.

        The source, the input ``other`` and files in the ``output`` folder are excluded. `InputError` if none is left.
        """
        fits, has_source, meant = Path(given[0], _FITS), False, resolve_source(source)
        if len(given) == 1 and fits.is_file():
            with fits.open(encoding="utf-8", newline="") as file:
                rows = [row for row in csv.DictReader(file) if row.get("verdict") not in (FAILED, LEFT_OUT)]
            found = {_safe_name(str(row.get("name")), fits): Path(str(row.get("file"))) for row in rows}
            has_source = Collection(fits.parent).holds(meant)
        else:
            sources, _ = find_sources([str(each) for each in given], None if output is None else Store.of(output))
            found = {each.name: Path(each.path) for each in sources}
        input_paths = [os.path.realpath(each) for each in (meant, other) if isinstance(each, str | Path)]
        inputs = {name: file for name, file in found.items() if os.path.realpath(file) in input_paths}
        if is_body(source):
            source_name = ""  # the bundled body is not one of the shapes
        elif isinstance(source, str | Path):
            own = [name for name, file in inputs.items() if os.path.realpath(file) == input_paths[0]]
            source_name = own[0] if own else stem_of(Path(source))
        else:
            source_name = source.name if isinstance(source, Shape) else ""
        left = {name: file for name, file in found.items() if name not in inputs}
        if not left:
            raise InputError(f"there is no target in {given[0]}", "name files or folders of shapes")
        return cls(left, fits.parent if has_source else None, source_name)


def _safe_name(name: str, table: Path) -> str:
    """Validate a name read from a table; `InputError` if an output of this name could be outside the output folder."""
    path = Path(name)
    if not path.parts or path.anchor or ".." in path.parts or "\0" in name:
        raise InputError(f"{table}: {name!r} is no name of a shape", "correct that row, or fit the shapes again")
    return name


class Transfers(Generic[R]):
    """A transfer to many targets, like ``meshmatch transfer-...`` with several.

    Iteration computes the result for one target at a time, and keeps none of them. `save` writes all results to files.
    A target that fails is left out with a warning and does not stop the others.

    Parameters
    ----------
    transfer
        The function that transfers to one target, such as `transfer_rig`.
    source
        The ``source`` of the function.
    targets
        Files, patterns such as ``scans/*.ply``, or a folder of shapes; or a folder of fits or its `Collection`, for the
        shapes in it, with maps that are looked up if the source is one of them. The source itself is not a target.
    choices
        Other keyword arguments of the function, for all targets.

    Raises
    ------
    InputError
        There are no targets, or two have the same name.

    Examples
    --------
    >>> scans = ["templates/samples/climber.ply", "templates/samples/dancer.ply"]
    >>> landmarks = meshmatch.Transfers(meshmatch.transfer_landmarks, scans[0], scans, landmarks=[0, 100, 200])
    >>> points = {name: moved.data.points for name, moved in landmarks}
    >>> landmarks.save("landmarks", ".json")
    """

    def __init__(
        self,
        transfer: Callable[..., R],
        source: ShapeLike,
        targets: str | Path | Collection | Sequence[str | Path],
        **choices: Any,
    ) -> None:
        self.transfer, self.source, self.choices = transfer, source, choices
        if isinstance(targets, Collection):
            targets = targets.store.location
        self.targets = [targets] if isinstance(targets, str | Path) else list(targets)
        if not self.targets:
            raise InputError("there are no targets", "name files or folders of shapes")
        self._find_targets()

    def __repr__(self) -> str:
        return f"Transfers({_function_name(self.transfer)}, {len(self.files)} targets)"

    @property
    def files(self) -> dict[str, Path]:
        """The targets by name: their path in the folder or the name of the file, without the suffix."""
        return self._find_targets().files

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[tuple[str, R]]:
        """Yield (name, result) for each target; results are computed one at a time."""
        found = self._find_targets()
        for name, file in found.files.items():
            try:
                result = self._transfer_to(file, found)
            except MeshmatchError as error:
                warn(f"{name}: {with_hint(error)}")
            else:
                yield name, result

    def save(
        self, folder: str | Path, suffix: str | None = None, tell: Callable[[TransferRecord], None] | None = None
    ) -> list[TransferRecord]:
        """Write a file for each target, with the target's name, and ``transfers.csv`` with a row for each.

        Outputs made from the same files and options are kept, so that an interrupted run can be continued. Options that
        cannot be compared, such as a function for ``match``, count as changed each time.

        Parameters
        ----------
        folder
            Output folder; it is created if missing.
        suffix
            Suffix of the files; by default that of the command line.
        tell
            Called with the record of each target as soon as it is done.

        Returns
        -------
        list of TransferRecord
            The result for each target, failed ones included.

        Raises
        ------
        OptionError
            The transfer cannot write files of this suffix.
        InputError
            There are no targets any more, or two have the same name.
        OutputError
            The folder cannot be written, or has another kind of file named ``transfers.csv``.
        """
        folder, word = as_path(folder), _function_name(self.transfer)
        changes = None if self.transfer.__module__.startswith("meshmatch.") else self.transfer
        found = self._find_targets(folder)
        garment = self.choices.get("garment")
        worn = Path(garment) if isinstance(garment, str | Path) else None
        ending = choose_suffix(word, suffix, worn, found.files)

        def transfer_one(name: str, file: Path, output: Path) -> tuple[str, float | None]:
            result = self._transfer_to(file, found)
            result.save(output)
            forward = result.maps.forward
            confidence = float(np.mean(forward.confidence))
            return forward.verdict, None if np.isnan(confidence) else confidence

        def report(record: TransferRecord) -> None:
            if record.error:
                warn(f"{record.name}: {record.error}")
            if tell is not None:
                tell(record)

        how = word, changes, self.source, self.choices, found.fits
        return transfer_each(found.files, folder, ending, how, transfer_one, report)

    def _find_targets(self, output: Path | None = None) -> Targets:
        return Targets.find(self.targets, self.source, self.choices.get("garment"), output)

    def _transfer_to(self, file: Path, found: Targets) -> R:
        maps = {} if found.fits is None else {"match": Collection(found.fits).maps_between}
        return self.transfer(source=self.source, target=file, **maps | self.choices)


def _function_name(transfer: Callable[..., object]) -> str:
    """Name of a transfer function."""
    return str(getattr(transfer, "__name__", type(transfer).__name__))
