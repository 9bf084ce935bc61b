"""Sample bodies with other objects in the same file: floors, boxes, chairs, coats, eyes, a second body."""

from pathlib import Path

import numpy as np
import trimesh

from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"


def sample(name: str) -> Shape:
    return load_shape(SAMPLES / f"{name}.ply")


def together(name: str, *shapes: Shape) -> Shape:
    """Concatenate shapes into one."""
    before = np.cumsum([0, *(shape.V for shape in shapes)])
    faces = [shape.faces + offset for shape, offset in zip(shapes, before[:-1], strict=True)]
    return Shape(np.concatenate([shape.verts for shape in shapes]), np.concatenate(faces), name)


def box(low: list[float], high: list[float], name: str = "box") -> Shape:
    """A closed box of 768 triangles."""
    mesh = trimesh.creation.box(bounds=[low, high])
    for _ in range(3):
        mesh = mesh.subdivide()
    return Shape(mesh.vertices, mesh.faces, name)


def sheet(center: np.ndarray, width: float) -> Shape:
    """A square, single-sided floor."""
    side = np.linspace(-width / 2, width / 2, 13)
    x, y = np.meshgrid(side, side, indexing="ij")
    verts = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3) + center
    corner = np.arange(169).reshape(13, 13)
    a, b, c, d = (each.ravel() for each in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    return Shape(verts, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), "floor")


def below(body: Shape) -> np.ndarray:
    """Return a point slightly below the feet."""
    low, high = body.bounds
    return np.array([*(low + high)[:2] / 2, low[2] - 0.003])


def floor(body: Shape, width: float = 3.0) -> Shape:
    return sheet(below(body), width)


def fused_with_floor(body: Shape, width: float = 3.0) -> Shape:
    """Join a body and a floor into one part by triangles between a foot and the floor."""
    ground = floor(body, width)
    lowest, middle = int(np.asarray(body.verts)[:, 2].argmin()), body.V + np.array([84, 85, 97])
    bridge = np.array([[lowest, middle[0], middle[1]], [lowest, middle[2], middle[0]]])
    verts, faces = (
        np.concatenate([body.verts, ground.verts]),
        np.concatenate([body.faces, ground.faces + body.V, bridge]),
    )
    return Shape(verts, faces, "scan.ply")


def pedestal(body: Shape, height: float = 0.5) -> Shape:
    x, y, z = below(body)
    return box([x - 0.4, y - 0.4, z - height], [x + 0.4, y + 0.4, z])


def pack(body: Shape) -> Shape:
    """A box on the back of a body."""
    x, y, z = body.bounds.mean(axis=0)
    return box([x - 0.2, y + 0.05, z - 0.05], [x + 0.2, y + 0.4, z + 0.45])


def chair(place: np.ndarray) -> Shape:
    """A chair: seat, back and four legs as separate parts."""
    x, y, z = place
    legs = [
        box([x + i - 0.02, y + j - 0.02, z], [x + i + 0.02, y + j + 0.02, z + 0.42])
        for i in (-0.2, 0.2)
        for j in (-0.2, 0.2)
    ]
    seat = box([x - 0.22, y - 0.22, z + 0.42], [x + 0.22, y + 0.22, z + 0.46])
    return together("chair", seat, box([x - 0.22, y + 0.18, z + 0.46], [x + 0.22, y + 0.22, z + 0.9]), *legs)


def beside(body: Shape, away: float = 0.35) -> np.ndarray:
    """Return a point on the floor at one side of a body."""
    return np.array([body.bounds[1, 0] + away, *below(body)[1:]])


def coat(body: Shape) -> Shape:
    """A copy of the trunk, offset by 2 % of the height: an open, separate part."""
    height = (body.verts[:, 2] - body.bounds[0, 2]) / np.ptp(body.bounds[:, 2])
    faces = body.faces[((height > 0.3) & (height < 0.75))[body.faces].all(axis=1)]
    used, corners = np.unique(faces, return_inverse=True)
    out = 0.02 * np.ptp(body.bounds[:, 2]) * body.vertex_normals[used]
    pieces = trimesh.Trimesh(body.verts[used] + out, corners.reshape(-1, 3), process=False).split(only_watertight=False)
    largest = max(pieces, key=lambda piece: piece.area)  # without pieces that cover a hand
    return Shape(largest.vertices, largest.faces, "coat")


def eyes(body: Shape) -> Shape:
    """Two small balls in the head."""
    top = body.verts[body.verts[:, 2].argmax()]
    ball = trimesh.creation.icosphere(2, 0.015)
    return together("eyes", *(Shape(ball.vertices + top + [x, 0, -0.06], ball.faces) for x in (-0.03, 0.03)))


def second(body: Shape, away: float = 0.9) -> Shape:
    """The same body next to it, facing the other way."""
    middle = body.bounds.mean(axis=0) * [1, 1, 0]
    return Shape((body.verts - middle) * [-1, -1, 1] + middle + [away, 0, 0], body.faces, "second")


def moved(shape: Shape, by: list[float]) -> Shape:
    return Shape(shape.verts + by, shape.faces, shape.name)
