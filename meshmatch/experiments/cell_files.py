"""What was measured, as files: a run that was stopped goes on with what is missing.

Each file answers one question, and says which: what was asked is kept beside the answer, and a file that answers
another question is not taken for this one's.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from meshmatch.errors import InputError, OptionError
from meshmatch.outputs import make_folder, replace_on_success


def recall(path: Path, asked: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a file answers; None where there is no file.

    Raises
    ------
    InputError
        The file is damaged.
    OptionError
        It answers another question.
    """
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        before = found["asked"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is no cell of this benchmark", "remove it to measure again") from error
    if before != _plain(asked):
        raise OptionError(
            f"{path} was measured with other choices ({_difference(before, _plain(asked))})",
            "choose another folder with --output, or remove it",
        )
    return dict(found)


def keep(path: Path, asked: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, Any]:
    """Write an answer with its question, and return both."""
    record = _plain({"asked": asked, **found})
    make_folder(path.parent)
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return record


def once(path: Path, asked: Mapping[str, Any], measure: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """What a file answers; it is measured and written where there is none."""
    found = recall(path, asked)
    return keep(path, asked, measure()) if found is None else found


def _plain(value: Mapping[str, Any]) -> dict[str, Any]:
    """As JSON gives it back: tuples are lists."""
    return dict(json.loads(json.dumps(value)))


def _difference(before: Any, now: Mapping[str, Any]) -> str:
    keys = {*before, *now} if isinstance(before, dict) else set(now)
    return ", ".join(
        sorted(key for key in keys if not isinstance(before, dict) or before.get(key) != now.get(key))
    )
