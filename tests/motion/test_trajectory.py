"""Laws of `Trajectory` and `joint_move`."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.errors import ConfigError, OutputError, TrajectoryError, UnsupportedJointError
from robot_ik.motion import PROFILES, Trajectory, joint_move
from robot_ik.robot import load_robot

SLACK = 1.0 + 1e-9  # rounding of differences of samples, relative

angle = st.floats(-3.0, 3.0)
limit = st.floats(0.3, 50.0)
law = settings(deadline=None, max_examples=40)


@st.composite
def moves(draw, lowest=1):
    n = draw(st.integers(lowest, 7))
    vector = lambda element: np.array(draw(st.lists(element, min_size=n, max_size=n)))  # noqa: E731
    return {
        "velocity": vector(limit),
        "acceleration": vector(limit),
        "start": vector(angle),
        "goal": vector(angle),
        "speed": draw(st.floats(0.2, 1.0)),
        "rate": draw(st.floats(5.0, 200.0)),
        "profile": draw(st.sampled_from(sorted(PROFILES))),
    }


def plan(number_robot, move):
    robot = number_robot(move["velocity"], move["acceleration"])
    return joint_move(
        robot,
        move["start"],
        move["goal"],
        speed=move["speed"],
        rate=move["rate"],
        profile=move["profile"],
    )


@given(move=moves())
@law
def test_limits_are_never_exceeded(number_robot, move):
    path = plan(number_robot, move)
    floor = 1e-12 * move["rate"]  # rounding of q around 3 rad, seen through one difference
    assert (path.peak_velocity <= move["speed"] * move["velocity"] * SLACK + floor).all()
    push = move["speed"] * move["acceleration"]
    assert (path.peak_acceleration <= push * SLACK + floor * move["rate"]).all()


@given(move=moves())
@law
def test_ends_are_exact_and_time_runs_evenly(number_robot, move):
    path = plan(number_robot, move)
    assert (path.q[0] == move["start"]).all() and (path.q[-1] == move["goal"]).all()
    assert path.times[0] == 0.0
    np.testing.assert_allclose(np.diff(path.times), 1.0 / move["rate"], rtol=1e-9)


@given(move=moves(lowest=2))
@law
def test_joints_are_synchronised_on_one_straight_line(number_robot, move):
    path = plan(number_robot, move)
    way = move["goal"] - move["start"]
    lead = int(np.argmax(np.abs(way)))
    if way[lead] == 0.0:
        return
    progress = (path.q[:, lead] - move["start"][lead]) / way[lead]
    np.testing.assert_allclose(path.q, move["start"] + progress[:, None] * way, atol=1e-12)
    assert (np.diff(progress) > -1e-12).all()


@given(move=moves())
@law
def test_the_trapezoid_is_as_fast_as_its_textbook_time(number_robot, move):
    """Return the duration of the slowest joint alone (Siciliano et al. 2009, section 4.2)."""
    path = plan(number_robot, move | {"profile": "trapezoid"})
    way = np.abs(move["goal"] - move["start"])
    v = move["speed"] * move["velocity"]
    a = move["speed"] * move["acceleration"]
    v_needed = np.inf
    a_needed = np.inf
    for distance, top, push in zip(way, v, a, strict=True):
        if distance > 1e-9:
            v_needed = min(v_needed, top / distance)
            a_needed = min(a_needed, push / distance)
    if not np.isfinite(v_needed):
        return
    cruises = v_needed**2 < a_needed
    ideal = 1.0 / v_needed + v_needed / a_needed if cruises else 2.0 / np.sqrt(a_needed)
    assert ideal - 1e-6 <= path.duration <= ideal + 1.0 / move["rate"] + 1e-6


@given(move=moves(), rate=st.floats(3.0, 900.0))
@law
def test_resampling_keeps_ends_box_and_velocity(number_robot, move, rate):
    path = plan(number_robot, move)
    again = path.resampled(rate)
    assert (again.q[0] == path.q[0]).all() and (again.q[-1] == path.q[-1]).all()
    assert again.duration == pytest.approx(path.duration)
    assert (again.q >= path.q.min(axis=0) - 1e-12).all() and (
        again.q <= path.q.max(axis=0) + 1e-12
    ).all()
    if len(again) > 2:  # the last interval may be short, and rounding large in it
        between = np.abs(np.diff(again.q, axis=0))[:-1] * rate
        assert (between <= path.peak_velocity * SLACK + 1e-9).all()


@given(move=moves(), part=st.floats(0.0, 1.0))
@law
def test_at_is_exact_at_samples_and_between_neighbours(number_robot, move, part):
    path = plan(number_robot, move)
    k = int(part * (len(path) - 1))
    assert (path.at(path.times[k]) == path.q[k]).all()
    assert (path.at(-1.0) == path.q[0]).all() and (path.at(path.duration + 1.0) == path.q[-1]).all()
    if k + 1 < len(path):
        middle = path.at(0.5 * (path.times[k] + path.times[k + 1]))
        np.testing.assert_allclose(middle, 0.5 * (path.q[k] + path.q[k + 1]), atol=1e-9)


def test_a_move_to_the_start_has_no_length(number_robot):
    path = joint_move(number_robot([1.0, 1.0], [1.0, 1.0]), [0.3, -0.2], [0.3, -0.2])
    assert len(path) == 1 and path.duration == 0.0
    assert not path.peak_velocity.any() and not path.peak_acceleration.any()


@pytest.mark.parametrize("way", [5e-324, 1e-300, 1e-12])
def test_a_very_short_move_ends_exactly(number_robot, way):
    path = joint_move(number_robot([1.0], [1.0]), [0.0], [way])
    assert path.q[-1, 0] == way and np.isfinite(path.times).all()


def test_one_slide_of_one_metre(number_robot):
    """By hand: 1 m, 0.5 m/s, 1 m/s^2: ramps of 0.5 s, cruise of 1.5 s, 2.5 s in all."""
    path = joint_move(number_robot([0.5], [1.0]), [0.0], [1.0], rate=100.0)
    assert path.duration == pytest.approx(2.5)
    assert path.at(0.5)[0] == pytest.approx(0.125)
    assert path.at(1.25)[0] == pytest.approx(0.5)
    assert path.peak_velocity[0] == pytest.approx(0.5)
    assert path.peak_acceleration[0] == pytest.approx(1.0)


def test_quintic_starts_and_stops_softly(number_robot):
    robot = number_robot([1.0], [2.0])
    hard = joint_move(robot, [0.0], [2.0], profile="trapezoid")
    soft = joint_move(robot, [0.0], [2.0], profile="quintic")
    bend = lambda path: np.diff(path.q[:, 0], 2) * 100.0**2  # noqa: E731
    assert abs(bend(soft)[0]) < 0.2 < abs(bend(hard)[0])
    assert hard.duration < soft.duration < 2.0 * hard.duration


def test_a_start_outside_the_limits_moves_inside(number_robot):
    path = joint_move(number_robot([1.0], [1.0], [-1.0], [1.0]), [1.5], [0.9])
    assert path.q[0, 0] == 1.5 and path.q[-1, 0] == 0.9 and (np.diff(path.q[:, 0]) < 0.0).all()


def test_lower_further_limits_count(number_robot):
    robot = number_robot([1.0, 1.0], [2.0, 2.0])
    path = joint_move(
        robot, [0, 0], [2, 2], velocity_limits=[0.25, 5.0], acceleration_limits=[0.5, 5.0]
    )
    assert path.peak_velocity.max() == pytest.approx(0.25, rel=0.01)
    assert path.peak_acceleration.max() <= 0.5 * SLACK


def test_a_goal_outside_the_limits_is_refused_with_joint_value_and_range(number_robot):
    robot = number_robot([1.0] * 3, [1.0] * 3, [-1.0] * 3, [1.0] * 3)
    with pytest.raises(TrajectoryError, match=r"1\.25 for joint 'j1'; allowed: -1 to 1"):
        joint_move(robot, [0, 0, 0], [0, 1.25, 0])


@pytest.mark.parametrize(
    ("start", "goal", "message"),
    [
        ([0.0, np.nan], [0.0, 0.0], "start has nan for joint 'j1'"),
        ([0.0, 0.0], [np.inf, 0.0], "goal has inf for joint 'j0'"),
        ([0.0], [0.0, 0.0], "start has shape"),
        ([0.0, 0.0], [[0.0, 0.0]], "goal has shape"),
    ],
)
def test_malformed_vectors_are_refused(number_robot, start, goal, message):
    with pytest.raises(TrajectoryError, match=message):
        joint_move(number_robot([1.0, 1.0], [1.0, 1.0]), start, goal)


@pytest.mark.parametrize(
    "options",
    [
        {"speed": 0.0},
        {"speed": 1.1},
        {"speed": np.nan},
        {"rate": 0.0},
        {"rate": np.inf},
        {"profile": "x"},
    ],
)
def test_malformed_options_are_refused(number_robot, options):
    with pytest.raises(TrajectoryError):
        joint_move(number_robot([1.0], [1.0]), [0.0], [1.0], **options)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_a_robot_without_limits_of_motion_is_refused(number_robot, bad):
    with pytest.raises(TrajectoryError, match="limits of 'numbers'"):
        joint_move(number_robot([bad], [1.0]), [0.0], [1.0])
    with pytest.raises(TrajectoryError, match="acceleration_limits of"):
        joint_move(number_robot([1.0], [bad]), [0.0], [1.0])


def test_ball_joints_are_refused_with_a_message(number_robot):
    with pytest.raises(UnsupportedJointError, match="ball or free"):
        joint_move(number_robot([1.0], [1.0], balls=1), [0.0] * 5, [0.0] * 5)


def test_trajectory_is_checked_and_cannot_be_changed():
    path = Trajectory([0.0, 0.5], [[0.0], [1.0]], ["a"])
    with pytest.raises(ValueError, match="read-only"):
        path.q[0, 0] = 9.0
    path.at(0.0)[0] = 9.0
    assert path.q[0, 0] == 0.0
    nothing = np.zeros((0, 1))
    for times, q in [
        ([0, 0], [[0], [1]]),
        ([0, 1], [[0], [np.nan]]),
        ([], nothing),
        ([0, 1], [[0]]),
    ]:
        with pytest.raises(TrajectoryError):
            Trajectory(times, q, ["a"])
    with pytest.raises(TrajectoryError, match="nan"):
        path.at(float("nan"))


def test_measures_of_a_known_path():
    times = np.linspace(0.0, 2.0, 201)
    path = Trajectory(times, np.column_stack([times**2, -times]), ["a", "b"])
    np.testing.assert_allclose(path.peak_velocity, [4.0, 1.0], rtol=0.01)
    assert path.peak_acceleration[1] == pytest.approx(
        1.0 / 0.01
    )  # starts at full speed: one sample


# CSV


@given(move=moves())
@settings(deadline=None, max_examples=25)
def test_csv_keeps_every_bit(number_robot, move, tmp_path_factory):
    path = plan(number_robot, move)
    file = tmp_path_factory.mktemp("csv") / "trajectory.csv"
    path.save_csv(file)
    again = Trajectory.load_csv(file)
    assert again.joints == path.joints
    assert (again.times == path.times).all() and (again.q == path.q).all()
    assert [entry.name for entry in file.parent.iterdir()] == [file.name]


def test_csv_has_a_readable_header(tmp_path):
    Trajectory([0.0, 0.01], [[0.5, 1.0], [0.25, 2.0]], ["waist", "arm, upper"]).save_csv(
        tmp_path / "t.csv"
    )
    text = (tmp_path / "t.csv").read_text()
    assert text == 'time_s,commanded.waist,"commanded.arm, upper"\n0.0,0.5,1.0\n0.01,0.25,2.0\n'
    assert Trajectory.load_csv(tmp_path / "t.csv").joints == ("waist", "arm, upper")


@pytest.mark.parametrize(
    "text",
    [
        "time_s,robot,commanded.a,commanded.b,measured.a,measured.b,text\n0,0,1,2,,,\n1,0,,,5,6,on\n2,0,3,4,7,8,\n",
        "time_s,commanded.a,commanded.b,measured.a,measured.b\n0,1,2,5,6\n2,3,4,7,8\n",
        "time_s,action,measured.a,measured.b,com_x\n0,walk,1,2,9\n1,walk,,,9\n2,walk,3,4,9\n",
    ],
    ids=["recording", "without goals", "measured only, with further columns"],
)
def test_commanded_positions_are_read_else_measured_positions(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    again = Trajectory.load_csv(tmp_path / "t.csv")
    assert again.joints == ("a", "b") and again.times.tolist() == [0.0, 2.0]
    assert again.q.tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_csv_into_a_missing_folder_is_refused_and_leaves_no_file(tmp_path):
    path = Trajectory([0.0], [[0.0]], ["a"])
    with pytest.raises(OutputError, match="cannot write"):
        path.save_csv(tmp_path / "missing" / "t.csv")
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match="cannot write"):
        path.save_csv(tmp_path / "folder")
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1"),
        ("time_s,a\n0,1\n", "allowed: time_s,commanded.JOINT"),
        ("t,commanded.a\n0,1\n", "line 1"),
        ("x,commanded.a\n0,1\n", "line 1"),
        ("time_s,commanded.a\n", "no samples"),
        ("time_s,commanded.a\n0,x\n", "line 2"),
        ("time_s,commanded.a\n0,1\n1\n", "line 3"),
        ("time_s,commanded.a\n1,1\n0,1\n", "must increase"),
        ("time_s,commanded.a\n0,nan\n", "line 2"),
        ("time_s,robot,commanded.a,measured.a\n0,0,1,\n0,1\n", "line 3"),
        ("time_s,robot,commanded.a,measured.a\n0,1,1,\n0,2,1,\n", "several robots"),
        ("time_s,robot,commanded.a,measured.a\n0,0,,1\n", "no samples"),
    ],
)
def test_a_malformed_csv_is_refused_with_the_line(tmp_path, text, message):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(ConfigError, match=message):
        Trajectory.load_csv(tmp_path / "t.csv")
    with pytest.raises(ConfigError, match="cannot be read"):
        Trajectory.load_csv(tmp_path / "none.csv")


def test_wrong_vectors_and_endless_moves_are_refused_with_a_message():
    robot = load_robot("puma560")
    end = robot.home + 0.1
    for arguments, message in (
        ({"velocity_limits": np.ones(5)}, "velocity_limits must be 6 numbers"),
        ({"acceleration_limits": "fast"}, "acceleration_limits must be 6 numbers"),
        ({"velocity_limits": 1e-300}, "samples at 100 Hz"),
    ):
        with pytest.raises(TrajectoryError, match=message):
            joint_move(robot, robot.home, end, **arguments)
    with pytest.raises(TrajectoryError, match="start must be 6 numbers"):
        joint_move(robot, "home", end)
