"""Samples of fits, atlases, prepared folders, models and checkpoints, for `experiments.hostile`.

All of them are made from three eggs in seconds, so that the files are small.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from trimesh.creation import icosphere

from meshmatch.api.prepare import PrepareConfig, prepare
from meshmatch.collections.collection import Collection
from meshmatch.implicit.network import ImplicitConfig
from meshmatch.implicit.samples import read_implicit_samples
from meshmatch.implicit.training import TRAINING, build_implicit, train_implicit
from meshmatch.models.card import IMPLICIT
from meshmatch.models.network import NetworkConfig
from meshmatch.models.registry import CARD, TEMPLATE, WEIGHTS
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepared_folder import read_registered
from meshmatch.templates.template import load_template
from meshmatch.training.datasets import registered_source
from meshmatch.training.folder_lock import CHECKPOINT
from meshmatch.training.loop import TrainConfig, Trainer
from meshmatch.training.recipes import Recipe
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import build_deformer, train

_NETWORK = NetworkConfig(
    code=16, width=32, depth=1, basis=24, align_basis=16, align_width=16, corrections=2, correct_width=16
)
RECIPE = Recipe(
    _NETWORK,
    TrainConfig(steps=2, shapes=4, scans_per_shape=1, workers=0, warm_up=1),
    ScanConfig(points=96, noise=0.012, outliers=0, partial=0),
    "smooth",
)
"""Recipe of a network that trains in a second."""
IMPLICIT_TRAINING = replace(TRAINING, steps=2, shapes=2, warm_up=1)
_KINDS = {"F64": "<f8", "F32": "<f4", "I32": "<i4", "I64": "<i8"}
_IMPLICIT_NETWORK = ImplicitConfig("mls", code=8, width=24, depth=2, inner=8, nodes=20)


def write_eggs(folder: Path, count: int = 3, splits: int = 3) -> None:
    """Write eggs with the same triangles: an icosahedron subdivided ``splits`` times."""
    folder.mkdir(parents=True)
    ball, rng = icosphere(splits), np.random.default_rng(8)
    for number in range(count):
        verts = ball.vertices * [0.8, 1.5, 1.0] @ (np.eye(3) + 0.02 * rng.normal(size=(3, 3)))
        save_shape(folder / f"egg{number}.ply", Shape(verts, np.asarray(ball.faces, np.int64)))


def prepare_eggs(eggs: Path, output: Path) -> None:
    """Write the prepared folder of a folder of eggs."""
    prepare(eggs, output, PrepareConfig(NodeConfig(strategy="uniform", K=36, radius=0.45, depth=0.05)))


@cache
def trainers() -> tuple[Trainer, Trainer]:
    """Trainers that read the checkpoints of explicit and of implicit models."""
    with tempfile.TemporaryDirectory() as place:
        eggs, ready = Path(place, "eggs"), Path(place, "ready")
        write_eggs(eggs)
        prepare_eggs(eggs, ready)
        template = load_template(ready / TEMPLATE)
        source = registered_source(torch.from_numpy(read_registered(ready, template)))
        network = build_implicit(read_implicit_samples(eggs), _IMPLICIT_NETWORK, 0)
    model = build_deformer(template, source, RECIPE.network, RECIPE.scan, RECIPE.kernel, 0)
    return Trainer(model, None, RECIPE.train), Trainer(network, None, IMPLICIT_TRAINING)


def learned_samples(folder: Path) -> Iterator[tuple[str, Path, str]]:
    """Yield family, folder, and the file in it that is read."""
    eggs = folder / "eggs"
    write_eggs(eggs)
    collection = Collection(folder / "fits", workers=1)
    collection.fit(eggs, model="none")
    _remove(folder / "fits", "first", "first.safetensors", ".lock", "fits.csv")
    for state in ("fits", "alone"):
        yield "fits", folder / "fits", f"{state}/egg0.safetensors"
    (folder / "atlas").mkdir()
    collection.atlas(modes=2).save(folder / "atlas" / "atlas.npz")
    yield "atlases", folder / "atlas", "atlas.npz"
    prepare_eggs(eggs, folder / "prepared")
    _remove(folder / "prepared", "nodes.png", "normalised")
    for name in ("prepared.json", "points.safetensors", "shapes.safetensors"):
        yield "prepared", folder / "prepared", name
    train(folder / "model", shapes=folder / "prepared", recipe=RECIPE)
    train_implicit(folder / "chair", eggs, config=_IMPLICIT_NETWORK, training=IMPLICIT_TRAINING)
    for model in ("model", "chair"):
        checkpoint = folder / model / CHECKPOINT
        checkpoint_folder = folder / f"{model}-checkpoint"
        checkpoint_folder.mkdir()
        os.replace(checkpoint, checkpoint_folder / f"{model}.safetensors")
        shutil.rmtree(checkpoint.parent)
        yield "checkpoints", checkpoint_folder, f"{model}.safetensors"
    for name in (WEIGHTS, CARD, TEMPLATE):
        yield "models", folder / "model", name
    for name in (WEIGHTS, IMPLICIT):
        yield "implicit models", folder / "chair", name


def _remove(folder: Path, *names: str) -> None:
    for path in (folder / name for name in names):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def update_hashes(folder: Path) -> None:
    """Update the hashes of damaged weights and templates, as an attacker would; skip files that are too damaged."""
    for card in (folder / CARD, folder / IMPLICIT):
        try:
            metadata = json.loads(card.read_bytes())
            metadata["weights_sha256"] = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
            card.write_text(json.dumps(metadata))
        except (OSError, ValueError, TypeError, RecursionError):
            continue
    for path in folder.glob("*.safetensors"):
        data = path.read_bytes()
        size = 8 + int.from_bytes(data[:8], "little")
        try:
            header = json.loads(data[8:size])
            metadata = json.loads(header["__metadata__"]["template"])
            digest = hashlib.sha256()
            for name, kind in (("verts", "<f8"), ("faces", "<i8"), ("nodes", "<f8"), ("radii", "<f8"), ("core", "<i8")):
                if name == "radii" and name not in header:
                    array = np.array(float(metadata["radius"]))
                else:
                    first, end = (size + int(offset) for offset in header[name]["data_offsets"])
                    array = np.frombuffer(data[first:end], _KINDS[header[name]["dtype"]])
                digest.update(array.astype(kind).tobytes())
            metadata["hash"] = digest.hexdigest()[:16]
            header["__metadata__"]["template"] = json.dumps(metadata)
        except (ValueError, TypeError, LookupError, RecursionError, AttributeError, OverflowError):
            continue
        text = json.dumps(header).encode()
        path.write_bytes(len(text).to_bytes(8, "little") + text + data[size:])
