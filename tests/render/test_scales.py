"""Numbers and labels as colors."""

import numpy as np
import pytest

from meshmatch.errors import OptionError
from meshmatch.render.scales import Scale, label_swatches, nice_step
from meshmatch.shapes.colors import UNKNOWN, label_colors

LIGHT = np.array([0.2126, 0.7152, 0.0722])


def test_a_scale_begins_at_0_and_ends_at_a_round_number() -> None:
    scale = Scale.of([0.3, 1.2, 4.7], "error (cm)")
    assert (scale.low, scale.high, scale.title) == (0, 5, "error (cm)")
    assert [words for _, words in scale.ticks()] == ["0", "1", "2", "3", "4", "5"]
    assert [place for place, _ in scale.ticks()] == pytest.approx([0, 1, 2, 3, 4, 5])


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ([7.1, 7.9], (7.0, 8.0)),
        ([-3.0, 1.0], (-4.0, 4.0)),
        ([-9.0, -8.2], (-9.0, -8.2)),
        ([2e-7, 9e-7], (0.0, 1e-6)),
        ([0.0, 0.0], (0.0, 1.0)),
        ([5.0, 5.0], (0.0, 5.0)),
        ([-2.0, -2.0], (-2.0, 0.0)),
        ([np.nan, np.nan], (0.0, 1.0)),
        ([], (0.0, 1.0)),
    ],
)
def test_ends(values: list[float], ends: tuple[float, float]) -> None:
    scale = Scale.of(values)
    assert (scale.low, scale.high) == pytest.approx(ends)
    assert np.isfinite(scale.colors(np.array(values, dtype=float))).all()


def test_a_few_far_numbers_do_not_stretch_the_scale_but_are_told() -> None:
    values = np.append(np.linspace(0, 1, 1000), 50.0)
    scale = Scale.of(values)
    assert scale.high == 1
    assert [words for _, words in scale.ticks()][-1] == "> 1"
    assert np.array_equal(scale.colors([50.0]), scale.colors([1.0]))
    chosen = Scale.of(values, limits=(0.2, 0.5))
    assert [words for _, words in chosen.ticks()] == ["< 0.2", "0.3", "0.4", "> 0.5"]


def test_ends_that_were_chosen_are_kept_and_stand_on_the_scale() -> None:
    scale = Scale.of([1.0, 2.0], limits=(0.37, 9.81))
    words = [words for _, words in scale.ticks()]
    assert (words[0], words[-1]) == ("0.37", "9.81")
    assert words[1:-1] == ["2", "4", "6", "8"]
    for limits in ((1.0, 1.0), (2.0, 1.0), (0.0, np.inf), (np.nan, 1.0)):
        with pytest.raises(OptionError, match="cannot run"):
            Scale.of([1.0], limits=limits)


def test_heat_gets_darker_all_the_way() -> None:
    scale = Scale(0, 1)
    light = scale.colors(np.linspace(0, 1, 50)) @ LIGHT
    assert (np.diff(light) < 0).all()
    assert light[0] > 0.85
    backwards = Scale(0, 1, reverse=True).colors(np.linspace(0, 1, 50))
    assert backwards == pytest.approx(scale.colors(np.linspace(1, 0, 50)))


def test_both_signs_have_a_color_and_0_has_none() -> None:
    scale = Scale(-2, 2)
    below, middle, above = scale.colors([-2.0, 0.0, 2.0])
    assert below[2] > below[0] + 0.1
    assert above[0] > above[2]
    assert np.ptp(middle) < 0.12
    assert scale.colors([-1.0])[0] @ LIGHT == pytest.approx(scale.colors([1.0])[0] @ LIGHT, abs=0.2)


def test_what_has_no_value_is_grey_and_told() -> None:
    scale = Scale.of([0.0, np.nan, 1.0])
    assert scale.unknown
    assert tuple(scale.colors([np.nan])[0]) == UNKNOWN
    assert not Scale.of([0.0, 1.0]).unknown


@pytest.mark.parametrize(("span", "step"), [(1, 0.2), (5, 1), (9, 2), (24, 5), (0.03, 0.01), (800, 200)])
def test_nice_steps(span: float, step: float) -> None:
    assert nice_step(span, 5) == pytest.approx(step)


def test_a_label_has_one_color_whoever_else_is_there() -> None:
    colors = label_colors(np.arange(17))
    assert np.array_equal(label_colors([3, 16]), colors[[3, 16]])
    apart = np.linalg.norm(colors[:, None] - colors[None], axis=2) + np.eye(17)
    assert apart.min() > 0.08
    assert np.linalg.norm(np.diff(colors, axis=0), axis=1).min() > 0.25
    assert tuple(label_colors([-1])[0]) == UNKNOWN
    assert np.isfinite(label_colors([10**15])).all()


def test_the_legend_of_labels_names_those_that_occur() -> None:
    swatches = label_swatches([4, 1, 1, -1], ["a", "arm", "c", "d"])
    assert swatches.names == ("arm", "4", "none")
    assert swatches.colors[0] == pytest.approx(label_colors([1])[0])
    assert swatches.colors[2] == UNKNOWN
    many = label_swatches(np.arange(100), most=10)
    assert len(many.names) == 10
    assert many.names[-1] == "and 91 more"
