"""Collections of shapes of one kind: each is fitted once, the fits agree jointly, and maps between any two are looked up."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.api.results import MapPair
from meshmatch.arrays import Float, Floats
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.export import Export, Exported, Fits, Place, export
from meshmatch.collections.fit_all import Fitted, elsewhere_messages, file_table, fit_all, fit_all_kinds, with_left_out
from meshmatch.collections.folder import FitsFolder
from meshmatch.collections.map_all import Pair, map_all
from meshmatch.collections.named_parts import WHOLE, Masks, parts_of_template
from meshmatch.collections.registered import Registered, load_points, match_names
from meshmatch.collections.select_setting import select_setting
from meshmatch.collections.setting import Record, Setting, clear_caches, read_template
from meshmatch.collections.sources import find_sources, frame_times, sort_by_sequence
from meshmatch.collections.stores import Store
from meshmatch.collections.superimpose import Scale, superimpose
from meshmatch.collections.workers import open_workers
from meshmatch.errors import InputError, warn
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.build import map_between_fits
from meshmatch.maps.files import check_suffix
from meshmatch.maps.places import Places
from meshmatch.maps.unfold_pair import unfold_both
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import AUTO, NO_MODEL
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.templates.prepared_folder import RegisteredShapes
from meshmatch.templates.template import Template


class Collection(FitsFolder):
    """A folder of fits of shapes of one kind, which `fit` fills.

    Fits are read on demand, and recently used ones are cached. Everything but `fit` raises `InputError` if the folder has
    no fits.

    Parameters
    ----------
    folder
        Path or URL.
    workers
        Number of processes, by default one per core; or the address of a Dask scheduler.
    progress
        Called with the stage, the folder and the completed share of the stage (0..1).

    Examples
    --------
    >>> collection = meshmatch.Collection("fits")
    >>> collection.fit(["templates/samples/climber.ply", "templates/samples/dancer.ply"], model="human")
    >>> collection.map("climber", "dancer").index
    """

    def __init__(
        self, folder: str | Path, workers: int | str | None = None, progress: ProgressCallback | None = None
    ) -> None:
        super().__init__(folder)
        self.workers = workers
        self.progress = progress

    def __getstate__(self) -> dict[str, Any]:
        return {"store": self.store, "workers": self.workers, "progress": None}

    def __repr__(self) -> str:
        return f"Collection({self.store.location!r})"

    def fit(
        self,
        shapes: str | Path | Sequence[str | Path],
        *,
        model: str | Path = AUTO,
        config: FitConfig | None = None,
        only: Sequence[str] = (),
        without: Sequence[str] = (),
        sequence: bool = False,
        agree: bool = True,
        tell: Callable[[Record], None] | None = None,
    ) -> Fitted:
        """Fit every shape once, then refine all fits jointly so that the template stretches alike (the agreement).

        With the model "none" the template is made of the shapes, which are of one kind, in any pose: one of them is
        fitted to all others, and then their mean, twice. Mirror images and cut shapes are found. There is no agreement,
        and five fits or more are judged by comparison. An interrupted run can be continued, with the same result bit for
        bit. Shapes fitted before stay in the collection while their files exist; only new ones are fitted. A shape that
        cannot be read or fitted gets a record and does not stop the others.

        Parameters
        ----------
        shapes
            Files, folders, patterns such as ``scans/*.ply``, or URLs of folders.
        model
            Name, folder, "auto" or "none". With "auto" the first shape decides; shapes of other kinds for which a model
            is installed are fitted with that model, in a subfolder named after the kind.
        config
            Options of all fits.
        only
            As in `load_shape`.
        without
            As in `load_shape`.
        sequence
            The shapes of a folder are frames, in the natural order of their names, and each fit starts from that of the
            previous frame.
        agree
            Whether to run the agreement.
        tell
            Called with the record of each shape: with a model as soon as it is fitted, before the agreement; without one
            when all are judged.

        Returns
        -------
        Fitted
            The result for each shape.

        Raises
        ------
        MeshmatchError
            There is no shape, two have the same name, none could be fitted, the fits in the folder were made with
            another model or other options, or another process writes to the folder.
        """
        given, left_out = find_sources(shapes, self.store)
        chosen, left = ((each,) if isinstance(each, str) else tuple(each) for each in (only, without))
        requested = Setting(self.store, str(model), config or FitConfig(), chosen, left, sequence)
        with self.store.exclusive(), open_workers(self.workers) as workers:
            setting = select_setting(requested, sources := self._with_earlier(given))
            if model == AUTO:
                fitted = fit_all_kinds(setting, requested, sources, workers, agree, self.progress, tell)
            else:
                fitted = fit_all(setting, sources, workers, agree, self.progress, tell)
            fitted = with_left_out(fitted, self.store, left_out)
        clear_caches()
        return fitted

    @property
    def names(self) -> list[str]:
        """Names of the fitted shapes, sorted; without those of another kind, whose fits are in a subfolder."""
        found = self._fitted
        elsewhere = self._fitted_elsewhere(found)
        left = [name for name in found if name not in elsewhere]
        if not left:
            what = f"{self.store.location} holds no fit of its own kind"
            raise InputError(what, "; ".join(elsewhere_messages(elsewhere)))
        return left

    @property
    def template(self) -> Template:
        """The template of the fits."""
        return read_template(self.store)

    @property
    def model(self) -> str:
        """Name or folder of the model of the fits; "none" if they were made without one."""
        return str(self._manifest()["model"])

    def to_learn(self) -> RegisteredShapes:
        """The fitted shapes as training data for `train`, without poor fits.

        Returns
        -------
        RegisteredShapes
            All shapes with the template's vertices.

        Raises
        ------
        InputError
            Fewer than three fits are left.
        """
        with self.registered() as found:
            name, verts = Path(self.store.location).name, np.array(found.points)
            if self.model != NO_MODEL:
                return RegisteredShapes(self.template, verts, name, self.model)
            mirror = any(self.fit_of(each).frame.mirrored for each in found.names)
            return RegisteredShapes(self.template, verts, name, self.model, "rigid", mirror)

    def fit_of(self, name: str) -> Fit:
        """The finished fit of a shape.

        Parameters
        ----------
        name
            Name of the shape.

        Returns
        -------
        Fit
            It has the places of the shape's vertices, but not the shape: its ``verts`` are empty. It can be passed to
            `Matcher.map`, with the fit of any other shape by the same model.
        """
        return self._read_fit(name)

    def places_of(self, name: str) -> Places:
        """The places of a shape's vertices on the template.

        Parameters
        ----------
        name
            Name of the shape.

        Returns
        -------
        Places
            A point of the template for every vertex of the shape.
        """
        return self._read_fit(name).places

    def map(self, source: str, target: str) -> VertexMap:
        """The map between two shapes, looked up from their fits.

        Parameters
        ----------
        source
            Name of the source.
        target
            Name of the target.

        Returns
        -------
        VertexMap
            From source to target.
        """
        return map_between_fits(self._read_fit(source), self._read_fit(target))

    def maps_between(self, source: ShapeLike, target: ShapeLike) -> MapPair:
        """The maps between two shapes in both directions, together with the shapes, for transfers and `evaluate`.

        The fits are found by the shapes' vertices and faces, also in the subfolders of other kinds.

        Parameters
        ----------
        source
            As in `match`.
        target
            As in `match`.

        Returns
        -------
        MapPair
            Both shapes and both maps.

        Raises
        ------
        InputError
            A shape is not among the fits.
        """
        shapes = as_shape(source, "source"), as_shape(target, "target")
        names = {self._hash_of(name): name for name in self._fitted}
        for other in self._other_kinds():
            if {shape.hash for shape in shapes} <= {other._hash_of(name) for name in other._fitted}:
                return other.maps_between(*shapes)
        for shape in shapes:
            if shape.hash not in names:
                hint = "fit it with `meshmatch fit`; its vertices and faces must be those of the fitted file"
                raise InputError(f"{self.store.location} holds no fit of {shape.name or 'this shape'}", hint)
        a, b = (names[shape.hash] for shape in shapes)
        there, back = self.map(a, b).for_shapes(*shapes), self.map(b, a).for_shapes(*shapes[::-1])
        part = self._metadata(a)["partial"] or self._metadata(b)["partial"]
        there, back = unfold_both(there, back, *shapes, part)
        return MapPair(*shapes, there, opposite=back)

    def holds(self, shape: ShapeLike) -> bool:
        """Whether a shape is among the fits, those of other kinds included; compared by vertices and faces.

        Parameters
        ----------
        shape
            As in `match`.

        Returns
        -------
        bool
            True if `maps_between` would find it.
        """
        digest = as_shape(shape).hash
        return any(digest == each._hash_of(name) for each in (self, *self._other_kinds()) for name in each._fitted)

    def _names_with_warning(self) -> list[str]:
        """Return `names`, with a warning about shapes of another kind."""
        names = self.names
        for text in elsewhere_messages(self._fitted_elsewhere(sorted(set(self._fitted) - set(names)))):
            warn(text)
        return names

    def pairs(self, to: str | None = None) -> list[Pair]:
        """All ordered pairs of names. Shapes of another kind are left out, with a warning.

        Parameters
        ----------
        to
            Name of a target: return only the pairs with this target.

        Returns
        -------
        list of (source, target)
            Names.
        """
        if to is not None:
            self._check(to)
        names = self._names_with_warning()
        if to is None:
            return list(permutations(names, 2))
        return [(name, to) for name in names if name != to]

    def save_maps(self, output: str | Path, pairs: Sequence[Pair] | None = None, *, suffix: str = ".npz") -> int:
        """Write maps, the one from A to B as ``output/A/B`` with the suffix. Maps that are newer than the fits are kept.

        Parameters
        ----------
        output
            A folder.
        pairs
            Pairs of names, by default all.
        suffix
            Chooses the format.

        Returns
        -------
        int
            Number of maps, kept ones included.

        Raises
        ------
        MeshmatchError
            A name or the format is unknown, a shape is of another kind, or the folder cannot be written or is in use by
            another process.
        """
        suffix = f".{suffix.removeprefix('.')}"
        check_suffix(Path(f"map{suffix}"))
        wanted = self.pairs() if pairs is None else list(pairs)
        known = set(self.names)
        for name in (name for pair in wanted for name in pair if name not in known):
            self._check(name)
        maps = Store.of(output)
        with maps.exclusive(), open_workers(self.workers) as workers:
            return map_all(self.store, maps, wanted, suffix, workers, self.progress)

    def export(
        self,
        output: str | Path,
        *,
        suffix: str = "",
        place: Place = "files",
        poor: bool = False,
        original: bool = False,
        values: str | Path | None = None,
        metadata: str | Path | None = None,
        smooth: bool = False,
        cycle: bool = False,
    ) -> Exported:
        """Write the registered meshes (the template fitted to every shape); vertex i is the same point on all of them.

        Parameters
        ----------
        output
            A new folder.
        suffix
            Suffix of one mesh per shape, by default .ply; or .csv or .npz for all coordinates in one file. A .csv has a row
            per shape: x, y and z of vertex 0, then of vertex 1, ... An .npz has ``points`` (S, V, 3), ``faces`` (F, 3),
            ``names``, ``centroid_size`` and ``mirrored`` (S,). Both come with metadata.csv, a row for each shape.
        place
            Coordinates, in the unit of the files: those of the shapes' files ("files"), or all shapes aligned with the
            template's axes and center ("template"), where mirror images are flipped.
        poor
            Whether to include poor fits.
        original
            Write the shapes of the files instead, as .vtp or .vtk, with the signed distance and the displacement of each
            vertex from the mean, and the template's parts.
        values
            A file of values of the template's vertices to add to the originals.
        metadata
            A table with a row for each shape, to add to metadata.csv.
        smooth
            Shapes of a folder are frames: smooth the paths of the vertices in time, along the surfaces.
        cycle
            Smooth in time, as a cycle: the last frame is followed by the first.

        Returns
        -------
        Exported
            What was written.

        Raises
        ------
        MeshmatchError
            The format or place is unknown, no fit is left, the file of an original has changed, or the folder is named
            like a file, is not empty or cannot be written.
        """
        how = Export(suffix, place, original, values, metadata, smooth, cycle).into(output)
        verdicts = {name: str(self._metadata(name)["verdict"]) for name in self._names_with_warning()}
        left_out = tuple(name for name, verdict in verdicts.items() if verdict == "poor" and not poor)
        names = [name for name in verdicts if name not in left_out]
        if not names:
            raise InputError(f"all {len(verdicts)} fits of {self.store.location} are poor", "write them with --poor")
        mean = None
        if original and len(names) > 2:
            with self.registered(poor) as shapes:
                mean = superimpose(shapes.points, shapes.faces)
        in_time = smooth or cycle
        sequence = in_time or bool(self._manifest()["sequence"])
        files: dict[str, str] = {}
        with nullcontext() if original or in_time else suppress(InputError):  # else only for the axes of a glb
            files = file_table(self.store) if original or in_time or how.suffix == ".glb" else {}
        names = sort_by_sequence(names) if sequence else names
        times = frame_times({*files, *names}) if sequence else {}
        fits = Fits(names, self.fit_of, self.places_of, files, self.template, sequence, times)
        return Exported(
            tuple(export(output, fits, how, mean, self.progress)), len(names), fits.template.shape.V, left_out
        )

    def atlas(
        self,
        *,
        modes: int = 100,
        scale: Scale = "keep",
        robust: bool = False,
        poor: bool = False,
        align_by: str = WHOLE,
        leave_out: Sequence[str] = (),
    ) -> Atlas:
        """Build an atlas (mean and modes of variation) of the fitted shapes.

        Parameters
        ----------
        modes
            As in `Atlas.of`.
        scale
            As in `Atlas.of`.
        robust
            As in `Atlas.of`.
        poor
            As in `registered`.
        align_by
            What to superimpose: "whole" shapes; "each" connected part by itself; or one part, given by its number (the
            largest is "1") or by its name in the template or in the files.
        leave_out
            As in `registered`.

        Returns
        -------
        Atlas
            Of all fits that are not left out.
        """
        with self.registered(poor, leave_out) as shapes:
            return shapes.atlas(modes=modes, scale=scale, robust=robust, align_by=align_by)

    @contextmanager
    def registered(self, poor: bool = False, leave_out: Sequence[str] = ()) -> Iterator[Registered]:
        """The registered shapes, as a context: many of them are kept in a temporary file, which the block's end removes.

        Parameters
        ----------
        poor
            Whether to include poor fits.
        leave_out
            Names of shapes to leave out, or one name; * and ? are wildcards.

        Yields
        ------
        Registered
            Points (S, V, 3) in the unit of the files, with the axes of the template.

        Raises
        ------
        InputError
            Fewer than three shapes are left, or a name to leave out matches no shape.
        """
        metadata = {name: self._metadata(name) for name in self._names_with_warning()}
        out = dict.fromkeys(sorted(match_names(metadata, leave_out)), "asked")
        out |= {name: "poor" for name, about in metadata.items() if about["verdict"] == "poor" and not poor}
        names = tuple(name for name in metadata if name not in out)
        if len(names) < 3:
            also = f" and {len(out)} that are left out" if out else ""
            raise InputError(f"{self.store.location} holds {len(names)} fits{also}", "three or more are needed")

        def read(number: int) -> Float[Floats, "V 3"]:
            fit = self.fit_of(names[number])
            return np.asarray(fit.points * fit.frame.scale)

        parts, cut = partial(self._parts, names), tuple(name for name in names if metadata[name]["partial"])
        with load_points(len(names), self.template.shape.V, read) as points:
            yield Registered(points, self.template.shape.faces, names, np.eye(3), out, self.template.hash, parts, cut)

    def _parts(self, names: Sequence[str]) -> Masks:
        return parts_of_template(self.template, names, file_table(self.store), self.places_of)

    def _check(self, name: str) -> None:
        """Raise `InputError` if a name has no fit in the collection, or if its shape is of another kind."""
        self.places_of(name)
        where = self._fitted_elsewhere([name]).get(name)
        if where is not None:
            raise InputError(f"{name} is of another kind", f"its fit is in {where}: map it there")
