"""Functions of symmetric matrices, against eigenvectors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.geometry.symmetric import eigenvalues, exponential, logarithm, to_entries, to_matrices

TURNS = Rotation.random(200, random_state=np.random.default_rng(0)).as_matrix()
LEAST = 1e-6


def turned(*values: float) -> np.ndarray:
    """Matrices with these eigenvalues."""
    return TURNS @ np.diag(values) @ TURNS.transpose(0, 2, 1)


@pytest.mark.parametrize(
    "values", [(3.0, 1.0, 0.2), (2.0, 2.0, 1.0), (2.0, 1.0, 1.0), (1.0, 1.0, 1.0), (1.0 + 1e-9, 1.0, 1.0 - 1e-12)]
)
def test_logarithm_and_exponential_of_known_eigenvalues(values: tuple[float, ...]) -> None:
    S = to_entries(turned(*values))
    assert np.allclose(eigenvalues(S), np.array(values)[:, None], rtol=0, atol=1e-7)
    for found, function in ((logarithm(S, LEAST), np.log), (exponential(S), np.exp)):
        assert np.allclose(to_matrices(found), turned(*function(values)), rtol=0, atol=1e-13 * np.exp(3))
    assert np.allclose(exponential(logarithm(S, LEAST)), S, rtol=0, atol=1e-13)


def test_what_is_flat_counts_as_least() -> None:
    S = np.concatenate([to_entries(turned(2.0, 1.0, 0.0))[:, :3], to_entries(turned(2.0, 1.0, 0.5))[:, 3:]], 1)
    found = to_matrices(logarithm(S, LEAST))
    assert np.allclose(found[:3], turned(np.log(2), 0, np.log(LEAST))[:3], rtol=0, atol=1e-8)
    assert np.allclose(found[3:], turned(np.log(2), 0, np.log(0.5))[3:])
    assert np.allclose(to_matrices(logarithm(np.zeros((6, 2)), LEAST)), np.log(LEAST) * np.eye(3))
