"""Bones whose truth is known: a place is the same on all, however they are triangulated, turned or mirrored."""

from pathlib import Path

import numpy as np

from meshmatch.experiments.makers.bones import BUMP, HIGH, draw_bones, main, scan
from meshmatch.shapes.files import load_shape


def test_places_lie_on_every_scan_and_triangles_face_out(tmp_path: Path) -> None:
    bones = draw_bones(4, 1)
    assert [bone.side for bone in bones] == ["right", "right", "left", "right"]
    for number, bone in enumerate(bones):
        found = scan(bone, 500, number)
        assert np.allclose(found.places(found.directions), found.shape.verts)
        assert found.frame.mirrored == (bone.side == "left")
        a, b, c = (found.shape.verts[corner] for corner in found.shape.faces.T)
        assert np.einsum("fi,fi->", a, np.cross(b, c)) - found.shape.verts.mean(0) @ np.cross(b - a, c - a).sum(0) > 0
        assert not found.shape.edges.open.any()


def test_groups_differ_in_a_bump_alone() -> None:
    bone = draw_bones(1)[0]
    at = np.array([BUMP, (-0.8, 0.1, 0.6)]) / np.linalg.norm(BUMP)
    plain = type(bone)(**{**vars(bone), "group": "plain"})
    moved = np.linalg.norm(bone.points(at) - plain.points(at), axis=1) / bone.size
    assert abs(moved[0] - HIGH * np.linalg.norm(BUMP)) < 1e-9 and moved[1] < 1e-6


def test_the_command_writes_scans_landmarks_and_a_table(tmp_path: Path) -> None:
    assert main([str(tmp_path / "bones"), "--count", "3", "--vertices", "200"]) == 0
    files = {path.relative_to(tmp_path / "bones").as_posix() for path in (tmp_path / "bones").rglob("*.*")}
    names = [f"bone-{k:02d}" for k in (1, 2, 3)]
    assert files == {"table.csv", *(f"scans/{n}.ply" for n in names), *(f"landmarks/{n}.csv" for n in names)}
    assert load_shape(tmp_path / "bones" / "scans" / "bone-01.ply").V in range(140, 261)
