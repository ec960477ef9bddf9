"""The table of commands and of their subcommands: names, where each lives, one line about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Command:
    """One row of ``COMMANDS``.

    Attributes:
        module: Where it lives; imported when the command is used and not before.
        options: Name of its frozen dataclass of options; empty: it has subcommands and nothing else.
        about: One line for ``robot-ik --help``.
        run: Name of its function ``run(options) -> exit code``.
        mujoco: It loads models, so a broken MuJoCo is told before anything else.
        subcommands: Rows of the same kind, by the word behind the command's name.
    """

    module: str
    options: str
    about: str
    run: str = "run"
    mujoco: bool = True
    subcommands: Mapping[str, Command] = field(default_factory=dict)


def _servo(name: str, about: str, module: str = "") -> Command:
    """``run_reset_fault(options: ResetFaultOptions)`` in ``servo_torque``, and so on."""
    options = "".join(word.title() for word in name.split("-")) + "Options"
    run = "run_" + name.replace("-", "_")
    return Command(f"robot_ik.cli.servo_{module or name}", options, about, run, mujoco=False)


def _camera(name: str, about: str) -> Command:
    return Command(f"robot_ik.cli.camera_{name}", f"Camera{name.title()}Options", about, mujoco=False)


_SERVO = {
    "ports": _servo("ports", "serial ports, the adapter behind each, who uses it"),
    "scan": _servo("scan", "which servos answer, at every rate; doubled ids"),
    "setup": _servo("setup", "id and baud rate of the one servo connected"),
    "calibrate": _servo("calibrate", "ranges, zeros and directions by hand"),
    "monitor": _servo("monitor", "position, current, supply, heat, errors, live"),
    "move": _servo("move", "joints to angles, slowly, within limits"),
    "torque": _servo("torque", "on: hold where it stands; off: let go"),
    "reset-fault": _servo("reset-fault", "restart servos that have shut down", "torque"),
    "teach": _servo("teach", "record the arm while a hand guides it"),
    "play": _servo("play", "repeat a recording within the limits", "teach"),
    "backup": _servo("backup", "save the control tables as JSON"),
    "restore": _servo("restore", "put the EEPROM back as a backup has it", "backup"),
}
_CAMERA = {
    "list": _camera("list", "cameras of this machine: index, name, who uses them"),
    "print": _camera("print", "a sheet of markers, a board, a cube or a pattern to print"),
    "calibrate": _camera("calibrate", "lens and focal length from views of a printed pattern"),
    "detect": _camera("detect", "markers in pictures: ids, corners, poses"),
    "locate": _camera("locate", "where the camera stands, from a board whose place is known"),
    "handeye": _camera("handeye", "where the camera is mounted, by moving the arm"),
    "verify": _camera("verify", "how far the arm is from where its joints say"),
}

COMMANDS: dict[str, Command] = {
    "reach": Command(
        "robot_ik.cli.reach",
        "ReachOptions",
        "see a marker, reach it, and let a camera judge: the whole product",
    ),
    "solve": Command(
        "robot_ik.cli.solve_command", "SolveOptions", "a goal in, joint angles out (JSON on stdout)"
    ),
    "robots": Command(
        "robot_ik.cli.listing", "RobotsOptions", "the robots that come along, or one in detail", "run_robots"
    ),
    "solvers": Command(
        "robot_ik.cli.listing", "SolversOptions", "the methods and their options", "run_solvers"
    ),
    "experiments": Command(
        "robot_ik.cli.experiments",
        "ExperimentsOptions",
        "repeat the experiments of the theses: a00 or s12",
    ),
    "bench": Command(
        "robot_ik.cli.bench",
        "BenchOptions",
        "methods on seeded problems: success, time, plots",
        subcommands={
            "camera": Command(
                "robot_ik.cli.bench_camera",
                "BenchCameraOptions",
                "the camera instead of the methods: errors on pictures whose truth is known",
                "run_camera",
            ),
            "figure": Command(
                "robot_ik.cli.bench_figure",
                "BenchFigureOptions",
                "the figure instead of the methods: gait, balance, hands, decisions, judged by MuJoCo",
            ),
        },
    ),
    "run": Command(
        "robot_ik.cli.run", "RunOptions", "a scripted test run on simulated or real servos, faults included"
    ),
    "sim-bus": Command(
        "robot_ik.cli.sim_bus",
        "SimBusOptions",
        "serve simulated servos on a port that any client can open",
        mujoco=False,
    ),
    "servo": Command(
        "", "", "servos by hand: find, set up, calibrate, watch, move, record, save", subcommands=_SERVO
    ),
    "stop": Command(
        "robot_ik.cli.stop",
        "StopOptions",
        "make an arm that another program drives stop and hold",
        mujoco=False,
    ),
    "ar": Command(
        "robot_ik.cli.ar", "ArOptions", "the virtual robot in a camera's pictures, on a printed board"
    ),
    "figure": Command(
        "robot_ik.cli.figure",
        "FigureOptions",
        "a humanoid sees a ball, decides, and reaches, bends, jumps or walks",
    ),
    "camera": Command(
        "", "", "the camera by hand: find, print markers, calibrate, detect, locate", subcommands=_CAMERA
    ),
    "doctor": Command(
        "robot_ik.cli.doctor",
        "DoctorOptions",
        "what this machine can do, and what to do about the rest",
        mujoco=False,
    ),
}


def find_command(words: Sequence[str]) -> tuple[str, Command, list[str]]:
    """The row that a command line means, as deep as its words lead.

    Args:
        words: Command line without ``robot-ik``; the first word is a name of ``COMMANDS``.

    Returns:
        Its name ("servo scan"), its row, and the words that are left for it.

    Raises:
        KeyError: There is no such command.
    """
    name, command, rest = words[0], COMMANDS[words[0]], list(words[1:])
    while rest and rest[0] in command.subcommands:
        name, command = f"{name} {rest[0]}", command.subcommands[rest[0]]
        del rest[0]
    return name, command, rest
