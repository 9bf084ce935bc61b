"""A folder of fits: which are there, which are of another kind, and how they are read."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self

from meshmatch.collections.fit_all import TABLE, files_of
from meshmatch.collections.setting import FITS, SUFFIX, Source, finished_fit
from meshmatch.collections.settle import read_about
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError
from meshmatch.maps.fit_files import load_words
from meshmatch.maps.places import PlacedFit


class FitsFolder:
    """What `meshmatch.Collection` asks of its folder."""

    def __init__(self, folder: str | Path) -> None:
        self.store = Store.of(folder)

    @property
    def _fitted(self) -> list[str]:
        """Names of all fits here, sorted, also of those that are of another kind."""
        self._about()
        found = [name.removesuffix(SUFFIX) for name in self.store.names(FITS) if name.endswith(SUFFIX)]
        if not found:
            raise InputError(f"{self.store.location} holds no finished fit", "run `meshmatch fit` to its end")
        return found

    def _with_earlier(self, given: Sequence[Source]) -> list[Source]:
        """The given shapes, and those that are here from before, where their files are still there; sorted by name."""
        names, paths = {each.name for each in given}, {each.path for each in given}
        files: dict[str, str] = {}
        with suppress(InputError):  # a new folder has no table
            files = files_of(self.store)
        found = list(given)
        for name in (name.removesuffix(SUFFIX) for name in self.store.names(FITS)):
            folder, _, file = files.get(name, "").rpartition("/")
            if name not in names and file and files[name] not in paths and Store.of(folder).exists(file):
                found.append(Source(name, Store.of(folder), file))
        return sorted(found, key=lambda source: source.name)

    def _others(self) -> list[Self]:
        """The collections of shapes of other kinds within this one that hold fits."""
        found = [name.split("/") for name in self.store.names() if name.endswith(f"/{TABLE}")]
        others = [type(self)(f"{self.store.location}/{parts[0]}") for parts in found if len(parts) == 2]
        return [each for each in others if each.store.names(FITS) and read_about(each.store) is not None]

    def _elsewhere(self, names: Sequence[str]) -> dict[str, str]:
        """Those of the names whose fits here are poor, for they are of another kind; and where their own fits are."""
        found = {}
        for other in self._others():
            theirs = set(other._fitted)
            for name in (name for name in names if name in theirs):
                here, there = self._words(name), other._words(name)
                same = here.get("shape_hash") == there.get("shape_hash")
                if same and here["verdict"] == "poor" and here["model"] != there["model"]:
                    found[name] = other.store.location
        return found

    def _hash_of(self, name: str) -> str:
        return str(self._words(name).get("shape_hash", ""))

    def _words(self, name: str) -> dict[str, Any]:
        with self.store.reading(f"{FITS}/{name}{SUFFIX}") as path:
            return load_words(path)[0]

    def _about(self) -> dict[str, Any]:
        about = read_about(self.store)
        if about is None:
            hint = "make one with `meshmatch fit SHAPES -o FOLDER`"
            raise InputError(f"{self.store.location} is not a folder of fits", hint)
        return about

    def _read(self, name: str) -> PlacedFit:
        if not self.store.exists(f"{FITS}/{name}{SUFFIX}"):
            close = get_close_matches(name, self._fitted, n=1)
            hint = f"did you mean {close[0]}?" if close else "names are those of the fitted files, without the suffix"
            raise InputError(f"the collection has no fit of {name}", hint)
        return finished_fit(self.store, name)
