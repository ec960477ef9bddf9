"""The Panda against the maker's numbers: DH product, limits, hand; identified masses."""

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

FOLDER = Path(__file__).parents[2] / "models" / "panda"
JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
# a, alpha / 90 deg, d of the maker's modified DH table; typed again here, the XML is not read.
DH = (
    (0.0, 0, 0.333),
    (0.0, -1, 0.0),
    (0.0, 1, 0.316),
    (0.0825, 1, 0.0),
    (-0.0825, -1, 0.384),
    (0.0, 1, 0.0),
    (0.088, 1, 0.0),
)
FLANGE = 0.107
# Gaz et al. 2019, in DH frame i: mass, centre of mass, inertia about it (xx, yy, zz, xy, xz, yz).
LINKS = (
    (
        4.970684,
        (0.003875, 0.002081, -0.04762),
        (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169),
    ),
    (
        0.646926,
        (-0.003141, -0.02872, 0.003495),
        (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704),
    ),
    (
        3.228604,
        (0.027518, 0.039252, -0.066502),
        (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805),
    ),
    (
        3.587895,
        (-0.05317, 0.104419, 0.027454),
        (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641),
    ),
    (
        1.225946,
        (-0.011953, 0.041065, -0.038437),
        (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229),
    ),
    (
        1.666555,
        (0.060149, -0.014117, -0.010517),
        (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341),
    ),
    (
        0.735522,
        (0.010517, -0.004252, 0.061597),
        (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741),
    ),
)


@cache
def load(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / name))


def dh_frames(q: Array) -> list[Array]:
    """DH frames 1 to 7, (4, 4) each, as Rx(alpha) Tx(a) Tz(d) Rz(q) products."""
    pose = np.eye(4)
    frames = []
    for angle, (a, turns, d) in zip(q, DH, strict=True):
        c = math.cos(angle)
        s = math.sin(angle)
        ca, sa = quarter(turns)
        pose = pose @ np.array(
            [
                [c, -s, 0, a],
                [s * ca, c * ca, -sa, -sa * d],
                [s * sa, c * sa, ca, ca * d],
                [0, 0, 0, 1.0],
            ]
        )
        frames.append(pose)
    return frames


angles = st.tuples(*(st.floats(*pair) for pair in zip(LOWER, UPPER, strict=True))).map(np.array)


@given(q=angles)
def test_flange_is_dh_frame_8(q: Array) -> None:
    position, rotation = site(posed(load("panda.xml"), q), "flange")
    expected = dh_frames(q)[-1]
    assert np.abs(position - (expected[:3, 3] + FLANGE * expected[:3, 2])).max() < 1e-12
    assert np.abs(rotation - expected[:3, :3]).max() < 1e-12


@given(q=angles)
def test_masses_are_the_identified_masses(q: Array) -> None:
    model = load("panda.xml")
    data = posed(model, q)
    for link, (frame, (mass, centre, moments)) in enumerate(zip(dh_frames(q), LINKS, strict=True)):
        xx, yy, zz, xy, xz, yz = moments
        body = model.jnt_bodyid[link]
        turn = frame[:3, :3]
        assert model.body_mass[body] == mass
        assert np.abs(data.xipos[body] - (turn @ centre + frame[:3, 3])).max() < 1e-12, link
        axes = data.ximat[body].reshape(3, 3)
        have = axes @ np.diag(model.body_inertia[body]) @ axes.T
        wanted = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        assert np.abs(have - wanted).max() < 1e-9, link


def test_known_pose_of_the_zero_configuration() -> None:
    position, rotation = site(posed(load("panda.xml"), np.zeros(7)), "flange")
    assert position == pytest.approx([0.088, 0, 0.333 + 0.316 + 0.384 - 0.107], abs=1e-15)
    assert rotation == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-15)


def test_joints_and_limits_equal_the_source() -> None:
    model = load("panda.xml")
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINTS
    assert np.all(model.jnt_limited == 1)
    assert np.array_equal(model.jnt_range, np.stack([LOWER, UPPER], axis=1))


def test_the_hand_is_rotated_by_minus_45_degrees_about_the_flange() -> None:
    data = posed(load("panda.xml"), load("panda.xml").key("ready").qpos)
    origin, rotation = site(data, "flange")
    h = math.sqrt(0.5)
    turned = np.array([[h, h, 0], [-h, h, 0], [0, 0, 1]])
    for name, offset in {"hand": 0.0, "hand_tcp": 0.1034}.items():
        position, axes = site(data, name)
        assert rotation.T @ (position - origin) == pytest.approx([0, 0, offset], abs=1e-14), name
        assert rotation.T @ axes == pytest.approx(turned, abs=1e-14), name
    axes = site(data, "hand_tcp")[1]
    # The maker's start holds the hand square to the base.
    assert axes == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-12)
