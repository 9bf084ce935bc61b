"""Expressions of a generated head on another, of which the truth is known."""

import numpy as np
import pytest
import torch

import meshmatch
from meshmatch.arrays import Floats
from meshmatch.generators import heads
from meshmatch.generators.bodies import draw_identities
from meshmatch.generators.cutouts import MeanBody, region_rig
from meshmatch.generators.rig import forward_kinematics, skin
from meshmatch.generators.rotations import DEGREE, rotation_from_vector
from meshmatch.shapes.blend_shapes import BlendShapes
from meshmatch.shapes.shape import Shape


def expressions(people: int) -> tuple[Floats, Floats, Floats, tuple[str, ...]]:
    """Heads (N, V, 3), the first of which looks straight ahead, faces, moves (N, K, V, 3), and names."""
    body = MeanBody.load()
    inside = np.flatnonzero((body.verts[:, 1] > 0.42) & (np.abs(body.verts[:, 0]) < 0.2))
    rig = region_rig(heads._REGION, inside, 8, 3)
    draw = torch.Generator().manual_seed(5)
    rest, joints = draw_identities(rig, people, draw)
    apart = float(np.linalg.norm(body.joint("eye.L") - body.joint("eye.R")))
    size = (joints[:, rig.joint("eye.L")] - joints[:, rig.joint("eye.R")]).norm(dim=1) / apart
    turns = heads.draw_turns(people, draw) * DEGREE
    turns[0] = 0
    vectors = torch.zeros(people, len(rig.names), 3)
    for name, share in heads._NECK.items():
        vectors[:, rig.joint(name)] = share * turns
    pose = forward_kinematics(rig, joints, rotation_from_vector(vectors))
    base = skin(rig, rest, *pose).double().numpy()
    moves = body.expressions[:, torch.from_numpy(inside)]
    shaped = [skin(rig, rest + size[:, None, None] * move, *pose).double().numpy() - base for move in moves]
    return base, rig.faces.numpy(), np.stack(shaped, axis=1), body.expression_names


@pytest.mark.slow
def test_expressions_of_another_head() -> None:
    base, faces, moves, names = expressions(6)
    # other corners first: two meshes with the same faces would not be matched
    a, b = Shape(base[0], faces, "head 0"), Shape(base[5], np.roll(faces, 1, axis=1), "head 5")
    result = meshmatch.transfer_shapes(
        a, b, shapes=BlendShapes(names, moves[0].astype(np.float32), np.zeros(len(names)))
    )
    assert result.maps.forward.verdict == "good"
    error, size = (np.linalg.norm(each, axis=2) for each in (result.shapes.moves - moves[5], moves[5]))
    moved = size > 5e-4
    mean, usual, most = 1000 * error[moved].mean(), 1000 * size[moved].mean(), 1000 * np.quantile(error[moved], 0.95)
    print(f"{mean:.2f} mm of {usual:.2f} mm, 95 % {most:.2f} mm")
    assert error[moved].mean() < 0.13 * size[moved].mean()
    assert error[~moved].mean() < 5e-5
    assert error.max() < 0.015
