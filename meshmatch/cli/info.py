"""``meshmatch info``: describe the content of a file."""

from bisect import bisect_right
from collections import Counter
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from meshmatch.cli import options
from meshmatch.cli.user_messages import Json, print_json, print_rows
from meshmatch.errors import InputError

if TYPE_CHECKING:
    from meshmatch.shapes.parts import Parts
    from meshmatch.shapes.shape import Shape

_ARRAYS = {  # arrays that identify a .npz that is not a map
    "atlas": {"mean", "modes", "deviations"},
    "blendshapes": {"names", "moves"},
    "skin weights": {"names", "joints", "weights"},
    "landmarks of several specimens": {"points", "specimens", "landmarks"},
    "registered shapes": {"points", "faces", "names"},
}
_MAX_PARTS_SHOWN, _MAX_PARTS = 20, 1000  # parts of a mesh in the text, and with --json


def info(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A shape, a map, a fit, a template or landmarks; or the folder of a collection, an atlas, a model or "
            "prepared shapes.",
        ),
    ],
    json: options.Json = False,
) -> None:
    """Describe a file: a shape, a map or a template.

    For a shape, also lists its parts and what the repair before fitting would change. A .npz of an atlas, of blendshapes,
    skin weights, registered shapes or landmarks is named, with its arrays. Nothing is written.
    """
    from meshmatch.maps import MAP_SUFFIXES

    suffix = file.suffix.lower()
    about = _shape
    if file.is_dir():
        about = _folder
    elif suffix == ".safetensors":
        about = _tensors
    elif suffix in (".fcsv", ".pp", ".pts", ".tps", ".landmarkascii"):
        about = _landmarks
    elif suffix in MAP_SUFFIXES and (suffix != ".npy" or _is_list(file)):
        about = _map
    record: Json = {"file": str(file)} | about(file)
    if json:
        print_json(record)
        return
    rows = []
    for key, value in record.items():
        if key == "unit_if_a_person" and value is None:
            continue
        values = value if key in ("repair", "reasons", "meshes", "materials", "notes") else [value]  # a line each
        if key == "largest_parts":
            values = _part_lines(value, record["parts"])
        if key == "flat_bases":
            values = [f"part {each['part']}: {100 * each['share_of_area']:.3g} % of the area" for each in value]
        shown = [_shown(item) for item in values] or ["nothing to do" if key == "repair" else "none"]
        rows += [(key.replace("_", " ") if n == 0 else "", text) for n, text in enumerate(shown)]
    print_rows(rows)


def _is_list(file: Path) -> bool:
    """Whether a .npy has one axis: it is then a map, with two axes a point cloud."""
    from meshmatch.shapes.input_files import check_input_file, read_npy

    try:
        return read_npy(check_input_file(file, "")).ndim == 1
    except InputError:
        return False  # the reader of shapes reports the error


def _shape(file: Path) -> Json:
    from meshmatch.shapes.alignment import guess_unit, long_axis
    from meshmatch.shapes.files import list_meshes, load_shape
    from meshmatch.shapes.parts import Parts
    from meshmatch.shapes.repair import repair

    meshes = list_meshes(file)  # first, so that its memory is freed before the shape is loaded
    shape = load_shape(file)
    size = [float(length) for length in shape.bounds[1] - shape.bounds[0]]
    clean = repair(shape)
    edges: Json = {}
    parts: Json = {}
    if not shape.is_cloud:
        border, crowded = shape.edges.counts
        edges = {"watertight": border == crowded == 0, "open_edges": border, "non_manifold_edges": crowded}
        found, fused = Parts.of(shape), Parts.of(shape, bases=True)
        parts = {"parts": len(found)} | ({"largest_parts": _parts(found, meshes)} if len(found) > 1 else {})
        bases = [
            {"part": n, "share_of_area": float(fused.shares[n - 1])} for n in range(len(found) + 1, len(fused) + 1)
        ]
        parts |= {"flat_bases": bases} if bases else {}
    about: Json = {"kind": "point cloud" if shape.is_cloud else "mesh", "vertices": shape.V, "faces": shape.F}
    if meshes:
        counts: Counter[str] = Counter()
        for name, count in meshes:
            counts[name] += count
        about["meshes"] = [f"{name} ({count:,} vertices)" for name, count in counts.items()]
    about |= _materials(file, shape)
    about |= {"size": size, "area": shape.area, "colors": shape.colors is not None}
    usual = {"longest_along": long_axis(clean.shape), "unit_if_a_person": guess_unit(clean.shape)}
    repaired: Json = {"repaired_vertices": clean.shape.V, "repaired_faces": clean.shape.F}
    if not shape.is_cloud:  # seams of texture coordinates are open edges until their vertices are merged
        repaired["repaired_watertight"] = not any(clean.shape.edges.counts)
    return about | edges | parts | usual | {"repair": list(clean.notes)} | repaired | {"hash": shape.hash}


def _materials(file: Path, shape: "Shape") -> Json:
    """List the materials of a file with the sizes of their images, or the reason why they cannot be read."""
    from meshmatch.shapes.textured_files import find_appearance

    try:
        look = find_appearance(file, shape, plain=True)
    except InputError as error:
        return {"materials": [error.message]}
    found = []
    for material in () if look is None else look.materials:
        size = None if material.image is None else f"a texture of {material.image.shape[1]} x {material.image.shape[0]}"
        if material.name or size:
            found.append(f"{material.name or 'without a name'} ({size or 'one color'})")
    return {"materials": found} if found else {}


def _parts(parts: "Parts", meshes: list[tuple[str, int]]) -> list[Json]:
    """Describe the largest parts of a mesh, each with the mesh of the scene that has its first vertex."""
    ends = list(accumulate(count for _, count in meshes))
    found: list[Json] = []
    for k in range(min(len(parts), _MAX_PARTS)):
        low, high = parts.bounds[k]
        about: Json = {"part": k + 1, "vertices": int(parts.counts[k]), "share_of_area": float(parts.shares[k])}
        about["size"] = [float(length) for length in high - low]
        if meshes:
            about["mesh"] = meshes[bisect_right(ends, int(parts.first_vertices[k]))][0]
        found.append(about)
    return found


def _part_lines(found: list[Json], count: int) -> list[str]:
    """One line for each of the largest parts, up to a readable number."""
    lines = []
    for each in found[:_MAX_PARTS_SHOWN]:
        size = " x ".join(f"{length:.3g}" for length in each["size"])
        name = f", {each['mesh']}" if "mesh" in each else ""
        share = f"{100 * each['share_of_area']:.3g} % of the area"
        lines.append(f"{each['part']}: {share}, {each['vertices']:,} vertices, {size}{name}")
    return lines + ([f"and {count - _MAX_PARTS_SHOWN:,} more"] if count > _MAX_PARTS_SHOWN else [])


def _map(file: Path) -> Json:
    from meshmatch.cli.user_messages import json_number, map_record
    from meshmatch.maps.files import load_map
    from meshmatch.maps.vertex_map import DIRECTION, UNKNOWN

    try:
        found = load_map(file)
    except InputError:
        if not (other := _not_a_map(file)):
            raise
        return other
    record: Json = {"kind": "map"} | map_record(found, (found.source, found.target))
    if found.target_vertices == UNKNOWN:
        record["target_vertices"] = None
    return record | {"confidence_mean": json_number(found.confidence.mean()), "direction": DIRECTION}


def _not_a_map(file: Path) -> Json:
    """Describe a file with the suffix of a map that is not one; empty if its content is unknown."""
    from zipfile import BadZipFile, ZipFile

    if file.suffix.lower() != ".npz":
        try:
            return _landmarks(file)
        except InputError:
            return {}
    try:
        with ZipFile(file) as arrays:
            names = [name.removesuffix(".npy") for name in arrays.namelist()]
    except (OSError, BadZipFile):
        return {}
    kind = next((kind for kind, own in _ARRAYS.items() if own <= set(names)), None)
    return {} if kind is None else {"kind": kind, "arrays": names}


def _landmarks(file: Path) -> Json:
    from meshmatch.shapes.landmark_files import LANDMARK_READERS, read_landmark_file
    from meshmatch.shapes.tables import read_by_suffix

    found = read_by_suffix(file, dict.fromkeys(LANDMARK_READERS, read_landmark_file), "landmarks", "")
    missing = sum(place.kind == "missing" for place in found.places)
    return {"kind": "landmarks", "landmarks": len(found.places), "missing": missing} | (
        {"names": [place.name for place in found.places]} if found.has_names else {}
    )


def _folder(file: Path) -> Json:
    """Describe a folder: the fits of a collection, an atlas, a model, or what `prepare` made."""
    import csv

    from meshmatch.collections.select_setting import read_manifest
    from meshmatch.collections.stores import Store
    from meshmatch.models.card import is_implicit
    from meshmatch.models.registry import CARD, read_any_card

    if (about := read_manifest(Store.of(file))) is not None:
        verdicts: Counter[str] = Counter()
        if (file / "fits.csv").is_file():  # it is written last
            with (file / "fits.csv").open(encoding="utf-8", newline="") as table:
                verdicts.update(str(row.get("verdict")) for row in csv.DictReader(table))
        counts = [f"{count} {verdict}" for verdict, count in verdicts.items()]
        return {"kind": "fits of a collection", "model": about["model"], "shapes": counts}
    if (file / "atlas.npz").is_file():
        return {"kind": "atlas"}
    if (file / CARD).is_file() or is_implicit(file):
        card = read_any_card(file)
        return {"kind": "model"} | {
            name: getattr(card, name) for name in ("name", "category", "data", "licence", "created")
        }
    if (file / "prepared.json").is_file():
        return _prepared(file)
    if (file / "template.safetensors").is_file():  # of a single shape `prepare` makes a template only
        return _template(file / "template.safetensors")
    hint = "give the name of a file, of a model's folder, or of one that `meshmatch fit`, `prepare` or `atlas` made"
    raise InputError(f"{file} is a folder", hint)


def _prepared(folder: Path) -> Json:
    """Describe a prepared folder: its shapes, and the template."""
    from meshmatch.templates.prepared_folder import prepared_facts

    facts, template = prepared_facts(folder), _template(folder / "template.safetensors")
    lists = {key: found if isinstance(found := facts.get(key), list) else [] for key in ("names", "mirrored", "notes")}
    about: Json = {"kind": "prepared folder", "shapes": len(lists["names"]), "mirrored": len(lists["mirrored"])}
    about |= {name: facts.get(name) for name in ("registered", "align", "scale", "landmarks")}
    about |= {"template": template["name"]}
    about |= {f"template_{name}": template[name] for name in ("vertices", "faces", "nodes")}
    return about | {"notes": [str(note) for note in lists["notes"]]}


def _tensors(file: Path) -> Json:
    """Describe a fit or a template."""
    from meshmatch.maps.fit_files import read_fit_header
    from meshmatch.models.registry import CARD, WEIGHTS

    if file.name == WEIGHTS and file.with_name(CARD).is_file():
        raise InputError(f"{file} contains the weights of a model", f"meshmatch info {file.parent}")
    try:
        fit, _ = read_fit_header(file)
    except InputError:
        return _template(file)
    shown = ("shape", "model", "verdict", "trust", "residual", "up", "front", "partial")
    return (
        {"kind": "fit"} | {name: fit.get(name) for name in shown} | {"reasons": [words for _, words in fit["reasons"]]}
    )


def _template(file: Path) -> Json:
    from meshmatch.templates.template import load_template

    template = load_template(file)
    sizes = {"vertices": template.shape.V, "faces": template.shape.F}
    sizes |= {"dense_vertices": template.dense.V, "dense_faces": template.dense.F, "nodes": template.K}
    about: Json = {"radius": template.reach}
    if not isinstance(template.radius, float):
        about["smallest_radius"] = float(template.radius.min())
    about["parts"] = list(template.label_names)
    about |= {name: getattr(template, name) for name in ("pose", "source", "licence", "hash")}
    return {"kind": "template", "name": template.name} | sizes | about


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
