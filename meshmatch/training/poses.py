"""Random human poses inside anatomical joint limits, rejected where the body would run into itself.

Angles follow the clinical convention (flexion, abduction, twist) and are drawn from a mixture of
everyday families (standing, reaching, overhead, sitting, crouching, kneeling, bending, lunging) and
of wide uniform ranges, so that rare poses are rare but present. Rotations are expressed in the axes of
the rest pose (y up, facing +z, left at +x) about the rest joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from meshmatch.training.rig import Rig

DEGREE = math.pi / 180.0


def rotation_from_vector(vector: torch.Tensor) -> torch.Tensor:
    """Rodrigues' formula: rotation vectors (..., 3) in radians to matrices (..., 3, 3)."""
    angle = vector.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    x, y, z = (vector / angle).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    return torch.eye(3).to(vector) + sine * cross + (1 - cosine) * (cross @ cross)


def rotation_between(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Smallest rotation that takes unit vectors a (..., 3) to b (..., 3); returns a rotation vector."""
    axis = torch.linalg.cross(a, b)
    sine = axis.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (a * b).sum(-1, keepdim=True))
    return axis / sine.clamp_min(1e-9) * angle


def _unit(vector: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.normalize(vector, dim=-1)


class _Draw:
    """Shorthand for seeded draws of shape (B,)."""

    def __init__(self, B: int, generator: torch.Generator) -> None:
        self.B, self.generator = B, generator

    def normal(self, mean: float, deviation: float) -> torch.Tensor:
        return mean + deviation * torch.randn(self.B, generator=self.generator)

    def uniform(self, low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(self.B, generator=self.generator)

    def normal3(self, deviation: float) -> torch.Tensor:
        return deviation * DEGREE * torch.randn(self.B, 3, generator=self.generator)

    def choice(self, weights: list[float], options: list[torch.Tensor]) -> torch.Tensor:
        pick = torch.multinomial(torch.tensor(weights), self.B, True, generator=self.generator)
        return torch.stack(options)[pick, torch.arange(self.B)]


@dataclass(frozen=True)
class _Limbs:
    """Clinical angles in degrees, each (B,), of one side of the body."""

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


def _draw_limbs(draw: _Draw, family: torch.Tensor) -> _Limbs:
    arm = torch.multinomial(
        torch.tensor([0.3, 0.18, 0.16, 0.18, 0.18]), draw.B, True, generator=draw.generator
    )
    at = torch.arange(draw.B)
    elevation = torch.stack(
        [
            draw.normal(14, 12).abs(),
            draw.normal(80, 20),
            draw.normal(80, 28),
            draw.normal(150, 20),
            draw.uniform(5, 165),
        ]
    )[arm, at].clamp(3, 175)
    azimuth = torch.stack(
        [
            draw.uniform(-50, 110),
            draw.normal(5, 20),
            draw.normal(85, 28),
            draw.uniform(-30, 110),
            draw.uniform(-50, 130),
        ]
    )[arm, at].clamp(-60, 135)
    elbow = draw.choice(
        [0.45, 0.4, 0.15], [draw.normal(10, 14).abs(), draw.uniform(0, 145), draw.normal(90, 25)]
    )
    # Families of the legs: stand, wide, crouch or sit, kneel, bend forward, lunge (left or right first).
    flexion = torch.stack(
        [
            draw.normal(3, 9),
            draw.uniform(-35, 125),
            draw.normal(88, 25),
            draw.normal(15, 25),
            draw.normal(65, 28),
            draw.uniform(-35, 100),
        ]
    )[family, at].clamp(-40, 135)
    crouch_knee = (flexion * draw.uniform(0.6, 1.4) + draw.normal(0, 15)).clamp(0, 150)
    knee = torch.stack(
        [
            draw.normal(6, 8).abs(),
            draw.choice([0.5, 0.5], [draw.uniform(0, 145), crouch_knee]),
            crouch_knee,
            draw.normal(110, 25),
            draw.normal(10, 12).abs(),
            draw.uniform(0, 110),
        ]
    )[family, at].clamp(0, 150)
    spread = torch.stack(
        [
            draw.normal(7, 8),
            draw.uniform(-15, 55),
            draw.normal(12, 18),
            draw.normal(8, 10),
            draw.normal(10, 12),
            draw.normal(10, 14),
        ]
    )[family, at].clamp(-20, 65)
    return _Limbs(
        arm_elevation=elevation,
        arm_azimuth=azimuth,
        arm_twist=draw.normal(0, 30).clamp(-80, 80),
        elbow=elbow.clamp(0, 150),
        pronation=draw.normal(10, 38).clamp(-85, 95),
        hip_flexion=flexion,
        hip_abduction=spread,
        hip_twist=draw.normal(5, 16) + 0.25 * flexion.clamp_min(0) * draw.uniform(-0.6, 1.2),
        knee=knee,
        ankle=draw.normal(0, 16).clamp(-35, 40),
        curl=draw.choice(
            [0.5, 0.25, 0.25], [draw.uniform(-0.3, 0.35), draw.normal(-0.3, 0.08), draw.uniform(0.4, 1.0)]
        ),
    )


def _mirror(source: _Limbs, own: _Limbs, mask: torch.Tensor, draw: _Draw) -> _Limbs:
    """Where mask holds, a side repeats the other with a few degrees of difference."""
    values = {}
    for name in own.__dataclass_fields__:
        noise = draw.normal(0, 0.03 if name == "curl" else 5)
        values[name] = torch.where(mask, getattr(source, name) + noise, getattr(own, name))
    return _Limbs(**values)


_LEG_FIELDS = ("hip_flexion", "hip_abduction", "hip_twist", "knee", "ankle")


def _with_legs(arms: _Limbs, legs: _Limbs) -> _Limbs:
    values = {
        name: getattr(legs if name in _LEG_FIELDS else arms, name) for name in arms.__dataclass_fields__
    }
    return _Limbs(**values)


def sample_pose(rig: Rig, heads: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Draw one pose per body.

    Parameters
    ----------
    heads : float tensor (B, J, 3)
        Rest joints of the bodies, metres.

    Returns
    -------
    float tensor (B, J, 3, 3)
        Rotation of every joint, in rest axes, relative to its parent.
    """
    B, J = heads.shape[:2]
    draw = _Draw(B, generator)
    vectors = torch.zeros(B, J, 3)
    joint = rig.joint
    family = torch.multinomial(torch.tensor([0.34, 0.24, 0.14, 0.08, 0.1, 0.1]), B, True, generator=generator)
    left, right = _draw_limbs(draw, family), _draw_limbs(draw, family)
    same_arms = torch.rand(B, generator=generator) < 0.3
    same_legs = torch.rand(B, generator=generator) < 0.35
    right = _with_legs(_mirror(left, right, same_arms, draw), _mirror(left, right, same_legs, draw))

    rotations_of = _pose_limbs(vectors, rig, heads, left, right, draw)

    flex = draw.choice([0.6, 0.25, 0.15], [draw.normal(4, 10), draw.uniform(-30, 75), draw.normal(35, 20)])
    spine = torch.stack([flex, draw.normal(0, 20), draw.normal(0, 14)], -1) * DEGREE
    spine = spine * (0.6 + 0.8 * torch.rand(B, 1, generator=generator))
    for name, share in (
        ("spine05", 0.15),
        ("spine04", 0.25),
        ("spine03", 0.2),
        ("spine02", 0.2),
        ("spine01", 0.2),
    ):
        vectors[:, joint(name)] = spine * share + draw.normal3(2)
    neck = torch.stack([draw.normal(2, 18), draw.normal(0, 28), draw.normal(0, 14)], -1) * DEGREE
    for name, share in (("neck01", 0.3), ("neck02", 0.2), ("neck03", 0.2), ("head", 0.3)):
        vectors[:, joint(name)] = neck * share

    return rotations_of()


def _pose_limbs(
    vectors: torch.Tensor, rig: Rig, heads: torch.Tensor, left: _Limbs, right: _Limbs, draw: _Draw
) -> Callable[[], torch.Tensor]:
    """Write both sides into ``vectors``; the returned function turns the finished vectors into matrices."""
    extra: dict[int, torch.Tensor] = {}
    for side, suffix, limbs in ((1.0, ".L", left), (-1.0, ".R", right)):
        _pose_arm(vectors, extra, rig, heads, side, suffix, limbs, draw)
        _pose_leg(vectors, extra, rig, heads, side, suffix, limbs, draw)
        _pose_hand(vectors, rig, heads, suffix, limbs, draw)

    def finish() -> torch.Tensor:
        rotations = rotation_from_vector(vectors)
        for index, rotation in extra.items():
            rotations[:, index] = rotation
        return rotations

    return finish


class _Still(_Draw):
    """Draws nothing: every value is its mean, so a template stands exactly as asked."""

    def __init__(self, B: int) -> None:
        super().__init__(B, torch.Generator())

    def normal(self, mean: float, deviation: float) -> torch.Tensor:
        return torch.full((self.B,), float(mean))

    def uniform(self, low: float, high: float) -> torch.Tensor:
        return torch.full((self.B,), 0.5 * (low + high))

    def normal3(self, deviation: float) -> torch.Tensor:
        return torch.zeros(self.B, 3)


def still_pose(rig: Rig, heads: torch.Tensor, arms: float, legs: float) -> torch.Tensor:
    """Stand still with straight limbs: arms raised and legs spread by so many degrees; (B, J, 3, 3)."""
    B, J = heads.shape[:2]
    vectors = torch.zeros(B, J, 3)
    angles = dict.fromkeys(_Limbs.__dataclass_fields__, 0.0) | {
        "arm_elevation": arms,
        "arm_azimuth": 8.0,
        "elbow": 4.0,
        "hip_flexion": 2.0,
        "hip_abduction": legs,
        "knee": 2.0,
        "curl": -0.15,
    }
    limbs = _Limbs(**{name: torch.full((B,), angle) for name, angle in angles.items()})
    return _pose_limbs(vectors, rig, heads, limbs, limbs, _Still(B))()


def _pose_arm(vectors, extra, rig, heads, side, suffix, limbs, draw) -> None:
    joint = rig.joint
    upper, elbow, wrist = (heads[:, joint(name + suffix)] for name in ("upperarm01", "lowerarm01", "wrist"))
    rest_arm, rest_fore = _unit(elbow - upper), _unit(wrist - elbow)
    elevation, azimuth = limbs.arm_elevation * DEGREE, limbs.arm_azimuth * DEGREE
    target = torch.stack(
        [
            side * elevation.sin() * azimuth.cos(),
            -elevation.cos(),
            elevation.sin() * azimuth.sin(),
        ],
        -1,
    )
    swing = rotation_between(rest_arm, target)
    # The shoulder girdle takes part of every elevation.
    share = draw.uniform(0.1, 0.3)[:, None]
    clavicle = rotation_from_vector(swing * share)
    local = (clavicle.transpose(1, 2) @ target[..., None])[..., 0]
    extra[joint("clavicle" + suffix)] = clavicle
    twist = side * limbs.arm_twist[:, None] * DEGREE * rest_arm
    extra[joint("upperarm01" + suffix)] = rotation_from_vector(
        rotation_between(rest_arm, local)
    ) @ rotation_from_vector(0.5 * twist)
    vectors[:, joint("upperarm02" + suffix)] = 0.5 * twist
    hinge = torch.linalg.cross(rest_arm, rest_fore)
    rest_flexion = torch.asin(hinge.norm(dim=-1).clamp(max=1.0))
    vectors[:, joint("lowerarm01" + suffix)] = _unit(hinge) * (limbs.elbow * DEGREE - rest_flexion)[:, None]
    vectors[:, joint("lowerarm02" + suffix)] = side * limbs.pronation[:, None] * DEGREE * rest_fore
    vectors[:, joint("wrist" + suffix)] = draw.normal3(16)


def _pose_leg(vectors, extra, rig, heads, side, suffix, limbs, draw) -> None:
    joint = rig.joint
    hip, knee, ankle = (heads[:, joint(name + suffix)] for name in ("upperleg01", "lowerleg01", "foot"))
    rest_thigh, rest_shin = _unit(knee - hip), _unit(ankle - knee)
    flexion, spread = limbs.hip_flexion * DEGREE, limbs.hip_abduction * DEGREE
    target = torch.stack(
        [side * spread.sin(), -spread.cos() * flexion.cos(), spread.cos() * flexion.sin()], -1
    )
    # Flex first, then spread: a plain smallest rotation would roll the knee outwards.
    flex = rotation_from_vector(
        torch.stack([-flexion, torch.zeros_like(flexion), torch.zeros_like(flexion)], -1)
    )
    flexed = (flex @ rest_thigh[..., None])[..., 0]
    twist = -side * limbs.hip_twist[:, None] * DEGREE * rest_thigh
    extra[joint("upperleg01" + suffix)] = (
        rotation_from_vector(rotation_between(flexed, target)) @ flex @ rotation_from_vector(0.5 * twist)
    )
    vectors[:, joint("upperleg02" + suffix)] = 0.5 * twist
    backward = torch.tensor([0.0, 0.0, -1.0]).expand_as(rest_thigh)
    hinge = _unit(torch.linalg.cross(rest_thigh, backward))
    rest_flexion = torch.asin((torch.linalg.cross(rest_thigh, rest_shin) * hinge).sum(-1).clamp(-1, 1))
    vectors[:, joint("lowerleg01" + suffix)] = hinge * (limbs.knee * DEGREE - rest_flexion)[:, None]
    ankle_vector = draw.normal3(8)
    ankle_vector[:, 0] += limbs.ankle * DEGREE
    vectors[:, joint("foot" + suffix)] = ankle_vector


def _pose_hand(vectors, rig, heads, suffix, limbs, draw) -> None:
    joint = rig.joint
    for finger in range(1, 6):
        first, second, third = (joint(f"finger{finger}-{k}{suffix}") for k in (1, 2, 3))
        a = _unit(heads[:, second] - heads[:, first])
        b = _unit(heads[:, third] - heads[:, second])
        axis = _unit(torch.linalg.cross(a, b))
        strength = (0.45 if finger == 1 else 1.0) * (limbs.curl + draw.normal(0, 0.06))
        for index, degrees in ((first, 70.0), (second, 90.0), (third, 60.0)):
            vectors[:, index] = axis * (strength * degrees * DEGREE)[:, None]


def forward_kinematics(
    rig: Rig, heads: torch.Tensor, rotations: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """World rotation and offset of every joint: x -> R x + t for a rest point x.

    Returns R (B, J, 3, 3) and t (B, J, 3).
    """
    world: list[torch.Tensor] = []
    offset: list[torch.Tensor] = []
    for index, parent in enumerate(rig.parents):
        R, head = rotations[:, index], heads[:, index]
        shift = head - (R @ head[..., None])[..., 0]
        if parent >= 0:
            shift = (world[parent] @ shift[..., None])[..., 0] + offset[parent]
            R = world[parent] @ R
        world.append(R)
        offset.append(shift)
    return torch.stack(world, 1), torch.stack(offset, 1)


# Capsules for self-intersection: (start joint, end joint, radius in units of the torso length).
_CAPSULES: tuple[tuple[str, str, float], ...] = (
    ("root", "spine03", 0.24),
    ("spine03", "spine01", 0.23),
    ("spine01", "neck01", 0.16),
    ("neck03", "eye.L", 0.17),
    ("neck03", "eye.R", 0.17),
    *(
        (start + side, end + side, radius)
        for side in (".L", ".R")
        for start, end, radius in (
            ("upperarm02", "lowerarm01", 0.08),
            ("lowerarm01", "wrist", 0.06),
            ("wrist", "finger3-2", 0.05),
            ("upperleg02", "lowerleg01", 0.12),
            ("lowerleg01", "foot", 0.085),
            ("foot", "toe2-1", 0.06),
        )
    ),
)
_NEAR = {"upperarm02": ("spine01",), "upperleg02": ("root",)}


def _capsule_pairs() -> list[tuple[int, int]]:
    pairs = []
    for i, (start_a, end_a, _) in enumerate(_CAPSULES):
        for j, (start_b, end_b, _) in enumerate(_CAPSULES[:i]):
            joined = {start_a, end_a} & {start_b, end_b} or (i < 5 and j < 5)
            girdle = start_b in ("spine03", "spine01") and start_a.startswith("upperarm")
            hips = start_b == "root" and start_a.startswith("upperleg")
            thighs = start_a.startswith("upperleg") and start_b.startswith("upperleg")
            if not (joined or girdle or hips or thighs):
                pairs.append((i, j))
    return pairs


def penetration(rig: Rig, heads: torch.Tensor, world: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """Summed overlap of non-adjacent body capsules, (B,), in units of the torso length."""
    joints = (world @ heads[..., None])[..., 0] + offset
    torso = (heads[:, rig.joint("neck01")] - heads[:, rig.joint("root")]).norm(dim=-1)
    steps = torch.linspace(0, 1, 5)
    start = torch.stack([joints[:, rig.joint(capsule[0])] for capsule in _CAPSULES], 1)
    end = torch.stack([joints[:, rig.joint(capsule[1])] for capsule in _CAPSULES], 1)
    points = start[:, :, None] + (end - start)[:, :, None] * steps[:, None]  # B C 5 3
    pairs = torch.tensor(_capsule_pairs())
    radii = torch.tensor([capsule[2] for capsule in _CAPSULES])
    gap = (points[:, pairs[:, 0], :, None] - points[:, pairs[:, 1], None]).norm(dim=-1).amin((-1, -2))
    touch = 0.85 * (radii[pairs[:, 0]] + radii[pairs[:, 1]])
    return (touch - gap / torso[:, None]).clamp_min(0).sum(-1)


def sample_free_pose(
    rig: Rig, heads: torch.Tensor, generator: torch.Generator, tries: int = 4, tolerance: float = 0.02
) -> tuple[torch.Tensor, torch.Tensor]:
    """Of several drawn poses keep the first that is free of self-intersection, else the least bad.

    Returns the world rotations (B, J, 3, 3) and offsets (B, J, 3) of :func:`forward_kinematics`.
    """
    B = heads.shape[0]
    repeated = heads.repeat(tries, 1, 1)
    world, offset = forward_kinematics(rig, repeated, sample_pose(rig, repeated, generator))
    depth = penetration(rig, repeated, world, offset).view(tries, B)
    order = torch.where(depth < tolerance, torch.arange(tries)[:, None] - 1e3, depth)
    pick = order.argmin(0) * B + torch.arange(B)
    return world[pick], offset[pick]
