"""Read access to a folder of fits, and to the folders within it that hold fits of other kinds."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self

from meshmatch.collections.fit_all import TABLE, file_table
from meshmatch.collections.select_setting import read_manifest
from meshmatch.collections.setting import FITS, SUFFIX, Source, read_finished_fit
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError
from meshmatch.maps.fit_files import read_fit_header
from meshmatch.maps.places import PlacedFit


class FitsFolder:
    """The folder of a `meshmatch.Collection`."""

    def __init__(self, folder: str | Path) -> None:
        self.store = Store.of(folder)

    @property
    def _fitted(self) -> list[str]:
        """Names of all fits in the folder, sorted, shapes of another kind included; `InputError` if there is none."""
        self._manifest()
        found = [name.removesuffix(SUFFIX) for name in self.store.names(FITS) if name.endswith(SUFFIX)]
        if not found:
            raise InputError(f"{self.store.location} holds no finished fit", "run `meshmatch fit` to its end")
        return found

    def _with_earlier(self, given: Sequence[Source]) -> list[Source]:
        """The given shapes together with those fitted before whose files still exist, sorted by name."""
        names, paths = {each.name for each in given}, {each.path for each in given}
        files: dict[str, str] = {}
        with suppress(InputError):  # a new folder has no table
            files = file_table(self.store)
        found = list(given)
        for name in (name.removesuffix(SUFFIX) for name in self.store.names(FITS)):
            folder, _, file = files.get(name, "").rpartition("/")
            if name not in names and file and files[name] not in paths and Store.of(folder).exists(file):
                found.append(Source(name, Store.of(folder), file))
        return sorted(found, key=lambda source: source.name)

    def _other_kinds(self) -> list[Self]:
        """Collections in subfolders, with fits of shapes of other kinds."""
        found = [name.split("/") for name in self.store.names() if name.endswith(f"/{TABLE}")]
        others = [type(self)(f"{self.store.location}/{parts[0]}") for parts in found if len(parts) == 2]
        return [each for each in others if each.store.names(FITS) and read_manifest(each.store) is not None]

    def _fitted_elsewhere(self, names: Sequence[str]) -> dict[str, str]:
        """Map shapes of another kind to the folder of their own fits; their fits in this folder are poor."""
        found = {}
        for other in self._other_kinds():
            other_names = set(other._fitted)
            for name in (name for name in names if name in other_names):
                here, there = self._metadata(name), other._metadata(name)
                same = here.get("shape_hash") == there.get("shape_hash")
                if same and here["verdict"] == "poor" and here["model"] != there["model"]:
                    found[name] = other.store.location
        return found

    def _hash_of(self, name: str) -> str:
        """Hash of the fitted shape."""
        return str(self._metadata(name).get("shape_hash", ""))

    def _metadata(self, name: str) -> dict[str, Any]:
        """Metadata of a fit, such as verdict and model."""
        with self.store.reading(f"{FITS}/{name}{SUFFIX}") as path:
            return read_fit_header(path)[0]

    def _manifest(self) -> dict[str, Any]:
        """Model and options of the collection, see `read_manifest`; `InputError` if the folder is not a collection."""
        about = read_manifest(self.store)
        if about is None:
            hint = "make one with `meshmatch fit SHAPES -o FOLDER`"
            raise InputError(f"{self.store.location} is not a folder of fits", hint)
        return about

    def _read_fit(self, name: str) -> PlacedFit:
        """Read a finished fit; `InputError` if there is none of this name."""
        if not self.store.exists(f"{FITS}/{name}{SUFFIX}"):
            close = get_close_matches(name, self._fitted, n=1)
            hint = f"did you mean {close[0]}?" if close else "names are those of the fitted files, without the suffix"
            raise InputError(f"the collection has no fit of {name}", hint)
        return read_finished_fit(self.store, name)
