"""A trained model ready for use: card, template, network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from meshmatch.arrays import Float, Floats, table_html
from meshmatch.derived import derived, remember
from meshmatch.errors import ModelError
from meshmatch.fields.shape_functions import ShapeFunctions, has_nodes, shape_functions
from meshmatch.geometry.kernels import KERNELS
from meshmatch.models.card import ModelCard
from meshmatch.models.inference import NodeNetwork, in_torch, load_network
from meshmatch.models.network import Network, NetworkConfig
from meshmatch.models.pair_statistics import PairStatistics, load_pair_statistics
from meshmatch.templates.template import Template, load_template

if TYPE_CHECKING:
    from meshmatch.fields.field import PointwiseField
    from meshmatch.models.deformer import Deformer


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A model, as `load_model` returns it.

    A model can be pickled, for processes of Python. One that `load_model` returned travels as its name or folder and its
    card: whoever unpickles it loads it there, once in each process (`ModelError` if it is missing there, or has other
    weights). Of any other model the arrays travel. What was derived stays behind.

    Attributes
    ----------
    card
        What it is, what it was trained on and how.
    template
        The mesh that is deformed, its control nodes, labels and core.
    inference
        The network as fits ask it, in arrays; `network` is the same in torch.
    pairs
        How fits of two shapes differ, if that is known of its kind: see `meshmatch.models.pair_statistics`.
    load_again
        What a pickle of it calls; None for a model that was not loaded.

    Examples
    --------
    >>> model = meshmatch.load_model("human")
    >>> print(model.card.category, model.template.K)
    >>> where = model.template.shape.verts  # (V, 3)
    >>> moved = where + model.field(where).displaced(np.zeros((model.template.K, 3)))
    """

    card: ModelCard
    template: Template
    inference: Network
    pairs: PairStatistics | None = None
    load_again: Callable[[], TrainedModel] | None = field(default=None, init=False, repr=False)

    @classmethod
    def of(cls, card: ModelCard, template: Template, network: Deformer) -> TrainedModel:
        """A model of a network at hand.

        Parameters
        ----------
        card
            Its card.
        template
            Whose nodes it moves.
        network
            In evaluation mode.

        Returns
        -------
        TrainedModel
            The model.
        """
        inference: Network = network
        if not network.config.in_torch:
            weights = {name: value.numpy(force=True) for name, value in network.state_dict().items()}
            inference = NodeNetwork(network.config, weights)
        made = cls(card, template, inference)
        remember(torch_network, made, network)
        return made

    def __reduce__(self) -> tuple[Callable[..., TrainedModel], tuple[Any, ...]]:
        if self.load_again is not None:
            return self.load_again, ()
        return TrainedModel, (self.card, self.template, self.inference, self.pairs)

    def __repr__(self) -> str:
        size = f"{self.template.shape.V} vertices, {self.template.K} nodes"
        return f"TrainedModel({self.card.name!r}, category {self.card.category!r}, {size})"

    def _repr_html_(self) -> str:
        card, template = self.card, self.template
        rows = {
            "category": card.category,
            "template": f"{template.name}: {template.shape.V:,} vertices, {template.K} nodes",
            "trained on": card.data,
            "steps": f"{card.steps:,}",
            "licence": card.licence,
        }
        return table_html(f"Model: {card.name}", rows)

    def field(self, points: Float[Floats, "P 3"]) -> ShapeFunctions | PointwiseField:
        """The deformation field on fixed points, with the kernel that the network was trained with.

        Parameters
        ----------
        points
            (P, 3) in the template's frame.

        Returns
        -------
        ShapeFunctions or PointwiseField
            Says where node vectors (K, 3), such as ``Fit.vectors``, move the points, and the deformation gradient there.

        Raises
        ------
        TemplateError
            A point has too few nodes in reach.
        """
        config, nodes, radius = self.inference.config, self.template.nodes, self.template.radius
        if has_nodes(config.field):
            return shape_functions(config.field, points, nodes, radius, self.card.field["kernel"])
        return self.network.pointwise_field(points)

    @property
    def network(self) -> Deformer:
        """The network in torch, in evaluation mode, on the CPU; needs the extra ``train``."""
        return torch_network(self)

    def on(self, device: str) -> Network:
        """The network for fits: in arrays on "cpu", in torch on another device.

        Parameters
        ----------
        device
            Such as "cpu" or "cuda".

        Returns
        -------
        Network
            What a fit asks.

        Raises
        ------
        OptionError
            There is no such device.
        """
        return self.inference if device == "cpu" else torch_network(self, device)

    @property
    def has_nodes(self) -> bool:
        """Whether its fits are node vectors, which can be solved for; a pointwise model has codes alone."""
        return has_nodes(self.inference.config.field)


@derived
def torch_network(model: TrainedModel, device: str = "cpu") -> Deformer:
    """The network of a model as torch has it, see `meshmatch.models.inference.in_torch`."""
    return in_torch(model.inference, model.template.K, device)


def trained_model(
    card: ModelCard,
    template_file: Path,
    weights_file: Path,
    load_again: Callable[[], TrainedModel] | None = None,
    encoder: type | None = None,
    pairs_file: Path | None = None,
) -> TrainedModel:
    """The model of a card, from files that are safe to read; `meshmatch.models.registry.load_model` finds them.

    ``pairs_file`` need not be there. ``load_again`` is what a pickle of the model holds, a function that survives it;
    ``encoder`` is the class that the card names, if it has one of its author's own.

    `ModelError` for a kernel that is not known here, weights that are not those of the card's network, or a template that
    is not the one the model was trained with; `TemplateError` if its file is damaged.
    """
    template = load_template(template_file)
    if template.hash != card.template_hash or template.K != card.field["nodes"]:
        both = f"{card.template_hash}, {card.field['nodes']} nodes; here {template.hash}, {template.K} nodes"
        problem = f"model {card.name} was trained with another template ({both})"
        raise ModelError(problem, "fetch or add the model again")
    if card.field["kernel"] not in KERNELS:
        problem = f"model {card.name} has the kernel {card.field['kernel']!r}, not {' or '.join(KERNELS)}"
        raise ModelError(problem, "it may need a newer meshmatch: update it")
    network = load_network(weights_file, NetworkConfig.from_dict(card.network, encoder), template.K)
    pairs = load_pair_statistics(pairs_file) if pairs_file is not None and pairs_file.is_file() else None
    made = TrainedModel(card, template, network, pairs)
    object.__setattr__(made, "load_again", load_again)
    return made
