"""A trained implicit model: its files, its surfaces, and the way between them through the template."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from scipy.ndimage import zoom
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.experiments.implicit_network import Deformation, ImplicitConfig, ImplicitNetwork
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.kernels import KERNELS
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.card import MAX_BYTES
from meshmatch.models.checkpoint import load_weights, save_weights
from meshmatch.models.registry import WEIGHTS
from meshmatch.models.tensor_file import read_header
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.shape import Shape

IMPLICIT = "implicit.json"
_SCHEMA = 1
_AT_ONCE = 8192  # points
_DOUBTED = 0.2  # distance on the template, in the cube, from which a match has no confidence; set by hand
_MOST = {"code": 1024, "width": 2048, "depth": 16, "inner": 512}  # that a card may ask for


@dataclass(frozen=True, eq=False)
class ImplicitModel:
    """A category as one deformed template; ``frames`` lead from the file of each named shape into the cube from -1 to 1."""

    network: ImplicitNetwork
    names: tuple[str, ...]
    frames: tuple[Frame, ...]

    def number(self, name: str) -> int:
        """Which shape of the training has that name; `OptionError` if none has."""
        if name not in self.names:
            some = ", ".join(self.names[:5])
            raise OptionError(f"the model knows no shape {name!r}", f"its {len(self.names)} shapes: {some}, ...")
        return self.names.index(name)

    def between(self, a: str, b: str, time: float) -> tuple[Float[torch.Tensor, " D"], Frame]:
        """Blended code and frame: at time 0 of the shape ``a``, at 1 of ``b``."""
        (first, before), (last, after) = ((self.network.codes[k], self.frames[k]) for k in map(self.number, (a, b)))
        scale = before.scale ** (1 - time) * after.scale**time
        center = (1 - time) * before.center + time * after.center
        return ((1 - time) * first + time * last).detach(), Frame(scale, np.eye(3), center)

    @torch.no_grad()
    def distance(
        self, points: Float[Floats, "P 3"], code: Float[torch.Tensor, " D"]
    ) -> tuple[Float[Floats, " P"], Float[Floats, "P 3"]]:
        """Signed distances of points of the cube, and where each lies on the template."""
        parts = torch.from_numpy(np.array(points, np.float32)).split(_AT_ONCE)
        found = [self.network.distance(part[None], code[None]) for part in parts]
        values, places = (torch.cat(each, 1)[0].double().numpy() for each in zip(*found, strict=True))
        return values, places

    def to_template(self, points: Float[Floats, "P 3"], name: str) -> Float[Floats, "P 3"]:
        """Where points of a shape's file (its vertices, say) lie on the template."""
        number = self.number(name)
        inside = np.clip(self.frames[number].apply(points), -1, 1)
        return self.distance(inside, self.network.codes[number])[1]

    def match(self, a: str, b: str, source: ShapeLike | None = None, target: ShapeLike | None = None) -> VertexMap:
        """Each vertex of one shape of the training to that of another which is nearest on the template.

        ``source`` and ``target`` are the shapes themselves, in their files' frames; by default the model's surfaces.
        Confidence falls with the distance there.
        """
        one, other = (self.surface(n) if given is None else as_shape(given) for n, given in ((a, source), (b, target)))
        apart, index = cKDTree(self.to_template(other.verts, b)).query(self.to_template(one.verts, a))
        return VertexMap.between(one, other, index, confidence=np.clip(1 - apart / _DOUBTED, 0, 1))

    def surface(self, a: str, b: str | None = None, time: float = 0.0, resolution: int = 64) -> Shape:
        """The surface of a shape of the training, or of one on the way to another, in the file's frame.

        ``resolution`` (even) is the number of cells along each side of the cube. `OptionError` for an unknown name or a
        resolution that is odd or out of 8..512; `ModelError` where the distances enclose nothing.
        """
        if not 8 <= resolution <= 512 or resolution % 2:
            raise OptionError(f"resolution must be even, from 8 to 512, not {resolution}")
        code, frame = self.between(a, b or a, time)
        step, ticks = 2 / resolution, np.linspace(-1, 1, resolution // 2 + 1, dtype=np.float64)
        points: Floats = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
        coarse = self.distance(points, code)[0].reshape([len(ticks)] * 3)
        values = zoom(coarse, (resolution + 1) / len(ticks), order=1)
        near = np.argwhere(np.abs(values) < 2 * step * math.sqrt(3))  # elsewhere the coarse grid says enough
        values[tuple(near.T)] = self.distance(np.asarray(near * step - 1, np.float64), code)[0]
        values = np.pad(values, 1, constant_values=1.0)  # closed where it meets the cube
        if not values.min() < 0:
            raise ModelError(f"the model has no surface between {a} and {b or a}", "train it longer")
        verts, faces, _, _ = marching_cubes(values, 0.0, allow_degenerate=False)
        return Shape(
            frame.undo((verts - 1) * step - 1), faces.astype(np.int64), a if b is None else f"{a}-{b}-{time:g}"
        )


def save_implicit(folder: Path, model: ImplicitModel, facts: Mapping[str, Any]) -> None:
    """Write a model folder; the card, with ``facts`` about the training, comes last."""
    (folder / IMPLICIT).unlink(missing_ok=True)
    digest = save_weights(model.network.state_dict(), folder / WEIGHTS, storage="float32")
    card = {
        **{"schema": _SCHEMA, "config": asdict(model.network.config), "names": model.names},
        **{"frames": [[frame.scale, *frame.center.tolist()] for frame in model.frames]},
        **{"weights_sha256": digest, **facts},
    }
    with replace_on_success(folder / IMPLICIT) as temporary:
        temporary.write_text(json.dumps(card, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def load_implicit(folder: str | Path) -> ImplicitModel:
    """A model that `train_implicit` wrote; `ModelError` if the folder holds none, or a file is damaged."""
    path = Path(folder) / IMPLICIT
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise ValueError(f"it is larger than {MAX_BYTES // 1000} kB")
        card = json.loads(text)
        config, names = ImplicitConfig(**card["config"]), tuple(map(str, card["names"]))
        frames = tuple(Frame(float(row[0]), np.eye(3), np.array(row[1:], np.float64)) for row in card["frames"])
        known = config.kernel in KERNELS and config.deformation in get_args(Deformation)
        small = (type(getattr(config, key)) is int and 0 < getattr(config, key) <= most for key, most in _MOST.items())
        if not (
            card["schema"] == _SCHEMA and known and all(small) and len(names) == len(frames) == len(set(names)) > 0
        ):
            raise ValueError("its schema, config or names cannot be")
        held = read_header(path.with_name(WEIGHTS))
        K = held["deformation.nodes"].shape[:1]
        with torch.device("meta"):
            network = ImplicitNetwork(config, len(names), torch.zeros(*K, 3), torch.zeros(K))
    except OSError as error:
        raise ModelError(
            f"{folder} holds no implicit model: cannot read {IMPLICIT}", "see experiments.implicit_training"
        ) from error
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError, InputError) as error:
        raise ModelError(f"{path} is not the card of an implicit model: {error}", "is a file damaged?") from error
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    weights = load_weights(path.with_name(WEIGHTS), expected)
    network.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()}, assign=True)
    return ImplicitModel(network.eval(), names, frames)
