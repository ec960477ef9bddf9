"""PyRoki: nonlinear least squares in JAX, compiled for the processor."""

from __future__ import annotations

import importlib
import io
import os
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from benchmarks.peers.library import Array, Library, Source, Task, into_limits, wxyz_of

_ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
"""Options of XLA for one thread."""

_NEWTON_STEPS = 50
"""Newton steps to the root that the quasi-random starts need. It converges in about ten."""


class PyRoki(Library):
    """PyRoki: ``pose_cost_analytic_jac`` and ``limit_cost`` with the weights of its example."""

    needs = (
        "jax",
        "jaxlie",
        "jax_dataclasses",
        "jaxtyping",
        "loguru",
        "yourdfpy",
        "trimesh",
        "termcolor",
        "tqdm",
        "tyro",
        "viser",
    )
    sources = MappingProxyType(
        {
            "jaxls": Source(
                "https://github.com/brentyi/jaxls", "50a58be88c5ef74532f09e3f55268b4f02c490e3"
            ),
            "pyroki": Source(
                "https://github.com/chungmin99/pyroki", "70b30a56b1e1ea83fb4c2cac8fe2c63a0624b9ce"
            ),
        }
    )
    weights = (50.0, 10.0, 100.0)
    """Weights of position, orientation and limits."""

    def setup(self, task: Task) -> bool:
        if not task.is_arm:
            return False
        os.environ["XLA_FLAGS"] = _ONE_THREAD
        self._task = task
        self._jax = importlib.import_module("jax")
        # Single precision, the default, ends 1e-6 m and 1e-6 rad too early.
        self._jax.config.update("jax_enable_x64", True)
        # The next round does not compile again.
        self._jax.config.update("jax_compilation_cache_dir", str(task.folder / "jax_cache"))
        self._lie = importlib.import_module("jaxlie")
        self._least_squares = importlib.import_module("jaxls")
        self._pyroki = importlib.import_module("pyroki")
        logger = importlib.import_module("loguru").logger
        logger.disable("jaxls")
        logger.disable("pyroki")
        text = Path(task.urdf).read_text(encoding="utf-8")
        urdf = importlib.import_module("yourdfpy").URDF.load(io.StringIO(text), load_meshes=False)
        self._robot = self._pyroki.Robot.from_urdf(urdf)
        names = list(self._robot.joints.actuated_names)
        self._order = np.array([task.joints.index(name) for name in names])
        self._link = self._robot.links.names.index(task.sites[0])
        self._solve = self._jax.jit(self.search)
        self._forward = self._jax.jit(self._robot.forward_kinematics)
        weights = f"weights {self.weights} of position, orientation and limits"
        self.settings = f"{weights}; {self.search_settings()}"
        return True

    def search_settings(self) -> str:
        """Return the settings of the search."""
        return "one start, 64-bit numbers"

    def search(self, wxyz: Array, position: Array, start: Array) -> Array:
        """Return joint angles for a target, from a start. JAX compiles it."""
        termination = self._least_squares.TerminationConfig(
            cost_tolerance=1e-14, gradient_tolerance=1e-12, parameter_tolerance=1e-12
        )
        trust_region = self._least_squares.TrustRegionConfig(lambda_initial=1.0)
        q, _ = self.minimise(wxyz, position, start, termination, trust_region)
        return q

    def minimise(
        self, wxyz: Array, position: Array, start: Array, termination: Any, trust_region: Any
    ) -> tuple[Array, Any]:
        """Return joint angles and the summary of one search of jaxls."""
        lie = self._lie
        target = lie.SE3.from_rotation_and_translation(lie.SO3(wxyz), position)
        variable = self._robot.joint_var_cls(0)
        for_position, for_orientation, for_limits = self.weights
        costs = [
            self._pyroki.costs.pose_cost_analytic_jac(
                self._robot,
                variable,
                target,
                self._jax.numpy.array(self._link, dtype="int32"),
                pos_weight=for_position,
                ori_weight=for_orientation,
            ),
            self._pyroki.costs.limit_cost(self._robot, variable, weight=for_limits),
        ]
        problem = self._least_squares.LeastSquaresProblem(costs, [variable]).analyze()
        solution, summary = problem.solve(
            initial_vals=self._least_squares.VarValues.make([variable.with_value(start)]),
            verbose=False,
            linear_solver="dense_cholesky",
            trust_region=trust_region,
            termination=termination,
            return_summary=True,
        )
        return solution[variable], summary

    def solve(self, target: Array, start: Array) -> Array | None:
        wxyz = np.array(wxyz_of(target[:3, :3]))
        answer = np.asarray(self._solve(wxyz, target[:3, 3], start[self._order]))
        q = np.empty(len(answer))
        q[self._order] = answer
        # The limits are soft: an angle may be a little beyond one.
        return np.clip(into_limits(q, self._task), self._task.lower, self._task.upper)

    def forward(self, q: Array) -> Array:
        row = np.asarray(self._forward(q[self._order]))[self._link]
        return np.asarray(self._lie.SE3(row).as_matrix())


class PyRokiBeam(PyRoki):
    """PyRoki's benchmark: 64 starts, 6 steps each, then 10 steps of the best four."""

    weights = (10.0, 5.0, 50.0)
    starts = 64
    first_steps = 6
    best = 4
    last_steps = 10

    def search_settings(self) -> str:
        return (
            f"{self.starts} quasi-random starts with {self.first_steps} steps, then "
            f"{self.last_steps} steps of the best {self.best}; 64-bit numbers"
        )

    def search(self, wxyz: Array, position: Array, start: Array) -> Array:
        del start  # it has its own starts
        jax = self._jax
        jnp = jax.numpy

        def descend(q: Array, damping: Array, steps: int) -> tuple[Array, Array, Array]:
            termination = self._least_squares.TerminationConfig(
                max_iterations=steps, early_termination=False
            )
            trust_region = self._least_squares.TrustRegionConfig(lambda_initial=damping)
            answer, summary = self.minimise(wxyz, position, q, termination, trust_region)
            last = summary.iterations
            return answer, summary.cost_history[last], summary.lambda_history[last]

        descend_all = jax.vmap(descend, in_axes=(0, 0, None))
        lower = self._task.lower[self._order]
        upper = self._task.upper[self._order]
        starts = lower + quasi_random(self.starts, len(lower)) * (upper - lower)
        damping = jnp.full(self.starts, 10.0)
        q, costs, damping = descend_all(jnp.array(starts), damping, self.first_steps)
        best = jnp.argsort(costs)[: self.best]
        q, costs, _ = descend_all(q[best], damping[best], self.last_steps)
        return q[jnp.argmin(costs)]


def quasi_random(number: int, size: int) -> Array:
    """Return points (number, size) of Roberts' quasi-random sequence in the unit cube."""
    root = 1.0
    for _ in range(_NEWTON_STEPS):
        value = root ** (size + 1) - root - 1.0
        root -= value / ((size + 1) * root**size - 1.0)
    steps = 1.0 - root ** -(1.0 + np.arange(size))
    return np.modf(np.arange(number)[:, None] * steps)[0]
