"""How hard a fit looks for the right pose, and how it is refined."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from numbers import Integral

from meshmatch.errors import OptionError
from meshmatch.fitting.choices import ON_NODES, PARTIALS, REFINE_NAMES, Partial, Refine
from meshmatch.fitting.nodes import NodeRefineConfig
from meshmatch.fitting.orientation import axis_vector
from meshmatch.models.trained import TrainedModel

_LEAST = {"seed": 0, "variants": 0, "screening": 0} | dict.fromkeys(
    ("samples", "coarse_samples", "copies", "hypotheses", "careful", "finalists"), 1
)


@dataclass(frozen=True)
class LatentRefineConfig:
    """The paper's test-time weights L1..L3, steps and rate."""

    steps: int = 2000
    rate: float = 1e-3
    chamfer: float = 1.0
    volume: float = 1e-4
    arap: float = 1e-3
    points: int = 3000


@dataclass(frozen=True)
class FitConfig:
    """How hard to look and how to refine.

    Attributes
    ----------
    refine : {"none", "latent", "nodes"}
        The network alone, the paper's search over codes, or Gauss-Newton on the nodes.
    seed : int
    up, front : str, optional
        Axes of the file, such as "y" or "-z"; searched where not given.
    partial : {"auto", "yes", "no"}
        Whether the shape may be a part: tried where a fit of the whole leaves template without surface, always, never.
    samples, coarse_samples : int
        Points drawn on the surface, and how many of them are used to screen orientations.
    copies : int
        Turned copies of the samples that vote on the orientation.
    hypotheses : int
        Voted orientations that are tried, each with its flips.
    careful : int
        The best so many of these are fitted again with all samples.
    variants, tilt : int, float
        Further interpretations of the best of these: predictions from frames tilted at random, by about so many degrees.
    finalists, screening : int
        So many interpretations get so many node steps before the best one gets them all.
    nodes : NodeRefineConfig
    latent : LatentRefineConfig

    Raises
    ------
    OptionError
        An unknown refinement, axis or word for ``partial``; up and front along the same axis; or a count that is too
        small or not an integer.
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
    careful: int = 3
    variants: int = 12
    tilt: float = 15.0
    finalists: int = 4
    screening: int = 4
    nodes: NodeRefineConfig = field(default_factory=NodeRefineConfig)
    latent: LatentRefineConfig = field(default_factory=LatentRefineConfig)

    def __post_init__(self) -> None:
        if self.refine not in REFINE_NAMES:
            raise OptionError(f"unknown refinement {self.refine!r}", f"choose one of {', '.join(REFINE_NAMES)}")
        if self.partial not in PARTIALS:
            raise OptionError(f"partial cannot be {self.partial!r}", f"choose one of {', '.join(PARTIALS)}")
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if not isinstance(value, Integral) or value < least:
                raise OptionError(f"{name} cannot be {value!r}", f"give an integer of {least} or more, or leave it out")
        axes = [axis_vector(axis) for axis in (self.up, self.front) if axis is not None]
        if len(axes) == 2 and axes[0] @ axes[1] != 0:
            raise OptionError("up and front lie along the same axis", "choose two different axes")

    @property
    def moves_nodes(self) -> bool:
        """Whether node vectors themselves are refined: only then landmarks hold and fits agree."""
        return self.refine in ON_NODES

    def for_model(self, model: TrainedModel) -> FitConfig:
        """The same for a model: where there are no nodes to refine (pointwise), the code is refined instead."""
        return replace(self, refine="latent") if self.moves_nodes and not model.has_nodes else self

    def for_noise(self, roughness: float) -> FitConfig:
        """The same for a cloud of a ``roughness`` (0..1, see `Shape.roughness`): more samples, refined more stiffly."""
        if roughness <= 0:
            return self
        return replace(self, samples=round(self.samples * (1 + roughness)), nodes=self.nodes.for_noise(roughness))


def check_landmarks(model: TrainedModel) -> None:
    """Refuse landmarks for a model without nodes, which could not hold them (`OptionError`)."""
    if not model.has_nodes:
        raise OptionError(
            f"model {model.card.name} is pointwise: it has no nodes that landmarks could hold",
            "leave out the landmarks, or use a model of another field",
        )
