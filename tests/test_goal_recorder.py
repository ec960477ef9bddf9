"""The recorder records arms in all test folders, and fails tests with forbidden goals."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from robot_ik.hardware import open_arm
from tests.hardware.family_arms import FAMILIES, family_config

PLUGIN = Path(__file__).with_name("goal_recorder.py")

BAD_ARM = """
import dataclasses, math
import pytest
from robot_ik.hardware import open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.limiter import SafetyLimiter

ARMS = {
    "dynamixel_x": ArmConfig.generic("two", ["a", "b"], [-1.0, -1.0], [1.0, 1.0]),
    "feetech_sts": ArmConfig.load("so101").only(["wrist_roll", "wrist_flex"]),
}

@pytest.mark.parametrize("bus", ["sim", "pty"])
@pytest.mark.parametrize("broken", [False, True])
@pytest.mark.parametrize("family", ARMS)
def test_it(family, bus, broken, monkeypatch):
    arm = ARMS[family]
    if broken:
        step = SafetyLimiter.step
        def beyond(self, *given):
            state, report = step(self, *given)
            return dataclasses.replace(state, q=tuple(q + 3.0 for q in state.q)), report
        monkeypatch.setattr(SafetyLimiter, "step", beyond)
    with open_arm(arm, bus) as arm:
        arm.enable()
        arm.send([0.0, 0.0], arm.clock.now())
"""


@pytest.mark.parametrize("family", FAMILIES)
def test_arms_of_all_tests_are_recorded(goal_recorder, family) -> None:
    with open_arm(family_config(family), "sim") as arm:
        arm.enable()
        before = goal_recorder.goals
        arm.send(np.full(6, 9.0), arm.clock.now())
        assert goal_recorder.goals == before + 6


def test_an_arm_that_sends_goals_beyond_its_limits_fails_its_test(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(
        "from importlib.util import module_from_spec, spec_from_file_location\n"
        f"spec = spec_from_file_location('goal_recorder', {str(PLUGIN)!r})\n"
        "module = module_from_spec(spec)\nspec.loader.exec_module(module)\n"
        "def pytest_configure(config):\n    config.pluginmanager.register(module)\n"
    )
    (tmp_path / "test_bad.py").write_text(BAD_ARM)
    run = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            f"--rootdir={tmp_path}",
            tmp_path,
        ],
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTEST")},
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    buses = ["sim", "pty"] if sys.platform != "win32" else ["sim"]
    broken = 2 * len(buses)
    assert f"{2 * broken} passed, {broken} errors" in run.stdout, run.stdout
    for family in ("dynamixel_x", "feetech_sts"):
        for bus in buses:
            assert f"ERROR test_bad.py::test_it[{family}-True-{bus}]" in run.stdout
    assert "AssertionError: ['a: " in run.stdout
    assert "range 1397..2699" in run.stdout
    assert "AssertionError: ['wrist_roll: " in run.stdout
    assert pytest.ExitCode(run.returncode) is pytest.ExitCode.TESTS_FAILED
