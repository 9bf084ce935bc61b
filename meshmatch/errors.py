"""The library's errors and warnings: a line that says what is wrong, and a hint on what to do about it.

Whatever the user's data or choices can cause is a `MeshmatchError`; any other exception is a bug and keeps its
traceback. What users should know, but need not stop for, is a `MeshmatchWarning`.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

MAX_MESSAGE_LENGTH = 300
"""Maximum length of a message or a hint, in characters; longer ones are elided in the middle."""
_INVISIBLE = dict.fromkeys(
    (*range(32), *range(127, 160), 0x2028, 0x2029, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
)
_REPLACEMENTS = {code: "\ufffd" for code in _INVISIBLE if chr(code) not in "\t\n"}


class MeshmatchError(Exception):
    """An error that the user can correct; the base class of all errors of the library.

    Parameters
    ----------
    message
        What is wrong, in one line.
    hint
        What to do about it, in one line; may be empty.

    Examples
    --------
    >>> try:
    ...     meshmatch.load_shape("missing.ply")
    ... except meshmatch.MeshmatchError as error:
    ...     print(error.message, error.hint)
    """

    def __init__(self, message: str, hint: str = "") -> None:
        self.message, self.hint = (_line(text) for text in (message, hint))
        super().__init__(self.message)

    def __reduce__(self) -> tuple[type["MeshmatchError"], tuple[str, str]]:
        return type(self), (self.message, self.hint)  # keeps the hint across a process pool


class MeshmatchWarning(UserWarning):
    """A warning about a file: what was left out, or read differently than it is written.

    Examples
    --------
    >>> import warnings
    >>> warnings.simplefilter("error", meshmatch.MeshmatchWarning)
    """


def warn(text: str) -> None:
    """Issue a one-line `MeshmatchWarning`. The command line shows each line once; in Python it is an ordinary warning."""
    warnings.warn(_line(text), MeshmatchWarning, stacklevel=2)


class InputError(MeshmatchError):
    """The user's file or data cannot be used."""


class ModelError(MeshmatchError):
    """A model's card, weights or registry entry is missing or wrong."""


class TemplateError(MeshmatchError):
    """A template is missing, damaged, or not the one that a model was trained with."""


class OptionError(MeshmatchError):
    """An unknown choice, or one that does not fit the others."""


class OutputError(MeshmatchError):
    """A result cannot be written."""


class PoorFit(MeshmatchError):
    """A fit was judged poor, and the caller asked for this to be an error."""


def visible(text: str) -> str:
    """Text that cannot control a terminal: control characters, but for tabs and new lines, become U+FFFD.

    So do those that change the direction of text.
    """
    return text.translate(_REPLACEMENTS)


def _line(text: str) -> str:
    line = visible(" ".join(str(text).split()))
    return line if len(line) <= MAX_MESSAGE_LENGTH else f"{line[: MAX_MESSAGE_LENGTH - 103]}...{line[-100:]}"


@contextmanager
def needs(library: str, extra: str) -> Iterator[None]:
    """Wrap an import: a missing library becomes an `OptionError` with the extra that installs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != library:
            raise
        hint = f"pip install 'meshmatch[{extra}]'"
        raise OptionError(f"this needs {library}, which is not installed", hint) from error
