"""The former commands: help and typing mistakes."""

from __future__ import annotations

import dataclasses
import importlib
import re
import subprocess
import sys
from typing import Any

import pytest

from robot_ik.cli.main import COMMANDS, find_command

LEAVES = [name for name, command in COMMANDS.items() if command.options] + [
    f"{name} {word}" for name, command in COMMANDS.items() for word in command.subcommands
]
"""All that has options of its own: "reach", "servo setup"."""


@pytest.mark.parametrize("name", LEAVES)
def test_help_of_each_command(name: str, robot_ik: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _, command, rest = find_command(name.split())
    assert rest == []
    options = getattr(importlib.import_module(command.module), command.options)
    run = robot_ik(*name.split(), "--help")
    assert run.code == 0 and run.err == ""
    assert max(map(len, run.out.splitlines())) <= 80
    text = " ".join(run.out.replace("│", " ").split())
    assert text.startswith(f"usage: robot-ik {name} [-h]")
    for field in dataclasses.fields(options):
        if "Positional" not in str(field.type):  # those go by another name
            assert "--" + field.name.replace("_", "-") in text, field.name
    assert not re.search(r"command\.\w|<class|\w OPTIONS\]|\(default: (None)?\)", text)


HELPS = """
import contextlib, io, sys
from robot_ik.commands.main import main
for line in {lines}:
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main(line.split())
print([name for name in {heavy} if name in sys.modules])
"""


def test_help_imports_nothing_heavy() -> None:
    heavy = ["mujoco", "numba", "cv2", "serial", "dynamixel_sdk", "matplotlib", "viser"]
    code = HELPS.format(lines=[f"{name} --help" for name in LEAVES], heavy=heavy)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.parametrize(
    ("line", "reported"),
    [
        ("figure --path triangle", "'triangle' is not a valid choice; allowed: circle, random, marker"),
        ("ar --record a.csv", "unknown option '--record'\n"),
        ("figure --scale inf", "--scale: inf; allowed: 0 or more (default: 1; synthetic"),
        ("ar --size 640 3", "--size: 640 x 3 pixels; allowed: 16 to 16384 each (default: the camera's)"),
    ],
)
def test_wrong_words_are_reported_in_one_sentence(line: str, reported: str, robot_ik: Any) -> None:
    run = robot_ik(*line.split())
    run.assert_one_screen_error()
    assert reported in run.err and run.err.startswith("error: ")
    assert "--help" in run.err.splitlines()[-1] or len(run.err.splitlines()) == 1  # or all words were read
    assert not re.search(r"command\.|\{None\}|<class|invalid literal|Traceback", run.err)
