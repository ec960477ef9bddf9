"""The fixtures for tests of other programs, in separate projects."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[1]
# By name, so that pytest finds it also if the package was installed without the entry point.
PLUGIN = ("-p", "robot_ik.pytest_plugin", "-p", "no:cacheprovider", "-p", "no:hypothesispytest")


ONE_WORLD = r"""
import numpy as np
import pytest
from robot_ik.errors import BusDisconnectedError, ConfigError

def test_arm_stands_at_home_with_torque(virtual_arm, virtual_bus):
    assert virtual_arm.bus.virtual_bus is virtual_bus
    assert virtual_arm.state.value == "enabled"
    assert all(servo.memory.values["torque_enable"] for servo in virtual_bus.servos)
    angles = np.degrees(virtual_arm.read().q[:6])
    np.testing.assert_allclose(angles, [0, 75, -165, 0, -90, 0], atol=0.1)

def test_each_test_has_its_own(virtual_bus):
    assert not any(servo.memory.values["torque_enable"] for servo in virtual_bus.servos)

def test_a_file_of_faults_counts_from_its_call(virtual_arm, fault_script):
    clock = virtual_arm.clock
    clock.sleep_until(5.0)
    fault_script('''
        schema = 1
        [[faults]]
        kind = "port_unplugged"
        at_s = 0.2
    ''')
    virtual_arm.send(virtual_arm.read().q, clock.now())
    clock.sleep_until(clock.now() + 0.21)
    with pytest.raises(BusDisconnectedError):
        virtual_arm.send(virtual_arm.read().q, clock.now())
    assert fault_script.clear() == 1

def test_a_mistake_in_a_fault_is_reported(fault_script):
    with pytest.raises(ConfigError, match="no fault is called 'overlod'"):
        fault_script.inject("overlod")
"""

ANOTHER_ARM = r"""
import pytest
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.dynamixel import DynamixelBus

@pytest.fixture
def virtual_arm_config():
    return ArmConfig.generic("two_joints", ["a", "b"], -1.0, 1.0)

def test_port(virtual_port, virtual_bus, fault_script):
    bus = DynamixelBus(virtual_port, 1_000_000)
    bus.open()
    try:
        assert bus.ping(2) == 1020  # an XM430-W350
        fault_script.inject("silent", "a")
        assert list(bus.broadcast_ping()) == [2]
    finally:
        bus.close()
"""


def test_the_fixtures_work_in_other_projects(pytester: pytest.Pytester) -> None:
    """It runs in one child process, because pytest would import the modules twice in this one."""
    page = (ROOT / "docs" / "how-to" / "testing.md").read_text(encoding="utf-8")
    examples = dict(
        re.findall(r"^```python file=(test_\w+)\.py\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    )
    assert examples
    files = {**examples, "test_one_world": ONE_WORLD, "test_another_arm": ANOTHER_ARM}
    pytester.makepyfile(**files)
    count = sum(len(re.findall(r"^def test_", text, re.MULTILINE)) for text in files.values())
    result = pytester.runpytest_subprocess(*PLUGIN)
    result.assert_outcomes(passed=count)


def test_the_entry_point_is_the_module() -> None:
    """With another name pytest would register the plugin twice, which it refuses."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["pytest11"] == {
        "robot_ik.pytest_plugin": "robot_ik.pytest_plugin"
    }
    installed = [
        e for e in metadata.entry_points(group="pytest11") if e.value == "robot_ik.pytest_plugin"
    ]
    assert all(entry.name == "robot_ik.pytest_plugin" for entry in installed)


def test_the_plugin_imports_no_large_module() -> None:
    heavy = [
        "numpy",
        "mujoco",
        "numba",
        "cv2",
        "serial",
        "dynamixel_sdk",
        "pydantic",
        "rich",
        "cyclopts",
    ]
    code = (
        "import sys, pytest; before = set(sys.modules); import robot_ik.pytest_plugin;"
        f"print(sorted(set({heavy}) & (set(sys.modules) - before)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "[]\n", done
