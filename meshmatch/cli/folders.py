"""Folders that a verb writes into."""

from pathlib import Path

from meshmatch.errors import OutputError


def make_folder(path: Path) -> None:
    """Make a folder if it is not there.

    Raises
    ------
    OutputError
        It cannot be made, or is a file.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the folder {path}: {error.strerror}", "choose another with -o"
        ) from error
