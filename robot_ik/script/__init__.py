"""Scripted test runs: a TOML file lists moves of an arm, faults and conditions.

``load_script`` reads a script, and ``ScriptRun`` runs it. ``shipped`` lists the bundled scripts.
"""

from robot_ik.script.file import Script, load_script, parse_script, shipped
from robot_ik.script.report import ScriptReport, json_report
from robot_ik.script.run import ScriptRequest, ScriptRun, run_script
from robot_ik.script.state import StepResult

__all__ = [
    "Script",
    "ScriptReport",
    "ScriptRequest",
    "ScriptRun",
    "StepResult",
    "json_report",
    "load_script",
    "parse_script",
    "run_script",
    "shipped",
]
