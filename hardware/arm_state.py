"""States of an arm, and the events that lead from one to the next.

``DISCONNECTED`` -> connect -> ``CONNECTED`` -> enable -> ``ENABLED`` <-> ``HOLD``.  The arm is
``MOVING`` on the way to a pose.  ``FAULT`` is latched until ``reset_fault``, ``reconnect`` or
``close``.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping

from robot_ik.errors import ArmStateError


class ArmState(enum.Enum):
    """State of an arm."""

    DISCONNECTED = "disconnected"
    CONNECTED = "connected"
    ENABLED = "enabled"
    HOLD = "hold"
    MOVING = "moving"
    FAULT = "fault"


_S = ArmState

# A motion holds the arm's lock.  A thread that has the lock and finds MOVING finds a motion that
# was cut off.
IN_USE: Mapping[ArmState, ArmState] = dict.fromkeys((_S.ENABLED, _S.HOLD, _S.MOVING), _S.ENABLED)
"""States in which the arm takes commands -> state after a command."""

EVENTS: Mapping[str, Mapping[ArmState, ArmState]] = {
    "connect": {_S.DISCONNECTED: _S.CONNECTED},
    "enable": {_S.CONNECTED: _S.ENABLED},
    "send": IN_USE,
    "grip": IN_USE,
    "hold": dict.fromkeys(IN_USE, _S.HOLD),
    "move": dict.fromkeys(IN_USE, _S.MOVING),
    "limit the current": {state: state for state in (_S.CONNECTED, *IN_USE)},
    "reset a fault": {_S.FAULT: _S.CONNECTED},
    "reconnect": {_S.FAULT: _S.CONNECTED, _S.CONNECTED: _S.CONNECTED},
}
"""Event -> state before -> state after.  ``close`` and a fault are possible in every state."""


def possible(event: str, state: ArmState) -> bool:
    """Return whether an event is possible in a state."""
    return state in EVENTS[event]


def state_after(event: str, state: ArmState) -> ArmState:
    """Return the state after an event.

    Raises:
        ArmStateError: The event is not possible in this state.
    """
    allowed = EVENTS[event]
    if state in allowed:
        return allowed[state]
    names = ", ".join(state.value for state in allowed)
    raise ArmStateError(
        f"cannot {event}: the arm is {state.value}; allowed: {names}",
        hint="connect(), enable(), then send(); after a fault reset_fault() or close()",
    )
