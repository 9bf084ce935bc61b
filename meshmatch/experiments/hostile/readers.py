"""Functions that read the files of each family of `experiments.hostile`, and a check of their messages."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path

import numpy as np
import torch

from meshmatch.cli.info import info
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.collection import Collection
from meshmatch.collections.map_all import load_pairs as load_names
from meshmatch.collections.registered import Registered, read_group
from meshmatch.errors import MeshmatchError, visible
from meshmatch.experiments.hostile.learned import trainers
from meshmatch.generators.pose_files import load_poses
from meshmatch.implicit.model import load_implicit
from meshmatch.implicit.samples import sample_shape
from meshmatch.maps.files import load_map
from meshmatch.maps.fit_files import read_fit
from meshmatch.models.card import IMPLICIT, read_card, read_implicit_card
from meshmatch.models.checkpoint import load_weights as load_network
from meshmatch.models.registry import TEMPLATE, verify_model
from meshmatch.shapes.appearance import ImageReader
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.parts import Parts
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import find_appearance, load_coordinates
from meshmatch.shapes.vertex_lists import load_pairs, load_points
from meshmatch.templates.prepared_folder import (
    card_frame,
    has_sides,
    is_registered,
    read_landmarks,
    read_registered,
    read_samples,
)
from meshmatch.templates.template import load_template
from meshmatch.training.datasets import registered_source
from meshmatch.transfer.label_files import load_labels
from meshmatch.transfer.landmarks import load_landmarks
from meshmatch.transfer.value_files import load_values
from meshmatch.transfer.weight_files import load_weights

_EGGS = Registered(
    np.empty((0, 0, 3)), np.empty((0, 3), np.int64), ("egg0", "egg1", "egg 2", "egg3"), None, {"egg4": "poor"}
)


def readers(family: str, path: Path, shape: Shape) -> Iterator[Callable[[], object]]:
    """Yield everything that meshmatch does when it reads a file of a family."""
    if family == "shapes":
        yield lambda: _load_all(path)
        yield lambda: _select_parts(path)
        yield lambda: _write_again(path)
        if path.suffix in (".glb", ".gltf"):
            yield lambda: load_weights(path, load_shape(path))
    simple: dict[str, tuple[Callable[[], object], ...]] = {
        "maps": (lambda: load_map(path), lambda: load_map(path, shape, shape)),
        "tables": (lambda: load_values(path, shape),),
        "lists": (lambda: load_pairs(path), lambda: load_points(path)),
        "known points": (lambda: read_landmarks(path, repair(shape)),),
        "names": (lambda: read_group(path, _EGGS) if path.stem == "group" else load_names(path),),
        "poses": (lambda: load_poses(path),),
        "samples": (lambda: sample_shape(path, 64, np.random.default_rng(0)),),
        "fits": (lambda: Collection(path.parents[1], 1).atlas(poor=True), lambda: _map_all(path)),
        "atlases": (lambda: _use_atlas(path),),
        "prepared": tuple(partial(read, path.parent) for read in (_draw_shapes, is_registered, card_frame, has_sides)),
        "checkpoints": (lambda: trainers()[path.stem == "chair"].load(path),),
        "models": (lambda: verify_model(path.parent),),
        "implicit models": (lambda: verify_model(path.parent), lambda: load_implicit(path.parent)),
        "labels": (lambda: load_labels(path, shape, "vertices"), lambda: load_labels(path, shape)),
        "weights": (lambda: load_weights(path, shape),),
        "landmarks": (lambda: load_landmarks(path, shape),),
        "images": (lambda: ImageReader().decode(path.read_bytes(), path.name),),
        "safetensors": (lambda: load_network(path, {"a.weight": (4, 70), "a.bias": (4,)}),),
        "templates": (lambda: load_template(path),),
        "cards": (lambda: read_implicit_card(path.parent) if path.name == IMPLICIT else read_card(path),),
    }
    yield from simple.get(family, ())
    if family in ("shapes", "maps", "templates"):
        yield lambda: _info(path)


def _load_all(path: Path) -> None:
    shape = load_shape(path)
    results = []
    for load in (find_appearance, load_coordinates):
        try:
            results.append(load(path, shape))
        except MeshmatchError as error:
            check(error.message, error.hint)


def _select_parts(path: Path) -> None:
    """Select parts of a shape by number or name."""
    for only, without in (("1", ()), ((), ("2", "sto*")), (("body", "1"), "*")):
        try:
            load_shape(path, only=only, without=without)
        except MeshmatchError as error:
            check(error.message, error.hint)
    Parts.of(load_shape(path))


def _write_again(path: Path) -> None:
    """Write a shape in other formats and read it again."""
    shape = load_shape(path)
    for suffix in (".ply", ".glb") if shape.is_cloud else (".ply", ".obj", ".off", ".glb", ".stl"):
        copy = path.with_name(f"again{suffix}")
        save_shape(copy, shape)
        again = load_shape(copy)
        if suffix != ".stl" and (again.V, again.F) != (shape.V, shape.F):
            raise AssertionError(f"{suffix} has {again.V} vertices and {again.F} faces, not {shape.V} and {shape.F}")


def _map_all(path: Path) -> None:
    fits = path.parents[1]
    if path.parent.name == "alone":
        read_fit(path, load_template(fits / TEMPLATE))
    Collection(fits, 1).save_maps(fits / "maps")


def _use_atlas(path: Path) -> None:
    atlas = Atlas.load(path)
    atlas.sample(1)
    atlas.project(atlas.mean)
    check(*atlas.names)


def _draw_shapes(folder: Path) -> None:
    """Draw shapes from a prepared folder, as in training."""
    template = load_template(folder / TEMPLATE)
    read_samples(folder, template)
    registered_source(torch.from_numpy(read_registered(folder, template)))(2, torch.Generator().manual_seed(0))


def _info(path: Path) -> None:
    """Run the command `info` and check its output, which is captured so that it does not count as stray output."""
    out = io.StringIO()
    with redirect_stdout(out):
        info(path, False)
    check(*out.getvalue().splitlines())


class BadMessage(Exception):
    """A message with a line break or terminal escapes."""


def check(*lines: str) -> None:
    for line in lines:
        if visible(line) != line or "\n" in line:
            raise BadMessage(line)
