"""How hard a fit looks for the right pose, and how it is refined."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from meshmatch.errors import OptionError
from meshmatch.fitting.latent import LatentRefineConfig
from meshmatch.fitting.nodes import NodeRefineConfig

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

Refine = Literal["none", "latent", "nodes"]
Partial = Literal["auto", "yes", "no"]
REFINEMENTS: tuple[Refine, ...] = ("none", "latent", "nodes")


@dataclass(frozen=True)
class FitConfig:
    """How hard to look and how to refine.

    samples : points drawn on the surface, of which coarse_samples see every orientation; hypotheses : voted
    orientations, each tried with its flips; laid : of which this many are laid on with care; variants : readings
    of the best from frames tilted by ``tilt`` degrees; finalists : readings that get ``screening`` node steps
    before the best one gets them all; copies : turned copies that vote on the orientation; partial : whether the
    shape may be a part of a whole, tried where a fit of the whole leaves template without surface ("auto"), always
    or never.
    """

    refine: Refine = "nodes"
    seed: int = 0
    up: str | None = None
    front: str | None = None
    partial: Partial = "auto"
    samples: int = 8000
    coarse_samples: int = 2048
    copies: int = 48
    hypotheses: int = 2
    laid: int = 3
    variants: int = 12
    tilt: float = 15.0
    finalists: int = 4
    screening: int = 4
    nodes: NodeRefineConfig = field(default_factory=NodeRefineConfig)
    latent: LatentRefineConfig = field(default_factory=LatentRefineConfig)

    def __post_init__(self) -> None:
        if self.refine not in REFINEMENTS:
            raise OptionError(f"no refinement {self.refine!r}", f"choose one of {', '.join(REFINEMENTS)}")
        if self.partial not in ("auto", "yes", "no"):
            raise OptionError(f"partial cannot be {self.partial!r}", "choose auto, yes or no")

    def possible(self, model: TrainedModel) -> FitConfig:
        """The same for a model: where there are no nodes to refine (pointwise), the code is refined instead."""
        if self.refine == "nodes" and not model.has_nodes:
            return replace(self, refine="latent")
        return self

    def suited(self, roughness: float) -> FitConfig:
        """The same for a cloud of a ``roughness`` (0..1, see `Shape.roughness`): more points, refined more stiffly."""
        if roughness <= 0:
            return self
        return replace(
            self, samples=round(self.samples * (1 + roughness)), nodes=self.nodes.suited(roughness)
        )


def check_landmarks(model: TrainedModel) -> None:
    """Refuse known pairs for a model that has no nodes to hold them (`OptionError`)."""
    if not model.has_nodes:
        raise OptionError(
            f"model {model.card.name} is pointwise: it has no nodes that landmarks could hold",
            "leave out the landmarks, or use a model of another field",
        )
