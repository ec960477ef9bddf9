"""``robot-ik completion``: print the completion script of a shell."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from cyclopts import Parameter

from robot_ik.commands.terminal import QUIET, Report, Terminal


@dataclass(frozen=True)
class Completion:
    """Print a script that completes the commands and options of robot-ik in a shell.

    For bash:

        robot-ik completion bash > ~/.local/share/bash-completion/completions/robot-ik
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], Parameter(name="SHELL")]
    """The shell."""

    def run(self, terminal: Terminal = QUIET) -> CompletionReport:
        """Import all commands and print the script."""
        from robot_ik.commands.main import completion_script  # it imports all commands

        script = completion_script(self.shell)
        terminal.end_progress()
        if not terminal.quiet:
            sys.stdout.write(script)  # a table would expand tabs
        return CompletionReport(script)


@dataclass(frozen=True)
class CompletionReport(Report):
    """The script."""

    streamed: ClassVar[bool] = True

    script: str

    def tables(self) -> Iterable[Any]:
        return [self.script]

    def facts(self) -> dict[str, Any]:
        return {"script": self.script}
