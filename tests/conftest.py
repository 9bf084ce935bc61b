"""Fixtures for all tests: small shapes, shared fits, and the evaluation data if it is available."""

import base64
import os
import pickle
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy: tests have many small products, in several processes

import numpy as np
import pytest
from filelock import FileLock

from tests import array_annotations

array_annotations.install(["meshmatch"])  # before any of its modules is loaded

from meshmatch.fitting.fit import Fit  # noqa: E402
from meshmatch.geometry.frames import Frame  # noqa: E402
from meshmatch.shapes.shape import Shape  # noqa: E402


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run modules with slow tests first, so that no process is still busy with one when the others are done."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session", autouse=True)
def kept_glb() -> Iterator[None]:
    """With MESHMATCH_KEEP_GLB=FOLDER, save every distinct glb that the package makes in that folder.

    `meshmatch.experiments.bench.viewers.valid` validates them.
    """
    if not (named := os.environ.get("MESHMATCH_KEEP_GLB")):
        yield
        return
    from meshmatch.shapes.formats import gltf_edit, gltf_write

    folder = Path(named)
    folder.mkdir(parents=True, exist_ok=True)

    def keeping(make: Callable[..., bytes]) -> Callable[..., bytes]:
        def kept(*words: Any, **more: Any) -> bytes:
            made = make(*words, **more)
            file, _, test = os.environ.get("PYTEST_CURRENT_TEST", "").partition(" ")[0].partition("::")
            words = re.sub(r"\W+", "-", f"{Path(file).stem} {test}").strip("-")
            name = f"{words}-{sha256(made).hexdigest()[:8]}.glb"
            (folder / name).write_bytes(made)
            return made

        return kept

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gltf_edit.Editor, "to_bytes", keeping(gltf_edit.Editor.to_bytes))
        patch.setattr(gltf_write, "_glb", keeping(gltf_write._glb))
        yield


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder shared by all processes of a test run."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@contextmanager
def remembering(folder: Path) -> Iterator[Callable[..., Any]]:
    """Cache fits in `folder`, by model, settings and shape, for all tests and processes.

    Yield the original method, which does not use the cache.
    """
    from meshmatch.fitting.fitter import Fitter

    fit = Fitter.fit

    def remembered(self, shape, landmarks=None):
        model = self.model.card.weights_sha256, self.model.template.hash
        key = (*model, self.config, landmarks, shape.name, shape.verts, shape.faces)
        file = folder / sha256(pickle.dumps(key)).hexdigest()
        with FileLock(f"{file}.lock"):
            if not file.exists():
                file.write_bytes(pickle.dumps(fit(self, shape, landmarks)))
            return pickle.loads(file.read_bytes())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Fitter, "fit", remembered)
        yield fit


@pytest.fixture(scope="module")
def remembered_fits(run_folder: Path) -> Iterator[Callable[..., Any]]:
    """Cache the fits of a module, for tests that only use fits or share them with other tests; see `remembering`."""
    with remembering(run_folder) as fit:
        yield fit


@pytest.fixture(scope="session")
def bench() -> Path:
    """The folder of evaluation data next to the repository; tests that need it are skipped without it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "bench"
    if not folder.is_dir():
        pytest.skip(f"no evaluation data at {folder}")
    return folder


@pytest.fixture(scope="session")
def cube() -> Shape:
    """The unit cube [0, 1]^3: 8 vertices, 12 outward triangles."""
    verts = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Shape(verts, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]), "cube")


@pytest.fixture(scope="session")
def make_sphere() -> Callable[[int], Shape]:
    """Function that makes unit spheres: an icosahedron whose triangles are split in four a number of times."""
    return icosphere


@pytest.fixture(scope="session")
def sphere() -> Shape:
    """The unit sphere: 642 vertices, 1280 outward triangles."""
    return icosphere(3)


@pytest.fixture(scope="session")
def torus() -> Shape:
    """A torus of radii 1 and 0.4 around the z axis: 1600 vertices, 3200 outward triangles."""
    n, m = 50, 32
    u, v = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.arange(m) * 2 * np.pi / m, indexing="ij")
    ring = 1 + 0.4 * np.cos(v)
    verts = np.stack([ring * np.cos(u), ring * np.sin(u), 0.4 * np.sin(v)], axis=-1).reshape(-1, 3)
    a = np.arange(n * m).reshape(n, m)
    b = np.roll(a, -1, axis=0)
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return Shape(verts, faces, "torus")


def some_fit(points: np.ndarray, faces: np.ndarray, **about: Any) -> Fit:
    """A made-up good fit with `points` as rest template, in the frame of its file; `about` replaces fields."""
    plain: dict[str, Any] = {"template_hash": "", "frame": Frame.identity(), "vectors": points, "resting": points}
    plain |= {"residual": 0.0, "verts": points, "verdict": "good", "reasons": ()}
    plain |= {"up": "+y", "front": "+z", "seconds": 0.0, "seed": 0}
    return Fit(points=points, faces=faces, **(plain | about))


def icosphere(splits: int) -> Shape:
    """Build a unit sphere of 20 * 4^splits outward triangles."""
    g = (1 + 5**0.5) / 2
    verts = np.array(
        [
            *[(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)],
            *[(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)],
        ],
        float,
    )
    faces = np.array(
        [
            *[(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2)],
            *[(10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5)],
            *[(2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)],
        ]
    )
    for _ in range(splits):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        ab, bc, ca = len(verts) + inverse.reshape(3, -1)
        a, b, c = faces.T
        verts = np.concatenate([verts, verts[unique].mean(axis=1)])
        faces = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    return Shape(verts / np.linalg.norm(verts, axis=1, keepdims=True), faces, f"sphere{splits}")


def vtp_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read the point data arrays of a .vtp file that this package wrote."""
    found = {}
    for each in ElementTree.parse(path).iterfind(".//PointData/DataArray"):
        kind = {"Float64": "f8", "Int64": "i8", "Int32": "i4"}[str(each.get("type"))]
        found[str(each.get("Name"))] = np.frombuffer(base64.b64decode(str(each.text))[8:], kind)
    return found
