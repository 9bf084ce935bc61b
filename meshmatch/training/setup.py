"""What a training begins with: an untrained network, its batches and its loss points."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Int, Ints
from meshmatch.errors import TemplateError
from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import has_nodes, shape_functions
from meshmatch.geometry.kernels import Kernel
from meshmatch.models.deformer import Deformer
from meshmatch.models.network import NetworkConfig
from meshmatch.shapes.sampling import farthest_points
from meshmatch.templates.prepared_folder import ShapeSamples
from meshmatch.templates.template import Template, template_radius
from meshmatch.training.datasets import BatchDataset, CloudDataset, Source, build_lattice
from meshmatch.training.loop import TrainConfig
from meshmatch.training.losses import LossPoints, SurfacePoints
from meshmatch.training.scans import ScanConfig


def fill_basis(points: Float[Tensor, "B P 3"], M: int, generator: torch.Generator) -> Float[Tensor, "M 3"]:
    """Basis points spread where shapes of the category are: farthest points of jittered samples."""
    flat = points.flatten(0, 1)
    flat = flat[torch.randperm(len(flat), generator=generator)[:20_000]]
    jittered = flat + 0.06 * torch.randn(len(flat), 3, generator=generator)
    # Farthest points run to the outliers of a set: leave out the outermost ones first.
    jittered = jittered[jittered.norm(dim=1) < torch.quantile(jittered.norm(dim=1), 0.995)]
    return jittered[torch.from_numpy(farthest_points(jittered.double().numpy(), M))]


def anchor_vertices(template: Template, A: int) -> Int[Ints, " A"]:
    """Template vertices where corrections look at the scan; `TemplateError` if there are fewer than that."""
    if template.shape.V < A:
        problem = f"template {template.name} has {A} nodes but only {template.shape.V} vertices"
        raise TemplateError(problem, "prepare it with fewer nodes")
    return farthest_points(template.shape.verts, A)


def build_deformer(
    template: Template,
    source: Source | CloudDataset,
    network: NetworkConfig,
    scan: ScanConfig,
    kernel: Kernel,
    seed: int,
) -> Deformer:
    """An untrained network for a template, its basis points laid where the source's shapes are."""
    basis = align_basis = torch.zeros(1, 3)
    if network.encoder == "basis" or network.align_basis:
        if isinstance(source, CloudDataset):
            points = replace(source, shapes=64, seed=seed + 1)[0].points
        else:
            points = build_dataset(template, source, None, scan, shapes=48, scans_per_shape=2, seed=seed)[0].points
        generator = torch.Generator().manual_seed(seed)
        basis = fill_basis(points, network.basis, generator)
        if network.align_basis:
            turned = points - points.mean(1, keepdim=True)
            direction = torch.nn.functional.normalize(torch.randn(turned.shape, generator=generator), dim=-1)
            align_basis = fill_basis(turned.norm(dim=-1, keepdim=True) * direction, network.align_basis, generator)
    anchors = template.shape.verts[anchor_vertices(template, template.K)]
    phi = None
    if has_nodes(network.field):
        field = Field.of(shape_functions(network.field, anchors, template.nodes, template.radius, kernel))
        phi = field.for_training().phi
    nodes = torch.from_numpy(template.nodes).float()
    torch.manual_seed(seed)
    return Deformer(network, nodes, torch.from_numpy(anchors).float(), phi, basis, align_basis)


def loss_vertices(template: Template, M: int = 1000) -> Int[Ints, " M"]:
    """Evenly spread template vertices that a loss is computed on."""
    return farthest_points(template.shape.verts, min(M, template.shape.V))


def build_dataset(
    template: Template,
    source: Source,
    model: Deformer | None,
    scan: ScanConfig,
    shapes: int,
    scans_per_shape: int,
    seed: int,
    length: int = 1,
) -> BatchDataset:
    """Batches of a source for a model, or for none as yet, supervised on evenly spread template vertices.

    Batches are drawn on the CPU, by processes of their own, wherever the model goes: so they have its encoders' copies.
    """
    verts = torch.from_numpy(np.array(template.shape.verts)).float()
    core = torch.from_numpy(template.core)
    faces, supervised = torch.from_numpy(np.array(template.shape.faces)), torch.from_numpy(loss_vertices(template))
    encoder = None if model is None else deepcopy(model.encoder).cpu()
    aligner = None if model is None or model.aligner is None else deepcopy(model.aligner).cpu()
    settings = scan, shapes, scans_per_shape, seed, length, template_radius(template) if scan.sphere else None
    return BatchDataset(source, faces, verts[core], core, supervised, encoder, aligner, *settings)


def build_loss_points(template: Template, kernel: Kernel, model: Deformer, strained: int = 400) -> LossPoints:
    """The model's field at the supervised vertices; its gradient at the first ``strained`` of them."""
    verts = template.shape.verts[loss_vertices(template)]
    field = model.field(verts, template.nodes, template.radius, kernel)
    return LossPoints(torch.from_numpy(verts).float(), field.for_training(strained))


def build_cloud_dataset(samples: ShapeSamples, config: TrainConfig, scan: ScanConfig) -> CloudDataset:
    """Batches of a folder's samples, as yet without an encoder."""
    points, normals, known = map(torch.from_numpy, (samples.points, samples.normals, samples.landmarks))
    settings = scan, config.shapes, config.seed, config.steps
    return CloudDataset(points, normals, known, build_lattice(samples), None, *settings)


def build_surface_points(
    template: Template, kernel: Kernel, model: Deformer, landmarks: Int[Ints, " L"], count: int = 1200
) -> SurfacePoints:
    """Evenly spread template vertices, and the landmark vertices, with what a Chamfer distance needs of them."""
    chosen = loss_vertices(template, count)
    at, M = np.concatenate([chosen, landmarks]).astype(np.int64), len(chosen)
    field = model.field(template.shape.verts[at], template.nodes, template.radius, kernel).for_training()
    verts = torch.from_numpy(template.shape.verts[at]).float()
    normals = torch.from_numpy(template.shape.vertex_normals[chosen]).float()
    return SurfacePoints(verts[:M], field.part(0, M), normals, verts[M:], field.part(M, len(at)))
