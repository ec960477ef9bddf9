"""Arms that people own: tables of their READMEs, the maker's numbers, five joints, scenes."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.commands.reach import Reach
from robot_ik.hardware.config import ArmConfig
from robot_ik.workcell.scene import reach_table
from tests.models.arm_checks import touching

Array = NDArray[np.float64]

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class OwnedArm:
    """A model folder, with the data that the tests need.

    Attributes:
        name: Of the folder.
        base: Rotation of the base's frame in the world, (3, 3).
    """

    name: str
    base: tuple[tuple[float, float, float], ...] = (
        (1.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
    )

    @property
    def folder(self) -> Path:
        return Path(__file__).parents[2] / "models" / self.name

    @cached_property
    def readme(self) -> str:
        return (self.folder / "README.md").read_text(encoding="utf-8")

    @cached_property
    def robot(self) -> rik.Robot:
        return rik.load_robot(self.name)

    @cached_property
    def config(self) -> ArmConfig:
        return ArmConfig.load(self.folder / "arm.toml")

    @cached_property
    def model(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_path(str(self.folder / f"{self.name}.xml"))

    @cached_property
    def scene(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_path(str(self.folder / "scene.xml"))

    def rows(self, head: str) -> list[list[str]]:
        """Return the cells of the README's table with this head."""
        lines = self.readme[self.readme.index(head) :].split("\n\n")[0].splitlines()[2:]
        return [
            [cell.strip().strip("`").replace("−", "-") for cell in line.strip("|").split("|")]
            for line in lines
        ]

    @cached_property
    def chain(self) -> list[tuple[str, Array, Array, tuple[float, float] | None]]:
        """Joint or fixed frame, axis in the base, origin in its parent, range in degrees."""
        found = []
        for name, axis, origin, span in self.rows("| joint | axis"):
            sign = -1.0 if axis.startswith("-") else 1.0
            ends = [float(part) for part in span.split("…")] if "…" in span else None
            direction = (
                sign * np.array(AXES[axis.lstrip("-")]) if axis.lstrip("-") in AXES else np.zeros(3)
            )
            place = np.array([float(part) for part in origin.split(",")])
            found.append((name, direction, place, None if ends is None else (ends[0], ends[1])))
        return found

    def tool(self, q: Array) -> tuple[Array, Array]:
        """Pose of the last frame of the README's table. At q = 0 all frames are parallel."""
        rotation = np.array(self.base)
        position = np.zeros(3)
        joints = iter(q)
        for _, axis, place, ends in self.chain:
            position = position + rotation @ place
            if ends is not None:
                rotation = rotation @ _turn(axis, float(next(joints)))
        return position, rotation

    def posed(self, q: Array, model: mujoco.MjModel | None = None) -> mujoco.MjData:
        """MuJoCo at ``q`` (nq,) of the arm, gripper as at home."""
        model = self.model if model is None else model
        data = mujoco.MjData(model)
        data.qpos[:] = model.key("home").qpos
        data.qpos[: len(q)] = q
        mujoco.mj_forward(model, data)
        return data


def _turn(axis: Array, angle: float) -> Array:
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


ARMS = {
    "wx250s": OwnedArm("wx250s"),
    "vx300s": OwnedArm("vx300s"),
    "omx_f": OwnedArm("omx_f"),
    "koch_v11": OwnedArm("koch_v11", ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))),
}
SIX = ("vx300s", "wx250s")
FIVE = ("koch_v11", "omx_f")
# The last frame of the README's table: the maker's, with x along the approach. A Koch has none.
FRAMES = {
    "wx250s": "ee_gripper",
    "vx300s": "ee_gripper",
    "omx_f": "end_effector",
    "koch_v11": "gripper",
}


@pytest.fixture(params=sorted(ARMS))
def arm(request: pytest.FixtureRequest) -> OwnedArm:
    return ARMS[request.param]


# The maker's numbers


def test_the_tool_is_where_the_readmes_table_puts_it(arm: OwnedArm) -> None:
    rng = np.random.default_rng(1)
    for q in (np.zeros(arm.robot.nq), *rng.uniform(-3.0, 3.0, (20, arm.robot.nq))):
        site = arm.posed(q).site(FRAMES[arm.name])
        position, rotation = arm.tool(q)
        assert np.abs(site.xpos - position).max() < 1e-12
        if arm.name != "koch_v11":  # whose tool is turned against the base
            assert np.abs(site.xmat.reshape(3, 3) - rotation).max() < 1e-12


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("wx250s", (0.458325, 0.0, 0.36065)),  # the handbook's M matrix
        ("vx300s", (0.536494, 0.0, 0.42705)),
        ("omx_f", (0.31288, -0.0016, 0.21065)),  # of the maker's URDF
    ],
)
def test_the_makers_frame_at_zero(name: str, place: tuple[float, float, float]) -> None:
    pose = ARMS[name].robot.measure(np.zeros(ARMS[name].robot.nq), FRAMES[name])
    np.testing.assert_allclose(pose.position, place, atol=1e-12)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-12)


# Screw axes in the base's frame: (axis, -axis x point), from the handbook's Slist of each arm.
SCREWS = {
    "wx250s": [
        (0, 0, 1, 0, 0, 0),
        (0, 1, 0, -0.11065, 0, 0),
        (0, 1, 0, -0.36065, 0, 0.04975),
        (1, 0, 0, 0, 0.36065, 0),
        (0, 1, 0, -0.36065, 0, 0.29975),
        (1, 0, 0, 0, 0.36065, 0),
    ],
    "vx300s": [
        (0, 0, 1, 0, 0, 0),
        (0, 1, 0, -0.12705, 0, 0),
        (0, 1, 0, -0.42705, 0, 0.05955),
        (1, 0, 0, 0, 0.42705, 0),
        (0, 1, 0, -0.42705, 0, 0.35955),
        (1, 0, 0, 0, 0.42705, 0),
    ],
}


@pytest.mark.parametrize("name", SIX)
def test_the_screw_axes_are_the_handbooks(name: str) -> None:
    model = ARMS[name].model
    data = ARMS[name].posed(np.zeros(6))
    for joint, screw in zip(ARMS[name].robot.joints, SCREWS[name], strict=True):
        axis = data.joint(joint).xaxis
        point = data.joint(joint).xanchor
        np.testing.assert_allclose([*axis, *-np.cross(axis, point)], screw, atol=1e-12)
    assert model.nkey == 2


def test_the_tool_looks_along_the_approach_and_the_fingers_open_along_y(arm: OwnedArm) -> None:
    pose = arm.robot.measure(np.zeros(arm.robot.nq))
    np.testing.assert_allclose(pose.rotation[:, 2], [1.0, 0.0, 0.0], atol=1e-12)  # forward at q = 0
    fingers = rik.load_robot(arm.name, joints="gripper")
    names = [
        n
        for n in ("left_finger_link", "finger_link1", "gripper_moving_finger")
        if n in fingers.frames
    ]
    data, wide = (arm.posed(np.zeros(arm.robot.nq)) for _ in range(2))
    joint = arm.config.group("gripper")[0]
    low, high = sorted(joint.limits, key=lambda end: abs(end - joint.value(2048)))
    for d, q in ((data, low), (wide, high)):
        d.joint(joint.name).qpos[:] = q
        mujoco.mj_forward(arm.model, d)
    tip = np.array([0.05 if arm.name != "koch_v11" else -0.05, 0.0, 0.0])
    opened = [
        d.body(names[0]).xpos + d.body(names[0]).xmat.reshape(3, 3) @ tip for d in (data, wide)
    ]
    way = pose.rotation.T @ (opened[1] - opened[0])
    assert abs(way[1]) > 0.01 and abs(way[1]) > 0.5 * abs(way[2])


def test_limits_servos_and_speeds_agree(arm: OwnedArm) -> None:
    table = {name: ends for name, _, _, ends in arm.chain if ends is not None}
    robot = arm.robot
    config = arm.config.chain
    assert tuple(table) == robot.joints == config.names
    spans = np.radians(list(table.values()))
    np.testing.assert_allclose(np.stack([robot.lower, robot.upper], axis=1), spans, atol=2e-6)
    # The arm file's range is never wider than that of the model, and a few ticks narrower at most.
    assert np.all(config.lower >= robot.lower - 1e-9) and np.all(config.upper <= robot.upper + 1e-9)
    assert np.all(config.upper - config.lower > 0.999 * (robot.upper - robot.lower) - 0.004)
    assert np.all(config.velocity >= robot.velocity_limits)
    assert np.all(config.acceleration >= robot.acceleration_limits)
    for joint in config.joints:
        servos = len(joint.servos)
        motor = joint.servo.table.motor
        assert arm.model.actuator(joint.name).forcerange[1] == pytest.approx(
            servos * motor.stall_torque
        )
        assert joint.velocity <= 0.5 * motor.no_load_speed, joint.name


def test_the_servos_of_the_readme_are_those_of_the_arm_file(arm: OwnedArm) -> None:
    rows = {row[0]: row[1:3] for row in arm.rows("| joint | id | servo |")}
    assert list(rows) == [joint.name for joint in arm.config.joints]
    for joint in arm.config.joints:
        ids, model = rows[joint.name]
        reported = [int(number) for number in re.findall(r"\d+", ids)]
        assert (reported, model) == ([servo.id for servo in joint.servos], joint.servo.model)


@pytest.mark.parametrize("name", SIX)
def test_drive_modes_of_the_readme_are_those_of_the_arm_file(name: str) -> None:
    for joint, row in zip(
        ARMS[name].config.joints, ARMS[name].rows("| joint | id | servo |"), strict=True
    ):
        bits = [bool(int(number)) for number in re.findall(r"\d+", row[3])]
        assert bits == [servo.reverse for servo in joint.servos]


def test_masses_are_those_of_the_readme_and_inertias_those_of_bodies(arm: OwnedArm) -> None:
    reported = {name: float(grams) / 1000 for name, grams in arm.rows("| body | mass")}
    model = arm.model
    have = {model.body(b).name: float(model.body_mass[b]) for b in range(1, model.nbody)}
    assert have == pytest.approx(reported, abs=6e-5)
    inertia = model.body_inertia[1:]
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) > 1.998 * inertia.max(axis=1))


# The model


def test_every_keyframe_is_inside_the_limits_and_touches_nothing(arm: OwnedArm) -> None:
    for model in (arm.model, arm.scene):
        assert model.nkey >= 1
        for k in range(model.nkey):
            qpos = np.array(model.key(k).qpos)
            assert touching(model, arm.posed(qpos, model)) == [], model.key(k).name
            lower, upper = model.jnt_range.T
            assert np.all(qpos >= lower) and np.all(qpos <= upper), model.key(k).name


def test_an_arm_folded_into_itself_is_in_contact(arm: OwnedArm) -> None:
    """Some random poses touch and most do not, so the number of exclusions is plausible."""
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(300):
        hits += bool(touching(arm.model, arm.posed(arm.robot.sample(rng))))
    assert 5 <= hits <= 120


def test_the_actuators_hold_the_home_pose(arm: OwnedArm) -> None:
    data = arm.posed(arm.robot.home)
    data.ctrl[:] = arm.model.key("home").ctrl
    for _ in range(500):
        mujoco.mj_step(arm.model, data)
    assert np.abs(data.qpos[: arm.robot.nq] - arm.robot.home).max() < math.radians(2)


@pytest.mark.parametrize("name", ["omx_f", "vx300s", "wx250s"])
def test_the_second_finger_follows_the_first_the_other_way_round(name: str) -> None:
    fingers = rik.load_robot(name, joints="gripper")
    low, high = ARMS[name].config.group("gripper")[0].limits
    wanted = 0.25 * low + 0.75 * high
    np.testing.assert_allclose(fingers.apply_couplings([wanted, 0.0]), [wanted, -wanted])


# Six joints, and five


@pytest.mark.parametrize("name", SIX)
def test_six_joints_have_all_branches_in_closed_form(name: str) -> None:
    robot = ARMS[name].robot
    q = np.radians([20.0, -30.0, 40.0, 50.0, 35.0, -60.0])
    goal = rik.PoseGoal.at(None, robot.forward(q))
    branches = rik.solve_all(robot, goal, limits=False)
    assert len({branch.name for branch in branches}) == 8
    assert any(branch.inside and np.abs(branch.q - q).max() < 1e-9 for branch in branches)
    assert rik.solve(robot, goal).solver == "analytic"


@pytest.mark.parametrize("name", FIVE)
def test_five_joints_reach_a_position_with_one_axis_but_not_every_pose(name: str) -> None:
    robot = ARMS[name].robot
    rng = np.random.default_rng(2)
    for k in range(30):
        pose = robot.forward(robot.sample(rng))
        goal = rik.PoseGoal(None, pose.position, pose.wxyz, free_axis="z")
        found = rik.solve(robot, goal, seed=k)
        assert found.converged and found.error.position < 1e-4 and found.error.angle < 1e-3
    # The tool axis is outside the vertical plane of the arm, which is impossible at any position.
    side = rik.PoseGoal(
        None, robot.forward(robot.home).position, (0.5, -0.5, 0.5, 0.5), free_axis="z"
    )
    assert not rik.solve(robot, side).converged


@pytest.mark.parametrize("name", FIVE)
def test_the_code_in_the_readme_of_a_five_joint_arm_runs(name: str) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", ARMS[name].readme, re.DOTALL)
    exec(compile(code, f"{name}/README.md", "exec"), {})


# The scene

PLACES = {
    "wx250s": [None, (0.22, 0.06, 0.0, 160.0)],
    "vx300s": [None, (0.30, 0.06, 0.0, 160.0)],
    "omx_f": [None, (0.15, 0.04, 0.0, 160.0)],
    "koch_v11": [None, (0.13, -0.05, 0.0, 200.0)],
}


@pytest.mark.parametrize(
    ("name", "place"),
    [
        pytest.param(name, place, marks=[pytest.mark.soak] * (place is None))
        for name in sorted(PLACES)
        for place in PLACES[name]
    ],
)
def test_reach_on_simulated_servos_without_a_contact(
    name: str, place: tuple[float, ...] | None
) -> None:
    arm = ARMS[name]
    report = Reach(robot=name, bus="sim", marker_at=place or ()).run()
    assert report.ok, report.error or report.verdict
    assert report.setup.config is not None and report.setup.config.robot == name
    assert isinstance(report.goal, rik.PoseGoal) and report.judged.by_camera is not None
    assert report.goal.free_axis == ("z" if name in FIVE else None)
    assert report.judged.q is not None and report.trajectory is not None
    down = arm.robot.measure(report.judged.q).rotation[:, 2]
    assert down[2] < -0.9998  # it faces the marker on the table, to a degree
    for q in report.trajectory.q[::5]:
        assert touching(arm.scene, arm.posed(np.array(q), arm.scene)) == []


def test_the_scenes_table_is_that_of_robot_toml(arm: OwnedArm) -> None:
    scene = reach_table(arm.robot)
    assert scene is not None and scene.table is not None
    data = arm.posed(arm.robot.home, arm.scene)
    top = arm.scene.geom("table_top")
    low = data.geom("table_top").xpos - top.size
    high = data.geom("table_top").xpos + top.size
    assert [low[0], high[0], low[1], high[1], high[2]] == pytest.approx(
        [*scene.table.x, *scene.table.y, scene.table.height], abs=1e-12
    )
