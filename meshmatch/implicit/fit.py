"""A shape as an implicit model has it: its code, its place, and how well the model knows it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import torch

from meshmatch.arrays import Brief, Float, Floats, Int, Ints
from meshmatch.geometry.frames import Frame
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.card import ImplicitCard
from meshmatch.shapes.shape import Shape

_FAIR, _POOR = 2.0, 5.0  # residuals above which a shape is so; set by hand
_FAIR_SHARE, _POOR_SHARE = 0.03, 0.1  # shares without counterpart above which a shape is so; set by hand
REACH = 4.0  # % of the longest side: what is further from the other surface has no counterpart; set by hand


class Owner(Protocol):
    """What a fit asks of its model."""

    @property
    def card(self) -> ImplicitCard: ...

    def register(self, shape: ImplicitFit) -> Shape: ...

    def match(self, a: ImplicitFit, b: ImplicitFit, source: Shape, target: Shape) -> VertexMap: ...


@dataclass(frozen=True, eq=False, repr=False)
class ImplicitFit(Brief):
    """A shape as a model has it.

    Attributes
    ----------
    name
        Of the shape.
    code
        (D,).
    frame
        From the shape's file into the cube from -1 to 1.
    residual
        Mean distance that the model gives points of the shape's surface, % of the longest side; NaN is not known.
    missed
        Share of these points that the model's surface comes nowhere near.
    invented
        Share of the model's surface that is nowhere near the shape.
    owner
        The model whose code it is.
    source
        The shape itself; None if it is one of the training, or a blend.
    seed
        Of its random numbers.
    seconds
        Wall time of the fit.
    notes
        Whether and how the shape was turned.

    Examples
    --------
    >>> chair = meshmatch.load_implicit("chair-model").known("chair-17")
    >>> chair.code  # (D,)
    >>> chair.verdict, chair.residual
    """

    name: str
    code: Float[torch.Tensor, " D"]
    frame: Frame
    residual: float = math.nan
    missed: float = math.nan
    invented: float = math.nan
    owner: Owner | None = field(default=None, repr=False)
    source: Shape | None = field(default=None, repr=False)
    seed: int = 0
    seconds: float = 0.0
    notes: tuple[str, ...] = ()

    @cached_property
    def shape(self) -> Shape:
        """The template's surface on the shape, see `ImplicitModel.register`."""
        assert self.owner is not None
        return self.owner.register(self)

    @property
    def points_in_file(self) -> Float[Floats, "V 3"]:
        """The vertices of ``shape``."""
        return self.shape.verts

    @property
    def faces(self) -> Int[Ints, "F 3"]:
        """The triangles of ``shape``: the same for all shapes."""
        return self.shape.faces

    @property
    def model(self) -> str:
        """Name of the model."""
        return "" if self.owner is None else self.owner.card.name

    @property
    def verdict(self) -> str:
        """Good, fair or poor by the residual and both shares, whichever is worst."""
        grades = [grade for grade, _ in self._graded]
        return ("good", "fair", "poor")[max(grades)] if grades else "unknown"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not good."""
        return tuple(words for grade, words in self._graded if grade)

    @property
    def _graded(self) -> list[tuple[int, str]]:
        """What is known, from 0 (good) to 2 (poor), in words."""
        reach = f"over {REACH:g} % of the longest side"
        away = f"the model's surface is {self.residual:.1f} % of the longest side away from {self.name}"
        missed = f"{self.missed:.0%} of {self.name} is {reach} from the model's surface"
        invented = f"{self.invented:.0%} of the model's surface is {reach} from {self.name}"
        shares = (_FAIR_SHARE, _POOR_SHARE)
        found = (
            (self.residual, _FAIR, _POOR, away),
            (self.missed, *shares, missed),
            (self.invented, *shares, invented),
        )
        return [(int(value > fair) + int(value > poor), words) for value, fair, poor, words in found if value == value]
