"""Asymmetry of shapes that are nearly symmetric by themselves: object symmetry.

Each shape is compared with its mirror image, whose vertices are those across the plane of symmetry of the mean. What all
shapes have in common is directional asymmetry, what is each one's own is fluctuating asymmetry, with what the
measurement adds. Sources: Mardia, Bookstein and Moreton, Biometrika 87 (2000); Klingenberg, Barluenga and Meyer, Evolution
56 (2002).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats, frozen
from meshmatch.collections.anova import Effect, Variances, analyse
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.covariates import DesignTerm
from meshmatch.collections.groups import Statistic
from meshmatch.collections.superimpose import Superimposed
from meshmatch.errors import InputError
from meshmatch.geometry.frames import kabsch
from meshmatch.maps.footpoints import Footpoints
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.shapes.shape import Shape
from meshmatch.templates.sides import laid_mirrored

_ROUNDS = 10
_SYMMETRIC = 0.015  # root mean square distance of a mean from its mirror image, in roots of its area: more is none


@dataclass(frozen=True, eq=False)
class Asymmetry:
    """How shapes differ from their mirror images.

    Attributes
    ----------
    names : of the S shapes
    of_mean : root mean square distance of the mean from its mirror image, over the surface
    directional : the side: how the shapes on average lie beside their mirror images. ``change`` (1, V, 3) and
        ``along_normal`` (1, V) lead from the mirror image to the shape: positive where it lies further out than its
        counterpart; F by fluctuating asymmetry, tested by exchanging sides (sign flips)
    fluctuating : (V,) root mean square deviation of the differences from their mean, at each vertex
    table : individuals, the side, and what is left: fluctuating asymmetry
    total_of : (S,) root mean square difference of each shape from its mirror image, over the surface
    fluctuating_of : (S,) the same without what is common to all
    """

    names: tuple[str, ...]
    of_mean: float
    directional: Effect
    fluctuating: Float[Floats, " V"]
    table: Variances
    total_of: Float[Floats, " S"]
    fluctuating_of: Float[Floats, " S"]


def measure_asymmetry(
    atlas: Atlas, *, kind: Statistic = "normal", permutations: int = 10_000, seed: int = 0
) -> Asymmetry:
    """Compare the shapes of an atlas with their mirror images.

    Parameters
    ----------
    atlas
        Of shapes that are nearly symmetric, such as heads. What the modes do not keep plays no part.
    kind
        What is tested at vertices. "normal": displacement along the normal of the mean; "hotelling": in any direction.
    permutations
        How many exchanges of sides the p-values come from; all if there are no more.
    seed
        Of the permutations.

    Returns
    -------
    Asymmetry
        In the frame and unit of the atlas.

    Raises
    ------
    InputError
        The mean is not nearly its own mirror image.

    Examples
    --------
    >>> found = meshmatch.measure_asymmetry(meshmatch.Atlas.load("atlas"))
    >>> print(found.directional.p, found.fluctuating_of)
    """
    if atlas.groups is not None:
        raise InputError("symmetry is of whole shapes, and parts were superimposed", "make an atlas of whole shapes")
    names, mean, weights = atlas.names, atlas.mean_shape, atlas.weights
    points = atlas.mean + atlas.offsets(atlas.scores)
    across = _Across(mean, weights, seed)
    image = Superimposed(mean.verts, weights, None).align(across.image(mean.verts)[None])[0]
    of_mean = _rms(mean.verts - image, weights)
    if of_mean > _SYMMETRIC * np.sqrt(mean.area):
        raise InputError(
            f"the mean is no mirror image of itself: they are {of_mean:.3g} apart on average",
            "left and right ones of a pair are compared by a column: shape ~ individual + side",
        )
    laid = Superimposed((mean.verts + image) / 2, weights, None)
    own = laid.align(points)
    apart = np.stack([_apart(each, across, laid) for each in own])
    both = np.stack([own, own - apart], axis=1).reshape(-1, *mean.verts.shape) - laid.consensus
    individual = np.repeat(np.arange(len(names)), 2)
    terms = [
        DesignTerm("individual", np.eye(len(names))[individual][:, 1:], names[1:]),
        DesignTerm("side", np.tile([[1.0], [0.0]], (len(names), 1)), ("side",)),
    ]
    flat = (both * np.sqrt(weights)[:, None]).reshape(len(both), -1)
    size, sides = np.linalg.eigh(flat @ flat.T)
    table = analyse(
        sides * np.sqrt(np.maximum(size, 0)),
        both,
        terms,
        Shape(laid.consensus, mean.faces).vertex_normals,
        along=kind == "normal",
        blocks=individual,
        permutations=permutations,
        seed=seed,
    )
    left = apart - apart.mean(axis=0)
    return Asymmetry(
        names=names,
        of_mean=of_mean,
        directional=table.effects[1],
        fluctuating=frozen(np.sqrt(np.square(left).sum(axis=2).sum(axis=0) / (len(names) - 1))),
        table=table,
        total_of=frozen(np.array([_rms(each, weights) for each in apart])),
        fluctuating_of=frozen(np.array([_rms(each, weights) for each in left])),
    )


def _apart(own: Float[Floats, "V 3"], across: _Across, laid: Superimposed) -> Float[Floats, "V 3"]:
    """A shape less its mirror image, both laid over something symmetric.

    Between vertices the image lies on a chord, a little inside, wherever there is a curve. Across the plane it does so too,
    where a true difference has the other sign: so that half of both differences is free of it.
    """
    image = across.image(own)
    pose = laid.poses(image[None])
    apart = own - pose.apply(image[None])[0]
    return np.asarray((apart - across.image(apart) @ pose.rotations[0, 0].T) / 2)


class _Across:
    """Which place of a mean lies across from each of its vertices."""

    def __init__(self, mean: Shape, weights: Float[Floats, " V"], seed: int) -> None:
        image = laid_mirrored(mean, seed)
        self._faces = image.faces
        normals = mean.vertex_normals
        for _ in range(_ROUNDS):
            self._places: Footpoints = MappedMesh.of(image).query(mean.verts, normals)
            # Towards the tangent planes, along which the image may slide.
            near = self._places.values(image.faces, image.verts)
            turns = np.concatenate([np.cross(near, normals), normals], axis=1) * np.sqrt(weights)[:, None]
            apart = np.einsum("vi,vi->v", mean.verts - near, normals) * np.sqrt(weights)
            step = np.linalg.lstsq(turns, apart, rcond=1e-6)[0]
            pose = kabsch(near, near + np.cross(step[:3], near) + step[3:], weights)
            image = Shape(pose.to_world(image.verts), image.faces)

    def image(self, verts: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
        """The mirror image of a shape, or of displacements, by x = 0; its vertices in their own order."""
        return self._places.values(self._faces, verts * [-1.0, 1.0, 1.0])


def _rms(offsets: Float[Floats, "V 3"], weights: Float[Floats, " V"]) -> float:
    return float(np.sqrt(weights @ np.square(offsets).sum(axis=1)))
