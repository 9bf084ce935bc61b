"""What was measured, kept with its question."""

from pathlib import Path

import pytest

from meshmatch.errors import InputError, OptionError
from meshmatch.experiments.cell_files import keep, once, recall


def test_an_answer_is_measured_once(tmp_path: Path) -> None:
    calls: list[int] = []

    def measure() -> dict[str, float]:
        calls.append(1)
        return {"cm": 2.5}

    path = tmp_path / "new" / "cell.json"
    asked = {"pairs": (("a", "b"),), "seed": 0}
    assert recall(path, asked) is None
    first = once(path, asked, measure)
    assert first == once(path, asked, measure) == recall(path, asked)
    assert first["cm"] == 2.5
    assert len(calls) == 1


def test_an_answer_to_another_question_is_refused(tmp_path: Path) -> None:
    keep(tmp_path / "cell.json", {"seed": 0, "steps": 5}, {"cm": 1})
    with pytest.raises(OptionError, match=r"other choices \(seed, steps\)"):
        recall(tmp_path / "cell.json", {"seed": 1, "steps": 6})
    with pytest.raises(OptionError, match=r"\(minutes\)"):
        recall(tmp_path / "cell.json", {"seed": 0, "steps": 5, "minutes": 2})


@pytest.mark.parametrize("words", ["{", "[]", "{}", "3", "[" * 5000, '"asked"'])
def test_a_damaged_file_is_told(words: str, tmp_path: Path) -> None:
    (tmp_path / "cell.json").write_text(words)
    with pytest.raises(InputError, match=r"cell\.json is no cell"):
        recall(tmp_path / "cell.json", {})
