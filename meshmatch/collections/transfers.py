"""One transfer to many targets: files, a folder of shapes, or a folder of fits; what is finished is kept."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from meshmatch.api.measure import is_body, meant_source
from meshmatch.api.results import MapPair
from meshmatch.collections.collection import Collection
from meshmatch.collections.endings import ending_of
from meshmatch.collections.setting import FAILED, LEFT_OUT
from meshmatch.collections.sources import find_sources
from meshmatch.collections.stores import Store
from meshmatch.collections.transfer_table import TransferRecord, transfer_each, words_of
from meshmatch.errors import InputError, MeshmatchError, warn
from meshmatch.outputs import as_path
from meshmatch.shapes.files import ShapeLike
from meshmatch.shapes.input_files import stem_of
from meshmatch.shapes.shape import Shape

_FITS = "fits.csv"


class HasMaps(Protocol):
    """What every transfer gives back."""

    @property
    def maps(self) -> MapPair: ...

    def save(self, path: str | Path) -> None: ...


R = TypeVar("R", bound=HasMaps)


@dataclass(frozen=True)
class Targets:
    """Files by name, without other inputs; the fits that their maps are looked up in, if the source is among these; and
    what the source is called among the targets.
    """

    files: dict[str, Path]
    fits: Path | None
    source: str

    @classmethod
    def find(
        cls, given: Sequence[str | Path], source: ShapeLike, other: object = None, output: Path | None = None
    ) -> Targets:
        """The shapes of files, folders and patterns, or those of one folder of fits; not the source, what lies in the
        output folder, or another input. `InputError` if there is none.
        """
        fits, held, meant = Path(given[0], _FITS), False, meant_source(source)
        if len(given) == 1 and fits.is_file():
            with fits.open(encoding="utf-8", newline="") as file:
                rows = [row for row in csv.DictReader(file) if row.get("verdict") not in (FAILED, LEFT_OUT)]
            found = {_inner(str(row.get("name")), fits): Path(str(row.get("file"))) for row in rows}
            held = Collection(fits.parent).holds(meant)
        else:
            sources, _ = find_sources([str(each) for each in given], None if output is None else Store.of(output))
            found = {each.name: Path(each.path) for each in sources}
        taken = [os.path.realpath(each) for each in (meant, other) if isinstance(each, str | Path)]
        inputs = {name: file for name, file in found.items() if os.path.realpath(file) in taken}
        if is_body(source):
            called = ""  # it is no specimen among others
        elif isinstance(source, str | Path):
            own = [name for name, file in inputs.items() if os.path.realpath(file) == taken[0]]
            called = own[0] if own else stem_of(Path(source))
        else:
            called = source.name if isinstance(source, Shape) else ""
        left = {name: file for name, file in found.items() if name not in inputs}
        if not left:
            raise InputError(f"there is no target in {given[0]}", "name files or folders of shapes")
        return cls(left, fits.parent if held else None, called)


def _inner(name: str, table: Path) -> str:
    """A name of a table; `InputError` if a file named so could lie outside of the folder it is meant for."""
    path = Path(name)
    if not path.parts or path.anchor or ".." in path.parts or "\0" in name:
        raise InputError(f"{table}: {name!r} is no name of a shape", "correct that row, or fit the shapes again")
    return name


class Transfers(Generic[R]):
    """One transfer to many targets, as ``meshmatch transfer-...`` does it with several.

    Iterating makes a result for each target when its turn comes, and keeps none of them. `save` writes them all.
    A target that fails stops no other: it is left out, with a warning.

    Parameters
    ----------
    transfer
        The function that transfers to one, such as `transfer_rig`.
    source
        Its ``source``.
    targets
        Files, patterns such as ``scans/*.ply``, or a folder of shapes; or a folder of fits, or its `Collection`: the shapes
        in it, whose maps are looked up if the source is one of them. The source is no target.
    choices
        What else the function takes, by name, for all targets.

    Raises
    ------
    InputError
        There are no targets, or two of one name.

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
        self._found()

    def __repr__(self) -> str:
        return f"Transfers({_called(self.transfer)}, {len(self.files)} targets)"

    @property
    def files(self) -> dict[str, Path]:
        """The targets by name: the path in their folder without the suffix, or the file's name."""
        return self._found().files

    def __len__(self) -> int:
        return len(self.files)

    def __iter__(self) -> Iterator[tuple[str, R]]:
        """Names and results, each made when its turn comes."""
        found = self._found()
        for name, file in found.files.items():
            try:
                result = self._to(file, found)
            except MeshmatchError as error:
                warn(f"{name}: {words_of(error)}")
            else:
                yield name, result

    def save(
        self, folder: str | Path, suffix: str | None = None, tell: Callable[[TransferRecord], None] | None = None
    ) -> list[TransferRecord]:
        """Write a file for each target, called by its name, and ``transfers.csv`` with a row for each.

        What is there, made of the same files and choices, is kept, so that a run that was stopped goes on. What cannot be
        compared, such as a function for ``match``, counts as another choice each time.

        Parameters
        ----------
        folder
            Where to; it is made if it is missing.
        suffix
            Of each file; by default what the command would write.
        tell
            Called with the record of each target, as they come in.

        Returns
        -------
        list of TransferRecord
            What became of each target, also of those that failed.

        Raises
        ------
        OptionError
            The suffix is not one that the transfer writes.
        InputError
            There are no targets any more, or two of one name.
        OutputError
            The folder cannot be written, or holds another table of that name.
        """
        folder, word = as_path(folder), _called(self.transfer)
        changes = None if self.transfer.__module__.startswith("meshmatch.") else self.transfer
        found = self._found(folder)
        garment = self.choices.get("garment")
        worn = Path(garment) if isinstance(garment, str | Path) else None
        ending = ending_of(word, suffix, worn, found.files)

        def made(name: str, file: Path, output: Path) -> tuple[str, float | None]:
            result = self._to(file, found)
            result.save(output)
            forward = result.maps.forward
            confidence = float(np.mean(forward.confidence))
            return forward.verdict, None if np.isnan(confidence) else confidence

        def told(record: TransferRecord) -> None:
            if record.error:
                warn(f"{record.name}: {record.error}")
            if tell is not None:
                tell(record)

        how = word, changes, self.source, self.choices, found.fits
        return transfer_each(found.files, folder, ending, how, made, told)

    def _found(self, output: Path | None = None) -> Targets:
        return Targets.find(self.targets, self.source, self.choices.get("garment"), output)

    def _to(self, file: Path, found: Targets) -> R:
        maps = {} if found.fits is None else {"match": Collection(found.fits).maps_between}
        return self.transfer(source=self.source, target=file, **maps | self.choices)


def _called(transfer: Callable[..., object]) -> str:
    return str(getattr(transfer, "__name__", type(transfer).__name__))
