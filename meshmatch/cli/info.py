"""``meshmatch info``: what is in a file."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from meshmatch.cli import options
from meshmatch.cli.console import print_json, print_rows

if TYPE_CHECKING:
    from meshmatch.shapes.shape import Shape

Record = dict[str, Any]


def info(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A shape, a map or a template bundle.")],
    json: options.Json = False,
) -> None:
    """Say what is in a file.

    Of a shape also what repair would do. Nothing is written.
    """
    record = _reader(file)(file)
    if json:
        print_json(record)
        return
    rows = []
    for key, value in record.items():
        values = value if key in ("repair", "reasons") else [value]  # a line each
        shown = [_shown(item) for item in values] or ["nothing to do" if key == "repair" else "none"]
        rows += [(key if n == 0 else "", text) for n, text in enumerate(shown)]
    print_rows([(key.replace("_", " "), text) for key, text in rows])


def _reader(file: Path) -> Callable[[Path], Record]:
    from meshmatch.maps import MAP_SUFFIXES

    suffix = file.suffix.lower()
    if suffix == ".safetensors":
        return _template
    if suffix in MAP_SUFFIXES and (suffix != ".npy" or _is_list(file)):
        return _map
    return _shape


def _is_list(file: Path) -> bool:
    """A .npy of one axis is a map, one of two is a cloud."""
    from meshmatch.errors import InputError
    from meshmatch.shapes.input_files import existing, read_npy

    try:
        return read_npy(existing(file, "")).ndim == 1
    except InputError:
        return False  # whatever is wrong with it, the reader of shapes says it well


def _shape(file: Path) -> Record:
    from meshmatch.geometry.topology import edges_of, face_parts
    from meshmatch.shapes.files import load_shape
    from meshmatch.shapes.normalise import guess_unit, long_axis
    from meshmatch.shapes.repair import repair

    shape = load_shape(file)
    record: Record = {
        "file": str(file),
        "kind": "point cloud" if shape.is_cloud else "mesh",
        "vertices": shape.V,
        "faces": shape.F,
        "size": _extent(shape),
        "area": shape.area,
        "colors": shape.colors is not None,
    }
    if not shape.is_cloud:
        border, crowded = edges_of(shape.faces).counts
        record["watertight"] = border == crowded == 0
        record["open_edges"] = border
        record["non_manifold_edges"] = crowded
    clean = repair(shape)
    if not shape.is_cloud:  # of the repaired mesh: the seams of texture and the corners of an stl are joined
        record["parts"] = int(face_parts(clean.shape.faces, clean.shape.V).max()) + 1
    record["longest_along"] = long_axis(clean.shape)
    record["unit_if_a_person"] = guess_unit(clean.shape)
    record["repair"] = list(clean.notes)
    record["repaired_vertices"] = clean.shape.V
    record["repaired_faces"] = clean.shape.F
    record["hash"] = shape.hash
    return record


def _extent(shape: "Shape") -> list[float]:
    return [float(length) for length in shape.bounds[1] - shape.bounds[0]]


def _map(file: Path) -> Record:
    from meshmatch.maps.files import load_map
    from meshmatch.maps.vertex_map import DIRECTION, UNKNOWN

    found = load_map(file)
    known = found.target_vertices != UNKNOWN
    return {
        "file": str(file),
        "kind": "map",
        "source": found.source,
        "target": found.target,
        "source_vertices": found.source_vertices,
        "target_vertices": found.target_vertices if known else None,
        "verdict": found.verdict,
        "reasons": list(found.reasons),
        "confidence_mean": float(found.confidence.mean()),
        "direction": DIRECTION,
    }


def _template(file: Path) -> Record:
    from meshmatch.templates.template import load_template

    template = load_template(file)
    return {
        "file": str(file),
        "kind": "template",
        "name": template.name,
        "vertices": template.shape.V,
        "faces": template.shape.F,
        "dense_vertices": template.dense.V,
        "dense_faces": template.dense.F,
        "nodes": template.K,
        "radius": template.radius,
        "parts": list(template.label_names),
        "pose": template.pose,
        "source": template.source,
        "licence": template.licence,
        "hash": template.hash,
    }


def _shown(value: Any) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        numbers = all(isinstance(item, float) for item in value)
        return (" x " if numbers else ", ").join(_shown(item) for item in value)
    return str(value)
