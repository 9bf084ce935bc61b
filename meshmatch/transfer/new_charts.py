"""New texture coordinates: charts with little stretch, packed into one image."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.progress import Progress
from meshmatch.transfer.chart_regions import chart_regions
from meshmatch.transfer.pack_charts import pack_charts


def new_charts(
    verts: Float[Floats, "V 3"],
    faces: Int[Ints, "F 3"],
    size: int,
    padding: int,
    polygons: Int[Ints, " F"] | None = None,
    progress: Progress = Progress(),
) -> Float[Floats, "F 3 2"]:
    """Coordinates in 0..1 of the corners of each face, for an image of `size` with `padding` texels between charts.

    `verts` are in units of sqrt(area). No seam crosses one of the `polygons` (F,) that triangles belong to. ``progress`` is
    called with the share (0..1) that is done, approximately.
    """
    polygons = np.arange(len(faces)) if polygons is None else polygons
    charts = chart_regions(verts, faces, polygons, progress.between(0.0, 0.8))
    out = np.empty((len(faces), 3, 2))
    for chart, uv in zip(charts, pack_charts(charts, padding / size), strict=True):
        out[chart.members] = uv[chart.corners]
    return out
