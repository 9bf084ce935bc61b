"""Clips of one skeleton for the same on another shape."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.shapes.formats.gltf_rig import Clip, Rig, Track
from meshmatch.transfer.retarget_clips import _sample_track, retargeted, standing_clips

TURNS = Rotation.from_rotvec(np.radians([[0, 0, 0], [0, 0, 170], [0, 0, 190], [0, 0, 350.0]])).as_quat() * [
    [1],
    [1],
    [-1],
    [1],
]
TIMES = np.arange(4.0)


def skeleton(*tracks: Track) -> Rig:
    """A hip, one unit above a root."""
    return Rig(
        ("root", "hip"),
        np.array([-1, 0]),
        np.array([1]),
        np.tile([0.0, 0, 0, 1], (2, 1)),
        np.array([[0.0, 0, 0], [0, 1, 0]]),
        np.ones((2, 3)),
        (Clip("jump", tracks),),
    )


def test_movements_are_scaled_from_where_the_joint_is() -> None:
    """Rotations stay; of a spline, slopes are scaled and values moved; scales are those of the source's own."""
    plain = np.array([[0.0, 1, 0], [0, 2, 0], [0, 1, 1], [0, 1, 0]])
    slopes = np.full((4, 3), 0.5)
    tracks = (
        Track(1, "translation", TIMES, plain, "LINEAR"),
        Track(1, "translation", TIMES, np.stack([slopes, plain, slopes], 1).reshape(-1, 3), "CUBICSPLINE"),
        Track(1, "rotation", TIMES, TURNS, "LINEAR"),
        Track(1, "scale", TIMES, np.full((4, 3), 3.0), "STEP"),
    )
    rig = replace(skeleton(), scales=np.array([[1.0, 1, 1], [2, 2, 2]]))
    posed = replace(rig, translations=np.array([[0.0, 0, 0], [0, 2.5, 0.5]]))
    moved = np.array([[0, 2.5, 0.5], [0, 4.5, 0.5], [0, 2.5, 2.5], [0, 2.5, 0.5]])
    for track, expected in zip(tracks, (moved, moved, TURNS, np.full((4, 3), 1.5)), strict=True):
        (found,) = retargeted(Clip("jump", (track,)), rig, posed, np.array([2.0, 2.0]), {}).tracks
        values = found.values
        if track.interpolation == "CUBICSPLINE":
            assert np.allclose(values[0::3], 1.0) and np.allclose(values[2::3], 1.0)
            values = values[1::3]
        assert np.allclose(values, expected)
        assert found.interpolation == track.interpolation


def test_what_a_clip_leaves_alone_is_held() -> None:
    posed = skeleton(Track(1, "translation", TIMES, np.zeros((4, 3)), "LINEAR"))
    turned = Rotation.from_euler("x", 30, degrees=True).as_quat()
    bind = replace(posed, rotations=np.stack([posed.rotations[0], turned]), translations=posed.translations + 1)
    (clip,) = standing_clips(bind, posed)
    held = {(track.node, track.moves): track.values.tolist() for track in clip.tracks[1:]}
    assert held == {(1, "rotation"): [[0, 0, 0, 1]], (0, "translation"): [[0, 0, 0]]}
    assert standing_clips(posed, posed)[0].tracks == posed.clips[0].tracks


def test_turns_go_the_shorter_way_round() -> None:
    """q and -q are one rotation."""
    track = Track(1, "rotation", TIMES, TURNS, "LINEAR")
    found = Rotation.from_quat(_sample_track(track, TURNS[0], np.array([0.0, 1.5, 3.0, 9.0])))
    angles = found.as_euler("xyz", degrees=True)[:, 2] % 360
    assert np.allclose(angles, [0, 180, 350, 350])
    stepped = _sample_track(replace(track, interpolation="STEP"), TURNS[0], np.array([-1.0, 0.9, 1.0]))
    assert np.allclose(stepped, TURNS[[0, 0, 1]])
