"""Trained implicit models: load them, extract surfaces, and match shapes through the template."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from scipy.ndimage import zoom
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, ModelError, OptionError, needs
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.kernels import KERNELS
from meshmatch.geometry.trees import cKDTree
from meshmatch.implicit.fit import REACH, ImplicitFit
from meshmatch.implicit.network import Deformation, ImplicitConfig, ImplicitNetwork
from meshmatch.implicit.samples import FILLED
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.card import ImplicitCard, read_implicit_card
from meshmatch.models.checkpoint import load_weights
from meshmatch.models.registry import WEIGHTS, check_weights, locate_model
from meshmatch.models.tensor_file import read_header
from meshmatch.scalars import is_integer
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

_BATCH = 8192  # points per batch
_MAX_DISTANCE = 0.2  # distance on the template, in the cube, at which confidence reaches 0; set by hand
_NORMAL_WEIGHT = 0.2  # weight of normals in matching; chosen from 0.05 to 0.2 on generated furniture
# Gauss-Newton steps that invert the deformation, steps that project onto the surface, maximum length of a step
_NEWTON_STEPS, _PROJECTION_STEPS, _MAX_STEP = 12, 3, 0.1
_DAMPING = 1e-6  # of the normal equations, in units of squared stretch
_COARSE = 48  # resolution of the surface by which a fit is judged
# bounds on the sizes on a card
_MAX_SIZES = {"code": 1024, "width": 2048, "depth": 16, "inner": 512, "layers": 16, "maker": 4096}
_MAX_CODE_LENGTH = 100.0  # bound on the initial length of codes


@dataclass(frozen=True, eq=False)
class ImplicitModel:
    """A category as one deformed template. Load one with `load_implicit`, train one with `train_implicit`.

    Attributes
    ----------
    card
        The model's metadata.
    network
        The networks, and the codes of the training shapes.

    Examples
    --------
    >>> model = meshmatch.load_implicit("chair-model")
    >>> a, b = (meshmatch.fit_implicit(model, path) for path in ("a.ply", "b.ply"))
    >>> half_way = model.surface(model.blend(a, b, 0.5))
    """

    card: ImplicitCard
    network: ImplicitNetwork

    def known(self, name: str) -> ImplicitFit:
        """Return a training shape.

        Parameters
        ----------
        name
            Name of the shape.

        Returns
        -------
        ImplicitFit
            With the code that the training found.

        Raises
        ------
        OptionError
            There was no training shape of that name.
        """
        names = self.card.shapes
        if name not in names:
            some = ", ".join(names[:5])
            raise OptionError(f"the model knows no shape {name!r}", f"its {len(names)} shapes: {some}, ...")
        number = names.index(name)
        scale, *center = self.card.frames[number]
        frame = Frame(scale, np.eye(3), np.array(center))
        return ImplicitFit(name, self.network.codes[number].detach(), frame, owner=self)

    def blend(self, a: ImplicitFit, b: ImplicitFit, time: float) -> ImplicitFit:
        """Interpolate between two shapes: their codes and frames.

        Parameters
        ----------
        a
            The shape at time 0.
        b
            The shape at time 1.
        time
            Values below 0 and above 1 extrapolate.

        Returns
        -------
        ImplicitFit
            The blended code.
        """
        scale = a.frame.scale ** (1 - time) * b.frame.scale**time
        center = (1 - time) * a.frame.center + time * b.frame.center
        turn = Rotation.from_matrix(b.frame.rotation @ a.frame.rotation.T).as_rotvec()
        rotation = Rotation.from_rotvec(time * turn).as_matrix() @ a.frame.rotation
        code = (1 - time) * a.code + time * b.code
        return ImplicitFit(f"{a.name}-{b.name}-{time:g}", code, Frame(scale, rotation, center), owner=self)

    @torch.no_grad()
    def distance(
        self, points: Float[Floats, "P 3"], code: Float[torch.Tensor, " D"]
    ) -> tuple[Float[Floats, " P"], Float[Floats, "P 3"]]:
        """Signed distances of points, and the corresponding points on the template.

        Parameters
        ----------
        points
            (P, 3) in the cube from -1 to 1.
        code
            (D,) code of a shape.

        Returns
        -------
        (P,), (P, 3)
            Distances, negative inside, and points in the template's cube.
        """
        parts = torch.from_numpy(np.array(points, np.float32)).split(_BATCH)
        found = [self.network.distance(part[None], code[None]) for part in parts]
        values, places = (torch.cat(each, 1)[0].double().numpy() for each in zip(*found, strict=True))
        return values, places

    def to_template(self, points: Float[Floats, "P 3"], shape: ImplicitFit) -> Float[Floats, "P 3"]:
        """Map points of a shape to the template.

        Parameters
        ----------
        points
            (P, 3) in the frame and unit of the shape's file, such as its vertices.
        shape
            The shape.

        Returns
        -------
        (P, 3)
            In the template's cube.
        """
        return self.distance(np.clip(shape.frame.apply(points), -1, 1), shape.code)[1]

    def match(self, a: ImplicitFit, b: ImplicitFit, source: Shape, target: Shape) -> VertexMap:
        """Map each vertex of one shape to the vertex of another that is nearest to it on the template.

        Between meshes normals are compared too, so that the two sides of a thin board are not confused. Confidence
        decreases with the distance; the verdict is the worse of the two fits'.

        Parameters
        ----------
        a
            The fit of the source.
        b
            The fit of the target.
        source
            The source.
        target
            The target.

        Returns
        -------
        VertexMap
            From source to target.
        """
        places = [self.to_template(shape.verts, fit) for shape, fit in ((source, a), (target, b))]
        signed = not (source.is_cloud or target.is_cloud)  # normals of clouds are estimated, up to sign
        normals = [
            shape.vertex_normals @ fit.frame.rotation.T if signed else np.zeros((shape.V, 3))
            for shape, fit in ((source, a), (target, b))
        ]
        index = nearest_on_template(*places, *normals)
        apart = np.linalg.norm(places[0] - places[1][index], axis=1)
        grades = ("good", "unknown", "fair", "poor")
        verdict = grades[max(grades.index(each.verdict) for each in (a, b))]
        trust = np.clip(1 - apart / _MAX_DISTANCE, 0, 1) * (0.5 if verdict == "poor" else 1.0)
        reasons = (*a.reasons, *b.reasons)
        return VertexMap.between(source, target, index, confidence=trust, verdict=verdict, reasons=reasons)

    def surface(self, shape: ImplicitFit, resolution: int = 64) -> Shape:
        """Extract the surface of a shape by marching cubes.

        Parameters
        ----------
        shape
            The shape.
        resolution
            Even number of cells along each side of the cube, 8..512.

        Returns
        -------
        Shape
            In the file's frame and unit.

        Raises
        ------
        OptionError
            The resolution is odd or out of range, or scikit-image is missing.
        ModelError
            The distances enclose nothing.
        """
        found = zero_surface(lambda points: self.distance(points, shape.code)[0], resolution, shape.name)
        return Shape(shape.frame.undo(found.verts), found.faces, shape.name)

    def template(self, resolution: int = 64) -> Shape:
        """Extract the template's surface by marching cubes.

        Parameters
        ----------
        resolution
            As in `surface`.

        Returns
        -------
        Shape
            In the cube from -1 to 1.

        Raises
        ------
        MeshmatchError
            As for `surface`.
        """

        @torch.no_grad()
        def distance(points: Float[Floats, "P 3"]) -> Float[Floats, " P"]:
            parts = torch.from_numpy(points.astype(np.float32)).split(_BATCH)
            return torch.cat([self.network.template(part[None])[0, :, 0] for part in parts]).double().numpy()

        return zero_surface(distance, resolution, "template")

    def register(self, shape: ImplicitFit, resolution: int = 64) -> Shape:
        """Register the template's surface to a shape: for all shapes the same vertices and triangles in the same order.

        Each vertex is mapped by the inverse of the deformation, and then along the gradient of the distance onto the
        shape's surface.

        Parameters
        ----------
        shape
            The shape.
        resolution
            As in `surface`.

        Returns
        -------
        Shape
            In the file's frame and unit.

        Raises
        ------
        MeshmatchError
            As for `surface`.
        """
        rest = self.template(resolution)
        places = torch.from_numpy(rest.verts.astype(np.float32))
        found = torch.cat([self._invert_deformation(part, shape.code) for part in places.split(_BATCH)])
        return Shape(shape.frame.undo(found.double().numpy()), rest.faces, shape.name)

    @torch.no_grad()
    def _invert_deformation(
        self, places: Float[torch.Tensor, "P 3"], code: Float[torch.Tensor, " D"]
    ) -> Float[torch.Tensor, "P 3"]:
        """Points of a shape's surface that the deformation maps to given places on the template, as nearly as possible."""
        at, network = places.clone(), self.network
        for _ in range(_NEWTON_STEPS):
            off = network.distance(at[None], code[None])[1][0] - places
            F = network(at[None], code[None]).F[0]
            # damped, in case the deformation folds; lstsq is not reproducible
            step = torch.linalg.solve(F.mT @ F + _DAMPING * torch.eye(3), F.mT @ off[..., None])
            at = (at - _limit_step(step[..., 0])).clamp(-1, 1)
        for _ in range(_PROJECTION_STEPS):
            found = network(at[None], code[None])
            slope = found.gradient[0]
            step = found.distance[0, :, None] * slope / slope.square().sum(1, keepdim=True).clamp_min(0.1)
            at = (at - _limit_step(step)).clamp(-1, 1)
        return at.detach()

    def shares(self, shape: ImplicitFit, points: Float[Floats, "P 3"], seed: int = 0) -> tuple[float, float]:
        """Shares of a shape's points and of the model's surface that are far from each other.

        Parameters
        ----------
        shape
            The shape.
        points
            (P, 3) points of its surface, in the cube.
        seed
            Seed for sampling the model's surface.

        Returns
        -------
        (float, float)
            ``missed`` and ``invented``, see `ImplicitFit`.
        """
        try:
            surface = sample_surface(self.surface(shape, _COARSE), len(points), np.random.default_rng(seed)).points
        except ModelError:
            return 1.0, 0.0
        surface, spacing = shape.frame.apply(surface), cKDTree(points).query(points, 2)[0][:, 1]
        reach = max(2 * FILLED * REACH / 100, 3 * float(np.median(spacing)))
        far = [cKDTree(b).query(a)[0] > reach for a, b in ((points, surface), (surface, points))]
        return float(far[0].mean()), float(far[1].mean())


def _limit_step(step: Float[torch.Tensor, "P 3"]) -> Float[torch.Tensor, "P 3"]:
    result: torch.Tensor = step * (_MAX_STEP / step.norm(dim=1, keepdim=True).clamp_min(_MAX_STEP))
    return result


def zero_surface(distance: Callable[[Float[Floats, "P 3"]], Float[Floats, " P"]], resolution: int, name: str) -> Shape:
    """Zero level set of distances in the cube, by marching cubes; see `ImplicitModel.surface`."""
    with needs("skimage", "implicit"):
        from skimage.measure import marching_cubes

    check_resolution(resolution)
    step, ticks = 2 / resolution, np.linspace(-1, 1, resolution // 2 + 1, dtype=np.float64)
    points: Floats = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    coarse = distance(points).reshape([len(ticks)] * 3)
    values = zoom(coarse, (resolution + 1) / len(ticks), order=1)
    near = np.argwhere(np.abs(values) < 2 * step * math.sqrt(3))  # elsewhere the coarse grid is sufficient
    if len(near):
        values[tuple(near.T)] = distance(np.asarray(near * step - 1, np.float64))
    values = np.pad(values, 1, constant_values=1.0)  # closes the surface at the cube's faces
    if not values.min() < 0:
        raise ModelError(f"the model has no surface for {name}", "train it longer")
    verts, faces, _, _ = marching_cubes(values, 0.0, allow_degenerate=False)
    return Shape((verts - 1) * step - 1, faces.astype(np.int64), name)


def nearest_on_template(
    source: Float[Floats, "P 3"],
    target: Float[Floats, "Q 3"],
    normals: Float[Floats, "P 3"],
    others: Float[Floats, "Q 3"],
) -> Int[Ints, " P"]:
    """Index of the nearest target place for each source place, in six dimensions: position and weighted normal."""
    tree = cKDTree(np.concatenate([target, _NORMAL_WEIGHT * others], 1))
    return np.asarray(tree.query(np.concatenate([source, _NORMAL_WEIGHT * normals], 1))[1])


def check_resolution(resolution: int) -> None:
    """Raise `OptionError` unless ``resolution`` is valid for marching cubes."""
    if not is_integer(resolution, 8) or resolution > 512 or resolution % 2:
        raise OptionError(f"resolution must be even, from 8 to 512, not {resolution!r}")


def percent_of_side(distance: float) -> float:
    """Convert a length in the cube to % of the longest side of the shape's box."""
    return 100 * distance / (2 * FILLED)


def load_implicit(folder: str | Path) -> ImplicitModel:
    """Load a model that `train_implicit` wrote.

    Parameters
    ----------
    folder
        Folder of the model, or its name in the registry.

    Returns
    -------
    ImplicitModel
        The model, checked.

    Raises
    ------
    ModelError
        There is no such model, or a file is damaged or belongs to another model.

    Examples
    --------
    >>> model = meshmatch.load_implicit("chair-model")
    >>> chair = meshmatch.fit_implicit(model, "chair.ply")
    >>> meshmatch.save_shape("surface.ply", model.surface(chair))
    """
    folder = locate_model(folder)
    card = read_implicit_card(folder)
    try:
        config = ImplicitConfig(**card.network)
        known = config.kernel in KERNELS and config.field in get_args(Deformation)
        valid = (
            type(getattr(config, key)) is int and 0 < getattr(config, key) <= most for key, most in _MAX_SIZES.items()
        )
        if not (known and all(valid) and 0 < config.length <= _MAX_CODE_LENGTH):
            raise ValueError("its network is invalid")
        header = read_header(folder / WEIGHTS)
        K = header["deformation.nodes"].shape[:1]
        with torch.device("meta"):
            network = ImplicitNetwork(config, len(card.shapes), torch.zeros(*K, 3), torch.zeros(K))
        for number in range(len(card.frames)):
            Frame(card.frames[number][0], np.eye(3), np.array(card.frames[number][1:]))
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, InputError) as error:
        raise ModelError(f"{folder} holds no valid implicit model: {error}", "is a file damaged?") from error
    check_weights(folder, card)
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    weights = load_weights(folder / WEIGHTS, expected)
    network.load_state_dict({name: torch.from_numpy(array) for name, array in weights.items()}, assign=True)
    return ImplicitModel(card, network.eval())
