"""Collections of biological specimens, and of other shapes, matched without a model and by other methods.

The specimens of a set are rotated at random and triangulated independently. In sets with sides every third one is a mirror
image, and the last two femurs are cut by a plane. Ground truth: femurs are in correspondence, as are molars, leaves and
knees, which are generated (`meshmatch.experiments.makers.molars_and_leaves`); hearts share vertices of the mesh that they
were decimated from; busts and birds have keypoints, up to the symmetries of their class. Errors are over all ordered pairs:
Euclidean in millimetres, or geodesic in percent of sqrt(area) where there is no unit. A point is lost beyond a tenth of
sqrt(area).

- none: ``fit FOLDER --model none``.
- own: ``prepare --grow-radii``, ``train --shapes`` for ``--steps`` steps, and ``fit FOLDER --model own``, all on the same
  specimens.
- pairs: ``match A B --model none`` for every pair, or for ``--limit-pairs`` of them.
- meshmonk: the first uncut specimen is registered to all others. It starts from the similarity, with the right side, that
  best aligns true points. The output says if it is not installed.

CPU seconds are those of all processes. With ``--work`` a run resumes where it was stopped.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.api.prepare import PrepareConfig, prepare
from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.collections.collection import Collection
from meshmatch.collections.setting import Record
from meshmatch.experiments import runner
from meshmatch.experiments.bench import any_shapes
from meshmatch.experiments.bench.methods import viscoelastic
from meshmatch.experiments.bench.sets import Pair, load_folder
from meshmatch.experiments.makers.molars_and_leaves import MAKERS, Registered
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import interpolate, vertex_normals
from meshmatch.maps.footpoints import Surface
from meshmatch.maps.vertex_map import VERDICTS
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import make_folder
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.training.recipes import recipe_for
from meshmatch.training.train import train

SIDED = ("femurs", "hearts", "knees", "molars")
BY_KEYPOINTS = ("bust", "bird", "fish", "chair")
SETS = (*SIDED, "leaves", *BY_KEYPOINTS)
PAIRS = "pairs"
METHODS = (NO_MODEL, "own", PAIRS, "meshmonk")
_OPTIONAL_METHODS = METHODS[3:]
LOST = 0.1  # error beyond which a point is lost, as a fraction of sqrt(area)
_N_CUT = 2  # number of femurs that are cut
_MONK_FACES = 10_000  # triangles of meshes for meshmonk
_COLUMNS = {"set": "set", "method": "method", "specimens": "specimens:d", "error": "error:.2f", "unit": "unit"}
_COLUMNS |= {"worst": "worst:.2f", "lost": "lost:.1%", "sides": "sides:.0%", "cut ones": "cut:.2f"}
_COLUMNS |= {"good": "good:d", "fair": "fair:d", "poor": "poor:d", "CPU s": "cpu:.0f"}


@dataclass(frozen=True, eq=False)
class Specimen:
    """A shape and its ground truth.

    ``places`` (P, 3) are corresponding points of a set in the coordinates of the shape, nan where it lacks them. The N
    ``vertices`` with known correspondence are at ``weights`` on triangles of places, whose indices are ``corners`` (N, 3).
    """

    shape: Shape
    places: Float[Floats, "P 3"]
    vertices: Int[Ints, " N"]
    corners: Int[Ints, "N 3"]
    weights: Float[Floats, "N 3"]
    mirrored: bool = False
    cut: bool = False

    def true_points_on(self, other: Specimen) -> Float[Floats, "N 3"]:
        """Return the true positions of its known vertices on another specimen; nan where that lacks them."""
        return interpolate(other.places, self.corners, self.weights)


@dataclass(frozen=True, eq=False)
class Specimens:
    """A set of specimens. With ``folder``, the truth is its keypoints, and errors are up to symmetry."""

    each: Mapping[str, Specimen]
    unit: str
    folder: Path | None = None

    def errors(self, pair: Pair, points: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
        """Compute errors, in the unit, of the mapped points of the source's known vertices; nan without a true point."""
        source, target = (self.each[name] for name in pair)
        if self.folder is None:
            return np.asarray(np.linalg.norm(points - source.true_points_on(target), axis=1))
        at = cKDTree(target.shape.verts).query(points)[1]
        known = any_shapes.distances(self.folder, pair[1])
        ways = [100 * known[way, at] for way in any_shapes.symmetries(self.folder, *pair)]
        return np.asarray(min(ways, key=np.mean))

    def save(self, folder: Path) -> None:
        """Write the shape of each specimen as a .ply file named after it."""
        make_folder(folder)
        for name, specimen in self.each.items():
            save_shape(folder / f"{name}.ply", specimen.shape)

    def lost(self, name: str) -> float:
        """Return the error, in the unit, beyond which a point of this target is lost."""
        return 100 * LOST if self.folder is not None else LOST * float(np.sqrt(self.each[name].shape.area))


def random_motion(rng: np.random.Generator, mirror: bool, far: float) -> Frame:
    """Draw a random rigid motion, with a reflection if ``mirror``; ``far`` bounds the translation along each axis."""
    turn = Rotation.random(rng=rng).as_matrix()
    return Frame(1.0, turn @ np.diag([-1.0, 1, 1]) if mirror else turn, rng.uniform(-far, far, 3))


def moved(shape: Shape, frame: Frame) -> Shape:
    """Transform a shape; reflections reverse its faces, which keeps normals outward."""
    return Shape(frame.apply(shape.verts), shape.faces[:, ::-1] if frame.mirrored else shape.faces, shape.name)


def make_scan(whole: Shape, rng: np.random.Generator, mirror: bool, cut: bool) -> Specimen:
    """Make a specimen from a shape in correspondence: remeshed, moved at random, and without one end if ``cut``."""
    shape, places = decimate(whole, int(whole.F * rng.uniform(0.5, 0.8))), np.array(whole.verts)
    if cut:
        long = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2][0]
        along = long + 0.3 * rng.standard_normal(3)
        along *= rng.choice([-1.0, 1.0]) / np.linalg.norm(along)
        edge = float(np.quantile(places @ along, rng.uniform(0.2, 0.35)))
        verts, faces = trimesh.intersections.slice_faces_plane(shape.verts, shape.faces, along, edge * along)[:2]
        shape = Shape(np.asarray(verts), np.asarray(faces, np.int64), whole.name)
        places[places @ along < edge] = np.nan
    unit = float(np.sqrt(whole.area))
    foot = Surface(whole.verts / unit, whole.faces, whole.vertex_normals).query(
        shape.verts / unit, shape.vertex_normals
    )
    frame = random_motion(rng, mirror, unit)
    at = np.arange(shape.V)
    return Specimen(moved(shape, frame), frame.apply(places), at, whole.faces[foot.face], foot.barycentric, mirror, cut)


def by_points(
    shape: Shape, points: Int[Ints, " P"], count: int, rng: np.random.Generator, mirror: bool = False
) -> Specimen:
    """Make a specimen from a shape with known vertices: ``points`` has the vertex of each place, or -1."""
    known = np.flatnonzero(points >= 0)
    shape = moved(shape, random_motion(rng, mirror, float(np.sqrt(shape.area))))
    places = np.full((count, 3), np.nan)
    places[known] = shape.verts[points[known]]
    return Specimen(
        shape, places, points[known], np.tile(known[:, None], 3), np.tile([1.0, 0, 0], (len(known), 1)), mirror
    )


def registered_shapes(name: str, data: Path, count: int, seed: int) -> dict[str, Shape]:
    """Return the shapes of a set in correspondence: femurs from files, others generated."""
    if name == "femurs":
        files = runner.evenly_spread(runner.files_in(data / "femur", "*.ply"), count)
        return {path.stem: load_shape(path) for path in files}
    found: Registered = MAKERS[name](count, seed)
    return {f"{name}-{k:02d}": Shape(verts, found.faces, name) for k, verts in enumerate(found.verts)}


def load(name: str, data: Path, count: int, seed: int) -> Specimens:
    """Load or generate a set of ``count`` specimens, or fewer if it has fewer."""
    rng = np.random.default_rng([seed, SETS.index(name)])
    mirrored = [name in SIDED and k % 3 == 2 for k in range(max(count, 100))]
    if name in BY_KEYPOINTS:
        folder = any_shapes.folder_of(name, data)
        names = runner.evenly_spread(any_shapes.shapes_of(folder), count)
        points = {each: any_shapes.keypoints_of(folder, each) for each in names}
        shapes = {each: load_shape(folder / f"{each}.ply") for each in names}
        made = {each: by_points(shapes[each], points[each], len(points[each]), rng) for each in names}
        return Specimens(made, "% of sqrt(area)", folder)
    if name == "hearts":
        shapes_of, truth = load_folder(data / "heart", ".truth.npy")
        names, size = (
            runner.evenly_spread(list(shapes_of), count),
            1 + max(int(each[:, 0].max()) for each in truth.values()),
        )
        made = {}
        for number, each in enumerate(names):
            at = np.full(size, -1)
            at[truth[each][:, 0]] = np.arange(len(truth[each]))
            made[each] = by_points(shapes_of[each], at, size, rng, mirrored[number])
        return Specimens(made, "mm")
    shapes = registered_shapes(name, data, count, seed)
    cut = [name == "femurs" and k >= len(shapes) - _N_CUT for k in range(len(shapes))]
    each_how = zip(shapes.items(), mirrored, cut, strict=False)
    return Specimens({key: make_scan(shape, rng, *how) for (key, shape), *how in each_how}, "mm")


Points = Callable[[Pair], Floats]
"""Function from a pair to the mapped points (N, 3), on the target, of the source's known vertices."""


@dataclass(frozen=True, eq=False)
class Done:
    """Result of a method on a set: mapped points, and records of a collection's fits or, by pair, verdict and right side."""

    points: Points
    records: Sequence[Record] = ()
    pairs: list[tuple[str, bool]] = field(default_factory=list)


def by_collection(some: Specimens, scans: Path, work: Path, model: str | Path) -> Done:
    """Fit a collection by ``meshmatch fit SCANS -o FITS --model MODEL``."""
    collection = Collection(work, workers=1)
    records = collection.fit(scans, model=model).records

    def points(pair: Pair) -> Floats:
        source, target = (some.each[name] for name in pair)
        if not set(pair) <= set(collection.names):
            return np.full((len(source.vertices), 3), target.shape.verts[0])
        return collection.map(*pair).points(target.shape)[source.vertices]

    return Done(points, records)


def by_own_model(some: Specimens, scans: Path, work: Path, steps: int) -> Done:
    """Train a model on the specimens and fit them with it."""
    prepare(scans, work / "prepared", PrepareConfig(NodeConfig("geodesic", grow=True)))
    recipe = recipe_for(work / "prepared").changed(steps=steps)
    train(work / "model", shapes=work / "prepared", recipe=recipe)
    return by_collection(some, scans, work / "fits", work / "model")


def by_pairs(some: Specimens, scans: Path, work: Path) -> Done:
    """Match each pair by ``meshmatch match A B --model none``."""
    matcher = Matcher(NO_MODEL, threads=1)
    files = {name: load_shape(scans / f"{name}.ply") for name in some.each}
    judged: list[tuple[str, bool]] = []

    def points(pair: Pair) -> Floats:
        source, target = (files[name] for name in pair)
        one, other = (some.each[name] for name in pair)
        found = matcher.match(source, target)
        turned_over = found.source_fit.frame.mirrored != found.target_fit.frame.mirrored
        judged.append((found.map.verdict, turned_over == (one.mirrored != other.mirrored)))
        return found.map.points(target)[one.vertices]

    return Done(points, pairs=judged)


def start_of(first: Specimen, other: Specimen) -> Frame:
    """Find the similarity, reflected if sides differ, that best aligns the places of one specimen with another's."""
    both = np.isfinite(first.places).all(axis=1) & np.isfinite(other.places).all(axis=1)
    a, b = first.places[both], other.places[both]
    centers = a.mean(axis=0), b.mean(axis=0)
    left, values, right = np.linalg.svd((b - centers[1]).T @ (a - centers[0]))
    side = -1.0 if first.mirrored != other.mirrored else 1.0
    signs = np.array([1.0, 1.0, side * np.sign(np.linalg.det(left @ right))])
    larger = float((values * signs).sum() / np.square(a - centers[0]).sum())
    turn = (left * signs) @ right
    return Frame(1 / larger, turn, centers[0] - centers[1] @ turn / larger)


def by_meshmonk(some: Specimens, scans: Path, work: Path) -> Done:
    """Register the first uncut specimen to all others by meshmonk."""
    first = next(each for each in some.each.values() if not each.cut)
    base, area = decimate(first.shape, _MONK_FACES), float(np.sqrt(first.shape.area))
    on, units = {}, {}
    for name, other in some.each.items():
        start = start_of(first, other)
        begun, unit = moved(base, start), area / start.scale
        meshes = [
            (each.verts / unit, each.vertex_normals, np.asarray(each.faces))
            for each in (begun, decimate(other.shape, _MONK_FACES))
        ]
        on[name], units[name] = viscoelastic(*meshes) * unit, unit

    def points(pair: Pair) -> Floats:
        source = some.each[pair[0]]
        unit, faces = units[pair[0]], base.faces[:, ::-1] if source.mirrored != first.mirrored else base.faces
        verts, at = on[pair[0]] / unit, source.shape.verts[source.vertices] / unit
        foot = Surface(verts, faces, vertex_normals(verts, faces)).query(
            at, source.shape.vertex_normals[source.vertices]
        )
        return interpolate(on[pair[1]], faces[foot.face], foot.barycentric)

    return Done(points)


def sides_found(some: Specimens, done: Done) -> float | None:
    """Share of specimens, or of pairs, whose side is found; the side of the template does not matter."""
    if not any(each.mirrored for each in some.each.values()):
        return None
    if done.pairs:
        return float(np.mean([right for _, right in done.pairs]))
    records = done.records
    same = float(np.mean([bool(each.mirrored) == some.each[each.name].mirrored for each in records]))
    return max(same, 1 - same)


def measure(
    name: str, method: str, data: Path, count: int, steps: int, limit: int | None, seed: int, work: Path
) -> dict[str, Any]:
    """Run a method on a set and return its table row."""
    some = load(name, data, count, seed)
    scans, place = work / "scans" / name, work / "fits" / f"{name}-{method}"
    some.save(scans)
    exact = {key: load_shape(scans / f"{key}.ply").verts - each.shape.verts for key, each in some.each.items()}
    assert max(float(np.abs(off).max()) for off in exact.values()) < 1e-3
    began = runner.cpu_seconds()
    ways: dict[str, Callable[[Specimens, Path, Path], Done]] = {
        NO_MODEL: partial(by_collection, model=NO_MODEL),
        "own": partial(by_own_model, steps=steps),
        PAIRS: by_pairs,
        "meshmonk": by_meshmonk,
    }
    done = ways[method](some, scans, place)
    cpu = runner.cpu_seconds() - began
    means, lost, on_cut = {}, [], []
    for pair in runner.evenly_spread(list(permutations(some.each, 2)), limit if method == PAIRS else None):
        began = runner.cpu_seconds()
        arrived = done.points(pair)
        cpu += runner.cpu_seconds() - began
        errors = some.errors(pair, arrived)
        errors = errors[np.isfinite(errors)]
        means[pair] = float(errors.mean())
        lost.append(float((errors > some.lost(pair[1])).mean()))
        if any(some.each[one].cut for one in pair):
            on_cut.append(means[pair])
    worst = max(means, key=lambda pair: means[pair])
    row: dict[str, Any] = {"set": name, "method": method, "specimens": len(some.each), "unit": some.unit}
    row |= {"error": float(np.mean(list(means.values()))), "worst": means[worst], "worst_pair": list(worst)}
    row |= {"lost": float(np.mean(lost)), "cut": float(np.mean(on_cut)) if on_cut else None, "cpu": cpu}
    if done.records or done.pairs:
        counts = Counter([each.verdict for each in done.records] or [verdict for verdict, _ in done.pairs])
        row |= {"sides": sides_found(some, done), **{each: counts[each] for each in VERDICTS[:3]}}
    of_each = {each: [means[pair] for pair in means if each in pair] for each in some.each}
    verdicts = {each.name: [each.verdict, each.trust, each.reasons] for each in done.records}
    return row | {"each": {key: [float(np.mean(off)), *verdicts.get(key, [])] for key, off in of_each.items()}}


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(SETS)}")] = ",".join(SETS),
    methods: Annotated[str, Option(help=f"of {', '.join(METHODS)}")] = ",".join(METHODS),
    count: Annotated[int, Option(min=3, help="specimens of each set, if it has as many")] = 9,
    steps: Annotated[int, Option(min=1, help="training steps of own models")] = 200,
    limit_pairs: runner.LimitPairs = None,
    work: runner.Work = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    names, rows = runner.split_names(sets, SETS, "set"), []
    chosen, skipped = runner.installed(runner.split_names(methods, METHODS, "method"), _OPTIONAL_METHODS)
    with tempfile.TemporaryDirectory() as temporary:
        place = work or Path(temporary)
        for method in chosen:
            asked: dict[str, Any] = {"count": count, "seed": seed}
            asked |= {"steps": steps} if method == "own" else {"pairs": limit_pairs} if method == PAIRS else {}
            for name in names:
                runner.log(f"{name}: {method}")
                call = partial(measure, name, method, data, count, steps, limit_pairs, seed, place)
                rows.append(runner.cached(place / "rows" / f"{name}-{method}.json", asked, call))
    rows.sort(key=lambda row: names.index(row["set"]))
    title = f"Specimens; own models of {steps} steps"
    return runner.Report({"rows": rows}, [runner.table(title, rows, _COLUMNS)], skipped)
