"""Numbers out of text, fast: whole files at a time, no loop over lines."""

from __future__ import annotations

import re
import warnings

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.shapes.formats import damaged

_SPACE = np.zeros(256, bool)
_SPACE[[9, 10, 11, 12, 13, 32]] = True


def numbers(name: str, text: bytes) -> Float[Floats, " N"]:
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
                raise damaged(name, f"found {word[:20].decode(errors='replace')!r} where a number should be") from None
            values.append(np.nan)
    return np.array(values)


def words_per_line(text: bytes) -> Int[Ints, " lines"]:
    """How many words each non-blank line of `text` has."""
    if not text:
        return np.empty(0, np.int64)
    characters = np.frombuffer(text, np.uint8)
    space = _SPACE[characters]
    begins = ~space
    begins[1:] &= space[:-1]
    before = np.searchsorted(np.flatnonzero(begins), np.flatnonzero(characters == 10))
    counts = np.diff(before, prepend=0, append=np.count_nonzero(begins))
    return counts[counts > 0].astype(np.int64)


def lines_of(text: bytes, *words: bytes) -> list[tuple[bytes, Ints]]:
    """For each of the given first words: its lines without that word, and which lines of the text they are.

    Spaces in front of the word are allowed.
    """
    characters = np.frombuffer(text + b"\n", np.uint8)
    ends = np.flatnonzero(characters == 10)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if ((characters[starts] == 32) | (characters[starts] == 9)).any():
        return lines_of(re.sub(rb"^[ \t]+", b"", text, flags=re.MULTILINE), *words)
    lengths = np.diff(ends, prepend=-1)
    out = []
    for word in words:
        chosen = lengths > len(word) + 1
        for k, letter in enumerate(word):
            chosen &= characters[np.minimum(starts + k, ends)] == letter
        chosen &= _SPACE[characters[np.minimum(starts + len(word), ends)]]
        kept = characters[np.repeat(chosen, lengths)]
        first = np.cumsum(lengths[chosen]) - lengths[chosen]
        for k in range(len(word)):
            kept[first + k] = 32
        out.append((kept.tobytes(), np.flatnonzero(chosen)))
    return out


def first_index(text: bytes) -> bytes:
    """Each word up to its first slash: 1/2/3 becomes 1."""
    return re.sub(rb"/\S*", b"", text)


def second_index(text: bytes) -> bytes:
    """Of each word what stands between its first and its second slash: 1/2/3 becomes 2; 1, 1//3 and 1/ become 0."""
    text = re.sub(rb"(?<!\S)(?:[^\s/]++|(?=/))(?:/(?:/\S*+)?+)?+(?=\s|\Z)", b"0", text)
    return re.sub(rb"[^\s/]*+/([^\s/]*+)\S*+", rb"\1", text)


def columns(
    values: Float[Floats, " words"], counts: Int[Ints, " lines"], first: int, last: int
) -> Float[Floats, "lines width"]:
    """Columns `first` to `last` (excluded) of lines of unequal length: flat values, and words per line."""
    if len(counts) and (counts == counts[0]).all():
        return values.reshape(len(counts), -1)[:, first:last]
    starts = np.cumsum(counts) - counts
    return values[starts[:, None] + np.arange(first, last)]
