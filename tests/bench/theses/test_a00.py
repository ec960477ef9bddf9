"""A00's courses: reachable goals that move as in the thesis, checked by MuJoCo."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import robot_ik as rik
from robot_ik.bench.theses import a00
from robot_ik.bench.theses.tracking import track
from robot_ik.errors import OptionError, UnknownSolverError
from robot_ik.files import plain
from robot_ik.problem import Budget, Problem
from robot_ik.solvers import SOLVERS
from robot_ik.theses.courses import DIAGONAL, NUMBERS, Course, make_course

FEW = 12


@pytest.fixture(scope="module")
def courses() -> dict[int, Course]:
    return {n: make_course(n, frames=100 if n in (6, 7, 11, 12) else None) for n in NUMBERS}


def rotations(course: Course) -> Rotation:
    return Rotation.from_quat([pose.wxyz for pose in course.targets], scalar_first=True)


def positions(course: Course) -> np.ndarray:
    return np.array([pose.position for pose in course.targets])


@pytest.mark.parametrize(
    ("number", "joints", "oriented"),
    [
        (1, 3, False),
        (2, 5, False),
        (3, 5, True),
        (6, 5, False),
        (7, 5, True),
        (8, 5, True),
        (10, 5, True),
        (11, 3, False),
        (12, 5, False),
        (13, 2, True),
    ],
)
def test_chains_and_kinds_are_those_of_the_thesis(
    number: int, joints: int, oriented: bool, courses: dict[int, Course]
) -> None:
    course = courses[number]
    assert (len(course.robot.joints), course.goal.weights[1] > 0.0) == (joints, oriented)


@pytest.mark.parametrize(
    ("number", "normal", "step"),
    [
        (1, (0, 0, 1), 1.0),
        (2, (0, 0, 1), 1.0),
        (3, (0, 0, 1), 1.0),
        (4, (0, 1, 0), 1.0),
        (5, (1, 0, 0), 1.0),
        (6, DIAGONAL, 0.1),
        (7, DIAGONAL, 0.1),
        (9, DIAGONAL, 5.0),
    ],
)
def test_circles_are_about_the_origin(
    number: int, normal: Any, step: float, courses: dict[int, Course]
) -> None:
    course = courses[number]
    points = positions(course)
    np.testing.assert_allclose(points @ np.asarray(normal), 0.0, atol=1e-12)
    rotated = Rotation.from_rotvec(np.radians(step) * np.asarray(normal)).apply(points[:-1])
    np.testing.assert_allclose(points[1:], rotated, atol=1e-12)
    if step >= 1.0:
        np.testing.assert_allclose(points[-1], points[0], atol=1e-11)  # a whole revolution
    assert np.linalg.norm(points[0]) == pytest.approx(0.5 * len(course.robot.joints))


def test_orientations_rotate_as_stated(courses: dict[int, Course]) -> None:
    for number, share, axis in ((3, 0.25, (0, 0, 1)), (7, 1.0, DIAGONAL), (8, 1.0, DIAGONAL)):
        orientations = rotations(courses[number])
        step = np.radians(courses[number].at[1]) * share
        between = (orientations[1:] * orientations[:-1].inv()).as_rotvec()
        np.testing.assert_allclose(
            between, np.tile(step * np.asarray(axis), (len(between), 1)), atol=1e-10
        )
    assert np.ptp(positions(courses[8]), axis=0).max() == 0.0
    one_side = courses[10]
    assert positions(one_side)[:, 0].min() > 1.0
    assert (rotations(one_side)[1:] * rotations(one_side)[:-1].inv()).magnitude().min() > 0.01
    assert np.linalg.norm(np.diff(positions(one_side), axis=0), axis=1).min() > 0.01


def test_lines_are_straight_and_random_by_seed(courses: dict[int, Course]) -> None:
    points = positions(courses[12])
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.max() < 0.02 + 1e-9
    assert np.sum(steps < 0.0199) <= 9  # only at the corners
    other = positions(make_course(12, seed=1, frames=2))
    assert np.linalg.norm(other[0] - points[0]) > 0.01


def test_the_jacobian_of_two_balls_has_rank_five() -> None:
    """J is square and has rank 5 everywhere, so test 13 cannot be solved with an inverse."""
    chain = rik.make_chain(2)
    rng = np.random.default_rng(3)
    for _ in range(50):
        sigma = np.linalg.svd(chain.jacobian(chain.sample(rng)), compute_uv=False)
        assert sigma.shape == (6,) and sigma[5] < 1e-12 < 0.3 < sigma[4]


# The job


def test_required_methods_pass_the_first_frames_of_every_course() -> None:
    names = [name for name in a00.MUST_PASS if name in SOLVERS]
    assert {"lm", "dls", "auto"} <= set(names)
    report = a00.run_a00(a00.ask_a00(solvers=names, frames=FEW))
    assert report.passed, report.failures
    assert set(report.tracks) == {(name, number) for name in names for number in NUMBERS}
    assert all(track.solved == track.frames == FEW for track in report.tracks.values())
    summary = json.loads(json.dumps(plain(a00.a00_summary(report))))
    assert summary["passed"] and summary["complete"] and len(summary["tests"]) == 13
    assert len(summary["tracks"]) == len(report.tracks)
    assert {row["share"] for row in summary["tracks"]} == {1.0}


def test_a_method_without_the_kind_of_goal_is_refused_not_lost() -> None:
    report = a00.run_a00(a00.ask_a00([5, 8], ["triangulation", "analytic"], frames=3))
    refused = {key for key, track in report.tracks.items() if track.refused}
    assert refused == {("triangulation", 8), ("analytic", 5), ("analytic", 8)}
    assert report.tracks["triangulation", 5].passed and report.passed


def slow_problem(*args: Any, **options: Any) -> Problem:
    """Return a problem whose method is too slow to follow its goal."""
    return Problem(*args, **options, budget=Budget(restarts=0), max_step=1e-4)


def test_a_lost_goal_is_counted_with_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(a00, "Problem", slow_problem)
    report = a00.run_a00(a00.ask_a00([6], ["dls"], frames=6))
    assert report.complete and not report.passed and report.failures == [("dls", 6)]
    assert report.tracks["dls", 6].lost == 0 and report.lost_at("dls", 6) == "0°"


def test_a_false_status_is_detected_by_mujoco() -> None:
    """MuJoCo's forward pass detects a wrong solution with the status CONVERGED."""
    course = make_course(4, frames=5)

    class Liar(Problem):
        def solve(self, start: Any = None, *, target: Any = None) -> Any:
            solution = super().solve(start, target=target)
            solution.q = self.robot.integrate(solution.q, np.full(15, 1e-3))
            assert solution.converged
            return solution

    honest = track(Problem(course.robot, course.goal), course.targets, course.robot.home)
    assert honest.passed and honest.lost is None
    found = track(Liar(course.robot, course.goal), course.targets, course.robot.home)
    assert found.solved == 0 and found.lost == 0


def test_an_interruption_keeps_finished_results() -> None:
    report = a00.ask_a00([4, 5], ["lm"], frames=5)
    seen = []

    def progress(phase: str, share: float) -> None:
        seen.append(share)
        if phase.startswith("test 5"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        a00.run_a00(report, progress)
    assert set(report.tracks) == {("lm", 4)} and not report.complete and not report.passed
    assert seen == sorted(seen) and max(seen) == pytest.approx(0.5)


def test_progress_begins_at_zero_and_ends_at_one() -> None:
    reported: list[tuple[str, float]] = []
    a00.run_a00(
        a00.ask_a00([4, 5], ["lm"], frames=5), lambda phase, share: reported.append((phase, share))
    )
    assert reported == [
        ("test 4: lm", 0.0),
        ("test 4: lm", 0.5),
        ("test 5: lm", 0.5),
        ("test 5: lm", 1.0),
    ]


def test_unknown_tests_and_methods_are_refused() -> None:
    with pytest.raises(OptionError, match="14"):
        a00.ask_a00([14])
    with pytest.raises(UnknownSolverError, match="lm"):
        a00.ask_a00([1], ["lmm"])


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(3))
def test_the_whole_course(seed: int) -> None:
    report = a00.run_a00(a00.ask_a00(seed=seed))
    assert report.passed, report.failures
