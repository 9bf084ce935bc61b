"""Clothes as displacements of the body's surface, with hems, folds, headwear and skirts.

Probabilities and sizes are set by hand. Thicknesses are in metres on a body of average size.
"""

from __future__ import annotations

import torch
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.generators.figure import LEG, Figure, joints_of, part
from meshmatch.generators.limbs import Draw
from meshmatch.generators.rig import Rig

_HEM = 0.03  # width of a hem, as a fraction of a limb
_TORSO = 0.57  # distance between root and neck of the body that the sizes below are for, metres


class ClothingDraw(Draw):
    """Seeded draws for B bodies, each of shape (B, 1)."""

    def bernoulli(self, share: float) -> Tensor:
        """1 with probability ``share``, else 0."""
        return (self.uniform(0, 1) < share).float()

    def uniform(self, low: float, high: float) -> Tensor:
        return super().uniform(low, high)[:, None]

    def log_uniform(self, low: float, high: float) -> Tensor:
        """Log-uniform between ``low`` and ``high``."""
        return low * (high / low) ** self.uniform(0, 1)


def torso(rig: Rig, heads: Float[Tensor, "B J 3"]) -> Float[Tensor, "B 1 1"]:
    """Relative size of bodies by the length of the torso; 1 is average."""
    result: Tensor = (heads[:, rig.joint("neck01")] - heads[:, rig.joint("root")]).norm(dim=-1)[:, None, None] / _TORSO
    return result


def step(values: Tensor, at: Tensor, width: float = _HEM) -> Tensor:
    """Smooth step from 0 to 1 around ``at``, over ``width``."""
    t = ((values - at) / width + 0.5).clamp(0, 1)
    return t * t * (3 - 2 * t)


def add_clothes(
    figure: Figure, rest: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], generator: torch.Generator,
) -> Float[Tensor, "B V 3"]:  # fmt: skip
    """Add clothes to bodies at rest: trousers, tops, shoes, gloves, hoods or hair, belts and bags."""
    draw = ClothingDraw(len(rest), generator)
    thickness = _garments(figure, draw)
    cover = (60 * thickness).clamp(0, 1)[..., None] * draw.bernoulli(0.7)[..., None]
    rest = torch.lerp(rest, figure.smooth(rest, 25), cover)  # cloth bridges concavities of the body
    thickness = thickness + _bulges(figure, rest, draw)
    thickness = thickness * (1 + 0.5 * draw.uniform(0, 1) * _folds(rest, draw))
    out = figure.normals(rest) * torso(figure.rig, heads)
    return _headwear(figure, rest + thickness[..., None] * out, draw)


def _garments(figure: Figure, draw: ClothingDraw) -> Tensor:
    """(B, V) total thickness of the clothes at every vertex."""
    arm, leg, height = figure.reach[:, 0], figure.reach[:, 1], figure.height
    trunk = (figure.share[:, [part("hips"), part("belly"), part("chest")]].sum(1) > 0.5).float()
    on_arm, on_leg = (arm > -0.5).float() * (1 - trunk), (leg > -0.5).float() * (1 - trunk)
    total = torch.zeros(draw.B, len(arm))
    # Trousers: from the waist to a hem, mostly wider further down.
    hem = draw.uniform(0.4, 2.05)
    widening = 1 + draw.uniform(-0.3, 1.5) * leg.clamp_min(0)
    shape = on_leg * (1 - step(leg, hem)) * widening.clamp_min(0.2) + trunk * (
        1 - step(height, draw.uniform(0.05, 0.35))
    )
    total += draw.bernoulli(0.75) * draw.log_uniform(0.006, 0.07) * shape
    # Tops: over the trunk down to a hem, with sleeves that may widen.
    sleeve = draw.uniform(0.0, 2.0)
    widening = 1 + draw.bernoulli(0.4) * draw.uniform(0, 2) * arm.clamp_min(0)
    low = draw.uniform(-0.35, 0.3)
    shape = trunk * step(height, low, 0.06) * (1 + draw.uniform(-0.3, 1.2) * (0.7 - height).clamp(0, 1))
    shape = shape + on_arm * (1 - step(arm, sleeve)) * widening
    shape = shape + on_leg * step(-leg * 0.45, low, 0.06)
    total += draw.bernoulli(0.8) * draw.log_uniform(0.007, 0.08) * shape
    # Collars, shoulder pieces, cuffs, boots and their soles, gloves.
    neck = figure.share[:, part("neck")]
    total += draw.bernoulli(0.35) * draw.log_uniform(0.01, 0.07) * neck
    total += (
        draw.bernoulli(0.25) * draw.log_uniform(0.01, 0.08) * on_arm * (1 - step(arm, draw.uniform(0.15, 0.5), 0.1))
    )
    cuff = step(arm, draw.uniform(1.2, 1.7)) * (1 - step(arm, draw.uniform(1.75, 2.0)))
    total += draw.bernoulli(0.2) * draw.log_uniform(0.01, 0.05) * cuff
    total += draw.bernoulli(0.65) * draw.log_uniform(0.006, 0.045) * on_leg * step(leg, draw.uniform(1.0, 2.1))
    knee = torch.exp(-(((leg - 1) / 0.2) ** 2))
    total += draw.bernoulli(0.15) * draw.log_uniform(0.01, 0.04) * on_leg * knee
    total += draw.bernoulli(0.4) * draw.log_uniform(0.004, 0.03) * on_arm * step(arm, draw.uniform(1.5, 2.1))
    belt = torch.exp(-(((height - draw.uniform(0.05, 0.3)) / 0.05) ** 4)) * trunk
    total += draw.bernoulli(0.35) * draw.log_uniform(0.005, 0.03) * belt
    return total


def _bulges(figure: Figure, rest: Tensor, draw: ClothingDraw) -> Tensor:
    """Thickness of bags, pouches and pads: bumps at random places, sometimes a large one on the back."""
    total = torch.zeros(rest.shape[:2])
    rows = torch.arange(draw.B)
    for _ in range(2):
        at = torch.randint(rest.shape[1], (draw.B,), generator=draw.generator)
        squared = (rest - rest[rows, at][:, None]).square().sum(-1) / draw.log_uniform(0.03, 0.12) ** 2
        total += draw.bernoulli(0.4) * draw.log_uniform(0.01, 0.06) * torch.exp(-(squared**2))
    back = (figure.height > 0.25) & (figure.share[:, [part("belly"), part("chest")]].sum(1) > 0.5)
    back = back & (rest.mean(0)[:, 2] < -0.02)
    backpack = torch.exp(-(((figure.height - draw.uniform(0.45, 0.75)) / draw.uniform(0.2, 0.4)) ** 4)) * back
    return total + draw.bernoulli(0.12) * draw.uniform(0.05, 0.2) * backpack


def _folds(rest: Tensor, draw: ClothingDraw) -> Tensor:
    """Folds as waves over the surface, between -1 and 1."""
    total = torch.zeros(rest.shape[:2])
    for frequency in (15.0, 35.0):
        direction = (
            torch.randn(draw.B, 3, 1, generator=draw.generator) * frequency * torch.tensor([1.0, 0.5, 1.0])[:, None]
        )
        total += 0.5 * torch.sin((rest @ direction)[..., 0] + draw.uniform(0, 6.3))
    return total


def _headwear(figure: Figure, verts: Tensor, draw: ClothingDraw) -> Tensor:
    """Add hair, caps, hoods or helmets: move the skull except the face outwards; some are pointed, long or have a brim."""
    head_share = figure.share[:, part("head")]
    middle = (head_share[:, None] * verts).sum(1, keepdim=True) / head_share.sum()
    local = verts - middle
    size = ((head_share[:, None] * local.square()).sum(1, keepdim=True) / head_share.sum()).mean(
        -1, keepdim=True
    ).sqrt() * 3**0.5
    direction = torch.nn.functional.normalize(figure.skull, dim=-1)
    # The face is a cone around a direction slightly below straight ahead; the rim of the headwear is at a random angle.
    face = torch.nn.functional.normalize(
        torch.stack([draw.uniform(-0.15, 0.15), draw.uniform(-0.6, -0.1), draw.uniform(1, 1)], -1), dim=-1
    )
    angle = torch.rad2deg(torch.acos((direction * face).sum(-1).clamp(-1, 1)))
    across, up = figure.skull[:, [0, 2]][None], figure.skull[:, 1][None]
    rim = draw.uniform(35, 85) * (1 - draw.bernoulli(0.15))  # closed helmets cover the face
    above = step(up, draw.uniform(-1.1, 0.2), 0.12)
    is_long = draw.bernoulli(0.3)  # long hair and hoods reach the neck
    above = torch.maximum(above, is_long * step(up, torch.tensor(-2.2), 0.12))
    head_weight = (head_share + figure.share[:, part("neck")]).clamp(0, 1)
    mask = head_weight * step(angle, rim, 6.0) * above * draw.bernoulli(0.7)
    growth = 1 + draw.log_uniform(0.04, 0.5) * (1 + 0.25 * _folds(figure.skull.expand_as(verts), draw))
    radius = local.norm(dim=-1)
    floor = size[..., 0] * draw.uniform(0.8, 1.15)  # minimum radius: hair makes a skull round
    target = torch.maximum(radius * growth, floor * step(up, torch.tensor(-0.9), 0.8) * draw.bernoulli(0.5))
    displaced = middle + local / radius.clamp_min(1e-6)[..., None] * target[..., None]
    # Pointed headwear: move the top up and back.
    tip = draw.bernoulli(0.3) * draw.uniform(0.2, 1.2)
    peak = torch.stack([draw.uniform(-0.2, 0.2), draw.uniform(-0.6, 0.2)], -1)
    from_peak = (across - peak) / draw.uniform(0.25, 0.7)[..., None]
    top = torch.exp(-from_peak.square().sum(-1)) * step(up, torch.tensor(0.0), 1.0)
    displaced = displaced + (tip * top)[..., None] * size * torch.nn.functional.normalize(
        torch.stack([0 * tip, 1 + 0 * tip, draw.uniform(-0.8, 0.2)], -1), dim=-1
    )
    brim_width = draw.bernoulli(0.12) * draw.uniform(0.2, 0.9)
    brim = brim_width * torch.exp(-(((up - draw.uniform(0.1, 0.5)) / 0.12) ** 2)) * head_weight
    horizontal = local * torch.tensor([1.0, 0.0, 1.0])
    verts = torch.lerp(verts, displaced, mask[..., None])
    return verts + brim[..., None] * horizontal


def add_skirts(
    figure: Figure, verts: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], joints: Float[Tensor, "B J 3"],
    generator: torch.Generator,
) -> Float[Tensor, "B V 3"]:  # fmt: skip
    """Add skirts, robes and coat tails to posed bodies: one sheet around both legs, down to a hem.

    The outer side of each leg becomes the outside of the sheet. The side that faces the other leg closes the gap between
    the legs in front and behind, and is otherwise folded inside.
    """
    draw, rig = ClothingDraw(len(verts), generator), figure.rig
    size = torso(rig, heads)[..., 0]
    hem, flare, wide = draw.uniform(0.25, 1.95), draw.uniform(0.0, 0.11) * size, draw.uniform(0.01, 0.07) * size
    strength = draw.uniform(0.5, 1.0)  # blend factor towards the sheet
    paths = {
        side: joints[:, [joints_of(rig, "thigh", side)[0], *(joints_of(rig, name, side)[1] for name in LEG[:2])]]
        for side in "LR"
    }
    thighs = [torch.nn.functional.normalize(paths[side][:, 1] - paths[side][:, 0], dim=-1) for side in "LR"]
    legs_parallel = step((thighs[0] * thighs[1]).sum(-1, keepdim=True), torch.tensor(0.6), 0.5)
    reach = figure.reach[:, 1]
    result = verts.clone()
    wave_height, n_waves = draw.uniform(0, 0.35), torch.randint(2, 7, (draw.B, 1), generator=generator)
    phase = draw.uniform(0, 6.3)
    for side, other in (("L", "R"), ("R", "L")):
        leg_share = figure.share[:, [part(name, side) for name in LEG]].sum(1)
        at = torch.nonzero((leg_share > 0.25) & (reach < 2.1))[:, 0]
        s = reach[at]
        leg_points, other_axis, axis = verts[:, at], _point_on(paths[other], s), _point_on(paths[side], s)
        down = torch.nn.functional.normalize(
            _point_on(paths[side], s + 0.02) - _point_on(paths[side], s - 0.02), dim=-1
        )
        across = axis - other_axis
        across = torch.nn.functional.normalize(across - (across * down).sum(-1, keepdim=True) * down, dim=-1)
        ahead = torch.linalg.cross(across, down)
        spoke = leg_points - axis
        axial = (spoke * down).sum(-1, keepdim=True) * down
        spoke = spoke - axial
        radius = spoke.norm(dim=-1).clamp_min(1e-5)
        cosine, sine = (spoke * across).sum(-1) / radius, (spoke * ahead).sum(-1) / radius
        angle = torch.atan2(sine, cosine)
        r = torch.maximum(radius, radius.mean(1, keepdim=True) * 0.9) + wide + flare * s
        r = r * (1 + wave_height * (s * 0.6) * torch.sin(angle * n_waves + phase))
        outer = axis + r[..., None] * (cosine[..., None] * across + sine[..., None] * ahead)
        inward = (-cosine).clamp_min(0)
        sheet = torch.tanh(4 * sine) / torch.tanh(torch.tensor(4.0))
        inner = axis + 0.5 * (other_axis - axis) * inward[..., None] + (r * sheet)[..., None] * ahead
        target = torch.where((cosine > 0)[..., None], outer, inner) + axial
        share = (1 - step(s, hem, 0.05)) * step(s, torch.tensor(0.08), 0.3) * strength * legs_parallel
        result[:, at] = torch.lerp(
            leg_points, target, share[..., None] * step(leg_share[at], torch.tensor(0.6), 0.6)[..., None]
        )
    return result


def _point_on(path: Float[Tensor, "B K 3"], s: Float[Tensor, " V"]) -> Float[Tensor, "B V 3"]:
    """Points of a polyline of K points at parameters from 0 to K - 1, extrapolated linearly beyond both ends."""
    k = s.floor().clamp(0, path.shape[1] - 2).long()
    t = (s - k)[..., None]
    return path[:, k] * (1 - t) + path[:, k + 1] * t
