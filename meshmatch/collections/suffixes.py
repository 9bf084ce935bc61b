"""Suffixes of the files that a transfer to several targets writes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from meshmatch.errors import OptionError


@dataclass(frozen=True)
class Ending:
    """The rule for the suffix of a target's output: the target's own suffix if it is in ``own``, else ``suffix``."""

    suffix: str
    own: tuple[str, ...] = ()

    def __call__(self, file: Path) -> str:
        """The suffix for a target's file."""
        return file.suffix.lower() if file.suffix.lower() in self.own else self.suffix


DEFAULT_SUFFIXES = {
    "transfer_colors": Ending(".ply", (".glb", ".vrm", ".obj", ".off")),
    "transfer_values": Ending(".ply"),  # the format of the target may not support values
    "transfer_labels": Ending(".npy"),
    "transfer_weights": Ending(".npz"),
    "transfer_landmarks": Ending(".csv"),
    "measure": Ending(".csv"),
    "transfer_rig": Ending(".glb"),
    "transfer_shapes": Ending(".glb", (".vrm",)),
    "transfer_texture": Ending(".glb", (".obj", ".vrm")),
    "transfer_garment": Ending(""),  # the garment's own suffix
}
"""Default endings, by the name of the transfer function."""


def choose_suffix(
    transfer: str, given: str | None, garment: Path | None, targets: Mapping[str, Path], join: bool = False
) -> Ending:
    """Choose the ending of a transfer's files, and check it for all targets.

    Parameters
    ----------
    transfer : name of the transfer function
    given : suffix that the user chose, if any
    garment : file of the garment, whose suffix a garment keeps
    targets : files of the targets, by name
    join : whether a garment is added to the file of its target

    Raises
    ------
    OptionError
        The transfer cannot write such files; or it is not known and no suffix is given.
    """
    found = DEFAULT_SUFFIXES.get(transfer)
    if given is not None:
        found = Ending(f".{given.removeprefix('.')}")
    elif found is None:
        raise OptionError(f"what {transfer} writes is not known", "give the suffix of its files")
    elif join:
        found = Ending(".glb", (".vrm",))
    elif not found.suffix:
        own = ".obj" if garment is None else garment.suffix.lower()
        found = Ending(".glb" if own in (".gltf", ".vrm") else own)
    for suffix, name in {found(file): name for name, file in reversed(list(targets.items()))}.items():
        _check("join" if join else transfer, f"{name.rpartition('/')[2]}{suffix}")
    return found


def _check(transfer: str, name: str) -> None:
    """Raise `OptionError` if a transfer cannot write a file of this name."""
    from meshmatch.api import blend_shapes, rig
    from meshmatch.shapes import files, tables, textured_files
    from meshmatch.transfer import label_files, landmarks, measurements, value_files, weight_files

    if Path(name).name != name:
        raise OptionError(f"{name}: --format is a suffix", "such as .glb")
    checks: dict[str, Callable[[Path], object]] = {
        "transfer_colors": value_files.check_color_suffix,
        "transfer_values": value_files.check_values_suffix,
        "transfer_labels": label_files.check_labels_suffix,
        "transfer_weights": weight_files.check_weights_suffix,
        "transfer_landmarks": landmarks.check_landmarks_suffix,
        "measure": measurements.check_measurements_suffix,
        "transfer_rig": rig.check_rig_suffix,
        "transfer_shapes": blend_shapes.check_suffix,
        "transfer_texture": textured_files.check_textured,
        "transfer_garment": files.check_suffix,
        "join": partial(tables.check_suffix, suffixes=(".glb", ".vrm"), what="a target with a garment in it"),
    }
    if transfer in checks:
        checks[transfer](Path(name))
