"""Bones whose truth is known: a place is the same on all, however they are triangulated, turned or mirrored."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from meshmatch.collections.atlas import Atlas
from meshmatch.experiments.makers.bones import BUMP, HIGH, Bone, bump_at, draw_bones, main, scan
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


def in_correspondence(bones: list[Bone], vertices: int) -> tuple[Atlas, np.ndarray, dict[str, list[str]]]:
    """An atlas of the bones' true places, their directions, and what is known of the bones."""
    given = scan(bones[0], vertices)
    atlas = Atlas.of(np.stack([bone.points(given.directions) for bone in bones]), given.shape.faces)
    return atlas, given.directions, {key: [getattr(bone, key) for bone in bones] for key in ("sex", "group")}


def test_a_bump_of_three_millimetres_is_found_where_it_is_and_nowhere_else() -> None:
    atlas, directions, known = in_correspondence(draw_bones(20), 900)
    found = atlas.anova("form ~ log(size) + sex + group", known, permutations=999).table.effects[2]
    places, bump = found.places, bump_at(directions, BUMP, 40.0)[:, 0]
    assert places is not None
    hit = places.p_corrected <= 0.05
    assert found.p_anywhere == 1 / 1000 and found.coefficients == ("group: plain - bump",)
    assert hit[bump > 0.6].all() and not hit[bump < 0.05].any()
    assert (places.p_fdr <= 0.05)[bump < 0.05].mean() < 0.05
    assert bump[found.along_normal[0].argmin()] > 0.8
    assert -HIGH < found.along_normal[0].min() < -0.7 * HIGH  # laying the bones over one another spreads it


def test_of_200_splits_at_random_one_in_twenty_differs() -> None:
    """In the shape as a whole, and anywhere on the surface: places of a bone vary together, not each by itself."""
    atlas = in_correspondence([replace(bone, group="plain") for bone in draw_bones(20)], 200)[0]
    random, found = np.random.default_rng(3), []
    for seed in range(200):
        names = random.permutation(atlas.names).tolist()
        about = atlas.compare(names[:10], names[10:], permutations=99, seed=seed)
        found.append([about.p_overall, about.p_corrected.min()])
    hits = (np.array(found) <= 0.05).sum(axis=0)
    assert (hits >= 2).all() and (hits <= 20).all()


def test_the_command_writes_scans_landmarks_and_a_table(tmp_path: Path) -> None:
    assert main([str(tmp_path / "bones"), "--count", "3", "--vertices", "200"]) == 0
    files = {path.relative_to(tmp_path / "bones").as_posix() for path in (tmp_path / "bones").rglob("*.*")}
    names = [f"bone-{k:02d}" for k in (1, 2, 3)]
    assert files == {"table.csv", *(f"scans/{n}.ply" for n in names), *(f"landmarks/{n}.csv" for n in names)}
    assert load_shape(tmp_path / "bones" / "scans" / "bone-01.ply").V in range(140, 261)
