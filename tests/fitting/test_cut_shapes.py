"""A cut shape is fitted as a part of what the template shows, without a model."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.experiments.makers.bones import draw_bones, scan
from meshmatch.fitting.fit_config import Schedule
from meshmatch.fitting.kind_templates import template_of
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.fitting.without_model import fit_without_model
from meshmatch.shapes.shape import Shape

SCHEDULE = Schedule(steps=10, prior=(1e-3, 1e-6), scale=(0.1, 0.02), damping=1e-6)
SMALL = ViscousConfig(
    nodes=150, radius=0.18, faces=1200, samples=1500, back_points=800, schedule=SCHEDULE, point_share=0.01
)


@pytest.mark.parametrize("cut", [True, False])
def test_a_cut_bone_is_a_part_and_a_whole_one_is_not(cut: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.fitting.without_model._ALIGN_SAMPLES", 300)
    monkeypatch.setattr("meshmatch.fitting.without_model._Task.search", lambda *_: [])
    one, other = (replace(bone, group="plain") for bone in draw_bones(2, 3))
    whole, found = scan(one, 500, 0), scan(other, 500, 1)
    kept = (found.directions[found.shape.faces, 2] < 0.45).all(axis=1) | (not cut)
    used, faces = np.unique(found.shape.faces[kept], return_inverse=True)
    shape = Shape(found.shape.verts[used], faces.reshape(-1, 3))
    template = template_of(whole.shape, "bone", SMALL)
    fit = fit_without_model(template, shape, SMALL, whole=float(np.sqrt(found.shape.area)))
    assert fit.partial == cut and fit.verdict == "fair" and not fit.frame.mirrored
    assert ("part" in [reason.code for reason in fit.reasons]) == cut
    if cut:
        assert "of the template has no counterpart" in fit.reasons[0]
    truth = found.places(whole.directions)  # the template's vertices are those of the first bone
    off = np.linalg.norm(fit.points_in_file - truth, axis=1)
    assert (
        off[whole.directions[:, 2] < 0.4].mean() < 4.0 and off.mean() < 6.0
    )  # of 100; the rest goes on beyond the cut
