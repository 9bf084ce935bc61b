"""Endless generated human bodies: identity, pose, linear blend skinning."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import platformdirs
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.errors import OptionError
from meshmatch.outputs import make_folder
from meshmatch.progress import Progress
from meshmatch.templates.template import Template
from meshmatch.training.datasets import Source
from meshmatch.training.pose_files import GivenPoses
from meshmatch.training.poses import sample_free_pose
from meshmatch.training.rig import RIG_VERSION, Rig, build_rig, load_rig, save_rig, skin


@dataclass(frozen=True)
class Bodies:
    """Which human bodies are generated: on the vertices of a template, of so many different people, some in given poses."""

    template: str | Path = "human-T"
    identities: int = 4096
    poses: GivenPoses | None = None

    @property
    def words(self) -> str:
        """What the card says of them."""
        words = f"{self.identities} generated bodies in sampled poses (anny, Apache-2.0; MakeHuman data, CC0)"
        if self.poses is not None:
            words += f", {self.poses.share:.0%} of them in {self.poses.P} poses of {self.poses.name}"
        return words


def draw_identities(
    rig: Rig, B: int, generator: torch.Generator
) -> tuple[Float[Tensor, "B V 3"], Float[Tensor, "B J 3"]]:
    """Blend pairs of stored identities: rest vertices and joints, metres.

    The body model is linear in its coefficients, so a blend of two bodies (and a little beyond) is a body.
    """
    a, b = torch.randint(len(rig.rest), (2, B), generator=generator)
    blend = torch.rand(B, 1, 1, generator=generator) * 1.2 - 0.1
    return torch.lerp(rig.rest[a].float(), rig.rest[b].float(), blend), torch.lerp(rig.heads[a], rig.heads[b], blend)


def sample_bodies(
    rig: Rig, B: int, generator: torch.Generator, poses: GivenPoses | None = None
) -> Float[Tensor, "B V 3"]:
    """Posed bodies in metres, pelvis roughly upright, y up, facing +z; some in given poses."""
    rest, heads = draw_identities(rig, B, generator)
    world, offset = sample_free_pose(rig, heads, generator)
    if poses is not None:
        world, offset = poses.mixed(rig, heads, world, offset, generator)
    return skin(rig, rest, world, offset)


def human_source(
    template: Template,
    identities: int = 4096,
    seed: int = 0,
    progress: Progress | None = None,
    poses: GivenPoses | None = None,
) -> Source:
    """Generated bodies on a human template's vertices, some in given poses; the rig is built once and cached.

    `OptionError` if the template is not made from the body model, or the extra ``train`` is not installed; `InputError` if
    the body has no joint of a name in ``poses``.
    """
    rig = cached_rig(identities, seed, progress)
    if poses is not None:
        poses.columns(rig)  # checks the names
    # Template vertices are a subset of the body model's: the dense mesh says which.
    apart, keep = cKDTree(template.dense.verts).query(template.shape.verts)
    if template.dense.verts.shape[0] != rig.rest.shape[1] or apart.max() > 1e-4:
        hint = "train on a prepared folder (--shapes), or use a human template"
        raise OptionError(f"template {template.name} is not made from the body model", hint)
    return partial(sample_bodies, rig.restricted(keep, np.array(template.shape.faces)), poses=poses)


def cached_rig(identities: int, seed: int, progress: Progress | None = None) -> Rig:
    """The body rig from the cache, or built into it (a minute or two, once)."""
    cache = Path(platformdirs.user_cache_dir("meshmatch"))
    path = cache / f"rig-v{RIG_VERSION}-{identities}-{seed}.safetensors"
    if not path.is_file():
        make_folder(path.parent)
        save_rig(build_rig(identities, seed, progress=progress), path)
    return load_rig(path)
