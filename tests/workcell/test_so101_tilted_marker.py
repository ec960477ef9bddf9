"""``reach`` with an SO-101 in front of a marker with an axis out of its reach."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from robot_ik.commands.reach import Reach
from robot_ik.commands.terminal import Terminal
from robot_ik.errors import NotConvergedError
from robot_ik.geometry import Pose, rotation_exp
from robot_ik.workcell import vision
from robot_ik.workcell.scene import scene_for

TILT = (0.25, 0.15, 0.0)
"""rad. Turn of the marker of the scene about its own axes."""


ABOVE_TABLE = 0.02
"""m. Otherwise the table hides half of a tilted marker."""


@pytest.fixture
def tilt(monkeypatch):
    """Return a function that tilts the marker of every scene from now on."""

    def tilted(rotation_vector):
        def scene(*arguments, **options):
            flat = scene_for(*arguments, **options)
            turn = Pose((0.0, 0.0, ABOVE_TABLE), rotation_exp(rotation_vector))
            return replace(flat, pose_world_marker=flat.pose_world_marker.compose(turn))

        monkeypatch.setattr(vision, "scene_for", scene)

    return tilted


class RecordedTerminal(Terminal):
    """A terminal that keeps its lines."""

    def __init__(self) -> None:
        super().__init__(quiet=True)
        self.lines: list[str] = []

    def say(self, text: str, style: str = "") -> None:
        self.lines.append(text)


def test_the_angle_is_printed_before_the_motion_and_the_result_is_judged_against_it(tilt):
    tilt(TILT)
    terminal = RecordedTerminal()
    report = Reach(robot="so101", bus="sim").run(terminal)
    assert report.ok, report.verdict
    prediction = report.prediction
    assert prediction.proven
    assert prediction.angle > math.radians(2.0)
    assert report.judged.read_back.angle == pytest.approx(prediction.angle, abs=math.radians(1.0))
    assert report.judged.by_camera.passed
    (line,) = [line for line in terminal.lines if "stays" in line]
    assert line == prediction.sentence()
    facts = report.facts()
    assert facts["goal"]["orientation"] == "best"
    assert facts["solution"]["angle_bound_rad"] == pytest.approx(prediction.angle, abs=2e-4)


def test_a_larger_angle_than_allowed_moves_nothing(tilt):
    tilt(TILT)
    report = Reach(robot="so101", bus="sim", max_angle_deg=1.0).run(RecordedTerminal())
    assert not report.ok
    assert isinstance(report.error, NotConvergedError)
    assert report.execution is None
    assert "turn the marker" in str(report.error)


def test_the_arm_meets_the_marker_after_the_turn_that_the_report_names(tilt):
    tilt(TILT)
    prediction = (
        Reach(robot="so101", bus="sim", max_angle_deg=180.0).run(RecordedTerminal()).prediction
    )
    turned = Pose((0.0, 0.0, 0.0), rotation_exp(TILT)).compose(
        Pose((0.0, 0.0, 0.0), rotation_exp(prediction.turn))
    )
    tilt(np.asarray(turned.log()[3:]))
    report = Reach(robot="so101", bus="sim", max_angle_deg=1.0).run(RecordedTerminal())
    assert report.ok, report.verdict
    assert report.prediction.is_met
