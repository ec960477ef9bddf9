"""The progress bar of a running command, on stderr."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, Task, TextColumn, TimeElapsedColumn
from rich.progress_bar import ProgressBar


class _ShareColumn(BarColumn):
    """A bar of the share that is done. It fills with the time if the duration is known."""

    def render(self, task: Task) -> ProgressBar:
        seconds = task.fields.get("seconds")
        if seconds:
            task.completed = min((task.elapsed or 0.0) / seconds, 1.0)
        return super().render(task)


class CommandProgress:
    """A bar with the name of the phase. It disappears at the end.

    Attributes:
        console: Its console. Lines that it prints appear above the bar.
    """

    def __init__(self, name: str, console: Console) -> None:
        self.console = console
        columns = (TextColumn("{task.description}"), _ShareColumn(), TimeElapsedColumn())
        self._bar = Progress(*columns, console=console, transient=True)
        self._task = self._bar.add_task(name, total=None, seconds=None)

    def start(self) -> None:
        """Show the bar."""
        self._bar.start()

    def stop(self) -> None:
        """Remove the bar. It may be called again."""
        self._bar.stop()

    def begin(self, phase: str, seconds: float | None) -> None:
        """Begin a phase, whose duration may be known."""
        self._bar.reset(self._task, total=1.0 if seconds else None, seconds=seconds)
        self._bar.update(self._task, description=phase)

    def update(self, **values: Any) -> None:
        """Change the fields of the bar: description, total, completed, seconds."""
        self._bar.update(self._task, **values)
