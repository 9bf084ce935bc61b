"""Small surfaces with known geometry."""

import numpy as np

from meshmatch.shapes.shape import Shape


def grid(rows: int, columns: int, step: float = 1.0, name: str = "grid") -> Shape:
    """A flat sheet of (rows + 1) x (columns + 1) vertices; vertex id = row * (columns + 1) + column."""
    y, x = np.mgrid[: rows + 1, : columns + 1]
    verts = np.stack([x.ravel() * step, y.ravel() * step, np.zeros(x.size)], axis=1)
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
    return Shape(verts, faces, name)


def bumpy_sphere(rows: int = 24, columns: int = 40, name: str = "bumpy") -> Shape:
    """A closed sphere with soft bumps: curved both ways, edges of many lengths."""
    theta = np.linspace(0, np.pi, rows + 1)[1:-1, None]
    phi = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None]
    radius = 1 + 0.25 * np.sin(3 * theta) * np.cos(4 * phi)
    x, y = radius * np.sin(theta) * np.cos(phi), radius * np.sin(theta) * np.sin(phi)
    ring = np.stack([x, y, radius * np.cos(theta)], axis=-1)
    verts = np.concatenate([ring.reshape(-1, 3), [[0, 0, 1.0]], [[0, 0, -1.0]]])
    faces = []
    for k in range(columns):
        right = (k + 1) % columns
        faces.append([len(verts) - 2, k, right])
        faces.append([len(verts) - 1, (rows - 2) * columns + right, (rows - 2) * columns + k])
        for r in range(rows - 2):
            a, b, c, d = (r * columns + k, r * columns + right, (r + 1) * columns + k, (r + 1) * columns + right)
            faces += [[a, c, d], [a, d, b]]
    return Shape(verts, np.array(faces), name)
