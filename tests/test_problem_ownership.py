"""Who owns what compiled code sees: no address outlives its array, whatever is called in which order."""

import copy
import gc
import pickle
import subprocess
import sys
import textwrap
import threading

import numpy as np
import pytest

import robot_ik as rik
from robot_ik.errors import ProblemInUseError, RobotIkError
from robot_ik.goals import Rows
from robot_ik.kernels.residuals import ONE_SIDE
from robot_ik.problem import Problem
from robot_ik.solvers import SOLVERS, make_solver
from robot_ik.solvers.base import BatchResult


@pytest.fixture(scope="module")
def puma():
    return rik.load_robot("puma560")


def problem_for(name, robot, seed=0):
    """A problem of a kind that the method serves, and poses (5, 12) to move it to."""
    rng = np.random.default_rng(seed)
    poses = [robot.forward(robot.sample(rng)) for _ in range(5)]
    kind = rik.PoseGoal if issubclass(rik.PoseGoal, SOLVERS[name].goals) else rik.PositionGoal
    goal = kind(None, poses[0].position)
    rows = np.array([np.concatenate([pose.position, pose.rotation.ravel()]) for pose in poses])
    budget = rik.Budget(iterations=60, restarts=2)
    return Problem(robot, goal, budget=budget), poses, rows


def test_rows_of_a_new_sort_are_never_proven_out_of_reach(puma):
    class OnSphere(
        rik.PositionGoal
    ):  # 2.5 m from the point, say: what the kernels must know is not asked here
        @property
        def rows(self):
            return Rows(position=ONE_SIDE + 1)

    far = (3.0, 0.0, 0.6)
    assert np.isfinite(Problem(puma, rik.PositionGoal(None, far)).arrays["reach"][0, 3])
    assert Problem(puma, OnSphere(None, far)).arrays["reach"][0, 3] == np.inf


def owned(table):
    """The arrays that a packed table points to and keeps alive, row by row; of another array: none."""
    return getattr(table.base, "arrays", ())


def tables_of(table, seen):
    """The table and all tables that it leads to; each address in them must be that of an array it owns."""
    seen.append(table)
    arrays = owned(table)
    assert len(arrays) == len(table)
    for (address, *_), array in zip(table.tolist(), arrays, strict=True):
        assert address == array.__array_interface__["data"][0]
        if owned(array):
            tables_of(array, seen)
    return seen


@pytest.mark.parametrize("name", SOLVERS)
def test_every_address_is_held_together_with_what_it_points_to(puma, name):
    problem, _, _ = problem_for(name, puma)
    solver = make_solver(name)
    solver.solve(problem)
    known = [array for table in problem.tables for array in owned(table)]
    assert {id(array) for array in (*problem.arrays.values(), *problem.goal_arrays.values())} <= {
        id(array) for array in known
    }
    assert problem.made
    for key, (owner, kept) in problem.made.items():
        assert key == id(owner)  # so that no other solver gets this id
        packed = [table for table in getattr(kept, "tables", ()) if owned(table)]
        held = {table.__array_interface__["data"][0] for start in packed for table in tables_of(start, [])}
        taken = getattr(kept, "arguments", getattr(kept, "addresses", ()))
        assert {x for x in taken if isinstance(x, int)} <= held


def test_a_table_keeps_its_arrays_when_nobody_else_does():
    from robot_ik.kernels.bundle import Layout

    table = Layout("One", numbers="floats").pack({"numbers": np.arange(1000.0)})
    gc.collect()
    assert owned(table)[0].sum() == 499500.0


@pytest.mark.parametrize("name", SOLVERS)
def test_solve_and_batch_in_turn_give_what_each_gives_alone(puma, name):
    solver = make_solver(name)
    problem, _, rows = problem_for(name, puma)
    alone = solver.solve(problem).q
    starts, results = np.tile(puma.home, (5, 1)), BatchResult.empty(5, puma.nq)
    solver.attempt_many(problem, rows, starts, results, problem.budget)
    first = results.q.copy()
    problem.target[0] = rows[0] if problem.given[0].has_angle else [*rows[0, :3], *np.eye(3).ravel()]
    problem.exchange(problem.given)
    gc.collect()
    assert np.array_equal(solver.solve(problem).q, alone)
    solver.attempt_many(problem, rows, starts, results, problem.budget)
    assert np.array_equal(results.q, first)


STRESS = """
    import copy, gc, pickle, sys, threading
    import numpy as np
    import robot_ik as rik
    from robot_ik.errors import ProblemInUseError, RobotIkError
    from robot_ik.problem import Problem
    from robot_ik.solvers import SOLVERS, make_solver
    from robot_ik.solvers.base import BatchResult

    def work(name, seed, shared):
        rng = np.random.default_rng(seed)
        own = rik.load_robot("puma560")
        kind = rik.PoseGoal if issubclass(rik.PoseGoal, SOLVERS[name].goals) else rik.PositionGoal
        budget = rik.Budget(iterations=20, restarts=1)
        problem = Problem(own, kind(None, own.forward(own.home).position), budget=budget)
        solvers = [make_solver(name), make_solver(name), make_solver("lm")]
        for _ in range(int(sys.argv[1])):
            what, pose = rng.integers(8), own.forward(own.sample(rng))
            solver = solvers[rng.integers(3)]
            if what < 2:
                solver.solve(problem, own.sample(rng))
            elif what == 2:
                row = np.concatenate([pose.position, pose.rotation.ravel()])
                many, answers = np.tile(row, (9, 1)), BatchResult.empty(9, own.nq)
                with problem.in_use():
                    solver.attempt_many(problem, many, np.tile(own.home, (9, 1)), answers, budget)
                assert np.isfinite(answers.q).all()
            elif what == 3:
                problem.retarget(pose.matrix)
            elif what == 4:
                problem.retarget({0: pose})
            elif what == 5:
                again = copy.copy, copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))
                problem = again[rng.integers(3)](problem)
            elif what == 6:
                solvers[rng.integers(2)] = make_solver(name)
                gc.collect()
            else:
                try:
                    shared.retarget(pose.matrix)
                    make_solver("lm").solve(shared)
                except ProblemInUseError:
                    pass
                rik.solve(own, kind(None, pose.position), solver=name, budget=budget)
                problem.budget = rik.Budget(iterations=int(rng.integers(1, 30)), restarts=1)

    robot = rik.load_robot("puma560")
    rik.warm_up(robot)
    for name in sys.argv[2:]:
        shared = Problem(robot, rik.PoseGoal(None, (0.4, 0.1, 0.9)))
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
def test_solves_batches_moves_copies_collections_and_threads_in_any_order_never_crash(rounds):
    """In a process of its own: what a bare address would end in is a segmentation fault."""
    code = textwrap.dedent(STRESS)
    command = [sys.executable, "-X", "faulthandler", "-c", code, str(rounds), *SOLVERS]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.split() == [word for name in SOLVERS for word in (name, "done")]


def test_a_call_that_begins_while_another_is_under_way_is_refused(puma):
    problem, poses, _ = problem_for("lm", puma)
    solver = make_solver("lm")
    before = problem.target.copy()
    with problem.in_use():  # as during another thread's call
        for call in (
            lambda: solver.solve(problem),
            lambda: make_solver("auto").solve(problem),
            lambda: make_solver("analytic").branches(problem),
            lambda: problem.retarget(poses[1]),
            lambda: problem.retarget({0: poses[1]}),
        ):
            with pytest.raises(ProblemInUseError, match="another thread") as caught:
                call()
            assert isinstance(caught.value, RobotIkError)
    assert np.array_equal(problem.target, before)
    with pytest.raises(rik.RobotIkError):
        solver.solve(problem, [0.0])
    assert solver.solve(problem).iterations  # an error lets go of it too


def test_threads_may_use_a_problem_in_turn(puma):
    problem, poses, _ = problem_for("auto", puma)
    solver, expected = make_solver("auto"), []
    for pose in poses:
        problem.retarget(pose)
        expected.append(solver.solve(problem).q)
    found, lock = {}, threading.Lock()

    def one(k):
        with lock:
            problem.retarget(poses[k])
            found[k] = solver.solve(problem).q

    threads = [threading.Thread(target=one, args=(k,)) for k in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(found[k], expected[k]) for k in range(5))


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_robots_goals_solutions_and_problems_can_be_copied_and_pickled(puma, again):
    pose = puma.forward(puma.home + 0.2)
    goal = rik.PoseGoal.at(None, pose)
    solution = rik.solve(puma, goal)  # the robot now has compiled problems in its memory
    robot = again(puma)
    assert np.array_equal(robot.home, puma.home) and robot.joints == puma.joints
    assert not robot.home.flags.writeable
    assert np.array_equal(rik.solve(robot, again(goal)).q, solution.q)
    other = again(solution)
    assert np.array_equal(other.q, solution.q) and other.status is solution.status
    assert other.goals == (goal,) and other.miss == solution.miss
    problem = Problem(puma, goal, solver="auto")
    problem.retarget(puma.forward(puma.home - 0.2))
    expected = problem.solve()
    moved = again(problem)
    del problem
    gc.collect()
    assert np.array_equal(make_solver("auto").solve(moved).q, expected.q) and moved.goals == expected.goals
    assert again(pose) == pose
