"""A trained model ready for use: card, template, network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from meshmatch.arrays import Float, Floats, table_html
from meshmatch.derived import derived, store_derived
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

    Models can be pickled, to be sent to other processes. The pickle of a model that `load_model` returned contains only
    its name or folder and its card; unpickling loads the model, once in each process (`ModelError` if it is missing there,
    or is another). The pickle of any other model contains its arrays. Cached values are not pickled.

    Attributes
    ----------
    card
        Metadata: what the model is and how it was trained.
    template
        The mesh that is deformed, its control nodes, labels and core.
    inference
        The network as fits use it, with arrays; `network` is the same in torch.
    pairs
        Statistics of the differences between fits, if the category has them: see `meshmatch.models.pair_statistics`.
    load_again
        Called to unpickle the model; None for a model that was not loaded.

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
        """Make a model from a network in memory.

        Parameters
        ----------
        card
            The model's card.
        template
            The template whose nodes the network moves.
        network
            The network, in evaluation mode.

        Returns
        -------
        TrainedModel
            The model.

        Raises
        ------
        ModelError
            The network is none of a model, is of another template, or has weights that are nan or infinite.
        """
        from meshmatch.models.deformer import Deformer

        if not isinstance(network, Deformer):
            raise ModelError(
                f"{type(network).__name__} is not the network of a model", "change a copy of model.network"
            )
        _check_template(card, template, "use the template of the model that the card is from")
        if len(network.nodes) != template.K:
            raise ModelError(
                f"the network moves {len(network.nodes)} nodes, but the template has {template.K}",
                "use its own template",
            )
        for name, value in network.state_dict().items():
            if not value.isfinite().all():
                raise ModelError(
                    f"the weights {name} of the network are nan or infinite", "train again at a lower rate"
                )
        inference: Network = network
        if not network.config.in_torch:
            weights = {name: value.numpy(force=True) for name, value in network.state_dict().items()}
            inference = NodeNetwork(network.config, weights)
        made = cls(card, template, inference)
        store_derived(torch_network, made, network)
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
            Computes where node vectors (K, 3), such as ``Fit.vectors``, move the points, and the deformation gradients.

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
        """Return the network for fits on a device: with arrays on "cpu", in torch on others.

        Parameters
        ----------
        device
            "cpu", or a device of torch such as "cuda".

        Returns
        -------
        Network
            The network that fits use.

        Raises
        ------
        OptionError
            There is no such device.
        """
        return self.inference if device == "cpu" else torch_network(self, device)

    @property
    def has_nodes(self) -> bool:
        """Whether fits are node vectors, which can be solved for; those of a pointwise model are codes only."""
        return has_nodes(self.inference.config.field)


def _check_template(card: ModelCard, template: Template, hint: str) -> None:
    """Raise `ModelError` if the template is not the one on the card."""
    if template.hash != card.template_hash or template.K != card.field["nodes"]:
        both = f"{card.template_hash}, {card.field['nodes']} nodes; here {template.hash}, {template.K} nodes"
        raise ModelError(f"model {card.name} was trained with another template ({both})", hint)


@derived
def torch_network(model: TrainedModel, device: str = "cpu") -> Deformer:
    """The network of a model in torch, see `meshmatch.models.inference.in_torch`."""
    return in_torch(model.inference, model.template.K, device)


def trained_model(
    card: ModelCard,
    template_file: Path,
    weights_file: Path,
    load_again: Callable[[], TrainedModel] | None = None,
    encoder: type | None = None,
    pairs_file: Path | None = None,
) -> TrainedModel:
    """Build a model from its card and files, which must be safe to read; `meshmatch.models.registry.load_model` finds them.

    ``pairs_file`` need not exist. ``load_again`` unpickles the model, and must be picklable itself; ``encoder`` is the class
    that the card names, if the model has a custom one.

    `ModelError` if the kernel is unknown, the weights do not match the network on the card, or the template is not the one
    that the model was trained with; `TemplateError` if the template's file is damaged.
    """
    template = load_template(template_file)
    _check_template(card, template, "fetch or add the model again")
    if card.field["kernel"] not in KERNELS:
        problem = f"model {card.name} has the kernel {card.field['kernel']!r}, not {' or '.join(KERNELS)}"
        raise ModelError(problem, "it may need a newer meshmatch: update it")
    network = load_network(weights_file, NetworkConfig.from_dict(card.network, encoder), template.K)
    pairs = load_pair_statistics(pairs_file) if pairs_file is not None and pairs_file.is_file() else None
    made = TrainedModel(card, template, network, pairs)
    object.__setattr__(made, "load_again", load_again)
    return made
