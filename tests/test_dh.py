"""``from_dh``: against products of DH matrices and published tables, by MuJoCo's kinematics."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import robot_ik as rik
from robot_ik.chain import DHRow, from_dh
from robot_ik.errors import OptionError
from robot_ik.geometry import Pose

HALF = math.pi / 2
NUMBER = st.floats(-1.0, 1.0)
ANGLE = st.floats(-3.0, 3.0)
ROW = st.builds(
    DHRow,
    a=NUMBER,
    alpha=ANGLE,
    d=NUMBER,
    theta=ANGLE,
    joint=st.sampled_from(["revolute", "prismatic"]),
)


def rotation_x(angle):
    c = math.cos(angle)
    s = math.sin(angle)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def rotation_z(angle):
    c = math.cos(angle)
    s = math.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def translation(x, z):
    matrix = np.eye(4)
    matrix[0, 3] = x
    matrix[2, 3] = z
    return matrix


def dh_matrix(row, value, convention):
    """Return A_i of the literature."""
    theta = row.theta
    d = row.d
    if row.joint == "revolute":
        theta += value
    else:
        d += value
    if convention == "standard":
        factors = (
            rotation_z(theta),
            translation(0, d),
            translation(row.a, 0),
            rotation_x(row.alpha),
        )
    else:
        factors = (
            rotation_x(row.alpha),
            translation(row.a, 0),
            rotation_z(theta),
            translation(0, d),
        )
    return np.linalg.multi_dot(factors)


@settings(max_examples=25)
@example(rows=[DHRow(a=6e-8), DHRow()], convention="standard", seed=0)
@given(
    rows=st.lists(ROW, min_size=1, max_size=7),
    convention=st.sampled_from(["standard", "modified"]),
    seed=st.integers(0, 100),
)
def test_each_frame_is_the_product_of_the_dh_matrices(rows, convention, seed):
    base = Pose((0.1, 0.2, 0.3), (0.5, 0.1, -0.7, 0.2))
    tool = Pose((-0.1, 0.0, 0.2), (0.3, 0.1, 0.7, 0.2))
    robot = from_dh(rows, convention=convention, base=base, tool=tool)
    q = np.random.default_rng(seed).uniform(-2.0, 2.0, len(rows))
    product = base.matrix
    for k, (row, value) in enumerate(zip(rows, q, strict=True), 1):
        product = product @ dh_matrix(row, value, convention)
        for pose in (robot.measure(q, f"frame{k}"), robot.forward(q, f"frame{k}")):
            np.testing.assert_allclose(pose.matrix, product, atol=1e-12)
    np.testing.assert_allclose(robot.measure(q).matrix, product @ tool.matrix, atol=1e-12)


# Corke & Armstrong-Helouvry, ICRA 1994; frame 6 is at the wrist centre.
PUMA = [
    DHRow(a=0.0, alpha=HALF, d=0.67183),
    DHRow(a=0.4318, alpha=0.0, d=0.0),
    DHRow(a=0.0203, alpha=-HALF, d=0.15005),
    DHRow(a=0.0, alpha=HALF, d=0.4318),
    DHRow(a=0.0, alpha=-HALF, d=0.0),
    DHRow(a=0.0, alpha=0.0, d=0.0),
]
# Franka Emika, DH parameters of the Control Interface; the flange is 0.107 m behind frame 7.
PANDA = [
    DHRow(a=0.0, alpha=0.0, d=0.333),
    DHRow(a=0.0, alpha=-HALF, d=0.0),
    DHRow(a=0.0, alpha=HALF, d=0.316),
    DHRow(a=0.0825, alpha=HALF, d=0.0),
    DHRow(a=-0.0825, alpha=-HALF, d=0.384),
    DHRow(a=0.0, alpha=HALF, d=0.0),
    DHRow(a=0.088, alpha=HALF, d=0.0),
]


@pytest.mark.parametrize(
    ("rows", "convention", "tool", "name"),
    [
        (PUMA, "standard", None, "puma560"),
        (PANDA, "modified", Pose((0.0, 0.0, 0.107)), "panda"),
    ],
)
def test_a_published_table_gives_the_robot_of_the_catalogue(rows, convention, tool, name):
    robot = from_dh(rows, convention=convention, tool=tool, name=name)
    known = rik.load_robot(name)
    rng = np.random.default_rng(1)
    for _ in range(10):
        q = known.sample(rng)
        expected = known.measure(q, "flange").matrix
        np.testing.assert_allclose(robot.measure(q).matrix, expected, atol=1e-12)


def test_names_ranges_and_types_of_joints_are_kept():
    robot = from_dh(
        [
            DHRow(d=0.3, lower=-1.0, upper=2.0, name="waist"),
            DHRow(alpha=HALF, joint="prismatic", lower=0.1, upper=0.5),
            DHRow(a=0.2),
            DHRow(a=0.2, lower=0.0),
        ],
        name="scara",
    )
    assert robot.name == "scara" and robot.tool == "tool"
    assert robot.joints == ("waist", "joint2", "joint3", "joint4")
    assert robot.lower.tolist() == [-1.0, 0.1, -np.inf, 0.0]
    assert robot.upper[:3].tolist() == [2.0, 0.5, np.inf] and robot.upper[3] > 1e6
    assert robot.home.tolist() == [0.0, 0.1, 0.0, 0.0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: from_dh([]), "rows: 0 rows; allowed: 1 to 500"),
        (lambda: from_dh([DHRow(), (0, 0, 0, 0)]), r"row 2 is \(0, 0, 0, 0\); allowed: DHRow"),
        (lambda: from_dh([DHRow(name="a"), DHRow(name="a")]), "two joints are called 'a'"),
        (
            lambda: from_dh([DHRow()], convention="classic"),
            "'classic'; allowed: standard, modified",
        ),
        (lambda: DHRow(a=math.nan), "a: nan is not allowed; allowed: a finite number"),
        (lambda: DHRow(alpha="x"), "alpha: 'x' is not allowed"),
        (lambda: DHRow(joint="ball"), "joint: 'ball' is not allowed; allowed: revolute, prismatic"),
        (lambda: DHRow(lower=1.0, upper=1.0), "lower < upper"),
        (lambda: DHRow(lower=math.nan), "lower < upper"),
    ],
)
def test_wrong_rows_are_refused(make, message):
    with pytest.raises(OptionError, match=message):
        make()
