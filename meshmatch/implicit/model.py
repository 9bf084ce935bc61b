"""A trained implicit model: its files, its surfaces, and the way between two shapes through the template."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from scipy.ndimage import zoom
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, ModelError, OptionError, needs
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.kernels import KERNELS
from meshmatch.implicit.card import ImplicitCard, read_implicit_card
from meshmatch.implicit.network import Deformation, ImplicitConfig, ImplicitNetwork
from meshmatch.implicit.samples import FILLED
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.checkpoint import load_weights
from meshmatch.models.registry import WEIGHTS
from meshmatch.models.tensor_file import read_header
from meshmatch.shapes.shape import Shape

_AT_ONCE = 8192  # points
_DOUBTED = 0.2  # distance on the template, in the cube, from which a match has no confidence; set by hand
_NORMAL = 0.2  # chosen among 0.05 to 0.2 on generated furniture
_FAIR, _POOR = 2.0, 5.0  # residuals above which a shape is so; set by hand
_MOST = {"code": 1024, "width": 2048, "depth": 16, "inner": 512}  # that a card may ask for


@dataclass(frozen=True, eq=False)
class ImplicitFit:
    """A shape as a model has it: a code, and the way from its file into the cube from -1 to 1.

    ``residual`` is the mean distance that the model gives points of its surface, % of the longest side; NaN if not known.
    """

    name: str
    code: Float[torch.Tensor, " D"]
    frame: Frame
    residual: float = math.nan

    @property
    def verdict(self) -> str:
        """Good, fair or poor by the residual."""
        return "unknown" if math.isnan(self.residual) else ("good", "fair", "poor")[self._grade]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not good."""
        if math.isnan(self.residual) or not self._grade:
            return ()
        return (f"the model's surface is {self.residual:.1f} % of the longest side away from {self.name}",)

    @property
    def _grade(self) -> int:
        return int(self.residual > _FAIR) + int(self.residual > _POOR)


@dataclass(frozen=True, eq=False)
class ImplicitModel:
    """A category as one deformed template. Make one with `load_implicit` or `train_implicit`.

    >>> model = meshmatch.load_implicit("chair-model")
    >>> a, b = (meshmatch.fit_implicit(model, path) for path in ("a.ply", "b.ply"))
    >>> half_way = model.surface(model.blend(a, b, 0.5))
    """

    card: ImplicitCard
    network: ImplicitNetwork

    def known(self, name: str) -> ImplicitFit:
        """A shape of the training by its name; `OptionError` if there was none of that name."""
        names = self.card.shapes
        if name not in names:
            some = ", ".join(names[:5])
            raise OptionError(f"the model knows no shape {name!r}", f"its {len(names)} shapes: {some}, ...")
        number = names.index(name)
        scale, *center = self.card.frames[number]
        return ImplicitFit(name, self.network.codes[number].detach(), Frame(scale, np.eye(3), np.array(center)))

    def blend(self, a: ImplicitFit, b: ImplicitFit, time: float) -> ImplicitFit:
        """The shape on the way from one to another: at time 0 the first, at 1 the last; before and beyond too."""
        scale = a.frame.scale ** (1 - time) * b.frame.scale**time
        center = (1 - time) * a.frame.center + time * b.frame.center
        code = (1 - time) * a.code + time * b.code
        return ImplicitFit(f"{a.name}-{b.name}-{time:g}", code, Frame(scale, np.eye(3), center))

    @torch.no_grad()
    def distance(
        self, points: Float[Floats, "P 3"], code: Float[torch.Tensor, " D"]
    ) -> tuple[Float[Floats, " P"], Float[Floats, "P 3"]]:
        """Signed distances of points of the cube, and where each lies on the template."""
        parts = torch.from_numpy(np.array(points, np.float32)).split(_AT_ONCE)
        found = [self.network.distance(part[None], code[None]) for part in parts]
        values, places = (torch.cat(each, 1)[0].double().numpy() for each in zip(*found, strict=True))
        return values, places

    def to_template(self, points: Float[Floats, "P 3"], shape: ImplicitFit) -> Float[Floats, "P 3"]:
        """Where points of a shape's file (its vertices, say) lie on the template."""
        return self.distance(np.clip(shape.frame.apply(points), -1, 1), shape.code)[1]

    def match(self, a: ImplicitFit, b: ImplicitFit, source: Shape, target: Shape) -> VertexMap:
        """Each vertex of ``source``, which is ``a``, to that of ``target``, which is ``b``, nearest to it on the template.

        Between meshes normals count too: shapes stand alike, and both sides of a thin board should not be taken for each
        other. Confidence falls with the distance; the verdict is the worse of the two.
        """
        places = [self.to_template(shape.verts, fit) for shape, fit in ((source, a), (target, b))]
        signed = not (
            source.is_cloud or target.is_cloud
        )  # the normals of a cloud are estimated, and may face either way
        normals = [shape.vertex_normals if signed else np.zeros((shape.V, 3)) for shape in (source, target)]
        index = nearest_on_template(*places, *normals)
        apart = np.linalg.norm(places[0] - places[1][index], axis=1)
        grades = ("good", "unknown", "fair", "poor")
        verdict = grades[max(grades.index(each.verdict) for each in (a, b))]
        trust = np.clip(1 - apart / _DOUBTED, 0, 1) * (0.5 if verdict == "poor" else 1.0)
        reasons = (*a.reasons, *b.reasons)
        return VertexMap.between(source, target, index, confidence=trust, verdict=verdict, reasons=reasons)

    def surface(self, shape: ImplicitFit, resolution: int = 64) -> Shape:
        """The surface of a shape by marching cubes, in the file's frame.

        ``resolution`` (even) is the number of cells along each side of the cube. `OptionError` for a resolution that is odd
        or out of 8..512, or without scikit-image; `ModelError` where the distances enclose nothing.
        """
        with needs("skimage", "implicit"):
            from skimage.measure import marching_cubes

        check_resolution(resolution)
        step, ticks = 2 / resolution, np.linspace(-1, 1, resolution // 2 + 1, dtype=np.float64)
        points: Floats = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
        coarse = self.distance(points, shape.code)[0].reshape([len(ticks)] * 3)
        values = zoom(coarse, (resolution + 1) / len(ticks), order=1)
        near = np.argwhere(np.abs(values) < 2 * step * math.sqrt(3))  # elsewhere the coarse grid says enough
        if len(near):
            values[tuple(near.T)] = self.distance(np.asarray(near * step - 1, np.float64), shape.code)[0]
        values = np.pad(values, 1, constant_values=1.0)  # closed where it meets the cube
        if not values.min() < 0:
            raise ModelError(f"the model has no surface for {shape.name}", "train it longer")
        verts, faces, _, _ = marching_cubes(values, 0.0, allow_degenerate=False)
        return Shape(shape.frame.undo((verts - 1) * step - 1), faces.astype(np.int64), shape.name)


def nearest_on_template(
    source: Float[Floats, "P 3"],
    target: Float[Floats, "Q 3"],
    normals: Float[Floats, "P 3"],
    others: Float[Floats, "Q 3"],
) -> Int[Ints, " P"]:
    """For each place on the template the nearest of others, in six dimensions: position and a share of the normal."""
    tree = cKDTree(np.concatenate([target, _NORMAL * others], 1))
    return np.asarray(tree.query(np.concatenate([source, _NORMAL * normals], 1))[1])


def check_resolution(resolution: int) -> None:
    """`OptionError` if marching cubes cannot have so many cells along a side."""
    if not 8 <= resolution <= 512 or resolution % 2:
        raise OptionError(f"resolution must be even, from 8 to 512, not {resolution}")


def percent_of_side(distance: float) -> float:
    """A length in the cube, % of the longest side of what is in it."""
    return 100 * distance / (2 * FILLED)


def load_implicit(folder: str | Path) -> ImplicitModel:
    """A model that `train_implicit` wrote; `ModelError` if the folder holds none, or a file is damaged or another's."""
    folder = Path(folder)
    card = read_implicit_card(folder)
    try:
        config = ImplicitConfig(**card.network)
        known = config.kernel in KERNELS and config.field in get_args(Deformation)
        small = (type(getattr(config, key)) is int and 0 < getattr(config, key) <= most for key, most in _MOST.items())
        if not (known and all(small)):
            raise ValueError("its network cannot be")
        held = read_header(folder / WEIGHTS)
        K = held["deformation.nodes"].shape[:1]
        with torch.device("meta"):
            network = ImplicitNetwork(config, len(card.shapes), torch.zeros(*K, 3), torch.zeros(K))
        for number in range(len(card.frames)):
            Frame(card.frames[number][0], np.eye(3), np.array(card.frames[number][1:]))
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, InputError) as error:
        raise ModelError(f"{folder} holds no implicit model that can be: {error}", "is a file damaged?") from error
    with (folder / WEIGHTS).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != card.weights_sha256:
        raise ModelError(f"the weights in {folder} are not those of its card", "train it again, or fetch it again")
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    weights = load_weights(folder / WEIGHTS, expected)
    network.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()}, assign=True)
    return ImplicitModel(card, network.eval())
