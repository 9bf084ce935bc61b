"""One training at a time writes to a folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, cast

from meshmatch.locks import locked
from meshmatch.outputs import as_path, make_folder

CHECKPOINT = Path("checkpoint", "last.safetensors")  # in the model folder
ALIGNER = Path("checkpoint", "aligner.safetensors")  # of one that was stopped before all else could be learned
Train = TypeVar("Train", bound=Callable[..., Any])


def alone(train: Train) -> Train:
    """Let a training make its output folder, and refuse a second one in it (`OutputError`) until the first ends or is
    killed.
    """

    @wraps(train)
    def only(output: str | Path, *args: Any, **kwargs: Any) -> Any:
        folder = (as_path(output) / CHECKPOINT).parent
        make_folder(folder)
        if os.environ.get("RANK", "0") != "0":  # of several processes the first holds the lock for all
            return train(output, *args, **kwargs)
        with locked(folder / "lock", f"another training writes to {output}", "let it end, or choose another folder"):
            return train(output, *args, **kwargs)

    return cast(Train, only)
