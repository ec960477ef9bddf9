"""A view as the JSON that the page draws."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import mujoco
import numpy as np

from robot_ik import SOLVERS, catalogue
from robot_ik.robot import Robot
from robot_ik.robot_file import find_robot
from robot_ik.testbed.arm import ArmView
from robot_ik.testbed.arrangement import INSTANCE_COLOURS, hexadecimal
from robot_ik.testbed.frontends.site import has_thumbnail
from robot_ik.testbed.instance import InstanceView
from robot_ik.testbed.keys import KEYMAP
from robot_ik.testbed.obstacles import ObstacleView
from robot_ik.testbed.reach_maps import ReachState
from robot_ik.testbed.view import FigureView, View
from robot_ik.theses.courses import NUMBERS, THESIS_RESULTS

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)


def program_row(*, has_camera: bool, has_film: bool, has_arm: bool) -> dict[str, Any]:
    """Return what does not change while the program runs."""
    return {
        "robots": [_catalogue_row(name) for name in catalogue()],
        "methods": {name: _option_rows(solver) for name, solver in SOLVERS.items()},
        "courses": {number: THESIS_RESULTS[number] for number in NUMBERS},
        "colours": [hexadecimal(colour) for colour in INSTANCE_COLOURS],
        "keys": [
            {
                "code": key.code,
                "label": key.label,
                "about": key.about,
                "group": key.group,
                "command": key.command is not None,
            }
            for key in KEYMAP
            if key.code
        ],
        "camera": has_camera,
        "film": has_film,
        "arm": has_arm,
    }


def _catalogue_row(name: str) -> dict[str, Any]:
    title = find_robot(name)[1].title
    return {"name": name, "about": title, "picture": has_thumbnail(name)}


def _option_rows(solver: Any) -> list[dict[str, Any]]:
    """Return the options of a method, those with a usual range or choices first."""
    rows = []
    for item in dataclasses.fields(solver):
        meta = item.metadata
        if isinstance(item.default, str) and not meta.get("choices"):
            continue  # no widget for free text
        is_bool = isinstance(item.default, bool)
        usual = meta.get("usual")
        rows.append(
            {
                "name": item.name,
                "help": str(meta.get("help", "")).replace("``", ""),
                "unit": meta.get("unit", ""),
                "choices": list(meta.get("choices") or ()),
                "lower": meta.get("lower"),
                "upper": meta.get("upper"),
                "usual": list(usual or ()),
                "whole": isinstance(item.default, int) and not is_bool,
                "switch": is_bool,
                "rare": not (is_bool or usual or meta.get("choices")),
            }
        )
    return sorted(rows, key=lambda row: bool(row["rare"]))


def robot_row(robot: Robot, name: str) -> dict[str, Any]:
    """Return a robot's joints that a person can turn.

    Args:
        robot: The robot.
        name: Its name or path as it was asked for.
    """
    model = robot.model
    joints = []
    for joint in robot.joints:
        j = model.joint(joint).id
        kind = int(model.jnt_type[j])
        if kind not in (_HINGE, _SLIDE):
            continue
        limited = bool(model.jnt_limited[j])
        lower, upper = model.jnt_range[j].tolist() if limited else (-math.pi, math.pi)
        joints.append(
            {
                "name": joint,
                "hinge": kind == _HINGE,
                "lower": lower,
                "upper": upper,
                "limited": limited,
            }
        )
    return {
        "name": robot.name,
        "path": name,
        "tool": robot.tool,
        "frames": _frame_rows(robot),
        "chain": list(robot.joints),
        "joints": joints,
        "picture": has_thumbnail(robot.name),
        "missing_meshes": list(robot.missing_meshes),
    }


def _frame_rows(robot: Robot) -> list[dict[str, Any]]:
    """Return the frames that can be tool, base or pin."""
    return [
        {
            "name": name,
            "about": tool.about if (tool := robot.file.tools.get(name)) else "",
            "body": _body_of(robot, name),
            "base": bool(robot.joints_between(name)),
        }
        for name in robot.frames
    ]


def frame_of_body(robot: Robot, body: str) -> str:
    """Return the frame that stands for a body: its first tool, else the body itself."""
    tools = (name for name in robot.file.tools if _body_of(robot, name) == body)
    return next(tools, body)


def _body_of(robot: Robot, frame: str) -> str:
    return str(robot.model.body(robot.frame(frame).body).name)


def joint_addresses(robot: Robot) -> list[int]:
    """Return where ``qpos`` has the joints of ``robot_row``."""
    model = robot.model
    ids = [model.joint(name).id for name in robot.joints]
    return [int(model.jnt_qposadr[j]) for j in ids if int(model.jnt_type[j]) in (_HINGE, _SLIDE)]


def view_row(view: View, robot: Robot, addresses: list[int]) -> dict[str, Any]:
    """Return a view. ``addresses`` are those of ``joint_addresses``."""
    return {
        "now": round(view.now, 3),
        "state": view.state,
        "ready": view.tick > 0,
        "running": view.running,
        "motion": view.motion,
        "speed": view.speed,
        "pace": view.pace,
        "restarts": view.restarts,
        "kind": view.kind,
        "extras": [dataclasses.asdict(extra) for extra in view.extras],
        "limits": view.limits,
        "tool": view.tool,
        "base": view.base,
        "pins": [dataclasses.asdict(pin) for pin in view.pins],
        "stiffness": dict(view.stiffness),
        "course": None if view.course is None else dataclasses.asdict(view.course),
        "branches": [branch.name for branch in view.branches] if view.show_branches else None,
        "busy": view.busy,
        "message": view.message,
        "ball": [round(x, 4) for x in np.array(view.ball.position).tolist()],
        "instances": [_instance_row(one, robot, addresses) for one in view.instances],
        "figure": None if view.figure is None else _figure_row(view.figure),
        "can_act": view.can_act,
        "timeline": dataclasses.asdict(view.timeline),
        "obstacles": [_obstacle_row(one) for one in view.obstacles],
        "plan": {
            "state": view.plan.state,
            "text": view.plan.text,
            "duration": round(view.plan.duration, 3),
            "now": round(view.plan.now, 3),
            "playing": view.plan.playing,
        },
        "contacts": [
            {"parts": list(one.parts), "depth_mm": round(1e3 * one.depth, 1)}
            for one in view.contacts
        ],
        "arm": None if view.arm is None else _arm_row(view.arm),
    }


def reach_row(state: ReachState) -> dict[str, Any]:
    """Return the state of the reachability map."""
    return {
        "text": state.text,
        "smallest_index": round(state.smallest_index, 4),
        "largest_index": round(state.largest_index, 4),
    }


def _obstacle_row(one: ObstacleView) -> dict[str, Any]:
    return {
        "name": one.placed.name,
        "shape": one.placed.shape,
        "size": [round(length, 4) for length in one.placed.size],
        "distance": one.distance if math.isfinite(one.distance) else None,
        "part": one.part,
    }


def _figure_row(figure: FigureView) -> dict[str, Any]:
    decision = figure.decision
    return {
        "mode": figure.mode,
        "action": figure.action,
        "phase": round(figure.phase, 3),
        "decision": decision.action,
        "then": decision.then or "",
        "arm": decision.arm or "",
        "reason": decision.reason,
        "waiting": figure.waiting,
        "locked": figure.locked,
    }


def _instance_row(one: InstanceView, robot: Robot, addresses: list[int]) -> dict[str, Any]:
    statistics = one.statistics
    return {
        "method": one.method,
        "options": {name: value for name, value in one.options if _is_plain(value)},
        "limited": one.limited,
        "iterations_limit": one.budget.iterations,
        "distance_mm": 1e3 * one.distance,
        "words": one.words,
        "status": one.status,
        "able": one.able,
        "met": one.met,
        "stuck": one.stuck,
        "note": one.note,
        "error_mm": round(1e3 * one.error, 4),
        "angle_deg": round(math.degrees(one.angle), 4),
        "off": one.off,
        "iterations": one.iterations,
        "manipulability": round(float(one.errors[-1, 2]) if len(one.errors) else 0.0, 5),
        "count": statistics.count,
        "mean_us": round(1e6 * statistics.mean, 1),
        "p99_us": round(1e6 * statistics.p99, 1),
        "mean_iterations": round(statistics.iterations, 2),
        "solved": round(statistics.solved, 4),
        "jump_deg": round(math.degrees(statistics.joint_change), 3),
        "joints": [round(x, 5) for x in robot.qpos(one.q)[addresses].tolist()],
        "goals": [
            [name, round(1e3 * metres, 3), round(math.degrees(angle), 3)]
            for name, metres, angle in one.goals
        ],
    }


def _is_plain(value: object) -> bool:
    """Return whether JSON has such a value."""
    is_finite = isinstance(value, float) and math.isfinite(value)
    return is_finite or isinstance(value, bool | int | str)


LIMP = "The arm is limp: nothing holds it. Press Follow to switch the torque on."
LIMP_TEACH = "The arm is limp: guide it by hand. Hold ends the recording; the arm stays limp."


def _arm_row(arm: ArmView) -> dict[str, Any]:
    limp = ""
    if arm.limp:
        limp = LIMP_TEACH if arm.mode == "teach" else LIMP
    return {
        "robot": arm.robot.name,
        "is_shown": arm.is_shown,
        "state": arm.state,
        # A limp arm does not hold, whatever was asked.
        "mode": "" if arm.limp and arm.mode == "hold" else arm.mode,
        "port": arm.port,
        "apart_deg": round(math.degrees(arm.apart), 1),
        "recorded": round(arm.recorded, 1),
        "limp": limp,
        "message": arm.message,
        "servos": [
            {
                "joint": servo.joint,
                "position": _number(servo.position_deg, 1, "°")
                if servo.position_mm is None
                else _number(servo.position_mm, 1, " mm"),
                "torque": servo.torque,
                "current": _number(servo.current_ma),
                "temperature": _number(servo.temperature),
                "errors": ", ".join(servo.errors),
            }
            for servo in arm.servos
        ],
    }


def _number(value: float | None, digits: int = 0, unit: str = "") -> str:
    """Return a reading as text, or a dash without one."""
    return "–" if value is None else f"{value:z.{digits}f}{unit}"
