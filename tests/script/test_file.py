"""Reading a script: accepted keys, and errors with the place and similar names."""

from __future__ import annotations

import contextlib
import json
import re
import typing
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.errors import ConfigError
from robot_ik.script import ScriptRequest, ScriptRun, load_script, parse_script, shipped
from robot_ik.script.file import Script
from robot_ik.script.state import RunState, StepResult
from robot_ik.script.steps import STEPS, ScriptStep, base

HEAD = 'schema = 1\nname = "trial"\n'


def with_step(*rows: str) -> str:
    """Return a script with one step."""
    return HEAD + "[[steps]]\n" + "\n".join(rows)


def error_of(text: str) -> ConfigError:
    """Return the error of a script, which must name the file."""
    with pytest.raises(ConfigError) as caught:
        parse_script(text, "trial.toml")
    assert "trial.toml" in str(caught.value)
    return caught.value


@pytest.mark.parametrize(
    ("text", "key", "message"),
    [
        ("schema = 1", "name", "missing"),
        ("schema = 2\nname = 'x'\n[[steps]]\ndo = 'hold'", "schema", "2"),
        (HEAD + "steps = []", "steps", "at least 1"),
        (HEAD + "sed = 3\n[[steps]]\ndo = 'hold'", "sed", "did you mean seed"),
        (HEAD + "seed = -3\n[[steps]]\ndo = 'hold'", "seed", ">= 0"),
        (with_step("seconds = 1"), "steps[0].do", "position, pose"),
        (with_step("do = 'wiat'"), "steps[0].do", "did you mean wait"),
        (with_step("do = 'wait'"), "steps[0].seconds", "missing"),
        (with_step("do = 'wait'", "seconds = -1"), "steps[0].seconds", "0..86400"),
        (with_step("do = 'wait'", "seconds = inf"), "steps[0].seconds", "finite"),
        (with_step("do = 'wait'", "second = 1"), "steps[0].second", "did you mean seconds"),
        (
            with_step("do = 'hold'", "time_limt_s = 1"),
            "steps[0].time_limt_s",
            "did you mean time_limit_s",
        ),
        (
            with_step("do = 'hold'", "raises = 'MotorFault'"),
            "steps[0].raises",
            "did you mean MotorFaultError",
        ),
        (
            with_step("do = 'hold'", "raises = '_UnknownName'"),
            "steps[0].raises",
            "UnknownRobotError",
        ),
        (
            with_step("do = 'pose'", "position = [1, 2]", "wxyz = [1, 0, 0, 0]"),
            "steps[0].position",
            "3 numbers",
        ),
        (
            with_step("do = 'pose'", "position = [1, 2, 3]", "wxyz = [0, 0, 0, 0]"),
            "steps[0].wxyz",
            "all zero",
        ),
        (with_step("do = 'line'"), "steps[0].position", "position or by"),
        (
            with_step("do = 'line'", "by = [0, 0, 0.1]", "position = [0, 0, 0]"),
            "steps[0].position",
            "position or by",
        ),
        (
            with_step("do = 'follow'", "path = 'circle'", "seconds = 1"),
            "steps[0].center",
            "missing",
        ),
        (
            with_step("do = 'follow'", "path = 'marker'", "seconds = 1", "radius = 1"),
            "steps[0].radius",
            "does not use radius",
        ),
        (with_step("do = 'expect'"), "steps[0]", "nothing is expected"),
        (with_step("do = 'expect'", "run_seconds = [2, 1]"), "steps[0].run_seconds", "[from, to]"),
        (with_step("do = 'expect'", "state = 'parked'"), "steps[0].state", "'fault'"),
    ],
)
def test_an_error_names_its_key(text: str, key: str, message: str) -> None:
    error = error_of(text)
    assert error.key == key
    assert message in str(error)


def test_invalid_toml_and_missing_files_are_errors(tmp_path: Path) -> None:
    assert "not valid TOML" in str(error_of("schema = ="))
    with pytest.raises(ConfigError, match="cannot be read"):
        load_script(tmp_path / "missing.toml")
    with pytest.raises(ConfigError, match="did you mean overload"):
        load_script("overlaod")


def test_a_bundled_script_loads_by_its_name() -> None:
    assert load_script("overload") == load_script(shipped()["overload"])


@pytest.mark.parametrize(
    ("rows", "key", "message"),
    [
        (("do = 'joints'", "joints_deg = {jont2 = 3}"), "joints_deg.jont2", "did you mean joint2"),
        (("do = 'joints'", "joints_deg = {joint5 = 300}"), "joints_deg.joint5", "-110.0 … 110.0"),
        (
            ("do = 'position'", "position = [0.2, 0, 0.1]", "frame = 'griper'"),
            "frame",
            "did you mean gripper",
        ),
        (("do = 'keyframe'", "keyframe = 'hom'"), "keyframe", "did you mean home"),
        (("do = 'expect'", "status = 'UNREACHABEL'"), "status", "did you mean UNREACHABLE"),
        (("do = 'grip'", "width_mm = 40.0"), "width_mm", "0 to 36"),
        (("do = 'inject'", "kind = 'overlod'"), "kind", "did you mean overload"),
        (("do = 'inject'", "kind = 'overload'", "joint = 'joint9'"), "joint", "joint9"),
        (("do = 'inject'", "kind = 'corrupt'", "value = 2.0"), "value", "0..1"),
        (("do = 'inject'", "kind = 'corrupt'"), "value", "missing"),
        (("do = 'inject'", "kind = 'model'", "value = 3.5"), "value", "a whole number"),
        (
            ("do = 'inject'", "kind = 'drop'", "joint = 'joint2'", "value = 0.1"),
            "joint",
            "not of one servo",
        ),
    ],
)
def test_a_step_that_does_not_fit_the_arm_is_an_error_before_the_run(
    rows: tuple[str, ...], key: str, message: str
) -> None:
    script = parse_script(with_step("do = 'hold'\n[[steps]]", *rows), "t.toml")
    with pytest.raises(ConfigError) as caught:
        ScriptRun(script, ScriptRequest())
    assert caught.value.key == f"steps[1].{key}"
    assert message in str(caught.value)
    assert str(caught.value).startswith("t.toml: steps[1]")


@pytest.mark.parametrize(
    "rows",
    [
        ("do = 'inject'", "kind = 'overload'"),
        ("do = 'clear'",),
        ("do = 'recover'",),
        ("do = 'marker'",),
        ("do = 'expect'", "keyframe = 'home'", "shafts = true"),
    ],
)
def test_steps_for_simulated_servos_are_rejected_on_a_real_port(rows: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match=r"steps\[0\]"):
        ScriptRun(parse_script(with_step(*rows)), ScriptRequest(bus="/dev/nowhere"))


def test_hold_is_accepted_on_a_real_port() -> None:
    ScriptRun(parse_script(with_step("do = 'hold'")), ScriptRequest(bus="/dev/nowhere"))


def test_each_kind_of_step_has_a_name_and_runs() -> None:
    for name, kind in STEPS.items():
        assert typing.get_args(kind.model_fields["do"].annotation) == (name,)
        assert kind.run is not ScriptStep.run


def test_a_new_kind_of_step_is_one_class(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "STEPS", dict(STEPS))

    class CountStep(ScriptStep):
        title_keys = ("number",)
        do: Literal["count"]
        number: int

        def run(self, _state: RunState, result: StepResult) -> None:
            result.numbers["count"] = self.number

    script = parse_script(with_step("do = 'count'", "number = 3"))
    row = ScriptRun(script, ScriptRequest()).report.steps[0]
    # The step does not use the state.
    state: Any = None
    script.steps[0].run(state, row)
    assert (row.name, row.numbers) == ("count 3", {"count": 3})
    error = error_of(with_step("do = 'count'", "number = true"))
    assert error.key == "steps[0].number"


def test_the_page_of_scripts_lists_each_step_and_each_key() -> None:
    path = Path(__file__).parents[2] / "docs" / "how-to" / "testing.md"
    page = path.read_text(encoding="utf-8")
    table = page[page.index("| `do` |") :]
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*)$", table, re.MULTILINE))
    common_keys = {"do", "name", "time_limit_s", "raises", "speed", "tolerance_mm", "tolerance_deg"}
    for name, kind in STEPS.items():
        assert name in rows, f"docs/how-to/testing.md has no row of the step {name}"
        keys = set(kind.model_fields) - common_keys
        assert set(re.findall(r"`(\w+)`", rows[name])) >= keys, name
    for key in common_keys | set(Script.model_fields) - {"version", "about", "arm"}:
        assert key in page, key


WORDS = sorted(
    {key for kind in STEPS.values() for key in kind.model_fields} | set(STEPS) | {"frmae"}
)
VALUES = st.one_of(
    st.booleans(),
    st.integers(-3, 3),
    st.floats(-2.0, 2.0),
    st.sampled_from([*WORDS, "MotorFaultError", "home", "silent", "joint1", "circle"]),
    st.lists(st.floats(-1.0, 1.0), max_size=4),
    st.dictionaries(st.sampled_from(["joint1", "jont"]), st.floats(-90.0, 90.0), max_size=2),
)


def toml(value: object) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + "}"
    return json.dumps(value)


@settings(max_examples=60)
@given(
    do=st.sampled_from(sorted(STEPS)),
    keys=st.dictionaries(st.sampled_from(WORDS), VALUES, max_size=6),
)
def test_any_step_is_accepted_or_a_config_error(do: str, keys: dict[str, object]) -> None:
    rows = [f"{key} = {toml(value)}" for key, value in ({"do": do} | keys).items()]
    with contextlib.suppress(ConfigError):
        parse_script(with_step(*rows), "fuzz.toml")


@pytest.mark.parametrize(
    ("head", "rows", "key", "message"),
    [
        ("robot = 'puma560'", ("do = 'grip'", "opening = 0.5"), "steps[0].do", "has no gripper"),
        ("", ("do = 'grip'", "held = true"), "steps[0].opening", "opening or width_mm"),
        (
            "",
            ("do = 'expect'", "object = 'cup'", "position = [0, 0, 0]"),
            "steps[0].object",
            "'cup'",
        ),
        (
            "[[objects]]\nname='a'\nposition=[0,0,0]\nsize_mm=[1,1,1]",
            ("do = 'hold'",),
            "physics",
            "true",
        ),
        (
            "[[objects]]\nname='a'\nsize=[1,1,1]",
            ("do = 'hold'",),
            "objects[0].size",
            "did you mean size_mm",
        ),
    ],
)
def test_a_missing_gripper_or_object_is_an_error(
    head: str, rows: tuple[str, ...], key: str, message: str
) -> None:
    text = f"schema = 1\nname = 't'\n{head}\n[[steps]]\n" + "\n".join(rows)
    with pytest.raises(ConfigError) as caught:
        ScriptRun(parse_script(text, "t.toml"), ScriptRequest())
    assert caught.value.key == key
    assert message in str(caught.value)
