"""Output files appear whole or not at all."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from meshmatch.errors import OutputError


@contextmanager
def replace_on_success(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path`, and rename it to `path` when the block ends well.

    The temporary name keeps the suffix, so writers that choose a format by it still do. On any exception,
    Ctrl-C included, the temporary file is removed and whatever was at `path` before is untouched.

    Raises
    ------
    OutputError
        The folder is missing or cannot be written, `path` is a folder, or the disk refuses the write.
    """
    path = Path(path)
    folder = path.parent
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder", "give the name of a file")
    if not folder.is_dir():
        raise OutputError(
            f"cannot write {path}: there is no folder {folder}", f"make it first: mkdir -p {folder}"
        )
    temporary = folder / f".{path.stem[:80]}.{secrets.token_hex(4)}{path.suffix}"
    try:
        temporary.touch(exist_ok=False)  # tells now, not after minutes of work
        mode = temporary.stat().st_mode  # some writers make files that only their owner may read
    except OSError as error:
        raise OutputError(
            f"cannot write {path}: {error.strerror}", "choose another folder with -o"
        ) from error
    try:
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, path)
    except OSError as error:
        if error.filename in (None, str(temporary), temporary):
            raise OutputError(
                f"cannot write {path}: {error.strerror or error}", "is the disk full?"
            ) from error
        raise
    finally:
        temporary.unlink(missing_ok=True)
