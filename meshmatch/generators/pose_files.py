"""Read poses from npz, json or csv files (docs/formats.md), and mix them with generated ones.

A pose is a rotation vector (axis times angle, radians) for each joint that the file names; other joints are at rest.
Rotations are about the joint's position in the rest pose, in the body's axes (y up, facing +z, left hand at +x), and move
everything beyond the joint.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Floats32
from meshmatch.errors import InputError, OptionError
from meshmatch.generators.rig import Rig, forward_kinematics
from meshmatch.generators.rotations import rotation_from_vector
from meshmatch.shapes.input_files import read_json, read_npz, read_text

MAX_BYTES = 60_000_000
"""Maximum size of a file, checked before it is read."""
MAX_VECTORS = 5_000_000
"""Maximum number of poses times joints in a table."""
_MAX_NAME_BYTES = 1_000_000  # maximum size of an array of names, each of which becomes a Python string
COLUMNS = ("pose", "joint", "x", "y", "z")

_HINT = "see docs/formats.md for what a file of poses holds"


@dataclass(frozen=True, eq=False)
class GivenPoses:
    """Given poses to train on in addition to generated ones.

    J unique joints of the body rig, and rotation vectors in radians, none longer than a full turn. A ``share`` of the
    bodies, 0..1, is in one of these poses; ``name`` is that of the file.

    `InputError` if there are no poses, or the vectors are invalid, or a joint occurs twice; `OptionError` if the share is
    not in 0..1. Whether a rig has the joints is checked by `columns`.
    """

    joints: tuple[str, ...]
    vectors: Float[Floats32, "P J 3"]
    share: float = 0.5
    name: str = ""

    def __post_init__(self) -> None:
        vectors = np.asarray(self.vectors)
        if vectors.dtype.kind not in "fiu" or vectors.ndim != 3 or vectors.shape[1:] != (len(self.joints), 3):
            expected = f"numbers of (poses, {len(self.joints)} joints, 3)"
            raise InputError(f"rotations are {vectors.dtype} of {_format_shape(vectors.shape)}, not {expected}", _HINT)
        if vectors.size == 0:
            raise InputError("there are no poses in it", _HINT)
        if len(set(self.joints)) < len(self.joints):
            duplicate = next(name for name in self.joints if self.joints.count(name) > 1)
            raise InputError(f"joint {duplicate[:80]!r} is named twice", _HINT)
        with np.errstate(over="ignore"):  # overflow gives infinity, which is rejected below
            vectors = vectors.astype(np.float32)
        if not np.isfinite(vectors).all():
            pose, joint, _ = np.argwhere(~np.isfinite(vectors))[0]
            raise InputError(f"pose {pose} has a rotation of {self.joints[joint][:80]!r} that is not a number", _HINT)
        angle = np.linalg.norm(vectors.astype(np.float64), axis=2)  # the square of 1e30 overflows float32
        if angle.max() > 2 * math.pi + 1e-3:
            pose, joint = np.unravel_index(int(angle.argmax()), angle.shape)
            description = f"pose {pose} turns {self.joints[joint][:80]!r} by {angle[pose, joint]:.4g}"
            raise InputError(f"{description}, more than a full turn", "angles are in radians: divide degrees by 57.3")
        if not 0 <= self.share <= 1:
            raise OptionError(f"a share must be from 0 to 1, not {self.share:g}")
        object.__setattr__(self, "vectors", vectors)

    @property
    def P(self) -> int:
        return len(self.vectors)

    def columns(self, rig: Rig) -> list[int]:
        """Index of each joint in a rig; `InputError` if the rig lacks one."""
        unknown = [name for name in self.joints if name not in rig.names]
        if unknown:
            suggestions = " or ".join(get_close_matches(unknown[0], rig.names, n=3))
            hint = f"did you mean {suggestions}?" if suggestions else "docs/formats.md names all joints"
            raise InputError(f"the body has no joint {unknown[0][:80]!r}", hint)
        return [rig.joint(name) for name in self.joints]

    def mixed(
        self,
        rig: Rig,
        heads: Float[Tensor, "B J 3"],
        world: Float[Tensor, "B J 3 3"],
        offset: Float[Tensor, "B J 3"],
        generator: torch.Generator,
    ) -> tuple[Float[Tensor, "B J 3 3"], Float[Tensor, "B J 3"]]:
        """Replace the pose of a random share of the bodies; world rotations and offsets are as in `forward_kinematics`."""
        B, J = heads.shape[:2]
        replaced = torch.rand(B, generator=generator) < self.share
        pick = torch.randint(self.P, (B,), generator=generator)
        vectors = torch.zeros(B, J, 3)
        vectors[:, self.columns(rig)] = torch.tensor(self.vectors)[pick]
        given_world, given_offset = forward_kinematics(rig, heads, rotation_from_vector(vectors))
        replaced = replaced[:, None, None]
        return torch.where(replaced[..., None], given_world, world), torch.where(replaced, given_offset, offset)


def load_poses(path: str | Path, share: float = 0.5) -> GivenPoses:
    """Read a file of poses; the format is determined by the suffix.

    `InputError` if the file is missing, too large, damaged, of another format or without poses; other errors as
    `GivenPoses`.
    """
    path = Path(path)
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise InputError(f"{path.name} is not a file of poses", f"the suffix is one of {', '.join(_READERS)}")
    if not path.is_file():
        raise InputError(f"there is no file {path}", _HINT)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path.name}: it is larger than {MAX_BYTES // 10**6} MB", "split it, or keep fewer poses")
        joints, vectors = read(path)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, csv.Error, RecursionError) as error:
        raise InputError(f"{path.name} is not a file of poses: {error}", _HINT) from error
    try:
        return GivenPoses(tuple(joints), vectors, share, path.name)
    except InputError as error:
        raise InputError(f"{path.name}: {error.message}", error.hint) from error


def _read_npz(path: Path) -> tuple[list[Any], Any]:
    """Read arrays `joints` (J,) of strings and `rotations` (P, J, 3)."""
    arrays = read_npz(path, ("joints", "rotations"))
    joints = _entry(arrays, "joints")
    if joints.dtype.kind not in "US" or joints.ndim != 1:
        raise ValueError(f"joints are {joints.dtype} of {_format_shape(joints.shape)}, not a list of names")
    if max(joints.nbytes, len(joints)) > _MAX_NAME_BYTES:
        raise ValueError(f"{len(joints)} joints of {joints.dtype} are too many")
    return joints.astype(np.str_).tolist(), _entry(arrays, "rotations")


def _read_json(path: Path) -> tuple[list[Any], Any]:
    """Read an object with `joints`, a list of names, and `rotations`, nested lists of numbers."""
    record: Any = read_json(path)
    if not isinstance(record, dict):
        raise ValueError("it is not an object with joints and rotations")
    joints, rotations = _entry(record, "joints"), _entry(record, "rotations")
    if not isinstance(joints, list) or not all(isinstance(word, str) for word in joints):
        raise ValueError("joints are not a list of names")
    try:
        return joints, np.array(rotations, np.float64)
    except (ValueError, TypeError, OverflowError):
        raise ValueError("rotations are not lists of numbers of equal length") from None


def _read_csv(path: Path) -> tuple[list[Any], Any]:
    """Read rows of `pose, joint, x, y, z`, one for each rotated joint; rows of one pose have the same first entry."""
    poses: dict[str, int] = {}
    joints: dict[str, int] = {}
    turns: dict[tuple[int, int], list[float]] = {}
    with io.StringIO(read_text(path, 450)) as file:
        rows = csv.reader(file)
        if tuple(word.strip() for word in next(rows, [])) != COLUMNS:
            raise ValueError(f"its first line is not {','.join(COLUMNS)}")
        for row in filter(None, rows):
            if len(row) != len(COLUMNS):
                raise ValueError(f"line {rows.line_num} has {len(row)} columns, not {len(COLUMNS)}")
            pose, joint = (word.strip() for word in row[:2])
            key = poses.setdefault(pose, len(poses)), joints.setdefault(joint, len(joints))
            if key in turns:
                raise ValueError(f"line {rows.line_num} turns {joint[:80]!r} of pose {pose[:80]!r} again")
            try:
                turns[key] = [float(word) for word in row[2:]]
            except ValueError:
                raise ValueError(f"line {rows.line_num} has text instead of numbers") from None
    if len(poses) * len(joints) > MAX_VECTORS:
        raise ValueError(f"{len(poses)} poses of {len(joints)} joints are too many")
    vectors = np.zeros((len(poses), len(joints), 3))
    for key, turn in turns.items():
        vectors[key] = turn
    return list(joints), vectors


def _entry(record: dict[str, Any], name: str) -> Any:
    if name not in record:
        raise ValueError(f"it has no {name}")
    return record[name]


def _format_shape(shape: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in shape) or "no shape"


_READERS = {".npz": _read_npz, ".json": _read_json, ".csv": _read_csv}
