"""Read and write the arrays of an atlas; damaged files and files of other versions are rejected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from meshmatch.arrays import set_read_only
from meshmatch.collections.superimpose import MAX_GROUPS, Scale
from meshmatch.errors import InputError
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.input_files import read_npz
from meshmatch.shapes.shape import LARGEST

FILE = "atlas.npz"
VERSION = 1
"""Version of the arrays in ``atlas.npz``."""
_SUM_TOLERANCE = 0.01  # for the sum of the weights, which may be in half precision


def save_arrays(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Write the arrays and the version; `OutputError` if the file cannot be written."""
    with replace_on_success(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays, version=np.int64(VERSION))


def load_arrays(path: str | Path, names: Sequence[str]) -> dict[str, Any]:
    """Read the arrays of these names from an ``atlas.npz``, or the folder of one; `InputError` if missing or damaged."""
    file = Path(path) / FILE if Path(path).is_dir() else Path(path)
    if not file.is_file():
        raise InputError(f"there is no atlas at {path}", "give the folder that `meshmatch atlas` made")
    return _validated(file, read_npz(file, (*names, "version")))


def _validated(file: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Validate the arrays of a file and convert them to the fields of an `Atlas`; `InputError` if any is wrong."""
    version = given.pop("version", np.empty(0))
    if version.dtype.kind not in "iu" or version.shape != () or version != VERSION:
        raise InputError(f"{file} is not an atlas of version {VERSION}", "make it again with this meshmatch")
    M, V, S, F = (
        len(given[name]) if np.ndim(given.get(name, 0)) else -1 for name in ("modes", "mean", "names", "faces")
    )
    layout: dict[str, tuple[str, tuple[int, ...]]] = {  # dtype kind and shape
        **{"mean": ("f", (V, 3)), "modes": ("f", (M, V, 3)), "deviations": ("f", (M,)), "scores": ("f", (S, M))},
        **{
            "sizes": ("f", (S,)),
            "faces": ("i", (F, 3)),
            "weights": ("f", (V,)),
            "names": ("U", (S,)),
            "total": ("f", ()),
        },
        **{"scale": ("U", ()), "robust": ("b", ()), "template": ("U", ())},
        **({"groups": ("i", (V,))} if "groups" in given else {}),
    }
    matches_layout = {
        n: n in given and (given[n].dtype.kind, given[n].shape) == expected for n, expected in layout.items()
    }
    numbers = {
        n: given[n].astype(np.float64) for n in layout if matches_layout[n] and layout[n][0] == "f"
    }  # floats of any precision
    invalid = [n for n in layout if not matches_layout[n] or not (np.abs(numbers.get(n, 0.0)) < LARGEST).all()]
    if not invalid:
        weights, faces = numbers["weights"], given["faces"]
        checks = {
            "deviations": (numbers["deviations"] > 0).all(),
            "sizes": (numbers["sizes"] > 0).all(),
            "weights": (weights >= 0).all() and abs(weights.sum() - 1) <= _SUM_TOLERANCE,
            "faces": F > 0 and faces.min() >= 0 and faces.max() < V,
            "scale": str(given["scale"]) in get_args(Scale),
            "groups": "groups" not in given or _are_valid_groups(given["groups"]),
        }
        invalid = [name for name, holds in checks.items() if not holds]
    if invalid:
        raise InputError(f"{file} is damaged: {', '.join(invalid)}", "make it again")
    found: dict[str, Any] = {name: set_read_only(array) for name, array in (given | numbers).items()}
    words = {"names": tuple(map(str, given["names"])), "scale": str(given["scale"]), "template": str(given["template"])}
    return found | words | {"total": float(given["total"]), "robust": bool(given["robust"])}


def _are_valid_groups(given: np.ndarray) -> bool:
    """Whether the group numbers are 0, 1, 2, ... without gaps and not too many, and perhaps -1."""
    found = np.unique(given)
    counted = found[found >= 0]
    return bool(found[0] >= -1 and 0 < len(counted) <= MAX_GROUPS and counted[-1] == len(counted) - 1)
