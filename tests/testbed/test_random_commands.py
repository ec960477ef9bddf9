"""Random valid commands of every kind: the session survives them, and its log replays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from robot_ik.testbed import commands
from robot_ik.testbed.commands import COMMANDS, Command, CommandLog, Start
from robot_ik.testbed.session import Session
from tests.testbed.session_runs import require_equal_replay, view_after

ROBOTS = ("puma560", "ur5e", "srs_arm", "humanoid")
METHODS = ("dls", "lm", "ccd", "analytic", "auto")
FRAMES = ("gripper", "flange", "link2", "link3", "left_hand", "right_hand", "pelvis")
JOINTS = ("joint1", "joint3", "right_elbow_pitch", "torso_pitch")
OPTIONS = (("damping", 0.2), ("order", "root_to_tip"), ("gain", 0.5), ("patience", 20))

TICKS_PER_COMMAND = 3


def random_command(rng: np.random.Generator) -> Command:
    """Return a valid command. Its target may not exist on the present robot."""

    def choice(values: tuple[object, ...]) -> object:
        return values[int(rng.integers(len(values)))]

    def point(size: float) -> tuple[float, ...]:
        return tuple(rng.uniform(-size, size, 3).tolist())

    def whole(end: int) -> int:
        return int(rng.integers(end))

    def flag() -> bool:
        return bool(rng.integers(2))

    def number(lower: float, upper: float) -> float:
        return float(rng.uniform(lower, upper))

    arguments: dict[str, Callable[[], tuple[object, ...]]] = {
        "set_robot": lambda: (choice(ROBOTS),),
        "set_count": lambda: (choice((1, 2, 4)),),
        "set_method": lambda: (whole(4), choice(METHODS)),
        "set_option": lambda: (whole(4), *OPTIONS[whole(len(OPTIONS))]),
        "set_goal_kind": lambda: (choice(commands.GOAL_KINDS),),
        "set_extra_goal": lambda: (choice(("posture", "gaze", "balance")), flag(), whole(3)),
        "set_limits": lambda: (flag(),),
        "set_tool": lambda: (choice(FRAMES),),
        "set_base": lambda: (choice(("", "link1", "pelvis")),),
        "set_pin": lambda: (choice(FRAMES), point(0.5)),
        "remove_pin": lambda: (choice(FRAMES),),
        "set_stiffness": lambda: (choice(JOINTS), number(0.01, 10.0)),
        "set_course": lambda: (1 + whole(13),),
        "show_branches": lambda: (flag(),),
        "set_figure": lambda: (choice(("off", "active", "passive")),),
        "set_motion": lambda: (choice(commands.MOTIONS),),
        "set_pace": lambda: (number(0.0, 2.0),),
        "set_running": lambda: (rng.random() < 0.8,),
        "set_speed": lambda: (number(0.0, 3.0),),
        "set_budget": lambda: (whole(4), 1 + whole(100), number(1e-4, 0.1)),
        "set_restarts": lambda: (flag(),),
        "move_goal": lambda: (point(1.5),),
        "nudge": lambda: (point(0.1),),
        "set_joint": lambda: (choice(JOINTS), number(-1.0, 1.0)),
        "drag_link": lambda: (whole(4), choice(FRAMES), point(0.05), point(0.8)),
        "release": lambda: (),
        "reset": lambda: (),
        "pick_branch": lambda: (whole(8),),
        "act": lambda: (),
        "set_arm": lambda: (choice(("follow", "hold", "release")),),
        "record_pose": lambda: (),
        "remove_pose": lambda: (whole(4),),
        "move_pose": lambda: (whole(4), number(0.0, 4.0)),
        "scrub": lambda: (number(0.0, 4.0),),
        "play_timeline": lambda: (flag(),),
        "load_poses": lambda: ("schema = 1\n",),
        "add_obstacle": lambda: (choice(("box", "sphere", "cylinder")),),
        "add_mesh": lambda: ("wedge", tuple(point(0.1) for _ in range(5))),
        "resize_obstacle": lambda: (whole(4), tuple(rng.uniform(0.05, 0.5, 3).tolist())),
        "move_obstacle": lambda: (whole(4), point(0.8)),
        "remove_obstacle": lambda: (whole(4),),
        "mark_plan_start": lambda: (),
        "plan_motion": lambda: (),
        "play_plan": lambda: (flag(),),
        "scrub_plan": lambda: (number(0.0, 4.0),),
        "remove_plan": lambda: (),
    }
    assert set(arguments) == set(COMMANDS), "give the new command random arguments here"
    name = str(choice(tuple(arguments)))
    return COMMANDS[name](*arguments[name]())


def random_session(seed: int, count: int) -> CommandLog:
    """Return the log of a session with random commands."""
    rng = np.random.default_rng(seed)
    with Session(Start(), beside=False) as session:
        for _ in range(count):
            view = view_after(session, random_command(rng), ticks=TICKS_PER_COMMAND)
            assert all(np.isfinite(instance.q).all() for instance in view.instances)
        return session.log()


def test_random_commands_replay_to_the_same_bits() -> None:
    require_equal_replay(random_session(seed=3, count=60))


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("seed", [1, 2])
def test_hundreds_of_random_commands_replay_to_the_same_bits(seed: int) -> None:
    """Both sessions together take 1500 commands."""
    require_equal_replay(random_session(seed, count=750))
