"""The one error family: what is wrong in a line, and a hint what to do about it.

Everything that the user's data or choices can cause is a `MeshmatchError`; anything else is a bug and keeps
its traceback.
"""

from collections.abc import Iterator
from contextlib import contextmanager


class MeshmatchError(Exception):
    """Something that the user can put right: what is wrong, and a hint what to do (may be empty), in one line each."""

    def __init__(self, message: str, hint: str = "") -> None:
        self.message, self.hint = (" ".join(str(text).split()) for text in (message, hint))
        super().__init__(self.message)

    def __reduce__(self) -> tuple[type["MeshmatchError"], tuple[str, str]]:
        return type(self), (self.message, self.hint)  # the hint survives a process pool


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
