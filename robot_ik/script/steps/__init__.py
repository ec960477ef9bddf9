"""The kinds of steps of a script, one class each.

Importing this package fills ``STEPS``. Each subclass of ``ScriptStep`` with a key ``do`` registers
itself.
"""

from robot_ik.script.steps import control, expect, follow, grip, moves
from robot_ik.script.steps.base import STEPS, Action, ScriptStep, step_class

__all__ = [
    "STEPS",
    "Action",
    "ScriptStep",
    "control",
    "expect",
    "follow",
    "grip",
    "moves",
    "step_class",
]
