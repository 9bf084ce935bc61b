"""Recipes: all settings of a training; and the choice of a recipe for a folder of shapes."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from meshmatch.errors import OptionError
from meshmatch.generators.kinds import Kind
from meshmatch.generators.proportions import STYLISED
from meshmatch.geometry.kernels import KERNELS, Kernel
from meshmatch.models.checkpoint import Storage
from meshmatch.models.network import PAPER, NetworkConfig
from meshmatch.models.trained import TrainedModel
from meshmatch.templates.prepared_folder import card_frame, check_prepared, is_registered
from meshmatch.training.limits import with_changes
from meshmatch.training.loop import TrainConfig
from meshmatch.training.losses import ChamferLoss, CorrespondenceLoss
from meshmatch.training.scans import ScanConfig

Preset = Literal["default", "paper"]
_SCAN_SETTINGS, _LOSS_SETTINGS = {"points"}, {"volume", "arap", "blend"}
_PLAIN_ADAM: dict[str, Any] = {
    "warm_up": 0, "decay": 0.0, "weight_decay": 0.0, "average": 0.0, "momentum": 0.999, "clip": None,
}  # fmt: skip
_CHAMFER = ChamferLoss(volume=1e-4, arap=1e-3, blend=1e-4)  # the paper's weights for segmentation transfer (table 2)


@dataclass(frozen=True)
class Recipe:
    """All settings of a training: together with the shapes they determine the result.

    Attributes
    ----------
    network
        Architecture and sizes of the network.
    train
        Steps, rates and minutes; its ``loss`` is minimised.
    scan
        How scans are simulated.
    kernel
        Kernel of the deformation field: "cubic" or "smooth".
    deform
        Deform registered shapes smoothly whenever they are drawn. The network then finds no orientation; the card records
        how a fit finds it.
    storage
        Number format of the weights in the file.
    template
        Name of the bundled template of generated bodies, unless `Bodies` names another.
    characters
        Share (0..1) of generated bodies with clothes or other proportions, unless `Bodies` sets it.
    stylised
        Share of these with the proportions of cartoons, unless `Bodies` sets it.
    bodies
        Number of generated bodies in a fixed pool; 0 generates new ones in every step. Unless `Bodies` sets it.

    Examples
    --------
    >>> recipe = meshmatch.recipe_for("my-prepared").changed(minutes=60, volume=2e-3)
    >>> print(recipe.train.steps, recipe.train.loss)
    """

    network: NetworkConfig
    train: TrainConfig
    scan: ScanConfig
    kernel: Kernel
    deform: bool = False
    storage: Storage = "int8"
    template: str = "human-T"
    characters: float = 0.0
    bodies: int = 0
    stylised: float = STYLISED

    def changed(self, **settings: Any) -> Recipe:
        """Return a copy with other settings.

        Parameters
        ----------
        settings
            Fields of `TrainConfig`, ``field`` of the network, ``points`` of the scans, ``volume``, ``arap`` and ``blend`` of
            the loss. A value of None leaves the setting as it is.

        Returns
        -------
        Recipe
            A recipe with these settings.

        Raises
        ------
        OptionError
            A setting is unknown or out of range.
        """
        given = {name: value for name, value in settings.items() if value is not None}
        changes = {name: value.item() if isinstance(value, np.generic) else value for name, value in given.items()}
        network = replace(self.network, field=changes.pop("field", self.network.field))
        scan, weights = (
            {name: changes.pop(name) for name in names & changes.keys()} for names in (_SCAN_SETTINGS, _LOSS_SETTINGS)
        )
        train = replace(self.train, loss=changes.pop("loss", self.train.loss))
        train = replace(train, loss=with_changes(train.loss, weights))
        train_fields = {each.name for each in fields(TrainConfig)}
        if unknown := sorted(changes.keys() - train_fields):
            raise OptionError(
                f"unknown training setting {unknown[0]!r}", f"choose from {', '.join(sorted(train_fields))}"
            )
        return replace(self, network=network, scan=with_changes(self.scan, scan), train=with_changes(train, changes))


def default() -> Recipe:
    """Recipe for many registered shapes; selected on generated bodies (docs/paper.md)."""
    loss = CorrespondenceLoss(volume=2e-3, arap=2e-3, blend=1e-3, robust=True)
    return Recipe(NetworkConfig(), TrainConfig(steps=13_000, decay=0.65, loss=loss), ScanConfig(), "smooth")


def people() -> Recipe:
    """Recipe for generated people: half of them naked, half characters; some scans have foreign objects, some lack hidden
    surfaces."""
    recipe = default()
    return replace(recipe, scan=replace(recipe.scan, outside=0.2, strays=0.12), characters=0.5)


def paper() -> Recipe:
    """Recipe of the NeurIPS 2022 paper: point encoder, node decoder, squared loss, plain Adam, and the paper's loss weights,
    kernel, batch size and learning rate.

    Scans are 3,000 clean points in the unit sphere, turned about the vertical axis; 75,000 steps are its 1,200 epochs of
    1,000 shapes, a fixed pool. The template has 300 nodes as in the paper, each with a radius of a fifth of the diameter.
    """
    train = TrainConfig(steps=75_000, shapes=16, scans_per_shape=1, **_PLAIN_ADAM)
    clean: dict[str, Any] = dict.fromkeys(("noise", "holes", "outliers", "partial", "density", "bumps", "scale"), 0.0)
    scan = ScanConfig(3000, upright=True, sphere=True, **clean)
    return Recipe(PAPER, train, scan, "cubic", template="human-T-300", bodies=1000)


def small_data() -> Recipe:
    """Recipe for fewer than a hundred registered shapes: a small network that finds no orientation; evaluated on hearts and
    animals (docs/categories.md)."""
    network = NetworkConfig(code=128, width=256, depth=1, basis=384, align_basis=0, corrections=2, correct_width=256)
    loss = CorrespondenceLoss(volume=1e-3, arap=1e-3, blend=1e-3, robust=True)
    speed: dict[str, Any] = {"decay": 0.5, "warm_up": 100, "average": 0.99}
    train = TrainConfig(steps=3000, shapes=8, scans_per_shape=1, loss=loss, workers=0, **speed)
    return Recipe(network, train, ScanConfig(points=1024), "smooth", deform=True)


def clouds() -> Recipe:
    """Recipe for shapes without correspondence: the network for small data, with the paper's weights for segmentation
    transfer."""
    small = small_data()
    return replace(small, train=replace(small.train, loss=_CHAMFER), storage="float16")


def paper_clouds() -> Recipe:
    """Recipe of the paper for shapes without correspondence: its network and weights, and a plain squared Chamfer distance.

    For folders from `meshmatch prepare --scale sphere` the loss is in units of the unit sphere, as in the paper.
    """
    loss = replace(_CHAMFER, plain=True)
    train = TrainConfig(steps=4000, shapes=8, scans_per_shape=1, loss=loss, workers=0, **_PLAIN_ADAM)
    scan = ScanConfig(points=1024, noise=0.0, scale=0.0, sphere=True)
    return Recipe(PAPER, train, scan, "cubic", storage="float16")


def compact() -> Recipe:
    """Recipe for generated hands and heads: half the network size, half the shapes in a step, and the aligner is trained
    first."""
    recipe = people()
    network = NetworkConfig(code=384, width=512, basis=640, align_basis=384, align_width=384, correct_width=448)
    train = replace(recipe.train, steps=4000, shapes=16, rate=8e-4, align_steps=3000)
    return replace(recipe, network=network, train=train, characters=0.0)


def fine_tuning(start: TrainedModel) -> Recipe:
    """Recipe for continuing a model's training on shapes that it has fitted: its network and kernel, at a low rate."""
    recipe = people()
    train = replace(recipe.train, steps=1500, rate=1e-4, shapes=16, decay=0.5)
    kernel = next(name for name in KERNELS if name == start.card.field["kernel"])
    start_scan = start.card.recipe.get("scan", {})
    scan = replace(recipe.scan, **{name: bool(start_scan.get(name)) for name in ("upright", "sphere")})
    recipe = replace(recipe, scan=scan, characters=0.0)
    return replace(recipe, network=start.inference.config, kernel=kernel, train=train, deform=True)


def recipe_for(
    shapes: str | Path | None = None, preset: Preset = "default", unsupervised: bool = False, kind: str | None = None
) -> Recipe:
    """Choose the recipe for a folder of shapes, or for generated shapes.

    Shapes are learned with correspondence if all of them are registered. Fewer than a hundred registered shapes, prepared
    at equal areas, get the recipe for small data; the paper's preset has no such recipe.

    Parameters
    ----------
    shapes
        A prepared folder (see `prepare`); None for generated shapes.
    preset
        "default", or "paper" for the settings of the NeurIPS 2022 paper.
    unsupervised
        Ignore the correspondence of registered shapes.
    kind
        Kind of generated shapes: "human" (the default), "quadruped", "hand" or "head".

    Returns
    -------
    Recipe
        A recipe for `train`.

    Raises
    ------
    OptionError
        The preset or the kind is unknown, a kind is given with a folder, or ``unsupervised`` without one.
    InputError
        The folder is not prepared.

    Examples
    --------
    >>> recipe = meshmatch.recipe_for("my-prepared").changed(minutes=60)
    >>> meshmatch.train("my-model", shapes="my-prepared", recipe=recipe)
    """
    if preset not in ("default", "paper"):
        raise OptionError(f"unknown preset {preset!r}", "choose default or paper")
    if shapes is None and unsupervised:
        raise OptionError("learning without correspondence needs a folder of shapes", "name it with --shapes")
    if kind not in (None, "human"):
        Kind(kind)  # raises if the kind is unknown
    if shapes is not None:
        if kind is not None:
            raise OptionError("generated shapes cannot be combined with a folder of shapes", "leave out one of the two")
        check_prepared(shapes)
    if shapes is not None and (unsupervised or not is_registered(shapes)):
        return paper_clouds() if preset == "paper" else clouds()
    if preset == "paper":
        return paper()
    if shapes is None:
        return compact() if kind in ("hand", "head") else people()
    return small_data() if card_frame(shapes) else default()
