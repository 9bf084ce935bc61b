"""Loss of a texture that is transferred to another shape and back.

The sample dancer's texture is transferred to a target with new texture coordinates, saved, and transferred back to the
dancer's coordinates: once from the original target shape, and once from the saved file, as a second command would do it,
which has another orientation and duplicate vertices along seams. Colors (sRGB) at random points of the dancer are
compared with the original ones by PSNR in decibels. The first target is the dancer itself, which gives the loss by
resampling alone.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

import meshmatch
from meshmatch.arrays import Float, Floats
from meshmatch.experiments import runner
from meshmatch.maps.folds import Folds
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.shapes.colors import to_srgb
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.textured_files import load_appearance
from meshmatch.templates.location import bundled_folder
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_colors import MaterialSampler

POINTS = 200_000
SOURCE, TARGETS = "dancer-textured.glb", "dancer-textured.glb,climber.ply"
COLUMNS = {
    "target": "target", "verdict": "verdict", "PSNR, dB": "psnr:.1f", "by the file written": "psnr_file:.1f",
    "turned over": "flipped:.2%", "crushed": "crushed:.2%", "CPU s": "seconds:.1f",
}  # fmt: skip


def colors_at(path: Path, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
    """Sample a textured file (sRGB) at the points of its surface nearest to ``points``."""
    shape = meshmatch.load_shape(path)
    places = MappedMesh.of(shape).query(points)
    sampler = MaterialSampler(load_appearance(path, shape), SurfaceWalker(shape))
    sharp = np.zeros(len(points), np.float32)
    found = sampler.colors(places.face.astype(np.int32), places.barycentric.T.astype(np.float32, order="C"), sharp)
    return np.asarray(to_srgb(found[:3].T))


def measure_target(source: Path, target: Path, options: meshmatch.BakeOptions, folder: Path) -> dict[str, Any]:
    """Transfer a texture there and back; return its PSNR, and the flipped and crushed shares of the target's map."""
    began = time.process_time()
    there, back = folder / "there.glb", folder / "back.glb"
    first = meshmatch.transfer_texture(source, target, uv="new", options=options)
    first.save(there)
    meshmatch.transfer_texture(there, source, uv="keep", options=options).save(back)
    seconds = time.process_time() - began
    look = load_appearance(there, meshmatch.load_shape(there))
    same = meshmatch.transfer_texture(meshmatch.load_shape(target), source, look=look, uv="keep", options=options)
    same.save(folder / "same.glb")
    points = sample_surface(meshmatch.load_shape(source), POINTS, np.random.default_rng(0)).points
    before = colors_at(source, points)
    folds = Folds.of(first.maps.backward, first.maps.target, first.maps.source)
    return {
        "target": target.name,
        "verdict": first.maps.forward.verdict,
        "psnr": _psnr(before, colors_at(folder / "same.glb", points)),
        "psnr_file": _psnr(before, colors_at(back, points)),
        "flipped": folds.flipped,
        "crushed": folds.crushed,
        "seconds": seconds,
    }


def _psnr(one: Floats, two: Floats) -> float:
    """Compute the PSNR of colors in [0, 1], in decibels."""
    return float(-10 * np.log10(np.square(one - two).mean()))


@runner.command
def main(
    targets: Annotated[str, Option(help="comma-separated samples or paths")] = TARGETS,
    size: Annotated[int, Option(min=16, help="texels per side")] = 2048,
    threads: runner.Threads = 1,
) -> runner.Report:
    samples, options = bundled_folder() / "samples", meshmatch.BakeOptions(size=size, workers=threads)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in runner.track(targets.split(","), "carrying"):
            rows.append(measure_target(samples / SOURCE, samples / name, options, Path(folder)))
    return runner.Report({"rows": rows}, [runner.table(f"Textures of {size} there and back", rows, COLUMNS)])
