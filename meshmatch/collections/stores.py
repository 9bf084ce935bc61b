"""Storage for the files of a collection: a local folder, or anything that fsspec reaches by a URL."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from meshmatch.errors import InputError, OutputError, needs
from meshmatch.locks import locked
from meshmatch.outputs import as_path, make_folder, remove_leftovers

LOCK = ".lock"


def is_url(location: str | Path) -> bool:
    """Whether a location is a URL, such as ``s3://bucket/scans``, rather than a path."""
    return isinstance(location, str) and "://" in location


@dataclass(frozen=True)
class Store:
    """A folder, given by an absolute path or a URL. File names are relative to it, with ``/`` as the separator."""

    location: str

    @classmethod
    def of(cls, location: str | Path) -> Store:
        """Make a store; a path becomes absolute, as workers may have another working directory."""
        return cls(str(location).rstrip("/") if is_url(location) else os.path.abspath(as_path(location)))

    @property
    def remote(self) -> bool:
        """Whether the location is a URL."""
        return is_url(self.location)

    @contextmanager
    def reading(self, name: str) -> Iterator[Path]:
        """Yield a local path of a file; a remote file is copied first. `InputError` if it cannot be fetched."""
        if not self.remote:
            yield Path(self.location, name)
            return
        with tempfile.TemporaryDirectory() as folder:
            local = Path(folder, PurePosixPath(name).name)
            files, root = _filesystem(self.location)
            try:
                files.get_file(f"{root}/{name}", str(local))
            except OSError as error:
                raise InputError(f"cannot read {self.location}/{name}: {error}", "check the address") from error
            yield local

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """Yield a local path to write a file to, and upload it if the store is remote (`OutputError` if that fails).

        The file is not written atomically: that is up to the block.
        """
        if not self.remote:
            path = Path(self.location, name)
            make_folder(path.parent)
            yield path
            return
        with tempfile.TemporaryDirectory() as folder:
            local = Path(folder, PurePosixPath(name).name)
            yield local
            files, root = _filesystem(self.location)
            try:
                files.makedirs(f"{root}/{PurePosixPath(name).parent}", exist_ok=True)
                files.put_file(str(local), f"{root}/{name}")
            except OSError as error:
                raise OutputError(f"cannot write {self.location}/{name}: {error}", "check the permissions") from error

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """Lock the folder for writing, and remove half-written files that killed processes left.

        `OutputError` if another process holds the lock. A remote folder is not locked.
        """
        if self.remote:
            yield
            return
        folder = Path(self.location)
        make_folder(folder)
        busy = f"another process writes to {self.location}"
        with locked(folder / LOCK, busy, "let it end, or choose another folder"):
            remove_leftovers(folder)
            yield

    def exists(self, name: str) -> bool:
        """Whether a file or folder of this name exists."""
        if not self.remote:
            return Path(self.location, name).exists()
        files, root = _filesystem(self.location)
        return bool(files.exists(f"{root}/{name}"))

    def mtime_ns(self, name: str) -> int:
        """Modification time of a local file, in nanoseconds; 0 for one that is remote or missing."""
        path = Path(self.location, name)
        return 0 if self.remote or not path.is_file() else path.stat().st_mtime_ns

    def names(self, folder: str = "") -> list[str]:
        """All files in a folder and its subfolders, sorted, relative to the folder; broken links included.

        Hidden files and folders, whose names begin with a dot, are left out.
        """
        if self.remote:
            files, root = _filesystem(self.location)
            top = f"{root}/{folder}".rstrip("/")
            found = [path[len(top) + 1 :] for path in files.find(top)] if files.exists(top) else []
        else:
            base = Path(self.location, folder)
            files = (path for path in base.rglob("*") if path.is_file() or (path.is_symlink() and not path.exists()))
            found = [path.relative_to(base).as_posix() for path in files]
        return _sorted_visible(found)

    def folder_links(self) -> list[str]:
        """Links to folders, as `names` lists files; `names` does not follow them, as they may be circular."""
        if self.remote:
            return []
        base = Path(self.location)
        links = (path for path in base.rglob("*") if path.is_symlink() and path.is_dir())
        return _sorted_visible([path.relative_to(base).as_posix() for path in links])

    def remove(self, name: str) -> None:
        """Remove a file, or a folder with everything in it."""
        if self.remote:
            files, root = _filesystem(self.location)
            if files.exists(f"{root}/{name}"):
                files.rm(f"{root}/{name}", recursive=True)
        else:
            path = Path(self.location, name)
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def _sorted_visible(names: list[str]) -> list[str]:
    """Sort names, without hidden ones: a part of the path begins with a dot."""
    return sorted(name for name in names if not any(part.startswith(".") for part in name.split("/")))


def _filesystem(location: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it."""
    with needs("fsspec", "cluster"):
        import fsspec
    try:
        found: tuple[Any, str] = fsspec.core.url_to_fs(location)
        return found
    except (ValueError, ImportError) as error:
        raise InputError(f"cannot reach {location}: {error}", "install what fsspec needs for such a URL") from error
