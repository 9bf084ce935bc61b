"""Bilateral symmetry maps of nearly symmetric shapes: fits without a model, single shapes, and pyclarcs.

Ground truth are keypoints of SHREC'07 that are mirror images of each other. The error is the distance, along the shape's
edges, between the computed and the true counterpart of a keypoint, in percent of sqrt(area). A counterpart is lost beyond a
tenth of sqrt(area).

- none: ``fit FOLDER --model none``; the symmetry map of the template is transferred to each shape.
- alone: ``symmetry SHAPE`` of each single shape.
- pyclarcs: ``clarcs asymmetry`` of each single shape: its plane of symmetry and its registration of the mirror image, with
  4,000 triangles. Its kernel widths are meant for endocasts in millimetres, so shapes are scaled to that size.

With the ``--work`` folder of `meshmatch.experiments.bench.specimens` its fits are reused.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.api.symmetry import find_symmetry
from meshmatch.arrays import Floats, Int, Ints
from meshmatch.collections.collection import Collection
from meshmatch.experiments import runner
from meshmatch.experiments.bench import any_shapes
from meshmatch.experiments.bench.specimens import BY_KEYPOINTS, LOST, Specimens, load
from meshmatch.geometry.frames import kabsch
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.footpoints import Surface
from meshmatch.models.registry import NO_MODEL
from meshmatch.shapes.decimate import decimate
from meshmatch.templates.mirror_images import aligned_mirror_image

PYCLARCS = "pyclarcs"
ALONE = "alone"
METHODS = (NO_MODEL, ALONE, PYCLARCS)
SETS = tuple(name for name in BY_KEYPOINTS if name != "chair")
_N_TRIANGLES, _SQRT_AREA_MM = 4000, 200.0  # of shapes for pyclarcs: number of triangles, and sqrt(area) in mm
_COLUMNS = {"set": "set", "method": "method", "shapes": "shapes:d", "keypoints": "keypoints:d"}
_COLUMNS |= {"error, % of sqrt(area)": "error:.2f", "worst shape": "worst:.2f", "lost": "lost:.1%"}

Counterparts = Callable[[str, Ints], Floats]
"""Function from a shape's name and vertices (N,) to the positions (N, 3) of their counterparts."""


def pairs_of(folder: Path, shape: str) -> Int[Ints, "N 2"]:
    """Return pairs of keypoints that are mirror images of each other, in both orders."""
    plain, swapped = any_shapes.symmetries(folder, shape)
    paired = np.flatnonzero(plain != swapped)
    return np.stack([paired, swapped[paired]], axis=1)


def by_fits(some: Specimens, scans: Path, work: Path) -> Counterparts:
    """Find counterparts by fits of a collection and the symmetry of its template."""
    collection = Collection(work, workers=1)
    collection.fit(scans, model=NO_MODEL)
    template = collection.template.shape
    images = template.verts * [-1.0, 1, 1]
    across = kabsch(images, aligned_mirror_image(template, 0).verts)

    def points(name: str, vertices: Ints) -> Floats:
        places = collection.places_of(name)
        image = across.to_world(places.resting[vertices] * [-1.0, 1, 1]).astype(np.float32)
        found = places.nearest(image)
        return interpolate(some.each[name].shape.verts, places.faces[found.face].astype(np.int64), found.barycentric)

    return points


def by_single_shapes(some: Specimens, scans: Path, work: Path) -> Counterparts:
    """Find counterparts by the symmetry of each single shape."""

    def points(name: str, vertices: Ints) -> Floats:
        shape = some.each[name].shape
        return find_symmetry(shape).map.apply(shape.verts)[vertices]

    return points


def by_pyclarcs(some: Specimens, scans: Path, work: Path) -> Counterparts:
    """Find counterparts by pyclarcs."""
    plane, coarse, fine, align, io, nonrigid = (
        import_module(f"{PYCLARCS}.{name}")
        for name in ("principal_axes", "coarse", "fine", "alignment", "io", "nonrigid")
    )

    def points(name: str, vertices: Ints) -> Floats:
        shape = some.each[name].shape
        small, unit = decimate(shape, _N_TRIANGLES), float(np.sqrt(shape.area)) / _SQRT_AREA_MM
        verts, faces = np.asarray(small.verts) / unit, small.faces.tolist()
        found = coarse.coarse_symmetry(verts, plane.best_principal_axis_plane(verts), verbose=False)
        for step in (fine.em_icp_sym, fine.em_icp_sym_corres):
            found = step(verts, found, verbose=False)
        image, inside_out = align.reflect_surface(verts, found.n, found.n * found.d), [each[::-1] for each in faces]
        normals = [io.compute_surface_normals(*mesh) for mesh in ((image, inside_out), (verts, faces))]
        moved = image + nonrigid.register(
            image, normals[0], verts, normals[1], inside_out, faces, n_levels=1, verbose=False
        )
        foot = Surface(verts, small.faces, small.vertex_normals).query(
            shape.verts[vertices] / unit, shape.vertex_normals[vertices]
        )
        return interpolate(moved, small.faces[foot.face], foot.barycentric) * unit

    return points


def measure(name: str, method: str, data: Path, seed: int, work: Path) -> dict[str, Any]:
    """Run a method on a set and return its table row."""
    some = load(name, data, any_shapes.SHAPES, seed)
    assert some.folder is not None
    scans = work / "scans" / name
    some.save(scans)
    ways: dict[str, Callable[[Specimens, Path, Path], Counterparts]] = {
        NO_MODEL: by_fits,
        ALONE: by_single_shapes,
        PYCLARCS: by_pyclarcs,
    }
    across, errors = ways[method](some, scans, work / "fits" / f"{name}-{method}"), {}
    for key, each in some.each.items():
        paired, known = pairs_of(some.folder, key), any_shapes.distances(some.folder, key)
        vertices = any_shapes.keypoints_of(some.folder, key)[paired[:, 0]]
        arrived = cKDTree(each.shape.verts).query(across(key, vertices))[1]
        errors[key] = 100 * known[paired[:, 1], arrived]
    off = np.concatenate(list(errors.values()))
    means = {key: float(each.mean()) for key, each in errors.items()}
    row = {"set": name, "method": method, "shapes": len(errors), "keypoints": len(off), "error": float(off.mean())}
    return row | {"worst": max(means.values()), "lost": float((off > 100 * LOST).mean()), "each": means}


@runner.command
def main(
    data: runner.Data = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(SETS)}")] = ",".join(SETS),
    methods: Annotated[str, Option(help=f"of {', '.join(METHODS)}")] = ",".join(METHODS),
    work: runner.Work = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    names, rows = runner.split_names(sets, SETS, "set"), []
    chosen, skipped = runner.installed(runner.split_names(methods, METHODS, "method"), (PYCLARCS,))
    with tempfile.TemporaryDirectory() as temporary:
        place = work or Path(temporary)
        for method in chosen:
            for name in names:
                runner.log(f"{name}: {method}")
                call = partial(measure, name, method, data, seed, place)
                rows.append(runner.cached(place / "symmetry" / f"{name}-{method}.json", {"seed": seed}, call))
    rows.sort(key=lambda row: names.index(row["set"]))
    return runner.Report({"rows": rows}, [runner.table("Across the plane of symmetry", rows, _COLUMNS)], skipped)
