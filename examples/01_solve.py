"""Solve inverse kinematics for the PUMA 560 and print the result.

The first goal is within reach. The program prints the joint angles, the error measured by a forward
pass of MuJoCo, and the iterations of each method. The second goal is two metres too far. It raises
no exception: the result has a status, a proof and the nearest point that was found.
"""

import numpy as np

import robot_ik as rik


def show(name: str, solution: rik.Solution) -> None:
    error = solution.error  # measured by MuJoCo, not by the solver
    print(
        f"{name:13} {solution.status.name:12} {1e3 * error.position:9.4f} mm "
        f"{np.degrees(error.angle):8.4f} deg  {solution.iterations:4} iterations, "
        f"{solution.restarts} restarts"
    )


def main() -> None:
    robot = rik.load_robot("puma560")
    print(f"{robot.file.title}: joints {', '.join(robot.joints)}; frame {robot.tool}")

    # 0 1 0 0 turns the gripper half a turn about x: it points straight down.
    goal = rik.PoseGoal("gripper", position=(-0.45, -0.10, 0.80), wxyz=(0, 1, 0, 0))
    for name, method in rik.SOLVERS.items():
        if isinstance(goal, method.goals):  # some methods support positions only
            show(name, rik.solve(robot, goal, solver=name))
    q = rik.solve(robot, goal).require().q  # require() raises an error if the goal was not reached
    print("q (deg):", np.array2string(np.degrees(q), precision=2, suppress_small=True))
    print("gripper:", robot.forward(q, "gripper"))

    far = rik.solve(robot, rik.PositionGoal("gripper", position=(-3.0, 0.0, 0.8)))
    show(far.solver, far)
    print("status:", far.status.meaning)


if __name__ == "__main__":
    main()
