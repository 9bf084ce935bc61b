"""A trained model ready for use: card, template, network."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import torch

from meshmatch.errors import ModelError
from meshmatch.fields.choice import has_nodes
from meshmatch.fields.field import PointField
from meshmatch.fields.mls import KERNELS
from meshmatch.models.card import ModelCard
from meshmatch.models.checkpoint import load_weights
from meshmatch.models.deformer import Deformer, NetworkConfig
from meshmatch.models.registry import find_model
from meshmatch.templates.template import Template, load_template

_DERIVING = threading.RLock()
P = ParamSpec("P")
Derived = TypeVar("Derived")


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """What fitting needs of a category. ``network`` is in evaluation mode, on the CPU.

    ``derived`` holds what was computed from the model alone, see `once_per_model`.
    """

    card: ModelCard
    template: Template
    network: Deformer
    derived: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    def field(self, points: np.ndarray) -> PointField:
        """The field on points (P, 3) of the template's frame, with the kernel that the network was trained with.

        Raises
        ------
        TemplateError
            A point has too few nodes in reach.
        """
        nodes, radius = self.template.nodes, self.template.radius
        return self.network.field(points, nodes, radius, self.card.field["kernel"])

    @property
    def has_nodes(self) -> bool:
        """Whether its fits are node vectors, which can be solved for; a pointwise model has codes alone."""
        return has_nodes(self.network.config.field)


def once_per_model(
    derive: Callable[Concatenate[TrainedModel, P], Derived],
) -> Callable[Concatenate[TrainedModel, P], Derived]:
    """Let a function of a model (and of hashable arguments) compute once for each model, whatever threads ask for it.

    The result lives as long as the model does.
    """

    @wraps(derive)
    def once(model: TrainedModel, *args: P.args, **kwargs: P.kwargs) -> Derived:
        key = (derive, args, tuple(sorted(kwargs.items())))
        with _DERIVING:
            if key not in model.derived:
                model.derived[key] = derive(model, *args, **kwargs)
            return model.derived[key]

    return once


def blank_deformer(config: NetworkConfig, K: int) -> Deformer:
    """A network of the right shape whose weights and buffers are still to be read; K nodes."""
    return Deformer(
        config,
        nodes=torch.zeros(K, 3),
        anchors=torch.zeros(K, 3),
        anchor_phi=torch.zeros(K, K) if has_nodes(config.field) else None,
        basis=torch.zeros(config.basis, 3),
        align_basis=torch.zeros(max(config.align_basis, 1), 3),
    )


def load_model(name: str | Path = "human") -> TrainedModel:
    """Load a model by its registry name or folder.

    Raises
    ------
    ModelError
        Unknown name, damaged files, a kernel that is not known here, or a template that is not the one the
        model was trained with.
    """
    folder, card = find_model(name)
    template = load_template(folder / "template.safetensors")
    if template.hash != card.template_hash:
        raise ModelError(
            f"model {card.name} was trained with another template ({card.template_hash}, not {template.hash})",
            "add the model again from its source",
        )
    if card.field["kernel"] not in KERNELS:
        raise ModelError(
            f"model {card.name} has the kernel {card.field['kernel']!r}, not {' or '.join(KERNELS)}",
            "it may need a newer meshmatch: update it",
        )
    network = blank_deformer(NetworkConfig.from_dict(card.network), template.K)
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    network.load_state_dict(load_weights(folder / "weights.safetensors", expected))
    network.eval()
    return TrainedModel(card, template, network)
