"""Textured meshes written, and read by another program."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from meshmatch.errors import OptionError, OutputError
from meshmatch.geometry.triangles import closest_on_triangles, normalized, same_rows
from meshmatch.shapes import dressed_files
from meshmatch.shapes.appearance import png_bytes
from meshmatch.shapes.colors import BYTE_TO_LINEAR
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.formats.seams import split_at_seams
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance, load_coordinates, output_files
from meshmatch.transfer.texels import Pyramid
from tests.shapes.painted import CORNERS, FACES, UV, quarters


@pytest.fixture
def ball(sphere: Shape) -> tuple[TexturedMesh, np.ndarray]:
    """A sphere with coordinates of its own for every triangle, and a picture of noise."""
    rng = np.random.default_rng(0)
    uv = rng.random((sphere.F, 3, 2)).astype(np.float32).astype(float)
    uv[:200] = sphere.verts[sphere.faces[:200]][:, :, :2] / 2 + 0.5  # and some without seams
    image = rng.integers(0, 256, (16, 16, 4), dtype=np.uint8)
    return TexturedMesh(sphere.verts, sphere.faces, uv, "blend"), image


def test_vertices_are_split_at_seams_alone() -> None:
    uv = UV[FACES].copy()
    same = split_at_seams(len(CORNERS), FACES, uv)
    np.testing.assert_array_equal(same[0], np.arange(len(CORNERS)))
    np.testing.assert_array_equal(same[1], UV)
    np.testing.assert_array_equal(same[2], FACES)
    uv[1, 0] = (0.5, 0.5)  # corner 0 now lies on two places
    vertex, places, faces = split_at_seams(len(CORNERS), FACES, uv)
    np.testing.assert_array_equal(vertex, [*range(len(CORNERS)), 0])
    assert sorted(places[[0, 4]].tolist()) == [[0.0, 1.0], [0.5, 0.5]]
    np.testing.assert_array_equal(places[faces], uv)


def test_split_vertices_keep_their_order_and_their_places(ball: tuple[TexturedMesh, np.ndarray]) -> None:
    mesh, _ = ball
    vertex, uv, faces = split_at_seams(len(mesh.verts), mesh.faces, mesh.uv)
    V = len(mesh.verts)
    np.testing.assert_array_equal(vertex[:V], np.arange(V))
    verts = mesh.verts[vertex]
    np.testing.assert_array_equal(verts[faces], mesh.verts[mesh.faces])
    np.testing.assert_allclose(uv[faces], mesh.uv, atol=1e-7)
    assert len(verts) == len(np.unique(np.concatenate([verts, uv], axis=1), axis=0))


def test_vertices_without_a_face_stay() -> None:
    vertex, uv, _ = split_at_seams(5, FACES, UV[FACES])
    assert vertex[4] == 4 and uv[4].tolist() == [0, 0]


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_written_and_read_again(tmp_path: Path, ball: tuple[TexturedMesh, np.ndarray], suffix: str) -> None:
    mesh, image = ball
    path = tmp_path / f"my ball{suffix}"
    save_textured(path, mesh, image)
    shape = load_shape(path)
    V = len(mesh.verts)
    np.testing.assert_allclose(shape.verts[:V], mesh.verts, atol=1e-6)
    if suffix == ".obj":
        np.testing.assert_array_equal(shape.verts, mesh.verts)
        np.testing.assert_array_equal(shape.faces, mesh.faces)
    look = load_appearance(path, shape)
    np.testing.assert_allclose(look.uv, mesh.uv, atol=1e-6)
    own = load_coordinates(path, shape)
    assert own is not None
    np.testing.assert_array_equal(own, look.uv)
    np.testing.assert_array_equal(look.materials[0].image, image)
    assert look.materials[0].alpha == "blend"
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(file.name for file in output_files(path))


@pytest.mark.parametrize("alpha", ["opaque", "mask", "blend"])
def test_the_meaning_of_alpha_is_written(tmp_path: Path, alpha: str) -> None:
    mesh = TexturedMesh(CORNERS, FACES, UV[FACES] + 3.0, alpha, 0.25)  # type: ignore[arg-type]
    save_textured(tmp_path / "a.glb", mesh, quarters())
    found = load_appearance(tmp_path / "a.glb", load_shape(tmp_path / "a.glb")).materials[0]
    assert found.alpha == alpha and found.wrap == ("repeat", "repeat")
    assert found.cutoff == (0.25 if alpha == "mask" else 0.5)
    assert found.factor == (1, 1, 1, 1)
    save_textured(tmp_path / "a.obj", mesh, quarters())
    assert ("map_d a.png" in (tmp_path / "a.mtl").read_text()) == (alpha != "opaque")


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_trimesh_sees_the_same_colors(tmp_path: Path, ball: tuple[TexturedMesh, np.ndarray], suffix: str) -> None:
    """The second implementation: its own reader, its own weights, its own look-up of the picture."""
    mesh, image = ball
    image[..., 3] = 255
    path = tmp_path / f"ball{suffix}"
    save_textured(path, TexturedMesh(mesh.verts, mesh.faces, mesh.uv), image)
    (other,) = trimesh.load_scene(path, process=False).geometry.values()
    material = other.visual.material
    picture = material.baseColorTexture if suffix == ".glb" else material.image
    np.testing.assert_array_equal(np.asarray(picture.convert("RGBA")), image)
    assert len(other.faces) == len(mesh.faces)

    points, face = trimesh.sample.sample_surface(other, 500, seed=1)
    weights = trimesh.triangles.points_to_barycentric(other.triangles[face], points)
    uv = np.einsum("nk,nkd->nd", weights, other.visual.uv[other.faces[face]])
    theirs = trimesh.visual.color.uv_to_interpolated_color(uv, picture)

    # it may reorder faces: ours is the one with the same middle
    middles = mesh.verts[mesh.faces].mean(axis=1)
    own = cKDTree(middles).query(other.triangles_center[face])[1]
    corners = mesh.verts[mesh.faces[own]]
    weights = closest_on_triangles(points, corners[:, 0], corners[:, 1], corners[:, 2])
    ours = np.einsum("nk,nkd->nd", weights, mesh.uv[own])
    np.testing.assert_allclose(ours, uv * (1, -1) + (0, 1), atol=1e-4)
    look = load_appearance(path, load_shape(path))
    pyramid = Pyramid(look.materials[0])
    # it mixes bytes where we mix light: compare at the centers of texels, where there is nothing to mix
    middle = (np.floor(ours * 16) + 0.5) / 16
    light = pyramid.sample(*middle.T.astype(np.float32), np.zeros(500, np.float32))
    column, row = np.floor(ours * 16).astype(int).clip(0, 15).T
    np.testing.assert_allclose(light[:3].T, BYTE_TO_LINEAR[image[row, column, :3]], atol=1e-4)
    # its texels lie at whole multiples of 1 / 15, so ours are asked there
    nearest = np.round(np.stack([uv[:, 0] * 15, 15 - uv[:, 1] * 15], 1)).astype(int)
    at = np.stack([nearest[:, 0] / 15, 1 - nearest[:, 1] / 15], 1)
    exact = trimesh.visual.color.uv_to_interpolated_color(at, picture)
    np.testing.assert_array_equal(exact[:, :3], image[nearest[:, 1], nearest[:, 0], :3])
    assert theirs.shape == (500, 4)


def test_a_picture_without_holes_has_no_alpha_channel() -> None:
    assert png_bytes(quarters())[25] == 2  # PNG's color type: red, green, blue
    holes = quarters().copy()
    holes[0, 0, 3] = 0
    assert png_bytes(holes)[25] == 6


def test_all_files_appear_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mtl").write_text("mine")
    mesh = TexturedMesh(CORNERS, FACES, UV[FACES])

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(dressed_files.obj, "write_materials", full)
        with pytest.raises(OutputError):
            save_textured(tmp_path / "a.obj", mesh, quarters())
    assert [file.name for file in tmp_path.iterdir()] == ["a.mtl"]
    assert (tmp_path / "a.mtl").read_text() == "mine"
    save_textured(tmp_path / "a.obj", mesh, quarters())
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.mtl", "a.obj", "a.png"]


def test_places_that_cannot_be_claimed(tmp_path: Path) -> None:
    (tmp_path / "a.png").mkdir()
    mesh = TexturedMesh(CORNERS, FACES, UV[FACES])
    with pytest.raises(OutputError, match=r"a\.png"):
        save_textured(tmp_path / "a.obj", mesh, quarters())
    with pytest.raises(OptionError, match="cannot write a texture"):
        save_textured(tmp_path / "a.stl", mesh, quarters())
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_the_sample_opens() -> None:
    from meshmatch.templates.location import bundled_folder

    path = bundled_folder() / "samples" / "dancer-textured.glb"
    assert path.stat().st_size < 600_000
    shape = load_shape(path)
    look = load_appearance(path, shape)
    bare = load_shape(bundled_folder() / "samples" / "dancer.ply")
    np.testing.assert_allclose(shape.verts[: bare.V], bare.verts, atol=1e-4)
    assert shape.F == bare.F
    image = look.materials[0].image
    assert image is not None and image.shape == (1024, 1024, 4)
    assert look.uv.min() >= 0 and look.uv.max() <= 1


def stored_normals(path: Path) -> np.ndarray:
    """The normals that a glb holds, as trimesh reads them; computed ones would not be among the cached."""
    mesh = next(iter(trimesh.load_scene(path, process=False).geometry.values()))
    assert "vertex_normals" in mesh._cache.cache
    return np.asarray(mesh.vertex_normals)


def test_a_glb_has_unit_normals_that_seams_share(tmp_path: Path, ball: tuple[TexturedMesh, np.ndarray]) -> None:
    mesh, image = ball
    save_textured(tmp_path / "a.glb", mesh, image)
    shape = load_shape(tmp_path / "a.glb")
    assert shape.V > len(mesh.verts)
    normals = stored_normals(tmp_path / "a.glb")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(normals, shape.verts, atol=0.02)  # of a unit sphere; copies of a vertex agree
    first = same_rows(shape.verts)
    np.testing.assert_array_equal(normals, normals[first])


def test_normals_of_a_plain_glb_keep_sharp_edges(tmp_path: Path, cube: Shape) -> None:
    """Corners that the file has apart stay sharp; a loose vertex gets a normal all the same."""
    corners = cube.verts[cube.faces].reshape(-1, 3)
    shape = Shape(np.concatenate([corners, [[9, 9, 9]]]), np.arange(len(corners)).reshape(-1, 3))
    save_shape(tmp_path / "a.glb", shape)
    normals = stored_normals(tmp_path / "a.glb")
    np.testing.assert_allclose(normals[:-1], np.repeat(normalized(shape.face_vectors), 3, axis=0), atol=1e-6)
    assert normals[-1].tolist() == [0, 0, 1]
