"""Write the torque table of models/tabletop_puma/README.md: `python docs/make/torque_table.py`.

The table has the torque that the joints of the desk arm need, by the inverse dynamics of MuJoCo,
and the torque that its servos give. The poses are random (seeded) in the joint ranges, with a
payload between the fingers. There are two loads: at rest, and all joints at the speed and
acceleration of robot.toml [motion], each with a random sign, friction included. The tests fail if
the README is out of date.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

import robot_ik as rik
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.servo import Joint

Array = NDArray[np.float64]

README = Path(__file__).resolve().parents[2] / "models" / "tabletop_puma" / "README.md"
ROBOT = "tabletop_puma"
POSES = 4000
SEED = 0
PAYLOAD = 0.1
"""kg at the site `gripper`."""
CONTINUOUS_SHARE = 0.2
"""Of the stall torque; ROBOTIS, Torque Ratings, 7 May 2020."""
_PLACE = re.compile(r"(<!-- torque -->\n)(.*?)(<!-- end -->)", re.DOTALL)
_NO_CONSTRAINT_BUT_FRICTION = (
    mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_LIMIT
    | mujoco.mjtDisableBit.mjDSBL_EQUALITY
    | mujoco.mjtDisableBit.mjDSBL_ACTUATION
)


@dataclass(frozen=True)
class Loads:
    """Torques at the joints of the arm, N m, absolute.

    Attributes:
        still: (poses, n) torques that hold the arm at rest.
        moving: (poses, n) torques at full speed and acceleration.
    """

    still: Array
    moving: Array


def loaded_model(robot: rik.Robot, payload: float = PAYLOAD) -> mujoco.MjModel:
    """Return the model with ``payload`` kg between the fingers, without contacts and limits."""
    spec = mujoco.MjSpec.from_file(str(robot.path))
    site = spec.site("gripper")
    site.parent.add_geom(
        name="payload",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[0.012, 0, 0],
        pos=site.pos,
        mass=payload,
        contype=0,
        conaffinity=0,
    )
    model = spec.compile()
    model.opt.disableflags |= _NO_CONSTRAINT_BUT_FRICTION
    return model


def loads(robot: rik.Robot, model: mujoco.MjModel, poses: int = POSES, seed: int = SEED) -> Loads:
    """Return the loads at random poses inside the joint limits."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    dofs = [int(model.joint(name).dofadr[0]) for name in robot.joints]
    still = np.empty((poses, robot.nv))
    moving = np.empty((poses, robot.nv))
    for k in range(poses):
        data.qpos[:] = robot.qpos(robot.sample(rng))
        signs = rng.choice([-1.0, 1.0], size=(2, robot.nv))
        for share, row in ((0.0, still), (1.0, moving)):
            data.qvel[dofs] = share * signs[0] * robot.velocity_limits
            data.qacc[dofs] = share * signs[1] * robot.acceleration_limits
            mujoco.mj_inverse(model, data)
            row[k] = np.abs(data.qfrc_inverse[dofs])
    return Loads(still, moving)


@dataclass(frozen=True)
class Strength:
    """Torques of the servos at the joints, (n,) N m, with belts without losses.

    Attributes:
        stall: Largest torque at rest, for a short time.
        continuous: Torque at rest without a time limit.
        at_speed: Torque at the speeds of [motion]. It decreases linearly from stall to no-load.
    """

    stall: Array
    continuous: Array
    at_speed: Array


def _joints(arm: ArmConfig) -> list[Joint]:
    """Return the joints that carry the tool; the fingers are left out."""
    return [joint for joint in arm.joints if joint.group == "arm"]


def strength(robot: rik.Robot, arm: ArmConfig) -> Strength:
    """Return the torques by the figures of the manual, at its recommended voltages."""
    joints = _joints(arm)
    stall = np.array([joint.servo.table.motor.stall_torque * joint.gear.ratio for joint in joints])
    free = np.array([joint.servo.table.motor.no_load_speed / joint.gear.ratio for joint in joints])
    return Strength(stall, CONTINUOUS_SHARE * stall, stall * (1.0 - robot.velocity_limits / free))


def _times(number: float) -> str:
    return "> 99" if number > 99.0 else f"{number:.1f}"


def table(poses: int = POSES, seed: int = SEED) -> str:
    """Return the table as Markdown."""
    robot = rik.load_robot(ROBOT)
    assert robot.arm_file is not None
    arm = ArmConfig.load(robot.arm_file)
    load = loads(robot, loaded_model(robot), poses, seed)
    can = strength(robot, arm)
    head = (
        "joint",
        "servo",
        "stall",
        "continuous",
        "still: worst",
        "99 %",
        "stall / worst",
        "continuous / worst",
        "moving: worst",
        "99 %",
        "at that speed",
        "at that speed / worst",
    )
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for k, joint in enumerate(_joints(arm)):
        worst = load.still[:, k].max()
        usual = np.percentile(load.still[:, k], 99)
        hardest = load.moving[:, k].max()
        hard = np.percentile(load.moving[:, k], 99)
        belt = "" if joint.gear.ratio == 1.0 else f" × {joint.gear.ratio:g}"
        bare = max(float(worst), 1e-9)
        cells = (
            f"`{joint.name}`",
            joint.servo.model + belt,
            f"{can.stall[k]:.2f}",
            f"{can.continuous[k]:.2f}",
            f"{worst:.2f}",
            f"{usual:.2f}",
            _times(can.stall[k] / bare),
            _times(can.continuous[k] / bare),
            f"{hardest:.2f}",
            f"{hard:.2f}",
            f"{can.at_speed[k]:.2f}",
            _times(can.at_speed[k] / hardest),
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def filled(text: str) -> str:
    """Return ``text`` of the README with the newest table."""
    return _PLACE.sub(lambda match: match[1] + table() + match[3], text)


if __name__ == "__main__":
    before = README.read_text(encoding="utf-8")
    after = filled(before)
    sys.stdout.write(table())
    if after != before:
        README.write_text(after, encoding="utf-8")
        sys.stdout.write(f"wrote {README}\n")
