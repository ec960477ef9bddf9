"""Processes that compile for the session: what they compile is what its solvers ask for."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from robot_ik.testbed import preparing
from robot_ik.testbed.commands import Start
from robot_ik.testbed.robot_goals import ExtraGoal
from robot_ik.testbed.session import Session
from robot_ik.testbed.setup import MethodChoice, Setup
from tests.waiting import wait_for

FAILING = """#!/bin/sh
case "$*" in *prepare_setup*)
    echo one; echo two
    until [ -e "$0.seen" ]; do sleep 0.05; done
esac
exit 1
"""


@pytest.mark.skipif(sys.platform == "win32", reason="the stand-in for Python is a shell script")
@pytest.mark.parametrize("there", [True, False])
def test_a_session_says_how_far_it_is_and_is_ready_though_the_processes_fail(
    there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "python"
    if there:
        program.write_text(FAILING)
        program.chmod(0o755)
    monkeypatch.setattr("robot_ik.testbed.preparing.is_compiled", lambda *given: False)
    monkeypatch.setattr(sys, "executable", str(program))
    said = set()
    progress = "compiling dls, once on this machine: 2 functions so far …"
    with Session(Start()) as session:
        session.tick()
        assert session.busy and not session.ready, "a compiler held the loop up"

        def tick() -> bool:
            said.add(session.busy)
            if progress in said:
                program.with_suffix(".seen").touch()
            session.tick()
            return session.ready

        wait_for(tick, "it is never ready")
        assert session.view().instances[0].method == "dls"
    assert (progress in said) is there


def test_a_setup_reaches_its_process_as_it_is() -> None:
    options = (("damping", 0.1), ("restarts", 0))
    extras = (ExtraGoal("balance", True, 1, "the centre of mass stays"),)
    setup = Setup(
        "humanoid",
        2,
        (MethodChoice("dls", options), MethodChoice("lm")),
        extras=extras,
        limits=(False, True, True, True),
    )
    assert preparing._SETUP.validate_json(preparing._SETUP.dump_json(setup)) == setup
