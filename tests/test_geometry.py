"""Poses: against SciPy's rotations and the laws of a group."""

import itertools

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from robot_ik.errors import InvalidPoseError
from robot_ik.geometry import (
    Pose,
    matrix_to_quat,
    quat_multiply,
    quat_to_matrix,
    rotation_exp,
    rotation_log,
)

NUMBER = st.floats(-10, 10)
VECTOR = st.tuples(NUMBER, NUMBER, NUMBER).map(np.array)
QUATERNION = st.tuples(NUMBER, NUMBER, NUMBER, NUMBER).filter(
    lambda q: sum(x * x for x in q) > 1e-3
)
POSE = st.builds(Pose, VECTOR, QUATERNION)
ROTATION_VECTOR = st.builds(
    lambda axis, angle: angle * axis / np.linalg.norm(axis),
    VECTOR.filter(lambda v: np.linalg.norm(v) > 1e-3),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 1e-4, 0.5, 2.0, 3.0, 3.1415, np.pi - 1e-9]),
)


def scipy_rotation(wxyz):
    return Rotation.from_quat(np.roll(wxyz, -1))


@given(POSE, POSE, VECTOR)
def test_composition_agrees_with_the_motion_of_points(a, b, point):
    assert isinstance(a @ b, Pose)
    np.testing.assert_allclose((a @ b) @ point, a @ (b @ point), atol=1e-11)
    np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-11)
    np.testing.assert_allclose(a.apply(np.tile(point, (3, 1)))[2], a.apply(point), atol=1e-12)


@given(POSE)
def test_a_pose_and_its_inverse_undo_each_other(pose):
    np.testing.assert_allclose(pose.compose(pose.inverse()).matrix, np.eye(4), atol=1e-11)
    np.testing.assert_allclose(pose.inverse().compose(pose).matrix, np.eye(4), atol=1e-11)


@given(POSE, POSE)
def test_rotations_equal_those_of_scipy(a, b):
    np.testing.assert_allclose(a.rotation, scipy_rotation(a.wxyz).as_matrix(), atol=1e-12)
    both = scipy_rotation(a.wxyz) * scipy_rotation(b.wxyz)
    np.testing.assert_allclose(
        quat_to_matrix(quat_multiply(a.wxyz, b.wxyz)), both.as_matrix(), atol=1e-12
    )
    metres, radians = a.distance(b)
    assert metres == pytest.approx(np.linalg.norm(a.position - b.position))
    assert radians == pytest.approx(
        (scipy_rotation(a.wxyz).inv() * scipy_rotation(b.wxyz)).magnitude(), abs=1e-7
    )


@given(POSE, POSE)
def test_plus_undoes_minus(a, b):
    change = a.minus(b)
    np.testing.assert_allclose(b.plus(change).matrix, a.matrix, atol=1e-9)
    rotation = scipy_rotation(a.wxyz) * scipy_rotation(b.wxyz).inv()
    np.testing.assert_allclose(
        scipy_rotation(rotation_exp(change[3:])).as_matrix(), rotation.as_matrix(), atol=1e-9
    )


@given(QUATERNION)
def test_a_matrix_gives_back_its_quaternion(wxyz):
    unit = Pose((0, 0, 0), wxyz).wxyz
    back = matrix_to_quat(quat_to_matrix(unit))
    assert back[0] >= 0
    assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) < 1e-12


@pytest.mark.parametrize("axis", np.eye(3).tolist())
def test_half_turns_are_kept_by_matrices(axis):
    assert np.abs(matrix_to_quat(quat_to_matrix(np.array([0.0, *axis])))[1:]).tolist() == axis


@given(ROTATION_VECTOR, VECTOR)
def test_log_undoes_exp_from_zero_to_a_half_turn(rotation_vector, position):
    np.testing.assert_allclose(
        rotation_log(rotation_exp(rotation_vector)), rotation_vector, atol=1e-12
    )
    np.testing.assert_allclose(
        rotation_log(-rotation_exp(rotation_vector)), rotation_vector, atol=1e-12
    )
    np.testing.assert_allclose(
        quat_to_matrix(rotation_exp(rotation_vector)),
        Rotation.from_rotvec(rotation_vector).as_matrix(),
        atol=1e-12,
    )
    twist = np.concatenate([position, rotation_vector])
    np.testing.assert_allclose(Pose().plus(twist).minus(Pose()), twist, atol=1e-12)


def twist_matrix(twist):
    """Return the element (4, 4) of se(3) of a twist."""
    x, y, z = twist[3:]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = ((0, -z, y), (z, 0, -x), (-y, x, 0))
    matrix[:3, 3] = twist[:3]
    return matrix


@given(VECTOR, ROTATION_VECTOR)
def test_exp_equals_the_matrix_exponential_and_log_is_its_inverse(linear, rotation_vector):
    twist = np.concatenate([linear, rotation_vector])
    pose = Pose.exp(twist)
    np.testing.assert_allclose(pose.matrix, expm(twist_matrix(twist)), atol=1e-11)
    np.testing.assert_allclose(pose.log(), twist, atol=1e-8)
    np.testing.assert_allclose(Pose.exp(-twist).matrix, pose.inverse().matrix, atol=1e-11)
    np.testing.assert_allclose(
        (Pose.exp(0.3 * twist) @ Pose.exp(0.7 * twist)).matrix, pose.matrix, atol=1e-10
    )


@pytest.mark.parametrize("angle", [1e-3, 0.0999, 0.1001, 0.5])
def test_the_series_and_the_formulas_of_exp_and_log_agree(angle):
    twist = np.array([1.0, -2.0, 3.0, 0.0, 0.6 * angle, 0.8 * angle])
    pose = Pose.exp(twist)
    np.testing.assert_allclose(pose.matrix, expm(twist_matrix(twist)), atol=1e-13)
    np.testing.assert_allclose(pose.log(), twist, atol=1e-13)


@given(POSE)
def test_a_pose_is_the_exp_of_its_log(pose):
    np.testing.assert_allclose(Pose.exp(pose.log()).matrix, pose.matrix, atol=1e-7)
    assert np.linalg.norm(pose.log()[3:]) <= np.pi + 1e-12


def test_the_identity_maps_each_pose_to_itself():
    pose = Pose((1, 2, 3), (0.5, 0.1, -0.7, 0.2))
    assert Pose.identity() == Pose()
    np.testing.assert_allclose((Pose.identity() @ pose).matrix, pose.matrix, atol=1e-15)
    assert not Pose.identity().log().any()


AXES = st.text("xyz", min_size=1, max_size=3).filter(
    lambda axes: all(a != b for a, b in itertools.pairwise(axes))
)


@given(AXES, st.booleans(), st.data())
def test_euler_angles_equal_those_of_scipy(axes, rotated, data):
    axes = axes.upper() if rotated else axes
    angles = data.draw(st.lists(st.floats(-7, 7), min_size=len(axes), max_size=len(axes)))
    pose = Pose.from_euler(axes, angles, position=(1, 2, 3))
    expected = Rotation.from_euler(axes, angles).as_matrix().reshape(3, 3)
    np.testing.assert_allclose(pose.rotation, expected, atol=1e-12)
    assert pose.position.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("axes", "angles", "message"),
    [
        ("xYz", (0, 0, 0), "not 'xYz'"),
        ("abc", (0, 0, 0), "not 'abc'"),
        ("", (), "not ''"),
        (None, (0, 0, 0), "not None"),
        ("xyz", (0, 0), "Euler angles must be 3 numbers, not 2"),
        ("x", np.nan, "finite"),
    ],
)
def test_wrong_euler_angles_are_refused(axes, angles, message):
    with pytest.raises(InvalidPoseError, match=message):
        Pose.from_euler(axes, angles)


@given(st.tuples(*[st.floats(-2, 2)] * 3), st.tuples(*[st.floats(-2, 2)] * 3))
def test_look_at_puts_the_target_in_the_middle_and_up_upwards(position, target):
    view = np.array(target) - position
    assume(np.linalg.norm(view) > 0.05 and np.linalg.norm(view[:2]) > 0.02)
    inverse = Pose.look_at(position, target).inverse()
    assert inverse.apply(target) == pytest.approx([0, 0, np.linalg.norm(view)], abs=1e-9)
    higher = inverse.apply(np.array(target) + np.array([0, 0, 0.01]))
    assert higher[1] < 0 and higher[0] == pytest.approx(0, abs=1e-9), "picture y points down"


@pytest.mark.parametrize("target", [(0.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
def test_look_at_refuses_views_without_an_up(target):
    with pytest.raises(InvalidPoseError, match="cannot look"):
        Pose.look_at((0, 0, 1), target)


@given(POSE)
def test_matrices_are_read_back_equal(pose):
    again = Pose.from_matrix(pose.matrix)
    np.testing.assert_allclose(again.matrix, pose.matrix, atol=1e-12)
    np.testing.assert_allclose(
        Pose.from_rotation(pose.rotation, pose.position).matrix, pose.matrix, atol=1e-12
    )


def test_a_pose_has_read_only_copies_of_its_numbers():
    position = np.zeros(3)
    wxyz = np.array([2.0, 0, 0, 0])
    pose = Pose(position, wxyz)
    position[0] = wxyz[1] = 9.0
    assert pose.position.tolist() == [0, 0, 0] and pose.wxyz.tolist() == [1, 0, 0, 0]
    with pytest.raises(ValueError, match="read-only"):
        pose.position[0] = 1.0
    assert repr(pose) == "Pose(position=(0, 0, 0), wxyz=(1, 0, 0, 0))"


@pytest.mark.parametrize(
    ("position", "wxyz", "message"),
    [
        ((0, 0), (1, 0, 0, 0), "a position must be 3 numbers, not 2"),
        ((0, 0, 0), (1, 0, 0), "wxyz must be 4 numbers, not 3"),
        ((0, np.nan, 0), (1, 0, 0, 0), "finite"),
        ((0, 0, 0), (np.inf, 0, 0, 0), "finite"),
        ((0, 0, 0), (0, 0, 0, 0), "zero quaternion"),
    ],
)
def test_invalid_numbers_are_refused_as_a_pose(position, wxyz, message):
    with pytest.raises(ValueError, match=message):
        Pose(position, wxyz)
    with pytest.raises(ValueError, match="homogeneous"):
        Pose.from_matrix(np.eye(3))


def test_poses_are_equal_by_their_numbers_and_can_be_keys():
    pose = Pose((1, 2, 3), (0.5, 0.5, 0.5, 0.5))
    same = Pose([1.0, 2.0, 3.0], np.array([1.0, 1, 1, 1]))
    assert pose == same and hash(pose) == hash(same) and len({pose, same}) == 1
    assert Pose((0.0, 0, 0)) == Pose((-0.0, 0, 0)) and hash(Pose((0.0, 0, 0))) == hash(
        Pose((-0.0, 0, 0))
    )
    for other in (
        Pose((1, 2, 3.0000001), pose.wxyz),
        Pose(pose.position),
        Pose(pose.position, -pose.wxyz),
    ):
        assert pose != other
    assert pose != "pose" and pose != pose.matrix.tolist()
    with pytest.raises(ValueError, match="read-only"):
        pose.position[0] = 1.0


@pytest.mark.parametrize("bad", [(np.nan, 0, 0), (np.inf, 0, 0)])
def test_numbers_that_are_not_finite_are_refused_as_a_pose(bad):
    with pytest.raises(ValueError, match="finite"):
        Pose(bad)
    with pytest.raises(ValueError, match="finite"):
        Pose(wxyz=(*bad, 1.0))
    with pytest.raises(ValueError, match="below 1e\\+100"):
        Pose((1e200, 0.0, 0.0))
    assert Pose((1e99, -1e99, 0.0)).position[0] == 1e99


@pytest.mark.parametrize(
    ("rotation", "last_row", "message"),
    [
        (2.0 * np.eye(3), (0, 0, 0, 1), "scales or mirrors"),
        (np.zeros((3, 3)), (0, 0, 0, 1), "scales or mirrors"),
        (np.diag([1.0, 1.0, -1.0]), (0, 0, 0, 1), "scales or mirrors"),
        (np.eye(3), (1, 0, 0, 1), "last row"),
    ],
)
def test_a_matrix_that_is_not_a_rigid_motion_is_refused(rotation, last_row, message):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[3] = last_row
    with pytest.raises(ValueError, match=message):
        Pose.from_matrix(matrix)


def test_a_matrix_of_six_digits_is_a_pose():
    matrix = Pose((1.0, 2.0, 3.0), (0.5, 0.1, -0.7, 0.2)).matrix
    assert Pose.from_matrix(np.round(matrix, 6)).distance(Pose.from_matrix(matrix))[1] < 1e-5
