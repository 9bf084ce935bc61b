"""How hard a fit looks for the right pose, and how it is refined: the user's choices, apart from what carries them out.

Standard library alone, so that a command line can list them without loading more.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, Literal, get_args

from meshmatch.errors import OptionError
from meshmatch.models.card import MIRRORINGS

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel
    from meshmatch.shapes.normalise import Mirroring

Refine = Literal["none", "latent", "nodes"]
"""How a fit is refined, see `meshmatch.fitting.search.refinement.REFINEMENTS`."""
Partial = Literal["auto", "yes", "no"]
"""Whether a shape may be a part of a whole, such as a scan from one side."""
ON_NODES: tuple[Refine, ...] = ("nodes",)
"""Refinements that move node vectors themselves: the model's field must have nodes; landmarks hold and fits agree."""
REFINE_NAMES: tuple[Refine, ...] = get_args(Refine)
PARTIALS: tuple[Partial, ...] = get_args(Partial)

_LEAST = {"seed": 0, "variants": 0, "screening": 0} | dict.fromkeys(
    ("samples", "coarse_samples", "copies", "hypotheses", "careful", "finalists"), 1
)


_QUICK = {"copies": 16, "hypotheses": 1, "careful": 1, "variants": 0, "finalists": 1}
_QUICK |= {"samples": 3500, "coarse_samples": 1024}
_QUICK_STEPS = 8


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How the weights of a least-squares fit change from its first step to its last; lengths in units of sqrt(area).

    Attributes
    ----------
    steps : how many linear systems are solved
    prior : weight of the prior in the first step and in the last, geometric in between
    scale : the same for the scale of the robust weight
    damping : weight of the present node vectors, for those that nothing else holds
    momentum : how far each step continues along the last one
    """

    steps: int
    prior: tuple[float, float]
    scale: tuple[float, float] = (1.0, 1.0)
    damping: float = 1e-4
    momentum: float = 0.0

    def prior_at(self, step: int) -> float:
        """Weight of the prior in a step, counted from 0."""
        return geometric_between(*self.prior, self._share(step))

    def scale_at(self, step: int) -> float:
        """Scale of the robust weight in a step, counted from 0."""
        return geometric_between(*self.scale, self._share(step))

    def grown(
        self, share: float, *, prior: tuple[float, float] = (1, 1), scale: tuple[float, float] = (1, 1)
    ) -> Schedule:
        """The same at a ``share`` (0..1) of the way to so many times the first and last ``prior`` and ``scale``."""
        priors = zip(self.prior, prior, strict=True)
        scales = zip(self.scale, scale, strict=True)
        first, last = (geometric_between(value, times * value, share) for value, times in priors)
        narrow, wide = (geometric_between(value, times * value, share) for value, times in scales)
        return replace(self, prior=(first, last), scale=(narrow, wide))

    def _share(self, step: int) -> float:
        return step / max(self.steps - 1, 1)


@dataclass(frozen=True, kw_only=True)
class Pairing:
    """How template vertices and samples are paired; lengths in units of sqrt(area). Set by hand."""

    point_share: float = 0.3  # how much a pair pulls along the surface, against 1 across it
    # How far a normal that points the other way (2 units) pushes a neighbour away: little, for sheets are apart by then, and
    # a normal that bends a little more must not drag its point along the surface.
    pair_normals: float = 0.06
    normal_cosine: float = 0.2  # pairs whose normals differ more do not count
    back_points: int = 4000  # about how many samples look for their template vertex
    # How much (0..1) samples pull at all of the template within about ``spread`` instead of at the nearest of it.
    shared: float = 0.0
    spread: float = 0.016
    landmark_weight: float = 0.05  # of each landmark; all other pairs together have about 1


@dataclass(frozen=True, kw_only=True)
class NodeRefineConfig(Pairing):
    """Schedule and pairing of the node refinement; lengths in units of sqrt(area). Set by hand."""

    schedule: Schedule = field(default=Schedule(steps=10, prior=(0.003, 0.0001), scale=(0.1, 0.03)))

    def for_noise(self, roughness: float) -> NodeRefineConfig:
        """The same for a cloud of a ``roughness`` (0..1, see `Shape.roughness`).

        Noise does not tell across from along, and asks for the mean of many points rather than for the nearest: a wider
        robust scale, a stiffer template, more points, shared pairs. Tuned on 14 hard pairs of SCAPE with noise of 1 % of
        the diagonal.
        """
        return replace(
            self,
            schedule=self.schedule.grown(roughness, prior=(1, 10), scale=(1, 2)),
            point_share=geometric_between(self.point_share, max(self.point_share, 1.0), roughness),
            back_points=round(geometric_between(self.back_points, 5 * self.back_points, roughness)),
            shared=max(self.shared, roughness),
        )


def geometric_between(low: float, high: float, share: float) -> float:
    """The number at a ``share`` (0..1) of the way from one to another, by ratio."""
    return low if low <= 0 or low == high else low ** (1 - share) * high**share


@dataclass(frozen=True, kw_only=True)
class LatentRefineConfig:
    """The paper's test-time weights L1..L3, steps and rate."""

    steps: int = 2000
    rate: float = 1e-3
    chamfer: float = 1.0
    volume: float = 1e-4
    arap: float = 1e-3
    points: int = 3000


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How hard a fit searches, and how it is refined.

    Attributes
    ----------
    refine
        "none": the network alone; "latent": the paper's search over codes; "nodes": the node vectors are refined.
    seed
        Of all random numbers.
    up
        Up axis of the file, such as "y" or "-z"; searched if not given.
    front
        Axis of the file that the shape faces; searched if not given.
    partial
        Whether the shape may be a part: "auto" tries it where a fit of the whole leaves template without surface, "yes"
        always, except where a fit of the whole is good and leaves nothing bare, "no" never.
    mirror
        Whether the shape may be the mirror image of what the model knows, such as the other hand: "auto" fits both and
        keeps the better, "no" never; by default as the model's card says.
    try_harder
        Where a fit is poor, search for longer: for a part from more orientations, and for separate
        parts of the file that are the shape and that the network alone does not recognise.
    again
        Where something in particular speaks against a fit, make it again with all of the search.
    samples
        Points drawn on the surface.
    coarse_samples
        How many of them screen orientations.
    copies
        Turned copies of the samples that vote on the orientation.
    hypotheses
        Voted orientations that are tried, each with its flips.
    careful
        How many of the best of these are fitted again with all samples.
    variants
        Further interpretations of the best of these: predictions from frames tilted at random.
    tilt
        Typical tilt of these frames, in degrees.
    finalists
        Interpretations that are refined by a few node steps before the best one gets all steps.
    screening
        How many steps these few are.
    device
        Where the network is evaluated and codes are searched: "cpu", or one of torch's, such as "cuda" (needs the extra
        ``train``).
    nodes
        How node vectors are refined.
    latent
        How codes are refined.

    Raises
    ------
    OptionError
        An unknown refinement, axis or word for ``partial``; up and front along the same axis; a count that is too small or
        not an integer; or a value of another type.

    Examples
    --------
    >>> config = meshmatch.FitConfig(up="z", front="-y", partial="yes")
    >>> fit = meshmatch.register("templates/samples/climber.ply", config=meshmatch.FitConfig(refine="none", seed=1))
    >>> fit.seed
    """

    refine: Refine = "nodes"
    seed: int = 0
    up: str | None = None
    front: str | None = None
    partial: Partial = "auto"
    mirror: Mirroring | None = None
    try_harder: bool = False
    again: bool = False
    samples: int = 8000
    coarse_samples: int = 2048
    copies: int = 48
    hypotheses: int = 2
    careful: int = 3
    variants: int = 12
    tilt: float = 15.0
    finalists: int = 4
    screening: int = 4
    device: str = "cpu"
    nodes: NodeRefineConfig = field(default_factory=NodeRefineConfig)
    latent: LatentRefineConfig = field(default_factory=LatentRefineConfig)

    def __post_init__(self) -> None:
        if self.refine not in REFINE_NAMES:
            raise OptionError(f"unknown refinement {self.refine!r}", f"choose one of {', '.join(REFINE_NAMES)}")
        if self.partial not in PARTIALS:
            raise OptionError(f"partial cannot be {self.partial!r}", f"choose one of {', '.join(PARTIALS)}")
        if self.mirror not in (None, *MIRRORINGS):
            raise OptionError(f"mirror cannot be {self.mirror!r}", f"choose one of {', '.join(MIRRORINGS)}")
        for name, least in _LEAST.items():
            value = getattr(self, name)
            if not isinstance(value, Integral) or value < least:
                raise OptionError(f"{name} cannot be {value!r}", f"give an integer of {least} or more, or leave it out")
        if not isinstance(self.tilt, Real) or not 0 <= self.tilt <= 180:
            raise OptionError(f"tilt cannot be {self.tilt!r}", "give degrees from 0 to 180, or leave it out")
        kinds = {"device": str, "nodes": NodeRefineConfig, "latent": LatentRefineConfig}
        for name, kind in kinds.items():
            if not isinstance(getattr(self, name), kind):
                hint = f"give a {kind.__name__}, or leave it out"
                raise OptionError(f"{name} cannot be {getattr(self, name)!r}", hint)
        axes = {axis_of(axis)[0] for axis in (self.up, self.front) if axis is not None}
        if len(axes) == 1 and None not in (self.up, self.front):
            raise OptionError("up and front lie along the same axis", "choose two different axes")

    @classmethod
    def quick(cls, **settings: Any) -> FitConfig:
        """Less search, for thousands of shapes that are whole and not strange; maps are a little less accurate.

        Parameters
        ----------
        settings
            Attributes that are to be otherwise.

        Returns
        -------
        FitConfig
            With fewer orientations, interpretations, samples and steps; where anything speaks against a fit, it is made
            `again`.

        Examples
        --------
        >>> matcher = meshmatch.Matcher("human", meshmatch.FitConfig.quick())
        >>> found = matcher.fit_all(["templates/samples/climber.ply", "templates/samples/dancer.ply"], errors="return")
        """
        usual = NodeRefineConfig()
        nodes = replace(usual, schedule=replace(usual.schedule, steps=_QUICK_STEPS))
        less: dict[str, Any] = {"again": True, "nodes": nodes, **_QUICK}
        return cls(**less | settings)

    def with_all_of_the_search(self) -> FitConfig:
        """The same without what `quick` leaves out.

        Returns
        -------
        FitConfig
            With as many orientations, interpretations, samples and steps as there are by default, or more.
        """
        usual, own = FitConfig(), self.nodes.schedule
        most = {name: max(getattr(self, name), getattr(usual, name)) for name in _QUICK}
        schedule = replace(own, steps=max(own.steps, usual.nodes.schedule.steps))
        return replace(self, again=False, nodes=replace(self.nodes, schedule=schedule), **most)

    @property
    def moves_nodes(self) -> bool:
        """Whether node vectors themselves are refined: only then landmarks hold and fits agree."""
        return self.refine in ON_NODES

    def for_model(self, model: TrainedModel) -> FitConfig:
        """The same for a model: where there are no nodes to refine (pointwise), the code is refined instead.

        Parameters
        ----------
        model
            The model that will be fitted.

        Returns
        -------
        FitConfig
            Itself where nothing changes.
        """
        return replace(self, refine="latent") if self.moves_nodes and not model.has_nodes else self

    def for_noise(self, roughness: float) -> FitConfig:
        """The same for a noisy cloud: more samples, refined more stiffly.

        Parameters
        ----------
        roughness
            0..1, see `Shape.roughness`.

        Returns
        -------
        FitConfig
            Itself where nothing changes.
        """
        if roughness <= 0:
            return self
        return replace(self, samples=round(self.samples * (1 + roughness)), nodes=self.nodes.for_noise(roughness))


def axis_of(name: str) -> tuple[int, float]:
    """Number and sign of an axis such as "y", "+y" or "-z"; any other name is an `OptionError`."""
    word = str(name)
    axis = word.lstrip("+-").lower()
    if axis not in ("x", "y", "z") or len(word) > 2:
        raise OptionError(f"invalid axis {name!r}", "write x, y or z, with - for the opposite direction")
    return "xyz".index(axis), -1.0 if word.startswith("-") else 1.0
