"""One training at a time writes to a folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from meshmatch.locks import locked
from meshmatch.outputs import as_path, make_folder

CHECKPOINT = Path("checkpoint", "last.safetensors")  # in the model folder
P = ParamSpec("P")
Made = TypeVar("Made")


def alone(train: Callable[Concatenate[str | Path, P], Made]) -> Callable[Concatenate[str | Path, P], Made]:
    """Let a training make its output folder, and refuse a second one in it (`OutputError`) until the first ends or is
    killed.
    """

    @wraps(train)
    def only(output: str | Path, *args: P.args, **kwargs: P.kwargs) -> Made:
        folder = (as_path(output) / CHECKPOINT).parent
        make_folder(folder)
        if os.environ.get("RANK", "0") != "0":  # of several processes the first holds the lock for all
            return train(output, *args, **kwargs)
        with locked(folder / "lock", f"another training writes to {output}", "let it end, or choose another folder"):
            return train(output, *args, **kwargs)

    return only
