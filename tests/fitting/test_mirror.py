"""The mirror of a symmetric template: a reading of the mirrored scan is a reading of the scan."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from meshmatch.api.inputs import as_model
from meshmatch.fields.shape_functions import ShapeFunctions
from meshmatch.fitting.network_fit import Mirror, Predictor, mirror_of
from meshmatch.fitting.system import node_system
from meshmatch.geometry.frames import RigidPose
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import egg_model, gentle_vectors, scan_of

FLIP = np.array([-1.0, 1, 1])


@pytest.fixture(scope="module")
def human() -> TrainedModel:
    return as_model("human")


@pytest.fixture(scope="module")
def mirror(human: TrainedModel) -> Mirror:
    found = mirror_of(human)
    assert found is not None
    return found


def test_a_body_has_a_mirror_and_what_is_not_symmetric_has_none(human: TrainedModel) -> None:
    template = human.template
    shifted = replace(template, dense=Shape(template.dense.verts + np.array([0.03, 0, 0]), template.dense.faces))
    assert mirror_of(replace(human, template=shifted)) is None


def test_the_mirrored_deformation_moves_the_mirrored_template_to_the_mirror_image(
    human: TrainedModel, mirror: Mirror
) -> None:
    system = node_system(human)
    vectors = 0.5 * gentle_vectors(human)
    moved = system.moved(mirror.vectors(vectors))
    # an oracle without the solve: the field itself, asked at the mirrored vertices
    over = human.field(system.verts * FLIP)
    assert isinstance(over, ShapeFunctions)
    across = over.phi.toarray().astype(float)
    wanted = (system.verts * FLIP + across @ vectors) * FLIP
    assert np.abs(moved - system.verts).max() > 0.01
    assert np.abs(moved - wanted).max() < 2e-3


def test_twice_in_the_mirror_is_the_same_again(human: TrainedModel, mirror: Mirror) -> None:
    system = node_system(human)
    vectors = 0.5 * gentle_vectors(human)
    twice = mirror.vectors(mirror.vectors(vectors))
    assert np.abs(system.moved(twice) - system.moved(vectors)).max() < 4e-3


def test_a_mirror_adds_as_many_readings_which_a_network_without_sides_reads_the_same() -> None:
    model = egg_model()
    system = node_system(model)
    scan = scan_of(Shape(system.verts, system.faces), 200)
    asked: list[np.ndarray] = []

    class Still:
        def predict(self, clouds: Sequence[np.ndarray]) -> np.ndarray:
            asked.extend(clouds)
            return np.full((len(clouds), system.K, 3), 0.1)

        def rotate_rows(self, vectors: np.ndarray, turn: np.ndarray) -> np.ndarray:
            return vectors

    network: Any = Still()
    mirror = Mirror(np.eye(system.K))
    # without a tilt and with all points the mirrored questions hold the mirrored points
    predictor = Predictor(network, system, model.template.core, mirror, np.random.default_rng(0))
    found = predictor.variants(scan, scan, RigidPose.identity(), 2, 0.0)
    assert len(found) == 4
    first, last = (np.sort(asked[k] * flip, axis=0) for k, flip in ((0, 1.0), (3, FLIP)))
    assert np.allclose(first, last, atol=1e-6)
    assert np.allclose(found[0].vectors, 0.1) and np.allclose(found[3].vectors, 0.1 * FLIP)
