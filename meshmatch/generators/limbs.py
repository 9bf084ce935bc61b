"""Random clinical angles of arms and legs within anatomical limits.

Poses are a mixture of everyday families (standing, reaching, overhead, arms folded, hand at the face; sitting, crouching,
kneeling, bending, lunging) and of wide uniform ranges, so that rare poses are rare but present. The order of the draws
determines the poses of a seed: changing it changes every training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from meshmatch.generators.rotations import DEGREE


@dataclass(frozen=True)
class Draw:
    """Seeded random numbers of shape (B,)."""

    B: int
    generator: torch.Generator

    def normal(self, mean: float, deviation: float) -> torch.Tensor:
        return mean + deviation * torch.randn(self.B, generator=self.generator)

    def uniform(self, low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(self.B, generator=self.generator)

    def normal3(self, deviation: float) -> torch.Tensor:
        return deviation * DEGREE * torch.randn(self.B, 3, generator=self.generator)

    def family(self, weights: Sequence[float]) -> torch.Tensor:
        """Random indices with probabilities proportional to ``weights``."""
        return torch.multinomial(torch.tensor(weights), self.B, True, generator=self.generator)

    def choice(self, weights: Sequence[float], options: list[torch.Tensor]) -> torch.Tensor:
        return torch.stack(options)[self.family(weights), torch.arange(self.B)]


@dataclass(frozen=True)
class Limbs:
    """Clinical angles of the limbs on one side of the body, degrees, each (B,); ``curl`` of the fingers has no unit."""

    arm_elevation: torch.Tensor
    arm_azimuth: torch.Tensor
    arm_twist: torch.Tensor
    elbow: torch.Tensor
    pronation: torch.Tensor
    hip_flexion: torch.Tensor
    hip_abduction: torch.Tensor
    hip_twist: torch.Tensor
    knee: torch.Tensor
    ankle: torch.Tensor
    curl: torch.Tensor


FOLDED = 5


def draw_arms(draw: Draw) -> tuple[torch.Tensor, torch.Tensor]:
    """Pose families of both arms, each (B,): hanging, spread, forward, overhead, any, folded in front, at the face.

    Folded arms mostly come in pairs, in which they touch each other; these are the difficult poses.
    """
    shares = [0.26, 0.15, 0.14, 0.16, 0.15, 0.1, 0.04]
    left, right = (draw.family(shares) for _ in range(2))
    both = (left == FOLDED) & (draw.uniform(0, 1) < 0.75)
    return left, torch.where(both, FOLDED, right)


def draw_limbs(draw: Draw, arm: torch.Tensor, family: torch.Tensor) -> Limbs:
    """Draw the angles of one side.

    ``arm`` (B,) is the arm's family as in `draw_arms`. ``family`` (B,) is the legs' family: 0 stand, 1 wide, 2 crouch or
    sit, 3 kneel, 4 bend forward, 5 lunge.
    """
    at = torch.arange(draw.B)
    elevation = torch.stack([
        draw.normal(14, 12).abs(), draw.normal(80, 20), draw.normal(80, 28), draw.normal(150, 20),
        draw.uniform(5, 165), draw.normal(35, 18), draw.normal(55, 25),
    ])[arm, at].clamp(3, 175)  # fmt: skip
    azimuth = torch.stack([
        draw.uniform(-50, 110), draw.normal(5, 20), draw.normal(85, 28), draw.uniform(-30, 110),
        draw.uniform(-50, 130), draw.normal(75, 28), draw.normal(80, 22),
    ])[arm, at].clamp(-60, 135)  # fmt: skip
    any_elbow = draw.choice([0.45, 0.4, 0.15], [draw.normal(10, 14).abs(), draw.uniform(0, 145), draw.normal(90, 25)])
    elbow = torch.stack([any_elbow] * FOLDED + [draw.normal(95, 26), draw.normal(130, 14)])[arm, at]
    # A positive twist turns the forearm inwards. A raised arm rotates outwards, or the palms would face away from each
    # other overhead.
    raised = ((elevation - 70) / 80).clamp(0, 1)
    twist = torch.stack([draw.normal(0, 30)] * FOLDED + [draw.normal(45, 24), draw.normal(20, 26)])[arm, at]
    twist = twist - raised * draw.uniform(10, 110)
    any_pronation = draw.choice([0.7, 0.3], [draw.normal(10, 38), draw.uniform(-85, 95)])
    pronation = any_pronation - raised * draw.uniform(0, 50)
    # Order of the leg families: stand, wide, crouch or sit, kneel, bend forward, lunge (left or right first).
    flexion = torch.stack([
        draw.normal(3, 9), draw.uniform(-35, 125), draw.normal(88, 25), draw.normal(15, 25),
        draw.normal(65, 28), draw.uniform(-35, 100),
    ])[family, at].clamp(-40, 135)  # fmt: skip
    crouch_knee = (flexion * draw.uniform(0.6, 1.4) + draw.normal(0, 15)).clamp(0, 150)
    knee = torch.stack([
        draw.normal(6, 8).abs(), draw.choice([0.5, 0.5], [draw.uniform(0, 145), crouch_knee]),
        crouch_knee, draw.normal(110, 25), draw.normal(10, 12).abs(), draw.uniform(0, 110),
    ])[family, at].clamp(0, 150)  # fmt: skip
    abduction = torch.stack([
        draw.normal(7, 8), draw.uniform(-15, 55), draw.normal(12, 18), draw.normal(8, 10),
        draw.normal(10, 12), draw.normal(10, 14),
    ])[family, at].clamp(-20, 65)  # fmt: skip
    hip_twist = draw.normal(5, 16) + 0.25 * flexion.clamp_min(0) * draw.uniform(-0.6, 1.2)
    ankle = draw.normal(0, 16).clamp(-35, 40)
    curls = [draw.uniform(-0.3, 0.35), draw.normal(-0.3, 0.08), draw.uniform(0.4, 1.0)]
    curl = draw.choice([0.5, 0.25, 0.25], curls)
    arms = elevation, azimuth, twist.clamp(-130, 85), elbow.clamp(0, 150), pronation.clamp(-90, 95)
    return Limbs(*arms, flexion, abduction, hip_twist, knee, ankle, curl)


def mirror_where(source: Limbs, own: Limbs, mask: torch.Tensor, draw: Draw) -> Limbs:
    """``own`` angles of one side, where ``mask`` is true replaced by those of the other with a few degrees of noise."""
    values = {}
    for name in own.__dataclass_fields__:
        noise = draw.normal(0, 0.03 if name == "curl" else 5)
        values[name] = torch.where(mask, getattr(source, name) + noise, getattr(own, name))
    return Limbs(**values)


_LEG_FIELDS = ("hip_flexion", "hip_abduction", "hip_twist", "knee", "ankle")


def combine_arms_and_legs(arms: Limbs, legs: Limbs) -> Limbs:
    """Combine the arms of one draw with the legs of another."""
    return replace(arms, **{name: getattr(legs, name) for name in _LEG_FIELDS})
