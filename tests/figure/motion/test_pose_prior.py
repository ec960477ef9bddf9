"""The pose prior: exact rows in the kernels, learning, and what it does to a reach."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.errors import (
    ConfigError,
    InvalidGoalError,
    ModelError,
    UnknownJointError,
    UnsupportedGoalError,
)
from robot_ik.figure.motion.pose_prior import fit_pose_prior, mirrored, thinned
from robot_ik.goals import PosePriorGoal
from robot_ik.motion import Keyframes, KeyPoses
from robot_ik.pose_prior import PosePrior, feature_names
from robot_ik.problem import Problem
from tests.residual_rows import rows_at

Array = NDArray[np.float64]


def some_poses(robot: rik.Robot, count: int, size: float = 0.25) -> Array:
    rng = np.random.default_rng(0)
    return np.array(
        [
            robot.clip(robot.integrate(robot.home, size * rng.standard_normal(robot.nv)))
            for _ in range(count)
        ]
    )


@pytest.fixture(scope="module", params=["humanoid", "lion", "puma560"])
def robot(request: pytest.FixtureRequest) -> rik.Robot:
    return rik.load_robot(request.param)


@pytest.fixture(scope="module")
def humanoid() -> rik.Robot:
    return rik.load_robot("humanoid")


@pytest.fixture(scope="module")
def prior(robot: rik.Robot) -> PosePrior:
    return fit_pose_prior(robot, some_poses(robot, 80), parts=3, mirror=False)


def test_the_rows_are_the_energy_and_their_slope_its_gradient(
    robot: rik.Robot, prior: PosePrior
) -> None:
    weight = 0.7
    problem = Problem(robot, PosePriorGoal(prior=prior, weight=weight))
    for q in some_poses(robot, 3, size=0.4):
        rows = rows_at(problem, q)
        energy = prior.energy(robot, q) - prior.min_energy
        assert rows.cost == pytest.approx(0.5 * rows.residual @ rows.residual, rel=1e-12)
        assert rows.cost / weight**2 == pytest.approx(energy, rel=1e-9, abs=1e-9)
        gradient = np.zeros(robot.nv)
        gradient[rows.dofs] = -rows.jacobian.T @ rows.residual / weight**2
        numeric = np.zeros(robot.nv)
        for v in range(robot.nv):
            step = np.zeros(robot.nv)
            step[v] = 1e-6
            forward = prior.energy(robot, robot.integrate(q, step))
            backward = prior.energy(robot, robot.integrate(q, -step))
            numeric[v] = (forward - backward) / 2e-6
        np.testing.assert_allclose(gradient, numeric, atol=1e-6 * max(1.0, np.abs(numeric).max()))


def test_gauss_newton_steps_never_make_a_pose_less_likely(
    robot: rik.Robot, prior: PosePrior
) -> None:
    problem = Problem(robot, PosePriorGoal(prior=prior))
    for q in some_poses(robot, 3, size=0.5):
        energies = [prior.energy(robot, q)]
        for _ in range(8):
            rows = rows_at(problem, q)
            step = np.zeros(robot.nv)
            step[rows.dofs] = np.linalg.lstsq(rows.jacobian, rows.residual, rcond=None)[0]
            q = robot.integrate(q, step)
            energies.append(prior.energy(robot, q))
        # The features of leans and balls are not linear: long steps may raise the energy a little.
        assert (np.diff(energies) < 1e-2 * max(1.0, energies[0] - energies[-1])).all()
        assert energies[-1] < energies[0]
        assert energies[-1] >= prior.min_energy - 1e-9


def test_place_and_heading_do_not_change_the_energy(humanoid: rik.Robot) -> None:
    prior = PosePrior.of(humanoid)
    q = humanoid.home.copy()
    moved = q.copy()
    moved[:3] += [3.0, -2.0, 0.4]
    moved[3:7] = np.cos(0.7), 0.0, 0.0, np.sin(0.7)
    assert prior.energy(humanoid, moved) == pytest.approx(float(prior.energy(humanoid, q)))
    tilted = q.copy()
    tilted[3:7] = np.cos(0.4), 0.0, np.sin(0.4), 0.0
    assert prior.energy(humanoid, tilted) > prior.energy(humanoid, q) + 1.0


def test_a_prior_is_saved_and_loaded(robot: rik.Robot, prior: PosePrior, tmp_path: Path) -> None:
    prior.save(tmp_path / "prior.npz")
    again = PosePrior.load(tmp_path / "prior.npz")
    poses = some_poses(robot, 5)
    np.testing.assert_allclose(again.energy(robot, poses), prior.energy(robot, poses), rtol=1e-4)
    assert again.names == prior.names == feature_names(robot)
    assert again.contour == prior.contour
    (tmp_path / "prior.npz").write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="is no pose prior"):
        PosePrior.load(tmp_path / "prior.npz")


def test_learning_finds_the_parts_of_a_mixture() -> None:
    puma = rik.load_robot("puma560")
    rng = np.random.default_rng(5)
    middles = np.array([np.full(6, -0.8), np.full(6, 0.6)])
    poses = np.concatenate([middle + 0.1 * rng.standard_normal((150, 6)) for middle in middles])
    prior = fit_pose_prior(puma, poses, parts=2, mirror=False)
    means = prior.means * prior.spread + prior.middle
    assert np.abs(means[np.argsort(means[:, 0])] - middles).max() < 0.03
    assert prior.weights == pytest.approx([0.5, 0.5], abs=0.02)
    inside = prior.energy(puma, poses) <= prior.contour
    assert inside.mean() == pytest.approx(0.99, abs=0.01)
    assert prior.energy(puma, np.zeros(6)) > prior.contour  # between the two
    again = fit_pose_prior(puma, poses, parts=2, mirror=False)
    assert (again.means == prior.means).all()  # same seed, same bits
    with pytest.raises(InvalidGoalError, match="too few"):
        fit_pose_prior(puma, poses[:30], parts=4, mirror=False)
    with pytest.raises(InvalidGoalError, match="positive definite"):
        PosePrior(("joint1",), [0.0], [1.0], [1.0], [[0.0]], [[[-1.0]]])  # type: ignore[arg-type]


def test_thinning_keeps_poses_that_are_far_apart() -> None:
    x = np.concatenate([np.zeros((50, 2)), [[1.0, 0.0], [0.0, 1.0]]])
    kept = thinned(x, 3)
    assert {50, 51} <= set(kept.tolist())
    assert len(kept) == 3


@pytest.mark.parametrize("name", ["humanoid", "lion"])
def test_a_mirrored_pose_has_mirrored_frames(name: str) -> None:
    robot = rik.load_robot(name)
    q = some_poses(robot, 1)[0]
    other = mirrored(robot, q)
    np.testing.assert_allclose(mirrored(robot, other), q, atol=1e-15)
    for frame in robot.file.tools:
        opposite = frame.replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")
        position = robot.measure(q, frame).position
        mirrored_position = robot.measure(other, opposite).position
        np.testing.assert_allclose(mirrored_position, position * [1.0, -1.0, 1.0], atol=1e-9)


def test_given_feet_and_a_hand_the_answer_is_likelier_and_as_exact(humanoid: rik.Robot) -> None:
    """The positions are between those of the training poses. Most answers are in the contour."""
    prior = PosePrior.of(humanoid)
    home = humanoid.home
    feet = [rik.PoseGoal.at(f, humanoid.forward(home, f)) for f in ("left_foot", "right_foot")]
    inside = []
    for position in ((0.42, -0.2, 1.2), (0.3, -0.45, 1.0), (0.25, -0.1, 1.45), (0.4, -0.3, 0.9)):
        hand = rik.PositionGoal("right_hand", position)
        plain = rik.solve(humanoid, [*feet, hand], solver="lm")
        likely = rik.solve(humanoid, [*feet, hand, PosePriorGoal(prior=prior)], solver="lm")
        assert likely.converged
        assert likely.error.position < 1e-4
        assert prior.energy(humanoid, likely.q) < prior.energy(humanoid, plain.q)
        inside.append(prior.energy(humanoid, likely.q) < prior.contour)
        # A solve from the solution stays there, so it is a minimum.
        again = rik.solve(
            humanoid, [*feet, hand, PosePriorGoal(prior=prior)], solver="lm", start=likely.q
        )
        assert np.abs(humanoid.difference(likely.q, again.q)).max() < 0.05
    assert sum(inside) >= 3


def test_the_bundled_prior_accepts_the_bundled_motions(humanoid: rik.Robot) -> None:
    prior = PosePrior.of(humanoid)
    book = KeyPoses.load(humanoid.folder / "poses.toml", humanoid)
    walk: Keyframes = book.motion("walk")
    energy = prior.energy(humanoid, walk.sampled(20.0).q)
    assert (energy < prior.contour).mean() > 0.8
    assert walk.q[-1, 0] - walk.q[0, 0] > 0.9  # metres in a cycle of two steps
    wild = some_poses(humanoid, 20, size=0.8)
    assert (prior.energy(humanoid, wild) > prior.contour).all()


def test_wrong_priors_and_goals_are_refused(humanoid: rik.Robot) -> None:
    prior = PosePrior.of(humanoid)
    puma = rik.load_robot("puma560")
    with pytest.raises(InvalidGoalError, match="must be a PosePrior, not None"):
        PosePriorGoal(prior=None)  # type: ignore[arg-type]
    with pytest.raises(InvalidGoalError, match="always soft"):
        PosePriorGoal(prior=prior, soft=False)
    with pytest.raises(InvalidGoalError, match="2 pose prior goals"):
        Problem(humanoid, [PosePriorGoal(prior=prior), PosePriorGoal(prior=prior, weight=2.0)])
    with pytest.raises(UnknownJointError):
        Problem(puma, PosePriorGoal(prior=prior))
    with pytest.raises(ModelError, match="no pose prior is bundled with 'puma560'"):
        PosePrior.of(puma)
    with pytest.raises(UnsupportedGoalError, match="soft"):
        Problem(humanoid, PosePriorGoal(prior=prior), solver="dls")
    goal = PosePriorGoal(prior=prior)
    with pytest.raises(InvalidGoalError, match="no pose to move"):
        goal.moved_to(rik.Pose())
    assert goal == PosePriorGoal(prior=prior)
    assert hash(goal) == hash(PosePriorGoal(prior=prior))
    assert "PosePrior(" in repr(goal)


def test_the_residual_is_in_proportion_to_the_weight(humanoid: rik.Robot) -> None:
    prior = PosePrior.of(humanoid)
    first = rows_at(Problem(humanoid, PosePriorGoal(prior=prior)), humanoid.home)
    second = rows_at(Problem(humanoid, PosePriorGoal(prior=prior, weight=2.0)), humanoid.home)
    np.testing.assert_allclose(second.residual, 2.0 * first.residual)
    np.testing.assert_allclose(second.jacobian, 2.0 * first.jacobian)


def test_the_public_names_include_the_prior_and_its_goal() -> None:
    assert rik.PosePriorGoal is PosePriorGoal
    assert rik.PosePrior is PosePrior


def test_the_page_shows_the_measured_numbers() -> None:
    docs = Path(__file__).parents[3] / "docs"
    measured = json.loads((docs / "pose_prior.json").read_text(encoding="utf-8"))
    page = (docs / "how-to" / "poses.md").read_text(encoding="utf-8")
    labels = {"goals alone": "goals alone", "with a posture goal": "with a soft posture (home)"}
    for name, row in measured["rows"].items():
        degrees = row["rms of elbows and spine, degrees"]
        inside = row["inside the 99 % contour"]
        nearest = row["nearest pose"]
        error_mm = row["largest error of the hand, mm"]
        cells = [f"{degrees:.1f}°", f"{inside:.0%}", f"{nearest:.2f}", f"{error_mm:.2f} mm"]
        line = f"| {' | '.join([labels.get(name, name), *cells])} |"
        assert line.replace("%", " %") in page
    assert f"{measured['held out']} of {measured['motions']} motions were held out" in page
    share = f"{measured['held-out poses inside the contour']:.0%}".replace("%", " %")
    assert f"The held-out poses themselves are {share} inside" in page
    key = "rms of elbows and spine, degrees"
    with_prior = measured["rows"]["with the prior"][key]
    assert with_prior < 0.6 * measured["rows"]["goals alone"][key]
