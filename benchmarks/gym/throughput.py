"""Steps a second of the Gymnasium environments with random actions.

    python benchmarks/gym/throughput.py

A step of a vector environment with n arms counts as n steps. Of each row the quickest round counts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import gymnasium
import numpy as np

ENVIRONMENT = "robot_ik.gym:robot_ik/Reach-v0"
"""Module that registers the environment, and its name."""

ROBOT = "koch_v11"
CONTROLS = ("tool", "joints")
COUNTS = (1, 16, 256, 2048)
"""Arms in one environment. One arm is the plain environment."""

ROUND_SECONDS = 1.0
"""Least duration of a round, s."""

ACTIONS = 64
"""Random actions that are drawn before the clock starts and repeated."""


def single_step(control: str) -> Callable[[], None]:
    """Return a function that makes one step of the plain environment."""
    env = gymnasium.make(ENVIRONMENT, robot=ROBOT, control=control)
    env.reset(seed=0)
    size = env.action_space.shape[0]
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (ACTIONS, size)).astype(np.float32)
    count = 0

    def step() -> None:
        nonlocal count
        truncated = env.step(actions[count % ACTIONS])[3]
        count += 1
        if truncated:
            env.reset()

    return step


def vector_step(control: str, arms: int) -> Callable[[], None]:
    """Return a function that makes one step of the vector environment."""
    envs = gymnasium.make_vec(ENVIRONMENT, num_envs=arms, robot=ROBOT, control=control)
    envs.reset(seed=0)
    shape = (ACTIONS, *envs.action_space.shape)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)
    count = 0

    def step() -> None:
        nonlocal count
        envs.step(actions[count % ACTIONS])
        count += 1

    return step


def steps_per_second(step: Callable[[], None], arms: int, rounds: int) -> float:
    """Return the steps of one arm a second, in the quickest round."""
    step()  # compiles or loads the kernels
    rates = []
    for _ in range(rounds):
        count = 0
        begin = time.perf_counter()
        while (spent := time.perf_counter() - begin) < ROUND_SECONDS:
            step()
            count += 1
        rates.append(arms * count / spent)
    return max(rates)


def lines(rounds: int) -> list[str]:
    """Return the table."""
    rows = ["| arms in one environment | `tool`, steps/s | `joints`, steps/s |", "|---:|---:|---:|"]
    for arms in COUNTS:
        cells = []
        for control in CONTROLS:
            step = single_step(control) if arms == 1 else vector_step(control, arms)
            cells.append(f"{steps_per_second(step, arms, rounds):,.0f}")
        rows.append(f"| {arms} | {cells[0]} | {cells[1]} |")
    return rows


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each row")
    options = parser.parse_args()
    print("\n".join(lines(options.rounds)))


if __name__ == "__main__":
    main()
