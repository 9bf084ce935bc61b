"""Progress: shares of ranges of the bar of a stage."""

import pytest

from meshmatch.progress import Progress


def recorder() -> tuple[Progress, list[tuple[str, str, float]]]:
    reports: list[tuple[str, str, float]] = []
    return Progress(lambda stage, name, share: reports.append((stage, name, share)), "cat.ply"), reports


def test_a_share_of_a_range_is_reported_as_a_share_of_its_stage() -> None:
    progress, reports = recorder()
    refinement = progress.stage("refinement", 0.6, 1.0)
    refinement(0.0)
    refinement(0.5)
    refinement(1.0)
    assert [report[:2] for report in reports] == [("refinement", "cat.ply")] * 3
    assert [report[2] for report in reports] == pytest.approx([0.6, 0.8, 1.0])


def test_ranges_nest() -> None:
    progress, reports = recorder()
    progress.stage("fit", 0.5, 1.0).between(0.2, 0.4).between(0.5, 1.0)(1.0)
    progress.stage("fit", 0.5, 1.0).between(0.2, 0.4).between(0.5, 1.0)(0.0)
    assert [share for _, _, share in reports] == pytest.approx([0.7, 0.65])


def test_a_new_stage_has_a_bar_of_its_own() -> None:
    progress, reports = recorder()
    progress.stage("one", 0.5, 0.6).stage("two")(0.25)
    assert reports == [("two", "cat.ply", 0.25)]


def test_without_a_callback_nothing_happens() -> None:
    Progress().stage("fit")(0.5)


def test_what_the_callback_raises_comes_through() -> None:
    def stop(stage: str, name: str, share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Progress(stop)(0.5)
