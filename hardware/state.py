"""The states of an arm."""

from __future__ import annotations

import enum


class ArmState(enum.Enum):
    """What an arm is doing."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"
    ENABLED = "enabled"
    HOLD = "hold"
    PARKING = "parking"
    FAULT = "fault"
