"""Output files and folders appear whole or not at all."""

import os
import re
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Literal

from meshmatch import blender
from meshmatch.errors import InputError, OutputError

_TEMPORARY = re.compile(r"\..*\.[0-9a-f]{8}(\.[^.]*)?")  # the names that `replace_on_success` gives


def plain_text(text: str) -> str:
    """Text that every file can hold. What is no letter, such as a byte of a file's name that is not UTF-8, becomes
    U+FFFD.
    """
    return text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")


def numbered_apart(words: Iterable[str], between: str, alike: Callable[[str], str] = str) -> list[str]:
    """The same words, but 2, 3, ... behind those that are as an earlier one, by what ``alike`` makes of them."""
    forms: dict[str, Iterator[str]] = {}  # those of a word that were not tried yet
    found: dict[str, str] = {}
    for word in words:
        left = forms.setdefault(word, _numbered(word, between))
        own = next(form for form in left if alike(form) not in found)
        found[alike(own)] = own
    return list(found.values())


def _numbered(word: str, between: str) -> Iterator[str]:
    yield word
    yield from (f"{word}{between}{k}" for k in count(2))


def as_path(path: str | Path) -> Path:
    """The path that is meant; `InputError` for what is neither text nor a path, such as None."""
    try:
        return Path(path)
    except TypeError as error:
        hint = "write it as text or as a pathlib.Path"
        raise InputError(f"expected a path, not {type(path).__name__}", hint) from error


def home_folder(kind: Literal["data", "cache"]) -> Path:
    """The user's folder of what is theirs, or of what can be made again; one that cannot be, where they have no home."""
    import platformdirs

    find = platformdirs.user_data_path if kind == "data" else platformdirs.user_cache_path
    with suppress(RuntimeError):
        path = find("meshmatch", appauthor=False)
        if path.is_absolute():  # else it would appear wherever the process happens to be
            return path
    return Path(os.devnull, "meshmatch")


def make_folder(path: Path) -> None:
    """Make a folder if it is not there; before long work, so that one that cannot be made is told at once.

    `OutputError` if it cannot be made, or is a file.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {path}: {error.strerror}", "choose another folder") from error


def _reached(path: Path) -> Path:
    """The path, or what it leads to if it is a link; `OutputError` for a name that no file can have."""
    try:
        path.lstat()
    except FileNotFoundError:
        return path
    except (OSError, ValueError) as error:  # too long; through a file; a NUL
        why = getattr(error, "strerror", None) or str(error)
        raise OutputError(f"cannot write {path}: {why}", "choose another name") from error
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextmanager
def replace_on_success(path: str | Path) -> Iterator[Path]:
    """As `_replacing`. Of a file that Blender writes (`meshmatch.blender`) the temporary path is that of a glb, which is
    converted when the block ends well, with images beside it; `OptionError` if there is no Blender, or one of these would
    replace another file.
    """
    path = Path(path)
    if not blender.is_converted(path):
        with _replacing(path) as temporary:
            yield temporary
        return
    blender.check_written(path)
    with _replacing(path) as converted:
        glb = converted.with_suffix(".glb")
        try:
            yield glb
            images = blender.from_glb(glb, converted, path)
            with replace_all_on_success(list(images)) as places:
                for place, data in zip(places, images.values(), strict=True):
                    place.write_bytes(data)
        finally:
            glb.unlink(missing_ok=True)


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path`, and rename it to `path` when the block ends well.

    The temporary name keeps the suffix, so writers that choose a format by it still do. On any exception, Ctrl-C
    included (and SIGTERM, which the command line turns into it), the temporary file is removed and whatever was at
    `path` before is untouched. Where `path` is a link, what it leads to is replaced, and the link stays.

    `OutputError` if the folder is missing or cannot be written, `path` is a folder or write-protected, or the disk refuses.
    """
    final = _reached(path)
    folder = final.parent
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder", "give the name of a file")
    if final.exists() and not os.access(final, os.W_OK):
        raise OutputError(f"cannot write {path}: it is write-protected", "choose another name with -o")
    if not folder.is_dir():
        raise OutputError(f"cannot write {path}: there is no folder {folder}", f"make it first: mkdir -p {folder}")
    # A name has 255 bytes at most, and a letter up to 4 of them.
    temporary = folder / f".{path.stem[:40]}.{os.urandom(4).hex()}{path.suffix}"
    try:
        temporary.touch(exist_ok=False)  # tells now, not after minutes of work
        mode = temporary.stat().st_mode  # some writers make files that only their owner may read
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}", "choose another folder with -o") from error
    try:
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, final)
    except OutputError as error:  # of a writer that takes care of its own, and knows the temporary name alone
        raise OutputError(error.message.replace(str(temporary), str(path)), error.hint) from error
    except OSError as error:
        if error.filename in (None, str(temporary), temporary):
            raise OutputError(f"cannot write {path}: {error.strerror or error}", "is the disk full?") from error
        raise
    except Exception as error:
        if "(os error " not in str(
            error
        ):  # as libraries of Rust say what the system refuses; their classes are their own
            raise
        why = str(error).rpartition(": ")[2].partition(" (os error")[0]
        raise OutputError(f"cannot write {path}: {why}", "is the disk full?") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replace_all_on_success(paths: Sequence[str | Path]) -> Iterator[list[Path]]:
    """As `replace_on_success` for several files that belong together; the first, which names the others, is renamed last."""
    with ExitStack() as claims:
        yield [claims.enter_context(replace_on_success(path)) for path in paths]


def sweep(folder: Path) -> None:
    """Remove what `replace_on_success` left in a folder, or below it, when its process was killed; nobody else may be
    writing there.
    """
    for path in folder.rglob(".*"):
        if _TEMPORARY.fullmatch(path.name) and path.is_file():
            path.unlink(missing_ok=True)


@contextmanager
def folder_on_success(path: str | Path, replaces: Collection[str] = ()) -> Iterator[Path]:
    """Give a temporary folder beside `path`, and rename it to `path` when the block ends well.

    On any exception the temporary folder is removed with all that is in it, and what was at `path` stays. Nothing of the
    user's is ever replaced: `path` must be new, or an empty folder, or hold nothing but what the same command writes
    (the names `replaces`).

    `OutputError` if `path` is a file or holds something else, its folder is missing or cannot be written, or the disk
    refuses.
    """
    path = check_new_folder(path, replaces)
    folder = path.parent
    temporary = folder / f".{path.name[:40]}.{os.urandom(4).hex()}"
    try:
        temporary.mkdir()
    except OSError as error:
        hint = "choose another folder with -o"
        raise OutputError(f"cannot make the folder {path}: {error.strerror}", hint) from error
    try:
        yield temporary
        _only_holds(path, replaces)
        if path.is_dir():
            _exchange(temporary, path)
        else:
            os.replace(temporary, path)
    except OutputError as error:  # of a file in it, which is gone when this is read
        raise OutputError(error.message.replace(str(temporary), str(path)), error.hint) from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}", "is the disk full?") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_new_folder(path: str | Path, replaces: Collection[str] = ()) -> Path:
    """Where `folder_on_success` would make a folder; `OutputError` where it would not. Ask before long work."""
    path = _reached(Path(path))
    folder = path.parent
    if path.exists() and not path.is_dir():
        raise OutputError(f"cannot make the folder {path}: it is a file", "choose another name")
    _only_holds(path, replaces)
    if path.is_dir() and path.samefile(Path.cwd()):
        raise OutputError(f"cannot make the folder {path}: it is the current folder", "give the name of a new one")
    if not folder.is_dir():
        raise OutputError(f"cannot make {path}: there is no folder {folder}", f"make it first: mkdir -p {folder}")
    return path


def _only_holds(path: Path, names: Collection[str]) -> None:
    """`OutputError` if there is a folder at ``path`` that holds anything but these."""
    if path.is_dir() and any(held.name not in names for held in path.iterdir()):
        raise OutputError(f"the folder {path} is not empty", "choose a new one, or empty it first")


def _exchange(new: Path, path: Path) -> None:
    """Put the folder ``new`` in the place of the one at ``path``, which is removed; if that fails, it is put back."""
    old = new.with_name(f"{new.name}-old")
    os.replace(path, old)
    try:
        os.replace(new, path)
    except BaseException:
        os.replace(old, path)
        raise
    shutil.rmtree(old, ignore_errors=True)
