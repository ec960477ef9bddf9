"""The TOML file of faults: what it says, and what is said of a mistake in it."""

from __future__ import annotations

from pathlib import Path

import pytest

from robot_ik.errors import ConfigError
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.faults import Fault, load_faults, parse_faults

GOOD = """
schema = 1
seed = 7

[[faults]]
kind = "silent"
joint = "joint3"
at_s = 2.0
for_s = 0.05

[[faults]]
kind = "corrupt"
value = 0.001

[[faults]]
kind = "overload"
id = 6
at_packet = 100

[[faults]]
kind = "silent"
for_packets = 1
"""


def test_a_good_file(arm_config: ArmConfig, tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text(GOOD)
    script = load_faults(path, arm_config)
    assert script.seed == 7
    assert script.faults == (
        Fault("silent", joint="joint3", at_s=2.0, for_s=0.05),
        Fault("corrupt", value=0.001),
        Fault("overload", 6, at_packet=100),
        Fault("silent", for_packets=1),
    )


def _entry(text: str) -> str:
    return f"schema = 1\n[[faults]]\n{text}"


@pytest.mark.parametrize(
    "text,key,said",
    [
        ("schema = 2", "schema", "allowed: 1"),
        ("seed = 1", "schema", "missing"),
        ("schema = ", "", "TOML"),
        ('schema = 1\nfault = "x"', "fault", "faults"),
        (_entry('kind = "silnt"'), "faults[0].kind", "silent"),
        (_entry('kind = "silent"\njiont = "joint3"'), "faults[0].jiont", "joint"),
        (_entry('knid = "silent"'), "faults[0].knid", "did you mean kind"),
        (_entry('kind = "silent"\njoint = "joitn3"'), "faults[0].joint", "joint3"),
        (_entry('kind = "silent"\nid = 77'), "faults[0].id", "1, 2, 3"),
        (_entry('kind = "silent"\nvalue = 1.0'), "faults[0].value", "takes no value"),
        (_entry('kind = "drop"'), "faults[0].value", "0..1"),
        (_entry('kind = "drop"\nvalue = 1.5'), "faults[0].value", "0..1"),
        (_entry('kind = "drop"\nvalue = "0.5"'), "faults[0].value", "number"),
        (_entry('kind = "drop"\nvalue = nan'), "faults[0].value", "finite"),
        (
            _entry('kind = "drop"\nvalue = 0.1\njoint = "joint1"'),
            "faults[0].joint",
            "not of one servo",
        ),
        (_entry('kind = "return_delay"\nvalue = 0.5\nid = 1'), "faults[0].value", "whole number"),
        (_entry('kind = "silent"\nat_s = -1.0'), "faults[0].at_s", "allowed: >= 0"),
        (
            _entry('kind = "silent"\nat_s = 1.0\nat_packet = 3'),
            "faults[0].at_packet",
            "exclude each other",
        ),
        (_entry('kind = "silent"\nid = 1\njoint = "joint1"'), "faults[0].id", "exclude each other"),
    ],
)
def test_a_mistake_is_named(text: str, key: str, said: str, arm_config: ArmConfig) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_faults(text, arm_config, "faults.toml")
    message = str(caught.value)
    assert "faults.toml" in message and key in message and said in message, message
    assert "Traceback" not in message


def test_a_file_that_is_not_there(arm_config: ArmConfig, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_faults(tmp_path / "none.toml", arm_config)
