"""Parts go to their counterparts: strings of beads, whose fits disagree by a third of a bead."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.maps.build import build_map
from meshmatch.maps.parts import match_parts
from meshmatch.maps.places import Places
from tests.conftest import icosphere

BALL = icosphere(2)


def beads(*lengths: float, shift: float = 0.0, dropped: int = 0, name: str = "beads") -> tuple[Places, np.ndarray]:
    """Ellipsoids end to end along x, moved along it as a fit may slide, and the bead of each vertex.

    Of the last bead so many faces were not fitted.
    """
    starts = np.cumsum([0.0, *lengths])
    verts = [
        BALL.verts * [0.5 * length, 0.3, 0.3] + [start + 0.5 * length + shift, 0, 0]
        for start, length in zip(starts[:-1], lengths, strict=True)
    ]
    resting = np.concatenate(verts).astype(np.float32)
    faces = np.concatenate([BALL.faces + k * BALL.V for k in range(len(lengths))]).astype(np.int32)
    V, F = len(resting), len(faces)
    own = {"resting": resting, "height": np.zeros(V, np.float32), "distance": np.zeros(V, np.float32)}
    own |= {"stands": np.arange(V, dtype=np.int32), "faces": faces, "fitted": np.arange(F) < F - dropped}
    words = {"name": name, "hash": name, "template_hash": "t", "verdict": "good"}
    places = Places(**words, **own, moved=None, spread=None)
    return places, np.repeat(np.arange(len(lengths)), BALL.V)


def test_a_part_does_not_leave_its_counterpart() -> None:
    (source, own), (target, theirs) = beads(1, 1, 1, 1, 1), beads(1, 1, 1, 1, 1, shift=0.3)
    alone = target.nearest(source.resting)
    assert 0.1 < (theirs[alone.vertex] != own).mean() < 0.4  # what the fits say
    found = build_map(source, target)
    assert (theirs[found.index] == own).all()
    stayed = theirs[alone.vertex] == own
    assert (found.index[stayed] == alone.vertex[stayed]).all()
    assert (target.faces[found.face] // BALL.V == own[:, None]).all()


def test_a_long_part_goes_to_all_that_are_together_as_long() -> None:
    """The first part is as long as two of the target's, and goes to both; each of the two goes back to it."""
    (source, own), (target, theirs) = beads(2, 1, 1, 1), beads(1, 1, 1, 1, 1)
    there = theirs[build_map(source, target).index]
    assert set(there[own == 0]) == {0, 1}
    assert [set(there[own == k]) for k in (1, 2, 3)] == [{2}, {3}, {4}]
    back = own[build_map(target, source).index]
    assert [set(back[theirs == k]) for k in range(5)] == [{0}, {0}, {1}, {2}, {3}]


@pytest.mark.parametrize("lengths", [(5,), (2, 2), (9, 0.3, 0.3, 0.3, 0.3)])
def test_one_skin_with_little_beside_it_has_no_parts(lengths: tuple[float, ...]) -> None:
    """Eyes and teeth do not make a body one that is put together: its map stays as the fits say."""
    whole, built = beads(*lengths)[0], beads(1, 1, 1, 1, 1, shift=0.3)[0]
    for source, target in ((whole, built), (built, whole)):
        alone = target.nearest(source.resting)
        assert match_parts(source, target, alone) is alone


def test_parts_that_were_not_fitted_are_no_counterparts() -> None:
    (source, own), (target, theirs) = beads(1, 1, 1, 1, 1), beads(1, 1, 1, 1, 1, shift=0.3, dropped=BALL.F)
    found = build_map(source, target)
    assert (theirs[found.index[own < 4]] == own[own < 4]).all()
    assert not (theirs[found.index] == 4).any()
    assert target.fitted[found.face].all()


def test_a_cloud_has_no_parts() -> None:
    built, own = beads(1, 1, 1, 1, 1)
    cloud = replace(built, faces=np.zeros((0, 3), np.int32), fitted=np.zeros(0, bool))
    assert len(build_map(cloud, built).index) == len(build_map(built, cloud).index) == len(own)
