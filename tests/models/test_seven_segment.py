"""The thesis' arm of seven segments: product of rotations, hinges through one point, limits."""

import math
import tomllib
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from robot_ik.robot import load_robot
from tests.models.arm_checks import posed

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "models" / "seven_segment"
JOINTS = tuple(f"joint{i}_{axis}" for i in range(1, 8) for axis in ("x", "z", "twist"))
LIMIT = math.radians(45.0)  # the thesis, table 4.1, cases 3 and 4
FILES = ("seven_segment.xml", "limited.xml", "scene.xml")


@cache
def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


def contacts(model: mujoco.MjModel, q: Array) -> int:
    return int(posed(model, q).ncon)


def turn(axis: int, angle: float) -> Array:
    c = math.cos(angle)
    s = math.sin(angle)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    rotation = np.eye(3)
    rotation[i, i] = rotation[j, j] = c
    rotation[i, j] = -s
    rotation[j, i] = s
    return rotation


def tip(q: Array) -> tuple[Array, Array]:
    """Rx(90 deg) then Rx Rz Ry Ty(1) for each segment, the XML is not read."""
    position = np.zeros(3)
    rotation = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for x, z, y in q.reshape(7, 3):
        rotation = rotation @ turn(0, x) @ turn(2, z) @ turn(1, y)
        position = position + rotation[:, 1]
    return position, rotation


angles = st.tuples(*[st.floats(-math.pi, math.pi)] * 21).map(np.array)


@pytest.mark.parametrize("file", FILES)
@given(q=angles)
def test_tip_is_the_product_of_its_segments(file: str, q: Array) -> None:
    tip_site = posed(load(file), q).site("tip")
    position, rotation = tip(q)
    assert np.abs(tip_site.xpos - position).max() < 1e-12
    assert np.abs(tip_site.xmat.reshape(3, 3) - rotation).max() < 1e-12


@given(q=angles)
def test_hinges_of_a_joint_meet_in_a_point_and_segments_are_a_metre(q: Array) -> None:
    data = posed(load("seven_segment.xml"), q)
    joints = data.xanchor.reshape(7, 3, 3)
    assert np.abs(joints - joints[:, :1]).max() < 1e-14
    ends = np.vstack([joints[:, 0], data.site("tip").xpos])
    assert np.linalg.norm(np.diff(ends, axis=0), axis=1) == pytest.approx(np.ones(7), abs=1e-12)
    twists = data.xaxis.reshape(7, 3, 3)[:, 2]
    assert np.abs(twists - np.diff(ends, axis=0)).max() < 1e-12  # the twist is about the bone


def test_upright_at_zero_and_the_last_twist_moves_no_point() -> None:
    model = load("seven_segment.xml")
    assert posed(model, np.zeros(21)).site("tip").xpos == pytest.approx([0, 0, 7], abs=1e-14)
    q = model.key("home").qpos.copy()
    before = posed(model, q).site("tip").xpos.copy()
    q[-1] += 1.0
    assert posed(model, q).site("tip").xpos == pytest.approx(before, abs=1e-12)


def test_the_bundled_arm_has_no_limits_and_its_variant_has_them() -> None:
    free = load_robot("seven_segment")
    limited = load_robot(FOLDER / "limited.xml")
    assert free.joints == limited.joints == JOINTS and free.tool == limited.tool == "tip"
    assert np.all(np.isinf(free.lower)) and np.all(np.isinf(free.upper))
    bend = np.where([joint.endswith("twist") for joint in JOINTS], np.inf, LIMIT)
    assert np.array_equal(limited.lower, -bend) and np.array_equal(limited.upper, bend)
    narrowed = free.with_limits(-bend, bend)
    assert np.array_equal(narrowed.lower, limited.lower) and np.array_equal(
        narrowed.upper, limited.upper
    )
    assert np.array_equal(narrowed.home, limited.home) and np.array_equal(free.home, limited.home)


def test_the_code_in_the_readme_builds_the_limited_arm() -> None:
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    names: dict[str, object] = {}
    exec(text.split("```python\n")[1].split("```")[0], names)
    made = names["limited"]
    assert np.array_equal(made.upper, load_robot(FOLDER / "limited.xml").upper)  # type: ignore[attr-defined]


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("key", ["home", "ready"])
def test_keyframes_are_inside_the_limits_free_and_regular(file: str, key: str) -> None:
    model = load(file)
    q = model.key(key).qpos
    assert np.abs(q.reshape(7, 3)[:, :2]).max() < LIMIT - math.radians(3)
    assert np.array_equal(model.key(key).ctrl, q)
    data = posed(model, q)
    assert data.ncon == 0
    jacobian = np.zeros((6, 21))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("tip").id)
    assert np.linalg.svd(jacobian, compute_uv=False).min() > 0.5


def test_a_rolled_up_arm_is_in_contact_and_a_leaning_arm_is_not() -> None:
    model = load("seven_segment.xml")
    bends = np.arange(21) % 3 == 1
    assert (
        contacts(model, np.zeros(21))
        == contacts(model, np.where(bends, -math.radians(15), 0.0))
        == 0
    )
    assert contacts(model, np.where(bends, -math.radians(85), 0.0)) > 0


def test_masses_and_inertias_are_those_of_rigid_bodies() -> None:
    model = load("seven_segment.xml")
    inertia = model.body_inertia[model.body_mass > 0]
    assert len(inertia) == 7
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) >= 2 * inertia.max(axis=1))
    assert np.all(np.diff(model.body_mass[model.body_mass > 0]) < 0)


def test_position_actuators_hold_the_arch() -> None:
    model = load("scene.xml")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    for _ in range(300):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - model.key("home").qpos).max() < math.radians(5)


def test_robot_toml_names_what_the_model_has() -> None:
    robot = load_robot("seven_segment")
    groups = tomllib.loads((FOLDER / "robot.toml").read_text(encoding="utf-8"))["groups"]
    assert robot.tool == "tip" and {"tip", "palm", "gripper"} <= set(robot.frames)
    assert tuple(groups["arm"]) == JOINTS
    assert set(groups["x"]) | set(groups["z"]) == set(groups["bends"])
    assert set(groups["bends"]) | set(groups["twist"]) == set(JOINTS)
    assert len(load_robot("seven_segment", joints="bends").joints) == 14
    assert np.array_equal(robot.home, robot.model.key("home").qpos) and robot.file.sources
