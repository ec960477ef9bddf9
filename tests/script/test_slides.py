"""Scripts for an arm with a slide. Its unit is the millimetre."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from robot_ik.errors import ConfigError
from robot_ik.script import ScriptReport, load_script, run_script

RAIL = """<mujoco><worldbody>
  <body><joint name="pan" type="hinge" axis="0 0 1" range="-90 90"/><geom size=".02" mass=".1"/>
    <body><joint name="rail" type="slide" axis="1 0 0" range="-.01 .08"/>
      <geom size=".01" mass=".1"/>
      <site name="tool" pos="0.1 0 0"/></body></body></worldbody></mujoco>"""
RAIL_ARM = """
schema = 1
name = "rail"
robot = "rail.xml"
[[joints]]
name = "pan"
id = 1
model = "XM430-W350"
lower_deg = -90.0
upper_deg = 90.0
velocity_deg = 90.0
acceleration_deg = 360.0
[[joints]]
name = "rail"
id = 2
model = "XL330-M288"
pinion_mm = 10.0
lower_mm = -5.0
upper_mm = 60.0
velocity_mm = 40.0
acceleration_mm = 200.0
"""


MOVE = """do = "joints"
joints_deg = { pan = 10.0 }
joints_mm = { rail = 30.0 }
tolerance_mm = 0.1
"""
EXPECT = """do = "expect"
joints_mm = { rail = %s }
tolerance_mm = 0.5
"""

Run = Callable[..., ScriptReport]


@pytest.fixture
def run_steps(tmp_path: Path) -> Run:
    """Return a function that runs steps, each in TOML, on the arm with the slide."""
    (tmp_path / "rail.xml").write_text(RAIL)
    (tmp_path / "arm.toml").write_text(RAIL_ARM)
    head = 'schema = 1\nname = "rail"\nrobot = "rail.xml"\narm = "arm.toml"\n[[steps]]\n'
    file = tmp_path / "run.toml"

    def run_steps(*texts: str) -> ScriptReport:
        file.write_text(head + "\n[[steps]]\n".join(texts))
        return run_script(load_script(file))

    return run_steps


def test_slides_move_and_are_measured_in_millimetres(run_steps: Run) -> None:
    report = run_steps(MOVE, EXPECT % 30.0, EXPECT % 34.0)
    assert [step.outcome for step in report.steps[:3]] == ["passed", "passed", "failed"]
    assert report.steps[0].name == "joints pan 10° rail 30 mm"
    assert report.steps[2].numbers["joint_off_mm"] == pytest.approx(4.0, abs=0.1)
    assert "rail 4.0" in report.steps[2].found
    assert "0.50 mm" in report.steps[2].found


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            "joints_deg = { rail = 1.0 }",
            "joints_deg.rail: a slide counts in millimetres; allowed: joints_mm",
        ),
        (
            "joints_mm = { pan = 1.0 }",
            "joints_mm.pan: a hinge counts in degrees; allowed: joints_deg",
        ),
        (
            "joints_mm = { rail = 70.0 }",
            "joints_mm.rail: 70.0 mm is outside the limits; allowed: -5.0 … 60.0",
        ),
        (
            "joints_mm = { rail = 60.004 }",
            "joints_mm.rail: 60.004 mm is outside the limits; allowed: -5.000 … 60.000",
        ),
        ("joints_mm = { rial = 1.0 }", "did you mean rail"),
        ("", "no joint is named"),
    ],
)
def test_values_of_joints_need_the_right_unit_and_range(
    keys: str, message: str, run_steps: Run
) -> None:
    with pytest.raises(ConfigError) as caught:
        run_steps(f'do = "joints"\n{keys}')
    assert message in f"{caught.value} {caught.value.hint}"
