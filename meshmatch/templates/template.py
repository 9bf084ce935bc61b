"""Template bundles: the mesh that is deformed, its control nodes and labels; and frames that scale shapes to its size."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from meshmatch.arrays import Float, Floats, Int, Ints, PickledFields, ShortRepr
from meshmatch.errors import InputError, TemplateError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.alignment import sqrt_area_frame, unit_sphere_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder

Scale = Literal["area", "sphere"]
SCALES: tuple[Scale, ...] = get_args(Scale)
SCHEMA = 2
MAX_BYTES = 50_000_000
"""Larger bundles are refused: 8-bit numbers take 64 bits in memory, and more while they are checked."""
_ONE_RADIUS = 1  # schema of bundles whose nodes share one radius, stored in the metadata; others have an array
_ARRAYS = ("verts", "faces", "dense_verts", "dense_faces", "nodes", "labels", "core")


_INTEGER_ARRAYS = ("faces", "dense_faces", "labels", "core")


@dataclass(frozen=True, eq=False, repr=False)
class Template(ShortRepr, PickledFields):
    """The reference shape of a category.

    Frame: surface area 1, area-weighted centroid at 0; human templates stand y up, face +z, left hand at +x.

    The core are vertices that move almost as one rigid piece and define the category's frame, such as a torso; all vertices
    if a category has no such part.
    """

    name: str
    shape: Shape  # low resolution mesh, which fits deform; V vertices
    dense: Shape  # high resolution mesh of the same surface, for `register` and pictures
    nodes: Float[Floats, "K 3"]
    radius: float | Float[Floats, " K"]  # support radius of all nodes, or of each if they differ
    labels: Int[Ints, " V"]  # part of each vertex, an index into `label_names`
    label_names: tuple[str, ...]
    core: Int[Ints, " C"]
    pose: str = ""
    source: str = ""
    licence: str = ""

    def __post_init__(self) -> None:
        if self.nodes.ndim != 2 or self.nodes.shape[1] != 3 or not np.isfinite(self.nodes).all():
            raise TemplateError(f"template {self.name}: nodes must be finite with shape (K, 3)")
        if self.labels.shape != (self.shape.V,) or self.labels.min() < 0:
            raise TemplateError(f"template {self.name}: one label per vertex is needed")
        if len(self.label_names) <= self.labels.max():
            raise TemplateError(f"template {self.name}: a label has no name")
        if len(self.core) < 3 or self.core.min() < 0 or self.core.max() >= self.shape.V:
            raise TemplateError(f"template {self.name}: the core needs at least three valid vertices")
        radii = np.asarray(self.radius, np.float64)
        if not (radii > 0).all() or not np.isfinite(radii).all() or radii.shape not in ((), (self.K,)):
            raise TemplateError(f"template {self.name}: the radius must be positive, one number or one for each node")
        if radii.min() == radii.max():  # equal radii become one number, so that the hash is the same
            object.__setattr__(self, "radius", float(radii.min()))

    @property
    def K(self) -> int:
        return len(self.nodes)

    @property
    def reach(self) -> float:
        """The largest support radius."""
        return float(np.max(self.radius))

    @cached_property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of all arrays that a model depends on.

        Labels and the dense mesh are left out: they affect neither the meaning of node vectors nor the compatibility of
        fits.
        """
        digest = hashlib.sha256()
        for array in (self.shape.verts, self.shape.faces, self.nodes, np.atleast_1d(self.radius), self.core):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]


def save_template(template: Template, path: str | Path) -> None:
    """Write a bundle as one safetensors file: arrays, and a JSON header with everything else."""
    integers = {"faces": template.shape.faces, "dense_faces": template.dense.faces}
    integers |= {"labels": template.labels, "core": template.core}
    arrays: dict[str, np.ndarray] = {name: values.astype(np.int32) for name, values in integers.items()}
    arrays |= {"verts": template.shape.verts, "nodes": template.nodes}
    arrays["dense_verts"] = template.dense.verts.astype(np.float32)
    keys = ("name", "label_names", "pose", "source", "licence", "hash")
    metadata = {key: getattr(template, key) for key in keys}
    if isinstance(template.radius, float):
        metadata |= {"schema": _ONE_RADIUS, "radius": template.radius}
    else:
        metadata |= {"schema": SCHEMA}
        arrays["radii"] = template.radius
    save_arrays(path, arrays, {"template": json.dumps(metadata)})


def save_arrays(path: str | Path, arrays: dict[str, np.ndarray], words: dict[str, str] | None = None) -> None:
    """Write one safetensors file, with ``words`` as its metadata."""
    with replace_on_success(path) as temporary:
        save_file({name: np.ascontiguousarray(array) for name, array in arrays.items()}, temporary, words)


@np.errstate(invalid="ignore")  # casts of nan, which are refused
def load_template(path: str | Path) -> Template:
    """Read a bundle; `TemplateError` if it is missing, damaged, of another schema, or does not match its hash."""
    path = Path(path)
    if not path.is_file():
        raise TemplateError(f"no template bundle at {path}", "make one with `meshmatch prepare`")
    if path.stat().st_size > MAX_BYTES:
        raise TemplateError(f"{path.name} is larger than a template may be: {MAX_BYTES // 10**6} MB", "make it smaller")
    try:
        with safe_open(str(path), framework="np") as file:
            metadata = json.loads((file.metadata() or {})["template"])
            if not isinstance(metadata, dict):
                raise KeyError("words")
            schema = metadata.get("schema")
            expected = {*_ARRAYS, "radii"} if schema == SCHEMA else set(_ARRAYS)
            if schema in (_ONE_RADIUS, SCHEMA) and set(file.keys()) != expected:
                raise KeyError("arrays")
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
            if any(arrays[name].dtype.kind not in "iu" for name in _INTEGER_ARRAYS if name in arrays):
                raise KeyError("whole numbers")
    except (SafetensorError, KeyError, ValueError, OSError, RecursionError) as error:
        raise TemplateError(f"{path.name} is not a template bundle", "make one with `meshmatch prepare`") from error
    if schema not in (_ONE_RADIUS, SCHEMA):
        raise TemplateError(f"{path.name} has template schema {schema}, not at most {SCHEMA}", "update meshmatch")
    try:
        name = str(metadata["name"])
        template = Template(
            name=name,
            shape=Shape(arrays["verts"].astype(np.float64), arrays["faces"].astype(np.int64), name),
            dense=Shape(arrays["dense_verts"].astype(np.float64), arrays["dense_faces"].astype(np.int64), name),
            nodes=arrays["nodes"].astype(np.float64),
            radius=arrays["radii"].astype(np.float64) if schema == SCHEMA else float(metadata["radius"]),
            labels=arrays["labels"].astype(np.int64),
            label_names=tuple(metadata["label_names"]),
            core=arrays["core"].astype(np.int64),
            **{key: metadata[key] for key in ("pose", "source", "licence")},
        )
    except (KeyError, TypeError, ValueError, IndexError, InputError) as error:
        raise TemplateError(f"{path.name} is not a template bundle: {error}", "make it again") from error
    if template.hash != metadata.get("hash"):
        raise TemplateError(f"{path.name} is damaged: its content does not match its hash", "make or fetch it again")
    return template


def read_template(name: str | Path) -> Template:
    """Read a template by file, or a built-in one by name (human-T, human-A, human-I, human-T-300).

    `TemplateError` as `load_template`.
    """
    path = Path(name)
    if path.is_file():
        return load_template(path)
    inside = bundled_folder() / "human" / f"{name}.safetensors"
    return load_template(inside if inside.is_file() else path)


def unit_frame(shape: Shape, scale: Scale, radius: float) -> Frame:
    """Frame that centers and scales a shape without rotating it: to area 1, or to ``radius`` around the centroid.

    ``radius`` is the template's `template_radius`.
    """
    if scale == "area":
        return sqrt_area_frame(shape)
    frame = unit_sphere_frame(shape)
    return Frame(frame.scale / radius, frame.rotation, frame.center)


def template_radius(template: Template) -> float:
    """Largest distance of a vertex from the template's centroid."""
    return float(np.linalg.norm(template.shape.verts, axis=1).max())


def template_samples(template: Template) -> OrientedPoints:
    """Samples of the template to which shapes are aligned."""
    return sample_surface(template.shape, 3000, np.random.default_rng(0))
