"""Lock the output folder, so that only one training writes to it at a time."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, cast

from meshmatch.locks import locked
from meshmatch.outputs import as_path, make_folder

CHECKPOINT = Path("checkpoint", "last.safetensors")  # relative to the model folder
ALIGNER = Path("checkpoint", "aligner.safetensors")  # checkpoint of an interrupted training of the aligner
Train = TypeVar("Train", bound=Callable[..., Any])


def exclusive_folder(train: Train) -> Train:
    """Decorate a training function: make the output folder, its first argument, and lock it during the call.

    `OutputError` if another process holds the lock. The lock is released even if that process is killed.
    """

    @wraps(train)
    def locked_train(output: str | Path, *args: Any, **kwargs: Any) -> Any:
        folder = (as_path(output) / CHECKPOINT).parent
        make_folder(folder)
        if os.environ.get("RANK", "0") != "0":  # the process with rank 0 holds the lock for all
            return train(output, *args, **kwargs)
        with locked(folder / "lock", f"another training writes to {output}", "let it end, or choose another folder"):
            return train(output, *args, **kwargs)

    return cast(Train, locked_train)
