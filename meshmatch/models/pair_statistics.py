"""How the fits of two shapes of a kind differ: of one individual in two poses, and of two individuals.

Measured on generated shapes (docs/method.md), and kept beside the weights of a model.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from meshmatch.arrays import Float, Floats
from meshmatch.errors import ModelError
from meshmatch.geometry.symmetric import entries_of, matrices_of
from meshmatch.models.tensor_file import read_header
from meshmatch.outputs import replace_on_success

_MOST = 512  # components
_SURE = 30.0  # natural logarithm of odds beyond which nothing changes
# From where to where a difference ceases to be one that two individuals have, who wear nothing: its mean square against what
# is usual of two, and the median length of its matrices. Of two people of FAUST one in a hundred has more than 1.2 and 0.40,
# generated people in clothes have 1.4 and 0.50 (medians); set by hand.
_CEASES = (1.25, 1.6), (0.40, 0.46)
# So that the length of six entries (xx xy xz yy yz zz) is the Frobenius norm of their matrix.
_FROBENIUS = np.sqrt([[1.0], [2.0], [2.0], [1.0], [2.0], [1.0]])


@dataclass(frozen=True, eq=False)
class PairStatistics:
    """What is usual of the difference of two fits' logarithms of stretch at the G gradient points of a template.

    Attributes
    ----------
    components
        (K, 6 G) orthonormal rows, the largest variation first.
    discriminant
        (L, L) takes the first L components of a difference to numbers that are independent of one another, and have variance
        1 for one individual in two poses.
    ratios
        (L,) their variances for two individuals.
    gains
        (K,) how much of each component of a difference is there in truth; the rest is error of the fits.
    """

    components: Float[Floats, "K D"]
    discriminant: Float[Floats, "L L"]
    ratios: Float[Floats, " L"]
    gains: Float[Floats, " K"]

    def __repr__(self) -> str:
        return f"PairStatistics({len(self.gains)} components, of which {len(self.ratios)} tell individuals)"

    def different(self, apart: Float[Floats, "G 3 3"]) -> float:
        """The chance (0..1) that two fits with such a difference are of two individuals, where both are as likely."""
        seen = self._told(apart)
        odds = 0.5 * float(np.sum(seen**2 * (1 - 1 / self.ratios) - np.log(self.ratios)))
        return float(1 / (1 + np.exp(-np.clip(odds, -_SURE, _SURE))))

    def concern(self, apart: Float[Floats, "G 3 3"]) -> float:
        """How far (0..1) such a difference is of the kind that this is about: 1 for all that individuals have, 0 for the
        clothes of others, or noise."""
        far = np.mean(self._told(apart) ** 2 / self.ratios), np.median(np.linalg.norm(apart, axis=(1, 2)))
        shares = [(high - each) / (high - low) for each, (low, high) in zip(far, _CEASES, strict=True)]
        return float(np.clip(shares, 0, 1).prod())

    def _told(self, apart: Float[Floats, "G 3 3"]) -> Float[Floats, " L"]:
        return np.asarray(self.discriminant @ (self.components[: len(self.ratios)] @ flat(apart)))

    def expected(self, apart: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
        """The true difference that is expected behind a difference of fits (a Wiener filter)."""
        return unflat(self.components.T @ (self.gains * (self.components @ flat(apart))))


def flat(matrices: Float[Floats, "G 3 3"]) -> Float[Floats, " D"]:
    """Symmetric matrices as one vector, whose length is their Frobenius norm."""
    return np.asarray((entries_of(matrices) * _FROBENIUS).reshape(-1))


def unflat(vector: Float[Floats, " D"]) -> Float[Floats, "G 3 3"]:
    """The matrices of `flat`."""
    return matrices_of(vector.reshape(6, -1) / _FROBENIUS)


def save_pair_statistics(found: PairStatistics, path: str | Path, words: dict[str, str]) -> None:
    """Write one safetensors file; components in half precision."""
    arrays = {name: np.ascontiguousarray(value, np.float32) for name, value in vars(found).items()}
    arrays["components"] = arrays["components"].astype(np.float16)
    with replace_on_success(path) as temporary:
        save_file(arrays, temporary, words)


def load_pair_statistics(path: Path) -> PairStatistics:
    """Read a file; `ModelError` if it is damaged, or its arrays cannot be."""
    header = read_header(path)
    try:
        shapes = {name: header[name].shape for name in (each.name for each in fields(PairStatistics))}
        K, D = shapes["components"]
        (L,) = shapes["ratios"]
        if not (0 < L <= K <= _MOST and D > 0 and D % 6 == 0 and len(header) == len(shapes)):
            raise ValueError("sizes")
        if shapes["discriminant"] != (L, L) or shapes["gains"] != (K,):
            raise ValueError("shapes")
        arrays = {name: array.astype(np.float64) for name, array in load_file(path).items()}
        if not (all(np.isfinite(array).all() for array in arrays.values()) and arrays["ratios"].min() > 0):
            raise ValueError("numbers")
    except (SafetensorError, OSError, LookupError, ValueError) as error:
        raise ModelError(f"{path} holds no statistics of pairs", "fetch or add the model again") from error
    return PairStatistics(**arrays)
