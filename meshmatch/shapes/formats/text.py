"""Numbers out of text, fast: whole files at a time, no loop over lines."""

import warnings

import numpy as np
from numpy.typing import NDArray

from meshmatch.shapes.formats import damaged

_SPACE = np.zeros(256, bool)
_SPACE[[9, 10, 11, 12, 13, 32]] = True


def numbers(name: str, text: bytes) -> NDArray[np.float64]:
    """All the whitespace-separated numbers of `text`, nan and inf included.

    Raises
    ------
    InputError
        Something is not a number.
    """
    if not text.strip():
        return np.empty(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # how fromstring says that it met a word
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            pass
    values = []
    for word in text.split():
        try:
            values.append(float(word))
        except ValueError:
            if b"nan" not in word.lower() and b"#" not in word:  # 1.#QNAN, -nan(ind)
                raise damaged(
                    name, f"found {word[:20].decode(errors='replace')!r} where a number should be"
                ) from None
            values.append(np.nan)
    return np.array(values)


def words_per_line(text: bytes) -> NDArray[np.int64]:
    """How many words each non-blank line of `text` has."""
    characters = np.frombuffer(text, np.uint8)
    space = _SPACE[characters]
    begins = ~space
    begins[1:] &= space[:-1]
    before = np.cumsum(begins)  # words begun up to here
    ends = np.append(before[characters == 10], before[-1] if len(before) else 0)
    counts = np.diff(ends, prepend=0)
    return counts[counts > 0].astype(np.int64)


def columns(
    values: NDArray[np.float64], counts: NDArray[np.int64], first: int, last: int
) -> NDArray[np.float64]:
    """Columns `first` to `last` (excluded) of lines of unequal length, given the flat values and words per line."""
    if len(counts) and (counts == counts[0]).all():
        return values.reshape(len(counts), -1)[:, first:last]
    starts = np.cumsum(counts) - counts
    return values[starts[:, None] + np.arange(first, last)]
