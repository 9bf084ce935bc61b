"""Clothes as layers of the body: what is worn is the body's surface, moved out, with hems, folds, hoods and skirts.

Shares and sizes are set by hand. Thicknesses are metres on a body of ordinary size.
"""

from __future__ import annotations

import torch
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.generators.figure import LEG, Figure, joints_of, part
from meshmatch.generators.limbs import Draw
from meshmatch.generators.rig import Rig

_HEM = 0.03  # over so much of a limb a hem rises
_TORSO = 0.57  # metres between root and neck, for which the sizes below are meant


class Wear(Draw):
    """Seeded draws for B bodies, each (B, 1)."""

    def some(self, share: float) -> Tensor:
        """1 for so many of the bodies, else 0."""
        return (self.uniform(0, 1) < share).float()

    def uniform(self, low: float, high: float) -> Tensor:
        return super().uniform(low, high)[:, None]

    def thick(self, low: float, high: float) -> Tensor:
        """Thin is more frequent than thick."""
        return low * (high / low) ** self.uniform(0, 1)


def torso(rig: Rig, heads: Float[Tensor, "B J 3"]) -> Float[Tensor, "B 1 1"]:
    """Size of bodies, 1 for an ordinary one."""
    result: Tensor = (heads[:, rig.joint("neck01")] - heads[:, rig.joint("root")]).norm(dim=-1)[:, None, None] / _TORSO
    return result


def step(values: Tensor, at: Tensor, width: float = _HEM) -> Tensor:
    """0 below, 1 above, within so much smooth."""
    t = ((values - at) / width + 0.5).clamp(0, 1)
    return t * t * (3 - 2 * t)


def dressed(
    figure: Figure, rest: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], generator: torch.Generator,
) -> Float[Tensor, "B V 3"]:  # fmt: skip
    """Resting bodies in trousers, tops, shoes, gloves, hoods or hair, with belts and bags."""
    wear = Wear(len(rest), generator)
    thickness = _garments(figure, wear)
    cover = (60 * thickness).clamp(0, 1)[..., None] * wear.some(0.7)[..., None]
    rest = torch.lerp(rest, figure.smooth(rest, 25), cover)  # cloth bridges what is below
    thickness = thickness + _bulges(figure, rest, wear)
    thickness = thickness * (1 + 0.5 * wear.uniform(0, 1) * _folds(rest, wear))
    out = figure.normals(rest) * torso(figure.rig, heads)
    return _headwear(figure, rest + thickness[..., None] * out, wear)


def _garments(figure: Figure, wear: Wear) -> Tensor:
    """Thickness of all that is worn at every vertex, (B, V)."""
    arm, leg, height = figure.reach[:, 0], figure.reach[:, 1], figure.height
    trunk = (figure.share[:, [part("hips"), part("belly"), part("chest")]].sum(1) > 0.5).float()
    on_arm, on_leg = (arm > -0.5).float() * (1 - trunk), (leg > -0.5).float() * (1 - trunk)
    total = torch.zeros(wear.B, len(arm))
    # Trousers: from the waist to a hem, wider further down.
    hem = wear.uniform(0.4, 2.05)
    widening = 1 + wear.uniform(-0.3, 1.5) * leg.clamp_min(0)
    shape = on_leg * (1 - step(leg, hem)) * widening.clamp_min(0.2) + trunk * (
        1 - step(height, wear.uniform(0.05, 0.35))
    )
    total += wear.some(0.75) * wear.thick(0.006, 0.07) * shape
    # Tops: over the trunk down to a hem, sleeves that may widen.
    sleeve = wear.uniform(0.0, 2.0)
    widening = 1 + wear.some(0.4) * wear.uniform(0, 2) * arm.clamp_min(0)
    low = wear.uniform(-0.35, 0.3)
    shape = trunk * step(height, low, 0.06) * (1 + wear.uniform(-0.3, 1.2) * (0.7 - height).clamp(0, 1))
    shape = shape + on_arm * (1 - step(arm, sleeve)) * widening
    shape = shape + on_leg * step(-leg * 0.45, low, 0.06)
    total += wear.some(0.8) * wear.thick(0.007, 0.08) * shape
    # Collars, shoulder pieces, cuffs, boots and their soles, gloves.
    neck = figure.share[:, part("neck")]
    total += wear.some(0.35) * wear.thick(0.01, 0.07) * neck
    total += wear.some(0.25) * wear.thick(0.01, 0.08) * on_arm * (1 - step(arm, wear.uniform(0.15, 0.5), 0.1))
    cuff = step(arm, wear.uniform(1.2, 1.7)) * (1 - step(arm, wear.uniform(1.75, 2.0)))
    total += wear.some(0.2) * wear.thick(0.01, 0.05) * cuff
    total += wear.some(0.65) * wear.thick(0.006, 0.045) * on_leg * step(leg, wear.uniform(1.0, 2.1))
    knee = torch.exp(-(((leg - 1) / 0.2) ** 2))
    total += wear.some(0.15) * wear.thick(0.01, 0.04) * on_leg * knee
    total += wear.some(0.4) * wear.thick(0.004, 0.03) * on_arm * step(arm, wear.uniform(1.5, 2.1))
    belt = torch.exp(-(((height - wear.uniform(0.05, 0.3)) / 0.05) ** 4)) * trunk
    total += wear.some(0.35) * wear.thick(0.005, 0.03) * belt
    return total


def _bulges(figure: Figure, rest: Tensor, wear: Wear) -> Tensor:
    """Bags, pouches, pads: bumps at random places, and now and then something large on the back."""
    total = torch.zeros(rest.shape[:2])
    rows = torch.arange(wear.B)
    for _ in range(2):
        at = torch.randint(rest.shape[1], (wear.B,), generator=wear.generator)
        near = (rest - rest[rows, at][:, None]).square().sum(-1) / wear.thick(0.03, 0.12) ** 2
        total += wear.some(0.4) * wear.thick(0.01, 0.06) * torch.exp(-(near**2))
    back = (figure.height > 0.25) & (figure.share[:, [part("belly"), part("chest")]].sum(1) > 0.5)
    back = back & (rest.mean(0)[:, 2] < -0.02)
    pack = torch.exp(-(((figure.height - wear.uniform(0.45, 0.75)) / wear.uniform(0.2, 0.4)) ** 4)) * back
    return total + wear.some(0.12) * wear.uniform(0.05, 0.2) * pack


def _folds(rest: Tensor, wear: Wear) -> Tensor:
    """Waves over the surface, between -1 and 1."""
    total = torch.zeros(rest.shape[:2])
    for frequency in (15.0, 35.0):
        direction = (
            torch.randn(wear.B, 3, 1, generator=wear.generator) * frequency * torch.tensor([1.0, 0.5, 1.0])[:, None]
        )
        total += 0.5 * torch.sin((rest @ direction)[..., 0] + wear.uniform(0, 6.3))
    return total


def _headwear(figure: Figure, verts: Tensor, wear: Wear) -> Tensor:
    """Hair, caps, hoods and helmets: the skull but for the face, further from the middle; some pointed, some long."""
    own = figure.share[:, part("head")]
    middle = (own[:, None] * verts).sum(1, keepdim=True) / own.sum()
    local = verts - middle
    size = ((own[:, None] * local.square()).sum(1, keepdim=True) / own.sum()).mean(-1, keepdim=True).sqrt() * 3**0.5
    toward = torch.nn.functional.normalize(figure.skull, dim=-1)
    # The face is what lies around a direction a little below ahead; its rim runs at some angle.
    face = torch.nn.functional.normalize(
        torch.stack([wear.uniform(-0.15, 0.15), wear.uniform(-0.6, -0.1), wear.uniform(1, 1)], -1), dim=-1
    )
    angle = torch.rad2deg(torch.acos((toward * face).sum(-1).clamp(-1, 1)))
    across, up = figure.skull[:, [0, 2]][None], figure.skull[:, 1][None]
    rim = wear.uniform(35, 85) * (1 - wear.some(0.15))  # some have no face: closed helmets
    above = step(up, wear.uniform(-1.1, 0.2), 0.12)
    down = wear.some(0.3)  # long hair and hoods reach the neck
    above = torch.maximum(above, down * step(up, torch.tensor(-2.2), 0.12))
    near = (own + figure.share[:, part("neck")]).clamp(0, 1)
    mask = near * step(angle, rim, 6.0) * above * wear.some(0.7)
    grown = 1 + wear.thick(0.04, 0.5) * (1 + 0.25 * _folds(figure.skull.expand_as(verts), wear))
    radius = local.norm(dim=-1)
    floor = size[..., 0] * wear.uniform(0.8, 1.15)  # hair makes a skull round
    target = torch.maximum(radius * grown, floor * step(up, torch.tensor(-0.9), 0.8) * wear.some(0.5))
    moved = middle + local / radius.clamp_min(1e-6)[..., None] * target[..., None]
    # Pointed: up and back, at the top.
    tip = wear.some(0.3) * wear.uniform(0.2, 1.2)
    peak = torch.stack([wear.uniform(-0.2, 0.2), wear.uniform(-0.6, 0.2)], -1)
    away = (across - peak) / wear.uniform(0.25, 0.7)[..., None]
    top = torch.exp(-away.square().sum(-1)) * step(up, torch.tensor(0.0), 1.0)
    moved = moved + (tip * top)[..., None] * size * torch.nn.functional.normalize(
        torch.stack([0 * tip, 1 + 0 * tip, wear.uniform(-0.8, 0.2)], -1), dim=-1
    )
    wide = wear.some(0.12) * wear.uniform(0.2, 0.9)
    brim = wide * torch.exp(-(((up - wear.uniform(0.1, 0.5)) / 0.12) ** 2)) * near
    flat = local * torch.tensor([1.0, 0.0, 1.0])
    verts = torch.lerp(verts, moved, mask[..., None])
    return verts + brim[..., None] * flat


def skirted(
    figure: Figure, verts: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], joints: Float[Tensor, "B J 3"],
    generator: torch.Generator,
) -> Float[Tensor, "B V 3"]:  # fmt: skip
    """Posed bodies in skirts, robes and coat tails: one sheet around both legs, down to a hem.

    What faces the other leg closes the sheet in front and behind, where the legs face it, and is folded inside elsewhere.
    """
    wear, rig = Wear(len(verts), generator), figure.rig
    size = torso(rig, heads)[..., 0]
    hem, flare, wide = wear.uniform(0.25, 1.95), wear.uniform(0.0, 0.11) * size, wear.uniform(0.01, 0.07) * size
    close = wear.uniform(0.5, 1.0)  # towards a round sheet
    paths = {
        side: joints[:, [joints_of(rig, "thigh", side)[0], *(joints_of(rig, name, side)[1] for name in LEG[:2])]]
        for side in "LR"
    }
    thighs = [torch.nn.functional.normalize(paths[side][:, 1] - paths[side][:, 0], dim=-1) for side in "LR"]
    together = step((thighs[0] * thighs[1]).sum(-1, keepdim=True), torch.tensor(0.6), 0.5)
    reach = figure.reach[:, 1]
    moved = verts.clone()
    wave, count = wear.uniform(0, 0.35), torch.randint(2, 7, (wear.B, 1), generator=generator)
    phase = wear.uniform(0, 6.3)
    for side, other in (("L", "R"), ("R", "L")):
        own = figure.share[:, [part(name, side) for name in LEG]].sum(1)
        at = torch.nonzero((own > 0.25) & (reach < 2.1))[:, 0]
        s = reach[at]
        here, there, middle = verts[:, at], _on(paths[other], s), _on(paths[side], s)
        down = torch.nn.functional.normalize(_on(paths[side], s + 0.02) - _on(paths[side], s - 0.02), dim=-1)
        across = middle - there
        across = torch.nn.functional.normalize(across - (across * down).sum(-1, keepdim=True) * down, dim=-1)
        ahead = torch.linalg.cross(across, down)
        spoke = here - middle
        level = (spoke * down).sum(-1, keepdim=True) * down
        spoke = spoke - level
        radius = spoke.norm(dim=-1).clamp_min(1e-5)
        cosine, sine = (spoke * across).sum(-1) / radius, (spoke * ahead).sum(-1) / radius
        turn = torch.atan2(sine, cosine)
        r = torch.maximum(radius, radius.mean(1, keepdim=True) * 0.9) + wide + flare * s
        r = r * (1 + wave * (s * 0.6) * torch.sin(turn * count + phase))
        outer = middle + r[..., None] * (cosine[..., None] * across + sine[..., None] * ahead)
        inward = (-cosine).clamp_min(0)
        sheet = torch.tanh(4 * sine) / torch.tanh(torch.tensor(4.0))
        inner = middle + 0.5 * (there - middle) * inward[..., None] + (r * sheet)[..., None] * ahead
        target = torch.where((cosine > 0)[..., None], outer, inner) + level
        share = (1 - step(s, hem, 0.05)) * step(s, torch.tensor(0.08), 0.3) * close * together
        moved[:, at] = torch.lerp(here, target, share[..., None] * step(own[at], torch.tensor(0.6), 0.6)[..., None])
    return moved


def _on(path: Float[Tensor, "B K 3"], s: Float[Tensor, " V"]) -> Float[Tensor, "B V 3"]:
    """Points of a path of K points at parameters from 0 to K - 1; straight on beyond both ends."""
    k = s.floor().clamp(0, path.shape[1] - 2).long()
    t = (s - k)[..., None]
    return path[:, k] * (1 - t) + path[:, k + 1] * t
