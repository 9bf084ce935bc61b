"""How much a texture loses on its way.

Each case carries the texture of a shape A to a shape B, into a new atlas, and back to A, to its own texture coordinates
where they serve; and asks for the colors at random points of A: before, on B, and after the way back. Errors are of sRGB
bytes (0..255), the mean over points and channels, and PSNR.

- itself: A is the sample body that ships; B is A, in another atlas. What resampling costs, and nothing else.
- remeshed: B is A split and decimated to 10,000 vertices, as it stands. Maps by the nearest point of the surface.
- re-posed: B is the template fitted to the other sample, in its pose, decimated to 10,000 vertices: another person. Maps
  by `match`; so this one counts what the map does too.
- Rogue, Rogue_Hooded, spot: characters and a cow of the evaluation data, to themselves with half of their triangles,
  where the data are. Maps by the nearest point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.api.matcher import Matcher
from meshmatch.api.matching import match
from meshmatch.arrays import Float, Floats
from meshmatch.experiments import runner
from meshmatch.experiments.bench.speed import sized
from meshmatch.fitting.fit import dense_shape
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import make_folder
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.colors import to_srgb
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.faces import seams
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance, save_textured
from meshmatch.templates.location import bundled_folder
from meshmatch.threads import set_threads
from meshmatch.transfer.bake import Baked, BakeOptions, transfer_texture
from meshmatch.transfer.mapped_mesh import MappedMesh
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_colors import MaterialSampler
from meshmatch.transfer.unwrap import atlas_of

POINTS = 200_000
VERTICES = 10_000
CHARACTERS = {"Rogue": "Rogue.glb", "Rogue_Hooded": "Rogue_Hooded.glb", "spot": "spot_triangulated.obj"}
_PICTURES = {"spot": "spot_texture.png"}
CASES = ("itself", "remeshed", "re-posed", *CHARACTERS)


@dataclass(frozen=True, eq=False)
class Trip:
    """A shape with its look, another shape, and the maps between them."""

    source: Shape
    look: Appearance
    target: Shape
    there: VertexMap
    back: VertexMap


def loss(one: Float[Floats, "N 3"], two: Float[Floats, "N 3"]) -> dict[str, float]:
    """Errors of colors in 0..1, counted in bytes: the mean, and PSNR in decibels (infinite where nothing is lost)."""
    error = 255.0 * (one - two)
    square = float(np.square(error).mean())
    psnr = float(10 * np.log10(255.0**2 / square)) if square else np.inf
    return {"mean": round(float(np.abs(error).mean()), 3), "psnr": round(psnr, 2)}


def nearest_map(a: Shape, b: Shape) -> VertexMap:
    """From a to b, which lie in one place: the nearest points of b's surface that face the same way."""
    places = MappedMesh.of(b).query(a.verts, a.vertex_normals)
    return VertexMap.between(a, b, places.vertex, face=places.face, barycentric=places.barycentric, verdict="good")


def trip_of(name: str, folder: Path) -> Trip:
    """The shapes and maps of a case."""
    samples = bundled_folder() / "samples"
    if name in CHARACTERS:
        path = folder / "textured" / CHARACTERS[name]
        source = load_shape(path)
        picture = _PICTURES.get(name)
        look = load_appearance(path, source, None if picture is None else path.parent / picture)
        # seams closed, and nothing else: repair would drop the eyes as outliers
        whole = Shape(source.verts, seams(source.verts, source.faces)[source.faces], source.name)
        target = decimate(whole, whole.F // 2)
    else:
        source = load_shape(samples / "dancer-textured.glb")
        look = load_appearance(samples / "dancer-textured.glb", source)
        target = source
    if name == "re-posed":
        fit = Matcher().fit(samples / "climber.ply")
        target = decimate(dense_shape(as_model("human"), fit), 2 * VERTICES)
        found = match(source, target)
        return Trip(source, look, target, found.backward(), found.map)
    if name == "remeshed":
        target = sized(repair(source).shape, VERTICES)
    if name == "itself":
        return Trip(source, look, target, VertexMap.identity(source), VertexMap.identity(source))
    return Trip(source, look, target, nearest_map(target, source), nearest_map(source, target))


def colors_at(shape: Shape, look: Appearance, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
    """sRGB of a textured shape at its points nearest to given ones."""
    places = MappedMesh.of(shape).query(points, None)
    sampler = MaterialSampler(look, SurfaceWalker(shape))
    face = np.maximum(places.face, 0)
    found = sampler.colors(face, places.barycentric.T.astype(np.float32), np.zeros(len(points), np.float32))
    return np.asarray(to_srgb(found[:3].T))


def look_of(worn: Baked) -> Appearance:
    """The look that a baked texture gives."""
    material = Material(image=worn.image, alpha=worn.alpha, wrap=("clamp", "clamp"))
    return Appearance((material,), np.zeros(len(worn.mesh.faces), np.int64), worn.mesh.uv)


def measure(name: str, trip: Trip, choices: BakeOptions, keep: Path | None) -> dict[str, Any]:
    """Carry there and back, and compare; also the share of texels where the map is discontinuous."""
    samples = sample_surface(trip.source, POINTS, np.random.default_rng(0)).points

    def carried(source: Shape, look: Appearance, target: Shape, back: VertexMap, own: Floats | None = None) -> Baked:
        atlas = atlas_of(target, own, choices.size, choices.padding)
        return transfer_texture(source, look, target, back, atlas, choices)

    before = colors_at(trip.source, trip.look, samples)
    there = carried(trip.source, trip.look, trip.target, trip.there)
    again = carried(trip.target, look_of(there), trip.source, trip.back, trip.look.uv)
    after = colors_at(trip.source, look_of(again), samples)
    if keep is not None:
        save_textured(keep / f"{name}-there.glb", there.mesh, there.image)
        save_textured(keep / f"{name}-back.glb", again.mesh, again.image)
    record = {"case": name, "a": trip.source.V, "b": trip.target.V, "torn": there.torn}
    if name != "re-posed":  # elsewhere the points of A lie on B too
        found = loss(before, colors_at(trip.target, look_of(there), samples))
        record |= {f"there_{key}": value for key, value in found.items()}
    return record | {f"back_{key}": value for key, value in loss(before, after).items()}


COLUMNS = {
    **{"case": "case", "A": "a:d", "B": "b:d", "mean, there": "there_mean:.2f", "PSNR": "there_psnr:.1f"},
    **{"mean, and back": "back_mean:.2f", "PSNR, and back": "back_psnr:.1f", "discontinuous": "torn:.1%"},
}


@runner.command
def main(
    cases: Annotated[str, Option(help=f"of {', '.join(CASES)}")] = ",".join(CASES),
    data: runner.Data = runner.DATA,
    size: Annotated[int, Option(min=1, help="texels a side")] = 2048,
    samples: Annotated[int, Option(min=1, help="as of the command")] = BakeOptions().samples,
    threads: runner.Threads = 2,
    keep: Annotated[Path | None, Option(help="a folder for the textured shapes, to look at them")] = None,
) -> runner.Report:
    names = runner.names_of(cases, CASES, "case")
    set_threads(1)  # baking alone has several
    if keep is not None:
        make_folder(keep)
    choices = replace(BakeOptions(), size=size, samples=samples, workers=threads)
    rows, notes = [], []
    for name in runner.track(names, "carrying"):
        if name in CHARACTERS and not (data / "textured" / CHARACTERS[name]).is_file():
            notes.append(f"{name}: no data")
        else:
            rows.append(measure(name, trip_of(name, data), choices, keep))
    record = {"cases": rows}
    title = f"Textures of {size} there and back, errors of bytes"
    return runner.Report(record, [runner.table(title, rows, COLUMNS)], notes)
