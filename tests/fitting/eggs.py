"""A model of eggs that nobody trained: small, quick, and with everything that fitting asks of a model."""

from meshmatch.fields.mls import Kernel
from meshmatch.models.deformer import NetworkConfig
from meshmatch.models.trained import TrainedModel
from tests.models.small_model import small_card
from tests.training.small import NETWORK, egg_template, small_network


def egg_model(kernel: Kernel = "smooth", network: NetworkConfig = NETWORK) -> TrainedModel:
    template = egg_template()
    card = small_card(
        name="egg",
        category="eggs",
        template=template.name,
        template_hash=template.hash,
        network=network.to_dict(),
        field={"kernel": kernel, "radius": template.radius, "nodes": template.K},
        seed=0,
    )
    return TrainedModel(card, template, small_network(template, network, kernel=kernel).eval())
