"""Cells of a table as files, so that a run that was stopped goes on with the next one."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from meshmatch.errors import InputError, OptionError
from meshmatch.experiments.iterations import Cell, Setting
from meshmatch.outputs import replace_on_success

_SETTING = "setting.json"


def read_cell(folder: Path, cell: Cell) -> dict[str, Any]:
    """What is known of a cell; empty before it was measured.

    Raises
    ------
    InputError
        The file is damaged.
    """
    path = folder / f"{cell.name}.json"
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is damaged", "delete it: the cell is then measured again") from error
    if not isinstance(found, dict):
        raise InputError(f"{path} holds no cell", "delete it: the cell is then measured again")
    return found


def keep(folder: Path, cell: Cell, **parts: Any) -> None:
    """Add to what is known of a cell."""
    record = read_cell(folder, cell) | {"field": cell.field, "constraint": cell.constraint} | parts
    with replace_on_success(folder / f"{cell.name}.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def claim(folder: Path, setting: Setting) -> None:
    """Make the folder, or see that its cells were measured as these will be.

    Raises
    ------
    OptionError
        They were not.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, words = folder / _SETTING, json.loads(json.dumps(asdict(setting)))
    if path.is_file():
        if json.loads(path.read_text(encoding="utf-8")) != words:
            raise OptionError(f"{folder} holds cells of another setting", "choose another --output")
        return
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps(words, indent=1) + "\n", encoding="utf-8")
