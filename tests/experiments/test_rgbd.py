"""The simulated Kinect, what is measured, and the command from end to end on few pixels."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.paper import rgbd
from meshmatch.experiments.paper.rgbd import Body, Camera, Cloud, save_pcd, scan
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere

SMALL = Camera(width=80, height=60, focal=72.5, patches=0.0, missing=0.0, flying=0.0, stray=0.0, color_noise=0.0)
EXACT = replace(SMALL, noise=0.0, turn_error=0.0, place_error=0.0, focal_of_disparity=1e7)


def ball(radius: float = 0.8) -> Body:
    shape = icosphere(3)
    return Body(radius * shape.verts + [0.3, 1.0, -0.2], np.array(shape.faces), 0.5 + 0.5 * shape.verts)


def test_an_exact_camera_sees_the_surface_that_faces_it() -> None:
    body = ball()
    cloud = scan(body, 1, 3, EXACT)
    assert 300 < cloud.shape.V < 80 * 60 and cloud.shape.is_cloud
    np.testing.assert_allclose(cloud.shape.verts, cloud.on(body.faces, body.verts), atol=1e-4)
    np.testing.assert_allclose(cloud.shape.colors[:, :3], cloud.on(body.faces, body.colors), atol=1e-6)
    assert (cloud.shape.verts[:, 2] > -0.2).mean() > 0.9  # its front
    around = scan(body, 4, 3, EXACT)
    assert 3.9 < around.shape.V / cloud.shape.V < 4.1
    assert (around.shape.verts[:, 2] < -0.2).mean() > 0.4


def test_noise_and_steps_of_depth_grow_with_its_square() -> None:
    body = ball(0.3)
    apart = {}
    for distance in (1.5, 3.0):
        cloud = scan(
            body, 1, 0, replace(SMALL, distance=distance, width=160, height=120, turn_error=0.0, place_error=0.0)
        )
        apart[distance] = np.linalg.norm(cloud.shape.verts - cloud.on(body.faces, body.verts), axis=1)
    # half a count of noise and the rounding: sqrt(1/4 + 1/12) counts
    expected = np.sqrt(1 / 4 + 1 / 12) * 2.6**2 / (8 * 580 * 0.075)
    assert np.sqrt(np.square(apart[3.0]).mean()) == pytest.approx(expected * (2.8 / 2.6) ** 2, rel=0.12)
    assert apart[3.0].mean() / apart[1.5].mean() == pytest.approx((2.8 / 1.3) ** 2, rel=0.15)


def test_pixels_fly_from_silhouettes_and_strays_belong_to_nothing() -> None:
    body = ball()
    clean, rough = (
        scan(body, 1, 0, SMALL),
        scan(body, 1, 0, replace(SMALL, flying=1.0, stray=0.1, missing=0.2, patches=3.0)),
    )
    assert (clean.face >= 0).all()
    lost = rough.face < 0
    assert 0.1 < lost.mean() < 0.3
    away = np.abs(np.linalg.norm(rough.shape.verts - [0.3, 1.0, -0.2], axis=1) - 0.8)
    assert np.median(away[lost]) > 3 * np.median(away[~lost])
    assert (~lost).sum() < 0.8 * clean.shape.V
    again = scan(body, 1, 0, SMALL)
    np.testing.assert_array_equal(again.shape.verts, clean.shape.verts)


def test_a_pcd_is_read_with_its_colours(tmp_path: Path) -> None:
    cloud = scan(ball(), 1, 0, SMALL).shape
    save_pcd(tmp_path / "a.pcd", cloud)
    save_shape(tmp_path / "a.ply", cloud)
    read, other = load_shape(tmp_path / "a.pcd"), load_shape(tmp_path / "a.ply")
    np.testing.assert_allclose(read.verts, cloud.verts, atol=1e-6)
    np.testing.assert_array_equal(read.colors, other.colors)


def known_case(folder: Path = Path()) -> rgbd.Case:
    """A ball, and another three times as large that its points belong to; the last target point is of no body."""
    body, shape = ball(), icosphere(3)
    chosen = np.arange(0, shape.F, 3)
    weights = np.tile([1.0, 0.0, 0.0], (len(chosen), 1))
    at = shape.faces[chosen, 0]
    rgba = np.column_stack([body.colors, np.ones(shape.V)])
    source = Cloud(Shape(body.verts[at], [], "s", rgba[at]), chosen, weights)
    face = chosen.copy()
    face[-1] = -1
    target = Cloud(Shape(3 * shape.verts[at], [], "t", rgba[at]), face, weights)
    return rgbd.Case("0-same-1", source, target, body, folder / "s.pcd", folder / "t.ply")


def test_errors_by_hand() -> None:
    case = known_case()
    carried = rgbd.by_truth(case)
    found = rgbd.measure(case, carried)
    assert found["mean_cm"] == pytest.approx(0, abs=1e-9) and found["color"] == pytest.approx(0, abs=1e-9)
    assert (found["lost"], found["shown"]) == (0.0, 1.0)
    colors, index = carried[0].copy(), carried[1].copy()
    colors[0] += 0.1
    index[0] = int(np.argmax(np.linalg.norm(case.source.shape.verts - case.right[0], axis=1)))
    count = len(index) - 1
    found = rgbd.measure(case, (colors, index))
    assert found["color"] == pytest.approx(25.5 / np.sqrt(count))
    assert 155 / count < found["mean_cm"] <= 160 / count and found["lost"] == pytest.approx(1 / count)


def test_the_command_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = [ball(), ball(0.6), ball(1.0)]
    monkeypatch.setattr(rgbd, "draw_bodies", lambda count, seed: [tuple(made)] * count)
    monkeypatch.setattr(rgbd, "scan", lambda body, views, seed: scan(body, views, seed, SMALL))
    words = ["--output", str(tmp_path), "--pairs", "2", "--views", "1,2", "--methods", "rigid,coded,truth"]
    assert rgbd.main(words) == 0
    heard = capsys.readouterr()
    assert "3D-CODED is left out" in heard.out and heard.err.count("rigid") == 8
    rows = json.loads(heard.out.strip().splitlines()[-1])["rows"]
    assert [(row["views"], row["target"], row["method"]) for row in rows[:2]] == [
        (1, "same", "rigid, nearest"),
        (1, "same", "the true partner"),
    ]
    assert all(row["pairs"] == 2 for row in rows) and len(rows) == 8
    assert rows[1]["mean_cm_mean"] < 3.0 and rows[1]["color_mean"] < 20.0
    (tmp_path / "1-other-2-rigid.json").unlink()
    assert rgbd.main(words) == 0
    heard = capsys.readouterr()
    assert heard.err.count("rigid") == 1
    assert json.loads(heard.out.strip().splitlines()[-1])["rows"][1]["mean_cm_mean"] == rows[1]["mean_cm_mean"]
    assert rgbd.main([*words[:4], "--views", "1,none"]) == 1
