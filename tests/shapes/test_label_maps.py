"""Label maps as shapes: where they lie, which labels they have, and what is refused. The positions of the formats were
checked against SimpleITK and nibabel.
"""

import bz2
import gzip
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.shapes.files import list_meshes, load_shape
from meshmatch.shapes.landmark_files import mesh_space
from meshmatch.shapes.shape import Shape

SIZES = 22, 18, 14
CENTER, RADIUS = np.array([9.0, 8.0, 7.0]), 5.0
SPACING = np.array([0.5, 0.75, 1.25])
AXES = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [-0.48, -0.64, -0.6]])  # left-handed, and no other way round
ORIGIN = np.array([10.0, -20.0, 30.0])
STEPS = AXES * SPACING[:, None]
INDEX = np.stack(np.meshgrid(*map(np.arange, SIZES), indexing="ij"), axis=-1)
BALL = np.linalg.norm(INDEX - CENTER, axis=-1) < RADIUS
LABELS = np.where(BALL, 3, 0)
LABELS[16:20, 3:8, 3:8] = 7


def voxels(kind: str = "u1", labels: np.ndarray = LABELS) -> bytes:
    """The first axis fastest."""
    return labels.astype(kind).tobytes("F")


def meta(kind: str = "MET_UCHAR", more: str = "", where: str = "LOCAL", sizes: tuple[int, ...] = SIZES) -> bytes:
    text = (
        f"ObjectType = Image\nNDims = {len(sizes)}\nTransformMatrix = {' '.join(map(str, AXES.ravel()))}\n"
        f"Offset = 10 -20 30\nElementSpacing = 0.5 0.75 1.25\n{more}DimSize = {' '.join(map(str, sizes))}\n"
        f"ElementType = {kind}\nElementDataFile = {where}\n"
    )
    return text.encode()


def nrrd(kind: str = "uint8", encoding: str = "raw", more: str = "", space: str = "left-posterior-superior") -> bytes:
    flip = -1 if space.startswith("right") else 1
    signs = np.array([flip, flip, 1])
    vectors = ["({})".format(",".join(map(str, row))) for row in (*(STEPS * signs), ORIGIN * signs)]
    text = (
        f"NRRD0005\n# made by hand\ntype: {kind}\ndimension: 3\nspace: {space}\nsizes: {' '.join(map(str, SIZES))}\n"
        f"space directions: {' '.join(vectors[:3])}\nspace origin: {vectors[3]}\nencoding: {encoding}\n{more}\n"
    )
    return text.encode()


def nifti(
    order: str = "<", code: int = 2, dims: tuple[int, ...] = (3, *SIZES), offset: float = 352.0, turn: bool = False
) -> bytes:
    """In RAS: x and y with the other sign. Axes as a matrix, or as spacings and a turn, the last of them backwards."""
    head = bytearray(352)
    head[:4] = struct.pack(f"{order}i", 348)
    head[40:56] = struct.pack(f"{order}8h", *dims, *[1] * (8 - len(dims)))
    head[70:72] = struct.pack(f"{order}h", code)
    head[108:112] = struct.pack(f"{order}f", offset)
    affine = np.column_stack([STEPS.T, ORIGIN]) * np.array([[-1.0], [-1.0], [1.0]])
    if turn:
        right = affine[:, :3] / SPACING * [1.0, 1.0, -1.0]
        x, y, z, w = Rotation.from_matrix(right).as_quat()
        head[76:108] = struct.pack(f"{order}8f", -1.0, *SPACING, *[0.0] * 4)
        head[252:256] = struct.pack(f"{order}2h", 1, 0)
        head[256:280] = struct.pack(f"{order}6f", *(np.array([x, y, z]) * np.sign(w)), *affine[:, 3])
    else:
        head[252:256] = struct.pack(f"{order}2h", 0, 1)
        head[280:328] = struct.pack(f"{order}12f", *affine.ravel())
    head[344:348] = b"n+1\0"
    return bytes(head)


FILES: dict[str, Callable[[], tuple[str, bytes]]] = {
    "mha": lambda: ("a.mha", meta() + voxels()),
    "mha, packed": lambda: ("a.mha", meta("MET_SHORT", "CompressedData = True\n") + zlib.compress(voxels("<i2"))),
    "mha, the other way": lambda: ("a.mha", meta("MET_USHORT", "BinaryDataByteOrderMSB = True\n") + voxels(">u2")),
    "mha, text": lambda: (
        "a.mha",
        meta(more="BinaryData = False\n") + " ".join(map(str, LABELS.ravel("F").tolist())).encode(),
    ),
    "nrrd": lambda: ("a.nrrd", nrrd() + voxels()),
    "nrrd, packed": lambda: ("a.nrrd", nrrd("unsigned short", "gzip", "endian: big\n") + gzip.compress(voxels(">u2"))),
    "nrrd, by bzip2": lambda: ("a.nrrd", nrrd("signed int", "bzip2") + bz2.compress(voxels("<i4"))),
    "nrrd, RAS": lambda: ("a.nrrd", nrrd(space="right-anterior-superior") + voxels()),
    "nii": lambda: ("a.nii", nifti() + voxels()),
    "nii, the other way": lambda: ("a.NII", nifti(">", 16) + voxels(">f4")),
    "nii by a turn": lambda: ("a.nii", nifti(turn=True) + voxels()),
    "nii.gz": lambda: ("a.nii.gz", gzip.compress(nifti(code=1024, dims=(4, *SIZES, 1)) + voxels("<i8"))),
    "nii.gz of members": lambda: ("a.nii.gz", gzip.compress(nifti()) + gzip.compress(voxels())),
}


def is_the_ball(shape: Shape) -> None:
    """Check that the vertices lie on the ball, and its faces look outwards."""
    index = np.linalg.solve(STEPS.T, (shape.verts - ORIGIN).T).T
    assert np.abs(np.linalg.norm(index - CENTER, axis=1) - RADIUS).max() < 0.6
    assert np.linalg.norm(index.mean(axis=0) - CENTER) < 0.05
    a, b, c = np.moveaxis(shape.verts[shape.faces] - shape.verts.mean(axis=0), 1, 0)
    volume = np.einsum("nd,nd->n", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(BALL.sum() * SPACING.prod(), rel=0.06)


@pytest.mark.parametrize("case", FILES)
def test_labels_lie_where_the_file_has_them(tmp_path: Path, case: str) -> None:
    name, content = FILES[case]()
    (tmp_path / name).write_bytes(content)
    with pytest.warns(MeshmatchWarning, match="holds 2 labels, and all are read: 3, 7; choose with --only"):
        both = load_shape(tmp_path / name)
    (first, count), second = list_meshes(tmp_path / name)
    assert (first, second[0], count + second[1]) == ("3", "7", both.V)
    is_the_ball(Shape(both.verts[:count], both.faces[(both.faces < count).all(axis=1)]))
    one = load_shape(tmp_path / name, only="3")
    assert one.weights is not None and one.weights.tolist() == [1.0] * count + [0.0] * second[1]
    assert mesh_space(tmp_path / name) == "LPS"
    with pytest.raises(InputError, match="no label of") as told:
        load_shape(tmp_path / name, only=1)  # no part
    assert told.value.hint == "there are: 3, 7"


@pytest.mark.parametrize(
    ("name", "header"), [("a.mhd", meta), ("a.nhdr", lambda where: nrrd(more=f"data file: {where}\n"))]
)
def test_voxels_in_a_file_beside_it(tmp_path: Path, name: str, header: Callable[..., bytes]) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / name).write_bytes(header(where="../a.raw"))
    (tmp_path / "a.raw").write_bytes(voxels())
    with pytest.raises(InputError, match=r"there is no file \.\./a\.raw in its folder"):
        load_shape(tmp_path / "in" / name)
    (tmp_path / name).write_bytes(header(where="a.raw"))
    assert [label for label, _ in list_meshes(tmp_path / name)] == ["3", "7"]


def test_segments_of_slicer_have_names(tmp_path: Path) -> None:
    """Also where they overlap: in layers."""
    about = "Segment0_Name:=Left femur\nSegment0_LabelValue:=1\nSegment0_Layer:=1\n"
    text = nrrd(more=about).decode().replace("dimension: 3", "dimension: 4").replace("sizes: ", "sizes: 2 ")
    text = text.replace("directions: ", "directions: none ")
    layers = np.stack([LABELS == 7, LABELS == 3])
    (tmp_path / "a.seg.nrrd").write_bytes(text.encode() + voxels(labels=layers))
    assert [label for label, _ in list_meshes(tmp_path / "a.seg.nrrd")] == ["1", "Left femur"]
    shape = load_shape(tmp_path / "a.seg.nrrd", only="left*")
    assert shape.weights is not None
    chosen = shape.weights[shape.faces].all(axis=1)
    first = int(np.argmax(shape.weights))
    is_the_ball(Shape(shape.verts[first:], shape.faces[chosen] - first))


def test_a_label_at_the_edge_is_open_and_told(tmp_path: Path) -> None:
    labels = np.zeros(SIZES, int)
    labels[:9, 5:12, 4:10] = 1
    (tmp_path / "a.mha").write_bytes(meta() + voxels(labels=labels))
    with pytest.warns(MeshmatchWarning, match="label 1 reaches the edge of the image, where the surface is left open"):
        shape = load_shape(tmp_path / "a.mha")
    assert shape.edges.counts[0] > 0
    closed = load_shape_of(tmp_path, BALL)
    assert closed.edges.counts == (0, 0)


def load_shape_of(folder: Path, labels: np.ndarray) -> Shape:
    (folder / "b.mha").write_bytes(meta() + voxels(labels=labels))
    return load_shape(folder / "b.mha")


GREY = np.random.default_rng(0).integers(0, 200, SIZES)
BAD: dict[str, tuple[str, bytes, str]] = {
    "grey values": (
        "a.mha",
        meta() + voxels(labels=GREY),
        "holds grey values, not labels: 200 different numbers, 0 to 199",
    ),
    "fractions": ("a.nii", nifti(code=16) + voxels("<f4", BALL * 0.5), "fractions or grey values"),
    "nan": ("a.nii", nifti(code=16) + voxels("<f4", BALL * np.nan), "fractions or grey values"),
    "negative": ("a.nii", nifti(code=4) + voxels("<i2", -LABELS), "labels from -7 to 0"),
    "no label": ("a.nrrd", nrrd() + voxels(labels=0 * LABELS), "holds no label: all its voxels are 0"),
    "all one label": ("a.nrrd", nrrd() + voxels(labels=0 * LABELS + 1), "no label of a.nrrd has a surface"),
    "cut short": ("a.nrrd", nrrd() + voxels()[:-1], "it has 5,543 bytes of voxels, not 5,544"),
    "packed, cut short": (
        "a.nrrd",
        nrrd(encoding="gzip") + gzip.compress(voxels())[:-40],
        "bytes of voxels, not 5,544",
    ),
    "not packed": ("a.nrrd", nrrd(encoding="gzip") + voxels(), "its header or its data cannot be read"),
    "hex": ("a.nrrd", nrrd(encoding="hex") + voxels(), "has the unsupported encoding hex"),
    "vectors": ("a.mha", meta(more="ElementNumberOfChannels = 3\n") + voxels(), "3 dimensions and 3 channels"),
    "a picture": ("a.mha", meta(sizes=(22, 18)) + voxels(), "has 2 dimensions"),
    "one slice": ("a.mha", meta(sizes=(22, 252, 1)) + voxels(), "22 x 252 x 1 voxels, which have no surface"),
    "no sizes": ("a.mha", meta().replace(b"DimSize", b"Size") + voxels(), "cannot be read"),
    "words for sizes": ("a.mha", meta().replace(b"22 18 14", b"a b c") + voxels(), "cannot be read"),
    "no size": ("a.mha", meta(sizes=(22, -18, 14)) + voxels(), "its sizes are 22 x -18 x 14"),
    "flat": ("a.mha", meta().replace(b"Spacing = 0.5", b"Spacing = 0.0") + voxels(), "do not span the space"),
    "not finite": ("a.mha", meta().replace(b"Offset = 10", b"Offset = nan") + voxels(), "do not span the space"),
    "complex": ("a.nii", nifti(code=32) + voxels(), "voxels of type 32"),
    "several volumes": ("a.nii", nifti(dims=(4, 22, 18, 7, 2)) + voxels(), "other than three dimensions"),
    "an offset": ("a.nii", nifti(offset=1e30) + voxels(), "which cannot be labels"),
    "NIfTI-2": ("a.nii", struct.pack("<i", 540) + bytes(600), "not a NIfTI-1 file"),
    "a list of files": ("a.mhd", meta(where="LIST"), "no file LIST in its folder"),
    "an archive": ("a.tar.gz", gzip.compress(b"nothing"), "unsupported file format .gz"),
    "too many layers": (
        "a.nrrd",
        nrrd()
        .replace(b"dimension: 3", b"dimension: 4")
        .replace(b"sizes: 22 18 14", b"sizes: 1001 2 2 2")
        .replace(b"directions: ", b"directions: none ")
        + bytes(8008),
        "has 1001 layers, of 1000 at most",
    ),
    "no header": ("a.nrrd", b"NRRD0004\n", "cannot be read"),
    "not at all": ("a.mha", b"solid\n", "it has no ElementDataFile"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_label_map_is_told_in_words(tmp_path: Path, case: str) -> None:
    name, content, words = BAD[case]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words) as told:
        load_shape(tmp_path / name)
    assert "\n" not in told.value.message


def test_labels_all_over_the_image_are_refused_before_hours_of_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("meshmatch.shapes.formats.label_surfaces._MAX_BOX_VOXELS", 3 * LABELS.size)
    corners = np.zeros(SIZES, int)
    for k in range(5):
        corners[2 * k : 2 * k + 2, 1:3, 1:3] = corners[-2 * k - 3 : -2 * k - 1, -3:-1, -3:-1] = k + 1
    with pytest.raises(InputError, match="the 5 labels are scattered over the whole image"):
        load_shape_of(tmp_path, corners)


HUGE = 2000, 2000, 2000
BOMBS = {
    "a.mha": lambda: meta(sizes=HUGE, more="CompressedData = True\n") + zlib.compress(bytes(50_000_000)),
    "b.mha": lambda: meta(sizes=(10**9, 10**9, 10**9)) + voxels(),
    "a.nii.gz": lambda: gzip.compress(nifti(dims=(3, *HUGE)) + bytes(50_000_000)),
    "b.nii.gz": lambda: gzip.compress(nifti() + voxels() + bytes(300_000_000)),  # more than it announces
}


@pytest.mark.parametrize("name", BOMBS)
def test_no_more_is_unpacked_than_what_is_announced(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(BOMBS[name]())
    tracemalloc.start()
    try:
        if name == "b.nii.gz":
            load_shape(tmp_path / name, only=3)
        else:
            with pytest.raises(InputError, match="promises too much"):
                load_shape(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 30_000_000
    finally:
        tracemalloc.stop()
