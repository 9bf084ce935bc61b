"""Shapes that are the mirror image of what a model knows: found, said, and matched all the same."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

import meshmatch
from meshmatch.api.inputs import as_model
from meshmatch.api.interpolation import InterpolationOptions, interpolate
from meshmatch.errors import OptionError
from meshmatch.fitting import fitter
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.geometry.triangles import triangle_vectors
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape

DANCER = Path(__file__).parents[2] / "templates" / "samples" / "dancer.ply"


@pytest.fixture
def one_sided(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bodies as if left and right were not alike, and the mirror image always lay nearer."""
    fit_whole = fitter.fit_whole

    def mirror_alone(task, *given):
        registration = fit_whole(task, *given)
        if task.config.mirror == "auto" and not registration.core_frame.mirrored:
            object.__setattr__(registration.candidate, "residual", 1.0)
        return registration

    monkeypatch.setattr(fitter, "mirror_of", lambda model: None)
    monkeypatch.setattr(fitter, "fit_whole", mirror_alone)


def volume(shape: Shape) -> float:
    return float((triangle_vectors(shape.verts, shape.faces) * shape.verts[shape.faces].mean(1)).sum())


def turned_over(fit: Fit) -> np.ndarray:
    """Template vertices on the shape, those of left and right exchanged."""
    at = cKDTree(fit.resting).query(fit.resting * [-1, 1, 1])[1]
    return fit.points_in_file[at]


def test_the_mirror_image_is_fitted_in_its_place(one_sided: None) -> None:
    fit = meshmatch.register(DANCER, model="human", config=FitConfig(mirror="auto"))
    plain = meshmatch.register(DANCER, model="human", config=FitConfig(mirror="no"))
    assert fit.frame.mirrored and not plain.frame.mirrored
    assert any("dancer.ply: taken for the mirror image of what human knows" in note for note in fit.notes)
    assert (fit.verdict, fit.up) == ("good", plain.up)
    size = plain.frame.scale
    # the fitted template lies on the dancer, faces out, and has left where right is
    assert volume(fit.shape) > 0 and volume(plain.shape) > 0
    apart = np.linalg.norm(turned_over(fit) - plain.points_in_file, axis=1).mean() / size
    assert apart < 0.02 < 0.15 < np.linalg.norm(fit.points_in_file - plain.points_in_file, axis=1).mean() / size
    dense = meshmatch.Matcher("human").dense(fit)
    assert volume(dense) > 0


def test_a_collection_names_mirror_images(one_sided: None, tmp_path: Path) -> None:
    quick = FitConfig(mirror="auto", refine="none", copies=16, careful=1)
    made = meshmatch.Collection(tmp_path / "fits", workers=1).fit(DANCER, model="human", config=quick, agree=False)
    (record,) = made.records
    assert (record.mirrored, record.notes) == (1, "taken for the mirror image of what human knows")


@pytest.mark.slow
def test_a_shape_and_its_mirror_image_are_matched(one_sided: None) -> None:
    dancer = meshmatch.load_shape(DANCER)
    image = Shape(dancer.verts * [-1, 1, 1], dancer.faces[:, ::-1], "image")
    plain, mirror = FitConfig(mirror="no"), FitConfig(mirror="auto")
    found = meshmatch.match(dancer, image, model="human", config=(plain, mirror))
    assert found.target_fit.frame.mirrored
    error = np.linalg.norm(dancer.verts[found.map.index] - dancer.verts, axis=1) / np.sqrt(dancer.area)
    assert error.mean() < 0.01
    with pytest.raises(OptionError, match="mirror image"):
        interpolate([dancer, image], model="human", config=(plain, mirror), options=InterpolationOptions(place="files"))


def test_what_fits_either_way_is_not_called_good(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitter, "mirror_of", lambda model: None)
    fit = meshmatch.register(DANCER, model="human", config=FitConfig(mirror="auto"))
    assert fit.verdict == "fair"
    assert [reason.code for reason in fit.reasons] == ["side"]


def test_what_is_whole_on_one_side_is_no_part_on_the_other(one_sided: None, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []
    monkeypatch.setattr(fitter, "_part_is_plausible", lambda whole: tried.append(whole.core_frame.mirrored))
    meshmatch.register(DANCER, model="human", config=FitConfig(mirror="auto"))
    assert tried == [True]


def test_what_is_symmetric_has_no_sides() -> None:
    fit = meshmatch.register(DANCER, model="human", config=FitConfig(mirror="auto"))
    assert fit.verdict == "good" and not fit.frame.mirrored
    assert as_model("human").card.mirror == "no"


def test_words_for_the_mirror() -> None:
    with pytest.raises(OptionError, match="mirror cannot be 'yes'"):
        FitConfig(mirror="yes")  # type: ignore[arg-type]


@pytest.mark.slow
def test_without_correspondence_near_is_all_that_is_known() -> None:
    model = as_model("human")
    blind = TrainedModel(replace(model.card, correspondence=False), model.template, model.inference)
    fit = meshmatch.register(DANCER, model=blind)
    assert (fit.verdict, [reason.code for reason in fit.reasons]) == ("fair", ["unsupervised"])
