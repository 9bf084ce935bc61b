"""A trained model ready for use: card, template, network."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from copy import deepcopy
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import torch

from meshmatch.arrays import Float, Floats
from meshmatch.errors import ModelError
from meshmatch.fields.choice import has_nodes
from meshmatch.fields.field import PointField
from meshmatch.geometry.kernels import KERNELS
from meshmatch.models.card import ModelCard
from meshmatch.models.checkpoint import load_weights
from meshmatch.models.deformer import Deformer, NetworkConfig
from meshmatch.templates.template import Template, load_template

_DERIVING = threading.RLock()
P = ParamSpec("P")
Derived = TypeVar("Derived")


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """What fitting needs of a category. ``network`` is in evaluation mode, on the CPU until `to` moves it.

    ``derived`` holds what was computed from the model alone, see `once_per_model`.
    """

    card: ModelCard
    template: Template
    network: Deformer
    derived: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False)

    def field(self, points: Float[Floats, "P 3"]) -> PointField:
        """The field on points of the template's frame, with the kernel that the network was trained with.

        Raises
        ------
        TemplateError
            A point has too few nodes in reach.
        """
        nodes, radius = self.template.nodes, self.template.radius
        return self.network.field(points, nodes, radius, self.card.field["kernel"])

    @property
    def device(self) -> torch.device:
        """Where the network computes."""
        return self.network.nodes.device

    def to(self, device: torch.device | str) -> TrainedModel:
        """The same model on another device; the network is copied, and nothing derived is taken along."""
        return TrainedModel(self.card, self.template, deepcopy(self.network).to(device))

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
    """A network for K nodes whose weights and buffers have shapes but no memory: a card cannot ask for gigabytes."""
    with torch.device("meta"):
        return Deformer(
            config,
            nodes=torch.zeros(K, 3),
            anchors=torch.zeros(K, 3),
            anchor_phi=torch.zeros(K, K) if has_nodes(config.field) else None,
            basis=torch.zeros(config.basis, 3),
            align_basis=torch.zeros(max(config.align_basis, 1), 3),
        )


def load_network(path: str | Path, config: NetworkConfig, K: int) -> Deformer:
    """A network for K nodes with the weights of a file, in evaluation mode.

    Raises
    ------
    ModelError
        The file is damaged, or holds the weights of another network.
    """
    network = blank_deformer(config, K)
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    network.load_state_dict(load_weights(path, expected), assign=True)
    return network.eval()


def trained_model(card: ModelCard, template_file: Path, weights_file: Path) -> TrainedModel:
    """The model of a card, from files that are safe to read; `meshmatch.models.registry.load_model` finds them.

    Raises
    ------
    ModelError
        A kernel that is not known here, weights that are not those of the card's network, or a template that is not the
        one the model was trained with.
    TemplateError
        The template's file is damaged.
    """
    template = load_template(template_file)
    if template.hash != card.template_hash or template.K != card.field["nodes"]:
        raise ModelError(
            f"model {card.name} was trained with another template "
            f"({card.template_hash}, {card.field['nodes']} nodes; here {template.hash}, {template.K} nodes)",
            "fetch or add the model again",
        )
    if card.field["kernel"] not in KERNELS:
        raise ModelError(
            f"model {card.name} has the kernel {card.field['kernel']!r}, not {' or '.join(KERNELS)}",
            "it may need a newer meshmatch: update it",
        )
    network = load_network(weights_file, NetworkConfig.from_dict(card.network), template.K)
    return TrainedModel(card, template, network)
