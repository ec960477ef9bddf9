"""How the commands talk: streams, width, colour, JSON, log."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_ik.cli import console
from robot_ik.files import json_text

LONG = "a_name_without_any_place_to_break_it_" * 3

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner) | st.tuples(inner),
    max_leaves=20,
)


@given(json_values)
def test_plain_gives_json_that_every_reader_accepts(value: object) -> None:
    simple = console.plain(value)
    assert json.loads(json.dumps(simple, allow_nan=False)) == simple
    assert json.loads(json_text(simple)) == simple


def test_plain_takes_arrays_and_keeps_every_digit() -> None:
    q = np.array([0.1, np.pi, -1e-17])
    assert np.array_equal(console.plain({"q": q})["q"], q)
    assert console.plain(np.float64("nan")) is None
    assert console.plain(np.array([np.inf, 1.0])) == [None, 1.0]
    assert console.plain(np.int64(3)) == 3


def test_print_json_is_one_object_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    console.print_json({"a": float("nan"), "b": np.arange(3), "c": "µm"})
    said = capsys.readouterr()
    assert '"b": [0, 1, 2]' in said.out
    assert json.loads(said.out) == {"a": None, "b": [0, 1, 2], "c": "µm"}
    assert said.err == ""


def test_tables_in_a_pipe_have_no_colour_and_break_no_word(capsys: pytest.CaptureFixture[str]) -> None:
    shown = console.table("name", "what")
    shown.add_row(LONG, "short")
    shown.add_row("x", "[green]words[/green]")
    console.out().print(shown)
    said = capsys.readouterr().out
    assert LONG in said and "\x1b" not in said


def test_talk_goes_to_stderr_unbroken(capsys: pytest.CaptureFixture[str]) -> None:
    console.say("word " * 60 + "[/not-markup]", "bold red")
    said = capsys.readouterr()
    assert said.out == "" and said.err == "word " * 60 + "[/not-markup]\n"


def test_progress_away_from_a_terminal_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    with console.progress() as bar:
        task = bar.add_task("moving", total=3, note="")
        for _ in range(3):
            bar.advance(task)
    said = capsys.readouterr()
    assert said.out == "" and said.err.strip() == ""


def test_kernels_may_speak_and_others_only_warn(capsys: pytest.CaptureFixture[str]) -> None:
    with console.logs_shown():
        logging.getLogger("robot_ik.kernels").info("compiling %s: some seconds", "lm")
        logging.getLogger("robot_ik.camera").info("not shown")
        logging.getLogger("robot_ik.camera").warning("shown [x]")
    said = capsys.readouterr()
    assert said.out == "" and said.err.splitlines() == ["compiling lm: some seconds", "shown [x]"]


def test_handlers_and_levels_are_taken_back(capsys: pytest.CaptureFixture[str]) -> None:
    names = ("robot_ik", "robot_ik.kernels")
    before = [(list(logging.getLogger(n).handlers), logging.getLogger(n).level) for n in names]
    with pytest.raises(ValueError), console.logs_shown(debug=True):
        logging.getLogger("robot_ik.camera").debug("everything")
        raise ValueError
    assert "everything" in capsys.readouterr().err
    assert [(list(logging.getLogger(n).handlers), logging.getLogger(n).level) for n in names] == before
