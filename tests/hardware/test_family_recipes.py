"""The recipes of docs/how-to/extend.md for a servo model and for a servo family."""

from __future__ import annotations

import re
import sys
import types
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import pytest

from robot_ik.hardware import family, models, open_arm
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families import feetech_sts_table
from robot_ik.hardware.virtual import bus as virtual_bus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.ports import VirtualClock

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "extend.md"
TURN = 0.2
"""rad."""


def python_block(text: str) -> types.ModuleType:
    """Return the module of the block of the page that contains ``text``."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = [block for block in blocks if text in block]
    module = types.ModuleType("recipe")
    exec(compile(code, "extend.md", "exec", dont_inherit=True), module.__dict__)
    return module


@pytest.fixture
def tables(monkeypatch):
    """Control tables to which a test may add models."""
    original = models.CONTROL_TABLES
    tables = dict(original)
    for module in [*sys.modules.values()]:
        if getattr(module, "CONTROL_TABLES", None) is original:
            monkeypatch.setattr(module, "CONTROL_TABLES", MappingProxyType(tables))
    models.control_table.cache_clear()
    yield tables
    models.control_table.cache_clear()


def arm_of(model: str) -> ArmConfig:
    config = ArmConfig.load("so101")
    joints = tuple(
        replace(joint, servos=tuple(replace(servo, model=model) for servo in joint.servos))
        for joint in config.joints
    )
    return replace(config, joints=joints, file=None)


def drive(config: ArmConfig) -> VirtualBus:
    """Drive the first joint of an arm of virtual servos."""
    servos = VirtualBus.from_config(config, VirtualClock())
    with open_arm(config, "sim", virtual_bus=servos, on_exit="torque_off") as arm:
        arm.enable()
        target = arm.read().q.copy()
        target[0] += TURN
        arm.move_to(target)
        assert arm.read().q == pytest.approx(target, abs=0.01)
    assert arm.exit_report.ok
    return servos


def test_a_servo_model_is_one_row(tables):
    (row,) = re.findall(r'("STS9999": StsModel.*?),\n```', PAGE.read_text(encoding="utf-8"))
    (model,) = eval(f"{{{row}}}", vars(feetech_sts_table)).items()
    tables[model[0]] = feetech_sts_table.build_table(*model)
    servos = drive(arm_of("STS9999"))
    assert servos.servos[0].values["model_number"] == 9999


def test_a_servo_family_is_two_files(tables, monkeypatch):
    tables.update(python_block("ACME_TABLES = ").ACME_TABLES)
    monkeypatch.setitem(sys.modules, "acme_ab", python_block("class AcmeAb"))
    monkeypatch.setitem(family.FAMILY_MODULES, "acme_ab", "acme_ab")
    rows = dict(virtual_bus.VIRTUAL_FAMILIES)
    rows["acme_ab"] = rows["feetech_sts"]
    monkeypatch.setattr(virtual_bus, "VIRTUAL_FAMILIES", rows)
    config = arm_of("AB100")
    assert config.family.title == "Acme AB"
    assert drive(config).family == "acme_ab"
