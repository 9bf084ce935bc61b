"""Statistical shape models (atlases): the mean of registered shapes and their modes of variation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats, Int, Ints, PickledFields, ShortRepr, as_numbers, set_read_only
from meshmatch.collections.atlas_arrays import load_arrays, save_arrays
from meshmatch.collections.covariates import Columns, covariates
from meshmatch.collections.explain import Explained, explain
from meshmatch.collections.groups import Comparison, Statistic, compare_groups
from meshmatch.collections.modes import compute_modes, outward_signs
from meshmatch.collections.superimpose import Poses, Scale, Shapes, Superimposed, iter_blocks, superimpose
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.fit import Fit, facing_out
from meshmatch.scalars import check_seed, is_integer
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False, repr=False)
class Projection(ShortRepr):
    """A shape projected onto the modes of an atlas.

    ``scores`` (M,) are in standard deviations. ``shape`` is the reconstruction from the scores, and ``distance`` (V,) the
    distance of each vertex from it, in the frame and unit of the given points; ``residual`` is the mean distance over the
    surface.
    """

    scores: Float[Floats, " M"]
    shape: Shape
    distance: Float[Floats, " V"]
    residual: float


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Atlas(ShortRepr, PickledFields):
    """The mean of S registered shapes, and the M modes in which they vary.

    Attributes
    ----------
    mean
        (V, 3) the mean shape, in the unit of the shapes. The origin is the center of its surface; the axes are those of the
        first shape.
    modes
        (M, V, 3) the modes, largest variance first; orthonormal in the inner product that averages over the surface.
    deviations
        (M,) standard deviations along the modes: root mean square displacements, in the unit of the shapes.
    scores
        (S, M) scores of each shape along each mode, in standard deviations.
    sizes
        (S,) root mean square distance of each shape from its center, before scaling, in the unit of its file. Where parts
        were superimposed: of their vertices, each from the center of its part.
    faces
        (F, 3) triangles of all shapes.
    weights
        (V,) share of the surface around each vertex.
    names
        Names of the shapes.
    total
        Variance along all modes, including those that are not kept.
    scale
        Whether the shapes keep their sizes ("keep") or are scaled to the same size ("remove").
    robust
        Whether the mean and modes resist outliers.
    template
        Hash of the template, if the shapes are fits; empty if not known.
    groups
        (V,) groups of vertices, from 0; each group was superimposed on its own. Vertices of -1 moved with group 0 but did
        not count. None if whole shapes were superimposed.

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
        """Build the atlas of S shapes with the same vertices and faces.

        The shapes are aligned by rotation and translation (generalised Procrustes analysis, each vertex weighted with
        its share of the surface). Shapes are read in blocks; only the modes and, for up to 3,000 shapes, an S x S matrix
        stay in memory.

        Parameters
        ----------
        points
            (S, V, 3): an array, which may be memory-mapped, or a list of arrays or of `Shape`.
        faces
            (F, 3) triangles.
        names
            A different name for each shape.
        modes
            Largest number of modes to keep, of at most S - 1.
        scale
            "keep" the sizes of the shapes, or "remove" them: scale all shapes to the same size.
        robust
            Use the spatial median as the mean, and spherical principal components as the modes (Locantore et al. 1999);
            a few outliers hardly change these.
        template
            Hash of the template, if the shapes are fits.
        groups
            (V,) how to superimpose shapes of several parts; by default as a whole. 0 for one part and -1 for the others: by
            that part, so that the poses of the others vary. 0, 1, 2, ...: each part on its own, so that no pose varies.

        Returns
        -------
        Atlas
            The mean and the modes.

        Raises
        ------
        InputError
            Fewer than three shapes, shapes that differ in their vertices or are all the same, names that are missing or
            repeated, or groups without surface.
        OptionError
            Unknown ``scale``, or fewer than one mode.
        """
        if scale not in get_args(Scale):
            raise OptionError(f"invalid scale {scale!r}", f"choose one of {', '.join(get_args(Scale))}")
        if not is_integer(modes, 1):
            raise OptionError(f"an atlas has one mode or more, not {modes!r}")
        if not hasattr(points, "shape"):
            points = [np.asarray(getattr(each, "verts", each)) for each in points]
        shape_names = tuple(names) if names is not None else tuple(f"shape-{k:03d}" for k in range(len(points)))
        if len(shape_names) != len(points) or len(set(shape_names)) < len(shape_names):
            raise InputError(f"{len(points)} shapes need as many different names", "one for each, in their order")
        faces = np.array(faces, np.int64)
        alignment = superimpose(points, faces, scale, robust, groups)
        found = compute_modes(points, alignment, modes, robust)
        mean = alignment.consensus + found.center
        sign = outward_signs(found.modes, mean, alignment.weights)
        signed_modes, scores = sign[:, None, None] * found.modes, sign * found.scores
        sizes = np.concatenate([alignment.poses(some).sizes for _, some in iter_blocks(points)])
        for array in (mean, signed_modes, found.deviations, scores, sizes, faces, alignment.weights):
            set_read_only(array)
        return cls(
            mean=mean, modes=signed_modes, deviations=found.deviations, scores=scores, sizes=sizes, faces=faces,
            weights=alignment.weights, names=shape_names, total=found.total, scale=scale, robust=robust, template=template,
            groups=None if alignment.groups is None else set_read_only(alignment.groups),
        )  # fmt: skip

    @property
    def variances(self) -> Float[Floats, " M"]:
        """(M,) variances along the modes, in squared units of the shapes."""
        return np.square(self.deviations)

    @property
    def compactness(self) -> Float[Floats, " M"]:
        """(M,) share of the total variance that the first 1, 2, ..., M modes explain."""
        return np.asarray(np.cumsum(self.variances) / self.total)

    @property
    def distances(self) -> Float[Floats, " S"]:
        """(S,) root mean square distance of each shape from the mean over the surface, within the modes."""
        return np.asarray(np.sqrt(np.square(self.scores * self.deviations).sum(axis=1)))

    @cached_property
    def mean_shape(self) -> Shape:
        """The mean as a shape."""
        return Shape(self.mean, self.faces, "mean")

    @cached_property
    def laid(self) -> Superimposed:
        """The superimposition that aligns further shapes with the mean."""
        size = float(self.sizes.mean()) if self.scale == "remove" else None
        return Superimposed(self.mean, self.weights, size, self.groups)

    def offsets(self, scores: Float[Floats, "N M"]) -> Float[Floats, "N V 3"]:
        """Displacements of the mean by scores.

        Parameters
        ----------
        scores
            (N, M) in standard deviations; fewer columns than modes are those of the first modes.

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
            (M,) in standard deviations; missing ones are 0.

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
        """Draw random shapes, with scores from a standard normal distribution.

        Parameters
        ----------
        count
            Number of shapes.
        seed
            Random seed. A larger count with the same seed adds shapes to the same ones.

        Returns
        -------
        list of Shape
            In the unit of the shapes.
        """
        if not is_integer(count, 0):
            raise OptionError(f"cannot make {count!r} shapes")
        check_seed(seed)
        draws = np.random.default_rng(seed).standard_normal((count, len(self.modes)))
        offsets = (self.offsets(row[None])[0] for row in draws)
        return [Shape(self.mean + each, self.faces, f"sample-{k:03d}") for k, each in enumerate(offsets)]

    def align(self, points: Float[Floats, "N V 3"]) -> tuple[Float[Floats, "N V 3"], Poses]:
        """Align shapes with the mean, by least squares.

        Parameters
        ----------
        points
            (N, V, 3) vertices of the shapes.

        Returns
        -------
        (N, V, 3), Poses
            The aligned shapes, and the transformations that were applied.
        """
        poses = self.laid.poses(points)
        return poses.apply(points), poses

    def project(self, points: ArrayLike | Fit) -> Projection:
        """Project a further shape, registered like the others, onto the modes.

        Parameters
        ----------
        points
            The vertices (V, 3) of the registered shape, or a fit.

        Returns
        -------
        Projection
            Its scores, and its distance from what the modes express. For a fit, in the frame and unit of the shape's file.

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
            found = self.project(scale * points.points)  # in the template's handedness, if the shape is a mirror image
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
        """Distance of each vertex of one of the shapes from the mean, within the modes.

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
            The atlas has no shape of this name.
        """
        return np.asarray(np.linalg.norm(self.offsets(self.scores[self.rows([name])])[0], axis=1))

    def rows(self, names: Sequence[str]) -> Int[Ints, " N"]:
        """Rows of the shapes with these names.

        Parameters
        ----------
        names
            Names of shapes, or one name.

        Returns
        -------
        (N,) int64
            Rows of ``scores``.

        Raises
        ------
        InputError
            The atlas has no shape of one of the names.
        """
        known = {name: k for k, name in enumerate(self.names)}
        names = [names] if isinstance(names, str) else names
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
        """Test where two groups of shapes differ (permutation tests); only variation within the modes counts.

        Parameters
        ----------
        first
            Names of the first group, two or more.
        second
            Names of the second group, two or more.
        kind
            What to test at vertices: displacement along the mean's normal ("normal") or in any direction ("hotelling").
        permutations
            Number of permutations of the group labels.
        seed
            Random seed of the permutations.

        Returns
        -------
        Comparison
            Differences and p-values for each vertex.

        Raises
        ------
        InputError
            The atlas has no shape of one of the names, or a name is in both groups.
        OptionError
            A group of fewer than two shapes, too few shapes for the statistic, or no permutations.
        """
        groups = [dict.fromkeys([names] if isinstance(names, str) else names) for names in (first, second)]
        both = groups[0].keys() & groups[1].keys()
        if both:
            raise InputError(f"{min(both)!r} is in both groups", "a shape is in one of them")
        rows = [self.rows(tuple(names)) for names in groups]
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
        """Procrustes analysis of variance: how much of the shapes' variation a linear model explains, and where.

        Sums of squares are sequential: each term is given those before it. Only variation within the modes counts.

        Parameters
        ----------
        formula
            Such as ``"shape ~ log(size) + sex * age"``, or ``"form ~ ..."`` for an atlas that keeps sizes. Names are columns
            of the table; ``size`` is ``sizes`` unless the table has such a column. ``factor()`` treats numbers as
            categories; ``a * b`` means ``a + b + a:b``.
        table
            A file (.csv, .tsv, .txt), or columns by name, such as a data frame. The column ``name``, or else the first one
            of a file, names the shapes; columns without names are in the order of the atlas's ``names``.
        blocks
            A column: only shapes with the same value are exchanged, as for repeated measures.
        kind
            What to test at vertices: displacement along the mean's normal ("normal") or in any direction ("hotelling").
        permutations
            Number of permutations.
        seed
            Random seed of the permutations.

        Returns
        -------
        Explained
            The table of variances, with the effect of each term at the vertices; and the allometry if the model has size.

        Raises
        ------
        InputError
            A shape has no row, a column is missing or constant, or there are too few shapes.
        OptionError
            The formula is invalid, or says "form" for an atlas without sizes or "shape" for one that keeps them.
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
            Path of the file.

        Raises
        ------
        OutputError
            The file cannot be written.
        """
        arrays = {each.name: getattr(self, each.name) for each in fields(self)}
        save_arrays(path, {name: np.asarray(array) for name, array in arrays.items() if array is not None})

    @classmethod
    def load(cls, path: str | Path) -> Atlas:
        """Read an atlas.

        Parameters
        ----------
        path
            A folder written by ``meshmatch atlas``, or its ``atlas.npz``.

        Returns
        -------
        Atlas
            The saved atlas.

        Raises
        ------
        InputError
            The file is missing, damaged or of another version.
        """
        return cls(**load_arrays(path, [each.name for each in fields(cls)]))
