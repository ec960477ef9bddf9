"""The memory of a problem: calls in any order, threads, copies."""

import copy
import gc
import pickle
import subprocess
import sys
import textwrap
import threading
from dataclasses import dataclass, field

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import ProblemInUseError
from robot_ik.problem import Problem
from robot_ik.solvers import SOLVERS
from robot_ik.solvers.base import BatchResult, Solver


@pytest.fixture(scope="module")
def puma():
    return rik.load_robot("puma560")


def problem_for(name, robot, seed=0):
    """Return a problem that the method supports, and poses (5, 4, 4) for its target."""
    rng = np.random.default_rng(seed)
    poses = [robot.forward(robot.sample(rng)) for _ in range(5)]
    kind = rik.PoseGoal if issubclass(rik.PoseGoal, SOLVERS[name].goals) else rik.PositionGoal
    goal = kind(None, poses[0].position)
    matrices = np.array([pose.matrix for pose in poses])
    budget = rik.Budget(iterations=60, restarts=2)
    return Problem(robot, goal, solver=name, budget=budget), poses, matrices


@pytest.mark.parametrize("name", SOLVERS)
def test_solve_and_batch_in_turn_give_the_results_of_separate_calls(puma, name):
    problem, _, matrices = problem_for(name, puma)
    alone = problem.solve().q
    starts = np.tile(puma.home, (5, 1))
    results = BatchResult.empty(5, puma.nq)
    problem.solve_many(matrices, starts, results)
    first = results.q.copy()
    problem.replace_goals(problem.given)
    gc.collect()
    assert np.array_equal(problem.solve().q, alone)
    problem.solve_many(matrices, starts, results)
    assert np.array_equal(results.q, first)


STRESS = """
    import copy, gc, pickle, sys, threading
    import numpy as np
    import robot_ik as rik
    from robot_ik.errors import ProblemInUseError, RobotIkError
    from robot_ik.problem import Problem
    from robot_ik.solvers import SOLVERS
    from robot_ik.solvers.base import BatchResult

    def work(name, seed, shared):
        rng = np.random.default_rng(seed)
        own = rik.load_robot("puma560")
        kind = rik.PoseGoal if issubclass(rik.PoseGoal, SOLVERS[name].goals) else rik.PositionGoal
        budget = rik.Budget(iterations=20, restarts=1)
        goal = kind(None, own.forward(own.home).position)
        problem = Problem(own, goal, solver=name, budget=budget)
        for _ in range(int(sys.argv[1])):
            what, pose = rng.integers(8), own.forward(own.sample(rng))
            if what < 2:
                problem.solve(own.sample(rng))
            elif what == 2:
                many, answers = np.tile(pose.matrix, (9, 1, 1)), BatchResult.empty(9, own.nq)
                problem.solve_many(many, np.tile(own.home, (9, 1)), answers)
                assert np.isfinite(answers.q).all()
            elif what == 3:
                problem.retarget(pose.matrix)
            elif what == 4:
                problem.retarget({0: pose})
            elif what == 5:
                again = copy.copy, copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))
                problem = again[rng.integers(3)](problem)
            elif what == 6:
                problem = Problem(own, problem.goals, solver=name, budget=budget)
                gc.collect()
            else:
                try:
                    shared.retarget(pose.matrix)
                    shared.solve()
                except ProblemInUseError:
                    pass
                rik.solve(own, kind(None, pose.position), solver=name, budget=budget)
                problem.budget = rik.Budget(iterations=int(rng.integers(1, 30)), restarts=1)

    robot = rik.load_robot("puma560")
    rik.warm_up(robot)
    for name in sys.argv[2:]:
        shared = Problem(robot, rik.PoseGoal(None, (0.4, 0.1, 0.9)), solver="lm")
        failed = []
        def run(seed):
            try:
                work(name, seed, shared)
            except BaseException as error:
                failed.append(error)
        threads = [threading.Thread(target=run, args=(seed,)) for seed in range(3)]
        [t.start() for t in threads], [t.join() for t in threads]
        if failed:
            raise failed[0]
        print(name, "done", flush=True)
"""


@pytest.mark.parametrize("rounds", [3, pytest.param(200, marks=pytest.mark.soak)])
def test_calls_in_any_order_and_in_threads_never_crash(rounds):
    """It runs in a separate process, because a wrong address causes a segmentation fault."""
    code = textwrap.dedent(STRESS)
    command = [sys.executable, "-X", "faulthandler", "-c", code, str(rounds), *SOLVERS]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.split() == [word for name in SOLVERS for word in (name, "done")]


class Waiting:
    """A prepared method whose solve waits."""

    name = "waiting"

    def __init__(self):
        self.running = threading.Event()
        self.finish = threading.Event()

    def run(self, problem, budget):
        self.running.set()
        assert self.finish.wait(30.0)

    run_many = None


@dataclass(frozen=True)
class WaitingSolver(Solver):
    """A method whose solve waits."""

    prepared: Waiting = field(default_factory=Waiting, metadata={"choices": (), "lower": None})
    name = "waiting"

    def __post_init__(self):
        """No options to check."""

    def prepare(self, problem):
        return self.prepared


def test_a_call_during_another_call_is_refused(puma):
    method = WaitingSolver()
    problem = Problem(puma, puma.forward(puma.home), solver=method)
    before = problem.search.arrays["target"].copy()
    thread = threading.Thread(target=problem.solve)
    thread.start()
    assert method.prepared.running.wait(30.0)
    there = puma.forward(puma.home + 0.1)
    for call in (
        problem.solve,
        lambda: problem.retarget(there),
        lambda: problem.retarget({0: there}),
        lambda: problem.solve(target=there),
    ):
        with pytest.raises(ProblemInUseError, match="another thread"):
            call()
    assert np.array_equal(problem.search.arrays["target"], before)
    method.prepared.finish.set()
    thread.join()
    with pytest.raises(rik.RobotIkError):
        problem.solve([0.0])
    problem.solve()  # an error ends the call too


def test_threads_may_use_a_problem_in_turn(puma):
    problem, poses, _ = problem_for("auto", puma)
    expected = [problem.solve(target=pose).q for pose in poses]
    found = {}
    lock = threading.Lock()

    def one(k):
        with lock:
            found[k] = problem.solve(target=poses[k]).q

    threads = [threading.Thread(target=one, args=(k,)) for k in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(found[k], expected[k]) for k in range(5))


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_robots_goals_solutions_and_problems_can_be_copied_and_pickled(puma, again):
    pose = puma.forward(puma.home + 0.2)
    goal = rik.PoseGoal.at(None, pose)
    solution = rik.solve(puma, goal)
    robot = again(puma)
    assert np.array_equal(robot.home, puma.home) and robot.joints == puma.joints
    assert not robot.home.flags.writeable
    assert np.array_equal(rik.solve(robot, again(goal)).q, solution.q)
    other = again(solution)
    assert np.array_equal(other.q, solution.q) and other.status is solution.status
    assert other.goals == (goal,) and other.error == solution.error
    problem = Problem(puma, goal, solver="auto")
    problem.retarget(puma.forward(puma.home - 0.2))
    expected = problem.solve()
    moved = again(problem)
    del problem
    gc.collect()
    assert np.array_equal(moved.solve().q, expected.q) and moved.goals == expected.goals
    assert again(pose) == pose
