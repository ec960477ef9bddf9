"""No wrong reply is a value, on either protocol: `docs/make/measure_wrong_replies.py`."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from robot_ik.hardware.family import FAMILY_MODULES

VALUES = 1500
"""Values of a run. The script measures 100,000 for each protocol."""

SCENARIOS = 7
"""Scenarios of the script."""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = Path(__file__).parents[2] / "docs" / "make" / "measure_wrong_replies.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look it up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("scenario", range(SCENARIOS))
@pytest.mark.parametrize("family", FAMILY_MODULES)
def test_no_wrong_reply_is_a_value_and_most_reads_have_one(script, family, scenario):
    row = script.SCENARIOS[scenario]
    result = script.measure(family, VALUES, row, seed=1)
    assert result.examples == []
    assert result.values >= VALUES
    assert result.refused < (0.15 if row.spoil_share else 0.2) * result.values


def test_every_scenario_is_tested(script):
    assert len(script.SCENARIOS) == SCENARIOS


def test_the_measurement_sees_a_wrong_value(script):
    result = script.WrongReplies()
    result.take("read", {1: 5, 2: 6}, {1: 7, 2: None})
    assert (result.values, result.wrong, result.refused) == (1, 1, 1)
