"""Differential inverse kinematics: one quadratic program a step, iterated until the goal is met."""

from __future__ import annotations

import importlib

import numpy as np

from benchmarks.peers.library import Array, Library, Task

_TOLERANCE_SHARE = 0.9
"""Share of the tolerance at which the iteration ends, so that rounding does not decide."""

_SEED = 1
"""Seed of the random starts."""

_DAMPING = 1e-12
"""Damping of mink and pink: their default."""

_LM_DAMPING = 1e-2
"""Levenberg-Marquardt damping of the frame tasks of mink and pink. Of 1, 1e-2 and 1e-4 it solved
random poses of the PUMA and the Panda in the least time."""

_LIMIT_SHARE = 0.95
"""Share of the way to a joint limit that a step of pink may go. Its default of 0.5 needs more
steps beside a limit."""

_REGULARISATION = 1e-6
"""Weight of placo's regularisation task."""


class Descent(Library):
    """Steps from the start, and optionally from random joint angles, until the goal is met.

    Attributes:
        steps: Largest number of steps from one start.
        restarts: Largest number of random starts.
    """

    steps = 200
    restarts = 0

    def prepare(self, task: Task) -> bool:
        """Keep the task. Return whether the library can serve it."""
        self._task = task
        self._rng = np.random.default_rng(_SEED)
        self._position = _TOLERANCE_SHARE * task.position
        self._angle = _TOLERANCE_SHARE * task.angle
        return self.restarts == 0 or task.is_arm

    def aim(self, target: Array) -> None:
        """Set the target: a pose (4, 4), or positions (sites, 3)."""
        raise NotImplementedError

    def put(self, q: Array) -> None:
        """Set the joint angles (nq,)."""
        raise NotImplementedError

    def get(self) -> Array:
        """Return the joint angles (nq,)."""
        raise NotImplementedError

    def is_met(self) -> bool:
        """Return whether the goal is met at the joint angles."""
        raise NotImplementedError

    def step(self) -> bool:
        """Make one step. Return False if the quadratic program has no solution."""
        raise NotImplementedError

    def solve(self, target: Array, start: Array) -> Array | None:
        self.aim(target)
        if not self._descend(start):
            for _ in range(self.restarts):
                if self._descend(self._rng.uniform(self._task.lower, self._task.upper)):
                    break
        return self.get()

    def _descend(self, start: Array) -> bool:
        """Step from a start until the goal is met. Return whether it is."""
        self.put(start)
        for _ in range(self.steps):
            if self.is_met():
                return True
            if not self.step():
                return False
        return self.is_met()

    def described(self, detail: str) -> str:
        """Return the settings with a detail."""
        return f"{detail}, at most {self.steps} steps a start, {self.restarts} random starts"


class Mink(Descent):
    """mink: frame tasks on MuJoCo, DAQP, full steps inside the joint limits."""

    needs = ("mink", "daqp")

    def setup(self, task: Task) -> bool:
        if not self.prepare(task):
            return False
        self._mink = importlib.import_module("mink")
        mujoco = importlib.import_module("mujoco")
        model = mujoco.MjModel.from_xml_path(str(task.folder / "model.xml"))
        self._configuration = self._mink.Configuration(model)
        self._limits = [self._mink.ConfigurationLimit(model)]
        self._tasks = [
            self._mink.FrameTask(
                site,
                "site",
                position_cost=1.0,
                orientation_cost=1.0 if task.is_arm else 0.0,
                gain=1.0,
                lm_damping=_LM_DAMPING,
            )
            for site in task.sites
        ]
        self.settings = self.described(f"daqp, gain 1, dt 1, lm_damping {_LM_DAMPING}")
        return True

    def aim(self, target: Array) -> None:
        if self._task.is_arm:
            self._tasks[0].set_target(self._mink.SE3.from_matrix(target))
            return
        for frame_task, position in zip(self._tasks, target, strict=True):
            frame_task.set_target(self._mink.SE3.from_translation(position))

    def put(self, q: Array) -> None:
        self._configuration.update(q)

    def get(self) -> Array:
        return self._configuration.q

    def is_met(self) -> bool:
        for frame_task in self._tasks:
            error = frame_task.compute_error(self._configuration)
            if error[:3] @ error[:3] > self._position**2:
                return False
            if self._task.is_arm and error[3:] @ error[3:] > self._angle**2:
                return False
        return True

    def step(self) -> bool:
        try:
            velocity = self._mink.solve_ik(
                self._configuration, self._tasks, 1.0, "daqp", _DAMPING, limits=self._limits
            )
        except self._mink.NoSolutionFound:
            return False
        self._configuration.integrate_inplace(velocity, 1.0)
        return True

    def forward(self, q: Array) -> Array | None:
        if not self._task.is_arm:
            return None
        self._configuration.update(q)
        site = self._task.sites[0]
        return self._configuration.get_transform_frame_to_world(site, "site").as_matrix()


class MinkRestarts(Mink):
    """mink with random starts, for arms."""

    steps = 15
    restarts = 30


class Pink(Descent):
    """pink: frame tasks on Pinocchio, DAQP, full steps inside the joint limits."""

    needs = ("pin-pink", "daqp")

    def setup(self, task: Task) -> bool:
        if not self.prepare(task):
            return False
        self._pink = importlib.import_module("pink")
        self._pin = importlib.import_module("pinocchio")
        if task.free_base:
            model = self._pin.buildModelFromUrdf(task.urdf, self._pin.JointModelFreeFlyer())
        else:
            model = self._pin.buildModelFromUrdf(task.urdf)
        first = 2 if task.free_base else 1  # after the universe and the free joint
        self._order = np.array([task.joints.index(name) for name in list(model.names)[first:]])
        self._configuration = self._pink.Configuration(
            model, model.createData(), self._its_q(task.home)
        )
        self._limits = [self._pink.limits.ConfigurationLimit(model, _LIMIT_SHARE)]
        self._tasks = [
            self._pink.FrameTask(
                site,
                position_cost=1.0,
                orientation_cost=1.0 if task.is_arm else 0.0,
                lm_damping=_LM_DAMPING,
                gain=1.0,
            )
            for site in task.sites
        ]
        self.settings = self.described(
            f"daqp, gain 1, dt 1, lm_damping {_LM_DAMPING}, config_limit_gain {_LIMIT_SHARE}"
        )
        return True

    def _its_q(self, q: Array) -> Array:
        """Return joint angles in Pinocchio's order. Its quaternions are x y z w."""
        if not self._task.free_base:
            return q[self._order]
        return np.concatenate([q[:3], q[4:7], q[3:4], q[7:][self._order]])

    def aim(self, target: Array) -> None:
        if self._task.is_arm:
            self._tasks[0].set_target(self._pin.SE3(target[:3, :3], target[:3, 3]))
            return
        for frame_task, position in zip(self._tasks, target, strict=True):
            frame_task.set_target(self._pin.SE3(np.eye(3), position))

    def put(self, q: Array) -> None:
        self._configuration.update(self._its_q(q))

    def get(self) -> Array:
        q = self._configuration.q
        base = (*q[:3], q[6], *q[3:6]) if self._task.free_base else ()
        joints = np.empty(len(self._order))
        joints[self._order] = q[len(base) :]
        return np.concatenate([base, joints])

    def is_met(self) -> bool:
        for frame_task in self._tasks:
            error = frame_task.compute_error(self._configuration)
            if error[:3] @ error[:3] > self._position**2:
                return False
            if self._task.is_arm and error[3:] @ error[3:] > self._angle**2:
                return False
        return True

    def step(self) -> bool:
        try:
            velocity = self._pink.solve_ik(
                self._configuration,
                self._tasks,
                1.0,
                "daqp",
                _DAMPING,
                limits=self._limits,
                safety_break=False,
            )
        except self._pink.exceptions.NoSolutionFound:
            return False
        self._configuration.integrate_inplace(velocity, 1.0)
        return True

    def forward(self, q: Array) -> Array | None:
        if not self._task.is_arm:
            return None
        self.put(q)
        return self._configuration.get_transform_frame_to_world(self._task.sites[0]).homogeneous


class PinkRestarts(Pink):
    """pink with random starts, for arms."""

    steps = 15
    restarts = 30


class Placo(Descent):
    """placo: a whole-body solver (C++), soft tasks, full steps inside the joint limits."""

    needs = ("placo",)

    def setup(self, task: Task) -> bool:
        if not self.prepare(task):
            return False
        placo = importlib.import_module("placo")
        self._robot = placo.RobotWrapper(task.urdf, placo.Flags.ignore_collisions)
        self._solver = placo.KinematicsSolver(self._robot)
        self._solver.enable_joint_limits(True)
        self._solver.enable_velocity_limits(False)
        self._solver.dt = 1.0
        names = list(self._robot.joint_names())
        self._order = np.array([task.joints.index(name) for name in names])
        if task.free_base:
            self._points = [
                self._solver.add_position_task(site, np.zeros(3)) for site in task.sites
            ]
            for point in self._points:
                point.configure("point", "soft", 1.0)
        else:
            self._solver.mask_fbase(True)
            self._frame = self._solver.add_frame_task(task.sites[0], np.eye(4))
            self._frame.configure("frame", "soft", 1.0, 1.0)
        self._solver.add_regularization_task(_REGULARISATION)
        self.settings = self.described(f"soft tasks, regularisation {_REGULARISATION:g}, dt 1")
        return True

    def aim(self, target: Array) -> None:
        if not self._task.free_base:
            self._frame.T_world_frame = target
            return
        for point, position in zip(self._points, target, strict=True):
            point.target_world = position

    def put(self, q: Array) -> None:
        state = self._robot.state.q.copy()
        if self._task.free_base:
            state[:7] = (*q[:3], *q[4:7], q[3])  # its quaternions are x y z w
            state[7:] = q[7:][self._order]
        else:
            state[7:] = q[self._order]
        self._robot.state.q = state
        self._robot.update_kinematics()

    def get(self) -> Array:
        state = np.asarray(self._robot.state.q)
        base = (*state[:3], state[6], *state[3:6]) if self._task.free_base else ()
        joints = np.empty(len(self._order))
        joints[self._order] = state[7:]
        return np.concatenate([base, joints])

    def is_met(self) -> bool:
        if self._task.free_base:
            for point in self._points:
                point.update()
            return max(point.error_norm() for point in self._points) < self._position
        position = self._frame.position()
        orientation = self._frame.orientation()
        position.update()
        orientation.update()
        is_near = position.error_norm() < self._position
        return is_near and orientation.error_norm() < self._angle

    def step(self) -> bool:
        try:
            self._solver.solve(True)
        except RuntimeError:  # the quadratic program has no solution
            return False
        self._robot.update_kinematics()
        return True

    def forward(self, q: Array) -> Array | None:
        if self._task.free_base:
            return None
        self.put(q)
        return np.asarray(self._robot.get_T_world_frame(self._task.sites[0]))


class PlacoRestarts(Placo):
    """placo with random starts, for arms."""

    steps = 40
    restarts = 60
