"""What the tests of the arms that people own share: the README's tables, and the model by them alone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.hardware.config import ArmConfig

Array = NDArray[np.float64]

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class OwnedArm:
    """A model folder as tests look at it.

    Attributes:
        name: Of the folder.
        base: Rotation of the base's frame in the world, (3, 3).
    """

    name: str
    base: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    @property
    def folder(self) -> Path:
        return Path(__file__).parents[2] / "models" / self.name

    @cached_property
    def readme(self) -> str:
        return (self.folder / "README.md").read_text(encoding="utf-8")

    @cached_property
    def robot(self) -> rik.Robot:
        return rik.load_robot(self.name)

    @cached_property
    def config(self) -> ArmConfig:
        return ArmConfig.load(self.folder / "arm.toml")

    @cached_property
    def model(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_path(str(self.folder / f"{self.name}.xml"))

    @cached_property
    def scene(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_path(str(self.folder / "scene.xml"))

    def rows(self, head: str) -> list[list[str]]:
        """Cells of the README's table that starts so."""
        lines = self.readme[self.readme.index(head) :].split("\n\n")[0].splitlines()[2:]
        return [
            [cell.strip().strip("`").replace("−", "-") for cell in line.strip("|").split("|")]
            for line in lines
        ]

    @cached_property
    def chain(self) -> list[tuple[str, Array, Array, tuple[float, float] | None]]:
        """Joint (or fixed frame), axis in the base's frame, origin in its parent, range in degrees."""
        found = []
        for name, axis, origin, span in self.rows("| joint | axis"):
            sign = -1.0 if axis.startswith("-") else 1.0
            ends = [float(part) for part in span.split("…")] if "…" in span else None
            direction = sign * np.array(AXES[axis.lstrip("-")]) if axis.lstrip("-") in AXES else np.zeros(3)
            place = np.array([float(part) for part in origin.split(",")])
            found.append((name, direction, place, None if ends is None else (ends[0], ends[1])))
        return found

    def tool(self, q: Array) -> tuple[Array, Array]:
        """Position and rotation of the last frame of the README's table: all frames are parallel at q = 0."""
        rotation, position = np.array(self.base), np.zeros(3)
        joints = iter(q)
        for _, axis, place, ends in self.chain:
            position = position + rotation @ place
            if ends is not None:
                rotation = rotation @ _turn(axis, float(next(joints)))
        return position, rotation

    def posed(self, q: Array, model: mujoco.MjModel | None = None) -> mujoco.MjData:
        """MuJoCo at ``q`` (nq,) of the arm, gripper as at home."""
        model = self.model if model is None else model
        data = mujoco.MjData(model)
        data.qpos[:] = model.key("home").qpos
        data.qpos[: len(q)] = q
        mujoco.mj_forward(model, data)
        return data


def _turn(axis: Array, angle: float) -> Array:
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def touching(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[str, str]]:
    """Names of the geoms that touch."""
    pairs = data.contact.geom[: data.ncon]
    return [(model.geom(int(a)).name, model.geom(int(b)).name) for a, b in pairs]


def check_kinematics(arm: OwnedArm, frame: str, q: Array) -> None:
    """The frame is where the README's table puts it, to 1e-12."""
    data = arm.posed(q)
    position, rotation = arm.tool(q)
    site = data.site(frame)
    assert np.abs(site.xpos - position).max() < 1e-12
    assert np.abs(site.xmat.reshape(3, 3) - rotation).max() < 1e-12


def check_limits(arm: OwnedArm) -> None:
    """Model, README and arm file: the same joints; the arm file nowhere wider than the model."""
    table = {name: ends for name, _, _, ends in arm.chain if ends is not None}
    robot, config = arm.robot, arm.config
    assert tuple(table) == robot.joints == config.names
    spans = np.radians(list(table.values()))
    np.testing.assert_allclose(np.stack([robot.lower, robot.upper], axis=1), spans, atol=2e-5)
    assert np.all(config.lower >= robot.lower - 2e-3) and np.all(config.upper <= robot.upper + 2e-3)
    assert np.all(config.upper - config.lower > 0.99 * (robot.upper - robot.lower))
    assert np.all(config.velocity >= robot.velocity) and np.all(config.acceleration >= robot.acceleration)
    for joint, force in zip(config.joints, robot.model.actuator_forcerange, strict=False):
        servos = 1 if joint.twin is None else 2
        assert force[1] == servos * joint.table.motor.stall_torque, joint.name
        assert joint.velocity <= joint.table.motor.no_load_speed / 2, joint.name


def check_masses(arm: OwnedArm) -> None:
    """Bodies weigh what the README says, and turn as solid bodies do."""
    told = {name: float(grams) / 1000 for name, grams in arm.rows("| body | mass")}
    model = arm.model
    have = {model.body(b).name: float(model.body_mass[b]) for b in range(1, model.nbody)}
    assert {name: round(mass, 4) for name, mass in have.items()} == {n: round(m, 4) for n, m in told.items()}
    inertia = model.body_inertia[1:]
    assert np.all(inertia > 0) and np.all(inertia.sum(axis=1) > 1.999 * inertia.max(axis=1))


def check_poses(arm: OwnedArm) -> None:
    """Every keyframe is inside the limits and free of contacts, on its table too."""
    for model in (arm.model, arm.scene):
        for k in range(model.nkey):
            qpos = np.array(model.key(k).qpos)
            assert touching(model, arm.posed(qpos, model)) == [], model.key(k).name
            lower, upper = model.jnt_range[: len(qpos)].T
            assert np.all(qpos >= lower - 1e-9) and np.all(qpos <= upper + 1e-9), model.key(k).name


def check_free_way(arm: OwnedArm, report: Any) -> None:
    """A reach touches neither itself nor the table."""
    assert report.reached, report.problem or report.verdict
    assert report.trajectory is not None
    for q in report.trajectory.q[::5]:
        assert touching(arm.scene, arm.posed(np.array(q), arm.scene)) == []


def check_holds_home(arm: OwnedArm) -> None:
    """The model's own actuators hold the home pose against gravity."""
    model = arm.model
    data = arm.posed(arm.robot.home)
    data.ctrl[:] = model.key("home").ctrl
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos[: arm.robot.nq] - arm.robot.home).max() < math.radians(2)
