"""Settings of a fit: how thoroughly it searches, and how it is refined.

Uses the standard library only, so that the command line can list the settings without importing more.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf
from typing import TYPE_CHECKING, Any, Literal, get_args

from meshmatch.errors import OptionError
from meshmatch.models.card import MIRRORINGS
from meshmatch.scalars import is_integer, is_number

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel
    from meshmatch.shapes.alignment import Mirroring

Refine = Literal["none", "latent", "nodes"]
"""How a fit is refined, see `meshmatch.fitting.search.refinement.REFINEMENTS`."""
Partial = Literal["auto", "yes", "no"]
"""Whether a shape may be a part of a whole, such as a scan from one side."""
ON_NODES: tuple[Refine, ...] = ("nodes",)
"""Refinements that move the node vectors themselves. They need a field with nodes; only they use landmarks and agreement."""
REFINE_NAMES: tuple[Refine, ...] = get_args(Refine)
PARTIALS: tuple[Partial, ...] = get_args(Partial)

# Smallest value of each count.
_MINIMUMS = {"seed": 0, "variants": 0, "screening": 0} | dict.fromkeys(
    ("samples", "coarse_samples", "copies", "hypotheses", "careful", "finalists"), 1
)


_QUICK = {"copies": 16, "hypotheses": 1, "careful": 1, "variants": 0, "finalists": 1}
_QUICK |= {"samples": 3500, "coarse_samples": 1024}
_QUICK_STEPS = 8


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How the weights of a least-squares fit change from the first step to the last; lengths in units of sqrt(area).

    Attributes
    ----------
    steps : number of linear systems that are solved
    prior : weight of the prior in the first step and in the last, geometric in between
    scale : scale of the robust weight, likewise
    damping : weight of the current node vectors, for those that nothing else determines
    momentum : share of the last step that is added to the starting point of the next one
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

    def scaled_by(
        self, share: float, *, prior: tuple[float, float] = (1, 1), scale: tuple[float, float] = (1, 1)
    ) -> Schedule:
        """Return a schedule with ``prior`` and ``scale`` multiplied by the given (first, last) factors.

        A ``share`` (0..1) below 1 applies that much of the factors, geometrically.
        """
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

    point_share: float = 0.3  # weight of a pair's distance along the surface, relative to 1 across it
    # Weight of unit normals against positions in the nearest-neighbour search. It is small: sheets are apart by then, and a
    # normal that bends a little more must not drag its point along the surface.
    pair_normals: float = 0.06
    normal_cosine: float = 0.2  # pairs with a smaller cosine between their normals are ignored
    back_points: int = 4000  # approximate number of samples that are paired with their nearest template vertex
    # How much (0..1) samples pull on all of the template within about ``spread``, instead of on the nearest vertex.
    shared: float = 0.0
    spread: float = 0.016
    landmark_weight: float = 0.05  # per landmark; the weights of all other pairs sum to about 1


@dataclass(frozen=True, kw_only=True)
class NodeRefineConfig(Pairing):
    """Schedule and pairing of the node refinement; lengths in units of sqrt(area). Set by hand."""

    schedule: Schedule = field(default=Schedule(steps=10, prior=(0.003, 0.0001), scale=(0.1, 0.03)))

    def for_noise(self, roughness: float) -> NodeRefineConfig:
        """The configuration for a cloud with the given ``roughness`` (0..1, see `Shape.roughness`).

        Noise has no preferred direction, and calls for the mean of many points rather than the nearest: a wider robust
        scale, a stiffer template, more points, and shared pairs. Tuned on 14 hard pairs of SCAPE with noise of 1 % of the
        diagonal.
        """
        return replace(
            self,
            schedule=self.schedule.scaled_by(roughness, prior=(1, 10), scale=(1, 2)),
            point_share=geometric_between(self.point_share, max(self.point_share, 1.0), roughness),
            back_points=round(geometric_between(self.back_points, 5 * self.back_points, roughness)),
            shared=max(self.shared, roughness),
        )


def geometric_between(low: float, high: float, share: float) -> float:
    """Interpolate geometrically from ``low`` (share 0) to ``high`` (share 1)."""
    return low if low <= 0 or low == high else low ** (1 - share) * high**share


@dataclass(frozen=True, kw_only=True)
class LatentRefineConfig:
    """The paper's weights L1 to L3, steps and learning rate for the search over codes.

    `OptionError` for steps or points below 1, a rate that is not positive, or a negative weight.
    """

    steps: int = 2000
    rate: float = 1e-3
    chamfer: float = 1.0
    volume: float = 1e-4
    arap: float = 1e-3
    points: int = 3000

    def __post_init__(self) -> None:
        for name in ("steps", "points"):
            _check_count(name, getattr(self, name), 1)
        for name in ("rate", "chamfer", "volume", "arap"):
            value = getattr(self, name)
            if not is_number(value) or not (0 < value < inf or (value == 0 and name != "rate")):
                least = "above 0" if name == "rate" else "of 0 or more"
                raise OptionError(f"{name} cannot be {value!r}", f"give a number {least}, or leave it out")


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How thoroughly a fit searches, and how it is refined.

    Attributes
    ----------
    refine
        "none": use the network's prediction; "latent": search over codes, as in the paper; "nodes": refine the node
        vectors.
    seed
        Seed of all random numbers.
    up
        Up axis of the file, such as "y" or "-z"; searched if not given.
    front
        Axis of the file that the shape faces; searched if not given.
    partial
        Whether the shape may be a part. "auto" tries it where a fit of the whole leaves template without surface; "yes"
        tries it always, except where a fit of the whole is good and leaves none; "no" never does.
    mirror
        Whether the shape may be the mirror image of what the model knows, such as the other hand. "auto" fits both and
        keeps the better one; "no" does not; by default the model's card decides.
    try_harder
        If a fit is poor, search longer: for a part, from more orientations; and for separate parts of the file that are the
        shape and that the network alone does not recognise.
    again
        If there is a specific reason against a fit, repeat it with the full search.
    samples
        Points sampled on the surface.
    coarse_samples
        How many of these screen orientations.
    copies
        Rotated copies of the samples that vote on the orientation.
    hypotheses
        Voted orientations to try, each with its flips.
    careful
        How many of the best of these are fitted again with all samples.
    variants
        Further candidates for the best of these: predictions from randomly tilted frames.
    tilt
        Typical tilt of these frames, in degrees.
    finalists
        Candidates that are refined by a few node steps before the best one gets all steps.
    screening
        Number of these few steps.
    device
        Where the network is evaluated and codes are searched: "cpu", or a device of torch, such as "cuda" (needs the extra
        ``train``).
    nodes
        How node vectors are refined.
    latent
        How codes are refined.

    Raises
    ------
    OptionError
        An unknown refinement, axis or value of ``partial``; up and front along the same axis; a count that is too small or
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
        for name, least in _MINIMUMS.items():
            _check_count(name, getattr(self, name), least)
        if not is_number(self.tilt) or not 0 <= self.tilt <= 180:
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
        """Search less, for thousands of shapes that are complete and ordinary; maps are a little less accurate.

        Parameters
        ----------
        settings
            Other attributes to set.

        Returns
        -------
        FitConfig
            With fewer orientations, candidates, samples and steps; a fit with a specific reason against it is repeated
            (`again`).

        Examples
        --------
        >>> matcher = meshmatch.Matcher("human", meshmatch.FitConfig.quick())
        >>> found = matcher.fit_all(["templates/samples/climber.ply", "templates/samples/dancer.ply"], errors="return")
        """
        default = NodeRefineConfig()
        nodes = replace(default, schedule=replace(default.schedule, steps=_QUICK_STEPS))
        reduced: dict[str, Any] = {"again": True, "nodes": nodes, **_QUICK}
        return cls(**reduced | settings)

    def with_all_of_the_search(self) -> FitConfig:
        """The same configuration with the full search that `quick` reduces.

        Returns
        -------
        FitConfig
            With at least the default number of orientations, candidates, samples and steps.
        """
        default, own = FitConfig(), self.nodes.schedule
        most = {name: max(getattr(self, name), getattr(default, name)) for name in _QUICK}
        schedule = replace(own, steps=max(own.steps, default.nodes.schedule.steps))
        return replace(self, again=False, nodes=replace(self.nodes, schedule=schedule), **most)

    @property
    def moves_nodes(self) -> bool:
        """Whether the node vectors themselves are refined; landmarks and agreement of fits need this."""
        return self.refine in ON_NODES

    def for_model(self, model: TrainedModel) -> FitConfig:
        """Adapt the configuration to a model: without nodes to refine (pointwise), the code is refined instead.

        Parameters
        ----------
        model
            The model that will be fitted.

        Returns
        -------
        FitConfig
            The same object if nothing changes.
        """
        return replace(self, refine="latent") if self.moves_nodes and not model.has_nodes else self

    def for_noise(self, roughness: float) -> FitConfig:
        """Adapt the configuration to a noisy cloud: more samples and a stiffer refinement.

        Parameters
        ----------
        roughness
            0..1, see `Shape.roughness`.

        Returns
        -------
        FitConfig
            The same object if nothing changes.
        """
        if roughness <= 0:
            return self
        return replace(self, samples=round(self.samples * (1 + roughness)), nodes=self.nodes.for_noise(roughness))


def _check_count(name: str, value: object, least: int) -> None:
    """Raise `OptionError` unless a value is an integer of at least ``least``."""
    if not is_integer(value, least):
        raise OptionError(f"{name} cannot be {value!r}", f"give an integer of {least} or more, or leave it out")


def axis_of(name: str) -> tuple[int, float]:
    """Index and sign of an axis such as "y", "+y" or "-z"; raises `OptionError` for any other name."""
    word = str(name)
    axis = word.lstrip("+-").lower()
    if axis not in ("x", "y", "z") or len(word) > 2:
        raise OptionError(f"invalid axis {name!r}", "write x, y or z, with - for the opposite direction")
    return "xyz".index(axis), -1.0 if word.startswith("-") else 1.0
