"""``robot-ik robots``: list the bundled robots, or describe one."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from robot_ik.commands.options import JsonOption
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import QUIET, Report, Terminal
from robot_ik.errors import ModelError

if TYPE_CHECKING:
    from rich.table import Table

    from robot_ik.robot import Robot

UNLIMITED = "-"
"""Text of a limit that does not exist."""


@dataclass(frozen=True)
class Robots(JsonOption):
    """List the bundled robots, or describe one with its joints, limits and frames.

    Any MJCF or URDF file works as well.

        robot-ik robots puma560
        robot-ik robots path/to/arm.xml
    """

    robot: Annotated[str, Parameter(name="NAME|FILE")] = ""
    """Robot to describe. Default: list all."""

    def run(self, terminal: Terminal = QUIET) -> RobotsReport | RobotReport:
        """Read the files of the catalogue, or load one robot."""
        if not self.robot:
            return RobotsReport(catalogue_rows())
        from robot_ik.commands.environment import import_mujoco

        import_mujoco()
        from robot_ik.robot import load_robot

        terminal.progress("loading")
        return RobotReport(load_robot(self.robot))


@dataclass(frozen=True)
class CatalogueRow:
    """A bundled robot, as its files describe it.

    Attributes:
        name: Name in the catalogue.
        title: Title.
        joints: Names of the active joints.
        tools: Names of the tools, the default first.
        arm_file: Path of its arm file. None without servos.
    """

    name: str
    title: str
    joints: Sequence[str]
    tools: Sequence[str]
    arm_file: str | None


def catalogue_rows() -> list[CatalogueRow]:
    """Return the bundled robots. MuJoCo is not needed."""
    from robot_ik.robot_file import catalogue, read_robot_file  # pydantic

    rows = []
    for name, folder in catalogue().items():
        path, file = read_robot_file(folder / "robot.toml")
        arm = folder / "arm.toml"
        default = [tool for tool in file.tools if tool == file.tool]
        rows.append(
            CatalogueRow(
                name,
                file.title,
                list(file.groups.get("arm", ())) or model_joints(path),
                default + [tool for tool in file.tools if tool != file.tool],
                str(arm) if arm.is_file() else None,
            )
        )
    return rows


def model_joints(path: Path) -> list[str]:
    """Return the names of all joints of an MJCF file.

    Raises:
        ModelError: The file has no world body.
    """
    world = ElementTree.parse(path).getroot().find("worldbody")
    if world is None:
        raise ModelError("the model has no worldbody")
    return [joint.get("name", "") for joint in world.iter() if joint.tag in ("joint", "freejoint")]


@dataclass(frozen=True, eq=False)
class RobotsReport(Report):
    """The bundled robots."""

    rows: Sequence[CatalogueRow]

    @property
    def hints(self) -> Sequence[str]:
        return ("one in detail: robot-ik robots NAME",)

    def tables(self) -> Iterable[Table]:
        columns = ("name", "title", "joints", "tools (default first)", "arm file")
        cells = [
            (
                row.name,
                row.title,
                len(row.joints),
                ", ".join(row.tools),
                "no" if row.arm_file is None else "yes",
            )
            for row in self.rows
        ]
        yield table(*columns, rows=cells)

    def facts(self) -> dict[str, Any]:
        return {"robots": [asdict(row) for row in self.rows]}


@dataclass(frozen=True, eq=False)
class RobotReport(Report):
    """One robot."""

    robot: Robot

    @property
    def hints(self) -> Sequence[str]:
        return ("in SI units and with every digit: --json",)

    def tables(self) -> Iterable[Table]:
        robot = self.robot
        names = {name: f"{name} (default)" if name == robot.tool else name for name in robot.frames}
        tools = [("tool", f"{names[name]}: {about(robot, name)}") for name in robot.file.tools]
        others = [names[name] for name in robot.frames if name not in robot.file.tools]
        head = [
            ("model", robot.path),
            ("arm file", robot.arm_file or "none"),
            *tools,
            ("frames", ", ".join(others)),
        ]
        yield table(robot.name, robot.file.title, rows=head)
        columns = ("joint", "kind", "lower", "upper", "home", "speed, /s", "accel., /s²", "unit")
        yield table(*columns, rows=self._joint_rows())

    def _joint_rows(self) -> Iterable[tuple[str, ...]]:
        robot = self.robot
        tree = robot.tree
        for k, (joint, kind) in enumerate(zip(robot.joints, robot.joint_kinds, strict=True)):
            rotary = kind in ("hinge", "ball")
            at_v = tree.vadr[k]
            # A quaternion does not fit a column. --json has it.
            is_scalar = kind in ("hinge", "slide")
            yield (
                joint,
                kind,
                _number(robot.lower[at_v], rotary),
                _number(robot.upper[at_v], rotary),
                _number(robot.home[tree.qadr[k]], rotary) if is_scalar else "…",
                _number(robot.velocity_limits[at_v], rotary),
                _number(robot.acceleration_limits[at_v], rotary),
                "deg" if rotary else "m",
            )

    def facts(self) -> dict[str, Any]:
        robot = self.robot
        return {
            "name": robot.name,
            "title": robot.file.title,
            "path": robot.path,
            "arm_file": robot.arm_file or None,
            "tool": robot.tool,
            "frames": {name: about(robot, name) for name in robot.frames},
            "joints": robot.joints,
            "kinds": robot.joint_kinds,
            "lower": robot.lower,
            "upper": robot.upper,
            "home": robot.home,
            "velocity_limits": robot.velocity_limits,
            "acceleration_limits": robot.acceleration_limits,
            "sources": robot.file.sources,
        }


def about(robot: Robot, frame: str) -> str:
    """Return the description of a tool in ``robot.toml``, empty for other frames."""
    tool = robot.file.tools.get(frame)
    return tool.about if tool else ""


def _number(value: float, rotary: bool) -> str:
    if not math.isfinite(value):
        return UNLIMITED
    return f"{math.degrees(value):z.1f}" if rotary else f"{value:z.4g}"
