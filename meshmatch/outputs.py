"""Output files and folders that are written completely or not at all."""

import os
import re
import shlex
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Literal

from meshmatch import blender
from meshmatch.errors import InputError, OutputError

_TEMPORARY = re.compile(r"\..*\.[0-9a-f]{8}(\.[^.]*)?")  # temporary names given by `replace_on_success`


def plain_text(text: str) -> str:
    """Text that every file can hold: lone surrogates, such as bytes of a file name that is not UTF-8, become U+FFFD."""
    return text.encode("utf-16", "surrogatepass").decode("utf-16", "replace")


def make_unique(words: Iterable[str], between: str, alike: Callable[[str], str] = str) -> list[str]:
    """The words, made unique: repetitions get the suffixes 2, 3, ... after ``between``.

    Words are repetitions if ``alike`` maps them to the same string.
    """
    forms: dict[str, Iterator[str]] = {}  # untried forms of each word
    chosen: dict[str, str] = {}
    for word in words:
        untried = forms.setdefault(word, _numbered_forms(word, between))
        unique = next(form for form in untried if alike(form) not in chosen)
        chosen[alike(unique)] = unique
    return list(chosen.values())


def _numbered_forms(word: str, between: str) -> Iterator[str]:
    yield word
    yield from (f"{word}{between}{k}" for k in count(2))


def as_path(path: str | Path) -> Path:
    """Convert to a path; `InputError` for anything but text or a path, such as None, and for empty text."""
    if path == "":
        raise InputError("a path is empty", "name a file or folder; . is the current folder")
    try:
        return Path(path)
    except TypeError as error:
        hint = "write it as text or as a pathlib.Path"
        raise InputError(f"expected a path, not {type(path).__name__}", hint) from error


def home_folder(kind: Literal["data", "cache"]) -> Path:
    """The user's folder for data or for the cache; a path that cannot be created if the user has no home directory."""
    import platformdirs

    find = platformdirs.user_data_path if kind == "data" else platformdirs.user_cache_path
    with suppress(RuntimeError):
        path = find("meshmatch", appauthor=False)
        if path.is_absolute():  # a relative path would depend on the current directory
            return path
    return Path(os.devnull, "meshmatch")


def make_folder(path: Path) -> None:
    """Create a folder if it does not exist; `OutputError` if it cannot be created, or is a file.

    Call it before long work, so that a folder that cannot be created is reported at once.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {path}: {error.strerror}", "choose another folder") from error


def _resolve_link(path: Path) -> Path:
    """The path, with a link resolved; `OutputError` for an impossible name."""
    try:
        path.lstat()
    except FileNotFoundError:
        return path
    except (OSError, ValueError) as error:  # too long, inside a file, or with a NUL
        why = getattr(error, "strerror", None) or str(error)
        raise OutputError(f"cannot write {path}: {why}", "choose another name") from error
    return Path(os.path.realpath(path)) if path.is_symlink() else path


@contextmanager
def replace_on_success(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path, which replaces `path` if the block succeeds; see `_replacing`.

    For formats that Blender writes (`meshmatch.blender`) the temporary path is that of a glb, which is converted after
    the block; images are written next to the output. `OptionError` if there is no Blender, or an image would replace
    another file.
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
    """Yield a temporary path next to `path`, and rename it to `path` if the block succeeds.

    The temporary name keeps the suffix, for writers that choose the format by it. On any exception, Ctrl-C included
    (and SIGTERM, which the command line turns into it), the temporary file is removed and whatever was at `path` before
    is untouched. If `path` is a link, its target is replaced, and the link stays.

    `OutputError` if the folder is missing or cannot be written, `path` is a folder, a pipe, a device or write-protected,
    or the disk is full.
    """
    final = _resolve_link(path)
    folder = final.parent
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder", "give the name of a file")
    if final.exists() and not final.is_file():
        raise OutputError(f"cannot write {path}: it is a pipe or a device", "give the name of a file")
    if final.exists() and not os.access(final, os.W_OK):
        raise OutputError(f"cannot write {path}: it is write-protected", "choose another name with -o")
    if not folder.is_dir():
        raise OutputError(
            f"cannot write {path}: there is no folder {folder}", f"make it first: mkdir -p {shlex.quote(str(folder))}"
        )
    # A name has at most 255 bytes, and a character up to 4 of them.
    temporary = folder / f".{path.stem[:40]}.{os.urandom(4).hex()}{path.suffix}"
    try:
        temporary.touch(exist_ok=False)  # fails now rather than after minutes of work
        mode = temporary.stat().st_mode  # some writers create files that only their owner may read
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}", "choose another folder with -o") from error
    try:
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, final)
    except OutputError as error:  # from a nested writer, which knows only the temporary name
        raise OutputError(error.message.replace(str(temporary), str(path)), error.hint) from error
    except OSError as error:
        if error.filename in (None, str(temporary), temporary):
            raise OutputError(f"cannot write {path}: {error.strerror or error}", "is the disk full?") from error
        raise
    except Exception as error:
        if "(os error " not in str(error):  # Rust libraries report system errors so, in classes of their own
            raise
        why = str(error).rpartition(": ")[2].partition(" (os error")[0]
        raise OutputError(f"cannot write {path}: {why}", "is the disk full?") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replace_all_on_success(paths: Sequence[str | Path]) -> Iterator[list[Path]]:
    """As `replace_on_success`, for several files that belong together.

    The first file, which refers to the others, is renamed last.
    """
    with ExitStack() as claims:
        yield [claims.enter_context(replace_on_success(path)) for path in paths]


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that `replace_on_success` left in a folder, or below it, when its process was killed.

    No other process may be writing there.
    """
    for path in folder.rglob(".*"):
        if _TEMPORARY.fullmatch(path.name) and path.is_file():
            path.unlink(missing_ok=True)


@contextmanager
def folder_on_success(path: str | Path, replaces: Collection[str] = ()) -> Iterator[Path]:
    """Yield a temporary folder next to `path`, and rename it to `path` if the block succeeds.

    On any exception the temporary folder is removed with its contents, and what was at `path` stays. Files of the user
    are never replaced: `path` must be new, or an empty folder, or contain only the names in `replaces`, which the same
    command writes.

    `OutputError` if `path` is a file or contains anything else, its folder is missing or cannot be written, or the disk
    is full.
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
        _check_contents(path, replaces)
        if path.is_dir():
            _replace_folder(temporary, path)
        else:
            os.replace(temporary, path)
    except OutputError as error:  # the message names a file in the temporary folder, which will be gone
        raise OutputError(error.message.replace(str(temporary), str(path)), error.hint) from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}", "is the disk full?") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_new_folder(path: str | Path, replaces: Collection[str] = ()) -> Path:
    """The path where `folder_on_success` would create a folder; `OutputError` if it could not.

    Call it before long work.
    """
    path = _resolve_link(Path(path))
    folder = path.parent
    if path.exists() and not path.is_dir():
        raise OutputError(f"cannot make the folder {path}: it is a file", "choose another name")
    _check_contents(path, replaces)
    if path.is_dir() and path.samefile(Path.cwd()):
        raise OutputError(f"cannot make the folder {path}: it is the current folder", "give the name of a new one")
    if not folder.is_dir():
        raise OutputError(
            f"cannot make {path}: there is no folder {folder}", f"make it first: mkdir -p {shlex.quote(str(folder))}"
        )
    return path


def _check_contents(path: Path, names: Collection[str]) -> None:
    """`OutputError` if there is a folder at ``path`` with anything but ``names`` in it."""
    if path.is_dir() and any(entry.name not in names for entry in path.iterdir()):
        raise OutputError(f"the folder {path} is not empty", "choose a new one, or empty it first")


def _replace_folder(new: Path, path: Path) -> None:
    """Replace the folder at ``path`` by ``new``; on failure the old folder is restored."""
    old = new.with_name(f"{new.name}-old")
    os.replace(path, old)
    try:
        os.replace(new, path)
    except BaseException:
        os.replace(old, path)
        raise
    shutil.rmtree(old, ignore_errors=True)
