"""What a collection of registered shapes has in common, and how they vary: the mean and modes of variation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Brief, Float, Floats, Int, Ints, Pickled, as_numbers, frozen
from meshmatch.collections.atlas_arrays import load_arrays, save_arrays
from meshmatch.collections.covariates import Columns, covariates
from meshmatch.collections.explain import Explained, explain
from meshmatch.collections.groups import Comparison, Statistic, compare_groups
from meshmatch.collections.modes import components, outward
from meshmatch.collections.superimpose import Poses, Scale, Shapes, Superimposed, blocks, superimpose
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.fit import Fit, facing_out
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False, repr=False)
class Projection(Brief):
    """A shape as the atlas sees it.

    ``scores`` (M,) are in standard deviations. ``shape`` is what the modes make of it, and ``distance`` (V,) how far its
    vertices are from there, in the frame and unit of the given points; ``residual`` is the mean of these distances over
    the surface.
    """

    scores: Float[Floats, " M"]
    shape: Shape
    distance: Float[Floats, " V"]
    residual: float


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Atlas(Brief, Pickled):
    """The mean of S registered shapes, and the M modes in which they vary.

    Attributes
    ----------
    mean
        (V, 3) the mean shape, in the unit of the shapes; the center of its surface is the origin, its axes are the
        shapes'.
    modes
        (M, V, 3) the modes, largest variance first; orthonormal in the mean product over the surface.
    deviations
        (M,) standard deviations along the modes: root mean square displacements, in the unit of the shapes.
    scores
        (S, M) of each shape along each mode, in standard deviations.
    sizes
        (S,) root mean square distance of each shape from its center (of what was superimposed, from its own centers),
        before it was scaled, unit of its file.
    faces
        (F, 3) triangles of all shapes.
    weights
        (V,) share of the surface around each vertex.
    names
        Of the shapes.
    total
        Variance along all modes, also those that are not kept.
    scale
        Whether the shapes keep their sizes ("keep"), or all were scaled to one ("remove").
    robust
        Whether the mean and modes resist outliers.
    template
        Hash of the template whose fits the shapes are; empty if not known.
    groups
        (V,) vertices of one number from 0 were superimposed together, each group for itself, and those of -1 with group 0,
        without a say; None where whole shapes were.

    Examples
    --------
    >>> base = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> atlas = meshmatch.Atlas.of([base.verts * [1, height, 1] for height in (0.9, 1.0, 1.2)], base.faces)
    >>> taller = atlas.shape([1.5])  # 1.5 standard deviations along the first mode
    """

    mean: Float[Floats, "V 3"]
    modes: Float[Floats, "M V 3"]
    deviations: Float[Floats, " M"]
    scores: Float[Floats, "S M"]
    sizes: Float[Floats, " S"]
    faces: Int[Ints, "F 3"]
    weights: Float[Floats, " V"]
    names: tuple[str, ...]
    total: float
    scale: Scale = "keep"
    robust: bool = False
    template: str = ""
    groups: Int[Ints, " V"] | None = None

    @classmethod
    def of(
        cls,
        points: Shapes,
        faces: Int[Ints, "F 3"],
        names: Sequence[str] | None = None,
        *,
        modes: int = 100,
        scale: Scale = "keep",
        robust: bool = False,
        template: str = "",
        groups: ArrayLike | None = None,
    ) -> Atlas:
        """The atlas of S shapes with the same vertices and faces.

        The shapes are aligned by rotation and translation (generalised Procrustes analysis, each vertex weighted with
        its share of the surface). Only some shapes are in memory at a time, beside the modes and, of up to 3,000
        shapes, an S x S matrix.

        Parameters
        ----------
        points
            (S, V, 3), which may be a list, also of `Shape`, or a memory-mapped array.
        faces
            (F, 3).
        names
            One for each shape, all different.
        modes
            Largest number of modes to keep, of S - 1.
        scale
            "keep" or "remove": scale all shapes to one size.
        robust
            The mean is the spatial median, the modes are spherical principal components (Locantore et al. 1999), which
            a few outliers hardly change.
        template
            Hash of the template whose fits the shapes are.
        groups
            (V,) of shapes of several parts, which vertices are superimposed together: 0 for those of one part and -1 for
            others, whose pose then shows; or 0, 1, 2, ... for each part alone, so that no pose shows. By default all.

        Returns
        -------
        Atlas
            The mean and the modes.

        Raises
        ------
        InputError
            Fewer than three shapes, shapes that do not have the same vertices or do not differ, names that are not one
            for each or not different, groups without surface.
        OptionError
            Another ``scale``, or no modes.
        """
        if scale not in get_args(Scale):
            raise OptionError(f"invalid scale {scale!r}", f"choose one of {', '.join(get_args(Scale))}")
        if modes < 1:
            raise OptionError(f"an atlas has one mode or more, not {modes}")
        if not hasattr(points, "shape"):
            points = [np.asarray(getattr(each, "verts", each)) for each in points]
        called = tuple(names) if names is not None else tuple(f"shape-{k:03d}" for k in range(len(points)))
        if len(called) != len(points) or len(set(called)) < len(called):
            raise InputError(f"{len(points)} shapes need as many different names", "one for each, in their order")
        faces = np.array(faces, np.int64)
        laid = superimpose(points, faces, scale, robust, groups)
        found = components(points, laid, modes, robust)
        mean = laid.consensus + found.center
        sign = outward(found.modes, mean, laid.weights)
        kept, scores = sign[:, None, None] * found.modes, sign * found.scores
        sizes = np.concatenate([laid.poses(some).sizes for _, some in blocks(points)])
        for array in (mean, kept, found.deviations, scores, sizes, faces, laid.weights):
            frozen(array)
        return cls(
            mean=mean, modes=kept, deviations=found.deviations, scores=scores, sizes=sizes, faces=faces,
            weights=laid.weights, names=called, total=found.total, scale=scale, robust=robust, template=template,
            groups=None if laid.groups is None else frozen(laid.groups),
        )  # fmt: skip

    @property
    def variances(self) -> Float[Floats, " M"]:
        """(M,) variances along the modes, in squared units of the shapes."""
        return np.square(self.deviations)

    @property
    def compactness(self) -> Float[Floats, " M"]:
        """(M,) share of all variance that the first modes explain, for one mode, two, ..."""
        return np.asarray(np.cumsum(self.variances) / self.total)

    @property
    def distances(self) -> Float[Floats, " S"]:
        """(S,) root mean square distance of each shape from the mean over the surface, as far as the modes have it."""
        return np.asarray(np.sqrt(np.square(self.scores * self.deviations).sum(axis=1)))

    @cached_property
    def mean_shape(self) -> Shape:
        """The mean as a shape."""
        return Shape(self.mean, self.faces, "mean")

    @cached_property
    def laid(self) -> Superimposed:
        """How further shapes are laid over the mean."""
        size = float(self.sizes.mean()) if self.scale == "remove" else None
        return Superimposed(self.mean, self.weights, size, self.groups)

    def offsets(self, scores: Float[Floats, "N M"]) -> Float[Floats, "N V 3"]:
        """What scores add to the mean.

        Parameters
        ----------
        scores
            (N, M) in standard deviations; of fewer than all modes, the first.

        Returns
        -------
        (N, V, 3)
            Displacements, in the unit of the shapes.
        """
        count = scores.shape[-1]
        return np.asarray(np.tensordot(scores * self.deviations[:count], self.modes[:count], 1))

    def shape(self, scores: ArrayLike) -> Shape:
        """The shape with these scores.

        Parameters
        ----------
        scores
            (M,) in standard deviations; modes that are not given count as 0.

        Returns
        -------
        Shape
            In the unit of the shapes.

        Raises
        ------
        InputError
            More scores than modes, or scores that are not finite.
        """
        given = as_numbers(scores, "scores", finite=True)
        if given.ndim != 1 or len(given) > len(self.modes):
            raise InputError(f"scores must be up to {len(self.modes)} numbers, not an array of {given.shape}")
        return Shape(self.mean + self.offsets(given[None])[0], self.faces)

    def sample(self, count: int, seed: int = 0) -> list[Shape]:
        """Random shapes, their scores drawn from a normal distribution.

        Parameters
        ----------
        count
            How many.
        seed
            The same seed gives the same shapes, whatever the count.

        Returns
        -------
        list of Shape
            In the unit of the shapes.
        """
        if count < 0:
            raise OptionError(f"cannot make {count} shapes")
        draws = np.random.default_rng(seed).standard_normal((count, len(self.modes)))
        offsets = (self.offsets(row[None])[0] for row in draws)
        return [Shape(self.mean + each, self.faces, f"sample-{k:03d}") for k, each in enumerate(offsets)]

    def align(self, points: Float[Floats, "N V 3"]) -> tuple[Float[Floats, "N V 3"], Poses]:
        """Lay shapes over the mean.

        Parameters
        ----------
        points
            (N, V, 3).

        Returns
        -------
        (N, V, 3), Poses
            The shapes as they lie then, and how they were moved.
        """
        poses = self.laid.poses(points)
        return poses.apply(points), poses

    def project(self, points: ArrayLike | Fit) -> Projection:
        """A further shape, registered like the others: its scores, and what the modes cannot express.

        Parameters
        ----------
        points
            The template's vertices (V, 3) on the shape, or a fit.

        Returns
        -------
        Projection
            Of a fit, in the frame and unit of the shape's file.

        Raises
        ------
        InputError
            The points are not an array (V, 3), or not finite.
        OptionError
            The fit is of another template.
        """
        if isinstance(points, Fit):
            if self.template:
                points.check_template(self.template)
            frame, scale = points.frame, points.frame.scale
            found = self.project(scale * points.points)  # as the mirror image that the template knows, if it is one
            verts = frame.undo(found.shape.verts / scale)
            return replace(found, shape=Shape(verts, facing_out(self.faces, frame)))
        given = as_numbers(points, "points", finite=True)
        if given.shape != self.mean.shape:
            hint = "register the shape with the model of the atlas"
            raise InputError(f"points must be an array of {self.mean.shape}, not {given.shape}", hint)
        aligned, poses = self.align(given[None])
        offset = aligned[0] - self.mean
        raw = np.einsum("mvi,v,vi->m", self.modes, self.weights, offset, optimize=True)
        scores = raw / self.deviations
        back = poses.undo((self.mean + self.offsets(scores[None])[0])[None])[0]
        distance = np.linalg.norm(back - given, axis=1)
        return Projection(scores, Shape(back, self.faces), distance, float(self.weights @ distance))

    def distance_from_mean(self, name: str) -> Float[Floats, " V"]:
        """How far each vertex of a shape of the collection is from the mean, as far as the modes express it.

        Parameters
        ----------
        name
            Name of the shape.

        Returns
        -------
        (V,)
            In the unit of the shapes.

        Raises
        ------
        InputError
            The atlas does not have the name.
        """
        return np.asarray(np.linalg.norm(self.offsets(self.scores[self.rows([name])])[0], axis=1))

    def rows(self, names: Sequence[str]) -> Int[Ints, " N"]:
        """Which shapes have these names.

        Parameters
        ----------
        names
            Names of shapes.

        Returns
        -------
        (N,) int64
            Rows of ``scores``.

        Raises
        ------
        InputError
            The atlas does not have a name.
        """
        known = {name: k for k, name in enumerate(self.names)}
        for name in names:
            if name not in known:
                some = ", ".join(self.names[:5]) + ", ..." * (len(known) > 5)
                raise InputError(f"the atlas has no shape called {name!r}", f"there are {len(known)}: {some}")
        return np.array([known[name] for name in names], np.int64)

    def compare(
        self,
        first: Sequence[str],
        second: Sequence[str],
        *,
        kind: Statistic = "normal",
        permutations: int = 10_000,
        seed: int = 0,
    ) -> Comparison:
        """Where two groups of shapes differ, and whether by more than chance. What the modes do not keep plays no part.

        Parameters
        ----------
        first
            Names of the first group.
        second
            Names of the second group.
        kind
            "normal": displacement along the normal of the mean; "hotelling": in any direction.
        permutations
            How many relabellings the p-values come from.
        seed
            Of the relabellings.

        Returns
        -------
        Comparison
            Differences and p-values for each vertex.

        Raises
        ------
        InputError
            The atlas does not have a name, or both groups have it.
        OptionError
            A group of fewer than two shapes, too few shapes for the statistic, no permutations.
        """
        both = set(first) & set(second)
        if both:
            raise InputError(f"{min(both)!r} is in both groups", "a shape is in one of them")
        rows = [self.rows(tuple(dict.fromkeys(names))) for names in (first, second)]
        chosen = np.concatenate(rows)
        in_second = np.arange(len(chosen)) >= len(rows[0])
        return compare_groups(
            self.offsets(self.scores[chosen]), in_second, self.mean_shape.vertex_normals, self.weights,
            kind=kind, permutations=permutations, seed=seed,
        )  # fmt: skip

    def anova(
        self,
        formula: str,
        table: str | Path | Columns | None = None,
        *,
        blocks: str | None = None,
        kind: Statistic = "normal",
        permutations: int = 10_000,
        seed: int = 0,
    ) -> Explained:
        """How much of the variation of the shapes a linear model explains, and where: Procrustes analysis of variance.

        Sums of squares are sequential: each term is given those before it. What the modes do not keep plays no part.

        Parameters
        ----------
        formula
            ``"shape ~ log(size) + sex * age"``, or ``"form ~ ..."`` of an atlas that keeps sizes. Names are columns of the
            table; ``size`` is ``sizes`` unless there is such a column; ``factor()`` takes numbers for
            categories; ``a * b`` is ``a + b + a:b``.
        table
            A file (.csv, .tsv, .txt) or columns by name, such as a data frame. A column ``name``, else a file's first one,
            names the shapes; columns without it are in the order of ``names``.
        blocks
            A column: shapes are exchanged only where its value is the same, as for repeated measures.
        kind
            What is tested at vertices. "normal": displacement along the normal of the mean; "hotelling": in any direction.
        permutations
            How many permutations the p-values come from.
        seed
            Of the permutations.

        Returns
        -------
        Explained
            The table of variances, with a map of each effect; and how shape goes with size, if the model has it.

        Raises
        ------
        InputError
            A shape has no row, a column is missing or says nothing, shapes are too few.
        OptionError
            The formula is none, or is of shapes with sizes where the atlas has none, or the other way round.
        """
        return explain(
            formula,
            covariates(table, self.names, self.sizes),
            self.scores * self.deviations,
            lambda points: self.offsets(points / self.deviations),
            self.mean_shape.vertex_normals,
            self.scale,
            blocks=blocks,
            kind=kind,
            permutations=permutations,
            seed=seed,
        )

    def save(self, path: str | Path) -> None:
        """Write ``atlas.npz``: the attributes as arrays, and the version.

        Parameters
        ----------
        path
            Where to.

        Raises
        ------
        OutputError
            It cannot be written.
        """
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        save_arrays(path, {name: np.asarray(array) for name, array in arrays.items() if array is not None})

    @classmethod
    def load(cls, path: str | Path) -> Atlas:
        """Read an atlas.

        Parameters
        ----------
        path
            The folder that ``meshmatch atlas`` made, or its ``atlas.npz``.

        Returns
        -------
        Atlas
            As it was saved.

        Raises
        ------
        InputError
            There is none, or it is damaged or of another version.
        """
        return cls(**load_arrays(path, [each.name for each in fields(cls)]))
