"""Every arm with six or seven axes: keyframes, motors, masses, robot.toml, markers, a reach."""

from __future__ import annotations

import itertools
import math
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from robot_ik.commands.reach import Reach
from robot_ik.robot import load_robot
from tests.models.arm_checks import check_way_from_ready, posed, site, solve, touching

MODELS = Path(__file__).parents[2] / "models"


@dataclass(frozen=True)
class Arm:
    name: str
    tool: str
    inside_deg: float  # smallest distance of a keyframe from the limits
    regular: float  # smallest distance of a keyframe from a singular pose
    down: float  # smallest cosine between the tool and the downward direction at a keyframe
    forces: tuple[float, ...]  # of the actuators, N m
    mass: Any  # of all bodies, kg
    folded_deg: tuple[float, ...]  # joint angles at which the arm touches itself

    @property
    def settings(self) -> dict[str, Any]:
        return tomllib.loads((MODELS / self.name / "robot.toml").read_text(encoding="utf-8"))

    @property
    def model(self) -> mujoco.MjModel:
        return load(self.name, f"{self.name}.xml")

    @property
    def scene(self) -> mujoco.MjModel:
        return load(self.name, "scene.xml")


@cache
def load(name: str, file: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(MODELS / name / file))


ARMS = (
    Arm(
        # Masses: Gaz et al. 2019, the hand, and the cube.
        "panda",
        "hand_tcp",
        30.0,
        0.05,
        0.999,
        (87, 87, 87, 87, 12, 12, 12),
        pytest.approx(16.062132 + 0.73 + 0.12),
        (0, 11.4592, 0, -171.8873, 0, 114.5916, 45.8366),
    ),
    Arm(
        # Torques: Armstrong, Khatib & Burdick 1986; masses: theirs, the base, and the gripper.
        "puma560",
        "gripper",
        15.0,
        0.1,
        math.sin(math.radians(40)),
        (97.6, 186.4, 89.4, 24.2, 20.1, 21.3),
        pytest.approx(17.4 + 4.8 + 0.82 + 0.34 + 0.09 + 13.0 + 0.6),
        (0, 45, 85, 0, 0, 0),
    ),
    Arm(
        "srs_arm",
        "gripper",
        30.0,
        0.05,
        0.8,
        (180, 180, 100, 100, 60, 40, 40),
        pytest.approx(17.5, abs=2.5),
        (0, 110, 0, 135, 0, 0, 0),
    ),
    Arm(
        # Masses: the maker's, and the gripper.
        "ur5e",
        "gripper",
        50.0,
        0.05,
        0.999,
        (150, 150, 150, 28, 28, 28),
        pytest.approx(17.7 + 0.6),
        (0, -90, 172, 0, 0, 0),
    ),
)
WITH_MARKERS = [arm for arm in ARMS if arm.name != "srs_arm"]


def named(arms: Any) -> Any:
    return pytest.mark.parametrize("arm", arms, ids=lambda arm: arm.name)


@named(ARMS)
@pytest.mark.parametrize("key", ["home", "ready"])
def test_keyframes_are_inside_limits_free_and_regular(arm: Arm, key: str) -> None:
    for model in (arm.model, arm.scene):
        q = model.key(key).qpos
        lower, upper = model.jnt_range.T
        assert np.minimum(q - lower, upper - q).min() > math.radians(arm.inside_deg)
        assert np.array_equal(model.key(key).ctrl, q)
        data = posed(model, q)
        assert touching(model, data) == []
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("flange").id)
        assert np.linalg.svd(jacobian, compute_uv=False).min() > arm.regular
        assert arm.down < -site(data, arm.tool)[1][2, 2] <= 1.0 + 1e-12


@named(ARMS)
def test_a_folded_arm_is_in_contact(arm: Arm) -> None:
    assert touching(arm.model, posed(arm.model, np.radians(arm.folded_deg)))


@named(ARMS)
def test_position_actuators_hold_the_ready_pose(arm: Arm) -> None:
    model = arm.scene
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("ready").id)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - model.key("ready").qpos).max() < math.radians(1.0)
    assert model.actuator_forcerange[:, 1] == pytest.approx(arm.forces)


@named(ARMS)
def test_masses_and_inertias_are_those_of_rigid_bodies(arm: Arm) -> None:
    model = arm.model
    inertia = model.body_inertia[model.body_mass > 0]
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) >= 2 * inertia.max(axis=1) - 1e-9)
    assert model.body_mass.sum() == arm.mass


@named(ARMS)
def test_robot_toml_names_what_the_model_has(arm: Arm) -> None:
    robot = load_robot(arm.name)
    model = arm.model
    settings = arm.settings
    assert robot.joints == tuple(model.joint(i).name for i in range(model.njnt))
    assert robot.tool == arm.tool and set(settings["tools"]) <= set(robot.frames)
    assert robot.home == pytest.approx(model.key(settings["home"]).qpos)
    assert tuple(settings["groups"]["arm"]) == robot.joints
    assert all(joint in robot.joints for group in settings["groups"].values() for joint in group)
    assert np.degrees(robot.velocity_limits) == pytest.approx(settings["motion"]["velocity_deg"])
    assert len(settings["motion"]["acceleration_deg"]) == robot.nv and robot.file.sources


@named(WITH_MARKERS)
def test_markers_lie_on_the_cube_with_z_outwards_and_y_along_its_z(arm: Arm) -> None:
    model = arm.model
    reach = arm.settings["reach"]["tool_marker"]
    data = posed(model, model.key("ready").qpos)
    centre, axes = site(data, reach["site"])
    assert reach["size"] < reach["cube"]
    assert model.geom("marker_cube").size == pytest.approx([reach["cube"] / 2] * 3)
    assert centre == pytest.approx(data.geom("marker_cube").xpos)
    for number, out in zip(
        reach["ids"], [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)], strict=True
    ):
        position, rotation = site(data, f"marker_{number}")
        assert rotation[:, 2] == pytest.approx(axes @ out, abs=1e-14), number
        assert rotation[:, 1] == pytest.approx(-axes[:, 2], abs=1e-14), number
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert position == pytest.approx(centre + reach["cube"] / 2 * rotation[:, 2], abs=1e-14), (
            number
        )
        # The PUMA's pictures are held to OpenCV's.
        printed = Path("assets") / f"marker_{number}.png"
        ours, pumas = (MODELS / name / printed for name in (arm.name, "puma560"))
        assert ours.read_bytes() == pumas.read_bytes()


@named(WITH_MARKERS)
def test_scene_table_is_that_of_robot_toml(arm: Arm) -> None:
    table = arm.settings["reach"]["table"]
    top = arm.scene.geom("table_top")
    centre = posed(arm.scene, arm.scene.key("ready").qpos).geom("table_top").xpos
    lower_corner = centre - top.size
    upper_corner = centre + top.size
    assert [lower_corner[0], upper_corner[0]] == pytest.approx(table["x"])
    assert [lower_corner[1], upper_corner[1]] == pytest.approx(table["y"])
    assert upper_corner[2] == pytest.approx(table["height"], abs=1e-12)


PLACES = [
    *itertools.product(["panda"], [0.42, 0.58], [-0.15, 0.0, 0.15], [-40.0, 0.0, 40.0]),
    *itertools.product(["ur5e"], [-0.25, -0.1, 0.05], [0.36, 0.56], [-90.0, 0.0, 60.0, 180.0]),
]
ELBOW = {"panda": "panda_link4", "ur5e": "forearm_link"}


@pytest.mark.parametrize(("name", "x", "y", "yaw_deg"), PLACES)
def test_markers_on_the_table_are_reached_without_contact(
    name: str, x: float, y: float, yaw_deg: float
) -> None:
    arm = next(arm for arm in ARMS if arm.name == name)
    reach = arm.settings["reach"]
    c = math.cos(math.radians(yaw_deg))
    s = math.sin(math.radians(yaw_deg))
    rotation = np.array([[c, s, 0], [s, -c, 0], [0, 0, -1.0]])
    place = np.array([x, y, reach["table"]["height"] + reach["hover"]])
    check_way_from_ready(
        arm.scene, solve(arm.scene, arm.tool, place, rotation), ELBOW[name], above=0.4
    )


@pytest.mark.parametrize("name", ["panda", "ur5e"])
def test_reach_is_reached_and_two_sides_of_the_cube_face_the_camera(name: str) -> None:
    """A complete reach on the simulated bus. The PUMA and the desk arms have separate tests."""
    report = Reach(robot=name, bus="sim").run()
    assert report.ok and not report.judged.blind
    assert report.judged.by_camera is not None and report.judged.q is not None
    assert report.judged.by_camera.position < 0.002
    data = posed(report.robot.model, report.judged.q)
    reach = next(arm for arm in ARMS if arm.name == name).settings["reach"]
    facing = 0
    for number in reach["tool_marker"]["ids"]:
        position, axes = site(data, f"marker_{number}")
        away = np.array(reach["camera"]["position"]) - position
        facing += float(away @ axes[:, 2] / np.linalg.norm(away)) > math.cos(math.radians(60))
    assert facing == 2
