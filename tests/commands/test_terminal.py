"""How the commands talk: streams, width, colour, JSON, log."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest

from robot_ik.commands.streams import open_console
from robot_ik.commands.tables import table
from robot_ik.commands.terminal import Report, Terminal, say, show_logs

LONG_NAME = "a_name_without_any_place_to_break_it_" * 3


class FactsReport(Report):
    """Report with values that JSON does not have."""

    def tables(self) -> Iterable[Any]:
        """Return one line."""
        return ["three values"]

    def facts(self) -> Mapping[str, Any]:
        """Return a NaN, an array, and a character outside ASCII."""
        return {"a": float("nan"), "b": np.arange(3), "c": "µm"}


def test_json_is_one_object_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    Terminal(json=True).show(FactsReport())
    said = capsys.readouterr()
    assert '"b": [0, 1, 2]' in said.out
    assert json.loads(said.out) == {"schema": 1, "a": None, "b": [0, 1, 2], "c": "µm"}
    assert said.err == ""


def test_a_report_is_shown_once(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = Terminal()
    report = FactsReport()
    terminal.show(report)
    terminal.show(report)
    assert capsys.readouterr().out == "three values\n"


def test_tables_in_a_pipe_have_no_colour_and_break_no_word(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = [(LONG_NAME, "short"), ("x", "[green]words[/green]")]
    open_console(sys.stdout).print(table("name", "what", rows=rows))
    said = capsys.readouterr().out
    assert LONG_NAME in said and "[green]" in said and "\x1b" not in said


def test_talk_goes_to_stderr_unbroken(capsys: pytest.CaptureFixture[str]) -> None:
    say("word " * 60 + "[/not-markup]", "bold red")
    said = capsys.readouterr()
    assert said.out == "" and said.err == "word " * 60 + "[/not-markup]\n"


def test_progress_away_from_a_terminal_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    terminal = Terminal()
    with terminal.running("moving"):
        for k in range(3):
            terminal.progress("moving", k / 3)
            terminal.counting("picture")(k, 3)
    said = capsys.readouterr()
    assert said.out == "" and said.err == ""


def test_kernels_report_compilations_and_other_parts_only_warnings(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with show_logs():
        logging.getLogger("robot_ik.kernels").info("compiling %s: some seconds", "lm")
        logging.getLogger("robot_ik.camera").info("not shown")
        logging.getLogger("robot_ik.camera").warning("shown [x]")
    said = capsys.readouterr()
    assert said.out == "" and said.err.splitlines() == ["compiling lm: some seconds", "shown [x]"]


def test_handlers_and_levels_are_restored(capsys: pytest.CaptureFixture[str]) -> None:
    loggers = [logging.getLogger(name) for name in ("robot_ik", "robot_ik.kernels")]
    before = [(list(logger.handlers), logger.level) for logger in loggers]
    with pytest.raises(ValueError), show_logs(debug=True):
        logging.getLogger("robot_ik.camera").debug("everything")
        raise ValueError
    assert "everything" in capsys.readouterr().err
    assert [(list(logger.handlers), logger.level) for logger in loggers] == before
