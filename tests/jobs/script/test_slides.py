"""Scripts for an arm with a joint that slides: millimetres, everywhere that hinges count in degrees."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot_ik.errors import ConfigError
from robot_ik.jobs.script import ScriptReport, load_script, run_script

RAIL = """<mujoco><worldbody>
  <body><joint name="pan" type="hinge" axis="0 0 1" range="-90 90"/><geom size=".02" mass=".1"/>
    <body><joint name="rail" type="slide" axis="1 0 0" range="-.01 .08"/><geom size=".01" mass=".1"/>
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


def test_slides_count_in_millimetres(tmp_path: Path) -> None:
    (tmp_path / "rail.xml").write_text(RAIL)
    (tmp_path / "arm.toml").write_text(RAIL_ARM)
    head = 'schema = 1\nname = "rail"\nrobot = "rail.xml"\narm = "arm.toml"\n[[steps]]\n'
    file = tmp_path / "run.toml"

    def steps(*texts: str) -> ScriptReport:
        file.write_text(head + "\n[[steps]]\n".join(texts))
        return run_script(load_script(file))

    go = 'do = "joints"\njoints_deg = { pan = 10.0 }\njoints_mm = { rail = 30.0 }\ntolerance_mm = 0.1'
    look = 'do = "expect"\njoints_mm = { rail = %s }\ntolerance_mm = 0.5'
    report = steps(go, look % 30.0, look % 34.0)
    assert [step.outcome for step in report.steps[:3]] == ["passed", "passed", "failed"]
    assert report.steps[0].name == "joints pan 10° rail 30 mm"
    assert report.steps[2].numbers["joint_off_mm"] == pytest.approx(4.0, abs=0.1)
    assert "rail 4.0" in report.steps[2].found and "0.50 mm" in report.steps[2].found
    for wrong, reported in [
        ("joints_deg = { rail = 1.0 }", "joints_deg.rail: a slide counts in millimetres; allowed: joints_mm"),
        ("joints_mm = { pan = 1.0 }", "joints_mm.pan: a hinge counts in degrees; allowed: joints_deg"),
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
    ]:
        with pytest.raises(ConfigError) as caught:
            steps(f'do = "joints"\n{wrong}')
        assert reported in f"{caught.value} {caught.value.hint}"
