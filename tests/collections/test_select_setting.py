"""What all fits of a collection share."""

from pathlib import Path

import numpy as np

from meshmatch.collections.select_setting import select_setting
from meshmatch.collections.setting import Setting
from meshmatch.collections.sources import find_sources
from meshmatch.collections.stores import Store
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.models.registry import NO_MODEL
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere


def test_without_a_model_the_first_template_is_made_of_the_chosen_part(tmp_path: Path) -> None:
    """Two parts far apart would be refused, and one of them is asked for."""
    ball = icosphere(3)
    both = np.concatenate([ball.verts, 0.5 * ball.verts + 100.0]), np.concatenate([ball.faces, ball.faces + ball.V])
    (tmp_path / "in").mkdir()
    save_shape(tmp_path / "in" / "a.ply", Shape(*both))
    store = Store.of(tmp_path / "fits")
    wish = Setting(store, NO_MODEL, FitConfig(), only=("1",))
    found = select_setting(wish, find_sources(tmp_path / "in", store)[0])
    assert found.template.shape.V == ball.V
