"""Reliability of verdicts on thousands of generated people outside the training distribution of the human model.

Every body is a function of the seed and its number alone: identities that training did not use, in poses beyond those of
training (squatting, cross-legged, curled up, handstands, folded forward, hugging the knees, arms crossed or behind the
back, random joint angles), naked, clothed, in skirts, or with other proportions. Half of them are remeshed, and some are
noisy, have holes, lack a limb, or are only one half. The human model is fitted to each as `match` does it. The error is the
mean distance between the fitted template's vertices and their true positions, over those that are on the shape, in
centimetres for a person of 1.9 m2.

Each body is a line of ``bodies.jsonl``, and its fit is a file in the same folder: a stopped run resumes with what is
missing. ``--known`` resumes from saved results alone.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Bool, Bools, Float, Floats, Ints
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.verdict_cases import LIMBS, direction, faces_kept
from meshmatch.experiments.bench.verdicts import REFUSED, VERDICTS
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.generators.bodies import draw_identities, joint_rotations, pose_limbs, template_rig
from meshmatch.generators.clothes import add_clothes, add_skirts
from meshmatch.generators.figure import Figure
from meshmatch.generators.limbs import Draw, Limbs
from meshmatch.generators.proportions import TOON, draw_style, round_parts, scale_bones
from meshmatch.generators.rig import forward_kinematics, penetration, skin
from meshmatch.generators.rotations import DEGREE
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.maps.fit_files import write_fit
from meshmatch.outputs import make_folder
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.input_files import read_json
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, read_template

BANDS = (5.0, 8.0, 15.0, 30.0)
_LOST_CM = 15.0
_WRONG_CM = 8.0
_POSE_COLUMNS = {
    "pose": "pose",
    "bodies": "bodies:d",
    "mean cm": "mean:.1f",
    "median": "median:.1f",
    "over 8 cm": "off:.0%",
}
_POSE_COLUMNS |= {"of these not poor": "not_poor:d"}
_N_IDENTITIES, _FIRST_IDENTITY_SEED = 64, 5300
_TRIES = 6  # poses drawn for each body; the one with the least self-penetration is used
_STYLE_PROBABILITIES = (0.78, 0.12, 0.06, 0.04, 0.0)  # plain, child, stretched, stylised, built of parts
# Mean angles in degrees, in the order of the fields of `Limbs`: alternatives for an arm (elevation, azimuth, twist, elbow,
# pronation), alternatives for a leg (hip flexion, abduction, twist, knee, ankle), and the spine (flexion, side, twist).
_HANG, _AHEAD, _UP = (12, 10, 0, 8, 10), (85, 88, 0, 15, 10), (172, 40, -60, 8, 0)
_CROSSED, _FACE, _BEHIND, _KNEES = (
    (38, 82, 62, 98, 40),
    (58, 82, 20, 138, 10),
    (25, -50, 70, 85, 20),
    (50, 85, 10, 20, 60),
)
_HUG, _HIPS = (62, 88, 40, 70, 30), (48, -10, 55, 95, 20)
_STRAIGHT_LEG = (2, 6, 2, 4, 0)
POSES: dict[str, tuple[tuple[Sequence[float], ...], tuple[Sequence[float], ...], tuple[float, float, float]]] = {
    "squat": ((_AHEAD, _HANG, _KNEES, _FACE), ((125, 18, 5, 145, -25), (120, 35, 20, 140, -20)), (30, 0, 0)),
    "kneel": ((_HANG, _UP, _CROSSED, _BEHIND), ((5, 10, 5, 100, 40), (90, 12, 5, 150, 45)), (5, 0, 0)),
    "cross-legged": ((_KNEES, _HANG, _FACE, _CROSSED), ((85, 45, 50, 120, 0), (95, 35, 60, 135, 10)), (20, 0, 0)),
    "sit": ((_KNEES, _CROSSED, _HANG), ((90, 4, 0, 90, 0), (88, -12, 0, 70, 0), (95, 8, 0, 10, 0)), (10, 0, 0)),
    "curled up": ((_HUG, _CROSSED, _FACE), ((132, 5, 0, 140, 20), (120, 0, 0, 125, 10)), (50, 0, 0)),
    "lie": ((_HANG, _UP, _BEHIND), (_STRAIGHT_LEG, (0, 2, 0, 2, 35)), (0, 0, 0)),
    "hands on knees": ((_KNEES,), ((55, 12, 5, 35, -10),), (40, 0, 0)),
    "hands on face": ((_FACE,), (_STRAIGHT_LEG, (60, 5, 0, 90, 0)), (15, 0, 0)),
    "handstand": ((_UP,), (_STRAIGHT_LEG, (35, 50, 10, 70, 30), (-20, 10, 0, 60, 30)), (-15, 0, 0)),
    "folded forward": ((_AHEAD, (130, 85, 0, 5, 0), _HUG), ((115, 5, 0, 5, 0), (100, 25, 0, 3, 0)), (65, 0, 0)),
    "arms crossed": ((_CROSSED,), (_STRAIGHT_LEG, (3, -10, 5, 5, 0)), (5, 0, 0)),
    "arms behind": ((_BEHIND, _HIPS), (_STRAIGHT_LEG, (-15, 5, 0, 20, 0)), (-10, 0, 0)),
    "bridge": ((_UP,), ((-30, 15, 0, 85, 10),), (-75, 0, 0)),
    "splits": (
        (_UP, _HANG, (90, 0, 0, 5, 0)),
        ((95, 0, 0, 4, 30), (-55, 0, 0, 10, 30), (20, 80, 0, 4, 20)),
        (10, 0, 0),
    ),
    "twisted": ((_HIPS, _AHEAD, _HUG), (_STRAIGHT_LEG, (100, 10, 0, 95, 0)), (15, 25, 55)),
    "anywhere": ((_HANG,), (_STRAIGHT_LEG,), (0, 0, 0)),
}
_MIN_ANGLES, _MAX_ANGLES = (
    (0, -70, -120, 0, -90, -45, -25, -40, 0, -40, -0.3),
    (178, 135, 90, 150, 95, 140, 85, 60, 155, 45, 1.0),
)
_ASYMMETRIC_POSES = ("splits", "anywhere", "kneel", "handstand", "cross-legged")  # left and right may differ


@dataclass(frozen=True, eq=False)
class Body:
    """A generated shape, the true positions of the template's vertices (``places``), and which of them it ``has``."""

    shape: Shape
    places: Float[Floats, "T 3"]
    has: Bool[Bools, " T"]
    words: dict[str, str]


@dataclass(frozen=True, eq=False)
class People:
    """Generator of the bodies of one seed."""

    template: Template
    seed: int

    @cached_property
    def figure(self) -> Figure:
        return Figure.of(template_rig(self.template, _N_IDENTITIES, _FIRST_IDENTITY_SEED + self.seed))

    def draw(self, number: int) -> Body:
        """Draw a body in a random orientation and a random unit of length."""
        rng = np.random.default_rng([self.seed, number])
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        pose = list(POSES)[int(rng.integers(len(POSES)))]
        verts, worn = self._draw_verts(pose, rng, generator)
        whole, tris = Shape(verts, np.asarray(self.template.shape.faces)), "template's"
        shape = whole
        if rng.random() < 0.5:
            tris, fine = "others", trimesh.Trimesh(verts, whole.faces, process=False).subdivide()
            shape = decimate(Shape(fine.vertices, fine.faces), int(rng.integers(4_000, 16_000)))
        cut, kept = self._draw_cut(verts, rng)
        near = cKDTree(verts).query(shape.verts)[1]
        shape, near = faces_kept(shape, near, np.asarray(kept(shape.verts, near)[shape.faces].all(1)))
        noise = rng.uniform(0.002, 0.012) if rng.random() < 0.15 else 0.0
        off = noise * rng.standard_normal(shape.verts.shape)
        turn, unit = Rotation.random(random_state=rng).as_matrix(), 10.0 ** rng.uniform(-1, 3)
        moved = Shape(unit * (shape.verts + off) @ turn.T, shape.faces, f"body {self.seed}-{number}")
        words = {"pose": pose, "worn": worn, "cut": cut, "triangles": tris, "noise": f"{1000 * noise:.0f} mm"}
        return Body(moved, unit * verts @ turn.T, kept(verts, np.arange(len(verts))), words)

    def _draw_verts(self, pose: str, rng: np.random.Generator, generator: torch.Generator) -> tuple[Floats, str]:
        """Draw vertices in metres; return them with a description of style and clothing."""
        figure, rig = self.figure, self.figure.rig
        rest, heads = draw_identities(rig, 1, generator)
        style = draw_style(1, generator, _STYLE_PROBABILITIES)
        worn = str(rng.choice(["naked", "clothed", "skirt"], p=[0.4, 0.4, 0.2]))
        kind = ("", "child, ", "stretched, ", "stylised, ")[int(style.kind)]
        if kind:
            rest, heads = scale_bones(figure, rest, heads, style)
        if int(style.kind) >= TOON:
            rest = round_parts(figure, rest, heads, style.kind, generator)
        if worn != "naked":
            rest = add_clothes(figure, rest, heads, generator)
        many = heads.repeat(_TRIES, 1, 1)
        world, offset = forward_kinematics(rig, many, self._draw_rotations(pose, many, rng, generator))
        best = int(penetration(rig, many, world, offset).argmin())
        world, offset = world[best : best + 1], offset[best : best + 1]
        verts = skin(rig, rest, world, offset)
        if worn == "skirt":
            joints = (world @ heads[..., None])[..., 0] + offset
            verts = add_skirts(figure, verts, heads, joints, generator)
        return verts[0].double().numpy(), kind + worn

    def _draw_rotations(
        self, pose: str, heads: torch.Tensor, rng: np.random.Generator, generator: torch.Generator
    ) -> torch.Tensor:
        """Draw the rotations of all joints, one set for each of the tries."""
        B, rig, draw = len(heads), self.figure.rig, Draw(len(heads), generator)
        arms, legs, spine = POSES[pose]
        same_arms, same_legs = rng.random() < 0.7, pose not in _ASYMMETRIC_POSES or rng.random() < 0.5
        picks = [(arms[rng.integers(len(arms))], legs[rng.integers(len(legs))]) for _ in range(2)]
        sides = []
        for side in (0, 1):
            arm, leg = picks[0 if same_arms else side][0], picks[0 if same_legs else side][1]
            middle = np.array([*arm, *leg, rng.choice([-0.2, 0.1, 0.8])], float)
            deviation = np.r_[np.full(10, 7.0), 0.08]
            columns = [draw.normal(a, d) for a, d in zip(middle, deviation, strict=True)]
            if pose == "anywhere":
                columns = [draw.uniform(a, b) for a, b in zip(_MIN_ANGLES, _MAX_ANGLES, strict=True)]
            names = [field.name for field in fields(Limbs)]
            sides.append(Limbs(**dict(zip(names, columns, strict=True))))
        vectors = torch.zeros(B, heads.shape[1], 3)
        matrices = pose_limbs(vectors, rig, heads, sides[0], sides[1], draw)
        bend = torch.stack([draw.normal(angle, 10) for angle in spine], -1)[:, [0, 2, 1]] * DEGREE
        for name, share in (("spine05", 0.15), ("spine04", 0.25), ("spine03", 0.2), ("spine02", 0.2), ("spine01", 0.2)):
            vectors[:, rig.joint(name)] = share * bend
        nod = torch.stack([draw.normal(0.3 * spine[0], 18), draw.normal(0, 28), draw.normal(0, 14)], -1) * DEGREE
        for name in ("neck01", "neck02", "neck03", "head"):
            vectors[:, rig.joint(name)] = 0.25 * nod
        return joint_rotations(vectors, matrices)

    def _draw_cut(self, verts: Floats, rng: np.random.Generator) -> tuple[str, Callable[[Floats, Ints], Bools]]:
        """Draw what is cut off.

        Return its name, and a function that selects the points to keep from positions and nearest template vertices.
        """
        which = str(rng.choice(["none", "half", "limb off", "limb alone", "holes"], p=[0.85, 0.05, 0.02, 0.01, 0.07]))
        names, labels = self.template.label_names, np.asarray(self.template.labels)
        if which == "half":
            name = str(rng.choice(["lower", "upper", "left", "right", "front", "back", "oblique"]))
            axis = {"lower": [0, -1, 0], "upper": [0, 1, 0], "left": [1, 0, 0], "right": [-1, 0, 0], "front": [0, 0, 1]}
            along = np.asarray(axis.get(name, [0, 0, -1]) if name != "oblique" else direction(rng), float)
            at = np.quantile(verts @ along, rng.uniform(0.35, 0.65))
            return f"{name} half", lambda points, _: points @ along >= at
        if which.startswith("limb"):
            asked = [names.index(name) for name in LIMBS[int(rng.integers(8))]]
            alone = which == "limb alone"
            return which, lambda _, near: np.isin(labels[near], asked) == alone
        middles = verts[rng.integers(len(verts), size=int(rng.integers(1, 8)) if which == "holes" else 0)]
        sizes = rng.uniform(0.04, 0.18, len(middles))
        return which, lambda points, _: (np.linalg.norm(points[:, None] - middles, axis=2) > sizes).all(1)


def measure_fit(body: Body, fit: Fit, template: Template) -> dict[str, Any]:
    """Return the errors of a fit, its verdict and its features."""
    unit = CM_PER_UNIT / np.sqrt(Shape(body.places, template.shape.faces).area)
    cm = unit * np.linalg.norm(fit.points_in_file - body.places, axis=1)
    opposite = cKDTree(template.shape.verts).query(template.shape.verts * [-1, 1, 1])[1]
    exchanged = unit * np.linalg.norm(fit.points_in_file[opposite] - body.places, axis=1)
    labels = np.asarray(template.labels)[body.has]
    parts = {template.label_names[k]: round(float(cm[body.has][labels == k].mean()), 1) for k in np.unique(labels)}
    assert fit.signs is not None
    row: dict[str, Any] = {"error": float(cm[body.has].mean()), "lost": float((cm[body.has] > _LOST_CM).mean())}
    row |= {"exchanged": float(exchanged[body.has].mean()), "parts": parts, "shown": float(body.has.mean())}
    row |= {"verdict": fit.verdict, "trust": fit.trust, "reasons": [reason.code for reason in fit.reasons]}
    return row | {"partial": fit.partial, "residual": fit.residual, "signs": asdict(fit.signs)}


def band_of(error: float) -> str:
    """Return the name of the band that contains an error in centimetres."""
    low = max((limit for limit in BANDS if error >= limit), default=0.0)
    return f"over {low:g} cm" if low == BANDS[-1] else f"{low:g} to {BANDS[BANDS.index(low) + 1 if low else 0]:g} cm"


def count_by_error(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Count fits by verdict: a row for every band of error."""
    found = []
    for name in [band_of(limit) for limit in (0.0, *BANDS)]:
        some = [row["verdict"] for row in rows if row["verdict"] != REFUSED and band_of(row["error"]) == name]
        found.append({"error": name, **{verdict: some.count(verdict) for verdict in VERDICTS}, "all": len(some)})
    return found


def summarize_by_pose(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Summarise errors by pose, with the number of fits over 8 cm that are not called poor."""
    found = []
    for pose in POSES:
        some = [
            row for row in rows if row["pose"] == pose and row["cut"] in ("none", "holes") and row["verdict"] != REFUSED
        ]
        if some:
            errors = np.array([row["error"] for row in some])
            believed = np.array([row["verdict"] != "poor" for row in some])
            is_wrong = errors > _WRONG_CM
            row = {"pose": pose, "bodies": len(some), "mean": errors.mean(), "median": np.median(errors)}
            found.append(row | {"off": is_wrong.mean(), "not_poor": int((is_wrong & believed).sum())})
    return found


def format_body(row: dict[str, Any]) -> str:
    """Format a body as one line, which `finished_bodies` parses."""
    error = f"{row['error']:.2f}" if "error" in row else ""
    return "; ".join([str(row["seed"]), str(row["number"]), row["pose"], row["cut"], error, row["verdict"]])


def finished_bodies(path: Path) -> list[dict[str, Any]]:
    """Read the bodies from the saved results of an earlier run."""
    found = []
    try:
        for line in read_json(path)["values"]["rows"]:
            seed, number, pose, cut, error, verdict = line.split("; ")
            row = {"seed": int(seed), "number": int(number), "pose": pose, "cut": cut, "verdict": verdict}
            found.append(row | ({"error": float(error)} if error else {}))
    except (OSError, KeyError, TypeError, ValueError, AttributeError) as problem:
        raise InputError(f"{path} has no bodies of an earlier run", "give a file that --save wrote") from problem
    return found


@runner.command
def main(
    bodies: Annotated[int, Option(min=1, help="how many")] = 5000,
    output: Annotated[Path, Option(help="folder of bodies and fits")] = Path("campaign"),
    threads: runner.Threads = 1,
    seed: runner.Seed = 1,
    seeds: Annotated[
        int, Option(min=1, help="number of seeds, from --seed on, that bodies are drawn from by turns")
    ] = 2,
    known: Annotated[Path | None, Option(help="results of an earlier run: its bodies are not fitted again")] = None,
) -> runner.Report:
    make_folder(output / "fits")
    path, template, matcher = output / "bodies.jsonl", read_template("human-T"), Matcher("human", FitConfig(), threads)
    rows = [] if known is None else finished_bodies(known)
    rows += [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.exists() else []
    done = {(row["seed"], row["number"]) for row in rows}
    drawn = [People(template, seed + k) for k in range(seeds)]
    for k in runner.track(range(bodies), "bodies"):
        people, number = drawn[k % seeds], k // seeds
        if (people.seed, number) in done:
            continue
        body, began = people.draw(number), time.process_time()
        row: dict[str, Any] = {"seed": people.seed, "number": number, **body.words, "V": body.shape.V}
        try:
            fit = matcher.fit(body.shape)
            row |= measure_fit(body, fit, template)
            write_fit(output / "fits" / f"{people.seed}-{number}.safetensors", fit)
        except MeshmatchError as error:
            row |= {"verdict": REFUSED, "reasons": [error.message]}
        row["seconds"] = time.process_time() - began
        rows.append(row)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(runner.to_json(row)) + "\n")
    found, poses = count_by_error(rows), summarize_by_pose(rows)
    refused = sum(row["verdict"] == REFUSED for row in rows)
    columns = {"error": "error"} | {name: f"{name}:d" for name in (*VERDICTS, "all")}
    tables = [
        runner.table(f"{len(rows)} bodies, of which {refused} refused", found, columns),
        runner.table("By pose, of bodies of which no more than holes is missing", poses, _POSE_COLUMNS),
    ]
    lines = [format_body(row) for row in sorted(rows, key=lambda row: (row["seed"], row["number"]))]
    record = {"bodies": len(rows), "refused": refused, "bands": found, "poses": poses, "rows": lines}
    return runner.Report(record, tables)
