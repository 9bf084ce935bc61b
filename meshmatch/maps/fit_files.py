"""Read and write fits: safetensors files with the arrays, and a JSON header with everything else.

A collection stores a fit in two states. Before it agrees with the others, the file contains the samples of its shape.
Once finished, it contains the places of the shape's vertices on the template (`Places`), which is all that maps need.
A fit that a user saves contains the shape itself. No file contains the template, or anything that differs between runs.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from meshmatch.errors import InputError, ModelError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.judge.reasons import Reason
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.maps.places import PlacedFit, Places
from meshmatch.maps.vertex_map import VERDICTS
from meshmatch.models.tensor_file import read_header
from meshmatch.shapes.shape import LARGEST, Shape
from meshmatch.templates.template import Template, save_arrays

SCHEMA = 1
_HINT = "fit the shape again; in a folder of fits, remove the file, and run `meshmatch fit` as before"
_SHAPE_PREFIX = "shape_"  # prefix of the names of the shape's arrays
_SHAPE_ARRAYS = ("verts", "faces", "colors", "invalid", "weights", "skinned")
_FIT_FIELDS = {
    **dict.fromkeys(("template_hash", "verdict", "up", "front", "model"), str),
    **{"residual": float, "trust": float, "seed": int, "partial": bool},
}
_PLACES_ARRAYS = ("resting", "height", "distance", "stands", "faces", "fitted")
_MAX_VALUE = 1e6  # no number in an array is larger; units of sqrt(area)
_OPTIONAL_ARRAYS = ("moved", "spread")
Words = dict[str, Any]


@dataclass(frozen=True, eq=False)
class StoredFit:
    """A fit that was read from a file; a `PlacedFit` if it was finished.

    The fit has no ``verts``, and ``seconds`` 0.
    """

    fit: Fit
    samples: OrientedPoints | None  # before agreement; in the fit's core frame
    shape: Shape | None  # of a fit that a user saved, as its file had it
    words: Words  # the extra metadata that `write_fit` was given


def write_fit(
    path: str | Path,
    fit: Fit,
    samples: OrientedPoints | None = None,
    shape: Shape | None = None,
    words: Words | None = None,
) -> None:
    """Write a fit, with its places if it is a `PlacedFit`.

    ``samples`` are those of its shape, ``shape`` is the shape as its file had it, ``words`` is extra metadata (JSON).
    """
    arrays: dict[str, np.ndarray] = {"points": fit.points, "vectors": fit.vectors}
    arrays |= {"rotation": fit.frame.rotation, "center": fit.frame.center}
    about: Words = {name: getattr(fit, name) for name in _FIT_FIELDS}
    about |= {"reasons": [[reason.code, str(reason)] for reason in fit.reasons], "scale": fit.frame.scale}
    about |= {"left_out": list(fit.left_out)} if fit.left_out else {}
    about |= {"side": fit.side} if fit.side else {}
    if fit.regularity is not None:
        about["regularity"] = asdict(fit.regularity)
    if isinstance(fit, PlacedFit):
        places = fit.places
        arrays |= {name: getattr(places, name) for name in _PLACES_ARRAYS}
        arrays |= {name: kept for name in _OPTIONAL_ARRAYS if (kept := getattr(places, name)) is not None}
        about |= {"shape": places.name, "shape_hash": places.hash}
    if samples is not None:
        arrays |= {"sample_points": samples.points, "sample_normals": samples.normals}
        if samples.weights is not None:
            arrays["sample_weights"] = samples.weights
        about["signed"] = samples.signed
    if shape is not None:
        arrays |= {_SHAPE_PREFIX + name: kept for name in _SHAPE_ARRAYS if (kept := getattr(shape, name)) is not None}
        about |= {"shape": shape.name, "upright": shape.upright, "made_of": shape.made_of, "notes": fit.notes}
    header = {"schema": SCHEMA, "fit": about, "more": words or {}}
    save_arrays(path, arrays, {"fit": json.dumps(header, sort_keys=True)})


def read_fit_header(path: str | Path) -> tuple[Words, Words]:
    """Read the header of a fit's file: the fit's fields and the extra metadata, without arrays. Errors as `read_fit`."""
    path = Path(path)
    try:
        read_header(path)
        with safe_open(str(path), framework="np") as file:
            header = json.loads((file.metadata() or {})["fit"])
        if header["schema"] != SCHEMA:
            raise InputError(f"{path.name} has fit schema {header['schema']!r}, not {SCHEMA}", "update meshmatch")
        about, more = dict(header["fit"]), dict(header["more"])
        odd = [name for name, kind in _FIT_FIELDS.items() if type(about[name]) is not kind]
        if not odd and not 0 <= about["trust"] <= 1:
            odd = ["trust"]
        if odd or about["verdict"] not in VERDICTS:
            raise InputError(f"{path.name}: its {odd[0] if odd else 'verdict'} is invalid", _HINT)
        about["reasons"] = [(str(code), str(sentence)) for code, sentence in about["reasons"]]
        regularity_of(about)
        return about, more
    except ModelError as error:
        raise InputError(error.message, _HINT) from error
    except (SafetensorError, KeyError, TypeError, ValueError, OSError, RecursionError) as error:
        raise InputError(f"{path.name} is not a fit's file", _HINT) from error


def read_fit(path: str | Path, template: Template) -> StoredFit:
    """Read a fit of this template; `InputError` if the file is missing, damaged, of another schema or template."""
    path = Path(path)
    about, more = read_fit_header(path)
    if about["template_hash"] != template.hash:
        wrong = f"{path.name} is a fit of another template ({about['template_hash']}, not {template.hash})"
        raise InputError(wrong, "use the model that made it")
    try:
        with safe_open(str(path), framework="np") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
        V = template.shape.V
        fit = Fit(
            frame=Frame(float(about["scale"]), arrays["rotation"], arrays["center"]),
            points=_checked_array(arrays, "points", np.float64, (V, 3)),
            vectors=_checked_array(arrays, "vectors", np.float64, (template.K, 3)),
            resting=np.asarray(template.shape.verts),
            faces=np.asarray(template.shape.faces),
            verts=np.empty((0, 3)),
            reasons=tuple(Reason(code, str(sentence)) for code, sentence in about["reasons"]),
            seconds=0.0,
            left_out=_part_numbers(about.get("left_out", [])),
            regularity=regularity_of(about),
            side=float(about.get("side", 0.0)),
            notes=tuple(map(str, about.get("notes", ()))),
            **{name: about[name] for name in _FIT_FIELDS},
        )
        if not (1 / LARGEST < fit.frame.scale < LARGEST and (np.abs(fit.frame.center) < LARGEST).all()):
            raise ValueError("its frame is invalid")
        places = _places(arrays, about, fit)
        fit = fit if places is None else PlacedFit.of(fit, places)
        return StoredFit(fit, _samples(arrays, about), _shape(arrays, about), more)
    except (InputError, SafetensorError, KeyError, TypeError, ValueError, OverflowError, OSError) as error:
        raise InputError(f"{path.name} is damaged: {error}", _HINT) from error


def _part_numbers(values: Any) -> tuple[int, ...]:
    """The numbers of the parts that were left out, counted from 1; `ValueError` if they are anything else."""
    if not isinstance(values, list) or not all(type(each) is int and each > 0 for each in values):
        raise ValueError("its parts are invalid")
    return tuple(values)


def regularity_of(about: Words) -> Regularity | None:
    """Regularity of the deformation, from a fit's header; None if the file is of a version that did not store it.

    `ValueError`, `KeyError` or `TypeError` for invalid numbers.
    """
    if "regularity" not in about:
        return None
    found = Regularity(*(about["regularity"][field.name] for field in fields(Regularity)))
    numbers = found.inverted, found.volume
    if {*map(type, numbers)} != {float} or not (0 <= found.inverted <= 1 and 0 <= found.volume < math.inf):
        raise ValueError("its regularity is invalid")
    return found


def _places(arrays: dict[str, np.ndarray], about: Words, fit: Fit) -> Places | None:
    if "resting" not in arrays:
        return None
    V, F = len(arrays["resting"]), len(arrays["faces"])
    kinds: dict[str, tuple[Any, tuple[int, ...]]] = {
        **dict.fromkeys(("height", "distance", "spread"), (np.float32, (V,))),
        **{"resting": (np.float32, (V, 3)), "moved": (np.float32, (V, 3)), "stands": (np.int32, (V,))},
        **{"faces": (np.int32, (F, 3)), "fitted": (np.bool_, (F,))},
    }
    found = {name: _checked_array(arrays, name, *kinds[name]) for name in kinds if name in arrays}
    for name in ("stands", "faces"):
        if found[name].size and not (0 <= found[name].min() and found[name].max() < V):
            raise ValueError(f"{name} names a vertex that is not there")
    optional: Words = {name: found.get(name) for name in _OPTIONAL_ARRAYS}
    required: Words = {name: found[name] for name in _PLACES_ARRAYS}
    words: Words = {"name": str(about["shape"]), "hash": str(about["shape_hash"]), "template_hash": fit.template_hash}
    judged: Words = {"verdict": fit.verdict, "reasons": tuple(map(str, fit.reasons)), "trust": fit.trust}
    return Places(**words, **required, **optional, **judged)


def _samples(arrays: dict[str, np.ndarray], about: Words) -> OrientedPoints | None:
    if "sample_points" not in arrays:
        return None
    P = len(arrays["sample_points"])
    points, normals = (_checked_array(arrays, f"sample_{name}", np.float64, (P, 3)) for name in ("points", "normals"))
    weights = _checked_array(arrays, "sample_weights", np.float64, (P,)) if "sample_weights" in arrays else None
    return OrientedPoints(points, normals, bool(about["signed"]), weights)


def _shape(arrays: dict[str, np.ndarray], about: Words) -> Shape | None:
    if _SHAPE_PREFIX + "verts" not in arrays:
        return None
    known: Words = {name: arrays[_SHAPE_PREFIX + name] for name in _SHAPE_ARRAYS if _SHAPE_PREFIX + name in arrays}
    if not (np.abs(known["verts"]) < LARGEST).all():
        raise ValueError("its shape has invalid vertices")
    made_of = tuple(map(str, about["made_of"]))
    return Shape(name=str(about["shape"]), upright=about["upright"] is True, made_of=made_of, **known)


def _checked_array(arrays: dict[str, np.ndarray], name: str, kind: Any, shape: tuple[int, ...]) -> Any:
    array = arrays[name]
    if array.dtype != kind or array.shape != shape:
        raise ValueError(f"{name} is an array of {array.shape} {array.dtype}, not of {shape} {np.dtype(kind)}")
    if array.dtype.kind == "f" and not (np.abs(array) < _MAX_VALUE).all():
        raise ValueError(f"{name} has invalid numbers")
    return array
