"""Frames smoothed in time: paths are nearer to the true ones and as smooth, and stay on their surfaces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.collections.export import Export, Fits, export
from meshmatch.collections.motion import area_strain, smooth_frames
from meshmatch.collections.sources import frame_times, sort_by_sequence
from meshmatch.errors import MeshmatchWarning, OptionError
from meshmatch.geometry.frames import Frame
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf import Document
from tests.conftest import icosphere, some_fit

BALL = icosphere(3)
FRAMES = 16


def pulsing(noise: float = 0.0, count: int = FRAMES) -> np.ndarray:
    """A ball that swells by a half and sways in one cycle, its vertices slid along it at random (T, V, 3)."""
    rng = np.random.default_rng(4)
    found = []
    for phase in 2 * np.pi * np.arange(count) / FRAMES:
        slid = BALL.verts + noise * rng.standard_normal(BALL.verts.shape)
        slid /= np.linalg.norm(slid, axis=1, keepdims=True)
        found.append((1.25 - 0.25 * np.cos(phase)) * slid + [np.sin(phase), 0, 0])
    return np.array(found)


def rough(paths: np.ndarray) -> float:
    return float(np.linalg.norm(paths[2:] - 2 * paths[1:-1] + paths[:-2], axis=2).mean())


@pytest.mark.parametrize("cycle", [False, True])
def test_paths_are_as_smooth_as_the_true_ones_and_nearer_to_them(cycle: bool) -> None:
    true, points = pulsing(), pulsing(0.05)
    found = np.array(list(smooth_frames(points, BALL.faces, range(FRAMES), cycle)))
    before, after = (np.linalg.norm(some - true, axis=2).mean() for some in (points, found))
    assert after < 0.7 * before
    assert rough(points) > 1.8 * rough(true) and rough(found) < 1.3 * rough(true)
    middle = np.array([np.sin(2 * np.pi * np.arange(FRAMES) / FRAMES), *2 * [np.zeros(FRAMES)]]).T
    radius = 1.25 - 0.25 * np.cos(2 * np.pi * np.arange(FRAMES) / FRAMES)
    assert np.allclose(np.linalg.norm(found - middle[:, None], axis=2), radius[:, None], rtol=0.02)  # on the surfaces


def test_a_first_frame_is_smoothed_as_well() -> None:
    """It has neighbours on one side alone, and a component of its own if it slid further than they."""
    true, points = pulsing(), pulsing(0.05)
    points[0] = pulsing(0.15)[0]
    found = np.array(list(smooth_frames(points, BALL.faces, range(FRAMES))))
    before, after = (np.linalg.norm((some - true)[0], axis=1).mean() for some in (points, found))
    assert after < 0.6 * before


def test_a_short_motion_is_no_noise() -> None:
    """A ball that jerks to the side and back within three frames, and slides at random."""
    aside = np.exp(-(((np.arange(FRAMES) - 8) / 1.5) ** 2))[:, None, None] * [1.0, 0, 0]
    rng = np.random.default_rng(4)
    slid = BALL.verts + 0.05 * rng.standard_normal((FRAMES, *BALL.verts.shape))
    points, true = slid / np.linalg.norm(slid, axis=2, keepdims=True) + aside, BALL.verts + aside
    found = np.array(list(smooth_frames(points, BALL.faces, range(FRAMES))))
    before, after = (np.linalg.norm(some - true, axis=2).mean() for some in (points, found))
    assert after < 0.6 * before and rough(found) < 1.3 * rough(true)


def test_what_is_smooth_stays_as_it_is() -> None:
    true = pulsing()
    assert np.abs(np.array(list(smooth_frames(true, BALL.faces, range(FRAMES), True))) - true).max() < 0.02


def test_a_missing_frame_is_a_gap_in_time() -> None:
    true, points = pulsing(), pulsing(0.05)
    kept = [k for k in range(FRAMES) if k not in (5, 6)]
    found = np.array(list(smooth_frames(points[kept], BALL.faces, kept, True)))
    as_if_none = np.array(list(smooth_frames(points[kept], BALL.faces, range(len(kept)), True)))
    off = [np.linalg.norm(some - true[kept], axis=2)[3:7].mean() for some in (found, as_if_none)]
    assert off[0] < off[1]


def test_a_cycle_has_its_last_frames_even_where_they_are_missing(tmp_path: Path) -> None:
    """Three of sixteen fits are poor; without them the first frame does not follow at once."""
    points, names = pulsing(0.05), [f"frame{k}" for k in range(FRAMES)]
    part = fits_of(points[:13], names[:13])
    export(tmp_path / "cycle", replace(part, times=frame_times(names)), Export(".npz", cycle=True), None)
    found = np.load(tmp_path / "cycle" / "coords.npz")["points"]
    known = np.array(list(smooth_frames(points[:13], BALL.faces, range(13), True, FRAMES)))
    shorter = np.array(list(smooth_frames(points[:13], BALL.faces, range(13), True)))
    assert np.allclose(found, known)
    ends = [0, 12]
    off = [np.linalg.norm(some[ends] - pulsing()[ends], axis=2).mean() for some in (found, shorter)]
    assert off[0] < off[1]


def test_frames_of_a_subfolder_do_not_split_those_of_its_folder() -> None:
    names = ["a1", "z1", "m/10", "m/9", "a10", "a2"]
    assert sort_by_sequence(names) == ["a1", "a2", "a10", "z1", "m/9", "m/10"]
    assert sort_by_sequence(["f1/2", "f01/1", "f1/1", "f01/2"]) == ["f01/1", "f01/2", "f1/1", "f1/2"]
    assert list(frame_times({"x1", "x01"})) == ["x01", "x1"]


@pytest.mark.parametrize("times", [range(1), range(4), [*range(7), 5000]])
def test_too_few_or_too_many_are_refused(times: list[int]) -> None:
    with pytest.raises(OptionError, match="cannot be smoothed"):
        next(smooth_frames(pulsing()[: len(times)], BALL.faces, times))


def test_strain_is_how_much_the_surface_grew() -> None:
    assert np.allclose(area_strain(1.5 * BALL.verts, BALL.verts, BALL.faces), 1.25)
    flat = BALL.verts.copy()
    flat[BALL.faces[0]] = 0
    lone = np.flatnonzero(np.isnan(area_strain(BALL.verts, 0 * flat, BALL.faces)))
    assert len(lone) == BALL.V  # there was none


def test_frames_have_their_places_in_each_folder() -> None:
    names = ["b/frame10", "a/frame2", "b/frame9", "a/frame10", "a/frame1"]
    assert frame_times(names) == {"a/frame1": 0, "a/frame2": 1, "a/frame10": 2, "b/frame9": 0, "b/frame10": 1}


def fits_of(points: np.ndarray, names: list[str]) -> Fits:
    """Fits of frames, each in its own core frame and all in the coordinates of one file."""
    frame = Frame(2.0, np.eye(3)[[1, 2, 0]], np.array([1.0, 2, 3]))
    made = dict(zip(names, (some_fit(frame.apply(each), BALL.faces, frame=frame) for each in points), strict=True))
    template = type("T", (), {"shape": BALL, "label_names": ()})
    return Fits(names, made.__getitem__, lambda name: None, {}, template, True, frame_times(names))  # type: ignore


def test_frames_are_exported_with_their_motion(tmp_path: Path) -> None:
    points = pulsing(0.05)
    two = np.concatenate([points[:8], points[8:]])
    names = [*(f"a/frame{k}" for k in range(8)), *(f"b/frame{k}" for k in range(8))]
    fits = fits_of(two, names)
    export(tmp_path / "plain", fits, Export(".npz"), None)
    files = export(tmp_path / "smooth", fits, Export(".npz", smooth=True), None)
    assert files == ["coords.npz", "metadata.csv"]
    plain, smooth = (np.load(tmp_path / name / "coords.npz") for name in ("plain", "smooth"))
    assert np.allclose(plain["points"], two) and rough(smooth["points"][:8]) < 0.8 * rough(two[:8])
    assert list(plain["names"]) == names
    for found in (plain, smooth):
        assert np.allclose(found["displacement"][:8], found["points"][:8] - found["points"][0])
        assert np.allclose(found["displacement"][8:], found["points"][8:] - found["points"][8])  # of its own sequence
        assert np.allclose(found["area_strain"][11], area_strain(found["points"][11], found["points"][8], BALL.faces))
    files = export(tmp_path / "vtp", fits, Export(".vtp", cycle=True), None)
    assert files[-2:] == ["a/sequence.pvd", "b/sequence.pvd"]
    text = (tmp_path / "vtp" / "a" / "frame3.vtp").read_text()
    assert 'Name="displacement"' in text and 'Name="area_strain"' in text
    assert load_shape(tmp_path / "vtp" / "b" / "frame3.vtp").V == BALL.V


@pytest.mark.parametrize("cycle", [False, True])
def test_frames_are_exported_as_one_mesh_that_moves(tmp_path: Path, cycle: bool) -> None:
    names = [*(f"a/frame{k}" for k in range(6)), *(f"b/frame{k}" for k in range(5))]
    points = pulsing()[: len(names)]
    files = export(tmp_path / "out", fits_of(points, names), Export(".glb", cycle=cycle), None)
    assert files[-2:] == ["a/sequence.glb", "b/sequence.glb"]
    data = (tmp_path / "out" / "a" / "sequence.glb").read_bytes()
    document = Document(tmp_path, data)
    (clip,) = document.json["animations"]
    assert clip["channels"] == [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]
    times, weights = (document.accessor(clip["samplers"][0][each]) for each in ("input", "output"))
    keys = 6 + cycle
    np.testing.assert_allclose(times.ravel(), np.arange(keys) / 24, rtol=1e-6)
    frames = [load_shape(tmp_path / "out" / "a" / f"frame{k}.glb").verts for k in range(6)]
    moves = np.array(
        [document.accessor(each["POSITION"]) for each in document.json["meshes"][0]["primitives"][0]["targets"]]
    )
    shown = frames[0] + np.einsum("tm,mvd->tvd", weights.reshape(keys, 5), moves)
    np.testing.assert_allclose(shown, [*frames, frames[0]][:keys], atol=1e-5)


def test_a_long_sequence_and_a_single_frame_do_not_move(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["a/sequence", "a/x", "b"]
    fits = fits_of(pulsing()[:3], names)
    assert export(tmp_path / "short", fits, Export(".glb"), None) == [
        *(f"{name}.glb" for name in names),
        "a/sequence-.glb",
    ]
    monkeypatch.setattr("meshmatch.collections.export._MAX_CLIP_VERTS", 2 * BALL.V - 1)
    with pytest.warns(MeshmatchWarning, match="a is too large"):
        assert len(export(tmp_path / "long", fits, Export(".glb"), None)) == 3


def test_only_registered_meshes_in_their_files_places_are_smoothed() -> None:
    for wrong in ({"place": "template", "smooth": True}, {"original": True, "cycle": True}):
        with pytest.raises(OptionError, match="smoothed as registered meshes"):
            Export(**wrong)
