"""Collections of a kind that a model learned without correspondence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.api.upright import upright_rotation_of_fit
from meshmatch.collections import setting, tasks
from meshmatch.collections.collection import Collection
from meshmatch.fitting import reference_statistics, same_pose
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import bent_egg, egg_model, write_model

QUICK = FitConfig(refine="none", copies=4, careful=1)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A model of eggs, and two eggs, one of which has lost its top."""
    known = egg_model()
    frame = {"orientation": "none", "scale": "area"}
    model = replace(known, card=replace(known.card, correspondence=False, frame=frame))
    write_model(model, tmp_path / "model")
    (tmp_path / "eggs").mkdir()
    whole = bent_egg(model)
    kept = whole.faces[(whole.verts[:, 1] < np.quantile(whole.verts[:, 1], 0.6))[whole.faces].all(1)]
    used = np.unique(kept)
    save_shape(tmp_path / "eggs" / "whole.ply", whole)
    save_shape(tmp_path / "eggs" / "cut.ply", Shape(whole.verts[used], np.searchsorted(used, kept)))
    monkeypatch.setattr(tasks, "differing_kind", lambda *_: None)  # it takes longer than all else
    monkeypatch.setattr(reference_statistics, "MIN_FITS", 2)
    return tmp_path


def test_what_stands_out_may_be_cut_and_finer_fits_stay(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, float]] = []
    monkeypatch.setattr(setting, "fit_as_part", lambda model, shape, whole, config: asked.append((shape.V, whole)))
    monkeypatch.setattr(
        same_pose, "refine_fit", lambda model, shape, fit, *_: replace(fit, points=fit.points + shape.V)
    )
    collection = Collection(folder / "fits", workers=1)
    made = collection.fit(folder / "eggs", model=str(folder / "model"), config=QUICK)
    assert asked == [(made.records[0].vertices, np.median([record.scale for record in made.records]))]
    for record in made.records:  # which agreement would move elsewhere
        assert abs(collection.fit_of(record.name).points.mean() - record.vertices) < 1
        assert (record.up, record.front) == ("", "")
        assert upright_rotation_of_fit(collection.fit_of(record.name)) is None
