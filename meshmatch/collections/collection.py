"""Many shapes of one kind: each fitted once, all agreeing on how the template stretches, and a map of any two by look-up."""

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
from meshmatch.collections.fit_all import Fitted, elsewhere_words, files_of, fit_all, fit_all_kinds, with_left_out
from meshmatch.collections.folder import FitsFolder
from meshmatch.collections.map_all import Pair, map_all
from meshmatch.collections.named_parts import WHOLE, Masks, parts_of_template
from meshmatch.collections.registered import Registered, held, matching
from meshmatch.collections.setting import Record, Setting, forget, template_at
from meshmatch.collections.settle import settled
from meshmatch.collections.sources import find_sources, frame_times, in_sequences
from meshmatch.collections.stores import Store
from meshmatch.collections.superimpose import Scale, superimpose
from meshmatch.collections.workers import hired
from meshmatch.errors import InputError, warn
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.build import map_of_placed
from meshmatch.maps.files import check_suffix
from meshmatch.maps.places import Places
from meshmatch.maps.unfold_pair import both_unfolded
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import AUTO, NO_MODEL
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.templates.prepared_folder import RegisteredShapes
from meshmatch.templates.template import Template


class Collection(FitsFolder):
    """A folder of fits of shapes of one kind; `fit` fills it.

    Fits are read when they are asked for, and some are kept in memory. Of a folder without fits, all but `fit` is an
    `InputError`.

    Parameters
    ----------
    folder
        Path or URL.
    workers
        Number of processes, by default one a core; or the address of a Dask scheduler.
    progress
        Called with the stage, the folder and the share of the stage that is done (0..1).

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
        """Fit every shape once, and let all fits agree on how the template stretches.

        With the model "none" the shapes themselves make a template: one of them is fitted to all others, and then their
        mean, twice. They are of one kind, in any pose; mirror images and cut ones are found. Nothing agrees then, and
        five fits or more are judged by comparison with each other. A run that was stopped goes on where it was, bit for
        bit. Shapes of before stay in the collection as long as their files are there, and those that are added are
        fitted. A shape that cannot be read or fitted is a record and stops nothing else.

        Parameters
        ----------
        shapes
            Files, folders, patterns such as ``scans/*.ply``, or URLs of folders.
        model
            Name, folder, "auto" or "none". With "auto" the first shape decides; shapes of other kinds that the installed
            models know are fitted by theirs, in a folder of the kind's name within this one.
        config
            How all shapes are fitted.
        only
            As in `load_shape`.
        without
            As in `load_shape`.
        sequence
            The shapes of a folder are frames, in the natural order of their names, and each fit starts where the last
            one ended.
        agree
            Whether fits agree.
        tell
            Called with the record of each shape, as they come in.

        Returns
        -------
        Fitted
            What became of each shape.

        Raises
        ------
        MeshmatchError
            There is no shape, two have the same name, none could be fitted, or the folder holds fits of another model
            or made in another way, or another process writes to it.
        """
        given, left_out = find_sources(shapes, self.store)
        wish = Setting(self.store, str(model), config or FitConfig(), tuple(only), tuple(without), sequence)
        with self.store.alone(), hired(self.workers) as crew:
            setting = settled(wish, sources := self._with_earlier(given))
            if model == AUTO:
                made = fit_all_kinds(setting, wish, sources, crew, agree, self.progress, tell)
            else:
                made = fit_all(setting, sources, crew, agree, self.progress, tell)
            made = with_left_out(made, self.store, left_out)
        forget()
        return made

    @property
    def names(self) -> list[str]:
        """Names of the fitted shapes, sorted; not of those of another kind, whose fits are in a folder of their own."""
        found = self._fitted
        elsewhere = self._elsewhere(found)
        left = [name for name in found if name not in elsewhere]
        if not left:
            what = f"{self.store.location} holds no fit of its own kind"
            raise InputError(what, "; ".join(elsewhere_words(elsewhere)))
        return left

    @property
    def template(self) -> Template:
        """The template of all fits."""
        return template_at(self.store)

    @property
    def model(self) -> str:
        """Name or folder of the model of all fits; "none" where there was none."""
        return str(self._about()["model"])

    def to_learn(self) -> RegisteredShapes:
        """The fitted shapes, without poor fits, for `train` to learn from.

        Returns
        -------
        RegisteredShapes
            In the template's vertices.

        Raises
        ------
        InputError
            Fewer than three are left.
        """
        with self.registered() as found:
            name, verts = Path(self.store.location).name, np.array(found.points)
            if self.model != NO_MODEL:
                return RegisteredShapes(self.template, verts, name, self.model)
            mirror = any(self.fit_of(each).frame.mirrored for each in found.names)
            return RegisteredShapes(self.template, verts, name, self.model, "rigid", mirror)

    def fit_of(self, name: str) -> Fit:
        """The fit of a shape, after all have agreed.

        Parameters
        ----------
        name
            Name of the shape.

        Returns
        -------
        Fit
            It knows where the vertices of the shape belong, but not the shape: its ``verts`` are empty. `Matcher.map` takes
            it, also together with fits of other shapes by the same model.
        """
        return self._read(name)

    def places_of(self, name: str) -> Places:
        """Where the vertices of a shape belong on the template.

        Parameters
        ----------
        name
            Name of the shape.

        Returns
        -------
        Places
            A point of the template for every vertex.
        """
        return self._read(name).places

    def map(self, source: str, target: str) -> VertexMap:
        """The map between two shapes: nothing is fitted, only looked up.

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
        return map_of_placed(self._read(source), self._read(target))

    def maps_between(self, source: ShapeLike, target: ShapeLike) -> MapPair:
        """The maps between two shapes themselves, in both directions, for transfers and `evaluate`.

        They are found among the fits by their vertices and faces; also among those of another kind, which are in a folder
        of their own.

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
        for other in self._others():
            if {shape.hash for shape in shapes} <= {other._hash_of(name) for name in other._fitted}:
                return other.maps_between(*shapes)
        for shape in shapes:
            if shape.hash not in names:
                hint = "fit it with `meshmatch fit`; its vertices and faces must be those of the fitted file"
                raise InputError(f"{self.store.location} holds no fit of {shape.name or 'this shape'}", hint)
        a, b = (names[shape.hash] for shape in shapes)
        there, back = self.map(a, b).for_shapes(*shapes), self.map(b, a).for_shapes(*shapes[::-1])
        part = self._words(a)["partial"] or self._words(b)["partial"]
        there, back = both_unfolded(there, back, *shapes, part)
        return MapPair(*shapes, there, opposite=back)

    def holds(self, shape: ShapeLike) -> bool:
        """Whether a shape is among the fits, or among those of another kind, by its vertices and faces.

        Parameters
        ----------
        shape
            As in `match`.

        Returns
        -------
        bool
            True if `maps_between` can find it.
        """
        digest = as_shape(shape).hash
        return any(digest == each._hash_of(name) for each in (self, *self._others()) for name in each._fitted)

    def _names_of_one_kind(self) -> list[str]:
        """`names`; with a warning about those that it does not have."""
        names = self.names
        for text in elsewhere_words(self._elsewhere(sorted(set(self._fitted) - set(names)))):
            warn(text)
        return names

    def pairs(self, to: str | None = None) -> list[Pair]:
        """All ordered pairs of names, with a warning about shapes of another kind, which are left out.

        Parameters
        ----------
        to
            Only those that lead to this name.

        Returns
        -------
        list of (source, target)
            Names.
        """
        if to is not None:
            self._check(to)
        names = self._names_of_one_kind()
        if to is None:
            return list(permutations(names, 2))
        return [(name, to) for name in names if name != to]

    def save_maps(self, output: str | Path, pairs: Sequence[Pair] | None = None, *, suffix: str = ".npz") -> int:
        """Write maps; the one from A to B is ``output/A/B`` with the suffix. Maps that are as new as the fits are kept.

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
            How many maps there are.

        Raises
        ------
        MeshmatchError
            An unknown name or format, or a name whose fit is of another kind, or the folder cannot be written, or another
            program made it.
        """
        suffix = f".{suffix.removeprefix('.')}"
        check_suffix(Path(f"map{suffix}"))
        wanted = self.pairs() if pairs is None else list(pairs)
        known = set(self.names)
        for name in (name for pair in wanted for name in pair if name not in known):
            self._check(name)
        maps = Store.of(output)
        with maps.alone(), hired(self.workers) as crew:
            return map_all(self.store, maps, wanted, suffix, crew, self.progress)

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
        """Write the template on every shape, as meshes or as a table; vertex i is the same point on all of them.

        Parameters
        ----------
        output
            A new folder.
        suffix
            Of a mesh for each shape, named as it is, by default .ply; or .csv or .npz, one table of all coordinates: a row
            for each shape, x, y and z of each vertex in turn; or arrays ``points`` (S, V, 3), ``faces`` (F, 3), ``names``,
            ``centroid_size`` and ``mirrored`` (S,). Beside a table, metadata.csv has a row for each shape.
        place
            Where they lie: where the files have the shapes ("files"), or all with the axes of the template, about its
            center ("template"). Both are in the unit of the files; a mirror image is turned over in the second.
        poor
            Whether poor fits are written.
        original
            Write the shapes of the files instead, as .vtp or .vtk, with the signed distance and the displacement of each
            vertex from the mean, and the template's parts.
        values
            A file of numbers of the template's vertices, which the originals then have too.
        metadata
            A table with a row for each shape, which metadata.csv then has too.
        smooth
            Shapes of a folder are frames: smooth the paths of the vertices in time, along the surfaces.
        cycle
            The same, and the last frame is followed by the first.

        Returns
        -------
        Exported
            What was written.

        Raises
        ------
        MeshmatchError
            The format or place is unknown, no fit is left, an original is not as it was, or the folder is named as a file,
            is not empty or cannot be written.
        """
        how = Export(suffix, place, original, values, metadata, smooth, cycle).into(output)
        verdicts = {name: str(self._words(name)["verdict"]) for name in self._names_of_one_kind()}
        left_out = tuple(name for name, verdict in verdicts.items() if verdict == "poor" and not poor)
        names = [name for name in verdicts if name not in left_out]
        if not names:
            raise InputError(f"all {len(verdicts)} fits of {self.store.location} are poor", "write them with --poor")
        mean = None
        if original and len(names) > 2:
            with self.registered(poor) as shapes:
                mean = superimpose(shapes.points, shapes.faces)
        in_time = smooth or cycle
        sequence = in_time or bool(self._about()["sequence"])
        files: dict[str, str] = {}
        with nullcontext() if original or in_time else suppress(InputError):  # else they only say how a glb stands
            files = files_of(self.store) if original or in_time or how.suffix == ".glb" else {}
        names = in_sequences(names) if sequence else names
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
        """The mean and the modes of the fitted shapes.

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
            What is superimposed: "whole" shapes, "each" connected part alone, or one part, whose number (the largest is "1")
            or name this is: of the template, or of a mesh in the files.
        leave_out
            As in `registered`.

        Returns
        -------
        Atlas
            Of all fits that count.
        """
        with self.registered(poor, leave_out) as shapes:
            return shapes.atlas(modes=modes, scale=scale, robust=robust, align_by=align_by)

    @contextmanager
    def registered(self, poor: bool = False, leave_out: Sequence[str] = ()) -> Iterator[Registered]:
        """The template on every shape, held in memory, or in a file until the block ends.

        Parameters
        ----------
        poor
            Whether poor fits count.
        leave_out
            Names of shapes that do not count; * and ? stand for any characters.

        Yields
        ------
        Registered
            Points (S, V, 3) in the unit of the files, with the axes of the template.

        Raises
        ------
        InputError
            Fewer than three shapes are left, or none is called so.
        """
        words = {name: self._words(name) for name in self._names_of_one_kind()}
        out = dict.fromkeys(sorted(matching(words, leave_out)), "asked")
        out |= {name: "poor" for name, about in words.items() if about["verdict"] == "poor" and not poor}
        names = tuple(name for name in words if name not in out)
        if len(names) < 3:
            also = f" and {len(out)} that are left out" if out else ""
            raise InputError(f"{self.store.location} holds {len(names)} fits{also}", "three or more are needed")

        def read(number: int) -> Float[Floats, "V 3"]:
            fit = self.fit_of(names[number])
            return np.asarray(fit.points * fit.frame.scale)

        parts, cut = partial(self._parts, names), tuple(name for name in names if words[name]["partial"])
        with held(len(names), self.template.shape.V, read) as points:
            yield Registered(points, self.template.shape.faces, names, np.eye(3), out, self.template.hash, parts, cut)

    def _parts(self, names: Sequence[str]) -> Masks:
        return parts_of_template(self.template, names, files_of(self.store), self.places_of)

    def _check(self, name: str) -> None:
        """`InputError` for a name that has no fit here, or whose fit is of another kind."""
        self.places_of(name)
        where = self._elsewhere([name]).get(name)
        if where is not None:
            raise InputError(f"{name} is of another kind", f"its fit is in {where}: map there")
