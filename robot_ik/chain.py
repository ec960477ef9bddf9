"""Serial chains in memory, from Denavit-Hartenberg rows or of equal links with ball joints."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from robot_ik.chain_model import chain_model
from robot_ik.errors import InvalidModelError, OptionError
from robot_ik.geometry import Pose, is_real
from robot_ik.robot import Robot, load_robot
from robot_ik.robot_file import LONGEST_CHAIN

DH_THICKNESS = 0.04
"""Radius of the drawn links of a DH chain, as a share of the longest link."""

SHORTEST_LINK = 1e-4
"""Metres. Shorter links are not drawn, because MuJoCo refuses capsules of almost no length."""

LARGEST_LIMIT = 1e10
"""rad or m. MuJoCo has no joints with one limit, so the missing limit is this far away."""

Convention = Literal["standard", "modified"]
CONVENTIONS = ("standard", "modified")


@dataclass(frozen=True)
class DHRow:
    """Denavit-Hartenberg parameters of one joint, with its range.

    The joint value is added to ``theta`` of a revolute joint and to ``d`` of a prismatic joint.

    Attributes:
        a: Link length, m.
        alpha: Link twist, rad.
        d: Link offset, m.
        theta: Joint angle, rad.
        joint: "revolute" or "prismatic".
        lower: Lower limit of the joint value, rad or m.
        upper: Upper limit of the joint value, rad or m.
        name: Name of the joint. Empty for ``joint1``, ``joint2`` and so on.

    Raises:
        OptionError: A parameter is not finite, the joint has another type, or its range is empty.
    """

    a: float = 0.0
    alpha: float = 0.0
    d: float = 0.0
    theta: float = 0.0
    joint: Literal["revolute", "prismatic"] = "revolute"
    lower: float = -math.inf
    upper: float = math.inf
    name: str = ""

    def __post_init__(self) -> None:
        for name in ("a", "alpha", "d", "theta"):
            value = getattr(self, name)
            if not is_real(value):
                raise OptionError(
                    name, f"{value!r} is not allowed", "a finite number", owner="DHRow"
                )
        if self.joint not in ("revolute", "prismatic"):
            problem = f"{self.joint!r} is not allowed"
            raise OptionError("joint", problem, "revolute, prismatic", owner="DHRow")
        is_range = all(is_real(value, -math.inf, math.inf) for value in (self.lower, self.upper))
        if not (is_range and self.lower < self.upper):
            problem = f"lower is {self.lower!r} and upper is {self.upper!r}"
            raise OptionError("", problem, "numbers, lower < upper", owner="DHRow")

    def poses(self, convention: Convention) -> tuple[Pose, Pose]:
        """Return the constant poses before and after the joint, which moves about or along z."""
        link = Pose((self.a, 0.0, 0.0), _rotation("x", self.alpha))
        offset = Pose((0.0, 0.0, self.d), _rotation("z", self.theta))
        if convention == "standard":  # Rz(theta) Tz(d) Tx(a) Rx(alpha)
            return offset, link
        return link.compose(offset), Pose.identity()  # Rx(alpha) Tx(a) Rz(theta) Tz(d)


def from_dh(
    rows: Sequence[DHRow],
    *,
    convention: Convention = "standard",
    name: str = "dh",
    base: Pose | None = None,
    tool: Pose | None = None,
) -> Robot:
    """Build a robot from Denavit-Hartenberg rows.

    The frames of the rows are ``frame1`` to ``frame<n>``. The default frame is ``tool``. All joints
    are at zero in the home pose, or at the limit that is nearest to zero.

    Args:
        rows: One row for each joint, from the base to the tool.
        convention: "standard" (distal, Denavit and Hartenberg 1955), T = Rz(theta) Tz(d) Tx(a)
            Rx(alpha), or "modified" (proximal, Craig 1986), T = Rx(alpha) Tx(a) Rz(theta) Tz(d).
        name: Name of the robot.
        base: Pose of frame 0 in the world. None for the identity.
        tool: Pose of the tool seen from the last frame. None for the identity.

    Raises:
        OptionError: No rows or too many, a value that is not a ``DHRow``, two joints of one name,
            or another convention.
    """
    listed = list(rows)
    _check_rows(listed, convention)
    poses = [row.poses(convention) for row in listed]
    last = Pose.identity() if tool is None else tool
    offsets = [pose.position for pair in [*poses, (last,)] for pose in pair]
    thickness = DH_THICKNESS * float(np.linalg.norm(offsets, axis=1).max())
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    body = spec.worldbody
    before = Pose.identity() if base is None else base
    for k, (row, (pre, post)) in enumerate(zip(listed, poses, strict=True), 1):
        place = before.compose(pre)
        if k > 1:
            _draw_link(body, place.position, thickness)
        body = body.add_body(name=f"link{k}", pos=place.position, quat=place.wxyz)
        _add_joint(body, row, row.name or f"joint{k}")
        body.add_site(name=f"frame{k}", pos=post.position, quat=post.wxyz)
        before = post
    end = before.compose(last)
    _draw_link(body, end.position, thickness)
    body.add_site(name="tool", pos=end.position, quat=end.wxyz)
    return load_robot(spec, tool="tool")


def _check_rows(rows: Sequence[object], convention: object) -> None:
    if convention not in CONVENTIONS:
        raise OptionError(
            "convention", f"unknown convention {convention!r}", ", ".join(CONVENTIONS)
        )
    if not 1 <= len(rows) <= LONGEST_CHAIN:
        raise OptionError("rows", f"{len(rows)} rows", f"1 to {LONGEST_CHAIN} rows")
    names = []
    for k, row in enumerate(rows, 1):
        if not isinstance(row, DHRow):
            hint = "for example DHRow(a=0.4318, alpha=0.0, d=0.15, theta=0.0)"
            raise OptionError("rows", f"row {k} is {row!r}", "DHRow", hint=hint)
        names.append(row.name or f"joint{k}")
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise OptionError("rows", f"two joints are called {repeated!r}", "one name for each joint")


def _rotation(axis: str, angle: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    return Pose.from_euler(axis, [angle]).wxyz


def _add_joint(body: Any, row: DHRow, name: str) -> None:
    """Add a joint about or along z to a body of an ``MjSpec``."""
    kinds = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
    joint = body.add_joint(name=name, type=kinds[row.joint], axis=[0.0, 0.0, 1.0])
    if math.isfinite(row.lower) or math.isfinite(row.upper):
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.range = [max(row.lower, -LARGEST_LIMIT), min(row.upper, LARGEST_LIMIT)]


def _draw_link(body: Any, end: np.ndarray[Any, Any], radius: float) -> None:
    """Add a capsule from the origin of a body of an ``MjSpec`` to a point."""
    if float(np.linalg.norm(end)) < SHORTEST_LINK:
        return
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0.0, 0.0, 0.0, *end.tolist()],
        size=[radius, 0.0, 0.0],
        contype=0,
        conaffinity=0,
        rgba=[0.25, 0.35, 0.5, 1.0],
    )


def make_chain(n: int, length: float = 1.0) -> Robot:
    """Build a chain of ``n`` unlimited ball joints, each with 3 degrees of freedom.

    The base is at the origin of the world. In the home pose all links are along z. The joints are
    ``joint1`` to ``joint<n>``, the bodies ``link1`` to ``link<n>``. The default frame is the site
    ``tip`` at the end of the last link, with z along the link.

    Args:
        n: Number of links, from 1 to ``LONGEST_CHAIN``.
        length: Length of each link, m.

    Raises:
        InvalidModelError: Another number of links, or a length that is not positive and finite.
    """
    given: object = n
    is_count = isinstance(given, int | np.integer) and not isinstance(given, bool)
    if not is_count or not 1 <= n <= LONGEST_CHAIN:
        hint = "MuJoCo's compile time grows with the cube of the links: 10 s for 400"
        raise InvalidModelError(f"a chain has 1 to {LONGEST_CHAIN} links, not {n!r}", hint=hint)
    if not (is_real(length, 0.0, sys.float_info.max) and length > 0.0):
        raise InvalidModelError(f"the length of a link is positive and finite, not {length!r}")
    return load_robot(chain_model(n, length).compile(), tool="tip")
