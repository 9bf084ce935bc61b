"""Statistics of the difference between fits of two shapes: of one individual in two poses, or of two individuals.

Measured on generated shapes (docs/method.md), and stored with the weights of a model.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from meshmatch.arrays import Float, Floats
from meshmatch.errors import ModelError
from meshmatch.geometry.symmetric import to_entries, to_matrices
from meshmatch.models.tensor_file import read_header
from meshmatch.outputs import replace_on_success

_MAX_COMPONENTS = 512  # maximum number of principal components in a file
_MAX_LOG_ODDS = 30.0  # bound on the natural logarithm of odds
# Ranges over which `PairStatistics.concern` falls from 1 to 0, because two unclothed individuals do not differ as much: mean
# square of a difference relative to that of two individuals, and median norm of its matrices. Among pairs of people of FAUST
# one in a hundred exceeds 1.2 and 0.40; generated people in clothes have 1.4 and 0.50 (medians). Set by hand.
_CONCERN_RANGES = (1.25, 1.6), (0.40, 0.46)
# Scales six entries (xx xy xz yy yz zz) so that the length of the vector is the Frobenius norm of the matrix.
_ENTRY_SCALES = np.sqrt([[1.0], [2.0], [2.0], [1.0], [2.0], [1.0]])


@dataclass(frozen=True, eq=False)
class PairStatistics:
    """Statistics of the difference between two fits' log stretch tensors at the G gradient points of a template.

    Attributes
    ----------
    components
        (K, 6 G) orthonormal principal components, the largest variation first.
    discriminant
        (L, L) maps the first L components of a difference to independent numbers with variance 1 for one individual in two
        poses.
    ratios
        (L,) variances of these numbers for two individuals.
    gains
        (K,) share of each component of a difference that is true; the rest is error of the fits.
    """

    components: Float[Floats, "K D"]
    discriminant: Float[Floats, "L L"]
    ratios: Float[Floats, " L"]
    gains: Float[Floats, " K"]

    def __repr__(self) -> str:
        return f"PairStatistics({len(self.gains)} components, of which {len(self.ratios)} tell individuals)"

    def different(self, apart: Float[Floats, "G 3 3"]) -> float:
        """Probability (0..1) that two fits with this difference are of two individuals, with equal priors."""
        discriminants = self._discriminants(apart)
        odds = 0.5 * float(np.sum(discriminants**2 * (1 - 1 / self.ratios) - np.log(self.ratios)))
        return float(1 / (1 + np.exp(-np.clip(odds, -_MAX_LOG_ODDS, _MAX_LOG_ODDS))))

    def concern(self, apart: Float[Floats, "G 3 3"]) -> float:
        """Degree (0..1) to which the statistics apply to a difference: 1 within the range of unclothed individuals, 0 for
        clothing or noise.
        """
        deviations = (
            np.mean(self._discriminants(apart) ** 2 / self.ratios),
            np.median(np.linalg.norm(apart, axis=(1, 2))),
        )
        shares = [(high - each) / (high - low) for each, (low, high) in zip(deviations, _CONCERN_RANGES, strict=True)]
        return float(np.clip(shares, 0, 1).prod())

    def _discriminants(self, apart: Float[Floats, "G 3 3"]) -> Float[Floats, " L"]:
        return np.asarray(self.discriminant @ (self.components[: len(self.ratios)] @ flat(apart)))

    def expected(self, apart: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
        """Expected true difference, given the difference between two fits (a Wiener filter)."""
        return unflat(self.components.T @ (self.gains * (self.components @ flat(apart))))


def flat(matrices: Float[Floats, "G 3 3"]) -> Float[Floats, " D"]:
    """Flatten symmetric matrices into one vector, whose length is their Frobenius norm."""
    return np.asarray((to_entries(matrices) * _ENTRY_SCALES).reshape(-1))


def unflat(vector: Float[Floats, " D"]) -> Float[Floats, "G 3 3"]:
    """Inverse of `flat`."""
    return to_matrices(vector.reshape(6, -1) / _ENTRY_SCALES)


def save_pair_statistics(found: PairStatistics, path: str | Path, words: dict[str, str]) -> None:
    """Write one safetensors file with metadata ``words``; components are stored in half precision."""
    arrays = {name: np.ascontiguousarray(value, np.float32) for name, value in vars(found).items()}
    arrays["components"] = arrays["components"].astype(np.float16)
    with replace_on_success(path) as temporary:
        save_file(arrays, temporary, words)


def load_pair_statistics(path: Path) -> PairStatistics:
    """Read a file; `ModelError` if it is damaged, or its arrays are invalid."""
    header = read_header(path)
    try:
        shapes = {name: header[name].shape for name in (each.name for each in fields(PairStatistics))}
        K, D = shapes["components"]
        (L,) = shapes["ratios"]
        if not (0 < L <= K <= _MAX_COMPONENTS and D > 0 and D % 6 == 0 and len(header) == len(shapes)):
            raise ValueError("sizes")
        if shapes["discriminant"] != (L, L) or shapes["gains"] != (K,):
            raise ValueError("shapes")
        arrays = {name: array.astype(np.float64) for name, array in load_file(path).items()}
        if not (all(np.isfinite(array).all() for array in arrays.values()) and arrays["ratios"].min() > 0):
            raise ValueError("numbers")
    except (SafetensorError, OSError, LookupError, ValueError) as error:
        raise ModelError(f"{path} holds no statistics of pairs", "fetch or add the model again") from error
    return PairStatistics(**arrays)
