"""Parts of shapes and the measure of confidence, by hand; the command on a small set."""

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.experiments.bench import partial
from meshmatch.experiments.bench.partial import main, part_of, seen_faces
from meshmatch.experiments.bench.sets import load_set
from meshmatch.geometry.triangles import normalized
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.experiments.small_bench import build, truth


def test_a_camera_sees_what_faces_it_and_is_not_hidden() -> None:
    ball = icosphere(3)
    behind = Shape(
        np.concatenate([ball.verts, ball.verts * 0.5 - [0, 0, 4.0]]), np.concatenate([ball.faces, ball.faces + ball.V])
    )
    centers = behind.verts[behind.faces].mean(axis=1)
    seen = seen_faces(behind, centers, np.array([0.0, 0.0, 1.0]))
    front = normalized(behind.face_vectors)[:, 2] > 0
    assert np.array_equal(seen[: ball.F], front[: ball.F])
    assert not seen[ball.F :].any()  # the small ball stands in the shadow of the large one
    aside = seen_faces(behind, centers, np.array([1.0, 0.0, 0.0]))
    assert np.array_equal(aside, normalized(behind.face_vectors)[:, 0] > 0)


@pytest.mark.parametrize("kind", partial.KINDS)
def test_parts_keep_their_vertices(kind: partial.Kind) -> None:
    ball = icosphere(3)
    for seed in range(5):
        part, used = part_of(ball, kind, seed)
        assert np.array_equal(part.verts, ball.verts[used])
        known = {tuple(face) for face in ball.faces.tolist()}
        assert all(tuple(face) in known for face in used[part.faces].tolist())
        assert (0.45 if kind == "view" else 0.5) <= part.F / ball.F <= (0.55 if kind == "view" else 0.9)
        assert part_of(ball, kind, seed)[0].hash == part.hash


@dataclass
class Known:
    """Stands for our method: right maps, made wrong at some vertices with little confidence."""

    used: dict[str, np.ndarray]
    seed: int = 0

    def fit(self, shape: Shape) -> SimpleNamespace:
        return SimpleNamespace(partial=shape.hash in self.used)

    def map(self, source: Shape, _: object, target: Shape, __: object) -> VertexMap:
        index = truth(Path(source.name).stem, Path(target.name).stem)[self.used[source.hash]]
        wrong = np.arange(len(index)) % 5 == 0
        index = np.where(wrong, (index + target.V // 2) % target.V, index)
        return VertexMap.between(source, target, index, confidence=np.where(wrong, 0.1, 0.9))


def test_the_command_counts_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data, known = build(tmp_path / "data"), Known({})
    bench = load_set("shrec19", data)
    for name in bench.shapes:
        for kind in partial.KINDS:
            part, used = part_of(bench.shape(name), kind, bench.shapes.index(name))
            known.used[part.hash] = used
    monkeypatch.setattr(partial, "OurMethod", lambda *_, **__: known)
    words = ["--sets", "shrec19", "--data", str(data), "--cache", str(tmp_path / "kept"), "--partial", "yes"]
    words += ["--work", str(tmp_path / "work")]
    assert main(words) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    # again, of what was kept
    monkeypatch.setattr(Known, "map", lambda *_: pytest.fail("a pair was matched again"))
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["rows"] == record["rows"]
    assert [row["part"] for row in record["rows"]] == list(partial.KINDS)
    for found in record["rows"]:
        assert (found["set"], found["pairs"]) == ("shrec19", "3 of 3")
        assert found["median_cm"] == 0.0
        assert 0.05 < found["share_over_15cm"] <= 0.25
        assert found["auc"] > 0.9
        assert found["taken_for_parts"] == 1.0
