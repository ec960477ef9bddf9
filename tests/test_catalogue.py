"""robot.toml: its keys, and the errors of wrong files."""

from pathlib import Path

import numpy as np
import pytest

from robot_ik.errors import (
    ConfigError,
    ModelError,
    UnknownFrameError,
    UnknownJointError,
    UnknownSolverError,
)
from robot_ik.robot import load_robot
from robot_ik.robot_file import catalogue, find_robot, read_robot_file
from robot_ik.solvers import solver_name

MODEL = """<mujoco><compiler angle="radian"/><worldbody><body name="a"><joint name="one"/>
<geom size="0.1"/>
<body name="b" pos="1 0 0"><joint name="two" range="-2 2"/>
<joint name="finger" type="slide" range="0 0.4"/>
<geom size="0.1"/>
<site name="tip" pos="0 0 1"/></body></body></worldbody>
<keyframe><key name="ready" qpos="0.1 0.2 0.3"/></keyframe></mujoco>"""
FILE = """schema = 1
title = "a small arm"
model = "arm.xml"
tool = "grip"
solver = "dls"
home = "ready"
[tools]
grip = { site = "tip", about = "between the jaws" }
wrist = { body = "b" }
[groups]
arm = ["one", "two"]
all = ["one", "two", "finger"]
[motion]
velocity_deg = [90, 180]
acceleration_deg = [360, 720]
[provenance]
sources = ["made up"]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "small"
    made.mkdir()
    (made / "arm.xml").write_text(MODEL)
    (made / "robot.toml").write_text(FILE)
    return made


def test_every_key_of_robot_toml_is_read(folder, monkeypatch):
    monkeypatch.chdir(folder)
    for asked in (folder, folder / "robot.toml", folder / "arm.xml", "."):
        robot = load_robot(asked)
        assert robot.name == "small" and robot.joints == ("one", "two") and robot.tool == "grip"
        np.testing.assert_allclose(robot.velocity_limits, np.radians([90, 180]))
        np.testing.assert_allclose(robot.acceleration_limits, np.radians([360, 720]))
        np.testing.assert_allclose(robot.home, [0.1, 0.2])
        assert robot.qpos(robot.home)[2] == 0.3
        assert robot.frames[:2] == ("grip", "wrist") and robot.file.solver == "dls"
        assert robot.forward(robot.home, "wrist").distance(robot.forward(robot.home, "b")) == (0, 0)
        assert robot.file.title == "a small arm" and robot.file.sources == ("made up",)
    assert load_robot(folder, joints="all").nq == 3


def test_robot_toml_does_not_apply_to_another_model_in_the_folder(folder):
    (folder / "other.xml").write_text(MODEL)
    model, file = find_robot(folder / "other.xml")
    assert model.name == "other.xml" and file.name == "other" and file.tool is None


def test_every_bundled_robot_loads_and_names_its_sources():
    assert "puma560" in catalogue()
    for name in catalogue():
        robot = load_robot(name)
        assert robot.name == name and robot.file.title and robot.file.sources
        assert not robot.outside(robot.home) and robot.tool in robot.frames


@pytest.mark.parametrize(
    ("before", "after", "key", "message"),
    [
        ('solver = "dls"', 'solvr = "dls"', "solvr", "did you mean solver"),
        ('about = "between', 'abot = "between', "tools.grip.abot", "did you mean about"),
        ("[motion]", "[moton]", "moton", "did you mean motion"),
        ("schema = 1", "schema = 2", "schema", "1"),
        ('title = "a small arm"', "", "title", "missing"),
        (
            "velocity_deg = [90, 180]",
            "velocity_deg = [90]",
            "motion.velocity_deg",
            "1 numbers for 2 joints",
        ),
        (
            "velocity_deg = [90, 180]",
            "velocity_deg = [90, 0]",
            "motion.velocity_deg",
            "0 of joint 'two'; allowed: one positive",
        ),
        (
            'home = "ready"',
            "home = [1, 2]",
            "home",
            "2 numbers; allowed: 3, rad and m, for the joints one, two",
        ),
        (
            'home = "ready"',
            "home = [0.1, 90, 0]",
            "home",
            "joint 'two' at 90 rad is outside its limits; allowed: -2 to 2 rad\n"
            "90 degrees are 1.571 rad",
        ),
        (
            'home = "ready"',
            "home = [0, 0, -0.5]",
            "home",
            "joint 'finger' at -0.5 m is outside its limits",
        ),
        ("velocity_deg = [90, 180]", 'velocity_deg = "fast"', "motion.velocity_deg", "a list"),
    ],
)
def test_a_wrong_key_or_value_is_reported_with_file_key_and_what_is_allowed(
    folder, before, after, key, message
):
    assert before in FILE
    (folder / "robot.toml").write_text(FILE.replace(before, after))
    with pytest.raises(ConfigError) as caught:
        load_robot(folder)
    assert caught.value.file == folder / "robot.toml" and caught.value.key == key
    assert message in str(caught.value)


def test_slides_have_limits_of_motion_in_millimetres(folder):
    asked = FILE.replace('arm = ["one", "two"]', 'arm = ["one", "finger", "two"]')
    asked = asked.replace(
        "[motion]", "[motion]\nvelocity_mm = { finger = 20 }\nacceleration_mm = { finger = 80 }"
    )
    (folder / "robot.toml").write_text(asked)
    robot = load_robot(folder)
    np.testing.assert_allclose(robot.velocity_limits, [np.radians(90), np.radians(180), 0.02])
    np.testing.assert_allclose(robot.acceleration_limits, [np.radians(360), np.radians(720), 0.08])
    (folder / "robot.toml").write_text(asked.replace("finger = 20", "fingr = 20"))
    with pytest.raises(UnknownJointError, match="did you mean 'finger'"):
        load_robot(folder)


def test_a_slide_in_degrees_and_a_hinge_in_millimetres_are_refused(folder):
    asked = FILE.replace('arm = ["one", "two"]', 'arm = ["one", "two", "finger"]')
    asked = asked.replace("[90, 180]", "[90, 180, 10]").replace("[360, 720]", "[360, 720, 40]")
    (folder / "robot.toml").write_text(asked)
    with pytest.raises(
        ConfigError, match="'finger' slides; allowed: its limits in velocity_mm"
    ) as caught:
        load_robot(folder)
    assert caught.value.key == "motion.velocity_deg"
    asked = FILE.replace("velocity_deg = [90, 180]", "velocity_mm = { two = 180 }")
    (folder / "robot.toml").write_text(asked.replace("[360, 720]", "[360]"))
    with pytest.raises(ConfigError, match="'two' does not slide") as caught:
        load_robot(folder)
    assert caught.value.key == "motion.velocity_mm"


def test_malformed_toml_and_a_missing_file_are_reported(folder):
    (folder / "robot.toml").write_text("schema = = 1")
    with pytest.raises(ConfigError, match=r"robot\.toml: not valid TOML"):
        load_robot(folder)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_robot_file(folder / "none.toml")


@pytest.mark.parametrize(
    ("before", "after", "error", "message"),
    [
        ('site = "tip"', 'site = "tipp"', UnknownFrameError, "did you mean 'tip'"),
        (
            'arm = ["one", "two"]',
            'arm = ["one", "too"]',
            UnknownJointError,
            r"did you mean 'two'(?s:.*)\nnamed by groups\.arm of .*robot\.toml",
        ),
        (
            "[motion]",
            "[stiffness]\ntoo = 4\n[motion]",
            UnknownJointError,
            r"named by stiffness of .*robot\.toml",
        ),
        (
            "[motion]",
            "[couplings]\none = { follows = 'too', ratio = 1 }\n[motion]",
            UnknownJointError,
            r"named by couplings\.one of .*robot\.toml",
        ),
        (
            'home = "ready"',
            'home = "redy"',
            ModelError,
            r"robot\.toml: home: .*no keyframe 'redy'; it has: ready",
        ),
        (
            'all = ["one", "two"',
            'all = ["one", "too"',
            UnknownJointError,
            r"\nnamed by groups\.all of .*robot\.toml",
        ),
        (
            'model = "arm.xml"',
            'model = "none.xml"',
            ConfigError,
            r"robot\.toml: model: .*none\.xml; allowed: a model file, such as arm\.xml",
        ),
        (
            'tool = "grip"',
            'tool = "gripp"',
            UnknownFrameError,
            r"did you mean 'grip'(?s:.*)\nnamed by tool of .*robot\.toml",
        ),
    ],
)
def test_a_file_that_does_not_fit_its_model_is_reported(folder, before, after, error, message):
    (folder / "robot.toml").write_text(FILE.replace(before, after))
    with pytest.raises(error, match=message):
        load_robot(folder)


def test_a_misspelt_method_is_reported_with_the_file(folder):
    (folder / "robot.toml").write_text(FILE.replace('solver = "dls"', 'solver = "dlss"'))
    robot = load_robot(folder)
    assert solver_name("lm", robot.file) == "lm"
    with pytest.raises(
        UnknownSolverError, match=r"did you mean 'dls'(?s:.*)\nnamed by solver of .*robot\.toml"
    ):
        solver_name("", robot.file)


def test_numbers_of_home_count_and_may_be_rounded_at_a_limit(folder):
    (folder / "robot.toml").write_text(FILE.replace('home = "ready"', "home = [0.3, 2.0004, 0.1]"))
    robot = load_robot(folder)
    assert robot.home.tolist() == [0.3, 2.0] and robot.qpos(robot.home)[2] == 0.1


def test_a_missing_model_is_compared_with_model_files_only(folder):
    (folder / "my_arm.toml").touch()
    with pytest.raises(ModelError, match="my_arm") as caught:
        load_robot(folder / "my_arm.xml")
    assert "my_arm.toml" not in str(caught.value)
    for wrong in ("armm.xml", "robto.toml"):
        with pytest.raises(ModelError, match=r"did you mean .*/(arm\.xml|robot\.toml)\?"):
            load_robot(folder / wrong)
