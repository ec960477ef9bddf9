"""OMPL's RRT-Connect with checks by MuJoCo; ``plan.py`` runs it in another environment.

Reads the problems as JSON from stdin and writes the paths and times as JSON to stdout. It needs the
packages ``ompl`` and ``mujoco``, and not this project.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import mujoco
import numpy as np
from ompl import base, geometric, util


class Checker:
    """Validity of a posture by ``mj_collision``."""

    def __init__(self, task: dict[str, Any]) -> None:
        self.model = mujoco.MjModel.from_binary_path(task["model"])
        # Contacts nearer than the margin are listed too. The compiler wrote the margin of a body.
        self.model.geom_margin[:] = task["margin"]
        self.model.body_margin[:] = task["margin"]
        self.margin = task["margin"]
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = task["qpos"]
        self.addresses = np.array(task["addresses"])
        self.count = len(self.addresses)

    def is_free(self, state: Any) -> bool:
        """Return whether no pair is nearer than the margin."""
        self.data.qpos[self.addresses] = [state[k] for k in range(self.count)]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        contacts = self.data.ncon
        return contacts == 0 or bool(self.data.contact.dist[:contacts].min() > self.margin)


def solve(task: dict[str, Any], checker: Checker, start: list[float], goal: list[float]) -> Any:
    """Return the path and the processor seconds of one problem: search and simplification."""
    count = checker.count
    space = base.RealVectorStateSpace(count)
    bounds = base.RealVectorBounds(count)
    for k in range(count):
        bounds.setLow(k, task["lower"][k])
        bounds.setHigh(k, task["upper"][k])
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(checker.is_free)
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(task["resolution"] / space.getMaximumExtent())
    setup.setPlanner(geometric.RRTConnect(information))
    first = space.allocState()
    last = space.allocState()
    for k in range(count):
        first[k] = start[k]
        last[k] = goal[k]
    setup.setStartAndGoalStates(first, last)
    began = time.process_time()
    solved = setup.solve(task["seconds"])
    path = None
    if solved and setup.haveExactSolutionPath():
        setup.simplifySolution()
        states = setup.getSolutionPath().getStates()
        path = [[state[k] for k in range(count)] for state in states]
    return {"path": path, "seconds": time.process_time() - began}


def main() -> None:
    """Solve all problems of stdin."""
    util.setLogLevel(util.LOG_NONE)
    task = json.loads(sys.stdin.read())
    checker = Checker(task)
    pairs = zip(task["starts"], task["goals"], strict=True)
    print(json.dumps([solve(task, checker, start, goal) for start, goal in pairs]))


if __name__ == "__main__":
    main()
