"""The error tree: one root, data as attributes, close names, hints at the end."""

import inspect

import pytest

from robot_ik import errors

CLASSES = [
    error
    for name, error in inspect.getmembers(errors, inspect.isclass)
    if error.__module__ == errors.__name__ and not name.startswith("_")
]


def test_every_error_has_the_same_root_and_module():
    assert len(CLASSES) > 30
    for error in CLASSES:
        assert issubclass(error, errors.RobotIkError) and error.__doc__
        assert getattr(errors, error.__name__) is error


@pytest.mark.parametrize(
    ("error", "builtin"),
    [
        (errors.UnknownFrameError, LookupError),
        (errors.UnknownSolverError, LookupError),
        (errors.InvalidGoalError, ValueError),
        (errors.UnsupportedGoalError, ValueError),
        (errors.ConfigError, ValueError),
        (errors.UnsafeCommandError, ValueError),
        (errors.MissingExtraError, ImportError),
        (errors.OutputError, OSError),
    ],
)
def test_an_error_derives_from_the_builtin_error(error, builtin):
    assert issubclass(error, builtin)


def test_a_wrong_name_lists_close_names_then_known_names():
    error = errors.UnknownJointError("joint_1", ["joint1", "joint2", "gripper"])
    assert error.name == "joint_1" and error.close[0] == "joint1" and error.known[2] == "gripper"
    text = str(error)
    assert "unknown joint 'joint_1'; did you mean 'joint1'" in text and "gripper" in text
    far = str(errors.UnknownRobotError("zzz", ["puma560"]))
    assert "did you mean" not in far and "known: puma560" in far
    assert "there is no frame" in str(errors.UnknownFrameError("x", []))
    assert "…" in str(errors.UnknownFrameError("x", [f"name{i}" for i in range(99)]))


def test_close_names_ignore_case():
    assert errors.close_matches("PUMA560", ["puma560", "ur5e"]) == ["puma560"]


@pytest.mark.parametrize(
    ("given", "known", "close"),
    [
        ("puma650", ["puma560", "panda"], ["puma560"]),  # exchanged digits
        ("gripr", ["gripper", "wrist"], ["gripper"]),
        ("dampign", ["damping", "patience"], ["damping"]),
        ("elbow", ["shoulder_pan_joint", "elbow_joint"], ["elbow_joint"]),
        ("puma", ["panda", "puma560"], ["puma560"]),
        ("joint_1", ["joint2", "joint1"], ["joint1"]),
        ("SLOVE", ["solve", "robots"], ["solve"]),
        ("--gaol", ["--goal", "--json"], ["--goal"]),
        (7, ["seven"], []),
        (None, ["none"], ["none"]),
    ],
)
def test_a_typing_error_has_close_names(given, known, close):
    assert errors.close_matches(given, known) == close


@pytest.mark.parametrize(
    ("given", "known"),
    [
        ("joint9", ["joint1", "joint2"]),  # another number is another joint
        ("restarts", ["tolerances", "streets"]),
        ("tool", ["elbow", "wheel"]),
        ("q0", ["q", "dq", "lm"]),
        ("method", ["methylene", "weather"]),
        ("x" * 200, ["x" * 201]),
        ("", ["a", "b"]),
        ("record", ["reach", "doctor"]),
        ("replay", ["reach"]),
        ("calibrate", ["camera"]),
        ("--solver", ["--overwrite"]),
        ("--record", ["--seconds"]),
        ("nojoint", ["root"]),
    ],
)
def test_another_word_has_no_close_names(given, known):
    assert errors.close_matches(given, known) == []
    assert errors.did_you_mean(given, known) == ""


def test_an_option_error_names_the_option_and_its_owner():
    error = errors.OptionError("damping", "-1 is not allowed", "0 to 1", owner="solver lm")
    assert str(error) == "solver lm: damping: -1 is not allowed; allowed: 0 to 1"
    assert (error.option, error.allowed, error.owner) == ("damping", "0 to 1", "solver lm")
    assert str(errors.OptionError("seed", "'x' is not allowed")) == "seed: 'x' is not allowed"


def test_the_hint_comes_last_and_only_once():
    error = errors.ModelError("it is broken", path="a.xml", reason="no", hint="mend it")
    assert str(error) == "it is broken\nmend it" and (error.path, error.reason) == ("a.xml", "no")
    assert str(errors.ModelError("it is broken")) == "it is broken"


def test_messages_have_the_request_the_allowed_values_and_a_hint():
    assert str(
        errors.ConfigError("is no number", file="arm.toml", key="bus.baud", allowed="9600 …")
    ) == ("arm.toml: bus.baud: is no number; allowed: 9600 …")
    assert str(errors.UnsupportedGoalError("ccd", "a line goal", ["lm", "dls"])).endswith(
        "these solvers do: lm, dls"
    )
    missing = errors.MissingExtraError("viser", "web", "the browser view")
    assert 'pip install "robot-ik-testbed[web]"' in str(missing)
    timeout = errors.BusTimeoutError(
        id=3, register="present_position", port="/dev/x", joint="elbow", last_good=0.5
    )
    for part in ("servo id 3", "'elbow'", "present_position", "/dev/x", "0.50 s ago", "baud"):
        assert part in str(timeout)
    table = str(errors.ServoMismatchError({1: "a: XM430"}, {2: "XL330"}, port="p"))
    assert "missing" in table and "nothing was switched on" in table
    assert str(errors.UnsafeCommandError("NaN", "numbers")).endswith(
        "Nothing was sent to any servo."
    )
    assert "overheating" in str(errors.MotorFaultError("wrist", ["overheating"]))
    refused = errors.ServoRefusedError(id=4, register="goal_position", code=6, reason="data limit")
    assert refused.code == 6 and "refused goal_position: data limit (error 6)" in str(refused)


def test_different_numbers_have_different_texts():
    assert errors.distinct_texts(200.0, -160.0, 160.0) == ["200.0", "-160.0", "160.0"]
    assert errors.distinct_texts(160.04, -160.0, 160.0) == ["160.04", "-160.00", "160.00"]
    assert errors.distinct_texts(160.0 + 3e-14, 160.0)[0] != "160.0"
    assert errors.distinct_texts(1.0, 1.0, digits=2) == ["1.00", "1.00"]
    assert errors.distinct_texts(1.25, -1.0, 1.0, digits=6, form="g") == ["1.25", "-1", "1"]
    assert errors.distinct_texts(1.0000001, 1.0, digits=6, form="g") == ["1.0000001", "1"]
