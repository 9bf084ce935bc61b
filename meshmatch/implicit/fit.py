"""The representation of a shape by an implicit model: code, frame, and quality."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import torch

from meshmatch.arrays import Float, Floats, Int, Ints, ShortRepr
from meshmatch.geometry.frames import Frame
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.card import ImplicitCard
from meshmatch.shapes.shape import Shape

_FAIR, _POOR = 2.0, 5.0  # residuals above which the verdict is fair, or poor; set by hand
_FAIR_SHARE, _POOR_SHARE = 0.03, 0.1  # shares without counterpart above which the verdict is fair, or poor; set by hand
REACH = 4.0  # % of the longest side: points farther from the other surface have no counterpart; set by hand


class Owner(Protocol):
    """Interface of a fit's model."""

    @property
    def card(self) -> ImplicitCard: ...

    def register(self, shape: ImplicitFit) -> Shape: ...

    def match(self, a: ImplicitFit, b: ImplicitFit, source: Shape, target: Shape) -> VertexMap: ...


@dataclass(frozen=True, eq=False, repr=False)
class ImplicitFit(ShortRepr):
    """The representation of a shape by an implicit model.

    Attributes
    ----------
    name
        Name of the shape.
    code
        (D,) latent code.
    frame
        From the shape's file into the cube from -1 to 1.
    residual
        Mean distance between the shape's surface and the model's, % of the longest side; NaN if not known.
    missed
        Share of the shape's surface that is far from the model's.
    invented
        Share of the model's surface that is far from the shape's.
    owner
        The model of the code.
    source
        The shape itself; None for a training shape or a blend.
    seed
        Seed of the fit's random numbers.
    seconds
        Wall time of the fit.
    notes
        Whether and how the shape was rotated.

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
        """The template's surface registered to the shape, see `ImplicitModel.register`."""
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
        """The worst of the grades (good, fair, poor) of the residual and of both shares; "unknown" if none is known."""
        grades = [grade for grade, _ in self._grades]
        return ("good", "fair", "poor")[max(grades)] if grades else "unknown"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the verdict is not good."""
        return tuple(words for grade, words in self._grades if grade)

    @property
    def _grades(self) -> list[tuple[int, str]]:
        """Grade, from 0 (good) to 2 (poor), and text, for each measure that is known."""
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
