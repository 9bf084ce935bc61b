"""Transfer of clothes, hair, hats and shoes between people, compared with the exact refit.

MakeHuman's clothes (`.mhclo`) bind each vertex to a triangle of its body and an offset, so that the refit on any body of
that family is exact; in another pose a vertex follows the joints as its triangle does. Bodies are generated: people in the
rest pose, in which garments are bound, and in a random pose. The garments of each person are transferred to the next one,
whose body is remeshed.

The error is the distance of each vertex from its position in the exact refit, in centimetres. "under the skin" counts
vertices inside the target that are not inside the source; the exact refit has such vertices too. ``--exact-map`` transfers
by the true map instead of a match, which leaves the errors of the transfer alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
import torch
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Bools, Floats, Ints
from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.makers.other_triangles import other_triangles
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.generators.bodies import sample_free_pose
from meshmatch.generators.rig import build_rig, skin
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.garment import carry_garment

Pose = Literal["rest", "posed"]
_BASE_VERTICES = 19_158  # vertices of MakeHuman's base mesh, which starts with those of the body
_TOPOLOGY = "makehuman-noeyes-notongue-tris"
_TARGET_FACES = 18_000  # faces of a remeshed target
COLUMNS = {
    "garment": "garment", "target": "pose", "pairs": "pairs:d", "mean cm": "mean_cm:.2f", "95 %": "high_cm:.2f",
    "worst": "worst_cm:.1f", "under the skin": "under:.2%", "exact refit": "truth_under:.2%",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Bound:
    """A garment (.mhclo) or body (.proxy) of MakeHuman, bound to the base mesh.

    Each vertex of ``mesh`` has three vertices of the base mesh (``corners``), their weights, and an offset. ``scales`` has
    for each axis two base vertices and a reference distance: the distance of the two vertices along the axis, divided by
    the reference, scales offsets along it.
    """

    mesh: Shape
    corners: Ints
    weights: Floats
    offsets: Floats
    scales: tuple[tuple[int, int, float], ...]

    @classmethod
    def read(cls, path: Path) -> Bound:
        """Read a file and the .obj of the same name; `InputError` if their numbers of vertices differ."""
        words = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
        starts = {row[0]: k for k, row in enumerate(words) if row}
        scales = [words[starts[f"{axis}_scale"]] for axis in "xyz"]
        rows = []
        for row in words[starts["verts"] + 1 :]:
            if len(row) not in (1, 9):
                break
            rows.append([float(word) for word in row] if len(row) == 9 else [float(row[0]), 0, 0, 1, 0, 0, 0, 0, 0])
        table, mesh = np.array(rows), load_shape(path.with_suffix(".obj"))
        if len(table) != mesh.V:
            raise InputError(f"{path.name} binds {len(table)} vertices, and its mesh has {mesh.V}")
        corners = table[:, :3].astype(np.int64)
        known = tuple((int(a), int(b), float(size)) for _, a, b, size in scales)
        return cls(mesh, corners, table[:, 3:6], table[:, 6:], known)

    def refit(self, base: Floats) -> Shape:
        """Refit the garment to a base mesh (V, 3) at rest, in metres."""
        axes = enumerate(self.scales)  # offsets and sizes are in decimeters: the result has the unit of the base mesh
        stretch = np.array([abs(base[a, k] - base[b, k]) / size for k, (a, b, size) in axes])
        return self._with(np.einsum("nk,nkd->nd", self.weights, base[self.corners]) + self.offsets * stretch)

    def refit_posed(self, base: Floats, moves: Floats) -> Shape:
        """Refit to a base mesh at rest, then pose the garment by the affine maps (V, 3, 4) of the base mesh's vertices."""
        share = np.maximum(self.weights, 0.0)
        own = np.einsum("nk,nkij->nij", share / share.sum(axis=1, keepdims=True), moves[self.corners])
        return self._with(np.einsum("nij,nj->ni", own[:, :, :3], self.refit(base).verts) + own[:, :, 3])

    def _with(self, verts: Floats) -> Shape:
        return Shape(verts, self.mesh.faces, self.mesh.name)


@dataclass(frozen=True, eq=False)
class Person:
    """Base mesh at rest (V, 3) and in a pose (V, 3), and the affine map (V, 3, 4) of each vertex between them."""

    rest: Floats
    posed: Floats
    moves: Floats

    def worn_shape(self, garment: Bound, pose: Pose) -> Shape:
        """Return a garment on this person, at rest or posed."""
        return garment.refit(self.rest) if pose == "rest" else garment.refit_posed(self.rest, self.moves)


def generate_people(count: int, seed: int) -> tuple[list[Person], Ints]:
    """Generate people; return them and the triangles of their bodies."""
    rig = build_rig(count, seed, keep=np.arange(_BASE_VERTICES), topology=_TOPOLOGY, dtype=torch.float32)
    world, offset = sample_free_pose(rig, rig.heads, torch.Generator().manual_seed(seed))
    posed = skin(rig, rig.rest, world, offset)
    moves = torch.einsum("vj,bjik->bvik", rig.weights, torch.cat([world, offset[..., None]], dim=-1))
    arrays = [each.double().numpy() for each in (rig.rest, posed, moves)]
    return [Person(*each) for each in zip(*arrays, strict=True)], rig.faces.numpy()


def body_of(base: Floats, faces: Ints, name: str, cut: bool) -> Shape:
    """Return the body without the rest of the base mesh; remeshed if ``cut``."""
    body = base[: int(faces.max()) + 1]
    if not cut:
        return Shape(body, faces, name)
    weights, fine = other_triangles(faces, len(body))
    return decimate(Shape(weights @ body, fine, name), _TARGET_FACES)


def measure_garment(
    garment: Bound, source: Person, target: Person, pose: Pose, found: VertexMap, bodies: tuple[Shape, Shape]
) -> Any:
    """Transfer a garment; return distances from the exact refit, in centimetres, and masks of vertices under the skin."""
    worn, true = source.worn_shape(garment, "rest"), target.worn_shape(garment, pose)
    carried = carry_garment(worn, found, *bodies)
    out = ~inside(bodies[0], worn.verts)
    return {
        "cm": 100 * np.linalg.norm(carried.verts - true.verts, axis=1),
        "under": inside(bodies[1], carried.verts) & out,
        "truth_under": inside(bodies[1], true.verts) & out,
    }


def true_map(source: Shape, places: Floats, target: Shape) -> VertexMap:
    """Build the map to a target whose surface passes through the true positions (V, 3) of the source's vertices."""
    found = MappedMesh.of(target).query(places)
    return VertexMap.between(source, target, found.vertex, face=found.face, barycentric=found.barycentric)


def inside(body: Shape, points: Floats) -> Bools:
    """Return which points (N,) are inside a body, by ray casting."""
    return np.asarray(body.to_trimesh().contains(points))


def rows_of(
    garments: dict[str, Bound], pose: Pose, count: int, matcher: Matcher | None, seed: int
) -> list[dict[str, Any]]:
    """Compute a row for each garment and one for all together, over all pairs of neighbours in a circle of people.

    Without a matcher, garments are transferred by the true map.
    """
    crowd, faces = generate_people(count, seed)
    found: dict[str, list[Any]] = {name: [] for name in garments}
    for k in runner.track(range(count), pose):
        source, target = crowd[k], crowd[(k + 1) % count]
        there = target.rest if pose == "rest" else target.posed
        bodies = body_of(source.rest, faces, f"person {k}", cut=False), body_of(there, faces, "the next", cut=True)
        exact = true_map(bodies[0], there[: bodies[0].V], bodies[1])
        way = exact if matcher is None else matcher.match(*bodies).map
        for name, garment in garments.items():
            found[name].append(measure_garment(garment, source, target, pose, way, bodies))
    rows = [_row(name, pose, each) for name, each in found.items()]
    return [*rows, _row("all", pose, [each for several in found.values() for each in several])]


def _row(name: str, pose: Pose, found: list[Any]) -> dict[str, Any]:
    """Compute a table row from the results of all pairs."""
    joined = {key: np.concatenate([each[key] for each in found]) for key in found[0]}
    return {
        **{"garment": name, "pose": pose, "pairs": len(found)},
        "mean_cm": float(np.mean([each["cm"].mean() for each in found])),
        **{"high_cm": float(np.quantile(joined["cm"], 0.95)), "worst_cm": float(joined["cm"].max())},
        **{key: float(joined[key].mean()) for key in ("under", "truth_under")},
    }


@runner.command
def main(
    data: runner.Data = runner.DATA,
    poses: Annotated[str, Option(help=f"of {', '.join(get_args(Pose))}")] = ",".join(get_args(Pose)),
    count: Annotated[int, Option(min=2, help="generated people")] = 4,
    exact_map: Annotated[bool, Option("--exact-map", help="transfer by the true map instead of a match")] = False,
    model: runner.Model = "human",
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    garments = {file.stem: Bound.read(file) for file in runner.files_in(data / "garments", "*.mhclo")}
    matcher = None if exact_map else Matcher(model, FitConfig(), threads)
    chosen: list[Any] = runner.split_names(poses, get_args(Pose), "pose")
    rows = [row for pose in chosen for row in rows_of(garments, pose, count, matcher, seed)]
    title = f"Garments from person to person with {'the true map' if exact_map else model}"
    return runner.Report({"rows": rows}, [runner.table(title, rows, COLUMNS)])
