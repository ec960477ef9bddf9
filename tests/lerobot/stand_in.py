"""Stand-in for the parts of LeRobot that ``robot_ik.lerobot`` imports.

The tests of the default environment run without LeRobot, which needs PyTorch. The classes here have
the interface of LeRobot 0.6.1. ``make lerobot`` runs the same code with LeRobot itself.
"""

from __future__ import annotations

import enum
import functools
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest


class _Registry:
    """Interface of ``draccus.ChoiceRegistry``."""

    choices: ClassVar[dict[str, type]]

    @classmethod
    def register_subclass(cls, name: str) -> Callable[[type], type]:
        def register(subclass: type) -> type:
            cls.choices[name] = subclass
            return subclass

        return register


@dataclass(kw_only=True)
class RobotConfig(_Registry):
    choices: ClassVar[dict[str, type]] = {}

    id: str | None = None
    calibration_dir: Path | None = None

    def __post_init__(self) -> None:
        pass


@dataclass(kw_only=True)
class CameraConfig(_Registry):
    choices: ClassVar[dict[str, type]] = {}

    fps: int | None = None
    width: int | None = None
    height: int | None = None


class Robot:
    name: str

    def __init__(self, config: RobotConfig) -> None:
        assert config.calibration_dir is not None
        self.id = config.id
        self.calibration_dir = config.calibration_dir
        self.calibration_fpath = self.calibration_dir / f"{self.id}.json"
        self.calibration: dict[str, Any] = {}
        if self.calibration_fpath.is_file():
            self._load_calibration()

    def _load_calibration(self) -> None:
        rows = json.loads(self.calibration_fpath.read_text())
        self.calibration = {name: SimpleNamespace(**row) for name, row in rows.items()}


class Camera:
    def __init__(self, config: CameraConfig) -> None:
        self.fps = config.fps
        self.width = config.width
        self.height = config.height


class MotorNormMode(enum.Enum):
    RANGE_0_100 = "range_0_100"
    DEGREES = "degrees"


@dataclass
class Motor:
    id: int
    model: str
    norm_mode: MotorNormMode


class ConnectionStateError(ConnectionError):
    """In place of ``DeviceNotConnectedError`` and ``DeviceAlreadyConnectedError``."""


def _require_state(connected: bool) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    def decorate(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def wrapper(self: Any, *args: Any, **kwargs: Any) -> Any:
            if self.is_connected is not connected:
                raise ConnectionStateError(method.__name__)
            return method(self, *args, **kwargs)

        return wrapper

    return decorate


def _no_cameras(configs: Mapping[str, Any]) -> dict[str, Any]:
    raise AssertionError(f"the tests use no camera of LeRobot: {configs}")


_MODULES: dict[str, dict[str, Any]] = {
    "lerobot": {},
    "lerobot.cameras": {"Camera": Camera, "CameraConfig": CameraConfig},
    "lerobot.cameras.utils": {"make_cameras_from_configs": _no_cameras},
    "lerobot.motors": {"Motor": Motor, "MotorNormMode": MotorNormMode},
    "lerobot.robots": {"Robot": Robot, "RobotConfig": RobotConfig},
    "lerobot.utils": {},
    "lerobot.utils.decorators": {
        "check_if_already_connected": _require_state(connected=False),
        "check_if_not_connected": _require_state(connected=True),
    },
}

_SUBMODULES = ("arm", "bus_view", "config_arm", "config_scene_camera", "scene_camera")


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the stand-in into ``sys.modules`` until the fixture ends."""
    for name, content in _MODULES.items():
        module = ModuleType(name)
        module.__path__ = []
        for key, value in content.items():
            setattr(module, key, value)
        monkeypatch.setitem(sys.modules, name, module)
    for name in _SUBMODULES:
        monkeypatch.delitem(sys.modules, f"robot_ik.lerobot.{name}", raising=False)
