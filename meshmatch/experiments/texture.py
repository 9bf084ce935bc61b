"""How much a texture loses on its way: ``python -m meshmatch.experiments.texture``.

Each case carries the texture of a shape A to a shape B, into a new atlas, and back to A, to its own texture
coordinates where they serve; and asks for the colours at random points of A: before, on B, and after the way back.
Errors are of sRGB bytes (0..255), the mean over points and channels, and PSNR.

- *itself*: A is the sample body that ships; B is A, in another atlas. What resampling costs, and nothing else.
- *remeshed*: B is A split and decimated to 10,000 vertices, as it stands. Maps by the nearest point of the surface.
- *re-posed*: B is the template laid on the other sample, in its pose, decimated to 10,000 vertices: another person.
  Maps by `match`; so this one counts what the map does too.
- *Rogue*, *Rogue_Hooded*, *spot*: characters and a cow of the evaluation data, to themselves with half of their
  triangles, where the data are. Maps by the nearest point.

The clock: one whole command, a map at hand, a texture of 2048 x 2048 onto 10,000 vertices without texture
coordinates of their own; the process from its start to its end, with unwrapping, baking and writing.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.table import Table

from meshmatch.arrays import Floats
from meshmatch.experiments.report import circumstances, status_of, wide_console
from meshmatch.experiments.speed import Cost, cost_of, keep_to_cores, sized
from meshmatch.fitting.dense import dense_shape
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import make_folder
from meshmatch.pipeline import carry, read_model, register
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.appearance_files import load_appearance
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.duplicates import seams
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.srgb import to_srgb
from meshmatch.shapes.textured_files import save_textured
from meshmatch.templates.location import bundled_folder
from meshmatch.threads import set_threads
from meshmatch.transfer.bake import BakeOptions
from meshmatch.transfer.mapped_mesh import MappedMesh
from meshmatch.transfer.material_sampler import MaterialSampler
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texture import BakedMesh, transfer_texture
from meshmatch.transfer.unwrap import atlas_of

POINTS = 200_000
VERTICES = 10_000
BAR_SECONDS, BAR_GIGABYTES = 10.0, 2.0
CHARACTERS = {"Rogue": "Rogue.glb", "Rogue_Hooded": "Rogue_Hooded.glb", "spot": "spot_triangulated.obj"}
_PICTURES = {"spot": "spot_texture.png"}
_BODIES = ("itself", "remeshed", "re-posed")


@dataclass(frozen=True, eq=False)
class Trip:
    """A shape with its look, another shape, and the maps between them."""

    source: Shape
    look: Appearance
    target: Shape
    there: VertexMap
    back: VertexMap


@dataclass(frozen=True)
class Loss:
    """Errors of colours in bytes: the mean, and PSNR in decibels (infinite where nothing is lost)."""

    mean: float
    psnr: float

    @classmethod
    def between(cls, one: Floats, two: Floats) -> Loss:
        """Of colours (N, 3) in 0..1."""
        apart = 255.0 * (one - two)
        square = float(np.square(apart).mean())
        return cls(float(np.abs(apart).mean()), float(10 * np.log10(255.0**2 / square)) if square else np.inf)


def nearest_map(a: Shape, b: Shape) -> VertexMap:
    """From a to b, which lie in one place: the nearest points of b's surface that face the same way."""
    image = MappedMesh.of(b)
    places = image.query(a.verts, a.vertex_normals)
    return VertexMap.between(
        a, b, places.vertex, face=places.face, barycentric=places.barycentric, verdict="good"
    )


def trip_of(name: str, folder: Path) -> Trip:
    """The shapes and maps of a case."""
    samples = bundled_folder() / "samples"
    if name in CHARACTERS:
        path = folder / "textured" / CHARACTERS[name]
        source = load_shape(path)
        picture = _PICTURES.get(name)
        look = load_appearance(path, source, None if picture is None else path.parent / picture)
        # seams closed, and nothing else: repair would drop the eyes as stray parts
        whole = Shape(source.verts, seams(source.verts, source.faces)[source.faces], source.name)
        target = decimate(whole, whole.F // 2)
    else:
        source = load_shape(samples / "dancer-textured.glb")
        look = load_appearance(samples / "dancer-textured.glb", source)
        target = source
    if name == "re-posed":
        fit = register(samples / "climber.ply")
        target = decimate(dense_shape(read_model("human"), fit), 2 * VERTICES)
        found = carry(source, target)
        return Trip(source, look, target, found.back, found.forward)
    if name == "remeshed":
        target = sized(repair(source).shape, VERTICES)
    if name == "itself":
        return Trip(source, look, target, VertexMap.identity(source), VertexMap.identity(source))
    return Trip(source, look, target, nearest_map(target, source), nearest_map(source, target))


def colors_at(shape: Shape, look: Appearance, points: Floats) -> Floats:
    """sRGB (N, 3) of a textured shape at its points nearest to given ones (N, 3)."""
    places = MappedMesh.of(shape).query(points, None)
    coat = MaterialSampler(look, SurfaceWalker(shape))
    face = np.maximum(places.face, 0)
    found = coat.colors(face, places.barycentric.T.astype(np.float32), np.zeros(len(points), np.float32))
    return np.asarray(to_srgb(found[:3].T))


def look_of(worn: BakedMesh) -> Appearance:
    """The look that a baked texture gives."""
    material = Material(image=worn.baked.image, alpha=worn.baked.alpha, wrap=("clamp", "clamp"))
    return Appearance((material,), np.zeros(len(worn.mesh.faces), np.int64), worn.mesh.uv)


def measure(name: str, trip: Trip, choices: BakeOptions, keep: Path | None) -> dict[str, object]:
    """Carry there and back, and compare."""
    rng = np.random.default_rng(0)
    samples = sample_surface(trip.source, POINTS, rng).points

    def carried(
        source: Shape, look: Appearance, target: Shape, back: VertexMap, own: Floats | None = None
    ) -> BakedMesh:
        atlas = atlas_of(target, own, choices.size, choices.padding)
        return transfer_texture(source, look, target, back, atlas, choices)

    before = colors_at(trip.source, trip.look, samples)
    there = carried(trip.source, trip.look, trip.target, trip.there)
    again = carried(trip.target, look_of(there), trip.source, trip.back, trip.look.uv)
    after = colors_at(trip.source, look_of(again), samples)
    if keep is not None:
        save_textured(keep / f"{name}-there.glb", there.mesh, there.baked.image)
        save_textured(keep / f"{name}-back.glb", again.mesh, again.baked.image)
    record: dict[str, object] = {
        "source_vertices": trip.source.V,
        "target_vertices": trip.target.V,
        "torn": there.baked.torn,
    }
    losses = {"there and back": Loss.between(before, after)}
    if name != "re-posed":  # elsewhere the points of A lie on B too
        losses["there"] = Loss.between(before, colors_at(trip.target, look_of(there), samples))
    for way, loss in losses.items():
        record[way] = {"mean": round(loss.mean, 3), "psnr": round(loss.psnr, 2)}
    return record


def clock(folder: Path, threads: int) -> dict[str, object]:
    """Seconds and gigabytes of the whole command, the median of three after one that does not count."""
    source = bundled_folder() / "samples" / "dancer-textured.glb"
    a = load_shape(source)
    b = sized(repair(a).shape, VERTICES)
    save_shape(folder / "b.ply", b)
    b = load_shape(folder / "b.ply")
    save_map(folder / "ab.npz", nearest_map(a, b))
    words = [sys.executable, "-m", "meshmatch", "transfer-texture", str(source), str(folder / "b.ply")]
    words += ["--map", str(folder / "ab.npz"), "-o", str(folder / "out.glb"), "--size", "2048", "-q"]
    costs: list[Cost] = [cost_of([*words, "--threads", str(threads)]) for _ in range(4)][1:]
    wall, cpu, gigabytes = (
        float(np.median([getattr(cost, part) for cost in costs])) for part in ("wall", "cpu", "gigabytes")
    )
    return {
        "vertices": b.V,
        "size": 2048,
        **{"seconds": round(wall, 2), "cpu_seconds": round(cpu, 2), "gigabytes": round(gigabytes, 3)},
        **{"bar_seconds": BAR_SECONDS, "bar_gigabytes": BAR_GIGABYTES},
        "met": wall <= BAR_SECONDS and gigabytes <= BAR_GIGABYTES,
    }


def run(
    cases: Sequence[str], folder: Path, choices: BakeOptions, keep: Path | None, timed: bool
) -> dict[str, object]:
    """Measure cases by name; prints a table and a JSON line, whose record is returned too."""
    kept = keep_to_cores(2)
    records: dict[str, object] = {}
    table = Table(title=f"Textures of {choices.size} there and back, errors of bytes", title_justify="left")
    for column in ("case", "A", "B", "mean, there", "PSNR", "mean, and back", "PSNR", "torn"):
        table.add_column(column, justify="left" if column == "case" else "right")
    for name in cases:
        if name in CHARACTERS and not (folder / "textured" / CHARACTERS[name]).is_file():
            records[name] = None
            table.add_row(name, "-", "-", "no data", "", "", "", "")
            continue
        record = measure(name, trip_of(name, folder), choices, keep)
        records[name] = record
        cells = [str(record["source_vertices"]), str(record["target_vertices"])]
        for way in ("there", "there and back"):
            loss = record.get(way)
            cells += [f"{loss['mean']:.2f}", f"{loss['psnr']:.1f}"] if isinstance(loss, dict) else ["", ""]
        table.add_row(name, *cells, f"{100 * float(str(record['torn'])):.1f} %")
    wide_console().print(table)
    whole: dict[str, object] = {
        "benchmark": "texture",
        **circumstances(threads=choices.workers, jobs=1),
        "size": choices.size,
        "samples": choices.samples,
        "cases": records,
    }
    if timed:
        with tempfile.TemporaryDirectory() as place:
            cost = whole["clock"] = clock(Path(place), choices.workers)
        wide_console().print(
            f"2048 x 2048 onto {cost['vertices']} vertices, {choices.workers} threads on {kept} cores: "
            f"{cost['seconds']} s ({cost['cpu_seconds']} s of CPU), {cost['gigabytes']} GB; "
            f"bars {BAR_SECONDS:g} s and {BAR_GIGABYTES:g} GB: {'met' if cost['met'] else 'NOT met'}"
        )
    print(json.dumps(whole), flush=True)
    return whole


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, whatever it measured."""
    names = [*_BODIES, *CHARACTERS]
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.texture", description=__doc__)
    parser.add_argument("--cases", default=",".join(names), help="some of %(default)s; none: the clock alone")
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--size", type=int, default=2048, help="texels a side [%(default)s]")
    parser.add_argument(
        "--samples", type=int, default=BakeOptions().samples, help="as of the command [%(default)s]"
    )
    parser.add_argument("--threads", type=int, default=2, help="of baking [%(default)s]")
    parser.add_argument("--keep", type=Path, help="a folder for the textured shapes, to look at them")
    parser.add_argument("--no-clock", action="store_true", help="leave out the timed command")
    options = parser.parse_args(words)
    cases = [name for name in options.cases.split(",") if name and name != "none"]
    if unknown := sorted(set(cases) - set(names)):
        parser.error(f"no case {unknown[0]!r}; there are {', '.join(names)}")
    if options.threads < 1:
        parser.error("--threads begins at 1")
    set_threads(1)
    choices = replace(BakeOptions(), size=options.size, samples=options.samples, workers=options.threads)

    def work() -> None:
        if options.keep is not None:
            make_folder(options.keep)
        run(cases, options.data, choices, options.keep, not options.no_clock)

    return status_of(work)


if __name__ == "__main__":
    sys.exit(main())
