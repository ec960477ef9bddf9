"""Inverse kinematics for robot arms in Python, from camera to servo.

    import robot_ik as rik

    robot = rik.load_robot("puma560")
    goal = rik.PoseGoal("gripper", position=(-0.45, -0.1, 0.8), wxyz=(0, 1, 0, 0))
    solution = rik.solve(robot, goal)

Names are imported when they are first used. The import of the package opens no window, port, camera
or GL context and compiles nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from robot_ik.batch import forward_batch, solve_batch
    from robot_ik.branches import solve_all
    from robot_ik.budget import Budget
    from robot_ik.chain import DHRow, from_dh, make_chain
    from robot_ik.collision.avoidance import CollisionAvoidance
    from robot_ik.collision.obstacle_file import load_obstacles
    from robot_ik.collision.obstacles import Box, Capsule, Cylinder, Mesh, Plane, Sphere
    from robot_ik.collision.scene import Clearance, Scene, load_scene
    from robot_ik.commands.reach import Reach
    from robot_ik.commands.run import Run
    from robot_ik.commands.solve import Solve
    from robot_ik.errors import NotConvergedError, RobotIkError
    from robot_ik.execution import execute, follow
    from robot_ik.geometry import Pose
    from robot_ik.goals import (
        AimGoal,
        CenterOfMassGoal,
        Goal,
        HalfSpaceGoal,
        LineGoal,
        OrientationGoal,
        PlaneGoal,
        PoseGoal,
        PosePriorGoal,
        PositionGoal,
        PostureGoal,
        Tolerance,
    )
    from robot_ik.inverse_kinematics import solve, warm_up
    from robot_ik.motion.line import line_move
    from robot_ik.motion.plan import Plan, PlanStatus, plan
    from robot_ik.motion.trajectory import Trajectory, joint_move
    from robot_ik.ports import RealClock, VirtualClock
    from robot_ik.pose_prior import PosePrior
    from robot_ik.problem import Problem
    from robot_ik.reachability.reachability_map import (
        ReachabilityMap,
        ReachStatus,
        map_reachability,
    )
    from robot_ik.robot import Robot, load_robot
    from robot_ik.robot_arm import RobotArm, open_robot
    from robot_ik.robot_file import catalogue
    from robot_ik.solution import Deviation, Solution, Status
    from robot_ik.solvers import SOLVERS, make_solver
    from robot_ik.support import support_goals

_HOME = {
    "robot_ik.batch": ("forward_batch", "solve_batch"),
    "robot_ik.branches": ("solve_all",),
    "robot_ik.chain": ("DHRow", "from_dh", "make_chain"),
    "robot_ik.collision.avoidance": ("CollisionAvoidance",),
    "robot_ik.collision.obstacle_file": ("load_obstacles",),
    "robot_ik.collision.obstacles": ("Box", "Capsule", "Cylinder", "Mesh", "Plane", "Sphere"),
    "robot_ik.collision.scene": ("Clearance", "Scene", "load_scene"),
    "robot_ik.commands.reach": ("Reach",),
    "robot_ik.commands.run": ("Run",),
    "robot_ik.commands.solve": ("Solve",),
    "robot_ik.errors": ("NotConvergedError", "RobotIkError"),
    "robot_ik.execution": ("execute", "follow"),
    "robot_ik.geometry": ("Pose",),
    "robot_ik.goals": (
        "AimGoal",
        "CenterOfMassGoal",
        "Goal",
        "HalfSpaceGoal",
        "LineGoal",
        "OrientationGoal",
        "PlaneGoal",
        "PoseGoal",
        "PosePriorGoal",
        "PositionGoal",
        "PostureGoal",
        "Tolerance",
    ),
    "robot_ik.pose_prior": ("PosePrior",),
    "robot_ik.motion.line": ("line_move",),
    "robot_ik.motion.plan": ("Plan", "PlanStatus", "plan"),
    "robot_ik.motion.trajectory": ("Trajectory", "joint_move"),
    "robot_ik.ports": ("RealClock", "VirtualClock"),
    "robot_ik.budget": ("Budget",),
    "robot_ik.problem": ("Problem",),
    "robot_ik.reachability.reachability_map": (
        "ReachStatus",
        "ReachabilityMap",
        "map_reachability",
    ),
    "robot_ik.robot": ("Robot", "load_robot"),
    "robot_ik.robot_arm": ("RobotArm", "open_robot"),
    "robot_ik.robot_file": ("catalogue",),
    "robot_ik.solution": ("Deviation", "Solution", "Status"),
    "robot_ik.support": ("support_goals",),
    "robot_ik.inverse_kinematics": ("solve", "warm_up"),
    "robot_ik.solvers": ("SOLVERS", "make_solver"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "SOLVERS",
    "AimGoal",
    "Box",
    "Budget",
    "Capsule",
    "CenterOfMassGoal",
    "Clearance",
    "CollisionAvoidance",
    "Cylinder",
    "DHRow",
    "Deviation",
    "Goal",
    "HalfSpaceGoal",
    "LineGoal",
    "Mesh",
    "NotConvergedError",
    "OrientationGoal",
    "Plan",
    "PlanStatus",
    "Plane",
    "PlaneGoal",
    "Pose",
    "PoseGoal",
    "PosePrior",
    "PosePriorGoal",
    "PositionGoal",
    "PostureGoal",
    "Problem",
    "Reach",
    "ReachStatus",
    "ReachabilityMap",
    "RealClock",
    "Robot",
    "RobotArm",
    "RobotIkError",
    "Run",
    "Scene",
    "Solution",
    "Solve",
    "Sphere",
    "Status",
    "Tolerance",
    "Trajectory",
    "VirtualClock",
    "__version__",
    "catalogue",
    "execute",
    "follow",
    "forward_batch",
    "from_dh",
    "joint_move",
    "line_move",
    "load_obstacles",
    "load_robot",
    "load_scene",
    "make_chain",
    "make_solver",
    "map_reachability",
    "open_robot",
    "plan",
    "solve",
    "solve_all",
    "solve_batch",
    "support_goals",
    "warm_up",
]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        module = _MODULE_OF.get(name)
        if module is None:
            raise AttributeError(f"module 'robot_ik' has no attribute {name!r}")
        value = getattr(importlib.import_module(module), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return __all__
