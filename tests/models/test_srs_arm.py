"""The seven-axis limb: its DH product, shoulder and wrist with three axes through one point."""

import math
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.models.arm_checks import posed, quarter, site

Array = NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "models" / "srs_arm"
JOINTS = tuple(f"joint{i}" for i in range(1, 8))
LIMIT = np.radians([170.0, 115.0, 170.0, 135.0, 170.0, 115.0, 175.0])
# alpha / 90 deg and d of the README's standard DH table (every a is 0). Not read from the XML.
DH = ((-1, 0.36), (1, 0.0), (-1, 0.42), (1, 0.0), (-1, 0.40), (1, 0.0), (0, 0.126))


@cache
def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


def dh_flange(q: Array) -> Array:
    """DH frame 7, (4, 4), as Rz(q) Tz(d) Rx(alpha) products."""
    pose = np.eye(4)
    for angle, (turns, d) in zip(q, DH, strict=True):
        c = math.cos(angle)
        s = math.sin(angle)
        ca, sa = quarter(turns)
        pose = pose @ np.array(
            [[c, -s * ca, s * sa, 0], [s, c * ca, -c * sa, 0], [0, sa, ca, d], [0, 0, 0, 1.0]]
        )
    return pose


angles = st.tuples(*(st.floats(-v, v) for v in LIMIT)).map(np.array)


@given(q=angles)
def test_flange_is_dh_frame_7(q: Array) -> None:
    position, rotation = site(posed(load("srs_arm.xml"), q), "flange")
    expected = dh_flange(q)
    assert np.abs(position - expected[:3, 3]).max() < 1e-12
    assert np.abs(rotation - expected[:3, :3]).max() < 1e-12


@given(q=angles)
def test_shoulder_and_wrist_are_points_and_the_elbow_has_no_offset(q: Array) -> None:
    data = posed(load("srs_arm.xml"), q)
    anchor = data.xanchor
    axis = data.xaxis
    shoulder = anchor[0]
    elbow = anchor[3]
    wrist = anchor[4]
    assert np.array_equal(anchor[1], shoulder) and np.array_equal(anchor[2], shoulder)
    assert np.array_equal(anchor[5], wrist) and np.array_equal(anchor[6], wrist)
    assert shoulder == pytest.approx([0, 0, 0.36], abs=1e-15)
    assert axis[2] == pytest.approx((elbow - shoulder) / 0.42, abs=1e-12)
    assert axis[4] == pytest.approx((wrist - elbow) / 0.40, abs=1e-12)
    for k in (0, 1, 4, 5):
        assert axis[k] @ axis[k + 1] == pytest.approx(0, abs=1e-12)
    between = math.sqrt(0.42**2 + 0.40**2 + 2 * 0.42 * 0.40 * math.cos(q[3]))
    assert np.linalg.norm(wrist - shoulder) == pytest.approx(between, abs=1e-12)


def test_the_elbow_swivels_without_moving_the_hand() -> None:
    """One degree of freedom remains at every pose, and it moves the elbow."""
    model = load("srs_arm.xml")
    data = posed(model, model.key("ready").qpos)
    jacobian = np.zeros((6, 7))
    elbow = np.zeros((3, 7))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("flange").id)
    mujoco.mj_jac(model, data, elbow, None, data.body("link4").xpos, model.body("link4").id)
    free = np.linalg.svd(jacobian)[2][-1]
    assert np.abs(jacobian @ free).max() < 1e-12
    assert np.linalg.norm(elbow @ free) > 0.05  # m per unit of the freedom


def test_known_pose_upright() -> None:
    position, rotation = site(posed(load("srs_arm.xml"), np.zeros(7)), "flange")
    assert position == pytest.approx([0, 0, 0.36 + 0.42 + 0.40 + 0.126], abs=1e-15)
    assert rotation == pytest.approx(np.eye(3), abs=1e-15)


def test_joints_and_limits_are_those_of_the_readme() -> None:
    model = load("srs_arm.xml")
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINTS
    assert np.abs(model.jnt_range - LIMIT[:, None] * [-1.0, 1.0]).max() < 1e-15
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    for joint, (limit, (_, d)) in enumerate(zip(np.degrees(LIMIT), DH, strict=True), 1):
        row = next(line.split("|") for line in text.splitlines() if line.startswith(f"| {joint} |"))
        assert float(row[4]) == d and row[5].strip() == f"±{limit:.0f}"
