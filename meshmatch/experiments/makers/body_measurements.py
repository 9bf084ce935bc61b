"""Make the reference body of ``meshmatch measure body``: the template of ``human`` in metres, standing on the floor, with
landmarks and measurements.

    python -m meshmatch.experiments.makers.body_measurements -o templates/measurements

A landmark is the point where a ray from inside the body leaves it, or the outermost vertex of a part. The origins of the
rays, in centimetres, were chosen from cross sections. Girths are those of tailoring and anthropometry (most are in
ISO 8559-1), at positions chosen on the template: where it is narrowest between ribs and hips, widest around seat and calf,
and so on.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from typer import Option

from meshmatch.arrays import Float, Floats
from meshmatch.experiments import runner
from meshmatch.geometry.triangles import interpolate
from meshmatch.models.registry import load_model
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_rows

_SKIN_AREA = 1.9  # square metres
# Origin of each ray in centimetres (x to the body's left, y up from the floor, z ahead), and its direction.
_MIDDLE = {
    "forehead": ((0, 168, 3), (0, 0, 1)),
    "chin": ((0, 155, 3), (0, 0, 1)),
    "throat": ((0, 153, 0), (0, 0, 1)),
    "nape": ((0, 151, 0), (0, 0, -1)),
    "chest": ((0, 129, 0), (0, 0, 1)),
    "waist": ((0, 113.5, 0), (0, 0, 1)),
    "waist back": ((0, 113.5, 0), (0, 0, -1)),
    "crotch": ((0, 95, -1.5), (0, -1, 0)),
}
_LEFT = {  # the right side has the mirror images, with x negated
    "hip": ((0, 92.5, -2), (1, 0, 0)),
    "thigh": ((13, 81, -1.5), (0, 0, 1)),
    "knee": ((23.5, 48.5, -3), (0, 0, 1)),
    "inner knee": ((23.5, 48.5, -3), (-1, 0, 0)),
    "calf": ((26, 39, -4), (0, 0, -1)),
    "ankle": ((32.2, 15, -2.7), (1, 0, 0)),
    "inner ankle": ((33.8, 9, -0.6), (-1, 0, 0)),
    "shoulder": ((17.5, 145, -2), (0, 1, 0)),
    "upper arm": ((30, 142, -1.2), (0, 1, 0)),
    "elbow": ((43.5, 140.6, 2), (0, 0, -1)),
    "forearm": ((49, 140, 3), (0, 1, 0)),
    "wrist": ((69.5, 137.5, 7.3), (0, 1, 0)),
}
_MIDDLE_GIRTHS = {
    "head": ("forehead", "crotch", "crown"),
    "neck": ("throat", "nape", "crown"),
    "chest": ("chest", "crotch", "crown"),
    "waist": ("waist", "crotch", "crown"),
    "hip": ("left hip", "crotch", "crown"),
}
_GIRTHS = {
    "thigh": ("thigh", "knee", "thigh"),
    "knee": ("knee", "knee", "thigh"),
    "calf": ("calf", "inner ankle", "inner knee"),
    "ankle": ("ankle", "inner ankle", "inner knee"),
    "upper arm": ("upper arm", "upper arm", "forearm"),
    "forearm": ("forearm", "forearm", "wrist"),
    "wrist": ("wrist", "forearm", "wrist"),
}
_LENGTHS = {
    "arm length": ("shoulder", "elbow", "wrist"),
    "inside leg length": ("crotch", "inner knee", "inner ankle"),
    "foot length": ("heel", "toe"),
    "hand length": ("wrist", "fingertip"),
}


def _landmarks(body: Shape) -> dict[str, Float[Floats, " 3"]]:
    landmarks = {"crown": body.verts[body.verts[:, 1].argmax()]}
    landmarks |= {name: _exit_point(body, *ray) for name, ray in _MIDDLE.items()}
    for side, sign in (("left", 1), ("right", -1)):
        mirror = np.array([sign, 1, 1])
        landmarks |= {
            f"{side} {name}": _exit_point(body, mirror * start, mirror * direction)
            for name, (start, direction) in _LEFT.items()
        }
        foot = body.verts[(sign * body.verts[:, 0] > 0.25) & (body.verts[:, 1] < 0.12)]
        landmarks |= {f"{side} heel": foot[foot[:, 2].argmin()], f"{side} toe": foot[foot[:, 2].argmax()]}
        landmarks[f"{side} fingertip"] = body.verts[(sign * body.verts[:, 0]).argmax()]
    return landmarks


def _exit_point(body: Shape, start: ArrayLike, direction: ArrayLike) -> Float[Floats, " 3"]:
    """First intersection of the body's surface with a ray from a point inside it, given in centimetres."""
    corners = body.verts[body.faces]
    origin, ray = np.asarray(start) / 100.0, np.asarray(direction, np.float64)
    matrices = np.stack(
        [corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], np.tile(-ray, (body.F, 1))], axis=2
    )
    solution = np.linalg.solve(matrices + 1e-15 * np.eye(3), (origin - corners[:, 0])[:, :, None])[:, :, 0]
    weights = np.column_stack([1 - solution[:, 0] - solution[:, 1], solution[:, :2]])
    hits = np.flatnonzero((weights >= -1e-9).all(axis=1) & (solution[:, 2] > 0))
    nearest = hits[solution[hits, 2].argmin()]
    return np.asarray(interpolate(body.verts, body.faces[[nearest]], weights[[nearest]])[0])


def _measurements() -> list[list[str]]:
    rows = [[f"{name} girth", "girth", *landmarks] for name, landmarks in _MIDDLE_GIRTHS.items()]
    rows += [
        ["shoulder breadth", "distance", "left shoulder", "right shoulder"],
        ["back length", "distance", "nape", "waist back"],
        ["head height", "distance", "chin", "crown"],
    ]
    for side in ("left", "right"):
        for kind, group in (("girth", _GIRTHS), ("distance", _LENGTHS)):
            for name, landmarks in group.items():
                landmark_names = [each if each == "crotch" else f"{side} {each}" for each in landmarks]
                rows.append([f"{side} {name}{' girth' if kind == 'girth' else ''}", kind, *landmark_names])
    return rows


@runner.command
def main(
    output: Annotated[Path, Option("-o", "--output", help="output folder; in the package it is below templates")],
) -> runner.Report:
    template = load_model("human").template.shape
    verts = template.verts * np.sqrt(_SKIN_AREA / template.area)
    body = Shape(verts - [0, verts[:, 1].min(), 0], template.faces, "body")
    output.mkdir(parents=True, exist_ok=True)
    save_shape(output / "body.ply", body)
    landmarks, measurements = _landmarks(body), _measurements()
    rows = [[name, *np.round(point, 5).tolist()] for name, point in landmarks.items()]
    write_rows(output / "body-landmarks.csv", ["name", "x", "y", "z"], rows)
    cells = [[*each, *[""] * (5 - len(each))] for each in measurements]
    write_rows(output / "body-measurements.csv", ["name", "kind", "first", "second", "third"], cells)
    return runner.Report({"landmarks": len(rows), "measurements": len(cells)}, notes=[f"wrote {output}"])
