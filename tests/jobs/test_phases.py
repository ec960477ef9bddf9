"""The shape of a job: a report keeps what each phase gives, under the names that the phase gives it."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields
from typing import Any

import pytest

from robot_ik.jobs import JobReport, reach
from robot_ik.jobs.ar import job as ar
from robot_ik.jobs.arm_camera import handeye, verify

PHASES: list[tuple[type[JobReport], tuple[type[Any], ...]]] = [
    (
        reach.ReachReport,
        (
            reach.ReachGoal,
            reach.Solved,
            reach.Planned,
            reach.Moved,
            reach.Followed,
            reach.Arrived,
            reach.SeenArrived,
        ),
    ),
    (handeye.HandEyeReport, (handeye.PlannedViews, handeye.MeasuredViews, handeye.SolvedMount)),
    (verify.VerifyReport, (handeye.PlannedViews, handeye.MeasuredViews, verify.Compared)),
    (ar.ArReport, (ar.Drawn,)),
]


@pytest.mark.parametrize(("report", "phases"), PHASES, ids=lambda one: getattr(one, "__name__", ""))
def test_a_report_has_a_field_for_all_that_its_phases_find(
    report: type[JobReport], phases: tuple[type[Any], ...]
) -> None:
    known = {one.name for one in fields(report)}  # type: ignore[arg-type]
    for phase in phases:
        assert {one.name for one in fields(phase)} <= known, phase


def test_what_a_phase_found_is_kept_and_given_back_and_stays_as_it_is() -> None:
    report = ar.ArReport("painter", 1.0, "")
    drawn = ar.Drawn(3, 2, 1, 0.5, 0.1, True)
    assert report.keep(drawn) is drawn
    assert (report.pictures, report.drawn, report.in_view, report.interrupted) == (3, 2, 1, True)
    assert report.backend == "painter"
    with pytest.raises(FrozenInstanceError):
        drawn.pictures = 4  # type: ignore[misc]
