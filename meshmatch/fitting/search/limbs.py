"""Limbs that a fit has misplaced, bent to a region of the shape that the fit leaves uncovered.

On people who cross their legs or fold their arms, every prediction of the network may put a foot on the wrong shin. Some
samples of the shape then have no template near. A limb that reaches them gives another candidate: its joints are turned,
with rigid pieces between them, until it lies there (inverse kinematics), and the rest stays where it was.

Limbs and joints come from the template's labels: a limb is a label with everything that hangs on it, and its joint is where
it borders on the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.derived import derived
from meshmatch.fitting.search.predictor import two_way_residual
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.models.trained import TrainedModel
from meshmatch.templates.template import Template


@dataclass(frozen=True, kw_only=True)
class LimbSettings:
    """All set by hand on people who touch themselves; lengths are in units of sqrt(area).

    Attributes
    ----------
    uncovered_distance : samples at least this far from the template, normals included, are uncovered
    cluster_distance : uncovered samples that are closer than this belong to one region
    min_share : share of all samples that an uncovered region must have: fits of 58 bodies of SCAPE, FAUST and SHREC'19
        leave none
    max_turned_joints : maximum number of consecutive joints that are turned, from the limb's end or the piece before it
    sweeps : how often each of these joints is turned
    max_miss : largest distance that may remain between the centroids of the limb and of the region
    max_tried : maximum number of limbs that are bent from one start and refined
    min_labels : a limb with fewer labels is not considered tangled with others
    same_distance, different_share : two bends are the same if at most this share of the nodes is more than this distance
        apart
    """

    uncovered_distance: float = 0.06
    cluster_distance: float = 0.05
    min_share: float = 0.01
    max_turned_joints: int = 3
    sweeps: int = 4
    max_miss: float = 0.08
    max_tried: int = 2
    min_labels: int = 3
    same_distance: float = 0.05
    different_share: float = 0.02


SETTINGS = LimbSettings()


def uncovered_regions(samples: OrientedPoints, surface: OrientedPoints) -> list[Float[Floats, " 3"]]:
    """Centroids (3,) of the regions whose samples have no template near, the largest region first."""
    weights = np.ones(len(samples.points)) if samples.weights is None else samples.weights
    min_weight = SETTINGS.min_share * weights.sum()
    distance = surface.tree.query(samples.features, distance_upper_bound=SETTINGS.uncovered_distance)[0]
    uncovered = np.flatnonzero(np.isinf(distance))
    if not len(uncovered) or weights[uncovered].sum() < min_weight:
        return []
    pairs = cKDTree(samples.points[uncovered]).query_pairs(SETTINGS.cluster_distance, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(uncovered), len(uncovered)))
    region = connected_components(graph, directed=False)[1]
    size = np.bincount(region, weights[uncovered])
    order = [k for k in np.argsort(-size, kind="stable") if size[k] >= min_weight > 0]
    return [samples.points[uncovered[region == k]].mean(0) for k in order]


@dataclass(frozen=True, eq=False)
class Limb:
    """A label of the template without core vertices, together with everything that hangs on it."""

    verts: Int[Ints, " N"]
    joint: Int[Ints, " J"]  # its vertices at the border with the label that it hangs on
    share: Float[Floats, " K"]  # how much (0..1) each node belongs to it


@dataclass(frozen=True, eq=False)
class Bend:
    """A limb that is to reach a region, and the joints that are turned for it, from the core outwards."""

    end: Limb
    turned_joints: tuple[Limb, ...]


@dataclass(frozen=True, eq=False)
class Branch:
    """A limb that hangs on the core, together with everything that hangs on it."""

    limbs: tuple[Limb, ...]  # the limb on the core first, then those that hang on it
    pieces: tuple[Int[Ints, " N"], ...]  # the vertices of each of these labels
    holder: Int[Ints, " H"]  # vertices of the label that it hangs on

    @staticmethod
    def together(branches: Sequence[Branch]) -> Limb:
        """Combine branches into one limb without a joint."""
        roots = [each.limbs[0] for each in branches]
        verts = np.concatenate([each.verts for each in roots])
        return Limb(verts, np.array([], np.int64), np.sum([each.share for each in roots], axis=0))


class Limbs:
    """The limbs of a template.

    ``bends`` are all ways to bend them; ``branches`` are limbs that can be tangled with each other.
    """

    def __init__(self, template: Template, system: NodeSystem) -> None:
        self._system, self._nodes = system, np.asarray(template.nodes)
        self.bends: list[Bend] = []  # those with fewer joints first
        self.branches: list[Branch] = []
        if not system.linear:
            return
        limbs = _limbs_by_label(template, system.phi)
        for name in limbs:
            chain = [name]
            while (parent := limbs[chain[-1]][1]) in limbs:
                chain.append(parent)
            pieces = [limbs[each][0] for each in chain]
            for first in range(min(2, len(pieces))):
                for last in range(first + 1, min(first + SETTINGS.max_turned_joints, len(pieces)) + 1):
                    self.bends.append(Bend(pieces[0], tuple(pieces[first:last][::-1])))
        self.bends.sort(key=lambda bend: len(bend.turned_joints))
        label_verts = {name: np.flatnonzero(template.labels == name) for name in range(len(template.label_names))}
        for root, (limb, parent) in limbs.items():
            names = [name for name in limbs if np.isin(label_verts[name], limb.verts).all()]
            if parent not in limbs and len(names) >= SETTINGS.min_labels:
                names.sort(key=lambda name: name != root)
                branch_limbs = tuple(limbs[name][0] for name in names)
                self.branches.append(
                    Branch(branch_limbs, tuple(label_verts[name] for name in names), label_verts[parent])
                )

    def bent(
        self, vectors: Float[Floats, "K 3"], bend: Bend, target: Float[Floats, " 3"]
    ) -> tuple[Float[Floats, "K 3"], float]:
        """Bend a limb towards a point (core frame) by cyclic coordinate descent.

        Each joint in order turns the limb's centroid towards the point. Returns node vectors, and the distance that remains
        between centroid and point.
        """
        moved, nodes = self._system.moved(vectors), self._nodes + vectors
        end = moved[bend.end.verts].mean(0)
        pivots = [moved[limb.joint].mean(0) for limb in bend.turned_joints]
        for _ in range(SETTINGS.sweeps):
            for number, limb in enumerate(bend.turned_joints):
                pivot = pivots[number]
                rotation = _rotation_between(end - pivot, target - pivot)
                nodes = nodes + limb.share[:, None] * ((nodes - pivot) @ rotation.T + pivot - nodes)
                end = (end - pivot) @ rotation.T + pivot
                pivots[number + 1 :] = [(each - pivot) @ rotation.T + pivot for each in pivots[number + 1 :]]
        return nodes - self._nodes, float(np.linalg.norm(end - target))

    def reaching(
        self, samples: OrientedPoints, start: Float[Floats, "K 3"], target: Float[Floats, " 3"]
    ) -> list[Float[Floats, "K 3"]]:
        """Node vectors with one limb bent to a point (core frame), for every limb that reaches it from the start.

        Those with the least residuals come first, and at most `LimbSettings.max_tried` are returned.
        """
        found: list[Floats] = []
        for bend in self.bends:
            bent, distance = self.bent(start, bend, target)
            if distance <= SETTINGS.max_miss and all(_differ(bent, other) for other in found):
                found.append(bent)
        found.sort(key=lambda each: two_way_residual(self._system, samples, each))
        return found[: SETTINGS.max_tried]


@derived
def limbs_of(model: TrainedModel) -> Limbs:
    """The limbs of a model's template; empty if its labels do not describe limbs."""
    return Limbs(model.template, node_system(model))


def _limbs_by_label(template: Template, phi: Any) -> dict[int, tuple[Limb, int]]:
    """Map each limb's label to the limb and the label that it hangs on.

    Labels form a tree of the longest common borders, rooted at the label with most of the core.
    """
    labels, count = template.labels, len(template.label_names)
    edges = template.shape.edges.vertices
    across = edges[labels[edges[:, 0]] != labels[edges[:, 1]]]
    border = coo_matrix((np.ones(len(across)), labels[across].T), (count, count)).tocsr()
    border = (border + border.T).tocsr()
    border.data = 1 / border.data
    tree = minimum_spanning_tree(border)
    root = int(np.bincount(labels[template.core], minlength=count).argmax())
    order, parent = breadth_first_order(tree + tree.T, root, directed=False)
    hanging = {int(label): labels == label for label in order}
    for label in order[:0:-1]:
        hanging[int(parent[label])] = hanging[int(parent[label])] | hanging[int(label)]
    abs_phi = abs(phi)
    total = np.asarray(abs_phi.sum(axis=0)).reshape(-1)
    limbs = {}
    for label in (int(each) for each in order[1:]):
        inside = hanging[label]
        if inside[template.core].any():
            continue
        ends = labels[across] == label
        joint = across[ends & (labels[across] == parent[label])[:, ::-1]]
        share = np.asarray(abs_phi.T @ inside.astype(np.float64)).reshape(-1) / np.maximum(total, 1e-300)
        limbs[label] = Limb(np.flatnonzero(inside), np.unique(joint), share), int(parent[label])
    return limbs


def _rotation_between(start: Float[Floats, " 3"], end: Float[Floats, " 3"]) -> Float[Floats, "3 3"]:
    """The smallest rotation that takes one direction to another."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, start @ end)
    return np.asarray(Rotation.from_rotvec(axis * (angle / max(sine, 1e-12))).as_matrix())


def _differ(here: Float[Floats, "K 3"], there: Float[Floats, "K 3"]) -> bool:
    return bool((np.linalg.norm(here - there, axis=1) > SETTINGS.same_distance).mean() > SETTINGS.different_share)
