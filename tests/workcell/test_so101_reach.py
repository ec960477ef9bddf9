"""`robot-ik reach --robot so101`: the camera confirms that the tool is at the marker."""

from __future__ import annotations

import json
import os

import pytest

from robot_ik.commands.main import main

BUSES = ("sim", pytest.param("pty", marks=pytest.mark.skipif(os.name != "posix", reason="no pty")))


@pytest.mark.parametrize("bus", BUSES)
def test_the_so101_reaches_a_marker(tmp_path, real_time, bus):
    out = tmp_path / "reach"
    assert main(["reach", "--robot", "so101", "--bus", bus, "--out", str(out)]) == 0
    assert json.loads((out / "summary.json").read_text())["reached"] is True


def test_a_stuck_joint_is_not_a_reach(tmp_path):
    out = tmp_path / "reach"
    options = ["--robot", "so101", "--bus", "sim", "--fault", "stuck:shoulder_pan"]
    assert main(["reach", *options, "--out", str(out)]) == 1
