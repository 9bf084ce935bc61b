"""The one error family: what is wrong in a line, and a hint what to do about it.

Everything that the user's data or choices can cause is a `MeshmatchError`; anything else is a bug and keeps
its traceback. What is worth a word but stops nothing is a `MeshmatchWarning`.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

LONGEST = 300
"""Letters of a message or a hint; of a longer one the middle is left out."""
_UNSEEN = dict.fromkeys((*range(32), *range(127, 160), 0x2028, 0x2029, *range(0x202A, 0x202F), *range(0x2066, 0x206A)))
_SHOWN = {code: "\ufffd" for code in _UNSEEN if chr(code) not in "\t\n"}


class MeshmatchError(Exception):
    """Something that the user can put right. All errors of the library are of this class.

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
        return type(self), (self.message, self.hint)  # the hint survives a process pool


class MeshmatchWarning(UserWarning):
    """Something about a file that the user should know: what was left out, or taken in another way than it is written.

    Examples
    --------
    >>> import warnings
    >>> warnings.simplefilter("error", meshmatch.MeshmatchWarning)
    """


def warn(text: str) -> None:
    """Warn in one line (`MeshmatchWarning`). The command line shows each line once; in Python it is a usual warning."""
    warnings.warn(_line(text), MeshmatchWarning, stacklevel=2)


class InputError(MeshmatchError):
    """The user's file or data cannot be used."""


class ModelError(MeshmatchError):
    """A model's card, weights or registry entry is missing or wrong."""


class TemplateError(MeshmatchError):
    """A template is missing, damaged, or not the one that a model was trained with."""


class OptionError(MeshmatchError):
    """A choice that does not exist, or does not go with the others."""


class OutputError(MeshmatchError):
    """A result cannot be written."""


class PoorFit(MeshmatchError):
    """A fit was judged poor, and the caller asked for this to be an error."""


def visible(text: str) -> str:
    """Text that cannot command a terminal: control characters and those that turn the order of letters round become
    U+FFFD; tabs and new lines stay.
    """
    return text.translate(_SHOWN)


def _line(text: str) -> str:
    line = visible(" ".join(str(text).split()))
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 103]}...{line[-100:]}"


@contextmanager
def needs(library: str, extra: str) -> Iterator[None]:
    """Around an import: a missing library is said as the user's choice, with the extra that brings it (`OptionError`)."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != library:
            raise
        hint = f"pip install 'meshmatch[{extra}]'"
        raise OptionError(f"this needs {library}, which is not installed", hint) from error
