"""Limbs that a fit has in a wrong place, bent to where it leaves the shape bare.

Of people who cross their legs or fold their arms every reading of the network may have the same foot on the other shin.
Samples of the shape then have no template near. A limb that reaches them is another interpretation: it is turned in its
joints, as rigid pieces, until it lies there, and the rest stays as it was.

Limbs and joints are the template's: a limb is a label with all that hangs on it, and a joint where it borders on the rest.
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
    bare : samples that lie so far from the template, normals included, are bare
    together : bare samples so near one another are of one place
    least : share of all samples that a bare place has at least: fits of 58 bodies of SCAPE, FAUST and SHREC'19 leave
        none
    joints : so many joints of a limb are turned at most, from its end or from the piece before it
    turns : how often each of them is turned
    missed : so far from the middle of a bare place that of a limb may stay
    tangled : a limb of fewer labels is not tangled with others
    alike : ways to bend that leave nodes so near are the same, but for a share ``differing`` of the nodes
    """

    bare: float = 0.06
    together: float = 0.05
    least: float = 0.01
    joints: int = 3
    turns: int = 4
    missed: float = 0.08
    tangled: int = 3
    alike: float = 0.05
    differing: float = 0.02


SETTINGS = LimbSettings()


def bare_places(samples: OrientedPoints, surface: OrientedPoints) -> list[Float[Floats, " 3"]]:
    """The middles of the places where samples have no template near, the largest first."""
    weights = np.ones(len(samples.points)) if samples.weights is None else samples.weights
    least = SETTINGS.least * weights.sum()
    distance = surface.tree.query(samples.features, distance_upper_bound=SETTINGS.bare)[0]
    at = np.flatnonzero(np.isinf(distance))
    if not len(at) or weights[at].sum() < least:
        return []
    pairs = cKDTree(samples.points[at]).query_pairs(SETTINGS.together, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(at), len(at)))
    place = connected_components(graph, directed=False)[1]
    size = np.bincount(place, weights[at])
    order = [k for k in np.argsort(-size, kind="stable") if size[k] >= least > 0]
    return [samples.points[at[place == k]].mean(0) for k in order]


@dataclass(frozen=True, eq=False)
class Limb:
    """A label of the template that has no vertex of the core, with all that hangs on it."""

    verts: Int[Ints, " N"]
    joint: Int[Ints, " J"]  # its vertices where it borders on what it hangs on
    share: Float[Floats, " K"]  # how far each node belongs to it (0..1)


@dataclass(frozen=True, eq=False)
class Bend:
    """Which limb is to reach a place, by turns in which joints, from the core outwards."""

    end: Limb
    joints: tuple[Limb, ...]


@dataclass(frozen=True, eq=False)
class Branch:
    """A limb that hangs on the core, with all that hangs on it."""

    limbs: tuple[Limb, ...]  # itself first
    pieces: tuple[Int[Ints, " N"], ...]  # the vertices of each of these labels
    holder: Int[Ints, " H"]  # of the label that it hangs on

    @staticmethod
    def together(branches: Sequence[Branch]) -> Limb:
        """Some of them as if they were one limb, without a joint."""
        roots = [each.limbs[0] for each in branches]
        verts = np.concatenate([each.verts for each in roots])
        return Limb(verts, np.array([], np.int64), np.sum([each.share for each in roots], axis=0))


class Limbs:
    """What of a template can be bent, and how: ``bends`` are all ways, ``branches`` are limbs that can be tangled."""

    def __init__(self, template: Template, system: NodeSystem) -> None:
        self._system, self._nodes = system, np.asarray(template.nodes)
        self.bends: list[Bend] = []  # those that turn fewer joints first
        self.branches: list[Branch] = []
        if not system.linear:
            return
        limbs = _limbs(template, system.phi)
        for name in limbs:
            chain = [name]
            while (onto := limbs[chain[-1]][1]) in limbs:
                chain.append(onto)
            pieces = [limbs[each][0] for each in chain]
            for first in range(min(2, len(pieces))):
                for last in range(first + 1, min(first + SETTINGS.joints, len(pieces)) + 1):
                    self.bends.append(Bend(pieces[0], tuple(pieces[first:last][::-1])))
        self.bends.sort(key=lambda bend: len(bend.joints))
        own = {name: np.flatnonzero(template.labels == name) for name in range(len(template.label_names))}
        for root, (limb, onto) in limbs.items():
            names = [name for name in limbs if np.isin(own[name], limb.verts).all()]
            if onto not in limbs and len(names) >= SETTINGS.tangled:
                names.sort(key=lambda name: name != root)
                together = tuple(limbs[name][0] for name in names)
                self.branches.append(Branch(together, tuple(own[name] for name in names), own[onto]))

    def bent(
        self, vectors: Float[Floats, "K 3"], bend: Bend, place: Float[Floats, " 3"]
    ) -> tuple[Float[Floats, "K 3"], float]:
        """Node vectors after a limb was bent to a place (core frame), and how far from it its middle stayed."""
        moved, at = self._system.moved(vectors), self._nodes + vectors
        end = moved[bend.end.verts].mean(0)
        pivots = [moved[limb.joint].mean(0) for limb in bend.joints]
        for _ in range(SETTINGS.turns):
            for number, limb in enumerate(bend.joints):
                pivot = pivots[number]
                turn = _turn(end - pivot, place - pivot)
                at = at + limb.share[:, None] * ((at - pivot) @ turn.T + pivot - at)
                end = (end - pivot) @ turn.T + pivot
                pivots[number + 1 :] = [(each - pivot) @ turn.T + pivot for each in pivots[number + 1 :]]
        return at - self._nodes, float(np.linalg.norm(end - place))

    def reaching(
        self, samples: OrientedPoints, vectors: Float[Floats, "K 3"], place: Float[Floats, " 3"]
    ) -> Float[Floats, "K 3"] | None:
        """Node vectors with some limb bent to a place in samples (core frame), those with the least residual; None where
        no limb reaches it.
        """
        found: list[Floats] = []
        for bend in self.bends:
            bent, missed = self.bent(vectors, bend, place)
            if missed <= SETTINGS.missed and all(_differ(bent, other) for other in found):
                found.append(bent)
        return min(found, key=lambda each: two_way_residual(self._system, samples, each), default=None)


@derived
def limbs_of(model: TrainedModel) -> Limbs:
    """What can be bent of a model's template; nothing where its labels say nothing of limbs."""
    return Limbs(model.template, node_system(model))


def _limbs(template: Template, phi: Any) -> dict[int, tuple[Limb, int]]:
    """The limbs of a template by their labels, each with the label that it hangs on.

    Labels hang on one another by a tree of the longest borders, from the label with most of the core.
    """
    labels, count = template.labels, len(template.label_names)
    edges = template.shape.edges.vertices
    across = edges[labels[edges[:, 0]] != labels[edges[:, 1]]]
    border = coo_matrix((np.ones(len(across)), labels[across].T), (count, count)).tocsr()
    border = (border + border.T).tocsr()
    border.data = 1 / border.data
    tree = minimum_spanning_tree(border)
    root = int(np.bincount(labels[template.core], minlength=count).argmax())
    order, onto = breadth_first_order(tree + tree.T, root, directed=False)
    hanging = {int(label): labels == label for label in order}
    for label in order[:0:-1]:
        hanging[int(onto[label])] = hanging[int(onto[label])] | hanging[int(label)]
    reach = abs(phi)
    total = np.asarray(reach.sum(axis=0)).reshape(-1)
    found = {}
    for label in (int(each) for each in order[1:]):
        inside = hanging[label]
        if inside[template.core].any():
            continue
        ends = labels[across] == label
        joint = across[ends & (labels[across] == onto[label])[:, ::-1]]
        share = np.asarray(reach.T @ inside.astype(np.float64)).reshape(-1) / np.maximum(total, 1e-300)
        found[label] = Limb(np.flatnonzero(inside), np.unique(joint), share), int(onto[label])
    return found


def _turn(start: Float[Floats, " 3"], end: Float[Floats, " 3"]) -> Float[Floats, "3 3"]:
    """The smallest rotation that takes one direction to another."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, start @ end)
    return np.asarray(Rotation.from_rotvec(axis * (angle / max(sine, 1e-12))).as_matrix())


def _differ(here: Float[Floats, "K 3"], there: Float[Floats, "K 3"]) -> bool:
    return bool((np.linalg.norm(here - there, axis=1) > SETTINGS.alike).mean() > SETTINGS.differing)
