"""A small model folder: its network can be loaded, but is not trained."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from meshmatch.models.card import ModelCard, write_card
from meshmatch.models.checkpoint import save_weights
from meshmatch.models.deformer import blank_deformer
from meshmatch.models.network import NetworkConfig
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, save_template

NETWORK = NetworkConfig(code=4, width=4, depth=1, basis=4, align_basis=0, corrections=0, align_width=4)


def small_card(**changes: Any) -> ModelCard:
    """A model card with valid entries; `changes` replace fields."""
    card = ModelCard(
        name="blob",
        category="blobs",
        template="ball",
        template_hash="0123456789abcdef",
        network={"width": 8, "layers": [1, 2], "note": None, "rate": 0.5, "deep": {"a": True}},
        field={"kernel": "smooth", "radius": 0.5, "nodes": 6},
        data="nothing",
        licence="CC0-1.0",
        recipe={"steps": 3},
        seed=1,
        steps=3,
        training_minutes=0.25,
        metrics={"validation": {"distance": 0.5}, "scape": {"none": {"mean_cm": 4.0}, "nodes": {"mean_cm": 2}}},
        weights_sha256="ab" * 32,
        created="2026-01-31",
        description="Größe: none",
    )
    return replace(card, **changes)


def small_template() -> Template:
    """An octahedron with a node at every vertex."""
    verts = np.concatenate([np.eye(3), -np.eye(3)]) * 0.4
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    ball = Shape(verts, faces, "ball")
    return Template("ball", ball, ball, verts.copy(), 0.5, np.zeros(6, np.int64), ("all",), np.arange(6))


def write_model(folder: Path, **changes: Any) -> ModelCard:
    """Write a model that `verify_model` accepts; `changes` are made to its card."""
    folder.mkdir(parents=True, exist_ok=True)
    template = small_template()
    save_template(template, folder / "template.safetensors")
    state = blank_deformer(NETWORK, template.K).state_dict()
    numbers = {name: torch.ones(value.shape) for name, value in state.items()}
    digest = save_weights(numbers, folder / "weights.safetensors")
    true = {"template_hash": template.hash, "weights_sha256": digest, "network": NETWORK.to_dict()}
    card = small_card(**true | changes)
    write_card(card, folder / "card.json")
    return card
