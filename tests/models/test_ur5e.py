"""The UR5e against the maker's numbers: DH product, limits, masses; its tools."""

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

FOLDER = Path(__file__).parents[2] / "models" / "ur5e"
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
LIMIT = np.array([2, 2, 1, 2, 2, 2]) * math.pi
# a, alpha / 90 deg, d of the maker's standard DH table; typed again here, the XML is not read.
DH = (
    (0.0, 1, 0.1625),
    (-0.425, 0, 0.0),
    (-0.3922, 0, 0.0),
    (0.0, 1, 0.1333),
    (0.0, -1, 0.0997),
    (0.0, 0, 0.0996),
)
# Mass and centre of mass in DH frame i, of the same page.
LINKS = (
    (3.761, (0.0, -0.02561, 0.00193)),
    (8.058, (0.2125, 0.0, 0.11336)),
    (2.846, (0.15, 0.0, 0.0265)),
    (1.37, (0.0, -0.0018, 0.01634)),
    (1.3, (0.0, 0.0018, 0.01634)),
    (0.365, (0.0, 0.0, -0.001159)),
)


@cache
def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


def dh_frames(q: Array) -> list[Array]:
    """DH frames 1 to 6, (4, 4) each, as Rz(q) Tz(d) Tx(a) Rx(alpha) products."""
    pose = np.eye(4)
    frames = []
    for angle, (a, turns, d) in zip(q, DH, strict=True):
        c = math.cos(angle)
        s = math.sin(angle)
        ca, sa = quarter(turns)
        pose = pose @ np.array(
            [
                [c, -s * ca, s * sa, a * c],
                [s, c * ca, -c * sa, a * s],
                [0, sa, ca, d],
                [0, 0, 0, 1.0],
            ]
        )
        frames.append(pose)
    return frames


angles = st.tuples(*(st.floats(-v, v) for v in LIMIT)).map(np.array)


@given(q=angles)
def test_flange_is_dh_frame_6(q: Array) -> None:
    position, rotation = site(posed(load("ur5e.xml"), q), "flange")
    expected = dh_frames(q)[-1]
    assert np.abs(position - expected[:3, 3]).max() < 1e-12
    assert np.abs(rotation - expected[:3, :3]).max() < 1e-12


@given(q=angles)
def test_masses_and_centres_are_those_of_the_maker(q: Array) -> None:
    model = load("ur5e.xml")
    data = posed(model, q)
    for link, (frame, (mass, centre)) in enumerate(zip(dh_frames(q), LINKS, strict=True)):
        body = model.jnt_bodyid[link]
        assert model.body_mass[body] == mass
        assert np.abs(data.xipos[body] - (frame[:3, :3] @ centre + frame[:3, 3])).max() < 1e-12, (
            link
        )


def test_known_pose_of_the_zero_configuration() -> None:
    position, rotation = site(posed(load("ur5e.xml"), np.zeros(6)), "flange")
    assert position == pytest.approx(
        [-0.425 - 0.3922, -0.1333 - 0.0996, 0.1625 - 0.0997], abs=1e-15
    )
    assert rotation == pytest.approx(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), abs=1e-15)


def test_joints_and_limits_equal_the_source() -> None:
    model = load("ur5e.xml")
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINTS
    assert np.all(model.jnt_limited == 1)
    assert np.abs(model.jnt_range - LIMIT[:, None] * [-1.0, 1.0]).max() < 1e-15


def test_gripper_is_rigid_to_the_flange() -> None:
    data = posed(load("ur5e.xml"), np.array([0.3, -1.2, 0.4, 2.0, 0.7, -1.1]))
    origin, rotation = site(data, "flange")
    for name, offset in {"gripper": 0.131, "marker_cube": 0.050}.items():
        position, axes = site(data, name)
        assert rotation.T @ (position - origin) == pytest.approx([0, 0, offset], abs=1e-14), name
        assert axes == pytest.approx(rotation, abs=1e-14), name
