"""Known pairs judge the map that was pulled by them."""

import numpy as np
import pytest

from meshmatch.maps.build import judge_by_pairs
from meshmatch.maps.vertex_map import VertexMap
from tests.maps.solids import bumpy_sphere


def test_a_missed_pair_is_a_reason_against_the_map() -> None:
    """Of the map of a ball to itself; lengths are halved by a unit of 2."""
    ball = bumpy_sphere()
    right = VertexMap.identity(ball)
    some = np.array([3, 40, 77])
    assert judge_by_pairs(right, ball, (some, some), 1.0) is right
    apart = np.linalg.norm(ball.verts - ball.verts[3], axis=1)
    near, far = int(np.abs(apart - 0.1).argmin()), int(np.abs(apart - 0.5).argmin())
    for vertex, verdict in ((near, "fair"), (far, "poor")):
        found = judge_by_pairs(right, ball, (some, np.array([vertex, 40, 77])), 2.0)
        (reason,) = found.reasons
        assert found.verdict == verdict and np.array_equal(found.index, right.index)
        assert reason == f"the known pair 3, {vertex} is missed by {100 * apart[vertex] / 2:.0f} % of sqrt(area)"


@pytest.mark.parametrize("verdict", ["fair", "poor"])
def test_pairs_that_are_met_make_no_map_better(verdict: str) -> None:
    ball = bumpy_sphere()
    doubtful = VertexMap.between(ball, ball, np.arange(ball.V), verdict=verdict, reasons=("ball: small",))
    one = np.array([5])
    assert judge_by_pairs(doubtful, ball, (one, one), 1.0) is doubtful
    far = np.array([int(np.linalg.norm(ball.verts - ball.verts[5], axis=1).argmax())])
    missed = judge_by_pairs(doubtful, ball, (one, far), 1.0)
    assert missed.verdict == "poor" and missed.reasons[1:] == ("ball: small",) and len(missed.reasons) == 2
