"""The steps of a script: one class a kind, with its keys, what it asks of an arm, and what it does.

Importing this fills ``STEPS``: a subclass of ``ScriptStep`` enters itself, and nothing else lists it.
"""

from robot_ik.jobs.script.steps import control, expect, moves
from robot_ik.jobs.script.steps.base import STEPS, Action, ScriptStep, step_class

__all__ = ["STEPS", "Action", "ScriptStep", "control", "expect", "moves", "step_class"]
