"""Scripted test runs: a TOML file says what an arm shall do, what goes wrong, and what must be true.

``load_script`` reads one, ``ScriptRun`` runs it; ``shipped`` names those that come along.
"""

from robot_ik.jobs.script.file import Script, load_script, parse_script, shipped
from robot_ik.jobs.script.report import ScriptReport, json_report
from robot_ik.jobs.script.run import ScriptRequest, ScriptRun, run_script
from robot_ik.jobs.script.state import StepResult

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
