"""The desk arm: the DH table, masses, servos and torques of its README; its fingers; its scene."""

import importlib.util
import math
import re
import sys
import tomllib
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.commands.reach import Reach
from robot_ik.hardware.config import ArmConfig
from tests.models.arm_checks import touching

Array = NDArray[np.float64]

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "models" / "tabletop_puma"
README = (FOLDER / "README.md").read_text(encoding="utf-8")
JOINTS = tuple(f"joint{i}" for i in range(1, 7))
# ROBOTIS e-manual, specification tables, kg. The README assigns the servos to the joints.
SERVO_MASS = {"XM430-W210": 0.082, "XM430-W350": 0.082, "XL430-W250": 0.0572, "XL330-M288": 0.018}


@cache
def load(name: str = "tabletop_puma.xml") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


@cache
def robot() -> rik.Robot:
    return rik.load_robot("tabletop_puma")


@cache
def arm() -> ArmConfig:
    return ArmConfig.load(FOLDER / "arm.toml")


def carrying() -> np.ndarray:
    """Return which joints of the arm file carry the tool; the others are fingers."""
    return np.array([joint.group == "arm" for joint in arm().joints])


def rows(head: str) -> list[list[str]]:
    """Return the cells of the README's table with this head."""
    lines = README[README.index(head) :].split("\n\n")[0].splitlines()[2:]
    return [
        [cell.strip().replace("−", "-") for cell in line.strip("|").split("|")] for line in lines
    ]


def dh_table() -> list[tuple[float, float, float, float, float]]:
    """a, alpha (deg), d, lower, upper (deg) of the README, joint by joint."""
    table_rows = []
    for _, a, alpha, d, span in rows("| joint | a (m)"):
        low, high = (float(part) for part in span.split("…"))
        table_rows.append((float(a), float(alpha), float(d), low, high))
    return table_rows


@cache
def torques() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "torque_table", ROOT / "docs" / "make" / "torque_table.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def posed(model: mujoco.MjModel, q: Array) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = model.key("home").qpos
    data.qpos[: len(q)] = q
    mujoco.mj_forward(model, data)
    return data


def dh_flange(q: Array) -> Array:
    pose = np.eye(4)
    for angle, (a, alpha, d, *_) in zip(q, dh_table(), strict=True):
        c = math.cos(angle)
        s = math.sin(angle)
        ca = round(math.cos(math.radians(alpha)))
        sa = round(math.sin(math.radians(alpha)))
        pose = pose @ np.array(
            [
                [c, -s * ca, s * sa, a * c],
                [s, c * ca, -c * sa, a * s],
                [0, sa, ca, d],
                [0, 0, 0, 1.0],
            ]
        )
    return pose


@given(q=st.tuples(*(st.floats(-3.9, 3.9) for _ in JOINTS)).map(np.array))
def test_flange_is_frame_6_of_the_dh_table_in_the_readme(q: Array) -> None:
    data = posed(load(), q)
    expected = dh_flange(q)
    assert np.abs(data.site("flange").xpos - expected[:3, 3]).max() < 1e-12
    assert np.abs(data.site("flange").xmat.reshape(3, 3) - expected[:3, :3]).max() < 1e-12
    gripper = expected[:3, 3] + 0.114 * expected[:3, 2]
    assert np.abs(data.site("gripper").xpos - gripper).max() < 1e-12


def test_lengths_are_the_scaled_lengths_of_the_puma() -> None:
    puma = {"a2": 0.4318, "a3": 0.0203, "d3": 0.15005, "d4": 0.4318}
    table = dh_table()
    ours = {"a2": table[1][0], "a3": table[2][0], "d3": table[2][2], "d4": table[3][2]}
    assert ours == {name: round(0.29 * length, 3) for name, length in puma.items()}
    reach = table[1][0] + math.hypot(table[2][0], table[3][2]) + 0.114
    assert reach == pytest.approx(0.364, abs=1e-3) and "0.36 m" in README


def test_limits_are_those_of_the_readme_and_of_the_arm_file() -> None:
    ranges = np.radians([row[3:] for row in dh_table()])
    assert robot().joints == JOINTS == tuple(np.array(arm().names)[carrying()])
    assert arm().servo_ids[:6] == (1, 2, 3, 4, 5, 6)
    np.testing.assert_allclose(np.stack([robot().lower, robot().upper], axis=1), ranges, atol=1e-12)
    limits = np.stack([arm().lower, arm().upper], axis=1)[carrying()]
    np.testing.assert_allclose(limits, ranges, atol=1e-12)
    for joint in arm().joints:  # inside one turn of the servo, with room for a wrong zero
        first, last = joint.ticks_range()
        assert 50 <= first < last <= 4045, joint.name


def test_masses_are_those_of_the_readme_and_of_the_servo_maker() -> None:
    model = load()
    reported = {name.strip("`"): float(grams) / 1000 for name, grams in rows("| body | mass")}
    have = {model.body(b).name: float(model.body_mass[b]) for b in range(model.nbody)}
    assert {name: round(mass, 4) for name, mass in have.items() if mass > 0} == pytest.approx(
        reported
    )
    assert "0.68 kg" in README and sum(have.values()) == pytest.approx(0.675, abs=0.005)
    inertia = model.body_inertia[model.body_mass > 0]
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) > 2 * inertia.max(axis=1))
    for joint in arm().joints:
        body = model.body(model.geom(f"servo{joint.servo.id}").bodyid[0])
        assert body.mass[0] > SERVO_MASS[joint.servo.model]
        table = next(row for row in rows("| servo | mass") if row[0] == joint.servo.model)
        assert float(table[1]) / 1000 == SERVO_MASS[joint.servo.model]
        size = sorted(float(edge) for edge in re.findall(r"[\d.]+", table[2]))
        assert sorted(2000 * model.geom(f"servo{joint.servo.id}").size) == pytest.approx(size)


def test_servos_of_the_readme_are_those_of_the_arm_file() -> None:
    reported = {
        joint: (servo, float(turns.split(",")[0]), float(free), float(used))
        for names, servo, turns, free, used in rows("| joint | servo | turns")[:5]
        for joint in names.split(", ")
    }
    joints = [joint for joint in arm().joints if joint.group == "arm"]
    for joint, speed in zip(joints, robot().velocity_limits, strict=True):
        servo, ratio, free, used = reported[joint.name.removeprefix("joint")]
        assert (joint.servo.model, joint.gear.ratio) == (servo, ratio)
        assert math.degrees(speed) == pytest.approx(used)
        assert math.degrees(joint.servo.table.motor.no_load_speed) / ratio == pytest.approx(
            free, abs=0.6
        )
        assert used <= free / 2
        row = next(row for row in rows("| servo | mass") if row[0] == servo)
        assert float(row[3].split()[0]) == joint.servo.table.motor.stall_torque
        assert float(row[4].split()[0]) == joint.servo.table.motor.no_load_rpm
        force = load().actuator(joint.name).forcerange[1]
        assert force == pytest.approx(joint.servo.table.motor.stall_torque * ratio)
        assert joint.velocity >= speed
    assert np.all(arm().acceleration[carrying()] >= robot().acceleration_limits)


def test_the_torque_table_of_the_readme_is_up_to_date() -> None:
    assert torques().filled(README) == README, "run: python docs/make/torque_table.py"
    assert "| `joint6` |" in README


def test_torques_leave_the_margins_that_the_readme_promises() -> None:
    make = torques()
    load_ = make.loads(robot(), make.loaded_model(robot()), poses=500, seed=1)
    can = make.strength(robot(), arm())
    assert np.all(load_.still.max(axis=0) < can.stall / 2)
    assert np.all(load_.still.max(axis=0) < can.continuous)
    assert np.all(load_.moving.max(axis=0) < can.at_speed)


def test_static_loads_equal_the_moment_of_the_later_links() -> None:
    """Stretched out level, joint 2 carries all later links: a moment of masses and positions."""
    make = torques()
    model = make.loaded_model(robot())
    q = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])
    data = mujoco.MjData(model)
    data.qpos[:] = robot().qpos(q)
    mujoco.mj_inverse(model, data)
    moved = range(model.body("link2").id, model.nbody)
    moment = sum(9.81 * model.body_mass[b] * (data.xipos[b, 0] - 0.0) for b in moved)
    assert data.qfrc_inverse[1] == pytest.approx(moment, rel=1e-9)
    assert sum(model.body_mass) - sum(load().body_mass) == pytest.approx(0.1)


def test_analytic_has_eight_branches() -> None:
    q = np.radians([40.0, 70.0, -140.0, 60.0, 50.0, -30.0])
    pose = robot().forward(q, "flange")
    goal = rik.PoseGoal("flange", pose.position, pose.wxyz)
    branches = rik.solve_all(robot(), goal, limits=False)
    assert len({branch.name for branch in branches}) == 8
    assert any(branch.inside and np.abs(branch.q - q).max() < 1e-9 for branch in branches)
    for branch in branches:
        far = robot().measure(branch.q, "flange").distance(pose)
        assert max(far) < 1e-9, branch.name


def test_the_right_finger_follows_the_left() -> None:
    fingers = rik.load_robot("tabletop_puma", joints="gripper", tool="finger_right")
    assert fingers.joints == ("finger_left", "finger_right")
    np.testing.assert_allclose(fingers.apply_couplings([0.012, 0.0]), [0.012, 0.012])
    place = fingers.forward(fingers.home).position + 0.004 * fingers.jacobian(fingers.home)[:3].sum(
        axis=1
    )
    solution = rik.solve(fingers, rik.PositionGoal("finger_right", place), solver="lm")
    assert solution.converged
    np.testing.assert_allclose(solution.q, [0.013, 0.013], atol=2e-4)
    model = load()
    data = posed(model, robot().home)
    data.ctrl[:] = model.key("home").ctrl
    data.ctrl[6] = 0.015
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert data.joint("finger_left").qpos[0] == pytest.approx(0.015, abs=1e-3)
    assert data.joint("finger_right").qpos[0] == pytest.approx(
        data.joint("finger_left").qpos[0], abs=1e-4
    )
    assert np.abs(data.qpos[:6] - robot().home).max() < math.radians(1)


@pytest.mark.parametrize("xml", ["tabletop_puma.xml", "scene.xml"])
def test_home_is_free_and_far_from_the_limits(xml: str) -> None:
    model = load(xml)
    home = model.key("home").qpos
    assert touching(model, posed(model, home)) == []
    lower, upper = model.jnt_range[:6].T
    assert np.minimum(home[:6] - lower, upper - home[:6]).min() > math.radians(15)
    np.testing.assert_allclose(np.degrees(home[:6]), [0, 75, -165, 0, -90, 0], atol=1e-9)


def test_a_gripper_folded_onto_the_shoulder_is_in_contact() -> None:
    assert touching(load(), posed(load(), np.radians([0.0, 90.0, -225.0, 0.0, -100.0, 0.0])))


def test_scene_table_and_markers_are_those_of_robot_toml() -> None:
    scene: dict[str, Any] = tomllib.loads((FOLDER / "robot.toml").read_text(encoding="utf-8"))[
        "reach"
    ]
    model = load("scene.xml")
    data = posed(model, robot().home)
    top = model.geom("table_top")
    low = data.geom("table_top").xpos - top.size
    high = data.geom("table_top").xpos + top.size
    assert [low[0], high[0], low[1], high[1], high[2]] == pytest.approx(
        [*scene["table"]["x"], *scene["table"]["y"], scene["table"]["height"]], abs=1e-12
    )
    cube = scene["tool_marker"]
    assert model.geom("marker_cube").size == pytest.approx([cube["cube"] / 2] * 3)
    centre = data.site(cube["site"]).xpos
    axes = data.site(cube["site"]).xmat.reshape(3, 3)
    for number, out in zip(
        cube["ids"], [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)], strict=True
    ):
        side = data.site(f"marker_{number}")
        turn = side.xmat.reshape(3, 3)
        assert turn[:, 2] == pytest.approx(axes @ out, abs=1e-12), number
        assert turn[:, 1] == pytest.approx(-axes[:, 2], abs=1e-12), number
        assert side.xpos == pytest.approx(centre + cube["cube"] / 2 * turn[:, 2], abs=1e-12), number


@pytest.mark.parametrize("place", [None, (0.22, 0.10, 0.0, 220.0), (0.11, -0.10, 0.0, 140.0)])
def test_reach_on_simulated_servos(place: tuple[float, float, float, float] | None) -> None:
    report = Reach(robot="tabletop_puma", bus="sim", marker_at=place or ()).run()
    assert report.ok, report.error or report.verdict
    assert report.setup.config is not None and report.setup.config.robot == "tabletop_puma"
    assert report.trajectory is not None
    scene = load("scene.xml")
    for q in report.trajectory.q[::5]:
        assert touching(scene, posed(scene, q)) == []
