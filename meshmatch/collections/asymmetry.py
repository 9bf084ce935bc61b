"""Asymmetry: of shapes that are nearly symmetric by themselves (object symmetry), and of left and right ones (matching).

Each shape is compared with its mirror image, whose vertices are those across the plane of symmetry of the mean; or the
left one of an individual with its right one. What all have in common is directional asymmetry, what is each one's own is
fluctuating asymmetry, with errors of measurement: individuals that were measured several times tell these apart. Sources:
Palmer and Strobeck, Annu. Rev. Ecol. Syst. 17 (1986); Mardia, Bookstein and Moreton, Biometrika 87 (2000); Klingenberg,
Barluenga and Meyer, Evolution 56 (2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from meshmatch.arrays import Brief, Float, Floats, Int, Ints, frozen
from meshmatch.collections.anova import Effect, Variances, analyse
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.covariates import Columns, Covariates, DesignTerm, covariates, some
from meshmatch.collections.groups import Statistic
from meshmatch.collections.superimpose import Superimposed
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.frames import kabsch
from meshmatch.maps.footpoints import Footpoints
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.shapes.shape import Shape
from meshmatch.templates.sides import laid_mirrored

_ROUNDS = 10
_SYMMETRIC = 0.015  # root mean square distance of a mean from its mirror image, in roots of its area: more is none


@dataclass(frozen=True, eq=False, repr=False)
class Asymmetry(Brief):
    """How shapes differ from their mirror images, or right ones from left ones.

    Attributes
    ----------
    names : of the S individuals
    of_mean : root mean square difference of the sides on average, over the surface
    directional : the side: how the shapes on average lie beside their mirror images, or one side beside the other.
        ``change`` (1, V, 3) and ``along_normal`` (1, V) lead from the mirror image to the shape: positive where it lies
        further out than its counterpart; F by fluctuating asymmetry, tested by exchanging the sides of individuals (sign
        flips)
    fluctuating : (V,) root mean square deviation of the differences from their mean, at each vertex
    error : (V,) the same of one individual's measurements, of their difference; None where there is one of each
    table : individuals, the side, and what is left: fluctuating asymmetry. Where individuals were measured several times
        fluctuating asymmetry is an effect, ``individual:side``, and errors of measurement are what is left. Its p-values
        come from exchanging measurements of all individuals
    total_of : (S,) root mean square difference of the sides of each individual, over the surface
    fluctuating_of : (S,) the same without what is common to all
    matching : whether left and right shapes were compared, and not shapes with their mirror images
    """

    names: tuple[str, ...]
    of_mean: float
    directional: Effect
    fluctuating: Float[Floats, " V"]
    error: Float[Floats, " V"] | None
    table: Variances
    total_of: Float[Floats, " S"]
    fluctuating_of: Float[Floats, " S"]
    matching: bool


def measure_asymmetry(
    atlas: Atlas,
    table: str | Path | Columns | None = None,
    *,
    individuals: str | None = None,
    sides: str | None = None,
    kind: Statistic = "normal",
    permutations: int = 10_000,
    seed: int = 0,
) -> Asymmetry:
    """Compare the shapes of an atlas with their mirror images, or left ones with right ones.

    What lies across from a vertex is the nearest place of the mean's mirror image: what all shapes have in common along the
    surface is no directional asymmetry. Left and right ones are compared vertex by vertex.

    Parameters
    ----------
    atlas
        Of shapes that are nearly symmetric, such as heads; or, with ``sides``, of left and right ones, such as femurs, laid
        over one another as mirror images. What the modes do not keep plays no part.
    table
        What is known of the shapes, as for `Atlas.anova`.
    individuals
        A column: shapes of one individual are several measurements of it. Without it each shape is an individual.
    sides
        A column of two values, such as left and right: each individual has as many shapes of one as of the other, which are
        taken for pairs in the order of their names.
    kind
        What is tested at vertices. "normal": displacement along the normal of the mean; "hotelling": in any direction.
    permutations
        How many exchanges the p-values come from; all if there are no more.
    seed
        Of the permutations.

    Returns
    -------
    Asymmetry
        In the frame and unit of the atlas.

    Raises
    ------
    InputError
        The mean is not nearly its own mirror image, a column is missing or does not give pairs.
    OptionError
        Sides without individuals.

    Examples
    --------
    >>> found = meshmatch.measure_asymmetry(meshmatch.Atlas.load("atlas"))
    >>> print(found.directional.p, found.fluctuating_of)
    """
    known = covariates(table, atlas.names, atlas.sizes)
    labels = atlas.names if individuals is None else _cells(known, individuals)
    if sides is None:
        given = _beside_images(atlas, labels, seed)
    elif individuals is not None:
        given = _left_and_right(atlas, labels, sides, _cells(known, sides))
    else:
        raise OptionError("sides are of individuals", "say which column names these")
    names, whose, pairs = given.names, given.whose, given.points
    if len(names) < 3:
        raise InputError(f"{len(names)} individuals are too few", "three or more are needed")
    weights, counts = atlas.weights, np.bincount(whose)
    means = np.add.reduceat(pairs, np.cumsum(counts) - counts) / counts[:, None, None, None]

    def analysed(offsets: Floats, terms: list[DesignTerm], blocks: Ints | None) -> Variances:
        flat = (offsets * np.sqrt(weights)[:, None]).reshape(len(offsets), -1)
        size, sides = np.linalg.eigh(flat @ flat.T)
        flat = sides * np.sqrt(np.maximum(size, 0))
        normals, along = given.laid.vertex_normals, kind == "normal"
        return analyse(
            flat, offsets, terms, normals, along=along, blocks=blocks, permutations=permutations, seed=seed
        )  # fmt: skip

    both = means.reshape(-1, *given.laid.verts.shape) - given.laid.verts
    individual = np.repeat(np.arange(len(names)), 2)
    side = DesignTerm("side", np.tile([[1.0], [0.0]], (len(names), 1)), (given.side,))
    found, error = analysed(both, [_term(individual, names), side], individual), None
    if len(whose) > len(names):
        apart, within = pairs[:, 0] - pairs[:, 1], pairs - means[whose]
        measured = analysed(apart - apart.mean(axis=0), [_term(whose, names)], None)
        scatter = float(np.square(within).sum(axis=(0, 1, 3)) @ weights)
        found = _with_error(found, measured.effects[0], scatter, counts)
        error = frozen(_spread(within[:, 0] - within[:, 1], len(whose) - len(names)))
    apart = means[:, 0] - means[:, 1]
    left = apart - apart.mean(axis=0)
    return Asymmetry(
        names=names,
        of_mean=_rms(apart.mean(axis=0), weights) if given.of_mean is None else given.of_mean,
        directional=found.effects[1],
        fluctuating=frozen(_spread(left, len(names) - 1)),
        error=error,
        table=found,
        total_of=frozen(np.array([_rms(each, weights) for each in apart])),
        fluctuating_of=frozen(np.array([_rms(each, weights) for each in left])),
        matching=sides is not None,
    )


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Measurements of both sides of individuals, one individual after the other.

    ``points`` (M, 2, V, 3) lie over ``laid``; ``whose`` (M,) are numbers of the ``names``; ``side`` is what the first of two
    less the second is called. ``of_mean``: how far a mean is from its mirror image.
    """

    names: tuple[str, ...]
    whose: Int[Ints, " M"]
    points: Float[Floats, "M 2 V 3"]
    laid: Shape
    side: str
    of_mean: float | None = None


def _beside_images(atlas: Atlas, labels: Sequence[str], seed: int) -> _Pairs:
    """Shapes of individuals, and their mirror images."""
    if atlas.groups is not None:
        raise InputError("symmetry is of whole shapes, and parts were superimposed", "make an atlas of whole shapes")
    mean, weights = atlas.mean_shape, atlas.weights
    across = _Across(mean, weights, seed)
    image = Superimposed(mean.verts, weights, None).align(across.image(mean.verts)[None])[0]
    of_mean = _rms(mean.verts - image, weights)
    if of_mean > _SYMMETRIC * np.sqrt(mean.area):
        raise InputError(
            f"the mean is no mirror image of itself: they are {of_mean:.3g} apart on average",
            "left and right ones of a pair are compared by columns that say which is whose (sides, individuals)",
        )
    laid = Superimposed((mean.verts + image) / 2, weights, None)
    names, whose, order = _numbered(labels)
    own = laid.align((atlas.mean + atlas.offsets(atlas.scores))[order])
    points = np.stack([own, own - np.stack([_apart(each, across, laid) for each in own])], axis=1)
    return _Pairs(names, whose[order], points, Shape(laid.consensus, mean.faces), "side", of_mean)


def _left_and_right(atlas: Atlas, labels: Sequence[str], column: str, cells: Sequence[str]) -> _Pairs:
    """Shapes of one side, and of the other, of the same individuals."""
    levels = sorted(set(cells))
    if len(levels) != 2:
        raise InputError(
            f"{column} has {len(levels)} values ({some(levels)})", "two are needed, such as left and right"
        )
    names, whose, order = _numbered(labels)
    second = np.array([cell == levels[1] for cell in cells], bool)
    rows = [order[second[order] == one] for one in (True, False)]
    if not np.array_equal(*(whose[each] for each in rows)):
        unlike = np.bincount(whose[second], minlength=len(names)) != np.bincount(whose[~second], minlength=len(names))
        raise InputError(
            f"{some([names[k] for k in np.flatnonzero(unlike)])}: not as many {levels[1]} as {levels[0]} ones",
            "each individual needs both; --leave-out (`leave_out`) leaves out shapes",
        )
    points = (atlas.mean + atlas.offsets(atlas.scores))[np.stack(rows, axis=1)]
    return _Pairs(names, whose[rows[0]], points, atlas.mean_shape, f"{column}: {levels[1]} - {levels[0]}")


def _cells(known: Covariates, column: str) -> tuple[str, ...]:
    """A column that says something of every shape."""
    lacking = known.missing(column)
    if lacking.any():
        names = some([known.names[k] for k in np.flatnonzero(lacking)])
        raise InputError(f"{names}: {column} is missing", "fill it in, or leave these shapes out of the atlas")
    return known.column(column)


def _numbered(labels: Sequence[str]) -> tuple[tuple[str, ...], Int[Ints, " M"], Int[Ints, " M"]]:
    """The individuals, the number of each label's, and an order of labels that has one individual after the other."""
    numbers = {label: k for k, label in enumerate(dict.fromkeys(labels))}
    whose = np.array([numbers[label] for label in labels])
    return tuple(numbers), whose, np.argsort(whose, kind="stable")


def _term(whose: Int[Ints, " S"], names: tuple[str, ...]) -> DesignTerm:
    return DesignTerm("individual", np.eye(len(names))[whose][:, 1:], names[1:])


def _with_error(given: Variances, tested: Effect, scatter: float, counts: Int[Ints, " N"]) -> Variances:
    """A table of the means of individuals, where fluctuating asymmetry is an effect and errors of measurement are left.

    ``scatter`` is the sum of squares of measurements about these means. Where individuals were measured a different
    number of times, ``counts``, their means count alike (unweighted means: Yates, J. Am. Stat. Assoc. 29 (1934)).
    """
    times = len(counts) / float((1 / counts).sum())
    df = 2 * int((counts - 1).sum())
    total = times * given.total_ss + scatter
    ss = times * given.residual_ss
    own = replace(
        tested,
        name="individual:side",
        df=given.residual_df,
        ss=ss,
        ms=ss / given.residual_df,
        r2=ss / total,
        f=ss / given.residual_df / max(scatter / df, np.finfo(float).tiny),
        coefficients=(),
        change=tested.change[:0],
        along_normal=tested.along_normal[:0],
    )
    before = [
        replace(each, ss=times * each.ss, ms=times * each.ms, r2=times * each.ss / total) for each in given.effects
    ]
    return replace(
        given, effects=(*before, own), residual_df=df, residual_ss=scatter, total_df=given.total_df + df, total_ss=total
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


def _spread(offsets: Float[Floats, "N V 3"], df: int) -> Float[Floats, " V"]:
    return np.asarray(np.sqrt(np.square(offsets).sum(axis=(0, 2)) / df))
