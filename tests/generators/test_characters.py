"""Characters: proportions by hand on a stick figure, clothes that go outwards, skirts around legs, and seeds."""

from dataclasses import replace

import pytest
import torch

from meshmatch.errors import OptionError
from meshmatch.generators.bodies import Bodies, sample_bodies
from meshmatch.generators.characters import CharacterConfig, sample_characters, sample_layers, sample_rest_poses
from meshmatch.generators.clothes import add_clothes, add_skirts
from meshmatch.generators.figure import PARTS, Figure, joints_of, part
from meshmatch.generators.proportions import (
    BUILT,
    CHILD,
    PLAIN,
    SHARES,
    STYLISED,
    TOON,
    Style,
    draw_style,
    round_parts,
    scale_bones,
    shares_with_stylised,
)
from meshmatch.generators.rig import Rig, forward_kinematics
from tests.generators.stick import seeded, stick_figure


@pytest.fixture(scope="module")
def figure() -> Figure:
    return Figure.of(stick_figure(3))


def resting(figure: Figure, B: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    rig = figure.rig
    return rig.rest[1:2].float().repeat(B, 1, 1), rig.heads[1:2].repeat(B, 1, 1)


def rows_of(figure: Figure, name: str) -> torch.Tensor:
    return torch.nonzero(figure.share[:, PARTS.index(name)] > 0.5)[:, 0]


def joint(figure: Figure, name: str) -> int:
    return figure.rig.joint(name)


# the figure


def test_every_vertex_belongs_to_parts_and_reach_runs_down_the_limbs(figure: Figure) -> None:
    assert torch.allclose(figure.share.sum(1), torch.ones(len(figure.share)))
    arm = [float(figure.reach[rows_of(figure, f"{name} L"), 0].mean()) for name in ("upper arm", "forearm", "hand")]
    leg = [float(figure.reach[rows_of(figure, f"{name} R"), 1].mean()) for name in ("thigh", "shin", "foot")]
    for values in (arm, leg):
        assert 0 <= values[0] < 1 <= values[1] < 2 <= values[2]
    assert (figure.reach[rows_of(figure, "head")] == -1).all()
    assert figure.height[rows_of(figure, "head")].min() > 1


def test_axes_are_right_handed_and_along_the_bones(figure: Figure) -> None:
    _, heads = resting(figure, 1)
    axes = figure.axes(heads)[0]
    assert torch.allclose(axes @ axes.transpose(1, 2), torch.eye(3).expand(len(PARTS), 3, 3), atol=1e-5)
    start, end = joints_of(figure.rig, "shin", "L")
    along = torch.nn.functional.normalize(heads[0, end] - heads[0, start], dim=0)
    assert torch.allclose(axes[part("shin", "L"), 1], along, atol=1e-5)
    assert torch.allclose(torch.linalg.det(axes), torch.ones(len(PARTS)), atol=1e-4)


# proportions


def test_sizes_of_one_change_nothing(figure: Figure) -> None:
    rest, heads = resting(figure)
    plain = Style(torch.zeros(2, dtype=torch.long), torch.ones(2, len(PARTS), 3))
    verts, joints = scale_bones(figure, rest, heads, plain)
    assert torch.allclose(verts, rest, atol=1e-5)
    assert torch.allclose(joints, heads, atol=1e-5)


def test_a_longer_thigh_lowers_what_hangs_on_it_and_a_larger_head_stays_in_place(figure: Figure) -> None:
    rest, heads = resting(figure, 1)
    sizes = torch.ones(1, len(PARTS), 3)
    sizes[:, [part("thigh", "L"), part("thigh", "R")], 1] = 1.5
    sizes[:, part("head")] = 2.0
    verts, joints = scale_bones(figure, rest, heads, Style(torch.zeros(1, dtype=torch.long), sizes))
    for side in ("L", "R"):
        hip, knee, foot = (joint(figure, f"{name}.{side}") for name in ("upperleg01", "lowerleg01", "foot"))
        before, after = heads[0, knee] - heads[0, hip], joints[0, knee] - joints[0, hip]
        assert float(after.norm() / before.norm()) == pytest.approx(1.5, abs=0.03)
        assert torch.allclose(joints[0, foot] - joints[0, knee], heads[0, foot] - heads[0, knee], atol=1e-5)
    assert torch.allclose(joints[0, joint(figure, "head")], heads[0, joint(figure, "head")], atol=1e-5)
    own = rows_of(figure, "head")
    spread = [float((x[0, own] - x[0, own].mean(0)).norm()) for x in (rest, verts)]
    assert spread[1] / spread[0] == pytest.approx(2, rel=1e-4)


def test_styles_are_alike_on_both_sides_and_stylised_heads_are_large() -> None:
    style = draw_style(600, seeded(), (0.2,) * 5)
    for name in ("hand", "thigh", "foot"):
        assert torch.equal(style.sizes[:, part(name, "L")], style.sizes[:, part(name, "R")])
    heads = style.sizes[:, part("head")].mean(1)
    means = [float(heads[style.kind == kind].mean()) for kind in (PLAIN, CHILD, TOON)]
    assert means[0] == 1
    assert 1.1 < means[1] < means[2]
    shares = torch.bincount(draw_style(20_000, seeded(1)).kind, minlength=5) / 20_000
    assert torch.allclose(shares, torch.tensor(SHARES), atol=0.02)


def test_rounded_parts_lie_nearer_to_balls(figure: Figure) -> None:
    rest, heads = resting(figure, 64)
    own = rows_of(figure, "hand L")
    moved = round_parts(figure, rest, heads, torch.full((64,), BUILT), seeded())

    def roundness(verts: torch.Tensor) -> torch.Tensor:
        radius = (verts[:, own] - verts[:, own].mean(1, keepdim=True)).norm(dim=-1)
        return radius.std(1) / radius.mean(1)

    assert torch.isfinite(moved).all()
    assert roundness(moved).mean() < 0.8 * roundness(rest).mean()


def test_solids_are_wide_or_narrow_deep_or_flat(figure: Figure) -> None:
    rest, heads = resting(figure, 64)
    own = rows_of(figure, "chest")

    def variety(verts: torch.Tensor) -> float:
        width, depth = verts[:, own, 0].std(1), verts[:, own, 2].std(1)
        return float((width / depth).log().std())

    built, plain = (round_parts(figure, rest, heads, torch.full((64,), kind), seeded()) for kind in (BUILT, PLAIN))
    assert variety(built) > 0.12 > 3 * variety(plain)


# clothes


def test_clothes_are_worn_outside(figure: Figure) -> None:
    rest, heads = resting(figure, 32)
    clothed = add_clothes(figure, rest, heads, seeded())
    assert torch.isfinite(clothed).all()
    own = rows_of(figure, "shin L")  # small closed pieces: outside is away from their middles
    pieces = [x[:, own].unflatten(1, (-1, 4)) for x in (rest, clothed)]
    sizes = [(each - each.mean(2, keepdim=True)).norm(dim=-1).mean((1, 2)) for each in pieces]
    assert (sizes[1] > 1.2 * sizes[0]).float().mean() > 0.15
    middles = [each.mean(2) for each in pieces]
    assert torch.allclose(middles[0], middles[1], atol=0.05)


def legs(spread: float) -> tuple[Figure, torch.Tensor, torch.Tensor]:
    """A figure whose thighs carry rings of vertices around the middle of the thigh, and its joints, legs spread so far."""
    rig: Rig = stick_figure(2)
    heads = rig.heads[:1].repeat(16, 1, 1)
    angle = torch.arange(24) * (2 * torch.pi / 24)
    rings, weights = [], []
    for side in ("L", "R"):
        hip, knee = (rig.joint(f"{name}.{side}") for name in ("upperleg01", "lowerleg01"))
        away = spread if side == "L" else -spread
        heads[:, knee : knee + 1] += torch.tensor([away, 0.0, 0.0])
        middle = 0.5 * (rig.heads[0, hip] + rig.heads[0, knee])
        rings.append(middle + 0.06 * torch.stack([angle.cos(), 0 * angle, angle.sin()], 1))
        weights.append(torch.eye(len(rig.names))[hip].expand(24, -1))
    rest = torch.cat([rig.rest[:1].float(), torch.cat(rings)[None]], 1)
    faces = torch.stack([torch.arange(22) + k for k in range(3)], 1) + rig.rest.shape[1]
    wider = replace(
        rig, rest=rest.half(), heads=rig.heads[:1], weights=torch.cat([rig.weights, *weights]),
        faces=torch.cat([rig.faces, faces, faces + 24]),
    )  # fmt: skip
    return Figure.of(wider), rest.repeat(16, 1, 1), heads


def test_skirts_close_between_legs_that_are_together_and_leave_a_split_alone() -> None:
    figure, verts, joints = legs(0.0)
    heads = figure.rig.heads.repeat(16, 1, 1)
    moved = add_skirts(figure, verts, heads, joints, seeded())
    ring = slice(-48, -24)  # around the left thigh, at x > 0
    before, after = verts[:, ring], moved[:, ring]
    front = before[..., 2] > before[..., 2].mean(1, keepdim=True) + 0.02
    inside = before[..., 0] < before[..., 0].mean(1, keepdim=True)
    bridged = front & inside  # what faces the other leg, in front, goes towards the middle and not back
    assert after[..., 0][bridged].mean() < before[..., 0][bridged].mean() - 0.005
    assert after[..., 2][bridged].mean() > before[..., 2][bridged].mean()
    outer = before[..., 0] > before[..., 0].mean(1, keepdim=True) + 0.03
    assert after[..., 0][outer].mean() > before[..., 0][outer].mean()
    others = torch.ones(verts.shape[1], dtype=torch.bool)
    for name in ("thigh L", "thigh R", "shin L", "shin R", "foot L", "foot R"):
        others[rows_of(figure, name)] = False
    assert torch.equal(moved[:, others], verts[:, others])
    figure, verts, joints = legs(0.6)
    assert torch.equal(add_skirts(figure, verts, heads, joints, seeded()), verts)


# people


def test_people_are_a_function_of_the_seed_and_of_the_share(figure: Figure) -> None:
    cast = CharacterConfig(figure, 0.5)
    first, again = (sample_characters(cast, 12, seeded(3)) for _ in range(2))
    assert torch.equal(first, again)
    assert torch.isfinite(first).all()
    assert not torch.equal(first, sample_characters(cast, 12, seeded(4)))
    none = sample_characters(CharacterConfig(figure, 0.0), 6, seeded(3))
    assert none.shape == sample_bodies(figure.rig, 6, seeded(3)).shape
    clothed, naked = sample_layers(CharacterConfig(figure, 1.0, style_shares=(1.0, 0, 0, 0, 0)), 12, seeded(3))
    assert not torch.equal(clothed, naked)
    clothed, naked = sample_layers(CharacterConfig(figure, 0.0), 12, seeded(3))
    assert torch.equal(clothed, naked)


def test_more_are_stylised_and_the_others_as_they_were_to_each_other() -> None:
    assert shares_with_stylised(STYLISED) == SHARES
    shares = shares_with_stylised(0.4)
    assert shares[TOON] == 0.4 and sum(shares) == pytest.approx(1)
    assert [each / shares[PLAIN] for each in shares[1:TOON]] == pytest.approx(
        [each / SHARES[PLAIN] for each in SHARES[1:TOON]]
    )
    kind = draw_style(4000, seeded(), shares).kind
    assert float((kind == TOON).float().mean()) == pytest.approx(0.4, abs=0.03)


def test_modellers_poses_have_legs_down_and_arms_between_hanging_and_level(figure: Figure) -> None:
    _, heads = resting(figure, 100)
    world, offset = forward_kinematics(figure.rig, heads, sample_rest_poses(figure.rig, heads, seeded()))
    joints = (world @ heads[..., None])[..., 0] + offset
    hip, foot, shoulder, wrist = (
        joints[:, joint(figure, name)] for name in ("upperleg01.L", "foot.L", "upperarm01.L", "wrist.L")
    )
    down = torch.nn.functional.normalize(foot - hip, dim=1)[:, 1]
    assert (down < -0.8).all()
    level = torch.nn.functional.normalize(wrist - shoulder, dim=1)
    assert (level[:, 1] < 0.5).all()
    assert (level[:, 0] > -0.2).all()


@pytest.mark.parametrize("share", [-0.1, 1.5])
def test_a_share_is_a_share(share: float) -> None:
    with pytest.raises(OptionError, match="share"):
        Bodies(characters=share)
    with pytest.raises(OptionError, match="share"):
        Bodies(stylised=share)
