"""Bodies that nobody drew for training: drawn again alike, with their truth, and count_by_error by verdict and error."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.api.matcher import Matcher
from meshmatch.errors import InputError
from meshmatch.experiments.bench import campaign
from meshmatch.experiments.bench.campaign import POSES, Body, People, band_of, count_by_error
from meshmatch.experiments.makers.human_bodies import unseen_bodies
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.judge.features import FitFeatures
from meshmatch.generators.bodies import template_rig
from meshmatch.generators.figure import Figure
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import read_template
from tests.conftest import some_fit

pytest.importorskip("anny")


@pytest.fixture(scope="module")
def people() -> People:
    """With the rig that other tests build as well."""
    template = read_template("human-T")
    unseen_bodies(template, 1, seed=1005)
    made = People(template, 5)
    made.__dict__["figure"] = Figure.of(template_rig(template, 64, 1006))
    return made


@pytest.fixture(scope="module")
def bodies(people: People) -> list[Body]:
    return [people.draw(number) for number in range(9)]


def test_a_body_is_a_function_of_its_number(people: People, bodies: list[Body]) -> None:
    again = people.draw(7)
    assert np.array_equal(again.shape.verts, bodies[7].shape.verts) and again.words == bodies[7].words
    assert not np.array_equal(again.places, people.draw(8).places)


def test_the_truth_lies_on_the_shape_where_that_is_shown(people: People, bodies: list[Body]) -> None:
    for body in bodies:
        unit = np.sqrt(Shape(body.places, people.template.shape.faces).area)
        gap = cKDTree(body.shape.verts).query(body.places)[0] / unit
        assert np.isfinite(body.places).all() and np.quantile(gap[body.has], 0.9) < 0.06
        if body.words["cut"] == "none":
            assert body.has.all()
        elif "half" in body.words["cut"]:
            assert 0.3 < body.has.mean() < 0.7 and gap[~body.has].max() > 0.1


@pytest.mark.slow
def test_all_kinds_of_bodies_are_drawn(people: People) -> None:
    told = [people.draw(number).words for number in range(40)]
    words = {name: {each[name] for each in told} for name in told[0]}
    assert len(words["pose"]) > len(POSES) // 2 and len(words["triangles"]) == 2
    assert len(words["cut"]) > 1 and len(words["noise"]) > 1 and len(words["worn"]) > 2


@pytest.mark.parametrize(
    ("error", "band"), [(0.0, "0 to 5 cm"), (5.0, "5 to 8 cm"), (14.9, "8 to 15 cm"), (30.0, "over 30 cm")]
)
def test_bands_of_error(error: float, band: str) -> None:
    assert band_of(error) == band


def test_what_is_counted() -> None:
    rows = [{"verdict": verdict, "error": error} for verdict, error in (("good", 1.0), ("fair", 2.0), ("fair", 50.0))]
    found = {row["error"]: row for row in count_by_error([*rows, {"verdict": "refused"}])}
    assert list(found) == ["0 to 5 cm", "5 to 8 cm", "8 to 15 cm", "15 to 30 cm", "over 30 cm"]
    assert (found["0 to 5 cm"]["good"], found["0 to 5 cm"]["fair"], found["0 to 5 cm"]["all"]) == (1, 1, 2)
    assert found["over 30 cm"] == {"error": "over 30 cm", "good": 0, "fair": 1, "poor": 0, "all": 1}


def test_a_run_goes_on_where_it_was_stopped(
    people: People, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fits are replaced by the truth, but for one body, which is refused."""
    fitted = []

    def fit(_: Matcher, shape: Shape) -> Fit:
        fitted.append(shape.name)
        if shape.name == "body 5-1":
            raise InputError("no body")
        body = people.draw(int(shape.name.rsplit("-")[-1]))
        return some_fit(body.places, people.template.shape.faces, signs=FitFeatures(residual=0.02))

    monkeypatch.setattr(campaign, "People", lambda *_: people)
    monkeypatch.setattr(campaign, "write_fit", lambda *_: None)
    monkeypatch.setattr(Matcher, "fit", fit)
    words = ["--output", str(tmp_path), "--seed", "5", "--seeds", "1", "--bodies"]
    assert campaign.main([*words, "2"]) == 0 and campaign.main([*words, "3"]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert fitted == ["body 5-0", "body 5-1", "body 5-2"]
    assert (record["bodies"], record["refused"], record["bands"][0]["all"]) == (3, 1, 2)
    rows = [json.loads(line) for line in (tmp_path / "bodies.jsonl").read_text().splitlines()]
    assert rows[0]["error"] == pytest.approx(0, abs=1e-6) and rows[0]["exchanged"] > 5
    assert sum(row["bodies"] for row in record["poses"]) <= 2 and record["poses"][0]["mean"] == pytest.approx(
        0, abs=1e-6
    )

    saved, elsewhere = tmp_path / "results.json", ["--output", str(tmp_path / "elsewhere"), *words[2:]]
    assert campaign.main([*words, "3", "--save", str(saved)]) == 0
    capsys.readouterr()
    assert campaign.main([*elsewhere, "4", "--known", str(saved)]) == 0
    more = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert fitted[3:] == ["body 5-3"]
    assert (more["bodies"], more["refused"]) == (4, 1) and more["rows"][:3] == record["rows"]
    saved.write_text("{}")
    assert campaign.main([*elsewhere, "4", "--known", str(saved)]) == 1
