"""Asymmetry of shapes that are nearly symmetric themselves (object symmetry), or of left and right pairs (matching).

Each shape is compared with its mirror image, with vertices matched across the plane of symmetry of the mean; or the left
shape of an individual with its right one. The mean difference is directional asymmetry; individual deviations from it are
fluctuating asymmetry plus errors of measurement, which repeated measurements separate. Sources: Palmer and Strobeck,
Annu. Rev. Ecol. Syst. 17 (1986); Mardia, Bookstein and Moreton, Biometrika 87 (2000); Klingenberg, Barluenga and Meyer,
Evolution 56 (2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints, ShortRepr, set_read_only
from meshmatch.collections.anova import Effect, Variances, analyse
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.covariates import Columns, Covariates, DesignTerm, covariates, shorten_names
from meshmatch.collections.groups import Statistic
from meshmatch.collections.superimpose import Superimposed
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.frames import kabsch
from meshmatch.maps.footpoints import Footpoints
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.shapes.shape import Shape
from meshmatch.templates.mirror_images import aligned_mirror_image

_ROUNDS = 10
_MAX_ASYMMETRY = 0.015  # largest rms distance of a symmetric mean from its mirror image, in sqrt(area)


@dataclass(frozen=True, eq=False, repr=False)
class Asymmetry(ShortRepr):
    """Differences of shapes from their mirror images, or of one side from the other.

    Attributes
    ----------
    names : names of the S individuals
    of_mean : root mean square over the surface of the mean difference between the sides
    directional : directional asymmetry: the effect of the side. ``change`` (1, V, 3) and ``along_normal`` (1, V) lead from
        the mirror image to the shape, or from one side to the other; positive where the latter lies further out. F is over
        fluctuating asymmetry, tested by exchanging the sides of individuals (sign flips)
    fluctuating : (V,) fluctuating asymmetry: root mean square deviation of the differences from their mean, per vertex
    error : (V,) root mean square deviation between measurements of one individual; None without repeated measurements
    table : effects of individual and side, with fluctuating asymmetry as the residual. With repeated measurements,
        fluctuating asymmetry is the effect ``individual:side``, tested by exchanging measurements between individuals, and
        errors of measurement are the residual
    total_of : (S,) root mean square difference between the sides of each individual, over the surface
    fluctuating_of : (S,) the same after the mean difference of all individuals is subtracted
    matching : whether left and right shapes were compared, rather than shapes with their mirror images
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
    """Measure asymmetry: compare the shapes of an atlas with their mirror images, or left shapes with right ones.

    The counterpart of a vertex is the nearest point of the mean's mirror image, so a common displacement along the surface
    does not count as directional asymmetry. Left and right shapes are compared vertex by vertex.

    Parameters
    ----------
    atlas
        Atlas of shapes that are nearly symmetric, such as heads; or, with ``sides``, of left and right shapes, such as
        femurs, superimposed as mirror images. Only variation within the modes counts.
    table
        Data of the shapes, as for `Atlas.anova`.
    individuals
        A column: shapes with the same value are repeated measurements of one individual. Without it, each shape is an
        individual.
    sides
        A column of two values, such as left and right. Each individual has equally many shapes of both, which are paired
        in the order of their names.
    kind
        What to test at vertices: displacement along the mean's normal ("normal") or in any direction ("hotelling").
    permutations
        Number of permutations; all possible ones are used if there are no more.
    seed
        Random seed of the permutations.

    Returns
    -------
    Asymmetry
        In the frame and unit of the atlas.

    Raises
    ------
    InputError
        The mean is not nearly symmetric, or a column is missing or does not give pairs.
    OptionError
        ``sides`` without ``individuals``.

    Examples
    --------
    >>> found = meshmatch.measure_asymmetry(meshmatch.Atlas.load("atlas"))
    >>> print(found.directional.p, found.fluctuating_of)
    """
    known = covariates(table, atlas.names, atlas.sizes)
    labels = atlas.names if individuals is None else _cells(known, individuals)
    if sides is None:
        given = _pair_with_images(atlas, labels, seed)
    elif individuals is not None:
        given = _pair_sides(atlas, labels, sides, _cells(known, sides))
    else:
        raise OptionError("sides are of individuals", "give the column that names individuals")
    names, owner, pairs = given.names, given.owner, given.points
    if len(names) < 3:
        raise InputError(f"{len(names)} individuals are too few", "three or more are needed")
    weights, counts = atlas.weights, np.bincount(owner)
    means = np.add.reduceat(pairs, np.cumsum(counts) - counts) / counts[:, None, None, None]

    def analysed(offsets: Floats, terms: list[DesignTerm], blocks: Ints | None) -> Variances:
        flat = (offsets * np.sqrt(weights)[:, None]).reshape(len(offsets), -1)
        size, sides = np.linalg.eigh(flat @ flat.T)
        flat = sides * np.sqrt(np.maximum(size, 0))
        normals, along = given.reference.vertex_normals, kind == "normal"
        return analyse(
            flat, offsets, terms, normals, along=along, blocks=blocks, permutations=permutations, seed=seed
        )  # fmt: skip

    both = means.reshape(-1, *given.reference.verts.shape) - given.reference.verts
    individual = np.repeat(np.arange(len(names)), 2)
    side = DesignTerm("side", np.tile([[1.0], [0.0]], (len(names), 1)), (given.side,))
    found, error = analysed(both, [_term(individual, names), side], individual), None
    if len(owner) > len(names):
        differences, within = pairs[:, 0] - pairs[:, 1], pairs - means[owner]
        measured = analysed(differences - differences.mean(axis=0), [_term(owner, names)], None)
        scatter = float(np.square(within).sum(axis=(0, 1, 3)) @ weights)
        found = _add_error(found, measured.effects[0], scatter, counts)
        error = set_read_only(_spread(within[:, 0] - within[:, 1], len(owner) - len(names)))
    differences = means[:, 0] - means[:, 1]
    deviations = differences - differences.mean(axis=0)
    return Asymmetry(
        names=names,
        of_mean=_rms(differences.mean(axis=0), weights) if given.of_mean is None else given.of_mean,
        directional=found.effects[1],
        fluctuating=set_read_only(_spread(deviations, len(names) - 1)),
        error=error,
        table=found,
        total_of=set_read_only(np.array([_rms(each, weights) for each in differences])),
        fluctuating_of=set_read_only(np.array([_rms(each, weights) for each in deviations])),
        matching=sides is not None,
    )


@dataclass(frozen=True, eq=False)
class _Pairs:
    """M measurements of both sides of individuals, sorted by individual.

    ``points`` (M, 2, V, 3) are aligned with ``reference``; ``owner`` (M,) indexes ``names``, those of the individuals.
    ``side`` names the difference, the first of each pair less the second. ``of_mean`` is the rms distance of the mean from
    its mirror image, None for left and right shapes.
    """

    names: tuple[str, ...]
    owner: Int[Ints, " M"]
    points: Float[Floats, "M 2 V 3"]
    reference: Shape
    side: str
    of_mean: float | None = None


def _pair_with_images(atlas: Atlas, labels: Sequence[str], seed: int) -> _Pairs:
    """Pair the shapes with their mirror images; `InputError` if the mean is not nearly symmetric."""
    if atlas.groups is not None:
        raise InputError("symmetry is of whole shapes, and parts were superimposed", "make an atlas of whole shapes")
    mean, weights = atlas.mean_shape, atlas.weights
    mirror = _MirrorMap(mean, weights, seed)
    image = Superimposed(mean.verts, weights, None).align(mirror.image(mean.verts)[None])[0]
    of_mean = _rms(mean.verts - image, weights)
    if of_mean > _MAX_ASYMMETRY * np.sqrt(mean.area):
        raise InputError(
            f"the mean is no mirror image of itself: they are {of_mean:.3g} apart on average",
            "to compare left shapes with right ones, give the columns that name sides and individuals",
        )
    reference = Superimposed((mean.verts + image) / 2, weights, None)
    names, owner, order = _number_individuals(labels)
    own = reference.align((atlas.mean + atlas.offsets(atlas.scores))[order])
    points = np.stack([own, own - np.stack([_difference_from_image(each, mirror, reference) for each in own])], axis=1)
    return _Pairs(names, owner[order], points, Shape(reference.consensus, mean.faces), "side", of_mean)


def _pair_sides(atlas: Atlas, labels: Sequence[str], column: str, cells: Sequence[str]) -> _Pairs:
    """Pair the shapes of one side with those of the other of the same individuals; `InputError` if there are no pairs."""
    levels = sorted(set(cells))
    if len(levels) != 2:
        raise InputError(
            f"{column} has {len(levels)} values ({shorten_names(levels)})", "two are needed, such as left and right"
        )
    names, owner, order = _number_individuals(labels)
    second = np.array([cell == levels[1] for cell in cells], bool)
    rows = [order[second[order] == one] for one in (True, False)]
    if not np.array_equal(*(owner[each] for each in rows)):
        unlike = np.bincount(owner[second], minlength=len(names)) != np.bincount(owner[~second], minlength=len(names))
        raise InputError(
            f"{shorten_names([names[k] for k in np.flatnonzero(unlike)])}: not as many {levels[1]} as {levels[0]} ones",
            "each individual needs both; --leave-out (`leave_out`) leaves out shapes",
        )
    points = (atlas.mean + atlas.offsets(atlas.scores))[np.stack(rows, axis=1)]
    return _Pairs(names, owner[rows[0]], points, atlas.mean_shape, f"{column}: {levels[1]} - {levels[0]}")


def _cells(known: Covariates, column: str) -> tuple[str, ...]:
    """The cells of a column; `InputError` if any is missing."""
    lacking = known.missing(column)
    if lacking.any():
        names = shorten_names([known.names[k] for k in np.flatnonzero(lacking)])
        raise InputError(f"{names}: {column} is missing", "fill it in, or leave these shapes out of the atlas")
    return known.column(column)


def _number_individuals(labels: Sequence[str]) -> tuple[tuple[str, ...], Int[Ints, " M"], Int[Ints, " M"]]:
    """The distinct labels, the number of each label among them, and an order that sorts the labels by individual."""
    numbers = {label: k for k, label in enumerate(dict.fromkeys(labels))}
    owner = np.array([numbers[label] for label in labels])
    return tuple(numbers), owner, np.argsort(owner, kind="stable")


def _term(owner: Int[Ints, " S"], names: tuple[str, ...]) -> DesignTerm:
    """The term of the individuals, coded by indicators of all but the first."""
    return DesignTerm("individual", np.eye(len(names))[owner][:, 1:], names[1:])


def _add_error(given: Variances, tested: Effect, scatter: float, counts: Int[Ints, " N"]) -> Variances:
    """Extend the table of the individuals' means: fluctuating asymmetry becomes an effect, errors become the residual.

    ``tested`` has the tests of fluctuating asymmetry, and ``scatter`` is the sum of squares of measurements about the
    means. Where individuals have different numbers of measurements, ``counts``, their means count equally (unweighted
    means: Yates, J. Am. Stat. Assoc. 29 (1934)).
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


def _difference_from_image(
    own: Float[Floats, "V 3"], mirror: _MirrorMap, reference: Superimposed
) -> Float[Floats, "V 3"]:
    """The difference of a shape from its mirror image, both aligned with a symmetric reference.

    Interpolation between vertices puts the image slightly inside wherever the surface is curved. This error has the same
    sign on both sides of the plane of symmetry, while a true difference changes its sign. Half the difference of the two
    sides is therefore free of it.
    """
    image = mirror.image(own)
    pose = reference.poses(image[None])
    differences = own - pose.apply(image[None])[0]
    return np.asarray((differences - mirror.image(differences) @ pose.rotations[0, 0].T) / 2)


class _MirrorMap:
    """The point of the mean's surface that lies across the plane of symmetry from each vertex."""

    def __init__(self, mean: Shape, weights: Float[Floats, " V"], seed: int) -> None:
        image = aligned_mirror_image(mean, seed)
        self._faces = image.faces
        normals = mean.vertex_normals
        for _ in range(_ROUNDS):
            self._footpoints: Footpoints = MappedMesh.of(image).query(mean.verts, normals)
            # Point-to-plane ICP: the image may slide along the tangent planes.
            near = self._footpoints.values(image.faces, image.verts)
            turns = np.concatenate([np.cross(near, normals), normals], axis=1) * np.sqrt(weights)[:, None]
            differences = np.einsum("vi,vi->v", mean.verts - near, normals) * np.sqrt(weights)
            step = np.linalg.lstsq(turns, differences, rcond=1e-6)[0]
            pose = kabsch(near, near + np.cross(step[:3], near) + step[3:], weights)
            image = Shape(pose.to_world(image.verts), image.faces)

    def image(self, verts: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
        """Mirror a shape, or displacements, in the plane x = 0, and resample it in the order of the original vertices."""
        return self._footpoints.values(self._faces, verts * [-1.0, 1.0, 1.0])


def _rms(offsets: Float[Floats, "V 3"], weights: Float[Floats, " V"]) -> float:
    """Root mean square length over the surface."""
    return float(np.sqrt(weights @ np.square(offsets).sum(axis=1)))


def _spread(offsets: Float[Floats, "N V 3"], df: int) -> Float[Floats, " V"]:
    """Root mean square length at each vertex, with ``df`` degrees of freedom."""
    return np.asarray(np.sqrt(np.square(offsets).sum(axis=(0, 2)) / df))
