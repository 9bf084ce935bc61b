"""Clouds of coloured points as a Kinect sees textured bodies, with the place on the body that every point is of.

A pinhole camera measures disparity, which is linear in 1 / depth. The map (x, y, z) -> (x / z, y / z, 1 / z) takes planes
to planes and the rays of the camera to parallel ones, so the renderer's orthographic rays give the disparity of every
pixel. What follows is the first Kinect's, after Khoshelham and Elberink, "Accuracy and resolution of Kinect depth data for
indoor mapping applications" (Sensors, 2012): disparity comes in eighths of a pixel with a standard deviation of half of
one, so noise and steps of depth grow with its square (0.9 and 1.8 cm at 2.5 m). Pixels at silhouettes may fly off towards
the background, and take half of its colour; steep surface and some round patches return nothing; points of no body lie
around. Several cameras are fused with a small error of calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.experiments.makers.human_bodies import body_parts
from meshmatch.generators.bodies import draw_identities, sample_free_pose
from meshmatch.generators.rig import Rig, cached_rig, skin
from meshmatch.geometry.triangles import closest_on_triangles, interpolate
from meshmatch.outputs import replace_on_success
from meshmatch.render.scene import Scene
from meshmatch.render.surface import Surface, face_paint
from meshmatch.shapes.colors import oklab_to_linear, to_srgb
from meshmatch.shapes.shape import Shape

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
