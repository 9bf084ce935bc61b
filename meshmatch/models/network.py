"""Configuration of deformation networks, the shapes of their weights, and the interface that fitting uses (`Network`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal, Protocol

from meshmatch.arrays import Float, Floats, Floats32
from meshmatch.errors import MeshmatchError, ModelError
from meshmatch.fields.shape_functions import FIELDS, FieldName, has_nodes

POINT_SIZES = (128, 128, 256, 512, 1024)  # widths of the layers of `models.layers.PointEncoder`
_MAX_SIZES = {
    "code": 4096, "width": 8192, "depth": 64, "basis": 8192,
    "align_basis": 8192, "align_width": 8192, "corrections": 64, "correct_width": 8192,
}  # fmt: skip
_POSITIVE = ("code", "width")  # options that must be at least 1


@dataclass(frozen=True)
class NetworkConfig:
    """Architecture of a deformer; stored on the model card (cards without ``field`` use moving least squares).

    The defaults were chosen on generated bodies (docs/paper.md).

    Attributes
    ----------
    encoder
        "basis" (basis point set), "point" (the paper's), or a custom class (docs/training.md), which is called with basis
        points (M, 3) and the length of a code, see `models.layers.Encoder`.
    decoder
        "flat" (one MLP for all nodes) or "node" (the paper's); a pointwise field has its own decoder.
    code
        Length of a code.
    width, depth
        Width of the basis encoder and of the decoder, and number of residual blocks of the basis encoder.
    basis
        Number of basis points of the encoder.
    align_basis, align_width
        Number of basis points and width of the aligner; without basis points there is no aligner.
    corrections, correct_width
        Number of learned registration steps, and width of their network.
    field
        "mls" (moving least squares), "rbf" (radial basis functions) or "pointwise".
    """

    encoder: Literal["basis", "point"] | type = "basis"
    decoder: Literal["flat", "node"] = "flat"
    code: int = 512
    width: int = 768
    depth: int = 2
    basis: int = 768
    align_basis: int = 512
    align_width: int = 512
    corrections: int = 3
    correct_width: int = 640
    field: FieldName = "mls"

    def __post_init__(self) -> None:
        # Cards are untrusted: bound the memory that building the network takes.
        if not isinstance(self.encoder, str):
            _check_class(self.encoder)
        known = isinstance(self.encoder, type) or self.encoder in ("basis", "point")
        if not known or self.decoder not in ("flat", "node"):
            raise ModelError(f"unknown network: encoder {self.encoder!r}, decoder {self.decoder!r}", "update meshmatch")
        if self.field not in FIELDS:
            raise ModelError(f"unknown field {self.field!r}, only {', '.join(FIELDS)}", "update meshmatch")
        for name, limit in _MAX_SIZES.items():
            value = getattr(self, name)
            least = 1 if name in _POSITIVE else 0
            if type(value) is not int or not least <= value <= limit:
                raise ModelError(f"network option {name} must be an integer from {least} to {limit}, not {value!r}")

    @property
    def in_torch(self) -> bool:
        """Whether only torch can evaluate it, because it has no nodes or a custom encoder."""
        return not has_nodes(self.field) or isinstance(self.encoder, type)

    @staticmethod
    def from_dict(values: dict[str, Any], encoder: type | None = None) -> NetworkConfig:
        """Parse the config on a card; ``encoder`` is the class that the card names, if the model has a custom encoder."""
        known = NetworkConfig.__dataclass_fields__
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ModelError(f"unknown network options: {', '.join(unknown)}", "update meshmatch")
        named = values.get("encoder", "basis")
        if isinstance(named, str) and "." in named:
            if encoder is None:
                hint = "load it in Python: meshmatch.load_model(..., encoder=THE_CLASS)"
                raise ModelError(f"the model has a custom encoder, {named[:80]!r}", hint)
            _check_class(encoder)
            if encoder.__name__ != named.rpartition(".")[2]:  # its module may have been another, or __main__, then
                raise ModelError(f"the model's encoder is {named[:80]!r}, not {_class_name(encoder)!r}")
            values = values | {"encoder": encoder}
        elif encoder is not None:
            raise ModelError(f"the model has the built-in encoder {named!r}", "leave out encoder=")
        return NetworkConfig(**values)

    def to_dict(self) -> dict[str, Any]:
        own = {"encoder": _class_name(self.encoder)} if isinstance(self.encoder, type) else {}
        return asdict(self) | own


def _check_class(encoder: object) -> None:
    """Raise `ModelError` unless ``encoder`` is a class with the methods of an encoder."""
    if not isinstance(encoder, type) or not all(
        callable(getattr(encoder, name, None)) for name in ("features", "forward")
    ):
        what = f"a custom encoder must be a class with features and forward, not {repr(encoder)[:80]}"
        raise ModelError(what, "derive one from meshmatch.models.layers.Encoder, and give the class itself")


@contextmanager
def encoder_errors(encoder: str | type) -> Iterator[None]:
    """Convert exceptions from a custom encoder inside the block to a `ModelError` that names the class."""
    try:
        yield
    except MeshmatchError:
        raise
    except Exception as error:
        if not isinstance(encoder, type):
            raise
        what = f"the encoder {_class_name(encoder)} fails: {type(error).__name__}: {error}"
        raise ModelError(what, "the error above says where") from error


def _class_name(encoder: type) -> str:
    return f"{encoder.__module__}.{encoder.__qualname__}"


PAPER = NetworkConfig(encoder="point", decoder="node", width=1024, align_basis=0, corrections=0)


class Network(Protocol):
    """Interface of a network for fitting. Rows are node vectors, or contain a code if the field is pointwise."""

    @property
    def config(self) -> NetworkConfig: ...

    @property
    def align_basis(self) -> Float[Floats32, "M 3"]:
        """Basis points of the aligner."""

    def predict(self, clouds: Sequence[Float[Floats, "P 3"]]) -> Float[Floats, "B R 3"]:
        """Predict rows for several clouds in their core frames, each with any number of points."""

    def read_frames(self, offsets: Float[Floats32, "B M 3"]) -> tuple[Float[Floats, "B 3 3"], Float[Floats, "B 3"]]:
        """Predict rotations R and centers t of the core, scan = R core + t.

        ``offsets`` are those from the basis points of the aligner to the nearest points of the scan.
        """

    def encode(self, cloud: Float[Floats, "P 3"]) -> Float[Floats, " D"]:
        """Encode a cloud in its core frame."""

    def decode(self, code: Float[Floats, " D"]) -> Float[Floats, "R 3"]:
        """Decode a code to rows, without corrections."""

    def rotate_rows(self, rows: Float[Floats, "R 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "R 3"]:
        """Rows of the deformation followed by a rotation: its moved points (row vectors) are those of ``rows`` @ turn."""


def weight_shapes(config: NetworkConfig, K: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the weights and buffers of a network with K nodes, by name; not for networks that need torch."""
    found: dict[str, tuple[int, ...]] = {"nodes": (K, 3), "anchors": (K, 3), "anchor_phi": (K, K)}

    def linear(name: str, inputs: int, outputs: int) -> None:
        found.update({f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)})

    def norm(name: str, width: int) -> None:
        found.update({f"{name}.weight": (width,), f"{name}.bias": (width,)})

    def batch_norm(name: str, width: int) -> None:
        norm(name, width)
        found.update({f"{name}.running_mean": (width,), f"{name}.running_var": (width,)})
        found[f"{name}.num_batches_tracked"] = ()

    def residual_mlp(name: str, inputs: int, width: int, depth: int, outputs: int) -> None:
        linear(f"{name}.0", inputs, width)
        for block in range(1, depth + 1):
            norm(f"{name}.{block}.norm", width)
            linear(f"{name}.{block}.widen", width, width)
            linear(f"{name}.{block}.narrow", width, width)
        norm(f"{name}.{depth + 1}", width)
        linear(f"{name}.{depth + 3}", width, outputs)

    code, width = config.code, config.width
    if config.encoder == "basis":
        found["encoder.basis"] = (config.basis, 3)
        residual_mlp("encoder.network", 3 * config.basis, width, config.depth, code)
    else:
        found["encoder.frequencies"] = (POINT_SIZES[0] // 2, 3)
        for number, (inputs, outputs) in enumerate(pairwise(POINT_SIZES)):
            linear(f"encoder.points.{3 * number}", inputs, outputs)
            batch_norm(f"encoder.points.{3 * number + 1}", outputs)
        linear("encoder.head.0", 1024, 1024)
        linear("encoder.head.3", 1024, code)
    if config.decoder == "flat":
        residual_mlp("decoder.network", code, width, 1, 3 * K)
    else:
        found["decoder.nodes"] = (K, 3)
        linear("decoder.from_code", code, width)
        found["decoder.from_node.weight"] = (width, 3)
        batch_norm("decoder.network.0", width)
        for layer, inputs in ((2, width), (5, width // 2)):
            linear(f"decoder.network.{layer}", inputs, inputs // 2)
            batch_norm(f"decoder.network.{layer + 1}", inputs // 2)
        linear("decoder.network.8", width // 4, 3)
    if config.align_basis:
        found["aligner.basis"] = (config.align_basis, 3)
        residual_mlp("aligner.network", 3 * config.align_basis, config.align_width, 2, 9)
    if config.corrections:
        residual_mlp("corrector", 10 * K, config.correct_width, 1, 3 * K)
    return found
