"""New texture coordinates by xatlas: charts with little stretch, packed side by side, by a program of its own.

When an `xatlas.Atlas` is freed, a thread can miss the word to end: then Python waits for ever, and not even Ctrl-C helps.
The program frees none: it ends at once when it has answered. What would bring it down does not bring down its caller.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys

import numpy as np
import xatlas

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.transfer.merged_charts import merged_charts
from meshmatch.transfer.whole_polygons import whole_polygons

# Charts are packed on a grid of at most this size, at several densities; the best result is taken.
_GRID, _DENSITIES = 1024, (0.6, 0.5, 0.4)
# Length of a chart's border, in units of sqrt(area): a longer one leaves much of a square empty.
_MAX_BORDER = 3.0
_PROGRAM = f"import sys; sys.path[:] = sys.argv[1:]; from {__name__} import main; main()"


def new_charts(
    verts: Float[Floats, "V 3"],
    faces: Int[Ints, "F 3"],
    size: int,
    padding: int,
    polygons: Int[Ints, " F"] | None = None,
) -> tuple[Float[Floats, "N 2"], Int[Ints, "F 3"]]:
    """Coordinates in 0..1, and the three of each face, for an image of `size` with `padding` texels between charts.

    `verts` in units of sqrt(area). No seam crosses one of the `polygons` that triangles are parts of.
    `RuntimeError` with the reason if xatlas cannot make them.
    """
    question = io.BytesIO()
    polygons = np.arange(len(faces)) if polygons is None else polygons
    np.savez(question, verts=verts, faces=faces, polygons=polygons, size=size, padding=padding)
    command = [sys.executable, "-I", "-c", _PROGRAM, *sys.path]
    done = subprocess.run(command, input=question.getvalue(), capture_output=True, check=False)
    if done.returncode:
        words = done.stderr.decode(errors="replace").strip().splitlines()
        raise RuntimeError(words[-1] if words else f"xatlas ended with status {done.returncode}")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as answer:
        return answer["uv"], answer["faces"]


def flat_areas(corners: Float[Floats, "F 3 2"]) -> Float[Floats, " F"]:
    """Areas of triangles in the plane."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(0.5 * np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]))


def main() -> None:
    """Answer the question on stdin, and end without freeing an atlas."""
    status = 0
    atlases: list[xatlas.Atlas] = []
    try:
        with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as question:
            verts, faces, polygons = (question[key] for key in ("verts", "faces", "polygons"))
            uv, corners = _made(verts, faces, polygons, int(question["size"]), int(question["padding"]), atlases)
        np.savez(sys.stdout.buffer, uv=uv, faces=corners)
    except Exception as error:
        print(error, file=sys.stderr)
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _made(
    verts: Floats, corners: Ints, polygons: Ints, size: int, padding: int, atlases: list[xatlas.Atlas]
) -> tuple[Floats, Ints]:
    maker, pack = xatlas.Atlas(), xatlas.PackOptions()
    atlases.append(maker)
    pack.resolution, pack.padding = 256, 0
    maker.add_mesh(verts.astype(np.float32), corners.astype(np.uint32))
    options = xatlas.ChartOptions()
    options.max_boundary_length = _MAX_BORDER
    maker.generate(options, pack)
    origin, faces, uv = maker[0]
    if not np.array_equal(origin[faces], corners):
        raise RuntimeError("faces were lost")
    charts = uv * (np.array([maker.width, maker.height]) / maker.texels_per_unit)
    charts, faces = merged_charts(verts, corners, charts, faces.astype(np.int64))
    charts, faces = whole_polygons(verts, corners, charts, faces, polygons)
    grid = min(size, _GRID)
    return _packed(charts, faces, grid, padding * grid / size, atlases), faces


def _packed(charts: Floats, faces: Ints, grid: int, padding: float, atlases: list[xatlas.Atlas]) -> Floats:
    """(N, 2) charts side by side on about `grid` texels, `padding` apart: the most square of a few attempts of xatlas."""
    area = float(flat_areas(charts[faces]).sum())
    best, most = charts, 0.0
    for density in _DENSITIES:
        packer, pack = xatlas.Atlas(), xatlas.PackOptions()
        atlases.append(packer)
        pack.texels_per_unit = grid * np.sqrt(density / area)
        # what is shrunk to fit later must be further apart now
        pack.padding, pack.bilinear = int(np.ceil(padding * np.sqrt(density / _DENSITIES[-1]))), True
        packer.add_uv_mesh(charts.astype(np.float32), faces.astype(np.uint32))
        packer.generate(xatlas.ChartOptions(), pack)
        origin, again, uv = packer[0]
        longest = max(packer.width, packer.height)
        reached = area * (pack.texels_per_unit / longest) ** 2
        if reached > most and np.array_equal(origin[again], faces):
            placed = np.empty_like(charts)
            placed[origin] = uv * (np.array([packer.width, packer.height]) / longest)
            best, most = placed, reached
    if not most:
        raise RuntimeError("its charts could not be packed")
    return best
