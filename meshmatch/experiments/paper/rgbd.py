"""Texture from one RGB-D cloud to another: the paper's section 6.1 and figure 13, on simulated clouds with a known answer.

Generated people in sampled poses and coloured clothes, none of whom a training of the released model drew, are seen by
one, two or four cameras as a Kinect sees them, written as .pcd (the source) and .ply (the target), and
read again. The colours of the source go to the points of the target: to the same person in another pose, and to another
person.

A pinhole camera measures disparity, which is linear in 1 / depth. The map (x, y, z) -> (x / z, y / z, 1 / z) takes planes
to planes and the rays of the camera to parallel ones, so the renderer's orthographic rays give the disparity of every
pixel. What follows is the first Kinect's, after Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data for
indoor mapping applications" (Sensors, 2012): disparity comes in eighths of a pixel with a standard deviation of half of
one, so noise and steps of depth grow with its square (0.9 and 1.8 cm at 2.5 m). Pixels at silhouettes may fly off towards
the background, and take half of its colour; steep surface and some round patches return nothing; points of no body lie
around. Several cameras are fused with a small error of calibration.

- geometry: distance (cm) of the source point that each target point is matched to from the place on the source's true
  surface where the target point belongs; the points' own noise, about 1 cm, counts.
- colour: root of the mean squared error over points and channels, in bytes (0..255), against the colour of that place.

Both are means over pairs, with a 95 % bootstrap interval over pairs. Only points count whose place the source shows (a
point of it lies within 3 cm): elsewhere there is nothing to carry; ``colour, all`` counts every point of the body. Points
that fly, and points of no body, are in the clouds but have no answer.

- truth: the source point nearest to the right place: the least that is possible.
- ours: `meshmatch.transfer_colors`. coded: 3D-CODED (--coded, a folder of `experiments.paper.learned_baselines`), its code
  searched by the Chamfer distance, then the nearest point; --coded-by names a model that tells it the orientation. rigid:
  scaled by area, all orientations tried, nearest point.

Clouds, and the results of each pair and method, are kept in the output folder; the same command goes on from there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from typer import Option

from meshmatch.api.inputs import validated
from meshmatch.api.matcher import Matcher
from meshmatch.api.transfer import transfer_colors
from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.methods import OurMethod, Registration, coded
from meshmatch.experiments.makers.human_bodies import body_parts
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.generators.bodies import draw_identities, sample_free_pose
from meshmatch.generators.rig import Rig, cached_rig, skin
from meshmatch.geometry.triangles import closest_on_triangles, interpolate
from meshmatch.models.registry import find_model
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.render.scene import Scene
from meshmatch.render.surface import Surface, face_paint
from meshmatch.shapes.colors import oklab_to_linear, to_srgb
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape

NAMES = {"rigid": "rigid, nearest", "coded": "3D-CODED", "ours": "ours", "truth": "the true partner"}
TARGETS = ("same", "other")
_SHOWN = 0.03  # metres
_LOST_CM = 15.0
_DRAWS = 10_000
Carried = tuple[Float[Floats, "N 3"], Int[Ints, " N"]]
"""Colours of the target's points (sRGB, 0..1), and the source point that each is matched to."""
COLUMNS = {
    **{"views": "views:d", "target": "target", "method": "method", "pairs": "pairs:d"},
    **{"colour RMS": "color", "colour, all": "color_all_mean:.1f", "geometry cm": "cm", "median": "median_cm_mean:.1f"},
    **{f"over {_LOST_CM:g} cm": "lost_mean:.1%", "shown": "shown_mean:.0%", "s": "seconds_mean:.1f"},
}


BACKGROUND = 0.55  # grey of the room
_IDENTITIES = 64


@dataclass(frozen=True)
class Camera:
    """The first Kinect at a quarter of its pixels; lengths in metres, pixels those of this image unless said otherwise."""

    width: int = 320
    height: int = 240
    focal: float = 290.0
    baseline: float = 0.075
    focal_of_disparity: float = 580.0  # pixels of the full image, of which disparity counts eighths
    noise: float = 0.5  # standard deviation of the count
    distance: float = 2.6  # from the middle of the body
    flying: float = 0.3  # share of pixels at silhouettes
    reach: float = 0.06  # mean distance that these are behind the body
    steep: float = 0.2  # cosine between ray and normal below which nothing returns
    missing: float = 0.01  # share of pixels that return nothing
    patches: float = 4.0  # round holes in an image, on average
    color_noise: float = 4.0 / 255.0
    turn_error: float = 0.15  # degrees, of a camera's calibration
    place_error: float = 0.002  # metres
    stray: float = 0.01  # points of no body, as a share of the others


@dataclass(frozen=True, eq=False)
class Body:
    """A generated body: vertices (V, 3) in metres, y up, facing +z, with their colours (V, 3), sRGB in 0..1."""

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    colors: Float[Floats, "V 3"]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Coloured points, and the triangle of the body and the place in it that each is of; face -1: of none."""

    shape: Shape
    face: Int[Ints, " N"]
    barycentric: Float[Floats, "N 3"]

    def on(self, faces: Int[Ints, "F 3"], values: Float[Floats, "V D"]) -> Float[Floats, "N D"]:
        """Values of a body's vertices where the points are from; rows of points of no body hold nothing of use."""
        return interpolate(values, faces[self.face], self.barycentric)


def draw_bodies(count: int, seed: int) -> list[tuple[Body, Body, Body]]:
    """So many triples: a person, the same in another pose, another person; no training of the released model drew them."""
    rig = cached_rig(_IDENTITIES, seed + 1)
    generator = torch.Generator().manual_seed(seed)
    rest, heads = draw_identities(rig, 2 * count, generator)
    who = torch.tensor([[k, k, count + k] for k in range(count)]).reshape(-1)
    world, offset = sample_free_pose(rig, heads[who], generator)
    verts = skin(rig, rest[who], world, offset).double().numpy()
    faces = rig.faces.numpy().astype(np.int64)
    dress = [clothes(rig, np.random.default_rng([seed, k])) for k in range(2 * count)]
    made = [Body(each, faces, dress[person]) for each, person in zip(verts, who.tolist(), strict=True)]
    return [(made[3 * k], made[3 * k + 1], made[3 * k + 2]) for k in range(count)]


def clothes(rig: Rig, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """Colours of the vertices: skin, hair, a checked shirt with sleeves of two colours, trousers with a seam, shoes."""
    labels, names = body_parts(rig)
    rest = rig.rest.float().mean(0).double().numpy()
    x, y, z = rest.T
    hue = rng.uniform(0, 2 * np.pi)

    def ink(light: float, chroma: float, turn: float) -> Floats:
        angle = hue + turn
        return np.asarray(to_srgb(oklab_to_linear(np.array([[light, chroma * np.cos(angle), chroma * np.sin(angle)]]))))

    part = np.array([name.removeprefix("left ").removeprefix("right ") for name in names])[labels]
    colors = np.tile(to_srgb(oklab_to_linear(np.array([[rng.uniform(0.5, 0.82), 0.03, 0.05]]))), (len(rest), 1))
    head = part == "head"
    top, middle = y[head].max(), z[head].mean()
    colors[head & ((y > top - 0.06) | ((z < middle - 0.01) & (y > top - 0.17)))] = ink(rng.uniform(0.2, 0.6), 0.03, 2.0)
    shirt, legs = np.isin(part, ["chest", "belly", "upper arm"]), np.isin(part, ["hips", "thigh", "shin"])
    checks = (np.floor(y / 0.07) + np.floor(x / 0.09) + (z > 0)) % 2 > 0.5
    colors[shirt] = np.where(checks[shirt, None], ink(0.75, 0.13, 0.0), ink(0.45, 0.13, 0.6))
    colors[shirt & (part == "upper arm") & (x > 0)] = ink(0.8, 0.12, 2.6)
    colors[legs] = ink(0.38, 0.09, 4.0)
    colors[legs & (np.abs(z - z[legs].mean()) < 0.02)] = ink(0.85, 0.05, 4.0)
    colors[part == "foot"] = ink(0.6, 0.15, 1.3)
    return colors


def scan(body: Body, views: int, seed: int, camera: Camera = Camera(), name: str = "") -> Cloud:
    """The body seen from so many sides, evenly around it, the first one roughly its front."""
    rng = np.random.default_rng(seed)
    first = np.radians(rng.uniform(-20, 20))
    seen = [_view(body, first + 2 * np.pi * k / views, camera, rng) for k in range(views)]
    points, colors, face, barycentric = (np.concatenate(each) for each in zip(*seen, strict=True))
    count = round(camera.stray * len(points))
    low, high = points.min(0) - 0.3, points.max(0) + 0.3
    points = np.concatenate([points, rng.uniform(low, high, (count, 3))])
    colors = np.concatenate([colors, rng.uniform(size=(count, 3))])
    order = rng.permutation(len(points))
    face = np.concatenate([face, np.full(count, -1)])[order]
    barycentric = np.concatenate([barycentric, np.ones((count, 3)) / 3])[order]
    rgba = np.column_stack([colors, np.ones(len(colors))])[order]
    return Cloud(Shape(points[order], np.empty((0, 3), np.int64), name, rgba), face, barycentric)


def _view(
    body: Body, yaw: float, camera: Camera, rng: np.random.Generator
) -> tuple[Float[Floats, "N 3"], Float[Floats, "N 3"], Int[Ints, " N"], Float[Floats, "N 3"]]:
    """What one camera sees: points in the world, their colours, faces (-1 for those that fly) and places in these."""
    center = 0.5 * (body.verts.min(0) + body.verts.max(0))
    back = np.array([np.sin(yaw), 0.0, np.cos(yaw)])  # from the body to the camera
    axes = np.stack([np.array([back[2], 0.0, -back[0]]), np.array([0.0, 1.0, 0.0]), back])
    eye = center + camera.distance * back
    local = (body.verts - eye) @ axes.T
    depth = -local[:, 2]
    warped = np.column_stack([local[:, :2], np.ones(len(local))]) / depth[:, None]
    white = face_paint(np.ones((len(body.faces), 3)))
    scene = Scene([Surface(warped, body.faces, np.zeros_like(warped), white)])
    across = (np.arange(camera.width) + 0.5 - camera.width / 2) / camera.focal
    upwards = (camera.height / 2 - np.arange(camera.height) - 0.5) / camera.focal
    x, y = (grid.reshape(-1) for grid in np.meshgrid(across, upwards))
    hits = scene.look(x, y, 1.0 / camera.focal)
    hit = hits.face >= 0
    true = np.where(hit, 1.0 / np.where(hit, hits.place[:, 2], 1.0), np.inf)
    rays = np.column_stack([x, y, -np.ones(len(x))]) @ axes
    rows = np.flatnonzero(hit & ~_dark(hits.face, np.column_stack([x, y]), rays, body, camera, rng))

    place = rays[rows] * true[rows, None] + eye
    corners = body.verts[body.faces[hits.face[rows]]]
    barycentric = closest_on_triangles(place, corners[:, 0], corners[:, 1], corners[:, 2])
    colors = interpolate(body.colors, body.faces[hits.face[rows]], barycentric)
    flies = _silhouette(true.reshape(camera.height, camera.width)).reshape(-1)[rows]
    flies &= rng.random(len(rows)) < camera.flying
    behind = true[rows] + flies * np.minimum(rng.exponential(camera.reach, len(rows)), 0.4)
    colors = np.where(flies[:, None], 0.5 * (colors + BACKGROUND), colors)
    colors = np.clip(colors + camera.color_noise * rng.standard_normal(colors.shape), 0.0, 1.0)
    scale = 8 * camera.focal_of_disparity * camera.baseline
    counts = np.rint(scale / behind + camera.noise * rng.standard_normal(len(rows)))
    points = rays[rows] * (scale / counts)[:, None] + eye
    turn = Rotation.from_rotvec(np.radians(camera.turn_error) * rng.standard_normal(3)).as_matrix()
    points = (points - eye) @ turn.T + eye + camera.place_error * rng.standard_normal(3)
    return points, colors, np.where(flies, -1, hits.face[rows]), barycentric


def _dark(
    face: Int[Ints, " P"],
    pixels: Float[Floats, "P 2"],
    rays: Float[Floats, "P 3"],
    body: Body,
    camera: Camera,
    rng: np.random.Generator,
) -> Bool[Bools, " P"]:
    """Pixels that return nothing; ``face`` is what each of them sees, -1 for nothing."""
    a, b, c = (body.verts[body.faces[np.maximum(face, 0)][:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(rays, axis=1)
    dark = np.abs((normal * rays).sum(1)) < camera.steep * lengths
    dark |= rng.random(len(rays)) < camera.missing
    inside = np.flatnonzero(face >= 0)
    for _ in range(rng.poisson(camera.patches)):
        radius = rng.uniform(2, 7) / camera.focal
        dark |= np.linalg.norm(pixels - pixels[rng.choice(inside)], axis=1) < radius
    return dark


def _silhouette(depth: Float[Floats, "H W"], jump: float = 0.05) -> Bool[Bools, "H W"]:
    """Pixels with a neighbour that is further away by more than a jump (metres), or sees nothing."""
    padded = np.pad(depth, 1, constant_values=np.inf)
    around = np.stack([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
    return np.asarray(np.isfinite(depth) & (around.max(0) > np.where(np.isfinite(depth), depth, 0) + jump))


def save_pcd(path: Path, shape: Shape) -> None:
    """Coloured points as PCL writes them, binary: the colour is a float's four bytes, blue first."""
    assert shape.colors is not None
    rows = np.zeros(shape.V, [("place", "<f4", 3), ("rgb", "u1", 4)])
    rows["place"] = shape.verts
    rows["rgb"][:, :3] = np.rint(255 * shape.colors[:, 2::-1])
    head = ["# .PCD v0.7", "VERSION 0.7", "FIELDS x y z rgb", "SIZE 4 4 4 4", "TYPE F F F F", "COUNT 1 1 1 1"]
    head += [f"WIDTH {shape.V}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {shape.V}", "DATA binary\n"]
    with replace_on_success(path) as temporary:
        temporary.write_bytes("\n".join(head).encode() + rows.tobytes())


@dataclass(frozen=True, eq=False)
class Case:
    """Two clouds with their files, and the source's body, whose triangles the target's body shares."""

    name: str
    source: Cloud
    target: Cloud
    body: Body
    source_file: Path
    target_file: Path

    @property
    def right(self) -> Float[Floats, "N 3"]:
        """Where the points of the target belong on the source's body; nothing of use for points of no body."""
        return self.target.on(self.body.faces, self.body.verts)

    def colored(self, index: Int[Ints, " N"]) -> Carried:
        """The target with the colours of these points of the source."""
        assert self.source.shape.colors is not None
        return self.source.shape.colors[index, :3], index


def by_rigid(case: Case, seed: int) -> Carried:
    """Rigid alignment without what repair takes for outliers, and the nearest point."""
    source, target = (validated(load_shape(file)) for file in (case.source_file, case.target_file))
    method = Registration("rigid", None, seed)
    found = method.map(target.shape, method.fit(target.shape), source.shape, method.fit(source.shape))
    return case.colored(source.kept_vertex[found.index[target.original_to_repaired]])


def by_coded(case: Case, method: OurMethod, fits: dict[Path, Fit]) -> Carried:
    """3D-CODED, from the target to the source; each cloud is fitted once."""
    for file in (case.source_file, case.target_file):
        if file not in fits:
            fits[file] = method.fit(load_shape(file))
    source, target = fits[case.source_file], fits[case.target_file]
    return case.colored(method.map(case.target.shape, target, case.source.shape, source).index)


def by_us(case: Case, matcher: Matcher) -> Carried:
    """The product's own call."""
    found = transfer_colors(case.source_file, case.target_file, matcher)
    return found.data[:, :3], found.maps.backward.index


def by_truth(case: Case) -> Carried:
    """The point of the source's body nearest to where each target point belongs."""
    real = np.flatnonzero(case.source.face >= 0)
    return case.colored(real[cKDTree(case.source.shape.verts[real]).query(case.right)[1]])


def measure(case: Case, carried: Carried) -> dict[str, float]:
    """Errors of one pair."""
    of_body = np.flatnonzero(case.target.face >= 0)
    right, verts = case.right[of_body], case.source.shape.verts
    goal = case.target.on(case.body.faces, case.body.colors)[of_body]
    shown = cKDTree(verts[case.source.face >= 0]).query(right)[0] < _SHOWN
    off = 255 * (carried[0][of_body] - goal)
    cm = 100 * np.linalg.norm(verts[carried[1][of_body]] - right, axis=1)
    return {
        "color": float(np.sqrt(np.square(off[shown]).mean())),
        "color_all": float(np.sqrt(np.square(off).mean())),
        **{"mean_cm": float(cm[shown].mean()), "median_cm": float(np.median(cm[shown]))},
        **{"lost": float((cm[shown] > _LOST_CM).mean()), "shown": float(shown.mean())},
    }


def interval(values: Sequence[float], seed: int = 0) -> tuple[float, float]:
    """95 % of the means of as many values drawn with replacement."""
    drawn = np.random.default_rng(seed).choice(np.asarray(values, float), (_DRAWS, len(values)))
    low, high = np.quantile(drawn.mean(1), [0.025, 0.975])
    return float(low), float(high)


def summed(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over pairs, and intervals in words and numbers."""
    row: dict[str, Any] = {"pairs": len(results)}
    for key in ("color", "color_all", "mean_cm", "median_cm", "lost", "shown", "seconds"):
        row[f"{key}_mean"] = float(np.mean([each[key] for each in results]))
    for key, words in (("color", "color"), ("mean_cm", "cm")):
        low, high = row[f"{key}_interval"] = interval([each[key] for each in results])
        row[words] = f"{row[f'{key}_mean']:.1f} ({low:.1f} to {high:.1f})"
    return row


def cases_of(folder: Path, bodies: tuple[Body, Body, Body], number: int, views: int, seed: int) -> list[Case]:
    """Both pairs of a person; clouds are written where they are not."""
    clouds, files = [], []
    for place, (body, role) in enumerate(zip(bodies, ("source", *TARGETS), strict=True)):
        cloud = scan(body, views, 1000 * seed + 100 * number + 10 * views + place)
        file = folder / f"{number}-{role}-{views}{'.ply' if place else '.pcd'}"
        if not file.is_file():
            (save_shape if place else save_pcd)(file, cloud.shape)
        clouds.append(cloud)
        files.append(file)
    source, *targets = zip(clouds, files, strict=True)
    return [Case(file.stem, source[0], cloud, bodies[0], source[1], file) for cloud, file in targets]


@runner.command
def main(
    output: Annotated[Path, Option("-o", "--output", help="folder of clouds and results")] = Path("out/rgbd"),
    pairs: Annotated[int, Option(min=1, help="people, each with two targets")] = 6,
    views: Annotated[str, Option(help="how many cameras: numbers with commas")] = "1,2,4",
    methods: Annotated[str, Option(help=f"of {', '.join(NAMES)}")] = ",".join(NAMES),
    coded_model: Annotated[
        str | None, Option("--coded", help="a model folder of experiments.paper.learned_baselines")
    ] = None,
    coded_steps: Annotated[int, Option(min=1, help="of its search over codes")] = 200,
    coded_by: Annotated[str, Option(help="a model that finds the orientation for it; none by default")] = "",
    model: runner.Model = "human",
    seed: runner.Seed = 0,
    threads: runner.Threads = 1,
) -> runner.Report:
    asked, notes = runner.names_of(methods, NAMES, "method"), []
    numbers = [str(k) for k in range(1, 13)]
    counts = [int(each) for each in runner.names_of(views, numbers, "number of views")]
    ways: dict[str, Callable[[Case], Carried]] = {
        **{"truth": by_truth, "rigid": partial(by_rigid, seed=seed)},
        "ours": partial(by_us, matcher=Matcher(model, FitConfig(seed=seed), threads)),
    }
    settings: dict[str, Any] = {"ours": find_model(model)[1].weights_sha256}
    if coded_model is not None:
        ways["coded"] = partial(by_coded, method=coded(coded_model, coded_steps, seed, coded_by), fits={})
        settings["coded"] = [find_model(coded_model)[1].weights_sha256, coded_steps, coded_by]
    elif "coded" in asked:
        asked.remove("coded")
        notes.append("3D-CODED is left out: give --coded MODEL, made by experiments.paper.learned_baselines coded")
    make_folder(output)
    bodies = draw_bodies(pairs, seed)

    def answer(case: Case, method: str) -> dict[str, Any]:
        runner.tell(f"{case.name}: {NAMES[method]}")
        began = time.perf_counter()
        carried = ways[method](case)
        seconds = round(time.perf_counter() - began, 2)
        np.save(output / f"{case.name}-{method}.npy", np.rint(255 * carried[0]).astype(np.uint8))
        return {**measure(case, carried), "seconds": seconds, **runner.circumstances(threads)}

    found: dict[tuple[int, str, str], list[dict[str, Any]]] = {}
    for count, number in product(counts, range(pairs)):
        cases = cases_of(output, bodies[number], number, count, seed)
        for (target, case), method in product(zip(TARGETS, cases, strict=True), asked):
            key = {"camera": vars(Camera()), "seed": seed, "people": pairs, "settings": settings.get(method)}
            file = output / f"{case.name}-{method}.json"
            result = runner.once(file, key, partial(answer, case, method))
            found.setdefault((count, target, method), []).append(result)
    order = sorted(found, key=lambda key: (key[0], TARGETS.index(key[1]), asked.index(key[2])))
    rows = [
        {"views": count, "target": target, "method": NAMES[method], **summed(found[count, target, method])}
        for count, target, method in order
    ]
    title = "Colours from cloud to cloud, in bytes; 95 % intervals over pairs"
    return runner.Report({"rows": rows}, [runner.table(title, rows, COLUMNS)], notes)
