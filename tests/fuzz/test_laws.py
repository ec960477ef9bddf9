"""The laws of ``laws.py`` with known failing inputs and with random inputs.

`make fuzz` searches further inputs for minutes.
"""

from __future__ import annotations

import importlib.util
import random
import sys
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_ik.hardware.virtual import protocol


def _laws() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_laws", Path(__file__).with_name("laws.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


laws = _laws()

FAST_LAWS = [name for name in laws.LAWS if name not in ("servos", "arm")]
"""Laws that are fast enough for many random inputs."""


@pytest.mark.parametrize(("law", "data"), laws.known_inputs())
def test_inputs_of_earlier_failures_break_no_law(law: str, data: bytes) -> None:
    laws.LAWS[law](data)


@pytest.mark.parametrize("law", laws.LAWS)
def test_random_stories_break_no_law(law: str) -> None:
    rng = random.Random(2)
    for _ in range(25 if law in FAST_LAWS else 5):
        laws.LAWS[law](laws.random_input(rng))


@pytest.mark.parametrize("law", FAST_LAWS)
@settings(max_examples=30)
@given(data=st.binary(max_size=300))
def test_any_bytes_break_no_law(law: str, data: bytes) -> None:
    laws.LAWS[law](data)


def test_the_laws_detect_a_parser_that_accepts_a_wrong_checksum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(protocol, "crc16", lambda data: int.from_bytes(b"\x00\x00", "little"))
    noise = protocol.HEADER + bytes((1, 4, 0, protocol.Instruction.REBOOT, 9, 0, 0))
    with pytest.raises(AssertionError):
        laws.servo_parser(bytes((len(noise) << 3,)) + noise)
