"""Key poses: smooth motions within limits, replayed without solving, written and read back."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.errors import ConfigError, TrajectoryError
from robot_ik.kernels.tree import BALL
from robot_ik.motion import Keyframes, KeyPoses
from robot_ik.motion.keyframes import column_names, free_base

Array = NDArray[np.float64]
ROBOTS = ("puma560", "humanoid", "lion")


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> rik.Robot:
    return rik.load_robot(request.param)


@pytest.fixture(scope="module")
def humanoid() -> rik.Robot:
    return rik.load_robot("humanoid")


def random_keys(robot: rik.Robot, count: int = 5, size: float = 0.25, seed: int = 3) -> list[Array]:
    rng = np.random.default_rng(seed)
    return [
        robot.clip(robot.integrate(robot.home, size * rng.standard_normal(robot.nv)))
        for _ in range(count)
    ]


def speeds(robot: rik.Robot, rows: Array, rate: float) -> Array:
    return np.array([np.abs(robot.difference(a, b)) * rate for a, b in pairwise(rows)])


def test_a_motion_passes_through_its_keys_inside_limits_and_speed_limits(robot: rik.Robot) -> None:
    keys = random_keys(robot)
    motion = Keyframes.through(robot, keys, speed=0.5)
    for t, key in zip(motion.times, keys, strict=True):
        assert np.abs(robot.difference(motion.at(t), key)).max() < 1e-12
    rate = 100.0
    count = int(motion.duration * rate)
    rows = np.array([motion.at(k / rate) for k in range(count + 1)])
    assert not [k for k, row in enumerate(rows) if robot.outside(row, 1e-6)]
    fastest = speeds(robot, rows, rate)
    assert (fastest <= 0.5 * robot.velocity_limits * (1 + 1e-6)).all()
    # Each segment is as fast as its slowest joint allows. The bound of balls is not tight.
    assert motion.peak_velocity_of_segments().max(axis=1).max() > 0.49 * robot.velocity_limits.min()
    # The speed has no jump at a key.
    for t in motion.times[1:-1].tolist():
        before = robot.difference(motion.at(t - 1e-5), motion.at(t)) / 1e-5
        after = robot.difference(motion.at(t), motion.at(t + 1e-5)) / 1e-5
        assert np.abs(before - after).max() < 2e-3


def test_hinges_stay_between_the_keys_before_and_after(humanoid: rik.Robot) -> None:
    keys = random_keys(humanoid)
    motion = Keyframes.through(humanoid, keys)
    first = 7  # after the base
    for i, (one, two) in enumerate(pairwise(keys)):
        lower = np.minimum(one, two)[first:]
        upper = np.maximum(one, two)[first:]
        for s in np.linspace(0.0, 1.0, 21):
            q = motion.at(motion.times[i] + s * (motion.times[i + 1] - motion.times[i]))[first:]
            assert (q >= lower - 1e-12).all() and (q <= upper + 1e-12).all()


def test_between_two_keys_balls_and_the_base_move_along_the_geodesic() -> None:
    lion = rik.load_robot("lion")
    one, two = random_keys(lion, 2)
    motion = Keyframes.through(lion, [one, two])
    middle = motion.at(0.5 * motion.duration)
    half = lion.integrate(one, 0.5 * lion.difference(one, two))  # slerp, for all rotations at once
    assert np.abs(lion.difference(middle, half)).max() < 1e-12
    assert any(kind == BALL for kind in lion.tree.kind)


def test_a_frame_is_replayed_in_microseconds(robot: rik.Robot) -> None:
    motion = Keyframes.through(robot, random_keys(robot))
    times = np.random.default_rng(0).uniform(0.0, motion.duration, 200).tolist()
    motion.at(0.1)
    best = np.inf
    for _ in range(15):
        begin = time.perf_counter()
        for t in times:
            motion.at(t)
        best = min(best, (time.perf_counter() - begin) / len(times))
    assert best < 100e-6  # 6 to 14 us; the bound only catches a change of kind


def test_a_loop_repeats_without_a_jump(robot: rik.Robot) -> None:
    motion = Keyframes.through(robot, random_keys(robot, 4), loop=True)
    for t in (motion.duration, 3 * motion.duration):
        before = robot.difference(motion.at(t - 2e-5), motion.at(t - 1e-5)) / 1e-5
        after = robot.difference(motion.at(t + 1e-5), motion.at(t + 2e-5)) / 1e-5
        assert np.abs(before - after).max() < 5e-3
    assert (
        np.abs(robot.difference(motion.at(0.3), motion.at(0.3 + 5 * motion.duration))).max() < 1e-9
    )


def test_a_loop_of_steps_continues_and_turns(humanoid: rik.Robot) -> None:
    first = humanoid.home.copy()
    last = first.copy()
    last[0] += 0.6
    last[3:7] = np.cos(0.2), 0.0, 0.0, np.sin(0.2)  # 0.4 rad to the left
    middle = humanoid.integrate(first, 0.5 * humanoid.difference(first, last))
    middle[humanoid.joints.index("left_knee_pitch") + 6] += 0.4
    motion = Keyframes(humanoid, [0.0, 0.5, 1.0], [first, middle, last], loop=True)
    where = free_base(humanoid)
    assert where == slice(0, 7)
    for rounds in (1, 2, 5):
        t = rounds * motion.duration
        base = motion.at(t)
        assert 2.0 * np.arctan2(base[6], base[3]) == pytest.approx(0.4 * rounds)
        before = (motion.at(t - 1e-5)[:2] - motion.at(t - 2e-5)[:2]) / 1e-5
        after = (motion.at(t + 2e-5)[:2] - motion.at(t + 1e-5)[:2]) / 1e-5
        assert np.abs(before - after).max() < 1e-3 and np.linalg.norm(after) > 0.1


def test_a_blend_begins_with_one_motion_and_ends_with_the_other(humanoid: rik.Robot) -> None:
    keys = random_keys(humanoid, 6, size=0.1)
    one = Keyframes.through(humanoid, keys[:3])
    two = Keyframes.through(humanoid, keys[3:])
    both = one.blended(two, 0.4)
    assert both.duration == pytest.approx(one.duration + two.duration - 0.4)
    assert np.abs(humanoid.difference(both.at(0.5), one.at(0.5))).max() < 1e-3
    end = both.duration - 0.5
    apart = humanoid.difference(both.at(end), two.at(two.duration - 0.5))
    assert np.abs(apart[6:]).max() < 1e-3  # its base continues from that of the first motion
    rows = both.sampled(60.0).q
    largest = max(speeds(humanoid, m.sampled(60.0).q, 60.0).max() for m in (one, two))
    gap = np.abs(humanoid.difference(one.q[-1], two.q[0])).max()
    assert speeds(humanoid, rows, 60.0).max() < 2 * largest + 1.9 * gap / 0.4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, q: (t[::-1], q), "times must increase"),
        (lambda t, q: (t, q[:, :-1]), "keys of 'puma560' got times"),
        (lambda t, q: (t, np.where(q == q[1, 2], np.nan, q)), "not finite"),
        (lambda t, q: (t, q + 10.0), "key 0: joint .* is outside its limits; allowed: .* deg"),
    ],
)
def test_keys_without_a_valid_motion_are_refused(change: object, message: str) -> None:
    puma = rik.load_robot("puma560")
    times, q = change(np.array([0.0, 1.0, 2.0]), np.array(random_keys(puma, 3)))  # type: ignore[operator]
    with pytest.raises(TrajectoryError, match=message):
        Keyframes(puma, times, q)


def test_an_open_loop_is_refused() -> None:
    puma = rik.load_robot("puma560")
    with pytest.raises(TrajectoryError, match="must equal the first"):
        Keyframes(puma, [0.0, 1.0], random_keys(puma, 2), loop=True)


# Names and files


def test_poses_and_motions_are_read_back_equal(robot: rik.Robot, tmp_path: Path) -> None:
    book = KeyPoses(robot)
    for k, q in enumerate(random_keys(robot, 3)):
        book.record(f'pose "{k}" ü', q)
    names = list(book.poses)
    book.record_motion("there and back", [names[0], names[1], names[0]], [0.7, 1.1])
    book.record_motion("round", names, loop=True)
    book.save(tmp_path / "poses.toml")
    again = KeyPoses.load(tmp_path / "poses.toml", robot)
    assert again.motions == book.motions and list(again.poses) == names
    for name in names:
        assert (again[name] == book[name]).all()
    assert (again.motion("round").q == book.motion("round").q).all()
    assert again.motion("there and back").times[1] >= 0.7


def test_frames_are_read_back_equal(robot: rik.Robot, tmp_path: Path) -> None:
    motion = Keyframes.through(robot, random_keys(robot))
    motion.save_csv(tmp_path / "keys.csv")
    again = Keyframes.load_csv(tmp_path / "keys.csv", robot)
    assert (again.q == motion.q).all() and (again.times == motion.times).all()
    frames = motion.sampled(50.0)
    frames.save_csv(tmp_path / "frames.csv")
    assert (Keyframes.load_csv(tmp_path / "frames.csv", robot).q == frames.q).all()


def test_recordings_with_further_columns_are_read(tmp_path: Path) -> None:
    puma = rik.load_robot("puma560")
    joints = [f"commanded.{name}" for name in column_names(puma)[::-1]]
    head = ["time_s", "action", *joints, "com_x"]
    rows = [[f"{k / 60}", "walk", *["0.25"] * 6, "1"] for k in range(3)]
    text = "\n".join(",".join(row) for row in [head, *rows]) + "\n"
    (tmp_path / "frames.csv").write_text(text)
    motion = Keyframes.load_csv(tmp_path / "frames.csv", puma)
    assert len(motion) == 3 and (motion.q == 0.25).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema = 2", "schema: 2 is not right; allowed: 1"),
        (
            "schema = 1\n[poses.a]\njiont1 = 1.0",
            r"(?s)poses.a.jiont1: unknown joint.*did you mean joint1",
        ),
        (
            "schema = 1\n[poses.a]\njoint1 = true",
            "poses.a.joint1: True is not right; allowed: a number",
        ),
        (
            "schema = 1\n[poses.a]\njoint1 = 99.0",
            "poses.a: joint 'joint1' at 5672.28 deg is outside its limits; "
            "allowed: -160 to 160 deg",
        ),
        ("schema = 1\nposes = 3", "poses: 3 is not right; allowed: a table"),
        ("schema = 1\n[motions.m]\nposes = ['a', 'b']", "motions.m: there is no pose 'a'"),
        (
            "schema = 1\n[motions.m]\nposes = []\nloop = 1",
            "motions.m.loop: 1 is not right; allowed: true or false",
        ),
        (
            "schema = 1\n[motions.m]\nloops = true",
            "motions.m.loops: unknown key 'loops'; allowed: poses",
        ),
        ("schema = 1\n[poses.a]\njoint1 = nan", "nan is not right"),
    ],
)
def test_a_wrong_file_is_reported_with_the_key(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "poses.toml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        KeyPoses.load(tmp_path / "poses.toml", rik.load_robot("puma560"))


def test_durations_hold_unless_a_speed_limit_of_the_file_is_lower(humanoid: rik.Robot) -> None:
    book = KeyPoses.load(humanoid.folder / "poses.toml", humanoid)
    assert book.motion("walk").duration == pytest.approx(1.1)  # its file states no limits
    puma = KeyPoses(rik.load_robot("puma560"))
    one, two = random_keys(puma.robot, 2)
    puma.record("one", one)
    puma.record("two", two)
    puma.record_motion("quick", ["one", "two"], [0.01])
    motion = puma.motion("quick")
    assert (motion.peak_velocity_of_segments() <= puma.robot.velocity_limits * (1 + 1e-6)).all()
    assert motion.duration > 0.2


def test_unknown_names_are_refused_with_close_names() -> None:
    book = KeyPoses(rik.load_robot("puma560"))
    book.record("stand", book.robot.home)
    with pytest.raises(TrajectoryError, match="did you mean stand"):
        book["stend"]
    with pytest.raises(TrajectoryError, match="there is already a pose 'stand'"):
        book.record("stand", book.robot.home)
    with pytest.raises(TrajectoryError, match="two or more poses"):
        book.record_motion("m", ["stand"])
    assert len(book.motion("stand")) == 1
