"""What is true of the benchmark's hearts: errors of maps, and registered hearts made from it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from meshmatch.experiments.category import Pair
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.maps.surface import Surface
from meshmatch.outputs import make_folder
from meshmatch.render.picture import Look, Panel, render_shapes
from meshmatch.render.scales import label_colors
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape

_NEAR = 40  # known vertices that say where another one goes


def heart_errors(
    shapes: Mapping[str, Shape],
    truth: Mapping[str, np.ndarray],
    maps: Mapping[Pair, np.ndarray],
    unseen: Collection[str] = (),
) -> dict[str, Any]:
    """Errors of index maps at the vertices whose partner is known: over pairs, and the share of right chambers.

    ``unseen_x100`` is the mean over pairs of ``unseen`` shapes alone, None without such pairs; ``across_x100`` the part
    of the errors along the target's normals: the rest is sliding along the surface.
    """
    means, chambers, across = {}, [], []
    for (source, target), index in maps.items():
        _, ours, theirs = np.intersect1d(truth[source][:, 0], truth[target][:, 0], return_indices=True)
        got, shape = index[ours], shapes[target]
        apart = 100 * (shape.verts[got] - shape.verts[theirs]) / np.sqrt(shape.area)
        means[source, target] = float(np.linalg.norm(apart, axis=1).mean())
        across.append(float(np.abs((apart * shape.vertex_normals[theirs]).sum(1)).mean()))
        chambers.append(float((truth[target][got, 1] == truth[source][ours, 1]).mean()))
    worst = max(means, key=lambda pair: means[pair])
    strange = [mean for pair, mean in means.items() if set(pair) <= set(unseen)]
    return {
        "pairs": len(means),
        "mean_x100": round(float(np.mean(list(means.values()))), 4),
        "worst_pair_x100": round(means[worst], 4),
        "worst_pair": list(worst),
        "across_x100": round(float(np.mean(across)), 4),
        "right_chamber": round(float(np.mean(chambers)), 4),
        "unseen_pairs": len(strange),
        "unseen_x100": round(float(np.mean(strange)), 4) if strange else None,
    }


def through(places: Mapping[str, np.ndarray], shapes: Mapping[str, Shape]) -> dict[Pair, np.ndarray]:
    """Maps through registered vertices: nearest of the source's, the same one on the target, nearest target vertex."""
    to = {name: cKDTree(places[name]).query(shape.verts)[1] for name, shape in shapes.items()}
    back = {name: cKDTree(shape.verts).query(places[name])[1] for name, shape in shapes.items()}
    return {(a, b): back[b][to[a]] for a in shapes for b in shapes if a != b}


def registered(template: Shape, ids: np.ndarray, target: Shape, target_ids: np.ndarray) -> np.ndarray:
    """Where the vertices of one heart lie on another (V, 3), by the vertices that both kept.

    Between these the displacement is a thin plate spline's, and then the nearest place of the target's surface that
    faces the same way is taken.

    Parameters
    ----------
    ids, target_ids : (V,), (V_tgt,) vertices of the mesh from which both were decimated
    """
    _, ours, theirs = np.intersect1d(ids, target_ids, return_indices=True)
    small, large = float(np.sqrt(template.area)), float(np.sqrt(target.area))
    verts, there = template.verts / small, target.verts / large
    spline = RBFInterpolator(verts[ours], there[theirs] - verts[ours], neighbors=min(_NEAR, len(ours)))
    moved = verts + spline(verts)
    surface = Surface(there, target.faces, vertex_normals(there, target.faces))
    foot = surface.query(moved, vertex_normals(moved, template.faces))
    return np.asarray(large * foot.values(target.faces, there))


def save_registered(
    folder: Path,
    shapes: Mapping[str, Shape],
    truth: Mapping[str, np.ndarray],
    template: str,
    names: Sequence[str],
) -> None:
    """Some hearts as meshes with the vertices and triangles of one of them, a file for each."""
    make_folder(folder)
    first, ids = shapes[template], truth[template][:, 0]
    for name in names:
        verts = first.verts if name == template else registered(first, ids, shapes[name], truth[name][:, 0])
        save_shape(folder / f"{name}.ply", Shape(verts, first.faces, name))


def chamber_picture(
    shapes: Mapping[str, Shape],
    truth: Mapping[str, np.ndarray],
    maps: Mapping[Pair, np.ndarray],
    first: str,
    path: Path,
    others: int = 5,
) -> None:
    """One heart's chambers in colours, and the same colours on others as the maps carry them."""
    palette = label_colors(np.arange(int(truth[first][:, 1].max()) + 1))
    panels = [Panel(shapes[first], palette[truth[first][:, 1]], label=f"{first}: its chambers")]
    for name in [name for name in shapes if name != first][:others]:
        carried = truth[first][maps[name, first], 1]
        panels.append(Panel(shapes[name], palette[carried], label=f"on {name}"))
    render_shapes(panels, path, Look(up="z", front="-y"))
